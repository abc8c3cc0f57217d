"""Calibration of a magnetometer by hand: it is turned slowly in all directions, in the earth's field alone.

The calibrated field is as strong as the earth's in every orientation. So the raw field lies on an ellipsoid: its centre is the
hard iron, its axes are the soft iron, nine constants in the form of the paper's (37). They leave open how the magnetometer's
axes are turned against the accelerometer's. The angle between field and vertical, which gives the dip, is constant too and
determines these three.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from controller.calibration.single_imu import deviations_of, missing_half_axes
from plant.errors import CalibrationError
from plant.pose import Array

LEAST_SAMPLES = 100
_MOST_ACCELERATION = 0.02  # share of gravity by which the length of a force may be off for it to count as a vertical
_MOST_RESIDUAL = 0.05
_LARGEST_CONDITION = 1e3


@dataclass(frozen=True, eq=False)
class MagnetometerCalibration:
    """The constants of one magnetometer: calibrated = gain @ raw + offset."""

    gain: Array  # (3, 3), upper triangular without an accelerometer
    offset: Array  # (3,) [uT]
    sigmas: Array  # (12,), standard deviations of offset and gain, row by row
    samples: int  # repeated ones count once
    field_residual: float  # RMS of the strength of the field [uT]
    dip: float | None  # of the field below the horizontal plane [rad]; None without an accelerometer
    dip_residual: float | None  # RMS [rad]; None without an accelerometer


def calibrate_magnetometer(fields: Array, forces: Array | None, strength: float, gravity: float) -> MagnetometerCalibration:
    """Find the constants of a magnetometer.

    Args:
        fields: (N, 3), raw [uT].
        forces: (N, 3), of the calibrated accelerometer [m/s^2]; None without one.
        strength: of the local field [uT].
        gravity: local gravity [m/s^2].

    Raises:
        CalibrationError: the data do not determine the constants; the message says what is missing.
    """
    fresh = np.append(True, np.any(np.diff(fields, axis=0) != 0.0, axis=1))
    fields = fields[fresh]
    if len(fields) < LEAST_SAMPLES:
        raise CalibrationError(
            f"there are {len(fields)} samples of the field; at least {LEAST_SAMPLES} are needed: turn it longer"
        )
    if forces is None:
        still, verticals = np.zeros(len(fields), bool), np.zeros((0, 3))
    else:
        lengths = np.linalg.norm(forces[fresh], axis=1)
        still = np.abs(lengths - gravity) < _MOST_ACCELERATION * gravity
        verticals = forces[fresh][still] / lengths[still, None]
        if len(verticals) < LEAST_SAMPLES:
            raise CalibrationError(
                f"the force is within {100.0 * _MOST_ACCELERATION:g} % of gravity in {len(verticals)} samples; at least "
                f"{LEAST_SAMPLES} are needed: turn it slowly, and calibrate the accelerometer first ('gough calibrate imu')"
            )
    return _fit(fields, still, verticals, strength)


def _fit(fields: Array, still: Array, verticals: Array, strength: float) -> MagnetometerCalibration:
    """The constants by least squares; `verticals` (n, 3) belong to the samples that are `still` (N,)."""
    rows, columns = np.triu_indices(3) if not len(verticals) else np.indices((3, 3)).reshape(2, 9)

    def gain_of(x: Array) -> Array:
        gain = np.zeros((3, 3))
        gain[rows, columns] = x[3 : 3 + len(rows)]
        return gain

    def residuals(x: Array) -> Array:
        calibrated = fields @ gain_of(x).T + x[:3]
        along = np.sum(calibrated[still] * verticals, axis=1)
        errors: Array = np.concatenate([np.linalg.norm(calibrated, axis=1) - strength, along - x[-1]])
        return errors

    center = 0.5 * (fields.min(axis=0) + fields.max(axis=0))
    scale = strength / np.linalg.norm(fields - center, axis=1).mean()
    start = np.concatenate([-scale * center, scale * np.eye(3)[rows, columns]])
    if len(verticals):
        start = np.append(start, scale * np.mean(np.sum((fields[still] - center) * verticals, axis=1)))
    sizes = np.repeat([1.0, 1.0 / strength, 1.0], [3, len(rows), len(start) - 3 - len(rows)])
    fit = least_squares(residuals, start, method="lm", x_scale=sizes)
    gain, offset = gain_of(fit.x), fit.x[:3]
    _check(fields @ gain.T + offset, strength)
    if not fit.success or np.linalg.cond(fit.jac * sizes) > _LARGEST_CONDITION:
        raise CalibrationError("the orientations are too much alike: turn it about other axes, too")
    deviations = deviations_of(fit.jac, fit.fun, len(fit.fun) - len(fit.x))
    field_errors, dip_errors = np.split(fit.fun, [len(fields)])
    return MagnetometerCalibration(
        gain=gain,
        offset=offset,
        sigmas=np.concatenate([deviations[:3], gain_of(deviations).ravel()]),
        samples=len(fields),
        field_residual=float(np.sqrt(np.mean(field_errors**2))),
        dip=float(-np.arcsin(np.clip(fit.x[-1] / strength, -1.0, 1.0))) if len(verticals) else None,
        dip_residual=float(np.sqrt(np.mean(dip_errors**2))) / strength if len(verticals) else None,
    )


def _check(calibrated: Array, strength: float) -> None:
    """Check that the field (N, 3) was along every half-axis at some time, and equally strong all the time."""
    if missing := missing_half_axes(calibrated / strength):
        raise CalibrationError(f"the field was never along {', '.join(missing)}: turn it until it has been")
    residual = float(np.sqrt(np.mean((np.linalg.norm(calibrated, axis=1) - strength) ** 2)))
    if residual > _MOST_RESIDUAL * strength:
        raise CalibrationError(
            f"the field's strength is off by {residual:.2g} uT RMS, {100.0 * residual / strength:.0f} %; at most "
            f"{100.0 * _MOST_RESIDUAL:g} % is allowed: turn it on the spot, away from iron, magnets and currents"
        )
