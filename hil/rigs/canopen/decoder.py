"""The decoder of the nodes' frames: statuswords, heartbeats and samples, and the count of everything that is refused."""

from collections.abc import Callable

import can
import numpy as np

from hil.rigs.canopen.frames import (
    ANSWER,
    CLASSIC_TAIL,
    FD_TAIL,
    HOME_INPUT,
    NO_VALUE,
    POSITION,
    SYNC_OVERFLOW,
    TRUTH,
    TRUTH_ID,
    CobId,
    NodeState,
    int32,
)
from hil.rigs.canopen.settings import FD_BYTES, CanopenSettings
from plant.imu_wiring import BASE_IMU, IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

_TAIL_AT = 18
_NODE_STATES = frozenset(NodeState)


class Decoder:
    """What the nodes have sent. It accepts any frame and never raises; a frame that is unknown, malformed, late or a duplicate
    changes nothing and is counted.

    Attributes:
        statuswords, velocities, error_codes: of the drives; velocities in counts/s.
        positions, homes: of their encoders, without wraps, and of their home switches; None before the first.
        nmt: state in the last heartbeat of each drive, then of each IMU; -1 before the first.
        heard_ns: time of each node's last frame on the controller's clock [ns].
        now_ns: that clock, set by the reader of the bus [ns].
        awaited: a bit for each frame that is expected in answer to SYNC.
        received: a bit for each of these frames that has arrived.
        refused: number of refused frames.
        answered: set when an IMU has answered this SYNC.
        sample_ns, sequence: time [ns] and number of the IMUs' samples.
        truth: position, quaternion and lengths of an emulated rig; else NaN.
    """

    def __init__(self, settings: CanopenSettings, lengths: bool = False) -> None:
        fd, drives, imus = settings.bus.fd, settings.drives.nodes, settings.imus.nodes
        of_imus = len(imus)
        count = LEGS + of_imus * (1 if fd else 2)
        positions = 1 << count
        # By identifier: how to decode the data, the node's number, the bit in `awaited`, and the length; None for any.
        self._table: dict[int, tuple[Callable[[int, bytearray], bool], int, int, int | None]] = {}
        for drive, node in enumerate(drives):
            self._table[CobId.TPDO + node] = self._take_drive, drive, 1 << drive, ANSWER.size
            self._table[CobId.HEARTBEAT + node] = self._take_heartbeat, drive, 0, 1
            self._table[CobId.EMERGENCY + node] = self._take_emergency, drive, 0, 8
            if lengths:
                self._table[CobId.TPDO + 0x100 + node] = self._take_position, drive, positions << drive, POSITION.size
        for imu, node in enumerate(imus):
            first = 1 << LEGS + imu
            self._table[CobId.HEARTBEAT + node] = self._take_heartbeat, LEGS + imu, 0, 1
            self._table[CobId.EMERGENCY + node] = self._ignore, imu, 0, 8
            if fd:
                self._table[CobId.TPDO + node] = self._take_fd, imu, first, FD_BYTES
            else:
                self._table[CobId.TPDO + node] = self._take_gyroscope, imu, first, 8
                self._table[CobId.TPDO + 0x100 + node] = self._take_accelerometer, imu, first << of_imus, 8
                self._table[CobId.TPDO + 0x200 + node] = self._take_magnetometer, imu, 0, 8
        # Frames of this side, which some buses return, and late answers to SDO requests.
        own = [CobId.NMT, CobId.SYNC, CobId.HEARTBEAT + settings.controller.node, *(CobId.RPDO + node for node in drives)]
        for each in own + [sdo + node for sdo in (CobId.SDO_ANSWER, CobId.SDO_REQUEST) for node in (*drives, *imus)]:
            self._table[each] = self._ignore, 0, 0, None
        self.all_frames = (1 << count + lengths * LEGS) - 1
        self.statuswords, self.velocities, self.error_codes = [0] * LEGS, [0] * LEGS, [0] * LEGS
        self.positions: list[int | None] = [None] * LEGS
        self.homes: list[bool | None] = [None] * LEGS
        self.nmt, self.heard_ns = [-1] * (LEGS + of_imus), [0] * (LEGS + of_imus)
        self.awaited, self.received, self.refused, self.answered = self.all_frames, self.all_frames, 0, False
        self.sample_ns, self.sequence = [0] * of_imus, [-1] * of_imus
        self.truth: tuple[float, ...] = (float("nan"),) * 13
        self.now_ns, self._sync, self._syncs = 0, 0, 0
        self._missing, self._positions = self.all_frames, positions
        self._sample_at, self._sample_sync = [0] * of_imus, [0] * of_imus
        self._stamps, self._counters = [0] * of_imus, [0] * of_imus
        self._pending: list[tuple[bytes, int]] = [(b"", 0)] * of_imus
        self._magnetic_sync = [0] * of_imus
        self._raw = [bytearray(NO_VALUE.to_bytes(2, "little", signed=True) * (3 * of_imus)) for _ in range(3)]
        self._readings = [np.frombuffer(sensor, "<i2").reshape(of_imus, 3) for sensor in self._raw]
        self._scales = settings.imus.scales

    def begin(self, sync: int) -> None:
        """Accept answers to the SYNC with this counter from now on."""
        self._sync, self.received = sync, 0
        self._syncs += 1

    def end(self) -> int:
        """Accept no more answers to this SYNC; returns a bit for each missing frame."""
        self._missing = self.all_frames & ~self.received
        self.received = self.all_frames
        return self._missing

    def answered_position(self, drive: int) -> bool:
        """Whether a drive has told its position in answer to the last SYNC that has ended."""
        return not self._missing & self._positions << drive

    def take(self, message: can.Message) -> bool:
        """Decode a frame; returns whether it was valid."""
        identifier, broken = message.arbitration_id, message.is_remote_frame or message.is_error_frame
        if message.is_extended_id and identifier == TRUTH_ID and len(message.data) == TRUTH.size and not broken:
            *truth, sync = TRUTH.unpack_from(message.data)
            if sync == self._sync:
                self.truth = tuple(truth)
                return True
        entry = self._table.get(identifier)
        if entry is None or broken or message.is_extended_id:
            self.refused += 1
            return False
        decode, node, bit, size = entry
        if self.received & bit:
            # A silent node that was given up is awaited again.
            self.awaited |= bit
            self.refused += 1
            return False
        valid = size in (None, len(message.data)) and decode(node, message.data)
        if valid:
            self.received |= bit
            self.awaited |= bit
        else:
            self.refused += 1
        return valid

    def _take_drive(self, drive: int, data: bytearray) -> bool:
        self.statuswords[drive], self.velocities[drive], self.error_codes[drive] = ANSWER.unpack_from(data)
        self.heard_ns[drive] = self.now_ns
        return True

    def _take_position(self, drive: int, data: bytearray) -> bool:
        position, inputs = POSITION.unpack_from(data)
        before = self.positions[drive]
        # The counter wraps at 32 bits.
        self.positions[drive] = position if before is None else before + int32(position - before)
        self.homes[drive] = bool(inputs & HOME_INPUT)
        return True

    def _take_heartbeat(self, node: int, data: bytearray) -> bool:
        if data[0] not in _NODE_STATES:
            return False
        self.nmt[node], self.heard_ns[node] = data[0], self.now_ns
        return True

    def _take_emergency(self, drive: int, data: bytearray) -> bool:
        self.error_codes[drive] = int.from_bytes(data[:2], "little")
        return True

    def _ignore(self, node: int, data: bytearray) -> bool:
        return True

    def _take_fd(self, imu: int, data: bytearray) -> bool:
        counter, stamp, sync = FD_TAIL.unpack_from(data, _TAIL_AT)
        if sync != self._sync:
            return False
        at = 6 * imu
        for sensor, raw in enumerate(self._raw):
            raw[at : at + 6] = data[6 * sensor : 6 * sensor + 6]
        self._count(imu, counter, 1 << 32, stamp, 1 << 32, 1000)
        return True

    def _take_gyroscope(self, imu: int, data: bytearray) -> bool:
        counter, sync = CLASSIC_TAIL.unpack_from(data, 6)
        if sync != self._sync:
            return False
        self._pending[imu] = bytes(data[:6]), counter
        return True

    def _take_accelerometer(self, imu: int, data: bytearray) -> bool:
        if not self.received & 1 << LEGS + imu:
            return False
        at = 6 * imu
        self._raw[0][at : at + 6], counter = self._pending[imu]
        self._raw[1][at : at + 6] = data[:6]
        self._count(imu, counter, 1 << 8, int.from_bytes(data[6:], "little"), 1 << 16, 10_000)
        return True

    def _take_magnetometer(self, imu: int, data: bytearray) -> bool:
        # Accepted a SYNC late, too: it is sampled so seldom that nothing waits for it.
        sync = data[6]
        if sync == self._magnetic_sync[imu] or (self._sync - sync) % SYNC_OVERFLOW > 1:
            return False
        self._magnetic_sync[imu] = sync
        self._raw[2][6 * imu : 6 * imu + 6] = data[:6]
        return True

    def _count(self, imu: int, counter: int, counters: int, stamp: int, stamps: int, unit_ns: int) -> None:
        """Note that this sample is the IMU's answer to SYNC; time and number advance with a new sample only."""
        self.answered = True
        if self.sequence[imu] < 0:
            self.sequence[imu], self.sample_ns[imu] = counter, stamp * unit_ns
        elif counter != self._counters[imu]:
            elapsed = (self.now_ns - self._sample_at[imu]) / unit_ns
            self.sample_ns[imu] += advance_of(stamp, self._stamps[imu], stamps, elapsed) * unit_ns
            self.sequence[imu] += advance_of(counter, self._counters[imu], counters, self._syncs - self._sample_sync[imu])
        else:
            return
        self._stamps[imu], self._counters[imu], self._sample_at[imu] = stamp, counter, self.now_ns
        self._sample_sync[imu] = self._syncs

    def write_measurement(self, measurement: Array) -> None:
        """Write the last readings (3, 7, 3) [rad/s, m/s^2, uT], NaN without a value."""
        for sensor, readings in enumerate(self._readings):
            np.multiply(readings[:IMU_COUNT], self._scales[sensor, :IMU_COUNT], out=measurement[sensor])
            measurement[sensor][readings[:IMU_COUNT] == NO_VALUE] = np.nan

    def write_base_imu(self, measurement: Array) -> None:
        """Write the last reading (2, 3) of the IMU on the base [rad/s, m/s^2], NaN without a value."""
        for sensor, readings in enumerate(self._readings[:2]):
            np.multiply(readings[BASE_IMU], self._scales[sensor, BASE_IMU], out=measurement[sensor])
            measurement[sensor][readings[BASE_IMU] == NO_VALUE] = np.nan


def advance_of(stamp: int, before: int, modulus: int, expected: float) -> int:
    """The advance of a counter that wraps at `modulus`, if that is about the expected one; never negative."""
    advance = (stamp - before) % modulus
    if advance - expected > modulus / 2:
        # The counter has gone back: the IMU has restarted.
        return max(round(expected), 1)
    return advance + max(round((expected - advance) / modulus), 0) * modulus
