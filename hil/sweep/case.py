"""One point of a study as a worker gets it: it needs no file of the machine that asks."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from hil.engine.batches import fingerprint
from hil.runs.config import SimulationConfig
from hil.runs.names import check_names, digest_of, kept_file
from hil.sweep.function import UserFunction
from hil.sweep.study import FILES, Study, part_of
from plant.errors import GoughError, InputError
from plant.mechanism import load_in_space
from plant.mechanism.documents import mechanism_from_text, mechanism_text, set_entry
from plant.mechanism.joint_circles import reshaped_entries

GEOMETRY_FIGURE = "geometry."
"""How the names of figures begin that need no run."""
Result = TypeVar("Result")
_OF_THIS_RUN = ("config", "version", "motion_s", "real_time_factor", "cycle_us")
"""Parts of a summary that are no figures, or not the same each time."""
_OF_SUMMARY = (
    "truth_known",
    "estimation",
    "tracking",
    "estimated_tracking",
    "target",
    "protection",
    "limits",
    "target_stretch",
)
"""The other parts."""


@dataclass(frozen=True)
class SentFile:
    """A file that goes with a case; its name is kept."""

    field: str  # of the configuration that names it
    name: str
    content: bytes

    @property
    def digest(self) -> str:
        """A hash of the content."""
        return digest_of(self.content)

    def local(self) -> Path:
        """The file in this machine's cache."""
        return kept_file(self.name, self.content)


@dataclass(frozen=True)
class Case:
    """A point of a study, and all that its figures depend on.

    Attributes:
        key: a hash of all that determines the figures: configuration, files, functions and gough's sources.
        kind: cases of a kind need the same machine code and FMU.
        point: the factors' values.
        config: of the run; `files` are in it by name alone.
        files: the files that the configuration names.
        function, model: as in `Study`.
        run, geometry: whether the figures of a run, and those of the geometry alone, are wanted.
    """

    key: str
    kind: str
    point: Mapping[str, Any]
    config: SimulationConfig
    files: tuple[SentFile, ...]
    function: UserFunction | None
    model: UserFunction | None
    run: bool = True
    geometry: bool = False

    def local_config(self) -> SimulationConfig:
        """The configuration with this machine's files."""
        local: dict[str, Any] = {file.field: str(file.local()) for file in self.files}
        return replace(self.config, **local)


def measure(case: Case) -> dict[str, float]:
    """The figures of a case.

    Raises:
        GoughError: it cannot be run, or the run has stopped early.
    """
    if case.model is not None:
        return case.model.figures(**case.point)
    config = case.local_config()
    figures: dict[str, float] = {}
    if case.geometry:
        from controller.workspace import geometry_figures

        section_5 = config.fusion == "section-5"
        found = geometry_figures(load_in_space(config.mechanism), config.imus, config.magnetometer, section_5)
        figures = {GEOMETRY_FIGURE + name: value for name, value in found.items()}
    if case.run:
        from hil.runs.simulation import simulate

        result = simulate(config)
        summary = {name: value for name, value in result.summary().items() if name not in _OF_THIS_RUN}
        figures |= dict(_flat(summary)) | (case.function.figures(result) if case.function else {})
    return figures


def own_figures(names: Iterable[str]) -> list[str]:
    """Those figures that are not of a run's summary, but of the user's own function; all of them without a function."""
    found = list(names)
    return [name for name in found if name.partition(".")[0] not in _OF_SUMMARY] or found


def cases_of(study: Study) -> Iterator[Case]:
    """The cases of a study in the order of its points.

    Raises:
        GoughError: a point cannot be run.
    """
    geometry = any(name.startswith(GEOMETRY_FIGURE) for name in study.figures)
    run = bool(study.function) or not all(name.startswith(GEOMETRY_FIGURE) for name in study.figures)
    for point in study.points():
        yield case_of(study, point, run, geometry)


def case_of(study: Study, point: Mapping[str, Any], run: bool = True, geometry: bool = False) -> Case:
    """The case of a study at a point, with the figures of a run, of the geometry alone, or both.

    Raises:
        GoughError: the point cannot be run.
    """
    try:
        return _case(study, point, run, geometry)
    except TypeError as error:
        raise InputError(f"at {_text(point)}: {error}") from None
    except GoughError as error:
        raise type(error)(f"at {_text(point)}: {error}") from None


def _case(study: Study, point: Mapping[str, Any], run: bool, geometry: bool) -> Case:
    if study.model is not None:
        key = _key({"model": study.model.source, "name": study.model.name, "point": dict(point)})
        return Case(key, "", point, study.run, (), None, study.model)
    config = study.config_at(point)
    check_names(config)
    files = []
    for field in FILES:
        name = getattr(config, field)
        if field == "mechanism" and (content := mechanism_at(study, point)) is not None:
            files.append(SentFile(field, f"{Path(name).stem}.toml", content))
        elif field != "mechanism" and name is not None and Path(name).is_file():
            files.append(SentFile(field, Path(name).name, _content(name)))
    config_of_key = asdict(config) | {file.field: file.digest for file in files}
    function = study.function and (study.function.name, study.function.source)
    planar = _is_planar(config.mechanism)
    kind = f"{config.fusion} {planar} {config.plant and digest_of(_content(config.plant))}" if run else "geometry"
    key = _key({"config": config_of_key, "function": function, "run": run, "geometry": geometry})
    without: dict[str, Any] = {file.field: file.name for file in files}
    return Case(key, kind, point, replace(config, **without), tuple(files), study.function, None, run, geometry)


def mechanism_at(study: Study, point: Mapping[str, Any]) -> bytes | None:
    """The mechanism's file at a point; None for a preset as it is.

    Raises:
        GoughError: the mechanism cannot be changed like this.
    """
    name, changes, shape = study.config_at(point).mechanism, study.mechanism_at(point), part_of(point, "geometry")
    if changes or shape:
        return _changed_mechanism(name, json.dumps(changes), json.dumps(shape))
    return _content(name) if Path(name).is_file() else None


def _kept(function: Callable[..., Result]) -> Callable[..., Result]:
    """Keep what a function gives for a file, or a preset, and more arguments, until the file changes."""

    @cache
    def known(state: tuple[int, ...], path: str, *others: Any) -> Result:
        return function(path, *others)

    def asked(path: str, *others: Any) -> Result:
        found = Path(path).stat() if Path(path).exists() else None
        return known((found.st_ino, found.st_ctime_ns, found.st_size) if found else (), path, *others)

    return asked


@_kept
def _is_planar(mechanism: str) -> bool:
    return load_in_space(mechanism).planar


@_kept
def _content(path: str) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None


@_kept
def _changed_mechanism(name: str, changes: str, shape: str) -> bytes:
    """The TOML text of a mechanism with other entries, and then other numbers of its geometry, both as JSON."""
    import tomlkit

    document: Any = tomlkit.parse(mechanism_text(name))
    document["name"] = document.get("name", Path(name).stem)
    for entry, value in json.loads(changes).items():
        set_entry(document, entry, value)
    if numbers := json.loads(shape):
        for entry, value in reshaped_entries(mechanism_from_text(tomlkit.dumps(document), name), numbers).items():
            set_entry(document, entry, value)
    return tomlkit.dumps(document).encode()


def _flat(figures: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, bool | int | float):
            yield prefix + name, float(value)


def _key(content: Mapping[str, Any]) -> str:
    text = json.dumps({**content, "sources": fingerprint()}, sort_keys=True, default=str)
    return digest_of(text.encode())


def _text(point: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} = {value}" for name, value in point.items())
