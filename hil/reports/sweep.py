"""The report of a sweep: distributions, main effects, shares of variance, Sobol indices, and what has failed."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from html import escape
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.colors import sample_colorscale
from plotly.subplots import make_subplots

from hil.engine.batches import fingerprint
from hil.look import COLORS, FAINT, NEUTRAL, SERIES
from hil.reports.page import LAYOUT, LEGEND, figure_html, overview, place, write_page
from hil.runs.config import SimulationConfig
from hil.sweep.analysis import INTERACTIONS, Interval, Level, Sensitivity
from hil.sweep.store import REASON, STATUS, as_stored
from hil.sweep.study import Factor
from hil.sweep.sweep import SweepResult
from hil.sweep.units import headed, label_of, unit_of_factor, unit_of_figure
from hil.table import Cell, Table

_MOST_FIGURES, _MOST_PAIRED, _MOST_CELLS, _MOST_FAILURES = 12, 4, 12, 30
_POINTS, _CURVE_POINTS = 400, 300
"""The most points of a panel, and of the curve of a distribution."""
_LOGARITHMIC = 20.0
"""An axis is logarithmic if the 99 % quantile is so many times the 1 % quantile."""


class _Shown(NamedTuple):
    """A figure as it is drawn."""

    name: str
    heading: str
    scale: float
    values: np.ndarray[Any, np.dtype[np.float64]]  # in its unit, (N,)

    @property
    def logarithmic(self) -> bool:
        """Whether its axis is better logarithmic."""
        least, most = np.nanpercentile(self.values, (1.0, 99.0))
        return bool(np.nanmin(self.values) > 0.0 and most > _LOGARITHMIC * least)

    @property
    def axis(self) -> dict[str, Any]:
        """The form of its axis."""
        return {"type": "log"} if self.logarithmic else {}


def write_report(result: SweepResult, path: Path) -> None:
    """Write the report of a sweep as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    analysis, study = result.analysis, result.study
    shown = []
    for name in result.figures():
        values = analysis.values(name)
        if np.isfinite(values).any():
            unit, scale = unit_of_figure(name)
            shown.append(_Shown(name, headed(name, unit), scale, scale * values))
    drawn = shown[:_MOST_FIGURES]
    body = overview(f"{_quantiles(result, shown).html()}\n{_facts(result)}", f"<div>{_what_varies(result).html()}</div>")
    if drawn:
        body += "".join(figure_html(*figure) for figure in _figures(result, drawn))
    if len(drawn) < len(shown):
        body += f"<p>{len(shown)} figures are known, and the first {len(drawn)} are drawn: name others in [measure].</p>"
    if result.failed:
        body += figure_html("failures", "Failed runs", _failure_caption(result), _failures(result).html())
    body += figure_html("configuration", "Configuration", "What all runs have in common.", _configuration(result).html())
    parts = [f"{len(result.table)} runs", f"gough {result.summary()['version']}", f"sources {fingerprint()[:12]}"]
    write_page(path, f"gough: {study.name}", " · ".join(parts), body)


def _figures(result: SweepResult, shown: Sequence[_Shown]) -> Iterator[tuple[str, str, str, go.Figure | str]]:
    """Name, title, caption and figure of each part."""
    analysis, factors = result.analysis, [each for each in result.study.factors if not each.is_seed]
    yield (
        "distributions",
        "Distributions",
        "The share of the runs below each value: steep is certain, and left is small. The list chooses the factor.",
        _distributions(result, shown, factors),
    )
    for number, figure in enumerate(shown if factors else ()):
        yield (
            f"effects{number}",
            f"Effects on {figure.name}",
            "Runs (faint), means (filled) and medians (open) at each value of a factor, or in parts of its range. The dashed "
            "line is the mean of all runs, and a bar the 95 % confidence of a mean's difference from it: a bar that does not "
            "reach the line is an effect.",
            _effects(result, figure, factors),
        )
    if shares := {each.heading: found for each in shown if (found := analysis.shares(each.name))}:
        yield (
            "shares",
            "Shares of the variance",
            "How much of a figure's variance the means at each factor's values explain. The rest are interactions: effects of "
            "a factor that depend on another one. Seeds are chance.",
            _shares(shares),
        )
    if result.study.sampling.method == "saltelli":
        for number, figure in enumerate(shown):
            yield _sobol(result, figure, f"sobol{number}")
    if len(shown) > 1:
        yield (
            "pairs",
            "Figures against each other",
            f"Every point is a run{_coloured_by(result, factors)}.",
            _pairs(result, shown[:_MOST_PAIRED], factors),
        )


def _quantiles(result: SweepResult, shown: Sequence[_Shown]) -> Table:
    table = Table("over all runs", "median", "90 %", "99 %")
    for figure in shown:
        level = result.analysis.over_all(figure.name)
        table.add(figure.heading, *(_interval_cell(each, figure.scale) for each in (level.quantiles if level else ())))
    return table


def _interval_cell(interval: Interval, scale: float) -> Cell:
    low, high = (f"{scale * end:.3g}" if isfinite(end) else "?" for end in (interval.low, interval.high))
    return Cell(f"{scale * interval.value:.4g}", f"{low} to {high}".replace(" ", "\u00a0"))


def _facts(result: SweepResult) -> str:
    facts = (
        ("runs", f"{len(result.table)}", ""),
        ("of them failed", f"{result.failed}", "bad" if result.failed else "good"),
        ("of them new; the others were in the table", f"{result.ran}", ""),
    )
    items = "".join(f'<div><dd class="{kind}">{value}</dd><dt>{name}</dt></div>' for name, value, kind in facts)
    note = "Small figures are the 95 % confidence; a question mark stands where there are too few runs to tell."
    return f"<dl>{items}</dl>\n<p><small>{escape(note)}</small></p>"


def _what_varies(result: SweepResult) -> Table:
    table = Table("what varies", "values", "how")
    for factor in result.study.factors:
        unit, scale = unit_of_factor(result.study, factor.name)
        if factor.sampled:
            values, how = (
                label_of((factor.low, factor.high), scale),
                "sampled" + (", logarithmic" if factor.logarithmic else ""),
            )
        elif factor.is_seed:
            values, how = f"{len(factor.values)} seeds", "replicates"
        else:
            named = [label_of(as_stored(value), scale) for value in factor.values]
            values = ", ".join(named) if len(named) <= 6 else f"{len(named)} values, {named[0]} to {named[-1]}"
            how = "crossed"
        table.add(headed(factor.name, unit), values, how)
    return table


def _distributions(result: SweepResult, shown: Sequence[_Shown], factors: Sequence[Factor]) -> go.Figure:
    columns = min(2, len(shown))
    rows = -(-len(shown) // columns)
    figure = make_subplots(rows, columns, horizontal_spacing=0.09, vertical_spacing=0.32 / rows)
    choices: list[tuple[str, list[tuple[str, Any, str]]]] = [("all runs", [("all runs", slice(None), COLORS["z"])])]
    for factor in factors:
        unit, scale = unit_of_factor(result.study, factor.name)
        parts = [(label_of(value, scale), chosen) for value, chosen in result.analysis.parts(factor)]
        lines = [(label, chosen, color) for (label, chosen), color in zip(parts, _colors(factor, len(parts)), strict=True)]
        choices.append((headed(factor.name, unit), lines))
    first = 1 + factors.index(main) if (main := _main_factor(result, factors)) else 0
    owners = []
    for choice, (_, lines) in enumerate(choices):
        for label, chosen, color in lines:
            for number, each in enumerate(shown):
                x, y = _distribution(each.values[chosen])
                figure.add_scatter(
                    x=x, y=y, name=label, legendgroup=label, showlegend=number == 0, visible=choice == first, mode="lines",
                    line={"color": color, "shape": "hv", "width": 2},
                    hovertemplate=f"{escape(label)}: %{{y:.1f}} % below %{{x:.4~g}}<extra></extra>",
                    **place(number, columns),
                )  # fmt: skip
                owners.append(choice)
    for number, each in enumerate(shown):
        figure.update_xaxes(title_text=each.heading, title_standoff=4, **each.axis, **place(number, columns))
        figure.update_yaxes(title_text="runs below [%]" if number % columns == 0 else "", **place(number, columns))
    buttons = [
        {"label": name, "method": "restyle", "args": [{"visible": [owner == choice for owner in owners]}]}
        for choice, (name, _) in enumerate(choices)
    ]
    height, above, below = 150 + 260 * rows, 105, LAYOUT["margin"]["b"]
    over = {"x": 0.0, "xanchor": "left", "y": 1.0 + 55.0 / (height - above - below), "yanchor": "bottom"}
    layout = {**LAYOUT, "margin": {**LAYOUT["margin"], "t": above}}
    return figure.update_layout(
        layout, height=height, updatemenus=[{"buttons": buttons, "active": first, **over}], legend=LEGEND
    )


def _distribution(values: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    """The points of a cumulative distribution, thinned, from 0 to 100 %."""
    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    if n == 0:
        return [], []
    kept = np.unique(np.linspace(0, n - 1, min(n, _CURVE_POINTS)).round().astype(int))
    return np.concatenate([ordered[:1], ordered[kept]]), np.concatenate([[0.0], 100.0 * (kept + 1) / n])


def _effects(result: SweepResult, shown: _Shown, factors: Sequence[Factor]) -> go.Figure:
    columns = min(len(factors), 4)
    rows = -(-len(factors) // columns)
    figure = make_subplots(rows, columns, shared_yaxes=True, horizontal_spacing=0.02, vertical_spacing=0.3 / rows)
    over_all = result.analysis.over_all(shown.name)
    for number, factor in enumerate(factors):
        where, unit = place(number, columns), unit_of_factor(result.study, factor.name)
        levels = result.analysis.levels(shown.name, factor)
        figure.add_scatter(**_cloud(result, shown, factor, unit[1]), **where)
        figure.add_scatter(**_means(levels, shown, factor, unit[1]), **where)
        figure.add_scatter(**_medians(levels, shown, factor, unit[1]), **where)
        if over_all:
            figure.add_hline(shown.scale * over_all.mean.value, line={"color": FAINT, "dash": "dash", "width": 1}, **where)
        axis: dict[str, Any] = {"type": "log"} if factor.logarithmic else {}
        if not factor.sampled:
            labels = [label_of(as_stored(value), unit[1]) for value in factor.values]
            every = -(-len(labels) // 8)
            ticks = list(range(0, len(labels), every))
            axis = {"tickvals": ticks, "ticktext": labels[::every], "range": [-0.6, len(labels) - 0.4]}
        figure.update_xaxes(title_text=headed(factor.name, unit[0]), title_standoff=4, **axis, **where)
    least, most = np.nanpercentile(shown.values, (0.0, 99.0))
    margin = 0.05 * (most - least) or 0.5
    limits = {} if shown.logarithmic else {"range": [least - margin, most + margin]}
    figure.update_yaxes(**shown.axis, **limits)
    figure.update_yaxes(title_text=shown.heading, col=1)
    return figure.update_layout(LAYOUT, height=90 + 230 * rows, showlegend=False)


def _cloud(result: SweepResult, shown: _Shown, factor: Factor, scale: float) -> dict[str, Any]:
    """The runs, a few of them; crossed values are spread a little."""
    column = result.analysis.column(factor.name)
    if factor.sampled:
        x = scale * column.astype(np.float64)
    else:
        x = np.full(len(column), np.nan)
        for number, (_, chosen) in enumerate(result.analysis.parts(factor)):
            x[chosen] = number
        x += np.random.default_rng(0).uniform(-0.25, 0.25, len(x))
    known = np.flatnonzero(np.isfinite(shown.values))
    kept = known[:: -(-len(known) // _POINTS)]
    return {
        "x": x[kept], "y": shown.values[kept], "mode": "markers", "marker": {"color": FAINT, "size": 4, "opacity": 0.5},
        "hovertemplate": "%{y:.4~g}<extra></extra>",
    }  # fmt: skip


def _places(levels: Sequence[Level], factor: Factor, scale: float) -> list[float]:
    """Where the levels are on the axis of a panel."""
    if factor.sampled:
        return [scale * factor.middle(*each.value) for each in levels]
    order = list(map(as_stored, factor.values))
    return [float(order.index(each.value)) for each in levels]


def _means(levels: Sequence[Level], shown: _Shown, factor: Factor, scale: float) -> dict[str, Any]:
    halves = [each.difference.high - each.difference.value for each in levels]
    return {
        "x": _places(levels, factor, scale), "y": [shown.scale * each.mean.value for each in levels],
        "error_y": {"array": [shown.scale * half if isfinite(half) else 0.0 for half in halves], "thickness": 1.6, "width": 5},
        "mode": "markers" if _is_text(factor) else "markers+lines", "marker": {"color": COLORS["z"], "size": 8},
        "line": {"color": COLORS["z"], "width": 1.5},
        "customdata": [f"{label_of(each.value, scale)}, {each.runs} runs" for each in levels],
        "hovertemplate": "%{customdata}: mean %{y:.4~g} ± %{error_y.array:.2~g}<extra></extra>",
    }  # fmt: skip


def _medians(levels: Sequence[Level], shown: _Shown, factor: Factor, scale: float) -> dict[str, Any]:
    return {
        "x": _places(levels, factor, scale), "y": [shown.scale * each.quantiles[0].value for each in levels],
        "mode": "markers", "marker": {"color": COLORS["x"], "size": 8, "symbol": "diamond-open", "line": {"width": 1.5}},
        "customdata": [label_of(each.value, scale) for each in levels],
        "hovertemplate": "%{customdata}: median %{y:.4~g}<extra></extra>",
    }  # fmt: skip


def _shares(shares: dict[str, dict[str, float]]) -> go.Figure:
    figure = go.Figure()
    names = list(dict.fromkeys(name for found in shares.values() for name in found))
    colors = [FAINT if name == INTERACTIONS else SERIES[i % len(SERIES)] for i, name in enumerate(names)]
    for name, color in zip(names, colors, strict=True):
        parts = [100.0 * found.get(name, 0.0) for found in shares.values()]
        figure.add_bar(
            y=list(shares), x=parts, name=name, orientation="h", marker_color=color,
            text=[f"{part:.0f} %" if part >= 4.0 else "" for part in parts], textposition="inside", insidetextanchor="middle",
            hovertemplate=f"{escape(name)}: %{{x:.1f}} % of %{{y}}<extra></extra>",
        )  # fmt: skip
    legend = {**LEGEND, "traceorder": "normal"}
    axes = {"xaxis": {"title": "share of the variance [%]", "range": [0, 100]}, "yaxis": {"autorange": "reversed"}}
    layout = {**LAYOUT, "margin": {**LAYOUT["margin"], "l": 210, "t": 50}}
    return figure.update_layout(layout, barmode="stack", bargap=0.35, height=120 + 46 * len(shares), legend=legend, **axes)


def _sobol(result: SweepResult, shown: _Shown, name: str) -> tuple[str, str, str, go.Figure | str]:
    title, missing = f"Sobol indices of {shown.name}", result.analysis.no_sensitivities(shown.name)
    if missing:
        return name, title, "", f"<p>{escape(missing)}.</p>"
    caption = (
        "The share of the variance that each sampled factor explains alone (first order), and with all its interactions "
        "(total), with the 95 % confidence. Seeds are averaged."
    )
    cells: dict[str, list[Sensitivity]] = {}
    for each in result.analysis.sensitivities(shown.name):
        at = ((unit_of_factor(result.study, name), name, value) for name, value in each.at.items())
        cells.setdefault(", ".join(f"{headed(name, u)} = {label_of(v, s)}" for (u, s), name, v in at), []).append(each)
    if len(cells) > _MOST_CELLS:
        caption += f" The first {_MOST_CELLS} of {len(cells)} combinations of the crossed factors are drawn; JSON has all."
    return name, title, caption, _index_bars(dict(list(cells.items())[:_MOST_CELLS]))


def _index_bars(cells: dict[str, list[Sensitivity]]) -> go.Figure:
    columns = min(2, len(cells))
    rows = -(-len(cells) // columns)
    factors = max(len(found) for found in cells.values())
    titles = {"subplot_titles": list(cells)} if len(cells) > 1 else {}
    height = (70 if titles else 40) + 46 * factors
    figure = make_subplots(rows, columns, shared_yaxes=True, vertical_spacing=60.0 / (rows * height + 60), **titles)
    for number, found in enumerate(cells.values()):
        for kind, label, color in (("first", "first order", COLORS["z"]), ("total", "total", FAINT)):
            indices = [getattr(each, kind) for each in found]
            figure.add_bar(
                y=[each.factor for each in found], x=[each.value for each in indices], name=label, legendgroup=label,
                showlegend=number == 0, orientation="h", marker_color=color,
                error_x={"array": [each.high - each.value for each in indices], "thickness": 1.4, "width": 4, "color": NEUTRAL},
                hovertemplate=f"%{{y}}: {label} %{{x:.3f}} ± %{{error_x.array:.2~g}}<extra></extra>",
                **place(number, columns),
            )  # fmt: skip
    figure.update_yaxes(autorange="reversed")
    figure.update_xaxes(rangemode="tozero")
    legend = {"orientation": "h", "x": 1.0, "xanchor": "right", "y": 1.0, "yanchor": "bottom"}
    layout = {**LAYOUT, "margin": {**LAYOUT["margin"], "l": 210, "t": 60}}
    return figure.update_layout(layout, height=80 + rows * height, bargap=0.3, legend=legend)


def _pairs(result: SweepResult, shown: Sequence[_Shown], factors: Sequence[Factor]) -> go.Figure:
    pairs = [(x, y) for i, x in enumerate(shown) for y in shown[i + 1 :]]
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = make_subplots(rows, columns, horizontal_spacing=0.08, vertical_spacing=0.28 / rows)
    factor = _main_factor(result, factors)
    parts: list[tuple[str, Any]] = [("all runs", np.ones(len(result.table), np.bool_))]
    colors = [COLORS["z"]]
    if factor:
        scale = unit_of_factor(result.study, factor.name)[1]
        parts = [(label_of(value, scale), chosen) for value, chosen in result.analysis.parts(factor)]
        colors = _colors(factor, len(parts))
    for (label, chosen), color in zip(parts, colors, strict=True):
        for number, (x, y) in enumerate(pairs):
            known = np.flatnonzero(chosen & np.isfinite(x.values) & np.isfinite(y.values))
            kept = known[:: max(1, -(-len(known) * len(parts) // (2 * _POINTS)))]
            figure.add_scatter(
                x=x.values[kept], y=y.values[kept], mode="markers", name=label, legendgroup=label,
                showlegend=factor is not None and number == 0, marker={"color": color, "size": 5, "opacity": 0.65},
                hovertemplate=f"{escape(label)}: %{{x:.4~g}}, %{{y:.4~g}}<extra></extra>", **place(number, columns),
            )  # fmt: skip
    for number, (x, y) in enumerate(pairs):
        figure.update_xaxes(title_text=x.heading, title_standoff=4, **x.axis, **place(number, columns))
        figure.update_yaxes(title_text=y.heading, title_standoff=4, **y.axis, **place(number, columns))
    layout = {**LAYOUT, "margin": {**LAYOUT["margin"], "t": 50}}
    return figure.update_layout(layout, height=90 + 280 * rows, legend=LEGEND)


def _coloured_by(result: SweepResult, factors: Sequence[Factor]) -> str:
    factor = _main_factor(result, factors)
    return f", in the colour of {headed(factor.name, unit_of_factor(result.study, factor.name)[0])}" if factor else ""


def _main_factor(result: SweepResult, factors: Sequence[Factor]) -> Factor | None:
    """The factor whose values the means of the first figure differ by most; None if none varies."""
    name = next((name for name in result.figures() if result.analysis.over_all(name)), "")

    def spread(factor: Factor) -> float:
        means = [each.mean.value for each in result.analysis.levels(name, factor)]
        return max(means) - min(means)

    return max(factors, key=spread, default=None)


def _is_text(factor: Factor) -> bool:
    return not factor.sampled and not isinstance(factor.values[0], int | float)


def _colors(factor: Factor, count: int) -> list[str]:
    """A colour for each value: in order for numbers, far apart for names."""
    if _is_text(factor):
        return [SERIES[i % len(SERIES)] for i in range(count)]
    colors: list[str] = sample_colorscale("Viridis", np.linspace(0.05, 0.85, count).tolist())
    return colors


def _failures(result: SweepResult) -> Table:
    rows = [row for row in result.frame().to_dict("records") if row[REASON] is not None and isinstance(row[REASON], str)]
    table = Table("reason", "runs", "status", "the first of them", left=(0, 3))
    for (reason, status), count in Counter((row[REASON], row[STATUS]) for row in rows).most_common(_MOST_FAILURES):
        first = next(row for row in rows if row[REASON] == reason)
        table.add(reason, f"{count}", status, ", ".join(f"{each.name} = {first[each.name]}" for each in result.study.factors))
    return table


def _failure_caption(result: SweepResult) -> str:
    return f"{result.failed} of {len(result.table)} runs have no figures. The most frequent {_MOST_FAILURES} reasons at most."


def _configuration(result: SweepResult) -> Table:
    study, table = result.study, Table("entry", "value")
    always = ("mechanism", "target", "duration", "rate", "imu", "fusion")
    varied = {each.name for each in study.factors}
    if study.model is not None:
        table.add("model", f"{study.model.name} in {study.model.origin}")
    else:
        for each in fields(SimulationConfig):
            value = getattr(study.run, each.name)
            shown = each.name in always or value != each.default
            if f"run.{each.name}" not in varied and shown and each.name not in ("settings", "wiring"):
                unit, scale = unit_of_factor(study, f"run.{each.name}")
                table.add(headed(f"run.{each.name}", unit), label_of(list(value) if isinstance(value, tuple) else value, scale))
        for setting in study.run.settings:
            table.add(f"plant.{setting.name}", ", ".join(f"{value:g}" for value in setting.value))
        for name, value in study.mechanism.items():
            table.add(f"mechanism.{name}", str(value))
    if study.sampled:
        for name, value in asdict(study.sampling).items():
            table.add(f"sampling.{name}", str(value))
    if study.function is not None:
        table.add("measure.function", f"{study.function.name} in {study.function.origin}")
    table.add("results", str(result.folder))
    table.add("sources", fingerprint())
    return table
