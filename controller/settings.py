"""Settings of the controller: `control`, `fusion`, `safety` and `drives` in a mechanism's file, checked when they are read."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from math import hypot, inf, pi, radians, sqrt
from typing import ClassVar, TypeVar

from plant.encoders import EncoderModel
from plant.errors import InputError
from plant.files import check_entries
from plant.imu import STANDARD_GRAVITY, ImuModel, sampled_noise
from plant.mechanism import Mechanism

_ENDLESS = 1e300
_LEAST_LENGTH_NOISE = 1e-6
_RAW_M, _FEW_M = 0.05, 0.03
_ENDLESS_ALLOWED = (
    "length_deviation",
    "misfit",
    "evidence",
    "protection_position",
    "protection_rotation",
    "oscillation",
    "slack",
)
_ZERO_ALLOWED = (
    "integral", "derivative", "position_integral", "sensor_delay", "sensor_timing", "most_lost_imus", "watch_imus",
    "need_platform_imu", "load", "resistance", "friction",
)  # fmt: skip
_SWITCHES = "watch_imus", "need_platform_imu"
_MOST = {"protection_position": (1.0, "m"), "protection_rotation": (pi, "rad")}

_LOW_RATE_HZ = 250.0
_HOLD_AT_LOW_RATES_S = 1.0

S = TypeVar("S", "ControlSettings", "FusionSettings", "SafetySettings", "DriveSettings")


@dataclass(frozen=True)
class _Settings:
    """Settings that must be positive and finite, except zero or no limit is allowed, and switches, which are 0 or 1."""

    table: ClassVar[str]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            endless, zero = field.name in _ENDLESS_ALLOWED, field.name in _ZERO_ALLOWED
            if value == inf and endless:
                continue
            most, _ = _MOST.get(field.name, (inf, ""))
            switch = field.name in _SWITCHES
            if not 0.0 <= value < inf or value > most or (value == 0.0 and not zero) or (switch and value not in (0.0, 1.0)):
                raise InputError(f"[{self.table}] {field.name} is {value}; it must be {self.allowed(field.name)}")

    @staticmethod
    def allowed(name: str) -> str:
        """Which values a setting may have, in words."""
        if name in _SWITCHES:
            return "0 or 1"
        sign = "0 or positive" if name in _ZERO_ALLOWED else "positive"
        if name in _MOST:
            most, unit = _MOST[name]
            sign += f", in {unit} and at most {most:.3g}"
        return f"{sign}; inf is no limit" if name in _ENDLESS_ALLOWED else f"{sign} and finite"


@dataclass(frozen=True)
class ControlSettings(_Settings):
    """Gains of the six PID controllers, designed by `controller.design.tuning`, and the time at which feedback closes."""

    table = "control"

    proportional: float = 60.0  # gain on the deviation of a length [1/s]
    integral: float = 200.0  # gain on its integral [1/s^2]
    derivative: float = 0.0  # gain on its derivative [-]
    derivative_bandwidth: float = 100.0  # corner of the derivative's low-pass [rad/s]
    hold: float = 0.2  # so long the brakes hold while the estimate settles; below 250 Hz at least 1 s [s]
    command_reserve: float = 1.4  # largest command, as a multiple of the actuators' velocity limit
    position_proportional: float = 15.0  # instead of `proportional` where drives close position loops [1/s]
    position_integral: float = 10.0  # instead of `integral` [1/s^2]

    def for_position_drives(self) -> "ControlSettings":
        """These settings for drives that close position loops, as load and friction are not left to the feedback.

        An outer loop must be slower than the one within it: gains for drives that follow velocities let stiff ones oscillate.
        """
        return replace(self, proportional=self.position_proportional, integral=self.position_integral, derivative=0.0)

    def hold_at(self, rate: float) -> float:
        """How long the brakes hold in a loop of this rate [Hz]: `hold`, but at low rates at least 1 s.

        The filters begin with large gains on the accelerometers. With few cycles per second, these let the loop oscillate.
        """
        return max(self.hold, _HOLD_AT_LOW_RATES_S) if rate < _LOW_RATE_HZ else self.hold


@dataclass(frozen=True)
class FusionSettings(_Settings):
    """Noise that the filters and the refinement assume: densities, random walks, and standard deviations.

    The accelerometers' noise is well above the data sheet's: the filters do not estimate bias and scale, which would look like
    motion. Jerk and noise of the whole-mechanism filter are such that its covariance is as large as its errors.
    """

    table = "fusion"

    leg_jerk: float = 100.0  # density of the legs' angular jerk [rad/s^3/sqrt(Hz)]
    bias_walk: float = 3.2e-5  # of the gyroscopes' biases [rad/s/sqrt(s)]
    bias_sigma: float = radians(0.4)  # of a gyroscope's bias at the start [rad/s]
    gyroscope_noise: float = radians(0.005)  # of the gyroscopes, density [rad/s/sqrt(Hz)]
    leg_accelerometer_noise: float = 0.018  # of the legs' accelerometers, density [m/s^2/sqrt(Hz)]
    platform_accelerometer_noise: float = 0.0134  # of the platform's accelerometer, density [m/s^2/sqrt(Hz)]
    leg_sigma: float = radians(0.06)  # of each component of a leg's direction, for the refinement [rad]
    tilt_sigma: float = radians(0.06)  # of the platform's roll and pitch, for the refinement [rad]
    magnetometer_noise: float = 0.052  # of the magnetometers, density, including that of its resolution [uT/sqrt(Hz)]
    magnetometer_rate: float = 100.0  # samples per second; between samples the last one is repeated [Hz]
    heading_sigma: float = radians(1.0)  # of the heading that its calibration leaves, for the refinement [rad]
    acceleration_time: float = 0.01  # time constant of the platform's acceleration, the derivative of its twist [s]
    sensor_delay: float = 0.0  # age of the IMUs' readings [s]
    sensor_timing: float = 0.0  # standard deviation of that age [s]
    gyroscope_range: float = radians(250.0)  # at its end, a reading is not used [rad/s]
    accelerometer_range: float = 4.0 * STANDARD_GRAVITY  # at its end, a reading is not used [m/s^2]
    length_noise: float = 2e-6  # of an encoder's reading [m]
    length_play: float = 1e-5  # what play and steps leave of it for a while [m]
    length_zero: float = 0.05  # of an encoder's zero at the start [m]
    # For the whole-mechanism filter, the noise with calibrated IMUs.
    platform_jerk: float = 6.0  # of the platform, density [m/s^3/sqrt(Hz)]
    platform_angular_jerk: float = 35.0  # of the platform, density [rad/s^3/sqrt(Hz)]
    mechanism_gyroscope_noise: float = radians(0.0042)  # of calibrated gyroscopes, density [rad/s/sqrt(Hz)]
    mechanism_accelerometer_noise: float = 0.004  # of calibrated accelerometers, density [m/s^2/sqrt(Hz)]
    accelerometer_bias_walk: float = 1e-5  # of the accelerometers' biases [m/s^2/sqrt(s)]
    # For IMUs without a calibration file, which have errors that the filter does not estimate.
    accelerometer_bias_sigma: float = 0.015  # of an accelerometer's bias [m/s^2]
    scale_sigma: float = 1e-3  # of a scale [1]
    alignment_sigma: float = radians(0.1)  # of an angle of the mounting [rad]
    axes_sigma: float = 1e-3  # of an angle between axes [rad]
    noise_inflation: float = 2.75  # factor on the whole-mechanism filter's noises and the platform's jerk
    disagreement: float = radians(1.0)  # RMS of it with the leg filters' directions, beyond which its pose is not used [rad]


@dataclass(frozen=True)
class SafetySettings(_Settings):
    """Limits that are checked while the loop runs."""

    table = "safety"

    most_lost_imus: float = 1.0  # so many may be left out at once
    disagreement: float = radians(1.0)  # of an IMU's direction and that of all others, beyond which it is left out [rad]
    misfit: float = 5.0  # RMS of what a pose leaves of the IMUs' directions without the worst, beyond which a run stops [sigma]
    evidence: float = 8.0  # that something is wrong with the readings, beyond which an IMU is left out or a run stops [sigma]
    protection_position: float = inf  # largest protection level of the position [m]
    protection_rotation: float = inf  # largest protection level of the rotation [rad]
    gyroscope_noise: float = radians(5.0)  # RMS beyond which an IMU is left out [rad/s]
    accelerometer_noise: float = 5.0  # RMS beyond which an IMU is left out [m/s^2]
    vibration: float = 1.5  # RMS of what accelerometers read beyond the motion, from which on it is told [m/s^2]
    carried: float = radians(0.3)  # uncertainty of a direction that shaking adds, beyond which a run ends [rad]
    conditioning: float = 5e-3  # least of the closed form
    stroke_margin: float = 0.003  # largest distance of an estimated length beyond its stroke [m]
    velocity_margin: float = 2.0  # largest estimated speed of a leg, as a multiple of its limit
    following: float = 0.01  # largest deviation of a leg from its reference [m]
    oscillation: float = 0.012  # RMS of fast corrections that shake the IMUs, beyond which a run ends [m/s]
    length_deviation: float = 6.5e-4  # change of a length, within a second, of which IMUs and an encoder differ [m]
    saturation: float = 0.25  # longest time for which a command may be at its limit [s]
    drive_deviation: float = 0.15  # largest difference between a drive's command and its leg's estimated speed [m/s]
    patience: float = 0.05  # longest time of a deviation from a reference or of a drive [s]
    bus_patience: float = 0.02  # longest time without an answer of the rig [s]
    arming_distance: float = 0.01  # largest distance of a leg from the start of the target [m]
    arming_drift: float = 1e-3  # largest change of a leg's mean length on the brakes, from one 50 ms to the next [m]
    arming_time: float = 5.0  # longest time for the checks before arming, and for the drives [s]
    watch_imus: float = 1.0  # 0 to ignore the disagreement of an IMU
    need_platform_imu: float = 1.0  # 0 to go on while the platform's IMU is left out, which checks all legs at once

    def for_raw_imus(self) -> "SafetySettings":
        """These settings for raw IMUs, whose errors move the pose by centimetres."""
        distances = "stroke_margin", "following", "arming_distance", "arming_drift", "length_deviation"
        wide = {name: max(getattr(self, name), _RAW_M) for name in distances}
        return replace(self, watch_imus=0.0, protection_position=inf, protection_rotation=inf, **wide)


@dataclass(frozen=True)
class DriveSettings(_Settings):
    """How far a drive may do otherwise than its model says: what is not known of its load, its motor and its friction."""

    table = "drives"

    load: float = 1.0  # unknown load of a leg, as a share of what the legs carry on average
    resistance: float = 0.2  # by which share a winding's resistance may be off
    friction: float = 2.5  # greatest friction, as a multiple of the Coulomb friction in the plant data
    slack: float = 0.008  # what lag, play, noise and an IMU before it is left out may leave; inf to ignore the drives [m]

    def for_raw_imus(self) -> "DriveSettings":
        """These settings for raw IMUs, whose errors move the pose by centimetres."""
        return replace(self, slack=max(self.slack, _RAW_M))


def control_settings(mechanism: Mechanism, **changes: float) -> ControlSettings:
    """The control settings of a mechanism, with changes by name.

    Raises:
        InputError: an unknown name, or a value that is not a positive number.
    """
    return _read(ControlSettings, mechanism, changes)


def fusion_settings(mechanism: Mechanism, **changes: float) -> FusionSettings:
    """The fusion settings of a mechanism, as `control_settings`."""
    return _read(FusionSettings, mechanism, changes)


def safety_settings(mechanism: Mechanism, **changes: float) -> SafetySettings:
    """The safety settings of a mechanism, as `control_settings`."""
    return _read(SafetySettings, mechanism, changes)


def drive_settings(mechanism: Mechanism, few_imus: bool = False, **changes: float) -> DriveSettings:
    """What is known of the drives of a mechanism, as `control_settings`.

    With few IMUs, whose estimate of a leg moves by up to 23 mm while the filters settle, the slack is wider where the
    mechanism's file has none.
    """
    if few_imus and "slack" not in mechanism.settings.get("drives", {}):
        changes = {"slack": _FEW_M, **changes}
    return _read(DriveSettings, mechanism, changes)


def sensor_settings(
    mechanism: Mechanism, imu: ImuModel, rate: float, encoder: EncoderModel | None = None
) -> FusionSettings:  # fmt: skip
    """The fusion settings of a mechanism, with what its IMUs and encoders tell where its file has none.

    That is the IMUs' delay, magnetometer rate and ranges, the noise that their samples have at the loop's rate [Hz] where it is
    more than the defaults, and the standard deviations that grow with it and with `accelerometer_wander`; and the encoders'
    noise, play and zeros.
    """
    wander, defaults = imu.accelerometer_wander, FusionSettings()
    noisier = max(sampled_noise(imu, imu.gyroscope, rate) / defaults.gyroscope_noise, 1.0)
    of_accelerometers = max(sampled_noise(imu, imu.accelerometer, rate), defaults.mechanism_accelerometer_noise)
    more = sqrt(of_accelerometers**2 - defaults.mechanism_accelerometer_noise**2)
    of_legs = hypot(defaults.leg_accelerometer_noise, more)
    of_platform = hypot(defaults.platform_accelerometer_noise, more)
    # A direction by gyroscopes and accelerometers is as uncertain as the root of the product of their noises.
    leg_sigma = sqrt(noisier * of_legs / defaults.leg_accelerometer_noise) * defaults.leg_sigma
    tilt_sigma = sqrt(noisier * of_platform / defaults.platform_accelerometer_noise) * defaults.tilt_sigma
    known = {
        "sensor_delay": imu.latency,
        "sensor_timing": imu.timing,
        "magnetometer_rate": min(imu.magnetometer_rate, _ENDLESS),
        "gyroscope_range": min(imu.gyroscope.reach, _ENDLESS),
        "accelerometer_range": min(imu.accelerometer.reach, _ENDLESS),
        "gyroscope_noise": noisier * defaults.gyroscope_noise,
        "mechanism_gyroscope_noise": noisier * defaults.mechanism_gyroscope_noise,
        "leg_accelerometer_noise": of_legs,
        "platform_accelerometer_noise": of_platform,
        "mechanism_accelerometer_noise": of_accelerometers,
        "leg_sigma": hypot(leg_sigma, wander / STANDARD_GRAVITY),
        "tilt_sigma": hypot(tilt_sigma, wander / STANDARD_GRAVITY),
        "accelerometer_bias_sigma": hypot(defaults.accelerometer_bias_sigma, wander),
    }
    if encoder is not None:
        step = encoder.resolution / sqrt(12.0)
        known["length_noise"] = max(hypot(encoder.noise, step), _LEAST_LENGTH_NOISE)
        known["length_play"] = max(hypot(0.5 * encoder.backlash, step), _LEAST_LENGTH_NOISE)
        known["length_zero"] = max(encoder.zero, _LEAST_LENGTH_NOISE) if encoder.absolute else defaults.length_zero
    own = mechanism.settings.get("fusion", {})
    return fusion_settings(mechanism, **{name: value for name, value in known.items() if name not in own})


def tables_with(name: str) -> list[str]:
    """The tables of settings in a mechanism's file that have an entry of this name."""
    kinds = ControlSettings, FusionSettings, SafetySettings, DriveSettings
    return [kind.table for kind in kinds if name in (field.name for field in fields(kind))]


def _read(kind: type[S], mechanism: Mechanism, changes: Mapping[str, float]) -> S:
    table = {**mechanism.settings.get(kind.table, {}), **changes}
    check_entries(table, sorted(field.name for field in fields(kind)), f"[{kind.table}]")
    for key, value in table.items():
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise InputError(f"[{kind.table}] {key} must be a number, got {value!r}")
    return kind(**table)
