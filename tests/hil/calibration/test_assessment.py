"""The assessment of a calibration: its residuals and errors, its constants by name, and what it tells in words."""

from types import SimpleNamespace

import numpy as np
import pytest

from controller.calibration.at_rest import expected_forces
from controller.calibration.file import Calibration, join_gain
from controller.rig import sensor_geometry
from hil.calibration.assessment import assess, constants, weak_words, weakest_direction
from hil.calibration.data import CalibrationData, Knowledge
from plant.imu import MILLI_G
from plant.mechanism import load_spatial
from plant.pose import quaternion_from_rotation, rotation_from_vector

SIZE = 185
POSES = 4


def test_the_weakest_direction_is_named():
    mechanism = load_spatial("hexapod")
    assert weakest_direction(np.diag([1e-8, 1e-8, 4e-6, 0.0, 0.0, 0.0]), mechanism).startswith("mostly along z: 2 mm")
    assert weakest_direction(np.diag([1e-8, 1e-8, 1e-8, 0.0, 4e-4, 0.0]), mechanism).startswith("mostly about y: 4 mm")


def test_rotations_count_by_the_mean_distance_of_the_platforms_joints():
    joints = np.diag([0.1, 0.2, 0.3])
    mechanism = SimpleNamespace(platform_joints=np.vstack([joints, -joints]))
    # 10 mrad at 0.2 m are 2 mm.
    assert weakest_direction(np.diag([0.0, 3.9e-6, 0.0, 0.0, 0.0, 1e-4]), mechanism).startswith("mostly about z: 2 mm")
    assert weakest_direction(np.diag([0.0, 4.1e-6, 0.0, 0.0, 0.0, 1e-4]), mechanism).startswith("mostly along y: 2 mm")


@pytest.fixture(scope="module")
def exact():
    """Rests of ideal IMUs at known poses."""
    mechanism, random = load_spatial("hexapod"), np.random.default_rng(5)
    data = CalibrationData(mechanism, "mpu9150", 1000.0, Knowledge(), 0)
    geometry, home = sensor_geometry(mechanism), mechanism.require_home()
    data.readings, data.truth = np.zeros((POSES, 7, 6)), np.zeros((POSES, 7))
    for readings, truth in zip(data.readings, data.truth, strict=True):
        position = home.position + random.uniform(-0.02, 0.02, 3)
        rotation = rotation_from_vector(random.uniform(-0.1, 0.1, 3)) @ home.rotation
        readings[:, 3:] = expected_forces(geometry, position, rotation)
        truth[:3], truth[3:] = position, quaternion_from_rotation(rotation)
    return data


def assessed(data, calibration=None, covariance=None):
    covariance = 1e-8 * np.eye(SIZE) if covariance is None else covariance
    return assess(data, {"motion": (calibration or Calibration(), covariance)})


def altered(data, **changes):
    other = CalibrationData(data.mechanism, "mpu9150", data.rate, Knowledge(), 0)
    for name in ("readings", "truth"):
        setattr(other, name, changes.get(name, getattr(data, name)).copy())
    return other


def test_exact_rests_leave_nothing_and_the_true_error_is_the_distance_from_the_truth(exact):
    figures = assessed(exact)
    assert figures["rests"] == POSES
    assert figures["residual_mg"]["motion"] < 1e-3
    assert figures["true"]["motion"]["position_rms"] < 1e-6
    moved = exact.truth.copy()
    moved[:, :3] += [3e-3, 0.0, -4e-3]
    true = assessed(altered(exact, truth=moved))["true"]["motion"]
    assert true["position_rms"] == pytest.approx(5e-3, rel=1e-3) and true["rotation_rms"] < 1e-5
    assert assessed(altered(exact, truth=np.full((POSES, 7), np.nan)))["true"] == {}


def test_residuals_are_of_calibrated_readings_by_imu_and_scaled_for_the_pose(exact):
    random = np.random.default_rng(6)
    noise = 2.0 * MILLI_G * random.normal(size=(POSES, 7, 3))
    noise[:, 3] *= 4.0
    readings = exact.readings.copy()
    readings[:, :, 3:] += noise
    found = assessed(altered(exact, readings=readings))
    by_imu = np.array(found["residual_by_imu_mg"]["motion"])
    assert found["residual_mg"]["motion"] == pytest.approx(np.sqrt(np.mean(by_imu**2)))
    assert by_imu.argmax() == 3
    # Twenty-one components less the pose's six tell the noise: the sum of squares that is left, over fifteen.
    assert np.sqrt(np.mean(noise**2)) / MILLI_G == pytest.approx(found["residual_mg"]["motion"], rel=0.35)
    offset = np.zeros((3, 7, 3))
    offset[1, 2] = 0.5
    readings = exact.readings.copy()
    readings[:, 2, 3:] -= 0.5
    biased = altered(exact, readings=readings)
    assert assessed(biased)["residual_mg"]["motion"] > 5.0
    assert assessed(biased, Calibration(offset=offset))["residual_mg"]["motion"] < 1e-3


def test_the_predicted_error_is_that_of_the_covariance(exact):
    once, more = (assessed(exact, covariance=factor * 1e-8 * np.eye(SIZE)) for factor in (1.0, 9.0))
    for name in ("position_rms", "rotation_rms"):
        assert once["predicted"]["motion"][name] > 0.0
        assert more["predicted"]["motion"][name] == pytest.approx(3.0 * once["predicted"]["motion"][name])


def test_constants_are_given_by_name_imu_and_axis():
    calibration, random = Calibration(), np.random.default_rng(8)
    drawn = {name: random.uniform(-0.02, 0.02, (2, 7, 3)) for name in ("scale", "axes", "mounting", "bias")}
    for sensor in range(2):
        for imu in range(7):
            scale, axes, mounting, bias = (drawn[name][sensor, imu] for name in ("scale", "axes", "mounting", "bias"))
            calibration.gain[sensor, imu] = join_gain(1.0 + scale, axes, mounting)
            calibration.offset[sensor, imu] = calibration.gain[sensor, imu] @ bias
    prior = np.linspace(1.0, 2.0, 147)
    found = constants(calibration, prior)["constants"]
    expected = {
        "gyroscope bias": drawn["bias"][0],
        "accelerometer bias": drawn["bias"][1],
        "accelerometer scale": drawn["scale"][1],
        "gyroscope scale": drawn["scale"][0],
        "alignment": drawn["mounting"][1],
        "accelerometer axes": drawn["axes"][1],
        "gyroscope axes": drawn["axes"][0],
    }
    assert list(found) == list(expected)
    for k, (name, values) in enumerate(expected.items()):
        np.testing.assert_allclose(found[name]["values"], values, atol=1e-12, err_msg=name)
        # Without a covariance, what is known is what was known before.
        np.testing.assert_allclose(found[name]["sigmas"], prior.reshape(7, 7, 3)[:, k])


def test_what_the_data_hardly_told_is_named():
    prior, shares = np.linspace(1.0, 2.0, 147), np.full(147, 0.1)
    # IMU, kind of error and axis: the gyroscope's scale about y of IMUs 2 and 5, and an axis of the accelerometer of IMU 6.
    for imu, kind, axis, share in ((2, 3, 1, 0.51), (5, 3, 1, 0.6), (6, 5, 2, 0.9), (1, 0, 0, 0.49)):
        shares[21 * imu + 3 * kind + axis] = share
    found = constants(Calibration(covariance=np.diag((shares * prior) ** 2)), prior)
    assert found["untold"] == {"gyroscope scale y": [2, 5], "accelerometer axes yz": [6]}
    least = found["least_told"]
    assert (least["name"], least["imu"]) == ("accelerometer axes yz", 6) and least["share"] == pytest.approx(0.9)
    np.testing.assert_allclose(found["constants"]["alignment"]["sigmas"], (shares * prior).reshape(7, 7, 3)[:, 4])
    assert list(weak_words(found | {"weakest": "mostly along x"})) == [
        "the pose is known least mostly along x",
        "the data hardly told gyroscope scale y of IMU 2, 5: more than 0.5 of its sigma before is left",
        "the data hardly told accelerometer axes yz of IMU 6: more than 0.5 of its sigma before is left",
        "the constant known least is accelerometer axes yz of IMU 6: 0.9 of its sigma before is left",
    ]
