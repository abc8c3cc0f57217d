"""The names and values that a study may give: fields of a run, entries of a mechanism's file, parameters of the plant."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from controller.settings import ControlSettings, DriveSettings, FusionSettings, SafetySettings
from hil.runs.config import OF_RUNS, SimulationConfig
from plant.checks import nearest
from plant.dynamics.variables import PLANAR, SPATIAL
from plant.errors import InputError
from plant.files import check_entries
from plant.mechanism.checks import Limits
from plant.mechanism.joint_circles import ENTRIES as GEOMETRY

PARTS = ("run", "mechanism", "geometry", "plant")
"""What the name of a factor begins with."""


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number, which a switch is not."""
    return isinstance(value, int) and not isinstance(value, bool)


def run_fields() -> dict[str, Any]:
    """The fields of a run's configuration that a study can set, with how their text is read; faults have spaces in between."""
    return {
        each.name: each.metadata["option"].parse
        for each in fields(SimulationConfig)
        if "option" in each.metadata and each.name not in ("settings", "faults", *OF_RUNS)
    } | {"hold": None, "faults": lambda text: tuple(text.split())}


def is_factor(name: str) -> bool:
    """Whether this is the name of a factor of runs; a figure of the geometry's has none of the geometry's numbers."""
    part, _, rest = name.partition(".")
    return part in PARTS and (part != "geometry" or rest in GEOMETRY)


def check_factor(name: str) -> None:
    """Check the name of a factor of runs."""
    part, _, rest = name.partition(".")
    if part not in PARTS or not rest:
        raise InputError(
            f"{name} cannot vary: a factor is run.FIELD, mechanism.TABLE.ENTRY, geometry.NUMBER or plant.PARAMETER"
            f"{nearest(part, PARTS)}"
        )
    if part == "run":
        check_entries({rest: None}, run_fields(), "a run")
    if part == "geometry":
        check_entries({rest: None}, GEOMETRY, "the geometry")


def check_entry(name: str) -> None:
    """Check the name of an entry of the mechanism's file, as far as its tables have the same entries in all mechanisms."""
    part, _, entry = name.partition(".")
    if part != "mechanism":
        return
    table, _, rest = entry.partition(".")
    tables = ("name", "based_on", "geometry", "home", "joints", "bodies", *_SETTINGS, "plant")
    check_entries({table: None}, tables, "a mechanism")
    if table in _SETTINGS:
        check_entries({rest.partition(".")[0]: None}, sorted(each.name for each in fields(_SETTINGS[table])), f"[{table}]")
    elif table == "plant" and not any(rest == known or rest.startswith(f"{known}.") for known in _PARAMETERS):
        raise InputError(f"[plant] has no entry {rest!r}{nearest(rest, _PARAMETERS)}; docs/fmu.md lists the plant's parameters")


def check_parameter(name: str) -> None:
    """Check the name of a parameter or input of gough's own plant."""
    part, _, rest = name.partition(".")
    known = [*_PARAMETERS, *(each.name for table in (SPATIAL, PLANAR) for each in table.inputs)]
    rest, *_ = rest.partition("@")
    if part == "plant" and rest not in known:
        raise InputError(f"the plant has no parameter or input {rest!r}{nearest(rest, known)}; docs/fmu.md lists them")


_SETTINGS: dict[str, Any] = {
    "limits": Limits, "control": ControlSettings, "fusion": FusionSettings, "safety": SafetySettings,
    "drives": DriveSettings,
}  # fmt: skip
"""Tables of a mechanism's file, and what has their entries."""
_PARAMETERS = [each.name for table in (SPATIAL, PLANAR) for each in table.parameters]


def parsed(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a run's fields, read as the command line reads them if they are text."""
    readers: dict[str, Callable[[str], Any] | None] = run_fields()
    check_entries(values, readers, "[run]")
    return {name: _read(name, value, readers[name]) for name, value in values.items()}


def _read(name: str, value: Any, read: Callable[[str], Any] | None) -> Any:
    default = SimulationConfig.__dataclass_fields__[name].default
    if default is None:
        default = 0.0 if name == "hold" else ""
    if read is not None and isinstance(value, str):
        return read(value)
    if isinstance(default, tuple) and isinstance(value, list | tuple) and all(map(is_whole, value)):
        return tuple(value)
    if isinstance(default, float) and is_whole(value):
        return float(value)
    kind, words = next(each for each in _KINDS if isinstance(default, each[0]))
    if isinstance(value, bool) != (kind is bool) or not isinstance(value, kind):
        raise InputError(f"run.{name} = {value!r} must be {words}")
    return value


_KINDS: tuple[tuple[type, str], ...] = (
    (bool, "true or false"),
    (int, "a whole number"),
    (float, "a number"),
    (tuple, "a list of whole numbers, or text"),
    (str, "text"),
)
"""What a run's field takes, by the kind of its default; checked in this order, as a switch is a whole number, too."""
