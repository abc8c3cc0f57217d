"""What is checked in every cycle: the rig's answers, the agreement of the IMUs, and every limit of the motion."""

from math import radians

import numpy as np

from controller.estimation.imu_monitor import contradiction, reset
from controller.estimation.integrity.parity import OF_TWO, SHARED
from controller.pid import MOST_HALVINGS, halve_gains
from controller.rig import elapsed
from controller.safety.causes import Cause, DriveState, Mode, Request, report_event
from controller.safety.stop import handle_cause
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS, Limits, six_rows
from plant.pose import Array

_IMPLAUSIBLE_SHARE = 0.25
"""How far outside its stroke, as a share of it, the estimate of a leg may lie."""

_LEAST_CYCLES = 10
"""For how many cycles a deviation must last, at low rates."""

_CLEARED, _CLEARED_EVALUATIONS = 0.3, 6
"""An IMU is taken back when the evidence against it is below this share of the limit in so many evaluations, in twice as many
after each time.
"""

_MOST_DOUBLINGS = 20

_CLEARLY, _CLEARLY_OF_ALL = 0.5, 0.25
"""How much less than for the named IMU the evidence for anything else must be: of the limit, and of that evidence."""

_REST, _REST_OF_ALL, _UNEXPLAINED_EVALUATIONS = 1.0, 0.35, 3
"""How much evidence for further faults may be left without the named IMU: so many times the limit, and of the evidence for it.
A fault that has just come up is not constant over the memory of the fault filter, and leaves up to a third of its own evidence.

If more is left in so many evaluations in a row, more than one IMU is wrong, though none of them may be beyond the limit.
"""

_PATIENT = 1.5
"""How many times the limit evidence may reach while more of it may tell what is wrong."""

_ENDING = 0.5
"""Beyond this share of the limit, evidence of recent readings ends a run where no IMU could be left out: all IMUs share the
error, or it is of one that is needed. Leaving out an IMU takes more.
"""

_USUAL, _CONTRADICTED, _OF_BEST = 0.3375, 0.625, 0.5
"""A cumulative sum (E. S. Page, Biometrika 41, 1954) takes the evidence against the platform's IMU, in sigma. Each evaluation
adds what it has beyond the first share of the limit (in sigma, too), or takes off what it lacks. From the second share on, the
sum ends the run. Evidence of less than the last share of the most evidence (both are squares of sigma) counts as none.
"""

_SUSPECTED, _SUSPICION_EVALUATIONS = 0.375, 20
"""The platform's IMU is suspected while the sum is at least this share of the limit, and for so many evaluations from the last
such one on. In that time evidence leaves out no other IMU. The pose follows the platform's IMU. If that turns slowly, the pose
is off, and at last a leg's IMU may seem to contradict the others more.
"""

_FIRST_COUNTED = 20
"""From which evaluation on these rules count. Until then nothing has been learned, and what a calibration does not know is left
unexplained, such as clocks of the IMUs' own, above all at low rates.
"""

_NEARLY = 0.7
"""Share of the evidence from which on something else explains the readings nearly as well."""

_CLEARER = 1.3
"""How much more of the residuals the named IMU must explain than any other."""

_UNFIT_S = 0.005
"""For how long the misfit must be beyond its limit, at least two cycles [s]."""

_UNJUDGED_S = 1.0
"""After what time without an evaluation of the evidence that is told [s]."""

_FAST_S = 0.1
"""Corrections that last longer than this are no oscillation; its mean square is taken over as long [s]."""

_OSCILLATING_S = 1.0
"""For how long a mean square must be beyond its limit: a step of the estimate is corrected in less [s]."""

_SWAYING, _TURNING = 0.011, radians(2.2)
"""If the platform moves or turns to and fro by more than this [m/s, rad/s RMS] beyond what is planned, it oscillates. Then the
gains are halved: at first beyond a quarter of the limit (RMS) for a quarter of that time, then beyond a half for a half. Twice
as far beyond, it takes a quarter of the time. If the platform does neither, only IMUs are shaken, and lower gains do not help.
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
    contradicted_for=np.float64,  # how long the IMUs have contradicted each other [s]
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
    returns=(np.int64, IMU_COUNT),  # how often each IMU was taken back
    cleared_for=(np.int64, IMU_COUNT),  # in how many evaluations there has been little evidence against an IMU left out
    unexplained_for=np.int64,  # in how many more than one IMU has been wrong
    against_platform=np.float64,  # sum of the evidence against the platform's IMU, if that is needed [sigma]
    suspicion=np.int64,  # for how many more evaluations it is suspected
    lasting=(np.float64, 2),  # square of what has lasted long enough to end a run, and of its limit; 0 if nothing has
    lasting_imu=np.int64,  # the IMU that it blames
    least_evidence=np.float64,  # from how much on the evidence of the last evaluation ends a run, or leaves out an IMU
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
def _moves(s: Record) -> bool:
    """Whether the loop moves the legs: in the motion, and in a controlled stop, which needs the estimate as well."""
    return bool(s.mode == Mode.RUNNING or s.mode == Mode.STOPPING)


@kernel
def exclude_imu(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, leg_weight: float, reference: Record, pid: Record
) -> bool:
    """After the refinement: leave out the IMU that contradicts the others, once, if it can be named; else stop. Returns whether
    it is left out.

    Three legs and the roll of a planar mechanism are one measurement more than its pose needs: they show that an IMU is
    wrong, not which one.
    """
    m = s.monitor
    worst = 0
    for k in range(1, IMU_COUNT):
        if m.explained[k] > m.explained[worst]:
            worst = k
    off, limit = contradiction(m, worst), p.monitor.disagreement
    s.watch.contradicted_for = s.watch.contradicted_for + rig.period if off > limit else 0.0
    if s.watch.contradicted_for < p.monitor.lasting or s.mode != Mode.RUNNING:
        return False
    second = left = 0.0
    excluded = 0
    for k in range(IMU_COUNT):
        excluded += imus.excluded[k]
        left += m.squares[k]
        if k != worst:
            second = max(second, m.explained[k])
    # Without the named IMU, the others must agree.
    disagree = left - m.explained[worst] > leg_weight * limit**2
    if disagree or excluded > 0 or m.explained[worst] < _CLEARER * second or p.watch.most_lost_imus == 0:
        named = worst if rig.planar == 0 else -1
        handle_cause(p, s, rig, time, reference, pid, Cause.IMUS_DISAGREE, named, off, limit)
        return False
    imus.excluded[worst] = 1
    s.watch.contradicted_for = 0.0
    for k in range(IMU_COUNT):
        reset(m, k)
    report_event(s.events, Cause.IMU_DISAGREES, worst, off, limit)
    return True


@kernel
def check_misfit(p: Record, s: Record, rig: Record, time: Record, pose: Record, reference: Record, pid: Record) -> None:
    """After the refinement: stop when no pose fits the directions that the IMUs tell, whichever of them is left out."""
    misfit, limit = pose.rest_misfit, p.watch.misfit
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
    sways = w.swaying[:3].sum() > _SWAYING**2 or w.swaying[3:].sum() > _TURNING**2
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
    if unjudged and w.unjudged == 0 and _moves(s):
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
def judge_parity(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, parity: Record, reference: Record, pid: Record
) -> bool:
    """When the gyroscopes contradict each other: leave out the one that is named, else stop. Returns whether it is left out.

    When all accelerometers or two show a force that is no motion, stop. If `evidence` has no limit, nothing happens.
    """
    if not _moves(s) or not np.isfinite(p.watch.evidence):
        return False
    if parity.shared != 0:
        handle_cause(p, s, rig, time, reference, pid, Cause.FORCES_SHARE, -1, parity.common, SHARED)
        return False
    if parity.two != 0:
        handle_cause(p, s, rig, time, reference, pid, Cause.TWO_FORCES, -1, parity.second, OF_TWO)
        return False
    if parity.named != 0 and _may_leave_out(p.watch, imus, parity.worst):
        imus.excluded[parity.worst] = 1
        _count_anew(s.watch)
        report_event(s.events, Cause.GYROSCOPE_OFF, parity.worst, parity.error, parity.limit)
        return True
    handle_cause(
        p, s, rig, time, reference, pid, Cause.GYROSCOPES_CONTRADICT, parity.worst, parity.error, parity.limit
    )  # fmt: skip
    return False


@kernel
def judge_evidence(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, integrity: Record, reference: Record, pid: Record
) -> bool:
    """After an evaluation of the evidence for faults of the present set of IMUs: take back IMUs that agree again. Else leave
    out the IMU that the evidence blames, if it clearly blames this one alone, the rest agrees, and the platform's IMU is not
    suspected; wait for more if that is not clear; else stop. Returns whether the set of IMUs has changed.

    Below the limit, stop if all IMUs share the error or one has it that cannot be left out, if evidence against that one adds
    up, or if three evaluations in a row leave too much unexplained.
    """
    w, limit, e = s.watch, p.watch.evidence, integrity
    back = False
    # What was learned tells nothing new of an IMU that is left out.
    judged = np.isfinite(limit) and e.evidence.of_learned == 0
    for at in range(e.evidence.apart if judged else 0):
        k = e.evidence.order[at]
        agrees = imus.healthy[k] != 0 and e.evidence.apart_evidence[at] < _CLEARED * limit
        w.cleared_for[k] = w.cleared_for[k] + 1 if agrees else 0
        if w.cleared_for[k] >= _CLEARED_EVALUATIONS << min(w.returns[k], _MOST_DOUBLINGS):
            w.cleared_for[k] = imus.excluded[k] = 0
            w.returns[k] += 1
            back = True
    rest, most_rest = e.all_evidence - e.imu_evidence, _REST * limit + _REST_OF_ALL * e.imu_evidence
    if back:
        _count_anew(w)
    elif judged:
        _count_evaluations(p.watch, w, e, rest, most_rest)
    k = e.blamed
    ends = k < 0 or _is_needed(p.watch, k)
    least = _ENDING * limit if ends and judged and e.evaluations >= _FIRST_COUNTED else limit
    w.least_evidence = least
    if back or not _moves(s):
        return back
    seen, most = e.best_evidence >= least, np.sqrt(least)
    if seen and k < 0:
        cause = Cause.GYROSCOPES_SHARE + e.shared
        handle_cause(p, s, rig, time, reference, pid, cause, -1, np.sqrt(e.best_evidence), most)
        _report_rival(s, e, -1)
        return False
    clear = e.rival_evidence < e.imu_evidence - max(_CLEARLY * limit, _CLEARLY_OF_ALL * e.imu_evidence)
    rest_agrees = rest < most_rest
    alone = clear and rest_agrees and e.evidence.of_learned == 0 and w.suspicion == 0
    if seen and alone and _may_leave_out(p.watch, imus, k):
        imus.excluded[k] = 1
        _count_anew(w)
        report_event(s.events, Cause.IMU_CONTRADICTED, k, np.sqrt(e.imu_evidence), most)
        return True
    # Nothing is gained by waiting where the IMU cannot be left out.
    certain = ends or (clear and rest_agrees) or e.best_evidence >= _PATIENT * limit
    if seen and certain:
        handle_cause(p, s, rig, time, reference, pid, Cause.IMUS_CONTRADICT, k, np.sqrt(e.imu_evidence), most)
        _report_rival(s, e, k)
    elif judged and w.lasting[1] > 0.0:
        found, most = np.sqrt(w.lasting)
        handle_cause(p, s, rig, time, reference, pid, Cause.IMUS_CONTRADICT, w.lasting_imu, found, most)
        _report_rival(s, e, w.lasting_imu)
    return False


@kernel
def _count_evaluations(p: Record, w: Record, e: Record, rest: float, most_rest: float) -> None:
    """Count the evaluations in a row that leave too much unexplained; and add up the evidence against the platform's IMU, if it
    is needed.
    """
    counts, sigma = e.evaluations >= _FIRST_COUNTED, np.sqrt(p.evidence)
    most = _CONTRADICTED * sigma
    w.unexplained_for = w.unexplained_for + 1 if counts and rest >= most_rest else 0
    found = e.platform_evidence if e.platform_evidence >= _OF_BEST * e.best_evidence else 0.0
    beyond = np.sqrt(max(found, 0.0)) - _USUAL * sigma
    # What adds up on the brakes may delay arming by a limited time only.
    added = min(max(w.against_platform + beyond, 0.0), 2.0 * most)
    w.against_platform = added if counts and _is_needed(p, PLATFORM_IMU) else 0.0
    suspected = w.against_platform >= _SUSPECTED * sigma
    w.suspicion = _SUSPICION_EVALUATIONS if suspected else max(w.suspicion - 1, 0)
    w.lasting[:] = 0.0
    if w.unexplained_for >= _UNEXPLAINED_EVALUATIONS:
        w.lasting[0], w.lasting[1], w.lasting_imu = rest, most_rest, e.blamed
    elif w.against_platform >= most:
        w.lasting[0], w.lasting[1], w.lasting_imu = w.against_platform**2, most**2, PLATFORM_IMU


@kernel
def _count_anew(w: Record) -> None:
    """Count no evaluation of another set of IMUs."""
    w.unexplained_for = 0
    w.against_platform = 0.0
    w.lasting[:] = 0.0


@kernel
def _is_needed(p: Record, k: int) -> bool:
    """Whether IMU `k` is the platform's, without which a run may not go on."""
    return bool(k == PLATFORM_IMU and np.isfinite(p.without_platform_imu))


@kernel
def _may_leave_out(p: Record, imus: Record, k: int) -> bool:
    """Whether the run may go on without IMU `k`."""
    lost = 0
    for other in range(IMU_COUNT):
        lost += imus.excluded[other]
    return bool(lost < p.most_lost_imus and not _is_needed(p, k))


@kernel
def _report_rival(s: Record, e: Record, named: int) -> None:
    """Say what else may be wrong, besides the IMU that has been named (-1: all share the error): what has more evidence, the
    platform's IMU if it is suspected and a leg's has been named, or what explains the readings nearly as well.
    """
    if named != e.blamed:
        k, shared, found = e.blamed, e.shared, e.best_evidence
    elif named >= 0 and named != PLATFORM_IMU and s.watch.suspicion > 0:
        # The evidence that has made it suspected may be gone.
        k, shared, found = PLATFORM_IMU, 0, np.nan
    elif e.rival_evidence >= _NEARLY * e.best_evidence:
        k, shared, found = e.rival_blamed, e.rival_shared, e.rival_evidence
    else:
        return
    cause = Cause.RIVAL_IMU if k >= 0 else Cause.RIVAL_GYROSCOPES + shared
    report_event(s.events, cause, k, np.sqrt(found), np.nan)


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
