"""A loaded FMU for Co-Simulation, of FMI 2.0 or 3.0.

FMPy loads the library and changes the working directory meanwhile, so load FMUs before threads start.
"""

import contextlib
import ctypes
import itertools
import zipfile
import zlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Self

import fmpy
import fmpy.fmi2
import fmpy.fmi3
import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.checks import printable
from plant.errors import FmuError, InputError
from plant.files import temporary_folder
from plant.fmu.description_reader import FmuDescription, FmuVariable
from plant.pose import Array

OK, WARNING, DISCARD, ERROR, FATAL, PENDING, ASKS_TO_END, NEEDS_EVENTS, NOT_FINITE = range(9)
"""FMI's statuses, two for flags of `fmi3DoStep`, and one for values that are not finite."""

_ENDINGS = {
    WARNING: "gave a warning",
    DISCARD: "was discarded",
    ERROR: "failed",
    FATAL: "failed for good",
    PENDING: "continues in the background, and the loop does not wait for it",
    ASKS_TO_END: "asked for the end of the simulation",
    NEEDS_EVENTS: "met an event, which needs event mode: export the FMU so that it handles its events itself",
}
_MOST_MESSAGES = 100


class FmuInstance:
    """An FMU that is loaded by `start` and freed by `close`.

    Attributes:
        messages: the latest warnings and errors that the FMU has logged.
        folder: with the extracted files; removed by `close`, or after a crash when an FMU is next loaded.
        status: of its failure, after which FMI allows fewer calls.
    """

    def __init__(self, description: FmuDescription) -> None:
        self.description, self.path = description, description.path
        self.messages: deque[str] = deque(maxlen=_MOST_MESSAGES)
        self.folder = Path()
        self.status = OK
        self._initialized = self._closed = False
        self._cleanup = contextlib.ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def start(self, values: Iterable[tuple[FmuVariable, NDArray[Any]]] = ()) -> None:
        """Load the FMU, set start values, and initialise it at time 0.

        Raises:
            FmuError: it holds no binary for this machine, cannot be loaded, or refuses.
        """
        try:
            self.fmu = self._load()
            for variable, numbers in values:
                self._access("Set", variable, numbers)
            self.initialize()
        except BaseException:
            self.close()
            raise

    def initialize(self) -> None:
        """Initialise the FMU at time 0."""
        experiment = (False, 0.0, 0.0, False, 0.0)
        if self.description.version == 2:
            self._call("SetupExperiment", "the setup of the experiment", *experiment)
            self._call("EnterInitializationMode", "initialisation")
        else:
            self._call("EnterInitializationMode", "initialisation", *experiment)
        self._call("ExitInitializationMode", "initialisation")
        self._initialized = True

    def close(self) -> None:
        """Free the instance and remove the extracted files; a second call does nothing."""
        self._closed = True
        self._cleanup.close()

    def address(self, function: str) -> int:
        """The address of a C function such as `DoStep`."""
        return int(ctypes.cast(self._function(function), ctypes.c_void_p).value or 0)

    def component(self) -> int:
        """The address of the instance."""
        component = self.fmu.component
        return int(component if isinstance(component, int) else component.value)

    def get(self, name: str) -> NDArray[Any]:
        """The value of a number, in its own shape.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: the variable is no number.
            FmuError: the FMU refuses.
        """
        variable = self.description[name]
        if not variable.ending:
            raise InputError(f"{name} of {self.path.name} is a {variable.type} and no number")
        values = np.zeros(variable.size, variable.dtype)
        self._access("Get", variable, values)
        return values.reshape(variable.shape)

    def set(self, name: str, value: ArrayLike) -> None:
        """Set a number.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: the value has the wrong number of elements or the wrong type.
            FmuError: the FMU refuses.
        """
        variable = self.description[name]
        self._access("Set", variable, variable.values(value, self.path.name))

    def jacobian(self, unknowns: Sequence[FmuVariable], knowns: Sequence[FmuVariable]) -> Array:
        """The partial derivatives (m, n) of the unknowns' m scalars by the knowns' n.

        Raises:
            FmuError: the FMU lacks these derivatives.
            InputError: a variable is not real.
        """
        self._check_open()
        if not self.description.differentiable:
            raise FmuError(f"{self.path.name} has no directional derivatives: export it with them")
        for each in (*unknowns, *knowns):
            if not each.real:
                raise InputError(
                    f"{each.name} of {self.path.name} is of type {each.type} and has no derivatives: choose real variables"
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

    def do_step(self, time: float, duration: float) -> None:
        """Take a communication step from `time` [s]; `FmuError` if the FMU fails."""
        self._check_open()
        with self._calling("a step"):
            self.fmu.doStep(time, duration, not self.description.saves_state)

    def state(self) -> bytes:
        """The FMU's whole state; `FmuError` if it cannot save it."""
        self._check_saves()
        with self._calling("saving the state"):
            held = self.fmu.getFMUState()
            try:
                return bytes(self.fmu.serializeFMUState(held))
            finally:
                self.fmu.freeFMUState(held)

    def restore(self, state: bytes) -> None:
        """Return to a saved state; `FmuError` if the FMU cannot, or this is no state of it."""
        self._check_saves()
        with self._calling("restoring a state"):
            held = self.fmu.deserializeFMUState(state)
            try:
                self.fmu.setFMUState(held)
            finally:
                self.fmu.freeFMUState(held)

    def _failed(self, what: str, status: int) -> FmuError:
        """The error for an action that ended with a status, with the FMU's own reason."""
        self.status = status
        reason = self.messages[-1] if self.messages else "the FMU gives no reason"
        return FmuError(f"{self.path.name}: {what} {_ENDINGS.get(status, f'ended with status {status}')}: {reason}")

    def _check(self, status: int, what: str) -> None:
        if status != OK:
            raise self._failed(what, status)

    def _check_open(self) -> None:
        if self._closed:
            raise FmuError(f"{self.path.name} has been closed: load it again")

    def _check_saves(self) -> None:
        self._check_open()
        if not self.description.saves_state:
            raise FmuError(f"{self.path.name} cannot save its state: export it with canSerializeFMUState")

    @contextlib.contextmanager
    def _calling(self, what: str) -> Any:
        try:
            yield
        except fmpy.fmi1.FMICallException as error:
            raise self._failed(what, error.status) from None

    def _function(self, name: str) -> Any:
        return getattr(self.fmu.dll, f"fmi{self.description.version}{name}")

    def _call(self, name: str, what: str, *arguments: Any) -> None:
        self._check(self._function(name)(self.fmu.component, *arguments), what)

    def _access(self, verb: str, variable: FmuVariable, values: NDArray[Any]) -> None:
        self._check_open()
        function = self._function(f"{verb}{variable.ending}")
        references = np.array(variable.references, np.uint32)
        at, into = references.ctypes.data_as(function.argtypes[1]), values.ctypes.data_as(function.argtypes[3])
        sizes = [] if self.description.version == 2 else [values.size]
        status = function(self.fmu.component, at, references.size, into, *sizes)
        self._check(status, f"{verb.lower()}ting {variable.name}")

    def _load(self) -> Any:
        description, name = self.description, self.path.name
        identifier = description.co_simulation.modelIdentifier
        platform = fmpy.platform if description.version == 2 else fmpy.platform_tuple
        self.folder = self._cleanup.enter_context(temporary_folder("gough-fmu-"))
        try:
            with zipfile.ZipFile(self.path) as archive:
                for member in archive.namelist():
                    if not member.startswith(("sources/", "documentation/")):
                        archive.extract(member, self.folder)
        except (zipfile.BadZipFile, zlib.error, OSError) as error:
            raise FmuError(f"{name} is not a usable FMU: {error}") from None
        if not (self.folder / "binaries" / platform / f"{identifier}{fmpy.sharedLibraryExtension}").is_file():
            raise FmuError(f"{name} holds no binary for {platform}: build it for this machine")
        try:
            # When FMPy cannot load the library, it stays in the library's folder.
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
            tool = f" (it needs {description.tool or 'its tool'} on this machine)"
            needed = tool if description.co_simulation.needsExecutionTool else ""
            raise FmuError(f"{name} cannot be loaded: {reason}{needed}") from None
        self._cleanup.callback(self._free, fmu)
        return fmu

    def _free(self, fmu: Any) -> None:
        if self._initialized and self.status < ERROR:
            self._function("Terminate")(fmu.component)
        if self.status != FATAL:
            fmu.freeInstance()

    def _callbacks(self) -> Any:
        """The callbacks of FMI 2.0; FMPy's proxy fills in the placeholders of messages."""
        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = _LOG_2
        callbacks.allocateMemory = fmpy.fmi2.defaultCallbacks.allocateMemory
        callbacks.freeMemory = fmpy.fmi2.defaultCallbacks.freeMemory
        callbacks.componentEnvironment = next(_NUMBERS)
        _LOGS[callbacks.componentEnvironment] = self._log
        self._cleanup.callback(_LOGS.pop, callbacks.componentEnvironment)
        # Some processors have no proxy.
        with contextlib.suppress(AttributeError):
            fmpy.fmi2.addLoggerProxy(ctypes.byref(callbacks))
        return callbacks

    def _logged(self, environment: object, status: int, category: bytes, message: bytes) -> None:
        del environment, category
        self._log(status, message)

    def _log(self, status: int, message: bytes | None) -> None:
        if status:
            self.messages.append(printable(" ".join((message or b"").decode("utf-8", "replace").split())))


_LOGS: dict[int, Callable[[int, bytes | None], None]] = {}
"""The loggers of all FMI 2.0 instances by their number, because FMPy's proxy has only one logger."""

_NUMBERS = itertools.count(1)


def _log_2(environment: int | None, name: bytes, status: int, category: bytes, message: bytes) -> None:
    del name, category
    log = _LOGS.get(environment or 0) or next(reversed(_LOGS.values()), None)
    if log is not None:
        log(status, message)


_LOG_2 = fmpy.fmi2.fmi2CallbackLoggerTYPE(_log_2)
