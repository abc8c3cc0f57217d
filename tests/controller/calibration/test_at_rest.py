"""Calibration at rest: the errors of IMUs that rest at unknown poses, against the errors that were put in."""

from dataclasses import replace

import numpy as np
import pytest

from controller.calibration.at_rest import Prior, Rests, calibrate_at_rest, expected_forces, fit_pose, undo
from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.imu_errors import ERRORS, error_matrix
from controller.inverse_kinematics import leg_lengths, sample_workspace
from controller.rig import sensor_geometry
from plant.errors import CalibrationError
from plant.imu import load_imu
from plant.mechanism import Mechanism, load_spatial
from tests.controller.calibration.rest_readings import pose_errors, rests_of
from tests.controller.leg_geometry import rotation_of


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
