"""The test: how often it speaks without a fault, and how large a fault must be for it to speak almost always."""

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, ncx2, norm

from plant.pose import Array

FALSE_ALARM_HOURS = 100.0
EVALUATIONS_HZ = 10.0
POWER = 0.999

RAISED = 0.01
"""With what probability a protection level may be beyond the size in question at any time, without a fault."""

HYPOTHESES = 65
"""Over which the false alarms are shared: of each IMU its gyroscope, its accelerometer, both, and its mounting (28); pairs of
IMUs (21); all gyroscopes, all accelerometers, a base that turns, a base that is accelerated (4); the joints (12).
"""


def threshold(dimensions: int, hypotheses: int = HYPOTHESES) -> float:
    """The value of the statistic from which on a fault in so many unknown directions is told.

    Without a fault the statistic is chi-squared distributed. Bonferroni: the false alarms of all evaluations of all hypotheses
    in `FALSE_ALARM_HOURS` add up to one.
    """
    evaluations = FALSE_ALARM_HOURS * 3600.0 * EVALUATIONS_HZ
    return float(chi2.isf(1.0 / (evaluations * hypotheses), dimensions))


def needed_noncentrality(dimensions: int, hypotheses: int = HYPOTHESES) -> float:
    """The least noncentrality with which the statistic reaches the threshold with the probability `POWER`."""
    least = threshold(dimensions, hypotheses)
    return float(brentq(lambda size: ncx2.sf(least, dimensions, size) - POWER, least, 10.0 * least + 100.0, xtol=1e-9))


def probability_of_silence(noncentrality: Array) -> Array:
    """How often a test is silent that knows what the fault is, and without one speaks with the probability `RAISED`.

    By Neyman and Pearson no such test is silent less often.

    Args:
        noncentrality: of the fault, any shape.
    """
    silence: Array = norm.cdf(norm.isf(RAISED) - np.sqrt(noncentrality))
    return silence
