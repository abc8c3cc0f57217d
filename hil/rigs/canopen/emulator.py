"""The emulated rig on CANopen: the nodes of `hil.rigs.canopen.nodes` around the plant, with the faults of the bus."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import can
import numpy as np

from controller.safety.causes import DriveState
from hil.rigs.canopen.nodes import CanopenNodes
from hil.rigs.canopen.settings import CanopenSettings
from hil.rigs.emulation.drives import EMULATED, move, sample
from hil.rigs.emulation.faults import disturb
from plant.compiled import Record
from plant.fmu.plant import FmuPlant

_HELD_BACK_S = 0.002


class PlantMachine:
    """The plant as the nodes see it (`canopen_nodes.Machine`), on a clock of its own.

    Args:
        made: makes the plant at its start, its IMUs' imperfections, and the drives (dtype `EMULATED`).
    """

    def __init__(self, made: Callable[[], tuple[FmuPlant, Record, Record]]) -> None:
        self._made = made
        self.rig: Record = np.zeros((), EMULATED)
        self._plant, self._imu, made_rig = made()
        self.rig[()] = made_rig
        self._started = time.monotonic_ns()
        self.request, self.target, self.drive = self.rig["request"], self.rig["target"], self.rig["drive"]
        self.code, self.velocity = self.rig["code"], self.rig["velocity"]
        self.measurement, self.sample_ns, self.sequence = (
            self.rig["measurement"],
            self.rig["sample_ns"],
            self.rig["sequence"],
        )
        self.truth = self.rig["truth"]

    def advance(self, now_ns: int) -> None:
        """Let the plant move on to this time of the machine's clock."""
        self._check(move(self._plant.handle, self.rig, now_ns - self._started))

    def sample(self, now_ns: int) -> None:
        """Read the IMUs."""
        self._check(sample(self._plant.handle, self._imu, self.rig, now_ns - self._started))

    def reset(self, drive: int) -> None:
        """Reset a drive's fault."""
        self.rig["reset"][drive] = 1
        self._check(move(self._plant.handle, self.rig, int(self.rig["time_ns"]) + 1))

    def restart(self) -> None:
        """All nodes are started anew: the platform is put back to its start, unless it moves."""
        if self.rig["enabled_ns"] < 0 or np.isin(self.drive, (DriveState.FOLLOWING, DriveState.QUICK_STOPPING)).any():
            return
        self._plant.close()
        self._plant, self._imu, made = self._made()
        self.rig[()] = made
        self._started = time.monotonic_ns()

    def close(self) -> None:
        """Let go of the plant."""
        self._plant.close()

    def _check(self, status: int) -> None:
        if status:
            raise self._plant.failure()


class FaultyChannel:
    """What the faults of the bus do to frames (`canopen_nodes.Channel`)."""

    def __init__(self, rig: Record) -> None:
        self._rig = rig

    def __call__(self, frame: can.Message, outgoing: bool) -> Iterator[tuple[float, can.Message]]:
        """The frames that come of one, and how much later [s]."""
        del outgoing
        copies, delay, damaged, held = disturb(self._rig[()], int(self._rig["time_ns"]))
        # A frame's own CRC is part of CAN: controllers never hand on what is damaged.
        for _ in range(0 if damaged else copies):
            yield 1e-9 * delay + (_HELD_BACK_S if held else 0.0), frame


def serve_canopen(
    settings: CanopenSettings,
    machine: PlantMachine,
    stopped: Callable[[], bool],
    look: Callable[[Record, dict[str, Any]], None],
) -> None:
    """Serve the bus until `stopped`; `look` is called now and then with the rig and what is to be told of the bus."""
    nodes = CanopenNodes(settings, machine, FaultyChannel(machine.rig))
    looked = 0.0

    def ended() -> bool:
        nonlocal looked
        if time.monotonic() - looked > 0.02:
            looked = time.monotonic()
            look(machine.rig, {"lost": nodes.lost})
        return stopped()

    try:
        nodes.serve(ended)
    finally:
        nodes.close()
