"""Arming: what must hold before the drives are enabled, and again before anything moves."""

import numpy as np

from controller.estimation.imu_monitor import contradiction
from controller.planning.segments import APPROACH_SEGMENTS, approach_duration, plan_approach
from controller.safety.causes import Cause, DriveState, Mode, Request, report_event
from controller.safety.stop import handle_cause
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS
from plant.pose import Array

_STILL_S = 0.05
"""Over what time the estimate is averaged, to see whether it stands still [s]."""

_READY_S = 0.1
"""A dry run that is ready for arming stays so while the rig does not answer for less than this time [s]."""

_AT_START_M = 1e-6
"""Closer than this to the start of the target there is no way to go."""

PARAMETERS = record_dtype(
    active=np.int64,  # whether the drives are to be enabled
    distance=np.float64,  # how far a leg may be from the start of the target [m]
    cycles=np.int64,  # how long arming may take
    drift=np.float64,  # by how much a leg's mean length may change on the brakes, from one window to the next [m]
    approach=np.int64,  # whether the reference begins at the estimated lengths
    window=np.int64,  # samples of a length that are averaged
    ready=np.int64,  # for how many cycles without an answer a dry run stays ready for arming
    judged=np.int64,  # whether evidence judges the IMUs
)
"""The constants of arming."""

STATE = record_dtype(
    delay=np.int64,  # how many cycles arming and the approach took beyond the hold
    ready_for=np.int64,  # how many more such cycles a dry run bears
    obstacle=np.int64,  # what prevents it, a `Cause` with its leg or IMU, value and limit
    index=np.int64,
    value=np.float64,
    limit=np.float64,
    samples=np.int64,  # of the lengths in the present window
    sum=(np.float64, LEGS),  # of these lengths [m]
    windows=np.int64,  # how many are full
    mean=(np.float64, LEGS),  # of the lengths in the last full window [m]
    drift=(np.float64, LEGS),  # by how much it has changed from that of the window before [m]
    approach=(np.float64, (LEGS, APPROACH_SEGMENTS, 5)),  # the reference of the way to the start of the target
    approach_cycles=np.int64,  # how long that takes
    evidence=(np.float64, 2),  # for a fault, of the last evaluation of recent readings, and of the last one of what was learned
    blamed=(np.int64, 2),  # the IMU that it is against; -1 if it is against all
    most_evidence=(np.float64, 2),  # beyond what it would end a motion, or leave out an IMU
)
"""How arming goes."""


def arming_parameters(settings: SafetySettings, rate: float, active: bool, judged: bool = False) -> Record:
    """The constants of arming (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    cycles = int(np.ceil(settings.arming_time * rate))
    return filled(
        PARAMETERS,
        active=active,
        distance=settings.arming_distance,
        cycles=cycles,
        drift=settings.arming_drift,
        approach=1,
        window=max(1, round(_STILL_S * rate)),
        ready=0 if active else round(_READY_S * rate),
        judged=judged,
    )


def longest_delay(parameters: Record) -> int:
    """The most cycles by which a motion begins later than the hold ends, from the cycle's parameters."""
    arming, limits = parameters["safety"]["arming"], parameters["safety"]["stop"]
    names = ("velocity_limit", "acceleration_limit", "jerk_limit")
    approach = approach_duration(float(arming["distance"]), *(float(limits[name]) for name in names))
    return int(arming["cycles"]) + int(np.ceil(approach / float(parameters["rig"]["period"])))


def describe_obstacle(state: Record) -> str:
    """What prevents arming, in words, from the cycle's state; "" if nothing does."""
    arming = state["safety"]["arming"]
    cause = Cause(int(arming["obstacle"]))
    if cause == Cause.NONE:
        return ""
    return cause.describe(int(arming["index"]), float(arming["value"]), float(arming["limit"]))


@kernel
def run_arming_checks(
    p: Record, s: Record, rig: Record, time: Record, imu_parameters: Record, imus: Record, integrity: Record, pose: Record,
    reference: Record, pid: Record,
) -> None:  # fmt: skip
    """Before the commands: from idle to armed, and from armed to running.

    Idle becomes armed when the IMUs have been judged and are plausible, the estimate stands still, the pose is in the workspace
    and where the target begins, and the drives are there. Armed becomes running when all drives follow. The reference then
    begins where the legs are, and the motion when they have come to its start.
    """
    a = s.arming
    if s.mode == Mode.IDLE:
        _take_lengths(p.arming, a, pose.lengths)
    if integrity.fresh != 0:
        kind = integrity.evidence.of_learned
        a.evidence[kind], a.blamed[kind] = integrity.best_evidence, integrity.blamed
        a.most_evidence[kind] = s.attribution.least_evidence
    if time.cycle < rig.hold_cycles or s.mode > Mode.ARMED:
        return
    if s.mode == Mode.IDLE:
        _note(p.arming, a, *_find_obstacle(p, s, rig, imu_parameters, imus, integrity, pose, pid))
        if a.obstacle == Cause.NONE and p.arming.active != 0:
            s.mode, s.request = Mode.ARMED, Request.ENABLED
            report_event(s.events, Cause.ARMED, -1, np.nan, np.nan)
    if s.mode == Mode.ARMED:
        a.obstacle, a.index, a.value, a.limit = _find_obstacle(p, s, rig, imu_parameters, imus, integrity, pose, pid)
        if a.obstacle != Cause.NONE:
            # The drives are enabled already, so arming does not wait here.
            handle_cause(p, s, rig, time, reference, pid, a.obstacle, a.index, a.value, a.limit)
            return
        for k in range(rig.legs):
            if s.watch.drive[k] != DriveState.FOLLOWING and a.obstacle == Cause.NONE:
                a.obstacle, a.index, a.value, a.limit = Cause.NO_DRIVES, k, np.nan, np.nan
        if a.obstacle == Cause.NONE:
            s.mode = Mode.RUNNING
            if p.arming.approach != 0:
                _begin_approach(p.stop, a, rig, pose.lengths, reference, pid)
            a.delay = time.cycle + a.approach_cycles - rig.hold_cycles
            return
    if p.arming.active == 0:
        return
    a.delay = time.cycle + 1 - rig.hold_cycles
    if a.delay > p.arming.cycles:
        handle_cause(p, s, rig, time, reference, pid, a.obstacle, a.index, a.value, a.limit)


@kernel
def _note(p: Record, a: Record, cause: int, index: int, value: float, limit: float) -> None:
    """Note what prevents arming in this cycle, `Cause.NONE` for nothing; a few late answers do not prevent it in a dry run."""
    if cause == Cause.NONE:
        a.ready_for = p.ready
    elif cause == Cause.BUS_LOST and a.ready_for > 0:
        a.ready_for -= 1
        return
    a.obstacle, a.index, a.value, a.limit = cause, index, value, limit


@kernel
def _take_lengths(p: Record, a: Record, lengths: Array) -> None:
    """Add the legs' estimated lengths (6,) to the window, and compare it with the one before when it is full."""
    a.samples += 1
    for k in range(LEGS):
        a.sum[k] += lengths[k]
    if a.samples < p.window:
        return
    for k in range(LEGS):
        mean = a.sum[k] / a.samples
        a.drift[k] = abs(mean - a.mean[k])
        a.mean[k] = mean
        a.sum[k] = 0.0
    a.samples = 0
    a.windows += 1


@kernel
def _begin_approach(limits: Record, a: Record, rig: Record, lengths: Array, reference: Record, pid: Record) -> None:
    """Plan the way from the estimated lengths (6,) to the reference, the start of the target, within the actuators' limits, and
    let the reference begin there.
    """
    farthest = 0.0
    for k in range(rig.legs):
        farthest = max(farthest, abs(reference.motion[k, 0] - lengths[k]))
    a.approach_cycles = 0
    if farthest < _AT_START_M:
        return
    duration = approach_duration(farthest, limits.velocity_limit, limits.acceleration_limit, limits.jerk_limit)
    a.approach_cycles = int(np.ceil(duration / rig.period))
    plan_approach(lengths, reference.motion, a.approach_cycles * rig.period, a.approach)
    for k in range(rig.legs):
        reference.motion[k, 0] = lengths[k]
        pid.error[k] = 0.0


@kernel
def postpones_arming(p: Record, s: Record, rig: Record, time: Record, cause: int) -> bool:
    """Whether a cause only prevents arming: nothing has been armed, and there is still time. A rig that does not answer is the
    obstacle before anything that its samples tell.
    """
    a = s.arming
    if s.mode != Mode.IDLE:
        return False
    if s.watch.unanswered > 0:
        _note(p.arming, a, Cause.BUS_LOST.value, -1, _unanswered_for(s.watch), 0.0)
    else:
        _note(p.arming, a, cause, -1, np.nan, np.nan)
    if time.cycle >= rig.hold_cycles and p.arming.active != 0:
        a.delay = time.cycle + 1 - rig.hold_cycles
    return bool(a.delay <= p.arming.cycles)


@kernel
def _unanswered_for(watch: Record) -> float:
    """For how many cycles the rig has not answered, in a row or more often than it did."""
    return float(max(watch.silent, watch.unanswered))


@kernel
def _find_obstacle(
    p: Record, s: Record, rig: Record, imu_parameters: Record, imus: Record, integrity: Record, pose: Record, pid: Record
) -> tuple[int, int, float, float]:
    """The first obstacle: a `Cause` with its leg or IMU, value and limit."""
    # Without answers, nothing below is about the present.
    if s.watch.unanswered > 0:
        return Cause.BUS_LOST.value, -1, _unanswered_for(s.watch), 0.0
    lost, lengths, error, a = 0, pose.lengths, pid.error, s.arming
    # The two take turns: a fault that is there from the start shows in the first alone, until it has been learned.
    for kind in range(2):
        if a.evidence[kind] > a.most_evidence[kind]:
            cause = Cause.NO_TRUST.value if a.blamed[kind] < 0 else Cause.NO_SENSORS.value
            return cause, a.blamed[kind], np.sqrt(a.evidence[kind]), np.sqrt(a.most_evidence[kind])
    lasting = s.attribution.lasting
    if lasting[1] > 0.0:
        blamed = s.attribution.lasting_imu
        cause = Cause.NO_TRUST.value if blamed < 0 else Cause.NO_SENSORS.value
        return cause, blamed, np.sqrt(lasting[0]), np.sqrt(lasting[1])
    level = integrity.protection.level
    for part, cause in enumerate((Cause.POSITION_UNSURE.value, Cause.ROTATION_UNSURE.value)):
        if integrity.evaluations > 0 and not level[part] <= p.watch.level[part]:
            return cause, -1, level[part], p.watch.level[part]
    for k in range(IMU_COUNT):
        off = contradiction(s.monitor, k)
        if not off <= p.monitor.disagreement:
            return Cause.NO_SENSORS.value, k, off, p.monitor.disagreement
        out = imu_parameters.present[k] != 0 and imus.used[k] == 0
        lost += out
        if lost > p.watch.most_lost_imus:
            return Cause.NO_SENSORS.value, k, np.nan, np.nan
        if out and k == PLATFORM_IMU and p.watch.without_platform_imu < np.inf:
            return Cause.PLATFORM_IMU_LOST.value, k, np.nan, np.nan
    for k in range(rig.legs):
        drift = a.drift[k] if a.windows > 1 else np.inf
        if s.mode == Mode.IDLE and not drift <= p.arming.drift:
            return Cause.NOT_STILL.value, k, drift, p.arming.drift
    for k in range(rig.legs):
        low, high = p.watch.lengths[k, 0], p.watch.lengths[k, 1]
        if not low <= lengths[k] <= high:
            return Cause.NO_WORKSPACE.value, k, lengths[k], low if lengths[k] < low else high
        if not abs(error[k]) <= p.arming.distance:
            return Cause.NO_AGREEMENT.value, k, abs(error[k]), p.arming.distance
        if s.watch.drive[k] != DriveState.READY and s.watch.drive[k] != DriveState.FOLLOWING:
            return Cause.NO_DRIVES.value, k, np.nan, np.nan
    # Without a first evaluation there is no protection level.
    if s.mode == Mode.IDLE and p.arming.judged != 0 and integrity.evaluations == 0:
        return Cause.NOT_JUDGED.value, -1, np.nan, np.nan
    return Cause.NONE.value, 0, np.nan, np.nan
