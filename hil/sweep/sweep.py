"""A sweep: all points of a study, run on an engine, into a table."""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hil.engine.batches import Failure, fingerprint
from hil.engine.engine import Engine
from hil.sweep.analysis import QUANTILES, Quantile, quantile
from hil.sweep.case import Case, cases_of, kind_of, measure
from hil.sweep.store import DIED, DONE, FAILED, KEY, REASON, STATUS, Store, rows_of
from hil.sweep.study import Study

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

_FLUSH_S = 0.1
"""The least time between files of new rows [s]; a batch of two seconds is written as it comes."""


@dataclass(frozen=True, eq=False)
class SweepResult:
    """The table of a study, a row for each point in the study's order.

    Its columns: `key`, `status` (done, failed or died), `reason`, the factors, and the figures.
    """

    study: Study
    folder: Path
    table: pa.Table
    ran: int  # rows that were not there before

    @property
    def failed(self) -> int:
        """The number of points without figures."""
        return sum(status != DONE for status in self.table[STATUS].to_pylist())

    @property
    def first_reason(self) -> str:
        """Why the first run that failed has failed; "" if none has."""
        return next((reason for reason in self.table[REASON].to_pylist() if reason), "") if self.failed else ""

    def summary(self) -> dict[str, Any]:
        """The quantiles of the shown figures, and how many runs there are."""
        return {
            "study": self.study.name,
            "factors": [factor.name for factor in self.study.factors],
            "runs": len(self.table),
            "new": self.ran,
            "failed": self.failed,
            "quantiles": {name: [asdict(each) for each in quantiles] for name, quantiles in self.quantiles().items()},
            "sources": fingerprint(),
            "version": version("gough"),
        }

    def figures(self) -> list[str]:
        """The figures that the study shows; all of them for functions of the user's own."""
        others = (KEY, STATUS, REASON, *(factor.name for factor in self.study.factors))
        return list(self.study.figures) or [name for name in self.table.column_names if name not in others]

    def quantiles(self) -> dict[str, list[Quantile]]:
        """The quantiles of each shown figure over all runs that have it."""
        found = {}
        for name in self.figures():
            values = np.array([each for each in self.table[name].to_pylist() if each is not None])
            found[name] = [quantile(values, share) for share in QUANTILES] if len(values) else []
        return found

    def frame(self) -> "pd.DataFrame":
        """The table for pandas."""
        frame: pd.DataFrame = self.table.to_pandas()
        return frame

    def dataset(self) -> "xr.Dataset":
        """The figures for xarray, over the factors if all are crossed, else over the point's number."""
        frame = self.frame().drop(columns=[KEY])
        names = [factor.name for factor in self.study.factors]
        crossed = all(not factor.sampled for factor in self.study.factors)
        cube: xr.Dataset = (frame.set_index(names) if crossed else frame.rename_axis("point")).to_xarray()
        return cube


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


def sweep(study: Study, folder: Path, engine: Engine, progress: Callable[[float, str], None] = no_report) -> SweepResult:
    """Run all points of a study that are not in the table of a folder yet.

    Args:
        study: what to run.
        folder: where the table is, or will be.
        engine: where to run it.
        progress: called with the share that is done, and what is going on in words.

    Raises:
        GoughError: the study, or the folder, cannot be used; or the engine's workers have gone.
    """
    cases = _unique(study)
    with Store.opened(folder) as store:
        known = store.table()
        settled = {
            key for key, status in zip(*(known[name].to_pylist() for name in (KEY, STATUS)), strict=True) if status != DIED
        }
        left = [case for case in cases if case.key not in settled]
        rows: list[dict[str, Any]] = []
        began = flushed = time.monotonic()
        try:
            for done, (number, outcome) in enumerate(engine.run(measure, left, kind_of), start=1):
                rows.append(_row(left[number], outcome))
                now = time.monotonic()
                if now - flushed > _FLUSH_S:
                    store.add(rows)
                    rows, flushed = [], now
                share = (len(cases) - len(left) + done) / len(cases)
                progress(share, f"{round(share * len(cases))} of {len(cases)} runs, {done / (now - began):.3g} a second")
        finally:
            store.add(rows)
        table = rows_of(store.table(), [case.key for case in cases])
    return SweepResult(study, folder, table, len(left))


def estimate(study: Study, folder: Path) -> Estimate:
    """Measure the first point of a study, after machine code and FMU are there.

    Raises:
        GoughError: the study, or its first point, cannot be used.
    """
    cases = _unique(study)
    known = {*Store(folder).table()[KEY].to_pylist()} & {case.key for case in cases}
    measure(cases[0])
    began = time.perf_counter()
    measure(cases[0])
    return Estimate(len(cases), len(known), time.perf_counter() - began)


def _unique(study: Study) -> list[Case]:
    """The cases of a study, without those that are the same run."""
    return list({case.key: case for case in cases_of(study)}.values())


def _row(case: Case, outcome: dict[str, float] | Failure) -> dict[str, Any]:
    if isinstance(outcome, Failure):
        return {KEY: case.key, STATUS: DIED if outcome.died else FAILED, REASON: outcome.reason, **case.point}
    return {KEY: case.key, STATUS: DONE, REASON: None, **case.point, **outcome}
