"""Functions of the user's own, which go to the workers with the text of their module."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from plant.errors import InputError
from plant.files import read_text


@dataclass(frozen=True)
class UserFunction:
    """A function, by its name in a module of which the text is known; `local` is one that has no module of its own."""

    name: str
    source: str
    origin: str
    local: Callable[..., Any] | None = field(default=None, compare=False)

    @classmethod
    def from_file(cls, text: str, folder: Path = Path()) -> "UserFunction":
        """The function that text such as `figures.py:settling_time` names, in a file of this folder.

        Raises:
            InputError: there is no such function.
        """
        file, _, name = str(text).rpartition(":")
        if not file or not name.isidentifier():
            raise InputError(f"{text!r} names no function: write FILE.py:FUNCTION, such as figures.py:settling_time")
        path = folder / file
        made = cls(name, read_text(path), str(path))
        made.function()
        return made

    @classmethod
    def of(cls, function: Callable[..., Any]) -> "UserFunction":
        """A function of the program that runs.

        Raises:
            InputError: its source cannot be found.
        """
        try:
            if function.__module__ == "__main__" or "<" in function.__qualname__:
                return cls(function.__name__, inspect.getsource(function), "<program>", function)
            path = inspect.getsourcefile(function) or ""
            return cls(function.__qualname__, read_text(path), path)
        except (OSError, TypeError, AttributeError):
            raise InputError(f"the source of {function!r} is not known: write it in a file") from None

    def function(self) -> Callable[..., Any]:
        """The function itself, with its module loaded from the text.

        Raises:
            InputError: the text cannot be run, or has no such function.
        """
        if self.local is not None:
            return self.local
        found = getattr(_module(self.source, self.origin), self.name, None)
        if not callable(found):
            raise InputError(f"{self.origin} has no function {self.name!r}")
        called: Callable[..., Any] = found
        return called

    def figures(self, *arguments: Any, **named: Any) -> dict[str, float]:
        """Its figures for these arguments: by their names, or one by the function's own name.

        Raises:
            InputError: it returns neither a number nor numbers by name.
        """
        value = self.function()(*arguments, **named)
        found = value if isinstance(value, Mapping) else {self.name: value}
        try:
            figures = {str(name): float(each) for name, each in found.items()}
        except (TypeError, ValueError):
            figures = {}
        if not figures:
            raise InputError(f"{self.name} returned {value!r}: it must return a number, or numbers by name")
        return figures


@cache
def _module(source: str, origin: str) -> ModuleType:
    module = ModuleType(Path(origin).stem)
    module.__file__ = origin
    try:
        exec(compile(source, origin, "exec"), module.__dict__)
    except Exception as error:
        raise InputError(f"{origin} cannot be run: {type(error).__name__}: {error}") from None
    return module
