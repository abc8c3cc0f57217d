"""The compiled products agree with NumPy's, and two identities hold."""

import numpy as np

from plant.pose import rotation_from_vector
from plant.vectors import add, cross, dot, rotate, rotate_back, scale, subtract, vector


def drawn(random):
    return vector(random.normal(size=3))


def test_products_are_those_of_numpy():
    random = np.random.default_rng(1)
    for _ in range(50):
        a, b = drawn(random), drawn(random)
        matrix = random.normal(size=(3, 3))
        assert add(a, b) == tuple(np.add(a, b)) and subtract(a, b) == tuple(np.subtract(a, b))
        assert scale(matrix[0, 0], a) == tuple(matrix[0, 0] * np.array(a))
        assert np.allclose(cross(a, b), np.cross(a, b), rtol=0, atol=1e-14)
        assert np.isclose(dot(a, b), np.dot(a, b), rtol=0, atol=1e-14)
        assert np.allclose(rotate(matrix, a), matrix @ a, rtol=0, atol=1e-14)
        assert np.allclose(rotate_back(matrix, a), matrix.T @ a, rtol=0, atol=1e-14)


def test_a_cross_product_is_across_both_factors():
    random = np.random.default_rng(2)
    for _ in range(50):
        a, b = drawn(random), drawn(random)
        assert abs(dot(cross(a, b), a)) < 1e-14
        assert abs(dot(cross(a, b), b)) < 1e-14


def test_rotating_back_undoes_a_rotation():
    random = np.random.default_rng(3)
    for _ in range(50):
        rotation = rotation_from_vector(random.normal(size=3))
        a = drawn(random)
        assert np.allclose(rotate_back(rotation, rotate(rotation, a)), a, rtol=0, atol=1e-14)
