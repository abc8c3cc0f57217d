"""Percentiles of durations: exact ones, and those of a histogram."""

import numpy as np

from hil.realtime.durations import FIGURES, Histogram, percentiles


def test_a_histogram_finds_the_percentiles_to_a_bin():
    durations = np.random.default_rng(0).lognormal(9.0, 1.0, 200_000).astype(np.int64)
    exact, counted = percentiles(durations), Histogram()
    counted.add(durations)
    for name in FIGURES:
        np.testing.assert_allclose(counted.figures()[name], exact[name], rtol=0.012)
    assert exact["p50"] == np.median(durations) / 1e3
    assert percentiles(durations, ("max", "n")) == {"max": durations.max() / 1e3, "n": 200_000}
