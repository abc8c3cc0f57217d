"""Datagrams over UDP: how any of them is packed and checked, and those of the UDP rig.

The UDP rig's are one datagram in each direction per cycle, and a handshake before. docs/rigs.md and `hil/rigs/udp/gough_rig.h`
describe them for firmware: little-endian, every field aligned to its size, SI units. A datagram ends with the CRC-32 (IEEE
802.3, as in zlib) of all bytes before it. One with another length, magic number, version, kind or session, or with a wrong CRC,
is refused.

A session has the version of its hello: 1, or 2 with the lengths that encoders read, or 3 with an IMU on the base besides.
"""

import zlib
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.truth import TRUTH_SIZE

MAGIC = 0x48475547
"""The bytes "GUGH"."""

VERSION, WITH_LENGTHS, WITH_BASE_IMU = VERSIONS = 1, 2, 3
"""The version of a session without lengths, of one with them, and of one with an IMU on the base besides."""


class DatagramKind(IntEnum):
    """The kinds of the UDP rig's datagrams."""

    HELLO = 1
    WELCOME = 2
    COMMAND = 3
    MEASUREMENT = 4


_HEAD = [("magic", "u4"), ("version", "u2"), ("kind", "u2"), ("session", "u4"), ("sequence", "u4"), ("time_ns", "i8")]

HELLO_DATAGRAM = np.dtype([*_HEAD, ("period_us", "u4"), ("reserved", "u4"), ("crc", "u4")])
"""From the controller: begin a session with commands at this period [us]."""

WELCOME_DATAGRAM = np.dtype(
    [*_HEAD, ("watchdog_us", "u4"), ("truthful", "u4"), ("name", "u1", 32), ("firmware", "u1", 16), ("crc", "u4")]
)
"""From the rig: its name and firmware, the time without a command after which its drives stop [us], and whether a truth follows
its measurements, as an emulated rig's does.
"""

COMMAND_DATAGRAM = np.dtype(
    [*_HEAD, ("request", "u4"), ("reset", "u4"), ("velocity", "f4", LEGS), ("reserved", "u4"), ("crc", "u4")]
)
"""From the controller, once per cycle: the request to the drives (0 brake, 1 follow, 2 quick stop), whether to reset faults,
and the velocities [m/s]. The rig applies it, samples its IMUs, and answers with the same sequence number."""

MEASUREMENT_DATAGRAM = np.dtype(
    [
        *_HEAD,
        ("sample_ns", "i8", IMU_COUNT),
        ("sample_number", "u4", IMU_COUNT),
        ("refused", "u4"),
        ("drive", "u1", LEGS),
        ("reserved", "u1", 2),
        ("code", "u2", LEGS),
        ("velocity", "f4", LEGS),
        ("measurement", "f4", (3, IMU_COUNT, 3)),
        ("crc", "u4"),
    ]
)
"""From the rig, once per command: the time on its own clock [ns]; the time and number of each IMU's sample; how many datagrams
it has refused; each drive's state (0 following, 1 ready, 2 not ready, 3 quick stop, 4 fault), fault code and velocity after
limits [m/s]; and the raw IMU data [rad/s, m/s^2, uT], NaN without an IMU."""

LENGTHS_DATAGRAM = np.dtype(
    [("length", "f8", LEGS), ("rate", "f4", LEGS), ("home", "i1", LEGS), ("reserved", "u1", 2), ("crc", "u4")]
)
"""From version 2 on, a measurement goes on with what encoders read: lengths [m] and their rates [m/s], NaN without an encoder,
and the home switches: 1 beyond the switch, 0 before it, -1 without one."""

BASE_IMU_DATAGRAM = np.dtype([("sample_ns", "i8"), ("sample_number", "u4"), ("measurement", "f4", (2, 3)), ("crc", "u4")])
"""In version 3, it then goes on with the IMU on the base: time and number of its sample, and its raw data [rad/s, m/s^2], NaN
without one."""

TRUTH_DATAGRAM = np.dtype([("truth", "f8", TRUTH_SIZE), ("reserved", "u4"), ("crc", "u4")])
"""An emulated rig appends it to all that."""

LONGEST = sum(
    each.itemsize for each in (MEASUREMENT_DATAGRAM, LENGTHS_DATAGRAM, BASE_IMU_DATAGRAM, TRUTH_DATAGRAM)
)  # fmt: skip


def version_for(lengths: bool, base_imu: bool) -> int:
    """The version of a session that tells so much."""
    return WITH_BASE_IMU if base_imu else WITH_LENGTHS if lengths else VERSION


Bytes = NDArray[np.uint8]


def encode(dtype: np.dtype[Any], **fields: object) -> bytes:
    """A datagram that ends with a field `crc`, by default with the UDP rig's magic number and version. For datagrams that are
    not sent in every cycle.
    """
    datagram: Record = np.zeros(1, dtype)
    for name, value in ({"magic": MAGIC, "version": VERSION} | fields).items():
        datagram[name] = value
    content: bytes = datagram.tobytes()[:-4]
    return content + zlib.crc32(content).to_bytes(4, "little")


def decode(dtype: np.dtype[Any], content: bytes, **fields: object) -> Record | None:
    """The datagram; None if its length or its CRC is wrong, or if magic number, version or one of the `fields` has another
    value.
    """
    if len(content) != dtype.itemsize:
        return None
    datagram: Record = np.frombuffer(content, dtype)[0]
    expected = {"magic": MAGIC, "version": VERSION} | fields
    valid = all(datagram[name] == value for name, value in expected.items())
    return datagram if valid and datagram["crc"] == zlib.crc32(content[:-4]) else None


# The CRC-32 of a byte, without the inversions at its start and end.
_CRC_TABLE = np.array([zlib.crc32(bytes((i ^ 0xFF,))) ^ 0xFF000000 for i in range(256)], np.uint32)


@kernel
def crc32(data: Bytes, length: int) -> int:
    """The CRC-32 of the first `length` bytes."""
    crc = np.uint32(0xFFFFFFFF)
    for i in range(length):
        crc = np.uint32(_CRC_TABLE[(crc ^ np.uint32(data[i])) & np.uint32(0xFF)] ^ (crc >> np.uint32(8)))
    return int(crc ^ np.uint32(0xFFFFFFFF))


@kernel
def is_valid(data: Bytes, datagram: Record, length: int, expected: int, kind: int, version: int) -> bool:
    """Whether `length` received bytes are a datagram of this kind and version with this `expected` length; `datagram` views
    `data`.
    """
    return bool(
        length == expected
        and datagram.magic == MAGIC
        and datagram.version == version
        and datagram.kind == kind
        and datagram.crc == crc32(data, expected - 4)
    )
