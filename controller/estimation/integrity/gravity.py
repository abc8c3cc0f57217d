"""How far the estimated pose has drifted from the one that gravity shows.

All accelerometers read gravity, and the pose says along which of their axes. In a window of the fault filter they read
`z = J m + b` more than pose and planned acceleration say, with the error m of the pose (6) and constant errors b of the
sensors. Least squares over all accelerometers, faded with `_MEMORY_S`, give

    m + c = (sum J^T W J)^-1 sum J^T W z,

where c is what b does to it: some tenths of a millimetre, which hardly change. So the mean of m + c since the motion began,
faded with `_REFERENCE_S`, tells c, and what is left is how far the pose has drifted since. The gyroscopes have no part in it:
errors that they share show themselves here when the filters still take them for motion.
"""

import numpy as np

from controller.estimation.whole_mechanism.readings import READINGS
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array
from plant.vectors import dot, vector

POSE = 6

_MEMORY_S, _REFERENCE_S = 1.0, 30.0
"""Time constants with which readings and reference fade [s]."""

_FIRST_S = 0.5
"""The least time constant of the reference [s]."""

STATE = record_dtype(
    information=(np.float64, (POSE, POSE)),  # sum of J^T W J
    vector=(np.float64, POSE),  # sum of J^T W z
    reference=(np.float64, POSE),  # c [m, rad]
    age=np.float64,  # of the motion [s]
    system=(np.float64, (POSE, POSE)),  # scratch
    pose=(np.float64, POSE),  # scratch
    drifted=(np.float64, 2),  # by how much position [m] and rotation [rad] have drifted; 0 where gravity does not show the pose
)
"""The sums, the reference and what is left; zeros before the motion."""


@kernel
def compare_with_gravity(s: Record, filtered: Record, excluded: Array, moves: bool) -> None:
    """After the jobs of a window: compare the loop's pose with the one that the accelerometers show.

    Args:
        s: dtype `STATE`.
        filtered: state of the fault filter.
        excluded: (7,), which IMUs have been left out.
        moves: whether the drives follow the commands.
    """
    _add_window(s, filtered, excluded)
    s.system[:] = s.information
    s.pose[:] = s.vector
    if not solve_square(s.system, s.pose) > RANK_TOLERANCE:
        s.drifted[:] = 0.0
        return
    if not moves:
        s.age = 0.0
        s.reference[:] = s.pose
    s.age += filtered.between
    share = min(1.0, filtered.between / min(max(s.age, _FIRST_S), _REFERENCE_S))
    for i in range(POSE):
        s.pose[i] -= s.reference[i]
        s.reference[i] += share * s.pose[i]
        s.pose[i] *= 1.0 - share
    for part in range(2):
        drift = vector(s.pose[3 * part :])
        s.drifted[part] = np.sqrt(dot(drift, drift))


@kernel
def _add_window(s: Record, filtered: Record, excluded: Array) -> None:
    keep = np.exp(-filtered.between / _MEMORY_S)
    s.information *= keep
    s.vector *= keep
    for k in range(IMU_COUNT):
        if filtered.counted[k] == 0 or excluded[k] != 0:
            continue
        weight = filtered.weight[k, 1]
        for axis in range(3, READINGS):
            row = filtered.jacobian[k, axis]
            off = weight * (filtered.mean[k, axis] - filtered.predicted[k, axis])
            for i in range(POSE):
                s.vector[i] += off * row[i]
                for j in range(POSE):
                    s.information[i, j] += weight * row[i] * row[j]
