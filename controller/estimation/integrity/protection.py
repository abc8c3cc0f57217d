"""The protection level: how far the pose may be off, fault or none.

As satellite navigation has it (RAIM), the level counts what a fault could do unseen, and the worst hypothesis gives it.
`evidence` leaves C_mm m + C_mf f = c_m for the error m of the pose. The most likely sizes a of a hypothesis D have the
covariance (D^T W D)^-1. Such a fault moves the pose by -C_mm^-1 C_mf D a, of covariance V, and leaves it off by
m = C_mm^-1 (c_m - C_mf D a). Let e be its evidence less the number of its directions and less 1, but at least 0: what
chance alone gives.

    no fault       |C_mm^-1 c_m|
    unseen fault   sqrt(tr V / 4): what could be there unseen; little where the readings would show it
    seen fault     sqrt((e + 1/4) tr V) + (2 |m| + 6 |m - u|) min(1, e / 7)

u is the usual m of the hypothesis, averaged over some 6 s. The 6 is for faults that grow: such a fault is larger at the end of
the filter's memory than on average over it, and has moved the pose before, and goes on until the next evaluation. What lasts
has grown already: the gyroscopes of IMUs that get warm together show a small error all the time. A fault since the loop began
has had little time to move the pose: these terms grow over the first four seconds.

The level is the root of the sum of the squares of ten terms:

1. The greatest of these.
2. The standard deviation of the pose, both that of the closed form and that of the pose's own source if that is less: no filter
   knows what calibrations of IMUs and joints leave.
3. The standard deviation of the closed form again, by how much its measurements contradict each other: so joints that are off
   show themselves, and other errors that nothing models.
4. What `parity` and `shaking` tell: forces that are no motion may have moved the pose.
5. How far an encoder whose zero is known could move the pose unseen, as `encoders` has it.
6. How far the pose has moved otherwise than commanded within a second, as `commanded` has it: so errors that all IMUs share
   show themselves before there is evidence.
7. How far the pose in closed form and that of the whole-mechanism filter are from each other.
8. How far the pose has drifted from the one that gravity shows, as `gravity` has it: so errors that all gyroscopes share show
   themselves while the filters still take them for motion.
9. How far the platform may have crept at rest, as `rest` has it: there the IMUs need not show a slow error.
10. How far a slow turn of the platform's IMU on its mounting could move the rotation unseen: several standard deviations of the
   rotation that the legs' accelerometers alone show, as `gravity` has it. Like a fault, it grows over the first four seconds.

Terms 1, 2 and 10 are those of the last evaluation. Terms 3 to 9 are renewed in every cycle; terms 6 and 9 are those of the
cycle before, and term 8 changes with the fault filter's windows. Term 2 counts more as soon as the evidence begins anew.
"""

import numpy as np

from controller.estimation.integrity.evidence import POSE
from controller.estimation.integrity.hypotheses import HYPOTHESES
from controller.least_squares import factor_cholesky, solve_cholesky
from plant.compiled import Record, kernel, record_dtype
from plant.pose import Array

_CHANCE = 1.0
"""By how much evidence may exceed the number of directions before a fault counts as seen."""

_UNSEEN = 0.25
"""Evidence ascribed to a fault for which there is less [-]."""

_SURELY = 7.0
"""Evidence beyond chance from which on a fault is taken to be there."""

_BENDING_S = 4.0
"""How long a fault takes to move the pose [s]."""

_UNSETTLED, _SETTLED_S = (0.25, 0.6), 4.0
"""How much more the pose's standard deviations of position and rotation count after the evidence has begun, as the filters
still settle, or hardly any readings have been judged; and until when [s].
"""

_LASTING, _GROWN = 2.0, 6.0
"""How many times the mean error within the fault filter's memory counts, and how many times more the part of it that is not
usual.
"""

USUAL_S = 5.0
"""Over what time of evaluations the usual error is averaged [s]; each fifth evaluation is about what was learned instead."""

_OF_CLOSED_FORM, _OF_SOURCE = (1.5, 1.6), (2.1, 1.2)
"""How many standard deviations of position and rotation count: of the pose in closed form, and of the better known of this and
the pose's source. Joints that are off by 0.2 mm move either pose alike, by up to two standard deviations of the closed form.
"""

_USUAL_MISFIT, _OF_MISFIT, _MISFIT_S = 0.3, 1.6, 0.1
"""A misfit up to the first is usual. Beyond it, the closed form's standard deviation counts so many times, times the root of
the excess. The misfit is averaged with the time constant [s]. Sound IMUs have less than 1, as most of the errors that the
weights stand for are alike in all measurements, or move the pose.
"""

_SOUND, _MOST, _SHAKEN, _SHAKEN_S, _HARDEST = 0.2, 1.0, 0.3, 0.5, 160.0
"""Mean forces that are no motion count beyond what sound IMUs hardly ever exceed, and up to this much [m/s^2]; the share of
vibration that counts with them, the time constant of its average [s], and the most that counts in it [m/s^2]. A shock is over
before it has moved the pose far, as when brakes are released and the mechanism has play.
"""

_BY_FORCE = 0.04, 0.06
"""How far such a force moves the pose [m, rad per m/s^2]: legs of 0.4 m that lean by its share of gravity."""

_USUALLY_MOVED, _OF_MOVED = (1.5e-4, 1.5e-3), (2.2, 1.8)
"""Motion that was not commanded counts beyond the first [m, rad], so many times."""

_USUALLY_APART, _OF_APART = (5e-4, 2e-3), 0.8
"""The distance of the two estimates counts beyond the first [m, rad], so many times."""

_OF_CREPT = 1.3
"""So many times counts what has crept at rest: the begin of a fault may be in the mean of the commands that hold the legs."""

_USUALLY_DRIFTED, _OF_DRIFTED = (0.3, 0.7), (3.2, 2.5)
"""The drift from what gravity shows counts beyond so many standard deviations of the closed form, so many times."""

_WELL_SHOWN, _OF_TURN = 5e-4, 5.0
"""The standard deviation of the rotation by the legs counts beyond the first [rad], so many times. On 6-4-II at 250 Hz
it is some 3 mrad, and a slow turn of the platform's IMU turns the pose by up to 0.9 deg before it is told.
"""

STATE = record_dtype(
    level=(np.float64, 2),  # of position [m] and rotation [rad]
    evaluated=(np.float64, 2),  # the sum of the squares of its first and tenth terms, of the last evaluation
    spread=(np.float64, 2),  # the square of its second, when the filters have settled
    closed=(np.float64, 2),  # square of the closed form's standard deviation then
    misfit=np.float64,  # of the closed form, averaged
    shaken=np.float64,  # root of the greatest excess of an accelerometer, averaged [m/s^2]
    fault=(np.float64, 2),  # the greatest effect of a fault, of the last complete evaluation of recent readings
    next_fault=(np.float64, 2),  # of the one under way
    determined=np.int64,  # whether the readings determine the pose
    factor=(np.float64, (POSE, POSE)),  # Cholesky, of the pose's information
    error=(np.float64, POSE),  # of the pose without a fault
    effect=(np.float64, (POSE, POSE)),  # of the directions of a hypothesis on the pose, a direction a row
    shift=(np.float64, POSE),  # of the pose by the fault
    usual=(np.float64, (HYPOTHESES, POSE)),  # error of the pose that each hypothesis leaves, averaged
    covariance=(np.float64, (2, POSE, POSE)),  # of the pose in closed form, and as its source has it
    scratch=(np.float64, (POSE, POSE)),
)
"""The level, and scratch."""


@kernel
def begin_level(s: Record, e: Record) -> None:
    """Begin with no fault: the error of the pose, from the state of `evidence`."""
    s.factor[:] = e.pose_information
    s.determined = factor_cholesky(s.factor)
    s.error[:] = e.pose_vector
    if s.determined != 0:
        solve_cholesky(s.factor, s.error)
    for part in range(2):
        squared = 0.0
        for i in range(3 * part, 3 * part + 3):
            squared += s.error[i] ** 2
        s.next_fault[part] = np.sqrt(squared)


@kernel
def take_hypothesis(
    s: Record, e: Record, hypothesis: int, count: int, first: int, last: int, found: float, usual_share: float, t: Record
) -> None:  # fmt: skip
    """Take the effect of a hypothesis, for which `evidence_for` has just been called, if it is the greatest so far.

    Args:
        s, e, t: dtypes `STATE`, `evidence.STATE` and `hypotheses.SCRATCH`.
        hypothesis: its number.
        count: of its directions.
        first, last: their span.
        found: the evidence.
        usual_share: of this evaluation in the usual error.
    """
    if s.determined == 0:
        return
    s.shift[:] = 0.0
    for n in range(count):
        effect = s.effect[n]
        effect[:] = 0.0
        if not t.matrix[n, n] > 0.0:
            continue
        for j in range(first, last):
            size = t.directions[n, j]
            if size != 0.0:
                for i in range(POSE):
                    effect[i] += size * e.pose_by_fault[i, j]
        solve_cholesky(s.factor, effect)
        for m in range(n):
            share = t.matrix[n, m]
            for i in range(POSE):
                effect[i] -= share * s.effect[m, i]
        for i in range(POSE):
            effect[i] /= t.matrix[n, n]
            s.shift[i] += effect[i] * t.right[n]
    seen = max(found - count - _CHANCE, 0.0)
    for part in range(2):
        squared = grown = variance = 0.0
        for i in range(3 * part, 3 * part + 3):
            left = s.error[i] - s.shift[i]
            squared += left**2
            grown += (left - s.usual[hypothesis, i]) ** 2
            # What is no number would stay.
            if np.isfinite(left):
                s.usual[hypothesis, i] += usual_share * (left - s.usual[hypothesis, i])
            for n in range(count):
                variance += s.effect[n, i] ** 2
        most = _LASTING * np.sqrt(squared) + _GROWN * np.sqrt(grown)
        fault = np.sqrt((seen + _UNSEEN) * variance) + most * min(1.0, seen / _SURELY)
        if fault > s.next_fault[part]:
            s.next_fault[part] = fault


@kernel
def end_level(s: Record, e: Record, age: float, by_legs: float) -> None:
    """End an evaluation; the level is infinite where the readings do not determine the pose.

    Args:
        s: dtype `STATE`, with the covariances of the pose.
        e: dtype `evidence.STATE`. If the evaluation is about what was learned, the faults are those of the one before.
        age: for how long the loop has run [s].
        by_legs: standard deviation of the rotation that the legs' accelerometers show [rad]; 0 where a slow turn of the
            platform's IMU could not move the pose, or nothing is said about it.
    """
    bent = min(1.0, age / _BENDING_S)
    if e.of_learned == 0:
        s.fault[:] = s.next_fault
    for part in range(2):
        closed = own = 0.0
        for i in range(3 * part, 3 * part + 3):
            closed += s.covariance[0, i, i]
            own += s.covariance[1, i, i]
        if not np.isfinite(closed):
            closed = own
        spread = _OF_CLOSED_FORM[part] ** 2 * closed + _OF_SOURCE[part] ** 2 * min(own, closed)
        s.closed[part] = closed if np.isfinite(closed) else 0.0
        s.spread[part] = spread if s.determined != 0 else 0.0
        s.evaluated[part] = (bent * s.fault[part]) ** 2 if s.determined != 0 else np.inf
    s.evaluated[1] += (bent * _OF_TURN * max(by_legs - _WELL_SHOWN, 0.0)) ** 2


@kernel
def publish_level(
    s: Record, settled: float, misfit: float, duration: float, steady: float, excess: float, bent: Array, moved: Array,
    crept: Array, apart: Array, drifted: Array,
) -> None:  # fmt: skip
    """Publish the level of a cycle, with what has come up since the last evaluation.

    Args:
        s: dtype `STATE`.
        settled: how much time of readings there has been since the evidence last began anew [s].
        misfit: of the closed form now, `pose_estimator.STATE`.
        duration: since the last cycle [s].
        steady: greatest mean force that is no motion [m/s^2], `parity.STATE`.
        excess: the greatest of an accelerometer's square over what is explained now [m^2/s^4], `shaking.STATE`.
        bent: (2,), by how much an encoder could move position [m] and rotation [rad] unseen.
        moved: (2,), by how much they have moved otherwise than commanded, `commanded.STATE`.
        crept: (2,), by how much they may have crept at rest, `rest.STATE`.
        apart: (2,), how far the closed form and the filter that is trusted are from each other.
        drifted: (2,), how far position and rotation have drifted from what gravity shows, `gravity.STATE`.
    """
    s.misfit += min(1.0, duration / _MISFIT_S) * (misfit - s.misfit)
    beyond = _OF_MISFIT**2 * max(s.misfit - _USUAL_MISFIT, 0.0)
    if np.isfinite(excess):
        s.shaken += min(1.0, duration / _SHAKEN_S) * (min(np.sqrt(excess), _HARDEST) - s.shaken)
    force = min(max(steady - _SOUND, 0.0) + _SHAKEN * s.shaken, _MOST)
    unsettled = max(0.0, 1.0 - settled / _SETTLED_S)
    for part in range(2):
        squared = s.evaluated[part] + s.spread[part] * (1.0 + _UNSETTLED[part] * unsettled) ** 2
        squared += beyond * s.closed[part] + (_BY_FORCE[part] * force) ** 2
        squared += bent[part] ** 2 + (_OF_CREPT * crept[part]) ** 2
        squared += (_OF_MOVED[part] * max(moved[part] - _USUALLY_MOVED[part], 0.0)) ** 2
        squared += (_OF_APART * max(apart[part] - _USUALLY_APART[part], 0.0)) ** 2
        squared += (_OF_DRIFTED[part] * max(drifted[part] - _USUALLY_DRIFTED[part] * np.sqrt(s.closed[part]), 0.0)) ** 2
        s.level[part] = np.sqrt(squared)
