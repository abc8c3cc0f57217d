"""The accuracy of a calibration, stage by stage, as SVG for its report and for documents."""

from collections.abc import Mapping
from math import ceil, floor, log10
from pathlib import Path
from typing import Any

from hil.calibration.assessment import STAGES
from hil.look import FAINT, GRID, SERIES
from hil.reports import svg
from plant.files import write_whole

KINDS = {
    "predicted": ("predicted", FAINT),
    "validated": ("halves of the data differ by", SERIES[1]),
    "true": ("true", SERIES[0]),
}
"""Measures of accuracy in a summary, with their names and colors."""

_LEFT, _TOP, _BAR, _GAP, _WIDTH = 150, 40, 14, 16, 500


def write_picture(summary: Mapping[str, Any], path: Path) -> None:
    """Draw the RMS error of the position with each stage's calibration into a file.

    Raises:
        InputError: the file cannot be written.
    """
    write_whole(path, f"{accuracy_svg(summary, 'position_rms', 'mm', 1e3)}\n".encode())


def accuracy_svg(summary: Mapping[str, Any], error: str, unit: str, scale: float) -> str:
    """Logarithmic bars of "position_rms" or "rotation_rms" by stage; `scale` is the factor from SI to the unit."""
    stages = list(summary["residual_mg"])
    sizes = {}
    for kind in KINDS:
        for stage, errors in summary[kind].items():
            sizes[stage, kind] = scale * errors[error]
    first, last = floor(log10(min(sizes.values()))), ceil(log10(max(sizes.values())))

    def x(size: float) -> float:
        return _LEFT + _WIDTH * (log10(size) - first) / (last - first)

    step = len(KINDS) * _BAR + _GAP
    bottom = _TOP + len(stages) * step
    parts = []
    for decade in range(first, last + 1):
        at = x(10.0**decade)
        parts.append(f'<path d="M{at:.1f} {_TOP - 6}V{bottom}" stroke="{GRID}"/>')
        parts.append(svg.text(at, bottom + 18, f"{10.0**decade:g} {unit}", "middle"))
    for i, stage in enumerate(stages):
        parts.append(svg.text(_LEFT - 10, _TOP + i * step + 1.5 * _BAR + 4, STAGES[stage], "end"))
        for j, (kind, (_, color)) in enumerate(KINDS.items()):
            if (size := sizes.get((stage, kind))) is None:
                continue
            y, end = _TOP + i * step + j * _BAR, x(size)
            parts.append(f'<path d="M{_LEFT} {y}H{end:.1f}V{y + _BAR - 2}H{_LEFT}Z" fill="{color}"/>')
            parts.append(svg.text(end + 5, y + _BAR - 3, f"{size:.3g}", "start"))
    for j, (name, color) in enumerate(KINDS.values()):
        at = _LEFT + 130 * j + 70 * (j > 1)
        parts.append(f'<path d="M{at} 8h12v12h-12Z" fill="{color}"/>')
        parts.append(svg.text(at + 17, 18, name, "start"))
    return svg.document(_LEFT + _WIDTH + 60, bottom + 30, parts)
