"""The report of a simulation: one HTML file that opens offline, with summary, time series and the moving mechanism."""

import os
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.io import to_html
from plotly.offline import get_plotlyjs
from plotly.subplots import make_subplots

from controller.cycle import ALL_IMUS
from hil.simulation import SimulationResult
from plant.errors import InputError
from plant.mechanism import LEGS
from plant.pose import Array, rotation_angle

AXIS_NAMES = ("x", "y", "z")
LEG_NAMES = tuple(f"leg {k}" for k in range(LEGS))
COLORS = {
    **dict(zip(AXIS_NAMES, ("#d1495b", "#2a9d5c", "#2f6fb5"), strict=True)),
    **dict(zip(LEG_NAMES, ("#3b6fb6", "#e8871e", "#3a9d6e", "#c8403f", "#8a5fb0", "#3fa7b8"), strict=True)),
}
INK, FAINT = "#26323d", "#9aa5b1"

_POINTS = 3000
_FRAMES = 150
_FRAME_RATE_HZ = 25.0
_SLOWEST_HZ = 15.0
_PATH_POINTS = 600
_TUBE = 0.62
"""The drawn length of a leg's lower part, relative to the least length of the leg."""


class _Panel(NamedTuple):
    """One pair of axes over time: `values` (N, k) of the curves `names`, their plan (N, k), and dashed limits."""

    label: str
    names: Sequence[str]
    values: Array
    planned: Array | None = None
    limits: Sequence[float] = ()


def write_report(result: SimulationResult, path: Path) -> None:
    """Write the report of a simulation as one HTML file, which takes its place only when it is complete.

    Raises:
        InputError: the file cannot be written.
    """
    page = _page(result)
    part = path.parent / f".{path.name}.{os.getpid()}.part"
    try:
        try:
            part.write_text(page, encoding="utf-8")
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot write the report {path}: {error.strerror}; give a file in a folder that is writable"
        ) from None


def _page(result: SimulationResult) -> str:
    summary = result.summary()
    title = f"gough: {escape(result.mechanism.name)} follows {escape(result.target.name)}"
    view, speed = _mechanism_view(result)
    series = "".join(_figure(*figure, "time") for figure in _time_figures(result))
    moving = _figure(
        "mechanism",
        "The mechanism",
        f"True poses, at {speed:.2g} times real speed; in grey the path of the platform's origin. Drag to turn, scroll to zoom.",
        view,
        "view",
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{_STYLE}</style>
<script>{get_plotlyjs()}</script>
</head>
<body>
<header><h1>{title}</h1><p>{_configuration(result, summary)}</p></header>
<section class="overview">
<div>
{_error_table(summary)}
{_facts(summary)}
</div>
{moving}
</section>
{series}
<script>{_SHARED_TIME}</script>
</body>
</html>
"""


def _configuration(result: SimulationResult, summary: dict[str, Any]) -> str:
    config = result.config
    ran = result.times[-1] + 1.0 / config.rate
    parts = [
        f"{config.duration:g} s" + (f", stopped after {ran:.3f} s" if ran < config.duration - 1.5 / config.rate else ""),
        f"{config.rate:g} Hz",
        f"IMU {config.imu}, seed {config.seed}",
        f"{config.fusion} fusion",
        f"gough {summary['version']}",
    ]
    if tuple(config.imus) != ALL_IMUS:
        parts.insert(3, f"only IMUs {', '.join(map(str, config.imus))}")
    if config.plant:
        parts.append(f"plant {config.plant}")
    return " · ".join(map(escape, parts))


def _error_table(summary: dict[str, Any]) -> str:
    lines = (
        ("Estimation", "estimate - truth", summary["estimation"], ""),
        ("Tracking", "truth - planned reference", summary["tracking"], ""),
        ("Against the raw target", "truth - target", summary["target"], ""),
        ("Reference", "planned reference - target", summary["target"], "reference_"),
    )
    rows = "".join(
        f"<tr><th>{name}<small>{meaning}</small></th>"
        + "".join(f"<td>{1e3 * errors[prefix + key]:.3f}</td>" for key in ("position_rms", "position_max"))
        + "".join(f"<td>{np.degrees(errors[prefix + key]):.3f}</td>" for key in ("rotation_rms", "rotation_max"))
        + "</tr>\n"
        for name, meaning, errors, prefix in lines
    )
    return f"""<table>
<thead>
<tr><th rowspan="2"></th><th colspan="2">position [mm]</th><th colspan="2">rotation [deg]</th></tr>
<tr><th>RMS</th><th>max</th><th>RMS</th><th>max</th></tr>
</thead>
<tbody>
{rows}</tbody>
</table>"""


def _facts(summary: dict[str, Any]) -> str:
    cycle = summary["cycle_us"]
    violations = summary["limits"]["violations"]
    facts = (
        ("violations of limits by the reference", f"{violations}", "good" if violations == 0 else "bad"),
        ("real-time factor", f"{summary['real_time_factor']:.1f}", ""),
        ("cycle [µs], p50 / p99 / p99.9", " / ".join(f"{cycle[name]:.1f}" for name in ("p50", "p99", "p999")), ""),
    )
    return (
        "<dl>" + "".join(f'<div><dd class="{kind}">{value}</dd><dt>{name}</dt></div>' for name, value, kind in facts) + "</dl>"
    )


def _figure(name: str, title: str, caption: str, figure: go.Figure, kind: str) -> str:
    plot = to_html(
        figure,
        config={"displaylogo": False, "responsive": True, "doubleClick": "reset"},
        auto_play=False,
        include_plotlyjs=False,
        full_html=False,
        div_id=name,
    )
    return f'<figure class="{kind}"><h2>{title}</h2>\n{plot}\n<figcaption>{caption}</figcaption></figure>\n'


def _time_figures(result: SimulationResult) -> list[tuple[str, str, str, go.Figure]]:
    """Name, title, caption and figure of everything that is drawn over time."""
    records, times = result.records, result.times
    limits, home = result.mechanism.require_limits(), result.mechanism.require_home()
    true_positions, true_rotations = result.true_positions, result.true_rotations
    true_lengths, currents = 1e3 * records["truth"][:, 7:13], records["truth"][:, 13:19]
    lengths, rates, accelerations = np.moveaxis(records["reference"], 2, 0)
    planned_lengths = 1e3 * lengths
    stroke = 1e3 * limits.stroke

    def errors(name: str, positions: Array, rotations: Array, to_positions: Array, to_rotations: Array) -> list[_Panel]:
        return [
            _Panel(f"{name} [mm]", AXIS_NAMES, 1e3 * (positions - to_positions)),
            _Panel(f"{name} [deg]", AXIS_NAMES, _rotation_vectors(rotations, to_rotations)),
        ]

    pose = [
        _Panel(
            "position [mm]",
            AXIS_NAMES,
            1e3 * (true_positions - home.position),
            1e3 * (result.reference_positions - home.position),
        ),
        _Panel(
            "rotation vector [deg]",
            AXIS_NAMES,
            _rotation_vectors(true_rotations, home.rotation),
            _rotation_vectors(result.reference_rotations, home.rotation),
        ),
    ]
    estimation = errors("estimation", records["position"], records["rotation"], true_positions, true_rotations)
    tracking = errors("tracking", true_positions, true_rotations, result.reference_positions, result.reference_rotations)
    legs = [
        _Panel(f"{name} [mm]", (name,), true_lengths[:, k : k + 1], planned_lengths[:, k : k + 1], stroke[k])
        for k, name in enumerate(LEG_NAMES)
    ]
    motion = [
        _Panel("speed [mm/s]", LEG_NAMES, 1e3 * rates, limits=(-1e3 * limits.velocity, 1e3 * limits.velocity)),
        _Panel("acceleration [m/s²]", LEG_NAMES, accelerations, limits=(-limits.acceleration, limits.acceleration)),
    ]
    drives = [
        _Panel("true - planned length [mm]", LEG_NAMES, true_lengths - planned_lengths),
        _Panel("command [mm/s]", LEG_NAMES, 1e3 * records["command"]),
        _Panel("motor current [A]", LEG_NAMES, currents),
    ]
    return [
        (
            "pose",
            "Pose",
            "True pose of the platform and its planned reference, from home; the rotation vector is seen in the base.",
            _plot(times, pose),
        ),
        (
            "errors",
            "Estimation and tracking error",
            "Estimate minus truth, and truth minus planned reference, on the same scales, which are those of the motion: "
            "while the filters settle in the hold (grey) the estimate may be further off.",
            _plot(times, [estimation[0], tracking[0], estimation[1], tracking[1]], columns=2, shared_yaxes=True),
        ),
        (
            "lengths",
            "Leg lengths",
            "True and planned length of each leg between the ends of its stroke.",
            _plot(times, legs, columns=3),
        ),
        ("motion", "Planned motion of the legs", "The reference against the limits of the actuators.", _plot(times, motion)),
        ("drives", "Drives", "What is left to control, what the drives are told, and what that takes.", _plot(times, drives)),
    ]


def _plot(times: Array, panels: Sequence[_Panel], columns: int = 1, shared_yaxes: bool = False) -> go.Figure:
    """A figure of panels over one time axis, filled row by row; each name is once in the legend."""
    rows = len(panels) // columns
    figure = make_subplots(
        rows,
        columns,
        shared_xaxes="all",
        shared_yaxes="rows" if shared_yaxes else False,
        horizontal_spacing=0.07 if columns > 1 else 0.0,
        vertical_spacing=0.05,
    )
    known: set[str] = set()

    def legend(name: str) -> dict[str, Any]:
        first = name not in known
        known.add(name)
        return {"name": name, "legendgroup": name, "showlegend": first, "legendrank": 1 if name in COLORS else 2}

    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        place: dict[str, Any] = {"row": row + 1, "col": column + 1}
        peers = panels[row * columns : (row + 1) * columns] if shared_yaxes else [panel]
        unit = panel.label.partition("[")[2].rstrip("]")
        for name, values in zip(panel.names, panel.values.T, strict=True):
            line = {"color": COLORS[name], "width": 1.5}
            figure.add_scatter(**_curve(times, values, name, unit), line=line, **legend(name), **place)
        for name, values in zip(panel.names, panel.planned.T if panel.planned is not None else (), strict=False):
            line = {"color": INK, "width": 1, "dash": "dot"}
            figure.add_scatter(**_curve(times, values, f"{name} planned", unit), line=line, **legend("planned"), **place)
        for limit in panel.limits:
            figure.add_hline(limit, line={"color": INK, "width": 1, "dash": "dash"}, **legend("limit"), **place)
        figure.update_yaxes(title_text=panel.label, range=_span(peers, times >= 0.0), **place)
    if times[0] < 0.0:
        figure.add_vrect(times[0], min(0.0, times[-1]), fillcolor=FAINT, opacity=0.2, line_width=0, layer="below")
    figure.update_xaxes(range=[times[0], times[-1]])
    figure.update_xaxes(title_text="time [s]", row=rows)
    figure.update_layout(
        _LAYOUT,
        height=60 + 210 * rows,
        legend={"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"},
    )
    return figure


def _span(panels: Sequence[_Panel], moving: NDArray[np.bool_]) -> tuple[float, float]:
    """What an axis for all of `panels` shows: the motion and the limits, but not how the filters settle before it."""
    drawn = [curves[moving].ravel() for panel in panels for curves in (panel.values, panel.planned) if curves is not None]
    values = np.concatenate([*drawn, *(panel.limits for panel in panels)])
    least, greatest = np.nanmin(values), np.nanmax(values)
    margin = 0.06 * (greatest - least) or 1.0
    return float(least - margin), float(greatest + margin)


def _curve(times: Array, values: Array, name: str, unit: str) -> dict[str, Any]:
    kept = _extremes(values)
    return {
        "x": times[kept].astype(np.float32),
        "y": values[kept].astype(np.float32),
        "mode": "lines",
        "hovertemplate": f"{name}: %{{y:.4~g}} {unit} at %{{x:.3f}} s<extra></extra>",
    }


def _extremes(values: Array, points: int = _POINTS) -> NDArray[np.intp]:
    """Indices of about `points` samples of `values` (N,), among them the least and the greatest of each bucket."""
    if len(values) <= points:
        return np.arange(len(values))
    size = 2 * len(values) // points
    buckets = values[: len(values) // size * size].reshape(-1, size)
    starts = np.arange(0, buckets.size, size)
    rest = np.arange(buckets.size, len(values))
    return np.unique(np.concatenate([starts + buckets.argmin(axis=1), starts + buckets.argmax(axis=1), rest]))


def _rotation_vectors(rotations: Array, references: Array) -> Array:
    """The rotation vectors (N, 3) [deg], seen in {1}, from `references` to `rotations` (N, 3, 3)."""
    relative = rotations @ np.swapaxes(references, -1, -2)
    skewed = relative - np.swapaxes(relative, 1, 2)
    sines = 0.5 * np.stack([skewed[:, 2, 1], skewed[:, 0, 2], skewed[:, 1, 0]], axis=1)
    angles = rotation_angle(rotations, references)
    vectors: Array = np.degrees(sines / np.sinc(angles / np.pi)[:, None])
    return vectors


def _mechanism_view(result: SimulationResult) -> tuple[go.Figure, float]:
    """The moving mechanism, and how many times faster than real it plays."""
    mechanism = result.mechanism
    moving = np.flatnonzero(result.times >= 0.0)
    span = float(result.times[moving[-1]] - result.times[moving[0]])
    shown = moving[np.linspace(0, len(moving) - 1, int(np.clip(span * _FRAME_RATE_HZ, 2, _FRAMES))).astype(int)]
    frame_ms = min(1e3 * span / len(shown), 1e3 / _SLOWEST_HZ)
    positions, rotations = 1e3 * result.true_positions[shown], result.true_rotations[shown]
    base = 1e3 * mechanism.base_joints
    joints = positions[:, None] + 1e3 * mechanism.platform_joints @ np.swapaxes(rotations, 1, 2)
    path = 1e3 * result.true_positions[moving[:: -(-len(moving) // _PATH_POINTS)]]
    tube = _TUBE * 1e3 * mechanism.require_limits().stroke[:, :1]
    ring, platform_ring = _ring(mechanism.base_joints), _ring(mechanism.platform_joints)
    triad = 0.4 * np.linalg.norm(1e3 * mechanism.platform_joints, axis=1).max()

    def moving_parts(k: int) -> list[dict[str, Any]]:
        legs = joints[k] - base
        ends = base + tube * legs / np.linalg.norm(legs, axis=1, keepdims=True)
        axes = positions[k] + triad * rotations[k].T
        return [
            _xyz(joints[k][platform_ring[:-1]]),
            _xyz(joints[k][platform_ring]),
            _xyz(_strokes(base, ends)),
            _xyz(_strokes(ends, joints[k])),
            _xyz(_strokes(np.broadcast_to(positions[k], (3, 3)), axes)),
        ]

    colors = [[color for name in names for color in 3 * [COLORS[name]]] for names in (LEG_NAMES, AXIS_NAMES)]
    plate, outline, tubes, rods, axes = moving_parts(0)
    figure = go.Figure(
        [
            _plate(plate, "#6d87a3", 0.55),
            _line(outline, "#3d5670", 6),
            _line(tubes, colors[0], 14),
            _line(rods, "#6b7683", 6),
            _line(axes, colors[1], 5),
            _plate(_xyz(base[ring[:-1]]), FAINT, 0.35),
            _line(_xyz(base[ring]), "#5c6873", 6),
            _line(_xyz(path), FAINT, 2),
        ],
        frames=[
            go.Frame(name=str(k), traces=[0, 1, 2, 3, 4], data=[
                {"type": "scatter3d" if part else "mesh3d", **xyz} for part, xyz in enumerate(moving_parts(k))
            ])
            for k in range(len(shown))
        ],
    )  # fmt: skip
    corners = np.concatenate([base, joints.reshape(-1, 3), path])
    least, greatest = corners.min(axis=0), corners.max(axis=0)
    margin = 0.05 * (greatest - least).max()
    up = dict(zip(AXIS_NAMES, mechanism.up_in_base.tolist(), strict=True))
    play = {"frame": {"duration": frame_ms, "redraw": True}, "transition": {"duration": 0}, "fromcurrent": True}
    still = {"frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}, "mode": "immediate"}
    figure.update_layout(
        _LAYOUT,
        height=540,
        margin={"l": 0, "r": 0, "t": 0, "b": 10},
        showlegend=False,
        uirevision="kept",
        scene={
            **{
                f"{name}axis": {
                    "range": [least[i] - margin, greatest[i] + margin],
                    "title": {"text": f"{name} [mm]"},
                    "showbackground": False,
                    "gridcolor": "#e3e7eb",
                    "color": FAINT,
                    "nticks": 5,
                    "showspikes": False,
                }
                for i, name in enumerate(AXIS_NAMES)
            },
            "aspectmode": "data",
            "camera": {"up": up, "eye": {"x": 1.05, "y": -1.2, "z": 0.55}, "projection": {"type": "perspective"}},
        },
        updatemenus=[
            {
                "type": "buttons",
                "direction": "left",
                "x": 0.0,
                "xanchor": "left",
                "y": 0.0,
                "yanchor": "top",
                "pad": {"t": 22, "l": 10},
                "showactive": False,
                "buttons": [
                    {"label": "▶", "method": "animate", "args": [None, play]},
                    {"label": "❚❚", "method": "animate", "args": [[None], still]},
                ],
            }
        ],
        sliders=[
            {
                "x": 0.16,
                "len": 0.8,
                "y": 0.0,
                "pad": {"t": 10},
                "ticklen": 0,
                "minorticklen": 0,
                "font": {"color": "rgba(0,0,0,0)", "size": 1},
                "currentvalue": {"prefix": "time ", "suffix": " s", "xanchor": "right", "font": {"color": INK, "size": 13}},
                "steps": [
                    {"label": f"{time:.2f}", "method": "animate", "args": [[str(k)], still]}
                    for k, time in enumerate(result.times[shown])
                ],
            }
        ],
    )
    return figure, 1e3 * span / len(shown) / frame_ms


def _ring(joints: Array) -> NDArray[np.intp]:
    """The indices that go round `joints` (6, 3) once, back to the first."""
    center = joints - joints.mean(axis=0)
    plane = np.linalg.svd(center)[2][:2]
    x, y = plane @ center.T
    order = np.argsort(np.arctan2(y, x))
    return np.append(order, order[0])


def _strokes(starts: Array, ends: Array) -> Array:
    """Points (3 n, 3) of n separate lines: start, end, gap."""
    return np.stack([starts, ends, np.full_like(ends, np.nan)], axis=1).reshape(-1, 3)


def _xyz(points: Array) -> dict[str, Array]:
    return dict(zip(AXIS_NAMES, points.T.astype(np.float32), strict=True))


def _line(xyz: dict[str, Array], color: str | list[str], width: float) -> go.Scatter3d:
    return go.Scatter3d(xyz, mode="lines", line={"color": color, "width": width}, hoverinfo="skip")


def _plate(xyz: dict[str, Array], color: str, opacity: float) -> go.Mesh3d:
    fan = np.arange(1, len(xyz["x"]) - 1)
    return go.Mesh3d(xyz, i=0 * fan, j=fan, k=fan + 1, color=color, opacity=opacity, flatshading=True, hoverinfo="skip")


_LAYOUT = {
    "template": "plotly_white",
    "font": {"family": "system-ui, -apple-system, 'Segoe UI', 'Liberation Sans', sans-serif", "size": 12, "color": INK},
    "margin": {"l": 70, "r": 15, "t": 30, "b": 45},
}

_STYLE = """
:root { --ink: #26323d; --faint: #66727e; --line: #dfe4e9; --accent: #2f6fb5; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 28px 24px 48px; max-width: 1240px; color: var(--ink); background: #fff;
  font: 15px/1.45 system-ui, -apple-system, "Segoe UI", "Liberation Sans", sans-serif; }
header { border-bottom: 2px solid var(--accent); padding-bottom: 12px; margin-bottom: 20px; }
h1 { font-size: 26px; font-weight: 600; margin: 0; overflow-wrap: anywhere; }
header p { margin: 4px 0 0; color: var(--faint); overflow-wrap: anywhere; }
h2 { font-size: 18px; font-weight: 600; margin: 0 0 4px; }
.overview { display: grid; grid-template-columns: minmax(380px, 5fr) minmax(480px, 7fr); gap: 28px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th { font-weight: 500; text-align: right; padding: 3px 0 3px 10px; }
thead th { color: var(--faint); font-size: 13px; }
tbody th { text-align: left; padding-left: 0; }
tbody tr { border-top: 1px solid var(--line); }
th small { display: block; color: var(--faint); font-weight: 400; }
td { text-align: right; padding: 8px 0 8px 10px; }
dl { display: grid; gap: 10px; margin: 22px 0 0; }
dl div { border-left: 3px solid var(--line); padding-left: 12px; }
dd { margin: 0; font-size: 22px; font-variant-numeric: tabular-nums; }
dd.good { color: #23864c; }
dd.bad { color: #c02f3f; }
dt { color: var(--faint); font-size: 13px; }
figure { margin: 0; min-width: 0; }
figure.time { margin-top: 32px; border-top: 1px solid var(--line); padding-top: 18px; }
figcaption { color: var(--faint); font-size: 13px; }
@media (max-width: 960px) { .overview { grid-template-columns: 1fr; } }
"""

_SHARED_TIME = """
const plots = document.querySelectorAll(".time .plotly-graph-div");
plots.forEach(plot => plot.on("plotly_relayout", () => {
  const range = plot.layout.xaxis.range;
  plots.forEach(other => {
    if (String(other.layout.xaxis.range) !== String(range)) Plotly.relayout(other, {"xaxis.range": [...range]});
  });
}));
"""
