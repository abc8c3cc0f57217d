"""The emulated rig on CANopen: the emulated bus around the plant, with the faults of the bus."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import numpy as np

from hil.rigs import DriveState
from hil.rigs.canopen.emulated_bus import Channel, EmulatedBus
from hil.rigs.emulation.drives import EMULATED, move, sample
from hil.rigs.emulation.faults import disturb
from plant.compiled import Record
from plant.fmu.plant import FmuPlant

_HELD_BACK_S = 0.002
_REPORT_S = 0.02


class PlantMachine:
    """The plant as a `hil.rigs.canopen.emulated_nodes.Machine`, on a clock of its own.

    Args:
        make: makes the plant at its start, its IMUs' imperfections, and the drives (dtype `EMULATED`).

    Attributes:
        rig: dtype `EMULATED`.
    """

    def __init__(self, make: Callable[[], tuple[FmuPlant, Record, Record]]) -> None:
        self._make = make
        self.rig: Record = np.zeros((), EMULATED)
        self._started = 0
        self._begin()
        # The clock starts when the machine code is loaded: a node that waits for it would not answer over SDO in time.
        self.sample(self._started)
        self.advance(self._started)
        self._started = time.monotonic_ns()

    def _begin(self) -> None:
        self._plant, self._imu, self.rig[()] = self._make()
        self._started = time.monotonic_ns()

    def advance(self, now_ns: int) -> None:
        """Move the plant on to this time of the machine's clock."""
        self._check(move(self._plant.handle, self.rig, now_ns - self._started))

    def sample(self, now_ns: int) -> None:
        """Read the IMUs."""
        self._check(sample(self._plant.handle, self._imu, self.rig, now_ns - self._started))

    def reset(self, drive: int) -> None:
        """Reset a drive's fault."""
        self.rig["reset"][drive] = 1
        self._check(move(self._plant.handle, self.rig, int(self.rig["time_ns"]) + 1))

    def restart(self) -> None:
        """Put the platform back to its start, unless a drive moves or none was ever enabled."""
        if self.rig["enabled_ns"] < 0 or np.isin(self.rig["drive"], (DriveState.FOLLOWING, DriveState.QUICK_STOPPING)).any():
            return
        self._plant.close()
        self._begin()

    def close(self) -> None:
        """Close the plant."""
        self._plant.close()

    def _check(self, status: int) -> None:
        if status:
            raise self._plant.failure()


def faulty_channel(rig: Record) -> Channel:
    """The faults of the bus of a rig (dtype `EMULATED`)."""

    def disturbed(frame: can.Message, outgoing: bool) -> Iterator[tuple[float, can.Message]]:
        copies, delay, damaged, held = disturb(rig[()], int(rig["time_ns"]))
        # CAN frames have a CRC of their own: controllers never pass on a damaged frame.
        for _ in range(0 if damaged else copies):
            yield 1e-9 * delay + (_HELD_BACK_S if held else 0.0), frame

    return disturbed


def serve_canopen(
    bus: EmulatedBus, machine: PlantMachine, stopped: Callable[[], bool], report: Callable[[Record, dict[str, Any]], None]
) -> None:
    """Serve the bus until `stopped`; `report` is called now and then with the rig and the figures of the bus."""
    reported = 0.0

    def ended() -> bool:
        nonlocal reported
        if time.monotonic() - reported > _REPORT_S:
            reported = time.monotonic()
            report(machine.rig, {"lost": bus.lost})
        return stopped()

    bus.serve(ended)
