"""The emulated rig without a bus: the plant with drives and IMUs as hardware has them, on a clock of its own. Compiled.

The code for a bus (`hil.rigs.udp.emulator`, `hil.rigs.canopen.emulated_bus`) sets each drive's `request` and `target`, and
takes a `sample`, which moves the plant on to the present. Faults of IMUs, drives and payload happen here. A fault of the bus
happens there: `disturb` only says what becomes of a message.
"""

from collections.abc import Iterable
from dataclasses import replace
from enum import IntEnum
from math import inf, radians
from typing import Any

import numpy as np

from hil.rigs import DriveState, Request
from hil.rigs.position_loops import (
    LONGEST_STEP_S,
    POSITION_LOOPS,
    are_closed,
    close_loops,
    follow_goal,
    hold_goal,
    loop_fault,
    take_motors,
    take_readings,
)
from plant.checks import nearest
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.dynamics.base_course import BASE_MOTION, MOST_BASE_MOTIONS, BaseMotionKind, base_motion_of_text, placed
from plant.dynamics.variables import BRAKE, IMU_COUNT, VELOCITY
from plant.encoder_readings import ENCODER_FAULT, fault_record, read_encoders
from plant.encoder_readings import MOST_FAULTS as MOST_ENCODER_FAULTS
from plant.encoders import PREFIX as ENCODER_PREFIX
from plant.encoders import EncoderFaultKind, encoder_fault
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries
from plant.fmu.calls import (
    advance,
    read_base_imu,
    read_imus,
    read_motors,
    read_truth,
    write_command,
    write_drive_modes,
    write_payload_mass,
)
from plant.imu import DISTURBANCE, MOST_DISTURBANCES, disturbance_record, measure
from plant.imu_disturbances import DisturbanceKind, disturbance, disturbance_of_text, number_in, times_in, words_of_text
from plant.imu_wiring import BASE_IMU, SLOTS, require_imus
from plant.mechanism import LEGS, Mechanism
from plant.truth import TRUTH_SIZE


class FaultKind(IntEnum):
    """A kind of fault."""

    count: int  # number of IMUs or drives of which one has the fault; 0 if it concerns none of them
    default: float  # size without another one, in the unit that the text gives
    scale: float  # factor from that unit to the kernels' (SI units, ns)
    text: str  # what happens

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

    IMU_FROZEN = SLOTS, 0.0, 1.0, "the IMU repeats its last sample as if it were new"
    IMU_DEAD = SLOTS, 0.0, 1.0, "the IMU sends nothing any more"
    IMU_NOISY = SLOTS, 20.0, 1.0, "noise of this size [deg/s RMS], and a tenth of it [m/s2 RMS]"
    IMU_BIASED = SLOTS, 2.0, radians(1.0), "the IMU is turned on its leg by this angle [deg]"
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


_OF_A_PROBABILITY = FaultKind.BUS_DROPS, FaultKind.BUS_REORDERS, FaultKind.BUS_REPEATS, FaultKind.BUS_CORRUPTS

FAULT = record_dtype(
    kind=np.int64,  # FaultKind; 0: a disturbance of IMUs alone
    index=np.int64,  # of the IMU or drive
    begin_ns=np.int64,  # since the drives were first enabled; below 0: from the start
    end_ns=np.int64,
    size=np.float64,
    disturbance=DISTURBANCE,  # of IMUs, as long as the fault is there
    base=BASE_MOTION,  # of the base
    encoder=ENCODER_FAULT,  # of encoders
)
"""A fault."""

MOST_FAULTS = 32
_LOOP_NS = round(1e9 * LONGEST_STEP_S)
_FOREVER = np.iinfo(np.int64).max


def fault(text: str, base_imu: bool = True) -> Record:
    """A fault (dtype `FAULT`) from its text: the kind, then index, `at` and `for` [s] and `size` where they matter, such as
    `imu-biased:3,at=5,for=2,size=2`; or a disturbance of IMUs, as `plant.imu_disturbances` has them; or a motion of the base,
    as `plant.dynamics.base_course` has them. Without `at` the fault is there from the start.

    Args:
        text: as above.
        base_imu: whether the rig has an IMU on its base.

    Raises:
        UnknownNameError: there is no such kind.
        InputError: an index or a number is out of range, or the fault is of an IMU that is not there.
    """
    name, index, words = words_of_text(text)
    kinds, disturbances = {kind.label: kind for kind in FaultKind}, [kind.label for kind in DisturbanceKind]
    if name in disturbances:
        meant = disturbance_of_text(text)
        require_imus(meant.imus, base_imu, f"the fault {text!r}")
        return _made(0, meant.begin, meant.duration, disturbance=disturbance_record(replace(meant, begin=0.0, duration=inf)))
    if name.startswith(ENCODER_PREFIX):
        broken = encoder_fault(text)
        return _made(
            0, broken.begin, broken.duration, encoder=fault_record(replace(broken, begin=0.0, duration=inf))
        )  # fmt: skip
    moves = [kind.label for kind in BaseMotionKind]
    if name in moves:
        motion = base_motion_of_text(text)
        begin, lasting = float(motion["begin"]), float(motion["end"] - max(motion["begin"], 0.0))
        return _made(0, begin, lasting, base=placed(motion, 0.0))
    if name not in kinds:
        of_encoders = [each.label for each in EncoderFaultKind]
        known = *kinds, *disturbances, *moves, *of_encoders
        raise UnknownNameError(f"there is no fault {name!r}; there are {', '.join(known)}{nearest(name, known)}")
    kind = kinds[name]
    if kind.count and not (index.isdecimal() and int(index) < kind.count):
        raise InputError(f"the fault {text!r} needs the number of an IMU or drive, 0 to {kind.count - 1}: such as {name}:0")
    if not kind.count and index:
        raise InputError(f"the fault {text!r} has a number, but {name} takes none")
    if kind.count == SLOTS:
        require_imus([int(index)], base_imu, f"the fault {text!r}")
    title = f"the fault {name!r}"
    check_entries(words, ("at_s", "for_s", "size"), title)
    size = number_in(words, "size", title, kind.default)
    if kind in _OF_A_PROBABILITY and not 0.0 <= size <= 1.0:
        raise InputError(f"{title} has size = {size:g}; it is a probability: give 0 to 1")
    turned = {}
    if kind == FaultKind.IMU_BIASED:
        turned = {"disturbance": disturbance_record(disturbance("turn", imus=index, axis="x", size_deg=size))}
    return _made(kind, *times_in(words, title), index=int(index or 0), size=size * kind.scale, **turned)


def _made(kind: int, at: float, duration: float, **fields: Any) -> Record:
    begin = -1 if at < 0.0 else round(1e9 * at)
    ends = max(begin, 0) + 1e9 * duration
    return filled(FAULT, kind=kind, begin_ns=begin, end_ns=_FOREVER if ends >= _FOREVER else round(ends), **fields)


EMULATED = record_dtype(
    time_ns=np.int64,
    step_ns=np.int64,  # the plant's largest
    enabled_ns=np.int64,  # when the drives were first enabled; negative before
    deceleration=np.float64,  # in a quick stop or after a fault [m/s^2]
    speed_limit=np.float64,  # [m/s]
    payload=np.float64,  # [kg]
    added=np.float64,  # payload [kg]
    request=(np.int64, LEGS),  # Request
    target=(np.float64, LEGS),  # velocity [m/s]
    until_ns=(np.int64, LEGS),  # when the goal of a drive with a position loop stops moving at that velocity
    reset=(np.int64, LEGS),  # whether to clear the drive's fault
    drive=(np.int64, LEGS),  # DriveState
    code=(np.int64, LEGS),  # of the fault
    velocity=(np.float64, LEGS),  # present [m/s]
    loops=POSITION_LOOPS,  # of drives that close one
    measurement=(np.float64, (3, IMU_COUNT, 3)),  # the last sample [rad/s, m/s^2, uT]
    sample_ns=(np.int64, IMU_COUNT),
    sequence=(np.int64, IMU_COUNT),
    base_imu=(np.float64, (2, 3)),  # the same of an IMU on the base; NaN without one
    base_imu_ns=np.int64,
    base_imu_sequence=np.int64,
    length=(np.float64, LEGS),  # that the encoders read [m]
    length_rate=(np.float64, LEGS),  # [m/s]
    home=(np.int64, LEGS),  # as `plant.encoder_readings` has it
    truth=(np.float64, TRUTH_SIZE),
    fault=(FAULT, MOST_FAULTS),
    faults=np.int64,
    random=(np.uint64, 1),  # state of the faults' random numbers
    ideal=(np.float64, (3, IMU_COUNT, 3)),  # scratch
)
"""State of an emulated rig. A bus sets `request`, `target` and `reset`, and reads the drives and the IMUs' last samples."""

POWER_LOST = 0x3220
"""CiA 402's code for a voltage that was too low; a drive reports it when its power is back."""

_SPEED_RESERVE = 1.5
"""A drive's largest velocity, over the limit of the mechanism."""


def new_emulated(
    mechanism: Mechanism, step_ns: int, seed: int, faults: Iterable[Record] = (), position: bool = False
) -> Record:  # fmt: skip
    """An emulated rig (dtype `EMULATED`) whose drives are ready, with the limits and the payload of a mechanism.

    Args:
        mechanism: with limits.
        step_ns: largest step of the plant [ns].
        seed: of the faults' random numbers.
        faults: each of dtype `FAULT`.
        position: whether the drives close position loops, whose goals move at the velocities that they are told.
    """
    rig: Record = np.zeros((), EMULATED)
    limits = mechanism.require_limits()
    rig["step_ns"], rig["deceleration"], rig["speed_limit"] = step_ns, limits.acceleration, _SPEED_RESERVE * limits.velocity
    rig["payload"] = mechanism.plant_parameters()["payload.mass"]
    rig["length"], rig["length_rate"], rig["home"], rig["base_imu"] = np.nan, np.nan, -1, np.nan
    rig["enabled_ns"], rig["drive"], rig["random"] = -1, DriveState.READY, seed + 1
    rig["until_ns"] = _FOREVER
    close_loops(rig["loops"], position)
    for each in faults:
        add_fault(rig, each)
    return rig


def add_fault(rig: Record, fault: Record) -> None:
    """Schedule another fault.

    Raises:
        InputError: there are too many.
    """
    count = int(rig["faults"])
    if count == MOST_FAULTS:
        raise InputError(f"there are already {count} faults, the most that are possible: leave some out, or clear them")
    rig["fault"][count] = fault
    rig["faults"] = count + 1


@shared_kernel
def sample(fmu: Record, imu: Record, encoders: Record, rig: Record, now_ns: int) -> int:
    """Move the plant on to `now_ns` on the rig's clock, and read the IMUs and the encoders; returns FMI's status."""
    r, c, m = rig[()], fmu[()], imu[()]
    status = move(fmu, rig, now_ns)
    status |= read_imus(fmu) | read_truth(fmu)
    r.truth[:] = c.truth
    r.ideal[:] = c.imu
    m.time, m.disturbances = 1e-9 * r.time_ns, m.lasting
    for i in range(r.faults):
        f = r.fault[i]
        if not is_active(f, r.enabled_ns, r.time_ns):
            continue
        if f.kind == FaultKind.IMU_SWAPPED:
            k, other = f.index, min(max(int(f.size), 0), IMU_COUNT - 1)
            for kind in range(3):
                for j in range(3):
                    r.ideal[kind, k, j], r.ideal[kind, other, j] = r.ideal[kind, other, j], r.ideal[kind, k, j]
        if f.disturbance.kind != 0 and m.disturbances < MOST_DISTURBANCES:
            m.disturbance[m.disturbances] = f.disturbance
            if f.begin_ns >= 0:
                m.disturbance[m.disturbances].begin = 1e-9 * (r.enabled_ns + f.begin_ns)
            m.disturbances += 1
    if m.count > BASE_IMU:
        status |= read_base_imu(fmu)
        m.base[:2] = c.base_imu
    measure(imu, r.ideal, c.imu)
    for k in range(m.count):
        if m.fresh[k] == 0 or find_fault(r, FaultKind.IMU_DEAD, k) >= 0:
            continue
        taken_ns = np.int64(np.rint(1e9 * m.sampled_at[k]))
        if k == BASE_IMU:
            r.base_imu_sequence += m.fresh[k]
            r.base_imu_ns = taken_ns
        else:
            r.sequence[k] += m.fresh[k]
            r.sample_ns[k] = taken_ns
        if find_fault(r, FaultKind.IMU_FROZEN, k) >= 0:
            continue
        noisy = find_fault(r, FaultKind.IMU_NOISY, k)
        noise = r.fault[noisy].size if noisy >= 0 else 0.0
        for kind in range(3):
            for j in range(3):
                read = m.reading[kind, k, j]
                if noise > 0.0 and kind < 2:
                    read += draw_normal(r.random) * noise * (np.pi / 180.0 if kind == 0 else 0.1)
                if k < BASE_IMU:
                    r.measurement[kind, k, j] = read
                elif kind < 2:
                    r.base_imu[kind, j] = read
    if encoders[()].legs > 0:
        status |= _read_encoders(fmu, encoders, r)
    elif are_closed(r.loops):
        # Their encoders tell the drives alone.
        status |= read_motors(fmu)
        take_motors(r.loops, c.motors)
    return status


@kernel
def _read_encoders(fmu: Record, encoders: Record, r: Record) -> int:
    """Read the encoders of a rig that has been moved on; returns FMI's status."""
    e = encoders[()]
    status = read_motors(fmu)
    e.time, e.faults = 1e-9 * r.time_ns, e.lasting
    for i in range(r.faults):
        f = r.fault[i]
        if f.encoder.kind == 0 or e.faults >= MOST_ENCODER_FAULTS or not is_active(f, r.enabled_ns, r.time_ns):
            continue
        e.fault[e.faults] = f.encoder
        if f.begin_ns >= 0:
            e.fault[e.faults].begin = 1e-9 * (r.enabled_ns + f.begin_ns)
        e.faults += 1
    read_encoders(encoders, fmu[()].motors, r.length, r.length_rate, r.home)
    take_readings(r.loops, fmu[()].motors, r.length)
    return status


@kernel
def move(fmu: Record, rig: Record, now_ns: int) -> int:
    """Move the plant and the drives on to `now_ns`; returns FMI's status."""
    r, c = rig[()], fmu[()]
    status, closed = 0, are_closed(r.loops)
    while r.time_ns < now_ns:
        step = min(r.step_ns, now_ns - r.time_ns)
        if closed:
            step = min(step, _LOOP_NS)
            status |= read_motors(fmu)
            take_motors(r.loops, c.motors)
        added = 0.0
        for i in range(r.faults):
            if r.fault[i].kind == FaultKind.PAYLOAD_JUMPS and is_active(r.fault[i], r.enabled_ns, r.time_ns):
                added += r.fault[i].size
        _set_base(c, r)
        if added != r.added:
            status |= write_payload_mass(fmu, r.payload + added)
            r.added = added
        for k in range(LEGS):
            _step_drive(r, k, step)
            moving = r.drive[k] == DriveState.FOLLOWING or r.drive[k] == DriveState.QUICK_STOPPING or r.velocity[k] != 0.0
            c.mode[k] = VELOCITY if moving else BRAKE
        status |= write_drive_modes(fmu) | write_command(fmu, r.velocity)
        status |= advance(fmu, 1e-9 * step)
        r.time_ns += step
    return status


@kernel
def _set_base(c: Record, r: Record) -> None:
    """Give the plant the motions of its base; those that have ended still have to come to rest."""
    c.base_motion_count = 0
    for i in range(r.faults):
        f, n = r.fault[i], c.base_motion_count
        if f.base.kind == 0 or (f.begin_ns >= 0 and r.enabled_ns < 0) or n >= MOST_BASE_MOTIONS:
            continue
        c.base_motions[n] = f.base
        if f.begin_ns >= 0:
            begin = c.time - 1e-9 * (r.time_ns - r.enabled_ns - f.begin_ns)
            c.base_motions[n].begin, c.base_motions[n].end = begin, begin + 1e-9 * (f.end_ns - f.begin_ns)
        c.base_motion_count += 1


@kernel
def _step_drive(r: Record, k: int, step: int) -> None:
    """Update a drive's state and velocity for a step [ns]."""
    period = 1e-9 * step
    broken, stuck = find_fault(r, FaultKind.DRIVE_FAULTS, k), find_fault(r, FaultKind.DRIVE_STUCK, k)
    running, ignoring = find_fault(r, FaultKind.DRIVE_RUNS_AWAY, k), find_fault(r, FaultKind.DRIVE_IGNORES, k)
    if find_fault(r, FaultKind.DRIVE_UNPOWERED, k) >= 0:
        r.drive[k], r.velocity[k] = DriveState.NOT_READY, 0.0
        return
    if r.drive[k] == DriveState.NOT_READY:
        r.drive[k], r.code[k] = DriveState.FAULTY, POWER_LOST
    if broken >= 0 and r.drive[k] != DriveState.FAULTY:
        r.drive[k], r.code[k] = DriveState.FAULTY, int(r.fault[broken].size)
    if r.drive[k] == DriveState.FAULTY:
        if r.reset[k] != 0 and broken < 0 and r.velocity[k] == 0.0:
            r.drive[k], r.code[k] = DriveState.READY, 0
    elif r.request[k] == Request.BRAKED:
        r.drive[k] = DriveState.READY
    elif r.request[k] == Request.ENABLED and r.drive[k] != DriveState.QUICK_STOPPING:
        if r.enabled_ns < 0:
            r.enabled_ns = r.time_ns
        r.drive[k] = DriveState.FOLLOWING
    elif r.request[k] == Request.QUICK_STOP and r.drive[k] == DriveState.FOLLOWING:
        r.drive[k] = DriveState.QUICK_STOPPING
    r.reset[k] = 0
    wanted = r.target[k] if r.loops.active[k] == 0 else _close_loop(r, k, step)
    if stuck >= 0:
        r.velocity[k] = 0.0
    elif running >= 0 and r.request[k] != Request.BRAKED:
        r.velocity[k] = r.fault[running].size
    elif ignoring >= 0 and r.request[k] != Request.BRAKED:
        return
    elif r.drive[k] == DriveState.FOLLOWING:
        r.velocity[k] = min(max(wanted, -r.speed_limit), r.speed_limit)
    elif r.drive[k] == DriveState.READY and r.request[k] == Request.BRAKED:
        r.velocity[k] = 0.0
    else:
        slower = r.deceleration * period
        r.velocity[k] -= min(max(r.velocity[k], -slower), slower)
        if r.velocity[k] == 0.0 and r.drive[k] == DriveState.QUICK_STOPPING:
            r.drive[k] = DriveState.READY


@kernel
def accepted_velocity(r: Record, k: int) -> float:
    """The command that a drive which follows it has accepted, or its present velocity [m/s].

    That of a position loop is what it makes of the command.
    """
    if r.loops.active[k] != 0 and r.drive[k] == DriveState.FOLLOWING:
        return float(min(max(r.target[k], -r.speed_limit), r.speed_limit))
    return float(r.velocity[k])


@kernel
def _close_loop(r: Record, k: int, step: int) -> float:
    """The velocity of a drive with a position loop for a step [ns]; a fault that the loop finds becomes the drive's."""
    if r.drive[k] != DriveState.FOLLOWING:
        hold_goal(r.loops, k)
        return 0.0
    moving = min(step, max(r.until_ns[k] - r.time_ns, 0))
    velocity = follow_goal(r.loops, k, r.target[k], 1e-9 * moving, r.speed_limit, 1e-9 * step)
    code = loop_fault(r.loops, k)
    if code != 0:
        r.drive[k], r.code[k] = DriveState.FAULTY, code
    return velocity


@kernel
def is_active(f: Record, enabled_ns: int, now_ns: int) -> bool:
    """Whether a fault is there now; `enabled_ns` is when the drives were first enabled, negative before."""
    if f.begin_ns < 0:
        return bool(enabled_ns < 0 or now_ns - enabled_ns < f.end_ns)
    return bool(enabled_ns >= 0 and f.begin_ns <= now_ns - enabled_ns < f.end_ns)


@kernel
def find_fault(rig: Record, kind: int, index: int) -> int:
    """Place of the latest active fault of this kind and index in a rig (dtype `EMULATED`), or -1."""
    place = -1
    for i in range(rig.faults):
        f = rig.fault[i]
        if f.kind == kind and f.index == index and is_active(f, rig.enabled_ns, rig.time_ns):
            place = i
    return place


@kernel
def disturb(rig: Record, now_ns: int) -> tuple[int, int, bool, bool]:
    """The effect of the bus's faults on a message of a rig (dtype `EMULATED`): the number of copies
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
