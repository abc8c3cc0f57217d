"""The variables of a planar plant: three legs in the xy-plane of {1}, with IMUs that measure in space.

Its names are those of the spatial plant (`plant.variables`) wherever they mean the same. Arrays are row-major. Vectors are
seen in the base frame {1} unless the description names another; those of two components lie in the plane. A leg's sensor
frame has its x axis along the plane's normal e_z and its z axis along the leg.
"""

from plant.variables import OPEN, TINY, VELOCITY, Variable, VariableTable, fixed, output, tunable

PLANAR_IMUS = 4
"""IMUs 0 to 2 sit on the legs, 3 on the platform."""

STATES = (
    Variable("state.position", (2,), "m", "state", "origin of the platform frame {2}", -100, 100, 0.1),
    Variable("state.angle", (), "rad", "state", "from {1} to {2}, counter-clockwise", -1e3, 1e3, 1),
    Variable("state.velocity", (2,), "m/s", "state", "velocity of the origin of {2}", -100, 100, 0.05),
    Variable("state.angular_velocity", (), "rad/s", "state", "angular velocity of {2}", -1e3, 1e3, 1),
    Variable("state.current", (3,), "A", "state", "motor currents", -1e4, 1e4, 1),
    Variable("state.brake_deflection", (3,), "m", "state", "elastic deflection of the brakes", -1, 1, 1e-4),
)

INPUTS = (
    Variable("velocity_command", (3,), "m/s", "input", "commanded speed of each leg, positive when it grows", -100, 100, 0.05),
    Variable("drive_mode", (3,), "1", "input", "0 open, 1 brake, 2 velocity", OPEN, VELOCITY, 1, discrete=True),
    Variable("external_wrench.force", (2,), "N", "input", "force on the origin of {2}", -1e6, 1e6, 10),
    Variable("external_wrench.torque", (), "N.m", "input", "torque on the platform, counter-clockwise", -1e6, 1e6, 1),
)

PARAMETERS = (
    fixed("base_joints", (3, 2), "m", "base joint of each leg", -100, 100, 0.1),
    fixed("platform_joints", (3, 2), "m", "platform joint of each leg, in {2}", -100, 100, 0.1),
    fixed("platform.mass", (), "kg", "mass of the platform", TINY, 1e5, 1),
    fixed("platform.center_of_mass", (2,), "m", "centre of mass of the platform, in {2}", -100, 100, 0.1),
    fixed("platform.inertia", (), "kg.m2", "inertia of the platform about its centre of mass", TINY, 1e5, 1e-3),
    tunable("payload.mass", (), "kg", "mass of the payload", 0, 1e5, 1),
    tunable("payload.center_of_mass", (2,), "m", "centre of mass of the payload, in {2}", -100, 100, 0.1),
    tunable("payload.inertia", (), "kg.m2", "inertia of the payload about its centre of mass", 0, 1e5, 1e-3),
    fixed("leg.lower.mass", (), "kg", "motor, gearbox and IMU: what turns about the base joint", TINY, 1e4, 1),
    fixed("leg.lower.center", (), "m", "centre of mass of the lower part, from the base joint along the leg", -100, 100, 0.1),
    fixed("leg.lower.inertia", (), "kg.m2", "inertia of the lower part about its centre of mass", 0, 1e4, 1e-3),
    fixed("leg.upper.mass", (), "kg", "mass of the rod", TINY, 1e4, 0.1),
    fixed("leg.upper.center", (), "m", "centre of mass of the rod, from the platform joint back along the leg", -100, 100, 0.1),
    fixed("leg.upper.inertia", (), "kg.m2", "inertia of the rod about its centre of mass", 0, 1e4, 1e-3),
    fixed("motor.resistance", (3,), "Ohm", "winding resistance", TINY, 1e4, 1),
    fixed("motor.inductance", (), "H", "winding inductance", TINY, 10, 1e-3),
    fixed("motor.torque_constant", (), "N.m/A", "torque constant, equal to the back-EMF constant", TINY, 1e3, 0.01),
    fixed("motor.rotor_inertia", (), "kg.m2", "inertia of rotor and screw", TINY, 1e3, 1e-6),
    fixed("motor.screw_lead", (), "m", "advance of the leg per turn", TINY, 1, 1e-3),
    fixed("drive.nominal_resistance", (), "Ohm", "winding resistance that the drive assumes", 0, 1e4, 1),
    fixed("drive.compensation", (), "1", "share kappa of the resistive drop that the drive makes up for", 0, 2, 1),
    fixed("drive.voltage_limit", (), "V", "largest voltage of the drive", TINY, 1e4, 10),
    fixed("drive.current_limit", (), "A", "largest current of the drive", TINY, 1e4, 1),
    fixed("drive.current_time_constant", (), "s", "time constant of the current limiter", TINY, 10, 1e-3),
    tunable("friction.coulomb", (3,), "N", "Coulomb friction of each leg", 0, 1e6, 1),
    tunable("friction.viscous", (3,), "N.s/m", "viscous friction of each leg", 0, 1e6, 10),
    tunable("friction.velocity", (), "m/s", "speed over which Coulomb friction changes sign", TINY, 100, 1e-3),
    fixed("brake.force", (), "N", "force at which a closed brake slips", TINY, 1e6, 100),
    fixed("brake.stiffness", (), "N/m", "stiffness of a closed brake", TINY, 1e12, 1e5),
    fixed("brake.damping", (), "N.s/m", "damping of a closed brake", 0, 1e9, 1e3),
    fixed("brake.release_time", (), "s", "time constant with which an opened brake relaxes", TINY, 10, 1e-3),
    fixed("stop.minimum_length", (3,), "m", "leg length at which the lower end stop touches", TINY, 100, 0.1),
    fixed("stop.maximum_length", (3,), "m", "leg length at which the upper end stop touches", TINY, 100, 0.1),
    fixed("stop.stiffness", (), "N/m", "stiffness of the end stops", 0, 1e12, 1e5),
    fixed("stop.damping", (), "s/m", "damping of the end stops relative to their force", 0, 1e6, 10),
    tunable("gravity", (3,), "m/s2", "acceleration of gravity; across the plane the joints bear it", -100, 100, 10),
    fixed("magnetic_field", (3,), "uT", "magnetic field of the earth", -1e3, 1e3, 10),
    fixed("leg_imu_position", (3, 3), "m", "place of each leg's IMU from the base joint, in the leg frame", -100, 100, 0.1),
    fixed("platform_imu_position", (3,), "m", "place of the platform's IMU, in {2}", -100, 100, 0.1),
    fixed("initial_position", (2,), "m", "origin of {2} at the start", -100, 100, 0.1),
    fixed("initial_angle", (), "rad", "from {1} to {2} at the start, counter-clockwise", -1e3, 1e3, 1),
    fixed("substep", (), "s", "largest internal integration step", 1e-6, 1, 1e-3),
)

OUTPUTS = (
    output("imu_angular_velocity", (4, 3), "rad/s", "ideal gyroscopes: legs 0-2, platform; sensor frames", -1e3, 1e3, 1),
    output("imu_specific_force", (4, 3), "m/s2", "ideal accelerometers: legs 0-2, platform; sensor frames", -1e6, 1e6, 10),
    output("imu_magnetic_field", (4, 3), "uT", "ideal magnetometers: legs 0-2, platform; sensor frames", -2e3, 2e3, 10),
    output("position", (2,), "m", "origin of {2}", -100, 100, 0.1),
    output("angle", (), "rad", "from {1} to {2}, counter-clockwise", -1e3, 1e3, 1),
    output("velocity", (2,), "m/s", "velocity of the origin of {2}", -100, 100, 0.05),
    output("angular_velocity", (), "rad/s", "angular velocity of {2}", -1e3, 1e3, 1),
    Variable("leg_length", (3,), "m", "output", "lengths of the legs", 0, 4 * 100, 0.1),
    output("leg_velocity", (3,), "m/s", "rates of the lengths", -100, 100, 0.05),
    output("current", (3,), "A", "motor currents", -1e4, 1e4, 1),
    output("voltage", (3,), "V", "drive voltages that are asked for, within the voltage limit", -1e4, 1e4, 10),
    Variable("kinetic_energy", (), "J", "output", "of all bodies and rotors", 0, 1e9, 0.1),
    output("potential_energy", (), "J", "of all bodies in the field of gravity", -1e9, 1e9, 1),
    output("power.drive", (), "W", "mechanical power of the motors", -1e9, 1e9, 1),
    output("power.friction", (), "W", "power lost in friction, as a negative number", -1e9, 1e9, 1),
    output("power.brake", (), "W", "power of the brakes on the legs", -1e9, 1e9, 1),
    output("power.stop", (), "W", "power of the end stops on the legs", -1e9, 1e9, 1),
    output("power.external", (), "W", "power of the external wrench", -1e9, 1e9, 1),
)

PLANAR = VariableTable(STATES, INPUTS, PARAMETERS, OUTPUTS)
