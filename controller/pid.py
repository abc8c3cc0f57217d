"""One PID controller per actuator, on the length deviation, with feed-forward; the command is a velocity [m/s].

`u = v_ref + u_ff + Kp e + Ki integral(e) + Kd e'`, e = l_ref - l_is. The derivative is low-passed. Against wind-up the
integral rests while the command is at its limit and the error would drive it further.
"""

from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array


@kernel
def step_pid(
    error: Array, feed_forward: Array, gains: Array, limit: float, period: float, integral: Array, previous: Array,
    derivative: Array, command: Array,
) -> None:  # fmt: skip
    """Write the commands (6,) from the errors (6,) [m] and the feed-forward (6,) [m/s].

    Args:
        gains: proportional, integral, derivative, corner of the derivative's low-pass [rad/s].
        limit: largest command [m/s].
        integral, previous, derivative: (6,) each, the controllers' state.
    """
    smoothing = period * gains[3] / (1.0 + period * gains[3])
    for k in range(LEGS):
        e = error[k]
        derivative[k] += smoothing * ((e - previous[k]) / period - derivative[k])
        previous[k] = e
        wanted = feed_forward[k] + gains[0] * e + gains[1] * integral[k] + gains[2] * derivative[k]
        command[k] = min(max(wanted, -limit), limit)
        if command[k] == wanted or (wanted - command[k]) * e < 0.0:
            integral[k] += period * e
