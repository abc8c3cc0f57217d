"""The one decorator that marks compiled kernels.

numba notices no edit in the files of a kernel's callees. The machine code therefore lies in the user's cache under a hash of
every source file of the three packages: any edit gives a new folder. Copies of the same sources share it, such as a checkout
and what was installed from it.
"""

import hashlib
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core import event
from numba.extending import lower_cast

from plant.compiled.cache import hash_of_files, keyed_folder
from plant.compiled.linking import linked_flat
from plant.compiled.shared import linked_shared

F = TypeVar("F", bound=Callable[..., Any])

Record = Any
"""A structured array of shape () or (N,), or a record of one. Compiled code reads its fields as attributes, which the types of
NumPy cannot say."""


def record_dtype(**fields: Any) -> np.dtype[Any]:
    """The dtype of a record with these fields: each a type, or a type and a shape."""
    return np.dtype(list(fields.items()), align=True)


def filled(dtype: np.dtype[Any], /, **values: Any) -> Record:
    """A structured array of shape () with these values by field; the other fields are zero."""
    record: Record = np.zeros((), dtype)
    for name, value in values.items():
        record[name] = value
    return record


PACKAGES = ("plant", "controller", "hil")
WITHOUT_KERNELS = ("command_line", "panel", "reference", "reports", "sweep")
"""Rooms of `hil` on which no kernel depends; an edit there leaves all machine code as it is."""


@contextmanager
def compilation_reported(report: Callable[[int], None]) -> Iterator[None]:
    """Call `report` each time numba begins to compile a function, with their number so far."""
    begun = itertools.count(1)
    base: Any = event.Listener

    class Listener(base):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            report(next(begun))

        def on_end(self, event: Any) -> None:
            pass

    with cast(Any, event).install_listener("numba:compile", Listener()):
        yield


@cache
def _kernel_folder() -> Path:
    root = Path(__file__).resolve().parents[2]
    files = (file.relative_to(root) for package in PACKAGES for file in (root / package).rglob("*.py"))
    sources = sorted(root / file for file in files if not {*WITHOUT_KERNELS} & {*file.parts})
    return keyed_folder("kernels", hash_of_files(sources, numba.__version__))


@cache
def _content(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()[:20]


class KernelLocator:
    """Tells numba where a function's machine code lies: by its module's name and its file's content, wherever that file is.

    numba's own hashes the file's path, and writes a file for each function to see whether that is possible.
    """

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._folder = _kernel_folder() / f"{function.__module__}-{_content(file)}"
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "KernelLocator":
        """The locator of a function of a file."""
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        """Make the folder."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def get_source_stamp(self) -> str:
        """The same at any time: an edit gives another folder."""
        return ""

    def get_disambiguator(self) -> str:
        """The line, as functions of a file may have one name."""
        return str(self._line)


def kernel(function: F) -> F:
    """Mark a function as compiled code: off the GIL, never raising, its machine code cached.

    Division by zero gives inf or NaN as in NumPy. fastmath stays off, so that NaN checks mean something. Only a kernel that
    Python calls gets machine code, with all its callees in it, one for all constants and shapes of arrays.
    """
    compiled = _cached(function)

    @cache
    def inner() -> Any:
        """The same kernel for callers that are compiled themselves."""
        njit: Any = numba.njit
        made = njit(nogil=True, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
        made.compile = linked_flat(made.compile)
        return made

    compiled.compile = linked_flat(compiled.compile)
    compiled.get_call_template = lambda args, kws: inner().get_call_template(*_generals(args, kws))
    compiled.get_overload = lambda signature: inner().get_overload(signature)
    return cast(F, compiled)


def shared_kernel(function: F) -> F:
    """As `kernel`, with machine code of its own, which callers call instead of having it in theirs: for large functions that
    are part of several programs, as they are compiled once.
    """
    compiled = _cached(function)
    find_template = compiled.get_call_template
    compiled.compile = linked_shared(compiled)
    compiled.get_call_template = lambda args, kws: find_template(*_generals(args, kws))
    return cast(F, compiled)


def _cached(function: Callable[..., Any]) -> Any:
    """Numba's dispatcher, with the cache in our folder."""
    settings: Any = numba.config
    njit: Any = numba.njit
    before = settings.CACHE_LOCATOR_CLASSES
    settings.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"
    try:
        compiled: Any = njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)(function)
    finally:
        settings.CACHE_LOCATOR_CLASSES = before
    return compiled


def _generals(args: Any, kws: Any) -> tuple[Any, Any]:
    """The general types of arguments, see `_general`."""
    return tuple(_general(each) for each in args), {name: _general(each) for name, each in kws.items()}


def _general(kind: Any) -> Any:
    """The type of an argument without a constant's value and an array's shape."""
    general: Any = cast(Any, types.unliteral)(kind)
    if isinstance(general, types.IntEnumMember):
        return general.dtype
    return types.Array(general.dtype, general.ndim, "C") if isinstance(general, types.NestedArray) else general


@lower_cast(types.NestedArray, types.Array)  # type: ignore[no-untyped-call, untyped-decorator]
def _cast_nested(context: Any, builder: Any, from_type: Any, to_type: Any, value: Any) -> Any:
    """Both lie in memory alike."""
    return value
