"""Planar mechanisms: three legs and three degrees of freedom (the paper's section 6).

Leg k joins base joint k, row k of an array (3, 2) in {1}, and platform joint k, row k of an array (3, 2) in {2}; a shared
joint is a repeated row. A pose is the position (2,) [m] of the origin of {2} in {1} and the counter-clockwise angle [rad]
from {1} to {2}.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.dynamics.planar_variables import PLANAR
from plant.dynamics.variables import checked_parameters
from plant.errors import InputError
from plant.mechanism.limits import Limits, checked_limits
from plant.pose import Array, checked_array

PLANAR_LEGS = 3
SAME_JOINT_M = 1e-9
"""Joints closer than this are one joint."""

_TABLES = {
    "geometry": {"base_joints", "platform_joints"},
    "home": {"position", "angle"},
    "limits": {field.name for field in fields(Limits)},
    "plant": None,
    "control": None,
    "fusion": None,
    "safety": None,
}

_DERIVED = (
    "base_joints", "platform_joints", "stop.minimum_length", "stop.maximum_length", "initial_position", "initial_angle",
)  # fmt: skip
"""Plant parameters that follow from the rest of a mechanism."""


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """Where the platform is.

    Attributes:
        position: (2,) [m], origin of {2} in {1}.
        angle: of {2} against {1}, counter-clockwise [rad].

    Raises:
        InputError: wrong shape, or not finite.
    """

    position: Array
    angle: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", checked_array(self.position, (2,), "position"))
        object.__setattr__(self, "angle", float(checked_array(self.angle, (), "angle")))


@dataclass(frozen=True, eq=False)
class PlanarMechanism:
    """A planar mechanism of three legs, checked when it is built and never changed.

    Attributes:
        name: what it is called in messages and reports.
        base_joints: (3, 2) [m] in {1}.
        platform_joints: (3, 2) [m] in {2}.
        home: the pose that strokes and targets are measured from, or None.
        limits: the actuators' limits, or None.
        plant: parameters of the dynamics by the names of `plant.dynamics.planar_variables`.
        settings: the tables `control`, `fusion` and `safety` of the preset, for the controller to read.
    """

    name: str
    base_joints: Array
    platform_joints: Array
    home: PlanarPose | None
    limits: Limits | None
    plant: Mapping[str, Array]
    settings: Mapping[str, Mapping[str, Any]]

    @classmethod
    def from_legs(
        cls,
        base_joints: ArrayLike,
        platform_joints: ArrayLike,
        *,
        name: str = "custom",
        home: PlanarPose | None = None,
        limits: Mapping[str, Any] | None = None,
        plant: Mapping[str, ArrayLike] | None = None,
        settings: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> "PlanarMechanism":
        """Build a mechanism from its two arrays of joints; the joints of a side may lie on one line.

        Args:
            base_joints: (3, 2) [m], in {1}.
            platform_joints: (3, 2) [m], in {2}.
            name: for messages and reports.
            home: pose of reference.
            limits: the fields of `Limits`; a stroke of (2,) [m] counts from the home lengths, (3, 2) is absolute.
            plant: parameters of the dynamics by name.
            settings: the tables `control`, `fusion` and `safety`.

        Raises:
            InputError: arrays of the wrong shape or not finite, legs that coincide, joints of a side that are all one
                point, an empty stroke, a limit that is not positive, a stroke about a home that is not given, or a plant
                that makes no sense.
            UnknownNameError: a plant parameter that does not exist.
        """
        base = checked_array(base_joints, (PLANAR_LEGS, 2), "base_joints")
        platform = checked_array(platform_joints, (PLANAR_LEGS, 2), "platform_joints")
        check_legs_differ(base, platform)
        for side, joints in (("base", base), ("platform", platform)):
            apart = float(np.linalg.norm(joints - joints[0], axis=1).max())
            if apart < SAME_JOINT_M:
                raise InputError(
                    f"the {side} joints are all one point, apart by {apart:g} m and not by {SAME_JOINT_M:g} m: move one of them"
                )
        parameters = checked_parameters(plant or {}, PLANAR)
        check_not_derived(parameters, _DERIVED)
        check_drives(parameters)
        made = cls(
            name=name,
            base_joints=base,
            platform_joints=platform,
            home=home,
            limits=None,
            plant=MappingProxyType(parameters),
            settings=MappingProxyType({key: MappingProxyType(dict(table)) for key, table in (settings or {}).items()}),
        )
        if limits is None:
            return made
        lengths = None if home is None else made.lengths_at(home.position, home.angle)
        return replace(made, limits=checked_limits(limits, PLANAR_LEGS, lengths))

    @property
    def stroke(self) -> Array | None:
        """(3, 2), least and greatest length of each leg [m], or None."""
        return None if self.limits is None else self.limits.stroke

    def joints_at(self, position: Array, angle: Array | float) -> Array:
        """The platform joints (..., 3, 2) [m] seen in {1}, at positions (..., 2) [m] and angles (...) [rad] ((1), planar)."""
        cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
        x, y = self.platform_joints.T
        joints: Array = position[..., None, :] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        return joints

    def lengths_at(self, position: Array, angle: Array | float) -> Array:
        """The leg lengths (..., 3) [m] at positions (..., 2) [m] and angles (...) [rad]."""
        lengths: Array = np.linalg.norm(self.joints_at(position, angle) - self.base_joints, axis=-1)
        return lengths


def planar_from_document(document: Mapping[str, Any]) -> PlanarMechanism:
    """A planar mechanism from the content of its TOML file: `name`, `[geometry]` and, for the loop, the tables that a spatial
    one has.

    Raises:
        InputError: an entry that is missing, unknown or of the wrong kind, or the content is not a mechanism.
        UnknownNameError: a plant parameter that does not exist.
    """
    check_tables(document, _TABLES)
    geometry = document.get("geometry", {})
    for array in ("base_joints", "platform_joints"):
        if array not in geometry:
            raise InputError(f"[geometry] lacks {array}, an array of three rows of two numbers in metres")
    home = None
    if "home" in document:
        home = PlanarPose(document["home"].get("position"), document["home"].get("angle", 0.0))
    return PlanarMechanism.from_legs(
        **geometry,
        name=str(document.get("name", "custom")),
        home=home,
        limits=document.get("limits") or None,
        plant=flattened(document.get("plant", {})),
        settings={key: document.get(key, {}) for key in ("control", "fusion", "safety")},
    )


def flattened(tables: Mapping[str, Any], prefix: str = "") -> dict[str, ArrayLike]:
    """Nested tables as one, whose names have dots between those of the tables."""
    flat: dict[str, ArrayLike] = {}
    for key, value in tables.items():
        if isinstance(value, Mapping):
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def check_not_derived(parameters: Mapping[str, Array], derived: Collection[str]) -> None:
    """Check that no plant parameter is given that follows from the rest of a mechanism.

    Raises:
        InputError: one is.
    """
    for name in derived:
        if name in parameters:
            raise InputError(f"the plant's {name} follows from the geometry, the home pose and the limits: leave it out")


def check_drives(parameters: Mapping[str, Array]) -> None:
    """Check that the drives are stable, as far as the plant's parameters tell.

    Raises:
        InputError: they make up for more than a motor's resistance.
    """
    if {"drive.compensation", "drive.nominal_resistance", "motor.resistance"} <= set(parameters):
        made_up = float(parameters["drive.compensation"] * parameters["drive.nominal_resistance"])
        least = float(parameters["motor.resistance"].min())
        if made_up >= least:
            raise InputError(
                f"drive.compensation x nominal_resistance is {made_up:g} Ohm; the drive is stable only below the motors' "
                f"resistance of {least:g} Ohm: choose a smaller compensation"
            )


def check_tables(document: Mapping[str, Any], tables: Mapping[str, Collection[str] | None]) -> None:
    """Check that the document of a mechanism has a name and these tables and nothing else; None allows any entry.

    Raises:
        InputError: an unknown table or entry, or a table that is none.
    """
    for key, table in document.items():
        if key == "name":
            continue
        if key not in tables:
            raise InputError(f"unknown entry {key!r}; a mechanism has name, {', '.join(tables)}, based_on")
        if not isinstance(table, Mapping):
            raise InputError(f"{key!r} must be a table")
        allowed = tables[key]
        unknown = set() if allowed is None else set(table) - set(allowed)
        if allowed is not None and unknown:
            raise InputError(f"[{key}] has no entry {sorted(unknown)[0]!r}; it has {', '.join(sorted(allowed))}")


def check_legs_differ(base: Array, platform: Array) -> None:
    """Check that no two legs share both their joints.

    Raises:
        InputError: names the two legs.
    """
    for leg in range(len(base)):
        for other in range(leg):
            apart = max(np.linalg.norm(base[leg] - base[other]), np.linalg.norm(platform[leg] - platform[other]))
            if apart < SAME_JOINT_M:
                raise InputError(f"legs {other} and {leg} coincide: they share both joints; move one of them")
