"""Inverse kinematics: from the pose of the platform to the legs (the paper's (1)), and the Jacobian of their lengths."""

from dataclasses import dataclass

import numpy as np

from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import kernel
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, checked_array, checked_rotation, rotation_from_vector
from plant.vectors import add, cross, dot, rotate, scale, subtract, vector

_MOST_DRAWS = 500


@dataclass(frozen=True, eq=False)
class Legs:
    """The legs at a pose; leg k connects base joint k and platform joint k.

    Attributes:
        vectors: (6, 3) [m] from base to platform joint, in {1}.
        lengths: (6,) [m].
        directions: (6, 3), unit.
        jacobian: (6, 6); maps the twist (velocity [m/s] of the origin of {2}, angular velocity [rad/s]; both in {1}) to
            the rates of the lengths [m/s].
    """

    vectors: Array
    lengths: Array
    directions: Array
    jacobian: Array


def inverse_kinematics(mechanism: Mechanism, pose: Pose) -> Legs:
    """The legs of `mechanism` at `pose`.

    Raises:
        InputError: the pose is not finite, or its rotation is no rotation matrix.
        SingularConfigurationError: a leg has no length.
    """
    position = checked_array(pose.position, (3,), "position")
    rotation = checked_rotation(pose.rotation, "rotation")
    arms = mechanism.platform_joints @ rotation.T
    vectors = position + arms - mechanism.base_joints
    lengths = np.linalg.norm(vectors, axis=1)
    if lengths.min() == 0.0:
        raise SingularConfigurationError(f"leg {int(lengths.argmin())} has no length at this pose, and so no direction")
    directions = vectors / lengths[:, None]
    return Legs(vectors, lengths, directions, np.hstack([directions, np.cross(arms, directions)]))


def leg_lengths(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """The lengths (..., n) [m] of n legs at positions (..., 3) [m] and rotations (..., 3, 3); unchecked."""
    arms = np.einsum("...ij,kj->...ki", rotations, mechanism.platform_joints)
    lengths: Array = np.linalg.norm(positions[..., None, :] + arms - mechanism.base_joints, axis=-1)
    return lengths


@kernel
def legs_at(
    base_joints: Array, platform_joints: Array, position: Array, rotation: Array, arms: Array, directions: Array, lengths: Array
) -> None:
    """Compiled twin of `inverse_kinematics`: writes arms (6, 3), the platform joints turned to {1}, directions and lengths."""
    for k in range(LEGS):
        arm = rotate(rotation, vector(platform_joints[k]))
        leg = subtract(add(vector(position), arm), vector(base_joints[k]))
        lengths[k] = length = np.sqrt(dot(leg, leg))
        arms[k, 0], arms[k, 1], arms[k, 2] = arm
        directions[k, 0], directions[k, 1], directions[k, 2] = scale(1.0 / length, leg)


@kernel
def jacobian_at(arms: Array, directions: Array, legs: int, jacobian: Array) -> None:
    """Write the Jacobian (6, 6) of the lengths from arms (6, 3) and directions (6, 3).

    In rows of legs that a planar mechanism lacks, its plane stands: no translation along z, no turns about x and y.
    """
    for k in range(legs, LEGS):
        for i in range(6):
            jacobian[k, i] = 1.0 if i == k - 1 else 0.0
    for k in range(legs):
        direction = vector(directions[k])
        jacobian[k, 0], jacobian[k, 1], jacobian[k, 2] = direction
        jacobian[k, 3], jacobian[k, 4], jacobian[k, 5] = cross(vector(arms[k]), direction)


@kernel
def motion_of_legs(
    arms: Array, directions: Array, lengths: Array, count: int, legs: Array, jacobian: Array, right: Array
) -> bool:  # fmt: skip
    """Write into `right` (2, 6) the twist and the acceleration of the platform at which the legs have their rates.

    With r the direction of a leg, a its arm, v + omega x a the velocity of its joint, and l its length,

        l' = r (v + omega x a),  l'' = r (v' + omega' x a + omega x (omega x a)) + (|v + omega x a|^2 - l'^2) / l

    Args:
        arms, directions, lengths: (6, 3), (6, 3), (6,), of the legs.
        count: number of legs; a planar mechanism has three, and moves in its plane.
        legs: (6, 3), length, rate and acceleration of each leg.
        jacobian: (6, 6), scratch.

    Returns:
        Whether the Jacobian can be inverted; if not, `right` is zero.
    """
    for order in range(2):
        jacobian_at(arms, directions, count, jacobian)
        right[order, count:] = 0.0
        for k in range(count):
            right[order, k] = legs[k, 1 + order]
            if order == 1:
                omega, arm = vector(right[0, 3:]), vector(arms[k])
                turning = cross(omega, arm)
                speed = add(vector(right[0]), turning)
                right[1, k] -= dot(vector(directions[k]), cross(omega, turning))
                right[1, k] -= (dot(speed, speed) - legs[k, 1] ** 2) / lengths[k]
        if solve_square(jacobian, right[order]) < RANK_TOLERANCE:
            right[:] = 0.0
            return False
    return True


def sample_workspace(mechanism: Mechanism, count: int, seed: int) -> tuple[Array, Array]:
    """Random poses at which every leg is inside its stroke: positions (count, 3) [m] and rotations (count, 3, 3).

    They are drawn uniformly from a box about home: four fifths of the stroke's range to either side, and 0.35 rad about each
    axis; for a planar mechanism, within its plane. Poses outside the strokes are discarded.

    Raises:
        InputError: no home, no stroke, or too few poses inside the strokes.
    """
    home, limits = mechanism.require_home(), mechanism.require_limits()
    reach = 0.8 * float((limits.stroke[:, 1] - limits.stroke[:, 0]).max())
    random = np.random.default_rng(seed)
    positions, rotations = np.empty((0, 3)), np.empty((0, 3, 3))
    for _ in range(_MOST_DRAWS):
        if len(positions) >= count:
            return positions[:count], rotations[:count]
        moves = np.hstack([random.uniform(-reach, reach, (2000, 3)), random.uniform(-0.35, 0.35, (2000, 3))])
        if mechanism.planar:
            moves[:, 2:5] = 0.0
        drawn = home.position + moves[:, :3]
        turned = np.array([rotation_from_vector(v) @ home.rotation for v in moves[:, 3:]])
        lengths = leg_lengths(mechanism, drawn, turned)
        inside = ((lengths > limits.stroke[:, 0]) & (lengths < limits.stroke[:, 1])).all(axis=1)
        positions, rotations = np.concatenate([positions, drawn[inside]]), np.concatenate([rotations, turned[inside]])
    raise InputError(
        f"the workspace of {mechanism.name!r} is too small to draw {count} poses, with legs of {limits.stroke.mean():.3g} m "
        f"and a stroke of {np.diff(limits.stroke).min():.3g} m: check the strokes, and that both are in metres"
    )
