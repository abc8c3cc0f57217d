"""The datagrams of the UDP rig, version 1: one in each direction per cycle, and a hand-shake before. docs/rigs.md and
`hil/rigs/udp/gough_rig.h` describe them for firmware.

Little-endian, every field aligned to its size, SI units. A datagram ends with the CRC-32 (IEEE 802.3, as in zlib) of all that
comes before it. What is of another length, magic number, version, kind or session, or has a wrong CRC, is refused.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.truth import TRUTH_SIZE

MAGIC = 0x48475547
"""The bytes "GUGH"."""

VERSION = 1
HELLO, WELCOME, COMMAND, MEASUREMENT = range(1, 5)

_HEAD = [
    ("magic", np.uint32),
    ("version", np.uint16),
    ("kind", np.uint16),
    ("session", np.uint32),
    ("sequence", np.uint32),
    ("time_ns", np.int64),
]

HELLO_DATAGRAM = np.dtype([*_HEAD, ("period_us", np.uint32), ("reserved", np.uint32), ("crc", np.uint32)])
"""From the controller: begin a session, with its period [us]."""

WELCOME_DATAGRAM = np.dtype(
    [
        *_HEAD,
        ("watchdog_us", np.uint32),
        ("truthful", np.uint32),
        ("name", np.uint8, 32),
        ("firmware", np.uint8, 16),
        ("crc", np.uint32),
    ]
)
"""From the rig: who it is, after how long without a command its drives stop [us], and whether it tells the truth, as emulated
ones do.
"""

COMMAND_DATAGRAM = np.dtype(
    [
        *_HEAD,
        ("request", np.uint32),
        ("reset", np.uint32),
        ("velocity", np.float32, LEGS),
        ("reserved", np.uint32),
        ("crc", np.uint32),
    ]
)
"""From the controller, once per cycle: what is asked of the drives (0 brake, 1 follow, 2 quick stop), whether faults are to be
reset, and the velocities [m/s]. The rig applies it, samples its IMUs, and answers with the same sequence number."""

MEASUREMENT_DATAGRAM = np.dtype(
    [
        *_HEAD,
        ("sample_ns", np.int64, IMU_COUNT),
        ("sample_number", np.uint32, IMU_COUNT),
        ("refused", np.uint32),
        ("drive", np.uint8, LEGS),
        ("reserved", np.uint8, 2),
        ("code", np.uint16, LEGS),
        ("velocity", np.float32, LEGS),
        ("measurement", np.float32, (3, IMU_COUNT, 3)),
        ("crc", np.uint32),
    ]
)
"""From the rig, once per command: the time on its own clock [ns], of each IMU when the sample was taken and its number; how
many datagrams it has refused; of each drive its state (0 following, 1 ready, 2 off, 3 quick stop, 4 fault), its fault code and
the velocity that it was really given [m/s]; and the raw IMU data [rad/s, m/s^2, uT], NaN where there is none."""

TRUTH_DATAGRAM = np.dtype([("truth", np.float64, TRUTH_SIZE), ("reserved", np.uint32), ("crc", np.uint32)])
"""What an emulated rig appends to a measurement."""

LONGEST = MEASUREMENT_DATAGRAM.itemsize + TRUTH_DATAGRAM.itemsize

Bytes = NDArray[np.uint8]


def _crc_table() -> NDArray[np.uint32]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(0xEDB88320), table >> 1)
    return table.astype(np.uint32)


_CRC_TABLE = _crc_table()


@kernel
def crc32(data: Bytes, length: int) -> int:
    """The CRC-32 of the first `length` bytes."""
    crc = np.uint32(0xFFFFFFFF)
    for i in range(length):
        crc = np.uint32(_CRC_TABLE[(crc ^ np.uint32(data[i])) & np.uint32(0xFF)] ^ (crc >> np.uint32(8)))
    return int(crc ^ np.uint32(0xFFFFFFFF))


@kernel
def is_sound(data: Bytes, datagram: Record, length: int, expected: int, kind: int) -> bool:
    """Whether so many received bytes are a datagram of this kind; `datagram` is a view of `data`."""
    return bool(
        length == expected
        and datagram.magic == MAGIC
        and datagram.version == VERSION
        and datagram.kind == kind
        and datagram.crc == crc32(data, expected - 4)
    )


def encode(dtype: np.dtype[Any], **fields: object) -> bytes:
    """A whole datagram with head and CRC, for what is not sent in every cycle."""
    datagram: Record = np.zeros(1, dtype)
    datagram["magic"], datagram["version"] = MAGIC, VERSION
    for name, value in fields.items():
        datagram[name] = value
    content: Bytes = datagram.view(np.uint8)
    datagram["crc"] = crc32(content, dtype.itemsize - 4)
    return content.tobytes()


def decode(dtype: np.dtype[Any], kind: int, content: bytes) -> Record | None:
    """The datagram, or None if it is none of this kind."""
    if len(content) != dtype.itemsize:
        return None
    data = np.frombuffer(content, np.uint8)
    datagram: Record = data.view(dtype)[0]
    sound = datagram["magic"] == MAGIC and datagram["version"] == VERSION and datagram["kind"] == kind
    return datagram if sound and datagram["crc"] == crc32(data, len(content) - 4) else None
