"""Calibration at rest: the errors of IMUs that rest at unknown poses, against the errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest

from controller.calibration.at_rest import (
    MeasuredLengths,
    Prior,
    Rests,
    _Problem,
    calibrate_at_rest,
    errors_of_base_imu,
    expected_forces,
    fit_pose,
    pose_covariance,
    undo,
    undo_one,
)
from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.imu_errors import ALIGNMENT, ERROR_NAMES, ERRORS, error_matrix
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.rig import sensor_geometry
from plant.errors import CalibrationError
from plant.imu import load_imu
from plant.mechanism import Mechanism, load_spatial
from tests.controller.calibration.rest_readings import pose_errors, rests_of
from tests.controller.leg_geometry import rotation_of, static_signals


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_rests_at_unknown_poses_bring_the_error_down(hexapod, seed):
    readings, _, _ = rests_of(hexapod, 20, seed)
    others = rests_of(hexapod, 10, seed, poses=sample_workspace(hexapod, 10, seed=999))
    found = calibrate_at_rest(hexapod, Rests(readings))
    before = pose_errors(hexapod, Calibration(), np.zeros(2), *others)
    after = pose_errors(hexapod, found.calibration(), found.tilt, *others)
    assert before[0] > 5.0
    assert after[0] < before[0] / 4.0
    assert after[0] < 2.0
    assert after[1] < 0.3


@pytest.mark.slow
def test_a_known_home_and_measured_lengths_help(hexapod):
    poses = sample_workspace(hexapod, 20, seed=7)
    poses[0][0], poses[1][0] = hexapod.home.position, hexapod.home.rotation
    readings, positions, rotations = rests_of(hexapod, 20, 4, poses=poses)
    lengths = leg_lengths(hexapod, positions, rotations)
    others = rests_of(hexapod, 10, 4, poses=sample_workspace(hexapod, 10, seed=999))
    errors = []
    for rests in (Rests(readings), Rests(readings, home=True, lengths=measured(lengths, 5e-5))):
        found = calibrate_at_rest(hexapod, rests)
        errors.append(pose_errors(hexapod, found.calibration(), found.tilt, *others)[0])
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.5


@pytest.mark.slow
def test_a_tilted_base_is_found_if_it_is_looked_for(hexapod):
    tilt = np.radians([0.6, -0.4])
    up = rotation_of([*tilt, 0.0])[:, 2]
    tilted = Mechanism.from_legs(
        hexapod.base_joints,
        hexapod.platform_joints,
        base_joint_axes=hexapod.base_joint_axes,
        up_in_base=up,
        home=hexapod.home,
        limits={"stroke": hexapod.limits.stroke},
        plant={**hexapod.plant, "gravity": -9.81 * up},
    )
    poses = sample_workspace(hexapod, 20, seed=7)
    readings, _, _ = rests_of(tilted, 20, 5, load_imu("mpu9150-calibrated"), poses)
    known = replace(Prior(tilt=np.radians(1.0)), accelerometer_bias=0.01, accelerometer_scale=1e-3, alignment=1e-4, axes=1e-4)
    found = calibrate_at_rest(hexapod, Rests(readings), known)
    np.testing.assert_allclose(np.degrees(found.tilt), np.degrees(tilt), atol=0.1)


@pytest.mark.slow
def test_legs_that_share_a_joint_keep_sharing_it():
    shared = load_spatial("6-3-I")
    found = calibrate_at_rest(shared, Rests(rests_of(shared.built(1e-4, 0), 8, 0)[0]), Prior(joints=1e-4))
    moved = shared.moved_joints(found.joints)
    np.testing.assert_array_equal(moved.distinct_joints(), shared.distinct_joints())
    assert np.abs(found.joints).max() > 1e-6


def test_errors_are_undone_by_their_calibration():
    random = np.random.default_rng(0)
    errors, ideal = random.normal(0.0, 0.02, (7, ERRORS)), random.normal(0.0, 3.0, (2, 7, 3))
    raw = np.zeros((3, 7, 3))
    for k in range(7):
        for sensor in range(2):
            raw[sensor, k] = error_matrix(errors[k], sensor) @ ideal[sensor, k] + errors[k, 3 * sensor : 3 * sensor + 3]
    np.testing.assert_allclose(Calibration(*undo(errors)).apply(raw)[:2], ideal, atol=1e-12)


def test_a_pose_at_rest_is_found_from_forces_alone(hexapod):
    geometry = sensor_geometry(hexapod)
    for position, rotation in zip(*sample_workspace(hexapod, 50, seed=3), strict=True):
        found = fit_pose(geometry, expected_forces(geometry, position, rotation), hexapod.home)
        np.testing.assert_allclose(found[0], position, atol=1e-9)
        np.testing.assert_allclose(found[1], rotation, atol=1e-9)


def test_too_few_rests_are_refused(hexapod):
    readings, _, _ = rests_of(hexapod, 4, 0)
    with pytest.raises(CalibrationError, match="4 poses at rest do not determine the IMUs' errors; at least 5 do, 20 are good"):
        calibrate_at_rest(hexapod, Rests(readings))


def test_the_mounting_of_the_magnetometers_is_undone_as_that_of_the_accelerometers():
    errors = np.zeros((7, ERRORS))
    errors[:, ALIGNMENT : ALIGNMENT + 3] = np.random.default_rng(1).normal(0.0, 0.01, (7, 3))
    gain, offset = undo(errors)
    for k in range(7):
        np.testing.assert_allclose(gain[2, k], rotation_of(errors[k, ALIGNMENT : ALIGNMENT + 3]), rtol=0.0, atol=1e-15)
        np.testing.assert_allclose(gain[2, k], gain[1, k], rtol=0.0, atol=1e-5)
    assert not offset[2].any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_an_imu_on_the_base_errs_less_on_a_tilted_base_once_its_share_of_each_error_is_known(hexapod, seed):
    random, prior = np.random.default_rng(seed), Prior(accelerometer_bias=0.1, alignment=np.radians(1.0))
    level = -hexapod.plant["gravity"]
    # The base leans by 20 deg in a direction that no rest has shown.
    leaning = rotation_of(np.radians([14.0, -14.0, 0.0])) @ level
    left = {"shares": [], "bias alone": []}
    for _ in range(200):
        errors = prior.of_an_imu() * random.normal(size=ERRORS)
        raw = [error_matrix(errors, 1) @ force + errors[3:6] for force in (level, leaning)]
        reading = np.concatenate([errors[:3], raw[0]])
        gain, offset = undo_one(errors_of_base_imu(hexapod, np.zeros(2), reading, prior))
        np.testing.assert_allclose(gain[0] @ reading[:3] + offset[0], 0.0, atol=1e-3)
        np.testing.assert_allclose(gain[1] @ raw[0] + offset[1], level, atol=1e-3)
        left["shares"].append(gain[1] @ raw[1] + offset[1] - leaning)
        left["bias alone"].append(raw[1] - raw[0] + level - leaning)
    shares, bias_alone = (np.sqrt(np.mean(np.square(each))) for each in left.values())
    assert shares < 0.97 * bias_alone


def test_the_prior_is_in_the_order_of_the_errors():
    prior = Prior(
        gyroscope_bias=1.0, accelerometer_bias=2.0, accelerometer_scale=3.0, gyroscope_scale=4.0, alignment=5.0, axes=6.0,
        tilt=7.0, joints=8.0,
    )  # fmt: skip
    of_names = {
        "gyroscope bias": 1.0, "accelerometer bias": 2.0, "accelerometer scale": 3.0, "gyroscope scale": 4.0, "alignment": 5.0,
        "accelerometer axes": 6.0, "gyroscope axes": 6.0,
    }  # fmt: skip
    expected = [of_names[name] for _ in range(7) for name in ERROR_NAMES for _ in range(3)]
    assert prior.error_sigmas().tolist() == expected
    assert prior.sigmas().tolist() == expected + [8.0] * 36 + [7.0] * 2
    # Joints that count as exact still have a variance.
    assert (Prior().sigmas()[147:183] == 1e-8).all()


def exact_rests(mechanism, errors, poses):
    """Readings (N, 7, 6) at rest, without noise, of IMUs with these errors (7, 21)."""
    readings = np.zeros((len(poses[0]), 7, 6))
    for n, (position, rotation) in enumerate(zip(*poses, strict=True)):
        ideal = static_signals(mechanism, position, rotation)
        for k, sensor in np.ndindex(7, 2):
            part = slice(3 * sensor, 3 * sensor + 3)
            readings[n, k, part] = error_matrix(errors[k], sensor) @ ideal[sensor, k] + errors[k, part]
    return readings


@pytest.fixture(scope="module")
def skewed(hexapod):
    """Rests of IMUs with errors that let the poses seem centimetres off; the first at home."""
    poses = sample_workspace(hexapod, 8, seed=11)
    poses[0][0], poses[1][0] = hexapod.home.position, hexapod.home.rotation
    errors = np.random.default_rng(5).normal(size=(7, ERRORS)) * np.repeat([0.1, 0.2, 0.01, 0.01, 0.01, 0.005, 0.005], 3)
    return exact_rests(hexapod, errors, poses), poses, errors


def measured(lengths, sigma, zero=0.05):
    """Lengths (N, 6) [m] of one run, by encoders with this noise and these zeros [m]."""
    return MeasuredLengths(lengths, zero**2 + sigma**2 * np.eye(len(lengths)))


def test_a_known_home_and_known_length_changes_bind_the_poses_and_the_joints_stay_in_their_prior(hexapod, skewed):
    readings, (positions, rotations), _ = skewed
    changes = leg_lengths(hexapod, positions, rotations)
    # What the encoders' zeros are does not matter.
    lengths = measured(changes + np.random.default_rng(6).normal(0.0, 0.02, 6), 5e-5)
    changes -= changes[0]
    free = calibrate_at_rest(hexapod, Rests(readings))
    bound = calibrate_at_rest(hexapod, Rests(readings, home=True, lengths=lengths), Prior(joints=1e-4))
    assert np.linalg.norm(free.positions - positions, axis=1).max() > 3e-4
    np.testing.assert_allclose(bound.positions[0], hexapod.home.position, rtol=0.0, atol=2e-5)
    np.testing.assert_allclose(bound.rotations[0], hexapod.home.rotation, rtol=0.0, atol=1e-4)
    found = leg_lengths(hexapod.moved_joints(bound.joints), bound.positions, bound.rotations)
    np.testing.assert_allclose(found - found[0], changes, rtol=0.0, atol=3e-5)
    np.testing.assert_allclose(bound.positions, positions, rtol=0.0, atol=1e-4)
    assert 0.0 < np.abs(bound.joints).max() < 3e-4 and not np.allclose(bound.joints, 0.0, atol=1e-9)
    assert np.abs(free.joints).max() < 1e-9


def test_lengths_with_known_zeros_tell_the_poses_themselves(hexapod, skewed):
    readings, poses, _ = skewed
    found = calibrate_at_rest(hexapod, Rests(readings, lengths=measured(leg_lengths(hexapod, *poses), 2e-6, zero=5e-6)))
    np.testing.assert_allclose(found.positions, poses[0], rtol=0.0, atol=1e-6)


@pytest.mark.slow
def test_a_zero_that_changes_between_two_runs_does_not_matter_if_that_is_known(hexapod, skewed):
    readings, poses, _ = skewed
    lengths, runs = leg_lengths(hexapod, *poses), np.arange(8) // 4
    lengths[4:] += 0.01
    errors = []
    for of_zeros in (runs[:, None] == runs, np.ones((8, 8))):
        known = MeasuredLengths(lengths, 0.05**2 * of_zeros + 1e-5**2 * np.eye(8))
        found = calibrate_at_rest(hexapod, Rests(readings, lengths=known))
        errors.append(np.linalg.norm(found.positions - poses[0], axis=1).max())
    assert errors[0] < 1e-4 < 2e-3 < errors[1]


@pytest.mark.parametrize("seed", range(2))
def test_the_derivatives_of_the_residuals_are_their_differences(hexapod, skewed, seed):
    """At random unknowns, with home, lengths and joints."""
    random = np.random.default_rng(seed)
    lengths = measured(leg_lengths(hexapod, *skewed[1]), 5e-5)
    problem = _Problem(hexapod, Rests(skewed[0], home=True, lengths=lengths), Prior(joints=1e-4))
    x = problem.start.copy()
    x[: 6 * 8] = random.normal(0.0, 1e-3, 6 * 8)
    x[6 * 8 :] += 0.1 * random.normal(size=len(x) - 6 * 8) * problem._sigmas
    direction = random.normal(size=len(x)) * np.concatenate([np.full(6 * 8, 1e-5), 1e-3 * problem._sigmas])
    change = (problem.residuals(x + direction) - problem.residuals(x - direction)) / 2.0
    expected = problem.jacobian(x) @ direction
    of_lengths = slice(8 * 42 + 6, 8 * 42 + 6 + 48)
    assert np.linalg.norm(change[of_lengths]) > 0.01
    np.testing.assert_allclose(change[of_lengths], expected[of_lengths], rtol=0.0, atol=1e-4 * np.abs(expected).max())


def test_the_result_explains_the_readings_and_its_residuals_are_read_minus_expected(hexapod, skewed):
    readings, _, errors = skewed
    found = calibrate_at_rest(hexapod, Rests(readings))
    moved = hexapod.moved_joints(found.joints)
    up = rotation_of([*found.tilt, 0.0]) @ hexapod.up_in_base
    tilted = Mechanism.from_legs(
        moved.base_joints, moved.platform_joints, base_joint_axes=hexapod.base_joint_axes, up_in_base=up, home=hexapod.home,
        plant={**hexapod.plant, "gravity": -np.linalg.norm(hexapod.plant["gravity"]) * up},
    )  # fmt: skip
    expected = exact_rests(tilted, found.errors, (found.positions, found.rotations))
    np.testing.assert_allclose(found.residuals, readings - expected, rtol=0.0, atol=1e-6)
    # The rate of the prior's reading errors, of which most are explained.
    assert np.sqrt(np.mean(found.residuals[:, :, :3] ** 2)) < np.radians(0.02)
    assert np.sqrt(np.mean(found.residuals[:, :, 3:] ** 2)) < 2e-3
    np.testing.assert_allclose(found.errors[:, :3], errors[:, :3], rtol=0.0, atol=1e-3)
    of_errors = found.calibration()
    assert of_errors.covariance.shape == (147, 147)
    np.testing.assert_array_equal(of_errors.tilt, found.tilt)
    np.testing.assert_array_equal(of_errors.joints, found.joints)
    # A gyroscope's bias is as uncertain as a mean reading over eight rests; a scale that no rest tells is as before.
    sigmas = np.sqrt(np.diag(found.covariance))[:147].reshape(7, 7, 3)
    np.testing.assert_allclose(sigmas[:, 0], np.radians(0.02) / np.sqrt(8.0), rtol=0.01)
    np.testing.assert_allclose(sigmas[:, 3], 0.03, rtol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_the_covariance_of_a_pose_is_that_of_what_errors_do_to_it(hexapod, seed):
    """One direction of errors of IMUs, joints and tilt at once, small enough to act linearly, through the fitted pose."""
    random, tilt = np.random.default_rng(seed), np.array([0.01, -0.02])
    position, rotation = (each[seed] for each in sample_workspace(hexapod, 3, seed=21))
    off = random.normal(size=185) * np.concatenate([np.full(147, 1e-5), np.full(36, 1e-6), np.full(2, 1e-5)])
    imus, joints, lean = off[:147].reshape(7, ERRORS), off[147:183].reshape(2, 6, 3), off[183:]
    poses = []
    for sign in (1.0, -1.0):
        true = sensor_geometry(hexapod.moved_joints(sign * joints), tilt + sign * lean)
        forces = expected_forces(true, position, rotation)
        read = [error_matrix(sign * e, 1) @ force + sign * e[3:6] for e, force in zip(imus, forces, strict=True)]
        poses.append(fit_pose(sensor_geometry(hexapod, tilt), np.array(read), hexapod.home))
    (ahead, turned_ahead), (behind, turned_behind) = poses
    turn = 0.5 * (turned_ahead @ turned_behind.T - turned_behind @ turned_ahead.T)
    moved = 0.5 * np.array([*(ahead - behind), turn[2, 1], turn[0, 2], turn[1, 0]])
    found = pose_covariance(hexapod, tilt, (position, rotation), np.outer(off, off))
    scale = np.repeat([np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])], 3)
    np.testing.assert_allclose(found / np.outer(scale, scale), np.outer(moved, moved) / np.outer(scale, scale), atol=2e-3)
