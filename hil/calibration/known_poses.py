"""Calibration of the mounting by known poses: it compares measured and planned orientations (the paper's section 7)."""

from collections.abc import Sequence

import numpy as np

from controller.calibration.at_rest import expected_forces, undo
from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.imu_errors import ACCELEROMETER_BIAS, ALIGNMENT, ERRORS, GYROSCOPE_BIAS
from controller.rig import sensor_geometry
from hil.calibration.data import CalibrationData
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import CalibrationError
from plant.imu import STANDARD_GRAVITY

_POSE_SIGMA = np.radians(0.3)
"""Standard deviation of the orientations of legs and platform from the planned ones [rad]."""


def calibrate_by_known_poses(data: CalibrationData, runs: Sequence[Record]) -> Calibration:
    """The mounting and the accelerometers' bias from the planned poses at rest, with the gyroscopes zeroed.

    Raises:
        CalibrationError: there is no rest.
    """
    forces, lengths = [], []
    for records in runs:
        for rest in data.rests_in(records):
            forces.append(records["specific_force"][rest].mean(axis=0))
            lengths.append(records["reference"][rest, :, 0].mean(axis=0))
    if not forces:
        raise CalibrationError("no rest was found: at known poses the rig must rest for a second or longer")
    geometry = sensor_geometry(data.mechanism)
    planned = zip(*data.planned_poses(np.array(lengths)), strict=True)
    expected = np.array([expected_forces(geometry, position, rotation) for position, rotation in planned])
    sigmas = data.knowledge.prior.error_sigmas().reshape(IMU_COUNT, ERRORS)
    errors, covariance = np.zeros((IMU_COUNT, ERRORS)), np.diag(sigmas.ravel() ** 2)
    sought = [*range(ACCELEROMETER_BIAS, ACCELEROMETER_BIAS + 3), *range(ALIGNMENT, ALIGNMENT + 3)]
    weight = 1.0 / (_POSE_SIGMA * STANDARD_GRAVITY) ** 2
    for imu in range(IMU_COUNT):
        # R(-alignment) f is about f + f x alignment.
        rows = np.vstack([np.hstack([np.eye(3), np.cross(force, np.eye(3)).T]) for force in expected[:, imu]])
        residuals = (np.array(forces) - expected)[:, imu].ravel()
        inverse = np.linalg.inv(weight * rows.T @ rows + np.diag(1.0 / sigmas[imu, sought] ** 2))
        errors[imu, sought] = weight * inverse @ rows.T @ residuals
        places = ERRORS * imu + np.array(sought)
        covariance[np.ix_(places, places)] = inverse
    errors[:, GYROSCOPE_BIAS : GYROSCOPE_BIAS + 3] = data.zero
    return Calibration().then(*undo(errors), covariance=covariance)
