"""Frames: named, linked coordinate systems, kept in TOML, and what a pose means in them (docs/frames.md).

Work frames stand on the base {1} or on the level frame, tool frames on the platform {2}, directly or on each other. A work
frame and a tool frame are enabled: a target or a read-out is then the pose of the tool in the work frame.

    frames = load_frames("cell.toml")
    active = frames.active()  # the enabled pair; or frames.active("table", "needle")
    tool = active.read(platform)  # the pose of the tool in the work frame, of a pose of the platform
    platform = active.platform(tool)
    lower = active.moved(platform, Move((0.0, 0.0, -0.01), axes="needle"))  # 10 mm along the needle's own z
"""

from controller.frames.active import ActiveFrames, Move
from controller.frames.rigid import (
    base_from_level,
    base_twist_from_level,
    compose,
    inverse,
    level_from_base,
    level_twist_from_base,
    transfer,
)
from controller.frames.tree import BASE, LEVEL, PLATFORM, Frame, Frames, Pivot, load_frames, parse_frames, save_frames

__all__ = [
    "BASE",
    "LEVEL",
    "PLATFORM",
    "ActiveFrames",
    "Frame",
    "Frames",
    "Move",
    "Pivot",
    "base_from_level",
    "base_twist_from_level",
    "compose",
    "inverse",
    "level_from_base",
    "level_twist_from_base",
    "load_frames",
    "parse_frames",
    "save_frames",
    "transfer",
]
