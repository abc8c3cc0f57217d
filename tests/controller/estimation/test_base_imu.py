"""The IMU on the base: what it takes out of the other readings, beside rigid-body kinematics in NumPy."""

import numpy as np
import pytest

from controller.cycle import PARAMETERS, STATE
from controller.estimation.base_imu import base_imu_parameters, hear_base_imu, remove_base_motion, shared_errors
from controller.rig import rig_parameters
from controller.settings import fusion_settings
from plant.mechanism import load_spatial
from plant.pose import rotation_from_vector, skew

PERIOD = 1e-3


@pytest.fixture(scope="module")
def mechanism():
    return load_spatial("hexapod")


@pytest.fixture
def cycle(mechanism):
    """Constants and state of a cycle with an IMU on the base, off the origin."""
    parameters, state = np.zeros((), PARAMETERS), np.zeros((), STATE)
    parameters["rig"] = rig_parameters(mechanism, 1.0 / PERIOD, 0.2, np.zeros(2))
    identity = np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3))
    parameters["base"] = base_imu_parameters(mechanism, fusion_settings(mechanism), True, *identity)
    parameters["base"]["place"] = 0.1, -0.2, 0.05
    state["time"]["cycle"] = 100
    return parameters[()], state[()]


def take_out(p, s):
    remove_base_motion(p["base"], s["base"], p["rig"], s["time"], s["imus"], s["legs"], p["platform"], s["platform"], s["pose"])


@pytest.mark.parametrize("ages", [(0, 0, 0), (0, 1, 0), (1, 0, 2)])
def test_the_angular_acceleration_is_exact_for_a_rate_that_is_a_parabola(cycle, ages):
    """Whatever samples are missing: a gap is carried over."""
    p, s = cycle
    first, second, third = np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.4, -0.3]), np.array([2.0, -1.0, 3.0])
    for n in range(1200):
        t = n * PERIOD
        reading = np.array([first + second * t + 0.5 * third * t * t, [0.0, 0.1 * t, 9.8]])
        age = ages[n % 3]
        hear_base_imu(p["base"], s["base"], PERIOD, reading if age == 0 else np.full((2, 3), 7.0), age)
        if age == 0:
            last = t
    np.testing.assert_allclose(s["base"]["fitted"][1], second + third * last, atol=1e-6)
    np.testing.assert_allclose(s["base"]["fitted"][2], third, atol=1e-4)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9])
def test_a_reading_that_cannot_be_used_is_not_taken(cycle, bad):
    p, s = cycle
    good = np.array([[0.1, 0.2, 0.3], [0.0, 1.0, 9.7]])
    hear_base_imu(p["base"], s["base"], PERIOD, good, 0)
    broken = good.copy()
    broken[1, 1] = bad
    for _ in range(5):
        hear_base_imu(p["base"], s["base"], PERIOD, broken, 0)
    np.testing.assert_array_equal(s["base"]["force"], good[1])
    assert s["base"]["lost_for"] == pytest.approx(5 * PERIOD)
    hear_base_imu(p["base"], s["base"], PERIOD, good * 1.01, 0)
    assert s["base"]["lost_for"] == 0.0


@pytest.mark.parametrize("seed", range(5))
def test_what_is_left_is_what_a_base_at_rest_would_leave(cycle, mechanism, seed):
    """Points that move on a turning, accelerated frame, by the textbook's formula for their acceleration."""
    random, (p, s) = np.random.default_rng(seed), cycle
    w, w_rate, force = random.normal(0, 0.5, 3), random.normal(0, 2.0, 3), random.normal(0, 1.0, 3) + (0.0, 0.0, 9.8)
    s["base"]["begun"], s["base"]["rate"], s["base"]["force"], s["base"]["fitted"][1] = 1, w, force, w_rate
    up = p["rig"]["sensors"]["up_in_base"][0] * p["rig"]["sensors"]["gravity"]
    s["imus"]["healthy"] = s["imus"]["used"] = 1

    def felt(place, velocity):
        arm = place - p["base"]["place"]
        return force + np.cross(w_rate, arm) + np.cross(w, np.cross(w, arm)) + 2.0 * np.cross(w, velocity)

    expected = np.zeros((2, 7, 3))
    for k in range(6):
        angles, rates = random.normal(0, 0.3, 2), random.normal(0, 1.0, 2)
        s["legs"]["age"][k] = 50
        s["legs"]["x"][k, :4] = *(angles - PERIOD * rates), *rates
        frame = mechanism.joint_rotations[k] @ rotation_from_vector([angles[0], 0, 0]) @ rotation_from_vector([0, angles[1], 0])
        turning = frame @ np.array([rates[0] * np.cos(angles[1]), rates[1], rates[0] * np.sin(angles[1])])
        lever = frame @ mechanism.plant["leg_imu_position"][k]
        added = np.stack([w, felt(mechanism.base_joints[k] + lever, np.cross(turning, lever)) - up]) @ frame
        expected[:, k] = random.normal(size=(2, 3))
        s["imus"]["sample"][:2, k] = expected[:, k] + added
    turn = random.normal(0, 0.2, 3)
    pose, place, twist = s["pose"], random.normal(0, 0.3, 3), random.normal(0, 0.3, 6)
    pose["found"], pose["position"], pose["rotation"], pose["twist"] = 1, place, rotation_from_vector(turn), twist
    rotation = (np.eye(3) + PERIOD * skew(twist[3:])) @ pose["rotation"]
    lever = rotation @ mechanism.plant["platform_imu_position"]
    added = np.stack([w, felt(place + lever, twist[:3] + np.cross(twist[3:], lever)) - up]) @ rotation
    expected[:, 6] = random.normal(size=(2, 3))
    s["imus"]["sample"][:2, 6] = expected[:, 6] + added
    take_out(p, s)
    np.testing.assert_allclose(s["imus"]["sample"][:2], expected, atol=1e-12)


def test_before_the_first_reading_and_of_unhealthy_imus_nothing_is_taken_out(cycle):
    p, s = cycle
    s["imus"]["sample"][:2] = before = np.random.default_rng(0).normal(size=(2, 7, 3))
    s["imus"]["healthy"] = 1
    take_out(p, s)
    np.testing.assert_array_equal(s["imus"]["sample"][:2], before)
    s["base"]["begun"], s["base"]["rate"], s["imus"]["healthy"] = 1, 0.1, 0
    take_out(p, s)
    np.testing.assert_array_equal(s["imus"]["sample"][:2], before)


def test_the_biases_of_the_base_are_in_all_readings_and_turned_to_their_axes(mechanism):
    fusion = fusion_settings(mechanism)
    covariance = shared_errors(mechanism, fusion)
    assert np.linalg.matrix_rank(covariance) == 6
    for k in range(7):
        own = covariance[21 * k : 21 * k + 6, 21 * k : 21 * k + 6]
        sigmas = np.repeat([fusion.bias_sigma, fusion.accelerometer_bias_sigma], 3)
        np.testing.assert_allclose(own, np.diag(sigmas**2), atol=1e-15)
