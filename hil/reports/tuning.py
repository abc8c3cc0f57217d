"""The report of a design of gains: Bode, Nyquist and step diagrams at home and at the worst pose, and maps of margins."""

from collections.abc import Sequence
from html import escape
from importlib.metadata import version
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from controller.design.stability import Response, sensitivity, single_loops, step_responses
from controller.design.tuning import FIGURES, Design
from controller.workspace import AXES
from hil.look import COLORS, FAINT, LEG_NAMES, NEUTRAL
from hil.reports.page import LAYOUT, LEGEND, figure_html, place, write_page
from hil.table import Table
from plant.mechanism.loads import moving_axes

_PEAK = "sensitivity peak, all loops"
_MAPPED = (_PEAK, "phase margin", "gain margin")
_PLANES = ((0, 1), (0, 2), (3, 4), (0, 5))
_STEP_S = 1.0
_NEAR = 3.0
"""How far the Nyquist diagram reaches."""


def write_report(design: Design, tables: Sequence[tuple[str, Table]], path: Path) -> None:
    """Write a design as one HTML file, with the tables that the command prints.

    Raises:
        InputError: the file cannot be written.
    """
    body = "".join(f"<h2>{escape(title, quote=False)}</h2>\n{table.html()}\n" for title, table in tables)
    body += f"<p>{escape(design.remark[0].upper() + design.remark[1:], quote=False)}.</p>\n"
    worst = design.worst(_PEAK)
    shown = {"at home": (design.responses[0], "solid")}
    if worst is not None:
        shown["at the worst pose"] = (design.responses[1 + design.workspace.index(worst)], "dot")
    dotted = "" if worst is None else " Dotted: at the pose of the workspace with the greatest sensitivity peak."
    each = "The loop of each leg with the others closed, with the designed gains."
    figures = [
        ("bode", "Bode diagram", each + dotted, _bode(design, shown)),
        (
            "nyquist",
            "Nyquist diagram",
            f"{each} The circle is where a loop of its own would have the sensitivity peak that the rule allows.{dotted}",
            _nyquist(design, shown),
        ),
        (
            "steps",
            "Step responses",
            "Estimated length of each leg after a step of its own reference, by feedback alone: a planned motion has no steps, "
            f"and its speed is fed forward.{dotted}",
            _steps(design, shown),
        ),
    ]
    if design.workspace:
        caption = "The poses that were drawn from the workspace, as moves and turns from home."
        figures.append(("maps", "Margins over the workspace", caption, _maps(design)))
    body += "".join(figure_html(*figure) for figure in figures)
    subtitle = f"{design.setup.rate:g} Hz · delay {1e3 * design.setup.delay:g} ms · gough {version('gough')}"
    write_page(path, f"gough: gains of {design.mechanism.name}", subtitle, body)


Shown = dict[str, tuple[Response, str]]


def _bode(design: Design, shown: Shown) -> go.Figure:
    figure = make_subplots(2, 1, shared_xaxes=True, vertical_spacing=0.04)
    for where, (response, dash) in shown.items():
        _, inverse = sensitivity(response, design.gains)
        loops = single_loops(inverse)
        phases = np.degrees(np.unwrap(np.angle(loops), axis=0))
        phases -= 360.0 * np.round((phases[0] + 90.0) / 360.0)
        for k in range(response.count):
            line = {"color": COLORS[LEG_NAMES[k]], "dash": dash, "width": 1.5}
            for number, values in enumerate((20.0 * np.log10(np.abs(loops[:, k])), phases[:, k])):
                figure.add_scatter(
                    x=response.frequencies, y=np.round(values, 3), line=line, name=LEG_NAMES[k], legendgroup=LEG_NAMES[k],
                    showlegend=dash == "solid" and number == 0, hovertemplate=f"%{{x:.3~g}} Hz: %{{y:.3~g}}, {where}",
                    **place(number, 1),
                )  # fmt: skip
    for number, level in enumerate((0.0, -180.0)):
        figure.add_hline(level, line={"color": FAINT, "width": 1}, **place(number, 1))
    figure.update_xaxes(type="log")
    figure.update_xaxes(title_text="frequency [Hz]", row=2)
    figure.update_yaxes(title_text="loop gain [dB]", row=1)
    figure.update_yaxes(title_text="phase [deg]", dtick=90, row=2)
    return figure.update_layout(LAYOUT, height=560, legend=LEGEND)


def _nyquist(design: Design, shown: Shown) -> go.Figure:
    figure = go.Figure()
    for where, (response, dash) in shown.items():
        _, inverse = sensitivity(response, design.gains)
        loops = single_loops(inverse)
        for k in range(response.count):
            near = np.where(np.abs(loops[:, k]) < 2.0 * _NEAR, loops[:, k], np.nan)
            figure.add_scatter(
                x=np.round(near.real, 4), y=np.round(near.imag, 4), customdata=response.frequencies, name=LEG_NAMES[k],
                line={"color": COLORS[LEG_NAMES[k]], "dash": dash, "width": 1.5}, legendgroup=LEG_NAMES[k],
                showlegend=dash == "solid", hovertemplate=f"%{{customdata:.3~g}} Hz: %{{x:.3f}} %{{y:+.3f}}i, {where}",
            )  # fmt: skip
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    radius = 1.0 / design.rule.sensitivity
    figure.add_scatter(
        x=-1.0 + radius * np.cos(turn), y=radius * np.sin(turn), line={"color": FAINT}, name="allowed peak", hoverinfo="skip"
    )
    figure.add_scatter(x=[-1.0], y=[0.0], mode="markers", marker={"color": NEUTRAL, "symbol": "cross"}, showlegend=False)
    figure.update_xaxes(range=[-_NEAR, 1.0], title_text="real part")
    figure.update_yaxes(range=[-_NEAR, _NEAR], scaleanchor="x", title_text="imaginary part")
    return figure.update_layout(LAYOUT, height=560, legend=LEGEND)


def _steps(design: Design, shown: Shown) -> go.Figure:
    figure = go.Figure()
    for where, (response, dash) in shown.items():
        times, lengths = step_responses(response, design.gains, _STEP_S)
        for k in range(response.count):
            figure.add_scatter(
                x=np.round(times, 6), y=np.round(lengths[:, k], 4), name=LEG_NAMES[k], legendgroup=LEG_NAMES[k],
                line={"color": COLORS[LEG_NAMES[k]], "dash": dash, "width": 1.5}, showlegend=dash == "solid",
                hovertemplate=f"%{{x:.3f}} s: %{{y:.3f}}, {where}",
            )  # fmt: skip
    figure.update_xaxes(title_text="time [s]")
    figure.update_yaxes(title_text="length, of a step of 1")
    return figure.update_layout(LAYOUT, height=380, legend=LEGEND)


def _maps(design: Design) -> go.Figure:
    moving = moving_axes(design.mechanism)
    planes = [plane for plane in _PLANES if {*plane} <= {*moving}][:3]
    moves = np.array([np.concatenate(each.where(design.home)) for each in design.workspace])
    moves *= np.repeat([1e3, np.degrees(1.0)], 3)
    figure = make_subplots(len(_MAPPED), len(planes), horizontal_spacing=0.09, vertical_spacing=0.09)
    for row, name in enumerate(_MAPPED):
        unit, _, scale, value, greatest = FIGURES[name]
        values = [scale * value(each.margins) for each in design.workspace]
        height = 1.0 / len(_MAPPED)
        bar = {"title": unit, "len": 0.9 * height, "y": 1.0 - (row + 0.5) * height, "thickness": 12}
        for column, (x, y) in enumerate(planes):
            figure.add_scatter(
                x=np.round(moves[:, x], 2), y=np.round(moves[:, y], 2), mode="markers", showlegend=False,
                marker={
                    "color": np.round(values, 3), "colorscale": "Viridis", "reversescale": greatest, "size": 9,
                    "showscale": column == 0, "colorbar": bar, "line": {"color": NEUTRAL, "width": 0.5},
                },
                hovertemplate=f"{name} %{{marker.color:.3~g}} {unit}<extra></extra>",
                **place(row * len(planes) + column, len(planes)),
            )  # fmt: skip
            titles = [f"{AXES[axis]} [{'mm' if axis < 3 else 'deg'}]" for axis in (x, y)]
            at = {"row": row + 1, "col": column + 1}
            figure.update_xaxes(title_text=titles[0], **at)
            figure.update_yaxes(title_text=f"{name}<br>{titles[1]}" if column == 0 else titles[1], **at)
    return figure.update_layout(LAYOUT, height=300 * len(_MAPPED))
