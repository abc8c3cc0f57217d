"""The whole-mechanism filter: an error-state extended Kalman filter on the platform's motion, with all IMUs.

The pose fixes every leg, so the platform's motion predicts every reading (`readings`), and motion tells
the sensors' errors apart. Error state: of position, rotation (`R <- exp(skew(theta)) R`), velocity, angular velocity,
acceleration and angular acceleration (18), driven by white jerk, then for each IMU the first parameters of `ERROR_NAMES`, and
for a calibration the places of the joints (36) and the tilt of the base (2). An IMU reads

    rate  = (I + diag(scale) + U(axes)) R(-alignment) ideal + bias,   U upper triangular, R the rotation, the force likewise

With an IMU on the base, all other samples are less what it reads (`base_imu`). Its biases are six more states, and so is its
noise in a window: all rows of an update share it, and the next window has another.

With the platform's magnetometer, the last error is a constant offset of its heading, so that what iron is left does not turn a
pose that the other IMUs know better.

Samples are averaged over a window of 5 ms; an update takes its 42 scalars one after the other, spread over the cycles until
the next window is full, so that every cycle costs about the same. What is told of the motion is carried to the present by the
motion model. The Jacobian is taken at a motion low-passed over 30 ms, and at rest while that is within its own uncertainty: at
the noisy one, the noise would be taken for excitation, and what rest does not tell of the errors would drift.
"""

import numpy as np

from controller.estimation.leg_filter import add_jerk
from controller.estimation.platform_filter import cut_innovation, take_scalar
from controller.estimation.whole_mechanism.imu_errors import (
    ACCELEROMETER_SCALE,
    ERRORS,
    distort,
    distort_jacobian,
    error_gradient,
)
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS, ROWS, base_start, lengths_start, rig_start, rows_of
from controller.estimation.whole_mechanism.readings import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    MOTION_STATES,
    RATE,
    READINGS,
    VELOCITY,
    find_frames,
    find_rig_jacobian,
    predict_readings,
    rig_state,
)
from plant.compiled import Record, kernel, shared_kernel
from plant.dynamics.variables import IMU_COUNT
from plant.imu import ACCELEROMETER
from plant.mechanism import LEGS
from plant.pose import Array, rotate_by_vector
from plant.vectors import add, cross, dot, rotate, rotate_back, scale, subtract, vector

_FIRST_SIGMAS = (0.01, 0.05, 0.1, 0.5, 5.0, 50.0)
"""Uncertainty of the motion at the start: position [m] and rotation [rad] as all IMUs tell them, and their derivatives."""

_PREPARING_ROWS = 14
"""What prediction costs, in scalar updates."""

_REST_SIGMAS = 3.0
"""Within how many standard deviations of none a motion counts as none."""

_STANDING = 1e-3
"""How fast a platform may move whose brakes hold, as far as one window tells [m/s, rad/s]."""

_PLAY_LASTS_S = 0.5
"""Time constant of what play does to an encoder's reading [s]."""

_SWITCH_SIGMAS = 5.0
"""A home switch that contradicts what is known of its encoder's zero by more is not taken: it may be elsewhere than is said."""

_LONGEST_CHANGE_S = 0.1
"""Beyond this time between two updates, how fast the readings change is not known [s]."""

_OFFSET_LASTS_S = 100.0
"""Time in which the offset of the heading may change by as much as its uncertainty at the start [s]."""


@shared_kernel
def start_filter(p: Record, f: Record, time: float, position: Array, rotation: Array, twist: Array) -> None:
    """Start from a pose (3,), (3, 3) and twist (6,) at `time`."""
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
    f.length_errors[:] = 0.0
    f.length_sum[:] = 0.0
    f.length_sum_time[:] = 0.0
    f.length_count[:] = 0.0
    f.length_passed[:] = 0
    f.base_errors[:] = 0.0
    states, rig = p.states, rig_start(p)
    for i in range(states):
        for j in range(states):
            f.covariance[i, j] = 0.0
    for i in range(MOTION_STATES):
        f.covariance[i, i] = ((p.start_share if i < 6 else 1.0) * _FIRST_SIGMAS[i // 3]) ** 2
    for k in range(IMU_COUNT):
        for i in range(p.errors):
            at, known = MOTION_STATES + k * p.errors + i, p.prior[k * ERRORS + i]
            for other in range(IMU_COUNT):
                for j in range(p.errors):
                    f.covariance[at, MOTION_STATES + other * p.errors + j] = known[other * ERRORS + j]
            for j in range(p.rig):
                f.covariance[at, rig + j] = f.covariance[rig + j, at] = known[ALL_ERRORS + j]
    for i in range(p.rig):
        for j in range(p.rig):
            f.covariance[rig + i, rig + j] = p.prior[ALL_ERRORS + i, ALL_ERRORS + j]
    for i in range(p.lengths):
        at = lengths_start(p) + i
        f.covariance[at, at] = p.length_prior[i // LEGS]
    for i in range(p.base):
        at = base_start(p) + i
        f.covariance[at, at] = p.base_prior[i // 3]
    if p.heading != 0:
        f.covariance[states - 1, states - 1] = p.offset_variance
    f.row = -1
    f.collected = 0
    _publish(f)


@kernel
def accumulate_sample(f: Record, sample: Array, weights: Array, time: float) -> None:
    """Add a calibrated sample (3, 7, 3) to the window, with the weight of each sensor (2, 7): 1 for noise alone, 0 for none."""
    if f.collected == 0:
        f.sum[:] = 0.0
        f.weight[:] = 0.0
        f.sum_time = 0.0
    f.collected += 1
    f.sum_time += time
    for sensor in range(2):
        for k in range(IMU_COUNT):
            weight = weights[sensor, k]
            if weight == 0.0:
                continue
            f.weight[sensor, k] += weight
            for i in range(3):
                f.sum[k, 3 * sensor + i] += weight * sample[sensor, k, i]


@kernel
def start_lengths(f: Record, zeros: Array) -> None:
    """Take what is known of the encoders' zeros (6,) [m] at the start."""
    for k in range(LEGS):
        f.length_errors[0, k] = zeros[k]


@kernel
def accumulate_lengths(f: Record, readings: Array, used: Array, time: float) -> None:
    """Add the encoders' readings (6,) [m] to the window, as far as they are `used` (6,)."""
    for k in range(LEGS):
        if used[k] != 0.0:
            f.length_sum[k] += readings[k]
            f.length_sum_time[k] += time
            f.length_count[k] += 1.0


@kernel
def accumulate_switch(f: Record, k: int, more: float, step: float) -> None:
    """Keep for the next update what the encoder of leg `k` has read `more` than the length, somewhere within a `step` [m]."""
    f.length_passed[k], f.length_switched[k], f.length_switched_variance[k] = 1, more, step * step / 12.0


@kernel
def accumulate_field(f: Record, field: Array, time: float) -> None:
    """Keep a calibrated sample (3,) of the platform's magnetometer for the next update."""
    f.field[:] = field
    f.field_time = time
    f.field_used = 1


@shared_kernel
def step_filter(p: Record, geometry: Record, f: Record) -> None:
    """The share of this cycle in the update; a new one begins when the window is full."""
    if f.collected >= p.window:
        _begin_update(p, geometry, f)
    if f.row < 0:
        return
    f.update_step += 1
    rows = rows_of(p)
    whole = _PREPARING_ROWS + rows
    _update_rows(p, geometry, f, min(max(-(-whole * f.update_step // p.window) - _PREPARING_ROWS, 0), rows))


@kernel
def _begin_update(p: Record, geometry: Record, f: Record) -> None:
    """Begin an update with the samples of a full window: predict, take the heading, and predict the readings."""
    if f.row >= 0:
        # The windows have overtaken the update, which happens when cycles are missed.
        _update_rows(p, geometry, f, rows_of(p))
    time = f.sum_time / f.collected
    f.sample_weight[:] = f.weight
    for k in range(IMU_COUNT):
        for i in range(READINGS):
            weight = f.weight[i // 3, k]
            f.sample[k, i] = f.sum[k, i] / weight if weight > 0.0 else 0.0
    _predict(p, f, time - f.time)
    _renew_base_noise(p, f)
    f.collected = 0
    f.time = time
    f.change[:] = 0.0
    f.row = f.update_step = 0
    if f.field_used != 0:
        _update_heading(p, f)
    if f.standing != 0:
        _take_standing(p, f)
    x, smooth = f.motion, f.smooth_motion
    predict_readings(geometry, f.position, f.rotation, smooth, True, f.smooth_predicted, f.jacobian, f.readings_scratch)
    predict_readings(geometry, f.position, f.rotation, x, False, f.predicted, f.jacobian, f.readings_scratch)
    _find_changes(p, f)
    if p.errors > ACCELEROMETER_SCALE:
        for k in range(IMU_COUNT):
            distort_jacobian(f.errors[k], f.jacobian[k])
    if p.base > 0:
        find_frames(geometry, f.position, f.rotation, f.frames)
    if p.lengths > 0:
        _predict_lengths(geometry, f)
    if p.rig > 0:
        find_rig_jacobian(geometry, f.position, f.rotation, smooth, f.errors, f.jacobian, f.rig_jacobian)


@kernel
def _take_standing(p: Record, f: Record) -> None:
    """Take for a measurement that the platform does not move.

    Few IMUs hardly tell some motions from the gyroscopes' biases. Taken for motion, these would seem to be information about
    the pose, on which a motion's readings depend.
    """
    for i in range(6, 12):
        for j in range(p.states):
            f.gain[j] = f.covariance[j, i]
        innovation = -f.motion[i // 3 - 2, i % 3] - f.change[i]
        take_scalar(f.covariance, f.gain, f.change, p.states, innovation, f.covariance[i, i] + _STANDING**2)


@kernel
def _find_changes(p: Record, f: Record) -> None:
    """Find how fast the readings change, by which the uncertain times of samples make them uncertain."""
    passed = f.time - f.predicted_time
    known = p.timing_variance > 0.0 and 0.0 < passed < _LONGEST_CHANGE_S
    for k in range(IMU_COUNT):
        for i in range(READINGS):
            change = f.smooth_predicted[k, i] - f.smooth_predicted_before[k, i]
            f.change_per_second[k, i] = change / passed if known else 0.0
    f.smooth_predicted_before[:] = f.smooth_predicted
    f.predicted_time = f.time


@kernel
def _predict(p: Record, f: Record, period: float) -> None:
    """Carry motion and covariance on by `period` [s]."""
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
    if np.isfinite(p.smoothing) and _is_at_rest(f):
        f.smooth_motion[:] = 0.0
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
    for i in range(6):
        add_jerk(c, i, 6 + i, 12 + i, p.jerk[i // 3], t)
    for k in range(IMU_COUNT):
        for i in range(min(p.errors, ACCELEROMETER_SCALE)):
            at = MOTION_STATES + k * p.errors + i
            c[at, at] += p.bias_walk[i // 3] * t
    for i in range(p.base):
        at = base_start(p) + i
        c[at, at] += p.bias_walk[i // 3] * t
    if p.lengths > 0:
        _forget_play(p, f, t)
    if p.heading != 0:
        c[states - 1, states - 1] += p.offset_variance * t / _OFFSET_LASTS_S
    # The updates take the matrix for symmetric.
    for i in range(states):
        for j in range(i):
            mean = 0.5 * (c[i, j] + c[j, i])
            c[i, j] = mean
            c[j, i] = mean


@kernel
def _renew_base_noise(p: Record, f: Record) -> None:
    """Let the noise of the base's IMU be that of a full window of which nothing is known yet."""
    c, first = f.covariance, base_start(p) + p.base
    for at in range(first, first + p.base):
        for i in range(p.states):
            c[at, i] = c[i, at] = 0.0
        c[at, at] = p.base_variance[(at - first) // 3] / f.collected


@kernel
def _is_at_rest(f: Record) -> bool:
    """Whether no part of the low-passed motion is more than its uncertainty."""
    for block in range(4):
        square = variance = 0.0
        for i in range(3):
            at = 6 + 3 * block + i
            square += f.smooth_motion[block, i] ** 2
            variance += f.covariance[at, at]
        if square > _REST_SIGMAS**2 * variance:
            return False
    return True


@kernel
def _update_rows(p: Record, geometry: Record, f: Record, last: int) -> None:
    """Take the scalars of the sample up to row `last`; the update ends with the last of all."""
    while f.row < last:
        _update_scalar(p, f, f.row)
        f.row += 1
    if f.row == rows_of(p):
        _end_update(p, geometry, f)


@kernel
def _update_scalar(p: Record, f: Record, row: int) -> None:
    """Take one scalar of the sample into covariance and change."""
    if row >= ROWS:
        if f.length_passed[row - ROWS] != 0:
            _update_switch(p, f, row - ROWS)
        _update_length(p, f, row - ROWS)
        return
    k, m = row // READINGS, row % READINGS
    sensor = m // 3
    if f.sample_weight[sensor, k] == 0.0:
        return
    states, start = p.states, MOTION_STATES + k * p.errors
    h, gain, change, c = f.jacobian[k, m], f.gain, f.change, f.covariance
    expected = distort(f.errors[k], sensor, vector(f.predicted[k, 3 * sensor :]))
    innovation = f.sample[k, m] - expected[m % 3] - f.errors[k, m]
    variance = p.variance[sensor] / f.sample_weight[sensor, k] + p.timing_variance * f.change_per_second[k, m] ** 2
    if sensor == ACCELEROMETER:
        acceleration = vector(f.smooth_motion[ACCELERATION])
        variance += p.ripple * dot(acceleration, acceleration)
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
        at = rig_start(p) + which
        innovation -= weight * (f.rig[which] + change[at])
        for i in range(states):
            gain[i] += weight * c[at, i]
    # Bias and noise of the base's IMU have been subtracted, seen in the axes of this one.
    axis, first_base = f.frames[k, m % 3], base_start(p) + 3 * sensor
    for j in range(3 if p.base > 0 else 0):
        bias, noise = first_base + j, first_base + p.base + j
        innovation += axis[j] * (f.base_errors[3 * sensor + j] + change[bias] + change[noise])
        for i in range(states):
            gain[i] -= axis[j] * (c[bias, i] + c[noise, i])
    for j in range(MOTION_STATES):
        variance += h[j] * gain[j]
    for j in range(p.errors):
        variance += f.gradient[j] * gain[start + j]
    for j in range(first, 8):
        variance += f.rig_jacobian[k, m, j] * gain[rig_start(p) + rig_state(k, j)]
    for j in range(3 if p.base > 0 else 0):
        variance -= axis[j] * (gain[first_base + j] + gain[first_base + p.base + j])
    take_scalar(c, gain, change, states, innovation, variance)


@kernel
def _find_length(geometry: Record, f: Record, k: int, gradient: Array) -> float:
    """The length of leg `k` at the pose, and its gradient (6,): the direction d for a move of the platform, and a x d with the
    arm a for a turn.
    """
    arm = rotate(f.rotation, vector(geometry.platform_joints[k]))
    leg = subtract(add(vector(f.position), arm), vector(geometry.base_joints[k]))
    length = float(np.sqrt(dot(leg, leg)))
    d = scale(1.0 / length, leg)
    gradient[0], gradient[1], gradient[2] = d
    gradient[3], gradient[4], gradient[5] = cross(arm, d)
    return length


@kernel
def _predict_lengths(geometry: Record, f: Record) -> None:
    """Close the window of the encoders' readings; their mean time is not that of the update."""
    for k in range(LEGS):
        count = f.length_count[k]
        f.length_weight[k], f.length_count[k] = count, 0.0
        f.length_predicted[k] = _find_length(geometry, f, k, f.length_gradient[k])
        f.length_later[k] = 0.0
        if count > 0.0:
            f.length[k], f.length_later[k] = f.length_sum[k] / count, f.length_sum_time[k] / count - f.time
        f.length_sum[k] = f.length_sum_time[k] = 0.0


@kernel
def _keep_readings(p: Record, geometry: Record, f: Record) -> None:
    """Let the zeros make up for how the lengths curve between the poses before and after an update.

    An update knows the sum of a length and a zero, far better than either of them. It is linear at the pose before, so that at
    the pose after it both the zeros and their covariance with the pose would contradict that sum, and the next readings would
    seem to tell where the platform is.
    """
    c, states, change, gradient = f.covariance, p.states, f.change, f.gradient
    for k in range(LEGS):
        before, zero = f.length_gradient[k], lengths_start(p) + k
        f.length_errors[0, k] += f.length_predicted[k] - _find_length(geometry, f, k, gradient)
        for j in range(6):
            f.length_errors[0, k] += before[j] * change[j]
            left = before[j] - gradient[j]
            for i in range(states):
                c[zero, i] += left * c[j, i]
        for j in range(6):
            left = before[j] - gradient[j]
            for i in range(states):
                c[i, zero] += left * c[i, j]


@kernel
def _forget_play(p: Record, f: Record, period: float) -> None:
    """Let what play does to the readings fade, as the legs turn back now and then, and be uncertain anew."""
    c, left = f.covariance, np.exp(-period / _PLAY_LASTS_S)
    first = lengths_start(p) + LEGS
    for at in range(first, first + LEGS):
        f.length_errors[1, at - first] *= left
        for i in range(p.states):
            c[at, i] *= left
        for i in range(p.states):
            c[i, at] *= left
        c[at, at] += p.length_prior[1] * (1.0 - left * left)


@kernel
def _update_switch(p: Record, f: Record, k: int) -> None:
    """Take what the home switch of leg `k` has told of its encoder, unless the two contradict what is known."""
    f.length_passed[k] = 0
    gain, change, c = f.gain, f.change, f.covariance
    zero = lengths_start(p) + k
    play = zero + LEGS
    for i in range(p.states):
        gain[i] = c[zero, i] + c[play, i]
    innovation = f.length_switched[k] - f.length_errors[0, k] - f.length_errors[1, k] - change[zero] - change[play]
    variance = p.length_variance + f.length_switched_variance[k] + gain[zero] + gain[play]
    if innovation * innovation <= _SWITCH_SIGMAS**2 * variance:
        take_scalar(c, gain, change, p.states, innovation, variance)


@kernel
def _update_length(p: Record, f: Record, k: int) -> None:
    """Take the encoder's readings of leg `k` into covariance and change; a joint's error acts along the leg."""
    if f.length_weight[k] == 0.0:
        return
    states, gradient, gain, change, c, later = p.states, f.length_gradient[k], f.gain, f.change, f.covariance, f.length_later[k]
    zero = lengths_start(p) + k
    play = zero + LEGS
    speed = dot(vector(gradient), vector(f.motion[VELOCITY])) + dot(vector(gradient[3:]), vector(f.motion[RATE]))
    errors = f.length_errors[0, k] + f.length_errors[1, k] + change[zero] + change[play]
    innovation = f.length[k] - f.length_predicted[k] - later * speed - errors
    variance = p.length_variance / f.length_weight[k]
    for i in range(states):
        gain[i] = c[zero, i] + c[play, i]
    for j in range(12):
        weight = gradient[j] if j < 6 else later * gradient[j - 6]
        innovation -= weight * change[j]
        for i in range(states):
            gain[i] += weight * c[j, i]
    at_base, at_platform = vector(gradient), rotate_back(f.rotation, vector(gradient))
    joints = 6 if p.rig > 0 else 0
    for j in range(joints):
        weight, which = -at_base[j] if j < 3 else at_platform[j - 3], rig_state(k, j)
        at = rig_start(p) + which
        innovation -= weight * (f.rig[which] + change[at])
        for i in range(states):
            gain[i] += weight * c[at, i]
    variance += gain[zero] + gain[play]
    for j in range(12):
        variance += (gradient[j] if j < 6 else later * gradient[j - 6]) * gain[j]
    for j in range(joints):
        variance += (-at_base[j] if j < 3 else at_platform[j - 3]) * gain[rig_start(p) + rig_state(k, j)]
    take_scalar(c, gain, change, states, innovation, variance)


@kernel
def _update_heading(p: Record, f: Record) -> None:
    """Take the sample of the magnetometer, before all others: the angle about the vertical by which the field, turned into {1},
    is off its direction. An error of the rotation turns it by -axis^T theta, and the offset adds to it.
    """
    f.field_used = 0
    c, gain, states = f.covariance, f.gain, p.states
    north, east, axis = vector(p.field_axes[0]), vector(p.field_axes[1]), vector(p.field_axes[2])
    field = rotate(f.rotation, vector(f.field))
    for i in range(states):
        gain[i] = c[states - 1, i] - axis[0] * c[3, i] - axis[1] * c[4, i] - axis[2] * c[5, i]
    variance = gain[states - 1] - axis[0] * gain[3] - axis[1] * gain[4] - axis[2] * gain[5] + p.heading_variance
    # The rotation is that at the time of the update.
    turned = (f.field_time - f.time) * dot(axis, vector(f.motion[RATE]))
    innovation = np.arctan2(dot(east, field), dot(north, field)) + turned - f.heading_offset
    take_scalar(c, gain, f.change, states, cut_innovation(innovation, variance), variance)


@kernel
def _end_update(p: Record, geometry: Record, f: Record) -> None:
    """Put the change into the motion and the errors."""
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
        f.rig[i] += f.change[rig_start(p) + i]
    if p.lengths > 0:
        for i in range(p.lengths):
            f.length_errors[i // LEGS, i % LEGS] += f.change[lengths_start(p) + i]
        _keep_readings(p, geometry, f)
    for i in range(p.base):
        f.base_errors[i] += f.change[base_start(p) + i]
    if p.heading != 0:
        f.heading_offset += f.change[p.states - 1]
    _publish(f)


@kernel
def _publish(f: Record) -> None:
    """Let others see the result of a complete update."""
    f.published_time = f.time
    f.published_position[:] = f.position
    f.published_rotation[:] = f.rotation
    f.published_motion[:] = f.motion
    for i in range(MOTION_STATES):
        for j in range(MOTION_STATES):
            f.published_covariance[i, j] = f.covariance[i, j]


@kernel
def extrapolate(f: Record, time: float, position: Array, rotation: Array, twist: Array, acceleration: Array) -> None:
    """Carry what is known to `time`: write the pose (3,), (3, 3), twist (6,) and acceleration (6,)."""
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
def extrapolate_covariance(p: Record, f: Record, time: float, covariance: Array) -> None:
    """Write the covariance (6, 6) of the pose carried to `time`, and add what the rig's errors leave that are not estimated."""
    t = time - f.published_time
    half, c = 0.5 * t * t, f.published_covariance
    for i in range(6):
        for j in range(6):
            near = c[i, j] + t * c[i, 6 + j] + half * c[i, 12 + j]
            rate = c[6 + i, j] + t * c[6 + i, 6 + j] + half * c[6 + i, 12 + j]
            acceleration = c[12 + i, j] + t * c[12 + i, 6 + j] + half * c[12 + i, 12 + j]
            covariance[i, j] = near + t * rate + half * acceleration
        covariance[i, i] += p.jerk[i // 3] * t**5 / 20.0 + p.floor[i // 3]
