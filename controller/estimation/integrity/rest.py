"""A platform at rest: how far it may have crept, by what was commanded, and by what the gyroscopes show as well.

In motion the IMUs show an error that comes up slowly. At rest they need not: one that the legs' accelerometers share looks like
another height, and what the gyroscopes read then is learned as a constant error of theirs. The loop holds the estimate, and so
moves the platform. But it has to command that motion, and the gyroscopes see it.

The rate of each leg is known twice: by its command c, less the load's share, and by the gyroscopes g, with the twist that fits
them all, as `parity` has it. Means of both from 1 to 2.5 s after the begin of a rest are those of legs that stand still.

**The creep.** The commands beyond that mean are added up. What counts is the farthest that this sum has moved the platform. The
protection level grows with it. When the platform moves again, both fade.

**A motion at rest.** Both rates, less these means, are added up over some seconds:

    m_c <- m_c + T (c - mean c - m_c / tau),   m_g <- m_g + T (g - mean g - m_g / tau),   both = m_c . m_g / max(|m_c|, |m_g|)

The mean of g goes on to be learned slowly, as gyroscopes get warm. A load that changes is in m_c alone, gyroscopes that drift
are in m_g alone. What is in both is a motion of the platform that its estimate does not show.
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

AT_REST = 2e-3
"""A motion at rest that is told [m RMS of the legs]."""

_COMMANDS, _GYROSCOPES, _WAYS = 0, 1, 2
_TWIST = 6

STATE = record_dtype(
    rest=np.float64,  # how long the reference has been at rest [s]
    still=(np.float64, (_WAYS, LEGS)),  # rate of each leg, by commands and by gyroscopes, when it stands still [m/s]
    creep=(np.float64, LEGS),  # what was commanded at rest beyond that [m]
    crept=(np.float64, 2),  # by how much it has moved position [m] and rotation [rad] at most
    moved=(np.float64, (_WAYS, LEGS)),  # the sums of a motion at rest [m]
    both=np.float64,  # what is in both, RMS of the legs [m]
    jacobian=(np.float64, (6, 6)),  # from here on scratch
    rates=(np.float64, (_WAYS, LEGS)),  # of the legs [m/s]
    motion=(np.float64, _TWIST),  # of the platform
    now=(np.float64, 2),  # by how much the creep has moved it by now
)
"""The creep and the motion at rest; zeros before the motion."""


@kernel
def compare_at_rest(
    s: Record, rig: Record, duration: float, follows: bool, measured: bool, commanded: Array, droop: float, drive: Array,
    twist: Array, pose: Record, reference: Record,
) -> None:  # fmt: skip
    """After the commands of a cycle: add up what they and the gyroscopes say of a motion at rest.

    Args:
        s: dtype `STATE`.
        duration: since the last cycle [s].
        follows: whether the drives follow the commands.
        measured: whether encoders measure the lengths, so that nothing moves unseen at rest.
        commanded: (6,), rate of each leg as it was commanded, after the lag [m/s].
        droop, drive: droop [m/s/N] and load of each leg (6,) [N]: their product is the load's share.
        twist: (6,), of the platform beyond the planned one, that fits all gyroscopes [m/s, rad/s].
    """
    if not follows:
        s.rest = 0.0
        s.creep[:] = 0.0
        s.crept[:] = 0.0
        forget_motion(s)
        return
    still = not measured
    for k in range(rig.legs):
        still = still and abs(reference.motion[k, 1]) < _REST_MPS
    if not still:
        s.rest = 0.0
        left = max(0.0, 1.0 - duration / _FADING_S)
        for k in range(rig.legs):
            s.creep[k] *= left
        for part in range(2):
            s.crept[part] *= left
        forget_motion(s)
        return
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    for k in range(rig.legs):
        s.rates[_COMMANDS, k] = commanded[k] - droop * drive[k]
        s.rates[_GYROSCOPES, k] = 0.0
        for i in range(_TWIST):
            s.rates[_GYROSCOPES, k] += s.jacobian[k, i] * twist[i]
    before, s.rest = s.rest, s.rest + duration
    if before >= _TO_S:
        _add_motion(s, rig, duration)
        _add_creep(s, rig, duration)
        return
    share = duration / (s.rest - _FROM_S) if before >= _FROM_S else 1.0
    for way in range(_WAYS):
        for k in range(rig.legs):
            s.still[way, k] += share * (s.rates[way, k] - s.still[way, k])


@kernel
def forget_motion(s: Record) -> None:
    """Forget the sums of a motion at rest, as the loop moves the platform, or is about to correct its pose."""
    s.moved[:] = 0.0
    s.both = 0.0


@kernel
def _add_motion(s: Record, rig: Record, duration: float) -> None:
    both = size = 0.0
    for way in range(_WAYS):
        squared = 0.0
        for k in range(rig.legs):
            beyond = s.rates[way, k] - s.still[way, k]
            s.moved[way, k] += duration * (beyond - s.moved[way, k] / _ADDED_S)
            squared += s.moved[way, k] ** 2
            if way == _GYROSCOPES:
                s.still[way, k] += duration / _WARMING_S * beyond
        size = max(size, np.sqrt(squared))
    for k in range(rig.legs):
        both += s.moved[_COMMANDS, k] * s.moved[_GYROSCOPES, k]
    s.both = max(both, 0.0) / (size * np.sqrt(rig.legs)) if size > 0.0 else 0.0


@kernel
def _add_creep(s: Record, rig: Record, duration: float) -> None:
    for k in range(rig.legs):
        s.creep[k] += duration * (s.rates[_COMMANDS, k] - s.still[_COMMANDS, k])
    move_platform(s, s.creep, s.now)
    for part in range(2):
        # Where the legs do not determine the pose, `now` is infinite, and this must not stay so.
        if s.now[part] < np.inf:
            s.crept[part] = max(s.crept[part], s.now[part])


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
