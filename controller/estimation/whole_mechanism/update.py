"""An update of the whole-mechanism filter: prediction, then 42 scalar measurements one after the other, and the heading."""

import numpy as np

from controller.estimation.platform_filter import INNOVATION_LIMIT
from controller.estimation.whole_mechanism.imu_errors import (
    ACCELEROMETER_SCALE,
    distort,
    distort_jacobian,
    error_gradient,
)
from controller.estimation.whole_mechanism.parameters import (
    ROWS,
    rig_start,
)
from controller.estimation.whole_mechanism.readings import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    MOTION_STATES,
    RATE,
    READINGS,
    VELOCITY,
    predict_readings,
)
from controller.estimation.whole_mechanism.rig_jacobian import find_rig_jacobian, rig_state
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import rotate_by_vector

_OFFSET_LASTS_S = 100.0
"""Time in which the offset of the heading may change by as much as its uncertainty at the start [s]."""


@kernel
def begin_update(parameters: Record, geometry: Record, state: Record) -> None:
    """Begin an update with the samples of a full window: predict, take the heading, and predict the readings."""
    p, f = parameters, state
    if f.row >= 0:
        # The windows have overtaken the update, which happens when cycles are missed.
        while f.row < ROWS:
            update_scalar(parameters, state, f.row)
            f.row += 1
        end_update(parameters, state)
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
def update_scalar(parameters: Record, state: Record, row: int) -> None:
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
        at = rig_start(p) + which
        innovation -= weight * (f.rig[which] + change[at])
        for i in range(states):
            gain[i] += weight * c[at, i]
    for j in range(MOTION_STATES):
        variance += h[j] * gain[j]
    for j in range(p.errors):
        variance += f.gradient[j] * gain[start + j]
    for j in range(first, 8):
        variance += f.rig_jacobian[k, m, j] * gain[rig_start(p) + rig_state(k, j)]
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
def end_update(parameters: Record, state: Record) -> None:
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
        f.rig[i] += f.change[rig_start(p) + i]
    if p.heading != 0:
        f.heading_offset += f.change[p.states - 1]
    publish(state)


@kernel
def publish(state: Record) -> None:
    """Let others see the result of a complete update."""
    f = state
    f.published_time = f.time
    f.published_position[:] = f.position
    f.published_rotation[:] = f.rotation
    f.published_motion[:] = f.motion
    for i in range(MOTION_STATES):
        for j in range(MOTION_STATES):
            f.published_covariance[i, j] = f.covariance[i, j]
