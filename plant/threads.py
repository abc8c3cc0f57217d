"""Work on the rows of arrays in several threads, by kernels that run off the GIL."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from plant.errors import InputError


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(work: Callable[[int, int], object], count: int, chunk: int, workers: int | None = None) -> None:
    """Call `work(start, stop)` for chunks of so many rows, until all `count` rows are done.

    Args:
        workers: threads; by default one for each core.

    Raises:
        InputError: `workers` is no whole number of threads.
    """
    if workers is None:
        workers = cores()
    if not isinstance(workers, int) or workers < 1:
        raise InputError(f"workers is {workers!r}; it must be a whole number of threads, 1 at least")
    parts = [(start, min(start + chunk, count)) for start in range(0, count, chunk)]
    if workers == 1 or len(parts) <= 1:
        for part in parts:
            work(*part)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(lambda part: work(*part), parts))
