"""Parity of the gyroscopes, and of accelerometers with them: large errors are told within two windows of the fault filter.

All gyroscopes see one motion. Let z (21) be the mean readings of a window less those of the planned motion. If the planned
twist is wrong by t (6), sound gyroscopes give z = J t. So what least squares leaves, e = z - J t, shows errors of gyroscopes
alone. Let H = J (J^T J)^-1 J^T, with the block H_k of IMU k. Without this IMU, the sum of squares is less by
e_k^T (I - H_k)^-1 e_k (Cook and Weisberg, Residuals and influence in regression, 1982). The root of this is how far its
gyroscope is off, however much the fit follows it. A gyroscope is named if the rest agrees without it, unless a base that turns,
which gives J three more columns, explains them about as well. What a gyroscope has been off for many seconds is no large error:
it is left to the evidence.

Where the change of t differs from window to window, the acceleration that was not planned is not steady: the loop may chatter
in the mechanism's play. The fault filter then expects more jerk, and relies less on mean forces.

From one window to the next, t changes with the acceleration that was not planned, averaged with weights that rise in the first
window and fall in the second one. If the forces, averaged alike, show more than that, it is no motion: it is vibration, or
accelerometers are off, perhaps all alike. They then count less at once. If all of them go on to show it, or two show more, the
run ends.

Smaller errors are left to the evidence for hypotheses, which takes 0.1 to 0.2 s. Until then they move the pose little.
"""

from math import radians

import numpy as np

from controller.least_squares import factor_cholesky, invert_cholesky, solve_cholesky
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.pose import Array

_TWIST, _FIRST, _WITH_BASE = 6, 6, 9
"""Size of the twist, its place in the states of the motion, and its size together with the base's rate."""

_LIMIT = radians(0.55)
"""Error of an angular velocity that is told: several times what calibrated gyroscopes have [rad/s]."""

_NOISE_SIGMAS = 6.0
"""The limit is at least so many standard deviations of the noise of a window's mean: an error has three components."""

_LATE_S = 1e-3
"""The limit grows by the angular acceleration times this, as the times of samples are uncertain [s]."""

_WINDOWS = 2
"""In how many windows in a row the limit must be broken."""

_USUAL_S = 10.0
"""Time constant of what counts as usual for a gyroscope [s]."""

_AGREE, _AGREE_OF_ALL = 0.6, 0.15
"""How large the error without the named gyroscope may be: of the limit, and of the error with it."""

_AS_WELL = 2.0
"""A base that turns explains the gyroscopes if it leaves less than so many times what is left without the named one."""

_LEAST_LEFT = 1e-4
"""A gyroscope's axis is known from the others if this share of an error there would be left over."""

_FORCE_LIMIT, _ROUGH_SIGMAS = 0.9, 3.0
"""Error of a mean force that is told: this [m/s^2], and some standard deviations of what is not known of the motion."""

_ENOUGH = 5
"""So many gyroscopes know the change of the twist well enough for that."""

_CHANGE_S = 0.1
"""Time constant over which the change of the acceleration that was not planned is averaged [s]."""

_AVERAGED = 0.25
"""Share of a window in the average of such errors."""

SHARED, _SHARED_WINDOWS = 0.1, 10
OF_TWO, _WINDOWS_OF_TWO = 0.2, 12
"""The average that all accelerometers, or two of them, show in so many windows in a row before the run ends [m/s^2]."""

_OF_VIBRATION = 0.5
"""Share of the RMS of vibration that is none of such an error of two: it moves slowly now and then."""

STATE = record_dtype(
    off_motion=(np.float64, IMU_COUNT),  # mean force of two windows that is no motion [m/s^2]
    usual=(np.float64, (IMU_COUNT, 3)),  # what each gyroscope has been off for long, in its axes [rad/s]
    error=np.float64,  # the greatest of a gyroscope in the last window [rad/s]
    limit=np.float64,  # for it
    off_for=np.int64,  # for how many windows it has been beyond the limit
    worst=np.int64,  # the IMU that has it, without which the rest agrees best
    named=np.int64,  # whether the rest then agrees
    steady=np.float64,  # greatest mean force that is no motion, averaged over some windows [m/s^2]
    common=np.float64,  # the least, averaged or not, which all show
    common_for=np.int64,  # for how many windows that has been beyond the limit
    shared=np.int64,  # whether for so many that they share an error
    second=np.float64,  # the second greatest of what each shows, averaged or not: two show it
    shown_for=(np.int64, IMU_COUNT),  # for how many windows that of each has been beyond the limit
    two=np.int64,  # whether that of two has been for so many that no single IMU is the cause
    average=(np.float64, (IMU_COUNT, 3)),  # of these forces, in the axes of the IMUs [m/s^2]
    twist_before=(np.float64, _TWIST),  # of the window before
    force_before=(np.float64, (IMU_COUNT, 3)),  # its part in the forces beyond the planned acceleration and the twist
    twist=(np.float64, _TWIST),  # of this one, beyond the planned one
    acceleration=(np.float64, _TWIST),  # its change since the window before, per second
    known_for=np.int64,  # in how many windows in direct succession it has been known well enough
    mean_square=(np.float64, 2),  # of that acceleration's change between windows, less noise: linear, angular
    change=(np.float64, _TWIST),  # from here on scratch: that change
    squares=(np.float64, 2),  # its squares
    normal=(np.float64, (_WITH_BASE, _WITH_BASE)),
    covariance=(np.float64, (_WITH_BASE, _WITH_BASE)),  # of what is fitted, for gyroscopes of variance 1
    fit=(np.float64, _WITH_BASE),  # twist and base's rate
    rows=(np.float64, (IMU_COUNT, 3, _WITH_BASE)),  # of J: what the twist adds to each reading, and the base's rate
    known=(np.float64, _WITH_BASE),
    left=(np.float64, (3, 3)),
    residual=(np.float64, 3),
    solved=(np.float64, 3),
)
"""What the last window has shown."""


@kernel
def step_parity(
    s: Record, f: Record, excluded: Array, frames: Array, samples: int, period: float, variance: float, shaking: Record
) -> bool:
    """Look at the last full window, once its readings are predicted; returns whether gyroscopes contradict each other.

    Args:
        s: dtype `STATE`.
        f: dtype `fault_filter.STATE`.
        excluded: (7,), which IMUs have been left out.
        frames: (7, 3, 3), axes of the IMUs in {1} by rows, of late: zeros if they are not known yet.
        samples: of an IMU in a window.
        period: of the samples [s].
        variance: of a sample's noise, angular velocity [rad^2/s^2].
        shaking: dtype `shaking.STATE`. Its `no_motion` is written: the variance of a sample that stands for what an
            accelerometer reads that is no motion [m^2/s^4]; all samples of a window share it. 0 within the limit.
    """
    duration = samples * period
    s.rows[:, :, :_TWIST] = f.jacobian[:, :3, _FIRST : _FIRST + _TWIST]
    s.rows[:, :, _TWIST:] = frames
    worst, s.error = _find_worst(s, f, excluded, -1, _TWIST)
    s.worst = max(worst, 0)
    s.twist[:] = s.fit[:_TWIST]
    least = max(_LIMIT, _NOISE_SIGMAS * np.sqrt(variance / samples))
    s.limit = least + _LATE_S * (f.turning + _unplanned_turning(s, f, duration))
    if s.error <= s.limit:
        _learn_usual(s, f, excluded, duration / _USUAL_S)
    _average_unplanned_change(s, f, excluded, worst >= 0, duration, variance / samples)
    _compare_forces(s, f, excluded, samples, duration, shaking)
    s.off_for = s.off_for + 1 if s.error > s.limit else 0
    if s.off_for < _WINDOWS:
        return False
    s.off_for = 0
    _, without = _find_worst(s, f, excluded, s.worst, _TWIST)
    fits, on_turning_base = _find_worst(s, f, excluded, -1, _WITH_BASE)
    agrees = without < max(_AGREE * s.limit, _AGREE_OF_ALL * s.error)
    s.named = agrees and not (fits >= 0 and on_turning_base < _AS_WELL * without)
    return True


@kernel
def _counts(f: Record, excluded: Array, k: int) -> bool:
    return bool(f.counted[k] != 0 and excluded[k] == 0)


@kernel
def _count_used(f: Record, excluded: Array) -> int:
    used = 0
    for k in range(IMU_COUNT):
        used += _counts(f, excluded, k)
    return used


@kernel
def _find_worst(s: Record, f: Record, excluded: Array, left_out: int, unknowns: int) -> tuple[int, float]:
    """Fit the twist, or with 9 unknowns the base's rate as well, to all gyroscopes but one; returns which is off most, and by
    how much.

    The error is 0, and the gyroscope -1, where too few are left to contradict each other.
    """
    used = 0
    normal, covariance, fit = s.normal[:unknowns, :unknowns], s.covariance[:unknowns, :unknowns], s.fit[:unknowns]
    normal[:] = 0.0
    fit[:] = 0.0
    for k in range(IMU_COUNT):
        if not _counts(f, excluded, k) or k == left_out:
            continue
        used += 1
        for m in range(3):
            row = s.rows[k, m]
            off = f.mean[k, m] - f.predicted[k, m] - s.usual[k, m]
            for i in range(unknowns):
                fit[i] += row[i] * off
                for j in range(i + 1):
                    normal[i, j] += row[i] * row[j]
    if 3 * used <= unknowns or not factor_cholesky(normal):
        fit[:] = 0.0
        return -1, 0.0
    solve_cholesky(normal, fit)
    invert_cholesky(normal, covariance)
    worst, most = -1, 0.0
    for k in range(IMU_COUNT):
        if _counts(f, excluded, k) and k != left_out:
            squared = _squared_error(s, f, k, unknowns)
            if squared > most:
                worst, most = k, squared
    return worst, float(np.sqrt(most))


@kernel
def _find_residual(s: Record, f: Record, k: int, unknowns: int) -> None:
    """What the fit leaves of a gyroscope's reading, into `residual`."""
    for m in range(3):
        off = f.mean[k, m] - f.predicted[k, m] - s.usual[k, m]
        for i in range(unknowns):
            off -= s.rows[k, m, i] * s.fit[i]
        s.residual[m] = off


@kernel
def _squared_error(s: Record, f: Record, k: int, unknowns: int) -> float:
    """By how much the sum of squares is less without a gyroscope; 0 if nothing else knows what it reads."""
    _find_residual(s, f, k, unknowns)
    for m in range(3):
        for n in range(m + 1):
            s.left[m, n] = 1.0 if n == m else 0.0
        for i in range(unknowns):
            known = 0.0
            for j in range(unknowns):
                known += s.covariance[i, j] * s.rows[k, m, j]
            s.known[i] = known
        for n in range(m + 1):
            for i in range(unknowns):
                s.left[m, n] -= s.rows[k, n, i] * s.known[i]
        s.solved[m] = s.residual[m]
    if not factor_cholesky(s.left) or min(s.left[0, 0], s.left[1, 1], s.left[2, 2]) < _LEAST_LEFT:
        return 0.0
    solve_cholesky(s.left, s.solved)
    squared = 0.0
    for m in range(3):
        squared += s.residual[m] * s.solved[m]
    return squared


@kernel
def _unplanned_turning(s: Record, f: Record, duration: float) -> float:
    """The greatest angular acceleration of an IMU that was not planned, by the change of the twist [rad/s^2]."""
    most = 0.0
    if f.follows == 0:
        return most
    for k in range(IMU_COUNT):
        squared = 0.0
        for m in range(3):
            change = 0.0
            for i in range(_TWIST):
                change += f.jacobian[k, m, _FIRST + i] * (s.twist[i] - s.twist_before[i])
            squared += change * change
        most = max(most, squared)
    return float(np.sqrt(most) / duration)


@kernel
def _average_unplanned_change(s: Record, f: Record, excluded: Array, fits: bool, duration: float, variance: float) -> None:
    """Average how much the acceleration that was not planned changes from window to window, where windows follow each other.

    It does not count where too few gyroscopes know it. What their noise adds on average, of this variance in a window's mean
    [rad^2/s^2], is taken off.
    """
    if fits and _count_used(f, excluded) >= _ENOUGH:
        s.known_for = s.known_for + 1 if f.follows != 0 else 1
    else:
        s.known_for = 0
    # The change of a difference counts the middle one of three means twice.
    noise = 6.0 * variance / duration**2
    s.squares[:] = 0.0
    for i in range(_TWIST):
        acceleration = (s.twist[i] - s.twist_before[i]) / duration
        s.change[i] = acceleration - s.acceleration[i]
        s.acceleration[i] = acceleration
        if i >= 3:
            s.squares[1] += s.change[i] ** 2 - noise * s.covariance[i, i]
    for m in range(3):
        row = f.jacobian[PLATFORM_IMU, 3 + m, _FIRST + _TWIST :]
        along = 0.0
        for i in range(_TWIST):
            along += row[i] * s.change[i]
            for j in range(_TWIST):
                s.squares[0] -= noise * row[i] * s.covariance[i, j] * row[j]
        s.squares[0] += along * along
    if s.known_for > 2 and np.isfinite(s.squares[0] + s.squares[1]):
        for i in range(2):
            s.mean_square[i] += min(1.0, duration / _CHANGE_S) * (s.squares[i] - s.mean_square[i])
            f.unplanned_change[i] = max(s.mean_square[i], 0.0)


@kernel
def _learn_usual(s: Record, f: Record, excluded: Array, share: float) -> None:
    for k in range(IMU_COUNT):
        if _counts(f, excluded, k):
            _find_residual(s, f, k, _TWIST)
            for m in range(3):
                s.usual[k, m] += share * s.residual[m]


@kernel
def _compare_forces(s: Record, f: Record, excluded: Array, samples: int, duration: float, shaking: Record) -> None:
    """Find what the forces of this window and the last one show beyond the change of the twist between them."""
    follows, used, lasting, no_motion = f.follows != 0, _count_used(f, excluded), 0, shaking.no_motion
    after_gap = f.windows > 1 and not follows
    rough = _ROUGH_SIGMAS * f.rough
    s.steady = s.second = most = 0.0
    s.common = np.inf
    for k in range(IMU_COUNT):
        s.off_motion[k] = 0.0
        if not after_gap:
            no_motion[k] = 0.0
        if not _counts(f, excluded, k) or used < _ENOUGH:
            s.average[k] = 0.0
            s.shown_for[k] = 0
            continue
        squared = averaged = 0.0
        for m in range(3):
            row = f.jacobian[k, 3 + m]
            off = f.mean[k, 3 + m] - f.predicted[k, 3 + m]
            for i in range(_TWIST):
                off -= row[_FIRST + i] * s.twist[i]
            beyond = 0.5 * (s.force_before[k, m] + off - f.trend[k, m])
            s.force_before[k, m] = off + f.trend[k, m]
            for i in range(_TWIST):
                beyond -= row[_FIRST + _TWIST + i] * (s.twist[i] - s.twist_before[i]) / duration
            squared += beyond * beyond
            if follows:
                s.average[k, m] += _AVERAGED * (beyond - s.average[k, m])
            averaged += s.average[k, m] ** 2
        averaged, own = max(np.sqrt(averaged) - rough, 0.0), np.sqrt(squared)
        s.steady = max(s.steady, averaged)
        # A shock is in the average for long, and in two windows.
        shown = min(averaged, max(own - rough, 0.0))
        s.common = min(s.common, shown)
        s.second, most = max(s.second, min(shown, most)), max(shown, most)
        lasts = follows and shown > max(OF_TWO, _OF_VIBRATION * np.sqrt(shaking.mean[k] + shaking.hidden[k]))
        if not after_gap:
            s.shown_for[k] = s.shown_for[k] + 1 if lasts else 0
        lasting += s.shown_for[k] >= _WINDOWS_OF_TWO
        if follows:
            s.off_motion[k] = own
            if s.off_motion[k] > _FORCE_LIMIT + rough:
                no_motion[k] = samples * squared
    s.twist_before[:] = s.twist
    s.common_for = s.common_for + 1 if used >= _ENOUGH and s.common > SHARED else 0
    s.shared = s.common_for >= _SHARED_WINDOWS
    s.two = lasting > 1
