"""Small dense least squares for the cycle: pivoted Householder QR, and Cholesky for weighted normal equations.

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
    m, n = matrix.shape[0], solution.shape[0]
    for j in range(n):
        order[j] = j
        norms[j] = 0.0
        for i in range(m):
            norms[j] += matrix[i, j] * matrix[i, j]
    for k in range(n):
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
    for k in range(n - 1, -1, -1):
        value = right[k]
        for j in range(k + 1, n):
            value -= matrix[k, j] * norms[j]
        norms[k] = value / matrix[k, k]
    for k in range(n):
        solution[int(order[k])] = norms[k]
    return float(abs(matrix[n - 1, n - 1] / matrix[0, 0]))


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
