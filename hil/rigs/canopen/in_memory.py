"""The CANopen rig and its emulated nodes in one thread, on virtual time: frames are real, and the bus between them is memory.

Time passes with the loop's cycles, with each frame by its time on the bus, and while the controller waits for frames. So a run
is repeatable, and takes as long as its computing.
"""

from collections import deque
from collections.abc import Callable
from copy import deepcopy
from types import SimpleNamespace

import can

from hil.rigs import Identity
from hil.rigs.canopen.emulated_bus import EmulatedBus, faulty_channel
from hil.rigs.canopen.emulated_nodes import PlantMachine
from hil.rigs.canopen.rig import CanopenRig
from hil.rigs.canopen.settings import CanopenSettings
from plant.compiled import Record
from plant.fmu.plant import FmuPlant
from plant.pose import Array

_FRAME_NS = 10_000
"""Time of a frame on the bus, about that of a command on CAN FD."""


class CanopenInMemory:
    """A CANopen rig (see `hil.rigs.Rig`) with the nodes that answer it.

    Args:
        settings: of the bus and its nodes.
        period: [s].
        make: as for `PlantMachine`.
        lengths: as for `CanopenRig`.
    """

    def __init__(
        self,
        settings: CanopenSettings,
        period: float,
        make: Callable[[], tuple[FmuPlant, Record, Record, Record]],
        lengths: bool = False,
    ) -> None:
        self._now_ns, self._period_ns, self._next_ns = 0, round(1e9 * period), 0
        self._frames: deque[can.Message] = deque()
        to_controller = SimpleNamespace(send=self._frames.append, shutdown=lambda: None)
        self.machine = PlantMachine(make, self._clock)
        self.nodes = EmulatedBus(settings, self.machine, faulty_channel(self.machine.rig), to_controller, self._clock)
        self._rig = CanopenRig(settings, period, lambda: self, self._clock, lengths)
        self.command_delay = self._rig.command_delay

    def open(self) -> None:
        """As `CanopenRig.open`."""
        self._rig.open()

    def identify(self) -> Identity:
        """As `CanopenRig.identify`."""
        return self._rig.identify()

    def arm(self) -> None:
        """As `CanopenRig.arm`; the cycles begin now."""
        self._rig.arm()
        self._next_ns = self._now_ns

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """As `CanopenRig.exchange`, in the next cycle."""
        self._next_ns += self._period_ns
        self._pass_until(self._next_ns)
        return self._rig.exchange(command, request, feedback)

    def quick_stop(self) -> None:
        """As `CanopenRig.quick_stop`."""
        self._rig.quick_stop()

    def close(self) -> None:
        """As `CanopenRig.close`."""
        self._rig.close()

    def send(self, message: can.Message) -> None:
        """The controller's end of the bus: the nodes hear a frame, and answer at once."""
        self._now_ns += _FRAME_NS
        self.nodes.hear(deepcopy(message))
        self.nodes.catch_up()

    def recv(self, timeout: float) -> can.Message | None:
        """The controller's end of the bus: the next frame; None if none arrives in time [s]."""
        deadline = self._now_ns + round(1e9 * timeout)
        while not self._frames and self._now_ns < deadline:
            self._pass_until(min(deadline, max(self.nodes.due_ns, self._now_ns + 1)))
        return self._frames.popleft() if self._frames else None

    def shutdown(self) -> None:
        """The controller's end of the bus: it can be opened again."""

    def _clock(self) -> int:
        return self._now_ns

    def _pass_until(self, time_ns: int) -> None:
        """Let the nodes do what is due until a time."""
        while self.nodes.due_ns < time_ns:
            self._now_ns = max(self._now_ns, self.nodes.due_ns)
            self.nodes.catch_up()
        self._now_ns = max(self._now_ns, time_ns)
        self.nodes.catch_up()
