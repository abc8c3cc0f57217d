"""Bindings: which of an FMU's variables hold the loop's signals, as a TOML file says (docs/fmu.md).

A signal has the name of gough's own variable (`plant.dynamics.variables`). One or several variables of the FMU hold its values.
In the binding of gough's own plants, every signal is the variable of its name.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from plant.dynamics.variables import DRIVE_MODES, IMU_COUNT, PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER
from plant.toml import read_toml, unknown_entries
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION

IMU_SIGNALS = {"imu_angular_velocity": GYROSCOPE, "imu_specific_force": ACCELEROMETER, "imu_magnetic_field": MAGNETOMETER}
TRUTH_PLACES = {
    "position": TRUTH_POSITION, "quaternion": TRUTH_QUATERNION, "angle": TRUTH_QUATERNION, "leg_length": TRUTH_LENGTHS,
    "current": TRUTH_CURRENTS,
}  # fmt: skip
"""Where a signal lies in the truth (`plant.truth`). A planar plant tells its angle in the first place of the quaternion."""

COMMANDS, MODES, PAYLOAD = "velocity_command", "drive_mode", "payload.mass"

UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "dm": 0.1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "um/s": 1e-6, "m/min": 1 / 60, "mm/min": 1e-3 / 60, "in/s": 0.0254},
    "m/s2": {"m/s2": 1.0, "m/s^2": 1.0, "mm/s2": 1e-3, "mm/s^2": 1e-3, "g": 9.80665, "mg": 9.80665e-3},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": np.pi / 180, "rpm": np.pi / 30, "1/min": np.pi / 30},
    "uT": {"uT": 1.0, "nT": 1e-3, "mT": 1e3, "T": 1e6, "G": 100.0, "mG": 0.1},
    "A": {"A": 1.0, "mA": 1e-3},
    "kg": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "1": {"1": 1.0, "": 1.0},
}
"""By the loop's unit: the units that an FMU may use, with the factor from the FMU's to the loop's."""

SIGNAL_UNITS = {
    COMMANDS: "m/s", MODES: "1", "imu_angular_velocity": "rad/s", "imu_specific_force": "m/s2", "imu_magnetic_field": "uT",
    "position": "m", "quaternion": "1", "angle": "rad", "leg_length": "m", "current": "A", PAYLOAD: "kg",
}  # fmt: skip
"""The loop's unit of every signal."""

REQUIRED = (COMMANDS, "imu_angular_velocity", "imu_specific_force")
WRITTEN = (COMMANDS, MODES, PAYLOAD)
_MODE_NAMES = tuple(DRIVE_MODES.values())
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
    """Read a binding; errors in its entries are reported later, with those in the FMU's variables.

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
        entries = _ENTRIES if name != MODES else ("variables", *_MODE_NAMES)
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
            tuple(self._mode(name, mode, table.get(mode)) for mode in _MODE_NAMES),
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
