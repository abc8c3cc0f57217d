"""Load feed-forward: the reference speed, and what the drives need beyond it for weight, acceleration and friction.

An encoderless drive falls short of its command by `droop` x force. The forces of the legs follow by virtual work: `J^T f`
balances the weight of platform and payload, what accelerates them as planned, and the weight of each leg's lower part and rod
through the moment about its base joint. Each drive bears its rod's own weight along its leg, and accelerates rod and rotor.
Friction is that of the reference's rate, so that a leg at rest is not shaken.
"""

from collections.abc import Mapping

import numpy as np

from controller.inverse_kinematics import jacobian_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

PARAMETERS = record_dtype(
    command_delay=np.float64,  # of the rig, from a sample to the command computed from it [s]
    droop=np.float64,  # by how much a drive falls short of its command per force [m/s/N]
    sliding_mass=np.float64,  # of rod and rotor, which each drive accelerates along its leg [kg]
    mass=np.float64,  # of platform and payload [kg]
    first_moment=(np.float64, 3),  # of platform and payload [kg m in {2}]
    inertia=(np.float64, (3, 3)),  # of platform and payload about the origin of {2} [kg m^2 in {2}]
    lower_moment=np.float64,  # mass times centre of a leg's lower part [kg m]
    coulomb=(np.float64, LEGS),  # Coulomb friction of each drive [N]
    viscous=(np.float64, LEGS),  # viscous friction of each drive [N s/m]
    friction_velocity=np.float64,  # over which Coulomb friction changes sign [m/s]
    rod_mass=np.float64,  # of a leg's rod [kg]
    rod_center=np.float64,  # of a leg's rod, from its platform joint [m]
)
"""Constants of the feed-forward."""

STATE = record_dtype(
    feed_forward=(np.float64, LEGS),
    drive=(np.float64, LEGS),
    load=(np.float64, 6),
    wrench=(np.float64, 6),
    force=(np.float64, 6),
    jacobian=(np.float64, (6, 6)),
    transposed=(np.float64, (6, 6)),
)
"""The feed-forward [m/s], the load of each drive [N], the load on the platform beside its weight, the forces of the legs on the
platform [N], and scratch."""


def load_parameters(mechanism: Mechanism, command_delay: float, position: bool = False) -> Record:
    """The constants of the feed-forward (dtype `PARAMETERS`); drives that close a `position` loop do not droop."""
    plant = mechanism.plant_parameters()
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    mass, first_moment = first_moment_of(plant)
    droop = plant["drive.nominal_resistance"] * (1.0 - plant["drive.compensation"]) / force_constant**2
    return filled(
        PARAMETERS,
        command_delay=command_delay,
        droop=0.0 if position else droop,
        sliding_mass=plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2,
        mass=mass,
        first_moment=first_moment,
        inertia=_inertia_of(plant),
        lower_moment=plant["leg.lower.mass"] * plant["leg.lower.center"],
        coulomb=np.pad(plant["friction.coulomb"], (0, LEGS - mechanism.legs)),
        viscous=np.pad(plant["friction.viscous"], (0, LEGS - mechanism.legs)),
        friction_velocity=plant["friction.velocity"],
        rod_mass=plant["leg.upper.mass"],
        rod_center=plant["leg.upper.center"],
    )


def first_moment_of(plant: Mapping[str, Array]) -> tuple[float, Array]:
    """The mass [kg] of platform and payload together, and their first moment (3,) in {2} [kg m]."""
    masses = [plant[f"{body}.mass"] for body in ("platform", "payload")]
    centers = [plant.get(f"{body}.center_of_mass", np.zeros(3)) for body in ("platform", "payload")]
    moment: Array = masses[0] * centers[0] + masses[1] * centers[1]
    return float(masses[0] + masses[1]), np.pad(moment, (0, 3 - moment.size))


def _inertia_of(plant: Mapping[str, Array]) -> Array:
    """The inertia (3, 3) of platform and payload together about the origin of {2} [kg m^2 in {2}]."""
    whole = np.zeros((3, 3))
    for body in ("platform", "payload"):
        center, own = plant.get(f"{body}.center_of_mass", np.zeros(3)), np.asarray(plant[f"{body}.inertia"])
        c = np.pad(center, (0, 3 - center.size))
        whole += np.diag([0.0, 0.0, float(own)]) if own.ndim == 0 else own
        whole += plant[f"{body}.mass"] * (c @ c * np.eye(3) - np.outer(c, c))
    return whole


@kernel
def find_static_forces(p: Record, s: Record, pose: Record, legs: int, up: Vector, gravity: float, load: Array) -> float:
    """Write the static force of each leg on the platform, of the weights and of a `load` (6,): a force and a moment, seen in
    {1}, on the origin of {2}; zero where the Jacobian is singular. Returns how far it is from that, the ratio of its pivots.
    """
    wrench, force = s.wrench, s.force
    jacobian_at(pose.arms, pose.directions, legs, s.jacobian)
    moment = cross(rotate(pose.rotation, vector(p.first_moment)), up)
    for i in range(3):
        wrench[i] = p.mass * gravity * up[i] - load[i]
        wrench[3 + i] = gravity * moment[i] - load[3 + i]
    for i in range(6):
        for j in range(6):
            s.transposed[i, j] = s.jacobian[j, i]
    for k in range(legs):
        d = vector(pose.directions[k])
        lever = (p.lower_moment + p.rod_mass * (pose.lengths[k] - p.rod_center)) * gravity / pose.lengths[k]
        push = scale(lever, subtract(up, scale(dot(d, up), d)))
        turn = cross(vector(pose.arms[k]), push)
        for i in range(3):
            wrench[i] += push[i]
            wrench[3 + i] += turn[i]
    conditioning = solve_square(s.transposed, wrench)
    for k in range(6):
        force[k] = 0.0 if conditioning < RANK_TOLERANCE else wrench[k]
    return conditioning


@kernel
def own_weight(p: Record, pose: Record, leg: int, up: Vector, gravity: float) -> float:
    """The part of its rod's weight along a leg [N]."""
    return float(p.rod_mass * gravity * dot(vector(pose.directions[leg]), up))


@kernel
def _find_inertial_load(p: Record, pose: Record, load: Array) -> None:
    """Write the load (6,) of platform and payload that move as planned, with their first moment h and inertia I:

    -(m v' + omega' x h + omega x (omega x h)) and -(h x v' + I omega' + omega x I omega).
    """
    origin, angular, omega = vector(pose.planned[1]), vector(pose.planned[1, 3:]), vector(pose.planned[0, 3:])
    h = rotate(pose.rotation, vector(p.first_moment))
    spin, speed_up = _turned_inertia(p, pose, omega), _turned_inertia(p, pose, angular)
    force = add(scale(p.mass, origin), add(cross(angular, h), cross(omega, cross(omega, h))))
    moment = add(cross(h, origin), add(speed_up, cross(omega, spin)))
    for i in range(3):
        load[i], load[3 + i] = -force[i], -moment[i]


@kernel
def _turned_inertia(p: Record, pose: Record, omega: Vector) -> Vector:
    """The inertia of platform and payload, seen in {1}, times a vector."""
    return rotate(pose.rotation, rotate(p.inertia, rotate_back(pose.rotation, omega)))


@kernel
def friction_at(p: Record, leg: int, rate: float) -> float:
    """What brakes the drive of a leg at this rate [m/s], as the plant has it [N]."""
    return float(p.coulomb[leg] * rate / np.sqrt(rate * rate + p.friction_velocity**2) + p.viscous[leg] * rate)


@kernel
def find_feed_forward(
    p: Record, s: Record, rig: Record, pose: Record, reference: Record, up: Vector, gravity: float
) -> None:  # fmt: skip
    """Write the feed-forward of each leg, and the load of its drive; `up` is the vertical in {1}, `gravity` in m/s^2."""
    _find_inertial_load(p, pose, s.load)
    find_static_forces(p, s, pose, rig.legs, up, gravity, s.load)
    for k in range(rig.legs):
        s.drive[k] = s.force[k] + own_weight(p, pose, k, up, gravity) + p.sliding_mass * reference.motion[k, 2]
        needed = s.drive[k] + friction_at(p, k, reference.motion[k, 1])
        s.feed_forward[k] = reference.motion[k, 1] + p.command_delay * reference.motion[k, 2] + p.droop * needed
