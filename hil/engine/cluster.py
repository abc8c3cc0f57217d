"""The engine on Dask distributed: a cluster of this machine's processes, or one that is there already."""

import logging
import math
import warnings
from asyncio import CancelledError
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, TypeVar
from uuid import uuid4

import dask
from distributed import Client, KilledWorker, LocalCluster, Security, as_completed
from distributed.comm.core import CommClosedError

from hil.engine.batches import Batch, Failure, SourcesDifferError, fingerprint, no_kind, run_batch
from hil.engine.engine import Engine
from hil.engine.settings import EngineSettings, host_and_port
from plant.errors import GoughError, InputError

Item = TypeVar("Item")
Result = TypeVar("Result")

_BATCH_S = 2.0
"""How long a batch should take [s]: Dask needs 1 to 2 ms for each."""
_AHEAD = 2
"""Batches for each worker, so that none waits for the next."""
_MOST_GROWTH = 16
_CONNECT_S, _FIRST_WORKER_S = 10.0, 60.0


class SchedulerLostError(GoughError, ConnectionError):
    """The scheduler has gone; what was finished before is there."""

    exit_status = 1


class DaskEngine(Engine):
    """Sends batches of items to the workers of a Dask cluster, and the items of a worker that dies to another."""

    def __init__(self, client: Client, workers: int) -> None:
        self._client, self._fixed = client, workers
        self.dashboard = client.dashboard_link

    @property
    def workers(self) -> int:  # type: ignore[override]
        """How many items are worked on at the same time: workers come and go."""
        return max(self._fixed, len(self._client.scheduler_info(n_workers=-1)["workers"]))

    def run(
        self, function: Callable[[Item], Result], items: Sequence[Item], kind: Callable[[Item], str] = no_kind
    ) -> Iterator[tuple[int, Result | Failure]]:
        """As `Engine.run`."""
        left, alone = deque(range(len(items))), deque[int]()
        running: dict[Any, list[int]] = {}
        completed, size, names = as_completed(loop=self._client.loop), 1, (f"gough-{uuid4().hex}-{n}" for n in count())

        def submit() -> None:
            while (alone or left) and len(running) < _AHEAD * self.workers:
                # The last batches are small, so that all workers end together.
                most = max(1, min(size, len(left) // (_AHEAD * self.workers)))
                numbers = [alone.popleft()] if alone else [left.popleft() for _ in range(most)]
                batch, kinds = [items[n] for n in numbers], [kind(items[n]) for n in numbers]
                future = self._client.submit(run_batch, function, batch, kinds, fingerprint(), key=next(names), pure=False)
                running[future] = numbers
                completed.add(future)

        try:
            submit()
            for future in completed:
                numbers = running.pop(future)
                batch = self._result(future)
                if batch is None and len(numbers) == 1:
                    yield numbers[0], Failure("the process that worked on it died, each time it was tried", died=True)
                elif batch is None:
                    alone.extend(numbers)
                else:
                    yield from zip(numbers, batch.results, strict=True)
                    if math.isfinite(batch.seconds):
                        size = max(1, min(round(_BATCH_S / max(batch.seconds, 1e-9)), _MOST_GROWTH * size))
                future.release()
                submit()
        finally:
            with suppress(Exception):
                self._client.cancel(list(running), force=True)

    def _result(self, future: Any) -> Batch[Any] | None:
        """A finished batch; None if every worker that tried it died."""
        try:
            batch: Batch[Any] = future.result()
            return batch
        except KilledWorker:
            return None
        except SourcesDifferError as error:
            raise SourcesDifferError(f"a worker cannot take part: {error}; install the same on all machines") from None
        except (CancelledError, CommClosedError, TimeoutError) as error:
            address = self._client.scheduler.address if self._client.scheduler else "Dask"
            raise SchedulerLostError(
                f"the scheduler at {address} has gone ({type(error).__name__}); what was finished is kept, and the same "
                "command goes on from there"
            ) from None


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
            yield DaskEngine(client, 1)
            return
        host, port = host_and_port(settings.listen)
        if settings.tls:
            stack.enter_context(
                dask.config.set(
                    {
                        "distributed.scheduler.dashboard.tls.ca-file": settings.tls_ca,
                        "distributed.scheduler.dashboard.tls.cert": settings.tls_cert,
                        "distributed.scheduler.dashboard.tls.key": settings.tls_key,
                    }
                )
            )
        try:
            cluster = stack.enter_context(
                LocalCluster(
                    n_workers=settings.processes,
                    threads_per_worker=1,
                    host=host,
                    scheduler_port=port,
                    protocol="tls" if settings.tls else "tcp",
                    security=security,
                    dashboard_address=settings.dashboard,
                    env={"OPENBLAS_NUM_THREADS": "1"},
                    silence_logs=logging.CRITICAL,
                )
            )
        except (OSError, RuntimeError, ValueError) as error:
            raise InputError(f"no scheduler can listen on {settings.listen}: {error}") from None
        yield DaskEngine(stack.enter_context(_client(cluster, security)), settings.processes)


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask tells of workers that come, go and stand still for a second; only what ends the work is for the user."""
    names = ("distributed", "tornado", "bokeh")
    levels = {name: logging.getLogger(name).level for name in names}
    with warnings.catch_warnings(), dask.config.set({"logging.distributed": "critical"}):
        warnings.filterwarnings("ignore", module="distributed")
        try:
            for name in names:
                logging.getLogger(name).setLevel(logging.CRITICAL)
            yield
        finally:
            for name, level in levels.items():
                logging.getLogger(name).setLevel(level)


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
