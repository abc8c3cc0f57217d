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

Offset and rate follow an error that comes up more slowly: `rest` is about such an error.
"""

import numpy as np

from controller.estimation.integrity.rest import move_platform
from controller.inverse_kinematics import jacobian_at
from controller.load_feed_forward import friction_at
from controller.rig import elapsed
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array

_FIRST_S, _LAST_S = 0.05, 1.5
"""The least and the greatest time constant with which offset and rate follow [s]."""

STATE = record_dtype(
    following=np.int64,  # whether command and offset are those of the last cycle
    age=np.float64,  # of the motion [s]
    command=(np.float64, LEGS),  # [m/s]
    rate=(np.float64, LEGS),  # commanded, after the lag [m/s]
    offset=(np.float64, LEGS),  # x and the expected length together [m]
    offset_rate=(np.float64, LEGS),  # v [m/s]
    left=(np.float64, LEGS),  # what is left of each length [m]
    moved=(np.float64, 2),  # by how much position [m] and rotation [rad] have moved otherwise
    jacobian=(np.float64, (6, 6)),  # scratch
    motion=(np.float64, 6),  # scratch: of the platform
)
"""The expected lengths, and how the estimate differs from them; zeros before the motion."""


@kernel
def compare_with_commands(
    s: Record, rig: Record, time: Record, follows: bool, lag: float, feed_forward: Record, load: Record, pose: Record,
    reference: Record, commands: Array,
) -> None:  # fmt: skip
    """After the commands of a cycle: compare the estimated lengths with what the commands before have made of them.

    Args:
        s: dtype `STATE`.
        follows: whether the drives follow the commands.
        lag: of a leg behind its command, by drive and bus [s].
        feed_forward, load: dtypes `PARAMETERS` and `STATE` of `load_feed_forward`.
        commands: (6,) [m/s].
    """
    if not follows:
        s.following = 0
        s.moved[:] = 0.0
        return
    if s.following == 0:
        s.following = 1
        s.rate[:] = commands
        s.offset[:] = pose.lengths
        s.offset_rate[:] = s.age = 0.0
    else:
        _compare(s, rig, elapsed(rig, time), lag, feed_forward, load, pose, reference)
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
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    move_platform(s, s.left, s.moved)
