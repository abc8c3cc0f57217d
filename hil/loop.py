"""The loop around the cycle: wait for the clock, read the rig, run the cycle, command the rig, record. Compiled.

All state lies in the arrays of `Loop`, so a run can be taken up again at any cycle. The same steps in Python serve rigs, and
filters, that are written in Python.
"""

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numba import typeof, types
from numba.core import event
from numba.extending import intrinsic
from numpy.typing import NDArray

from controller.cycle import (
    IMPLAUSIBLE,
    NOT_FINITE,
    OK,
    POSE_LOST,
    begin_stop,
    control,
    has_stopped,
    prepare,
    skip,
)
from controller.fusion import calibrate, find_pose, fuse_heading, fuse_legs, fuse_mechanism, fuse_platform, improve_pose
from controller.least_squares import RANK_TOLERANCE, factor_cholesky, invert_cholesky
from controller.mechanism_filter import extrapolate_covariance
from hil.clock import FREE, REAL, finish, new_clock, now, start, wait
from plant.compiled import Record, kernel
from plant.fmu import CALLS, advance, read_imus, read_truth, write_command, write_drive_mode
from plant.imu import measure
from plant.mechanism import LEGS
from plant.pose import Array
from plant.variables import BRAKE, IMU_COUNT, VELOCITY

STOPPED, CLOCK_FAILED = 50, 51
"""Statuses beside those of the cycle: a controlled stop has ended on the brakes; the machine's clock wakes no one."""

RIG_FAILED, SEND_FAILED = 100, 200
"""Added to the rig's own status (FMI's, for an FMU) when it reports a failure: before the cycle has computed, and after."""

NO_STOP, END_OF_MOTION, ASKED_TO_STOP, MISSED_PERIODS, SUPERVISOR_GONE = range(5)
STOP_CAUSES = (
    "none",
    "end of the motion",
    "asked for",
    "too many periods missed in a row",
    "the supervising process has gone",
)
"""Why a controlled stop began."""

_FAILURES = {
    IMPLAUSIBLE: (
        "the estimated pose needs a leg far outside its stroke: the IMUs' errors are larger than the filters assume "
        "(raw ones need a calibration)"
    ),
    POSE_LOST: "the IMUs that can be used no longer determine the pose",
    NOT_FINITE: "an estimate or a command is no longer finite",
    CLOCK_FAILED: "this machine's clock refuses to wake the loop",
}

STAGES = (
    "sense",
    "leg filters",
    "platform filter",
    "direct kinematics",
    "refinement",
    "whole mechanism",
    "control",
    "send",
    "record",
    "plant",
)
"""What a cycle is made of: `leg filters` begin with the calibration; `control` is inverse kinematics, PID and feed-forward;
`record` is what comes after the command: telemetry and the next reference; `plant` is the simulated one's own time."""

_SENSE, _LEGS, _PLATFORM, _POSE, _REFINEMENT, _MECHANISM, _CONTROL, _SEND, _RECORD, _PLANT = range(len(STAGES))
COMPUTED, TO_COMMAND = slice(_LEGS, _SEND), slice(_SENSE, _RECORD)
"""The stages of the paper's Figure 4, and all between the wake-up and the command."""

RECORD = np.dtype(
    [
        ("cycle", np.int64),
        ("time_ns", np.int64),
        ("late_ns", np.int64),
        ("stage_ns", np.int64, len(STAGES)),
        ("cpu_ns", np.int64),
        ("missed", np.int64),
        ("status", np.int32),
        ("stop", np.int32),
        ("imus", np.int32),
        ("trusted", np.int32),
        ("angular_velocity", np.float64, (IMU_COUNT, 3)),
        ("specific_force", np.float64, (IMU_COUNT, 3)),
        ("magnetic_field", np.float64, (IMU_COUNT, 3)),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("covariance", np.float32, (6, 6)),
        ("residuals", np.float32, (LEGS, 3)),
        ("conditioning", np.float64),
        ("lengths", np.float64, LEGS),
        ("reference", np.float64, (LEGS, 3)),
        ("command", np.float64, LEGS),
        ("truth", np.float64, CALLS["truth"].shape),
    ],
    align=True,
)
"""What is kept of a cycle: the period that it ran in; when it woke [ns since the first] and how late; the stages' durations and
the thread's CPU time; periods missed before it; its status and the cause of a stop; which IMUs were used (a bit each, and
the eighth for the platform's magnetometer), and whether the pose is the whole-mechanism filter's; raw IMU data; the pose with
covariance (translation, rotation; in {1}), residuals of the directions and conditioning; lengths, reference (length, rate,
acceleration) and commands; and the truth as the plant's `truth` buffer has it.
"""

HEAD, STOP, DONE, TAIL, KEPT, SUPERVISOR, START = range(7)
LINK = 16
"""Places in the array that the loop shares with other processes, int64 (16,): records written, whether it shall stop, whether
it has ended; where the next recorder goes on, and how many records are in files for good; the process whose end ends the
motion, 0 for none; and the first deadline [ns]."""


def describe_status(status: int) -> str:
    """What a status of the loop means, in words; what a rig has to say of its own, it must be asked."""
    own = status - (SEND_FAILED if status >= SEND_FAILED else RIG_FAILED)
    return _FAILURES.get(status, f"the rig reports failure {own}")


class PythonFilters(NamedTuple):
    """Filters in Python, which take the calibrated sample in the cycle's state and leave there what the compiled ones would.

    Attributes:
        fuse_legs, fuse_platform: in the place of those in `controller.fusion`.
    """

    fuse_legs: Callable[[Record], None]
    fuse_platform: Callable[[Record], None]


_ENDLESS = np.iinfo(np.int64).max
_LOOK_NS = 100_000_000
_SIGNALS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14
"""SIGHUP, SIGINT, SIGQUIT and SIGTERM in a set of signals."""

_WORK = np.dtype(
    [
        ("cycle", np.int64),
        ("measurement", np.float64, (3, IMU_COUNT, 3)),
        ("truth", np.float64, CALLS["truth"].shape),
        ("factor", np.float64, (6, 6)),
        ("covariance", np.float64, (6, 6)),
        ("stage_ns", np.int64, len(STAGES)),
        ("signals", np.int64, 16),
    ],
    align=True,
)
_getppid: Any = types.ExternalFunction("getppid", types.int32())
_sigpending: Any = types.ExternalFunction("sigpending", types.int32(types.intp))


def _store(typing_context: Any, link: Any, index: Any, value: Any) -> Any:
    """Store a number in a shared int64 array after everything that was stored before it."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        builder.store_atomic(arguments[2], builder.gep(array.data, [arguments[1]]), "release", 8)
        return context.get_dummy_value()

    return types.void(types.int64[::1], types.intp, types.int64), generate


_publish: Any = intrinsic(_store)


@dataclass(eq=False)
class Loop:
    """Everything that a run changes or reads.

    Attributes:
        calls: the plant (dtype `plant.fmu.CALLS`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        parameters, state: of the cycle.
        segments: the reference.
        records: (N,), dtype `RECORD`, written round and round.
        clock: dtype `hil.clock.CLOCK`; by default the loop runs as fast as it goes.
        script: (n, 3), of a scripted clock.
        link: (16,), what is shared with other processes.
        most_missed: periods missed in a row that end in a controlled stop.
    """

    calls: Record
    imu: Record
    parameters: Record
    state: Record
    segments: Array
    records: Record
    clock: Record = field(default_factory=lambda: new_clock(FREE, 0))
    script: NDArray[np.int64] = field(default_factory=lambda: np.zeros((1, 3), np.int64))
    link: NDArray[np.int64] = field(default_factory=lambda: np.zeros(LINK, np.int64))
    most_missed: int = 10

    def __post_init__(self) -> None:
        self._work: Record = np.zeros((), _WORK)
        self._work["truth"] = np.nan

    def run(self, last: int, filters: PythonFilters | None = None) -> int:
        """Run up to but not including cycle `last`; returns a status, 0 when all is well, and brakes when it is not."""
        if filters is None:
            return self._run(last, _ENDLESS)
        return self._run_python(FmuRig(self), last, _ENDLESS, filters)

    def follow(self, end: int, rig: "Rig | None" = None) -> int:
        """Follow the motion to cycle `end`, stop there, or earlier for a cause, and brake; returns `STOPPED`, or what failed.

        With a rig in Python the loop is one, too.
        """
        if rig is None:
            return self._run(_ENDLESS, end)
        try:
            return self._run_python(rig, _ENDLESS, end)
        except BaseException:
            rig.brake()
            raise

    def load(self, python: bool = False) -> None:
        """Load the machine code of the loop, or of the one in Python, so that nothing is compiled when it runs."""
        parameters, state, clock, link, work = self.parameters, self.state, self.clock, self.link, self._work
        if not python:
            _load(_run, *self._arguments(0, 0))
            return
        timespec, calls = clock["timespec"], self.calls
        _load(now, timespec)
        _load(_begin, parameters, state, clock, self.script, link, work, 0, 0)
        _load(_is_due, parameters, state)
        _load(_compute, parameters, state, self.segments, work, timespec)
        _load(calibrate, parameters, state, work["measurement"])
        _load(_locate_and_control, parameters, state, self.segments, work, timespec)
        _load(_note, parameters, state, self.segments, self.records, clock, link, work, 0)
        _load(_end, self.records, clock, self.script, link, work)
        _load(_catch_up, calls, parameters, 0)
        _load(_read, calls, self.imu, work)
        _load(_checked, 0, 0)
        _load(write_drive_mode, calls, 0)
        _load(write_command, calls, state["command"])
        _load(advance, calls, 0.0)

    def _arguments(self, last: int, end: int) -> tuple[Any, ...]:
        return (
            self.calls, self.imu, self.parameters, self.state, self.segments, self.records, self.clock, self.script, self.link,
            self._work, self.most_missed, last, end,
        )  # fmt: skip

    def _run(self, last: int, end: int) -> int:
        return _run(*self._arguments(last, end))

    def _run_python(self, rig: "Rig", last: int, end: int, filters: PythonFilters | None = None) -> int:
        """The loop of `_run`, in Python."""
        parameters, state, clock, work = self.parameters, self.state, self.clock, self._work
        measurement, stage_ns, timespec = work["measurement"], work["stage_ns"], clock["timespec"]
        status = OK
        while status == OK and state["cycle"] < last:
            status = _begin(parameters, state, clock, self.script, self.link, work, self.most_missed, end)
            if status != OK:
                break
            began = now(timespec)
            status = rig.read(measurement, int(state["missed"]))
            if status == OK and _is_due(parameters, state):
                status = rig.release()
            stage_ns[_SENSE] = now(timespec) - began
            if status == OK and filters is None:
                status = _compute(parameters, state, self.segments, work, timespec)
            elif status == OK and filters is not None:
                t0 = now(timespec)
                calibrate(parameters, state, measurement)
                filters.fuse_legs(state)
                t1 = now(timespec)
                filters.fuse_platform(state)
                stage_ns[_LEGS], stage_ns[_PLATFORM] = t1 - t0, now(timespec) - t1
                status = _locate_and_control(parameters, state, self.segments, work, timespec)
            began = now(timespec)
            if status == OK and (failure := rig.write(state["command"])):
                status = failure + SEND_FAILED - RIG_FAILED
            stage_ns[_SEND] = now(timespec) - began
            _note(parameters, state, self.segments, self.records, clock, self.link, work, status)
            began = now(timespec)
            if status == OK and (failure := rig.advance()):
                status = failure + SEND_FAILED - RIG_FAILED
            stage_ns[_PLANT] = now(timespec) - began
            _end(self.records, clock, self.script, self.link, work)
        if status != OK:
            rig.brake()
        return status


def _load(kernel: Any, *arguments: Any) -> None:
    """Load a kernel's machine code for arguments of these types, or compile it, without running it."""
    type_of: Any = typeof
    kernel.compile(tuple(type_of(argument) for argument in arguments))


def shared_array(count: int, dtype: np.dtype[Any]) -> Any:
    """Zeros (count,) in memory that is shared with the processes forked later."""
    return np.frombuffer(mmap.mmap(-1, count * dtype.itemsize), dtype)


@contextmanager
def prevent_compilation() -> Iterator[None]:
    """Make it an error, as long as the context lasts, if anything would have to be compiled."""

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            raise RuntimeError(f"{event.data['dispatcher']} was to be compiled while the loop is on the clock")

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


class Rig(Protocol):
    """What the loop needs of a rig. Every call returns a status, 0 when all is well, else `RIG_FAILED` plus the rig's own."""

    def read(self, measurement: Array, missed: int) -> int:
        """Write the latest IMU data (3, 7, 3), `missed` periods and one after the last."""

    def release(self) -> int:
        """Release the brakes: from now on the drives follow the commands."""

    def write(self, command: Array) -> int:
        """Command the drives' velocities (6,) [m/s]."""

    def advance(self) -> int:
        """After the command: what the rig does until the next period; a real one nothing."""

    def brake(self) -> int:
        """Stop the drives on their brakes, whatever has happened."""


class FmuRig:
    """The plant behind a loop's `calls`, for loops in Python."""

    def __init__(self, loop: Loop) -> None:
        self._loop = loop

    def read(self, measurement: Array, missed: int) -> int:
        """Let the plant move for missed periods, and read it."""
        loop = self._loop
        if loop.state["cycle"] == 0:
            write_drive_mode(loop.calls, BRAKE)
        status = _catch_up(loop.calls, loop.parameters, missed)
        return status or _read(loop.calls, loop.imu, loop._work)

    def release(self) -> int:
        """Release the drives."""
        return _checked(write_drive_mode(self._loop.calls, VELOCITY), RIG_FAILED)

    def write(self, command: Array) -> int:
        """Command the drives."""
        return _checked(write_command(self._loop.calls, command), RIG_FAILED)

    def advance(self) -> int:
        """Let the plant move for a period."""
        return _checked(advance(self._loop.calls, float(self._loop.parameters["period"])), RIG_FAILED)

    def brake(self) -> int:
        """Brake the drives."""
        return _checked(write_drive_mode(self._loop.calls, BRAKE), RIG_FAILED)


@kernel
def _checked(status: int, offset: int) -> int:
    return offset + status if status else OK


@kernel
def _begin(
    parameters: Record, state: Record, clock: Record, script: NDArray[np.int64], link: NDArray[np.int64], work: Record,
    most_missed: int, end: int,
) -> int:  # fmt: skip
    """Wait for the next period, take note of missed ones, and stop where that is due; returns a status."""
    c, s = clock[()], state[()]
    if c.cycles == 0:
        start(clock)
    missed = wait(clock, script)
    if missed < 0:
        return CLOCK_FAILED
    skip(state, missed)
    work[()].cycle = s.cycle
    work[()].stage_ns[:] = 0
    if link[STOP] != 0:
        begin_stop(parameters, state, ASKED_TO_STOP)
    if c.in_a_row >= most_missed:
        begin_stop(parameters, state, MISSED_PERIODS)
    if c.mode == REAL and c.cycles % max(_LOOK_NS // c.period, 1) == 0:
        signals = work[()].signals
        if _sigpending(signals.ctypes.data) == 0 and signals[0] & _SIGNALS != 0:
            begin_stop(parameters, state, ASKED_TO_STOP)
        if link[SUPERVISOR] != 0 and _getppid() != link[SUPERVISOR]:
            begin_stop(parameters, state, SUPERVISOR_GONE)
    if s.cycle >= end:
        begin_stop(parameters, state, END_OF_MOTION)
    return STOPPED if has_stopped(state) else OK


@kernel
def _catch_up(calls: Record, parameters: Record, missed: int) -> int:
    """Let the plant move for the periods that were missed."""
    status = 0
    for _ in range(missed):
        status |= advance(calls, parameters[()].period)
    return _checked(status, RIG_FAILED)


@kernel
def _read(calls: Record, imu: Record, work: Record) -> int:
    """Read the plant through the IMUs' imperfections."""
    status = read_imus(calls) | read_truth(calls)
    measure(imu, calls[()].imu, work[()].measurement)
    work[()].truth[:] = calls[()].truth
    return _checked(status, RIG_FAILED)


@kernel
def _is_due(parameters: Record, state: Record) -> bool:
    """Whether the drives are to be released in this cycle; said once."""
    p, s = parameters[()], state[()]
    due = s.driving == 0 and s.cycle >= p.hold_cycles
    if due:
        s.driving = 1
    return bool(due)


@kernel
def _compute(parameters: Record, state: Record, segments: Array, work: Record, timespec: NDArray[np.int64]) -> int:
    """The steps of `controller.cycle.cycle`, with the clock read in between."""
    measurement, stage_ns = work[()].measurement, work[()].stage_ns
    t0 = now(timespec)
    calibrate(parameters, state, measurement)
    fuse_legs(parameters, state)
    t1 = now(timespec)
    fuse_platform(parameters, state)
    fuse_heading(parameters, state)
    stage_ns[_LEGS], stage_ns[_PLATFORM] = t1 - t0, now(timespec) - t1
    return _locate_and_control(parameters, state, segments, work, timespec)


@kernel
def _locate_and_control(parameters: Record, state: Record, segments: Array, work: Record, timespec: NDArray[np.int64]) -> int:
    stage_ns = work[()].stage_ns
    t0 = now(timespec)
    conditioning = find_pose(parameters, state)
    t1 = now(timespec)
    found = conditioning >= RANK_TOLERANCE and improve_pose(parameters, state)
    t2 = now(timespec)
    known = fuse_mechanism(parameters, state, found)
    t3 = now(timespec)
    status = control(parameters, state, segments) if known else POSE_LOST
    t4 = now(timespec)
    stage_ns[_POSE], stage_ns[_REFINEMENT], stage_ns[_MECHANISM], stage_ns[_CONTROL] = t1 - t0, t2 - t1, t3 - t2, t4 - t3
    return status


@kernel
def _note(
    parameters: Record, state: Record, segments: Array, records: Record, clock: Record, link: NDArray[np.int64], work: Record,
    status: int,
) -> None:  # fmt: skip
    """After the command: record the cycle, and prepare the next reference."""
    p, s, c, w = parameters[()], state[()], clock[()], work[()]
    began = now(c.timespec)
    head = link[HEAD]
    record = records[head % records.shape[0]]
    record.cycle = w.cycle
    record.time_ns = c.woke - c.start if c.mode != FREE else np.int64(np.rint(1e9 * p.period * w.cycle))
    record.late_ns = c.late
    record.missed = s.missed
    record.status = status
    record.stop = s.stopping
    record.imus = s.heading_used << IMU_COUNT
    for k in range(IMU_COUNT):
        record.imus |= s.imu_used[k] << k
    record.trusted = s.filter_trusted
    record.angular_velocity[:] = w.measurement[0]
    record.specific_force[:] = w.measurement[1]
    record.magnetic_field[:] = w.measurement[2]
    record.position[:] = s.position
    record.rotation[:] = s.rotation
    record.conditioning = s.conditioning
    record.lengths[:] = s.lengths
    record.reference[:] = s.reference
    record.command[:] = s.command
    record.truth[:] = w.truth
    for k in range(LEGS):
        for i in range(3):
            record.residuals[k, i] = s.directions[k, i] - s.predicted[k, i] if s.leg_used[k] != 0.0 else np.nan
    w.factor[:] = s.information
    if s.filter_trusted != 0:
        extrapolate_covariance(p.filter, s.filter, s.cycle * p.period, w.covariance)
        record.covariance[:] = w.covariance
    elif factor_cholesky(w.factor):
        invert_cholesky(w.factor, w.covariance)
        record.covariance[:] = w.covariance
    else:
        record.covariance[:] = np.nan
    prepare(parameters, state, segments)
    w.stage_ns[_RECORD] = now(c.timespec) - began


@kernel
def _end(records: Record, clock: Record, script: NDArray[np.int64], link: NDArray[np.int64], work: Record) -> None:
    """End the cycle: set the next deadline, complete the record, and let others see it."""
    head = link[HEAD]
    link[START] = clock[()].start
    record = records[head % records.shape[0]]
    record.stage_ns[:] = work[()].stage_ns
    record.cpu_ns = finish(clock, script, record.stage_ns.sum())
    _publish(link, HEAD, head + 1)


@kernel
def _run(
    calls: Record, imu: Record, parameters: Record, state: Record, segments: Array, records: Record, clock: Record,
    script: NDArray[np.int64], link: NDArray[np.int64], work: Record, most_missed: int, last: int, end: int,
) -> int:  # fmt: skip
    s, c, stage_ns, timespec = state[()], clock[()], work[()].stage_ns, clock[()].timespec
    status = OK
    while status == OK and s.cycle < last:
        status = _begin(parameters, state, clock, script, link, work, most_missed, end)
        if status != OK:
            break
        if s.cycle == 0:
            write_drive_mode(calls, BRAKE)
        # A real rig would have moved on by itself, so this is no stage of the cycle.
        status = _catch_up(calls, parameters, s.missed)
        began = c.woke if c.mode == REAL and s.missed == 0 else now(timespec)
        if status == OK:
            status = _read(calls, imu, work)
        if status == OK and _is_due(parameters, state):
            status = _checked(write_drive_mode(calls, VELOCITY), RIG_FAILED)
        stage_ns[_SENSE] = now(timespec) - began
        if status == OK:
            status = _compute(parameters, state, segments, work, timespec)
        began = now(timespec)
        if status == OK:
            status = _checked(write_command(calls, s.command), SEND_FAILED)
        stage_ns[_SEND] = now(timespec) - began
        _note(parameters, state, segments, records, clock, link, work, status)
        began = now(timespec)
        if status == OK:
            status = _checked(advance(calls, parameters[()].period), SEND_FAILED)
        stage_ns[_PLANT] = now(timespec) - began
        _end(records, clock, script, link, work)
    if status != OK:
        write_drive_mode(calls, BRAKE)
    return status
