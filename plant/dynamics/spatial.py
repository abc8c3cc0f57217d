"""Rigid-body and drive dynamics of a six-leg mechanism, as CasADi expressions in one set of symbols.

Generalised coordinates are the platform's pose and twist; the legs follow. With the leg vector `s = p + R a - b` of each
leg, its kinetic energy `T(s, s')` and potential `V(s)` give `M_s s'' + h = F`, and `s'' = J nu' + J' nu` carries that to
the platform:  `(M + sum J^T M_s J) nu' = wrench - sum J^T (h + M_s J' nu - F n)`.

The legs and their actuators are those of `plant.dynamics.legs`. Nothing here is integrated: the FMU's C code does that.
"""

from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca

from plant.dynamics.legs import (
    SX,
    Condition,
    Leg,
    actuators_at,
    imu_signals_of,
    leg_conditions,
    leg_constants,
    legs_at,
    length_limits,
    lengths_of,
    row,
    solve,
    speeds_of,
    stack,
)
from plant.dynamics.variables import SPATIAL, TINY, Variable, VariableTable
from plant.mechanism import LEGS


@dataclass(frozen=True)
class Dynamics:
    """A plant as CasADi functions of flat vectors in the order of its variable table.

    `constants(parameters)` is what the others need of the parameters, worked out once; `start(parameters)` are the states
    at the start; `conditions(parameters)` are two vectors, values and the limits that they must not exceed for the
    parameters to make sense, and `condition_texts` say so of each; `limits(states, constants)` and `limit_texts` are the
    same for the motion; `rates(states, inputs, constants)` is the time derivative of the states; `outputs(states, inputs,
    constants)` all outputs.
    """

    constants: ca.Function
    start: ca.Function
    conditions: ca.Function
    condition_texts: tuple[str, ...]
    limits: ca.Function
    limit_texts: tuple[str, ...]
    rates: ca.Function
    outputs: ca.Function


def build_dynamics() -> Dynamics:
    """Derive the plant's equations."""
    p = variable_symbols(SPATIAL.parameters)
    return assembled(SPATIAL, p, _constants(p), _start(p), _conditions(p), _limits, _plant)


def assembled(
    table: VariableTable,
    parameters: dict[str, SX],
    constants: dict[str, SX],
    start: dict[str, SX],
    conditions: list[Condition],
    limits: Callable[[dict[str, SX], dict[str, SX]], list[Condition]],
    plant: Callable[[dict[str, SX], dict[str, SX], dict[str, SX]], tuple[dict[str, SX], dict[str, SX]]],
) -> Dynamics:
    """The functions of a plant from its expressions.

    Args:
        table: its variables.
        parameters: their symbols, of which the next three are made.
        constants: by any names.
        start: the states at the start, by name.
        conditions: for the parameters to make sense.
        limits: gives the conditions on the motion for states and constants by name.
        plant: gives rates and outputs by name for states, inputs and constants by name.
    """
    # The symbols stand for the worked-out constants inside `rates` and `outputs`.
    stand_ins = {name: SX.sym(name, *value.shape) for name, value in constants.items()}
    states, inputs = variable_symbols(table.states), variable_symbols(table.inputs)
    rates, outputs = plant(states, inputs, stand_ins)
    arguments = [_flat(states), _flat(inputs), _flat(stand_ins)]
    given = [_flat(parameters)]
    options = {"cse": True}
    watched = limits(states, stand_ins)
    return Dynamics(
        constants=ca.Function("plant_constants", given, [_flat(constants)], options),
        start=ca.Function("plant_start", given, [_in_order(start, table.states)], options),
        conditions=ca.Function("plant_conditions", given, _sides(conditions), options),
        condition_texts=tuple(condition.text for condition in conditions),
        limits=ca.Function("plant_limits", [_flat(states), _flat(stand_ins)], _sides(watched), options),
        limit_texts=tuple(condition.text for condition in watched),
        rates=ca.Function("plant_rates", arguments, [_in_order(rates, table.states)], options),
        outputs=ca.Function("plant_outputs", arguments, [_in_order(outputs, table.outputs)], options),
    )


def _sides(conditions: list[Condition]) -> list[SX]:
    values = [ca.densify(ca.vertcat(*side)) for side in zip(*((c.value, c.limit) for c in conditions), strict=True)]
    return values or [SX.zeros(0), SX.zeros(0)]


def variable_symbols(variables: tuple[Variable, ...]) -> dict[str, SX]:
    """A symbol for each variable, in its shape."""
    made = {}
    for variable in variables:
        rows, columns = (*variable.shape, 1, 1)[:2] if variable.shape else (1, 1)
        # CasADi stores columns first and the table rows first, so the symbol is made transposed.
        made[variable.name] = SX.sym(variable.name, columns, rows).T
    return made


def _flat(values: dict[str, SX]) -> SX:
    return ca.vertcat(*[ca.vec(ca.densify(value).T) for value in values.values()])


def _skew(v: SX) -> SX:
    return ca.skew(v)


def _rotation(q: SX) -> SX:
    w, x, y, z = ca.vertsplit(q)
    return ca.vertcat(
        ca.horzcat(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        ca.horzcat(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        ca.horzcat(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def _constants(p: dict[str, SX]) -> dict[str, SX]:
    """What follows from the parameters alone: one rigid body of platform and payload, one set of numbers per leg."""
    masses = (p["platform.mass"], p["payload.mass"])
    centers = (p["platform.center_of_mass"], p["payload.center_of_mass"])
    inertias = (p["platform.inertia"], p["payload.inertia"])
    mass = masses[0] + masses[1]
    first_moment = masses[0] * centers[0] + masses[1] * centers[1]
    inertia = sum(
        (i + m * (ca.dot(c, c) * SX.eye(3) - c @ c.T) for m, c, i in zip(masses, centers, inertias, strict=True)),
        SX.zeros(3, 3),
    )
    joints = {name: p[name] for name in ("base_joints", "platform_joints", "base_joint_axes")}
    return (
        joints
        | leg_constants(p)
        | {
            "mass": mass,
            "first_moment": first_moment,
            "inertia": inertia,
            "axial_inertia": p["leg.lower.axial_inertia"] + p["leg.upper.axial_inertia"],
        }
    )


def _start(p: dict[str, SX]) -> dict[str, SX]:
    """At rest at the initial pose, without current, the brakes not deflected."""
    q = p["initial_quaternion"]
    resting = {variable.name: SX.zeros(variable.size) for variable in SPATIAL.states}
    return resting | {"state.position": p["initial_position"], "state.quaternion": q / ca.norm_2(q)}


def inertia_conditions(inertia: SX, name: str) -> list[Condition]:
    """A symmetric (3, 3) inertia that a body can have: `tr(I) / 2 E - I`, its second moments, is positive semidefinite."""
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


_ROUNDING = 1e-6
"""What rounded parameters may be off by, relatively."""

_NORM_RATE = 5.0
"""How fast the quaternion's length returns to one [1/s]."""

_MOST_ALONG_AT_START, _MOST_ALONG = 0.99, 0.9998
"""Cosine between a leg and the first axis of its joint; at 1 the leg could not turn about itself without infinite inertia."""


def _conditions(p: dict[str, SX]) -> list[Condition]:
    q = p["initial_quaternion"]
    conditions = [
        Condition(
            ca.fabs(ca.dot(q, q) - 1), 2e-3, "initial_quaternion is not of unit length (its square is off by %g, at most %g)"
        ),
        *inertia_conditions(p["platform.inertia"], "platform.inertia"),
        *inertia_conditions(p["payload.inertia"], "payload.inertia"),
    ]
    vectors = _leg_vectors(p["initial_position"], _rotation(q / ca.norm_2(q)), p)
    conditions += leg_conditions(p, stack([ca.norm_2(s) for s in vectors]))
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


def _leg_vectors(position: SX, rotation: SX, joints: dict[str, SX]) -> list[SX]:
    """(3, 1) each, from base to platform joint."""
    return [position + rotation @ row(joints["platform_joints"], k) - row(joints["base_joints"], k) for k in range(LEGS)]


def _limits(x: dict[str, SX], c: dict[str, SX]) -> list[Condition]:
    """What must hold during the motion: no leg of no length, or along the first axis of its joint."""
    vectors = _leg_vectors(x["state.position"], _rotation(x["state.quaternion"]), c)
    limits = length_limits(stack([ca.norm_2(s) for s in vectors]))
    for k, s in enumerate(vectors):
        along = ca.fabs(ca.dot(row(c["base_joint_axes"], k), s)) / ca.norm_2(s)
        text = f"leg {k} has come to lie along the first axis of its base joint (cosine %g, at most %g): limit its stroke"
        limits.append(Condition(along, _MOST_ALONG, text))
    return limits


def _legs(position: SX, rotation: SX, velocity: SX, omega: SX, c: dict[str, SX]) -> list[Leg]:
    joints = (c["base_joints"], c["platform_joints"], c["base_joint_axes"])
    return legs_at(position, rotation, velocity, omega, *joints, c)


def _plant(x: dict[str, SX], u: dict[str, SX], c: dict[str, SX]) -> tuple[dict[str, SX], dict[str, SX]]:
    rotation = _rotation(x["state.quaternion"])
    position, velocity, omega = x["state.position"], x["state.velocity"], x["state.angular_velocity"]
    gravity = c["gravity"]
    moment = rotation @ c["first_moment"]
    inertia = rotation @ c["inertia"] @ rotation.T
    legs = _legs(position, rotation, velocity, omega, c)
    speeds = speeds_of(legs)
    actuators = actuators_at(legs, x, u, c)
    forces = actuators.force

    linear, coupling, angular = c["mass"] * SX.eye(3), _skew(moment), inertia
    external = ca.vertcat(u["external_wrench.force"], u["external_wrench.torque"])
    wrench = external + ca.vertcat(
        c["mass"] * gravity - ca.cross(omega, ca.cross(omega, moment)),
        ca.cross(moment, gravity) - ca.cross(omega, inertia @ omega),
    )
    for k, leg in enumerate(legs):
        turned = _skew(leg.arm) @ leg.mass
        linear += leg.mass
        coupling += turned
        angular -= turned @ _skew(leg.arm)
        force = forces[k] * leg.direction - leg.force - leg.mass @ leg.bias
        wrench += ca.vertcat(force, ca.cross(leg.arm, force))
    acceleration = solve(ca.blockcat([[linear, coupling.T], [coupling, angular]]), wrench)

    w, q1, q2, q3 = ca.vertsplit(x["state.quaternion"])
    ox, oy, oz = ca.vertsplit(omega)
    quaternion_rate = 0.5 * ca.vertcat(
        -q1 * ox - q2 * oy - q3 * oz,
        w * ox + oy * q3 - oz * q2,
        w * oy + oz * q1 - ox * q3,
        w * oz + ox * q2 - oy * q1,
    )
    # An integrator of Model Exchange may let the length drift, which the equations would take for another rotation.
    quaternion_rate += _NORM_RATE * (1 - ca.dot(x["state.quaternion"], x["state.quaternion"])) * x["state.quaternion"]
    rates = {
        "state.position": velocity,
        "state.quaternion": quaternion_rate,
        "state.velocity": acceleration[:3],
        "state.angular_velocity": acceleration[3:],
        "state.current": actuators.current_rate,
        "state.brake_deflection": actuators.brake_rate,
    }
    imu = imu_signals_of(legs, c["base_joint_axes"], rotation, omega, acceleration, c)
    outputs = (
        imu
        | actuators.powers(speeds)
        | {
            "position": position,
            "quaternion": x["state.quaternion"],
            "velocity": velocity,
            "angular_velocity": omega,
            "leg_length": lengths_of(legs),
            "leg_velocity": speeds,
            "current": x["state.current"],
            "voltage": actuators.voltage,
            "kinetic_energy": (
                c["mass"] * ca.dot(velocity, velocity) / 2
                + ca.dot(velocity, ca.cross(omega, moment))
                + ca.dot(omega, inertia @ omega) / 2
                + sum(leg.kinetic for leg in legs)
            ),
            "potential_energy": (-ca.dot(gravity, c["mass"] * position + moment) + sum(leg.potential for leg in legs)),
            "power.external": ca.dot(external, ca.vertcat(velocity, omega)),
        }
    )
    return rates, outputs


def imu_signals(
    position: SX, rotation: SX, velocity: SX, omega: SX, acceleration: SX, parameters: dict[str, SX]
) -> dict[str, SX]:
    """Ideal IMU signals by their names in the table, (7, 3) each, of a platform that moves as given, all seen in {1}.

    Args:
        position, rotation: (3, 1), (3, 3), of {2}.
        velocity, omega: (3, 1), of the origin of {2}, and its angular velocity.
        acceleration: (6, 1), their derivatives.
        parameters: values by name, of all the table's parameters.
    """
    c = _constants(parameters)
    legs = _legs(position, rotation, velocity, omega, c)
    return imu_signals_of(legs, c["base_joint_axes"], rotation, omega, acceleration, c)


def _in_order(values: dict[str, SX], variables: tuple[Variable, ...]) -> SX:
    return _flat({variable.name: values[variable.name] for variable in variables})
