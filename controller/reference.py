"""The reference of each cycle: that of the motion, whose time begins when the run does, or that of a stop."""

import numpy as np

from controller.planning.segments import evaluate_reference
from controller.safety.causes import Cause, Mode, Request
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array

STATE = record_dtype(
    motion=(np.float64, (LEGS, 3)),
    index=(np.int64, LEGS),
    due_cycle=np.int64,
)
"""Length, rate and acceleration of each leg in the cycle before `due_cycle`, and each leg's place in the segments."""


@kernel
def motion_cycle(rig: Record, time: Record, safety: Record) -> int:
    """How many periods of the motion have passed; 0 before it begins."""
    return int(max(time.cycle - rig.hold_cycles - safety.arming.delay, 0)) if safety.mode >= Mode.RUNNING else 0


@kernel
def update_reference(s: Record, rig: Record, time: Record, safety: Record, segments: Array) -> None:
    """Evaluate the reference of this cycle.

    Args:
        s: dtype `STATE`.
        rig, time: dtypes `RIG` and `TIME`.
        safety: state of that stage, which has the segments of a stop.
        segments: (6, n, 5), the motion as `controller.planning.segments` has it.
    """
    stop = safety.stop
    if stop.cause != Cause.NONE and safety.request == Request.ENABLED:
        evaluate_reference(stop.segments, (time.cycle - stop.cycle) * rig.period, s.index, s.motion)
    else:
        evaluate_reference(segments, motion_cycle(rig, time, safety) * rig.period, s.index, s.motion)
    s.due_cycle = time.cycle + 1
