"""IMU imperfections: from the ideal signals of a plant to the raw data of its IMUs.

The raw reading inverts the paper's (37), `a_cal = T S (a_u + b)`: with the mounting misalignment M,
`a_u = S^-1 T^-1 M a - b + noise`. A low-pass, a delay, range, resolution and dropouts follow. The low-pass is exact for signals
that are linear between samples. All noise is keyed by (seed, IMU, cycle), so every cycle can be reproduced on its own.
"""

import re
from dataclasses import dataclass, fields, replace
from math import exp, expm1, inf, pi, radians, sqrt
from typing import Any

import numpy as np

from plant.checks import checked_seed
from plant.compiled import MOST, Limits, Record, kernel, record_dtype
from plant.errors import InputError, UnknownNameError
from plant.imu_wiring import IMU_COUNT, RIGHT_WIRING, Wiring
from plant.pose import Array, rotation_from_vector

STANDARD_GRAVITY = 9.80665
MILLI_G = 1e-3 * STANDARD_GRAVITY

GYROSCOPE, ACCELEROMETER, MAGNETOMETER = 0, 1, 2
"""First index of a measurement (3, 7, 3) [rad/s, m/s^2, uT]: sensor, IMU, axis."""


def _check_not_negative(what: str, value: Any) -> None:
    try:
        good = bool((np.asarray(value, dtype=float) >= 0.0).all())
    except (TypeError, ValueError):
        good = False
    if not good:
        raise InputError(f"{what} is {value}; it must be a number that is not negative")


@dataclass(frozen=True)
class SensorErrors:
    """Errors of one three-axis sensor, in its own unit."""

    noise: float = 0.0  # white [unit/sqrt(Hz)]
    bias: tuple[float, float] = (0.0, 0.0)  # least and greatest magnitude, in a random direction
    scale: float = 0.0  # greatest error of an axis, uniform and relative
    cross_axis: float = 0.0  # greatest element of the upper triangle of T, uniform
    drift: float = 0.0  # random walk of the bias [unit/sqrt(s)]
    bandwidth: float = inf  # -3 dB frequency of the first-order low-pass [Hz]
    reach: float = inf  # largest reading
    resolution: float = 0.0  # step of the reading; 0 for none

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_not_negative(f"the {field.name} of a sensor", getattr(self, field.name))


@dataclass(frozen=True)
class ImuModel:
    """The imperfections of one kind of IMU."""

    name: str
    gyroscope: SensorErrors = SensorErrors()  # in rad/s
    accelerometer: SensorErrors = SensorErrors()  # in m/s^2
    magnetometer: SensorErrors = SensorErrors()  # in uT
    magnetometer_rate: float = inf  # [Hz]; each sample is repeated until the next
    misalignment: float = 0.0  # greatest angle about each axis, uniform [rad]
    delay: float = 0.0  # [s], rounded to whole cycles
    dropout: float = 0.0  # probability that a cycle repeats the previous sample

    def __post_init__(self) -> None:
        for name in ("magnetometer_rate", "misalignment", "delay", "dropout"):
            _check_not_negative(f"the {name} of an IMU", getattr(self, name))
        if self.magnetometer_rate == 0.0:
            raise InputError("the magnetometer_rate of an IMU is 0; it must be positive")
        if not self.delay < inf:
            raise InputError("the delay of an IMU is infinite; it must be finite")
        if self.dropout > 1.0:
            raise InputError(f"the dropout of an IMU is {self.dropout}; it is a probability, at most 1")

    @property
    def latency(self) -> float:
        """Mean delay of gyroscope and accelerometer, with their low-passes [s]."""
        return self.delay + sum(0.5 / (2.0 * pi * sensor.bandwidth) for sensor in (self.gyroscope, self.accelerometer))


# InvenSense MPU-9150, +-4 g, +-250 deg/s, widest filter, as in its product specification; with iron of a motor beside it.
_MPU9150 = ImuModel(
    "mpu9150",
    gyroscope=SensorErrors(
        noise=radians(0.005), bias=(radians(20.0), radians(20.0)), scale=0.03, cross_axis=0.02,
        bandwidth=256.0, reach=radians(250.0), resolution=radians(1.0 / 131.0),
    ),
    accelerometer=SensorErrors(
        noise=0.4 * MILLI_G, bias=(50.0 * MILLI_G, 80.0 * MILLI_G), scale=0.03, cross_axis=0.02,
        bandwidth=260.0, reach=4.0 * STANDARD_GRAVITY, resolution=STANDARD_GRAVITY / 8192.0,
    ),
    magnetometer=SensorErrors(noise=0.05, bias=(20.0, 20.0), scale=0.05, cross_axis=0.05, reach=1200.0, resolution=0.3),
    magnetometer_rate=100.0,
    misalignment=radians(1.0),
)  # fmt: skip

_CALIBRATED = replace(
    _MPU9150,
    name="mpu9150-calibrated",
    gyroscope=replace(_MPU9150.gyroscope, bias=(radians(0.2), radians(0.2)), scale=0.0, cross_axis=0.0),
    accelerometer=replace(_MPU9150.accelerometer, bias=(MILLI_G, MILLI_G), scale=1e-3, cross_axis=0.0),
    magnetometer=replace(_MPU9150.magnetometer, bias=(0.3, 0.3), scale=5e-3, cross_axis=5e-3),
    misalignment=0.0,
)

# TDK ICM-42688-P after the same calibration; it has no magnetometer, so the MPU-9150's is used.
_ICM42688 = replace(
    _CALIBRATED,
    name="icm42688",
    gyroscope=replace(_CALIBRATED.gyroscope, noise=radians(0.0028), bandwidth=400.0),
    accelerometer=replace(_CALIBRATED.accelerometer, noise=0.07 * MILLI_G, bandwidth=400.0),
)

PRESETS = {model.name: model for model in (ImuModel("ideal"), _MPU9150, _CALIBRATED, _ICM42688)}

_LONGEST_DELAY = 32


def axes_matrix(axes: str) -> Array:
    """The matrix (3, 3) of axes such as "+y-x+z", with 0 for an axis that reads nothing."""
    units = dict(zip(("+x", "+y", "+z", "-x", "-y", "-z", "0"), (*np.eye(3), *-np.eye(3), np.zeros(3)), strict=True))
    return np.array([units[axis] for axis in re.findall("[+-].|0", axes)])


IMU_STATE = record_dtype(
    gain=(np.float64, (3, IMU_COUNT, 3, 3)),
    offset=(np.float64, (3, IMU_COUNT, 3)),
    place=(np.int64, IMU_COUNT),
    noise=(np.float64, 3),
    drift=(np.float64, 2),
    smoothing=(np.float64, (3, 2)),
    reach=(np.float64, 3),
    resolution=(np.float64, 3),
    dropout=np.float64,
    delay=np.int64,
    magnetometer_every=np.int64,
    seed=np.uint64,
    cycle=np.int64,
    bias_walk=(np.float64, (2, IMU_COUNT, 3)),
    value=(np.float64, (3, IMU_COUNT, 3)),
    smoothed=(np.float64, (3, IMU_COUNT, 3)),
    queue=(np.float64, (_LONGEST_DELAY + 1, 3, IMU_COUNT, 3)),
    reading=(np.float64, (3, IMU_COUNT, 3)),
    normals=(np.float64, 6),
)
"""Constants and state of the imperfections of seven IMUs; a copy is a snapshot."""

IMU_LIMITS: Limits = {
    "place": (0, IMU_COUNT - 1),
    "delay": (0, _LONGEST_DELAY),
    "magnetometer_every": (1, MOST),
    "cycle": (0, MOST),
}
"""Least and greatest of what counts, indexes or divides in them."""


Word = np.uint64 | int
"""A 32-bit number, kept in 64 bits."""


def load_imu(name: str) -> ImuModel:
    """The preset of that name.

    Raises:
        UnknownNameError: there is none.
    """
    if name not in PRESETS:
        raise UnknownNameError(f"no IMU preset {name!r}; there are {', '.join(PRESETS)}")
    return PRESETS[name]


def imu_state(model: ImuModel, seed: int, period: float, wiring: Wiring = RIGHT_WIRING) -> Record:
    """Draw the constant errors of seven IMUs, for cycles of `period` [s].

    Raises:
        InputError: a negative seed, or a delay longer than 32 cycles.
    """
    checked_seed(seed)
    state: Record = np.zeros((), IMU_STATE)
    random = np.random.default_rng([seed, IMU_COUNT])
    alignments = [rotation_from_vector(random.uniform(-model.misalignment, model.misalignment, 3)) for _ in range(IMU_COUNT)]
    every = max(1, round(1.0 / (model.magnetometer_rate * period)))
    for kind, sensor in enumerate((model.gyroscope, model.accelerometer, model.magnetometer)):
        sampling = every * period if kind == MAGNETOMETER else period
        axes = (wiring.gyroscopes, wiring.accelerometers, RIGHT_WIRING.gyroscopes)[kind]
        for imu in range(IMU_COUNT):
            gain, offset = _constant_errors(sensor, random)
            read = axes_matrix(axes[imu])
            state["gain"][kind, imu] = read @ (gain @ alignments[imu])
            state["offset"][kind, imu] = read @ offset
        state["noise"][kind] = sensor.noise * sqrt(0.5 / sampling)
        state["smoothing"][kind] = _smoothing(sensor.bandwidth, sampling)
        state["reach"][kind] = sensor.reach
        state["resolution"][kind] = sensor.resolution
        if kind != MAGNETOMETER:
            state["drift"][kind] = sensor.drift * sqrt(period)
    delay = round(model.delay / period)
    if delay > _LONGEST_DELAY:
        raise InputError(f"the delay of the IMUs is {delay} cycles; at most {_LONGEST_DELAY} are kept")
    state["place"] = wiring.places
    state["delay"] = delay
    state["magnetometer_every"] = every
    state["dropout"] = model.dropout
    state["seed"] = seed
    return state


def _constant_errors(sensor: SensorErrors, random: np.random.Generator) -> tuple[Array, Array]:
    """The gain (3, 3), S^-1 T^-1, and the offset (3,), -b, of (37)."""
    scale = np.diag(1.0 + random.uniform(-sensor.scale, sensor.scale, 3))
    axes = np.eye(3) + np.triu(random.uniform(-sensor.cross_axis, sensor.cross_axis, (3, 3)), 1)
    direction = random.normal(size=3)
    return np.linalg.inv(axes @ scale), -random.uniform(*sensor.bias) * direction / np.linalg.norm(direction)


def _smoothing(bandwidth: float, period: float) -> tuple[float, float]:
    """The shares of the previous and the new value in a first-order low-pass."""
    if bandwidth == inf:
        return 0.0, 1.0
    ratio = 2.0 * pi * bandwidth * period
    if ratio == 0.0:
        return 0.0, 0.0
    share = -expm1(-ratio)
    return share / ratio - exp(-ratio), 1.0 - share / ratio


@kernel
def philox(c0: Word, c1: Word, c2: Word, c3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    """Philox4x32-10 of Salmon, Moraes, Dror, Shaw (2011): four random 32-bit words for a counter and a key."""
    mask = np.uint64(0xFFFFFFFF)
    a, b, c, d = np.uint64(c0), np.uint64(c1), np.uint64(c2), np.uint64(c3)
    key0, key1 = np.uint64(k0), np.uint64(k1)
    for _ in range(10):
        product0 = np.uint64(0xD2511F53) * a
        product1 = np.uint64(0xCD9E8D57) * c
        a, c = (product1 >> np.uint64(32)) ^ b ^ key0, (product0 >> np.uint64(32)) ^ d ^ key1
        b, d = product1 & mask, product0 & mask
        key0 = (key0 + np.uint64(0x9E3779B9)) & mask
        key1 = (key1 + np.uint64(0xBB67AE85)) & mask
    return a, b, c, d


@kernel
def _normal_pair(word0: Word, word1: Word) -> tuple[float, float]:
    """Two standard normal numbers of two 32-bit words (Box and Muller)."""
    radius = np.sqrt(-2.0 * np.log((np.float64(word0) + 1.0) * 2.0**-32))
    angle = np.float64(word1) * (2.0 * np.pi * 2.0**-32)
    return radius * np.cos(angle), radius * np.sin(angle)


@kernel
def _draw(normals: Array, cycle: int, imu: int, purpose: int, seed: int) -> float:
    """Fill `normals` (6,) with standard normal numbers; returns a further number, uniform in [0, 1)."""
    mask = np.uint64(0xFFFFFFFF)
    key0, key1 = np.uint64(seed) & mask, np.uint64(seed) >> np.uint64(32)
    low, high = np.uint64(cycle) & mask, np.uint64(cycle) >> np.uint64(32)
    a, b, c, d = philox(low, high, imu, 2 * purpose, key0, key1)
    normals[0], normals[1] = _normal_pair(a, b)
    normals[2], normals[3] = _normal_pair(c, d)
    a, b, c, d = philox(low, high, imu, 2 * purpose + 1, key0, key1)
    normals[4], normals[5] = _normal_pair(a, b)
    return np.float64(c) * 2.0**-32


_MEASURE, _MAGNETIC, _WALK = 0, 1, 2


@kernel
def measure(state: Record, ideal: Array, measurement: Array) -> None:
    """Write the IMUs' raw readings (3, 7, 3) of ideal signals (3, 7, 3), and advance `state` by one cycle."""
    s = state[()]
    first = s.cycle == 0
    normals = s.normals
    fresh_field = s.cycle % s.magnetometer_every == 0
    noisy = s.noise[GYROSCOPE] > 0.0 or s.noise[ACCELEROMETER] > 0.0 or s.dropout > 0.0
    walking = s.drift[GYROSCOPE] > 0.0 or s.drift[ACCELEROMETER] > 0.0
    slot = s.cycle % (s.delay + 1)
    for imu in range(IMU_COUNT):
        if walking:
            _draw(normals, s.cycle, imu, _WALK, s.seed)
            for axis in range(3):
                s.bias_walk[GYROSCOPE, imu, axis] += s.drift[GYROSCOPE] * normals[axis]
                s.bias_walk[ACCELEROMETER, imu, axis] += s.drift[ACCELEROMETER] * normals[3 + axis]
        dropped = False
        if noisy:
            dropped = _draw(normals, s.cycle, imu, _MEASURE, s.seed) < s.dropout and not first
        else:
            normals[:] = 0.0
        for kind in range(3):
            magnetic = kind == MAGNETOMETER
            stale = magnetic and not fresh_field
            if magnetic and fresh_field and s.noise[kind] > 0.0:
                _draw(normals, s.cycle, imu, _MAGNETIC, s.seed)
            gain, signal = s.gain[kind, imu], ideal[kind, s.place[imu]]
            for axis in range(3):
                smoothed = s.smoothed[kind, imu, axis]
                if not stale:
                    value = s.offset[kind, imu, axis]
                    value += gain[axis, 0] * signal[0] + gain[axis, 1] * signal[1] + gain[axis, 2] * signal[2]
                    if magnetic:
                        value += s.noise[kind] * normals[axis]
                    else:
                        value += s.bias_walk[kind, imu, axis] + s.noise[kind] * normals[3 * kind + axis]
                    before, share = s.smoothing[kind, 0], s.smoothing[kind, 1]
                    if first or share == 1.0:
                        smoothed = value
                    else:
                        smoothed += before * (s.value[kind, imu, axis] - smoothed) + share * (value - smoothed)
                    s.value[kind, imu, axis] = value
                    s.smoothed[kind, imu, axis] = smoothed
                delayed = smoothed
                if s.delay > 0:
                    if first:
                        s.queue[:, kind, imu, axis] = smoothed
                    s.queue[slot, kind, imu, axis] = smoothed
                    delayed = s.queue[(slot + 1) % (s.delay + 1), kind, imu, axis]
                delayed = min(max(delayed, -s.reach[kind]), s.reach[kind])
                if s.resolution[kind] > 0.0:
                    delayed = np.rint(delayed / s.resolution[kind]) * s.resolution[kind]
                if not dropped:
                    s.reading[kind, imu, axis] = delayed
    s.cycle += 1
    for kind in range(3):
        for imu in range(IMU_COUNT):
            for axis in range(3):
                measurement[kind, imu, axis] = s.reading[kind, imu, axis]
