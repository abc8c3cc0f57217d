"""The clock of the loop: absolute deadlines, and missed periods that are skipped in phase and counted by cause.

A wake-up that is late by whole periods, or work that lasts into the next ones, skips those periods; the deadlines stay where
they are. Own work has missed a period if the thread worked longer than a period, both by the clock and by its CPU time. Else
the host has: it took the processor away, or handled interrupts in the thread's time. Time is CLOCK_MONOTONIC, which nobody
sets. In tests a script replaces it.
"""

from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from plant.compiled import Record, kernel, record_dtype
from plant.stopwatch import CLOCK_MONOTONIC, clock_gettime, now

FREE, REAL, SCRIPTED = range(3)
"""Whether the loop runs as fast as it can, on the machine's clock, or on a script."""

CLOCK = record_dtype(
    mode=np.int64,
    period=np.int64,
    start=np.int64,  # the first deadline
    deadline=np.int64,  # the next one
    woke=np.int64,
    late=np.int64,  # how late the cycle woke
    cpu=np.int64,  # the thread's CPU time at the end of the last cycle
    time=np.int64,  # the present of a script
    cycles=np.int64,
    overrun=np.int64,  # periods that the last cycle's work ran over
    in_a_row=np.int64,  # periods missed since two cycles last followed each other directly
    most_in_a_row=np.int64,
    missed_late=np.int64,  # periods missed because the thread woke late
    missed_own=np.int64,  # because of its own work
    missed_host=np.int64,  # because of the host
    timespec=(np.int64, 2),  # scratch
)
"""State of the clock; times are in ns."""

_CLOCK_THREAD_CPUTIME = 3
_TIMER_ABSTIME, _EINTR = 1, 4
_LEAD_NS = 2_000_000

_clock_nanosleep: Any = types.ExternalFunction("clock_nanosleep", types.int32(types.int32, types.int32, types.intp, types.intp))


def new_clock(mode: int, period_ns: int) -> Record:
    """A clock (dtype `CLOCK`) that has not started."""
    clock = np.zeros((), CLOCK)
    clock["mode"], clock["period"] = mode, period_ns
    return clock


@kernel
def _cpu_time(timespec: NDArray[np.int64]) -> int:
    clock_gettime(_CLOCK_THREAD_CPUTIME, timespec.ctypes.data)
    return int(timespec[0] * 1_000_000_000 + timespec[1])


@kernel
def start(clock: Record) -> None:
    """Set the first deadline, two milliseconds from now."""
    c = clock[()]
    if c.mode == REAL:
        c.deadline = now(c.timespec) + _LEAD_NS
        c.cpu = _cpu_time(c.timespec)
    else:
        c.deadline = c.period
    c.start = c.deadline


@kernel
def wait(clock: Record, script: NDArray[np.int64]) -> int:
    """Sleep until the deadline.

    Args:
        clock: dtype `CLOCK`.
        script: (n, 3) [ns], for each cycle of a scripted clock: lateness, duration of the work, CPU time of it.

    Returns:
        How many periods have been missed since the last cycle; -1 if the machine's clock fails.
    """
    c = clock[()]
    if c.mode == FREE:
        c.woke = now(c.timespec)
        return 0
    if c.mode == SCRIPTED:
        c.woke = max(c.time, c.deadline) + script[c.cycles % script.shape[0], 0]
    else:
        c.woke = now(c.timespec)
        while c.woke < c.deadline:
            c.timespec[0], c.timespec[1] = c.deadline // 1_000_000_000, c.deadline % 1_000_000_000
            status = _clock_nanosleep(CLOCK_MONOTONIC, _TIMER_ABSTIME, c.timespec.ctypes.data, 0)
            if status != 0 and status != _EINTR:
                return -1
            c.woke = now(c.timespec)
    c.late = c.woke - c.deadline
    late = c.late // c.period
    if c.cycles == 0:
        # The phase begins with the first cycle, so nothing is missed before it.
        c.deadline += late * c.period
        c.start = c.deadline
        return 0
    c.missed_late += late
    c.deadline += late * c.period
    missed = c.overrun + late
    c.in_a_row = c.in_a_row + missed if missed > 0 else 0
    c.most_in_a_row = max(c.most_in_a_row, c.in_a_row)
    return int(missed)


@kernel
def finish(clock: Record, script: NDArray[np.int64], worked: int) -> int:
    """End a cycle that `worked` for some time [ns], and set the next deadline; returns its CPU time [ns]."""
    c = clock[()]
    if c.mode == FREE:
        c.cycles += 1
        return 0
    if c.mode == SCRIPTED:
        row = script[c.cycles % script.shape[0]]
        done, used, worked = c.woke + row[1], row[2], row[1]
        c.time = done
    else:
        cpu = _cpu_time(c.timespec)
        used, c.cpu = cpu - c.cpu, cpu
        done = now(c.timespec)
    c.cycles += 1
    c.deadline += c.period
    c.overrun = 0
    if done > c.deadline:
        c.overrun = -((c.deadline - done) // c.period)
        c.deadline += c.overrun * c.period
        if min(used, worked) > c.period:
            c.missed_own += c.overrun
        else:
            c.missed_host += c.overrun
    return int(used)
