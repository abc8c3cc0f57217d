"""Motions as TOML documents (docs/motions.md)."""

from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from controller.planning.motions.cueing import Washout
from controller.planning.motions.elements import KINDS, Element, Motion, Place, SplinePoint, ToolLimits
from controller.planning.motions.waves import AXES, SHAPES, AnyWave
from plant.checks import nearest
from plant.errors import InputError
from plant.files import check_entries, parse_toml, read_text, toml_entries
from plant.pose import checked_array, checked_unit, rotation_from_quaternion, vector_from_rotation

T = TypeVar("T")

_DEGREES = "_deg"
_ANGLES = (
    "rotation", "angle", "phase", "turn_speed", "turn_acceleration", "turn_jerk", "turn_velocity",
    "most_turn_speed", "tilt", "tilt_speed",
)  # fmt: skip
_SIZES = ("amplitude", "amplitudes", "radius", "rms")
"""Angles, and what is an angle on an axis of turns; each can be given in degrees under its name with `_deg`."""

_LIMITS = tuple(each.name for each in fields(ToolLimits))
_PLACE = (*(each.name for each in fields(Place)), "quaternion")
_PLACES = ("to", "through", "centre")


def load_motion(path: str | Path) -> Motion:
    """The motion of a TOML file; files that it names are beside it.

    Raises:
        InputError: the file cannot be read, or is no motion.
    """
    return motion_from_text(read_text(path), Path(path).name, Path(path).parent)


def motion_from_text(text: str, source: str, folder: Path = Path()) -> Motion:
    """The motion of a TOML text, which messages call `source`; errors as for `load_motion`."""
    try:
        return _Reader(folder).motion(parse_toml(text, source), source)
    except InputError as error:
        raise error if str(error).startswith(source) else InputError(f"{source}, {error}") from None


def load_washout(path: str | Path) -> Washout:
    """The settings of a washout from a TOML file, which has the entries of a cueing element but those of its file and end.

    Raises:
        InputError: the file cannot be read, or is none.
    """
    name = Path(path).name
    return _made(Washout, _in_radians(parse_toml(read_text(path), name), name), name)


def place_of(table: Any, title: str, also: Iterable[str] = ()) -> Place:
    """The place of a table, which messages call `title`; they list what the table may have, and `also` besides.

    Raises:
        InputError: it is no place.
    """
    return _Reader(Path()).place(table, title, also)


def text_of_motion(motion: Motion) -> str:
    """The TOML text of a motion, which `motion_from_text` reads again."""
    tables = _plain(motion)
    elements = tables.pop("elements")
    lines = toml_entries({name: value for name, value in tables.items() if value != {}})
    for element in elements:
        lines += ["", "[[elements]]", *toml_entries(element)]
    return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    """What a motion file has for a value."""
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    if not is_dataclass(value):
        return value
    given = {
        each.name: _plain(getattr(value, each.name))
        for each in fields(value)
        if each.default is MISSING or getattr(value, each.name) != each.default
    }
    if not isinstance(value, Motion):
        given |= given.pop("limits", {}) | given.pop("place", {})
    for names, key in ((KINDS, "kind"), (SHAPES, "shape")):
        for name, kind in names.items():
            if type(value) is kind:
                return {key: name, **given}
    return given


class _Reader:
    """Reads a document; keeps its named points, and where its files are."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._points: dict[str, Place] = {}

    def motion(self, document: dict[str, Any], source: str) -> Motion:
        named = _table(document.get("points", {}), "[points]")
        self._points = {name: self.place(table, f"[points.{name}]") for name, table in named.items()}
        given = {name: value for name, value in document.items() if name != "points"}
        given.setdefault("name", source)
        if not isinstance(given["name"], str):
            raise InputError(f"name is {given['name']!r}; it must be a text")
        return _made(
            Motion,
            given,
            "the file",
            also=("points",),
            elements=self._elements,
            start=lambda value: self.place(value, "[start]"),
            limits=lambda value: _made(ToolLimits, _in_radians(_table(value, "[limits]"), "[limits]"), "[limits]"),
        )

    def _elements(self, values: Any, prefix: str = "") -> tuple[Element, ...]:
        return tuple(self._element(value, f"{prefix}{k}") for k, value in enumerate(_tables(values, "elements"), start=1))

    def _element(self, given: dict[str, Any], number: str) -> Element:
        kind = given.get("kind")
        if kind not in KINDS:
            lacks = "lacks a kind" if kind is None else f"has the kind {kind!r}"
            raise InputError(f"element {number} {lacks}; there are {', '.join(KINDS)}{nearest(str(kind), KINDS)}")
        title = f"element {number} ({kind})"
        table = _in_radians({name: value for name, value in given.items() if name != "kind"}, title)
        also = ["kind"]
        if "limits" in {each.name for each in fields(KINDS[kind])}:
            if "limits" in table:
                raise InputError(f"{title} has a table of limits; give its entries, {', '.join(_LIMITS)}, without a table")
            own = {name: table.pop(name) for name in _LIMITS if name in table}
            also += _LIMITS
            if own:
                table["limits"] = own
        return _made(
            KINDS[kind], table, title, also=also,
            elements=lambda values: self._elements(values, f"{number}."),
            points=lambda values: tuple(
                self._spline_point(value, f"{title}, point {k}")
                for k, value in enumerate(_listed(values, f"{title}, points"), start=1)
            ),
            waves=lambda values: tuple(
                self._wave(value, f"{title}, wave {k}") for k, value in enumerate(_tables(values, f"{title}, waves"), start=1)
            ),
            limits=lambda own: _made(ToolLimits, own, title),
            file=self._file,
            **{name: lambda value, name=name: self.place(value, f"{title}, {name}") for name in _PLACES},
        )  # fmt: skip

    def place(self, given: Any, title: str, also: Iterable[str] = ()) -> Place:
        """The place of a table, or of a point's name; `also` as in `place_of`."""
        if isinstance(given, str):
            if given not in self._points:
                there = f"there are {', '.join(self._points)}" if self._points else "there is no table [points]"
                raise InputError(f"{title} names no point: {given!r}; {there}{nearest(given, self._points)}")
            return self._points[given]
        table = _in_radians(_table(given, title), title)
        if "quaternion" in table:
            if "rotation" in table:
                raise InputError(f"{title} has a quaternion and a rotation: give one of them")
            try:
                turned = rotation_from_quaternion(checked_unit(table.pop("quaternion"), 4, "quaternion"))
            except InputError as error:
                raise InputError(f"{title}: {error}") from None
            table["rotation"] = tuple(vector_from_rotation(turned).tolist())
        if isinstance(table.get("relative", False), bool):
            return _made(Place, table, title, also=("quaternion", *also))
        raise InputError(f"{title}: relative is {table['relative']!r}; it must be true or false")

    def _spline_point(self, given: Any, title: str) -> SplinePoint:
        if isinstance(given, str):
            return SplinePoint(self.place(given, title))
        table = _in_radians(_table(given, title), title)
        own = [each.name for each in fields(SplinePoint) if each.name != "place"]
        check_entries(table, ["point", *_PLACE, *own], title)
        where: Any = {name: table.pop(name) for name in _PLACE if name in table}
        if "point" in table:
            if where:
                raise InputError(f"{title} names a point and has {next(iter(where))}: give one of them")
            where = table.pop("point")
        table["place"] = self.place(where, title)
        return _made(SplinePoint, table, title)

    def _wave(self, given: dict[str, Any], title: str) -> AnyWave:
        shape = given.get("shape")
        if shape not in SHAPES:
            lacks = "lacks a shape" if shape is None else f"has the shape {shape!r}"
            raise InputError(f"{title} {lacks}; there are {', '.join(SHAPES)}{nearest(str(shape), SHAPES)}")
        table = _in_radians({name: value for name, value in given.items() if name != "shape"}, title)
        return _made(SHAPES[shape], table, f"{title} ({shape})", also=("shape",), file=self._file)

    def _file(self, name: Any) -> str:
        """The path of a file beside the document."""
        return str(self._folder / str(name))


def _made(kind: type[T], table: dict[str, Any], title: str, also: Iterable[str] = (), **readers: Any) -> T:
    """An object of a dataclass from a table with its fields; `readers` read some of them, and `also` is known besides."""
    made: Any = kind
    declared = {each.name: each for each in fields(made)}
    known = [name for name in declared if name not in ("limits", "place") or name in table or kind is Motion]
    check_entries(table, [*also, *known], title)
    for name, each in declared.items():
        if name not in table and each.default is MISSING and each.default_factory is MISSING:
            raise InputError(f"{title} lacks {name}")
    values = {
        name: readers[name](value) if name in readers else tuple(value) if isinstance(value, list) else value
        for name, value in table.items()
    }
    try:
        found: T = made(**values)
    except (InputError, TypeError, ValueError) as error:
        raise InputError(f"{title}: {error}") from None
    return found


def _table(value: Any, title: str) -> dict[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{title} is {value!r}; it must be a table")
    return dict(value)


def _listed(values: Any, title: str) -> list[Any]:
    if not isinstance(values, list):
        raise InputError(f"{title} is {values!r}; it must be a list")
    return values


def _tables(values: Any, title: str) -> list[dict[str, Any]]:
    return [_table(value, f"entry {k} of {title}") for k, value in enumerate(_listed(values, title), start=1)]


def _in_radians(table: dict[str, Any], title: str) -> dict[str, Any]:
    """A table whose angles in degrees are in radians."""
    turns = all(str(axis) in AXES[3:] for axis in (table.get("axis"), *table.get("axes", ())) if axis is not None)
    named = "axis" in table or "axes" in table
    found: dict[str, Any] = {}
    for name, value in table.items():
        base = name.removesuffix(_DEGREES)
        angle = base in _ANGLES or (base in _SIZES and named and turns)
        if base == name or not angle:
            found[name] = value
            continue
        if base in table:
            raise InputError(f"{title} has {base} and {name}: give one of them")
        try:
            angles = checked_array(value, np.shape(value), name)
        except InputError as error:
            raise InputError(f"{title}: {error}") from None
        found[base] = np.radians(angles).tolist()
    return found
