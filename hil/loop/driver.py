"""The loop around the cycle: wait for the clock, exchange with the rig, run the cycle, record.

The compiled loop is `run_loop`. The same steps in Python serve rigs and filters that are written in Python.
"""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from controller.cycle import CycleStage, run_stages
from controller.planning.plan_handover import STREAM_READER
from controller.safety.causes import Cause, Mode
from hil.loop.compiled_loop import begin_cycle, end_cycle, exchange_fmu, periods_passed, process_feedback, run_loop
from hil.loop.records import LINK_SIZE, STAGES, WORK, Stage, TargetStream
from hil.realtime.clock import FREE, new_clock
from hil.rigs import SILENT, Identity, Rig, new_feedback
from hil.rigs.udp.emulator import UdpEmulator
from hil.rigs.udp.link import UdpLink
from plant.compiled import Record, load_kernels
from plant.dynamics.variables import BRAKE
from plant.fmu.calls import write_drive_mode
from plant.pose import Array
from plant.stopwatch import now


class PythonFilters(Protocol):
    """Stages in Python that replace the compiled filters of legs and platform. They change the cycle's state."""

    def step_legs(self, state: Record) -> None:
        """In place of `controller.estimation.leg_filter.step_leg_filters`."""

    def step_platform(self, state: Record) -> None:
        """In place of `controller.estimation.platform_filter.step_platform_filter`."""


_RAISED = SILENT + 1
_ENDLESS = np.iinfo(np.int64).max


@dataclass(eq=False)
class Loop:
    """Everything that a run changes or reads; by default on a clock that never waits."""

    fmu: Record  # dtype `FMU_HANDLE`
    imu: Record  # dtype `IMU_STATE`
    encoders: Record  # dtype `ENCODER_STATE`
    parameters: Record
    state: Record
    segments: Array
    records: Record  # (N,), a ring buffer
    clock: Record = field(default_factory=lambda: new_clock(FREE, 0))
    script: NDArray[np.int64] = field(default_factory=lambda: np.zeros((1, 3), np.int64))
    link: NDArray[np.int64] = field(default_factory=lambda: np.zeros(LINK_SIZE, np.int64))
    most_missed: int = 10  # periods in a row, before a controlled stop
    udp: UdpLink | None = None  # replaces the plant
    emulator: UdpEmulator | None = None  # the other side of `udp`, if it is in memory
    stream: Record | None = None  # of a streamed target
    failure: str = ""  # what a rig in Python has raised

    def __post_init__(self) -> None:
        self._stream_reader: Record = np.zeros((), STREAM_READER)
        self._work: Record = np.zeros((), WORK)
        self._work["feedback"], self._work["sequence"] = new_feedback(), -1
        self._work["base_imu_sequence"] = -1

    @property
    def loops(self) -> Record:
        """The position loops of the simulated plant's drives (dtype `POSITION_LOOPS`)."""
        return self._work["loops"][()]

    def run(self, last: int, filters: PythonFilters | None = None) -> int:
        """Run up to, not including, cycle `last`; returns 0, or the cause if the run has ended on the brakes."""
        if filters is None:
            return run_loop(*self._arguments(last, _ENDLESS))
        return self._run_python(FmuRig(self), last, _ENDLESS, filters)

    def follow(self, end: int, rig: Rig | None = None) -> int:
        """Follow the motion to cycle `end` and stop there, or earlier for a cause; returns the cause."""
        if rig is None:
            return run_loop(*self._arguments(_ENDLESS, end))
        try:
            return self._run_python(rig, _ENDLESS, end)
        except BaseException:
            stop_quickly(rig)
            raise

    def memory(self) -> dict[str, Record]:
        """The arrays on which the rest of a run depends, except the plant's."""
        return {
            "imu": self.imu,
            "encoders": self.encoders,
            "state": self.state,
            "clock": self.clock,
            "link": self.link,
            "work": self._work,
        }

    def load(self, python: bool = False) -> None:
        """Load the machine code of the loop, or of the one in Python."""
        if not python:
            load_kernels((run_loop, *self._arguments(0, 0)))
            return
        cycle, work, segments, clock = (self.parameters, self.state), self._work, self.segments, self.clock
        shared = self.script, self.link, work, self._streamed()
        stages = CycleStage.SCREENING.value, CycleStage.END.value
        load_kernels(
            (now, clock["timespec"]),
            (begin_cycle, *cycle, clock, *shared, self.most_missed, 0),
            (process_feedback, *cycle, work, 0),
            (run_stages, *cycle, work["feedback"]["measurement"], segments, work["marks"][()], *stages),
            (end_cycle, *cycle, segments, self.records, clock, *shared, 0),
        )

    def _arguments(self, last: int, end: int) -> tuple[Any, ...]:
        plant = (self.fmu, self.imu, self.encoders) if self.udp is None else (None, None, None)
        return (
            *plant, self.udp, self.emulator, self.parameters, self.state, self.segments, self.records, self.clock, self.script,
            self.link, self._work, self._streamed(), self.most_missed, last, end,
        )  # fmt: skip

    def _streamed(self) -> TargetStream | None:
        return None if self.stream is None else TargetStream(self.stream, self._stream_reader)

    def _run_python(self, rig: Rig, last: int, end: int, filters: PythonFilters | None = None) -> int:
        parameters, state, clock, work, streamed = self.parameters, self.state, self.clock, self._work, self._streamed()
        feedback, timespec, safety, segments = work["feedback"][()], clock["timespec"], state["safety"], self.segments
        measurement, marks, cause = feedback["measurement"], work["marks"][()], Cause.NONE.value
        while cause == Cause.NONE and state["time"]["cycle"] < last:
            cause = begin_cycle(parameters, state, clock, self.script, self.link, work, streamed, self.most_missed, end)
            if cause != Cause.NONE:
                break
            began = now(timespec)
            status = self._exchange(rig, int(safety["request"]), feedback)
            work["stage_ns"][Stage.SENSE] = now(timespec) - began
            failed = process_feedback(parameters, state, work, status)
            if not failed:
                first = CycleStage.SCREENING.value
                if filters is not None and safety["mode"] != Mode.FAULT:
                    run_stages(parameters, state, measurement, segments, marks, first, CycleStage.LEGS.value)
                    t0 = now(timespec)
                    filters.step_legs(state)
                    t1 = now(timespec)
                    filters.step_platform(state)
                    marks["ns"][CycleStage.LEGS], marks["ns"][CycleStage.PLATFORM] = t1 - t0, now(timespec) - t1
                    first = CycleStage.HEADING.value
                failed = run_stages(parameters, state, measurement, segments, marks, first, CycleStage.END.value)
            end_cycle(parameters, state, segments, self.records, clock, self.script, self.link, work, streamed, failed)
        if cause != Cause.NONE:
            stop_quickly(rig)
        return cause

    def _exchange(self, rig: Rig, request: int, feedback: Record) -> int:
        try:
            return int(rig.exchange(self.state["pid"]["command"], request, feedback))
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
            return _RAISED


def stop_quickly(rig: Rig) -> None:
    """Stop a rig's drives; no exception hides the reason for the stop."""
    with suppress(Exception):
        rig.quick_stop()


@contextmanager
def prevent_compilation() -> Iterator[None]:
    """Raise an error if anything is compiled while the context lasts."""

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            raise RuntimeError(f"{event.data['dispatcher']} was to be compiled while the loop is on the clock")

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        yield


class FmuRig:
    """A loop's plant as a rig in Python."""

    command_delay = 0.0

    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self._stage_ns, self._timespec = np.zeros(len(STAGES), np.int64), np.zeros(2, np.int64)

    def open(self) -> None:
        """Load the machine code that drives the plant."""
        loop, feedback = self._loop, new_feedback()[()]
        command, work = loop.state["pid"]["command"], (feedback, self._stage_ns, self._timespec)
        load_kernels(
            (periods_passed, loop.state),
            (exchange_fmu, loop.fmu, loop.imu, loop.encoders, loop.loops, command, 0, 0, 0.0, *work),
            (write_drive_mode, loop.fmu, BRAKE),
        )

    def identify(self) -> Identity:
        """The plant has no parts."""
        return Identity("FMU")

    def arm(self) -> None:
        """Nothing: the drives are always ready."""

    def exchange(self, command: Array, request: int, feedback: Record) -> int:
        """Drive the plant for the periods that have passed, and read it."""
        loop = self._loop
        periods, period = periods_passed(loop.state), float(loop.parameters["rig"]["period"])
        stage_ns, timespec = self._stage_ns, self._timespec
        return exchange_fmu(
            loop.fmu, loop.imu, loop.encoders, loop.loops, command, request, periods, period, feedback, stage_ns, timespec
        )  # fmt: skip

    def quick_stop(self) -> None:
        """Brake the drives."""
        write_drive_mode(self._loop.fmu, BRAKE)

    def close(self) -> None:
        """Nothing."""
