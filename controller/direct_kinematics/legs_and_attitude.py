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

from controller.direct_kinematics.geometry import across, set_number
from controller.least_squares import RANK_TOLERANCE, solve_least_squares, solve_truncated
from plant.compiled import Record, kernel
from plant.mechanism import LEGS
from plant.mechanism.checks import SAME_JOINT_M
from plant.pose import Array
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector


@kernel
def meeting_point(origins: Array, directions: Array, selected: Array, point: Array, scratch: Record) -> float:
    """The point (3,) nearest to the selected ones of six lines, by QR (the paper's (8) and (25)-(28))."""
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
    axis, _ = across(from_vector)
    if flip:
        f = scale(-1.0, f)
    v0, v1, v2 = cross(f, t)
    cosine = dot(f, t)
    k = 1.0 / (1.0 + cosine)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cosine + k * v0 * v0, k * v0 * v1 - v2, k * v0 * v2 + v1
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = k * v0 * v1 + v2, cosine + k * v1 * v1, k * v1 * v2 - v0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = k * v0 * v2 - v1, k * v1 * v2 + v0, cosine + k * v2 * v2
    if flip:
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
    matrix, right, unknowns = scratch.matrix, scratch.right, scratch.unknowns
    legs = set_number(measured)
    center, per_spread, u = vector(geometry.centers[legs]), 1.0 / geometry.spreads[legs], vector(in_base)
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        q = rotate(rotation, subtract(vector(geometry.platform_joints[k]), center))
        along = scale(dot(u, q), u)
        level, turned = subtract(q, along), cross(u, q)
        base = subtract(vector(geometry.base_joints[k]), along)
        for w in across(directions[k]):
            matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = w
            matrix[rows, 3] = per_spread * dot(w, level)
            matrix[rows, 4] = per_spread * dot(w, turned)
            right[rows] = dot(w, base)
            rows += 1
    if rows < 6:
        return 0.0
    if _from_one_base_joint(geometry.base_joints, measured):
        return _pose_to_scale(geometry, directions, measured, rows, in_base, in_platform, position, rotation, scratch)
    conditioning = solve_least_squares(matrix, right, rows, unknowns[:5], scratch.norms, scratch.order)
    if conditioning < RANK_TOLERANCE or not _turn(rotation, u, per_spread * unknowns[3], per_spread * unknowns[4]):
        return 0.0
    if pose_from_rotation(geometry, directions, measured, rotation, position, scratch) < RANK_TOLERANCE:
        return 0.0
    return conditioning


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
