"""Frames of the CANopen rig: layout and mapping of its PDOs, packed beforehand, and the decoder of what the nodes answer.

An IMU's synchronous PDOs carry the counter of the SYNC (object 1019h) that they answer. That tells a late answer to an earlier
SYNC from the answer to this one; the sample counter beside it stands when the IMU repeats a sample.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.rigs.canopen.settings import FD_BYTES, MAGNETOMETER_INTERVAL, CanopenSettings
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

NMT, SYNC, EMERGENCY, TPDO, RPDO, SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0, 0x80, 0x80, 0x180, 0x200, 0x580, 0x600, 0x700
"""Identifiers of CANopen's predefined connection set, all but NMT and SYNC plus the node id; further TPDOs are 100h apart."""

START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 0x80, 0x81, 0x82
"""NMT commands."""

BOOT_UP, STOPPED, OPERATIONAL, IS_PRE_OPERATIONAL = 0, 4, 5, 127
"""What a heartbeat says."""

SYNC_OVERFLOW = 240
"""The SYNC counter goes from 1 to this."""

NO_VALUE = -32768
"""Raw reading of an axis that has none."""

ERROR_REGISTER, DEVICE_TYPE, DEVICE_NAME, CONSUMER_HEARTBEAT, PRODUCER_HEARTBEAT, IDENTITY, SYNC_OVERFLOW_VALUE = (
    0x1001, 0x1000, 0x1008, 0x1016, 0x1017, 0x1018, 0x1019,
)  # fmt: skip
"""Objects of every node."""

COB_ID, TRANSMISSION_TYPE, EVENT_TIMER, SYNC_START_VALUE = 1, 2, 5, 6
"""Sub-indices of a PDO's communication parameters."""

INVALID_COB_ID = 1 << 31
"""Bit of a PDO's COB-ID that switches it off."""

COMMAND, ANSWER = struct.Struct("<Hi"), struct.Struct("<HiH")
"""A drive's PDOs: controlword and target velocity [counts/s]; statusword, velocity [counts/s] and error code."""

_AXES, _CLASSIC_TAIL, _FD_TAIL, _CODE, _STAMP = (struct.Struct(f"<{each}") for each in ("3h", "BB", "IIB", "H", "H"))
_TAIL_AT = 18


@dataclass(frozen=True)
class Pdo:
    """A PDO as it is configured over SDO.

    Attributes:
        communication, mapping: indices of its communication and mapping parameters.
        cob_id: without the node id.
        transmission_type: 1, or how many SYNCs there are per transmission.
        objects: what is mapped: index (16 bits), sub-index (8), length in bits (8).
    """

    communication: int
    mapping: int
    cob_id: int
    transmission_type: int
    objects: tuple[int, ...]


_GYROSCOPE = (0x20000110, 0x20000210, 0x20000310)
_ACCELEROMETER = (0x20010110, 0x20010210, 0x20010310)
_MAGNETOMETER = (0x20020110, 0x20020210, 0x20020310)
_SAMPLE_COUNTER, _LOW_SAMPLE_COUNTER, _SYNC_COUNTER, _MICROSECONDS, _TENS_OF_MICROSECONDS = (
    0x20100020, 0x20110008, 0x20120008, 0x20130020, 0x20140010,
)  # fmt: skip

DRIVE_PDOS = (
    Pdo(0x1400, 0x1600, RPDO, 1, (0x60400010, 0x60FF0020)),
    Pdo(0x1800, 0x1A00, TPDO, 1, (0x60410010, 0x606C0020, 0x603F0010)),
)
IMU_PDOS_CLASSIC = (
    Pdo(0x1800, 0x1A00, TPDO, 1, (*_GYROSCOPE, _LOW_SAMPLE_COUNTER, _SYNC_COUNTER)),
    Pdo(0x1801, 0x1A01, TPDO + 0x100, 1, (*_ACCELEROMETER, _TENS_OF_MICROSECONDS)),
    Pdo(0x1802, 0x1A02, TPDO + 0x200, MAGNETOMETER_INTERVAL, (*_MAGNETOMETER, _SYNC_COUNTER)),
)
"""Of an IMU on classic CAN. The sample counter wraps at 256, the time stamp, in units of 10 us, at 655.36 ms; the decoder tells
by its own clock how often they have."""

IMU_PDOS_FD = (
    Pdo(
        0x1800,
        0x1A00,
        TPDO,
        1,
        (*_GYROSCOPE, *_ACCELEROMETER, *_MAGNETOMETER, _SAMPLE_COUNTER, _MICROSECONDS, _SYNC_COUNTER),
    ),
)
"""Of an IMU on CAN FD: 27 bytes in a frame of 32. The time stamp in us wraps after 71.6 minutes."""


def imu_pdos(fd: bool) -> tuple[Pdo, ...]:
    """The PDOs of an IMU."""
    return IMU_PDOS_FD if fd else IMU_PDOS_CLASSIC


def magnetometer_turn(imu: int) -> int:
    """SYNC start value of an IMU's magnetometer on classic CAN, so that they take turns."""
    return imu + 1


def advance_of(stamp: int, before: int, modulus: int, expected: float) -> int:
    """By how much a counter that wraps at `modulus` has advanced, if that is about as much as expected; never negative."""
    advance = (stamp - before) % modulus
    if advance - expected > modulus / 2:
        # It has gone back: the IMU has started anew.
        return max(round(expected), 1)
    return advance + max(round((expected - advance) / modulus), 0) * modulus


def pack_imu(
    raw: NDArray[np.int16], sequence: int, sample_ns: int, sync: int, fd: bool, magnetometer: bool
) -> list[tuple[int, bytes]]:
    """The frames of an IMU's sample: identifier without the node id, and data.

    Args:
        raw: (3, 3) readings of gyroscope, accelerometer and magnetometer in LSB.
        sequence: number of the sample.
        sample_ns: its time on the IMU's clock [ns].
        sync: counter of the SYNC.
        fd: whether the bus is CAN FD.
        magnetometer: whether it is the magnetometer's turn, on classic CAN.
    """
    if fd:
        tail = _FD_TAIL.pack(sequence & 0xFFFFFFFF, sample_ns // 1000 & 0xFFFFFFFF, sync)
        return [(TPDO, (raw.tobytes() + tail).ljust(FD_BYTES, b"\0"))]
    frames = [
        (TPDO, raw[0].tobytes() + _CLASSIC_TAIL.pack(sequence & 0xFF, sync)),
        (TPDO + 0x100, raw[1].tobytes() + _STAMP.pack(sample_ns // 10_000 & 0xFFFF)),
    ]
    if magnetometer:
        frames.append((TPDO + 0x200, raw[2].tobytes() + _CLASSIC_TAIL.pack(0, sync)[1:].ljust(2, b"\0")))
    return frames


TRUTH = 0x1F470001
"""Extended identifier of the frame in which an emulated rig on CAN FD tells the truth, which no hardware does."""

_TRUTH = struct.Struct("<13fB")
TRUTH_BYTES = 64


def pack_truth(truth: Array, sync: int) -> bytes:
    """Position [m], quaternion and lengths [m] of the plant's truth, at this SYNC."""
    return _TRUTH.pack(*truth[:13], sync).ljust(TRUTH_BYTES, b"\0")


_DRIVE, _IMU_FD, _GYRO, _ACCEL, _MAGNETO, _BEAT, _EMCY, _OTHER = range(8)


class Decoder:
    """What the nodes have said. It takes any frame whatever and never raises; a frame that is unknown, malformed, late or
    double changes nothing and is counted.

    Attributes:
        statuswords, velocities, error_codes: of the drives; velocities in counts/s.
        nmt: what the last heartbeat of each drive, then of each IMU, said; -1 before it.
        heard_ns: when it was last heard of, on the controller's clock [ns].
        now_ns: that clock, set by who reads the bus [ns].
        awaited: a bit for each frame that an answer to SYNC is expected to have.
        received: a bit for each frame of it that has come.
        refused: how many frames have been refused.
        answered: set when an IMU has answered this SYNC.
        sample_ns, sequence: of the IMUs.
        truth: position, quaternion and lengths, where an emulated rig tells them; NaN elsewhere.
    """

    def __init__(self, settings: CanopenSettings) -> None:
        fd, drives, imus = settings.bus.fd, settings.drives.nodes, settings.imus.nodes
        self._table: dict[int, tuple[int, int, int]] = {}
        for drive, node in enumerate(drives):
            self._table[TPDO + node] = _DRIVE, drive, 1 << drive
            self._table[HEARTBEAT + node] = _BEAT, drive, 0
            self._table[EMERGENCY + node] = _EMCY, drive, 0
        for imu, node in enumerate(imus):
            first = 1 << LEGS + imu
            self._table[HEARTBEAT + node] = _BEAT, LEGS + imu, 0
            self._table[EMERGENCY + node] = _EMCY, -1, 0
            self._table[TPDO + node] = _IMU_FD if fd else _GYRO, imu, first
            if not fd:
                self._table[TPDO + 0x100 + node] = _ACCEL, imu, first << IMU_COUNT
                self._table[TPDO + 0x200 + node] = _MAGNETO, imu, 0
        # Buses that hand back what this side has sent, and answers to SDO requests that came too late.
        for own in (NMT, SYNC, HEARTBEAT + settings.controller.node, *(RPDO + node for node in drives)):
            self._table[own] = _OTHER, 0, 0
        for node in (*drives, *imus):
            self._table[SDO_ANSWER + node] = self._table[SDO_REQUEST + node] = _OTHER, 0, 0
        self._fd = fd
        self.all_frames = (1 << LEGS + IMU_COUNT * (1 if fd else 2)) - 1
        self.statuswords, self.velocities, self.error_codes = [0] * LEGS, [0] * LEGS, [0] * LEGS
        self.nmt, self.heard_ns = [-1] * (LEGS + IMU_COUNT), [0] * (LEGS + IMU_COUNT)
        self.awaited, self.received, self.refused, self.answered = self.all_frames, self.all_frames, 0, False
        self.sample_ns, self.sequence = [0] * IMU_COUNT, [-1] * IMU_COUNT
        self.truth: tuple[float, ...] = (float("nan"),) * 13
        self.now_ns, self._sync, self._syncs = 0, 0, 0
        self._sample_at = [0] * IMU_COUNT
        self._sample_sync = [0] * IMU_COUNT
        self._stamps, self._counters = [0] * IMU_COUNT, [0] * IMU_COUNT
        self._pending: list[tuple[bytes, int]] = [(b"", 0)] * IMU_COUNT
        self._magnetic_sync = [0] * IMU_COUNT
        self._raw = [bytearray(6 * IMU_COUNT) for _ in range(3)]
        for sensor in self._raw:
            sensor[:] = NO_VALUE.to_bytes(2, "little", signed=True) * (3 * IMU_COUNT)
        self._readings = [np.frombuffer(sensor, "<i2").reshape(IMU_COUNT, 3) for sensor in self._raw]
        signs = np.array(settings.imus.signs, np.float64)
        self._scales = [scale * signs for scale in settings.imus.scales]

    def begin(self, sync: int) -> None:
        """Answers to the SYNC with this counter are taken from now on."""
        self._sync, self.received = sync, 0
        self._syncs += 1

    def end(self) -> int:
        """Answers to this SYNC come too late from now on; returns a bit for each frame that has not come."""
        missing = self.all_frames & ~self.received
        self.received = self.all_frames
        return missing

    def refuse(self) -> None:
        """Count something that was no frame at all."""
        self.refused += 1

    def take(
        self, identifier: int, data: bytes | bytearray, remote: bool = False, error: bool = False, extended: bool = False
    ) -> bool:
        """Take a frame in; returns whether it was sound."""
        entry = self._table.get(identifier)
        if extended and identifier == TRUTH and len(data) == TRUTH_BYTES and not (remote or error):
            *truth, sync = _TRUTH.unpack_from(data)
            if sync == self._sync:
                self.truth = tuple(truth)
                return True
        if entry is None or remote or error or extended:
            self.refused += 1
            return False
        kind, node, bit = entry
        size = len(data)
        if kind <= _ACCEL:
            if self.received & bit:
                # A node that was given up for silent is waited for again.
                self.awaited |= bit
                self.refused += 1
                return False
            if kind == _DRIVE:
                sound = size == ANSWER.size
                if sound:
                    self.statuswords[node], self.velocities[node], self.error_codes[node] = ANSWER.unpack_from(data)
                    self.heard_ns[node] = self.now_ns
            elif kind == _IMU_FD:
                sound = size == FD_BYTES and self._take_fd(node, data)
            elif kind == _GYRO:
                sound = size == 8 and self._take_gyroscope(node, data)
            else:
                sound = size == 8 and self._take_accelerometer(node, data)
            if sound:
                self.received |= bit
                self.awaited |= bit
        elif kind == _MAGNETO:
            sound = size == 8 and self._take_magnetometer(node, data)
        elif kind == _BEAT:
            sound = size == 1 and self._take_heartbeat(node, data)
        elif kind == _EMCY:
            sound = size == 8
            if sound and node >= 0:
                self.error_codes[node] = _CODE.unpack_from(data)[0]
        else:
            return True
        if not sound:
            self.refused += 1
        return sound

    def _take_fd(self, imu: int, data: bytes | bytearray) -> bool:
        counter, stamp, sync = _FD_TAIL.unpack_from(data, _TAIL_AT)
        if sync != self._sync:
            return False
        at = 6 * imu
        for sensor, raw in enumerate(self._raw):
            raw[at : at + 6] = data[6 * sensor : 6 * sensor + 6]
        self._count(imu, counter, 1 << 32, stamp, 1 << 32, 1000)
        return True

    def _take_gyroscope(self, imu: int, data: bytes | bytearray) -> bool:
        counter, sync = _CLASSIC_TAIL.unpack_from(data, 6)
        if sync != self._sync:
            return False
        self._pending[imu] = bytes(data[:6]), counter
        return True

    def _take_accelerometer(self, imu: int, data: bytes | bytearray) -> bool:
        if not self.received & 1 << LEGS + imu:
            return False
        at = 6 * imu
        self._raw[0][at : at + 6], counter = self._pending[imu]
        self._raw[1][at : at + 6] = data[:6]
        self._count(imu, counter, 1 << 8, _STAMP.unpack_from(data, 6)[0], 1 << 16, 10_000)
        return True

    def _take_magnetometer(self, imu: int, data: bytes | bytearray) -> bool:
        # Taken a SYNC late, too: it is sampled so seldom that nothing waits for it.
        sync = data[6]
        if sync == self._magnetic_sync[imu] or (self._sync - sync) % SYNC_OVERFLOW > 1:
            return False
        self._magnetic_sync[imu] = sync
        self._raw[2][6 * imu : 6 * imu + 6] = data[:6]
        return True

    def _take_heartbeat(self, node: int, data: bytes | bytearray) -> bool:
        state = data[0]
        if state not in (BOOT_UP, STOPPED, OPERATIONAL, IS_PRE_OPERATIONAL):
            return False
        self.nmt[node], self.heard_ns[node] = state, self.now_ns
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
        """Write the last readings (3, 7, 3) [rad/s, m/s^2, uT], NaN where there is none."""
        for sensor, readings in enumerate(self._readings):
            np.multiply(readings, self._scales[sensor], out=measurement[sensor])
            measurement[sensor][readings == NO_VALUE] = np.nan


def raw_readings(measurement: Record, scales: NDArray[np.float64]) -> NDArray[np.int16]:
    """Readings (3, 7, 3) in LSB of 16 bits, cut at the ends of the range; `NO_VALUE` where there is none.

    Args:
        measurement: (3, 7, 3) [rad/s, m/s^2, uT].
        scales: (3, 7, 3) of an LSB, with the axes' signs.
    """
    lsb = np.clip(np.rint(measurement / scales), NO_VALUE + 1, -NO_VALUE - 1)
    return np.where(np.isfinite(lsb), lsb, NO_VALUE).astype("<i2")


def sensor_scales(settings: CanopenSettings) -> NDArray[np.float64]:
    """Of an LSB of each axis (3, 7, 3) [rad/s, m/s^2, uT], with its sign."""
    return np.multiply.outer(settings.imus.scales, np.array(settings.imus.signs, np.float64))


def drive_scales(settings: CanopenSettings) -> Sequence[float]:
    """Counts/s per m/s of each drive, with its sign."""
    return [sign * settings.drives.counts_per_metre for sign in settings.drives.signs]
