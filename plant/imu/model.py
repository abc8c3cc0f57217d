"""A kind of IMU: its sensors' errors, low-passes and clock."""

from dataclasses import dataclass, fields
from math import exp, expm1, hypot, inf, pi, sqrt
from typing import Any

from plant.errors import InputError
from plant.imu_disturbances import SENSORS, Disturbance, DisturbanceKind

STANDARD_GRAVITY = 9.80665
MILLI_G = 1e-3 * STANDARD_GRAVITY

MOST_SECTIONS = 4
"""The greatest order of a sensor's low-pass."""
MOST_CONVERSIONS = 4096
"""The most conversions of an IMU in a cycle; what else fell due in a long gap is left out."""


def _check_not_negative(what: str, value: Any) -> None:
    try:
        numbers = value if isinstance(value, tuple) else (value,)
        good = all(float(number) >= 0.0 for number in numbers)
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
    bandwidth: float = inf  # -3 dB frequency of the low-pass [Hz]
    order: int = 1  # of the low-pass: so many equal sections of first order
    reach: float = inf  # largest reading, and what an oversampling part can convert
    resolution: float = 0.0  # step of the reading; 0 for none
    bias_per_kelvin: tuple[float, float] = (0.0, 0.0)  # common, in one random direction; of each IMU, at most [unit/K]
    scale_per_kelvin: tuple[float, float] = (0.0, 0.0)  # greatest of an axis, uniform: common; of each IMU [1/K]
    bias_per_volt: tuple[float, float] = (0.0, 0.0)  # as bias_per_kelvin [unit/V]
    rectification: float = 0.0  # bias over the mean square of the signal: the sensor reads x + rectification x^2 [1/unit]

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_not_negative(f"the {field.name} of a sensor", getattr(self, field.name))
        if self.bandwidth == 0.0:
            raise InputError("the bandwidth of a sensor is 0; it must be positive: leave it out if there is no low-pass")
        if self.order not in range(1, MOST_SECTIONS + 1):
            raise InputError(f"the order of a sensor is {self.order}; it must be a whole number from 1 to {MOST_SECTIONS}")

    @property
    def section_bandwidth(self) -> float:
        """-3 dB frequency of each section of the low-pass, so that together they have the bandwidth [Hz]."""
        return self.bandwidth / sqrt(2.0 ** (1.0 / self.order) - 1.0)

    def smoothing(self, period: float) -> tuple[float, float]:
        """The shares of the previous and the new input in a step of a section, between which the input goes straight [s]."""
        ratio = 2.0 * pi * self.section_bandwidth * period
        if ratio == inf:
            return 0.0, 1.0
        if ratio == 0.0:
            return 0.0, 0.0
        share = -expm1(-ratio)
        return share / ratio - exp(-ratio), 1.0 - share / ratio


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
    sample_rate: float = 0.0  # of a clock of its own, which the loop reads when it likes [Hz]; 0: the loop's cycles
    clock_error: float = 0.0  # greatest relative error of its own clock, uniform
    jitter: float = 0.0  # RMS of the time by which a conversion comes early [s]
    conversion_rate: float = 0.0  # of the conversions that the low-pass takes in, a multiple of the samples' [Hz]; 0: one each
    low_passes: tuple[tuple[float, float, int], ...] = ()  # its settings: bandwidth of gyroscope, accelerometer [Hz]; order
    sparing: bool = False  # whether it converts once a sample while nothing shakes it, as signals hardly curve between samples
    disturbances: tuple[Disturbance, ...] = ()  # that are part of its normal life

    def __post_init__(self) -> None:
        for name in (
            "magnetometer_rate", "misalignment", "delay", "dropout", "sample_rate", "clock_error", "jitter", "conversion_rate",
        ):  # fmt: skip
            _check_not_negative(f"the {name} of an IMU", getattr(self, name))
        if self.magnetometer_rate == 0.0:
            raise InputError("the magnetometer_rate of an IMU is 0; it must be positive: leave it out to read it in each cycle")
        if not self.delay < inf:
            raise InputError("the delay of an IMU is infinite; it must be finite")
        if self.dropout > 1.0:
            raise InputError(f"the dropout of an IMU is {self.dropout}; it is a probability, at most 1")
        if not (max(self.sample_rate, self.conversion_rate, self.jitter) < inf and self.clock_error < 1.0):
            raise InputError(
                "the sample_rate, conversion_rate and jitter of an IMU must be finite, its clock_error below 1; they are "
                f"{self.sample_rate:g}, {self.conversion_rate:g}, {self.jitter:g} and {self.clock_error:g}"
            )

    @property
    def latency(self) -> float:
        """Mean delay of gyroscope and accelerometer, with their low-passes and the wait for the loop [s]."""
        filters = sum(
            0.5 * sensor.order / (2.0 * pi * sensor.section_bandwidth) for sensor in (self.gyroscope, self.accelerometer)
        )
        return self.delay + filters + (0.5 / self.sample_rate if self.sample_rate else 0.0)

    @property
    def timing(self) -> float:
        """Standard deviation of that delay from sample to sample, by jitter and the wait for the loop [s]."""
        return hypot(self.jitter, 1.0 / (self.sample_rate * sqrt(12.0)) if self.sample_rate else 0.0)

    @property
    def accelerometer_wander(self) -> float:
        """By how much an axis of the accelerometer wanders in the IMU's normal life, after a calibration [m/s^2].

        This is a standard deviation over IMUs, axes and times: of what temperature and supply do to bias and scale, and of the
        bias that rectified vibration leaves. Axes are in any direction to gravity, and `disturbances` are independent.
        """
        sensor, variance = self.accelerometer, 0.0
        # The mean square along an axis of a random direction is a third, and so is that of a uniform number.
        bias_per_kelvin, bias_per_volt = (
            (common**2 + own**2 / 3.0) / 3.0 for common, own in (sensor.bias_per_kelvin, sensor.bias_per_volt)
        )
        scale_per_kelvin = sum(part**2 for part in sensor.scale_per_kelvin) / 3.0
        for each in self.disturbances:
            if each.kind == DisturbanceKind.TEMPERATURE:
                variance += each.mean_square * (bias_per_kelvin + scale_per_kelvin * STANDARD_GRAVITY**2 / 3.0)
            elif each.kind == DisturbanceKind.SUPPLY:
                variance += each.mean_square * bias_per_volt
            elif each.kind == DisturbanceKind.VIBRATION and SENSORS[each.sensor] == "accelerometer":
                rectified = sensor.rectification * each.mean_square
                variance += sum((rectified * part**2) ** 2 for part in each.axis) / 3.0
        return sqrt(variance)
