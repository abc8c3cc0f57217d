"""A target in the level frame: the platform keeps its attitude on the earth while the base rolls.

The level frame has the axes that {1} has while the base is level, and the origin of {1}. The base's attitude B, which turns {1}
to it, follows the gyroscope of the base's IMU, less its bias b. The accelerometer corrects both as a Kalman filter does. With a
small error d of B, seen in the level frame,

    d' = c,   c = B (b - its truth),   B f x up / g = d + noise

The noise is that of a base that is accelerated to and fro, so that a sample counts for tens of seconds. Nothing tells the
heading. It is taken to be that at the start, with the same noise: the platform keeps its heading while the base yaws to and
fro, and turns with a base that goes on turning.

A target pose p, R in the level frame is B^T p, B^T R in {1}. Its rate and acceleration there follow from those of the base. The
reference of a leg follows that, within the limits of its drive and its stroke; where it cannot, that is told.
"""

import numpy as np

from controller.direct_kinematics.lengths import find_pose
from controller.inverse_kinematics import legs_at, motion_of_legs
from controller.safety.causes import Cause, Mode, Request, report_event
from controller.settings import FusionSettings, SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, rotate_by_vector
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

_SWAY = 0.02
"""Density of the accelerations of a base in waves, as noise of its vertical [m/s^2/sqrt(Hz)]."""

_BIAS_WALK = 3e-6
"""Of the gyroscope on the base, while nothing but a swaying vertical tells it [rad/s/sqrt(s)]."""

_FIRST_TILT = 0.1
"""Uncertainty of the tilt after the first sample [rad]."""

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
    rate_density=np.float64,  # spectral density of the gyroscope's noise [rad^2/s]
    tilt_variance=np.float64,  # of a sample of the vertical, per second between samples [rad^2 s]
    bias_variance=np.float64,  # of the bias at the start [rad^2/s^2]
    position=(np.float64, 3),  # where the target begins
    rotation=(np.float64, (3, 3)),
)
"""Constants."""

STATE = record_dtype(
    begun=np.int64,  # whether there is an attitude
    attitude=(np.float64, (3, 3)),  # B
    bias=(np.float64, 3),  # b [rad/s]
    covariance=(np.float64, 3),  # of an angle, with its bias, and of the bias
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
    turn=(np.float64, 3),
    seen_position=(np.float64, 3),
    seen_rotation=(np.float64, (3, 3)),
)
"""State."""


def level_parameters(mechanism: Mechanism, fusion: FusionSettings, safety: SafetySettings, active: bool) -> Record:
    """The constants (dtype `PARAMETERS`) of a mechanism with limits."""
    limits, home = mechanism.require_limits(), mechanism.require_home()
    gravity = float(np.linalg.norm(mechanism.plant_parameters()["gravity"]))
    stroke = np.zeros((LEGS, 2))
    stroke[: mechanism.legs] = limits.stroke + safety.stroke_margin * np.array([1.0, -1.0])
    return filled(
        PARAMETERS,
        active=active,
        velocity=_RESERVE * limits.velocity,
        acceleration=_RESERVE * limits.acceleration,
        stroke=stroke,
        rate_density=fusion.gyroscope_noise**2,
        tilt_variance=(_SWAY / gravity) ** 2,
        bias_variance=fusion.bias_sigma**2,
        position=home.position,
        rotation=home.rotation,
    )


@kernel
def follow_attitude(p: Record, s: Record, rate: Array, force: Array, up: Vector, gravity: float, period: float) -> None:
    """Carry the attitude of the base on by `period` [s], and correct it.

    Args:
        rate, force: (3,), of the base's IMU in {1} [rad/s, m/s^2].
        up: the vertical in the level frame.
        gravity: [m/s^2].
    """
    b, c = s.attitude, s.covariance
    if s.begun == 0:
        s.begun = 1
        for i in range(3):
            for j in range(3):
                b[i, j] = 1.0 if i == j else 0.0
        c[0], c[1], c[2] = _FIRST_TILT**2, 0.0, p.bias_variance
        # The force is taken for gravity.
        felt = vector(force)
        turn = cross(scale(1.0 / np.sqrt(dot(felt, felt)), felt), up)
        sine = np.sqrt(dot(turn, turn))
        _rotate(s, b, scale(np.arcsin(min(sine, 1.0)) / max(sine, 1e-12), turn))
        return
    _rotate(s, b, scale(period, rotate(b, subtract(vector(rate), vector(s.bias)))))
    c[0] += period * (2.0 * c[1] + period * c[2] + p.rate_density)
    c[1] += period * c[2]
    c[2] += period * _BIAS_WALK**2
    heading = 0.5 * dot(up, (b[2, 1] - b[1, 2], b[0, 2] - b[2, 0], b[1, 0] - b[0, 1]))
    off = subtract(scale(1.0 / gravity, cross(rotate(b, vector(force)), up)), scale(heading, up))
    whole = c[0] + p.tilt_variance / period
    of_angle, of_bias = c[0] / whole, c[1] / whole
    c[2] -= of_bias * c[1]
    c[1] -= of_bias * c[0]
    c[0] -= of_angle * c[0]
    learned = rotate_back(b, scale(of_bias, off))
    for i in range(3):
        s.bias[i] -= learned[i]
    _rotate(s, b, scale(of_angle, off))


@kernel
def _rotate(s: Record, rotation: Array, turn: Vector) -> None:
    s.turn[0], s.turn[1], s.turn[2] = turn
    rotate_by_vector(rotation, s.turn)


@shared_kernel
def follow_level_target(p: Record, s: Record, rig: Record, safety: Record, base: Record, reference: Record) -> None:
    """After the reference of the target in the level frame: replace it by that of the legs in {1}.

    Until the drives follow, and in a stop, the reference stays as it is.
    """
    planned, motion = reference.motion, s.motion
    following = safety.mode == Mode.RUNNING and safety.request == Request.ENABLED and s.begun != 0
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
    if t > 0.0 and _find_target(s, rig, base, planned):
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
def _find_target(s: Record, rig: Record, base: Record, legs: Array) -> bool:
    """Replace the motion (6, 3) of the legs at a target in the level frame by that at the same target seen in {1}; returns
    whether there is one.
    """
    geometry, b = rig.geometry, s.attitude
    for k in range(LEGS):
        s.wanted[k] = legs[k, 0]
    if not find_pose(geometry, s.wanted, s.position, s.rotation, s.arms, s.directions, s.lengths, s.jacobian) < 1e-9:
        return False
    legs_at(geometry.base_joints, geometry.platform_joints, s.position, s.rotation, s.arms, s.directions, s.lengths)
    if not motion_of_legs(s.arms, s.directions, s.lengths, rig.legs, legs, s.jacobian, s.twist):
        return False
    w, angular_acceleration = subtract(vector(base.fitted[0]), vector(s.bias)), vector(base.fitted[1])
    place = rotate_back(b, vector(s.position))
    turning = subtract(rotate_back(b, vector(s.twist[0, 3:])), w)
    speed = subtract(rotate_back(b, vector(s.twist[0])), cross(w, place))
    carried = add(cross(angular_acceleration, place), cross(w, add(cross(w, place), scale(2.0, speed))))
    acceleration = subtract(rotate_back(b, vector(s.twist[1])), carried)
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
