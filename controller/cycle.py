"""The cycle: everything between raw IMU data and the six commands, the paper's Figure 4, as one compiled function.

    raw IMU data -> screening -> the base's motion subtracted -> leg, platform and heading filters
        -> closed form -> refinement -> whole-mechanism filter
        -> inverse kinematics -> reference - length -> feed-forward and PID -> commands

The cycle allocates nothing, raises nothing and knows no clock: time is counted in periods, missed ones included. Each stage
owns its constants and its state; `PARAMETERS` and `STATE` compose them, and a copy of the state is a snapshot.

In the kernels of a stage, `p` and `s` are its own constants and state, `rig` and `time` are records of `RIG` and `TIME`, and
the states of other stages have their names in `STATE`. Only the entry points here take `parameters` and `state` of the whole
cycle.

A planar mechanism goes through the same cycle in the first three rows of all that is kept by leg. Its leg filters, direct
kinematics and refinement stay in the plane.
"""

from collections.abc import Collection
from dataclasses import replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from controller import level_frame, load_feed_forward, pid, reference
from controller import safety as safety_stage
from controller.calibration.file import Calibration
from controller.direct_kinematics.geometry import LINEAR_RANK
from controller.estimation import (
    base_imu,
    base_motion,
    encoders,
    heading_filter,
    imu_health,
    imu_monitor,
    leg_filter,
    platform_filter,
    pose_estimator,
)
from controller.estimation.integrity import commanded, rest
from controller.estimation.integrity import stage as integrity
from controller.estimation.integrity.gravity import spread_by_legs
from controller.estimation.integrity.protection import end_level
from controller.estimation.whole_mechanism import trust
from controller.estimation.whole_mechanism.imu_errors import ERRORS
from controller.estimation.whole_mechanism.parameters import (
    ALL_ERRORS,
    BASE_ERRORS,
    LENGTH_ERRORS,
    MOST_STATES,
    filter_parameters,
    ripple_at,
    with_biases_for_the_rest,
)
from controller.estimation.whole_mechanism.readings import MOTION_STATES, READINGS, RIG_ERRORS, find_frames
from controller.imu_set import are_few, check_imus, imus_of, length_share, lengths_lead, pose_share
from controller.inverse_kinematics import legs_at
from controller.least_squares import RANK_TOLERANCE
from controller.rig import RIG, TIME, elapsed, field_of, rig_parameters
from controller.safety import arming, attribution, drives, encoder_watch, watch
from controller.safety.causes import Cause, Mode, Request
from controller.safety.stop import handle_cause, ramp_down
from controller.settings import ControlSettings, DriveSettings, FusionSettings, SafetySettings
from plant.checks import check_rate
from plant.compiled import MOST, Limits, Record, filled, kernel, record_dtype, shared_kernel
from plant.encoders import EncoderModel
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS, IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.planar import PLANAR_LEGS
from plant.pose import Array
from plant.stopwatch import now
from plant.vectors import subtract, vector

_LEAST_GRAVITY = 0.1
_LEAST_EVIDENCE_HZ = 125.0
"""Below this rate the motion between two commands is not known well enough for sound IMUs to agree with it."""

PARAMETERS = record_dtype(
    rig=RIG,
    imus=imu_health.PARAMETERS,
    base=base_imu.PARAMETERS,
    encoders=encoders.PARAMETERS,
    legs=leg_filter.PARAMETERS,
    platform=platform_filter.PARAMETERS,
    heading=heading_filter.PARAMETERS,
    pose=pose_estimator.PARAMETERS,
    mechanism=trust.PARAMETERS,
    integrity=integrity.PARAMETERS,
    level=level_frame.PARAMETERS,
    load=load_feed_forward.PARAMETERS,
    pid=pid.PARAMETERS,
    safety=safety_stage.PARAMETERS,
)
"""The constants of the cycle by stage, in SI units."""

PARAMETER_LIMITS: Limits = {
    "rig.legs": (PLANAR_LEGS, LEGS),
    "rig.geometry.ranks": (0, LINEAR_RANK),
    "heading.sample_cycles": (1, MOST),
    "mechanism.filter.window": (1, MOST),
    "integrity.filter.window": (2, MOST),
    "mechanism.filter.errors": (0, ERRORS),
    "mechanism.filter.rig": (0, RIG_ERRORS),
    "mechanism.filter.lengths": (0, LENGTH_ERRORS),
    "mechanism.filter.base": (0, BASE_ERRORS),
    "mechanism.filter.states": (MOTION_STATES, MOST_STATES),
}
"""Least and greatest of the constants that count, index or divide."""

STATE = record_dtype(
    time=TIME,
    imus=imu_health.STATE,
    base=base_imu.STATE,
    encoders=encoders.STATE,
    legs=leg_filter.STATE,
    platform=platform_filter.STATE,
    heading=heading_filter.STATE,
    pose=pose_estimator.STATE,
    mechanism=trust.STATE,
    integrity=integrity.STATE,
    reference=reference.STATE,
    level=level_frame.STATE,
    load=load_feed_forward.STATE,
    pid=pid.STATE,
    safety=safety_stage.STATE,
)
"""The state of the cycle by stage; zeros before the first cycle."""

RUNNING_LIMITS: Limits = {
    "time.cycle": (0, MOST),
    "reference.index": (0, MOST),
    "mechanism.again": (0, 1),
    "safety.mode": (Mode.IDLE, Mode.RUNNING),
    "safety.stop.cause": (Cause.NONE, Cause.NONE),
    "safety.stop.earlier_cause": (Cause.NONE, Cause.NONE),
    "safety.arming.obstacle": (Cause.NONE, max(Cause)),
    "safety.events.count": (0, 0),
    "pid.halvings": (0, pid.MOST_HALVINGS),
    **{f"integrity.{name}": limits for name, limits in integrity.LIMITS.items()},
}
"""The same of the state between two cycles of a run that is not stopping."""


class CycleStage(IntEnum):
    """The stages, in their order.

    Python calls kernels with their `value`: numba takes 30 us to tell a member of an enumeration, and compiles anew for it.
    """

    SCREENING, LEGS, PLATFORM, HEADING, POSE, REFINEMENT, MECHANISM, INTEGRITY, CONTROL, WATCH, END = range(11)


MARKS = record_dtype(ns=(np.int64, CycleStage.END), timespec=(np.int64, 2))
"""How long each stage took in the last cycle [ns], and scratch."""


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
    drive_settings: DriveSettings | None = None,
    command_delay: float = 0.0,
    to_arm: bool = True,
    encoder: EncoderModel | None = None,
    on_base: bool = False,
    level: bool = False,
    position_drives: bool = False,
    heave_period: float = 0.0,
) -> Record:
    """The constants of the cycle (dtype `PARAMETERS`).

    Args:
        mechanism: spatial or planar, with home, limits and plant data, its joints where the calibration has moved them.
        rate: cycles per second [Hz].
        control, fusion: settings.
        imus: which IMUs there are, 0-5 on the legs and 6 on the platform; those of absent legs do not count.
        whole: which errors of the IMUs the whole-mechanism filter estimates, a key of its `BLOCKS`; None for no such
            filter.
        calibration: of the IMUs; without one their readings are taken as they are.
        magnetometer: whether the platform's magnetometer gives its heading.
        section_5: whether the pose is that of the paper's section 5, unrefined; that needs the magnetometer.
        safety: limits that are watched; by default those of `SafetySettings`.
        drive_settings: what is known of the drives; by default as `DriveSettings` has it.
        command_delay: of the rig, from a sample to the command computed from it [s].
        to_arm: whether the drives are enabled; else everything is read and nothing moves.
        encoder: the kind of the encoders; None without encoders.
        on_base: whether there is an IMU on the base.
        level: whether the target is in the level frame; that needs that IMU, and six legs.
        position_drives: whether each drive closes a position loop of its own, whose goal moves at the commanded velocity.
        heave_period: mean period of the base's heave, in which a target in the level frame takes no part; 0 if it does [s].

    Raises:
        InputError: a rate out of range, an IMU that cannot be, IMUs that do not determine the pose, or a limit of the
            protection level where there is none.
    """
    check_rate(rate)
    check_imus(mechanism, imus, magnetometer, section_5, encoder)
    calibration, watched = calibration or Calibration(), safety or SafetySettings()
    limits, field = mechanism.require_limits(), field_of(mechanism, calibration.tilt)
    gravity = float(np.linalg.norm(mechanism.plant_parameters()["gravity"]))
    if gravity < _LEAST_GRAVITY:
        raise InputError(
            f"gravity is {gravity:g} m/s2; the accelerometers need at least {_LEAST_GRAVITY:g} to tell a direction"
        )
    present = imus_of(mechanism, imus)
    of_heading = field if magnetometer else None
    if level and (mechanism.planar or not on_base):
        raise InputError("a target in the level frame needs six legs and an IMU on the base: add --base-imu")
    if on_base and magnetometer:
        raise InputError(
            "the field of the earth turns in the frame of a base that moves: leave out --magnetometer or --base-imu"
        )
    of_base = fusion
    if on_base:
        fusion = base_imu.with_its_noise(fusion)
    rig, covariance = rig_parameters(mechanism, rate, control.hold, calibration.tilt), calibration.covariance
    if whole is not None and covariance is not None:
        covariance = with_biases_for_the_rest(covariance, whole, _readings_at_home(mechanism, rig["sensors"]))
    lead = lengths_lead(mechanism, imus, magnetometer, encoder)
    filtered = filter_parameters(
        fusion, rate, whole, covariance, calibration.floor, of_heading, ripple=ripple_at(rate), lengths=encoder is not None,
        base=on_base, start_share=1.0 if lead else pose_share(mechanism, fusion, imus, magnetometer),
    )  # fmt: skip
    prior = filtered["prior"][:ALL_ERRORS, :ALL_ERRORS] if calibration.covariance is None else calibration.covariance
    if on_base and not mechanism.planar:
        prior = prior + base_imu.shared_errors(mechanism, fusion)
    able = not _without_evidence(mechanism, rate, section_5)
    if min(watched.protection_position, watched.protection_rotation) < np.inf and not (able and watched.watch_imus):
        raise InputError(
            f"[safety] limits the protection level, which there is only in space, from {_LEAST_EVIDENCE_HZ:g} Hz on (this is "
            f"{rate:g} Hz), without the paper's section 5 and with watch_imus = 1: leave out protection_position and "
            "protection_rotation"
        )
    watch_evidence = bool(watched.watch_imus) and able
    if not able:
        watched = replace(watched, misfit=np.inf)
    if encoder is not None:
        share = length_share(mechanism, fusion, imus, magnetometer)
        watched = replace(watched, length_deviation=watched.length_deviation * share)
    if are_few(mechanism, imus):
        # The noise of their estimate alone makes the commands go to and fro.
        watched = replace(watched, evidence=np.inf, oscillation=np.inf)
    return filled(
        PARAMETERS,
        rig=rig,
        imus=imu_health.imu_parameters(present, calibration.gain, calibration.offset, fusion, watched, rate),
        base=base_imu.base_imu_parameters(mechanism, fusion, on_base, calibration.base_gain, calibration.base_offset),
        encoders=encoders.encoder_parameters(encoder, fusion, mechanism, lead),
        legs=leg_filter.leg_parameters(fusion, rate),
        platform=platform_filter.platform_parameters(fusion, rate, limits.jerk),
        heading=heading_filter.heading_parameters(fusion, rate, field, magnetometer),
        pose=pose_estimator.pose_parameters(fusion, section_5),
        mechanism=trust.trust_parameters(fusion, rate, filtered, bool(watched.watch_imus)),
        integrity=integrity.integrity_parameters(
            fusion, rate, prior, watch_evidence, base_imu.SHARED_NOISE if on_base else 1.0
        ),
        level=level_frame.level_parameters(mechanism, of_base, watched, level, heave_period),
        load=load_feed_forward.load_parameters(mechanism, command_delay, position_drives),
        pid=pid.pid_parameters(control, limits.velocity),
        safety=safety_stage.safety_parameters(
            watched, drive_settings or DriveSettings(), mechanism, rate, to_arm, position_drives, watch_evidence
        ),
    )


def _readings_at_home(mechanism: Mechanism, geometry: Record) -> Array:
    """What ideal IMUs read (7, 6) while the platform stands at home; `geometry` has the dtype `SENSOR_GEOMETRY`."""
    home, readings, axes = mechanism.require_home(), np.zeros((IMU_COUNT, READINGS)), np.zeros((IMU_COUNT, 3, 3))
    find_frames(geometry[()], home.position, home.rotation, axes)
    readings[:, 3:] = geometry["gravity"] * axes @ geometry["up_in_base"][0]
    return readings


def evidence_remark(mechanism: Mechanism, rate: float, section_5: bool = False) -> str:
    """What a user should know where evidence judges no readings, in a line; "" where it does."""
    where = _without_evidence(mechanism, rate, section_5)
    return where and (
        f"{where} an error that the IMUs share is told late, when the estimate has moved otherwise than commanded, and there "
        "is no protection level (docs/integrity.md)"
    )


def _without_evidence(mechanism: Mechanism, rate: float, section_5: bool) -> str:
    if mechanism.planar:
        return "in a plane"
    if section_5:
        return "with the paper's section 5"
    return f"below {_LEAST_EVIDENCE_HZ:g} Hz" if rate < _LEAST_EVIDENCE_HZ else ""


@kernel
def cycle(parameters: Record, state: Record, measurement: Array, segments: Array, marks: Record) -> int:
    """One cycle: from raw IMU data to the commands, which are left in `state`.

    Args:
        parameters, state: dtypes `PARAMETERS` and `STATE`; the state is zeros before the first cycle.
        measurement: (3, 7, 3), angular velocity [rad/s], specific force [m/s^2], magnetic field [uT] of the seven IMUs.
        segments: (6, n, 5), the reference as `controller.planning.segments` has it.
        marks: a record of dtype `MARKS`.

    Returns:
        `Cause.NONE`, or why there is no pose or why the estimate cannot be used: the cause of a fault, unless nothing has been
        armed yet.
    """
    return run_stages(parameters, state, measurement, segments, marks, CycleStage.SCREENING, CycleStage.END)


@shared_kernel
def run_stages(
    parameters: Record, state: Record, measurement: Array, segments: Array, marks: Record, first: int, last: int
) -> int:
    """The stages of a cycle from `first` up to but not including `last`; arguments and result as for `cycle`.

    `CONTROL` ends with the commands, which `WATCH` judges. After that the cycle is over: whoever leaves out that stage counts
    the cycle itself. After a fault, a cycle that begins only ramps the commands down.
    """
    p, s, m = parameters[()], state[()], marks
    rig, time = p.rig, s.time
    if first == CycleStage.SCREENING and s.safety.mode == Mode.FAULT:
        ramp_down(p.safety.stop, rig, time, s.pid)
        return Cause.NONE.value
    t = now(m.timespec)
    if first <= CycleStage.SCREENING < last:
        if time.behind > 0 and s.safety.stop.cause == Cause.NONE:
            # The stages before the control read the reference, too.
            _update_reference(parameters, state, segments)
        imu_health.screen_imus(
            p.imus, s.imus, rig, time, s.safety.watch.silent, measurement, s.reference.motion, s.safety.events
        )  # fmt: skip
        if p.level.active != 0 and s.base.begun != 0:
            force = vector(s.base.force)
            if s.mechanism.trusted != 0:
                force = subtract(force, vector(s.mechanism.filter.base_errors[3:]))
            base_motion.follow_base(
                p.level.motion, s.level.base, s.base.rate, s.base.fitted[1], force, vector(rig.sensors.up_in_base[0]),
                rig.sensors.gravity, elapsed(rig, time),
            )  # fmt: skip
        if p.base.present != 0:
            base_imu.remove_base_motion(p.base, s.base, rig, time, s.imus, s.legs, p.platform, s.platform, s.pose)
            watch.check_base_imu(p.safety, s.safety, rig, time, s.base, s.reference, s.pid)
        t = _mark(m, CycleStage.SCREENING, t)
    if first <= CycleStage.LEGS < last:
        leg_filter.step_leg_filters(p.legs, s.legs, rig, time, s.imus)
        t = _mark(m, CycleStage.LEGS, t)
    if first <= CycleStage.PLATFORM < last:
        pose_estimator.follow_plan(s.pose, rig, s.reference.motion)
        platform_filter.step_platform_filter(p.platform, s.platform, rig, time, s.imus, s.pose)
    if first <= CycleStage.HEADING < last:
        heading_filter.step_heading_filter(p.heading, s.heading, rig, time, s.imus, s.platform)
        t = _mark(m, CycleStage.HEADING, t)
    if first <= CycleStage.POSE < last:
        pose_estimator.take_vectors(s.pose, s.platform, s.heading)
        if p.encoders.lead != 0:
            s.pose.found = encoders.find_pose_by_lengths(
                p.encoders, s.encoders, p.pose, rig, time, s.legs, s.platform.rate, s.pose
            )
        else:
            conditioning = pose_estimator.find_pose(
                p.pose, s.pose, rig, s.legs.directions, s.legs.used, s.platform.used, s.heading.used
            )
            s.pose.found = conditioning >= RANK_TOLERANCE
        t = _mark(m, CycleStage.POSE, t)
    if first <= CycleStage.REFINEMENT < last:
        if s.pose.found != 0 and p.encoders.lead == 0:
            s.pose.found = pose_estimator.refine_pose(p.pose, s.pose, rig, time, s.legs, s.platform.rate)
            if s.pose.found != 0 and p.pose.section_5 == 0:
                moved = s.integrity.commanded.moved[0]
                watch.check_misfit(p.safety, s.safety, rig, time, s.pose, moved, s.reference, s.pid)
            if s.pose.found != 0 and p.pose.section_5 == 0 and p.encoders.count > 0:
                encoders.compare_lengths(p.encoders, s.encoders, rig, s.pose)
                if encoder_watch.judge_encoders(
                    p.safety, s.safety, rig, time, p.encoders, s.encoders, s.pose.lengths, s.reference, s.pid
                ):
                    trust.restart_filter(s.mechanism, time)
                s.pose.found = encoders.move_to_lengths(p.encoders, s.encoders, rig, time, s.pose)
        judged = p.integrity.filter.active != 0 and np.isfinite(p.safety.watch.evidence)
        if s.pose.found != 0 and p.safety.monitor.active != 0 and p.pose.section_5 == 0 and not judged:
            imu_monitor.look_at_next(
                p.safety.monitor, s.safety.monitor, s.pose, s.legs.directions, s.legs.weights, rig.vectors_in_base[0]
            )
            if attribution.exclude_imu(p.safety, s.safety, rig, time, s.imus, p.legs.weight, s.reference, s.pid):
                trust.restart_filter(s.mechanism, time)
                integrity.restart_integrity(p.integrity, s.integrity)
        t = _mark(m, CycleStage.REFINEMENT, t)
    if first <= CycleStage.MECHANISM < last:
        standing = s.safety.mode == Mode.IDLE and p.safety.arming.active != 0
        s.pose.found = trust.step_mechanism_filter(
            p.mechanism, s.mechanism, rig, time, standing, s.imus, s.encoders, s.legs, s.heading, s.pose, s.safety.events
        )  # fmt: skip
        t = _mark(m, CycleStage.MECHANISM, t)
    if first <= CycleStage.INTEGRITY < last:
        if s.pose.found != 0:
            _check_integrity(parameters, state)
        t = _mark(m, CycleStage.INTEGRITY, t)
    if first <= CycleStage.CONTROL < last:
        if s.pose.found != 0:
            _control(parameters, state, segments)
        t = _mark(m, CycleStage.CONTROL, t)
    cause = Cause.NONE.value
    if first <= CycleStage.WATCH < last:
        cause = _watch(parameters, state) if s.pose.found != 0 else _lose_pose(parameters, state)
        _mark(m, CycleStage.WATCH, t)
    return cause


@kernel
def _check_integrity(parameters: Record, state: Record) -> None:
    """Look for faults in the samples of the cycle, and react to what has been found with them."""
    p, s = parameters[()], state[()]
    rig, time = p.rig, s.time
    integrity.step_integrity(p.integrity, s.integrity, rig, time, s.imus, s.pose, s.reference.motion, s.pid.command)
    if s.integrity.fresh != 0:
        level = s.integrity.protection
        trust.find_closed_covariance(s.pose, level.scratch, level.covariance[0])
        trust.find_covariance(p.mechanism, s.mechanism, rig, time, s.pose, level.scratch, level.covariance[1])
        # Encoders of all legs show what the platform's IMU alone does not.
        alone = s.imus.used[PLATFORM_IMU] != 0 and not s.encoders.counts.all()
        by_legs = spread_by_legs(s.integrity.gravity, s.imus) if alone else 0.0
        end_level(level, s.integrity.evidence, time.cycle * rig.period, by_legs)
    integrity.publish_level(p.integrity, s.integrity, rig, time, s.imus, s.pose)
    changed = s.integrity.contradicts != 0 and attribution.judge_parity(
        p.safety, s.safety, rig, time, s.imus, s.integrity.parity, s.reference, s.pid
    )
    if changed:
        trust.restart_filter(s.mechanism, time)
        integrity.restart_integrity(p.integrity, s.integrity)
    if p.integrity.filter.active != 0:
        watch.check_judgement(p.safety, s.safety, rig, time, s.integrity, s.reference, s.pid)
        if not s.encoders.counts.any():
            watch.check_drift(p.safety, s.safety, rig, time, s.imus, s.integrity, s.reference, s.pid)
    # What parity has just left out is still in the evidence.
    judged = s.integrity.fresh != 0 and not changed
    if judged and attribution.judge_evidence(p.safety, s.safety, rig, time, s.imus, s.integrity, s.reference, s.pid):
        trust.restart_filter(s.mechanism, time)
        integrity.restart_integrity(p.integrity, s.integrity)


@kernel
def _mark(m: Record, stage: int, began: int) -> int:
    """Note how long a stage took; returns when it ended [ns]."""
    t = now(m.timespec)
    m.ns[stage] = t - began
    return t


@kernel
def _control(parameters: Record, state: Record, segments: Array) -> None:
    """From the pose to the commands."""
    p, s = parameters[()], state[()]
    rig, time, pose = p.rig, s.time, s.pose
    legs_at(
        rig.geometry.base_joints, rig.geometry.platform_joints, pose.position, pose.rotation, pose.arms, pose.directions,
        pose.lengths,
    )  # fmt: skip
    pose.lengths[rig.legs :] = 0.0
    if s.reference.due_cycle != time.cycle + 1:
        _update_reference(parameters, state, segments)
    for k in range(rig.legs):
        s.pid.error[k] = s.reference.motion[k, 0] - pose.lengths[k]
    arming.run_arming_checks(p.safety, s.safety, rig, time, p.imus, s.imus, s.integrity, pose, s.reference, s.pid)
    if not follows_commands(s.safety):
        pid.hold_still(s.pid, rig.legs)
    else:
        up, gravity = base_imu.vertical(p.base, s.base, rig)
        load_feed_forward.find_feed_forward(p.load, s.load, rig, pose, s.reference, up, gravity)
        pid.step_pid(p.pid, s.pid, s.load.feed_forward, elapsed(rig, time))


@kernel
def follows_commands(safety: Record) -> bool:
    """Whether the drives follow the commands."""
    return bool(safety.request == Request.ENABLED and safety.mode >= Mode.RUNNING)


@kernel
def _watch(parameters: Record, state: Record) -> int:
    """Judge the estimate and the commands; returns the cause of a fault, or `Cause.NONE`."""
    p, s = parameters[()], state[()]
    rig, time, pose = p.rig, s.time, s.pose
    if p.integrity.filter.active != 0:
        commanded.compare_with_commands(
            s.integrity.commanded, rig, time, follows_commands(s.safety), p.safety.drives.lag + p.load.command_delay, p.load,
            s.load, pose, s.reference, s.pid.command,
        )  # fmt: skip
        rest.compare_at_rest(
            s.integrity.rest, rig, elapsed(rig, time), follows_commands(s.safety), s.encoders.counts.any(),
            s.imus.shaking.told != 0, s.integrity.commanded.rate, p.load.droop, s.load.drive, s.integrity.parity.twist,
            s.integrity.protection.covariance[0], 2 * s.safety.watch.used_imus + s.mechanism.trusted, pose, s.reference,
        )  # fmt: skip
        watch.check_rest(p.safety, s.safety, rig, time, s.integrity.rest, s.reference, s.pid)
    if follows_commands(s.safety):
        watch.check_oscillation(
            p.safety, s.safety, rig, time, s.imus.shaking, s.integrity.parity.twist, s.load.feed_forward, s.reference, s.pid
        )  # fmt: skip
    watch.check_carried(p.safety, s.safety, rig, time, s.imus.shaking, s.legs, s.mechanism, s.reference, s.pid)
    time.cycle += 1
    cause = watch.check_limits(
        p.safety, s.safety, rig, time, p.imus, s.imus, pose, s.mechanism.trusted, s.reference, p.pid.limit, s.pid
    )
    if cause != Cause.NONE:
        return cause
    return drives.check_drives(p.safety, s.safety, rig, time, p.load.command_delay, s.load, pose, s.reference, s.pid)


@kernel
def _lose_pose(parameters: Record, state: Record) -> int:
    """The rest of a cycle without a pose, which is a fault unless nothing has been armed; returns its cause."""
    p, s = parameters[()], state[()]
    if not arming.postpones_arming(p.safety, s.safety, p.rig, s.time, Cause.POSE_LOST):
        react(parameters, state, Cause.POSE_LOST, -1, np.nan, np.nan)
    s.time.cycle += 1
    return Cause.POSE_LOST.value


@kernel
def skip_periods(state: Record, missed: int) -> None:
    """Before a cycle: say how many periods were missed since the last one."""
    time = state[()].time
    time.missed = missed
    time.behind = missed
    time.cycle += missed


@kernel
def hear_rig(parameters: Record, state: Record, sample_age: Array, drive: Array, drive_code: Array, silent: int) -> None:
    """Before a cycle: take the rig's report, as `controller.safety.watch.update_rig_status` has it."""
    p, s = parameters[()], state[()]
    watch.update_rig_status(
        p.safety, s.safety, p.rig, s.time, s.imus, s.reference, s.pid, sample_age, drive, drive_code, silent
    )  # fmt: skip


@kernel
def hear_encoders(
    parameters: Record, state: Record, silent: int, readings: Array, rates: Array, home: NDArray[np.int64]
) -> None:
    """Before a cycle: take the encoders' readings, as `controller.estimation.encoders.screen_encoders` has it."""
    p, s = parameters[()], state[()]
    encoders.screen_encoders(p.encoders, s.encoders, elapsed(p.rig, s.time), silent, readings, rates, home)


@kernel
def hear_base_imu(parameters: Record, state: Record, reading: Array, age: int) -> None:
    """Before a cycle: take the reading of the base's IMU, as `controller.estimation.base_imu.hear_base_imu` has it."""
    p, s = parameters[()], state[()]
    if p.base.present != 0:
        base_imu.hear_base_imu(p.base, s.base, elapsed(p.rig, s.time), reading, age)


@kernel
def react(parameters: Record, state: Record, cause: int, index: int, value: float, limit: float) -> None:
    """Between cycles: report a cause and react to it, as `controller.safety.stop.handle_cause` has it."""
    p, s = parameters[()], state[()]
    handle_cause(p.safety, s.safety, p.rig, s.time, s.reference, s.pid, cause, index, value, limit)


@kernel
def prepare_next(parameters: Record, state: Record, segments: Array) -> None:
    """After a cycle, when its events have been read: the next reference, which need not lie between measurement and command."""
    s = state[()]
    s.safety.events.count = 0
    if s.safety.mode != Mode.FAULT:
        _update_reference(parameters, state, segments)


@kernel
def _update_reference(parameters: Record, state: Record, segments: Array) -> None:
    """The reference of this cycle, in {1}."""
    p, s = parameters[()], state[()]
    reference.update_reference(s.reference, p.rig, s.time, s.safety, segments)
    s.time.behind = 0
    if p.level.active != 0:
        level_frame.follow_level_target(p.level, s.level, p.rig, s.safety, s.base, s.reference)
