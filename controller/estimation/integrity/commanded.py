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

Wind and friction do so as well. But they move the platform, and the gyroscopes see that. So the same is done with the rates of
the legs that the gyroscopes show: the planned ones, and those of the twist beyond them that fits all gyroscopes, as `parity`
has it. What is in both, with m_c and m_g the motions of the position,

    both = max(0, m_c . m_g) / max(|m_c|, |m_g|),

is no motion of the platform. The estimate moves although it does not, as when accelerometers share an error.

Offset and rate follow an error that comes up more slowly: `rest` is about such an error.
"""

import numpy as np

from controller.estimation.integrity.rest import COMMANDS, GYROSCOPES, WAYS, move_platform
from controller.inverse_kinematics import jacobian_at
from controller.load_feed_forward import friction_at
from controller.rig import elapsed
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, vector

_FIRST_S, _LAST_S = 0.05, 1.5
"""The least and the greatest time constant with which offset and rate follow [s]."""

_LEAST_M = 5e-4
"""If the position has moved less otherwise than commanded, no time is spent on what the gyroscopes show."""

STATE = record_dtype(
    following=np.int64,  # whether command and offset are those of the last cycle
    source=np.int64,  # what the pose comes from
    age=(np.float64, WAYS),  # of what is known, by commands and by gyroscopes [s]
    command=(np.float64, LEGS),  # [m/s]
    rate=(np.float64, LEGS),  # commanded, after the lag [m/s]
    offset=(np.float64, (WAYS, LEGS)),  # x and the expected length together [m]
    offset_rate=(np.float64, (WAYS, LEGS)),  # v [m/s]
    left=(np.float64, (WAYS, LEGS)),  # what is left of each length [m]
    moved=(np.float64, 2),  # by how much position [m] and rotation [rad] have moved otherwise than commanded
    both=np.float64,  # by how much the position has moved otherwise than both show [m]; 0 if that is little
    jacobian=(np.float64, (6, 6)),  # from here on scratch
    motion=(np.float64, 6),  # of the platform
    shift=(np.float64, 3),  # of the position, by commands
    turned=(np.float64, 2),  # by how much position and rotation have moved otherwise than the gyroscopes show
)
"""The expected lengths, and how the estimate differs from them; zeros before the motion."""


@kernel
def compare_with_commands(
    s: Record, rig: Record, time: Record, follows: bool, lag: float, feed_forward: Record, load: Record, pose: Record,
    reference: Record, commands: Array, twist: Array, source: int,
) -> None:  # fmt: skip
    """After the commands of a cycle: compare the estimated lengths with what the commands before have made of them, and with
    what the gyroscopes show.

    Args:
        s: dtype `STATE`.
        follows: whether the drives follow the commands.
        lag: of a leg behind its command, by drive and bus [s].
        feed_forward, load: dtypes `PARAMETERS` and `STATE` of `load_feed_forward`.
        commands: (6,) [m/s].
        twist: (6,), of the platform beyond the planned one, that fits all gyroscopes [m/s, rad/s].
        source: a number for what the pose comes from: IMUs and filter. If it changes, the pose is corrected, which no gyroscope
            shows.
    """
    if not follows:
        s.following = 0
        s.moved[:] = s.both = 0.0
        return
    if s.following == 0:
        s.following = 1
        s.rate[:] = commands
        _begin(s, COMMANDS, pose.lengths)
        _begin(s, GYROSCOPES, pose.lengths)
    else:
        if source != s.source:
            _begin(s, GYROSCOPES, pose.lengths)
        _compare(s, rig, elapsed(rig, time), lag, feed_forward, load, pose, reference, twist)
    s.source = source
    s.command[:] = commands


@kernel
def _begin(s: Record, way: int, lengths: Array) -> None:
    s.offset[way] = lengths
    s.offset_rate[way] = s.age[way] = s.both = 0.0


@kernel
def _compare(
    s: Record, rig: Record, duration: float, lag: float, feed_forward: Record, load: Record, pose: Record, reference: Record,
    twist: Array,
) -> None:  # fmt: skip
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    for way in range(WAYS):
        s.age[way] += duration
        share = min(1.0, duration / min(max(0.5 * s.age[way], _FIRST_S), _LAST_S))
        for k in range(rig.legs):
            if way == COMMANDS:
                s.rate[k] += duration / (duration + lag) * (s.command[k] - s.rate[k])
                braked = load.drive[k] + friction_at(feed_forward, k, reference.motion[k, 1])
                rate = s.rate[k] - feed_forward.droop * braked
            else:
                rate = reference.motion[k, 1]
                for i in range(twist.shape[0]):
                    rate += s.jacobian[k, i] * twist[i]
            s.offset[way, k] += duration * (rate + s.offset_rate[way, k])
            s.left[way, k] = left = pose.lengths[k] - s.offset[way, k]
            s.offset[way, k] += share * (2.0 - share) * left
            s.offset_rate[way, k] += 1.5 * share**2 / duration * left
    move_platform(s, s.left[COMMANDS], s.moved)
    s.both = 0.0
    if not _LEAST_M < s.moved[0] < np.inf:
        return
    s.shift[:] = s.motion[:3]
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    move_platform(s, s.left[GYROSCOPES], s.turned)
    most, along = max(s.moved[0], s.turned[0]), dot(vector(s.shift), vector(s.motion))
    s.both = along / most if along > 0.0 and most < np.inf else 0.0
