"""Figures of a mechanism's geometry alone: how far it reaches, how well the pose is determined, and what its actuators bear."""

from collections.abc import Collection

import numpy as np

from controller.imu_set import conditionings
from controller.inverse_kinematics import sample_workspace
from controller.load_feed_forward import first_moment_of
from controller.pose_limits.limits import GEOMETRY_ALONE, space_of
from controller.pose_limits.margins import WORK, force_rows, margins
from controller.workspace.extent import poses_about, reach_from, spread_points
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import Mechanism
from plant.pose import Array

_BOX_POSES, _BOX_TILT = 8192, 0.2
_LOAD_POSES = 200
_LOADS = ("gravity", "platform.mass", "payload.mass")


def geometry_figures(
    mechanism: Mechanism, imus: Collection[int] = ALL_IMUS, magnetometer: bool = False, section_5: bool = False
) -> dict[str, float]:
    """The figures of a mechanism with home and strokes.

    - `reach` [m^3]: volume of the positions that a straight move from home reaches, with the rotation of home, before a leg
      comes to the end of its stroke, a joint to that of its swing, or two bodies together.
    - `reach_rotation` [rad^3]: volume of the rotation vectors that a turn about one axis reaches from home, in place.
    - `reach_share`: share of a box of poses about home that are within the same limits; it goes half a stroke to either side
      along each axis, and rotation vectors of 0.2 rad.
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
    if mechanism.planar:
        raise InputError(f"{mechanism.name!r} is planar, and these figures are of six legs: see 'gough workspace'")
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
    return reach_from(mechanism, mechanism.require_home(), GEOMETRY_ALONE).volume


def reach_rotation(mechanism: Mechanism) -> float:
    """The volume [rad^3] of the rotation vectors that a turn about one axis reaches from home, at home's position.

    Raises:
        InputError: no home, or no stroke.
    """
    return reach_from(mechanism, mechanism.require_home(), GEOMETRY_ALONE, turning=True, most=np.pi).volume


def reach_share(mechanism: Mechanism) -> float:
    """The share of a box of poses about home that are reachable; see `geometry_figures`.

    Raises:
        InputError: no home, or no stroke.
    """
    home, stroke = mechanism.require_home(), mechanism.require_limits().stroke
    moves = 2.0 * spread_points(_BOX_POSES, 6) - 1.0
    moves[:, :3] *= 0.5 * float(np.mean(stroke[:, 1] - stroke[:, 0]))
    moves[:, 3:] *= _BOX_TILT
    return float(margins(mechanism, *poses_about(home, moves), GEOMETRY_ALONE).reachable.mean())


def holding_forces(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """The forces (N, 6) [N] with which the actuators hold platform and payload at rest; positive forces push.

    Raises:
        InputError: the mechanism has no masses of platform and payload, or no gravity.
    """
    plant = mechanism.plant
    for name in _LOADS:
        if name not in plant:
            raise InputError(
                f"the mechanism {mechanism.name!r} lacks the plant's {name}, and so has no weight to hold: give it"
            )
    space = space_of(mechanism, GEOMETRY_ALONE).copy()
    space["gravity"] = float(np.linalg.norm(plant["gravity"]))
    space["weights"]["mass"], space["weights"]["first_moment"] = first_moment_of(plant)
    forces = np.empty((len(positions), mechanism.legs))
    force_rows(space, np.zeros((), WORK), np.ascontiguousarray(positions), np.ascontiguousarray(rotations), forces)
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
