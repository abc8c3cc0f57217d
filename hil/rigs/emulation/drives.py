"""The emulated rig without a bus: the plant with drives and IMUs as hardware has them, on a clock of its own. Compiled.

The code for a bus (`hil.rigs.udp.emulator`, `hil.rigs.canopen.emulator`) sets each drive's `request` and `target`, and takes a
`sample`, which moves the plant on to the present. Faults of IMUs, drives and payload happen here, faults of the bus there.
"""

from collections.abc import Iterable

import numpy as np

from hil.rigs import DriveState, Request
from hil.rigs.emulation.faults import FAULT, MOST_FAULTS, FaultKind, draw_normal, find_fault, is_active
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import BRAKE, IMU_COUNT, VELOCITY
from plant.errors import InputError
from plant.fmu.calls import advance, read_imus, read_truth, write_command, write_drive_modes, write_payload_mass
from plant.imu import measure
from plant.mechanism import LEGS, Mechanism
from plant.pose import rotate_by_vector
from plant.truth import TRUTH_SIZE
from plant.vectors import rotate, vector

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
    reset=(np.int64, LEGS),  # whether to clear the drive's fault
    drive=(np.int64, LEGS),  # DriveState
    code=(np.int64, LEGS),  # of the fault
    velocity=(np.float64, LEGS),  # present [m/s]
    measurement=(np.float64, (3, IMU_COUNT, 3)),  # the last sample [rad/s, m/s^2, uT]
    sample_ns=(np.int64, IMU_COUNT),
    sequence=(np.int64, IMU_COUNT),
    truth=(np.float64, TRUTH_SIZE),
    fault=(FAULT, MOST_FAULTS),
    faults=np.int64,
    random=(np.uint64, 1),  # state of the faults' random numbers
    ideal=(np.float64, (3, IMU_COUNT, 3)),  # scratch, as the rest
    turn=(np.float64, (3, 3)),
    axis=(np.float64, 3),
)
"""State of an emulated rig. A bus sets `request`, `target` and `reset`, and reads the drives and the IMUs' last samples."""

POWER_LOST = 0x3220
"""CiA 402's code for a voltage that was too low; a drive reports it when its power is back."""

_SPEED_RESERVE = 1.5
"""A drive's largest velocity, over the limit of the mechanism."""


def new_emulated(mechanism: Mechanism, step_ns: int, seed: int, faults: Iterable[Record] = ()) -> Record:
    """An emulated rig (dtype `EMULATED`) whose drives are ready, with the limits and the payload of a mechanism.

    Args:
        mechanism: with limits.
        step_ns: largest step of the plant [ns].
        seed: of the faults' random numbers.
        faults: each of dtype `FAULT`.
    """
    rig: Record = np.zeros((), EMULATED)
    limits = mechanism.require_limits()
    rig["step_ns"], rig["deceleration"], rig["speed_limit"] = step_ns, limits.acceleration, _SPEED_RESERVE * limits.velocity
    rig["payload"] = mechanism.plant_parameters()["payload.mass"]
    rig["enabled_ns"], rig["drive"], rig["random"] = -1, DriveState.READY, seed + 1
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


@kernel
def sample(fmu: Record, imu: Record, rig: Record, now_ns: int) -> int:
    """Move the plant on to `now_ns` on the rig's clock, and read the IMUs; returns FMI's status."""
    r, c = rig[()], fmu[()]
    status = move(fmu, rig, now_ns)
    status |= read_imus(fmu) | read_truth(fmu)
    r.truth[:] = c.truth
    r.ideal[:] = c.imu
    for i in range(r.faults):
        f = r.fault[i]
        if not is_active(f, r.enabled_ns, r.time_ns):
            continue
        if f.kind == FaultKind.IMU_SWAPPED:
            k, m = f.index, min(max(int(f.size), 0), IMU_COUNT - 1)
            for kind in range(3):
                for j in range(3):
                    r.ideal[kind, k, j], r.ideal[kind, m, j] = r.ideal[kind, m, j], r.ideal[kind, k, j]
        elif f.kind == FaultKind.IMU_BIASED:
            _turn(r, f.index, f.size)
    measure(imu, r.ideal, c.imu)
    for k in range(IMU_COUNT):
        if find_fault(r, FaultKind.IMU_DEAD, k) >= 0:
            continue
        r.sequence[k] += 1
        r.sample_ns[k] = r.time_ns
        if find_fault(r, FaultKind.IMU_FROZEN, k) >= 0:
            continue
        noisy = find_fault(r, FaultKind.IMU_NOISY, k)
        noise = r.fault[noisy].size if noisy >= 0 else 0.0
        for kind in range(3):
            for j in range(3):
                r.measurement[kind, k, j] = c.imu[kind, k, j]
                if noise > 0.0 and kind < 2:
                    r.measurement[kind, k, j] += draw_normal(r.random) * noise * (np.pi / 180.0 if kind == 0 else 0.1)
    return status


@kernel
def _turn(r: Record, k: int, angle: float) -> None:
    """Turn an IMU by an angle about its x axis; its readings turn the other way."""
    for i in range(3):
        for j in range(3):
            r.turn[i, j] = 1.0 if i == j else 0.0
        r.axis[i] = 0.0
    r.axis[0] = -angle
    rotate_by_vector(r.turn, r.axis)
    for kind in range(3):
        ideal = r.ideal[kind, k]
        ideal[0], ideal[1], ideal[2] = rotate(r.turn, vector(ideal))


@kernel
def move(fmu: Record, rig: Record, now_ns: int) -> int:
    """Move the plant and the drives on to `now_ns`; returns FMI's status."""
    r, c = rig[()], fmu[()]
    status = 0
    while r.time_ns < now_ns:
        step = min(r.step_ns, now_ns - r.time_ns)
        added = 0.0
        for i in range(r.faults):
            if r.fault[i].kind == FaultKind.PAYLOAD_JUMPS and is_active(r.fault[i], r.enabled_ns, r.time_ns):
                added += r.fault[i].size
        if added != r.added:
            status |= write_payload_mass(fmu, r.payload + added)
            r.added = added
        for k in range(LEGS):
            _step_drive(r, k, 1e-9 * step)
            moving = r.drive[k] == DriveState.FOLLOWING or r.drive[k] == DriveState.QUICK_STOPPING or r.velocity[k] != 0.0
            c.mode[k] = VELOCITY if moving else BRAKE
        status |= write_drive_modes(fmu) | write_command(fmu, r.velocity)
        status |= advance(fmu, 1e-9 * step)
        r.time_ns += step
    return status


@kernel
def _step_drive(r: Record, k: int, period: float) -> None:
    """Update a drive's state and velocity for a step of `period` [s]."""
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
    if stuck >= 0:
        r.velocity[k] = 0.0
    elif running >= 0 and r.request[k] != Request.BRAKED:
        r.velocity[k] = r.fault[running].size
    elif ignoring >= 0 and r.request[k] != Request.BRAKED:
        return
    elif r.drive[k] == DriveState.FOLLOWING:
        r.velocity[k] = min(max(r.target[k], -r.speed_limit), r.speed_limit)
    elif r.drive[k] == DriveState.READY and r.request[k] == Request.BRAKED:
        r.velocity[k] = 0.0
    else:
        slower = r.deceleration * period
        r.velocity[k] -= min(max(r.velocity[k], -slower), slower)
        if r.velocity[k] == 0.0 and r.drive[k] == DriveState.QUICK_STOPPING:
            r.drive[k] = DriveState.READY
