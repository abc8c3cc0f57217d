"""The cycle: everything between raw IMU data and the six commands, the paper's Figure 4, as one compiled function.

    measurement -> leg filters, platform filter -> direct kinematics -> inverse kinematics -> PID against the reference

It allocates nothing, raises nothing and knows no clock: time is counted in periods, missed ones included. Constants lie in
one structured array (dtype `PARAMETERS`), all state in another (dtype `STATE`); a copy of that is a snapshot.
"""

from collections.abc import Collection

import numpy as np

from controller.direct_kinematics.closed_forms import GEOMETRY, SCRATCH, geometry_of, pose_from_legs, pose_from_vector
from controller.direct_kinematics.refinement import find_twist, move_pose, normal_equations, solve_normal_equations
from controller.inverse_kinematics import jacobian_at, legs_at, sample_workspace
from controller.least_squares import RANK_TOLERANCE, solve_least_squares
from controller.leg_filter import leg_direction, predict_leg, start_leg, update_leg
from controller.pid import step_pid
from controller.platform_filter import start_platform, step_platform
from controller.reference import STOP_SEGMENTS, evaluate_reference, plan_stop
from controller.settings import ControlSettings, FusionSettings
from plant.compiled import Record, kernel
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, STANDARD_GRAVITY
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.variables import IMU_COUNT, PLATFORM_IMU

OK, POSE_LOST, NOT_FINITE, IMPLAUSIBLE = range(4)
"""What a cycle reports: all well; the directions no longer determine a pose; an estimate or command is not finite; after
the hold, the estimated lengths are far outside the strokes."""

_IMPLAUSIBLE_SHARE = 0.25
"""How far outside its stroke, as a share of it, the estimate of a leg may lie."""

ALL_IMUS = tuple(range(IMU_COUNT))

RATE_RANGE_HZ = (50.0, 4000.0)

STOP_SETTLING_S = 0.1
"""How long a mechanism that has stopped is held by its drives before the brakes take over [s]."""

_GAP_S = 0.05
"""Longest time for which a leg's angular acceleration is taken to last [s]."""

_WORST_CONDITIONING = 1e-2
_LEAST_GRAVITY = 0.1
_LEAST_OBSERVABILITY = 0.2
"""Least component of the vertical across both axes of a universal joint at home; without one, gravity does not tell the
joint's angles."""

PARAMETERS = np.dtype(
    [
        ("period", np.float64),
        ("hold_cycles", np.int64),
        ("geometry", GEOMETRY),
        ("joint_rotations", np.float64, (LEGS, 3, 3)),
        ("up_in_joint", np.float64, (LEGS, 3)),
        ("up_in_base", np.float64, (1, 3)),
        ("leg_imu_position", np.float64, (LEGS, 3)),
        ("platform_imu_position", np.float64, 3),
        ("gravity", np.float64),
        ("leg_used", np.float64, LEGS),
        ("platform_used", np.int64),
        ("leg_jerk", np.float64),
        ("bias_walk", np.float64),
        ("bias_sigma", np.float64),
        ("gyroscope_density", np.float64),
        ("gyroscope_variance", np.float64),
        ("leg_force_variance", np.float64),
        ("vertical_variance", np.float64),
        ("leg_weights", np.float64, LEGS),
        ("vertical_weight", np.float64, 1),
        ("acceleration_rate", np.float64),
        ("gains", np.float64, 4),
        ("command_limit", np.float64),
        ("velocity_limit", np.float64),
        ("acceleration_limit", np.float64),
        ("jerk_limit", np.float64),
        ("settling_cycles", np.int64),
        ("plausible_lengths", np.float64, (LEGS, 2)),
        ("droop", np.float64),
        ("moving_mass", np.float64),
        ("mass", np.float64),
        ("first_moment", np.float64, 3),
        ("lower_moment", np.float64),
        ("rod_mass", np.float64),
        ("rod_center", np.float64),
    ],
    align=True,
)
"""Constants of the cycle, in SI units; `moving_mass` and `droop` belong to the load feed-forward."""

STATE = np.dtype(
    [
        ("cycle", np.int64),
        ("missed", np.int64),
        ("leg_x", np.float64, (LEGS, 9)),
        ("leg_covariance", np.float64, (LEGS, 9, 9)),
        ("platform_x", np.float64, 6),
        ("platform_covariance", np.float64, (6, 6)),
        ("directions", np.float64, (LEGS, 3)),
        ("rates", np.float64, (LEGS, 3)),
        ("vertical", np.float64, (1, 3)),
        ("platform_rate", np.float64, 3),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("twist", np.float64, 6),
        ("smooth_twist", np.float64, 6),
        ("acceleration", np.float64, 6),
        ("conditioning", np.float64),
        ("information", np.float64, (6, 6)),
        ("lengths", np.float64, LEGS),
        ("reference_index", np.int64, LEGS),
        ("reference", np.float64, (LEGS, 3)),
        ("prepared", np.int64),
        ("driving", np.int64),
        ("stopping", np.int64),
        ("stop_cycle", np.int64),
        ("stopped_cycle", np.int64),
        ("stop_segments", np.float64, (LEGS, STOP_SEGMENTS, 5)),
        ("feed_forward", np.float64, LEGS),
        ("error", np.float64, LEGS),
        ("integral", np.float64, LEGS),
        ("previous_error", np.float64, LEGS),
        ("derivative", np.float64, LEGS),
        ("command", np.float64, LEGS),
        # Scratch, here so that the cycle allocates nothing.
        ("arms", np.float64, (LEGS, 3)),
        ("predicted", np.float64, (LEGS, 3)),
        ("angular_velocity", np.float64, 3),
        ("imu_acceleration", np.float64, 3),
        ("measurement_6", np.float64, 6),
        ("jacobian_6_9", np.float64, (6, 9)),
        ("vectors_9", np.float64, (2, 9)),
        ("matrices_6_6", np.float64, (2, 6, 6)),
        ("vectors_6", np.float64, (2, 6)),
        ("scratch", SCRATCH),
    ],
    align=True,
)
"""State of the cycle: filters, pose, controllers, and what the last cycle found.

`cycle` counts periods, `missed` those since the last cycle that had none. `twist` is velocity and angular velocity in {1};
`vertical` and `platform_rate` are seen in {2}; `information` is the inverse of the pose's covariance (lower triangle).
`reference` holds length, rate and acceleration of each leg in the cycle before `prepared`. The drives are `driving` after the
hold. A stop, `stopping` for a cause that the loop numbers, begins in `stop_cycle`, and from `stopped_cycle` on the brakes may
hold.
"""


def cycle_parameters(
    mechanism: Mechanism,
    rate: float,
    control: ControlSettings,
    fusion: FusionSettings,
    imus: Collection[int] = ALL_IMUS,
) -> Record:
    """Work out the constants of the cycle.

    Args:
        mechanism: with home, limits and plant data.
        rate: cycles per second [Hz].
        control, fusion: settings.
        imus: which IMUs there are, 0-5 on the legs and 6 on the platform.

    Raises:
        InputError: a rate out of range, an IMU that cannot be, or IMUs that do not determine the pose.
    """
    check_rate(rate)
    check_imus(mechanism, imus)
    plant = mechanism.plant_parameters()
    parameters: Record = np.zeros((), PARAMETERS)
    used = np.array([float(leg in imus) for leg in range(LEGS)])
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    nominal = plant["drive.nominal_resistance"]
    mass = plant["platform.mass"] + plant["payload.mass"]
    sliding_mass = plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2
    stroke = mechanism.require_limits().stroke
    margin = _IMPLAUSIBLE_SHARE * (stroke[:, 1] - stroke[:, 0])
    gravity = float(np.linalg.norm(plant["gravity"]))
    if gravity < _LEAST_GRAVITY:
        raise InputError(
            f"gravity is {gravity:g} m/s2; the accelerometers need at least {_LEAST_GRAVITY:g} to tell a direction"
        )
    values = {
        "period": 1.0 / rate,
        "hold_cycles": int(np.ceil(control.hold * rate - 1e-9)),
        "geometry": geometry_of(mechanism),
        "joint_rotations": mechanism.joint_rotations,
        "up_in_joint": np.swapaxes(mechanism.joint_rotations, 1, 2) @ mechanism.up_in_base,
        "up_in_base": mechanism.up_in_base,
        "leg_imu_position": plant["leg_imu_position"],
        "platform_imu_position": plant["platform_imu_position"],
        "gravity": gravity,
        "leg_used": used,
        "platform_used": PLATFORM_IMU in imus,
        "leg_jerk": fusion.leg_jerk**2,
        "bias_walk": fusion.bias_walk**2,
        "bias_sigma": fusion.bias_sigma,
        "gyroscope_density": fusion.gyroscope_noise**2,
        "gyroscope_variance": fusion.gyroscope_noise**2 * rate / 2.0,
        "leg_force_variance": fusion.leg_accelerometer_noise**2 * rate / 2.0,
        "vertical_variance": (fusion.platform_accelerometer_noise / STANDARD_GRAVITY) ** 2 * rate / 2.0,
        "leg_weights": used / fusion.leg_sigma**2,
        "vertical_weight": (PLATFORM_IMU in imus) / fusion.tilt_sigma**2,
        "acceleration_rate": 1.0 / fusion.acceleration_time,
        "gains": (control.proportional, control.integral, control.derivative, control.derivative_bandwidth),
        "command_limit": control.command_reserve * mechanism.require_limits().velocity,
        "velocity_limit": mechanism.require_limits().velocity,
        "acceleration_limit": mechanism.require_limits().acceleration,
        "jerk_limit": mechanism.require_limits().jerk,
        "settling_cycles": int(np.ceil(STOP_SETTLING_S * rate)),
        "plausible_lengths": np.stack([stroke[:, 0] - margin, stroke[:, 1] + margin], axis=1),
        "droop": nominal * (1.0 - plant["drive.compensation"]) / force_constant**2,
        "moving_mass": sliding_mass + mass / LEGS,
        "mass": mass,
        "first_moment": (
            plant["platform.mass"] * plant["platform.center_of_mass"] + plant["payload.mass"] * plant["payload.center_of_mass"]
        ),
        "lower_moment": plant["leg.lower.mass"] * plant["leg.lower.center"],
        "rod_mass": plant["leg.upper.mass"],
        "rod_center": plant["leg.upper.center"],
    }
    for name, value in values.items():
        parameters[name] = value
    return parameters


def check_rate(rate: float) -> None:
    """Check that the cycle can run at this rate [Hz].

    Raises:
        InputError: it is outside 50 to 4000 Hz.
    """
    if not RATE_RANGE_HZ[0] <= rate <= RATE_RANGE_HZ[1]:
        raise InputError(f"the rate is {rate:g} Hz; it must be {RATE_RANGE_HZ[0]:g} to {RATE_RANGE_HZ[1]:g} Hz")


def check_imus(mechanism: Mechanism, imus: Collection[int]) -> None:
    """Check that these IMUs determine the pose, at home and over the workspace.

    Raises:
        InputError: an IMU outside 0 to 6, or the set does not determine the pose.
    """
    for imu in imus:
        if imu not in ALL_IMUS:
            raise InputError(f"there is no IMU {imu}; 0 to 5 sit on the legs, 6 on the platform")
    across = np.abs(mechanism.joint_rotations[:, :, 2] @ mechanism.up_in_base)
    for leg in range(LEGS):
        if leg in imus and across[leg] < _LEAST_OBSERVABILITY:
            raise InputError(
                f"gravity hardly tells the angles of leg {leg}: of the vertical only {across[leg]:.2g} lies across the axes "
                f"of its joint, and {_LEAST_OBSERVABILITY:g} is needed: turn base_joint_axes[{leg}], or leave its IMU out"
            )
    positions, rotations = sample_workspace(mechanism, 50, seed=0)
    parameters, state = np.zeros((), PARAMETERS), np.zeros((), STATE)
    parameters["geometry"] = geometry_of(mechanism)
    parameters["up_in_base"], parameters["platform_used"] = mechanism.up_in_base, PLATFORM_IMU in imus
    parameters["leg_used"] = [leg in imus for leg in range(LEGS)]
    worst = np.inf
    for position, rotation in zip(positions, rotations, strict=True):
        legs = position + mechanism.platform_joints @ rotation.T - mechanism.base_joints
        state["directions"] = legs / np.linalg.norm(legs, axis=1, keepdims=True)
        state["vertical"] = rotation.T @ mechanism.up_in_base
        worst = min(worst, find_pose(parameters, state))
    if worst < _WORST_CONDITIONING:
        names = ", ".join(str(imu) for imu in sorted(imus)) or "none"
        raise InputError(
            f"the IMUs {names} do not determine the pose of {mechanism.name!r} everywhere in its workspace (conditioning "
            f"{worst:.1e}; at least {_WORST_CONDITIONING:g} is needed): add legs, or the platform's IMU (6)"
        )


@kernel
def cycle(parameters: Record, state: Record, measurement: Array, segments: Array) -> int:
    """One cycle: from raw IMU data to the commands, which are left in `state`.

    Args:
        parameters: dtype `PARAMETERS`.
        state: dtype `STATE`; zeros before the first cycle.
        measurement: (3, 7, 3), angular velocity [rad/s], specific force [m/s^2], magnetic field [uT] of the seven IMUs.
        segments: (6, n, 5), the reference as `controller.reference` has it.

    Returns:
        `OK`, or why the estimate cannot be used.
    """
    fuse_legs(parameters, state, measurement)
    fuse_platform(parameters, state, measurement)
    status = locate(parameters, state)
    return control(parameters, state, segments) if status == OK else status


@kernel
def skip(state: Record, missed: int) -> None:
    """Before a cycle: say how many periods have been missed since the last one."""
    s = state[()]
    s.missed = missed
    s.cycle += missed


@kernel
def prepare(parameters: Record, state: Record, segments: Array) -> None:
    """After a cycle: what need not lie between measurement and command, the reference of the next one."""
    refer(parameters, state, segments)


@kernel
def begin_stop(parameters: Record, state: Record, cause: int) -> None:
    """Between cycles: leave the motion for the fastest stop within the limits, leg by leg; during the hold there is nothing to
    stop. The first cause, not 0, counts. In periods that were missed the drives went on as they were last told, and the stop
    begins from where that has led.
    """
    p, s = parameters[()], state[()]
    if s.stopping != 0:
        return
    s.stopping = cause
    s.stop_cycle = s.stopped_cycle = s.cycle
    if s.cycle > p.hold_cycles:
        if s.missed > 0:
            for k in range(LEGS):
                speed = min(max(s.command[k], -p.velocity_limit), p.velocity_limit)
                s.reference[k, 0] += s.missed * p.period * speed
                s.reference[k, 1], s.reference[k, 2] = speed, 0.0
        duration = plan_stop(s.reference, p.acceleration_limit, p.jerk_limit, s.stop_segments)
        s.stopped_cycle += int(np.ceil(duration / p.period)) + p.settling_cycles
        s.reference_index[:] = 0
        s.prepared = 0


@kernel
def has_stopped(state: Record) -> bool:
    """Whether a stop has come to its end, so that the brakes may hold."""
    s = state[()]
    return bool(s.stopping != 0 and s.cycle >= s.stopped_cycle)


@kernel
def elapsed(parameters: Record, state: Record) -> float:
    """Time since the last cycle [s]."""
    return float((1 + state[()].missed) * parameters[()].period)


@kernel
def locate(parameters: Record, state: Record) -> int:
    """Direct kinematics and its refinement; returns `OK` or `POSE_LOST`."""
    if find_pose(parameters, state) < RANK_TOLERANCE or not improve_pose(parameters, state):
        return POSE_LOST
    return OK


@kernel
def control(parameters: Record, state: Record, segments: Array) -> int:
    """From the pose to the commands; returns a status."""
    p, s = parameters[()], state[()]
    invert(parameters, state)
    if s.prepared != s.cycle + 1:
        refer(parameters, state, segments)
    regulate(parameters, state)
    s.cycle += 1
    for k in range(LEGS):
        if not (np.isfinite(s.command[k]) and np.isfinite(s.lengths[k])):
            return NOT_FINITE
        if s.cycle > p.hold_cycles and not p.plausible_lengths[k, 0] <= s.lengths[k] <= p.plausible_lengths[k, 1]:
            return IMPLAUSIBLE
    return OK


@kernel
def fuse_legs(parameters: Record, state: Record, measurement: Array) -> None:
    """Step the leg filters."""
    p, s = parameters[()], state[()]
    period = elapsed(parameters, state)
    for k in range(LEGS):
        if p.leg_used[k] == 0.0:
            continue
        x, covariance, up = s.leg_x[k], s.leg_covariance[k], p.up_in_joint[k]
        rate, force = measurement[GYROSCOPE, k], measurement[ACCELEROMETER, k]
        if s.cycle == 0:
            start_leg(x, covariance, rate, force, up, p.bias_sigma)
        else:
            if period > _GAP_S:
                x[4:6] = 0.0
            predict_leg(x, covariance, period, p.leg_jerk, p.bias_walk)
        update_leg(
            x, covariance, rate, force, up, p.leg_imu_position[k], p.gravity, p.gyroscope_variance, p.leg_force_variance,
            s.measurement_6, s.jacobian_6_9, s.vectors_9[0], s.vectors_9[1],
        )  # fmt: skip
    point_legs(parameters, state)


@kernel
def point_legs(parameters: Record, state: Record) -> None:
    """Directions of the legs and their rates from the states of the leg filters."""
    p, s = parameters[()], state[()]
    for k in range(LEGS):
        leg_direction(s.leg_x[k], p.joint_rotations[k], s.directions[k], s.rates[k])


@kernel
def fuse_platform(parameters: Record, state: Record, measurement: Array) -> None:
    """Step the platform's filter, with its own acceleration, known from the legs, taken out of the reading."""
    p, s = parameters[()], state[()]
    if p.platform_used == 0:
        return
    rate, force = measurement[GYROSCOPE, PLATFORM_IMU], measurement[ACCELEROMETER, PLATFORM_IMU]
    if s.cycle == 0:
        start_platform(s.platform_x, s.platform_covariance, force, p.bias_sigma)
    # Acceleration of the IMU: that of the origin, and what turning adds at the IMU's place d.
    d = p.platform_imu_position
    w0, w1, w2 = rate[0] - s.platform_x[3], rate[1] - s.platform_x[4], rate[2] - s.platform_x[5]
    wd = w0 * d[0] + w1 * d[1] + w2 * d[2]
    ww = w0 * w0 + w1 * w1 + w2 * w2
    a = s.angular_velocity
    for i in range(3):
        s.imu_acceleration[i] = 0.0
        a[i] = 0.0
        for j in range(3):
            s.imu_acceleration[i] += s.rotation[j, i] * s.acceleration[j]
            a[i] += s.rotation[j, i] * s.acceleration[3 + j]
    s.imu_acceleration[0] += a[1] * d[2] - a[2] * d[1] + w0 * wd - d[0] * ww
    s.imu_acceleration[1] += a[2] * d[0] - a[0] * d[2] + w1 * wd - d[1] * ww
    s.imu_acceleration[2] += a[0] * d[1] - a[1] * d[0] + w2 * wd - d[2] * ww
    period = elapsed(parameters, state)
    step_platform(
        s.platform_x, s.platform_covariance, rate, force, s.imu_acceleration, period, p.gravity, p.gyroscope_density,
        p.bias_walk, p.vertical_variance, s.matrices_6_6[0], s.matrices_6_6[1], s.vectors_6[0], s.vectors_6[1],
    )  # fmt: skip
    for i in range(3):
        s.vertical[0, i] = s.platform_x[i]
        s.platform_rate[i] = rate[i] - s.platform_x[3 + i]


@kernel
def find_pose(parameters: Record, state: Record) -> float:
    """The pose in closed form from the leg directions, and the vertical if the platform has an IMU; returns the
    conditioning.
    """
    p, s = parameters[()], state[()]
    if p.platform_used != 0:
        s.conditioning = pose_from_vector(
            p.geometry, s.directions, p.leg_used, p.up_in_base[0], s.vertical[0], s.position, s.rotation, s.scratch
        )
    else:
        s.conditioning = pose_from_legs(p.geometry, s.directions, p.leg_used, s.position, s.rotation, s.scratch)
    return float(s.conditioning)


@kernel
def improve_pose(parameters: Record, state: Record) -> bool:
    """Two Gauss-Newton steps for the pose; the twist comes with them, and the acceleration is its derivative."""
    p, s = parameters[()], state[()]
    factor = s.matrices_6_6[0]
    for _ in range(2):
        normal_equations(
            p.geometry.base_joints, p.geometry.platform_joints, s.directions, p.leg_weights, p.up_in_base, s.vertical,
            p.vertical_weight, s.position, s.rotation, s.arms, s.predicted, s.lengths, s.information, s.vectors_6[0],
        )  # fmt: skip
        if not solve_normal_equations(s.information, s.vectors_6[0], factor):
            return False
        move_pose(s.vectors_6[0], s.position, s.rotation)
    for i in range(3):
        s.angular_velocity[i] = 0.0
        for j in range(3):
            s.angular_velocity[i] += s.rotation[i, j] * s.platform_rate[j]
    find_twist(
        s.rates, p.leg_weights, s.vertical, p.vertical_weight, s.angular_velocity, s.rotation, s.arms, s.predicted, s.lengths,
        factor, s.twist,
    )  # fmt: skip
    if s.cycle == 0:
        s.smooth_twist[:] = s.twist
    share = min(1.0, elapsed(parameters, state) * p.acceleration_rate)
    for i in range(6):
        s.acceleration[i] = (s.twist[i] - s.smooth_twist[i]) * p.acceleration_rate
        s.smooth_twist[i] += share * (s.twist[i] - s.smooth_twist[i])
    return True


@kernel
def invert(parameters: Record, state: Record) -> None:
    """Inverse kinematics of the estimated pose."""
    p, s = parameters[()], state[()]
    legs_at(p.geometry.base_joints, p.geometry.platform_joints, s.position, s.rotation, s.arms, s.predicted, s.lengths)


@kernel
def refer(parameters: Record, state: Record, segments: Array) -> None:
    """The reference of this cycle: of the motion, whose time begins at the end of the hold, or of a stop."""
    p, s = parameters[()], state[()]
    if s.stopping != 0 and s.stop_cycle > p.hold_cycles:
        evaluate_reference(s.stop_segments, (s.cycle - s.stop_cycle) * p.period, s.reference_index, s.reference)
    else:
        evaluate_reference(segments, max(s.cycle - p.hold_cycles, 0) * p.period, s.reference_index, s.reference)
    s.prepared = s.cycle + 1


@kernel
def regulate(parameters: Record, state: Record) -> None:
    """The six commands from the length deviations: nothing during the hold, then feed-forward and PID."""
    p, s = parameters[()], state[()]
    for k in range(LEGS):
        s.error[k] = s.reference[k, 0] - s.lengths[k]
    if s.cycle < p.hold_cycles:
        for k in range(LEGS):
            s.command[k] = 0.0
            s.previous_error[k] = s.error[k]
        return
    feed_load_forward(parameters, state)
    step_pid(
        s.error, s.feed_forward, p.gains, p.command_limit, elapsed(parameters, state), s.integral, s.previous_error,
        s.derivative, s.command,
    )  # fmt: skip


@kernel
def feed_load_forward(parameters: Record, state: Record) -> None:
    """The reference speed, and what the drives need beyond it for weight and acceleration.

    An encoderless drive falls short of its command by `droop` x force. Static leg forces follow from the known weight by
    virtual work: `J^T f` balances the weight of platform and payload, of each leg's lower part and rod through the
    moment about its base joint, and each rod's own weight along its leg.
    """
    p, s = parameters[()], state[()]
    up = p.up_in_base[0]
    wrench, force = s.vectors_6[0], s.vectors_6[1]
    jacobian, transposed = s.matrices_6_6[0], s.matrices_6_6[1]
    jacobian_at(s.arms, s.predicted, jacobian)
    for i in range(6):
        wrench[i] = p.mass * p.gravity * up[i] if i < 3 else 0.0
        for j in range(6):
            transposed[i, j] = jacobian[j, i]
    m0 = m1 = m2 = 0.0
    for j in range(3):
        m0 += s.rotation[0, j] * p.first_moment[j]
        m1 += s.rotation[1, j] * p.first_moment[j]
        m2 += s.rotation[2, j] * p.first_moment[j]
    wrench[3] = p.gravity * (m1 * up[2] - m2 * up[1])
    wrench[4] = p.gravity * (m2 * up[0] - m0 * up[2])
    wrench[5] = p.gravity * (m0 * up[1] - m1 * up[0])
    for k in range(LEGS):
        d, a = s.predicted[k], s.arms[k]
        along = d[0] * up[0] + d[1] * up[1] + d[2] * up[2]
        lever = (p.lower_moment + p.rod_mass * (s.lengths[k] - p.rod_center)) * p.gravity / s.lengths[k]
        f0, f1, f2 = lever * (up[0] - along * d[0]), lever * (up[1] - along * d[1]), lever * (up[2] - along * d[2])
        wrench[0] += f0
        wrench[1] += f1
        wrench[2] += f2
        wrench[3] += a[1] * f2 - a[2] * f1
        wrench[4] += a[2] * f0 - a[0] * f2
        wrench[5] += a[0] * f1 - a[1] * f0
    if solve_least_squares(transposed, wrench, 6, force, s.vectors_9[0, :6], s.vectors_9[1, :6]) < RANK_TOLERANCE:
        for k in range(LEGS):
            force[k] = 0.0
    for k in range(LEGS):
        d = s.predicted[k]
        own = p.rod_mass * p.gravity * (d[0] * up[0] + d[1] * up[1] + d[2] * up[2])
        load = force[k] + own + p.moving_mass * s.reference[k, 2]
        s.feed_forward[k] = s.reference[k, 1] + p.droop * load
