"""A second model of the plant's motion: thirteen free bodies, held together by constraints with Lagrange multipliers.

Platform with payload, six lower parts and six rods each have a place, a quaternion, a velocity and an angular velocity; each
rotor has an angle and a speed. The joints are equations between places and attitudes, which CasADi differentiates; the
equations of motion are Newton's, Euler's and the joints' second derivatives. Nothing is eliminated, no leg's length or
angle is a coordinate, and nothing is shared with `plant.dynamics.spatial`. Brakes and end stops are left out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from plant.dynamics.variables import OPEN
from plant.pose import Array, quaternion_from_rotation
from tests.plant.dynamics.explicit_bodies import leg_frames, leg_vectors

LEGS = 6
BODIES = 1 + 2 * LEGS
LOWER, UPPER = range(1, 1 + LEGS), range(1 + LEGS, BODIES)
PLACES = 7 * BODIES + LEGS
SPEEDS = 6 * BODIES + LEGS
"""Sizes of the coordinates (place and quaternion of each body, rotor angles) and of their velocities."""


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

    Attributes:
        state: coordinates, velocities and motor currents, one vector; at first at rest at the initial pose.
    """

    def __init__(self, parameters: Mapping[str, Array]) -> None:
        self._p = p = parameters
        self._turns = 2 * pi / float(p["motor.screw_lead"])
        self._bodies = [
            _platform(p),
            *[_leg_part(p, "lower", float(p["leg.lower.center"]))] * LEGS,
            *[_leg_part(p, "upper", -float(p["leg.upper.center"]))] * LEGS,
        ]
        rotation = Rotation.from_quat(p["initial_quaternion"], scalar_first=True).as_matrix()
        legs, frames = leg_vectors(p, p["initial_position"], rotation), leg_frames(p, p["initial_position"], rotation)
        origins = [p["initial_position"], *p["base_joints"], *(p["base_joints"] + legs)]
        attitudes = [rotation, *frames, *frames]
        places = [o + a @ b.center for o, a, b in zip(origins, attitudes, self._bodies, strict=True)]
        quaternions = [quaternion_from_rotation(a) for a in attitudes]
        coordinates = np.hstack([np.ravel(places), np.ravel(quaternions), np.zeros(LEGS)])
        self.state = np.hstack([coordinates, np.zeros(SPEEDS + LEGS)])
        self._slides = np.linalg.norm(legs, axis=1)
        self._equations = self._derive()

    def _derive(self) -> ca.Function:
        """Of (state, command, whether driven, wrench): the rates of coordinates and currents, the velocities' rates without
        joints, what the joints' forces add to them, how those rates part the joints in turn, and how far apart these are.
        """
        p, bodies = self._p, self._bodies
        q, v = ca.SX.sym("q", PLACES), ca.SX.sym("v", SPEEDS)
        current, command, wrench = ca.SX.sym("i", LEGS), ca.SX.sym("u", LEGS), ca.SX.sym("w", 6)
        driven = ca.SX.sym("driven")
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
        forces[0] += wrench[:3]
        torques[0] += wrench[3:] - ca.cross(attitudes[0] @ bodies[0].center, wrench[:3])
        joints: list[ca.SX] = []
        for k, (low, up) in enumerate(zip(LOWER, UPPER, strict=True)):
            x, y, z = ca.horzsplit(attitudes[low])
            rod_x, rod_y, rod_z = ca.horzsplit(attitudes[up])
            apart = places[up] - places[low]
            length = ca.dot(z, apart) + float(p["leg.lower.center"]) + float(p["leg.upper.center"])
            joints += [
                # The lower part turns about the base joint, its y axis square to the joint's first axis.
                places[low] - attitudes[low] @ bodies[low].center - p["base_joints"][k],
                ca.dot(p["base_joint_axes"][k], y),
                # The rod slides along it and does not turn in it.
                ca.vertcat(ca.dot(x, apart), ca.dot(y, apart), ca.dot(x, rod_y), ca.dot(y, rod_z), ca.dot(z, rod_x)),
                # A spherical joint ties the rod to the platform, and a screw the rotor to the rod.
                places[up] - attitudes[up] @ bodies[up].center
                - places[0] - attitudes[0] @ (p["platform_joints"][k] - bodies[0].center),
                (length - self._slides[k]) * self._turns - q[7 * BODIES + k],
            ]  # fmt: skip
            speed = ca.jtimes(length, q, coordinate_rates)
            lost = p["friction.viscous"][k] * speed + p["friction.coulomb"][k] * speed / ca.sqrt(
                speed**2 + float(p["friction.velocity"]) ** 2
            )
            forces[up] = forces[up] - lost * z
            forces[low] = forces[low] + lost * z
        inverse = ca.diagcat(
            *[np.eye(3) / b.mass for b in bodies],
            *[a @ np.linalg.inv(b.inertia) @ a.T for a, b in zip(attitudes, bodies, strict=True)],
            np.eye(LEGS) / float(p["motor.rotor_inertia"]),
        )
        constant = float(p["motor.torque_constant"])
        applied = ca.vertcat(*forces, *torques, constant * current)
        closure = ca.vertcat(*joints)
        closing_speed = ca.jtimes(closure, q, coordinate_rates)
        limit = float(p["drive.voltage_limit"])
        asked = constant * self._turns * command + float(p["drive.compensation"] * p["drive.nominal_resistance"]) * current
        voltage = ca.fmax(ca.fmin(asked, limit), -limit)
        current_rates = driven * (voltage - p["motor.resistance"] * current - constant * rotors) / float(p["motor.inductance"])
        joints = ca.jacobian(closing_speed, v)
        responses = inverse @ joints.T
        bias = ca.jtimes(closing_speed, q, coordinate_rates)
        return ca.Function(
            "maximal",
            [ca.vertcat(q, v, current), command, driven, wrench],
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

    def rates(self, state: Array, command: Array, modes: Array, wrench: Array) -> Array:
        """The time derivative of the state, the joints' forces solved for; drives are all open or all driven."""
        values = self._equations(state, command, float((modes != OPEN).all()), wrench)
        coordinate_rates, current_rates, free, responses, mobility, parting = (value.full() for value in values[:6])
        acceleration = free - responses @ np.linalg.solve(mobility, parting)
        return np.vstack([coordinate_rates, acceleration, current_rates]).ravel()

    def go_on(self, duration: float, command: Array, modes: Array, wrench: Array) -> None:
        """Integrate with held inputs by an adaptive method of eighth order."""
        arguments = (command, modes, wrench)
        end = solve_ivp(
            lambda _, state: self.rates(state, *arguments),
            (0.0, duration), self.state, method="DOP853", rtol=1e-11, atol=1e-12, t_eval=[duration],
        )  # fmt: skip
        self.state = end.y[:, -1]

    def gap(self) -> float:
        """How far the joints have come apart [m and rad; the rotors' in turns of the screw]."""
        zeros = np.zeros(LEGS)
        return float(np.abs(self._equations(self.state, zeros, 0.0, zeros)[6].full()).max())

    def attitude(self, body: int) -> Array:
        """The rotation (3, 3) of a body's frame to {1}."""
        at = 3 * BODIES + 4 * body
        return Rotation.from_quat(self.state[at : at + 4], scalar_first=True).as_matrix()

    def outputs(self, command: Array, modes: Array, wrench: Array) -> dict[str, Array]:
        """What the plant puts out of the same names."""
        rates = self.rates(self.state, command, modes, wrench)
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
        return {
            "position": self.state[:3] - rotation @ center,
            "quaternion": quaternion_from_rotation(rotation),
            "angular_velocity": spin[0],
            "current": self.state[-LEGS:],
            "imu_angular_velocity": np.array(rate),
            "imu_specific_force": np.array(force),
        }
