"""A plant FMU for the loop, called from compiled code (`plant.fmu.calls`)."""

import struct
from collections.abc import Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.compiled import Record
from plant.dynamics.base_course import BASE_SIZE, MOST_BASE_MOTIONS
from plant.dynamics.variables import PLANAR, SPATIAL
from plant.errors import FmuError, InputError
from plant.fmu.binding import (
    BASE,
    OWN_BINDING,
    READ_GROUPS,
    Binding,
    Bound,
    Modes,
    Scalars,
    bind,
    check_settable,
    load_binding,
)
from plant.fmu.calls import CALLED, FMU_HANDLE, MOST_CHANGES, advance
from plant.fmu.description_reader import FmuDescription, FmuVariable
from plant.fmu.instance import NOT_FINITE, OK, FmuInstance
from plant.fmu.settings import Setting
from plant.mechanism import LEGS
from plant.pose import Array


class LinearPlant(NamedTuple):
    """A linear system `x' = A x + B u, y = C x + D u`, all differences from a point."""

    a: Array  # (n, n)
    b: Array  # (n, m)
    c: Array  # (p, n)
    d: Array  # (p, m)
    states: tuple[str, ...]  # names of scalars
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class FmuPlant(FmuInstance):
    """A plant FMU for Co-Simulation, of FMI 2.0 or 3.0, initialised and ready to step.

    Args:
        parameters: start values by name; a name that the FMU lacks is an error.
        period: of control [s].
        binding: a binding or its TOML file; None if the variables have gough's own names.
        settings: set after the parameters and the binding's start values, or during the run.
        legs: the required number; None for any.

    Attributes:
        handle: the record (dtype `FMU_HANDLE`) for the kernels of `plant.fmu.calls`.
        bound: the loop's signals in the FMU.

    Raises:
        FmuError: the file is no such FMU, does not fit its binding, or refuses a parameter.
        UnknownNameError: a parameter or setting that the FMU lacks.
        InputError: a number of legs, a period, a binding or a value that does not fit.
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
        if not isinstance(binding, Binding):
            binding = OWN_BINDING if binding is None else load_binding(binding)
        super().__init__(FmuDescription(Path(path)))
        self.handle: Record = np.zeros((), FMU_HANDLE)
        self.bound = bind(binding, self.description)
        if legs is not None:
            check_number_of_legs(self.path, self.bound, legs)
        self._check_period(period, binding.step)
        values = [self._values(name, value) for name, value in {**parameters, **binding.start}.items()]
        values += [self._setting(each) for each in settings if each.at is None]
        later = sorted((each.at, i) for i, each in enumerate(settings) if each.at is not None)
        if len(later) > MOST_CHANGES:
            raise InputError(f"{len(later)} settings change during the run, and at most {MOST_CHANGES} can")
        changes = [(at, *self._setting(settings[i])) for at, i in later]
        self.start(values)
        self._prepare_handle(binding.step)
        self.handle["change_count"] = len(changes)
        self._kept = [self._prepare_change(i, *change) for i, change in enumerate(changes)]

    def close(self) -> None:
        """Free the instance and remove the extracted files; a second call does nothing."""
        self.status = max(self.status, int(self.handle["status"]))
        super().close()

    def restart(self, parameters: Mapping[str, ArrayLike]) -> None:
        """Return to time 0, with other start values by name, and the FMU's own for all others; nothing changes during the run.

        This takes a tenth of the time of loading the FMU again.

        Raises:
            UnknownNameError: a parameter that the FMU lacks.
            FmuError: the FMU refuses.
        """
        values = [self._values(name, value) for name, value in parameters.items()]
        self._check_open()
        self._call("Reset", "a reset")
        for variable, numbers in values:
            self._access("Set", variable, numbers)
        self.initialize()
        for name in (*_CLOCKED, "status", "change_count"):
            self.handle[name] = 0

    def move_base(self, motions: Sequence[Record]) -> None:
        """Let the base move (dtype `plant.dynamics.base_course.BASE_MOTION`) from now on; times count from time 0.

        Raises:
            InputError: the FMU takes no motion of its base, or there are too many.
        """
        check_base(self.path, self.bound, len(motions))
        for place, motion in enumerate(motions):
            self.handle["base_motions"][place] = motion
        self.handle["base_motion_count"] = len(motions)

    def step(self, duration: float) -> None:
        """Advance by `duration` [s].

        Raises:
            FmuError: the FMU reports a failure.
        """
        self._check_open()
        self.handle["status"] = OK
        if advance(self.handle, duration):
            raise self.failure()

    def linearize(self, inputs: Sequence[str], outputs: Sequence[str]) -> LinearPlant:
        """The plant linearised at its present state, without states of imperfections that it does not have.

        Raises:
            UnknownNameError: the FMU has no such variable.
            InputError: a variable is not real.
            FmuError: the FMU has no directional derivatives, or exposes no states.
        """
        states, rates = [state for state, _ in self.description.states], [rate for _, rate in self.description.states]
        if not states:
            raise FmuError(f"{self.path.name} exposes no continuous states: export it with them")
        u, y = [self.description[name] for name in inputs], [self.description[name] for name in outputs]
        n = sum(each.size for each in states)
        whole = self.jacobian([*rates, *y], [*states, *u])
        named, *others = (tuple(name for each in side for name in each.element_names) for side in (states, u, y))
        # FMI 2.0 has a variable for each element, such as bending[1].
        disturbed = [state.name.partition("[")[0] in _DISTURBED for state in states for _ in range(state.size)]
        still = _still(disturbed, whole[:n])
        kept = [i for i in range(whole.shape[1]) if i >= n or not still[i]]
        rows, m = [i for i in range(len(whole)) if i >= n or not still[i]], n - int(still.sum())
        part = whole[np.ix_(rows, kept)]
        left = tuple(name for name, none in zip(named, still, strict=True) if not none)
        return LinearPlant(part[:m, :m], part[:m, m:], part[m:, :m], part[m:, m:], left, *others)

    def state(self) -> bytes:
        """The plant's whole state, with its clock."""
        return struct.pack(_CLOCK, *(self.handle[name] for name in _CLOCKED)) + super().state()

    def restore(self, state: bytes) -> None:
        """Return to a state of this plant, or of another with the same FMU and settings."""
        size = struct.calcsize(_CLOCK)
        if len(state) < size:
            raise FmuError(f"{self.path.name} cannot restore a state of {len(state)} bytes, which is no state of this plant")
        clock = dict(zip(_CLOCKED, struct.unpack(_CLOCK, state[:size]), strict=True))
        if not 0 <= clock["changed"] <= self.handle["change_count"]:
            raise FmuError(f"{self.path.name} cannot restore a state after {clock['changed']} changes: it has not so many")
        super().restore(state[size:])
        for name, value in clock.items():
            self.handle[name] = value

    def failure(self) -> FmuError:
        """The error for the first compiled call that failed, with the FMU's own reason."""
        if self.handle["status"] == NOT_FINITE:
            return FmuError(f"{self.path.name} gives {self._not_finite()}, which is not finite: mend its model")
        return self._failed(CALLED[int(self.handle["call"])], int(self.handle["status"]))

    def _not_finite(self) -> str:
        """The first value that was read and is not finite, with the name of its variable."""
        groups = [(self.handle[name]["raw"], getattr(self.bound, name).places.size) for name in READ_GROUPS]
        values = np.concatenate([raw[:count] for raw, count in groups])
        first = int(np.argmin(np.isfinite(values)))
        return f"{values[first]} for {self.bound.read[first]}"

    def _values(self, name: str, value: ArrayLike, spread: bool = False) -> tuple[FmuVariable, NDArray[Any]]:
        variable = self.description[name]
        return variable, variable.values(value, self.path.name, spread)

    def _setting(self, setting: Setting) -> tuple[FmuVariable, NDArray[Any]]:
        """The variable and the values of a setting that the FMU takes at its time."""
        variable, values = self._values(setting.name, setting.value, spread=True)
        check_settable(variable, self.path.name, self.bound.driven, running=setting.at is not None)
        if setting.at is not None:
            for name, value, (least, most) in zip(variable.element_names, values, variable.limits, strict=True):
                if not least <= value <= most:
                    raise InputError(f"{name} of {self.path.name} would be {value:g}; it must be from {least:g} to {most:g}")
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

    def _prepare_handle(self, step: float | None) -> None:
        handle, bound = self.handle, self.bound
        real = "Real" if self.description.version == 2 else "Float64"
        handle["version"], handle["instance"] = self.description.version, self.component()
        for field, function in (("get", f"Get{real}"), ("set", f"Set{real}"), ("do_step", "DoStep")):
            handle[field] = self.address(function)
        handle["step"], handle["final"] = step or 0.0, not self.description.saves_state
        for group in (*READ_GROUPS, "commanded", "loaded", "based"):
            _fill(handle[group], getattr(bound, group))
        if bound.modes.variable is not None:
            self._prepare_modes(bound.modes, bound.modes.variable)
        handle["imu"], handle["truth"], handle["motors"], handle["base_imu"] = (np.nan,) * 4
        handle["legs"], handle["planar_angle"] = bound.legs, bound.planar_angle
        if bound.knows_pose and bound.legs < LEGS:
            handle["truth"][2] = 0.0

    def _prepare_modes(self, modes: Modes, variable: FmuVariable) -> None:
        handle = self.handle
        handle["set_mode"] = self.address(f"Set{variable.ending}")
        handle["mode_references"][: modes.references.size] = modes.references
        handle["mode_reference_count"] = modes.references.size
        handle["mode_count"] = 1 if modes.common else self.bound.legs
        handle["mode_bytes"] = variable.dtype.itemsize
        for mode, value in enumerate(modes.values.astype(variable.dtype)):
            handle["mode_values"][mode] = int.from_bytes(value.tobytes(), "little")

    def _prepare_change(self, i: int, at: float, variable: FmuVariable, values: NDArray[Any]) -> list[NDArray[Any]]:
        """Fill the record of change i; returns the arrays that it points to."""
        change = self.handle["changes"][i]
        references = np.array(variable.references, np.uint32)
        change["time"], change["function"] = at, self.address(f"Set{variable.ending}")
        change["references"], change["reference_count"] = references.ctypes.data, references.size
        change["values"], change["count"] = values.ctypes.data, values.size
        return [references, values]


def check_base(path: Path, bound: Bound, count: int) -> None:
    """Check that the base of an FMU can have so many motions, or raise an `InputError`."""
    if count and bound.based.places.size < BASE_SIZE:
        raise InputError(f"{path.name} takes no motion of its base: bind {', '.join(BASE)}, or leave the motion out")
    if count > MOST_BASE_MOTIONS:
        raise InputError(f"the base has {count} motions, and at most {MOST_BASE_MOTIONS} are possible: leave some out")


def check_number_of_legs(path: Path, bound: Bound, legs: int) -> None:
    """Check that an FMU has as many legs as a mechanism, or raise an `InputError`."""
    if legs != bound.legs:
        raise InputError(f"{path.name} has {bound.legs} legs, and the mechanism has {legs}: choose another one")


def takes_parameters(description: FmuDescription, names: Sequence[str]) -> bool:
    """Whether an FMU with the signals of gough's own plants takes their parameters, too; one that has none keeps its own.

    Raises:
        FmuError: it has some of them, and lacks others.
    """
    absent = [name for name in names if name not in description]
    if absent and len(absent) < len(names):
        raise FmuError(
            f"{description.path.name} has {len(names) - len(absent)} of the {len(names)} parameters of gough's own plants and "
            f"lacks {', '.join(absent[:3])}{', ...' if len(absent) > 3 else ''}: add them, or bind its signals with --binding "
            "(docs/fmu.md), and it keeps its own values"
        )
    return not absent


_DISTURBED = {each.name for table in (SPATIAL, PLANAR) for each in table.states if each.disturbance}
"""States of gough's own plants that stay zero without the imperfection that they belong to."""


def _still(disturbed: Sequence[bool], rates: Array) -> NDArray[np.bool_]:
    """Which of these states (n,) no other state and no input moves, by the Jacobian (n, n + m) of the rates."""
    still = np.array(disturbed)
    while True:
        moved = still & (rates[:, [*~still, *[True] * (rates.shape[1] - len(still))]] != 0.0).any(axis=1)
        if not moved.any():
            return still
        still &= ~moved


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
