"""The words of an IMU's data sheet, in its own units, as they stand there: `noise_density = "160 ug/sqrt(Hz)"`.

One table says which field of `SensorErrors` each word gives, one which units there are. A sensor that is described by these
words has what they say, and nothing else.
"""

import re
from collections.abc import Callable, Mapping
from math import isclose, isfinite, radians, sqrt
from typing import Any, NamedTuple

from plant.errors import InputError
from plant.imu.model import MILLI_G, STANDARD_GRAVITY

_UNITS = {
    "gyroscope": {
        "deg/s": radians(1.0), "mdeg/s": radians(1e-3), "deg/h": radians(1.0 / 3600.0), "rad/s": 1.0, "mrad/s": 1e-3,
    },
    "accelerometer": {
        "g": STANDARD_GRAVITY, "mg": MILLI_G, "ug": 1e-3 * MILLI_G, "m/s2": 1.0, "mm/s2": 1e-3,
    },
    "magnetometer": {"uT": 1.0, "nT": 1e-3, "gauss": 100.0, "mgauss": 0.1},
}  # fmt: skip
"""Units of each sensor's reading, and their factors to its SI unit (uT for magnetometers)."""

_WALKS = {
    "gyroscope": {"deg/rth": radians(1.0 / 60.0), "deg/rts": radians(1.0), "rad/rts": 1.0},
    "accelerometer": {"m/s/rth": 1.0 / 60.0, "m/s/rts": 1.0},
    "magnetometer": {},
}
"""Units of random walks of angle and velocity, and their factors to rad/sqrt(s) and m/s/sqrt(s)."""

_SPELLINGS = (
    (" ", ""), ("\N{PLUS-MINUS SIGN}", ""), ("+/-", ""), ("+-", ""), ("\N{MICRO SIGN}", "u"),
    ("\N{GREEK SMALL LETTER MU}", "u"), ("\N{DEGREE CELSIUS}", "K"), ("\N{DEGREE SIGN}C", "K"), ("degC", "K"), ("/C", "/K"),
    ("\N{DEGREE SIGN}", "deg"), ("dps", "deg/s"), ("sec", "s"), ("hr", "h"), ("\N{SUPERSCRIPT TWO}", "2"), ("^", ""),
    ("\N{SQUARE ROOT}", "rt"), ("sqrt", "rt"), ("(", ""), (")", ""), ("LSb", "LSB"),
)  # fmt: skip
"""How else a data sheet may write a unit, in the order in which they are replaced."""

_NUMBER = re.compile(r"(\d+\.?\d*(?:[eE][+-]?\d+)?|\.\d+)(.*)")


class _Word(NamedTuple):
    """What a word of a data sheet gives: a field of `SensorErrors`, and the units of its figure for a sensor."""

    field: str
    units: Callable[[str], Mapping[str, float]]
    parts: str = ""  # what becomes of the figure: "" one number, "range" least and greatest, "halves" common and own


def _reading(suffix: str = "") -> Callable[[str], Mapping[str, float]]:
    return lambda sensor: {f"{unit}{suffix}": factor for unit, factor in _UNITS[sensor].items()}


def _sensitivity(sensor: str) -> Mapping[str, float]:
    """Units of a sensitivity: LSB of a unit, whose figure must be inverted, or the unit of an LSB."""
    return {f"LSB/{unit}": -factor for unit, factor in _UNITS[sensor].items()} | dict(_reading("/LSB")(sensor))


def _only(**units: float) -> Callable[[str], Mapping[str, float]]:
    return lambda _: units


def _percent(suffix: str = "") -> Callable[[str], Mapping[str, float]]:
    return lambda _: {f"%{suffix}": 0.01, f"ppm{suffix}": 1e-6}


_WORDS = {
    "full_scale": _Word("reach", _reading()),
    "sensitivity": _Word("resolution", _sensitivity),
    "noise_density": _Word("noise", _reading("/rtHz")),
    "random_walk": _Word("noise", lambda sensor: {unit: sqrt(2.0) * by for unit, by in _WALKS[sensor].items()}),
    "bias_instability": _Word("drift", _reading()),
    "zero_level": _Word("bias", _reading(), "range"),
    "zero_level_drift": _Word("bias_per_kelvin", _reading("/K"), "halves"),
    "zero_level_supply": _Word("bias_per_volt", _reading("/V"), "halves"),
    "sensitivity_tolerance": _Word("scale", _percent()),
    "sensitivity_drift": _Word("scale_per_kelvin", _percent("/K"), "halves"),
    "cross_axis": _Word("cross_axis", _percent()),
    "bandwidth": _Word("bandwidth", _only(Hz=1.0, kHz=1e3)),
}
SENSOR_WORDS = {word: entry.field for word, entry in _WORDS.items()} | {"bits": "resolution"}
"""The words of a data sheet for a sensor, with the fields that they give; figures are text with a unit, but for `bits`."""

IMU_WORDS = {
    "output_data_rate": ("sample_rate", {"Hz": 1.0, "kHz": 1e3}),
    "internal_rate": ("conversion_rate", {"Hz": 1.0, "kHz": 1e3}),
    "clock_tolerance": ("clock_error", {"%": 0.01, "ppm": 1e-6}),
}
"""The words of a data sheet for the whole IMU: the field of `ImuModel`, and its units."""


def words_for(sensor: str) -> dict[str, tuple[str, list[str]]]:
    """The words of a data sheet for a sensor, each with the field that it gives and its units; `bits` has none."""
    found = {word: (entry.field, [*map(_shown, entry.units(sensor))]) for word, entry in _WORDS.items()}
    return {word: (field, units) for word, (field, units) in found.items() if units} | {"bits": ("resolution", [])}


def figure(text: Any, units: Mapping[str, float], title: str) -> float:
    """The figure of a text such as "160 ug/sqrt(Hz)" in SI units; a unit with a negative factor stands for its inverse.

    Raises:
        InputError: the text has no number, or none of these units.
    """
    found = _NUMBER.fullmatch(_plain(text)) if isinstance(text, str) else None
    if found is None or not isfinite(float(found[1])):
        raise InputError(f'{title} is {text!r}; it must be a number and its unit, such as "4 {_shown(next(iter(units)))}"')
    number, unit = float(found[1]), found[2]
    if unit not in units:
        raise InputError(f"{title} is {text!r}; its unit must be one of {', '.join(map(_shown, units))}")
    if units[unit] > 0.0:
        return number * units[unit]
    if number == 0.0:
        raise InputError(f"{title} is {text!r}; it must be positive")
    return -units[unit] / number


def _plain(text: str) -> str:
    for spelling, plain in _SPELLINGS:
        text = text.replace(spelling, plain)
    return text


def _shown(unit: str) -> str:
    return re.sub(r"rt(Hz|h|s)", r"sqrt(\1)", unit)


def sensor_of_words(table: Mapping[str, Any], sensor: str, title: str) -> dict[str, Any]:
    """The fields of `SensorErrors` that the words of a data sheet give for a sensor; messages call its table `title`.

    Raises:
        InputError: a figure or unit cannot be used, figures contradict each other, or noise or range is missing.
    """
    found: dict[str, Any] = {}
    given: dict[str, str] = {}
    for word, (field, units, parts) in _WORDS.items():
        if word not in table:
            continue
        texts = table[word] if parts == "range" and isinstance(table[word], list) and len(table[word]) == 2 else [table[word]]
        numbers = [figure(text, units(sensor), f"{word} of {title}") for text in texts]
        if field in found and not isclose(found[field], numbers[0], rel_tol=0.1):
            raise InputError(
                f"{word} and {given[field]} of {title} contradict each other: {table[word]!r} is "
                f"{numbers[0] / found[field]:.3g} times {table[given[field]]!r}: leave one of them out"
            )
        found.setdefault(field, _parted(numbers, parts))
        given.setdefault(field, word)
    for field, words, why in (
        ("noise", "noise_density or random_walk", "a sensor without noise is no real one"),
        ("reach", "full_scale", "readings are clipped there"),
    ):
        if not found.get(field):
            raise InputError(
                f"{title} has no {words}, and {why}: give it, or only words with units in their names (docs/imus.md) to "
                "change single figures of what the file is based on"
            )
    if "bits" in table:
        found["resolution"] = _checked_resolution(table, found, title)
    if "drift" in found:
        # It is the least Allan deviation of noise and walk together: sqrt(2 N K / sqrt(3)), with N^2 = noise^2 / 2.
        found["drift"] = sqrt(1.5) * found["drift"] ** 2 / found["noise"]
    return found


def _parted(numbers: list[float], parts: str) -> Any:
    if parts == "range":
        return numbers[0], numbers[-1]
    return (0.5 * numbers[0], 0.5 * numbers[0]) if parts == "halves" else numbers[0]


def _checked_resolution(table: Mapping[str, Any], found: Mapping[str, Any], title: str) -> float:
    """The step of readings of so many bits, which must agree with the sensitivity if that is given."""
    bits, reach = table["bits"], found["reach"]
    if type(bits) is not int or not 8 <= bits <= 32:
        raise InputError(f"bits of {title} is {bits!r}; it must be a whole number from 8 to 32")
    step: float = found.get("resolution", reach / 2 ** (bits - 1))
    largest = step * 2 ** (bits - 1)
    if not 0.95 * reach <= largest <= 1.25 * reach:
        raise InputError(
            f"sensitivity, bits and full_scale of {title} contradict each other: {bits} bits of {table['sensitivity']!r} reach "
            f"{largest / reach:.3g} times {table['full_scale']!r}: check which full scale the sensitivity is for"
        )
    return step
