"""Fields of configurations that the command line offers as options: their help, unit and form are said once, with the field."""

from collections.abc import Callable, Sequence
from dataclasses import field
from typing import Any, TypeVar

from plant.errors import InputError

T = TypeVar("T")


def option(
    default: T,
    text: str,
    *,
    unit: str = "",
    flag: str | None = None,
    metavar: str | None = None,
    choices: Sequence[Any] = (),
    parse: Callable[[str], Any] | None = None,
    several: bool = False,
    shown: str | None = None,
) -> T:
    """A field of a dataclass, with what `hil.command_line.options.add_options` needs to know of it.

    Args:
        default: of the field, in SI units.
        text: what the option means, without its unit and default.
        unit: of the option's number; one in mm or ms is converted to the field's SI unit.
        flag: such as "--set"; by default the field's name, for a field that is True by default with "--no-" before it.
        metavar: stands for the value in the help.
        choices: the values there are, if the parser shall check them.
        parse: makes the value from text, and raises an InputError for text that it refuses; by default the default's type.
        several: whether the option can be given several times, for a tuple.
        shown: the default in the help's words.
    """
    details = {
        "help": text, "unit": unit, "flag": flag, "metavar": metavar, "choices": choices or None, "parse": parse,
        "several": several, "shown": shown,
    }  # fmt: skip
    made: T = field(default=default, metadata=details)
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
