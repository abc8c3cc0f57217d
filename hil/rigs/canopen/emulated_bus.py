"""The emulated nodes on a python-can bus: six drives and the IMUs around a machine, served by one thread, with faults.

The object dictionaries are read and written over SDO; SYNC and PDOs bypass them.
"""

import heapq
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from copy import deepcopy
from itertools import count
from typing import Any

import can
import canopen
import numpy as np

from hil.rigs.canopen.emulated_nodes import EmulatedDrive, EmulatedImu, EmulatedNode, PlantMachine
from hil.rigs.canopen.frames import (
    ANSWER,
    COMMAND,
    POSITION,
    POSITION_PDO,
    CobId,
    NmtCommand,
    NodeState,
    pack_imu,
    raw_readings,
    truth_message,
)
from hil.rigs.canopen.settings import MAGNETOMETER_INTERVAL, CanopenSettings
from hil.rigs.emulation import disturb
from plant.compiled import Record
from plant.imu_wiring import BASE_IMU
from plant.mechanism import LEGS

Channel = Callable[[can.Message, bool], Iterable[tuple[float, can.Message]]]
"""The bus's effect on a frame, with whether the nodes send it: the frames that arrive instead, each with its delay [s]."""

_POLL_NS, _HELD_BACK_S = 5_000_000, 0.002


def faulty_channel(rig: Record) -> Channel:
    """The faults of the bus of a rig (dtype `EMULATED`)."""

    def disturbed(frame: can.Message, outgoing: bool) -> Iterator[tuple[float, can.Message]]:
        copies, delay, damaged, held = disturb(rig[()], int(rig["time_ns"]))
        # CAN frames have a CRC of their own: controllers never pass on a damaged frame.
        for _ in range(0 if damaged else copies):
            yield 1e-9 * delay + (_HELD_BACK_S if held else 0.0), frame

    return disturbed


class EmulatedBus:
    """Six drives and the IMUs around a machine, on a bus of their own.

    Args:
        settings: of the bus and its nodes.
        machine: what they drive and read.
        channel: what happens to frames; by default nothing.
        bus: by default that of the settings.
        clock: [ns], also the machine's.
    """

    def __init__(
        self,
        settings: CanopenSettings,
        machine: PlantMachine,
        channel: Channel | None = None,
        bus: Any = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._machine, self._fd, self._clock = machine, settings.bus.fd, clock
        self._channel = channel or (lambda message, outgoing: ((0.0, message),))
        self._scales = settings.imus.scales
        self._bus = settings.bus.opened() if bus is None else bus
        # The network sends by this object's `send`.
        self._network = canopen.Network(self)
        self.drives = [EmulatedDrive(leg, settings, machine, self._network, clock) for leg in range(LEGS)]
        self.imus = [EmulatedImu(imu, settings, self._network, clock) for imu in range(len(settings.imus.nodes))]
        self.lost = 0  # frames that could not be sent or read
        self._nodes: list[EmulatedNode] = [*self.drives, *self.imus]
        self._controller = CobId.HEARTBEAT + settings.controller.node
        self._commands = {CobId.RPDO + drive.node: drive for drive in self.drives}
        self._requests = {CobId.SDO_REQUEST + node.node for node in self._nodes}
        self._heard = {CobId.NMT, CobId.SYNC, self._controller, *self._commands, *self._requests}
        self._held: list[tuple[int, int, bool, can.Message]] = []
        self._numbers = count()
        self._polled_ns = 0
        for node in self._nodes:
            self._boot(node)

    def serve(self, stop: Callable[[], bool], report: Callable[[], None] = lambda: None) -> None:
        """Answer the bus until `stop` returns true; `report` is called every few milliseconds."""
        while not stop():
            try:
                message = self._bus.recv(max(self.due_ns - self._clock(), 0) * 1e-9)
            except (can.CanError, OSError, ValueError):
                self.lost += 1
                message = None
                time.sleep(0.001)
            if message is not None:
                self.hear(message)
            if self.catch_up():
                report()

    @property
    def due_ns(self) -> int:
        """When the nodes have something to do of their own accord."""
        polled = self._polled_ns + _POLL_NS
        return min(polled, self._held[0][0]) if self._held else polled

    def hear(self, message: can.Message) -> None:
        """Take a frame from the bus."""
        # Some buses return the frames that the nodes have sent.
        if message.arbitration_id in self._heard:
            self._pass(message, False)

    def catch_up(self) -> bool:
        """Do what is due by now; returns whether the nodes have looked at their watchdogs."""
        now = self._clock()
        while self._held and self._held[0][0] <= now:
            _, _, outgoing, frame = heapq.heappop(self._held)
            self._arrive(frame, outgoing)
        if now - self._polled_ns < _POLL_NS:
            return False
        self._poll(now)
        return True

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _poll(self, now: int) -> None:
        """Advance the machine, and check watchdogs and heartbeats."""
        self._polled_ns = now
        self._machine.advance(now)
        for drive in self.drives:
            drive.settle()
            drive.watch(now)
        for node in self._nodes:
            if node.heartbeat_ns and now >= node.heartbeat_due:
                node.heartbeat_due = now + node.heartbeat_ns
                self._network.send_message(CobId.HEARTBEAT + node.node, bytes((node.state,)))

    def _boot(self, node: EmulatedNode) -> None:
        node.reset()
        self._network.send_message(CobId.HEARTBEAT + node.node, bytes((NodeState.BOOT_UP,)))

    def send(self, message: can.Message) -> None:
        """Send a frame; one that is held back does not change when its object is used again."""
        self._pass(deepcopy(message), True)

    def _pass(self, message: can.Message, outgoing: bool) -> None:
        for delay, frame in self._channel(message, outgoing):
            if delay > 0.0:
                due = self._clock() + round(delay * 1e9)
                heapq.heappush(self._held, (due, next(self._numbers), outgoing, frame))
            else:
                self._arrive(frame, outgoing)

    def _arrive(self, message: can.Message, outgoing: bool) -> None:
        if outgoing:
            try:
                self._bus.send(message)
            except (can.CanError, OSError, ValueError):
                self.lost += 1
        elif not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
            self._dispatch(message.arbitration_id, message.data)

    def _dispatch(self, identifier: int, data: bytearray) -> None:
        if drive := self._commands.get(identifier):
            if CobId.RPDO in drive.active and len(data) == COMMAND.size:
                drive.command = COMMAND.unpack_from(data)
        elif identifier == CobId.SYNC:
            self._on_sync(data[0] if len(data) == 1 else 0)
        elif identifier == self._controller:
            now = self._clock()
            for drive in self.drives:
                if drive.controller == identifier - CobId.HEARTBEAT:
                    drive.controller_ns = now
        elif identifier in self._requests:
            self._machine.advance(self._clock())
            # A request that is not an SDO frame is ignored.
            with suppress(Exception):
                self._network.notify(identifier, data, 0.0)
        elif identifier == CobId.NMT and len(data) == 2:
            self._on_nmt(data[0], data[1])

    def _on_sync(self, sync: int) -> None:
        machine, rig, now = self._machine, self._machine.rig, self._clock()
        machine.advance(now)
        for drive in self.drives:
            drive.settle()
            if drive.command is not None:
                drive.obey(*drive.command)
                drive.command = None
        machine.sample(now)
        if self._fd:
            self.send(truth_message(rig["truth"], sync))
        for drive in self.drives:
            if CobId.TPDO in drive.active:
                drive.answer.data = bytearray(ANSWER.pack(drive.statusword(), drive.velocity(), drive.code))
                self.send(drive.answer)
            if POSITION_PDO.cob_id in drive.active:
                drive.position_answer.data = bytearray(POSITION.pack(drive.position(), drive.inputs()))
                self.send(drive.position_answer)
        read, sequences, times = rig["measurement"], rig["sequence"], rig["sample_ns"]
        if len(self.imus) > BASE_IMU:
            # The node of the IMU on the base has no magnetometer.
            on_base = np.concatenate([rig["base_imu"], np.full((1, 3), np.nan)])
            read = np.concatenate([read, on_base[:, None]], axis=1)
            sequences, times = np.append(sequences, rig["base_imu_sequence"]), np.append(times, rig["base_imu_ns"])
        raw = raw_readings(read, self._scales)
        for node in self.imus:
            if node.active:
                imu = node.imu
                turn = (sync - node.magnetometer_start) % MAGNETOMETER_INTERVAL == 0
                sequence, sample_ns = int(sequences[imu]), int(times[imu])
                for cob_id, data in pack_imu(raw[:, imu], sequence, sample_ns, sync, self._fd, turn):
                    if cob_id in node.active:
                        answer = node.answers[cob_id]
                        answer.data, answer.dlc = bytearray(data), len(data)
                        self.send(answer)

    def _on_nmt(self, command: int, addressed: int) -> None:
        for node in self._nodes:
            if addressed not in (0, node.node):
                continue
            if command == NmtCommand.START:
                node.start()
            elif command == NmtCommand.STOP:
                node.stop(NodeState.STOPPED)
            elif command == NmtCommand.ENTER_PRE_OPERATIONAL:
                node.stop(NodeState.PRE_OPERATIONAL)
            elif command in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
                self._machine.restart()
                self._boot(node)
