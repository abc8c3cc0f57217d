"""A second model of the plant's motion: thirteen free bodies, held together by constraints with Lagrange multipliers.

Platform with payload, six lower parts and six rods each have a place, a quaternion, a velocity and an angular velocity; each
rotor has an angle and a speed. The joints are equations between places and attitudes, which CasADi differentiates; the
equations of motion are Newton's, Euler's and the joints' second derivatives. Nothing is eliminated, no leg's length or
angle is a coordinate, and nothing is shared with `plant.dynamics.spatial`. All is seen from the earth: a base that moves
carries its joints along, as a function of time. The second axis of a base joint may lie beyond the first, a screw may have
play, and a leg may bend: its rod then turns in the guide of the lower part against a spring. Brakes and end stops are left out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import pi

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import OPEN
from plant.pose import Array, quaternion_from_rotation
from tests.plant.dynamics.explicit_bodies import leg_frames, leg_vectors, play, second_axes

LEGS = 6
BODIES = 1 + 2 * LEGS
LOWER, UPPER = range(1, 1 + LEGS), range(1 + LEGS, BODIES)
PLACES = 7 * BODIES + LEGS
SPEEDS = 6 * BODIES + LEGS
"""Sizes of the coordinates (place and quaternion of each body, rotor angles) and of their velocities."""


Base = Callable[[ca.SX], tuple[ca.SX, ca.SX]]
"""Place (3, 1) of the origin of {1} on the earth, and the rotation (3, 3) from {1} to the earth, against time [s]."""


def still(_: ca.SX) -> tuple[ca.SX, ca.SX]:
    """A base at rest."""
    return ca.SX.zeros(3), ca.SX.eye(3)


class MovingBase:
    """A base's motion against time, by CasADi's derivatives: what the plant takes as inputs, by name."""

    def __init__(self, base: Base) -> None:
        t = ca.SX.sym("t")
        place, turn = base(t)
        rate, speed = ca.jacobian(ca.vec(turn), t), ca.jacobian(place, t)
        skew = turn.T @ ca.reshape(rate, 3, 3)
        omega = ca.vertcat(skew[2, 1], skew[0, 2], skew[1, 0])
        values = [place, turn, speed, omega, ca.jacobian(omega, t), turn.T @ ca.jacobian(speed, t)]
        self._at = ca.Function("base", [t], [ca.densify(value) for value in values])

    def _values(self, t: float) -> list[Array]:
        return [value.full() if value.shape[1] > 1 else value.full().ravel() for value in self._at(t)]

    def place(self, t: float) -> tuple[Array, Array, Array, Array]:
        """Place, rotation, velocity on the earth and angular velocity in {1}."""
        place, turn, speed, omega = self._values(t)[:4]
        return place, turn, speed, omega

    def inputs(self, t: float) -> dict[str, Array]:
        """The inputs of the plant."""
        _, turn, _, omega, alpha, acceleration = self._values(t)
        return {
            "base_motion.rotation": Rotation.from_matrix(turn).as_rotvec(),
            "base_motion.angular_velocity": omega,
            "base_motion.angular_acceleration": alpha,
            "base_motion.acceleration": acceleration,
        }


@dataclass(frozen=True)
class Body:
    """Mass [kg], inertia (3, 3) [kg m^2] about the centre of mass in the body's frame, and where the centre lies (3,) [m]
    from the platform's origin, the base joint or the platform joint.
    """

    mass: float
    inertia: Array
    center: Array


def _platform(p: Mapping[str, Array]) -> Body:
    parts = [(float(p[f"{name}.mass"]), p[f"{name}.inertia"], p[f"{name}.center_of_mass"]) for name in ("platform", "payload")]
    mass = sum(m for m, _, _ in parts)
    center = sum(m * c for m, _, c in parts) / mass
    inertia = sum(i + m * ((c - center) @ (c - center) * np.eye(3) - np.outer(c - center, c - center)) for m, i, c in parts)
    return Body(mass, inertia, center)


def _leg_part(p: Mapping[str, Array], part: str, center: float) -> Body:
    across, axial = p[f"leg.{part}.inertia"], p[f"leg.{part}.axial_inertia"]
    return Body(float(p[f"leg.{part}.mass"]), np.diag([across, across, axial]), np.array([0.0, 0.0, center]))


def _rotation(q: ca.SX) -> ca.SX:
    return (q[0] ** 2 - ca.dot(q[1:], q[1:])) * ca.SX.eye(3) + 2 * q[1:] @ q[1:].T + 2 * q[0] * ca.skew(q[1:])


class MaximalModel:
    """The equations of one mechanism, whose parameters are given by name, and their integration.

    Springs in the guides of legs that bend have a damping [N m s/rad].

    Attributes:
        state: coordinates, velocities and motor currents, one vector; at first at rest in {1} at the initial pose.
        time: [s].
    """

    def __init__(self, parameters: Mapping[str, Array], base: Base = still, bending_damping: float = 0.0) -> None:
        self._p = p = parameters
        self._bending_damping = bending_damping
        self._base, self._moving, self.time = base, MovingBase(base), 0.0
        self._turns = 2 * pi / float(p["motor.screw_lead"])
        self._bodies = [
            _platform(p),
            *[_leg_part(p, "lower", float(p["leg.lower.center"]))] * LEGS,
            *[_leg_part(p, "upper", -float(p["leg.upper.center"]))] * LEGS,
        ]
        rotation = Rotation.from_quat(p["initial_quaternion"], scalar_first=True).as_matrix()
        legs, frames = leg_vectors(p, p["initial_position"], rotation), leg_frames(p, p["initial_position"], rotation)
        axes = second_axes(p, p["initial_position"], rotation)
        origins = [p["initial_position"], *axes, *(axes + legs)]
        attitudes = [rotation, *frames, *frames]
        origin, turn, speed, omega = self._moving.place(0.0)
        spin = turn @ omega
        arms = [turn @ (o + a @ b.center) for o, a, b in zip(origins, attitudes, self._bodies, strict=True)]
        quaternions = [quaternion_from_rotation(turn @ a) for a in attitudes]
        coordinates = np.hstack([np.ravel(origin + arms), np.ravel(quaternions), np.zeros(LEGS)])
        speeds = np.hstack([np.ravel(speed + np.cross(spin, arms)), np.tile(spin, BODIES), np.zeros(LEGS)])
        self.state = np.hstack([coordinates, speeds, np.zeros(LEGS)])
        self._slides = np.linalg.norm(legs, axis=1)
        self._equations = self._derive()

    def _derive(self) -> ca.Function:
        """Of (state, command, whether driven, wrench, time): the rates of coordinates and currents, the velocities' rates
        without joints, what the joints' forces add to them, how those rates part the joints in turn, and how far apart
        these are.
        """
        p, bodies = self._p, self._bodies
        q, v = ca.SX.sym("q", PLACES), ca.SX.sym("v", SPEEDS)
        current, command, wrench = ca.SX.sym("i", LEGS), ca.SX.sym("u", LEGS), ca.SX.sym("w", 6)
        driven, time = ca.SX.sym("driven"), ca.SX.sym("t")
        origin, turn = self._base(time)
        force, torque = turn @ wrench[:3], turn @ wrench[3:]
        places, quaternions = ca.horzsplit(ca.reshape(q[: 3 * BODIES], 3, BODIES)), ca.reshape(q[3 * BODIES : -LEGS], 4, BODIES)
        attitudes = [_rotation(quaternions[:, k]) for k in range(BODIES)]
        moves = ca.horzsplit(ca.reshape(v[: 3 * BODIES], 3, BODIES))
        spins = ca.horzsplit(ca.reshape(v[3 * BODIES : -LEGS], 3, BODIES))
        rotors = v[-LEGS:]
        quaternion_rates = [
            ca.vertcat(-ca.dot(w, quaternions[1:, k]), quaternions[0, k] * w + ca.cross(w, quaternions[1:, k])) / 2
            for k, w in enumerate(spins)
        ]
        coordinate_rates = ca.vertcat(*moves, *quaternion_rates, rotors)

        forces = [b.mass * p["gravity"] for b in bodies]
        tensors = [a @ b.inertia @ a.T for a, b in zip(attitudes, bodies, strict=True)]
        torques = [-ca.cross(w, t @ w) for w, t in zip(spins, tensors, strict=True)]
        forces[0] += force
        torques[0] += torque - ca.cross(attitudes[0] @ bodies[0].center, force)
        joints: list[ca.SX] = []
        on_rotors: list[ca.SX] = []
        for k, (low, up) in enumerate(zip(LOWER, UPPER, strict=True)):
            x, y, z = ca.horzsplit(attitudes[low])
            rod_x, rod_y, rod_z = ca.horzsplit(attitudes[up])
            first = turn @ p["base_joint_axes"][k]
            beyond = float(p["base_joint_offset"][k]) * ca.cross(first, y)
            guide = places[low] + attitudes[low] @ (np.array([0.0, 0.0, float(p["leg.guide"])]) - bodies[low].center)
            apart = places[up] - guide
            length = ca.dot(rod_z, apart) + float(p["leg.guide"]) + float(p["leg.upper.center"])
            joints += [
                # The lower part turns about the second axis of the base joint, which turns about the first and is its y axis.
                places[low] - attitudes[low] @ bodies[low].center - origin - turn @ p["base_joints"][k] - beyond,
                ca.dot(first, y),
                # The rod slides through the guide and does not turn in it.
                ca.vertcat(ca.dot(rod_x, apart), ca.dot(rod_y, apart), ca.dot(x, rod_y)),
                # A spherical joint ties the rod to the platform.
                places[up] - attitudes[up] @ bodies[up].center
                - places[0] - attitudes[0] @ (p["platform_joints"][k] - bodies[0].center),
            ]  # fmt: skip
            bend = float(p["leg.bending_compliance"][k])
            if bend > 0.0:
                across = ca.cross(z, rod_z)
                rate = spins[up] - spins[low]
                spring = -across / bend - self._bending_damping * (rate - ca.dot(rate, rod_z) * rod_z)
                torques[up] = torques[up] + spring
                torques[low] = torques[low] - spring
            else:
                joints.append(ca.vertcat(ca.dot(y, rod_z), ca.dot(z, rod_x)))
            speed = ca.jtimes(length, q, coordinate_rates)
            extension = length - self._slides[k]
            motor, motor_speed = q[7 * BODIES + k] / self._turns, rotors[k] / self._turns
            if width := float(play(p)[k]):
                # The rotor pushes the rod by either flank of its screw.
                ahead, faster = motor - extension, motor_speed - speed
                damping = float(p["screw.damping"]) * faster
                push = float(p["screw.stiffness"]) * (
                    ca.fmax(ahead - width / 2, 0) * ca.fmax(1 + damping, 0)
                    - ca.fmax(-ahead - width / 2, 0) * ca.fmax(1 - damping, 0)
                )
                forces[up] = forces[up] + push * rod_z
                forces[low] = forces[low] - push * rod_z
                torques[low] = torques[low] - ca.cross(guide - places[low], push * rod_z)
                on_rotors.append(-push / self._turns)
            else:
                # A screw ties the rotor to the rod.
                joints.append((extension - motor) * self._turns)
                on_rotors.append(ca.SX(0))
            speed = motor_speed if width else speed
            lost = p["friction.viscous"][k] * speed + p["friction.coulomb"][k] * speed / ca.sqrt(
                speed**2 + float(p["friction.velocity"]) ** 2
            )
            if width:
                on_rotors[k] -= lost / self._turns
                continue
            forces[up] = forces[up] - lost * rod_z
            forces[low] = forces[low] + lost * rod_z
            torques[low] = torques[low] + ca.cross(guide - places[low], lost * rod_z)
        inverse = ca.diagcat(
            *[np.eye(3) / b.mass for b in bodies],
            *[a @ np.linalg.inv(b.inertia) @ a.T for a, b in zip(attitudes, bodies, strict=True)],
            np.eye(LEGS) / float(p["motor.rotor_inertia"]),
        )
        constant = float(p["motor.torque_constant"])
        applied = ca.vertcat(*forces, *torques, constant * current + ca.vertcat(*on_rotors))
        closure = ca.vertcat(*joints)
        moving, rates = ca.vertcat(q, time), ca.vertcat(coordinate_rates, 1)
        closing_speed = ca.jtimes(closure, moving, rates)
        limit = float(p["drive.voltage_limit"])
        asked = p["drive.gain"] * constant * self._turns * command
        asked += float(p["drive.compensation"] * p["drive.nominal_resistance"]) * current
        voltage = ca.fmax(ca.fmin(asked, limit), -limit)
        current_rates = driven * (voltage - p["motor.resistance"] * current - constant * rotors) / float(p["motor.inductance"])
        joints = ca.jacobian(closing_speed, v)
        responses = inverse @ joints.T
        bias = ca.jtimes(closing_speed, moving, rates)
        return ca.Function(
            "maximal",
            [ca.vertcat(q, v, current), command, driven, wrench, time],
            [
                coordinate_rates,
                current_rates,
                inverse @ applied,
                ca.densify(responses),
                ca.densify(joints @ responses),
                bias + joints @ inverse @ applied,
                closure,
            ],
            {"cse": True},
        )

    def rates(self, state: Array, command: Array, modes: Array, wrench: Array, time: float) -> Array:
        """The time derivative of the state, the joints' forces solved for; drives are all open or all driven."""
        values = self._equations(state, command, float((modes != OPEN).all()), wrench, time)
        coordinate_rates, current_rates, free, responses, mobility, parting = (value.full() for value in values[:6])
        acceleration = free - responses @ np.linalg.solve(mobility, parting)
        return np.vstack([coordinate_rates, acceleration, current_rates]).ravel()

    def go_on(self, duration: float, command: Array, modes: Array, wrench: Array, tolerance: float = 1e-11) -> None:
        """Integrate with held inputs by an adaptive method of eighth order, with a relative tolerance."""
        end = self.time + duration
        solution = solve_ivp(
            lambda t, state: self.rates(state, command, modes, wrench, t),
            (self.time, end), self.state, method="DOP853", rtol=tolerance, atol=0.1 * tolerance, t_eval=[end],
        )  # fmt: skip
        self.state, self.time = solution.y[:, -1], end

    def gap(self) -> float:
        """How far the joints have come apart [m and rad; the rotors' in turns of the screw]."""
        zeros = np.zeros(LEGS)
        return float(np.abs(self._equations(self.state, zeros, 0.0, zeros, self.time)[6].full()).max())

    def attitude(self, body: int) -> Array:
        """The rotation (3, 3) of a body's frame to the earth."""
        at = 3 * BODIES + 4 * body
        return Rotation.from_quat(self.state[at : at + 4], scalar_first=True).as_matrix()

    def outputs(self, command: Array, modes: Array, wrench: Array) -> dict[str, Array]:
        """What the plant puts out of the same names."""
        rates = self.rates(self.state, command, modes, wrench, self.time)
        moves, spins = (rates[PLACES + at : PLACES + at + 3 * BODIES].reshape(BODIES, 3) for at in (0, 3 * BODIES))
        spin = self.state[PLACES + 3 * BODIES : PLACES + 6 * BODIES].reshape(BODIES, 3)
        rotation = self.attitude(0)
        center = self._bodies[0].center
        p = self._p
        imu_places = [*p["leg_imu_position"] - [0.0, 0.0, float(p["leg.lower.center"])], p["platform_imu_position"] - center]
        rate, force = [], []
        for body, place in zip([*LOWER, 0], imu_places, strict=True):
            to_sensor = self.attitude(body).T
            arm = to_sensor.T @ place
            acceleration = moves[body] + np.cross(spins[body], arm) + np.cross(spin[body], np.cross(spin[body], arm))
            rate.append(to_sensor @ spin[body])
            force.append(to_sensor @ (acceleration - p["gravity"]))
        origin, turn, _, omega = self._moving.place(self.time)
        return {
            "position": turn.T @ (self.state[:3] - rotation @ center - origin),
            "quaternion": quaternion_from_rotation(turn.T @ rotation),
            "angular_velocity": turn.T @ spin[0] - omega,
            "current": self.state[-LEGS:],
            "imu_angular_velocity": np.array(rate),
            "imu_specific_force": np.array(force),
            "imu_magnetic_field": np.array([self.attitude(body).T @ p["magnetic_field"] for body in [*LOWER, 0]]),
        }
