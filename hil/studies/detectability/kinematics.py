"""What the IMUs and the legs do while the platform moves: exact kinematics of a mechanism, in NumPy.

This is code of its own, on purpose: it shares nothing with the loop's filters, whose figures it bounds. From the vector of a
leg in its joint's frame, s = L (sin b, -sin a cos b, cos a cos b), follow the angles a and b of its universal joint with two
derivatives, from these the angular velocity and acceleration in the leg's frame, and the specific force at the IMU. A base that
moves adds what it gives to a point that is fixed in {1}, and the Coriolis acceleration.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from controller.direct_kinematics.lengths import poses_from_lengths
from controller.planning.offline_planner import plan
from controller.planning.segments import lengths_along
from controller.planning.target import Target
from plant.compiled import Record
from plant.dynamics.base_course import base_motions_at
from plant.mechanism import Mechanism
from plant.pose import Array

POSE = 6
"""Position and rotation vector of a pose error."""

JET = 3 * POSE
"""A pose error, its rate and its second derivative."""

BASE_JET = 9
"""Errors of the base's angular velocity, angular acceleration and specific force."""

_DIFFERENCE_S = 1e-4

_PLANNED_S = 2e-3
"""Between two poses of a planned motion."""


@dataclass(frozen=True)
class BaseMotion:
    """How {1} moves at N times, seen in {1}: (N, 3) each. The specific force is that of a body at rest in its origin."""

    angular_velocity: Array
    angular_acceleration: Array
    specific_force: Array

    def shifted(self, jet: Array) -> "BaseMotion":
        """The motion with errors (9,)."""
        turning, hurry, force = jet.reshape(-1, 3)
        return BaseMotion(self.angular_velocity + turning, self.angular_acceleration + hurry, self.specific_force + force)


@dataclass(frozen=True)
class Motion:
    """The platform's motion in {1} at N times: (N, 3) each, the rotation (N, 3, 3) maps {2} to {1}. {1} may move itself."""

    position: Array
    rotation: Array
    velocity: Array
    angular_velocity: Array
    acceleration: Array
    angular_acceleration: Array
    base: BaseMotion | None = None

    @property
    def unknowns(self) -> int:
        """The number of its errors."""
        return JET if self.base is None else JET + BASE_JET

    def part(self, steps: slice) -> "Motion":
        """The motion at some of the times."""
        base = self.base and BaseMotion(*(each[steps] for each in vars(self.base).values()))
        return replace(self, **{name: each[steps] for name, each in vars(self).items() if name != "base"}, base=base)

    def shifted(self, jet: Array) -> "Motion":
        """The motion with a pose error (18,) that changes: `exp(error) rotation`, and its two derivatives to first order; with
        those of the base's motion (9,), if it moves, behind it.
        """
        position, rotation, velocity, turning, acceleration, hurry = jet[:JET].reshape(POSE, 3)
        omega = self.angular_velocity
        return Motion(
            self.position + position,
            Rotation.from_rotvec(rotation).as_matrix() @ self.rotation,
            self.velocity + velocity,
            omega + turning + np.cross(rotation, omega),
            self.acceleration + acceleration,
            self.angular_acceleration + hurry + np.cross(turning, omega) + np.cross(rotation, self.angular_acceleration),
            self.base and self.base.shifted(jet[JET:]),
        )


class Signals(NamedTuple):
    """What K IMUs measure on n legs, the platform and, if it moves, the base, without any error; and where the IMUs are."""

    angular_velocity: Array  # (N, K, 3) [rad/s], in each IMU's axes
    specific_force: Array  # (N, K, 3) [m/s^2], likewise
    lengths: Array  # (N, n) [m]
    leg_rates: Array  # (N, n) [m/s]
    axes: Array  # (N, K, 3, 3), from each IMU's axes to {1}
    places: Array  # (N, K, 3) [m], in {1}
    velocities: Array  # (N, K, 3) [m/s], in {1}

    def data(self) -> Array:
        """(N, 6 K + n): angular velocity and specific force IMU by IMU, then the rates of the legs."""
        imus = np.concatenate([self.angular_velocity, self.specific_force], axis=2).reshape(len(self.leg_rates), -1)
        return np.concatenate([imus, self.leg_rates], axis=1)


def motion_along(target: Target, mechanism: Mechanism, times: Array) -> Motion:
    """A target's motion at increasing times (N,) [s], through a spline with four continuous derivatives; before 0 it stands at
    the start.

    Raises:
        GoughError: the target holds its poses, and the loop's planner finds no way between them.
    """
    if target.held:
        target = _as_planned(target, mechanism, float(times[-1]))
    home = mechanism.require_home()
    turns = Rotation.from_matrix(target.rotations @ home.rotation.T).as_rotvec()
    spline = make_interp_spline(target.times, np.hstack([target.positions, turns]), k=5)
    velocity, acceleration = spline.derivative(1), spline.derivative(2)

    def turning(at: Array) -> Array:
        """The angular velocity of a rotation vector: phi' + b phi x phi' + c phi x (phi x phi')."""
        phi, rate = spline(at)[:, 3:], velocity(at)[:, 3:]
        angle = np.maximum(np.linalg.norm(phi, axis=1, keepdims=True), 1e-4)
        across = np.cross(phi, rate)
        b, c = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
        omega: Array = rate + b * across + c * np.cross(phi, across)
        return omega

    at, moving = np.maximum(times, 0.0), (times > 0.0)[:, None]
    hurry = (turning(at + _DIFFERENCE_S) - turning(at - _DIFFERENCE_S)) / (2.0 * _DIFFERENCE_S)
    return Motion(
        spline(at)[:, :3],
        Rotation.from_rotvec(spline(at)[:, 3:]).as_matrix() @ home.rotation,
        velocity(at)[:, :3] * moving,
        turning(at) * moving,
        acceleration(at)[:, :3] * moving,
        hurry * moving,
    )


def _as_planned(target: Target, mechanism: Mechanism, end: float) -> Target:
    """The poses through which the loop's planner goes between those that a target holds, until after `end` [s]."""
    times = np.arange(0.0, max(end, 0.0) + 6.0 * _PLANNED_S, _PLANNED_S)
    lengths = np.empty((len(times), mechanism.legs))
    lengths_along(plan(mechanism, target, float(times[-1])).segments, times, lengths)
    positions, rotations = poses_from_lengths(mechanism, lengths, target.start)
    return replace(target, times=times, positions=positions, rotations=rotations, held=False)


def base_motion_along(motions: Sequence[Record], mechanism: Mechanism, times: Array) -> BaseMotion:
    """The motion of a base under motions (dtype `plant.dynamics.base_course.BASE_MOTION`) at times (N,) [s]."""
    turn, omega, alpha, acceleration = np.moveaxis(base_motions_at(motions, times).reshape(-1, 4, 3), 1, 0)
    gravity = mechanism.plant["gravity"] @ Rotation.from_rotvec(turn).as_matrix()
    return BaseMotion(omega, alpha, acceleration - gravity)


def signals(mechanism: Mechanism, motion: Motion) -> Signals:
    """The signals along a motion."""
    arms = np.einsum("nij,kj->nki", motion.rotation, mechanism.platform_joints)
    omega, alpha = motion.angular_velocity[:, None], motion.angular_acceleration[:, None]
    turned = np.cross(omega, arms)
    s = motion.position[:, None] + arms - mechanism.base_joints
    ds = motion.velocity[:, None] + turned
    dds = motion.acceleration[:, None] + np.cross(alpha, arms) + np.cross(omega, np.cross(omega, arms))
    lengths = np.linalg.norm(s, axis=2)
    rates = np.sum(s * ds, axis=2) / lengths
    axes, leg_omega, leg_alpha = _universal_joints(mechanism.joint_rotations, s, ds, dds)

    platform = motion.rotation[:, None]
    axes = np.concatenate([axes, platform], axis=1)
    own_omega = np.concatenate([leg_omega, _seen(platform, omega)], axis=1)
    own_alpha = np.concatenate([leg_alpha, _seen(platform, alpha)], axis=1)
    levers = np.vstack([mechanism.plant["leg_imu_position"], mechanism.plant["platform_imu_position"]])
    # Of the points about which the IMUs turn, the base joints stand still.
    origin = np.zeros((len(s), mechanism.legs + 1, 3))
    origin[:, :-1] = mechanism.base_joints
    origin[:, -1] = motion.position
    moving, speeding = np.zeros_like(origin), np.zeros_like(origin)
    moving[:, -1], speeding[:, -1] = motion.velocity, motion.acceleration
    speeding -= mechanism.plant["gravity"]
    force = _seen(axes, speeding) + np.cross(own_alpha, levers) + np.cross(own_omega, np.cross(own_omega, levers))
    places = origin + np.einsum("nkij,kj->nki", axes, levers)
    velocities = moving + np.einsum("nkij,nkj->nki", axes, np.cross(own_omega, levers))
    still = Signals(own_omega, force, lengths, rates, axes, places, velocities)
    return still if motion.base is None else _on_moving_base(mechanism, motion.base, still)


def _on_moving_base(mechanism: Mechanism, base: BaseMotion, still: Signals) -> Signals:
    """The signals on a base that moves, from those on one that stands still."""
    gravity, zero = mechanism.plant["gravity"], np.zeros((len(still.lengths), 1, 3))
    place = zero + mechanism.plant_parameters()["base_imu_position"]
    places, velocities = np.concatenate([still.places, place], axis=1), np.concatenate([still.velocities, zero], axis=1)
    axes = np.concatenate([still.axes, np.broadcast_to(np.eye(3), (len(zero), 1, 3, 3))], axis=1)
    omega, alpha, force = (each[:, None] for each in vars(base).values())
    added = force + gravity + np.cross(alpha, places) + np.cross(omega, np.cross(omega, places) + 2.0 * velocities)
    return still._replace(
        angular_velocity=np.concatenate([still.angular_velocity, zero], axis=1) + _seen(axes, omega),
        specific_force=np.concatenate([still.specific_force, zero - gravity], axis=1) + _seen(axes, added),
        axes=axes,
        places=places,
        velocities=velocities,
    )


def sensitivity(mechanism: Mechanism, motion: Motion, data: Callable[[Signals], Array] = Signals.data) -> Array:
    """The derivative (N, m, 18) of data (N, m) of the signals with respect to a pose error and its two derivatives, by central
    differences; on a base that moves (N, m, 27), with respect to the errors of its motion, too.
    """
    derivative = np.empty((len(motion.position), data(signals(mechanism, motion)).shape[1], motion.unknowns))
    for i in range(motion.unknowns):
        step = np.zeros(motion.unknowns)
        step[i] = 1e-5
        ahead, behind = (data(signals(mechanism, motion.shifted(sign * step))) for sign in (1.0, -1.0))
        derivative[:, :, i] = (ahead - behind) / 2e-5
    return derivative


def _seen(axes: Array, vectors: Array) -> Array:
    """Vectors (N, K, 3) of {1} in the axes (N, K, 3, 3)."""
    seen: Array = np.einsum("nkji,nkj->nki", axes, np.broadcast_to(vectors, axes.shape[:3]))
    return seen


def _universal_joints(joints: Array, s: Array, ds: Array, dds: Array) -> tuple[Array, Array, Array]:
    """Axes (N, n, 3, 3) of the legs in {1}, their angular velocity and angular acceleration (N, n, 3) in these axes."""
    (x, y, z), (dx, dy, dz), (ddx, ddy, ddz) = (
        np.moveaxis(np.einsum("kji,nkj->nki", joints, each), 2, 0) for each in (s, ds, dds)
    )
    square = y * y + z * z
    dsquare = 2.0 * (y * dy + z * dz)
    da = (y * dz - dy * z) / square
    dda = (y * ddz - ddy * z - da * dsquare) / square
    height = np.sqrt(square)
    dheight = 0.5 * dsquare / height
    ddheight = (dy * dy + dz * dz + y * ddy + z * ddz - dheight * dheight) / height
    length = x * x + square
    db = (dx * height - x * dheight) / length
    ddb = (ddx * height - x * ddheight - 2.0 * db * (x * dx + height * dheight)) / length
    sa, ca, sb, cb = -y / height, z / height, x / np.sqrt(length), height / np.sqrt(length)
    zero = np.zeros_like(sa)
    turns = np.stack([cb, zero, sb, sa * sb, ca, -sa * cb, -ca * sb, sa, ca * cb], axis=-1).reshape(*sa.shape, 3, 3)
    omega = np.stack([da * cb, db, da * sb], axis=-1)
    alpha = np.stack([dda * cb - da * db * sb, ddb, dda * sb + da * db * cb], axis=-1)
    return joints @ turns, omega, alpha
