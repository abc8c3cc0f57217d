"""The whole-mechanism filter: an error-state extended Kalman filter on the platform's motion, with all IMUs.

The pose fixes every leg, so the platform's motion predicts every reading (`controller.estimation.readings`), and motion tells
the sensors' errors apart. Error state: of position, rotation (`R <- exp(skew(theta)) R`), velocity, angular velocity,
acceleration and angular acceleration (18), driven by white jerk, then for each IMU the first parameters of `ERROR_NAMES`, and
for a calibration the places of the joints (36) and the tilt of the base (2). An IMU reads

    rate  = (I + diag(scale) + U(axes)) R(-alignment) ideal + bias,   U upper triangular, R the rotation, the force likewise

With the platform's magnetometer, the last error is a constant offset of its heading, so that what iron is left does not turn a
pose that the other IMUs know better.

Samples are averaged over a window of 5 ms; an update takes its 42 scalars one after the other, spread over the cycles until
the next window is full, so that every cycle costs about the same. What is told of the motion is carried to the present by the
motion model. The Jacobian is taken at a motion low-passed over 30 ms: at the noisy one, the noise would be taken for
excitation, and the biases would drift at rest.
"""

import numpy as np

from controller.estimation.imu_errors import ACCELEROMETER_SCALE, ERRORS, distort, distort_jacobian, error_gradient
from controller.estimation.platform_filter import INNOVATION_LIMIT
from controller.estimation.readings import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    MOTION_STATES,
    RATE,
    READINGS,
    READINGS_SCRATCH,
    VELOCITY,
    predict_readings,
)
from controller.estimation.rig_jacobian import RIG_ERRORS, find_rig_jacobian, rig_state
from controller.rig import MagneticField
from controller.settings import FusionSettings
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.errors import UnknownNameError
from plant.mechanism import LEGS
from plant.pose import Array, rotate_by_vector

BLOCKS = {"gyroscopes": 3, "accelerometers": 6, "alignments": 15, "axes": ERRORS}
"""How many of an IMU's errors are estimated."""

ALL_ERRORS = IMU_COUNT * ERRORS
MOST_STATES = MOTION_STATES + ALL_ERRORS + RIG_ERRORS + 1
_ROWS = IMU_COUNT * READINGS

WINDOW_S = 0.005
_SMOOTHING_S = 0.03
_FIRST_SIGMAS = (0.01, 0.05, 0.1, 0.5, 5.0, 50.0)
"""Of the motion at the start: position [m], rotation [rad], and their derivatives."""

_OFFSET_LASTS_S = 100.0
"""Time in which the offset of the heading may change by as much as is not known of it at the start."""

_PREPARING_ROWS = 14
"""What prediction costs, in scalar updates."""

FILTER_PARAMETERS = np.dtype(
    [
        ("window", np.int64),
        ("errors", np.int64),
        ("rig", np.int64),
        ("states", np.int64),
        ("smoothing", np.float64),
        ("jerk", np.float64, 2),
        ("bias_walk", np.float64, 2),
        ("variance", np.float64, 2),
        ("prior", np.float64, (ALL_ERRORS + RIG_ERRORS, ALL_ERRORS + RIG_ERRORS)),
        ("floor", np.float64, 2),
        ("heading", np.int64),
        ("field_axes", np.float64, (3, 3)),
        ("heading_variance", np.float64),
        ("offset_variance", np.float64),
    ],
    align=True,
)
"""Samples of a window; estimated errors of an IMU, 0 for no filter, and of the rig; all states; time constant of the motion at
which the Jacobian is taken, infinite if that is set from outside; spectral densities of the platform's jerk (linear,
angular) and of the biases' walks (gyroscope, accelerometer); variances of one sample (rate, force); the covariance of the
errors; and the variances of position and rotation that are left because the rig's are not estimated. Then whether there is a
heading; in {1} the horizontal direction of the magnetic field, that across it and the vertical, and the axis about which a
small turn changes what the heading seems to be; and the variances of a sample's heading and of its offset.
"""

FILTER_STATE = np.dtype(
    [
        ("running", np.int64),
        ("time", np.float64),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("motion", np.float64, (4, 3)),
        ("low_passed", np.float64, (2, 4, 3)),
        ("smooth_motion", np.float64, (4, 3)),
        ("errors", np.float64, (IMU_COUNT, ERRORS)),
        ("rig", np.float64, RIG_ERRORS),
        ("covariance", np.float64, (MOST_STATES, MOST_STATES)),
        ("published_time", np.float64),
        ("published_position", np.float64, 3),
        ("published_rotation", np.float64, (3, 3)),
        ("published_motion", np.float64, (4, 3)),
        ("published_covariance", np.float64, (MOTION_STATES, MOTION_STATES)),
        ("sum", np.float64, (IMU_COUNT, READINGS)),
        ("sum_time", np.float64),
        ("samples", np.int64, IMU_COUNT),
        ("collected", np.int64),
        ("field", np.float64, 3),
        ("field_time", np.float64),
        ("field_used", np.int64),
        ("heading_offset", np.float64),
        ("sample", np.float64, (IMU_COUNT, READINGS)),
        ("sample_used", np.int64, IMU_COUNT),
        ("row", np.int64),
        ("update_step", np.int64),
        ("change", np.float64, MOST_STATES),
        ("gain", np.float64, MOST_STATES),
        ("turn", np.float64, 3),
        ("frame", np.float64, (3, 3)),
        ("predicted", np.float64, (IMU_COUNT, READINGS)),
        ("smooth_predicted", np.float64, (IMU_COUNT, READINGS)),
        ("jacobian", np.float64, (IMU_COUNT, READINGS, MOTION_STATES)),
        ("rig_jacobian", np.float64, (IMU_COUNT, READINGS, 8)),
        ("gradient", np.float64, ERRORS),
        ("mixed", np.float64, (3, MOTION_STATES)),
        ("readings_scratch", READINGS_SCRATCH),
    ],
    align=True,
)
"""State of the filter, whose update may be under way; `published` is what the last complete one has found.

Times are in seconds since the first cycle. `sum` collects the samples of a window, `sample` is the mean of the last one;
`row` is the next scalar to take, -1 when none is left. `rig` is by how much joints (2, 6, 3) and tilt (2) are off; the readings
of a leg's IMU depend on eight of these, its two joints and the tilt. `field` is the magnetometer's last sample, until it
has been taken.
"""


def filter_parameters(
    fusion: FusionSettings, rate: float, errors: str | None, covariance: Array | None, floor: Array | None = None,
    field: MagneticField | None = None, inflation: float | None = None,
) -> Record:  # fmt: skip
    """Constants of the filter.

    Args:
        fusion: settings.
        rate: samples per second [Hz].
        errors: a key of `BLOCKS`; None for no filter.
        covariance: (147, 147), of the errors that a calibration has left, or (185, 185), of joints and tilt, too, which are
            estimated then; None for what the settings say.
        floor: (2,) [m, rad], standard deviations of position and rotation that joints and tilt leave; None if they are exact.
        field: of the earth, for the platform's magnetometer; None without one.
        inflation: times the noise and the jerk; None for 1 with a covariance, and what the settings say without.

    Raises:
        UnknownNameError: no such block of errors.
    """
    if errors is not None and errors not in BLOCKS:
        raise UnknownNameError(f"no block of errors {errors!r}; there are {', '.join(BLOCKS)}")
    sigmas = np.repeat(
        [
            fusion.bias_sigma, fusion.accelerometer_bias_sigma, fusion.scale_sigma, fusion.scale_sigma, fusion.alignment_sigma,
            fusion.axes_sigma, fusion.axes_sigma,
        ],
        3,
    )  # fmt: skip
    prior, known = np.zeros((ALL_ERRORS + RIG_ERRORS,) * 2), np.diag(np.tile(sigmas**2, IMU_COUNT))
    if covariance is not None:
        known = covariance
    prior[: len(known), : len(known)] = known
    estimated = 0 if errors is None else BLOCKS[errors]
    if inflation is None:
        inflation = 1.0 if covariance is not None else fusion.noise_inflation
    jerk = inflation * np.array([fusion.platform_jerk, fusion.platform_angular_jerk])
    noise = inflation * np.array([fusion.mechanism_gyroscope_noise, fusion.mechanism_accelerometer_noise])
    parameters: Record = np.zeros((), FILTER_PARAMETERS)
    values = {
        "window": max(1, round(WINDOW_S * rate)),
        "errors": estimated,
        "rig": len(known) - ALL_ERRORS,
        "states": MOTION_STATES + IMU_COUNT * estimated + len(known) - ALL_ERRORS + (field is not None),
        "smoothing": _SMOOTHING_S,
        "jerk": jerk**2,
        "bias_walk": (fusion.bias_walk**2, fusion.accelerometer_bias_walk**2),
        "variance": noise**2 * rate / 2.0,
        "prior": prior,
        "floor": np.zeros(2) if floor is None else floor**2 / 3.0,
    }
    if field is not None:
        up, north = field.vectors
        values |= {
            "heading": 1,
            "field_axes": (north, np.cross(up, north), up - field.vertical / field.horizontal * north),
            "heading_variance": field.heading_variance(fusion, rate),
            "offset_variance": fusion.heading_sigma**2,
        }
    for name, value in values.items():
        parameters[name] = value
    return parameters


@kernel
def _rig_start(parameters: Record) -> int:
    return int(MOTION_STATES + IMU_COUNT * parameters.errors)


@kernel
def start_filter(parameters: Record, state: Record, time: float, position: Array, rotation: Array, twist: Array) -> None:
    """Start from a pose (3,), (3, 3) and twist (6,) at `time`."""
    p, f = parameters, state
    f.running = 1
    f.time = f.published_time = time
    f.position[:] = position
    f.rotation[:] = rotation
    f.motion[:] = 0.0
    for i in range(3):
        f.motion[VELOCITY, i] = twist[i]
        f.motion[RATE, i] = twist[3 + i]
    f.low_passed[:] = f.motion
    f.smooth_motion[:] = f.motion
    f.errors[:] = 0.0
    f.rig[:] = 0.0
    f.heading_offset = 0.0
    f.field_used = 0
    states, rig = p.states, _rig_start(p)
    for i in range(states):
        for j in range(states):
            f.covariance[i, j] = 0.0
    for block in range(6):
        for i in range(3):
            f.covariance[3 * block + i, 3 * block + i] = _FIRST_SIGMAS[block] ** 2
    for k in range(IMU_COUNT):
        for i in range(p.errors):
            for other in range(IMU_COUNT):
                for j in range(p.errors):
                    f.covariance[MOTION_STATES + k * p.errors + i, MOTION_STATES + other * p.errors + j] = p.prior[
                        k * ERRORS + i, other * ERRORS + j
                    ]
            for j in range(p.rig):
                covariance = p.prior[k * ERRORS + i, ALL_ERRORS + j]
                f.covariance[MOTION_STATES + k * p.errors + i, rig + j] = covariance
                f.covariance[rig + j, MOTION_STATES + k * p.errors + i] = covariance
    for i in range(p.rig):
        for j in range(p.rig):
            f.covariance[rig + i, rig + j] = p.prior[ALL_ERRORS + i, ALL_ERRORS + j]
    if p.heading != 0:
        f.covariance[states - 1, states - 1] = p.offset_variance
    f.row = -1
    f.collected = 0
    _publish(state)


@kernel
def accumulate_sample(state: Record, sample: Array, used: Array, time: float) -> None:
    """Add a calibrated sample (3, 7, 3) of the IMUs that are `used` (7,) to the window."""
    f = state
    if f.collected == 0:
        f.sum[:] = 0.0
        f.samples[:] = 0
        f.sum_time = 0.0
    f.collected += 1
    f.sum_time += time
    for k in range(IMU_COUNT):
        if used[k] == 0:
            continue
        f.samples[k] += 1
        for i in range(3):
            f.sum[k, i] += sample[0, k, i]
            f.sum[k, 3 + i] += sample[1, k, i]


@kernel
def accumulate_field(state: Record, field: Array, time: float) -> None:
    """Keep a calibrated sample (3,) of the platform's magnetometer for the next update."""
    f = state
    f.field[:] = field
    f.field_time = time
    f.field_used = 1


@kernel
def step_filter(parameters: Record, geometry: Record, state: Record) -> None:
    """The share of this cycle in the update; a new one begins when the window is full."""
    p, f = parameters, state
    if f.collected >= p.window:
        _begin_update(parameters, geometry, state)
    if f.row < 0:
        return
    f.update_step += 1
    whole = _PREPARING_ROWS + _ROWS
    last = min(max(-(-whole * f.update_step // p.window) - _PREPARING_ROWS, 0), _ROWS)
    while f.row < last:
        _update_scalar(parameters, state, f.row)
        f.row += 1
    if f.row == _ROWS:
        _end_update(parameters, state)


@kernel
def _begin_update(parameters: Record, geometry: Record, state: Record) -> None:
    p, f = parameters, state
    if f.row >= 0:
        # The windows have overtaken the update, which happens when cycles are missed.
        while f.row < _ROWS:
            _update_scalar(parameters, state, f.row)
            f.row += 1
        _end_update(parameters, state)
    time = f.sum_time / f.collected
    for k in range(IMU_COUNT):
        f.sample_used[k] = f.samples[k]
        for i in range(READINGS):
            f.sample[k, i] = f.sum[k, i] / max(f.samples[k], 1)
    f.collected = 0
    _predict(parameters, state, time - f.time)
    f.time = time
    f.change[:] = 0.0
    f.row = f.update_step = 0
    if f.field_used != 0:
        _update_heading(parameters, state)
    predict_readings(
        geometry, f.position, f.rotation, f.smooth_motion, True, f.smooth_predicted, f.jacobian, f.readings_scratch
    )
    predict_readings(geometry, f.position, f.rotation, f.motion, False, f.predicted, f.jacobian, f.readings_scratch)
    if p.errors > ACCELEROMETER_SCALE:
        for k in range(IMU_COUNT):
            distort_jacobian(f.errors[k], f.jacobian[k], f.mixed)
    if p.rig > 0:
        find_rig_jacobian(geometry, state)


@kernel
def _predict(parameters: Record, state: Record, period: float) -> None:
    """Carry motion and covariance on by `period` [s]."""
    p, f = parameters, state
    t, half = period, 0.5 * period * period
    x, c = f.motion, f.covariance
    for i in range(3):
        f.position[i] += t * x[VELOCITY, i] + half * x[ACCELERATION, i]
        f.turn[i] = t * x[RATE, i] + half * x[ANGULAR_ACCELERATION, i]
        x[VELOCITY, i] += t * x[ACCELERATION, i]
        x[RATE, i] += t * x[ANGULAR_ACCELERATION, i]
    rotate_by_vector(f.rotation, f.turn)
    share = t / (t + p.smoothing)
    for block in range(4):
        for i in range(3):
            f.low_passed[0, block, i] += share * (x[block, i] - f.low_passed[0, block, i])
            f.low_passed[1, block, i] += share * (f.low_passed[0, block, i] - f.low_passed[1, block, i])
            # Low-passed once and twice, these have one and two lags.
            f.smooth_motion[block, i] = 2.0 * f.low_passed[0, block, i] - f.low_passed[1, block, i]
    # theta+ = (I + skew(turn)) theta + t d_omega + t^2/2 d_alpha, first by rows and then by columns.
    states = p.states
    r0, r1, r2 = f.turn[0], f.turn[1], f.turn[2]
    for j in range(states):
        x0, x1, x2 = c[3, j], c[4, j], c[5, j]
        c[3, j] += r1 * x2 - r2 * x1
        c[4, j] += r2 * x0 - r0 * x2
        c[5, j] += r0 * x1 - r1 * x0
    for i in range(6):
        for j in range(states):
            c[i, j] += t * c[6 + i, j] + half * c[12 + i, j]
            c[6 + i, j] += t * c[12 + i, j]
    for i in range(states):
        x0, x1, x2 = c[i, 3], c[i, 4], c[i, 5]
        c[i, 3] += r1 * x2 - r2 * x1
        c[i, 4] += r2 * x0 - r0 * x2
        c[i, 5] += r0 * x1 - r1 * x0
        for j in range(6):
            c[i, j] += t * c[i, 6 + j] + half * c[i, 12 + j]
            c[i, 6 + j] += t * c[i, 12 + j]
    t3 = t * t * t
    for i in range(6):
        q = p.jerk[i // 3]
        v, a = 6 + i, 12 + i
        c[i, i] += q * t3 * t * t / 20.0
        c[v, v] += q * t3 / 3.0
        c[a, a] += q * t
        for first, second, value in ((i, v, q * t3 * t / 8.0), (i, a, q * t3 / 6.0), (v, a, q * t * t / 2.0)):
            c[first, second] += value
            c[second, first] += value
    for k in range(IMU_COUNT):
        for i in range(min(p.errors, ACCELEROMETER_SCALE)):
            at = MOTION_STATES + k * p.errors + i
            c[at, at] += p.bias_walk[i // 3] * t
    if p.heading != 0:
        c[states - 1, states - 1] += p.offset_variance * t / _OFFSET_LASTS_S
    # The updates take the matrix for symmetric.
    for i in range(states):
        for j in range(i):
            mean = 0.5 * (c[i, j] + c[j, i])
            c[i, j] = mean
            c[j, i] = mean


@kernel
def _update_scalar(parameters: Record, state: Record, row: int) -> None:
    """Take one scalar of the sample into covariance and change."""
    p, f = parameters, state
    k, m = row // READINGS, row % READINGS
    if f.sample_used[k] == 0:
        return
    sensor = m // 3
    states, start = p.states, MOTION_STATES + k * p.errors
    h, gain, change, c = f.jacobian[k, m], f.gain, f.change, f.covariance
    x = f.predicted[k]
    expected = distort(f.errors[k], sensor, x[3 * sensor], x[3 * sensor + 1], x[3 * sensor + 2])
    innovation = f.sample[k, m] - expected[m % 3] - f.errors[k, m]
    variance = p.variance[sensor] / f.sample_used[k]
    for i in range(states):
        gain[i] = 0.0
    for j in range(MOTION_STATES):
        weight = h[j]
        innovation -= weight * change[j]
        for i in range(states):
            gain[i] += weight * c[j, i]
    error_gradient(f.errors[k], f.smooth_predicted[k], m, f.gradient)
    for j in range(p.errors):
        weight = f.gradient[j]
        if weight != 0.0:
            innovation -= weight * change[start + j]
            for i in range(states):
                gain[i] += weight * c[start + j, i]
    first = 8 if p.rig == 0 else 0 if k < LEGS else 6
    for j in range(first, 8):
        weight, which = f.rig_jacobian[k, m, j], rig_state(k, j)
        at = _rig_start(p) + which
        innovation -= weight * (f.rig[which] + change[at])
        for i in range(states):
            gain[i] += weight * c[at, i]
    for j in range(MOTION_STATES):
        variance += h[j] * gain[j]
    for j in range(p.errors):
        variance += f.gradient[j] * gain[start + j]
    for j in range(first, 8):
        variance += f.rig_jacobian[k, m, j] * gain[_rig_start(p) + rig_state(k, j)]
    _correct(state, states, innovation, variance)


@kernel
def _correct(state: Record, states: int, innovation: float, variance: float) -> None:
    """Take a scalar into covariance and change; `gain` is the covariance with it."""
    gain, change, c = state.gain, state.change, state.covariance
    inverse = 1.0 / variance
    for i in range(states):
        weight = gain[i] * inverse
        change[i] += weight * innovation
        for j in range(states):
            c[i, j] -= weight * gain[j]


@kernel
def _update_heading(parameters: Record, state: Record) -> None:
    """Take the sample of the magnetometer, before all others: the angle about the vertical by which the field, turned into {1},
    is off its direction. An error of the rotation turns it by -axis^T theta, and the offset adds to it.
    """
    p, f = parameters, state
    f.field_used = 0
    c, gain, states = f.covariance, f.gain, p.states
    north, east, axis = p.field_axes[0], p.field_axes[1], p.field_axes[2]
    along = aside = turned = 0.0
    for i in range(3):
        in_base = f.rotation[i, 0] * f.field[0] + f.rotation[i, 1] * f.field[1] + f.rotation[i, 2] * f.field[2]
        along += north[i] * in_base
        aside += east[i] * in_base
        turned += axis[i] * f.motion[RATE, i]
    for i in range(states):
        gain[i] = c[states - 1, i] - axis[0] * c[3, i] - axis[1] * c[4, i] - axis[2] * c[5, i]
    variance = gain[states - 1] - axis[0] * gain[3] - axis[1] * gain[4] - axis[2] * gain[5] + p.heading_variance
    # The rotation is that at the time of the update.
    innovation = np.arctan2(aside, along) + (f.field_time - f.time) * turned - f.heading_offset
    bound = INNOVATION_LIMIT * np.sqrt(variance)
    _correct(state, states, min(max(innovation, -bound), bound), variance)


@kernel
def _end_update(parameters: Record, state: Record) -> None:
    """Put the change into the motion and the errors."""
    p, f = parameters, state
    f.row = -1
    for i in range(3):
        f.position[i] += f.change[i]
        f.turn[i] = f.change[3 + i]
        for block in range(4):
            f.motion[block, i] += f.change[6 + 3 * block + i]
    rotate_by_vector(f.rotation, f.turn)
    for k in range(IMU_COUNT):
        for i in range(p.errors):
            f.errors[k, i] += f.change[MOTION_STATES + k * p.errors + i]
    for i in range(p.rig):
        f.rig[i] += f.change[_rig_start(p) + i]
    if p.heading != 0:
        f.heading_offset += f.change[p.states - 1]
    _publish(state)


@kernel
def extrapolate(state: Record, time: float, position: Array, rotation: Array, twist: Array, acceleration: Array) -> None:
    """Carry what is known to `time`: write the pose (3,), (3, 3), twist (6,) and acceleration (6,)."""
    f = state
    t = time - f.published_time
    x = f.published_motion
    for i in range(3):
        position[i] = f.published_position[i] + t * (x[VELOCITY, i] + 0.5 * t * x[ACCELERATION, i])
        f.turn[i] = t * (x[RATE, i] + 0.5 * t * x[ANGULAR_ACCELERATION, i])
        twist[i] = x[VELOCITY, i] + t * x[ACCELERATION, i]
        twist[3 + i] = x[RATE, i] + t * x[ANGULAR_ACCELERATION, i]
        acceleration[i] = x[ACCELERATION, i]
        acceleration[3 + i] = x[ANGULAR_ACCELERATION, i]
        for j in range(3):
            rotation[i, j] = f.published_rotation[i, j]
    rotate_by_vector(rotation, f.turn)


@kernel
def extrapolate_covariance(parameters: Record, state: Record, time: float, covariance: Array) -> None:
    """Write the covariance (6, 6) of the pose carried to `time`, and add what the rig's errors leave that are not estimated."""
    p, f = parameters, state
    t = time - f.published_time
    half, c = 0.5 * t * t, f.published_covariance
    for i in range(6):
        for j in range(6):
            near = c[i, j] + t * c[i, 6 + j] + half * c[i, 12 + j]
            rate = c[6 + i, j] + t * c[6 + i, 6 + j] + half * c[6 + i, 12 + j]
            acceleration = c[12 + i, j] + t * c[12 + i, 6 + j] + half * c[12 + i, 12 + j]
            covariance[i, j] = near + t * rate + half * acceleration
        covariance[i, i] += p.jerk[i // 3] * t**5 / 20.0 + p.floor[i // 3]


@kernel
def _publish(state: Record) -> None:
    f = state
    f.published_time = f.time
    f.published_position[:] = f.position
    f.published_rotation[:] = f.rotation
    f.published_motion[:] = f.motion
    for i in range(MOTION_STATES):
        for j in range(MOTION_STATES):
            f.published_covariance[i, j] = f.covariance[i, j]
