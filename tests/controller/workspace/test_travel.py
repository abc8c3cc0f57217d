"""Travel, against fine steps of a slow twin, there and back, and where a limit is exceeded for a short way only."""

import numpy as np
import pytest

from controller.imu_set import conditionings
from controller.workspace import GEOMETRY_ALONE, LIMITS, Demands, margins, pose_along, travel, travels
from plant.errors import InputError, UnreachableError
from plant.mechanism import Mechanism, load_in_space, load_spatial
from plant.mechanism.documents import mechanism_from_text
from plant.pose import Pose
from tests.controller.workspace.twin import LIMITED, draw, limited, slow_margins

TWIST = np.array([0.03, -0.02, 0.02, 0.1, -0.1, 0.1])
FORCES = np.array([30.0, 20.0, -40.0, 2.0, 1.0, -1.0])


def along(pose, direction, ways, pivot=None):
    poses = [pose_along(pose, way * direction, pivot) for way in ways]
    return np.array([each.position for each in poses]), np.array([each.rotation for each in poses])


def directions_of(mechanism: Mechanism, count: int, seed: int):
    """Each axis, and random ones in which all axes count about the same."""
    random = np.random.default_rng(seed)
    mixed = random.standard_normal((count, 6)) * np.repeat([0.1, 0.4], 3)
    chosen = np.vstack([np.eye(6), -np.eye(6), mixed])
    if mechanism.planar:
        chosen[:, 2:5] = 0.0
        chosen = chosen[np.linalg.norm(chosen, axis=1) > 0.0]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


def check_travel(name: str, count: int, steps: int, starts: int) -> set[str]:
    """Every pose up to the end is within all limits, and what lies 1e-6 beyond is not."""
    mechanism = limited(name)
    part = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0]) * 0.1 if mechanism.planar else np.ones(6)
    demands = Demands(twist=part * TWIST, load=part * FORCES)
    rows = [row for row in range(400) if row == 0 or _kept(mechanism, demands, row)][:starts]
    ended = set()
    for row in rows:
        pose = _start(mechanism, row)
        for direction in directions_of(mechanism, count, row):
            pivot = pose.position + 0.1 * np.array([1.0, -1.0, 0.0]) if row else None
            (way,), (end,) = travels(mechanism, pose, direction[None], demands, pivot=pivot)
            shares = np.unique(np.concatenate([np.linspace(0.0, 1.0, steps), 1.0 - np.geomspace(1e-6, 1e-2, 20)]))
            inside = slow_margins(mechanism, *along(pose, direction, way * shares, pivot), demands.twist, demands.load)
            assert inside[shares <= 1.0 - 1e-6].min() > -1e-7
            beyond = slow_margins(mechanism, *along(pose, direction, [way + 1e-6], pivot), demands.twist, demands.load)[0]
            assert beyond.min() < 0.0, (direction, way, LIMITS[end].text)
            assert beyond[end] < 1e-9
            ended.add(LIMITS[end].kind)
    return ended


def _start(mechanism: Mechanism, row: int) -> Pose:
    if row == 0:
        return mechanism.home
    positions, rotations = draw(mechanism, 400, seed=5)
    return Pose(positions[row], rotations[row])


def _kept(mechanism: Mechanism, demands: Demands, row: int) -> bool:
    pose = _start(mechanism, row)
    return bool(margins(mechanism, pose.position[None], pose.rotation[None], demands, workers=1).values.min() > 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "planar-3rpr",
        pytest.param("hexapod", marks=pytest.mark.slow),
        *(pytest.param(name, marks=pytest.mark.endurance) for name in LIMITED if name not in ("planar-3rpr", "hexapod")),
    ],
)
def test_travel_ends_where_fine_steps_do(name):
    assert len(check_travel(name, 4, 100, starts=2)) >= 2


@pytest.mark.endurance
@pytest.mark.parametrize("name", LIMITED)
def test_so_does_travel_in_many_directions(name):
    assert len(check_travel(name, 20, 400, starts=3)) >= 2


def test_the_hexapod_goes_as_far_as_its_design_says():
    """Section 10 of the design: x +-117, y +-108, z -69/+66 mm, tilt 19.6 deg, yaw 31 deg."""
    hexapod = load_spatial("hexapod")
    ways = {}
    for axis in range(6):
        for sign in (1.0, -1.0):
            ways[axis, sign] = travel(hexapod, hexapod.home, sign * np.eye(6)[axis])
    assert 1e3 * ways[0, -1.0].distance == pytest.approx(117.0, abs=0.5)
    assert 1e3 * ways[1, 1.0].distance == pytest.approx(108.0, abs=0.5)
    assert 1e3 * ways[2, 1.0].distance == pytest.approx(66.0, abs=0.5)
    assert 1e3 * ways[2, -1.0].distance == pytest.approx(69.0, abs=0.5)
    assert np.degrees(ways[3, 1.0].angle) == pytest.approx(19.6, abs=0.05)
    assert np.degrees(ways[5, 1.0].angle) == pytest.approx(31.0, abs=0.5)
    assert all(each.limit.kind == "stroke" for each in ways.values())


def test_straight_up_by_the_cosine_rule():
    hexapod = load_spatial("hexapod")
    found = travel(hexapod, hexapod.home, [0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    length = hexapod.limits.stroke[0, 1]
    legs = hexapod.home.position + hexapod.platform_joints - hexapod.base_joints
    level = np.hypot(legs[:, 0], legs[:, 1])
    expected = (np.sqrt(length**2 - level**2) - legs[:, 2]).min()
    assert found.distance == pytest.approx(expected, abs=1e-9)
    assert found.way == pytest.approx(0.5 * expected, abs=1e-9)
    assert found.pose.position[2] == pytest.approx(0.35 + expected, abs=1e-9)


def test_there_and_back():
    """From the end of one way, the way back goes through the start and ends where that from the start does."""
    mechanism = limited("hexapod")
    random = np.random.default_rng(3)
    for _ in range(10):
        direction = random.standard_normal(6) * np.repeat([0.1, 0.4], 3)
        forth, back = (travel(mechanism, mechanism.home, sign * direction, GEOMETRY_ALONE) for sign in (1.0, -1.0))
        middle = pose_along(mechanism.home, 0.5 * forth.way * direction)
        again = travel(mechanism, middle, -direction, GEOMETRY_ALONE)
        assert again.way == pytest.approx(0.5 * forth.way + back.way, abs=1e-8)
        np.testing.assert_allclose(again.pose.position, back.pose.position, atol=1e-8)
        np.testing.assert_allclose(again.pose.rotation, back.pose.rotation, atol=1e-8)


@pytest.mark.parametrize("excess", [1e-4, 1e-7, 1e-9])
def test_a_limit_that_is_exceeded_for_a_short_way_ends_the_travel(excess):
    """A straight way passes a base joint; the leg is too short only about the middle, on 6 mm to 30 um."""
    hexapod = load_spatial("hexapod")
    leg, start = 2, Pose(hexapod.home.position - [0.05, 0.0, 0.0], hexapod.home.rotation)
    vector = start.position + hexapod.platform_joints[leg] - hexapod.base_joints[leg]
    nearest, closest = -vector[0], np.hypot(vector[1], vector[2])
    stroke = np.array(hexapod.limits.stroke) + [-0.2, 0.4]
    stroke[leg, 0] = closest + excess
    home = Pose(hexapod.home.position, hexapod.home.rotation)
    if not stroke[leg, 0] < np.linalg.norm(home.position + hexapod.platform_joints[leg] - hexapod.base_joints[leg]):
        pytest.skip("home itself")
    mechanism = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=home, limits={"stroke": stroke, "velocity": 0.25}
    )
    x = np.sign(nearest)
    found = travel(mechanism, start, [x, 0.0, 0.0, 0.0, 0.0, 0.0], GEOMETRY_ALONE)
    half = np.sqrt((closest + excess) ** 2 - closest**2)
    assert found.way == pytest.approx(abs(nearest) - half, abs=1e-8)
    assert (found.limit.kind, found.limit.legs) == ("stroke", (leg,))


def test_what_turns_freely_ends_after_a_full_turn():
    """A planar platform on long legs that meet at its middle."""
    hexapod = load_spatial("hexapod")
    wide = Mechanism.from_legs(
        hexapod.base_joints, 0.2 * hexapod.platform_joints, home=hexapod.home, limits={"stroke": [-0.3, 0.3]}
    )
    found = travel(wide, wide.home, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], GEOMETRY_ALONE)
    assert found.limit is None and found.angle == pytest.approx(2.0 * np.pi)
    ends_at_singularity = travel(wide, wide.home, [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], Demands(forces=False))
    assert ends_at_singularity.limit.kind == "Jacobian" and ends_at_singularity.angle < np.pi


def test_direct_kinematics_may_end_a_way():
    """With a limit that is little below its conditioning at home."""
    strict = mechanism_from_text('based_on = "hexapod"\n[safety]\nconditioning = 0.44\n', "strict")
    for direction in np.vstack([np.eye(6), -np.eye(6)])[[2, 3, 8, 9]]:
        end, far = (travel(mechanism, strict.home, direction) for mechanism in (strict, load_spatial("hexapod")))
        least = conditionings(strict, *along(strict.home, direction, np.linspace(0.0, far.way, 200))).min()
        assert (end.limit.kind == "direct kinematics") == (least < 0.44)
        if end.limit.kind == "direct kinematics":
            poses = along(strict.home, direction, [end.way - 1e-6, end.way + 1e-6])
            before, after = conditionings(strict, *poses)
            assert after < 0.44 <= before
    assert travel(strict, strict.home, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]).limit.kind == "direct kinematics"


def test_a_screw_follows_its_axis():
    hexapod = load_spatial("hexapod")
    axis_point, pitch = np.array([0.05, 0.0, 0.0]), 0.02
    move = np.array([0.0, 0.0, pitch, 0.0, 0.0, 1.0])
    pose = pose_along(hexapod.home, 0.3 * move, axis_point)
    arm = hexapod.home.position - axis_point
    expected = [0.05 + np.cos(0.3) * arm[0], np.sin(0.3) * arm[0], 0.35 + 0.3 * pitch]
    np.testing.assert_allclose(pose.position, expected, atol=1e-12)
    found = travel(hexapod, hexapod.home, move, pivot=axis_point)
    assert found.distance == pytest.approx(pitch * found.angle)
    np.testing.assert_allclose(found.pose.position, pose_along(hexapod.home, found.way * move, axis_point).position, atol=1e-12)


def test_what_cannot_be_travelled_is_refused():
    hexapod, planar = load_spatial("hexapod"), load_in_space("planar-3rpr")
    with pytest.raises(InputError, match="the direction has no length"):
        travel(hexapod, hexapod.home, np.zeros(6))
    with pytest.raises(InputError, match="leaves the plane of 'planar-3rpr'"):
        travel(planar, planar.home, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    outside = Pose(hexapod.home.position + [0.0, 0.0, 0.1], hexapod.home.rotation)
    with pytest.raises(UnreachableError, match=r"stroke of leg . is exceeded by 0\.03"):
        travel(hexapod, outside, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    with pytest.raises(UnreachableError, match="its IMUs do not determine it"):
        travel(hexapod, hexapod.home, [0.0, 0.0, 1.0, 0.0, 0.0, 0.0], Demands(imus=(0, 6)))
