"""Figures of the geometry alone, against random poses, virtual work and other solvers."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from controller.direct_kinematics import poses_from_lengths
from controller.imu_set import check_imus
from controller.inverse_kinematics import inverse_kinematics, leg_lengths, sample_workspace
from controller.workspace.figures import geometry_figures, holding_forces, reach, reach_rotation, reach_share
from plant.errors import InputError
from plant.mechanism import Mechanism, load_spatial
from plant.mechanism.joint_circles import reshaped
from plant.pose import Pose

BOX = 60_000


def within(mechanism: Mechanism, positions, rotations):
    lengths = leg_lengths(mechanism, positions, rotations)
    return ((lengths >= mechanism.limits.stroke[:, 0]) & (lengths <= mechanism.limits.stroke[:, 1])).all(axis=1)


@pytest.fixture(params=["hexapod", "6-3-II", "genhexkins"], scope="module")
def mechanism(request):
    return load_spatial(request.param)


def first_outside(mechanism, poses, most):
    """How far one goes along a straight line of poses, by small steps and by bisection."""
    steps = np.linspace(0.0, most, 400)
    inside = within(mechanism, *poses(steps))
    if inside.all():
        return most
    k = int(np.argmin(inside))

    def excess(step):
        lengths = leg_lengths(mechanism, *poses(np.array([step])))[0]
        stroke = mechanism.limits.stroke
        return float(np.maximum(stroke[:, 0] - lengths, lengths - stroke[:, 1]).max())

    return brentq(excess, steps[k - 1], steps[k], xtol=1e-12)


@pytest.mark.slow
def test_reach_is_the_volume_that_straight_moves_cover(mechanism):
    """Against moves in random directions, each by steps: the mean of the cubes, with its standard error."""
    random, home = np.random.default_rng(0), mechanism.home
    size = float((mechanism.limits.stroke[:, 1]).max())

    def moves(direction):
        return lambda steps: (home.position + steps[:, None] * direction, np.tile(home.rotation, (len(steps), 1, 1)))

    def turns(axis):
        return lambda steps: (
            np.tile(home.position, (len(steps), 1)),
            Rotation.from_rotvec(steps[:, None] * axis).as_matrix() @ home.rotation,
        )

    for figure, poses, most in ((reach, moves, 2.0 * size), (reach_rotation, turns, np.pi)):
        directions = random.normal(size=(300, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        cubes = 4.0 / 3.0 * np.pi * np.array([first_outside(mechanism, poses(each), most) for each in directions]) ** 3
        assert figure(mechanism) == pytest.approx(cubes.mean(), abs=4.0 * cubes.std() / np.sqrt(len(cubes)))


def test_reach_share_is_that_of_random_poses(mechanism):
    random = np.random.default_rng(1)
    half = 0.5 * float(np.mean(np.ptp(mechanism.limits.stroke, axis=1)))
    positions = mechanism.home.position + random.uniform(-half, half, (BOX, 3))
    rotations = Rotation.from_rotvec(random.uniform(-0.2, 0.2, (BOX, 3))).as_matrix() @ mechanism.home.rotation
    share = float(within(mechanism, positions, rotations).mean())
    assert reach_share(mechanism) == pytest.approx(share, abs=0.01)


def test_longer_strokes_reach_further():
    hexapod = load_spatial("hexapod")
    half = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, home=hexapod.home, limits={"stroke": [-0.03, 0.03]}
    )
    for figure in (reach, reach_rotation):
        # Small strokes reach a body that is nearly similar.
        assert figure(half) == pytest.approx(figure(hexapod) / 8.0, rel=0.1)


def test_a_larger_platform_turns_less():
    hexapod = load_spatial("hexapod")
    base, platform, position = reshaped(hexapod, {"platform_radius": 0.24})
    home = Pose(position, np.eye(3))
    larger = Mechanism.from_legs(base, platform, home=home, limits={"stroke": [-0.06, 0.06]})
    assert reach_rotation(larger) < 0.8 * reach_rotation(hexapod)


def test_the_forces_do_the_work_that_lifts_the_load():
    """Against the poses that direct kinematics finds when one leg gets a little longer."""
    hexapod = load_spatial("hexapod")
    positions, rotations = sample_workspace(hexapod, 5, seed=3)
    forces = holding_forces(hexapod, positions, rotations)
    step = 1e-5

    def energy(lengths, start):
        at, turned = poses_from_lengths(hexapod, lengths[None], start)
        loads = ((3.0, np.zeros(3)), (10.0, np.array([0.0, 0.0, 0.10])))
        return sum(mass * 9.81 * (at[0] + turned[0] @ center)[2] for mass, center in loads)

    for position, rotation, expected in zip(positions, rotations, forces, strict=True):
        pose = Pose(position, rotation)
        lengths = inverse_kinematics(hexapod, pose).lengths
        for leg in range(6):
            change = step * np.eye(6)[leg]
            lifted = energy(lengths + change, pose) - energy(lengths - change, pose)
            assert lifted / (2.0 * step) == pytest.approx(expected[leg], rel=1e-5, abs=1e-3)


def test_at_home_each_leg_of_the_hexapod_bears_a_sixth():
    hexapod = load_spatial("hexapod")
    home = hexapod.home
    forces = holding_forces(hexapod, home.position[None], home.rotation[None])[0]
    upright = hexapod.home_directions[:, 2]
    np.testing.assert_allclose(forces, 13.0 * 9.81 / 6.0 / upright, rtol=1e-9)


def test_the_figures_of_a_mechanism():
    hexapod = load_spatial("hexapod")
    figures = geometry_figures(hexapod)
    assert figures["conditioning_worst"] <= figures["conditioning_home"]
    # The worst of 200 poses that begin like the 50 of the check.
    assert figures["conditioning_worst"] == pytest.approx(check_imus(hexapod, range(7)), rel=0.1)
    positions, rotations = sample_workspace(hexapod, 200, seed=0)
    forces = holding_forces(hexapod, positions, rotations)
    assert figures["force_max"] >= np.abs(forces).max()
    assert geometry_figures(hexapod) == figures
    assert geometry_figures(hexapod, imus=(0, 1, 3, 4))["conditioning_worst"] < figures["conditioning_worst"]


def test_a_load_in_the_worst_direction_is_worse_than_many_others():
    hexapod = load_spatial("hexapod")
    figures, random = geometry_figures(hexapod), np.random.default_rng(0)
    positions, rotations = sample_workspace(hexapod, 200, seed=0)
    positions = np.vstack([hexapod.home.position[None], positions])
    rotations = np.concatenate([hexapod.home.rotation[None], rotations])
    loads = random.normal(size=(2000, 3))
    loads /= np.linalg.norm(loads, axis=1, keepdims=True)
    worst = {"force_per_load": 0.0, "force_per_torque": 0.0}
    for position, rotation in zip(positions, rotations, strict=True):
        jacobian = inverse_kinematics(hexapod, Pose(position, rotation)).jacobian
        for name, wrenches in (
            ("force_per_load", np.hstack([loads, np.zeros_like(loads)])),
            ("force_per_torque", np.hstack([np.zeros_like(loads), loads])),
        ):
            worst[name] = max(worst[name], float(np.abs(np.linalg.solve(jacobian.T, wrenches.T)).max()))
    for name, found in worst.items():
        assert found <= figures[name] <= 1.02 * found


def test_what_lacks_a_home_a_stroke_or_masses_is_refused():
    hexapod = load_spatial("hexapod")
    bare = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints)
    with pytest.raises(InputError, match="no home pose"):
        reach(bare)
    with pytest.raises(InputError, match="lacks the plant's gravity"):
        holding_forces(bare, np.zeros((1, 3)), np.eye(3)[None])
