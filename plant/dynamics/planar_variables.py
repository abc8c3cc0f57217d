"""The variables of a planar plant: three legs in the xy-plane of {1}, with IMUs that measure in space.

What means the same as in the spatial plant is made by `plant.dynamics.variables`. Arrays are row-major. Vectors are seen in the
base frame {1} unless the description names another; those of two components lie in the plane, and across it the joints bear the
weight. IMUs 0 to 2 sit on the legs, 3 on the platform. A leg's sensor frame has its x axis along the plane's normal e_z and its
z axis along the leg.
"""

from plant.dynamics.variables import (
    LEG_PARAMETERS,
    SUBSTEP,
    Variable,
    VariableTable,
    actuator_outputs,
    actuator_parameters,
    actuator_states,
    body_parameters,
    drive_inputs,
    fixed,
    imu_outputs,
    joint_parameters,
    output,
    surroundings_parameters,
)

STATES = (
    Variable("state.position", (2,), "m", "state", "origin of the platform frame {2}", -100, 100, 0.1),
    Variable("state.angle", (), "rad", "state", "from {1} to {2}, counter-clockwise", -1e3, 1e3, 1),
    Variable("state.velocity", (2,), "m/s", "state", "velocity of the origin of {2}", -100, 100, 0.1),
    Variable("state.angular_velocity", (), "rad/s", "state", "angular velocity of {2}", -1e3, 1e3, 0.1),
    *actuator_states(3),
)

INPUTS = (
    *drive_inputs(3),
    Variable("external_wrench.force", (2,), "N", "input", "force on the origin of {2}", -1e6, 1e6, 100),
    Variable("external_wrench.torque", (), "N.m", "input", "torque on the platform, counter-clockwise", -1e6, 1e6, 10),
)

PARAMETERS = (
    *joint_parameters(3, 2),
    *body_parameters(2),
    *(variable for variable in LEG_PARAMETERS if not variable.name.endswith("axial_inertia")),
    *actuator_parameters(3),
    *surroundings_parameters(3),
    fixed("initial_position", (2,), "m", "origin of {2} at the start", -100, 100, 0.1),
    fixed("initial_angle", (), "rad", "from {1} to {2} at the start, counter-clockwise", -1e3, 1e3, 1),
    SUBSTEP,
)

OUTPUTS = (
    *imu_outputs(3),
    output("position", (2,), "m", "origin of {2}", -100, 100, 0.1),
    output("angle", (), "rad", "from {1} to {2}, counter-clockwise", -1e3, 1e3, 1),
    output("velocity", (2,), "m/s", "velocity of the origin of {2}", -100, 100, 0.1),
    output("angular_velocity", (), "rad/s", "angular velocity of {2}", -1e3, 1e3, 0.1),
    *actuator_outputs(3),
)

PLANAR = VariableTable(STATES, INPUTS, PARAMETERS, OUTPUTS)
