"""The time that cycles take, by stage, and the timing budget."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any

from hil.loop.records import COMPUTED, STAGES, TO_COMMAND
from hil.realtime.durations import Histogram
from plant.compiled import Record


class Timing:
    """Histograms of the lateness of the wake-up, of every stage, of the cycle's computing, of the time from wake-up to command,
    and of the round trip to a rig on a bus.
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
def budget(fusion: str = "") -> dict[str, dict[str, float]]:
    """The timing budget of `hil/loop/budget.toml` with this fusion: by stage, p50, p99, p999 and max [us]."""
    table: dict[str, Any] = tomllib.loads((files("hil.loop") / "budget.toml").read_text())
    of_fusion: dict[str, dict[str, float]] = table.pop("fusion").get(fusion, {})
    return table | of_fusion


def exceeded(figures: dict[str, dict[str, float]], fusion: str = "") -> dict[str, list[str]]:
    """The figures that exceed the budget: their names by stage. A bus has none: its round trip is part of `sense` and
    `latency`.
    """
    on_bus = ("sense", "latency") if "round trip" in figures else ()
    found = {}
    for stage, limits in budget(fusion).items():
        measured = figures.get(stage, {"n": 0})
        names = [name for name, limit in limits.items() if measured["n"] and measured[name] > limit]
        if names and stage not in on_bus:
            found[stage] = names
    return found


def over_budget(figures: dict[str, dict[str, float]], fusion: str = "") -> list[str]:
    """The figures that exceed the budget, in words."""
    return [
        f"{stage} {name} {figures[stage][name]:.1f} us, budget {budget(fusion)[stage][name]:g} us"
        for stage, names in exceeded(figures, fusion).items()
        for name in names
    ]
