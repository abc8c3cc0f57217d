"""The stage of the cycle: the fault filter, after each window the gyroscopes' parity, and ten times a second the evidence for
every hypothesis.
"""

import numpy as np

from controller.estimation.integrity import (
    commanded,
    evidence,
    fault_filter,
    gravity,
    hypotheses,
    parity,
    protection,
    rest,
)
from controller.estimation.integrity.hypotheses import (
    HYPOTHESES,
    OF_ONE_IMU,
    Kind,
    directions_of,
    evidence_for,
    imu_of,
    kind_of,
    span_of,
)
from controller.estimation.whole_mechanism.readings import find_frames
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import MOST, Limits, Record, filled, kernel, record_dtype, shared_kernel
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.imu import ACCELEROMETER
from plant.pose import Array

PARAMETERS = record_dtype(
    filter=fault_filter.PARAMETERS,
    evidence=evidence.PARAMETERS,
    cycles=np.int64,  # over which an evaluation is spread
    shared_noise=np.float64,  # variance of the noise that hypotheses about all IMUs see, as a multiple of an IMU's own
    correction_cycles=np.int64,  # how long the loop takes to correct the pose
    usual_share=np.float64,  # of an evaluation in the usual error of the pose
)
"""Constants."""

STATE = record_dtype(
    filter=fault_filter.STATE,
    evidence=evidence.STATE,
    hypotheses=hypotheses.SCRATCH,
    protection=protection.STATE,
    commanded=commanded.STATE,
    gravity=gravity.STATE,
    parity=parity.STATE,
    rest=rest.STATE,
    compared=np.int64,  # the last window of which the gyroscopes have been compared
    contradicts=np.int64,  # whether they contradict each other, or accelerometers show no motion, found in this cycle
    stalled=np.int64,  # whether more than a window was missed at once since the last evaluation began
    waits=np.int64,  # for how many more cycles what is read counts for the gyroscopes' parity alone
    step=np.int64,  # next of the evaluation
    cycle=np.int64,  # of the evaluation
    found=(np.float64, HYPOTHESES),  # evidence for each, of the evaluation under way
    evaluations=np.int64,  # how many are complete
    unjudged_for=np.float64,  # how long none has been completed [s]
    fresh=np.int64,  # whether the last one has become complete in this cycle
    best=np.int64,  # the hypothesis with the most evidence
    best_evidence=np.float64,
    blamed=np.int64,  # the IMU that it blames; -1 if it is shared by all
    shared=np.int64,  # if it is: 0 all gyroscopes, 1 all accelerometers, 2 a base that turns, 3 one that accelerates
    rival_blamed=np.int64,
    rival_shared=np.int64,
    rival=np.int64,  # the one with the most evidence among those that do not blame the same IMU
    rival_evidence=np.float64,
    imu_evidence=np.float64,  # for the whole IMU that the best one blames
    platform_evidence=np.float64,  # for the whole IMU of the platform
    all_evidence=np.float64,  # for faults of any kind
)
"""State of the filter and of the evaluation, and what the last evaluation has found."""

_FRAMES = evidence.STEPS
_FIRST_HYPOTHESIS = _FRAMES + 1
_FIRST_TOTAL = _FIRST_HYPOTHESIS + HYPOTHESES
STEPS = _FIRST_TOTAL + IMU_COUNT
"""Steps of an evaluation."""

_CORRECTION_S = 0.1
"""How long the loop takes to correct the pose when an IMU has been left out or taken back, or after many missed periods [s]; no
plan has that motion.
"""

LIMITS: Limits = {
    "filter.windows": (0, MOST),
    "filter.job": (0, fault_filter.JOBS),
    "filter.step": (0, MOST),
    "filter.collected": (0, MOST),
    "filter.lost": (0, MOST),
    "filter.unsettled": (0, MOST),
    "evidence.waits": (0, evidence.LATE),
    "evidence.windows": (0, MOST),
    "evidence.order": (0, IMU_COUNT - 1),
    "evidence.place": (0, IMU_COUNT - 1),
    "evidence.apart": (0, IMU_COUNT),
    "parity.worst": (0, IMU_COUNT - 1),
    "waits": (0, MOST),
    "step": (0, STEPS),
    "cycle": (0, MOST),
    "best": (0, HYPOTHESES - 1),
    "rival": (0, HYPOTHESES - 1),
    "blamed": (-1, IMU_COUNT - 1),
    "rival_blamed": (-1, IMU_COUNT - 1),
}
"""Least and greatest of what counts or indexes in the state."""

_FIRST_WINDOWS = 7
"""After how many windows the first evaluation begins: it is complete before the brakes have held for 0.2 s."""

_WINDOWS_AFTER_STALL = 16
"""How many windows the next evaluation waits for if more than a window was missed at once. The loop then corrects the pose to
and fro within a window, and the fault filter does not follow that: few windows look like an error of the platform's
accelerometer.
"""


def integrity_parameters(
    fusion: FusionSettings, rate: float, prior: Array, active: bool, shared_noise: float = 1.0
) -> Record:  # fmt: skip
    """The constants (dtype `PARAMETERS`) in cycles of this rate [Hz].

    Args:
        fusion: settings.
        rate: [Hz].
        prior: covariance (147, 147) of the errors of the IMUs at the start.
        active: whether readings are judged.
        shared_noise: variance of the noise that hypotheses about all IMUs see, as a multiple of an IMU's own.
    """
    filtered = fault_filter.fault_filter_parameters(fusion, rate, active)
    return filled(
        PARAMETERS,
        filter=filtered,
        evidence=evidence.evidence_parameters(prior, float(filtered["duration"])),
        cycles=evidence.EVALUATION_WINDOWS * int(filtered["window"]),
        shared_noise=shared_noise,
        correction_cycles=round(_CORRECTION_S * rate),
        usual_share=evidence.EVALUATION_WINDOWS * float(filtered["duration"]) / protection.USUAL_S,
    )


@shared_kernel
def step_integrity(
    p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record, legs: Array, commands: Array
) -> None:
    """Take a cycle's samples, and do its share of the evaluation; a new one begins when the one before is complete."""
    s.fresh = s.contradicts = 0
    if p.filter.active == 0:
        return
    s.unjudged_for += elapsed(rig, time)
    if time.missed > p.filter.window:
        s.stalled = 1
    if time.missed > 0 and not fault_filter.bridge_gap(p.filter, s.filter, time.missed):
        restart_integrity(p, s)
    took = fault_filter.step_fault_filter(p.filter, s.filter, rig.sensors, imus, pose, legs, commands)
    if took and s.waits == 0:
        gravity.compare_with_gravity(s.gravity, s.filter, imus, s.commanded.following != 0)
    if s.filter.job > 0 and s.compared != s.filter.windows:
        s.compared = s.filter.windows
        s.contradicts = s.filter.windows > 0 and (
            parity.step_parity(
                s.parity,
                s.filter,
                imus.excluded,
                s.hypotheses.frames,
                p.filter.window,
                rig.period,
                p.filter.variance[0],
                imus.shaking,
            )
            or s.parity.shared != 0
            or s.parity.two != 0
        )
    if s.waits > 0:
        s.waits -= 1
        if s.waits == 0:
            fault_filter.begin_anew(s.filter)
        return
    least = _WINDOWS_AFTER_STALL if s.stalled != 0 and s.evaluations > 0 else _FIRST_WINDOWS
    if s.step == 0:
        if not (took and s.filter.windows >= least):
            return
        s.stalled = 0
    s.cycle += 1
    # One window is left for waiting until the next evaluation may begin.
    due = min(STEPS, -(-STEPS * s.cycle // (p.cycles - p.filter.window)))
    while s.step < due:
        _do(p, s, rig, imus, s.step)
        s.step += 1
    if s.step == STEPS:
        s.step = s.cycle = 0
        s.fresh = 1
        s.unjudged_for = 0.0
        s.evaluations += 1


@kernel
def restart_integrity(p: Record, s: Record) -> None:
    """Forget the last half second, as the loop is about to correct the pose: the set of IMUs that are relied upon has changed,
    or many periods have been missed. What was learned before it stays.
    """
    s.waits = p.correction_cycles
    rest.forget_motion(s.rest)
    evidence.end_widening(p.evidence, s.evidence, s.step)
    s.step = s.cycle = 0
    fault_filter.begin_anew(s.filter)


@kernel
def publish_level(p: Record, s: Record, rig: Record, time: Record, imus: Record, pose: Record) -> None:
    """Publish the level of the cycle, from the first evaluation on."""
    if s.evaluations > 0:
        protection.publish_level(
            s.protection, s.filter.windows * p.filter.duration, pose.misfit, elapsed(rig, time), s.parity.steady,
            imus.shaking.excess[ACCELEROMETER].max(), pose.bent, s.commanded.moved, s.rest.crept, pose.apart, s.gravity.drifted,
        )  # fmt: skip


@kernel
def _do(p: Record, s: Record, rig: Record, imus: Record, step: int) -> None:
    e, t = s.evidence, s.hypotheses
    if step < _FRAMES:
        evidence.step_evidence(p.evidence, e, s.filter, imus.excluded, step)
    elif step == _FRAMES:
        find_frames(rig.sensors, s.filter.path.position, s.filter.path.rotation, t.frames)
        if e.of_learned == 0:
            protection.begin_level(s.protection, e)
    elif step < _FIRST_TOTAL:
        h = step - _FIRST_HYPOTHESIS
        count = directions_of(h, t.frames, s.filter.predicted, e.place, t.directions)
        first, last = span_of(h, e.place)
        s.found[h] = evidence_for(count, first, last, e.weight, e.vector, t)
        if imu_of(h) < 0:
            s.found[h] /= p.shared_noise
        if e.of_learned == 0:
            # The first readings after a new beginning tell little.
            share = p.usual_share if s.filter.windows * p.filter.duration > fault_filter.MEMORY_S else 0.0
            protection.take_hypothesis(s.protection, e, h, count, first, last, s.found[h], share, t)
    else:
        at = step - _FIRST_TOTAL
        if at == 0:
            s.all_evidence = 0.0
        if at >= e.apart:
            s.all_evidence += evidence.evidence_against(e, at)
        if at == IMU_COUNT - 1:
            _compare(s)


@kernel
def _compare(s: Record) -> None:
    """Find the hypothesis with the most evidence, and its strongest rival."""
    s.best = s.rival = 0
    for h in range(1, HYPOTHESES):
        if s.found[h] > s.found[s.best]:
            s.best = h
    blamed = s.blamed = imu_of(s.best)
    s.shared = kind_of(s.best) - OF_ONE_IMU
    s.best_evidence, s.rival_evidence = s.found[s.best], -1.0
    s.imu_evidence = s.best_evidence
    s.platform_evidence = s.found[IMU_COUNT * Kind.IMU + PLATFORM_IMU]
    for h in range(HYPOTHESES):
        if blamed >= 0 and imu_of(h) == blamed:
            s.imu_evidence = max(s.imu_evidence, s.found[h])
        elif h != s.best and s.found[h] > s.rival_evidence:
            s.rival, s.rival_evidence = h, s.found[h]
    s.rival_blamed = imu_of(s.rival)
    s.rival_shared = kind_of(s.rival) - OF_ONE_IMU
