"""Rigid transforms: poses one after the other, and what they do to velocities.

A pose may be one, position (3,) and rotation (3, 3), or many, (..., 3) and (..., 3, 3); the leading axes broadcast. The pose of
B in A followed by that of C in B is the pose of C in A. A twist (..., 6) is the velocity [m/s] of a body's origin and its
angular velocity [rad/s], both seen in the frame in which the body's pose is given, in the order of a pose's covariance (6, 6).
"""

import numpy as np

from plant.pose import Array, Pose


def compose(outer: Pose, inner: Pose) -> Pose:
    """The pose of C in A, from `outer`, that of B in A, and `inner`, that of C in B."""
    return Pose(outer.position + turned(outer.rotation, inner.position), outer.rotation @ inner.rotation)


def inverse(pose: Pose) -> Pose:
    """The pose of A in B, from that of B in A."""
    back = transposed(pose.rotation)
    return Pose(-turned(back, pose.position), back)


def transfer(axes: Array, arm: Array) -> Array:
    """The matrix (..., 6, 6) from a body's twist to that at another of its points, seen in other axes: the adjoint.

    It maps a covariance P of small errors, too: J P J^T.

    Args:
        axes: (..., 3, 3), maps the other axes to those of the twist.
        arm: (..., 3), from the twist's point to the other point, in the axes of the twist [m].
    """
    back = transposed(axes)
    upper_right = -back @ transposed(np.cross(np.asarray(arm)[..., None, :], np.eye(3)))
    matrix = np.zeros((*upper_right.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = back
    matrix[..., :3, 3:] = upper_right
    return matrix


def level_from_base(pose: Pose, attitude: Array) -> Pose:
    """The pose in the level frame of one in {1}; `attitude` (..., 3, 3) maps {1} to the level frame (docs/moving_base.md)."""
    return Pose(turned(attitude, pose.position), attitude @ pose.rotation)


def base_from_level(pose: Pose, attitude: Array) -> Pose:
    """The pose in {1} of one in the level frame; the inverse of `level_from_base`."""
    return level_from_base(pose, transposed(attitude))


def level_twist_from_base(pose: Pose, twist: Array, attitude: Array, rate: Array) -> Array:
    """The twist (..., 6) in the level frame of a body with this pose and twist in {1}.

    Args:
        pose, twist: in {1}.
        attitude: (..., 3, 3), maps {1} to the level frame.
        rate: (..., 3), the angular velocity of the base, seen in {1} [rad/s].
    """
    seen = twist + _carried(pose.position, rate)
    return np.concatenate([turned(attitude, seen[..., :3]), turned(attitude, seen[..., 3:])], axis=-1)


def base_twist_from_level(pose: Pose, twist: Array, attitude: Array, rate: Array) -> Array:
    """The twist (..., 6) in {1} of a body with this pose in {1} and this twist in the level frame; the inverse of
    `level_twist_from_base`.
    """
    back = transposed(attitude)
    return np.concatenate([turned(back, twist[..., :3]), turned(back, twist[..., 3:])], axis=-1) - _carried(pose.position, rate)


def _carried(position: Array, rate: Array) -> Array:
    """The twist (..., 6) of what the base carries, seen in {1}."""
    velocity = np.cross(rate, position)
    return np.concatenate([velocity, np.broadcast_to(rate, velocity.shape)], axis=-1)


def turned(rotation: Array, vector: Array) -> Array:
    """The vectors (..., 3), rotated by (..., 3, 3)."""
    rotated: Array = (rotation @ vector[..., None])[..., 0]
    return rotated


def transposed(rotation: Array) -> Array:
    """The inverse rotations (..., 3, 3)."""
    return np.swapaxes(rotation, -1, -2)
