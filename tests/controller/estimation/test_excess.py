"""The excess of squared innovations over what noise explains."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.estimation.excess import INNOVATION_LIMIT, MEMORY_S, faded_excess


def test_noise_as_assumed_has_no_excess_and_three_times_it_has_about_its_own_square():
    random, quiet, loud, highest = np.random.default_rng(1), 0.0, 0.0, 0.0
    for sample in random.normal(size=5000):
        quiet = faded_excess(quiet, min(sample**2, INNOVATION_LIMIT**2), 1.0, 1e-3)
        loud = faded_excess(loud, (6.0 * sample) ** 2, 1.0, 1e-3)
        highest = max(highest, (6.0 * sample) ** 2)
        assert quiet == 0.0
    assert 36.0 < loud < highest - INNOVATION_LIMIT**2


def test_a_new_excess_counts_at_once_and_fades_with_the_memory_until_it_ends():
    excess = faded_excess(0.0, 100.0, 0.01, 1e-3)
    assert excess == pytest.approx(100.0 - 0.01 * INNOVATION_LIMIT**2)
    for _ in range(round(MEMORY_S / 1e-3)):
        excess = faded_excess(excess, 0.0, 0.01, 1e-3)
    assert excess == pytest.approx(100.0 / np.e, rel=0.01)
    for _ in range(round(9.0 * MEMORY_S / 1e-3)):
        excess = faded_excess(excess, 0.0, 0.01, 1e-3)
    assert excess == 0.0


@given(st.floats(0.0, 1e6), st.floats(0.0, 1e6), st.floats(0.0, 1e3), st.floats(1e-5, 10.0))
def test_it_is_never_negative_and_never_more_than_what_is_seen_or_was(excess, squared, variance, period):
    assert 0.0 <= faded_excess(excess, squared, variance, period) <= max(excess, squared)
