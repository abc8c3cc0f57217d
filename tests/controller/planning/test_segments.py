"""The reference: cubic segments are evaluated as polynomials, segment after segment; and the fastest way to rest."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruckig import ControlInterface, Ruckig, Trajectory

from controller.planning.offline_planner import ruckig_input
from controller.planning.segments import (
    APPROACH_SEGMENTS,
    STOP_SEGMENTS,
    approach_duration,
    evaluate_reference,
    plan_approach,
    plan_stop,
    stop_phases,
)
from controller.planning.trajectory_generator import calculate
from plant.mechanism import Limits
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


@pytest.mark.slow
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


# ------------------------------------------------------------------------------------------------------------ the way to rest

ACCELERATION, JERK = 3.0, 60.0


def run_down(rate, acceleration):
    """Time to rest, the way there, the final rate and acceleration, and the largest acceleration on the way."""
    state, total, largest = (0.0, rate, acceleration), 0.0, abs(acceleration)
    for jerk, duration in stop_phases(rate, acceleration, ACCELERATION, JERK):
        assert duration >= 0.0 and abs(jerk) in (0.0, JERK)
        polynomial = np.polynomial.Polynomial([state[0], state[1], state[2] / 2.0, jerk / 6.0])
        state = tuple(float(polynomial.deriv(order)(duration) if order else polynomial(duration)) for order in range(3))
        total, largest = total + duration, max(largest, abs(state[2]))
    return total, state, largest


@pytest.mark.parametrize("seed", range(4))
def test_a_stop_is_the_fastest_that_ruckig_knows(seed):
    random = np.random.default_rng(seed)
    parameters = ruckig_input(Limits(np.array([[0.1, 0.2]]), 10.0, ACCELERATION, JERK), ControlInterface.Velocity, None)
    parameters.target_velocity, parameters.target_acceleration = [0.0], [0.0]
    otg, trajectory = Ruckig(1), Trajectory(1)
    for _ in range(100):
        rate, acceleration = (
            random.choice([0.0, 0.02, 0.3]) * random.normal(),
            random.choice([0.0, 1.0]) * random.uniform(-3, 3),
        )
        total, (way, *rest), largest = run_down(rate, acceleration)
        np.testing.assert_allclose(rest, 0.0, atol=1e-12)
        assert largest <= ACCELERATION * (1.0 + 1e-12)
        assert calculate(otg, parameters, ([0.0], [rate], [acceleration]), trajectory)
        assert total == pytest.approx(trajectory.duration, abs=1e-9)
        assert way == pytest.approx(trajectory.at_time(total)[0][0], abs=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(
    ("rate", "acceleration", "time", "way"),
    [
        # Up to 3 m/s^2 in 50 ms, which takes 0.15 m/s with its way back; 50 ms more take another 0.15 m/s.
        (0.15, 0.0, 0.1, 0.0075),
        (0.30, 0.0, 0.15, 0.0225),
        (0.0375, 0.0, 0.05, 0.0009375),
        # Braking already as a stop would in its middle.
        (0.075, -3.0, 0.05, 0.00125),
        (0.0, 0.0, 0.0, 0.0),
    ],
)
def test_a_stop_takes_the_time_and_the_way_that_are_worked_out_by_hand(rate, acceleration, time, way, sign):
    total, (gone, *_), _ = run_down(sign * rate, sign * acceleration)
    assert total == pytest.approx(time, abs=1e-9)
    assert gone == pytest.approx(sign * way, abs=1e-12)


def test_every_leg_stops_by_itself_and_the_slowest_tells_how_long_it_takes():
    random = np.random.default_rng(5)
    reference = random.normal([0.4, 0.0, 0.0], [0.05, 0.2, 1.0], (6, 3))
    segments = np.full((6, STOP_SEGMENTS, 5), np.nan)
    longest = plan_stop(reference, ACCELERATION, JERK, segments)
    each = [run_down(rate, acceleration) for _, rate, acceleration in reference]
    assert longest == pytest.approx(max(total for total, _, _ in each))
    np.testing.assert_allclose(segments[:, 0], np.column_stack([np.zeros(6), reference, segments[:, 0, 4]]))
    np.testing.assert_allclose(segments[:, 3, 0], [total for total, _, _ in each])
    np.testing.assert_array_equal(segments[:, 3, 2:], 0.0)
    times = np.sort(np.concatenate([segments[:, :, 0].ravel(), np.nextafter(segments[:, :, 0].ravel(), 0.0)]).clip(0.0))
    found, _ = evaluated(segments, [*times, longest + 1.0])
    np.testing.assert_allclose(np.diff(found[:-1], axis=0)[np.diff(times) < 1e-12], 0.0, atol=1e-9)
    np.testing.assert_allclose(found[-1, :, 0], reference[:, 0] + [state[0] for _, state, _ in each], atol=1e-12)
    np.testing.assert_array_equal(found[-1, :, 1:], 0.0)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-6, 0.5), st.floats(0.01, 1.0), st.floats(0.1, 20.0), st.floats(1.0, 500.0))
def test_an_approach_goes_from_rest_to_rest_at_one_of_the_limits(seed, farthest, rate, acceleration, jerk):
    random = np.random.default_rng(seed)
    lengths, ways = random.uniform(0.3, 0.5, 6), random.uniform(-1.0, 1.0, 6)
    ways *= farthest / np.abs(ways).max()
    reference, segments = np.zeros((6, 3)), np.full((6, APPROACH_SEGMENTS, 5), np.nan)
    reference[:, 0] = lengths + ways
    duration = approach_duration(farthest, rate, acceleration, jerk)
    plan_approach(lengths, reference, duration, segments)
    found, _ = evaluated(segments, np.linspace(0.0, duration, 41))
    scale = [farthest, rate, acceleration]
    np.testing.assert_allclose(found[0], np.column_stack([lengths, np.zeros((6, 2))]), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose((found[-1] - reference) / scale, 0.0, atol=1e-9)
    # All arrive together, on ways that are alike.
    np.testing.assert_allclose(found[:, :, 0] - lengths, np.outer((found[:, 0, 0] - lengths[0]) / ways[0], ways), atol=1e-12)
    used = np.abs(found[:, :, 1]).max() / rate, np.abs(found[:, :, 2]).max() / acceleration
    used += (np.abs(segments[:, :, 4]).max() / jerk,)
    assert max(used) == pytest.approx(1.0, rel=1e-9)
