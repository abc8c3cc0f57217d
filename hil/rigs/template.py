"""A rig to start from: copy this file, and put your hardware in the place of `KinematicHexapod`.

    gough check-rig --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200
    gough check-rig --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200 --move
    gough run       --rig python:my_rig:MyRig --rig-at /dev/ttyUSB0 --rate 200

What to change is marked by 1 to 5. The drives' own watchdog is yours to set: drives that are told nothing for some periods must
stop by themselves, for the loop may die.
"""

import time

import numpy as np

from hil.rigs import ANSWERED, ENABLED, FOLLOWING, READY, SILENT, Identity, RigError
from hil.rigs.kinematic import KinematicHexapod
from plant.compiled import Record
from plant.mechanism import Mechanism
from plant.pose import Array

SPEED_LIMIT = 0.35
"""Of each drive [m/s]."""


class TemplateRig:
    """Six velocity drives and seven IMUs.

    Args:
        mechanism: what is driven.
        period: of the exchanges [s].
        rig_at: where it is, from the command line's --rig-at; None without one.
    """

    def __init__(self, mechanism: Mechanism, period: float, rig_at: str | None) -> None:
        # A command takes effect by the exchange after the one in which its sample was taken.
        self.command_delay = period
        self._mechanism, self._rig_at = mechanism, rig_at
        self._hardware: KinematicHexapod | None = None
        self._opened_ns = 0

    def open(self) -> None:
        """Take hold of the hardware. No thread may run when this returns, and what numba compiles must be compiled."""
        # 1: open the port or bus that rig_at names; let every error be a RigError that says what to do.
        if self._rig_at == "nowhere":
            raise RigError("there is no hardware at nowhere: check --rig-at, cable and power")
        self._hardware, self._opened_ns = KinematicHexapod(self._mechanism), time.monotonic_ns()

    def identify(self) -> Identity:
        """Ask every part who it is, and refuse what is not as expected."""
        self._check_open()
        # 2: ask for serial numbers and firmware, and compare them.
        return Identity("template", {"drives": "six of the first order", "IMUs": "seven ideal ones"})

    def arm(self) -> None:
        """Reset faults and make the drives ready; they stay on their brakes."""
        self._check_open()
        # 3: reset and prepare each drive; a RigError if one has a fault that stays.

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Commands out, samples in, as `hil.rigs.Rig` says."""
        hardware = self._hardware
        if hardware is None:
            return SILENT
        began = time.monotonic_ns()
        # What is not a number is no command.
        wanted = np.where(np.isnan(command), 0.0, command) if request == ENABLED else np.zeros(6)
        velocities = np.clip(wanted, -SPEED_LIMIT, SPEED_LIMIT)
        try:
            read_imus(hardware, began - self._opened_ns, feedback)
            drive(hardware, velocities, feedback)
        except OSError:
            return SILENT
        feedback["drive"] = FOLLOWING if request == ENABLED else READY
        feedback["round_trip_ns"] = time.monotonic_ns() - began
        return ANSWERED

    def quick_stop(self) -> None:
        """Stop the drives, whatever has happened: nothing may be raised here, also when they are gone."""
        if self._hardware is not None:
            self._hardware.commands = np.zeros(6)

    def close(self) -> None:
        """Leave the drives on their brakes, and let go of the hardware."""
        self.quick_stop()
        self._hardware = None

    def _check_open(self) -> None:
        if self._hardware is None:
            raise RigError("the rig is not open: open it first")


def drive(hardware: KinematicHexapod, velocities: Array, feedback: Record) -> None:
    """4: Send the velocities (6,) [m/s], from now on, and note what was really sent after rounding."""
    hardware.commands = velocities
    feedback["sent"] = velocities


def read_imus(hardware: KinematicHexapod, time_ns: int, feedback: Record) -> None:
    """5: Read the IMUs: rad/s, m/s^2 and uT in their own axes, the time of each sample on one clock, and its number, which
    stands if there is none that is new. Hardware leaves the truth as it is: it is not known.
    """
    hardware.advance(time_ns)
    feedback["measurement"] = hardware.signals
    feedback["sample_ns"] = time_ns
    feedback["sequence"] += 1
    feedback["truth"][:13] = hardware.truth()
