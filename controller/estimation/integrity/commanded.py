"""How far the estimated pose has moved otherwise than commanded.

A drive moves its leg at `u - droop F`, with the command u behind the drive's lag, and the load F and the friction of the
feed-forward. The integral of that is the expected length. A load, resistance or friction that is not as the mechanism's file
says makes the estimated length l leave the expected one slowly. An error of the estimate that comes up within a second makes it
leave fast. So for each leg, an offset x and its rate v follow the difference d of l and the expected length,

    left = d - x - v T,   x <- x + v T + a (2 - a) left,   v <- v + 1.5 a^2 / T left,   a = T / tau,

and what is left moves the platform by `J^-1 left`, with the Jacobian J of the lengths. The time constant tau is half the age of
the motion, at least 0.05 s and at most 1.5 s. While it grows, x and v are the straight line through all differences so far, by
least squares, so that what is wrong from the start is learned soon.

No sensor measures the expected lengths; only the load depends on the estimate, and little. So an error that all IMUs share
shows itself here, too.

Offset and rate follow an error that comes up more slowly. In motion the IMUs show such an error. At rest they need not: one
that the legs' accelerometers share looks like another height. The loop then holds the estimate, and so moves the platform. So
at rest the commands are added up, less the load's share, and less their mean from 1 to 2.5 s after the begin of the rest, which
holds the legs still. This sum is a creep of the legs. What counts is the farthest that the creep has moved the platform. When
the platform moves again, both fade.
"""

import numpy as np

from controller.inverse_kinematics import jacobian_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from controller.load_feed_forward import friction_at
from controller.rig import elapsed
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, vector

_FIRST_S, _LAST_S = 0.05, 1.5
"""The least and the greatest time constant with which offset and rate follow [s]."""

_REST_MPS = 1e-6
"""A leg whose reference is slower is at rest [m/s]."""

_FROM_S, _TO_S = 1.0, 2.5
"""The mean of the commands between these times after the begin of a rest holds the legs still [s]."""

_FADING_S = 5.0
"""Time constant with which the creep fades when the platform moves again [s]."""

STATE = record_dtype(
    following=np.int64,  # whether command and offset are those of the last cycle
    age=np.float64,  # of the motion [s]
    command=(np.float64, LEGS),  # [m/s]
    rate=(np.float64, LEGS),  # commanded, after the lag [m/s]
    offset=(np.float64, LEGS),  # x and the expected length together [m]
    offset_rate=(np.float64, LEGS),  # v [m/s]
    left=(np.float64, LEGS),  # what is left of each length [m]
    moved=(np.float64, 2),  # by how much position [m] and rotation [rad] have moved otherwise
    rest=np.float64,  # how long the reference has been at rest [s]
    still=(np.float64, LEGS),  # commanded rate that holds each leg still [m/s]
    creep=(np.float64, LEGS),  # what was commanded at rest beyond that [m]
    crept=(np.float64, 2),  # by how much it has moved position [m] and rotation [rad] at most
    jacobian=(np.float64, (6, 6)),  # scratch
    motion=(np.float64, 6),  # scratch: of the platform
    now=(np.float64, 2),  # scratch: by how much it has moved them by now
)
"""The expected lengths, and how the estimate differs from them; zeros before the motion."""


@kernel
def compare_with_commands(
    s: Record, rig: Record, time: Record, follows: bool, measured: bool, lag: float, feed_forward: Record, load: Record,
    pose: Record, reference: Record, commands: Array,
) -> None:  # fmt: skip
    """After the commands of a cycle: compare the estimated lengths with what the commands before have made of them.

    Args:
        s: dtype `STATE`.
        follows: whether the drives follow the commands.
        measured: whether encoders measure the lengths, so that nothing moves unseen at rest.
        lag: of a leg behind its command, by drive and bus [s].
        feed_forward, load: dtypes `PARAMETERS` and `STATE` of `load_feed_forward`.
        commands: (6,) [m/s].
    """
    if not follows:
        s.following = 0
        s.moved[:] = s.crept[:] = s.creep[:] = s.rest = 0.0
        return
    if s.following == 0:
        s.following = 1
        s.rate[:] = commands
        s.offset[:] = pose.lengths
        s.offset_rate[:] = s.age = 0.0
    else:
        _compare(s, rig, elapsed(rig, time), lag, feed_forward, load, pose, reference)
        _add_creep(s, rig, elapsed(rig, time), measured, feed_forward, load, pose, reference)
    s.command[:] = commands


@kernel
def _compare(
    s: Record, rig: Record, duration: float, lag: float, feed_forward: Record, load: Record, pose: Record, reference: Record
) -> None:  # fmt: skip
    s.age += duration
    share = min(1.0, duration / min(max(0.5 * s.age, _FIRST_S), _LAST_S))
    for k in range(rig.legs):
        s.rate[k] += duration / (duration + lag) * (s.command[k] - s.rate[k])
        braked = load.drive[k] + friction_at(feed_forward, k, reference.motion[k, 1])
        s.offset[k] += duration * (s.rate[k] - feed_forward.droop * braked + s.offset_rate[k])
        s.left[k] = pose.lengths[k] - s.offset[k]
        s.offset[k] += share * (2.0 - share) * s.left[k]
        s.offset_rate[k] += 1.5 * share**2 / duration * s.left[k]
    _move_platform(s, rig, pose, s.left, s.moved)


@kernel
def _add_creep(
    s: Record, rig: Record, duration: float, measured: bool, feed_forward: Record, load: Record, pose: Record, reference: Record
) -> None:  # fmt: skip
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
        return
    before, s.rest = s.rest, s.rest + duration
    for k in range(rig.legs):
        rate = s.rate[k] - feed_forward.droop * load.drive[k]
        if before >= _TO_S:
            s.creep[k] += duration * (rate - s.still[k])
        elif before < _FROM_S:
            s.still[k] = rate
        else:
            s.still[k] += duration / (s.rest - _FROM_S) * (rate - s.still[k])
    if before >= _TO_S:
        _move_platform(s, rig, pose, s.creep, s.now)
        for part in range(2):
            # Where the legs do not determine the pose, `moved` is infinite as well, and this must not stay so.
            if s.now[part] < np.inf:
                s.crept[part] = max(s.crept[part], s.now[part])


@kernel
def _move_platform(s: Record, rig: Record, pose: Record, lengths: Array, moved: Array) -> None:
    """Write by how much changes of lengths (6,) move position and rotation; infinite if the legs do not determine the pose."""
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    s.motion[:] = lengths
    if solve_square(s.jacobian, s.motion) > RANK_TOLERANCE:
        for part in range(2):
            motion = vector(s.motion[3 * part :])
            moved[part] = np.sqrt(dot(motion, motion))
    else:
        moved[:] = np.inf
