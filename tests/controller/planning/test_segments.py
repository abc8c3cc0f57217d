"""The reference: cubic segments are evaluated as polynomials, segment after segment."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.planning.segments import evaluate_reference
from tests.controller.planning.sampled_reference import sample_reference


def random_segments(random, count, longest=0.05):
    """Continuous segments (6, n, 5), of different numbers for each leg, padded with unused rows."""
    segments = np.zeros((6, count + 2, 5))
    segments[:, :, 0] = np.inf
    for leg in range(6):
        state = np.array([0.4, 0.0, 0.0]) + random.normal(scale=0.01, size=3)
        start = 0.0
        for row in range(int(random.integers(1, count + 1))):
            jerk, duration = random.uniform(-60.0, 60.0), random.uniform(1e-4, longest)
            segments[leg, row] = (start, *state, jerk)
            t = duration
            state = np.array([[1.0, t, t * t / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]]) @ state
            state += jerk * np.array([t**3 / 6.0, t**2 / 2.0, t])
            start += duration
    return segments


def evaluated(segments, times):
    """References (N, 6, 3) and indices (N, 6) at increasing times, the index remembered in between."""
    index, reference = np.zeros(6, np.int64), np.zeros((6, 3))
    references, indices = [], []
    for time in times:
        evaluate_reference(segments, time, index, reference)
        references.append(reference.copy())
        indices.append(index.copy())
    return np.array(references), np.array(indices)


def twin(segments, time):
    """NumPy polynomials of the last segment that has started."""
    rows = []
    for leg in segments:
        start, *state, jerk = leg[np.flatnonzero(leg[:, 0] <= time)[-1]]
        polynomial = np.polynomial.Polynomial([state[0], state[1], state[2] / 2.0, jerk / 6.0])
        rows.append([polynomial.deriv(order)(time - start) if order else polynomial(time - start) for order in range(3)])
    return np.array(rows)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.floats(1e-4, 0.2))
def test_length_rate_and_acceleration_are_those_of_the_segments_polynomial(seed, count, step):
    random = np.random.default_rng(seed)
    segments = random_segments(random, count)
    times = np.cumsum(random.uniform(0.0, step, 60))
    found, indices = evaluated(segments, times)
    np.testing.assert_allclose(found, [twin(segments, time) for time in times], rtol=1e-12, atol=1e-12)
    assert (np.diff(indices, axis=0) >= 0).all()


@pytest.mark.parametrize("seed", range(5))
def test_at_the_instant_a_segment_starts_it_counts_and_nothing_jumps(seed):
    segments = random_segments(np.random.default_rng(seed), 20)
    starts = np.unique(segments[:, :, 0][np.isfinite(segments[:, :, 0])])
    around = np.sort(np.concatenate([starts, np.nextafter(starts[1:], 0.0)]))
    found, indices = evaluated(segments, around)
    for time, reference, index in zip(around, found, indices, strict=True):
        np.testing.assert_array_equal(index, [np.sum(leg[:, 0] <= time) - 1 for leg in segments])
        np.testing.assert_allclose(reference, twin(segments, time), rtol=1e-12, atol=1e-12)
    # A rounding error before a start and at it, the two segments agree: position, rate and acceleration are continuous.
    close = np.diff(around) < 1e-12
    assert close.sum() == len(starts) - 1
    np.testing.assert_allclose(np.diff(found, axis=0)[close], 0.0, atol=1e-11)


def test_many_segments_are_passed_in_one_step_and_the_last_goes_on():
    segments = random_segments(np.random.default_rng(6), 200, longest=0.01)
    found, indices = evaluated(segments, [0.0, 50.0])
    np.testing.assert_array_equal(indices[1], [np.isfinite(leg[:, 0]).sum() - 1 for leg in segments])
    np.testing.assert_allclose(found[1], twin(segments, 50.0), rtol=1e-12)


def test_a_full_table_without_unused_rows_is_read_to_its_end_and_not_beyond():
    segments = np.zeros((6, 2, 5))
    segments[:, 1, 0] = 1.0
    segments[:, :, 1] = [[0.3, 0.4]]
    found, indices = evaluated(segments, [0.0, 0.999, 1.0, 2.0, 1e6])
    np.testing.assert_array_equal(indices[:, 0], [0, 0, 1, 1, 1])
    np.testing.assert_allclose(found[:, 0, 0], [0.3, 0.3, 0.4, 0.4, 0.4])


def test_samples_are_the_reference_at_whole_cycles():
    segments = random_segments(np.random.default_rng(7), 30)
    samples = sample_reference(segments, 1e-3, 700)
    assert samples.shape == (700, 6, 3)
    expected, _ = evaluated(segments, 1e-3 * np.arange(700))
    np.testing.assert_array_equal(samples, expected)
