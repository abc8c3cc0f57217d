"""Load feed-forward: the reference speed, and what the drives need beyond it for weight and acceleration.

An encoderless drive falls short of its command by `droop` x force. Static leg forces follow from the known weight by virtual
work: `J^T f` balances the weight of platform and payload, of each leg's lower part and rod through the moment about its base
joint, and each rod's own weight along its leg.
"""

import numpy as np

from controller.inverse_kinematics import jacobian_at
from controller.least_squares import RANK_TOLERANCE, solve_least_squares
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS, Mechanism

PARAMETERS = record_dtype(
    command_delay=np.float64,
    droop=np.float64,
    moving_mass=np.float64,
    mass=np.float64,
    first_moment=(np.float64, 3),
    lower_moment=np.float64,
    rod_mass=np.float64,
    rod_center=np.float64,
)
"""Constants of the feed-forward.

Fields:
    command_delay: of the rig, from a sample to the command computed from it [s].
    droop: by how much a drive falls short of its command per force [m/s/N].
    moving_mass: that each drive accelerates [kg].
    mass, first_moment: of platform and payload [kg, kg m in {2}].
    lower_moment: mass times centre of a leg's lower part [kg m].
    rod_mass, rod_center: of a leg's rod [kg, m from its platform joint].
"""

STATE = record_dtype(
    feed_forward=(np.float64, LEGS),
    wrench=(np.float64, 6),
    force=(np.float64, 6),
    jacobian=(np.float64, (6, 6)),
    transposed=(np.float64, (6, 6)),
    norms=(np.float64, 6),
    order=(np.float64, 6),
)
"""The feed-forward [m/s], and scratch."""


def load_parameters(mechanism: Mechanism, command_delay: float) -> Record:
    """The constants of the feed-forward (dtype `PARAMETERS`)."""
    plant = mechanism.plant_parameters()
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    mass = plant["platform.mass"] + plant["payload.mass"]
    sliding_mass = plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2
    moments = [plant[f"{body}.mass"] * plant[f"{body}.center_of_mass"] for body in ("platform", "payload")]
    values = {
        "command_delay": command_delay,
        "droop": plant["drive.nominal_resistance"] * (1.0 - plant["drive.compensation"]) / force_constant**2,
        "moving_mass": sliding_mass + mass / mechanism.legs,
        "mass": mass,
        "first_moment": np.pad(moments[0] + moments[1], (0, 3 - moments[0].size)),
        "lower_moment": plant["leg.lower.mass"] * plant["leg.lower.center"],
        "rod_mass": plant["leg.upper.mass"],
        "rod_center": plant["leg.upper.center"],
    }
    return filled(PARAMETERS, values)


@kernel
def find_feed_forward(p: Record, s: Record, rig: Record, pose: Record, reference: Record) -> None:
    """Write the feed-forward of each leg.

    Args:
        p, s: dtypes `PARAMETERS` and `STATE`.
        rig: dtype `RIG`.
        pose, reference: states of these stages.
    """
    up, gravity = rig.sensors.up_in_base[0], rig.sensors.gravity
    wrench, force, rotation = s.wrench, s.force, pose.rotation
    jacobian_at(pose.arms, pose.directions, rig.legs, s.jacobian)
    for i in range(6):
        wrench[i] = p.mass * gravity * up[i] if i < 3 else 0.0
        for j in range(6):
            s.transposed[i, j] = s.jacobian[j, i]
    m0 = m1 = m2 = 0.0
    for j in range(3):
        m0 += rotation[0, j] * p.first_moment[j]
        m1 += rotation[1, j] * p.first_moment[j]
        m2 += rotation[2, j] * p.first_moment[j]
    wrench[3] = gravity * (m1 * up[2] - m2 * up[1])
    wrench[4] = gravity * (m2 * up[0] - m0 * up[2])
    wrench[5] = gravity * (m0 * up[1] - m1 * up[0])
    for k in range(rig.legs):
        d, a = pose.directions[k], pose.arms[k]
        along = d[0] * up[0] + d[1] * up[1] + d[2] * up[2]
        lever = (p.lower_moment + p.rod_mass * (pose.lengths[k] - p.rod_center)) * gravity / pose.lengths[k]
        f0, f1, f2 = lever * (up[0] - along * d[0]), lever * (up[1] - along * d[1]), lever * (up[2] - along * d[2])
        wrench[0] += f0
        wrench[1] += f1
        wrench[2] += f2
        wrench[3] += a[1] * f2 - a[2] * f1
        wrench[4] += a[2] * f0 - a[0] * f2
        wrench[5] += a[0] * f1 - a[1] * f0
    if solve_least_squares(s.transposed, wrench, 6, force, s.norms, s.order) < RANK_TOLERANCE:
        for k in range(rig.legs):
            force[k] = 0.0
    for k in range(rig.legs):
        d = pose.directions[k]
        own = p.rod_mass * gravity * (d[0] * up[0] + d[1] * up[1] + d[2] * up[2])
        load = force[k] + own + p.moving_mass * reference.motion[k, 2]
        s.feed_forward[k] = reference.motion[k, 1] + p.command_delay * reference.motion[k, 2] + p.droop * load
