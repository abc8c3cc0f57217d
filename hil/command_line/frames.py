"""The command frames."""

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hil.command_line import cli
from hil.table import Table
from plant.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from controller.frames import Frames
    from plant.pose import Array, Pose

_FILE = cli.source("file", "FILE.toml", "the frames (docs/frames.md)")
_NAME = cli.argument("name", metavar="NAME", help="the frame")
_HERE = (
    cli.argument(
        "--recording",
        metavar="FILE.mcap",
        help="where the platform is: the estimated pose of a recorded cycle, by default its last",
    ),
    cli.argument("--at", type=float, metavar="SECONDS", help="which cycle: the last one until this time of the recording [s]"),
    cli.argument("--home", metavar="MECHANISM", help="where the platform is: at the home of this preset or file"),
    cli.argument(
        "--pose",
        metavar="X,Y,Z[,QW,QX,QY,QZ]",
        help="where the platform is: its position in the base [m], and the unit quaternion of its orientation",
    ),
    cli.argument(
        "--attitude", metavar="W,X,Y,Z", help="attitude of the base, which maps it to the level frame; for frames on level"
    ),
)
_PARENT = cli.argument("--parent", metavar="FRAME", help="what it stands on; needed for a new frame")


@cli.command(_FILE)
def gough_frames_list(options: Namespace) -> None:
    """List the frames: what each stands on, where, what is enabled, and what depends on it."""
    frames = _read(options.file)
    table = Table("frame", "position [mm]", "rotation vector [deg]", "kind", "depends on it", "note", left=(0, 3, 4, 5))
    for name in frames:
        depth = len(frames.chain(name)) - 1
        frame = frames.frames.get(name)
        numbers = ("", "") if frame is None else _numbers(frame.pose)
        marks = [frames.kind(name), *(["enabled"] if name in (frames.work, frames.tool) else [])]
        table.add(
            "  " * depth + name,
            *numbers,
            ", ".join(marks),
            ", ".join(_dependents(frames, name)),
            "" if frame is None else frame.note,
        )
    table.print()
    if frames.pivot is None:
        print(f"turns are about the origin of {frames.tool}, as there is no [pivot]")
    else:
        print(f"turns are about the pivot, {_millimetres(frames.pivot.position)} mm in {frames.pivot.parent}")
    print(f"a target is {frames.active().text}")


@cli.command(_FILE, _NAME, *_HERE, cli.JSON)
def gough_frames_show(options: Namespace) -> None:
    """Show a frame: the chain that it stands on, its place in each, and what depends on it.

    With the place of the platform, also its pose in the base and in the enabled work frame.
    """
    from controller.frames import BASE
    from plant.pose import quaternion_from_rotation

    frames = _read(options.file)
    places: dict[str, Any] = {f"in {each}": frames.pose(options.name, each) for each in frames.chain(options.name)[1:]}
    if (platform := _platform(options, needed=False)) is not None:
        seen = dict.fromkeys((BASE, frames.work))
        places |= {f"now in {each}": frames.pose(options.name, each, platform, _attitude(options)) for each in seen}
    table = Table(options.name, "position [mm]", "rotation vector [deg]")
    for label, pose in places.items():
        table.add(label, *_numbers(pose))
    if places:
        table.print()
    stands = " on ".join(frames.chain(options.name))
    depends = ", ".join(_dependents(frames, options.name)) or "nothing"
    print(f"{stands}; a {frames.kind(options.name)} frame; depends on it: {depends}")
    cli.write_json(
        options.json,
        {
            "chain": frames.chain(options.name),
            "kind": frames.kind(options.name),
            "uses": frames.uses(options.name),
            "poses": {
                label: {"position": pose.position, "quaternion": quaternion_from_rotation(pose.rotation)}
                for label, pose in places.items()
            },
        },
    )


@cli.command(
    _FILE,
    _NAME,
    _PARENT,
    cli.argument("--position", metavar="X,Y,Z", help="its origin in the parent [m]"),
    cli.argument("--angles", metavar="RX,RY,RZ", help="turns about the parent's x, then y, then z [deg]"),
    cli.argument("--quaternion", metavar="W,X,Y,Z", help="its orientation as a unit quaternion, instead of --angles"),
    cli.argument("--note", metavar="TEXT", help="what it is"),
)
def gough_frames_set(options: Namespace) -> None:
    """Add a frame to a file, which may be a new one, or change what is given of one; the name pivot sets the pivot."""
    from controller.frames import Frames

    frames = _read(options.file) if options.file.exists() else Frames()
    if options.name == "pivot":
        _save(options.file, _with_pivot(frames, options))
        return
    _save(options.file, frames.with_frame(options.name, _frame(frames, options)))


def _with_pivot(frames: "Frames", options: Namespace) -> "Frames":
    from dataclasses import replace

    from controller.frames import PLATFORM, Pivot
    from controller.frames.tree import checked_place

    if options.angles or options.quaternion or options.note:
        raise InputError("the pivot is a point: give --parent and --position alone")
    before = frames.pivot or Pivot(PLATFORM)
    position = before.position if options.position is None else _given(options.position, (3,), "--position")
    return replace(frames, pivot=Pivot(options.parent or before.parent, checked_place(position, "--position")))


def _frame(frames: "Frames", options: Namespace) -> Any:
    from controller.frames import BASE, Frame
    from controller.frames.tree import ROOTS

    before = frames.frames.get(options.name)
    if before is None and options.parent is None and options.name not in ROOTS:
        raise InputError(
            f"there is no frame {options.name!r} yet: say what it stands on with --parent, such as base or platform"
        )
    if options.angles and options.quaternion:
        raise InputError("--angles and --quaternion both turn the frame: keep one of them")
    entries: dict[str, Any] = {"parent": BASE} if before is None else dict(before.entries or {})
    entries |= {name: value for name in ("parent", "note") if (value := getattr(options, name)) is not None}
    if options.position is not None:
        entries["position"] = _given(options.position, (3,), "--position").tolist()
    for name, form, count in (("angles", "angles_deg", 3), ("quaternion", "quaternion", 4)):
        if (text := getattr(options, name)) is not None:
            entries = {key: value for key, value in entries.items() if not key.endswith("_deg") and key != "quaternion"}
            entries[form] = _given(text, (count,), f"--{name}").tolist()
    return Frame.from_entries(entries, options.name)


@cli.command(
    _FILE,
    _NAME,
    cli.argument("parent", metavar="PARENT", help="what it stands on from now on"),
    cli.flag("--keep-place", "leave it where it is, with other numbers, instead of keeping the numbers"),
)
def gough_frames_link(options: Namespace) -> None:
    """Let a frame stand on another; what stands on it goes with it."""
    _save(options.file, _read(options.file).linked(options.name, options.parent, options.keep_place))


@cli.command(_FILE, _NAME, _PARENT, *_HERE, cli.flag("--keep-axes", "move its origin alone"))
def gough_frames_zero(options: Namespace) -> None:
    """Measure in place: here is zero.

    A work frame is put where the enabled tool is, so that the tool reads zero in it. A tool is put where the enabled work frame
    is: touch the frame's origin with it first.
    """
    frames, platform = _read(options.file), _platform(options, needed=True)
    assert platform is not None
    zeroed = frames.zeroed(options.name, platform, _attitude(options), options.parent, not options.keep_axes)
    _save(options.file, zeroed)
    pose = zeroed.frames[options.name]
    position, vector = _numbers(pose.pose)
    print(f"{options.name} is at {position} mm in {pose.parent}, turned by {vector} deg")


@cli.command(_FILE, _NAME)
def gough_frames_enable(options: Namespace) -> None:
    """Enable a work frame or a tool: from now on a target is the tool's pose in the work frame.

    It takes the place of the one that was enabled; base, level and platform go back to none.
    """
    frames = _read(options.file)
    enabled = frames.enabled(**{frames.kind(options.name): options.name})
    _save(options.file, enabled)
    print(f"a target is {enabled.active().text}")


@cli.command(_FILE, _NAME)
def gough_frames_remove(options: Namespace) -> None:
    """Remove a frame that nothing depends on; the name pivot removes the pivot."""
    from dataclasses import replace

    frames = _read(options.file)
    _save(options.file, replace(frames, pivot=None) if options.name == "pivot" else frames.removed(options.name))


gough_frames = cli.group(
    "List and change the frames in which targets and read-outs are.",
    list=gough_frames_list,
    show=gough_frames_show,
    set=gough_frames_set,
    link=gough_frames_link,
    zero=gough_frames_zero,
    enable=gough_frames_enable,
    remove=gough_frames_remove,
)


def _read(path: Path) -> "Frames":
    from controller.frames import load_frames

    return load_frames(path)


def _save(path: Path, frames: "Frames") -> None:
    from controller.frames import save_frames

    # What could not be used is refused now, not by the next run.
    frames.active()
    save_frames(path, frames)


def _dependents(frames: "Frames", name: str) -> list[str]:
    pivot = ["pivot"] if frames.pivot is not None and name in frames.chain(frames.pivot.parent) else []
    return [*frames.dependents(name), *pivot]


def _numbers(pose: "Pose") -> tuple[str, str]:
    """The position [mm] and the rotation vector [deg]."""
    from math import degrees

    from plant.pose import vector_from_rotation

    return _millimetres(pose.position), _joined(map(degrees, vector_from_rotation(pose.rotation)))


def _millimetres(position: "Array") -> str:
    return _joined(1e3 * position)


def _joined(numbers: "Iterable[float]") -> str:
    """Numbers with three digits after the point at most."""
    return ", ".join(f"{each:z.3f}".rstrip("0").rstrip(".") for each in numbers)


def _given(text: str, shape: tuple[int, ...], name: str) -> "Array":
    """The numbers of a text such as 0,0,0.3."""
    from plant.pose import checked_array

    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise InputError(f"{name} is {text!r}; it must be {shape[0]} numbers with commas in between") from None
    return checked_array(values, shape, name)


def _platform(options: Namespace, needed: bool) -> "Pose | None":
    """Where the platform is, as one option says."""
    given = [name for name in ("recording", "home", "pose") if getattr(options, name) is not None]
    if len(given) > 1:
        raise InputError(f"--{' and --'.join(given)} both say where the platform is: keep one of them")
    if options.at is not None and given != ["recording"]:
        raise InputError("--at is a time of a recording: name that with --recording FILE.mcap")
    if not given:
        if needed:
            raise InputError("where is the platform? say it with --recording FILE.mcap, --home MECHANISM or --pose X,Y,Z")
        return None
    if options.recording is not None:
        return _recorded(options.recording, options.at)
    if options.home is not None:
        from plant.mechanism import load_spatial

        return load_spatial(options.home).require_home()
    from plant.pose import Pose, rotation_from_quaternion

    text = options.pose if options.pose.count(",") != 2 else f"{options.pose},1,0,0,0"
    values = _given(text, (7,), "--pose")
    return Pose(values[:3], rotation_from_quaternion(_unit(values[3:], "--pose")))


def _attitude(options: Namespace) -> "Array | None":
    """The attitude (3, 3) of the base."""
    if options.attitude is None:
        return None
    from plant.pose import rotation_from_quaternion

    return rotation_from_quaternion(_unit(_given(options.attitude, (4,), "--attitude"), "--attitude"))


def _unit(quaternion: "Array", name: str) -> "Array":
    from plant.pose import checked_unit

    return checked_unit(quaternion, 4, f"the quaternion of {name}")


def _recorded(path: str, at: float | None) -> "Pose":
    """The estimated pose of a recorded cycle."""
    import numpy as np

    from hil.recording.mcap import read
    from plant.pose import Pose

    records = read(path).records
    posed = records[(records["status"] == 0) & np.isfinite(records["position"]).all(axis=1)]
    if at is not None:
        posed = posed[1e-9 * posed["time_ns"] <= at]
    if not len(posed):
        until = "" if at is None else f" until {at:g} s"
        raise InputError(f"{path} has no pose{until}: give another recording or time")
    return Pose(posed[-1]["position"].copy(), posed[-1]["rotation"].copy())
