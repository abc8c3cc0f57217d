"""Running a plant FMU: checked when it is loaded, then called from compiled code by the addresses of its C functions."""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import ArrayLike, NDArray

from plant.binding import OWN_BINDING, TRUTH_SIZE, Binding, Modes, Scalars, Setting, bind, check_free, check_start, load_binding
from plant.compiled import Record, kernel
from plant.errors import FmuError, InputError
from plant.fmi import ASKS_TO_END, ERROR, NEEDS_EVENTS, OK, FmuDescription, FmuInstance, FmuVariable
from plant.mechanism import LEGS
from plant.pose import Array
from plant.variables import DRIVE_MODES, IMU_COUNT, VELOCITY

MOST_CHANGES = 32
"""How many parameters may change during a run."""

_SENSED = 3 * IMU_COUNT * 3
_READING, _TELLING, _COMMANDING, _SWITCHING, _LOADING, _CHANGING, _STEPPING = range(7)
_CALLED = (
    "reading the IMUs", "reading the truth", "setting the commands", "setting the drives' modes", "setting the payload",
    "changing a parameter", "a step",
)  # fmt: skip


def _scalars(most: int) -> np.dtype[Any]:
    """As `plant.binding.Scalars`, with room for so many, and the FMU's values."""
    return np.dtype(
        [
            ("references", np.uint32, most),
            ("reference_count", np.int64),
            ("count", np.int64),
            ("places", np.int64, most),
            ("factors", np.float64, most),
            ("offsets", np.float64, most),
            ("raw", np.float64, most),
        ],
        align=True,
    )


_CHANGE = np.dtype(
    [
        ("time", np.float64),
        ("function", np.int64),
        ("references", np.int64),
        ("reference_count", np.int64),
        ("values", np.int64),
        ("count", np.int64),
    ],
    align=True,
)

CALLS = np.dtype(
    [
        ("version", np.int64),
        ("instance", np.int64),
        ("get", np.int64),
        ("set", np.int64),
        ("set_mode", np.int64),
        ("do_step", np.int64),
        ("time", np.float64),
        ("since", np.float64),
        ("length", np.float64),
        ("steps", np.int64),
        ("step", np.float64),
        ("final", np.uint8),
        ("status", np.int64),
        ("call", np.int64),
        ("sensed", _scalars(_SENSED)),
        ("known", _scalars(TRUTH_SIZE)),
        ("commanded", _scalars(LEGS)),
        ("loaded", _scalars(1)),
        ("mode_references", np.uint32, LEGS),
        ("mode_reference_count", np.int64),
        ("mode_count", np.int64),
        ("mode_bytes", np.int64),
        ("mode_values", np.uint64, len(DRIVE_MODES)),
        ("mode_raw", np.uint64, LEGS),
        ("imu", np.float64, (3, IMU_COUNT, 3)),
        ("truth", np.float64, TRUTH_SIZE),
        ("planar_angle", np.int64),
        ("legs", np.int64),
        ("command", np.float64, LEGS),
        ("mode", np.int64, LEGS),
        ("payload", np.float64, 1),
        ("reached", np.float64, 1),
        ("flags", np.uint8, 3),
        ("changes", _CHANGE, MOST_CHANGES),
        ("change_count", np.int64),
        ("changed", np.int64),
    ],
    align=True,
)
"""One FMU as compiled code sees it: addresses, value references with what makes the FMU's values the loop's, and buffers.

`imu` is angular velocity [rad/s], specific force [m/s^2] and magnetic field [uT] of the seven IMUs; `truth` is position (3)
[m], quaternion (4), leg lengths (6) [m] and currents (6) [A]; both are NaN where the FMU says nothing. A planar plant's truth
has its pose in space, with z = 0, and its first three legs. `step` is the communication step [s], 0 for that of each call.
`time` is `steps` steps of one `length` [s] after `since` [s]: counted, for a sum would drift. `final` is whether no earlier
state will be restored. `status` is how the first call that went wrong has ended, and `call` which that was.
"""


@dataclass(frozen=True, eq=False)
class LinearPlant:
    """A linear system `x' = A x + B u, y = C x + D u` of n states, m inputs and p outputs, all as differences.

    Attributes:
        a, b, c, d: (n, n), (n, m), (p, n), (p, m).
        states, inputs, outputs: the names of the scalars.
    """

    a: Array
    b: Array
    c: Array
    d: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class FmuPlant:
    """A plant FMU for Co-Simulation, of FMI 2.0 or 3.0, initialised and ready to step.

    Args:
        path: the FMU.
        parameters: start values by name; a name that the FMU does not have is an error.
        period: of control [s].
        binding: a TOML file that says which variables are which; None where they have gough's own names.
        settings: values that come after the parameters and the binding's, at the start or during the run.
        legs: that it must have; None for any number.

    Attributes:
        calls: the structured array (dtype `CALLS`) for `read_imus`, `read_truth`, `write_command` and `advance`.
        bound: what its variables are to the loop.
        folder: where it has been extracted to; removed by `close`, or after a crash when an FMU is next loaded.

    Raises:
        FmuError: the file is no FMU, is of another kind, does not fit its binding, holds no binary for this machine, or refuses
            its parameters.
        UnknownNameError: a parameter or setting that the FMU does not have.
        InputError: another number of legs, a period that the FMU cannot take, a binding that cannot be read, or a value that
            does not fit.
    """

    def __init__(
        self,
        path: Path | str,
        parameters: Mapping[str, ArrayLike],
        period: float,
        binding: Path | str | Binding | None = None,
        settings: Sequence[Setting] = (),
        legs: int | None = None,
    ) -> None:
        self.path = Path(path)
        self.calls: Record = np.zeros((), CALLS)
        if not isinstance(binding, Binding):
            binding = OWN_BINDING if binding is None else load_binding(binding)
        self.description = FmuDescription(self.path)
        self.bound = bind(binding, self.description)
        if legs not in (None, self.bound.legs):
            raise InputError(f"{self.path.name} has {self.bound.legs} legs, and the mechanism has {legs}: choose another one")
        self._check_period(period, binding.step)
        self._kept: list[NDArray[Any]] = []
        starts = {**parameters, **binding.start}
        values = [self._values(name, value) for name, value in starts.items()]
        values += [self._start_values(each) for each in settings if each.at is None]
        changes = sorted((each for each in settings if each.at is not None), key=lambda each: each.at or 0.0)
        self._check_changes(changes)
        self._instance = FmuInstance(self.description)
        try:
            self._prepare_calls(binding.step)
            for each in changes:
                self._add_change(each)
            for variable, numbers in values:
                self._instance.set(variable, numbers)
            self._instance.initialize()
        except BaseException:
            self._instance.close()
            raise

    def __enter__(self) -> "FmuPlant":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    @property
    def folder(self) -> Path:
        """Where the FMU has been extracted to."""
        return self._instance.folder

    @property
    def messages(self) -> Sequence[str]:
        """What the FMU has logged of late, but for what says that all is well."""
        return self._instance.messages

    def close(self) -> None:
        """Free the instance and remove what was extracted; closing twice does no harm."""
        self._instance.status = max(self._instance.status, int(self.calls["status"]))
        self._instance.close()

    def get(self, name: str) -> NDArray[Any]:
        """The value of a number, in its own shape.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: it is no number.
            FmuError: the FMU refuses.
        """
        return self._instance.get(self.description[name])

    def set(self, name: str, value: ArrayLike) -> None:
        """Set a number.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: the value has the wrong number of elements, or is none for this variable.
            FmuError: the FMU refuses.
        """
        self._instance.set(*self._values(name, value))

    def step(self, duration: float) -> None:
        """Advance by `duration` [s].

        Raises:
            FmuError: the FMU reports a failure.
        """
        self._instance.check_open()
        self.calls["status"] = OK
        if advance(self.calls, duration):
            raise self.failure()

    def linearize(self, inputs: Sequence[str], outputs: Sequence[str]) -> "LinearPlant":
        """The plant's equations to first order about where it is, from the FMU's directional derivatives.

        Args:
            inputs, outputs: names of the variables between which the plant is wanted.

        Raises:
            UnknownNameError: the FMU has no such variable.
            FmuError: the FMU has no directional derivatives, or shows no states.
        """
        states, rates = [state for state, _ in self.description.states], [rate for _, rate in self.description.states]
        if not states:
            raise FmuError(f"{self.path.name} shows no continuous states: export it with them")
        u, y = [self.description[name] for name in inputs], [self.description[name] for name in outputs]
        n = sum(each.size for each in states)
        whole = self._instance.jacobian([*rates, *y], [*states, *u])
        names = tuple(tuple(name for each in side for name in each.element_names) for side in (states, u, y))
        return LinearPlant(whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:], *names)

    def state(self) -> bytes:
        """All that the plant's future depends on, its clock included.

        Raises:
            FmuError: the FMU cannot save its state.
        """
        return struct.pack(_CLOCK, *(self.calls[name] for name in _CLOCKED)) + self._instance.state()

    def restore(self, state: bytes) -> None:
        """Go back to a state of this plant, or of another with the same FMU and settings.

        Raises:
            FmuError: the FMU cannot, or this is no state of it.
        """
        size = struct.calcsize(_CLOCK)
        if len(state) < size:
            raise FmuError(f"{self.path.name} cannot restore a state of {len(state)} bytes, for it is none of this plant")
        self._instance.restore(state[size:])
        for name, value in zip(_CLOCKED, struct.unpack(_CLOCK, state[:size]), strict=True):
            self.calls[name] = value

    def failure(self) -> FmuError:
        """The error that says what went wrong in the compiled calls, in the FMU's own words."""
        return self._instance.failure(_CALLED[int(self.calls["call"])], int(self.calls["status"]))

    def _values(self, name: str, value: ArrayLike, spread: bool = False) -> tuple[FmuVariable, NDArray[Any]]:
        variable = self.description[name]
        return variable, variable.values(value, self.path.name, spread)

    def _start_values(self, setting: Setting) -> tuple[FmuVariable, NDArray[Any]]:
        variable, values = self._values(setting.name, setting.value, spread=True)
        check_start(variable, self.path.name, self.bound.driven)
        return variable, values

    def _check_period(self, period: float, step: float | None) -> None:
        if not 0.0 < period < inf:
            raise InputError(f"{self.path.name} cannot take a step of {period:g} s; it must be positive and finite")
        if step is not None and not _is_multiple(period, step):
            raise InputError(
                f"{self.path.name} cannot take a rate of {1 / period:g} Hz: its binding sets a step of {step:g} s, so the rate "
                f"must be {1 / step:g} Hz divided by a whole number"
            )
        co_simulation, experiment = self.description.co_simulation, self.description.experiment
        if co_simulation.canHandleVariableCommunicationStepSize:
            return
        fixed = float(co_simulation.fixedInternalStepSize or (experiment and experiment.stepSize) or 0.0)
        if fixed <= 0.0 or _is_multiple(step or period, fixed):
            return
        if step is not None:
            raise InputError(
                f"{self.path.name} cannot take a step of {step:g} s: its own is fixed at {fixed:g} s; set [fmu] step to "
                "that, or to a multiple"
            )
        raise InputError(
            f"{self.path.name} cannot take a rate of {1 / period:g} Hz: its step is fixed at {fixed:g} s, so the "
            f"rate must be {1 / fixed:g} Hz divided by a whole number"
        )

    def _check_changes(self, changes: Sequence[Setting]) -> None:
        if len(changes) > MOST_CHANGES:
            raise InputError(f"{len(changes)} settings change during the run, and at most {MOST_CHANGES} can")
        for each in changes:
            variable, values = self._values(each.name, each.value, spread=True)
            if not variable.tunable:
                raise InputError(
                    f"{each.name} of {self.path.name} cannot change during the run, for it is neither an input nor a tunable "
                    "parameter: set it without @"
                )
            check_free(variable, self.path.name, self.bound.driven)
            limits = np.broadcast_to(variable.minimum, values.shape), np.broadcast_to(variable.maximum, values.shape)
            for name, value, least, most in zip(variable.element_names, values, *limits, strict=True):
                if not least <= value <= most:
                    raise InputError(f"{name} of {self.path.name} is to be {value:g}; it must be from {least:g} to {most:g}")

    def _add_change(self, setting: Setting) -> None:
        variable, values = self._values(setting.name, setting.value, spread=True)
        references = np.array(variable.references, np.uint32)
        self._kept += [references, values]
        change = self.calls["changes"][self.calls["change_count"]]
        change["time"], change["function"] = setting.at, self._instance.address(f"Set{variable.ending}")
        change["references"], change["reference_count"] = references.ctypes.data, references.size
        change["values"], change["count"] = values.ctypes.data, values.size
        self.calls["change_count"] += 1

    def _prepare_calls(self, step: float | None) -> None:
        calls, bound, instance = self.calls, self.bound, self._instance
        real = "Real" if self.description.version == 2 else "Float64"
        calls["version"], calls["instance"] = self.description.version, instance.component()
        calls["get"], calls["set"], calls["do_step"] = (
            instance.address(each) for each in (f"Get{real}", f"Set{real}", "DoStep")
        )  # fmt: skip
        calls["step"], calls["final"] = step or 0.0, not self.description.saves_state
        for group in ("sensed", "known", "commanded", "loaded"):
            _fill(calls[group], getattr(bound, group))
        if bound.modes.variable is not None:
            self._prepare_modes(bound.modes, bound.modes.variable)
        calls["imu"], calls["truth"] = np.nan, np.nan
        calls["legs"], calls["planar_angle"] = bound.legs, bound.planar_angle
        if bound.knows_pose and bound.legs < LEGS:
            calls["truth"][2] = 0.0

    def _prepare_modes(self, modes: Modes, variable: FmuVariable) -> None:
        calls = self.calls
        count = 1 if modes.common else self.bound.legs
        calls["set_mode"] = self._instance.address(f"Set{variable.ending}")
        calls["mode_references"][: modes.references.size] = modes.references
        calls["mode_count"], calls["mode_bytes"] = count, variable.dtype.itemsize
        calls["mode_reference_count"] = modes.references.size
        for mode, value in enumerate(modes.values.astype(variable.dtype)):
            calls["mode_values"][mode] = int.from_bytes(value.tobytes(), "little")


_CLOCKED = ("time", "since", "length", "steps", "changed")
_CLOCK = "<dddqq"


def _is_multiple(duration: float, step: float) -> bool:
    multiple = duration / step
    return 0.5 < multiple < inf and abs(multiple - round(multiple)) <= 1e-6


def _fill(record: Record, scalars: Scalars) -> None:
    count = scalars.places.size
    record["references"][: scalars.references.size] = scalars.references
    record["reference_count"], record["count"] = scalars.references.size, count
    record["places"][:count], record["factors"][:count], record["offsets"][:count] = (
        scalars.places, scalars.factors, scalars.offsets,
    )  # fmt: skip


def _calling(arguments: str) -> Any:
    """An intrinsic that calls the C function at an address with a tuple of arguments and returns its int.

    `arguments` has one letter each: p for a pointer or size (intp), d for a double, b for a bool (uint8), i for an int.
    """
    llvm = {"p": ir.IntType(64), "d": ir.DoubleType(), "b": ir.IntType(8), "i": ir.IntType(32)}
    numba_types = {"p": types.intp, "d": types.float64, "b": types.uint8, "i": types.int32}
    tuple_of: Any = types.Tuple

    @intrinsic
    def call(typing_context: Any, address: Any, values: Any) -> Any:
        signature = types.int32(types.intp, tuple_of([numba_types[letter] for letter in arguments]))

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            function_type = ir.FunctionType(ir.IntType(32), [llvm[letter] for letter in arguments])
            function = builder.inttoptr(args[0], function_type.as_pointer())
            unpacked = [builder.extract_value(args[1], i) for i in range(len(arguments))]
            # Callees may count on a bool that fills its register.
            extended = {i: ("zeroext",) for i, letter in enumerate(arguments) if letter == "b"}
            return builder.call(function, unpacked, arg_attrs=extended)

        return signature, generate

    return call


_access_2: Callable[..., int] = _calling("pppp")
_access_3: Callable[..., int] = _calling("ppppp")
_do_step_2: Callable[..., int] = _calling("pddi")
_do_step_3: Callable[..., int] = _calling("pddbpppp")


@kernel
def _ended(c: Record, call: int, status: int) -> int:
    """Take note of the first call that goes wrong; returns its status."""
    if status != OK and c.status == OK:
        c.status, c.call = status, call
    return status


@kernel
def _access(c: Record, call: int, function: int, references: int, reference_count: int, values: int, count: int) -> int:
    """Get or set values, unless the FMU has failed before; returns FMI's status."""
    if c.status >= ERROR:
        return int(c.status)
    if c.version == 2:
        status = _access_2(function, (c.instance, references, reference_count, values))
    else:
        status = _access_3(function, (c.instance, references, reference_count, values, count))
    return _ended(c, call, status)


@kernel
def _read(c: Record, call: int, scalars: Record, into: Array) -> int:
    """Read scalars, each to its place."""
    if scalars.count == 0:
        return OK
    raw, references = scalars.raw, scalars.references
    status = _access(c, call, c.get, references.ctypes.data, scalars.reference_count, raw.ctypes.data, scalars.count)
    places, factors, offsets = scalars.places, scalars.factors, scalars.offsets
    for i in range(scalars.count):
        into[places[i]] = factors[i] * raw[i] + offsets[i]
    return status


@kernel
def _write(c: Record, call: int, scalars: Record, values: Array) -> int:
    """Write scalars, each from its place."""
    if scalars.count == 0:
        return OK
    raw, references = scalars.raw, scalars.references
    places, factors, offsets = scalars.places, scalars.factors, scalars.offsets
    for i in range(scalars.count):
        raw[i] = (values[places[i]] - offsets[i]) / factors[i]
    return _access(c, call, c.set, references.ctypes.data, scalars.reference_count, raw.ctypes.data, scalars.count)


@kernel
def read_imus(calls: Record) -> int:
    """Read the ideal IMU signals into `imu`; returns FMI's status, 0 when all is well."""
    c = calls[()]
    return _read(c, _READING, c.sensed, c.imu.reshape(-1))


@kernel
def read_truth(calls: Record) -> int:
    """Read pose, lengths and currents into `truth`, as far as the FMU tells them; returns FMI's status."""
    c = calls[()]
    truth = c.truth
    status = _read(c, _TELLING, c.known, truth)
    if c.planar_angle != 0:
        half = 0.5 * truth[3]
        truth[3], truth[4], truth[5], truth[6] = np.cos(half), 0.0, 0.0, np.sin(half)
    return status


@kernel
def write_command(calls: Record, command: Array) -> int:
    """Set the velocity commands (6,) or (3,) [m/s]; returns FMI's status.

    Where the drives have no modes, those that are not to move are told to stand.
    """
    c = calls[()]
    sent = c.command
    for k in range(c.legs):
        sent[k] = command[k] if c.mode_count > 0 or c.mode[k] == VELOCITY else 0.0
    return _write(c, _COMMANDING, c.commanded, sent)


@kernel
def write_drive_mode(calls: Record, mode: int) -> int:
    """Set the mode of all drives; returns FMI's status."""
    calls[()].mode[:] = mode
    return write_drive_modes(calls)


@kernel
def write_drive_modes(calls: Record) -> int:
    """Set the modes of the drives to those in `mode`; returns FMI's status.

    A switch that the drives have in common is on while any of them is to move.
    """
    c = calls[()]
    if c.mode_count == 0:
        return write_command(calls, c.command)
    raw = c.mode_raw
    raw[:] = 0
    for k in range(c.mode_count):
        mode = c.mode[k]
        if c.mode_count == 1:
            for other in range(c.legs):
                mode = max(mode, c.mode[other])
        at = k * c.mode_bytes
        raw[at >> 3] |= c.mode_values[mode] << np.uint64(8 * (at & 7))
    references = c.mode_references
    return _access(
        c, _SWITCHING, c.set_mode, references.ctypes.data, c.mode_reference_count, raw.ctypes.data, c.mode_count
    )  # fmt: skip


@kernel
def write_payload_mass(calls: Record, mass: float) -> int:
    """Set the mass of the payload [kg], if the plant has one; returns FMI's status."""
    c = calls[()]
    c.payload[0] = mass
    return _write(c, _LOADING, c.loaded, c.payload)


@kernel
def advance(calls: Record, duration: float) -> int:
    """Step the FMU by `duration` [s], in communication steps of its own if it has one; returns FMI's status."""
    c = calls[()]
    steps = 1 if c.step == 0.0 else max(int(np.rint(duration / c.step)), 1)
    status = OK
    for _ in range(steps):
        while c.changed < c.change_count and c.changes[c.changed].time <= c.time + _INSTANT_S:
            change = c.changes[c.changed]
            status |= _access(
                c, _CHANGING, change.function, change.references, change.reference_count, change.values, change.count
            )  # fmt: skip
            c.changed += 1
        status |= _step(c, duration / steps)
    return status


_INSTANT_S = 1e-9
"""What is due within this time is due now [s]."""


@kernel
def _step(c: Record, step: float) -> int:
    """Take a communication step, unless the FMU has failed before; returns FMI's status."""
    if c.status >= ERROR:
        return int(c.status)
    if c.version == 2:
        status = _do_step_2(c.do_step, (c.instance, c.time, step, np.int32(c.final)))
    else:
        flags = c.flags
        at = flags.ctypes.data
        status = _do_step_3(c.do_step, (c.instance, c.time, step, c.final, at, at + 1, at + 2, c.reached.ctypes.data))
        if status == OK and flags[1] != 0:
            status = ASKS_TO_END
        elif status == OK and (flags[0] != 0 or flags[2] != 0):
            status = NEEDS_EVENTS
    if step != c.length:
        c.since, c.length, c.steps = c.time, step, 0
    c.steps += 1
    c.time = c.since + c.steps * step
    return _ended(c, _STEPPING, status)
