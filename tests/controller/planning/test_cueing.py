"""Motion cueing: the filter against continuous transfer functions by python-control, against physics, and within all limits."""

import re
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from controller.frames import ActiveFrames, parse_frames
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions import (
    MANOEUVRES,
    CueFilter,
    Cueing,
    Line,
    Motion,
    Place,
    ToolLimits,
    Washout,
    drive,
    load_washout,
    motion_from_text,
    plan_motion,
    read_vehicle,
    text_of_motion,
    text_of_vehicle,
)
from controller.planning.motions.cueing import COLUMNS, FORCE_COLUMNS, ROW, Site, at_rest, render
from controller.planning.offline_planner import count_violations
from controller.planning.stream_planner import StreamPlanner
from controller.planning.target import plan_in_frames
from plant.errors import InputError, UnknownNameError
from plant.imu.model import STANDARD_GRAVITY as G
from plant.mechanism import load_in_space, load_mechanism
from plant.pose import Pose
from tests.controller.planning.test_motions import check_reference

HERE = Pose(np.zeros(3), np.eye(3))
UP = np.array([0.0, 0.0, 1.0])
LEFT_ALONE = {"most_acceleration": (50.0,) * 3, "most_turn_speed": (50.0,) * 3, "tilt_speed": 1e3}


def site_at_home(mechanism, point=(0.0, 0.0, 0.0)):
    home = mechanism.require_home()
    return Site(mechanism, HERE, lambda p, r: (home.position + p, r @ home.rotation), point)


def filtered(site, washout, times, forces, rates):
    """The rows of a filter, and its parameters."""
    rows, p = np.zeros(len(times), ROW), site.filter(washout)
    render(p, at_rest(), times, np.ascontiguousarray(forces), np.ascontiguousarray(rates), np.ones(len(times)), rows)
    return rows, p


def written(path, times, forces, rates, columns=COLUMNS):
    rows = np.column_stack([times, forces, rates])
    path.write_text("\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows.tolist())]) + "\n")
    return str(path)


@pytest.fixture
def calm(tmp_path):
    """A vehicle at rest but for a gentle push along x."""
    times = np.arange(0.0, 4.0, 0.01)
    forces = np.outer(0.2 * np.sin(np.pi * np.clip(times - 1.0, 0.0, 1.0)) ** 2, [1.0, 0.0, 0.0])
    return written(tmp_path / "calm.csv", times, forces, 0.0 * forces)


# ------------------------------------------------------------------------------------------------------------------- filter


def low(frequency):
    return control.tf([frequency], [1.0, frequency])


@pytest.mark.slow
@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("kind", ["force x", "force y", "force z", "rate x", "rate y", "rate z"])
def test_small_motions_are_those_of_the_transfer_functions(hexapod, kind, order):
    washout = Washout(scale=0.6, turn_scale=0.7, **LEFT_ALONE, **({"return_frequency": 0.0} if order == 2 else {}))
    times = np.arange(0.0, 12.0, 0.004)
    random = np.random.default_rng(3)
    wave = np.interp(times, np.arange(0.0, 13.0, 0.25), np.cumsum(random.normal(0.0, 1e-4, 52))) * np.clip(times, 0.0, 1.0)
    what, axis = kind.split()
    k = "xyz".index(axis)
    vehicle = np.zeros((2, len(times), 3))
    vehicle[int(what == "rate"), :, k] = wave
    rows, p = filtered(site_at_home(hexapod), washout, times, *vehicle)
    s, w, v = control.tf("s"), float(p["washout"]), float(p["back"])
    assert (v == 0.0) == (order == 2)
    smooth = low(float(p["smoothing"])) ** 2
    moved = 1 / (s + w) ** 2 * (1.0 if order == 2 else s / (s + v))
    tilt = low(float(p["tilt_frequency"])) ** 2 * low(float(p["tilt_smoothing"])) ** 2
    turned = smooth * s / (s + float(p["turn_washout"])) ** 2

    def response(system):
        return control.forced_response(system, times, wave).outputs

    expected = np.zeros((len(times), 6))
    if what == "force" and axis == "z":
        expected[:, 2] = 0.6 * response(moved * smooth)
    elif what == "force":
        # The nose goes up when the vehicle speeds up: x leans about -y, y about +x.
        across, sign = (4, -1.0) if axis == "x" else (3, 1.0)
        expected[:, k] = 0.6 * response(moved * (smooth - tilt))
        expected[:, across] = 0.6 * sign * response(tilt) / G
    else:
        expected[:, 3 + k] = 0.7 * response(turned)
        if axis != "z":
            # A turn makes gravity felt, and moving renders that no such force is there: a = angle x (g up).
            other, sign = (1, -1.0) if axis == "x" else (0, 1.0)
            expected[:, other] = 0.7 * sign * G * response(moved * turned)
    for column in range(6):
        size = max(np.abs(expected[:, column]).max(), 1e-8)
        assert np.abs(rows["moves"][:, column] - expected[:, column]).max() < 2e-3 * size


def test_the_period_of_the_samples_does_not_matter(hexapod):
    vehicle, site = drive(["brake", "lane-change"]), site_at_home(hexapod)
    fine = np.arange(0.0, vehicle.times[-1], 0.001)
    values = [np.column_stack([np.interp(fine, vehicle.times, column) for column in each.T]) for each in vehicle[1:3]]
    coarse_rows, _ = filtered(site, Washout(), vehicle.times, vehicle.forces, vehicle.rates)
    fine_rows, _ = filtered(site, Washout(), fine, *values)
    off = np.abs(fine_rows["moves"][::10] - coarse_rows["moves"][: len(fine_rows[::10])])
    assert (off.max(axis=0) < [1e-4] * 3 + [3e-4] * 3).all()


# ------------------------------------------------------------------------------------------------------------------ physics


@pytest.mark.slow
@settings(max_examples=20)
@given(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))
def test_what_lasts_is_felt_as_gravity_and_the_platform_comes_back(hexapod, along, across):
    """The tilt's gravity is the scaled acceleration, to where it is too steep, with the platform back in the middle."""
    times = np.arange(0.0, 60.0, 0.01)
    forces = np.tile([along, across, 0.0], (len(times), 1))
    rows, p = filtered(site_at_home(hexapod), Washout(), times, forces, 0.0 * forces)
    felt = Rotation.from_rotvec(rows["moves"][-1, 3:]).inv().apply(G * UP)
    asked = 0.5 * np.array([along, across])
    share = min(1.0, G * p["steepest"] / max(np.linalg.norm(asked), 1e-12))
    np.testing.assert_allclose(felt[:2], share * asked, rtol=0.0, atol=1e-6)
    assert abs(rows["moves"][-1, 5]) < 1e-9
    assert np.abs(rows["moves"][-1, :3]).max() < 1e-5
    # It tilts no faster than allowed, and begins to move the way that the vehicle goes.
    tilted = rows["moves"][:, 3:]
    assert np.linalg.norm(np.diff(tilted, axis=0), axis=1).max() / 0.01 <= np.radians(3.0) * (1.0 + 1e-9)
    assert rows["tilt_speed"].max() <= np.radians(3.0) * (1.0 + 1e-9)
    assert (rows["moves"][5, :2] * asked >= 0.0).all()


def test_a_cue_that_may_not_move_or_turn_tilts_alone(hexapod):
    """No filter divides by 0 where nothing is to be washed out, and the tilt is as quick as usual."""
    times = np.arange(0.0, 60.0, 0.01)
    forces, rates = np.tile([0.5, -0.2, 3.0], (len(times), 1)), np.tile([0.1, 0.2, -0.3], (len(times), 1))
    usual, still = site_at_home(hexapod).filter(Washout()), Washout(most_acceleration=(0.0,) * 3, most_turn_speed=(0.0,) * 3)
    rows, p = filtered(site_at_home(hexapod), still, times, forces, rates)
    felt = Rotation.from_rotvec(rows["moves"][-1, 3:]).inv().apply(G * UP)
    np.testing.assert_allclose(felt[:2], [0.25, -0.1], rtol=0.0, atol=1e-6)
    assert p["washout"] == usual["washout"] and p["tilt_frequency"] == usual["tilt_frequency"]
    assert np.isfinite(rows["moves"]).all() and (rows["moves"][:, :3] == 0.0).all()
    assert np.abs(rows["moves"][:, 5]).max() < 1e-9


def test_a_step_of_angular_velocity_is_washed_out(hexapod):
    times = np.arange(0.0, 20.0, 0.005)
    rates = np.tile([0.0, 0.0, 0.2], (len(times), 1))
    rows, p = filtered(site_at_home(hexapod), Washout(), times, 0.0 * rates, rates)
    yaw = rows["moves"][:, 5]
    # The greatest angle of w t exp(-w t) / w at t = 1 / w, a little later by the smoothing.
    assert yaw.max() == pytest.approx(0.1 / (np.e * p["turn_washout"]), rel=0.01)
    assert abs(yaw[-1]) < 1e-6


def test_a_lean_of_the_vehicle_alone_is_rendered_by_the_lean(hexapod):
    """Accelerometers that lean read gravity from the side. Turning with the gyroscopes renders that, so nothing need move."""
    times = np.arange(0.0, 3.0, 0.005)
    angle = 0.02 * np.sin(np.pi * np.clip(times / 0.4, 0.0, 1.0)) ** 2
    rates = np.outer(np.gradient(angle, times), [1.0, 0.0, 0.0])
    forces = np.column_stack([0.0 * angle, G * np.sin(angle), G * np.cos(angle) - G])
    washout = Washout(scale=1.0, turn_scale=1.0, turn_washout_frequency=0.01, tilt=0.0, **LEFT_ALONE)
    leaning, _ = filtered(site_at_home(hexapod), washout, times, forces, rates)
    pushed, _ = filtered(site_at_home(hexapod), washout, times, forces, 0.0 * rates)
    assert np.abs(leaning["moves"][:, 1]).max() < 0.2 * np.abs(pushed["moves"][:, 1]).max()


def test_the_operator_s_point_moves_and_the_platform_turns_about_it(hexapod, calm):
    """With the operator above the tool, the tool swings below; the operator goes as without."""
    point = np.array([0.02, -0.01, 0.1])
    plain = plan_motion(Motion((Cueing(file=calm),)), hexapod)
    moved = plan_motion(Motion((Cueing(file=calm, point=tuple(point), washout_frequency=0.8, tilt=0.1),)), hexapod)
    again = plan_motion(Motion((Cueing(file=calm, washout_frequency=0.8, tilt=0.1),)), hexapod)
    head = moved.positions + moved.rotations @ point
    np.testing.assert_allclose(head - head[0], again.positions - again.positions[0], atol=1e-7)
    assert np.abs(moved.positions - plain.positions).max() > 1e-4


def test_a_work_frame_turns_the_axes_of_the_vehicle(hexapod, calm):
    """What pushes along x of the work frame is felt along x of it, on a base that is not level, too."""
    up = Rotation.from_rotvec([0.03, -0.02, 0.0]).apply(UP)
    tilted = replace(hexapod, up_in_base=up)
    frames = ActiveFrames(
        parse_frames(
            'work = "table"\ntool = "flange"\n[frames.table]\nparent = "base"\nposition = [0.1, 0, 0]\n'
            'rotation_vector_deg = [0, 0, 90]\n[frames.flange]\nparent = "platform"\nposition = [0, 0, 0]\n',
            "frames",
        )
    )
    washout = {"tilt_speed": 1.0, "tilt_frequency": 2.0, "scale": 1.0}
    planned = plan_in_frames(Motion((Cueing(file=calm, **washout),)), tilted, frames)
    turn = Rotation.from_matrix(planned.rotations[700])
    accelerations = np.gradient(np.gradient(planned.positions, 0.002, axis=0), 0.002, axis=0)
    times = planned.times[:-1]
    middle = int(np.searchsorted(times, 1.6))
    turn = Rotation.from_matrix(planned.rotations[middle] @ planned.rotations[0].T)
    felt = turn.inv().apply(accelerations[middle] + G * up) - G * up
    # x of the work frame is y of {1}.
    assert felt[1] > 0.1 and abs(felt[0]) < 0.02 and abs(felt[2]) < 0.02


# ------------------------------------------------------------------------------------------------------------------- limits


@st.composite
def vehicles(draw):
    """A vehicle with up to three manoeuvres, shaken besides, up to far beyond what a platform can render."""
    names = draw(st.lists(st.sampled_from([*MANOEUVRES]), min_size=1, max_size=3))
    vehicle = drive(names, draw(st.floats(4.0, 30.0)), draw(st.floats(0.3, 4.0)), rest=draw(st.floats(0.2, 1.0)))
    random = np.random.default_rng(draw(st.integers(0, 1000)))
    shake = draw(st.sampled_from([0.0, 1.0, 20.0])) * random.normal(size=(2, *vehicle.forces.shape))
    return vehicle._replace(forces=vehicle.forces + shake[0], rates=vehicle.rates + 0.3 * shake[1])


@st.composite
def washouts(draw):
    given = {
        "scale": st.floats(0.1, 2.0),
        "washout_frequency": st.floats(0.1, 2.0),
        "return_frequency": st.floats(0.0, 0.5),
        "turn_washout_frequency": st.floats(0.05, 1.0),
        "tilt_frequency": st.floats(0.2, 2.0),
        "tilt": st.floats(0.0, 0.5),
        "tilt_speed": st.floats(0.01, 0.5),
        "most_acceleration": st.tuples(*[st.floats(0.0, 20.0)] * 3),
        "most_turn_speed": st.tuples(*[st.floats(0.0, 3.0)] * 3),
        "point": st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    }
    chosen = draw(st.lists(st.sampled_from([*given]), unique=True, max_size=4))
    return {name: draw(given[name]) for name in chosen}


def check_plan(folder, data):
    mechanism = load_mechanism(data.draw(st.sampled_from(["hexapod", "genhexkins", "6-3-I", "6-5"])))
    vehicle, given_settings = data.draw(vehicles()), data.draw(washouts())
    path = written(folder / "v.csv", *vehicle[:3])
    speed = data.draw(st.sampled_from([np.inf, 0.05]))
    cue = Cueing(file=path, settle=4.0, limits=ToolLimits(speed=speed), **given_settings)
    planned = plan_motion(Motion((Line(Place(position=(0.01, 0.0, 0.0))), cue)), mechanism)
    check_reference(mechanism, planned)
    assert count_violations(planned.segments, planned.duration, mechanism.limits) == 0
    assert next(peak.value for peak in planned.parts[1].peaks if peak.name == "speed of the tool") <= speed
    home = mechanism.require_home()
    np.testing.assert_allclose(planned.positions[-1], home.position + [0.01, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(planned.rotations[-1], home.rotation, atol=1e-9)
    rendered = planned.parts[1].cue
    assert np.isfinite([*rendered.asked, *rendered.error, rendered.tilt]).all()
    assert all(0.0 < each.factor < 1.0 < each.share * 1.01 for each in rendered.scaled)


@settings(max_examples=4)
@given(st.data())
def test_no_manoeuvre_leaves_a_limit(tmp_path_factory, data):
    check_plan(tmp_path_factory.mktemp("cue"), data)


@pytest.mark.slow
@settings(max_examples=20)
@given(st.data())
def test_none_of_many_manoeuvres_leaves_a_limit(tmp_path_factory, data):
    check_plan(tmp_path_factory.mktemp("cue"), data)


def check_stream(data):
    """The loop's own planner takes every pose, with lost ones between them, and what it plans is within all limits."""
    mechanism = load_mechanism(data.draw(st.sampled_from(["hexapod", "genhexkins", "6-3-I", "6-5"])))
    vehicle, given_settings = data.draw(vehicles()), data.draw(washouts())
    rate, lost = data.draw(st.sampled_from([50.0, 100.0])), data.draw(st.sampled_from([0.0, 0.2]))
    random = np.random.default_rng(1)
    washout = Washout(**given_settings)
    home, stroke = mechanism.require_home(), mechanism.limits.stroke
    cue = CueFilter(washout, site_at_home(mechanism, washout.point))
    planner = StreamPlanner(mechanism, leg_lengths(mechanism, home.position, home.rotation))
    every, before = round(100.0 / rate), None
    for k in range(0, min(len(vehicle.times), 800), every):
        position, quaternion = cue.step(vehicle.forces[k], vehicle.rates[k], 1.0 / rate)
        turn = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        lengths = leg_lengths(mechanism, home.position + position, turn @ home.rotation)
        assert (lengths >= stroke[:, 0]).all() and (lengths <= stroke[:, 1]).all()
        if before is not None:
            assert np.abs(lengths - before).max() <= mechanism.limits.velocity / rate * (1.0 + 1e-9)
        before = lengths
        if k and random.random() < lost:
            continue
        planner.add(0.01 * k, position, quaternion)
        plan = planner.plan(0.01 * k + 0.02, 0.02)
        if plan is not None:
            assert count_violations(plan.segments, np.inf, mechanism.limits) == 0
            planner.follow(plan)


@pytest.mark.slow
@settings(max_examples=2)
@given(st.data())
def test_a_streamed_cue_is_never_refused_and_no_limit_is_left(data):
    check_stream(data)


@pytest.mark.slow
@settings(max_examples=5)
@given(st.data())
def test_none_of_many_streamed_cues_is_refused(data):
    check_stream(data)


def test_what_a_streamed_cue_is_kept_from_is_counted(hexapod):
    site = site_at_home(hexapod)
    calm = CueFilter(Washout(), site)
    for _ in range(100):
        calm.step((0.05, 0.0, 0.0), (0.0, 0.0, 0.0), 0.01)
    assert calm.kept.samples == 100
    assert not any((calm.kept.clipped, calm.kept.tilt_clipped, calm.kept.tilt_slowed, calm.kept.stroke, calm.kept.slowed))
    wild = CueFilter(Washout(scale=1.0, washout_frequency=0.2, most_acceleration=(15.0,) * 3, tilt=0.5, tilt_speed=0.3), site)
    for k in range(600):
        wild.step((20.0 * (1 if (k // 150) % 2 else -1), 3.0, 0.0), (0.0, 0.0, 9.0), 0.01)
    kept = wild.kept
    assert min(kept.clipped, kept.tilt_clipped, kept.tilt_slowed, kept.stroke, kept.slowed) > 0
    assert kept.excess > 1e-3 and 0 <= kept.leg < 6 and kept.speed > hexapod.limits.velocity


def test_gravity_in_the_samples_is_no_cue(hexapod):
    cue = CueFilter(Washout(), site_at_home(hexapod))
    for _ in range(50):
        position, quaternion = cue.step((0.0, 0.0, G), (0.0, 0.0, 0.0), 0.02, gravity=True)
    np.testing.assert_allclose(position, 0.0, atol=1e-12)
    np.testing.assert_allclose(quaternion, (1.0, 0.0, 0.0, 0.0), atol=1e-12)


@pytest.mark.parametrize(
    "sample", [((np.nan, 0, 0), (0, 0, 0), 0.01), ((0, 0, 0), (0, np.inf, 0), 0.01), ((0, 0, 0), (0, 0, 0), 0.0)]
)
def test_a_sample_that_is_none_is_refused(hexapod, sample):
    cue = CueFilter(Washout(), site_at_home(hexapod))
    with pytest.raises(InputError, match=r"finite|at least"):
        cue.step(*sample)


# ------------------------------------------------------------------------------------------------------------------- report


def test_nothing_is_clipped_of_a_calm_motion(hexapod, calm):
    planned = plan_motion(Motion((Cueing(file=calm),)), hexapod)
    rendered = planned.parts[0].cue
    assert not rendered.scaled and {clip.what for clip in rendered.clips} <= {"tilt speed"}
    assert planned.summary()["elements"][0]["cue"]["onset_gain"][1] is None
    calmer = plan_motion(Motion((Cueing(file=calm, scale=0.2),)), hexapod)
    assert not calmer.parts[0].cue.clips and not calmer.remarks


def test_what_was_clipped_is_told(hexapod, tmp_path):
    """A long push is too steep and too fast for the tilt, a bump and a spin are clipped, and a slow washout needs scaling."""
    times = np.arange(0.0, 12.0, 0.01)
    forces, rates = np.zeros((2, len(times), 3))
    forces[:, 0] = 6.0 * ((times > 1.0) & (times < 4.0))
    forces[:, 2] = 8.0 * ((times > 6.0) & (times < 6.1))
    rates[:, 2] = 3.0 * ((times > 8.0) & (times < 8.5))
    cue = Cueing(file=written(tmp_path / "v.csv", times, forces, rates), washout_frequency=0.4)
    planned = plan_motion(Motion((cue,), name="push"), hexapod)
    rendered, p = planned.parts[0].cue, site_at_home(hexapod).filter(cue.settings)
    spans = {what: [(c.begin, c.end, c.asked, c.most) for c in rendered.clips if c.what == what] for what in
             {clip.what for clip in rendered.clips}}  # fmt: skip
    bump = next(each for each in spans["acceleration along z"] if 5.9 < each[0] < 6.1)
    assert 0.05 < bump[1] - bump[0] < 0.2 and bump[2] == pytest.approx(4.0, abs=0.4) and bump[3] == p["most_acceleration"][2]
    ((begin, end, asked, most),) = spans["angular velocity about z"]
    assert begin == pytest.approx(8.0, abs=0.02) and end == pytest.approx(8.5, abs=0.02)
    assert asked == pytest.approx(1.5) and most == p["most_turn_speed"][2]
    assert spans["tilt"][0][2] > np.arcsin(p["steepest"]) and spans["tilt speed"][0][2] > np.radians(3.0)
    (scaled, *_) = rendered.scaled
    assert re.fullmatch("(stroke|velocity|acceleration|jerk) of leg [0-5]", scaled.limit)
    assert 0.0 < scaled.factor < 1.0 < scaled.share and scaled.begin < 4.0
    # It is not scaled by more than it must be.
    lengths, stroke = planned.segments[:, :, 1], hexapod.limits.stroke
    room = np.where(lengths > lengths[:, :1], stroke[:, 1:] - lengths[:, :1], lengths[:, :1] - stroke[:, :1])
    assert (np.abs(lengths - lengths[:, :1]) / room).max() > 0.93
    said = "\n".join(planned.remarks)
    for part in ("acceleration along z is clipped", "tilt is clipped", "deg/s to 3", "motion is scaled to", "of its limit"):
        assert part in said


def test_the_quality_of_a_cue_is_what_the_planned_poses_give(hexapod, tmp_path):
    """From the poses alone, by differences: what an accelerometer at the operator would read."""
    path = tmp_path / "drive.csv"
    path.write_text(text_of_vehicle(drive(["brake", "lane-change", "bumps"])))
    point = np.array([0.0, 0.05, 0.1])
    planned = plan_motion(Motion((Cueing(file=str(path), point=tuple(point)),)), hexapod)
    rendered, vehicle = planned.parts[0].cue, read_vehicle(path)
    heads = (planned.positions + planned.rotations @ point)[:-1]
    times = planned.times[:-1]
    accelerations = np.gradient(np.gradient(heads, times, axis=0), times, axis=0)
    felt = np.einsum("nji,nj->ni", planned.rotations[:-1], accelerations + G * UP) - G * UP
    during = times <= vehicle.times[-1]
    asked = 0.5 * np.column_stack([np.interp(times, vehicle.times, column) for column in vehicle.forces.T])
    missing = (asked - felt)[during]
    np.testing.assert_allclose(rendered.asked, np.sqrt((asked[during] ** 2).mean(axis=0)), rtol=1e-2)
    np.testing.assert_allclose(rendered.error, np.sqrt((missing**2).mean(axis=0)), rtol=1e-2)
    np.testing.assert_allclose(rendered.worst_error, np.abs(missing).max(axis=0), rtol=2e-2)
    changes, shown = (values[during][50:] - values[during][:-50] for values in (asked, felt))
    np.testing.assert_allclose(
        rendered.onset_gain, [np.polyfit(c, s, 1)[0] for c, s in zip(changes.T, shown.T, strict=True)], atol=0.01
    )
    tilt = np.arccos(planned.rotations[:, 2, 2]).max()
    assert rendered.tilt == pytest.approx(tilt, rel=1e-3) and rendered.tilt_speed <= np.radians(3.0) * (1.0 + 1e-9)
    # A cue is worth something: bumps and braking are felt from the right side.
    assert rendered.onset_gain[0] > 0.2 and rendered.onset_gain[2] > 0.3


# ------------------------------------------------------------------------------------------------------------------ defaults


@pytest.mark.parametrize("name", ["hexapod", "genhexkins", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5"])
def test_defaults_suit_the_mechanism(name):
    """The box of moves is within all strokes and reaches one of them; a twin of twice the size and speed has twice the room."""
    mechanism = load_mechanism(name)
    site = site_at_home(mechanism)
    room = site.room(range(6))
    random = np.random.default_rng(0)
    assert site.inside(random.uniform(-1.0, 1.0, (2000, 6)) * room).all()
    corners = np.sign(random.uniform(-1.0, 1.0, (500, 6)))
    assert not site.inside(1.01 * corners * room).all()
    p = site.filter(Washout())
    assert 0.03 < p["steepest"] < 0.5 and 1.0 < p["washout"] < 20.0 and (p["most_acceleration"] > 0.1).all()


def test_a_planar_mechanism_neither_tilts_nor_leaves_its_plane(tmp_path):
    mechanism = load_in_space("planar-3rpr")
    path = tmp_path / "drive.csv"
    path.write_text(text_of_vehicle(drive(["brake", "lane-change"])))
    planned = plan_motion(Motion((Cueing(file=str(path)),)), mechanism)
    home = mechanism.require_home()
    moves = planned.positions - home.position
    assert np.abs(moves[:, 2]).max() < 1e-12 and np.abs(moves[:, :2]).max() > 1e-3
    assert np.abs(planned.rotations[:, 2, 2] - 1.0).max() < 1e-12
    # Its plane stands upright, so that it can lean in it, and renders braking so.
    assert abs(mechanism.up_in_base[2]) < 1e-9 and planned.parts[0].cue.tilt > 0.01
    lying = replace(mechanism, up_in_base=UP)
    assert plan_motion(Motion((Cueing(file=str(path)),)), lying).parts[0].cue.tilt < 1e-12


# -------------------------------------------------------------------------------------------------------------------- files


def test_a_cue_is_read_in_degrees_and_written_again(tmp_path, calm):
    text = """
[[elements]]
kind = "cueing"
file = "calm.csv"
scale = 0.4
tilt_deg = 5
tilt_speed_deg = 2
most_turn_speed_deg = [10, 10, 20]
speed = 0.1
dwell = 1
"""
    motion = motion_from_text(text, "cue.toml", tmp_path)
    (cue,) = motion.elements
    assert cue.tilt == pytest.approx(np.radians(5.0)) and cue.tilt_speed == pytest.approx(np.radians(2.0))
    np.testing.assert_allclose(cue.most_turn_speed, np.radians([10.0, 10.0, 20.0]))
    assert cue.limits.speed == 0.1 and cue.file == calm
    assert motion_from_text(text_of_motion(motion), "cue.toml") == motion
    settings_alone = "\n".join(line for line in text.splitlines()[3:] if line.split(" ")[0] not in ("file", "speed", "dwell"))
    path = tmp_path / "washout.toml"
    path.write_text(settings_alone)
    assert load_washout(path) == cue.settings


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ("", "lacks file"),
        ('file = "none.csv"', "none.csv"),
        ('file = "calm.csv"\nscale = -1', "scale is -1; it must be 0 to 10"),
        ('file = "calm.csv"\ntilt_deg = 50', "tilt is"),
        ('file = "calm.csv"\ntilt_speed = 0', "tilt_speed is 0"),
        ('file = "calm.csv"\nwashout_frequency = 60', "washout_frequency is 60; it must be 0.001 to 50"),
        ('file = "calm.csv"\nmost_acceleration = 1', "most_acceleration must have shape"),
        ('file = "calm.csv"\nmost_acceleration = [1, -1, 1]', "most_acceleration is -1; it must be at least 0"),
        ('file = "calm.csv"\nsettle = 0.1', "settle is 0.1"),
        ('file = "calm.csv"\nwash_out_frequency = 1', "has no entry 'wash_out_frequency'"),
        ('file = "late.csv"', "line 4: time 0.5 s does not come after 0.5 s"),
        ('file = "short.csv"', "has 1 samples; a vehicle's motion needs at least 2"),
        ('file = "nan.csv"', "az_m_s2 is nan"),
        ('file = "wrong.csv"', "the header must be time_s,ax_m_s2"),
    ],
)
def test_what_cannot_be_meant_is_refused(tmp_path, calm, entries, said):
    row = ",0,0,0,0,0,0"
    header = ",".join(COLUMNS)
    (tmp_path / "late.csv").write_text(f"{header}\n0{row}\n0.5{row}\n0.5{row}\n")
    (tmp_path / "short.csv").write_text(f"{header}\n0{row}\n")
    (tmp_path / "nan.csv").write_text(f"{header}\n0{row}\n1,0,0,nan,0,0,0\n")
    (tmp_path / "wrong.csv").write_text("t,a\n0,1\n")
    with pytest.raises(InputError) as refusal:
        motion_from_text(f'[[elements]]\nkind = "cueing"\n{entries}\n', "cue.toml", tmp_path)
    assert "cue.toml, element 1 (cueing)" in str(refusal.value) and said in str(refusal.value)


def test_no_room_is_told(hexapod, calm):
    top = hexapod.limits.stroke[:, 1]
    low_end, high = 0.0, 0.2
    home = hexapod.require_home()
    for _ in range(60):
        middle = 0.5 * (low_end + high)
        inside = (leg_lengths(hexapod, home.position + [0.0, 0.0, middle], home.rotation) <= top).all()
        low_end, high = (middle, high) if inside else (low_end, middle)
    motion = Motion((Cueing(file=calm),), start=Place(position=(0.0, 0.0, high)))
    with pytest.raises(InputError, match="no room for a cue"):
        plan_motion(motion, hexapod)


def test_specific_forces_with_gravity_are_the_same_cue(hexapod, tmp_path):
    vehicle = drive(["lane-change"])
    plain = written(tmp_path / "a.csv", *vehicle[:3])
    heavy = written(tmp_path / "f.csv", vehicle.times, vehicle.forces + G * UP, vehicle.rates, FORCE_COLUMNS)
    first, second = (plan_motion(Motion((Cueing(file=file),)), hexapod) for file in (plain, heavy))
    np.testing.assert_allclose(first.segments, second.segments, atol=1e-9)


# --------------------------------------------------------------------------------------------------------------- manoeuvres


@pytest.mark.parametrize("speed", [8.0, 20.0])
@pytest.mark.parametrize("strength", [0.5, 1.5])
def test_manoeuvres_are_those_of_a_car(speed, strength):
    period = 0.01
    brake = drive(["brake"], speed, strength)
    assert period * brake.forces[:, 0].sum() == pytest.approx(-speed, rel=0.01)
    assert brake.forces[:, 0].min() == pytest.approx(-max(speed / max(speed / (5.0 * strength), 0.3), 0.0), rel=0.01)
    change = drive(["lane-change"], speed, strength)
    velocity = period * np.cumsum(change.forces[:, 1])
    assert abs(velocity[-1]) < 0.01 and period * velocity.sum() == pytest.approx(3.5, rel=0.01)
    np.testing.assert_allclose(change.rates[:, 2] * speed, change.forces[:, 1], atol=1e-9)
    bumps = drive(["bumps"], speed, strength)
    assert np.abs(bumps.forces[:, :2]).max() == 0.0 and np.abs(bumps.forces[:, 2]).max() > 0.1
    # It dives under the brake, and all that swings ends level, at the height where it began.
    for each in (brake, change, bumps):
        angles = period * np.cumsum(each.rates, axis=0)
        assert np.abs(angles[-1, :2]).max() < 2e-3
        height = period * np.cumsum(period * np.cumsum(each.forces[:, 2]))
        assert abs(height[-1]) < 2e-3
    assert (period * np.cumsum(brake.rates[:, 1])).max() > 0.005


def test_manoeuvres_are_written_and_read_again(tmp_path):
    vehicle = drive([*MANOEUVRES])
    path = tmp_path / "drive.csv"
    path.write_text(text_of_vehicle(vehicle))
    again = read_vehicle(path)
    for first, second in zip(vehicle[:3], again[:3], strict=True):
        np.testing.assert_allclose(first, second, atol=1e-9)
    with pytest.raises(UnknownNameError, match="did you mean 'brake'"):
        drive(["break"])
    with pytest.raises(InputError, match="speed"):
        drive(["brake"], speed=0.0)
