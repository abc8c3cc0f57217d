"""Direct kinematics from the lengths of all legs, by Newton's method on SE(3) from a first guess, for rigs with encoders."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from controller.direct_kinematics.geometry import geometry_of
from controller.direct_kinematics.refinement import move_pose
from controller.inverse_kinematics import jacobian_at, legs_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import Record, kernel
from plant.errors import SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, checked_array, checked_rotation, numbers

_NEWTON_LIMIT = 50
_REACHED_M = 1e-10


def pose_from_lengths(mechanism: Mechanism, lengths: ArrayLike, guess: Pose | None = None) -> Pose:
    """The pose at which the legs have these lengths (n,) [m], from a first guess (default: home).

    Raises:
        InputError: wrong shape or not finite, or the guess is no pose.
        SingularConfigurationError: no pose near the guess has these lengths.
    """
    target = checked_array(lengths, (mechanism.legs,), "lengths")
    positions, rotations, found, error = _follow(mechanism, target[None], guess or mechanism.require_home())
    if not found:
        raise SingularConfigurationError(
            f"no pose near the guess has these lengths (they are missed by {1e3 * error:.3g} mm): they are not reachable, or "
            "the guess is too far"
        )
    return Pose(positions[0], rotations[0])


def poses_from_lengths(mechanism: Mechanism, lengths: ArrayLike, guess: Pose, partial: bool = False) -> tuple[Array, Array]:
    """Positions (N, 3) [m] and rotations (N, 3, 3) of a motion given by lengths (N, n) [m] of n legs. Each pose is the first
    guess for the next. If `partial`, all from the first one on that is not found are NaN.

    Raises:
        InputError: wrong shape or not finite, or the guess is no pose.
        SingularConfigurationError: the lengths of a row belong to no pose near the one before.
    """
    given = numbers(lengths, "lengths", f"(N, {mechanism.legs})")
    given = checked_array(given, (len(given) if given.ndim else 0, mechanism.legs), "lengths")
    positions, rotations, found, _ = _follow(mechanism, given, guess)
    positions[found:], rotations[found:] = np.nan, np.nan
    if found < len(given) and not partial:
        raise SingularConfigurationError(f"no pose near the one before has the lengths of row {found}")
    return positions, rotations


def kernels_of_lengths(mechanism: Mechanism) -> tuple[tuple[Any, ...], ...]:
    """The kernel of `poses_from_lengths`, with arguments, as `load_kernels` takes it."""
    lengths, rotation = checked_array(np.zeros((1, mechanism.legs)), (1, mechanism.legs), "lengths"), np.eye(3)
    return ((_find_poses, geometry_of(mechanism), lengths, np.zeros(3), rotation, np.zeros((1, 3)), rotation[None].copy()),)


def _follow(mechanism: Mechanism, lengths: Array, guess: Pose) -> tuple[Array, Array, int, float]:
    """Positions and rotations at lengths (N, n), how many were found, and the largest error of the last [m]."""
    position = checked_array(guess.position, (3,), "guess.position").copy()
    rotation = checked_rotation(guess.rotation, "guess.rotation").copy()
    positions, rotations = np.empty((len(lengths), 3)), np.empty((len(lengths), 3, 3))
    return positions, rotations, *_find_poses(geometry_of(mechanism), lengths, position, rotation, positions, rotations)


@kernel
def _find_poses(
    geometry: Record, lengths: Array, position: Array, rotation: Array, positions: Array, rotations: Array
) -> tuple[int, float]:
    arms, directions, errors, jacobian = np.zeros((LEGS, 3)), np.zeros((LEGS, 3)), np.zeros(LEGS), np.zeros((6, 6))
    error = 0.0
    for i in range(lengths.shape[0]):
        error = find_pose(geometry, lengths[i], position, rotation, arms, directions, errors, jacobian)
        if not error < _REACHED_M:
            return i, error
        positions[i] = position
        rotations[i] = rotation
    return lengths.shape[0], error


@kernel
def find_pose(
    geometry: Record, target: Array, position: Array, rotation: Array, arms: Array, directions: Array, errors: Array,
    jacobian: Array,
) -> float:  # fmt: skip
    """Move a pose, in place, to where the legs have the lengths `target` (n,) [m]; returns the largest remaining error [m]."""
    error, legs = np.inf, target.shape[0]
    for _ in range(_NEWTON_LIMIT):
        legs_at(geometry.base_joints, geometry.platform_joints, position, rotation, arms, directions, errors)
        before, error = error, 0.0
        for k in range(legs, LEGS):
            errors[k] = 0.0
        for k in range(legs):
            errors[k] = target[k] - errors[k]
            if not np.isfinite(errors[k]):
                return np.inf
            error = max(error, abs(errors[k]))
        if error < 1e-15 or (error < 1e-11 and error >= before):
            break
        jacobian_at(arms, directions, legs, jacobian)
        if solve_square(jacobian, errors) < RANK_TOLERANCE:
            return np.inf
        move_pose(errors, position, rotation)
    return error
