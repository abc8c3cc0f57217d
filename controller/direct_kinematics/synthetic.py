"""Measurements for direct kinematics at given and at random poses, with the noise of real sensors or without."""

from typing import Any

import numpy as np

from controller.direct_kinematics.spatial import LEG_SIGMA, NEEDS, TILT_SIGMA, YAW_SIGMA
from plant.mechanism import Mechanism
from plant.pose import Array, rotation_from_vector

REACH, TILT = 1.0 / 6.0, np.radians(15.0)
"""Poses are drawn within this share of the base's radius and this angle from home: 50 mm and 15 deg on `hexapod`."""


def draw_poses(mechanism: Mechanism, count: int, random: np.random.Generator) -> tuple[Array, Array]:
    """Positions (count, 3) [m] and rotations (count, 3, 3), uniform about home by axes and by xyz angles."""
    radius = float(np.linalg.norm(mechanism.base_joints - mechanism.base_joints.mean(axis=0), axis=1).max())
    home = mechanism.nominal_home
    positions = home.position + random.uniform(-REACH * radius, REACH * radius, (count, 3))
    about_x, about_y, about_z = (
        np.array([rotation_from_vector(angle * axis) for angle in random.uniform(-TILT, TILT, count)]) for axis in np.eye(3)
    )
    return positions, about_z @ about_y @ about_x @ home.rotation


def leg_directions(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """The unit vectors (N, 6, 3) along the legs at positions (N, 3) [m] and rotations (N, 3, 3)."""
    return _unit(positions[:, None] + mechanism.platform_joints @ np.swapaxes(rotations, 1, 2) - mechanism.base_joints)


def draw_measurements(
    mechanism: Mechanism, positions: Array, rotations: Array, random: np.random.Generator, noise: float
) -> dict[str, Array]:
    """The measurements at these poses, by their names in `solve_batch`, with `noise` times the sigmas."""
    up, count = mechanism.up_in_base, len(positions)
    directions = leg_directions(mechanism, positions, rotations)
    level = np.linalg.svd(up[None])[2][1:]
    turns = random.normal(size=(count, 3)) * [TILT_SIGMA, TILT_SIGMA, YAW_SIGMA] @ np.array([*level, up])
    return {
        "leg_directions": _unit(directions + noise * random.normal(scale=LEG_SIGMA, size=directions.shape)),
        "up_in_platform": _unit(up @ rotations + noise * random.normal(scale=TILT_SIGMA, size=(count, 3))),
        "normal": _unit(rotations[:, :, 2] + noise * random.normal(scale=TILT_SIGMA, size=(count, 3))),
        "rotation": np.array([rotation_from_vector(noise * turn) for turn in turns]) @ rotations,
    }


def _unit(vectors: Array) -> Array:
    unit: Array = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def measurements_of(method: str, measurements: dict[str, Array]) -> dict[str, Any]:
    """Those of the measurements that a method of `solve_batch` uses."""
    return {name: measurements[name] for name in ("leg_directions", NEEDS.get(method)) if name}
