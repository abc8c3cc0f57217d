"""A platform at rest: how far it may have crept, by what was commanded, and by what the gyroscopes show as well.

In motion the IMUs show an error that comes up slowly. At rest they need not: one that the legs' accelerometers share looks like
another height, and what the gyroscopes read then is learned as a constant error of theirs. The loop holds the estimate, and so
moves the platform. But it has to command that motion, and the gyroscopes see it.

The rate of each leg is known twice: by its command c, less the load's share, and by the gyroscopes g, with the twist that fits
them all, as `parity` has it. Means from 1 to 2.5 s after the begin of a rest are those of legs that stand still.

**The creep.** The commands beyond their mean are added up. What counts is the farthest that this sum has moved the platform.
The protection level grows with it. When the platform moves again, both fade.

**A motion at rest.** Both rates, less their means, are added up over some seconds, of n legs:

    m_c <- m_c + T (c - mean c - m_c / tau),   m_g <- m_g + T (g - mean g - m_g / tau)
    both = m_c . m_g / max(|m_c|, |m_g|) / sqrt n

The mean of g goes on to be learned slowly, as gyroscopes get warm. A load that changes is in m_c alone, gyroscopes that drift
are in m_g alone. What is in both is a motion of the platform that its estimate does not show. When the pose comes from other
IMUs or another filter, or many periods were missed, the loop corrects it, and both means are taken anew. So they are after IMUs
were shaken, as then the commands were mostly noise.
"""

import numpy as np

from controller.inverse_kinematics import jacobian_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, vector

_REST_MPS = 1e-6
"""A leg whose reference is slower is at rest [m/s]."""

_FROM_S, _TO_S = 1.0, 2.5
"""Between these times after the begin of a rest the mean rates are taken [s]."""

_FADING_S = 5.0
"""Time constant with which the creep fades when the platform moves again [s]."""

_WARMING_S, _ADDED_S = 20.0, 5.0
"""Time constants of the gyroscopes' mean later on, and of the sums of a motion at rest [s]."""

_TOLD, _OF_SPREAD, _LONG_S = 2e-3, 4.0, 2e-3
"""A motion at rest is told beyond the first [m RMS of the legs] and beyond so many standard deviations of the lengths, by the
covariance of the pose in closed form: while the estimate settles, its error changes, and the loop moves the platform with it.
With periods longer than the last [s], more noise aliases than this covariance says. So the standard deviation is multiplied by
the root of the ratio of the periods.
"""

_COMMANDS, _GYROSCOPES, _WAYS = 0, 1, 2
_TWIST = 6

STATE = record_dtype(
    rest=np.float64,  # how long the reference has been at rest [s]
    still=(np.float64, LEGS),  # commanded rate of each leg when it stands still [m/s]
    creep=(np.float64, LEGS),  # what was commanded at rest beyond that [m]
    crept=(np.float64, 2),  # by how much it has moved position [m] and rotation [rad] at most
    source=np.int64,  # what the pose comes from
    known=np.float64,  # how long it has come from that at rest [s]
    mean=(np.float64, (_WAYS, LEGS)),  # rate of each leg, by commands and by gyroscopes, when it stands still [m/s]
    moved=(np.float64, (_WAYS, LEGS)),  # the sums of a motion at rest [m]
    both=np.float64,  # what is in both, RMS of the legs [m]
    limit=np.float64,  # beyond which that is told [m]
    jacobian=(np.float64, (6, 6)),  # from here on scratch
    rates=(np.float64, (_WAYS, LEGS)),  # of the legs [m/s]
    motion=(np.float64, _TWIST),  # of the platform
    now=(np.float64, 2),  # by how much the creep has moved it by now
)
"""The creep and the motion at rest; zeros before the motion."""


@kernel
def compare_at_rest(
    s: Record, rig: Record, duration: float, follows: bool, measured: bool, shaken: bool, commanded: Array, droop: float,
    drive: Array, twist: Array, covariance: Array, source: int, pose: Record, reference: Record,
) -> None:  # fmt: skip
    """After the commands of a cycle: add up what they and the gyroscopes say of a motion at rest.

    Args:
        s: dtype `STATE`.
        duration: since the last cycle [s].
        follows: whether the drives follow the commands.
        measured: whether encoders measure the lengths, so that nothing moves unseen at rest.
        shaken: whether IMUs are shaken.
        commanded: (6,), rate of each leg as it was commanded, after the lag [m/s].
        droop, drive: droop [m/s/N] and load of each leg (6,) [N]: their product is the load's share.
        twist: (6,), of the platform beyond the planned one, that fits all gyroscopes [m/s, rad/s].
        covariance: (6, 6), of the pose in closed form [m, rad].
        source: a number for what the pose comes from: IMUs and filter.
    """
    still = follows and not measured
    for k in range(rig.legs):
        still = still and abs(reference.motion[k, 1]) < _REST_MPS
    if source != s.source or not still or shaken:
        s.source = source
        forget_motion(s)
    if not still:
        s.rest = 0.0
        left = max(0.0, 1.0 - duration / _FADING_S) if follows else 0.0
        for k in range(rig.legs):
            s.creep[k] *= left
        for part in range(2):
            s.crept[part] *= left
        return
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    for k in range(rig.legs):
        s.rates[_COMMANDS, k] = commanded[k] - droop * drive[k]
        s.rates[_GYROSCOPES, k] = 0.0
        for i in range(_TWIST):
            s.rates[_GYROSCOPES, k] += s.jacobian[k, i] * twist[i]
    spread = _spread_of_lengths(s.jacobian, covariance, rig.legs) * np.sqrt(max(1.0, rig.period / _LONG_S))
    s.limit = max(_TOLD, _OF_SPREAD * spread) if np.isfinite(spread) else _TOLD
    _add_motion(s, rig, duration)
    _add_creep(s, rig, duration)


@kernel
def forget_motion(s: Record) -> None:
    """Forget what is known of a motion at rest, as the loop moves the platform, or is about to correct its pose."""
    s.known = 0.0
    s.moved[:] = 0.0
    s.both = 0.0


@kernel
def _add_motion(s: Record, rig: Record, duration: float) -> None:
    before, s.known = s.known, s.known + duration
    if before < _TO_S:
        for way in range(_WAYS):
            _learn_mean(s.mean[way], s.rates[way], rig.legs, before, duration)
        return
    both = size = 0.0
    for way in range(_WAYS):
        squared = 0.0
        for k in range(rig.legs):
            beyond = s.rates[way, k] - s.mean[way, k]
            s.moved[way, k] += duration * (beyond - s.moved[way, k] / _ADDED_S)
            squared += s.moved[way, k] ** 2
            if way == _GYROSCOPES:
                s.mean[way, k] += duration / _WARMING_S * beyond
        size = max(size, np.sqrt(squared))
    for k in range(rig.legs):
        both += s.moved[_COMMANDS, k] * s.moved[_GYROSCOPES, k]
    s.both = max(both, 0.0) / (size * np.sqrt(rig.legs)) if size > 0.0 else 0.0


@kernel
def _spread_of_lengths(jacobian: Array, covariance: Array, legs: int) -> float:
    """The standard deviation [m] of the lengths of a pose with this covariance (6, 6), RMS of the legs."""
    total = 0.0
    for k in range(legs):
        for i in range(_TWIST):
            for j in range(_TWIST):
                total += jacobian[k, i] * covariance[i, j] * jacobian[k, j]
    return float(np.sqrt(max(total, 0.0) / legs))


@kernel
def _add_creep(s: Record, rig: Record, duration: float) -> None:
    before, s.rest = s.rest, s.rest + duration
    if before < _TO_S:
        _learn_mean(s.still, s.rates[_COMMANDS], rig.legs, before, duration)
        return
    for k in range(rig.legs):
        s.creep[k] += duration * (s.rates[_COMMANDS, k] - s.still[k])
    move_platform(s, s.creep, s.now)
    for part in range(2):
        # Where the legs do not determine the pose, `now` is infinite, and this must not stay so.
        if s.now[part] < np.inf:
            s.crept[part] = max(s.crept[part], s.now[part])


@kernel
def _learn_mean(mean: Array, rates: Array, legs: int, before: float, duration: float) -> None:
    """Take rates (6,) into the mean (6,) of those from `_FROM_S` to `_TO_S`; `before` is the time so far [s]."""
    for k in range(legs):
        if before < _FROM_S:
            mean[k] = rates[k]
        else:
            mean[k] += duration / (before + duration - _FROM_S) * (rates[k] - mean[k])


@kernel
def move_platform(s: Record, lengths: Array, moved: Array) -> None:
    """Write by how much changes of lengths (6,) move position and rotation; infinite if the legs do not determine the pose.

    Args:
        s: has the `jacobian` of the lengths, which is lost, and the scratch `motion`.
    """
    s.motion[:] = lengths
    if solve_square(s.jacobian, s.motion) > RANK_TOLERANCE:
        for part in range(2):
            motion = vector(s.motion[3 * part :])
            moved[part] = np.sqrt(dot(motion, motion))
    else:
        moved[:] = np.inf
