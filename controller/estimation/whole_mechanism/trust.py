"""Whether the whole-mechanism filter is trusted: when it starts, when its pose is used, and how the source of the pose changes.

The filter starts from the pose in closed form. Its pose is used once it has settled and knows its rotation, as long as the leg
filters agree with it.

The filter knows the pose better than the closed form, but it expects less jerk than joints with clearance or screws with
backlash have, and is late for what is fast. A loop that is closed by a late pose chatters. So the loop's pose is the one in
closed form, moved by the step from there to the filter's pose, low-passed. It takes what is slow from the filter, and what is
fast from the closed form. The low-pass is of second order and follows a step that grows steadily without lag. When the filter
is not used, the step fades away.

One IMU that is wrong can turn the filter's pose by 0.7 deg within 0.3 s, about an axis about which the legs' directions hardly
show it. The closed form is off by less. So the pose takes no more of the step than the closed form's covariance explains.
"""

import numpy as np

from controller.direct_kinematics.refinement import move_pose
from controller.estimation.shaking import worth_of
from controller.estimation.whole_mechanism.filter import (
    accumulate_field,
    accumulate_lengths,
    accumulate_sample,
    accumulate_switch,
    extrapolate,
    extrapolate_covariance,
    start_filter,
    start_lengths,
    step_filter,
)
from controller.estimation.whole_mechanism.parameters import BLOCKS, FILTER_PARAMETERS, FILTER_STATE
from controller.inverse_kinematics import legs_at
from controller.least_squares import factor_cholesky, invert_cholesky
from controller.rig import elapsed
from controller.safety.causes import Cause, report_event
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import dot, vector

_FIRST_S, _START_S, _SETTLING_S, _SETTLING_AGAIN_S = 0.1, 0.3, 0.3, 1.0
"""The filter starts after the first time with few IMUs, and after the second when it was stopped. Its pose is used after the
third time at the first start, when the legs are at rest, and after the last at each later start [s].
"""

_FEW_IMUS = 4.0
"""IMUs are few if they leave the pose so many times more uncertain than all do. Their first pose may be degrees off, and the
filter, which is linear about its start, must wait for a better one.
"""

_OVERCONFIDENCE = 10.0
"""With few IMUs and encoders the filter learns less from a few millimetres of motion than its covariance says: it states
0.2 deg where it is 1 deg off. So its rotation must be known so many times better before it is trusted.
"""

_AVERAGE_S = 0.05
"""Time constant of the mean square of the angles between the leg filters' directions and the filter's pose [s]."""

_MOST_DOUBLINGS = 10
"""The filter is started later each time that the leg filters have disagreed: twice as late, so many times at most."""

_BLENDING_S = 0.03
"""Time constant of the low-pass of the step from the pose in closed form to the filter's [s]."""

_FARTHEST = 2.5
"""The most of that step that the pose takes, in standard deviations of the closed form, RMS over its six components. Sound runs
reach 1.4.
"""

_FAST = 0.1
"""Share of the closed form's standard deviation that changes faster than this low-pass: 0.02 to 0.08 in the closed loop."""

PARAMETERS = record_dtype(
    filter=FILTER_PARAMETERS,
    delay=np.float64,  # of the sensors [s]
    first_cycle=np.int64,  # before which the filter does not start
    start_cycles=np.int64,  # this and the next: the durations above
    settling_cycles=(np.int64, 2),
    disagreement=np.float64,  # of the leg filters with the filter, limit of the mean square [rad^2]
    known=np.float64,  # greatest variance of the filter's rotation with which it may be trusted [rad^2]
    smoothing=np.float64,  # share of a cycle's in that mean
    farthest=np.float64,  # limit of the step's square by the closed form's information; infinite where it has no limit
)
"""Constants."""

STATE = record_dtype(
    filter=FILTER_STATE,
    due=np.int64,  # the cycle in which the filter is started, or from which on it may be trusted
    again=np.int64,  # whether it has been started before
    trusted=np.int64,  # whether the pose is the filter's
    disagreement=np.float64,  # of the leg filters with the filter, mean square [rad^2]
    stops=np.int64,  # how often that has stopped the filter
    step=(np.float64, 6),  # from the pose in closed form to the filter's [m, rad]
    taken=np.float64,  # share of this step that the closed form's covariance explains
    correction=(np.float64, 6),  # this share, low-passed, which moves the pose
    growth=(np.float64, 6),  # of the step within `_BLENDING_S`
    alone=np.int64,  # whether the filter's pose was the only one
    closed_position=(np.float64, 3),  # of the pose in closed form [m]
    closed_rotation=(np.float64, (3, 3)),
    twist=(np.float64, 6),  # of the filter
    acceleration=(np.float64, 6),  # of the filter
    weights=(np.float64, (2, IMU_COUNT)),  # of the sensors' samples
)
"""State of the filter and of the trust in it."""


def trust_parameters(fusion: FusionSettings, rate: float, filter_constants: Record, bounded: bool) -> Record:
    """The constants (dtype `PARAMETERS`), around those of the filter itself.

    Args:
        fusion: settings.
        rate: [Hz].
        filter_constants: of the filter.
        bounded: whether the closed form bounds the filter's pose: not with raw IMUs, whose errors its covariance does not know.
    """
    few = filter_constants["start_share"] > _FEW_IMUS
    # It may be far from the closed form, rightly, if it knows lengths, mountings or what the base's IMU reads wrong.
    more = filter_constants["errors"] > BLOCKS["accelerometers"] or filter_constants["lengths"] + filter_constants["base"] > 0
    overconfidence = _OVERCONFIDENCE if few and filter_constants["lengths"] > 0 else 1.0
    return filled(
        PARAMETERS,
        filter=filter_constants,
        delay=fusion.sensor_delay,
        first_cycle=round(_FIRST_S * rate) if few else 0,
        start_cycles=round(_START_S * rate),
        settling_cycles=(round(_SETTLING_S * rate), round(_SETTLING_AGAIN_S * rate)),
        disagreement=fusion.disagreement**2,
        known=(fusion.disagreement / overconfidence) ** 2,
        smoothing=1.0 / max(1.0, _AVERAGE_S * rate),
        farthest=6.0 * _FARTHEST**2 if bounded and not few and not more else np.inf,
    )


@shared_kernel
def step_mechanism_filter(
    p: Record, s: Record, rig: Record, time: Record, standing: bool, imus: Record, encoders: Record, legs: Record,
    heading: Record, pose: Record, events: Record,
) -> bool:  # fmt: skip
    """Step the filter, and let its pose replace the one in closed form while it is trusted; returns whether there is a pose.

    Args:
        standing: whether the brakes hold the platform.
    """
    f, found = s.filter, bool(pose.found != 0)
    pose.apart[:] = 0.0
    if p.filter.errors == 0:
        return found
    now = time.cycle * rig.period
    if f.running == 0:
        if found and time.cycle >= max(s.due, p.first_cycle):
            start_filter(p.filter, f, now, pose.position, pose.rotation, pose.twist)
            if p.filter.lengths > 0:
                start_lengths(f, encoders.zero)
                for k in range(LEGS):
                    if encoders.switch_step[k] != 0.0 and encoders.followed_for[k] == np.inf:
                        accumulate_switch(f, k, encoders.zero[k], encoders.switch_step[k])
            s.due = time.cycle + p.settling_cycles[s.again]
            s.again = 1
            s.disagreement = 0.0
        if found:
            _correct(s, rig, time, pose)
        return found
    for k in range(IMU_COUNT):
        # A sample that is repeated is of another time.
        fresh = imus.used[k] != 0 and imus.sample_age[k] == 0
        # What the closed form doubts has bent one of the other filters, and counts less here as well.
        share = 1.0 / (1.0 + pose.doubts[k]) if fresh else 0.0
        for sensor in range(2):
            s.weights[sensor, k] = share * worth_of(imus.shaking, sensor, k, p.filter.variance[sensor])
    accumulate_sample(f, imus.sample, s.weights, now - p.delay)
    if p.filter.lengths > 0:
        accumulate_lengths(f, encoders.reading, encoders.used, now)
        for k in range(LEGS):
            if encoders.passed_switch[k] != 0:
                accumulate_switch(f, k, encoders.zero[k], encoders.switch_step[k])
    if heading.used != 0 and heading.fresh != 0:
        accumulate_field(f, heading.field, now - p.delay)
    f.standing = standing and p.filter.start_share > 1.0
    step_filter(p.filter, rig.sensors, f)
    s.closed_position[:] = pose.position
    s.closed_rotation[:] = pose.rotation
    extrapolate(f, now, pose.position, pose.rotation, s.twist, s.acceleration)
    s.disagreement += min(1.0, (1 + time.missed) * p.smoothing) * (_disagreement(rig, legs, pose) - s.disagreement)
    if not s.disagreement <= p.disagreement:
        f.running = 0
        s.due = time.cycle + (p.start_cycles << min(s.stops, _MOST_DOUBLINGS))
        if s.trusted != 0:
            s.stops += 1
            report_event(events, Cause.FILTER_DISAGREES, -1, np.sqrt(s.disagreement), np.sqrt(p.disagreement))
    elif s.trusted == 0 and time.cycle >= s.due and _knows_rotation(f, p.known):
        s.trusted = 1
    if f.running == 0:
        s.trusted = 0
    if s.trusted != 0:
        pose.twist[:] = s.twist
    if found:
        _find_step(s.closed_position, s.closed_rotation, pose.position, pose.rotation, s.step)
        if s.trusted != 0:
            for part in range(2):
                step = vector(s.step[3 * part :])
                pose.apart[part] = np.sqrt(dot(step, step))
        s.taken = _share_within(s.step, pose.information, p.farthest) if s.trusted != 0 else 1.0
        pose.position[:] = s.closed_position
        pose.rotation[:] = s.closed_rotation
        _correct(s, rig, time, pose)
    else:
        s.alone = s.trusted
        s.taken = 1.0
        if s.trusted == 0:
            return False
        for i in range(6):
            pose.smooth_twist[i], pose.unplanned[i] = s.twist[i], s.acceleration[i] - pose.planned[1, i]
    # The legs were last found at the filter's pose, which may not be the one that is used.
    _find_legs(rig, pose)
    return True


@kernel
def restart_filter(s: Record, time: Record) -> None:
    """Let the filter begin anew, as an IMU on which it relied has been left out or one has come back."""
    if s.filter.running != 0:
        s.filter.running = s.trusted = 0
        s.due = time.cycle


@kernel
def find_covariance(p: Record, s: Record, rig: Record, time: Record, pose: Record, factor: Array, covariance: Array) -> None:
    """Write the pose's covariance (6, 6), NaN if there is none.

    It is that of the refinement, or of a filter that is trusted, with what the pose has of the refinement: what is fast, and
    the share of the step that is not taken.
    """
    find_closed_covariance(pose, factor, covariance)
    if s.trusted == 0:
        return
    extrapolate_covariance(p.filter, s.filter, time.cycle * rig.period, factor)
    share = _FAST**2 + (1.0 - s.taken) ** 2
    for i in range(6):
        for j in range(6):
            closed = share * covariance[i, j]
            covariance[i, j] = factor[i, j] + (closed if np.isfinite(closed) else 0.0)


@kernel
def find_closed_covariance(pose: Record, factor: Array, covariance: Array) -> None:
    """Write the covariance (6, 6) of the refined pose in closed form; NaN if there is none."""
    factor[:] = pose.information
    if factor_cholesky(factor):
        invert_cholesky(factor, covariance)
    else:
        covariance[:] = np.nan


@kernel
def _correct(s: Record, rig: Record, time: Record, pose: Record) -> None:
    """Move the pose in closed form by the low-passed step to the filter's pose, or by what is left of it without the filter."""
    share = min(1.0, elapsed(rig, time) / _BLENDING_S)
    for i in range(6):
        if s.trusted == 0:
            s.growth[i] = 0.0
            s.correction[i] -= share * s.correction[i]
        elif s.alone != 0:
            s.correction[i] = s.step[i]
        else:
            left = s.taken * s.step[i] - s.correction[i]
            s.growth[i] += share * left
            s.correction[i] += share * (left + s.growth[i])
    s.alone = 0
    move_pose(s.correction, pose.position, pose.rotation)


@kernel
def _find_step(position: Array, rotation: Array, new_position: Array, new_rotation: Array, step: Array) -> None:
    """Write the small step (6,) from one pose to the new one [m, rad]."""
    for i in range(3):
        step[i] = new_position[i] - position[i]
        j, k = (i + 1) % 3, (i + 2) % 3
        turn = 0.0
        for m in range(3):
            turn += 0.5 * (rotation[j, m] * new_rotation[k, m] - rotation[k, m] * new_rotation[j, m])
        step[3 + i] = turn


@kernel
def _share_within(step: Array, information: Array, most: float) -> float:
    """The share of a step (6,) whose square by an information matrix (6, 6), of which the lower triangle counts, is `most`.

    1 if that of the whole step is less, or not finite.
    """
    squared = 0.0
    for i in range(6):
        for j in range(i + 1):
            squared += (1.0 if i == j else 2.0) * step[i] * information[i, j] * step[j]
    return np.sqrt(most / squared) if squared > most else 1.0


@kernel
def _knows_rotation(f: Record, variance: float) -> bool:
    """Whether the filter's own rotation is known to this variance [rad^2], which it is not at rest with few IMUs."""
    return bool(f.published_covariance[3, 3] + f.published_covariance[4, 4] + f.published_covariance[5, 5] <= variance)


@kernel
def _disagreement(rig: Record, legs: Record, pose: Record) -> float:
    """The mean square of the angles between the leg filters' directions and those of the filter's pose [rad^2]; NaN if that is
    not finite.

    If the leg filters have no pose, there is nothing to compare.
    """
    if pose.found == 0:
        return 0.0 if np.isfinite(pose.position.sum() + pose.rotation.sum()) else np.nan
    _find_legs(rig, pose)
    total = count = 0.0
    for k in range(LEGS):
        if legs.used[k] != 0.0:
            count += 1.0
            for i in range(3):
                total += (legs.directions[k, i] - pose.directions[k, i]) ** 2
    return total / max(count, 1.0)


@kernel
def _find_legs(rig: Record, pose: Record) -> None:
    legs_at(
        rig.geometry.base_joints, rig.geometry.platform_joints, pose.position, pose.rotation, pose.arms, pose.directions,
        pose.lengths,
    )  # fmt: skip
