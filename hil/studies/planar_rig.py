"""A real planar rig: direct kinematics from the leg angles that its IMUs measured at known static poses.

A folder holds one file `pose_*.csv` for each pose: a first line with the true pose by image processing, a header, then a
sample of all leg angles in every row, as measured raw, and after a Kalman and a complementary filter.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from controller.direct_kinematics.planar import AssemblyMode, closing_angles, closing_positions, solve_planar, wrapped
from hil.reports.page import LAYOUT, figure_html, page
from plant.errors import InputError, SingularConfigurationError
from plant.files import write_whole
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array

SOURCES = ("raw", "kalman", "complementary")
COLUMNS = tuple(f"leg{leg}_{source}_deg" for source in SOURCES for leg in range(1, PLANAR_LEGS + 1))

TRUE_DISTANCE_M = 0.010
TRUE_ANGLE = np.radians(8.0)
"""A mode is the true pose if it is no further from it than `TRUE_DISTANCE_M` and this angle [rad]."""

_FIRST_LINE = re.compile(r"# true pose by image processing: x (\S+) mm, y (\S+) mm, gamma (\S+) deg")
_COMPONENTS = (("x", "mm", 1e3), ("y", "mm", 1e3), ("angle", "deg", np.degrees(1.0)))
_COLORS = dict(zip(SOURCES, ("#e8871e", "#3b6fb6", "#3a9d6e"), strict=True))
_DRAWN = SOURCES.index("kalman")
_COLUMNS_DRAWN = 4


@dataclass(frozen=True, eq=False)
class RigPose:
    """A static pose of the rig; N samples of each source, in the order of `SOURCES`.

    Attributes:
        name: of its file.
        true_pose: (3,), x, y [m] and angle [rad].
        true_leg_angles: (3,) [rad] at the true pose.
        leg_errors: (3, N, 3), measured minus true angle of each leg [rad], by source, sample and leg.
        errors: (3, N, 3), the assembly mode nearest to the true pose minus this: x, y [m] and angle [rad].
    """

    name: str
    true_pose: Array
    true_leg_angles: Array
    leg_errors: Array
    errors: Array


@dataclass(frozen=True, eq=False)
class RigEvaluation:
    """What the direct kinematics makes of the leg angles of a rig."""

    mechanism: PlanarMechanism
    poses: tuple[RigPose, ...]

    def summary(self) -> dict[str, Any]:
        """The figures by source, in SI units.

        - `rms`: over the poses, of the mean error of a pose.
        - `true_mode`: the share of `samples` and the number of `poses`, by their mean, in which a mode is the true pose.
        - `leg_angles`: their `constant_error`, the RMS over legs and poses of the mean error, and their `noise`, that of
          the standard deviation.
        - `poses`: mean and standard deviation of the error of each.
        """
        means = np.array([pose.errors.mean(axis=1) for pose in self.poses])
        samples = np.concatenate([pose.errors for pose in self.poses], axis=1)
        constant_error = _rms(np.array([pose.leg_errors.mean(axis=1) for pose in self.poses]), (0, 2))
        noise = _rms(np.array([pose.leg_errors.std(axis=1) for pose in self.poses]), (0, 2))
        sources: dict[str, Any] = {
            source: {
                "rms": _named(_rms(means[:, i], 0)),
                "true_mode": {"samples": float(_is_true(samples[i]).mean()), "poses": int(_is_true(means[:, i]).sum())},
                "leg_angles": {"constant_error": float(constant_error[i]), "noise": float(noise[i])},
                "poses": {
                    pose.name: {
                        "mean_error": _named(pose.errors[i].mean(axis=0)),
                        "standard_deviation": _named(pose.errors[i].std(axis=0)),
                    }
                    for pose in self.poses
                },
            }
            for i, source in enumerate(SOURCES)
        }
        return {
            "mechanism": self.mechanism.name,
            "true_poses": {pose.name: _named(pose.true_pose) for pose in self.poses},
            "sources": sources,
            "version": version("gough"),
        }


def evaluate(folder: str | Path, mechanism: PlanarMechanism) -> RigEvaluation:
    """Solve every sample of every pose in the files `pose_*.csv` of a folder.

    Of the two assembly modes, the one whose platform joints are nearest to the true ones counts for the errors.

    Raises:
        InputError: the folder is missing or has no such file, or a file is malformed or not finite; names file and line.
        SingularConfigurationError: a sample leaves the pose open.
    """
    paths = sorted(Path(folder).glob("pose_*.csv"))
    if not paths:
        raise InputError(f"{folder} is no folder with files pose_*.csv: give one with the poses of a rig")
    return RigEvaluation(mechanism, tuple(_evaluate_pose(path, mechanism) for path in paths))


def _evaluate_pose(path: Path, mechanism: PlanarMechanism) -> RigPose:
    true_pose, leg_angles = _read_csv(path)
    x, y = (mechanism.joints_at(true_pose[:2], true_pose[2]) - mechanism.base_joints).T
    true_leg_angles = np.arctan2(y, x)
    try:
        angles = closing_angles(mechanism, leg_angles)
    except SingularConfigurationError as error:
        raise SingularConfigurationError(f"{path}: {error}") from None
    positions = closing_positions(mechanism, leg_angles[..., None, :], angles)
    nearest = _distances(mechanism, true_pose, positions, angles).argmin(axis=-1)[..., None, None]
    errors = np.concatenate([positions - true_pose[:2], wrapped(angles - true_pose[2])[..., None]], axis=-1)
    return RigPose(
        name=path.stem,
        true_pose=true_pose,
        true_leg_angles=true_leg_angles,
        leg_errors=wrapped(leg_angles - true_leg_angles),
        errors=np.take_along_axis(errors, nearest, axis=-2)[..., 0, :],
    )


def _distances(mechanism: PlanarMechanism, true_pose: Array, positions: Array, angles: Array | float) -> Array:
    """How far the platform joints are (...) [m], in root sum square, from where they are at the true pose."""
    offsets = mechanism.joints_at(positions, angles) - mechanism.joints_at(true_pose[:2], true_pose[2])
    distances: Array = np.linalg.norm(offsets, axis=(-2, -1))
    return distances


def _read_csv(path: Path) -> tuple[Array, Array]:
    """The true pose (3,) [m, m, rad] and the leg angles (3, N, 3) [rad], by source, sample and leg."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}") from None
    first, header, *samples = (line.strip() for line in [*lines, "", ""])
    match = _FIRST_LINE.fullmatch(first)
    true_pose = _numbers(match.groups() if match else (), 3)
    if true_pose is None:
        raise InputError(
            f"{path}, line 1: {first!r} gives no true pose in finite numbers: write "
            "'# true pose by image processing: x 107 mm, y 192 mm, gamma 0 deg'"
        )
    if header != ",".join(COLUMNS):
        raise InputError(f"{path}, line 2: the header must be {','.join(COLUMNS)}")
    rows = []
    for number, line in enumerate(samples, start=3):
        if not line:
            continue
        row = _numbers(line.split(","), len(COLUMNS))
        if row is None:
            raise InputError(f"{path}, line {number}: {line!r} is not a row of {len(COLUMNS)} finite numbers")
        rows.append(row)
    if not rows:
        raise InputError(f"{path} ends without a sample: it needs at least 1")
    by_source = np.radians(rows).reshape(-1, len(SOURCES), PLANAR_LEGS).swapaxes(0, 1)
    return np.array(true_pose) / [scale for _, _, scale in _COMPONENTS], by_source


def _numbers(fields: Sequence[str], count: int) -> list[float] | None:
    """The fields as `count` finite numbers, or None."""
    try:
        numbers = [float(field) for field in fields]
    except ValueError:
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None


def _rms(values: Array, axes: int | tuple[int, ...]) -> Array:
    root: Array = np.sqrt(np.mean(values**2, axis=axes))
    return root


def _is_true(errors: Array) -> NDArray[np.bool_]:
    true: NDArray[np.bool_] = (np.hypot(errors[:, 0], errors[:, 1]) <= TRUE_DISTANCE_M) & (np.abs(errors[:, 2]) <= TRUE_ANGLE)
    return true


def _named(pose: Array) -> dict[str, float]:
    return {name: float(value) for (name, _, _), value in zip(_COMPONENTS, pose, strict=True)}


def write_report(result: RigEvaluation, path: Path) -> None:
    """Write the report of an evaluation as one HTML file, which takes its place only when it is complete.

    Raises:
        InputError: the file cannot be written.
    """
    write_whole(path, _page(result).encode())


def _page(result: RigEvaluation) -> str:
    summary = result.summary()
    title = f"gough: {escape(result.mechanism.name)} at {len(result.poses)} known poses"
    samples = sum(pose.errors.shape[1] for pose in result.poses)
    errors = figure_html(
        "errors",
        "Error of the pose",
        "Mean over the samples of a pose, estimate minus truth; the bars are the standard deviation of one sample.",
        _error_plot(result),
        "time",
    )
    modes = figure_html(
        "modes",
        "Assembly modes",
        f"Both poses that the mean {SOURCES[_DRAWN]} leg angles allow, and the true pose in grey. The conditioning is that of "
        "the mode nearest to it.",
        _mode_plot(result),
        "time",
    )
    subtitle = f"{samples} samples of each source · leg angles only · gough {summary['version']}"
    return page(title, subtitle, f"{_table(summary['sources'], len(result.poses))}\n{errors}\n{modes}")


def _table(sources: dict[str, Any], poses: int) -> str:
    rows = "".join(
        f"<tr><th>{source}</th>"
        + "".join(f"<td>{scale * figures['rms'][name]:.2f}</td>" for name, _, scale in _COMPONENTS)
        + "".join(f"<td>{np.degrees(figures['leg_angles'][name]):.2f}</td>" for name in ("constant_error", "noise"))
        + f"<td>{figures['true_mode']['poses']} of {poses}</td><td>{100.0 * figures['true_mode']['samples']:.1f} %</td></tr>\n"
        for source, figures in sources.items()
    )
    columns = "".join(f"<th>{name} [{unit}]</th>" for name, unit, _ in _COMPONENTS)
    return f"""<table>
<thead>
<tr><th rowspan="2"></th><th colspan="3">RMS of the mean errors</th><th colspan="2">leg angles [deg]</th>
<th colspan="2">a mode within {1e3 * TRUE_DISTANCE_M:g} mm, {np.degrees(TRUE_ANGLE):g} deg</th></tr>
<tr>{columns}<th>constant error</th><th>noise</th><th>poses</th><th>samples</th></tr>
</thead>
<tbody>
{rows}</tbody>
</table>"""


def _error_plot(result: RigEvaluation) -> go.Figure:
    figure = make_subplots(len(_COMPONENTS), 1, shared_xaxes=True, vertical_spacing=0.05)
    places = np.arange(len(result.poses))
    for row, (name, unit, scale) in enumerate(_COMPONENTS):
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
    figure.update_layout(LAYOUT, height=620, legend=_LEGEND)
    return figure


def _mode_plot(result: RigEvaluation) -> go.Figure:
    drawn = [(pose, *_modes_near(result.mechanism, pose)) for pose in result.poses]
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
        row, column = divmod(number, columns)
        for name, position, angle, line in (
            ("true pose", pose.true_pose[:2], pose.true_pose[2], {"color": "#c5ccd4", "width": 7}),
            ("mode nearest to it", near.position, near.angle, {"color": "#3b6fb6", "width": 2}),
            ("other mode", far.position, far.angle, {"color": "#e8871e", "width": 2, "dash": "dot"}),
        ):
            x, y = 1e3 * _outline(result.mechanism, position, angle).T
            figure.add_scatter(
                x=x, y=y, mode="lines", line=line, name=name, legendgroup=name, showlegend=number == 0, hoverinfo="skip",
                row=row + 1, col=column + 1,
            )  # fmt: skip
        figure.update_yaxes(scaleanchor=f"x{number + 1}" if number else "x", row=row + 1, col=column + 1)
    figure.update_xaxes(title_text="x [mm]", row=rows)
    figure.update_yaxes(title_text="y [mm]", col=1)
    figure.update_layout(LAYOUT, height=120 + 330 * rows, legend={**_LEGEND, "y": 1.06})
    return figure


def _modes_near(mechanism: PlanarMechanism, pose: RigPose) -> tuple[AssemblyMode, AssemblyMode]:
    """The assembly modes at the mean leg angles, the one nearest to the true pose first; both are the same if they merge."""
    modes = solve_planar(mechanism, pose.true_leg_angles + pose.leg_errors[_DRAWN].mean(axis=0))
    near, *others = sorted(modes, key=lambda mode: float(_distances(mechanism, pose.true_pose, mode.position, mode.angle)))
    return near, others[0] if others else near


def _outline(mechanism: PlanarMechanism, position: Array, angle: float) -> Array:
    """Points (13, 2) [m] of the legs, with gaps between, and round the platform."""
    joints = mechanism.joints_at(position, angle)
    legs = np.stack([mechanism.base_joints, joints, np.full_like(joints, np.nan)], axis=1)
    return np.concatenate([legs.reshape(-1, 2), joints, joints[:1]])


_LEGEND = {"orientation": "h", "x": 0.0, "y": 1.0, "yanchor": "bottom"}
