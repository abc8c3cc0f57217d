"""A closed-loop simulation: a mechanism follows a target on its FMU plant, as fast as the machine can."""

import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics import poses_from_lengths
from controller.planning.offline_planner import Reference
from controller.planning.pace import required_stretch
from controller.planning.target import Target
from controller.safety.causes import Cause
from hil.loop.records import COMPUTED
from hil.progress import Progress, Say, no_progress, say_nothing
from hil.realtime.durations import QUANTILES, percentiles
from hil.runs.config import LEVEL, SimulationConfig
from hil.runs.prepare import PreparedLoop, prepared_loop
from hil.runs.run_state import note_events
from hil.runs.snapshot import Snapshot, resume_snapshot, take_snapshot
from plant.compiled import Record
from plant.dynamics.base_course import attitudes_of, placed
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism
from plant.pose import Array, pose_errors, rms_figures, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION

_CHUNK_S = 0.1
"""How long the loop may run before it looks for Ctrl-C [s]."""


class SimulationStoppedError(GoughError, RuntimeError):
    """The loop ended early: the message has the cause and the cycle, `result` what was recorded until then."""

    exit_status = 1

    def __init__(self, message: str, result: "SimulationResult") -> None:
        super().__init__(message)
        self.result = result


@dataclass(frozen=True, eq=False)
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

    @property
    def moved(self) -> bool:
        """Whether the run came to the start of the motion, with a reference that is a pose there."""
        first = int(np.searchsorted(self.times, 0.0))
        return first < len(self.times) and bool(np.isfinite(self.reference_positions[first]).all())

    @property
    def truth_known(self) -> bool:
        """Whether the plant gives its true pose."""
        return bool(np.isfinite(self.records["truth"][:1, :7]).all())

    @property
    def true_positions(self) -> Array:
        """(N, 3) [m]; NaN if the truth is not known."""
        positions: Array = self.records["truth"][:, TRUTH_POSITION]
        return positions

    @property
    def true_rotations(self) -> Array:
        """(N, 3, 3); NaN if the truth is not known."""
        return rotations_from_quaternions(np.ascontiguousarray(self.records["truth"][:, TRUTH_QUATERNION]))

    @property
    def events(self) -> list[str]:
        """What happened, by cycle: the first hundred events."""
        noted: list[str] = []
        note_events(self.records, noted)
        return noted

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units, over the time of the motion; None for those that need the truth where it is not known.

        What is compared with the reference counts where that is a pose.
        """
        moving = self.times >= 0.0
        estimate = (self.records["position"][moving], self.records["rotation"][moving])
        reference = (self.reference_positions[moving], self.reference_rotations[moving])
        target = (self.target_positions[moving], self.target_rotations[moving])
        truth = (self.true_positions[moving], self.true_rotations[moving]) if self.truth_known else None
        known = np.isfinite(reference[0][:, 0])
        planned = {f"reference_{name}": value for name, value in _figures(reference, target, known).items()}
        return {
            "truth_known": self.truth_known,
            "estimation": None if truth is None else _figures(estimate, truth),
            "tracking": None if truth is None else _figures(truth, reference, known),
            "estimated_tracking": _figures(estimate, reference, known),
            "target": planned if truth is None else _figures(truth, target) | planned,
            "protection": self._protection(moving, truth and pose_errors(*estimate, *truth)),
            "limits": {"violations": self.reference.violations},
            "target_stretch": required_stretch(self.mechanism, self.target),
            "real_time_factor": self.real_time_factor,
            "cycle_us": percentiles(self.records["stage_ns"][:, COMPUTED].sum(axis=1), tuple(QUANTILES)),
            "remarks": list(self.remarks),
            "events": self.events,
            "config": asdict(self.config),
            "version": version("gough"),
        }

    def _protection(self, moving: NDArray[np.bool_], errors: Array | None) -> dict[str, float] | None:
        """Median, 99th percentile and maximum of the protection level, and in which share of cycles it covers both errors; None
        without a level.
        """
        levels = self.records["protection"][moving].astype(float)
        known = np.isfinite(levels[:, 0])
        if not known.any():
            return None
        figures = {
            f"{name}_{label}": float(np.quantile(levels[known, part], share))
            for part, name in enumerate(("position", "rotation"))
            for label, share in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))
        }
        if errors is None:
            return figures
        sizes = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2)
        return figures | {"covered": float((sizes <= levels)[known].all(axis=1).mean())}


def simulate(
    config: SimulationConfig,
    progress: Progress = no_progress,
    resumed: Snapshot | None = None,
    save_at: float | None = None,
    say: Say = say_nothing,
) -> SimulationResult:
    """Run a simulation.

    Args:
        config: what to simulate.
        progress: called with the share of the run that is done.
        resumed: where to go on; the result then covers the rest of the run.
        save_at: the time in the motion at which to take a snapshot [s], its duration for the end; None for never.
        say: called with each remark before the loop runs.

    Raises:
        GoughError: something in the configuration cannot be used; nothing has run.
        SimulationStoppedError: the loop ended early.
    """
    if config.streamed or config.rig != "fmu":
        raise InputError("a streamed target, and any rig but the FMU, has a clock of its own: use 'gough run'")
    if config.fusion == "filterpy" and (resumed is not None or save_at is not None):
        raise InputError("filters on filterpy cannot be saved: choose another fusion")
    with prepared_loop(config) as loop:
        for remark in loop.remarks:
            say(remark)
        if resumed is not None:
            resume_snapshot(resumed, loop)
        first, stop = int(loop.state["time"]["cycle"]), loop.state["safety"]["stop"]
        if save_at is not None:
            _check_time(save_at, loop, first)
        snapshot = filters = None
        if config.fusion == "filterpy":
            from controller.estimation.filterpy_filters import FilterpyFilters

            filters = FilterpyFilters(loop.parameters)
        cause, took = Cause.NONE.value, loop.planning_time
        done, chunk = first, 1
        while cause == Cause.NONE and done < loop.cycle_at(config.duration):
            saved = None if save_at is None else loop.cycle_at(save_at)
            last = min(done + chunk, saved if saved is not None and done < saved else loop.cycle_at(config.duration))
            began = time.perf_counter()
            cause = loop.run(last, filters)
            passed = time.perf_counter() - began
            took, done = took + passed, last
            # As many cycles as fit, whatever a cycle costs on this plant.
            chunk = max(1, min(2 * chunk, int(chunk * _CHUNK_S / max(passed, 1e-6))))
            if cause == Cause.NONE and save_at is not None and last == loop.cycle_at(save_at) and stop["cause"] == Cause.NONE:
                snapshot = take_snapshot(asdict(config), loop)
            progress(min((done - first) / (loop.cycle_at(config.duration) - first), 1.0))
        result = _result(config, loop, first, snapshot, took)
        if stop["cause"] != Cause.NONE:
            how = "stopped on the brakes" if cause != Cause.NONE else "still stopping at the end, from"
            count = loop.cycle_at(config.duration)
            raise SimulationStoppedError(f"{how} at cycle {stop['cycle']} of {count}: {loop.reason()}", result)
    return result


def _check_time(at: float, loop: PreparedLoop, first: int) -> None:
    period, begin, end = float(loop.parameters["rig"]["period"]), loop.cycle_at(0.0), loop.end + loop.delay
    if not (np.isfinite(at) and first < loop.cycle_at(at) <= end):
        least, most = ((cycle - begin) * period for cycle in (first, end))
        raise InputError(f"a snapshot at {at:g} s is not within the motion: choose more than {least:g}, and at most {most:g} s")


def _result(
    config: SimulationConfig, loop: PreparedLoop, first: int, snapshot: Snapshot | None, took: float
) -> SimulationResult:
    done = int(loop.state["time"]["cycle"])
    records = loop.records[first:done]
    times = (np.arange(first, done) - loop.cycle_at(0.0)) / config.rate
    lengths = records["reference"][:, : loop.mechanism.legs, 0]
    target = loop.target.at(times)
    if config.frame == LEVEL:
        hold = float(loop.parameters["rig"]["hold_cycles"] * loop.parameters["rig"]["period"])
        moved = attitudes_of([placed(each, hold) for each in config.base_motions], 1e-9 * records["time_ns"])
        target = (target[0][:, None] @ moved)[:, 0], np.swapaxes(moved, 1, 2) @ target[1]
    return SimulationResult(
        config, loop.mechanism, loop.target, loop.reference, times, records,
        *poses_from_lengths(loop.mechanism, lengths, loop.target.start, partial=True), *target,
        (done - first) / config.rate / took, snapshot, loop.remarks, loop.parameters.copy(),
    )  # fmt: skip


def _figures(poses: tuple[Array, Array], true: tuple[Array, Array], known: NDArray[np.bool_] | None = None) -> dict[str, float]:
    """RMS and largest errors of poses, positions (N, 3) and rotations (N, 3, 3), of those that are `known`."""
    errors = pose_errors(*poses, *true)
    errors = errors if known is None else errors[known]
    largest = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
    return rms_figures(errors) | {"position_max": float(largest[0]), "rotation_max": float(largest[1])}
