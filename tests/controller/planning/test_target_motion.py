"""The motion of a streamed target: exact samples are followed without lag, and noise is not taken for motion."""

import numpy as np
import pytest

from controller.planning.target_motion import TargetMotion

AHEAD_S = 0.04
"""As far as plans mostly aim."""


def fed(times, lengths, velocity=0.25):
    motion = TargetMotion(times[0], lengths[0], velocity)
    for time, sample in zip(times[1:], lengths[1:], strict=True):
        motion.add(time, sample)
    return motion


def six(values):
    return np.outer(values, np.linspace(0.5, 1.0, 6)) + 0.4


@pytest.mark.parametrize("rate", [30.0, 100.0, 200.0])
def test_an_even_acceleration_is_continued_exactly_for_50_ms_and_then_its_speed(rate):
    times = np.arange(0.0, 0.4, 1.0 / rate)
    motion = fed(times, six(0.02 * times + 0.1 * times**2))
    for ahead in (0.0, 0.02, 0.05, 0.1):
        bent = times[-1] + min(ahead, 0.05)
        speed = 0.02 + 0.2 * bent
        lengths, rates = motion.at(ahead)
        np.testing.assert_allclose(rates, six([speed])[0] - 0.4, atol=1e-9)
        place = 0.02 * bent + 0.1 * bent**2 + max(ahead - 0.05, 0.0) * speed
        np.testing.assert_allclose(lengths, six([place])[0], atol=1e-10)


def test_no_speed_is_above_the_legs(rate=100.0):
    times = np.arange(0.0, 0.3, 1.0 / rate)
    lengths, rates = fed(times, six(0.35 * times)).at(0.1)
    assert rates.max() == 0.25 and rates.min() == pytest.approx(0.5 * 0.35)
    assert np.abs(lengths - fed(times, six(0.35 * times)).at(0.05)[0]).max() <= 0.25 * 0.05 + 1e-9


def test_a_target_that_stands_still_does_so_to_the_bit():
    lengths = six(0.01 * np.ones(40))
    found, rates = fed(0.01 * np.arange(40), lengths).at(AHEAD_S)
    assert (found == lengths[-1]).all() and not rates.any()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("rate", [100.0, 1000.0])
def test_noise_of_a_standing_target_is_not_taken_for_motion(rate, seed):
    """A curve through the last samples would be five times as far off as they are."""
    random = np.random.default_rng(seed)
    times = np.arange(0.0, 3.0, 1.0 / rate)
    noise = random.normal(size=(len(times), 6)) * 1e-3
    motion, off, speeds = TargetMotion(0.0, noise[0], 0.25), [], []
    for time, sample in zip(times[1:], noise[1:], strict=True):
        motion.add(time, sample)
        if time > 0.5:
            lengths, rates = motion.at(AHEAD_S)
            off.append(lengths)
            speeds.append(rates)
    assert np.sqrt(np.mean(np.square(off))) < 0.6e-3
    assert np.sqrt(np.mean(np.square(speeds))) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22])
@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.1e-3), (1e-5, 0.15e-3), (1e-4, 0.5e-3), (1e-3, 3e-3)])
def test_a_moving_target_is_met_as_well_as_its_noise_allows(noise, most, seed):
    random = np.random.default_rng(seed)
    times = np.arange(0.0, 4.0, 0.01)

    def true(t):
        return six(0.012 * np.sin(2.0 * np.pi * 0.5 * np.asarray(t)))

    samples = true(times) + noise * random.normal(size=(len(times), 6))
    motion, off = TargetMotion(0.0, samples[0], 0.25), []
    for time, sample in zip(times[1:], samples[1:], strict=True):
        motion.add(time, sample)
        if time > 0.5:
            off.append(motion.at(AHEAD_S)[0] - true([time + AHEAD_S])[0])
    assert np.sqrt(np.mean(np.square(off))) < most


def test_how_densely_a_motion_is_sampled_does_not_matter():
    def met(rate):
        times = np.arange(0.0, 1.0 + 0.5 / rate, 1.0 / rate)
        return fed(times, six(0.012 * np.sin(2.0 * np.pi * 0.7 * times))).at(AHEAD_S)

    for rate in (250.0, 1000.0, 5000.0):
        for dense, usual in zip(met(rate), met(100.0), strict=True):
            np.testing.assert_allclose(dense, usual, atol=5e-4)
