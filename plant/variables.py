"""The plant's variables: the one table that drives the dynamics, the FMU's layout and its XML, and their use by name.

Arrays are row-major. Vectors are seen in the base frame {1} unless the description names another.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from plant.errors import InputError, UnknownNameError
from plant.pose import Array, checked_array, numbers

Causality = Literal["state", "input", "parameter", "output"]

OPEN, BRAKE, VELOCITY = 0, 1, 2
"""Values of `drive_mode`: motor unpowered and free; held by its brake; driven at `velocity_command`."""

DRIVE_MODES = {OPEN: "open", BRAKE: "brake", VELOCITY: "velocity"}
PLATFORM_IMU = 6
"""Row of the platform's IMU in arrays over the seven IMUs; rows 0 to 5 are the legs'."""
IMU_COUNT = 7


@dataclass(frozen=True)
class Variable:
    """One variable of the plant: its name, shape (() for a scalar), unit, role, and for parameters its smallest value.

    A `tunable` parameter may change during a run; the others are fixed once initialisation ends. `discrete` marks
    the drive modes, an enumeration.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    causality: Causality
    description: str
    minimum: float | None = None
    tunable: bool = False
    discrete: bool = False

    @property
    def size(self) -> int:
        """The number of scalars."""
        return prod(self.shape)


def _fixed(name: str, shape: tuple[int, ...], unit: str, description: str, minimum: float | None = None) -> Variable:
    return Variable(name, shape, unit, "parameter", description, minimum)


def _tunable(name: str, shape: tuple[int, ...], unit: str, description: str, minimum: float | None = None) -> Variable:
    return Variable(name, shape, unit, "parameter", description, minimum, tunable=True)


TINY = 1e-9
"""Smallest value of what must be positive."""

STATES = (
    Variable("state.position", (3,), "m", "state", "origin of the platform frame {2}"),
    Variable("state.quaternion", (4,), "1", "state", "rotation of {2} to {1}, w first"),
    Variable("state.velocity", (3,), "m/s", "state", "velocity of the origin of {2}"),
    Variable("state.angular_velocity", (3,), "rad/s", "state", "angular velocity of {2}"),
    Variable("state.current", (6,), "A", "state", "motor currents"),
    Variable("state.brake_deflection", (6,), "m", "state", "elastic deflection of the brakes"),
)

INPUTS = (
    Variable("velocity_command", (6,), "m/s", "input", "commanded speed of each leg, positive when it grows"),
    Variable("drive_mode", (6,), "1", "input", "0 open, 1 brake, 2 velocity", discrete=True),
    Variable("external_wrench", (6,), "N", "input", "force [N] on the origin of {2}, then torque [N.m]"),
)

PARAMETERS = (
    _fixed("base_joints", (6, 3), "m", "base joint of each leg"),
    _fixed("platform_joints", (6, 3), "m", "platform joint of each leg, in {2}"),
    _fixed("base_joint_axes", (6, 3), "1", "unit first axis of each universal joint, fixed in the base"),
    _fixed("platform.mass", (), "kg", "mass of the platform", TINY),
    _fixed("platform.center_of_mass", (3,), "m", "centre of mass of the platform, in {2}"),
    _fixed("platform.inertia", (3, 3), "kg.m2", "inertia of the platform about its centre of mass, in {2}"),
    _tunable("payload.mass", (), "kg", "mass of the payload", 0.0),
    _tunable("payload.center_of_mass", (3,), "m", "centre of mass of the payload, in {2}"),
    _tunable("payload.inertia", (3, 3), "kg.m2", "inertia of the payload about its centre of mass, in {2}"),
    _fixed("leg.lower.mass", (), "kg", "motor, gearbox and IMU: what turns about the base joint", TINY),
    _fixed("leg.lower.center", (), "m", "centre of mass of the lower part, from the base joint along the leg"),
    _fixed("leg.lower.inertia", (), "kg.m2", "transverse inertia of the lower part about its centre of mass", 0.0),
    _fixed("leg.lower.axial_inertia", (), "kg.m2", "inertia of the lower part about the leg's axis", 0.0),
    _fixed("leg.upper.mass", (), "kg", "mass of the rod", TINY),
    _fixed("leg.upper.center", (), "m", "centre of mass of the rod, from the platform joint back along the leg"),
    _fixed("leg.upper.inertia", (), "kg.m2", "transverse inertia of the rod about its centre of mass", 0.0),
    _fixed("leg.upper.axial_inertia", (), "kg.m2", "inertia of the rod about the leg's axis", 0.0),
    _fixed("motor.resistance", (6,), "Ohm", "winding resistance", TINY),
    _fixed("motor.inductance", (), "H", "winding inductance", TINY),
    _fixed("motor.torque_constant", (), "N.m/A", "torque constant, equal to the back-EMF constant", TINY),
    _fixed("motor.rotor_inertia", (), "kg.m2", "inertia of rotor and screw", TINY),
    _fixed("motor.screw_lead", (), "m", "advance of the leg per turn", TINY),
    _fixed("drive.nominal_resistance", (), "Ohm", "winding resistance that the drive assumes", 0.0),
    _fixed("drive.compensation", (), "1", "share kappa of the resistive drop that the drive makes up for", 0.0),
    _fixed("drive.voltage_limit", (), "V", "largest voltage of the drive", TINY),
    _fixed("drive.current_limit", (), "A", "largest current of the drive", TINY),
    _fixed("drive.current_time_constant", (), "s", "time constant of the current limiter", TINY),
    _tunable("friction.coulomb", (6,), "N", "Coulomb friction of each leg", 0.0),
    _tunable("friction.viscous", (6,), "N.s/m", "viscous friction of each leg", 0.0),
    _tunable("friction.velocity", (), "m/s", "speed over which Coulomb friction changes sign", TINY),
    _fixed("brake.force", (), "N", "force at which a closed brake slips", TINY),
    _fixed("brake.stiffness", (), "N/m", "stiffness of a closed brake", TINY),
    _fixed("brake.damping", (), "N.s/m", "damping of a closed brake", 0.0),
    _fixed("brake.release_time", (), "s", "time constant with which an opened brake relaxes", TINY),
    _fixed("stop.minimum_length", (6,), "m", "leg length at which the lower end stop touches", TINY),
    _fixed("stop.maximum_length", (6,), "m", "leg length at which the upper end stop touches", TINY),
    _fixed("stop.stiffness", (), "N/m", "stiffness of the end stops", 0.0),
    _fixed("stop.damping", (), "s/m", "damping of the end stops relative to their force", 0.0),
    _tunable("gravity", (3,), "m/s2", "acceleration of gravity"),
    _fixed("magnetic_field", (3,), "uT", "magnetic field of the earth"),
    _fixed("leg_imu_position", (6, 3), "m", "place of each leg's IMU from the base joint, in the leg frame"),
    _fixed("platform_imu_position", (3,), "m", "place of the platform's IMU, in {2}"),
    _fixed("initial_position", (3,), "m", "origin of {2} at the start"),
    _fixed("initial_quaternion", (4,), "1", "rotation of {2} to {1} at the start, w first"),
    _fixed("substep", (), "s", "largest internal integration step", 1e-6),
)

OUTPUTS = (
    Variable("imu_angular_velocity", (7, 3), "rad/s", "output", "ideal gyroscopes: legs 0-5, platform; sensor frames"),
    Variable("imu_specific_force", (7, 3), "m/s2", "output", "ideal accelerometers: legs 0-5, platform; sensor frames"),
    Variable("imu_magnetic_field", (7, 3), "uT", "output", "ideal magnetometers: legs 0-5, platform; sensor frames"),
    Variable("position", (3,), "m", "output", "origin of {2}"),
    Variable("quaternion", (4,), "1", "output", "rotation of {2} to {1}, w first"),
    Variable("velocity", (3,), "m/s", "output", "velocity of the origin of {2}"),
    Variable("angular_velocity", (3,), "rad/s", "output", "angular velocity of {2}"),
    Variable("leg_length", (6,), "m", "output", "lengths of the legs"),
    Variable("leg_velocity", (6,), "m/s", "output", "rates of the lengths"),
    Variable("current", (6,), "A", "output", "motor currents"),
    Variable("voltage", (6,), "V", "output", "drive voltages that are asked for, within the voltage limit"),
    Variable("kinetic_energy", (), "J", "output", "of all bodies and rotors"),
    Variable("potential_energy", (), "J", "output", "of all bodies in the field of gravity"),
    Variable("power.drive", (), "W", "output", "mechanical power of the motors"),
    Variable("power.friction", (), "W", "output", "power lost in friction, as a negative number"),
    Variable("power.brake", (), "W", "output", "power of the brakes on the legs"),
    Variable("power.stop", (), "W", "output", "power of the end stops on the legs"),
    Variable("power.external", (), "W", "output", "power of the external wrench"),
)

BY_NAME = {variable.name: variable for variable in (*STATES, *INPUTS, *PARAMETERS, *OUTPUTS)}


def checked_parameters(values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Check parameter values against the table; scalars are spread over arrays.

    Raises:
        UnknownNameError: a name that is no parameter.
        InputError: wrong shape, not finite, or below the smallest value.
    """
    known = {variable.name: variable for variable in PARAMETERS}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError(f"the plant has no parameter {name!r}; it has {', '.join(known)}")
        variable = known[name]
        given = numbers(value, name, variable.shape)
        if given.ndim == 0 and len(variable.shape) == 1:
            given = np.full(variable.shape, given)
        array = checked_array(given, variable.shape, name)
        if variable.minimum is not None and (array < variable.minimum).any():
            raise InputError(f"{name} is {array.min():g} {variable.unit}; it must be at least {variable.minimum:g}")
        checked[name] = array
    return checked
