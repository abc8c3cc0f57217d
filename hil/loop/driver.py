"""The loop around the cycle: wait for the clock, exchange with the rig, run the cycle, record.

The compiled loop is `run_loop`. The same steps in Python serve rigs and stages that are written in Python, and a loop that is
stepped from outside.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from controller.cycle import CycleStage, react, run_stages
from controller.planning.plan_handover import STREAM_READER
from controller.safety.causes import Cause, Mode
from hil.loop.compiled_loop import begin_cycle, end_cycle, exchange_fmu, periods_passed, process_feedback, run_loop
from hil.loop.own_stages import Cycle, Replacement
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
    failure: str = ""  # what a rig or a stage in Python has raised, in words
    error: BaseException | None = None  # that a stage in Python has raised

    def __post_init__(self) -> None:
        self._failed, self._skips, self._broken = Cause.NONE.value, False, False
        self._stream_reader: Record = np.zeros((), STREAM_READER)
        self._work: Record = np.zeros((), WORK)
        self._work["feedback"], self._work["sequence"] = new_feedback(), -1
        self._work["base_imu_sequence"] = -1

    @property
    def loops(self) -> Record:
        """The position loops of the simulated plant's drives (dtype `POSITION_LOOPS`)."""
        return self._work["loops"][()]

    @property
    def cycle(self) -> Cycle:
        """What the loop knows, in a view that changes with it."""
        return Cycle(self.parameters, self.state, self._work["feedback"])

    def run(self, last: int, replacements: Sequence[Replacement] = ()) -> int:
        """Run up to, not including, cycle `last`; returns 0, or the cause if the run has ended on the brakes."""
        if not replacements:
            return run_loop(*self._arguments(last, _ENDLESS))
        return self._run_python(FmuRig(self), last, _ENDLESS, replacements)

    def follow(self, end: int, rig: Rig | None = None, replacements: Sequence[Replacement] = ()) -> int:
        """Follow the motion to cycle `end` and stop there, or earlier for a cause; returns the cause."""
        if rig is None:
            return run_loop(*self._arguments(_ENDLESS, end))
        try:
            return self._run_python(rig, _ENDLESS, end, replacements)
        except BaseException:
            stop_quickly(rig)
            raise

    def sense(self, rig: Rig, end: int = _ENDLESS) -> int:
        """Begin a cycle: wait for its time, and exchange with the rig; returns the cause if the run has ended on the brakes.

        Of a cycle that has begun, `compute` runs stages, and `finish` the rest.
        """
        clock, work = self.clock, self._work
        cause: int = begin_cycle(
            self.parameters, self.state, clock, self.script, self.link, work, self._streamed(), self.most_missed, end
        )
        if cause != Cause.NONE:
            stop_quickly(rig)
            return cause
        began = now(clock["timespec"])
        status = self._exchange(rig, int(self.state["safety"]["request"]), work["feedback"][()])
        work["stage_ns"][Stage.SENSE] = now(clock["timespec"]) - began
        self._failed = process_feedback(self.parameters, self.state, work, status)
        # After a fault the stages only ramp the commands down.
        self._skips = self._failed != Cause.NONE or self.state["safety"]["mode"] == Mode.FAULT
        self._broken = False
        return cause

    def compute(self, first: CycleStage, last: CycleStage, replacements: Sequence[Replacement] = ()) -> None:
        """Run the stages from `first` up to, not including, `last`, and the replacements that come before `last`."""
        for each in replacements:
            if first <= each.before < last and not self._skips:
                self._run_stages(first, each.before)
                self.replace(each)
                first = each.then
        self._run_stages(first, last)

    def replace(self, replacement: Replacement) -> None:
        """Let a replacement run, unless another one has failed in this cycle; one that fails ends the run by a quick stop."""
        if self._broken or self._skips:
            return
        timespec = self.clock["timespec"]
        began = now(timespec)
        try:
            replacement.run()
        except (Exception, SystemExit) as error:
            self._broken, self.failure, self.error = True, f"{type(error).__name__}: {error}", error
            react(self.parameters, self.state, Cause.STAGE_FAILED.value, -1, np.nan, np.nan)
        self._work["marks"]["ns"][replacement.of] += now(timespec) - began

    def finish(self, first: CycleStage, replacements: Sequence[Replacement] = ()) -> None:
        """Run the stages from `first` on, and end the cycle."""
        self.compute(first, CycleStage.END, replacements)
        end_cycle(
            self.parameters, self.state, self.segments, self.records, self.clock, self.script, self.link, self._work,
            self._streamed(), self._failed,
        )  # fmt: skip

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
            (react, *cycle, Cause.NONE.value, -1, np.nan, np.nan),
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

    def _run_python(self, rig: Rig, last: int, end: int, replacements: Sequence[Replacement] = ()) -> int:
        cause = Cause.NONE.value
        while cause == Cause.NONE and self.state["time"]["cycle"] < last:
            cause = self.sense(rig, end)
            if cause == Cause.NONE:
                self.finish(CycleStage.SCREENING, replacements)
        return cause

    def _run_stages(self, first: CycleStage, last: CycleStage) -> None:
        if self._failed == Cause.NONE and first < last and (first == CycleStage.SCREENING or not self._skips):
            measurement, marks = self._work["feedback"]["measurement"], self._work["marks"][()]
            self._failed = run_stages(
                self.parameters, self.state, measurement, self.segments, marks, first.value, last.value
            )  # fmt: skip

    def _exchange(self, rig: Rig, request: int, feedback: Record) -> int:
        try:
            return int(rig.exchange(self.state["pid"]["command"], request, feedback))
        except Exception as error:
            self.failure = self.failure or f"{type(error).__name__}: {error}"
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
            name = event.data["dispatcher"]
            raise RuntimeError(f"{name} was to be compiled while the loop is on the clock: call it once before the run")

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
