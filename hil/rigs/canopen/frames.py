"""Frames of the CANopen rig: identifiers, node commands and states, and how the PDOs' data are packed.

An IMU's synchronous PDOs carry the counter of the SYNC (object 1019h) that they answer. So a late answer to an earlier SYNC
cannot be mistaken for the answer to this one. The sample counter beside it stays the same when the IMU repeats a sample.
"""

import struct
from enum import IntEnum
from typing import Any

import can
import numpy as np
from numpy.typing import NDArray

from hil.rigs.canopen.settings import FD_BYTES
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

COMMAND, ANSWER = struct.Struct("<Hi"), struct.Struct("<HiH")
"""A drive's PDOs: controlword and target velocity [counts/s]; statusword, velocity [counts/s] and error code."""

CLASSIC_TAIL, FD_TAIL, CODE, STAMP = (struct.Struct(f"<{each}") for each in ("BB", "IIB", "H", "H"))
"""Of an IMU's PDOs, behind the axes: sample counter and SYNC counter on classic CAN; sample counter, time [us] and SYNC counter
on CAN FD; the error code of an emergency; the time stamp on classic CAN [10 us]."""

TRUTH = struct.Struct("<13fB")
"""Position, quaternion and lengths, and the SYNC counter."""

TRUTH_BYTES = 64


def new_message(identifier: int, data: bytes = b"", **flags: Any) -> can.Message:
    """A frame with an 11-bit identifier, and further arguments of `can.Message`."""
    return can.Message(arbitration_id=identifier, data=data, **{"is_extended_id": False, **flags})


def pack_imu(
    raw: NDArray[np.int16], sequence: int, sample_ns: int, sync: int, fd: bool, magnetometer: bool
) -> list[tuple[int, bytes]]:
    """The frames of an IMU's sample: identifier without the node id, and data.

    Args:
        raw: (3, 3) readings of gyroscope, accelerometer and magnetometer in LSB.
        sequence: number of the sample.
        sample_ns: its time [ns].
        sync: counter of the SYNC.
        fd: whether the bus is CAN FD.
        magnetometer: whether it is the magnetometer's turn, on classic CAN.
    """
    if fd:
        tail = FD_TAIL.pack(sequence & 0xFFFFFFFF, sample_ns // 1000 & 0xFFFFFFFF, sync)
        return [(CobId.TPDO, (raw.tobytes() + tail).ljust(FD_BYTES, b"\0"))]
    frames = [
        (CobId.TPDO, raw[0].tobytes() + CLASSIC_TAIL.pack(sequence & 0xFF, sync)),
        (CobId.TPDO + 0x100, raw[1].tobytes() + STAMP.pack(sample_ns // 10_000 & 0xFFFF)),
    ]
    if magnetometer:
        frames.append((CobId.TPDO + 0x200, raw[2].tobytes() + bytes((sync, 0))))
    return frames


def pack_truth(truth: Array, sync: int) -> bytes:
    """Position [m], quaternion and lengths [m] of the plant's truth at this SYNC."""
    return TRUTH.pack(*truth[:13], sync).ljust(TRUTH_BYTES, b"\0")


def raw_readings(measurement: Record, scales: NDArray[np.float64]) -> NDArray[np.int16]:
    """Readings (3, 7, 3) in LSB of 16 bits, limited to the range; `NO_VALUE` for NaN.

    Args:
        measurement: (3, 7, 3) [rad/s, m/s^2, uT].
        scales: (3, 7, 3) of an LSB, with the axes' signs.
    """
    lsb = np.clip(np.rint(measurement / scales), NO_VALUE + 1, -NO_VALUE - 1)
    return np.where(np.isfinite(lsb), lsb, NO_VALUE).astype("<i2")
