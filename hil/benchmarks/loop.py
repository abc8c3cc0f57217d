"""Benchmarks of the simulated loop: its speed over real time, and the cost of each stage."""

import json
import os
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hil.loop.records import COMPUTED, STAGES
from hil.progress import Progress, no_progress, part_of
from hil.realtime.durations import percentiles
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError

_REPEATS = 3
_FILTERPY_S = 2.0


def measure_speed(target: str, duration: float, progress: Progress = no_progress) -> dict[str, Any]:
    """Run the simulation several times, and once with the filters on filterpy.

    Returns:
        `real_time_factor`, `filterpy_real_time_factor`, `filterpy_slowdown`, `cycle_us` and `stages_us`.

    Raises:
        GoughError: as `simulate`.
    """
    config = SimulationConfig(target=target, duration=duration)
    simulate(SimulationConfig(target=target, duration=0.1))
    share = 1.0 / (_REPEATS + 1)
    results = [simulate(config, part_of(progress, i * share, share)) for i in range(_REPEATS)]
    factors = [result.real_time_factor for result in results]
    stage_ns = np.concatenate([result.records["stage_ns"] for result in results])
    slow = simulate(SimulationConfig(target=target, duration=min(duration, _FILTERPY_S), fusion="filterpy"))
    progress(1.0)
    median = float(np.median(factors))
    return {
        "real_time_factor": {"median": median, "least": min(factors), "greatest": max(factors)},
        "filterpy_real_time_factor": slow.real_time_factor,
        "filterpy_slowdown": median / slow.real_time_factor,
        "cycle_us": percentiles(stage_ns[:, COMPUTED].sum(axis=1)),
        "stages_us": {name: percentiles(column) for name, column in zip(STAGES, stage_ns.T, strict=True)},
        "duration": duration,
        "target": target,
    }


def machine() -> dict[str, str]:
    """The machine, date and version of figures."""
    return {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version("gough"),
    }


def read_earlier(path: Path) -> dict[str, Any]:
    """Read figures that `gough bench --json` wrote.

    Raises:
        InputError: the file holds none.
    """
    try:
        figures: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} holds no earlier figures: {error}") from None
    if not isinstance(figures, dict) or "date" not in figures:
        raise InputError(f"{path} holds no figures of 'gough bench': it has no date")
    return figures
