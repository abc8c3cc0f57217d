"""Planar mechanisms: three legs and three degrees of freedom (the paper's section 6).

Leg k joins base joint k, row k of an array (3, 2) in {1}, and platform joint k, row k of an array (3, 2) in {2}; a shared
joint is a repeated row. A pose is the position (2,) [m] of the origin of {2} in {1} and the counter-clockwise angle [rad]
from {1} to {2}.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plant.dynamics.variables import PLANAR
from plant.errors import InputError
from plant.mechanism.bodies import Bodies, Joints, checked_bodies, checked_swings
from plant.mechanism.checks import SAME_JOINT_M, Limits, checked_joints, checked_limits, checked_plant, read_only
from plant.pose import Array, checked_array

PLANAR_LEGS = 3


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """Position (2,) [m] of the origin of {2} in {1}, and angle of {2} against {1}, counter-clockwise [rad].

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
    """A planar mechanism of three legs, checked when it is built and never changed; its attributes are as of `Mechanism`."""

    name: str
    base_joints: Array  # (3, 2) [m] in {1}
    platform_joints: Array  # (3, 2) [m] in {2}
    home: PlanarPose | None
    limits: Limits | None
    plant: Mapping[str, Array]
    settings: Mapping[str, Mapping[str, Any]]
    joints: Joints | None = None
    bodies: Bodies | None = None

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
        joints: Mapping[str, Any] | None = None,
        bodies: Mapping[str, Any] | None = None,
    ) -> "PlanarMechanism":
        """Build a mechanism from its two arrays of joints; the joints of a side may lie on one line.

        Arguments and errors as for `Mechanism.from_legs`, with joints (3, 2) and a stroke (2,) or (3, 2).

        Raises:
            InputError: joints of a side that are all one point, or cones without a home.
        """
        base, platform = checked_joints(base_joints, platform_joints, (PLANAR_LEGS, 2))
        for side, points in (("base", base), ("platform", platform)):
            apart = float(np.linalg.norm(points - points[0], axis=1).max())
            if apart < SAME_JOINT_M:
                raise InputError(
                    f"the {side} joints are all one point, apart by {apart:g} m and not by {SAME_JOINT_M:g} m: move one of them"
                )
        thick = checked_bodies(bodies, PLANAR_LEGS, planar=True)
        made = cls(name, base, platform, home, None, checked_plant(plant, PLANAR), read_only(settings), bodies=thick)
        if joints:
            made = replace(made, joints=made._checked_joints(joints))
        if limits is None:
            return made
        lengths = None if home is None else made.lengths_at(home.position, home.angle)
        return replace(made, limits=checked_limits(limits, PLANAR_LEGS, lengths))

    def _checked_joints(self, joints: Mapping[str, Any]) -> Joints | None:
        if self.home is None:
            raise InputError("[joints] counts from the legs at home, and there is none: give a home pose")
        legs = self.joints_at(self.home.position, self.home.angle) - self.base_joints
        directions = np.pad(legs / np.linalg.norm(legs, axis=1, keepdims=True), ((0, 0), (0, 1)))
        cosine, sine = np.cos(self.home.angle), np.sin(self.home.angle)
        rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return checked_swings(joints, directions, rotation, planar=True)

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
