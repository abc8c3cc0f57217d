"""Named points that an operator goes to: a TOML file with a table [points], as a motion file has one, too."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from controller.planning.motions.document import place_of
from controller.planning.motions.elements import Place
from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import parse_toml, read_text

HOME = "home"
"""The point that is always there: the mechanism's home."""

_FRAMES = ("frame", "tool")


@dataclass(frozen=True)
class Point:
    """A place, and the work frame and tool in which it is; None for those of the run."""

    place: Place
    frame: str | None = None
    tool: str | None = None


def load_points(path: str | Path) -> dict[str, Point]:
    """The points of a TOML file by name.

    A point has the entries of a place in a motion file (docs/motions.md), and may have `frame` and `tool`.

    Raises:
        InputError: the file cannot be read, or a point cannot be used.
    """
    source = Path(path).name
    named = parse_toml(read_text(path), source).get("points")
    if not isinstance(named, Mapping) or not named:
        raise InputError(f"{source} has no points: give tables such as [points.left]")
    points = {}
    for name, table in named.items():
        title = f"{source}, [points.{name}]"
        if name == HOME:
            raise InputError(f"{title}: {HOME!r} is the mechanism's own: choose another name")
        if not isinstance(table, Mapping):
            raise InputError(f"{title} is {table!r}; it must be a table")
        where = dict(table)
        frames = {each: where.pop(each, None) for each in _FRAMES}
        for each, given in frames.items():
            if given is not None and not isinstance(given, str):
                raise InputError(f"{title}: {each} is {given!r}; it must be a text in quotes")
        points[name] = Point(place_of(where, title, _FRAMES), **frames)
    return points


def require_point(points: Mapping[str, Point], name: str) -> Point:
    """The point of a name, or an `UnknownNameError`."""
    if name not in points:
        names = [HOME, *points]
        raise UnknownNameError(
            f"no point {name!r}; there are {', '.join(names)}{nearest(name, names)}: name a file with it by --points when the "
            "run is started"
        )
    return points[name]
