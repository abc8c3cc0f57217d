"""The plant's variables: the one table that drives the dynamics, the FMU's layout and its XML, and their use by name.

The table here is that of six legs in space; the planar plant's (`plant.dynamics.planar_variables`) takes the same rows by the
functions that make them for any number of legs.

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
from plant.wiring import IMU_COUNT as IMU_COUNT
from plant.wiring import PLATFORM_IMU as PLATFORM_IMU

Causality = Literal["state", "input", "parameter", "output"]

OPEN, BRAKE, VELOCITY = 0, 1, 2
"""Values of `drive_mode`: motor unpowered and free; held by its brake; driven at `velocity_command`."""

DRIVE_MODES = {OPEN: "open", BRAKE: "brake", VELOCITY: "velocity"}


@dataclass(frozen=True)
class Variable:
    """One variable of a plant: its name, shape (() for a scalar), unit, role, the range that makes sense, and a usual size.

    A parameter outside its range is refused; for the others the range is a promise. A `tunable` parameter may change
    during a run; the others are fixed once initialisation ends. `discrete` marks the drive modes, an enumeration.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    causality: Causality
    description: str
    minimum: float
    maximum: float
    nominal: float
    tunable: bool = False
    discrete: bool = False

    @property
    def size(self) -> int:
        """The number of scalars."""
        return prod(self.shape)


@dataclass(frozen=True)
class VariableTable:
    """All variables of one plant, in the order of its flat vectors."""

    states: tuple[Variable, ...]
    inputs: tuple[Variable, ...]
    parameters: tuple[Variable, ...]
    outputs: tuple[Variable, ...]


def fixed(
    name: str, shape: tuple[int, ...], unit: str, description: str, minimum: float, maximum: float, nominal: float
) -> Variable:
    """A parameter that stays as it is once initialisation ends."""
    return Variable(name, shape, unit, "parameter", description, minimum, maximum, nominal)


def tunable(
    name: str, shape: tuple[int, ...], unit: str, description: str, minimum: float, maximum: float, nominal: float
) -> Variable:
    """A parameter that may change during a run."""
    return Variable(name, shape, unit, "parameter", description, minimum, maximum, nominal, tunable=True)


def output(
    name: str, shape: tuple[int, ...], unit: str, description: str, minimum: float, maximum: float, nominal: float
) -> Variable:
    """What the plant tells of itself."""
    return Variable(name, shape, unit, "output", description, minimum, maximum, nominal)


TINY = 1e-9
"""Smallest value of what must be positive."""


def actuator_states(legs: int) -> tuple[Variable, ...]:
    """Of motors and brakes, in any plant of so many legs."""
    return (
        Variable("state.current", (legs,), "A", "state", "motor currents", -1e4, 1e4, 1),
        Variable("state.brake_deflection", (legs,), "m", "state", "elastic deflection of the brakes", -0.1, 0.1, 1e-4),
    )


def drive_inputs(legs: int) -> tuple[Variable, ...]:
    """Of the drives of so many legs."""
    return (
        Variable(
            "velocity_command", (legs,), "m/s", "input", "commanded speed of each leg, positive when it grows", -10, 10, 0.1
        ),
        Variable("drive_mode", (legs,), "1", "input", "0 open, 1 brake, 2 velocity", OPEN, VELOCITY, 1, discrete=True),
    )


def joint_parameters(legs: int, dimensions: int) -> tuple[Variable, ...]:
    """Where so many legs are joined, in the plane or in space."""
    shape = (legs, dimensions)
    return (
        fixed("base_joints", shape, "m", "base joint of each leg", -100, 100, 0.1),
        fixed("platform_joints", shape, "m", "platform joint of each leg, in {2}", -100, 100, 0.1),
    )


def body_parameters(dimensions: int) -> tuple[Variable, ...]:
    """Of platform and payload, in the plane or in space, where an inertia is a matrix."""
    spatial = dimensions == 3
    made: list[Variable] = []
    for body, make, least in (("platform", fixed, TINY), ("payload", tunable, 0.0)):
        about = f"inertia of the {body} about its centre of mass{', in {2}' if spatial else ''}"
        made += [
            make(f"{body}.mass", (), "kg", f"mass of the {body}", least, 1e6, 1),
            make(f"{body}.center_of_mass", (dimensions,), "m", f"centre of mass of the {body}, in {{2}}", -100, 100, 0.1),
            make(f"{body}.inertia", (3, 3) if spatial else (), "kg.m2", about, -1e8 if spatial else least, 1e8, 0.01),
        ]
    return tuple(made)


LEG_PARAMETERS = (
    fixed("leg.lower.mass", (), "kg", "motor, gearbox and IMU: what turns about the base joint", TINY, 1e5, 1),
    fixed("leg.lower.center", (), "m", "centre of mass of the lower part, from the base joint along the leg", -100, 100, 0.1),
    fixed("leg.lower.inertia", (), "kg.m2", "transverse inertia of the lower part about its centre of mass", 0, 1e6, 0.01),
    fixed("leg.lower.axial_inertia", (), "kg.m2", "inertia of the lower part about the leg's axis", 0, 1e6, 1e-3),
    fixed("leg.upper.mass", (), "kg", "mass of the rod", TINY, 1e5, 1),
    fixed("leg.upper.center", (), "m", "centre of mass of the rod, from the platform joint back along the leg", -100, 100, 0.1),
    fixed("leg.upper.inertia", (), "kg.m2", "transverse inertia of the rod about its centre of mass", 0, 1e6, 0.01),
    fixed("leg.upper.axial_inertia", (), "kg.m2", "inertia of the rod about the leg's axis", 0, 1e6, 1e-3),
)
"""Of every leg's two parts; the inertias about the leg's axis, whose names end in `axial_inertia`, are for legs in space."""


def actuator_parameters(legs: int) -> tuple[Variable, ...]:
    """Of the motors, drives, frictions, brakes and end stops of so many legs."""
    return (
        fixed("motor.resistance", (legs,), "Ohm", "winding resistance", TINY, 1e6, 1),
        fixed("motor.inductance", (), "H", "winding inductance", TINY, 1e3, 1e-3),
        fixed("motor.torque_constant", (), "N.m/A", "torque constant, equal to the back-EMF constant", TINY, 1e3, 0.1),
        fixed("motor.rotor_inertia", (), "kg.m2", "inertia of rotor and screw", TINY, 1e3, 1e-5),
        fixed("motor.screw_lead", (), "m", "advance of the leg per turn", 1e-6, 10, 0.01),
        fixed("drive.nominal_resistance", (), "Ohm", "winding resistance that the drive assumes", 0, 1e6, 1),
        fixed("drive.compensation", (), "1", "share kappa of the resistive drop that the drive makes up for", 0, 10, 1),
        fixed("drive.voltage_limit", (), "V", "largest voltage of the drive", TINY, 1e5, 10),
        fixed("drive.current_limit", (), "A", "largest current of the drive", TINY, 1e4, 10),
        fixed("drive.current_time_constant", (), "s", "time constant of the current limiter", TINY, 100, 1e-3),
        tunable("friction.coulomb", (legs,), "N", "Coulomb friction of each leg", 0, 1e6, 10),
        tunable("friction.viscous", (legs,), "N.s/m", "viscous friction of each leg", 0, 1e6, 10),
        tunable("friction.velocity", (), "m/s", "speed over which Coulomb friction changes sign", TINY, 10, 1e-3),
        fixed("brake.force", (), "N", "force at which a closed brake slips", TINY, 1e7, 1e3),
        fixed("brake.stiffness", (), "N/m", "stiffness of a closed brake", TINY, 1e10, 1e6),
        fixed("brake.damping", (), "N.s/m", "damping of a closed brake", 0, 1e7, 1e3),
        fixed("brake.release_time", (), "s", "time constant with which an opened brake relaxes", TINY, 100, 0.01),
        fixed("stop.minimum_length", (legs,), "m", "leg length at which the lower end stop touches", 0, 100, 0.1),
        fixed("stop.maximum_length", (legs,), "m", "leg length at which the upper end stop touches", TINY, 100, 0.1),
        fixed("stop.stiffness", (), "N/m", "stiffness of the end stops", 0, 1e10, 1e6),
        fixed("stop.damping", (), "s/m", "damping of the end stops relative to their force", 0, 1e4, 1),
    )


def surroundings_parameters(legs: int) -> tuple[Variable, ...]:
    """Of the fields around the mechanism and the places of its IMUs."""
    return (
        tunable("gravity", (3,), "m/s2", "acceleration of gravity", -1e3, 1e3, 10),
        fixed("magnetic_field", (3,), "uT", "magnetic field of the earth", -1e4, 1e4, 10),
        fixed(
            "leg_imu_position", (legs, 3), "m", "place of each leg's IMU from the base joint, in the leg frame", -100, 100, 0.1
        ),
        fixed("platform_imu_position", (3,), "m", "place of the platform's IMU, in {2}", -100, 100, 0.1),
    )


SUBSTEP = fixed("substep", (), "s", "largest internal integration step", 1e-6, 0.1, 1e-3)


def imu_outputs(legs: int) -> tuple[Variable, ...]:
    """The ideal signals of the IMUs on so many legs and the platform."""
    shape, which = (legs + 1, 3), f"legs 0-{legs - 1}, platform; sensor frames"
    return (
        output("imu_angular_velocity", shape, "rad/s", f"ideal gyroscopes: {which}", -1e3, 1e3, 0.1),
        output("imu_specific_force", shape, "m/s2", f"ideal accelerometers: {which}", -1e5, 1e5, 10),
        output("imu_magnetic_field", shape, "uT", f"ideal magnetometers: {which}", -2e4, 2e4, 10),
    )


def actuator_outputs(legs: int) -> tuple[Variable, ...]:
    """Of so many legs and their actuators, and the balance of energy."""
    return (
        output("leg_length", (legs,), "m", "lengths of the legs", 0, 400, 0.1),
        output("leg_velocity", (legs,), "m/s", "rates of the lengths", -1e3, 1e3, 0.1),
        output("current", (legs,), "A", "motor currents", -1e4, 1e4, 1),
        output("voltage", (legs,), "V", "drive voltages that are asked for, within the voltage limit", -1e5, 1e5, 10),
        output("kinetic_energy", (), "J", "of all bodies and rotors", 0, 1e9, 1),
        output("potential_energy", (), "J", "of all bodies in the field of gravity", -1e9, 1e9, 10),
        output("power.drive", (), "W", "mechanical power of the motors", -1e9, 1e9, 10),
        output("power.friction", (), "W", "power lost in friction, as a negative number", -1e9, 0, 1),
        output("power.brake", (), "W", "power of the brakes on the legs", -1e9, 1e9, 1),
        output("power.stop", (), "W", "power of the end stops on the legs", -1e9, 1e9, 1),
        output("power.external", (), "W", "power of the external wrench", -1e9, 1e9, 1),
    )


STATES = (
    Variable("state.position", (3,), "m", "state", "origin of the platform frame {2}", -100, 100, 0.1),
    Variable("state.quaternion", (4,), "1", "state", "rotation of {2} to {1}, w first", -1.001, 1.001, 1),
    Variable("state.velocity", (3,), "m/s", "state", "velocity of the origin of {2}", -100, 100, 0.1),
    Variable("state.angular_velocity", (3,), "rad/s", "state", "angular velocity of {2}", -1e3, 1e3, 0.1),
    *actuator_states(6),
)

INPUTS = (
    *drive_inputs(6),
    Variable("external_wrench.force", (3,), "N", "input", "force on the origin of {2}", -1e6, 1e6, 100),
    Variable("external_wrench.torque", (3,), "N.m", "input", "torque on the platform", -1e6, 1e6, 10),
)

PARAMETERS = (
    *joint_parameters(6, 3),
    fixed("base_joint_axes", (6, 3), "1", "unit first axis of each universal joint, fixed in the base", -1.001, 1.001, 1),
    *body_parameters(3),
    *LEG_PARAMETERS,
    *actuator_parameters(6),
    *surroundings_parameters(6),
    fixed("initial_position", (3,), "m", "origin of {2} at the start", -100, 100, 0.1),
    fixed("initial_quaternion", (4,), "1", "rotation of {2} to {1} at the start, w first", -1.001, 1.001, 1),
    SUBSTEP,
)

OUTPUTS = (
    *imu_outputs(6),
    output("position", (3,), "m", "origin of {2}", -100, 100, 0.1),
    output("quaternion", (4,), "1", "rotation of {2} to {1}, w first", -1.001, 1.001, 1),
    output("velocity", (3,), "m/s", "velocity of the origin of {2}", -100, 100, 0.1),
    output("angular_velocity", (3,), "rad/s", "angular velocity of {2}", -1e3, 1e3, 0.1),
    *actuator_outputs(6),
)

SPATIAL = VariableTable(STATES, INPUTS, PARAMETERS, OUTPUTS)


def checked_parameters(values: Mapping[str, ArrayLike], table: VariableTable = SPATIAL) -> dict[str, Array]:
    """Check parameter values against a table; scalars are spread over arrays.

    Raises:
        UnknownNameError: a name that is no parameter.
        InputError: wrong shape, not finite, or out of range.
    """
    known = {variable.name: variable for variable in table.parameters}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError(f"the plant has no parameter {name!r}; it has {', '.join(known)}")
        variable = known[name]
        given = numbers(value, name, variable.shape)
        if given.ndim == 0 and len(variable.shape) == 1:
            given = np.full(variable.shape, given)
        array = checked_array(given, variable.shape, name)
        for outside in array[(array < variable.minimum) | (array > variable.maximum)][:1]:
            raise InputError(f"{name} is {outside:g} {variable.unit}; it must be {variable.minimum:g} to {variable.maximum:g}")
        checked[name] = array
    return checked
