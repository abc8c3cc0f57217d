"""A simulation as a moving picture: SVG with SMIL, without a script, so that it moves wherever an image is shown."""

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.look import (
    BASE_COLOR,
    FAINT,
    NEUTRAL,
    PLATFORM_COLOR,
    REFERENCE,
    REFERENCE_COLOR,
    TUBE_SHARE,
    VIEWED_FROM,
    leg_colors,
    ring,
    stroke_shares,
)  # fmt: skip
from hil.reports import svg
from hil.runs.simulation import SimulationResult
from plant.errors import InputError
from plant.files import write_whole
from plant.mechanism import Mechanism
from plant.pose import Array

_WIDTH, _HEIGHT, _MARGIN, _CAPTION = 640.0, 460.0, 24.0, 48.0
_TOLERANCE, _SHADES = 0.25, 12.0
"""How far a drawn point may be off between keyframes [px], and what a share of a leg's colour counts then [px]."""
_SAMPLES, _SAMPLE_RATE_HZ, _KEYFRAMES = 3000, 50.0, 300
_CAPTIONS, _CAPTION_S = 60, 0.25
"""The most captions, and about how long each stays [s] unless there would be more."""
_ELEVATION = np.arctan(np.sqrt(0.5))


class _Projection(NamedTuple):
    """Parallel projection to the picture: pixels are `offset` (2,) + points [m] @ `axes` (3, 2)."""

    axes: Array
    offset: Array

    def __call__(self, points: Array) -> Array:
        """Points (..., 3) [m] in {1} as pixels (..., 2)."""
        pixels: Array = self.offset + points @ self.axes
        return pixels


class _Course(NamedTuple):
    """What is drawn at the moments (m,) [s] of the motion, of n legs: points [m] and shares of colours."""

    times: Array
    joints: Array  # (m, n, 3), of the platform as it is estimated
    reference: Array  # (m, n, 3), of the platform as it should be
    origins: Array  # (m, 3), of {2}
    shares: Array  # (m, n)
    errors: Array  # (m,) [m], of the estimate, or of the reference where the truth is not known


def write_picture(result: SimulationResult, path: Path) -> None:
    """Draw a simulation in motion, in real time and again and again, into a file of less than 300 kB.

    Raises:
        InputError: there is no pose to draw, or the file cannot be written.
    """
    write_whole(path, f"{picture_svg(result)}\n".encode())


def picture_svg(result: SimulationResult) -> str:
    """The SVG text of `write_picture`."""
    mechanism, course = result.mechanism, _course(result)
    moving = result.times >= 0.0
    path = result.target_positions[moving][:: max(1, int(moving.sum()) // _SAMPLES)]
    base = mechanism.base_joints
    project = _projection(mechanism, np.concatenate([base, path, *course.joints]))
    ends = base + _tube_shares(mechanism, course)[..., None] * (course.joints - base)
    tubes = np.stack([np.broadcast_to(project(base), (*ends.shape[:2], 2)), project(ends)], axis=2)
    rods = np.stack([project(ends), project(course.joints)], axis=2)
    platform_ring = ring(mechanism.platform_joints)[:-1]
    plate, ghost = project(course.joints[:, platform_ring]), project(course.reference[:, platform_ring])
    drawn = (plate, ghost, tubes, project(course.origins), _SHADES * course.shares)
    kept = _keyframes(np.hstack([each.reshape(len(course.times), -1) for each in drawn]))
    clock = _Clock(course.times[kept], float(course.times[-1]))
    colors = leg_colors(course.shares[kept])
    towards = np.cross(project.axes[:, 1], project.axes[:, 0])
    body = [
        f"<title>{escape(f'{mechanism.name} follows {result.target.name}')}</title>",
        _polygon(project(base[ring(base)[:-1]]), f'fill="{FAINT}" fill-opacity="0.25" stroke="{BASE_COLOR}" stroke-width="2"'),
        f'<polyline points="{_pixels(_thinned(project(path)))}" fill="none" stroke="{NEUTRAL}" stroke-dasharray="1 4" '
        'stroke-linecap="round" stroke-width="2"/>',
    ]
    # What is farther away is drawn first.
    for leg in np.argsort((base + course.joints[0]) @ towards):
        shades = ["#" + bytes(color).hex() for color in colors[:, leg]]
        body.append(clock.line(rods[kept, leg], [NEUTRAL], 4))
        body.append(clock.line(tubes[kept, leg], shades, 9))
    look = f'fill="{PLATFORM_COLOR}" fill-opacity="0.45" stroke="{PLATFORM_COLOR}" stroke-width="3" stroke-linejoin="round"'
    body.append(clock.polygon(plate[kept], look))
    body.append(clock.polygon(ghost[kept], f'fill="none" stroke="{REFERENCE_COLOR}" stroke-width="1.5" stroke-dasharray="6 4"'))
    body.append(clock.dot(project(course.origins)[kept], f'r="4" fill="{NEUTRAL}"'))
    body += _captions(result, course, clock)
    return svg.document(_WIDTH, _HEIGHT, body)


def _projection(mechanism: Mechanism, points: Array) -> _Projection:
    """The isometric view, or of a planar mechanism the view along its axis, that has all points (N, 3) [m] in the picture."""
    up = mechanism.up_in_base
    if mechanism.planar:
        across = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    else:
        aside = np.array(VIEWED_FROM)
        aside = aside - (aside @ up) * up
        eye = np.cos(_ELEVATION) * aside / np.linalg.norm(aside) + np.sin(_ELEVATION) * up
        right = np.cross(up, eye) / np.linalg.norm(np.cross(up, eye))
        across = right, np.cross(eye, right)
    # Pixels count downwards.
    axes = np.stack([across[0], -across[1]], axis=1)
    seen = points @ axes
    least, most = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
    room = np.array([_WIDTH, _HEIGHT - _CAPTION]) - 2.0 * _MARGIN
    scale = float((room / np.maximum(most - least, 1e-9)).min())
    middle = np.array([_WIDTH, _HEIGHT - _CAPTION]) / 2.0
    return _Projection(scale * axes, middle - scale * (least + most) / 2.0)


def _course(result: SimulationResult) -> _Course:
    mechanism, records = result.mechanism, result.records
    moving = np.flatnonzero(result.times >= 0.0)
    count = int(np.clip(len(moving) / result.config.rate * _SAMPLE_RATE_HZ, 2, _SAMPLES))
    shown = moving[np.linspace(0, len(moving) - 1, count).astype(int)]
    shown = shown[np.isfinite(records["position"][shown]).all(axis=1)]
    if len(np.unique(shown)) < 2:
        raise InputError("a moving picture needs poses, and this run has none after its hold: leave --picture out")
    estimate = records["position"][shown], records["rotation"][shown]
    reference = _last_known(result.reference_positions[shown]), _last_known(result.reference_rotations[shown])
    truth = result.true_positions[shown] if result.truth_known else reference[0]
    joints = _joints(mechanism, *estimate)
    lengths = np.linalg.norm(joints - mechanism.base_joints, axis=2)
    return _Course(
        result.times[shown],
        joints,
        _joints(mechanism, *reference),
        estimate[0],
        stroke_shares(lengths, mechanism.require_limits().stroke),
        np.linalg.norm(estimate[0] - truth, axis=1),
    )


def _joints(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    joints: Array = positions[:, None] + mechanism.platform_joints @ np.swapaxes(rotations, 1, 2)
    return joints


def _last_known(values: Array) -> Array:
    """Values (m, ...) with the last finite ones in the place of NaN."""
    known = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    latest = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
    kept: Array = values[latest]
    return kept


def _tube_shares(mechanism: Mechanism, course: _Course) -> Array:
    """The drawn length of each leg's lower part over the leg's (m, n)."""
    lengths = np.linalg.norm(course.joints - mechanism.base_joints, axis=2)
    shares: Array = TUBE_SHARE * mechanism.require_limits().stroke[:, 0] / lengths
    return shares


def _keyframes(drawn: Array) -> NDArray[np.intp]:
    """The rows of `drawn` (m, d) [px] between which straight lines are near all others."""
    tolerance = _TOLERANCE
    while len(kept := _corners(drawn, tolerance)) > _KEYFRAMES:
        tolerance *= 1.5
    return kept


def _thinned(points: Array) -> Array:
    """The points (N, 2) [px] that are needed for a line through all."""
    return points[_corners(points, _TOLERANCE)]


def _corners(values: Array, tolerance: float) -> NDArray[np.intp]:
    """The rows of `values` (m, d), the first and the last among them, between which straight lines, in equal steps from row to
    row, are off by at most `tolerance` (Douglas and Peucker).
    """
    kept, parts = {0, len(values) - 1}, [(0, len(values) - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        share = (np.arange(first + 1, last) - first)[:, None] / (last - first)
        off = np.abs(values[first + 1 : last] - values[first] - share * (values[last] - values[first])).max(axis=1)
        worst = int(np.argmax(off))
        if off[worst] > tolerance:
            kept.add(middle := first + 1 + worst)
            parts += [(first, middle), (middle, last)]
    return np.array(sorted(kept))


class _Clock:
    """Elements that move with the keyframes at `times` (m,) of a motion that takes `duration` [s]."""

    def __init__(self, times: Array, duration: float) -> None:
        shares = times / duration
        shares[0] = 0.0
        self._each = f'dur="{duration:g}s" repeatCount="indefinite"'
        self._at = f'keyTimes="{";".join(f"{share:.4g}" for share in shares)}" {self._each}'

    def _changes(self, attribute: str, values: Sequence[str]) -> str:
        if len({*values}) < 2:
            return ""
        return f'<animate attributeName="{attribute}" values="{";".join(values)}" {self._at}/>'

    def line(self, ends: Array, colors: Sequence[str], width: float) -> str:
        """A line between ends (m, 2, 2) [px], with a colour for each keyframe or one for all."""
        values = [_pixels(each) for each in ends]
        moves = self._changes("points", values) + self._changes("stroke", colors)
        look = f'fill="none" stroke="{colors[0]}" stroke-width="{width:g}" stroke-linecap="round"'
        return f'<polyline points="{values[0]}" {look}>{moves}</polyline>'

    def polygon(self, corners: Array, look: str) -> str:
        """A polygon with corners (m, n, 2) [px]."""
        values = [_pixels(each) for each in corners]
        return f'<polygon points="{values[0]}" {look}>{self._changes("points", values)}</polygon>'

    def dot(self, places: Array, look: str) -> str:
        """A circle at places (m, 2) [px]."""
        x, y = ([f"{value:.1f}" for value in values] for values in places.T)
        return f'<circle cx="{x[0]}" cy="{y[0]}" {look}>{self._changes("cx", x)}{self._changes("cy", y)}</circle>'

    def shown(self, element: str, begin: float, end: float) -> str:
        """A group that is seen between two shares of the time."""
        values, at = ["hidden", "visible", "hidden"], [0.0, begin, end]
        if begin <= 0.0:
            values, at = values[1:], at[::2]
        if end >= 1.0:
            values, at = values[:-1], at[:-1]
        first = "visible" if begin <= 0.0 else "hidden"
        if len(values) < 2:
            return element
        times = ";".join(f"{share:.4g}" for share in at)
        change = f'values="{";".join(values)}" keyTimes="{times}" calcMode="discrete" {self._each}'
        return f'<g visibility="{first}">{element}<animate attributeName="visibility" {change}/></g>'


def _captions(result: SimulationResult, course: _Course, clock: _Clock) -> Iterator[str]:
    """What is drawn, and the time and the error as they are now."""
    bottom, duration = _HEIGHT - 16.0, float(course.times[-1])
    above = bottom - 18.0
    yield svg.text(_MARGIN, above, f"{result.mechanism.name} follows {result.target.name}")
    yield svg.text(_MARGIN, bottom, f"dashed: {REFERENCE}; legs turn from green to red near an end of their stroke")
    count = int(np.clip(round(duration / _CAPTION_S), 1, _CAPTIONS))
    off = "estimate - truth" if result.truth_known else f"estimate - {REFERENCE}"
    for number in range(count):
        begin = number / count
        nearest = int(np.searchsorted(course.times, begin * duration))
        error = 1e3 * course.errors[min(nearest, len(course.times) - 1)]
        text = svg.text(_WIDTH - _MARGIN, above, f"{begin * duration:.1f} s, {off} {error:.2f} mm", "end")
        yield clock.shown(text, begin, (number + 1) / count)


def _polygon(corners: Array, look: str) -> str:
    return f'<polygon points="{_pixels(corners)}" {look}/>'


def _pixels(points: Array) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in points.tolist())
