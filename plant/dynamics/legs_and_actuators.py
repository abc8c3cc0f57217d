"""The legs and their actuators, as CasADi expressions that the spatial and the planar plant share.

A leg is a universal joint (first axis e1 fixed in the base, second e2 = n x e1 / |n x e1|) with a lower part and a rod, both
symmetric about the leg's axis n = s / l. Since the leg's angular velocity lies in the plane of e1 and e2,
`omega = n x s' / l + omega_n n` with `omega_n = k e1 . (s x s') / (l (l^2 - k^2))`, k = e1 . s. In a planar mechanism e1 is
the plane's normal, so k and omega_n are zero. All this is seen in {1}, whose own motion is added to it.

Each leg is driven through a screw by a DC motor on an encoderless drive that turns a velocity command u into the voltage
`g n k u + kappa R_nominal i`, n = 2 pi / lead, with a gain g that is 1 where the drive counts as the screw does.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import casadi as ca

from plant.dynamics.base_motion import BaseMotion
from plant.dynamics.play import Play, play_at, width_of
from plant.dynamics.universal_joint import Reach, reach_at
from plant.dynamics.variables import BRAKE, OPEN, VELOCITY

SX = ca.SX


def row(matrix: SX, k: int) -> SX:
    """Row k as a column."""
    return matrix[k, :].T


_UNCHANGED = (
    "motor.resistance", "drive.gain", "drive.voltage_limit", "drive.current_limit", "friction.coulomb", "friction.viscous",
    "friction.velocity", "brake.stiffness", "brake.damping", "stop.minimum_length", "stop.maximum_length", "stop.stiffness",
    "stop.damping", "screw.backlash", "joint.clearance", "screw.stiffness", "screw.damping", "leg.lower.mass",
    "leg.lower.center", "leg.lower.inertia", "leg.upper.inertia", "leg.bending_compliance", "leg.guide",
    "leg.bending_frequency", "leg.bending_damping", "gravity", "magnetic_field", "leg_imu_position", "platform_imu_position",
    "base_imu_position",
)  # fmt: skip


def body_constants(p: dict[str, SX], about_offset: Callable[[SX], SX]) -> dict[str, SX]:
    """The constants of legs, actuators, IMUs, and of platform and payload as one body.

    `about_offset(center)` is the inertia of a unit mass at an offset.
    """
    masses = (p["platform.mass"], p["payload.mass"])
    centers = (p["platform.center_of_mass"], p["payload.center_of_mass"])
    inertias = (p["platform.inertia"], p["payload.inertia"])
    first, second = (i + m * about_offset(c) for m, c, i in zip(masses, centers, inertias, strict=True))
    turns = 2 * pi / p["motor.screw_lead"]
    lower, upper = "leg.lower.", "leg.upper."
    return {name: p[name] for name in _UNCHANGED} | {
        "transverse_inertia": p[lower + "inertia"] + p[upper + "inertia"] + p[lower + "mass"] * p[lower + "center"] ** 2,
        "lower_moment": p[lower + "mass"] * p[lower + "center"],
        "rod_mass": p[upper + "mass"],
        "rod_center": p[upper + "center"],
        "sliding_mass": p[upper + "mass"] + p["motor.rotor_inertia"] * turns**2,
        "rotor_mass": p["motor.rotor_inertia"] * turns**2,
        "force_constant": turns * p["motor.torque_constant"],
        "compensating_resistance": p["drive.compensation"] * p["drive.nominal_resistance"],
        "inverse_inductance": 1 / p["motor.inductance"],
        "limiter_rate": 1 / p["drive.current_time_constant"],
        "brake_slip": p["brake.force"] / p["brake.stiffness"],
        "release_rate": 1 / p["brake.release_time"],
        "mass": masses[0] + masses[1],
        "first_moment": masses[0] * centers[0] + masses[1] * centers[1],
        "inertia": first + second,
    }


@dataclass(frozen=True)
class Condition:
    """`value` must not exceed `limit`; `text` is the message, with both numbers and the remedy."""

    value: SX | float
    limit: SX | float
    text: str


_LEAST_LENGTH_M = 1e-4


def leg_conditions(p: dict[str, SX], lengths: SX) -> list[Condition]:
    """Conditions on the parameters of legs and actuators, for lengths (n, 1) at the start."""
    conditions = []
    for k in range(lengths.shape[0]):
        conditions += [
            Condition(_LEAST_LENGTH_M, lengths[k], f"leg {k} needs a length of %g m at the start and has %g m"),
            Condition(
                p["stop.minimum_length"][k],
                p["stop.maximum_length"][k],
                f"stop.minimum_length of leg {k} is %g m, beyond its stop.maximum_length of %g m",
            ),
        ]
    conditions.append(
        Condition(
            (ca.mmax(p["leg.bending_compliance"]) > 0) * p["leg.guide"],
            ca.mmin(lengths),
            "leg.guide is at %g m, beyond the end of a leg of %g m that bends: move it to where the rod leaves the lower part",
        )
    )
    outside = ca.vertcat(p["stop.minimum_length"] - lengths, lengths - p["stop.maximum_length"])
    return conditions + _substep_conditions(p, ca.fmax(ca.mmax(outside), 0))


def length_limits(lengths: SX) -> list[Condition]:
    """Every leg keeps a length during the motion; `lengths` (n, 1)."""
    return [
        Condition(_LEAST_LENGTH_M, lengths[k], f"leg {k} needs a length of %g m and has come down to %g m: limit its stroke")
        for k in range(lengths.shape[0])
    ]


_RUNGE_KUTTA_REACH = 2.5
"""The classical Runge-Kutta method is stable for |eigenvalue| x step up to this."""

_CONTACT_REACH = 1.5
"""The same for the end stops, found with 800 random sets of parameters."""

_STRIKE = 0.1
"""The speed at which flanks strike one another after the short way through their play [m/s]."""


def _substep_conditions(p: dict[str, SX], beyond_stop: SX) -> list[Condition]:
    """The substep is short enough for the fastest modes of the legs.

    In coordinates whose squared length is the energy, the largest dissipation and the norm of the storage bound every
    eigenvalue, and mass beside a leg's sliding mass only lowers them. Brakes and end stops act faster at a higher speed of the
    leg: at most the drive's voltage over its force constant, or that of a leg that starts `beyond_stop` [m] beyond its stop.
    """
    turns = 2 * pi / p["motor.screw_lead"]
    rotor_mass, rod_mass, loose = p["motor.rotor_inertia"] * turns**2, p["leg.upper.mass"], ca.mmax(width_of(p)) > 0
    sliding_mass = rotor_mass + (1 - loose) * rod_mass
    constant = turns * p["motor.torque_constant"]
    speed = p["drive.voltage_limit"] / constant
    slope = ca.mmax(p["friction.viscous"] + p["friction.coulomb"] / p["friction.velocity"]) + p["brake.damping"]
    fading = ca.fmax(slope / sliding_mass, ca.mmax(p["motor.resistance"]) / p["motor.inductance"])
    storing = (constant**2 / p["motor.inductance"] + p["brake.stiffness"]) / sliding_mass
    # An end stop acts on the rotor, or beside play on the platform, at whose rim a leg moves about a quarter of its mass.
    share = (p["platform.mass"] + p["payload.mass"]) / 4
    bounce = ca.sqrt(p["stop.stiffness"] / (rod_mass + (1 - loose) * rotor_mass + loose * share))
    rattle = loose * ca.sqrt(p["screw.stiffness"] * (1 / rod_mass + 1 / rotor_mass))
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
            bounce * (1 + p["stop.damping"] * ca.fmax(speed, beyond_stop * bounce)) / _CONTACT_REACH,
            "the end stops, the square root of stop.stiffness over the sliding mass, and stop.damping",
        ),
        (
            rattle * (1 + p["screw.damping"] * _STRIKE) / _CONTACT_REACH,
            "the play, the square root of screw.stiffness over the mass of rod or rotor, and screw.damping",
        ),
        (
            (ca.mmax(p["leg.bending_compliance"]) > 0)
            * 2
            * pi
            * p["leg.bending_frequency"]
            * (1 + p["leg.bending_damping"])
            / _RUNGE_KUTTA_REACH,
            "the bending, leg.bending_frequency and leg.bending_damping",
        ),
    ]
    return [
        Condition(p["substep"], 1 / rate, f"substep is %g s, and may be at most %g s because of {what}: reduce it")
        for rate, what in rates
    ]


@dataclass(frozen=True)
class Leg:
    """One leg at one instant; vectors (3, 1) and their derivatives seen in {1}.

    r is the vector from base joint to platform joint, and s that from the second axis of the base joint. `mass` (3, 3) and
    `force` (3, 1) are M and h in `M r'' + h = F`, with F the force on the platform joint. `arm` points from the platform's
    origin to that joint, and `bias` is r'' without acceleration of the platform. `gravity` is what a body at rest on the base
    joint feels.
    """

    reach: Reach
    arm: SX
    bias: SX
    gravity: SX
    length: SX
    speed: SX
    direction: SX
    mass: SX
    force: SX
    kinetic: SX
    potential: SX
    swing2: SX  # square of the rate at which the leg swings in {1}

    def accelerations(self, platform: SX) -> tuple[SX, SX]:
        """The second derivatives of r and s, for an acceleration (6, 1) of the platform."""
        whole = platform[:3] + ca.cross(platform[3:], self.arm) + self.bias
        return whole, self.reach.slope @ whole + self.reach.bias

    def length_acceleration(self, platform: SX) -> SX:
        """The second derivative of the length, for an acceleration (6, 1) of the platform."""
        return ca.dot(self.reach.s, self.accelerations(platform)[1]) / self.length + self.length * self.swing2


def _leg_at(reach: Reach, arm: SX, bias: SX, joint: SX, e1: SX, sliding_mass: SX, base: BaseMotion, c: dict[str, SX]) -> Leg:
    """Lagrange's equations of one leg with its motor, on its base joint and its first axis e1.

    The leg slides with the mass m, swings with the transverse inertia I(l), and turns about its axis with the rate that the
    universal joint imposes, `w = kappa q + omega . n`, kappa = k / (l^3 - l k^2), q = (e1 x s) . s', omega of the base.
    """
    s, velocity = reach.s, reach.velocity
    # One square root and no division: CasADi would make a separate division of every product with 1 / l.
    square = ca.dot(s, s)
    inverse = ca.sqrt(1 / square)
    length = square * inverse
    n = s * inverse
    speed = ca.dot(n, velocity)
    across = velocity - speed * n
    # Slide and swing are those in a frame that moves with the base joint, but does not turn.
    swing = across + ca.cross(base.omega, s)
    swing2 = ca.dot(swing, swing) * inverse**2
    carried = base.acceleration(s, velocity)
    on_joint = base.gravity - base.carry @ joint
    # The second axis moves about the first: its acceleration is `beyond r'' - reach.bias` in {1}.
    beyond = SX.eye(3) - reach.slope
    gravity = on_joint - base.acceleration(reach.beyond, reach.beyond_velocity) + reach.bias
    axis_velocity = ca.cross(base.omega, joint + reach.beyond) + reach.beyond_velocity

    lever = length - c["rod_center"]
    inertia = c["transverse_inertia"] + c["rod_mass"] * lever**2
    inertia_slope = 2 * c["rod_mass"] * lever
    weight_lever = c["lower_moment"] + c["rod_mass"] * lever
    gravity_along = ca.dot(gravity, n)

    k = ca.dot(e1, s)
    inverse_cubic = inverse / (square - k**2)
    kappa = k * inverse_cubic
    kappa_gradient = inverse_cubic**2 * (length * (square + k**2) * e1 - k * (3 * square - k**2) * n)
    turned = ca.cross(e1, s)
    q = ca.dot(turned, velocity)
    kappa_rate = ca.dot(kappa_gradient, velocity)
    axial = c["axial_inertia"]
    along = ca.dot(base.omega, n)
    spin = kappa * q + along
    spin_rate = kappa_rate * q + ca.dot(base.alpha, n) + ca.dot(base.omega, across) * inverse
    gyroscopic = spin_rate * kappa * turned + spin * (
        kappa_rate * turned + 2 * kappa * ca.cross(e1, velocity) - q * kappa_gradient - (base.omega - along * n) * inverse
    )

    swing_mass = inertia * inverse**2
    # Of the leg's first moment about its second axis, the slope by s and the acceleration without s''.
    moment_slope = weight_lever * inverse * (SX.eye(3) - n @ n.T) + c["rod_mass"] * n @ n.T
    moment_rate = weight_lever * inverse * across + c["rod_mass"] * speed * n
    moment_bias = (c["rod_mass"] * length - weight_lever) * inverse**2 * (2 * speed * across + ca.dot(across, across) * n)
    leg_mass = c["leg.lower.mass"] + c["rod_mass"]
    dragged = moment_slope @ reach.bias + moment_bias + base.acceleration(weight_lever * n, moment_rate) - leg_mass * gravity
    coupling = beyond @ moment_slope @ reach.slope
    mass = swing_mass * SX.eye(3) + (sliding_mass - swing_mass) * n @ n.T + axial * kappa**2 * turned @ turned.T
    force = (
        (sliding_mass * length * swing2 - inertia_slope * swing2 / 2 - c["rod_mass"] * gravity_along) * n
        + (inertia_slope - 2 * inertia * inverse) * speed * inverse**2 * swing
        - weight_lever * inverse * (gravity - gravity_along * n)
        + axial * gyroscopic
        + swing_mass * carried
        + (sliding_mass - swing_mass) * ca.dot(n, carried) * n
    )
    return Leg(
        reach=reach,
        arm=arm,
        bias=bias,
        gravity=on_joint,
        length=length,
        speed=speed,
        direction=n,
        mass=reach.slope @ mass @ reach.slope + leg_mass * beyond @ beyond + coupling + coupling.T,
        force=reach.slope @ (force + mass @ reach.bias) + beyond @ dragged,
        kinetic=(
            (inertia * swing2 + sliding_mass * speed**2 + axial * spin**2) / 2
            + leg_mass * ca.dot(axis_velocity, axis_velocity) / 2
            + ca.dot(axis_velocity, weight_lever * inverse * swing + c["rod_mass"] * speed * n)
        ),
        potential=-ca.dot(base.gravity, n) * weight_lever - leg_mass * ca.dot(base.gravity, reach.beyond),
        swing2=ca.dot(across, across) * inverse**2,
    )


def legs_at(position: SX, rotation: SX, velocity: SX, omega: SX, base: BaseMotion, c: dict[str, SX]) -> list[Leg]:
    """The legs, whose constants include joints and axes (n, 3), for a motion of {2} in {1}."""
    legs, widths = [], width_of(c)
    for k in range(c["base_joints"].shape[0]):
        arm, joint = rotation @ row(c["platform_joints"], k), row(c["base_joints"], k)
        turning = ca.cross(omega, arm)
        bias = ca.cross(omega, turning)
        axis, sliding_mass = row(c["base_joint_axes"], k), c["sliding_mass"] - (widths[k] > 0) * c["rotor_mass"]
        reach = reach_at(position + arm - joint, velocity + turning, axis, c["base_joint_offset"][k])
        legs.append(_leg_at(reach, arm, bias, joint, axis, sliding_mass, base, c))
    return legs


@dataclass(frozen=True)
class Actuators:
    """The actuators of n legs at one instant, (n, 1) each; a force pushes if it is positive, but friction brakes."""

    motor: SX
    friction: SX
    brake: SX
    stop: SX
    voltage: SX
    current_rate: SX
    brake_rate: SX
    speed: SX  # of the motors, along the legs
    play: Play

    @property
    def driving(self) -> SX:
        """The force of all that acts on the motors."""
        return self.motor - self.friction + self.brake

    @property
    def force(self) -> SX:
        """The total force on the legs, positive when it pushes."""
        return self.driving + self.stop + (self.play.force - self.play.loose * self.driving)

    def play_velocity_rate(self, length_acceleration: SX, c: dict[str, SX]) -> SX:
        """The rate of `state.play_velocity`, for accelerations of the lengths (n, 1)."""
        return self.play.loose * ((self.driving - self.play.force) / c["rotor_mass"] - length_acceleration)

    def kinetic(self, c: dict[str, SX]) -> SX:
        """The kinetic energy of motors that are apart from their rods."""
        return ca.dot(self.play.loose, self.speed**2) * c["rotor_mass"] / 2


def actuators_at(legs: list[Leg], x: dict[str, SX], u: dict[str, SX], c: dict[str, SX]) -> Actuators:
    """The actuators, from states, inputs and constants."""
    play, current = play_at(x, c), x["state.current"]
    speeds = _speeds(legs) + play.speed
    mode = u["drive_mode"]
    closed, driven = mode == BRAKE, mode == VELOCITY
    friction = c["friction.viscous"] * speeds + c["friction.coulomb"] * speeds / ca.sqrt(
        speeds**2 + c["friction.velocity"] ** 2
    )
    back_emf = c["force_constant"] * speeds
    asked = driven * (c["drive.gain"] * c["force_constant"] * u["velocity_command"] + c["compensating_resistance"] * current)
    voltage = ca.fmax(ca.fmin(asked, c["drive.voltage_limit"]), -c["drive.voltage_limit"])
    # In an open motor the back-EMF drives no current; a braked motor is short-circuited.
    free = (voltage - c["motor.resistance"] * current - (mode != OPEN) * back_emf) * c["inverse_inductance"]
    deflections = x["state.brake_deflection"]
    return Actuators(
        motor=c["force_constant"] * current,
        friction=friction,
        # An opened brake releases within its release time, while the drive takes over the load.
        brake=-(c["brake.stiffness"] * deflections + closed * c["brake.damping"] * speeds),
        stop=ca.vertcat(*[_stop_force(leg.length, leg.speed, c, k) for k, leg in enumerate(legs)]),
        voltage=voltage,
        current_rate=ca.fmax(
            ca.fmin(free, c["limiter_rate"] * (c["drive.current_limit"] - current)),
            c["limiter_rate"] * (-c["drive.current_limit"] - current),
        ),
        brake_rate=ca.vertcat(*[_brake_rate(deflections[k], speeds[k], closed[k], c) for k in range(len(legs))]),
        speed=speeds,
        play=play,
    )


def leg_outputs(legs: list[Leg], actuators: Actuators, x: dict[str, SX]) -> dict[str, SX]:
    """What the table has of legs and actuators, by name."""
    lengths, speeds, motors = ca.vertcat(*[leg.length for leg in legs]), _speeds(legs), actuators.speed
    return {
        "leg_length": lengths,
        "leg_velocity": speeds,
        "motor_length": lengths + actuators.play.loose * x["state.play"],
        "current": x["state.current"],
        "voltage": actuators.voltage,
        "power.drive": ca.dot(actuators.motor, motors),
        "power.friction": -ca.dot(actuators.friction, motors),
        "power.brake": ca.dot(actuators.brake, motors),
        "power.stop": ca.dot(actuators.stop, speeds),
        "power.play": -ca.dot(actuators.play.force, actuators.play.speed),
    }


def _speeds(legs: list[Leg]) -> SX:
    return ca.vertcat(*[leg.speed for leg in legs])


def _stop_force(length: SX, speed: SX, c: dict[str, SX], k: int) -> SX:
    """Hunt and Crossley's contact: damping in proportion to the elastic force, and no pull."""
    below = ca.fmax(c["stop.minimum_length"][k] - length, 0)
    above = ca.fmax(length - c["stop.maximum_length"][k], 0)
    stiffness, damping = c["stop.stiffness"], c["stop.damping"]
    return stiffness * (below * ca.fmax(1 - damping * speed, 0) - above * ca.fmax(1 + damping * speed, 0))


def _brake_rate(deflection: SX, speed: SX, closed: SX, c: dict[str, SX]) -> SX:
    """Elasto-plastic bristle (Dupont, Hayward, Armstrong, Altpeter 2002), purely elastic below 70 % of the slipping force,
    so that a closed brake holds without creep.
    """
    load = ca.fabs(deflection) / c["brake_slip"]
    share = ca.fmin(ca.fmax((load - 0.7) / 0.3, 0), 1)
    slipping = ca.if_else(deflection * speed > 0, share * share * (3 - 2 * share), 0)
    return closed * speed * (1 - slipping * load) - (1 - closed) * c["release_rate"] * deflection


_SINGULAR = 1e-12
"""Directions in which the brakes have less than this share of their effect bear nothing."""


def brake_deflections(effect: SX, falling: SX, slip: SX) -> SX:
    """The deflections (n, 1) of closed brakes that leave a platform at rest.

    Without them it would accelerate by `falling` (d, 1), of which a deflection takes away its column of `effect` (d, n). Brakes
    that would slip, beyond the deflection `slip`, carry an equal share of each leg's load. What no leg bears falls.
    """
    scales = 1 / ca.sqrt(ca.sum2(effect**2) + _SINGULAR * ca.sumsqr(effect))
    rows = effect * ca.repmat(scales, 1, effect.shape[1])
    square = rows @ rows.T + _SINGULAR * SX.eye(rows.shape[0])
    wanted = rows.T @ solve(square, falling * scales)
    return wanted * (slip / ca.fmax(slip, ca.mmax(ca.fabs(wanted))))


def solve(matrix: SX, right: SX) -> SX:
    """Solve a positive definite system by Cholesky's method; only the lower triangle is read."""
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
