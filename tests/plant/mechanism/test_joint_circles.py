"""Geometry by radii, angles and height: what a mechanism has, what it becomes, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.errors import InputError, UnknownNameError
from plant.mechanism import load_mechanism, load_spatial
from plant.mechanism.joint_circles import ENTRIES, reshaped, shape_of

radii = st.floats(0.05, 2.0)
angles = st.floats(0.01, 1.0)


def test_the_preset_hexapod_has_the_numbers_that_its_file_says():
    expected = dict(zip(ENTRIES, (0.30, np.radians(12.0), 0.20, np.radians(12.0), 0.35), strict=True))
    assert shape_of(load_spatial("hexapod")) == pytest.approx(expected, rel=1e-12)


def test_a_mechanism_without_new_numbers_stays_as_it_is():
    hexapod = load_spatial("hexapod")
    base, platform, position = reshaped(hexapod, {})
    np.testing.assert_allclose(base, hexapod.base_joints, atol=1e-15)
    np.testing.assert_allclose(platform, hexapod.platform_joints, atol=1e-15)
    np.testing.assert_array_equal(position, hexapod.home.position)


@given(radii, angles, radii, angles, st.floats(0.1, 3.0))
def test_the_joints_stand_where_compass_and_ruler_put_them(base_radius, base_angle, platform_radius, platform_angle, height):
    """Distances alone: to the centre, within a pair (a chord), and from a joint to the middle of its old pair."""
    hexapod = load_spatial("hexapod")
    shape = dict(zip(ENTRIES, (base_radius, base_angle, platform_radius, platform_angle, height), strict=True))
    base, platform, position = reshaped(hexapod, shape)
    assert position.tolist() == [0.0, 0.0, height]
    pairs = {"base": ((0, 1), (2, 3), (4, 5)), "platform": ((1, 2), (3, 4), (5, 0))}
    for side, joints, old in (("base", base, hexapod.base_joints), ("platform", platform, hexapod.platform_joints)):
        radius, angle = shape[f"{side}_radius"], shape[f"{side}_angle"]
        np.testing.assert_allclose(np.linalg.norm(joints, axis=1), radius)
        for first, second in pairs[side]:
            assert np.linalg.norm(joints[first] - joints[second]) == pytest.approx(2.0 * radius * np.sin(angle))
            middle, was = joints[first] + joints[second], old[first] + old[second]
            np.testing.assert_allclose(middle / np.linalg.norm(middle), was / np.linalg.norm(was), atol=1e-9)
            # Each joint stays on its side of the middle.
            assert np.cross(joints[first], joints[second])[2] * np.cross(old[first], old[second])[2] > 0.0


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        ("hexapod", {"base_radius": -0.1}, "a radius is -0.1 m; it must be positive"),
        ("hexapod", {"platform_angle": 1.1}, "must be more than 0 and less than 1.047"),
        ("hexapod", {"base_angle": 0.0}, "must be more than 0"),
        ("hexapod", {"radius": 0.1}, "the geometry has no entry 'radius'"),
        ("6-3-I", {"platform_angle": 0.1}, "the joints of a pair coincide"),
        ("6-4-I", {}, "the platform joints stand on no circle across the z axis"),
        ("planar-3rpr", {}, "is planar"),
    ],
)
def test_what_cannot_be_is_refused(name, shape, message):
    with pytest.raises((InputError, UnknownNameError), match=message):
        reshaped(load_mechanism(name), shape)


def test_joints_that_coincide_stay_together():
    base, platform, _ = reshaped(load_mechanism("6-3-I"), {"platform_radius": 0.1})
    assert np.unique(np.round(platform, 12), axis=0).shape == (3, 3)
    assert np.unique(np.round(base, 12), axis=0).shape == (6, 3)
