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

from dataclasses import dataclass
from math import pi

import casadi as ca

from plant.mechanism import LEGS
from plant.variables import BRAKE, INPUTS, OPEN, OUTPUTS, PARAMETERS, STATES, VELOCITY, Variable

SX = ca.SX


@dataclass(frozen=True)
class Dynamics:
    """The plant as CasADi functions of flat vectors in the order of the variable table.

    `constants(parameters)` is what the other two need of the parameters, worked out once; `rates(states, inputs,
    constants)` is the time derivative of the states; `outputs(states, inputs, constants)` all outputs.
    """

    constants: ca.Function
    rates: ca.Function
    outputs: ca.Function


def build_dynamics() -> Dynamics:
    """Derive the plant's equations."""
    parameters = _symbols(PARAMETERS)
    states, inputs = _symbols(STATES), _symbols(INPUTS)
    expressions = _constants(parameters)
    # The symbols stand for the worked-out constants inside `rates` and `outputs`.
    constants = {name: SX.sym(name, *value.shape) for name, value in expressions.items()}
    rates, outputs = _plant(states, inputs, constants)
    arguments = [_flat(states), _flat(inputs), _flat(constants)]
    options = {"cse": True}
    return Dynamics(
        constants=ca.Function("plant_constants", [_flat(parameters)], [_flat(expressions)], options),
        rates=ca.Function("plant_rates", arguments, [ca.densify(rates)], options),
        outputs=ca.Function("plant_outputs", arguments, [ca.densify(outputs)], options),
    )


def _symbols(variables: tuple[Variable, ...]) -> dict[str, SX]:
    symbols = {}
    for variable in variables:
        rows, columns = (*variable.shape, 1, 1)[:2] if variable.shape else (1, 1)
        # CasADi stores columns first and the table rows first, so the symbol is made transposed.
        symbols[variable.name] = SX.sym(variable.name, columns, rows).T
    return symbols


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


def _plant(x: dict[str, SX], u: dict[str, SX], c: dict[str, SX]) -> tuple[SX, SX]:
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
    wrench = u["external_wrench"] + ca.vertcat(
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
        "power.external": ca.dot(u["external_wrench"], ca.vertcat(velocity, omega)),
    }
    return _in_table_order(rates, STATES), _in_table_order(outputs, OUTPUTS)


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


def parameter_symbols() -> dict[str, SX]:
    """A symbol for each parameter of the table."""
    return _symbols(PARAMETERS)


def _in_table_order(values: dict[str, SX], variables: tuple[Variable, ...]) -> SX:
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
