"""The whole-mechanism filter: an error-state extended Kalman filter on the platform's motion, with all IMUs.

The pose fixes every leg, so the platform's motion predicts every reading (`readings`), and motion tells
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

from controller.estimation.whole_mechanism.imu_errors import ERRORS
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS, ROWS, rig_start
from controller.estimation.whole_mechanism.readings import (
    ACCELERATION,
    ANGULAR_ACCELERATION,
    MOTION_STATES,
    RATE,
    VELOCITY,
)
from controller.estimation.whole_mechanism.update import begin_update, end_update, publish, update_scalar
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array, rotate_by_vector

_FIRST_SIGMAS = (0.01, 0.05, 0.1, 0.5, 5.0, 50.0)
"""Uncertainty of the motion at the start: position [m], rotation [rad], and their derivatives."""

_PREPARING_ROWS = 14
"""What prediction costs, in scalar updates."""


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
    states, rig = p.states, rig_start(p)
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
    publish(state)


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
        begin_update(parameters, geometry, state)
    if f.row < 0:
        return
    f.update_step += 1
    whole = _PREPARING_ROWS + ROWS
    last = min(max(-(-whole * f.update_step // p.window) - _PREPARING_ROWS, 0), ROWS)
    while f.row < last:
        update_scalar(parameters, state, f.row)
        f.row += 1
    if f.row == ROWS:
        end_update(parameters, state)


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
