"""The report of the loop on the clock."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import plotly.graph_objects as go

from hil.reports.page import LAYOUT, figure_html, write_page
from plant.errors import InputError


def write_report(figures: dict[str, Any], history: Sequence[dict[str, Any]], path: Path) -> None:
    """Write histograms, and the times from run to run, as one HTML file.

    The figures, and those in `history`, are as `gough bench --json` writes them.

    Raises:
        InputError: the figures lack the section `real_time`, or the file cannot be written.
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
            sections.append(figure_html(f"clock-{rate}-{condition}", name, _sentence(measured), figure))
    for rate in figures["real_time"]["rates"]:
        figure = go.Figure()
        for name in ("compute_us", "latency_us", "wake_us", "cyclictest_us"):
            for key in ("p50", "p999"):
                times = {run["date"]: found[key] for run in runs if (found := _idle(run, rate).get(name))}
                label = f"{name.removesuffix('_us')} {key.replace('p999', 'p99.9')}"
                figure.add_scatter(x=list(times), y=list(times.values()), name=label, mode="lines+markers")
        figure.update_layout(LAYOUT, height=380, yaxis={"title": "us", "type": "log"})
        caption = f"{len(runs)} runs, idle."
        sections.append(figure_html(f"history-{rate}", f"{rate} Hz, from run to run", caption, figure))
    subtitle = f"{figures['machine']}, {figures['date']}, gough {figures['version']}"
    write_page(path, "The loop on the clock", subtitle, "\n".join(sections))


def _sentence(measured: dict[str, Any]) -> str:
    compute, latency = measured["compute_us"], measured["latency_us"]
    return (
        f"Computing p50 {compute['p50']:.1f} us, p99.9 {compute['p999']:.1f}; wake-up to command p50 {latency['p50']:.1f}, "
        f"p99.9 {latency['p999']:.1f}; missed by own work {measured['missed_own']}, by the host {measured['missed_host']}."
    )


def _idle(run: dict[str, Any], rate: str) -> dict[str, Any]:
    """The figures of an idle run at a rate; empty if it has none."""
    found: dict[str, Any] = run.get("real_time", {}).get("rates", {}).get(rate, {}).get("idle", {})
    return found
