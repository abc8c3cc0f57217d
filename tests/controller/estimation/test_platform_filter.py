"""The platform's roll-pitch filter: against a Kalman filter in plain NumPy, and on simulated platforms."""

import numpy as np
import pytest

from controller.estimation.platform_filter import INNOVATION_LIMIT, STATES, TILT_SIGMA, start_platform, step_platform
from controller.settings import FusionSettings
from tests.controller.leg_geometry import UP, rotation_of, skew, unit

GRAVITY = 9.81
PERIOD_S = 1e-3
DEGREE = np.pi / 180.0
BIAS = np.radians([0.3, -0.2, 0.1])
FUSION = FusionSettings()
FORCE_VARIANCE = FUSION.platform_accelerometer_noise**2 / (2.0 * PERIOD_S)
NOISE = (FUSION.gyroscope_noise**2, FUSION.bias_walk**2, FORCE_VARIANCE / GRAVITY**2)


class Platform:
    """The compiled filter with the arrays that it works on."""

    def __init__(self, accelerometer, bias_sigma=FUSION.bias_sigma):
        self.x, self.covariance = np.zeros(STATES), np.full((STATES, STATES), np.nan)
        self._scratch = (np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6), np.zeros(6))
        start_platform(self.x, self.covariance, accelerometer, bias_sigma)

    def step(self, gyroscope, accelerometer, acceleration=(0.0, 0.0, 0.0)):
        sample = (gyroscope, accelerometer, np.asarray(acceleration, dtype=float))
        step_platform(self.x, self.covariance, *sample, PERIOD_S, GRAVITY, *NOISE, *self._scratch)

    @property
    def vertical(self):
        return self.x[:3]


class Twin:
    """The same Kalman filter with matrices, one axis of the accelerometer after the other, each cut to its limit."""

    def __init__(self, x, covariance, innovation_limit=INNOVATION_LIMIT):
        self.x, self.covariance, self.limit = x.copy(), covariance.copy(), innovation_limit

    def step(self, gyroscope, accelerometer, acceleration):
        rate_density, bias_walk, variance = NOISE
        u, w = self.x[:3], gyroscope - self.x[3:]
        turned = np.cross(u, w)
        forward = np.eye(STATES)
        forward[:3, :3] -= PERIOD_S * skew(w)
        forward[:3, 3:] = -PERIOD_S * skew(u)
        x = np.concatenate([u + PERIOD_S * turned + PERIOD_S**2 / 2.0 * np.cross(turned, w), self.x[3:]])
        covariance = forward @ self.covariance @ forward.T + PERIOD_S * np.diag([rate_density] * 3 + [bias_walk] * 3)
        for seen, reading in zip(np.eye(STATES)[:3], (accelerometer - acceleration) / GRAVITY, strict=True):
            spread = seen @ covariance @ seen + variance
            gain = covariance @ seen / spread
            bound = self.limit * np.sqrt(spread)
            x = x + gain * np.clip(reading - seen @ x, -bound, bound)
            covariance = (np.eye(STATES) - np.outer(gain, seen)) @ covariance
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
    for force in (GRAVITY * UP, 0.01 * unit([1.0, 2.0, -3.0]), -GRAVITY * UP):
        platform = Platform(force, 0.02)
        np.testing.assert_allclose(platform.vertical, unit(force), atol=1e-15)
        np.testing.assert_array_equal(platform.x[3:], 0.0)
        np.testing.assert_allclose(platform.covariance, np.diag([TILT_SIGMA**2] * 3 + [0.02**2] * 3), rtol=1e-15)


@pytest.mark.parametrize(("noise", "seed"), [(0.1, 0), (0.1, 1), (0.4, 2), (3.0, 3)])
def test_three_thousand_steps_agree_with_a_kalman_filter_in_numpy(noise, seed):
    random = np.random.default_rng(seed)
    rotations, rates = tumbling(seed, 3000, speed=2.0)
    accelerations = random.normal(size=(3000, 3))
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + accelerations + random.normal(scale=noise, size=(3000, 3))
    gyroscope = rates + BIAS + random.normal(scale=2e-3, size=(3000, 3))
    platform = Platform(force[0])
    twin = Twin(platform.x, platform.covariance)
    worst = 0.0
    for sample in zip(gyroscope, force, accelerations, strict=True):
        platform.step(*sample)
        twin.step(*sample)
        scale = np.sqrt(np.diag(twin.covariance))
        off = (platform.covariance - twin.covariance) / np.outer(scale, scale)
        worst = max(worst, np.abs(platform.x - twin.x).max(), np.abs(off).max())
    assert worst < 1e-12


def test_a_single_jolt_tilts_a_settled_filter_by_no_more_than_an_ordinary_sample_might():
    """As when brakes open: 60 m/s^2 for one sample, which nothing else knows of."""
    platform = Platform(GRAVITY * UP)
    for _ in range(2000):
        platform.step(np.zeros(3), GRAVITY * UP)
    unlimited = Twin(platform.x, platform.covariance, innovation_limit=np.inf)
    largest_gain = platform.covariance[0, 0] / (platform.covariance[0, 0] + NOISE[2])
    allowed = INNOVATION_LIMIT * largest_gain * np.sqrt(platform.covariance[0, 0] + NOISE[2])
    jolt = (np.zeros(3), GRAVITY * UP + [60.0, 0.0, 0.0], np.zeros(3))
    platform.step(*jolt)
    unlimited.step(*jolt)
    assert 0.5 * allowed < tilt_error(platform.vertical, np.eye(3)) < 1.1 * allowed
    assert tilt_error(unlimited.x[:3], np.eye(3)) > 5.0 * allowed


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8), (0.0, 0.0, 1.0)])
def test_a_constant_turn_is_tracked_and_its_bias_found(axis):
    """Ten seconds of 1 rad/s, upside down and back again, with a bias on every axis."""
    rate, rotation = np.array(axis), rotation_of([0.2, -0.1, 0.0])
    platform = Platform(GRAVITY * rotation.T @ UP)
    errors = []
    for _ in range(10_000):
        rotation = rotation @ rotation_of(PERIOD_S * rate)
        platform.step(rate + BIAS, GRAVITY * rotation.T @ UP)
        errors.append(tilt_error(platform.vertical, rotation))
    assert max(errors[5000:]) < 0.01 * DEGREE
    # About the vertical a gyroscope's bias cannot be seen; across it, it is found.
    across = np.eye(3) - np.outer(rotation.T @ UP, rotation.T @ UP)
    assert np.linalg.norm(across @ (platform.x[3:] - BIAS)) < 0.05 * DEGREE


def test_the_platforms_own_acceleration_is_taken_out_when_it_is_given():
    rotations, rates = tumbling(4, 4000, speed=0.3)
    times = PERIOD_S * np.arange(4000)[:, None]
    in_base = 1.5 * np.sin(2.0 * np.pi * np.array([0.7, 0.9, 1.1]) * times)
    in_platform = np.einsum("nji,nj->ni", rotations, in_base)
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + in_platform
    informed, misled = Platform(GRAVITY * rotations[0].T @ UP), Platform(GRAVITY * rotations[0].T @ UP)
    errors = []
    for k in range(4000):
        # The rate that leads from the sample before to this one.
        rate = rates[k - 1] if k else rates[0]
        informed.step(rate, force[k], in_platform[k])
        misled.step(rate, force[k])
        errors.append([tilt_error(filtered.vertical, rotations[k]) for filtered in (informed, misled)])
    best, worst = np.sqrt(np.mean(np.square(errors[500:]), axis=0))
    assert best < 0.002 * DEGREE
    assert worst > 50.0 * best


def test_the_vertical_stays_unit_and_the_covariance_positive_definite_over_twenty_seconds():
    random = np.random.default_rng(5)
    rotations, rates = tumbling(5, 20_000, speed=3.0)
    force = np.einsum("nji,j->ni", rotations, GRAVITY * UP) + random.normal(scale=1.0, size=(20_000, 3))
    gyroscope = rates + BIAS + random.normal(scale=5e-3, size=(20_000, 3))
    platform = Platform(force[0])
    for k in range(20_000):
        platform.step(gyroscope[k], force[k])
        if k % 100 == 0:
            assert abs(np.linalg.norm(platform.vertical) - 1.0) < 1e-15
            scale = np.sqrt(np.diag(platform.covariance))
            correlation = platform.covariance / np.outer(scale, scale)
            np.testing.assert_allclose(correlation, correlation.T, rtol=0.0, atol=1e-14)
            assert np.linalg.eigvalsh(correlation).min() > 1e-9
    assert tilt_error(platform.vertical, rotations[-1]) < 1.0 * DEGREE


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
