"""The engine on Dask distributed: a cluster of this machine's processes, or one that is there already."""

import logging
import math
import pickle
import signal
import ssl
import threading
import time
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from multiprocessing import resource_tracker, spawn
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import cloudpickle
import dask
from distributed import Client, KilledWorker, LocalCluster, Security, as_completed
from distributed.comm.core import CommClosedError
from distributed.utils import LoopRunner

from hil.engine.batches import Batch, Failure, Refusal, fingerprint, no_kind, run_batch
from hil.engine.engine import Engine
from hil.engine.settings import EngineSettings, host_and_port
from plant.compiled import keyed_folder
from plant.errors import GoughError, InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_BATCH_S = 2.0
"""How long a batch should take [s]: Dask needs 1 to 2 ms for each."""
_AHEAD = 2
"""Batches for each worker, so that none waits for the next."""
_MOST_GROWTH = 16
_TRIES = 3
"""How often a worker may die over an item: in a batch, by itself, and at last while nothing else is at work."""
_DIED = "the processes that worked on it died: it ends them, crashes, or takes more memory than there is"
_CONNECT_S, _FIRST_WORKER_S, _CLOSE_S, _LOOK_S, _SILENT_S = 10.0, 60.0, 30.0, 0.02, 10.0

_LOG = logging.getLogger("gough")
"""Without a handler, Python prints its warnings on standard error, a line each."""


class SchedulerLostError(GoughError, ConnectionError):
    """The scheduler has gone; what was finished before is there."""

    exit_status = 1


class WorkerRefusedError(GoughError, RuntimeError):
    """No worker is left, as the last one has another version of gough, or of what computes for it."""

    exit_status = 1


class DaskEngine(Engine):
    """Sends batches of items to the workers of a Dask cluster, and the items of a worker that dies to another."""

    def __init__(self, client: Client, joined_at: str | None = None) -> None:
        self._client, self._address, self.joined_at = client, client.scheduler.address, joined_at
        self.dashboard = client.dashboard_link
        self._refused: set[str] = set()

    @property
    def workers(self) -> int:  # type: ignore[override]
        """How many items are worked on at the same time: workers come and go."""
        return max(1, self._present())

    def _present(self) -> int:
        try:
            return len(self._client.nthreads())
        except (OSError, RuntimeError, AttributeError, TimeoutError) as error:
            raise self._lost(error) from None

    def _lost(self, error: BaseException) -> SchedulerLostError:
        return SchedulerLostError(
            f"the scheduler at {self._address} has gone ({type(error).__name__}); what was finished is kept: start a scheduler "
            "and workers again, and the same command goes on from there"
        )

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], kind: Callable[[Item], str] = no_kind
    ) -> Iterator[tuple[int, Result | Failure]]:
        """As `Engine.run`."""
        queue, running = _Queue(len(items)), dict[Any, list[int]]()
        completed, names = as_completed(loop=self._client.loop), (f"gough-{uuid4().hex}-{n}" for n in count())
        try:
            while True:
                workers = self.workers
                while len(running) < _AHEAD * workers and (numbers := queue.next(list(running.values()), workers)):
                    batch, kinds = [items[n] for n in numbers], [kind(items[n]) for n in numbers]
                    call = cloudpickle.dumps(_Call(run_batch, function, batch, kinds, fingerprint()))
                    future = self._client.submit(pickle.loads, call, key=next(names), pure=False)
                    running[future] = numbers
                    completed.add(future)
                if not running:
                    return
                future = self._next(completed)
                numbers, outcome = running.pop(future), self._outcome(future)
                if outcome is None:
                    for number in queue.died(numbers):
                        yield number, Failure(_DIED, died=True)
                elif isinstance(outcome, Refusal):
                    queue.put_back(numbers)
                    self._leave_out(outcome)
                else:
                    queue.took(outcome.seconds)
                    yield from zip(numbers, outcome.results, strict=True)
                future.release()
        finally:
            with suppress(Exception):
                self._client.cancel(list(running), force=True)

    def _next(self, completed: Any) -> Any:
        """The next batch that is finished; waits for workers if there are none."""
        silent_from = time.monotonic() + _SILENT_S
        while not completed.has_ready():
            time.sleep(_LOOK_S)
            if time.monotonic() > silent_from:
                silent_from = math.inf
                if not self._present():
                    _LOG.warning("no worker is there; the work goes on as soon as one joins")
        return next(completed)

    def _outcome(self, future: Any) -> Batch[Any] | Refusal | None:
        """A finished batch, or why the worker did not do it; None if the worker died."""
        try:
            outcome: Batch[Any] | Refusal = future.result()
            return outcome
        except KilledWorker:
            return None
        except (CancelledError, CommClosedError, TimeoutError) as error:
            raise self._lost(error) from None
        except (ImportError, AttributeError) as error:
            raise WorkerRefusedError(f"a worker cannot take part: {error}; install the same gough on all machines") from None

    def _leave_out(self, refusal: Refusal) -> None:
        if refusal.worker in self._refused:
            return
        self._refused.add(refusal.worker)
        with suppress(OSError, TimeoutError):
            self._client.retire_workers([refusal.worker], close_workers=True)
        text = f"the worker at {refusal.worker} is left out: {refusal.reason}; install the same on all machines"
        if not self._present():
            raise WorkerRefusedError(text)
        _LOG.warning(text)


class _Call:
    """A call that is made where its pickled form is read: a scheduler and a worker pass it on without knowing what it needs."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self._call = function, arguments

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return self._call


class _Queue:
    """The numbers of items that are still to do, and how many of them make a batch."""

    def __init__(self, items: int) -> None:
        self._left, self._suspects = deque(range(items)), deque[int]()
        self._deaths = Counter[int]()
        self._size = 1

    def next(self, running: list[list[int]], workers: int) -> list[int]:
        """The next batch beside those that are running; none if they must end first, or if there is no more.

        Items of a batch over which a worker died go one at a time, beside batches that have killed none. What dies again is
        alone on the cluster in the end, so that no other item pays for it, and none is taken for guilty that is not.
        """
        suspect = next((numbers[0] for numbers in running if self._deaths[numbers[0]]), None)
        if suspect is not None and self._last_try(suspect):
            return []
        if self._suspects and suspect is None:
            return [] if self._last_try(self._suspects[0]) and running else [self._suspects.popleft()]
        # The last batches are small, so that all workers end together.
        most = max(1, min(self._size, len(self._left) // (_AHEAD * workers)))
        return [self._left.popleft() for _ in range(min(most, len(self._left)))]

    def _last_try(self, number: int) -> bool:
        return self._deaths[number] == _TRIES - 1

    def died(self, numbers: list[int]) -> list[int]:
        """Take back a batch over which a worker died; returns the items that are not tried again."""
        self._deaths.update(numbers)
        again = [number for number in numbers if self._deaths[number] < _TRIES]
        self._suspects.extend(again)
        return [number for number in numbers if number not in again]

    def put_back(self, numbers: list[int]) -> None:
        """Take back a batch that has not begun."""
        for number in reversed(numbers):
            (self._suspects if self._deaths[number] else self._left).appendleft(number)

    def took(self, seconds: float) -> None:
        """Choose the size of batches by the time that an item took [s], if that is known."""
        if math.isfinite(seconds):
            self._size = max(1, min(round(_BATCH_S / max(seconds, 1e-9)), _MOST_GROWTH * self._size))


@contextmanager
def connected(settings: EngineSettings) -> Iterator[DaskEngine]:
    """An engine on the cluster that settings name, or on a new one of this machine's processes.

    Raises:
        GoughError: it cannot be reached or started.
    """
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        security = _security(settings)
        if settings.scheduler is not None:
            client = stack.enter_context(_client(settings.scheduler, security))
            _wait_for_workers(client, settings.scheduler)
            yield DaskEngine(client)
            return
        cluster = stack.enter_context(_local_cluster(settings, security))
        joined_at = cluster.scheduler_address if settings.others_join else None
        yield DaskEngine(stack.enter_context(_client(cluster, security)), joined_at)


@contextmanager
def _local_cluster(settings: EngineSettings, security: Security | None) -> Iterator[LocalCluster]:
    """A scheduler in this process, and processes that work. All but the scheduler listens on loopback only."""
    with ExitStack() as stack:
        files = {"ca-file": settings.tls_ca, "cert": settings.tls_cert, "key": settings.tls_key}
        tls = {f"distributed.scheduler.dashboard.tls.{name}": file for name, file in files.items()}
        # The profiles of tasks that Dask keeps would let a worker grow by a hundred kilobytes a run, for an hour. Its threshold
        # for giving memory back would make every run ask the kernel for its records anew, which costs a tenth of the time.
        own = {"distributed.worker.profile.enabled": False, "distributed.nanny.pre-spawn-environ.MALLOC_TRIM_THRESHOLD_": None}
        stack.enter_context(dask.config.set({**tls, **own}))
        stack.enter_context(_main_module_not_run_again())
        loop = stack.enter_context(_loop_for_workers())
        with _ctrl_c_deferred():
            cluster = _started(settings, security, loop)
            stack.callback(_close, cluster)
        if settings.tls:
            cluster.scheduler.http_server.ssl_options.verify_mode = ssl.CERT_REQUIRED
        yield cluster


def _started(settings: EngineSettings, security: Security | None, loop: Any) -> LocalCluster:
    host, port = host_and_port(settings.listen)
    for tries_left in reversed(range(_TRIES)):
        try:
            return LocalCluster(
                n_workers=settings.processes,
                threads_per_worker=1,
                host="127.0.0.1",
                # `_Queue` tries again what a worker died over.
                scheduler_kwargs={"host": host, "allowed_failures": 0},
                scheduler_port=port,
                protocol="tls" if settings.tls else "tcp",
                security=security,
                dashboard_address=settings.dashboard,
                # If the user's cache cannot be written, all share the one of this process.
                env={"GOUGH_CACHE": str(keyed_folder("prepared", fingerprint()).resolve().parents[1])},
                loop=loop,
                silence_logs=logging.CRITICAL,
            )
        except (OSError, RuntimeError, ValueError) as error:
            # A worker that dies before it works fails the start.
            if not tries_left:
                raise InputError(f"cannot start a scheduler at {settings.listen} with its workers: {error}") from None
    raise AssertionError


def _close(cluster: LocalCluster) -> None:
    with _ctrl_c_deferred(), suppress(TimeoutError):
        cluster.close(timeout=_CLOSE_S)


@contextmanager
def _ctrl_c_deferred() -> Iterator[None]:
    """Let Dask start or end its processes, which takes seconds, before Ctrl-C is heeded."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        raise KeyboardInterrupt


@contextmanager
def _loop_for_workers() -> Iterator[Any]:
    """An event loop that starts processes which never see Ctrl-C: it is for this process, which then ends them."""
    runner = LoopRunner()
    # Else it would be started with the first process, and let signals through again.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        runner.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield runner.loop
    finally:
        runner.stop()


@contextmanager
def _main_module_not_run_again() -> Iterator[None]:
    """Let workers start without running the program's main module, so that it needs no `if __name__ == "__main__"`."""
    original = spawn.get_preparation_data

    def without_main(name: str) -> dict[str, Any]:
        data = original(name)
        if name.startswith("Dask Worker"):
            data = {each: value for each, value in data.items() if not each.startswith("init_main")}
        return data

    spawn.get_preparation_data = without_main
    try:
        yield
    finally:
        spawn.get_preparation_data = original


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask tells of workers that come, go and stand still for a second; only what ends the work is for the user."""
    loggers = [
        logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith(("distributed", "tornado"))
    ]
    handlers = {handler: handler.level for logger in loggers for handler in logger.handlers}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module="distributed")
        try:
            for handler in handlers:
                handler.setLevel(logging.CRITICAL + 1)
            yield
        finally:
            for handler, level in handlers.items():
                handler.setLevel(level)


def _security(settings: EngineSettings) -> Security | None:
    if not settings.tls:
        return None
    for path in (settings.tls_ca, settings.tls_cert, settings.tls_key):
        if path is None or not Path(path).is_file():
            raise InputError(f"there is no file {path} for TLS")
    files = {"tls_ca_file": settings.tls_ca}
    for role in ("client", "scheduler", "worker"):
        files |= {f"tls_{role}_cert": settings.tls_cert, f"tls_{role}_key": settings.tls_key}
    return Security(require_encryption=True, **files)


@contextmanager
def _client(where: Any, security: Security | None) -> Iterator[Client]:
    try:
        client = Client(where, security=security, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"no scheduler answers at {where}: {reason}") from None
    with client:
        yield client


def _wait_for_workers(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=_FIRST_WORKER_S)
    except (TimeoutError, OSError):
        raise InputError(
            f"the scheduler at {address} has had no worker for {_FIRST_WORKER_S:g} s: start some with 'dask worker {address}'"
        ) from None
