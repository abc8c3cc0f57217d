"""Figures of a mechanism's geometry alone: how far it reaches, how well the pose is determined, and what its actuators bear."""

from collections.abc import Collection

import numpy as np

from controller.imu_set import conditionings
from controller.inverse_kinematics import leg_lengths, sample_workspace
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism
from plant.pose import Array

_DIRECTIONS = 4000
_BOX_POSES, _BOX_TILT = 8192, 0.2
_LOAD_POSES = 200
_LOADS = ("gravity", "platform.mass", "payload.mass")


def geometry_figures(
    mechanism: Mechanism, imus: Collection[int] = ALL_IMUS, magnetometer: bool = False, section_5: bool = False
) -> dict[str, float]:
    """The figures of a mechanism with home and strokes.

    - `reach` [m^3]: volume of the positions that a straight move from home reaches, with the rotation of home, before a leg
      comes to the end of its stroke.
    - `reach_rotation` [rad^3]: volume of the rotation vectors that a turn about one axis reaches from home, in place.
    - `reach_share`: share of a box of poses about home at which all legs are within their strokes; it goes half a stroke to
      either side along each axis, and rotation vectors of 0.2 rad.
    - `conditioning_home`, `conditioning_worst`: of direct kinematics with these IMUs, at home and at the worst pose of the
      workspace; 1 is best, 0 singular.
    - `force_per_load`, `force_per_torque` [-, 1/m]: the greatest force of an actuator, over the workspace, for a load of 1 N in
      the worst direction at the origin of {2}, and of 1 Nm about the worst axis.
    - `force_max` [N]: the greatest force of an actuator, over the workspace, that holds platform and payload; only where the
      mechanism has their masses.

    "Over the workspace" are 200 random poses within the strokes (`sample_workspace`), the same on each call.

    Raises:
        InputError: no home, no stroke, a planar mechanism, or IMUs that cannot be used.
    """
    positions, rotations = _poses(mechanism)
    found = conditionings(mechanism, positions, rotations, imus, magnetometer, section_5)
    by_force = _inverse_jacobians(mechanism, positions, rotations)
    figures = {
        "reach": reach(mechanism),
        "reach_rotation": reach_rotation(mechanism),
        "reach_share": reach_share(mechanism),
        "conditioning_home": float(found[0]),
        "conditioning_worst": float(found.min()),
        "force_per_load": float(np.linalg.norm(by_force[:, :, :3], axis=2).max()),
        "force_per_torque": float(np.linalg.norm(by_force[:, :, 3:], axis=2).max()),
    }
    if mechanism.plant.keys() >= {*_LOADS}:
        figures["force_max"] = float(np.abs(holding_forces(mechanism, positions, rotations)).max())
    return figures


def reach(mechanism: Mechanism) -> float:
    """The volume [m^3] of the positions that a straight move from home reaches, with the rotation of home.

    Raises:
        InputError: no home, or no stroke.
    """
    home, stroke = mechanism.require_home(), mechanism.require_limits().stroke
    directions = _sphere(_DIRECTIONS)
    legs = home.position + mechanism.platform_joints @ home.rotation.T - mechanism.base_joints
    along, squares = directions @ legs.T, np.sum(legs**2, axis=1)
    # A leg has the length s where t^2 + 2 t along + squares = s^2: it leaves the stroke at its greatest length, or before
    # that at its least.
    longest = -along + np.sqrt(np.maximum(along**2 - squares + stroke[:, 1] ** 2, 0.0))
    inner = along**2 - squares + stroke[:, 0] ** 2
    shortest = np.where((along < 0.0) & (inner >= 0.0), -along - np.sqrt(np.maximum(inner, 0.0)), np.inf)
    return _volume(np.minimum(longest, shortest).min(axis=1))


def reach_rotation(mechanism: Mechanism) -> float:
    """The volume [rad^3] of the rotation vectors that a turn about one axis reaches from home, at home's position.

    Raises:
        InputError: no home, or no stroke.
    """
    home, stroke = mechanism.require_home(), mechanism.require_limits().stroke
    axes = _sphere(_DIRECTIONS)
    arms, toward = mechanism.platform_joints @ home.rotation.T, home.position - mechanism.base_joints
    # The square of a length is a constant + 2 (a cos + b sin) of the angle.
    fixed = (axes @ toward.T) * (axes @ arms.T)
    a = np.sum(toward * arms, axis=1) - fixed
    b = np.sum(toward * np.cross(axes[:, None], arms), axis=2)
    squares = np.sum(toward**2 + arms**2, axis=1) + 2.0 * fixed
    size, phase = np.hypot(a, b), np.arctan2(b, a)
    angles = np.full((2, *size.shape, 2), np.pi)
    for end in range(2):
        with np.errstate(invalid="ignore", divide="ignore"):
            opening = np.arccos((stroke[:, end] ** 2 - squares) / (2.0 * size))
        for way, sign in enumerate((-1.0, 1.0)):
            met = np.mod(phase + sign * opening, 2.0 * np.pi)
            angles[end, :, :, way] = np.where(np.isfinite(met), np.minimum(met, np.pi), np.pi)
    return _volume(angles.min(axis=(0, 2, 3)))


def reach_share(mechanism: Mechanism) -> float:
    """The share of a box of poses about home at which all legs are within their strokes; see `geometry_figures`.

    Raises:
        InputError: no home, or no stroke.
    """
    home, stroke = mechanism.require_home(), mechanism.require_limits().stroke
    shares = 2.0 * _spread_points(_BOX_POSES, 6) - 1.0
    moves = shares[:, :3] * 0.5 * float(np.mean(stroke[:, 1] - stroke[:, 0]))
    rotations = _rotations(_BOX_TILT * shares[:, 3:]) @ home.rotation
    lengths = leg_lengths(mechanism, home.position + moves, rotations)
    return float(((lengths >= stroke[:, 0]) & (lengths <= stroke[:, 1])).all(axis=1).mean())


def holding_forces(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """The forces (N, 6) [N] with which the actuators hold platform and payload at rest; positive forces push.

    Raises:
        InputError: the mechanism has no masses of platform and payload, or no gravity.
    """
    plant, wrenches = mechanism.plant, np.zeros((len(positions), 6))
    for name in _LOADS:
        if name not in plant:
            raise InputError(
                f"the mechanism {mechanism.name!r} lacks the plant's {name}, and so has no weight to hold: give it"
            )
    for body in ("platform", "payload"):
        weight = float(plant[f"{body}.mass"]) * plant["gravity"]
        arms = rotations @ plant.get(f"{body}.center_of_mass", np.zeros(3))
        wrenches[:, :3] += weight
        wrenches[:, 3:] += np.cross(arms, weight)
    forces: Array = -np.einsum("nij,nj->ni", _inverse_jacobians(mechanism, positions, rotations), wrenches)
    return forces


def _poses(mechanism: Mechanism) -> tuple[Array, Array]:
    """Home, and poses of the workspace."""
    home = mechanism.require_home()
    positions, rotations = sample_workspace(mechanism, _LOAD_POSES, seed=0)
    return np.vstack([home.position[None], positions]), np.concatenate([home.rotation[None], rotations])


def _inverse_jacobians(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """(N, 6, 6): the actuators' forces for a wrench on the platform are minus these times the wrench (virtual work)."""
    arms = mechanism.platform_joints @ np.swapaxes(rotations, 1, 2)
    legs = positions[:, None] + arms - mechanism.base_joints
    directions = legs / np.linalg.norm(legs, axis=2, keepdims=True)
    jacobians = np.concatenate([directions, np.cross(arms, directions)], axis=2)
    inverse: Array = np.linalg.inv(np.swapaxes(jacobians, 1, 2))
    return inverse


def _volume(radii: Array) -> float:
    """The volume within these distances from the centre, along directions that are spread evenly."""
    return float(4.0 / 3.0 * np.pi * np.mean(radii**3))


def _sphere(count: int) -> Array:
    """Unit vectors (count, 3), spread evenly (a Fibonacci spiral)."""
    number = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def _spread_points(count: int, dimensions: int) -> Array:
    """Points (count, dimensions), spread evenly over the unit cube (an additive recurrence)."""
    root = 2.0
    for _ in range(50):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0


def _rotations(vectors: Array) -> Array:
    """The rotations (N, 3, 3) of vectors (N, 3) [rad] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = (vectors / np.maximum(angles[:, 0], np.finfo(float).tiny)).T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    turned: Array = np.eye(3) + np.sin(angles) * skew + (1.0 - np.cos(angles)) * skew @ skew
    return turned
