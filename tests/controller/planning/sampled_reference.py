"""A planned reference, cycle by cycle."""

import numpy as np

from controller.planning.segments import evaluate_reference


def sample_reference(segments, period, count):
    """The reference (count, 6, 3) at the first `count` cycles of `period` [s]: lengths, rates, accelerations."""
    samples, index = np.empty((count, 6, 3)), np.zeros(6, np.int64)
    for i in range(count):
        evaluate_reference(segments, i * period, index, samples[i])
    return samples
