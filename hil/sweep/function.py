"""Functions of the user's own, which go to the workers with the text of their module."""

import hashlib
import inspect
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, ClassVar

from plant.errors import InputError
from plant.files import read_text


@dataclass(frozen=True)
class UserFunction:
    """A function, by its name in a module of which the text is known.

    One that is not to be found by its name, as in a notebook or within another, is `local`: as it was when this was made, with
    the values that it uses from around it. A hash of all that takes the place of the text.
    """

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
            InputError: its source cannot be found, or it uses what cannot go to another process.
        """
        try:
            if function.__module__ == "__main__" or "<" in function.__qualname__:
                own = "" if function.__module__ == "__main__" else read_text(inspect.getsourcefile(function) or "")
                source, copy = _frozen(function, own)
                return cls(function.__name__, source, "<program>", copy)
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


def _frozen(function: Callable[..., Any], module: str) -> tuple[str, Callable[..., Any]]:
    """A hash of a function, of the values that it uses and of its module's text, and a copy with these values."""
    import cloudpickle

    reduced = cloudpickle.Pickler.dispatch_table

    def code_alone(code: CodeType) -> Any:
        # Neither where it stands, which a notebook changes, nor the order of sets, which each process has its own of.
        constants = tuple(sorted(map(repr, each)) if isinstance(each, frozenset) else each for each in code.co_consts)
        return reduced[CodeType](code.replace(co_filename="", co_firstlineno=1, co_linetable=b"", co_consts=constants))

    class Pickler(cloudpickle.Pickler):  # type: ignore[misc]
        dispatch_table: ClassVar = {**reduced, CodeType: code_alone}

    content = io.BytesIO()
    try:
        Pickler(content).dump((function, module))
        copy: Callable[..., Any] = cloudpickle.loads(cloudpickle.dumps(function))
    except Exception as error:
        raise InputError(f"{function.__name__} cannot go to another process: {error}; write it in a file") from None
    return hashlib.sha256(content.getvalue()).hexdigest(), copy


@cache
def _module(source: str, origin: str) -> ModuleType:
    module = ModuleType(Path(origin).stem)
    module.__file__ = origin
    try:
        exec(compile(source, origin, "exec"), module.__dict__)
    except Exception as error:
        raise InputError(f"{origin} cannot be run: {type(error).__name__}: {error}") from None
    return module
