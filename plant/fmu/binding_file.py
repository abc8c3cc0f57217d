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
    """One signal: the FMU's variables that hold it, in order, and the conversion of their values to the loop's.

    Attributes:
        variables: names in the FMU.
        unit: of the FMU's values; None for the unit that the FMU declares, or else the loop's.
        sign: factors of 1 or -1: one, one for each axis, or one for each element.
        offset: added afterwards, in the loop's unit: one, or one for each element.
        imus: numbers of the IMUs; None for all.
        modes: the FMU's values for a drive that is open, braked, and driven at its velocity; None for the usual value.
    """

    variables: tuple[str, ...]
    unit: str | None = None
    sign: tuple[float, ...] = (1.0,)
    offset: tuple[float, ...] = (0.0,)
    imus: tuple[int, ...] | None = None
    modes: tuple[float | None, ...] = (None,) * len(DRIVE_MODES)


@dataclass(frozen=True)
class Binding:
    """A binding that has not been checked against its FMU.

    Attributes:
        source: its file, for messages; "" for gough's own.
        signals: by name.
        step: communication step [s]; None for the control period.
        start: start values by the FMU's own names.
        native: whether the signals are those of gough's own plants, which also have gough's parameters.
        problems: errors in the file.
    """

    source: str
    signals: Mapping[str, SignalBinding]
    step: float | None = None
    start: Mapping[str, Any] = field(default_factory=dict)
    native: bool = False
    problems: tuple[str, ...] = ()


_OWN_SIGNALS = {name: SignalBinding((name,)) for name in SIGNAL_UNITS}
OWN_BINDING = Binding("", _OWN_SIGNALS, native=True)
"""The binding of gough's own plants, spatial and planar."""


def load_binding(path: Path | str) -> Binding:
    """Read a binding; errors in its entries are reported later, together with those in the FMU's variables.

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
        if step is not None and not (_is_number(step) and step >= LEAST_STEP_S):
            self.problems.append(f"[fmu] step is {step!r}; it must be a number of seconds, at least {LEAST_STEP_S:g}")
            return None
        return None if step is None else float(step)

    def signal(self, name: str, table: Mapping[str, Any]) -> SignalBinding:
        entries = _ENTRIES if name != MODES else ("variables", *_MODE_NAMES)
        self.problems += unknown_entries(table, ("imus", *entries) if name in IMU_SIGNALS else entries, f"[{name}]")
        variables = table.get("variables", [])
        if isinstance(variables, str):
            variables = [variables]
        if not (isinstance(variables, list) and variables and all(isinstance(each, str) for each in variables)):
            self.problems.append(f"[{name}] variables is {variables!r}; it must be the name of a variable, or a list of names")
            variables = []
        unit = table.get("unit")
        if unit is not None and not (isinstance(unit, str) and unit in UNITS[SIGNAL_UNITS[name]]):
            self.problems.append(f"[{name}] unit is {unit!r}; it must be one of {unit_names(name)}")
            unit = None
        return SignalBinding(
            tuple(variables), unit, self._signs(name, table), self._numbers(name, "offset", table.get("offset", 0.0)),
            self._imus(name, table.get("imus")), tuple(self._mode(name, mode, table.get(mode)) for mode in _MODE_NAMES),
        )  # fmt: skip

    def _numbers(self, name: str, entry: str, value: Any) -> tuple[float, ...]:
        values = value if isinstance(value, list) else [value]
        if values and all(_is_number(each) or isinstance(each, bool) for each in values):
            return tuple(map(float, values))
        self.problems.append(f"[{name}] {entry} is {value!r}; it must be a number, or a list of numbers")
        return (0.0,) * len(values or [0.0])

    def _mode(self, name: str, mode: str, value: Any) -> float | None:
        if value is None or _is_number(value) or isinstance(value, bool):
            return None if value is None else float(value)
        self.problems.append(f"[{name}] {mode} is {value!r}; it must be a number, true or false")
        return None

    def _signs(self, name: str, table: Mapping[str, Any]) -> tuple[float, ...]:
        signs = self._numbers(name, "sign", table.get("sign", 1))
        if set(signs) <= {1.0, -1.0}:
            return signs
        self.problems.append(f"[{name}] sign is {table['sign']!r}; it must be 1 or -1, or a list of these")
        return (1.0,)

    def _imus(self, name: str, value: Any) -> tuple[int, ...] | None:
        if value is None:
            return None
        if (
            isinstance(value, list)
            and value
            and all(type(each) is int and each in range(IMU_COUNT) for each in value)
            and len(set(value)) == len(value)
        ):
            return tuple(value)
        self.problems.append(f"[{name}] imus is {value!r}; it must be a list of different numbers from 0 to {PLATFORM_IMU}")
        return None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


def unit_names(signal: str) -> str:
    """The units that an FMU may use for a signal."""
    return ", ".join(name for name in UNITS[SIGNAL_UNITS[signal]] if name)
