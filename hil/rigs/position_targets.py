"""Targets of drives that close a position loop of their own, from the commanded velocities."""

from collections.abc import Sequence

import numpy as np

from hil.rigs import Request
from plant.mechanism import LEGS
from plant.pose import Array


class PositionTargets:
    """Integrals of the commanded velocities, one for each drive, that begin where the drive is when it is enabled.

    Each exchange moves the target of a drive that follows by one period at its command, however long ago the last one was. So
    nothing jumps after missed periods or lost answers, and the outer loop makes up for the motion that was missed. The target
    of any other drive is the last position that its encoder has read.

    Args:
        period: of the exchanges [s].
        limit: larger velocities are cut to it [m/s].

    Attributes:
        targets: (6,) [m], as the encoders count; NaN before the first reading.
    """

    def __init__(self, period: float, limit: float) -> None:
        self._period, self._limit = period, limit
        self.targets: Array = np.full(LEGS, np.nan)

    def advance(self, command: Array, request: int, following: Sequence[bool], positions: Array) -> Array:
        """The targets of the next exchange (6,) [m].

        Args:
            command: (6,) velocities [m/s]; NaN is no command.
            request: the `Request` to all drives.
            following: whether each drive has said that it follows its target.
            positions: (6,) that the encoders have read last [m]; NaN for those that have not.
        """
        for drive in range(LEGS):
            if request == Request.ENABLED and following[drive]:
                velocity = float(command[drive])
                if velocity == velocity:
                    self.targets[drive] += min(max(velocity, -self._limit), self._limit) * self._period
            elif positions[drive] == positions[drive]:
                self.targets[drive] = positions[drive]
        return self.targets
