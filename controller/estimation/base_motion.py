"""How the base moves on the earth, by the IMU on it: its attitude and its heave, for targets in the level frame.

The level frame has the axes that {1} has while the base is level. The base's attitude B, which turns {1} to it, follows the
gyroscope less its bias b. B f, the specific force in the level frame, is gravity and the acceleration of the base. What tells
them apart is that a base in waves moves to and fro: across the vertical its place p is taken for that of an oscillator which
noise w drives,

    p'' + 2 D w0 p' + w0^2 p = w

A tilt of B by an angle u adds g u to p'', and grows by an error c of the bias. So the errors of an axis across the vertical are
a chain p' = v, v' = g u, u' = c, and a Kalman filter takes the equation of the oscillator for a measurement of them. Both axes
have the same covariance. The mean tilt is thus the one under which the base does not run away; this is exact sooner than
a mean of the force.

Nothing tells the heading. It is taken to be that at the start, with noise: the level frame keeps its heading while the base
yaws to and fro, and turns with a base that goes on turning.

The heave h is what the vertical force tells, less gravity and a bias. Noise of an accelerometer that is integrated twice grows
without limit at low frequencies. So the heave is taken for that of two oscillators in a row, of the mean period of the waves:

    h'' + 2 D w0 h' + w0^2 h = y,   y' + 2 D w0 y - z = w,   z' + w0^2 y = 0
"""

from math import pi

import numpy as np

from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import Mechanism
from plant.pose import Array, rotate_by_vector
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

_SWAY_FREQUENCY = 0.8
"""Of the oscillator across the vertical: a period of 8 s [rad/s]."""

_SWAY_DAMPING = 0.5

_SWAY = 0.1
"""Density of the noise that drives it: a place of 0.1 m RMS [m/s^2/sqrt(Hz)]."""

_HEAVE_DAMPING = 0.2

_HEAVE_SHARE = 0.25
"""RMS of the heave that is expected, as a share of the travel of a leg: more cannot be followed."""

_YAW = 2e-3
"""Density of a yaw to and fro, as noise of the heading [rad/sqrt(Hz)]."""

_BIAS_WALK = 3e-6
"""Of the gyroscope on the base, while nothing but a swaying vertical tells it [rad/s/sqrt(s)]."""

_FIRST_PLACE, _FIRST_SPEED, _FIRST_TILT = 0.3, 0.3, 0.03
"""Uncertainty of place, speed and tilt after the first sample [m, m/s, rad]."""

_TILT, _HEAVING = 4, 5
"""Number of states across the vertical: place, speed, tilt, bias; and along it: h, h', y, z and the accelerometer's bias."""

PARAMETERS = record_dtype(
    tilt_change=(np.float64, (_TILT, _TILT)),  # derivative of the errors across the vertical by themselves [1/s]
    tilt_noise=(np.float64, _TILT),  # spectral densities of what drives them
    tilt_row=(np.float64, _TILT),  # how w depends on them
    tilt_start=(np.float64, _TILT),  # variances at the start
    sway_variance=np.float64,  # spectral density of w
    rate_density=np.float64,  # of the gyroscope's noise [rad^2/s]
    yaw_variance=np.float64,  # spectral density of the heading's noise [rad^2 s]
    heaves=np.int64,  # whether the heave is estimated
    heave_change=(np.float64, (_HEAVING, _HEAVING)),  # as above, for the states along the vertical
    heave_noise=(np.float64, _HEAVING),
    heave_row=(np.float64, _HEAVING),  # how the force depends on them
    heave_start=(np.float64, _HEAVING),
    force_variance=np.float64,  # spectral density of the accelerometer's noise
    place=(np.float64, 3),  # of the IMU in {1} [m]
)
"""Constants."""

STATE = record_dtype(
    begun=np.int64,  # whether there is an attitude
    attitude=(np.float64, (3, 3)),  # B
    bias=(np.float64, 3),  # b [rad/s]
    position=(np.float64, 3),  # p in the level frame, across the vertical [m]
    velocity=(np.float64, 3),  # [m/s]
    tilt_covariance=(np.float64, (_TILT, _TILT)),
    heading_covariance=(np.float64, 3),  # of an angle, with its bias, and of the bias
    heave=(np.float64, _HEAVING),
    heave_covariance=(np.float64, (_HEAVING, _HEAVING)),
    turn=(np.float64, 3),  # from here on scratch
    tilt_gain=(np.float64, _TILT),
    tilt_work=(np.float64, (2, _TILT, _TILT)),
    heave_gain=(np.float64, _HEAVING),
    heave_work=(np.float64, (2, _HEAVING, _HEAVING)),
)
"""State."""


def base_motion_parameters(mechanism: Mechanism, fusion: FusionSettings, heave_period: float) -> Record:
    """The constants (dtype `PARAMETERS`) of a mechanism with limits, with the mean period of the heave [s], or 0 for none."""
    plant, stroke = mechanism.plant_parameters(), mechanism.require_limits().stroke
    gravity = float(np.linalg.norm(plant["gravity"]))
    spring, damper = _SWAY_FREQUENCY**2, 2.0 * _SWAY_DAMPING * _SWAY_FREQUENCY
    tilt = np.zeros((_TILT, _TILT))
    tilt[0, 1], tilt[1, 2], tilt[2, 3] = 1.0, gravity, 1.0
    rate_density, force_density = fusion.gyroscope_noise**2, fusion.mechanism_accelerometer_noise**2
    of_heave: dict[str, object] = {}
    if heave_period > 0.0:
        of_heave = _heave_parameters(2.0 * pi / heave_period, _HEAVE_SHARE * float(np.ptp(stroke, axis=1).min()), fusion)
    return filled(
        PARAMETERS,
        tilt_change=tilt,
        tilt_noise=(0.0, force_density, rate_density, _BIAS_WALK**2),
        tilt_row=(spring, damper, gravity, 0.0),
        tilt_start=(_FIRST_PLACE**2, _FIRST_SPEED**2, _FIRST_TILT**2, fusion.bias_sigma**2),
        sway_variance=_SWAY**2,
        rate_density=rate_density,
        yaw_variance=_YAW**2,
        place=plant["base_imu_position"],
        **of_heave,
    )


def _heave_parameters(frequency: float, size: float, fusion: FusionSettings) -> dict[str, object]:
    """Of two oscillators in a row with this frequency [rad/s] and heave, RMS [m], which begin with what they do on average."""
    spring, damper = frequency**2, 2.0 * _HEAVE_DAMPING * frequency
    change = np.zeros((_HEAVING, _HEAVING))
    change[0, 1] = 1.0
    change[1, :3] = -spring, -damper, 1.0
    change[2, 2:4] = -damper, 1.0
    change[3, 2] = -spring
    row = np.array([-spring, -damper, 1.0, 0.0, 1.0])
    drive, waves = np.array([0.0, 0.0, 1.0, 0.0]), change[:4, :4]
    # A C + C A^T + drive drive^T = 0 for unit noise, and then as much of it as makes that heave.
    unit = np.eye(4)
    stationary = np.linalg.solve(np.kron(waves, unit) + np.kron(unit, waves), -np.outer(drive, drive).ravel()).reshape(4, 4)
    density = size**2 / stationary[0, 0]
    return {
        "heaves": 1,
        "heave_change": change,
        "heave_noise": (0.0, 0.0, density, 0.0, fusion.accelerometer_bias_walk**2),
        "heave_row": row,
        "heave_start": (*np.diag(density * stationary), fusion.accelerometer_bias_sigma**2),
        "force_variance": fusion.mechanism_accelerometer_noise**2,
    }


@kernel
def follow_base(
    p: Record, s: Record, rate: Array, angular_acceleration: Array, force: Vector, up: Vector, gravity: float, t: float
) -> None:  # fmt: skip
    """Carry the motion of the base on by `t` [s], and correct it.

    Args:
        rate, angular_acceleration, force: (3,), of the base and its IMU in {1}; the force without the bias that the pose takes
            for known, as an error of the bias turns both, one against the other [rad/s, rad/s^2, m/s^2].
        up: the vertical in the level frame.
        gravity: [m/s^2].
    """
    b = s.attitude
    w = subtract(vector(rate), vector(s.bias))
    # The force where {1} has its origin, about which the base turns as far as anyone knows.
    arm = vector(p.place)
    felt = subtract(force, add(cross(vector(angular_acceleration), arm), cross(w, cross(w, arm))))
    if s.begun == 0:
        _start(p, s, felt, up)
        return
    _rotate(s, b, scale(t, rotate(b, w)))
    felt = rotate(b, felt)
    lift = dot(felt, up)
    across = subtract(felt, scale(lift, up))
    place = add(vector(s.position), scale(t, add(vector(s.velocity), scale(0.5 * t, across))))
    speed = add(vector(s.velocity), scale(t, across))
    _carry(p.tilt_change, p.tilt_noise, s.tilt_covariance, s.tilt_work, t)
    off = scale(-1.0, add(across, add(scale(p.tilt_row[0], place), scale(p.tilt_row[1], speed))))
    gain = s.tilt_gain
    _learn(s.tilt_covariance, _see(s.tilt_covariance, p.tilt_row, gain) + p.sway_variance / t, gain)
    for i in range(3):
        s.position[i] = place[i] + gain[0] * off[i]
        s.velocity[i] = speed[i] + gain[1] * off[i]
    tilt = cross(up, off)
    of_heading, of_turn = _heading_gains(p, s.heading_covariance, t)
    heading = scale(-0.5 * dot(up, (b[2, 1] - b[1, 2], b[0, 2] - b[2, 0], b[1, 0] - b[0, 1])), up)
    learned = rotate_back(b, add(scale(gain[3], tilt), scale(of_turn, heading)))
    for i in range(3):
        s.bias[i] -= learned[i]
    _rotate(s, b, add(scale(gain[2], tilt), scale(of_heading, heading)))
    if p.heaves != 0:
        _follow_heave(p, s, lift - gravity, t)


@kernel
def heave(p: Record, s: Record) -> tuple[float, float, float]:
    """The base's heave [m], with its rate and acceleration."""
    x, row = s.heave, p.heave_row
    return x[0], x[1], row[0] * x[0] + row[1] * x[1] + row[2] * x[2]


@kernel
def _start(p: Record, s: Record, felt: Vector, up: Vector) -> None:
    """The force is taken for gravity."""
    s.begun = 1
    for i in range(3):
        for j in range(3):
            s.attitude[i, j] = 1.0 if i == j else 0.0
    for i in range(_TILT):
        s.tilt_covariance[i, i] = p.tilt_start[i]
    for i in range(_HEAVING):
        s.heave_covariance[i, i] = p.heave_start[i]
    c = s.heading_covariance
    c[0], c[1], c[2] = p.tilt_start[2], 0.0, p.tilt_start[3]
    turn = cross(scale(1.0 / np.sqrt(dot(felt, felt)), felt), up)
    sine = np.sqrt(dot(turn, turn))
    _rotate(s, s.attitude, scale(np.arcsin(min(sine, 1.0)) / max(sine, 1e-12), turn))


@kernel
def _follow_heave(p: Record, s: Record, force: float, t: float) -> None:
    x, gain, work = s.heave, s.heave_gain, s.heave_work
    _carry(p.heave_change, p.heave_noise, s.heave_covariance, work, t)
    step, off = work[0], force
    for i in range(_HEAVING):
        gain[i] = 0.0
        for j in range(_HEAVING):
            gain[i] += step[i, j] * x[j]
    for i in range(_HEAVING):
        x[i] = gain[i]
        off -= p.heave_row[i] * x[i]
    _learn(s.heave_covariance, _see(s.heave_covariance, p.heave_row, gain) + p.force_variance / t, gain)
    for i in range(_HEAVING):
        x[i] += gain[i] * off


@kernel
def _heading_gains(p: Record, c: Array, t: float) -> tuple[float, float]:
    """Those of heading and bias for a sample of the heading."""
    c[0] += t * (2.0 * c[1] + t * c[2] + p.rate_density)
    c[1] += t * c[2]
    c[2] += t * _BIAS_WALK**2
    whole = c[0] + p.yaw_variance / t
    of_heading, of_bias = c[0] / whole, c[1] / whole
    c[2] -= of_bias * c[1]
    c[1] -= of_bias * c[0]
    c[0] -= of_heading * c[0]
    return of_heading, of_bias


@kernel
def _carry(change: Array, noise: Array, covariance: Array, work: Array, t: float) -> None:
    """Carry a covariance (n, n) on by `t` [s]; leaves the transition in `work[0]`, (2, n, n)."""
    size, (step, half) = len(noise), work
    for i in range(size):
        for j in range(size):
            step[i, j] = t * change[i, j] + (1.0 if i == j else 0.0)
    for i in range(size):
        for j in range(size):
            half[i, j] = 0.0
            for k in range(size):
                half[i, j] += step[i, k] * covariance[k, j]
    for i in range(size):
        for j in range(i + 1):
            total = t * noise[i] if i == j else 0.0
            for k in range(size):
                total += half[i, k] * step[j, k]
            covariance[i, j] = covariance[j, i] = total


@kernel
def _see(covariance: Array, row: Array, gain: Array) -> float:
    """Put the covariance (n,) with a scalar measurement into `gain`; returns the variance that the measurement has by it."""
    size, seen = len(gain), 0.0
    for i in range(size):
        gain[i] = 0.0
        for j in range(size):
            gain[i] += covariance[i, j] * row[j]
        seen += row[i] * gain[i]
    return float(seen)


@kernel
def _learn(covariance: Array, whole: float, gain: Array) -> None:
    """After `_see`: reduce the covariance (n, n) by a measurement with `whole` its variance, and turn `gain` into the gains."""
    size = len(gain)
    for i in range(size):
        for j in range(size):
            covariance[i, j] -= gain[i] * gain[j] / whole
    for i in range(size):
        gain[i] /= whole


@kernel
def _rotate(s: Record, rotation: Array, turn: Vector) -> None:
    s.turn[0], s.turn[1], s.turn[2] = turn
    rotate_by_vector(rotation, s.turn)
