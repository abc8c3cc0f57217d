"""Rigid-body and drive dynamics of a six-leg mechanism, as CasADi expressions in one set of symbols.

Generalised coordinates are the platform's pose and twist; the legs follow. With the leg vector `s = p + R a - b` of each
leg, its kinetic energy `T(s, s')` and potential `V(s)` give `M_s s'' + h = F`, and `s'' = J nu' + J' nu` carries that to
the platform:  `(M + sum J^T M_s J) nu' = wrench - sum J^T (h + M_s J' nu - F n)`.

A leg is a universal joint (first axis e1 fixed in the base, second e2 = n x e1 / |n x e1|) that carries a lower part and
a rod, both symmetric about the leg's axis n = s / l. Since the leg's angular velocity lies in the plane of e1 and e2,
`omega = n x s' / l + omega_n n` with `omega_n = k e1 . (s x s') / (l (l^2 - k^2))`, k = e1 . s.

Each leg is driven through a screw by a DC motor on an encoderless drive that turns a velocity command u into the voltage
`n k u + kappa R_nominal i`, n = 2 pi / lead. Nothing here is integrated: the FMU's C code does that.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import casadi as ca

from plant.mechanism import LEGS
from plant.variables import BRAKE, OPEN, SPATIAL, TINY, VELOCITY, Variable, VariableTable

SX = ca.SX


@dataclass(frozen=True)
class Condition:
    """`value` must not exceed `limit`; `text` names the value, and what to change."""

    value: SX | float
    limit: SX | float
    text: str


@dataclass(frozen=True)
class Dynamics:
    """A plant as CasADi functions of flat vectors in the order of its variable table.

    `constants(parameters)` is what the others need of the parameters, worked out once; `start(parameters)` are the states
    at the start; `conditions(parameters)` are two vectors, values and the limits that they must not exceed, for the
    parameters to make sense, and `condition_texts` says so for each; `limits(states, constants)` and `limit_texts` are the
    same for the motion; `rates(states, inputs, constants)` is the time
    derivative of the states; `outputs(states, inputs, constants)` all outputs.
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


def _row(matrix: SX, row: int) -> SX:
    return matrix[row, :].T


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
    turns = 2 * pi / p["motor.screw_lead"]
    lower, upper = "leg.lower.", "leg.upper."
    same = (
        "base_joints", "platform_joints", "base_joint_axes", "motor.resistance", "drive.voltage_limit", "drive.current_limit",
        "friction.coulomb", "friction.viscous", "friction.velocity", "brake.stiffness", "brake.damping",
        "stop.minimum_length", "stop.maximum_length", "stop.stiffness", "stop.damping", "gravity", "magnetic_field",
        "leg_imu_position", "platform_imu_position",
    )  # fmt: skip
    return {name: p[name] for name in same} | {
        "mass": mass,
        "first_moment": first_moment,
        "inertia": inertia,
        "axial_inertia": p[lower + "axial_inertia"] + p[upper + "axial_inertia"],
        "transverse_inertia": p[lower + "inertia"] + p[upper + "inertia"] + p[lower + "mass"] * p[lower + "center"] ** 2,
        "lower_moment": p[lower + "mass"] * p[lower + "center"],
        "rod_mass": p[upper + "mass"],
        "rod_center": p[upper + "center"],
        "sliding_mass": p[upper + "mass"] + p["motor.rotor_inertia"] * turns**2,
        "force_constant": turns * p["motor.torque_constant"],
        "compensating_resistance": p["drive.compensation"] * p["drive.nominal_resistance"],
        "inverse_inductance": 1 / p["motor.inductance"],
        "limiter_rate": 1 / p["drive.current_time_constant"],
        "brake_slip": p["brake.force"] / p["brake.stiffness"],
        "release_rate": 1 / p["brake.release_time"],
    }


def _start(p: dict[str, SX]) -> dict[str, SX]:
    """At rest at the initial pose, without current, the brakes not deflected."""
    q = p["initial_quaternion"]
    resting = {variable.name: SX.zeros(variable.size) for variable in SPATIAL.states}
    return resting | {"state.position": p["initial_position"], "state.quaternion": q / ca.norm_2(q)}


_RUNGE_KUTTA_REACH = 2.5
"""The classical Runge-Kutta method is stable for |eigenvalue| x step up to this, wherever the eigenvalue does not grow."""

_CONTACT_REACH = 1.5
"""The same for the end stops, which are not linear; found by 800 random sets of parameters."""


def substep_conditions(p: dict[str, SX], sliding_mass: SX) -> list[Condition]:
    """The substep is short enough for the fastest modes of the legs.

    In coordinates whose squared length is the energy, what dissipates is on the diagonal of the linearised plant and what
    stores is skew, so the larger of the one and the norm of the other bound every eigenvalue; what else moves with a leg
    than its sliding mass only lowers them. A slipping brake forgets its deflection, and an end stop hits, the faster the leg
    runs, which without load is the drive's voltage over its force constant.
    """
    constant = 2 * pi / p["motor.screw_lead"] * p["motor.torque_constant"]
    speed = p["drive.voltage_limit"] / constant
    slope = ca.mmax(p["friction.viscous"] + p["friction.coulomb"] / p["friction.velocity"]) + p["brake.damping"]
    fading = ca.fmax(slope / sliding_mass, ca.mmax(p["motor.resistance"]) / p["motor.inductance"])
    storing = (constant**2 / p["motor.inductance"] + p["brake.stiffness"]) / sliding_mass
    bounce = ca.sqrt(p["stop.stiffness"] / sliding_mass)
    rates = [
        (
            ca.sqrt(fading**2 + storing) / _RUNGE_KUTTA_REACH,
            "motor, friction and brake: motor.resistance / motor.inductance, friction.coulomb / friction.velocity and "
            "brake.damping over the sliding mass, and the square root of brake.stiffness over it",
        ),
        (1 / p["drive.current_time_constant"] / _RUNGE_KUTTA_REACH, "drive.current_time_constant"),
        (1 / p["brake.release_time"] / _RUNGE_KUTTA_REACH, "brake.release_time"),
        (
            speed * p["brake.stiffness"] / p["brake.force"] / _RUNGE_KUTTA_REACH,
            "a slipping brake, brake.stiffness / brake.force",
        ),
        (
            bounce * (1 + p["stop.damping"] * speed) / _CONTACT_REACH,
            "the end stops, the square root of stop.stiffness over the sliding mass, and stop.damping",
        ),
    ]
    return [
        Condition(p["substep"], 1 / rate, f"substep is %g s, and may be at most %g s because of {what}: reduce it")
        for rate, what in rates
    ]


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


def stop_condition(p: dict[str, SX], k: int) -> Condition:
    """The lower end stop of leg k lies below the upper one."""
    return Condition(
        p["stop.minimum_length"][k],
        p["stop.maximum_length"][k],
        f"stop.minimum_length of leg {k} is %g m, beyond its stop.maximum_length of %g m",
    )


_ROUNDING = 1e-6
"""What rounded parameters may be off by, relatively."""

_LEAST_LENGTH_M = 1e-6
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
    rotation = _rotation(q / ca.norm_2(q))
    sliding_mass = p["leg.upper.mass"] + p["motor.rotor_inertia"] * (2 * pi / p["motor.screw_lead"]) ** 2
    for k in range(LEGS):
        axis = _row(p["base_joint_axes"], k)
        s = p["initial_position"] + rotation @ _row(p["platform_joints"], k) - _row(p["base_joints"], k)
        conditions += [
            Condition(
                ca.fabs(ca.dot(axis, axis) - 1),
                2e-3,
                f"base_joint_axes of leg {k} is not of unit length (its square is off by %g, at most %g)",
            ),
            Condition(_LEAST_LENGTH_M, ca.norm_2(s), f"leg {k} needs a length of %g m at the start and has %g m"),
            Condition(
                ca.fabs(ca.dot(axis, s)) / ca.norm_2(s),
                _MOST_ALONG_AT_START,
                f"leg {k} starts along its base_joint_axes (cosine %g, at most %g): turn the axis",
            ),
            stop_condition(p, k),
        ]
    return conditions + substep_conditions(p, sliding_mass)


def _limits(x: dict[str, SX], c: dict[str, SX]) -> list[Condition]:
    """What must hold during the motion: no leg along the first axis of its joint."""
    limits = []
    rotation = _rotation(x["state.quaternion"])
    for k in range(LEGS):
        s = x["state.position"] + rotation @ _row(c["platform_joints"], k) - _row(c["base_joints"], k)
        along = ca.fabs(ca.dot(_row(c["base_joint_axes"], k), s)) / ca.norm_2(s)
        text = f"leg {k} has come to lie along the first axis of its base joint (cosine %g, at most %g): limit its stroke"
        limits.append(Condition(along, _MOST_ALONG, text))
    return limits


@dataclass(frozen=True)
class _Leg:
    """One leg at one instant; vectors (3, 1) seen in {1}.

    `mass` (3, 3) and `force` (3, 1) are M_s and h of the module's text; `arm` leads from the platform's origin to its
    joint, and `bias` is J' nu.
    """

    s: SX
    velocity: SX
    arm: SX
    bias: SX
    length: SX
    speed: SX
    direction: SX
    mass: SX
    force: SX
    kinetic: SX
    potential: SX


def _leg(s: SX, velocity: SX, arm: SX, bias: SX, e1: SX, c: dict[str, SX]) -> _Leg:
    """Lagrange's equations of one leg, its motor included, worked out for its three ways to move.

    Sliding with the mass m, swinging with the transverse inertia I(l), and turning about its axis with the rate
    `w = kappa q`, kappa = k / (l^3 - l k^2), q = (e1 x s) . s', which the universal joint imposes.
    """
    # One square root and no division: CasADi would turn every product with 1 / l into a division of its own.
    square = ca.dot(s, s)
    inverse = ca.sqrt(1 / square)
    length = square * inverse
    n = s * inverse
    speed = ca.dot(n, velocity)
    across = velocity - speed * n
    swing2 = ca.dot(across, across) * inverse**2

    lever = length - c["rod_center"]
    inertia = c["transverse_inertia"] + c["rod_mass"] * lever**2
    inertia_slope = 2 * c["rod_mass"] * lever
    weight_lever = c["lower_moment"] + c["rod_mass"] * lever
    gravity_along = ca.dot(c["gravity"], n)

    k = ca.dot(e1, s)
    inverse_cubic = inverse / (square - k**2)
    kappa = k * inverse_cubic
    kappa_gradient = inverse_cubic**2 * (length * (square + k**2) * e1 - k * (3 * square - k**2) * n)
    turned = ca.cross(e1, s)
    q = ca.dot(turned, velocity)
    kappa_rate = ca.dot(kappa_gradient, velocity)
    axial = c["axial_inertia"]
    gyroscopic = kappa_rate * q * kappa * turned + kappa * q * (
        kappa_rate * turned + 2 * kappa * ca.cross(e1, velocity) - q * kappa_gradient
    )

    swing_mass = inertia * inverse**2
    sliding_mass = c["sliding_mass"]
    return _Leg(
        s=s,
        velocity=velocity,
        arm=arm,
        bias=bias,
        length=length,
        speed=speed,
        direction=n,
        mass=swing_mass * SX.eye(3) + (sliding_mass - swing_mass) * n @ n.T + axial * kappa**2 * turned @ turned.T,
        force=(
            (sliding_mass * length * swing2 - inertia_slope * swing2 / 2 - c["rod_mass"] * gravity_along) * n
            + (inertia_slope - 2 * inertia * inverse) * speed * inverse**2 * across
            - weight_lever * inverse * (c["gravity"] - gravity_along * n)
            + axial * gyroscopic
        ),
        kinetic=(inertia * swing2 + sliding_mass * speed**2 + axial * (kappa * q) ** 2) / 2,
        potential=-gravity_along * weight_lever,
    )


def _legs(x: dict[str, SX], rotation: SX, c: dict[str, SX]) -> list[_Leg]:
    omega = x["state.angular_velocity"]
    legs = []
    for k in range(LEGS):
        arm = rotation @ _row(c["platform_joints"], k)
        s = x["state.position"] + arm - _row(c["base_joints"], k)
        turning = ca.cross(omega, arm)
        bias = ca.cross(omega, turning)
        legs.append(_leg(s, x["state.velocity"] + turning, arm, bias, _row(c["base_joint_axes"], k), c))
    return legs


def _stack(values: list[SX]) -> SX:
    return ca.vertcat(*values)


def _stop_force(length: SX, speed: SX, c: dict[str, SX], k: int) -> SX:
    """Hunt and Crossley's contact: the damping is in proportion to the elastic force, and nothing ever pulls."""
    below = ca.fmax(c["stop.minimum_length"][k] - length, 0)
    above = ca.fmax(length - c["stop.maximum_length"][k], 0)
    stiffness, damping = c["stop.stiffness"], c["stop.damping"]
    return stiffness * (below * ca.fmax(1 - damping * speed, 0) - above * ca.fmax(1 + damping * speed, 0))


def _brake_rate(deflection: SX, speed: SX, closed: SX, c: dict[str, SX]) -> SX:
    """Elasto-plastic bristle (Dupont, Hayward, Armstrong, Altpeter 2002): purely elastic below 70 % of the slipping
    force, so that a closed brake holds without creep.
    """
    load = ca.fabs(deflection) / c["brake_slip"]
    share = ca.fmin(ca.fmax((load - 0.7) / 0.3, 0), 1)
    slipping = ca.if_else(deflection * speed > 0, share * share * (3 - 2 * share), 0)
    return closed * speed * (1 - slipping * load) - (1 - closed) * c["release_rate"] * deflection


def _solve(matrix: SX, right: SX) -> SX:
    """Solve a symmetric positive definite system by Cholesky's method, unrolled; only the lower triangle is read."""
    n = right.shape[0]
    lower = SX.zeros(n, n)
    inverses: list[SX] = []
    for j in range(n):
        column = [matrix[i, j] - sum(lower[i, k] * lower[j, k] for k in range(j)) for i in range(j, n)]
        inverses.append(ca.sqrt(1 / column[0]))
        for i in range(j + 1, n):
            lower[i, j] = column[i - j] * inverses[j]
    z = [SX(0)] * n
    for i in range(n):
        z[i] = (right[i] - sum(lower[i, k] * z[k] for k in range(i))) * inverses[i]
    for i in reversed(range(n)):
        z[i] = (z[i] - sum(lower[k, i] * z[k] for k in range(i + 1, n))) * inverses[i]
    return ca.vertcat(*z)


def _plant(x: dict[str, SX], u: dict[str, SX], c: dict[str, SX]) -> tuple[dict[str, SX], dict[str, SX]]:
    rotation = _rotation(x["state.quaternion"])
    velocity, omega, current = x["state.velocity"], x["state.angular_velocity"], x["state.current"]
    gravity = c["gravity"]
    moment = rotation @ c["first_moment"]
    inertia = rotation @ c["inertia"] @ rotation.T
    legs = _legs(x, rotation, c)
    speeds = _stack([leg.speed for leg in legs])

    mode = u["drive_mode"]
    closed, driven = mode == BRAKE, mode == VELOCITY
    motor = c["force_constant"] * current
    friction = c["friction.viscous"] * speeds + c["friction.coulomb"] * speeds / ca.sqrt(
        speeds**2 + c["friction.velocity"] ** 2
    )
    # An opened brake lets go within its release time, while the drive takes over the load.
    brake = -(c["brake.stiffness"] * x["state.brake_deflection"] + closed * c["brake.damping"] * speeds)
    stop = _stack([_stop_force(leg.length, leg.speed, c, k) for k, leg in enumerate(legs)])
    axial = motor - friction + brake + stop

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
        force = axial[k] * leg.direction - leg.force - leg.mass @ leg.bias
        wrench += ca.vertcat(force, ca.cross(leg.arm, force))
    acceleration = _solve(ca.blockcat([[linear, coupling.T], [coupling, angular]]), wrench)

    back_emf = c["force_constant"] * speeds
    asked = driven * (c["force_constant"] * u["velocity_command"] + c["compensating_resistance"] * current)
    voltage = ca.fmax(ca.fmin(asked, c["drive.voltage_limit"]), -c["drive.voltage_limit"])
    # An open motor has no back-EMF current to drive; a braked one is short-circuited.
    free = (voltage - c["motor.resistance"] * current - (mode != OPEN) * back_emf) * c["inverse_inductance"]
    current_rate = ca.fmax(
        ca.fmin(free, c["limiter_rate"] * (c["drive.current_limit"] - current)),
        c["limiter_rate"] * (-c["drive.current_limit"] - current),
    )

    w, q1, q2, q3 = ca.vertsplit(x["state.quaternion"])
    ox, oy, oz = ca.vertsplit(omega)
    quaternion_rate = 0.5 * ca.vertcat(
        -q1 * ox - q2 * oy - q3 * oz,
        w * ox + oy * q3 - oz * q2,
        w * oy + oz * q1 - ox * q3,
        w * oz + ox * q2 - oy * q1,
    )
    rates = {
        "state.position": velocity,
        "state.quaternion": quaternion_rate,
        "state.velocity": acceleration[:3],
        "state.angular_velocity": acceleration[3:],
        "state.current": current_rate,
        "state.brake_deflection": _stack(
            [_brake_rate(x["state.brake_deflection"][k], legs[k].speed, closed[k], c) for k in range(LEGS)]
        ),
    }
    imu = _imu_signals(legs, rotation, omega, acceleration, c)
    outputs = imu | {
        "position": x["state.position"],
        "quaternion": x["state.quaternion"],
        "velocity": velocity,
        "angular_velocity": omega,
        "leg_length": _stack([leg.length for leg in legs]),
        "leg_velocity": speeds,
        "current": current,
        "voltage": voltage,
        "kinetic_energy": (
            c["mass"] * ca.dot(velocity, velocity) / 2
            + ca.dot(velocity, ca.cross(omega, moment))
            + ca.dot(omega, inertia @ omega) / 2
            + sum(leg.kinetic for leg in legs)
        ),
        "potential_energy": (-ca.dot(gravity, c["mass"] * x["state.position"] + moment) + sum(leg.potential for leg in legs)),
        "power.drive": ca.dot(motor, speeds),
        "power.friction": -ca.dot(friction, speeds),
        "power.brake": ca.dot(brake, speeds),
        "power.stop": ca.dot(stop, speeds),
        "power.external": ca.dot(external, ca.vertcat(velocity, omega)),
    }
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
    motion = {"state.position": position, "state.velocity": velocity, "state.angular_velocity": omega}
    return _imu_signals(_legs(motion, rotation, c), rotation, omega, acceleration, c)


def _in_order(values: dict[str, SX], variables: tuple[Variable, ...]) -> SX:
    return _flat({variable.name: values[variable.name] for variable in variables})


def _imu_signals(legs: list[_Leg], rotation: SX, omega: SX, acceleration: SX, c: dict[str, SX]) -> dict[str, SX]:
    """Ideal IMU signals; each leg's in the leg frame, whose z axis is the leg and whose y axis is e2."""
    s, sd, sdd, e1, arm = (SX.sym(name, 3) for name in ("s", "sd", "sdd", "e1", "d"))
    gravity, field = SX.sym("g", 3), SX.sym("m", 3)
    length = ca.norm_2(s)
    n = s / length
    e2 = ca.cross(n, e1)
    e2 = e2 / ca.norm_2(e2)
    frame = ca.horzcat(ca.cross(e2, n), e2, n)
    k = ca.dot(e1, s)
    axial_rate = k * ca.dot(e1, ca.cross(s, sd)) / (length * (length**2 - k**2))
    rate = frame.T @ (ca.cross(s, sd) / length**2 + axial_rate * n)
    angular = ca.jtimes(rate, s, sd) + ca.jtimes(rate, sd, sdd)
    force = -frame.T @ gravity + ca.cross(angular, arm) + ca.cross(rate, ca.cross(rate, arm))
    leg_imu = ca.Function("leg_imu", [s, sd, sdd, e1, arm, gravity, field], [rate, force, frame.T @ field])

    rates: list[SX] = []
    forces: list[SX] = []
    fields: list[SX] = []
    for i, leg in enumerate(legs):
        arguments = (_row(c["base_joint_axes"], i), _row(c["leg_imu_position"], i), c["gravity"], c["magnetic_field"])
        signals = leg_imu(leg.s, leg.velocity, acceleration[:3] + ca.cross(acceleration[3:], leg.arm) + leg.bias, *arguments)
        for collected, signal in zip((rates, forces, fields), signals, strict=True):
            collected.append(signal.T)
    place = rotation @ c["platform_imu_position"]
    at_imu = acceleration[:3] + ca.cross(acceleration[3:], place) + ca.cross(omega, ca.cross(omega, place))
    rates.append((rotation.T @ omega).T)
    forces.append((rotation.T @ (at_imu - c["gravity"])).T)
    fields.append((rotation.T @ c["magnetic_field"]).T)
    return {
        "imu_angular_velocity": ca.vertcat(*rates),
        "imu_specific_force": ca.vertcat(*forces),
        "imu_magnetic_field": ca.vertcat(*fields),
    }
