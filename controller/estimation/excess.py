"""How much a sensor shows that its filter does not explain: the excess of squared innovations over what noise explains.

A filter that adds the excess to its measurement noise weighs the sensor by what it sees. Without an excess, its noise is that
of the settings.
"""

from plant.compiled import kernel

INNOVATION_LIMIT = 3.0
"""Noise explains innovations of up to so many standard deviations."""

MEMORY_S = 4.0
"""Time in which an excess fades to the share 1/e."""


@kernel
def faded_excess(excess: float, squared: float, variance: float, period: float, memory: float = MEMORY_S) -> float:
    """The excess after another innovation.

    A new excess counts at once and in full, before it can bend the filter. It fades exponentially towards less than zero, so
    that it ends. What noise explains has none.

    Args:
        excess: so far, at least zero.
        squared: square of the innovation.
        variance: of the innovation by what is explained.
        period: since the innovation before [s].
        memory: time in which the excess fades to the share 1/e [s].
    """
    faded = excess - min(1.0, period / memory) * (excess + variance)
    return float(max(0.0, faded, squared - INNOVATION_LIMIT**2 * variance))
