"""What ideal IMUs read when the platform moves: the measurement of the whole-mechanism filter and of the calibration.

The platform's pose, twist and acceleration fix every leg. With the leg vector `s = p + R A - B`, seen in the joint frame, the
joint's angles are `a = atan2(-s_y, s_z)` and `b = atan2(s_x, hypot(s_y, s_z))`; with their gradient J and its time derivatives,

    q' = J s',  q'' = J' s' + J s'',     dq = J ds,  dq' = J' ds + J ds',  dq'' = J'' ds + 2 J' ds' + J ds''

and the leg's IMU reads what `leg_filter.predict_measurement` says. Errors of the motion are (18): of position, rotation (about
axes of {1}), velocity, angular velocity, acceleration and angular acceleration. Errors of the rig are (38): of the places of
the joints and of the tilt of the base.
"""

import numpy as np

from controller.estimation.leg_filter import predict_measurement
from controller.estimation.whole_mechanism.imu_errors import distort
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

MOTION_STATES = 18
READINGS = 6
"""Of one IMU: rate [rad/s], then specific force [m/s^2]."""

VELOCITY, RATE, ACCELERATION, ANGULAR_ACCELERATION = range(4)
"""Rows of a motion (4, 3), seen in {1}: velocity of the origin of {2}, angular velocity, and their derivatives."""

JOINTS, TILT = 2 * LEGS * 3, 2
RIG_ERRORS = JOINTS + TILT
"""How many errors of the rig can be estimated: the places of the joints (2, 6, 3) [m] and the tilt (2) [rad]."""

READINGS_SCRATCH = record_dtype(
    gradient=(np.float64, (3, 2, 3)),
    gradient_in_base=(np.float64, (3, 2, 3)),
    angles=(np.float64, 9),
    angle_jacobian=(np.float64, (READINGS, 9)),
)


@kernel
def _joint_angles(x: Vector, y: Vector, z: Vector, angles: Array, gradient: Array) -> None:
    """Angles, rates and accelerations (6,) of a universal joint from the leg vector's components in the joint frame, each with
    its two derivatives, and the angles' gradient with its two derivatives (3, 2, 3).
    """
    # Each quantity with its first and second derivative: h = hypot(y, z), ss = |s|^2.
    hh = (
        y[0] * y[0] + z[0] * z[0],
        2.0 * (y[0] * y[1] + z[0] * z[1]),
        2.0 * (y[1] * y[1] + y[0] * y[2] + z[1] * z[1] + z[0] * z[2]),
    )
    root = np.sqrt(hh[0])
    root1 = hh[1] / (2.0 * root)
    h = root, root1, (hh[2] - 2.0 * root1 * root1) / (2.0 * root)
    ss = hh[0] + x[0] * x[0], hh[1] + 2.0 * x[0] * x[1], hh[2] + 2.0 * (x[1] * x[1] + x[0] * x[2])
    u, c = _inverse(hh), _product(scale(-1.0, x), _inverse(_product(h, ss)))
    # Gradient of a is (0, -z, y) / h^2, of b (h^2, -x y, -x z) / (h ss).
    ay, az = _product(scale(-1.0, z), u), _product(y, u)
    bx, by, bz = _product(h, _inverse(ss)), _product(c, y), _product(c, z)
    for n in range(3):
        gradient[n, 0, 1], gradient[n, 0, 2] = ay[n], az[n]
        gradient[n, 1, 0], gradient[n, 1, 1], gradient[n, 1, 2] = bx[n], by[n], bz[n]
    angles[0], angles[1] = np.arctan2(-y[0], z[0]), np.arctan2(x[0], h[0])
    angles[2], angles[3] = ay[0] * y[1] + az[0] * z[1], bx[0] * x[1] + by[0] * y[1] + bz[0] * z[1]
    angles[4] = ay[1] * y[1] + az[1] * z[1] + ay[0] * y[2] + az[0] * z[2]
    angles[5] = bx[1] * x[1] + by[1] * y[1] + bz[1] * z[1] + bx[0] * x[2] + by[0] * y[2] + bz[0] * z[2]


@kernel
def _product(x: Vector, y: Vector) -> Vector:
    """A product with its two derivatives."""
    return x[0] * y[0], x[1] * y[0] + x[0] * y[1], x[2] * y[0] + 2.0 * x[1] * y[1] + x[0] * y[2]


@kernel
def _inverse(x: Vector) -> Vector:
    """1 / x with its two derivatives."""
    y = 1.0 / x[0]
    y1 = -x[1] * y * y
    return y, y1, -x[2] * y * y - 2.0 * x[1] * y * y1


@kernel
def _predict_leg(
    geometry: Record, k: int, position: Array, rotation: Array, motion: Array, derive: bool, readings: Array, jacobian: Array,
    scratch: Record,
) -> None:  # fmt: skip
    """Write what the IMU of leg `k` reads (6,), and if wanted the derivative by the errors of the motion (6, 18)."""
    t, frame = scratch, geometry.joint_rotations[k]
    w, alpha = vector(motion[RATE]), vector(motion[ANGULAR_ACCELERATION])
    arm = rotate(rotation, vector(geometry.platform_joints[k]))
    turning = cross(w, arm)
    s = rotate_back(frame, subtract(add(vector(position), arm), vector(geometry.base_joints[k])))
    v = rotate_back(frame, add(vector(motion[VELOCITY]), turning))
    a = rotate_back(frame, add(add(vector(motion[ACCELERATION]), cross(alpha, arm)), cross(w, turning)))
    _joint_angles((s[0], v[0], a[0]), (s[1], v[1], a[1]), (s[2], v[2], a[2]), t.angles, t.gradient)
    up, place = geometry.up_in_joint[k], geometry.leg_imu_position[k]
    predict_measurement(t.angles, up, place, geometry.gravity, readings, t.angle_jacobian)
    if not derive:
        return
    for n in range(3):
        for m in range(2):
            in_base = rotate(frame, vector(t.gradient[n, m]))
            for i in range(3):
                t.gradient_in_base[n, m, i] = in_base[i]
    g, g1, g2 = t.gradient_in_base[0], t.gradient_in_base[1], t.gradient_in_base[2]
    for m in range(READINGS):
        h, row = t.angle_jacobian[m], jacobian[m]
        # Derivatives by s, s' and s'', and from there by the motion.
        for i in range(3):
            row[i] = h[0] * g[0, i] + h[1] * g[1, i] + h[2] * g1[0, i] + h[3] * g1[1, i] + h[4] * g2[0, i] + h[5] * g2[1, i]
            row[6 + i] = h[2] * g[0, i] + h[3] * g[1, i] + 2.0 * (h[4] * g1[0, i] + h[5] * g1[1, i])
            row[12 + i] = h[4] * g[0, i] + h[5] * g[1, i]
        by_s, by_v, by_a = vector(row), vector(row[6:]), vector(row[12:])
        # s' = v + w x r and s'' = a + alpha x r + w x (w x r), with r turned by the rotation's error.
        x = cross(by_a, w)
        by_turned = add(add(add(by_s, cross(by_v, w)), cross(x, w)), cross(by_a, alpha))
        by_rate = add(cross(arm, add(by_v, x)), cross(turning, by_a))
        row[3], row[4], row[5] = cross(arm, by_turned)
        row[9], row[10], row[11] = by_rate
        row[15], row[16], row[17] = cross(arm, by_a)


@kernel
def _predict_platform(geometry: Record, rotation: Array, motion: Array, derive: bool, readings: Array, jacobian: Array) -> None:
    """Write what the platform's IMU reads (6,), and if wanted the derivative by the errors of the motion (6, 18)."""
    w, alpha = vector(motion[RATE]), vector(motion[ANGULAR_ACCELERATION])
    arm = rotate(rotation, vector(geometry.platform_imu_position))
    turning = cross(w, arm)
    f = add(add(vector(motion[ACCELERATION]), cross(alpha, arm)), cross(w, turning))
    f = add(f, scale(geometry.gravity, vector(geometry.up_in_base[0])))
    for m in range(3):
        g = rotation[0, m], rotation[1, m], rotation[2, m]
        readings[m], readings[3 + m] = dot(g, w), dot(g, f)
        if not derive:
            continue
        rate, force = jacobian[m], jacobian[3 + m]
        rate[:] = 0.0
        force[:] = 0.0
        # An error of the rotation turns the axis g and the arm.
        x = cross(g, w)
        rate[3], rate[4], rate[5] = x
        rate[9], rate[10], rate[11] = g
        force[3], force[4], force[5] = add(cross(g, f), cross(arm, add(cross(x, w), cross(g, alpha))))
        force[9], force[10], force[11] = add(cross(arm, x), cross(turning, g))
        force[12], force[13], force[14] = g
        force[15], force[16], force[17] = cross(arm, g)


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
    for k in range(LEGS):
        _predict_leg(geometry, k, position, rotation, motion, derive, readings[k], jacobian[k], scratch)
    _predict_platform(geometry, rotation, motion, derive, readings[PLATFORM_IMU], jacobian[PLATFORM_IMU])


@kernel
def rig_state(k: int, j: int) -> int:
    """The place among the rig's errors of the one, 0 to 7, on which IMU `k` depends."""
    return 3 * k + j if j < 3 else 3 * (LEGS + k - 1) + j if j < 6 else JOINTS + j - 6


@kernel
def find_rig_jacobian(
    geometry: Record, position: Array, rotation: Array, motion: Array, errors: Array, jacobian: Array, rig_jacobian: Array
) -> None:
    """Write the derivatives (7, 6, 8) of the readings by base joint, platform joint and tilt.

    They follow from the derivatives by the motion (7, 6, 18) and the IMUs' errors (7, 21).

    A leg vector p + R A - B answers to a move of B like to the opposite one of p; and to one of A like to one of p by R A, of
    the velocity by omega x R A, and of the acceleration by alpha x R A + omega x (omega x R A). The tilt turns the vertical.
    """
    w, alpha = vector(motion[RATE]), vector(motion[ANGULAR_ACCELERATION])
    for k in range(LEGS):
        for m in range(READINGS):
            h, by_rig = jacobian[k, m], rig_jacobian[k, m]
            for i in range(3):
                r = rotation[0, i], rotation[1, i], rotation[2, i]
                v = cross(w, r)
                a = add(cross(alpha, r), cross(w, v))
                by_rig[i] = -h[i]
                by_rig[3 + i] = h[0] * r[0] + h[1] * r[1] + h[2] * r[2] + h[6] * v[0] + h[7] * v[1] + h[8] * v[2]
                by_rig[3 + i] += dot(vector(h[12:]), a)
    up = geometry.up_in_base[0]
    # e x up for the axes e = x, y.
    for j, turned in enumerate(((0.0, -up[2], up[1]), (up[2], 0.0, -up[0]))):
        for k in range(IMU_COUNT):
            in_frame = rotate_back(rotation, turned)
            if k < LEGS:
                x, y, z = leg_axes(geometry, k, position, rotation)
                in_frame = dot(x, turned), dot(y, turned), dot(z, turned)
            read = distort(errors[k], 1, scale(geometry.gravity, in_frame))
            for i in range(3):
                rig_jacobian[k, i, 6 + j] = 0.0
                rig_jacobian[k, 3 + i, 6 + j] = read[i]


@kernel
def leg_axes(geometry: Record, k: int, position: Array, rotation: Array) -> tuple[Vector, Vector, Vector]:
    """The axes of the frame of leg `k` in {1}: z along the leg, y across the joint's first axis, too."""
    joint, frame = geometry.platform_joints[k], geometry.joint_rotations[k]
    z = subtract(vector(position), vector(geometry.base_joints[k]))
    for j in range(3):
        z = add(z, scale(joint[j], (rotation[0, j], rotation[1, j], rotation[2, j])))
    y = cross(z, (frame[0, 0], frame[1, 0], frame[2, 0]))
    return _unit(cross(y, z)), _unit(y), _unit(z)


@kernel
def find_frames(geometry: Record, position: Array, rotation: Array, frames: Array) -> None:
    """Write the axes of all IMUs in {1} (7, 3, 3), an axis a row, at a pose."""
    for k in range(PLATFORM_IMU):
        for i, axis in enumerate(leg_axes(geometry, k, position, rotation)):
            frames[k, i, 0], frames[k, i, 1], frames[k, i, 2] = axis
    for i in range(3):
        for j in range(3):
            frames[PLATFORM_IMU, i, j] = rotation[j, i]


@kernel
def _unit(x: Vector) -> Vector:
    size = np.sqrt(dot(x, x))
    return x[0] / size, x[1] / size, x[2] / size


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
