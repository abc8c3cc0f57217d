"""Tables and summaries of what `gough faults` has run."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from math import degrees, inf, isfinite
from typing import Any

import numpy as np

from controller.safety.causes import Cause
from hil.faults.reactions import RATE_HZ, Case, Outcome
from hil.faults.rows import ENCODERS, SOUND, Row
from hil.faults.trials import Figures
from hil.table import Table

_MM, _DEG = 1e3, degrees(1.0)
_ENCODER_OFF_M, _ENCODER_S = 1e-3, 0.05
"""An encoder that is wrong is named before it is so far off, or within so long, whichever is later."""
_NOTHING, _END = "nothing", Cause.END_OF_MOTION.short
_GREATEST = (
    "position_before", "rotation_before", "position_after", "rotation_after", "position_then", "rotation_then", "deviation",
    "level_position", "level_rotation", "told_s", "encoder_off",
)  # fmt: skip
"""Of these figures the greatest over the seeds is shown; a table has no column for what no run has."""
_OF_SEEDS = ("seed", "what", "position_before", "rotation_before")
"""These figures of each seed are in the summary, too."""


def summary(
    outcomes: list[Outcome], disturbances: list[dict[str, Any]], sound: list[dict[str, Any]], seeds: Sequence[int]
) -> dict[str, Any]:
    """Everything, for JSON, in SI units; what is not finite is null."""
    return {
        "cases": [each.summary() for each in outcomes],
        "disturbances": _finite(disturbances),
        "sound": _finite(sound),
        "seeds": len(seeds),
        "first_seed": seeds[0],
        "rate_hz": RATE_HZ,
        "version": version("gough"),
    }


def _finite(figures: list[dict[str, Any]]) -> list[dict[str, Any]]:
    def or_none(value: Any) -> Any:
        if isinstance(value, list):
            return _finite(value)
        return None if isinstance(value, float) and not isfinite(value) else value

    return [{name: or_none(value) for name, value in each.items()} for each in figures]


def disturbances_of(found: Iterable[Figures]) -> list[dict[str, Any]]:
    """What each row has shown with each fusion, over all seeds, from the figures of their trials.

    Returns:
        By row and fusion: the greatest of each error, level and time (`verdict.judge`), how often what was `told` first, how
        often and why the run `ended` early, the numbers of `runs`, of those with `alarms` before the begin, of `forbidden`
        ones, and of those that named an encoder too `late`, the share of cycles that the protection level has `covered`, if
        there is one, and of each of the `seeds`, `what` it has drawn and its errors before anything was told.
    """
    groups: dict[tuple[str, str, str], list[Figures]] = {}
    for figures in found:
        if figures["kind"] != Case.kind:
            groups.setdefault((figures["kind"], figures["row"], figures["fusion"]), []).append(figures)
    return [{"kind": kind, "row": row, "fusion": fusion, **_over_seeds(runs)} for (kind, row, fusion), runs in groups.items()]


def _over_seeds(runs: list[Figures]) -> dict[str, Any]:
    covered = [(each["covered"], each["cycles"]) for each in runs if each.get("covered") is not None]
    ended = Counter(each["ended"] for each in runs if each["ended"] != _END)
    return {
        "runs": len(runs),
        **{name: max((each[name] for each in runs if each.get(name) is not None), default=None) for name in _GREATEST},
        "told": dict(Counter(each["told"] or _NOTHING for each in runs).most_common()),
        "ended": dict(ended.most_common()),
        "alarms": sum(each["alarms"] > 0 for each in runs),
        "sound_left_out": sum(bool(each["sound_left_out"]) for each in runs),
        "forbidden": sum(each["forbidden"] for each in runs),
        "late": sum(map(_is_late, runs)),
        "covered": float(np.divide(*np.sum(covered, axis=0))) if covered else None,
        "seeds": [{name: each[name] for name in _OF_SEEDS} for each in runs],
    }


def _is_late(figures: Figures) -> bool:
    """Whether nothing was told until an encoder was 1 mm off and 50 ms had passed."""
    off, told = figures.get("encoder_off"), figures.get("told_s")
    return off is not None and off > _ENCODER_OFF_M and (told is None or told > _ENCODER_S)


def encoder_table(disturbances: Iterable[dict[str, Any]]) -> Table:
    """A line for each row of faults of encoders: how far one was off when it was told, and the longest time until then."""
    table = Table("encoders", "fusion", "off when told [mm]", "s", "later than 1 mm and 50 ms")
    for each in disturbances:
        if each["kind"] == ENCODERS and each["encoder_off"] is not None:
            off, told = _number(each["encoder_off"], _MM, 2), _number(each["told_s"], 1.0, 3)
            table.add(each["row"], each["fusion"], off, told, f"{each['late']} of {each['runs']}")
    return table


def disturbance_table(disturbances: Sequence[dict[str, Any]]) -> Table:
    """A line for each row; where there are several fusions, their cells have a stroke between them.

    Errors are the greatest over the seeds, `silent` until something is told, and `told` from then on. `first told` has what
    most runs told, and in how many, and `s` the longest time until then.
    """
    covered = any(each["covered"] is not None for each in disturbances)
    headings = ("disturbance", "silent [mm]", "[deg]", "told [mm]", "[deg]", "first told", "s", "stops", "forbidden")
    table = Table(*headings, *(["covered [%]"] if covered else []), left=(0, 5))
    by_row: dict[str, list[dict[str, Any]]] = {}
    for each in disturbances:
        by_row.setdefault(each["row"], []).append(each)
    for name, group in by_row.items():
        told = [_told(each) for each in group]
        table.add(
            name,
            _joined(group, lambda each: _number(each["position_before"], _MM)),
            _joined(group, lambda each: _number(each["rotation_before"], _DEG, 2)),
            _joined(group, lambda each: _number(each["position_after"], _MM)),
            _joined(group, lambda each: _number(each["rotation_after"], _DEG, 2)),
            " / ".join(told if len(set(told)) > 1 else told[:1]),
            _joined(group, lambda each: _number(each["told_s"], 1.0)),
            _joined(group, lambda each: f"{sum(each['ended'].values())}"),
            _joined(group, lambda each: f"{each['forbidden']}"),
            *([_joined(group, lambda each: _number(each["covered"], 100.0, 2))] if covered else []),
        )
    return table


def sound_of(found: Iterable[Figures]) -> list[dict[str, Any]]:
    """What the rows of the kind "sound" have shown with each fusion, in which nothing is wrong.

    Returns:
        By fusion: the numbers of `runs`, of those that `told` anything, that left an IMU out, and that `ended` early, before
        they moved or later; the `seconds` that they took; the RMS errors, over all cycles in motion; the share of these that
        the protection level has `covered`; and `level_position` and `level_rotation`, the medians over the runs of its 99th
        percentiles, in RMS errors. None where nothing has moved, or there is no level.
    """
    groups: dict[str, list[Figures]] = {}
    for figures in found:
        if figures["kind"] == SOUND:
            groups.setdefault(figures["fusion"], []).append(figures)
    return [{"fusion": fusion, **_of_sound(runs)} for fusion, runs in groups.items()]


def _of_sound(runs: list[Figures]) -> dict[str, Any]:
    moved = [each for each in runs if each["cycles"]]
    known = [each for each in moved if each.get("covered") is not None]
    result: dict[str, Any] = {
        "runs": len(runs),
        "seconds": sum(each["ended_s"] for each in runs),
        "told": sum(bool(each["told"]) for each in runs),
        "left_out": sum(bool(each["left_out"]) for each in runs),
        "ended": sum(each["ended"] != _END for each in runs),
        "covered": sum(each["covered"] for each in known) / sum(each["cycles"] for each in known) if known else None,
    }
    for part in ("position", "rotation"):
        squares, cycles = [each[f"rms_{part}"] ** 2 for each in moved], [each["cycles"] for each in moved]
        rms = float(np.sqrt(np.average(squares, weights=cycles))) if moved else None
        levels = [each[f"level_{part}"] for each in known]
        result |= {f"rms_{part}": rms, f"level_{part}": float(np.median(levels)) / rms if rms and levels else None}
    return result


def sound_table(sound: Iterable[dict[str, Any]]) -> Table:
    """A line for each fusion; the level's columns are medians over the runs of its 99th percentile, in RMS errors."""
    headings = ("nothing is wrong", "runs", "hours", "told", "left out", "ended", "RMS [mm]", "[deg]", "covered [%]")
    table = Table(*headings, "level of position / RMS", "of rotation")
    for each in sound:
        counts = (f"{each[name]}" for name in ("told", "left_out", "ended"))
        errors = _number(each["rms_position"], _MM, 3), _number(each["rms_rotation"], _DEG, 3)
        levels = (_number(each[f"level_{part}"], 1.0) for part in ("position", "rotation"))
        hours = f"{each['seconds'] / 3600.0:.2f}"
        table.add(each["fusion"], f"{each['runs']}", hours, *counts, *errors, _number(each["covered"], 100.0, 2), *levels)
    return table


def worst_first(disturbances: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Forbidden outcomes first, and then by the greatest error before anything was told: 1 deg counts as much as 5 mm."""

    def badness(each: dict[str, Any]) -> tuple[int, float]:
        position, rotation = ((each[f"{part}_before"] or 0.0) for part in ("position", "rotation"))
        return each["forbidden"], max(position / 5e-3, _DEG * rotation)

    return sorted(disturbances, key=badness, reverse=True)


def list_table(items: Iterable[Case | Row]) -> Table:
    """What there is, for `--list`."""
    table = Table("kind", "name", "link", "Hz", "s", "faults and settings", left=(0, 1, 2, 5))
    for item in items:
        if isinstance(item, Row):
            what = (*item.faults, *item.settings, *_others(item))
            rate = "drawn" if "rate" in item.draw else f"{item.rate:g}"
            table.add(item.kind, item.name, item.link, rate, f"{item.duration:g}", " ".join(what))
        else:
            table.add("reactions", item.name, "udp", f"{RATE_HZ:g}", "4.5", item.faults or item.streamed)
    return table


def _others(row: Row) -> tuple[str, ...]:
    """What else is not as the controller has it."""
    sizes = {"base_bend_mm": row.base_bend_mm, "joint_off_mm": row.joint_off_mm, "joint_error_mm": 1e3 * row.joint_error}
    sizes["late_percent"] = row.late_percent
    bounds = (f"size={row.sizes[0]:g}..{row.sizes[1]:g}",) if row.sizes else ()
    return (*(f"{name}={size:g}" for name, size in sizes.items() if size), *bounds)


def _joined(group: Sequence[dict[str, Any]], cell: Callable[[dict[str, Any]], str]) -> str:
    return " / ".join(map(cell, group))


def _told(each: dict[str, Any]) -> str:
    what, count = next(iter(each["told"].items()))
    return what if count == each["runs"] else f"{what} ({count} of {each['runs']})"


def _number(value: float | None, scale: float, digits: int = 1) -> str:
    if value is None:
        return "-"
    return "none" if value == inf else f"{scale * value:.{digits}f}"
