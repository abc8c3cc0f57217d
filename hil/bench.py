"""Benchmarks: how many times faster than real time the loop runs, and what each stage of it costs."""

import os
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.cycle import find_pose, fuse_legs, fuse_platform, improve_pose, invert, refer, regulate
from hil.loop import now
from hil.simulation import SimulationConfig, prepared_loop, simulate
from plant.compiled import Record, kernel
from plant.fmu import advance, read_imus, read_truth, write_command, write_drive_mode
from plant.imu import measure
from plant.pose import Array
from plant.variables import BRAKE, IMU_COUNT, VELOCITY

STAGES = (
    "FMU outputs",
    "IMU imperfections",
    "fusion, six legs",
    "fusion, platform",
    "direct kinematics",
    "refinement, twice",
    "inverse kinematics",
    "reference",
    "PID and feed-forward",
    "FMU step",
)
_REPEATS = 3
_FILTERPY_S = 2.0


def measure_speed(target: str, duration: float, progress: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
    """Run the simulation several times, once stage by stage, and once on filterpy.

    Returns:
        `real_time_factor` (median, least, greatest), `filterpy_real_time_factor`, `filterpy_slowdown`, `cycle_us` and
        `stages_us` (p50, p99, p999, max, n).

    Raises:
        GoughError: as `simulate`.
    """
    config = SimulationConfig(target=target, duration=duration)
    simulate(SimulationConfig(target=target, duration=0.1))
    share = 1.0 / (_REPEATS + 2)
    factors = []
    cycle_ns: NDArray[np.int64] = np.empty(0, np.int64)
    for i in range(_REPEATS):
        result = simulate(config, partial(_report_part, progress, i * share, share))
        factors.append(result.real_time_factor)
        cycle_ns = np.concatenate([cycle_ns, result.records["cycle_ns"]])
    stages = _time_stages(config)
    progress((_REPEATS + 1) * share)
    slow = simulate(SimulationConfig(target=target, duration=min(duration, _FILTERPY_S), fusion="filterpy"))
    progress(1.0)
    median = float(np.median(factors))
    return {
        "real_time_factor": {"median": median, "least": min(factors), "greatest": max(factors)},
        "filterpy_real_time_factor": slow.real_time_factor,
        "filterpy_slowdown": median / slow.real_time_factor,
        "cycle_us": _percentiles(cycle_ns),
        "stages_us": {name: _percentiles(column) for name, column in zip(STAGES, stages.T, strict=True)},
        "duration": duration,
        "target": target,
    }


def machine() -> dict[str, str]:
    """What figures are measured on: machine, date and version."""
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version("gough"),
    }


def _report_part(progress: Callable[[float], None], start: float, share: float, done: float) -> None:
    progress(start + share * done)


def _percentiles(nanoseconds: NDArray[np.int64]) -> dict[str, float]:
    us = nanoseconds / 1e3
    p50, p99, p999 = np.percentile(us, (50.0, 99.0, 99.9))
    return {"p50": float(p50), "p99": float(p99), "p999": float(p999), "max": float(us.max()), "n": len(us)}


def _time_stages(config: SimulationConfig) -> NDArray[np.int64]:
    """Nanoseconds (N, stages) of every stage in every cycle, the clock's own taken off."""
    with prepared_loop(config) as loop:
        count = len(loop.records)
        nanoseconds = np.zeros((count, len(STAGES)), np.int64)
        arguments = (loop.calls, loop.imu, loop.parameters, loop.state, loop.segments)
        clock = np.zeros(2, np.int64)
        _run_stages(*arguments, np.zeros((3, IMU_COUNT, 3)), clock, nanoseconds)
        return np.maximum(nanoseconds - _clock_cost(clock), 0)


@kernel
def _clock_cost(clock: NDArray[np.int64]) -> int:
    best = 1_000_000
    for _ in range(1000):
        first = now(clock)
        best = min(best, now(clock) - first)
    return best


@kernel
def _run_stages(
    calls: Record, imu: Record, parameters: Record, state: Record, segments: Array, measurement: Array,
    clock: NDArray[np.int64], nanoseconds: NDArray[np.int64],
) -> None:  # fmt: skip
    """The loop of `hil.loop`, with the clock read between the stages."""
    p, s = parameters[()], state[()]
    for k in range(nanoseconds.shape[0]):
        if s.cycle == 0:
            write_drive_mode(calls, BRAKE)
        if s.cycle == p.hold_cycles:
            write_drive_mode(calls, VELOCITY)
        row = nanoseconds[k]
        t = now(clock)
        read_imus(calls)
        read_truth(calls)
        row[0], t = now(clock) - t, now(clock)
        measure(imu, calls[()].imu, measurement)
        row[1], t = now(clock) - t, now(clock)
        fuse_legs(parameters, state, measurement)
        row[2], t = now(clock) - t, now(clock)
        fuse_platform(parameters, state, measurement)
        row[3], t = now(clock) - t, now(clock)
        find_pose(parameters, state)
        row[4], t = now(clock) - t, now(clock)
        improve_pose(parameters, state)
        row[5], t = now(clock) - t, now(clock)
        invert(parameters, state)
        row[6], t = now(clock) - t, now(clock)
        refer(parameters, state, segments)
        row[7], t = now(clock) - t, now(clock)
        regulate(parameters, state)
        row[8], t = now(clock) - t, now(clock)
        s.cycle += 1
        write_command(calls, s.command)
        advance(calls, p.period)
        row[9] = now(clock) - t
