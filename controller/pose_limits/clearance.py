"""Distances between legs, which are segments, and between a leg and a plate, which is a disc."""

import numpy as np

from plant.compiled import kernel
from plant.vectors import Vector, add, dot, scale, subtract

_PARALLEL = 1e-14
_MOST_STEPS = 60
_SETTLED = 1e-15


@kernel
def segment_distance(first: Vector, to_first: Vector, second: Vector, to_second: Vector) -> float:
    """The distance between two segments, each from a point to another one; neither may be a point (Ericson 2005, 5.1.9)."""
    u, v, w = subtract(to_first, first), subtract(to_second, second), subtract(first, second)
    a, b, c, e, f = dot(u, u), dot(u, v), dot(u, w), dot(v, v), dot(v, w)
    across = a * e - b * b
    s = min(max((b * f - c * e) / across, 0.0), 1.0) if across > _PARALLEL * a * e else 0.0
    t = (b * s + f) / e
    if t < 0.0:
        t, s = 0.0, min(max(-c / a, 0.0), 1.0)
    elif t > 1.0:
        t, s = 1.0, min(max((b - c) / a, 0.0), 1.0)
    apart = subtract(add(w, scale(s, u)), scale(t, v))
    return float(np.sqrt(dot(apart, apart)))


@kernel
def disc_distance(start: Vector, end: Vector, center: Vector, normal: Vector, radius: float) -> float:
    """The distance between a segment and a filled disc across a unit normal.

    The distance from the disc is convex along the segment, so that its slope has one root, or the least is at an end: soonest
    told where it is at the start.
    """
    a, d = subtract(start, center), subtract(end, start)
    height, rise = dot(normal, a), dot(normal, d)
    out, grow = subtract(a, scale(height, normal)), subtract(d, scale(rise, normal))
    p, q, r = dot(out, out), dot(out, grow), dot(grow, grow)
    low, high = 0.0, 1.0
    at_low = _slope(low, height, rise, p, q, r, radius)
    if at_low >= 0.0:
        return float(np.sqrt(_square(low, height, rise, p, q, r, radius)))
    at_high = _slope(high, height, rise, p, q, r, radius)
    if at_high <= 0.0:
        low = high
    else:
        for step in range(_MOST_STEPS):
            # The secant, and every third time the middle, so that the bracket shrinks.
            t = 0.5 * (low + high) if step % 3 == 2 else (low * at_high - high * at_low) / (at_high - at_low)
            value = _slope(t, height, rise, p, q, r, radius)
            if value <= 0.0:
                low, at_low = t, value
            if value >= 0.0:
                high, at_high = t, value
            if high - low < _SETTLED or value == 0.0:
                break
    least = min(_square(low, height, rise, p, q, r, radius), _square(high, height, rise, p, q, r, radius))
    return float(np.sqrt(least))


@kernel
def _square(t: float, height: float, rise: float, p: float, q: float, r: float, radius: float) -> float:
    """The square of the distance at the share t of the segment."""
    beyond = max(np.sqrt(max(p + t * (2.0 * q + t * r), 0.0)) - radius, 0.0)
    z = height + t * rise
    return float(beyond * beyond + z * z)


@kernel
def _slope(t: float, height: float, rise: float, p: float, q: float, r: float, radius: float) -> float:
    """Half the slope of the square."""
    size = np.sqrt(max(p + t * (2.0 * q + t * r), 0.0))
    share = 1.0 - radius / size if size > radius else 0.0
    return float(share * (q + t * r) + (height + t * rise) * rise)
