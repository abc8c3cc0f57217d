"""Parts of a view of a mechanism in 3-D."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from hil.look import AXIS_NAMES, BASE_COLOR, COLORS, FAINT, GRID, LEG_SCALE, NEUTRAL, PLATFORM_COLOR, VIEWED_FROM
from plant.pose import Array

VIEW = {"margin": {"l": 0, "r": 0, "t": 0, "b": 10}, "showlegend": False}
PLATFORM, BASE = (PLATFORM_COLOR, 0.55, PLATFORM_COLOR), (FAINT, 0.35, BASE_COLOR)
"""The look of a view, and of its plates."""


def scene(points: Array, up: Array, front: Array | None = None) -> dict[str, Any]:
    """Fixed axes with equal scales around `points` (N, 3), of which some may be NaN, seen from above, or along `front` (3,)."""
    margin = 0.05 * (np.nanmax(points, axis=0) - np.nanmin(points, axis=0)).max()
    ranges = np.stack([np.nanmin(points, axis=0) - margin, np.nanmax(points, axis=0) + margin], axis=1)
    aside = np.array(VIEWED_FROM)
    eye = aside + (0.6 - aside @ up) * up
    if front is not None:
        # The camera's unit is the edge of the cube that has the volume of the scene.
        spans = np.ptp(ranges, axis=1)
        eye = 1.2 * spans.max() / np.cbrt(spans.prod()) * front
    looks = {"up": up, "eye": eye, "center": -0.1 * up}
    look = {"showbackground": False, "showspikes": False, "gridcolor": GRID, "color": NEUTRAL, "nticks": 5}
    return {
        **{
            f"{name}axis": {"range": ends.tolist(), "title": {"text": f"{name} [mm]"}, **look}
            for name, ends in zip(AXIS_NAMES, ranges, strict=True)
        },
        "aspectmode": "data",
        # A turntable always turns about z.
        "dragmode": "turntable" if up[2] > 0.999 else "orbit",
        "camera": {key: dict(zip(AXIS_NAMES, vector.tolist(), strict=True)) for key, vector in looks.items()},
    }


def segments(starts: Array, ends: Array) -> Array:
    """Points (3 n, d) of n separate lines: start, end, gap."""
    return np.stack([starts, ends, np.full_like(ends, np.nan)], axis=1).reshape(-1, ends.shape[1])


def segment_colors(names: Sequence[str]) -> list[str]:
    """A color for each point of `segments`."""
    return [COLORS[name] for name in names for _ in range(3)]


def coordinates(points: Array) -> dict[str, Array]:
    """Points (n, 3) as the keywords of a trace."""
    return dict(zip(AXIS_NAMES, points.T.astype(np.float32), strict=True))


def line(points: Array, color: str | list[str], width: float) -> go.Scatter3d:
    """A line through points (n, 3)."""
    return go.Scatter3d(coordinates(points), mode="lines", line={"color": color, "width": width}, hoverinfo="skip")


def shaded_line(points: Array, shares: Array, width: float) -> go.Scatter3d:
    """A line through points (n, 3), with the colours of legs by shares (n,)."""
    drawn = line(points, NEUTRAL, width)
    return drawn.update(line={"color": shares.astype(np.float32), "colorscale": LEG_SCALE, "cmin": 0.0, "cmax": 1.0})


def plate(rim: Array, color: str, opacity: float, edge: str) -> tuple[go.Mesh3d, go.Scatter3d]:
    """A plate within a closed rim (n, 3), and the line round it."""
    fan = np.arange(1, len(rim) - 2)
    look = {"color": color, "opacity": opacity, "flatshading": True, "hoverinfo": "skip"}
    return go.Mesh3d(coordinates(rim[:-1]), i=0 * fan, j=fan, k=fan + 1, **look), line(rim, edge, 6)


def labels(points: Array, texts: Sequence[str]) -> go.Scatter3d:
    """Texts at points (n, 3)."""
    return go.Scatter3d(coordinates(points), mode="text", text=texts, hoverinfo="skip")
