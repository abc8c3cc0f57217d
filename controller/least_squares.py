"""Small dense systems for the cycle: pivoted Householder QR, elimination, and Cholesky for weighted normal equations.

The closed forms use QR, because their normal equations would lose half the digits. The refinement's are well scaled.
"""

import numpy as np

from plant.compiled import kernel
from plant.pose import Array

RANK_TOLERANCE = 1e-9  # ratio of the least to the greatest diagonal element of R, below which columns count as dependent
_SQUARE = 1e-16  # share of its neighbours below which an element beside the diagonal is zero
_MOST_SWEEPS = 30


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
        if not matrix[j, j] > 1e-13 * before:
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
def determinant(matrix: Array, n: int) -> float:
    """The determinant of the corner (n, n) of `matrix`, by elimination with row pivots; overwrites it."""
    product = 1.0
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        if best != k:
            product = -product
            for j in range(k, n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
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
