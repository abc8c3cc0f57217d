"""Durations of cycles, gathered while they run, and the budget that they are held against."""

import tomllib
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from hil.loop.records import COMPUTED, STAGES, TO_COMMAND
from plant.compiled import Record

QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999}
_PER_OCTAVE = 64
_OCTAVES = 36
"""A histogram reaches from 1 ns to a minute, in steps of 1.1 %."""


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


class Timing:
    """Histograms of the wake-up, of every stage, of the cycle's computing, of the time from wake-up to command, and of the
    round trip to a rig on a bus.
    """

    def __init__(self) -> None:
        self.histograms = {name: Histogram() for name in ("wake", *STAGES, "compute", "latency", "round trip")}

    def add(self, records: Record) -> None:
        """Count the cycles of records (n,)."""
        stage_ns = records["stage_ns"]
        self.histograms["wake"].add(records["late_ns"])
        for i, name in enumerate(STAGES):
            self.histograms[name].add(stage_ns[:, i])
        self.histograms["compute"].add(stage_ns[:, COMPUTED].sum(axis=1))
        self.histograms["latency"].add(stage_ns[:, TO_COMMAND].sum(axis=1))
        self.histograms["round trip"].add(records["round_trip_ns"][records["round_trip_ns"] > 0])

    def figures(self) -> dict[str, dict[str, float]]:
        """The figures of each histogram [us]."""
        counted = {name: each for name, each in self.histograms.items() if name != "round trip" or each.longest}
        return {name: histogram.figures() for name, histogram in counted.items()}


@cache
def budget() -> dict[str, dict[str, float]]:
    """The timing budget of `hil/loop/budget.toml`: by stage, p50, p99, p999 and max [us]."""
    table: dict[str, dict[str, float]] = tomllib.loads((files("hil.loop") / "budget.toml").read_text())
    return table


def over_budget(figures: dict[str, dict[str, float]]) -> list[str]:
    """What exceeds the budget, in words; a round trip on a bus has none, and is part of `sense` and `latency`."""
    on_bus = ("sense", "latency") if "round trip" in figures else ()
    return [
        f"{stage} {name} {figures[stage][name]:.1f} us, budget {limit:g} us"
        for stage, limits in budget().items()
        for name, limit in limits.items()
        if stage not in on_bus and figures[stage]["n"] and figures[stage][name] > limit
    ]
