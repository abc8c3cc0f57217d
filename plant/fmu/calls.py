"""Calls of an FMU from compiled code, by the addresses of its C functions."""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.base_course import BASE_MOTION, BASE_SIZE, MOST_BASE_MOTIONS, base_motion_at
from plant.dynamics.variables import DRIVE_MODES, IMU_COUNT, VELOCITY
from plant.fmu.instance import ASKS_TO_END, ERROR, NEEDS_EVENTS, NOT_FINITE, OK
from plant.mechanism import LEGS
from plant.pose import Array
from plant.truth import TRUTH_SIZE

MOST_CHANGES = 32
"""The most parameters that may change during a run."""

_SENSED = 3 * IMU_COUNT * 3
(
    _READ_IMUS, _READ_TRUTH, _READ_MOTORS, _READ_BASE_IMU, _WRITE_COMMAND, _WRITE_MODES, _WRITE_PAYLOAD, _WRITE_BASE,
    _CHANGE_VALUE, _STEP,
) = range(10)  # fmt: skip
CALLED = (
    "reading the IMUs", "reading the truth", "reading the motors", "reading the base's IMU", "setting the commands",
    "setting the drives' modes", "setting the payload", "moving the base", "changing a parameter", "a step",
)  # fmt: skip
"""The name of each call in messages, by the `call` of `FMU_HANDLE`."""


def _scalars(most: int) -> np.dtype[Any]:
    """`plant.fmu.binding.Scalars` for at most so many, and a buffer `raw` for the FMU's values."""
    return record_dtype(
        references=(np.uint32, most),
        reference_count=np.int64,
        count=np.int64,
        places=(np.int64, most),
        factors=(np.float64, most),
        offsets=(np.float64, most),
        raw=(np.float64, most),
    )


_CHANGE = record_dtype(
    time=np.float64,
    function=np.int64,
    references=np.int64,
    reference_count=np.int64,
    values=np.int64,
    count=np.int64,
)

FMU_HANDLE = record_dtype(
    version=np.int64,
    instance=np.int64,
    get=np.int64,
    set=np.int64,
    set_mode=np.int64,
    do_step=np.int64,
    time=np.float64,
    since=np.float64,
    length=np.float64,
    steps=np.int64,
    step=np.float64,
    final=np.uint8,
    status=np.int64,
    call=np.int64,
    sensed=_scalars(_SENSED),
    known=_scalars(TRUTH_SIZE),
    encoded=_scalars(LEGS),
    base_sensed=_scalars(6),
    commanded=_scalars(LEGS),
    loaded=_scalars(1),
    based=_scalars(BASE_SIZE),
    mode_references=(np.uint32, LEGS),
    mode_reference_count=np.int64,
    mode_count=np.int64,
    mode_bytes=np.int64,
    mode_values=(np.uint64, len(DRIVE_MODES)),
    mode_raw=(np.uint64, LEGS),
    imu=(np.float64, (3, IMU_COUNT, 3)),
    truth=(np.float64, TRUTH_SIZE),
    motors=(np.float64, LEGS),
    base_imu=(np.float64, (2, 3)),
    planar_angle=np.int64,
    legs=np.int64,
    command=(np.float64, LEGS),
    mode=(np.int64, LEGS),
    payload=(np.float64, 1),
    base=(np.float64, BASE_SIZE),
    base_motions=(BASE_MOTION, MOST_BASE_MOTIONS),
    base_motion_count=np.int64,
    base_moved=np.uint8,
    reached=(np.float64, 1),
    flags=(np.uint8, 3),
    changes=(_CHANGE, MOST_CHANGES),
    change_count=np.int64,
    changed=np.int64,
)
"""One FMU in compiled code: addresses, value references with their conversions, and buffers.

`imu` is angular velocity [rad/s], specific force [m/s^2] and magnetic field [uT] of the seven IMUs; `truth` is that of
`plant.truth`; `motors` are the lengths of the legs that encoders read [m]; `base_imu` is what an IMU on the base senses, in its
first two units; all are NaN where the FMU has no value. A planar
plant's truth has its pose in space, with z = 0, and its first three legs. `step` is the communication step [s], or 0 to step by
the duration of each call. `time` is `steps` steps of one `length` [s] after `since` [s]: a count, because a sum would drift.
The base's motions count from time 0. `final` is whether no earlier state will be restored. `status` is the status of the first
call that failed, and `call` is that call.
"""


def _calling(arguments: str) -> Any:
    """An intrinsic that calls the C function at an address with a tuple of arguments.

    `arguments` has a letter for each: p for a pointer or size (intp), d for a double, b for a bool (uint8), i for an int.
    """
    llvm = {"p": ir.IntType(64), "d": ir.DoubleType(), "b": ir.IntType(8), "i": ir.IntType(32)}
    numba_types = {"p": types.intp, "d": types.float64, "b": types.uint8, "i": types.int32}
    tuple_of: Any = types.Tuple

    @intrinsic
    def call(typing_context: Any, address: Any, values: Any) -> Any:
        signature = types.int32(types.intp, tuple_of([numba_types[letter] for letter in arguments]))

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            function_type = ir.FunctionType(ir.IntType(32), [llvm[letter] for letter in arguments])
            function = builder.inttoptr(args[0], function_type.as_pointer())
            unpacked = [builder.extract_value(args[1], i) for i in range(len(arguments))]
            # Callees may expect a bool to fill its register.
            extended = {i: ("zeroext",) for i, letter in enumerate(arguments) if letter == "b"}
            return builder.call(function, unpacked, arg_attrs=extended)

        return signature, generate

    return call


_access_2: Callable[..., int] = _calling("pppp")
_access_3: Callable[..., int] = _calling("ppppp")
_do_step_2: Callable[..., int] = _calling("pddi")
_do_step_3: Callable[..., int] = _calling("pddbpppp")


@kernel
def _keep_failure(c: Record, call: int, status: int) -> int:
    """Record the status if this call is the first that fails; return it."""
    if status != OK and c.status == OK:
        c.status, c.call = status, call
    return status


@kernel
def _access(c: Record, call: int, function: int, references: int, reference_count: int, values: int, count: int) -> int:
    """Get or set values, unless the FMU has failed; returns FMI's status."""
    if c.status >= ERROR:
        return int(c.status)
    if c.version == 2:
        status = _access_2(function, (c.instance, references, reference_count, values))
    else:
        status = _access_3(function, (c.instance, references, reference_count, values, count))
    return _keep_failure(c, call, status)


@kernel
def _read(c: Record, call: int, scalars: Record, into: Array) -> int:
    """Read scalars, each to its place; one that is not finite is left out, and is a failure of the FMU."""
    if scalars.count == 0:
        return OK
    raw, references = scalars.raw, scalars.references
    status = _access(c, call, c.get, references.ctypes.data, scalars.reference_count, raw.ctypes.data, scalars.count)
    places, factors, offsets = scalars.places, scalars.factors, scalars.offsets
    for i in range(scalars.count):
        if np.isfinite(raw[i]):
            into[places[i]] = factors[i] * raw[i] + offsets[i]
        elif status == OK:
            status = _keep_failure(c, call, NOT_FINITE)
    return status


@kernel
def _write(c: Record, call: int, scalars: Record, values: Array) -> int:
    """Write scalars, each from its place."""
    if scalars.count == 0:
        return OK
    raw, references = scalars.raw, scalars.references
    places, factors, offsets = scalars.places, scalars.factors, scalars.offsets
    for i in range(scalars.count):
        raw[i] = (values[places[i]] - offsets[i]) / factors[i]
    return _access(c, call, c.set, references.ctypes.data, scalars.reference_count, raw.ctypes.data, scalars.count)


@kernel
def read_imus(fmu: Record) -> int:
    """Read the ideal IMU signals into `imu`; returns FMI's status or `NOT_FINITE`, 0 for success."""
    c = fmu[()]
    return _read(c, _READ_IMUS, c.sensed, c.imu.reshape(-1))


@kernel
def read_truth(fmu: Record) -> int:
    """Read what the FMU has of the truth into `truth`; returns FMI's status."""
    c = fmu[()]
    truth = c.truth
    status = _read(c, _READ_TRUTH, c.known, truth)
    if c.planar_angle != 0:
        half = 0.5 * truth[3]
        truth[3], truth[4], truth[5], truth[6] = np.cos(half), 0.0, 0.0, np.sin(half)
    return status


@kernel
def read_motors(fmu: Record) -> int:
    """Read the lengths that encoders read into `motors`; returns FMI's status."""
    c = fmu[()]
    return _read(c, _READ_MOTORS, c.encoded, c.motors)


@kernel
def read_base_imu(fmu: Record) -> int:
    """Read the ideal signals of an IMU on the base into `base_imu`; returns FMI's status."""
    c = fmu[()]
    return _read(c, _READ_BASE_IMU, c.base_sensed, c.base_imu.reshape(-1))


@kernel
def write_command(fmu: Record, command: Array) -> int:
    """Set the velocity commands (6,) or (3,) [m/s]; returns FMI's status.

    Drives without modes get the command 0 unless their mode is `VELOCITY`.
    """
    c = fmu[()]
    sent = c.command
    for k in range(c.legs):
        sent[k] = command[k] if c.mode_count > 0 or c.mode[k] == VELOCITY else 0.0
    return _write(c, _WRITE_COMMAND, c.commanded, sent)


@kernel
def write_drive_mode(fmu: Record, mode: int) -> int:
    """Set the mode of all drives; returns FMI's status."""
    fmu[()].mode[:] = mode
    return write_drive_modes(fmu)


@kernel
def write_drive_modes(fmu: Record) -> int:
    """Set the drives to the modes in `mode`; returns FMI's status.

    A mode that all drives share is that of the drive with the highest mode.
    """
    c = fmu[()]
    if c.mode_count == 0:
        return write_command(fmu, c.command)
    raw = c.mode_raw
    raw[:] = 0
    for k in range(c.mode_count):
        mode = c.mode[k]
        if c.mode_count == 1:
            for other in range(c.legs):
                mode = max(mode, c.mode[other])
        at = k * c.mode_bytes
        raw[at >> 3] |= c.mode_values[mode] << np.uint64(8 * (at & 7))
    references = c.mode_references
    return _access(
        c, _WRITE_MODES, c.set_mode, references.ctypes.data, c.mode_reference_count, raw.ctypes.data, c.mode_count
    )  # fmt: skip


@kernel
def write_payload_mass(fmu: Record, mass: float) -> int:
    """Set the mass of the payload [kg], if the plant has one; returns FMI's status."""
    c = fmu[()]
    c.payload[0] = mass
    return _write(c, _WRITE_PAYLOAD, c.loaded, c.payload)


@kernel
def _move_base(c: Record, time: float) -> int:
    """Set the motion that the base has at a time [s], if it has one or had one; returns FMI's status."""
    if c.base_motion_count == 0 and c.base_moved == 0:
        return OK
    base_motion_at(c.base_motions, c.base_motion_count, time, c.base)
    c.base_moved = 1 if c.base_motion_count > 0 else 0
    return _write(c, _WRITE_BASE, c.based, c.base)


@kernel
def advance(fmu: Record, duration: float) -> int:
    """Step the FMU by `duration` [s], in steps of `step` if that is set; returns FMI's status.

    The base's motion is that of the middle of each step, and afterwards that of the present.
    """
    c = fmu[()]
    steps = 1 if c.step == 0.0 else max(int(np.rint(duration / c.step)), 1)
    status = OK
    for _ in range(steps):
        while c.changed < c.change_count and c.changes[c.changed].time <= c.time + _INSTANT_S:
            change = c.changes[c.changed]
            status |= _access(
                c, _CHANGE_VALUE, change.function, change.references, change.reference_count, change.values, change.count
            )  # fmt: skip
            c.changed += 1
        status |= _move_base(c, c.time + 0.5 * duration / steps)
        status |= _step(c, duration / steps)
    return status | _move_base(c, c.time)


_INSTANT_S = 1e-9
"""A change that is due within this time is made now [s]."""


@kernel
def _step(c: Record, step: float) -> int:
    """Take a communication step, unless the FMU has failed; returns FMI's status."""
    if c.status >= ERROR:
        return int(c.status)
    if c.version == 2:
        status = _do_step_2(c.do_step, (c.instance, c.time, step, np.int32(c.final)))
    else:
        flags = c.flags
        at = flags.ctypes.data
        status = _do_step_3(c.do_step, (c.instance, c.time, step, c.final, at, at + 1, at + 2, c.reached.ctypes.data))
        if status == OK and flags[1] != 0:
            status = ASKS_TO_END
        elif status == OK and (flags[0] != 0 or flags[2] != 0):
            status = NEEDS_EVENTS
    if step != c.length:
        c.since, c.length, c.steps = c.time, step, 0
    c.steps += 1
    c.time = c.since + c.steps * step
    return _keep_failure(c, _STEP, status)
