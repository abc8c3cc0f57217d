"""Rigid-body and drive dynamics of a planar three-leg mechanism, as CasADi expressions in one set of symbols.

The equations are those of `plant.dynamics.spatial`, with J = [1, e_z x R a]. The legs are in space: the plane is the xy-plane
of {1}, and its normal is the first axis of every leg's joint. The joints bear the forces across the plane. When the base
turns out of the plane, platform and payload count as symmetric about the normal.
"""

import casadi as ca

from plant.dynamics.assembly import Dynamics, Values, assemble, variable_symbols
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
    solve,
)
from plant.dynamics.variables import PLANAR

_NORMAL = SX([0, 0, 1])


def build_dynamics() -> Dynamics:
    """Derive the plant's equations."""
    p = variable_symbols(PLANAR.parameters)
    start = {"state.position": p["initial_position"], "state.angle": p["initial_angle"]}
    return assemble(PLANAR, p, _constants(p), start, _conditions(p), _limits, _plant)


def _constants(p: Values) -> Values:
    joints = {name: p[name] for name in ("base_joints", "platform_joints")}
    centers = [(p[f"{body}.mass"], p[f"{body}.center_of_mass"]) for body in ("platform", "payload")]
    spread = {"centers_spread": sum((mass * center @ center.T for mass, center in centers), SX.zeros(2, 2))}
    return joints | spread | body_constants(p, lambda center: ca.dot(center, center))


def _conditions(p: Values) -> list[Condition]:
    return leg_conditions(p, _lengths(p["initial_position"], p["initial_angle"], p))


def _limits(x: Values, c: Values) -> list[Condition]:
    return length_limits(_lengths(x["state.position"], x["state.angle"], c))


def _lengths(position: SX, angle: SX, c: Values) -> SX:
    legs = (position + _rotation(angle)[:2, :2] @ c["platform_joints"].T).T - c["base_joints"]
    return ca.sqrt(ca.sum2(legs**2))


def _rotation(angle: SX) -> SX:
    cosine, sine = ca.cos(angle), ca.sin(angle)
    return ca.blockcat([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def _in_space(vectors: SX) -> SX:
    """Vectors (n, 2) in the plane, as (n, 3)."""
    return ca.horzcat(vectors, SX(vectors.shape[0], 1))


def _plant(x: Values, u: Values, c: Values) -> tuple[Values, Values]:
    position, velocity, turning = x["state.position"], x["state.velocity"], x["state.angular_velocity"]
    rotation = _rotation(x["state.angle"])
    base = base_motion(u, c)
    in_plane = base.gravity[:2]
    moment = rotation[:2, :2] @ c["first_moment"]
    across = ca.vertcat(-moment[1], moment[0])
    omega = turning * _NORMAL
    joints = {name: _in_space(c[name]) for name in ("base_joints", "platform_joints")}
    c = c | joints | {"base_joint_axes": ca.repmat(_NORMAL.T, 3, 1), "axial_inertia": SX(0)}
    c["base_joint_offset"] = SX.zeros(3)
    place, moving, first_moment = (_in_space(vector.T).T for vector in (position, velocity, moment))
    legs = legs_at(place, rotation, moving, omega, base, c)
    actuators = actuators_at(legs, x, u, c)
    forces = actuators.force

    mass = ca.blockcat([[c["mass"] * SX.eye(2), across], [across.T, c["inertia"]]])
    external = ca.vertcat(u["external_wrench.force"], u["external_wrench.torque"])
    # The acceleration that the base's motion adds is linear in place and velocity: a body feels it by its moments.
    carried = base.acceleration(place, moving)
    carried_force = c["mass"] * carried + base.acceleration(first_moment, ca.cross(omega, first_moment))
    spread = rotation[:2, :2] @ c["centers_spread"] @ rotation[:2, :2].T
    carried_torque = (
        ca.dot(across, carried[:2])
        + c["inertia"] * base.alpha[2]
        + base.omega[0] * base.omega[1] * (spread[0, 0] - spread[1, 1])
        + (base.omega[1] ** 2 - base.omega[0] ** 2) * spread[0, 1]
    )
    wrench = external + ca.vertcat(c["mass"] * in_plane + turning**2 * moment, ca.dot(across, in_plane))
    wrench -= ca.vertcat(carried_force[:2], carried_torque)
    for k, leg in enumerate(legs):
        jacobian = ca.horzcat(SX.eye(2), ca.cross(_NORMAL, leg.arm)[:2])
        leg_mass = leg.mass[:2, :2]
        mass += jacobian.T @ leg_mass @ jacobian
        wrench += jacobian.T @ (forces[k] * leg.direction[:2] - leg.force[:2] - leg_mass @ leg.bias[:2])
    acceleration = solve(mass, wrench)

    in_space = ca.vertcat(acceleration[:2], 0, 0, 0, acceleration[2])
    frames = leg_frames(legs, in_space, base, c)
    bend = bending_changes(legs, frames, x, c)
    lengthening = ca.vertcat(*[leg.length_acceleration(in_space) for leg in legs])
    rates = {
        "state.position": velocity,
        "state.angle": turning,
        "state.velocity": acceleration[:2],
        "state.angular_velocity": acceleration[2],
        "state.current": actuators.current_rate,
        "state.brake_deflection": actuators.brake_rate,
        "state.bending": x["state.bending_rate"],
        "state.bending_rate": bend,
        "state.play": actuators.play.speed,
        "state.play_velocity": actuators.play_velocity_rate(lengthening, c),
    }
    carried = ca.vertcat(carried, base.alpha + ca.cross(base.omega, omega))
    bending = x["state.bending"], x["state.bending_rate"], bend
    imu = imu_signals_of(frames, bending, rotation, omega, in_space, carried, base, c)
    whole_velocity, whole_turning = moving + ca.cross(base.omega, place), turning + base.omega[2]
    outputs = {
        "position": position,
        "angle": x["state.angle"],
        "velocity": velocity,
        "angular_velocity": turning,
        "kinetic_energy": (
            c["mass"] * ca.dot(whole_velocity, whole_velocity) / 2
            + whole_turning * ca.dot(whole_velocity[:2], across)
            + whole_velocity[2] * ca.cross(base.omega, first_moment)[2]
            + c["inertia"] * whole_turning**2 / 2
            + sum(leg.kinetic for leg in legs)
            + actuators.kinetic(c)
        ),
        "potential_energy": -ca.dot(in_plane, c["mass"] * position + moment) + sum(leg.potential for leg in legs),
        "power.external": ca.dot(external, ca.vertcat(velocity, turning)),
    }
    return rates, imu | base.imu_signals(c["base_imu_position"]) | leg_outputs(legs, actuators, x) | outputs
