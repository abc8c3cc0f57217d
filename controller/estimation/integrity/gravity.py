"""How far the estimated pose has drifted from the one that gravity shows.

All accelerometers read gravity, and the pose says along which of their axes. In a window of the fault filter, their readings
differ by `z = J m + b` from what pose and planned acceleration predict, with the error m of the pose (6) and constant errors b
of the sensors. Least squares over all accelerometers, faded with `_MEMORY_S`, give

    m + c = (sum J^T W J)^-1 sum J^T W z,

where c is what b does to it: some tenths of a millimetre, which hardly change. So the mean of m + c since the motion began,
faded with `_REFERENCE_S`, tells c, and what is left is how far the pose has drifted since. Of a drift that goes on, the mean
takes half at first. What is older than `_REFERENCE_S` is all in the mean. The gyroscopes have no part in it: errors that they
share show themselves here when the filters still take them for motion.

With another set of IMUs, c is another one, and the drift is too large until the mean has followed.

If the platform's IMU turns slowly on its mounting, the pose follows it, and only the legs show that. How well they do, the same
sums of the legs alone tell.
"""

import numpy as np

from controller.estimation.integrity.evidence import POSE
from controller.estimation.whole_mechanism.readings import READINGS
from controller.least_squares import invert_symmetric, solve_square
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, vector

_MEMORY_S, _REFERENCE_S = 1.0, 30.0
"""Time constants with which readings and reference fade [s]."""

_FIRST_S = 0.5
"""The least time constant of the reference [s]."""

_LEAST_PIVOT = 1e-3
"""Gravity shows the pose if the least pivot of the sum is at least so large, as a share of the greatest. With all IMUs it is
0.01 and more on all presets.
"""

_LEAST_LEGS, _MOST_SPREAD = 4, 0.02
"""How well the legs show the rotation is only asked of so many or more, and at most so little is admitted [rad]."""

STATE = record_dtype(
    information=(np.float64, (IMU_COUNT, POSE, POSE)),  # J^T W J of each IMU, sum
    vector=(np.float64, (IMU_COUNT, POSE)),  # J^T W z of each IMU, sum
    follows=np.int64,  # whether the reference is of this motion
    age=np.float64,  # of the reference [s]
    reference=(np.float64, POSE),  # c [m, rad]
    system=(np.float64, (POSE, POSE)),  # scratch
    inverse=(np.float64, (POSE, POSE)),  # scratch
    pose=(np.float64, POSE),  # scratch
    drifted=(np.float64, 2),  # by how much position [m] and rotation [rad] have drifted; 0 where gravity does not show the pose
)
"""The sums, the reference, and what is left, which is 0 before the motion."""


@kernel
def compare_with_gravity(s: Record, filtered: Record, imus: Record, moves: bool) -> None:
    """After the jobs of a window: compare the loop's pose with the one that the accelerometers show.

    Args:
        s: dtype `STATE`.
        filtered: state of the fault filter.
        imus: dtype `imu_health.STATE`: which IMUs are used, and which have been left out.
        moves: whether the drives follow the commands.
    """
    _add_window(s, filtered, imus.excluded)
    s.drifted[:] = 0.0
    if not moves:
        s.follows = 0
        return
    s.system[:] = 0.0
    s.pose[:] = 0.0
    for k in range(IMU_COUNT):
        if imus.used[k] != 0:
            s.system += s.information[k]
            s.pose += s.vector[k]
    if not solve_square(s.system, s.pose) > _LEAST_PIVOT:
        return
    if s.follows == 0:
        s.follows = 1
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
def spread_by_legs(s: Record, imus: Record) -> float:
    """The standard deviation of the rotation that the accelerometers of the legs show, at most `_MOST_SPREAD` [rad].

    With fewer than `_LEAST_LEGS` it is 0: they do not show the pose at all, and nothing is said. The sums fade exponentially.
    So the covariance of what they show is half the inverse of their information.
    """
    used = 0
    s.system[:] = 0.0
    for k in range(LEGS):
        if imus.used[k] != 0:
            used += 1
            s.system += s.information[k]
    if used < _LEAST_LEGS:
        return 0.0
    spread = np.inf
    if invert_symmetric(s.system, s.inverse):
        spread = np.sqrt(0.5 * (s.inverse[3, 3] + s.inverse[4, 4] + s.inverse[5, 5]))
    return float(spread if spread < _MOST_SPREAD else _MOST_SPREAD)


@kernel
def _add_window(s: Record, filtered: Record, excluded: Array) -> None:
    keep = np.exp(-filtered.between / _MEMORY_S)
    s.information *= keep
    s.vector *= keep
    for k in range(IMU_COUNT):
        if excluded[k] != 0:
            s.information[k] = 0.0
            s.vector[k] = 0.0
        elif filtered.counted[k] != 0:
            _add_imu(s.information[k], s.vector[k], filtered, k)


@kernel
def _add_imu(information: Array, total: Array, filtered: Record, k: int) -> None:
    weight = filtered.weight[k, 1]
    for axis in range(3, READINGS):
        row = filtered.jacobian[k, axis]
        off = weight * (filtered.mean[k, axis] - filtered.predicted[k, axis])
        for i in range(POSE):
            total[i] += off * row[i]
            for j in range(POSE):
                information[i, j] += weight * row[i] * row[j]
