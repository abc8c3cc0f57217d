"""A batch of a study's work, as a worker does it."""

import fcntl
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from platform import python_version
from typing import Any, Generic, TypeVar

from plant.compiled import hash_of_files, keyed_folder
from plant.errors import GoughError

Item = TypeVar("Item")
Result = TypeVar("Result")

_PACKAGES = ("plant", "controller", "hil", "fmus")
_SOURCES = (".py", ".c", ".h", ".toml")
_WITHOUT_RESULTS = ("command_line", "reports")
"""Rooms that show results and make none."""
_LIBRARIES = ("casadi", "filterpy", "fmpy", "llvmlite", "numba", "numpy", "ruckig", "scipy", "vqf")
"""What computes; some are there only with extras."""


@dataclass(frozen=True)
class Failure:
    """An item whose function raised an error, or that no worker survived."""

    reason: str
    trace: str = ""  # where it was raised, if that is an error of the program
    died: bool = False  # whether the workers died
    again: bool = False  # whether another try may succeed: the machine or the program is to blame, not the item
    exit_status: int | None = None  # of a command that fails for this reason, if the error says so
    error: Exception | None = field(default=None, compare=False)  # in the process that raised it


@dataclass(frozen=True)
class Batch(Generic[Result]):
    """The results of a batch, and the time [s] that an item took; without items that had to wait for machine code, NaN."""

    results: list[Result | Failure]
    seconds: float


@dataclass(frozen=True)
class Refusal:
    """Why a worker, at this address, cannot take part."""

    worker: str
    reason: str


@cache
def fingerprint() -> str:
    """A hash of all that determines results: gough's sources, and the versions of Python and the libraries that compute."""
    root = Path(__file__).resolve().parents[2]
    files = (file.relative_to(root) for package in _PACKAGES for file in (root / package).rglob("*.*"))
    kept = (file for file in files if file.suffix in _SOURCES and not {*_WITHOUT_RESULTS} & {*file.parts})
    installed = (f"{name} {version(name)}" for name in _LIBRARIES if find_spec(name))
    return hash_of_files([root / file for file in sorted(kept)], python_version(), *installed)


_OF_MACHINE = (OSError, ImportError)
"""Errors of the machine that does the work, such as a full disk and a missing compiler or package."""


def attempt(function: Callable[[Item], Result], item: Item) -> Result | Failure:
    """What a function gives for an item, or why it failed."""
    try:
        return function(item)
    except GoughError as error:
        again = any(isinstance(each, _OF_MACHINE) for each in (error, error.__context__))
        return Failure(str(error), again=again, exit_status=getattr(error, "exit_status", None), error=error)
    except Exception as error:
        return Failure(f"{type(error).__name__}: {error}", traceback.format_exc(), again=True, error=error)


_ONE_AT_A_TIME = threading.Lock()
"""A run takes a whole process, and `dask worker` has a thread for each processor unless it is told otherwise."""


def run_batch(
    function: Callable[[Item], Result], items: Sequence[Item], kinds: Sequence[str], sources: str
) -> Batch[Result] | Refusal:
    """Do a batch of work on a worker, unless it would give other results than who asks.

    Args:
        function: what to do with an item.
        items: the batch.
        kinds: of each item; all items of a kind need the same machine code and FMU.
        sources: the `fingerprint` of who asks.
    """
    if sources != fingerprint():
        from distributed import get_worker

        reason = f"its gough {version('gough')} has other sources ({fingerprint()}) than this one ({sources})"
        return Refusal(get_worker().address, reason)
    with _ONE_AT_A_TIME:
        return _run_batch(function, items, kinds)


def _run_batch(function: Callable[[Item], Result], items: Sequence[Item], kinds: Sequence[str]) -> Batch[Result]:
    results: list[Result | Failure] = []
    times: list[float] = []
    for item, kind in zip(items, kinds, strict=True):
        outcome = attempt(partial(_timed, function, kind, times), item)
        if isinstance(outcome, Failure):
            outcome = replace(outcome, error=None)
        results.append(outcome)
    return Batch(results, sum(times) / len(times) if times else float("nan"))


def _timed(function: Callable[[Item], Result], kind: str, times: list[float], item: Item) -> Result:
    """What a function gives for an item; adds the time [s] that it took, unless it had to wait for machine code."""
    with alone_if_first(kind) as first:
        began = time.perf_counter()
        try:
            return function(item)
        finally:
            if not first:
                times.append(time.perf_counter() - began)


_prepared: set[str] = set()
"""Kinds of work that this process has begun."""


@contextmanager
def alone_if_first(kind: str) -> Iterator[bool]:
    """Let no other process of this machine do work of a kind that was never done on it, as that builds what all need.

    Yields whether this process has not begun such work yet. Work that raises an error may have built nothing, so the next
    process is alone, too.
    """
    if kind in _prepared:
        yield False
        return
    folder = keyed_folder("prepared", hash_of_files([], fingerprint(), kind))
    done = folder / "done"
    with (folder / "lock").open("w") as lock:
        if not done.exists():
            fcntl.flock(lock, fcntl.LOCK_EX)
        _prepared.add(kind)
        yield True
        done.touch()


def no_kind(item: Any) -> str:
    """The kind of items that are all alike."""
    return ""
