"""What limits a pose besides the strokes, all optional: how far the joints swing, and how thick legs and plates are.

Of a planar mechanism, points and directions have two numbers in a file; here they have three.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from plant.errors import InputError
from plant.files import check_entries
from plant.pose import Array, checked_array, checked_unit, numbers

MOST_M = 1.0
"""The largest plausible diameter, thickness and clearance."""
LARGEST_PLATE_M = 10.0


@dataclass(frozen=True, eq=False)
class Joints:
    """How far the joints of n legs swing: each leg stays within a cone about an axis, at its base and at its platform joint.

    Attributes:
        base_swing, platform_swing: (n,), the greatest angle between leg and axis [rad]; inf is no limit.
        base_axes, platform_axes: (n, 3), unit, in {1} and in {2}, from the base to the platform.
    """

    base_swing: Array
    platform_swing: Array
    base_axes: Array
    platform_axes: Array


@dataclass(frozen=True, eq=False)
class Plate:
    """A round plate, in the frame of its side: centre (3,) [m], unit normal (3,), radius [m] and thickness [m]."""

    center: Array
    normal: Array
    radius: float
    thickness: float = 0.0


@dataclass(frozen=True, eq=False)
class Bodies:
    """The bodies that must not touch: n legs from joint to joint, and plates.

    Attributes:
        leg_diameter: (n,) [m].
        leg_ends: (2,), how far from the base joint, and from the platform joint, a leg has no body [m].
        clearance: least distance between two bodies [m].
        base_plate, platform_plate: in {1} and in {2}, or None.
    """

    leg_diameter: Array
    leg_ends: Array
    clearance: float
    base_plate: Plate | None
    platform_plate: Plate | None


def checked_swings(table: Mapping[str, Any] | None, directions: Array, rotation: Array, planar: bool) -> Joints | None:
    """The table `[joints]` of a file; None without one.

    Args:
        directions: (n, 3), of the legs at home, in {1}: the axes that are not given.
        rotation: (3, 3), at home.

    Raises:
        InputError: an unknown entry, an angle out of range, an axis that is no unit vector, or a home outside a cone.
    """
    if not table:
        return None
    check_entries(table, [each.name for each in fields(Joints)], "[joints]")
    legs, found = len(directions), {}
    for side, at_home in (("base", directions), ("platform", directions @ rotation)):
        swing, axes = f"{side}_swing", f"{side}_axes"
        found[swing] = _by_leg(table.get(swing, np.full(legs, np.pi)), legs, swing)
        for leg, angle in enumerate(found[swing]):
            if not 0.0 < angle <= np.pi:
                raise InputError(
                    f"the {swing} of leg {leg} is {angle:g} rad; it must be positive and at most {np.pi:.3f} rad: angles are "
                    f"in radians, so write {np.radians(angle):.3g} for {angle:g} deg"
                )
        found[axes] = _vectors(table[axes], legs, axes, planar) if axes in table else at_home
        for leg in range(legs):
            checked_unit(found[axes][leg], 3, f"{axes}[{leg}]")
        found[axes] = found[axes] / np.linalg.norm(found[axes], axis=1, keepdims=True)
        angles = np.arccos(np.clip(np.sum(found[axes] * at_home, axis=1), -1.0, 1.0))
        worst = int(np.argmax(angles - found[swing]))
        if angles[worst] > found[swing][worst]:
            raise InputError(
                f"at home leg {worst} is {angles[worst]:.3g} rad from the axis of its {side} joint, which swings "
                f"{found[swing][worst]:.3g} rad: turn {axes}[{worst}], which points from the base to the platform, or widen "
                f"{swing}"
            )
        if swing not in table:
            found[swing] = np.full(legs, np.inf)
    return Joints(**found)


def checked_bodies(table: Mapping[str, Any] | None, legs: int, planar: bool) -> Bodies | None:
    """The table `[bodies]` of a file; None without one.

    Raises:
        InputError: an unknown entry, no diameter, or a size out of range.
    """
    if not table:
        return None
    check_entries(table, [each.name for each in fields(Bodies)], "[bodies]")
    if "leg_diameter" not in table:
        raise InputError("[bodies] lacks leg_diameter, one number or one for each leg, in metres")
    diameter = _by_leg(table["leg_diameter"], legs, "leg_diameter")
    for leg, size in enumerate(diameter):
        _check_size(f"the diameter of leg {leg}", size, 0.0)
    ends = checked_array(table.get("leg_ends", (0.0, 0.0)), (2,), "leg_ends")
    clearance = float(checked_array(table.get("clearance", 0.0), (), "clearance"))
    for name, size in (("leg_ends[0]", ends[0]), ("leg_ends[1]", ends[1]), ("clearance", clearance)):
        _check_size(name, size)
    plates = {name: _plate(table[name], name, planar) if name in table else None for name in ("base_plate", "platform_plate")}
    return Bodies(diameter, ends, clearance, **plates)


def swing_entries(joints: Joints | None, planar: bool) -> dict[str, Any]:
    """The entries of `[joints]` in a file."""
    if joints is None:
        return {}
    axes = slice(2 if planar else 3)
    entries: dict[str, Any] = {}
    for side in ("base", "platform"):
        swing = getattr(joints, f"{side}_swing")
        if np.isfinite(swing).all():
            entries |= {f"{side}_swing": swing, f"{side}_axes": getattr(joints, f"{side}_axes")[:, axes]}
    return entries


def body_tables(bodies: Bodies | None, planar: bool) -> dict[str, dict[str, Any]]:
    """The table `[bodies]` of a file, and those of its plates."""
    if bodies is None:
        return {}
    axes = slice(2 if planar else 3)
    tables = {"bodies": {"leg_diameter": bodies.leg_diameter, "leg_ends": bodies.leg_ends, "clearance": bodies.clearance}}
    for name, plate in (("base_plate", bodies.base_plate), ("platform_plate", bodies.platform_plate)):
        if plate is not None:
            place = {"center": plate.center[axes], "normal": plate.normal[axes]}
            tables[f"bodies.{name}"] = {**place, "radius": plate.radius, "thickness": plate.thickness}
    return tables


def _plate(table: Any, name: str, planar: bool) -> Plate:
    if not isinstance(table, Mapping):
        raise InputError(f"{name} must be a table with center, normal, radius and thickness")
    check_entries(table, [each.name for each in fields(Plate)], f"[bodies.{name}]")
    for entry in ("center", "radius", *(("normal",) if planar else ())):
        if entry not in table:
            raise InputError(f"[bodies.{name}] lacks its {entry}")
    center = _vectors([table["center"]], 1, f"{name}.center", planar)[0]
    normal = _vectors([table.get("normal", (0.0, 0.0, 1.0))], 1, f"{name}.normal", planar)[0]
    radius, thickness = (float(checked_array(table.get(each, 0.0), (), f"{name}.{each}")) for each in ("radius", "thickness"))
    _check_size(f"{name}.radius", radius, 0.0, LARGEST_PLATE_M)
    _check_size(f"{name}.thickness", thickness)
    return Plate(center, checked_unit(normal, 3, f"{name}.normal"), radius, thickness)


def _by_leg(value: Any, legs: int, name: str) -> Array:
    """One number, or one for each leg, as (legs,)."""
    given = numbers(value, name, f"() or ({legs},)")
    return checked_array(np.full(legs, given) if given.ndim == 0 else given, (legs,), name)


def _vectors(value: Any, count: int, name: str, planar: bool) -> Array:
    """Rows of three numbers, or of two in the plane, as (count, 3)."""
    rows = checked_array(value, (count, 2 if planar else 3), name)
    return np.pad(rows, ((0, 0), (0, 3 - rows.shape[1])))


def _check_size(name: str, size: float, least: float | None = None, most: float = MOST_M) -> None:
    """Check that a size [m] is at least 0, or more than `least`, and not in another unit."""
    if (size < 0.0 if least is None else size <= least) or size > most:
        raise InputError(
            f"{name} is {size:g} m; it must be {'at least 0' if least is None else 'positive'} and at most {most:g} m: write "
            "0.03 for 30 mm"
        )
