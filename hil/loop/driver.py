"""The loop around the cycle: wait for the clock, exchange with the rig, run the cycle, record. Compiled.

All state lies in the arrays of `Loop`, so a run can be taken up again at any cycle. The same steps in Python serve rigs, and
filters, that are written in Python.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numba import typeof
from numba.core import event
from numpy.typing import NDArray

from controller.cycle import END, HEADING, LEGS, PLATFORM, SCREENING, run_stages
from controller.planning.stream import STREAM, STREAM_READER
from controller.safety.causes import Cause, Mode
from hil.loop.kernels import (
    begin_cycle,
    drive_fmu,
    end_cycle,
    exchange_status,
    periods_passed,
    process_feedback,
    read_fmu,
    record_cycle,
    run_loop,
    write_stage_times,
)
from hil.loop.records import FMU_RIG, LINK_SIZE, WORK, RigHandle, Stage, TargetStream
from hil.realtime.clock import FREE, new_clock
from hil.rigs import SILENT, Identity, Rig, new_feedback
from hil.rigs.emulation.drives import EMULATED
from hil.rigs.udp.emulator import UdpEmulator, new_udp_emulator
from hil.rigs.udp.link import UdpLink, new_link
from plant.compiled import Record
from plant.dynamics.variables import BRAKE
from plant.fmu.calls import write_drive_mode
from plant.pose import Array
from plant.stopwatch import now


class PythonFilters(Protocol):
    """Stages in Python in place of the compiled filters of legs and platform; they change the cycle's state."""

    def step_legs(self, state: Record) -> None:
        """In place of `controller.estimation.leg_filter.step_leg_filters`."""

    def step_platform(self, state: Record) -> None:
        """In place of `controller.estimation.platform_filter.step_platform_filter`."""


_RAISED = SILENT + 1
_ENDLESS = np.iinfo(np.int64).max
STREAM_PATIENCE_S = 0.1
"""How long a streamed target may be silent [s]."""


@dataclass(eq=False)
class Loop:
    """Everything that a run changes or reads.

    Attributes:
        fmu: the plant (dtype `plant.fmu.calls.FMU_HANDLE`).
        imu: the IMUs' imperfections (dtype `plant.imu.IMU_STATE`).
        parameters, state: of the cycle.
        kind, udp, emulator: as in `RigHandle`; by default the rig is the plant itself.
        stream: of a streamed target (dtype `controller.planning.stream.STREAM`), None without one.
        failure: what a rig in Python has raised.
        segments: the reference.
        records: (N,), dtype `RECORD`, written round and round.
        clock: dtype `hil.realtime.clock.CLOCK`; by default the loop runs as fast as it goes.
        script: (n, 3), of a scripted clock.
        link: (16,), what is shared with other processes.
        most_missed: periods missed in a row that end in a controlled stop.
    """

    fmu: Record
    imu: Record
    parameters: Record
    state: Record
    segments: Array
    records: Record
    clock: Record = field(default_factory=lambda: new_clock(FREE, 0))
    script: NDArray[np.int64] = field(default_factory=lambda: np.zeros((1, 3), np.int64))
    link: NDArray[np.int64] = field(default_factory=lambda: np.zeros(LINK_SIZE, np.int64))
    most_missed: int = 10
    kind: int = FMU_RIG
    udp: UdpLink = field(default_factory=new_link)
    emulator: UdpEmulator | None = None
    stream: Record | None = None
    failure: str = ""

    def __post_init__(self) -> None:
        self._reader: Record = np.zeros((), STREAM_READER)
        self._work: Record = np.zeros((), WORK)
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
            _load(run_loop, *self._arguments(0, 0))
            return
        timespec, fmu = clock["timespec"], self.fmu
        _load(now, timespec)
        _load(begin_cycle, parameters, state, clock, self.script, link, work, self._streamed(), 0, 0)
        _load(process_feedback, parameters, state, work, 0)
        _load(run_stages, parameters, state, work["feedback"]["measurement"], self.segments, work["marks"][()], 0, 0)
        _load(write_stage_times, work)
        _load(record_cycle, parameters, state, self.segments, self.records, clock, link, work, self._streamed(), 0)
        _load(end_cycle, self.records, clock, self.script, link, work)
        _load(periods_passed, state)
        _load(drive_fmu, fmu, state["pid"]["command"], 0, 0, 0.0)
        _load(read_fmu, fmu, self.imu, state["pid"]["command"], 0, work["feedback"][()])
        _load(exchange_status, 0)
        _load(write_drive_mode, fmu, 0)

    def _arguments(self, last: int, end: int) -> tuple[Any, ...]:
        emulator = self.emulator or new_udp_emulator(self.fmu, self.imu, np.zeros((), EMULATED))
        return (
            RigHandle(self.kind, self.fmu, self.imu, self.udp, emulator), self.parameters, self.state, self.segments,
            self.records, self.clock, self.script, self.link, self._work, self._streamed(), self.most_missed, last, end,
        )  # fmt: skip

    def _streamed(self) -> TargetStream:
        active = self.stream is not None
        stream = self.stream if active else np.zeros((), STREAM)
        return TargetStream(int(active), round(1e9 * STREAM_PATIENCE_S), stream, self._reader)

    def _run(self, last: int, end: int) -> int:
        return run_loop(*self._arguments(last, end))

    def _run_python(self, rig: Rig, last: int, end: int, filters: PythonFilters | None = None) -> int:
        """The loop of `_run`, in Python."""
        parameters, state, clock, work, streamed = self.parameters, self.state, self.clock, self._work, self._streamed()
        feedback, stage_ns, timespec, safety = work["feedback"][()], work["stage_ns"], clock["timespec"], state["safety"]
        measurement, marks, cause = feedback["measurement"], work["marks"][()], Cause.NONE.value
        while cause == Cause.NONE and state["time"]["cycle"] < last:
            cause = begin_cycle(parameters, state, clock, self.script, self.link, work, streamed, self.most_missed, end)
            if cause != Cause.NONE:
                break
            began = now(timespec)
            status = self._exchange(rig, int(safety["request"]), feedback)
            stage_ns[Stage.SENSE] = now(timespec) - began
            failed = process_feedback(parameters, state, work, status)
            if not failed:
                first = SCREENING
                if filters is not None and safety["mode"] != Mode.FAULT:
                    run_stages(parameters, state, measurement, self.segments, marks, SCREENING, LEGS)
                    t0 = now(timespec)
                    filters.step_legs(state)
                    t1 = now(timespec)
                    filters.step_platform(state)
                    marks["ns"][LEGS], marks["ns"][PLATFORM] = t1 - t0, now(timespec) - t1
                    first = HEADING
                failed = run_stages(parameters, state, measurement, self.segments, marks, first, END)
                write_stage_times(work)
            record_cycle(parameters, state, self.segments, self.records, clock, self.link, work, streamed, failed)
            end_cycle(self.records, clock, self.script, self.link, work)
        if cause != Cause.NONE:
            stop_quickly(rig)
        return cause

    def _exchange(self, rig: Rig, request: int, feedback: Record) -> int:
        """An exchange of a rig in Python; whatever it raises is a failure."""
        try:
            return int(rig.exchange(self.state["pid"]["command"], request, feedback))
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
            return _RAISED


def _load(kernel: Any, *arguments: Any) -> None:
    """Load a kernel's machine code for arguments of these types, or compile it, without running it."""
    type_of: Any = typeof
    kernel.compile(tuple(type_of(argument) for argument in arguments))


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
    """The plant behind a loop's `fmu`, for loops in Python."""

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
        status = drive_fmu(loop.fmu, command, request, periods_passed(loop.state), float(loop.parameters["rig"]["period"]))
        return exchange_status(status or read_fmu(loop.fmu, loop.imu, command, request, feedback))

    def quick_stop(self) -> None:
        """Brake the drives."""
        write_drive_mode(self._loop.fmu, BRAKE)

    def close(self) -> None:
        """Nothing."""
