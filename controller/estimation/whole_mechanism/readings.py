"""What ideal IMUs read when the platform moves: the measurement of the whole-mechanism filter and of the calibration.

The platform's pose, twist and acceleration fix every leg. With the leg vector `s = p + R A - B`, seen in the joint frame, the
joint's angles are `a = atan2(-s_y, s_z)` and `b = atan2(s_x, hypot(s_y, s_z))`; with their gradient J and its time derivatives,

    q' = J s',  q'' = J' s' + J s'',     dq = J ds,  dq' = J' ds + J ds',  dq'' = J'' ds + 2 J' ds' + J ds''

and the leg's IMU reads what `leg_filter.predict_measurement` says. Errors of the motion are (18): of position, rotation (about
axes of {1}), velocity, angular velocity, acceleration and angular acceleration.
"""

import numpy as np

from controller.estimation.leg_filter import predict_measurement
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS
from plant.pose import Array

MOTION_STATES = 18
READINGS = 6
"""Of one IMU: rate [rad/s], then specific force [m/s^2]."""

VELOCITY, RATE, ACCELERATION, ANGULAR_ACCELERATION = range(4)
"""Rows of a motion (4, 3), seen in {1}: velocity of the origin of {2}, angular velocity, and their derivatives."""

READINGS_SCRATCH = record_dtype(
    arm=(np.float64, 3),
    turning=(np.float64, 3),
    vector=(np.float64, (3, 3)),
    gradient=(np.float64, (3, 2, 3)),
    gradient_in_base=(np.float64, (3, 2, 3)),
    angles=(np.float64, 9),
    angle_jacobian=(np.float64, (READINGS, 9)),
)


@kernel
def cross(x0: float, x1: float, x2: float, y0: float, y1: float, y2: float) -> tuple[float, float, float]:
    """The product x x y of two vectors."""
    return x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0


@kernel
def _joint_angles(vector: Array, x: Array, gradient: Array) -> None:
    """Angles, rates and accelerations (6,) of a universal joint from the leg vector and its two derivatives (3, 3) in the joint
    frame, and the angles' gradient with its two derivatives (3, 2, 3).
    """
    x0, y0, z0 = vector[0, 0], vector[0, 1], vector[0, 2]
    x1, y1, z1 = vector[1, 0], vector[1, 1], vector[1, 2]
    x2, y2, z2 = vector[2, 0], vector[2, 1], vector[2, 2]
    # Each quantity with its first and second derivative: h = hypot(y, z), l = |s|^2.
    h_h, h_h1, h_h2 = y0 * y0 + z0 * z0, 2.0 * (y0 * y1 + z0 * z1), 2.0 * (y1 * y1 + y0 * y2 + z1 * z1 + z0 * z2)
    h = np.sqrt(h_h)
    h1 = h_h1 / (2.0 * h)
    h2 = (h_h2 - 2.0 * h1 * h1) / (2.0 * h)
    l0, l1, l2 = h_h + x0 * x0, h_h1 + 2.0 * x0 * x1, h_h2 + 2.0 * (x1 * x1 + x0 * x2)
    u, u1, u2 = _inverse(h_h, h_h1, h_h2)
    v, v1, v2 = _inverse(l0, l1, l2)
    w, w1, w2 = _product(h, h1, h2, l0, l1, l2)
    w, w1, w2 = _inverse(w, w1, w2)
    c, c1, c2 = _product(-x0, -x1, -x2, w, w1, w2)
    # Gradient of a is (0, -z, y) / h^2, of b (h^2, -x y, -x z) / (h l).
    ay, ay1, ay2 = _product(-z0, -z1, -z2, u, u1, u2)
    az, az1, az2 = _product(y0, y1, y2, u, u1, u2)
    bx, bx1, bx2 = _product(h, h1, h2, v, v1, v2)
    by, by1, by2 = _product(c, c1, c2, y0, y1, y2)
    bz, bz1, bz2 = _product(c, c1, c2, z0, z1, z2)
    gradient[0, 0, 1], gradient[0, 0, 2] = ay, az
    gradient[1, 0, 1], gradient[1, 0, 2] = ay1, az1
    gradient[2, 0, 1], gradient[2, 0, 2] = ay2, az2
    gradient[0, 1, 0], gradient[0, 1, 1], gradient[0, 1, 2] = bx, by, bz
    gradient[1, 1, 0], gradient[1, 1, 1], gradient[1, 1, 2] = bx1, by1, bz1
    gradient[2, 1, 0], gradient[2, 1, 1], gradient[2, 1, 2] = bx2, by2, bz2
    x[0], x[1] = np.arctan2(-y0, z0), np.arctan2(x0, h)
    x[2], x[3] = ay * y1 + az * z1, bx * x1 + by * y1 + bz * z1
    x[4] = ay1 * y1 + az1 * z1 + ay * y2 + az * z2
    x[5] = bx1 * x1 + by1 * y1 + bz1 * z1 + bx * x2 + by * y2 + bz * z2


@kernel
def _product(x: float, x1: float, x2: float, y: float, y1: float, y2: float) -> tuple[float, float, float]:
    """A product with its two derivatives."""
    return x * y, x1 * y + x * y1, x2 * y + 2.0 * x1 * y1 + x * y2


@kernel
def _inverse(x: float, x1: float, x2: float) -> tuple[float, float, float]:
    """1 / x with its two derivatives."""
    y = 1.0 / x
    y1 = -x1 * y * y
    return y, y1, -x2 * y * y - 2.0 * x1 * y * y1


@kernel
def predict_leg_readings(
    joint_rotation: Array, base_joint: Array, platform_joint: Array, up_in_joint: Array, imu_position: Array, gravity: float,
    position: Array, rotation: Array, motion: Array, derive: bool, readings: Array, jacobian: Array, scratch: Record,
) -> None:  # fmt: skip
    """Write what a leg's IMU reads (6,), and if wanted the derivative by the errors of the motion (6, 18)."""
    t = scratch
    arm, turning, vector = t.arm, t.turning, t.vector
    w0, w1, w2 = motion[RATE, 0], motion[RATE, 1], motion[RATE, 2]
    e0, e1, e2 = motion[ANGULAR_ACCELERATION, 0], motion[ANGULAR_ACCELERATION, 1], motion[ANGULAR_ACCELERATION, 2]
    for i in range(3):
        arm[i] = 0.0
        for j in range(3):
            arm[i] += rotation[i, j] * platform_joint[j]
    r0, r1, r2 = arm[0], arm[1], arm[2]
    t0, t1, t2 = cross(w0, w1, w2, r0, r1, r2)
    turning[0], turning[1], turning[2] = t0, t1, t2
    c0, c1, c2 = cross(w0, w1, w2, t0, t1, t2)
    f0, f1, f2 = cross(e0, e1, e2, r0, r1, r2)
    s0, s1, s2 = position[0] + r0 - base_joint[0], position[1] + r1 - base_joint[1], position[2] + r2 - base_joint[2]
    v0, v1, v2 = motion[VELOCITY, 0] + t0, motion[VELOCITY, 1] + t1, motion[VELOCITY, 2] + t2
    a0 = motion[ACCELERATION, 0] + f0 + c0
    a1 = motion[ACCELERATION, 1] + f1 + c1
    a2 = motion[ACCELERATION, 2] + f2 + c2
    q = joint_rotation
    for k in range(3):
        vector[0, k] = q[0, k] * s0 + q[1, k] * s1 + q[2, k] * s2
        vector[1, k] = q[0, k] * v0 + q[1, k] * v1 + q[2, k] * v2
        vector[2, k] = q[0, k] * a0 + q[1, k] * a1 + q[2, k] * a2
    _joint_angles(vector, t.angles, t.gradient)
    predict_measurement(t.angles, up_in_joint, imu_position, gravity, readings, t.angle_jacobian)
    if not derive:
        return
    for n in range(3):
        for m in range(2):
            for i in range(3):
                g = t.gradient[n, m]
                t.gradient_in_base[n, m, i] = q[i, 0] * g[0] + q[i, 1] * g[1] + q[i, 2] * g[2]
    g, g1, g2 = t.gradient_in_base[0], t.gradient_in_base[1], t.gradient_in_base[2]
    for m in range(READINGS):
        h = t.angle_jacobian[m]
        # Derivatives by s, s' and s'', and from there by the motion.
        by_s0 = h[0] * g[0, 0] + h[1] * g[1, 0] + h[2] * g1[0, 0] + h[3] * g1[1, 0] + h[4] * g2[0, 0] + h[5] * g2[1, 0]
        by_s1 = h[0] * g[0, 1] + h[1] * g[1, 1] + h[2] * g1[0, 1] + h[3] * g1[1, 1] + h[4] * g2[0, 1] + h[5] * g2[1, 1]
        by_s2 = h[0] * g[0, 2] + h[1] * g[1, 2] + h[2] * g1[0, 2] + h[3] * g1[1, 2] + h[4] * g2[0, 2] + h[5] * g2[1, 2]
        by_v0 = h[2] * g[0, 0] + h[3] * g[1, 0] + 2.0 * (h[4] * g1[0, 0] + h[5] * g1[1, 0])
        by_v1 = h[2] * g[0, 1] + h[3] * g[1, 1] + 2.0 * (h[4] * g1[0, 1] + h[5] * g1[1, 1])
        by_v2 = h[2] * g[0, 2] + h[3] * g[1, 2] + 2.0 * (h[4] * g1[0, 2] + h[5] * g1[1, 2])
        by_a0, by_a1, by_a2 = (
            h[4] * g[0, 0] + h[5] * g[1, 0],
            h[4] * g[0, 1] + h[5] * g[1, 1],
            h[4] * g[0, 2] + h[5] * g[1, 2],
        )
        row = jacobian[m]
        row[0], row[1], row[2] = by_s0, by_s1, by_s2
        row[6], row[7], row[8] = by_v0, by_v1, by_v2
        row[12], row[13], row[14] = by_a0, by_a1, by_a2
        # s' = v + w x r and s'' = a + e x r + w x (w x r), with r turned by the rotation's error.
        x0, x1, x2 = cross(by_a0, by_a1, by_a2, w0, w1, w2)
        y0, y1, y2 = cross(x0, x1, x2, w0, w1, w2)
        z0, z1, z2 = cross(by_a0, by_a1, by_a2, e0, e1, e2)
        u0, u1, u2 = cross(by_v0, by_v1, by_v2, w0, w1, w2)
        row[3], row[4], row[5] = cross(r0, r1, r2, by_s0 + u0 + y0 + z0, by_s1 + u1 + y1 + z1, by_s2 + u2 + y2 + z2)
        n0, n1, n2 = cross(r0, r1, r2, by_v0 + x0, by_v1 + x1, by_v2 + x2)
        o0, o1, o2 = cross(t0, t1, t2, by_a0, by_a1, by_a2)
        row[9], row[10], row[11] = n0 + o0, n1 + o1, n2 + o2
        row[15], row[16], row[17] = cross(r0, r1, r2, by_a0, by_a1, by_a2)


@kernel
def predict_platform_readings(
    imu_position: Array, up_in_base: Array, gravity: float, rotation: Array, motion: Array, derive: bool, readings: Array,
    jacobian: Array,
) -> None:  # fmt: skip
    """Write what the platform's IMU reads (6,), and if wanted the derivative by the errors of the motion (6, 18)."""
    d0, d1, d2 = imu_position[0], imu_position[1], imu_position[2]
    r0 = rotation[0, 0] * d0 + rotation[0, 1] * d1 + rotation[0, 2] * d2
    r1 = rotation[1, 0] * d0 + rotation[1, 1] * d1 + rotation[1, 2] * d2
    r2 = rotation[2, 0] * d0 + rotation[2, 1] * d1 + rotation[2, 2] * d2
    w0, w1, w2 = motion[RATE, 0], motion[RATE, 1], motion[RATE, 2]
    e0, e1, e2 = motion[ANGULAR_ACCELERATION, 0], motion[ANGULAR_ACCELERATION, 1], motion[ANGULAR_ACCELERATION, 2]
    t0, t1, t2 = cross(w0, w1, w2, r0, r1, r2)
    c0, c1, c2 = cross(w0, w1, w2, t0, t1, t2)
    a0, a1, a2 = cross(e0, e1, e2, r0, r1, r2)
    f0 = motion[ACCELERATION, 0] + a0 + c0 + gravity * up_in_base[0]
    f1 = motion[ACCELERATION, 1] + a1 + c1 + gravity * up_in_base[1]
    f2 = motion[ACCELERATION, 2] + a2 + c2 + gravity * up_in_base[2]
    for m in range(3):
        g0, g1, g2 = rotation[0, m], rotation[1, m], rotation[2, m]
        readings[m] = g0 * w0 + g1 * w1 + g2 * w2
        readings[3 + m] = g0 * f0 + g1 * f1 + g2 * f2
        if not derive:
            continue
        rate, force = jacobian[m], jacobian[3 + m]
        rate[:] = 0.0
        force[:] = 0.0
        # An error of the rotation turns the axis g and the arm r.
        rate[3], rate[4], rate[5] = cross(g0, g1, g2, w0, w1, w2)
        rate[9], rate[10], rate[11] = g0, g1, g2
        x0, x1, x2 = cross(g0, g1, g2, w0, w1, w2)
        y0, y1, y2 = cross(x0, x1, x2, w0, w1, w2)
        z0, z1, z2 = cross(g0, g1, g2, e0, e1, e2)
        p0, p1, p2 = cross(g0, g1, g2, f0, f1, f2)
        n0, n1, n2 = cross(r0, r1, r2, y0 + z0, y1 + z1, y2 + z2)
        force[3], force[4], force[5] = p0 + n0, p1 + n1, p2 + n2
        n0, n1, n2 = cross(r0, r1, r2, x0, x1, x2)
        o0, o1, o2 = cross(t0, t1, t2, g0, g1, g2)
        force[9], force[10], force[11] = n0 + o0, n1 + o1, n2 + o2
        force[12], force[13], force[14] = g0, g1, g2
        force[15], force[16], force[17] = cross(r0, r1, r2, g0, g1, g2)


@kernel
def predict_readings(
    geometry: Record, position: Array, rotation: Array, motion: Array, derive: bool, readings: Array, jacobian: Array,
    scratch: Record,
) -> None:  # fmt: skip
    """Write what all IMUs read (7, 6), and if wanted the derivatives by the errors of the motion (7, 6, 18).

    Args:
        geometry: dtype `SENSOR_GEOMETRY`.
        position, rotation, motion: (3,), (3, 3), (4, 3), of {2}.
        scratch: dtype `READINGS_SCRATCH`.
    """
    g = geometry
    for k in range(LEGS):
        predict_leg_readings(
            g.joint_rotations[k], g.base_joints[k], g.platform_joints[k], g.up_in_joint[k], g.leg_imu_position[k], g.gravity,
            position, rotation, motion, derive, readings[k], jacobian[k], scratch,
        )  # fmt: skip
    predict_platform_readings(
        g.platform_imu_position, g.up_in_base[0], g.gravity, rotation, motion, derive, readings[PLATFORM_IMU],
        jacobian[PLATFORM_IMU],
    )  # fmt: skip


def readings_along(geometry: Record, positions: Array, rotations: Array, rate: float) -> Array:
    """What ideal IMUs read (N, 7, 6) along a motion, positions (N, 3) and rotations (N, 3, 3) at `rate` [Hz]."""
    turns = np.gradient(rotations, axis=0) @ np.swapaxes(rotations, 1, 2) * rate
    velocities, rates = np.gradient(positions, axis=0) * rate, turns[:, [2, 0, 1], [1, 2, 0]]
    motions = np.stack(
        [velocities, rates, np.gradient(velocities, axis=0) * rate, np.gradient(rates, axis=0) * rate], axis=1
    )  # fmt: skip
    readings, unused = np.empty((len(positions), IMU_COUNT, READINGS)), np.empty((IMU_COUNT, READINGS, MOTION_STATES))
    scratch: Record = np.zeros((), READINGS_SCRATCH)
    for position, rotation, motion, reading in zip(positions, rotations, motions, readings, strict=True):
        predict_readings(geometry[()], position, rotation, motion, False, reading, unused, scratch[()])
    return readings
