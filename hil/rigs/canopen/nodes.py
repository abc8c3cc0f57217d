"""Emulated nodes of the CANopen rig: six CiA 402 drives and seven IMUs on a python-can bus, around a machine that moves.

One thread serves all of them. Their object dictionaries are canopen's, read and written over SDO; SYNC and PDOs go a short way
past them. The nodes keep to the PDO mapping of `hil.rigs.canopen.frames` and refuse any other over SDO.
"""

import heapq
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from copy import deepcopy
from itertools import count
from typing import Any, Protocol

import can
import canopen
import numpy as np
from canopen.sdo import SdoAbortedError
from numpy.typing import NDArray

from hil.rigs import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, READY
from hil.rigs.canopen.cia402 import (
    CONTROLWORD,
    CYCLIC_SYNCHRONOUS_VELOCITY,
    ERROR_CODE,
    FAULT,
    FAULT_REACTION_ACTIVE,
    HEARTBEAT_LOST,
    MODE,
    MODE_DISPLAY,
    NOT_READY,
    OPERATION_ENABLED,
    PDO_LOST,
    QUICK_STOP_ACTIVE,
    STATUSWORD,
    SWITCH_ON_DISABLED,
    SWITCHED_ON,
    TARGET_VELOCITY,
    VELOCITY_ACTUAL,
    commanded,
    settled,
    statusword,
)
from hil.rigs.canopen.frames import (
    ANSWER,
    BOOT_UP,
    COB_ID,
    COMMAND,
    CONSUMER_HEARTBEAT,
    DRIVE_PDOS,
    EMERGENCY,
    ERROR_REGISTER,
    EVENT_TIMER,
    HEARTBEAT,
    INVALID_COB_ID,
    IS_PRE_OPERATIONAL,
    NMT,
    OPERATIONAL,
    PRE_OPERATIONAL,
    PRODUCER_HEARTBEAT,
    RESET_COMMUNICATION,
    RESET_NODE,
    RPDO,
    SDO_REQUEST,
    START,
    STOP,
    STOPPED,
    SYNC,
    SYNC_START_VALUE,
    TPDO,
    TRANSMISSION_TYPE,
    TRUTH,
    TRUTH_BYTES,
    Pdo,
    drive_scales,
    imu_pdos,
    pack_imu,
    pack_truth,
    raw_readings,
    sensor_scales,
)
from hil.rigs.canopen.settings import MAGNETOMETER_INTERVAL, CanopenSettings, object_dictionary
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

Channel = Callable[[can.Message, bool], Iterable[tuple[float, can.Message]]]
"""What the bus makes of a frame, and whether the nodes send it: the frames that arrive instead, each with its delay [s]."""

_POLL_S = 0.005
_LARGEST = 2**31 - 1
_CLASSIC_PDO_BITS, _FD_PDO_BITS = 64, 512
_NOT_MAPPABLE, _TOO_LONG, _NOT_NOW, _TOO_HIGH, _TOO_LOW = 0x06040041, 0x06040042, 0x08000022, 0x06090031, 0x06090032
_MODE_UNSUPPORTED = 0x06090030
_DRIVE_ERROR = 0x81
_MAGNETOMETER_PDO = 0x1802


class Machine(Protocol):
    """What the nodes drive and read.

    Attributes:
        request: (6,) what the nodes ask of each drive: `BRAKED`, `ENABLED` or `QUICK_STOP`.
        target: (6,) velocity that each drive is to follow [m/s].
        drive: (6,) each drive's state: `OFF`, `READY`, `FOLLOWING`, `QUICK_STOPPING` or `FAULTY`.
        code: (6,) error code of each drive.
        velocity: (6,) of each drive [m/s].
        measurement: (3, 7, 3) last sample of the IMUs [rad/s, m/s^2, uT], NaN where there is none.
        sample_ns: (7,) its time on each IMU's clock [ns].
        sequence: (7,) its number.
        truth: the plant's `truth` buffer, told on CAN FD; None for none.
    """

    request: NDArray[np.int64]
    target: Array
    drive: NDArray[np.int64]
    code: NDArray[np.int64]
    velocity: Array
    measurement: Array
    sample_ns: NDArray[np.int64]
    sequence: NDArray[np.int64]
    truth: Any

    def advance(self, now_ns: int) -> None:
        """Let the machine move until now [ns]."""

    def sample(self, now_ns: int) -> None:
        """Let the IMUs take a sample now [ns]."""

    def reset(self, drive: int) -> None:
        """Clear a drive's fault, if its cause has gone; its `drive` says so at once."""

    def restart(self) -> None:
        """A node has been reset."""


class _Network(canopen.Network):  # type: ignore[misc]
    """Sends what the object dictionaries answer through the nodes' own outlet."""

    def __init__(self, send: Callable[[can.Message], None]) -> None:
        super().__init__()
        self._outlet = send

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._outlet(can.Message(arbitration_id=can_id, data=data, is_remote_frame=remote, is_extended_id=False))


class _Node:
    """What drives and IMUs have in common: object dictionary, NMT state, heartbeat and configuration of the PDOs."""

    def __init__(self, name: str, node: int, eds: Any, pdos: tuple[Pdo, ...], fd: bool, network: _Network) -> None:
        self.name, self.node, self.pdos = name, node, pdos
        self.local = canopen.LocalNode(node, object_dictionary(eds, node))
        # canopen's own callback would start a thread that sends the heartbeat.
        self.local._write_callbacks.clear()
        self.local.add_write_callback(self._on_write)
        self.local.add_read_callback(self._on_read)
        self.local.associate_network(network)
        self.state = IS_PRE_OPERATIONAL
        self.active: frozenset[int] = frozenset()
        self.heartbeat_ns, self.heartbeat_due = 0, 0
        self._most_bits = _FD_PDO_BITS if fd else _CLASSIC_PDO_BITS

    def value(self, index: int, subindex: int = 0) -> int:
        """A number in the object dictionary."""
        raw: Any = self.local.sdo[index][subindex].raw if subindex else self._variable(index).raw
        return int(raw)

    def _variable(self, index: int) -> Any:
        entry = self.local.sdo[index]
        return entry if hasattr(entry, "raw") else entry[0]

    def reset(self) -> None:
        """Go back to what the EDS says."""
        self.local.data_store.clear()
        self.heartbeat_ns, self.active, self.state = 0, frozenset(), IS_PRE_OPERATIONAL

    def start(self) -> None:
        """Become operational, with the PDOs that are configured."""
        self.state = OPERATIONAL
        self.active = frozenset(
            pdo.cob_id
            for pdo in self.pdos
            if self.value(pdo.communication, COB_ID) == pdo.cob_id + self.node
            and self.value(pdo.communication, TRANSMISSION_TYPE) == pdo.transmission_type
            and self._mapped(pdo) == pdo.objects
        )

    def stop(self, state: int) -> None:
        """Leave the operational state."""
        self.state, self.active = state, frozenset()

    def _mapped(self, pdo: Pdo) -> tuple[int, ...]:
        return tuple(self.value(pdo.mapping, i + 1) for i in range(self.value(pdo.mapping)))

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        return None

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        number = od.decode_raw(data)
        if od.max is not None and number > od.max:
            raise SdoAbortedError(_TOO_HIGH)
        if od.min is not None and number < od.min:
            raise SdoAbortedError(_TOO_LOW)
        for pdo in self.pdos:
            if index == pdo.mapping:
                self._check_mapping(pdo, subindex, number)
        if index == PRODUCER_HEARTBEAT:
            self.heartbeat_ns = number * 1_000_000
            self.heartbeat_due = time.monotonic_ns() + self.heartbeat_ns

    def _check_mapping(self, pdo: Pdo, subindex: int, number: int) -> None:
        if not self.value(pdo.communication, COB_ID) & INVALID_COB_ID or self.state == OPERATIONAL:
            raise SdoAbortedError(_NOT_NOW)
        if subindex:
            if self.value(pdo.mapping):
                raise SdoAbortedError(_NOT_NOW)
            if number:
                self._check_mappable(number)
        elif number:
            objects = tuple(self.value(pdo.mapping, i + 1) for i in range(number))
            if sum(each & 0xFF for each in objects) > self._most_bits:
                raise SdoAbortedError(_TOO_LONG)
            if objects != pdo.objects:
                raise SdoAbortedError(_NOT_MAPPABLE)

    def _check_mappable(self, entry: int) -> None:
        index, subindex, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        dictionary = self.local.object_dictionary
        found = dictionary.get(index)
        if isinstance(found, canopen.objectdictionary.ODRecord | canopen.objectdictionary.ODArray):
            found = found.get(subindex)
        if found is None or not found.pdo_mappable or len(found) != bits:
            raise SdoAbortedError(_NOT_MAPPABLE)


class _Drive(_Node):
    """A CiA 402 drive, whose mechanics are the machine's."""

    def __init__(
        self, leg: int, settings: CanopenSettings, machine: Machine, network: _Network, send: Callable[..., None]
    ) -> None:
        node = settings.drives.nodes[leg]
        self.leg, self.machine = leg, machine
        self.power, self.code, self.controlword, self.target = NOT_READY, 0, 0, 0
        self.command: tuple[int, int] | None = None
        self.commanded_ns, self.timeout_ns = 0, 0
        self.controller, self.consumer_ns, self.controller_ns = 0, 0, 0
        self.mode = 0
        self._scale = drive_scales(settings)[leg]
        self._send = send
        self.answer = can.Message(arbitration_id=TPDO + node, is_extended_id=False, dlc=ANSWER.size, is_fd=settings.bus.fd)
        self.answer.bitrate_switch = settings.bus.fd
        super().__init__(f"drive {leg}", node, settings.drive_eds, DRIVE_PDOS, settings.bus.fd, network)

    def reset(self) -> None:
        super().reset()
        self.power, self.code, self.controlword, self.target, self.command = NOT_READY, 0, 0, 0, None
        self.timeout_ns = self.controller = self.consumer_ns = self.controller_ns = self.mode = 0
        self.ask()

    def start(self) -> None:
        super().start()
        self.command = None

    def stop(self, state: int) -> None:
        super().stop(state)
        if self.power == OPERATION_ENABLED:
            self.power = QUICK_STOP_ACTIVE
            self.ask()

    def _on_read(self, index: int, subindex: int, od: Any) -> int | None:
        if index == STATUSWORD:
            return self.statusword()
        if index == ERROR_CODE:
            return self.code
        if index == VELOCITY_ACTUAL:
            return self.velocity()
        if index == ERROR_REGISTER:
            return _DRIVE_ERROR if self.power in (FAULT, FAULT_REACTION_ACTIVE) else 0
        return self.mode if index == MODE_DISPLAY else None

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        super()._on_write(index, subindex, od, data)
        number = od.decode_raw(data)
        if index == CONTROLWORD:
            self.settle()
            self.obey(number, self.target)
        elif index == TARGET_VELOCITY:
            self.target = number
        elif index == MODE:
            if number != CYCLIC_SYNCHRONOUS_VELOCITY:
                raise SdoAbortedError(_MODE_UNSUPPORTED)
            self.mode = number
        elif (index, subindex) == (CONSUMER_HEARTBEAT, 1):
            self.controller, self.consumer_ns, self.controller_ns = number >> 16 & 0x7F, (number & 0xFFFF) * 1_000_000, 0
        elif (index, subindex) == (DRIVE_PDOS[0].communication, EVENT_TIMER):
            self.timeout_ns = number * 1_000_000

    def statusword(self) -> int:
        """As the drive is now."""
        drive = self.machine.drive[self.leg]
        return statusword(self.power, bool(drive != OFF), bool(drive == FOLLOWING))

    def velocity(self) -> int:
        """[counts/s]."""
        counts = float(self.machine.velocity[self.leg]) * self._scale
        return round(min(max(counts, -_LARGEST), _LARGEST)) if counts == counts else 0

    def obey(self, controlword: int, target: int) -> None:
        """Take a command into effect."""
        before = self.power
        self.power = commanded(before, controlword, self.controlword)
        self.controlword, self.target, self.commanded_ns = controlword, target, time.monotonic_ns()
        if before == FAULT and self.power != FAULT:
            self.code = 0
            self.machine.reset(self.leg)
        self.ask()

    def settle(self) -> None:
        """Follow what the machine's drive does by itself."""
        drive = int(self.machine.drive[self.leg])
        if drive == OFF:
            self.power = NOT_READY
        elif self.power == NOT_READY:
            self.power = SWITCH_ON_DISABLED
        if drive == FAULTY and self.power not in (FAULT, FAULT_REACTION_ACTIVE):
            self.power = FAULT
            self._report(int(self.machine.code[self.leg]))
        elif drive in (READY, FAULTY):
            self.power = settled(self.power)
        self.ask()

    def watch(self, now_ns: int) -> None:
        """Stop if the controller has gone."""
        if self.consumer_ns and self.controller_ns and now_ns - self.controller_ns > self.consumer_ns:
            self.controller_ns = 0
            self._miss(HEARTBEAT_LOST)
        if self.timeout_ns and self.power == OPERATION_ENABLED and now_ns - self.commanded_ns > self.timeout_ns:
            self._miss(PDO_LOST)

    def _miss(self, code: int) -> None:
        if self.power in (OPERATION_ENABLED, QUICK_STOP_ACTIVE):
            self.power = FAULT_REACTION_ACTIVE
        elif self.power == SWITCHED_ON:
            self.power = FAULT
        else:
            return
        self.ask()
        self._report(code)

    def _report(self, code: int) -> None:
        self.code = code
        emergency = code.to_bytes(2, "little") + bytes((_DRIVE_ERROR,)) + bytes(5)
        self._send(can.Message(arbitration_id=EMERGENCY + self.node, data=emergency, is_extended_id=False))

    def ask(self) -> None:
        """Ask of the machine's drive what the power state machine says."""
        leg, power = self.leg, self.power
        if power == OPERATION_ENABLED:
            self.machine.request[leg] = ENABLED
            self.machine.target[leg] = self.target / self._scale if self.mode == CYCLIC_SYNCHRONOUS_VELOCITY else 0.0
        else:
            self.machine.request[leg] = QUICK_STOP if power in (QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE) else BRAKED
            self.machine.target[leg] = 0.0


class _Imu(_Node):
    """An IMU, whose readings are the machine's."""

    def __init__(self, imu: int, settings: CanopenSettings, network: _Network) -> None:
        node, fd = settings.imus.nodes[imu], settings.bus.fd
        self.imu = imu
        super().__init__(f"IMU {imu}", node, settings.imu_eds, imu_pdos(fd), fd, network)
        self.answers = {
            pdo.cob_id: can.Message(
                arbitration_id=pdo.cob_id + node, is_extended_id=False, is_fd=fd, bitrate_switch=fd
            )
            for pdo in self.pdos
        }  # fmt: skip
        self.magnetometer_start = 0

    def start(self) -> None:
        super().start()
        self.magnetometer_start = self.value(_MAGNETOMETER_PDO, SYNC_START_VALUE)


class CanopenNodes:
    """Six drives and seven IMUs around a machine, on a bus of their own.

    Attributes:
        drives, imus: the nodes.
        lost: how many frames could not be sent or read.
    """

    def __init__(self, settings: CanopenSettings, machine: Machine, channel: Channel | None = None) -> None:
        self._machine, self._channel, self._fd = machine, channel, settings.bus.fd
        self._scales = sensor_scales(settings)
        self._bus = can.Bus(**settings.bus.arguments())
        self._network = _Network(self._send)
        self.drives = [_Drive(leg, settings, machine, self._network, self._send) for leg in range(LEGS)]
        self.imus = [_Imu(imu, settings, self._network) for imu in range(IMU_COUNT)]
        self.lost = 0
        self._nodes: list[_Node] = [*self.drives, *self.imus]
        self._controller = HEARTBEAT + settings.controller.node
        self._commands = {RPDO + drive.node: drive for drive in self.drives}
        self._requests = {SDO_REQUEST + node.node for node in self._nodes}
        self._truth = can.Message(
            arbitration_id=TRUTH, is_extended_id=True, dlc=TRUTH_BYTES, is_fd=True, bitrate_switch=True
        )  # fmt: skip
        self._heard = {NMT, SYNC, self._controller, *self._commands, *self._requests}
        self._held: list[tuple[int, int, bool, can.Message]] = []
        self._numbers = count()
        self._polled_ns = 0
        for node in self._nodes:
            self._boot(node)

    def serve(self, stop: Callable[[], bool]) -> None:
        """Answer the bus until `stop` says so."""
        while not stop():
            now = time.monotonic_ns()
            due = self._polled_ns + round(_POLL_S * 1e9)
            if self._held:
                due = min(due, self._held[0][0])
            try:
                message = self._bus.recv(max(due - now, 0) * 1e-9)
            except (can.CanError, OSError, ValueError):
                self.lost += 1
                message = None
                time.sleep(0.001)
            # Some buses hand back what the nodes have sent.
            if message is not None and message.arbitration_id in self._heard:
                self._pass(message, False)
            now = time.monotonic_ns()
            while self._held and self._held[0][0] <= now:
                _, _, outgoing, frame = heapq.heappop(self._held)
                self._arrive(frame, outgoing)
            if now - self._polled_ns >= _POLL_S * 1e9:
                self._poll(now)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _poll(self, now: int) -> None:
        """What is due by time: the machine's motion, watchdogs, heartbeats."""
        self._polled_ns = now
        self._machine.advance(now)
        for drive in self.drives:
            drive.settle()
            drive.watch(now)
        for node in self._nodes:
            if node.heartbeat_ns and now >= node.heartbeat_due:
                node.heartbeat_due = now + node.heartbeat_ns
                self._say(node, node.state)

    def _say(self, node: _Node, state: int) -> None:
        self._send(can.Message(arbitration_id=HEARTBEAT + node.node, data=bytes((state,)), is_extended_id=False))

    def _boot(self, node: _Node) -> None:
        node.reset()
        self._say(node, BOOT_UP)

    def _send(self, message: can.Message) -> None:
        if self._channel is None:
            self._arrive(message, True)
        else:
            # The frame may be held back, and its object is used again.
            self._pass(deepcopy(message), True)

    def _pass(self, message: can.Message, outgoing: bool) -> None:
        if self._channel is None:
            self._arrive(message, outgoing)
            return
        for delay, frame in self._channel(message, outgoing):
            if delay > 0.0:
                due = time.monotonic_ns() + round(delay * 1e9)
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
            if RPDO in drive.active and len(data) == COMMAND.size:
                drive.command = COMMAND.unpack_from(data)
        elif identifier == SYNC:
            self._on_sync(data[0] if len(data) == 1 else 0)
        elif identifier == self._controller:
            now = time.monotonic_ns()
            for drive in self.drives:
                if drive.controller == identifier - HEARTBEAT:
                    drive.controller_ns = now
        elif identifier in self._requests:
            self._machine.advance(time.monotonic_ns())
            # A request that is no SDO frame is nobody's business.
            with suppress(Exception):
                self._network.notify(identifier, data, 0.0)
        elif identifier == NMT and len(data) == 2:
            self._on_nmt(data[0], data[1])

    def _on_sync(self, sync: int) -> None:
        machine, now = self._machine, time.monotonic_ns()
        machine.advance(now)
        for drive in self.drives:
            drive.settle()
            if drive.command is not None:
                drive.obey(*drive.command)
                drive.command = None
        machine.sample(now)
        if machine.truth is not None and self._fd:
            self._truth.data = bytearray(pack_truth(machine.truth, sync))
            self._send(self._truth)
        for drive in self.drives:
            if TPDO in drive.active:
                drive.answer.data = bytearray(ANSWER.pack(drive.statusword(), drive.velocity(), drive.code))
                self._send(drive.answer)
        raw = raw_readings(machine.measurement, self._scales)
        for node in self.imus:
            if node.active:
                imu = node.imu
                turn = (sync - node.magnetometer_start) % MAGNETOMETER_INTERVAL == 0
                sequence, sample_ns = int(machine.sequence[imu]), int(machine.sample_ns[imu])
                for cob_id, data in pack_imu(raw[:, imu], sequence, sample_ns, sync, self._fd, turn):
                    if cob_id in node.active:
                        answer = node.answers[cob_id]
                        answer.data, answer.dlc = bytearray(data), len(data)
                        self._send(answer)

    def _on_nmt(self, command: int, addressed: int) -> None:
        for node in self._nodes:
            if addressed not in (0, node.node):
                continue
            if command == START:
                node.start()
            elif command in (STOP, PRE_OPERATIONAL):
                node.stop(STOPPED if command == STOP else IS_PRE_OPERATIONAL)
            elif command in (RESET_NODE, RESET_COMMUNICATION):
                self._machine.restart()
                self._boot(node)
