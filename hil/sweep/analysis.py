"""What a sweep's table says: quantiles with their confidence."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom

QUANTILES = (0.5, 0.9, 0.99)
CONFIDENCE = 0.95


@dataclass(frozen=True)
class Quantile:
    """A quantile of a figure, and the interval that holds it with `CONFIDENCE`; an end is infinite with too few runs."""

    share: float
    value: float
    low: float
    high: float


def quantile(values: ArrayLike, share: float) -> Quantile:
    """A quantile (0 to 1) of independent values (N,), with the interval between two of the ordered values.

    The interval needs no assumption on the distribution: the number of values below the quantile is binomial.
    """
    ordered = np.sort(np.asarray(values, np.float64))
    n, tail = len(ordered), (1.0 - CONFIDENCE) / 2.0
    padded = np.concatenate([[-np.inf], ordered, [np.inf]])
    low, high = binom.ppf([tail, 1.0 - tail], n, share)
    return Quantile(share, float(np.quantile(ordered, share)), float(padded[int(low)]), float(padded[int(high) + 1]))
