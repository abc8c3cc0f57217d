"""The pace of a target: whether the legs' limits allow to keep up with it."""

import numpy as np

from controller.inverse_kinematics import leg_lengths
from controller.planning.target import Target
from plant.mechanism import Mechanism

_STEP_S = 0.02
"""Interval over which the legs' rates and accelerations are averaged: the corners of a file's motion do not count [s]."""


def required_stretch(mechanism: Mechanism, target: Target) -> float:
    """By what a target's time must be stretched so that no leg exceeds its velocity or its acceleration; 1 if it does not.

    A target that jumps from pose to pose is met at the legs' own pace, whatever its time: 1, too.
    """
    if target.held:
        return 1.0
    span = float(target.times[-1] - target.times[0])
    step, limits = min(_STEP_S, 0.25 * span), mechanism.require_limits()
    lengths = leg_lengths(mechanism, *target.at(np.arange(target.times[0], target.times[-1] + 0.5 * step, step)))
    velocity = np.abs(np.diff(lengths, axis=0)).max() / step
    acceleration = np.abs(np.diff(lengths, 2, axis=0)).max() / step**2
    return float(max(1.0, velocity / limits.velocity, np.sqrt(acceleration / limits.acceleration)))
