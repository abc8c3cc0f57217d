"""Calibration by known poses: made-up mounting and bias come back from the planned poses."""

import numpy as np
import pytest

from controller.calibration.at_rest import expected_forces
from controller.inverse_kinematics import leg_lengths
from controller.rig import sensor_geometry
from hil.calibration.data import CalibrationData, Knowledge
from hil.calibration.known_poses import calibrate_by_known_poses
from hil.loop.records import RECORD
from plant.errors import CalibrationError
from plant.mechanism import load_spatial
from plant.pose import rotation_from_vector, vector_from_rotation

RATE, REST = 100.0, 150
POSES = 24


@pytest.fixture(scope="module")
def rig():
    """Records of rests with a short turn after each, and the readings of ideal IMUs in them."""
    mechanism, random = load_spatial("hexapod"), np.random.default_rng(3)
    home, geometry = mechanism.require_home(), sensor_geometry(mechanism)
    records = np.zeros(POSES * (REST + 20), RECORD)
    ideal = np.zeros((len(records), 7, 3))
    for pose in range(POSES):
        position = home.position + random.uniform(-0.03, 0.03, 3)
        rotation = rotation_from_vector(random.uniform(-0.3, 0.3, 3)) @ home.rotation
        part = slice(pose * (REST + 20), (pose + 1) * (REST + 20))
        records["reference"][part, :, 0] = leg_lengths(mechanism, position, rotation)
        ideal[part] = expected_forces(geometry, position, rotation)
        records["angular_velocity"][part][REST:] = 0.2
    return mechanism, records, ideal


def new_data(mechanism):
    data = CalibrationData(mechanism, "mpu9150", RATE, Knowledge(), 0)
    data.zero[:] = np.random.default_rng(9).normal(0.0, 0.01, (7, 3))
    return data


def test_mounting_and_bias_come_back(rig):
    mechanism, records, ideal = rig
    data, random = new_data(mechanism), np.random.default_rng(4)
    turns, bias = random.uniform(-0.02, 0.02, (7, 3)), random.uniform(-0.2, 0.2, (7, 3))
    records = records.copy()
    records["angular_velocity"] += data.zero
    for imu in range(7):
        # An IMU that is turned on its place reads what is turned back.
        records["specific_force"][:, imu] = ideal[:, imu] @ rotation_from_vector(turns[imu]) + bias[imu]
    middle = len(records) // 2
    found = calibrate_by_known_poses(data, [records[:middle], records[middle:]])
    raw = np.zeros((len(records), 3, 7, 3))
    raw[:, 0], raw[:, 1] = data.zero, records["specific_force"]
    calibrated = found.apply(raw)
    np.testing.assert_allclose(calibrated[:, 0], 0.0, atol=1e-12)
    before, after = (
        np.sqrt(np.mean((each - ideal) ** 2, axis=(0, 2))) for each in (records["specific_force"], calibrated[:, 1])
    )
    assert (after < 0.1 * before).all()
    # What rests alone do not tell apart is as uncertain as the covariance says.
    sigmas = np.sqrt(np.diag(found.covariance)).reshape(7, 7, 3)[:, 4]
    left = [vector_from_rotation(found.gain[1, imu] @ rotation_from_vector(turns[imu]).T) for imu in range(7)]
    assert (np.abs(left) < 1.5 * sigmas).all()


def test_the_covariance_is_that_of_the_poses_and_of_what_was_known_before(rig):
    mechanism, records, ideal = rig
    data = new_data(mechanism)
    records = records.copy()
    records["specific_force"] = ideal
    records["angular_velocity"] += data.zero
    found, twice = (calibrate_by_known_poses(data, [records] * times) for times in (1, 2))
    before = data.knowledge.prior.error_sigmas().reshape(7, 7, 3)
    sigmas, fewer = (np.sqrt(np.diag(each.covariance)).reshape(7, 7, 3) for each in (found, twice))
    sought = [1, 4]
    others = [0, 2, 3, 5, 6]
    np.testing.assert_allclose(sigmas[:, others], before[:, others])
    assert (sigmas[:, sought] < 0.85 * before[:, sought]).all()
    # Where the data rule, twice as many halve the variance.
    ratio = (sigmas / fewer)[:, sought] ** 2
    assert (ratio > 1.1).all() and ratio.max() == pytest.approx(2.0, abs=0.1) and (ratio < 2.0).all()
    # Mounting and bias of one IMU are coupled, those of different IMUs are not.
    blocks = found.covariance.reshape(7, 21, 7, 21)
    assert np.abs(blocks[2, 3:6, 2, 12:15]).max() > 0.0
    assert not blocks[2, :, 3].any()


def test_without_a_rest_there_is_nothing_to_compare(rig):
    mechanism, records, _ = rig
    data = new_data(mechanism)
    records = records[:400].copy()
    records["angular_velocity"] = 1.0
    with pytest.raises(CalibrationError, match="no rest was found: at known poses the rig must rest for a second"):
        calibrate_by_known_poses(data, [records])
