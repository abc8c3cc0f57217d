"""Compilation in several processes at once, into the cache, from which this process then loads.

A worker does not compile the shared kernels that its own kernel calls: their names and types follow from their declarations. It
reports them, and the next free worker compiles them. No list of kernels is kept, and each shared kernel is compiled once.
"""

import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, cast

from numba import typeof
from numba.core import event
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import cpu_target

from plant.compiled.linking import Origin
from plant.compiled.shared import shared_kernels_declared
from plant.threads import cores

MOST_WORKERS = 4
"""More would wait for the largest kernels."""

_PATIENCE_S = 120.0
"""How long no worker may begin with a function before all are given up [s]."""

_LEFT_TO_PARENT = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT)


def load_kernels(*calls: tuple[Any, ...]) -> None:
    """Load the machine code of kernels for arguments of these types, or compile it; nothing is run.

    What is not in the cache is compiled by workers, as far as there are processors. What they leave undone is compiled here,
    and raises its errors here.

    Args:
        calls: a kernel and its arguments each.
    """
    type_of: Any = typeof
    typed = [(kernel, tuple(type_of(each) for each in arguments)) for kernel, *arguments in calls]
    missing = [_origin(kernel, types) for kernel, types in typed if not _is_cached(kernel, types)]
    workers = min(cores(), MOST_WORKERS)
    # A study's workers compile in threads, and there is one for each processor already.
    if missing and workers > 1 and threading.current_thread() is threading.main_thread():
        with suppress(Exception), _workers() as started:
            _compile(missing, started, workers)
    for kernel, types in typed:
        if types not in kernel.overloads:
            kernel.compile(types)


def _origin(kernel: Any, types: tuple[Any, ...]) -> Origin:
    return kernel.py_func.__module__, kernel.py_func.__qualname__, types


def _is_cached(kernel: Any, types: tuple[Any, ...]) -> bool:
    if types in kernel.overloads:
        return True
    cache = kernel._cache
    target: Any = cpu_target.target_context
    # What each worker would have to prepare is prepared once.
    target.refresh()
    return cache._index_key(types, target.codegen()) in cache._cache_file._load_index()


class _Worker(NamedTuple):
    """A process that compiles. It is sent origins of kernels, at last None; `_work` says what it answers."""

    pid: int
    pipe: Connection


@contextmanager
def _workers() -> Iterator[list[_Worker]]:
    """A list for workers; those in it are ended, whatever happens."""
    workers: list[_Worker] = []
    try:
        yield workers
    finally:
        for each in workers:
            each.pipe.close()
            with suppress(ProcessLookupError):
                os.kill(each.pid, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitpid(each.pid, 0)


def _compile(kernels: list[Origin], workers: list[_Worker], most: int) -> None:
    """Have workers compile kernels and the shared ones that they find, and save all."""
    known, waiting = {*kernels}, [*kernels]
    idle: list[Connection] = []
    busy: list[Connection] = []
    while waiting or busy:
        while waiting and (idle or len(workers) < most):
            if not idle:
                workers.append(_start(workers))
                idle.append(workers[-1].pipe)
            busy.append(idle.pop())
            busy[-1].send(waiting.pop(0))
        ready = wait(busy, _PATIENCE_S)
        if not ready:
            raise TimeoutError
        for pipe in cast(list[Connection], ready):
            match pipe.recv():
                case None:
                    busy.remove(pipe)
                    idle.append(pipe)
                case str(name):
                    cast(Any, event).start_event("numba:compile", {"dispatcher": name})
                case origin if origin not in known:
                    known.add(origin)
                    waiting.append(origin)
    for pipe in idle:
        pipe.send(None)
    for pipe in idle:
        pipe.recv()


def _start(others: list[_Worker]) -> _Worker:
    ours, theirs = Pipe()
    # No lock that a worker takes may be held by another thread: it compiles, and prints nothing.
    with global_compiler_lock, warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid:
        theirs.close()
        return _Worker(pid, ours)
    try:
        for each in (ours, *(other.pipe for other in others)):
            each.close()
        _work(theirs)
    finally:
        os._exit(0)


def _work(pipe: Connection) -> None:
    """Compile what the parent sends. Answer with the name of each function, the origin of each shared kernel that is called,
    None when a kernel is done, and None when all are saved.
    """
    for each in _LEFT_TO_PARENT:
        signal.signal(each, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    events: Any = event
    events._registered["numba:compile"][:] = [_reporter(pipe)]
    saves: list[Callable[[], None]] = []
    while (origin := pipe.recv()) is not None:
        _compile_one(origin, pipe, saves)
        _send(pipe, None)
    for save in saves:
        save()
    _send(pipe, None)


def _send(pipe: Connection, message: Any) -> None:
    """Send the parent a message; without a parent, the worker ends, which no error in the midst of numba can do for sure."""
    try:
        pipe.send(message)
    except OSError:
        os._exit(1)


def _reporter(pipe: Connection) -> Any:
    base: Any = event.Listener

    class Reporter(base):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            function = event.data["dispatcher"].py_func
            _send(pipe, f"{function.__module__}.{function.__qualname__}")

        def on_end(self, event: Any) -> None:
            pass

    return Reporter()


def _compile_one(origin: Origin, pipe: Connection, saves: list[Callable[[], None]]) -> None:
    """Compile a kernel. If it calls shared ones, it is saved when these are compiled: until then it could not be loaded."""
    module, name, types = origin
    kernel = getattr(import_module(module), name)
    save = kernel._cache.save_overload

    def save_or_keep(signature: Any, result: Any) -> None:
        if result.library.calls:
            saves.append(partial(save, signature, result))
        else:
            save(signature, result)

    def report(called: Any, arguments: tuple[Any, ...]) -> bool:
        elsewhere = called is not kernel
        if elsewhere:
            _send(pipe, _origin(called, arguments))
        return elsewhere

    kernel.overloads.pop(types, None)
    kernel._cache.save_overload = save_or_keep
    with shared_kernels_declared(report):
        kernel.compile(types)
    del kernel._cache.save_overload
