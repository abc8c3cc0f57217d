"""Fields of configurations that are options of the command line, too."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from plant.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Option:
    """The form of an option."""

    text: str  # its help, without unit and default
    unit: str = ""  # of its number; mm and ms become the field's SI unit
    flag: str | None = None  # by default the field's name, after "--no-" if the field is True by default
    metavar: str | None = None  # what stands for the value in the help
    choices: Sequence[Any] | None = None  # the possible values, if the parser checks them
    parse: Callable[[str], Any] | None = None  # by default the type of the field's default
    several: bool = False  # whether it can be given several times, for a tuple
    shown: str | None = None  # the default in the help's words
    required: bool = False  # whether it must be given


def option(default: T, text: str, **form: Any) -> T:
    """A dataclass field with this default in SI units, and its option."""
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
