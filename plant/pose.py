"""Poses and rotations, for all rooms.

A pose is `position` (3,) [m], the origin of the platform frame {2} seen in the base frame {1}, and `rotation` (3, 3),
which maps vectors of {2} to {1}. Quaternions are unit and w first. Every rotation is the active one; the paper's (14), (15)
and (32) print the transposes of the rotations that its (1) needs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.compiled import kernel
from plant.errors import InputError

Array = NDArray[np.floating[Any]]

UNIT_TOLERANCE = 1e-3
"""A user's unit quaternion or direction is refused if its length differs from 1 by more than this."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Position (3,) [m] of {2} in {1} and the rotation (3, 3) that maps {2} to {1}."""

    position: Array
    rotation: Array


_FLOAT = np.dtype(np.float64)


def numbers(value: ArrayLike, name: str, shape: tuple[int, ...] | str) -> Array:
    """A float copy of `value`; `shape` is the expected shape, for the error message only.

    Raises:
        InputError: `value` is not an array of numbers.
    """
    if type(value) is np.ndarray and value.dtype is _FLOAT:
        return value.copy()
    try:
        given = np.asarray(value)
    except ValueError:
        given = np.empty((), object)
    if given.dtype.kind not in "iuf":
        raise InputError(f"{name} must be an array of numbers of shape {shape}, got {value!r}")
    return np.array(given, dtype=np.float64)


def checked_array(value: ArrayLike, shape: tuple[int, ...], name: str, *, allow_nan: bool = False) -> Array:
    """A read-only float copy of `value`, which must have this shape and be finite.

    Raises:
        InputError: wrong shape, not numeric, or not finite (NaN passes with `allow_nan`; infinity never).
    """
    array = numbers(value, name, shape)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    bad = np.isinf(array) if allow_nan else ~np.isfinite(array)
    if bad.any():
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise InputError(f"{name}{list(where) if where else ''} is {array[where]}; it must be finite")
    array.setflags(write=False)
    return array


def checked_unit(value: ArrayLike, size: int, name: str) -> Array:
    """The normalised vector of one whose length is 1 within 1e-3, or an `InputError`."""
    array = checked_array(value, (size,), name)
    norm = float(np.linalg.norm(array))
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise InputError(f"{name} has length {norm:.6g}; it must be 1 within {UNIT_TOLERANCE:g}: normalise it")
    unit: Array = array / norm
    unit.setflags(write=False)
    return unit


def checked_rotation(value: ArrayLike, name: str) -> Array:
    """The rotation (3, 3) closest to a matrix that is orthogonal within 1e-3.

    Raises:
        InputError: wrong shape, not finite, not orthogonal, or a reflection (determinant -1).
    """
    array = checked_array(value, (3, 3), name)
    error = float(np.abs(array.T @ array - np.eye(3)).max())
    if error > UNIT_TOLERANCE:
        raise InputError(f"{name} is off orthogonal by {error:.3g}, more than {UNIT_TOLERANCE:g}: give a rotation matrix")
    if np.linalg.det(array) < 0.0:
        raise InputError(f"{name} is a reflection (determinant -1); the frames of a pose are both right-handed")
    rotation = nearest_rotation(array)
    rotation.setflags(write=False)
    return rotation


def nearest_rotation(matrix: Array) -> Array:
    """The rotation (3, 3) closest to `matrix` (3, 3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrix)
    u[:, 2] *= np.sign(np.linalg.det(u @ vt))
    rotation: Array = u @ vt
    return rotation


def skew(vector: Array) -> Array:
    """The matrix (3, 3) of `vector x` (the paper's tilde, (22) and (23))."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@kernel
def rotation_from_quaternion(quaternion: Array) -> Array:
    """The rotation (3, 3) of a unit quaternion (4,), w first."""
    w, x, y, z = quaternion
    rotation = np.empty((3, 3))
    rotation[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    rotation[0, 1] = 2.0 * (x * y - w * z)
    rotation[0, 2] = 2.0 * (x * z + w * y)
    rotation[1, 0] = 2.0 * (x * y + w * z)
    rotation[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    rotation[1, 2] = 2.0 * (y * z - w * x)
    rotation[2, 0] = 2.0 * (x * z - w * y)
    rotation[2, 1] = 2.0 * (y * z + w * x)
    rotation[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return rotation


@kernel
def rotations_from_quaternions(quaternions: Array) -> Array:
    """The rotations (N, 3, 3) of unit quaternions (N, 4), w first."""
    rotations = np.empty((quaternions.shape[0], 3, 3))
    for i in range(quaternions.shape[0]):
        rotations[i] = rotation_from_quaternion(quaternions[i])
    return rotations


def quaternion_from_rotation(rotation: Array) -> Array:
    """The unit quaternions (..., 4), w first and w >= 0, of rotations (..., 3, 3)."""
    # The quaternion is an eigenvector of Bar-Itzhack's symmetric matrix.
    m = np.moveaxis(rotation, (-2, -1), (0, 1))
    rows = [
        [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]],
    ]
    quaternion: Array = np.linalg.eigh(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))[1][..., -1]
    return np.where(quaternion[..., :1] >= 0.0, quaternion, -quaternion)


def quaternions_along(rotations: Array) -> Array:
    """The unit quaternions (N, 4) of rotations (N, 3, 3), each with the sign that is nearer to the one before."""
    quaternions = quaternion_from_rotation(rotations)
    flips = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1.0, 1.0)
    quaternions[1:] *= np.cumprod(flips)[:, None]
    return quaternions


@kernel
def rotate_by_vector(rotation: Array, vector: Array) -> None:
    """Replace `rotation` (3, 3) by exp(skew(`vector`)) @ `rotation`, with `vector` (3,) [rad] seen in {1}."""
    angle2 = vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2]
    if angle2 > 1e-3:
        angle = np.sqrt(angle2)
        a = np.sin(angle) / angle
        b = (1.0 - np.cos(angle)) / angle2
    else:
        # What the series leave out is less than 3e-18.
        a = 1.0 - angle2 * (1.0 / 6.0 - angle2 * (1.0 / 120.0 - angle2 / 5040.0))
        b = 0.5 - angle2 * (1.0 / 24.0 - angle2 * (1.0 / 720.0 - angle2 / 40320.0))
    v0, v1, v2 = vector[0], vector[1], vector[2]
    for j in range(3):
        x, y, z = rotation[0, j], rotation[1, j], rotation[2, j]
        c0, c1, c2 = v1 * z - v2 * y, v2 * x - v0 * z, v0 * y - v1 * x
        rotation[0, j] = x + a * c0 + b * (v1 * c2 - v2 * c1)
        rotation[1, j] = y + a * c1 + b * (v2 * c0 - v0 * c2)
        rotation[2, j] = z + a * c2 + b * (v0 * c1 - v1 * c0)


def rotation_from_vector(vector: ArrayLike) -> Array:
    """The rotation (3, 3) about `vector` (3,) by its length [rad] (Rodrigues)."""
    rotation = np.eye(3)
    rotate_by_vector(rotation, np.asarray(vector, dtype=np.float64))
    return rotation


def vector_from_rotation(rotation: Array) -> Array:
    """The rotation vectors (..., 3) [rad], of at most half a turn, of rotations (..., 3, 3)."""
    quaternion = quaternion_from_rotation(rotation)
    half = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    turns = 2.0 * np.arctan2(half, quaternion[..., :1])
    vector: Array = quaternion[..., 1:] * np.where(half > 0.0, turns / np.where(half > 0.0, half, 1.0), 2.0)
    return vector


def rotation_angle(first: Array, second: Array) -> Array:
    """The angle [rad] between rotations (..., 3, 3) and (..., 3, 3); shape (...)."""
    return _turn(first, second)[0]


def _turn(first: Array, second: Array) -> tuple[Array, Array]:
    """The angle (...) [rad] from `second` to `first`, and its axis (..., 3) of the length 2 sin(angle)."""
    relative = first @ np.swapaxes(second, -1, -2)
    skewed = relative - np.swapaxes(relative, -1, -2)
    axis = np.stack([skewed[..., 2, 1], skewed[..., 0, 2], skewed[..., 1, 0]], axis=-1)
    return np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(relative, axis1=-2, axis2=-1) - 1.0), axis


def pose_errors(positions: Array, rotations: Array, true_positions: Array, true_rotations: Array) -> Array:
    """Errors (..., 6) of poses, less than half a turn: translation [m] and rotation vector [rad], both seen in {1}."""
    angle, axis = _turn(rotations, true_rotations)
    return np.concatenate([positions - true_positions, 0.5 * axis / np.sinc(angle / np.pi)[..., None]], axis=-1)


def rms_figures(errors: Array) -> dict[str, float]:
    """Root mean squares of the distance [m] and the angle [rad] of pose errors (N, 6)."""
    position, rotation = np.sqrt(np.mean(np.sum(errors.reshape(-1, 2, 3) ** 2, axis=2), axis=0))
    return {"position_rms": float(position), "rotation_rms": float(rotation)}
