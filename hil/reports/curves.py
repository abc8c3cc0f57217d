"""Curves with as many points as a page needs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from plant.pose import Array

_POINTS = 3000


def curve(times: Array, values: Array, name: str, unit: str) -> dict[str, Any]:
    """Values (N,) over times (N,) [s] as the keywords of a trace; `name` and `unit` are shown where the pointer is."""
    kept = _extremes(values)
    return {
        "x": times[kept].astype(np.float32),
        "y": values[kept].astype(np.float32),
        "mode": "lines",
        "hovertemplate": f"{name}: %{{y:.4~g}} {unit} at %{{x:.3f}} s<extra></extra>",
    }


def _extremes(values: Array, points: int = _POINTS) -> NDArray[np.intp]:
    """Indices of about `points` samples of `values` (N,), with the least and the greatest of each bucket."""
    if len(values) <= points:
        return np.arange(len(values))
    size = -(-2 * len(values) // points)
    buckets = values[: len(values) // size * size].reshape(-1, size)
    starts = np.arange(0, buckets.size, size)
    rest = np.arange(buckets.size, len(values))
    return np.unique(np.concatenate([starts + buckets.argmin(axis=1), starts + buckets.argmax(axis=1), rest]))
