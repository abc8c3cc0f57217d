"""Small dense systems for the cycle: pivoted Householder QR, elimination, and Cholesky for weighted normal equations.

Normal equations of the closed forms lose half the digits, so those use QR; the refinement's are well scaled.
"""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array

RANK_TOLERANCE = 1e-9
"""Ratio of the least to the greatest diagonal element of R below which columns count as dependent."""


@kernel
def solve_least_squares(matrix: Array, right: Array, solution: Array, norms: Array, order: Array) -> float:
    """Minimise |matrix @ solution - right| by QR with column pivoting; overwrites `matrix` (m, n) and `right` (m,).

    Args:
        matrix: (m, n), m >= n.
        right: (m,).
        solution: (n,), written.
        norms, order: (n,) scratch.

    Returns:
        The ratio of the least to the greatest diagonal element of R, an estimate of the reciprocal condition number;
        below `RANK_TOLERANCE` nothing is solved.
    """
    n = solution.shape[0]
    conditioning = _triangularise(matrix, right, n, norms, order)
    if conditioning >= RANK_TOLERANCE:
        _substitute_back(matrix, right, n)
        for k in range(n):
            solution[int(order[k])] = right[k]
    return conditioning


@kernel
def solve_truncated(
    matrix: Array, right: Array, rank: int, solution: Array, null_space: Array, norms: Array, order: Array
) -> float:
    """Solve a system of known rank: after `rank` pivots what is left of the rows counts as noise.

    Args:
        matrix, right, norms, order: as for `solve_least_squares`.
        rank: of the system without noise, at most n.
        solution: (n,), one solution, written.
        null_space: (>= n - rank, n), whose rows may be added to it in any amount, written.

    Returns:
        The ratio of the last to the first pivot; below `RANK_TOLERANCE` nothing is solved.
    """
    n = solution.shape[0]
    conditioning = _triangularise(matrix, right, rank, norms, order)
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


@kernel
def _triangularise(matrix: Array, right: Array, rank: int, norms: Array, order: Array) -> float:
    """Turn `matrix` (m, n) into R by `rank` pivots and `right` along with it; returns the ratio of last to first pivot."""
    m, n = matrix.shape
    for j in range(n):
        order[j] = j
        norms[j] = 0.0
        for i in range(m):
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
        # Householder's vector is stored below the diagonal, its leading element apart.
        lead = matrix[k, k] - alpha
        scale = 1.0 / (alpha * lead)
        for j in range(k + 1, n):
            dot = lead * matrix[k, j]
            for i in range(k + 1, m):
                dot += matrix[i, k] * matrix[i, j]
            dot *= scale
            matrix[k, j] += dot * lead
            for i in range(k + 1, m):
                matrix[i, j] += dot * matrix[i, k]
            norms[j] = 0.0
            for i in range(k + 1, m):
                norms[j] += matrix[i, j] * matrix[i, j]
        dot = lead * right[k]
        for i in range(k + 1, m):
            dot += matrix[i, k] * right[i]
        dot *= scale
        right[k] += dot * lead
        for i in range(k + 1, m):
            right[i] += dot * matrix[i, k]
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
def solve_square(matrix: Array, right: Array) -> float:
    """Replace `right` (n,) by the solution of `matrix` (n, n) @ x = right, by elimination with row pivots; overwrites `matrix`.

    Returns:
        The ratio of the least to the greatest pivot; below `RANK_TOLERANCE` nothing is solved.
    """
    n = right.shape[0]
    least, greatest = np.inf, 0.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        if best != k:
            right[k], right[best] = right[best], right[k]
            for j in range(k, n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
        pivot = abs(matrix[k, k])
        least, greatest = min(least, pivot), max(greatest, pivot)
        if not least > RANK_TOLERANCE * greatest:
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
    """Replace the lower triangle of a symmetric `matrix` (n, n) by its Cholesky factor; False if it is not positive
    definite beyond rounding.
    """
    n = matrix.shape[0]
    for j in range(n):
        before = matrix[j, j]
        for k in range(j):
            factor = matrix[j, k]
            for i in range(j, n):
                matrix[i, j] -= matrix[i, k] * factor
        if not matrix[j, j] > 1e-13 * before:
            return False
        pivot = np.sqrt(matrix[j, j])
        matrix[j, j] = pivot
        inverse = 1.0 / pivot
        for i in range(j + 1, n):
            matrix[i, j] *= inverse
    return True


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
