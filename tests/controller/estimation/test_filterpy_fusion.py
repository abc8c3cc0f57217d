"""The filters on filterpy agree with the compiled ones: over thousands of steps, and the leg's part by part at any state."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.estimation import shaking
from controller.estimation.filterpy_filters import STATES, FilterpyLeg, FilterpyPlatform
from controller.estimation.leg_filter import force_doubt, predict_leg, predict_measurement, start_leg, take_leg_sample
from controller.estimation.platform_filter import STATE, note_clipping, platform_parameters, start_platform, step_platform
from controller.settings import FusionSettings
from plant.imu import GYROSCOPE
from tests.controller.leg_geometry import unit
from tests.controller.leg_motion import observe, sines

GRAVITY = 9.81
IMU_POSITION = np.array([0.03, -0.01, 0.10])
UP_IN_JOINT = unit([0.05, 0.45, 0.9])


class Twins:
    """Both filters of one leg with the same noise."""

    def __init__(self, rate, up=UP_IN_JOINT, d=IMU_POSITION):
        fusion = FusionSettings()
        self.noise = (1.0 / rate, fusion.leg_jerk**2, fusion.bias_walk**2)
        variances = (fusion.gyroscope_noise**2 * rate / 2.0, fusion.leg_accelerometer_noise**2 * rate / 2.0)
        self.place, self.variances, self.period = (up, d, GRAVITY), variances, 1.0 / rate
        self.shaking = np.zeros((), shaking.STATE)[()]
        self.reference = FilterpyLeg(up, d, GRAVITY, *self.noise, *variances)
        self.x, self.covariance = np.zeros(STATES), np.zeros((STATES, STATES))
        self.scratch = (np.zeros(6), np.zeros((6, STATES)), np.zeros(STATES), np.zeros(STATES))

    def start(self, gyroscope, accelerometer):
        start_leg(self.x, self.covariance, gyroscope, accelerometer, self.place[0], FusionSettings().bias_sigma)
        self.reference.start(self.x, self.covariance)
        self.reference.take(gyroscope, accelerometer)
        self.take(gyroscope, accelerometer)

    def step(self, gyroscope, accelerometer, clipped=(0, 0)):
        self.reference.shaken = float(self.shaking["mean"][0])
        self.reference.predict()
        self.reference.take(gyroscope, accelerometer, clipped)
        predict_leg(self.x, self.covariance, *self.noise)
        self.take(gyroscope, accelerometer, clipped)

    def take(self, gyroscope, accelerometer, clipped=(0, 0)):
        s, nominal = self.shaking, self.variances
        s["clipped"][:, 0] = clipped
        predict_measurement(self.x, *self.place, *self.scratch[:2])
        squared = np.square([gyroscope, accelerometer] - self.scratch[0].reshape(2, 3)).sum(axis=1).tolist()
        doubt = 3.0 * nominal[0] + self.covariance[2, 2] + self.covariance[3, 3]
        shaking.note_rate(s, 0, squared[0], doubt, self.period)
        shaking.note_force(s, 0, squared[1], nominal[1] + force_doubt(self.covariance, *self.place[1:]), self.period)
        variances = [shaking.variance_of(s, sensor, 0, nominal[sensor]) for sensor in range(2)]
        take_leg_sample(self.x, self.covariance, gyroscope, accelerometer, *variances, *self.scratch)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate", "seed"),
    [(250.0, 2), *(pytest.param(rate, seed, marks=pytest.mark.slow) for rate, seed in ((1000.0, 1), (4000.0, 3)))],
)
def test_five_thousand_steps_agree_with_the_compiled_filter(rate, seed):
    random = np.random.default_rng(seed)
    motion = observe(sines(random, size=0.3), np.arange(5000) / rate, UP_IN_JOINT, IMU_POSITION, GRAVITY)
    gyroscope = motion.gyroscope + 0.004 + random.normal(scale=2e-3, size=(5000, 3))
    accelerometer = motion.accelerometer + random.normal(scale=0.4, size=(5000, 3))
    # Shocks, and readings that are clipped.
    shocks = random.random(5000) < 0.02
    accelerometer[shocks] += random.normal(scale=30.0, size=(int(shocks.sum()), 3))
    clipped = (random.random((5000, 2)) < 0.01).astype(int)
    gyroscope[clipped[:, GYROSCOPE] != 0] = 4.4
    twins, excess = Twins(rate), []
    twins.start(gyroscope[0], accelerometer[0])
    # Relative to the size of each state in this motion, a bias being part of a rate, and of each covariance to its variances.
    size = np.abs(motion.states).max(axis=0)
    size[6:] = size[2:4].min()
    worst = np.zeros(2)
    for sample in zip(gyroscope[1:], accelerometer[1:], clipped[1:], strict=True):
        twins.step(*sample)
        excess.append(twins.shaking["excess"][:, 0].copy())
        deviation = np.sqrt(np.diag(twins.covariance))
        off = twins.covariance - twins.reference.P
        worst = np.maximum(
            worst, [np.abs((twins.x - twins.reference.state) / size).max(), np.abs(off / np.outer(deviation, deviation)).max()]
        )
    assert worst[0] < 3e-12
    assert worst[1] < 5e-12
    of_rate, of_force = np.array(excess).T
    assert of_force.max() > 900.0 and np.count_nonzero(of_force) > 0.8 * shocks.sum()
    assert of_rate.max() > 1.0
    # The motion was followed, so the agreement is not that of two filters at rest.
    assert np.ptp(motion.angles, axis=0).min() > 0.1
    assert np.abs(twins.x[:2] - motion.angles[-1]).max() < 0.01


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(*[st.floats(-size, size) for size in (1.5, 1.5, 5.0, 5.0, 80.0, 80.0, 0.4, 0.4, 0.4)]),
    st.integers(0, 2**32 - 1),
)
def test_measurement_and_jacobian_agree_at_any_state(state, seed):
    random = np.random.default_rng(seed)
    up, d, x = unit(random.normal(size=3)), random.uniform(-0.1, 0.1, 3), np.array(state)
    reference = FilterpyLeg(up, d, GRAVITY, 1e-3, 1.0, 1.0, 1.0, 1.0)
    h, jacobian = np.zeros(6), np.zeros((6, STATES))
    predict_measurement(x, up, d, GRAVITY, h, jacobian)
    np.testing.assert_allclose(reference.measurement(x[:, None])[:, 0], h, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(reference.measurement_jacobian(x[:, None]), jacobian, rtol=0.0, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-4.0, -1.0))
def test_a_prediction_agrees_for_any_covariance_and_period(seed, exponent):
    random = np.random.default_rng(seed)
    period, jerk, bias_walk = 10.0**exponent, 10.0 ** random.uniform(0.0, 4.0), 10.0 ** random.uniform(-10.0, 0.0)
    reference = FilterpyLeg(UP_IN_JOINT, IMU_POSITION, GRAVITY, period, jerk, bias_walk, 1.0, 1.0)
    root, x = random.normal(size=(STATES, STATES)), random.normal(size=STATES)
    covariance = root @ root.T
    reference.start(x, covariance)
    reference.predict()
    predict_leg(x, covariance, period, jerk, bias_walk)
    np.testing.assert_allclose(x, reference.state, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(covariance, reference.P, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "known", "seed"), [(1000.0, 1.0, 0), (250.0, 1.0, 1), (4000.0, 1.0, 2), (500.0, 0.0, 3)])
def test_five_thousand_steps_of_the_platform_agree_with_the_compiled_filter(rate, known, seed):
    """With an acceleration that is known, or is not, jolts, clipped rates, and a rest: with and without an unknown velocity."""
    random, fusion = np.random.default_rng(seed), FusionSettings()
    times = np.arange(5000)[:, None] / rate
    moving = np.where(np.arange(5000) < 3000, 1.0, 0.0)[:, None]
    gyroscope = 0.01 + 2.0 * np.sin(times * [3.0, 5.0, 7.0] + [0.0, 1.0, 2.0]) + random.normal(scale=2e-3, size=(5000, 3))
    acceleration = moving * 5.0 * np.sin(times * [9.0, 7.0, 5.0])
    force = GRAVITY * unit([0.1, -0.2, 1.0]) + acceleration + random.normal(scale=0.1, size=(5000, 3))
    jolts = random.random((5000, 3)) < 0.02 * moving
    force[jolts] += 60.0
    parameters, state = platform_parameters(fusion, rate)[()], np.zeros((), STATE)[()]
    start_platform(parameters, state, force[0])
    constants = (float(parameters[name]) for name in ("rate_density", "bias_walk", "force_variance"))
    reference, handed = FilterpyPlatform(GRAVITY, *constants), np.zeros((), STATE)[()]
    reference.take_over(state)
    worst, excess = np.zeros(3), []
    velocity_noise = float(parameters["force_variance"]) / rate**2
    clipped = np.abs(gyroscope).max(axis=1) > 1.98
    for rates, forces, own, beyond in zip(gyroscope, force, known * acceleration, clipped, strict=True):
        note_clipping(state, beyond, 1.0 / rate)
        reference.clipped_for = float(state["clipped_for"])
        reference.step(rates, forces, own, 1.0 / rate)
        step_platform(parameters, state, rates, forces, own, 1.0 / rate, GRAVITY)
        reference.hand_over(handed)
        # Where the velocity is known to be zero, it has no variance of its own.
        deviation = np.sqrt(np.diag(state["covariance"]) + velocity_noise * np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]))
        off = (state["covariance"] - handed["covariance"]) / np.outer(deviation, deviation)
        unknown = state["unknown"] - handed["unknown"], state["noise"] - handed["noise"]
        worst = np.maximum(worst, [np.abs(difference).max() for difference in (state["x"] - handed["x"], off, unknown)])
        excess.append(float(state["unknown"]))
    assert worst.max() < 1e-11
    assert max(excess) > 0.0 and clipped.sum() > 10
