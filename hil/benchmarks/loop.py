"""Benchmarks: how many times faster than real time the loop runs, and what each stage of it costs."""

import json
import os
import platform
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from hil.loop.records import COMPUTED, STAGES
from hil.reports.page import LAYOUT, figure_html, page
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.files import write_whole

_REPEATS = 3
_FILTERPY_S = 2.0


def measure_speed(target: str, duration: float, progress: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
    """Run the simulation several times, and once on filterpy.

    Returns:
        `real_time_factor` (median, least, greatest), `filterpy_real_time_factor`, `filterpy_slowdown`, `cycle_us` and
        `stages_us` (p50, p99, p999, max, n).

    Raises:
        GoughError: as `simulate`.
    """
    config = SimulationConfig(target=target, duration=duration)
    simulate(SimulationConfig(target=target, duration=0.1))
    share = 1.0 / (_REPEATS + 1)
    factors = []
    runs = []
    for i in range(_REPEATS):
        result = simulate(config, partial(_report_part, progress, i * share, share))
        factors.append(result.real_time_factor)
        runs.append(result.records["stage_ns"])
    stage_ns = np.concatenate(runs)
    slow = simulate(SimulationConfig(target=target, duration=min(duration, _FILTERPY_S), fusion="filterpy"))
    progress(1.0)
    median = float(np.median(factors))
    return {
        "real_time_factor": {"median": median, "least": min(factors), "greatest": max(factors)},
        "filterpy_real_time_factor": slow.real_time_factor,
        "filterpy_slowdown": median / slow.real_time_factor,
        "cycle_us": _percentiles(stage_ns[:, COMPUTED].sum(axis=1)),
        "stages_us": {name: _percentiles(column) for name, column in zip(STAGES, stage_ns.T, strict=True)},
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


def write_report(figures: dict[str, Any], history: Sequence[dict[str, Any]], path: Path) -> None:
    """Write histograms of the loop on the clock, and how its figures have changed, as one HTML file.

    Args:
        figures: what `gough bench --json` writes, with the section `real_time`.
        history: earlier such figures.
        path: of the HTML file.

    Raises:
        InputError: there is no such section.
    """
    if "real_time" not in figures:
        raise InputError(
            "a report shows the loop on the clock, which was not measured: run it with --only clock, or without --only"
        )
    runs = sorted([*history, figures], key=lambda run: str(run["date"]))
    sections = []
    for rate, conditions in figures["real_time"]["rates"].items():
        for condition, measured in conditions.items():
            name = f"{rate} Hz, {condition.replace('_', ' ')}"
            figure = go.Figure()
            for label, (lower, counts) in measured["histograms"].items():
                if counts:
                    figure.add_scatter(x=lower, y=counts, name=label, mode="lines", line={"shape": "hv"})
            axes = {"xaxis": {"title": "us", "type": "log"}, "yaxis": {"title": "cycles", "type": "log"}}
            figure.update_layout(LAYOUT, height=380, **axes)
            sections.append(figure_html(f"clock-{rate}-{condition}", name, _sentence(measured), figure, "time"))
    for rate in figures["real_time"]["rates"]:
        figure = go.Figure()
        for name in ("compute_us", "latency_us", "wake_us", "cyclictest_us"):
            for key in ("p50", "p999"):
                measured = [(run["date"], _idle(run, rate).get(name)) for run in runs]
                points = [(date, figures_of[key]) for date, figures_of in measured if figures_of]
                label = f"{name.removesuffix('_us')} {key.replace('p999', 'p99.9')}"
                figure.add_scatter(x=[at for at, _ in points], y=[us for _, us in points], name=label, mode="lines+markers")
        figure.update_layout(LAYOUT, height=380, yaxis={"title": "us", "type": "log"})
        caption = f"{len(runs)} runs, idle."
        sections.append(figure_html(f"history-{rate}", f"{rate} Hz, from run to run", caption, figure, "time"))
    subtitle = f"{figures['machine']}, {figures['date']}, gough {figures['version']}"
    write_whole(path, page("The loop on the clock", subtitle, "\n".join(sections)).encode())


def _sentence(measured: dict[str, Any]) -> str:
    compute, latency = measured["compute_us"], measured["latency_us"]
    return (
        f"Computing p50 {compute['p50']:.1f} us, p99.9 {compute['p999']:.1f}; wake-up to command p50 {latency['p50']:.1f}, "
        f"p99.9 {latency['p999']:.1f}; missed by own work {measured['missed_own']}, by the host {measured['missed_host']}."
    )


def _idle(run: dict[str, Any], rate: str) -> dict[str, Any]:
    """What a run has measured at a rate, idle; empty if it has not."""
    found: dict[str, Any] = run.get("real_time", {}).get("rates", {}).get(rate, {}).get("idle", {})
    return found


def read_earlier(path: Path) -> dict[str, Any]:
    """Figures that `gough bench --json` has written.

    Raises:
        InputError: it has not.
    """
    try:
        figures: dict[str, Any] = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path} holds no earlier figures: {error}") from None
    if not isinstance(figures, dict) or "date" not in figures:
        raise InputError(f"{path} holds no figures of 'gough bench': it has no date")
    return figures
