"""Rigid-body and drive dynamics of a six-leg mechanism, as CasADi expressions in one set of symbols.

Generalised coordinates are the platform's pose and twist; the legs follow. For a leg with the vector `s = p + R a - b`, the
kinetic energy `T(s, s')` and the potential `V(s)` give `M_s s'' + h = F`. With `s'' = J nu' + J' nu` the platform's equation is
`(M + sum J^T M_s J) nu' = wrench - sum J^T (h + M_s J' nu - F n)`. Pose and twist are those in {1}, which may move itself:
the accelerations that its motion adds are part of h and of the wrench.
"""

import casadi as ca

from plant.dynamics.assembly import Dynamics, Values, assemble, variable_symbols, zeros
from plant.dynamics.base_motion import base_motion
from plant.dynamics.imu_signals import bending_changes, imu_signals_of, leg_frames
from plant.dynamics.legs_and_actuators import (
    SX,
    Condition,
    actuators_at,
    body_constants,
    leg_conditions,
    leg_outputs,
    legs_at,
    length_limits,
    row,
    solve,
)
from plant.dynamics.universal_joint import reach_at
from plant.dynamics.variables import SPATIAL, TINY
from plant.mechanism import LEGS

_ROUNDING = 1e-6
"""Greatest relative error of rounded parameters."""

_NORM_RATE = 5.0
"""The rate at which the quaternion's length returns to one [1/s]."""

_MOST_ALONG_AT_START, _MOST_ALONG = 0.99, 0.9998
"""Cosine between a leg and the first axis of its joint, along which the leg would be singular."""


def build_dynamics() -> Dynamics:
    """Derive the plant's equations."""
    p = variable_symbols(SPATIAL.parameters)
    q = p["initial_quaternion"]
    start = {"state.position": p["initial_position"], "state.quaternion": q / ca.norm_2(q)}
    return assemble(SPATIAL, p, _constants(p), start, _conditions(p), _limits, _plant)


def _rotation(q: SX) -> SX:
    w, x, y, z = ca.vertsplit(q)
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _constants(p: Values) -> Values:
    joints = {name: p[name] for name in ("base_joints", "platform_joints", "base_joint_axes", "base_joint_offset")}
    bodies = body_constants(p, lambda center: ca.dot(center, center) * SX.eye(3) - center @ center.T)
    return joints | bodies | {"axial_inertia": p["leg.lower.axial_inertia"] + p["leg.upper.axial_inertia"]}


def inertia_conditions(inertia: SX, name: str) -> list[Condition]:
    """For an inertia (3, 3) of a real body: it is symmetric, and `tr(I) / 2 E - I`, its second moments, is positive
    semidefinite.
    """
    scale = ca.trace(inertia) + TINY
    moments = (ca.trace(inertia) / 2 * SX.eye(3) - inertia) / scale
    minors = [moments[i, i] for i in range(3)]
    minors += [moments[i, i] * moments[j, j] - moments[i, j] ** 2 for i, j in ((0, 1), (0, 2), (1, 2))]
    return [
        Condition(
            ca.norm_fro(inertia - inertia.T) / scale,
            _ROUNDING,
            f"{name} is not symmetric (relative difference %g, at most %g): make it so",
        ),
        Condition(
            -ca.mmin(ca.vertcat(*minors, ca.det(moments))),
            _ROUNDING,
            f"{name} is of no real body (its second moments are negative by %g, at most %g): each principal moment must be at "
            "most the sum of the other two",
        ),
    ]


def _conditions(p: Values) -> list[Condition]:
    q = p["initial_quaternion"]
    conditions = [
        Condition(
            ca.fabs(ca.dot(q, q) - 1), 2e-3, "initial_quaternion is not of unit length (its square is off by %g, at most %g)"
        ),
        *inertia_conditions(p["platform.inertia"], "platform.inertia"),
        *inertia_conditions(p["payload.inertia"], "payload.inertia"),
    ]
    vectors = _leg_vectors(p["initial_position"], _rotation(q / ca.norm_2(q)), p)
    conditions += leg_conditions(p, ca.vertcat(*[ca.norm_2(s) for s in vectors]))
    for k, s in enumerate(vectors):
        axis = row(p["base_joint_axes"], k)
        conditions += [
            Condition(
                ca.fabs(ca.dot(axis, axis) - 1),
                2e-3,
                f"base_joint_axes of leg {k} is not of unit length (its square is off by %g, at most %g)",
            ),
            Condition(
                ca.fabs(ca.dot(axis, s)) / ca.norm_2(s),
                _MOST_ALONG_AT_START,
                f"leg {k} starts along its base_joint_axes (cosine %g, at most %g): turn the axis",
            ),
        ]
    return conditions


def _leg_vectors(position: SX, rotation: SX, joints: Values) -> list[SX]:
    """From second axis of base joint to platform joint, (3, 1) each."""
    vectors = []
    for k in range(LEGS):
        whole = position + rotation @ row(joints["platform_joints"], k) - row(joints["base_joints"], k)
        vectors.append(reach_at(whole, SX.zeros(3), row(joints["base_joint_axes"], k), joints["base_joint_offset"][k]).s)
    return vectors


def _limits(x: Values, c: Values) -> list[Condition]:
    vectors = _leg_vectors(x["state.position"], _rotation(x["state.quaternion"]), c)
    limits = length_limits(ca.vertcat(*[ca.norm_2(s) for s in vectors]))
    for k, s in enumerate(vectors):
        along = ca.fabs(ca.dot(row(c["base_joint_axes"], k), s)) / ca.norm_2(s)
        text = f"leg {k} has come to lie along the first axis of its base joint (cosine %g, at most %g): limit its stroke"
        limits.append(Condition(along, _MOST_ALONG, text))
    return limits


def _plant(x: Values, u: Values, c: Values) -> tuple[Values, Values]:
    rotation = _rotation(x["state.quaternion"])
    position, velocity, omega = x["state.position"], x["state.velocity"], x["state.angular_velocity"]
    base = base_motion(u, c)
    gravity = base.gravity
    moment = rotation @ c["first_moment"]
    inertia = rotation @ c["inertia"] @ rotation.T
    legs = legs_at(position, rotation, velocity, omega, base, c)
    actuators = actuators_at(legs, x, u, c)
    forces = actuators.force

    # Twist and acceleration in a frame that moves with the base's origin, but does not turn.
    whole_velocity, whole_omega = velocity + ca.cross(base.omega, position), omega + base.omega
    carried = base.acceleration(position, velocity)
    carried_angular = base.alpha + ca.cross(base.omega, omega)
    linear, coupling, angular = c["mass"] * SX.eye(3), ca.skew(moment), inertia
    external = ca.vertcat(u["external_wrench.force"], u["external_wrench.torque"])
    wrench = external + ca.vertcat(
        c["mass"] * (gravity - carried)
        - ca.cross(whole_omega, ca.cross(whole_omega, moment))
        - ca.cross(carried_angular, moment),
        ca.cross(moment, gravity - carried) - ca.cross(whole_omega, inertia @ whole_omega) - inertia @ carried_angular,
    )
    for k, leg in enumerate(legs):
        turned = ca.skew(leg.arm) @ leg.mass
        linear += leg.mass
        coupling += turned
        angular -= turned @ ca.skew(leg.arm)
        force = forces[k] * leg.direction - leg.force - leg.mass @ leg.bias
        wrench += ca.vertcat(force, ca.cross(leg.arm, force))
    acceleration = solve(ca.blockcat([[linear, coupling.T], [coupling, angular]]), wrench)

    frames = leg_frames(legs, acceleration, base, c)
    bend = bending_changes(legs, frames, x, c)
    lengthening = ca.vertcat(*[leg.length_acceleration(acceleration) for leg in legs])
    w, q1, q2, q3 = ca.vertsplit(x["state.quaternion"])
    ox, oy, oz = ca.vertsplit(omega)
    quaternion_rate = 0.5 * ca.vertcat(
        -q1 * ox - q2 * oy - q3 * oz,
        w * ox + oy * q3 - oz * q2,
        w * oy + oz * q1 - ox * q3,
        w * oz + ox * q2 - oy * q1,
    )
    # In Model Exchange the length may drift, and the equations would take that for another rotation.
    quaternion_rate += _NORM_RATE * (1 - ca.dot(x["state.quaternion"], x["state.quaternion"])) * x["state.quaternion"]
    rates = {
        "state.position": velocity,
        "state.quaternion": quaternion_rate,
        "state.velocity": acceleration[:3],
        "state.angular_velocity": acceleration[3:],
        "state.current": actuators.current_rate,
        "state.brake_deflection": actuators.brake_rate,
        "state.bending": x["state.bending_rate"],
        "state.bending_rate": bend,
        "state.play": actuators.play.speed,
        "state.play_velocity": actuators.play_velocity_rate(lengthening, c),
    }
    bending = x["state.bending"], x["state.bending_rate"], bend
    imu = imu_signals_of(frames, bending, rotation, omega, acceleration, ca.vertcat(carried, carried_angular), base, c)
    outputs = {
        "position": position,
        "quaternion": x["state.quaternion"],
        "velocity": velocity,
        "angular_velocity": omega,
        "kinetic_energy": (
            c["mass"] * ca.dot(whole_velocity, whole_velocity) / 2
            + ca.dot(whole_velocity, ca.cross(whole_omega, moment))
            + ca.dot(whole_omega, inertia @ whole_omega) / 2
            + sum(leg.kinetic for leg in legs)
            + actuators.kinetic(c)
        ),
        "potential_energy": -ca.dot(gravity, c["mass"] * position + moment) + sum(leg.potential for leg in legs),
        "power.external": ca.dot(external, ca.vertcat(velocity, omega)),
    }
    return rates, imu | base.imu_signals(c["base_imu_position"]) | leg_outputs(legs, actuators, x) | outputs


def imu_signals(position: SX, rotation: SX, velocity: SX, omega: SX, acceleration: SX, parameters: Values) -> Values:
    """Ideal IMU signals (7, 3) by name, for a motion of {2} in {1}, which rests.

    Its rotation is (3, 3), its acceleration (6, 1), of the origin and then angular; the other arguments are (3, 1).
    """
    c = _constants(parameters)
    base = base_motion(zeros(SPATIAL.inputs), c)
    legs = legs_at(position, rotation, velocity, omega, base, c)
    straight = (SX.zeros(len(legs), 2),) * 3
    frames = leg_frames(legs, acceleration, base, c)
    return imu_signals_of(frames, straight, rotation, omega, acceleration, SX.zeros(6), base, c)
