"""Thresholds and sizes against closed forms and draws."""

import numpy as np
import pytest
from scipy.stats import norm

from hil.studies.detectability.likelihood_ratio import HYPOTHESES, needed_noncentrality, threshold


def test_a_fault_in_one_direction_has_the_closed_form_of_neyman_and_pearson():
    alarm = 1.0 / (100.0 * 3600.0 * 10.0 * HYPOTHESES)
    spoken = norm.isf(alarm / 2.0)
    assert threshold(1) == pytest.approx(spoken**2, rel=1e-9)
    # The other tail adds nothing at such sizes.
    assert needed_noncentrality(1) == pytest.approx((spoken + norm.isf(1e-3)) ** 2, rel=1e-6)


def test_there_is_less_than_one_false_alarm_in_a_hundred_hours():
    # Of a variable with chi-squared distribution and two degrees of freedom, the tail is an exponential.
    assert np.exp(-threshold(2) / 2.0) * HYPOTHESES * 10.0 * 3600.0 * 100.0 == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("directions", [1, 3, 6])
def test_draws_at_the_needed_size_are_told_with_the_power(directions):
    random = np.random.default_rng(directions)
    mean = random.standard_normal(directions)
    mean *= np.sqrt(needed_noncentrality(directions)) / np.linalg.norm(mean)
    drawn = np.sum((mean + random.standard_normal((400_000, directions))) ** 2, axis=1)
    # 400 are missed on average, with a standard deviation of 20.
    assert np.sum(drawn < threshold(directions)) == pytest.approx(400, abs=80)


def test_more_unknown_directions_and_more_hypotheses_need_a_larger_fault():
    sizes = [needed_noncentrality(directions) for directions in (1, 3, 6)]
    assert sizes == sorted(sizes) and needed_noncentrality(3, 1000) > needed_noncentrality(3)
