"""The report of a real planar rig: errors of its poses, and the assembly modes."""

from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from hil.look import BAND, SERIES
from hil.reports.page import LAYOUT, LEGEND, figure_html, place, write_page
from hil.reports.view import segments
from hil.studies.planar_rig import COMPONENTS, SOURCES, TRUE_ANGLE, TRUE_DISTANCE_M, RigEvaluation, modes_near
from hil.table import Table
from plant.mechanism.planar import PlanarMechanism
from plant.pose import Array

_COLORS = dict(zip(SOURCES, (SERIES[1], SERIES[0], SERIES[2]), strict=True))
_DRAWN = SOURCES.index("kalman")
_COLUMNS_DRAWN = 4


def write_report(result: RigEvaluation, path: Path) -> None:
    """Write the report of an evaluation as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    summary, poses = result.summary(), len(result.poses)
    errors = figure_html(
        "errors",
        "Error of the pose",
        "Mean over the samples of a pose, estimate minus truth; the bars are the standard deviation of one sample.",
        _error_plot(result),
    )
    modes = figure_html(
        "modes",
        "Assembly modes",
        f"The two poses that the mean {SOURCES[_DRAWN]} leg angles allow, and the true pose in grey. The conditioning is that "
        "of the mode nearest to it.",
        _mode_plot(result),
    )
    samples = sum(pose.errors.shape[1] for pose in result.poses)
    subtitle = f"{samples} samples of each source · leg angles only · gough {summary['version']}"
    body = f"{_table(summary['sources'], poses).html()}\n{errors}\n{modes}"
    write_page(path, f"gough: {result.mechanism.name} at {poses} known poses", subtitle, body)


def _table(sources: dict[str, Any], poses: int) -> Table:
    mode = f"a mode within {1e3 * TRUE_DISTANCE_M:g} mm, {np.degrees(TRUE_ANGLE):g} deg"
    table = Table(
        "",
        *(("RMS of the mean errors", f"{name} [{unit}]") for name, unit, _ in COMPONENTS),
        *(("leg angles [deg]", name) for name in ("constant error", "noise")),
        *((mode, name) for name in ("poses", "samples")),
    )
    for source, figures in sources.items():
        true = figures["true_mode"]
        table.add(
            source,
            *(f"{scale * figures['rms'][name]:.2f}" for name, _, scale in COMPONENTS),
            *(f"{np.degrees(figures['leg_angles'][name]):.2f}" for name in ("constant_error", "noise")),
            f"{true['poses']} of {poses}",
            f"{100.0 * true['samples']:.1f} %",
        )
    return table


def _error_plot(result: RigEvaluation) -> go.Figure:
    figure = make_subplots(len(COMPONENTS), 1, shared_xaxes=True, vertical_spacing=0.05)
    places = np.arange(len(result.poses))
    for row, (name, unit, scale) in enumerate(COMPONENTS):
        for i, source in enumerate(SOURCES):
            errors = [scale * pose.errors[i, :, row] for pose in result.poses]
            figure.add_scatter(
                x=places + 0.15 * (i - 1),
                y=np.array([error.mean() for error in errors]),
                error_y={"array": np.array([error.std() for error in errors]), "thickness": 1.5},
                mode="markers",
                marker={"color": _COLORS[source], "size": 8},
                name=source,
                legendgroup=source,
                showlegend=row == 0,
                hovertemplate=f"{source}: %{{y:.2f}} {unit}<extra></extra>",
                row=row + 1,
                col=1,
            )
        figure.update_yaxes(title_text=f"{name} [{unit}]", row=row + 1)
    figure.update_xaxes(tickvals=places, ticktext=[escape(pose.name) for pose in result.poses])
    return figure.update_layout(LAYOUT, height=620, legend=LEGEND)


def _mode_plot(result: RigEvaluation) -> go.Figure:
    drawn = [(pose, *modes_near(result.mechanism, pose, _DRAWN)) for pose in result.poses]
    columns = min(_COLUMNS_DRAWN, len(drawn))
    rows = -(-len(drawn) // columns)
    figure = make_subplots(
        rows,
        columns,
        subplot_titles=[f"{escape(pose.name)}, conditioning {near.conditioning:.2f}" for pose, near, _ in drawn],
        horizontal_spacing=0.05,
        vertical_spacing=0.25 / rows,
    )
    for number, (pose, near, far) in enumerate(drawn):
        for name, position, angle, line in (
            ("true pose", pose.true_pose[:2], pose.true_pose[2], {"color": BAND, "width": 7}),
            ("mode nearest to it", near.position, near.angle, {"color": SERIES[0], "width": 2}),
            ("other mode", far.position, far.angle, {"color": SERIES[1], "width": 2, "dash": "dot"}),
        ):
            x, y = 1e3 * _outline(result.mechanism, position, angle).T
            figure.add_scatter(
                x=x, y=y, mode="lines", line=line, name=name, legendgroup=name, showlegend=number == 0, hoverinfo="skip",
                **place(number, columns),
            )  # fmt: skip
        figure.update_yaxes(scaleanchor=f"x{number + 1}" if number else "x", **place(number, columns))
    figure.update_xaxes(title_text="x [mm]", row=rows)
    figure.update_yaxes(title_text="y [mm]", col=1)
    return figure.update_layout(LAYOUT, height=120 + 330 * rows, legend={**LEGEND, "y": 1.06})


def _outline(mechanism: PlanarMechanism, position: Array, angle: float) -> Array:
    """Points (13, 2) [m] of the legs, with gaps between, and round the platform."""
    joints = mechanism.joints_at(position, angle)
    return np.concatenate([segments(mechanism.base_joints, joints), joints, joints[:1]])
