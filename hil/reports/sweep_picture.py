"""The figures of a sweep over up to three of its factors, as SVG for documents."""

from collections.abc import Iterator, Mapping, Sequence
from math import ceil, floor, isfinite, log10
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hil.look import GRID, SERIES
from hil.reports import svg
from hil.sweep.analysis import Level
from hil.sweep.study import Factor, Study
from hil.sweep.sweep import SweepResult
from hil.sweep.units import headed, label_of, unit_of_factor, unit_of_figure
from plant.errors import InputError
from plant.files import write_whole

_LEFT, _TOP, _WIDTH, _HEIGHT, _GAP, _BELOW = 74, 62, 210, 175, 18, 40
_SPREAD = 14.0
"""How far the points of two colours at the same value are apart."""
_MOST = 6
"""The most values of a factor, and figures."""


class _Part(NamedTuple):
    """Some of the runs, by the value of a factor."""

    label: str
    chosen: np.ndarray[Any, np.dtype[np.bool_]]


class _Axes(NamedTuple):
    """The axes of a panel: the pixels of its upper left corner, and the values at its upper end and between its lines."""

    left: float
    top: float
    end: float
    step: float

    def x(self, place: int, places: int) -> float:
        """The pixel of one of the places along the axis."""
        return self.left + _WIDTH * (place + 0.5) / places

    def y(self, value: float) -> float:
        """The pixel of a value."""
        return self.top + _HEIGHT * (1.0 - min(max(value / self.end, 0.0), 1.0))


def write_picture(result: SweepResult, path: Path) -> None:
    """Draw the median and the 90 % quantile of each shown figure over up to three factors into a file.

    The last factor is along the axis; before it, the first one has colours, and the second one columns. All others are pooled.

    Raises:
        InputError: no run has a figure, nothing but the seed varies, a factor has too many values, or the file cannot be
            written.
    """
    write_whole(path, f"{picture_svg(result)}\n".encode())


def drawn_factors(study: Study) -> list[Factor]:
    """Up to three factors that a picture shows: along the axis, by colour, by column.

    Raises:
        InputError: nothing but the seed varies, or a factor has too many values.
    """
    factors = [each for each in study.factors if not each.is_seed]
    if not factors:
        raise InputError("a picture needs a factor besides the seed: leave it out")
    drawn = [factors[-1], *factors[:-1][:2]]
    for each in drawn:
        if len(each.values) > _MOST:
            raise InputError(f"{each.name} has {len(each.values)} values, and a picture shows at most {_MOST}: take a report")
    return drawn


def picture_svg(result: SweepResult) -> str:
    """The SVG text of `write_picture`."""
    figures = [name for name in result.figures() if result.analysis.over_all(name)][:_MOST]
    along, *others = drawn_factors(result.study)
    if not figures:
        raise InputError("a picture needs a figure of a run, and none has one: leave it out")
    colored, columned = others[:1], others[1:]
    places = _parts(result, along)
    series, panels = (_parts(result, *each) for each in (colored, columned))
    body = _legend(colored[0], series) if colored else []
    for column, panel in enumerate(panels if columned else ()):
        middle = _LEFT + column * (_WIDTH + _GAP) + _WIDTH / 2
        body.append(svg.text(middle, _TOP - 10, f"{_heading(result, columned[0])}: {panel.label}", "middle"))
    for row, name in enumerate(figures):
        body += _row(result, name, _TOP + row * (_HEIGHT + _BELOW), (panels, series, places))
    width, height = _LEFT + len(panels) * (_WIDTH + _GAP), _TOP + len(figures) * (_HEIGHT + _BELOW) + 22
    explained = f"{_heading(result, along)}; dots: median with its 95 % confidence; dashes: 90 % of the runs lie below"
    body.append(svg.text(_LEFT, height - 8, explained))
    return svg.document(width, height, body)


def _parts(result: SweepResult, *factors: Factor) -> list[_Part]:
    """The runs by a factor's value; all of them without a factor."""
    if not factors:
        return [_Part("", np.ones(len(result.table), np.bool_))]
    scale = unit_of_factor(result.study, factors[0].name)[1]
    return [_Part(label_of(value, scale), chosen) for value, chosen in result.analysis.parts(factors[0])]


def _heading(result: SweepResult, factor: Factor) -> str:
    return headed(factor.name, unit_of_factor(result.study, factor.name)[0])


def _legend(factor: Factor, series: Sequence[_Part]) -> list[str]:
    drawn, at = [svg.text(_LEFT, 20, f"{factor.name}:", "start")], _LEFT + 20.0 + 7.0 * len(factor.name)
    for each, color in zip(series, SERIES, strict=False):
        drawn.append(f'<circle cx="{at:.0f}" cy="16" r="4.5" fill="{color}"/>')
        drawn.append(svg.text(at + 9, 20, each.label, "start"))
        at += 32.0 + 7.0 * len(each.label)
    return drawn


def _row(
    result: SweepResult, name: str, top: float, parts: tuple[Sequence[_Part], Sequence[_Part], Sequence[_Part]]
) -> list[str]:
    """The panels of a figure, which share the axis."""
    panels, series, places = parts
    unit, scale = unit_of_figure(name)
    levels = {
        (i, j, k): level
        for i, panel in enumerate(panels)
        for j, each in enumerate(series)
        for k, place in enumerate(places)
        if (level := result.analysis.level(name, None, panel.chosen & each.chosen & place.chosen))
    }
    ends = [end for level in levels.values() for end in (level.quantiles[0].high, level.quantiles[1].value)]
    most = scale * max(filter(isfinite, ends))
    step = _step(most)
    middle = top + _HEIGHT / 2
    drawn = [svg.upright_text(18, middle, headed(name, unit))]
    for i in range(len(panels)):
        axes = _Axes(_LEFT + i * (_WIDTH + _GAP), top, step * ceil(most / step), step)
        drawn += _frame(axes, places, i == 0)
        for j, color in enumerate(SERIES[: len(series)]):
            shift = _SPREAD * (j - (len(series) - 1) / 2.0)
            own = {axes.x(k, len(places)) + shift: levels[i, j, k] for k in range(len(places)) if (i, j, k) in levels}
            drawn += _series(axes, own, scale, color)
    return drawn


def _frame(axes: _Axes, places: Sequence[_Part], numbered: bool) -> Iterator[str]:
    for number in range(round(axes.end / axes.step) + 1):
        value = number * axes.step
        yield f'<path d="M{axes.left:.1f} {axes.y(value):.1f}h{_WIDTH}" stroke="{GRID}"/>'
        if numbered:
            yield svg.text(axes.left - 6, axes.y(value) + 4, f"{value:.4g}", "end")
    for k, place in enumerate(places):
        yield svg.text(axes.x(k, len(places)), axes.top + _HEIGHT + 16, place.label, "middle")


def _series(axes: _Axes, levels: Mapping[float, Level], scale: float, color: str) -> Iterator[str]:
    """The marks of a colour, by their pixels along the axis."""
    line = "L".join(f"{x:.1f} {axes.y(scale * level.quantiles[0].value):.1f}" for x, level in levels.items())
    yield f'<path d="M{line}" fill="none" stroke="{color}" stroke-opacity="0.4"/>'
    for x, level in levels.items():
        half, most = level.quantiles[:2]
        low, high = (axes.y(scale * end) if isfinite(end) else axes.y(end) for end in (half.low, half.high))
        yield f'<path d="M{x:.1f} {low:.1f}V{high:.1f}M{x - 5:.1f} {axes.y(scale * most.value):.1f}h10" stroke="{color}"/>'
        yield f'<circle cx="{x:.1f}" cy="{axes.y(scale * half.value):.1f}" r="4" fill="{color}"/>'


def _step(most: float) -> float:
    """The distance of four to ten lines from 0 to a value: 1, 2 or 5 times a power of ten."""
    if most <= 0.0:
        return 1.0
    decade = 10.0 ** floor(log10(most / 4.0))
    return max(times * decade for times in (1.0, 2.0, 5.0) if times * decade <= most / 4.0 * (1.0 + 1e-12))
