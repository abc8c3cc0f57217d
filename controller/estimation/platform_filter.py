"""The platform's roll-pitch filter: a Kalman filter for the vertical seen in {2}.

State (6): the unit vertical u in {2} and the gyroscope's bias [rad/s]. The vertical turns with `u' = u x (rate - bias)`,
and once the platform's own acceleration is taken out the accelerometer measures `g u`.
"""

import numpy as np

from controller.estimation.leg_filter import SETTLING_S
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE, STANDARD_GRAVITY
from plant.pose import Array
from plant.vectors import Vector, cross, dot, rotate_back, subtract, vector

STATES = 6
TILT_SIGMA = 0.15
"""Uncertainty of the vertical after the first sample [rad]."""

INNOVATION_LIMIT = 3.0
"""Innovations are cut to this many standard deviations: a jolt between two samples, as when the brakes open, is in the
accelerometer's reading but not in the acceleration known from the legs."""

PARAMETERS = record_dtype(
    rate_density=np.float64,  # spectral density of the gyroscope's noise
    bias_walk=np.float64,  # spectral density of the gyroscope's bias
    bias_sigma=np.float64,  # uncertainty of the gyroscope's bias at the start [rad/s]
    vertical_variance=np.float64,  # of each component of the accelerometer's reading over g
    weight=np.float64,  # of the vertical in the refinement, 1 / variance [1/rad^2]
    delay=np.float64,  # of the sensors [s]
    settling_cycles=np.int64,  # how long the filter is not relied upon
)
"""Constants of the filter."""

STATE = record_dtype(
    x=(np.float64, STATES),
    covariance=(np.float64, (STATES, STATES)),
    age=np.int64,  # for how many cycles the filter has run
    used=np.int64,  # whether the vertical is used
    weight=np.float64,  # of the vertical in the refinement
    vertical=(np.float64, 3),  # in {2}, without the sensors' delay
    rate=(np.float64, 3),  # angular velocity in {2} [rad/s]
    imu_acceleration=(np.float64, 3),  # of the IMU in {2} [m/s^2]
    transition=(np.float64, (STATES, STATES)),  # from here on scratch
    work=(np.float64, (STATES, STATES)),
    gain=(np.float64, STATES),
    change=(np.float64, STATES),
)
"""State of the filter."""


def platform_parameters(fusion: FusionSettings, rate: float) -> Record:
    """The constants of the filter (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(
        PARAMETERS,
        rate_density=fusion.gyroscope_noise**2,
        bias_walk=fusion.bias_walk**2,
        bias_sigma=fusion.bias_sigma,
        vertical_variance=(fusion.platform_accelerometer_noise / STANDARD_GRAVITY) ** 2 * rate / 2.0,
        weight=1.0 / fusion.tilt_sigma**2,
        delay=fusion.sensor_delay,
        settling_cycles=round(SETTLING_S * rate),
    )


@kernel
def step_platform_filter(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> None:
    """Step the filter, with the platform's own acceleration taken out of the reading: that of the last cycle's `pose`, known
    from the legs.
    """
    if not begin_platform_step(p, s, rig, time, imus, pose):
        return
    step_platform(
        s.x, s.covariance, imus.sample[GYROSCOPE, PLATFORM_IMU], imus.sample[ACCELEROMETER, PLATFORM_IMU], s.imu_acceleration,
        elapsed(rig, time), rig.sensors.gravity, p.rate_density, p.bias_walk, p.vertical_variance, s.transition, s.work, s.gain,
        s.change,
    )  # fmt: skip
    end_platform_step(p, s, imus)


@kernel
def begin_platform_step(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> bool:
    """Start the filter where that is due, and find the acceleration of the IMU, in {2}; returns whether there is a sample."""
    age = s.age
    s.age = age + 1 + time.missed if imus.used[PLATFORM_IMU] != 0 else 0
    s.used = s.age > min(time.cycle, p.settling_cycles)
    s.weight = p.weight if s.used != 0 else 0.0
    if imus.used[PLATFORM_IMU] == 0:
        return False
    rate, force = imus.sample[GYROSCOPE, PLATFORM_IMU], imus.sample[ACCELEROMETER, PLATFORM_IMU]
    if age == 0:
        start_platform(s.x, s.covariance, force, p.bias_sigma)
    # The acceleration of the origin, and what turning adds at the IMU's place d.
    d = vector(rig.sensors.platform_imu_position)
    w = subtract(vector(rate), vector(s.x[3:]))
    wd, ww = dot(w, d), dot(w, w)
    of_origin = rotate_back(pose.rotation, vector(pose.acceleration))
    tangential = cross(rotate_back(pose.rotation, vector(pose.acceleration[3:])), d)
    for i in range(3):
        s.imu_acceleration[i] = of_origin[i] + (tangential[i] + w[i] * wd - d[i] * ww)
    return True


@kernel
def end_platform_step(p: Record, s: Record, imus: Record) -> None:
    """After the filter's step: the platform's angular velocity and the vertical in {2}, without the sensors' delay."""
    rate = imus.sample[GYROSCOPE, PLATFORM_IMU]
    for i in range(3):
        s.rate[i] = rate[i] - s.x[3 + i]
    extrapolate_direction(s.x, s.rate, p.delay, s.vertical)


@kernel
def extrapolate_direction(x: Array, rate: Array, delay: float, carried: Array) -> None:
    """Write a direction that is fixed in {1}, seen in {2}, carried on by a delay [s]: x' = x x rate."""
    turning = cross(vector(x), vector(rate))
    for i in range(3):
        carried[i] = x[i] + delay * turning[i]


@kernel
def turn_direction(x: Array, rate: Vector, t: float) -> None:
    """Carry on a direction that is fixed in {1}, seen in {2}, by a time t [s]: x' = x x rate, to second order."""
    turning, half = cross(vector(x), rate), 0.5 * t * t
    twice = cross(turning, rate)
    for i in range(3):
        x[i] += t * turning[i] + half * twice[i]


@kernel
def cut_innovation(innovation: float, variance: float) -> float:
    """An innovation of this variance, within `INNOVATION_LIMIT` standard deviations."""
    bound = INNOVATION_LIMIT * np.sqrt(variance)
    return float(min(max(innovation, -bound), bound))


@kernel
def take_scalar(covariance: Array, gain: Array, change: Array, states: int, innovation: float, variance: float) -> None:
    """Take a scalar measurement into covariance and change of the first `states` states.

    Args:
        gain: the covariance of the states with the measurement.
        variance: of the innovation.
    """
    inverse = 1.0 / variance
    for i in range(states):
        weight = gain[i] * inverse
        change[i] += weight * innovation
        for j in range(states):
            covariance[i, j] -= weight * gain[j]


@kernel
def start_platform(x: Array, covariance: Array, accelerometer: Array, bias_sigma: float) -> None:
    """Start the filter from its first sample, taking the force for gravity."""
    force = vector(accelerometer)
    norm = np.sqrt(dot(force, force))
    for i in range(STATES):
        x[i] = accelerometer[i] / norm if i < 3 else 0.0
        for j in range(STATES):
            covariance[i, j] = 0.0
        covariance[i, i] = TILT_SIGMA**2 if i < 3 else bias_sigma**2


@kernel
def step_platform(
    x: Array, covariance: Array, gyroscope: Array, accelerometer: Array, acceleration: Array, period: float, gravity: float,
    rate_density: float, bias_walk: float, vertical_variance: float, transition: Array, work: Array, gain: Array, change: Array,
) -> None:  # fmt: skip
    """Take one sample [rad/s, m/s^2] into state and covariance.

    Args:
        acceleration: (3,) [m/s^2], of the IMU itself without gravity, in {2}; it is taken out of the reading.
        rate_density, bias_walk: spectral densities of the gyroscope's noise and of its bias.
        vertical_variance: of each component of the accelerometer's reading over g.
        transition, work, gain, change: scratch (6, 6), (6, 6), (6,), (6,).
    """
    rate, t = subtract(vector(gyroscope), vector(x[3:])), period
    w0, w1, w2 = rate
    u0, u1, u2 = vector(x)
    turn_direction(x, rate, t)
    for i in range(STATES):
        change[i] = 0.0
        for j in range(STATES):
            transition[i, j] = 1.0 if i == j else 0.0
    transition[0, 1], transition[0, 2] = t * w2, -t * w1
    transition[1, 0], transition[1, 2] = -t * w2, t * w0
    transition[2, 0], transition[2, 1] = t * w1, -t * w0
    transition[0, 4], transition[0, 5] = t * u2, -t * u1
    transition[1, 3], transition[1, 5] = -t * u2, t * u0
    transition[2, 3], transition[2, 4] = t * u1, -t * u0
    # The lower half of the transition is the identity.
    for i in range(STATES):
        for j in range(STATES):
            total = covariance[i, j]
            if i < 3:
                total = 0.0
                for k in range(STATES):
                    total += transition[i, k] * covariance[k, j]
            work[i, j] = total
    for i in range(STATES):
        for j in range(i + 1):
            total = work[i, j]
            if j < 3:
                total = 0.0
                for k in range(STATES):
                    total += work[i, k] * transition[j, k]
            covariance[i, j] = total
            covariance[j, i] = total
    for i in range(3):
        covariance[i, i] += rate_density * t
        covariance[3 + i, 3 + i] += bias_walk * t
    for m in range(3):
        innovation = (accelerometer[m] - acceleration[m]) / gravity - x[m] - change[m]
        variance = covariance[m, m] + vertical_variance
        for i in range(STATES):
            gain[i] = covariance[i, m]
        take_scalar(covariance, gain, change, STATES, cut_innovation(innovation, variance), variance)
    for i in range(STATES):
        x[i] += change[i]
    norm = np.sqrt(dot(vector(x), vector(x)))
    for i in range(3):
        x[i] /= norm
