"""A study as its TOML file or a Python program describes it: what is run, what varies, what is measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from inspect import signature
from itertools import product
from math import prod, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from hil.runs.config import SimulationConfig
from hil.runs.names import name_of
from hil.sweep.function import UserFunction
from hil.sweep.names import PARTS, check_entry, check_factor, check_parameter, is_whole, parsed
from plant.checks import checked_seed, nearest
from plant.errors import GoughError, InputError
from plant.files import check_entries, read_toml
from plant.fmu.settings import Setting

METHODS = ("sobol", "latin-hypercube", "saltelli")
"""How ranges without steps are sampled; `saltelli` is Sobol's sequence in the form that sensitivity indices need."""
FIGURES = (
    "estimation.position_rms", "estimation.rotation_rms", "tracking.position_rms", "tracking.rotation_rms",
)  # fmt: skip
"""Figures of a run that are shown if a study names none."""
FILES = ("mechanism", "target", "imu", "lengths", "frames", "calibration", "plant", "binding")
"""Fields of a run's configuration that may name files."""
SEED = "seed"
"""The last part of the name of factors that replicate."""
_MOST_RUNS = 10_000_000


@dataclass(frozen=True)
class Factor:
    """Something that varies: with `values` they are crossed with all others, else it is sampled from `low` to `high`.

    The name is `run.FIELD`, a field of the run's configuration; `mechanism.TABLE.ENTRY`, an entry of the mechanism's file;
    `geometry.NUMBER`, one of the numbers in `plant.mechanism.joint_circles`; or `plant.PARAMETER`, a parameter or input of the
    FMU, from a time of the motion on as `plant.PARAMETER@SECONDS`. For a `model`, it is an argument of that function.
    """

    name: str
    values: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    logarithmic: bool = False

    def __post_init__(self) -> None:
        part, _, field = self.name.partition(".")
        plain = map(_plain, self.values)
        object.__setattr__(self, "values", tuple(name_of(field, value) if part == "run" else value for value in plain))
        if self.values:
            self._check_values()
            return
        if self.is_seed:
            raise InputError(f"{self.name} is a seed, a whole number, and has no range: give {{ seeds = 10 }}, or a list")
        if not (np.isfinite([self.low, self.high]).all() and self.low < self.high):
            raise InputError(f"{self.name} goes from {self.low:g} to {self.high:g}: give a finite range that goes up")
        if self.logarithmic and self.low <= 0.0:
            raise InputError(f"{self.name} begins at {self.low:g}, and a logarithmic range must be positive")

    def _check_values(self) -> None:
        kinds = {float if type(value) is int else type(value) for value in self.values}
        if len(kinds) > 1:
            raise InputError(
                f"{self.name} has values of several kinds, {list(self.values)}: give numbers, switches or texts alone"
            )
        if not kinds <= {float, bool, str, list}:
            raise InputError(f"{self.name} has the value {self.values[0]!r}: give numbers, switches, texts or lists")
        known: set[Any] = set()
        for value in self.values:
            if isinstance(value, float) and not np.isfinite(value):
                raise InputError(f"{self.name} has the value {value}: give finite numbers")
            hashed = str(value) if isinstance(value, list) else value
            if hashed in known:
                raise InputError(f"{self.name} has the value {value!r} twice: leave one out")
            known.add(hashed)

    @property
    def is_seed(self) -> bool:
        """Whether it replicates: a factor called seed is no cause to look for, but chance."""
        return self.name.rpartition(".")[2] == SEED

    @property
    def sampled(self) -> bool:
        """Whether its values come from the design of the samples."""
        return not self.values

    def at(self, share: float) -> float:
        """The value at a share 0 to 1 of its range."""
        if self.logarithmic:
            return float(self.low * (self.high / self.low) ** share)
        return float(self.low + share * (self.high - self.low))

    def middle(self, low: float, high: float) -> float:
        """The middle of a part of its range."""
        return sqrt(low * high) if self.logarithmic else (low + high) / 2.0


@dataclass(frozen=True)
class Sampling:
    """How ranges are sampled: the method, the number of samples (saltelli: its base), and the seed."""

    method: str = "sobol"
    count: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        checked_seed(self.seed)
        if self.method not in METHODS:
            question = nearest(str(self.method), METHODS)
            raise InputError(f"there is no method {self.method!r} of sampling; there are {', '.join(METHODS)}{question}")
        if not 2 <= self.count <= _MOST_RUNS:
            raise InputError(f"{self.count} samples are asked for; there can be 2 to {_MOST_RUNS}")
        below = 1 << (self.count.bit_length() - 1)
        if self.method != "latin-hypercube" and self.count != below:
            raise InputError(f"{self.count} samples are asked for; {self.method} needs a power of two: {below} or {2 * below}")

    def shares(self, factors: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Samples (N, factors) of the unit cube."""
        if self.method == "saltelli":
            from SALib.sample import sobol

            problem = {"num_vars": factors, "names": [str(n) for n in range(factors)], "bounds": [[0.0, 1.0]] * factors}
            drawn = sobol.sample(problem, self.count, calc_second_order=False, seed=self.seed)
        else:
            from scipy.stats import qmc

            kind: Any = qmc.Sobol if self.method == "sobol" else qmc.LatinHypercube
            drawn = kind(factors, rng=self.seed).random(self.count)
        return np.asarray(drawn, np.float64)


@dataclass(frozen=True)
class Study:
    """What is run, what varies and what is measured.

    Attributes:
        factors: what varies.
        run: the configuration of every run, where nothing varies.
        mechanism: entries that replace those of the mechanism's file, by name with dots.
        sampling: how ranges are sampled.
        figures: which figures reports and tables show; all are kept.
        function: figures of the user's own, from the result of a run.
        model: figures of the user's own, from the factors, in place of a run.
        name: what reports call it.
    """

    factors: tuple[Factor, ...]
    run: SimulationConfig = field(default_factory=SimulationConfig)
    mechanism: Mapping[str, Any] = field(default_factory=dict)
    sampling: Sampling = field(default_factory=Sampling)
    figures: tuple[str, ...] = ()
    function: UserFunction | None = None
    model: UserFunction | None = None
    name: str = "study"

    def __post_init__(self) -> None:
        if not self.factors:
            raise InputError("nothing varies: give a factor, such as run.seed, in [vary]")
        names = [factor.name for factor in self.factors]
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"{name} varies twice: leave one out")
        if self.model is not None and self.function is not None:
            raise InputError("a model is in place of a run, of which a function takes the result: leave one of them out")
        if self.model is None:
            for name in names:
                check_factor(name)
            for name in (*names, *(f"mechanism.{entry}" for entry in self.mechanism)):
                check_entry(name)
            if self.run.plant is None and "run.plant" not in names:
                for name in (*names, *(f"plant.{setting.name}" for setting in self.run.settings)):
                    check_parameter(name)
        if self.model is not None:
            self._check_arguments(self.model, names)
        if self.function is None and self.model is None and not self.figures:
            object.__setattr__(self, "figures", FIGURES)
        if self.sampling.method == "saltelli" and not any(factor.sampled for factor in self.factors):
            raise InputError("saltelli samples ranges, and none varies: give one, such as { from = 1.0, to = 2.0 }")

    @staticmethod
    def _check_arguments(model: UserFunction, names: Sequence[str]) -> None:
        try:
            signature(model.function()).bind(**dict.fromkeys(names))
        except TypeError as error:
            raise InputError(f"{model.name} does not take the factors {', '.join(names)}: {error}") from None

    @property
    def sampled(self) -> list[Factor]:
        """The factors that are sampled."""
        return [factor for factor in self.factors if factor.sampled]

    @property
    def crossed(self) -> list[Factor]:
        """The factors of which every value meets every other one, and every sample."""
        return [factor for factor in self.factors if not factor.sampled]

    @property
    def samples(self) -> int:
        """The number of samples; 1 if nothing is sampled."""
        if not self.sampled:
            return 1
        return self.sampling.count * (len(self.sampled) + 2 if self.sampling.method == "saltelli" else 1)

    @property
    def size(self) -> int:
        """The number of points, without drawing them."""
        return self.samples * prod(len(factor.values) for factor in self.crossed)

    def points(self) -> list[dict[str, Any]]:
        """The values of all factors at each point: samples in the outer loop, crossed values in the inner ones.

        Raises:
            InputError: there are too many.
        """
        if self.size > _MOST_RUNS:
            raise InputError(f"the study has {self.size} points; there can be {_MOST_RUNS}: vary less")
        sampled, crossed = self.sampled, self.crossed
        shares = self.sampling.shares(len(sampled)).tolist() if sampled else [[]]
        drawn = [{factor.name: factor.at(share) for factor, share in zip(sampled, row, strict=True)} for row in shares]
        grid = [dict(zip((f.name for f in crossed), values, strict=True)) for values in product(*(f.values for f in crossed))]
        order = [factor.name for factor in self.factors]
        return [{name: (sample | cell)[name] for name in order} for sample in drawn for cell in grid]

    def config_at(self, point: Mapping[str, Any]) -> SimulationConfig:
        """The configuration of the run at a point, but for entries of the mechanism's file.

        Raises:
            GoughError: a value cannot be used.
        """
        settings = [_setting(name, value) for name, value in part_of(point, "plant").items()]
        return replace(self.run, **parsed(part_of(point, "run")), settings=(*self.run.settings, *settings))

    def mechanism_at(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """The entries that replace those of the mechanism's file at a point, by name with dots."""
        return {**self.mechanism, **part_of(point, "mechanism")}


def _plain(value: Any) -> Any:
    """A value, or a list of values, without NumPy's types, which neither TOML nor JSON has."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return [_plain(each) for each in value] if isinstance(value, list | tuple) else value


def part_of(point: Mapping[str, Any], part: str) -> dict[str, Any]:
    """The values of a point that belong to run, mechanism, geometry or plant, by their names in there."""
    return {name.removeprefix(f"{part}."): value for name, value in point.items() if name.startswith(f"{part}.")}


def read_study(path: Path | str) -> Study:
    """Read a study from its TOML file; names of files in it are relative to its folder.

    Raises:
        GoughError: the file is no study.
    """
    path, document = Path(path), read_toml(path)
    try:
        return study_of(document, path)
    except GoughError as error:
        raise type(error)(f"{path}: {error}") from None


def study_of(document: dict[str, Any], path: Path) -> Study:
    """The study of a document that was read from a path; errors as for `read_study`."""
    check_entries(document, ("name", "run", "mechanism", "plant", "vary", "sampling", "measure", "model"), "the study")
    for entry, value in document.items():
        kind: type = str if entry in ("name", "model") else dict
        if not isinstance(value, kind):
            raise InputError(f"{entry} = {value!r} must be {'text' if kind is str else f'a table [{entry}]'}")
    if "model" in document and (table := next((part for part in PARTS if part in document), None)):
        raise InputError(f"a model takes the place of a run: leave out [{table}], or model")
    measure, sampling = document.get("measure", {}), document.get("sampling", {})
    check_entries(measure, ("figures", "function"), "[measure]")
    check_entries(sampling, [each.name for each in fields(Sampling)], "[sampling]")
    model = document.get("model")
    factors = factors_of(document.get("vary", {}), path)
    run = {name: _beside(path, name, value) for name, value in parsed(document.get("run", {})).items()}
    settings = tuple(_setting(name, value) for name, value in _flat(document.get("plant", {})).items())
    figures, function = measure.get("figures", []), measure.get("function")
    if not (isinstance(figures, list) and all(isinstance(each, str) for each in figures)):
        raise InputError(f"[measure] figures = {figures!r} must be a list of texts, such as [{FIGURES[0]!r}]")
    for entry, value in sampling.items():
        if not (isinstance(value, str) if entry == "method" else is_whole(value)):
            raise InputError(f"[sampling] {entry} = {value!r} must be {'text' if entry == 'method' else 'a whole number'}")
    try:
        return Study(
            factors,
            SimulationConfig(**run, settings=settings),
            _flat(document.get("mechanism", {})),
            Sampling(**sampling),
            tuple(figures),
            None if function is None else UserFunction.from_file(function, path.parent),
            None if model is None else UserFunction.from_file(model, path.parent),
            str(document.get("name", path.stem)),
        )
    except TypeError as error:
        raise InputError(f"a value has the wrong kind: {error}") from None


def factors_of(table: Mapping[str, Any], path: Path) -> tuple[Factor, ...]:
    """The factors of a table; names of files are relative to the folder of `path`.

    Raises:
        InputError: an entry is no factor.
    """
    return tuple(
        replace(each, values=tuple(_beside(path, each.name.removeprefix("run."), value) for value in each.values))
        for each in _factors(table, "")
    )


def _beside(path: Path, field: str, value: Any) -> Any:
    """A name of a file beside the study's, if there is such a file; any other value as it is."""
    if field in FILES and isinstance(value, str) and (path.parent / value).is_file():
        return str(path.parent / value)
    return value


_SPECIFICATION = ("from", "to", "steps", "logarithmic", "seeds")


def _factors(table: Mapping[str, Any], prefix: str) -> list[Factor]:
    found = []
    for name, value in table.items():
        full = prefix + name
        if isinstance(value, dict) and value.keys() & {*_SPECIFICATION}:
            check_entries(value, _SPECIFICATION, full)
            found.append(_factor(full, value))
        elif isinstance(value, dict):
            found += _factors(value, f"{full}.")
        elif isinstance(value, list) and value:
            found.append(Factor(full, tuple(value)))
        else:
            raise InputError(f"{full} = {value!r} does not vary: give a list, {{ from = 1.0, to = 2.0 }}, or {{ seeds = 10 }}")
    return found


def _factor(name: str, table: Mapping[str, Any]) -> Factor:
    if "seeds" in table:
        if len(table) > 1 or not is_whole(table["seeds"]) or not 1 <= table["seeds"] <= _MOST_RUNS:
            raise InputError(f"{name}: seeds = {table['seeds']!r} must be a whole number, 1 to {_MOST_RUNS}, and stand alone")
        factor = Factor(name, tuple(range(table["seeds"])))
        if not factor.is_seed:
            raise InputError(f"{name} is no seed: {{ seeds = N }} is for run.seed, or for a model's argument called seed")
        return factor
    if not {"from", "to"} <= set(table):
        raise InputError(f"{name}: a range has from and to, such as {{ from = 1.0, to = 2.0 }}")
    for entry in ("from", "to"):
        if not isinstance(table[entry], int | float) or isinstance(table[entry], bool):
            raise InputError(f"{name}: {entry} = {table[entry]!r} must be a number")
    if not isinstance(table.get("logarithmic", False), bool):
        raise InputError(f"{name}: logarithmic = {table['logarithmic']!r} must be true or false")
    factor = Factor(name, (), float(table["from"]), float(table["to"]), table.get("logarithmic", False))
    if "steps" not in table:
        return factor
    if not is_whole(table["steps"]) or not 2 <= table["steps"] <= _MOST_RUNS:
        raise InputError(f"{name}: steps = {table['steps']!r} must be a whole number, 2 to {_MOST_RUNS}")
    return Factor(name, tuple(factor.at(share) for share in np.linspace(0.0, 1.0, table["steps"]).tolist()))


def _setting(name: str, value: Any) -> Setting:
    variable, at, seconds = name.partition("@")
    numbers = value if isinstance(value, list | tuple) else [value]
    if not numbers or not all(isinstance(each, int | float) and np.isfinite(each) for each in numbers):
        raise InputError(f"plant.{name} = {value!r} must be a finite number, or a list of them")
    return Setting.parse(f"{variable}={','.join(str(float(each)) for each in numbers)}{at}{seconds}")


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in table.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat
