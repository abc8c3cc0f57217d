"""The platform's roll-pitch filter: against a Kalman filter in plain NumPy, and on simulated platforms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.estimation.excess import INNOVATION_LIMIT
from controller.estimation.platform_filter import (
    BIAS,
    LEVEL,
    RATE_NOISE,
    SLOW_TURN,
    STATE,
    TILT_SIGMA,
    UNSEEN_ACCELERATION,
    note_clipping,
    platform_parameters,
    start_platform,
    step_platform,
    turn_direction,
    vertical_covariance,
)
from controller.settings import FusionSettings
from tests.controller.leg_geometry import UP, rotation_of, skew, unit

GRAVITY = 9.81
PERIOD_S = 1e-3
DEGREE = np.pi / 180.0
BIAS_RATE = np.radians([0.3, -0.2, 0.1])
FUSION = FusionSettings()
FORCE_VARIANCE = FUSION.platform_accelerometer_noise**2 / (2.0 * PERIOD_S)
NOISE = (FUSION.gyroscope_noise**2, FUSION.bias_walk**2, FORCE_VARIANCE / GRAVITY**2)


class Platform:
    """The compiled filter with its records."""

    def __init__(self, accelerometer, bias_sigma=FUSION.bias_sigma, period=PERIOD_S):
        self.parameters = platform_parameters(FusionSettings(bias_sigma=bias_sigma), 1.0 / period)[()]
        self.state, self.period = np.zeros((), STATE)[()], period
        start_platform(self.parameters, self.state, accelerometer)

    def step(self, gyroscope, accelerometer, acceleration=(0.0, 0.0, 0.0), clipped=False):
        note_clipping(self.state, clipped, self.period)
        sample = (gyroscope, accelerometer, np.asarray(acceleration, dtype=float))
        step_platform(self.parameters, self.state, *sample, self.period, GRAVITY)

    @property
    def vertical(self):
        return self.state["x"][:3]

    @property
    def bias(self):
        return self.state["x"][BIAS:LEVEL]

    @property
    def covariance(self):
        """Of vertical and bias (6, 6); what they have in common is left out."""
        covariance = np.zeros((6, 6))
        vertical_covariance(self.state, covariance[:3, :3])
        covariance[3:, 3:] = self.state["covariance"][4:, 4:]
        return covariance


class Twin:
    """A Kalman filter that takes what the known acceleration leaves for gravity and white noise, axis by axis of the IMU."""

    def __init__(self, vertical, covariance, innovation_limit=INNOVATION_LIMIT):
        self.x, self.covariance, self.limit = np.concatenate([vertical, np.zeros(3)]), covariance.copy(), innovation_limit

    def step(self, gyroscope, accelerometer, acceleration):
        rate_density, bias_walk, variance = NOISE
        u, w = self.x[:3], gyroscope - self.x[3:]
        forward = np.eye(6)
        forward[:3, :3] -= PERIOD_S * skew(w)
        forward[:3, 3:] = -PERIOD_S * skew(u)
        x = np.concatenate([rotation_of(-PERIOD_S * w) @ u, self.x[3:]])
        noise = [rate_density + RATE_NOISE * w @ w] * 3 + [bias_walk] * 3
        covariance = forward @ self.covariance @ forward.T + PERIOD_S * np.diag(noise)
        for seen, reading in zip(np.eye(6)[:3], (accelerometer - acceleration) / GRAVITY, strict=True):
            spread = seen @ covariance @ seen + variance
            gain = covariance @ seen / spread
            bound = self.limit * np.sqrt(spread)
            x = x + gain * np.clip(reading - seen @ x, -bound, bound)
            covariance = (np.eye(6) - np.outer(gain, seen)) @ covariance
        self.x, self.covariance = np.concatenate([x[:3] / np.linalg.norm(x[:3]), x[3:]]), covariance


def tilt_error(vertical, rotation):
    return np.linalg.norm(np.cross(vertical, rotation.T @ UP))


def tumbling(seed, count, speed=1.0):
    """Rotations (N, 3, 3) and the rates (N, 3) in {2} that lead from each to the next, exactly."""
    random = np.random.default_rng(seed)
    frequencies, phases = 2.0 * np.pi * random.uniform(0.2, 1.5, 3), random.uniform(0.0, 2.0 * np.pi, 3)
    rates = speed * np.sin(frequencies * PERIOD_S * np.arange(count)[:, None] + phases)
    rotations = [rotation_of(random.uniform(-0.3, 0.3, 3))]
    for rate in rates[:-1]:
        rotations.append(rotations[-1] @ rotation_of(PERIOD_S * rate))
    return np.array(rotations), rates


def test_the_start_takes_the_force_for_gravity():
    for force in (GRAVITY * UP, 0.01 * unit([1.0, 2.0, -3.0]), -GRAVITY * UP, np.array([GRAVITY, 0.0, 0.0])):
        platform = Platform(force, 0.02)
        for _ in range(2):
            np.testing.assert_allclose(platform.vertical, unit(force), atol=1e-15)
            np.testing.assert_array_equal(platform.bias, 0.0)
            across = np.eye(3) - np.outer(unit(force), unit(force))
            np.testing.assert_allclose(platform.covariance[:3, :3], TILT_SIGMA**2 * across, atol=1e-15)
            np.testing.assert_allclose(platform.covariance[3:, 3:], 0.02**2 * np.eye(3), rtol=1e-15)
            level = platform.state["x"][LEVEL : LEVEL + 3]
            assert np.linalg.norm(level) == pytest.approx(1.0, abs=1e-15)
            assert level @ platform.vertical == pytest.approx(0.0, abs=1e-15)
            # What the filter learned from another motion is forgotten by a new start.
            for _ in range(20):
                platform.step(np.ones(3), np.full(3, 30.0))
            assert platform.state["unknown"] > 0.0
            start_platform(platform.parameters, platform.state, force)
            assert platform.state["unknown"] == platform.state["running"] == platform.state["noise"] == 0.0


@given(st.lists(st.floats(-60.0, 60.0), min_size=3, max_size=3), st.floats(1e-4, 2e-3))
def test_a_direction_turns_exactly(rate, period):
    x = unit([0.3, -0.5, 0.8])
    turned = x.copy()
    turn_direction(turned, tuple(rate), period)
    angle = period * np.linalg.norm(rate)
    np.testing.assert_allclose(turned, rotation_of(-period * np.array(rate)) @ x, rtol=0.0, atol=1e-3 * angle**7 + 1e-15)
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "seed"), [(0.05, 0), (0.1, 1), (0.15, 2)])
def test_with_a_known_acceleration_it_is_the_kalman_filter_that_takes_the_rest_for_gravity(noise, seed):
    """Over three thousand steps, to a fifth of the standard deviations, with less noise than the assumed 0.3 m/s2."""
    random = np.random.default_rng(seed)
    rotations, rates = tumbling(seed, 3000, speed=2.0)
    accelerations = random.normal(size=(3000, 3))
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + accelerations + random.normal(scale=noise, size=(3000, 3))
    gyroscope = np.concatenate([rates[:1], rates[:-1]]) + BIAS_RATE + random.normal(scale=2e-3, size=(3000, 3))
    platform = Platform(force[0] - accelerations[0])
    twin = Twin(platform.vertical, platform.covariance)
    for k, sample in enumerate(zip(gyroscope, force, accelerations, strict=True)):
        platform.step(*sample)
        twin.step(*sample)
        if k > 100:
            off = np.concatenate([platform.vertical, platform.bias]) - twin.x
            assert np.linalg.norm(off[:3]) < 0.2 * np.sqrt(np.trace(twin.covariance[:3, :3]))
            assert np.linalg.norm(off[3:]) < 0.2 * np.sqrt(np.trace(twin.covariance[3:, 3:]))
    across = np.linalg.svd(platform.vertical[None])[2][1:]
    for part, axes in ((slice(3), across), (slice(3, 6), np.eye(3))):
        np.testing.assert_allclose(
            axes @ platform.covariance[part, part] @ axes.T,
            axes @ twin.covariance[part, part] @ axes.T,
            rtol=0.0,
            atol=0.05 * np.trace(twin.covariance[part, part]),
        )


def test_a_single_jolt_tilts_a_settled_filter_by_less_than_an_ordinary_sample_might():
    """As when brakes open: 60 m/s^2 for one sample, which nothing else knows of. Nor does it do so afterwards."""
    platform = Platform(GRAVITY * UP)
    for _ in range(2000):
        platform.step(np.zeros(3), GRAVITY * UP)
    covariance = platform.covariance
    unlimited = Twin(platform.vertical, covariance, innovation_limit=np.inf)
    largest_gain = covariance[0, 0] / (covariance[0, 0] + NOISE[2])
    allowed = INNOVATION_LIMIT * largest_gain * np.sqrt(covariance[0, 0] + NOISE[2])
    jolt = (np.zeros(3), GRAVITY * UP + [60.0, 0.0, 0.0], np.zeros(3))
    platform.step(*jolt)
    unlimited.step(*jolt)
    assert tilt_error(unlimited.x[:3], np.eye(3)) > 5.0 * allowed
    for _ in range(3000):
        assert tilt_error(platform.vertical, np.eye(3)) < allowed
        platform.step(np.zeros(3), GRAVITY * UP)


@pytest.mark.slow
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.0, 1.0)])
def test_a_constant_turn_is_tracked_and_its_bias_found(axis):
    """Ten seconds of 1 rad/s, upside down and back again, with a bias on every axis."""
    rate, rotation = np.array(axis), rotation_of([0.2, -0.1, 0.0])
    platform = Platform(GRAVITY * rotation.T @ UP)
    errors = []
    for _ in range(10_000):
        rotation = rotation @ rotation_of(PERIOD_S * rate)
        platform.step(rate + BIAS_RATE, GRAVITY * rotation.T @ UP)
        errors.append(tilt_error(platform.vertical, rotation))
    assert max(errors[5000:]) < 0.01 * DEGREE
    # About the vertical a gyroscope's bias cannot be seen; across it, it is found.
    across = np.eye(3) - np.outer(rotation.T @ UP, rotation.T @ UP)
    assert np.linalg.norm(across @ (platform.bias - BIAS_RATE)) < 0.05 * DEGREE


@pytest.mark.parametrize("turn", [0.3, 0.8])
def test_a_slow_turn_between_faster_ones_is_not_taken_for_a_bias(turn):
    """As in a slow motion that turns back every now and then: a second of so many deg/s, then a quarter of 2 deg/s."""
    up = rotation_of([0.3, -0.2, 0.0]).T @ UP
    platform = Platform(GRAVITY * up)
    for cycle in range(10_000):
        rate = turn if cycle % 1250 < 1000 else -2.0
        platform.step(rate * DEGREE * up, GRAVITY * up)
    assert abs(up @ platform.bias) < 1e-3 * DEGREE


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize(("turn", "believed"), [(0.0, True), (0.05, True), (2.0, False)])
def test_at_rest_the_bias_about_the_vertical_is_found_to_a_slow_turn_but_no_turn_is_taken_for_it(turn, believed, noise):
    """Five seconds askew, turning about the vertical at so many deg/s, with the bias of a calibrated gyroscope."""
    random, rotation = np.random.default_rng(3), rotation_of([0.3, -0.2, 0.0])
    up = rotation.T @ UP
    platform = Platform(GRAVITY * up)
    for _ in range(5000):
        rate = turn * DEGREE * up + BIAS_RATE
        platform.step(rate + random.normal(scale=noise, size=3), GRAVITY * up + random.normal(scale=10.0 * noise, size=3))
    deviation = np.sqrt(up @ platform.covariance[3:, 3:] @ up)
    if believed:
        assert abs(up @ (platform.bias - BIAS_RATE)) < 1.5 * SLOW_TURN
        assert 0.95 * SLOW_TURN < deviation <= SLOW_TURN
    else:
        assert abs(up @ platform.bias) < 1e-3 * DEGREE and deviation > 0.99 * FUSION.bias_sigma


def test_the_platforms_own_acceleration_is_taken_out_when_it_is_given():
    rotations, rates = tumbling(4, 4000, speed=0.3)
    times = PERIOD_S * np.arange(4000)[:, None]
    in_base = 1.5 * np.sin(2.0 * np.pi * np.array([0.7, 0.9, 1.1]) * times)
    in_platform = np.einsum("nji,nj->ni", rotations, in_base)
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + in_platform
    informed, uninformed = Platform(GRAVITY * rotations[0].T @ UP), Platform(GRAVITY * rotations[0].T @ UP)
    errors = []
    for k in range(4000):
        # The rate that leads from the sample before to this one.
        rate = rates[k - 1] if k else rates[0]
        informed.step(rate, force[k], in_platform[k])
        uninformed.step(rate, force[k])
        errors.append([tilt_error(filtered.vertical, rotations[k]) for filtered in (informed, uninformed)])
    informed_rms, uninformed_rms = np.sqrt(np.mean(np.square(errors[500:]), axis=0))
    assert informed_rms < 0.002 * DEGREE
    assert uninformed_rms > 50.0 * informed_rms


@pytest.mark.parametrize("rate", [100.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_an_unknown_acceleration_of_10_m_s2_moves_the_vertical_by_less_than_a_degree_and_is_forgotten_at_rest(rate):
    """Half a minute of sines along all axes, then rest: the filter sees both, and weighs the accelerometer accordingly."""
    random, times = np.random.default_rng(7), np.arange(round(60.0 * rate)) / rate
    moving = np.clip(np.minimum(times - 5.0, 40.0 - times), 0.0, 1.0)[:, None]
    acceleration = moving * 8.0 * np.sin(2.0 * np.pi * np.array([0.9, 1.3, 1.7]) * times[:, None])
    rates = moving * np.sin(2.0 * np.pi * np.array([0.3, 0.4, 0.5]) * times[:, None])
    rotation, platform, errors, excess = rotation_of([0.2, -0.1, 0.0]), None, [], []
    scale = np.sqrt(rate / 2.0)
    for k in range(len(times)):
        rotation = rotation @ rotation_of(rates[k] / rate)
        force = rotation.T @ (GRAVITY * UP + acceleration[k]) + random.normal(scale=0.004 * scale, size=3)
        platform = platform or Platform(force, period=1.0 / rate)
        platform.step(rates[k] + BIAS_RATE + random.normal(scale=1e-4 * scale, size=3), force)
        errors.append(tilt_error(platform.vertical, rotation))
        excess.append(float(platform.state["unknown"]))
    errors = np.array(errors)
    at_rest, moved, again = times < 5.0, (times > 10.0) & (times < 39.0), times > 55.0
    assert np.max(errors[moved]) < 1.0 * DEGREE
    assert np.max(errors[again]) < 0.3 * DEGREE
    assert max(np.array(excess)[at_rest]) < 1e-4
    assert min(np.array(excess)[moved]) > 0.05
    assert excess[-1] < 0.02 * max(excess)


def test_a_clipped_rate_leaves_the_vertical_as_uncertain_as_a_constant_acceleration_beyond_the_range_turns_it():
    platform, period = Platform(GRAVITY * UP, period=1e-4), 1e-4
    platform.parameters["force_variance"] = platform.state["force_variance"] = 1e12
    before = platform.covariance
    for k in range(1, 3001):
        platform.step(np.zeros(3), GRAVITY * UP, clipped=True)
        if k % 1000 == 0:
            grown = np.diagonal(platform.covariance - before)[:2] - (k * period * FUSION.bias_sigma) ** 2
            beyond = UNSEEN_ACCELERATION * (k * period) ** 2 / 2.0
            np.testing.assert_allclose(np.sqrt(grown), beyond, rtol=5e-3)
    platform.step(np.zeros(3), GRAVITY * UP)
    assert platform.state["clipped_for"] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_what_a_clipped_rate_turns_the_vertical_is_forgotten_within_two_seconds_on_a_shaken_platform(seed):
    """A turn of half a second at up to 4.8 rad/s, of which a gyroscope shows 4 rad/s: 15 degrees are lost."""
    random, rate, reach = np.random.default_rng(seed), 250.0, 4.0
    times = np.arange(round(14.0 * rate)) / rate
    turns = np.zeros((len(times), 3))
    turns[:, 0] = np.where(abs(times - 8.0) < 0.25, reach + 0.8 * np.cos(2.0 * np.pi * (times - 8.0)), 0.0)
    shaking = 6.0 * np.sin(2.0 * np.pi * random.uniform(6.0, 20.0, 3) * times[:, None] + random.uniform(0.0, 6.3, 3))
    rotation, errors = np.eye(3), []
    knowing, ignorant = (Platform(GRAVITY * UP, period=1.0 / rate) for _ in range(2))
    for turn, shaken in zip(turns, shaking, strict=True):
        rotation = rotation @ rotation_of(turn / rate)
        reading, force = np.minimum(turn, reach), rotation.T @ (GRAVITY * UP + shaken)
        knowing.step(reading, force, clipped=turn[0] >= reach)
        ignorant.step(reading, force)
        errors.append([tilt_error(platform.vertical, rotation) for platform in (knowing, ignorant)])
    errors, soon = np.array(errors), times > 10.25
    assert np.max(errors[:, 0]) > 10.0 * DEGREE
    assert np.max(errors[soon, 0]) < 0.5 * DEGREE
    assert np.max(errors[soon, 1]) > 5.0 * DEGREE


def test_the_vertical_stays_unit_and_the_covariance_positive_definite_over_twenty_seconds():
    random = np.random.default_rng(5)
    rotations, rates = tumbling(5, 20_000, speed=3.0)
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + random.normal(scale=1.0, size=(20_000, 3))
    gyroscope = rates + BIAS_RATE + random.normal(scale=5e-3, size=(20_000, 3))
    platform = Platform(force[0])
    for k in range(20_000):
        platform.step(gyroscope[k], force[k])
        if k % 100 == 99:
            assert abs(np.linalg.norm(platform.vertical) - 1.0) < 1e-15
            covariance = platform.state["covariance"]
            scale = np.sqrt(np.diag(covariance))
            correlation = covariance / np.outer(scale, scale)
            np.testing.assert_allclose(correlation, correlation.T, rtol=0.0, atol=1e-14)
            assert np.linalg.eigvalsh(correlation).min() > 1e-9
    assert tilt_error(platform.vertical, rotations[-1]) < 1.0 * DEGREE


@pytest.mark.slow
def test_settled_errors_are_as_large_as_the_covariance_says():
    errors = []
    for seed in range(40):
        random = np.random.default_rng(seed)
        rotations, rates = tumbling(seed, 1500, speed=0.5)
        bias = random.normal(scale=FUSION.bias_sigma, size=3)
        platform = Platform(GRAVITY * rotations[0].T @ UP + random.normal(scale=0.2, size=3))
        for k in range(1, 1500):
            gyroscope = rates[k - 1] + bias + random.normal(scale=np.sqrt(NOISE[0] / PERIOD_S), size=3)
            force = GRAVITY * (rotations[k].T @ UP + random.normal(scale=np.sqrt(NOISE[2]), size=3))
            platform.step(gyroscope, force)
        across = np.linalg.svd(platform.vertical[None])[2][1:]
        error = across @ (rotations[-1].T @ UP - platform.vertical)
        errors.append(error @ np.linalg.solve(across @ platform.covariance[:3, :3] @ across.T, error))
    # Two degrees of freedom each: the mean of forty lies within 1.2 to 3.0 but once in a thousand times.
    assert 1.2 < np.mean(errors) < 3.0
