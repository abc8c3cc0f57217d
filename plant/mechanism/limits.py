"""The limits of a mechanism's actuators."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from plant.errors import InputError
from plant.pose import Array, checked_array, numbers
from plant.toml import check_entries


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of the actuators of n legs: `stroke` (n, 2), least and greatest length of each leg [m]; greatest `velocity` [m/s],
    `acceleration` [m/s^2] and `jerk` [m/s^3] along each leg; and the distance `stop_clearance` [m] of the plant's end stops
    beyond the stroke.

    Raises:
        InputError: an empty or non-positive stroke, or a limit that is not positive.
    """

    stroke: Array
    velocity: float = 0.25
    acceleration: float = 3.0
    jerk: float = 60.0
    stop_clearance: float = 0.002

    def __post_init__(self) -> None:
        stroke = checked_array(self.stroke, (len(np.atleast_1d(self.stroke)), 2), "stroke")
        object.__setattr__(self, "stroke", stroke)
        for leg, (least, greatest) in enumerate(stroke):
            if not 0.0 < least < greatest:
                raise InputError(
                    f"the stroke of leg {leg} runs from {least:g} m to {greatest:g} m; it needs 0 < least < greatest length"
                )
        for name in ("velocity", "acceleration", "jerk", "stop_clearance"):
            value = float(checked_array(getattr(self, name), (), f"limit of {name}"))
            object.__setattr__(self, name, value)
            if value <= 0.0:
                raise InputError(f"the limit of {name} is {value:g}; it must be positive")


def checked_limits(limits: Mapping[str, Any], legs: int, lengths: Array | None) -> Limits:
    """The limits of a mechanism from the fields of `Limits` and the lengths (legs,) [m] at home, if there is one."""
    check_entries(limits, sorted(field.name for field in fields(Limits)), "[limits]")
    shape = f"({legs}, 2)"
    if "stroke" not in limits:
        raise InputError(f"the limits lack the stroke: two numbers in metres about the home lengths, or {shape} lengths")
    stroke = numbers(limits["stroke"], "stroke", f"(2,) or {shape}")
    if stroke.shape == (2,):
        if lengths is None:
            raise InputError(f"a stroke of two numbers counts from the home lengths: give a home pose, or {shape} lengths")
        stroke = lengths[:, None] + checked_array(stroke, (2,), "stroke")
    checked = Limits(**{**limits, "stroke": checked_array(stroke, (legs, 2), "stroke")})
    if lengths is not None:
        leg = int(np.argmax(np.maximum(checked.stroke[:, 0] - lengths, lengths - checked.stroke[:, 1])))
        least, greatest = checked.stroke[leg]
        if not least <= lengths[leg] <= greatest:
            raise InputError(
                f"leg {leg} is {lengths[leg]:g} m long at home, outside its stroke of {least:g} to {greatest:g} m: "
                "move the home pose or the stroke"
            )
    return checked
