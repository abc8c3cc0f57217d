"""Drives that close a position loop of their own, around the encoder at their motor. Compiled.

A drive's goal moves at the rate that it is told. Its velocity is that rate, and what a proportional and an integral part add,
so that neither load nor friction moves it off its goal for long: with a motor that follows velocities exactly, an error decays
as `(1 - w t / 2) exp(-w t / 2)`, where w is the bandwidth. Every emulated drive has this loop, and so has the simulated plant.
"""

import numpy as np

from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import Array

BANDWIDTH = 60.0
"""Proportional gain of the loop [1/s], 10 Hz."""

LONGEST_STEP_S = 1e-3
"""The loop is closed at least so often [s]."""

FOLLOWING_WINDOW = 0.005
"""The greatest following error, unless a bus sets another one [m]."""

FOLLOWING_ERROR, ENCODER_LOST = 0x8611, 0x7305
"""CiA 402's codes of a drive that does not follow its goal, and of one whose encoder reads nothing."""

_BEYOND_S = 0.01
"""For how long the following error must be beyond its window [s]."""

_MOST_UNREAD = 10
"""How many samples in a row may lack a reading."""

POSITION_LOOPS = record_dtype(
    active=(np.int64, LEGS),  # whether the drive closes a position loop
    bandwidth=np.float64,  # proportional gain [1/s]
    window=(np.float64, LEGS),  # greatest following error [m]
    place=(np.float64, LEGS),  # what the drive's encoder reads now [m]
    offset=(np.float64, LEGS),  # by how much it read more than the motor's length when it was sampled [m]
    unread=(np.int64, LEGS),  # in how many samples in a row it has read nothing
    goal=(np.float64, LEGS),  # where the drive is to be, as its encoder counts [m]
    integral=(np.float64, LEGS),  # part of the velocity [m/s]
    beyond_for=(np.float64, LEGS),  # for how long the following error has been beyond its window [s]
    velocity=(np.float64, LEGS),  # that the drive makes of it [m/s]
)
"""The position loops of the drives; zeros where there are none."""


def close_loops(loops: Record, active: bool) -> None:
    """Let all drives close position loops, or none."""
    loops["active"], loops["bandwidth"], loops["window"] = active, BANDWIDTH, FOLLOWING_WINDOW


@kernel
def are_closed(loops: Record) -> bool:
    """Whether a drive closes a position loop."""
    closed = 0
    for k in range(LEGS):
        closed += loops.active[k]
    return closed > 0


@kernel
def take_motors(loops: Record, motors: Array) -> None:
    """Take the lengths (6,) at which the motors are now [m]; between its samples an encoder keeps its error."""
    for k in range(LEGS):
        loops.place[k] = motors[k] + loops.offset[k]


@kernel
def take_readings(loops: Record, motors: Array, readings: Array) -> None:
    """Take what the encoders have just read (6,) [m], NaN for nothing, with their motors at lengths (6,) [m]."""
    for k in range(LEGS):
        there = np.isfinite(readings[k])
        loops.unread[k] = 0 if there else loops.unread[k] + 1
        if there:
            loops.offset[k] = readings[k] - motors[k]
    take_motors(loops, motors)


@kernel
def hold_goal(loops: Record, k: int) -> None:
    """Let the goal of a drive that does not follow be where the drive is."""
    loops.goal[k], loops.integral[k], loops.beyond_for[k], loops.velocity[k] = loops.place[k], 0.0, 0.0, 0.0


@kernel
def follow_goal(loops: Record, k: int, rate: float, moving: float, limit: float, period: float) -> float:
    """Move the goal at `rate` [m/s] for a time `moving` within a step of `period` [s].

    Returns the drive's velocity in that step, within the limit [m/s]; `velocity` has it, too.
    """
    error = loops.goal[k] - loops.place[k]
    loops.goal[k] += rate * moving
    wanted = rate * moving / period + loops.bandwidth * error + loops.integral[k]
    velocity = min(max(wanted, -limit), limit)
    if velocity == wanted:
        loops.integral[k] += 0.25 * loops.bandwidth**2 * error * period
    loops.beyond_for[k] = loops.beyond_for[k] + period if abs(error) > loops.window[k] else 0.0
    loops.velocity[k] = velocity
    return float(velocity)


@kernel
def loop_fault(loops: Record, k: int) -> int:
    """The code of the fault that the loop of a drive which follows has found, or 0."""
    if loops.unread[k] > _MOST_UNREAD:
        return ENCODER_LOST
    return FOLLOWING_ERROR if loops.beyond_for[k] > _BEYOND_S else 0
