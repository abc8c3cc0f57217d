"""Planar direct kinematics: poses come back for every class, roots agree with a search over all angles, noise and covariance
agree with what they do to the pose, and what is not determined is refused.
"""

import re

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, least_squares

from controller.direct_kinematics.planar import closing_angles, closing_positions, solve_planar
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism.planar import PlanarMechanism

SEEDS = st.integers(0, 2**32 - 1)
ANGLES = st.one_of(st.floats(-np.pi, np.pi), st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2, -np.pi / 2, 1e-12, np.pi - 1e-9]))
CLASSES = {
    "n-3, n = 3": ("012", "012"),
    "n-3, n = 2": ("001", "012"),
    "n-2, n = 3": ("012", "001"),
    "n-2, n = 2": ("011", "001"),
}
DEGREE = np.pi / 180.0
RIG = PlanarMechanism.from_legs([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]], [[0.0, 0.0], [1.0, 0.0], [2.0, 0.5]], name="mine")


# ---------------------------------------------------------------------------------------------------- independent twins


def turned(point, angle):
    x, y = point
    return np.array([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])


def legs_at(mechanism, position, angle):
    """Angles and lengths of the legs, one by one."""
    joints = zip(mechanism.platform_joints, mechanism.base_joints, strict=True)
    legs = [position + turned(a, angle) - b for a, b in joints]
    return np.array([np.arctan2(y, x) for x, y in legs]), np.array([np.hypot(x, y) for x, y in legs])


def misses(mechanism, leg_angles, position, angle):
    """The distance of each platform joint from the line of its leg."""
    found = []
    for a, b, t in zip(mechanism.platform_joints, mechanism.base_joints, leg_angles, strict=True):
        x, y = position + turned(a, angle) - b
        found.append(x * np.sin(t) - y * np.cos(t))
    return np.array(found)


def crossing(mechanism, leg_angles, angle, first, second):
    """The position at which two legs meet their joints on a platform at `angle`."""
    starts = [mechanism.base_joints[k] - turned(mechanism.platform_joints[k], angle) for k in (first, second)]
    rays = np.array([[np.cos(leg_angles[k]), np.sin(leg_angles[k])] for k in (first, second)])
    along = np.linalg.solve(np.column_stack([rays[0], -rays[1]]), starts[1] - starts[0])
    return starts[0] + along[0] * rays[0]


def angles_by_search(mechanism, leg_angles):
    """Every platform angle at which the third leg meets its joint too, from the sign changes over a full turn."""
    first, second = max(((0, 1), (1, 2), (2, 0)), key=lambda pair: abs(np.sin(np.subtract(*leg_angles[list(pair)]))))
    third = 3 - first - second

    def miss(angle):
        return misses(mechanism, leg_angles, crossing(mechanism, leg_angles, angle, first, second), angle)[third]

    grid = np.linspace(-np.pi, np.pi, 181) + 0.001
    values = [miss(angle) for angle in grid]
    return [
        brentq(miss, *grid[k : k + 2], xtol=1e-15, rtol=1e-14) for k in range(len(grid) - 1) if values[k] * values[k + 1] <= 0.0
    ]


def random_mechanism(random, joints=CLASSES["n-3, n = 3"], collinear=(False, False), stroke=None):
    base, platform = (
        random.uniform(-0.2, 0.2, (3, 2)) @ np.diag([1.0, not flat]) @ rotation_of(random.uniform(-3.0, 3.0)).T
        + random.uniform(-0.2, 0.2, 2)
        for flat in collinear
    )
    rows = ([int(k) for k in side] for side in joints)
    return PlanarMechanism.from_legs(
        base[next(rows)], platform[next(rows)], limits=stroke if stroke is None else {"stroke": stroke}
    )


def rotation_of(angle):
    return np.column_stack([turned(axis, angle) for axis in np.eye(2)])


def random_case(seed, **options):
    """A mechanism, and a pose of it with the leg angles."""
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, **options)
    position, angle = random.uniform(-0.3, 0.3, 2), random.uniform(-np.pi, np.pi)
    return mechanism, position, angle, legs_at(mechanism, position, angle)[0]


def tangent_case(seed):
    """A double root: the perpendiculars to the legs in the platform joints meet in one point."""
    random = np.random.default_rng(seed)
    platform = random.uniform(-0.1, 0.1, (3, 2))
    position, angle, center = random.uniform(-0.2, 0.2, 2), random.uniform(-3.0, 3.0), random.uniform(-0.3, 0.3, 2)
    joints = np.array([position + turned(a, angle) for a in platform])
    base = joints - np.array([rotation_of(np.pi / 2) @ (joint - center) for joint in joints]) * random.uniform(0.5, 2.0, (3, 1))
    mechanism = PlanarMechanism.from_legs(base, platform)
    return mechanism, position, angle, legs_at(mechanism, position, angle)[0]


def separation(first, second):
    return abs(np.angle(np.exp(1j * (first - second))))


def pose_error(mode, position, angle):
    return max(np.abs(mode.position - position).max(), separation(mode.angle, angle))


# -------------------------------------------------------------------------------------------------------- legs alone


@pytest.mark.parametrize("joints", CLASSES.values(), ids=CLASSES)
@given(seed=SEEDS, angle=ANGLES, collinear=st.tuples(st.booleans(), st.booleans()))
@settings(max_examples=60, deadline=None)
def test_one_of_the_modes_is_the_true_pose_and_both_close_the_legs(joints, seed, angle, collinear):
    random = np.random.default_rng(seed)
    mechanism = random_mechanism(random, joints, collinear)
    position = random.uniform(-0.3, 0.3, 2)
    leg_angles, lengths = legs_at(mechanism, position, angle)
    modes = solve_planar(mechanism, leg_angles)
    nearest = min(modes, key=lambda mode: pose_error(mode, position, angle))
    if nearest.conditioning > 1e-6:
        assert pose_error(nearest, position, angle) < 1e-8
        np.testing.assert_allclose(nearest.lengths, lengths, atol=1e-8)
        assert nearest.within_stroke
    assert [mode.double_root for mode in modes] in ([False, False], [True])
    for mode in modes:
        assert -np.pi < mode.angle <= np.pi
        assert np.abs(misses(mechanism, leg_angles, mode.position, mode.angle)).max() < 1e-9 * (
            1.0 + np.abs(mode.lengths).max()
        )
        np.testing.assert_allclose(np.abs(mode.lengths), legs_at(mechanism, mode.position, mode.angle)[1], atol=1e-8)
    assert len(modes) == 1 or separation(modes[0].angle, modes[1].angle) > 1e-6


@given(seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_the_modes_are_all_that_a_search_over_every_angle_finds(seed):
    random = np.random.default_rng(seed)
    mechanism, leg_angles = random_mechanism(random), random.uniform(-np.pi, np.pi, 3)
    modes = solve_planar(mechanism, leg_angles)
    # Roots closer than two angles of the search would pass unseen.
    assume(len(modes) == 1 or separation(modes[0].angle, modes[1].angle) > 0.05)
    found = angles_by_search(mechanism, leg_angles)
    assert len(found) == (0 if modes[0].double_root else 2)
    for angle in found:
        assert min(separation(mode.angle, angle) for mode in modes) < 1e-8


@pytest.mark.parametrize("seed", range(8))
def test_many_samples_at_once_are_what_each_gives_alone(seed):
    mechanism, _, _, leg_angles = random_case(seed)
    samples = leg_angles + np.random.default_rng(seed).normal(0.0, 0.02, (4, 5, 3))
    angles = closing_angles(mechanism, samples)
    positions = closing_positions(mechanism, samples[..., None, :], angles)
    for where in np.ndindex(4, 5):
        modes = solve_planar(mechanism, samples[where])
        order = np.argsort(angles[where])[: len(modes)]
        modes = sorted(modes, key=lambda mode: mode.angle)
        np.testing.assert_allclose(angles[where][order], [mode.angle for mode in modes], rtol=0.0, atol=1e-14)
        np.testing.assert_allclose(positions[where][order], [mode.position for mode in modes], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("unit", [20.0, 1e-6])
@pytest.mark.parametrize("seed", range(6))
def test_neither_units_nor_the_choice_of_frames_matter(seed, unit):
    mechanism, _, _, leg_angles = random_case(seed)
    shift_base, shift_platform, turn_base, turn_platform = np.array([5.0, -2.0]), np.array([0.3, 1.0]), 0.4, -1.1
    base = unit * (np.array([turned(b, turn_base) for b in mechanism.base_joints]) + shift_base)
    platform = unit * np.array([turned(a - shift_platform, turn_platform) for a in mechanism.platform_joints])
    other = PlanarMechanism.from_legs(base, platform)
    for mode in solve_planar(mechanism, leg_angles):
        twin = min(
            solve_planar(other, leg_angles + turn_base),
            key=lambda twin: separation(twin.angle, mode.angle + turn_base - turn_platform),
        )
        joints = mechanism.joints_at(mode.position, mode.angle)
        expected = unit * (np.array([turned(joint, turn_base) for joint in joints]) + shift_base)
        np.testing.assert_allclose(other.joints_at(twin.position, twin.angle), expected, rtol=0.0, atol=1e-9 * unit)
        assert twin.conditioning == pytest.approx(mode.conditioning, rel=1e-6)
        assert twin.covariance[2, 2] == pytest.approx(mode.covariance[2, 2], rel=1e-6)


# ------------------------------------------------------------------------------------------------------- double roots


@pytest.mark.parametrize("seed", range(10))
def test_where_the_modes_merge_there_is_one_without_a_covariance(seed):
    mechanism, position, angle, leg_angles = tangent_case(seed)
    (mode,) = solve_planar(mechanism, leg_angles)
    assert mode.double_root
    assert pose_error(mode, position, angle) < 1e-6
    assert mode.conditioning < 1e-6
    assert np.isposinf(mode.covariance).all()


@pytest.mark.parametrize("seed", range(10))
def test_noise_at_a_double_root_splits_it_or_leaves_the_closest_pose(seed):
    mechanism, position, angle, leg_angles = tangent_case(seed)
    noisy = [leg_angles + [noise, 0.0, 0.0] for noise in (-0.01, 0.01)]
    (contradictory, one), (_, two) = sorted(
        ((angles, solve_planar(mechanism, angles)) for angles in noisy), key=lambda x: len(x[1])
    )
    assert [mode.double_root for mode in (*one, *two)] == [True, False, False]
    closest = least_squares(
        lambda pose: misses(mechanism, contradictory, pose[:2], pose[2]), [*position, angle], xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    assert closest.cost > 1e-12
    assert pose_error(one[0], closest.x[:2], closest.x[2]) < 1e-5
    left = misses(mechanism, contradictory, one[0].position, one[0].angle)
    assert 0.5 * left @ left == pytest.approx(closest.cost, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_conditioning_tells_how_near_the_modes_are_to_merging(seed):
    mechanism, _, _, leg_angles = tangent_case(seed)
    split = max((1.0, -1.0), key=lambda sign: len(solve_planar(mechanism, leg_angles + [sign * 1e-3, 0.0, 0.0])))
    modes = [solve_planar(mechanism, leg_angles + [split * noise, 0.0, 0.0])[0] for noise in (1e-3, 1e-5, 1e-7, 1e-9)]
    conditioning = np.array([mode.conditioning for mode in modes])
    sigma = np.sqrt([mode.covariance[2, 2] for mode in modes])
    np.testing.assert_allclose(conditioning[:-1] / conditioning[1:], 10.0, rtol=0.2)  # the root of the noise
    np.testing.assert_allclose(sigma[1:] / sigma[:-1], 10.0, rtol=0.2)


# --------------------------------------------------------------------------------------------------- stroke and order


@pytest.mark.parametrize("seed", range(10))
def test_what_is_within_the_stroke_comes_first_and_then_the_smaller_angle(seed):
    mechanism, _, _, leg_angles = random_case(seed)
    modes = solve_planar(mechanism, leg_angles)
    for wanted in modes:
        lengths = np.abs(wanted.lengths)[:, None] * [0.99, 1.01]
        limited = PlanarMechanism.from_legs(mechanism.base_joints, mechanism.platform_joints, limits={"stroke": lengths})
        first, second = solve_planar(limited, leg_angles)
        positive = bool((wanted.lengths > 0.0).all())
        assert [mode.within_stroke for mode in (first, second)] == [positive, False]
        if positive:
            assert first.angle == wanted.angle
        else:
            assert abs(first.angle) < abs(second.angle)


@pytest.mark.parametrize(("least", "greatest", "within"), [(0.5, 1.5, True), (1.1, 1.5, False), (0.5, 0.9, False)])
def test_every_leg_has_its_own_stroke(least, greatest, within):
    stroke = [[0.1, 9.0], [least, greatest], [0.1, 9.0]]
    mechanism = PlanarMechanism.from_legs(RIG.base_joints, RIG.platform_joints, limits={"stroke": stroke})
    position = np.array([0.2, np.sqrt(0.96)])  # legs 0 and 1 are 1 m long
    (mode,) = solve_planar(mechanism, legs_at(mechanism, position, 0.0)[0], roll=0.0)
    assert mode.within_stroke is within


def test_legs_pointed_the_other_way_have_negative_lengths():
    mechanism, position, angle, leg_angles = random_case(3)
    for mode, twin in zip(solve_planar(mechanism, leg_angles), solve_planar(mechanism, leg_angles + np.pi), strict=True):
        assert pose_error(twin, mode.position, mode.angle) < 1e-12
        np.testing.assert_allclose(twin.lengths, -mode.lengths, atol=1e-12)
    assert not any(mode.within_stroke for mode in solve_planar(mechanism, leg_angles + np.pi))
    assert min(pose_error(mode, position, angle) for mode in solve_planar(mechanism, leg_angles)) < 1e-10


# ------------------------------------------------------------------------------------------------------ with the roll


@pytest.mark.parametrize("joints", CLASSES.values(), ids=CLASSES)
@pytest.mark.parametrize("left_out", [0, 1, 2, None])
@given(seed=SEEDS, angle=ANGLES)
@settings(max_examples=15, deadline=None)
def test_two_legs_and_the_roll_give_the_pose(joints, left_out, seed, angle):
    random = np.random.default_rng(seed)
    mechanism, position = random_mechanism(random, joints), random.uniform(-0.3, 0.3, 2)
    leg_angles, lengths = legs_at(mechanism, position, angle)
    if left_out is not None:
        leg_angles[left_out] = np.nan
    (mode,) = solve_planar(mechanism, leg_angles, roll=angle + 2.0 * np.pi)
    assert -np.pi < mode.angle <= np.pi
    assert pose_error(mode, position, angle) < 1e-8
    np.testing.assert_allclose(mode.lengths, lengths, atol=1e-8)
    assert mode.within_stroke and not mode.double_root
    # The paper's way: two legs cross at the position, seen from their joints.
    first, second = [k for k in range(3) if k != left_out][:2]
    assert np.abs(crossing(mechanism, leg_angles, angle, first, second) - mode.position).max() < 1e-8


@pytest.mark.parametrize("seed", range(5))
def test_three_legs_and_the_roll_give_the_position_of_least_squares(seed):
    mechanism, position, angle, leg_angles = random_case(seed)
    leg_angles = leg_angles + np.random.default_rng(seed).normal(0.0, 0.02, 3)
    (mode,) = solve_planar(mechanism, leg_angles, roll=angle)
    closest = least_squares(lambda p: misses(mechanism, leg_angles, p, angle), position, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert closest.cost > 1e-10
    np.testing.assert_allclose(mode.position, closest.x, atol=1e-9)


# --------------------------------------------------------------------------------------------------------- covariance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("roll_sigma", "left_out"),
    [(None, None), (0.02 * DEGREE, None), (0.5 * DEGREE, None), (0.02 * DEGREE, 1), (0.5 * DEGREE, 1)],
)
def test_the_covariance_is_that_of_noisy_measurements(roll_sigma, left_out):
    random = np.random.default_rng(5)
    mechanism, position, angle, leg_angles = random_case(2)
    if left_out is not None:
        leg_angles[left_out] = np.nan
    angle_sigma = 0.02 * DEGREE

    def solve(noise, turn):
        roll = {} if roll_sigma is None else {"roll": angle + turn, "roll_sigma": roll_sigma}
        modes = solve_planar(mechanism, leg_angles + noise, angle_sigma=angle_sigma, **roll)
        return min(modes, key=lambda mode: pose_error(mode, position, angle))

    exact = solve(np.zeros(3), 0.0)
    poses = [
        [*(mode.position - position), np.angle(np.exp(1j * (mode.angle - angle)))]
        for mode in (solve(random.normal(0.0, angle_sigma, 3), random.normal(0.0, roll_sigma or 0.0)) for _ in range(1500))
    ]
    scale = np.sqrt(np.diag(exact.covariance))
    normalised = np.cov(np.array(poses).T) / np.outer(scale, scale)
    np.testing.assert_allclose(normalised, exact.covariance / np.outer(scale, scale), atol=0.12)
    assert np.abs(np.mean(poses, axis=0) / scale).max() < 0.12


# ---------------------------------------------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"leg_angles": [1.0, 2.0]}, "leg_angles must have shape (3,), got (2,)"),
        ({"leg_angles": [1.0, np.inf, 2.0]}, "leg_angles[1] is inf; it must be finite"),
        ({"leg_angles": "up"}, "leg_angles must be an array of numbers"),
        ({"roll": np.nan}, "roll is nan; it must be finite"),
        ({"roll": [0.1]}, "roll must have shape (), got (1,)"),
        ({"angle_sigma": 0.0}, "angle_sigma is 0.0; it must be positive and finite [rad]"),
        ({"roll_sigma": -1.0}, "roll_sigma is -1.0; it must be positive and finite [rad]"),
        ({"roll_sigma": np.inf}, "roll_sigma is inf; it must be finite"),
    ],
)
def test_bad_input_is_refused(arguments, said):
    with pytest.raises(InputError, match=re.escape(said)):
        solve_planar(RIG, **{"leg_angles": [1.2, 1.4, 1.9], **arguments})


@pytest.mark.parametrize(
    ("leg_angles", "roll", "said"),
    [
        ([0.5, 0.5, 0.5], None, "legs at 28.65, 28.65, 28.65 deg leave the angle of 'mine' open: they are parallel or"),
        ([0.5, 0.5 - np.pi, 0.5 + np.pi], None, "parallel or close at any angle"),
        ([0.5, 0.5 + 1e-7, 0.5 - 1e-7], None, "at least 1e-06): measure the roll, or move away"),
        ([0.5, 0.5, 0.5], 0.1, "legs at 28.65, 28.65, 28.65 deg do not give the position of 'mine', which takes two that"),
        ([np.nan, 0.5, 0.5 + np.pi], 0.1, "legs at nan, 28.65, 208.6 deg do not give the position"),
        ([np.nan, 0.5, np.nan], 0.1, "(conditioning 0, at least 1e-06): measure another leg"),
        ([np.nan, np.nan, np.nan], 0.1, "measure another leg"),
        (
            [0.5, np.nan, 1.5],
            None,
            "2 leg angles do not give the pose of 'mine', which takes 3: measure every leg, or the roll",
        ),
        ([np.nan, np.nan, np.nan], None, "0 leg angles do not give the pose"),
    ],
)
def test_angles_that_do_not_determine_the_pose_are_refused(leg_angles, roll, said):
    with pytest.raises(SingularConfigurationError, match=re.escape(said)):
        solve_planar(RIG, leg_angles, roll=roll)


def test_legs_that_close_at_any_angle_of_the_platform_are_refused():
    leg_angles = np.array([0.3, 1.1, 2.5])
    # Sides across the legs that close a triangle, and a platform that is its mirror image.
    sides = np.sin(leg_angles[[2, 0, 1]] - leg_angles[[1, 2, 0]]) * np.exp(-1j * leg_angles)
    platform = np.array([0.0, 1.0, -sides[1] / sides[2]])
    joints = platform * np.exp(0.4j) + (0.2 + 0.9j)
    base = joints - np.exp(1j * leg_angles)
    mechanism = PlanarMechanism.from_legs(*(np.column_stack([row.real, row.imag]) for row in (base, platform)))
    for turn in (0.4, 1.0, -2.0):
        position = crossing(mechanism, leg_angles, turn, 0, 1)
        assert np.abs(misses(mechanism, leg_angles, position, turn)).max() < 1e-12
    with pytest.raises(SingularConfigurationError, match="close at any angle"):
        solve_planar(mechanism, leg_angles)
    (mode,) = solve_planar(mechanism, leg_angles, roll=0.4)
    assert pose_error(mode, [0.2, 0.9], 0.4) < 1e-12


def test_three_legs_that_meet_in_one_point_determine_the_pose():
    platform = np.array([[0.0, 0.0], [0.1, 0.0], [0.05, 0.08]])
    meeting, position, angle = np.array([0.1, 0.7]), np.array([0.0, 0.3]), 0.2
    joints = np.array([position + turned(a, angle) for a in platform])
    mechanism = PlanarMechanism.from_legs(meeting + (joints - meeting) * [[1.5], [2.0], [1.8]], platform)
    first, second = solve_planar(mechanism, legs_at(mechanism, position, angle)[0])
    assert pose_error(first, position, angle) < 1e-12
    assert first.conditioning > 0.05
    # The other mode is the mirror image in the meeting point.
    assert separation(second.angle, angle + np.pi) < 1e-12
    np.testing.assert_allclose(second.position, 2.0 * meeting - position, atol=1e-12)


@pytest.mark.parametrize("between", [0.1, 0.7, 1.5, -0.4])
def test_the_conditioning_of_two_legs_with_the_roll_is_the_tangent_of_half_their_angle(between):
    (mode,) = solve_planar(RIG, [0.4, 0.4 + between, np.nan], roll=0.2)
    assert mode.conditioning == pytest.approx(abs(np.tan(0.5 * between)), rel=1e-12)


@pytest.mark.parametrize(
    ("given_", "expected"), [(np.pi, np.pi), (-np.pi, np.pi), (3.0 * np.pi, np.pi), (-4.0, 2.0 * np.pi - 4.0)]
)
def test_an_angle_is_told_above_minus_and_up_to_plus_half_a_turn(given_, expected):
    (mode,) = solve_planar(RIG, [1.2, 1.4, np.nan], roll=given_)
    assert mode.angle == pytest.approx(expected, abs=1e-14) and mode.angle > 0.0
