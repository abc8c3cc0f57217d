"""Geometry by a few numbers: mechanisms whose joints stand in three pairs on a circle, of the base and of the platform."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.errors import InputError
from plant.files import check_entries
from plant.mechanism.planar import PlanarMechanism
from plant.mechanism.spatial import LEGS, Mechanism
from plant.pose import Array, checked_array

ENTRIES = ("base_radius", "base_angle", "platform_radius", "platform_angle", "home_height")
"""The numbers: radii [m], half the angles between the two joints of a pair [rad], z of the home position [m]."""
_SAME = 1e-6
"""Radii (as a share) and angles [rad] that differ by less are equal."""


@dataclass(frozen=True, eq=False)
class JointCircle:
    """Six joints in three pairs on a circle across the z axis.

    Attributes:
        center: (3,) [m].
        radius: [m].
        angle: half the angle between the two joints of a pair, seen from the centre [rad].
        middles: (6,), the direction from the centre to the middle of each joint's pair, from the x axis [rad].
        sides: (6,), -1 or 1, the side of the middle on which each joint stands; 0 if the joints of a pair coincide.
    """

    center: Array
    radius: float
    angle: float
    middles: Array
    sides: Array

    @classmethod
    def of(cls, joints: ArrayLike, side: str) -> "JointCircle":
        """The circle of joints (6, 3) [m]; messages call it the circle of `side`.

        Raises:
            InputError: the joints do not stand in three pairs, with equal angles, on such a circle.
        """
        points = checked_array(joints, (LEGS, 3), f"{side}_joints")
        center = points.mean(axis=0)
        arms = points - center
        radii = np.linalg.norm(arms[:, :2], axis=1)
        radius = float(radii.mean())
        if radius <= 0.0 or np.abs([radii - radius, arms[:, 2]]).max() > _SAME * radius:
            raise InputError(
                f"the {side} joints stand on no circle across the z axis (radii {radii.min():.6g} to {radii.max():.6g} m, "
                f"heights {arms[:, 2].min():.3g} to {arms[:, 2].max():.3g} m): vary their entries one by one instead"
            )
        azimuths = np.arctan2(arms[:, 1], arms[:, 0])
        turns = (azimuths - azimuths[:, None] + np.pi) % (2.0 * np.pi) - np.pi  # [i, j]: from joint i to joint j
        apart = np.abs(turns) + 2.0 * np.pi * np.eye(LEGS)
        legs, partners = np.arange(LEGS), apart.argmin(axis=1)
        nearest, second = np.sort(apart, axis=1)[:, :2].T
        if (partners[partners] != legs).any() or np.ptp(nearest) > _SAME or (second - nearest).min() < _SAME:
            raise InputError(
                f"the {side} joints do not stand in three pairs with equal angles: vary their entries one by one instead"
            )
        half = turns[legs, partners] / 2.0
        sides = np.where(np.abs(half) < _SAME, 0.0, -np.sign(half))
        return cls(center, radius, float(nearest.mean()) / 2.0, azimuths + half, sides)

    def joints(self) -> Array:
        """The joints (6, 3) [m].

        Raises:
            InputError: the radius is not positive, or the pairs meet.
        """
        if not 0.0 < self.radius < np.inf:
            raise InputError(f"a radius is {self.radius:g} m; it must be positive")
        apart = np.sort(self.middles % (2.0 * np.pi))
        gaps = np.diff(np.append(apart, apart[0] + 2.0 * np.pi))
        most = float(gaps[gaps > _SAME].min()) / 2.0
        coincide = not self.sides.any()
        if not (0.0 < self.angle < most) and not (coincide and self.angle < _SAME):
            raise InputError(f"half the angle of a pair is {self.angle:g} rad; it must be more than 0 and less than {most:.4g}")
        if coincide and self.angle >= _SAME:
            raise InputError("the joints of a pair coincide, so their angle cannot vary: leave it out")
        azimuths = self.middles + self.sides * self.angle
        return self.center + self.radius * np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros(LEGS)], axis=1)


def shape_of(mechanism: Mechanism | PlanarMechanism) -> dict[str, float]:
    """The numbers of `ENTRIES` that a mechanism has.

    Raises:
        InputError: it is planar, its joints do not stand in pairs on circles, or it has no home.
    """
    (base, platform), home = _circles_and_home(mechanism)
    return dict(zip(ENTRIES, (base.radius, base.angle, platform.radius, platform.angle, float(home[2])), strict=True))


def reshaped(mechanism: Mechanism | PlanarMechanism, shape: Mapping[str, float]) -> tuple[Array, Array, Array]:
    """The joints of base and platform (6, 3) [m], and the home position (3,) [m], of a mechanism with other numbers.

    What is not in `shape` stays as it is.

    Raises:
        InputError: an unknown number, one that makes no sense, or as `shape_of`.
    """
    check_entries(shape, ENTRIES, "the geometry")
    circles, home = _circles_and_home(mechanism)
    base, platform = (
        replace(
            circle,
            radius=float(shape.get(f"{side}_radius", circle.radius)),
            angle=float(shape.get(f"{side}_angle", circle.angle)),
        )
        for side, circle in zip(("base", "platform"), circles, strict=True)
    )
    return base.joints(), platform.joints(), np.append(home[:2], float(shape.get("home_height", home[2])))


def reshaped_entries(mechanism: Mechanism | PlanarMechanism, shape: Mapping[str, float]) -> dict[str, list[Any]]:
    """The same as entries of a mechanism's file, by their names with dots; errors as for `reshaped`."""
    names = ("geometry.base_joints", "geometry.platform_joints", "home.position")
    return {name: array.tolist() for name, array in zip(names, reshaped(mechanism, shape), strict=True)}


def _circles_and_home(mechanism: Mechanism | PlanarMechanism) -> tuple[tuple[JointCircle, JointCircle], Array]:
    if isinstance(mechanism, PlanarMechanism):
        raise InputError(f"{mechanism.name!r} is planar: its joints stand on no circles that could vary")
    circles = JointCircle.of(mechanism.base_joints, "base"), JointCircle.of(mechanism.platform_joints, "platform")
    return circles, mechanism.require_home().position
