"""The plants' variables: the tables that drive the dynamics, the FMUs' layout and XML, and all use of variables by name.

Arrays are row-major. Vectors are seen in the base frame {1} unless the description names another. The IMUs of the planar plant
measure in space: a leg's sensor frame has its x axis along the plane's normal and its z axis along the leg.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import prod
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from plant.checks import nearest
from plant.errors import InputError, UnknownNameError
from plant.imu_wiring import IMU_COUNT as IMU_COUNT
from plant.imu_wiring import PLATFORM_IMU as PLATFORM_IMU
from plant.pose import Array, checked_array, numbers

Causality = Literal["state", "input", "parameter", "output"]

OPEN, BRAKE, VELOCITY = 0, 1, 2
"""Values of `drive_mode`: free, held by the brake, or driven at `velocity_command`."""

DRIVE_MODES = {OPEN: "open", BRAKE: "brake", VELOCITY: "velocity"}

TINY = 1e-9
"""The smallest value of a parameter that must be positive."""


@dataclass(frozen=True)
class Variable:
    """One variable of a plant, with the names of FMI; the shape of a scalar is ().

    A parameter outside its range is refused; other variables stay inside. A `tunable` parameter may change during a run.
    `discrete` marks the drive modes, an enumeration. A `disturbance` is zero in the ideal case, which has shorter equations.
    A mechanism that gives no value has the `default`.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    description: str
    minimum: float
    maximum: float
    nominal: float
    causality: Causality
    tunable: bool = False
    discrete: bool = False
    disturbance: bool = False
    default: float | None = None

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

    @property
    def variables(self) -> tuple[Variable, ...]:
        """All of them."""
        return (*self.states, *self.inputs, *self.parameters, *self.outputs)


Shape = tuple[int, ...]
Maker = Callable[..., Variable]


_state: Maker = partial(Variable, causality="state")
_resting: Maker = partial(Variable, causality="state", disturbance=True)
_input: Maker = partial(Variable, causality="input")
_disturbing: Maker = partial(Variable, causality="input", disturbance=True)
_fixed: Maker = partial(Variable, causality="parameter")
_imperfect: Maker = partial(Variable, causality="parameter", disturbance=True, default=0.0)
_tunable: Maker = partial(Variable, causality="parameter", tunable=True)
_output: Maker = partial(Variable, causality="output")


def _pose(make: Maker, prefix: str, dimensions: int, when: str = "") -> tuple[Variable, Variable]:
    position = make(f"{prefix}position", (dimensions,), "m", f"origin of {{2}}{when}", -100, 100, 0.1)
    if dimensions == 2:
        return position, make(f"{prefix}angle", (), "rad", f"from {{1}} to {{2}}{when}, counter-clockwise", -1e3, 1e3, 1)
    return position, make(f"{prefix}quaternion", (4,), "1", f"rotation of {{2}} to {{1}}{when}, w first", -1.001, 1.001, 1)


def _twist(make: Maker, prefix: str, dimensions: int) -> tuple[Variable, Variable]:
    return (
        make(f"{prefix}velocity", (dimensions,), "m/s", "velocity of the origin of {2}", -100, 100, 0.1),
        make(f"{prefix}angular_velocity", _turning(dimensions), "rad/s", "angular velocity of {2}", -1e3, 1e3, 0.1),
    )


def _turning(dimensions: int) -> Shape:
    """The shape of an angular velocity or a torque."""
    return (3,) if dimensions == 3 else ()


def _states(legs: int, dimensions: int) -> tuple[Variable, ...]:
    return (
        *_pose(_state, "state.", dimensions),
        *_twist(_state, "state.", dimensions),
        _state("state.current", (legs,), "A", "motor currents", -1e4, 1e4, 1),
        _state("state.brake_deflection", (legs,), "m", "elastic deflection of the brakes", -0.1, 0.1, 1e-4),
        _resting(
            "state.bending", (legs, 2), "rad", "bending: further angles of the base joints about their two axes", -1, 1, 1e-3
        ),
        _resting("state.bending_rate", (legs, 2), "rad/s", "rate of the bending", -100, 100, 0.1),
        _resting("state.play", (legs,), "m", "how far the motor is ahead of the middle of its play", -1, 1, 1e-4),
        _resting("state.play_velocity", (legs,), "m/s", "velocity of the motor ahead of the rod", -10, 10, 0.01),
    )


def _inputs(legs: int, dimensions: int) -> tuple[Variable, ...]:
    sense = "" if dimensions == 3 else ", counter-clockwise"
    return (
        _input("velocity_command", (legs,), "m/s", "commanded speed of each leg, positive when it grows", -10, 10, 0.1),
        _input("drive_mode", (legs,), "1", "0 open, 1 brake, 2 velocity", OPEN, VELOCITY, 1, discrete=True),
        _input("external_wrench.force", (dimensions,), "N", "force on the origin of {2}", -1e6, 1e6, 100),
        _input("external_wrench.torque", _turning(dimensions), "N.m", f"torque on the platform{sense}", -1e6, 1e6, 10),
        *(
            _disturbing(f"base_motion.{name}", (3,), unit, description, -most, most, nominal)
            for name, unit, description, most, nominal in _BASE_MOTION
        ),
    )


_BASE_MOTION = (
    ("rotation", "rad", "rotation vector that has turned the base {1} from the attitude in which gravity is given", 1e3, 0.1),
    ("angular_velocity", "rad/s", "angular velocity of the base", 1e3, 0.1),
    ("angular_acceleration", "rad/s2", "angular acceleration of the base", 1e5, 1),
    ("acceleration", "m/s2", "acceleration of the origin of {1}, without gravity", 1e5, 1),
)
"""Name, unit, description, greatest and nominal value of what the inputs tell of the base's motion."""


def _body(make: Maker, body: str, dimensions: int, least: float) -> tuple[Variable, ...]:
    """Mass properties of platform or payload; in the plane the inertia is a number."""
    spatial = dimensions == 3
    about = f"inertia of the {body} about its centre of mass{', in {2}' if spatial else ''}"
    return (
        make(f"{body}.mass", (), "kg", f"mass of the {body}", least, 1e6, 1),
        make(f"{body}.center_of_mass", (dimensions,), "m", f"centre of mass of the {body}, in {{2}}", -100, 100, 0.1),
        make(f"{body}.inertia", (3, 3) if spatial else (), "kg.m2", about, -1e8 if spatial else least, 1e8, 0.01),
    )


def _leg_part(name: str, part: str, mass: str, center: str, dimensions: int) -> tuple[Variable, ...]:
    """Mass properties of one part of every leg; a planar leg does not turn about its axis."""
    axial = _fixed(f"leg.{name}.axial_inertia", (), "kg.m2", f"inertia of the {part} about the leg's axis", 0, 1e6, 1e-3)
    return (
        _fixed(f"leg.{name}.mass", (), "kg", mass, TINY, 1e5, 1),
        _fixed(f"leg.{name}.center", (), "m", f"centre of mass of the {part}, from the {center} the leg", -100, 100, 0.1),
        _fixed(f"leg.{name}.inertia", (), "kg.m2", f"transverse inertia of the {part} about its centre of mass", 0, 1e6, 0.01),
        *((axial,) if dimensions == 3 else ()),
    )


def _parameters(legs: int, dimensions: int) -> tuple[Variable, ...]:
    each, joints = (legs,), (legs, dimensions)
    axes = _fixed(
        "base_joint_axes", joints, "1", "unit first axis of each universal joint, fixed in the base", -1.001, 1.001, 1
    )
    offset = _imperfect("base_joint_offset", each, "m", "from first to second axis of each universal joint", -1, 1, 1e-3)
    flanks, guide = (1e6, 0.2) if dimensions == 3 else (1e5, 0.1)
    lower = "motor, gearbox and IMU: everything that turns about the base joint"
    return (
        _fixed("base_joints", joints, "m", "base joint of each leg", -100, 100, 0.1),
        _fixed("platform_joints", joints, "m", "platform joint of each leg, in {2}", -100, 100, 0.1),
        *((axes,) if dimensions == 3 else ()),
        *((offset,) if dimensions == 3 else ()),
        *_body(_fixed, "platform", dimensions, TINY),
        *_body(_tunable, "payload", dimensions, 0.0),
        *_leg_part("lower", "lower part", lower, "base joint along", dimensions),
        *_leg_part("upper", "rod", "mass of the rod", "platform joint back along", dimensions),
        _imperfect("leg.bending_compliance", each, "rad/N.m", "bend of each leg in its guide", 0, 1, 1e-4),
        _fixed(
            "leg.guide",
            (),
            "m",
            "guide of the rod, where the leg bends, from the base joint along the leg",
            0,
            100,
            0.1,
            default=guide,
        ),
        _fixed("leg.bending_frequency", (), "1/s", "natural frequency of the bending", TINY, 1e5, 100, default=80.0),
        _fixed("leg.bending_damping", (), "1", "damping of the bending, relative to the critical one", 0, 10, 0.1, default=0.1),
        _fixed("motor.resistance", each, "Ohm", "winding resistance", TINY, 1e6, 1),
        _fixed("motor.inductance", (), "H", "winding inductance", TINY, 1e3, 1e-3),
        _fixed("motor.torque_constant", (), "N.m/A", "torque constant, equal to the back-EMF constant", TINY, 1e3, 0.1),
        _fixed("motor.rotor_inertia", (), "kg.m2", "inertia of rotor and screw", TINY, 1e3, 1e-5),
        _fixed("motor.screw_lead", (), "m", "advance of the leg per turn", 1e-6, 10, 0.01),
        _imperfect("screw.backlash", each, "m", "play between motor and rod", 0, 0.1, 1e-4),
        _imperfect("joint.clearance", each, "m", "play of base and platform joint together, along the leg", 0, 0.1, 1e-4),
        _fixed(
            "screw.stiffness",
            (),
            "N/m",
            "stiffness of the screw's flanks, where there is play",
            TINY,
            1e10,
            1e6,
            default=flanks,
        ),
        _fixed("screw.damping", (), "s/m", "damping of the flanks relative to their force", 0, 1e4, 1, default=5.0),
        _fixed("drive.nominal_resistance", (), "Ohm", "winding resistance that the drive assumes", 0, 1e6, 1),
        _fixed("drive.gain", each, "1", "speed of each leg without load over its command", TINY, 1e3, 1, default=1.0),
        _fixed("drive.compensation", (), "1", "share kappa of the resistive drop that the drive compensates", 0, 10, 1),
        _fixed("drive.voltage_limit", (), "V", "largest voltage of the drive", TINY, 1e5, 10),
        _fixed("drive.current_limit", (), "A", "largest current of the drive", TINY, 1e4, 10),
        _fixed("drive.current_time_constant", (), "s", "time constant of the current limiter", TINY, 100, 1e-3),
        _tunable("friction.coulomb", each, "N", "Coulomb friction of each leg", 0, 1e6, 10),
        _tunable("friction.viscous", each, "N.s/m", "viscous friction of each leg", 0, 1e6, 10),
        _tunable("friction.velocity", (), "m/s", "speed over which Coulomb friction changes sign", TINY, 10, 1e-3),
        _fixed("brake.force", (), "N", "force at which a closed brake slips", TINY, 1e7, 1e3),
        _fixed("brake.stiffness", (), "N/m", "stiffness of a closed brake", TINY, 1e10, 1e6),
        _fixed("brake.damping", (), "N.s/m", "damping of a closed brake", 0, 1e7, 1e3),
        _fixed("brake.release_time", (), "s", "time constant with which an opened brake relaxes", TINY, 100, 0.01),
        _fixed("stop.minimum_length", each, "m", "leg length at which the lower end stop touches", 0, 100, 0.1),
        _fixed("stop.maximum_length", each, "m", "leg length at which the upper end stop touches", TINY, 100, 0.1),
        _fixed("stop.stiffness", (), "N/m", "stiffness of the end stops", 0, 1e10, 1e6),
        _fixed("stop.damping", (), "s/m", "damping of the end stops relative to their force", 0, 1e4, 1),
        _tunable("gravity", (3,), "m/s2", "acceleration of gravity, before the base has turned", -1e3, 1e3, 10),
        _fixed("magnetic_field", (3,), "uT", "magnetic field of the earth, before the base has turned", -1e4, 1e4, 10),
        _fixed("leg_imu_position", (legs, 3), "m", "each leg's IMU from the base joint, in the leg frame", -100, 100, 0.1),
        _fixed("platform_imu_position", (3,), "m", "the platform's IMU, in {2}", -100, 100, 0.1),
        _fixed("base_imu_position", (3,), "m", "the base's IMU, in {1}", -100, 100, 0.1, default=0.0),
        *_pose(_fixed, "initial_", dimensions, " at the start"),
        _fixed("substep", (), "s", "largest internal integration step", 1e-6, 0.1, 1e-3),
    )


def _outputs(legs: int, dimensions: int) -> tuple[Variable, ...]:
    imus, which = (legs + 1, 3), f"legs 0-{legs - 1}, platform; sensor frames"
    return (
        _output("imu_angular_velocity", imus, "rad/s", f"ideal gyroscopes: {which}", -1e3, 1e3, 0.1),
        _output("imu_specific_force", imus, "m/s2", f"ideal accelerometers: {which}", -1e5, 1e5, 10),
        _output("imu_magnetic_field", imus, "uT", f"ideal magnetometers: {which}", -2e4, 2e4, 10),
        _output("base_imu_angular_velocity", (3,), "rad/s", "ideal gyroscope of an IMU on the base, in {1}", -1e3, 1e3, 0.1),
        _output("base_imu_specific_force", (3,), "m/s2", "ideal accelerometer of an IMU on the base, in {1}", -1e5, 1e5, 10),
        *_pose(_output, "", dimensions),
        *_twist(_output, "", dimensions),
        _output("leg_length", (legs,), "m", "lengths of the legs", 0, 400, 0.1),
        _output("leg_velocity", (legs,), "m/s", "rates of the lengths", -1e3, 1e3, 0.1),
        _output("motor_length", (legs,), "m", "lengths at the motors, which have the play before them", 0, 400, 0.1),
        _output("current", (legs,), "A", "motor currents", -1e4, 1e4, 1),
        _output("voltage", (legs,), "V", "voltages that the drives ask for, within the voltage limit", -1e5, 1e5, 10),
        _output("kinetic_energy", (), "J", "of all bodies and rotors, seen from the base without its turning", 0, 1e9, 1),
        _output(
            "potential_energy", (), "J", "of all bodies in the field of gravity, less the base's acceleration", -1e9, 1e9, 10
        ),
        _output("power.drive", (), "W", "mechanical power of the motors", -1e9, 1e9, 10),
        _output("power.friction", (), "W", "power lost in friction, as a negative number", -1e9, 0, 1),
        _output("power.brake", (), "W", "power of the brakes on the legs", -1e9, 1e9, 1),
        _output("power.stop", (), "W", "power of the end stops on the legs", -1e9, 1e9, 1),
        _output("power.play", (), "W", "power of the screws' flanks where there is play", -1e9, 1e9, 1),
        _output("power.external", (), "W", "power of the external wrench", -1e9, 1e9, 1),
    )


SPATIAL, PLANAR = (
    VariableTable(_states(*size), _inputs(*size), _parameters(*size), _outputs(*size)) for size in ((6, 3), (3, 2))
)
"""The variables of the plants with six legs in space and with three legs in the plane."""


def checked_parameters(values: Mapping[str, ArrayLike], table: VariableTable = SPATIAL) -> dict[str, Array]:
    """Check parameter values against a table; a number is repeated for an array of one dimension.

    Raises:
        UnknownNameError: a name that is no parameter.
        InputError: wrong shape, not finite, or out of range.
    """
    known = {variable.name: variable for variable in table.parameters}
    checked = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownNameError(f"the plant has no parameter {name!r}; it has {', '.join(known)}{nearest(name, known)}")
        variable = known[name]
        given = numbers(value, name, variable.shape)
        if given.ndim == 0 and len(variable.shape) == 1:
            given = np.full(variable.shape, given)
        array = checked_array(given, variable.shape, name)
        for outside in array[(array < variable.minimum) | (array > variable.maximum)][:1]:
            raise InputError(f"{name} is {outside:g} {variable.unit}; it must be {variable.minimum:g} to {variable.maximum:g}")
        checked[name] = array
    return checked
