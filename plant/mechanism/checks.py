"""What every mechanism must satisfy, and the limits of its actuators."""

import copyreg
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.dynamics.variables import VariableTable, checked_parameters
from plant.errors import InputError
from plant.files import check_entries
from plant.pose import Array, checked_array, numbers

SAME_JOINT_M = 1e-9
"""Joints closer than this are one joint."""

_LARGEST_M = 10.0
"""Radius and height of the largest mechanisms."""

_LEAST_ROOM = 0.02
"""Least distance of home from either end of the stroke, as a share of it."""

DERIVED = (
    "base_joints", "platform_joints", "base_joint_axes", "stop.minimum_length", "stop.maximum_length", "initial_position",
    "initial_quaternion", "initial_angle",
)  # fmt: skip
"""Plant parameters that follow from the rest of a mechanism."""


def checked_joints(base_joints: ArrayLike, platform_joints: ArrayLike, shape: tuple[int, int]) -> tuple[Array, Array]:
    """The joints of base and platform, each of `shape`, or an `InputError`."""
    base, platform = checked_array(base_joints, shape, "base_joints"), checked_array(platform_joints, shape, "platform_joints")
    for name, joints in (("base_joints", base), ("platform_joints", platform)):
        check_size(f"{name} reach {{:g}} m from their middle", np.linalg.norm(joints - joints.mean(axis=0), axis=1).max())
    check_legs_differ(base, platform)
    return base, platform


def check_size(what: str, size: float) -> None:
    """Check that a length [m] of a mechanism, which the text `what` shows, is not in another unit, or raise an `InputError`."""
    if size > _LARGEST_M:
        raise InputError(
            f"{what.format(size)}; the largest mechanisms have {_LARGEST_M:g} m: lengths are in metres, so write 0.3 for 300 mm"
        )


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
    for name in parameters.keys() & DERIVED:
        raise InputError(f"the plant's {name} follows from the geometry, the home pose and the limits: leave it out")
    if {"drive.compensation", "drive.nominal_resistance", "motor.resistance"} <= parameters.keys():
        compensated = float(parameters["drive.compensation"] * parameters["drive.nominal_resistance"])
        least = float(parameters["motor.resistance"].min())
        if compensated >= least:
            raise InputError(
                f"drive.compensation x nominal_resistance is {compensated:g} Ohm; the drive is stable only below the motors' "
                f"resistance of {least:g} Ohm: choose a smaller compensation"
            )
    return _table(parameters)


def read_only(settings: Mapping[str, Mapping[str, Any]] | None) -> Mapping[str, Mapping[str, Any]]:
    """A read-only copy of the tables for the controller."""
    return _table({name: _table(dict(table)) for name, table in (settings or {}).items()})


def _table(content: dict[str, Any]) -> MappingProxyType[str, Any]:
    return MappingProxyType(content)


# Python cannot pickle read-only tables by itself, and mechanisms go to other processes.
copyreg.pickle(MappingProxyType, lambda table: (_table, (dict(table),)))


MOST_LIMITS = {"velocity": (10.0, "m/s"), "acceleration": (1e4, "m/s2"), "jerk": (1e8, "m/s3"), "stop_clearance": (1.0, "m")}
"""The largest plausible limits, and their units."""


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the actuators of n legs.

    Raises:
        InputError: an empty or non-positive stroke, or a limit that is not positive.
    """

    stroke: Array  # (n, 2), least and greatest length of each leg [m]
    velocity: float = 0.25  # of each leg [m/s]
    acceleration: float = 3.0  # of each leg [m/s^2]
    jerk: float = 60.0  # of each leg [m/s^3]
    stop_clearance: float = 0.002  # from the stroke to the plant's end stops [m]

    def __post_init__(self) -> None:
        stroke = checked_array(self.stroke, (len(np.atleast_1d(self.stroke)), 2), "stroke")
        object.__setattr__(self, "stroke", stroke)
        for leg, (least, greatest) in enumerate(stroke):
            if not 0.0 < least < greatest:
                raise InputError(
                    f"the stroke of leg {leg} runs from {least:g} m to {greatest:g} m; it needs 0 < least < greatest length, "
                    "in metres"
                )
        for name in ("velocity", "acceleration", "jerk", "stop_clearance"):
            value = float(checked_array(getattr(self, name), (), f"limit of {name}"))
            object.__setattr__(self, name, value)
            if value <= 0.0:
                raise InputError(f"the limit of {name} is {value:g}; it must be positive")
            most, unit = MOST_LIMITS[name]
            if value > most:
                raise InputError(f"the limit of {name} is {value:g} {unit}; no leg has more than {most:g}: give it in {unit}")


def checked_limits(limits: Mapping[str, Any], legs: int, lengths: Array | None) -> Limits:
    """The limits of a mechanism from the fields of `Limits` and the lengths (legs,) [m] at home, if there is one.

    Raises:
        InputError: an unknown entry, no stroke, a stroke about a missing home, or a home outside the stroke.
    """
    check_entries(limits, sorted(field.name for field in fields(Limits)), "[limits]")
    rows = f"{legs} rows of absolute least and greatest length, in metres"
    if "stroke" not in limits:
        raise InputError(f"the limits lack the stroke: give two numbers about the home lengths, or {rows}")
    stroke = numbers(limits["stroke"], "stroke", f"(2,) or ({legs}, 2)")
    if stroke.shape not in ((2,), (legs, 2)):
        raise InputError(f"stroke is {stroke.tolist()}; it must be two numbers about the home lengths, or {rows}")
    if stroke.shape == (2,):
        if lengths is None:
            raise InputError(f"a stroke of two numbers counts from the home lengths: give a home pose, or {rows}")
        stroke = lengths[:, None] + checked_array(stroke, (2,), "stroke")
    checked = Limits(**{**limits, "stroke": stroke})
    if lengths is not None:
        leg = int(np.argmax(np.maximum(checked.stroke[:, 0] - lengths, lengths - checked.stroke[:, 1])))
        least, greatest = checked.stroke[leg]
        if not least <= lengths[leg] <= greatest:
            raise InputError(
                f"leg {leg} is {lengths[leg]:g} m long at home, outside its stroke of {least:g} to {greatest:g} m: "
                "move the home pose or the stroke"
            )
    return checked


def check_room(limits: Limits, lengths: Array) -> None:
    """Check that legs of these lengths (n,) [m], at home, have room either way, or raise an `InputError`."""
    spans = np.diff(limits.stroke)[:, 0]
    rooms = np.minimum(lengths - limits.stroke[:, 0], limits.stroke[:, 1] - lengths)
    leg = int(np.argmin(rooms / spans))
    if rooms[leg] < _LEAST_ROOM * spans[leg]:
        raise InputError(
            f"leg {leg} is {1e3 * rooms[leg]:.3g} mm from an end of its stroke at home, and a run begins and ends there: at "
            f"least {1e3 * _LEAST_ROOM * spans[leg]:.3g} mm are needed either way; move the home pose or the stroke"
        )
