"""The clock that compiled code reads is the system's own, in nanoseconds."""

import time

import numpy as np

from plant.stopwatch import now


def test_the_compiled_clock_is_the_monotonic_clock_in_nanoseconds():
    timespec = np.zeros(2, np.int64)
    now(timespec)
    before = time.monotonic_ns()
    readings = [now(timespec) for _ in range(5)]
    after = time.monotonic_ns()
    assert before <= readings[0] and readings == sorted(readings) and readings[-1] <= after
    assert timespec[0] * 10**9 + timespec[1] == readings[-1]
