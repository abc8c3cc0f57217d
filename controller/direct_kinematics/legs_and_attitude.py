"""Closed forms from legs and what is known of the platform's attitude: its whole rotation, or one vector.

- The rotation known (the paper's section 5): linear in p, the point where the lines through `b - R a` along the legs meet.
- One vector known in both frames, `R v_platform = v_base` (`docs/direct_kinematics.md`): the vertical as the platform's
  accelerometer sees it, or the platform's normal of the paper's section 4. With any R_0 that carries one to the other,
  `R = Rot(v_base, yaw) R_0`, so the problem is linear in (p, cos yaw, sin yaw), for every class of mechanism. Legs from one
  base joint leave the scale open, and `cos^2 + sin^2 = 1` settles it.

Every function returns the conditioning: the ratio of the least to the greatest pivot of the system that was solved. Rotations
count in the joints' spread, so that it depends neither on size nor on frames. 0 means that nothing was solved.
"""

import numpy as np

from controller.direct_kinematics.geometry import across, across_leg, set_number
from controller.least_squares import (
    RANK_TOLERANCE,
    WELL_CONDITIONED,
    solve_five,
    solve_least_squares,
    solve_truncated,
)
from plant.compiled import Record, kernel, shared_kernel
from plant.mechanism import LEGS
from plant.mechanism.checks import SAME_JOINT_M
from plant.pose import Array
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector


@kernel
def meeting_point(origins: Array, directions: Array, selected: Array, point: Array, scratch: Record) -> float:
    """The point (3,) nearest to the selected ones of six lines (the paper's (8) and (25)-(28)).

    By normal equations where they are exact enough, else by QR.
    """
    conditioning = _meeting_point(origins, directions, selected, point)
    if conditioning >= WELL_CONDITIONED:
        return conditioning
    matrix, right = scratch.matrix, scratch.right
    rows = 0
    for k in range(LEGS):
        if selected[k] == 0.0:
            continue
        origin = vector(origins[k])
        for w in across(directions[k]):
            matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = w
            right[rows] = dot(w, origin)
            rows += 1
    if rows < 4:
        return 0.0
    return solve_least_squares(matrix, right, rows, point, scratch.norms, scratch.order)


@kernel
def _meeting_point(origins: Array, directions: Array, selected: Array, point: Array) -> float:
    """`meeting_point` by normal equations, of which a line along d counts P = I - d d^T; writes no point if it returns 0.

    The matrix is inverted by its cofactors. They are exact, because only one of its eigenvalues can be small: the others are
    at least half of the number of lines.
    """
    m00 = m10 = m11 = m20 = m21 = m22 = r0 = r1 = r2 = 0.0
    for k in range(LEGS):
        if selected[k] == 0.0:
            continue
        d0, d1, d2 = direction = vector(directions[k])
        m00, m11, m22 = m00 + (1.0 - d0 * d0), m11 + (1.0 - d1 * d1), m22 + (1.0 - d2 * d2)
        m10, m20, m21 = m10 - d1 * d0, m20 - d2 * d0, m21 - d2 * d1
        p0, p1, p2 = across_leg(direction, vector(origins[k]))
        r0, r1, r2 = r0 + p0, r1 + p1, r2 + p2
    c00, c11, c22 = m11 * m22 - m21 * m21, m00 * m22 - m20 * m20, m00 * m11 - m10 * m10
    c10, c20, c21 = m21 * m20 - m10 * m22, m10 * m21 - m11 * m20, m10 * m20 - m00 * m21
    determinant = m00 * c00 + m10 * c10 + m20 * c20
    # The first pivot of a QR is the greatest element of the diagonal, the product of two the greatest minor with it.
    if m00 >= m11 and m00 >= m22:
        first, two = m00, max(c11, c22)
    elif m11 >= m22:
        first, two = m11, max(c00, c22)
    else:
        first, two = m22, max(c00, c11)
    square = determinant / (first * two)
    if not square >= WELL_CONDITIONED**2:
        return 0.0
    inverse = 1.0 / determinant
    point[0] = inverse * (c00 * r0 + c10 * r1 + c20 * r2)
    point[1] = inverse * (c10 * r0 + c11 * r1 + c21 * r2)
    point[2] = inverse * (c20 * r0 + c21 * r1 + c22 * r2)
    return float(np.sqrt(square))


@shared_kernel
def pose_from_rotation(
    geometry: Record, directions: Array, measured: Array, rotation: Array, position: Array, scratch: Record
) -> float:
    """Position from the rotation and two or more legs (the paper's section 5)."""
    for k in range(LEGS):
        arm = rotate(rotation, vector(geometry.platform_joints[k]))
        for i in range(3):
            scratch.points[k, i] = geometry.base_joints[k, i] - arm[i]
    return meeting_point(scratch.points, directions, measured, position, scratch)


@kernel
def rotation_between(from_vector: Array, to_vector: Array, rotation: Array) -> None:
    """Write a rotation (3, 3) that carries one unit vector to another, opposite ones included."""
    f, t = vector(from_vector), vector(to_vector)
    # Opposite vectors have no shortest way: half a turn about an axis across the first brings them together.
    flip = dot(f, t) < 0.0
    if flip:
        f = scale(-1.0, f)
    v0, v1, v2 = cross(f, t)
    cosine = dot(f, t)
    k = 1.0 / (1.0 + cosine)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cosine + k * v0 * v0, k * v0 * v1 - v2, k * v0 * v2 + v1
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = k * v0 * v1 + v2, cosine + k * v1 * v1, k * v1 * v2 - v0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = k * v0 * v2 - v1, k * v1 * v2 + v0, cosine + k * v2 * v2
    if flip:
        axis, _ = across(from_vector)
        for i in range(3):
            along = dot(vector(rotation[i]), axis)
            for j in range(3):
                rotation[i, j] = 2.0 * along * axis[j] - rotation[i, j]


@kernel
def _turn(rotation: Array, axis: Vector, cosine: float, sine: float) -> bool:
    """Turn `rotation` about a unit axis seen in {1}, in place. Cosine and sine may have a common scale; False if both are 0."""
    size = np.sqrt(cosine * cosine + sine * sine)
    if not size > RANK_TOLERANCE:
        return False
    cosine, sine = cosine / size, sine / size
    for j in range(3):
        column = rotation[0, j], rotation[1, j], rotation[2, j]
        turned = cross(axis, column)
        along = (1.0 - cosine) * dot(axis, column)
        for i in range(3):
            rotation[i, j] = cosine * column[i] + sine * turned[i] + along * axis[i]
    return True


@kernel
def rotation_from_vectors(in_base: Array, in_platform: Array, rotation: Array) -> bool:
    """Write the rotation (3, 3) that carries the first of two unit vectors (2, 3) from {2} to {1} and brings the second as
    near as it can; False if the two leave it open.
    """
    up, second = vector(in_base[0]), vector(in_base[1])
    rotation_between(in_platform[0], in_base[0], rotation)
    turned = rotate(rotation, vector(in_platform[1]))
    cosine = dot(turned, second) - dot(up, turned) * dot(up, second)
    return bool(_turn(rotation, up, cosine, dot(up, cross(turned, second))))


@kernel
def pose_from_vector(
    geometry: Record, directions: Array, measured: Array, in_base: Array, in_platform: Array, position: Array,
    rotation: Array, scratch: Record,
) -> float:  # fmt: skip
    """Pose from one vector known in both frames, and three or more legs that end in two platform joints or more."""
    rotation_between(in_platform, in_base, rotation)
    unknowns, per_spread = scratch.unknowns[:5], 1.0 / geometry.spreads[set_number(measured)]
    if _count(measured) < 3:
        return 0.0
    to_scale = _from_one_base_joint(geometry.base_joints, measured)
    conditioning = 0.0
    if not to_scale:
        _write_normal_equations(geometry, directions, measured, in_base, rotation, scratch.matrix)
        conditioning = solve_five(scratch.matrix, 5, unknowns, scratch.matrix, scratch.norms, scratch.order)
    if conditioning < WELL_CONDITIONED:
        rows = _write_rows(geometry, directions, measured, in_base, rotation, scratch)
        if to_scale:
            return _pose_to_scale(geometry, directions, measured, rows, in_base, in_platform, position, rotation, scratch)
        conditioning = solve_least_squares(scratch.matrix, scratch.right, rows, unknowns, scratch.norms, scratch.order)
    turned = _turn(rotation, vector(in_base), per_spread * unknowns[3], per_spread * unknowns[4])
    if conditioning < RANK_TOLERANCE or not turned:
        return 0.0
    if pose_from_rotation(geometry, directions, measured, rotation, position, scratch) < RANK_TOLERANCE:
        return 0.0
    return conditioning


@kernel
def _count(measured: Array) -> int:
    """How many legs were measured."""
    count = 0
    for k in range(LEGS):
        if measured[k] != 0.0:
            count += 1
    return count


@kernel
def _terms(geometry: Record, k: int, legs: int, u: Vector, rotation: Array) -> tuple[Vector, Vector, Vector]:
    """What the cosine and the sine of the yaw multiply in the equations of a leg, its arm from the joints' centre before and
    after a quarter turn, and the base joint less what no yaw moves.
    """
    arm = rotate(rotation, subtract(vector(geometry.platform_joints[k]), vector(geometry.centers[legs])))
    along = scale(dot(u, arm), u)
    return subtract(arm, along), cross(u, arm), subtract(vector(geometry.base_joints[k]), along)


@kernel
def _write_rows(geometry: Record, directions: Array, measured: Array, in_base: Array, rotation: Array, scratch: Record) -> int:
    """Write the equations of `pose_from_vector` for QR; returns how many there are."""
    matrix, right, legs, u = scratch.matrix, scratch.right, set_number(measured), vector(in_base)
    per_spread = 1.0 / geometry.spreads[legs]
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        level, turned, base = _terms(geometry, k, legs, u, rotation)
        for w in across(directions[k]):
            matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = w
            matrix[rows, 3] = per_spread * dot(w, level)
            matrix[rows, 4] = per_spread * dot(w, turned)
            right[rows] = dot(w, base)
            rows += 1
    return rows


@kernel
def _write_normal_equations(
    geometry: Record, directions: Array, measured: Array, in_base: Array, rotation: Array, matrix: Array
) -> None:
    """Write the normal equations of the same for `solve_five`."""
    legs, u = set_number(measured), vector(in_base)
    per_spread = 1.0 / geometry.spreads[legs]
    m00 = m10 = m11 = m20 = m21 = m22 = m30 = m31 = m32 = m33 = m40 = m41 = m42 = m43 = m44 = 0.0
    r0 = r1 = r2 = r3 = r4 = 0.0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        level, turned, base = _terms(geometry, k, legs, u, rotation)
        d0, d1, d2 = direction = vector(directions[k])
        l0, l1, l2 = level = across_leg(direction, scale(per_spread, level))
        t0, t1, t2 = turned = across_leg(direction, scale(per_spread, turned))
        b0, b1, b2 = base = across_leg(direction, base)
        m00, m11, m22 = m00 + (1.0 - d0 * d0), m11 + (1.0 - d1 * d1), m22 + (1.0 - d2 * d2)
        m10, m20, m21 = m10 - d1 * d0, m20 - d2 * d0, m21 - d2 * d1
        m30, m31, m32, m33 = m30 + l0, m31 + l1, m32 + l2, m33 + dot(level, level)
        m40, m41, m42, m43, m44 = m40 + t0, m41 + t1, m42 + t2, m43 + dot(turned, level), m44 + dot(turned, turned)
        r0, r1, r2, r3, r4 = r0 + b0, r1 + b1, r2 + b2, r3 + dot(level, base), r4 + dot(turned, base)
    rows = (
        (m00, m10, m20, m30, m40, r0),
        (m10, m11, m21, m31, m41, r1),
        (m20, m21, m22, m32, m42, r2),
        (m30, m31, m32, m33, m43, r3),
        (m40, m41, m42, m43, m44, r4),
    )
    for i, row in enumerate(rows):
        matrix[i, 0], matrix[i, 1], matrix[i, 2], matrix[i, 3], matrix[i, 4], matrix[i, 5] = row


@kernel
def _from_one_base_joint(base_joints: Array, measured: Array) -> bool:
    first = 0
    while measured[first] == 0.0:
        first += 1
    for k in range(first + 1, LEGS):
        for i in range(3):
            if measured[k] != 0.0 and abs(base_joints[k, i] - base_joints[first, i]) > SAME_JOINT_M:
                return False
    return True


@kernel
def _pose_to_scale(
    geometry: Record, directions: Array, measured: Array, rows: int, in_base: Array, in_platform: Array, position: Array,
    rotation: Array, scratch: Record,
) -> float:  # fmt: skip
    """Pose from the system of `pose_from_vector` without its last pivot, which `cos^2 + sin^2 = 1` replaces; it has two roots.

    Seen from the one base joint, a level platform may be near and small or far and large. To scale, its mirror image in that
    joint fits too. Lengths are positive at one root only, or the equations left out tell the roots apart.
    """
    matrix, right, span = scratch.matrix, scratch.right, scratch.span
    conditioning = solve_truncated(matrix, right, rows, 4, span[0, :5], span[1:, :5], scratch.norms, scratch.order)
    if conditioning < RANK_TOLERANCE:
        return 0.0
    spread = geometry.spreads[set_number(measured)]
    per_spread = 1.0 / spread
    c0, s0, c1, s1 = per_spread * span[0, 3], per_spread * span[0, 4], per_spread * span[1, 3], per_spread * span[1, 4]
    a, b, c = c1 * c1 + s1 * s1, c0 * c1 + s0 * s1, c0 * c0 + s0 * s0 - 1.0
    if not a * spread**2 > RANK_TOLERANCE:
        return 0.0
    root = np.sqrt(max(b * b - a * c, 0.0))
    far = near = 0.0
    for row in range(4, rows):
        far += (right[row] - (root - b) / a * matrix[row, 4]) ** 2
        near += (right[row] + (root + b) / a * matrix[row, 4]) ** 2
    for step in (root, -root) if far < near else (-root, root):
        t = (step - b) / a
        rotation_between(in_platform, in_base, rotation)
        if not _turn(rotation, vector(in_base), c0 + t * c1, s0 + t * s1):
            return 0.0
        if pose_from_rotation(geometry, directions, measured, rotation, position, scratch) < RANK_TOLERANCE:
            return 0.0
        if _total_length(directions, measured, position, scratch) > 0.0:
            return float(min(conditioning, root / np.sqrt(b * b + a)))
    return 0.0


@kernel
def _total_length(directions: Array, measured: Array, position: Array, scratch: Record) -> float:
    """Sum of the measured legs' lengths along their directions, after `pose_from_rotation`."""
    total = 0.0
    for k in range(LEGS):
        if measured[k] != 0.0:
            for i in range(3):
                total += directions[k, i] * (position[i] - scratch.points[k, i])
    return total
