"""The presets: each is of the type that its name says, and well conditioned wherever its strokes let it go."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import SPATIAL
from plant.mechanism import Mechanism, load_mechanism
from plant.pose import Array

DEGREES = {
    "hexapod": [1, 1, 1, 1, 1, 1],
    "6-3-I": [2, 2, 2],
    "6-3-II": [3, 2, 1],
    "6-4-I": [2, 2, 1, 1],
    "6-4-II": [3, 1, 1, 1],
    "6-5": [2, 1, 1, 1, 1],
    "genhexkins": [1, 1, 1, 1, 1, 1],
}
"""How many legs end in each platform joint."""

CONDITIONING = {
    "hexapod": (0.22, 0.36, 0.25),
    "6-3-I": (0.33, 0.44, 0.32),
    "6-3-II": (0.21, 0.45, 0.40),
    "6-4-I": (0.24, 0.48, 0.31),
    "6-4-II": (0.14, 0.30, 0.16),
    "6-5": (0.26, 0.48, 0.30),
    "genhexkins": (0.30, 0.54, 0.42),
}
"""Least reciprocal condition over the workspace: of the Jacobian, and of the linear equations for the pose from leg directions
with the vertical and from leg directions alone."""


def joint_degrees(joints: Array) -> list[int]:
    return sorted(np.unique(joints, axis=0, return_counts=True)[1].tolist(), reverse=True)


def legs_at(mechanism: Mechanism, positions: Array, rotations: Array) -> tuple[Array, Array]:
    """Arms and legs, both (..., 6, 3) in {1}."""
    arms = np.einsum("...ij,kj->...ki", rotations, mechanism.platform_joints)
    return arms, positions[..., None, :] + arms - mechanism.base_joints


def workspace(mechanism: Mechanism) -> tuple[Array, Array]:
    """The arms and legs of some hundred poses with every leg inside its stroke, from a box that hardly cuts them."""
    random, count = np.random.default_rng(0), 40_000
    home, stroke = mechanism.require_home(), mechanism.require_limits().stroke
    reach = 0.8 * np.ptp(stroke[0])
    rotations = Rotation.from_rotvec(random.uniform(-0.35, 0.35, (count, 3))).as_matrix() @ home.rotation
    arms, legs = legs_at(mechanism, home.position + random.uniform(-reach, reach, (count, 3)), rotations)
    lengths = np.linalg.norm(legs, axis=-1)
    inside = ((lengths > stroke[:, 0]) & (lengths < stroke[:, 1])).all(axis=1)
    return arms[inside], legs[inside]


def reciprocal_condition(matrices: Array, rank: int) -> float:
    values = np.linalg.svd(matrices, compute_uv=False)
    return float((values[:, rank - 1] / values[:, 0]).min())


@pytest.mark.parametrize("name", DEGREES)
def test_every_preset_loads_whole(name: str) -> None:
    mechanism = load_mechanism(name)
    assert mechanism.name == name
    assert list(mechanism.plant_parameters()) == [variable.name for variable in SPATIAL.parameters]
    assert mechanism.settings["control"]


@pytest.mark.parametrize(("name", "degrees"), DEGREES.items())
def test_as_many_legs_end_in_each_platform_joint_as_the_type_says(name: str, degrees: list[int]) -> None:
    mechanism = load_mechanism(name)
    assert joint_degrees(mechanism.platform_joints) == degrees
    assert joint_degrees(mechanism.base_joints) == ([2, 2, 2] if name == "genhexkins" else [1] * 6)
    assert (mechanism.platform_joints[:, 2] == 0.0).all()


@pytest.mark.parametrize("name", ["6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5"])
def test_joints_lie_on_the_hexapods_circles(name: str, hexapod: Mechanism) -> None:
    mechanism = load_mechanism(name)
    np.testing.assert_allclose(np.linalg.norm(mechanism.base_joints, axis=1), 0.30, atol=1e-14)
    radii = np.linalg.norm(mechanism.platform_joints, axis=1)
    np.testing.assert_allclose(radii, [0.0, 0.2, 0.0, 0.2, 0.0, 0.2] if name == "6-4-II" else 0.2, atol=1e-14)
    np.testing.assert_array_equal(mechanism.plant["payload.inertia"], hexapod.plant["payload.inertia"])


@pytest.mark.parametrize(("name", "bounds"), CONDITIONING.items())
def test_presets_are_well_conditioned_all_over_their_workspace(name: str, bounds: tuple[float, float, float]) -> None:
    mechanism = load_mechanism(name)
    arms, legs = workspace(mechanism)
    assert len(arms) > 500
    directions = legs / np.linalg.norm(legs, axis=-1, keepdims=True)
    radius = np.linalg.norm(mechanism.platform_joints, axis=1).max()
    jacobian = np.concatenate([directions, np.cross(arms, directions) / radius], axis=-1)
    signs = np.sign(np.linalg.det(jacobian))
    assert (signs == signs[0]).all(), "a singularity divides the workspace"

    across = np.cross(directions[..., None, :], np.eye(3)).swapaxes(-1, -2)
    planar = mechanism.platform_joints - mechanism.platform_joints.mean(axis=0)
    spread = np.sqrt(np.mean(np.sum(planar**2, axis=1)))
    turned = np.stack([arms * [1, 1, 0], np.cross([0, 0, 1], arms)], axis=-1) / spread
    with_vertical = np.concatenate([across, across @ turned], axis=-1)
    alone = np.concatenate([across, *(across * (planar[:, i] / spread)[:, None, None] for i in (0, 1))], axis=-1)
    found = (
        reciprocal_condition(jacobian, 6),
        reciprocal_condition(with_vertical.reshape(-1, 18, 5), 5),
        # Without a platform IMU, type n-3-II leaves one unknown to the columns' being orthonormal.
        reciprocal_condition(alone.reshape(-1, 18, 9), 8 if name == "6-3-II" else 9),
    )
    assert (np.array(found) > bounds).all(), found


@pytest.mark.parametrize("name", DEGREES)
def test_legs_keep_clear_of_each_other_at_home(name: str) -> None:
    mechanism = load_mechanism(name)
    home = mechanism.require_home()
    base, platform = mechanism.base_joints, mechanism.platform_joints
    legs = legs_at(mechanism, home.position, home.rotation)[1]
    points = base[:, None] + np.linspace(0.0, 1.0, 201)[:, None] * legs[:, None]
    for k, other in combinations(range(6), 2):
        if (base[k] != base[other]).any() and (platform[k] != platform[other]).any():
            assert np.linalg.norm(points[k][:, None] - points[other], axis=-1).min() > 0.03, (k, other)


def test_genhexkins_has_the_proportions_of_linuxcnc() -> None:
    mechanism = load_mechanism("genhexkins")
    inch = 0.0254
    base = [[-22.95, 13.25, 0], [22.95, 13.25, 0], [22.95, 13.25, 0], [0, -26.5, 0], [0, -26.5, 0], [-22.95, 13.25, 0]]
    platform = [
        [-1, 11.5, 0], [1, 11.5, 0], [10.459, -4.884, 0], [9.459, -6.616, 0], [-9.459, -6.616, 0], [-10.459, -4.884, 0],
    ]  # fmt: skip
    np.testing.assert_allclose(mechanism.base_joints / inch, base, atol=1e-12)
    np.testing.assert_allclose(mechanism.platform_joints / inch, platform, atol=1e-12)
    home = mechanism.require_home()
    lengths = np.linalg.norm(legs_at(mechanism, home.position, home.rotation)[1], axis=1)
    np.testing.assert_allclose(lengths / inch, 29.7466, atol=5e-4)
