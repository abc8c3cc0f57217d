"""Arming: what must hold before the drives are enabled, and again before anything moves."""

import numpy as np

from controller.estimation.imu_monitor import contradiction
from controller.safety.causes import Cause, DriveState, Mode, Request, report_event
from controller.safety.stop import handle_cause
from controller.settings import SafetySettings
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT

PARAMETERS = record_dtype(active=np.int64, distance=np.float64, cycles=np.int64)
"""Whether the drives are to be enabled; how far a leg may be from the start of the target [m]; how long arming may take."""

STATE = record_dtype(
    delay=np.int64,
    obstacle=np.int64,
    index=np.int64,
    value=np.float64,
    limit=np.float64,
)
"""How many cycles arming took beyond the hold; and what prevents it, a `Cause` with its leg or IMU, value and limit."""


def arming_parameters(settings: SafetySettings, rate: float, active: bool) -> Record:
    """The constants of arming (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    parameters: Record = np.zeros((), PARAMETERS)
    parameters["active"], parameters["distance"] = active, settings.arming_distance
    parameters["cycles"] = np.ceil(settings.arming_time * rate)
    return parameters


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
        _find_obstacle(p, s, rig, imu_parameters, imus, pose, pid)
        if a.obstacle == Cause.NONE and p.arming.active != 0:
            s.mode, s.request = Mode.ARMED, Request.ENABLED
            report_event(s.events, Cause.ARMED, -1, np.nan, np.nan)
    if s.mode == Mode.ARMED:
        _find_obstacle(p, s, rig, imu_parameters, imus, pose, pid)
        if a.obstacle != Cause.NONE:
            # The drives are enabled already, so arming does not wait here.
            handle_cause(p, s, rig, time, reference, pid, a.obstacle, a.index, a.value, a.limit)
            return
        for k in range(rig.legs):
            if s.watch.drive[k] != DriveState.FOLLOWING:
                _set_obstacle(a, Cause.NO_DRIVES, k, np.nan, np.nan)
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
    """Whether a cause only prevents arming: nothing has been armed, and there is still time."""
    a = s.arming
    if s.mode != Mode.IDLE:
        return False
    a.obstacle, a.index, a.value, a.limit = cause, -1, np.nan, np.nan
    if time.cycle >= rig.hold_cycles and p.arming.active != 0:
        a.delay = time.cycle + 1 - rig.hold_cycles
    return bool(a.delay <= p.arming.cycles)


@kernel
def _find_obstacle(p: Record, s: Record, rig: Record, imu_parameters: Record, imus: Record, pose: Record, pid: Record) -> None:
    a, limits = s.arming, p.watch
    a.obstacle = Cause.NONE
    lost = 0
    for k in range(IMU_COUNT):
        off = contradiction(s.monitor, k)
        if not off <= p.monitor.disagreement:
            _set_obstacle(a, Cause.NO_SENSORS, k, off, p.monitor.disagreement)
        if imu_parameters.present[k] != 0 and imus.used[k] == 0:
            lost += 1
            if lost > limits.most_lost_imus:
                _set_obstacle(a, Cause.NO_SENSORS, k, np.nan, np.nan)
    for k in range(rig.legs):
        low, high = limits.lengths[k, 0], limits.lengths[k, 1]
        if not low <= pose.lengths[k] <= high:
            _set_obstacle(a, Cause.NO_WORKSPACE, k, pose.lengths[k], low if pose.lengths[k] < low else high)
        if not abs(pid.error[k]) <= p.arming.distance:
            _set_obstacle(a, Cause.NO_AGREEMENT, k, abs(pid.error[k]), p.arming.distance)
        if s.watch.drive[k] != DriveState.READY and s.watch.drive[k] != DriveState.FOLLOWING:
            _set_obstacle(a, Cause.NO_DRIVES, k, np.nan, np.nan)
    if s.watch.silent > 0:
        _set_obstacle(a, Cause.BUS_LOST, -1, float(s.watch.silent), 0.0)


@kernel
def _set_obstacle(a: Record, cause: int, index: int, value: float, limit: float) -> None:
    """The first obstacle counts."""
    if a.obstacle == Cause.NONE:
        a.obstacle, a.index, a.value, a.limit = cause, index, value, limit
