"""The error model of an IMU: what it makes of an ideal reading, and the derivatives of that.

rate  = (I + diag(scale) + U(axes)) R(-alignment) ideal + bias,   U upper triangular, R the rotation, the force likewise
"""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array
from plant.vectors import Vector, add, cross, scale, subtract, vector

ERROR_NAMES = (
    "gyroscope bias",
    "accelerometer bias",
    "accelerometer scale",
    "gyroscope scale",
    "alignment",
    "accelerometer axes",
    "gyroscope axes",
)
"""Errors of an IMU, three parameters each [rad/s, m/s^2, 1, 1, rad, rad, rad]; axes are the elements xy, xz, yz of U."""

GYROSCOPE_BIAS, ACCELEROMETER_BIAS, ACCELEROMETER_SCALE, GYROSCOPE_SCALE, ALIGNMENT, ACCELEROMETER_AXES, GYROSCOPE_AXES = range(
    0, 21, 3
)
ERRORS = 3 * len(ERROR_NAMES)


@kernel
def _turned_back(errors: Array, x: Vector) -> Vector:
    """A vector seen from the mounted IMU: turned back by the alignment, to second order."""
    alignment = vector(errors[ALIGNMENT:])
    once = cross(alignment, x)
    return add(subtract(x, once), scale(0.5, cross(alignment, once)))


@kernel
def distort(errors: Array, sensor: int, ideal: Vector) -> Vector:
    """What a sensor without bias, 0 the gyroscope and 1 the accelerometer, makes of an ideal reading."""
    at, axes = (ACCELEROMETER_SCALE, ACCELEROMETER_AXES) if sensor else (GYROSCOPE_SCALE, GYROSCOPE_AXES)
    y0, y1, y2 = _turned_back(errors, ideal)
    return (
        y0 + errors[at] * y0 + errors[axes] * y1 + errors[axes + 1] * y2,
        y1 + errors[at + 1] * y1 + errors[axes + 2] * y2,
        y2 + errors[at + 2] * y2,
    )


def error_matrix(errors: Array, sensor: int) -> Array:
    """The matrix (3, 3) of `distort`."""
    return np.array([distort(errors, sensor, (x, y, z)) for x, y, z in np.eye(3)]).T


@kernel
def distort_jacobian(errors: Array, jacobian: Array) -> None:
    """Turn derivatives of ideal readings (6, 18) into those of an IMU with these errors."""
    for sensor in range(2):
        x, y, z = jacobian[3 * sensor], jacobian[3 * sensor + 1], jacobian[3 * sensor + 2]
        for j in range(jacobian.shape[1]):
            x[j], y[j], z[j] = distort(errors, sensor, (x[j], y[j], z[j]))


@kernel
def error_gradient(errors: Array, ideal: Array, m: int, gradient: Array) -> None:
    """Write the derivative (21,) of reading `m`, 0-5, of an IMU by its errors; `ideal` (6,) is what an ideal one reads."""
    gradient[:] = 0.0
    sensor, i = m // 3, m % 3
    at, axes = (ACCELEROMETER_SCALE, ACCELEROMETER_AXES) if sensor else (GYROSCOPE_SCALE, GYROSCOPE_AXES)
    y = _turned_back(errors, vector(ideal[3 * sensor :]))
    gradient[m] = 1.0
    gradient[at + i] = y[i]
    if i == 0:
        gradient[axes], gradient[axes + 1] = y[1], y[2]
        row = 1.0 + errors[at], errors[axes], errors[axes + 1]
    elif i == 1:
        gradient[axes + 2] = y[2]
        row = 0.0, 1.0 + errors[at + 1], errors[axes + 2]
    else:
        row = 0.0, 0.0, 1.0 + errors[at + 2]
    # A further turn of the alignment adds skew(y) of it, before scale and axes.
    gradient[ALIGNMENT], gradient[ALIGNMENT + 1], gradient[ALIGNMENT + 2] = cross(row, y)
