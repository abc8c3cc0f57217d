"""Settings of the controller: the tables `control`, `fusion` and `safety` of a mechanism's file, checked when they are read."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import radians
from typing import Any, TypeVar

from plant.errors import InputError
from plant.imu import STANDARD_GRAVITY, ImuModel
from plant.mechanism import Mechanism
from plant.toml import check_entries

_ENDLESS = 1e300
_RAW_M = 0.05

S = TypeVar("S", "ControlSettings", "FusionSettings", "SafetySettings")


@dataclass(frozen=True)
class ControlSettings:
    """Gains of the six PID controllers, designed by `controller.design.tuning`, and the time at which feedback closes.

    Attributes:
        proportional: gain [1/s].
        integral: gain [1/s^2].
        derivative: gain [-].
        derivative_bandwidth: corner of the derivative's low-pass [rad/s].
        hold: time for which the brakes hold while the estimate settles [s].
        command_reserve: largest command as a multiple of the actuators' velocity limit.
    """

    proportional: float = 60.0
    integral: float = 200.0
    derivative: float = 0.0
    derivative_bandwidth: float = 100.0
    hold: float = 0.2
    command_reserve: float = 1.4

    def __post_init__(self) -> None:
        _check_positive(self, zero_allowed={"integral", "derivative"})


@dataclass(frozen=True)
class FusionSettings:
    """Noise that the filters and the refinement assume.

    Attributes:
        leg_jerk: density of the legs' angular jerk [rad/s^3/sqrt(Hz)].
        bias_walk: random walk of the gyroscopes' biases [rad/s/sqrt(s)].
        bias_sigma: standard deviation of a gyroscope's bias at the start [rad/s].
        gyroscope_noise: density [rad/s/sqrt(Hz)].
        leg_accelerometer_noise, platform_accelerometer_noise: density [m/s^2/sqrt(Hz)]; well above the data sheet's: the
            filters do not estimate bias and scale, and would take them for motion.
        leg_sigma: standard deviation of each component of a leg's direction, for the refinement [rad].
        tilt_sigma: standard deviation of the platform's roll and pitch, for the refinement [rad].
        magnetometer_noise: density, including that of its resolution [uT/sqrt(Hz)].
        magnetometer_rate: samples per second; between samples the last one is repeated [Hz].
        heading_sigma: standard deviation of the heading that its calibration leaves, for the refinement [rad].
        acceleration_time: time constant of the platform's acceleration, which is the derivative of its twist [s].
        sensor_delay: age of the IMUs' readings [s].
        gyroscope_range, accelerometer_range: from this size on, a reading is not used [rad/s, m/s^2].
        platform_jerk, platform_angular_jerk: density of the platform's jerk, for the whole-mechanism filter
            [m/s^3/sqrt(Hz), rad/s^3/sqrt(Hz)].
        mechanism_gyroscope_noise, mechanism_accelerometer_noise: density for that filter with calibrated IMUs
            [rad/s/sqrt(Hz), m/s^2/sqrt(Hz)]; chosen with the jerk so that its covariance is as large as its errors.
        accelerometer_bias_walk: random walk of the accelerometers' biases [m/s^2/sqrt(s)].
        accelerometer_bias_sigma, scale_sigma, alignment_sigma, axes_sigma: standard deviations for IMUs without a calibration
            file [m/s^2, 1, rad, rad].
        noise_inflation: factor on these noises and the platform's jerk for IMUs without a calibration file, which have errors
            that the filter does not estimate.
        disagreement: RMS angle between the leg filters' directions and the whole-mechanism filter's pose that ends the use of
            that pose [rad].
    """

    leg_jerk: float = 100.0
    bias_walk: float = 3.2e-5
    bias_sigma: float = radians(0.4)
    gyroscope_noise: float = radians(0.005)
    leg_accelerometer_noise: float = 0.018
    platform_accelerometer_noise: float = 0.0134
    leg_sigma: float = radians(0.06)
    tilt_sigma: float = radians(0.06)
    magnetometer_noise: float = 0.052
    magnetometer_rate: float = 100.0
    heading_sigma: float = radians(1.0)
    acceleration_time: float = 0.01
    sensor_delay: float = 0.0
    gyroscope_range: float = radians(250.0)
    accelerometer_range: float = 4.0 * STANDARD_GRAVITY
    platform_jerk: float = 6.0
    platform_angular_jerk: float = 35.0
    mechanism_gyroscope_noise: float = radians(0.0042)
    mechanism_accelerometer_noise: float = 0.004
    accelerometer_bias_walk: float = 1e-5
    accelerometer_bias_sigma: float = 0.015
    scale_sigma: float = 1e-3
    alignment_sigma: float = radians(0.1)
    axes_sigma: float = 1e-3
    noise_inflation: float = 2.75
    disagreement: float = radians(1.0)

    def __post_init__(self) -> None:
        _check_positive(self, zero_allowed={"sensor_delay"})


@dataclass(frozen=True)
class SafetySettings:
    """Limits that are checked while the loop runs.

    Attributes:
        most_lost_imus: number of IMUs that may be left out at once.
        disagreement: angle between an IMU's direction and that of all others, beyond which the IMU is left out [rad].
        gyroscope_noise, accelerometer_noise: RMS noise beyond which an IMU is left out [rad/s, m/s^2].
        conditioning: least conditioning of the closed form.
        stroke_margin: largest distance of an estimated length beyond its stroke [m].
        velocity_margin: largest estimated speed of a leg, as a multiple of its limit.
        following: largest deviation of a leg from its reference [m].
        saturation: longest time for which a command may be at its limit [s].
        drive_deviation: largest difference between a drive's command and its leg's estimated speed [m/s].
        patience: longest time of a deviation from a reference or of a drive [s].
        bus_patience: longest time without an answer of the rig [s].
        arming_distance: largest distance of a leg from the start of the target [m].
        arming_time: longest time for the checks before arming, and for the drives [s].
        watch_imus: 0 to ignore the disagreement of an IMU.
    """

    most_lost_imus: float = 1.0
    disagreement: float = radians(1.0)
    gyroscope_noise: float = radians(5.0)
    accelerometer_noise: float = 5.0
    conditioning: float = 5e-3
    stroke_margin: float = 0.003
    velocity_margin: float = 2.0
    following: float = 0.01
    saturation: float = 0.25
    drive_deviation: float = 0.15
    patience: float = 0.05
    bus_patience: float = 0.02
    arming_distance: float = 0.01
    arming_time: float = 1.0
    watch_imus: float = 1.0

    def __post_init__(self) -> None:
        _check_positive(self, zero_allowed={"most_lost_imus", "watch_imus"})

    def for_raw_imus(self) -> "SafetySettings":
        """These settings for raw IMUs, whose errors move the pose by centimetres."""
        wide = {name: max(getattr(self, name), _RAW_M) for name in ("stroke_margin", "following", "arming_distance")}
        return replace(self, watch_imus=0.0, **wide)


def control_settings(mechanism: Mechanism, **changes: float) -> ControlSettings:
    """The control settings of a mechanism, with changes by name.

    Raises:
        InputError: an unknown name, or a value that is not a positive number.
    """
    return _read(ControlSettings, "control", {**mechanism.settings.get("control", {}), **changes})


def fusion_settings(mechanism: Mechanism, **changes: float) -> FusionSettings:
    """The fusion settings of a mechanism, with changes by name.

    Raises:
        InputError: an unknown name, or a value that is not a positive number.
    """
    return _read(FusionSettings, "fusion", {**mechanism.settings.get("fusion", {}), **changes})


def safety_settings(mechanism: Mechanism, **changes: float) -> SafetySettings:
    """The safety settings of a mechanism, with changes by name.

    Raises:
        InputError: an unknown name, or a value that is not a positive number.
    """
    return _read(SafetySettings, "safety", {**mechanism.settings.get("safety", {}), **changes})


def sensor_settings(mechanism: Mechanism, imu: ImuModel) -> FusionSettings:
    """The fusion settings of a mechanism, with delay, magnetometer rate and ranges of its IMUs where its file has none."""
    known = {
        "sensor_delay": imu.latency,
        "magnetometer_rate": min(imu.magnetometer_rate, _ENDLESS),
        "gyroscope_range": min(imu.gyroscope.reach, _ENDLESS),
        "accelerometer_range": min(imu.accelerometer.reach, _ENDLESS),
    }
    own = mechanism.settings.get("fusion", {})
    return fusion_settings(mechanism, **{name: value for name, value in known.items() if name not in own})


def _read(kind: type[S], name: str, table: Mapping[str, Any]) -> S:
    check_entries(table, sorted(field.name for field in fields(kind)), f"[{name}]")
    for key, value in table.items():
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise InputError(f"[{name}] {key} must be a number, got {value!r}")
    return kind(**table)


def _check_positive(settings: ControlSettings | FusionSettings | SafetySettings, zero_allowed: set[str]) -> None:
    for field in fields(settings):
        value = getattr(settings, field.name)
        if not 0.0 <= value < float("inf") or (value == 0.0 and field.name not in zero_allowed):
            raise InputError(f"{field.name} is {value}; it must be positive and finite")
