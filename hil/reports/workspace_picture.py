"""The slices of a workspace, as SVG for documents and reports: what is reached, and which limit binds elsewhere."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controller.workspace import KINDS, LIMITS, Slice
from hil.look import NEUTRAL, SERIES
from hil.reports import svg
from hil.studies.workspace import Workspace
from plant.files import write_whole

_COLORS = dict(zip(KINDS, SERIES, strict=True))
_OPACITIES = (0.3, 0.42, 0.54, 0.66, 0.78, 0.9)
_LEFT, _TOP, _SIZE, _GAP, _BELOW = 64, 64, 300, 70, 74


def write_picture(found: Sequence[Workspace], path: Path) -> None:
    """Draw the slices of workspaces, one below the other, into a file.

    Raises:
        InputError: the file cannot be written.
    """
    write_whole(path, f"{picture_svg(found)}\n".encode())


def picture_svg(found: Sequence[Workspace]) -> str:
    """The SVG text of `write_picture`."""
    columns = max(len(each.slices) for each in found)
    body: list[str] = []
    for row, workspace in enumerate(found):
        top = _TOP + row * (_SIZE + _BELOW)
        for column, each in enumerate(workspace.slices):
            body += _slice(each, workspace.label, _LEFT + column * (_SIZE + _GAP), top)
    body += _legend(_kinds(found))
    width, height = _LEFT + columns * (_SIZE + _GAP), _TOP + len(found) * (_SIZE + _BELOW)
    return svg.document(width, height, body)


def _kinds(found: Sequence[Workspace]) -> list[str]:
    numbers = {number for each in found for part in each.slices for number in np.unique(part.binding[~part.reachable])}
    return [kind for kind in KINDS if any(LIMITS[number].kind == kind for number in numbers)]


def _legend(kinds: Sequence[str]) -> Iterator[str]:
    at = float(_LEFT)
    yield svg.text(at, 18, "blank: reached; in colour: what is exceeded most, a shade for each leg:")
    for kind in kinds:
        yield f'<rect x="{at:.0f}" y="26" width="12" height="12" fill="{_COLORS[kind]}"/>'
        yield svg.text(at + 17, 36, kind, "start")
        at += 36.0 + 7.0 * len(kind)


def _slice(part: Slice, label: str, left: float, top: float) -> Iterator[str]:
    """A slice with its axes in mm or deg; runs of equal cells are one rectangle."""
    rows, columns = part.reachable.shape
    wide, high = _SIZE / columns, _SIZE / rows
    for row in range(rows):
        y = top + _SIZE - (row + 1) * high
        values = np.where(part.reachable[row], -1, part.binding[row])
        for start, stop in _runs(values):
            if values[start] >= 0:
                limit = LIMITS[values[start]]
                shade = _OPACITIES[limit.legs[0]] if limit.legs else _OPACITIES[-1]
                yield (
                    f'<rect x="{left + start * wide:.2f}" y="{y:.2f}" width="{(stop - start) * wide + 0.3:.2f}" '
                    f'height="{high + 0.3:.2f}" fill="{_COLORS[limit.kind]}" fill-opacity="{shade}"/>'
                )
    yield f'<rect x="{left}" y="{top}" width="{_SIZE}" height="{_SIZE}" fill="none" stroke="{NEUTRAL}"/>'
    for axis, ends, along in ((part.axes[0], part.columns, True), (part.axes[1], part.rows, False)):
        scale, unit = (np.degrees(1.0), "deg") if axis.startswith("r") else (1e3, "mm")
        for share in (0.0, 0.5, 1.0):
            value = f"{scale * (ends[0] + share * (ends[-1] - ends[0])):.3g}"
            if along:
                yield svg.text(left + share * _SIZE, top + _SIZE + 15, value, "middle")
            else:
                yield svg.text(left - 5, top + _SIZE * (1.0 - share) + 4, value, "end")
        name = f"{axis} [{unit}]"
        if along:
            yield svg.text(left + 0.25 * _SIZE, top + _SIZE + 15, name, "middle")
        else:
            x, y = left - 30, top + 0.75 * _SIZE
            yield svg.upright_text(x, y, name)
    yield svg.text(left + 0.5 * _SIZE, top - 6, label, "middle")


def _runs(values: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Where runs of equal values begin and end."""
    changes = np.flatnonzero(np.diff(values)) + 1
    yield from zip([0, *changes.tolist()], [*changes.tolist(), len(values)], strict=True)
