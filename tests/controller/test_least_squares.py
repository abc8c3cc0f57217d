"""The small solvers of the cycle against LAPACK, on well and badly conditioned systems."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.least_squares import (
    RANK_TOLERANCE,
    WELL_CONDITIONED,
    determinant,
    extreme_singular_values,
    factor_cholesky,
    invert_cholesky,
    invert_symmetric,
    solve_cholesky,
    solve_five,
    solve_least_squares,
    solve_nine,
    solve_square,
    solve_truncated,
)


def solve(matrix, right):
    """The kernel with scratch, on copies, since it overwrites its arguments."""
    n = matrix.shape[1]
    solution = np.full(n, np.nan)
    ratio = solve_least_squares(matrix.copy(), right.copy(), len(matrix), solution, np.zeros(n), np.zeros(n))
    return solution, ratio


def matrix_of_condition(random, rows, columns, condition):
    u, _ = np.linalg.qr(random.normal(size=(rows, columns)))
    v, _ = np.linalg.qr(random.normal(size=(columns, columns)))
    return u @ np.diag(np.geomspace(1.0, 1.0 / condition, columns)) @ v.T


shapes = st.integers(1, 9).flatmap(lambda n: st.tuples(st.integers(n, 14), st.just(n)))
seeds = st.integers(0, 2**32 - 1)


@settings(max_examples=150, deadline=None)
@given(shapes, st.floats(0.0, 6.0), st.floats(-6.0, 6.0), seeds)
def test_least_squares_agrees_with_lapack_at_any_condition_and_scale(shape, exponent, scale_exponent, seed):
    random = np.random.default_rng(seed)
    condition, scale = 10.0**exponent, 10.0**scale_exponent
    matrix = scale * matrix_of_condition(random, *shape, condition)
    right = random.normal(size=shape[0])
    solution, _ = solve(matrix, right)
    expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
    # The solution of a least-squares problem moves by condition^2 times the residual (Wedin); its fitted values do not.
    residual = np.linalg.norm(right - matrix @ expected)
    moves = 1e-14 * condition * (np.linalg.norm(expected) + condition * residual / scale)
    assert np.linalg.norm(solution - expected) <= moves
    np.testing.assert_allclose(matrix @ solution, matrix @ expected, rtol=0.0, atol=1e-13 * condition * np.linalg.norm(right))


def test_a_consistent_system_of_condition_a_million_keeps_ten_digits():
    random = np.random.default_rng(1)
    for _ in range(50):
        matrix = matrix_of_condition(random, 12, 9, 1e6)
        truth = random.normal(size=9)
        solution, _ = solve(matrix, matrix @ truth)
        np.testing.assert_allclose(solution, truth, rtol=0.0, atol=1e-9)
        # What the module says of normal equations: they lose twice as many.
        by_normal_equations = np.linalg.solve(matrix.T @ matrix, matrix.T @ (matrix @ truth))
        assert np.abs(by_normal_equations - truth).max() > 100.0 * np.abs(solution - truth).max()


@settings(max_examples=100, deadline=None)
@given(shapes, st.floats(0.0, 8.0), seeds)
def test_the_returned_ratio_bounds_the_reciprocal_condition(shape, exponent, seed):
    random = np.random.default_rng(seed)
    n = shape[1]
    matrix = matrix_of_condition(random, *shape, 10.0**exponent)
    _, ratio = solve(matrix, np.ones(shape[0]))
    singular_values = np.linalg.svd(matrix, compute_uv=False)
    reciprocal = singular_values[-1] / singular_values[0]
    # For QR with column pivoting: |r_nn| >= sigma_n and |r_11| <= sigma_1, and at worst 2^n sqrt(n) apart from them.
    assert reciprocal * (1.0 - 1e-6) <= ratio <= reciprocal * np.sqrt(n) * 2.0**n


@pytest.mark.parametrize("columns", [1, 3, 5, 9])
@pytest.mark.parametrize("defect", ["zero column", "equal columns", "combination", "zero matrix", "too few rows"])
def test_dependent_columns_are_reported_below_the_tolerance(columns, defect):
    random = np.random.default_rng(columns)
    matrix = random.normal(size=(12, columns))
    if defect == "zero matrix":
        matrix[:] = 0.0
    elif defect == "zero column" or columns == 1:
        matrix[:, 0] = 0.0
    elif defect == "equal columns":
        matrix[:, -1] = matrix[:, 0]
    elif defect == "too few rows":
        matrix[columns - 1 :] = 0.0
    else:
        matrix[:, -1] = matrix[:, :-1] @ random.normal(size=columns - 1)
    _, ratio = solve(matrix, random.normal(size=12))
    assert ratio < RANK_TOLERANCE


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_not_finite_in_any_place_of_the_matrix_counts_as_dependent(bad):
    random = np.random.default_rng(2)
    for _ in range(30):
        matrix = random.normal(size=(8, 4))
        matrix[random.integers(8), random.integers(4)] = bad
        _, ratio = solve(matrix, random.normal(size=8))
        assert ratio < RANK_TOLERANCE


def test_a_part_of_a_larger_scratch_array_gives_the_same_solution():
    random = np.random.default_rng(3)
    matrix, right = random.normal(size=(10, 5)), random.normal(size=10)
    scratch, long_right = np.full((12, 9), np.nan), np.full(12, np.nan)
    scratch[:10, :5], long_right[:10] = matrix, right
    solution, norms, order = np.zeros(9), np.zeros(9), np.zeros(9)
    solve_least_squares(scratch, long_right, 10, solution[:5], norms, order)
    np.testing.assert_allclose(solution[:5], np.linalg.lstsq(matrix, right, rcond=None)[0], rtol=1e-12, atol=1e-13)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 9), st.floats(0.0, 8.0), seeds)
def test_cholesky_agrees_with_lapack_and_reads_the_lower_triangle_alone(n, exponent, seed):
    random = np.random.default_rng(seed)
    root = matrix_of_condition(random, n, n, 10.0 ** (exponent / 2.0))
    matrix = root @ root.T
    matrix = (matrix + matrix.T) / 2.0
    factor = np.tril(matrix) + np.triu(np.full((n, n), np.nan), 1)
    assert factor_cholesky(factor)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=0.0, atol=1e-15 * n * 10.0 ** (exponent / 2.0))
    truth = random.normal(size=n)
    right = matrix @ truth
    solve_cholesky(factor, right)
    np.testing.assert_allclose(right, truth, rtol=0.0, atol=1e-14 * n * 10.0**exponent * np.linalg.norm(truth))


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 6), st.floats(-3.0, 0.0), seeds)
def test_cholesky_refuses_what_is_not_positive_definite(n, exponent, seed):
    random = np.random.default_rng(seed)
    v, _ = np.linalg.qr(random.normal(size=(n, n)))
    eigenvalues = random.uniform(0.5, 1.0, n)
    eigenvalues[random.integers(n)] = -(10.0**exponent)
    matrix = v @ np.diag(eigenvalues) @ v.T
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(matrix)
    assert not factor_cholesky(matrix)


@pytest.mark.parametrize("n", [1, 2, 6])
def test_cholesky_refuses_a_singular_and_a_nan_matrix(n):
    row = np.random.default_rng(n).normal(size=(n, n - 1))
    assert not factor_cholesky(row @ row.T)
    broken = np.eye(n)
    broken[n - 1, n - 1] = np.nan
    assert not factor_cholesky(broken)


@settings(max_examples=100, deadline=None)
@given(st.integers(1, 9), st.floats(0.0, 6.0), seeds)
def test_the_inverse_of_a_cholesky_factor_is_lapacks(n, exponent, seed):
    random = np.random.default_rng(seed)
    matrix = matrix_of_condition(random, n, n, 10.0 ** (0.5 * exponent))
    matrix = matrix @ matrix.T
    factor, inverse = np.tril(matrix), np.full((n, n), np.nan)
    assert factor_cholesky(factor)
    invert_cholesky(factor, inverse)
    np.testing.assert_array_equal(inverse, inverse.T)
    expected = np.linalg.inv(matrix)
    np.testing.assert_allclose(inverse, expected, rtol=0.0, atol=1e-13 * 10.0**exponent * np.abs(expected).max())


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 12), st.floats(0.0, 6.0), st.floats(-6.0, 6.0), seeds)
def test_elimination_agrees_with_lapack(n, exponent, scale_exponent, seed):
    random = np.random.default_rng(seed)
    matrix = 10.0**scale_exponent * matrix_of_condition(random, n, n, 10.0**exponent)
    truth = random.normal(size=n)
    solution = matrix @ truth
    assert 0.0 < solve_square(matrix.copy(), solution) <= 1.0
    np.testing.assert_allclose(solution, truth, rtol=0.0, atol=1e-13 * 10.0**exponent * np.abs(truth).max())


@pytest.mark.parametrize("n", [1, 2, 6])
def test_elimination_reports_a_singular_and_a_nan_matrix(n):
    random = np.random.default_rng(4)
    singular = random.normal(size=(n, n))
    singular[-1] = 2.0 * singular[0] if n > 1 else 0.0
    assert solve_square(singular, np.ones(n)) < RANK_TOLERANCE
    for i in range(n):
        for j in range(n):
            matrix = random.normal(size=(n, n))
            matrix[i, j] = np.nan
            assert solve_square(matrix, np.ones(n)) < RANK_TOLERANCE


@settings(max_examples=150, deadline=None)
@given(st.integers(2, 12), st.data())
def test_truncated_at_its_rank_a_system_gives_one_solution_and_all_that_may_be_added(n, data):
    rank, rows = data.draw(st.integers(1, n)), data.draw(st.integers(n, 14))
    random = np.random.default_rng(data.draw(seeds))
    matrix = random.normal(size=(rows, rank)) @ np.linalg.qr(random.normal(size=(n, rank)))[0].T
    right = matrix @ random.normal(size=n)
    solution, null_space = np.full(n, np.nan), np.full((n, n), np.nan)
    noise = 1e-7 * random.normal(size=(rows, n))
    for disturbed, off in ((matrix, 1e-11), (matrix + noise, 1e-4)):
        conditioning = solve_truncated(
            disturbed.copy(), right.copy(), rows, rank, solution, null_space, np.zeros(n), np.zeros(n)
        )
        if conditioning < 1e-2:
            return
        open_directions = null_space[: n - rank]
        np.testing.assert_allclose(matrix @ solution, right, rtol=0.0, atol=off * np.abs(right).max())
        assert np.abs(matrix @ open_directions.T).max(initial=0.0) <= off * np.abs(open_directions).max(initial=1.0)
        assert np.linalg.matrix_rank(open_directions) == n - rank if rank < n else len(open_directions) == 0


def test_a_rank_that_is_not_there_is_reported():
    matrix = np.outer(np.arange(1.0, 7.0), [1.0, 2.0, 3.0])
    solution, null_space = np.zeros(3), np.zeros((3, 3))
    args = (solution, null_space, np.zeros(3), np.zeros(3))
    assert solve_truncated(matrix.copy(), matrix[:, 0].copy(), 6, 2, *args) < RANK_TOLERANCE
    assert solve_truncated(matrix.copy(), matrix[:, 0].copy(), 6, 1, *args) == 1.0


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_singular_values_and_determinant_are_numpys(n):
    random = np.random.default_rng(n)
    for number in range(300):
        matrix = random.normal(size=(6, 6))
        if number % 3 == 0:
            matrix[:, :n] *= 10.0 ** random.uniform(-3.0, 1.0, n)
        if number % 5 == 0:
            # Twofold singular values.
            matrix[:n, :n] = np.repeat([1.0, 2.0, 3.0], 2)[:n, None] * np.linalg.qr(random.normal(size=(n, n)))[0]
        corner = matrix[:n, :n].copy()
        values, expected = np.linalg.svd(corner, compute_uv=False), np.linalg.det(corner)
        scratch = np.empty((6, 6)), np.empty(6), np.empty(6)
        least, greatest = extreme_singular_values(matrix.copy(), n, *scratch)
        assert greatest == pytest.approx(values[0], rel=1e-13)
        assert abs(least - values[-1]) * values[-1] < 1e-13 * values[0] ** 2
        assert determinant(matrix.copy(), n) == pytest.approx(expected, rel=1e-9, abs=1e-12 * values[0] ** n)


def test_a_singular_matrix_has_the_singular_value_zero():
    scratch = np.empty((6, 6)), np.empty(6), np.empty(6)
    for matrix in (np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 0.0]), np.zeros((6, 6))):
        assert extreme_singular_values(matrix.copy(), 6, *scratch)[0] == 0.0
        assert determinant(matrix.copy(), 6) == 0.0


def by_qr_and_by_normal_equations(matrix, right, rank):
    """Conditioning, solution and open directions, by `solve_truncated` and by `solve_five` or `solve_nine`."""
    rows, n = matrix.shape
    solution, null_space, norms, order = (np.full(shape, np.nan) for shape in (n, (n, n), n, n))
    ratio = solve_truncated(matrix.copy(), right.copy(), rows, rank, solution, null_space, norms, order)
    found, found_space, pivots, found_order = (np.full(shape, np.nan) for shape in (n, (n, n), n, n))
    equations = np.full((20, 20), np.nan)
    equations[:n, :n], equations[:n, n] = matrix.T @ matrix, matrix.T @ right
    solver = {5: solve_five, 9: solve_nine}[n]
    found_ratio = solver(equations, rank, found, found_space, pivots, found_order)
    return (ratio, solution, null_space[: n - rank]), (found_ratio, found, found_space[: n - rank])


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.sampled_from([5, 9]), st.data())
def test_where_they_are_well_conditioned_normal_equations_give_what_the_qr_gives(n, data):
    """To rounding over the square of the conditioning, the open directions in the same order."""
    rank, noise = data.draw(st.integers(n - 2, n)), data.draw(st.sampled_from([0.0, 1e-3]))
    random = np.random.default_rng(data.draw(seeds))
    matrix = matrix_of_condition(random, 12, rank, 10.0 ** data.draw(st.floats(0.0, 1.5)))
    matrix = matrix @ np.linalg.qr(random.normal(size=(n, rank)))[0].T
    matrix += noise * np.ptp(matrix) * random.normal(size=(12, n))
    right = random.normal(size=12)
    qr, found = by_qr_and_by_normal_equations(matrix, right, rank)
    if qr[0] < WELL_CONDITIONED:
        assert found[0] == 0.0 or qr[0] > WELL_CONDITIONED * (1.0 - 1e-9)
        return
    for one, other in zip(qr, found, strict=True):
        np.testing.assert_allclose(other, one, rtol=0.0, atol=1e-12 * max(1.0, np.abs(one).max(initial=0.0)))
    if rank == n:
        expected = np.linalg.lstsq(matrix, right, rcond=None)[0]
        np.testing.assert_allclose(found[1], expected, rtol=0.0, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("n", [5, 9])
def test_normal_equations_refuse_dependent_columns_and_nan(n):
    random = np.random.default_rng(n)
    matrix = random.normal(size=(12, n))
    matrix[:, 1] = matrix[:, 0] + 1e-3 * random.normal(size=12)
    assert by_qr_and_by_normal_equations(matrix, np.ones(12), n)[1][0] == 0.0
    matrix = random.normal(size=(12, n))
    for k in range(n):
        broken = matrix.copy()
        broken[3, k] = np.nan
        assert by_qr_and_by_normal_equations(broken, np.ones(12), n)[1][0] == 0.0


@settings(max_examples=100, deadline=None)
@given(st.floats(0.0, 8.0), st.floats(-6.0, 6.0), seeds)
def test_the_inverse_by_blocks_is_lapacks_and_reads_the_lower_triangle_alone(exponent, scale_exponent, seed):
    random = np.random.default_rng(seed)
    root = matrix_of_condition(random, 6, 6, 10.0 ** (0.5 * exponent))
    matrix = 10.0**scale_exponent * root @ root.T
    matrix, inverse = (matrix + matrix.T) / 2.0, np.full((6, 6), np.nan)
    assert invert_symmetric(np.tril(matrix) + np.triu(np.full((6, 6), np.nan), 1), inverse)
    np.testing.assert_array_equal(inverse, inverse.T)
    expected = np.linalg.inv(matrix)
    np.testing.assert_allclose(inverse, expected, rtol=0.0, atol=1e-13 * 10.0**exponent * np.abs(expected).max())


def test_the_inverse_by_blocks_refuses_what_cholesky_refuses():
    random = np.random.default_rng(5)
    row = random.normal(size=(6, 5))
    v, _ = np.linalg.qr(random.normal(size=(6, 6)))
    indefinite = v @ np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-3]) @ v.T
    for matrix in (row @ row.T, indefinite, np.zeros((6, 6)), np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])):
        assert not factor_cholesky(matrix.copy())
        assert not invert_symmetric(matrix, np.zeros((6, 6)))
    for i in range(6):
        for j in range(i + 1):
            broken = np.eye(6)
            broken[i, j] = np.nan
            assert not invert_symmetric(broken, np.zeros((6, 6)))
