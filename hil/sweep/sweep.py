"""A sweep: all points of a study, run on an engine, into a table."""

import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
import pyarrow as pa

from hil.engine.batches import Failure, attempt, fingerprint
from hil.engine.engine import Engine
from hil.sweep.analysis import Analysis
from hil.sweep.case import Case, cases_of, measure, own_figures
from hil.sweep.names import is_factor
from hil.sweep.store import DIED, DONE, ERROR, FAILED, KEY, REASON, STATUS, Store, as_stored, rows_of, settled
from hil.sweep.study import Study
from plant.checks import nearest
from plant.errors import GoughError, InputError

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

Report = Callable[[float, str], None]
"""Called with the share that is done, and what is going on in words."""


class Keyed(Protocol):
    """A run whose row is kept: what its figures depend on, in a hash, the `kind` for the engine, and its row's other values."""

    @property
    def key(self) -> str: ...  # noqa: D102
    @property
    def kind(self) -> str: ...  # noqa: D102
    @property
    def point(self) -> Mapping[str, Any]: ...  # noqa: D102


Run = TypeVar("Run", bound=Keyed)

_FLUSH_S = 0.1
"""The least time between files of new rows [s], on average: rows that come more slowly are written as they come."""


@dataclass(frozen=True, eq=False)
class SweepResult:
    """The table of a study, a row for each point in the study's order.

    Its columns: `key`, `status` (done, failed, error or died), `reason`, the factors, and the figures.
    """

    study: Study
    folder: Path
    table: pa.Table
    ran: int  # rows that were not there before

    @cached_property
    def analysis(self) -> Analysis:
        """What the table says."""
        return Analysis(self.study, self.table)

    @property
    def failed(self) -> int:
        """The number of points without figures."""
        return self.analysis.failed

    @property
    def first_reason(self) -> str:
        """Why the first run that failed has failed; "" if none has."""
        return next((reason for reason in self.table[REASON].to_pylist() if reason), "") if self.failed else ""

    def summary(self) -> dict[str, Any]:
        """What the table says of the shown figures, in SI units, and how many runs there are."""
        return {
            "study": self.study.name,
            "factors": [factor.name for factor in self.study.factors],
            "runs": len(self.table),
            "new": self.ran,
            "failed": self.failed,
            "figures": self.analysis.plain(self.figures()),
            "sources": fingerprint(),
            "version": version("gough"),
        }

    def figures(self) -> list[str]:
        """The figures that are shown: those that the study names, else those of the user's own function."""
        return list(self.study.figures) or own_figures(self.analysis.names())

    def frame(self) -> "pd.DataFrame":
        """The table for pandas, with a row for each point; a figure that a run lacks is NaN."""
        frame: pd.DataFrame = self.table.to_pandas()
        return frame

    def dataset(self) -> "xr.Dataset":
        """The figures for xarray, over the crossed factors, and over the samples if there are any.

        The values of the sampled factors are coordinates of the dimension `sample`.

        Raises:
            InputError: points are missing, as some were the same run.
        """
        if len(self.table) != self.study.size:
            raise InputError(
                f"the study has {self.study.size} points, and {len(self.table)} different runs: use the frame, or leave out "
                "values that mean the same"
            )
        sampled, frame = [each.name for each in self.study.sampled], self.frame().drop(columns=[KEY])
        dimensions = [each.name for each in self.study.crossed]
        if sampled:
            frame["sample"] = np.arange(len(frame)) // (len(frame) // self.study.samples)
            dimensions.insert(0, "sample")
        dataset: xr.Dataset = frame.drop(columns=sampled).set_index(dimensions).to_xarray()
        dataset = dataset.sel({each.name: list(map(as_stored, each.values)) for each in self.study.crossed})
        first = frame.groupby("sample")[sampled].first() if sampled else {}
        return dataset.assign_coords({name: ("sample", first[name].to_numpy()) for name in sampled})


@dataclass(frozen=True)
class Estimate:
    """What a sweep would take: points, those of them that are in the table already, and the time of a run [s]."""

    points: int
    known: int
    seconds: float

    def total(self, workers: int) -> float:
        """The time of the sweep [s]."""
        return (self.points - self.known) * self.seconds / workers


def no_report(share: float, label: str) -> None:
    """Report nothing."""


def run_study(study: Study, folder: Path, engine: Engine, progress: Report = no_report) -> SweepResult:
    """Run all points of a study that are not in the table of a folder yet.

    Args:
        study: what to run.
        folder: where the table is, or will be.
        engine: where to run it.
        progress: called with the share that is done, and what is going on in words.

    Raises:
        GoughError: the study, or the folder, cannot be used; or the engine's workers have gone.
    """
    cases = _unique(study, progress)
    with Store.opened(folder) as store:
        checked, ran = False, 0
        for row in run_missing(cases, measure, engine, store, progress):
            ran += 1
            if not checked and row[STATUS] == DONE:
                check_figures(study.figures, figures_in(row, study))
                checked = True
        table = _table(study, cases, store)
    result = SweepResult(study, folder, table, ran)
    if result.failed < len(table):
        check_figures(study.figures, result.analysis.names())
    return result


def run_missing(
    runs: Sequence[Run], work: Callable[[Run], Mapping[str, Any]], engine: Engine, store: Store, progress: Report = no_report
) -> Iterator[dict[str, Any]]:
    """Run what is not in a store yet, or died there, as `run_cases` does, and report the progress.

    Raises:
        GoughError: as for `run_cases`.
    """
    known = {*settled(store.table())[KEY].to_pylist()}
    left = [run for run in runs if run.key not in known]
    began = time.monotonic()
    for done, row in enumerate(run_cases(left, engine, store, work), start=1):
        yield row
        there = len(runs) - len(left) + done
        rate = done / (time.monotonic() - began)
        progress(there / len(runs), f"{there} of {len(runs)} runs, {rate:.3g} a second")


def run_cases(
    cases: Sequence[Run], engine: Engine, store: Store, work: Callable[[Run], Mapping[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Run cases and yield their rows as they come; the rows go to the store soon after they came.

    Args:
        cases: each with a key of its own.
        engine: where to run them.
        store: where their rows are kept.
        work: gives the figures of a case.

    Raises:
        GoughError: the engine's workers have gone, or the store cannot be written.
    """
    store.as_table([case.point for case in cases])
    rows: list[dict[str, Any]] = []
    began, files = time.monotonic(), 0
    try:
        for number, outcome in engine.run(work, cases, _kind_of):
            row = _row(cases[number], outcome)
            rows.append(row)
            if time.monotonic() - began > files * _FLUSH_S:
                store.add(rows)
                rows, files = [], files + 1
            yield row
    finally:
        store.add(rows)


def estimate(study: Study, folder: Path) -> Estimate:
    """Measure the first point of a study, after machine code and FMU are there.

    Raises:
        GoughError: the study cannot be used, or its first run fails.
    """
    cases = _unique(study)
    known = {*settled(Store(folder).table())[KEY].to_pylist()} & {case.key for case in cases}
    first = attempt(measure, cases[0])
    if isinstance(first, Failure):
        reason, *_ = first.reason.partition("\n")
        raise GoughError(f"the first run fails: {reason}")
    check_figures(study.figures, first)
    began = time.perf_counter()
    measure(cases[0])
    return Estimate(len(cases), len(known), time.perf_counter() - began)


def figures_in(row: Mapping[str, Any], study: Study) -> list[str]:
    """The names of the figures that a row has."""
    return [name for name, value in row.items() if value is not None and _is_figure(name, study)]


def _is_figure(name: str, study: Study) -> bool:
    """Whether a column is a figure; of the factors of runs, a table has also those that this study does not vary."""
    others = (KEY, STATUS, REASON, *(factor.name for factor in study.factors))
    return name not in others and not (study.model is None and is_factor(name))


def check_figures(wanted: Iterable[str], names: Collection[str]) -> None:
    """Check that a run, which has figures of these names, has those that are wanted.

    Raises:
        InputError: it lacks one.
    """
    for name in wanted:
        if name not in names:
            raise InputError(f"no run has the figure {name!r}{nearest(name, names)}; there are {', '.join(names)}")


def _unique(study: Study, progress: Report = no_report) -> list[Case]:
    """The cases of a study, without those that are the same run."""
    cases: dict[str, Case] = {}
    for number, case in enumerate(cases_of(study), start=1):
        cases[case.key] = case
        progress(0.0, f"preparing {number} of {study.size} runs")
    return list(cases.values())


def _table(study: Study, cases: Sequence[Case], store: Store) -> pa.Table:
    """The rows of cases, with the factors of this study alone: the same runs may be there from one with others."""
    rows = rows_of(store.table(), [case.key for case in cases])
    points = store.as_table([case.point for case in cases])
    figures = [name for name in rows.column_names if _is_figure(name, study) and rows[name].null_count < len(rows)]
    columns = {name: rows[name] for name in (KEY, STATUS, REASON)}
    columns |= {factor.name: points[factor.name] for factor in study.factors}
    return pa.table(columns | {name: rows[name] for name in figures})


def _kind_of(case: Keyed) -> str:
    return case.kind


def _row(case: Keyed, outcome: Mapping[str, Any] | Failure) -> dict[str, Any]:
    if isinstance(outcome, Failure):
        status = DIED if outcome.died else ERROR if outcome.again else FAILED
        return {KEY: case.key, STATUS: status, REASON: outcome.reason, **case.point}
    row = {KEY: case.key, STATUS: DONE, REASON: None, **case.point}
    of_runs = isinstance(case, Case) and case.model is None
    for name in outcome:
        if name in row or (of_runs and is_factor(name)):
            reason = f"the figure {name!r} has the name of a factor, or of a column of the table: give it another one"
            return {**row, STATUS: FAILED, REASON: reason}
    return {**row, **outcome}
