"""The report of a comparison: its tables, and the courses of the recordings on top of each other."""

from collections.abc import Iterator, Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from hil.look import BAND, LEG_NAMES, NEUTRAL, POSITION, ROTATION, SERIES
from hil.reports.curves import curve
from hil.reports.page import LAYOUT, LEGEND, figure_html, place, write_page
from hil.runs.comparison import Comparison, Course
from plant.pose import Array

_SHARES = np.concatenate([np.linspace(0.0, 0.98, 197), 1.0 - np.geomspace(0.02, 1e-5, 120), [1.0]])
"""Where a distribution is drawn."""


class _Drawn(NamedTuple):
    """A recording in the plots."""

    name: str
    color: str
    course: Course


def write_report(comparison: Comparison, path: Path) -> None:
    """Write a comparison as one HTML file; only recordings have a course to draw.

    Raises:
        InputError: the file cannot be written.
    """
    drawn = [
        _Drawn(run.name, SERIES[number % len(SERIES)], run.course)
        for number, run in enumerate(comparison.ordered)
        if run.course is not None
    ]
    caption = "Configurations as far as they differ, and figures, with their difference and ratio to the first run's."
    remarks = "".join(f"<p>{escape(remark[0].upper() + remark[1:])}.</p>\n" for remark in comparison.remarks)
    body = f"<section>\n{comparison.table(notes=True).html()}\n<p>{caption}</p>\n{remarks}</section>\n"
    body += "".join(figure_html(*figure) for figure in _figures(comparison, drawn))
    if not drawn:
        body += "<p>Figures alone have no course to draw: for plots, compare recordings of <code>gough run --record</code>.</p>"
    body += figure_html("events", "Events", "Of the whole runs.", comparison.events_table().html())
    names = ", ".join(run.name for run in comparison.others)
    subtitle = f"{comparison.seconds:.3f} s of motion · gough {version('gough')}"
    write_page(path, f"gough: {names} against {comparison.reference.name}", subtitle, body)


def _figures(comparison: Comparison, drawn: Sequence[_Drawn]) -> Iterator[tuple[str, str, str, go.Figure]]:
    """Name, title, caption and figure of each plot."""
    known = [each for each in drawn if np.isfinite(each.course.estimation).any()]
    if known:
        yield "errors", "Errors", "Sizes of the errors over time.", _errors_over_time(known)
        caption = "The share of the cycles in which each error is smaller: left is better."
        yield "distribution", "Distribution of the errors", caption, _distributions(known)
    if drawn:
        caption = "The share of the cycles that took longer, or that began later, than each time: left is better."
        yield "times", "Distribution of the times", caption, _times(drawn)
    if drawn and comparison.one_mechanism:
        caption = "The estimated length of each leg, in grey that of the first run's reference, and the ends of its stroke."
        yield "lengths", "Leg lengths", caption, _lengths(drawn)


class _Error(NamedTuple):
    """An error that is drawn: of a course's `group`, the columns `part`."""

    label: str
    group: str
    part: slice
    unit: str
    scale: float

    def of(self, course: Course) -> Array:
        """Its sizes (N,) in its unit."""
        sizes: Array = self.scale * np.linalg.norm(getattr(course, self.group)[:, self.part], axis=1)
        return sizes


_ERRORS = [
    _Error(f"{words}<br>{label}", group, part, unit, scale)
    for label, part, unit, scale in ((POSITION, slice(3), "mm", 1e3), (ROTATION, slice(3, 6), "deg", float(np.degrees(1.0))))
    for group, words in (("estimation", "estimate - truth"), ("tracking", "truth - reference"))
]


def _errors_over_time(drawn: Sequence[_Drawn]) -> go.Figure:
    figure = _panels(len(_ERRORS), 2, shared_xaxes="all")
    for number, error in enumerate(_ERRORS):
        for each in drawn:
            figure.add_scatter(
                **curve(each.course.times, error.of(each.course), each.name, error.unit), **_look(each, number, 2)
            )
        figure.update_yaxes(title_text=error.label, rangemode="tozero", **place(number, 2))
    return _finished(figure, len(_ERRORS) // 2, "time [s]")


def _distributions(drawn: Sequence[_Drawn]) -> go.Figure:
    figure = _panels(len(_ERRORS), 2, vertical_spacing=0.2)
    for number, error in enumerate(_ERRORS):
        for each in drawn:
            sizes = error.of(each.course)
            sizes = sizes[np.isfinite(sizes)]
            if len(sizes):
                figure.add_scatter(
                    x=np.quantile(sizes, _SHARES).astype(np.float32), y=(100.0 * _SHARES).astype(np.float32),
                    mode="lines", hovertemplate=f"{each.name}: %{{y:.4~g}} % below %{{x:.4~g}} {error.unit}<extra></extra>",
                    **_look(each, number, 2),
                )  # fmt: skip
        figure.update_xaxes(title_text=error.label.replace("<br>", ", "), **place(number, 2))
        figure.update_yaxes(title_text="cycles below [%]", **place(number, 2))
    return _finished(figure, len(_ERRORS) // 2)


def _times(drawn: Sequence[_Drawn]) -> go.Figure:
    figure = _panels(2, 2)
    for number, (name, label) in enumerate((("compute", "computing [us]"), ("late", "woken late [us]"))):
        for each in drawn:
            times = 1e6 * getattr(each.course, name)
            figure.add_scatter(
                x=np.maximum(np.quantile(times, _SHARES), 1e-3).astype(np.float32),
                y=np.maximum(100.0 * (1.0 - _SHARES), 1e-3).astype(np.float32),
                mode="lines", hovertemplate=f"{each.name}: %{{y:.3~g}} % above %{{x:.4~g}} us<extra></extra>",
                **_look(each, number, 2),
            )  # fmt: skip
        figure.update_xaxes(title_text=label, type="log", **place(number, 2))
        figure.update_yaxes(title_text="cycles above [%]", type="log", **place(number, 2))
    return _finished(figure, 1)


def _lengths(drawn: Sequence[_Drawn]) -> go.Figure:
    first = drawn[0].course
    legs = first.lengths.shape[1]
    figure = _panels(legs, 3, shared_xaxes="all")
    for leg in range(legs):
        at = place(leg, 3)
        planned = curve(first.times, 1e3 * first.planned[:, leg], "reference", "mm")
        line = {"color": BAND, "width": 5}
        figure.add_scatter(**planned, name="reference", legendgroup="reference", showlegend=leg == 0, line=line, **at)
        for each in drawn:
            lengths = 1e3 * each.course.lengths[:, leg]
            figure.add_scatter(**curve(each.course.times, lengths, each.name, "mm"), **_look(each, leg, 3))
        for end in 1e3 * first.stroke[leg]:
            figure.add_hline(end, line={"color": NEUTRAL, "width": 1, "dash": "dash"}, **at)
        figure.update_yaxes(title_text=f"{LEG_NAMES[leg]} [mm]", **at)
    return _finished(figure, -(-legs // 3), "time [s]")


def _panels(count: int, columns: int, **settings: Any) -> go.Figure:
    rows = -(-count // columns)
    return make_subplots(rows, columns, **{"horizontal_spacing": 0.09, "vertical_spacing": 0.16 / rows, **settings})


def _look(each: _Drawn, number: int, columns: int) -> dict[str, Any]:
    """The look and the place of a run's curve in a panel; the legend has each run once."""
    line = {"color": each.color, "width": 1.5}
    return {"name": each.name, "legendgroup": each.name, "showlegend": number == 0, "line": line, **place(number, columns)}


def _finished(figure: go.Figure, rows: int, below: str = "") -> go.Figure:
    if below:
        figure.update_xaxes(title_text=below, row=rows)
    return figure.update_layout(LAYOUT, height=70 + 240 * rows, legend=LEGEND)
