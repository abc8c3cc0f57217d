"""FMUs for Co-Simulation, of FMI 2.0 and 3.0 alike: what one says of itself, and one that is loaded.

FMPy reads the description and loads the library; it changes the working directory meanwhile, so load FMUs before threads
start.
"""

import contextlib
import ctypes
import itertools
import re
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
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

from plant.errors import FmuError, InputError, UnknownNameError
from plant.files import temporary_folder
from plant.pose import Array

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
"""By FMI's version and a variable's type: how its functions' names end, and what they take."""

OK, WARNING, DISCARD, ERROR, FATAL, PENDING, ASKS_TO_END, NEEDS_EVENTS = range(8)
"""FMI's statuses, and two that stand for flags of `fmi3DoStep`."""

_ENDINGS = {
    WARNING: "gave a warning",
    DISCARD: "was discarded",
    ERROR: "failed",
    FATAL: "failed for good",
    PENDING: "goes on in the background, for which the loop does not wait",
    ASKS_TO_END: "asked for the end of the simulation",
    NEEDS_EVENTS: "met an event, which needs event mode: export the FMU so that it handles its events itself",
}
_MOST_MESSAGES = 100
_ELEMENT = re.compile(r"(.+)\[(\d+(?:, ?\d+)*)\]")


@dataclass(frozen=True)
class FmuVariable:
    """A variable of an FMU; in FMI 2.0 also the scalars `name[1,1]`, `name[1,2]`, ... together, as the array that they are.

    Attributes:
        name: in the FMU.
        shape: () for a scalar.
        type, causality, variability: as FMI names them.
        unit: None if the FMU declares none.
        limits: least and greatest value of each scalar, as the FMU declares them.
        startable: whether it may be set before initialisation.
        references: value references, of an array's scalars row by row.
        ending: how the names of its functions end, such as Float64 in `fmi3GetFloat64`; "" if it is no number.
        dtype: what these take.
    """

    name: str
    shape: tuple[int, ...]
    type: str
    causality: str
    variability: str
    unit: str | None
    limits: tuple[tuple[float, float], ...]
    startable: bool
    references: tuple[int, ...]
    ending: str
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        """The number of scalars."""
        return prod(self.shape)

    @property
    def minimum(self) -> float:
        """The least value that any of its scalars may have."""
        return min((least for least, _ in self.limits), default=-np.inf)

    @property
    def maximum(self) -> float:
        """The greatest value that any of its scalars may have."""
        return max((most for _, most in self.limits), default=np.inf)

    @property
    def element_names(self) -> list[str]:
        """The names of its scalars, counted from 1 and row by row as in FMI 2.0."""
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
        """Values (size,) for this variable, of its own type.

        Args:
            given: the values, in any shape.
            owner: the FMU's file, for messages.
            spread: whether one number will do for all elements.

        Raises:
            InputError: they are no numbers, or not of this type, or not that many.
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
        whole, needed = numbers == np.rint(numbers), "whole numbers"
        if self.type == "Boolean":
            whole, needed = np.isin(numbers, (0.0, 1.0)), "true or false"
        if not whole.all():
            raise InputError(f"{self.name} of {owner} must be {needed}, got {given!r}")
        return numbers.astype(self.dtype)


def element_names(name: str, shape: tuple[int, ...]) -> list[str]:
    """The names of an array's elements in FMI 2.0, row by row and counted from 1; of a scalar its own name."""
    if not shape:
        return [name]
    name, closing = (name[:-1], ")") if name.startswith("der(") else (name, "")
    indices = itertools.product(*(range(1, n + 1) for n in shape))
    return [f"{name}[{','.join(str(i) for i in index)}]{closing}" for index in indices]


class FmuDescription:
    """What an FMU says of itself, checked.

    Args:
        path: the FMU.

    Attributes:
        version: 2 or 3.
        co_simulation, experiment: FMPy's descriptions; `experiment` may be None.
        abilities: in Co-Simulation, by FMI's names.
        token: that goes with the binary.
        states: each continuous state that it shows, and the derivative of that.

    Raises:
        FmuError: the file is no FMU, or of another kind.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            raise FmuError(f"{path} is a folder: name the FMU's file")
        try:
            read = fmpy.read_model_description(str(path), validate=True)
        except FileNotFoundError:
            raise FmuError(f"there is no FMU at {path}") from None
        except Exception as error:
            raise FmuError(f"{path} is not a usable FMU: {' '.join(str(error).split())}") from None
        if not str(read.fmiVersion).startswith(("2.", "3.")):
            raise FmuError(f"{path.name} is of FMI {read.fmiVersion}, not 2.0 or 3.0: export it for one of these")
        if read.coSimulation is None:
            raise FmuError(f"{path.name} is not for Co-Simulation: export it for that, with its solver inside")
        self.version = int(str(read.fmiVersion)[0])
        self.co_simulation, self.experiment, self.token, self.tool = (
            read.coSimulation, read.defaultExperiment, read.guid, read.generationTool,
        )  # fmt: skip
        with zipfile.ZipFile(path) as archive:
            # FMPy does not tell all of them for FMI 3.0.
            element = ElementTree.fromstring(archive.read("modelDescription.xml")).find("CoSimulation")
        self.abilities = frozenset(
            name for name, value in ({} if element is None else element).items() if value in ("true", "1")
        )
        self._variables = {each.name: self._variable(each) for each in read.modelVariables}
        self._elements: dict[str, dict[tuple[int, ...], FmuVariable]] = {}
        self.states = tuple(
            (self._variables[each.derivative.name], self._variables[each.name])
            for each in read.modelVariables
            if each.derivative
        )
        for name, variable in self._variables.items():
            if variable.shape == () and (match := _ELEMENT.fullmatch(name)):
                indices = tuple(int(index) for index in match[2].split(","))
                self._elements.setdefault(match[1], {})[indices] = variable

    def __getitem__(self, name: str) -> FmuVariable:
        """The variable of this name, or the array of which there are all elements.

        Raises:
            UnknownNameError: there is none.
        """
        if name in self._variables:
            return self._variables[name]
        if name in self._elements and (whole := _assembled(name, self._elements[name])):
            return whole
        near = get_close_matches(name, [*self._variables, *self._elements], 1)
        raise UnknownNameError(f"{self.path.name} has no variable {name!r}{f'; did you mean {near[0]}?' if near else ''}")

    @property
    def saves_state(self) -> bool:
        """Whether its state can be saved as bytes, and restored."""
        can = self.co_simulation
        return bool(can.canGetAndSetFMUstate and can.canSerializeFMUstate)

    @property
    def differentiable(self) -> bool:
        """Whether it has directional derivatives."""
        return not self.abilities.isdisjoint(("providesDirectionalDerivative", "providesDirectionalDerivatives"))

    def __iter__(self) -> Iterator[FmuVariable]:
        """All variables as they are listed."""
        return iter(self._variables.values())

    def __contains__(self, name: str) -> bool:
        return name in self._variables or (name in self._elements and _assembled(name, self._elements[name]) is not None)

    def _variable(self, each: Any) -> FmuVariable:
        ending, dtype = _TYPES[self.version].get(each.type, ("", _FLOAT))
        limits = float(-np.inf if each.min is None else each.min), float(np.inf if each.max is None else each.max)
        startable = each.causality in ("input", "parameter") or each.initial in ("exact", "approx")
        return FmuVariable(
            each.name, tuple(each.shape), each.type, each.causality, each.variability, each.unit or _declared_unit(each),
            (limits,) * prod(each.shape), startable and each.variability != "constant", (each.valueReference,), ending, dtype,
        )  # fmt: skip


def _declared_unit(variable: Any) -> str | None:
    return variable.declaredType.unit if variable.declaredType is not None else None


def _assembled(name: str, elements: dict[tuple[int, ...], FmuVariable]) -> FmuVariable | None:
    """The array of these scalars by their indices from 1, if none is missing and all are alike."""
    first = next(iter(elements.values()))
    if len({len(indices) for indices in elements}) > 1:
        return None
    shape = tuple(map(max, zip(*elements, strict=True)))
    order = list(itertools.product(*(range(1, length + 1) for length in shape)))
    if set(order) != set(elements):
        return None
    kinds = {(each.type, each.causality, each.variability, each.unit, each.startable) for each in elements.values()}
    if len(kinds) > 1:
        return None
    scalars = [elements[indices] for indices in order]
    return replace(
        first,
        name=name,
        shape=shape,
        limits=tuple(each.limits[0] for each in scalars),
        references=tuple(each.references[0] for each in scalars),
    )


class FmuInstance:
    """An FMU that is loaded and instantiated, until it is closed.

    Args:
        description: of the FMU.

    Attributes:
        messages: the last that the FMU has logged, but for those that say that all is well.
        folder: where it has been extracted to.
        initialized: whether initialisation has ended.
        status: how it has failed; FMI allows less to be called then.

    Raises:
        FmuError: it holds no binary for this machine, or cannot be loaded.
    """

    def __init__(self, description: FmuDescription) -> None:
        self.description = description
        self.messages: deque[str] = deque(maxlen=_MOST_MESSAGES)
        self.folder = Path()
        self.initialized = self.closed = False
        self.status = OK
        self._cleanup = contextlib.ExitStack()
        try:
            self.fmu = self._load()
        except BaseException:
            self._cleanup.close()
            raise

    def close(self) -> None:
        """Free the instance and remove what was extracted; closing twice does no harm."""
        self.closed = True
        self._cleanup.close()

    def check_open(self) -> None:
        """Check that it has not been closed.

        Raises:
            FmuError: it has.
        """
        if self.closed:
            raise FmuError(f"{self.description.path.name} has been closed: load it again")

    def address(self, function: str) -> int:
        """Of a C function, without its prefix, such as `DoStep`."""
        return int(ctypes.cast(self._function(function), ctypes.c_void_p).value or 0)

    def component(self) -> int:
        """The address of the instance."""
        component = self.fmu.component
        return int(component if isinstance(component, int) else component.value)

    def initialize(self) -> None:
        """Set up the experiment from time 0, and go through initialisation.

        Raises:
            FmuError: the FMU refuses.
        """
        if self.description.version == 2:
            self._check(self._call("SetupExperiment", 0, 0.0, 0.0, 0, 0.0), "the setup of the experiment")
            self._check(self._call("EnterInitializationMode"), "initialisation")
        else:
            self._check(self._call("EnterInitializationMode", False, 0.0, 0.0, False, 0.0), "initialisation")
        self._check(self._call("ExitInitializationMode"), "initialisation")
        self.initialized = True

    def get(self, variable: FmuVariable) -> NDArray[Any]:
        """The values of a variable, in its own shape.

        Raises:
            FmuError: the FMU refuses.
        """
        if not variable.ending:
            raise InputError(f"{variable.name} of {self.description.path.name} is a {variable.type} and no number")
        values = np.zeros(variable.size, variable.dtype)
        self._access("Get", variable, values)
        return values.reshape(variable.shape)

    def set(self, variable: FmuVariable, values: NDArray[Any]) -> None:
        """Set a variable to values (size,) of its own type.

        Raises:
            FmuError: the FMU refuses.
        """
        self._access("Set", variable, values)

    def jacobian(self, unknowns: Sequence[FmuVariable], knowns: Sequence[FmuVariable]) -> Array:
        """The partial derivatives (m, n) of the unknowns' m scalars by the knowns' n, from the FMU's directional derivatives.

        Raises:
            FmuError: the FMU has none, or not these.
            InputError: a variable is no real.
        """
        self.check_open()
        if not self.description.differentiable:
            raise FmuError(f"{self.description.path.name} has no directional derivatives: export it with them")
        for each in (*unknowns, *knowns):
            if not each.real:
                raise InputError(
                    f"{each.name} of {self.description.path.name} is of type {each.type} and has no derivatives: choose real "
                    "variables"
                )
        rows, columns = sum(each.size for each in unknowns), sum(each.size for each in knowns)
        jacobian, seed, product = np.zeros((rows, columns)), np.zeros(columns), np.zeros(rows)
        function = self._function("GetDirectionalDerivative")
        arguments: list[Any] = []
        for side in (unknowns, knowns):
            references = [reference for each in side for reference in each.references]
            arguments += [(function.argtypes[1]._type_ * len(references))(*references), len(references)]
        for vector in (seed, product):
            arguments.append(vector.ctypes.data_as(ctypes.POINTER(ctypes.c_double)))
            if self.description.version == 3:
                arguments.append(vector.size)
        for column in range(columns):
            seed[:] = 0.0
            seed[column] = 1.0
            self._check(function(self.fmu.component, *arguments), "a directional derivative")
            jacobian[:, column] = product
        return jacobian

    def step(self, time: float, duration: float) -> None:
        """Take a communication step from `time` [s].

        Raises:
            FmuError: the FMU fails.
        """
        self.check_open()
        with self._calling("a step"):
            self.fmu.doStep(time, duration, not self.description.saves_state)

    def state(self) -> bytes:
        """The FMU's whole state.

        Raises:
            FmuError: the FMU cannot save it.
        """
        self._check_saves()
        with self._calling("saving the state"):
            held = self.fmu.getFMUState()
            try:
                return bytes(self.fmu.serializeFMUState(held))
            finally:
                self.fmu.freeFMUState(held)

    def restore(self, state: bytes) -> None:
        """Go back to a state.

        Raises:
            FmuError: the FMU cannot, or it is no state of this FMU.
        """
        self._check_saves()
        with self._calling("restoring a state"):
            held = self.fmu.deserializeFMUState(state)
            try:
                self.fmu.setFMUState(held)
            finally:
                self.fmu.freeFMUState(held)

    def failure(self, what: str, status: int) -> FmuError:
        """The error that says how `what` has ended, in the FMU's own words."""
        self.status = status
        reason = self.messages[-1] if self.messages else "the FMU gives no reason"
        return FmuError(f"{self.description.path.name}: {what} {_ENDINGS.get(status, f'ended with status {status}')}: {reason}")

    def _check(self, status: int, what: str) -> None:
        if status != OK:
            raise self.failure(what, status)

    def _check_saves(self) -> None:
        self.check_open()
        if not self.description.saves_state:
            raise FmuError(f"{self.description.path.name} cannot save its state: export it with canSerializeFMUState")

    @contextlib.contextmanager
    def _calling(self, what: str) -> Any:
        try:
            yield
        except fmpy.fmi1.FMICallException as error:
            raise self.failure(what, error.status) from None

    def _function(self, name: str) -> Any:
        return getattr(self.fmu.dll, f"fmi{self.description.version}{name}")

    def _call(self, name: str, *arguments: Any) -> int:
        return int(self._function(name)(self.fmu.component, *arguments))

    def _access(self, verb: str, variable: FmuVariable, values: NDArray[Any]) -> None:
        self.check_open()
        function = self._function(f"{verb}{variable.ending}")
        references = np.array(variable.references, np.uint32)
        pointers = [
            array.ctypes.data_as(kind) for array, kind in ((references, function.argtypes[1]), (values, function.argtypes[3]))
        ]
        sizes = [] if self.description.version == 2 else [values.size]
        status = function(self.fmu.component, pointers[0], references.size, pointers[1], *sizes)
        self._check(status, f"{verb.lower()}ting {variable.name}")

    def _load(self) -> Any:
        description, name = self.description, self.description.path.name
        identifier = description.co_simulation.modelIdentifier
        platform = fmpy.platform if description.version == 2 else fmpy.platform_tuple
        self.folder = self._cleanup.enter_context(temporary_folder("gough-fmu-"))
        try:
            with zipfile.ZipFile(description.path) as archive:
                for member in archive.namelist():
                    if not member.startswith(("sources/", "documentation/")):
                        archive.extract(member, self.folder)
        except (zipfile.BadZipFile, zlib.error, OSError) as error:
            raise FmuError(f"{name} is not a usable FMU: {error}") from None
        if not (self.folder / "binaries" / platform / f"{identifier}{fmpy.sharedLibraryExtension}").is_file():
            raise FmuError(f"{name} holds no binary for {platform}: build it for this machine")
        try:
            # FMPy stays in the library's folder when it cannot load it.
            with contextlib.chdir("."):
                kind = fmpy.fmi2.FMU2Slave if description.version == 2 else fmpy.fmi3.FMU3Slave
                fmu = kind(
                    guid=description.token, unzipDirectory=str(self.folder), modelIdentifier=identifier, instanceName="plant"
                )
            if description.version == 2:
                fmu.instantiate(loggingOn=True, callbacks=self._callbacks())
            else:
                fmu.instantiate(loggingOn=True, logMessage=self._logged)
        except Exception as error:
            reason = self.messages[-1] if self.messages else error
            needed = (
                f" (it needs {description.tool or 'its tool'} on this machine)"
                if description.co_simulation.needsExecutionTool
                else ""
            )
            raise FmuError(f"{name} cannot be loaded: {reason}{needed}") from None
        self._cleanup.callback(self._free, fmu)
        return fmu

    def _free(self, fmu: Any) -> None:
        if self.initialized and self.status < ERROR:
            self._call("Terminate")
        if self.status != FATAL:
            fmu.freeInstance()

    def _callbacks(self) -> Any:
        """What FMI 2.0 wants of its importer; FMPy's proxy fills in the placeholders of messages."""
        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = _LOG_2
        callbacks.allocateMemory = fmpy.fmi2.defaultCallbacks.allocateMemory
        callbacks.freeMemory = fmpy.fmi2.defaultCallbacks.freeMemory
        callbacks.componentEnvironment = next(_NUMBERS)
        _LOGS[callbacks.componentEnvironment] = self._log
        self._cleanup.callback(_LOGS.pop, callbacks.componentEnvironment)
        # There is none for some processors.
        with contextlib.suppress(AttributeError):
            fmpy.fmi2.addLoggerProxy(ctypes.byref(callbacks))
        return callbacks

    def _logged(self, environment: object, status: int, category: bytes, message: bytes) -> None:
        del environment, category
        self._log(status, message)

    def _log(self, status: int, message: bytes | None) -> None:
        if status:
            self.messages.append(" ".join((message or b"").decode("utf-8", "replace").split()))


_LOGS: dict[int, Callable[[int, bytes | None], None]] = {}
"""Of the FMI 2.0 instances that there are, by the number that they give back: FMPy's proxy knows only one logger."""

_NUMBERS = itertools.count(1)


def _log_2(environment: int | None, name: bytes, status: int, category: bytes, message: bytes) -> None:
    del name, category
    log = _LOGS.get(environment or 0) or next(reversed(_LOGS.values()), None)
    if log is not None:
        log(status, message)


_LOG_2 = fmpy.fmi2.fmi2CallbackLoggerTYPE(_log_2)
