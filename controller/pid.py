"""One PID controller per actuator, on the length deviation, with feed-forward; the command is a velocity [m/s].

`u = v_ref + u_ff + Kp e + Ki integral(e) + Kd e'`, e = l_ref - l_is. The derivative is low-passed. Against wind-up, the
integral rests while the command is at its limit and the error would drive it further.

Gains that make the mechanism oscillate can be halved in motion: then Kp and Kd are half, and Ki is a quarter of what it was. So
the loop has half its bandwidth and the same damping.
"""

import numpy as np

from controller.settings import ControlSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array

MOST_HALVINGS = 2
"""So often may the gains be halved."""

PARAMETERS = record_dtype(
    gains=(np.float64, 4),  # Kp [1/s], Ki [1/s^2], Kd [-], and the corner of the derivative's low-pass [rad/s]
    limit=np.float64,  # largest command [m/s]
)
"""The constants of the controllers."""

STATE = record_dtype(
    error=(np.float64, LEGS),  # deviation of the length [m]
    integral=(np.float64, LEGS),  # of the error [m s]
    previous_error=(np.float64, LEGS),
    derivative=(np.float64, LEGS),  # of the error, low-passed [m/s]
    command=(np.float64, LEGS),  # [m/s]
    halvings=np.int64,  # how often the gains have been halved, at most `MOST_HALVINGS`
)
"""The state of each controller."""


def pid_parameters(control: ControlSettings, velocity: float) -> Record:
    """The constants of the controllers (dtype `PARAMETERS`); `velocity` is the actuators' limit [m/s]."""
    gains = control.proportional, control.integral, control.derivative, control.derivative_bandwidth
    return filled(PARAMETERS, gains=gains, limit=control.command_reserve * velocity)


@kernel
def step_pid(p: Record, s: Record, feed_forward: Array, period: float) -> None:
    """Write the commands from the errors and the feed-forward (6,) [m/s], over one period [s]."""
    gains = p.gains
    share = 0.5**s.halvings
    smoothing = period * gains[3] / (1.0 + period * gains[3])
    for k in range(LEGS):
        e = s.error[k]
        s.derivative[k] += smoothing * ((e - s.previous_error[k]) / period - s.derivative[k])
        s.previous_error[k] = e
        wanted = feed_forward[k] + share * (gains[0] * e + share * gains[1] * s.integral[k] + gains[2] * s.derivative[k])
        s.command[k] = min(max(wanted, -p.limit), p.limit)
        if s.command[k] == wanted or (wanted - s.command[k]) * e < 0.0:
            s.integral[k] += period * e


@kernel
def halve_gains(s: Record) -> None:
    """Halve the gains from the next command on; what the integral adds to it stays the same."""
    s.halvings += 1
    s.integral[:] *= 4.0


@kernel
def hold_still(s: Record, legs: int) -> None:
    """No commands, before the motion; the derivative will begin from the present error."""
    for k in range(legs):
        s.command[k] = 0.0
        s.previous_error[k] = s.error[k]
