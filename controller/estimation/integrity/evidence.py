"""The evidence for faults that have come up: the last half second is compared with all that was learned before.

What was learned of the sensors' constant errors b, Y_b with right side y_b, begins with the calibration's uncertainty. The last
half second, as the fault filter has it, sees b + f, where f has come up since. Together, with the error m of the motion,

    [ Y_ff + Y_b   Y_fm   Y_ff ] [b]   [ y_f + y_b ]
    [ Y_mf         Y_mm   Y_mf ] [m] = [ y_m       ]
    [ Y_ff         Y_fm   Y_ff ] [f]   [ y_f       ]

Elimination of b leaves what ties the pose to faults. Elimination of m as well leaves W f = w. A fault f has the likelihood of
no fault times exp(w^T f - f^T W f / 2). For faults f = D a in some directions D with any sizes a, twice the greatest value of
this exponent is (D^T w)^T (D^T W D)^-1 (D^T w). That is twice the logarithm of the generalised likelihood ratio of Willsky and
Jones (1976), for a fault that came up within the last half second. Where the readings do not show a fault, W is nearly zero,
and there is no evidence.

What comes up too slowly for that is learned. So after each time of learning there is one evaluation of another kind: all that
was learned takes the place of the last half second, and the calibration, as far as it is relied upon, that of what was
learned.

The errors of an IMU that has been left out are eliminated as well: whatever it reads is no evidence for anything else.
"""

from math import radians

import numpy as np

from controller.estimation.integrity.fault_filter import FAULTS, MEMORY_S, UNKNOWNS
from controller.estimation.whole_mechanism.imu_errors import ERRORS
from controller.estimation.whole_mechanism.readings import MOTION_STATES, READINGS
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array

POSE = 6
REST = MOTION_STATES - POSE
_SIZE = 2 * FAULTS + POSE

_LEARNING_S, LATE = 0.5, 2
"""What is learned grows every `_LEARNING_S` seconds, by what was read `LATE` times as long ago. So a fault is told before it
is learned.
"""

EVALUATION_WINDOWS = 10
"""How many windows of the fault filter an evaluation takes."""

_LEARNED_S = 10.0
"""Time constant with which what was learned fades [s]."""

_POSE_ERRORS = 1.5e-4, 3e-3
"""By how much a sensor's constant error seems to change from pose to pose, because of errors of joints, scales and axes:
standard deviations of a gyroscope and an accelerometer [rad/s, m/s^2].
"""

_SHARED_CHANGE = radians(0.015)
"""By how much the constant errors of all gyroscopes change alike, as they share the supply: standard deviation [rad/s].
20 mV change an MPU-9150 by 0.04 deg/s, half of it alike (`plant.imu.presets`).
"""

_LARGEST = 0.1, 5.0
"""Standard deviation of a fault about which the readings say nothing [rad/s, m/s^2]."""

_AGED = radians(1.0), 0.015
"""Least standard deviation of the calibration when all that was learned is compared with it [rad/s, m/s^2]."""

_STILL = 0.8
"""Share of the evidence against an IMU that has been left out which still counts in the next evaluation."""

_LEAST_PIVOT = 1e-9

PARAMETERS = record_dtype(
    prior=(np.float64, (FAULTS, FAULTS)),  # information on the sensors' errors before anything is read
    aged=(np.float64, (FAULTS, FAULTS)),  # the same, when all that was learned is compared with it
    learning_windows=np.int64,  # between two times of learning
    share=np.float64,  # of the information of the last half second that is new at such a time
    keep=np.float64,  # what is left of the information that was learned before
    stiffness=(np.float64, 2),  # inverse variance of the change of a constant error from pose to pose
    shared_stiffness=np.float64,  # and of the change that all gyroscopes share
    least=(np.float64, 2),  # information on a fault about which the readings say nothing
)
"""Constants."""

STATE = record_dtype(
    of_learned=np.int64,  # whether the evaluation under way is of all that was learned, beside the calibration
    began=np.int64,  # whether what was learned has begun with the prior
    learned=(np.float64, (FAULTS, FAULTS)),
    learned_vector=(np.float64, FAULTS),
    expected=(np.float64, (FAULTS, FAULTS)),  # the same at any pose
    expected_vector=(np.float64, FAULTS),
    waiting=(np.float64, (LATE, FAULTS, FAULTS)),  # what is learned later
    waiting_vector=(np.float64, (LATE, FAULTS)),
    waits=np.int64,  # how many there are
    windows=np.int64,  # since the last time of learning
    order=(np.int64, IMU_COUNT),  # of the IMUs in the matrices, those that are left out first
    place=(np.int64, IMU_COUNT),  # of each IMU in that order
    apart=np.int64,  # how many are left out
    recent=(np.float64, (UNKNOWNS, UNKNOWNS + 1)),  # the last half second: rest of the motion, pose, faults
    system=(np.float64, (_SIZE, _SIZE + 1)),  # the whole: errors learned, pose, faults
    pose_information=(np.float64, (POSE, POSE)),  # on the pose's error, when the errors learned are eliminated; lower triangle
    pose_by_fault=(np.float64, (POSE, FAULTS)),  # what ties it to the faults
    pose_vector=(np.float64, POSE),
    weight=(np.float64, (FAULTS, FAULTS)),  # W, in that order
    vector=(np.float64, FAULTS),  # w
    apart_evidence=(np.float64, IMU_COUNT),  # against each IMU that is left out, in that order
    apart_system=(np.float64, (IMU_COUNT, READINGS, READINGS + 1)),  # of an IMU that is left out, faded sum over evaluations
    apart_scratch=(np.float64, (READINGS, READINGS + 1)),
    row=(np.float64, FAULTS),
)
"""State and scratch."""


_WIDENINGS = IMU_COUNT + 1
_BEGIN, _BUILD = 0, 1 + REST
_APART = _BUILD + 1 + FAULTS
_TAKE = _APART + 1 + POSE
_LEARN = _TAKE + 1
STEPS = _LEARN + 1 + _WIDENINGS
"""Steps of an evaluation: copying the last half second, eliminating the rest of its motion, putting the system together,
eliminating the errors learned and what is left out, keeping what ties the pose to faults, eliminating the pose, learning, and
widening the uncertainty of what was learned.
"""


def evidence_parameters(prior: Array, window: float) -> Record:
    """The constants (dtype `PARAMETERS`).

    Args:
        prior: (147, 147), covariance of the IMUs' errors before anything is read, as in `imu_errors`.
        window: duration of a window of the fault filter [s].
    """
    biases = np.concatenate([np.arange(READINGS) + k * ERRORS for k in range(IMU_COUNT)])
    between = max(1, round(_LEARNING_S / window))
    covariance = prior[np.ix_(biases, biases)]
    wider = np.maximum(1.0, np.tile(np.repeat(_AGED, 3), IMU_COUNT) / np.sqrt(np.diag(covariance)))
    return filled(
        PARAMETERS,
        prior=np.linalg.inv(covariance),
        aged=np.linalg.inv(covariance * np.outer(wider, wider)),
        learning_windows=between,
        share=between * window / MEMORY_S,
        keep=np.exp(-between * window / _LEARNED_S),
        stiffness=1.0 / np.square(_POSE_ERRORS),
        shared_stiffness=1.0 / _SHARED_CHANGE**2,
        least=1.0 / np.square(_LARGEST),
    )


@shared_kernel
def step_evidence(p: Record, s: Record, filtered: Record, excluded: Array, step: int) -> None:
    """Do one step of an evaluation; after the last one, the results are those of the time of the first.

    Args:
        p, s: dtypes `PARAMETERS` and `STATE`.
        filtered: state of the fault filter.
        excluded: (7,), which IMUs have been left out.
        step: 0 to `STEPS` - 1.
    """
    if step == _BEGIN:
        if s.began == 0:
            s.began = 1
            s.learned[:] = p.prior
            s.learned_vector[:] = 0.0
            s.expected[:] = p.prior
            s.expected_vector[:] = 0.0
            s.waits = s.windows = 0
        _order_imus(s, excluded)
        s.of_learned = s.windows == 0 and s.waits == LATE
        if s.of_learned != 0:
            _copy_learned(p, s)
        else:
            _copy_recent(s, filtered.information, filtered.vector)
    elif step < _BUILD:
        _eliminate(s.recent, step - 1)
    elif step == _BUILD:
        if s.of_learned != 0:
            _build_system(s, p.aged, 0.0)
        else:
            _build_system(s, s.expected, 1.0)
    elif step < _APART:
        _eliminate(s.system, step - _BUILD - 1)
    elif step == _APART:
        _set_apart(s)
    elif step < _TAKE:
        _eliminate(s.system, _pose_row(s, step - _APART - 1))
    elif step == _TAKE:
        _take_weight(p, s)
    elif step == _LEARN:
        _learn(p, s)
    elif s.windows == 0:
        _widen(p, s, step - _LEARN - 1)


@kernel
def _order_imus(s: Record, excluded: Array) -> None:
    at = s.apart = 0
    for k in range(IMU_COUNT):
        if excluded[k] == 0:
            s.apart_system[k] = 0.0
        else:
            s.apart += 1
    for left_out in (1, 0):
        for k in range(IMU_COUNT):
            if (excluded[k] != 0) == (left_out == 1):
                s.order[at], s.place[k] = k, at
                at += 1


@kernel
def _state(s: Record, i: int) -> int:
    """The place in the fault filter of row `i` of `recent`: rest of the motion, pose, faults in order."""
    if i < REST:
        return POSE + i
    if i < MOTION_STATES:
        return i - REST
    fault = i - MOTION_STATES
    return int(MOTION_STATES + READINGS * s.order[fault // READINGS] + fault % READINGS)


@kernel
def _copy_recent(s: Record, information: Array, vector: Array) -> None:
    for i in range(UNKNOWNS):
        row, source = s.recent[i], information[_state(s, i)]
        for j in range(i, UNKNOWNS):
            row[j] = source[_state(s, j)]
        row[UNKNOWNS] = vector[_state(s, i)]


@kernel
def _copy_learned(p: Record, s: Record) -> None:
    """Take all that was learned in place of the last half second."""
    s.recent[:] = 0.0
    for i in range(FAULTS):
        known, row = READINGS * s.order[i // READINGS] + i % READINGS, s.recent[MOTION_STATES + i]
        for j in range(i, FAULTS):
            other = READINGS * s.order[j // READINGS] + j % READINGS
            row[MOTION_STATES + j] = s.learned[known, other] - p.prior[known, other]
        row[UNKNOWNS] = s.learned_vector[known]


@kernel
def _pose_row(s: Record, i: int) -> int:
    """The place of the error of the pose in the system, after the faults of what is left out."""
    return int(FAULTS + READINGS * s.apart + i)


@kernel
def _fault_row(s: Record, i: int) -> int:
    """The place of a fault, in order, in the system."""
    return int(FAULTS + i if i < READINGS * s.apart else FAULTS + POSE + i)


@kernel
def _set(a: Array, i: int, j: int, value: float) -> None:
    a[min(i, j), max(i, j)] = value


@kernel
def _build_system(s: Record, known_before: Array, share: float) -> None:
    """Write the upper triangle and the right side of the system: errors learned, faults of what is left out, pose, faults.

    Args:
        known_before: information on the sensors' errors (42, 42).
        share: of the right side that was learned.
    """
    a, recent = s.system, s.recent
    for i in range(FAULTS):
        known, own = READINGS * s.order[i // READINGS] + i % READINGS, _fault_row(s, i)
        source = recent[MOTION_STATES + i]
        for j in range(i, FAULTS):
            other, value = READINGS * s.order[j // READINGS] + j % READINGS, source[MOTION_STATES + j]
            a[i, j] = value + known_before[known, other]
            a[i, _fault_row(s, j)] = a[j, own] = value
            a[own, _fault_row(s, j)] = value
        a[i, _SIZE] = source[UNKNOWNS] + share * s.expected_vector[known]
        a[own, _SIZE] = source[UNKNOWNS]
        for j in range(POSE):
            value = recent[REST + j, MOTION_STATES + i]
            a[i, _pose_row(s, j)] = value
            _set(a, _pose_row(s, j), own, value)
    for i in range(POSE):
        for j in range(i, POSE):
            a[_pose_row(s, i), _pose_row(s, j)] = recent[REST + i, REST + j]
        a[_pose_row(s, i), _SIZE] = recent[REST + i, UNKNOWNS]


@kernel
def _eliminate(a: Array, k: int) -> None:
    """Eliminate unknown `k` of a symmetric system (n, n + 1), of which the upper triangle and the right side count.

    An unknown about which nothing is known stays as it is.
    """
    pivot = a[k, k]
    if not pivot > _LEAST_PIVOT:
        return
    inverse = 1.0 / pivot
    for i in range(k + 1, a.shape[0]):
        # Indices that begin at 0 let the compiler use vectors.
        row, other = a[k, i:], a[i, i:]
        share = inverse * row[0]
        for j in range(row.shape[0]):
            other[j] -= share * row[j]


@kernel
def _set_apart(s: Record) -> None:
    """Eliminate what is left out, with the evidence against it, and keep what ties the pose to the other faults."""
    for at in range(s.apart):
        if s.of_learned == 0:
            s.apart_evidence[at] = _evidence_still(s, at)
        evidence_against(s, at)
    for i in range(POSE):
        row = s.system[_pose_row(s, i)]
        for j in range(POSE):
            s.pose_information[max(i, j), min(i, j)] = s.system[_pose_row(s, min(i, j)), _pose_row(s, max(i, j))]
        for j in range(FAULTS):
            s.pose_by_fault[i, j] = row[_fault_row(s, j)] if j >= READINGS * s.apart else 0.0
        s.pose_vector[i] = row[_SIZE]


@kernel
def _take_weight(p: Record, s: Record) -> None:
    """Copy W and w; they are zero for what is left out."""
    first = READINGS * s.apart
    s.weight[:first] = 0.0
    s.weight[:, :first] = 0.0
    s.vector[:first] = 0.0
    for i in range(first, FAULTS):
        row = s.system[_fault_row(s, i)]
        for j in range(i, FAULTS):
            s.weight[i, j] = s.weight[j, i] = row[_fault_row(s, j)]
        s.weight[i, i] += p.least[i % READINGS // 3]
        s.vector[i] = row[_SIZE]


@kernel
def _evidence_still(s: Record, at: int) -> float:
    """The evidence of the last evaluations against the IMU at a place in the order, which has been left out.

    What it reads wrong may change from window to window, so one evaluation knows little of it. Several are added.
    """
    first, found = _fault_row(s, READINGS * at), 0.0
    kept, scratch = s.apart_system[s.order[at]], s.apart_scratch
    for i in range(READINGS):
        for j in range(i, READINGS):
            kept[i, j] = _STILL * kept[i, j] + s.system[first + i, first + j]
        kept[i, READINGS] = _STILL * kept[i, READINGS] + s.system[first + i, _SIZE]
    scratch[:] = kept
    for i in range(READINGS):
        if scratch[i, i] > _LEAST_PIVOT:
            found += scratch[i, READINGS] ** 2 / scratch[i, i]
        _eliminate(scratch, i)
    return found


@kernel
def evidence_against(s: Record, at: int) -> float:
    """Eliminate the IMU at a place in the order; returns the evidence that it adds to that of those before it."""
    a, found = s.system, 0.0
    for i in range(READINGS):
        k = _fault_row(s, READINGS * at + i)
        if a[k, k] > _LEAST_PIVOT:
            found += a[k, _SIZE] ** 2 / a[k, k]
        _eliminate(a, k)
    return found


@kernel
def _learn(p: Record, s: Record) -> None:
    """Every `_LEARNING_S`, learn what was read of the sensors' errors `LATE` times as long ago."""
    s.windows += EVALUATION_WINDOWS
    if s.windows < p.learning_windows or s.of_learned != 0:
        return
    s.windows = 0
    for i in range(POSE):
        _eliminate(s.recent, REST + i)
    # What is left out comes first; what it reads wrong is not learned.
    left_out = READINGS * s.apart
    for i in range(left_out):
        _eliminate(s.recent, MOTION_STATES + i)
    late = s.waits == LATE
    for i in range(FAULTS):
        known = READINGS * s.order[i // READINGS] + i % READINGS
        for j in range(i, FAULTS):
            other = READINGS * s.order[j // READINGS] + j % READINGS
            value = p.keep * s.learned[known, other] + (1.0 - p.keep) * p.prior[known, other]
            if late:
                value += p.share * s.waiting[0, known, other]
            s.learned[known, other] = s.learned[other, known] = value
            s.expected[known, other] = s.expected[other, known] = value
            for n in range(LATE - 1):
                s.waiting[n, known, other] = s.waiting[n, other, known] = s.waiting[n + 1, known, other]
            new = s.recent[MOTION_STATES + i, MOTION_STATES + j] if i >= left_out else 0.0
            s.waiting[LATE - 1, known, other] = s.waiting[LATE - 1, other, known] = new
        s.learned_vector[known] *= p.keep
        if late:
            s.learned_vector[known] += p.share * s.waiting_vector[0, known]
        for n in range(LATE - 1):
            s.waiting_vector[n, known] = s.waiting_vector[n + 1, known]
        s.waiting_vector[LATE - 1, known] = s.recent[MOTION_STATES + i, UNKNOWNS] if i >= left_out else 0.0
        s.expected_vector[known] = s.learned_vector[known]
    s.waits = min(s.waits + 1, LATE)


@kernel
def end_widening(p: Record, s: Record, step: int) -> None:
    """Widen the uncertainty of what was just learned, as far as an evaluation that is broken off before this step has not."""
    if s.windows == 0:
        for k in range(max(step - _LEARN - 1, 0) if step > _LEARN else _WIDENINGS, _WIDENINGS):
            _widen(p, s, k)


@kernel
def _widen(p: Record, s: Record, k: int) -> None:
    """Let the errors of IMU `k` (0 to 6) be others at another pose, or with 7 those of all gyroscopes change alike."""
    if k < IMU_COUNT:
        for fault in range(READINGS * k, READINGS * (k + 1)):
            s.row[:] = s.expected[fault]
            _let_change(s, s.row[fault], s.expected_vector[fault], p.stiffness[fault % READINGS // 3])
        return
    for axis in range(3):
        s.row[:] = 0.0
        known = size = 0.0
        for fault in range(axis, FAULTS, READINGS):
            size += s.expected_vector[fault]
            for j in range(FAULTS):
                s.row[j] += s.expected[fault, j]
        for fault in range(axis, FAULTS, READINGS):
            known += s.row[fault]
        _let_change(s, known, size, p.shared_stiffness)


@kernel
def _let_change(s: Record, known: float, size: float, stiffness: float) -> None:
    """Forget some of what is expected in a direction u.

    Args:
        s: dtype `STATE`, with the information times u in `row`.
        known, size: u^T times this, and u^T times the vector.
        stiffness: inverse variance of the change along u.
    """
    a, y = s.expected, s.expected_vector
    share = 1.0 / (known + stiffness)
    for i in range(FAULTS):
        other, part = a[i], share * s.row[i]
        for j in range(FAULTS):
            other[j] -= part * s.row[j]
        y[i] -= part * size
