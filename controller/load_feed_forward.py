"""Load feed-forward: the reference speed, and what the drives need beyond it for weight and acceleration.

An encoderless drive falls short of its command by `droop` x force. Static leg forces follow from the known weight by virtual
work: `J^T f` balances the weight of platform and payload, of each leg's lower part and rod through the moment about its base
joint, and each rod's own weight along its leg.
"""

from collections.abc import Mapping

import numpy as np

from controller.inverse_kinematics import jacobian_at
from controller.least_squares import RANK_TOLERANCE, solve_square
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector

PARAMETERS = record_dtype(
    command_delay=np.float64,  # of the rig, from a sample to the command computed from it [s]
    droop=np.float64,  # by how much a drive falls short of its command per force [m/s/N]
    moving_mass=np.float64,  # that each drive accelerates [kg]
    mass=np.float64,  # of platform and payload [kg]
    first_moment=(np.float64, 3),  # of platform and payload [kg m in {2}]
    lower_moment=np.float64,  # mass times centre of a leg's lower part [kg m]
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
"""The feed-forward [m/s], the load of each drive [N], an external load (none is known), the static forces on the platform [N],
and scratch."""


def load_parameters(mechanism: Mechanism, command_delay: float, position: bool = False) -> Record:
    """The constants of the feed-forward (dtype `PARAMETERS`); drives that close a `position` loop do not droop."""
    plant = mechanism.plant_parameters()
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    mass, first_moment = first_moment_of(plant)
    sliding_mass = plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2
    droop = plant["drive.nominal_resistance"] * (1.0 - plant["drive.compensation"]) / force_constant**2
    return filled(
        PARAMETERS,
        command_delay=command_delay,
        droop=0.0 if position else droop,
        moving_mass=sliding_mass + mass / mechanism.legs,
        mass=mass,
        first_moment=first_moment,
        lower_moment=plant["leg.lower.mass"] * plant["leg.lower.center"],
        rod_mass=plant["leg.upper.mass"],
        rod_center=plant["leg.upper.center"],
    )


def first_moment_of(plant: Mapping[str, Array]) -> tuple[float, Array]:
    """The mass [kg] of platform and payload together, and their first moment (3,) in {2} [kg m]."""
    masses = [plant[f"{body}.mass"] for body in ("platform", "payload")]
    centers = [plant.get(f"{body}.center_of_mass", np.zeros(3)) for body in ("platform", "payload")]
    moment: Array = masses[0] * centers[0] + masses[1] * centers[1]
    return float(masses[0] + masses[1]), np.pad(moment, (0, 3 - moment.size))


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
def find_feed_forward(
    p: Record, s: Record, rig: Record, pose: Record, reference: Record, up: Vector, gravity: float
) -> None:  # fmt: skip
    """Write the feed-forward of each leg, and the load of its drive; `up` is the vertical in {1}, `gravity` in m/s^2."""
    find_static_forces(p, s, pose, rig.legs, up, gravity, s.load)
    for k in range(rig.legs):
        s.drive[k] = s.force[k] + own_weight(p, pose, k, up, gravity) + p.moving_mass * reference.motion[k, 2]
        s.feed_forward[k] = reference.motion[k, 1] + p.command_delay * reference.motion[k, 2] + p.droop * s.drive[k]
