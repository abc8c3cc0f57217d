"""Targets against all limits: what is refused, when, and why; and the nearest pose that is not."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from controller.direct_kinematics import poses_from_lengths
from controller.inverse_kinematics import leg_lengths
from controller.planning.stream_planner import StreamPlanner, TargetRefusedError
from controller.planning.target import Target, load_target
from controller.pose_limits.limits import BEYOND, KINDS
from controller.safety.causes import Cause
from controller.workspace import (
    GEOMETRY_ALONE,
    LIMITS,
    Demands,
    PoseGuard,
    check_against_limits,
    margins,
    margins_at,
    nearest_reachable,
)
from hil.command_line import main
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import MissingPackageError, UnreachableError
from plant.mechanism.documents import mechanism_from_text
from plant.pose import Pose, quaternion_from_rotation, rotation_from_vector
from tests.controller.planning.test_stream_planner import Follower
from tests.controller.workspace.twin import draw, limited, slow_margins

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def way(mechanism, move, turn=(0.0, 0.0, 0.0), lasts=4.0, samples=81):
    """From home along a move and a turn at once, at a constant pace."""
    shares, home = np.linspace(0.0, 1.0, samples), mechanism.home
    rotations = Rotation.from_rotvec(shares[:, None] * np.array(turn)).as_matrix() @ home.rotation
    return Target("way", lasts * shares, home.position + shares[:, None] * np.array(move), rotations)


@pytest.mark.parametrize("name", ["hexapod", "6-3-II", "planar-3rpr"])
@pytest.mark.parametrize("seed", [pytest.param(0, marks=pytest.mark.slow), 1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_first_violation_is_that_of_a_slow_twin(name, seed):
    """On ways to random poses, looked at each 0.1 ms; the worst is at their end, or inside."""
    mechanism, random = limited(name), np.random.default_rng(seed)
    move, turn = random.normal(size=3) * 0.06, random.normal(size=3) * 0.25
    if mechanism.planar:
        move[2], turn[:2] = 0.0, 0.0
    target = way(mechanism, move, turn)
    times = np.arange(0.0, 4.0, 2e-3)
    values = slow_margins(mechanism, *target.at(times), conditioning=False)
    out = np.flatnonzero((values < 0.0).any(axis=1))
    checked = check_against_limits(mechanism, target, 4.0, Demands(conditioning=False))
    if not len(out):
        assert checked.first is None and checked.reference is not None
        return
    assert checked.first.time == pytest.approx(times[out[0]], abs=7e-3)
    assert values[out[0] : out[0] + 4, LIMITS.index(checked.first.limit)].min() < 0.0
    assert checked.reference is None and not checked.passes
    # Value and bound differ by the margin.
    at = np.searchsorted(times, checked.worst.time)
    off = abs(checked.worst.value - checked.worst.bound)
    assert off == pytest.approx(-values[min(at, len(times) - 1), LIMITS.index(checked.worst.limit)], rel=0.02, abs=1e-4)
    assert checked.first.text in checked.refusal() and "the nearest pose within all limits is" in checked.refusal()
    with pytest.raises(UnreachableError, match="is out of reach"):
        checked.require_reachable()


def cost(mechanism, pose, other):
    spread = np.linalg.norm(mechanism.platform_joints - mechanism.platform_joints.mean(axis=0), axis=1).max()
    turn = Rotation.from_matrix(pose.rotation @ other.rotation.T).as_rotvec()
    return np.linalg.norm(np.append(pose.position - other.position, spread * turn))


@pytest.mark.parametrize("name", ["hexapod", "6-5", "planar-3rpr"])
def test_the_nearest_pose_is_reachable_and_none_near_it_is_nearer(name):
    """Against SLSQP from where it is, and a random search around."""
    mechanism, demands, tried = limited(name), GEOMETRY_ALONE, 0
    positions, rotations = draw(mechanism, 12, seed=3, reach=1.5, tilt=0.8)
    spread = np.linalg.norm(mechanism.platform_joints - mechanism.platform_joints.mean(axis=0), axis=1).max()
    random = np.random.default_rng(0)
    for position, rotation in zip(positions, rotations, strict=True):
        asked = Pose(position, rotation)
        found = nearest_reachable(mechanism, asked, demands)
        assert min(margins_at(mechanism, found.pose, demands).values()) >= 0.0
        if min(margins_at(mechanism, asked, demands).values()) >= 0.0:
            assert found.distance == found.angle == 0.0
            continue
        tried += 1
        turn = Rotation.from_matrix(found.pose.rotation @ rotation.T).as_rotvec()
        place = np.append(found.pose.position - position, spread * turn)
        size = np.linalg.norm(place)
        assert (
            size
            == pytest.approx(cost(mechanism, found.pose, asked))
            == pytest.approx(np.hypot(found.distance, spread * found.angle))
        )
        free = [0, 1, 5] if mechanism.planar else list(range(6))

        def all_margins(places, free=free, position=position, rotation=rotation):
            full = np.zeros((len(places), 6))
            full[:, free] = places
            turned = Rotation.from_rotvec(full[:, 3:] / spread).as_matrix() @ rotation
            values = margins(mechanism, position + full[:, :3], turned, demands).values
            return values[:, np.isfinite(values).all(axis=0)]

        solved = minimize(
            lambda x: x @ x, place[free], jac=lambda x: 2.0 * x, method="SLSQP", options={"maxiter": 30, "ftol": 1e-14},
            constraints={"type": "ineq", "fun": lambda x: all_margins(x[None])[0]},
        )  # fmt: skip
        if solved.success and all_margins(solved.x[None]).min() > -1e-7:
            assert size <= np.sqrt(solved.fun) * 1.001 + 1e-6
        near = place[free] + random.normal(size=(4000, len(free))) * 0.3 * size * random.random((4000, 1)) ** 3
        near = near[np.linalg.norm(near, axis=1) < 0.995 * size]
        assert not (all_margins(near) >= 0.0).all(axis=1).any()
    assert tried >= 6


@pytest.mark.slow
def test_a_pose_a_metre_away_has_a_nearest_one(hexapod):
    asked = Pose(hexapod.home.position + [1.0, 0.0, 0.0], hexapod.home.rotation)
    found = nearest_reachable(hexapod, asked)
    assert min(margins_at(hexapod, found.pose).values()) >= 0.0
    straight = hexapod.home.position + [0.1189, 0.0, 0.0]
    assert cost(hexapod, found.pose, asked) < np.linalg.norm(straight - asked.position)


def test_a_target_within_all_limits_is_planned_and_its_peaks_are_told(hexapod):
    target = load_target("circle", hexapod, 5.0)
    checked = check_against_limits(hexapod, target, 5.0)
    assert checked.passes and checked.refusal() == checked.remark == "" and checked.require_reachable().violations == 0
    summary = checked.summary()
    assert summary["passes"] and summary["first"] is None and 0.1 < summary["time_scale"] < 0.4
    closest = {each["kind"]: each for each in summary["closest"]}
    # Those that the mechanism has, each at the time at which it is closest.
    assert closest.keys() == {"stroke", "force", "Jacobian", "direct kinematics"}
    times = np.arange(0.0, 5.0, 0.005)
    lengths, stroke = leg_lengths(hexapod, *target.at(times)), hexapod.limits.stroke
    room = np.minimum(lengths - stroke[:, 0], stroke[:, 1] - lengths).min()
    assert abs(closest["stroke"]["value"] - closest["stroke"]["bound"]) == pytest.approx(room, abs=1e-4)


def test_poses_that_are_held_have_the_peaks_of_their_reference(hexapod):
    checked = check_against_limits(hexapod, load_target("steps", hexapod, 4.0), 4.0)
    assert checked.passes
    assert [peak.name.partition(" ")[0] for peak in checked.peaks] == ["velocity", "acceleration", "jerk"]
    assert checked.peaks[2].share == pytest.approx(1.0) and all(0.3 < peak.share <= 1.0 for peak in checked.peaks[:2])


def test_too_fast_a_target_is_told_with_a_time_scale_that_passes(hexapod):
    target = way(hexapod, [0.0, 0.0, 0.05], lasts=0.1)
    checked = check_against_limits(hexapod, target, 0.1)
    scale = checked.time_scale()
    assert checked.first is None and not checked.passes and checked.fast.share > 1.5
    assert f"it passes with --time-scale {scale:.4f}" in checked.remark
    slower = target.slower(scale)
    assert check_against_limits(hexapod, slower, float(slower.times[-1])).passes


def test_where_no_imus_are_needed_direct_kinematics_does_not_count(hexapod):
    target = load_target("hold", hexapod, 0.1)
    kinds = [
        {each.limit.kind for each in check_against_limits(hexapod, target, 0.1, Demands(imus=imus)).closest}
        for imus in ((0, 1, 2, 3, 4, 5, 6), None)
    ]
    assert kinds[0] - kinds[1] == {"direct kinematics"} and not kinds[1] - kinds[0]


def test_a_run_is_refused_before_it_moves_and_the_command_tells_the_same(tmp_path, capsys):
    path, csv = tmp_path / "stiff.toml", tmp_path / "far.csv"
    path.write_text('based_on = "hexapod"\n[joints]\nbase_swing = 0.12\n')
    csv.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0.02,0,1,0,0,0\n2,0,0.08,0,1,0,0,0\n")
    with pytest.raises(
        UnreachableError, match=r"out of reach: base swing of leg \d would be 6\.\d+ deg at 1\.\d+ s, .* at most 6\.8"
    ) as refused:
        simulate(SimulationConfig(mechanism=str(path), target=str(csv), duration=2.0))
    assert main(["motion", str(csv), "--mechanism", str(path), "--duration", "2"]) == 1
    assert str(refused.value) in capsys.readouterr().out
    # Within the joints' cones it goes.
    assert main(["motion", str(csv), "--mechanism", str(path), "--duration", "1"]) == 0


def test_without_scipy_a_refusal_names_its_limit_and_no_nearest_pose(monkeypatch, hexapod):
    """A base installation lacks it, and a first user's target is often out of reach."""
    monkeypatch.setattr("plant.extras.find_spec", lambda package: None)
    config = SimulationConfig(target=lambda t: [0.0, 0.0, 0.2, 0.0, 0.0, 0.0], duration=0.1)
    with pytest.raises(UnreachableError, match="stroke of leg") as refused:
        simulate(config)
    assert "nearest" not in str(refused.value) and "scipy" not in str(refused.value)
    with pytest.raises(MissingPackageError, match=r"needs scipy.*gough\[calibrate\]"):
        nearest_reachable(hexapod, hexapod.home)


def test_every_kind_of_limit_has_its_cause():
    assert list(BEYOND) == list(KINDS)
    for cause in BEYOND.values():
        assert cause.reaction.text == "controlled stop"


@pytest.mark.parametrize(
    ("pose", "cause"),
    [
        (([0.0, 0.0, 0.0], [0.0, 0.0, 0.5]), Cause.PLATFORM_SWING),
        (([0.117, 0.0, 0.0], [0.0, 0.0, 0.0]), Cause.BASE_SWING),
        (([0.0, 0.0, 0.9], [0.0, 0.0, 0.0]), Cause.BEYOND_STROKE),
    ],
)
def test_a_streamed_pose_beyond_a_limit_is_refused_with_its_cause(pose, cause):
    swings = {Cause.PLATFORM_SWING: "platform_swing = 0.35", Cause.BASE_SWING: "base_swing = 0.2"}
    mechanism = mechanism_from_text(f'based_on = "hexapod"\n[joints]\n{swings.get(cause, "")}\n', "test")
    home, guard = mechanism.home, PoseGuard(mechanism, GEOMETRY_ALONE)
    planner = StreamPlanner(mechanism, leg_lengths(mechanism, home.position, home.rotation), None, guard)
    turned = rotation_from_vector(pose[1])
    with pytest.raises(TargetRefusedError) as refusal:
        planner.add(0.0, pose[0], quaternion_from_rotation(turned))
    assert refusal.value.cause == cause
    at = home.position + pose[0], turned @ home.rotation
    if cause != Cause.BEYOND_STROKE:
        found = guard(*(part[None] for part in at))
        kind = "platform swing" if cause == Cause.PLATFORM_SWING else "base swing"
        worst = margins(mechanism, *(part[None] for part in at), GEOMETRY_ALONE).of(kind).min()
        assert found[3] - found[2] == pytest.approx(worst) and refusal.value.value == pytest.approx(found[2])


@pytest.mark.parametrize("seed", [1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 9))])
def test_no_plan_for_a_stream_leaves_a_limit_of_the_pose(seed):
    """With dropouts and jitter, towards limits and beyond: what is followed stays within all of them, to its end at rest."""
    mechanism, random = limited("hexapod"), np.random.default_rng(seed)
    demands = Demands(conditioning=False)
    guard = PoseGuard(mechanism, demands)
    lengths = leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation)
    follower = Follower(mechanism, lengths)
    follower.planner = StreamPlanner(mechanism, lengths, None, guard)
    sizes, rates = random.uniform(0.02, 0.06, 3), random.uniform(0.5, 2.0, 3)
    accepted = []
    for k in range(120):
        if random.random() < 0.2:
            continue
        at = 0.01 * k + random.uniform(0.0, 0.004)
        move = sizes * np.sin(2.0 * np.pi * rates * at) * min(1.0, at)
        turn = np.array([0.0, 0.0, 0.5 * np.sin(7.0 * at)]) * min(1.0, at)
        refused = follower.refused
        follower.add(at, move, quaternion_from_rotation(rotation_from_vector(turn)))
        if follower.refused == refused:
            accepted.append(at)
        follower.run(round(at * 1000), points=1)
        if accepted and follower.planner.current.begin <= (follower.cycle + 10) * 1e-3:
            follower.plan(follower.cycle + 10, follower.cycle * 1e-3 + 0.01 - accepted[-1])
    follower.run(follower.cycle + 500, points=1)
    assert follower.taken > 20
    positions, rotations = poses_from_lengths(mechanism, np.array(follower.pieces)[:, :, 0], mechanism.home)
    values = margins(mechanism, positions, rotations, demands).values
    # Between the moments that the guard sees, 10 ms apart, a limit can be passed by the curvature of the way.
    scaled = values.min(axis=0)
    assert scaled.min() > -2e-4
    assert np.linalg.norm(np.array(follower.pieces)[-1, :, 1]) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_a_check_after_its_machine_code_was_loaded_compiles_none_of_it_for_other_types(name):
    """In a process of its own: kernels that other tests have called know other types, too."""
    code = f"""
import pickle
from controller.direct_kinematics import lengths
from controller.planning import offline_planner, segments
from controller.planning.target import load_target
from controller.pose_limits.margins import first_that_is_none, margin_rows
from controller.workspace import check_against_limits, load_check
from plant.mechanism import load_in_space

kernels = (
    margin_rows, first_that_is_none, lengths._find_poses, segments.lengths_along,
    offline_planner._stops_inside, offline_planner._collect_segments, offline_planner._count_violations,
)
mechanism = load_in_space({name!r})
load_check(mechanism)
loaded = [[*kernel.overloads] for kernel in kernels]
assert all(len(types) == 1 for types in loaded)
for each in (mechanism, pickle.loads(pickle.dumps(mechanism))):
    assert check_against_limits(each, load_target("circle", each, 0.2), 0.2).passes
assert [[*kernel.overloads] for kernel in kernels] == loaded
"""
    subprocess.run([sys.executable, "-c", code], check=True)
