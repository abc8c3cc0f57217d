"""A streamed reference: plans that one process makes while the loop of another follows them, and why a stream has failed.

The two share one record () of dtype `STREAM`, and neither ever waits for the other. A plan begins at a time in the future,
exactly in the state that the previous plan has at that time. The loop takes it only if that time has not passed and the loop
follows the previous plan; then it reports what it did. So the reference is continuous, whatever is late or lost. Every plan
ends at rest.
"""

import numpy as np

from controller.planning.segments import LENGTH, START
from controller.safety.causes import Cause
from plant.compiled import Record, fence, kernel, load_acquire, record_dtype, store_release
from plant.mechanism import LEGS
from plant.pose import Array

PLAN_SEGMENTS = 24
"""Rows of a plan for each leg: ten of ruckig's, a moment at constant speed, a stop of four, and some spare."""

FOLLOWED_SEGMENTS = 2 * PLAN_SEGMENTS
"""Rows of the array that the cycle follows: the rest of the previous plan, and the new one."""

STREAM_PATIENCE_S = 0.1
"""How long a stream may be silent before the motion stops."""

CYCLE, LATEST, SEEN, TAKEN, CAUSE, SAMPLE_NS, END_PLANNER = range(7)
"""Places in `shared`: cycles since the motion began; the numbers of the latest plan, of the last plan that the loop has seen,
and of the plan that it follows; why the stream has failed; when the last sample came [ns of CLOCK_MONOTONIC, 0 before the
first and after the end of the stream]; whether the planner's process must end."""

STREAM = record_dtype(
    shared=(np.int64, 8),
    guards=(np.int64, 2),  # number of each slot's plan, 0 while it is written
    bases=(np.int64, 2),  # the plan that it follows
    begins=(np.float64, 2),  # [s]
    plans=(np.float64, (2, LEGS, PLAN_SEGMENTS, 5)),
    index=np.int64,  # leg, value and limit of the failure
    value=np.float64,
    limit=np.float64,
    accepted=np.int64,  # samples
    malformed=np.int64,  # datagrams
    stale=np.int64,  # datagrams that came late or twice
    strange=np.int64,  # datagrams from another sender
    planned=np.int64,  # plans
    late=np.int64,  # plans that the loop could not take in time
)
"""What planner and loop share; plans lie in two slots by turns. In `shared`, the loop writes `CYCLE`, `SEEN` and `TAKEN`, the
planner the others, and the process that ends the planner `END_PLANNER`.
"""

STREAM_READER = record_dtype(
    seen=np.int64,  # the last plan that the loop has seen
    taken=np.int64,  # the plan that it follows
    plan=(np.float64, (LEGS, PLAN_SEGMENTS, 5)),  # scratch
)
"""The loop's own side of a stream."""


def rest(lengths: Array, rows: int = FOLLOWED_SEGMENTS) -> Array:
    """Segments (6, rows, 5) that stay at lengths (n,) [m] of n legs without end, the others at 0: the start of a stream."""
    segments = np.zeros((LEGS, rows, 5))
    segments[:, 1:, START] = np.inf
    segments[: len(lengths), 0, LENGTH] = lengths
    return segments


@kernel
def publish_plan(stream: Record, plan: Array, begin: float, base: int) -> int:
    """Publish a plan (6, 24, 5) to the loop. It begins at `begin` [s] and follows plan `base`. Returns its number."""
    s = stream[()]
    number = load_acquire(s.shared, LATEST) + 1
    slot = number % 2
    store_release(s.guards, slot, 0)
    fence()
    s.plans[slot] = plan
    s.begins[slot] = begin
    s.bases[slot] = base
    store_release(s.guards, slot, number)
    store_release(s.shared, LATEST, number)
    return int(number)


@kernel
def take_plan(stream: Record, reader: Record, cycle: int, period: float, segments: Array, index: Array) -> bool:
    """Take over the latest plan if it is new and can still be taken; never waits.

    Args:
        stream: dtype `STREAM`.
        reader: dtype `STREAM_READER`.
        cycle: of the motion; its reference is evaluated next.
        period: of a cycle [s].
        segments: (6, n, 5), which the cycle follows; the new plan is put after the rest of the previous one.
        index: (6,), the cycle's place in the segments.

    Returns:
        Whether a plan was taken.
    """
    s, r = stream[()], reader[()]
    store_release(s.shared, CYCLE, cycle)
    latest = load_acquire(s.shared, LATEST)
    if latest == r.seen:
        return False
    slot = latest % 2
    if load_acquire(s.guards, slot) != latest:
        return False
    begin, base = s.begins[slot], s.bases[slot]
    r.plan[:] = s.plans[slot]
    fence()
    if load_acquire(s.guards, slot) != latest:
        return False
    r.seen = latest
    taken = base == r.taken and begin >= cycle * period and _append(r.plan, begin, segments, index)
    if taken:
        r.taken = latest
        store_release(s.shared, TAKEN, latest)
    store_release(s.shared, SEEN, latest)
    return taken


@kernel
def _append(plan: Array, begin: float, segments: Array, index: Array) -> bool:
    """Replace the segments after the begin of a plan by the plan; False, and nothing changed, if there is no room."""
    rows = segments.shape[1]
    for leg in range(LEGS):
        if _kept(segments[leg], begin, index[leg]) + _used(plan[leg]) > rows:
            return False
    for leg in range(LEGS):
        kept, used, first = _kept(segments[leg], begin, index[leg]), _used(plan[leg]), index[leg]
        for row in range(rows):
            for column in range(5):
                if row < kept:
                    segments[leg, row, column] = segments[leg, first + row, column]
                elif row < kept + used:
                    segments[leg, row, column] = plan[leg, row - kept, column]
                else:
                    segments[leg, row, column] = np.inf if column == START else 0.0
        index[leg] = 0
    return True


@kernel
def _kept(rows: Array, begin: float, first: int) -> int:
    """The number of rows (n, 5), from the present one on, that start before a time."""
    last = first
    while last < rows.shape[0] and rows[last, START] < begin:
        last += 1
    return int(last - first)


@kernel
def _used(rows: Array) -> int:
    used = 0
    while used < rows.shape[0] and rows[used, START] < np.inf:
        used += 1
    return used


@kernel
def fail_stream(stream: Record, cause: int, index: int, value: float, limit: float) -> None:
    """Report why the stream has failed, a `Cause`; the first report counts."""
    s = stream[()]
    if load_acquire(s.shared, CAUSE) == Cause.NONE:
        s.index, s.value, s.limit = index, value, limit
        store_release(s.shared, CAUSE, cause)


@kernel
def note_sample(stream: Record, time_ns: int) -> None:
    """Report when the last sample came [ns of CLOCK_MONOTONIC], or 0: the stream has ended, and no further one is due."""
    store_release(stream[()].shared, SAMPLE_NS, time_ns)


@kernel
def stream_cause(stream: Record, now_ns: int, patience_ns: int) -> tuple[int, int, float, float]:
    """Why the stream has failed: cause, leg, value and limit; `NO_CAUSE` if it has not.

    The stream is lost when no sample has come for longer than the patience. It cannot be lost before the first sample,
    nor after its end.
    """
    s = stream[()]
    cause = load_acquire(s.shared, CAUSE)
    if cause != Cause.NONE:
        return cause, s.index, s.value, s.limit
    last = load_acquire(s.shared, SAMPLE_NS)
    if last != 0 and now_ns - last > patience_ns:
        return Cause.TARGET_LOST, 0, 1e-9 * (now_ns - last), 1e-9 * patience_ns
    return Cause.NONE, 0, np.nan, np.nan
