"""Processes beside this one: they share its memory, leave its signals to it, and end with it."""

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

FORK = multiprocessing.get_context("fork")
PATIENCE_S = 10.0
"""How long a process may take to end before it is killed."""

_ENDING = (
    signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM, signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU,
)  # fmt: skip


def started(target: Callable[..., None], *arguments: Any) -> BaseProcess:
    """Start a process that runs a function. The signals that end or stop a process are blocked, because the supervisor handles
    them; those that it ignores are ignored.
    """
    process = FORK.Process(target=_run, args=(target, *arguments))
    process.start()
    return process


def _run(target: Callable[..., None], *arguments: Any) -> None:
    # A signal that is ignored would be pending, and so heard, if it were blocked, too.
    signal.pthread_sigmask(signal.SIG_BLOCK, [each for each in _ENDING if signal.getsignal(each) != signal.SIG_IGN])
    target(*arguments)


@contextmanager
def signals_handled(numbers: Iterable[int], handle: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle signals while the context lasts, and as before after it."""
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def join_or_kill(process: BaseProcess) -> None:
    """Wait for the end of a process, and kill it if it does not end."""
    process.join(PATIENCE_S)
    if process.is_alive():
        process.kill()
        process.join()
