"""Watching over direct kinematics: faults are detected and named, and lengths agree or not."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from controller.direct_kinematics import cross_check, integrity, solve
from controller.direct_kinematics.consistency import chi_square_quantile
from controller.inverse_kinematics import sample_workspace
from plant.errors import InputError, SingularConfigurationError
from tests.controller.leg_geometry import UP, leg_directions, leg_vectors, rotation_of, unit

DEGREE = np.pi / 180.0
SIGMA = 0.05 * DEGREE


@pytest.fixture(scope="module")
def poses(hexapod):
    return list(zip(*sample_workspace(hexapod, 1000, 5), strict=True))


def noisy(random, vectors):
    return unit(vectors + SIGMA * random.normal(size=np.shape(vectors)))


def turned(random, vector, angle):
    axis = unit(np.cross(vector, random.normal(size=3)))
    return rotation_of(angle * axis) @ vector


def measured(random, mechanism, pose):
    position, rotation = pose
    return noisy(random, leg_directions(mechanism, position, rotation)), noisy(random, mechanism.up_in_base @ rotation)


def without(directions, leg):
    return np.where(np.arange(6)[:, None] == leg, np.nan, directions)


# ---------------------------------------------------------------------------------------------------------- the threshold


@pytest.mark.parametrize("degrees", range(1, 16))
@pytest.mark.parametrize("rate", [0.999, 0.5, 1e-2, 1e-4, 1e-9])
def test_the_quantile_is_that_of_scipy(degrees, rate):
    assert chi_square_quantile(degrees, rate) == pytest.approx(chi2.isf(rate, degrees), rel=1e-9)


@pytest.mark.parametrize("rate", [0.0, 1.0, -0.1, 2.0, np.nan])
def test_a_false_alarm_rate_out_of_range_is_refused(hexapod, rate):
    directions = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    solution = solve(hexapod, directions)
    with pytest.raises(InputError, match=r"false-alarm rate is .* must lie between 0 and 1"):
        integrity(hexapod, directions, false_alarm_rate=rate)
    with pytest.raises(InputError, match=r"false-alarm rate is .* must lie between 0 and 1"):
        cross_check(hexapod, solution, np.ones(6), false_alarm_rate=rate)


@pytest.mark.parametrize("known", ["legs", "up"])
def test_sound_measurements_raise_as_many_alarms_as_are_asked_for(hexapod, poses, known):
    random = np.random.default_rng(1)
    alarms = 0
    for pose in poses:
        directions, up = measured(random, hexapod, pose)
        given = {"up_in_platform": up} if known == "up" else {}
        found = integrity(hexapod, directions, false_alarm_rate=0.05, **given)
        assert found.degrees_of_freedom == (8 if known == "up" else 6)
        assert found.threshold == pytest.approx(chi2.isf(0.05, found.degrees_of_freedom))
        assert found.detected == (found.chi_square > found.threshold)
        if not found.detected:
            assert found.faulty is None
            assert found.solution.chi_square == found.chi_square == solve(hexapod, directions, **given).chi_square
        alarms += found.detected
    assert binom.ppf(1e-4, 1000, 0.05) <= alarms <= binom.ppf(1.0 - 1e-4, 1000, 0.05)


# ------------------------------------------------------------------------------------------------------------ faulty IMUs


def test_a_leg_off_by_a_degree_is_named_and_the_pose_is_that_of_the_others(hexapod, poses):
    random = np.random.default_rng(2)
    named, errors, errors_without = 0, [], []
    for pose in poses:
        directions, up = measured(random, hexapod, pose)
        leg = random.integers(6)
        directions[leg] = turned(random, directions[leg], 1.0 * DEGREE)
        found = integrity(hexapod, directions, up_in_platform=up)
        assert found.threshold == pytest.approx(chi2.isf(1e-4, 8))
        others = solve(hexapod, without(directions, leg), up_in_platform=up)
        assert found.chi_squares[leg] == others.chi_square
        if found.detected and found.faulty == leg:
            named += 1
            np.testing.assert_array_equal(found.solution.position, others.position)
            np.testing.assert_array_equal(found.solution.rotation, others.rotation)
        errors.append(found.solution.position - pose[0])
        errors_without.append(others.position - pose[0])
    assert named >= 990
    assert np.sqrt(np.mean(np.square(errors))) < 1.02 * np.sqrt(np.mean(np.square(errors_without)))


def test_the_platforms_imu_is_named_as_the_seventh(hexapod, poses):
    random = np.random.default_rng(3)
    for pose in poses[:200]:
        directions, up = measured(random, hexapod, pose)
        found = integrity(hexapod, directions, up_in_platform=turned(random, up, 2.0 * DEGREE))
        assert found.detected
        assert found.faulty == 6
        assert found.solution.method == "legs"
        assert found.solution.chi_square == found.chi_squares[6] == solve(hexapod, directions).chi_square


def test_two_faults_at_once_are_detected_and_neither_is_named(hexapod, poses):
    random = np.random.default_rng(4)
    unnamed = 0
    for pose in poses[:200]:
        directions, up = measured(random, hexapod, pose)
        for leg in random.choice(6, 2, replace=False):
            directions[leg] = turned(random, directions[leg], 3.0 * DEGREE)
        found = integrity(hexapod, directions, up_in_platform=up)
        assert found.detected
        assert found.solution is not None
        unnamed += found.faulty is None
    assert unnamed > 190


def test_a_direction_that_no_pose_fits_is_named_all_the_same(hexapod):
    """Turned by half, a leg contradicts the others so far that with it there is no pose."""
    position = hexapod.home.position
    directions = leg_directions(hexapod, position, np.eye(3))
    for leg in range(6):
        broken = np.where(np.arange(6)[:, None] == leg, -directions, directions)
        found = integrity(hexapod, broken, up_in_platform=UP)
        assert found.faulty == leg
        np.testing.assert_allclose(found.solution.position, position, rtol=0.0, atol=1e-9)


def test_legs_that_are_not_measured_are_neither_tried_nor_named(hexapod, poses):
    random = np.random.default_rng(5)
    for pose in poses[:50]:
        directions, up = measured(random, hexapod, pose)
        directions[2] = np.nan
        found = integrity(hexapod, directions, up_in_platform=up)
        assert np.isnan(found.chi_squares[2])
        assert np.isfinite(np.delete(found.chi_squares, 2)).all()
        assert found.degrees_of_freedom == 6


def test_the_threshold_is_relative_to_the_sigmas(hexapod, poses):
    directions, up = measured(np.random.default_rng(6), hexapod, poses[0])
    usual = integrity(hexapod, directions, up_in_platform=up)
    strict = integrity(hexapod, directions, up_in_platform=up, leg_sigma=0.1 * SIGMA, tilt_sigma=0.1 * SIGMA)
    assert not usual.detected
    assert strict.detected
    assert strict.chi_square == pytest.approx(100.0 * usual.chi_square, rel=1e-6)


def test_no_more_than_a_pose_needs_cannot_be_checked(hexapod):
    directions = leg_directions(hexapod, hexapod.home.position, np.eye(3))
    three, two = directions.copy(), directions.copy()
    three[3:], two[2:] = np.nan, np.nan
    with pytest.raises(InputError, match=r"3 legs are no more than a pose needs.*measure more"):
        integrity(hexapod, three)
    with pytest.raises(InputError, match="2 legs and up_in_platform are no more than a pose needs"):
        integrity(hexapod, two, up_in_platform=UP)
    with pytest.raises(SingularConfigurationError):
        integrity(hexapod, np.tile(UP, (6, 1)), up_in_platform=UP)


# ---------------------------------------------------------------------------------------------------------------- lengths


def lengths_at(mechanism, pose):
    return np.linalg.norm(leg_vectors(mechanism, *pose), axis=1)


def test_true_lengths_agree_as_often_as_is_asked_for(hexapod, poses):
    random = np.random.default_rng(7)
    inconsistent, squares = 0, 0.0
    for pose in poses:
        directions, up = measured(random, hexapod, pose)
        solution = solve(hexapod, directions, up_in_platform=up)
        lengths = lengths_at(hexapod, pose) + 1e-4 * random.normal(size=6)
        found = cross_check(hexapod, solution, lengths, false_alarm_rate=0.05)
        assert found.consistent == (found.chi_square <= found.threshold)
        np.testing.assert_allclose(
            found.errors, lengths - lengths_at(hexapod, (solution.position, solution.rotation)), rtol=0.0, atol=1e-15
        )
        inconsistent += not found.consistent
        squares += found.chi_square
    assert binom.ppf(1e-4, 1000, 0.05) <= inconsistent <= binom.ppf(1.0 - 1e-4, 1000, 0.05)
    assert chi2.ppf(0.005, 6000) < squares < chi2.ppf(0.995, 6000)


def test_lengths_of_a_true_pose_lead_back_to_it(hexapod, poses):
    random = np.random.default_rng(8)
    for pose in poses[:100]:
        directions, up = measured(random, hexapod, pose)
        found = cross_check(hexapod, solve(hexapod, directions, up_in_platform=up), lengths_at(hexapod, pose))
        np.testing.assert_allclose(found.pose.position, pose[0], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found.pose.rotation, pose[1], rtol=0.0, atol=1e-8)
        assert 0.0 < found.distance < 5e-3
        assert 0.0 < found.angle < 1.0 * DEGREE


def test_an_encoder_that_slipped_is_seen_in_its_leg(hexapod, poses):
    random = np.random.default_rng(9)
    for pose in poses[:100]:
        directions, up = measured(random, hexapod, pose)
        lengths = lengths_at(hexapod, pose)
        leg = random.integers(6)
        lengths[leg] += 0.01
        found = cross_check(hexapod, solve(hexapod, directions, up_in_platform=up), lengths)
        assert not found.consistent
        assert np.argmax(np.abs(found.deviations)) == leg


def test_some_lengths_are_compared_and_give_no_pose(hexapod, poses):
    directions, up = measured(np.random.default_rng(10), hexapod, poses[0])
    lengths = lengths_at(hexapod, poses[0])
    lengths[[1, 4]] = np.nan
    found = cross_check(hexapod, solve(hexapod, directions, up_in_platform=up), lengths)
    assert found.consistent
    assert np.isnan(found.errors[[1, 4]]).all() and np.isfinite(found.errors[[0, 2, 3, 5]]).all()
    assert found.threshold == pytest.approx(chi2.isf(1e-4, 4))
    assert found.pose is None and np.isnan(found.distance) and np.isnan(found.angle)


def test_lengths_that_no_pose_has_are_inconsistent_and_give_none(hexapod):
    home = hexapod.home
    solution = solve(hexapod, leg_directions(hexapod, home.position, home.rotation))
    found = cross_check(hexapod, solution, [0.01, 3.0, 0.01, 3.0, 0.01, 3.0])
    assert not found.consistent
    assert found.pose is None


def test_malformed_lengths_are_refused(hexapod):
    solution = solve(hexapod, leg_directions(hexapod, hexapod.home.position, np.eye(3)))
    with pytest.raises(InputError, match="no length was measured"):
        cross_check(hexapod, solution, np.full(6, np.nan))
    with pytest.raises(InputError, match="lengths must have shape"):
        cross_check(hexapod, solution, np.ones(5))
    for sigma in (0.0, -1.0):
        with pytest.raises(InputError, match=r"length_sigma is .*must be positive"):
            cross_check(hexapod, solution, np.ones(6), length_sigma=sigma)


@pytest.mark.parametrize(
    ("names", "freedom"),
    [((), 6), (("up",), 8), (("normal",), 8), (("rotation",), 9), (("normal", "up"), 10), (("rotation", "normal", "up"), 13)],
)
@pytest.mark.parametrize("missing", [0, 1])
def test_the_degrees_of_freedom_are_two_for_each_leg_and_vector_three_for_a_rotation_less_six(hexapod, names, freedom, missing):
    position, rotation = hexapod.home.position, rotation_of([0.1, -0.05, 0.2])
    known = {"up": rotation.T @ UP, "normal": rotation[:, 2], "rotation": rotation}
    given = {"up_in_platform" if name == "up" else name: known[name] for name in names}
    directions = leg_directions(hexapod, position, rotation)
    directions[:missing] = np.nan
    found = integrity(hexapod, directions, **given)
    assert found.degrees_of_freedom == freedom - 2 * missing == found.solution.degrees_of_freedom
    assert found.threshold == pytest.approx(chi2.isf(1e-4, freedom - 2 * missing))
    assert found.faulty is None and not found.detected
    # The sum without the platform's IMU is there if it has one that is tried.
    assert np.isfinite(found.chi_squares[6]) == bool(names)


def test_with_a_method_of_its_own_the_platforms_imu_is_not_tried(hexapod):
    rotation = rotation_of([0.1, -0.05, 0.2])
    directions = leg_directions(hexapod, hexapod.home.position, rotation)
    found = integrity(hexapod, directions, up_in_platform=turned(np.random.default_rng(0), rotation.T @ UP, 0.1), method="up")
    assert found.detected and np.isnan(found.chi_squares[6]) and found.faulty != 6


@pytest.mark.parametrize("length_sigma", [1e-5, 3e-3])
def test_the_deviations_of_lengths_are_errors_over_what_pose_and_encoder_leave(hexapod, poses, length_sigma):
    random, deviations = np.random.default_rng(11), []
    for pose in poses[:300]:
        directions, up = measured(random, hexapod, pose)
        lengths = lengths_at(hexapod, pose) + length_sigma * random.normal(size=6)
        found = cross_check(hexapod, solve(hexapod, directions, up_in_platform=up), lengths, length_sigma=length_sigma)
        assert (np.sign(found.deviations) == np.sign(found.errors)).all()
        deviations.append(found.deviations)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(deviations))), 1.0, atol=0.06)
