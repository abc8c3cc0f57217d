"""The CANopen rig: six CiA 402 drives in cyclic synchronous velocity mode and seven IMUs, on a bus of python-can.

The loop is the SYNC producer and, by its heartbeat, what the drives watch: both are sent in `exchange`, so that a dead loop is
a dead heartbeat. No thread runs beside it. Commands take effect at the SYNC that they precede.
"""

import struct
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import can
import canopen
from canopen.sdo import SdoAbortedError, SdoClient, SdoCommunicationError

from hil.rigs import ANSWERED, BRAKED, ENABLED, OFF, SILENT, Identity, RigError
from hil.rigs.canopen.cia402 import (
    ABORT_CONNECTION_OPTION,
    ABORT_QUICK_STOP,
    CONTROLWORD,
    CYCLIC_SYNCHRONOUS_VELOCITY,
    DISABLE_AT_ONCE,
    DISABLE_OPERATION_OPTION,
    DISABLE_VOLTAGE,
    ERROR_CODE,
    FAULT,
    FAULT_RAMP,
    FAULT_REACTION_OPTION,
    FAULT_RESET,
    INTERPOLATION_PERIOD,
    MAX_MOTOR_SPEED,
    MODE,
    MODE_DISPLAY,
    NO_STATE,
    QUICK_STOP_COMMAND,
    QUICK_STOP_DECELERATION,
    QUICK_STOP_OPTION,
    QUICK_STOP_RAMP,
    STATES,
    STATUSWORD,
    SWITCHED_ON,
    TARGET_VELOCITY,
    controlword_towards,
    drive_state,
    state_of,
)
from hil.rigs.canopen.frames import (
    BOOT_UP,
    COB_ID,
    COMMAND,
    CONSUMER_HEARTBEAT,
    DEVICE_NAME,
    DEVICE_TYPE,
    DRIVE_PDOS,
    ERROR_REGISTER,
    EVENT_TIMER,
    HEARTBEAT,
    IDENTITY,
    INVALID_COB_ID,
    NMT,
    OPERATIONAL,
    PRE_OPERATIONAL,
    PRODUCER_HEARTBEAT,
    RESET_NODE,
    RPDO,
    SDO_ANSWER,
    SDO_REQUEST,
    START,
    SYNC,
    SYNC_OVERFLOW,
    SYNC_OVERFLOW_VALUE,
    SYNC_START_VALUE,
    TRANSMISSION_TYPE,
    Decoder,
    Pdo,
    drive_scales,
    imu_pdos,
    magnetometer_turn,
)
from hil.rigs.canopen.settings import CanopenSettings, object_dictionary
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.mechanism import LEGS
from plant.pose import Array

_GIVEN_UP_AFTER = 10
"""Exchanges in a row without a frame, after which none waits for it any more until it comes again."""

_SDO_ATTEMPTS = 3
_REMINDER_S = 0.5
_SWITCH_ON_TIMEOUT_S, _MODE_TIMEOUT_S = 2.0, 0.5
_MOST_DRAINED, _MOST_ERRORS = 256, 32
_SDO_CONTROLWORD = struct.Struct("<BHBHH")
_REMEDIES = {
    "socketcan": "set the interface up with ip link, and name it as [bus] channel",
    "udp_multicast": "where there is no route for multicast: ip route add 224.0.0.0/4 dev lo",
    "virtual": "name another [bus] channel",
}
_BUS_ERRORS = (can.CanError, OSError, ValueError)


class _Sdo(SdoClient):  # type: ignore[misc]
    """canopen's SDO client, which reads the bus itself instead of having a thread do it."""

    RESPONSE_TIMEOUT = 0.3

    def __init__(self, node: int, eds: Any, network: canopen.Network, receive: Callable[[float], can.Message | None]) -> None:
        super().__init__(SDO_REQUEST + node, SDO_ANSWER + node, object_dictionary(eds, node))
        self.network = network
        self._receive = receive

    def send_request(self, request: bytes) -> None:
        # What an earlier request has left behind is no answer to this one.
        for _ in range(_MOST_DRAINED):
            if self._receive(0.0) is None:
                break
        super().send_request(request)

    def read_response(self) -> bytes:
        deadline = time.monotonic() + self.RESPONSE_TIMEOUT
        while self.responses.empty():
            left = deadline - time.monotonic()
            if left <= 0.0:
                raise SdoCommunicationError("no answer")
            message = self._receive(left)
            if message is not None and message.arbitration_id == self.tx_cobid and len(message.data) == 8:
                self.responses.put(bytes(message.data))
        response: bytes = super().read_response()
        return response


class _Node:
    """A node as the controller configures it: over SDO, with every value read back."""

    def __init__(self, name: str, node: int, sdo: _Sdo) -> None:
        self.name, self.node = f"{name} (node {node})", node
        self._sdo = sdo

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the EDS has this object."""
        return self._sdo.od.get_variable(index, subindex) is not None

    def expected(self, index: int, subindex: int = 0) -> Any:
        """What the EDS says that an object is."""
        return self._variable(index, subindex).default

    def read(self, index: int, subindex: int = 0) -> Any:
        """The value of an object.

        Raises:
            RigError: the node does not answer or refuses.
        """
        variable = self._variable(index, subindex)
        return self._ask(
            lambda: variable.decode_raw(self._sdo.upload(index, subindex)), f"to tell object {index:04X}h:{subindex:02X}"
        )

    def write(self, index: int, subindex: int, value: int) -> None:
        """Write an object.

        Raises:
            RigError: the node does not answer or refuses.
        """
        data = self._variable(index, subindex).encode_raw(value)
        self._ask(lambda: self._sdo.download(index, subindex, data), f"{_shown(value)} for object {index:04X}h:{subindex:02X}")

    def _variable(self, index: int, subindex: int) -> Any:
        variable = self._sdo.od.get_variable(index, subindex)
        if variable is None:
            raise RigError(f"{self.name} needs object {index:04X}h:{subindex:02X}, which its EDS does not have: check the EDS")
        return variable

    def _ask(self, transfer: Callable[[], Any], purpose: str) -> Any:
        reason: Exception | None = None
        for _ in range(_SDO_ATTEMPTS):
            try:
                return transfer()
            except SdoAbortedError as error:
                raise RigError(f"{self.name} refuses {purpose}: {error}; check its EDS") from None
            except (SdoCommunicationError, struct.error, *_BUS_ERRORS) as error:
                reason = error
        raise RigError(f"{self.name} does not answer over SDO: {reason}; check its power, wiring and bit rate")

    def check(self, index: int, subindex: int, value: Any, within: float = 0.0) -> None:
        """Check that an object has this value, or takes it within a time [s].

        Raises:
            RigError: it has another.
        """
        deadline = time.monotonic() + within
        found = self.read(index, subindex)
        while found != value and time.monotonic() < deadline:
            found = self.read(index, subindex)
        if found != value:
            raise RigError(
                f"{self.name} has {_shown(found)} in object {index:04X}h:{subindex:02X}; it must be {_shown(value)}: "
                "check that it is the right device with the right firmware"
            )

    def configure(self, index: int, subindex: int, value: int) -> None:
        """Write an object and check that it has been taken."""
        self.write(index, subindex, value)
        self.check(index, subindex, value)

    def map_pdo(self, pdo: Pdo) -> None:
        """Configure a PDO and check all of it."""
        cob_id = pdo.cob_id + self.node
        self.write(pdo.communication, COB_ID, cob_id | INVALID_COB_ID)
        self.write(pdo.mapping, 0, 0)
        for i, entry in enumerate(pdo.objects):
            self.write(pdo.mapping, i + 1, entry)
        self.configure(pdo.mapping, 0, len(pdo.objects))
        for i, entry in enumerate(pdo.objects):
            self.check(pdo.mapping, i + 1, entry)
        self.configure(pdo.communication, TRANSMISSION_TYPE, pdo.transmission_type)
        self.configure(pdo.communication, COB_ID, cob_id)


class CanopenRig:
    """A rig on CANopen (see `hil.rigs.Rig`).

    Attributes:
        command_delay: one period [s].
        decoder: what the nodes have said.
        bus_load: share of the bus' time that a cycle takes in the worst case.
    """

    def __init__(self, settings: CanopenSettings, period: float) -> None:
        """Prepare a rig for exchanges every `period` [s].

        Raises:
            RigError: the bus cannot carry that many frames.
        """
        self.command_delay = period
        self.bus_load = settings.check_bus_load(1.0 / period)
        self.decoder = Decoder(settings)
        self._settings = settings
        self._bus: Any = None
        self._nodes: list[_Node] = []
        self._configured = False
        self._answer_ns = round(period * settings.controller.answer_share * 1e9)
        self._silence_ns = round(settings.drives.silence * 1e9)
        self._heartbeat_ns, self._heartbeat_due = round(settings.controller.heartbeat * 1e9), 0
        self._scales = drive_scales(settings)
        self._misses = [0] * self.decoder.all_frames.bit_length()
        self._missed = False
        fd = settings.bus.fd
        self._commands = [
            can.Message(arbitration_id=RPDO + node, is_extended_id=False, data=bytes(COMMAND.size), is_fd=fd, bitrate_switch=fd)
            for node in settings.drives.nodes
        ]
        self._sync = can.Message(arbitration_id=SYNC, is_extended_id=False, data=b"\0")
        self._heartbeat = can.Message(
            arbitration_id=HEARTBEAT + settings.controller.node, is_extended_id=False, data=bytes((OPERATIONAL,))
        )

    def open(self) -> None:
        """Open the bus, reset all nodes and wait until they have booted up.

        Raises:
            RigError: there is no such bus, or a node does not boot up.
            InputError: an EDS file cannot be used.
        """
        bus = self._settings.bus
        try:
            self._bus = can.Bus(**bus.arguments())
            self.decoder, self._misses = Decoder(self._settings), [0] * len(self._misses)
            network = canopen.Network(self._bus)
            self._nodes = [_Node(name, node, _Sdo(node, eds, network, self._receive)) for name, node, eds in self._parts()]
            self._wait_for_boot()
        except GoughError:
            self.close()
            raise
        except (*_BUS_ERRORS, ImportError) as error:
            self.close()
            raise RigError(
                f"cannot use bus {bus.channel!r} of interface {bus.interface}: {error}; {_REMEDIES[bus.interface]}"
            ) from error

    def identify(self) -> Identity:
        """Ask each node for its device type and identity, compare them with the EDS, and configure and start it.

        Raises:
            RigError: a node does not answer, is another than its EDS describes, or refuses its configuration.
        """
        self._check_open()
        parts = {}
        for node in self._nodes:
            node.check(DEVICE_TYPE, 0, node.expected(DEVICE_TYPE))
            for subindex in (1, 2):
                node.check(IDENTITY, subindex, node.expected(IDENTITY, subindex))
            name = node.read(DEVICE_NAME) if node.has(DEVICE_NAME) else "unnamed"
            version = node.read(IDENTITY, 3)
            parts[node.name] = f"{name}, revision {version >> 16}.{version & 0xFFFF}"
        self._configure()
        return Identity(f"CANopen on {self._settings.bus.interface} {self._settings.bus.channel}", parts)

    def arm(self) -> None:
        """Reset the drives' faults and lead them to Switched on.

        Raises:
            RigError: a drive does not get there.
        """
        self._check_open()
        self._configure()
        try:
            for drive, node in enumerate(self._nodes[:LEGS]):
                self.decoder.statuswords[drive] = self._switch_on(node)
                self.decoder.error_codes[drive] = 0
        except _BUS_ERRORS as error:
            raise RigError(f"the bus has failed: {error}; check its wiring and termination") from error

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Send the commands (6,) [m/s] and SYNC, and take the answers to it in (see `hil.rigs.Rig.exchange`)."""
        if self._bus is None:
            return SILENT
        decoder, start = self.decoder, time.monotonic_ns()
        decoder.now_ns, decoder.answered = start, False
        try:
            self._drain()
            self._send_commands(command, request, feedback)
            decoder.begin(self._next_sync())
            self._bus.send(self._sync)
            if start >= self._heartbeat_due:
                self._heartbeat_due = start + self._heartbeat_ns
                self._bus.send(self._heartbeat)
            self._collect(start + self._answer_ns)
        except _BUS_ERRORS:
            # The bus has gone, or its queue is full: nothing is answered.
            decoder.refuse()
        self._note_missing(decoder.end())
        self._fill(feedback, start)
        return ANSWERED if decoder.answered else SILENT

    def quick_stop(self) -> None:
        """Have all drives stop by themselves and hold, by PDO as well as by SDO."""
        self._order(QUICK_STOP_COMMAND)

    def close(self) -> None:
        """Take the power off the drives, which leaves them on their brakes, and let go of the bus."""
        if self._bus is None:
            return
        self._order(DISABLE_VOLTAGE)
        with suppress(Exception):
            self._command_all_nodes(PRE_OPERATIONAL)
        with suppress(Exception):
            self._bus.shutdown()
        self._bus, self._configured = None, False

    def _configure(self) -> None:
        """Configure all nodes, and start them; once."""
        if self._configured:
            return
        try:
            self._command_all_nodes(PRE_OPERATIONAL)
            for node in self._nodes[:LEGS]:
                self._configure_drive(node)
            for imu, node in enumerate(self._nodes[LEGS:]):
                self._configure_imu(imu, node)
            self._start()
        except _BUS_ERRORS as error:
            raise RigError(f"the bus has failed: {error}; check its wiring and termination") from error
        self._configured = True

    def _check_open(self) -> None:
        if self._bus is None:
            raise RigError("the CANopen rig is not open: open it first")

    def _parts(self) -> Iterator[tuple[str, int, Any]]:
        settings = self._settings
        for drive, node in enumerate(settings.drives.nodes):
            yield f"drive {drive}", node, settings.drive_eds
        for imu, node in enumerate(settings.imus.nodes):
            yield f"IMU {imu}", node, settings.imu_eds

    def _receive(self, timeout: float) -> can.Message | None:
        """The next frame, which the decoder has had already; None if there is none in time [s], or one that cannot be read."""
        try:
            message: can.Message | None = self._bus.recv(timeout)
        except can.CanError:
            self.decoder.refuse()
            return None
        if message is not None:
            self.decoder.now_ns = time.monotonic_ns()
            self.decoder.take(
                message.arbitration_id,
                message.data,
                message.is_remote_frame,
                message.is_error_frame,
                message.is_extended_id,
            )
        return message

    def _command_all_nodes(self, command: int, node: int = 0) -> None:
        self._bus.send(can.Message(arbitration_id=NMT, data=bytes((command, node)), is_extended_id=False))

    def _wait_for_boot(self) -> None:
        missing = {HEARTBEAT + node.node: node for node in self._nodes}
        deadline = time.monotonic() + self._settings.controller.boot_timeout
        reminder = 0.0
        while missing:
            now = time.monotonic()
            if now > deadline:
                names = ", ".join(node.name for node in missing.values())
                raise RigError(
                    f"no boot-up within {self._settings.controller.boot_timeout:g} s from {names}: "
                    "check power, wiring, node ids and bit rate"
                )
            if now > reminder:
                reminder = now + _REMINDER_S
                for node in missing.values():
                    self._command_all_nodes(RESET_NODE, node.node)
            message = self._receive(min(deadline, reminder) - now)
            if message is not None and bytes(message.data) == bytes((BOOT_UP,)):
                missing.pop(message.arbitration_id, None)

    def _configure_drive(self, node: _Node) -> None:
        drives = self._settings.drives
        units, exponent = interpolation_period(self.command_delay)
        for pdo in DRIVE_PDOS:
            node.map_pdo(pdo)
        node.configure(PRODUCER_HEARTBEAT, 0, round(drives.heartbeat * 1e3))
        node.configure(QUICK_STOP_OPTION, 0, QUICK_STOP_RAMP)
        for index, subindex, value in (
            (DRIVE_PDOS[0].communication, EVENT_TIMER, round(drives.command_timeout * 1e3)),
            (SYNC_OVERFLOW_VALUE, 0, SYNC_OVERFLOW),
            (DISABLE_OPERATION_OPTION, 0, DISABLE_AT_ONCE),
            (FAULT_REACTION_OPTION, 0, FAULT_RAMP),
            (ABORT_CONNECTION_OPTION, 0, ABORT_QUICK_STOP),
            (INTERPOLATION_PERIOD, 2, exponent),
            (INTERPOLATION_PERIOD, 1, units),
            (MAX_MOTOR_SPEED, 0, round(drives.velocity_limit / drives.screw_lead * drives.gear_ratio * 60.0)),
        ):
            # Not every drive has these.
            if node.has(index, subindex):
                node.configure(index, subindex, value)
        node.configure(QUICK_STOP_DECELERATION, 0, round(drives.quick_stop_deceleration * drives.counts_per_metre))
        node.write(MODE, 0, CYCLIC_SYNCHRONOUS_VELOCITY)
        node.check(MODE_DISPLAY, 0, CYCLIC_SYNCHRONOUS_VELOCITY, _MODE_TIMEOUT_S)
        node.write(TARGET_VELOCITY, 0, 0)

    def _configure_imu(self, imu: int, node: _Node) -> None:
        settings = self._settings
        for number, pdo in enumerate(imu_pdos(settings.bus.fd)):
            node.map_pdo(pdo)
            if number == 2:
                node.configure(pdo.communication, SYNC_START_VALUE, magnetometer_turn(imu))
        node.configure(SYNC_OVERFLOW_VALUE, 0, SYNC_OVERFLOW)
        node.configure(PRODUCER_HEARTBEAT, 0, round(settings.imus.heartbeat * 1e3))

    def _start(self) -> None:
        """Make all nodes operational, and have their heartbeats say so."""
        self.decoder.nmt[:] = [-1] * (LEGS + IMU_COUNT)
        deadline = time.monotonic() + self._settings.controller.boot_timeout
        reminder = 0.0
        while any(state != OPERATIONAL for state in self.decoder.nmt):
            now = time.monotonic()
            if now > deadline:
                names = [node.name for node, state in zip(self._nodes, self.decoder.nmt, strict=True) if state != OPERATIONAL]
                raise RigError(
                    f"{', '.join(names)} does not become operational; read its error register, object {ERROR_REGISTER:04X}h"
                )
            if now > reminder:
                reminder = now + _REMINDER_S
                self._command_all_nodes(START)
            self._receive(min(deadline, reminder) - now)

    def _switch_on(self, node: _Node) -> int:
        """Lead a drive to Switched on, its fault reset; returns its statusword."""
        controller = self._settings.controller
        # Written anew each time: a drive begins to watch for the heartbeat when it next comes, with the first exchange.
        node.configure(CONSUMER_HEARTBEAT, 1, controller.node << 16 | round(controller.heartbeat_timeout * 1e3))
        deadline = time.monotonic() + _SWITCH_ON_TIMEOUT_S
        code, resets = 0, 0
        while True:
            word = int(node.read(STATUSWORD))
            state = state_of(word)
            if state == SWITCHED_ON:
                return word
            if time.monotonic() > deadline or (state == FAULT and resets == 2):
                where = STATES[state] if state != NO_STATE else f"statusword 0x{word:04X}"
                raise RigError(
                    f"{node.name} does not get to {STATES[SWITCHED_ON]}: it stays in {where}, error code "
                    f"0x{code or int(node.read(ERROR_CODE)):04X}; remove the cause that its manual gives"
                )
            if state == FAULT:
                code = int(node.read(ERROR_CODE))
                resets += 1
                node.write(CONTROLWORD, 0, DISABLE_VOLTAGE)
                node.write(CONTROLWORD, 0, FAULT_RESET)
            node.write(CONTROLWORD, 0, controlword_towards(BRAKED, state))

    def _next_sync(self) -> int:
        sync = self._sync.data[0] % SYNC_OVERFLOW + 1
        self._sync.data[0] = sync
        return sync

    def _drain(self) -> None:
        """Take in what came after the last exchange: too late for it, as far as PDOs go."""
        for _ in range(_MOST_DRAINED):
            try:
                message = self._bus.recv(0)
            except can.CanError:
                self.decoder.refuse()
                continue
            if message is None:
                return
            self.decoder.take(
                message.arbitration_id,
                message.data,
                message.is_remote_frame,
                message.is_error_frame,
                message.is_extended_id,
            )

    def _send_commands(self, command: Array, request: int, feedback: Record) -> None:
        statuswords, limit, sent = self.decoder.statuswords, self._settings.drives.velocity_limit, feedback["sent"]
        for drive, message in enumerate(self._commands):
            velocity = float(command[drive]) if request == ENABLED else 0.0
            # A command that is not a number is none.
            velocity = min(max(velocity, -limit), limit) if velocity == velocity else 0.0
            counts = round(velocity * self._scales[drive])
            sent[drive] = counts / self._scales[drive]
            COMMAND.pack_into(message.data, 0, controlword_towards(request, state_of(statuswords[drive])), counts)
            self._bus.send(message)

    def _collect(self, deadline: int) -> None:
        decoder, receive = self.decoder, self._bus.recv
        take, awaited, errors = decoder.take, decoder.awaited, 0
        while awaited & ~decoder.received:
            now = time.monotonic_ns()
            if now >= deadline:
                return
            decoder.now_ns = now
            try:
                message = receive((deadline - now) * 1e-9)
            except can.CanError:
                decoder.refuse()
                errors += 1
                if errors == _MOST_ERRORS:
                    return
                continue
            if message is None:
                return
            take(
                message.arbitration_id,
                message.data,
                message.is_remote_frame,
                message.is_error_frame,
                message.is_extended_id,
            )

    def _note_missing(self, missing: int) -> None:
        """Wait no longer for frames that have not come for a while."""
        if not missing:
            if self._missed:
                self._misses = [0] * len(self._misses)
                self._missed = False
            return
        self._missed = True
        for bit, misses in enumerate(self._misses):
            self._misses[bit] = misses + 1 if missing >> bit & 1 else 0
            if misses + 1 >= _GIVEN_UP_AFTER and missing >> bit & 1:
                self.decoder.awaited &= ~(1 << bit)

    def _fill(self, feedback: Record, start: int) -> None:
        decoder, now = self.decoder, time.monotonic_ns()
        decoder.write_measurement(feedback["measurement"])
        feedback["sample_ns"] = decoder.sample_ns
        feedback["sequence"] = decoder.sequence
        feedback["drive"] = [
            drive_state(decoder.statuswords[drive])
            if decoder.nmt[drive] == OPERATIONAL and now - decoder.heard_ns[drive] <= self._silence_ns
            else OFF
            for drive in range(LEGS)
        ]
        feedback["drive_code"] = decoder.error_codes
        feedback["truth"][:13] = decoder.truth
        feedback["round_trip_ns"] = now - start
        feedback["refused"] = decoder.refused

    def _order(self, controlword: int) -> None:
        """Send all drives a controlword, now and with SYNC, whatever happens."""
        if self._bus is None:
            return
        for message, node in zip(self._commands, self._settings.drives.nodes, strict=True):
            COMMAND.pack_into(message.data, 0, controlword, 0)
            request = _SDO_CONTROLWORD.pack(0x2B, CONTROLWORD, 0, controlword, 0)
            with suppress(Exception):
                self._bus.send(message)
            with suppress(Exception):
                self._bus.send(can.Message(arbitration_id=SDO_REQUEST + node, data=request, is_extended_id=False))
        with suppress(Exception):
            self.decoder.begin(self._next_sync())
            self._bus.send(self._sync)


def interpolation_period(period: float) -> tuple[int, int]:
    """A period [s] as CiA 402's object 60C2h has it: so many (at most 255) times a power of ten of a second."""
    exponents = range(-3, -7, -1)
    exact = (each for each in exponents if abs(period * 10.0**-each - round(period * 10.0**-each)) < 1e-6)
    exponent = next((each for each in exact if 1 <= round(period * 10.0**-each) <= 255), None)
    if exponent is None:
        exponent = min((each for each in exponents if period * 10.0**-each <= 255.0), default=-3)
    return max(1, round(period * 10.0**-exponent)), exponent


def _shown(value: Any) -> str:
    return f"0x{value & 0xFFFFFFFF:X}" if isinstance(value, int) else repr(value)
