"""Running a plant FMU: checked when it is loaded, then called from compiled code by the addresses of its C functions.

FMPy reads the description and loads the library; it changes the working directory meanwhile, so load plants before
threads start.
"""

import contextlib
import ctypes
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any

import fmpy
import fmpy.fmi3
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import ArrayLike, NDArray

from plant.compiled import Record, kernel
from plant.errors import FmuError, InputError, UnknownNameError
from plant.pose import Array
from plant.variables import BY_NAME, IMU_COUNT, Variable

_IMU_OUTPUTS = ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field")
_TRUTH_OUTPUTS = ("position", "quaternion", "leg_length", "current")
_REQUIRED = (*_IMU_OUTPUTS, *_TRUTH_OUTPUTS, "velocity_command", "drive_mode")

CALLS = np.dtype(
    [
        ("instance", np.int64),
        ("get", np.int64),
        ("set", np.int64),
        ("set_enumeration", np.int64),
        ("step", np.int64),
        ("time", np.float64),
        ("imu_references", np.uint32, len(_IMU_OUTPUTS)),
        ("truth_references", np.uint32, len(_TRUTH_OUTPUTS)),
        ("command_reference", np.uint32, 1),
        ("mode_reference", np.uint32, 1),
        ("payload_reference", np.uint32, 1),
        ("imu", np.float64, (len(_IMU_OUTPUTS), IMU_COUNT, 3)),
        ("truth", np.float64, sum(BY_NAME[name].size for name in _TRUTH_OUTPUTS)),
        ("mode", np.int64, 6),
        ("payload", np.float64, 1),
        ("reached", np.float64, 1),
        ("flags", np.uint8, 3),
    ],
    align=True,
)
"""One FMU as compiled code sees it: addresses, value references, and the buffers it reads into and writes from.

`imu` is angular velocity, specific force, magnetic field of the seven IMUs; `truth` is position (3), quaternion (4),
leg lengths (6) and currents (6).
"""


class FmuPlant:
    """An FMI 3.0 Co-Simulation FMU with the variables of `plant.variables`, initialised and ready to step.

    Args:
        path: the FMU.
        parameters: start values by name; a name that the FMU does not have is an error.
        period: communication step [s].

    Attributes:
        calls: the structured array (dtype `CALLS`) for `read_imus`, `read_truth`, `write_command` and `advance`.
        messages: what the FMU has logged.
        folder: where it has been extracted to; removed by `close`, and for whoever survives a crash to remove.

    Raises:
        FmuError: the file is no FMU, is of another kind, lacks variables, has them in another shape or type, holds no
            binary for this machine, or refuses its parameters.
        InputError: a period that the FMU cannot take.
    """

    def __init__(self, path: Path | str, parameters: Mapping[str, ArrayLike], period: float) -> None:
        self.path = Path(path)
        self.messages: list[str] = []
        self.folder = Path()
        self.calls: Record = np.zeros((), CALLS)
        self._description = _read_description(self.path)
        self._variables = {variable.name: variable for variable in self._description.modelVariables}
        self._check_variables()
        self._check_period(period)
        self._cleanup = contextlib.ExitStack()
        self._closed = False
        try:
            self._fmu = self._load()
            self._initialize(parameters)
        except BaseException:
            self._cleanup.close()
            raise

    def __enter__(self) -> "FmuPlant":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def close(self) -> None:
        """Free the instance and remove what was extracted; closing twice does no harm."""
        self._closed = True
        self._cleanup.close()

    def get(self, name: str) -> Array:
        """The value of a Float64 variable, in its own shape.

        Raises:
            UnknownNameError: the FMU has no such variable.
            FmuError: the FMU refuses.
        """
        variable = self._known(name)
        values = np.zeros(_size_of(variable))
        reference = np.array([variable.valueReference], np.uint32)
        self._call("fmi3GetFloat64", _pointer(reference, ctypes.c_uint32), 1, _pointer(values, ctypes.c_double), values.size)
        return values.reshape([int(dimension.start) for dimension in variable.dimensions])

    def set(self, name: str, value: ArrayLike) -> None:
        """Set a Float64 or enumeration variable.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: the value has the wrong number of elements.
            FmuError: the FMU refuses.
        """
        variable = self._known(name)
        discrete = variable.type == "Enumeration"
        try:
            numbers = np.array(value, np.float64).reshape(-1)
        except (TypeError, ValueError):
            raise InputError(f"{name} of {self.path.name} must be numbers, got {value!r}") from None
        values = numbers.astype(np.int64) if discrete else numbers
        if discrete and (values != numbers).any():
            raise InputError(f"{name} of {self.path.name} must be whole numbers, got {value!r}")
        if values.size != _size_of(variable):
            raise InputError(f"{name} of {self.path.name} has {_size_of(variable)} elements, got {values.size}")
        reference = np.array([variable.valueReference], np.uint32)
        function, c_type = ("fmi3SetInt64", ctypes.c_int64) if discrete else ("fmi3SetFloat64", ctypes.c_double)
        self._call(function, _pointer(reference, ctypes.c_uint32), 1, _pointer(values, c_type), values.size)

    def step(self, duration: float) -> None:
        """Advance by `duration` [s].

        Raises:
            FmuError: the FMU reports a failure.
        """
        self._check_open()
        if advance(self.calls, duration):
            raise self.failure("a step failed")

    def failure(self, what: str) -> FmuError:
        """The error that says what went wrong in the FMU's own words."""
        return FmuError(f"{self.path.name}: {what}: {self.messages[-1] if self.messages else 'the FMU gives no reason'}")

    def _check_open(self) -> None:
        if self._closed:
            raise FmuError(f"{self.path.name} has been closed: load it again")

    def _known(self, name: str) -> Any:
        self._check_open()
        try:
            return self._variables[name]
        except KeyError:
            raise UnknownNameError(f"{self.path.name} has no variable {name!r}") from None

    def _check_variables(self) -> None:
        problems = []
        for name in _REQUIRED:
            expected = BY_NAME[name]
            if name not in self._variables:
                problems.append(f"lacks {name}{list(expected.shape)}")
                continue
            actual = self._variables[name]
            shape = tuple(int(dimension.start or 0) for dimension in actual.dimensions)
            if shape != expected.shape or actual.type != _type_of(expected) or actual.causality != expected.causality:
                problems.append(
                    f"has {name} as {actual.causality} {actual.type}{list(shape)} instead of "
                    f"{expected.causality} {_type_of(expected)}{list(expected.shape)}"
                )
        if problems:
            raise FmuError(f"{self.path.name} {'; '.join(problems)}")

    def _check_period(self, period: float) -> None:
        if not 0.0 < period < inf:
            raise InputError(f"{self.path.name} cannot take a step of {period:g} s; it must be positive and finite")
        co_simulation = self._description.coSimulation
        if co_simulation.canHandleVariableCommunicationStepSize:
            return
        experiment = self._description.defaultExperiment
        step = co_simulation.fixedInternalStepSize or (experiment.stepSize if experiment else None)
        if step is None:
            return
        multiple = period / float(step)
        if round(multiple) < 1 or abs(multiple - round(multiple)) > 1e-6:
            raise InputError(
                f"{self.path.name} cannot take a rate of {1 / period:g} Hz: its step is fixed at {float(step):g} s, so the "
                f"rate must be {1 / float(step):g} Hz divided by a whole number"
            )

    def _load(self) -> Any:
        folder = self._cleanup.enter_context(tempfile.TemporaryDirectory(prefix="gough-fmu-"))
        self.folder = Path(folder)
        identifier = self._description.coSimulation.modelIdentifier
        library = Path(folder) / "binaries" / fmpy.platform_tuple / f"{identifier}{fmpy.sharedLibraryExtension}"
        try:
            with zipfile.ZipFile(self.path) as archive:
                for member in archive.namelist():
                    if not member.startswith(("sources/", "documentation/")):
                        archive.extract(member, folder)
        except (zipfile.BadZipFile, zlib.error, OSError) as error:
            raise FmuError(f"{self.path.name} is not a usable FMU: {error}") from None
        if not library.is_file():
            raise FmuError(f"{self.path.name} holds no binary for {fmpy.platform_tuple}: build it for this machine")
        try:
            # FMPy stays in the library's folder when it cannot load it.
            with contextlib.chdir("."):
                fmu = fmpy.fmi3.FMU3Slave(
                    guid=self._description.guid, unzipDirectory=folder, modelIdentifier=identifier, instanceName="plant"
                )
            fmu.instantiate(loggingOn=True, logMessage=self._log)
        except Exception as error:
            reason = self.messages[-1] if self.messages else error
            raise FmuError(f"{self.path.name} cannot be loaded: {reason}") from None
        self._cleanup.callback(fmu.freeInstance)
        return fmu

    def _initialize(self, parameters: Mapping[str, ArrayLike]) -> None:
        calls = self.calls
        calls["instance"] = self._fmu.component if isinstance(self._fmu.component, int) else self._fmu.component.value
        for field, function in (
            ("get", "fmi3GetFloat64"),
            ("set", "fmi3SetFloat64"),
            ("set_enumeration", "fmi3SetInt64"),
            ("step", "fmi3DoStep"),
        ):
            calls[field] = ctypes.cast(getattr(self._fmu.dll, function), ctypes.c_void_p).value
        calls["imu_references"] = [self._variables[name].valueReference for name in _IMU_OUTPUTS]
        calls["truth_references"] = [self._variables[name].valueReference for name in _TRUTH_OUTPUTS]
        calls["command_reference"] = self._variables["velocity_command"].valueReference
        calls["mode_reference"] = self._variables["drive_mode"].valueReference
        if "payload.mass" in self._variables:
            calls["payload_reference"] = self._variables["payload.mass"].valueReference
        for name, value in parameters.items():
            self.set(name, value)
        try:
            self._fmu.enterInitializationMode(startTime=0.0)
            self._fmu.exitInitializationMode()
        except fmpy.fmi1.FMICallException:
            raise self.failure("initialisation failed") from None

    def _call(self, function: str, *arguments: Any) -> None:
        try:
            getattr(self._fmu, function)(self._fmu.component, *arguments)
        except fmpy.fmi1.FMICallException:
            raise self.failure(f"{function} failed") from None

    def _log(self, environment: object, status: int, category: bytes, message: bytes) -> None:
        del environment, category
        if status:
            self.messages.append(message.decode("utf-8", "replace"))


def _read_description(path: Path) -> Any:
    try:
        description = fmpy.read_model_description(str(path), validate=True)
    except FileNotFoundError:
        raise FmuError(f"there is no FMU at {path}") from None
    except Exception as error:
        reason = " ".join(str(error).split())
        raise FmuError(f"{path} is not a usable FMU: {reason}") from None
    if not str(description.fmiVersion).startswith("3.") or description.coSimulation is None:
        raise FmuError(f"{path.name} is not an FMI 3.0 Co-Simulation FMU (it declares FMI {description.fmiVersion})")
    return description


def _type_of(variable: Variable) -> str:
    return "Enumeration" if variable.discrete else "Float64"


def _size_of(variable: Any) -> int:
    return int(np.prod([int(dimension.start) for dimension in variable.dimensions], dtype=int))


def _pointer(array: NDArray[Any], c_type: Any) -> Any:
    return array.ctypes.data_as(ctypes.POINTER(c_type))


def _calling(arguments: str) -> Any:
    """An intrinsic that calls the C function at an address with a tuple of arguments and returns its int.

    `arguments` has one letter each: p for a pointer or size (intp), d for a double, b for a bool.
    """
    llvm = {"p": ir.IntType(64), "d": ir.DoubleType(), "b": ir.IntType(1)}
    numba_types = {"p": types.intp, "d": types.float64, "b": types.boolean}
    tuple_of: Any = types.Tuple

    @intrinsic
    def call(typing_context: Any, address: Any, values: Any) -> Any:
        signature = types.int32(types.intp, tuple_of([numba_types[letter] for letter in arguments]))

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            function_type = ir.FunctionType(ir.IntType(32), [llvm[letter] for letter in arguments])
            function = builder.inttoptr(args[0], function_type.as_pointer())
            unpacked = []
            for i, letter in enumerate(arguments):
                value = builder.extract_value(args[1], i)
                unpacked.append(builder.trunc(value, llvm["b"]) if letter == "b" else value)
            return builder.call(function, unpacked)

        return signature, generate

    return call


_access: Callable[..., int] = _calling("ppppp")
_do_step: Callable[..., int] = _calling("pddbpppp")


@kernel
def read_imus(calls: Record) -> int:
    """Read the ideal IMU signals into `imu`; returns FMI's status, 0 when all is well."""
    c = calls[()]
    return _access(c.get, (c.instance, c.imu_references.ctypes.data, c.imu_references.size, c.imu.ctypes.data, c.imu.size))


@kernel
def read_truth(calls: Record) -> int:
    """Read pose, lengths and currents into `truth`; returns FMI's status."""
    c = calls[()]
    return _access(
        c.get, (c.instance, c.truth_references.ctypes.data, c.truth_references.size, c.truth.ctypes.data, c.truth.size)
    )


@kernel
def write_command(calls: Record, command: Array) -> int:
    """Set the velocity commands (6,) [m/s]; returns FMI's status."""
    c = calls[()]
    return _access(c.set, (c.instance, c.command_reference.ctypes.data, 1, command.ctypes.data, command.size))


@kernel
def write_drive_mode(calls: Record, mode: int) -> int:
    """Set the mode of all six drives; returns FMI's status."""
    calls[()].mode[:] = mode
    return write_drive_modes(calls)


@kernel
def write_drive_modes(calls: Record) -> int:
    """Set the modes of the drives to those in `mode`; returns FMI's status."""
    c = calls[()]
    return _access(c.set_enumeration, (c.instance, c.mode_reference.ctypes.data, 1, c.mode.ctypes.data, c.mode.size))


@kernel
def write_payload_mass(calls: Record, mass: float) -> int:
    """Set the mass of the payload [kg], if the plant has one; returns FMI's status."""
    c = calls[()]
    if c.payload_reference[0] == 0:
        return 0
    c.payload[0] = mass
    return _access(c.set, (c.instance, c.payload_reference.ctypes.data, 1, c.payload.ctypes.data, 1))


@kernel
def advance(calls: Record, duration: float) -> int:
    """Step the FMU by `duration` [s]; returns FMI's status."""
    c = calls[()]
    flags = c.flags.ctypes.data
    status = _do_step(c.step, (c.instance, c.time, duration, True, flags, flags + 1, flags + 2, c.reached.ctypes.data))
    c.time += duration
    return status
