"""The rows of disturbances against the best test on their data: how far the pose may be off before something is told."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from math import degrees, inf, radians
from pathlib import Path
from typing import Any, NamedTuple

from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.faults.rows import Row
from hil.progress import Progress, no_progress
from hil.studies.detectability.bounds import Bound, Disturbed, find_bounds
from hil.studies.detectability.signatures import NoSignatureError
from hil.studies.detectability.uncertainty import Uncertainty
from hil.table import Cell, Table
from plant.encoders import NO_LENGTHS
from plant.errors import InputError
from plant.files import read_text


class Errors(NamedTuple):
    """Errors of a pose."""

    position: float  # [m]
    rotation: float  # [rad]

    def within(self, most: "Errors") -> bool:
        """Whether neither is greater than in `most`."""
        return self.position <= most.position and self.rotation <= most.rotation

    def __str__(self) -> str:
        """In mm and deg."""
        return f"{1e3 * self.position:.2f}/{degrees(self.rotation):.2f}"


FACTOR = 1.5
"""The error before something is told may be so many times that of the best test."""

LIMITS = {True: Errors(3e-3, radians(0.7)), False: Errors(5e-3, radians(1.0))}
"""For faults of few IMUs, and for what more of them share: the error that it may never exceed where `FACTOR` times that of the
best test is below it [m], [rad].
"""


@dataclass(frozen=True)
class RowBounds:
    """A row with its bounds, one for each seed, or the reason why there are none.

    Attributes:
        row: the disturbance.
        single: whether few IMUs have it.
        bounds: of the seeds.
        reason: why there are none.
        seed: the only one, where each draws another disturbance; None otherwise.
    """

    row: Row
    single: bool
    bounds: tuple[Bound, ...] = ()
    reason: str = ""
    seed: int | None = None

    @property
    def name(self) -> str:
        """That of the row, with the seed if this is the only one."""
        return self.row.name if self.seed is None else f"{self.row.name}, seed {self.seed}"

    def greatest(self, figure: str) -> float:
        """The greatest of a figure over the seeds."""
        return max(float(getattr(bound, figure)) for bound in self.bounds)

    def errors(self, prefix: str = "") -> Errors:
        """The greatest errors over the seeds; `prefix` names those of a `Bound`: none, fault_, least_, level_ or sound_."""
        return Errors(self.greatest(f"{prefix}position"), self.greatest(f"{prefix}rotation"))

    @property
    def strict(self) -> Errors:
        """`FACTOR` times the errors of the best test."""
        return Errors(*(FACTOR * error for error in self.errors()))

    @property
    def limit(self) -> Errors:
        """The errors that are never allowed; greater where `strict` is."""
        return Errors(*map(max, self.strict, LIMITS[self.single]))

    def verdict(self, before: Errors) -> str:
        """Whether errors until something was told are within `strict` ("yes"), `limit` alone ("limit"), or neither ("no")."""
        return "yes" if before.within(self.strict) else "limit" if before.within(self.limit) else "no"

    def beyond(self, measured: Mapping[str, Any]) -> bool:
        """Whether an error in the figures of `gough faults --json` is beyond the limit."""
        return bool(self.bounds) and "no" in map(self.verdict, self.before(measured).values())

    def before(self, measured: Mapping[str, Any]) -> dict[str, Errors]:
        """By fusion, the greatest errors until something was told, in the figures of `gough faults --json`.

        Raises:
            InputError: these are other figures.
        """
        try:
            rows = [each for each in measured["disturbances"] if each["row"] == self.row.name]
            if self.seed is None:
                return {each["fusion"]: _errors_before(each) for each in rows}
            seeds = {each["fusion"]: {own["seed"]: own for own in each["seeds"]} for each in rows}
            return {fusion: _errors_before(own[self.seed]) for fusion, own in seeds.items() if self.seed in own}
        except (KeyError, TypeError, ValueError):
            raise InputError(
                "these are no figures of disturbances as this version writes them: run 'gough faults --json FILE' again"
            ) from None

    def summary(self, measured: Mapping[str, Any] | None) -> dict[str, Any]:
        """The figures in SI units, for JSON, with those of `gough faults --json` if there are any."""
        found = {"row": self.row.name, "kind": self.row.kind, "single": self.single, "reason": self.reason or None}
        if self.seed is not None:
            found["seed"] = self.seed
        if not self.bounds:
            return found
        found |= {"strict": self.strict._asdict(), "limit": self.limit._asdict(), "seeds": [vars(each) for each in self.bounds]}
        if measured:
            before = self.before(measured)
            found["measured"] = {name: {**each._asdict(), "within": self.verdict(each)} for name, each in before.items()}
        return found


def _errors_before(figures: Mapping[str, Any]) -> Errors:
    # Infinite errors have no number in JSON.
    sizes = (inf if size is None else float(size) for size in (figures["position_before"], figures["rotation_before"]))
    return Errors(*sizes)


def bounds_of_rows(
    rows: Sequence[Row],
    seeds: Sequence[int],
    uncertainty: Uncertainty | None = None,
    engine: Engine = IN_ONE_PROCESS,
    progress: Progress = no_progress,
) -> list[RowBounds]:
    """The bounds of rows as seeds draw them: of each row those of all seeds together, or one by one where each draws another
    disturbance.

    Raises:
        GoughError: a mechanism, a target or a kind of IMU cannot be used.
    """
    items = [(row, own) for row in rows for own in ([(seed,) for seed in seeds] if row.draw else [tuple(seeds)])]
    return engine.starmap(_bounds_of, [(*item, uncertainty or Uncertainty()) for item in items], progress)


def _bounds_of(row: Row, seeds: Sequence[int], uncertainty: Uncertainty) -> RowBounds:
    drawn = [row.drawn(seed, "whole") for seed in seeds]
    found = RowBounds(row, bool(drawn[0].guilty), seed=seeds[0] if row.draw else None)
    if row.base_imu or row.lengths != NO_LENGTHS:
        return replace(found, reason="the test has neither lengths nor an IMU on the base")
    try:
        bounds = find_bounds([Disturbed(each.config, each.faults, each.begin) for each in drawn], uncertainty)
    except NoSignatureError as error:
        return replace(found, reason=str(error))
    return replace(found, bounds=tuple(bounds))


def summary(found: Sequence[RowBounds], uncertainty: Uncertainty, measured: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Everything, for JSON, in SI units."""
    rows = [each.summary(measured) for each in found]
    return {"rows": rows, "uncertainty": vars(uncertainty), "version": version("gough")}


def read_figures(path: Path) -> dict[str, Any]:
    """The figures in a file of `gough faults --json`.

    Raises:
        InputError: the file cannot be read or has none.
    """
    try:
        figures = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path} is no JSON: {error}") from None
    if not isinstance(figures, dict) or not isinstance(figures.get("disturbances"), list):
        raise InputError(f"{path} has no disturbances: take what 'gough faults --json FILE' has written")
    return figures


def table(found: Sequence[RowBounds], measured: Mapping[str, Any] | None = None) -> Table:
    """The bounds of rows that have some: errors in mm and deg, the greatest over the seeds.

    With the figures of `gough faults`, the measured errors stand beside them, and the verdict for each fusion.
    """
    headings = ("disturbance", "told [s]", "at", "error", "by fault", f"{FACTOR:g} x", "limit")
    least = ("least", "its error", "level", "/ RMS")
    result = Table(*headings, *least, *(["measured", "within"] if measured else []))
    for each in found:
        if not each.bounds:
            continue
        times = [bound.told_after for bound in each.bounds]
        when = "never" if None in times else f"{max(time for time in times if time is not None):.2f}"
        errors = map(str, (each.errors(), each.errors("fault_"), each.strict, each.limit))
        cells: list[str | Cell] = [each.name, when, f"{100.0 * each.greatest('share'):.0f} %", *errors]
        cells += [f"{100.0 * each.greatest('least'):.3g} %", str(each.errors("least_"))]
        level, sound = each.errors("level_"), each.errors("sound_")
        cells += [str(level), f"{level.position / sound.position:.1f}/{level.rotation / sound.rotation:.1f}"]
        if measured:
            before = each.before(measured).values()
            verdicts = [each.verdict(errors) for errors in before]
            cells += ["; ".join(map(str, before)) or "-", Cell(" / ".join(verdicts) or "-", alarm="no" in verdicts)]
        result.add(*cells)
    return result


def left_out(found: Sequence[RowBounds]) -> list[str]:
    """The rows without bounds and the reason, a line each."""
    return [f"{each.name}: {each.reason}" for each in found if each.reason]
