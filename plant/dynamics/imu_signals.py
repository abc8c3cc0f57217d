"""Ideal IMU signals, and the bending that turns an IMU away from its leg.

A leg rests on its base joint and its platform joint, and bends between them like a beam, in the guide where the rod leaves the
lower part. What bends it is weight and inertia of both parts across the leg. The lower part, which has the IMU, then points
beside the line between the joints: its base joint has turned further, about its first axis e1 and its second axis, the leg's y
axis. These two angles are damped oscillators. What bending does to the forces on the platform is left out.
"""

from dataclasses import dataclass

import casadi as ca

from plant.dynamics.base_motion import BaseMotion
from plant.dynamics.legs_and_actuators import SX, Leg, row


@dataclass(frozen=True)
class LegFrame:
    """A leg's frame at one instant, or that of its lower part: its z axis is along it, its y axis the base joint's second axis.

    `frame` (3, 3) is its rotation to {1}. Angular velocity and acceleration (3, 1) are those in {1}; `felt` (3, 1) is the
    specific force of its origin, which lies on the second axis; all three are seen in {1}.
    """

    e1: SX
    frame: SX
    turning: SX
    angular: SX
    felt: SX
    base: BaseMotion

    @property
    def rate(self) -> SX:
        """The angular velocity on the earth, seen in the frame."""
        return self.frame.T @ (self.turning + self.base.omega)

    def force_at(self, place: SX) -> SX:
        """The specific force of a point of the body, both seen in the frame."""
        angular = self.frame.T @ (self.angular + (self.base.alpha + ca.cross(self.base.omega, self.turning)))
        return ca.cross(angular, place) + ca.cross(self.rate, ca.cross(self.rate, place)) + self.frame.T @ self.felt

    def turned(self, angles: SX, rates: SX, changes: SX) -> "LegFrame":
        """The frame turned further by angles (2, 1) of the base joint, which have these derivatives."""
        cosines, sines = ca.cos(angles), ca.sin(angles)

        def turn(v: SX) -> SX:
            across = ca.cross(self.e1, v)
            return v * cosines[0] + across * sines[0] + self.e1 * (ca.dot(self.e1, v) * (1 - cosines[0]))

        x, y, z = (turn(axis) for axis in ca.horzsplit(self.frame))
        carried = turn(self.turning)
        turning = carried + rates[0] * self.e1 + rates[1] * y
        return LegFrame(
            e1=self.e1,
            frame=ca.horzcat(cosines[1] * x - sines[1] * z, y, sines[1] * x + cosines[1] * z),
            turning=turning,
            angular=(
                turn(self.angular)
                + rates[0] * ca.cross(self.e1, carried)
                + changes[0] * self.e1
                + changes[1] * y
                + rates[1] * ca.cross(turning, y)
            ),
            felt=self.felt,
            base=self.base,
        )


def leg_frames(legs: list[Leg], acceleration: SX, base: BaseMotion, c: dict[str, SX]) -> list[LegFrame]:
    """The frames of the legs for an acceleration (6, 1) of the platform in {1}."""
    frames = []
    for k, leg in enumerate(legs):
        whole, own = leg.accelerations(acceleration)
        e1 = row(c["base_joint_axes"], k)
        # The second axis moves about the first.
        lifted = whole - own + base.acceleration(leg.reach.beyond, leg.reach.beyond_velocity)
        frames.append(LegFrame(e1, *_turning(leg.reach.s, leg.reach.velocity, own, e1), lifted - leg.gravity, base))
    return frames


def bending_changes(legs: list[Leg], frames: list[LegFrame], x: dict[str, SX], c: dict[str, SX]) -> SX:
    """The second derivatives (n, 2) of the bending."""
    pulsation, damping = 2 * ca.pi * c["leg.bending_frequency"], c["leg.bending_damping"]
    off = bending_under_load(legs, frames, c) - x["state.bending"]
    return pulsation**2 * off - 2 * damping * pulsation * x["state.bending_rate"]


def bending_under_load(legs: list[Leg], frames: list[LegFrame], c: dict[str, SX]) -> SX:
    """The bending (n, 2) that weight and inertia hold."""
    along = SX([0, 0, 1])
    low, guide, rows = c["leg.lower.center"], c["leg.guide"], []
    for k, (leg, frame) in enumerate(zip(legs, frames, strict=True)):
        high, rate = leg.length - c["rod_center"], frame.rate
        angular = frame.frame.T @ (frame.angular + (frame.base.alpha + ca.cross(frame.base.omega, frame.turning)))
        on_lower = c["leg.lower.mass"] * ca.cross(along, frame.force_at(low * along))
        on_rod = c["rod_mass"] * ca.cross(along, frame.force_at(high * along) + 2 * leg.speed * ca.cross(rate, along))
        # The platform joint bears what turns the whole leg about its base joint; the rest of the rod's torque bends the guide.
        inertia = c["leg.lower.inertia"] + c["leg.upper.inertia"]
        whole = low * on_lower + high * on_rod + inertia * angular
        share = (leg.length - guide) / leg.length
        torque = (high - guide) * on_rod + c["leg.upper.inertia"] * angular - share * whole
        turned = c["leg.bending_compliance"][k] * share * torque
        # Turning about e1 turns the leg about its own x axis less than about e1.
        rows.append(ca.horzcat(turned[0] / ca.dot(frame.e1, frame.frame[:, 0]), turned[1]))
    return ca.vertcat(*rows)


def _turning(s: SX, velocity: SX, acceleration: SX, e1: SX) -> tuple[SX, SX, SX]:
    """The leg frame (3, 3), and the leg's angular velocity and acceleration (3, 1) in {1}, from the leg vector and its
    derivatives.

    With `h = k q / d`, `k = e1 . s`, `q = e1 . (s x s')` and `d = s . s - k^2 = |s x e1|^2`, the angular velocity of the
    text of `plant.dynamics.legs_and_actuators` is `omega = (s x s' + h s) / (s . s)`.
    """
    square, k = ca.dot(s, s), ca.dot(e1, s)
    across = square - k**2
    # Square roots instead of divisions, as in `plant.dynamics.legs_and_actuators`.
    inverse, inverse_across = ca.sqrt(1 / square), ca.sqrt(1 / across)
    n, e2 = s * inverse, ca.cross(s, e1) * inverse_across
    swing, swing_rate = ca.cross(s, velocity), ca.cross(s, acceleration)
    k_rate, q, q_rate = ca.dot(e1, velocity), ca.dot(e1, swing), ca.dot(e1, swing_rate)
    growth = ca.dot(s, velocity)
    h = k * q * inverse_across**2
    h_rate = (k_rate * q + k * q_rate - 2 * h * (growth - k * k_rate)) * inverse_across**2
    turning = (swing + h * s) * inverse**2
    angular = (swing_rate + h_rate * s + h * velocity - 2 * growth * turning) * inverse**2
    return ca.horzcat(ca.cross(e2, n), e2, n), turning, angular


def imu_signals_of(
    frames: list[LegFrame],
    bending: tuple[SX, SX, SX],
    rotation: SX,
    omega: SX,
    acceleration: SX,
    carried: SX,
    base: BaseMotion,
    c: dict[str, SX],
) -> dict[str, SX]:
    """Ideal IMU signals (n + 1, 3) of legs and platform, by their names in the table.

    Signals of a leg are seen in the frame of its lower part, which is bent by angles (n, 2), given with their two derivatives;
    those of the platform in {2}. The `acceleration` (6, 1) is that of the origin of {2} in {1}, then angular; `carried` (6, 1)
    is what the motion of {1} adds to it.
    """
    signals: list[tuple[SX, SX, SX]] = []
    for k, leg in enumerate(frames):
        lower = leg.turned(*(each[k, :].T for each in bending))
        signals.append((lower.rate, lower.force_at(row(c["leg_imu_position"], k)), lower.frame.T @ base.magnetic_field))
    place = rotation @ c["platform_imu_position"]
    whole, turning = acceleration + carried, omega + base.omega
    at_imu = whole[:3] + ca.cross(whole[3:], place) + ca.cross(turning, ca.cross(turning, place))
    signals.append((rotation.T @ turning, rotation.T @ (at_imu - base.gravity), rotation.T @ base.magnetic_field))
    names = ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field")
    return {name: ca.horzcat(*values).T for name, values in zip(names, zip(*signals, strict=True), strict=True)}
