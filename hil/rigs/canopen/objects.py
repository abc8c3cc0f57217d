"""The nodes' objects: indices in the object dictionary, and the PDOs with the objects that are mapped to them."""

from dataclasses import dataclass
from enum import IntEnum

from hil.rigs.canopen.frames import CobId
from hil.rigs.canopen.settings import MAGNETOMETER_INTERVAL


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
    VELOCITY_ACTUAL = 0x606C
    MAX_MOTOR_SPEED = 0x6080
    QUICK_STOP_DECELERATION = 0x6085
    INTERPOLATION_PERIOD = 0x60C2
    TARGET_VELOCITY = 0x60FF


COB_ID, TRANSMISSION_TYPE, EVENT_TIMER, SYNC_START_VALUE = 1, 2, 5, 6
"""Sub-indices of a PDO's communication parameters."""

INVALID_COB_ID = 1 << 31
"""Bit of a PDO's COB-ID that switches it off."""


@dataclass(frozen=True)
class Pdo:
    """A PDO as it is configured over SDO.

    Attributes:
        communication, mapping: indices of its communication and mapping parameters.
        cob_id: without the node id.
        transmission_type: number of SYNCs per transmission.
        objects: the mapped objects: index (16 bits), sub-index (8), length in bits (8).
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

COMMAND_PDO = Pdo(0x1400, 0x1600, CobId.RPDO, 1, (0x60400010, 0x60FF0020))
ANSWER_PDO = Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (0x60410010, 0x606C0020, 0x603F0010))
DRIVE_PDOS = (COMMAND_PDO, ANSWER_PDO)

MAGNETOMETER_PDO = Pdo(0x1802, 0x1A02, CobId.TPDO + 0x200, MAGNETOMETER_INTERVAL, (*_MAGNETOMETER, _SYNC_COUNTER))
IMU_PDOS_CLASSIC = (
    Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (*_GYROSCOPE, _LOW_SAMPLE_COUNTER, _SYNC_COUNTER)),
    Pdo(0x1801, 0x1A01, CobId.TPDO + 0x100, 1, (*_ACCELEROMETER, _TENS_OF_MICROSECONDS)),
    MAGNETOMETER_PDO,
)
"""An IMU's on classic CAN. The sample counter wraps at 256, the time stamp, in units of 10 us, at 655.36 ms; the decoder finds
the number of wraps by its own clock."""

_ALL_AXES = (*_GYROSCOPE, *_ACCELEROMETER, *_MAGNETOMETER)
IMU_PDOS_FD = (Pdo(0x1800, 0x1A00, CobId.TPDO, 1, (*_ALL_AXES, _SAMPLE_COUNTER, _MICROSECONDS, _SYNC_COUNTER)),)
"""An IMU's on CAN FD: 27 bytes in a frame of 32. The time stamp in us wraps after 71.6 minutes."""


def imu_pdos(fd: bool) -> tuple[Pdo, ...]:
    """The PDOs of an IMU."""
    return IMU_PDOS_FD if fd else IMU_PDOS_CLASSIC
