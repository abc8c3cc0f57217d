"""Named frames that stand on each other, their TOML file, and how to change them.

Three frames are always there: `base` is {1}, `level` has its origin and stays level, and `platform` is {2}.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from controller.frames.rigid import compose, inverse
from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries, parse_toml, read_text, toml_entries, write_whole
from plant.pose import (
    Array,
    Pose,
    checked_array,
    checked_rotation,
    checked_unit,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)

if TYPE_CHECKING:
    from controller.frames.active import ActiveFrames

ROOTS = BASE, LEVEL, PLATFORM = "base", "level", "platform"
"""What all frames stand on in the end."""

FARTHEST_M = 10.0
"""A frame's origin, or the pivot, may be so far from its parent's along each axis."""

ORIENTATIONS = ("quaternion", "angles_deg", "rotation_vector_deg")
"""The entries of which one gives a frame's orientation in its parent."""

MOST_FRAMES = 200
"""In one file."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")
_NOWHERE = Pose(np.zeros(3), np.eye(3))


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame that stands on another.

    Attributes:
        parent: the name of what it stands on.
        position: (3,), its origin in the parent [m].
        rotation: (3, 3), maps it to the parent.
        note: what it is, for a reader.
        entries: how its file gives it.
    """

    parent: str
    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.eye(3))
    note: str = ""
    entries: Mapping[str, Any] | None = None

    @property
    def pose(self) -> Pose:
        """In the parent."""
        return Pose(self.position, self.rotation)

    @classmethod
    def from_entries(cls, entries: Mapping[str, Any], title: str) -> "Frame":
        """A frame from the entries of its table, which messages call `title`, or an `InputError`."""
        check_entries(entries, ("parent", "position", *ORIENTATIONS, "note"), title)
        for name, value in entries.items():
            if name in ("parent", "note") and not isinstance(value, str):
                raise InputError(f"{title}: {name} is {value!r}; it must be a text in quotes")
        if "parent" not in entries:
            raise InputError(f"{title} lacks parent, the frame that it stands on, such as base or platform")
        given = [name for name in ORIENTATIONS if name in entries]
        if len(given) > 1:
            raise InputError(f"{title} has {' and '.join(given)}: keep one of them")
        rotation = rotation_of(given[0], entries[given[0]], title) if given else np.eye(3)
        position = checked_place(entries.get("position", (0.0, 0.0, 0.0)), f"{title}: position")
        return cls(entries["parent"], position, rotation, entries.get("note", ""), dict(entries))

    def lines(self) -> list[str]:
        """Its entries as TOML."""
        if self.entries is not None:
            return toml_entries(self.entries)
        note = {"note": self.note} if self.note else {}
        quaternion = quaternion_from_rotation(self.rotation)
        return toml_entries({"parent": self.parent, "position": self.position, "quaternion": quaternion, **note})


@dataclass(frozen=True, eq=False)
class Pivot:
    """The centre of rotation, which stands in a frame: it moves with the platform if that is a tool's."""

    parent: str
    position: Array = field(default_factory=lambda: np.zeros(3))  # (3,) [m]


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames by name, the pair that is enabled, and the pivot; a change makes new ones.

    Attributes:
        frames: by name, without `ROOTS`.
        work, tool: what is enabled.
        pivot: the centre of rotation; None for the tool's origin.

    Raises:
        InputError: a name cannot be used, frames stand on each other in a circle, or what is enabled is of the wrong kind.
        UnknownNameError: a parent or an enabled frame does not exist.
    """

    frames: Mapping[str, Frame] = field(default_factory=dict)
    work: str = BASE
    tool: str = PLATFORM
    pivot: Pivot | None = None

    def __post_init__(self) -> None:
        if len(self.frames) > MOST_FRAMES:
            raise InputError(f"there are {len(self.frames)} frames; at most {MOST_FRAMES} will do: leave some out")
        for name, frame in self.frames.items():
            _check_name(name)
            self._check_known(frame.parent, f"frame {name!r} stands on {frame.parent!r}, which does not exist")
        for name in self.frames:
            self.chain(name)
        if self.pivot is not None:
            parent = self.pivot.parent
            self._check_known(parent, f"the pivot stands on {parent!r}, which does not exist")
        self._check_work(self.work)
        self._check_tool(self.tool)

    def __iter__(self) -> Iterator[str]:
        """The names of all frames, each after its parent."""

        def below(name: str) -> Iterator[str]:
            yield name
            for child in self.children(name):
                yield from below(child)

        for root in ROOTS:
            yield from below(root)

    def chain(self, name: str) -> list[str]:
        """The names from a frame down to what it stands on in the end, one of `ROOTS`.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: it goes round in a circle.
        """
        self._check_known(name)
        names = [name]
        while names[-1] not in ROOTS:
            parent = self.frames[names[-1]].parent
            if parent in names:
                circle = " on ".join([*names[names.index(parent) :], parent])
                raise InputError(f"frames stand on each other in a circle: {circle}; let one of them stand on base or platform")
            names.append(parent)
        return names

    def root(self, name: str) -> str:
        """What a frame stands on in the end, one of `ROOTS`; errors as of `chain`."""
        return self.chain(name)[-1]

    def kind(self, name: str) -> str:
        """`work` for a frame on the base or the level frame, `tool` for one on the platform; errors as of `chain`."""
        return "tool" if self.root(name) == PLATFORM else "work"

    def children(self, name: str) -> list[str]:
        """The frames that stand on one directly."""
        return [each for each, frame in self.frames.items() if frame.parent == name]

    def dependents(self, name: str) -> list[str]:
        """All frames that stand on one, directly or on each other."""
        return [each for each in self if each != name and name in self.chain(each)]

    def uses(self, name: str) -> list[str]:
        """What would break without a frame, in words."""
        standing = [f"{each} stands on it" for each in self.dependents(name)]
        pivot = ["the pivot stands on it"] if self.pivot is not None and self.pivot.parent == name else []
        return [*standing, *pivot, *(["it is enabled"] if name in (self.work, self.tool) else [])]

    def place(self, name: str) -> Pose:
        """The pose of a frame in its root; errors as of `chain`."""
        pose = _NOWHERE
        for each in self.chain(name)[:-1]:
            pose = compose(self.frames[each].pose, pose)
        return pose

    def pose(self, name: str, seen_in: str, platform: Pose | None = None, attitude: Array | None = None) -> Pose:
        """The pose of a frame in another.

        Args:
            name, seen_in: the frames.
            platform: the pose of {2} in {1}, or many; needed between a tool and a work frame.
            attitude: (..., 3, 3), maps {1} to the level frame; needed between the level frame and the others.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: what is needed is not given.
        """
        here, there = self.root(name), self.root(seen_in)
        inner, outer = self.place(name), inverse(self.place(seen_in))
        if here == there:
            return compose(outer, inner)
        on_base, from_base = (self._root_in_base(root, platform, attitude) for root in (here, there))
        return compose(outer, compose(inverse(from_base), compose(on_base, inner)))

    def _root_in_base(self, root: str, platform: Pose | None, attitude: Array | None) -> Pose:
        if root == PLATFORM:
            if platform is None:
                raise InputError("between a tool and a work frame lies the platform: give its pose")
            return platform
        if root == BASE:
            return _NOWHERE
        if attitude is None:
            raise InputError("between the level frame and the others lies the attitude of the base: give it")
        return Pose(np.zeros(3), np.swapaxes(attitude, -1, -2))

    def active(self, work: str | None = None, tool: str | None = None) -> "ActiveFrames":
        """A work frame and a tool, by default the enabled ones, for poses and moves in them.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: one is of the wrong kind, or the pivot stands on another root than the work frame.
        """
        from controller.frames.active import ActiveFrames

        return ActiveFrames(self.enabled(work, tool))

    def enabled(self, work: str | None = None, tool: str | None = None) -> "Frames":
        """These frames, with another pair enabled; None keeps what is enabled. Errors as of `active`."""
        return replace(self, work=self.work if work is None else work, tool=self.tool if tool is None else tool)

    def with_frame(self, name: str, frame: Frame) -> "Frames":
        """Add or replace a frame; what stands on it moves with it.

        Raises:
            InputError, UnknownNameError: as of the constructor, or the frame is one of `ROOTS`.
        """
        return replace(self, frames={**self.frames, name: frame})

    def linked(self, name: str, parent: str, keep_place: bool = False) -> "Frames":
        """Let a frame stand on another: with the same numbers, or, with `keep_place`, where it is.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: they would stand in a circle; or to keep the place a pose of the platform or the base's attitude would
                be needed.
        """
        frame = self._own(name)
        self._check_known(parent)
        if name in self.chain(parent):
            how = "is itself" if parent == name else f"stands on {name!r}"
            raise InputError(f"{name!r} cannot stand on {parent!r}, which {how}: link {parent!r} to another frame first")
        if not keep_place:
            entries = None if frame.entries is None else {**frame.entries, "parent": parent}
            return self.with_frame(name, replace(frame, parent=parent, entries=entries))
        if self.root(name) != self.root(parent):
            raise InputError(
                f"{name!r} stands on {self.root(name)} and {parent!r} on {self.root(parent)}, which move against each other, "
                "so there is no place to keep: link without keeping it, or measure in place"
            )
        pose = self.pose(name, parent)
        return self.with_frame(name, Frame(parent, pose.position, pose.rotation, frame.note))

    def zeroed(
        self, name: str, platform: Pose, attitude: Array | None = None, parent: str | None = None, turn: bool = True
    ) -> "Frames":
        """Measure in place: here is zero.

        A work frame is put where the enabled tool is, so that the tool reads zero in it. A tool is put where the enabled work
        frame is, as a tip that touches the frame's origin.

        Args:
            name: the frame; a new one needs a parent.
            platform: the pose of {2} in {1} now.
            attitude: (3, 3), maps {1} to the level frame; for frames on `level`.
            parent: what it stands on from now on; None for what it stands on now.
            turn: whether it takes the axes, too; otherwise only the origin.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: the attitude is missing, or an enabled frame would become one of the other kind.
        """
        frame = self.frames.get(name)
        if frame is None and parent is None:
            self._own(name)
        on = parent if parent is not None else self._own(name).parent
        with_it = self.with_frame(name, replace(frame, parent=on, entries=None) if frame is not None else Frame(on))
        here = self.tool if with_it.kind(name) == "work" else self.work
        pose = with_it.pose(here, on, platform, attitude)
        rotation = pose.rotation if turn else with_it.frames[name].rotation
        return with_it.with_frame(name, Frame(on, checked_place(pose.position, name), rotation, frame.note if frame else ""))

    def removed(self, name: str) -> "Frames":
        """Without a frame.

        Raises:
            UnknownNameError: there is no such frame.
            InputError: something depends on it.
        """
        self._own(name)
        if uses := self.uses(name):
            raise InputError(f"{name!r} cannot be removed: {', '.join(uses)}; change that first")
        return replace(self, frames={each: frame for each, frame in self.frames.items() if each != name})

    def text(self) -> str:
        """The TOML text, which `parse_frames` reads again."""
        lines = toml_entries({"work": self.work, "tool": self.tool})
        if self.pivot is not None:
            lines += ["", "[pivot]", *toml_entries({"parent": self.pivot.parent, "position": self.pivot.position})]
        for name, frame in self.frames.items():
            lines += ["", f"[frames.{name}]", *frame.lines()]
        return "\n".join(lines) + "\n"

    def _own(self, name: str) -> Frame:
        """A frame that can be changed."""
        if name in ROOTS:
            raise InputError(f"{name!r} is always there and cannot be changed: choose another name")
        self._check_known(name)
        return self.frames[name]

    def _check_known(self, name: str, problem: str = "") -> None:
        if name not in self.frames and name not in ROOTS:
            names = [*ROOTS, *self.frames]
            problem = problem or f"no frame {name!r}"
            raise UnknownNameError(f"{problem}; there are {', '.join(names)}{nearest(name, names)}")

    def _check_work(self, name: str) -> None:
        if self.kind(name) != "work":
            raise InputError(f"{name!r} stands on the platform, so it is a tool, not a work frame: choose one on base or level")

    def _check_tool(self, name: str) -> None:
        if self.kind(name) != "tool":
            raise InputError(f"{name!r} stands on {self.root(name)}, so it is a work frame, not a tool: choose one on platform")


def _check_name(name: str) -> None:
    if name in ROOTS:
        raise InputError(f"{name!r} is always there and cannot be changed: choose another name")
    if not _NAME.fullmatch(name):
        raise InputError(f"{name!r} cannot name a frame: use a letter, then at most 39 letters, digits, - and _")


def checked_place(value: ArrayLike, title: str) -> Array:
    """A position (3,) [m] within `FARTHEST_M`, or an `InputError`."""
    position = checked_array(value, (3,), title)
    most = float(np.abs(position).max())
    if most > FARTHEST_M:
        raise InputError(f"{title} is {most:g} m off along an axis; at most {FARTHEST_M:g} m will do: give metres")
    return position


def rotation_of(form: str, value: ArrayLike, title: str) -> Array:
    """The rotation (3, 3) of an orientation in one of the forms `ORIENTATIONS`, or an `InputError`."""
    if form == "quaternion":
        return rotation_from_quaternion(checked_unit(value, 4, f"{title}: quaternion"))
    angles = np.radians(checked_array(value, (3,), f"{title}: {form}"))
    if form == "rotation_vector_deg":
        return rotation_from_vector(angles)
    x, y, z = (rotation_from_vector(angle * axis) for angle, axis in zip(angles, np.eye(3), strict=True))
    return checked_rotation(z @ y @ x, title)


def load_frames(path: Path | str) -> Frames:
    """The frames of a TOML file (docs/frames.md).

    Raises:
        InputError: the file cannot be read, is not TOML, or has entries that do not describe frames.
        UnknownNameError: a frame that it names does not exist.
    """
    return parse_frames(read_text(path), str(path))


def parse_frames(text: str, source: str) -> Frames:
    """The frames of a TOML text, which messages call `source`; errors as of `load_frames`."""
    document = parse_toml(text, source)
    try:
        return _frames(document)
    except (InputError, UnknownNameError) as error:
        raise type(error)(f"{source}: {error}") from None


def save_frames(path: Path, frames: Frames) -> None:
    """Write frames to a file; an `InputError` if it cannot be written. Comments of a file that was there are lost."""
    write_whole(path, frames.text().encode())


def _frames(document: Mapping[str, Any]) -> Frames:
    check_entries(document, ("work", "tool", "pivot", "frames"), "the file")
    for name, kind, what in (
        ("work", str, "a text in quotes"),
        ("tool", str, "a text in quotes"),
        ("pivot", dict, "a table"),
        ("frames", dict, "a table"),
    ):
        if not isinstance(document.get(name, kind()), kind):
            raise InputError(f"{name} is {document[name]!r}; it must be {what}")
    frames = {}
    for name, entries in document.get("frames", {}).items():
        _check_name(name)
        if not isinstance(entries, dict):
            raise InputError(f"frames.{name} is {entries!r}; it must be a table")
        frames[name] = Frame.from_entries(entries, f"[frames.{name}]")
    pivot = None
    if (entries := document.get("pivot")) is not None:
        check_entries(entries, ("parent", "position"), "[pivot]")
        parent = entries.get("parent", PLATFORM)
        if not isinstance(parent, str):
            raise InputError(f"[pivot]: parent is {parent!r}; it must be a text in quotes")
        pivot = Pivot(parent, checked_place(entries.get("position", (0.0, 0.0, 0.0)), "[pivot]: position"))
    return Frames(frames, document.get("work", BASE), document.get("tool", PLATFORM), pivot)
