"""Plans that are put together: what is kept of the one before, leg by leg, and what the loop tells."""

import numpy as np
import pytest

from controller.planning.plan_handover import (
    CYCLE,
    FOLLOWED_SEGMENTS,
    LATEST,
    PLAN_SEGMENTS,
    SEEN,
    STREAM,
    STREAM_READER,
    TAKEN,
    note_sample,
    publish_plan,
    rest,
    stream_cause,
    take_plan,
)
from controller.planning.segments import evaluate_reference
from controller.safety.causes import Cause
from hil.loop.records import shared_array
from tests.controller.planning.test_segments import twin

PERIOD = 1e-3


def random_plan(random, begin, longest=8):
    """Rows (6, 24, 5) of different numbers for each leg, which need not join."""
    plan = np.zeros((6, PLAN_SEGMENTS, 5))
    plan[:, :, 0] = np.inf
    for leg in range(6):
        count = int(random.integers(1, longest + 1))
        plan[leg, :count] = random.normal(size=(count, 5))
        plan[leg, :count, 0] = begin + np.concatenate([[0.0], np.cumsum(random.uniform(2e-3, 9e-3, count - 1))])
    return plan


@pytest.mark.parametrize("seed", range(5))
def test_before_a_plan_begins_the_one_before_is_followed_and_from_then_on_the_new_one(seed):
    random = np.random.default_rng(seed)
    stream, reader = shared_array(1, STREAM).reshape(()), np.zeros((), STREAM_READER)
    start = random.uniform(0.3, 0.4, 6)
    segments, index = rest(start), np.zeros(6, np.int64)
    followed, begin, cycle, reference = rest(start), 0.0, 0, np.zeros((6, 3))
    assert segments.shape == (6, FOLLOWED_SEGMENTS, 5)
    for number in range(1, 12):
        begin = (cycle + int(random.integers(0, 12))) * PERIOD
        plan = random_plan(random, begin)
        assert publish_plan(stream, plan, begin, reader["taken"]) == number
        assert take_plan(stream, reader, cycle, PERIOD, segments, index)
        assert (index == 0).all()
        assert stream["shared"][[CYCLE, LATEST, SEEN, TAKEN]].tolist() == [cycle, number, number, number]
        for _ in range(int(random.integers(13, 40))):
            now = cycle * PERIOD
            evaluate_reference(segments, now, index, reference)
            np.testing.assert_allclose(reference, twin(plan if now >= begin else followed, now), rtol=1e-9, atol=1e-9)
            cycle += 1
        followed = plan
        # Beyond what is used, no row ever starts.
        assert np.isinf(segments[:, -1, 0]).all()


def test_the_loop_tells_its_cycle_when_there_is_no_new_plan_too():
    stream, reader = shared_array(1, STREAM).reshape(()), np.zeros((), STREAM_READER)
    segments, index = rest(np.full(6, 0.4)), np.zeros(6, np.int64)
    for cycle in (0, 5, 17):
        assert not take_plan(stream, reader, cycle, PERIOD, segments, index)
        assert stream["shared"][CYCLE] == cycle
    np.testing.assert_array_equal(segments, rest(np.full(6, 0.4)))


def test_a_stream_at_rest_stays_where_it_is_without_end():
    lengths = 0.3 + 0.01 * np.arange(6)
    segments, index, reference = rest(lengths, PLAN_SEGMENTS), np.zeros(6, np.int64), np.zeros((6, 3))
    assert segments.shape == (6, PLAN_SEGMENTS, 5)
    for now in (0.0, 1.0, 1e6):
        evaluate_reference(segments, now, index, reference)
        np.testing.assert_array_equal(reference, np.column_stack([lengths, np.zeros((6, 2))]))


def test_a_stream_is_lost_a_nanosecond_after_its_patience():
    stream = shared_array(1, STREAM).reshape(())
    note_sample(stream, 3_000_000_000)
    note_sample(stream, 5_000_000_000)
    assert stream_cause(stream, 5_200_000_000, 200_000_000)[0] == Cause.NONE
    cause, leg, value, limit = stream_cause(stream, 5_200_000_001, 200_000_000)
    assert (cause, leg, value, limit) == (Cause.TARGET_LOST, 0, pytest.approx(0.2), pytest.approx(0.2))
