"""The report of a mechanism's class: needs of each method, graph of the legs, and conditioning."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from hil.look import COLORS, LEG_NAMES, NEUTRAL, ring
from hil.reports import view
from hil.reports.page import LAYOUT, figure_html, overview, write_page
from hil.studies.classification import PAPER, Description, Need, joints_about, planar_home
from hil.table import Cell, Table
from plant.mechanism import Mechanism
from plant.mechanism.classification import canonical_legs, joint_numbers, layout
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism


def write_report(description: Description, path: Path) -> None:
    """Write the description of a mechanism as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    mechanism, mechanism_class = description.mechanism, description.mechanism_class
    figure = _planar_view(mechanism) if isinstance(mechanism, PlanarMechanism) else _spatial_view(mechanism)
    graph = (
        "graph",
        "Graph of the legs",
        "Platform joints above, base joints below; legs in the colours of the mechanism.",
        _graph(description),
        "view",
    )
    spread = (
        "conditioning",
        "Conditioning",
        f"The share of {description.where} at which the conditioning of each method, with all legs, is lower. 1 is best; "
        "the sensors' noise grows by about the reciprocal.",
        _conditioning(description),
    )
    table = Table("", "needs", ("conditioning", "home"), ("conditioning", "worst"))
    for need in description.needs:
        requirement = need.requirement
        needs = Cell(requirement.text, requirement.choice_text)
        table.add(Cell(requirement.method, _claim(need)), needs, f"{need.home:.2g}", f"{need.worst:.2g}")
    subtitle = (
        f"{mechanism_class.name} · {mechanism_class.base_count} base and {mechanism_class.platform_count} platform joints · "
        f"graph {mechanism_class.drawing} · gough {version('gough')}"
    )
    drawn = figure_html("mechanism", "The mechanism", "At home, in mm.", figure, "view")
    body = overview(f"{table.html()}\n{figure_html(*graph)}", drawn) + figure_html(*spread)
    write_page(path, f"gough: {mechanism.name} is of class {mechanism_class.label}", subtitle, body)


def _claim(need: Need) -> str:
    section = PAPER.get(need.requirement.method)
    unique = "unique" if need.modes == 1 else f"{need.modes} assembly modes"
    return f"the paper's section {section}, {unique}" if section else unique


def _graph(description: Description) -> go.Figure:
    base, platform = layout(description.mechanism_class)
    figure = go.Figure()
    for number, (lower, upper) in enumerate(canonical_legs(description.mechanism)):
        figure.add_scatter(
            x=[base[lower], platform[upper]], y=[0.0, 1.0], mode="lines", showlegend=False, name=LEG_NAMES[number],
            hoverinfo="name", line={"color": COLORS[LEG_NAMES[number]], "width": 4},
        )  # fmt: skip
    for x, y, name in ((base, 0.0, "base joint"), (platform, 1.0, "platform joint")):
        figure.add_scatter(
            x=x, y=np.full(len(x), y), mode="markers", showlegend=False, marker={"size": 15, "color": NEUTRAL},
            hovertemplate=f"{name} %{{pointNumber}}<extra></extra>",
        )  # fmt: skip
    hidden = {"visible": False, "fixedrange": True}
    return figure.update_layout(LAYOUT, height=220, xaxis=hidden, yaxis={**hidden, "range": [-0.3, 1.3]})


def _spatial_view(mechanism: Mechanism) -> go.Figure:
    base = 1e3 * mechanism.base_joints
    home = mechanism.nominal_home
    joints = 1e3 * (home.position + mechanism.platform_joints @ home.rotation.T)
    numbers = joint_numbers(mechanism.base_joints)
    shared = [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]
    labels = np.array([base[legs[0]] + 0.12 * (base[legs[0]] - base.mean(axis=0)) for legs in shared])
    texts = [", ".join(map(str, legs)) for legs in shared]
    figure = go.Figure(
        [
            *view.plate(joints[ring(joints)], *view.PLATFORM),
            view.line(view.segments(base, joints), view.segment_colors(LEG_NAMES), 10),
            *view.plate(base[ring(base)], *view.BASE),
            view.labels(labels, texts),
        ]
    )
    points = np.concatenate([labels, joints])
    return figure.update_layout(LAYOUT, **view.VIEW, height=540, scene=view.scene(points, mechanism.up_in_base))


def _planar_view(mechanism: PlanarMechanism) -> go.Figure:
    center, across, spread = planar_home(mechanism)
    joints = 1e3 * joints_about(mechanism, center + spread * across, 0.0)
    base = 1e3 * mechanism.base_joints
    figure = go.Figure()
    for name, points in (("base", base), ("platform", joints)):
        closed = points[[0, 1, 2, 0]]
        figure.add_scatter(x=closed[:, 0], y=closed[:, 1], name=name, mode="lines+markers", line={"width": 5})
    for k in range(PLANAR_LEGS):
        figure.add_scatter(
            x=[base[k, 0], joints[k, 0]], y=[base[k, 1], joints[k, 1]], name=LEG_NAMES[k], mode="lines",
            line={"color": COLORS[LEG_NAMES[k]], "width": 3},
        )  # fmt: skip
    return figure.update_layout(LAYOUT, height=540, xaxis={"title": "x [mm]"}, yaxis={"title": "y [mm]", "scaleanchor": "x"})


def _conditioning(description: Description) -> go.Figure:
    figure = go.Figure()
    for need in description.needs:
        shares = np.linspace(0.0, 100.0, 201)
        figure.add_scatter(
            x=np.percentile(need.conditionings, shares), y=shares, name=need.requirement.method, mode="lines",
            hovertemplate=f"{need.requirement.method}: %{{y:.1f}} % of the poses below %{{x:.2g}}<extra></extra>",
        )  # fmt: skip
    axes = {"xaxis": {"title": "conditioning", "type": "log"}, "yaxis": {"title": "poses below [%]"}}
    return figure.update_layout(LAYOUT, height=380, **axes)
