"""Calls of ruckig, and what is read from its trajectories."""

from collections.abc import Sequence

import numpy as np
from ruckig import InputParameter, Result, Ruckig, RuckigError, Trajectory

from plant.pose import Array


def calculate(otg: Ruckig, parameters: InputParameter, state: Sequence[list[float]], trajectory: Trajectory) -> bool:
    """Let ruckig plan from a state, lengths, rates and accelerations (legs,) each; returns whether there is a plan."""
    parameters.current_position, parameters.current_velocity, parameters.current_acceleration = state
    try:
        return otg.calculate(parameters, trajectory) in (Result.Working, Result.Finished)
    except (RuckigError, ValueError):
        # ValueError: a result code of ruckig that its own binding does not know.
        return False


def phases_of(trajectory: Trajectory) -> Array:
    """Durations and jerks (legs, 2, 9) of a plan of ruckig."""
    return np.array([((*each.brake.t, *each.t), (*each.brake.j, *each.j)) for each in trajectory.profiles[0]])
