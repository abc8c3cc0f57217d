"""Fusion: from raw IMU data to the pose of the platform, the left half of the paper's Figure 4, step by step.

    calibration -> which IMUs are sound -> leg, platform, heading filters -> closed form -> refinement -> whole-mechanism filter

The leg filters and the closed form need no first guess; they start the whole-mechanism filter and watch over it. Every step
works on the cycle's parameters and state (`controller.cycle`).
"""

import numpy as np

from controller.direct_kinematics.legs_alone import pose_from_legs
from controller.direct_kinematics.legs_and_attitude import pose_from_rotation, pose_from_vector, rotation_from_vectors
from controller.direct_kinematics.planar import pose_from_roll
from controller.direct_kinematics.refinement import (
    find_twist,
    move_pose,
    normal_equations,
    solve_normal_equations,
    stay_in_plane,
)
from controller.estimation.heading_filter import predict_heading, start_heading, update_heading
from controller.estimation.imu_monitor import look_at_next
from controller.estimation.leg_filter import leg_direction, lock_second_axis, predict_leg, start_leg, update_leg
from controller.estimation.mechanism_filter import collect, collect_field, extrapolate, start_filter, step_filter
from controller.estimation.platform_filter import start_platform, step_platform
from controller.inverse_kinematics import legs_at
from controller.least_squares import RANK_TOLERANCE
from controller.safety.watch import (
    IMU_BACK,
    IMU_FROZEN,
    IMU_NOISY,
    IMU_NOT_FINITE,
    IMU_OUT_OF_RANGE,
    IMU_STALE,
    NO_CAUSE,
    tell,
    watch_imus,
)
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE, MAGNETOMETER
from plant.mechanism import LEGS
from plant.pose import Array

WORST_CONDITIONING = 1e-2
"""Least conditioning of a closed form that is relied upon where there is another one, or none."""

_FIELD_SHARE = 0.3
"""By how much of itself the magnetic field may differ from the earth's: beyond that something magnetic is near."""

_FROZEN_FIELDS = 10
"""How many samples in a row of a magnetometer may be the same while the rest of its IMU moves."""

_GAP_S = 0.05
"""Longest time for which a leg's angular acceleration is taken to last [s]."""

_FADING_S = 0.1
"""Time constant with which the step between two sources of the pose fades away [s]."""


_NOISIER = 3.0
"""How much noisier than the others an IMU must be: what shakes them all is no fault of one."""


@kernel
def elapsed(parameters: Record, state: Record) -> float:
    """Time since the last cycle [s]."""
    return float((1 + state[()].missed) * parameters[()].period)


@kernel
def calibrate(parameters: Record, state: Record, measurement: Array) -> None:
    """Take the sensors' known errors out of a raw measurement (3, 7, 3), by (37), and find out which IMUs are sound.

    An IMU that gives what is not finite, is at the end of its range, is noisy, or stands still or is stale while others are
    not, is left out, and taken back when it has been sound for a while; one that contradicted the others is not.
    """
    p, s = parameters[()], state[()]
    changed, total_noise = 0, 0.0
    for k in range(IMU_COUNT):
        s.same[k] = 1
        for kind in range(2):
            for i in range(3):
                raw = measurement[kind, k, i]
                if np.isfinite(raw) and raw != s.raw[kind, k, i]:
                    s.same[k] = 0
        changed += p.imu_present[k] != 0 and s.same[k] == 0
        find_noise(parameters, state, measurement, k)
        total_noise += s.safety.noise[k]
    for k in range(IMU_COUNT):
        if s.same[k] == 0:
            s.stands[k] = 0
        elif changed > 0:
            s.stands[k] += 1
        why = NO_CAUSE
        value, limit = np.nan, np.nan
        if s.safety.sample_age[k] >= p.safety.stale_cycles and s.safety.silent == 0:
            why, value, limit = IMU_STALE, s.safety.sample_age[k], p.safety.stale_cycles
        elif s.stands[k] >= p.frozen_cycles:
            why, value, limit = IMU_FROZEN, s.stands[k], p.frozen_cycles
        noise = s.safety.noise[k]
        if why == NO_CAUSE and noise > max(1.0, _NOISIER * (total_noise - noise) / p.legs):
            why, value, limit = IMU_NOISY, noise, 1.0
        for kind in range(3):
            for i in range(3):
                raw = measurement[kind, k, i]
                s.raw[kind, k, i] = raw
                # NaN is not below the limit either.
                if kind < 2 and not abs(raw) < p.reach[kind]:
                    why, value, limit = IMU_OUT_OF_RANGE, abs(raw) / p.reach[kind], 1.0
                    if not np.isfinite(raw):
                        why, value, limit = IMU_NOT_FINITE, np.nan, np.nan
                total = p.calibration_offset[kind, k, i]
                for j in range(3):
                    total += p.calibration_gain[kind, k, i, j] * measurement[kind, k, j]
                s.sample[kind, k, i] = total
        if p.imu_present[k] == 0 or s.safety.excluded[k] != 0:
            s.imu_used[k] = 0
            continue
        used = s.imu_used[k]
        s.sound[k] = s.sound[k] + 1 + s.missed if why == NO_CAUSE else 0
        s.imu_used[k] = 1 if why == NO_CAUSE and (used != 0 or s.sound[k] > min(s.cycle, p.sound_cycles)) else 0
        if why != NO_CAUSE and (used != 0 or s.cycle == 0):
            tell(state, why, k, value, limit)
        elif s.imu_used[k] > used and s.cycle > 0:
            tell(state, IMU_BACK, k, np.nan, np.nan)


@kernel
def find_noise(parameters: Record, state: Record, measurement: Array, k: int) -> None:
    """The noise of IMU `k` over its limit, RMS: white noise of variance v has second differences of variance 6 v, to which
    motion adds little.
    """
    p, s = parameters[()], state[()]
    w, worst = s.safety, 0.0
    for kind in range(2):
        total = 0.0
        for i in range(3):
            raw = measurement[kind, k, i]
            change = raw - 2.0 * w.before[0, kind, k, i] + w.before[1, kind, k, i]
            total += change * change / 18.0
            w.before[1, kind, k, i] = w.before[0, kind, k, i]
            w.before[0, kind, k, i] = raw
        if s.cycle < 2 or not np.isfinite(total):
            total = 0.0
        w.variance[kind, k] += p.safety.noise_smoothing * (total - w.variance[kind, k])
        worst = max(worst, w.variance[kind, k] / p.safety.noise[kind] ** 2)
    w.noise[k] = np.sqrt(worst)


@kernel
def fuse_legs(parameters: Record, state: Record) -> None:
    """Step the leg filters of the IMUs that are sound."""
    s = state[()]
    for k in range(LEGS):
        if s.imu_used[k] != 0:
            fuse_leg(parameters, state, k)
    point_legs(parameters, state)


@kernel
def fuse_leg(parameters: Record, state: Record, k: int) -> None:
    """Start or step the filter of leg `k`."""
    p, s = parameters[()], state[()]
    x, covariance, up = s.leg_x[k], s.leg_covariance[k], p.sensors.up_in_joint[k]
    rate, force = s.sample[GYROSCOPE, k], s.sample[ACCELEROMETER, k]
    period = elapsed(parameters, state)
    if s.age[k] == 0:
        start_leg(x, covariance, rate, force, up, p.bias_sigma)
    else:
        if period > _GAP_S:
            x[4:6] = 0.0
        predict_leg(x, covariance, period, p.leg_jerk, p.bias_walk)
    if p.planar != 0:
        lock_second_axis(x, covariance)
    update_leg(
        x, covariance, rate, force, up, p.sensors.leg_imu_position[k], p.sensors.gravity, p.gyroscope_variance,
        p.leg_force_variance, s.measurement_6, s.jacobian_6_9, s.vectors_9[0], s.vectors_9[1],
    )  # fmt: skip


@kernel
def point_legs(parameters: Record, state: Record) -> None:
    """Directions of the legs and their rates from the states of the leg filters, and which of them are to be used: those whose
    filter has settled, which is asked of all but the first.
    """
    p, s = parameters[()], state[()]
    for k in range(LEGS):
        s.age[k] = s.age[k] + 1 + s.missed if s.imu_used[k] != 0 else 0
        settled = s.age[k] > min(s.cycle, p.leg_settling_cycles)
        s.leg_used[k] = 1.0 if settled else 0.0
        s.leg_weights[k] = p.leg_weight if settled else 0.0
        leg_direction(s.leg_x[k], p.sensors.joint_rotations[k], p.sensor_delay, s.directions[k], s.rates[k])


@kernel
def fuse_platform(parameters: Record, state: Record) -> None:
    """Step the platform's filter, with its own acceleration, known from the legs, taken out of the reading."""
    if not prepare_platform(parameters, state):
        return
    p, s = parameters[()], state[()]
    step_platform(
        s.platform_x, s.platform_covariance, s.sample[GYROSCOPE, PLATFORM_IMU], s.sample[ACCELEROMETER, PLATFORM_IMU],
        s.imu_acceleration, elapsed(parameters, state), p.sensors.gravity, p.gyroscope_density, p.bias_walk,
        p.vertical_variance, s.matrices_6_6[0], s.matrices_6_6[1], s.vectors_6[0], s.vectors_6[1],
    )  # fmt: skip
    find_vertical(parameters, state)


@kernel
def prepare_platform(parameters: Record, state: Record) -> bool:
    """Before the step of the platform's filter: start it where that is due, and find the acceleration of its IMU, seen in {2};
    returns whether there is a sample to take.
    """
    p, s = parameters[()], state[()]
    age = s.age[PLATFORM_IMU]
    s.age[PLATFORM_IMU] = age + 1 + s.missed if s.imu_used[PLATFORM_IMU] != 0 else 0
    s.platform_used = s.age[PLATFORM_IMU] > min(s.cycle, p.leg_settling_cycles)
    s.vector_weights[0] = p.vertical_weight if s.platform_used != 0 else 0.0
    if s.imu_used[PLATFORM_IMU] == 0:
        return False
    rate, force = s.sample[GYROSCOPE, PLATFORM_IMU], s.sample[ACCELEROMETER, PLATFORM_IMU]
    if age == 0:
        start_platform(s.platform_x, s.platform_covariance, force, p.bias_sigma)
    # That of the origin, and what turning adds at the IMU's place d.
    d = p.sensors.platform_imu_position
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
    return True


@kernel
def find_vertical(parameters: Record, state: Record) -> None:
    """After the step of the platform's filter: the platform's rate and the vertical in {2}, without the sensors' delay."""
    p, s = parameters[()], state[()]
    rate, w, u = s.sample[GYROSCOPE, PLATFORM_IMU], s.platform_rate, s.platform_x
    for i in range(3):
        w[i] = rate[i] - u[3 + i]
    _carry_on(u, w, p.sensor_delay, s.vectors[0])


@kernel
def _carry_on(x: Array, rate: Array, delay: float, carried: Array) -> None:
    """Write a vector that is fixed in {1}, seen in {2}, carried on by the delay of the sensors; x' = x x rate."""
    carried[0] = x[0] + delay * (x[1] * rate[2] - x[2] * rate[1])
    carried[1] = x[1] + delay * (x[2] * rate[0] - x[0] * rate[2])
    carried[2] = x[2] + delay * (x[0] * rate[1] - x[1] * rate[0])


@kernel
def fuse_heading(parameters: Record, state: Record) -> None:
    """Step the heading filter, if the magnetometer is to be used and is sound: its field is about as strong as the earth's, and
    does not stand still while the rest of its IMU moves. A sample that stands until the next one is taken once.
    """
    p, s = parameters[()], state[()]
    if p.magnetometer == 0:
        return
    field = s.sample[MAGNETOMETER, PLATFORM_IMU]
    if field[0] != s.field[0] or field[1] != s.field[1] or field[2] != s.field[2]:
        s.field_stands = 0
    elif s.same[PLATFORM_IMU] == 0:
        s.field_stands += 1
    s.field[:] = field
    # NaN is not below the limit either.
    strength = np.sqrt(field[0] * field[0] + field[1] * field[1] + field[2] * field[2])
    sound = (
        s.imu_used[PLATFORM_IMU] != 0
        and abs(strength - p.field_strength) < _FIELD_SHARE * p.field_strength
        and s.field_stands < _FROZEN_FIELDS * p.field_cycles
    )
    age = s.heading_age
    s.heading_age = age + 1 + s.missed if sound else 0
    s.heading_used = 1 if s.platform_used != 0 and s.heading_age > min(s.cycle, p.leg_settling_cycles) else 0
    s.field_fresh = 1 if sound and s.field_stands % p.field_cycles == 0 else 0
    s.vector_weights[1] = 0.0
    if not sound:
        return
    x, covariance, up = s.heading_x, s.heading_covariance, s.platform_x
    if age == 0:
        start_heading(x, covariance, field, up, p.heading_variance, p.bias_sigma)
    else:
        period = elapsed(parameters, state)
        predict_heading(x, covariance, up, s.platform_rate, period, p.gyroscope_density, p.bias_walk)
        if s.field_fresh != 0:
            update_heading(x, covariance, field, up, p.heading_variance)
    _carry_on(x, s.platform_rate, p.sensor_delay, s.vectors[1])
    if s.heading_used != 0:
        s.vector_weights[1] = 1.0 / (covariance[0, 0] + p.heading_floor)


@kernel
def find_pose(parameters: Record, state: Record) -> float:
    """The pose in closed form from the leg directions, and the vertical if the platform has an IMU; returns the
    conditioning. The platform's whole orientation, if it has a heading, stands in where those do not do, or is all that the
    paper's section 5 takes from the platform. A planar mechanism's pose takes the platform's vertical for its roll (section 6).
    """
    p, s = parameters[()], state[()]
    if p.planar != 0:
        s.conditioning = 0.0
        if s.platform_used != 0:
            s.conditioning = pose_from_roll(
                p.geometry, s.directions, s.leg_used, p.vectors_in_base[0], s.vectors[0], s.position, s.rotation
            )
        return float(s.conditioning)
    if s.platform_used == 0:
        s.conditioning = pose_from_legs(p.geometry, s.directions, s.leg_used, s.position, s.rotation, s.scratch)
        return float(s.conditioning)
    s.conditioning = 0.0
    if p.section_5 == 0:
        s.conditioning = pose_from_vector(
            p.geometry, s.directions, s.leg_used, p.vectors_in_base[0], s.vectors[0], s.position, s.rotation, s.scratch
        )
    if s.heading_used != 0 and s.conditioning < WORST_CONDITIONING:
        s.conditioning = 0.0
        if rotation_from_vectors(p.vectors_in_base, s.vectors, s.rotation):
            s.conditioning = pose_from_rotation(p.geometry, s.directions, s.leg_used, s.rotation, s.position, s.scratch)
    return float(s.conditioning)


@kernel
def improve_pose(parameters: Record, state: Record) -> bool:
    """Two Gauss-Newton steps for the pose; the twist comes with them, and the acceleration is its derivative.

    The paper's section 5 does not move the pose, and tells no covariance.
    """
    p, s = parameters[()], state[()]
    factor = s.matrices_6_6[0]
    for _ in range(2):
        normal_equations(
            p.geometry.base_joints, p.geometry.platform_joints, s.directions, s.leg_weights, p.vectors_in_base, s.vectors,
            s.vector_weights, s.position, s.rotation, s.arms, s.predicted, s.lengths, s.information, s.vectors_6[0],
        )  # fmt: skip
        if p.planar != 0:
            stay_in_plane(s.information, s.vectors_6[0])
        if not solve_normal_equations(s.information, s.vectors_6[0], factor):
            return False
        if p.section_5 != 0:
            s.information[:] = 0.0
            break
        move_pose(s.vectors_6[0], s.position, s.rotation)
    for i in range(3):
        s.angular_velocity[i] = 0.0
        for j in range(3):
            s.angular_velocity[i] += s.rotation[i, j] * s.platform_rate[j]
    find_twist(
        s.rates, s.leg_weights, s.vectors, s.vector_weights, s.angular_velocity, s.rotation, s.arms, s.predicted, s.lengths,
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
def locate(parameters: Record, state: Record) -> bool:
    """Direct kinematics, its refinement and the whole-mechanism filter; returns whether there is a pose."""
    found = find_pose(parameters, state) >= RANK_TOLERANCE and improve_pose(parameters, state)
    if found:
        monitor_imus(parameters, state)
    return fuse_mechanism(parameters, state, found)


@kernel
def monitor_imus(parameters: Record, state: Record) -> None:
    """After the refinement: look at the next IMU's contradiction, and leave out one that is wrong."""
    p, s = parameters[()], state[()]
    if p.safety.watch_imus == 0 or p.section_5 != 0:
        return
    look_at_next(
        s.safety.monitor, s.matrices_6_6[0], s.arms, s.predicted, s.lengths, s.directions, s.leg_weights, s.rotation,
        p.vectors_in_base[0], s.vectors[0], s.vector_weights[0], p.safety.smoothing,
    )  # fmt: skip
    watch_imus(parameters, state)


@kernel
def fuse_mechanism(parameters: Record, state: Record, found: bool) -> bool:
    """Step the whole-mechanism filter, which is started from the pose `found` in closed form; returns whether there is a pose.

    The filter's pose is used once it has settled, as long as the leg filters do not disagree with it; what the pose would jump
    by when its source changes fades away.
    """
    p, s = parameters[()], state[()]
    f = s.filter
    if p.filter.errors == 0:
        return found
    time = s.cycle * p.period
    if f.running == 0:
        if not found or s.cycle < s.filter_due:
            return found
        start_filter(p.filter, f, time, s.position, s.rotation, s.twist)
        s.filter_due = s.cycle + p.filter_settling_cycles
        return found
    collect(f, s.sample, s.imu_used, time - p.sensor_delay)
    if s.heading_used != 0 and s.field_fresh != 0:
        collect_field(f, s.field, time - p.sensor_delay)
    step_filter(p.filter, p.sensors, f)
    s.found_position[:] = s.position
    s.found_rotation[:] = s.rotation
    extrapolate(f, time, s.position, s.rotation, s.filter_twist, s.filter_acceleration)
    agree = _agree(parameters, state, found)
    s.disagreeing = 0 if agree else s.disagreeing + 1 + s.missed
    if s.disagreeing > p.patience_cycles:
        f.running = 0
        s.filter_due = s.cycle + p.filter_start_cycles
    elif s.cycle >= s.filter_due and agree:
        if s.filter_trusted == 0:
            s.filter_trusted = 1
            _bridge(s.found_position, s.found_rotation, s.position, s.rotation, s.offset)
        s.twist[:] = s.filter_twist
        s.acceleration[:] = s.filter_acceleration
    if s.filter_trusted != 0 and f.running == 0:
        s.filter_trusted = 0
        _bridge(s.position, s.rotation, s.found_position, s.found_rotation, s.offset)
    if s.filter_trusted == 0:
        if not found:
            return False
        s.position[:] = s.found_position
        s.rotation[:] = s.found_rotation
    share = max(1.0 - elapsed(parameters, state) / _FADING_S, 0.0)
    for i in range(6):
        s.offset[i] *= share
    move_pose(s.offset, s.position, s.rotation)
    return True


@kernel
def _bridge(position: Array, rotation: Array, new_position: Array, new_rotation: Array, offset: Array) -> None:
    """Add to `offset` (6,) the small way from the new pose to the one before."""
    for i in range(3):
        offset[i] += position[i] - new_position[i]
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = 0.0
        for m in range(3):
            turn += 0.5 * (rotation[k, m] * new_rotation[j, m] - rotation[j, m] * new_rotation[k, m])
        offset[3 + i] += turn
    for i in range(6):
        if not np.isfinite(offset[i]):
            offset[:] = 0.0


@kernel
def _agree(parameters: Record, state: Record, found: bool) -> bool:
    """Whether the leg filters' directions are near those of the whole-mechanism filter's pose, which is finite at least."""
    p, s = parameters[()], state[()]
    if not found:
        return bool(np.isfinite(s.position.sum() + s.rotation.sum()))
    legs_at(p.geometry.base_joints, p.geometry.platform_joints, s.position, s.rotation, s.arms, s.predicted, s.lengths)
    total = legs = 0.0
    for k in range(LEGS):
        if s.leg_used[k] != 0.0:
            legs += 1.0
            for i in range(3):
                total += (s.directions[k, i] - s.predicted[k, i]) ** 2
    return bool(total <= legs * p.disagreement**2)
