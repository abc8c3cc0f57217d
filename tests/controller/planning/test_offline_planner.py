"""The planner: no limit is ever left, whatever the target; and slow targets are followed, fast ones as far as possible."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.direct_kinematics import poses_from_lengths
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.planning.motions import SAMPLE_PERIOD_S
from controller.planning.offline_planner import Reference, count_violations, plan
from controller.planning.target import Target, load_target
from plant.errors import GoughError, InputError, UnreachableError
from plant.mechanism import Mechanism, load_in_space
from tests.controller.leg_geometry import leg_vectors
from tests.controller.planning.sampled_reference import sample_reference

ROUNDING = 1e-9
"""Relative to a limit, as the planner's own count has it; for the stroke, in m."""


def with_limits(mechanism, **changes):
    limits = {"stroke": mechanism.limits.stroke, "velocity": 0.25, "acceleration": 3.0, "jerk": 60.0} | changes
    return Mechanism.from_legs(mechanism.base_joints, mechanism.platform_joints, home=mechanism.home, limits=limits)


def moved_from_home(mechanism, displacements, times=None, *, held=False, name="test"):
    """A target of displacements (N, 6), position and rotation vector, from home."""
    times = SAMPLE_PERIOD_S * np.arange(len(displacements)) if times is None else times
    rotations = Rotation.from_rotvec(displacements[:, 3:]).as_matrix() @ mechanism.home.rotation
    return Target(name, times, mechanism.home.position + displacements[:, :3], rotations, held)


def stretched_to_the_stroke(mechanism, displacements, share=1.0):
    """Displacements scaled until a leg comes to `share` of its way to an end of its stroke, by bisection."""
    home = leg_lengths(mechanism, mechanism.home.position, mechanism.home.rotation)
    stroke = home[:, None] + share * (mechanism.limits.stroke - home[:, None])

    def inside(scale):
        target = moved_from_home(mechanism, scale * displacements)
        lengths = leg_lengths(mechanism, target.positions, target.rotations)
        return ((lengths >= stroke[:, 0]) & (lengths <= stroke[:, 1])).all()

    least, greatest = 0.0, 1.0
    while inside(greatest):
        greatest *= 2.0
    for _ in range(40):
        middle = (least + greatest) / 2.0
        least, greatest = (middle, greatest) if inside(middle) else (least, middle)
    return least * displacements


SIZES = np.array([0.03, 0.03, 0.02, 0.1, 0.1, 0.15])


def sines(random, mechanism, duration):
    """Up to 6 Hz, from end to end of the stroke: far beyond every limit."""
    times = np.arange(0.0, duration + 0.1, SAMPLE_PERIOD_S)
    frequencies, phases = random.uniform(0.2, 6.0, 6), random.uniform(0.0, 2.0 * np.pi, 6)
    waves = random.uniform(0.2, 1.0, 6) * SIZES * np.sin(2.0 * np.pi * frequencies * times[:, None] + phases)
    return moved_from_home(mechanism, stretched_to_the_stroke(mechanism, waves))


def steps(random, mechanism, duration):
    """Poses anywhere in the workspace, held for 20 to 500 ms."""
    times = np.concatenate([[0.0], np.cumsum(random.uniform(0.02, 0.5, int(duration / 0.02)))])
    times = times[times < duration]
    positions, rotations = sample_workspace(mechanism, len(times), seed=int(random.integers(2**31)))
    return Target("steps", times, positions, rotations, held=True)


def jumps(random, mechanism, duration):
    """The same poses, but from one to the next within a sample."""
    return replace(steps(random, mechanism, duration), held=False)


def noise(random, mechanism, duration):
    """A new pose every 10 ms without any connection with the one before."""
    displacements = random.normal(size=(int(duration / SAMPLE_PERIOD_S) + 10, 6)) * SIZES
    return moved_from_home(mechanism, stretched_to_the_stroke(mechanism, displacements))


def dwells(random, mechanism, duration):
    """To where a leg is at the very end of its stroke, as fast as it goes, and away again."""
    poses = stretched_to_the_stroke(mechanism, random.normal(size=(1, 6)) * SIZES)
    poses = np.concatenate([np.zeros((1, 6)), poses, -0.3 * poses, poses])
    return moved_from_home(
        mechanism, poses, np.sort(np.concatenate([[0.0], random.uniform(0.1, 0.8, 3) * duration])), held=True
    )


def grazing(random, mechanism, duration):
    """Slow enough to be followed, and just touching the end of a stroke."""
    times = np.arange(0.0, duration + 0.1, SAMPLE_PERIOD_S)
    frequencies = random.uniform(0.4, 0.9, 6)
    waves = random.uniform(0.2, 1.0, 6) * SIZES * (1.0 - np.cos(2.0 * np.pi * frequencies * times[:, None]))
    return moved_from_home(mechanism, stretched_to_the_stroke(mechanism, waves))


def uneven(random, mechanism, duration):
    """A walk sampled at uneven times, and ending in full motion before the time is up."""
    times = np.concatenate([[0.0], np.cumsum(random.uniform(1e-4, 0.03, int(duration / 0.02)))])
    walk = np.cumsum(random.normal(size=(len(times), 6)) * SIZES, axis=0)
    return moved_from_home(mechanism, stretched_to_the_stroke(mechanism, walk - walk[0], 0.999), times)


FAMILIES = [sines, steps, jumps, noise, dwells, grazing, uneven]


def dense(reference: Reference, horizon, points=65):
    """Lengths, rates, accelerations, jerks at points of every segment, its ends included: lists of (n, points) per leg; and
    the jumps of the first three from segment to segment, (n - 1, 3).
    """
    sampled, gaps = [], []
    for rows in reference.segments:
        rows = rows[rows[:, 0] < horizon]
        ends = np.append(rows[1:, 0], horizon)
        t = np.linspace(0.0, 1.0, points) * (ends - rows[:, 0])[:, None]
        p, v, a, j = (rows[:, column, None] for column in range(1, 5))
        values = p + t * (v + t * (a / 2.0 + t * j / 6.0)), v + t * (a + t * j / 2.0), a + t * j, j + 0.0 * t
        sampled.append(values)
        gaps.append(np.stack([value[:-1, -1] - value[1:, 0] for value in values[:3]], axis=1))
    return sampled, gaps


def check(mechanism, target, duration):
    """Every promise of a plan, on a grid denser than its segments."""
    limits = mechanism.limits
    reference = plan(mechanism, target, duration)
    horizon = SAMPLE_PERIOD_S * np.ceil(duration / SAMPLE_PERIOD_S - 1e-9)
    used = reference.segments[np.isfinite(reference.segments[:, :, 0])]
    assert np.isfinite(used).all()
    assert reference.violations == 0
    sampled, gaps = dense(reference, horizon)
    for leg, (lengths, rates, accelerations, jerks) in enumerate(sampled):
        assert lengths.min() >= limits.stroke[leg, 0] - ROUNDING
        assert lengths.max() <= limits.stroke[leg, 1] + ROUNDING
        assert np.abs(rates).max() <= limits.velocity * (1.0 + ROUNDING)
        assert np.abs(accelerations).max() <= limits.acceleration * (1.0 + ROUNDING)
        assert np.abs(jerks).max() <= limits.jerk * (1.0 + ROUNDING)
        # Only the jerk jumps.
        np.testing.assert_allclose(gaps[leg][:, 0], 0.0, atol=1e-12)
        np.testing.assert_allclose(gaps[leg][:, 1], 0.0, atol=1e-10)
        np.testing.assert_allclose(gaps[leg][:, 2], 0.0, atol=1e-8)
        first = leg_lengths(mechanism, target.positions[0], target.rotations[0])[leg]
        np.testing.assert_array_equal(reference.segments[leg, 0, :4], [0.0, first, 0.0, 0.0])
        assert (np.diff(reference.segments[leg, np.isfinite(reference.segments[leg, :, 0]), 0]) >= 0.0).all()
    return reference, sampled


# ------------------------------------------------------------------------------------------------------------------ limits


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_no_target_makes_a_leg_leave_a_limit(hexapod, family):
    busy = 0
    for seed in range(40):
        random = np.random.default_rng(seed)
        _, sampled = check(hexapod, family(random, hexapod, 1.0), 1.0)
        busy += max(np.abs(accelerations).max() for _, _, accelerations, _ in sampled) > 0.99 * hexapod.limits.acceleration
    # The targets were such that the limits mattered.
    assert busy > 20 or family is grazing


@pytest.mark.parametrize(
    "limits",
    [
        {"velocity": 0.02},
        {"acceleration": 0.2},
        {"jerk": 2.0},
        {"velocity": 1.0, "acceleration": 40.0, "jerk": 4000.0},
        {"jerk": 1e5},
    ],
)
def test_limits_of_every_kind_are_kept(hexapod, limits):
    mechanism = with_limits(hexapod, **limits)
    for seed, family in enumerate(FAMILIES):
        check(mechanism, family(np.random.default_rng(seed), mechanism, 1.0), 1.0)


def test_what_the_plan_keeps_to_is_violated_when_the_limit_is_lowered(hexapod):
    target = steps(np.random.default_rng(1), hexapod, 2.0)
    reference, _ = check(hexapod, target, 2.0)
    sampled, _ = dense(reference, 2.0, points=3001)
    reached = [max(np.abs(values[order]).max() for values in sampled) for order in range(1, 4)]
    for name, most in zip(("velocity", "acceleration", "jerk"), reached, strict=True):
        assert count_violations(reference.segments, 2.0, replace(hexapod.limits, **{name: 1.0001 * most})) == 0
        assert count_violations(reference.segments, 2.0, replace(hexapod.limits, **{name: 0.9999 * most})) > 0
    for leg, (lengths, *_) in enumerate(sampled):
        for end, extreme, inward in ((0, lengths.min(), 1e-6), (1, lengths.max(), -1e-6)):
            for change, found in ((-inward, False), (inward, True)):
                stroke = hexapod.limits.stroke.copy()
                stroke[leg, end] = extreme + change
                assert (count_violations(reference.segments, 2.0, replace(hexapod.limits, stroke=stroke)) > 0) == found


def test_violations_are_counted_segment_by_segment(hexapod):
    """Against a count on the dense grid, which misses an extremum between its points by little."""
    target = sines(np.random.default_rng(2), hexapod, 3.0)
    reference, _ = check(hexapod, target, 3.0)

    def counted(share, points=400):
        limits = hexapod.limits
        total = 0
        for leg, (lengths, rates, accelerations, jerks) in enumerate(dense(reference, 3.0, points)[0]):
            middle = limits.stroke[leg].mean()
            outside = np.abs(lengths - middle) > share * (limits.stroke[leg, 1] - middle)
            outside |= np.abs(rates) > share * limits.velocity
            outside |= np.abs(accelerations) > share * limits.acceleration
            outside |= np.abs(jerks) > 2.0 * limits.jerk
            total += outside.any(axis=1).sum()
        return total

    for share in (0.3, 0.6, 0.9):
        middle = hexapod.limits.stroke.mean(axis=1, keepdims=True)
        lowered = replace(
            hexapod.limits,
            stroke=middle + share * (hexapod.limits.stroke - middle),
            velocity=share * 0.25,
            acceleration=share * 3.0,
            jerk=120.0,
        )
        found = count_violations(reference.segments, 3.0, lowered)
        assert 0 < counted(share * (1.0 + 1e-6)) <= found <= counted(share * (1.0 - 1e-3))
        # Beyond the horizon nothing counts.
        assert count_violations(reference.segments, 0.0, lowered) == 0
        assert count_violations(reference.segments, 1.5, lowered) < found


def test_an_extremum_inside_a_segment_is_seen(hexapod):
    """Up and down again within one cubic: at its ends it is well inside."""
    middle = hexapod.limits.stroke.mean(axis=1)
    segments = np.zeros((6, 1, 5))
    segments[:, 0, 1] = middle
    assert count_violations(segments, 1.0, hexapod.limits) == 0
    # 0.2 m/s at -1 m/s^2 turns round after 0.2 s, 20 mm away, and is back after 0.4 s.
    segments[2, 0] = (0.0, hexapod.limits.stroke[2, 1] - 0.0199, 0.2, -1.0, 0.0)
    assert count_violations(segments, 0.4, hexapod.limits) == 1
    segments[2, 0, 1] -= 0.0002
    assert count_violations(segments, 0.4, hexapod.limits) == 0
    # From -2 to 2 m/s^2 in 0.4 s at 10 m/s^3: the speed falls by 0.2 m/s in between, below -0.25 m/s.
    segments[2, 0] = (0.0, middle[2] + 0.05, -0.051, -2.0, 10.0)
    assert count_violations(segments, 0.4, hexapod.limits) == 1
    segments[2, 0, 2] += 0.002
    assert count_violations(segments, 0.4, hexapod.limits) == 0


@pytest.mark.parametrize("column", range(1, 5))
def test_a_segment_that_is_not_a_number_is_a_violation(hexapod, column):
    segments = np.zeros((6, 1, 5))
    segments[:, 0, 1] = hexapod.limits.stroke.mean(axis=1)
    assert count_violations(segments, 1.0, hexapod.limits) == 0
    segments[3, 0, column] = np.nan
    assert count_violations(segments, 1.0, hexapod.limits) > 0


# --------------------------------------------------------------------------------------------------------------- following


def position_error(mechanism, target, duration):
    """RMS distance [m] of the planned pose from the raw target, sampled at 1 kHz; violations are checked on the way."""
    reference, _ = check(mechanism, target, duration)
    count = round(1000 * duration)
    lengths = sample_reference(reference.segments, 1e-3, count)[:, :, 0]
    positions, _ = poses_from_lengths(mechanism, lengths, target.start)
    wanted, _ = target.at(1e-3 * np.arange(count))
    return np.sqrt(np.mean(np.sum((positions - wanted) ** 2, axis=1)))


@pytest.mark.slow
def test_a_recorded_motion_is_followed_within_a_fiftieth_of_a_millimetre(hexapod, motion_capture):
    assert position_error(hexapod, load_target(motion_capture, hexapod, 60.0), 60.0) <= 0.02e-3


@pytest.mark.parametrize("name", ["hold", "circle", "sines"])
def test_named_motions_are_followed_within_a_fiftieth_of_a_millimetre(hexapod, name):
    assert position_error(hexapod, load_target(name, hexapod, 8.0), 8.0) <= 0.02e-3


def shortest_time(distance, limits):
    """Of a move from rest to rest at these limits: with and without a phase of constant acceleration, or of speed."""
    v, a, j = limits.velocity, limits.acceleration, limits.jerk
    ramp = v / a + a / j if v * j > a * a else 2.0 * np.sqrt(v / j)
    if distance >= v * ramp:
        return distance / v + ramp
    if distance >= 2.0 * a**3 / j**2:
        return a / j + np.sqrt((a / j) ** 2 + 4.0 * distance / a)
    return 4.0 * (distance / (2.0 * j)) ** (1.0 / 3.0)


@pytest.mark.parametrize("seed", range(10))
def test_a_step_from_rest_to_rest_arrives_in_the_time_that_its_slowest_leg_needs(hexapod, seed):
    positions, rotations = sample_workspace(hexapod, 2, seed=seed)
    target = Target("step", np.array([0.0, 0.5]), positions, rotations, held=True)
    start, end = leg_lengths(hexapod, positions, rotations)
    needed = max(shortest_time(distance, hexapod.limits) for distance in np.abs(end - start))
    reference, _ = check(hexapod, target, 3.0)
    samples = sample_reference(reference.segments, 1e-3, 3000)
    np.testing.assert_allclose(samples[:500, :, 0], np.broadcast_to(start, (500, 6)), rtol=0.0, atol=1e-9)
    away = np.abs(samples[:, :, 0] - end).max(axis=1)
    arrived = 1e-3 * (np.flatnonzero(away > 1e-5)[-1] + 1) - 0.5
    assert 0.9 * needed < arrived < needed + SAMPLE_PERIOD_S
    np.testing.assert_allclose(samples[-1, :, 0], end, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(samples[-1, :, 1:], 0.0, atol=1e-9)


def dash(mechanism, seed):
    """From one pose of the workspace straight to another within 50 ms, and then waiting."""
    share = np.clip((np.arange(0.0, 2.0, SAMPLE_PERIOD_S) - 0.2) / 0.05, 0.0, 1.0)[:, None]
    while True:
        positions, rotations = sample_workspace(mechanism, 2, seed=seed)
        turn = Rotation.from_matrix(rotations[1] @ rotations[0].T).as_rotvec()
        turned = Rotation.from_rotvec(share * turn).as_matrix() @ rotations[0]
        moved = positions[0] + share * (positions[1] - positions[0])
        lengths = leg_lengths(mechanism, moved, turned)
        if ((lengths > mechanism.limits.stroke[:, 0]) & (lengths < mechanism.limits.stroke[:, 1])).all():
            return Target("dash", SAMPLE_PERIOD_S * np.arange(len(share)), moved, turned), lengths
        seed += 1000


@pytest.mark.parametrize("seed", range(10))
def test_a_target_too_fast_to_follow_is_caught_up_with_where_it_waits(hexapod, seed):
    target, lengths = dash(hexapod, seed)
    assert np.abs(np.diff(lengths, axis=0)).max() / SAMPLE_PERIOD_S > 1.5 * hexapod.limits.velocity
    reference, _ = check(hexapod, target, 2.0)
    samples = sample_reference(reference.segments, 1e-3, 2000)
    start, end = lengths[0], lengths[-1]
    needed = max(shortest_time(distance, hexapod.limits) for distance in np.abs(end - start))
    away = np.abs(samples[:, :, 0] - end).max(axis=1)
    arrived = 1e-3 * (np.flatnonzero(away > 1e-5)[-1] + 1) - 0.2
    assert arrived < needed + 0.1
    np.testing.assert_allclose(samples[-1, :, 0], end, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(samples[-1, :, 1], 0.0, atol=1e-5)


def test_a_target_that_ends_early_is_left_at_rest_where_it_ended(hexapod):
    target = sines(np.random.default_rng(3), hexapod, 0.5)
    reference, _ = check(hexapod, target, 3.0)
    samples = sample_reference(reference.segments, 1e-3, 3000)
    end = leg_lengths(hexapod, target.positions[-1], target.rotations[-1])
    np.testing.assert_allclose(samples[-1, :, 0], end, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(samples[-1, :, 1], 0.0, atol=1e-5)


def test_a_target_that_stands_still_is_not_left_by_rounding(hexapod):
    """Lengths such as 0.3999999999999999 m once made the generator fail."""
    for nudge in (0.0, 1e-16, -1e-16, 3e-13):
        displacements = np.zeros((50, 6))
        displacements[1::2, 2] = nudge
        target = moved_from_home(hexapod, displacements)
        reference, _ = check(hexapod, target, 2.0)
        samples = sample_reference(reference.segments, 1e-3, 2000)
        home = leg_lengths(hexapod, hexapod.home.position, np.eye(3))
        np.testing.assert_allclose(samples[:, :, 0], np.broadcast_to(home, (2000, 6)), rtol=0.0, atol=1e-9)


def test_a_planar_mechanism_is_planned_for_in_its_three_legs_alone():
    mechanism = load_in_space("planar-3rpr")
    target = load_target("circle", mechanism, 3.0)
    reference = plan(mechanism, target, 3.0)
    assert reference.violations == 0
    samples = sample_reference(reference.segments, 5e-3, 600)
    assert not samples[:, 3:].any()
    wanted = leg_lengths(mechanism, *target.at(5e-3 * np.arange(600)))
    np.testing.assert_allclose(samples[:, :3, 0], wanted, rtol=0.0, atol=0.1e-3)
    # And its own limits are kept, which are a third of the hexapod's.
    assert np.abs(samples[:, :, 1]).max() <= mechanism.limits.velocity == 0.08


def test_planning_twice_gives_the_same_segments_bit_by_bit(hexapod):
    target = jumps(np.random.default_rng(4), hexapod, 1.0)
    np.testing.assert_array_equal(plan(hexapod, target, 1.0).segments, plan(hexapod, target, 1.0).segments)


# ----------------------------------------------------------------------------------------------------------------- refusals


def test_a_pose_out_of_reach_is_refused_with_the_leg_and_how_far(hexapod):
    displacements = np.zeros((20, 6))
    displacements[7] = (0.03, 0.02, 0.08, 0.0, 0.0, 0.1)
    displacements[8] = (0.0, 0.0, 0.07, 0.0, 0.0, 0.0)
    target = moved_from_home(hexapod, displacements, name="too high")
    lengths = np.linalg.norm(leg_vectors(hexapod, target.positions[7], target.rotations[7]), axis=1)
    excess = lengths - hexapod.limits.stroke[:, 1]
    leg = int(np.argmax(excess))
    with pytest.raises(UnreachableError) as caught:
        plan(hexapod, target, 0.2)
    assert isinstance(caught.value, GoughError)
    assert isinstance(caught.value, ValueError)
    for said in ("too high", f"leg {leg}", f"{1e3 * excess[leg]:.2f} mm", f"{1e3 * lengths[leg]:.2f} mm"):
        assert said in str(caught.value)
    # At 99 % of the way to where its worst leg leaves the stroke, the same motion is planned.
    check(hexapod, moved_from_home(hexapod, stretched_to_the_stroke(hexapod, displacements, 0.99)), 0.2)


def test_a_mechanism_without_a_stroke_has_no_plan(hexapod):
    bare = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints, home=hexapod.home)
    with pytest.raises(InputError, match="stroke"):
        plan(bare, moved_from_home(hexapod, np.zeros((5, 6))), 0.1)
