"""The report of a calibration on the rig: what it found, and how well that is known."""

from collections.abc import Mapping
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from hil.calibration.assessment import STAGES, weak_words
from hil.calibration.procedure import RigCalibration
from hil.look import AXIS_NAMES, COLORS, FAINT, NEUTRAL, SERIES
from hil.reports import view
from hil.reports.calibration_picture import KINDS, accuracy_svg
from hil.reports.page import LAYOUT, LEGEND, figure_html, overview, place, write_page
from hil.table import Cell, Table
from plant.dynamics.variables import IMU_COUNT
from plant.imu import MILLI_G

_IMU_NAMES = [f"{imu}" for imu in range(IMU_COUNT)]
_STAGE_COLORS = {"before": FAINT, "known": SERIES[1], "rests": SERIES[0], "motion": SERIES[2]}

_CONSTANTS = {
    "gyroscope bias": ("deg/s", np.degrees(1.0)),
    "accelerometer bias": ("mg", 1.0 / MILLI_G),
    "accelerometer scale": ("%", 100.0),
    "gyroscope scale": ("%", 100.0),
    "alignment": ("deg", np.degrees(1.0)),
    "accelerometer axes": ("%", 100.0),
    "gyroscope axes": ("%", 100.0),
}
"""Unit of each constant, and the factor from SI units to it."""


def write_report(result: RigCalibration, path: Path) -> None:
    """Write the report of a calibration as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    summary, about = result.summary, result.calibration.about
    words = "".join(f"<p>{escape(line[0].upper() + line[1:])}.</p>" for line in weak_words(summary))
    quantities = (("position_rms", "mm", 1e3), ("rotation_rms", "deg", np.degrees(1.0)))
    bars = "\n".join(accuracy_svg(summary, error, unit, scale) for error, unit, scale in quantities)
    rests = figure_html("rests", "The rests", "Where the platform rested, in their order.", _rests(result), "view")
    figures = (
        (
            "accuracy",
            "Accuracy of the pose",
            "RMS over the rests: predicted by the covariance, the difference of calibrations by disjoint halves of the data, "
            "and the error, where the truth is known.",
            f'<div class="pair">{bars}</div>',
        ),
        (
            "residuals",
            "Residuals of the forces",
            "RMS difference of each accelerometer's reading at rest from the one at the fitted pose.",
            _residuals(summary),
        ),
        (
            "constants",
            "Constants",
            "Corrections of each IMU's readings, with three standard deviations. The alignment is about the axes of the IMU's "
            "place; axes are deviations from the right angle.",
            _constants(summary),
        ),
    )
    body = overview(f"{_table(summary).html()}\n{words}", rests) + "".join(figure_html(*figure) for figure in figures)
    title = f"gough: the IMUs of {result.mechanism.name}, calibrated on the rig"
    write_page(path, title, f"{summary['rests']} rests · {about['date']} · gough {about['version']}", body)


def _table(summary: Mapping[str, Any]) -> Table:
    table = Table("", "residual [mg]", "at rests left out [mg]", *(f"{name} [mm]" for name, _ in KINDS.values()))
    for stage, residual in summary["residual_mg"].items():
        left_out = summary["validated"].get(stage, {}).get("left_out_mg")
        table.add(
            STAGES[stage],
            f"{residual:.3f}",
            "" if left_out is None else f"{left_out:.3f}",
            *(_accuracy(summary[kind].get(stage)) for kind in KINDS),
        )
    return table


def _accuracy(errors: dict[str, float] | None) -> Cell:
    if errors is None:
        return Cell("")
    return Cell(f"{1e3 * errors['position_rms']:.3f}", f"{np.degrees(errors['rotation_rms']):.3f} deg")


def _residuals(summary: Mapping[str, Any]) -> go.Figure:
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
    return figure.update_layout(LAYOUT, height=330, legend=LEGEND)


def _constants(summary: Mapping[str, Any]) -> go.Figure:
    columns = 2
    rows = -(-len(_CONSTANTS) // columns)
    figure = make_subplots(rows, columns, horizontal_spacing=0.08, vertical_spacing=0.06)
    for number, (name, (unit, scale)) in enumerate(_CONSTANTS.items()):
        found = summary["constants"][name]
        values, sigmas = scale * np.array(found["values"]), scale * np.array(found["sigmas"])
        for axis, label in enumerate(AXIS_NAMES):
            axes = ("xy", "xz", "yz")[axis]
            shown = axes if name.endswith("axes") else label
            figure.add_scatter(
                x=np.arange(IMU_COUNT) + 0.18 * (axis - 1),
                y=values[:, axis],
                error_y={"array": 3.0 * sigmas[:, axis], "thickness": 1.5, "width": 3},
                mode="markers",
                marker={"color": COLORS[label], "size": 7},
                name=f"{label} (axes: {axes})",
                legendgroup=label,
                showlegend=number == 0,
                customdata=sigmas[:, axis],
                hovertemplate=f"{shown}: %{{y:.4~g}} ± %{{customdata:.2~g}} {unit}<extra></extra>",
                **place(number, columns),
            )
        figure.update_yaxes(title_text=f"{name} [{unit}]", zerolinecolor=NEUTRAL, **place(number, columns))
    figure.update_xaxes(tickvals=list(range(IMU_COUNT)), title_text="IMU", title_standoff=2)
    return figure.update_layout(LAYOUT, height=60 + 230 * rows, legend=LEGEND)


def _rests(result: RigCalibration) -> go.Figure:
    positions = 1e3 * np.array(result.summary["positions"])
    rests = go.Scatter3d(
        view.coordinates(positions),
        mode="markers+text",
        text=[str(n) for n in range(len(positions))],
        marker={"size": 4, "color": COLORS["z"]},
        textfont={"size": 10, "color": NEUTRAL},
        hovertemplate="rest %{text}: %{x:.1f}, %{y:.1f}, %{z:.1f} mm<extra></extra>",
    )
    figure = go.Figure([view.line(positions, FAINT, 2), rests])
    scene = view.scene(positions, result.mechanism.up_in_base)
    return figure.update_layout(LAYOUT, **view.VIEW, height=460, scene=scene)
