"""Calibration of a single IMU by hand: it rests in many orientations and is turned from one to the next, without equipment.

At rest the calibrated force has the length of gravity in every orientation. That determines nine constants of the
accelerometer: bias, scale and axes (the multi-position method of the paper's reference 31). Between two rests, the gyroscope
must turn one vertical into the other. That determines nine more, in the accelerometer's frame. The gyroscope's bias is its
reading at rest.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import least_squares

from plant.compiled import kernel
from plant.errors import CalibrationError
from plant.pose import Array, rotate_by_vector

LEAST_RESTS = 9
_WINDOW_S = 0.1
_SHORTEST_REST_S = 0.5
_MARGIN_S = 0.1
_MOST_RATE = np.radians(1.0)
_MOST_SPREAD = 5.0
_LEAST_SHARE = 0.75  # component of a unit vector along each half-axis, at some time
_LEAST_TURN = np.pi  # sum of the turns about each axis [rad]
_LARGEST_CONDITION = 1e3
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")


@dataclass(frozen=True, eq=False)
class ImuCalibration:
    """The constants of one IMU, by sensor (gyroscope, accelerometer): calibrated = gain @ raw + offset."""

    gain: Array  # (2, 3, 3), the accelerometer's upper triangular
    offset: Array  # (2, 3) [rad/s, m/s^2]
    sigmas: Array  # (2, 12), standard deviations of offset and gain, row by row
    rests: int
    force_residual: float  # RMS of the length of gravity at rest [m/s^2]
    turn_residual: float  # RMS of the angle between the verticals after a turn [rad]


def calibrate_imu(times: Array, rates: Array, forces: Array, gravity: float) -> ImuCalibration:
    """Find the constants of an IMU.

    Args:
        times: (N,) [s], evenly spaced.
        rates, forces: (N, 3), raw [rad/s, m/s^2]; they begin with a rest.
        gravity: local gravity [m/s^2].

    Raises:
        CalibrationError: the data do not determine the constants; the message says which rest or turn is missing.
    """
    period = float(np.median(np.diff(times)))
    rests = _find_rests(rates, forces, period)
    if len(rests) < LEAST_RESTS:
        raise CalibrationError(
            f"there are {len(rests)} rests of at least {_SHORTEST_REST_S:g} s; at least {LEAST_RESTS} in other orientations "
            "are needed, beginning with one"
        )
    at_rest = np.array([forces[rest].mean(axis=0) for rest in rests])
    force_gain, force_offset, force_sigmas, force_residual = _fit_forces(at_rest, gravity)
    verticals = at_rest @ force_gain.T + force_offset
    _check_orientations(verticals, gravity)
    verticals /= np.linalg.norm(verticals, axis=1, keepdims=True)
    bias = np.array([rates[rest].mean(axis=0) for rest in rests])
    _check_turns(rates, bias, rests, period)
    rate_gain, rate_sigmas, turn_residual = _fit_turns(rates, bias, rests, verticals, period)
    return ImuCalibration(
        gain=np.stack([rate_gain, force_gain]),
        offset=np.stack([-rate_gain @ bias.mean(axis=0), force_offset]),
        sigmas=np.stack([rate_sigmas, force_sigmas]),
        rests=len(rests),
        force_residual=force_residual,
        turn_residual=turn_residual,
    )


def _find_rests(rates: Array, forces: Array, period: float) -> list[slice]:
    """Stretches in which rates and forces change no more than by the noise of the first half second."""
    length = max(2, round(_WINDOW_S / period))
    count = len(rates) // length
    first = max(1, round(_SHORTEST_REST_S / _WINDOW_S))
    if count < first:
        return []
    rate_windows, force_windows = (each[: count * length].reshape(count, length, 3) for each in (rates, forces))
    spread = force_windows.std(axis=1).max(axis=1)
    zero = rate_windows[:first].mean(axis=(0, 1))
    turning = np.abs(rate_windows.mean(axis=1) - zero).max(axis=1)
    still = (turning < _MOST_RATE) & (spread < _MOST_SPREAD * max(float(spread[:first].max()), 1e-6))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int))).reshape(-1, 2)
    margin = round(_MARGIN_S / period)
    return [
        slice(start * length + margin, stop * length - margin)
        for start, stop in edges.tolist()
        if (stop - start) * length * period >= _SHORTEST_REST_S
    ]


def _fit_forces(at_rest: Array, gravity: float) -> tuple[Array, Array, Array, float]:
    """Gain (3, 3), offset (3,), their standard deviations (12,) and the residual, from mean forces (n, 3)."""

    def gain_of(x: Array) -> Array:
        gain = np.zeros((3, 3))
        gain[np.triu_indices(3)] = x[3:]
        return gain

    def residuals(x: Array) -> Array:
        lengths: Array = np.linalg.norm(at_rest @ gain_of(x).T + x[:3], axis=1)
        return lengths - gravity

    start = np.concatenate([np.zeros(3), np.eye(3)[np.triu_indices(3)]])
    fit = least_squares(residuals, start, method="lm", x_scale=np.repeat([1.0, 0.1], [3, 6]))
    scaled = fit.jac * np.repeat([1.0, 1.0 / gravity], [3, 6])
    if not fit.success or np.linalg.cond(scaled) > _LARGEST_CONDITION:
        _check_orientations(at_rest, gravity)
        raise CalibrationError("the orientations at rest are too much alike: rest in more of them, also askew")
    deviations = deviations_of(fit.jac, fit.fun, max(len(at_rest) - 9, 1))
    sigmas = np.concatenate([deviations[:3], gain_of(deviations).ravel()])
    return gain_of(fit.x), fit.x[:3], sigmas, float(np.sqrt(np.mean(fit.fun**2)))


def deviations_of(jacobian: Array, residuals: Array, freedom: int) -> Array:
    """Standard deviations (n,) of the unknowns of a least-squares fit, from the size of its residuals."""
    variance = float(residuals @ residuals) / freedom
    deviations: Array = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)) * variance)
    return deviations


def _check_orientations(forces: Array, gravity: float) -> None:
    """Check that gravity is along every half-axis in some rest."""
    if missing := missing_half_axes(forces / gravity):
        raise CalibrationError(f"no rest has {', '.join(missing)} up: rest in these orientations too")


def missing_half_axes(vectors: Array) -> list[str]:
    """The half-axes, such as "+x", that no unit vector of (n, 3) is near."""
    along = np.concatenate([vectors.max(axis=0), -vectors.min(axis=0)]).reshape(2, 3).T.ravel()
    return [name for name, share in zip(_AXES, along, strict=True) if share < _LEAST_SHARE]


def _check_turns(rates: Array, bias: Array, rests: list[slice], period: float) -> None:
    """Check that the IMU was turned about every axis."""
    moving = np.concatenate([rates[a.stop : b.start] for a, b in pairwise(rests)])
    turned = np.abs(moving - bias.mean(axis=0)).sum(axis=0) * period
    missing = {name: f"{np.degrees(angle):.0f} deg" for name, angle in zip("xyz", turned, strict=True) if angle < _LEAST_TURN}
    if missing:
        raise CalibrationError(
            f"it was turned by too little about {', '.join(missing)} ({', '.join(missing.values())} in all; "
            f"{np.degrees(_LEAST_TURN):.0f} deg are needed): turn it about that axis between two rests, while it is not upright"
        )


def _fit_turns(rates: Array, bias: Array, rests: list[slice], verticals: Array, period: float) -> tuple[Array, Array, float]:
    """Gain (3, 3), standard deviations (12,) of offset and gain, and the residual [rad]."""
    middles = [(rest.start + rest.stop) // 2 for rest in rests]
    parts = list(pairwise(middles))
    # The bias drifts: between two rests it is the mean of theirs.
    unbiased = [rates[a:b] - 0.5 * (bias[i] + bias[i + 1]) for i, (a, b) in enumerate(parts)]

    def residuals(x: Array) -> Array:
        gain, found = x.reshape(3, 3), []
        for i, part in enumerate(unbiased):
            found.append(_turn(np.ascontiguousarray(part @ gain.T), period) @ verticals[i] - verticals[i + 1])
        return np.concatenate(found)

    fit = least_squares(residuals, np.eye(3).ravel(), method="lm")
    if not fit.success or np.linalg.cond(fit.jac) > _LARGEST_CONDITION:
        raise CalibrationError("the turns are too much alike: turn it about each of its axes between rests")
    deviations = deviations_of(fit.jac, fit.fun, max(2 * len(parts) - 9, 1))
    offset = bias.std(axis=0) / np.sqrt(len(bias))
    return fit.x.reshape(3, 3), np.concatenate([offset, deviations]), float(np.sqrt(np.mean(fit.fun**2) * 1.5))


@kernel
def _turn(rates: Array, period: float) -> Array:
    """The rotation (3, 3) that carries a vector at rest, seen from a sensor, through its rates (N, 3) [rad/s]."""
    rotation, step = np.eye(3), np.zeros(3)
    for i in range(rates.shape[0] - 1):
        for j in range(3):
            # Seen from the sensor, the world turns the other way.
            step[j] = -0.5 * period * (rates[i, j] + rates[i + 1, j])
        rotate_by_vector(rotation, step)
    return rotation
