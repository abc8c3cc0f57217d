"""Planar mechanisms: three legs and three degrees of freedom (the paper's section 6).

Leg k joins base joint k, row k of an array (3, 2) in {1}, and platform joint k, row k of an array (3, 2) in {2}; a shared
joint is a repeated row. A pose is the position (2,) [m] of the origin of {2} in {1} and the counter-clockwise angle [rad]
from {1} to {2}.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.errors import InputError
from plant.pose import Array, checked_array

PLANAR_LEGS = 3
SAME_JOINT_M = 1e-9
"""Joints closer than this are one joint."""

_TABLES = {"geometry": {"base_joints", "platform_joints"}, "limits": {"stroke"}}


@dataclass(frozen=True, eq=False)
class PlanarMechanism:
    """A planar mechanism of three legs, checked when it is built and never changed.

    Attributes:
        name: what it is called in messages and reports.
        base_joints: (3, 2) [m] in {1}.
        platform_joints: (3, 2) [m] in {2}.
        stroke: (3, 2), least and greatest length of each leg [m], or None.
    """

    name: str
    base_joints: Array
    platform_joints: Array
    stroke: Array | None

    @classmethod
    def from_legs(
        cls,
        base_joints: ArrayLike,
        platform_joints: ArrayLike,
        *,
        name: str = "custom",
        stroke: ArrayLike | None = None,
    ) -> "PlanarMechanism":
        """Build a mechanism from its two arrays of joints; the joints of a side may lie on one line.

        Args:
            base_joints: (3, 2) [m], in {1}.
            platform_joints: (3, 2) [m], in {2}.
            name: for messages and reports.
            stroke: (3, 2), least and greatest length of each leg [m].

        Raises:
            InputError: arrays of the wrong shape or not finite, legs that coincide, joints of a side that are all one
                point, or an empty stroke.
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
        return cls(name, base, platform, None if stroke is None else checked_stroke(stroke, PLANAR_LEGS))

    def joints_at(self, position: Array, angle: Array | float) -> Array:
        """The platform joints (..., 3, 2) [m] seen in {1}, at positions (..., 2) [m] and angles (...) [rad] ((1), planar)."""
        cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
        x, y = self.platform_joints.T
        joints: Array = position[..., None, :] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
        return joints


def planar_from_document(document: Mapping[str, Any]) -> PlanarMechanism:
    """A planar mechanism from the content of its TOML file: `name`, `[geometry]` and, if the legs have one, a stroke.

    Raises:
        InputError: an entry that is missing, unknown or of the wrong kind, or the content is not a mechanism.
    """
    check_tables(document, _TABLES)
    geometry = document.get("geometry", {})
    for array in ("base_joints", "platform_joints"):
        if array not in geometry:
            raise InputError(f"[geometry] lacks {array}, an array of three rows of two numbers in metres")
    stroke = document.get("limits", {}).get("stroke")
    return PlanarMechanism.from_legs(**geometry, name=str(document.get("name", "custom")), stroke=stroke)


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


def checked_stroke(value: ArrayLike, legs: int) -> Array:
    """The least and greatest length (legs, 2) [m] of each leg, read-only.

    Raises:
        InputError: wrong shape or not finite, or without 0 < least < greatest length.
    """
    stroke = checked_array(value, (legs, 2), "stroke")
    for leg, (least, greatest) in enumerate(stroke):
        if not 0.0 < least < greatest:
            raise InputError(
                f"the stroke of leg {leg} runs from {least:g} m to {greatest:g} m; it needs 0 < least < greatest length"
            )
    return stroke
