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

STATES = 6
TILT_SIGMA = 0.15
"""Uncertainty of the vertical after the first sample [rad]."""

INNOVATION_LIMIT = 3.0
"""Innovations are cut to this many standard deviations: a jolt between two samples, as when the brakes open, is in the
accelerometer's reading but not in the acceleration known from the legs."""


PARAMETERS = record_dtype(
    rate_density=np.float64,
    bias_walk=np.float64,
    bias_sigma=np.float64,
    vertical_variance=np.float64,
    weight=np.float64,
    delay=np.float64,
    settling_cycles=np.int64,
)
"""Constants of the filter.

Fields:
    rate_density, bias_walk: spectral densities of the gyroscope's noise and of its bias.
    bias_sigma: uncertainty of the gyroscope's bias at the start [rad/s].
    vertical_variance: of each component of the accelerometer's reading over g.
    weight: of the vertical in the refinement, 1 / variance [1/rad^2].
    delay: of the sensors [s].
    settling_cycles: how long the filter is not relied upon.
"""

STATE = record_dtype(
    x=(np.float64, STATES),
    covariance=(np.float64, (STATES, STATES)),
    age=np.int64,
    used=np.int64,
    weight=np.float64,
    vertical=(np.float64, 3),
    rate=(np.float64, 3),
    angular_acceleration=(np.float64, 3),
    imu_acceleration=(np.float64, 3),
    transition=(np.float64, (STATES, STATES)),
    work=(np.float64, (STATES, STATES)),
    gain=(np.float64, STATES),
    change=(np.float64, STATES),
)
"""State of the filter.

Fields:
    x, covariance, age: of the filter, which has run for `age` cycles.
    used, weight: whether the vertical is used, and its weight in the refinement.
    vertical, rate: the vertical and the angular velocity [rad/s], both in {2}, without the sensors' delay.
    angular_acceleration, imu_acceleration: of the platform and of its IMU, in {2}.
    transition, work, gain, change: scratch.
"""


def platform_parameters(fusion: FusionSettings, rate: float) -> Record:
    """The constants of the filter (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    values = {
        "rate_density": fusion.gyroscope_noise**2,
        "bias_walk": fusion.bias_walk**2,
        "bias_sigma": fusion.bias_sigma,
        "vertical_variance": (fusion.platform_accelerometer_noise / STANDARD_GRAVITY) ** 2 * rate / 2.0,
        "weight": 1.0 / fusion.tilt_sigma**2,
        "delay": fusion.sensor_delay,
        "settling_cycles": round(SETTLING_S * rate),
    }
    return filled(PARAMETERS, values)


@kernel
def step_platform_filter(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> None:
    """Step the filter, with the platform's own acceleration taken out of the reading.

    Args:
        p, s: dtypes `PARAMETERS` and `STATE`.
        rig, time: dtypes `RIG` and `TIME`.
        imus: state of the IMUs.
        pose: the last cycle's pose, whose acceleration is known from the legs.
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
    """Start the filter where that is due, and find the acceleration of the IMU, in {2}.

    Returns:
        Whether there is a sample to take.
    """
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
    d = rig.sensors.platform_imu_position
    w0, w1, w2 = rate[0] - s.x[3], rate[1] - s.x[4], rate[2] - s.x[5]
    wd = w0 * d[0] + w1 * d[1] + w2 * d[2]
    ww = w0 * w0 + w1 * w1 + w2 * w2
    a = s.angular_acceleration
    for i in range(3):
        s.imu_acceleration[i] = 0.0
        a[i] = 0.0
        for j in range(3):
            s.imu_acceleration[i] += pose.rotation[j, i] * pose.acceleration[j]
            a[i] += pose.rotation[j, i] * pose.acceleration[3 + j]
    s.imu_acceleration[0] += a[1] * d[2] - a[2] * d[1] + w0 * wd - d[0] * ww
    s.imu_acceleration[1] += a[2] * d[0] - a[0] * d[2] + w1 * wd - d[1] * ww
    s.imu_acceleration[2] += a[0] * d[1] - a[1] * d[0] + w2 * wd - d[2] * ww
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
    carried[0] = x[0] + delay * (x[1] * rate[2] - x[2] * rate[1])
    carried[1] = x[1] + delay * (x[2] * rate[0] - x[0] * rate[2])
    carried[2] = x[2] + delay * (x[0] * rate[1] - x[1] * rate[0])


@kernel
def start_platform(x: Array, covariance: Array, accelerometer: Array, bias_sigma: float) -> None:
    """Start the filter from its first sample, taking the force for gravity."""
    norm = np.sqrt(accelerometer[0] ** 2 + accelerometer[1] ** 2 + accelerometer[2] ** 2)
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
    w0, w1, w2 = gyroscope[0] - x[3], gyroscope[1] - x[4], gyroscope[2] - x[5]
    u0, u1, u2 = x[0], x[1], x[2]
    t = period
    c0, c1, c2 = u1 * w2 - u2 * w1, u2 * w0 - u0 * w2, u0 * w1 - u1 * w0
    half = 0.5 * t * t
    x[0] += t * c0 + half * (c1 * w2 - c2 * w1)
    x[1] += t * c1 + half * (c2 * w0 - c0 * w2)
    x[2] += t * c2 + half * (c0 * w1 - c1 * w0)
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
    for i in range(3):
        for j in range(STATES):
            total = 0.0
            for k in range(STATES):
                total += transition[i, k] * covariance[k, j]
            work[i, j] = total
    for i in range(3, STATES):
        for j in range(STATES):
            work[i, j] = covariance[i, j]
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
        bound = INNOVATION_LIMIT * np.sqrt(variance)
        innovation = min(max(innovation, -bound), bound)
        inverse = 1.0 / variance
        for i in range(STATES):
            gain[i] = covariance[i, m]
        for i in range(STATES):
            k = gain[i] * inverse
            change[i] += k * innovation
            for j in range(STATES):
                covariance[i, j] -= k * gain[j]
    for i in range(STATES):
        x[i] += change[i]
    norm = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    for i in range(3):
        x[i] /= norm
