"""The IMUs' calibration in the cycle: the paper's (37), `a_cal = T S (a_u + b)`, for every raw sample.

`controller.calibration` finds the constants and keeps them in a file.
"""

from plant.compiled import kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array


@kernel
def calibrate_reading(gain: Array, offset: Array, reading: Array, calibrated: Array) -> None:
    """Write the calibrated reading (3,) of a raw one (3,): gain (3, 3) times that, plus offset (3,)."""
    for i in range(3):
        total = offset[i]
        for j in range(3):
            total += gain[i, j] * reading[j]
        calibrated[i] = total


@kernel
def calibrate_samples(gain: Array, offset: Array, measurement: Array, sample: Array) -> None:
    """Write the calibrated samples (3, 7, 3) of a raw measurement (3, 7, 3) [rad/s, m/s^2, uT].

    Args:
        gain: (3, 7, 3, 3), T S and the mounting of each sensor.
        offset: (3, 7, 3), T S b [rad/s, m/s^2, uT].
    """
    for kind in range(3):
        for k in range(IMU_COUNT):
            calibrate_reading(gain[kind, k], offset[kind, k], measurement[kind, k], sample[kind, k])
