"""Runs beside each other: their configurations, errors and times, from figures that were written and from recordings."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.loop.records import COMPUTED
from hil.realtime.durations import percentiles
from hil.runs.config import SimulationConfig
from hil.runs.figures import error_figures, level_figures
from hil.runs.recorded_run import RecordedRun, recorded_run
from hil.runs.run_state import RunState
from hil.table import Cell, Table
from plant.errors import InputError
from plant.files import read_text
from plant.pose import Array, pose_errors

_MCAP = b"\x89MCAP"
_TIMES = ("p50", "p99", "p999")
_TOLERANCE_S = 1e-6


class Figure(NamedTuple):
    """How a figure is called and shown."""

    label: str
    scale: float = 1.0  # from SI to the unit of the label
    digits: int = 4

    def text(self, value: float | None, sign: str = "") -> str:
        """A value in its unit."""
        return "-" if value is None or not isfinite(value) else f"{self.scale * value:{sign}.{self.digits}f}"


_MM, _DEG = 1e3, float(np.degrees(1.0))
_ERRORS = {
    f"{group}.{quantity}_{kind}": Figure(f"{words}, {quantity} {kind.replace('rms', 'RMS')} [{unit}]", scale)
    for group, words in (("estimation", "estimate - truth"), ("tracking", "truth - reference"))
    for quantity, unit, scale in (("position", "mm", _MM), ("rotation", "deg", _DEG))
    for kind in ("rms", "max")
}
_LEVELS = {
    f"protection.{quantity}_{kind}": Figure(f"protection level, {quantity} {kind} [{unit}]", scale)
    for quantity, unit, scale in (("position", "mm", _MM), ("rotation", "deg", _DEG))
    for kind in ("p50", "p99", "max")
}
_DURATIONS = {
    f"{group}.{kind}": Figure(f"{words} {kind.replace('p999', 'p99.9')} [us]", 1e6, 1)
    for group, words in (("compute", "computing"), ("late", "woken late"))
    for kind in _TIMES
}
FIGURES = {
    **_ERRORS,
    "whole.estimation": Figure("estimate - truth with the hold, position RMS [mm]", _MM),
    "whole.rotation": Figure("estimate - truth with the hold, rotation RMS [deg]", _DEG),
    "whole.lengths": Figure("reference - length with the hold, RMS [mm]", _MM),
    **_LEVELS,
    "target_stretch": Figure("stretch of the target's times"),
    **_DURATIONS,
    "missed_periods": Figure("missed periods", digits=0),
    "events": Figure("events", digits=0),
}
"""The figures of a run by name, in SI units; docs/compare.md says what they are."""


@dataclass(frozen=True, eq=False)
class Course:
    """The motion of a recorded run, over the time that is compared, with n legs.

    Attributes:
        times: (N,) [s] since the motion began.
        estimation, tracking: (N, 6), estimate - truth and truth - reference, translation [m] and rotation vector [rad]; NaN
            where it is not known.
        lengths, planned: (N, n) [m], estimated and of the reference.
        stroke: (n, 2) [m].
        compute, late: (N,) [s].
    """

    times: Array
    estimation: Array
    tracking: Array
    lengths: Array
    planned: Array
    stroke: Array
    compute: Array
    late: Array


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """A run in a comparison.

    Attributes:
        name: short, and no other run's.
        source: the file, or the files with commas in between.
        kind: "simulation" or "run", of which there are only figures, or "recording".
        config: fields of `SimulationConfig`, as JSON has them.
        figures: some of `FIGURES`, in SI units.
        seconds: of motion that the figures are of.
        course: None of what is no recording.
    """

    name: str
    source: str
    kind: str
    version: str
    config: Mapping[str, Any]
    figures: Mapping[str, float]
    seconds: float
    events: tuple[str, ...]
    course: Course | None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several runs and how they differ from one of them.

    Attributes:
        runs: in the order in which they were named.
        reference: with which the others are compared.
        seconds: of motion over which recordings are compared.
        remarks: what limits the comparison, a sentence each.
    """

    runs: tuple[ComparedRun, ...]
    reference: ComparedRun
    seconds: float
    remarks: tuple[str, ...]

    @property
    def others(self) -> list[ComparedRun]:
        """The runs without the reference."""
        return [run for run in self.runs if run is not self.reference]

    @property
    def ordered(self) -> list[ComparedRun]:
        """The reference, and then the others."""
        return [self.reference, *self.others]

    @property
    def one_mechanism(self) -> bool:
        """Whether all runs are of the same mechanism."""
        return "mechanism" not in self.differing()

    def differing(self) -> dict[str, list[Any]]:
        """The fields of the configuration, and the version, in which runs differ: their values, in the order of `ordered`."""
        values = {name: [run.config[name] for run in self.ordered] for name in self.reference.config}
        values["version"] = [run.version for run in self.ordered]
        return {name: each for name, each in values.items() if any(value != each[0] for value in each)}

    def difference(self, run: ComparedRun, name: str) -> tuple[float, float] | None:
        """A figure of a run less that of the reference, and over it, NaN over zero; None if one of them lacks it."""
        own, other = run.figures.get(name), self.reference.figures.get(name)
        if own is None or other is None:
            return None
        return own - other, own / other if other else float("nan")

    def table(self, notes: bool = False) -> Table:
        """The fields in which runs differ, and every figure that a run has, with its difference and ratio to the reference's
        behind it, or as `notes` below it.
        """
        table = Table("", *(run.name for run in self.ordered))
        for field, values in self.differing().items():
            table.add(field, *(_value_text(value) for value in values))
        for name, figure in FIGURES.items():
            if any(name in run.figures for run in self.runs):
                table.add(figure.label, *(self._cell(run, name, figure, notes) for run in self.ordered))
        return table

    def _cell(self, run: ComparedRun, name: str, figure: Figure, notes: bool) -> Cell:
        text, note = figure.text(run.figures.get(name)), ""
        if run is not self.reference and (found := self.difference(run, name)):
            off, ratio = found
            note = figure.text(off, "+") + (f", x{ratio:.3g}" if isfinite(ratio) else "")
        return Cell(text, note) if notes or not note else Cell(f"{text} ({note})")

    def events_table(self) -> Table:
        """The events of each run."""
        table = Table("run", "events", left=(0, 1))
        for run in self.ordered:
            table.add(Cell(run.name), "; ".join(run.events) or "none")
        return table

    def summary(self) -> dict[str, Any]:
        """All of it in SI units, for JSON."""
        listed = [
            {name: value for name, value in vars(run).items() if name != "course"}
            | {"differences": {} if run is self.reference else self._differences(run)}
            for run in self.runs
        ]
        return {
            "reference": self.reference.name,
            "seconds": self.seconds,
            "runs": listed,
            "differing": {
                name: dict(zip((run.name for run in self.ordered), values, strict=True))
                for name, values in self.differing().items()
            },
            "remarks": list(self.remarks),
            "version": version("gough"),
        }

    def _differences(self, run: ComparedRun) -> dict[str, dict[str, float | None]]:
        found = {name: self.difference(run, name) for name in FIGURES}
        return {
            name: {"difference": each[0], "ratio": each[1] if isfinite(each[1]) else None}
            for name, each in found.items()
            if each is not None
        }


def compare(sources: Sequence[Path | str], reference: Path | str | None = None, mechanism: str | None = None) -> Comparison:
    """Compare runs: JSON files of `gough simulate` and `gough run`, and recordings.

    Recordings are compared over the time of motion that all runs share.

    Args:
        sources: the files; those of one recording have commas in between.
        reference: which of them the others are compared with; the first by default. One that is not among them is added.
        mechanism: of the recordings, if its file has moved.

    Raises:
        InputError: fewer than two runs, one that is named twice, or a file that is no run's.
        RecordingError: a recording cannot be read.
    """
    named = [str(source) for source in sources]
    if reference is not None and str(reference) not in named:
        named.insert(0, str(reference))
    if len(named) < 2:
        raise InputError(f"a comparison needs two runs at least, and there is {len(named)}: name another file")
    if twice := [source for source in named if named.count(source) > 1]:
        raise InputError(f"{twice[0]} is named twice: name each run once")
    loaded = [_loaded(source, mechanism) for source in named]
    lengths = [each.seconds for each in loaded]
    seconds = min(lengths)
    names = _short_names(named)
    runs = tuple(each.cut(name, seconds) for each, name in zip(loaded, names, strict=True))
    chosen = runs[0 if reference is None else named.index(str(reference))]
    return Comparison(runs, chosen, seconds, tuple(_remarks(runs, lengths, seconds)))


@dataclass(frozen=True, eq=False)
class _Loaded:
    """What a file has of a run, before it is cut to the time that all share."""

    source: str
    kind: str
    version: str
    config: dict[str, Any]
    seconds: float
    events: tuple[str, ...]
    figures: dict[str, float]
    recorded: RecordedRun | None = None

    def cut(self, name: str, seconds: float) -> ComparedRun:
        """The run, a recording over so many seconds."""
        course, figures, own = None, dict(self.figures), self.seconds
        if self.recorded is not None:
            rows = self.recorded.motion
            rows = rows[self.recorded.times[rows] < seconds - _TOLERANCE_S]
            course = _course(self.recorded, rows)
            figures, own = figures | _recorded_figures(self.recorded, course, rows), min(self.seconds, seconds)
        ordered = {each: float(figures[each]) for each in FIGURES if figures.get(each) is not None}
        return ComparedRun(name, self.source, self.kind, self.version, self.config, ordered, own, self.events, course)


def _loaded(source: str, mechanism: str | None) -> _Loaded:
    paths = [Path(part) for part in source.split(",")]
    try:
        with paths[0].open("rb") as file:
            recorded = file.read(len(_MCAP)) == _MCAP
    except OSError as error:
        raise InputError(f"cannot read {paths[0]}: {error.strerror}") from None
    if recorded:
        return _of_recording(source, recorded_run(paths, mechanism))
    try:
        content = json.loads(read_text(source))
    except json.JSONDecodeError:
        content = None
    if isinstance(content, dict):
        if {"estimation", "tracking", "cycle_us", "config"} <= content.keys():
            return _of_simulation(source, content)
        if {"errors_m", "timing_us", "cycles", "config"} <= content.keys():
            return _of_run(source, content)
    raise InputError(
        f"{source} is no run's: name what 'gough simulate --json' or 'gough run --json' has written, or a recording of "
        "'gough run --record'"
    )


def _of_simulation(source: str, content: dict[str, Any]) -> _Loaded:
    figures = {
        f"{group}.{name}": value
        for group in ("estimation", "tracking", "protection")
        for name, value in (content.get(group) or {}).items()
    }
    figures |= {f"compute.{name}": 1e-6 * us for name, us in content["cycle_us"].items()}
    figures |= _common(content)
    config = _config(content["config"] | _stages(content))
    seconds = content.get("motion_s", config["duration"])
    return _Loaded(source, "simulation", str(content["version"]), config, seconds, tuple(content["events"]), figures)


def _of_run(source: str, content: dict[str, Any]) -> _Loaded:
    errors, timing, config = content["errors_m"], content["timing_us"], _config(content["config"] | _stages(content))
    figures = _with_the_hold(errors, content.get("errors_rad", {}))
    figures |= {f"protection.{name}_max": value for name, value in (content.get("protection") or {}).items()}
    for group, stage in (("compute", "compute"), ("late", "wake")):
        figures |= {f"{group}.{name}": 1e-6 * timing[stage][name] for name in _TIMES}
    figures["missed_periods"] = sum(content[f"missed_{cause}"] for cause in ("own", "late", "host"))
    figures |= _common(content)
    seconds = content.get("motion_s", config["duration"])
    return _Loaded(source, "run", str(content["version"]), config, seconds, tuple(content["events"]), figures)


def _of_recording(source: str, run: RecordedRun) -> _Loaded:
    times = run.times[run.motion]
    if len(times) < 2:
        raise InputError(f"{source} has no motion: the run ended before it began; leave it out")
    state = RunState(run.period)
    state.add(run.records)
    figures = _with_the_hold(state.errors(), state.rotation_errors())
    # Those that the JSON of a run has; a recording also tells each missed period.
    events = tuple(state.events)
    figures["events"] = len(events)
    seconds = float(times[-1]) + run.period
    return _Loaded(source, "recording", str(run.config["version"]), _config(run.config), seconds, events, figures, run)


def _common(content: Mapping[str, Any]) -> dict[str, float]:
    """The figures that simulations and runs tell alike; an older version told no stretch."""
    stretch = {"target_stretch": content["target_stretch"]} if "target_stretch" in content else {}
    return {**stretch, "events": len(content["events"])}


def _stages(content: Mapping[str, Any]) -> dict[str, Any]:
    return {"stages": content.get("stages", {})}


def _with_the_hold(errors: Mapping[str, float], rotation: Mapping[str, float]) -> dict[str, float]:
    """The figures of the errors that a run sums up; an older version did not tell that of the rotation."""
    figures = {"whole.lengths": errors["tracking"]}
    if errors["known"]:
        figures["whole.estimation"] = errors["estimation"]
        figures |= {"whole.rotation": rotation["estimation"]} if rotation else {}
    return figures


def _config(values: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a configuration as JSON has them, and the stages of the user's own; an older version may lack some, which
    then have their defaults.
    """
    plain = json.loads(json.dumps(asdict(SimulationConfig()))) | {"stages": {}}
    return {name: values.get(name, default) for name, default in plain.items()}


def _course(run: RecordedRun, rows: NDArray[np.intp]) -> Course:
    legs, records = run.mechanism.legs, run.records[rows]
    estimates, unknown = run.estimates(rows), np.full((len(rows), 6), np.nan)
    known = run.truth_known
    truths = run.truths(rows) if known else estimates
    return Course(
        times=run.times[rows],
        estimation=pose_errors(*estimates, *truths) if known else unknown,
        tracking=pose_errors(*truths, *run.references(rows)) if known else unknown,
        lengths=records["lengths"][:, :legs],
        planned=records["reference"][:, :legs, 0],
        stroke=run.mechanism.require_limits().stroke,
        compute=1e-9 * records["stage_ns"][:, COMPUTED].sum(axis=1),
        late=1e-9 * records["late_ns"],
    )


def _recorded_figures(run: RecordedRun, course: Course, rows: NDArray[np.intp]) -> dict[str, float]:
    figures: dict[str, float] = {}
    for group, errors in (("estimation", course.estimation), ("tracking", course.tracking)):
        known = errors[np.isfinite(errors).all(axis=1)]
        if len(known):
            figures |= {f"{group}.{name}": value for name, value in error_figures(known).items()}
    levels = run.records["protection"][rows].astype(float)
    levels = levels[np.isfinite(levels).all(axis=1)]
    if len(levels):
        figures |= {f"protection.{name}": value for name, value in level_figures(levels).items()}
    for group, times in (("compute", course.compute), ("late", course.late)):
        figures |= {f"{group}.{name}": 1e-6 * us for name, us in percentiles(1e9 * times, _TIMES).items()}
    figures["missed_periods"] = int(run.records["missed"][rows].sum())
    return figures


def _short_names(sources: Sequence[str]) -> list[str]:
    """The names of the files without their folders, if these are all different."""
    short = [Path(source.partition(",")[0]).name for source in sources]
    return short if len({*short}) == len(short) else list(sources)


def _remarks(runs: Sequence[ComparedRun], lengths: Sequence[float], seconds: float) -> Iterator[str]:
    """What limits the comparison of runs with motions of these lengths [s] over so many seconds."""
    longer = {run: length for run, length in zip(runs, lengths, strict=True) if length - seconds > _TOLERANCE_S}
    cut = [f"{run.name} has {length:.3f} s" for run, length in longer.items() if run.course is not None]
    if cut:
        yield f"recordings are compared over the {seconds:.3f} s of motion that all runs share; {', '.join(cut)}"
    for run, length in longer.items():
        if run.course is None:
            yield f"the figures of {run.name} are of its whole motion of {length:.3f} s, and cannot be cut"
    of_run = [run.name for run in runs if run.kind == "run"]
    if of_run:
        yield f"the times, missed periods and protection level of {', '.join(of_run)} are of the whole run, with the hold"
    if len({run.config["mechanism"] for run in runs}) > 1:
        yield "the runs are of different mechanisms: the lengths of their legs are not compared"


def _value_text(value: Any) -> str:
    if value is None or value in ([], ""):
        return "none"
    if isinstance(value, list | dict):
        return json.dumps(value)
    return str(value)
