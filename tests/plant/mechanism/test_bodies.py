"""Swings, bodies and plates of a mechanism's file: what is read, kept, and refused."""

import numpy as np
import pytest

from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.mechanism.documents import mechanism_from_text, set_entry, text_of_mechanism

SPATIAL = """based_on = "hexapod"
[joints]
base_swing = 0.5
platform_swing = [0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
base_axes = [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]
[bodies]
leg_diameter = 0.03
leg_ends = [0.01, 0.02]
clearance = 0.001
[bodies.base_plate]
center = [0.0, 0.0, -0.03]
radius = 0.35
thickness = 0.01
[bodies.platform_plate]
center = [0.0, 0.0, 0.02]
normal = [0.0, 0.6, 0.8]
radius = 0.2
"""
PLANAR = """based_on = "planar-3rpr"
[joints]
platform_swing = 1.0
[bodies]
leg_diameter = [0.01, 0.02, 0.03]
[bodies.base_plate]
center = [0.1, -0.03]
normal = [0.0, 1.0]
radius = 0.3
"""


def test_a_file_says_how_far_joints_swing_and_how_thick_bodies_are():
    mechanism = mechanism_from_text(SPATIAL, "own")
    np.testing.assert_array_equal(mechanism.joints.base_swing, np.full(6, 0.5))
    np.testing.assert_array_equal(mechanism.joints.platform_swing, [0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    np.testing.assert_array_equal(mechanism.joints.base_axes, np.tile([0.0, 0.0, 1.0], (6, 1)))
    # By default a cone stands about the leg at home.
    np.testing.assert_allclose(mechanism.joints.platform_axes, mechanism.home_directions, atol=1e-15)
    bodies = mechanism.bodies
    np.testing.assert_array_equal(bodies.leg_diameter, np.full(6, 0.03))
    assert (bodies.leg_ends.tolist(), bodies.clearance) == ([0.01, 0.02], 0.001)
    assert (bodies.base_plate.radius, bodies.base_plate.thickness) == (0.35, 0.01)
    np.testing.assert_array_equal(bodies.base_plate.normal, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(bodies.platform_plate.normal, [0.0, 0.6, 0.8])


def test_a_turned_home_has_its_axes_in_the_platforms_frame():
    text = 'based_on = "hexapod"\n[home]\nquaternion = [0.9950041652780258, 0.0, 0.0, 0.09983341664682815]\n'
    mechanism = mechanism_from_text(f"{text}[joints]\nplatform_swing = 0.5\n", "own")
    seen = mechanism.joints.platform_axes @ mechanism.home.rotation.T
    np.testing.assert_allclose(seen, mechanism.home_directions, atol=1e-14)
    assert np.isinf(mechanism.joints.base_swing).all()


def test_vectors_of_a_planar_mechanism_have_two_numbers():
    mechanism = Mechanism.from_planar(mechanism_from_text(PLANAR, "own"))
    assert mechanism.joints.platform_axes.shape == (3, 3) and not mechanism.joints.platform_axes[:, 2].any()
    np.testing.assert_allclose(
        mechanism.joints.platform_axes @ mechanism.home.rotation.T, mechanism.home_directions, atol=1e-14
    )
    np.testing.assert_array_equal(mechanism.bodies.base_plate.center, [0.1, -0.03, 0.0])
    np.testing.assert_array_equal(mechanism.bodies.leg_diameter, [0.01, 0.02, 0.03])


@pytest.mark.parametrize("text", [SPATIAL, PLANAR])
def test_they_are_kept_in_the_text_of_a_mechanism(text):
    mechanism = mechanism_from_text(text, "own")
    kept = mechanism_from_text(text_of_mechanism(mechanism), "kept")
    for table in ("joints", "bodies"):
        for name, value in vars(getattr(mechanism, table)).items():
            again = getattr(getattr(kept, table), name)
            if value is None or not hasattr(value, "radius"):
                np.testing.assert_allclose(again, value, atol=1e-15) if value is not None else None
                assert (again is None) == (value is None) or np.isinf(value).all()
                continue
            for each, number in vars(value).items():
                np.testing.assert_allclose(getattr(again, each), number, atol=1e-15)


def test_without_the_tables_there_is_neither():
    mechanism = mechanism_from_text('based_on = "hexapod"\n', "own")
    assert mechanism.joints is None and mechanism.bodies is None


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ("[joints]\nbase_swing = 35\n", r"base_swing of leg 0 is 35 rad; .* so write 0\.611 for 35 deg"),
        ("[joints]\nswing = 0.5\n", r"\[joints\] has no entry 'swing'"),
        ("[joints]\nbase_swing = [0.5, 0.5]\n", r"base_swing must have shape \(6,\)"),
        ("[joints]\nbase_axes = [[0.0, 0.0, 1.0]]\n", r"base_axes must have shape \(6, 3\)"),
        (
            "[joints]\nbase_swing = 0.4\nbase_axes = [" + "[0.0, 0.0, 1.0]," * 6 + "]\n",
            r"at home leg . is 0\.478 rad from the axis of its base joint, which swings 0\.4 rad",
        ),
        ("[bodies]\nclearance = 0.01\n", r"\[bodies\] lacks leg_diameter"),
        ("[bodies]\nleg_diameter = 30.0\n", "the diameter of leg 0 is 30 m; .* write 0.03 for 30 mm"),
        ("[bodies]\nleg_diameter = 0.0\n", "it must be positive"),
        ("[bodies]\nleg_diameter = 0.03\nclearance = -0.1\n", "clearance is -0.1 m; it must be at least 0"),
        ("[bodies]\nleg_diameter = 0.03\nbase_plate = 3\n", "base_plate must be a table"),
        ("[bodies]\nleg_diameter = 0.03\n[bodies.base_plate]\nradius = 0.3\n", r"\[bodies.base_plate\] lacks its center"),
        (
            "[bodies]\nleg_diameter = 0.03\n[bodies.base_plate]\nradius = 0.3\ncenter = [0.0, 0.0, 0.0]\n"
            "normal = [0.0, 0.0, 2.0]\n",
            "base_plate.normal has length 2",
        ),
    ],
)
def test_what_is_no_table_of_them_is_refused(tables, said):
    with pytest.raises(InputError, match=said):
        mechanism_from_text(f'based_on = "hexapod"\n{tables}', "own")


def test_an_entry_is_set_by_its_name():
    document = {"limits": {"velocity": 0.25}, "geometry": {"base_joints": [[0.0, 1.0, 2.0]]}}
    set_entry(document, "limits.velocity", 0.1)
    set_entry(document, "geometry.base_joints.0.2", 5.0)
    set_entry(document, "joints.base_swing", 0.5)
    assert document == {
        "limits": {"velocity": 0.1}, "geometry": {"base_joints": [[0.0, 1.0, 5.0]]}, "joints": {"base_swing": 0.5},
    }  # fmt: skip
    for entry, said in (("limits.velocity.x", "is no table"), ("geometry.base_joints.3.0", "no number from 0 to 0")):
        with pytest.raises(LookupError, match=said):
            set_entry(document, entry, 1.0)
