"""The paper's own algorithms of sections 3.1.1 and 4, with the mending that design and errata ask for; compiled.

Joints are matched to their known places on the platform, which gives the rotation with its sign; (11) would lose that
through its arccosines. Lines that do not meet count where they are nearest to each other. Section 5 is
`closed_forms.pose_from_rotation`, section 6 `planar`.
"""

import numpy as np

from controller.direct_kinematics.closed_forms import meeting_point, rotation_between, set_number
from controller.least_squares import RANK_TOLERANCE
from plant.compiled import Record, kernel
from plant.mechanism import LEGS
from plant.pose import Array


@kernel
def section_3_1_1(
    geometry: Record, directions: Array, measured: Array, position: Array, rotation: Array, scratch: Record
) -> float:
    """Pose of an n-3-I mechanism from its leg directions: three pairs of lines meet in the three platform joints.

    Returns the conditioning; 0 if not three platform joints have two measured legs each.
    """
    points, base, platform = scratch.points, scratch.span[:3, :3], scratch.span[3:, :3]
    joints = np.int64(0)
    conditioning = 1.0
    first = -1
    for joint in range(LEGS):
        if _select(geometry, measured, joint, scratch.selected) < 2:
            continue
        if joints == 3:
            return 0.0
        met = meeting_point(geometry.base_joints, directions, scratch.selected, points[joints], scratch)
        conditioning = min(conditioning, met)
        for i in range(3):
            points[3 + joints, i] = geometry.platform_joints[joint, i]
        if joints == 0:
            first = joint
        joints += 1
    if joints < 3 or conditioning < RANK_TOLERANCE:
        return 0.0
    conditioning = min(conditioning, _triad(points[:3], base), _triad(points[3:], platform))
    if conditioning < RANK_TOLERANCE:
        return 0.0
    for i in range(3):
        for j in range(3):
            rotation[i, j] = base[0, i] * platform[0, j] + base[1, i] * platform[1, j] + base[2, i] * platform[2, j]
    _place(geometry, first, points[0], rotation, position)
    return conditioning


@kernel
def section_4(
    geometry: Record, directions: Array, measured: Array, normal: Array, e_z: Array, position: Array, rotation: Array,
    scratch: Record,
) -> float:  # fmt: skip
    """Pose from the platform's normal in {1}: two legs or more meet in a joint, further legs cut the plane through it.

    The plane through the joint of leg q is off by `(a_q - a_l) . e_z`, so that joints need not be coplanar. The paper asks
    for two further legs; one is enough, and all that are measured count, the more the steeper they stand on the plane.

    Returns the conditioning; 0 if no platform joint has two measured legs, or no further leg is measured.
    """
    point, best, pivot = scratch.points[0], scratch.points[1], -1
    conditioning = 0.0
    for joint in range(LEGS):
        if _select(geometry, measured, joint, scratch.selected) < 2:
            continue
        met = meeting_point(geometry.base_joints, directions, scratch.selected, point, scratch)
        if met > conditioning:
            conditioning, pivot = met, joint
            best[:] = point
    if conditioning < RANK_TOLERANCE:
        return 0.0
    n0, n1, n2 = normal[0], normal[1], normal[2]
    rotation_between(e_z, normal, rotation)
    cosine = sine = weights = 0.0
    for k in range(LEGS):
        if measured[k] == 0.0 or geometry.platform_numbers[k] == pivot:
            continue
        x = geometry.platform_joints[k, 0] - geometry.platform_joints[pivot, 0]
        y = geometry.platform_joints[k, 1] - geometry.platform_joints[pivot, 1]
        offset = geometry.platform_joints[k, 2] - geometry.platform_joints[pivot, 2]
        r0, r1, r2 = directions[k, 0], directions[k, 1], directions[k, 2]
        v0 = geometry.base_joints[k, 0] - best[0]
        v1 = geometry.base_joints[k, 1] - best[1]
        v2 = geometry.base_joints[k, 2] - best[2]
        # The leg cuts the plane at v + length r; times the slope, lest a leg in the plane divide by zero.
        slope = n0 * r0 + n1 * r1 + n2 * r2
        length = offset - (n0 * v0 + n1 * v1 + n2 * v2)
        v0, v1, v2 = slope * v0 + length * r0, slope * v1 + length * r1, slope * v2 + length * r2
        # Seen along the axes that the turned platform has without yaw.
        w0 = rotation[0, 0] * v0 + rotation[1, 0] * v1 + rotation[2, 0] * v2
        w1 = rotation[0, 1] * v0 + rotation[1, 1] * v1 + rotation[2, 1] * v2
        cosine += slope * (x * w0 + y * w1)
        sine += slope * (x * w1 - y * w0)
        weights += slope * slope * (x * x + y * y)
    spread = geometry.spreads[set_number(measured)]
    size = np.sqrt(cosine * cosine + sine * sine)
    if not size > (RANK_TOLERANCE * spread) ** 2:
        return 0.0
    cosine, sine = cosine / size, sine / size
    for i in range(3):
        r0, r1 = rotation[i, 0], rotation[i, 1]
        rotation[i, 0] = r0 * cosine + r1 * sine
        rotation[i, 1] = r1 * cosine - r0 * sine
    _place(geometry, pivot, best, rotation, position)
    return float(min(conditioning, np.sqrt(weights / LEGS) / spread))


@kernel
def _select(geometry: Record, measured: Array, joint: int, selected: Array) -> int:
    """Select the measured legs of a platform joint; returns how many there are."""
    count = 0
    for k in range(LEGS):
        selected[k] = 0.0
        if measured[k] != 0.0 and geometry.platform_numbers[k] == joint:
            selected[k] = 1.0
            count += 1
    return count


@kernel
def _triad(points: Array, axes: Array) -> float:
    """Write the orthonormal rows `axes` (3, 3) that three points span, the last normal to them ((9), (10)); returns the sine
    of their angle at the first.
    """
    u0, u1, u2 = points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2]
    v0, v1, v2 = points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2]
    n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    u, v = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2), np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
    n = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    if not n > RANK_TOLERANCE * u * v:
        return 0.0
    u0, u1, u2 = u0 / u, u1 / u, u2 / u
    n0, n1, n2 = n0 / n, n1 / n, n2 / n
    axes[0, 0], axes[0, 1], axes[0, 2] = u0, u1, u2
    axes[1, 0], axes[1, 1], axes[1, 2] = n1 * u2 - n2 * u1, n2 * u0 - n0 * u2, n0 * u1 - n1 * u0
    axes[2, 0], axes[2, 1], axes[2, 2] = n0, n1, n2
    return float(n / (u * v))


@kernel
def _place(geometry: Record, leg: int, joint: Array, rotation: Array, position: Array) -> None:
    """Position of the platform from that of a leg's platform joint in {1} (13)."""
    a = geometry.platform_joints[leg]
    for i in range(3):
        position[i] = joint[i] - (rotation[i, 0] * a[0] + rotation[i, 1] * a[1] + rotation[i, 2] * a[2])
