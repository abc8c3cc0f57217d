"""Figures that simulations, runs and recordings tell alike."""

import numpy as np

from plant.pose import Array, rms_figures

_SHARES = (("p50", 0.5), ("p99", 0.99), ("max", 1.0))


def error_figures(errors: Array) -> dict[str, float]:
    """RMS and largest of pose errors (N, 6) [m, rad]: `position_rms`, `rotation_rms`, `position_max`, `rotation_max`."""
    largest = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
    return rms_figures(errors) | {"position_max": float(largest[0]), "rotation_max": float(largest[1])}


def level_figures(levels: Array) -> dict[str, float]:
    """Median, 99th percentile and maximum of protection levels (N, 2) [m, rad], such as `position_p99`."""
    return {
        f"{name}_{label}": float(np.quantile(levels[:, part], share))
        for part, name in enumerate(("position", "rotation"))
        for label, share in _SHARES
    }
