"""What is on the bus: the frames' identifiers and data, and the nodes' objects and PDOs behind them.

An IMU's synchronous PDOs carry the counter of the SYNC (object 1019h) that they answer. So a late answer to an earlier SYNC
cannot be mistaken for the answer to this one. The sample counter beside it stays the same when the IMU repeats a sample.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from hil.rigs.canopen.settings import FD_BYTES, MAGNETOMETER_INTERVAL
from plant.compiled import Record
from plant.pose import Array


class CobId(IntEnum):
    """Identifiers of CANopen's predefined connection set; all but NMT and SYNC plus the node id. TPDOs are 100h apart."""

    NMT = 0
    SYNC = 0x80
    EMERGENCY = 0x80
    TPDO = 0x180
    RPDO = 0x200
    SDO_ANSWER = 0x580
    SDO_REQUEST = 0x600
    HEARTBEAT = 0x700


class NmtCommand(IntEnum):
    """Commands of the network management."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NodeState(IntEnum):
    """A node's state in its heartbeat."""

    BOOT_UP = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


SYNC_OVERFLOW = 240
"""The SYNC counter counts from 1 to this value."""

NO_VALUE = -32768
"""Raw reading of an axis without a value."""

TRUTH_ID = 0x1F470001
"""Extended identifier of the frame with an emulated rig's truth, on CAN FD; no hardware sends it."""

COMMAND, ANSWER, POSITION = struct.Struct("<Hi"), struct.Struct("<HiH"), struct.Struct("<iI")
"""A drive's PDOs: controlword and target [counts/s or counts]; statusword, velocity [counts/s] and error code;
position [counts] and digital inputs."""

HOME_INPUT = 1 << 2
"""The home switch among a drive's digital inputs (CiA 402, object 60FDh)."""

CLASSIC_TAIL, FD_TAIL = struct.Struct("<BB"), struct.Struct("<IIB")
"""Of an IMU's PDOs, behind the axes: sample counter and SYNC counter on classic CAN; sample counter, time [us] and SYNC counter
on CAN FD."""

TRUTH = struct.Struct("<13fB11x")
"""Position, quaternion and lengths, and the SYNC counter."""


class Object(IntEnum):
    """Index of an object: those of every node (CiA 301), and those of a drive (CiA 402)."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    DEVICE_NAME = 0x1008
    CONSUMER_HEARTBEAT = 0x1016
    PRODUCER_HEARTBEAT = 0x1017
    IDENTITY = 0x1018
    SYNC_OVERFLOW = 0x1019
    ABORT_CONNECTION_OPTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    DISABLE_OPERATION_OPTION = 0x605C
    FAULT_REACTION_OPTION = 0x605E
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION_ACTUAL = 0x6064
    FOLLOWING_WINDOW = 0x6065
    VELOCITY_ACTUAL = 0x606C
    TARGET_POSITION = 0x607A
    MAX_MOTOR_SPEED = 0x6080
    QUICK_STOP_DECELERATION = 0x6085
    INTERPOLATION_PERIOD = 0x60C2
    DIGITAL_INPUTS = 0x60FD
    TARGET_VELOCITY = 0x60FF


class Parameter(IntEnum):
    """Sub-index of a PDO's communication parameter."""

    COB_ID = 1
    TRANSMISSION_TYPE = 2
    EVENT_TIMER = 5
    SYNC_START_VALUE = 6


INVALID_COB_ID = 1 << 31
"""Bit of a PDO's COB-ID that switches it off."""


@dataclass(frozen=True)
class Pdo:
    """A PDO as it is configured over SDO."""

    communication: int  # index of its communication parameters
    mapping: int  # index of its mapping parameters
    cob_id: int  # without the node id
    transmission_type: int  # number of SYNCs per transmission
    objects: tuple[int, ...]  # each: index (16 bits), sub-index (8), length in bits (8)


_GYROSCOPE = (0x20000110, 0x20000210, 0x20000310)
_ACCELEROMETER = (0x20010110, 0x20010210, 0x20010310)
_MAGNETOMETER = (0x20020110, 0x20020210, 0x20020310)
_SAMPLE_COUNTER, _LOW_SAMPLE_COUNTER, _SYNC_COUNTER = 0x20100020, 0x20110008, 0x20120008
_MICROSECONDS, _TENS_OF_MICROSECONDS = 0x20130020, 0x20140010

COMMAND_PDO = Pdo(0x1400, 0x1600, CobId.RPDO, 1, (0x60400010, 0x60FF0020))
TARGET_PDO = Pdo(0x1400, 0x1600, CobId.RPDO, 1, (0x60400010, 0x607A0020))
"""The same with a position instead of a velocity."""

ANSWER_PDO = Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (0x60410010, 0x606C0020, 0x603F0010))
POSITION_PDO = Pdo(0x1801, 0x1A01, CobId.TPDO + 0x100, 1, (0x60640020, 0x60FD0020))
"""What an encoder reads; mapped only where the loop wants to know."""

MAGNETOMETER_PDO = Pdo(0x1802, 0x1A02, CobId.TPDO + 0x200, MAGNETOMETER_INTERVAL, (*_MAGNETOMETER, _SYNC_COUNTER))
_IMU_PDOS_CLASSIC = (
    Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (*_GYROSCOPE, _LOW_SAMPLE_COUNTER, _SYNC_COUNTER)),
    Pdo(0x1801, 0x1A01, CobId.TPDO + 0x100, 1, (*_ACCELEROMETER, _TENS_OF_MICROSECONDS)),
    MAGNETOMETER_PDO,
)
"""An IMU's on classic CAN. The sample counter wraps at 256, the time stamp, in units of 10 us, at 655.36 ms; the decoder finds
the number of wraps by its own clock."""

_ALL_AXES = (*_GYROSCOPE, *_ACCELEROMETER, *_MAGNETOMETER)
_IMU_PDOS_FD = (Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (*_ALL_AXES, _SAMPLE_COUNTER, _MICROSECONDS, _SYNC_COUNTER)),)
"""An IMU's on CAN FD: 27 bytes in a frame of 32. The time stamp in us wraps after 71.6 minutes."""


def imu_pdos(fd: bool) -> tuple[Pdo, ...]:
    """The PDOs of an IMU."""
    return _IMU_PDOS_FD if fd else _IMU_PDOS_CLASSIC


def int32(counts: int) -> int:
    """A count as an object of 32 bits has it, which wraps."""
    return (counts + 2**31) % 2**32 - 2**31


def new_message(identifier: int, data: bytes = b"", **flags: Any) -> can.Message:
    """A frame with an 11-bit identifier, and further arguments of `can.Message`."""
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **flags})


def pack_imu(
    raw: NDArray[np.int16], sequence: int, sample_ns: int, sync: int, fd: bool, magnetometer: bool
) -> list[tuple[int, bytes]]:
    """The frames of an IMU's sample: identifier without the node id, and data.

    Args:
        raw: (3, 3) readings of gyroscope, accelerometer and magnetometer in LSB.
        sequence, sample_ns: number and time [ns] of the sample.
        sync: counter of the SYNC.
        fd: whether the bus is CAN FD.
        magnetometer: whether it is the magnetometer's turn, on classic CAN.
    """
    if fd:
        tail = FD_TAIL.pack(sequence & 0xFFFFFFFF, sample_ns // 1000 & 0xFFFFFFFF, sync)
        return [(CobId.TPDO, (raw.tobytes() + tail).ljust(FD_BYTES, b"\0"))]
    frames = [
        (CobId.TPDO, raw[0].tobytes() + CLASSIC_TAIL.pack(sequence & 0xFF, sync)),
        (CobId.TPDO + 0x100, raw[1].tobytes() + (sample_ns // 10_000 & 0xFFFF).to_bytes(2, "little")),
    ]
    if magnetometer:
        frames.append((CobId.TPDO + 0x200, raw[2].tobytes() + bytes((sync, 0))))
    return frames


def truth_message(truth: Array, sync: int) -> can.Message:
    """The frame with position [m], quaternion and lengths [m] of the plant's truth at this SYNC."""
    return new_message(TRUTH_ID, TRUTH.pack(*truth[:13], sync), is_extended_id=True, is_fd=True, bitrate_switch=True)


def raw_readings(measurement: Record, scales: NDArray[np.float64]) -> NDArray[np.int16]:
    """Readings (3, 7, 3) [rad/s, m/s^2, uT] in LSB of 16 bits, limited to the range; `NO_VALUE` for NaN.

    The `scales` (3, 7, 3) are those of an LSB, with the axes' signs.
    """
    lsb = np.clip(np.rint(measurement / scales), NO_VALUE + 1, -NO_VALUE - 1)
    return np.where(np.isfinite(lsb), lsb, NO_VALUE).astype("<i2")
