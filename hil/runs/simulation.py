"""A closed-loop simulation: a mechanism follows a target on its FMU plant, as fast as the machine can."""

import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from controller.cycle import OK
from controller.direct_kinematics import poses_from_lengths
from controller.estimation.fusion import find_vertical, fuse_heading, point_legs, prepare_platform
from controller.estimation.leg_filter import start_leg
from controller.planning.planner import Reference
from controller.planning.target import Target
from hil.loop.driver import PythonFilters
from hil.loop.records import COMPUTED
from hil.progress import Progress, no_progress
from hil.runs.config import SimulationConfig
from hil.runs.prepare import PreparedLoop, prepared_loop
from hil.runs.snapshot import Snapshot, resume_snapshot, take_snapshot
from plant.compiled import Record
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import GoughError, InputError
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, pose_errors, rms_figures, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION

_CHUNK_S = 0.25


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
        config: what was simulated.
        mechanism, target, reference: as prepared from the configuration.
        times: (N,) [s]; 0 is the end of the hold.
        records: (N,), dtype `hil.loop.records.RECORD`.
        reference_positions, reference_rotations: (N, 3) [m] and (N, 3, 3), the planned poses.
        target_positions, target_rotations: (N, 3) [m] and (N, 3, 3), the raw target.
        real_time_factor: simulated time over the time that planning and loop took.
        snapshot: None if none was asked for.
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

    @property
    def moved(self) -> bool:
        """Whether the run went beyond the hold on the brakes, so that there are figures to sum up."""
        return bool(len(self.times)) and bool(self.times[-1] >= 0.0)

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

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units, over the time after the hold; None for those that need the truth where it is not known."""
        moving = self.times >= 0.0
        estimate = (self.records["position"][moving], self.records["rotation"][moving])
        reference = (self.reference_positions[moving], self.reference_rotations[moving])
        target = (self.target_positions[moving], self.target_rotations[moving])
        truth = (self.true_positions[moving], self.true_rotations[moving]) if self.truth_known else None
        cycle_us = self.records["stage_ns"][:, COMPUTED].sum(axis=1) / 1e3
        return {
            "truth_known": self.truth_known,
            "estimation": None if truth is None else _figures(estimate, truth),
            "tracking": None if truth is None else _figures(truth, reference),
            "estimated_tracking": _figures(estimate, reference),
            "target": ({} if truth is None else _figures(truth, target))
            | {f"reference_{key}": value for key, value in _figures(reference, target).items()},
            "limits": {"violations": self.reference.violations},
            "real_time_factor": self.real_time_factor,
            "cycle_us": {
                name: float(np.percentile(cycle_us, percent)) for name, percent in (("p50", 50), ("p99", 99), ("p999", 99.9))
            },
            "config": asdict(self.config),
            "version": version("gough"),
        }


def simulate(
    config: SimulationConfig,
    progress: Progress = no_progress,
    resumed: Snapshot | None = None,
    save_at: float | None = None,
) -> SimulationResult:
    """Run a simulation.

    Args:
        config: what to simulate.
        progress: called with the share of the run that is done.
        resumed: the snapshot to resume from; the result then covers the rest of the run.
        save_at: the time in the motion at which to take a snapshot [s], its duration for the end; None for never.

    Raises:
        GoughError: something in the configuration cannot be used; nothing has run.
        SimulationStoppedError: the loop ended early.
    """
    if config.streamed or config.rig != "fmu":
        raise InputError("a streamed target, and any rig but the FMU, has a clock of its own: use 'gough run'")
    if config.fusion == "filterpy" and (resumed is not None or save_at is not None):
        raise InputError("filters on filterpy cannot be saved: choose another fusion")
    with prepared_loop(config) as loop:
        count = len(loop.records)
        if resumed is not None:
            resume_snapshot(resumed, loop, loop.simulated)
        first = int(loop.state["cycle"])
        saved = None if save_at is None else _cycle_at(save_at, loop, first)
        snapshot = None
        filters = filterpy_filters(loop.parameters) if config.fusion == "filterpy" else None
        cause, took = OK, loop.planning_time
        chunk = max(1, round(_CHUNK_S * config.rate))
        for last in sorted({*range(first + chunk, count, chunk), count, *([] if saved is None else [saved])}):
            began = time.perf_counter()
            cause = loop.run(last, filters)
            took += time.perf_counter() - began
            if cause != OK:
                break
            if last == saved and loop.state["stopping"] == OK:
                snapshot = take_snapshot(asdict(config), loop, loop.simulated)
            progress((last - first) / (count - first))
        result = _result(config, loop, first, snapshot, took)
        if loop.state["stopping"] != OK:
            at = int(loop.state["stop_cycle"])
            how = "stopped on the brakes" if cause != OK else "still stopping at the end, from"
            raise SimulationStoppedError(f"{how} at cycle {at} of {count}: {loop.reason()}", result)
    return result


def _cycle_at(at: float, loop: PreparedLoop, first: int) -> int:
    """The cycle at a time [s] of the motion."""
    period, hold = float(loop.parameters["period"]), int(loop.parameters["hold_cycles"])
    cycle = hold + round(at / period) if np.isfinite(at) else -1
    if not first < cycle <= len(loop.records):
        least, most = ((cycle - hold) * period for cycle in (first, len(loop.records)))
        raise InputError(f"a snapshot at {at:g} s is not within the motion: choose more than {least:g}, and at most {most:g} s")
    return cycle


def _result(
    config: SimulationConfig, loop: PreparedLoop, first: int, snapshot: Snapshot | None, took: float
) -> SimulationResult:
    """The result from cycle `first` on, after `took` seconds of planning and running."""
    done = int(loop.state["cycle"])
    records = loop.records[first:done]
    times = (np.arange(first, done) - int(loop.parameters["hold_cycles"])) / config.rate
    positions, rotations = poses_from_lengths(
        loop.mechanism, records["reference"][:, : loop.mechanism.legs, 0], loop.target.start
    )
    target_positions, target_rotations = loop.target.at(times)
    return SimulationResult(
        config, loop.mechanism, loop.target, loop.reference, times, records, positions, rotations, target_positions,
        target_rotations, (done - first) / config.rate / took, snapshot,
    )  # fmt: skip


def filterpy_filters(parameters: Record) -> PythonFilters:
    """The filters of legs and platform on filterpy, in place of the compiled ones."""
    from controller.estimation.filterpy_filters import FilterpyLeg, FilterpyPlatform

    legs = [
        FilterpyLeg(
            up_in_joint=parameters["sensors"]["up_in_joint"][k],
            imu_position=parameters["sensors"]["leg_imu_position"][k],
            gravity=float(parameters["sensors"]["gravity"]),
            period=float(parameters["period"]),
            jerk=float(parameters["leg_jerk"]),
            bias_walk=float(parameters["bias_walk"]),
            rate_variance=float(parameters["gyroscope_variance"]),
            force_variance=float(parameters["leg_force_variance"]),
        )
        for k in range(LEGS)
    ]
    platform = FilterpyPlatform(
        gravity=float(parameters["sensors"]["gravity"]),
        period=float(parameters["period"]),
        rate_density=float(parameters["gyroscope_density"]),
        bias_walk=float(parameters["bias_walk"]),
        vertical_variance=float(parameters["vertical_variance"]),
    )

    def fuse_legs(state: Record) -> None:
        for k, leg in enumerate(legs):
            if not state["imu_used"][k]:
                continue
            rate, force = state["sample"][GYROSCOPE, k], state["sample"][ACCELEROMETER, k]
            if state["age"][k] == 0:
                start_leg(
                    state["leg_x"][k], state["leg_covariance"][k], rate, force, leg.up_in_joint, float(parameters["bias_sigma"])
                )
                leg.start(state["leg_x"][k], state["leg_covariance"][k])
                leg.update(rate, force)
            else:
                leg.step(rate, force)
            state["leg_x"][k], state["leg_covariance"][k] = leg.state, leg.covariance
        point_legs(parameters, state)

    def fuse_platform(state: Record) -> None:
        if prepare_platform(parameters, state):
            platform.start(state["platform_x"], state["platform_covariance"])
            rate, force = state["sample"][GYROSCOPE, PLATFORM_IMU], state["sample"][ACCELEROMETER, PLATFORM_IMU]
            platform.step(rate, force, state["imu_acceleration"])
            state["platform_x"], state["platform_covariance"] = platform.state, platform.covariance
            find_vertical(parameters, state)
        fuse_heading(parameters, state)

    return PythonFilters(fuse_legs, fuse_platform)


def _figures(poses: tuple[Array, Array], true: tuple[Array, Array]) -> dict[str, float]:
    """RMS and largest differences of poses, positions (N, 3) and rotations (N, 3, 3), from true ones."""
    errors = pose_errors(*poses, *true)
    largest = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
    return rms_figures(errors) | {"position_max": float(largest[0]), "rotation_max": float(largest[1])}
