"""How stable the loop is with its gains, from a model of few numbers: it takes milliseconds, and no library for design.

`controller.design.tuning` designs gains from the whole linearised loop. Here all drives are alike, gravity's stiffness is left
out, and leg filters are exact. With the mass matrix M of the lengths l, commands u lead to

    M l'' = k i - d l',   L i' = k (u - l') - (R - kappa R_nominal) i

The filter of the platform takes what its accelerometer reads beyond the acceleration that it expects, which lags, for a tilt,

    tilt = K / (s + K) (1 - lag) a / g,   K its gain after 10 s

and integrates the gyroscope by rectangles. The least squares of the pose spread both over all lengths.
"""

from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.imu_set import across, measured_rows
from controller.settings import ControlSettings, FusionSettings
from plant.imu import STANDARD_GRAVITY
from plant.imu_wiring import ALL_IMUS, PLATFORM_IMU
from plant.mechanism import Mechanism
from plant.mechanism.loads import force_constant, home_loads, moving_axes, point_jacobian
from plant.pose import Array

SENSITIVITY_LIMIT = 2.0
"""The sensitivity peak that `gough tune` allows."""

_NOTICED_PEAK = 3.0
"""The peak from which on a run says so; the presets stay below it from 250 Hz on."""

Complex = NDArray[np.complexfloating[Any, Any]]

_FREQUENCIES = 400
_SETTLED_S, _STEP_S, _TILT_SIGMA = 10.0, 0.01, 0.15
_RIGHT_ANGLE = np.pi / 2.0


def margin_remark(
    mechanism: Mechanism,
    control: ControlSettings,
    fusion: FusionSettings,
    rate: float,
    imus: Collection[int] = ALL_IMUS,
    magnetometer: bool = False,
) -> str:
    """What a user should know of gains that leave little stability, in a line; "" of others."""
    peak = sensitivity_peak(mechanism, control, fusion, rate, imus, magnetometer)
    if peak < _NOTICED_PEAK:
        return ""
    how = f"have a sensitivity peak of about {peak:.1f}, and tuned ones at most {SENSITIVITY_LIMIT:g}"
    return (
        f"the gains in [control] do not suit {mechanism.name!r} at {rate:g} Hz: they {how if peak < np.inf else 'oscillate'}; "
        "design them with 'gough tune'"
    )


def sensitivity_peak(
    mechanism: Mechanism,
    control: ControlSettings,
    fusion: FusionSettings,
    rate: float,
    imus: Collection[int] = ALL_IMUS,
    magnetometer: bool = False,
) -> float:
    """The largest singular value of the sensitivity over frequency, all loops closed, in cycles of 1 / `rate` [Hz]; infinite if
    the loop is unstable, 0 at a singular home.
    """
    loads = home_loads(mechanism)
    if loads is None:
        return 0.0
    s: Complex = 2j * np.pi * np.geomspace(0.05, 0.499 * rate, _FREQUENCIES)
    z, one = np.exp(s / rate), np.eye(mechanism.legs)
    p, constant = mechanism.plant_parameters(), force_constant(mechanism)
    resistance = float(p["motor.resistance"].mean() - p["drive.compensation"] * p["drive.nominal_resistance"])
    bodies = _by_matrix(s) * loads.masses + float(p["friction.viscous"].mean()) * one
    drives = constant**2 * np.linalg.inv(_by_matrix(float(p["motor.inductance"]) * s + resistance) * bodies + constant**2 * one)
    slope = control.derivative * rate
    pid = control.proportional + control.integral / rate / (z - 1.0) + slope * (1.0 - 1.0 / z)
    rows = measured_rows(mechanism, fusion, imus, magnetometer)
    # A command is held for a period.
    held = (1.0 - 1.0 / z) * rate / s**2
    loop = _by_matrix(pid * held) * (_estimate(mechanism, loads.jacobian, fusion, rows, rate, s) @ drives)
    # The phase of det(1 + L) falls by two right angles for each double integrator, and further turns are unstable poles.
    turns = np.unwrap(np.angle(np.linalg.det(one + loop))[::-1])
    integrators = 2 if control.integral > 0.0 else 1
    if abs(turns[0]) > _RIGHT_ANGLE or abs(turns[-1] + integrators * mechanism.legs * _RIGHT_ANGLE) > 2.0 * _RIGHT_ANGLE:
        return np.inf
    return float(np.linalg.norm(np.linalg.inv(one + loop), 2, axis=(1, 2)).max())


def _estimate(
    mechanism: Mechanism,
    jacobian: Array,
    fusion: FusionSettings,
    rows: Mapping[int, tuple[Array, Array]],
    rate: float,
    s: Complex,
) -> Complex:
    """From lengths to estimated lengths, (F, n, n) at frequencies s (F,) [rad/s], of IMUs with these `measured_rows`."""
    one, z, period = np.eye(mechanism.legs), np.exp(s / rate), 1.0 / rate
    if PLATFORM_IMU not in rows:
        return np.broadcast_to(one.astype(np.complex128), (len(s), *one.shape))
    moving, sideways = moving_axes(mechanism), across(mechanism, mechanism.up_in_base)
    whole = np.vstack([each for each, _ in rows.values()])[:, moving]
    # Of the platform's IMU, the tilt alone.
    weighted, sigmas = (each[: len(sideways)] for each in rows[PLATFORM_IMU])
    turns = weighted[:, moving] * sigmas[:, None]
    # How a tilt moves the pose, and how a move accelerates the platform's IMU across the vertical.
    spread = np.linalg.solve(whole.T @ whole, (turns / sigmas[:, None] ** 2).T)
    place = mechanism.require_home().rotation @ mechanism.plant["platform_imu_position"]
    felt = sideways @ point_jacobian(place)[:, moving] / np.linalg.norm(mechanism.plant["gravity"])
    gain, share = _tilt_gain(fusion) * period, min(1.0, period / fusion.acceleration_time)
    tilting = gain / (1.0 - (1.0 - gain) / z) * s**2
    expected = (1.0 - share / z / (1.0 - (1.0 - share) / z)) / (max(period, fusion.acceleration_time) * s) / z
    rectangles = s * period / (1.0 - 1.0 / z) - 1.0
    moved = one - _by_matrix(tilting) * (spread @ felt) + _by_matrix(rectangles) * (spread @ turns)
    pose = np.linalg.solve(one - _by_matrix(tilting * expected) * (spread @ felt), moved)
    found: Complex = jacobian @ pose @ np.linalg.inv(jacobian)
    return found


def _tilt_gain(fusion: FusionSettings) -> float:
    """The gain of the platform's filter on its accelerometer [1/s]: Kalman's, of the vertical and the gyroscope's bias."""
    predict = np.array([[1.0, _STEP_S], [0.0, 1.0]])
    noise = _STEP_S * np.diag([fusion.gyroscope_noise**2, fusion.bias_walk**2])
    variance = (fusion.platform_accelerometer_noise / STANDARD_GRAVITY) ** 2 / (2.0 * _STEP_S)
    covariance, gain = np.diag([_TILT_SIGMA**2, fusion.bias_sigma**2]), np.zeros(2)
    for _ in range(round(_SETTLED_S / _STEP_S)):
        covariance = predict @ covariance @ predict.T + noise
        gain = covariance[:, 0] / (covariance[0, 0] + variance)
        covariance -= np.outer(gain, covariance[0])
    return float(gain[0] / _STEP_S)


def _by_matrix(values: Complex) -> Complex:
    """Values (F,) as factors of matrices (F, n, n)."""
    return values[:, None, None]
