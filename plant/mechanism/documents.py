"""Mechanisms as TOML documents: presets and files, what they are based on, and their tables."""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries, parse_toml, read_text, toml_entries
from plant.mechanism.bodies import body_tables, swing_entries
from plant.mechanism.checks import checked_joints
from plant.mechanism.planar import PlanarMechanism, PlanarPose
from plant.mechanism.spatial import LEGS, Mechanism
from plant.pose import Pose, checked_array, checked_unit, quaternion_from_rotation, rotation_from_quaternion

_PRESETS = resources.files("plant.mechanism") / "presets"

_JOINTS = ("base_joints", "platform_joints")
_MUCH_SHORTER = 0.8
_MOST_MASS_RATIO = 3.0
_SETTINGS = ("control", "fusion", "safety", "drives")
_ANY_ENTRY = ("limits", "plant", *_SETTINGS, "joints", "bodies")
"""Tables whose entries are checked by those who read them."""

_SAME_FRAMES = 1e-9
"""Largest difference in an entry of rotations that are the same."""


def load_mechanism(name_or_path: str | Path, changes: Mapping[str, Any] | None = None) -> Mechanism | PlanarMechanism:
    """Load a preset by its name, or a mechanism from a TOML file; joints of two numbers make it a planar one.

    Args:
        name_or_path: of the preset or the file.
        changes: entries that replace those of the file, by name with dots, such as {"control.proportional": 30.0}.

    Raises:
        UnknownNameError: no such preset, and no such file; or a change leads into something that is no table.
        InputError: the content is not a mechanism.
    """
    return mechanism_from_text(mechanism_text(name_or_path), str(name_or_path), changes)


def mechanism_from_text(text: str, source: str, changes: Mapping[str, Any] | None = None) -> Mechanism | PlanarMechanism:
    """The mechanism of a TOML text, which messages call `source`; changes and errors as for `load_mechanism`."""
    document = parse_toml(text, source)
    try:
        document = _completed(document, source)
        for entry, value in (changes or {}).items():
            set_entry(document, entry, value)
        return mechanism_from_document(document)
    except (InputError, UnknownNameError) as error:
        raise type(error)(f"{source}: {error}") from None


def mechanism_document(text: str, source: str) -> dict[str, Any]:
    """The document of a TOML text, laid over the presets that it is based on.

    Raises:
        UnknownNameError: no such preset.
        InputError: the text is not TOML.
    """
    return _completed(parse_toml(text, source), source)


def load_spatial(name_or_path: str | Path) -> Mechanism:
    """`load_mechanism` for callers that need six legs; a planar mechanism is an error."""
    mechanism = load_mechanism(name_or_path)
    if isinstance(mechanism, PlanarMechanism):
        raise InputError(f"{name_or_path} has three legs in the plane; this needs six in space: choose another mechanism")
    return mechanism


def load_in_space(name_or_path: str | Path) -> Mechanism:
    """`load_mechanism` for the loop, which sees a planar mechanism in space; one without a home is an error."""
    mechanism = load_mechanism(name_or_path)
    return Mechanism.from_planar(mechanism) if isinstance(mechanism, PlanarMechanism) else mechanism


def mechanism_text(name_or_path: str | Path) -> str:
    """The TOML text of a preset, or of a file; errors as for `load_mechanism`."""
    if str(name_or_path) in preset_names():
        return (_PRESETS / f"{name_or_path}.toml").read_text()
    path = Path(name_or_path)
    if not path.is_file():
        names = preset_names()
        raise UnknownNameError(
            f"no mechanism {str(path)!r}: neither a preset ({', '.join(names)}) nor a file{nearest(str(path), names)}"
        )
    return read_text(path)


def mechanism_from_document(document: dict[str, Any]) -> Mechanism | PlanarMechanism:
    """The mechanism of a document that is based on no other; errors as for `load_mechanism`."""
    planar = _is_planar(document)
    tables: dict[str, tuple[str, ...] | None] = {
        "geometry": _JOINTS if planar else ("base_joint_axes", *_JOINTS, "up_in_base"),
        "home": ("angle", "position") if planar else ("position", "quaternion"),
        **dict.fromkeys(_ANY_ENTRY),
    }
    for name, table in document.items():
        if name == "name":
            continue
        if name not in tables:
            raise InputError(
                f"unknown entry {name!r}; a mechanism has name, {', '.join(tables)}, based_on{nearest(name, tables)}"
            )
        if not isinstance(table, dict):
            raise InputError(f"{name!r} must be a table")
        if (known := tables[name]) is not None:
            check_entries(table, known, f"[{name}]")
    for joints in _JOINTS:
        if joints not in document.get("geometry", {}):
            rows = "three rows of two" if planar else "six rows of three"
            raise InputError(f"[geometry] lacks {joints}, an array of {rows} numbers in metres")
    home = _home(document["home"], planar) if "home" in document else None
    if isinstance(home, Pose) and "quaternion" in document["home"]:
        _check_quaternion_order(home, document["home"]["quaternion"], document["geometry"])
    kind: Any = PlanarMechanism if planar else Mechanism
    mechanism: Mechanism | PlanarMechanism = kind.from_legs(
        **document["geometry"],
        name=str(document.get("name", "custom")),
        home=home,
        limits=document.get("limits") or None,
        joints=document.get("joints"),
        bodies=document.get("bodies"),
        plant=_flattened(document.get("plant", {})),
        settings={name: document.get(name, {}) for name in _SETTINGS},
    )
    return mechanism


def _check_quaternion_order(home: Pose, quaternion: Any, geometry: dict[str, Any]) -> None:
    """Check that the legs would not be much shorter with the quaternion's numbers in the order x, y, z, w."""
    x, y, z, w = checked_array(quaternion, (4,), "home.quaternion").tolist()
    base, platform = checked_joints(geometry["base_joints"], geometry["platform_joints"], (LEGS, 3))
    given, other = (
        float(np.linalg.norm(home.position + platform @ rotation.T - base, axis=1).mean())
        for rotation in (home.rotation, rotation_from_quaternion(np.array([w, x, y, z])))
    )
    if other < _MUCH_SHORTER * given:
        raise InputError(
            f"home.quaternion is {quaternion}, with which the legs are {given:.3g} m long on average; in the order x, "
            f"y, z, w they would be {other:.3g} m: quaternions are w first, so write {[w, x, y, z]}"
        )


def text_of_mechanism(mechanism: Mechanism | PlanarMechanism) -> str:
    """The TOML text of a mechanism, which `mechanism_from_text` reads again.

    Raises:
        InputError: its joints were moved after it was made, so that its leg frames do not follow from them.
    """
    planar = isinstance(mechanism, PlanarMechanism) or mechanism.planar
    axes = slice(2 if planar else 3)
    geometry = {"base_joints": mechanism.base_joints[:, axes], "platform_joints": mechanism.platform_joints[:, axes]}
    if isinstance(mechanism, Mechanism) and not planar:
        geometry |= {"base_joint_axes": mechanism.base_joint_axes, "up_in_base": mechanism.up_in_base}
    tables = {
        "geometry": geometry,
        "home": _home_entries(mechanism.home, planar),
        "limits": {} if mechanism.limits is None else vars(mechanism.limits),
        "joints": swing_entries(mechanism.joints, planar),
        **body_tables(mechanism.bodies, planar),
        "plant": mechanism.plant,
        **mechanism.settings,
    }
    lines = toml_entries({"name": mechanism.name})
    for name, entries in tables.items():
        if entries:
            lines += ["", f"[{name}]", *toml_entries(entries)]
    text = "\n".join(lines) + "\n"
    if isinstance(mechanism, Mechanism):
        again = mechanism_from_text(text, mechanism.name)
        frames = Mechanism.from_planar(again) if isinstance(again, PlanarMechanism) else again
        if np.abs(frames.joint_rotations - mechanism.joint_rotations).max() > _SAME_FRAMES:
            raise InputError(
                f"the joints of {mechanism.name!r} were moved after it was made, and its leg frames were not: give the "
                "mechanism as it was designed, and the moves in a calibration"
            )
    return text


def _home_entries(home: Pose | PlanarPose | None, planar: bool) -> dict[str, Any]:
    if isinstance(home, PlanarPose):
        return {"position": home.position, "angle": home.angle}
    if home is None:
        return {}
    if planar:
        return {"position": home.position[:2], "angle": float(np.arctan2(home.rotation[1, 0], home.rotation[0, 0]))}
    return {"position": home.position, "quaternion": quaternion_from_rotation(home.rotation)}


def set_entry(document: Any, entry: str, value: Any) -> None:
    """Set an entry of a document, by its name with dots, such as limits.velocity or geometry.base_joints.0.2.

    Raises:
        UnknownNameError: the name leads into something that is no table or list, or beyond a list.
    """
    *tables, last = entry.split(".")
    inner = document
    for part in tables:
        if isinstance(inner, list):
            inner = inner[_index(part, inner, entry)]
            continue
        _check_table(inner, entry)
        if part not in inner:
            inner[part] = {}
        inner = inner[part]
    if isinstance(inner, list):
        inner[_index(last, inner, entry)] = value
    else:
        _check_table(inner, entry)
        inner[last] = value


def _index(part: str, inner: list[Any], entry: str) -> int:
    if not part.isdecimal() or int(part) >= len(inner):
        raise UnknownNameError(f"the mechanism has no entry {entry}: {part!r} is no number from 0 to {len(inner) - 1}")
    return int(part)


def _check_table(inner: Any, entry: str) -> None:
    if not isinstance(inner, dict):
        raise UnknownNameError(f"the mechanism has no entry {entry}: {'.'.join(entry.split('.')[:-1])} is no table")


def preset_names() -> list[str]:
    """The names of all presets."""
    return sorted(entry.name.removesuffix(".toml") for entry in _PRESETS.iterdir() if entry.name.endswith(".toml"))


def _completed(document: dict[str, Any], source: str) -> dict[str, Any]:
    """A document laid over the preset that it is based on, and so on."""
    names = [source]
    while "based_on" in document:
        names.append(document.pop("based_on"))
        if names[-1] not in preset_names():
            presets = preset_names()
            question = nearest(str(names[-1]), presets)
            raise UnknownNameError(f"based_on names no preset: {names[-1]!r}; there are {', '.join(presets)}{question}")
        if names[-1] in names[:-1]:
            raise InputError(f"based_on goes round in a circle, {' -> '.join(names)}: leave one out")
        preset = parse_toml(mechanism_text(names[-1]), names[-1])
        preset.pop("name", None)
        _check_inertias(document, preset, names[-1])
        document = _merged(preset, document)
    return document


def _check_inertias(document: dict[str, Any], preset: dict[str, Any], name: str) -> None:
    """Check that no body has a mass of its own, and the inertia of a preset's body of another mass."""
    for body in ("platform", "payload"):
        own, under = (_table_of(_table_of(each, "plant"), body) for each in (document, preset))
        if "inertia" in own or "inertia" not in under or "mass" not in own.keys() & under.keys():
            continue
        mass, before = (float(checked_array(each["mass"], (), f"{body}.mass")) for each in (own, under))
        if mass > _MOST_MASS_RATIO * before or before > _MOST_MASS_RATIO * mass:
            raise InputError(
                f"{body}.mass is {mass:g} kg, and {body}.inertia is left as {name}'s, for {before:g} kg: give the "
                f"inertia in [plant.{body}], too"
            )


def _table_of(table: dict[str, Any], name: str) -> dict[str, Any]:
    inner = table.get(name, {})
    return inner if isinstance(inner, dict) else {}


def _merged(under: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """Two nested tables as one; where both have an entry that is no table, `over` wins."""
    shared = [key for key in under.keys() & over.keys() if isinstance(under[key], dict) and isinstance(over[key], dict)]
    return under | over | {key: _merged(under[key], over[key]) for key in shared}


def _is_planar(document: dict[str, Any]) -> bool:
    try:
        return bool(np.shape(document["geometry"]["base_joints"])[-1:] == (2,))
    except (LookupError, TypeError, ValueError):
        return False


def _home(table: Any, planar: bool) -> Pose | PlanarPose:
    if planar:
        return PlanarPose(table.get("position"), table.get("angle", 0.0))
    quaternion = checked_unit(table.get("quaternion", (1.0, 0.0, 0.0, 0.0)), 4, "home.quaternion")
    return Pose(checked_array(table.get("position"), (3,), "home.position"), rotation_from_quaternion(quaternion))


def _flattened(tables: dict[str, Any], prefix: str = "") -> dict[str, ArrayLike]:
    """Nested tables as one, with dots in the names."""
    flat: dict[str, ArrayLike] = {}
    for name, value in tables.items():
        flat |= _flattened(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat
