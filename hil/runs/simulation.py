"""A closed-loop simulation: a mechanism follows a target on its FMU plant, as fast as the machine can, or step by step."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.cycle import CycleStage
from controller.direct_kinematics import poses_from_lengths
from controller.frames import ActiveFrames, level_from_base
from controller.planning.offline_planner import Reference
from controller.planning.pace import least_time_scale
from controller.planning.target import Target
from controller.safety.causes import Cause
from hil.loop.driver import FmuRig
from hil.loop.own_stages import Cycle, Replacement, Stages, ordered, replace_command, replacements_of
from hil.loop.records import COMPUTED
from hil.progress import Progress, Say, no_progress, say_nothing
from hil.realtime.durations import QUANTILES, percentiles
from hil.runs.config import SimulationConfig
from hil.runs.figures import error_figures, level_figures
from hil.runs.prepare import PreparedLoop, prepared_loop
from hil.runs.run_state import note_events
from hil.runs.snapshot import Snapshot, resume_snapshot, take_snapshot
from plant.compiled import Record
from plant.dynamics.base_course import attitudes_of, displacements_of, placed
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose, pose_errors, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION, pose_known

Poses = tuple[Array, Array]
"""Positions (N, 3) [m] and rotations (N, 3, 3)."""

_CHUNK_S = 0.1
"""How long the loop may run before it looks for Ctrl-C [s]."""


class SimulationStoppedError(GoughError, RuntimeError):
    """The loop ended early: the message has the cause and the cycle, `result` what was recorded until then."""

    exit_status = 1

    def __init__(self, message: str, result: "SimulationResult") -> None:
        super().__init__(message)
        self.result = result


@dataclass(frozen=True, eq=False, repr=False)
class SimulationResult:
    """What a simulation found.

    Attributes:
        times: (N,) [s]; 0 is where the motion begins, after the hold and the approach to its start.
        records: (N,), dtype `hil.loop.records.RECORD`.
        reference_positions, reference_rotations: (N, 3) [m] and (N, 3, 3), the planned poses; NaN from where on the planned
            lengths belong to no pose near the one before, as they may in a stop.
        target_positions, target_rotations: (N, 3) [m] and (N, 3, 3), the raw target.
        real_time_factor: simulated time over the time that planning and loop took.
        remarks: what was said before it began.
        parameters: the constants of the cycle, for a recording.
        frames: of the target and of read-outs, if there are any.
        attitudes, heaves: (N, 3, 3) and (N, 3) [m], map {1} to the level frame, if the target stands in that or on it.
        stages: module and name of the functions that stood in place of stages, by stage.
    """

    config: SimulationConfig
    mechanism: Mechanism
    target: Target
    reference: Reference
    times: Array
    records: Record
    reference_positions: Array
    reference_rotations: Array
    target_positions: Array
    target_rotations: Array
    real_time_factor: float
    snapshot: Snapshot | None
    remarks: tuple[str, ...]
    parameters: Record | None = None
    frames: ActiveFrames | None = None
    attitudes: Array | None = None
    heaves: Array | None = None
    stages: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        text = f"{self.mechanism.name} follows {self.target.name}: {len(self.times)} cycles at {self.config.rate:g} Hz"
        if not self.moved:
            return f"<{text}, before the motion>"
        kind, what = ("estimation", "truth") if self.truth_known else ("estimated_tracking", "reference")
        return f"<{text}, estimate - {what} {1e3 * self.summary()[kind]['position_rms']:.3f} mm RMS>"

    @property
    def moved(self) -> bool:
        """Whether the run came to the start of the motion, with a reference that is a pose there."""
        first = int(np.searchsorted(self.times, 0.0))
        return first < len(self.times) and bool(np.isfinite(self.reference_positions[first]).all())

    @property
    def truth_known(self) -> bool:
        """Whether the plant gives its true pose."""
        return bool(pose_known(self.records["truth"][:1]).all())

    @property
    def true_positions(self) -> Array:
        """(N, 3) [m]; NaN if the truth is not known."""
        positions: Array = self.records["truth"][:, TRUTH_POSITION]
        return positions

    @property
    def true_rotations(self) -> Array:
        """(N, 3, 3); NaN if the truth is not known."""
        return rotations_from_quaternions(np.ascontiguousarray(self.records["truth"][:, TRUTH_QUATERNION]))

    def read(self, positions: Array, rotations: Array) -> Poses:
        """The poses of the tool in the work frame, from those (N, 3) and (N, 3, 3) of {2} in {1}; without frames just these."""
        if self.frames is None:
            return positions, rotations
        platform = Pose(positions, rotations)
        if self.attitudes is not None and self.heaves is not None:
            platform = level_from_base(platform, self.attitudes)
            platform = replace(platform, position=platform.position + self.heaves)
        tool = self.frames.read(platform)
        return tool.position, tool.rotation

    @property
    def events(self) -> list[str]:
        """What happened, by cycle: the first hundred events."""
        noted: list[str] = []
        note_events(self.records, 1.0 / self.config.rate, noted)
        return noted

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units, over the time of the motion; None for those that need the truth where it is not known.

        What is compared with the reference counts where that is a pose. The errors are those of {2} in {1}; with frames,
        `frames` has the names of the tool and the work frame, and the errors of the one in the other.
        """
        moving = self.times >= 0.0
        poses = {
            "estimate": (self.records["position"], self.records["rotation"]),
            "reference": (self.reference_positions, self.reference_rotations),
            "target": (self.target_positions, self.target_rotations),
        }
        if self.truth_known:
            poses["truth"] = (self.true_positions, self.true_rotations)

        def chosen(read: Callable[[Array, Array], Poses]) -> dict[str, Poses]:
            seen = {name: read(*pose) for name, pose in poses.items()}
            return {name: (positions[moving], rotations[moving]) for name, (positions, rotations) in seen.items()}

        levels = self.records["protection"][moving].astype(float)
        of_platform = chosen(lambda *pose: pose)
        frames = {}
        if self.frames is not None:
            # A tool is off by the turn times its distance from {2} at most.
            arm = np.array([[1.0, float(np.linalg.norm(self.frames.tool.position))], [0.0, 1.0]])
            of_tool = chosen(self.read)
            described: dict[str, Any] = {**self.frames.described(), **_errors(**of_tool)}
            frames = {"frames": {**described, "protection": _protection(levels @ arm.T, of_tool)}}
        return {
            "truth_known": self.truth_known,
            "motion_s": int(moving.sum()) / self.config.rate,
            **_errors(**of_platform),
            **frames,
            "protection": _protection(levels, of_platform),
            "limits": {"violations": self.reference.violations},
            "target_stretch": least_time_scale(self.mechanism, self.target, 1.0),
            "real_time_factor": self.real_time_factor,
            "cycle_us": percentiles(self.records["stage_ns"][:, COMPUTED].sum(axis=1), tuple(QUANTILES)),
            "remarks": list(self.remarks),
            "events": self.events,
            "stages": self.stages,
            "config": asdict(self.config),
            "version": version("gough"),
        }


def simulate(
    config: SimulationConfig,
    progress: Progress = no_progress,
    resumed: Snapshot | None = None,
    save_at: float | None = None,
    say: Say = say_nothing,
    stages: Stages | None = None,
) -> SimulationResult:
    """Run a simulation.

    Args:
        config: what to simulate.
        progress: called with the share of the run that is done.
        resumed: where to go on; the result then covers the rest of the run.
        save_at: the time in the motion at which to take a snapshot [s], its duration for the end; None for never.
        say: called with each remark before the loop runs.
        stages: functions in place of stages of the cycle; some ten times slower than the compiled ones.

    Raises:
        GoughError: something in the configuration cannot be used; nothing has run.
        SimulationStoppedError: the loop ended early; if a stage has failed, its exception is the cause of this one.
    """
    stages = stages or Stages()
    if (config.fusion == "filterpy" or stages.names) and (resumed is not None or save_at is not None):
        raise InputError("filters on filterpy and stages of your own have a state that cannot be saved: leave them out")
    with _loop_on_fmu(config, stages) as (loop, replacements):
        for remark in loop.remarks:
            say(remark)
        if resumed is not None:
            resume_snapshot(resumed, loop)
        first, stop = int(loop.state["time"]["cycle"]), loop.state["safety"]["stop"]
        if save_at is not None:
            _check_time(save_at, loop, first)
        snapshot = None
        cause, took = Cause.NONE.value, loop.planning_time
        done, chunk, share = first, 1, 0.0
        while cause == Cause.NONE and done < loop.cycle_at(config.duration):
            saved = None if save_at is None else loop.cycle_at(save_at)
            last = min(done + chunk, saved if saved is not None and done < saved else loop.cycle_at(config.duration))
            began = time.perf_counter()
            cause = loop.run(last, replacements)
            passed = time.perf_counter() - began
            took, done = took + passed, last
            # As many cycles as fit, whatever a cycle costs on this plant.
            chunk = max(1, min(2 * chunk, int(chunk * _CHUNK_S / max(passed, 1e-6))))
            if cause == Cause.NONE and save_at is not None and last == loop.cycle_at(save_at) and stop["cause"] == Cause.NONE:
                snapshot = take_snapshot(asdict(config), loop)
            # A motion that waits for the pose ends later than planned: the share stands still then.
            share = max(share, min((done - first) / (loop.cycle_at(config.duration) - first), 1.0))
            progress(share)
        result = _result(config, loop, first, snapshot, took, stages)
        if stop["cause"] != Cause.NONE:
            raise _stopped(loop, result, cause) from loop.error
    return result


class Simulation:
    """A simulation that is stepped from outside, as `open_simulation` makes it.

    Attributes:
        cycle: what the loop knows, in views that change with it.
    """

    def __init__(self, config: SimulationConfig, loop: PreparedLoop, stages: Stages, replacements: list[Replacement]) -> None:
        self._config, self._loop, self._stages, self._replacements = config, loop, stages, replacements
        self._rig, self._began, self._cause, self._sensed = FmuRig(loop), time.perf_counter(), Cause.NONE.value, False
        self.cycle: Cycle = loop.cycle

    @property
    def ended(self) -> bool:
        """Whether the motion is over."""
        return self.cycle.number >= self._loop.cycle_at(self._config.duration)

    def sense(self) -> Cycle:
        """Let the plant move for a period with the last command, read its sensors, and find the pose, the reference, and what
        command gough would give. `act` ends the cycle.

        Raises:
            InputError: the motion is over, or the cycle before has not been ended.
            SimulationStoppedError: the run has ended on the brakes.
        """
        if self._sensed:
            raise InputError("the cycle has been sensed already: end it with act()")
        if self.ended:
            raise InputError(f"the motion of {self._config.duration:g} s is over: give the configuration a longer duration")
        loop = self._loop
        self._cause = loop.sense(self._rig)
        if self._cause != Cause.NONE:
            raise _stopped(loop, self.result(), self._cause) from loop.error
        loop.compute(CycleStage.SCREENING, CycleStage.WATCH, self._replacements)
        for each in self._replacements:
            if each.before == CycleStage.WATCH:
                loop.replace(each)
        self._sensed = True
        return self.cycle

    def act(self, command: ArrayLike | None = None) -> None:
        """End the cycle.

        Args:
            command: velocity of each drive (L,) [m/s] in place of gough's or a stage's, cut off at the largest command. It is
                for a platform that follows its motion (`cycle.driving`).

        Raises:
            InputError: the command is malformed, or no cycle has been sensed.
            SimulationStoppedError: the motion is over, and a stop is still under way.
        """
        if not self._sensed:
            raise InputError("no cycle has been sensed: call sense() first")
        if command is not None:
            replace_command(self._loop.parameters, self._loop.state, self.cycle, command)
        self._loop.finish(CycleStage.WATCH)
        self._sensed = False
        if self.ended and self._loop.state["safety"]["stop"]["cause"] != Cause.NONE:
            raise _stopped(self._loop, self.result(), Cause.NONE) from self._loop.error

    def step(self, command: ArrayLike | None = None) -> Cycle:
        """One cycle: `sense`, then `act`."""
        self.sense()
        self.act(command)
        return self.cycle

    def result(self) -> SimulationResult:
        """What was found until now."""
        took = self._loop.planning_time + time.perf_counter() - self._began
        return _result(self._config, self._loop, 0, None, took, self._stages)


@contextmanager
def open_simulation(config: SimulationConfig, stages: Stages | None = None) -> Iterator[Simulation]:
    """A simulation to be stepped from outside, at rest before its first cycle.

    Args:
        config: what to simulate.
        stages: functions in place of stages of the cycle.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    stages = stages or Stages()
    with _loop_on_fmu(config, stages, stepped=True) as (loop, replacements):
        yield Simulation(config, loop, stages, replacements)


@contextmanager
def _loop_on_fmu(
    config: SimulationConfig, stages: Stages, stepped: bool = False
) -> Iterator[tuple[PreparedLoop, list[Replacement]]]:
    """A loop, and what runs in it in Python."""
    if config.streamed or config.rig != "fmu":
        raise InputError("a streamed target, and any rig but the FMU, has a clock of its own: use 'gough run'")
    in_python = stepped or config.fusion == "filterpy" or bool(stages.names)
    with prepared_loop(config, in_python=in_python) as loop:
        if in_python:
            FmuRig(loop).open()
        replacements = replacements_of(stages, loop.cycle, loop.parameters, loop.state)
        if config.fusion == "filterpy":
            from controller.estimation.filterpy_filters import FilterpyFilters

            filters, state = FilterpyFilters(loop.parameters), loop.state
            replacements += [
                Replacement(CycleStage.LEGS, CycleStage.LEGS, lambda: filters.step_legs(state)),
                Replacement(CycleStage.PLATFORM, CycleStage.PLATFORM, lambda: filters.step_platform(state)),
            ]
        yield loop, ordered(replacements)


def _stopped(loop: PreparedLoop, result: SimulationResult, cause: int) -> SimulationStoppedError:
    how = "stopped on the brakes" if cause != Cause.NONE else "still stopping at the end, from"
    reason = ": ".join(filter(None, [loop.reason(), loop.failure]))
    at, count = int(loop.state["safety"]["stop"]["cycle"]), loop.cycle_at(result.config.duration)
    return SimulationStoppedError(f"{how} at cycle {at} of {count}: {reason}", result)


def _check_time(at: float, loop: PreparedLoop, first: int) -> None:
    period, begin, end = float(loop.parameters["rig"]["period"]), loop.cycle_at(0.0), loop.end + loop.delay
    if not (np.isfinite(at) and first < loop.cycle_at(at) <= end):
        least, most = ((cycle - begin) * period for cycle in (first, end))
        raise InputError(f"a snapshot at {at:g} s is not within the motion: choose more than {least:g}, and at most {most:g} s")


def _result(
    config: SimulationConfig, loop: PreparedLoop, first: int, snapshot: Snapshot | None, took: float, stages: Stages
) -> SimulationResult:
    done = int(loop.state["time"]["cycle"])
    records = loop.records[first:done]
    times = (np.arange(first, done) - loop.cycle_at(0.0)) / config.rate
    lengths = records["reference"][:, : loop.mechanism.legs, 0]
    target = loop.target.at(times)
    attitudes = heaves = None
    if config.levelled:
        attitudes, heaves = _motion_of_base(config, loop, 1e-9 * records["time_ns"])
        back = np.swapaxes(attitudes, 1, 2)
        target = (back @ (target[0] - heaves)[..., None])[..., 0], back @ target[1]
    return SimulationResult(
        config, loop.mechanism, loop.target, loop.reference, times, records,
        *poses_from_lengths(loop.mechanism, lengths, loop.target.start, partial=True), *target,
        (done - first) / config.rate / took, snapshot, loop.remarks, loop.parameters.copy(), loop.frames, attitudes, heaves,
        stages.names,
    )  # fmt: skip


def _motion_of_base(config: SimulationConfig, loop: PreparedLoop, times: Array) -> tuple[Array, Array]:
    """The true attitudes (N, 3, 3), and the heaves (N, 3) [m] in which the platform takes no part, at times (N,) [s]."""
    rig = loop.parameters["rig"]
    motions = [placed(each, float(rig["hold_cycles"] * rig["period"])) for each in config.base_motions]
    heaves = np.zeros((len(times), 3))
    if config.heave_period > 0.0:
        up = rig["sensors"]["up_in_base"][0]
        heaves = np.outer(displacements_of(motions, times) @ up, up)
    return attitudes_of(motions, times), heaves


def _errors(estimate: Poses, reference: Poses, target: Poses, truth: Poses | None = None) -> dict[str, dict[str, float] | None]:
    """RMS and largest differences of poses (N)."""
    known = np.isfinite(reference[0][:, 0])
    planned = {f"reference_{name}": value for name, value in _figures(reference, target, known).items()}
    return {
        "estimation": None if truth is None else _figures(estimate, truth),
        "tracking": None if truth is None else _figures(truth, reference, known),
        "estimated_tracking": _figures(estimate, reference, known),
        "target": planned if truth is None else _figures(truth, target) | planned,
    }


def _protection(levels: Array, poses: dict[str, Poses]) -> dict[str, float] | None:
    """Median, 99th percentile and maximum of protection levels (N, 2) [m, rad], and in which share of cycles they cover both
    errors of the estimate, if the truth is among the poses; None without a level.
    """
    known = np.isfinite(levels[:, 0])
    if not known.any():
        return None
    figures = level_figures(levels[known])
    if "truth" not in poses:
        return figures
    sizes = np.linalg.norm(pose_errors(*poses["estimate"], *poses["truth"]).reshape(-1, 2, 3), axis=2)
    return figures | {"covered": float((sizes <= levels)[known].all(axis=1).mean())}


def _figures(poses: Poses, true: Poses, known: NDArray[np.bool_] | None = None) -> dict[str, float]:
    """RMS and largest errors of poses, positions (N, 3) and rotations (N, 3, 3), of those that are `known`."""
    errors = pose_errors(*poses, *true)
    return error_figures(errors if known is None else errors[known])
