"""Encoders: what sensors of the legs' lengths read, as most drives have them at their motors.

A motor with play moves `play(length)`: it stays where it is until the rod has crossed the play, half of which lies on either
side. The encoder reads that to its resolution, from a zero of its own: where the machine was switched on (incremental), or
where its maker has set it (absolute). The length's rate is the readings' difference, low-passed as drives do it. A home switch
tells on which side of its place the leg is.

A kind of encoder is a preset or a TOML file. What can happen to one has the same words as a disturbance of an IMU:

    encoder-jumps:3,size_mm=0.5,at_s=5        encoder-slips:3,size_percent=20,at_s=5,for_s=2        encoder-reversed:3
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from math import inf, isfinite
from pathlib import Path
from typing import Any

from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.files import check_entries, read_toml, toml_entries
from plant.imu_disturbances import number_in, times_in, words_of_text
from plant.imu_wiring import PLATFORM_IMU as LEGS

PREFIX = "encoder-"
"""What the text of a fault begins with."""


@dataclass(frozen=True)
class EncoderModel:
    """The imperfections of one kind of encoder, the same for all legs."""

    name: str
    absolute: bool = False  # whether its zero is known
    resolution: float = 5e-6  # step of the reading; 0 for none [m]
    backlash: float = 20e-6  # play between rod and encoder, beside that of the plant [m]
    noise: float = 0.0  # RMS [m]
    scale: float = 0.0  # greatest error of the screw's lead, uniform and relative
    zero: float = 5e-6  # of an absolute encoder: standard deviation of its zero [m]
    dropout: float = 0.0  # probability that a cycle has no reading
    switches: tuple[float, ...] = ()  # lengths at which each leg's home switch closes; none without switches [m]
    repeatability: float = 2e-6  # of the switches, RMS [m]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and not (isfinite(value) and value >= 0.0):
                raise InputError(f"the {field.name} of an encoder is {value}; it must be finite and not negative")
        if self.dropout > 1.0 or self.scale >= 1.0:
            raise InputError(f"the dropout and scale of an encoder are {self.dropout} and {self.scale}; they are below 1")
        if len(self.switches) > LEGS or not all(isfinite(each) and each > 0.0 for each in self.switches):
            raise InputError(f"the home switches are at {self.switches}; give a length for each leg, in m")


PRESETS = {
    model.name: model
    for model in (
        EncoderModel("incremental"),
        EncoderModel("absolute", absolute=True, backlash=0.0),
        EncoderModel("ideal", absolute=True, resolution=0.0, backlash=0.0, zero=0.0),
    )
}
"""5 um are a count of a motor's encoder with 1000 lines (4000 counts) on a screw of 20 mm; 20 um are the play of a rolled one.
An absolute encoder sits at the rod, has no play and a zero that its maker has set to 5 um.
"""

NO_LENGTHS = "none"

WORDS = {
    "resolution_um": ("resolution", 1e-6),
    "backlash_um": ("backlash", 1e-6),
    "noise_um": ("noise", 1e-6),
    "scale_percent": ("scale", 0.01),
    "zero_um": ("zero", 1e-6),
    "dropout": ("dropout", 1.0),
    "repeatability_um": ("repeatability", 1e-6),
}
"""The words of an encoder's file: the field, and the factor to its unit."""


def load_encoder(name: str) -> EncoderModel | None:
    """The preset of that name, or the kind that a TOML file describes; None for `NO_LENGTHS`.

    Raises:
        UnknownNameError: there is neither.
        InputError: the file cannot be used.
    """
    if name == NO_LENGTHS:
        return None
    if name in PRESETS:
        return PRESETS[name]
    if not name.endswith(".toml"):
        known = (NO_LENGTHS, *PRESETS)
        raise UnknownNameError(f"no encoder {name!r}; there are {', '.join(known)}, or a TOML file{nearest(name, known)}")
    table = read_toml(name)
    check_entries(table, ("based_on", "absolute", "switches_m", *WORDS), name)
    base = load_encoder(table.get("based_on", "incremental"))
    if base is None:
        raise InputError(f"{name} is based on no encoder: leave based_on out, or name incremental or absolute")
    changes: dict[str, Any] = {field: _number(table, word, name) * by for word, (field, by) in WORDS.items() if word in table}
    if "absolute" in table:
        if not isinstance(table["absolute"], bool):
            raise InputError(f"absolute of {name} is {table['absolute']!r}; it must be true or false")
        changes["absolute"] = table["absolute"]
    if "switches_m" in table:
        switches = table["switches_m"]
        if not isinstance(switches, list) or not all(type(each) in (int, float) for each in switches):
            raise InputError(f"switches_m of {name} is {switches!r}; it must be a list of lengths")
        changes["switches"] = tuple(map(float, switches))
    return replace(base, name=Path(name).stem, **changes)


def text_of_encoder(model: EncoderModel) -> str:
    """The TOML text of a kind of encoder, which `load_encoder` reads again, to rounding."""
    words = {word: getattr(model, field) / by for word, (field, by) in WORDS.items()}
    switches = [float(each) for each in model.switches]
    return "\n".join(toml_entries({"absolute": model.absolute, "switches_m": switches, **words})) + "\n"


def _number(table: Mapping[str, Any], word: str, title: str) -> float:
    value = table[word]
    if type(value) not in (int, float):
        raise InputError(f"{word} of {title} is {value!r}; it must be a number")
    return float(value)


class EncoderFaultKind(IntEnum):
    """What happens to an encoder."""

    size: str  # word for its size; none if it has no size
    factor: float  # to SI units
    text: str

    def __new__(cls, size: str, factor: float, text: str) -> "EncoderFaultKind":
        """The next member."""
        kind = int.__new__(cls, len(cls.__members__) + 1)
        kind._value_ = len(cls.__members__) + 1
        kind.size, kind.factor, kind.text = size, factor, text
        return kind

    @property
    def label(self) -> str:
        """The kind's name as text, such as encoder-slips."""
        return PREFIX + self.name.lower()

    DEAD = "", 0.0, "the encoder reads nothing any more"
    FROZEN = "", 0.0, "the encoder keeps its reading"
    REVERSED = "", 0.0, "the encoder counts the wrong way"
    JUMPS = "size_mm", 1e-3, "the encoder loses counts at once, and reads so much more from then on"
    SLIPS = "size_percent", 0.01, "the coupling slips: the encoder misses this share of each motion"
    CREEPS = "size_mm_per_s", 1e-3, "the encoder counts at this speed without a motion"


@dataclass(frozen=True)
class EncoderFault:
    """A fault of some encoders, in SI units; times [s] count from the first cycle, and a negative begin is the start."""

    kind: EncoderFaultKind
    legs: tuple[int, ...]
    size: float = 0.0
    begin: float = -1.0
    duration: float = inf

    def later(self, by: float) -> "EncoderFault":
        """The same, with a begin that counts from a time `by` [s]; what is there from the start stays so."""
        return self if self.begin < 0.0 else replace(self, begin=self.begin + by)


def encoder_fault(text: str) -> EncoderFault:
    """A fault from its text, such as `encoder-slips:3,size_percent=20,at=5`.

    Raises:
        UnknownNameError: there is no such kind.
        InputError: a word is missing, unknown or out of range.
    """
    name, legs, words = words_of_text(text)
    kinds = {each.label: each for each in EncoderFaultKind}
    if name not in kinds:
        raise UnknownNameError(f"there is no fault {name!r} of an encoder; there are {', '.join(kinds)}{nearest(name, kinds)}")
    kind, title = kinds[name], f"the fault {name!r}"
    check_entries(words, ("at_s", "for_s", *([kind.size] if kind.size else [])), title)
    if kind.size and kind.size not in words:
        raise InputError(f"{title} needs its size: add {kind.size}=NUMBER")
    size = number_in(words, kind.size, title) * kind.factor if kind.size else 0.0
    return EncoderFault(kind, _legs(legs, title), size, *times_in(words, title))


def _legs(text: str, title: str) -> tuple[int, ...]:
    if text == "all":
        return tuple(range(LEGS))
    parts = text.split("+")
    legs = tuple(sorted({int(part) for part in parts})) if all(part.isdecimal() for part in parts) else ()
    if not legs or legs[-1] >= LEGS:
        raise InputError(f"{title} is for legs {text!r}; there are 0 to {LEGS - 1}, several such as 0+2+5, and all")
    return legs
