"""What can happen to IMUs while they run: which IMUs, which sensor, which axis, how large, and its course over time.

A disturbance has the same words in Python, as a TOML table, and as text of `gough simulate --fault` and `gough inject`:

    disturbance("offset", imus="all", axis="y", size_m_per_s2=0.5, at_s=5.0, ramp_s=10.0)
    imu-offset:all,axis=y,size_m_per_s2=0.5,at_s=5,ramp_s=10

Each word has its unit in its name. Axes are each IMU's own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from math import inf, isfinite, nan, radians, sqrt
from typing import Any

from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries
from plant.imu_wiring import ALL_IMUS, BASE_IMU

PREFIX = "imu-"
"""What the text of a disturbance begins with."""

BASE_PREFIX = "base-"
"""What the text of a motion of the base begins with (`plant.dynamics.base_course`)."""

SENSORS = ("gyroscope", "accelerometer", "magnetometer")
"""The sensors of an IMU, in the order of a measurement's first index."""

_SIZES: dict[str, tuple[float, str]] = {
    "size_deg_per_s": (radians(1.0), "gyroscope"),
    "size_m_per_s2": (1.0, "accelerometer"),
    "size_g": (9.80665, "accelerometer"),
    "size_ut": (1.0, "magnetometer"),
    "size_percent": (0.01, ""),
    "size_deg": (radians(1.0), ""),
    "size_k": (1.0, ""),
    "size_v": (1.0, ""),
    "size_ms": (1e-3, ""),
}
"""Words for a size: the factor to SI units, and the sensor that has this unit."""

_OF_A_SENSOR = ("size_deg_per_s", "size_m_per_s2", "size_g", "size_ut")


class DisturbanceKind(IntEnum):
    """What happens to an IMU."""

    sizes: tuple[str, ...]  # words for its size; none if it has no size
    places: tuple[str, ...]  # which of sensor and axis must be told
    text: str

    def __new__(cls, sizes: tuple[str, ...], places: tuple[str, ...], text: str) -> "DisturbanceKind":
        """The next member."""
        kind = int.__new__(cls, len(cls.__members__) + 1)
        kind._value_ = len(cls.__members__) + 1
        kind.sizes, kind.places, kind.text = sizes, places, text
        return kind

    @property
    def label(self) -> str:
        """The kind's name as text, such as imu-offset."""
        return PREFIX + self.name.lower()

    OFFSET = _OF_A_SENSOR, ("sensor", "axis"), "the sensor adds this to its reading"
    SCALE = ("size_percent",), ("sensor", "axis"), "the sensor reads this share more"
    VIBRATION = (
        _OF_A_SENSOR[:3],
        ("sensor", "axis"),
        "the IMU is shaken or struck; the sensor rectifies, filters and clips it",
    )
    NOISE = _OF_A_SENSOR, ("sensor", "axis"), "each conversion has white noise of this RMS in addition"
    RANGE = _OF_A_SENSOR, ("sensor",), "conversions and readings are clipped at this size"
    TURN = ("size_deg",), ("axis",), "the IMU is turned on its mounting about this axis"
    STUCK = (), ("sensor", "axis"), "the axis keeps its reading"
    TEMPERATURE = ("size_k",), (), "the IMU gets warmer; its bias and scale follow by its model's figures per kelvin"
    SUPPLY = ("size_v",), (), "the supply rises; the bias follows by the model's figures per volt"
    CLOCK = ("size_percent",), (), "the IMU samples on a clock of its own, which is faster than nominal; -50 halves its rate"
    JITTER = ("size_ms",), (), "each conversion comes early by a random time of this RMS"


class Course(IntEnum):
    """How the size of a disturbance goes on after its begin."""

    STEP, RAMP, SETTLE, SINE, PULSES = range(5)


@dataclass(frozen=True)
class Disturbance:
    """A disturbance of some IMUs, in SI units; `disturbance` makes one of words.

    Attributes:
        imus: their numbers.
        sensor: index in `SENSORS`; -1 for all of the IMU.
        axis: what each axis gets of the size: a unit vector, or ones for all axes.
        span: duration of a ramp, time constant, period of a sine, or duration of a pulse [s].
        every: time from pulse to pulse [s]; infinite for a single one.
        begin: [s]; negative: from the start.
        duration: [s].
    """

    kind: DisturbanceKind
    imus: tuple[int, ...]
    sensor: int
    axis: tuple[float, float, float]
    size: float
    course: Course = Course.STEP
    span: float = 0.0
    every: float = inf
    begin: float = -1.0
    duration: float = inf

    @property
    def mean_square(self) -> float:
        """The mean square of its size over time; a ramp or an exponential has come to its end."""
        if self.course == Course.SINE:
            return 0.5 * self.size**2
        return self.size**2 * (0.5 * self.span / self.every if self.course == Course.PULSES else 1.0)

    def later(self, by: float) -> "Disturbance":
        """The same, with a begin that counts from a time `by` [s]; what is there from the start stays so."""
        return self if self.begin < 0.0 else replace(self, begin=self.begin + by)


_COURSES = {"ramp_s": Course.RAMP, "settle_s": Course.SETTLE, "sine_hz": Course.SINE, "pulse_ms": Course.PULSES}

WORDS = {
    "imus": "which: all, legs, a number, or several such as 0+2+5; in text after a colon",
    "sensor": "gyroscope, accelerometer or magnetometer, where the unit of the size does not tell",
    "axis": "of each IMU: x, -y, z, all, or a direction such as 0/0.89/-0.46",
    "at_s": "when it begins; without it, it is there from the start",
    "for_s": "how long it lasts; without it, to the end",
    "ramp_s": "it grows evenly for this time; without this or the next three, its size is there at once",
    "settle_s": "it grows as an exponential with this time constant",
    "sine_hz": "it is a sine of this frequency, and its size is the amplitude",
    "pulse_ms": "it is a half-sine pulse of this duration, and its size is the peak",
    "repeat_hz": "pulses come at this rate; without it, there is one",
}
"""The words of a disturbance beside those of its size, with their meaning."""

_GREATEST = 1e6
"""The greatest value of a word for a course."""

_SHORT = {"at": "at_s", "for": "for_s"}
"""Words that faults of drives and of the bus have, too."""


def disturbance(kind: str, /, **words: Any) -> Disturbance:
    """A disturbance from its words.

    Args:
        kind: offset, scale, vibration, noise, range, turn, stuck, temperature, supply, clock or jitter; `DisturbanceKind` says
            what each is.
        words: those of `WORDS`, and the size by one of those that the kind has. `imus` may be a list of numbers, `axis` one of
            three numbers.

    Raises:
        UnknownNameError: there is no such kind.
        InputError: a word is missing, unknown or out of range.
    """
    kinds = {each.name.lower(): each for each in DisturbanceKind}
    if kind not in kinds:
        known = f"{', '.join(kinds)}{nearest(kind, kinds)}"
        raise UnknownNameError(f"there is no disturbance {kind!r} of an IMU; there are {known}")
    made, title = kinds[kind], f"the disturbance {kind!r}"
    check_entries(words, [word for word in WORDS if word not in ("sensor", "axis")] + [*made.places, *made.sizes], title)
    sizes = [word for word in made.sizes if word in words]
    if len(sizes) != min(1, len(made.sizes)):
        raise InputError(f"{title} needs one of {', '.join(made.sizes)}, and it has {', '.join(sizes) or 'none'}")
    factor, of = _SIZES[sizes[0]] if sizes else (0.0, "")
    size = number_in(words, sizes[0], title) * factor if sizes else 0.0
    course, span, every = course_in(words, title)
    begin, duration = times_in(words, title)
    if made == DisturbanceKind.CLOCK and not -1.0 < size <= 100.0:
        raise InputError(f"{title} has size_percent = {100.0 * size:g}; a clock needs more than -100, and at most 10000")
    if made in (DisturbanceKind.JITTER, DisturbanceKind.RANGE) and size < 0.0:
        raise InputError(f"{title} has {sizes[0]} = {size / factor:g}; it must not be negative")
    sensor = _sensor(words, of, title) if "sensor" in made.places else -1
    axis = axis_in(words, title, made != DisturbanceKind.TURN) if "axis" in made.places else (0.0, 0.0, 0.0)
    return Disturbance(made, _imus(words.get("imus"), title), sensor, axis, size, course, span, every, begin, duration)


def disturbance_of_text(text: str) -> Disturbance:
    """A disturbance from text: kind and IMUs, then the words of `disturbance`; `at` and `for` do for `at_s` and `for_s`.

    Raises:
        GoughError: as `disturbance`.
    """
    name, imus, words = words_of_text(text)
    if imus and "imus" in words:
        raise InputError(f"the IMUs come twice in {text!r}: {imus} and {words['imus']}")
    return disturbance(name.removeprefix(PREFIX), **(words | ({"imus": imus} if imus else {})))


def words_of_text(text: str) -> tuple[str, str, dict[str, str]]:
    """The name before the first colon, what follows it, and the words with their values; `InputError` if it is no such text."""
    head, *options = text.split(",")
    name, _, what = head.partition(":")
    words: dict[str, str] = {}
    for option in options:
        word, equals, value = option.partition("=")
        word = _SHORT.get(word, word)
        if not equals or word in words:
            raise InputError(f"{option!r} in {text!r} is no word with a value, such as axis=y, or comes twice")
        words[word] = value
    return name, what, words


def disturbance_of_table(table: Mapping[str, Any]) -> Disturbance:
    """A disturbance from a TOML table: `kind`, and the words of `disturbance`.

    Raises:
        GoughError: as `disturbance`.
    """
    words = dict(table)
    kind = words.pop("kind", None)
    if kind is None:
        raise InputError('a disturbance of an IMU needs its kind, such as kind = "offset"')
    return disturbance(kind, **words)


def words_of(disturbance: Disturbance) -> dict[str, Any]:
    """The words of a disturbance, with its kind, from which `disturbance_of_table` makes it again."""
    kind = disturbance.kind
    words: dict[str, Any] = {"kind": kind.name.lower(), "imus": list(disturbance.imus)}
    if "sensor" in kind.places:
        words["sensor"] = SENSORS[disturbance.sensor]
    if "axis" in kind.places:
        words["axis"] = "all" if disturbance.axis == (1.0, 1.0, 1.0) else list(disturbance.axis)
    for word in (each for each in kind.sizes if _SIZES[each][1] in ("", words.get("sensor"))):
        words[word] = disturbance.size / _SIZES[word][0]
        break
    if disturbance.course != Course.STEP:
        word = next(each for each, course in _COURSES.items() if course == disturbance.course)
        words[word] = {"sine_hz": 1.0 / disturbance.span, "pulse_ms": 1e3 * disturbance.span}.get(word, disturbance.span)
    if isfinite(disturbance.every):
        words["repeat_hz"] = 1.0 / disturbance.every
    if disturbance.begin >= 0.0:
        words["at_s"] = disturbance.begin
    if isfinite(disturbance.duration):
        words["for_s"] = disturbance.duration
    return words


def number_in(words: Mapping[str, Any], word: str, title: str, default: float = nan) -> float:
    """The number that a word has; `title` begins the message of an `InputError`."""
    value = words.get(word, default)
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = nan
    if isinstance(value, bool) or not (isfinite(number) or (number == inf and word == "for_s")):
        raise InputError(f"{title} has {word} = {value!r}; it must be a finite number")
    return number


def times_in(words: Mapping[str, Any], title: str) -> tuple[float, float]:
    """When it begins [s], -1 if it is there from the start, and how long it lasts [s]."""
    begin, duration = number_in(words, "at_s", title, -1.0), number_in(words, "for_s", title, inf)
    if "at_s" in words and begin < 0.0:
        raise InputError(f"{title} has at_s = {begin:g}; it must not be negative: leave it out for one from the start")
    if not duration > 0.0:
        raise InputError(f"{title} has for_s = {duration:g}; it must be positive")
    return begin, duration


def course_in(words: Mapping[str, Any], title: str) -> tuple[Course, float, float]:
    """The course, its time [s], and the time from pulse to pulse [s]."""
    given = [word for word in _COURSES if word in words]
    if len(given) > 1:
        raise InputError(f"{title} has {' and '.join(given)}; it has one course, or none for a step")
    if "repeat_hz" in words and given != ["pulse_ms"]:
        raise InputError(f"{title} has repeat_hz, which goes with pulse_ms")
    if not given:
        return Course.STEP, 0.0, inf
    values = {word: number_in(words, word, title) for word in (*given, "repeat_hz") if word in words}
    for word, value in values.items():
        if not 0.0 < value <= _GREATEST:
            raise InputError(f"{title} has {word} = {value:g}; it must be positive, and at most {_GREATEST:g}")
    (word,) = given
    span = 1.0 / values[word] if word == "sine_hz" else values[word] * (1e-3 if word == "pulse_ms" else 1.0)
    every = 1.0 / values["repeat_hz"] if "repeat_hz" in values else inf
    if word == "pulse_ms" and span > every:
        raise InputError(f"{title} has pulses of {1e3 * span:g} ms every {1e3 * every:g} ms: they must not overlap")
    return _COURSES[word], span, every


def _sensor(words: Mapping[str, Any], of: str, title: str) -> int:
    sensor = words.get("sensor", of)
    if sensor not in SENSORS or (of and sensor != of):
        such = f"{of}, which has that unit" if of else " or ".join(SENSORS)
        raise InputError(f"{title} has sensor = {sensor!r}; it must be {such}")
    return SENSORS.index(sensor)


def axis_in(words: Mapping[str, Any], title: str, can_be_all: bool) -> tuple[float, float, float]:
    """The unit vector of `axis`, or ones for all."""
    axis, every = words.get("axis"), ", all" if can_be_all else ""
    possible = f"x, -y, z{every}, or a direction such as 0/0.89/-0.46"
    if axis is None:
        raise InputError(f"{title} needs its axis: add {possible}, as in axis=z")
    if axis == "all" and can_be_all:
        return 1.0, 1.0, 1.0
    named = {"x": "1/0/0", "y": "0/1/0", "z": "0/0/1", "-x": "-1/0/0", "-y": "0/-1/0", "-z": "0/0/-1"}
    parts = named.get(axis, axis).split("/") if isinstance(axis, str) else axis
    try:
        x, y, z = map(float, parts)
    except (TypeError, ValueError):
        x = y = z = nan
    length = sqrt(x * x + y * y + z * z)
    if not (isfinite(length) and length > 0.0):
        raise InputError(f"{title} has axis = {axis!r}; it must be {possible}")
    return x / length, y / length, z / length


def _imus(imus: Any, title: str) -> tuple[int, ...]:
    named = {"all": (*ALL_IMUS, BASE_IMU), "legs": ALL_IMUS[:-1]}
    if isinstance(imus, str) and imus in named:
        return named[imus]
    parts = imus.split("+") if isinstance(imus, str) else [imus] if isinstance(imus, int) else imus
    try:
        numbers = tuple(sorted({int(str(each)) for each in parts}))
    except (TypeError, ValueError):
        numbers = ()
    if not numbers or not 0 <= numbers[0] <= numbers[-1] <= BASE_IMU:
        raise InputError(f"{title} is for imus = {imus!r}; there are 0 to {BASE_IMU}, several such as 0+2+5, legs and all")
    return numbers
