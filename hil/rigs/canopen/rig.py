"""The CANopen rig: six CiA 402 drives in a cyclic synchronous mode, velocity or position, and seven IMUs, on a bus of
python-can.

The loop produces SYNC, and the heartbeat that the drives watch. `exchange` sends both, so the heartbeat dies with the loop. No
thread runs beside it. Commands take effect at the SYNC after them.
"""

import struct
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import can
import canopen
import numpy as np

from hil.rigs import ANSWERED, SILENT, DriveState, Identity, Request, RigError
from hil.rigs.canopen.cia402 import OFF_TARGET, Controlword, controlword_towards, drive_state, state_of
from hil.rigs.canopen.configuration import BUS_ERRORS, MOST_DRAINED, RemoteNode, configure_drive, configure_imu, switch_on
from hil.rigs.canopen.decoder import Decoder
from hil.rigs.canopen.frames import COMMAND, SYNC_OVERFLOW, CobId, NmtCommand, NodeState, Object, int32, new_message
from hil.rigs.canopen.settings import CanopenSettings
from hil.rigs.position_loops import FOLLOWING_ERROR
from hil.rigs.position_targets import PositionTargets
from plant.compiled import Record
from plant.errors import GoughError
from plant.imu_wiring import BASE_IMU, IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

_GIVEN_UP_AFTER = 10
"""Number of exchanges in a row without a frame after which no exchange waits for it, until it arrives again."""

_REMINDER_S = 0.5
_MOST_ERRORS = 32
_SDO_CONTROLWORD = struct.Struct("<BHBHH")
_REMEDIES = {
    "socketcan": "set the interface up with ip link, and name it as [bus] channel",
    "udp_multicast": "where there is no route for multicast: ip route add 224.0.0.0/4 dev lo",
    "virtual": "name another [bus] channel",
}


class CanopenRig:
    """A rig on CANopen (see `hil.rigs.Rig`)."""

    def __init__(
        self,
        settings: CanopenSettings,
        period: float,
        opened: Callable[[], Any] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        lengths: bool = False,
    ) -> None:
        """Prepare a rig for exchanges every `period` [s].

        Args:
            settings: of the bus and its nodes.
            period: [s].
            opened: opens the bus, by default that of the settings.
            clock: [ns].
            lengths: whether the drives are to tell what their encoders read.

        Raises:
            RigError: the bus cannot carry that many frames.
        """
        self.command_delay = period
        self.bus_load = settings.check_bus_load(1.0 / period, lengths)  # in the worst case
        self._lengths, self._told_positions = lengths, settings.drives.holds_positions
        self.decoder = Decoder(settings, lengths or self._told_positions)
        self._settings, self._open, self._clock = settings, opened or settings.bus.opened, clock
        self._bus: Any = None
        self._nodes: list[RemoteNode] = []
        self._configured = False
        self._answer_ns = round(period * settings.controller.answer_share * 1e9)
        self._silence_ns = round(settings.drives.silence * 1e9)
        self._heartbeat_ns, self._heartbeat_due = round(settings.controller.heartbeat * 1e9), 0
        self._scales = settings.drives.scales
        self._targets = PositionTargets(period, settings.drives.velocity_limit)
        self._misses = [0] * self.decoder.all_frames.bit_length()
        fd = settings.bus.fd
        self._commands = [
            new_message(CobId.RPDO + node, bytes(COMMAND.size), is_fd=fd, bitrate_switch=fd) for node in settings.drives.nodes
        ]
        self._sync = new_message(CobId.SYNC, b"\0")
        self._heartbeat = new_message(CobId.HEARTBEAT + settings.controller.node, bytes((NodeState.OPERATIONAL,)))

    def open(self) -> None:
        """Open the bus, reset all nodes and wait until they have booted up.

        Raises:
            RigError: there is no such bus, or a node does not boot up.
            InputError: an EDS file cannot be used.
        """
        bus, drives, imus = self._settings.bus, self._settings.drives, self._settings.imus
        try:
            self._bus = self._open()
            self.decoder = Decoder(self._settings, self._lengths or self._told_positions)
            self._misses = [0] * len(self._misses)
            self._targets = PositionTargets(self.command_delay, self._settings.drives.velocity_limit)
            network = canopen.Network(self._bus)
            self._nodes = [
                RemoteNode(f"{name} {number}", node, table.eds, network, self._receive, self._clock)
                for name, table in (("drive", drives), ("IMU", imus))
                for number, node in enumerate(table.nodes)
            ]
            within = f"{self._settings.controller.boot_timeout:g} s"
            complaint = f"no boot-up within {within} from {{}}: check power, wiring, node ids and bit rate"
            self._lead_nodes(NmtCommand.RESET_NODE, NodeState.BOOT_UP, complaint, broadcast=False)
        except GoughError:
            self.close()
            raise
        except (*BUS_ERRORS, ImportError) as error:
            self.close()
            raise RigError(
                f"cannot use bus {bus.channel!r} of interface {bus.interface}: {error}; {_REMEDIES[bus.interface]}"
            ) from error

    def identify(self) -> Identity:
        """Ask each node for its device type and identity, compare them with the EDS, and configure and start it; see
        `hil.rigs.Rig.identify`.
        """
        self._check_open()
        parts = {}
        for node in self._nodes:
            node.check(Object.DEVICE_TYPE, 0, node.expected(Object.DEVICE_TYPE))
            for subindex in (1, 2):
                node.check(Object.IDENTITY, subindex, node.expected(Object.IDENTITY, subindex))
            name = node.read(Object.DEVICE_NAME) if node.has(Object.DEVICE_NAME) else "unnamed"
            version = node.read(Object.IDENTITY, 3)
            parts[node.name] = f"{name}, revision {version >> 16}.{version & 0xFFFF}"
        self._configure()
        return Identity(f"CANopen on {self._settings.bus.interface} {self._settings.bus.channel}", parts)

    def arm(self) -> None:
        """Reset the drives' faults and lead them to Switched on (see `hil.rigs.Rig.arm`)."""
        self._check_open()
        self._configure()
        for drive, node in enumerate(self._nodes[:LEGS]):
            self.decoder.statuswords[drive] = switch_on(node, self._settings.controller)
            self.decoder.error_codes[drive] = 0

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Send the commands (6,) [m/s] and SYNC, and receive the answers to it (see `hil.rigs.Rig.exchange`)."""
        if self._bus is None:
            return SILENT
        decoder, start = self.decoder, self._clock()
        decoder.now_ns, decoder.answered = start, False
        try:
            self._drain()
            self._send_commands(command, request, feedback)
            self._bus.send(self._next_sync())
            if start >= self._heartbeat_due:
                self._heartbeat_due = start + self._heartbeat_ns
                self._bus.send(self._heartbeat)
            self._collect(start + self._answer_ns)
        except BUS_ERRORS:
            # The bus is gone, or its queue is full: there is no answer.
            decoder.refused += 1
        self._note_missing(decoder.end())
        self._fill(feedback, start)
        return ANSWERED if decoder.answered else SILENT

    def quick_stop(self) -> None:
        """Send all drives a quick stop, by PDO and by SDO; they then hold."""
        self._order(Controlword.QUICK_STOP)

    def close(self) -> None:
        """Take the power off the drives, which closes their brakes, and close the bus."""
        if self._bus is None:
            return
        self._order(Controlword.DISABLE_VOLTAGE)
        with suppress(Exception):
            self._command_nodes(NmtCommand.ENTER_PRE_OPERATIONAL)
        with suppress(Exception):
            self._bus.shutdown()
        self._bus, self._configured = None, False

    def _configure(self) -> None:
        """Configure all nodes, and start them; once."""
        if self._configured:
            return
        try:
            self._command_nodes(NmtCommand.ENTER_PRE_OPERATIONAL)
            for node in self._nodes[:LEGS]:
                configure_drive(node, self._settings.drives, self.command_delay, self._lengths)
            for imu, node in enumerate(self._nodes[LEGS:]):
                configure_imu(node, imu, self._settings)
            complaint = f"{{}} does not become operational; read its error register, object {Object.ERROR_REGISTER:04X}h"
            self._lead_nodes(NmtCommand.START, NodeState.OPERATIONAL, complaint, broadcast=True)
        except BUS_ERRORS as error:
            raise RigError(f"the bus has failed: {error}; check its wiring and termination") from error
        self._configured = True

    def _check_open(self) -> None:
        if self._bus is None:
            raise RigError("the CANopen rig is not open: open it first")

    def _read(self, timeout: float) -> can.Message | None:
        """The next frame, decoded; None if none arrives in time [s].

        Raises:
            CanError: the frame cannot be read; it is counted as refused.
        """
        try:
            message: can.Message | None = self._bus.recv(timeout)
        except can.CanError:
            self.decoder.refused += 1
            raise
        if message is not None:
            self.decoder.now_ns = self._clock()
            self.decoder.take(message)
        return message

    def _receive(self, timeout: float) -> can.Message | None:
        """The next frame, decoded; None if none arrives in time [s], or if it cannot be read."""
        with suppress(can.CanError):
            return self._read(timeout)
        return None

    def _command_nodes(self, command: NmtCommand, node: int = 0) -> None:
        """Send an NMT command to a node, by default to all."""
        self._bus.send(new_message(CobId.NMT, bytes((command, node))))

    def _lead_nodes(self, command: NmtCommand, state: NodeState, complaint: str, broadcast: bool) -> None:
        """Send the nodes an NMT command until each has reported a state; the `complaint` names those that have not."""
        self.decoder.nmt[:] = [-1] * len(self._nodes)
        missing = list(enumerate(self._nodes))
        deadline = 1e-9 * self._clock() + self._settings.controller.boot_timeout
        reminder = 0.0
        while missing := [(i, node) for i, node in missing if self.decoder.nmt[i] != state]:
            now = 1e-9 * self._clock()
            if now > deadline:
                raise RigError(complaint.format(", ".join(node.name for _, node in missing)))
            if now > reminder:
                reminder = now + _REMINDER_S
                for node in [0] if broadcast else [node.node for _, node in missing]:
                    self._command_nodes(command, node)
            self._receive(min(deadline, reminder) - now)

    def _next_sync(self) -> can.Message:
        """The next SYNC, whose answers the decoder then accepts."""
        self._sync.data[0] = self._sync.data[0] % SYNC_OVERFLOW + 1
        self.decoder.begin(self._sync.data[0])
        return self._sync

    def _drain(self) -> None:
        """Read the frames since the last exchange; as PDOs they are too late for it."""
        for _ in range(MOST_DRAINED):
            with suppress(can.CanError):
                if self._read(0.0) is None:
                    return

    def _send_commands(self, command: Array, request: int, feedback: Record) -> None:
        statuswords, limit, sent = self.decoder.statuswords, self._settings.drives.velocity_limit, feedback["sent"]
        targets = self._next_targets(command, request) if self._told_positions else None
        for drive, message in enumerate(self._commands):
            velocity = float(command[drive]) if request == Request.ENABLED else 0.0
            # NaN is no command.
            velocity = min(max(velocity, -limit), limit) if velocity == velocity else 0.0
            word = controlword_towards(request, state_of(statuswords[drive]))
            if targets is None:
                counts = round(velocity * self._scales[drive])
                sent[drive] = counts / self._scales[drive]
            else:
                counts, sent[drive] = targets[drive], velocity
                if self.decoder.positions[drive] is None:
                    # A drive without a position has no target either.
                    word = controlword_towards(Request.BRAKED, state_of(statuswords[drive]))
            COMMAND.pack_into(message.data, 0, word, counts)
            self._bus.send(message)

    def _next_targets(self, command: Array, request: int) -> list[int]:
        """The drives' target positions [counts], in 32 bits."""
        decoder, scales = self.decoder, np.array(self._scales)
        read = np.array([np.nan if position is None else position for position in decoder.positions]) / scales
        following = [drive_state(word) == DriveState.FOLLOWING for word in decoder.statuswords]
        targets = self._targets.advance(command, request, following, read) * scales
        return [int32(round(target)) if target == target else 0 for target in targets.tolist()]

    def _collect(self, deadline: int) -> None:
        """Read the answers to SYNC, until all awaited frames are there or until the deadline."""
        decoder, awaited, errors = self.decoder, self.decoder.awaited, 0
        while awaited & ~decoder.received and errors < _MOST_ERRORS:
            left = deadline - self._clock()
            try:
                if left <= 0 or self._read(left * 1e-9) is None:
                    return
            except can.CanError:
                errors += 1

    def _note_missing(self, missing: int) -> None:
        """Stop waiting for frames that have been missing for a while."""
        for bit, misses in enumerate(self._misses):
            self._misses[bit] = misses + 1 if missing >> bit & 1 else 0
            if self._misses[bit] >= _GIVEN_UP_AFTER:
                self.decoder.awaited &= ~(1 << bit)

    def _fill(self, feedback: Record, start: int) -> None:
        decoder, now = self.decoder, self._clock()
        decoder.write_measurement(feedback["measurement"])
        feedback["sample_ns"] = decoder.sample_ns[:IMU_COUNT]
        feedback["sequence"] = decoder.sequence[:IMU_COUNT]
        if len(decoder.sequence) > BASE_IMU:
            decoder.write_base_imu(feedback["base_imu"])
            feedback["base_imu_ns"], feedback["base_imu_sequence"] = decoder.sample_ns[BASE_IMU], decoder.sequence[BASE_IMU]
        feedback["drive"] = [
            drive_state(decoder.statuswords[drive], self._told_positions)
            if decoder.nmt[drive] == NodeState.OPERATIONAL and now - decoder.heard_ns[drive] <= self._silence_ns
            else DriveState.NOT_READY
            for drive in range(LEGS)
        ]
        feedback["drive_code"] = [
            code or (FOLLOWING_ERROR if self._told_positions and word & OFF_TARGET else 0)
            for code, word in zip(decoder.error_codes, decoder.statuswords, strict=True)
        ]
        if self._lengths:
            self._fill_lengths(feedback)
        feedback["truth"][:13] = decoder.truth
        feedback["round_trip_ns"] = now - start
        feedback["refused"] = decoder.refused

    def _fill_lengths(self, feedback: Record) -> None:
        """What the encoders read; one that does not answer this SYNC reads nothing."""
        decoder, lengths, rates, homes = self.decoder, feedback["length"], feedback["length_rate"], feedback["home"]
        for drive, (position, home) in enumerate(zip(decoder.positions, decoder.homes, strict=True)):
            there = position is not None and decoder.answered_position(drive)
            lengths[drive] = position / self._scales[drive] if position is not None and there else np.nan
            rates[drive] = decoder.velocities[drive] / self._scales[drive] if there else np.nan
            homes[drive] = -1 if home is None else int(home)

    def _order(self, controlword: Controlword) -> None:
        """Send all drives a controlword, by SDO and by PDO with SYNC, whatever happens."""
        if self._bus is None:
            return
        frames, request = [], _SDO_CONTROLWORD.pack(0x2B, Object.CONTROLWORD, 0, controlword, 0)
        for message, node in zip(self._commands, self._settings.drives.nodes, strict=True):
            target = COMMAND.unpack(message.data)[1] if self._told_positions else 0
            COMMAND.pack_into(message.data, 0, controlword, target)
            frames += [message, new_message(CobId.SDO_REQUEST + node, request)]
        for frame in (*frames, self._next_sync()):
            with suppress(Exception):
                self._bus.send(frame)
