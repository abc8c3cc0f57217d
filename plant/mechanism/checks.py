"""What every mechanism must satisfy, in space and in the plane."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.dynamics.variables import VariableTable, checked_parameters
from plant.errors import InputError
from plant.pose import Array, checked_array

SAME_JOINT_M = 1e-9
"""Joints closer than this are one joint."""

_DERIVED = (
    "base_joints", "platform_joints", "base_joint_axes", "stop.minimum_length", "stop.maximum_length", "initial_position",
    "initial_quaternion", "initial_angle",
)  # fmt: skip
"""Plant parameters that follow from the rest of a mechanism."""


def checked_joints(base_joints: ArrayLike, platform_joints: ArrayLike, shape: tuple[int, int]) -> tuple[Array, Array]:
    """The joints of base and platform, each of `shape`, of legs that differ; or an `InputError`."""
    base, platform = checked_array(base_joints, shape, "base_joints"), checked_array(platform_joints, shape, "platform_joints")
    check_legs_differ(base, platform)
    return base, platform


def check_legs_differ(base: Array, platform: Array) -> None:
    """Check that no two legs share both their joints, or raise an `InputError`."""
    for leg in range(len(base)):
        for other in range(leg):
            apart = max(np.linalg.norm(base[leg] - base[other]), np.linalg.norm(platform[leg] - platform[other]))
            if apart < SAME_JOINT_M:
                raise InputError(f"legs {other} and {leg} coincide: they share both joints; move one of them")


def checked_plant(values: Mapping[str, ArrayLike] | None, table: VariableTable) -> Mapping[str, Array]:
    """The parameters of the dynamics that a mechanism gives.

    Raises:
        UnknownNameError: a parameter that does not exist.
        InputError: wrong shape, out of range, a parameter that follows from the geometry, or an unstable drive.
    """
    parameters = checked_parameters(values or {}, table)
    for name in parameters.keys() & _DERIVED:
        raise InputError(f"the plant's {name} follows from the geometry, the home pose and the limits: leave it out")
    if {"drive.compensation", "drive.nominal_resistance", "motor.resistance"} <= parameters.keys():
        compensated = float(parameters["drive.compensation"] * parameters["drive.nominal_resistance"])
        least = float(parameters["motor.resistance"].min())
        if compensated >= least:
            raise InputError(
                f"drive.compensation x nominal_resistance is {compensated:g} Ohm; the drive is stable only below the motors' "
                f"resistance of {least:g} Ohm: choose a smaller compensation"
            )
    return MappingProxyType(parameters)


def read_only(settings: Mapping[str, Mapping[str, Any]] | None) -> Mapping[str, Mapping[str, Any]]:
    """A read-only copy of the tables for the controller."""
    return MappingProxyType({name: MappingProxyType(dict(table)) for name, table in (settings or {}).items()})
