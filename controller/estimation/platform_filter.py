"""The platform's roll-pitch filter: a Kalman filter for the vertical seen in {2}.

The vertical u turns with `u' = u x (rate - bias)`. Once the acceleration that is planned or known from the legs is taken out,
the accelerometer measures `g u`, its noise, and what is unknown of the platform's acceleration. The latter is no white noise:
its integral, a velocity, stays small. So the filter integrates what the accelerometer shows along two level axes, and measures
that this velocity is zero, with a noise as large as the velocity is seen to be (`excess`). If the acceleration is known, that
noise is zero, and the filter takes each reading for gravity. If it is not, the filter averages over seconds.

While the gyroscope's reading is clipped, the rate goes on beyond the range, unseen. A constant angular acceleration a from
there on leaves the vertical off by a t^2 / 2 after the time t. So its variance is a^2 t^4 / 4, which grows by a^2 t^3 dt, and
the accelerometer corrects the vertical soon afterwards.

The bias about the vertical does not show in u before the IMU tilts. So after `REST_S` at rest the filter measures that it does
not turn about the vertical, as `vqf` does (D. Laidig, T. Seel, *VQF: Highly accurate IMU orientation estimation with bias
estimation and magnetic disturbance rejection*, Information Fusion 91, 2023), but only to `SLOW_TURN`, as a platform may turn
slowly for long.

State (11): u, the gyroscope's bias [rad/s], the first level axis in {2}, and the unknown velocity along both level axes [m/s].
The second level axis is u x the first. Both turn with the rate less its bias, as u does, and point to no heading of note.

Errors (7): the small turn about both level axes that leads from the estimate to the truth, and the errors of velocity and bias.
"""

import numpy as np

from controller.estimation.excess import INNOVATION_LIMIT, faded_excess
from controller.estimation.leg_filter import SETTLING_S
from controller.estimation.shaking import is_clipped, note_force, variance_of
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.pose import Array
from plant.vectors import Vector, add, cross, dot, rotate_back, scale, subtract, vector

STATES = 11
BIAS, LEVEL, VELOCITY = 3, 6, 9
"""Where bias, level axis and velocity begin in the state; the vertical is its beginning."""

ERRORS = 7
TILT_SIGMA = 0.15
"""Uncertainty of the vertical after the first sample [rad]."""

CORRELATION_S = 0.1
"""For how long the unknown velocity stays alike: with its square this gives its density."""

FASTEST_MOTION = 300.0
"""How fast the unknown velocity may change, as a multiple of itself [1/s]: beyond that, a sample is cut as a jolt."""

SLOWEST_CORRECTION = 0.4
"""At least so fast the vertical follows the accelerometer, however large the unknown velocity [rad/s]."""

START_CORRECTION = 1.5
"""The same soon after the start, times the filter's age [rad]: it forgets what it took for gravity in its first samples."""

YOUNGEST_S = 0.01

REST_RATE, REST_VELOCITY = np.radians(1.0), 1e-3
"""Below these the IMU seems to be at rest: its rate less its bias [rad/s], and its unknown velocity [m/s]."""

REST_S = 1.5
"""For how long it seems to be at rest before it is taken for that [s]."""

SLOW_TURN = np.radians(0.1)
"""How fast an IMU that seems to be at rest may turn about the vertical [rad/s]: so well it learns that bias."""

UNSEEN_ACCELERATION = 4.0
"""How fast the rate may change while its reading is clipped [rad/s^2]."""

ACCELERATION_SIGMA = 2.0
"""Least uncertainty of what is known of the IMU's own acceleration: as the brakes open, and as legs jerk [m/s^2]."""

RATE_NOISE = 1e-7
"""Density of the gyroscope's noise that its scales and axes cause, by the square of the rate [1/Hz]."""

PARAMETERS = record_dtype(
    rate_density=np.float64,  # spectral density of the gyroscope's noise
    bias_walk=np.float64,  # spectral density of the gyroscope's bias
    bias_sigma=np.float64,  # uncertainty of the gyroscope's bias at the start [rad/s]
    force_variance=np.float64,  # of each component of the accelerometer's reading by noise alone [m^2/s^4]
    weight=np.float64,  # of the vertical in the refinement, 1 / variance [1/rad^2]
    delay=np.float64,  # of the sensors [s]
    settling_cycles=np.int64,  # how long the filter is not relied upon
    acceleration_variance=np.float64,  # of what is known of the IMU's own acceleration [m^2/s^4]
)
"""Constants of the filter."""

STATE = record_dtype(
    x=(np.float64, STATES),
    covariance=(np.float64, (ERRORS, ERRORS)),  # of the errors
    unknown=np.float64,  # square of the velocity beyond what noise explains, faded [m^2/s^2]
    noise=np.float64,  # variance of the velocity that the accelerometer's noise alone would cause [m^2/s^2]
    running=np.float64,  # time since the start [s]
    resting_for=np.float64,  # for how long the IMU has seemed to be at rest [s]
    clipped_for=np.float64,  # time since the rate was last seen, as the gyroscope's reading is clipped [s]
    age=np.int64,  # for how many cycles the filter has run
    used=np.int64,  # whether the vertical is used
    weight=np.float64,  # of the vertical in the refinement
    vertical=(np.float64, 3),  # in {2}, without the sensors' delay
    rate=(np.float64, 3),  # angular velocity in {2} [rad/s]
    gyroscope=(np.float64, 3),  # what it reads, or would read if it were not clipped [rad/s]
    force_variance=np.float64,  # of each component of the accelerometer's present reading [m^2/s^4]
    imu_acceleration=(np.float64, 3),  # of the IMU in {2} [m/s^2]
    gain=(np.float64, ERRORS),  # from here on scratch
    change=(np.float64, ERRORS),
)
"""State of the filter."""


def platform_parameters(fusion: FusionSettings, rate: float, jerk: float = 0.0) -> Record:
    """The constants of the filter (dtype `PARAMETERS`) in cycles of this rate [Hz]; `jerk` is the legs' limit [m/s^3]."""
    return filled(
        PARAMETERS,
        rate_density=fusion.gyroscope_noise**2,
        bias_walk=fusion.bias_walk**2,
        bias_sigma=fusion.bias_sigma,
        force_variance=fusion.platform_accelerometer_noise**2 * rate / 2.0,
        weight=1.0 / fusion.tilt_sigma**2,
        delay=fusion.sensor_delay,
        settling_cycles=round(SETTLING_S * rate),
        # An acceleration that is not planned is known late, and the platform may jerk twice as much as its legs.
        acceleration_variance=max(ACCELERATION_SIGMA, 2.0 * jerk * fusion.acceleration_time) ** 2,
    )


@kernel
def step_platform_filter(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> None:
    """Step the filter, with the platform's own acceleration taken out of the reading: that of `pose`, as it is planned and as
    the legs have shown.
    """
    if not begin_platform_step(p, s, rig, time, imus, pose):
        return
    force, period, gravity = imus.sample[ACCELEROMETER, PLATFORM_IMU], elapsed(rig, time), rig.sensors.gravity
    step_platform(p, s, s.gyroscope, force, s.imu_acceleration, period, gravity)
    end_platform_step(p, s)


@kernel
def begin_platform_step(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> bool:
    """Start the filter where that is due, and find the acceleration of the IMU, in {2}; returns whether there is a sample."""
    age = s.age
    s.age = age + 1 + time.missed if imus.used[PLATFORM_IMU] != 0 else 0
    s.used = s.age > min(time.cycle, p.settling_cycles)
    s.weight = p.weight if s.used != 0 else 0.0
    if imus.used[PLATFORM_IMU] == 0:
        return False
    force = imus.sample[ACCELEROMETER, PLATFORM_IMU]
    if age == 0:
        start_platform(p, s, force)
    rate = s.gyroscope
    rate[:] = imus.sample[GYROSCOPE, PLATFORM_IMU]
    clipped = is_clipped(imus.shaking, GYROSCOPE, PLATFORM_IMU)
    note_clipping(s, clipped, elapsed(rig, time))
    if clipped:
        # The others know the platform's rate, too.
        known = rotate_back(pose.rotation, vector(pose.twist[3:]))
        for i in range(3):
            rate[i] = known[i] + s.x[BIAS + i]
    # The acceleration of the origin, and what turning adds at the IMU's place d.
    d = vector(rig.sensors.platform_imu_position)
    w = subtract(vector(rate), vector(s.x[BIAS:]))
    wd, ww = dot(w, d), dot(w, w)
    of_origin = rotate_back(pose.rotation, vector(pose.acceleration))
    tangential = cross(rotate_back(pose.rotation, vector(pose.acceleration[3:])), d)
    for i in range(3):
        s.imu_acceleration[i] = of_origin[i] + (tangential[i] + w[i] * wd - d[i] * ww)
    off = subtract(subtract(vector(force), vector(s.imu_acceleration)), scale(rig.sensors.gravity, vector(s.x)))
    tilt = s.covariance[0, 0] + s.covariance[1, 1]
    explained = p.force_variance + p.acceleration_variance + rig.sensors.gravity**2 * tilt
    note_force(imus.shaking, PLATFORM_IMU, dot(off, off), explained, elapsed(rig, time))
    s.force_variance = variance_of(imus.shaking, ACCELEROMETER, PLATFORM_IMU, p.force_variance)
    return True


@kernel
def note_clipping(s: Record, clipped: bool, period: float) -> None:
    """Note whether the gyroscope's reading is clipped, before the filter's step; `period` is since the sample before [s]."""
    s.clipped_for = s.clipped_for + period if clipped else 0.0


@kernel
def end_platform_step(p: Record, s: Record) -> None:
    """After the filter's step: the platform's angular velocity and the vertical in {2}, without the sensors' delay."""
    for i in range(3):
        s.rate[i] = s.gyroscope[i] - s.x[BIAS + i]
    extrapolate_direction(s.x, s.rate, p.delay, s.vertical)


@kernel
def extrapolate_direction(x: Array, rate: Array, delay: float, carried: Array) -> None:
    """Write a direction that is fixed in {1}, seen in {2}, carried on by a delay [s]: x' = x x rate."""
    turning = cross(vector(x), vector(rate))
    for i in range(3):
        carried[i] = x[i] + delay * turning[i]


@kernel
def turn_direction(x: Array, rate: Vector, t: float) -> None:
    """Carry on a direction that is fixed in {1}, seen in {2}, at a rate [rad/s] over a time t [s]: x' = x x rate.

    A rotation by the tangent of half its angle, with three terms of its series: exact to 6e-8 of the angle up to 0.2 rad, and
    it keeps lengths and angles.
    """
    square = 0.25 * t * t * dot(rate, rate)
    half = scale(0.5 * t * (1.0 + square * (1.0 / 3.0 + square * (2.0 / 15.0))), rate)
    turning = cross(vector(x), half)
    twice, factor = cross(turning, half), 2.0 / (1.0 + dot(half, half))
    for i in range(3):
        x[i] += factor * (turning[i] + twice[i])


@kernel
def make_level(x: Array, vertical: Vector) -> None:
    """Make a direction (3,) a unit vector across the vertical."""
    direction = vector(x)
    level = subtract(direction, scale(dot(direction, vertical), vertical))
    size = np.sqrt(dot(level, level))
    for i in range(3):
        x[i] = level[i] / size


@kernel
def cut_innovation(innovation: float, variance: float) -> float:
    """An innovation of this variance, within `INNOVATION_LIMIT` standard deviations.

    A jolt between two samples, as when the brakes open, is in the accelerometer's reading but not in the acceleration known
    from the legs.
    """
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
def start_platform(p: Record, s: Record, accelerometer: Array) -> None:
    """Start the filter from its first sample, taking the force for gravity."""
    force = vector(accelerometer)
    up = scale(1.0 / np.sqrt(dot(force, force)), force)
    s.x[:], s.covariance[:] = 0.0, 0.0
    for i in range(3):
        s.x[i] = up[i]
        s.covariance[4 + i, 4 + i] = p.bias_sigma**2
    # That axis of {2} which is the least upright.
    s.x[LEVEL + np.argmin(np.abs(s.x[:3]))] = 1.0
    make_level(s.x[LEVEL:VELOCITY], up)
    s.covariance[0, 0] = s.covariance[1, 1] = TILT_SIGMA**2
    s.unknown = s.noise = s.running = s.resting_for = s.clipped_for = 0.0
    s.force_variance = p.force_variance


@kernel
def step_platform(
    p: Record, s: Record, gyroscope: Array, accelerometer: Array, acceleration: Array, period: float, gravity: float
) -> None:
    """Take one sample [rad/s, m/s^2] into state and covariance.

    Args:
        acceleration: (3,) [m/s^2], what is known of the acceleration of the IMU itself, in {2}; it is taken out of the reading.
        period: since the sample before [s].
        gravity: [m/s^2].
    """
    x, t = s.x, period
    rate = subtract(vector(gyroscope), vector(x[BIAS:]))
    turn_direction(x, rate, t)
    turn_direction(x[LEVEL:], rate, t)
    first = vector(x[LEVEL:])
    second = cross(vector(x), first)
    force = subtract(vector(accelerometer), vector(acceleration))
    shown = t * dot(first, force), t * dot(second, force)
    seen = 0.5 * ((x[VELOCITY] + shown[0]) ** 2 + (x[VELOCITY + 1] + shown[1]) ** 2)
    tilt_variance = 0.5 * (s.covariance[0, 0] + s.covariance[1, 1])
    variance = t * t * (s.force_variance + gravity**2 * tilt_variance + FASTEST_MOTION**2 * s.unknown)
    for i in range(2):
        x[VELOCITY + i] += cut_innovation(shown[i], variance)
    _predict_covariance(p, s, first, second, rate, t, gravity)
    # This sample's own noise is left out, as small accelerations that last would be taken for gravity; what shakes it is not.
    s.noise += (s.force_variance - p.force_variance) * t * t
    s.unknown = faded_excess(s.unknown, seen, s.noise, t)
    s.noise += p.force_variance * t * t
    _measure_no_velocity(s, velocity_density(s.unknown) / t)
    seems_at_rest = dot(rate, rate) < REST_RATE**2 and s.unknown < REST_VELOCITY**2
    s.resting_for = s.resting_for + t if seems_at_rest else 0.0
    if s.resting_for > REST_S:
        _measure_no_turn(s, rate, t)
    _correct(s, first, second)


@kernel
def velocity_density(square: float) -> float:
    """Spectral density of a velocity of this square [m^2/s^2]."""
    return 2.0 * CORRELATION_S * square


@kernel
def _predict_covariance(p: Record, s: Record, first: Vector, second: Vector, rate: Vector, t: float, gravity: float) -> None:
    """Carry the errors on: the bias turns the level axes, and their turn lets gravity into the velocity."""
    c, lean = s.covariance, t * gravity
    s.running += t
    slowest = max(SLOWEST_CORRECTION, START_CORRECTION / (s.running + YOUNGEST_S))
    turn = p.rate_density + RATE_NOISE * dot(rate, rate) + slowest**4 / gravity**2 * velocity_density(s.unknown)
    turn += UNSEEN_ACCELERATION**2 * s.clipped_for**3
    for i in range(ERRORS):
        c[2, i] += lean * c[1, i]
        c[3, i] -= lean * c[0, i]
    for i in range(ERRORS):
        c[i, 2] += lean * c[i, 1]
        c[i, 3] -= lean * c[i, 0]
    for i in range(ERRORS):
        c[0, i] -= t * (first[0] * c[4, i] + first[1] * c[5, i] + first[2] * c[6, i])
        c[1, i] -= t * (second[0] * c[4, i] + second[1] * c[5, i] + second[2] * c[6, i])
    for i in range(ERRORS):
        c[i, 0] -= t * (first[0] * c[i, 4] + first[1] * c[i, 5] + first[2] * c[i, 6])
        c[i, 1] -= t * (second[0] * c[i, 4] + second[1] * c[i, 5] + second[2] * c[i, 6])
    for i in range(2):
        c[i, i] += turn * t
        c[2 + i, 2 + i] += s.force_variance * t * t
    for i in range(4, ERRORS):
        c[i, i] += p.bias_walk * t


@kernel
def _measure_no_velocity(s: Record, variance: float) -> None:
    """Take for a measurement of this variance [m^2/s^2] that the velocity along each level axis is zero."""
    c, gain = s.covariance, s.gain
    kept = variance / (0.5 * (c[2, 2] + c[3, 3]) + variance)
    s.noise *= kept * kept
    s.change[:] = 0.0
    for m in range(2, 4):
        inverse = 1.0 / (c[m, m] + variance)
        innovation = -s.x[VELOCITY + m - 2] - s.change[m]
        for i in range(ERRORS):
            gain[i] = c[i, m]
        for i in range(ERRORS):
            weight = gain[i] * inverse
            s.change[i] += weight * innovation
            for j in range(i + 1):
                c[i, j] -= weight * gain[j]
                c[j, i] = c[i, j]


@kernel
def _measure_no_turn(s: Record, rate: Vector, t: float) -> None:
    """Take for a measurement, to `SLOW_TURN` in a second, that the rate [rad/s] about the vertical is bias."""
    c, gain, up = s.covariance, s.gain, vector(s.x)
    for i in range(ERRORS):
        gain[i] = dot(vector(c[i, 4:]), up)
    variance = dot(vector(gain[4:]), up)
    if variance > SLOW_TURN**2:
        innovation = dot(rate, up) - dot(vector(s.change[4:]), up)
        take_scalar(c, gain, s.change, ERRORS, innovation, variance + SLOW_TURN**2 / t)


@kernel
def _correct(s: Record, first: Vector, second: Vector) -> None:
    """Move the state by the errors that were found."""
    x, change = s.x, s.change
    up = vector(x)
    moved = add(up, subtract(scale(change[0], second), scale(change[1], first)))
    size = np.sqrt(dot(moved, moved))
    for i in range(3):
        x[i] = moved[i] / size
        x[LEVEL + i] += change[1] * up[i]
        x[BIAS + i] += change[4 + i]
    make_level(x[LEVEL:VELOCITY], vector(x))
    for i in range(2):
        x[VELOCITY + i] += change[2 + i]


@kernel
def vertical_covariance(s: Record, covariance: Array) -> None:
    """Write the covariance (3, 3) of the vertical in {2} [rad^2]; along the vertical itself it is zero."""
    c, first = s.covariance, vector(s.x[LEVEL:])
    second = cross(vector(s.x), first)
    for i in range(3):
        for j in range(3):
            mixed = first[i] * second[j] + second[i] * first[j]
            covariance[i, j] = c[0, 0] * second[i] * second[j] + c[1, 1] * first[i] * first[j] - c[0, 1] * mixed
