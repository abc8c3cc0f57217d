"""Calibration in motion: it improves what was found at rest, and predicts its own accuracy."""

import numpy as np
import pytest

from controller.calibration.at_rest import Prior, Rests, calibrate_at_rest, pose_covariance
from controller.calibration.in_motion import Motion, calibrate_in_motion
from controller.estimation.whole_mechanism.imu_errors import ERRORS
from controller.estimation.whole_mechanism.readings import JOINTS
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.settings import sensor_settings
from plant.dynamics.imposed_motion import impose
from plant.encoders import PRESETS
from plant.imu import imu_state, measure
from plant.pose import Pose, vector_from_rotation
from tests.controller.calibration.rest_readings import RAW, pose_errors, rests_of


def moved(mechanism, duration):
    """State of raw IMUs, an imposed motion, and what these IMUs read of it with the pose and twist at its start."""
    imposed = impose(mechanism, "0.8", duration, 1000.0, 3, size=(0.02, np.radians(6.0)))
    imu, samples = imu_state(RAW, 1, 1e-3), np.zeros_like(imposed.signals)
    for signals, sample in zip(imposed.signals, samples, strict=True):
        measure(imu, signals, sample)
    (first, second), (start, later) = imposed.positions[:2], imposed.rotations[:2]
    twist = 1000.0 * np.array([*(second - first), *vector_from_rotation(later @ start.T)])
    return imu, imposed, Motion(samples, (Pose(first, start), twist))


@pytest.mark.slow
def test_motion_brings_it_to_a_tenth_of_a_millimetre(hexapod):
    fusion = sensor_settings(hexapod, RAW, 1000.0)
    readings, _, _ = rests_of(hexapod, 20, 1)
    found = calibrate_at_rest(hexapod, Rests(readings))
    imu, _, motion = moved(hexapod, 20.0)
    calibration, covariance = calibrate_in_motion(hexapod, found, motion, 1000.0, fusion)
    others = rests_of(hexapod, 10, 1, poses=sample_workspace(hexapod, 10, seed=999))
    true = pose_errors(hexapod, calibration, calibration.tilt, *others)
    assert true[0] < 0.5
    assert true[0] < pose_errors(hexapod, found.calibration(), found.tilt, *others)[0]
    predicted = [pose_covariance(hexapod, calibration.tilt, pose, covariance) for pose in zip(*others[1:], strict=True)]
    assert 0.4 < true[0] / (1e3 * np.sqrt(np.trace(np.mean(predicted, axis=0)[:3, :3]))) < 2.5
    # What the rig leaves is told apart from what the IMUs leave: together they are what there was, over the rests.
    of_imus = np.zeros_like(covariance)
    of_imus[: 7 * ERRORS, : 7 * ERRORS] = calibration.covariance
    rests = list(zip(found.positions, found.rotations, strict=True))
    of_both, of_one = (
        np.mean([pose_covariance(hexapod, calibration.tilt, pose, each) for pose in rests], axis=0)
        for each in (covariance, of_imus)
    )
    apart, together = (np.diag(each).reshape(2, 3).sum(axis=1) for each in (of_one, of_both))
    np.testing.assert_allclose(apart + calibration.floor**2, together, rtol=1e-3)
    assert (calibration.floor > 0.0).all()
    # The gyroscopes' scales, which no rest tells; a leg hardly turns about itself.
    error = np.abs(calibration.gain[0] - np.linalg.inv(imu["gain"][0, :7]))
    assert error[:6, :, :2].max() < 2e-3
    assert error[6].max() < 2e-3


@pytest.mark.endurance
def test_encoders_tell_more_than_a_longer_motion_without(hexapod):
    """With zeros that are centimetres off, and some readings lost."""
    readings, _, _ = rests_of(hexapod, 20, 1)
    found = calibrate_at_rest(hexapod, Rests(readings))
    _, imposed, motion = moved(hexapod, 10.0)
    random = np.random.default_rng(2)
    lengths = leg_lengths(hexapod, imposed.positions, imposed.rotations) + random.normal(0.0, 0.03, 6)
    lengths = 5e-6 * np.rint(lengths / 5e-6)
    lengths[random.random(lengths.shape) < 0.1] = np.nan
    fusion = sensor_settings(hexapod, RAW, 1000.0, PRESETS["incremental"])
    others = rests_of(hexapod, 10, 1, poses=sample_workspace(hexapod, 10, seed=999))
    errors, predicted = [], []
    for read in (lengths, None):
        calibration, covariance = calibrate_in_motion(hexapod, found, motion._replace(lengths=read), 1000.0, fusion)
        errors.append(pose_errors(hexapod, calibration, calibration.tilt, *others)[0])
        of_poses = [pose_covariance(hexapod, calibration.tilt, pose, covariance) for pose in zip(*others[1:], strict=True)]
        predicted.append(1e3 * np.sqrt(np.trace(np.mean(of_poses, axis=0)[:3, :3])))
    assert predicted[0] < 0.7 * predicted[1]
    assert errors[0] < 0.8 * errors[1] and 0.3 < errors[0] / predicted[0] < 2.5


@pytest.mark.endurance
def test_joints_that_are_off_are_sought_with_the_rest(hexapod):
    built, fusion = hexapod.built(2e-4, 3), sensor_settings(hexapod, RAW, 1000.0)
    readings, _, _ = rests_of(built, 20, 1)
    _, _, motion = moved(built, 20.0)
    others, surprise = rests_of(built, 10, 1, poses=sample_workspace(built, 10, seed=999)), []
    true = np.stack([built.base_joints - hexapod.base_joints, built.platform_joints - hexapod.platform_joints])

    def predicted(mechanism, tilt, covariance):
        poses = zip(*others[1:], strict=True)
        return np.mean([pose_covariance(mechanism, tilt, pose, covariance) for pose in poses], axis=0).diagonal()

    for joints in (0.0, 2e-4):
        found = calibrate_at_rest(hexapod, Rests(readings), Prior(joints=joints))
        calibration, covariance = calibrate_in_motion(hexapod, found, motion, 1000.0, fusion)
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


@pytest.mark.slow
def test_missed_periods_cost_what_was_not_read_alone(hexapod):
    """Taken for readings, the samples that stand for missed ones would bend the calibration."""
    fusion = sensor_settings(hexapod, RAW, 1000.0)
    readings, _, _ = rests_of(hexapod, 20, 1)
    found = calibrate_at_rest(hexapod, Rests(readings))
    _, _, motion = moved(hexapod, 10.0)
    read = np.arange(len(motion.samples)) % 200 >= 20
    read[:200] = True
    last = np.maximum.accumulate(np.where(read, np.arange(len(read)), 0))
    held = motion._replace(samples=motion.samples[last])
    others = rests_of(hexapod, 10, 1, poses=sample_workspace(hexapod, 10, seed=999))
    errors = []
    for each in (motion, held._replace(read=read), held):
        calibration, _ = calibrate_in_motion(hexapod, found, each, 1000.0, fusion)
        errors.append(pose_errors(hexapod, calibration, calibration.tilt, *others)[0])
    whole, missed, taken = errors
    assert missed < 1.2 * whole < taken
