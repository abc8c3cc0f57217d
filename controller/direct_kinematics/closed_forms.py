"""Closed forms: from leg directions to the pose, compiled, without a first guess."""

import numpy as np

from controller.least_squares import RANK_TOLERANCE, solve_least_squares
from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array


@kernel
def _across(direction: Array) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors that span the plane across a unit vector (Duff et al. 2017, with the sign of z)."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


@kernel
def _spread(joints: Array, measured: Array) -> float:
    """Root mean square distance of the measured legs' joints (6, 3) from their centre [m]: the length in which columns for
    a rotation are counted, so that the conditioning does not depend on the size of the mechanism.
    """
    count = c0 = c1 = c2 = total = 0.0
    for k in range(LEGS):
        if measured[k] != 0.0:
            count += 1.0
            c0 += joints[k, 0]
            c1 += joints[k, 1]
            c2 += joints[k, 2]
            total += joints[k, 0] ** 2 + joints[k, 1] ** 2 + joints[k, 2] ** 2
    if count == 0.0:
        return 1.0
    variance = (total - (c0 * c0 + c1 * c1 + c2 * c2) / count) / count
    return np.sqrt(variance) if variance > 0.0 else 1.0


@kernel
def rotation_between(from_vector: Array, to_vector: Array, rotation: Array) -> None:
    """Write a rotation (3, 3) that carries one unit vector to another, opposite ones included."""
    flip = from_vector[0] * to_vector[0] + from_vector[1] * to_vector[1] + from_vector[2] * to_vector[2] < 0.0
    # Opposite vectors have no shortest way: half a turn about an axis across the first brings them together.
    t0, t1, t2, _, _, _ = _across(from_vector)
    f0, f1, f2 = from_vector[0], from_vector[1], from_vector[2]
    if flip:
        f0, f1, f2 = -f0, -f1, -f2
    v0, v1, v2 = (
        f1 * to_vector[2] - f2 * to_vector[1],
        f2 * to_vector[0] - f0 * to_vector[2],
        f0 * to_vector[1] - f1 * to_vector[0],
    )
    cosine = f0 * to_vector[0] + f1 * to_vector[1] + f2 * to_vector[2]
    k = 1.0 / (1.0 + cosine)
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cosine + k * v0 * v0, k * v0 * v1 - v2, k * v0 * v2 + v1
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = k * v0 * v1 + v2, cosine + k * v1 * v1, k * v1 * v2 - v0
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = k * v0 * v2 - v1, k * v1 * v2 + v0, cosine + k * v2 * v2
    if flip:
        for i in range(3):
            dot = rotation[i, 0] * t0 + rotation[i, 1] * t1 + rotation[i, 2] * t2
            rotation[i, 0] = 2.0 * dot * t0 - rotation[i, 0]
            rotation[i, 1] = 2.0 * dot * t1 - rotation[i, 1]
            rotation[i, 2] = 2.0 * dot * t2 - rotation[i, 2]


@kernel
def pose_from_rotation(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, rotation: Array, position: Array,
    matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Position from leg directions and the rotation (the paper's (25)-(28), by QR); returns the conditioning."""
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        c0, c1, c2 = base_joints[k, 0], base_joints[k, 1], base_joints[k, 2]
        for j in range(3):
            c0 -= rotation[0, j] * platform_joints[k, j]
            c1 -= rotation[1, j] * platform_joints[k, j]
            c2 -= rotation[2, j] * platform_joints[k, j]
        matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = t0, t1, t2
        right[rows] = t0 * c0 + t1 * c1 + t2 * c2
        matrix[rows + 1, 0], matrix[rows + 1, 1], matrix[rows + 1, 2] = s0, s1, s2
        right[rows + 1] = s0 * c0 + s1 * c1 + s2 * c2
        rows += 2
    if rows < 3:
        return 0.0
    return solve_least_squares(matrix[:rows, :3], right[:rows], position, norms, order)


@kernel
def pose_from_vector(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, in_base: Array, in_platform: Array,
    position: Array, rotation: Array, matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Pose from leg directions and one vector known in both frames; linear in (p, cos yaw, sin yaw).

    Returns the conditioning.
    """
    rotation_between(in_platform, in_base, rotation)
    scale = 1.0 / _spread(platform_joints, measured)
    u0, u1, u2 = in_base[0], in_base[1], in_base[2]
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        a0, a1, a2 = platform_joints[k, 0], platform_joints[k, 1], platform_joints[k, 2]
        q0 = rotation[0, 0] * a0 + rotation[0, 1] * a1 + rotation[0, 2] * a2
        q1 = rotation[1, 0] * a0 + rotation[1, 1] * a1 + rotation[1, 2] * a2
        q2 = rotation[2, 0] * a0 + rotation[2, 1] * a1 + rotation[2, 2] * a2
        along = u0 * q0 + u1 * q1 + u2 * q2
        x0, x1, x2 = q0 - along * u0, q1 - along * u1, q2 - along * u2
        y0, y1, y2 = u1 * q2 - u2 * q1, u2 * q0 - u0 * q2, u0 * q1 - u1 * q0
        c0 = base_joints[k, 0] - along * u0
        c1 = base_joints[k, 1] - along * u1
        c2 = base_joints[k, 2] - along * u2
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for row, w0, w1, w2 in ((rows, t0, t1, t2), (rows + 1, s0, s1, s2)):
            matrix[row, 0], matrix[row, 1], matrix[row, 2] = w0, w1, w2
            matrix[row, 3] = scale * (w0 * x0 + w1 * x1 + w2 * x2)
            matrix[row, 4] = scale * (w0 * y0 + w1 * y1 + w2 * y2)
            right[row] = w0 * c0 + w1 * c1 + w2 * c2
        rows += 2
    if rows < 5:
        return 0.0
    conditioning = solve_least_squares(matrix[:rows, :5], right[:rows], unknowns[:5], norms, order)
    if conditioning < RANK_TOLERANCE:
        return conditioning
    # Cosine and sine come multiplied by the spread of the joints.
    size = np.sqrt(unknowns[3] * unknowns[3] + unknowns[4] * unknowns[4])
    if not size * scale > RANK_TOLERANCE:
        return 0.0
    cosine, sine = unknowns[3] / size, unknowns[4] / size
    for j in range(3):
        r0, r1, r2 = rotation[0, j], rotation[1, j], rotation[2, j]
        along = (1.0 - cosine) * (u0 * r0 + u1 * r1 + u2 * r2)
        rotation[0, j] = cosine * r0 + sine * (u1 * r2 - u2 * r1) + along * u0
        rotation[1, j] = cosine * r1 + sine * (u2 * r0 - u0 * r2) + along * u1
        rotation[2, j] = cosine * r2 + sine * (u0 * r1 - u1 * r0) + along * u2
    pose_from_rotation(
        base_joints, platform_joints, directions, measured, rotation, position, matrix, right, unknowns, norms, order
    )
    return conditioning


@kernel
def pose_from_legs(
    base_joints: Array, platform_joints: Array, directions: Array, measured: Array, center: Array, axes: Array,
    position: Array, rotation: Array, matrix: Array, right: Array, unknowns: Array, norms: Array, order: Array,
) -> float:  # fmt: skip
    """Pose from leg directions alone, for platform joints in the plane of `center` and `axes`; returns the conditioning.

    Linear in the plane's origin and the two columns of the rotation that span it; the nearest rotation follows, then
    the position again.
    """
    rows = 0
    scale = 1.0 / _spread(platform_joints, measured)
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        x = y = 0.0
        for j in range(3):
            x += scale * axes[j, 0] * (platform_joints[k, j] - center[j])
            y += scale * axes[j, 1] * (platform_joints[k, j] - center[j])
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for row, w0, w1, w2 in ((rows, t0, t1, t2), (rows + 1, s0, s1, s2)):
            matrix[row, 0], matrix[row, 1], matrix[row, 2] = w0, w1, w2
            matrix[row, 3], matrix[row, 4], matrix[row, 5] = x * w0, x * w1, x * w2
            matrix[row, 6], matrix[row, 7], matrix[row, 8] = y * w0, y * w1, y * w2
            right[row] = w0 * base_joints[k, 0] + w1 * base_joints[k, 1] + w2 * base_joints[k, 2]
        rows += 2
    if rows < 9:
        return 0.0
    conditioning = solve_least_squares(matrix[:rows], right[:rows], unknowns, norms, order)
    if conditioning < RANK_TOLERANCE:
        return conditioning
    # The nearest pair of orthonormal columns is M (M^T M)^(-1/2), and the root of a 2 x 2 matrix is in closed form.
    p = q = r = 0.0
    for j in range(3, 6):
        p += unknowns[j] * unknowns[j]
        q += unknowns[j] * unknowns[j + 3]
        r += unknowns[j + 3] * unknowns[j + 3]
    root_det = np.sqrt(max(p * r - q * q, 0.0))
    if not root_det * scale * scale > RANK_TOLERANCE:
        return 0.0
    trace = np.sqrt(p + r + 2.0 * root_det)
    f = 1.0 / (root_det * trace)
    e00, e01, e11 = f * (r + root_det), -f * q, f * (p + root_det)
    x0 = e00 * unknowns[3] + e01 * unknowns[6]
    x1 = e00 * unknowns[4] + e01 * unknowns[7]
    x2 = e00 * unknowns[5] + e01 * unknowns[8]
    y0 = e01 * unknowns[3] + e11 * unknowns[6]
    y1 = e01 * unknowns[4] + e11 * unknowns[7]
    y2 = e01 * unknowns[5] + e11 * unknowns[8]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    for j in range(3):
        rotation[0, j] = x0 * axes[j, 0] + y0 * axes[j, 1] + z0 * axes[j, 2]
        rotation[1, j] = x1 * axes[j, 0] + y1 * axes[j, 1] + z1 * axes[j, 2]
        rotation[2, j] = x2 * axes[j, 0] + y2 * axes[j, 1] + z2 * axes[j, 2]
    pose_from_rotation(
        base_joints, platform_joints, directions, measured, rotation, position, matrix, right, unknowns, norms, order
    )
    return conditioning
