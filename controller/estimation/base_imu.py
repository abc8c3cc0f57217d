"""The IMU on the base: what the base's motion adds to the readings of the other IMUs is subtracted.

While the base {1} turns with `w` and `w'` and its IMU at p feels the specific force f, an IMU at r that moves with the velocity
v in {1} reads, beside what its motion in {1} makes,

    rate  = R^T w,    force = R^T (f + w' x (r - p) + w x (w x (r - p)) + 2 w x v),    R: its axes in {1}

where it would read 0 and R^T g up on a base at rest. The difference is subtracted, so that all stages after this one see a base
at rest. R, r and v are those that its own filter expects: an error e of R leaves e times the difference, which is a small share
of g e, and vanishes with e.

The angular acceleration w' is that of a polynomial of second order, fitted to the rate with a memory that fades (N. Morrison,
*Introduction to Sequential Smoothing and Prediction*, 1969).
"""

from dataclasses import replace
from math import sqrt

import numpy as np

from controller.estimation.imu_calibration import calibrate_reading
from controller.estimation.imu_health import END_OF_RANGE
from controller.estimation.leg_filter import STATES as LEG_STATES
from controller.estimation.leg_filter import start_leg
from controller.estimation.platform_filter import start_platform
from controller.estimation.whole_mechanism.imu_errors import ACCELEROMETER_BIAS, ERRORS, GYROSCOPE_BIAS
from controller.estimation.whole_mechanism.readings import find_frames, leg_axes
from controller.rig import elapsed, sensor_geometry
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.imu_wiring import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import Mechanism
from plant.pose import Array
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

_MEMORY_S = 0.015
"""Time constant with which the memory of the rate fades [s]."""

_FROZEN_S = 0.01
"""How long a reading that says that the base turns may stay the same [s]."""

_FIRST_CYCLES = 8
"""So often the platform's filter starts anew: without a pose, the axes of the platform's IMU in {1} are those at home."""

_SAME_NOISE = 2.0
"""Variance of the noise of a difference between two readings, as a multiple of that of one."""

SHARED_NOISE = (1.0 + IMU_COUNT) / _SAME_NOISE
"""Variance of the noise that all IMUs together see, as a multiple of that of as many independent differences."""

PARAMETERS = record_dtype(
    present=np.int64,  # whether there is one
    gain=(np.float64, (2, 3, 3)),  # a calibrated reading is gain times the raw one plus offset
    offset=(np.float64, (2, 3)),
    range=(np.float64, 2),  # of gyroscope and accelerometer; the end of which is invalid [rad/s, m/s^2]
    place=(np.float64, 3),  # of the IMU in {1} [m]
    home_position=(np.float64, 3),  # of the platform [m]
    home_rotation=(np.float64, (3, 3)),
)
"""Constants."""

STATE = record_dtype(
    begun=np.int64,  # whether there has been a reading
    raw=(np.float64, (2, 3)),  # last reading [rad/s, m/s^2]
    unchanged_for=np.float64,  # for how long it has stayed the same [s]
    lost_for=np.float64,  # for how long there has been none that can be used [s]
    rate=(np.float64, 3),  # of the base, seen in {1} as the rest [rad/s]
    force=(np.float64, 3),  # specific force of the IMU [m/s^2]
    fitted=(np.float64, (3, 3)),  # rate, its derivative and the derivative of that
    leg=(np.float64, LEG_STATES),  # from here on scratch
    leg_covariance=(np.float64, (LEG_STATES, LEG_STATES)),
    up=(np.float64, 3),
    rotation=(np.float64, (3, 3)),
)
"""State."""


def base_imu_parameters(mechanism: Mechanism, fusion: FusionSettings, present: bool, gain: Array, offset: Array) -> Record:
    """The constants (dtype `PARAMETERS`) of an IMU on the base, if there is one, with gain (2, 3, 3) and offset (2, 3)."""
    home = mechanism.require_home()
    return filled(
        PARAMETERS,
        present=present,
        gain=gain,
        offset=offset,
        range=(fusion.gyroscope_range, fusion.accelerometer_range),
        place=mechanism.plant_parameters()["base_imu_position"],
        home_position=home.position,
        home_rotation=home.rotation,
    )


def with_its_noise(fusion: FusionSettings) -> FusionSettings:
    """The settings for readings from which those of the base's IMU have been subtracted, which is as noisy as the others.

    They take that noise for each IMU's own. The whole-mechanism filter knows that it is shared (`_renew_base_noise`), and has
    these settings as well: with less noise it forgets too soon what it knows of the biases, and was up to 12 % worse.
    """
    noises = (
        "gyroscope_noise", "leg_accelerometer_noise", "platform_accelerometer_noise", "mechanism_gyroscope_noise",
        "mechanism_accelerometer_noise",
    )  # fmt: skip
    return replace(fusion, **{name: sqrt(_SAME_NOISE) * getattr(fusion, name) for name in noises})


def shared_errors(mechanism: Mechanism, fusion: FusionSettings) -> Array:
    """The covariance (147, 147) that the biases of the base's IMU give to those of the others, with the platform at home."""
    home, geometry = mechanism.require_home(), sensor_geometry(mechanism)[()]
    frames, seen = np.zeros((IMU_COUNT, 3, 3)), np.zeros((IMU_COUNT * ERRORS, 6))
    find_frames(geometry, home.position, home.rotation, frames)
    for k in range(IMU_COUNT):
        for first in (GYROSCOPE_BIAS, ACCELEROMETER_BIAS):
            seen[k * ERRORS + first : k * ERRORS + first + 3, first : first + 3] = frames[k]
    sigmas = np.repeat([fusion.bias_sigma, fusion.accelerometer_bias_sigma], 3)
    covariance: Array = (seen * sigmas**2) @ seen.T
    return covariance


@kernel
def hear_base_imu(p: Record, s: Record, period: float, reading: Array, age: int) -> None:
    """Before a cycle: take a reading (2, 3) of the base's IMU.

    Args:
        period: time since the last cycle [s].
        age: of the reading, in cycles.
    """
    same, good = True, age == 0
    for sensor in range(2):
        for i in range(3):
            value = reading[sensor, i]
            same = same and value == s.raw[sensor, i]
            good = good and abs(value) < END_OF_RANGE * p.range[sensor]
            s.raw[sensor, i] = value
    # An ideal IMU at rest reads exactly no rate.
    turns = reading[GYROSCOPE, 0] != 0.0 or reading[GYROSCOPE, 1] != 0.0 or reading[GYROSCOPE, 2] != 0.0
    s.unchanged_for = s.unchanged_for + period if same and turns and age == 0 else 0.0
    good = good and s.unchanged_for < _FROZEN_S
    since = s.lost_for + period
    s.lost_for = 0.0 if good else since
    if good:
        calibrate_reading(p.gain[GYROSCOPE], p.offset[GYROSCOPE], s.raw[GYROSCOPE], s.rate)
        calibrate_reading(p.gain[ACCELEROMETER], p.offset[ACCELEROMETER], s.raw[ACCELEROMETER], s.force)
        _fit_rate(s, since)


@kernel
def _fit_rate(s: Record, t: float) -> None:
    """Carry the polynomial on by `t` [s], and fit it to the rate."""
    x = s.fitted
    if s.begun == 0:
        s.begun = 1
        x[:] = 0.0
        x[0] = s.rate
        return
    kept = np.exp(-t / _MEMORY_S)
    lost = 1.0 - kept
    for i in range(3):
        x[0, i] += t * (x[1, i] + 0.5 * t * x[2, i])
        x[1, i] += t * x[2, i]
        off = s.rate[i] - x[0, i]
        x[0, i] += (1.0 - kept**3) * off
        x[1, i] += 1.5 * lost * lost * (1.0 + kept) / t * off
        x[2, i] += lost * lost * lost / (t * t) * off


@kernel
def vertical(p: Record, s: Record, rig: Record) -> tuple[Vector, float]:
    """The direction (3,) against which bodies at rest on the base are pulled, in {1}, and how much [m/s^2]."""
    if p.present == 0 or s.begun == 0:
        return vector(rig.sensors.up_in_base[0]), rig.sensors.gravity
    force = vector(s.force)
    size = np.sqrt(dot(force, force))
    return scale(1.0 / size, force), size


@shared_kernel
def remove_base_motion(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, legs: Record, platform_parameters: Record, platform: Record,
    pose: Record,
) -> None:  # fmt: skip
    """Subtract the base's motion from the samples of all healthy IMUs; without a new reading of it, the last one is held."""
    if s.begun == 0:
        return
    period = elapsed(rig, time)
    known = time.cycle > 0 and pose.found != 0
    for k in range(rig.legs):
        if imus.healthy[k] != 0:
            _remove_from_leg(p, s, rig, imus, legs, pose, known, k, period)
    if imus.healthy[PLATFORM_IMU] != 0:
        _remove_from_platform(p, s, rig, imus, pose, known, period)
        if imus.used[PLATFORM_IMU] != 0 and time.cycle < _FIRST_CYCLES:
            start_platform(platform_parameters, platform, imus.sample[ACCELEROMETER, PLATFORM_IMU])


@kernel
def _remove_from_leg(
    p: Record, s: Record, rig: Record, imus: Record, legs: Record, pose: Record, known: bool, k: int, period: float
) -> None:  # fmt: skip
    """The leg's attitude is that of its filter; without one, that of the pose, or that in which it feels the base's force."""
    sensors, x = rig.sensors, s.leg
    if legs.age[k] == 0 and known:
        axes = leg_axes(sensors, k, pose.position, pose.rotation)
        for j in range(3):
            for i in range(3):
                s.rotation[i, j] = axes[j][i]
        moving = (0.0, 0.0, 0.0)
    else:
        if legs.age[k] == 0:
            up = rotate_back(sensors.joint_rotations[k], vector(s.force))
            s.up[0], s.up[1], s.up[2] = scale(1.0 / np.sqrt(dot(up, up)), up)
            start_leg(
                x, s.leg_covariance, imus.sample[GYROSCOPE, k], imus.sample[ACCELEROMETER, k], s.up, 1.0
            )  # fmt: skip
            x[2] = x[3] = 0.0
        else:
            for i in range(4):
                x[i] = legs.x[k, i] + period * legs.x[k, 2 + i]
        ca, sa, cb, sb = np.cos(x[0]), np.sin(x[0]), np.cos(x[1]), np.sin(x[1])
        joint = sensors.joint_rotations[k]
        columns = (
            rotate(joint, (cb, sa * sb, -ca * sb)),
            rotate(joint, (0.0, ca, sa)),
            rotate(joint, (sb, -sa * cb, ca * cb)),
        )
        for j in range(3):
            for i in range(3):
                s.rotation[i, j] = columns[j][i]
        turning = rotate(s.rotation, (x[2] * cb, x[3], x[2] * sb))
        moving = cross(turning, rotate(s.rotation, vector(sensors.leg_imu_position[k])))
    place = add(vector(sensors.base_joints[k]), rotate(s.rotation, vector(sensors.leg_imu_position[k])))
    _remove(p, s, rig, imus, k, place, moving)


@kernel
def _remove_from_platform(
    p: Record, s: Record, rig: Record, imus: Record, pose: Record, known: bool, period: float
) -> None:  # fmt: skip
    """The platform's attitude is that of the pose, or that at home."""
    if known:
        turn = scale(period, vector(pose.twist[3:]))
        for j in range(3):
            column = (pose.rotation[0, j], pose.rotation[1, j], pose.rotation[2, j])
            turned = add(column, cross(turn, column))
            s.rotation[0, j], s.rotation[1, j], s.rotation[2, j] = turned
        origin, velocity, turning = vector(pose.position), vector(pose.twist), vector(pose.twist[3:])
    else:
        s.rotation[:] = p.home_rotation
        origin, velocity, turning = vector(p.home_position), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    arm = rotate(s.rotation, vector(rig.sensors.platform_imu_position))
    _remove(p, s, rig, imus, PLATFORM_IMU, add(origin, arm), add(velocity, cross(turning, arm)))


@kernel
def _remove(p: Record, s: Record, rig: Record, imus: Record, k: int, place: Vector, velocity: Vector) -> None:
    """Subtract what the base's motion adds to the readings of IMU `k` with the axes `s.rotation` at a place."""
    w, arm = vector(s.rate), subtract(place, vector(p.place))
    force = add(vector(s.force), cross(vector(s.fitted[1]), arm))
    force = add(force, cross(w, add(cross(w, arm), scale(2.0, velocity))))
    added = subtract(force, scale(rig.sensors.gravity, vector(rig.sensors.up_in_base[0])))
    turning, felt = rotate_back(s.rotation, w), rotate_back(s.rotation, added)
    for i in range(3):
        imus.sample[GYROSCOPE, k, i] -= turning[i]
        imus.sample[ACCELEROMETER, k, i] -= felt[i]
