"""Small dense systems for the cycle: pivoted Householder QR, elimination, and Cholesky for weighted normal equations.

The closed forms use QR, because their normal equations would lose half the digits. The refinement's are well scaled.
"""

from collections.abc import Callable

import numpy as np

from plant.compiled import kernel
from plant.pose import Array
from plant.vectors import Vector, dot

RANK_TOLERANCE = 1e-9  # ratio of the least to the greatest diagonal element of R, below which columns count as dependent
_SQUARE = 1e-16  # share of its neighbours below which an element beside the diagonal is zero
_MOST_SWEEPS = 30
_LEAST_PIVOT = 1e-13  # of a symmetric matrix, over the element of its diagonal from which elimination leaves it


WELL_CONDITIONED = 0.05
"""Ratio of the last to the first pivot from which on normal equations serve: they lose twice as many digits as QR, but here no
more than rounding times the square of this ratio's inverse, 1e-13."""

Symmetric = tuple[float, float, float, float, float, float]
"""The lower triangle of a symmetric matrix (3, 3), row by row."""


@kernel
def solve_least_squares(matrix: Array, right: Array, rows: int, solution: Array, norms: Array, order: Array) -> float:
    """Minimise |matrix @ solution - right| by QR with column pivoting: `solve_truncated` with as many pivots as unknowns.

    The ratio that it returns estimates the reciprocal condition number.
    """
    return solve_truncated(matrix, right, rows, solution.shape[0], solution, matrix[:0], norms, order)


@kernel
def solve_truncated(
    matrix: Array, right: Array, rows: int, rank: int, solution: Array, null_space: Array, norms: Array, order: Array
) -> float:
    """Solve a system of known rank: after `rank` pivots, the rest of the rows counts as noise.

    Args:
        matrix, right: (>= rows, >= n), of which the corner counts, contiguous, and (>= rows,); overwritten.
        rows: at least `rank`.
        rank: of the system without noise, at most n.
        solution: (n,), one solution, written.
        null_space: (>= n - rank, n), written; any multiples of its rows may be added to the solution.
        norms, order: (>= n,) scratch.

    Returns:
        The ratio of the last to the first pivot; below `RANK_TOLERANCE` nothing is solved.
    """
    n = solution.shape[0]
    conditioning = _triangularise(matrix, right, rows, rank, solution, norms, order)
    if conditioning < RANK_TOLERANCE:
        return conditioning
    _substitute_back(matrix, right, rank)
    for k in range(n):
        solution[int(order[k])] = right[k] if k < rank else 0.0
    for free in range(rank, n):
        for k in range(rank):
            norms[k] = -matrix[k, free]
        _substitute_back(matrix, norms, rank)
        row = null_space[free - rank]
        for k in range(n):
            row[int(order[k])] = norms[k] if k < rank else 0.0
        row[int(order[free])] = 1.0
    return conditioning


def _symmetric_solver(n: int) -> Callable[[Array, int, Array, Array, Array, Array], float]:
    """`solve_five` and `solve_nine`: with a constant size, the compiler unrolls the loops over columns."""

    @kernel
    def substitute_back(matrix: Array, rank: int, column: int, sign: float, order: Array, solution: Array) -> None:
        """Solve the triangle for one of the columns times `sign`; unknowns that were not chosen are 0."""
        for j in range(n):
            solution[j] = 0.0
        for k in range(rank - 1, -1, -1):
            value = sign * matrix[n + k, column]
            for j in range(k + 1, rank):
                chosen = int(order[j])
                value -= matrix[n + k, chosen] * solution[chosen]
            solution[int(order[k])] = value * matrix[n + k, n + 1]

    @kernel
    def solve_symmetric(matrix: Array, rank: int, solution: Array, null_space: Array, pivots: Array, order: Array) -> float:
        """`solve_truncated` from normal equations, by Cholesky's factors with the same pivots, where it is `WELL_CONDITIONED`.

        Args:
            matrix: (>= 2 n, >= n + 2); its first n rows are the normal equations, their right side in column n. Overwritten.
            rank, solution, null_space: as there, with n unknowns.
            pivots, order: (>= n,) scratch.

        Returns:
            The ratio of the last to the first pivot of the QR; 0 if it is too small, and nothing is solved.
        """
        for j in range(n):
            pivots[j], order[j] = matrix[j, j], j
        first = ratio = 1.0
        for k in range(rank):
            best, greatest = 0, pivots[0]
            for j in range(1, n):
                greater = pivots[j] > greatest
                best, greatest = j if greater else best, pivots[j] if greater else greatest
            if k == 0:
                first = greatest
            # Neither is what is not a number: then the first column may be the best again, and is in no place.
            if not greatest >= WELL_CONDITIONED**2 * first or not greatest > 0.0:
                return 0.0
            ratio = greatest / first
            place = k
            while int(order[place]) != best:
                place += 1
            order[k], order[place] = order[place], order[k]
            row = n + k
            for j in range(n + 1):
                matrix[row, j] = matrix[best, j]
            for above in range(n, row):
                factor = matrix[above, best] * matrix[above, n + 1]
                for j in range(n + 1):
                    matrix[row, j] -= factor * matrix[above, j]
            inverse = 1.0 / matrix[row, best]
            matrix[row, n + 1] = inverse
            for j in range(n):
                pivots[j] -= matrix[row, j] * matrix[row, j] * inverse
            pivots[best] = -np.inf  # once chosen
        substitute_back(matrix, rank, n, 1.0, order, solution)
        for k in range(rank, n):
            free = int(order[k])
            substitute_back(matrix, rank, free, -1.0, order, null_space[k - rank])
            null_space[k - rank, free] = 1.0
        return float(np.sqrt(ratio))

    return solve_symmetric


solve_five, solve_nine = _symmetric_solver(5), _symmetric_solver(9)


@kernel
def _triangularise(matrix: Array, right: Array, m: int, rank: int, dots: Array, norms: Array, order: Array) -> float:
    """Turn the corner (m, n) of `matrix` into R by `rank` pivots, and transform `right` with it; n is the size of `dots`, which
    is scratch. Returns the ratio of the last to the first pivot.
    """
    n = dots.shape[0]
    for j in range(n):
        order[j] = j
        norms[j] = 0.0
    for i in range(m):
        for j in range(n):
            norms[j] += matrix[i, j] * matrix[i, j]
    for k in range(rank):
        best = k
        for j in range(k + 1, n):
            if norms[j] > norms[best]:
                best = j
        if best != k:
            norms[best] = norms[k]
            order[k], order[best] = order[best], order[k]
            for i in range(m):
                matrix[i, k], matrix[i, best] = matrix[i, best], matrix[i, k]
        tail = 0.0
        for i in range(k, m):
            tail += matrix[i, k] * matrix[i, k]
        alpha = np.sqrt(tail)
        if not alpha > RANK_TOLERANCE * abs(matrix[0, 0]):
            return 0.0
        if matrix[k, k] > 0.0:
            alpha = -alpha
        # The Householder vector is stored below the diagonal, its leading element in `lead`.
        lead = matrix[k, k] - alpha
        scale = 1.0 / (alpha * lead)
        dot = lead * right[k]
        for j in range(k + 1, n):
            dots[j] = lead * matrix[k, j]
        for i in range(k + 1, m):
            element = matrix[i, k]
            dot += element * right[i]
            for j in range(k + 1, n):
                dots[j] += element * matrix[i, j]
        dot *= scale
        right[k] += dot * lead
        for j in range(k + 1, n):
            dots[j] *= scale
            matrix[k, j] += dots[j] * lead
            norms[j] -= matrix[k, j] * matrix[k, j]
        for i in range(k + 1, m):
            element = matrix[i, k]
            right[i] += dot * element
            for j in range(k + 1, n):
                matrix[i, j] += dots[j] * element
        matrix[k, k] = alpha
    return float(abs(matrix[rank - 1, rank - 1] / matrix[0, 0]))


@kernel
def _substitute_back(matrix: Array, right: Array, rank: int) -> None:
    """Replace the first `rank` elements of `right` by the solution of R's leading triangle."""
    for k in range(rank - 1, -1, -1):
        value = right[k]
        for j in range(k + 1, rank):
            value -= matrix[k, j] * right[j]
        right[k] = value / matrix[k, k]


@kernel
def _bring_up_pivot(matrix: Array, k: int, n: int) -> int:
    """Exchange row `k` of the corner (n, n) of `matrix` for that with the greatest pivot from there on; returns its number."""
    best = k
    for i in range(k + 1, n):
        if abs(matrix[i, k]) > abs(matrix[best, k]):
            best = i
    if best != k:
        for j in range(k, n):
            matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
    return best


@kernel
def solve_square(matrix: Array, right: Array) -> float:
    """Replace `right` (n,) by the solution of `matrix` (n, n) @ x = right, by elimination with row pivots; overwrites `matrix`.

    Returns:
        The ratio of the least to the greatest pivot; below `RANK_TOLERANCE` nothing is solved.
    """
    n = right.shape[0]
    least, greatest = np.inf, 0.0
    for k in range(n):
        best = _bring_up_pivot(matrix, k, n)
        if best != k:
            right[k], right[best] = right[best], right[k]
        pivot = abs(matrix[k, k])
        if not pivot > RANK_TOLERANCE * greatest:
            return 0.0
        least, greatest = min(least, pivot), max(greatest, pivot)
        if least <= RANK_TOLERANCE * greatest:
            return 0.0
        inverse = 1.0 / matrix[k, k]
        for i in range(k + 1, n):
            factor = matrix[i, k] * inverse
            right[i] -= factor * right[k]
            for j in range(k + 1, n):
                matrix[i, j] -= factor * matrix[k, j]
    _substitute_back(matrix, right, n)
    return least / greatest


@kernel
def factor_cholesky(matrix: Array) -> bool:
    """Replace a symmetric matrix's lower triangle by its Cholesky factor; False if not positive definite beyond rounding."""
    n = matrix.shape[0]
    for j in range(n):
        before = matrix[j, j]
        for k in range(j):
            factor = matrix[j, k]
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * factor
        if not matrix[j, j] > _LEAST_PIVOT * before:
            return False
        pivot = np.sqrt(matrix[j, j])
        matrix[j, j] = pivot
        inverse = 1.0 / pivot
        for i in range(j + 1, n):
            matrix[i, j] *= inverse
    return True


@kernel
def invert_cholesky(factor: Array, inverse: Array) -> None:
    """Write the inverse (n, n) of the matrix whose Cholesky factor is the lower triangle of `factor`, which is overwritten."""
    n = factor.shape[0]
    for j in range(n):
        factor[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * factor[k, j]
            factor[i, j] = value / factor[i, i]
    for i in range(n):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, n):
                value += factor[k, i] * factor[k, j]
            inverse[i, j] = value
            inverse[j, i] = value


@kernel
def solve_cholesky(factor: Array, right: Array) -> None:
    """Replace `right` (n,) by the solution of the system whose Cholesky factor is the lower triangle of `factor`."""
    n = factor.shape[0]
    for i in range(n):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * right[k]
        right[i] = value / factor[i, i]
    for i in range(n - 1, -1, -1):
        value = right[i]
        for k in range(i + 1, n):
            value -= factor[k, i] * right[k]
        right[i] = value / factor[i, i]


@kernel
def invert_symmetric(matrix: Array, inverse: Array) -> bool:
    """Write the inverse of a symmetric matrix (6, 6), of which the lower triangle is read; False if it is not positive definite
    beyond rounding, as `factor_cholesky`.

    By blocks of three and in scalars, without a root: with the upper block L D L^T, rows Y of `L^-1` times the block beside it,
    and the inverse X of what is left of the lower block, S = lower - Y^T D^-1 Y. Several times as fast as `invert_cholesky`.
    """
    fit, triangle, pivots = _factor_three(
        (matrix[0, 0], matrix[1, 0], matrix[1, 1], matrix[2, 0], matrix[2, 1], matrix[2, 2]),
        (matrix[0, 0], matrix[1, 1], matrix[2, 2]),
    )
    y0, w0, g0 = _eliminate(triangle, pivots, (matrix[3, 0], matrix[3, 1], matrix[3, 2]))
    y1, w1, g1 = _eliminate(triangle, pivots, (matrix[4, 0], matrix[4, 1], matrix[4, 2]))
    y2, w2, g2 = _eliminate(triangle, pivots, (matrix[5, 0], matrix[5, 1], matrix[5, 2]))
    n00, n10, n11, n20, n21, n22 = _inverse_of_three(triangle, pivots)
    fit_below, triangle, pivots = _factor_three(
        (
            matrix[3, 3] - dot(w0, y0), matrix[4, 3] - dot(w1, y0), matrix[4, 4] - dot(w1, y1),
            matrix[5, 3] - dot(w2, y0), matrix[5, 4] - dot(w2, y1), matrix[5, 5] - dot(w2, y2),
        ),
        (matrix[3, 3], matrix[4, 4], matrix[5, 5]),
    )  # fmt: skip
    if not (fit and fit_below):
        return False
    x00, x10, x11, x20, x21, x22 = _inverse_of_three(triangle, pivots)
    h0 = _combine(-x00, g0, -x10, g1, -x20, g2)
    h1 = _combine(-x10, g0, -x11, g1, -x21, g2)
    h2 = _combine(-x20, g0, -x21, g1, -x22, g2)
    t00, t10, t20 = _combine(g0[0], h0, g1[0], h1, g2[0], h2)
    _, t11, t21 = _combine(g0[1], h0, g1[1], h1, g2[1], h2)
    t22 = g0[2] * h0[2] + g1[2] * h1[2] + g2[2] * h2[2]
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = n00 - t00, n10 - t10, n20 - t20
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = n10 - t10, n11 - t11, n21 - t21
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = n20 - t20, n21 - t21, n22 - t22
    inverse[3, 0], inverse[3, 1], inverse[3, 2] = h0
    inverse[4, 0], inverse[4, 1], inverse[4, 2] = h1
    inverse[5, 0], inverse[5, 1], inverse[5, 2] = h2
    inverse[0, 3], inverse[1, 3], inverse[2, 3] = h0
    inverse[0, 4], inverse[1, 4], inverse[2, 4] = h1
    inverse[0, 5], inverse[1, 5], inverse[2, 5] = h2
    inverse[3, 3], inverse[3, 4], inverse[3, 5] = x00, x10, x20
    inverse[4, 3], inverse[4, 4], inverse[4, 5] = x10, x11, x21
    inverse[5, 3], inverse[5, 4], inverse[5, 5] = x20, x21, x22
    return True


@kernel
def _factor_three(matrix: Symmetric, before: Vector) -> tuple[bool, Vector, Vector]:
    """L D L^T of a symmetric matrix: whether its pivots are more than the rounding of the diagonal `before` elimination, the
    elements 10, 20 and 21 of L, and the inverses of D.
    """
    d0, s10, s11, s20, s21, s22 = matrix
    i0 = 1.0 / d0
    l10, l20 = s10 * i0, s20 * i0
    d1, u21 = s11 - l10 * s10, s21 - l10 * s20
    i1 = 1.0 / d1
    l21 = u21 * i1
    d2 = s22 - l20 * s20 - l21 * u21
    fit = d0 > _LEAST_PIVOT * before[0] and d1 > _LEAST_PIVOT * before[1] and d2 > _LEAST_PIVOT * before[2]
    return fit, (l10, l20, l21), (i0, i1, 1.0 / d2)


@kernel
def _eliminate(triangle: Vector, pivots: Vector, row: Vector) -> tuple[Vector, Vector, Vector]:
    """L^-1 `row`, the same times D^-1, and the solution (L D L^T)^-1 `row`."""
    l10, l20, l21 = triangle
    y0 = row[0]
    y1 = row[1] - l10 * y0
    y2 = row[2] - l20 * y0 - l21 * y1
    w0, w1, w2 = y0 * pivots[0], y1 * pivots[1], y2 * pivots[2]
    g1 = w1 - l21 * w2
    return (y0, y1, y2), (w0, w1, w2), (w0 - l10 * g1 - l20 * w2, g1, w2)


@kernel
def _inverse_of_three(triangle: Vector, pivots: Vector) -> Symmetric:
    """(L D L^T)^-1."""
    l10, l20, l21 = triangle
    i0, i1, i2 = pivots
    m20 = l10 * l21 - l20
    x20, x21, y10 = i2 * m20, -i2 * l21, -i1 * l10
    return i0 - l10 * y10 + m20 * x20, y10 - l21 * x20, i1 - l21 * x21, x20, x21, i2


@kernel
def _combine(a: float, u: Vector, b: float, v: Vector, c: float, w: Vector) -> Vector:
    """A u + b v + c w."""
    return a * u[0] + b * v[0] + c * w[0], a * u[1] + b * v[1] + c * w[1], a * u[2] + b * v[2] + c * w[2]


@kernel
def determinant(matrix: Array, n: int) -> float:
    """The determinant of the corner (n, n) of `matrix`, by elimination with row pivots; overwrites it."""
    product = 1.0
    for k in range(n):
        if _bring_up_pivot(matrix, k, n) != k:
            product = -product
        product *= matrix[k, k]
        if product == 0.0:
            return 0.0
        for i in range(k + 1, n):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k + 1, n):
                matrix[i, j] -= factor * matrix[k, j]
    return product


@kernel
def extreme_singular_values(matrix: Array, n: int, squares: Array, diagonal: Array, beside: Array) -> tuple[float, float]:
    """The least and the greatest singular value of the corner (n, n) of `matrix`, to about 1e-16 of the greatest one's square.

    They are the roots of the eigenvalues of its Gram matrix, by Householder's tridiagonal form and QL steps with implicit
    shifts (Wilkinson 1971, II/3). `squares` (n, n), `diagonal` (n,) and `beside` (n,) are scratch.
    """
    for i in range(n):
        for j in range(i + 1):
            product = 0.0
            for k in range(n):
                product += matrix[k, i] * matrix[k, j]
            squares[i, j] = squares[j, i] = product
    _tridiagonalise(squares, n, diagonal, beside)
    _find_eigenvalues(diagonal, beside, n)
    least, greatest = np.inf, 0.0
    for k in range(n):
        least, greatest = min(least, diagonal[k]), max(greatest, diagonal[k])
    return np.sqrt(max(least, 0.0)), np.sqrt(greatest)


@kernel
def _tridiagonalise(a: Array, n: int, diagonal: Array, beside: Array) -> None:
    """Write the diagonal (n,) of a symmetric matrix (n, n) turned to tridiagonal form, and what is beside it, n - 1 numbers."""
    for k in range(n - 2):
        tail = 0.0
        for i in range(k + 1, n):
            tail += a[i, k] * a[i, k]
        size = np.sqrt(tail)
        if size == 0.0:
            beside[k] = 0.0
            continue
        lead = a[k + 1, k]
        alpha = -size if lead > 0.0 else size
        beside[k] = alpha
        # The reflection I - v v^T / h with v = column - alpha e, and the products with it below `beside`.
        a[k + 1, k] = lead - alpha
        h = tail - lead * alpha
        share = 0.0
        for i in range(k + 1, n):
            product = 0.0
            for j in range(k + 1, n):
                product += a[i, j] * a[j, k]
            diagonal[i] = product / h
            share += diagonal[i] * a[i, k]
        share /= 2.0 * h
        for i in range(k + 1, n):
            diagonal[i] -= share * a[i, k]
        for i in range(k + 1, n):
            for j in range(k + 1, n):
                a[i, j] -= a[i, k] * diagonal[j] + diagonal[i] * a[j, k]
    if n > 1:
        beside[n - 2] = a[n - 1, n - 2]
    for k in range(n):
        diagonal[k] = a[k, k]


@kernel
def _find_eigenvalues(diagonal: Array, beside: Array, n: int) -> None:
    """Replace the diagonal (n,) of a symmetric tridiagonal matrix by its eigenvalues."""
    beside[n - 1] = 0.0
    for first in range(n):
        for _ in range(_MOST_SWEEPS):
            last = first
            while last < n - 1:
                if abs(beside[last]) <= _SQUARE * (abs(diagonal[last]) + abs(diagonal[last + 1])):
                    break
                last += 1
            if last == first:
                break
            g = (diagonal[first + 1] - diagonal[first]) / (2.0 * beside[first])
            r = np.sqrt(g * g + 1.0)
            g = diagonal[last] - diagonal[first] + beside[first] / (g + (r if g >= 0.0 else -r))
            sine, cosine, moved = 1.0, 1.0, 0.0
            for i in range(last - 1, first - 1, -1):
                f, b = sine * beside[i], cosine * beside[i]
                r = np.sqrt(f * f + g * g)
                beside[i + 1] = r
                if r == 0.0:
                    break
                sine, cosine = f / r, g / r
                g = diagonal[i + 1] - moved
                r = (diagonal[i] - g) * sine + 2.0 * cosine * b
                moved = sine * r
                diagonal[i + 1] = g + moved
                g = cosine * r - b
            if r == 0.0 and last - 1 > first:
                beside[last] = 0.0
                continue
            diagonal[first] -= moved
            beside[first] = g
            beside[last] = 0.0
