"""The reference that the cycle follows: per actuator, cubic segments in time, evaluated every cycle.

`segments` (6, n, 5) holds for each actuator rows of start time [s], length [m], rate, acceleration and jerk at the start;
unused rows start at infinity. The last segment goes on for ever: a motion is planned for at least as long as it runs.
"""

import numpy as np

from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array

START, LENGTH, RATE, ACCELERATION, JERK = range(5)


@kernel
def evaluate_reference(segments: Array, time: float, index: Array, reference: Array) -> None:
    """Write length, rate and acceleration (6, 3) of each actuator at `time` [s].

    `index` (6,) remembers the segment of each actuator; time must not run backwards between calls.
    """
    for k in range(LEGS):
        i = index[k]
        while i + 1 < segments.shape[1] and segments[k, i + 1, START] <= time:
            i += 1
        index[k] = i
        segment = segments[k, i]
        t = time - segment[START]
        reference[k, 0] = segment[LENGTH] + t * (segment[RATE] + t * (segment[ACCELERATION] / 2.0 + t * segment[JERK] / 6.0))
        reference[k, 1] = segment[RATE] + t * (segment[ACCELERATION] + t * segment[JERK] / 2.0)
        reference[k, 2] = segment[ACCELERATION] + t * segment[JERK]


@kernel
def _sample(segments: Array, period: float, index: Array, samples: Array) -> None:
    for i in range(samples.shape[0]):
        evaluate_reference(segments, i * period, index, samples[i])


def sample_reference(segments: Array, period: float, count: int) -> Array:
    """The reference (count, 6, 3) at the first `count` cycles of `period` [s]: lengths, rates, accelerations."""
    samples = np.empty((count, LEGS, 3))
    _sample(segments, period, np.zeros(LEGS, np.int64), samples)
    return samples
