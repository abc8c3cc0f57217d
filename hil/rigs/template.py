"""A rig to start from: copy this file, and put your hardware in the place of `KinematicHexapod`.

    gough check-rig --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200
    gough check-rig --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200 --move
    gough run       --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200

The places to change are marked by 1 to 6. Set the drives' own watchdog, too: drives without a command for some periods must
stop by themselves, because the loop may die.
"""

import time

import numpy as np

from hil.rigs import ANSWERED, ENABLED, FOLLOWING, READY, SILENT, Identity, RigError
from hil.rigs.kinematic import KinematicHexapod
from plant.compiled import Record
from plant.mechanism import Mechanism
from plant.pose import Array

SPEED_LIMIT = 0.35
"""The largest velocity of a drive [m/s]."""


class TemplateRig:
    """Six velocity drives and seven IMUs.

    Args:
        mechanism: what the rig drives.
        period: of the exchanges [s].
        rig_at: the rig's address, from the command line's --rig-at; None without one.
    """

    def __init__(self, mechanism: Mechanism, period: float, rig_at: str | None) -> None:
        # A command takes effect at the exchange after that of its sample.
        self.command_delay = period
        self._mechanism, self._rig_at = mechanism, rig_at
        self._hardware: KinematicHexapod | None = None
        self._opened_ns = 0

    def open(self) -> None:
        """Open the hardware. When this returns, no thread may run, and everything for numba must be compiled."""
        # 1: open the port or bus at rig_at; turn every error into a RigError that says what to do.
        if self._rig_at == "nowhere":
            raise RigError("there is no hardware at nowhere: check --rig-at, cable and power")
        self._hardware, self._opened_ns = KinematicHexapod(self._mechanism), time.monotonic_ns()

    def identify(self) -> Identity:
        """Ask every part for its identity, and refuse an unexpected one."""
        self._check_open()
        # 2: ask for serial numbers and firmware, and compare them.
        return Identity("template", {"drives": "six of the first order", "IMUs": "seven ideal ones"})

    def arm(self) -> None:
        """Reset faults and make the drives ready; they stay on their brakes."""
        self._check_open()
        # 3: reset and prepare each drive; raise a RigError if its fault stays.

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Commands out, samples in (see `hil.rigs.Rig.exchange`)."""
        hardware = self._hardware
        if hardware is None:
            return SILENT
        began = time.monotonic_ns()
        # NaN is no command.
        wanted = np.where(np.isnan(command), 0.0, command) if request == ENABLED else np.zeros(6)
        velocities = np.clip(wanted, -SPEED_LIMIT, SPEED_LIMIT)
        try:
            read_imus(hardware, began - self._opened_ns, feedback)
            read_encoders(hardware, feedback)
            drive(hardware, velocities, feedback)
        except OSError:
            return SILENT
        feedback["drive"] = FOLLOWING if request == ENABLED else READY
        feedback["round_trip_ns"] = time.monotonic_ns() - began
        return ANSWERED

    def quick_stop(self) -> None:
        """Stop the drives, whatever has happened; this must not raise, even if they are gone."""
        if self._hardware is not None:
            self._hardware.commands = np.zeros(6)

    def close(self) -> None:
        """Leave the drives on their brakes, and close the hardware."""
        self.quick_stop()
        self._hardware = None

    def _check_open(self) -> None:
        if self._hardware is None:
            raise RigError("the rig is not open: open it first")


def drive(hardware: KinematicHexapod, velocities: Array, feedback: Record) -> None:
    """4: Send the velocities (6,) [m/s], which hold from now on, and note what was really sent after rounding."""
    hardware.commands = velocities
    feedback["sent"] = velocities


def read_imus(hardware: KinematicHexapod, time_ns: int, feedback: Record) -> None:
    """5: Read the IMUs: rad/s, m/s^2 and uT in their own axes, the time of each sample on one clock, and its number, which
    changes only with a new sample. Hardware does not know the truth and leaves it unchanged.
    """
    hardware.advance(time_ns)
    feedback["measurement"] = hardware.signals
    feedback["sample_ns"] = time_ns
    feedback["sequence"] += 1
    feedback["truth"][:13] = hardware.truth()


def read_encoders(hardware: KinematicHexapod, feedback: Record) -> None:
    """6: Read the encoders, if there are any: lengths [m] from any zero, positive when a leg extends, their rates [m/s], and
    home switches, 1 beyond the switch and 0 before it. Without encoders, leave this function out.
    """
    feedback["length"], feedback["length_rate"] = hardware.lengths, hardware.velocities
