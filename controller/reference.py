"""The reference of each cycle: that of the way to the motion's start, of the motion itself, or of a stop."""

import numpy as np

from controller.planning.segments import evaluate_reference
from controller.safety.causes import Cause, Mode, Request
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array

STATE = record_dtype(
    motion=(np.float64, (LEGS, 3)),  # length, rate and acceleration in the cycle before `due_cycle` [m, m/s, m/s^2]
    index=(np.int64, LEGS),  # place in the segments
    due_cycle=np.int64,
)
"""The reference of each leg."""


@kernel
def motion_cycle(rig: Record, time: Record, safety: Record) -> int:
    """How many periods of the motion have passed; 0 before it begins."""
    return int(max(time.cycle - rig.hold_cycles - safety.arming.delay, 0)) if safety.mode >= Mode.RUNNING else 0


@kernel
def update_reference(s: Record, rig: Record, time: Record, safety: Record, segments: Array) -> None:
    """Evaluate the reference of this cycle, from the `segments` (6, n, 5) of the motion, those of the approach, or those of a
    stop.
    """
    stop, arming = safety.stop, safety.arming
    to_go = rig.hold_cycles + arming.delay - time.cycle
    if stop.cause != Cause.NONE and safety.request == Request.ENABLED:
        evaluate_reference(stop.segments, (time.cycle - stop.cycle) * rig.period, s.index, s.motion)
    elif safety.mode >= Mode.RUNNING and 0 < to_go <= arming.approach_cycles:
        s.index[:] = 0
        evaluate_reference(arming.approach, (arming.approach_cycles - to_go) * rig.period, s.index, s.motion)
        s.index[:] = 0
    else:
        evaluate_reference(segments, motion_cycle(rig, time, safety) * rig.period, s.index, s.motion)
    s.due_cycle = time.cycle + 1
