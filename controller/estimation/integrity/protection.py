"""The protection level: how far the pose may be off, fault or none.

As satellite navigation has it (RAIM), the level counts what a fault could do unseen, and the worst hypothesis gives it.
`evidence` leaves C_mm m + C_mf f = c_m for the error m of the pose. The most likely sizes a of a hypothesis D have the
covariance (D^T W D)^-1. Such a fault moves the pose by -C_mm^-1 C_mf D a, of covariance V, and leaves it off by
m = C_mm^-1 (c_m - C_mf D a). Let e be its evidence less the number of its directions: by chance, e hardly ever exceeds 6.

    no fault       |C_mm^-1 c_m|
    unseen fault   sqrt(max(e, 1/2) tr V): what could be there unseen; little where the readings would show it
    seen fault     sqrt(e tr V) + 3 |m|, for e > 6

The 3 is for faults that grow: such a fault is larger at the end of the filter's memory than on average over it, and has moved
the pose before. The level is the root of the squares of the greatest of these and of 2.2 standard deviations of the pose as
its filter has it.
"""

import numpy as np

from controller.estimation.integrity.fault_filter import FAULTS
from controller.least_squares import factor_cholesky, solve_cholesky
from plant.compiled import Record, kernel, record_dtype
from plant.pose import Array

POSE = 6
_CHANCE = 6.0
"""By how much the evidence may exceed the number of directions by chance."""

_UNSEEN = 0.5
"""Evidence ascribed to a fault for which there is less [-]."""

_GROWN = 3.0
"""By which factor the present error may exceed the mean one within the fault filter's memory."""

_SIGMAS = 2.2
"""So many standard deviations of the pose, as its own filter has it, count in the level."""

STATE = record_dtype(
    level=(np.float64, 2),  # of position [m] and rotation [rad], of the last complete evaluation
    hypothesis=(np.int64, 2),  # that gives the level; -1: none
    fault=(np.float64, 2),  # the greatest effect of a fault, of the evaluation under way
    next_hypothesis=(np.int64, 2),  # that has it; -1: none
    determined=np.int64,  # whether the readings determine the pose
    factor=(np.float64, (POSE, POSE)),  # Cholesky, of the pose's information
    error=(np.float64, POSE),  # of the pose without a fault
    effect=(np.float64, (POSE, POSE)),  # of the directions of a hypothesis on the pose, a direction a row
    shift=(np.float64, POSE),  # of the pose by the fault
    covariance=(np.float64, (POSE, POSE)),  # of the pose as its own filter has it
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
    s.next_hypothesis[:] = -1
    for part in range(2):
        squared = 0.0
        for i in range(3 * part, 3 * part + 3):
            squared += s.error[i] ** 2
        s.fault[part] = np.sqrt(squared)


@kernel
def take_hypothesis(s: Record, e: Record, hypothesis: int, count: int, found: float, t: Record) -> None:
    """Take the effect of a hypothesis, for which `evidence_for` has just been called, if it is the greatest so far.

    Args:
        s, e, t: dtypes `STATE`, `evidence.STATE` and `hypotheses.SCRATCH`.
        hypothesis: its number.
        count: of its directions.
        found: the evidence.
    """
    if s.determined == 0:
        return
    s.shift[:] = 0.0
    for n in range(count):
        effect = s.effect[n]
        effect[:] = 0.0
        if not t.matrix[n, n] > 0.0:
            continue
        for j in range(FAULTS):
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
    seen = found - count
    for part in range(2):
        squared = variance = 0.0
        for i in range(3 * part, 3 * part + 3):
            squared += (s.error[i] - s.shift[i]) ** 2
            for n in range(count):
                variance += s.effect[n, i] ** 2
        fault = np.sqrt(max(seen, _UNSEEN) * variance)
        if seen > _CHANCE:
            fault += _GROWN * np.sqrt(squared)
        if fault > s.fault[part]:
            s.fault[part] = fault
            s.next_hypothesis[part] = hypothesis


@kernel
def end_level(s: Record, covariance: Array) -> None:
    """Publish the level, infinite where the readings do not determine the pose, with the pose's own `covariance` (6, 6)."""
    for part in range(2):
        variance = 0.0
        for i in range(3 * part, 3 * part + 3):
            variance += covariance[i, i]
        s.level[part] = np.sqrt(_SIGMAS**2 * variance + s.fault[part] ** 2) if s.determined != 0 else np.inf
        s.hypothesis[part] = s.next_hypothesis[part]
