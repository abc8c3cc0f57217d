"""Free motions: readings that fit the motion, spectra, and seeds."""

import numpy as np
import pytest

from plant.dynamics.free_motion import ACCELERATION, SPECTRA, STILL_S, move_freely
from plant.errors import InputError, UnknownNameError
from plant.imu import STANDARD_GRAVITY
from tests.controller.leg_geometry import rotation_of

RATE_HZ, DURATION_S = 200.0, 30.0


@pytest.mark.parametrize("kind", SPECTRA)
def test_the_readings_are_those_of_the_motion(kind):
    motion = move_freely(kind, DURATION_S, RATE_HZ, 3)
    at_rest, moving = motion.times < STILL_S, motion.times >= STILL_S
    assert len(motion.times) == round(DURATION_S * RATE_HZ)
    np.testing.assert_array_equal(motion.rates[at_rest], 0.0)
    np.testing.assert_allclose(motion.rotations[0].T @ [0.0, 0.0, STANDARD_GRAVITY], motion.forces[0], atol=1e-12)
    for k in (700, 1500, 5000):
        turned = motion.rotations[k - 1] @ rotation_of(motion.rates[k] / RATE_HZ)
        np.testing.assert_allclose(motion.rotations[k], turned, atol=1e-12)
    accelerations = np.einsum("nij,nj->ni", motion.rotations, motion.forces) - [0.0, 0.0, STANDARD_GRAVITY]
    size = np.sqrt(np.mean(np.sum(accelerations[moving] ** 2, axis=1)))
    assert 0.8 * ACCELERATION < size < 1.2 * ACCELERATION
    assert 1.5 < np.sqrt(np.mean(np.sum(motion.rates[moving] ** 2, axis=1))) < 2.5


@pytest.mark.parametrize(("kind", "band"), [("0.3-5 Hz", (0.3, 5.0)), ("5-40 Hz", (5.0, 40.0)), ("sines", (0.5, 3.0))])
def test_the_acceleration_lies_in_its_band(kind, band):
    motion = move_freely(kind, DURATION_S, RATE_HZ, 1, still=0.0)
    accelerations = np.einsum("nij,nj->ni", motion.rotations, motion.forces) - [0.0, 0.0, STANDARD_GRAVITY]
    powers = np.sum(np.abs(np.fft.rfft(accelerations * np.hanning(len(accelerations))[:, None], axis=0)) ** 2, axis=1)
    frequencies = np.fft.rfftfreq(len(accelerations), 1.0 / RATE_HZ)
    inside = (frequencies > band[0] - 0.1) & (frequencies < band[1] + 0.1)
    assert powers[inside].sum() > 0.99 * powers.sum()


def test_a_seed_gives_the_same_motion_again_and_another_one_another():
    first, again, other = (move_freely("bursts", DURATION_S, RATE_HZ, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.forces, again.forces)
    assert np.abs(first.forces - other.forces).max() > 1.0


def test_what_is_no_kind_and_no_seed_is_refused():
    with pytest.raises(UnknownNameError, match="there is no free motion 'jumps'; there are sines, steps"):
        move_freely("jumps", DURATION_S, RATE_HZ, 1)
    with pytest.raises(InputError, match="seed"):
        move_freely("sines", DURATION_S, RATE_HZ, -1)
    with pytest.raises(InputError, match="the duration is 5 s; a free motion takes at least 20 s"):
        move_freely("sines", 5.0, RATE_HZ, 1)
