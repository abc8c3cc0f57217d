"""The engine of all studies: a function and its items in, results out, from one process or from many."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from importlib.util import find_spec
from typing import Any, TypeVar, cast

from hil.engine.batches import Failure, attempt, no_kind
from hil.engine.settings import EngineSettings
from hil.progress import Progress, no_progress
from plant.errors import GoughError
from plant.extras import check_installed

Item = TypeVar("Item")
Result = TypeVar("Result")


class WorkFailedError(GoughError, RuntimeError):
    """An item of a study has failed in another process."""

    def __init__(self, reason: str, exit_status: int | None) -> None:
        super().__init__(reason)
        if exit_status is not None:
            self.exit_status = exit_status


class Engine(ABC):
    """Does work item by item. Functions, items and results go to other processes, so they can be pickled."""

    workers: int = 1
    """How many items are worked on at the same time."""
    dashboard: str | None = None
    """Address of a page that shows the work."""
    joined_at: str | None = None
    """Address at which workers of other machines can join."""

    @abstractmethod
    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], kind: Callable[[Item], str] = no_kind
    ) -> Iterator[tuple[int, Result | Failure]]:
        """The results with the numbers of their items, as they come; an item that fails gives a `Failure`.

        Args:
            function: what to do with an item.
            items: the work.
            kind: items of the same kind need the same machine code and FMU, which are built once on each machine.

        Raises:
            GoughError: the workers have gone, or have another version of gough.
        """

    def map(self, function: Callable[[Item], Result], items: Sequence[Item], progress: Progress = no_progress) -> list[Result]:
        """The results in the order of the items, which all need the same machine code and FMU.

        Raises:
            GoughError: an item has failed, or as for `run`.
        """
        results: dict[int, Result] = {}
        kind = _name(function)
        for number, outcome in self.run(function, items, lambda item: kind):
            if isinstance(outcome, Failure):
                if outcome.error is not None:
                    raise outcome.error
                raise RuntimeError(outcome.trace) if outcome.trace else WorkFailedError(outcome.reason, outcome.exit_status)
            results[number] = outcome
            progress(len(results) / len(items))
        return [results[number] for number in range(len(items))]

    def starmap(
        self, function: Callable[..., Result], items: Sequence[tuple[Any, ...]], progress: Progress = no_progress
    ) -> list[Result]:
        """As `map`, where an item has the function's arguments."""
        return self.map(partial(_spread, function), items, progress)


def _spread(function: Callable[..., Result], arguments: tuple[Any, ...]) -> Result:
    return function(*arguments)


def _name(function: Any) -> str:
    """The module and the name of a function, or of the one that a partial one calls."""
    while isinstance(function, partial):
        function = function.args[0] if function.func is _spread else function.func
    return f"{function.__module__}.{function.__qualname__}"


class InOneProcess(Engine):
    """Does one item after the other, here."""

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], kind: Callable[[Item], str] = no_kind
    ) -> Iterator[tuple[int, Result | Failure]]:
        """As `Engine.run`, in the order of the items."""
        return ((number, attempt(function, item)) for number, item in enumerate(items))


IN_ONE_PROCESS = InOneProcess()


class _WhenNeeded(Engine):
    """An engine that is opened with its first work."""

    def __init__(self, opened: Callable[[], Engine]) -> None:
        self._opened = opened

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], kind: Callable[[Item], str] = no_kind
    ) -> Iterator[tuple[int, Result | Failure]]:
        """As `Engine.run`."""
        return self._opened().run(function, items, kind) if items else iter(())


@contextmanager
def open_engine(settings: EngineSettings | None = None) -> Iterator[Engine]:
    """The engine that settings ask for; without Dask, and without settings that need it, all is done in this process.

    Raises:
        GoughError: the scheduler cannot be reached, or an address or a file for TLS cannot be used.
        MissingPackageError: the settings need Dask, and it is not installed.
    """
    settings = settings or EngineSettings()
    if not settings.alone and settings != EngineSettings():
        check_installed("distributed")
    if settings.alone or find_spec("distributed") is None:
        yield InOneProcess()
        return
    from hil.engine.cluster import connected

    with connected(settings) as engine:
        yield cast(Engine, engine)


@contextmanager
def engine_when_needed(settings: EngineSettings, tell: Callable[[Engine], object]) -> Iterator[Engine]:
    """As `open_engine`, but opened with its first work: what is wrong with a study is told before any process starts.

    `tell` is called with the engine that was opened.
    """
    with ExitStack() as stack:

        @cache
        def opened() -> Engine:
            engine = stack.enter_context(open_engine(settings))
            tell(engine)
            return engine

        yield _WhenNeeded(opened)
