"""Fields of configurations that are options of the command line, too: each says its help, unit and form once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from plant.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Option:
    """The form of an option.

    Attributes:
        text: its help, without unit and default.
        unit: of its number; mm and ms become the field's SI unit.
        flag: such as "--set"; by default the field's name, with "--no-" before it if the field is True by default.
        metavar: what stands for the value in the help.
        choices: the possible values, if the parser checks them.
        parse: makes the value from text, or raises an InputError; by default the type of the field's default.
        several: whether the option can be given several times, for a tuple.
        shown: the default in the help's words.
        required: whether it must be given.
    """

    text: str
    unit: str = ""
    flag: str | None = None
    metavar: str | None = None
    choices: Sequence[Any] | None = None
    parse: Callable[[str], Any] | None = None
    several: bool = False
    shown: str | None = None
    required: bool = False


def option(default: T, text: str, **form: Any) -> T:
    """A dataclass field with this default in SI units, and its option with this help and the other attributes of `Option`."""
    made: T = field(default=default, metadata={"option": Option(text, **form)})
    return made


def integers(text: str) -> tuple[int, ...]:
    """Parse a list of whole numbers such as 0,1,2.

    Raises:
        InputError: the text is no such list.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{text!r} is no list of numbers such as 0,1,2") from None
