"""The look of reports, pictures and the panel: one palette, and one name and unit for each thing that they show."""

import numpy as np
from numpy.typing import NDArray

from plant.mechanism import LEGS
from plant.pose import Array

AXIS_NAMES = ("x", "y", "z")
LEG_NAMES = tuple(f"leg {k}" for k in range(LEGS))
ESTIMATE, REFERENCE, TRUTH = "estimate", "reference", "truth"
POSITION, ROTATION, LENGTH, ROOM, SPEED = "position [mm]", "rotation [deg]", "length [mm]", "room [mm]", "speed [mm/s]"
COLORINGS = ("stroke", "speed", "IMUs")
"""What the colours of the legs may show."""

FONT = "system-ui, -apple-system, 'Segoe UI', 'Liberation Sans', sans-serif"

NEUTRAL = "#6e7a86"
"""Lines and small text of what has one colour for all backgrounds: it has a contrast of 4.3 to white and to near black."""
FAINT, BAND, GRID = "#9aa5b1", "rgba(128, 141, 154, 0.4)", "rgba(128, 141, 154, 0.25)"

LIGHT = {"ink": "#26323d", "faint": "#66727e", "line": "#dfe4e9", "ground": "#ffffff", "accent": "#2f6fb5"}
DARK = {"ink": "#dfe5ea", "faint": "#97a3ae", "line": "#333d47", "ground": "#14191f", "accent": "#6ba3e0"}
"""Colours of a page, by what the browser asks for."""

GOOD, WARM, BAD = "#1f9254", "#d97a0b", "#c8354a"
_WARM_AT = 0.7
LEG_SCALE = ((0.0, GOOD), (_WARM_AT, WARM), (1.0, BAD))
"""The colours of legs by the share of what they show: 0 is good, and 1 at a limit, or without an IMU."""

BASE_COLOR, PLATFORM_COLOR, REFERENCE_COLOR, TRUTH_COLOR = "#5c6873", "#6d87a3", "#2f6fb5", "#d1495b"
"""The plates, and the ghosts of where the platform should be and of where it is."""

TUBE_SHARE = 0.62
"""The drawn length of a leg's lower part, as a share of the leg's least length."""
VIEWED_FROM = (1.15, -1.4, 0.0)
"""The side from which a mechanism is seen."""

SERIES = ("#3b6fb6", "#e8871e", "#3a9d6e", "#c8403f", "#8a5fb0", "#3fa7b8", "#b0a03a", "#7d5a44", "#e377c2", "#7f7f7f")
"""Colours of what has no colour of its own, such as runs, in their order."""

COLORS = {
    **dict(zip(AXIS_NAMES, (TRUTH_COLOR, "#2a9d5c", REFERENCE_COLOR), strict=True)),
    **dict(zip(LEG_NAMES, SERIES, strict=False)),
    "error": TRUTH_COLOR,
    "level": NEUTRAL,
}
"""Colours of curves by their names."""


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue, 0 to 255, of a colour such as "#1f9254"."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


def leg_colors(shares: Array) -> NDArray[np.uint8]:
    """The colours (..., 3) of `LEG_SCALE` at shares (...); NaN is bad."""
    shares = np.clip(np.nan_to_num(shares, nan=1.0), 0.0, 1.0)
    places, colors = [place for place, _ in LEG_SCALE], np.array([rgb(color) for _, color in LEG_SCALE], float)
    mixed = np.stack([np.interp(shares, places, channel) for channel in colors.T], axis=-1)
    return np.round(mixed).astype(np.uint8)


def room(lengths: Array, stroke: Array) -> Array:
    """How far lengths (..., n) are from the nearer ends of strokes (n, 2) [m]."""
    nearer: Array = np.minimum(lengths - stroke[:, 0], stroke[:, 1] - lengths)
    return nearer


def stroke_shares(lengths: Array, stroke: Array) -> Array:
    """0 in the middle of strokes (n, 2) [m], and 1 at their ends, for lengths (..., n) [m]."""
    shares: Array = 1.0 - 2.0 * room(lengths, stroke) / np.ptp(stroke, axis=1)
    return shares


def speed_shares(rates: Array, velocity: float) -> Array:
    """Speeds of legs (..., n) [m/s] over the greatest."""
    shares: Array = np.abs(rates) / velocity
    return shares


def imu_shares(used: NDArray[np.bool_]) -> Array:
    """0 for legs (..., n) whose IMU is used, else 1."""
    return np.where(used, 0.0, 1.0)


def ring(joints: Array) -> NDArray[np.intp]:
    """The indices of `joints` (n, 3) in their order round the centre, and the first again."""
    center = joints - joints.mean(axis=0)
    plane = np.linalg.svd(center)[2][:2]
    x, y = plane @ center.T
    order = np.argsort(np.arctan2(y, x))
    return np.append(order, order[0])
