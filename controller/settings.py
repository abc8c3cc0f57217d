"""Settings of the controller: the tables `control` and `fusion` of a mechanism's preset, checked when they are read."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import radians
from typing import Any, TypeVar

from plant.errors import InputError
from plant.mechanism import Mechanism

S = TypeVar("S", "ControlSettings", "FusionSettings")


@dataclass(frozen=True)
class ControlSettings:
    """Gains of the six PID controllers, designed by `controller.tuning`, and when feedback closes.

    Attributes:
        proportional: [1/s].
        integral: [1/s^2].
        derivative: [-].
        derivative_bandwidth: corner of the derivative's low-pass [rad/s].
        hold: how long the brakes hold while the estimate settles [s].
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
        bias_sigma: what is known of a gyroscope's bias at the start [rad/s].
        gyroscope_noise: [rad/s/sqrt(Hz)].
        leg_accelerometer_noise, platform_accelerometer_noise: [m/s^2/sqrt(Hz)]; well above the data sheet's, because
            bias and scale, which the filters do not estimate, would otherwise be taken for motion.
        leg_sigma: of each component of a leg's direction, for the refinement [rad].
        tilt_sigma: of the platform's roll and pitch, for the refinement [rad].
        acceleration_time: time constant of the platform's acceleration, which is the derivative of its twist [s].
    """

    leg_jerk: float = 100.0
    bias_walk: float = 3.2e-5
    bias_sigma: float = radians(0.4)
    gyroscope_noise: float = radians(0.005)
    leg_accelerometer_noise: float = 0.018
    platform_accelerometer_noise: float = 0.0134
    leg_sigma: float = radians(0.06)
    tilt_sigma: float = radians(0.06)
    acceleration_time: float = 0.01

    def __post_init__(self) -> None:
        _check_positive(self, zero_allowed=set())


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


def _read(kind: type[S], name: str, table: Mapping[str, Any]) -> S:
    known = {field.name for field in fields(kind)}
    for key, value in table.items():
        if key not in known:
            raise InputError(f"[{name}] has no entry {key!r}; it has {', '.join(sorted(known))}")
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise InputError(f"[{name}] {key} must be a number, got {value!r}")
    return kind(**table)


def _check_positive(settings: ControlSettings | FusionSettings, zero_allowed: set[str]) -> None:
    for field in fields(settings):
        value = getattr(settings, field.name)
        if not 0.0 <= value < float("inf") or (value == 0.0 and field.name not in zero_allowed):
            raise InputError(f"{field.name} is {value}; it must be positive and finite")
