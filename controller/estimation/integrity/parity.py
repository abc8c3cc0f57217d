"""Parity of the gyroscopes, and of accelerometers with them: large errors are told within two windows of the fault filter.

All gyroscopes see one motion. Let z (21) be the mean readings of a window less those of the planned motion. If the planned
twist is wrong by t (6), sound gyroscopes give z = J t. So what least squares leaves, z - J t, shows errors of gyroscopes
alone. Its length at each IMU counts. A gyroscope is named if the rest agrees without it.

From one window to the next, t changes with the acceleration that was not planned. If the mean forces of both windows show more
than that, it is no motion: it is vibration, or accelerometers are off, perhaps all alike. They then count less at once.

Smaller errors are left to the evidence for hypotheses, which takes 0.1 to 0.2 s. Until then they move the pose little.
"""

from math import radians

import numpy as np

from controller.least_squares import factor_cholesky, solve_cholesky
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array

_TWIST, _FIRST = 6, 6
"""Size of the twist, and its place in the states of the motion."""

_LIMIT = radians(0.75)
"""Error of an angular velocity that is told: several times what calibrated gyroscopes have [rad/s]."""

_LATE_S = 1e-3
"""The limit grows by the angular acceleration times this, as the times of samples are uncertain [s]."""

_WINDOWS = 2
"""In how many windows in a row the limit must be broken."""

_AGREE, _AGREE_OF_ALL = 0.6, 0.15
"""How large the error without the named gyroscope may be: of the limit, and of the error with it."""

_FORCE_LIMIT, _ROUGH_SIGMAS = 0.9, 3.0
"""Error of a mean force that is told: this [m/s^2], and some standard deviations of what is not known of the motion."""

_ENOUGH = 5
"""So many gyroscopes know the change of the twist well enough for that."""

_AVERAGED = 0.25
"""Share of a window in the average of such errors."""

STATE = record_dtype(
    off_motion=(np.float64, IMU_COUNT),  # mean force of two windows that is no motion [m/s^2]
    error=np.float64,  # the greatest of an IMU in the last window [rad/s]
    limit=np.float64,  # for it
    off_for=np.int64,  # for how many windows it has been beyond the limit
    worst=np.int64,  # the IMU without which the rest agrees best
    named=np.int64,  # whether it agrees
    steady=np.float64,  # greatest of those, averaged over some windows [m/s^2]
    average=(np.float64, (IMU_COUNT, 3)),  # of them, in the axes of the IMUs [m/s^2]
    twist_before=(np.float64, _TWIST),  # of the window before
    force_before=(np.float64, (IMU_COUNT, 3)),  # beyond what the planned acceleration and this twist explain
    normal=(np.float64, (_TWIST, _TWIST)),  # from here on scratch
    twist=(np.float64, _TWIST),
)
"""What the last window has shown."""


@kernel
def step_parity(s: Record, f: Record, excluded: Array, samples: int, period: float, no_motion: Array) -> bool:
    """Look at the last full window, once its readings are predicted; returns whether gyroscopes contradict each other.

    Args:
        s: dtype `STATE`.
        f: dtype `fault_filter.STATE`.
        excluded: (7,), which IMUs have been left out.
        samples: of an IMU in a window.
        period: of the samples [s].
        no_motion: (7,), is written: the variance of a sample that stands for what an accelerometer reads that is no motion
            [m^2/s^4]; all samples of a window share it. 0 within the limit.
    """
    s.limit = _LIMIT + _LATE_S * f.turning
    s.error = _error_without(s, f, excluded, -1)
    _compare_forces(s, f, excluded, samples, period, no_motion)
    s.off_for = s.off_for + 1 if s.error > s.limit else 0
    if s.off_for < _WINDOWS:
        return False
    s.off_for = 0
    s.worst, least = 0, np.inf
    for k in range(IMU_COUNT):
        if f.counted[k] != 0 and excluded[k] == 0:
            error = _error_without(s, f, excluded, k)
            if error < least:
                s.worst, least = k, error
    s.named = least < max(_AGREE * s.limit, _AGREE_OF_ALL * s.error)
    return True


@kernel
def _error_without(s: Record, f: Record, excluded: Array, left_out: int) -> float:
    """The greatest error of a gyroscope when the twist fits all but one; 0 where fewer determine it than could contradict."""
    used = 0
    s.normal[:] = 0.0
    s.twist[:] = 0.0
    for k in range(IMU_COUNT):
        if f.counted[k] == 0 or excluded[k] != 0 or k == left_out:
            continue
        used += 1
        for m in range(3):
            row = f.jacobian[k, m]
            off = f.mean[k, m] - f.predicted[k, m]
            for i in range(_TWIST):
                share = row[_FIRST + i]
                s.twist[i] += share * off
                for j in range(i + 1):
                    s.normal[i, j] += share * row[_FIRST + j]
    if 3 * used <= _TWIST or not factor_cholesky(s.normal):
        s.twist[:] = 0.0
        return 0.0
    solve_cholesky(s.normal, s.twist)
    greatest = 0.0
    for k in range(IMU_COUNT):
        if f.counted[k] == 0 or excluded[k] != 0 or k == left_out:
            continue
        squared = 0.0
        for m in range(3):
            off = f.mean[k, m] - f.predicted[k, m]
            for i in range(_TWIST):
                off -= f.jacobian[k, m, _FIRST + i] * s.twist[i]
            squared += off * off
        greatest = max(greatest, squared)
    return float(np.sqrt(greatest))


@kernel
def _compare_forces(s: Record, f: Record, excluded: Array, samples: int, period: float, no_motion: Array) -> None:
    """Find what the mean forces of this window and the last one show beyond the change of the twist between them."""
    follows, used = f.windows > 1, 0
    for k in range(IMU_COUNT):
        used += f.counted[k] != 0 and excluded[k] == 0
    s.steady = 0.0
    for k in range(IMU_COUNT):
        s.off_motion[k] = no_motion[k] = 0.0
        if f.counted[k] == 0 or excluded[k] != 0 or used < _ENOUGH:
            s.average[k] = 0.0
            continue
        squared = averaged = 0.0
        for m in range(3):
            row = f.jacobian[k, 3 + m]
            off = f.mean[k, 3 + m] - f.predicted[k, 3 + m]
            for i in range(_TWIST):
                off -= row[_FIRST + i] * s.twist[i]
            beyond = 0.5 * (off + s.force_before[k, m])
            s.force_before[k, m] = off
            for i in range(_TWIST):
                beyond -= row[_FIRST + _TWIST + i] * (s.twist[i] - s.twist_before[i]) / (samples * period)
            squared += beyond * beyond
            if follows:
                s.average[k, m] += _AVERAGED * (beyond - s.average[k, m])
            averaged += s.average[k, m] ** 2
        s.steady = max(s.steady, np.sqrt(averaged))
        if follows:
            s.off_motion[k] = np.sqrt(squared)
            if s.off_motion[k] > _FORCE_LIMIT + _ROUGH_SIGMAS * f.rough:
                no_motion[k] = samples * squared
    s.twist_before[:] = s.twist
