"""From leg directions and the platform's vertical to the pose: a closed form without a first guess, then its refinement.

The twist follows from the refinement's normal equations. Of the acceleration, the reference has what is planned, without delay;
what the twist's derivative has beyond that is low-passed.
"""

import numpy as np

from controller.direct_kinematics.geometry import SCRATCH
from controller.direct_kinematics.legs_alone import pose_from_legs
from controller.direct_kinematics.legs_and_attitude import pose_from_rotation, pose_from_vector, rotation_from_vectors
from controller.direct_kinematics.planar import pose_from_roll
from controller.direct_kinematics.refinement import (
    find_doubts,
    find_misfits,
    find_twist,
    move_pose,
    normal_equations,
    solve_normal_equations,
    stay_in_plane,
)
from controller.inverse_kinematics import motion_of_legs
from controller.rig import elapsed
from controller.settings import FusionSettings
from plant.compiled import Record, filled, kernel, record_dtype, shared_kernel
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import rotate, vector

WORST_CONDITIONING = 1e-2
"""Least conditioning of a closed form that is relied upon where there is another one, or none."""

PARAMETERS = record_dtype(
    section_5=np.int64,  # whether the pose is that of the paper's section 5, unrefined
    doubting=np.int64,  # whether what disagrees with the pose has less weight in the next cycle
    acceleration_rate=np.float64,  # corner of the acceleration's low-pass [1/s]
)
"""Constants of the estimator."""

STATE = record_dtype(
    position=(np.float64, 3),  # [m]
    rotation=(np.float64, (3, 3)),
    twist=(np.float64, 6),  # velocity and angular velocity in {1} [m/s, rad/s]
    smooth_twist=(np.float64, 6),  # the twist, low-passed
    unplanned=(np.float64, 6),  # how its derivative differs from what is planned, low-passed [m/s^2, rad/s^2]
    acceleration=(np.float64, 6),  # what is planned, and what is not
    conditioning=np.float64,  # of the closed form
    found=np.int64,  # whether the measurements determine the pose
    information=(np.float64, (6, 6)),  # inverse of the refined pose's covariance, lower triangle
    factor=(np.float64, (6, 6)),  # Cholesky factor of the information
    misfit=np.float64,  # of the measurements about the refined pose, 1 on average if their covariances are right
    rest_misfit=np.float64,  # the same without the worst of the measurements; 0 with few measurements
    bent=(np.float64, 2),  # by how much an encoder could move it unseen, position [m] and rotation [rad]
    apart=(np.float64, 2),  # distance of the closed form and the filter that is trusted [m, rad]; 0 unless there are both
    arms=(np.float64, (LEGS, 3)),  # the turned platform joints at the pose [m]
    directions=(np.float64, (LEGS, 3)),  # of the legs at the pose, unit
    lengths=(np.float64, LEGS),  # of the legs at the pose [m]
    vectors=(np.float64, (2, 3)),  # the measured vertical and horizontal field in {2}
    vector_weights=(np.float64, 2),
    misfits=(np.float64, LEGS + 2),  # of each leg's direction and each vector
    doubts=(np.float64, LEGS + 2),  # by which their weights were reduced
    weights=(np.float64, LEGS + 2),  # the reduced ones
    planned=(np.float64, (2, 6)),  # twist and acceleration of the reference
    angular_velocity=(np.float64, 3),  # from here on scratch
    correction=(np.float64, 6),
    jacobian=(np.float64, (6, 6)),
    scratch=SCRATCH,
)
"""The estimated pose."""


def pose_parameters(fusion: FusionSettings, section_5: bool) -> Record:
    """The constants of the estimator (dtype `PARAMETERS`)."""
    return filled(PARAMETERS, section_5=section_5, doubting=1, acceleration_rate=1.0 / fusion.acceleration_time)


@kernel
def take_vectors(s: Record, platform: Record, heading: Record) -> None:
    """Take the vertical and the heading from their filters."""
    for i in range(3):
        s.vectors[0, i] = platform.vertical[i]
        s.vectors[1, i] = heading.north[i]
    s.vector_weights[0], s.vector_weights[1] = platform.weight, heading.weight


@shared_kernel
def find_pose(
    p: Record, s: Record, rig: Record, directions: Array, leg_used: Array, platform_used: int, heading_used: int
) -> float:
    """The pose in closed form from the leg directions, and from the vertical if the platform has an IMU.

    The platform's whole orientation, if there is a heading, serves where those do not suffice; it is all that the paper's
    section 5 takes from the platform. A planar mechanism's pose takes the platform's vertical for its roll (section 6).

    Args:
        directions, leg_used: (6, 3) and (6,), the measured directions and which of them are used.
        platform_used, heading_used: whether the vertical and the heading are used.

    Returns:
        The conditioning.
    """
    s.conditioning = 0.0
    if rig.planar != 0:
        if platform_used != 0:
            s.conditioning = pose_from_roll(
                rig.geometry, directions, leg_used, rig.vectors_in_base[0], s.vectors[0], s.position, s.rotation
            )
        return float(s.conditioning)
    if platform_used == 0:
        s.conditioning = pose_from_legs(rig.geometry, directions, leg_used, s.position, s.rotation, s.scratch)
        return float(s.conditioning)
    if p.section_5 == 0:
        s.conditioning = pose_from_vector(
            rig.geometry, directions, leg_used, rig.vectors_in_base[0], s.vectors[0], s.position, s.rotation, s.scratch
        )
    if heading_used != 0 and s.conditioning < WORST_CONDITIONING:
        s.conditioning = 0.0
        if rotation_from_vectors(rig.vectors_in_base, s.vectors, s.rotation):
            s.conditioning = pose_from_rotation(rig.geometry, directions, leg_used, s.rotation, s.position, s.scratch)
    return float(s.conditioning)


@kernel
def refine_pose(p: Record, s: Record, rig: Record, time: Record, legs: Record, platform_rate: Array) -> bool:
    """Two Gauss-Newton steps for the pose; the twist comes with them, and what of its derivative is not planned.

    What disagreed with the pose of the last cycle has less weight.

    The paper's section 5 does not move the pose and has no covariance. `platform_rate` (3,) is the angular velocity in {2}
    [rad/s]. False if the normal equations have no solution.
    """
    weights, vector_weights = s.weights[:LEGS], s.weights[LEGS:]
    for k in range(LEGS + 2):
        weight = legs.weights[k] if k < LEGS else s.vector_weights[k - LEGS]
        s.weights[k] = weight / (1.0 + s.doubts[k])
    for _ in range(2):
        normal_equations(
            rig.geometry.base_joints, rig.geometry.platform_joints, legs.directions, weights, rig.vectors_in_base,
            s.vectors, vector_weights, s.position, s.rotation, s.arms, s.directions, s.lengths, s.information, s.correction,
        )  # fmt: skip
        if rig.planar != 0:
            stay_in_plane(s.information, s.correction)
        if not solve_normal_equations(s.information, s.correction, s.factor):
            return False
        if p.section_5 != 0:
            s.information[:] = 0.0
            break
        move_pose(s.correction, s.position, s.rotation)
    s.misfit = find_misfits(
        legs.directions, legs.weights, s.directions, rig.vectors_in_base, s.vectors, s.vector_weights, s.rotation, s.misfits
    )  # fmt: skip
    if p.doubting != 0:
        s.rest_misfit = find_doubts(s.misfits, s.doubts)
    s.angular_velocity[0], s.angular_velocity[1], s.angular_velocity[2] = rotate(s.rotation, vector(platform_rate))
    find_twist(
        legs.rates, weights, s.vectors, vector_weights, s.angular_velocity, s.rotation, s.arms, s.directions, s.lengths,
        s.factor, s.twist,
    )  # fmt: skip
    follow_twist(p, s, rig, time)
    return True


@kernel
def follow_twist(p: Record, s: Record, rig: Record, time: Record) -> None:
    """Low-pass the twist of this cycle, carried on as planned; what is left of its derivative is not planned."""
    if time.cycle == 0:
        s.smooth_twist[:] = s.twist
    # A period that is longer than the time constant takes the whole change of the twist.
    period = elapsed(rig, time)
    share, rate = min(1.0, period * p.acceleration_rate), min(p.acceleration_rate, 1.0 / period)
    for i in range(6):
        s.smooth_twist[i] += period * s.planned[1, i]
        s.unplanned[i] = (s.twist[i] - s.smooth_twist[i]) * rate
        s.smooth_twist[i] += share * (s.twist[i] - s.smooth_twist[i])


@kernel
def follow_plan(s: Record, rig: Record, legs: Array) -> None:
    """Find the acceleration from that of the reference, `legs` (6, 3): length, rate and acceleration of each leg."""
    motion_of_legs(s.arms, s.directions, s.lengths, rig.legs, legs, s.jacobian, s.planned)
    for i in range(6):
        s.acceleration[i] = s.planned[1, i] + s.unplanned[i]
