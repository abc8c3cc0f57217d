"""Streamed targets: whatever comes, and whenever it ends, no limit is left and plans join; what can be followed is."""

import multiprocessing
import os
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.inverse_kinematics import leg_lengths
from controller.planning.offline_planner import count_violations
from controller.planning.plan_handover import (
    END_PLANNER,
    LATEST,
    PLAN_SEGMENTS,
    SEEN,
    STREAM,
    STREAM_READER,
    TAKEN,
    fail_stream,
    note_sample,
    publish_plan,
    rest,
    stream_cause,
    take_plan,
)
from controller.planning.segments import LENGTH, START, evaluate_reference, stop_phases
from controller.planning.stream_planner import Plan, StreamPlanner, TargetRefusedError, _stoppable
from controller.planning.target import load_target
from controller.safety.causes import Cause
from hil.loop.records import shared_array
from plant.compiled import kernel
from plant.errors import InputError, UnreachableError
from plant.pose import quaternion_from_rotation, rotation_from_vector

ROUNDING = 1e-9
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
PERIOD = 1e-3


def home_lengths(mechanism):
    return leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation)


def new_stream():
    return shared_array(1, STREAM).reshape(())


@kernel
def follow(segments, first, index, references):
    """The references (cycles, points, 6, 3) from a cycle on; the index stays where the last cycle began."""
    ahead = index.copy()
    for k in range(references.shape[0]):
        ahead[:] = index
        for point in range(references.shape[1]):
            evaluate_reference(segments, (first + k + point / references.shape[1]) * PERIOD, ahead, references[k, point])
            if point == 0:
                index[:] = ahead


class Follower:
    """A planner and a loop that takes its plans as they come; it keeps the joined reference, finely sampled."""

    def __init__(self, mechanism, lengths=None):
        lengths = home_lengths(mechanism) if lengths is None else lengths
        self.planner = StreamPlanner(mechanism, lengths)
        self.stream, self.reader = new_stream(), np.zeros((), STREAM_READER)
        self.segments, self.index = rest(lengths), np.zeros(6, np.int64)
        self.cycle, self.taken, self.refused = 0, 0, 0
        self.pieces = []

    def add(self, at, displacement, quaternion=LEVEL):
        try:
            self.planner.add(at, displacement, quaternion)
        except TargetRefusedError:
            self.refused += 1

    def plan(self, at, ahead, late=0):
        """Plan from a cycle on; the loop looks when it has come `late` cycles beyond it."""
        plan = self.planner.plan(at * PERIOD, ahead)
        if plan is None:
            return
        number = publish_plan(self.stream, plan.segments, plan.begin, self.reader["taken"])
        if late > 0:
            self.run(at + late)
        take_plan(self.stream, self.reader, self.cycle, PERIOD, self.segments, self.index)
        assert self.stream["shared"][SEEN] == number
        if self.stream["shared"][TAKEN] == number:
            self.taken += 1
            self.planner.follow(plan)

    def run(self, cycle, points=8):
        """Follow the segments up to a cycle, sampled at several points of each."""
        references = np.zeros((max(cycle - self.cycle, 0), points, 6, 3))
        follow(self.segments, self.cycle, self.index, references)
        self.pieces.extend(references.reshape(-1, 6, 3))
        self.cycle += len(references)

    def check(self, limits):
        """The limits, on the samples alone: differences show the jumps that rates and accelerations would hide."""
        sampled, step = np.array(self.pieces), PERIOD / 8
        lengths, rates, accelerations = np.moveaxis(sampled, 2, 0)
        assert (lengths >= limits.stroke[:, 0] - ROUNDING).all() and (lengths <= limits.stroke[:, 1] + ROUNDING).all()
        assert np.abs(rates).max() <= limits.velocity * (1.0 + ROUNDING)
        assert np.abs(accelerations).max() <= limits.acceleration * (1.0 + ROUNDING)
        assert np.abs(np.diff(accelerations, axis=0)).max() <= limits.jerk * step * (1.0 + 1e-6)
        # The mean of a rate is within what the jerk can make of its ends' mean.
        for value, rate, bend in ((lengths, rates, limits.acceleration), (rates, accelerations, limits.jerk)):
            gap = np.diff(value, axis=0) - step * 0.5 * (rate[1:] + rate[:-1])
            assert np.abs(gap).max() <= 0.26 * bend * step**2 + 1e-12


def displacements(random, kind, count):
    scale = np.array([0.03, 0.03, 0.02])
    times = np.arange(count) * 0.01
    waves = np.sin(2.0 * np.pi * random.uniform(0.2, 3.0, 3) * times[:, None]) * scale * random.uniform(0.1, 1.5)
    if kind == "noise":
        return waves * 0.5 + random.normal(size=(count, 3)) * 10.0 ** random.uniform(-6, -2.5)
    if kind == "steps":
        return np.cumsum(random.choice([0.0, 0.0, 0.004], (count, 1)) * random.choice([-1.0, 1.0], (count, 3)), axis=0)
    if kind == "leaps":
        poses = np.repeat(random.normal(size=(count // 10 + 1, 3)) * scale, 10, axis=0)[:count]
        return poses - poses[0]
    if kind == "ramps":
        return np.clip(times[:, None] * random.uniform(-0.4, 0.4, 3), -0.06, 0.06)
    return waves


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "steps",
        pytest.param("waves", marks=pytest.mark.slow),
        *(pytest.param(kind, marks=pytest.mark.endurance) for kind in ("ramps", "leaps", "noise")),
    ],
)
@given(seed=st.integers(0, 2**32 - 1))
def test_no_limit_is_left_whatever_comes(hexapod, kind, seed):
    random = np.random.default_rng(seed)
    follower = Follower(hexapod)
    follower.add(-0.01, np.zeros(3))
    bend = random.uniform(0.0, 0.1)
    cycle = int(random.integers(10_000_000)) if random.random() < 0.3 else 0
    follower.cycle = cycle
    for k, displacement in enumerate(displacements(random, kind, 60)):
        if k > 0 and random.random() < 0.1:
            continue
        turn = bend * np.sin(0.05 * k)
        follower.add(0.01 * k, displacement, np.array([np.cos(turn), np.sin(turn), 0.0, 0.0]))
        at = cycle + 10 * k + int(random.integers(1, 25))
        if follower.planner.current.begin <= at * PERIOD and at >= follower.cycle:
            follower.plan(at, random.uniform(0.0, 0.03), late=int(random.integers(1, 4)) if random.random() < 0.1 else 0)
        follower.run(cycle + 10 * (k + 1))
    assert follower.taken > 0
    # And now silence.
    follower.run(follower.cycle + 2000)
    follower.check(hexapod.limits)
    assert (follower.pieces[-1][:, 1:] == 0.0).all()


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1))
def test_each_plan_is_within_the_limits_to_its_end_and_begins_where_the_one_before_is(hexapod, seed):
    random = np.random.default_rng(seed)
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    at = 0.0
    for k, displacement in enumerate(displacements(random, random.choice(["waves", "noise", "steps"]), 40)):
        try:
            planner.add(0.01 * k, displacement, LEVEL)
        except TargetRefusedError:
            continue
        at += random.uniform(0.0, 0.02)
        plan = planner.plan(at, 0.01)
        if plan is None:
            continue
        before, after = np.zeros((6, 3)), np.zeros((6, 3))
        evaluate_reference(planner.current.segments, at, np.zeros(6, np.int64), before)
        evaluate_reference(plan.segments, at, np.zeros(6, np.int64), after)
        np.testing.assert_array_equal(after, before)
        assert plan.segments.shape == (6, PLAN_SEGMENTS, 5)
        assert count_violations(plan.segments, at + 3.0, hexapod.limits) == 0
        for rows in plan.segments:
            last = rows[np.isfinite(rows[:, START])][-1]
            assert (last[2:] == 0.0).all() and last[START] < at + 2.0
        if random.random() < 0.9:
            planner.follow(plan)


def followed(mechanism, name, noise=0.0, rate=100, duration=4.0, kept=lambda k: True):
    """Errors (n, 6) [m] of the reference against the target at the same time, streamed with 10 ms from sample to plan."""
    target = load_target(name, mechanism, duration)
    times = np.arange(0.0, duration, 1.0 / rate)
    positions, rotations = target.at(times)
    moved = positions - mechanism.home.position + np.random.default_rng(0).normal(size=positions.shape) * noise
    turned = quaternion_from_rotation(rotations @ mechanism.home.rotation.T)
    follower = Follower(mechanism, leg_lengths(mechanism, positions[0], rotations[0]))
    for k, at in enumerate(times):
        follower.run(round(at / PERIOD))
        if kept(k):
            follower.add(at, moved[k], turned[k])
            follower.plan(follower.cycle + 10, 0.01)
    follower.check(mechanism.limits)
    assert follower.refused == 0
    sampled = np.array(follower.pieces)[::8, :, 0]
    return sampled - leg_lengths(mechanism, *target.at(np.arange(len(sampled)) * PERIOD))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "how", "most"),
    [
        ("hold", {}, 1e-12),
        ("circle", {}, 0.02e-3),
        ("sines", {}, 0.05e-3),
        ("shaking", {}, 0.6e-3),
        ("sines", {"noise": 2e-5}, 0.2e-3),
        ("sines", {"rate": 30}, 0.3e-3),
        ("sines", {"rate": 500}, 0.08e-3),
        ("sines", {"kept": lambda k: k % 7 not in (2, 3)}, 0.2e-3),
    ],
)
def test_a_target_is_followed_without_lag(hexapod, name, how, most):
    assert np.sqrt(np.mean(followed(hexapod, name, **how) ** 2)) < most


def test_a_standing_target_is_reached_exactly_and_planned_for_once(hexapod):
    follower = Follower(hexapod)
    for k in range(60):
        follower.add(0.01 * k, [0.02, 0.01, 0.0])
        follower.plan(follower.cycle + 10, 0.01)
        follower.run(follower.cycle + 10)
    expected = leg_lengths(hexapod, hexapod.home.position + [0.02, 0.01, 0.0], hexapod.home.rotation)
    np.testing.assert_allclose(follower.pieces[-1][:, 0], expected, atol=1e-12)
    assert follower.taken == 1


@pytest.mark.parametrize(
    ("sample", "cause"),
    [
        (([np.nan, 0.0, 0.0], LEVEL), Cause.TARGET_NOT_FINITE),
        (([0.0, 0.0, np.inf], LEVEL), Cause.TARGET_NOT_FINITE),
        (([0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0]), Cause.TARGET_NOT_FINITE),
        (([0.0, 0.0, 0.0], 1.002 * LEVEL), Cause.TARGET_NOT_FINITE),
        (([0.0, 0.0, 0.0], 0.0 * LEVEL), Cause.TARGET_NOT_FINITE),
        (([0.0, 0.0, 0.5], LEVEL), Cause.BEYOND_STROKE),
        (([0.0, 0.0, -0.5], LEVEL), Cause.BEYOND_STROKE),
        (([0.0, 0.0, 0.01], LEVEL), Cause.TARGET_JUMPS),
    ],
)
def test_what_cannot_be_followed_is_refused_with_its_cause(hexapod, sample, cause):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    planner.add(0.0, np.zeros(3), LEVEL)
    with pytest.raises(TargetRefusedError) as refusal:
        planner.add(0.01, *sample)
    assert refusal.value.cause == cause
    assert not abs(refusal.value.value) <= refusal.value.limit or cause == Cause.BEYOND_STROKE
    # What was refused is forgotten.
    planner.add(0.01, [1e-4, 0.0, 0.0], 1.0005 * LEVEL)


def test_a_jump_is_measured_by_the_time_since_the_last_sample(hexapod):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    planner.add(0.0, np.zeros(3), LEVEL)
    most = 1.5 * hexapod.limits.velocity * 0.1 + 1e-3
    planner.add(0.1, [0.0, 0.0, 0.95 * most], LEVEL)
    with pytest.raises(TargetRefusedError, match=r"jumps for leg \d \(.* the limit is 0.00475 m"):
        planner.add(0.11, [0.0, 0.0, 0.5 * most], LEVEL)


def test_misuse_is_refused(hexapod):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    with pytest.raises(InputError, match="no sample"):
        planner.plan(0.0, 0.0)
    planner.add(1.0, np.zeros(3), LEVEL)
    with pytest.raises(InputError, match="does not come after"):
        planner.add(1.0, np.zeros(3), LEVEL)
    plan = planner.plan(1.0, 0.0)
    planner.follow(plan)
    with pytest.raises(InputError, match="would begin before the current plan"):
        planner.plan(0.9, 0.0)
    with pytest.raises(UnreachableError):
        StreamPlanner(hexapod, home_lengths(hexapod) + 1.0)


def moved(value, begin=0.0, rows=PLAN_SEGMENTS):
    """A plan all of whose numbers tell its value."""
    plan = np.full((6, rows, 5), float(value))
    plan[:, :, START] = begin + np.arange(rows) * 1e-6
    return plan


def looked(stream, reader, segments, index, cycle=0):
    return take_plan(stream, reader, cycle, PERIOD, segments, index)


def test_a_plan_is_taken_once_and_only_in_time_and_after_the_one_before():
    stream, reader = new_stream(), np.zeros((), STREAM_READER)
    segments, index = rest(np.full(6, 7.0)), np.zeros(6, np.int64)
    assert not looked(stream, reader, segments, index)
    assert publish_plan(stream, moved(1.0, 0.005), 0.005, 0) == 1
    assert looked(stream, reader, segments, index, 5)
    assert not looked(stream, reader, segments, index, 5)
    assert segments[0, 0, LENGTH] == 7.0 and segments[0, 1, LENGTH] == 1.0
    # Too late; then one that follows it; then one that follows the plan that was taken.
    publish_plan(stream, moved(2.0, 0.009), 0.009, 1)
    assert not looked(stream, reader, segments, index, 10)
    publish_plan(stream, moved(3.0, 0.02), 0.02, 2)
    assert not looked(stream, reader, segments, index, 11)
    index[:] = PLAN_SEGMENTS
    publish_plan(stream, moved(4.0, 0.02), 0.02, 1)
    assert looked(stream, reader, segments, index, 12)
    assert list(stream["shared"][[LATEST, SEEN, TAKEN]]) == [4, 4, 4]
    assert segments[0, 0, LENGTH] == 1.0 and segments[0, 1, LENGTH] == 4.0
    assert (index == 0).all()


def test_a_plan_that_has_no_room_is_left():
    stream, reader = new_stream(), np.zeros((), STREAM_READER)
    segments, index = rest(np.full(6, 7.0), PLAN_SEGMENTS), np.zeros(6, np.int64)
    publish_plan(stream, moved(1.0, 0.005), 0.005, 0)
    before = segments.copy()
    assert not looked(stream, reader, segments, index)
    np.testing.assert_array_equal(segments, before)
    assert stream["shared"][SEEN] == 1 and stream["shared"][TAKEN] == 0


def hammer(stream):
    value = 0
    while not stream["shared"][END_PLANNER]:
        value += 1
        # The base is always what the loop has taken, so that each may be.
        publish_plan(stream, moved(value), 1e9, int(stream["shared"][TAKEN]))


@pytest.mark.slow
def test_no_plan_is_ever_torn():
    """However long it takes: the writer goes on until the reader has seen enough plans."""
    stream, reader = new_stream(), np.zeros((), STREAM_READER)
    segments, index = rest(np.full(6, 7.0)), np.zeros(6, np.int64)
    publish_plan(stream, moved(0.0), 1e9, 0)
    looked(stream, reader, segments, index)
    writer = multiprocessing.get_context("fork").Process(target=hammer, args=(stream,))
    writer.start()
    seen, last, until = 0, 0.0, time.monotonic() + 600.0
    try:
        while seen < 2000:
            before = int(reader["seen"])
            looked(stream, reader, segments, index)
            if reader["seen"] == before:
                assert time.monotonic() < until
                # There may be one processor for both.
                os.sched_yield()
                continue
            seen += 1
            values = reader["plan"][:, :, 1:]
            assert (values == values[0, 0, 0]).all()
            assert values[0, 0, 0] > last
            last = values[0, 0, 0]
    finally:
        stream["shared"][END_PLANNER] = 1
        writer.join()
    assert writer.exitcode == 0


def test_a_plan_that_is_being_written_is_left():
    stream, reader = new_stream(), np.zeros((), STREAM_READER)
    segments, index = rest(np.full(6, 7.0)), np.zeros(6, np.int64)
    number = publish_plan(stream, moved(1.0, 0.005), 0.005, 0)
    stream["guards"][number % 2] = 0
    assert not looked(stream, reader, segments, index)
    assert reader["seen"] == 0
    stream["guards"][number % 2] = number
    assert looked(stream, reader, segments, index)


def test_a_stream_is_lost_when_no_sample_comes_for_longer_than_the_patience():
    stream = new_stream()
    assert stream_cause(stream, 10**12, 10**8)[0] == Cause.NONE
    note_sample(stream, 10**9)
    assert stream_cause(stream, 11 * 10**8, 10**8)[0] == Cause.NONE
    cause, index, value, limit = stream_cause(stream, 12 * 10**8, 10**8)
    assert (cause, index) == (Cause.TARGET_LOST, 0)
    assert value == pytest.approx(0.2) and limit == pytest.approx(0.1)
    fail_stream(stream, Cause.TARGET_JUMPS, 3, 0.02, 0.005)
    fail_stream(stream, Cause.TARGET_NOT_FINITE, 0, np.nan, np.nan)
    assert stream_cause(stream, 10**9, 10**8) == (Cause.TARGET_JUMPS, 3, 0.02, 0.005)


@pytest.mark.parametrize(("height", "end"), [(0.5, 1), (-0.2, 0)])
def test_a_sample_out_of_reach_names_the_leg_that_is_farthest_out_its_length_and_the_end_of_its_stroke(hexapod, height, end):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    # Leaning, so that the legs differ.
    position, turn = np.array([0.02, -0.01, height]), np.array([np.cos(0.05), np.sin(0.05), 0.0, 0.0])
    with pytest.raises(TargetRefusedError) as refusal:
        planner.add(0.0, position, turn)
    lean = rotation_from_vector([0.1, 0.0, 0.0]) @ hexapod.home.rotation
    lengths = leg_lengths(hexapod, hexapod.home.position + position, lean)
    stroke = hexapod.limits.stroke
    leg = int(np.argmax((lengths - stroke[:, 1]) if end else (stroke[:, 0] - lengths)))
    found = refusal.value
    assert (found.cause, found.index, found.limit) == (Cause.BEYOND_STROKE, leg, stroke[leg, end])
    assert found.value == pytest.approx(lengths[leg], abs=1e-12)
    assert str(found).startswith(f"leg {leg} is beyond its stroke (") and str(found).endswith(": correct what sends the target")


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_jump_names_the_leg_that_jumps_farthest_and_by_how_much(hexapod, sign):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    planner.add(2.0, np.zeros(3), LEVEL)
    move = sign * np.array([0.03, 0.01, 0.0])
    steps = leg_lengths(hexapod, hexapod.home.position + move, hexapod.home.rotation) - home_lengths(hexapod)
    leg = int(np.argmax(np.abs(steps)))
    # 1.5 times 0.25 m/s for 20 ms, and a millimetre.
    with pytest.raises(TargetRefusedError) as refusal:
        planner.add(2.02, move, LEVEL)
    found = refusal.value
    assert (found.cause, found.index) == (Cause.TARGET_JUMPS, leg)
    assert found.value == pytest.approx(np.abs(steps[leg])) and found.limit == pytest.approx(0.0085)
    size = 0.0085 / np.abs(steps[leg])
    with pytest.raises(TargetRefusedError):
        planner.add(2.02, 1.03 * size * move, LEVEL)
    planner.add(2.02, 0.97 * size * move, LEVEL)


@pytest.mark.parametrize("ahead", [0.0, 0.015, 0.04])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_plan_meets_an_accelerating_target_where_it_will_be(hexapod, ahead, sign):
    """Samples of an even acceleration: the plan is where the target is, and as fast, when it meets it after 30 ms."""
    planner, times = StreamPlanner(hexapod, home_lengths(hexapod)), 0.01 * np.arange(-12, 1)

    def height(t):
        return sign * (0.004 * t + 0.15 * t * t)

    def expected(t):
        # It is taken to accelerate for 50 ms after the last sample.
        bent = min(t, 0.05)
        at = height(bent) + (t - bent) * sign * (0.004 + 0.3 * bent)
        return leg_lengths(hexapod, hexapod.home.position + [0.0, 0.0, at], hexapod.home.rotation)

    for t in times:
        planner.add(5.0 + t, [0.0, 0.0, height(t)], LEVEL)
    # From the state in which the target will be, the plan can follow at once.
    at, state = 2.0, np.zeros((6, 3))
    h = 1e-4
    segments = rest(expected(ahead), PLAN_SEGMENTS)
    segments[:, 0, 0] = at
    segments[:, 0, 2] = (expected(ahead + h) - expected(ahead - h)) / (2.0 * h)
    planner.follow(Plan(at, segments, None))
    plan = planner.plan(at, ahead)
    evaluate_reference(plan.segments, at + 0.03, np.zeros(6, np.int64), state)
    np.testing.assert_allclose(state[:, 0], expected(ahead + 0.03), rtol=0.0, atol=3e-6)
    rates = (expected(ahead + 0.03 + h) - expected(ahead + 0.03 - h)) / (2.0 * h)
    np.testing.assert_allclose(state[:, 1], rates, rtol=0.0, atol=3e-4)
    assert plan.begin == at and plan.goal is None
    # It coasts for 20 ms, and then stops.
    evaluate_reference(plan.segments, at + 0.05, np.zeros(6, np.int64), state)
    np.testing.assert_allclose(state[:, 1], rates, rtol=0.0, atol=3e-4)
    evaluate_reference(plan.segments, at + 0.07, np.zeros(6, np.int64), state)
    assert (np.abs(state[:, 1]) < np.abs(rates)).all()


def test_from_the_speeds_that_a_leg_may_arrive_with_it_stops_within_the_way_that_is_left():
    room = np.array([1e-7, 1e-5, 1e-4, 1e-3, 0.0075, 0.0225, 0.06, 0.12])
    speeds = _stoppable(room, 3.0, 60.0)
    for way, speed in zip(room, speeds, strict=True):
        for sign in (-1.0, 1.0):
            length, rate = 0.0, sign * speed
            acceleration = 0.0
            for jerk, duration in stop_phases(rate, acceleration, 3.0, 60.0):
                length += duration * (rate + duration * (acceleration / 2.0 + duration * jerk / 6.0))
                rate += duration * (acceleration + duration * jerk / 2.0)
                acceleration += duration * jerk
            assert length == pytest.approx(sign * way, rel=1e-9) and rate == pytest.approx(0.0, abs=1e-12)
    # 7.5 mm from 0.15 m/s, 22.5 mm from 0.3 m/s.
    np.testing.assert_allclose(speeds[4:6], [0.15, 0.3], rtol=1e-12)
    assert _stoppable(np.array([-1e-3, 0.0]), 3.0, 60.0).tolist() == [0.0, 0.0]


def swing(mechanism, times, displacements):
    """By how much a leg goes beyond all that was sent [m]."""
    follower, sent = Follower(mechanism), [home_lengths(mechanism)]
    for at, displacement in zip(times, displacements, strict=True):
        cycle = round(at / PERIOD)
        follower.run(cycle, points=1)
        refused = follower.refused
        follower.add(at, displacement)
        if follower.refused > refused:
            break
        sent.append(leg_lengths(mechanism, mechanism.home.position + displacement, mechanism.home.rotation))
        if follower.planner.current.begin <= (cycle + 10) * PERIOD:
            follower.plan(cycle + 10, 0.01)
    follower.run(follower.cycle + 600, points=1)
    lengths, sent = np.array(follower.pieces)[:, :, 0], np.array(sent)
    return max((lengths.max(axis=0) - sent.max(axis=0)).max(), (sent.min(axis=0) - lengths.min(axis=0)).max())


SLOW, DENSE = 0.01 * np.arange(150), 0.0002 * np.arange(5000)


def waves(times):
    return np.sin(np.pi * times)[:, None] * np.array([10e-3, 5e-3, 5e-3])


@pytest.mark.parametrize("seed", [pytest.param(31, marks=pytest.mark.slow), pytest.param(32, marks=pytest.mark.endurance)])
@pytest.mark.parametrize(
    ("times", "made", "most"),
    [
        (SLOW, lambda t, noise: 1e-4 * noise, 2e-3),
        (SLOW, lambda t, noise: 0.58e-3 * noise.clip(-2.5, 2.5), 6e-3),
        (SLOW, lambda t, noise: 0.58e-3 * noise.clip(-2.5, 2.5) * (t > 0.5)[:, None], 6e-3),
        (SLOW, lambda t, noise: np.round(waves(t), 3), 2.5e-3),
        (SLOW, lambda t, noise: waves(t) + 1e-4 * noise, 4e-3),
        (DENSE, lambda t, noise: 1e-4 * noise.clip(-3.0, 3.0), 0.5e-3),
        (DENSE, lambda t, noise: waves(t) + 1e-4 * noise.clip(-3.0, 3.0), 4e-3),
        (DENSE, lambda t, noise: 4e-3 * np.abs((25.0 * t[:, None]) % 2.0 - 1.0) * [0.0, 0.0, 1.0] - [0.0, 0.0, 4e-3], 2e-3),
    ],
    ids=["noise", "much noise", "noise from 0.5 s on", "rounded", "noisy waves", "dense noise", "dense waves", "dense teeth"],
)
def test_legs_do_not_swing_beyond_what_was_sent(hexapod, times, made, most, seed):
    """A curve through the last samples took them up to 39 mm beyond. Waves end at full speed, from which legs need 3 mm."""
    noise = np.random.default_rng(seed).normal(size=(len(times), 3))
    assert swing(hexapod, times, made(times, noise)) < most


def test_a_time_stamp_far_ahead_moves_nothing_by_itself(hexapod):
    times = np.append(SLOW[:100], 2.0**64 * 1e-9)
    follower = Follower(hexapod)
    for at, displacement in zip(times, waves(SLOW[:101]), strict=True):
        follower.run(follower.cycle + 10, points=1)
        follower.add(at, displacement)
        follower.plan(follower.cycle + 10, 0.01)
    follower.run(follower.cycle + 600, points=1)
    lengths = np.array(follower.pieces)[:, :, 0]
    sent = leg_lengths(hexapod, hexapod.home.position + waves(SLOW[:101]), np.tile(hexapod.home.rotation, (101, 1, 1)))
    # What was sent, and the way to come to rest from its speed.
    assert (lengths.max(axis=0) - sent.max(axis=0)).max() < 3e-3 and (sent.min(axis=0) - lengths.min(axis=0)).max() < 3e-3


def test_samples_that_come_more_often_may_not_jump_farther(hexapod):
    """Each sample by itself went less than a millimetre, and they 50 mm/s faster than a leg may."""
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    speed, found = 2.0 * hexapod.limits.velocity, None
    for k in range(200):
        try:
            planner.add(0.0002 * k, [0.0, 0.0, speed * 0.0002 * k], LEVEL)
        except TargetRefusedError as refusal:
            found = refusal
            break
    assert found is not None and found.cause == Cause.TARGET_JUMPS
    # At the greatest speed allowed, and one millimetre.
    assert 0.0002 * k * (speed * 0.9 - 1.5 * hexapod.limits.velocity) < 1e-3 + 0.0002 * speed
    assert found.value > found.limit


def test_a_gap_lets_a_target_jump_no_farther_than_the_patience_with_it(hexapod):
    planner = StreamPlanner(hexapod, home_lengths(hexapod))
    planner.add(0.0, np.zeros(3), LEVEL)
    with pytest.raises(TargetRefusedError, match=r"the limit is 0.0385 m"):
        planner.add(1e6, [0.0, 0.0, 0.05], LEVEL)
    planner.add(1e6, [0.0, 0.0, 0.03], LEVEL)
