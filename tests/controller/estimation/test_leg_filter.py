"""The leg filter: its measurement model against differences, its start, and its errors on simulated legs."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from controller.cycle import STATE, cycle_parameters
from controller.estimation.leg_filter import (
    STATES,
    leg_direction,
    predict_leg,
    predict_measurement,
    start_leg,
    step_leg_filters,
    take_leg_sample,
)
from controller.inverse_kinematics import sample_workspace
from controller.settings import FusionSettings, control_settings, fusion_settings
from plant.imu import load_imu
from plant.mechanism import Mechanism
from tests.controller.leg_geometry import leg_directions, leg_frames, rotation_of, unit
from tests.controller.leg_motion import joint_to_leg, observe, sines

GRAVITY = 9.81
RATE_HZ = 1000.0
PERIOD_S = 1.0 / RATE_HZ
UP_IN_JOINT = unit([0.0, 0.45, 0.9])
IMU_POSITION = np.array([0.03, -0.01, 0.10])
DEGREE = np.pi / 180.0
SEEDS = st.integers(0, 2**32 - 1)
FUSION = FusionSettings()


class Leg:
    """The compiled filter of one leg with the arrays that it works on."""

    def __init__(self, jerk=FUSION.leg_jerk**2, bias_walk=FUSION.bias_walk**2):
        self.x, self.covariance = np.zeros(STATES), np.zeros((STATES, STATES))
        self.densities = (jerk, bias_walk)
        self.variances = (FUSION.gyroscope_noise**2 * RATE_HZ / 2.0, FUSION.leg_accelerometer_noise**2 * RATE_HZ / 2.0)
        self._scratch = (np.zeros(6), np.zeros((6, STATES)), np.zeros(STATES), np.zeros(STATES))

    def start(self, gyroscope, accelerometer):
        start_leg(self.x, self.covariance, gyroscope, accelerometer, UP_IN_JOINT, FUSION.bias_sigma)
        self.update(gyroscope, accelerometer)

    def step(self, gyroscope, accelerometer):
        predict_leg(self.x, self.covariance, PERIOD_S, *self.densities)
        self.update(gyroscope, accelerometer)

    def update(self, gyroscope, accelerometer):
        predict_measurement(self.x, UP_IN_JOINT, IMU_POSITION, GRAVITY, *self._scratch[:2])
        take_leg_sample(self.x, self.covariance, gyroscope, accelerometer, *self.variances, *self._scratch)

    def run(self, gyroscope, accelerometer):
        """States (N, 9) after each sample of a record."""
        states = np.empty((len(gyroscope), STATES))
        for k, sample in enumerate(zip(gyroscope, accelerometer, strict=True)):
            (self.step if k else self.start)(*sample)
            states[k] = self.x
        return states


def measurement(x, up_in_joint=UP_IN_JOINT, d=IMU_POSITION):
    h, jacobian = np.zeros(6), np.zeros((6, STATES))
    predict_measurement(x, up_in_joint, d, GRAVITY, h, jacobian)
    return h, jacobian


def tilt_errors(states, angles):
    """Angles [rad] between the legs of filter states (N, 9) and of true angles (N, 2)."""
    return np.linalg.norm(np.cross(joint_to_leg(states[:, :2])[:, :, 2], joint_to_leg(angles)[:, :, 2]), axis=1)


angles = st.one_of(st.floats(-1.2, 1.2), st.sampled_from([0.0, np.pi / 2, -np.pi / 2, 1e-9, np.pi]))
rates = st.one_of(st.floats(-5.0, 5.0), st.just(0.0))
accelerations = st.one_of(st.floats(-80.0, 80.0), st.just(0.0))
states = st.tuples(angles, angles, rates, rates, accelerations, accelerations, *[st.floats(-0.4, 0.4)] * 3)


@settings(max_examples=100, deadline=None)
@given(states, SEEDS)
def test_the_expected_measurement_is_what_an_imu_on_such_a_leg_reads(state, seed):
    random = np.random.default_rng(seed)
    up, d, x = unit(random.normal(size=3)), random.uniform(-0.1, 0.1, 3), np.array(state)

    def moving(times):
        t = np.asarray(times)[..., None]
        return x[:2] + t * x[2:4] + t**2 / 2.0 * x[4:6]

    seen = observe(moving, [0.0], up, d, GRAVITY)
    h, _ = measurement(x, up, d)
    np.testing.assert_allclose(h[:3], seen.gyroscope[0] + x[6:], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(h[3:], seen.accelerometer[0], rtol=0.0, atol=1e-7)


@settings(max_examples=100, deadline=None)
@given(states, SEEDS)
def test_the_jacobian_is_the_derivative_of_the_measurement(state, seed):
    random = np.random.default_rng(seed)
    up, d, x = unit(random.normal(size=3)), random.uniform(-0.1, 0.1, 3), np.array(state)
    _, jacobian = measurement(x, up, d)
    numeric = np.empty((6, STATES))
    for i in range(STATES):
        step = 1e-4 * np.eye(STATES)[i]
        h = [measurement(x + k * step, up, d)[0] for k in (-2, -1, 1, 2)]
        numeric[:, i] = (h[0] - 8.0 * h[1] + 8.0 * h[2] - h[3]) / 12e-4
    np.testing.assert_allclose(jacobian, numeric, rtol=0.0, atol=1e-8)


@settings(max_examples=60, deadline=None)
@given(states, SEEDS)
def test_direction_and_rate_are_those_of_the_leg_frame(state, seed):
    random = np.random.default_rng(seed)
    joint, x = rotation_of(random.normal(size=3)), np.array(state)
    direction, rate = np.zeros(3), np.zeros(3)
    leg_direction(x, joint, 0.0, direction, rate)
    np.testing.assert_allclose(direction, joint @ joint_to_leg(x[:2])[:, 2], rtol=0.0, atol=1e-15)
    h = 1e-6
    ahead, behind = (joint @ joint_to_leg(x[:2] + sign * h * x[2:4])[:, 2] for sign in (1.0, -1.0))
    np.testing.assert_allclose(rate, (ahead - behind) / (2.0 * h), rtol=0.0, atol=1e-8)
    assert abs(rate @ direction) < 1e-14


@settings(max_examples=100, deadline=None)
@given(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), st.tuples(*[st.floats(-0.5, 0.5)] * 2), SEEDS)
def test_the_start_takes_the_one_of_two_solutions_on_whose_side_of_the_singularity_the_joint_rests(pair, rate, seed):
    random = np.random.default_rng(seed)
    up = unit(random.normal(size=3))
    a, _ = pair
    seen = joint_to_leg(np.array(pair)).T @ up
    # The other solution: the vertical after the first turn keeps its y and mirrors its z, so that a -> 2 phi - a.
    other_a = np.angle(np.exp(1j * (2.0 * np.arctan2(up[2], up[1]) - a)))
    before = rotation_of([other_a, 0.0, 0.0]).T @ up
    other_b = np.arctan2(before[0] * seen[2] - before[2] * seen[0], before[0] * seen[0] + before[2] * seen[2])
    np.testing.assert_allclose(joint_to_leg(np.array([other_a, other_b])).T @ up, seen, atol=1e-12)
    # Where the two meet, gravity does not tell the angles.
    across = rotation_of([a, 0.0, 0.0])[:, 2] @ up
    assume(np.hypot(seen[0], seen[2]) > 1e-2)
    assume(abs(across) > 1e-2 and abs(up[2]) > 1e-2)
    # No universal joint has a second angle beyond the right one; a planar one may have passed the singularity.
    on_side = pair if across * up[2] > 0.0 else (other_a, other_b)
    other = (other_a, other_b) if across * up[2] > 0.0 else pair
    assume(abs(abs(on_side[1]) - np.pi / 2.0) > 1e-6)
    expected = on_side if abs(on_side[1]) < np.pi / 2.0 else other

    axis = joint_to_leg(np.array(expected)).T[:, 0]
    gyroscope = rate[0] * axis + rate[1] * np.array([0.0, 1.0, 0.0])
    x, covariance = np.zeros(STATES), np.full((STATES, STATES), np.nan)
    start_leg(x, covariance, gyroscope, GRAVITY * seen, up, 0.007)
    np.testing.assert_allclose(x[:2], expected, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(x[2:4], rate, rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(x[4:], 0.0)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()
    np.testing.assert_allclose(np.diag(covariance)[6:], 0.007**2)


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, -20.0])
def test_the_start_finds_every_leg_of_the_workspace_on_a_level_and_a_tilted_base(hexapod, tilt_deg):
    mechanism = Mechanism.from_legs(
        hexapod.base_joints,
        hexapod.platform_joints,
        home=hexapod.home,
        limits={"stroke": (-0.06, 0.06)},
        up_in_base=rotation_of([tilt_deg * DEGREE, 0.0, 0.0])[:, 2],
    )
    for position, rotation in zip(*sample_workspace(mechanism, 60, seed=2), strict=True):
        directions = leg_directions(mechanism, position, rotation)
        frames = leg_frames(directions, mechanism.base_joint_axes)
        for leg in range(6):
            joint = mechanism.joint_rotations[leg]
            x, covariance, found = np.zeros(STATES), np.zeros((STATES, STATES)), np.zeros(3)
            force = GRAVITY * frames[leg].T @ mechanism.up_in_base
            start_leg(x, covariance, np.zeros(3), force, joint.T @ mechanism.up_in_base, 0.01)
            leg_direction(x, joint, 0.0, found, np.zeros(3))
            np.testing.assert_allclose(found, directions[leg], rtol=0.0, atol=1e-9)


def test_noise_free_readings_of_a_leg_at_rest_leave_no_error():
    place = (UP_IN_JOINT, IMU_POSITION, GRAVITY)
    still = observe(lambda times: np.full((*np.shape(times), 2), [0.2, -0.15]), np.zeros(2000), *place)
    found = Leg().run(still.gyroscope, still.accelerometer)
    assert tilt_errors(found, still.angles).max() < 1e-9
    np.testing.assert_allclose(found[-1, 2:], 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_noise_free_readings_in_motion_converge_to_the_truth_from_a_start_that_was_misled(seed):
    motion = observe(sines(np.random.default_rng(seed)), np.arange(4000) * PERIOD_S, UP_IN_JOINT, IMU_POSITION, GRAVITY)
    bias = np.radians([0.2, -0.1, 0.15])
    found = Leg().run(motion.gyroscope + bias, motion.accelerometer)
    errors = tilt_errors(found, motion.angles)
    # The start takes the leg's own acceleration for gravity and the bias for motion.
    assert errors[0] > 0.05 * DEGREE
    assert errors[2000:].max() < 0.01 * DEGREE
    np.testing.assert_allclose(found[-1, 6:], bias, atol=0.01 * DEGREE)
    np.testing.assert_allclose(found[2000:, 2:4], motion.rates[2000:], atol=0.05 * DEGREE)


def test_in_motion_the_noise_of_an_mpu9150_costs_less_than_a_twentieth_of_a_degree():
    imu, scale, late, misled = load_imu("mpu9150-calibrated"), np.sqrt(RATE_HZ / 2.0), [], []
    for seed in range(8):
        random = np.random.default_rng(seed)
        motion = observe(sines(random), np.arange(8000) * PERIOD_S, UP_IN_JOINT, IMU_POSITION, GRAVITY)
        shape = motion.gyroscope.shape
        gyroscope = motion.gyroscope + imu.gyroscope.bias[1] * unit(random.normal(size=3))
        gyroscope += random.normal(scale=imu.gyroscope.noise * scale, size=shape)
        accelerometer = motion.accelerometer + random.normal(scale=imu.accelerometer.noise * scale, size=shape)
        late.append(tilt_errors(Leg().run(gyroscope, accelerometer), motion.angles)[2000:])
        # What the filter is for: the accelerometer alone, taken for gravity.
        alone = np.empty((2000, STATES))
        for row, force in zip(alone, accelerometer, strict=False):
            start_leg(row, np.zeros((STATES, STATES)), np.zeros(3), force, UP_IN_JOINT, 0.01)
        misled.append(tilt_errors(alone, motion.angles[:2000]))
    assert np.sqrt(np.mean(np.square(late))) < 0.05 * DEGREE
    # Settled, a run keeps within what sqrt(gyroscope noise x accelerometer noise / g) = 0.023 deg allows a Gaussian error.
    assert np.max(np.array(late)[:, -1000:]) < 4.0 * 0.023 * DEGREE
    assert np.sqrt(np.mean(np.square(misled))) > 20.0 * 0.05 * DEGREE


def test_the_covariance_stays_symmetric_and_positive_definite_over_twenty_seconds():
    random = np.random.default_rng(5)
    motion = observe(sines(random, size=0.3), np.arange(20_000) * PERIOD_S, UP_IN_JOINT, IMU_POSITION, GRAVITY)
    gyroscope = motion.gyroscope + random.normal(scale=2e-3, size=motion.gyroscope.shape)
    accelerometer = motion.accelerometer + random.normal(scale=0.4, size=motion.gyroscope.shape)
    leg = Leg()
    for k, sample in enumerate(zip(gyroscope, accelerometer, strict=True)):
        (leg.step if k else leg.start)(*sample)
        if k % 100 == 0:
            np.testing.assert_array_equal(leg.covariance, leg.covariance.T)
            scale = np.sqrt(np.diag(leg.covariance))
            assert np.linalg.eigvalsh(leg.covariance / np.outer(scale, scale)).min() > 1e-9
    assert np.isfinite(leg.x).all()


def test_the_covariance_is_that_of_the_errors_when_the_noise_is_as_assumed():
    """NEES: legs drawn from the filter's own model of motion, readings with its own noise."""
    random, runs, steps = np.random.default_rng(6), 60, 250
    jerk, bias_walk = 10.0**2, 1e-4**2
    t = PERIOD_S
    block = jerk * np.array([[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]])
    root = np.linalg.cholesky(block)
    forward = np.array([[1.0, t, t * t / 2.0], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
    total, count = 0.0, 0
    for _ in range(runs):
        leg = Leg(jerk, bias_walk)
        first = np.concatenate([random.uniform(-0.2, 0.2, 2), random.normal(scale=0.02, size=2), np.zeros(2)])
        truth = np.concatenate([first, random.normal(scale=FUSION.bias_sigma, size=3)])
        for k in range(steps):
            if k:
                moved = forward @ truth[:6].reshape(3, 2) + root @ random.normal(size=(3, 2))
                truth = np.concatenate([moved.ravel(), truth[6:] + np.sqrt(bias_walk * t) * random.normal(size=3)])
            noise = random.normal(size=6) * np.sqrt(np.repeat(leg.variances, 3))
            sample = measurement(truth)[0] + noise
            (leg.step if k else leg.start)(sample[:3], sample[3:])
        error = truth - leg.x
        total += error @ np.linalg.solve(leg.covariance, error)
        count += STATES
    least, greatest = chi2.ppf([0.0005, 0.9995], count)
    assert 0.8 * least < total < 1.2 * greatest


@pytest.mark.parametrize("missed", [0, 1, 40, 60, 300])
def test_missed_periods_are_predicted_and_in_a_long_gap_the_speed_lasts_without_acceleration(hexapod, missed):
    """The readings are so uncertain that the states after the cycle are those that were predicted."""
    parameters = cycle_parameters(hexapod, RATE_HZ, control_settings(hexapod), fusion_settings(hexapod))
    parameters["legs"]["rate_variance"] = parameters["legs"]["force_variance"] = 1e30
    state = np.zeros((), STATE)
    legs, before = state["legs"], np.random.default_rng(missed).uniform(-1.0, 1.0, (6, STATES))
    legs["x"], legs["age"], legs["covariance"] = before, 500, np.eye(STATES)
    state["imus"]["used"], state["imus"]["sample"] = 1, 1.0
    state["time"]["missed"], state["time"]["cycle"] = missed, 1000
    p, s = parameters[()], state[()]
    step_leg_filters(p["legs"], s["legs"], p["rig"], s["time"], s["imus"])

    time = (1 + missed) * PERIOD_S
    acceleration = before[:, 4:6] if time <= 0.05 else np.zeros((6, 2))
    expected = before.copy()
    expected[:, :2] += time * before[:, 2:4] + time**2 / 2.0 * acceleration
    expected[:, 2:4] += time * acceleration
    expected[:, 4:6] = acceleration
    np.testing.assert_allclose(legs["x"], expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(legs["age"], 501 + missed)
