"""The constrained leg filter: an extended Kalman filter for a leg on its universal joint.

The leg frame is `R_joint Rx(a) Ry(b)`, the leg its z axis. State (9): angles a, b [rad], their rates, their
accelerations, and the gyroscope's bias (3) [rad/s]. The IMU sits at `d` in the leg frame, so that, whatever the platform
does, it measures exactly

    rate  = omega + bias,                     omega = (a' cos b, b', a' sin b)
    force = g up + alpha x d + omega x (omega x d),   up = Ry(b)^T Rx(a)^T up_in_joint

The motion model is a random walk of the accelerations. The six measurements are taken one after the other, linearised
once, which equals the joint update. `filterpy_filters` is the slow clear twin.
"""

import numpy as np

from controller.estimation.shaking import note_force, note_rate, variance_of
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, rotate, subtract, vector

STATES = 9
ANGLE_SIGMA, RATE_SIGMA, ACCELERATION_SIGMA = 0.15, 0.05, 40.0
"""Uncertainty of the state after the first sample [rad, rad/s, rad/s^2]."""

SETTLING_S = 0.1
"""How long a filter that was started again is not relied upon [s]."""

_GAP_S = 0.05
"""Longest time for which a leg's angular acceleration is taken to last [s]."""

PARAMETERS = record_dtype(
    jerk=np.float64,  # spectral density of the legs' angular jerk
    bias_walk=np.float64,  # spectral density of the gyroscopes' biases
    bias_sigma=np.float64,  # uncertainty of a gyroscope's bias at the start [rad/s]
    rate_variance=np.float64,  # of one sample [(rad/s)^2]
    force_variance=np.float64,  # of one sample [(m/s^2)^2]
    weight=np.float64,  # of a direction in the refinement, 1 / variance [1/rad^2]
    delay=np.float64,  # of the sensors [s]
    settling_cycles=np.int64,  # how long a filter is not relied upon
)
"""Constants of the leg filters."""

STATE = record_dtype(
    x=(np.float64, (LEGS, STATES)),
    covariance=(np.float64, (LEGS, STATES, STATES)),
    age=(np.int64, LEGS),  # for how many cycles each filter has run
    used=(np.float64, LEGS),  # whether a direction is used
    weights=(np.float64, LEGS),  # in the refinement
    directions=(np.float64, (LEGS, 3)),  # of the legs in {1}, unit
    rates=(np.float64, (LEGS, 3)),  # derivatives of the directions [1/s]
    expected=(np.float64, 6),  # from here on scratch, so that the cycle allocates nothing
    jacobian=(np.float64, (6, STATES)),
    gain=(np.float64, STATES),
    change=(np.float64, STATES),
)
"""State of the leg filters."""


def leg_parameters(fusion: FusionSettings, rate: float) -> Record:
    """The constants of the leg filters (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(
        PARAMETERS,
        jerk=fusion.leg_jerk**2,
        bias_walk=fusion.bias_walk**2,
        bias_sigma=fusion.bias_sigma,
        rate_variance=fusion.gyroscope_noise**2 * rate / 2.0,
        force_variance=fusion.leg_accelerometer_noise**2 * rate / 2.0,
        weight=1.0 / fusion.leg_sigma**2,
        delay=fusion.sensor_delay,
        settling_cycles=round(SETTLING_S * rate),
    )


@shared_kernel
def step_leg_filters(p: Record, s: Record, rig: Record, time: Record, imus: Record) -> None:
    """Step the filters of the legs whose IMUs are used."""
    period = elapsed(rig, time)
    for k in range(LEGS):
        if imus.used[k] == 0:
            continue
        x, covariance, up = s.x[k], s.covariance[k], rig.sensors.up_in_joint[k]
        rate, force = imus.sample[GYROSCOPE, k], imus.sample[ACCELEROMETER, k]
        if s.age[k] == 0:
            start_leg(x, covariance, rate, force, up, p.bias_sigma)
        else:
            if period > _GAP_S:
                x[4:6] = 0.0
            predict_leg(x, covariance, period, p.jerk, p.bias_walk)
        if rig.planar != 0:
            lock_second_axis(x, covariance)
        d, gravity = rig.sensors.leg_imu_position[k], rig.sensors.gravity
        predict_measurement(x, up, d, gravity, s.expected, s.jacobian)
        off = subtract(vector(rate), vector(s.expected))
        note_rate(imus.shaking, k, dot(off, off), 3.0 * p.rate_variance + covariance[2, 2] + covariance[3, 3], period)
        off = subtract(vector(force), vector(s.expected[3:]))
        note_force(imus.shaking, k, dot(off, off), p.force_variance + force_doubt(covariance, d, gravity), period)
        take_leg_sample(
            x, covariance, rate, force, variance_of(imus.shaking, GYROSCOPE, k, p.rate_variance),
            variance_of(imus.shaking, ACCELEROMETER, k, p.force_variance), s.expected, s.jacobian, s.gain, s.change,
        )  # fmt: skip
    update_leg_directions(p, s, rig, time, imus)


@kernel
def force_doubt(covariance: Array, d: Array, gravity: float) -> float:
    """The mean square [m^2/s^4] by which an expected force is off, as angles and angular accelerations are uncertain."""
    angles, accelerations = covariance[0, 0] + covariance[1, 1], covariance[4, 4] + covariance[5, 5]
    return float(gravity * gravity * angles + dot(vector(d), vector(d)) * accelerations)


@kernel
def update_leg_directions(p: Record, s: Record, rig: Record, time: Record, imus: Record) -> None:
    """Directions and rates of the legs from the filters' states, and which of them are used: those of settled filters.

    Filters that start with the first cycle need not settle.
    """
    for k in range(LEGS):
        s.age[k] = s.age[k] + 1 + time.missed if imus.used[k] != 0 else 0
        settled = s.age[k] > min(time.cycle, p.settling_cycles)
        s.used[k] = 1.0 if settled else 0.0
        s.weights[k] = p.weight if settled else 0.0
        leg_direction(s.x[k], rig.sensors.joint_rotations[k], p.delay, s.directions[k], s.rates[k])


@kernel
def start_leg(
    x: Array, covariance: Array, gyroscope: Array, accelerometer: Array, up_in_joint: Array, bias_sigma: float
) -> None:
    """Start the filter from its first sample, taking the force for gravity.

    Two pairs of angles agree with a vertical. Their verticals have opposite components across both axes, and a leg never
    passes the angle at which that component vanishes, so it has the sign that it has at rest. The other pair is right only
    where the first has turned the leg by more than a right angle, as in a planar mechanism.
    """
    p, q, r = vector(up_in_joint)
    force = vector(accelerometer)
    norm = np.sqrt(dot(force, force))
    u0, u1, u2 = force[0] / norm, force[1] / norm, force[2] / norm
    middle = np.arctan2(r, q)
    spread = np.arccos(min(1.0, max(-1.0, u1 / np.sqrt(q * q + r * r))))
    side = -1.0 if r >= 0.0 else 1.0
    for sign in (side, -side):
        a = middle + sign * spread
        a -= 2.0 * np.pi * np.rint(a / (2.0 * np.pi))
        z = r * np.cos(a) - q * np.sin(a)
        x[0], x[1] = a, np.arctan2(p * u2 - z * u0, p * u0 + z * u2)
        if abs(x[1]) <= 0.5 * np.pi:
            break
    x[2] = gyroscope[0] * np.cos(x[1]) + gyroscope[2] * np.sin(x[1])
    x[3] = gyroscope[1]
    x[4:] = 0.0
    covariance[:] = 0.0
    for i in range(2):
        covariance[i, i] = ANGLE_SIGMA**2
        covariance[2 + i, 2 + i] = RATE_SIGMA**2
        covariance[4 + i, 4 + i] = ACCELERATION_SIGMA**2
    for i in range(6, STATES):
        covariance[i, i] = bias_sigma**2


@kernel
def predict_leg(x: Array, covariance: Array, period: float, jerk: float, bias_walk: float) -> None:
    """Carry state and covariance over one period [s]; `jerk` and `bias_walk` are spectral densities."""
    t, half = period, 0.5 * period * period
    for i in range(2):
        x[i] += t * x[2 + i] + half * x[4 + i]
        x[2 + i] += t * x[4 + i]
    for j in range(STATES):
        for i in range(2):
            covariance[i, j] += t * covariance[2 + i, j] + half * covariance[4 + i, j]
            covariance[2 + i, j] += t * covariance[4 + i, j]
    for i in range(STATES):
        for j in range(2):
            covariance[i, j] += t * covariance[i, 2 + j] + half * covariance[i, 4 + j]
            covariance[i, 2 + j] += t * covariance[i, 4 + j]
    for i in range(2):
        add_jerk(covariance, i, 2 + i, 4 + i, jerk, t)
    for i in range(6, STATES):
        covariance[i, i] += bias_walk * t


@kernel
def add_jerk(covariance: Array, x: int, v: int, a: int, jerk: float, t: float) -> None:
    """Add to the covariance of the states x, v = x', a = x'' what white jerk of this spectral density does in a time t."""
    t3 = t * t * t
    covariance[x, x] += jerk * t3 * t * t / 20.0
    covariance[v, v] += jerk * t3 / 3.0
    covariance[a, a] += jerk * t
    for i, j, value in ((x, v, jerk * t3 * t / 8.0), (x, a, jerk * t3 / 6.0), (v, a, jerk * t * t / 2.0)):
        covariance[i, j] += value
        covariance[j, i] += value


@kernel
def lock_second_axis(x: Array, covariance: Array) -> None:
    """Hold the joint's second angle at rest, without doubt, before an update: in a planar mechanism the first axis is all that
    the joint has.
    """
    for i in range(1, 6, 2):
        x[i] = 0.0
        for j in range(STATES):
            covariance[i, j] = 0.0
            covariance[j, i] = 0.0


@kernel
def predict_measurement(x: Array, up_in_joint: Array, d: Array, gravity: float, h: Array, jacobian: Array) -> None:
    """Write the expected measurement `h` (6,), rate then force, and its Jacobian (6, 9), whose other elements stay 0."""
    ca, sa, cb, sb = np.cos(x[0]), np.sin(x[0]), np.cos(x[1]), np.sin(x[1])
    da, db, dda, ddb = x[2], x[3], x[4], x[5]
    d0, d1, d2 = vector(d)
    w0, w1, w2 = da * cb, db, da * sb
    a0, a1, a2 = dda * cb - da * db * sb, ddb, dda * sb + da * db * cb
    # The vertical after the first turn; its derivative with respect to a is (0, r, -q).
    p = up_in_joint[0]
    q = up_in_joint[1] * ca + up_in_joint[2] * sa
    r = up_in_joint[2] * ca - up_in_joint[1] * sa
    wd = w0 * d0 + w1 * d1 + w2 * d2
    ww = w0 * w0 + w1 * w1 + w2 * w2
    h[0], h[1], h[2] = w0 + x[6], w1 + x[7], w2 + x[8]
    h[3] = gravity * (p * cb - r * sb) + a1 * d2 - a2 * d1 + w0 * wd - d0 * ww
    h[4] = gravity * q + a2 * d0 - a0 * d2 + w1 * wd - d1 * ww
    h[5] = gravity * (p * sb + r * cb) + a0 * d1 - a1 * d0 + w2 * wd - d2 * ww

    jacobian[0, 1], jacobian[0, 2], jacobian[0, 6] = -w2, cb, 1.0
    jacobian[1, 3], jacobian[1, 7] = 1.0, 1.0
    jacobian[2, 1], jacobian[2, 2], jacobian[2, 8] = w0, sb, 1.0
    # Derivative of omega x (omega x d) with respect to omega: (omega . d) I + omega d^T - 2 d omega^T.
    m00, m01, m02 = wd + w0 * d0 - 2.0 * d0 * w0, w0 * d1 - 2.0 * d0 * w1, w0 * d2 - 2.0 * d0 * w2
    m10, m11, m12 = w1 * d0 - 2.0 * d1 * w0, wd + w1 * d1 - 2.0 * d1 * w1, w1 * d2 - 2.0 * d1 * w2
    m20, m21, m22 = w2 * d0 - 2.0 * d2 * w0, w2 * d1 - 2.0 * d2 * w1, wd + w2 * d2 - 2.0 * d2 * w2
    jacobian[3, 0], jacobian[4, 0], jacobian[5, 0] = gravity * q * sb, gravity * r, -gravity * q * cb
    a0b, a2b = -dda * sb - da * db * cb, dda * cb - da * db * sb
    jacobian[3, 1] = -gravity * (p * sb + r * cb) - a2b * d1 - m00 * w2 + m02 * w0
    jacobian[4, 1] = a2b * d0 - a0b * d2 - m10 * w2 + m12 * w0
    jacobian[5, 1] = gravity * (p * cb - r * sb) + a0b * d1 - m20 * w2 + m22 * w0
    a0d, a2d = -db * sb, db * cb
    jacobian[3, 2] = -a2d * d1 + m00 * cb + m02 * sb
    jacobian[4, 2] = a2d * d0 - a0d * d2 + m10 * cb + m12 * sb
    jacobian[5, 2] = a0d * d1 + m20 * cb + m22 * sb
    a0e, a2e = -da * sb, da * cb
    jacobian[3, 3] = -a2e * d1 + m01
    jacobian[4, 3] = a2e * d0 - a0e * d2 + m11
    jacobian[5, 3] = a0e * d1 + m21
    jacobian[3, 4], jacobian[4, 4], jacobian[5, 4] = -sb * d1, sb * d0 - cb * d2, cb * d1
    jacobian[3, 5], jacobian[5, 5] = d2, -d0


@kernel
def take_leg_sample(
    x: Array, covariance: Array, gyroscope: Array, accelerometer: Array, rate_variance: float, force_variance: float, h: Array,
    jacobian: Array, gain: Array, change: Array,
) -> None:  # fmt: skip
    """Take one sample into state and covariance.

    Args:
        rate_variance, force_variance: of each component.
        h, jacobian: of `predict_measurement` at `x`.
        gain, change: scratch (9,).
    """
    change[:] = 0.0
    for m in range(6):
        rate = m < 3
        innovation = (gyroscope[m] if rate else accelerometer[m - 3]) - h[m]
        variance = rate_variance if rate else force_variance
        for i in range(STATES):
            if rate:
                total = jacobian[m, 1] * covariance[1, i] + jacobian[m, 2] * covariance[2, i]
                gain[i] = total + jacobian[m, 3] * covariance[3, i] + covariance[6 + m, i]
            else:
                total = jacobian[m, 0] * covariance[0, i]
                for j in range(1, 6):
                    total += jacobian[m, j] * covariance[j, i]
                gain[i] = total
        for j in range(STATES if rate else 6):
            variance += jacobian[m, j] * gain[j]
            innovation -= jacobian[m, j] * change[j]
        inverse = 1.0 / variance
        for i in range(STATES):
            k = gain[i] * inverse
            change[i] += k * innovation
            for j in range(i + 1):
                value = covariance[i, j] - k * gain[j]
                covariance[i, j] = value
                covariance[j, i] = value
    for i in range(STATES):
        x[i] += change[i]


@kernel
def leg_direction(x: Array, joint_rotation: Array, delay: float, direction: Array, rate: Array) -> None:
    """Write the leg's direction (3,) in {1} and its rate (3,) [1/s] from the filter's state, carried on by `delay` [s]."""
    da, db = x[2] + delay * x[4], x[3] + delay * x[5]
    a, b = x[0] + 0.5 * delay * (x[2] + da), x[1] + 0.5 * delay * (x[3] + db)
    ca, sa, cb, sb = np.cos(a), np.sin(a), np.cos(b), np.sin(b)
    turned = rotate(joint_rotation, (sb, -sa * cb, ca * cb))
    turning = rotate(joint_rotation, (cb * db, -ca * cb * da + sa * sb * db, -sa * cb * da - ca * sb * db))
    for i in range(3):
        direction[i], rate[i] = turned[i], turning[i]
