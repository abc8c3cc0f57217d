"""What a sweep's table says: quantiles, main effects, shares of variance and Sobol indices, with their confidence.

Runs with the same seed, and runs of the same sample, are not independent: they share the imperfections of the IMUs, or the
sampled values. Every interval here counts such runs as groups.
"""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binom, t

from hil.sweep.store import DONE, KEY, REASON, STATUS, as_stored
from hil.sweep.study import Factor, Study

if TYPE_CHECKING:
    import pyarrow as pa

QUANTILES = (0.5, 0.9, 0.99)
CONFIDENCE = 0.95
_TAIL = (1.0 - CONFIDENCE) / 2.0
INTERACTIONS = "interactions"
"""What explains the part of the variance that no factor explains by itself."""
_RESAMPLES = 500
"""For the confidence of Sobol indices."""
_MOST_BINS, _LEAST_IN_BIN = 8, 8

Values = NDArray[np.float64]
Groups = NDArray[np.intp]
"""The number of the group that each value belongs to (N,)."""


@dataclass(frozen=True)
class Interval:
    """A value, and the ends of the interval that holds it with `CONFIDENCE`; infinite where there are too few runs."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Quantile(Interval):
    """A quantile of a figure; `share` (0 to 1) of the runs lie below it."""

    share: float


@dataclass(frozen=True)
class Level:
    """A figure in some of the runs.

    Attributes:
        value: of the factor, as the table has it; the two ends of a part of a sampled range; None for all runs.
        runs: how many have the figure.
        mean: of the figure.
        difference: of this mean from the mean of all runs: the main effect.
        quantiles: for each of `QUANTILES`.
    """

    value: Any
    runs: int
    mean: Interval
    difference: Interval
    quantiles: tuple[Quantile, ...]


@dataclass(frozen=True)
class Sensitivity:
    """Sobol indices of a figure for a sampled factor: the share of the variance by it alone, and with its interactions.

    `at` has the values of the crossed factors, seeds apart; their figures are averaged.
    """

    at: Mapping[str, Any]
    factor: str
    first: Interval
    total: Interval


def quantile(values: ArrayLike, share: float, groups: Sequence[Groups] = ()) -> Quantile:
    """A quantile (0 to 1) of values (N,), with the interval between two of the ordered values.

    The interval needs no assumption on the distribution: the number of independent values below the quantile is binomial.
    Values in groups count as so many independent ones as give the share below the quantile the same variance (Korn and
    Graubard, Survey Methodology 24, 1998).

    Raises:
        ValueError: there is no value.
    """
    ordered = np.sort(np.asarray(values, np.float64))
    n, value = len(ordered), float(np.quantile(ordered, share))
    known = np.asarray(values, np.float64)
    # A few values beyond an extreme quantile hardly tell how alike those of a group are; the median does.
    independent = min(_independent(known <= limit, groups) for limit in (value, np.median(known)))
    low, high = binom.ppf([_TAIL, 1.0 - _TAIL], independent, share)
    padded = np.concatenate([[-inf], ordered, [inf]])
    # Each independent value stands for n / independent ordered ones: the low end is the first of those, the high end the last.
    first = int((low - 1.0) * n / independent) + 1 if low else 0
    last = min(n + 1, int(np.ceil((high + 1.0) * n / independent)))
    # The value lies between two of them, so that with few runs an end could be beyond it.
    return Quantile(value, min(value, float(padded[first])), max(value, float(padded[last])), share)


def mean(values: ArrayLike, groups: Sequence[Groups] = ()) -> Interval:
    """The mean of values (N,), with the interval by Student's t distribution over the groups."""
    known = np.asarray(values, np.float64)
    value = float(known.mean())
    return _interval(value, (known - value) / len(known), groups)


def difference(values: ArrayLike, chosen: NDArray[np.bool_], groups: Sequence[Groups] = ()) -> Interval:
    """How much the mean of the `chosen` ones of values (N,) is above the mean of all.

    What the values of a group have in common does not count: the interval is for differences within groups.
    """
    known = np.asarray(values, np.float64)
    whole, part = float(known.mean()), float(known[chosen].mean())
    influence = chosen * (known - part) / chosen.sum() - (known - whole) / len(known)
    return _interval(part - whole, influence, groups)


def _interval(value: float, influence: Values, groups: Sequence[Groups]) -> Interval:
    variance, freedom = _variance(influence, groups)
    half = float(t.ppf(1.0 - _TAIL, freedom)) * variance**0.5 if freedom else inf
    return Interval(value, value - half, value + half)


def _independent(below: NDArray[np.bool_], groups: Sequence[Groups]) -> int:
    """As how many independent values these count, of which some are below a quantile."""
    n = len(below)
    influence = (below - below.mean()) / n
    alone, _ = _variance(influence, ())
    grouped, freedom = _variance(influence, groups)
    if freedom in (0, n - 1):
        return n
    if alone == 0.0 or grouped == 0.0:
        return n if alone else freedom + 1
    few = (t.ppf(1.0 - _TAIL, n - 1) / t.ppf(1.0 - _TAIL, freedom)) ** 2
    return max(1, min(n, int(n * alone / grouped * few)))


def _variance(influence: Values, groups: Sequence[Groups]) -> tuple[float, int]:
    """The variance of a sum whose terms vary by groups, and the degrees of freedom; for two groupings as for two-way clusters.

    Without groups, or with one group alone, every term varies by itself.
    """
    numbered = [np.unique(each, return_inverse=True)[1] for each in groups]
    numbered = [each for each in numbered if each.max() > 0] or [np.arange(len(influence))]
    freedom = min(int(each.max()) for each in numbered)
    if freedom == 0:
        return 0.0, 0
    parts = [_squares(influence, each) for each in numbered]
    if len(parts) == 2:
        both = np.unique(numbered[0] * len(influence) + numbered[1], return_inverse=True)[1]
        parts.append(sum(parts) - _squares(influence, both))
    return max(parts), freedom


def _squares(influence: Values, groups: Groups) -> float:
    sums = np.bincount(groups, influence)
    return float(sums @ sums) * len(sums) / (len(sums) - 1)


class Analysis:
    """The answers of a study's table, a row for each of its points in their order."""

    def __init__(self, study: Study, table: "pa.Table") -> None:
        self.study = study
        self._columns = {name: table[name] for name in table.column_names}
        self.runs, self._complete = len(table), len(table) == study.size
        self.failed: int = self.runs - self._columns[STATUS].to_pylist().count(DONE)
        self._factors = {each.name: np.array(table[each.name].to_pylist(), object) for each in study.factors}
        self._samples = self._sample_of_each_row()
        seeds = [np.unique(self._factors[each.name], return_inverse=True)[1] for each in study.factors if each.is_seed]
        self._groups = [*seeds[:1], *([self._samples] if study.sampled else [])]

    @property
    def crossed(self) -> list[Factor]:
        """The crossed factors, without the seeds, which replicate."""
        return [each for each in self.study.crossed if not each.is_seed]

    def column(self, factor: str) -> "NDArray[np.object_]":
        """The factor's value in each row."""
        return self._factors[factor]

    def values(self, figure: str) -> Values:
        """A figure in each row; NaN where the run has failed, or has no finite number."""
        if figure not in self._columns:
            return np.full(self.runs, np.nan)
        found = np.array([np.nan if each is None else each for each in self._columns[figure].to_pylist()], np.float64)
        found[~np.isfinite(found)] = np.nan
        return found

    def names(self) -> list[str]:
        """The columns that are figures."""
        others = {KEY, STATUS, REASON, *self._factors}
        return [name for name in self._columns if name not in others]

    def over_all(self, figure: str) -> Level | None:
        """A figure over all runs; None if none has it."""
        return self.level(figure, None, np.ones(self.runs, np.bool_))

    def levels(self, figure: str, factor: Factor) -> list[Level]:
        """A figure at each value of a crossed factor, or in parts of a sampled one's range; only where runs have it."""
        found = (self.level(figure, value, chosen) for value, chosen in self.parts(factor))
        return [each for each in found if each is not None]

    def parts(self, factor: Factor) -> Iterable[tuple[Any, NDArray[np.bool_]]]:
        """The values of a crossed factor, or parts of a sampled one's range, and which rows they have."""
        column = self._factors[factor.name]
        if not factor.sampled:
            for value in map(as_stored, factor.values):
                yield value, column == value
            return
        samples = int(self._samples.max(initial=0)) + 1
        ends = [factor.at(share) for share in np.linspace(0.0, 1.0, min(_MOST_BINS, max(2, samples // _LEAST_IN_BIN)) + 1)]
        number = np.digitize(column.astype(np.float64), ends[1:-1])
        for i, (low, high) in enumerate(pairwise(ends)):
            yield (low, high), number == i

    def level(self, figure: str, value: Any, chosen: NDArray[np.bool_]) -> Level | None:
        """A figure in the chosen rows, at what is called their value; None if none of them has it."""
        values = self.values(figure)
        known = np.isfinite(values)
        chosen, groups, values = chosen[known], [each[known] for each in self._groups], values[known]
        if not chosen.any():
            return None
        own, part = values[chosen], [each[chosen] for each in groups]
        return Level(
            value,
            len(own),
            mean(own, part),
            Interval(0.0, 0.0, 0.0) if chosen.all() else difference(values, chosen, groups),
            tuple(quantile(own, share, part) for share in QUANTILES),
        )

    def shares(self, figure: str) -> dict[str, float]:
        """The share of a figure's variance that the mean at each factor's values explains, and the rest, the interactions.

        This is the sum of squares by factor over the whole one. It needs all runs. Sampled factors count together. Empty if a
        figure does not vary, or a factor alone varies.
        """
        grid, axes = self._grid(figure)
        varying = [axis for axis, size in enumerate(() if grid is None else grid.shape) if size > 1]
        if grid is None or len(varying) < 2 or grid.var() == 0.0:
            return {}
        others = (tuple(each for each in range(grid.ndim) if each != axis) for axis in varying)
        found = {axes[axis]: float(grid.mean(other).var() / grid.var()) for axis, other in zip(varying, others, strict=True)}
        return {**found, INTERACTIONS: max(0.0, 1.0 - sum(found.values()))}

    def sensitivities(self, figure: str) -> list[Sensitivity]:
        """Sobol indices of a figure, by Saltelli's design; empty if `no_sensitivities` has a reason."""
        grid, _ = self._grid(figure)
        if grid is None or self.no_sensitivities(figure):
            return []
        seeds = tuple(axis for axis, each in enumerate(self.study.crossed, start=1) if each.is_seed)
        means = grid.mean(seeds) if seeds else grid
        places = product(*(enumerate(map(as_stored, each.values)) for each in self.crossed))
        return [each for place in places for each in self._indices(means, place)]

    def _indices(self, means: Values, place: Sequence[tuple[int, Any]]) -> list[Sensitivity]:
        from SALib.analyze import sobol

        names = [each.name for each in self.study.sampled]
        at = {each.name: value for each, (_, value) in zip(self.crossed, place, strict=True)}
        figure: Values = np.moveaxis(means, 0, -1)[tuple(number for number, _ in place)]
        if np.ptp(figure) == 0.0:
            return []
        problem = {"num_vars": len(names), "names": names, "bounds": [[0.0, 1.0]] * len(names)}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # A seed of 0 would be none at all.
            found = sobol.analyze(
                problem, figure, calc_second_order=False, num_resamples=_RESAMPLES, conf_level=CONFIDENCE, seed=1
            )
        kinds = [zip(found[kind], found[f"{kind}_conf"], strict=True) for kind in ("S1", "ST")]
        return [
            Sensitivity(at, name, *(Interval(float(value), float(value - half), float(value + half)) for value, half in both))
            for name, *both in zip(names, *kinds, strict=True)
        ]

    def no_sensitivities(self, figure: str) -> str:
        """Why a figure has no Sobol indices; "" if it has them."""
        if self.study.sampling.method != "saltelli":
            return "Sobol indices need samples by saltelli"
        values = self.values(figure)
        missing = self.study.size - int(np.isfinite(values).sum())
        if missing:
            return f"Sobol indices need {figure} of all {self.study.size} runs, and {missing} lack it"
        return f"{figure} is the same in all runs" if np.ptp(values) == 0.0 else ""

    def _grid(self, figure: str) -> tuple[Values | None, list[str]]:
        """A figure (samples, values of each crossed factor ...), None if a run lacks it; and what the axes are."""
        values, crossed = self.values(figure), self.study.crossed
        sampled = [each.name for each in self.study.sampled]
        axes = [" + ".join(sampled) if len(sampled) < 3 else "all sampled factors", *(each.name for each in crossed)]
        if not self._complete or not np.isfinite(values).all():
            return None, axes
        return values.reshape(-1, *(len(each.values) for each in crossed)), axes

    def _sample_of_each_row(self) -> Groups:
        """The number of the sample of each row; the rows of one base sample of Saltelli's design count as one."""
        if not self.study.sampled:
            return np.zeros(self.runs, np.intp)
        columns = np.array([self._factors[each.name] for each in self.study.sampled], np.float64).T
        if not self._complete:
            return np.unique(columns, axis=0, return_inverse=True)[1].reshape(-1)
        cells = self.study.size // self.study.samples
        together = len(self.study.sampled) + 2 if self.study.sampling.method == "saltelli" else 1
        numbers: Groups = np.arange(self.runs) // (cells * together)
        return numbers

    def plain(self, figures: Iterable[str]) -> dict[str, Any]:
        """All answers for figures as JSON takes them; an infinite end is None."""
        factors = [each for each in self.study.factors if not each.is_seed]
        return {
            figure: {
                "all": _plain(self.over_all(figure)),
                "by_factor": {each.name: [_plain(level) for level in self.levels(figure, each)] for each in factors},
                "shares": self.shares(figure),
                "sensitivities": [_plain(each) for each in self.sensitivities(figure)],
                "no_sensitivities": self.no_sensitivities(figure),
            }
            for figure in figures
        }


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    if hasattr(value, "__dataclass_fields__"):
        return {name: _plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return dict(value) if isinstance(value, Mapping) else value
