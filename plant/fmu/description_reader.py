"""The description of an FMU for Co-Simulation, of FMI 2.0 or 3.0, read by FMPy."""

import itertools
import re
import stat
import unicodedata
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from difflib import get_close_matches
from math import prod
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.checks import printable
from plant.errors import FmuError, InputError, UnknownNameError
from plant.files import most_unpacked

_FLOAT, _INTEGER = np.dtype(np.float64), np.dtype(np.int32)
_SIZED = [f"{sign}{bits}" for sign in ("Int", "UInt") for bits in (8, 16, 32, 64)]
_TYPES: dict[int, dict[str, tuple[str, np.dtype[Any]]]] = {
    2: {
        "Real": ("Real", _FLOAT),
        "Integer": ("Integer", _INTEGER),
        "Enumeration": ("Integer", _INTEGER),
        "Boolean": ("Boolean", _INTEGER),
    },
    3: {
        "Float64": ("Float64", _FLOAT),
        "Float32": ("Float32", np.dtype(np.float32)),
        "Enumeration": ("Int64", np.dtype(np.int64)),
        "Boolean": ("Boolean", np.dtype(np.bool_)),
        **{name: (name, np.dtype(name.lower())) for name in _SIZED},
    },
}
"""The ending of the functions' names and their number type, by FMI version and type of the variable."""

_ELEMENT = re.compile(r"(.+)\[(\d+(?:, ?\d+)*)\]")

_MOST_ELEMENTS = 1_000_000
"""The most elements of one variable."""


@dataclass(frozen=True)
class FmuVariable:
    """A variable of an FMU. In FMI 2.0, the scalars `name[1]`, `name[2]`, ... also form an array `name`."""

    name: str
    shape: tuple[int, ...]
    type: str
    causality: str
    variability: str
    unit: str | None
    limits: tuple[tuple[float, float], ...]  # of each scalar
    startable: bool  # before initialisation
    references: tuple[int, ...]  # row by row
    ending: str  # of its functions' names, such as Float64; "" if it is no number
    dtype: np.dtype[Any]  # of these functions' values

    @property
    def size(self) -> int:
        """The number of scalars."""
        return prod(self.shape)

    @property
    def minimum(self) -> float:
        """The least of all scalars."""
        return min((least for least, _ in self.limits), default=-np.inf)

    @property
    def maximum(self) -> float:
        """The greatest of all scalars."""
        return max((most for _, most in self.limits), default=np.inf)

    @property
    def element_names(self) -> list[str]:
        """The names of its scalars in FMI 2.0."""
        return element_names(self.name, self.shape)

    @property
    def real(self) -> bool:
        """Whether its values are double-precision numbers."""
        return self.dtype == _FLOAT and bool(self.ending)

    @property
    def tunable(self) -> bool:
        """Whether it may be set during a run."""
        return self.causality == "input" or (self.causality == "parameter" and self.variability == "tunable")

    def values(self, given: ArrayLike, owner: str, spread: bool = False) -> NDArray[Any]:
        """Values (size,) of this variable's type; with `spread`, one number may stand for all elements.

        Raises:
            InputError: no numbers, numbers of another type, or too few or too many.
        """
        if not self.ending:
            raise InputError(f"{self.name} of {owner} is a {self.type} and takes no numbers")
        try:
            numbers = np.array(given, np.float64).reshape(-1)
        except (TypeError, ValueError, OverflowError):
            raise InputError(f"{self.name} of {owner} must be numbers, got {given!r}") from None
        if spread and numbers.size == 1:
            numbers = np.repeat(numbers, self.size)
        if numbers.size != self.size:
            raise InputError(f"{self.name} of {owner} has {self.size} elements, got {numbers.size}")
        if self.dtype.kind == "f":
            return numbers.astype(self.dtype)
        switch = self.type == "Boolean"
        whole = np.isin(numbers, (0.0, 1.0)) if switch else numbers == np.rint(numbers)
        if not whole.all():
            raise InputError(f"{self.name} of {owner} must be {'true or false' if switch else 'whole numbers'}, got {given!r}")
        return numbers.astype(self.dtype)


def element_names(name: str, shape: tuple[int, ...]) -> list[str]:
    """The names of an array's elements in FMI 2.0, row by row and counted from 1."""
    if not shape:
        return [name]
    name, closing = (name[:-1], ")") if name.startswith("der(") else (name, "")
    indices = itertools.product(*(range(1, n + 1) for n in shape))
    return [f"{name}[{','.join(str(i) for i in index)}]{closing}" for index in indices]


class FmuDescription:
    """The checked description of an FMU.

    Attributes:
        version: 2 or 3.
        co_simulation, experiment: FMPy's descriptions; `experiment` may be None.
        abilities: in Co-Simulation, by FMI's names.
        token: instantiation token, or GUID.
        states: each exposed continuous state with its derivative.

    Raises:
        FmuError: the file is no FMU, or of another kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            raise FmuError(f"{path} is a folder: name the FMU's file")
        try:
            _check_archive(path)
            read = fmpy.read_model_description(str(path), validate=True)
        except FileNotFoundError:
            raise FmuError(f"there is no FMU at {path}") from None
        except FmuError:
            raise
        except Exception as error:
            raise FmuError(f"{path} is not a usable FMU: {printable(' '.join(str(error).split()))}") from None
        if not str(read.fmiVersion).startswith(("2.", "3.")):
            raise FmuError(f"{path.name} is of FMI {read.fmiVersion}, not 2.0 or 3.0: export it for one of these")
        if read.coSimulation is None:
            raise FmuError(f"{path.name} is not for Co-Simulation: export it for that, with its solver inside")
        self.version = int(str(read.fmiVersion)[0])
        self.co_simulation, self.experiment, self.token, self.tool = (
            read.coSimulation, read.defaultExperiment, read.guid, read.generationTool,
        )  # fmt: skip
        with zipfile.ZipFile(path) as archive:
            # FMPy omits some abilities of FMI 3.0.
            root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        _check_texts(path, root)
        element = root.find("CoSimulation")
        abilities = {} if element is None else element.attrib
        self.abilities = frozenset(name for name, value in abilities.items() if value in ("true", "1"))
        self._variables = {each.name: self._variable(each) for each in read.modelVariables}
        derivatives = {each.name: each.derivative.name for each in read.modelVariables if each.derivative}
        self.states = tuple((self._variables[state], self._variables[rate]) for rate, state in derivatives.items())
        self._elements: dict[str, dict[tuple[int, ...], FmuVariable]] = {}
        for name, variable in self._variables.items():
            if variable.shape == () and (match := _ELEMENT.fullmatch(name)):
                indices = tuple(int(index) for index in match[2].split(","))
                self._elements.setdefault(match[1], {})[indices] = variable

    def __getitem__(self, name: str) -> FmuVariable:
        """The variable of this name, or the array whose elements all exist.

        Raises:
            UnknownNameError: there is none.
        """
        if found := self._find(name):
            return found
        near = get_close_matches(name, [*self._variables, *self._elements], 1)
        raise UnknownNameError(f"{self.path.name} has no variable {name!r}{f'; did you mean {near[0]}?' if near else ''}")

    @property
    def saves_state(self) -> bool:
        """Whether its state can be saved as bytes and restored."""
        can = self.co_simulation
        return bool(can.canGetAndSetFMUstate and can.canSerializeFMUstate)

    @property
    def differentiable(self) -> bool:
        """Whether it has directional derivatives."""
        return not self.abilities.isdisjoint(("providesDirectionalDerivative", "providesDirectionalDerivatives"))

    def __iter__(self) -> Iterator[FmuVariable]:
        """All variables in the order of the description."""
        return iter(self._variables.values())

    def __contains__(self, name: str) -> bool:
        return self._find(name) is not None

    def _find(self, name: str) -> FmuVariable | None:
        if name in self._variables or name not in self._elements:
            return self._variables.get(name)
        return _assembled(name, self._elements[name])

    def _variable(self, each: Any) -> FmuVariable:
        if not 0 <= prod(each.shape) <= _MOST_ELEMENTS:
            raise FmuError(
                f"{each.name} of {self.path.name} has {prod(each.shape)} elements, and may have {_MOST_ELEMENTS} at most: "
                "export a smaller one"
            )
        ending, dtype = _TYPES[self.version].get(each.type, ("", _FLOAT))
        limits = float(-np.inf if each.min is None else each.min), float(np.inf if each.max is None else each.max)
        startable = each.causality in ("input", "parameter") or each.initial in ("exact", "approx")
        unit = each.unit or (each.declaredType and each.declaredType.unit)
        return FmuVariable(
            each.name, tuple(each.shape), each.type, each.causality, each.variability, unit, (limits,) * prod(each.shape),
            startable and each.variability != "constant", (each.valueReference,), ending, dtype,
        )  # fmt: skip


def _assembled(name: str, elements: dict[tuple[int, ...], FmuVariable]) -> FmuVariable | None:
    """The array of these scalars, by indices from 1; None if one is missing or differs in kind."""
    if len({len(indices) for indices in elements}) > 1:
        return None
    shape = tuple(map(max, zip(*elements, strict=True)))
    if prod(shape) != len(elements):
        return None
    order = list(itertools.product(*(range(1, length + 1) for length in shape)))
    kinds = {(each.type, each.causality, each.variability, each.unit, each.startable) for each in elements.values()}
    if set(order) != set(elements) or len(kinds) > 1:
        return None
    scalars = [elements[indices] for indices in order]
    return replace(
        scalars[0],
        name=name,
        shape=shape,
        limits=tuple(each.limits[0] for each in scalars),
        references=tuple(each.references[0] for each in scalars),
    )


def _check_texts(path: Path, root: ElementTree.Element) -> None:
    """Check that names, units and other texts of a description do nothing to a terminal that shows them."""
    for element in root.iter():
        for name, value in element.attrib.items():
            if any(unicodedata.category(each) == "Cc" and each not in "\t\n\r" for each in value):
                raise FmuError(
                    f"{path} is not a usable FMU: {name} {printable(value)!r} in its description has control characters: "
                    "export it again"
                )


def _check_archive(path: Path) -> None:
    """Check what an FMU's archive claims, before it is unpacked; a `FmuError` if it would do harm or is ambiguous."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    names = [member.filename for member in members]
    outside = [name for name in names if name.startswith(("/", "\\")) or ".." in re.split(r"[/\\]", name) or name[1:2] == ":"]
    links = [each.filename for each in members if stat.S_ISLNK(each.external_attr >> 16)]
    locked = [each.filename for each in members if each.flag_bits & 1]
    found = {
        "leads out of its folder": outside,
        "is a link": links,
        "is encrypted": locked,
        "is in it twice": [name for i, name in enumerate(names) if name in names[:i]] if len(set(names)) < len(names) else [],
    }
    for what, wrong in found.items():
        if wrong:
            raise FmuError(f"{path} is not a usable FMU: its entry {wrong[0]!r} {what}: export it again")
    size, most = sum(member.file_size for member in members), most_unpacked(path.stat().st_size)
    if size > most:
        raise FmuError(
            f"{path} is not a usable FMU: it would unpack to {size / 1e6:.0f} MB, and may to {most / 1e6:.0f} MB for its size"
        )
