"""The report of a simulation: summary, the moving mechanism and time series."""

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from controller.frames import BASE, Frames, compose
from hil.look import (
    AXIS_NAMES,
    BAND,
    COLORINGS,
    COLORS,
    FAINT,
    GRID,
    LEG_NAMES,
    NEUTRAL,
    REFERENCE,
    REFERENCE_COLOR,
    TRUTH,
    TRUTH_COLOR,
    TUBE_SHARE,
    imu_shares,
    ring,
    speed_shares,
    stroke_shares,
)  # fmt: skip
from hil.reports import view
from hil.reports.curves import curve
from hil.reports.page import LAYOUT, LEGEND, figure_html, overview, place, write_page
from hil.runs.simulation import SimulationResult
from hil.table import Cell, Table
from plant.imu_wiring import ALL_IMUS
from plant.pose import Array, Pose, pose_errors, vector_from_rotation
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS

_QUANTITIES = (("position", "mm", 1e3), ("rotation", "deg", np.degrees(1.0)))
_PATH_POINTS = 600
_FRAMES, _FRAME_RATE_HZ, _SLOWEST_HZ = 150, 25.0, 15.0


class _Panel(NamedTuple):
    """Axes over time."""

    label: str
    names: Sequence[str]  # of its k curves
    values: Array  # (N, k)
    planned: Array | None = None  # (N, k), drawn behind
    limits: Sequence[float] = ()  # dashed


def write_report(result: SimulationResult, path: Path) -> None:
    """Write the report of a simulation as one HTML file.

    Raises:
        InputError: the file cannot be written.
    """
    summary = result.summary()
    mechanism = figure_html("mechanism", "The mechanism", *_mechanism_view(result), "view")
    remarks = "".join(f"<p>{escape(remark[0].upper() + remark[1:])}.</p>" for remark in result.remarks)
    errors = _error_table(summary.get("frames", summary), _seen(result), result.truth_known)
    body = overview(f"{errors.html()}\n{_facts(summary)}{remarks}", mechanism)
    body += "".join(figure_html(*figure) for figure in _time_figures(result))
    if result.frames is not None:
        body += _frames_section(result.frames.frames)
    title = f"gough: {result.mechanism.name} follows {result.target.name}"
    write_page(path, title, _configuration(result, summary), body, _SHARED_TIME)


def figures(result: SimulationResult) -> dict[str, go.Figure]:
    """The report's figures, for a notebook: `mechanism`, which moves, `pose`, `errors`, `lengths`, `motion`, `drives`, and
    `protection` where there is a protection level.
    """
    return {"mechanism": _mechanism_view(result)[1]} | {name: figure for name, _, _, figure in _time_figures(result)}


def _configuration(result: SimulationResult, summary: dict[str, Any]) -> str:
    config = result.config
    ran = result.times[-1] + 1.0 / config.rate
    parts = [
        f"{config.duration:g} s" + (f", stopped after {ran:.3f} s" if ran < config.duration - 1.5 / config.rate else ""),
        f"{config.rate:g} Hz",
        f"IMU {config.imu}, seed {config.seed}",
        f"{config.fusion} fusion" + (", magnetometer" if config.magnetometer else ""),
        f"gough {summary['version']}",
    ]
    if tuple(config.imus) != ALL_IMUS:
        parts.insert(3, f"only IMUs {', '.join(map(str, config.imus))}")
    if result.frames is not None:
        parts.append(result.frames.text)
    if config.plant:
        parts.append(f"plant {config.plant}" + (f" with {config.binding}" if config.binding else ""))
    parts += [each.text for each in config.settings]
    return " · ".join(parts)


def _seen(result: SimulationResult) -> str:
    """Whose pose is compared in which frame, in words; "" for that of {2} in {1}."""
    return "" if result.frames is None else result.frames.text


def _frames_section(frames: Frames) -> str:
    """The frames as they were in the run."""
    table = Table("", "stands on", "position [mm]", "rotation vector [deg]", "note")
    for name, frame in frames.frames.items():
        position, vector = 1e3 * frame.position, np.degrees(vector_from_rotation(frame.rotation))
        numbers = (", ".join(f"{value:.3f}" for value in values) for values in (position, vector))
        enabled = "enabled" if name in (frames.work, frames.tool) else ""
        table.add(Cell(name, enabled), frame.parent, *numbers, frame.note)
    pivot = ""
    if frames.pivot is not None:
        place = ", ".join(f"{1e3 * value:.3f}" for value in frames.pivot.position)
        pivot = f"<p>The pivot is at {place} mm in {escape(frames.pivot.parent)}.</p>"
    return f"<section><h2>Frames</h2>{table.html()}{pivot}</section>"


def _error_table(figures: dict[str, Any], seen: str, truth_known: bool) -> Table:
    """The errors of the groups in `figures`."""
    table = Table(seen, *((f"{name} [{unit}]", kind) for name, unit, _ in _QUANTITIES for kind in ("RMS", "max")))

    rows = [("Tracking", "estimate - planned reference; the truth is not known", figures["estimated_tracking"], "")]
    if truth_known:
        rows = [
            ("Estimation", "estimate - truth", figures["estimation"], ""),
            ("Tracking", "truth - planned reference", figures["tracking"], ""),
            ("Against the raw target", "truth - target", figures["target"], ""),
        ]
    rows.append(("Reference", "planned reference - target", figures["target"], "reference_"))
    for name, meaning, errors, prefix in rows:
        keys = ((f"{prefix}{quantity}_{kind}", scale) for quantity, _, scale in _QUANTITIES for kind in ("rms", "max"))
        table.add(Cell(name, meaning), *(f"{scale * errors[key]:.3f}" for key, scale in keys))
    return table


def _facts(summary: dict[str, Any]) -> str:
    cycle = summary["cycle_us"]
    violations = summary["limits"]["violations"]
    facts = (
        ("violations of limits by the reference", f"{violations}", "good" if violations == 0 else "bad"),
        ("real-time factor", f"{summary['real_time_factor']:.1f}", ""),
        ("cycle [us], p50 / p99 / p99.9", " / ".join(f"{cycle[name]:.1f}" for name in ("p50", "p99", "p999")), ""),
    )
    items = "".join(f'<div><dd class="{kind}">{value}</dd><dt>{name}</dt></div>' for name, value, kind in facts)
    return f"<dl>{items}</dl>"


def _time_figures(result: SimulationResult) -> list[tuple[str, str, str, go.Figure]]:
    """Name, title, caption and figure of each plot over time."""
    records, times = result.records, result.times
    limits, home_pose = result.mechanism.require_limits(), result.mechanism.require_home()
    there = slice(result.mechanism.legs)
    names = LEG_NAMES[there]
    of_platform = (records["position"], records["rotation"])
    real, *drawn_poses = _drawn_poses(result)
    estimate, actual = result.read(*of_platform), result.read(*drawn_poses)
    planned = result.read(result.reference_positions, result.reference_rotations)
    lengths, currents = (records["truth"][:, part][:, there] for part in (TRUTH_LENGTHS, TRUTH_CURRENTS))
    real_length = "True"
    if not np.isfinite(lengths[:1]).all():
        lengths, real_length = records["lengths"][:, there], "Estimated"
    lengths = 1e3 * lengths
    planned_lengths, rates, accelerations = np.moveaxis(records["reference"][:, there] * [1e3, 1e3, 1.0], 2, 0)

    origin, of = (home_pose.position, home_pose.rotation), ""
    where = "the platform and its planned reference, from home; the rotation vector is in the base's axes"
    if result.frames is not None:
        origin, of = (np.zeros(3), result.frames.read(home_pose).rotation), f", of {_seen(result)}"
        where = f"{_seen(result)} and its planned reference; the rotation is from that at home"
    drawn, plan = _differences(actual, origin), _differences(planned, origin)
    pose = [
        _Panel(label, AXIS_NAMES, drawn[:, part], plan[:, part])
        for label, part in (("position [mm]", slice(3)), ("rotation vector [deg]", slice(3, 6)))
    ]
    differences = [("tracking", _differences(actual, planned))]
    if result.truth_known:
        differences.insert(0, ("estimation", _differences(estimate, actual)))
    errors = [
        _Panel(f"{name} [{unit}]", AXIS_NAMES, error[:, part])
        for unit, part in (("mm", slice(3)), ("deg", slice(3, 6)))
        for name, error in differences
    ]
    legs = [
        _Panel(f"{name} [mm]", (name,), lengths[:, [k]], planned_lengths[:, [k]], 1e3 * limits.stroke[k])
        for k, name in enumerate(names)
    ]
    motion = [
        _Panel("speed [mm/s]", names, rates, limits=(-1e3 * limits.velocity, 1e3 * limits.velocity)),
        _Panel("acceleration [m/s²]", names, accelerations, limits=(-limits.acceleration, limits.acceleration)),
    ]
    drives = [
        _Panel("length error [mm]", names, lengths - planned_lengths),
        _Panel("command [mm/s]", names, 1e3 * records["command"][:, there]),
    ]
    if np.isfinite(currents[:1]).all():
        drives.append(_Panel("motor current [A]", names, currents))
    level = 1e3 * records["protection"][:, :1].astype(float), np.degrees(records["protection"][:, 1:].astype(float))
    sizes: list[Array] = []
    if result.truth_known:
        off = _differences(of_platform, drawn_poses)
        sizes = [np.linalg.norm(off[:, part], axis=1, keepdims=True) for part in (slice(3), slice(3, 6))]
    protection = [
        _Panel(f"{name} [{unit}]", ("level", "error")[: 1 + len(sizes) // 2], np.hstack([level[k], *sizes[k : k + 1]]))
        for k, (name, unit) in enumerate((("position", "mm"), ("rotation", "deg")))
    ]
    figures = [
        (
            "pose",
            "Pose",
            f"{real} pose of {where}.",
            _plot(times, pose),
        ),
        (
            "errors",
            "Estimation and tracking error" if result.truth_known else "Tracking error",
            ("Estimate minus truth, and truth" if result.truth_known else "The truth is not known: estimate")
            + f" minus planned reference{of}. The scales fit the motion: during the hold (grey), while the filters settle, the "
            "estimate may be further off.",
            _plot(times, errors, columns=len(differences), shared_yaxes=True),
        ),
        (
            "lengths",
            "Leg lengths",
            f"{real_length} and planned length of each leg, with the ends of its stroke.",
            _plot(times, legs, columns=3),
        ),
        ("motion", "Planned motion of the legs", "The reference, with the limits of the actuators.", _plot(times, motion)),
        (
            "drives",
            "Drives",
            f"{real_length} minus planned length of each leg, the speed commanded to its drive, and its motor's current, if "
            "the plant has it.",
            _plot(times, drives),
        ),
    ]
    if np.isfinite(level[0]).any():
        caption = "How far the estimate may be off, whatever single fault the readings cannot show"
        caption += ", and how far it is" if result.truth_known else ""
        caption += "." if result.frames is None else ": the platform, in the base's frame."
        figures.append(("protection", "Protection level", caption, _plot(times, protection, columns=2)))
    return figures


def _drawn_poses(result: SimulationResult) -> tuple[str, Array, Array]:
    """The true poses, or the estimated ones where the truth is not known, after the word for them."""
    if result.truth_known:
        return "True", result.true_positions, result.true_rotations
    return "Estimated", result.records["position"], result.records["rotation"]


def _plot(times: Array, panels: Sequence[_Panel], columns: int = 1, shared_yaxes: bool = False) -> go.Figure:
    """A figure of panels over one time axis, filled row by row; the legend has each name once."""
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
        at: dict[str, Any] = place(number, columns)
        first = number - number % columns
        peers = panels[first : first + columns] if shared_yaxes else [panel]
        unit = panel.label.partition("[")[2].rstrip("]")
        for name, values in zip(panel.names, panel.planned.T if panel.planned is not None else (), strict=False):
            line = {"color": BAND, "width": 5}
            figure.add_scatter(**curve(times, values, f"{name} planned", unit), line=line, **legend("planned"), **at)
        for name, values in zip(panel.names, panel.values.T, strict=True):
            line = {"color": COLORS[name], "width": 1.5}
            figure.add_scatter(**curve(times, values, name, unit), line=line, **legend(name), **at)
        for limit in panel.limits:
            figure.add_hline(limit, line={"color": NEUTRAL, "width": 1, "dash": "dash"}, **legend("limit"), **at)
        figure.update_yaxes(title_text=panel.label, range=_span(peers, times >= 0.0), **at)
    if times[0] < 0.0:
        figure.add_vrect(times[0], min(0.0, times[-1]), fillcolor=FAINT, opacity=0.2, line_width=0, layer="below")
    figure.update_xaxes(range=[times[0], times[-1]])
    figure.update_xaxes(title_text="time [s]", row=rows)
    return figure.update_layout(LAYOUT, height=60 + 210 * rows, legend=LEGEND)


def _span(panels: Sequence[_Panel], moving: NDArray[np.bool_]) -> tuple[float, float]:
    """The range of an axis for all `panels`: the motion and the limits, not the filters' settling before."""
    curves = [curve for panel in panels for curve in (panel.values, panel.planned) if curve is not None]
    limits = (panel.limits for panel in panels)
    values = np.concatenate([*(curve[moving].ravel() for curve in curves), *limits])
    finite = values[np.isfinite(values)]
    least, greatest = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    margin = 0.06 * (greatest - least) or 1.0
    return float(least - margin), float(greatest + margin)


def _differences(poses: Sequence[Array], origins: Sequence[Array]) -> Array:
    """Translations [mm] and rotation vectors [deg] (N, 6) from the poses `origins` to `poses`, in {1}."""
    errors: Array = pose_errors(*poses, *origins) * np.repeat([1e3, np.degrees(1.0)], 3)
    return errors


def _mechanism_view(result: SimulationResult) -> tuple[str, go.Figure]:
    """The caption and the figure of the moving mechanism."""
    mechanism, records = result.mechanism, result.records
    moving = np.flatnonzero(result.times >= 0.0)
    span = len(moving) / result.config.rate
    count = int(np.clip(span * _FRAME_RATE_HZ, 1, _FRAMES))
    frame_s = min(span / count, 1.0 / _SLOWEST_HZ)
    shown = moving[np.linspace(0, len(moving) - 1, count).astype(int)]
    tool = Pose(records["position"], records["rotation"])
    if result.frames is not None:
        tool = compose(tool, result.frames.tool)
    path = 1e3 * tool.position[moving[:: -(-len(moving) // _PATH_POINTS)]]
    tips, tip_axes = 1e3 * tool.position[shown], tool.rotation[shown]
    base, platform = 1e3 * mechanism.base_joints, 1e3 * mechanism.platform_joints
    ghosts = {REFERENCE_COLOR: (result.reference_positions, result.reference_rotations)}
    if result.truth_known:
        ghosts[TRUTH_COLOR] = (result.true_positions, result.true_rotations)

    def joints_at(positions: Array, rotations: Array) -> Array:
        """The platform's joints (count, n, 3) [mm] at poses (N)."""
        joints: Array = 1e3 * positions[shown, None] + platform @ np.swapaxes(rotations[shown], 1, 2)
        return joints

    joints = joints_at(records["position"], records["rotation"])
    platform_ring = ring(platform)
    rims = [joints_at(*poses)[:, platform_ring] for poses in ghosts.values()]
    shares = _leg_shares(result, shown, 1e-3 * np.linalg.norm(joints - base, axis=2))
    numbers = base + 0.12 * (base - base.mean(axis=0))
    tube = TUBE_SHARE * 1e3 * mechanism.require_limits().stroke[:, :1]
    triad = 0.4 * np.linalg.norm(platform, axis=1).max()

    def moving_parts(k: int) -> list[Any]:
        """The traces of what moves: the platform, tubes by the first colouring, rods, axes, ghosts, other tubes."""
        legs = joints[k] - base
        ends = base + tube * legs / np.linalg.norm(legs, axis=1, keepdims=True)
        tubes = [view.shaded_line(view.segments(base, ends), np.repeat(each[k], 3), 14) for each in shares.values()]
        axes = view.segments(np.broadcast_to(tips[k], (3, 3)), tips[k] + triad * tip_axes[k].T)
        return [
            *view.plate(joints[k][platform_ring], *view.PLATFORM),
            tubes[0],
            view.line(view.segments(ends, joints[k]), NEUTRAL, 6),
            view.line(axes, view.segment_colors(AXIS_NAMES), 5),
            *(view.line(rim[k], color, 3) for rim, color in zip(rims, ghosts, strict=True)),
            *(each.update(visible=False) for each in tubes[1:]),
        ]

    def frame(k: int) -> go.Frame:
        data = [_moved(part) for part in moving_parts(k)]
        return go.Frame(name=str(k), traces=list(range(len(data))), data=data)

    first = moving_parts(0)
    figure = go.Figure(
        [
            *first,
            *view.plate(base[ring(base)], *view.BASE),
            view.line(path, FAINT, 2),
            view.labels(numbers, [str(k) for k in range(mechanism.legs)]),
        ],
        frames=[frame(k) for k in range(count)],
    )
    points = np.concatenate([numbers, joints.reshape(-1, 3), path])
    if result.frames is not None and result.frames.root == BASE:
        work = result.frames.work
        origin, ends = 1e3 * work.position, 1e3 * work.position + triad * work.rotation.T
        figure.add_trace(view.line(view.segments(np.broadcast_to(origin, (3, 3)), ends), view.segment_colors(AXIS_NAMES), 5))
        points = np.concatenate([points, origin[None], ends])
    player = _player(result.times[shown], frame_s)
    player["updatemenus"].append(_colorings([2, *range(len(first) - len(COLORINGS) + 1, len(first))]))
    figure.update_layout(
        LAYOUT,
        **view.VIEW,
        height=540,
        uirevision="kept",
        scene=view.scene(points, mechanism.up_in_base, np.array([0.0, 0.0, 1.0]) if mechanism.planar else None),
        **player,
    )
    speed = span / count / frame_s
    pace = "in real time" if speed < 1.05 else f"at {speed:.2g} times real speed"
    pace += ", or as fast as the browser draws them"
    of = "the origin" if result.frames is None else result.frames.frames.tool
    truth = f", a red one of the {TRUTH}" if result.truth_known else ""
    caption = (
        f"Estimated poses {pace}, with a blue ghost of the {REFERENCE}{truth}, and the path of {of} in grey. Legs turn from "
        "green to red near an end of the stroke, near the greatest speed, or without an IMU. Drag to turn, scroll to zoom."
    )
    return caption, figure


def _moved(part: Any) -> dict[str, Any]:
    """What a frame changes of a trace."""
    moved = {"type": part.type, **{axis: part[axis] for axis in AXIS_NAMES}}
    if part.type == "scatter3d" and part.line.colorscale is not None:
        moved["line"] = {"color": part.line.color}
    return moved


def _leg_shares(result: SimulationResult, shown: NDArray[np.intp], lengths: Array) -> dict[str, Array]:
    """What each of `COLORINGS` shows of legs with these lengths (count, n) [m], at the records `shown` (count,)."""
    limits, records, legs = result.mechanism.require_limits(), result.records[shown], np.arange(result.mechanism.legs)
    shares = (
        stroke_shares(lengths, limits.stroke),
        speed_shares(records["reference"][:, legs, 1], limits.velocity),
        imu_shares((records["imus"][:, None] >> legs & 1).astype(np.bool_)),
    )
    return dict(zip(COLORINGS, shares, strict=True))


def _colorings(tubes: Sequence[int]) -> dict[str, Any]:
    """A menu that chooses which of the traces `tubes`, and so which colouring, is seen."""
    buttons = [
        {"label": f"legs by {name}", "method": "restyle", "args": [{"visible": [tube == own for tube in tubes]}, [*tubes]]}
        for name, own in zip(COLORINGS, tubes, strict=True)
    ]
    return {"buttons": buttons, "x": 0.0, "xanchor": "left", "y": 1.0, "yanchor": "top", "pad": {"t": 8, "l": 10}}


def _player(times: Array, frame_s: float) -> dict[str, Any]:
    """Buttons to play and pause, and a slider with a step for each frame."""
    play = {"frame": {"duration": 1e3 * frame_s, "redraw": True}, "transition": {"duration": 0}, "fromcurrent": True}
    show = {"frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}, "mode": "immediate"}
    buttons = [
        {"label": "▶", "method": "animate", "args": [None, play]},
        {"label": "❚❚", "method": "animate", "args": [[None], show]},
    ]
    steps = [{"label": f"{time:.2f}", "method": "animate", "args": [[str(k)], show]} for k, time in enumerate(times)]
    slider = {
        "x": 0.16,
        "len": 0.8,
        "y": 0.0,
        "pad": {"t": 10},
        "bgcolor": GRID,
        "activebgcolor": FAINT,
        "bordercolor": FAINT,
        "ticklen": 0,
        "minorticklen": 0,
        "font": {"color": "rgba(0, 0, 0, 0)", "size": 1},
        "currentvalue": {"prefix": "time ", "suffix": " s", "xanchor": "right", "font": {"color": NEUTRAL, "size": 13}},
        "steps": steps,
    }
    menu = {
        "type": "buttons",
        "direction": "left",
        "showactive": False,
        "x": 0.0,
        "xanchor": "left",
        "y": 0.0,
        "yanchor": "top",
        "pad": {"t": 22, "l": 10},
        "buttons": buttons,
    }
    return {"updatemenus": [menu], "sliders": [slider]}


_SHARED_TIME = """
const plots = document.querySelectorAll(".time .plotly-graph-div");
plots.forEach(plot => plot.on("plotly_relayout", () => {
  const range = plot.layout.xaxis.range;
  plots.forEach(other => {
    if (String(other.layout.xaxis.range) !== String(range)) Plotly.relayout(other, {"xaxis.range": [...range]});
  });
}));
"""
