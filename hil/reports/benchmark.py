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
        InputError: the figures lack the sections `real_time` and `panel`, or the file cannot be written.
    """
    if not {"real_time", "panel"} & set(figures):
        raise InputError(
            "a report shows the loop on the clock, which was not measured: run it with --only clock panel, or without --only"
        )
    runs = sorted([*history, figures], key=lambda run: str(run["date"]))
    rates = figures.get("real_time", {"rates": {}})["rates"]
    sections = []
    for rate, conditions in rates.items():
        for condition, measured in conditions.items():
            name, figure = f"{rate} Hz, {condition.replace('_', ' ')}", _histograms(measured["histograms"])
            sections.append(figure_html(f"clock-{rate}-{condition}", name, _sentence(measured), figure))
    if "panel" in figures:
        panel = figures["panel"]
        for what, name in (("compute", "computing"), ("wake", "woken late")):
            figure = _histograms({f"{each} a panel": panel[each]["histograms"][what] for each in ("without", "with")})
            title = f"{panel['rate']:g} Hz, without and with a panel: {name}"
            sections.append(figure_html(f"panel-{what}", title, _panel_sentence(panel, what), figure))
    for rate in rates:
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


def _histograms(histograms: dict[str, Any]) -> go.Figure:
    """Histograms by name, each lower ends of bins [us] and counts."""
    figure = go.Figure()
    for label, (lower, counts) in histograms.items():
        if counts:
            figure.add_scatter(x=lower, y=counts, name=label, mode="lines", line={"shape": "hv"})
    axes = {"xaxis": {"title": "us", "type": "log"}, "yaxis": {"title": "cycles", "type": "log"}}
    return figure.update_layout(LAYOUT, height=380, **axes)


def _panel_sentence(panel: dict[str, Any], what: str) -> str:
    ratios, noise, attached = panel["ratios"][what], panel["noise"][what], panel["with"]
    return (
        f"With a panel over without: p50 {ratios['p50']:.3f} (noise {noise['p50']:.3f}), p99.9 {ratios['p999']:.3f} "
        f"({noise['p999']:.3f}); missed by own work {attached['missed_own']}, by the host {attached['missed_host']}. The panel "
        f"takes {attached['panel_cores']:.3f} of a processor, for {attached['frames_hz']:.1f} pictures a second."
    )


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
