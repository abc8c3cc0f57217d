"""What a mechanism is and what it needs: its class, the sensors of each method, conditioning, and a report with drawings."""

from dataclasses import asdict, dataclass
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go

from controller.direct_kinematics import Requirement, required_measurements, solve_batch, solve_planar
from controller.direct_kinematics.spatial import NEEDS
from controller.inverse_kinematics import sample_workspace
from hil.reports.page import (
    COLORS,
    FAINT,
    INK,
    LAYOUT,
    LEG_NAMES,
    coordinates,
    figure_html,
    line_trace,
    page,
    plate_trace,
    ring,
    scene,
    segment_colors,
    segments,
)  # fmt: skip
from hil.studies.accuracy import draw_measurements, draw_poses
from plant.errors import SingularConfigurationError
from plant.files import write_whole
from plant.mechanism import Mechanism
from plant.mechanism.classification import MechanismClass, canonical_legs, classify, joint_numbers, layout
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array

_POSES = 1000
_PLANAR_REACH, _PLANAR_TILT = 0.15, np.radians(15.0)

PAPER = {"section-3.1.1": "3.1.1", "section-4": "4", "section-5": "5", "planar, roll": "6"}
"""The sections of the paper whose algorithms the methods are."""


@dataclass(frozen=True, eq=False)
class Need:
    """What a method needs on a mechanism and how well it is conditioned with all legs: at home, and at the worst of many
    poses. The pose is unique, but for `modes` of them.
    """

    requirement: Requirement
    modes: int
    home: float
    worst: float
    conditionings: Array


@dataclass(frozen=True, eq=False)
class Description:
    """A mechanism, its class, and the needs of each method; `where` says over which poses conditioning is the worst."""

    mechanism: Mechanism | PlanarMechanism
    mechanism_class: MechanismClass
    needs: tuple[Need, ...]
    where: str

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON."""
        mechanism = self.mechanism
        return {
            "mechanism": mechanism.name,
            "class": self.mechanism_class.label,
            "name": self.mechanism_class.name,
            "drawing": self.mechanism_class.drawing,
            "base_joints": joint_numbers(mechanism.base_joints).tolist(),
            "platform_joints": joint_numbers(mechanism.platform_joints).tolist(),
            "poses": self.where,
            "methods": [
                {
                    **asdict(need.requirement),
                    "section": PAPER.get(need.requirement.method),
                    "modes": need.modes,
                    "conditioning_home": need.home,
                    "conditioning_worst": need.worst,
                }
                for need in self.needs
            ],
            "version": version("gough"),
        }


def describe(mechanism: Mechanism | PlanarMechanism) -> Description:
    """The class of a mechanism and what each method needs on it.

    Raises:
        InputError: the mechanism is in no class.
    """
    if isinstance(mechanism, PlanarMechanism):
        return _describe_planar(mechanism)
    mechanism_class = classify(mechanism)
    random = np.random.default_rng(0)
    if mechanism.limits is not None and mechanism.home is not None:
        where = "the workspace"
        poses = sample_workspace(mechanism, _POSES, seed=0)
    else:
        where = "poses within a sixth of the base's radius and 15 deg about home"
        poses = draw_poses(mechanism, _POSES, random)
    home = mechanism.nominal_home
    positions = np.concatenate([home.position[None], poses[0]])
    rotations = np.concatenate([home.rotation[None], poses[1]])
    exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
    needs = []
    for requirement in required_measurements(mechanism):
        given: dict[str, Any] = {name: exact[name] for method, name in NEEDS.items() if method == requirement.method}
        found = solve_batch(mechanism, exact["leg_directions"], method=requirement.method, refine=False, **given)
        conditionings = np.where(found.solved, found.conditionings, 0.0)
        needs.append(Need(requirement, 1, float(conditionings[0]), float(conditionings[1:].min()), conditionings[1:]))
    return Description(mechanism, mechanism_class, tuple(needs), where)


def _describe_planar(mechanism: PlanarMechanism) -> Description:
    random = np.random.default_rng(0)
    center, across, spread = _planar_home(mechanism)
    values: dict[str, list[float]] = {"planar, legs": [], "planar, roll": []}
    for number in range(_POSES + 1):
        reach = 0.0 if number == 0 else 1.0
        angle = reach * random.uniform(-_PLANAR_TILT, _PLANAR_TILT)
        middle = center + spread * (across + reach * random.uniform(-_PLANAR_REACH, _PLANAR_REACH, 2))
        x, y = (_joints_about(mechanism, middle, angle) - mechanism.base_joints).T
        for method, roll in (("planar, legs", None), ("planar, roll", angle)):
            try:
                values[method].append(solve_planar(mechanism, np.arctan2(y, x), roll=roll)[0].conditioning)
            except SingularConfigurationError:
                values[method].append(0.0)
    every = tuple(range(PLANAR_LEGS))
    pairs = tuple((i, j) for i in every for j in every[i + 1 :])
    requirements = {
        "planar, legs": Requirement("planar, legs", "nothing", PLANAR_LEGS, (every,), PLANAR_LEGS),
        "planar, roll": Requirement("planar, roll", "roll", 2, pairs, 2),
    }
    needs = tuple(
        Need(requirements[method], 2 if method == "planar, legs" else 1, found[0], min(found[1:]), np.array(found[1:]))
        for method, found in values.items()
    )
    where = "poses within 15 % of the base's spread and 15 deg about a platform that stands off the base by its spread"
    return Description(mechanism, classify(mechanism), needs, where)


def _planar_home(mechanism: PlanarMechanism) -> tuple[Array, Array, float]:
    """Centre of the base joints (2,) [m], the unit vector (2,) across them, and their spread [m]."""
    center = mechanism.base_joints.mean(axis=0)
    _, spread, axes = np.linalg.svd(mechanism.base_joints - center)
    across = axes[1] * np.sign(axes[1, 1] or 1.0)
    return center, across, float(np.linalg.norm(spread))


def _joints_about(mechanism: PlanarMechanism, middle: Array, angle: float) -> Array:
    """The platform joints (3, 2) [m] with their centre at `middle` (2,) [m]."""
    joints = mechanism.joints_at(np.zeros(2), angle)
    moved: Array = joints - joints.mean(axis=0) + middle
    return moved


def write_report(description: Description, path: Path) -> None:
    """Write the description as one HTML file that opens offline.

    Raises:
        InputError: the file cannot be written.
    """
    mechanism, mechanism_class = description.mechanism, description.mechanism_class
    title = f"gough: {escape(mechanism.name)} is of class {escape(mechanism_class.label)}"
    subtitle = (
        f"{escape(mechanism_class.name)} · {mechanism_class.base_count} base and {mechanism_class.platform_count} platform "
        f"joints · graph {escape(mechanism_class.drawing)} · gough {version('gough')}"
    )
    view = _planar_view(mechanism) if isinstance(mechanism, PlanarMechanism) else _spatial_view(mechanism)
    graph = figure_html(
        "graph",
        "Graph of the legs",
        "Platform joints above, base joints below; legs in the colours of the mechanism.",
        _graph(description),
        "view",
    )
    drawn = figure_html("mechanism", "The mechanism", "At home, in mm.", view, "view")
    spread = figure_html(
        "conditioning",
        "Conditioning",
        f"Of each method with all legs, over {escape(description.where)}: which share of the poses lies below. 1 is best; the "
        "noise of the sensors is amplified by about its reciprocal.",
        _conditioning(description),
        "time",
    )
    body = f'<section class="overview"><div>\n{_table(description)}\n{graph}</div>\n{drawn}\n</section>\n{spread}'
    write_whole(path, page(title, subtitle, body).encode())


def _table(description: Description) -> str:
    rows = "".join(
        f"<tr><th>{escape(need.requirement.method)}<small>{_claim(need)}</small></th>"
        f"<td>{escape(need.requirement.text)}<small>{need.requirement.choice_text}</small></td><td>{need.home:.2g}</td><td>{need.worst:.2g}</td></tr>\n"
        for need in description.needs
    )
    return f"""<table>
<thead><tr><th rowspan="2"></th><th rowspan="2">needs</th><th colspan="2">conditioning</th></tr>
<tr><th>home</th><th>worst</th></tr></thead>
<tbody>
{rows}</tbody>
</table>"""


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
            x=x, y=np.full(len(x), y), mode="markers", showlegend=False, marker={"size": 15, "color": INK},
            hovertemplate=f"{name} %{{pointNumber}}<extra></extra>",
        )  # fmt: skip
    hidden = {"visible": False, "fixedrange": True}
    figure.update_layout(LAYOUT, height=220, xaxis=hidden, yaxis={**hidden, "range": [-0.3, 1.3]})
    return figure


def _spatial_view(mechanism: Mechanism) -> go.Figure:
    base = 1e3 * mechanism.base_joints
    home = mechanism.nominal_home
    joints = 1e3 * (home.position + mechanism.platform_joints @ home.rotation.T)
    base_ring, platform_ring = ring(base), ring(joints)
    numbers = joint_numbers(mechanism.base_joints)
    shared = [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]
    labels = np.array([base[legs[0]] + 0.12 * (base[legs[0]] - base.mean(axis=0)) for legs in shared])
    texts = [", ".join(str(leg) for leg in legs) for legs in shared]
    figure = go.Figure(
        [
            plate_trace(coordinates(joints[platform_ring[:-1]]), "#6d87a3", 0.55),
            line_trace(coordinates(joints[platform_ring]), "#3d5670", 6),
            line_trace(coordinates(segments(base, joints)), segment_colors(LEG_NAMES), 10),
            plate_trace(coordinates(base[base_ring[:-1]]), FAINT, 0.35),
            line_trace(coordinates(base[base_ring]), "#5c6873", 6),
            go.Scatter3d(coordinates(labels), mode="text", text=texts, hoverinfo="skip"),
        ]
    )
    margin = {"l": 0, "r": 0, "t": 0, "b": 10}
    points = np.concatenate([labels, joints])
    figure.update_layout(LAYOUT, height=540, margin=margin, showlegend=False, scene=scene(points, mechanism.up_in_base))
    return figure


def _planar_view(mechanism: PlanarMechanism) -> go.Figure:
    center, across, spread = _planar_home(mechanism)
    joints = 1e3 * _joints_about(mechanism, center + spread * across, 0.0)
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
    figure.update_layout(LAYOUT, height=540, xaxis={"title": "x [mm]"}, yaxis={"title": "y [mm]", "scaleanchor": "x"})
    return figure


def _conditioning(description: Description) -> go.Figure:
    figure = go.Figure()
    for need in description.needs:
        shares = np.linspace(0.0, 100.0, 201)
        figure.add_scatter(
            x=np.percentile(need.conditionings, shares), y=shares, name=need.requirement.method, mode="lines",
            hovertemplate=f"{need.requirement.method}: %{{y:.1f}} % of the poses below %{{x:.2g}}<extra></extra>",
        )  # fmt: skip
    figure.update_layout(
        LAYOUT, height=380, xaxis={"title": "conditioning", "type": "log"}, yaxis={"title": "poses below [%]"}
    )  # fmt: skip
    return figure
