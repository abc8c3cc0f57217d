"""Margins of poses, against a slow twin in NumPy, the solver of direct kinematics, and by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.direct_kinematics import solve_batch
from controller.settings import safety_settings
from controller.workspace import GEOMETRY_ALONE, KINDS, LIMITS, Demands, margins, margins_at
from plant.errors import InputError
from plant.mechanism import Mechanism, load_in_space, load_spatial
from plant.mechanism.documents import mechanism_from_text
from plant.pose import Pose
from tests.controller.workspace.twin import LIMITED, draw, limited, slow_margins

TWIST, LOAD = np.array([0.06, -0.04, 0.05, 0.2, -0.3, 0.1]), np.array([40.0, -30.0, 60.0, 3.0, -2.0, 4.0])
PLANE = np.array([1.0, 1.0, 0.0, 0.0, 0.0, 1.0])
TOLERANCES = {"force": 1e-4, "base swing": 1e-7, "platform swing": 1e-7}
"""The twin differentiates the energy, and the kernels take angles by their cosine; all else agrees to 1e-9."""


def asked(mechanism: Mechanism) -> Demands:
    part = PLANE * 0.1 if mechanism.planar else np.ones(6)
    return Demands(twist=TWIST * part, load=LOAD * part)


def agree(name: str, count: int) -> None:
    mechanism = limited(name)
    positions, rotations = draw(mechanism, count)
    demands = asked(mechanism)
    found = margins(mechanism, positions, rotations, demands)
    slow = slow_margins(mechanism, positions, rotations, demands.twist, demands.load)
    for kind in KINDS[:-1]:
        columns = [limit.kind == kind for limit in LIMITS]
        ours, theirs = found.values[:, columns], slow[:, columns]
        np.testing.assert_array_equal(np.isinf(ours), np.isinf(theirs))
        there = np.isfinite(theirs)
        scale = np.maximum(1.0, np.abs(theirs[there])) if kind == "force" else 1.0
        assert (np.abs(ours[there] - theirs[there]) / scale).max(initial=0.0) < TOLERANCES.get(kind, 1e-9)
    slow[:, -1] = found.values[:, -1]
    doubtful = (np.abs(slow) < 1e-4).any(axis=1)
    truth = (slow >= 0.0).all(axis=1)
    np.testing.assert_array_equal(found.reachable[~doubtful], truth[~doubtful])
    assert not (found.reachable & (slow < -1e-4).any(axis=1)).any(), "a false reachable"
    assert doubtful.mean() < 0.2 and 0.02 < truth.mean() < 0.98


@pytest.mark.parametrize("name", ["hexapod", "6-3-I", "planar-3rpr"])
def test_margins_agree_with_the_twin(name):
    agree(name, 400)


@pytest.mark.slow
@pytest.mark.parametrize("name", LIMITED)
def test_margins_agree_with_the_twin_at_10_000_poses(name):
    agree(name, 10_000)


@pytest.mark.parametrize("name", ["hexapod", "6-4-I"])
def test_the_conditioning_of_direct_kinematics_is_the_solvers(name):
    mechanism = load_spatial(name)
    positions, rotations = draw(mechanism, 50, tilt=0.2)
    legs = positions[:, None] + np.einsum("nij,kj->nki", rotations, mechanism.platform_joints) - mechanism.base_joints
    directions = legs / np.linalg.norm(legs, axis=2, keepdims=True)
    up = mechanism.up_in_base @ rotations
    solved = solve_batch(mechanism, directions, up_in_platform=up, method="up", refine=False).conditionings
    least = safety_settings(mechanism).conditioning
    found = margins(mechanism, positions, rotations).of("direct kinematics")[:, 0]
    np.testing.assert_allclose(found + least, solved, rtol=1e-9)


def test_fewer_imus_leave_less_conditioning():
    mechanism = load_spatial("hexapod")
    positions, rotations = draw(mechanism, 20)
    all_of_them, few = (
        margins(mechanism, positions, rotations, Demands(imus=imus)).of("direct kinematics")
        for imus in (range(7), (0, 1, 2, 6))
    )
    assert (few < all_of_them).all()
    none = margins(mechanism, positions, rotations, Demands(imus=(0, 6))).of("direct kinematics")
    assert (none < 0.0).all()


def test_the_other_side_of_a_singularity_is_not_reachable():
    """Mirrored below the base, the legs have the lengths that they have above it."""
    mechanism = load_spatial("6-3-I")
    below = Pose(mechanism.home.position * [1.0, 1.0, -1.0], mechanism.home.rotation)
    found = margins_at(mechanism, below, Demands(forces=False))
    by_kind = {limit.kind: margin for limit, margin in found.items()}
    assert by_kind["stroke"] > 0.0 > by_kind["Jacobian"]


def test_home_of_the_hexapod_by_hand():
    text = 'based_on = "hexapod"\n[joints]\nbase_swing = 0.5\n[bodies]\nleg_diameter = 0.03\nclearance = 0.002\n'
    text += "[bodies.base_plate]\ncenter = [0.0, 0.0, -0.05]\nradius = 0.35\nthickness = 0.01\n"
    mechanism = mechanism_from_text(text, "own")
    load = np.array([0.0, 0.0, -60.0, 0.0, 0.0, 0.0])
    found = margins_at(mechanism, mechanism.home, Demands(twist=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0], load=load))
    by_name = {limit.text: margin for limit, margin in found.items()}
    upright = mechanism.home_directions[0, 2]
    assert by_name["stroke of leg 0"] == pytest.approx(0.06, abs=1e-12)
    assert by_name["base swing of leg 3"] == pytest.approx(0.5, abs=1e-7)
    assert by_name["speed of leg 2"] == pytest.approx(0.25 - 0.1 * upright, abs=1e-12)
    assert by_name["leg 4 at the base plate"] == pytest.approx(0.05 - 0.015 - 0.005 - 0.002, abs=1e-12)
    # Each leg bears a sixth of the load, whatever the weights are.
    with_load, without = (
        {limit.text: margin for limit, margin in margins_at(mechanism, mechanism.home, Demands(load=each)).items()}
        for each in (load, np.zeros(6))
    )
    assert without["force of leg 5"] - with_load["force of leg 5"] == pytest.approx(10.0 / upright, rel=1e-9)
    assert "platform swing of leg 0" not in by_name and "leg 0 at the platform plate" not in by_name


def test_what_binds_is_the_least_share():
    mechanism = limited("hexapod")
    positions, rotations = draw(mechanism, 300)
    found = margins(mechanism, positions, rotations, GEOMETRY_ALONE)
    outside = ~found.reachable
    chosen = found.values[np.arange(300), found.binding]
    assert (chosen[outside] < 0.0).all() and (chosen[~outside] >= 0.0).all()
    assert {LIMITS[number].kind for number in found.binding} >= {"stroke", "platform swing"}


def test_rows_are_the_same_on_any_number_of_threads():
    mechanism = limited("hexapod")
    positions, rotations = draw(mechanism, 3000)
    one, two = (margins(mechanism, positions, rotations, workers=workers).values for workers in (1, 2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize(
    ("positions", "rotations", "said"),
    [
        (np.zeros(3), np.eye(3), r"positions have shape \(3,\)"),
        (np.zeros((2, 3)), np.eye(3)[None], "rotations"),
        ([[0.0, 0.0, np.nan]], np.eye(3)[None], "pose 0 has the position"),
        (np.zeros((1, 3)), 2.0 * np.eye(3)[None], "rotation matrices"),
        (np.zeros((1, 3)), -np.eye(3)[None], "rotation matrices"),
    ],
)
def test_poses_that_are_none_are_refused(positions, rotations, said):
    with pytest.raises(InputError, match=said):
        margins(load_spatial("hexapod"), positions, rotations)


def test_what_cannot_be_asked_is_refused():
    planar, hexapod = load_in_space("planar-3rpr"), load_spatial("hexapod")
    tilted = Rotation.from_rotvec([0.1, 0.0, 0.0]).as_matrix()
    with pytest.raises(InputError, match="leaves the plane"):
        margins(planar, planar.home.position[None], tilted[None])
    with pytest.raises(InputError, match=r"twist must have shape \(6,\)"):
        Demands(twist=[1.0, 2.0])
    with pytest.raises(InputError, match="no home pose"):
        margins(Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints), np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(InputError, match="there is no kind of limit 'hope'; there are stroke"):
        margins(hexapod, hexapod.home.position[None], hexapod.home.rotation[None]).of("hope")
    text = 'based_on = "hexapod"\n[bodies]\nleg_diameter = 0.03\nleg_ends = [0.2, 0.2]\n'
    long_ends = mechanism_from_text(text, "own")
    with pytest.raises(InputError, match="leave nothing of a leg"):
        margins(long_ends, long_ends.home.position[None], long_ends.home.rotation[None])
