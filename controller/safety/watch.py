"""What is checked in every cycle: the rig's answers, what the estimate is worth, and every limit of the motion."""

from math import radians

import numpy as np

from controller.pid import MOST_HALVINGS, halve_gains
from controller.rig import elapsed
from controller.safety.causes import Cause, DriveState, Mode, Request, report_event
from controller.safety.stop import handle_cause, moves
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS, Limits, six_rows
from plant.pose import Array

_IMPLAUSIBLE_SHARE = 0.25
"""How far outside its stroke, as a share of it, the estimate of a leg may lie."""

_LEAST_CYCLES = 10
"""For how many cycles a deviation must last, at low rates."""

_UNFIT_S = 0.005
"""For how long the misfit must be beyond its limit, at least two cycles [s]."""

_MOVED_M = 1.3e-3
"""If the estimate has moved so far otherwise than commanded, the limit of the misfit is reduced: to half at twice as far."""

_UNJUDGED_S = 1.0
"""After what time without an evaluation of the evidence that is told [s]."""

_FAST_S = 0.1
"""Corrections that last longer than this are no oscillation; its mean square is taken over as long [s]."""

_OSCILLATING_S = 1.0
"""For how long a mean square must be beyond its limit: a step of the estimate is corrected in less [s]."""

_SWAYING, _TURNING = 0.011, radians(2.2)
"""If the platform turns to and fro by more than the second [rad/s RMS] beyond what is planned, it oscillates. The same holds if
it moves by more than the first [m/s RMS] while the IMUs are shaken: a single step of the pose shakes them too little. Then the
gains are halved: at first beyond a quarter of the limit (RMS) for a quarter of that time, then beyond a half for a half. At
twice as much, it takes a quarter of the time. If the platform does neither, only IMUs are shaken, and lower gains do not help.
"""

_BASE_IMU_S, _FIRST_BASE_IMU_S = 0.01, 1.0
"""How long there may be no reading of the base's IMU, and how long the first one may take [s]."""

_DRIFT, _DRIFTING_S = 3.0, 1.0
"""How far the pose may drift from what gravity shows [standard deviations of the closed form], and for how long [s]."""

_FIRST_DRIFT_S, _LEARNING_S = 10.0, 10.0
"""That is not looked at in the first seconds of a motion, nor for some seconds after the IMUs were shaken or others came into
use: the filters, and the reference of the drift, learn then.
"""

PARAMETERS = record_dtype(
    most_lost_imus=np.int64,
    conditioning=np.float64,
    lengths=(np.float64, (LEGS, 2)),  # [m]
    plausible_lengths=(np.float64, (LEGS, 2)),  # [m]
    speed=np.float64,  # [m/s]
    following=np.float64,  # [m]
    saturation=np.float64,  # [s]
    drive_deviation=np.float64,  # [m/s]
    patience=np.float64,  # [s]
    without_platform_imu=np.float64,  # [s]
    bus_cycles=np.int64,
    carried=np.float64,  # [rad^2]
    oscillation=np.float64,  # [m^2/s^2]
    misfit=np.float64,  # square of the RMS
    unfit=np.float64,  # [s]
    evidence=np.float64,  # for a fault, twice a logarithm
    level=(np.float64, 2),  # of protection, position [m] and rotation [rad]
)
"""The limits. Durations that are compared with sums of periods are in s."""

STATE = record_dtype(
    drive=(np.int64, LEGS),  # the `DriveState` of each drive
    silent=np.int64,  # for how many cycles the rig has not answered
    unanswered=np.int64,  # how many more exchanges failed than succeeded, up to twice the limit
    unjudged=np.int64,  # whether there has been no evidence for too long
    unfit_for=np.float64,  # how long no pose has fitted the IMUs [s]
    used_imus=np.int64,  # set of the IMUs in use, a bit for each
    drifting_for=np.float64,  # how long the pose has been too far from what gravity shows; below 0: not looked at [s]
    without_platform_imu=np.float64,  # for how long the platform's IMU, where there is one, has been left out [s]
    off_reference_for=(np.float64, LEGS),  # how long each leg has been off its reference [s]
    deviating_for=(np.float64, LEGS),  # how long each drive has been off its command [s]
    saturated_for=(np.float64, LEGS),  # how long each command has been at its limit [s]
    correction=(np.float64, LEGS),  # of each command beyond its feed-forward, averaged [m/s]
    oscillation=(np.float64, LEGS),  # square of what the correction is apart from that, averaged [m^2/s^2]
    oscillating_for=np.float64,  # how long the mean of these squares has been beyond its limit [s]
    sway=(np.float64, 6),  # twist beyond the planned one, averaged [m/s, rad/s]
    swaying=(np.float64, 6),  # square of what it is apart from that, averaged [m^2/s^2, rad^2/s^2]
    speed=(np.float64, LEGS),  # estimated, of each leg [m/s]
    variance=(np.float64, 2),  # of the least known direction, of the leg filters and of the whole-mechanism filter [rad^2]
    calm_variance=(np.float64, 2),  # the same when nothing shook the IMUs last
)
"""What the rig has reported, and what lasts."""


def watch_parameters(settings: SafetySettings, rate: float, limits: Limits) -> Record:
    """The limits (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    stroke = limits.stroke
    margin = _IMPLAUSIBLE_SHARE * (stroke[:, 1] - stroke[:, 0])
    patience = max(settings.patience, _LEAST_CYCLES / rate)
    return filled(
        PARAMETERS,
        most_lost_imus=settings.most_lost_imus,
        conditioning=settings.conditioning,
        lengths=six_rows(stroke + settings.stroke_margin * np.array([-1.0, 1.0])),
        plausible_lengths=six_rows(np.stack([stroke[:, 0] - margin, stroke[:, 1] + margin], axis=1)),
        speed=settings.velocity_margin * limits.velocity,
        following=settings.following,
        saturation=settings.saturation,
        drive_deviation=settings.drive_deviation,
        patience=patience,
        without_platform_imu=patience if settings.need_platform_imu else np.inf,
        bus_cycles=max(3, round(settings.bus_patience * rate)),
        carried=settings.carried**2,
        oscillation=settings.oscillation**2,
        misfit=settings.misfit**2 if settings.watch_imus else np.inf,
        unfit=max(_UNFIT_S, 2.0 / rate),
        evidence=settings.evidence**2,
        level=(settings.protection_position, settings.protection_rotation),
    )


@kernel
def update_rig_status(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, reference: Record, pid: Record, sample_age: Array,
    drive: Array, drive_code: Array, silent: int,
) -> None:  # fmt: skip
    """Before a cycle: take the rig's report, and react to a lost bus and to drives that left their operation.

    Args:
        sample_age: (7,), of each IMU's sample, in cycles.
        drive, drive_code: (6,), of each drive its `DriveState` and its own fault code.
        silent: for how many cycles the rig has not answered.
    """
    w = s.watch
    for k in range(IMU_COUNT):
        imus.sample_age[k] = sample_age[k]
    for k in range(rig.legs):
        w.drive[k] = drive[k]
    if silent > 0 and w.silent == 0:
        report_event(s.events, Cause.ANSWER_LATE, -1, np.nan, np.nan)
    w.silent = silent
    most = p.watch.bus_cycles
    # What was missed on the brakes may delay arming by a limited time only.
    w.unanswered = min(max(w.unanswered + (1 if silent > 0 else -1), 0), 2 * most)
    if s.request != Request.ENABLED:
        return
    if silent >= most or w.unanswered >= 2 * most:
        handle_cause(
            p, s, rig, time, reference, pid, Cause.BUS_LOST, -1, float(max(silent, w.unanswered)), float(most)
        )  # fmt: skip
    for k in range(rig.legs):
        if drive[k] == DriveState.FAULTY:
            handle_cause(p, s, rig, time, reference, pid, Cause.DRIVE_FAULT, k, float(drive_code[k]), np.nan)
        elif s.mode != Mode.ARMED and drive[k] != DriveState.FOLLOWING:
            handle_cause(p, s, rig, time, reference, pid, Cause.DRIVE_OFF, k, np.nan, np.nan)


@kernel
def check_misfit(
    p: Record, s: Record, rig: Record, time: Record, pose: Record, moved: float, reference: Record, pid: Record
) -> None:  # fmt: skip
    """After the refinement: stop when no pose fits the directions that the IMUs tell, whichever of them is left out.

    Args:
        moved: how far the position has moved otherwise than commanded, as of the last cycle [m]. Commands are no sensor: an
            error that IMUs share shows itself here and in the misfit, long before one of the two alone is certain.
    """
    misfit, limit = pose.rest_misfit, p.watch.misfit
    if moved > _MOVED_M:
        limit *= (_MOVED_M / moved) ** 2
    s.watch.unfit_for = s.watch.unfit_for + elapsed(rig, time) if misfit > limit else 0.0
    if s.watch.unfit_for >= p.watch.unfit and s.mode == Mode.RUNNING:
        handle_cause(p, s, rig, time, reference, pid, Cause.NO_POSE_FITS, -1, np.sqrt(misfit), np.sqrt(limit))


@kernel
def check_carried(
    p: Record, s: Record, rig: Record, time: Record, shaking: Record, legs: Record, mechanism: Record, reference: Record,
    pid: Record,
) -> None:  # fmt: skip
    """While IMUs are shaken: stop when what the pose comes from knows a direction much less well than before: the leg filters,
    or the whole-mechanism filter's rotation.
    """
    w, worst = s.watch, -1
    w.variance[:] = 0.0
    for k in range(rig.legs):
        own = legs.covariance[k, 0, 0] + legs.covariance[k, 1, 1]
        if legs.used[k] != 0.0 and own > w.variance[0]:
            worst, w.variance[0] = k, own
    for i in range(3, 6):
        w.variance[1] = max(w.variance[1], mechanism.filter.published_covariance[i, i])
    if shaking.told == 0 and shaking.bridging == 0:
        w.calm_variance[:] = w.variance
    source = 0
    if mechanism.trusted != 0:
        source, worst = 1, -1
    variance, limit = w.variance[source], p.watch.carried + w.calm_variance[source]
    if variance > limit and s.mode == Mode.RUNNING:
        handle_cause(p, s, rig, time, reference, pid, Cause.NOT_CARRIED, worst, np.sqrt(variance), np.sqrt(limit))


@kernel
def check_oscillation(
    p: Record, s: Record, rig: Record, time: Record, shaking: Record, twist: Array, feed_forward: Array, reference: Record,
    pid: Record,
) -> None:  # fmt: skip
    """After the commands: halve the gains when what the PIDs add to the feed-forward (6,) [m/s] goes to and fro for long, fast
    and far, and moves or turns the platform, as it does where the legs have play. Stop when that does not help, or when it
    shakes the IMUs without moving the platform. If it does neither, it is noise of the estimate.

    Args:
        twist: (6,), of the platform beyond the planned one, by all gyroscopes [m/s, rad/s].
    """
    w, passed, worst = s.watch, elapsed(rig, time), 0
    share = min(1.0, passed / _FAST_S)
    for k in range(rig.legs):
        _take_oscillation(share, pid.command[k] - feed_forward[k], k, w.correction, w.oscillation)
        if w.oscillation[k] > w.oscillation[worst]:
            worst = k
    for i in range(6):
        _take_oscillation(share, twist[i], i, w.sway, w.swaying)
    rms = np.sqrt(w.oscillation[: rig.legs].mean())
    translates = shaking.told != 0 and w.swaying[:3].sum() > _SWAYING**2
    sways = translates or w.swaying[3:].sum() > _TURNING**2
    left = MOST_HALVINGS - pid.halvings if sways else 0
    limit = np.sqrt(p.watch.oscillation) / 2**left
    oscillates = rms > limit and (sways or shaking.told != 0) and s.mode == Mode.RUNNING
    sooner = (rms / limit) ** 2 if left > 0 else 1.0
    w.oscillating_for = w.oscillating_for + passed * sooner if oscillates else 0.0
    if w.oscillating_for > _OSCILLATING_S / 2**left:
        w.oscillating_for = 0.0
        if left > 0:
            halve_gains(pid)
            report_event(s.events, Cause.GAINS_HALVED, worst, rms, limit)
        else:
            handle_cause(p, s, rig, time, reference, pid, Cause.OSCILLATES, worst, rms, limit)


@kernel
def _take_oscillation(share: float, value: float, k: int, mean: Array, square: Array) -> None:
    """Average a value into `mean[k]`, and the square of its distance from that mean into `square[k]`."""
    off = value - mean[k]
    mean[k] += share * off
    square[k] += share * (off * off - square[k])


@kernel
def check_base_imu(p: Record, s: Record, rig: Record, time: Record, base: Record, reference: Record, pid: Record) -> None:
    """End a run whose base IMU (dtype `base_imu.STATE`) has had no readings that can be used for too long."""
    patience = _BASE_IMU_S if base.begun != 0 else _FIRST_BASE_IMU_S
    if base.lost_for > patience:
        handle_cause(p, s, rig, time, reference, pid, Cause.BASE_IMU_LOST, -1, base.lost_for, patience)


@kernel
def check_judgement(p: Record, s: Record, rig: Record, time: Record, integrity: Record, reference: Record, pid: Record) -> None:
    """After the samples of a cycle: say once when no evidence could be taken for too long, as periods are missed too often. The
    level is then unknown, and beyond every limit.
    """
    w, unjudged = s.watch, integrity.unjudged_for > _UNJUDGED_S
    if unjudged and w.unjudged == 0 and moves(s):
        report_event(s.events, Cause.UNJUDGED, -1, integrity.unjudged_for, _UNJUDGED_S)
    w.unjudged = 1 if unjudged else 0
    if unjudged:
        integrity.protection.level[:] = np.inf
    if unjudged or integrity.evaluations > 0:
        check_level(p, s, rig, time, integrity.protection.level, reference, pid)


@kernel
def check_level(p: Record, s: Record, rig: Record, time: Record, level: Array, reference: Record, pid: Record) -> None:
    """Stop when the protection level (2,) [m, rad] is beyond its limit."""
    for part, cause in enumerate((Cause.POSITION_UNSURE.value, Cause.ROTATION_UNSURE.value)):
        if s.mode == Mode.RUNNING and not level[part] <= p.watch.level[part]:
            handle_cause(p, s, rig, time, reference, pid, cause, -1, level[part], p.watch.level[part])


@kernel
def check_rest(p: Record, s: Record, rig: Record, time: Record, rest: Record, reference: Record, pid: Record) -> None:
    """At rest: stop when commands and gyroscopes show a motion of the platform beyond the limit of `rest` [m RMS of the legs].

    If `evidence` has no limit, nothing happens.
    """
    if s.mode == Mode.RUNNING and rest.both > rest.limit and np.isfinite(p.watch.evidence):
        handle_cause(p, s, rig, time, reference, pid, Cause.MOVES_AT_REST, -1, rest.both, rest.limit)


@kernel
def check_drift(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, integrity: Record, reference: Record, pid: Record
) -> None:
    """Without encoders: stop when the pose has drifted from the one that gravity shows, as `gravity` has it.

    While IMUs are shaken, accelerometers do not show gravity. If `evidence` has no limit, nothing happens. This also notes
    which IMUs are used, on which the check at rest relies.
    """
    drift, closed, furthest = integrity.gravity.drifted, integrity.protection.closed, 0.0
    for part in range(2):
        if closed[part] > 0.0:
            furthest = max(furthest, drift[part] / np.sqrt(closed[part]))
    w, used = s.watch, 0
    for k in range(IMU_COUNT):
        used += imus.used[k] << k
    lasts = furthest > _DRIFT and integrity.gravity.age > _FIRST_DRIFT_S and integrity.waits == 0
    if imus.shaking.told != 0 or imus.shaking.bridging != 0 or used != w.used_imus:
        w.drifting_for = -_LEARNING_S
    else:
        w.drifting_for = w.drifting_for + elapsed(rig, time) if lasts or w.drifting_for < 0.0 else 0.0
    w.used_imus = used
    if w.drifting_for > _DRIFTING_S and s.mode == Mode.RUNNING and np.isfinite(p.watch.evidence):
        handle_cause(p, s, rig, time, reference, pid, Cause.DRIFTS, -1, furthest, _DRIFT)


@kernel
def check_limits(
    p: Record, s: Record, rig: Record, time: Record, imu_parameters: Record, imus: Record, pose: Record, filter_trusted: int,
    reference: Record, command_limit: float, pid: Record,
) -> int:  # fmt: skip
    """After the commands, while there is motion: hold everything against its limit; returns the cause of a fault, or
    `Cause.NONE`.
    """
    w, limits = s.watch, p.watch
    for k in range(rig.legs):
        if not (np.isfinite(pid.command[k]) and np.isfinite(pose.lengths[k])):
            handle_cause(p, s, rig, time, reference, pid, Cause.NOT_FINITE, k, np.nan, np.nan)
            return Cause.NOT_FINITE.value
    if s.mode < Mode.RUNNING or s.request != Request.ENABLED:
        return Cause.NONE.value
    lost = 0
    for k in range(IMU_COUNT):
        lost += imu_parameters.present[k] != 0 and imus.used[k] == 0
    if lost > limits.most_lost_imus:
        handle_cause(
            p, s, rig, time, reference, pid, Cause.IMUS_LOST, -1, float(lost), float(limits.most_lost_imus)
        )  # fmt: skip
    out = imu_parameters.present[PLATFORM_IMU] != 0 and imus.used[PLATFORM_IMU] == 0
    w.without_platform_imu = w.without_platform_imu + rig.period if out else 0.0
    if w.without_platform_imu > limits.without_platform_imu:
        handle_cause(
            p, s, rig, time, reference, pid, Cause.PLATFORM_IMU_LOST, PLATFORM_IMU, w.without_platform_imu,
            limits.without_platform_imu,
        )  # fmt: skip
    if pose.conditioning < limits.conditioning and filter_trusted == 0:
        handle_cause(p, s, rig, time, reference, pid, Cause.ILL_CONDITIONED, -1, pose.conditioning, limits.conditioning)
    for k in range(rig.legs):
        length, command, d, a = pose.lengths[k], pid.command[k], pose.directions[k], pose.arms[k]
        low, high = limits.plausible_lengths[k, 0], limits.plausible_lengths[k, 1]
        if not low <= length <= high:
            handle_cause(p, s, rig, time, reference, pid, Cause.IMPLAUSIBLE, k, length, low if length < low else high)
            return Cause.IMPLAUSIBLE.value
        low, high = limits.lengths[k, 0], limits.lengths[k, 1]
        if not low <= length <= high:
            handle_cause(p, s, rig, time, reference, pid, Cause.BEYOND_STROKE, k, length, low if length < low else high)
        t = pose.smooth_twist
        w.speed[k] = (
            d[0] * (t[0] + t[4] * a[2] - t[5] * a[1])
            + d[1] * (t[1] + t[5] * a[0] - t[3] * a[2])
            + d[2] * (t[2] + t[3] * a[1] - t[4] * a[0])
        )
        if not abs(w.speed[k]) <= limits.speed:
            handle_cause(p, s, rig, time, reference, pid, Cause.TOO_FAST, k, abs(w.speed[k]), limits.speed)
        off = abs(pid.error[k])
        w.off_reference_for[k] = w.off_reference_for[k] + rig.period if off > limits.following else 0.0
        if w.off_reference_for[k] > limits.patience:
            handle_cause(p, s, rig, time, reference, pid, Cause.FOLLOWING_ERROR, k, off, limits.following)
        # A drive is behind its command, by less than what it may deviate by.
        off = abs(w.speed[k] - command)
        w.deviating_for[k] = w.deviating_for[k] + rig.period if off > limits.drive_deviation else 0.0
        if w.deviating_for[k] > limits.patience:
            handle_cause(p, s, rig, time, reference, pid, Cause.DRIVE_DEVIATES, k, off, limits.drive_deviation)
            return Cause.DRIVE_DEVIATES.value
        w.saturated_for[k] = w.saturated_for[k] + rig.period if abs(command) >= command_limit else 0.0
        if w.saturated_for[k] > limits.saturation:
            handle_cause(p, s, rig, time, reference, pid, Cause.SATURATED, k, w.saturated_for[k], limits.saturation)
    return Cause.NONE.value
