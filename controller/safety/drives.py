"""What was commanded, as a second opinion without any sensor: how the drives' model says that the legs have moved.

An encoderless drive with a command u and a load F moves its leg at `u - droop F`, and friction brakes that. Load, resistance
and friction are known within limits (`DriveSettings`), so the rate lies within an interval [low, high]. A drive that closes a
position loop moves its leg at u whatever it carries, and the interval is that rate alone. For each leg, two
cumulative sums say how far the estimated length l has come beyond that (E. S. Page, Continuous inspection schemes, Biometrika
41, 1954):

    ahead = max(0, ahead + (change of l) - high T),   behind = max(0, behind - (change of l) + low T)

Each is the greatest excess over all windows of time that end now, however long. Beyond the slack, the estimate or the drive is
wrong.
"""

import numpy as np

from controller.safety.causes import Cause, Mode, Request
from controller.safety.stop import handle_cause
from controller.settings import DriveSettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism

PARAMETERS = record_dtype(
    load=np.float64,  # that may be unknown, as a share of the legs' mean load
    droop=(np.float64, 2),  # the least and the greatest [m/s/N]
    friction=np.float64,  # the greatest [N]
    lag=np.float64,  # of a drive behind its command [s]
    slack=np.float64,  # [m]
)
"""What is known of the drives."""

STATE = record_dtype(
    following=np.int64,  # whether lengths and rates are those of the last period
    length=(np.float64, LEGS),  # estimated [m]
    rate=(np.float64, LEGS),  # commanded, after the lag [m/s]
    low=(np.float64, LEGS),  # least rate of a leg in the coming period [m/s]
    high=(np.float64, LEGS),  # and the greatest
    ahead=(np.float64, LEGS),  # how far the estimate has come beyond the greatest rates [m]
    behind=(np.float64, LEGS),  # how far it has stayed behind the least ones [m]
)
"""The interval of each leg's rate, and the cumulative sums; zeros before the motion."""


def drive_parameters(settings: DriveSettings, mechanism: Mechanism, position: bool = False) -> Record:
    """What is known of the drives of a mechanism (dtype `PARAMETERS`); with a `position` loop they hold whatever the load."""
    plant = mechanism.plant_parameters()
    force_constant = 2.0 * np.pi / plant["motor.screw_lead"] * plant["motor.torque_constant"]
    uncompensated = 1.0 + settings.resistance * np.array([-1.0, 1.0]) - plant["drive.compensation"]
    droop = plant["drive.nominal_resistance"] * np.maximum(uncompensated, 0.0) / force_constant**2
    return filled(
        PARAMETERS,
        load=settings.load,
        droop=0.0 * droop if position else droop,
        friction=settings.friction * np.max(plant["friction.coulomb"]),
        lag=plant["drive.current_time_constant"],
        slack=settings.slack,
    )


@kernel
def check_drives(
    p: Record, s: Record, rig: Record, time: Record, command_delay: float, load: Record, pose: Record, reference: Record,
    pid: Record,
) -> int:  # fmt: skip
    """After the commands: close the brakes when a leg's estimate has moved otherwise than its drive was told to.

    Returns the cause of a fault, or `Cause.NONE`. After missed periods and before each motion the sums begin anew.
    """
    d, limit = s.drives, p.drives.slack
    if s.mode != Mode.RUNNING or s.request != Request.ENABLED:
        d.following = 0
        return Cause.NONE.value
    if d.following == 0 or time.missed > 0:
        d.following = 1
        d.rate[:] = pid.command
        d.ahead[:] = d.behind[:] = 0.0
    else:
        add_excess(d, rig, pose)
    expect_rates(p.drives, d, rig, command_delay, load, pid)
    d.length[:] = pose.lengths
    for k in range(rig.legs):
        excess = max(d.ahead[k], d.behind[k])
        if excess > limit:
            handle_cause(p, s, rig, time, reference, pid, Cause.MOVED_OTHERWISE, k, excess, limit)
            return Cause.MOVED_OTHERWISE.value
    return Cause.NONE.value


@kernel
def add_excess(s: Record, rig: Record, pose: Record) -> None:
    """Add to the sums by how much the lengths have changed beyond the interval of the last period."""
    for k in range(rig.legs):
        change = pose.lengths[k] - s.length[k]
        s.ahead[k] = max(0.0, s.ahead[k] + change - s.high[k] * rig.period)
        s.behind[k] = max(0.0, s.behind[k] - change + s.low[k] * rig.period)


@kernel
def expect_rates(p: Record, s: Record, rig: Record, command_delay: float, load: Record, pid: Record) -> None:
    """Write the interval of each leg's rate in the coming period, from its command and load.

    Friction brings a rate nearer to zero, and never beyond.
    """
    follows = rig.period / (rig.period + p.lag + command_delay)
    unknown = 0.0
    for k in range(rig.legs):
        unknown += p.load * abs(load.force[k]) / rig.legs
    friction = p.droop[1] * p.friction
    for k in range(rig.legs):
        s.rate[k] += follows * (pid.command[k] - s.rate[k])
        least, most = load.drive[k] - unknown, load.drive[k] + unknown
        low = s.rate[k] - (p.droop[1] if most > 0.0 else p.droop[0]) * most
        high = s.rate[k] - (p.droop[0] if least > 0.0 else p.droop[1]) * least
        s.low[k] = max(low - friction, 0.0) if low > 0.0 else low
        s.high[k] = min(high + friction, 0.0) if high < 0.0 else high
