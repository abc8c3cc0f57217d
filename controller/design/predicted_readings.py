"""What the IMUs and encoders of a machine should read along given commands, by its plant FMU, for the fit of its actuators.

The plant starts at rest at a pose, with its drives enabled. A command takes effect a delay after the cycle that computed it.
Readings pass through the low-passes of the IMUs, and have none of their errors.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT, VELOCITY
from plant.fmu.build import default_fmu, model_of
from plant.fmu.calls import advance, read_imus, read_motors, write_command, write_drive_mode
from plant.fmu.plant import FmuPlant
from plant.imu import ImuModel, SensorErrors, imu_state, measure
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose

_INSTANT_S = 1e-9
"""Times that are closer are one [s]."""

_ERRORS: dict[str, Any] = {
    name: getattr(SensorErrors(), name)
    for name in (
        "noise", "bias", "scale", "cross_axis", "drift", "resolution", "bias_per_kelvin", "scale_per_kelvin",
        "bias_per_volt", "rectification",
    )
}  # fmt: skip


def without_errors(model: ImuModel) -> ImuModel:
    """The kind of IMU with its low-passes, delay and ranges, and no error; it samples at the cycles."""
    return replace(
        ImuModel(model.name),
        gyroscope=replace(model.gyroscope, **_ERRORS),
        accelerometer=replace(model.accelerometer, **_ERRORS),
        delay=model.delay,
    )


@dataclass(frozen=True, eq=False)
class Commands:
    """What a loop has told the drives.

    Attributes:
        times: (N,) [s], increasing from 0: of the exchanges with the machine, at which its IMUs are read.
        velocities: (N, n) [m/s], computed from the readings at these times.
    """

    times: Array
    velocities: Array

    def until(self, time: float) -> "Commands":
        """The commands up to a time [s]."""
        count = int(np.searchsorted(self.times, time, side="right"))
        return Commands(self.times[:count], self.velocities[:count])


@dataclass(frozen=True, eq=False)
class Readings:
    """What sensors read, or should read: `imus` (N, 2, 7, 3) [rad/s, m/s^2], and `lengths` (N, 6) [m] of the encoders."""

    imus: Array
    lengths: Array


class Prediction:
    """The plant of a mechanism with one kind of IMU, open until `close`."""

    def __init__(self, mechanism: Mechanism, imu: ImuModel, period: float) -> None:
        """Open the plant, for cycles of `period` [s]."""
        self.mechanism = mechanism
        self._imu, self._period = without_errors(imu), period
        self._plant = FmuPlant(default_fmu(model_of(mechanism)), mechanism.plant_parameters(), period, legs=mechanism.legs)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the plant; a second call does nothing."""
        self._plant.close()

    def readings(
        self, commands: Commands, parameters: Mapping[str, ArrayLike], start: Pose, delay: float, at: Array | None = None
    ) -> Readings:
        """The readings along commands.

        Args:
            commands: to the drives.
            parameters: of the plant, by name, that differ from the mechanism's.
            start: the pose at which the platform rests at first.
            delay: from the exchange that takes a sample to the effect of the command computed from it [s].
            at: (M,) [s], evenly spread times at which to read; by default those of the exchanges.

        Raises:
            FmuError: the plant refuses a parameter, or fails.
        """
        self._plant.restart({**self.mechanism.plant_parameters(start), **parameters})
        at = commands.times if at is None else at
        imu = imu_state(self._imu, 0, self._period * len(commands.times) / len(at))
        found = Readings(np.zeros((len(at), 3, IMU_COUNT, 3)), np.full((len(at), LEGS), np.nan))
        if _follow(self._plant.handle, imu, at, commands.times, commands.velocities, delay, found.imus, found.lengths):
            raise self._plant.failure()
        return replace(found, imus=found.imus[:, :2])


@kernel
def _follow(
    fmu: Record, imu: Record, at: Array, times: Array, velocities: Array, delay: float, readings: Array, lengths: Array
) -> int:  # fmt: skip
    """Write the readings (M, 3, 7, 3) of IMUs, and (M, 6) of encoders, along commands (N, n); returns the FMU's status."""
    c = fmu[()]
    # Until the first command takes effect, it counts already.
    status = write_drive_mode(fmu, VELOCITY) | write_command(fmu, velocities[0])
    due = 1
    for k in range(at.shape[0]):
        while True:
            while due < times.shape[0] and times[due] + delay <= c.time + _INSTANT_S:
                status |= write_command(fmu, velocities[due])
                due += 1
            until = at[k]
            if due < times.shape[0]:
                until = min(until, times[due] + delay)
            if until <= c.time + _INSTANT_S:
                break
            status |= advance(fmu, until - c.time)
            if status != 0:
                return status
        status |= read_imus(fmu) | read_motors(fmu)
        measure(imu, c.imu, readings[k])
        for i in range(c.legs):
            lengths[k, i] = c.motors[i]
    return status
