"""Limits of actuators and parameters of the plant: each bound from both sides, and what is assumed where nothing is said."""

import re

import numpy as np
import pytest

from plant.dynamics.variables import PLANAR, SPATIAL
from plant.errors import InputError
from plant.mechanism.checks import Limits, check_legs_differ, checked_limits, checked_plant

LENGTHS = np.array([0.30, 0.32, 0.34])


def test_what_a_mechanism_does_not_say_of_its_limits():
    limits = checked_limits({"stroke": [-0.02, 0.03]}, 3, LENGTHS)
    np.testing.assert_allclose(limits.stroke, [[0.28, 0.33], [0.30, 0.35], [0.32, 0.37]], atol=1e-15)
    assert (limits.velocity, limits.acceleration, limits.jerk, limits.stop_clearance) == (0.25, 3.0, 60.0, 0.002)


def test_each_limit_is_its_own():
    given = {"velocity": 0.1, "acceleration": 2.0, "jerk": 30.0, "stop_clearance": 0.004}
    limits = checked_limits({"stroke": [-0.02, 0.03], **given}, 3, LENGTHS)
    assert {name: getattr(limits, name) for name in given} == given


@pytest.mark.parametrize("name", ["velocity", "acceleration", "jerk", "stop_clearance"])
@pytest.mark.parametrize("value", [0.0, -0.1])
def test_every_limit_is_positive(name, value):
    with pytest.raises(InputError, match=f"the limit of {name} is {value:g}; it must be positive"):
        checked_limits({"stroke": [-0.02, 0.03], name: value}, 3, LENGTHS)


@pytest.mark.parametrize("stroke", [[0.0, 0.03], [-0.02, 0.0]])
def test_home_may_be_an_end_of_the_stroke(stroke):
    assert checked_limits({"stroke": np.add(LENGTHS[:, None], stroke)}, 3, LENGTHS).stroke.shape == (3, 2)


@pytest.mark.parametrize(
    ("leg", "end", "by", "said"),
    [
        (1, 0, 0.001, "leg 1 is 0.32 m long at home, outside its stroke of 0.321 to 0.35 m: move the home"),
        (2, 1, -0.001, "leg 2 is 0.34 m long at home, outside its stroke of 0.32 to 0.339 m"),
        (0, 1, -0.002, "leg 0 is 0.3 m long at home, outside its stroke of 0.28 to 0.298 m"),
    ],
)
def test_a_home_just_outside_the_stroke_names_its_leg(leg, end, by, said):
    stroke = LENGTHS[:, None] + [-0.02, 0.03]
    stroke[leg, end] = LENGTHS[leg] + by
    with pytest.raises(InputError, match=re.escape(said)):
        checked_limits({"stroke": stroke}, 3, LENGTHS)


def test_a_leg_needs_a_length_all_along_its_stroke():
    with pytest.raises(InputError, match=r"the stroke of leg 1 runs from 0 m to 0\.4 m"):
        Limits(np.array([[0.1, 0.2], [0.0, 0.4]]))
    with pytest.raises(InputError, match=r"the stroke of leg 0 runs from 0\.3 m to 0\.2 m"):
        Limits(np.array([[0.3, 0.2], [0.1, 0.4]]))


DRIVE = {"drive.nominal_resistance": 0.8, "motor.resistance": [0.9, 0.7, 0.6, 0.8, 0.9, 1.0]}


def test_a_drive_compensates_for_less_than_the_least_resistance_of_its_motors():
    assert checked_plant({**DRIVE, "drive.compensation": 0.749}, SPATIAL)["drive.compensation"] == 0.749
    message = r"drive.compensation x nominal_resistance is 0.6 Ohm; .* resistance of 0.6 Ohm: choose a smaller"
    with pytest.raises(InputError, match=message):
        checked_plant({**DRIVE, "drive.compensation": 0.5, "drive.nominal_resistance": 1.2}, SPATIAL)
    # Without one of the three there is nothing to compare.
    assert len(checked_plant({"drive.compensation": 5.0, "motor.resistance": 0.1}, SPATIAL)) == 2


@pytest.mark.parametrize("table", [SPATIAL, PLANAR], ids=["spatial", "planar"])
def test_what_follows_from_the_geometry_is_no_parameter_of_a_mechanism(table):
    derived = {"base_joints", "platform_joints", "stop.minimum_length", "stop.maximum_length", "initial_position"}
    derived |= {"base_joint_axes", "initial_quaternion"} if table is SPATIAL else {"initial_angle"}
    refused = set()
    for variable in table.parameters:
        value = np.full(variable.shape, min(1.0, 0.5 * variable.maximum))
        try:
            checked_plant({variable.name: value}, table)
        except InputError as error:
            assert f"the plant's {variable.name} follows from the geometry" in str(error)
            refused.add(variable.name)
    assert refused == derived


@pytest.mark.parametrize("side", [0, 1])
def test_legs_that_share_one_joint_differ_by_the_other(side):
    joints = [np.arange(18.0).reshape(6, 3), np.arange(18.0).reshape(6, 3)]
    joints[side][5] = joints[side][2]
    check_legs_differ(*joints)
    joints[1 - side][5] = joints[1 - side][2] + [0.0, 0.0, 9e-10]
    with pytest.raises(InputError, match="legs 2 and 5 coincide"):
        check_legs_differ(*joints)
    joints[1 - side][5, 2] += 2e-10
    check_legs_differ(*joints)
