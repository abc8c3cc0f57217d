"""Fields of configurations that are options of the command line, too."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from plant.errors import InputError

T = TypeVar("T")


class Named(Generic[T]):
    """The type of a field that is given a name, a path or an object T, and then is the name."""

    if TYPE_CHECKING:

        def __get__(self, instance: object, owner: type | None = None) -> str:
            """The name."""

        def __set__(self, instance: object, value: str | PathLike[str] | T) -> None:
            """Anything that can be named."""


class NamedOrNone(Generic[T]):
    """The same for a field that may be None."""

    if TYPE_CHECKING:

        def __get__(self, instance: object, owner: type | None = None) -> str | None:
            """The name, or None."""

        def __set__(self, instance: object, value: str | PathLike[str] | T | None) -> None:
            """Anything that can be named, or None."""


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


def named(default: str | None, text: str, **form: Any) -> Any:
    """An `option` whose field is `Named` or `NamedOrNone`."""
    return option(default, text, **form)


def integers(text: str) -> tuple[int, ...]:
    """Parse a list of whole numbers such as 0,1,2.

    Raises:
        InputError: the text is no such list.
    """
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{text!r} is no list of numbers such as 0,1,2") from None
