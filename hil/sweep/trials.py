"""The trials of a design: what is run for each, on an engine, and what they are worth."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from hil.engine.engine import Engine
from hil.sweep.case import GEOMETRY_FIGURE, Case, case_of, measure
from hil.sweep.design import Design, pooled
from hil.sweep.store import DONE, KEY, REASON, STATUS, Store, settled
from hil.sweep.sweep import check_figures, figures_in, run_cases
from plant.errors import GoughError, InputError


@dataclass
class Outcome:
    """What is known of a point: the values of each wanted figure, one for each run; and why it cannot be run, if so."""

    point: Mapping[str, Any]
    values: dict[str, list[float]] = field(default_factory=dict)
    reason: str = ""
    left: bool = True  # whether the rest of its runs is wanted

    def figures(self, design: Design) -> dict[str, float]:
        """The figures that are known, pooled over the runs."""
        return {name: pooled(self.values[name], pool) for name, pool in design.pools.items() if name in self.values}


class TrialRunner:
    """Runs what is not in a store yet, and keeps count."""

    def __init__(self, design: Design, engine: Engine, store: Store, ran: Callable[[], None]) -> None:
        self.design, self.ran = design, 0
        self._engine, self._store, self._told = engine, store, ran
        self._rows = {row[KEY]: row for row in settled(store.table()).to_pylist()}
        self._began = time.monotonic()

    @property
    def rate(self) -> float:
        """Runs in a second."""
        return self.ran / max(time.monotonic() - self._began, 1e-9)

    def start(self) -> dict[str, float]:
        """The figures of the design as it is, where nothing varies; none of a model.

        Raises:
            GoughError: it cannot be run, or lacks a figure that is wanted.
        """
        if self.design.study.model is not None:
            return {}
        outcome = Outcome({})
        self.measure_geometry([outcome])
        self.measure_runs([outcome], self.design.points_of)
        if outcome.reason:
            raise InputError(f"the design as it is cannot be run: {outcome.reason}")
        return outcome.figures(self.design)

    def measure_geometry(self, outcomes: Sequence[Outcome]) -> None:
        """Add the figures of the geometry alone, if any is wanted."""
        if self.design.of_geometry:
            self._measure([(outcome, [outcome.point]) for outcome in outcomes], False)

    def measure_runs(
        self, outcomes: Sequence[Outcome], points_of: Callable[[Mapping[str, Any]], Sequence[Mapping[str, Any]]]
    ) -> None:
        """Add the figures of runs, if any is wanted, at the points that belong to each outcome's point."""
        if self.design.of_run:
            self._measure([(outcome, points_of(outcome.point)) for outcome in outcomes if outcome.left], True)

    def _measure(self, work: Sequence[tuple[Outcome, Sequence[Mapping[str, Any]]]], run: bool) -> None:
        """Add the figures of runs, or of the geometry alone, at some points for each outcome.

        Raises:
            GoughError: there is no such figure, or the engine's workers have gone.
        """
        cases: list[tuple[Outcome, Case]] = []
        for outcome, points in work:
            try:
                cases += [(outcome, case_of(self.design.study, point, run, not run)) for point in points]
            except GoughError as error:
                outcome.reason, outcome.left = str(error), False
        new = {case.key: case for outcome, case in cases if outcome.left and case.key not in self._rows}
        for row in run_cases(list(new.values()), self._engine, self._store, measure):
            self._rows[row[KEY]] = row
            self.ran += 1
            self._told()
        model = self.design.study.model is not None
        wanted = [name for name in self.design.pools if model or name.startswith(GEOMETRY_FIGURE) != run]
        for outcome, case in cases:
            if outcome.left:
                self._take(outcome, self._rows[case.key], wanted)

    def _take(self, outcome: Outcome, row: Mapping[str, Any], wanted: Sequence[str]) -> None:
        if row[STATUS] != DONE:
            outcome.reason, outcome.left = str(row[REASON]), False
            return
        check_figures(wanted, figures_in(row, self.design.study))
        for name in wanted:
            value = float(row[name])
            if not np.isfinite(value):
                outcome.reason, outcome.left = f"{name} is {value}", False
                return
            outcome.values.setdefault(name, []).append(value)


def violations(design: Design, outcome: Outcome, start: Mapping[str, float]) -> dict[str, float]:
    """By how much an outcome breaks each constraint, as a share of the bound; what was not measured counts as 1.

    The last, "run", is 1 if it cannot be run.
    """
    figures = outcome.figures(design)
    found = {
        each.figure: each.violation(figures[each.figure], start.get(each.figure, np.nan)) if each.figure in figures else 1.0
        for each in design.constraints
    }
    return found | {"run": float(bool(outcome.reason))}


def breaks_geometry(design: Design, outcome: Outcome, start: Mapping[str, float]) -> bool:
    """Whether the geometry alone breaks a constraint, so that no run is needed."""
    found = violations(design, outcome, start)
    return any(found[each.figure] > 0.0 for each in design.constraints if each.figure in outcome.values)


@dataclass(frozen=True)
class Comparison:
    """A figure of start and chosen design on runs that the search did not use.

    Attributes:
        values: of the factors of the check.
        start, chosen: the figure, pooled over the seeds.
        better: the number of seeds at which the chosen design is better; None for a figure that is no objective.
        seeds: their number.
    """

    figure: str
    values: Mapping[str, Any]
    start: float
    chosen: float
    better: int | None
    seeds: int


def compare(runner: TrialRunner, point: Mapping[str, Any]) -> list[Comparison]:
    """Compare a point with the design as it is, on the runs of the design's check.

    Raises:
        GoughError: one of the two cannot be run.
    """
    design, found = runner.design, []
    signs = {each.figure: each.sign for each in design.objectives}
    cells: list[dict[str, Any]] = [{}]
    for factor in design.check.factors:
        cells = [{**cell, factor.name: value} for cell in cells for value in factor.values]
    for cell in cells:
        pair = Outcome({}), Outcome(point)
        runner.measure_runs(pair, partial(design.check_points, values=cell))
        for outcome in pair:
            if outcome.reason:
                raise InputError(f"the check cannot be run: {outcome.reason}")
        for name, pool in design.pools.items():
            if name not in pair[0].values:
                continue
            start, chosen = (np.array(outcome.values[name]) for outcome in pair)
            better = int(np.sum(signs[name] * (chosen - start) < 0.0)) if name in signs else None
            found.append(Comparison(name, cell, pooled(start, pool), pooled(chosen, pool), better, len(start)))
    return found
