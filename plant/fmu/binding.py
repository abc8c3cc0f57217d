"""Bindings: which of an FMU's variables hold the loop's signals, as a TOML file says (docs/fmu.md).

A signal has the name of gough's own variable (`plant.dynamics.variables`). One or several variables of the FMU hold its values.
In the binding of gough's own plants, every signal is the variable of its name.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from plant.dynamics.variables import BRAKE, DRIVE_MODES, IMU_COUNT, OPEN, PLATFORM_IMU, VELOCITY
from plant.errors import FmuError, GoughError, InputError
from plant.files import read_toml, toml_entries, unknown_entries
from plant.fmu.description_reader import FmuDescription, FmuVariable
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER
from plant.mechanism import LEGS
from plant.mechanism.planar import PLANAR_LEGS
from plant.pose import Array
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION

IMU_SIGNALS = {"imu_angular_velocity": GYROSCOPE, "imu_specific_force": ACCELEROMETER, "imu_magnetic_field": MAGNETOMETER}
TRUTH_PLACES = {
    "position": TRUTH_POSITION, "quaternion": TRUTH_QUATERNION, "angle": TRUTH_QUATERNION, "leg_length": TRUTH_LENGTHS,
    "current": TRUTH_CURRENTS,
}  # fmt: skip
"""Where a signal lies in the truth. A planar plant's angle is in the first place of the quaternion."""

BASE_IMU_SIGNALS = {"base_imu_angular_velocity": GYROSCOPE, "base_imu_specific_force": ACCELEROMETER}
COMMANDS, MODES, PAYLOAD = "velocity_command", "drive_mode", "payload.mass"
MOTORS, LENGTHS = "motor_length", "leg_length"
BASE = tuple(f"base_motion.{name}" for name in ("rotation", "angular_velocity", "angular_acceleration", "acceleration"))
"""The signals of the base's motion, in the order of `plant.dynamics.base_course`."""

UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6, "m/min": 1 / 60, "mm/min": 1e-3 / 60, "in/s": 0.0254},
    "m/s2": {"m/s2": 1.0, "m/s^2": 1.0, "mm/s2": 1e-3, "mm/s^2": 1e-3, "g": 9.80665, "mg": 9.80665e-3},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": np.pi / 180, "rpm": np.pi / 30, "1/min": np.pi / 30},
    "uT": {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "T": 1e6, "G": 100.0, "mG": 0.1},
    "rad/s2": {"rad/s2": 1.0, "rad/s^2": 1.0, "deg/s2": np.pi / 180, "deg/s^2": np.pi / 180},
    "A": {"A": 1.0, "mA": 1e-3},
    "kg": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "1": {"1": 1.0, "": 1.0},
}
"""The units that an FMU may use, with the factors to the loop's unit."""

SIGNAL_UNITS = {
    COMMANDS: "m/s", MODES: "1", "imu_angular_velocity": "rad/s", "imu_specific_force": "m/s2", "imu_magnetic_field": "uT",
    "base_imu_angular_velocity": "rad/s", "base_imu_specific_force": "m/s2", "position": "m", "quaternion": "1",
    "angle": "rad", LENGTHS: "m", MOTORS: "m", "current": "A", PAYLOAD: "kg",
    **dict(zip(BASE, ("rad", "rad/s", "rad/s2", "m/s2"), strict=True)),
}  # fmt: skip
"""The loop's unit of every signal."""

REQUIRED = (COMMANDS, "imu_angular_velocity", "imu_specific_force")
WRITTEN = (COMMANDS, MODES, PAYLOAD, *BASE)
READ_GROUPS = ("sensed", "known", "encoded", "base_sensed")
"""The groups of scalars that the loop reads, as `Bound` has them."""

MODE_NAMES = tuple(DRIVE_MODES.values())
_ENTRIES = ("offset", "sign", "unit", "variables")

LEAST_STEP_S = 1e-6
"""The shortest communication step [s]."""


@dataclass(frozen=True)
class SignalBinding:
    """The FMU's variables that hold one signal, in order, and the conversion to the loop's values."""

    variables: tuple[str, ...]
    unit: str | None = None  # by default the FMU's, or else the loop's
    sign: tuple[float, ...] = (1.0,)  # of all, each axis, or each element
    offset: tuple[float, ...] = (0.0,)  # added afterwards, in the loop's unit
    imus: tuple[int, ...] | None = None  # None for all
    modes: tuple[float | None, ...] = (None,) * len(DRIVE_MODES)  # None for the usual value


@dataclass(frozen=True)
class Binding:
    """A binding that has not been checked against its FMU."""

    source: str  # its file, for messages; "" for gough's own
    signals: Mapping[str, SignalBinding]
    step: float | None = None  # [s]; None for the control period
    start: Mapping[str, Any] = field(default_factory=dict)
    native: bool = False  # as gough's own plants, with their parameters
    problems: tuple[str, ...] = ()  # errors in the file


_OWN_SIGNALS = {name: SignalBinding((name,)) for name in SIGNAL_UNITS}
OWN_BINDING = Binding("", _OWN_SIGNALS, native=True)
"""The binding of gough's own plants, spatial and planar."""


def load_binding(path: Path | str) -> Binding:
    """Read a binding; `bind` reports errors in its entries.

    Raises:
        InputError: the file cannot be read, or is not TOML.
    """
    document = read_toml(path)
    reader = _Reader()
    tables = {name: reader.table(name, content) for name, content in document.items()}
    for name in tables.keys() - SIGNAL_UNITS.keys() - {"fmu", "start"}:
        reader.problems.append(f"there is no table [{name}]; there are fmu, start, {', '.join(SIGNAL_UNITS)}")
    step = reader.step(tables.get("fmu", {}))
    signals = {name: reader.signal(name, tables[name]) for name in SIGNAL_UNITS if name in tables}
    problems = tuple(reader.problems)
    return Binding(Path(path).name, signals or _OWN_SIGNALS, step, tables.get("start", {}), not signals, problems)


def text_of_binding(binding: Binding) -> str:
    """The TOML text of a binding, which `load_binding` reads again."""
    tables: dict[str, dict[str, Any]] = {
        "fmu": {} if binding.step is None else {"step": binding.step},
        "start": {json.dumps(name): value for name, value in binding.start.items()},
    }
    for name, signal in ({} if binding.native else binding.signals).items():
        entries: dict[str, Any] = {"variables": signal.variables, "unit": signal.unit, "imus": signal.imus}
        entries |= dict(zip(MODE_NAMES, signal.modes, strict=True)) if name == MODES else {}
        entries |= {"sign": signal.sign, "offset": signal.offset} if name != MODES else {}
        tables[name] = {entry: value for entry, value in entries.items() if value is not None}
    return "\n".join(line for name, entries in tables.items() for line in (f"[{json.dumps(name)}]", *toml_entries(entries), ""))


class _Reader:
    """Reads the entries of a binding and collects the errors."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    def table(self, name: str, content: Any) -> dict[str, Any]:
        if isinstance(content, dict):
            return content
        self.problems.append(f"{name} must be a table [{name}]")
        return {}

    def step(self, table: Mapping[str, Any]) -> float | None:
        self.problems += unknown_entries(table, ("step",), "[fmu]")
        step = table.get("step")
        good = step is None or (_is_number(step) and step >= LEAST_STEP_S)
        self._check("fmu", "step", step, good, f"a number of seconds, at least {LEAST_STEP_S:g}")
        return float(step) if good and step is not None else None

    def signal(self, name: str, table: Mapping[str, Any]) -> SignalBinding:
        entries = _ENTRIES if name != MODES else ("variables", *MODE_NAMES)
        self.problems += unknown_entries(table, ("imus", *entries) if name in IMU_SIGNALS else entries, f"[{name}]")
        variables = table.get("variables", [])
        if isinstance(variables, str):
            variables = [variables]
        named = isinstance(variables, list) and variables and all(isinstance(each, str) for each in variables)
        self._check(name, "variables", variables, named, "the name of a variable, or a list of names")
        unit = table.get("unit")
        known = unit is None or (isinstance(unit, str) and unit in UNITS[SIGNAL_UNITS[name]])
        self._check(name, "unit", unit, known, f"one of {unit_names(name)}")
        sign = self._numbers(name, "sign", table.get("sign", 1))
        signs = set(sign) <= {1.0, -1.0}
        self._check(name, "sign", table.get("sign"), signs, "1 or -1, or a list of these")
        return SignalBinding(
            tuple(variables) if named else (),
            unit if known else None,
            sign if signs else (1.0,),
            self._numbers(name, "offset", table.get("offset", 0.0)),
            self._imus(name, table.get("imus")),
            tuple(self._mode(name, mode, table.get(mode)) for mode in MODE_NAMES),
        )

    def _check(self, name: str, entry: str, value: Any, good: Any, needed: str) -> None:
        if not good:
            self.problems.append(f"[{name}] {entry} is {value!r}; it must be {needed}")

    def _numbers(self, name: str, entry: str, value: Any) -> tuple[float, ...]:
        values = value if isinstance(value, list) else [value]
        good = values and all(_is_number(each) or isinstance(each, bool) for each in values)
        self._check(name, entry, value, good, "a number, or a list of numbers")
        return tuple(map(float, values)) if good else (0.0,) * len(values or [0.0])

    def _mode(self, name: str, mode: str, value: Any) -> float | None:
        good = value is None or _is_number(value) or isinstance(value, bool)
        self._check(name, mode, value, good, "a number, true or false")
        return float(value) if good and value is not None else None

    def _imus(self, name: str, value: Any) -> tuple[int, ...] | None:
        if value is None:
            return None
        good = (
            isinstance(value, list)
            and value
            and all(type(each) is int and each in range(IMU_COUNT) for each in value)
            and len(set(value)) == len(value)
        )
        self._check(name, "imus", value, good, f"a list of different numbers from 0 to {PLATFORM_IMU}")
        return tuple(value) if good else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def unit_names(signal: str) -> str:
    """The units that an FMU may use for a signal."""
    return ", ".join(name for name in UNITS[SIGNAL_UNITS[signal]] if name)


class Scalars(NamedTuple):
    """Scalars that one call moves between FMU and loop: `loop = factor * fmu + offset`."""

    references: NDArray[np.uint32]
    places: NDArray[np.int64]  # in the loop's array
    factors: Array
    offsets: Array


class Modes(NamedTuple):
    """How to switch the drives."""

    references: NDArray[np.uint32]
    values: Array  # the FMU's for `OPEN`, `BRAKE`, `VELOCITY`
    variable: FmuVariable | None  # one of the modes, for its type
    common: bool  # one mode for all drives


@dataclass(frozen=True)
class Bound:
    """A binding matched to its FMU."""

    legs: int  # 6, or 3 of a planar plant
    imus: tuple[int, ...]
    magnetometers: tuple[int, ...]
    sensed: Scalars  # in (3, 7, 3)
    known: Scalars  # the truth, in (19,)
    encoded: Scalars  # the lengths that encoders read, in (legs,): the motors', or else the legs'
    base_sensed: Scalars  # what an IMU on the base senses, in (2, 3)
    commanded: Scalars  # in (legs,)
    loaded: Scalars  # the payload's mass, in (1,)
    based: Scalars  # the base's motion, in (12,)
    modes: Modes
    knows_pose: bool
    planar_angle: bool  # in place of the quaternion
    driven: frozenset[str]  # scalars that the loop sets
    read: tuple[str, ...]  # scalars that the loop reads, in the order of `READ_GROUPS`


def check_settable(variable: FmuVariable, owner: str, driven: frozenset[str], running: bool = False) -> None:
    """Check that a variable of the FMU `owner` may be set at the start, or during the run.

    Raises:
        InputError: it may not, or the loop sets it.
    """
    if running and not variable.tunable:
        raise InputError(
            f"{variable.name} of {owner} cannot change during the run, as it is neither an input nor a tunable parameter: "
            "set it without @"
        )
    if not running and not variable.startable:
        raise InputError(
            f"{variable.name} of {owner} is a {variable.variability} {variable.causality} variable, which takes no start "
            "value: set parameters and inputs"
        )
    if not driven.isdisjoint(variable.element_names):
        raise InputError(f"{variable.name} of {owner} is set by the loop, and cannot be set besides")


def bind(binding: Binding, description: FmuDescription) -> Bound:
    """Find a binding's variables in its FMU.

    Raises:
        FmuError: lists all errors, in the file and in the FMU's variables.
    """
    return _Binder(binding, description).bound()


class _Binder:
    def __init__(self, binding: Binding, description: FmuDescription) -> None:
        self._binding, self._description = binding, description
        self._problems = list(binding.problems)
        present = {
            name: each
            for name, each in binding.signals.items()
            if not binding.native or name in REQUIRED or name in description
        }
        self._found = {name: self._variables(name, each) for name, each in present.items()}
        self._legs = PLANAR_LEGS if self._size(COMMANDS) == PLANAR_LEGS else LEGS
        self._all_imus = (*range(self._legs), PLATFORM_IMU)
        self._driven = frozenset(
            scalar for name in (COMMANDS, MODES) for each in self._found.get(name, ()) for scalar in each.element_names
        )

    def bound(self) -> Bound:
        for name in REQUIRED:
            if name not in self._binding.signals:
                self._problems.append(f"there is no table [{name}], which is needed")
        imus = {name: self._binding.signals[name].imus or self._all_imus for name in IMU_SIGNALS if name in self._found}
        if len({frozenset(imus[name]) for name in REQUIRED[1:] if name in imus}) > 1:
            self._problems.append("imu_angular_velocity and imu_specific_force are of different imus, and must be of the same")
        groups = {
            "sensed": self._group({name: self._imu_places(name, each) for name, each in imus.items()}),
            "known": self._group({name: self._truth_places(name) for name in TRUTH_PLACES if name in self._found}),
            "encoded": self._group({name: range(self._legs) for name in self._encoded()}),
            "base_sensed": self._group(
                {name: range(3 * i, 3 * i + 3) for name, i in BASE_IMU_SIGNALS.items() if name in self._found}
            ),
            "commanded": self._group({name: range(self._legs) for name in (COMMANDS,) if name in self._found}),
            "loaded": self._group({name: range(1) for name in (PAYLOAD,) if name in self._found}),
            "based": self._group({name: range(3 * i, 3 * i + 3) for i, name in enumerate(BASE) if name in self._found}),
        }
        modes = self._modes()
        knows = "position" in self._found, "quaternion" in self._found or "angle" in self._found
        if any(knows) and not all(knows):
            self._problems.append("position, and quaternion or angle, are the pose only together: give both, or neither")
        if len(BASE_IMU_SIGNALS.keys() & self._found.keys()) == 1:
            self._problems.append(f"{' and '.join(BASE_IMU_SIGNALS)} are the base's IMU only together: give both, or neither")
        self._check_once()
        self._check_start()
        if self._problems:
            with_binding = f" with {self._binding.source}" if self._binding.source else ""
            raise FmuError(f"{self._description.path.name}{with_binding}: {'; '.join(self._problems)}")
        return Bound(
            legs=self._legs,
            imus=tuple(sorted(imus["imu_angular_velocity"])),
            magnetometers=tuple(sorted(imus.get("imu_magnetic_field", ()))),
            **groups,
            modes=modes,
            knows_pose=all(knows),
            planar_angle="angle" in self._found,
            driven=self._driven,
            read=tuple(
                scalar
                for name in (*IMU_SIGNALS, *TRUTH_PLACES, *self._encoded(), *BASE_IMU_SIGNALS)
                for each in self._found.get(name, ())
                for scalar in each.element_names
            ),
        )

    def _variables(self, name: str, signal: SignalBinding) -> list[FmuVariable]:
        found = []
        for wanted in signal.variables:
            try:
                variable = self._description[wanted]
            except GoughError as error:
                self._problems.append(f"{name}: {str(error).removeprefix(f'{self._description.path.name} ')}")
                continue
            found.append(variable)
            written, kind = name in WRITTEN, variable.causality
            if not (variable.tunable if written else kind in ("output", "local")):
                kind = f"{variable.variability} {kind}" if kind == "parameter" else kind
                self._problems.append(f"{name}: {wanted} is of causality {kind} and must be {'input' if written else 'output'}")
            if name == MODES and variable.ending and variable.dtype.itemsize <= 8:
                continue
            if not variable.real:
                needed = "a number or a Boolean" if name == MODES else "double-precision real"
                self._problems.append(f"{name}: {wanted} is of type {variable.type} and must be {needed}")
        return found

    def _size(self, name: str) -> int:
        return sum(each.size for each in self._found.get(name, ()))

    def _whole(self, name: str) -> bool:
        """Whether all variables of a signal have been found."""
        return len(self._found[name]) == len(self._binding.signals[name].variables) > 0

    def _imu_places(self, name: str, imus: Sequence[int]) -> list[int]:
        beyond = sorted(set(imus) - set(self._all_imus))
        if beyond:
            self._problems.append(f"{name}: there is no imu {beyond[0]} on {self._legs} legs; there are {self._all_imus}")
        return [(IMU_SIGNALS[name] * IMU_COUNT + imu) * 3 + axis for imu in imus for axis in range(3)]

    def _encoded(self) -> list[str]:
        """The signal that encoders read, if there is one."""
        return [name for name in (MOTORS, LENGTHS) if name in self._found][:1]

    def _truth_places(self, name: str) -> range:
        sizes = {"position": 2 if self._legs == PLANAR_LEGS else 3, "quaternion": 4, "angle": 1}
        if name == "angle" and self._legs != PLANAR_LEGS:
            self._problems.append("angle: only a planar plant, with three commands, has one: give its quaternion")
        first = TRUTH_PLACES[name].start
        return range(first, first + sizes.get(name, self._legs))

    def _group(self, places: Mapping[str, Sequence[int]]) -> Scalars:
        """The scalars of some signals, from the places of their elements."""
        references: list[int] = []
        factors: list[float] = []
        offsets: list[float] = []
        for name, elements in places.items():
            if not self._whole(name):
                continue
            found, signal, count = self._found[name], self._binding.signals[name], len(elements)
            references += [reference for each in found for reference in each.references]
            if self._size(name) != count:
                have = "has" if len(found) == 1 else "together have"
                remedy = "; if there are fewer imus, name them with imus" if name in IMU_SIGNALS and signal.imus is None else ""
                self._problems.append(
                    f"{name}: {_names(found)} {have} {self._size(name)} elements and must have {count}{remedy}"
                )
                continue
            units = np.array([self._factor(name, each) for each in found for _ in range(each.size)])
            factors += list(units * self._spread(name, "sign", signal.sign, count))
            offsets += list(self._spread(name, "offset", signal.offset, count))
        return Scalars(
            np.array(references, np.uint32), np.array([place for elements in places.values() for place in elements], np.int64),
            np.array(factors, np.float64), np.array(offsets, np.float64),
        )  # fmt: skip

    def _factor(self, name: str, variable: FmuVariable) -> float:
        known, unit = UNITS[SIGNAL_UNITS[name]], self._binding.signals[name].unit
        if unit is None:
            unit = SIGNAL_UNITS[name] if variable.unit is None else variable.unit
        if unit not in known:
            self._problems.append(f"{name}: {variable.name} is in {unit}: say with unit which of {unit_names(name)} that is")
        return known.get(unit, 1.0)

    def _spread(self, name: str, entry: str, values: tuple[float, ...], count: int) -> Array:
        if len(values) in (1, count) or (len(values) == 3 and name in IMU_SIGNALS):
            return np.resize(np.array(values), count)
        per_axis = ", 3" if name in IMU_SIGNALS else ""
        self._problems.append(f"[{name}] {entry} has {len(values)} numbers and must have 1{per_axis} or {count}")
        return np.ones(count)

    def _modes(self) -> Modes:
        found = self._found.get(MODES, [])
        references = np.array([reference for each in found for reference in each.references], np.uint32)
        if not found or not self._whole(MODES):
            return Modes(references[:0], np.zeros(len(DRIVE_MODES)), None, False)
        size, first = self._size(MODES), found[0]
        if size not in (1, self._legs):
            self._problems.append(f"{MODES}: {_names(found)} together have {size} elements and must have 1, or {self._legs}")
        if len({(each.ending, each.dtype) for each in found}) > 1:
            self._problems.append(f"{MODES}: {_names(found)} are of different types and must be of one")
        usual = (0.0, 0.0, 1.0) if first.type == "Boolean" else tuple(map(float, DRIVE_MODES))
        told = self._binding.signals[MODES].modes
        values = [each if mode is None else mode for each, mode in zip(usual, told, strict=True)]
        if told[OPEN] is None and told[BRAKE] is not None:
            values[OPEN] = values[BRAKE]
        if values[BRAKE] == values[VELOCITY]:
            self._problems.append(f"{MODES}: brake and velocity are both {values[BRAKE]:g} and must differ: give them both")
        if first.ending:
            try:
                for value in values:
                    first.values([value] * first.size, self._description.path.name)
            except GoughError as error:
                self._problems.append(f"{MODES}: {error}")
        return Modes(references, np.array(values), first, size == 1)

    def _check_once(self) -> None:
        """Each scalar of the FMU may be bound once."""
        signals: dict[str, list[str]] = {}
        for name, found in self._found.items():
            for scalar in (scalar for each in found for scalar in each.element_names):
                signals.setdefault(scalar, []).append(name)
        doubled: dict[str, list[str]] = {}
        for scalar, names in signals.items():
            if len(names) > 1:
                doubled.setdefault(" and ".join(dict.fromkeys(names)), []).append(scalar)
        for where, scalars in doubled.items():
            self._problems.append(f"{where}: {', '.join(scalars)} must be bound once, and not more often")

    def _check_start(self) -> None:
        for name, value in self._binding.start.items():
            try:
                variable, owner = self._description[name], self._description.path.name
                variable.values(value, owner)
                check_settable(variable, owner, self._driven)
            except GoughError as error:
                self._problems.append(f"[start] {error}")


def _names(variables: Sequence[FmuVariable]) -> str:
    return ", ".join(each.name for each in variables)
