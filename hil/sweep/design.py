"""A design as its TOML file or a Python program describes it: a study, and what is better and what is allowed in it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hil.sweep.case import GEOMETRY_FIGURE
from hil.sweep.study import Factor, Study, factors_of, study_of
from plant.checks import checked_seed
from plant.errors import GoughError, InputError
from plant.files import check_entries, read_toml

MINIMISE, MAXIMISE = "minimise", "maximise"
START = "start"
"""A bound that is the figure of the design as it is, where nothing varies."""
POOLS = ("rms", "mean", "max", "min")
"""How the figures of several seeds become one; a number from 0 to 1 is a quantile."""
METHODS = ("nsga2", "tpe")
_BATCHES = {"nsga2": 40, "tpe": 8}
_SEED = "run.seed"
_ROUNDING = 1e-9
"""Share of a bound by which rounding may break it."""


def pooled(values: ArrayLike, pool: str | float) -> float:
    """One figure for several seeds (N,)."""
    found = np.asarray(values, np.float64)
    if pool == "rms":
        return float(np.sqrt(np.mean(found**2)))
    if pool == "mean":
        return float(found.mean())
    return float(np.quantile(found, {"min": 0.0, "max": 1.0}[pool] if isinstance(pool, str) else pool))


@dataclass(frozen=True)
class Objective:
    """A figure that should be as small, or as large, as possible, and how it is pooled over seeds."""

    figure: str
    goal: str = MINIMISE
    pool: str | float = "mean"

    def __post_init__(self) -> None:
        if self.goal not in (MINIMISE, MAXIMISE):
            raise InputError(f"{self.figure}: the goal is {self.goal!r}; it is {MINIMISE} or {MAXIMISE}")
        _check_pool(self.figure, self.pool)

    @property
    def sign(self) -> float:
        """1 if less is better, else -1."""
        return 1.0 if self.goal == MINIMISE else -1.0


@dataclass(frozen=True)
class Constraint:
    """Bounds on a figure, numbers or "start", and how it is pooled over seeds."""

    figure: str
    least: float | str | None = None
    most: float | str | None = None
    pool: str | float = "mean"

    def __post_init__(self) -> None:
        _check_pool(self.figure, self.pool)
        bounds = [bound for bound in (self.least, self.most) if bound is not None]
        if not bounds:
            raise InputError(f'{self.figure} has no bound: give least or most, a number or "{START}"')
        for bound in bounds:
            if bound != START and (isinstance(bound, str | bool) or not np.isfinite(bound)):
                raise InputError(f'{self.figure}: a bound is {bound!r}; it is a number or "{START}"')

    def violation(self, value: float, start: float) -> float:
        """By which share of a bound a value breaks it; not positive if it is within the bounds, but for rounding."""
        worst = -np.inf
        for bound, sign in ((self.least, -1.0), (self.most, 1.0)):
            if bound is not None:
                limit = float(start if bound == START else bound)
                worst = max(worst, sign * (value - limit) / (abs(limit) or 1.0))
        return worst - _ROUNDING


@dataclass(frozen=True)
class Search:
    """How the search goes.

    Attributes:
        trials: how many designs are tried.
        seeds: each is run with the seeds 0 to this, without it.
        seed: of the search itself.
        method: nsga2, or tpe; by default tpe for one objective and nsga2 for several.
        batch: how many trials are asked for before their results are told; nsga2's population. 0: 40 for nsga2, 8 for tpe.
        group: with tpe and one objective, a trial that is worse than the best is given up after each group of so many seeds.
    """

    trials: int = 200
    seeds: int = 4
    seed: int = 0
    method: str = ""
    batch: int = 0
    group: int = 2

    def __post_init__(self) -> None:
        checked_seed(self.seed)
        if self.method and self.method not in METHODS:
            raise InputError(f"there is no method {self.method!r} of search; there are {', '.join(METHODS)}")
        for name, least, most in (("trials", 1, 1_000_000), ("seeds", 1, 10_000), ("batch", 0, 10_000), ("group", 1, 10_000)):
            value = getattr(self, name)
            if not isinstance(value, int) or not least <= value <= most:
                raise InputError(f"{name} is {value!r}; it is a whole number from {least} to {most}")
        if self.method == "nsga2" and self.batch == 1:
            raise InputError("the batch of nsga2 is its population, and one has no parents: give 2 at least")


@dataclass(frozen=True)
class Check:
    """What start and chosen design are compared on in the end: seeds that the search did not use, crossed with `factors`."""

    seeds: int = 0
    factors: tuple[Factor, ...] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.seeds, int) or not 0 <= self.seeds <= 10_000:
            raise InputError(f"the check has {self.seeds!r} seeds; there can be 0 to 10000")
        for factor in self.factors:
            if factor.sampled or not factor.name.startswith("run.") or factor.name == _SEED:
                raise InputError(f"[check] {factor.name}: give a list of values of a run's field, but not of its seed")
        if self.factors and not self.seeds:
            raise InputError("[check] has no seeds: give seeds, such as 20")


@dataclass(frozen=True)
class Design:
    """A study of which the best points are looked for.

    Attributes:
        study: what is run, and what varies within which bounds: ranges, or lists of choices.
        objectives: what is better.
        constraints: what is allowed.
        search: how it is looked for.
        check: what the chosen point is checked on.
    """

    study: Study
    objectives: tuple[Objective, ...]
    constraints: tuple[Constraint, ...] = ()
    search: Search = field(default_factory=Search)
    check: Check = field(default_factory=Check)

    def __post_init__(self) -> None:
        if not self.objectives:
            raise InputError('nothing is to be improved: give a figure in [objectives], such as cost = "minimise"')
        for group in (self.objectives, self.constraints):
            names = [each.figure for each in group]
            for name in names:
                if names.count(name) > 1:
                    raise InputError(f"{name} stands twice in the objectives or in the constraints: leave one out")
        for each in self.objectives:
            if self.pools[each.figure] != each.pool:
                raise InputError(
                    f"{each.figure} is pooled by {each.pool} as an objective and by {self.pools[each.figure]} as a constraint: "
                    "give both the same pool"
                )
        if any(factor.name == _SEED for factor in self.study.factors):
            raise InputError(f"{_SEED} is no part of a design: [search] seeds says how many there are")
        of_model = self.study.model is not None
        if of_model and any(START in (each.least, each.most) for each in self.constraints):
            raise InputError(f'a model has no start, so no bound can be "{START}": give a number')
        if of_model and self.check.seeds:
            raise InputError("a model has no seeds: leave [check] out")

    @property
    def method(self) -> str:
        """How it searches."""
        return self.search.method or ("tpe" if len(self.objectives) == 1 else "nsga2")

    @property
    def batch(self) -> int:
        """How many trials are asked for at once."""
        return self.search.batch or _BATCHES[self.method]

    @property
    def pools(self) -> dict[str, str | float]:
        """How each figure is pooled, the objectives first."""
        by_objective = {each.figure: each.pool for each in self.objectives}
        return by_objective | {each.figure: each.pool for each in self.constraints}

    @property
    def of_geometry(self) -> bool:
        """Whether a figure of the geometry alone is wanted."""
        return self.study.model is None and any(name.startswith(GEOMETRY_FIGURE) for name in self.pools)

    @property
    def of_run(self) -> bool:
        """Whether a run's figure, or a model's, is wanted."""
        return self.study.model is not None or not all(name.startswith(GEOMETRY_FIGURE) for name in self.pools)

    def points_of(self, point: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The points that are run for a trial, one for each seed."""
        if self.study.model is not None:
            return [dict(point)]
        return [{**point, _SEED: seed} for seed in range(self.search.seeds)]

    def check_points(self, point: Mapping[str, Any], values: Mapping[str, Any]) -> list[dict[str, Any]]:
        """The points of a check, one for each seed that the search did not use."""
        seeds = range(self.search.seeds, self.search.seeds + self.check.seeds)
        return [{**point, **values, _SEED: seed} for seed in seeds]


def read_design(path: Path | str) -> Design:
    """Read a design from its TOML file; names of files in it are relative to its folder.

    Raises:
        GoughError: the file is no design.
    """
    path, document = Path(path), read_toml(path)
    try:
        return _design(document, path)
    except GoughError as error:
        raise type(error)(f"{path}: {error}") from None


def _design(document: dict[str, Any], path: Path) -> Design:
    tables = {name: document.pop(name, {}) for name in ("objectives", "constraints", "search", "check")}
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"{name!r} must be a table")
    if "sampling" in document:
        raise InputError("a design is searched and not sampled: leave [sampling] out, and see [search]")
    check_entries(document.get("measure", {}), ("function",), "[measure]")
    check_entries(tables["search"], [each.name for each in fields(Search)], "[search]")
    check = dict(tables["check"])
    seeds = check.pop("seeds", 0)
    try:
        return Design(
            study_of(document, path),
            tuple(Objective(name, **table) for name, table in _figures(tables["objectives"], ("goal", "pool"), "goal")),
            tuple(Constraint(name, **table) for name, table in _figures(tables["constraints"], ("least", "most", "pool"))),
            Search(**tables["search"]),
            Check(seeds, factors_of(check, path)),
        )
    except TypeError as error:
        raise InputError(f"a value has the wrong kind: {error}") from None


def _figures(
    table: Mapping[str, Any], entries: tuple[str, ...], short: str = "", prefix: str = ""
) -> list[tuple[str, dict[str, Any]]]:
    """The figures of a table, with what it says of each; a text stands for the entry `short`."""
    found = []
    for name, value in table.items():
        full = prefix + name
        if isinstance(value, dict) and value and value.keys() <= {*entries}:
            found.append((full, dict(value)))
        elif isinstance(value, dict) and value and not value.keys() & {*entries}:
            found += _figures(value, entries, short, f"{full}.")
        elif short and isinstance(value, str):
            found.append((full, {short: value}))
        else:
            raise InputError(f"{full} = {value!r} is not understood: give a table with {', '.join(entries)}")
    return found


def _check_pool(figure: str, pool: Any) -> None:
    if isinstance(pool, str) and pool in POOLS:
        return
    if not isinstance(pool, int | float) or isinstance(pool, bool) or not 0.0 <= pool <= 1.0:
        raise InputError(f"{figure}: pool is {pool!r}; it is {', '.join(POOLS)}, or a quantile from 0 to 1")
