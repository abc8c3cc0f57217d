"""Durations and their percentiles: of all values at once, or counted in a histogram while they come."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
FIGURES = (*QUANTILES, "max", "n")
_PER_OCTAVE = 64
_OCTAVES = 36
"""A histogram reaches from 1 ns to a minute, in steps of 1.1 %."""


def percentiles(nanoseconds: NDArray[Any], names: tuple[str, ...] = FIGURES) -> dict[str, float]:
    """The figures `names` of durations (n,) [ns]: `p50`, `p99`, `p999` and `max` [us], and their number `n`."""
    us = nanoseconds / 1e3
    figures = dict(zip(QUANTILES, np.quantile(us, [*QUANTILES.values()]).tolist(), strict=True))
    figures |= {"max": float(us.max()), "n": len(us)}
    return {name: figures[name] for name in names}


@dataclass(eq=False)
class Histogram:
    """Counts of durations [ns] on a logarithmic scale, and the longest."""

    counts: NDArray[np.int64] = field(default_factory=lambda: np.zeros(_PER_OCTAVE * _OCTAVES, np.int64))
    longest: int = 0

    def add(self, nanoseconds: NDArray[np.int64]) -> None:
        """Count durations (n,)."""
        if len(nanoseconds):
            bins = (_PER_OCTAVE * np.log2(np.maximum(nanoseconds, 1))).astype(np.int64)
            self.counts += np.bincount(np.minimum(bins, len(self.counts) - 1), minlength=len(self.counts))
            self.longest = max(self.longest, int(nanoseconds.max()))

    def figures(self) -> dict[str, float]:
        """`p50`, `p99`, `p999` and `max` [us], and their number `n`."""
        n = int(self.counts.sum())
        reached = np.searchsorted(np.cumsum(self.counts), [share * n for share in QUANTILES.values()])
        middles = 2.0 ** ((reached + 0.5) / _PER_OCTAVE) / 1e3
        figures = {name: float(min(us, self.longest / 1e3)) for name, us in zip(QUANTILES, middles, strict=True)}
        return {**figures, "max": self.longest / 1e3, "n": n}

    def bars(self) -> list[list[float]]:
        """Lower ends of the bins that are not empty [us], sixteen to the octave, and their counts."""
        coarse = self.counts.reshape(-1, _PER_OCTAVE // 16).sum(axis=1)
        used = np.flatnonzero(coarse)
        return [(2.0 ** (used / 16.0) / 1e3).tolist(), coarse[used].tolist()]
