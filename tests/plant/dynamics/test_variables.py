"""The table of the plant's variables and the check of parameters against it."""

import re
from typing import Any

import numpy as np
import pytest

from plant.dynamics.variables import DRIVE_MODES, PLANAR, SPATIAL, checked_parameters
from plant.errors import InputError, UnknownNameError

BY_NAME = {variable.name: variable for variable in (*SPATIAL.states, *SPATIAL.inputs, *SPATIAL.parameters, *SPATIAL.outputs)}


def test_every_variable_has_one_entry_with_unit_and_description() -> None:
    table = (*SPATIAL.states, *SPATIAL.inputs, *SPATIAL.parameters, *SPATIAL.outputs)
    assert len(BY_NAME) == len(table)
    assert all(variable.unit and variable.description for variable in table)
    assert {v.causality for v in SPATIAL.states} == {"state"} and {v.causality for v in SPATIAL.outputs} == {"output"}
    assert {v.causality for v in SPATIAL.inputs} == {"input"} and {v.causality for v in SPATIAL.parameters} == {"parameter"}


def test_payload_friction_and_gravity_are_what_may_change_during_a_run() -> None:
    tunable = {v.name.split(".")[0] for v in SPATIAL.parameters if v.tunable}
    assert tunable == {"payload", "friction", "gravity"}
    assert all(v.tunable for v in SPATIAL.parameters if v.name.startswith(("payload.", "friction.", "gravity")))


def test_both_plants_mean_the_same_by_a_name() -> None:
    planar = (*PLANAR.states, *PLANAR.inputs, *PLANAR.parameters, *PLANAR.outputs)
    shared = [(variable, BY_NAME[variable.name]) for variable in planar if variable.name in BY_NAME]
    assert {variable.name for variable in planar} - set(BY_NAME) == {"state.angle", "initial_angle", "angle"}
    for variable, other in shared:
        for field in ("unit", "causality", "maximum", "nominal", "tunable", "discrete"):
            assert getattr(variable, field) == getattr(other, field), variable.name
        # Products of inertia, which a scalar has none of, may be negative.
        assert variable.minimum == other.minimum or variable.name in ("platform.inertia", "payload.inertia"), variable.name


def test_the_description_of_the_drive_mode_names_every_mode() -> None:
    for value, name in DRIVE_MODES.items():
        assert f"{value} {name}" in BY_NAME["drive_mode"].description


def test_a_scalar_is_spread_over_the_legs() -> None:
    checked = checked_parameters({"friction.coulomb": 12, "motor.resistance": [1, 2, 3, 4, 5, 6], "payload.mass": 0})
    np.testing.assert_array_equal(checked["friction.coulomb"], np.full(6, 12.0))
    np.testing.assert_array_equal(checked["motor.resistance"], np.arange(1.0, 7.0))
    assert checked["payload.mass"] == 0.0


@pytest.mark.parametrize(
    ("values", "kind", "message"),
    [
        ({"platform.weight": 1.0}, UnknownNameError, "the plant has no parameter 'platform.weight'; it has base_joints, "),
        ({"velocity_command": 0.0}, UnknownNameError, "no parameter 'velocity_command'"),
        ({"platform.mas": 1.0}, UnknownNameError, "; did you mean 'platform.mass'\\?"),
        ({"platform.mass": -1.0}, InputError, "platform.mass is -1 kg; it must be 1e-09 to"),
        ({"motor.resistance": [1, 1, 0, 1, 1, 1]}, InputError, "motor.resistance is 0 Ohm; it must be 1e-09 to"),
        ({"platform.inertia": 1.0}, InputError, r"platform.inertia must have shape \(3, 3\), got \(\)"),
        ({"friction.coulomb": [1.0] * 5}, InputError, r"friction.coulomb must have shape \(6,\), got \(5,\)"),
        ({"gravity": [0.0, 0.0, np.nan]}, InputError, r"gravity\[2\] is nan"),
        ({"substep": "short"}, InputError, "substep must be an array of numbers"),
        ({"friction.coulomb": "much"}, InputError, "friction.coulomb must be an array of numbers"),
        ({"substep": 1e-7}, InputError, "substep is 1e-07 s; it must be 1e-06 to"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(values: dict[str, Any], kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        checked_parameters(values)


@pytest.mark.parametrize(
    ("name", "allowed", "refused"),
    [
        ("substep", [1e-6, 0.1], [0.9e-6, 0.1001]),
        ("drive.compensation", [0.0, 10.0], [-1e-6, 10.1]),
        ("payload.mass", [0.0, 1e6], [-1e-9, 1.1e6]),
        ("motor.screw_lead", [1e-6, 10.0], [0.0, -0.005, 10.1]),
    ],
)
def test_a_parameter_may_be_either_end_of_its_range(name: str, allowed: list[float], refused: list[float]) -> None:
    for value in allowed:
        assert checked_parameters({name: value})[name] == value
    for value in refused:
        with pytest.raises(InputError, match=re.escape(f"{name} is {value:g} ")):
            checked_parameters({name: value})


def test_the_value_that_is_out_of_range_is_told_wherever_it_stands() -> None:
    with pytest.raises(InputError, match=r"motor\.resistance is -3 Ohm"):
        checked_parameters({"motor.resistance": [1, 1, 1, 1, 1, -3]})
    with pytest.raises(InputError, match=r"friction\.coulomb is 2e"):
        checked_parameters({"friction.coulomb": [1, 1, 1, 2e6, 1, 1]})


def test_a_number_is_spread_over_three_legs_and_shapes_are_the_planes() -> None:
    checked = checked_parameters(
        {"friction.coulomb": 2.5, "platform.inertia": 0.1, "leg_imu_position": np.ones((3, 3))}, PLANAR
    )
    assert {name: value.shape for name, value in checked.items()} == {
        "friction.coulomb": (3,), "platform.inertia": (), "leg_imu_position": (3, 3)
    }  # fmt: skip
    with pytest.raises(UnknownNameError, match="no parameter 'base_joint_axes'"):
        checked_parameters({"base_joint_axes": np.ones((3, 3))}, PLANAR)
    with pytest.raises(InputError, match=r"base_joints must have shape \(3, 2\), got \(6, 3\)"):
        checked_parameters({"base_joints": np.ones((6, 3))}, PLANAR)
