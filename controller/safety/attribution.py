"""Attribution: what is done when IMUs contradict each other. One is left out or taken back, or the run waits or ends."""

import numpy as np

from controller.estimation.imu_monitor import contradiction, reset
from controller.estimation.integrity.parity import OF_TWO, SHARED
from controller.safety.causes import Cause, Mode, report_event
from controller.safety.stop import handle_cause, moves
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU

_CLEARED, _CLEARED_EVALUATIONS = 0.3, 6
"""An IMU is taken back when the evidence against it is below this share of the limit in so many evaluations, in twice as many
after each time.
"""

_MOST_DOUBLINGS = 20

_CLEARLY, _CLEARLY_OF_ALL = 0.5, 0.25
"""How much less than for the named IMU the evidence for anything else must be: of the limit, and of that evidence."""

_REST, _REST_OF_ALL, _UNEXPLAINED_EVALUATIONS = 0.75, 0.35, 3
"""How much evidence for further faults may be left without the named IMU: this share of the limit, and on top this share of the
evidence for it. A fault that has just come up is not constant over the memory of the fault filter, and leaves up to a
third of its own evidence.

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

_USUAL_OF_SHARED, _SHARED = 0.375, 0.875
"""The same for a second sum, of the evidence for an error that all IMUs share, such as one that comes up slowly; the last share
is that of the first sum.
"""

_FITTING, _USUAL_WHERE_FITTING = 0.5, 0.4375
"""If the misfit of the closed form is below the first, the sum against the platform's IMU takes only what is beyond the second,
a share of the limit. An IMU that tilts by about a degree raises the misfit. Play, and joints that are off by 0.1 mm, raise the
evidence, but hardly the misfit. Without redundancy, and where encoders lead, the misfit is 0.
"""

_SUSPECTED, _SUSPICION_EVALUATIONS = 0.375, 20
"""The platform's IMU is suspected while the sum against it is at least this share of the limit, and for so many evaluations
from the last such one on. In that time evidence leaves out no other IMU. The pose follows the platform's IMU. If that turns
slowly, the pose is off, and at last a leg's IMU may seem to contradict the others more.
"""

_FIRST_COUNTED = 20
"""From which evaluation on these rules count. Until then nothing has been learned, and what a calibration does not know is left
unexplained, such as clocks of the IMUs' own, above all at low rates.
"""

_NEARLY = 0.7
"""Share of the evidence from which on something else explains the readings nearly as well."""

_CLEARER = 1.3
"""How much more of the residuals the named IMU must explain than any other."""

STATE = record_dtype(
    contradicted_for=np.float64,  # how long the IMUs have contradicted each other [s]
    returns=(np.int64, IMU_COUNT),  # how often each IMU was taken back
    cleared_for=(np.int64, IMU_COUNT),  # in how many evaluations there has been little evidence against an IMU left out
    unexplained_for=np.int64,  # in how many more than one IMU has been wrong
    against_platform=np.float64,  # sum of the evidence against the platform's IMU, if that is needed [sigma]
    suspicion=np.int64,  # for how many more evaluations it is suspected
    for_shared=np.float64,  # sum of the evidence for an error that all IMUs share [sigma]
    lasting=(np.float64, 2),  # square of what has lasted long enough to end a run, and of its limit; 0 if nothing has
    lasting_imu=np.int64,  # the IMU that it blames; -1 if it blames none
    lasting_cause=np.int64,  # how it ends a run, a `Cause`
    least_evidence=np.float64,  # from how much on the evidence of the last evaluation ends a run, or leaves out an IMU
)
"""What lasts of the evidence. The limits are those of the watch."""


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
    s.attribution.contradicted_for = s.attribution.contradicted_for + rig.period if off > limit else 0.0
    if s.attribution.contradicted_for < p.monitor.lasting or s.mode != Mode.RUNNING:
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
    s.attribution.contradicted_for = 0.0
    for k in range(IMU_COUNT):
        reset(m, k)
    report_event(s.events, Cause.IMU_DISAGREES, worst, off, limit)
    return True


@kernel
def judge_parity(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, parity: Record, reference: Record, pid: Record
) -> bool:
    """When the gyroscopes contradict each other: leave out the one that is named, else stop. Returns whether it is left out.

    When all accelerometers or two show a force that is no motion, stop. If `evidence` has no limit, nothing happens.
    """
    if not moves(s) or not np.isfinite(p.watch.evidence):
        return False
    if parity.shared != 0:
        handle_cause(p, s, rig, time, reference, pid, Cause.FORCES_SHARE, -1, parity.common, SHARED)
        return False
    if parity.two != 0:
        handle_cause(p, s, rig, time, reference, pid, Cause.TWO_FORCES, -1, parity.second, OF_TWO)
        return False
    if parity.named != 0 and _may_leave_out(p.watch, imus, parity.worst):
        imus.excluded[parity.worst] = 1
        _count_anew(s.attribution)
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

    Below the limit, stop if all IMUs share the error or one has it that cannot be left out, if evidence for either adds up, or
    if three evaluations in a row leave too much unexplained.
    """
    a, limit, e = s.attribution, p.watch.evidence, integrity
    back = False
    # What was learned tells nothing new of an IMU that is left out.
    judged = np.isfinite(limit) and e.evidence.of_learned == 0
    for at in range(e.evidence.apart if judged else 0):
        k = e.evidence.order[at]
        agrees = imus.healthy[k] != 0 and e.evidence.apart_evidence[at] < _CLEARED * limit
        a.cleared_for[k] = a.cleared_for[k] + 1 if agrees else 0
        if a.cleared_for[k] >= _CLEARED_EVALUATIONS << min(a.returns[k], _MOST_DOUBLINGS):
            a.cleared_for[k] = imus.excluded[k] = 0
            a.returns[k] += 1
            back = True
    rest, most_rest = e.all_evidence - e.imu_evidence, _REST * limit + _REST_OF_ALL * e.imu_evidence
    if back:
        _count_anew(a)
    elif judged:
        _count_evaluations(p.watch, a, e, rest, most_rest)
    k = e.blamed
    ends = k < 0 or _is_needed(p.watch, k)
    least = _ENDING * limit if ends and judged and e.evaluations >= _FIRST_COUNTED else limit
    a.least_evidence = least
    if back or not moves(s):
        return back
    seen, most = e.best_evidence >= least, np.sqrt(least)
    if seen and k < 0:
        cause = Cause.GYROSCOPES_SHARE + e.shared
        handle_cause(p, s, rig, time, reference, pid, cause, -1, np.sqrt(e.best_evidence), most)
        _report_rival(s, e, -1)
        return False
    clear = e.rival_evidence < e.imu_evidence - max(_CLEARLY * limit, _CLEARLY_OF_ALL * e.imu_evidence)
    rest_agrees = rest < most_rest
    alone = clear and rest_agrees and e.evidence.of_learned == 0 and a.suspicion == 0
    if seen and alone and _may_leave_out(p.watch, imus, k):
        imus.excluded[k] = 1
        _count_anew(a)
        report_event(s.events, Cause.IMU_CONTRADICTED, k, np.sqrt(e.imu_evidence), most)
        return True
    # Nothing is gained by waiting where the IMU cannot be left out.
    certain = ends or (clear and rest_agrees) or e.best_evidence >= _PATIENT * limit
    if seen and certain:
        handle_cause(p, s, rig, time, reference, pid, Cause.IMUS_CONTRADICT, k, np.sqrt(e.imu_evidence), most)
        _report_rival(s, e, k)
    elif judged and a.lasting[1] > 0.0:
        found, most = np.sqrt(a.lasting)
        handle_cause(p, s, rig, time, reference, pid, a.lasting_cause, a.lasting_imu, found, most)
        _report_rival(s, e, a.lasting_imu)
    return False


@kernel
def _count_evaluations(p: Record, a: Record, e: Record, rest: float, most_rest: float) -> None:
    """Count the evaluations in a row that leave too much unexplained; and add up the evidence for an error that all IMUs share,
    and that against the platform's IMU, if it is needed.
    """
    counts, sigma = e.evaluations >= _FIRST_COUNTED, np.sqrt(p.evidence)
    most, most_shared = _CONTRADICTED * sigma, _SHARED * sigma
    a.unexplained_for = a.unexplained_for + 1 if counts and rest >= most_rest else 0
    shared, found = e.shared, e.best_evidence
    if e.blamed >= 0:
        shared, found = e.rival_shared, e.rival_evidence if e.rival_blamed < 0 else 0.0
    usual = _USUAL_WHERE_FITTING if e.protection.misfit < _FITTING else _USUAL
    a.for_shared = _add_evidence(a.for_shared, found, e.best_evidence, _USUAL_OF_SHARED * sigma, most_shared) if counts else 0.0
    a.against_platform = (
        _add_evidence(a.against_platform, e.platform_evidence, e.best_evidence, usual * sigma, most)
        if counts and _is_needed(p, PLATFORM_IMU)
        else 0.0
    )
    suspected = a.against_platform >= _SUSPECTED * sigma
    a.suspicion = _SUSPICION_EVALUATIONS if suspected else max(a.suspicion - 1, 0)
    if a.unexplained_for >= _UNEXPLAINED_EVALUATIONS:
        _note_lasting(a, Cause.IMUS_CONTRADICT.value, e.blamed, rest, most_rest)
    elif a.against_platform >= most:
        _note_lasting(a, Cause.IMUS_CONTRADICT.value, PLATFORM_IMU, a.against_platform**2, most**2)
    elif a.for_shared >= most_shared and found >= _OF_BEST * e.best_evidence:
        _note_lasting(a, Cause.GYROSCOPES_SHARE.value + shared, -1, a.for_shared**2, most_shared**2)
    else:
        a.lasting[:] = 0.0


@kernel
def _add_evidence(total: float, found: float, best: float, usual: float, most: float) -> float:
    """A cumulative sum with what one more evaluation has found. It is at most twice its limit, so that it delays arming by a
    limited time only.
    """
    beyond = np.sqrt(found if found >= _OF_BEST * best else 0.0) - usual
    return float(min(max(total + beyond, 0.0), 2.0 * most))


@kernel
def _note_lasting(a: Record, cause: int, blamed: int, found: float, most: float) -> None:
    a.lasting_cause, a.lasting_imu, a.lasting[0], a.lasting[1] = cause, blamed, found, most


@kernel
def _count_anew(a: Record) -> None:
    """Count no evaluation of another set of IMUs."""
    a.unexplained_for = 0
    a.for_shared = a.against_platform = 0.0
    a.lasting[:] = 0.0


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
    elif named >= 0 and named != PLATFORM_IMU and s.attribution.suspicion > 0:
        # The evidence that has made it suspected may be gone.
        k, shared, found = PLATFORM_IMU, 0, np.nan
    elif e.rival_evidence >= _NEARLY * e.best_evidence:
        k, shared, found = e.rival_blamed, e.rival_shared, e.rival_evidence
    else:
        return
    cause = Cause.RIVAL_IMU if k >= 0 else Cause.RIVAL_GYROSCOPES + shared
    report_event(s.events, cause, k, np.sqrt(found), np.nan)
