"""The loop around the cycle: wait for the clock, exchange with the rig, run the cycle, record. Compiled.

All state lies in the arrays of `Loop`, so a run can be taken up again at any cycle. The same steps in Python serve rigs, and
filters, that are written in Python.
"""

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numba import typeof, types
from numba.core import event
from numpy.typing import NDArray

from controller.cycle import OK, control, lose_pose, motion_cycle, prepare, skip
from controller.estimation.fusion import (
    calibrate,
    find_pose,
    fuse_heading,
    fuse_legs,
    fuse_mechanism,
    fuse_platform,
    improve_pose,
    monitor_imus,
)
from controller.estimation.mechanism_filter import extrapolate_covariance
from controller.least_squares import RANK_TOLERANCE, factor_cholesky, invert_cholesky
from controller.planning.stream import STREAM, TAKER, stream_cause, take_plan
from controller.safety.watch import (
    ASKED_TO_STOP,
    BRAKED,
    CLOCK_FAILED,
    EMERGENCY_STOP,
    END_OF_MOTION,
    EVENT_SLOTS,
    EVENTS,
    FAULT,
    MISSED_PERIODS,
    REACTION,
    RIG_FAILED,
    SUPERVISOR_GONE,
    coast,
    has_stopped,
    hear,
    react,
)
from hil.realtime.clock import FREE, REAL, finish, new_clock, now, start, wait
from hil.rigs import ANSWERED, FEEDBACK, SILENT, Identity, Rig, new_feedback
from hil.rigs.emulation.drives import EMULATED
from hil.rigs.udp.emulator import UdpEmulator, exchange_in_memory, new_udp_emulator
from hil.rigs.udp.rig import UdpLink, encode_command, exchange_udp, new_link, send_datagram
from plant.compiled import Record, kernel, store_release
from plant.dynamics.variables import BRAKE, IMU_COUNT, VELOCITY
from plant.fmu.plant import CALLS, advance, read_imus, read_truth, write_command, write_drive_mode
from plant.imu import measure
from plant.mechanism import LEGS
from plant.pose import Array

STAGES = (
    "sense",
    "leg filters",
    "platform filter",
    "direct kinematics",
    "refinement",
    "whole mechanism",
    "control",
    "record",
    "plant",
)
"""What a cycle is made of: `sense` is the exchange with the rig, the last commands sent; `leg filters` begin with the
calibration; `control` is inverse kinematics, PID, feed-forward and the watch; `record` is telemetry and the next reference;
`plant` is the simulated one's own time."""

_SENSE, _LEGS, _PLATFORM, _POSE, _REFINEMENT, _MECHANISM, _CONTROL, _RECORD, _PLANT = range(len(STAGES))
COMPUTED, TO_COMMAND = slice(_LEGS, _RECORD), slice(_SENSE, _RECORD)
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
        ("asked", np.int32),
        ("mode", np.int32),
        ("request", np.int32),
        ("silent", np.int32),
        ("drive", np.int32, LEGS),
        ("drive_code", np.int32, LEGS),
        ("sample_age", np.int32, IMU_COUNT),
        ("imus", np.int32),
        ("trusted", np.int32),
        ("sample_ns", np.int64, IMU_COUNT),
        ("round_trip_ns", np.int64),
        ("refused", np.int64),
        ("sent", np.float64, LEGS),
        *EVENTS,
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
"""What is kept of a cycle: the period that it ran in; when it woke [ns since the first] and how late; the stages' durations
and the thread's CPU time; periods missed before it; the cause of a fault that began in it, and of the stop or fault that is
on, and what was asked of it before it; mode and request to the drives (`controller.safety.watch`); what the rig said
(`hil.rigs.FEEDBACK`): for how many cycles it has been silent, the drives, how many cycles old the samples are, their time,
round trip, refused packets, and what was really sent; what happened; which IMUs were used (a bit each, and the eighth for
the platform's magnetometer), and whether the pose is the whole-mechanism filter's; raw IMU data; the pose with covariance
(translation, rotation; in {1}), residuals of the directions and conditioning; lengths, reference (length, rate,
acceleration) and commands, 0 for legs that a planar mechanism has not; and the truth as the plant's `truth` buffer has it.
"""

HEAD, STOP, DONE, TAIL, KEPT, SUPERVISOR, START = range(7)
LINK = 16
"""Places in the array that the loop shares with other processes, int64 (16,): records written, whether, and how,
it shall stop; whether it has ended; where the next recorder goes on, and how many records are in files for good; the process
whose end ends the motion, 0 for none; and the first deadline [ns]."""

CONTROLLED, QUICKLY = 1, 2
"""How the loop shall stop."""


class PythonFilters(NamedTuple):
    """Filters in Python, which take the calibrated sample in the cycle's state and leave there what the compiled ones would.

    Attributes:
        fuse_legs, fuse_platform: in the place of those in `controller.estimation.fusion`.
    """

    fuse_legs: Callable[[Record], None]
    fuse_platform: Callable[[Record], None]


_ENDLESS = np.iinfo(np.int64).max
_RAISED = SILENT + 1
_LOOK_NS = 100_000_000
_SIGQUIT = 1 << 2
_SIGNALS = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 14
"""SIGHUP, SIGINT, SIGQUIT and SIGTERM in a set of signals."""

_WORK = np.dtype(
    [
        ("cycle", np.int64),
        ("asked", np.int64),
        ("silent", np.int64),
        ("sequence", np.int64, IMU_COUNT),
        ("sample_age", np.int64, IMU_COUNT),
        ("feedback", FEEDBACK),
        ("factor", np.float64, (6, 6)),
        ("covariance", np.float64, (6, 6)),
        ("stage_ns", np.int64, len(STAGES)),
        ("signals", np.int64, 16),
    ],
    align=True,
)
_getppid: Any = types.ExternalFunction("getppid", types.int32())
_sigpending: Any = types.ExternalFunction("sigpending", types.int32(types.intp))


FMU_RIG, UDP_RIG, EMULATED_RIG = range(3)
"""What the compiled loop exchanges with: the plant; a rig over UDP; an emulated one over UDP's datagrams, in memory."""


class Port(NamedTuple):
    """The rig as compiled code sees it: which of the three it is, and what each needs.

    Attributes:
        kind: `FMU_RIG`, `UDP_RIG` or `EMULATED_RIG`.
        calls: the plant (dtype `plant.fmu.plant.CALLS`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        link: the controller's side of UDP.
        emulator: the rig's side, in memory.
    """

    kind: int
    calls: Record
    imu: Record
    link: UdpLink
    emulator: UdpEmulator


class Streamed(NamedTuple):
    """A streamed target as compiled code sees it.

    Attributes:
        active: whether there is one.
        patience_ns: how long it may be silent.
        stream, taker: dtypes `controller.planning.stream.STREAM` and `TAKER`.
    """

    active: int
    patience_ns: int
    stream: Record
    taker: Record


STREAM_PATIENCE_S = 0.1
"""How long a streamed target may be silent [s]."""


@dataclass(eq=False)
class Loop:
    """Everything that a run changes or reads.

    Attributes:
        calls: the plant (dtype `plant.fmu.plant.CALLS`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        parameters, state: of the cycle.
        kind, udp, emulator: as in `Port`; by default the rig is the plant itself.
        stream: of a streamed target (dtype `controller.planning.stream.STREAM`), None without one.
        failure: what a rig in Python has raised.
        segments: the reference.
        records: (N,), dtype `RECORD`, written round and round.
        clock: dtype `hil.realtime.clock.CLOCK`; by default the loop runs as fast as it goes.
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
    kind: int = FMU_RIG
    udp: UdpLink = field(default_factory=new_link)
    emulator: UdpEmulator | None = None
    stream: Record | None = None
    failure: str = ""

    def __post_init__(self) -> None:
        self._taker: Record = np.zeros((), TAKER)
        self._work: Record = np.zeros((), _WORK)
        self._work["feedback"], self._work["sequence"] = new_feedback(), -1

    def run(self, last: int, filters: PythonFilters | None = None) -> int:
        """Run up to but not including cycle `last`; returns 0, or the cause for which the run has ended on the brakes."""
        if filters is None:
            return self._run(last, _ENDLESS)
        return self._run_python(FmuRig(self), last, _ENDLESS, filters)

    def follow(self, end: int, rig: Rig | None = None) -> int:
        """Follow the motion to cycle `end`, stop there, or earlier for a cause, and brake; returns the cause.

        With a rig in Python the loop is one, too.
        """
        if rig is None:
            return self._run(_ENDLESS, end)
        try:
            return self._run_python(rig, _ENDLESS, end)
        except BaseException:
            stop_quickly(rig)
            raise

    def memory(self) -> dict[str, Record]:
        """All arrays on which the rest of a run depends and that it changes, but for those of the plant."""
        return {"imu": self.imu, "state": self.state, "clock": self.clock, "link": self.link, "work": self._work}

    def load(self, python: bool = False) -> None:
        """Load the machine code of the loop, or of the one in Python, so that nothing is compiled when it runs."""
        parameters, state, clock, link, work = self.parameters, self.state, self.clock, self.link, self._work
        if not python:
            _load(_run, *self._arguments(0, 0))
            return
        timespec, calls = clock["timespec"], self.calls
        _load(now, timespec)
        _load(_begin, parameters, state, clock, self.script, link, work, self._streamed(), 0, 0)
        _load(_hear, parameters, state, work, 0)
        _load(coast, parameters, state)
        _load(_compute, parameters, state, self.segments, work, timespec)
        _load(calibrate, parameters, state, work["feedback"]["measurement"])
        _load(_locate_and_control, parameters, state, self.segments, work, timespec)
        _load(_note, parameters, state, self.segments, self.records, clock, link, work, self._streamed(), 0)
        _load(_end, self.records, clock, self.script, link, work)
        _load(periods_passed, state)
        _load(drive_fmu, calls, state["command"], 0, 0, 0.0)
        _load(read_fmu, calls, self.imu, state["command"], 0, work["feedback"][()])
        _load(_checked, 0)
        _load(write_drive_mode, calls, 0)

    def _arguments(self, last: int, end: int) -> tuple[Any, ...]:
        emulator = self.emulator or new_udp_emulator(self.calls, self.imu, np.zeros((), EMULATED))
        return (
            Port(self.kind, self.calls, self.imu, self.udp, emulator), self.parameters, self.state, self.segments, self.records,
            self.clock, self.script, self.link, self._work, self._streamed(), self.most_missed, last, end,
        )  # fmt: skip

    def _streamed(self) -> Streamed:
        active = self.stream is not None
        stream = self.stream if active else np.zeros((), STREAM)
        return Streamed(int(active), round(1e9 * STREAM_PATIENCE_S), stream, self._taker)

    def _run(self, last: int, end: int) -> int:
        return _run(*self._arguments(last, end))

    def _run_python(self, rig: Rig, last: int, end: int, filters: PythonFilters | None = None) -> int:
        """The loop of `_run`, in Python."""
        parameters, state, clock, work, streamed = self.parameters, self.state, self.clock, self._work, self._streamed()
        feedback, stage_ns, timespec, safety = work["feedback"][()], work["stage_ns"], clock["timespec"], state["safety"]
        cause = OK
        while cause == OK and state["cycle"] < last:
            cause = _begin(parameters, state, clock, self.script, self.link, work, streamed, self.most_missed, end)
            if cause != OK:
                break
            began = now(timespec)
            status = self._exchange(rig, int(safety["request"]), feedback)
            stage_ns[_SENSE] = now(timespec) - began
            failed = _hear(parameters, state, work, status)
            if not failed and filters is not None and safety["mode"] != FAULT:
                t0 = now(timespec)
                calibrate(parameters, state, feedback["measurement"])
                filters.fuse_legs(state)
                t1 = now(timespec)
                filters.fuse_platform(state)
                stage_ns[_LEGS], stage_ns[_PLATFORM] = t1 - t0, now(timespec) - t1
                failed = _locate_and_control(parameters, state, self.segments, work, timespec)
            elif not failed:
                failed = _compute(parameters, state, self.segments, work, timespec)
            _note(parameters, state, self.segments, self.records, clock, self.link, work, streamed, failed)
            _end(self.records, clock, self.script, self.link, work)
        if cause != OK:
            stop_quickly(rig)
        return cause

    def _exchange(self, rig: Rig, request: int, feedback: Record) -> int:
        """An exchange of a rig in Python; whatever it raises is a failure."""
        try:
            return int(rig.exchange(self.state["command"], request, feedback))
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
            return _RAISED


def _load(kernel: Any, *arguments: Any) -> None:
    """Load a kernel's machine code for arguments of these types, or compile it, without running it."""
    type_of: Any = typeof
    kernel.compile(tuple(type_of(argument) for argument in arguments))


def shared_array(count: int, dtype: np.dtype[Any]) -> Any:
    """Zeros (count,) in memory that is shared with the processes forked later."""
    return np.frombuffer(mmap.mmap(-1, count * dtype.itemsize), dtype)


def stop_quickly(rig: Rig) -> None:
    """Stop a rig's drives; one that raises here must not hide why."""
    with suppress(Exception):
        rig.quick_stop()


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


class FmuRig:
    """The plant behind a loop's `calls`, for loops in Python."""

    command_delay = 0.0

    def __init__(self, loop: Loop) -> None:
        self._loop = loop

    def open(self) -> None:
        """Nothing: the plant is loaded."""

    def identify(self) -> Identity:
        """The plant has no parts."""
        return Identity("FMU")

    def arm(self) -> None:
        """Nothing: the plant's drives are always ready."""

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Drive the plant for the periods that have passed since the last exchange, and read it."""
        loop = self._loop
        status = drive_fmu(loop.calls, command, request, periods_passed(loop.state), float(loop.parameters["period"]))
        return _checked(status or read_fmu(loop.calls, loop.imu, command, request, feedback))

    def quick_stop(self) -> None:
        """Brake the drives."""
        write_drive_mode(self._loop.calls, BRAKE)

    def close(self) -> None:
        """Nothing."""


@kernel
def drive_fmu(calls: Record, command: Array, request: int, periods: int, period: float) -> int:
    """Let the plant move with the command for so many periods; returns FMI's status."""
    status = write_drive_mode(calls, BRAKE if request == BRAKED else VELOCITY)
    if periods > 0:
        status |= write_command(calls, command)
    for _ in range(periods):
        status |= advance(calls, period)
    return status


@kernel
def read_fmu(calls: Record, imu: Record, command: Array, request: int, feedback: Record) -> int:
    """Read the plant through the IMUs' imperfections; returns FMI's status."""
    status = read_imus(calls) | read_truth(calls)
    measure(imu, calls[()].imu, feedback.measurement)
    feedback.truth[:] = calls[()].truth
    for k in range(LEGS):
        feedback.sent[k] = 0.0 if request == BRAKED else command[k]
    for k in range(IMU_COUNT):
        feedback.sequence[k] += 1
        feedback.sample_ns[k] = np.int64(np.rint(1e9 * calls[()].time))
    return status


@kernel
def _exchange(port: Port, parameters: Record, state: Record, work: Record, timespec: NDArray[np.int64]) -> int:
    """Send the commands of the cycle before, and read the sensors; returns the rig's status."""
    s, w, period = state[()], work[()], parameters[()].period
    t0 = t1 = now(timespec)
    if port.kind == UDP_RIG:
        status = exchange_udp(port.link, s.command, s.safety.request, w.feedback, timespec)
    elif port.kind == EMULATED_RIG:
        at = int(np.rint(1e9 * period * s.cycle))
        status = exchange_in_memory(port.emulator, port.link, s.command, s.safety.request, w.feedback, at)
    else:
        status = drive_fmu(port.calls, s.command, s.safety.request, periods_passed(state), period)
        t1 = now(timespec)
        if status == 0:
            status = read_fmu(port.calls, port.imu, s.command, s.safety.request, w.feedback)
        status = _checked(status)
    w.stage_ns[_PLANT], w.stage_ns[_SENSE] = t1 - t0, now(timespec) - t1
    return status


@kernel
def _hold(port: Port, parameters: Record, state: Record, work: Record, timespec: NDArray[np.int64]) -> None:
    """At the end: the drives hold on their brakes."""
    if port.kind == UDP_RIG:
        encode_command(port.link, state[()].command, BRAKED, now(timespec))
        send_datagram(port.link.socket, port.link.command_bytes, port.link.command_bytes.size)
    elif port.kind == EMULATED_RIG:
        at = int(np.rint(1e9 * parameters[()].period * state[()].cycle))
        exchange_in_memory(port.emulator, port.link, state[()].command, BRAKED, work[()].feedback, at)
    else:
        write_drive_mode(port.calls, BRAKE)


@kernel
def _checked(status: int) -> int:
    """FMI's status as that of an exchange."""
    return SILENT + status if status != 0 else ANSWERED


@kernel
def periods_passed(state: Record) -> int:
    """How many periods have passed since the last exchange; none before the first."""
    s = state[()]
    return 1 + s.missed if s.cycle > 0 else 0


@kernel
def _begin(
    parameters: Record, state: Record, clock: Record, script: NDArray[np.int64], link: NDArray[np.int64], work: Record,
    streamed: Streamed, most_missed: int, end: int,
) -> int:  # fmt: skip
    """Wait for the next period, take note of missed ones, and stop where that is due; returns the cause if the run has
    ended.
    """
    c, s, w = clock[()], state[()], work[()]
    if c.cycles == 0:
        start(clock)
    missed = wait(clock, script)
    w.asked = OK
    if missed < 0:
        _ask(work, CLOCK_FAILED)
        missed = 0
    skip(state, missed)
    w.cycle = s.cycle
    w.stage_ns[:] = 0
    if s.cycle - s.safety.waited >= end:
        _ask(work, END_OF_MOTION)
    if c.mode == REAL and c.cycles % max(_LOOK_NS // c.period, 1) == 0:
        signals = w.signals
        if _sigpending(signals.ctypes.data) == 0 and signals[0] & _SIGNALS != 0:
            _ask(work, ASKED_TO_STOP if signals[0] & _SIGQUIT == 0 else EMERGENCY_STOP)
        if link[SUPERVISOR] != 0 and _getppid() != link[SUPERVISOR]:
            _ask(work, SUPERVISOR_GONE)
    if c.in_a_row >= most_missed:
        _ask(work, MISSED_PERIODS)
    if link[STOP] != 0:
        _ask(work, ASKED_TO_STOP if link[STOP] == CONTROLLED else EMERGENCY_STOP)
    leg, value, limit = -1, np.nan, np.nan
    if streamed.active != 0 and s.stopping == 0 and w.asked == OK:
        cause, leg, value, limit = stream_cause(streamed.stream, c.woke, streamed.patience_ns)
        _ask(work, cause)
    if w.asked == MISSED_PERIODS:
        value, limit = float(c.in_a_row), float(most_missed)
    if w.asked != OK:
        react(parameters, state, w.asked, leg, value, limit)
    return int(s.stopping) if has_stopped(state) else OK


@kernel
def _ask(work: Record, cause: int) -> None:
    """Ask for a reaction; of several causes the gravest counts, and of the same gravity the last."""
    if REACTION[cause] >= REACTION[work[()].asked]:
        work[()].asked = cause


@kernel
def _hear(parameters: Record, state: Record, work: Record, status: int) -> int:
    """After an exchange: note what is new, and react to what the rig has said; returns a cause if the cycle cannot be
    computed.
    """
    w = work[()]
    feedback = w.feedback
    w.silent = w.silent + 1 + state[()].missed if status == SILENT else 0
    for k in range(IMU_COUNT):
        fresh = feedback.sequence[k] != w.sequence[k]
        w.sample_age[k] = 0 if fresh else w.sample_age[k] + 1 + state[()].missed
        w.sequence[k] = feedback.sequence[k]
    if status != ANSWERED and status != SILENT:
        react(parameters, state, RIG_FAILED, -1, status, np.nan)
        coast(parameters, state)
        return RIG_FAILED
    hear(parameters, state, w.sample_age, feedback.drive, w.silent)
    return OK


@kernel
def _compute(parameters: Record, state: Record, segments: Array, work: Record, timespec: NDArray[np.int64]) -> int:
    """The steps of `controller.cycle.cycle`, with the clock read in between."""
    measurement, stage_ns = work[()].feedback.measurement, work[()].stage_ns
    if state[()].safety.mode == FAULT:
        coast(parameters, state)
        return OK
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
    if found:
        monitor_imus(parameters, state)
    t2 = now(timespec)
    known = fuse_mechanism(parameters, state, found)
    t3 = now(timespec)
    cause = control(parameters, state, segments) if known else lose_pose(parameters, state)
    t4 = now(timespec)
    stage_ns[_POSE], stage_ns[_REFINEMENT], stage_ns[_MECHANISM], stage_ns[_CONTROL] = t1 - t0, t2 - t1, t3 - t2, t4 - t3
    return cause


@kernel
def _note(
    parameters: Record, state: Record, segments: Array, records: Record, clock: Record, link: NDArray[np.int64], work: Record,
    streamed: Streamed, failed: int,
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
    record.status = failed
    record.stop = s.stopping
    record.asked = w.asked
    record.mode, record.request = s.safety.mode, s.safety.request
    record.silent = w.silent
    record.drive[:] = w.feedback.drive
    record.drive_code[:] = w.feedback.drive_code
    record.sample_age[:] = w.sample_age
    record.sample_ns[:] = w.feedback.sample_ns
    record.round_trip_ns, record.refused = w.feedback.round_trip_ns, w.feedback.refused
    record.sent[:] = w.feedback.sent
    record.event_count = s.safety.event_count
    for i in range(EVENT_SLOTS):
        told = i < s.safety.event_count
        record.event_cause[i] = s.safety.event_cause[i] if told else 0
        record.event_index[i] = s.safety.event_index[i] if told else 0
        record.event_value[i] = s.safety.event_value[i] if told else 0.0
        record.event_limit[i] = s.safety.event_limit[i] if told else 0.0
    record.imus = s.heading_used << IMU_COUNT
    for k in range(IMU_COUNT):
        record.imus |= s.imu_used[k] << k
    record.trusted = s.filter_trusted
    record.angular_velocity[:] = w.feedback.measurement[0]
    record.specific_force[:] = w.feedback.measurement[1]
    record.magnetic_field[:] = w.feedback.measurement[2]
    record.position[:] = s.position
    record.rotation[:] = s.rotation
    record.conditioning = s.conditioning
    record.lengths[:] = s.lengths
    record.reference[:] = s.reference
    record.command[:] = s.command
    record.truth[:] = w.feedback.truth
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
    if streamed.active != 0 and s.stopping == 0:
        take_plan(streamed.stream, streamed.taker, motion_cycle(parameters, state), p.period, segments, s.reference_index)
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
    store_release(link, HEAD, head + 1)


@kernel
def _run(
    port: Port, parameters: Record, state: Record, segments: Array, records: Record, clock: Record,
    script: NDArray[np.int64], link: NDArray[np.int64], work: Record, streamed: Streamed, most_missed: int, last: int, end: int,
) -> int:  # fmt: skip
    s, timespec = state[()], clock[()].timespec
    cause = OK
    while cause == OK and s.cycle < last:
        cause = _begin(parameters, state, clock, script, link, work, streamed, most_missed, end)
        if cause != OK:
            break
        status = _exchange(port, parameters, state, work, timespec)
        failed = _hear(parameters, state, work, status)
        if failed == OK:
            failed = _compute(parameters, state, segments, work, timespec)
        _note(parameters, state, segments, records, clock, link, work, streamed, failed)
        _end(records, clock, script, link, work)
    if cause != OK:
        _hold(port, parameters, state, work, timespec)
    return cause
