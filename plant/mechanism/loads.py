"""What a mechanism's actuators bear at home, and whether they can reach its limits.

Static forces follow by virtual work from the weights of platform, payload and legs. The mass matrix of the lengths is that of
all bodies, `J^-T M J^-1` with the Jacobian J of the lengths; the inertia of legs about their own axis is left out.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plant.errors import InputError
from plant.pose import Array

if TYPE_CHECKING:
    from plant.mechanism.spatial import Mechanism

_MOST_CONDITION = 1e6
"""Largest condition number of the Jacobian at which the legs are said to bear the platform."""


class HomeLoads(NamedTuple):
    """What n legs bear at home."""

    forces: Array  # (n,) that hold all weights, positive when the leg pushes [N]
    masses: Array  # (n, n) from the accelerations of the lengths to the forces along the legs [kg]
    jacobian: Array  # (n, n) from the twist along `moving_axes` to the rates of the lengths


def force_constant(mechanism: "Mechanism") -> float:
    """Force along a leg per current of its motor [N/A], and back-EMF per speed of the leg [V s/m]."""
    return float(2.0 * np.pi / mechanism.plant["motor.screw_lead"] * mechanism.plant["motor.torque_constant"])


def moving_axes(mechanism: "Mechanism") -> list[int]:
    """The components of the twist (6,) that the platform has: all, or those in the plane."""
    return [0, 1, 5] if mechanism.planar else [*range(6)]


def home_loads(mechanism: "Mechanism") -> HomeLoads | None:
    """The loads at home; None at a singular home.

    Raises:
        InputError: the mechanism lacks home, limits or a parameter of the dynamics.
    """
    p, home = mechanism.plant_parameters(), mechanism.require_home()
    moving = moving_axes(mechanism)
    arms = mechanism.platform_joints @ home.rotation.T
    vectors = home.position + arms - mechanism.base_joints
    lengths = np.linalg.norm(vectors, axis=1)
    along = vectors / lengths[:, None]
    jacobian = np.hstack([along, np.cross(arms, along)])[:, moving]
    if np.linalg.cond(jacobian) > _MOST_CONDITION:
        return None
    mass, wrench = np.zeros((6, 6)), np.zeros(6)
    for body in ("platform", "payload"):
        center = home.rotation @ np.pad(p[f"{body}.center_of_mass"], (0, 3 - p[f"{body}.center_of_mass"].size))
        inertia = np.diag([0.0, 0.0, float(p[f"{body}.inertia"])]) if mechanism.planar else p[f"{body}.inertia"]
        to_center = point_jacobian(center)
        mass += p[f"{body}.mass"] * to_center.T @ to_center
        mass[3:, 3:] += home.rotation @ inertia @ home.rotation.T
        wrench += p[f"{body}.mass"] * to_center.T @ p["gravity"]
    rod, rod_center = p["leg.upper.mass"], p["leg.upper.center"]
    sliding = rod + p["motor.rotor_inertia"] * (2.0 * np.pi / p["motor.screw_lead"]) ** 2
    swinging = p["leg.lower.inertia"] + p["leg.upper.inertia"] + p["leg.lower.mass"] * p["leg.lower.center"] ** 2
    for length, n, arm in zip(lengths, along, arms, strict=True):
        to_joint, axial = point_jacobian(arm), np.outer(n, n)
        swing = (swinging + rod * (length - rod_center) ** 2) / length**2
        mass += to_joint.T @ (swing * (np.eye(3) - axial) + sliding * axial) @ to_joint
        lever = (p["leg.lower.mass"] * p["leg.lower.center"] + rod * (length - rod_center)) / length
        wrench += to_joint.T @ (rod * axial + lever * (np.eye(3) - axial)) @ p["gravity"]
    inverse = np.linalg.inv(jacobian)
    return HomeLoads(-inverse.T @ wrench[moving], inverse.T @ mass[np.ix_(moving, moving)] @ inverse, jacobian)


def point_jacobian(arm: Array) -> Array:
    """From a twist (6,) to the velocity of the point at `arm` (3,) from the origin of {2}."""
    x, y, z = arm
    return np.hstack([np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]])


def check_reach(mechanism: "Mechanism") -> None:
    """Check that the drives can hold the platform at home and reach the limits there, each leg by itself.

    Raises:
        InputError: names the leg, what it needs, what its drive has, and the remedy.
    """
    loads = home_loads(mechanism)
    if loads is None:
        return
    p, limits = mechanism.plant_parameters(), mechanism.require_limits()
    constant, current = force_constant(mechanism), float(p["drive.current_limit"])
    holding = np.abs(loads.forces)
    leg = int(np.argmax(holding))
    for has, name, unit, needs in (
        (current, "drive.current_limit", "A", holding[leg] / constant),
        (float(p["brake.force"]), "brake.force", "N", holding[leg]),
    ):
        if needs > has:
            raise InputError(
                f"leg {leg} needs {needs:.3g} {unit} to hold the platform at home, and {name} is {has:g} {unit}: check masses "
                "[kg] and drives"
            )
    voltage, resistance = float(p["drive.voltage_limit"]), p["motor.resistance"]
    slipping = holding + p["friction.coulomb"]
    speeds = (constant * voltage - resistance * slipping) / (constant**2 + resistance * p["friction.viscous"])
    pushing = constant * current - slipping - p["friction.viscous"] * limits.velocity
    for name, reached, unit, drive in (
        ("velocity", speeds, "m/s", f"drive.voltage_limit of {voltage:g} V"),
        ("acceleration", pushing / np.diag(loads.masses), "m/s2", f"drive.current_limit of {current:g} A"),
    ):
        leg, limit = int(np.argmin(reached)), getattr(limits, name)
        if reached[leg] < limit:
            raise InputError(
                f"the limit of {name} is {limit:g} {unit}, and leg {leg} reaches {max(float(reached[leg]), 0.0):.3g} {unit} "
                f"at home with its {drive}: lower the limit, or check motor, screw and load"
            )
