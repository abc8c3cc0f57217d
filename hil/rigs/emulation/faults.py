"""Faults for an emulated rig: what can go wrong with IMUs, drives, the bus and the payload, by schedule and by seed."""

from enum import IntEnum
from math import inf, radians

import numpy as np

from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError, UnknownNameError
from plant.mechanism import LEGS


class FaultKind(IntEnum):
    """A kind of fault.

    Attributes:
        count: number of IMUs or drives of which one has the fault; 0 if it concerns none of them.
        default: size without another one, in the unit that the text gives.
        scale: factor from that unit to the kernels' (SI units, ns).
        text: what happens.
    """

    count: int
    default: float
    scale: float
    text: str

    def __new__(cls, count: int, default: float, scale: float, text: str) -> "FaultKind":
        """The next member."""
        kind = int.__new__(cls, len(cls.__members__) + 1)
        kind._value_ = len(cls.__members__) + 1
        kind.count, kind.default, kind.scale, kind.text = count, default, scale, text
        return kind

    @property
    def label(self) -> str:
        """The kind's name on the command line, such as imu-frozen."""
        return self.name.lower().replace("_", "-")

    IMU_FROZEN = IMU_COUNT, 0.0, 1.0, "the IMU repeats its last sample as if it were new"
    IMU_DEAD = IMU_COUNT, 0.0, 1.0, "the IMU sends nothing any more"
    IMU_NOISY = IMU_COUNT, 20.0, 1.0, "noise of this size [deg/s RMS], and a tenth of it [m/s2 RMS]"
    IMU_BIASED = IMU_COUNT, 2.0, radians(1.0), "the IMU is turned on its leg by this angle [deg]"
    IMU_SWAPPED = IMU_COUNT, 0.0, 1.0, "the IMU and the one of this number have changed places"
    DRIVE_FAULTS = LEGS, 0x7500, 1.0, "the drive reports this fault code and stops"
    DRIVE_UNPOWERED = LEGS, 0.0, 1.0, "the drive loses its power, and its brake closes"
    DRIVE_IGNORES = LEGS, 0.0, 1.0, "the drive keeps following the command that it had"
    DRIVE_STUCK = LEGS, 0.0, 1.0, "the drive stands still, but reports that it follows"
    DRIVE_RUNS_AWAY = LEGS, 0.2, 1.0, "the drive moves at this speed, whatever its command [m/s]"
    BUS_DROPS = 0, 0.01, 1.0, "packets are lost with this probability, each way"
    BUS_DELAYS = 0, 5.0, 1e6, "packets arrive later by this time, each way [ms]"
    BUS_REORDERS = 0, 0.1, 1.0, "packets arrive after the next one with this probability"
    BUS_REPEATS = 0, 0.1, 1.0, "packets arrive twice with this probability"
    BUS_CORRUPTS = 0, 0.1, 1.0, "one bit of a packet is inverted with this probability"
    BUS_DOWN = 0, 0.0, 1.0, "no packet arrives"
    PAYLOAD_JUMPS = 0, 5.0, 1.0, "the payload gains this mass [kg]"


FAULT = record_dtype(
    kind=np.int64,
    index=np.int64,  # of the IMU or drive
    begin_ns=np.int64,  # since the drives were first enabled; below 0: from the start
    end_ns=np.int64,
    size=np.float64,
)
"""A fault."""

MOST_FAULTS = 32
_FOREVER = np.iinfo(np.int64).max


def fault(text: str) -> Record:
    """A fault (dtype `FAULT`) from its text: the kind, then index, `at` and `for` [s] and `size` where they matter, such as
    `imu-biased:3,at=5,for=2,size=2`. Without `at` the fault is there from the start.

    Raises:
        UnknownNameError: there is no such kind.
        InputError: an index or a number is out of range.
    """
    head, *options = text.split(",")
    name, _, index = head.partition(":")
    kinds = {kind.label: kind for kind in FaultKind}
    if name not in kinds:
        raise UnknownNameError(f"there is no fault {name!r}; there are {', '.join(kinds)}")
    kind = kinds[name]
    if kind.count and not (index.isdecimal() and int(index) < kind.count):
        raise InputError(f"the fault {text!r} needs the number of an IMU or drive, 0 to {kind.count - 1}: such as {name}:0")
    if not kind.count and index:
        raise InputError(f"the fault {text!r} has a number, but {name} takes none")
    values = {"at": -1.0, "for": inf, "size": kind.default}
    for option in options:
        key, _, value = option.partition("=")
        try:
            if key not in values:
                raise ValueError
            values[key] = float(value)
        except ValueError:
            raise InputError(f"{option!r} in the fault {text!r} is none of at=SECONDS, for=SECONDS, size=NUMBER") from None
    if not (np.isfinite(values["size"]) and np.isfinite(values["at"]) and values["for"] > 0.0):
        raise InputError(f"the fault {text!r} has a wrong number: size and at must be finite, for must be positive")
    made: Record = np.zeros((), FAULT)
    made["kind"], made["index"], made["size"] = kind, int(index or 0), values["size"] * kind.scale
    made["begin_ns"] = -1 if values["at"] < 0.0 else round(1e9 * values["at"])
    ends = made["begin_ns"] + 1e9 * values["for"]
    made["end_ns"] = _FOREVER if ends >= _FOREVER else round(ends)
    return made


@kernel
def is_active(f: Record, enabled_ns: int, now_ns: int) -> bool:
    """Whether a fault is there now; `enabled_ns` is when the drives were first enabled, negative before."""
    if f.begin_ns < 0:
        return bool(enabled_ns < 0 or now_ns - enabled_ns < f.end_ns)
    return bool(enabled_ns >= 0 and f.begin_ns <= now_ns - enabled_ns < f.end_ns)


@kernel
def find_fault(rig: Record, kind: int, index: int) -> int:
    """Place of the latest active fault of this kind and index in a rig (dtype `hil.rigs.emulation.drives.EMULATED`), or -1."""
    place = -1
    for i in range(rig.faults):
        f = rig.fault[i]
        if f.kind == kind and f.index == index and is_active(f, rig.enabled_ns, rig.time_ns):
            place = i
    return place


@kernel
def disturb(rig: Record, now_ns: int) -> tuple[int, int, bool, bool]:
    """The effect of the bus's faults on a message of a rig (dtype `hil.rigs.emulation.drives.EMULATED`): the number of copies
    that arrive, their delay [ns], whether they are damaged, and whether they arrive after the next message.
    """
    copies, delay, damaged, held = 1, 0, False, False
    for i in range(rig.faults):
        f = rig.fault[i]
        if not is_active(f, rig.enabled_ns, now_ns):
            continue
        if f.kind == FaultKind.BUS_DOWN or (f.kind == FaultKind.BUS_DROPS and draw(rig.random) < f.size):
            copies = 0
        elif f.kind == FaultKind.BUS_DELAYS:
            delay += int(f.size)
        elif f.kind == FaultKind.BUS_REPEATS and draw(rig.random) < f.size:
            copies *= 2
        elif f.kind == FaultKind.BUS_CORRUPTS and draw(rig.random) < f.size:
            damaged = True
        elif f.kind == FaultKind.BUS_REORDERS and draw(rig.random) < f.size:
            held = True
    return copies, delay, damaged, held


@kernel
def draw(random: Record) -> float:
    """The next number in [0, 1) of the generator splitmix64, whose state (uint64, shape (1,)) advances."""
    random[0] += np.uint64(0x9E3779B97F4A7C15)
    z = random[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) / 9007199254740992.0


@kernel
def draw_normal(random: Record) -> float:
    """A number of the standard normal distribution (Box and Muller 1958)."""
    radius = np.sqrt(-2.0 * np.log(1.0 - draw(random)))
    return float(radius * np.cos(2.0 * np.pi * draw(random)))
