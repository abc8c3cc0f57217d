"""Faults for an emulated rig: what can go wrong with IMUs, drives, the bus and the load, by schedule and by seed."""

from dataclasses import dataclass
from math import inf, radians

import numpy as np

from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.errors import InputError, UnknownNameError
from plant.mechanism import LEGS

(
    IMU_FROZEN, IMU_DEAD, IMU_NOISY, IMU_BIASED, IMU_SWAPPED, DRIVE_FAULTS, DRIVE_UNPOWERED, DRIVE_IGNORES, DRIVE_RUNS_AWAY,
    BUS_DROPS, BUS_DELAYS, BUS_REORDERS, BUS_REPEATS, BUS_CORRUPTS, BUS_DOWN, PAYLOAD_JUMPS,
    DRIVE_STUCK,
) = range(1, 18)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of fault: its number, what its index counts up to (0 for none), and what its size is."""

    number: int
    count: int
    default: float
    scale: float
    text: str


KINDS = {
    "imu-frozen": Kind(IMU_FROZEN, IMU_COUNT, 0.0, 1.0, "the IMU repeats its last sample as if it were new"),
    "imu-dead": Kind(IMU_DEAD, IMU_COUNT, 0.0, 1.0, "the IMU sends nothing any more"),
    "imu-noisy": Kind(IMU_NOISY, IMU_COUNT, 20.0, 1.0, "noise of this size [deg/s RMS], and a tenth of it [m/s2 RMS]"),
    "imu-biased": Kind(IMU_BIASED, IMU_COUNT, 2.0, radians(1.0), "the IMU is turned on its leg by this angle [deg]"),
    "imu-swapped": Kind(IMU_SWAPPED, IMU_COUNT, 0.0, 1.0, "the IMU and that of this number have changed places"),
    "drive-faults": Kind(DRIVE_FAULTS, LEGS, 0x7500, 1.0, "the drive reports this fault code and stops"),
    "drive-unpowered": Kind(DRIVE_UNPOWERED, LEGS, 0.0, 1.0, "the drive loses its power, and its brake closes"),
    "drive-ignores": Kind(DRIVE_IGNORES, LEGS, 0.0, 1.0, "the drive goes on with the command that it had"),
    "drive-stuck": Kind(DRIVE_STUCK, LEGS, 0.0, 1.0, "the drive stands still, and says that it follows"),
    "drive-runs-away": Kind(DRIVE_RUNS_AWAY, LEGS, 0.2, 1.0, "the drive does this speed, whatever it is told [m/s]"),
    "bus-drops": Kind(BUS_DROPS, 0, 0.01, 1.0, "packets are lost with this probability, each way"),
    "bus-delays": Kind(BUS_DELAYS, 0, 5.0, 1e6, "packets come later by this, each way [ms]"),
    "bus-reorders": Kind(BUS_REORDERS, 0, 0.1, 1.0, "packets come after the next one with this probability"),
    "bus-repeats": Kind(BUS_REPEATS, 0, 0.1, 1.0, "packets come twice with this probability"),
    "bus-corrupts": Kind(BUS_CORRUPTS, 0, 0.1, 1.0, "a bit of a packet is turned with this probability"),
    "bus-down": Kind(BUS_DOWN, 0, 0.0, 1.0, "nothing comes through"),
    "payload-jumps": Kind(PAYLOAD_JUMPS, 0, 5.0, 1.0, "the payload gains this mass [kg]"),
}
"""By name. Sizes are scaled to SI units, delays to ns."""

FAULT = np.dtype(
    [("kind", np.int64), ("index", np.int64), ("begin_ns", np.int64), ("end_ns", np.int64), ("size", np.float64)], align=True
)
"""A fault: its kind, which IMU or drive, when it begins and ends [ns since the drives were first enabled], and its size. One
that begins below 0 is there from the start.
"""

MOST_FAULTS = 32
_FOREVER = np.iinfo(np.int64).max


def fault(text: str) -> Record:
    """A fault (dtype `FAULT`) as it is written: its kind, then index, `at` and `for` [s] and `size` where they matter, such as
    `imu-biased:3,at=5,for=2,size=2`; without `at` it is there from the start.

    Raises:
        UnknownNameError: no such kind.
        InputError: an index or a number that cannot be.
    """
    head, *options = text.split(",")
    name, _, index = head.partition(":")
    if name not in KINDS:
        raise UnknownNameError(f"there is no fault {name!r}; there are {', '.join(KINDS)}")
    kind = KINDS[name]
    if kind.count and not (index.isdecimal() and int(index) < kind.count):
        raise InputError(f"the fault {text!r} needs the number of an IMU or drive, 0 to {kind.count - 1}: such as {name}:0")
    if not kind.count and index:
        raise InputError(f"the fault {text!r} has a number, and {name} has none")
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
        raise InputError(f"the fault {text!r} has a number that cannot be: size and at are finite, for is positive")
    made: Record = np.zeros((), FAULT)
    made["kind"], made["index"], made["size"] = kind.number, int(index or 0), values["size"] * kind.scale
    made["begin_ns"] = -1 if values["at"] < 0.0 else round(1e9 * values["at"])
    ends = made["begin_ns"] + 1e9 * values["for"]
    made["end_ns"] = _FOREVER if ends >= _FOREVER else round(ends)
    return made


@kernel
def is_active(found: Record, enabled_ns: int, now_ns: int) -> bool:
    """Whether a fault is there now; `enabled_ns` is when the drives were first enabled, negative before."""
    if found.begin_ns < 0:
        return bool(enabled_ns < 0 or now_ns - enabled_ns < found.end_ns)
    return bool(enabled_ns >= 0 and found.begin_ns <= now_ns - enabled_ns < found.end_ns)


@kernel
def disturb(rig: Record, now_ns: int) -> tuple[int, int, bool, bool]:
    """What the faults of the bus do to a message of a rig (dtype `hil.rigs.emulation.drives.EMULATED`): how many copies arrive,
    how much later [ns], whether they are damaged, and whether they come after the next one.
    """
    copies, delay, damaged, held = 1, 0, False, False
    for i in range(rig.faults):
        f = rig.fault[i]
        if not is_active(f, rig.enabled_ns, now_ns):
            continue
        if f.kind == BUS_DOWN or (f.kind == BUS_DROPS and draw(rig.random) < f.size):
            copies = 0
        elif f.kind == BUS_DELAYS:
            delay += int(f.size)
        elif f.kind == BUS_REPEATS and draw(rig.random) < f.size:
            copies *= 2
        elif f.kind == BUS_CORRUPTS and draw(rig.random) < f.size:
            damaged = True
        elif f.kind == BUS_REORDERS and draw(rig.random) < f.size:
            held = True
    return copies, delay, damaged, held


@kernel
def draw(random: Record) -> float:
    """A number in [0, 1) of the generator splitmix64, whose state (uint64, shape (1,)) goes on."""
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
