"""The report of a calibration on the rig: one HTML file that opens offline, with what was found and how well it is known."""

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from hil.calibration.assessment import STAGES, weak_words
from hil.calibration.drive import RigCalibration
from hil.reports.page import (
    AXIS_NAMES,
    COLORS,
    FAINT,
    INK,
    LAYOUT,
    coordinates,
    figure_html,
    line_trace,
    page,
    scene,
)
from plant.dynamics.variables import IMU_COUNT
from plant.files import write_whole
from plant.imu import MILLI_G

_IMU_NAMES = [f"{imu}" for imu in range(IMU_COUNT)]
_STAGE_COLORS = {"before": FAINT, "known": "#e8871e", "rests": "#3b6fb6", "motion": "#3a9d6e"}
_KINDS = {"predicted": ("predicted", FAINT), "validated": ("halves differ by", "#e8871e"), "true": ("true", "#3b6fb6")}
"""Measures of accuracy in the summary, with their names and colors."""

_CONSTANTS = {
    "gyroscope bias": ("deg/s", np.degrees(1.0)),
    "accelerometer bias": ("mg", 1.0 / MILLI_G),
    "accelerometer scale": ("%", 100.0),
    "gyroscope scale": ("%", 100.0),
    "alignment": ("deg", np.degrees(1.0)),
    "accelerometer axes": ("%", 100.0),
    "gyroscope axes": ("%", 100.0),
}
"""Unit of each constant, and what SI units are multiplied by."""


def write_report(result: RigCalibration, path: Path) -> None:
    """Write the report of a calibration as one HTML file, which takes its place only when it is complete.

    Raises:
        InputError: the file cannot be written.
    """
    summary, about = result.summary, result.calibration.about
    title = f"gough: the IMUs of {escape(result.mechanism.name)}, calibrated on the rig"
    words = "".join(f"<p>{escape(line[0].upper() + line[1:])}.</p>" for line in weak_words(summary))
    rests = figure_html("rests", "The rests", "Where the platform rested, in their order.", _rests(result), "view")
    figures = (
        (
            "accuracy",
            "Accuracy of the pose",
            "RMS over the rests: as the covariance predicts it, by how much calibrations by disjoint halves of the data differ,"
            " and the error, where the truth is known.",
            _accuracy(summary),
        ),
        (
            "residuals",
            "Residuals of the forces",
            "What is left of each accelerometer's reading at rest when the pose has been fitted, RMS.",
            _residuals(summary),
        ),
        (
            "constants",
            "Constants",
            "What each IMU reads is changed by, with three standard deviations; alignment is about the axes of its place, and "
            "axes are off the right angle.",
            _constants(summary),
        ),
    )
    body = f"""<section class="overview">
<div>
{_table(summary)}
{words}
</div>
{rests}</section>
{"".join(figure_html(*figure, "time") for figure in figures)}"""
    subtitle = escape(f"{summary['rests']} rests · {about['date']} · gough {about['version']}")
    write_whole(path, page(title, subtitle, body).encode())


def _table(summary: dict[str, Any]) -> str:
    rows = []
    for stage, residual in summary["residual_mg"].items():
        left_out = summary["validated"].get(stage, {}).get("left_out_mg")
        cells = [f"{residual:.3f}", "" if left_out is None else f"{left_out:.3f}"]
        for kind in _KINDS:
            errors = summary[kind].get(stage)
            cells.append(
                ""
                if errors is None
                else f"{1e3 * errors['position_rms']:.3f}<small>{np.degrees(errors['rotation_rms']):.3f} deg</small>"
            )
        rows.append(f"<tr><th>{STAGES[stage]}</th>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>\n")
    heads = ("residual [mg]", "at rests left out [mg]", *(f"{name} [mm]" for name, _ in _KINDS.values()))
    return f"""<table>
<thead><tr><th></th>{"".join(f"<th>{head}</th>" for head in heads)}</tr></thead>
<tbody>
{"".join(rows)}</tbody>
</table>"""


def _accuracy(summary: dict[str, Any]) -> go.Figure:
    figure = make_subplots(1, 2, horizontal_spacing=0.1)
    for column, (key, unit, scale) in enumerate(
        (("position_rms", "mm", 1e3), ("rotation_rms", "deg", np.degrees(1.0))), start=1
    ):
        for kind, (name, color) in _KINDS.items():
            stages = [stage for stage in summary["residual_mg"] if stage in summary[kind]]
            values = [scale * summary[kind][stage][key] for stage in stages]
            figure.add_bar(
                x=[STAGES[stage] for stage in stages],
                y=values,
                name=name,
                legendgroup=name,
                showlegend=column == 1,
                marker_color=color,
                hovertemplate=f"{name}: %{{y:.3~g}} {unit}<extra></extra>",
                row=1,
                col=column,
            )
        figure.update_yaxes(type="log", title_text=f"{key.partition('_')[0]} [{unit}]", dtick=1, row=1, col=column)
    return figure.update_layout(LAYOUT, height=330, legend=_LEGEND)


def _residuals(summary: dict[str, Any]) -> go.Figure:
    figure = go.Figure()
    for stage, values in summary["residual_by_imu_mg"].items():
        figure.add_bar(
            x=_IMU_NAMES,
            y=values,
            name=STAGES[stage],
            marker_color=_STAGE_COLORS[stage],
            hovertemplate="IMU %{x}: %{y:.3~g} mg<extra></extra>",
        )
    figure.update_yaxes(type="log", title_text="residual [mg]", dtick=1)
    figure.update_xaxes(title_text="IMU", type="category")
    return figure.update_layout(LAYOUT, height=330, legend=_LEGEND)


def _constants(summary: dict[str, Any]) -> go.Figure:
    columns = 2
    rows = -(-len(_CONSTANTS) // columns)
    figure = make_subplots(rows, columns, horizontal_spacing=0.08, vertical_spacing=0.06)
    for number, (name, (unit, scale)) in enumerate(_CONSTANTS.items()):
        row, column = divmod(number, columns)
        found = summary["constants"][name]
        values, sigmas = scale * np.array(found["values"]), scale * np.array(found["sigmas"])
        for axis, label in enumerate(AXIS_NAMES):
            shown = ("xy", "xz", "yz")[axis] if name.endswith("axes") else label
            figure.add_scatter(
                x=np.arange(IMU_COUNT) + 0.18 * (axis - 1),
                y=values[:, axis],
                error_y={"array": 3.0 * sigmas[:, axis], "thickness": 1.5, "width": 3},
                mode="markers",
                marker={"color": COLORS[label], "size": 7},
                name=f"{label} (axes: {('xy', 'xz', 'yz')[axis]})",
                legendgroup=label,
                showlegend=number == 0,
                customdata=sigmas[:, axis],
                hovertemplate=f"{shown}: %{{y:.4~g}} ± %{{customdata:.2~g}} {unit}<extra></extra>",
                row=row + 1,
                col=column + 1,
            )
        figure.update_yaxes(title_text=f"{name} [{unit}]", zerolinecolor=INK, row=row + 1, col=column + 1)
    figure.update_xaxes(tickvals=list(range(IMU_COUNT)), title_text="IMU", title_standoff=2)
    return figure.update_layout(LAYOUT, height=60 + 230 * rows, legend=_LEGEND)


def _rests(result: RigCalibration) -> go.Figure:
    positions = 1e3 * np.array(result.summary["positions"])
    figure = go.Figure(
        [
            line_trace(coordinates(positions), FAINT, 2),
            go.Scatter3d(
                coordinates(positions),
                mode="markers+text",
                text=[str(n) for n in range(len(positions))],
                marker={"size": 4, "color": COLORS["z"]},
                textfont={"size": 10, "color": INK},
                hovertemplate="rest %{text}: %{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>",
            ),
        ]
    )
    return figure.update_layout(
        LAYOUT,
        height=460,
        margin={"l": 0, "r": 0, "t": 0, "b": 10},
        showlegend=False,
        scene=scene(positions, result.mechanism.up_in_base),
    )


_LEGEND = {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"}
