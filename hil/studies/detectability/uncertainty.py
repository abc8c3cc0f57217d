"""What is not known of a sound machine; quick to load."""

from dataclasses import dataclass, fields
from math import inf, radians

from hil.option import option
from plant.errors import InputError


@dataclass(frozen=True)
class Uncertainty:
    """Standard deviations of all that is not known without a fault, per axis, in SI units.

    They are those of a calibrated MPU-9150 after a rest with imperfections of nominal size, and of drives without encoders, so
    that a sound machine is one of this model.
    """

    gyroscope_bias: float = option(radians(0.01), "standard deviation of a gyroscope's bias, after a rest", unit="rad/s")
    accelerometer_bias: float = option(0.015, "standard deviation of an accelerometer's bias", unit="m/s2")
    gyroscope_walk: float = option(
        radians(0.005), "standard deviation of the change of a gyroscope's bias in 1 s", unit="rad/s"
    )
    accelerometer_walk: float = option(1e-3, "standard deviation of the change of an accelerometer's bias in 1 s", unit="m/s2")
    gyroscope_wander: float = option(
        radians(0.02), "standard deviation of a gyroscope's error that comes and goes", unit="rad/s"
    )
    accelerometer_wander: float = option(
        3e-3, "standard deviation of an accelerometer's error that comes and goes", unit="m/s2"
    )
    wander_time: float = option(0.5, "correlation time of the errors that come and go", unit="s")
    drive_rate: float = option(
        2.5e-3, "standard deviation of a leg's rate from its command, because of load, resistance and friction", unit="m/s"
    )
    drive_time: float = option(1.0, "correlation time of --drive-rate", unit="s")
    drive_noise: float = option(2e-4, "white noise of a leg's rate, RMS in a bandwidth of 1 Hz", unit="m/s")
    jerk: float = option(6.0, "white noise of the platform's jerk, RMS in a bandwidth of 1 Hz", unit="m/s3")
    angular_jerk: float = option(35.0, "white noise of the platform's angular jerk, RMS in a bandwidth of 1 Hz", unit="rad/s3")

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < inf:
                raise InputError(f"the {field.name} of the uncertainty is {value}; it must be positive and finite")
