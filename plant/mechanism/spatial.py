"""Mechanisms in space: geometry, limits, and the data of plant and controller for one rig.

Leg k joins base joint k, row k of an array (6, 3) in {1}, and platform joint k, row k of an array (6, 3) in {2}; a
shared joint is a repeated row. The two arrays alone are enough for kinematics.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from plant.checks import checked_seed
from plant.dynamics.variables import PLANAR, SPATIAL, TINY, VariableTable, checked_parameters
from plant.errors import InputError, UnreachableError
from plant.mechanism.bodies import Bodies, Joints, checked_bodies, checked_swings
from plant.mechanism.checks import (
    DERIVED,
    SAME_JOINT_M,
    Limits,
    check_legs_differ,
    check_room,
    check_size,
    checked_joints,
    checked_limits,
    checked_plant,
    read_only,
)
from plant.mechanism.loads import check_reach
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import (
    Array,
    Pose,
    checked_array,
    checked_rotation,
    checked_unit,
    quaternion_from_rotation,
    rotation_from_vector,
)

LEGS = 6


def six_rows(values: Array, filling: ArrayLike = 0.0) -> Array:
    """Values by leg (n, ...) as an array of six rows; `filling` fills the rows of missing legs."""
    rows: Array = np.empty((LEGS, *values.shape[1:]))
    rows[: len(values)], rows[len(values) :] = values, filling
    return rows


_NOMINAL_HEIGHT = 7.0 / 6.0
"""Height of a nominal home, as a multiple of the base's radius."""

_BUILDING = 1
"""Separates the joint errors from everything else that a seed draws."""


@dataclass(frozen=True, eq=False)
class Mechanism:
    """A mechanism of n = 6 legs, or a planar one of n = 3 seen in space; checked when it is built, then read-only.

    Attributes:
        name: for messages and reports.
        base_joints: (n, 3) [m] in {1}.
        platform_joints: (n, 3) [m] in {2}.
        base_joint_axes: (n, 3), unit; the first axis of each universal joint, fixed in the base. At rest the axis of
            leg k is perpendicular to the leg's home direction.
        home_directions: (n, 3), unit; the leg directions at home, which span the leg frames together with the axes.
        up_in_base: (3,), unit; the vertical seen in {1}.
        home: the pose that strokes and targets are measured from, or None.
        limits: the actuators' limits, or None.
        plant: parameters of the dynamics by the names of `plant.dynamics.variables`.
        settings: the tables `control`, `fusion` and `safety`, which the controller reads.
        joints: how far the joints swing, or None.
        bodies: legs and plates that must not touch, or None.
    """

    name: str
    base_joints: Array
    platform_joints: Array
    base_joint_axes: Array
    home_directions: Array
    up_in_base: Array
    home: Pose | None
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
        up_in_base: ArrayLike = (0.0, 0.0, 1.0),
        base_joint_axes: ArrayLike | None = None,
        home: Pose | None = None,
        limits: Mapping[str, Any] | None = None,
        plant: Mapping[str, ArrayLike] | None = None,
        settings: Mapping[str, Mapping[str, Any]] | None = None,
        joints: Mapping[str, Any] | None = None,
        bodies: Mapping[str, Any] | None = None,
    ) -> "Mechanism":
        """Build a mechanism from its two arrays of joints; everything else is optional.

        Args:
            base_joints, platform_joints: (6, 3) [m].
            name, up_in_base, plant, settings: as the attributes.
            base_joint_axes: by default e_z x (home direction).
            home: without it, `nominal_home` defines the default axes but no length.
            limits: the fields of `Limits`; a stroke of (2,) [m] counts from the home lengths, (6, 2) is absolute.
            joints, bodies: the entries of these tables in a file (docs/mechanism.md).

        Raises:
            InputError: geometry, a limit or a parameter that makes no sense, or for a run no room about home or limits
                that the drives do not reach.
            UnknownNameError: a plant parameter that does not exist.
        """
        base, platform = checked_joints(base_joints, platform_joints, (LEGS, 3))
        _check_spread(base, platform)
        if home is not None:
            home = Pose(checked_array(home.position, (3,), "home.position"), checked_rotation(home.rotation, "home.rotation"))
            check_size(
                "home.position is {:g} m from the middle of the base", float(np.linalg.norm(home.position - base.mean(axis=0)))
            )
        up = checked_unit(up_in_base, 3, "up_in_base")
        directions = _home_directions(base, platform, home, up)
        parameters = checked_plant(plant, SPATIAL)
        _check_bodies(parameters, up)
        lengths = None if home is None else np.linalg.norm(home.position + platform @ home.rotation.T - base, axis=1)
        return cls(
            name=name,
            base_joints=base,
            platform_joints=platform,
            base_joint_axes=_joint_axes(base_joint_axes, directions),
            home_directions=directions,
            up_in_base=up,
            home=home,
            limits=None if limits is None else checked_limits(limits, LEGS, lengths),
            plant=parameters,
            settings=read_only(settings),
            joints=checked_swings(joints, directions, np.eye(3) if home is None else home.rotation, planar=False),
            bodies=checked_bodies(bodies, LEGS, planar=False),
        )._fit_to_run()

    @classmethod
    def from_planar(cls, planar: PlanarMechanism) -> "Mechanism":
        """A planar mechanism in space: it moves in the xy-plane of {1}, whose normal is the first axis of every joint.

        Raises:
            InputError: it has no home pose, or a leg has no length at home.
        """
        if planar.home is None:
            raise InputError(f"the mechanism {planar.name!r} has no home pose: give one")
        home = Pose(np.append(planar.home.position, 0.0), rotation_from_vector([0.0, 0.0, planar.home.angle]))
        base, platform = (np.pad(joints, ((0, 0), (0, 1))) for joints in (planar.base_joints, planar.platform_joints))
        up = -planar.plant.get("gravity", np.array([0.0, -1.0, 0.0]))
        return cls(
            name=planar.name,
            base_joints=base,
            platform_joints=platform,
            base_joint_axes=np.tile([0.0, 0.0, 1.0], (PLANAR_LEGS, 1)),
            home_directions=_home_directions(base, platform, home, up),
            up_in_base=up / max(float(np.linalg.norm(up)), TINY),
            home=home,
            limits=planar.limits,
            plant=planar.plant,
            settings=planar.settings,
            joints=planar.joints,
            bodies=planar.bodies,
        )._fit_to_run()

    def _fit_to_run(self) -> "Mechanism":
        """This mechanism. If it has all that a run needs, home and limits must leave room, and the drives must reach them."""
        if self.plant_is_complete and self.home is not None and self.limits is not None:
            arms = self.platform_joints @ self.home.rotation.T
            check_room(self.limits, np.linalg.norm(self.home.position + arms - self.base_joints, axis=1))
            check_reach(self)
        return self

    @property
    def legs(self) -> int:
        """The number of legs, 6 or 3."""
        return len(self.base_joints)

    @property
    def planar(self) -> bool:
        """Whether the platform moves only in the xy-plane of {1}."""
        return self.legs == PLANAR_LEGS

    @property
    def nominal_home(self) -> Pose:
        """Home; without one, a pose without rotation above the base joints."""
        return self.home or _nominal_home(self.base_joints, self.platform_joints, self.up_in_base)

    @property
    def joint_rotations(self) -> Array:
        """(n, 3, 3): the rotation of each joint frame to {1}; x is the joint's first axis, z the component of the home
        direction perpendicular to it. A leg's frame is `joint_rotation @ Rx(a) @ Ry(b)` with the leg along its z axis.
        """
        x = self.base_joint_axes
        z = self.home_directions - np.sum(self.home_directions * x, axis=1, keepdims=True) * x
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
        return np.stack([x, np.cross(z, x), z], axis=2)

    def moved_joints(self, moves: Array) -> "Mechanism":
        """The same mechanism with its base and platform joints moved by (2, n, 3) [m]."""
        base, platform = self.base_joints + moves[0], self.platform_joints + moves[1]
        if not self.planar:
            check_legs_differ(base, platform)
            _check_spread(base, platform)
        return replace(self, base_joints=base, platform_joints=platform)

    def distinct_joints(self) -> NDArray[np.int64]:
        """(2, n): for base and platform, the first leg that shares each leg's joint."""
        joints = np.stack([self.base_joints, self.platform_joints])
        apart = np.linalg.norm(joints[:, :, None] - joints[:, None], axis=3)
        first: NDArray[np.int64] = np.argmax(apart < SAME_JOINT_M, axis=2)
        return first

    def built(self, joint_error: float, seed: int) -> "Mechanism":
        """The mechanism as built, with a normal error of each joint coordinate [m].

        Raises:
            InputError: the joint error is negative, or at least a tenth of the base's radius.
        """
        most = 0.1 * float(np.linalg.norm(self.base_joints - self.base_joints.mean(axis=0), axis=1).max())
        if not 0.0 <= joint_error < most:
            raise InputError(f"the joint error is {1e3 * joint_error:g} mm; it must be at least 0 and below {1e3 * most:g} mm")
        moves = joint_error * np.random.default_rng([checked_seed(seed), _BUILDING]).standard_normal((2, self.legs, 3))
        if self.planar:
            moves[:, :, 2] = 0.0
        return self.moved_joints(np.take_along_axis(moves, self.distinct_joints()[:, :, None], axis=1))

    def check_lengths(self, lengths: Array, what: str) -> None:
        """Check leg lengths (..., n) [m] against the stroke.

        Raises:
            UnreachableError: names the leg furthest outside, its length, and the excess.
            InputError: the mechanism has no stroke.
        """
        stroke = self.require_limits().stroke
        excess = np.maximum(stroke[:, 0] - lengths, lengths - stroke[:, 1]).reshape(-1, self.legs)
        row, leg = np.unravel_index(int(np.argmax(excess)), excess.shape)
        if excess[row, leg] > 0.0:
            length = np.reshape(lengths, (-1, self.legs))[row, leg]
            raise UnreachableError(
                f"{what} needs leg {leg} at {1e3 * length:.2f} mm, {1e3 * excess[row, leg]:.2f} mm outside its stroke of "
                f"{1e3 * stroke[leg, 0]:.2f} to {1e3 * stroke[leg, 1]:.2f} mm: choose a smaller motion"
            )

    def require_home(self) -> Pose:
        """The home pose, or an `InputError`."""
        if self.home is None:
            raise InputError(f"the mechanism {self.name!r} has no home pose: give one")
        return self.home

    def require_limits(self) -> Limits:
        """The actuators' limits, or an `InputError`."""
        if self.limits is None:
            raise InputError(f"the mechanism {self.name!r} has no stroke: give one")
        return self.limits

    def plant_parameters(self, initial: Pose | None = None) -> dict[str, Array]:
        """Every parameter of the plant by name, for a start at the pose `initial` (default: home).

        Raises:
            InputError: the mechanism lacks a parameter of the dynamics.
        """
        start = initial or self.require_home()
        limits = self.require_limits()
        axes = slice(2 if self.planar else 3)
        values: dict[str, ArrayLike] = {
            **{each.name: np.full(each.shape, each.default) for each in self._table.parameters if each.default is not None},
            "base_joints": self.base_joints[:, axes],
            "platform_joints": self.platform_joints[:, axes],
            "base_joint_axes": self.base_joint_axes,
            "stop.minimum_length": limits.stroke[:, 0] - limits.stop_clearance,
            "stop.maximum_length": limits.stroke[:, 1] + limits.stop_clearance,
            "initial_position": start.position[axes],
            "initial_quaternion": quaternion_from_rotation(start.rotation),
            "initial_angle": np.arctan2(start.rotation[1, 0], start.rotation[0, 0]),
            **self.plant,
        }
        if missing := self._lacking():
            raise InputError(f"the mechanism {self.name!r} lacks plant parameters: {', '.join(missing)}")
        return checked_parameters({variable.name: values[variable.name] for variable in self._table.parameters}, self._table)

    @property
    def _table(self) -> VariableTable:
        return PLANAR if self.planar else SPATIAL

    @property
    def plant_is_complete(self) -> bool:
        """Whether home, limits and all parameters of the dynamics are given."""
        return self.home is not None and self.limits is not None and not self._lacking()

    def _lacking(self) -> list[str]:
        """The plant's parameters that follow from nothing."""
        needed = (each.name for each in self._table.parameters if each.default is None)
        return [name for name in needed if name not in {*self.plant, *DERIVED}]


def _check_spread(base: Array, platform: Array) -> None:
    for name, joints in (("base", base), ("platform", platform)):
        spread = np.linalg.svd(joints - joints.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-6 * max(spread[0], SAME_JOINT_M):
            raise InputError(f"the {name} joints all lie on one line: no pose of six legs can be measured or held")


def _check_bodies(parameters: Mapping[str, Array], up: Array) -> None:
    for name in ("platform.inertia", "payload.inertia"):
        inertia = parameters.get(name, np.eye(3))
        if np.abs(inertia - inertia.T).max() > 1e-9 or np.linalg.eigvalsh(inertia).min() < 0.0:
            raise InputError(
                f"{name} {inertia.tolist()} is no inertia: it must be symmetric without negative principal moments"
            )
    gravity = parameters.get("gravity", np.zeros(3))
    size = float(np.linalg.norm(gravity))
    if size > 0.0 and np.linalg.norm(gravity / size + up) > 1e-3:
        raise InputError(f"gravity {gravity.tolist()} does not point against up_in_base {up.tolist()}: make them agree")


def _nominal_home(base: Array, platform: Array, up: Array) -> Pose:
    radius = float(np.linalg.norm(base - base.mean(axis=0), axis=1).max())
    return Pose(base.mean(axis=0) - platform.mean(axis=0) + _NOMINAL_HEIGHT * radius * up, np.eye(3))


def _home_directions(base: Array, platform: Array, home: Pose | None, up: Array) -> Array:
    pose = home or _nominal_home(base, platform, up)
    legs = pose.position + platform @ pose.rotation.T - base
    if home is None:
        legs[np.linalg.norm(legs, axis=1) < SAME_JOINT_M] = up
    lengths = np.linalg.norm(legs, axis=1, keepdims=True)
    if lengths.min() < SAME_JOINT_M:
        raise InputError(f"leg {int(lengths.argmin())} has no length at home: move the home pose")
    directions: Array = legs / lengths
    directions.setflags(write=False)
    return directions


def _joint_axes(given: ArrayLike | None, directions: Array) -> Array:
    if given is None:
        axes = np.cross([0.0, 0.0, 1.0], directions)
        axes[np.linalg.norm(axes, axis=1) < 1e-6] = [1.0, 0.0, 0.0]
    else:
        axes = checked_array(given, (LEGS, 3), "base_joint_axes")
        for leg in range(LEGS):
            checked_unit(axes[leg], 3, f"base_joint_axes[{leg}]")
    unit: Array = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    along = np.abs(np.sum(unit * directions, axis=1))
    if along.max() > 0.99:
        raise InputError(
            f"base_joint_axes[{int(along.argmax())}] lies within 8 deg of its leg at home, where a universal joint is "
            "singular: turn the axis"
        )
    unit.setflags(write=False)
    return unit
