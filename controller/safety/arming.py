"""Arming: what must hold before the drives are enabled, and again before anything moves."""

import numpy as np

from controller.estimation.imu_monitor import contradiction
from controller.safety.causes import Cause, DriveState, Mode, Request, report_event
from controller.safety.stop import handle_cause
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT

PARAMETERS = record_dtype(
    active=np.int64,  # whether the drives are to be enabled
    distance=np.float64,  # how far a leg may be from the start of the target [m]
    cycles=np.int64,  # how long arming may take
)
"""The constants of arming."""

STATE = record_dtype(
    delay=np.int64,  # how many cycles arming took beyond the hold
    obstacle=np.int64,  # what prevents it, a `Cause` with its leg or IMU, value and limit
    index=np.int64,
    value=np.float64,
    limit=np.float64,
)
"""How arming goes."""


def arming_parameters(settings: SafetySettings, rate: float, active: bool) -> Record:
    """The constants of arming (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    cycles = int(np.ceil(settings.arming_time * rate))
    return filled(PARAMETERS, active=active, distance=settings.arming_distance, cycles=cycles)


def describe_obstacle(state: Record) -> str:
    """What prevents arming, in words, from the cycle's state; "" if nothing does."""
    arming = state["safety"]["arming"]
    cause = Cause(int(arming["obstacle"]))
    if cause == Cause.NONE:
        return ""
    return cause.describe(int(arming["index"]), float(arming["value"]), float(arming["limit"]))


@kernel
def run_arming_checks(
    p: Record, s: Record, rig: Record, time: Record, imu_parameters: Record, imus: Record, pose: Record, reference: Record,
    pid: Record,
) -> None:  # fmt: skip
    """Before the commands: from idle to armed, and from armed to running.

    Idle becomes armed when the IMUs are plausible, the pose is in the workspace and where the target begins, and the drives
    are there. Armed becomes running when all drives follow.
    """
    a = s.arming
    if time.cycle < rig.hold_cycles or s.mode > Mode.ARMED:
        return
    if s.mode == Mode.IDLE:
        a.obstacle, a.index, a.value, a.limit = _find_obstacle(p, s, rig, imu_parameters, imus, pose, pid)
        if a.obstacle == Cause.NONE and p.arming.active != 0:
            s.mode, s.request = Mode.ARMED, Request.ENABLED
            report_event(s.events, Cause.ARMED, -1, np.nan, np.nan)
    if s.mode == Mode.ARMED:
        a.obstacle, a.index, a.value, a.limit = _find_obstacle(p, s, rig, imu_parameters, imus, pose, pid)
        if a.obstacle != Cause.NONE:
            # The drives are enabled already, so arming does not wait here.
            handle_cause(p, s, rig, time, reference, pid, a.obstacle, a.index, a.value, a.limit)
            return
        for k in range(rig.legs):
            if s.watch.drive[k] != DriveState.FOLLOWING and a.obstacle == Cause.NONE:
                a.obstacle, a.index, a.value, a.limit = Cause.NO_DRIVES, k, np.nan, np.nan
        if a.obstacle == Cause.NONE:
            s.mode = Mode.RUNNING
            a.delay = time.cycle - rig.hold_cycles
            return
    if p.arming.active == 0:
        return
    a.delay = time.cycle + 1 - rig.hold_cycles
    if a.delay > p.arming.cycles:
        handle_cause(p, s, rig, time, reference, pid, a.obstacle, a.index, a.value, a.limit)


@kernel
def postpones_arming(p: Record, s: Record, rig: Record, time: Record, cause: int) -> bool:
    """Whether a cause only prevents arming: nothing has been armed, and there is still time. A rig that does not answer is the
    obstacle before anything that its samples tell.
    """
    a = s.arming
    if s.mode != Mode.IDLE:
        return False
    a.obstacle, a.index, a.value, a.limit = cause, -1, np.nan, np.nan
    if s.watch.unanswered > 0:
        a.obstacle, a.value, a.limit = Cause.BUS_LOST, _unanswered_for(s.watch), 0.0
    if time.cycle >= rig.hold_cycles and p.arming.active != 0:
        a.delay = time.cycle + 1 - rig.hold_cycles
    return bool(a.delay <= p.arming.cycles)


@kernel
def _unanswered_for(watch: Record) -> float:
    """For how many cycles the rig has not answered, in a row or more often than it did."""
    return float(max(watch.silent, watch.unanswered))


@kernel
def _find_obstacle(
    p: Record, s: Record, rig: Record, imu_parameters: Record, imus: Record, pose: Record, pid: Record
) -> tuple[int, int, float, float]:
    """The first obstacle: a `Cause` with its leg or IMU, value and limit."""
    # Without answers, nothing below is about the present.
    if s.watch.unanswered > 0:
        return Cause.BUS_LOST.value, -1, _unanswered_for(s.watch), 0.0
    lost, lengths, error = 0, pose.lengths, pid.error
    for k in range(IMU_COUNT):
        off = contradiction(s.monitor, k)
        if not off <= p.monitor.disagreement:
            return Cause.NO_SENSORS.value, k, off, p.monitor.disagreement
        lost += imu_parameters.present[k] != 0 and imus.used[k] == 0
        if lost > p.watch.most_lost_imus:
            return Cause.NO_SENSORS.value, k, np.nan, np.nan
    for k in range(rig.legs):
        low, high = p.watch.lengths[k, 0], p.watch.lengths[k, 1]
        if not low <= lengths[k] <= high:
            return Cause.NO_WORKSPACE.value, k, lengths[k], low if lengths[k] < low else high
        if not abs(error[k]) <= p.arming.distance:
            return Cause.NO_AGREEMENT.value, k, abs(error[k]), p.arming.distance
        if s.watch.drive[k] != DriveState.READY and s.watch.drive[k] != DriveState.FOLLOWING:
            return Cause.NO_DRIVES.value, k, np.nan, np.nan
    return Cause.NONE.value, 0, np.nan, np.nan
