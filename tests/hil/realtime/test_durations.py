"""Percentiles of durations: exact ones, and those of a histogram."""

import numpy as np
import pytest

from hil.realtime.durations import FIGURES, Histogram, percentiles


def test_a_histogram_finds_the_percentiles_to_a_bin():
    durations = np.random.default_rng(0).lognormal(9.0, 1.0, 200_000).astype(np.int64)
    exact, counted = percentiles(durations), Histogram()
    counted.add(durations)
    for name in FIGURES:
        np.testing.assert_allclose(counted.figures()[name], exact[name], rtol=0.012)
    assert exact["p50"] == np.median(durations) / 1e3
    assert percentiles(durations, ("max", "n")) == {"max": durations.max() / 1e3, "n": 200_000}


def test_bars_begin_at_the_lower_end_of_what_they_count():
    histogram = Histogram()
    # 1024 ns and its double begin a bar; a bar is a sixteenth of an octave.
    histogram.add(np.array([1024, 1025, 1060, 1071, 2048, 2047]))
    lower, counts = histogram.bars()
    np.testing.assert_allclose(lower, [1.024, 1.024 * 2 ** (1 / 16), 1.024 * 2 ** (15 / 16), 2.048], rtol=1e-12)
    assert counts == [3, 1, 1, 1]


def test_the_shortest_and_the_longest_durations_are_counted_at_the_ends():
    histogram = Histogram()
    histogram.add(np.array([], np.int64))
    assert histogram.figures()["n"] == 0
    histogram.add(np.array([0, -5, 1, 10**12]))
    lower, counts = histogram.bars()
    assert counts == [3, 1]
    assert lower[0] == 0.001 and 60e6 < lower[1] < 70e6
    assert histogram.figures()["max"] == 1e9
    # What is counted later does not make the longest shorter, and no quantile is beyond it.
    histogram.add(np.array([5] * 1000))
    assert histogram.figures()["max"] == 1e9
    short = Histogram()
    short.add(np.array([1024]))
    assert short.figures() == {"p50": 1.024, "p99": 1.024, "p999": 1.024, "max": 1.024, "n": 1}


def test_exact_figures_are_in_microseconds_in_the_order_that_is_asked():
    durations = np.array([4000, 1000, 2000, 3000, 10_000])
    assert percentiles(durations) == pytest.approx({"p50": 3.0, "p99": 9.76, "p999": 9.976, "max": 10.0, "n": 5})
    assert list(percentiles(durations, ("n", "p50"))) == ["n", "p50"]
