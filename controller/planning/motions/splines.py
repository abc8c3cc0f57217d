"""Curves through samples whose third derivative is constant by intervals, as the segments of the reference have it.

A curve is an array (m, n, 5) of m values over a parameter, which is time or goes along a way: for each of them rows of
parameter, value, and first to third derivative at the start of an interval, as in `controller.planning.segments`. The last row
is the end.
"""

import numpy as np

from controller.planning.segments import ACCELERATION, JERK, LENGTH, RATE, START, segment_extrema, state_after, write_segment
from plant.compiled import kernel
from plant.pose import Array


def spline_at_rest(knots: Array, values: Array) -> Array:
    """The cubic spline through values (n, m) at increasing knots (n,), n at least 3, that begins and ends at rest.

    First and second derivative vanish at both ends. Two conditions more than a clamped spline has need two knots more: one in
    the middle of the first interval, and one in the middle of the last. So the curve has n + 2 rows.
    """
    steps = np.diff(knots)
    curve = np.zeros((values.shape[1], len(knots) + 2, 5))
    inner = np.concatenate([knots[:1], [knots[0] + 0.5 * steps[0]], knots[1:-1], [knots[-1] - 0.5 * steps[-1]], knots[-1:]])
    _fit(inner, np.ascontiguousarray(values.T), True, curve)
    return curve


def natural_spline(knots: Array, values: Array) -> Array:
    """The cubic spline through values (n, m) at increasing knots (n,), n at least 3; second derivatives are 0 at its ends."""
    curve = np.zeros((values.shape[1], len(knots), 5))
    _fit(np.ascontiguousarray(knots), np.ascontiguousarray(values.T), False, curve)
    return curve


def quintic_spline(knots: Array, values: Array, rates: Array) -> Array:
    """Values (n, m), rates (n, m) and the second derivatives (n, m) with which quintics between the knots (n,) join.

    The third derivative is continuous, too; the curve begins and ends with second derivatives of 0.

    Returns:
        The second derivatives (n, m).
    """
    h, count = np.diff(knots)[:, None], len(knots)
    second = np.zeros_like(values)
    if count > 2:
        # The third derivative at a knot from the left is that from the right.
        left = 60.0 * np.diff(values, axis=0) / h**3 - (24.0 * rates[:-1] + 36.0 * rates[1:]) / h**2
        right = 60.0 * np.diff(values, axis=0) / h**3 - (36.0 * rates[:-1] + 24.0 * rates[1:]) / h**2
        matrix = np.zeros((count - 2, count))
        rows = np.arange(count - 2)
        matrix[rows, rows], matrix[rows, rows + 2] = -3.0 / h[:-1, 0], -3.0 / h[1:, 0]
        matrix[rows, rows + 1] = 9.0 / h[:-1, 0] + 9.0 / h[1:, 0]
        second[1:-1] = np.linalg.solve(matrix[:, 1:-1], right[1:] - left[:-1])
    return second


def quintic_values(knots: Array, values: Array, rates: Array, second: Array, at: Array) -> Array:
    """Values (q, m) at parameters (q,) of the quintics between the knots (n,), with their derivatives (n, m) there."""
    i = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    h = np.diff(knots)[i][:, None]
    t = (at - knots[i])[:, None] / h
    rise = values[i + 1] - values[i]
    v0, v1, a0, a1 = h * rates[i], h * rates[i + 1], 0.5 * h * h * second[i], 0.5 * h * h * second[i + 1]
    c3 = 10.0 * rise - 6.0 * v0 - 4.0 * v1 - 3.0 * a0 + a1
    c4 = -15.0 * rise + 8.0 * v0 + 7.0 * v1 + 3.0 * a0 - 2.0 * a1
    c5 = 6.0 * rise - 3.0 * (v0 + v1) - a0 + a1
    found: Array = values[i] + t * (v0 + t * (a0 + t * (c3 + t * (c4 + t * c5))))
    return found


def curve_at(curve: Array, at: Array) -> Array:
    """Value and first to third derivative (4, q, m) of a curve (m, n, 5) at parameters (q,); beyond its ends, the end holds."""
    knots = curve[0, :, START]
    at = np.clip(at, knots[0], knots[-1])
    row = np.clip(np.searchsorted(knots, at, side="right") - 1, 0, len(knots) - 2)
    pieces = curve[:, row]
    t, (p, v, a, j) = at - pieces[:, :, START], (pieces[:, :, k] for k in (LENGTH, RATE, ACCELERATION, JERK))
    found: Array = np.stack(
        [p + t * (v + t * (a / 2.0 + t * j / 6.0)), v + t * (a + t * j / 2.0), a + t * j, j + 0.0 * t]
    ).transpose(0, 2, 1)
    return found


def stretched(curve: Array, factor: float) -> Array:
    """A curve over time (m, n, 5), `factor` times as slow."""
    slower: Array = curve * np.array([factor, 1.0, 1.0 / factor, factor**-2, factor**-3])
    return slower


@kernel
def extrema_of(curve: Array, extrema: Array, places: Array) -> None:
    """Write least and greatest value, and greatest size of first to third derivative (m, 5) of a curve (m, n, 5), and the
    starts of the intervals (m, 5) that have them.
    """
    for k in range(curve.shape[0]):
        extrema[k, 0], extrema[k, 1] = np.inf, -np.inf
        extrema[k, 2:] = 0.0
        for i in range(curve.shape[1] - 1):
            piece = curve[k, i]
            t = curve[k, i + 1, START] - piece[START]
            state, jerk = (piece[LENGTH], piece[RATE], piece[ACCELERATION]), piece[JERK]
            least, greatest, rate = segment_extrema(state, jerk, t)
            acceleration = max(abs(state[2]), abs(state_after(state, jerk, t)[2]))
            if least < extrema[k, 0]:
                extrema[k, 0], places[k, 0] = least, piece[START]
            for q, size in ((1, greatest), (2, rate), (3, acceleration), (4, abs(jerk))):
                if size > extrema[k, q]:
                    extrema[k, q], places[k, q] = size, piece[START]


@kernel
def _fit(knots: Array, values: Array, at_rest: bool, curve: Array) -> None:
    """Write the cubic spline (m, N, 5) over knots (N,). At rest, the second knot and the last but one have no value in
    `values` (m, n): n = N - 2 there, else n = N.
    """
    size = knots.shape[0]
    lower, diagonal, upper, right = np.zeros(size), np.ones(size), np.zeros(size), np.zeros(size)
    y = np.zeros(size)
    for k in range(values.shape[0]):
        if at_rest:
            y[0], y[size - 1] = values[k, 0], values[k, -1]
            y[2 : size - 2] = values[k, 1:-1]
            y[1], y[size - 2] = y[0], y[size - 1]
        else:
            y[:] = values[k]
        # The continuity of the slope at each inner knot gives its second derivative.
        for i in range(1, size - 1):
            before, after = knots[i] - knots[i - 1], knots[i + 1] - knots[i]
            lower[i], diagonal[i], upper[i] = before, 2.0 * (before + after), after
            right[i] = 6.0 * ((y[i + 1] - y[i]) / after - (y[i] - y[i - 1]) / before)
        if at_rest:
            # From rest, the value at the knot without one is h^2 / 6 times the second derivative there above the end's.
            for end, step in ((1, 1), (size - 2, -1)):
                outer, inner = abs(knots[end] - knots[end - step]), abs(knots[end + step] - knots[end])
                diagonal[end] += outer * outer / inner + outer
                if step == 1:
                    lower[2] -= outer * outer / inner
                else:
                    upper[size - 3] -= outer * outer / inner
        lower[0] = upper[0] = right[0] = lower[size - 1] = upper[size - 1] = right[size - 1] = 0.0
        diagonal[0] = diagonal[size - 1] = 1.0
        # Elimination from above: rows are dominated by their diagonals.
        for i in range(1, size):
            factor = lower[i] / diagonal[i - 1]
            diagonal[i] -= factor * upper[i - 1]
            right[i] -= factor * right[i - 1]
        right[size - 1] /= diagonal[size - 1]
        for i in range(size - 2, -1, -1):
            right[i] = (right[i] - upper[i] * right[i + 1]) / diagonal[i]
        if at_rest:
            y[1] += right[1] * (knots[1] - knots[0]) ** 2 / 6.0
            y[size - 2] += right[size - 2] * (knots[size - 1] - knots[size - 2]) ** 2 / 6.0
        for i in range(size - 1):
            h = knots[i + 1] - knots[i]
            rate = (y[i + 1] - y[i]) / h - h * (2.0 * right[i] + right[i + 1]) / 6.0
            write_segment(curve[k, i], knots[i], (y[i], rate, right[i]), (right[i + 1] - right[i]) / h)
        h, last = knots[size - 1] - knots[size - 2], curve[k, size - 2]
        state = state_after((last[LENGTH], last[RATE], last[ACCELERATION]), last[JERK], h)
        if at_rest:
            state = (y[size - 1], 0.0, 0.0)
        write_segment(curve[k, size - 1], knots[size - 1], state, 0.0)
