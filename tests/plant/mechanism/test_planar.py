"""Planar mechanisms: the preset, what two arrays are enough for, and what is refused."""

import re
import tomllib
from importlib import resources

import numpy as np
import pytest

from plant.errors import InputError
from plant.mechanism.documents import mechanism_from_document
from plant.mechanism.planar import PlanarMechanism, PlanarPose

BASE = [[0.0, 0.0], [0.2, 0.0], [0.3, 0.1]]
PLATFORM = [[0.0, 0.0], [0.1, 0.0], [0.05, 0.08]]
STROKE = [[0.1, 0.2], [0.1, 0.3], [0.2, 0.3]]


def document(**tables):
    return {"name": "mine", "geometry": {"base_joints": BASE, "platform_joints": PLATFORM}, **tables}


def test_the_preset_is_the_rig():
    text = (resources.files("plant.mechanism") / "presets" / "planar-3rpr.toml").read_text()
    rig = mechanism_from_document(tomllib.loads(text))
    assert rig.name == "planar-3rpr"
    home, limits = rig.home, rig.limits
    assert home is not None and limits is not None
    np.testing.assert_array_equal(home.position, [0.1, 0.205])
    lengths = rig.lengths_at(home.position, home.angle)
    np.testing.assert_allclose(limits.stroke, lengths[:, None] + [-0.03, 0.03], atol=1e-15)
    np.testing.assert_array_equal(rig.base_joints, [[0.0, 0.0], [0.17, 0.0], [0.28, 0.0]])
    np.testing.assert_array_equal(rig.platform_joints, [[0.0, 0.0], [0.07, 0.0], [0.1, 0.0]])


def test_a_document_says_the_same_as_two_arrays():
    mechanism = mechanism_from_document(document(limits={"stroke": STROKE}))
    twin = PlanarMechanism.from_legs(np.array(BASE), np.array(PLATFORM), name="mine", limits={"stroke": STROKE})
    for name in ("base_joints", "platform_joints", "stroke"):
        np.testing.assert_array_equal(getattr(mechanism, name), getattr(twin, name))
    assert mechanism.name == twin.name
    assert mechanism_from_document({"geometry": document()["geometry"], "limits": {}}).name == "custom"


def test_arrays_are_copied_and_cannot_be_changed():
    base, stroke = np.array(BASE), np.array(STROKE)
    mechanism = PlanarMechanism.from_legs(base, PLATFORM, limits={"stroke": stroke})
    base[0], stroke[0] = 7.0, 7.0
    np.testing.assert_array_equal(mechanism.base_joints, BASE)
    np.testing.assert_array_equal(mechanism.stroke, STROKE)
    for array in (mechanism.base_joints, mechanism.platform_joints, mechanism.stroke):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0


@pytest.mark.parametrize(
    ("base", "platform"),
    [
        ([BASE[0], BASE[1], BASE[2]], [PLATFORM[0], PLATFORM[0], PLATFORM[1]]),
        ([BASE[0], BASE[1], BASE[1]], [PLATFORM[0], PLATFORM[0], PLATFORM[1]]),
        ([BASE[0], BASE[0], BASE[1]], PLATFORM),
        ([[0.0, 0.0], [0.1, 0.1], [0.3, 0.3]], [[0.0, 0.1], [0.0, 0.2], [0.0, 0.4]]),
    ],
    ids=["n-2, n = 3", "n-2, n = 2", "n-3, n = 2", "rows on a line"],
)
def test_joints_may_be_shared_and_lie_on_a_line(base, platform):
    mechanism = PlanarMechanism.from_legs(base, platform)
    np.testing.assert_array_equal(mechanism.base_joints, base)
    np.testing.assert_array_equal(mechanism.platform_joints, platform)


def test_joints_are_turned_and_moved():
    mechanism = PlanarMechanism.from_legs(BASE, PLATFORM)
    quarter = mechanism.joints_at(np.array([1.0, 2.0]), np.pi / 2)
    np.testing.assert_allclose(quarter, [[1.0, 2.0], [1.0, 2.1], [0.92, 2.05]], atol=1e-15)
    positions, angles = np.array([[1.0, 2.0], [0.3, -0.2]]), np.array([np.pi / 2, 0.7])
    several = mechanism.joints_at(positions, angles)
    np.testing.assert_array_equal(several[0], quarter)
    rotation = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    np.testing.assert_allclose(several[1], [positions[1] + rotation @ np.array(a) for a in PLATFORM], atol=1e-15)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"base_joints": [[0.0, 0.0, 0.0]] * 3}, "base_joints must have shape (3, 2), got (3, 3)"),
        ({"platform_joints": PLATFORM * 2}, "platform_joints must have shape (3, 2), got (6, 2)"),
        ({"platform_joints": "none"}, "platform_joints must be an array of numbers"),
        ({"base_joints": [[0.0, 0.0], [np.nan, 0.0], [1.0, 0.0]]}, "base_joints[1, 0] is nan; it must be finite"),
        (
            {"base_joints": [BASE[0], BASE[1], BASE[1]], "platform_joints": [PLATFORM[0], PLATFORM[1], PLATFORM[1]]},
            "legs 1 and 2 coincide",
        ),
        ({"base_joints": [[0.1, 0.2]] * 3}, "the base joints are all one point, apart by 0 m and not by 1e-09 m: move one"),
        ({"platform_joints": [[0.1, 0.2], [0.1, 0.2 + 1e-10], [0.1, 0.2]]}, "the platform joints are all one point"),
        (
            {"limits": {"stroke": STROKE[:2]}},
            "it must be two numbers about the home lengths, or 3 rows of",
        ),
        (
            {"limits": {"stroke": [[0.1, 0.2], [0.3, 0.3], [0.1, 0.2]]}},
            "the stroke of leg 1 runs from 0.3 m to 0.3 m",
        ),
        ({"limits": {"stroke": [[0.1, 0.2], [0.1, 0.3], [0.0, 0.2]]}}, "the stroke of leg 2 runs from 0 m to 0.2 m"),
    ],
)
def test_what_is_no_mechanism_is_refused(changes, said):
    with pytest.raises(InputError, match=re.escape(said)):
        PlanarMechanism.from_legs(**{"base_joints": BASE, "platform_joints": PLATFORM, **changes})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (document(sensors={}), "unknown entry 'sensors'; a mechanism has name, geometry, home, limits, plant"),
        (document(home={"angle": 0.1}), "position must be an array of numbers"),
        (document(home={"position": [0.0, 0.2], "angle": np.inf}), "angle is inf; it must be finite"),
        (document(limits={"stroke": STROKE, "speed": 1.0}), "[limits] has no entry 'speed'"),
        (document(plant={"motor": {"resistance": 1.0}, "drive": {"compensation": 0.5, "nominal_resistance": 3.0}}), "1.5 Ohm"),
        (document(plant={"initial_angle": 1.0}), "the plant's initial_angle follows from the geometry, the home pose"),
        (document(plant={"platform": {"mass": -1.0}}), "platform.mass is -1 kg"),
        (document(limits=3.0), "'limits' must be a table"),
        (
            document(limits={"velocity": 0.2}),
            "the limits lack the stroke: give two numbers about the home lengths, or 3 rows",
        ),
        (
            {"geometry": {"base_joints": BASE, "base": BASE}},
            "[geometry] has no entry 'base'; it has base_joints, platform_joints",
        ),
        ({"geometry": {"base_joints": BASE}}, "[geometry] lacks platform_joints, an array of three rows of two numbers"),
        ({}, "[geometry] lacks base_joints"),
        (
            document(limits={"stroke": [0.1, 0.2]}),
            "counts from the home lengths: give a home pose, or 3 rows of absolute least",
        ),
    ],
)
def test_what_is_no_document_of_a_mechanism_is_refused(content, said):
    with pytest.raises(InputError, match=re.escape(said)):
        mechanism_from_document(content)


def test_a_table_may_have_entries_of_any_name():
    assert mechanism_from_document(document(control={"anything": 1.0})).settings["control"] == {"anything": 1.0}
    with pytest.raises(InputError, match=re.escape("[home] has no entry 'anything'; it has angle, position")):
        mechanism_from_document(document(home={"position": [0.0, 0.2], "anything": 1.0}))


def test_lengths_are_those_of_a_ruler():
    mechanism = PlanarMechanism.from_legs([[0.0, 0.0], [4.0, 0.0], [0.0, 5.0]], [[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    # {2} at (3, 4) and turned by a quarter: joints at (3, 4), (3, 5) and (1, 4).
    np.testing.assert_allclose(mechanism.lengths_at(np.array([3.0, 4.0]), np.pi / 2), [5.0, np.sqrt(26.0), np.sqrt(2.0)])


def test_a_stroke_about_home_counts_from_the_lengths_of_the_turned_platform():
    home = PlanarPose(np.array([0.05, 0.2]), 0.4)
    mechanism = PlanarMechanism.from_legs(BASE, PLATFORM, home=home, limits={"stroke": [-0.02, 0.03], "velocity": 0.07})
    lengths = mechanism.lengths_at(home.position, 0.4)
    assert np.abs(lengths - mechanism.lengths_at(home.position, 0.0)).max() > 0.01
    np.testing.assert_allclose(mechanism.stroke, lengths[:, None] + [-0.02, 0.03], atol=1e-15)
    assert mechanism.limits.velocity == 0.07
    assert PlanarMechanism.from_legs(BASE, PLATFORM).stroke is None


def test_a_home_of_a_document_is_not_turned_unless_it_says_so():
    assert mechanism_from_document(document(home={"position": [0.0, 0.2]})).home.angle == 0.0
    home = mechanism_from_document(document(home={"position": [0.1, -0.2], "angle": -0.3})).home
    assert home.angle == -0.3 and home.position.tolist() == [0.1, -0.2]
