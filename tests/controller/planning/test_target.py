"""Targets: the named motions, CSV files good and bad, and poses between the samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from controller.direct_kinematics import poses_from_lengths
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions import MARGIN_S, MOTIONS, REST_S, SAMPLE_PERIOD_S
from controller.planning.offline_planner import plan
from controller.planning.target import COLUMNS, Target, load_target
from plant.errors import GoughError, InputError, UnknownNameError, UnreachableError
from plant.mechanism import Mechanism, load_in_space, load_spatial
from plant.pose import Pose
from tests.controller.leg_geometry import angle_between, rotation_of, unit
from tests.controller.planning.sampled_reference import sample_reference

HEADER = ",".join(COLUMNS)
ROWS = ["0.00,0,0,0,1,0,0,0", "0.01,0.001,0,0,1,0,0,0", "0.02,0.002,0,-0.001,1,0,0,0"]


def write(folder, *lines, ending="\n"):
    path = folder / "motion.csv"
    path.write_text(ending.join(lines) + ending)
    return path


# ----------------------------------------------------------------------------------------------------------- named motions


def displacements_at(mechanism, name, times, duration=4.0):
    """Displacements (N, 6) of a motion from home, position and rotation vector."""
    positions, rotations = load_target(name, mechanism, duration).at(np.asarray(times, float))
    turns = Rotation.from_matrix(rotations @ mechanism.home.rotation.T).as_rotvec()
    return np.hstack([positions - mechanism.home.position, turns])


@pytest.mark.parametrize("name", list(MOTIONS))
def test_a_named_motion_starts_at_home_at_rest_and_stays_inside_the_strokes(hexapod, name):
    target = load_target(name, hexapod, 30.0)
    np.testing.assert_allclose(target.start.position, hexapod.home.position, atol=1e-12)
    np.testing.assert_allclose(target.start.rotation, hexapod.home.rotation, atol=1e-12)
    assert target.times[0] == 0.0
    assert (np.diff(target.times) > 0.0).all()
    assert target.times[-1] >= 30.0 + MARGIN_S - 1e-9
    early = np.linspace(0.0, 0.02, 5)
    positions, rotations = target.at(early)
    assert np.linalg.norm(positions - positions[0], axis=1).max() < 1e-3 * 0.02
    assert max(angle_between(rotation, rotations[0]) for rotation in rotations) < 1e-3 * 0.02
    lengths = leg_lengths(hexapod, target.positions, target.rotations)
    hexapod.check_lengths(lengths, name)
    assert (np.ptp(lengths, axis=0).min() > 0.005) == (name != "hold")


def test_the_circle_turns_once_in_four_seconds(hexapod):
    target = load_target("circle", hexapod, 12.0)
    away = target.positions - hexapod.home.position
    later = target.times > 1.0
    np.testing.assert_allclose(np.linalg.norm(away[later], axis=1), 0.03, rtol=1e-9)
    np.testing.assert_allclose(away[later, 2], 0.0, atol=1e-15)
    np.testing.assert_allclose(target.at(np.array([2.0]))[0], target.at(np.array([6.0]))[0], atol=1e-9)
    tilts = Rotation.from_matrix(target.rotations[later]).magnitude()
    np.testing.assert_allclose(tilts, np.radians(4.0), rtol=1e-9)


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_the_circle_and_the_sines_are_those_that_are_described(preset):
    mechanism = load_in_space(preset)
    # The hexapod's strokes are 120 mm, the planar mechanism's 60 mm.
    scale, planar = (1.0, False) if preset == "hexapod" else (0.5, True)
    circle = displacements_at(mechanism, "circle", [0.5, 1.0, 2.0, 3.0])
    # Half of it after half a second, at 45 deg.
    r, tilt = 0.03 * scale, np.radians(4.0) * scale
    half = 0.5 * np.sqrt(0.5)
    np.testing.assert_allclose(circle[:, :2], [[half * r, half * r], [0.0, r], [-r, 0.0], [0.0, -r]], atol=1e-9)
    turns = [[half * tilt, -half * tilt, 0.0], [tilt, 0.0, 0.0], [0.0, tilt, 0.0], [-tilt, 0.0, 0.0]]
    if planar:
        turns = np.outer([half, 1.0, 0.0, -1.0], [0.0, 0.0, np.radians(10.0) * scale])
    np.testing.assert_allclose(circle[:, 3:], turns, atol=1e-9)
    sines = displacements_at(mechanism, "sines", [0.25, 1.5, 3.0])
    sizes = np.array([0.012, 0.012, 0.012, *np.radians([3.0, 3.0, 5.0])]) * scale
    times = np.array([[0.25], [1.5], [3.0]])
    expected = sizes * np.sin(2.0 * np.pi * times * [0.30, 0.37, 0.43, 0.50, 0.57, 0.63])
    # 10 x^3 - 15 x^4 + 6 x^5 at a quarter is 0.103515625.
    expected[0] *= 0.103515625
    expected[:, 2:5] *= not planar
    np.testing.assert_allclose(sines, expected, atol=1e-9)


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_steps_go_to_each_axis_in_turn_and_home_again(preset):
    mechanism = load_in_space(preset)
    scale = 1.0 if preset == "hexapod" else 0.5
    sizes = scale * np.diag([0.02, 0.02, 0.02, *np.radians([4.0, 4.0, 8.0])])
    poses = [np.zeros(6), *(sizes if preset == "hexapod" else sizes[[0, 1, 5]])]
    found = displacements_at(mechanism, "steps", 2.0 * np.arange(9) + 1.0, 20.0)
    np.testing.assert_allclose(found, [poses[k % len(poses)] for k in range(9)], atol=1e-12)


@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_shaking_uses_what_the_limits_allow_and_probing_three_tenths_of_it(preset):
    mechanism = load_in_space(preset)
    limits, target = mechanism.limits, load_target("shaking", mechanism, 6.0)
    assert target.times[-1] >= 6.0 + MARGIN_S - 1e-9 and not target.held
    lengths = leg_lengths(mechanism, target.positions, target.rotations)
    middle, half = limits.stroke.mean(axis=1), np.ptp(limits.stroke, axis=1) / 2.0
    rates = np.gradient(lengths, SAMPLE_PERIOD_S, axis=0)
    use = (
        (np.abs(lengths - middle) / half).max(),
        np.abs(rates).max() / limits.velocity,
        np.abs(np.gradient(rates, SAMPLE_PERIOD_S, axis=0)).max() / limits.acceleration,
    )
    assert 0.849 < max(use) <= 0.85
    times = np.arange(0.2, 6.0, 0.37)
    whole, small = (displacements_at(mechanism, name, times, 6.0) for name in ("shaking", "probing"))
    np.testing.assert_allclose(small, 0.3 * whole, rtol=0.0, atol=1e-4 * np.abs(whole).max())
    # 0.72 to 0.88 Hz: in order of the axes, each a little faster.
    moved = [k for k in range(6) if not mechanism.planar or k in (0, 1, 5)]
    times = np.arange(1.0, 6.0, 0.01)
    whole = displacements_at(mechanism, "shaking", times, 6.0)
    for k in moved:
        wave = np.sin(2.0 * np.pi * (0.72 + 0.032 * k) * times)
        np.testing.assert_allclose(whole[:, k], wave * (whole[:, k] @ wave) / (wave @ wave), atol=2e-4)
    size = [np.abs(whole[:, k]).max() for k in moved]
    spread = np.linalg.norm(mechanism.platform_joints, axis=1).mean()
    assert size[0] / size[-1] == pytest.approx(spread, rel=0.05)


@pytest.mark.parametrize(("name", "share"), [("rests", 0.8), ("near-rests", 0.4)])
@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_rests_begin_at_home_and_are_as_far_apart_as_the_strokes_share_allows(preset, name, share):
    mechanism = load_in_space(preset)
    target = load_target(name, mechanism, 2.0 * REST_S + 0.1)
    # Home, and three more for two and a bit.
    np.testing.assert_array_equal(target.times, REST_S * np.arange(4))
    assert target.held
    np.testing.assert_array_equal(target.positions[0], mechanism.home.position)
    lengths = leg_lengths(mechanism, target.positions, target.rotations)
    middle, half = mechanism.limits.stroke.mean(axis=1), np.ptp(mechanism.limits.stroke, axis=1) / 2.0
    used = np.abs(lengths - middle) / half
    assert used.max() <= share and used[1:].max() > 0.7 * share
    # Each is farther from those before than those that follow it will be.
    apart = [min(np.linalg.norm(lengths[k] - lengths[i]) for i in range(k)) for k in range(1, 4)]
    assert (np.diff(apart) <= 1e-12).all() and apart[-1] > half.mean() * share
    assert len(load_target(name, mechanism, 2.0 * REST_S).times) == 3


def test_steps_are_held_and_visit_every_axis(hexapod):
    target = load_target("steps", hexapod, 14.0)
    assert target.held
    moved = [np.zeros(6)]
    for start in np.arange(2.0, 14.0, 2.0):
        # The pose of a step stands from its time to the next one's.
        positions, rotations = target.at(np.array([start - 1e-6, start, start + 1.0, start + 2.0 - 1e-6]))
        np.testing.assert_array_equal(positions[1:], np.broadcast_to(positions[1], (3, 3)))
        np.testing.assert_array_equal(rotations[1:], np.broadcast_to(rotations[1], (3, 3, 3)))
        away = np.concatenate([positions[1] - hexapod.home.position, Rotation.from_matrix(rotations[1]).as_rotvec()])
        assert np.abs(away - moved[-1]).max() > 0.01
        moved.append(away)
    sizes = np.abs(np.array(moved[1:]))
    assert sorted(np.argmax(sizes, axis=1)) == [0, 1, 2, 3, 4, 5]
    np.testing.assert_allclose(np.sum(sizes > 1e-9, axis=1), 1)


def test_the_reach_of_a_motion_is_in_proportion_to_the_stroke(hexapod):
    small = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, limits={"stroke": (-0.015, 0.015)}
    )
    for name in ("circle", "sines", "steps"):
        full = load_target(name, hexapod, 5.0).positions - hexapod.home.position
        np.testing.assert_allclose(load_target(name, small, 5.0).positions - hexapod.home.position, full / 4.0, atol=1e-15)


def test_an_unknown_name_is_answered_with_the_known_ones(hexapod, tmp_path):
    for name in ("spiral", str(tmp_path / "missing.csv"), str(tmp_path)):
        with pytest.raises(UnknownNameError) as caught:
            load_target(name, hexapod, 1.0)
        assert isinstance(caught.value, GoughError)
        assert isinstance(caught.value, LookupError)
        for known in MOTIONS:
            assert known in str(caught.value)


@pytest.mark.parametrize("duration", [0.0, -1.0, np.nan, np.inf])
def test_a_duration_must_be_positive_and_finite(hexapod, duration):
    with pytest.raises(InputError, match="duration"):
        load_target("hold", hexapod, duration)


def test_a_motion_wants_home_and_stroke(hexapod, tmp_path):
    bare = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints)
    for name in ("circle", write(tmp_path, HEADER, *ROWS)):
        with pytest.raises(InputError, match="home"):
            load_target(name, bare, 1.0)


# --------------------------------------------------------------------------------------------------------------- CSV files


def test_the_motion_capture_is_accepted_as_displacements_from_home(hexapod, motion_capture):
    target = load_target(motion_capture, hexapod, 60.0)
    table = np.loadtxt(motion_capture, delimiter=",", skiprows=1)
    assert target.name == "motion_capture.csv"
    assert not target.held
    np.testing.assert_allclose(target.times, table[:, 0], atol=1e-12)
    np.testing.assert_allclose(target.positions, hexapod.home.position + table[:, 1:4], atol=1e-15)
    expected = Rotation.from_quat(table[:, [5, 6, 7, 4]]).as_matrix() @ hexapod.home.rotation
    np.testing.assert_allclose(target.rotations, expected, atol=1e-6)
    np.testing.assert_allclose(target.rotations @ target.rotations.transpose(0, 2, 1) - np.eye(3), 0.0, atol=1e-14)
    hexapod.check_lengths(leg_lengths(hexapod, target.positions, target.rotations), target.name)


def test_a_motion_is_cut_to_the_duration_and_a_margin_to_look_ahead(hexapod, motion_capture):
    target = load_target(motion_capture, hexapod, 2.0)
    assert 2.0 + 0.03 < target.times[-1] <= 2.0 + MARGIN_S + 1e-9
    assert len(load_target(motion_capture, hexapod, 1e-6).times) >= 2


@pytest.mark.parametrize("period", [0.01, 0.07, 0.5, 3.0])
@pytest.mark.parametrize("duration", [0.5, 1.0, 1.234])
def test_the_samples_that_are_kept_lead_beyond_the_duration_and_its_margin(hexapod, tmp_path, period, duration):
    """At a steady speed the poses up to there are those of the whole file, however far apart the samples are."""
    times = period * np.arange(round(9.0 / period) + 1)
    rows = [f"{time!r},{0.003 * time!r},0,0,1,0,0,0" for time in times.tolist()]
    target = load_target(write(tmp_path, HEADER, *rows), hexapod, duration)
    needed = np.linspace(0.0, duration + MARGIN_S, 50)
    np.testing.assert_allclose(target.at(needed)[0][:, 0], hexapod.home.position[0] + 0.003 * needed, rtol=0.0, atol=1e-12)
    # And no more of them than that takes.
    assert len(target.times) == 2 or target.times[-2] < duration + MARGIN_S


def test_displacements_turn_about_a_home_that_is_turned_itself(hexapod, tmp_path):
    home = Pose(np.array([0.01, -0.02, 0.36]), rotation_of([0.0, 0.05, 0.1]))
    mechanism = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, home=home, limits={"stroke": (-0.06, 0.06)})
    quarter = "0.7071067811865476,0,0,0.7071067811865476"
    target = load_target(write(tmp_path, HEADER, "3.0,0,0,0,1,0,0,0", f"3.5,0.01,0.02,0.03,{quarter}"), mechanism, 9.0)
    np.testing.assert_allclose(target.times, [0.0, 0.5])
    np.testing.assert_allclose(target.positions, home.position + np.array([[0.0, 0.0, 0.0], [0.01, 0.02, 0.03]]), atol=1e-15)
    np.testing.assert_allclose(target.rotations[1], rotation_of([0.0, 0.0, np.pi / 2]) @ home.rotation, atol=1e-12)


def test_blank_lines_spaces_and_windows_line_ends_are_no_errors(hexapod, tmp_path):
    plain = load_target(write(tmp_path, HEADER, *ROWS), hexapod, 1.0)
    spaced = ["  " + row.replace(",", " , ") for row in ROWS]
    for ending in ("\n", "\r\n"):
        path = write(tmp_path, HEADER.replace(",", ", "), spaced[0], "", spaced[1], "   ", spaced[2], "", ending=ending)
        target = load_target(path, hexapod, 1.0)
        np.testing.assert_array_equal(target.positions, plain.positions)
        np.testing.assert_array_equal(target.times, plain.times)


@pytest.mark.parametrize(
    ("lines", "number", "said"),
    [
        ([], 1, "header"),
        ([HEADER.replace("qw", "w"), *ROWS], 1, "header"),
        ([HEADER.rsplit(",", 1)[0], *ROWS], 1, "header"),
        (ROWS, 1, "header"),
        ([HEADER, ROWS[0], "0.01,0,0,x,1,0,0,0"], 3, "numbers"),
        ([HEADER, ROWS[0], "0.01,0,0,,1,0,0,0"], 3, "numbers"),
        ([HEADER, ROWS[0], "0.01;0;0;0;1;0;0;0"], 3, "numbers"),
        ([HEADER, ROWS[0], "0.01,0,0,0,1,0,0"], 3, "7 numbers"),
        ([HEADER, ROWS[0], "0.01,0,0,0,1,0,0,0,0"], 3, "9 numbers"),
        ([HEADER, *ROWS, "0.03,nan,0,0,1,0,0,0"], 5, "finite"),
        ([HEADER, *ROWS, "inf,0,0,0,1,0,0,0"], 5, "finite"),
        ([HEADER, *ROWS, "0.03,0,0,0,1,-inf,0,0"], 5, "finite"),
        ([HEADER, *ROWS, "0.02,0,0,0,1,0,0,0"], 5, "0.02"),
        ([HEADER, *ROWS, "0.015,0,0,0,1,0,0,0"], 5, "0.015"),
        ([HEADER, ROWS[0], "", ROWS[0]], 4, "after"),
        ([HEADER, ROWS[0], "0.01,0,0,0,1.0011,0,0,0"], 3, "quaternion"),
        ([HEADER, ROWS[0], "0.01,0,0,0,0.9989,0,0,0"], 3, "quaternion"),
        ([HEADER, "0.00,0,0,0,0,0,0,0", *ROWS[1:]], 2, "quaternion"),
    ],
)
def test_a_bad_file_is_refused_with_the_number_of_the_line(hexapod, tmp_path, lines, number, said):
    path = write(tmp_path, *lines)
    with pytest.raises(InputError, match=said) as caught:
        load_target(path, hexapod, 1.0)
    assert f"line {number}:" in str(caught.value)
    assert "motion.csv" in str(caught.value)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_target_leaves_the_plane_to_either_side_and_the_first_sample_that_does_is_named(tmp_path, sign):
    rig = load_in_space("planar-3rpr")

    def rows(*heights):
        return [f"{0.5 * k},0,0,{sign * height!r},1,0,0,0" for k, height in enumerate(heights)]

    load_target(write(tmp_path, HEADER, *rows(0.0, 0.9e-9, 0.0)), rig, 5.0)
    with pytest.raises(InputError, match=r"leaves the plane of 'planar-3rpr' at 1 s by 2 mm and 0 deg"):
        load_target(write(tmp_path, HEADER, *rows(0.0, 0.9e-9, 0.002, 0.005)), rig, 5.0)
    turn = float(np.cos(0.01)), sign * float(np.sin(0.01))
    with pytest.raises(InputError, match=r"at 0.5 s by 0 mm and 1.15 deg"):
        load_target(write(tmp_path, HEADER, *rows(0.0), f"0.5,0,0,0,{turn[0]!r},0,{turn[1]!r},0"), rig, 5.0)


@pytest.mark.parametrize("count", [0, 1])
def test_a_file_of_too_few_samples_is_refused(hexapod, tmp_path, count):
    with pytest.raises(InputError, match=f"{count} samples"):
        load_target(write(tmp_path, HEADER, *ROWS[:count]), hexapod, 1.0)


def test_a_file_that_is_no_text_is_refused(hexapod, tmp_path):
    path = tmp_path / "motion.csv"
    path.write_bytes(b"\xff\xfe\x00\x01" * 20)
    with pytest.raises(InputError, match=r"motion\.csv"):
        load_target(path, hexapod, 1.0)


def test_a_quaternion_off_unit_within_the_tolerance_is_normalised(hexapod, tmp_path):
    quaternion = 1.0009 * unit([1.0, 0.02, -0.01, 0.03])
    row = "0.01,0,0,0," + ",".join(str(value) for value in quaternion)
    target = load_target(write(tmp_path, HEADER, ROWS[0], row), hexapod, 1.0)
    np.testing.assert_allclose(target.rotations[1] @ target.rotations[1].T, np.eye(3), atol=1e-14)
    expected = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
    np.testing.assert_allclose(target.rotations[1], expected, atol=1e-14)


# ------------------------------------------------------------------------------------------------------ between the samples


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.5, 3.0, np.pi - 0.01, np.pi]))
def test_between_samples_the_motion_is_smooth_and_never_swings_beyond_them(seed, start_angle):
    """Turning on through half a turn, where a quaternion with w >= 0 jumps to its negative."""
    random = np.random.default_rng(seed)
    times = np.concatenate([[0.0], np.cumsum(random.uniform(0.005, 0.02, 9))])
    positions = random.normal(scale=0.02, size=(10, 3))
    axis, steps = unit(random.normal(size=3)), random.uniform(-0.02, 0.02, (9, 3))
    turns = [Rotation.from_rotvec(start_angle * axis)]
    for step in steps:
        turns.append(Rotation.from_rotvec(step) * turns[-1])
    rotations = Rotation.concatenate(turns)
    target = Target("test", times, positions, rotations.as_matrix())
    wanted = random.uniform(times[0], times[-1], 40)
    found, turned = target.at(wanted)
    for k, time in enumerate(wanted):
        i = min(int(np.searchsorted(times, time, side="right")) - 1, 8)
        least, greatest = np.minimum(positions[i], positions[i + 1]), np.maximum(positions[i], positions[i + 1])
        assert (least - 1e-15 <= found[k]).all() and (found[k] <= greatest + 1e-15).all()
        apart = angle_between(rotations[i].as_matrix(), rotations[i + 1].as_matrix())
        assert angle_between(turned[k], rotations[i].as_matrix()) <= apart + 1e-6
    at_samples = target.at(times)
    np.testing.assert_allclose(at_samples[0], positions, atol=1e-15)
    np.testing.assert_allclose(at_samples[1], rotations.as_matrix(), atol=1e-13)
    h = 1e-9
    for time in times[1:-1]:
        before, at, after = (target.at(np.array([t]))[0][0] for t in (time - h, time, time + h))
        np.testing.assert_allclose((at - before) / h, (after - at) / h, atol=1e-4)


def test_positions_between_samples_are_those_of_scipys_monotone_cubic():
    random = np.random.default_rng(3)
    times = np.concatenate([[0.0], np.cumsum(random.uniform(0.01, 0.3, 30))])
    positions = random.normal(scale=0.02, size=(31, 3))
    target = Target("test", times, positions, np.tile(np.eye(3), (31, 1, 1)))
    # The ends differ: ours go off along the first and last secant.
    inner = random.uniform(times[1], times[-2], 200)
    np.testing.assert_allclose(target.at(inner)[0], PchipInterpolator(times, positions)(inner), atol=1e-15)


def test_two_samples_are_joined_by_a_line_and_the_shortest_turn():
    times, share = np.array([0.0, 0.4]), 0.3
    rotations = Rotation.from_rotvec([[0.0, 0.0, 3.1], [0.0, 0.0, 3.2]])
    target = Target("test", times, np.array([[0.0, 0.0, 0.35], [0.01, 0.0, 0.35]]), rotations.as_matrix())
    position, rotation = target.at(np.array([share * 0.4]))
    np.testing.assert_allclose(position[0], [share * 0.01, 0.0, 0.35], atol=1e-15)
    assert angle_between(rotation[0], Slerp(times, rotations)(share * 0.4).as_matrix()) < 1e-5


def test_coarse_waypoints_do_not_make_the_reference_swing(hexapod):
    """Rows seconds apart: the reference stays between them, and close to the target."""
    times = np.array([0.0, 2.0, 2.5, 4.5, 5.0, 7.0])
    positions = np.tile(hexapod.home.position, (6, 1))
    positions[2:4, 0] += 0.02
    target = Target("test", times, positions, np.tile(np.eye(3), (6, 1, 1)))
    lengths = sample_reference(plan(hexapod, target, 7.0).segments, 1e-3, 7000)[:, :, 0]
    found, _ = poses_from_lengths(hexapod, lengths, target.start)
    wanted, _ = target.at(np.arange(7000) * 1e-3)
    assert np.linalg.norm(found - wanted, axis=1).max() < 0.5e-3


def test_before_the_first_and_after_the_last_sample_these_stand(hexapod):
    for name in ("circle", "steps"):
        target = load_target(name, hexapod, 4.0)
        positions, rotations = target.at(np.array([-1.0, target.times[-1] + 5.0]))
        np.testing.assert_allclose(positions, target.positions[[0, -1]], atol=1e-15)
        np.testing.assert_allclose(rotations, target.rotations[[0, -1]], atol=1e-13)


def test_asking_for_poses_does_not_change_the_target(hexapod):
    target = load_target("sines", hexapod, 3.0)
    kept = target.rotations.copy()
    first = target.at(np.linspace(0.0, 3.0, 50))
    second = target.at(np.linspace(0.0, 3.0, 50))
    np.testing.assert_array_equal(first[1], second[1])
    np.testing.assert_array_equal(target.rotations, kept)
    assert target.times[1] == SAMPLE_PERIOD_S


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins"])
def test_no_two_rests_near_home_are_alike(name):
    target = load_target("near-rests", load_spatial(name), 8 * REST_S)
    assert len(np.unique(target.positions.round(6), axis=0)) == 9


# --------------------------------------------------------------------------------------------------- files in another reading


@pytest.mark.parametrize(
    ("start", "said"),
    [
        ((0.0, 0.0, "home"), "its positions fit as absolute ones, so give displacements from home"),
        ((0.0, 0.0, "1e3 home"), "its positions fit as absolute ones in mm, so give displacements from home in m"),
        ((2.0, -1.0, 1.0), "its displacements fit in mm, so give them in m"),
        ((0.3, 0.0, 0.0), "choose a smaller motion"),
    ],
)
def test_a_target_outside_the_stroke_says_how_it_may_have_been_meant(hexapod, tmp_path, start, said):
    height = float(hexapod.home.position[2])
    x, y, z = ({"home": height, "1e3 home": 1e3 * height}.get(each, each) for each in start)
    path = write(tmp_path, HEADER, f"0,{x},{y},{z},1,0,0,0", f"1,{x},{y},{z},1,0,0,0")
    with pytest.raises(UnreachableError, match=rf"the target motion.csv needs leg \d at .* mm outside its stroke .*: {said}$"):
        plan(hexapod, load_target(path, hexapod, 1.0), 1.0)
