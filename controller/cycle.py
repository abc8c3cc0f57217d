"""The cycle: everything between raw IMU data and the six commands, the paper's Figure 4, as one compiled function.

    measurement -> leg, platform and heading filters -> direct kinematics -> inverse kinematics -> PID against the reference

It allocates nothing, raises nothing and knows no clock: time is counted in periods, missed ones included. Constants lie in
one structured array (dtype `PARAMETERS`), all state in another (dtype `STATE`); a copy of that is a snapshot.

A planar mechanism goes through the same cycle in the first three rows of all that is kept by leg; its leg filters, direct
kinematics and refinement do not leave the plane.
"""

from collections.abc import Collection

import numpy as np

from controller.calibration.file import Calibration
from controller.direct_kinematics.geometry import GEOMETRY, SCRATCH, geometry_of
from controller.estimation.fusion import (
    WORST_CONDITIONING,
    calibrate,
    elapsed,
    find_pose,
    fuse_heading,
    fuse_legs,
    fuse_platform,
    locate,
)
from controller.estimation.heading_filter import ERRORS as HEADING_ERRORS
from controller.estimation.heading_filter import STATES as HEADING_STATES
from controller.estimation.heading_filter import field_of
from controller.estimation.mechanism_filter import FILTER_PARAMETERS, FILTER_STATE, filter_parameters
from controller.estimation.readings import SENSOR_GEOMETRY, sensor_geometry
from controller.inverse_kinematics import jacobian_at, legs_at, sample_workspace
from controller.least_squares import RANK_TOLERANCE, solve_least_squares
from controller.pid import step_pid
from controller.planning.segments import STOP_SEGMENTS, evaluate_reference
from controller.safety.watch import (
    ENABLED,
    FAULT,
    NO_CAUSE,
    POSE_LOST,
    RUNNING,
    SAFETY_PARAMETERS,
    SAFETY_STATE,
    arm,
    begin_stop,
    coast,
    is_held,
    safety_parameters,
    watch,
)
from controller.settings import ControlSettings, FusionSettings, SafetySettings
from plant.checks import check_rate
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.errors import InputError
from plant.imu import STANDARD_GRAVITY
from plant.mechanism import LEGS, Mechanism, six_rows
from plant.pose import Array
from plant.wiring import ALL_IMUS

OK = NO_CAUSE
"""What a cycle reports if all is well; else it is the cause of a fault, by `controller.safety.watch`."""

_IMPLAUSIBLE_SHARE = 0.25
"""How far outside its stroke, as a share of it, the estimate of a leg may lie."""


STOP_SETTLING_S = 0.1
"""How long a mechanism that has stopped is held by its drives before the brakes take over [s]."""

_FROZEN_S = 0.01
"""How long an IMU may stand still while others do not [s]."""

_SOUND_S = 0.02
"""How long an IMU that was left out must be sound to be taken back [s]."""

_LEG_SETTLING_S = 0.1
"""How long a leg filter that was started again is not relied upon [s]."""

_FILTER_START_S, _FILTER_SETTLING_S = 0.3, 0.3
"""When the whole-mechanism filter is started, and how long it is not relied upon [s]."""

_PATIENCE_S = 0.05
"""How long the leg filters may disagree with the whole-mechanism filter [s]."""

_LEAST_GRAVITY = 0.1
_LEAST_FIELD = 5.0
"""Least horizontal magnetic field that tells a heading [uT]."""

_LEAST_OBSERVABILITY = 0.2
"""Least component of the vertical across both axes of a universal joint at home; without one, gravity does not tell the
joint's angles."""

PARAMETERS = np.dtype(
    [
        ("legs", np.int64),
        ("planar", np.int64),
        ("period", np.float64),
        ("hold_cycles", np.int64),
        ("safety", SAFETY_PARAMETERS),
        ("geometry", GEOMETRY),
        ("sensors", SENSOR_GEOMETRY),
        ("vectors_in_base", np.float64, (2, 3)),
        ("imu_present", np.int64, IMU_COUNT),
        ("magnetometer", np.int64),
        ("section_5", np.int64),
        ("calibration_gain", np.float64, (3, IMU_COUNT, 3, 3)),
        ("calibration_offset", np.float64, (3, IMU_COUNT, 3)),
        ("reach", np.float64, 2),
        ("frozen_cycles", np.int64),
        ("sound_cycles", np.int64),
        ("leg_settling_cycles", np.int64),
        ("sensor_delay", np.float64),
        ("leg_jerk", np.float64),
        ("bias_walk", np.float64),
        ("bias_sigma", np.float64),
        ("gyroscope_density", np.float64),
        ("gyroscope_variance", np.float64),
        ("leg_force_variance", np.float64),
        ("vertical_variance", np.float64),
        ("leg_weight", np.float64),
        ("vertical_weight", np.float64),
        ("field_strength", np.float64),
        ("field_cycles", np.int64),
        ("heading_variance", np.float64),
        ("heading_floor", np.float64),
        ("acceleration_rate", np.float64),
        ("filter", FILTER_PARAMETERS),
        ("filter_start_cycles", np.int64),
        ("filter_settling_cycles", np.int64),
        ("disagreement", np.float64),
        ("patience_cycles", np.int64),
        ("gains", np.float64, 4),
        ("command_limit", np.float64),
        ("velocity_limit", np.float64),
        ("acceleration_limit", np.float64),
        ("jerk_limit", np.float64),
        ("settling_cycles", np.int64),
        ("plausible_lengths", np.float64, (LEGS, 2)),
        ("command_delay", np.float64),
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
"""Constants of the cycle, in SI units; of what is kept by leg the first `legs` rows count. A calibrated reading is gain times
the raw one plus offset, and `moving_mass` and `droop` belong to the load feed-forward.

`vectors_in_base` are the vertical and the horizontal direction of the magnetic field, as unit vectors in {1}. A sample of the
magnetometer stands for `field_cycles`; its heading has the `heading_variance`, and whatever is averaged at least the
`heading_floor`.
"""

STATE = np.dtype(
    [
        ("cycle", np.int64),
        ("missed", np.int64),
        ("raw", np.float64, (3, IMU_COUNT, 3)),
        ("sample", np.float64, (3, IMU_COUNT, 3)),
        ("same", np.int64, IMU_COUNT),
        ("stands", np.int64, IMU_COUNT),
        ("sound", np.int64, IMU_COUNT),
        ("imu_used", np.int64, IMU_COUNT),
        ("age", np.int64, IMU_COUNT),
        ("leg_used", np.float64, LEGS),
        ("leg_weights", np.float64, LEGS),
        ("platform_used", np.int64),
        ("heading_age", np.int64),
        ("heading_used", np.int64),
        ("field", np.float64, 3),
        ("field_stands", np.int64),
        ("field_fresh", np.int64),
        ("vector_weights", np.float64, 2),
        ("leg_x", np.float64, (LEGS, 9)),
        ("leg_covariance", np.float64, (LEGS, 9, 9)),
        ("platform_x", np.float64, 6),
        ("platform_covariance", np.float64, (6, 6)),
        ("heading_x", np.float64, HEADING_STATES),
        ("heading_covariance", np.float64, (HEADING_ERRORS, HEADING_ERRORS)),
        ("directions", np.float64, (LEGS, 3)),
        ("rates", np.float64, (LEGS, 3)),
        ("vectors", np.float64, (2, 3)),
        ("platform_rate", np.float64, 3),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("twist", np.float64, 6),
        ("smooth_twist", np.float64, 6),
        ("acceleration", np.float64, 6),
        ("conditioning", np.float64),
        ("information", np.float64, (6, 6)),
        ("filter", FILTER_STATE),
        ("filter_due", np.int64),
        ("filter_trusted", np.int64),
        ("disagreeing", np.int64),
        ("offset", np.float64, 6),
        ("lengths", np.float64, LEGS),
        ("reference_index", np.int64, LEGS),
        ("reference", np.float64, (LEGS, 3)),
        ("prepared", np.int64),
        ("safety", SAFETY_STATE),
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
        ("found_position", np.float64, 3),
        ("found_rotation", np.float64, (3, 3)),
        ("filter_twist", np.float64, 6),
        ("filter_acceleration", np.float64, 6),
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

`cycle` counts periods, `missed` those since the last cycle that had none. `sample` is the calibrated measurement. Of each IMU:
whether it reads the `same` again, how often in a row it `stands` still while others do not, for how long it has been `sound`,
whether it is used, and the `age` of its filter, all in periods; of the magnetometer's `field`, how long it stands, and whether
it is to be taken. `twist` is velocity and angular velocity in {1}; `vectors`, vertical and horizontal field, and
`platform_rate` are seen in {2}; `information` is the inverse of the covariance of the refined pose (lower triangle).

The whole-mechanism filter is to be started, or trusted, when it is `filter_due`; `offset` is what is left of the way from one
source of the pose to the other, and the pose in closed form is `found`.

`reference` holds length, rate and acceleration of each leg in the cycle before `prepared`. A stop or a fault, `stopping` for a
cause by `controller.safety.watch`, begins in `stop_cycle`, and from `stopped_cycle` on the brakes may hold.
"""


def cycle_parameters(
    mechanism: Mechanism,
    rate: float,
    control: ControlSettings,
    fusion: FusionSettings,
    imus: Collection[int] = ALL_IMUS,
    whole: str | None = None,
    calibration: Calibration | None = None,
    magnetometer: bool = False,
    section_5: bool = False,
    safety: SafetySettings | None = None,
    command_delay: float = 0.0,
    to_arm: bool = True,
) -> Record:
    """Work out the constants of the cycle.

    Args:
        mechanism: spatial or planar, with home, limits and plant data, its joints where the calibration has moved them.
        rate: cycles per second [Hz].
        control, fusion: settings.
        imus: which IMUs there are, 0-5 on the legs and 6 on the platform; those of legs that there are not do not count.
        whole: which errors of the IMUs the whole-mechanism filter estimates, a key of `mechanism_filter.BLOCKS`; None to do
            without that filter.
        calibration: of the IMUs; without one their readings are taken as they are.
        magnetometer: whether the platform's magnetometer gives its heading.
        section_5: whether the pose is that of the paper's section 5, unrefined; that needs the magnetometer.
        safety: limits that are watched; by default those of `SafetySettings`.
        command_delay: of the rig, from a sample to the command computed from it [s].
        to_arm: whether the drives are asked for; else everything is read and nothing moves.

    Raises:
        InputError: a rate out of range, an IMU that cannot be, or IMUs that do not determine the pose.
    """
    check_rate(rate)
    check_imus(mechanism, imus, magnetometer, section_5)
    plant = mechanism.plant_parameters()
    parameters: Record = np.zeros((), PARAMETERS)
    calibration = calibration or Calibration()
    turns = 2.0 * np.pi / plant["motor.screw_lead"]
    force_constant = turns * plant["motor.torque_constant"]
    nominal = plant["drive.nominal_resistance"]
    mass = plant["platform.mass"] + plant["payload.mass"]
    sliding_mass = plant["leg.upper.mass"] + plant["motor.rotor_inertia"] * turns**2
    stroke = mechanism.require_limits().stroke
    margin = _IMPLAUSIBLE_SHARE * (stroke[:, 1] - stroke[:, 0])
    field = field_of(mechanism, calibration.tilt)
    gravity = float(np.linalg.norm(plant["gravity"]))
    if gravity < _LEAST_GRAVITY:
        raise InputError(
            f"gravity is {gravity:g} m/s2; the accelerometers need at least {_LEAST_GRAVITY:g} to tell a direction"
        )
    moments = [plant[f"{body}.mass"] * plant[f"{body}.center_of_mass"] for body in ("platform", "payload")]
    values = {
        "legs": mechanism.legs,
        "planar": mechanism.planar,
        "period": 1.0 / rate,
        "hold_cycles": int(np.ceil(control.hold * rate - 1e-9)),
        "safety": safety_parameters(safety or SafetySettings(), rate, mechanism.require_limits(), to_arm),
        "geometry": geometry_of(mechanism),
        "sensors": sensor_geometry(mechanism, calibration.tilt),
        "vectors_in_base": field.vectors,
        "imu_present": [imu in imus_of(mechanism, imus) for imu in ALL_IMUS],
        "magnetometer": magnetometer,
        "section_5": section_5,
        "calibration_gain": calibration.gain,
        "calibration_offset": calibration.offset,
        "reach": (fusion.gyroscope_range, fusion.accelerometer_range),
        "frozen_cycles": max(3, round(_FROZEN_S * rate)),
        "sound_cycles": round(_SOUND_S * rate),
        "leg_settling_cycles": round(_LEG_SETTLING_S * rate),
        "sensor_delay": fusion.sensor_delay,
        "leg_jerk": fusion.leg_jerk**2,
        "bias_walk": fusion.bias_walk**2,
        "bias_sigma": fusion.bias_sigma,
        "gyroscope_density": fusion.gyroscope_noise**2,
        "gyroscope_variance": fusion.gyroscope_noise**2 * rate / 2.0,
        "leg_force_variance": fusion.leg_accelerometer_noise**2 * rate / 2.0,
        "vertical_variance": (fusion.platform_accelerometer_noise / STANDARD_GRAVITY) ** 2 * rate / 2.0,
        "leg_weight": 1.0 / fusion.leg_sigma**2,
        "vertical_weight": 1.0 / fusion.tilt_sigma**2,
        "field_strength": field.strength,
        "field_cycles": max(1, round(rate / fusion.magnetometer_rate)),
        "heading_variance": field.heading_variance(fusion, rate),
        "heading_floor": fusion.heading_sigma**2,
        "acceleration_rate": 1.0 / fusion.acceleration_time,
        "filter": filter_parameters(
            fusion, rate, whole, calibration.covariance, calibration.floor, field if magnetometer else None
        ),
        "filter_start_cycles": round(_FILTER_START_S * rate),
        "filter_settling_cycles": round(_FILTER_SETTLING_S * rate),
        "disagreement": fusion.disagreement,
        "patience_cycles": round(_PATIENCE_S * rate),
        "gains": (control.proportional, control.integral, control.derivative, control.derivative_bandwidth),
        "command_limit": control.command_reserve * mechanism.require_limits().velocity,
        "velocity_limit": mechanism.require_limits().velocity,
        "acceleration_limit": mechanism.require_limits().acceleration,
        "jerk_limit": mechanism.require_limits().jerk,
        "settling_cycles": int(np.ceil(STOP_SETTLING_S * rate)),
        "plausible_lengths": six_rows(np.stack([stroke[:, 0] - margin, stroke[:, 1] + margin], axis=1)),
        "command_delay": command_delay,
        "droop": nominal * (1.0 - plant["drive.compensation"]) / force_constant**2,
        "moving_mass": sliding_mass + mass / mechanism.legs,
        "mass": mass,
        "first_moment": np.pad(moments[0] + moments[1], (0, 3 - moments[0].size)),
        "lower_moment": plant["leg.lower.mass"] * plant["leg.lower.center"],
        "rod_mass": plant["leg.upper.mass"],
        "rod_center": plant["leg.upper.center"],
    }
    for name, value in values.items():
        parameters[name] = value
    return parameters


def imus_of(mechanism: Mechanism, imus: Collection[int] = ALL_IMUS) -> tuple[int, ...]:
    """Those of `imus` that the legs of a mechanism and its platform can have."""
    return tuple(imu for imu in ALL_IMUS if imu in imus and (imu < mechanism.legs or imu == PLATFORM_IMU))


def check_imus(mechanism: Mechanism, imus: Collection[int], magnetometer: bool = False, section_5: bool = False) -> float:
    """Check that these IMUs, and the platform's magnetometer, determine the pose, at home and over the workspace; returns the
    worst conditioning there.

    Raises:
        InputError: an IMU outside 0 to 6, no field for the magnetometer, or the set does not determine the pose.
    """
    for imu in imus:
        if imu not in ALL_IMUS:
            raise InputError(f"there is no IMU {imu}; 0 to 5 sit on the legs, 6 on the platform")
    field = field_of(mechanism)
    if mechanism.planar and (magnetometer or section_5):
        raise InputError(f"{mechanism.name!r} is planar and has no heading: do without magnetometer and section 5")
    if magnetometer and PLATFORM_IMU not in imus:
        raise InputError("the magnetometer is part of the platform's IMU, which is not there: add IMU 6")
    if magnetometer and field.horizontal < _LEAST_FIELD:
        raise InputError(
            f"the horizontal magnetic field is {field.horizontal:.3g} uT; a heading needs at least {_LEAST_FIELD:g}: do "
            "without the magnetometer, or set the plant's magnetic_field"
        )
    if section_5 and not magnetometer:
        raise InputError("the paper's section 5 needs the platform's heading: add its magnetometer (--magnetometer)")
    # Of the one axis of a planar joint, gravity tells the angle wherever the leg points.
    in_plane = float(np.linalg.norm(mechanism.up_in_base[:2]))
    if mechanism.planar and in_plane < _LEAST_OBSERVABILITY:
        raise InputError(
            f"gravity hardly tells the angles in the plane of {mechanism.name!r}: of the vertical only {in_plane:.2g} lies in "
            f"it, and {_LEAST_OBSERVABILITY:g} is needed: set the plant's gravity"
        )
    across = np.abs(mechanism.joint_rotations[:, :, 2] @ mechanism.up_in_base)
    for leg in range(mechanism.legs):
        if not mechanism.planar and leg in imus and across[leg] < _LEAST_OBSERVABILITY:
            raise InputError(
                f"gravity hardly tells the angles of leg {leg}: of the vertical only {across[leg]:.2g} lies across the axes "
                f"of its joint, and {_LEAST_OBSERVABILITY:g} is needed: turn base_joint_axes[{leg}], or leave its IMU out"
            )
    names = ", ".join(str(imu) for imu in imus_of(mechanism, imus)) or "none"
    if mechanism.planar and PLATFORM_IMU not in imus:
        raise InputError(
            f"the IMUs {names} determine the pose of {mechanism.name!r} up to its two assembly modes at best, which the loop "
            "cannot tell apart: add the platform's IMU (6), whose roll does"
        )
    positions, rotations = sample_workspace(mechanism, 50, seed=0)
    parameters, state = np.zeros((), PARAMETERS), np.zeros((), STATE)
    parameters["geometry"] = geometry_of(mechanism)
    parameters["vectors_in_base"], parameters["section_5"] = field.vectors, section_5
    parameters["planar"] = mechanism.planar
    state["platform_used"] = PLATFORM_IMU in imus
    state["leg_used"] = [leg in imus_of(mechanism, imus) for leg in range(LEGS)]
    state["heading_used"] = magnetometer
    worst = np.inf
    for position, rotation in zip(positions, rotations, strict=True):
        legs = position + mechanism.platform_joints @ rotation.T - mechanism.base_joints
        state["directions"] = six_rows(legs / np.linalg.norm(legs, axis=1, keepdims=True))
        state["vectors"] = field.vectors @ rotation
        worst = min(worst, find_pose(parameters, state))
    if worst < WORST_CONDITIONING:
        remedies = ["legs"]
        if PLATFORM_IMU not in imus:
            remedies.append("the platform's IMU (6)")
        if not (magnetometer or mechanism.planar):
            remedies.append("its magnetometer (--magnetometer)")
        raise InputError(
            f"the IMUs {names} do not determine the pose of {mechanism.name!r} everywhere in its workspace (conditioning "
            f"{worst:.1e}; at least {WORST_CONDITIONING:g} is needed): add {', or '.join(remedies)}"
        )
    return worst


@kernel
def cycle(parameters: Record, state: Record, measurement: Array, segments: Array) -> int:
    """One cycle: from raw IMU data to the commands, which are left in `state`.

    Args:
        parameters: dtype `PARAMETERS`.
        state: dtype `STATE`; zeros before the first cycle.
        measurement: (3, 7, 3), angular velocity [rad/s], specific force [m/s^2], magnetic field [uT] of the seven IMUs.
        segments: (6, n, 5), the reference as `controller.planning.segments` has it.

    Returns:
        `OK`, or why there is no pose or the estimate cannot be used: the cause of a fault, unless nothing has been armed yet.
    """
    if state[()].safety.mode == FAULT:
        coast(parameters, state)
        return OK
    calibrate(parameters, state, measurement)
    fuse_legs(parameters, state)
    fuse_platform(parameters, state)
    fuse_heading(parameters, state)
    return control(parameters, state, segments) if locate(parameters, state) else lose_pose(parameters, state)


@kernel
def lose_pose(parameters: Record, state: Record) -> int:
    """The rest of a cycle that has found no pose, which is a fault unless nothing has been armed; returns its cause."""
    s = state[()]
    if not is_held(parameters, state, POSE_LOST):
        begin_stop(parameters, state, POSE_LOST)
    s.cycle += 1
    return POSE_LOST


@kernel
def skip(state: Record, missed: int) -> None:
    """Before a cycle: say how many periods have been missed since the last one."""
    s = state[()]
    s.missed = missed
    s.cycle += missed


@kernel
def prepare(parameters: Record, state: Record, segments: Array) -> None:
    """After a cycle, when its events have been read: what need not lie between measurement and command, the next reference."""
    state[()].safety.event_count = 0
    if state[()].safety.mode != FAULT:
        refer(parameters, state, segments)


@kernel
def control(parameters: Record, state: Record, segments: Array) -> int:
    """From the pose to the commands; returns the cause of a fault, or `OK`."""
    p, s = parameters[()], state[()]
    invert(parameters, state)
    if s.prepared != s.cycle + 1:
        refer(parameters, state, segments)
    for k in range(p.legs):
        s.error[k] = s.reference[k, 0] - s.lengths[k]
    arm(parameters, state)
    regulate(parameters, state)
    s.cycle += 1
    return watch(parameters, state)


@kernel
def invert(parameters: Record, state: Record) -> None:
    """Inverse kinematics of the estimated pose."""
    p, s = parameters[()], state[()]
    legs_at(p.geometry.base_joints, p.geometry.platform_joints, s.position, s.rotation, s.arms, s.predicted, s.lengths)
    s.lengths[p.legs :] = 0.0


@kernel
def refer(parameters: Record, state: Record, segments: Array) -> None:
    """The reference of this cycle: of the motion, whose time begins when the run does, or of a stop."""
    p, s = parameters[()], state[()]
    if s.stopping != 0 and s.safety.request == ENABLED:
        evaluate_reference(s.stop_segments, (s.cycle - s.stop_cycle) * p.period, s.reference_index, s.reference)
    else:
        evaluate_reference(segments, motion_cycle(parameters, state) * p.period, s.reference_index, s.reference)
    s.prepared = s.cycle + 1


@kernel
def motion_cycle(parameters: Record, state: Record) -> int:
    """How many periods of the motion have passed; 0 before it begins."""
    p, s = parameters[()], state[()]
    return int(max(s.cycle - p.hold_cycles - s.safety.waited, 0)) if s.safety.mode >= RUNNING else 0


@kernel
def regulate(parameters: Record, state: Record) -> None:
    """The six commands from the length deviations: nothing before the motion, then feed-forward and PID."""
    p, s = parameters[()], state[()]
    if s.safety.request != ENABLED or s.safety.mode < RUNNING:
        for k in range(p.legs):
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
    """The reference speed when the command takes effect, and what the drives need beyond it for weight and acceleration.

    An encoderless drive falls short of its command by `droop` x force. Static leg forces follow from the known weight by
    virtual work: `J^T f` balances the weight of platform and payload, of each leg's lower part and rod through the
    moment about its base joint, and each rod's own weight along its leg.
    """
    p, s = parameters[()], state[()]
    up = p.sensors.up_in_base[0]
    wrench, force = s.vectors_6[0], s.vectors_6[1]
    jacobian, transposed = s.matrices_6_6[0], s.matrices_6_6[1]
    jacobian_at(s.arms, s.predicted, p.legs, jacobian)
    for i in range(6):
        wrench[i] = p.mass * p.sensors.gravity * up[i] if i < 3 else 0.0
        for j in range(6):
            transposed[i, j] = jacobian[j, i]
    m0 = m1 = m2 = 0.0
    for j in range(3):
        m0 += s.rotation[0, j] * p.first_moment[j]
        m1 += s.rotation[1, j] * p.first_moment[j]
        m2 += s.rotation[2, j] * p.first_moment[j]
    wrench[3] = p.sensors.gravity * (m1 * up[2] - m2 * up[1])
    wrench[4] = p.sensors.gravity * (m2 * up[0] - m0 * up[2])
    wrench[5] = p.sensors.gravity * (m0 * up[1] - m1 * up[0])
    for k in range(p.legs):
        d, a = s.predicted[k], s.arms[k]
        along = d[0] * up[0] + d[1] * up[1] + d[2] * up[2]
        lever = (p.lower_moment + p.rod_mass * (s.lengths[k] - p.rod_center)) * p.sensors.gravity / s.lengths[k]
        f0, f1, f2 = lever * (up[0] - along * d[0]), lever * (up[1] - along * d[1]), lever * (up[2] - along * d[2])
        wrench[0] += f0
        wrench[1] += f1
        wrench[2] += f2
        wrench[3] += a[1] * f2 - a[2] * f1
        wrench[4] += a[2] * f0 - a[0] * f2
        wrench[5] += a[0] * f1 - a[1] * f0
    if solve_least_squares(transposed, wrench, 6, force, s.vectors_9[0, :6], s.vectors_9[1, :6]) < RANK_TOLERANCE:
        for k in range(p.legs):
            force[k] = 0.0
    for k in range(p.legs):
        d = s.predicted[k]
        own = p.rod_mass * p.sensors.gravity * (d[0] * up[0] + d[1] * up[1] + d[2] * up[2])
        load = force[k] + own + p.moving_mass * s.reference[k, 2]
        s.feed_forward[k] = s.reference[k, 1] + p.command_delay * s.reference[k, 2] + p.droop * load
