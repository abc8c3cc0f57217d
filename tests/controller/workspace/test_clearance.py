"""Distances of segments and discs, against minimisation by SciPy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import minimize, minimize_scalar

from controller.pose_limits.clearance import disc_distance, segment_distance

coordinates = st.floats(-1.0, 1.0, allow_subnormal=False).map(lambda x: round(x, 6))
points = arrays(np.float64, 3, elements=coordinates)


def far_enough(*ends):
    return all(np.linalg.norm(a - b) > 1e-3 for a, b in ends)


def minimised(a, b, c, d):
    """From several starts, as a bounded minimisation may stop in a corner."""

    def square(shares):
        return float(np.sum((a + shares[0] * (b - a) - c - shares[1] * (d - c)) ** 2))

    runs = [minimize(square, start, bounds=[(0, 1)] * 2, tol=1e-15) for start in ([0, 0], [0, 1], [1, 0], [1, 1], [0.5, 0.5])]
    return float(np.sqrt(min(run.fun for run in runs)))


@given(points, points, points, points)
def test_the_distance_of_segments_is_the_least(a, b, c, d):
    if far_enough((a, b), (c, d)):
        assert segment_distance(tuple(a), tuple(b), tuple(c), tuple(d)) == pytest.approx(minimised(a, b, c, d), abs=2e-5)


@given(points, points, points, points)
def test_segments_are_as_far_apart_either_way_round(a, b, c, d):
    if far_enough((a, b), (c, d)):
        a, b, c, d = map(tuple, (a, b, c, d))
        found = segment_distance(a, b, c, d)
        for other in ((c, d, a, b), (b, a, c, d), (a, b, d, c)):
            assert segment_distance(*other) == pytest.approx(found, abs=1e-7)


def test_distances_of_segments_by_hand():
    def distance(*ends):
        return segment_distance(*(tuple(map(float, end)) for end in ends))

    assert distance((0, 0, 0), (1, 0, 0), (0.5, -1, 2), (0.5, 1, 2)) == 2.0
    assert distance((0, 0, 0), (1, 0, 0), (3, 0, 0), (4, 0, 0)) == 2.0
    assert distance((0, 0, 0), (1, 0, 0), (0.2, 0.5, 0), (0.9, 0.5, 0)) == 0.5
    assert distance((0, 0, 0), (1, 0, 0), (0.5, -1, 0), (0.5, 1, 0)) == 0.0
    assert distance((0, 0, 0), (1, 0, 0), (1, 0, 0), (2, 1, 0)) == 0.0


@given(points, points, points, points, st.floats(0.05, 1.0))
def test_the_distance_from_a_disc_is_the_least(start, end, center, normal, radius):
    if not far_enough((start, end), (normal, np.zeros(3))):
        return
    normal = normal / np.linalg.norm(normal)

    def distance(share):
        point = start + share * (end - start) - center
        height = point @ normal
        beyond = max(np.linalg.norm(point - height * normal) - radius, 0.0)
        return float(np.hypot(height, beyond))

    # It is convex, so that one bounded search finds the least, which may lie at an end.
    inner = minimize_scalar(distance, bounds=(0.0, 1.0), method="bounded", options={"xatol": 1e-10})
    expected = min(float(inner.fun), distance(0.0), distance(1.0))
    found = disc_distance(*(tuple(each) for each in (start, end, center, normal)), radius)
    assert found == pytest.approx(expected, abs=1e-7)


def test_distances_from_a_disc_by_hand():
    def distance(start, end, radius=1.0):
        return disc_distance(tuple(map(float, start)), tuple(map(float, end)), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), radius)

    assert distance((0, 0, 1), (0, 0, 3)) == 1.0
    assert distance((0, 0, -1), (0, 0, 3)) == 0.0
    assert distance((3, 0, -1), (3, 0, 1)) == pytest.approx(2.0, abs=1e-12)
    assert distance((4, 0, 0), (2, 0, 0)) == 1.0
    assert distance((1 + 3, -5, 4), (1 + 3, 5, 4)) == pytest.approx(5.0, abs=1e-12)
