"""Products of three-vectors in compiled code.

A vector is a tuple of three floats, so that a call costs as little as the formula written out. Every sum is taken from left to
right.
"""

from plant.compiled import kernel
from plant.pose import Array

Vector = tuple[float, float, float]


@kernel
def vector(array: Array) -> Vector:
    """The elements of an array (3,)."""
    return array[0], array[1], array[2]


@kernel
def add(a: Vector, b: Vector) -> Vector:
    """A + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def subtract(a: Vector, b: Vector) -> Vector:
    """A - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def scale(factor: float, a: Vector) -> Vector:
    """The vector times a number."""
    return factor * a[0], factor * a[1], factor * a[2]


@kernel
def dot(a: Vector, b: Vector) -> float:
    """The inner product."""
    a0, a1, a2 = a
    b0, b1, b2 = b
    return a0 * b0 + a1 * b1 + a2 * b2


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """The product a x b."""
    a0, a1, a2 = a
    b0, b1, b2 = b
    return a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0


@kernel
def rotate(rotation: Array, a: Vector) -> Vector:
    """R a, for a rotation (3, 3)."""
    a0, a1, a2 = a
    return (
        rotation[0, 0] * a0 + rotation[0, 1] * a1 + rotation[0, 2] * a2,
        rotation[1, 0] * a0 + rotation[1, 1] * a1 + rotation[1, 2] * a2,
        rotation[2, 0] * a0 + rotation[2, 1] * a1 + rotation[2, 2] * a2,
    )


@kernel
def rotate_back(rotation: Array, a: Vector) -> Vector:
    """R^T a, for a rotation (3, 3)."""
    a0, a1, a2 = a
    return (
        rotation[0, 0] * a0 + rotation[1, 0] * a1 + rotation[2, 0] * a2,
        rotation[0, 1] * a0 + rotation[1, 1] * a1 + rotation[2, 1] * a2,
        rotation[0, 2] * a0 + rotation[1, 2] * a1 + rotation[2, 2] * a2,
    )
