"""What `gough faults` runs: every case of the reactions and every row of the disturbances, with every seed, into a table.

The table is that of a sweep: a row for each run, by a hash of all that determines it. An end in the middle loses nothing.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from hil.engine.batches import fingerprint
from hil.engine.engine import IN_ONE_PROCESS, Engine, WorkFailedError
from hil.faults.links import run
from hil.faults.reactions import Case, Outcome, try_case
from hil.faults.rows import Row
from hil.faults.verdict import judge
from hil.runs.names import digest_of
from plant.encoders import NO_LENGTHS

FUSIONS = ("compiled", "whole")
"""The ways to fuse the IMUs with which every disturbance is tried."""

Figures = Mapping[str, Any]
"""Numbers and texts of a run by name."""

Report = Callable[..., None]
"""Called with the share that is done, and with or without what is going on in words."""


@dataclass(frozen=True)
class Trial:
    """One run: a case or a row, with a seed; a case without encoders has the default fusion."""

    what: Case | Row
    seed: int
    fusion: str

    @cached_property
    def key(self) -> str:
        """A hash of all that determines the figures."""
        # What a case is stands in the sources.
        content = asdict(self.what) if isinstance(self.what, Row) else {"lengths": self.what.lengths}
        return digest_of(json.dumps({**content, **self.point, "sources": fingerprint()}, sort_keys=True).encode())

    @property
    def kind(self) -> str:
        """Trials of a kind need the same machine code and FMU."""
        return f"{self.what.link if isinstance(self.what, Row) else 'udp'} {self.fusion}"

    @property
    def point(self) -> dict[str, Any]:
        """What the row of the table begins with."""
        return {"kind": self.what.kind, "row": self.what.name, "fusion": self.fusion, "seed": self.seed}


def trials_of(items: Iterable[Case | Row], seeds: Sequence[int], fusions: Sequence[str] = FUSIONS) -> list[Trial]:
    """The trials of cases and rows with each seed."""
    return [
        Trial(item, seed, fusion)
        for item in items
        for fusion in (fusions if isinstance(item, Row) or item.lengths != NO_LENGTHS else FUSIONS[:1])
        for seed in seeds
    ]


def figures_of(trial: Trial) -> dict[str, Any]:
    """The figures of a trial: those of `Outcome.row`, or those of `verdict.judge` and `what` was drawn.

    Raises:
        GoughError: it cannot be run.
    """
    if isinstance(trial.what, Case):
        return try_case(trial.what, trial.seed, trial.fusion).row()
    drawn = trial.what.drawn(trial.seed, trial.fusion)
    records, begin, cause = run(drawn)
    return {"what": drawn.what, **judge(records, begin, drawn.guilty, cause, drawn.config.rate)}


def run_trials(
    trials: Sequence[Trial], engine: Engine = IN_ONE_PROCESS, progress: Report = lambda *_: None, folder: Path | None = None
) -> list[dict[str, Any]]:
    """The figures of trials, in their order, each with its `Trial.point`.

    Args:
        trials: what to run.
        engine: where to run them.
        progress: called with the share that is done, and what is going on in words.
        folder: of a table that keeps them; what is there already is not run again. None to keep nothing.

    Raises:
        GoughError: a trial has failed, the folder cannot be used, or the engine's workers have gone.
    """
    if folder is None:
        found = engine.map(figures_of, trials, progress)
        return [trial.point | figures for trial, figures in zip(trials, found, strict=True)]
    # A table needs a package that others do not.
    from hil.sweep.store import DONE, REASON, STATUS, Store, rows_of
    from hil.sweep.sweep import run_missing

    with Store.opened(folder) as store:
        for _ in run_missing(trials, figures_of, engine, store, progress):
            pass
        rows: list[dict[str, Any]] = rows_of(store.table(), [trial.key for trial in trials]).to_pylist()
    failed = [row for row in rows if row[STATUS] != DONE]
    if failed:
        first = failed[0]
        what = f"{first['row']!r}, fusion {first['fusion']}, seed {first['seed']}: {first[REASON]}"
        raise WorkFailedError(f"{len(failed)} of {len(rows)} runs failed; the first one, {what}", None)
    return rows


def outcomes_of(cases: Iterable[Case], rows: Iterable[Figures]) -> list[Outcome]:
    """The outcomes of cases with each fusion over all seeds, from the figures of their trials."""
    by_name = {case.name: case for case in cases}
    outcomes: dict[tuple[str, str], Outcome] = {}
    for row in rows:
        if row["kind"] == Case.kind:
            key = row["row"], row["fusion"]
            outcomes[key] = outcomes.get(key, Outcome(by_name[key[0]], fusion=key[1])).with_row(row)
    return list(outcomes.values())
