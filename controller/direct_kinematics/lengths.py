"""Direct kinematics from the lengths of all legs, by Newton's method on SE(3) from a first guess, for rigs with encoders."""

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.geometry import geometry_of
from controller.direct_kinematics.refinement import move_pose
from controller.inverse_kinematics import jacobian_at, legs_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import kernel
from plant.errors import SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, checked_array, checked_rotation, numbers

_NEWTON_LIMIT = 50


def pose_from_lengths(mechanism: Mechanism, lengths: ArrayLike, guess: Pose | None = None) -> Pose:
    """The pose at which the legs have these lengths, by Newton's method on SE(3) from a first guess (default: home).

    Raises:
        InputError: wrong shape or not finite, or the guess is no pose.
        SingularConfigurationError: no pose near the guess has these lengths.
    """
    target = checked_array(lengths, (mechanism.legs,), "lengths")
    position, rotation = _copied(guess or mechanism.require_home())
    geometry = geometry_of(mechanism)
    error = newton_from_lengths(geometry["base_joints"], geometry["platform_joints"], target, position, rotation, *_scratch())
    if not error < 1e-10:
        raise SingularConfigurationError(
            f"no pose near the guess has these lengths (they are missed by {1e3 * error:.3g} mm): they are not reachable, or "
            "the guess is too far"
        )
    return Pose(position, rotation)


def _copied(guess: Pose) -> tuple[Array, Array]:
    position = checked_array(guess.position, (3,), "guess.position")
    return position.copy(), checked_rotation(guess.rotation, "guess.rotation").copy()


def _scratch() -> tuple[Array, ...]:
    """Memory for `newton_from_lengths`, in the order of its arguments."""
    return tuple(np.zeros(shape) for shape in ((LEGS, 3), (LEGS, 3), LEGS, (6, 6)))


@kernel
def newton_from_lengths(
    base_joints: Array, platform_joints: Array, target: Array, position: Array, rotation: Array, arms: Array, directions: Array,
    lengths: Array, jacobian: Array,
) -> float:  # fmt: skip
    """Move a pose, in place, to where the legs have the lengths `target` (n,) [m]; returns the largest remaining error [m]."""
    error, legs = np.inf, target.shape[0]
    for _ in range(_NEWTON_LIMIT):
        legs_at(base_joints, platform_joints, position, rotation, arms, directions, lengths)
        before, error = error, 0.0
        for k in range(legs, LEGS):
            lengths[k] = 0.0
        for k in range(legs):
            lengths[k] = target[k] - lengths[k]
            if not np.isfinite(lengths[k]):
                return np.inf
            error = max(error, abs(lengths[k]))
        if error < 1e-15 or (error < 1e-11 and error >= before):
            break
        jacobian_at(arms, directions, legs, jacobian)
        if solve_square(jacobian, lengths) < RANK_TOLERANCE:
            return np.inf
        move_pose(lengths, position, rotation)
    return error


@kernel
def _poses_from_lengths(
    base_joints: Array, platform_joints: Array, lengths: Array, position: Array, rotation: Array, positions: Array,
    rotations: Array, arms: Array, directions: Array, scratch: Array, jacobian: Array,
) -> int:  # fmt: skip
    for i in range(lengths.shape[0]):
        error = newton_from_lengths(
            base_joints, platform_joints, lengths[i], position, rotation, arms, directions, scratch, jacobian
        )
        if not error < 1e-10:
            return i
        positions[i] = position
        rotations[i] = rotation
    return -1


def poses_from_lengths(mechanism: Mechanism, lengths: ArrayLike, guess: Pose) -> tuple[Array, Array]:
    """Positions (N, 3) [m] and rotations (N, 3, 3) of a motion given by lengths (N, n) [m] of n legs. Each pose is the first
    guess for the next.

    Raises:
        InputError: wrong shape or not finite, or the guess is no pose.
        SingularConfigurationError: the lengths of a row belong to no pose near the one before.
    """
    given = numbers(lengths, "lengths", f"(N, {mechanism.legs})")
    given = checked_array(given, (len(given) if given.ndim else 0, mechanism.legs), "lengths")
    position, rotation = _copied(guess)
    positions, rotations = np.empty((len(given), 3)), np.empty((len(given), 3, 3))
    geometry = geometry_of(mechanism)
    failed = _poses_from_lengths(
        geometry["base_joints"], geometry["platform_joints"], given, position, rotation, positions, rotations, *_scratch()
    )
    if failed >= 0:
        raise SingularConfigurationError(f"no pose near the one before has the lengths of row {failed}")
    return positions, rotations
