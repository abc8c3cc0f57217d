"""A target in the level frame: the platform keeps its attitude on the earth while the base rolls.

`controller.estimation.base_motion` tells the base's attitude B, which turns {1} to the level frame, and its heave h. With the
heave, the level frame has its origin where that of {1} is without it; otherwise the two origins are one.

A target pose p, R in the level frame is B^T (p - h up), B^T R in {1}. Its rate and acceleration there follow from those of the
base. The reference of a leg follows that, within the limits of its drive and its stroke; where it cannot, that is told.
"""

import numpy as np

from controller.direct_kinematics.lengths import find_pose
from controller.estimation import base_motion
from controller.estimation.base_motion import heave
from controller.inverse_kinematics import legs_at, motion_of_legs
from controller.safety.causes import Cause, Mode, Request, report_event
from controller.settings import FusionSettings, SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array
from plant.vectors import add, cross, dot, rotate_back, scale, subtract, vector

_BANDWIDTH = 20.0
"""Of the reference that follows the target [rad/s]."""

_BEGINNING_S = 2.0
"""In what time the platform goes from the base's frame to the level one [s]."""

_RESERVE = 0.9
"""Share of the drives' limits that may be used."""

_LATE_M = 2e-3
"""From which distance of a leg from its target on it is told that the target cannot be followed [m]."""

PARAMETERS = record_dtype(
    active=np.int64,  # whether the target is in the level frame
    velocity=np.float64,  # limits of a leg [m/s, m/s^2, m]
    acceleration=np.float64,
    stroke=(np.float64, (LEGS, 2)),
    motion=base_motion.PARAMETERS,
    position=(np.float64, 3),  # where the target begins
    rotation=(np.float64, (3, 3)),
)
"""Constants."""

STATE = record_dtype(
    base=base_motion.STATE,
    running_for=np.float64,  # how long the reference has followed [s]
    due_cycle=np.int64,  # of the reference that has been found last
    offset=(np.float64, LEGS),  # of the first reference from the target [m]
    motion=(np.float64, (LEGS, 3)),  # the reference: length, rate and acceleration
    late=np.int64,  # whether it is late
    position=(np.float64, 3),  # the target's pose in the level frame
    rotation=(np.float64, (3, 3)),
    arms=(np.float64, (LEGS, 3)),  # from here on scratch
    directions=(np.float64, (LEGS, 3)),
    lengths=(np.float64, LEGS),
    wanted=(np.float64, LEGS),
    jacobian=(np.float64, (6, 6)),
    twist=(np.float64, (2, 6)),
    seen_position=(np.float64, 3),
    seen_rotation=(np.float64, (3, 3)),
)
"""State."""


def level_parameters(
    mechanism: Mechanism, fusion: FusionSettings, safety: SafetySettings, active: bool, heave_period: float
) -> Record:  # fmt: skip
    """The constants (dtype `PARAMETERS`) of a mechanism with limits; `heave_period` as in `base_motion_parameters`."""
    limits, home = mechanism.require_limits(), mechanism.require_home()
    stroke = np.zeros((LEGS, 2))
    stroke[: mechanism.legs] = limits.stroke + safety.stroke_margin * np.array([1.0, -1.0])
    return filled(
        PARAMETERS,
        active=active,
        velocity=_RESERVE * limits.velocity,
        acceleration=_RESERVE * limits.acceleration,
        stroke=stroke,
        motion=base_motion.base_motion_parameters(mechanism, fusion, heave_period),
        position=home.position,
        rotation=home.rotation,
    )


@shared_kernel
def follow_level_target(p: Record, s: Record, rig: Record, safety: Record, base: Record, reference: Record) -> None:
    """After the reference of the target in the level frame: replace it by that of the legs in {1}.

    Until the drives follow, and in a stop, the reference stays as it is.
    """
    planned, motion = reference.motion, s.motion
    following = safety.mode == Mode.RUNNING and safety.request == Request.ENABLED and s.base.begun != 0
    if not following:
        s.running_for = 0.0
        motion[:] = planned
        s.due_cycle = reference.due_cycle
        return
    first = s.running_for == 0.0
    if first:
        motion[:] = planned
        s.position[:] = p.position
        s.rotation[:] = p.rotation
    t = (reference.due_cycle - s.due_cycle) * rig.period
    if t > 0.0 and _find_target(p, s, rig, base, planned):
        s.due_cycle = reference.due_cycle
        for k in range(LEGS):
            if first:
                s.offset[k] = motion[k, 0] - planned[k, 0]
        s.running_for += t
        share = min(s.running_for / _BEGINNING_S, 1.0)
        left = 1.0 - share**3 * (10.0 - share * (15.0 - 6.0 * share))
        worst, most = 0, 0.0
        for k in range(LEGS):
            late = _follow(p, k, planned[k], left * s.offset[k], motion[k], t)
            if late > most:
                worst, most = k, late
        if most > _LATE_M and s.late == 0:
            report_event(safety.events, Cause.LEVEL_BEYOND, worst, most, _LATE_M)
        s.late = 1 if most > (_LATE_M if s.late == 0 else 0.5 * _LATE_M) else 0
    planned[:] = motion


@kernel
def _find_target(p: Record, s: Record, rig: Record, base: Record, legs: Array) -> bool:
    """Replace the motion (6, 3) of the legs at a target in the level frame by that at the same target seen in {1}; returns
    whether there is one.
    """
    geometry, b = rig.geometry, s.base.attitude
    for k in range(LEGS):
        s.wanted[k] = legs[k, 0]
    if not find_pose(geometry, s.wanted, s.position, s.rotation, s.arms, s.directions, s.lengths, s.jacobian) < 1e-9:
        return False
    legs_at(geometry.base_joints, geometry.platform_joints, s.position, s.rotation, s.arms, s.directions, s.lengths)
    if not motion_of_legs(s.arms, s.directions, s.lengths, rig.legs, legs, s.jacobian, s.twist):
        return False
    w, angular_acceleration = subtract(vector(base.fitted[0]), vector(s.base.bias)), vector(base.fitted[1])
    up, (height, rising, lifted) = vector(rig.sensors.up_in_base[0]), heave(p.motion, s.base)
    place = rotate_back(b, subtract(vector(s.position), scale(height, up)))
    turning = subtract(rotate_back(b, vector(s.twist[0, 3:])), w)
    speed = subtract(rotate_back(b, subtract(vector(s.twist[0]), scale(rising, up))), cross(w, place))
    carried = add(cross(angular_acceleration, place), cross(w, add(cross(w, place), scale(2.0, speed))))
    acceleration = subtract(rotate_back(b, subtract(vector(s.twist[1]), scale(lifted, up))), carried)
    angular = subtract(rotate_back(b, vector(s.twist[1, 3:])), add(angular_acceleration, cross(w, turning)))
    s.seen_position[0], s.seen_position[1], s.seen_position[2] = place
    for j in range(3):
        column = rotate_back(b, (s.rotation[0, j], s.rotation[1, j], s.rotation[2, j]))
        s.seen_rotation[0, j], s.seen_rotation[1, j], s.seen_rotation[2, j] = column
    legs_at(geometry.base_joints, geometry.platform_joints, s.seen_position, s.seen_rotation, s.arms, s.directions, s.lengths)
    for k in range(LEGS):
        d, arm = vector(s.directions[k]), vector(s.arms[k])
        across = cross(turning, arm)
        joint = add(speed, across)
        joint_acceleration = add(acceleration, add(cross(angular, arm), cross(turning, across)))
        legs[k, 0], legs[k, 1] = s.lengths[k], dot(d, joint)
        legs[k, 2] = dot(d, joint_acceleration) + (dot(joint, joint) - legs[k, 1] ** 2) / s.lengths[k]
    return True


@kernel
def _follow(p: Record, k: int, target: Array, offset: float, motion: Array, t: float) -> float:
    """Let the reference of leg `k` follow its target, length, rate and acceleration, for a time `t` [s]; returns how far it is
    behind [m].
    """
    low, high = p.stroke[k]
    wanted = target[0] + offset
    inside = min(max(wanted, low), high)
    free = wanted == inside
    rate = target[1] if free else 0.0
    acceleration = _BANDWIDTH * (2.0 * (rate - motion[1]) + _BANDWIDTH * (inside - motion[0])) + (target[2] if free else 0.0)
    acceleration = min(max(acceleration, -p.acceleration), p.acceleration)
    before = motion[1]
    motion[1] = min(max(before + t * acceleration, -p.velocity), p.velocity)
    motion[2] = (motion[1] - before) / t
    motion[0] += 0.5 * t * (before + motion[1])
    return float(abs(wanted - motion[0]))
