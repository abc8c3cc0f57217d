"""Waves: displacements over time, to be added up."""

from dataclasses import dataclass
from math import inf
from pathlib import Path
from sys import float_info

import numpy as np

from controller.planning.motions.splines import curve_at, natural_spline
from plant.checks import checked_seed, nearest
from plant.csv import read_csv
from plant.errors import InputError
from plant.pose import Array

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Displacements along the axes [m], and turns about them, as components of a rotation vector [rad]."""

COLUMNS = ("time_s", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
"""Of a file of samples."""

MOST_HZ = 50.0
"""The fastest wave; drives are slower."""

_MOST_SINES = 400
"""Noise has as many sines at most."""


def checked_number(value: float, name: str, least: float = -inf, most: float = inf) -> float:
    """A finite number within limits, or an `InputError`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= float_info.max:
        raise InputError(f"{name} is {value!r}; it must be a finite number")
    if not least <= value <= most:
        bounds = f"at least {least:g}" if most == inf else f"{least:g} to {most:g}"
        raise InputError(f"{name} is {value:g}; it must be {bounds}")
    return float(value)


def read_samples(path: Path, what: str, least: int, *headers: tuple[str, ...]) -> tuple[tuple[str, ...], Array]:
    """The columns (m) and rows (N, m) of a CSV file with one of these headers, whose first column is an increasing time.

    Raises:
        InputError: the file cannot be read, is malformed, out of order, or has less than `least` samples for `what` it is.
    """
    columns, table, lines = read_csv(path, *headers)
    if len(table) < least:
        raise InputError(f"{path} has {len(table)} samples; {what} needs at least {least}")
    late = np.flatnonzero(np.diff(table[:, 0]) <= 0.0)
    if len(late):
        row = int(late[0]) + 1
        raise InputError(f"{path}, line {lines[row]}: time {table[row, 0]:g} s does not come after {table[row - 1, 0]:g} s")
    return columns, table


def _axis(name: str) -> int:
    if name not in AXES:
        raise InputError(f"axis is {name!r}; it must be one of {', '.join(AXES)}{nearest(str(name), AXES)}")
    return AXES.index(name)


def _two_axes(names: tuple[str, str]) -> list[int]:
    if len(names) != 2 or names[0] == names[1]:
        raise InputError(f"axes is {names!r}; it must be two different ones of {', '.join(AXES)}")
    found = [_axis(name) for name in names]
    if (found[0] < 3) != (found[1] < 3):
        raise InputError(f"axes is {names!r}; both must be displacements, x, y, z, or both turns, rx, ry, rz")
    return found


def _on(count: int, **columns: Array) -> Array:
    moved = np.zeros((count, 6))
    for axis, values in columns.items():
        moved[:, AXES.index(axis)] = values
    return moved


@dataclass(frozen=True)
class Sine:
    """A sine on an axis."""

    axis: str
    amplitude: float  # at its peaks, on a turn an angle [m or rad]
    frequency: float  # [Hz]
    phase: float = 0.0  # at the beginning [rad]

    def __post_init__(self) -> None:
        _axis(self.axis)
        checked_number(self.amplitude, "amplitude")
        checked_number(self.frequency, "frequency", 0.0, MOST_HZ)
        checked_number(self.phase, "phase")

    @property
    def fastest(self) -> float:
        """The highest frequency [Hz]."""
        return self.frequency

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        return _on(len(times), **{self.axis: self.amplitude * np.sin(2.0 * np.pi * self.frequency * times + self.phase)})


@dataclass(frozen=True)
class Chirp:
    """A sine whose frequency goes from one to another within `duration`, by the same factor in the same time."""

    axis: str
    amplitude: float  # at its peaks, on a turn an angle [m or rad]
    from_frequency: float  # [Hz]
    to_frequency: float  # [Hz]
    duration: float  # [s]; then the frequency stays

    def __post_init__(self) -> None:
        _axis(self.axis)
        checked_number(self.amplitude, "amplitude")
        checked_number(self.from_frequency, "from_frequency", 1e-3, MOST_HZ)
        checked_number(self.to_frequency, "to_frequency", 1e-3, MOST_HZ)
        checked_number(self.duration, "duration", 1e-3)

    @property
    def fastest(self) -> float:
        """The highest frequency [Hz]."""
        return max(self.from_frequency, self.to_frequency)

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        growth = np.log(self.to_frequency / self.from_frequency) / self.duration
        swept = np.minimum(times, self.duration)
        turns = self.from_frequency * (swept if growth == 0.0 else np.expm1(growth * swept) / growth)
        turns = turns + self.to_frequency * np.maximum(times - self.duration, 0.0)
        return _on(len(times), **{self.axis: self.amplitude * np.sin(2.0 * np.pi * turns)})


@dataclass(frozen=True)
class Circle:
    """A circle about where the wave begins, in the plane of two axes."""

    axes: tuple[str, str]
    radius: float  # of turns an angle [m or rad]
    frequency: float  # turns per second [Hz]

    def __post_init__(self) -> None:
        _two_axes(self.axes)
        checked_number(self.radius, "radius", 0.0)
        checked_number(self.frequency, "frequency", 0.0, MOST_HZ)

    @property
    def fastest(self) -> float:
        """The highest frequency [Hz]."""
        return self.frequency

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        angle = 2.0 * np.pi * self.frequency * times
        return _on(len(times), **{self.axes[0]: self.radius * np.cos(angle), self.axes[1]: self.radius * np.sin(angle)})


@dataclass(frozen=True)
class FigureEight:
    """A figure eight through where the wave begins: the second axis goes to and fro twice as often as the first."""

    axes: tuple[str, str]
    amplitudes: tuple[float, float]  # at its peaks, of turns angles [m or rad]
    frequency: float  # of the whole figure [Hz]

    def __post_init__(self) -> None:
        _two_axes(self.axes)
        if len(self.amplitudes) != 2:
            raise InputError(f"amplitudes is {self.amplitudes!r}; it must be two numbers")
        for amplitude in self.amplitudes:
            checked_number(amplitude, "amplitudes")
        checked_number(self.frequency, "frequency", 0.0, 0.5 * MOST_HZ)

    @property
    def fastest(self) -> float:
        """The highest frequency [Hz]."""
        return 2.0 * self.frequency

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        angle, (first, second) = 2.0 * np.pi * self.frequency * times, self.amplitudes
        return _on(len(times), **{self.axes[0]: first * np.sin(angle), self.axes[1]: second * np.sin(2.0 * angle)})


@dataclass(frozen=True)
class Noise:
    """Noise within a band: sines of random phase and of amplitudes that are alike, spread evenly over the band."""

    axis: str
    rms: float  # root mean square, on a turn of an angle [m or rad]
    from_frequency: float  # [Hz]
    to_frequency: float  # [Hz]
    seed: int = 0

    def __post_init__(self) -> None:
        _axis(self.axis)
        checked_number(self.rms, "rms", 0.0)
        checked_number(self.from_frequency, "from_frequency", 1e-3, MOST_HZ)
        checked_number(self.to_frequency, "to_frequency", self.from_frequency, MOST_HZ)
        checked_seed(self.seed)

    @property
    def fastest(self) -> float:
        """The highest frequency [Hz]."""
        return self.to_frequency

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        span = float(times[-1] - times[0]) if len(times) else 0.0
        band = self.to_frequency - self.from_frequency
        # Sines that are closer than the whole time's inverse cannot be told apart.
        count = int(np.clip(np.ceil(2.0 * band * span), 8, _MOST_SINES))
        random = np.random.default_rng(self.seed)
        places, phases = random.uniform(0.0, 1.0, _MOST_SINES)[:count], random.uniform(0.0, 2.0 * np.pi, _MOST_SINES)[:count]
        frequencies = self.from_frequency + band * (np.arange(count) + places) / count
        waves = np.sin(2.0 * np.pi * np.outer(times, frequencies) + phases).sum(axis=1)
        return _on(len(times), **{self.axis: self.rms * np.sqrt(2.0 / count) * waves})


@dataclass(frozen=True)
class Samples:
    """A wave from a CSV file of samples, with a cubic spline through them; after the last sample, that one holds."""

    file: str  # with the header of `COLUMNS`
    factor: float = 1.0

    def __post_init__(self) -> None:
        checked_number(self.factor, "factor")
        self._table()

    def _table(self) -> Array:
        return read_samples(Path(self.file), "a wave", 3, COLUMNS)[1]

    @property
    def fastest(self) -> float:
        """The highest frequency that the samples have [Hz], if each of its periods has ten."""
        return float(min(MOST_HZ, 0.1 / np.diff(self._table()[:, 0]).min()))

    def at(self, times: Array) -> Array:
        """Displacements (N, 6) at times (N,) [s]."""
        table = self._table()
        displacements: Array = self.factor * curve_at(natural_spline(table[:, 0] - table[0, 0], table[:, 1:]), times)[0]
        return displacements


AnyWave = Sine | Chirp | Circle | FigureEight | Noise | Samples

SHAPES: dict[str, type[AnyWave]] = {
    "sine": Sine,
    "chirp": Chirp,
    "circle": Circle,
    "figure-eight": FigureEight,
    "noise": Noise,
    "samples": Samples,
}
"""The waves by their names in a motion file."""
