"""The error model of an IMU: what it makes of an ideal reading, and the derivatives of that.

rate  = (I + diag(scale) + U(axes)) R(-alignment) ideal + bias,   U upper triangular, R the rotation, the force likewise
"""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array

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
def _turned_back(errors: Array, x0: float, x1: float, x2: float) -> tuple[float, float, float]:
    """A vector seen from the mounted IMU: turned back by the alignment, to second order."""
    a0, a1, a2 = errors[ALIGNMENT], errors[ALIGNMENT + 1], errors[ALIGNMENT + 2]
    c0, c1, c2 = a1 * x2 - a2 * x1, a2 * x0 - a0 * x2, a0 * x1 - a1 * x0
    return (
        x0 - c0 + 0.5 * (a1 * c2 - a2 * c1),
        x1 - c1 + 0.5 * (a2 * c0 - a0 * c2),
        x2 - c2 + 0.5 * (a0 * c1 - a1 * c0),
    )


@kernel
def distort(errors: Array, sensor: int, x0: float, x1: float, x2: float) -> tuple[float, float, float]:
    """What a sensor without bias, 0 the gyroscope and 1 the accelerometer, makes of an ideal reading."""
    scale, axes = (ACCELEROMETER_SCALE, ACCELEROMETER_AXES) if sensor else (GYROSCOPE_SCALE, GYROSCOPE_AXES)
    y0, y1, y2 = _turned_back(errors, x0, x1, x2)
    return (
        y0 + errors[scale] * y0 + errors[axes] * y1 + errors[axes + 1] * y2,
        y1 + errors[scale + 1] * y1 + errors[axes + 2] * y2,
        y2 + errors[scale + 2] * y2,
    )


def error_matrix(errors: Array, sensor: int) -> Array:
    """The matrix (3, 3) of `distort`."""
    return np.array([distort(errors, sensor, *axis) for axis in np.eye(3)]).T


@kernel
def distort_jacobian(errors: Array, jacobian: Array, mixed: Array) -> None:
    """Turn derivatives of ideal readings (6, 18) into those of an IMU with these errors."""
    for sensor in range(2):
        first = 3 * sensor
        for j in range(jacobian.shape[1]):
            mixed[0, j], mixed[1, j], mixed[2, j] = distort(
                errors, sensor, jacobian[first, j], jacobian[first + 1, j], jacobian[first + 2, j]
            )
        for i in range(3):
            for j in range(jacobian.shape[1]):
                jacobian[first + i, j] = mixed[i, j]


@kernel
def error_gradient(errors: Array, ideal: Array, m: int, gradient: Array) -> None:
    """Write the derivative (21,) of reading `m`, 0-5, of an IMU by its errors; `ideal` (6,) is what an ideal one reads."""
    gradient[:] = 0.0
    sensor, i = m // 3, m % 3
    first = 3 * sensor
    scale, axes = (ACCELEROMETER_SCALE, ACCELEROMETER_AXES) if sensor else (GYROSCOPE_SCALE, GYROSCOPE_AXES)
    y0, y1, y2 = _turned_back(errors, ideal[first], ideal[first + 1], ideal[first + 2])
    m0 = m1 = m2 = 0.0
    gradient[first + i] = 1.0
    if i == 0:
        gradient[scale], gradient[axes], gradient[axes + 1] = y0, y1, y2
        m0, m1, m2 = 1.0 + errors[scale], errors[axes], errors[axes + 1]
    elif i == 1:
        gradient[scale + 1], gradient[axes + 2] = y1, y2
        m1, m2 = 1.0 + errors[scale + 1], errors[axes + 2]
    else:
        gradient[scale + 2] = y2
        m2 = 1.0 + errors[scale + 2]
    # A further turn of the alignment adds skew(y) of it, before scale and axes.
    gradient[ALIGNMENT] = m1 * y2 - m2 * y1
    gradient[ALIGNMENT + 1] = m2 * y0 - m0 * y2
    gradient[ALIGNMENT + 2] = m0 * y1 - m1 * y0
