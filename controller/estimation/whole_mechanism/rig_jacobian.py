"""How the readings depend on the rig: derivatives by the places of the joints and by the tilt of the base."""

import numpy as np

from controller.estimation.whole_mechanism.imu_errors import distort
from controller.estimation.whole_mechanism.readings import ANGULAR_ACCELERATION, RATE, READINGS, cross
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS
from plant.pose import Array

JOINTS, TILT = 2 * LEGS * 3, 2
RIG_ERRORS = JOINTS + TILT
"""How many errors of the rig can be estimated: the places of the joints (2, 6, 3) and the tilt (2)."""


@kernel
def rig_state(k: int, j: int) -> int:
    """The place among the rig's errors of the one, 0 to 7, on which IMU `k` depends."""
    return 3 * k + j if j < 3 else 3 * (LEGS + k - 1) + j if j < 6 else JOINTS + j - 6


@kernel
def find_rig_jacobian(geometry: Record, state: Record) -> None:
    """Write the derivatives (7, 6, 8) of the readings by base joint, platform joint and tilt.

    They follow from the derivatives by the motion (7, 6, 18).

    A leg vector p + R A - B answers to a move of B like to the opposite one of p; and to one of A like to one of p by R A, of
    the velocity by omega x R A, and of the acceleration by alpha x R A + omega x (omega x R A). The tilt turns the vertical.
    """
    g, f = geometry, state
    w, alpha = f.smooth_motion[RATE], f.smooth_motion[ANGULAR_ACCELERATION]
    for k in range(LEGS):
        for m in range(READINGS):
            h, by_rig = f.jacobian[k, m], f.rig_jacobian[k, m]
            for i in range(3):
                by_rig[i] = -h[i]
                r0, r1, r2 = f.rotation[0, i], f.rotation[1, i], f.rotation[2, i]
                v0, v1, v2 = cross(w[0], w[1], w[2], r0, r1, r2)
                a0, a1, a2 = cross(alpha[0], alpha[1], alpha[2], r0, r1, r2)
                c0, c1, c2 = cross(w[0], w[1], w[2], v0, v1, v2)
                by_rig[3 + i] = h[0] * r0 + h[1] * r1 + h[2] * r2 + h[6] * v0 + h[7] * v1 + h[8] * v2
                by_rig[3 + i] += h[12] * (a0 + c0) + h[13] * (a1 + c1) + h[14] * (a2 + c2)
    up = g.up_in_base[0]
    for j in range(TILT):
        # e x up for the axes e = x, y.
        u0, u1, u2 = (0.0, -up[2], up[1]) if j == 0 else (up[2], 0.0, -up[0])
        for k in range(IMU_COUNT):
            if k < LEGS:
                _find_leg_frame(g.joint_rotations[k], g.base_joints[k], g.platform_joints[k], f.position, f.rotation, f.frame)
            else:
                f.frame[:] = f.rotation
            for i in range(3):
                f.rig_jacobian[k, i, 6 + j] = 0.0
                f.turn[i] = g.gravity * (f.frame[0, i] * u0 + f.frame[1, i] * u1 + f.frame[2, i] * u2)
            turned = distort(f.errors[k], 1, f.turn[0], f.turn[1], f.turn[2])
            for i in range(3):
                f.rig_jacobian[k, 3 + i, 6 + j] = turned[i]


@kernel
def _find_leg_frame(
    joint_rotation: Array, base_joint: Array, platform_joint: Array, position: Array, rotation: Array, frame: Array
) -> None:
    """Write the axes of a leg's frame in {1} as columns (3, 3): z along the leg, y across the joint's first axis, too."""
    for i in range(3):
        frame[i, 2] = position[i] - base_joint[i]
        for j in range(3):
            frame[i, 2] += rotation[i, j] * platform_joint[j]
    z0, z1, z2 = frame[0, 2], frame[1, 2], frame[2, 2]
    y0, y1, y2 = cross(z0, z1, z2, joint_rotation[0, 0], joint_rotation[1, 0], joint_rotation[2, 0])
    x0, x1, x2 = cross(y0, y1, y2, z0, z1, z2)
    frame[0, 0], frame[1, 0], frame[2, 0] = x0, x1, x2
    frame[0, 1], frame[1, 1], frame[2, 1] = y0, y1, y2
    for j in range(3):
        size = np.sqrt(frame[0, j] ** 2 + frame[1, j] ** 2 + frame[2, j] ** 2)
        for i in range(3):
            frame[i, j] /= size
