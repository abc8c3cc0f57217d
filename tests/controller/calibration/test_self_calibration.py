"""Self-calibration: the errors of IMUs that rest at unknown poses and move, against the errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest

from controller.calibration.at_rest import (
    CalibrationError,
    Prior,
    Rests,
    calibrate_at_rest,
    calibrate_in_motion,
    expected_forces,
    fit_pose,
    pose_covariance,
    undo,
)
from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.imu_errors import ERRORS, error_matrix
from controller.estimation.whole_mechanism.rig_jacobian import JOINTS
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.rig import sensor_geometry
from controller.settings import sensor_settings
from plant.dynamics.imposed import impose
from plant.imu import imu_state, load_imu, measure
from plant.mechanism import Mechanism, load_spatial
from plant.pose import Pose, rotation_angle, vector_from_rotation
from tests.controller.leg_geometry import rotation_of, static_signals

RAW = load_imu("mpu9150")


def read(imu, signals, count):
    """Mean of `count` readings (3, 7, 3) of signals that stay."""
    raw, total = np.zeros((3, 7, 3)), np.zeros((3, 7, 3))
    for _ in range(count):
        measure(imu, signals, raw)
        total += raw
    return total / count


def rests_of(mechanism, count, seed, model=RAW, poses=None):
    """Readings (count, 7, 6) at random poses, and these."""
    positions, rotations = sample_workspace(mechanism, count, seed=seed + 50) if poses is None else poses
    imu = imu_state(model, seed, 1e-3)
    readings = []
    for position, rotation in zip(positions, rotations, strict=True):
        read(imu, static_signals(mechanism, position, rotation), 20)
        mean = read(imu, static_signals(mechanism, position, rotation), 500)
        readings.append(np.concatenate([mean[0], mean[1]], axis=1))
    return np.array(readings), positions, rotations


def pose_errors(mechanism, calibration, tilt, readings, positions, rotations):
    """RMS error [mm, deg] of the poses that calibrated forces at rest give."""
    raw = np.zeros((len(readings), 3, 7, 3))
    raw[:, 1] = readings[:, :, 3:]
    forces = calibration.apply(raw)[:, 1]
    found = [fit_pose(sensor_geometry(mechanism, tilt), each, mechanism.home) for each in forces]
    distances = np.linalg.norm([position for position, _ in found] - positions, axis=1)
    angles = rotation_angle(np.array([rotation for _, rotation in found]), rotations)
    return 1e3 * np.sqrt(np.mean(distances**2)), np.degrees(np.sqrt(np.mean(angles**2)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
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
def test_a_known_home_and_measured_length_changes_help(hexapod):
    poses = sample_workspace(hexapod, 20, seed=7)
    poses[0][0], poses[1][0] = hexapod.home.position, hexapod.home.rotation
    readings, positions, rotations = rests_of(hexapod, 20, 4, poses=poses)
    lengths = leg_lengths(hexapod, positions, rotations)
    others = rests_of(hexapod, 10, 4, poses=sample_workspace(hexapod, 10, seed=999))
    errors = []
    for rests in (Rests(readings), Rests(readings, home=True, length_changes=lengths - lengths[0])):
        found = calibrate_at_rest(hexapod, rests)
        errors.append(pose_errors(hexapod, found.calibration(), found.tilt, *others)[0])
    assert errors[1] < 0.7 * errors[0]
    assert errors[1] < 0.5


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


def test_motion_brings_it_to_a_tenth_of_a_millimetre(hexapod):
    fusion = sensor_settings(hexapod, RAW)
    readings, _, _ = rests_of(hexapod, 20, 1)
    found = calibrate_at_rest(hexapod, Rests(readings))
    motion = impose(hexapod, "0.8", 20.0, 1000.0, 3, size=(0.02, np.radians(6.0)))
    imu, samples = imu_state(RAW, 1, 1e-3), np.zeros_like(motion.signals)
    for signals, sample in zip(motion.signals, samples, strict=True):
        measure(imu, signals, sample)
    turn = (motion.rotations[1] @ motion.rotations[0].T - np.eye(3)) * 1000.0
    velocity = (motion.positions[1] - motion.positions[0]) * 1000.0
    start = Pose(motion.positions[0], motion.rotations[0]), np.array([*velocity, turn[2, 1], turn[0, 2], turn[1, 0]])
    calibration, covariance = calibrate_in_motion(hexapod, found, samples, 1000.0, start, fusion)
    others = rests_of(hexapod, 10, 1, poses=sample_workspace(hexapod, 10, seed=999))
    true = pose_errors(hexapod, calibration, calibration.tilt, *others)
    assert true[0] < 0.5
    assert true[0] < pose_errors(hexapod, found.calibration(), found.tilt, *others)[0]
    predicted = [pose_covariance(hexapod, calibration.tilt, pose, covariance) for pose in zip(*others[1:], strict=True)]
    assert 0.4 < true[0] / (1e3 * np.sqrt(np.trace(np.mean(predicted, axis=0)[:3, :3]))) < 2.5
    # The gyroscopes' scales, which no rest tells; a leg hardly turns about itself.
    error = np.abs(calibration.gain[0] - np.linalg.inv(imu["gain"][0]))
    assert error[:6, :, :2].max() < 2e-3
    assert error[6].max() < 2e-3


@pytest.mark.slow
def test_joints_that_are_off_are_sought_with_the_rest(hexapod):
    built, fusion = hexapod.built(2e-4, 3), sensor_settings(hexapod, RAW)
    readings, _, _ = rests_of(built, 20, 1)
    motion = impose(built, "0.8", 20.0, 1000.0, 3, size=(0.02, np.radians(6.0)))
    imu, samples = imu_state(RAW, 1, 1e-3), np.zeros_like(motion.signals)
    for signals, sample in zip(motion.signals, samples, strict=True):
        measure(imu, signals, sample)
    velocity = [
        *(motion.positions[1] - motion.positions[0]),
        *vector_from_rotation(motion.rotations[1] @ motion.rotations[0].T),
    ]
    start = Pose(motion.positions[0], motion.rotations[0]), 1000.0 * np.array(velocity)
    others, surprise = rests_of(built, 10, 1, poses=sample_workspace(built, 10, seed=999)), []
    true = np.stack([built.base_joints - hexapod.base_joints, built.platform_joints - hexapod.platform_joints])

    def predicted(mechanism, tilt, covariance):
        poses = zip(*others[1:], strict=True)
        return np.mean([pose_covariance(mechanism, tilt, pose, covariance) for pose in poses], axis=0).diagonal()

    for joints in (0.0, 2e-4):
        found = calibrate_at_rest(hexapod, Rests(readings), Prior(joints=joints))
        calibration, covariance = calibrate_in_motion(hexapod, found, samples, 1000.0, start, fusion)
        known = hexapod.moved_joints(calibration.joints)
        error = 1e-3 * pose_errors(known, calibration, calibration.tilt, *others)[0]
        surprise.append(error / np.sqrt(predicted(known, calibration.tilt, covariance)[:3].sum()))
    assert np.linalg.norm(calibration.joints - true) < 0.9 * np.linalg.norm(true)
    assert surprise[1] < min(2.0, 0.9 * surprise[0])
    off, of_joints = (
        (calibration.joints - true).ravel(),
        covariance[7 * ERRORS : 7 * ERRORS + JOINTS, 7 * ERRORS : 7 * ERRORS + JOINTS],
    )
    assert 0.3 < off @ np.linalg.solve(of_joints, off) / JOINTS < 1.6
    # What the rig leaves is told apart from what the IMUs leave: together they are what there was.
    of_imus = np.zeros_like(covariance)
    of_imus[: 7 * ERRORS, : 7 * ERRORS] = calibration.covariance
    apart = predicted(known, calibration.tilt, of_imus).reshape(2, 3).sum(axis=1) + calibration.floor**2
    np.testing.assert_allclose(apart, predicted(known, calibration.tilt, covariance).reshape(2, 3).sum(axis=1), rtol=0.1)


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
