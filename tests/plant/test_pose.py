"""Rotations and quaternions, and the checks on what users give."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from plant.errors import InputError
from plant.pose import (
    Array,
    checked_array,
    checked_rotation,
    checked_unit,
    nearest_rotation,
    pose_errors,
    quaternion_from_rotation,
    rms_figures,
    rotate_by_vector,
    rotation_angle,
    rotation_from_quaternion,
    rotation_from_vector,
    rotations_from_quaternions,
    skew,
    vector_from_rotation,
)

seeds = st.integers(0, 2**32 - 1)
angles = st.one_of(
    st.floats(0.0, np.pi),
    st.floats(-12.0, 0.0).map(lambda exponent: 10.0**exponent),  # near the identity
    st.floats(-12.0, 0.0).map(lambda exponent: np.pi - 10.0**exponent),  # near half a turn
    st.sampled_from([0.0, 0.99e-4, 1e-4, 1.01e-4, np.pi / 2.0, np.pi]),  # and where the series begins
)


def unit(seed: int, size: int = 3) -> Array:
    """A random direction; a third of them lie near a coordinate axis."""
    vector = np.random.default_rng(seed).normal(size=size)
    if seed % 3 == 0:
        vector[1:] *= 1e-9
    return vector / np.linalg.norm(vector)


@given(seeds)
def test_a_quaternion_makes_the_rotation_that_scipy_makes(seed: int) -> None:
    quaternion = unit(seed, 4)
    rotation = rotation_from_quaternion(quaternion)
    np.testing.assert_allclose(rotation, Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), atol=1e-15)
    np.testing.assert_array_equal(rotations_from_quaternions(np.array([quaternion, -quaternion])), [rotation, rotation])


@given(seeds, angles)
def test_quaternion_and_rotation_make_a_round_trip(seed: int, angle: float) -> None:
    rotation = Rotation.from_rotvec(angle * unit(seed)).as_matrix()
    quaternion = quaternion_from_rotation(rotation)
    assert quaternion[0] >= 0.0
    assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(rotation_from_quaternion(quaternion), rotation, atol=4e-15)


@given(seeds)
def test_the_quaternion_of_half_a_turn_is_its_axis(seed: int) -> None:
    axis = unit(seed)
    quaternion = quaternion_from_rotation(2.0 * np.outer(axis, axis) - np.eye(3))
    assert abs(quaternion[1:] @ axis) == pytest.approx(1.0, abs=1e-14)


@given(seeds, angles)
def test_turning_by_a_vector_multiplies_by_the_matrix_exponential(seed: int, angle: float) -> None:
    vector = angle * unit(seed)
    start = Rotation.random(rng=seed).as_matrix()
    turned = start.copy()
    rotate_by_vector(turned, vector)
    np.testing.assert_allclose(turned, expm(skew(vector)) @ start, atol=5e-15)
    np.testing.assert_allclose(rotation_from_vector(vector), expm(skew(vector)), atol=5e-15)


@given(seeds, st.floats(-16.0, -4.0))
def test_a_small_turn_keeps_its_relative_accuracy(seed: int, exponent: float) -> None:
    angle = 10.0**exponent
    vector = angle * unit(seed)
    turned = np.eye(3)
    rotate_by_vector(turned, vector)
    off = [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
    np.testing.assert_allclose(off, 2.0 * np.sin(angle) / angle * vector, rtol=1e-12, atol=1e-22)


@given(seeds, angles)
def test_a_rotation_vector_is_found_again(seed: int, angle: float) -> None:
    vector = min(angle, np.pi - 1e-9) * unit(seed)
    rotation = Rotation.from_rotvec(vector).as_matrix()
    np.testing.assert_allclose(vector_from_rotation(rotation), vector, rtol=0.0, atol=1e-14)
    stack = np.array([rotation, rotation.T, np.eye(3), rotation]).reshape(2, 2, 3, 3)
    found = vector_from_rotation(stack)
    np.testing.assert_allclose(found, [[vector, -vector], [np.zeros(3), vector]], rtol=0.0, atol=1e-14)


def test_half_a_turn_is_found_from_its_rotation() -> None:
    axis = np.array([0.6, 0.0, -0.8])
    vector = vector_from_rotation(2.0 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-14)
    assert abs(vector @ axis) == pytest.approx(np.pi, abs=1e-14)


def test_quaternions_are_found_for_stacks_of_rotations() -> None:
    stack = Rotation.random(6, random_state=1)
    expected = stack.as_quat(canonical=True, scalar_first=True).reshape(2, 3, 4)
    np.testing.assert_allclose(quaternion_from_rotation(stack.as_matrix().reshape(2, 3, 3, 3)), expected, atol=1e-14)
    quaternions = stack.as_quat(scalar_first=True)
    np.testing.assert_allclose(rotations_from_quaternions(quaternions), stack.as_matrix(), atol=1e-15)


def test_thousands_of_small_turns_stay_a_rotation() -> None:
    random = np.random.default_rng(0)
    rotation = np.eye(3)
    for vector in random.normal(0.0, 0.01, (10_000, 3)):
        rotate_by_vector(rotation, vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-11)


@given(seeds, angles)
def test_the_angle_between_rotations_is_that_of_their_quotient(seed: int, angle: float) -> None:
    start = Rotation.random(rng=seed).as_matrix()
    turned = expm(angle * skew(unit(seed))) @ start
    assert rotation_angle(turned, start) == pytest.approx(angle, abs=2e-15 + 1e-14 * angle)
    assert rotation_angle(start, turned) == pytest.approx(angle, abs=2e-15 + 1e-14 * angle)


def test_angles_are_found_for_stacks_of_rotations() -> None:
    stack = np.array([rotation_from_vector([0.1 * i, 0.0, 0.0]) for i in range(6)]).reshape(2, 3, 3, 3)
    np.testing.assert_allclose(rotation_angle(stack, np.eye(3)), 0.1 * np.arange(6).reshape(2, 3), atol=1e-15)


@given(seeds)
def test_the_nearest_rotation_beats_its_neighbours(seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix = Rotation.random(rng=seed).as_matrix() + random.normal(0.0, 0.4, (3, 3))
    nearest = nearest_rotation(matrix)
    np.testing.assert_allclose(nearest @ nearest.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(nearest) == pytest.approx(1.0, abs=1e-14)
    distance = np.linalg.norm(nearest - matrix)
    for step in (1e-3, 0.1, 1.0, 3.0):
        for vector in random.normal(size=(10, 3)):
            neighbour = expm(step * skew(vector / np.linalg.norm(vector))) @ nearest
            assert np.linalg.norm(neighbour - matrix) >= distance - 1e-12


def test_a_reflection_has_a_nearest_rotation() -> None:
    nearest = nearest_rotation(np.diag([1.0, 0.9, -0.1]))
    np.testing.assert_allclose(nearest, np.eye(3), atol=1e-15)


@given(seeds)
def test_skew_is_the_cross_product(seed: int) -> None:
    random = np.random.default_rng(seed)
    a, b = random.normal(size=(2, 3))
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-15)


# ---- checks ----


def test_checked_values_are_read_only_copies() -> None:
    given_values = np.array([1.0, 2.0, 3.0])
    checked = checked_array(given_values, (3,), "thing")
    given_values[0] = 9.0
    np.testing.assert_array_equal(checked, [1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="read-only"):
        checked[0] = 0.0
    assert checked_array(5, (), "number") == 5.0


@pytest.mark.parametrize(
    ("value", "shape", "message"),
    [
        ([1.0, 2.0], (3,), r"thing must have shape \(3,\), got \(2,\)"),
        ([[1.0, np.nan], [0.0, 0.0]], (2, 2), r"thing\[0, 1\] is nan; it must be finite"),
        ([0.0, -np.inf], (2,), r"thing\[1\] is -inf"),
        (np.inf, (), "thing is inf; it must be finite"),
        ("abc", (), "thing must be an array of numbers of shape .* got 'abc'"),
        ([[1.0], [1.0, 2.0]], (2, 2), "thing must be an array of numbers"),
        ([1j, 0.0], (2,), "thing must be an array of numbers"),
        ({"a": 1.0}, (1,), "thing must be an array of numbers"),
    ],
)
def test_malformed_arrays_are_refused(value: Any, shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        checked_array(value, shape, "thing")


def test_nan_passes_where_it_is_allowed_and_infinity_never() -> None:
    assert np.isnan(checked_array([np.nan, 1.0], (2,), "thing", allow_nan=True)[0])
    with pytest.raises(InputError, match=r"thing\[1\] is inf"):
        checked_array([np.nan, np.inf], (2,), "thing", allow_nan=True)


@given(seeds, st.floats(0.9991, 1.0009))
def test_a_nearly_unit_vector_is_normalised(seed: int, length: float) -> None:
    direction = unit(seed, 4)
    np.testing.assert_allclose(checked_unit(length * direction, 4, "thing"), direction, atol=1e-15)


@pytest.mark.parametrize("length", [0.0, 0.9989, 1.0011, 2.0])
def test_a_vector_off_unit_length_is_refused(length: float) -> None:
    with pytest.raises(InputError, match=f"thing has length {length:g}; it must be 1 within 0.001: normalise it"):
        checked_unit([0.0, length, 0.0], 3, "thing")


@given(seeds)
def test_a_rotation_with_rounding_errors_is_made_proper(seed: int) -> None:
    rotation = Rotation.random(rng=seed).as_matrix()
    rounded = np.round(rotation, 4)
    checked = checked_rotation(rounded, "thing")
    np.testing.assert_allclose(checked @ checked.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(checked, rotation, atol=2e-4)


def test_a_matrix_just_within_the_tolerance_is_a_rotation() -> None:
    np.testing.assert_allclose(checked_rotation(np.diag([1.0, 1.0, 1.0 + 4.9e-4]), "thing"), np.eye(3), atol=1e-15)
    with pytest.raises(InputError, match=r"thing is off orthogonal by 0\.00102"):
        checked_rotation(np.diag([1.0, 1.0, 1.0 + 5.1e-4]), "thing")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.eye(2), r"thing must have shape \(3, 3\)"),
        (np.full((3, 3), np.nan), r"thing\[0, 0\] is nan"),
        (np.diag([1.0, 1.0, 1.001]), "thing is off orthogonal by 0.002, more than 0.001: give a rotation matrix"),
        (np.zeros((3, 3)), "thing is off orthogonal by 1"),
        (np.diag([1.0, -1.0, 1.0]), r"thing is a reflection \(determinant -1\)"),
    ],
)
def test_what_is_no_rotation_is_refused(value: Array, message: str) -> None:
    with pytest.raises(InputError, match=message):
        checked_rotation(value, "thing")


def test_pose_errors_are_translations_and_rotation_vectors_in_the_base():
    random = np.random.default_rng(0)
    true, vectors = Rotation.random(50, random_state=0).as_matrix(), random.uniform(-1.5, 1.5, (50, 3))
    vectors[0] = 0.0
    turned = np.array([rotation_from_vector(vector) for vector in vectors]) @ true
    positions, offsets = random.normal(size=(2, 50, 3))
    errors = pose_errors(positions + offsets, turned, positions, true)
    np.testing.assert_allclose(errors, np.concatenate([offsets, vectors], axis=1), atol=1e-13)
    np.testing.assert_allclose(pose_errors(positions[1], turned[1], np.zeros(3), true[1])[3:], vectors[1], atol=1e-13)
    figures = rms_figures(errors)
    assert figures["position_rms"] == pytest.approx(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))
    assert figures["rotation_rms"] == pytest.approx(np.sqrt(np.mean(rotation_angle(turned, true) ** 2)))
