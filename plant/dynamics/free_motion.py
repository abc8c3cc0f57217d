"""Free motion: a body that accelerates and turns with no legs to tell how, and the ideal readings of an IMU on it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plant.checks import checked_seed
from plant.errors import InputError, UnknownNameError
from plant.imu import STANDARD_GRAVITY
from plant.pose import Array, rotation_from_vector

ACCELERATION = 10.0
"""Root of the mean square of the acceleration, over all axes together [m/s^2]."""

STILL_S = 3.0
"""For how long the body rests before it moves."""

_LEAST_S = 20.0
_EASING_S = 0.5
_TURNING_HZ = (0.05, 1.5)


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """A prescribed motion and the ideal readings of its IMU."""

    times: Array  # (N,) [s]
    rotations: Array  # (N, 3, 3), from the body to a frame with z up
    rates: Array  # (N, 3) [rad/s], which lead from the sample before to this one
    forces: Array  # (N, 3) [m/s^2]


def move_freely(kind: str, duration: float, rate: float, seed: int, turning: float = 2.0, still: float = STILL_S) -> FreeMotion:
    """A motion of a kind (`SPECTRA`), in samples at `rate` [Hz] for `duration` [s], of which the first `still` [s] are at rest.

    Args:
        kind: by what its acceleration is made up.
        turning: root of the mean square of the angular velocity, over all axes together [rad/s].

    Raises:
        UnknownNameError: no such kind.
        InputError: too short a motion, or a negative seed.
    """
    if not duration >= _LEAST_S:
        raise InputError(f"the duration is {duration:g} s; a free motion takes at least {_LEAST_S:g} s")
    if kind not in SPECTRA:
        raise UnknownNameError(f"there is no free motion {kind!r}; there are {', '.join(SPECTRA)}")
    random = np.random.default_rng([checked_seed(seed), *kind.encode()])
    times = np.arange(round(duration * rate)) / rate
    eased = np.clip((times - still) / _EASING_S, 0.0, 1.0)[:, None]
    eased = eased**2 * (3.0 - 2.0 * eased)
    # What is eased is the velocity, so that the body does not drift away.
    velocities = eased * _integral(_of_size(ACCELERATION, SPECTRA[kind](times, random)), rate)
    accelerations = rate * np.diff(velocities, axis=0, prepend=0.0)
    rates = eased * _of_size(turning, _noise(times, random, *_TURNING_HZ))
    rotation, rotations = rotation_from_vector(random.uniform(-0.5, 0.5, 3)), np.empty((len(times), 3, 3))
    for i, turn in enumerate(rates / rate):
        rotation = rotation @ rotation_from_vector(turn)
        rotations[i] = rotation
    forces = np.einsum("nji,nj->ni", rotations, accelerations + np.array([0.0, 0.0, STANDARD_GRAVITY]))
    return FreeMotion(times, rotations, rates, forces)


def _of_size(size: float, values: Array) -> Array:
    """The values (N, n) scaled to this root of their mean square, over all columns together."""
    scaled: Array = values * size / np.sqrt(np.mean(np.sum(values**2, axis=1)))
    return scaled


def _integral(values: Array, rate: float) -> Array:
    """The integral over time (N, n) of values at this rate [Hz], without a mean."""
    spectrum, frequencies = np.fft.rfft(values, axis=0), np.fft.rfftfreq(len(values), 1.0 / rate)
    spectrum[0] = 0.0
    spectrum[1:] /= 2j * np.pi * frequencies[1:, None]
    return np.fft.irfft(spectrum, len(values), axis=0)


def _noise(times: Array, random: np.random.Generator, lowest: float, highest: float, slope: float = 0.0) -> Array:
    """Noise (N, 3) from `lowest` to `highest` [Hz], whose amplitudes go with a power of the frequency."""
    frequencies = np.fft.rfftfreq(len(times), times[1] - times[0])
    inside = (frequencies >= lowest) & (frequencies <= highest)
    amplitudes = np.zeros((len(frequencies), 3), complex)
    shape = (int(inside.sum()), 3)
    amplitudes[inside] = (random.normal(size=shape) + 1j * random.normal(size=shape)) * frequencies[inside, None] ** slope
    return np.fft.irfft(amplitudes, len(times), axis=0)


def _sines(times: Array, random: np.random.Generator) -> Array:
    """One sine an axis."""
    frequencies, phases = random.uniform(0.5, 3.0, 3), random.uniform(0.0, 2.0 * np.pi, 3)
    waves: Array = np.sin(2.0 * np.pi * frequencies * times[:, None] + phases)
    return waves


def _steps(times: Array, random: np.random.Generator) -> Array:
    """As of somebody who walks: five harmonics of about 1 Hz an axis, whose pace wanders."""
    pace = 2.0 * np.pi * (random.uniform(0.8, 1.2) + 0.1 * _of_size(1.0, _noise(times, random, 0.05, 0.5))[:, 0])
    phase = np.cumsum(pace) * (times[1] - times[0])
    harmonics, sizes, phases = np.arange(1, 6)[:, None], random.normal(size=(5, 3)), random.uniform(0.0, 2.0 * np.pi, (5, 3))
    waves: Array = np.sum(sizes * np.sin(harmonics * phase[:, None, None] + phases), axis=1)
    return waves


def _bursts(times: Array, random: np.random.Generator) -> Array:
    """Noise of 0.5 to 5 Hz that comes and goes within seconds."""
    wave = _of_size(1.0, _noise(times, random, 0.02, 0.1))[:, :1]
    bursts: Array = _noise(times, random, 0.5, 5.0) / (1.0 + np.exp(-20.0 * (wave - 0.3)))
    return bursts


SPECTRA: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "sines": _sines,
    "steps": _steps,
    "bursts": _bursts,
    "0.3-5 Hz": lambda times, random: _noise(times, random, 0.3, 5.0),
    "5-40 Hz": lambda times, random: _noise(times, random, 5.0, 40.0),
    "0.1-10 Hz, pink": lambda times, random: _noise(times, random, 0.1, 10.0, -0.5),
    "0.05-3 Hz, white velocity": lambda times, random: _noise(times, random, 0.05, 3.0, 1.0),
}
"""What the acceleration is made of."""
