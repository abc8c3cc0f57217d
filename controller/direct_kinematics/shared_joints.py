"""The paper's own algorithms of sections 3.1.1 and 4; compiled.

Section 5 is `legs_and_attitude.pose_from_rotation`, section 6 is `planar`. Where the printed equations need care:

- Joints are matched to their known places on the platform, which gives the rotation with its sign. The arccosines of (11) would
  lose that sign.
- Lines that do not meet count where they are nearest to each other.
"""

import numpy as np

from controller.direct_kinematics.geometry import set_number
from controller.direct_kinematics.legs_and_attitude import meeting_point, rotation_between
from controller.least_squares import RANK_TOLERANCE
from plant.compiled import Record, kernel
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import add, cross, dot, rotate, rotate_back, scale, subtract, vector


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
    for joint in range(LEGS):
        if _select(geometry, measured, joint, scratch.selected) < 2:
            continue
        if joints == 3:
            return 0.0
        met = meeting_point(geometry.base_joints, directions, scratch.selected, points[joints], scratch)
        conditioning = min(conditioning, met)
        for i in range(3):
            points[3 + joints, i] = geometry.platform_joints[joint, i]
        joints += 1
    if joints < 3 or conditioning < RANK_TOLERANCE:
        return 0.0
    conditioning = min(conditioning, _triad(points[:3], base), _triad(points[3:], platform))
    if conditioning < RANK_TOLERANCE:
        return 0.0
    for i in range(3):
        for j in range(3):
            rotation[i, j] = base[0, i] * platform[0, j] + base[1, i] * platform[1, j] + base[2, i] * platform[2, j]
    _place(points[3], points[0], rotation, position)
    return conditioning


@kernel
def section_4(
    geometry: Record, directions: Array, measured: Array, normal: Array, e_z: Array, position: Array, rotation: Array,
    scratch: Record,
) -> float:  # fmt: skip
    """Pose from the platform's normal in {1}: two legs or more meet in a joint, further legs cut the plane through it.

    The plane through the joint of leg q is off by `(a_q - a_l) . e_z`, so that joints need not be coplanar. The paper asks
    for two further legs; one is enough. All that are measured count, the more the steeper they stand on the plane.

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
            best[0], best[1], best[2] = vector(point)
    if conditioning < RANK_TOLERANCE:
        return 0.0
    n = vector(normal)
    rotation_between(e_z, normal, rotation)
    cosine = sine = weights = 0.0
    for k in range(LEGS):
        if measured[k] == 0.0 or geometry.platform_numbers[k] == pivot:
            continue
        x, y, offset = subtract(vector(geometry.platform_joints[k]), vector(geometry.platform_joints[pivot]))
        r, v = vector(directions[k]), subtract(vector(geometry.base_joints[k]), vector(best))
        # The leg cuts the plane at v + length r. Everything is multiplied by the slope, which is 0 for a leg in the plane.
        slope = dot(n, r)
        length = offset - dot(n, v)
        v = add(scale(slope, v), scale(length, r))
        # Seen along the axes that the turned platform has without yaw.
        w0, w1, _ = rotate_back(rotation, v)
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
    _place(geometry.platform_joints[pivot], best, rotation, position)
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
    """Write the orthonormal rows `axes` (3, 3) that three points span, the last normal to them ((9), (10)). Returns the sine of
    their angle at the first.
    """
    u, v = subtract(vector(points[1]), vector(points[0])), subtract(vector(points[2]), vector(points[0]))
    n = cross(u, v)
    long_u, long_v, long_n = np.sqrt(dot(u, u)), np.sqrt(dot(v, v)), np.sqrt(dot(n, n))
    if not long_n > RANK_TOLERANCE * long_u * long_v:
        return 0.0
    u, n = (u[0] / long_u, u[1] / long_u, u[2] / long_u), (n[0] / long_n, n[1] / long_n, n[2] / long_n)
    axes[0, 0], axes[0, 1], axes[0, 2] = u
    axes[1, 0], axes[1, 1], axes[1, 2] = cross(n, u)
    axes[2, 0], axes[2, 1], axes[2, 2] = n
    return float(long_n / (long_u * long_v))


@kernel
def _place(in_platform: Array, in_base: Array, rotation: Array, position: Array) -> None:
    """Position of the platform from that of a platform joint (3,) in {2} and in {1} (13)."""
    arm = rotate(rotation, vector(in_platform))
    for i in range(3):
        position[i] = in_base[i] - arm[i]
