"""The rows of disturbances against the best test on their data: how far the pose may be off before something is told."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
    """A row with its bounds, one for each seed, or the reason why there are none."""

    row: Row
    single: bool
    bounds: tuple[Bound, ...] = ()
    reason: str = ""

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
        return bool(self.bounds) and "no" in map(self.verdict, errors_before(self.row, measured).values())

    def summary(self, measured: Mapping[str, Any] | None) -> dict[str, Any]:
        """The figures in SI units, for JSON, with those of `gough faults --json` if there are any."""
        found = {"row": self.row.name, "kind": self.row.kind, "single": self.single, "reason": self.reason or None}
        if not self.bounds:
            return found
        found |= {"strict": self.strict._asdict(), "limit": self.limit._asdict(), "seeds": [vars(each) for each in self.bounds]}
        if measured:
            before = errors_before(self.row, measured)
            found["measured"] = {name: {**each._asdict(), "within": self.verdict(each)} for name, each in before.items()}
        return found


def bounds_of_rows(
    rows: Sequence[Row],
    seeds: int,
    uncertainty: Uncertainty | None = None,
    engine: Engine = IN_ONE_PROCESS,
    progress: Progress = no_progress,
) -> list[RowBounds]:
    """The bounds of rows, each as so many seeds draw it.

    Raises:
        GoughError: a mechanism, a target or a kind of IMU cannot be used.
    """
    return engine.starmap(_bounds_of, [(row, seeds, uncertainty or Uncertainty()) for row in rows], progress)


def _bounds_of(row: Row, seeds: int, uncertainty: Uncertainty) -> RowBounds:
    drawn = [row.drawn(seed, "whole") for seed in range(seeds)]
    if row.base_imu or row.lengths != NO_LENGTHS:
        return RowBounds(row, bool(drawn[0].guilty), reason="the test has neither lengths nor an IMU on the base")
    if row.draw:
        return RowBounds(row, bool(drawn[0].guilty), reason="every seed draws another disturbance")
    try:
        bounds = find_bounds([Disturbed(each.config, each.faults, each.begin) for each in drawn], uncertainty)
    except NoSignatureError as error:
        return RowBounds(row, bool(drawn[0].guilty), reason=str(error))
    return RowBounds(row, bool(drawn[0].guilty), tuple(bounds))


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


def errors_before(row: Row, measured: Mapping[str, Any]) -> dict[str, Errors]:
    """By fusion, the greatest errors of a row until something was told, in the figures of `gough faults --json`.

    Raises:
        InputError: these are other figures.
    """
    try:
        rows = [each for each in measured["disturbances"] if each["row"] == row.name]
        # Infinite errors have no number in JSON.
        sizes = [
            [inf if size is None else float(size) for size in (each["position_before"], each["rotation_before"])]
            for each in rows
        ]
        return {each["fusion"]: Errors(*size) for each, size in zip(rows, sizes, strict=True)}
    except (KeyError, TypeError, ValueError):
        raise InputError(
            "these are no figures of disturbances: take those that 'gough faults --json FILE' has written"
        ) from None


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
        cells: list[str | Cell] = [each.row.name, when, f"{100.0 * each.greatest('share'):.0f} %", *errors]
        cells += [f"{100.0 * each.greatest('least'):.3g} %", str(each.errors("least_"))]
        level, sound = each.errors("level_"), each.errors("sound_")
        cells += [str(level), f"{level.position / sound.position:.1f}/{level.rotation / sound.rotation:.1f}"]
        if measured:
            before = errors_before(each.row, measured).values()
            verdicts = [each.verdict(errors) for errors in before]
            cells += ["; ".join(map(str, before)) or "-", Cell(" / ".join(verdicts) or "-", alarm="no" in verdicts)]
        result.add(*cells)
    return result


def left_out(found: Sequence[RowBounds]) -> list[str]:
    """The rows without bounds and the reason, a line each."""
    return [f"{each.row.name}: {each.reason}" for each in found if each.reason]
