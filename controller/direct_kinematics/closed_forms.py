"""Closed forms from all measured legs: from directions to the pose, compiled, without a first guess.

Every leg gives `skew(r) (p + R a - b) = 0`, of rank two; written here with two unit vectors across the leg, which is the
same least-squares problem with two rows a leg instead of three.

- Rotation known (the paper's section 5): linear in p, the point where the lines through `b - R a` along r meet.
- One vector known in both frames, `R v_platform = v_base`: the vertical seen by the platform's accelerometer, or the
  platform's normal of the paper's section 4. `R = Rot(v_base, yaw) R_0` with any R_0 that carries the one to the other, so
  the problem is linear in (p, cos yaw, sin yaw), for every class of mechanism. Legs from one base joint leave the scale
  open, and `cos^2 + sin^2 = 1` settles it.
- Legs alone: linear in p and R, of a rank that the graph of the legs tells. Rotations obey twenty quadratic equations,
  which are linear in the parameters that the legs leave open and in the products of those: up to five parameters, hence
  four legs or more, of every class, with coplanar platform joints or not.
- Planar, the roll known (the paper's section 6): linear in the position in the plane.

All return the conditioning: the ratio of the least to the greatest pivot of what was solved, with rotations counted in the
joints' spread, so that it depends neither on size nor on frames; 0 where nothing was solved.
"""

from functools import lru_cache

import numpy as np

from controller.least_squares import RANK_TOLERANCE, solve_least_squares, solve_truncated
from plant.compiled import Record, kernel
from plant.mechanism import LEGS, Mechanism, six_rows
from plant.mechanism.checks import SAME_JOINT_M
from plant.pose import Array

FLATNESS = 1e-3
"""Platform joints count as coplanar if they leave their plane by less than this share of their spread: the refinement makes
up for it, where it starts near enough."""

_FLAT = 1e-13
"""Such a share that is no more than rounding."""

_LEAST_FLAT_CONDITIONING = 10.0
"""Least conditioning over that share: further off than a tenth of a radian, the refinement may find another pose."""

_SETS = 1 << LEGS
_MOST_FREE = 5
_ROTATION_EQUATIONS = 20
_COLUMN_EQUATIONS = 3
_COLUMN_STEPS = 5
_MOST_POLAR_STEPS = 30
_POLAR_TOLERANCE = 1e-18
"""Square of the last step; what is left is its square."""

_LINEAR_RANK = 9
"""Rank beyond which the legs' equations are left out: with three parameters open, the equations of a rotation settle those
with a sixth of the error that the last three pivots of a 6-6 mechanism would bring."""


GEOMETRY = np.dtype(
    [
        ("base_joints", np.float64, (LEGS, 3)),
        ("platform_joints", np.float64, (LEGS, 3)),
        ("platform_numbers", np.int64, LEGS),
        ("centers", np.float64, (_SETS, 3)),
        ("axes", np.float64, (_SETS, 3, 3)),
        ("spreads", np.float64, _SETS),
        ("bulges", np.float64, _SETS),
        ("ranks", np.int64, _SETS),
    ],
    align=True,
)
"""What the closed forms need of a mechanism: its joints [m], and the first leg of each leg's platform joint. Of each set of
legs, in whose number leg k has bit k: the centre of its platform joints [m]; axes in columns, of which two span the joints'
plane; their root mean square distance from the centre [m]; the share of it by which they leave the plane; and the rank of the
legs' equations for p and R.
"""

SCRATCH = np.dtype(
    [
        ("matrix", np.float64, (_ROTATION_EQUATIONS, _ROTATION_EQUATIONS)),
        ("right", np.float64, _ROTATION_EQUATIONS),
        ("unknowns", np.float64, _ROTATION_EQUATIONS),
        ("span", np.float64, (1 + _MOST_FREE, 12)),
        ("norms", np.float64, _ROTATION_EQUATIONS),
        ("order", np.float64, _ROTATION_EQUATIONS),
        ("points", np.float64, (LEGS, 3)),
        ("selected", np.float64, LEGS),
        ("second_root", np.float64, 12),
        ("roots", np.int64),
        ("approximate", np.int64),
        ("misfit", np.float64),
    ],
    align=True,
)
"""Memory for the closed forms, which allocate nothing; `roots` is how many `pose_from_legs` found, 2 where one parameter of
coplanar joints is open (class n-3-II), whether it took joints for coplanar that are so but approximately, and `misfit` how far
from a rotation it came out.
"""


_OUT_OF_THE_WAY = (0.0, 0.0, -1.0)
"""Base joint in the rows of legs that a planar mechanism has not, so that none of them has the length zero [m]."""


@lru_cache(maxsize=256)
def geometry_of(mechanism: Mechanism) -> Record:
    """What the closed forms need of a mechanism, a record of dtype `GEOMETRY`."""
    geometry = np.zeros((), GEOMETRY)
    platform = six_rows(mechanism.platform_joints)
    apart = np.linalg.norm(platform[:, None] - platform, axis=2)
    geometry["base_joints"], geometry["platform_joints"] = six_rows(mechanism.base_joints, _OUT_OF_THE_WAY), platform
    geometry["platform_numbers"] = numbers = np.argmax(apart < SAME_JOINT_M, axis=1)
    geometry["spreads"] = 1.0
    for number in range(1, _SETS):
        legs = [leg for leg in range(LEGS) if number >> leg & 1]
        center = platform[legs].mean(axis=0)
        _, spread, axes = np.linalg.svd(platform[legs] - center)
        axes[2] *= np.sign(np.linalg.det(axes))
        size = float(np.linalg.norm(spread))
        geometry["centers"][number], geometry["axes"][number] = center, axes.T
        if size > SAME_JOINT_M:
            geometry["spreads"][number] = size / np.sqrt(len(legs))
            if len(legs) > 3:
                geometry["bulges"][number] = spread[2] / size
        # A joint is a point as soon as two of its legs are known.
        geometry["ranks"][number] = min(_LINEAR_RANK, int(np.minimum(2 * np.bincount(numbers[legs]), 3).sum()))
    return geometry[()]


@kernel
def set_number(measured: Array) -> int:
    """Number of a set of legs, given as (6,) with 0 for the legs that are not in it."""
    number = 0
    for k in range(LEGS):
        if measured[k] != 0.0:
            number += 1 << k
    return number


@kernel
def _across(direction: Array) -> tuple[float, float, float, float, float, float]:
    """Two unit vectors that span the plane across a unit vector (Duff et al. 2017, with the sign of z)."""
    x, y, z = direction[0], direction[1], direction[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    return 1.0 + sign * x * x * a, sign * b, -sign * x, b, sign + y * y * a, -y


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
def meeting_point(origins: Array, directions: Array, selected: Array, point: Array, scratch: Record) -> float:
    """The point (3,) nearest to the selected ones of six lines, by QR (the paper's (8) and (25)-(28))."""
    matrix, right = scratch.matrix, scratch.right
    rows = 0
    for k in range(LEGS):
        if selected[k] == 0.0:
            continue
        o0, o1, o2 = origins[k, 0], origins[k, 1], origins[k, 2]
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        matrix[rows, 0], matrix[rows, 1], matrix[rows, 2] = t0, t1, t2
        right[rows] = t0 * o0 + t1 * o1 + t2 * o2
        matrix[rows + 1, 0], matrix[rows + 1, 1], matrix[rows + 1, 2] = s0, s1, s2
        right[rows + 1] = s0 * o0 + s1 * o1 + s2 * o2
        rows += 2
    if rows < 4:
        return 0.0
    return solve_least_squares(matrix, right, rows, point, scratch.norms, scratch.order)


@kernel
def pose_from_rotation(
    geometry: Record, directions: Array, measured: Array, rotation: Array, position: Array, scratch: Record
) -> float:
    """Position from the rotation and two or more legs (the paper's section 5)."""
    for k in range(LEGS):
        a0, a1, a2 = geometry.platform_joints[k, 0], geometry.platform_joints[k, 1], geometry.platform_joints[k, 2]
        for i in range(3):
            arm = rotation[i, 0] * a0 + rotation[i, 1] * a1 + rotation[i, 2] * a2
            scratch.points[k, i] = geometry.base_joints[k, i] - arm
    return meeting_point(scratch.points, directions, measured, position, scratch)


@kernel
def pose_from_roll(
    geometry: Record, directions: Array, measured: Array, in_base: Array, in_platform: Array, position: Array, rotation: Array
) -> float:
    """Pose of a planar mechanism in the xy-plane of {1} from its roll and two or more legs (the paper's section 6).

    The roll is the angle between one vector's parts in the plane, as it is known in {1} and in {2}, in the place of (30); the
    position is that of least squares of all legs (31). Returns the conditioning of the position, which is what can fail.
    """
    b0, b1, v0, v1 = in_base[0], in_base[1], in_platform[0], in_platform[1]
    cosine, sine = b0 * v0 + b1 * v1, b1 * v0 - b0 * v1
    size = np.sqrt(cosine * cosine + sine * sine)
    if not size > RANK_TOLERANCE:
        return 0.0
    cosine, sine = cosine / size, sine / size
    n00 = n01 = n11 = r0 = r1 = 0.0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        n0, n1 = -directions[k, 1], directions[k, 0]
        a0, a1 = geometry.platform_joints[k, 0], geometry.platform_joints[k, 1]
        off = n0 * (geometry.base_joints[k, 0] - cosine * a0 + sine * a1)
        off += n1 * (geometry.base_joints[k, 1] - sine * a0 - cosine * a1)
        n00, n01, n11 = n00 + n0 * n0, n01 + n0 * n1, n11 + n1 * n1
        r0, r1 = r0 + n0 * off, r1 + n1 * off
    middle, swing = 0.5 * (n00 + n11), np.sqrt(0.25 * (n00 - n11) ** 2 + n01 * n01)
    if not middle - swing > RANK_TOLERANCE**2 * middle:
        return 0.0
    determinant = n00 * n11 - n01 * n01
    position[0], position[1], position[2] = (n11 * r0 - n01 * r1) / determinant, (n00 * r1 - n01 * r0) / determinant, 0.0
    for i in range(3):
        for j in range(3):
            rotation[i, j] = 1.0 if i == j else 0.0
    rotation[0, 0], rotation[0, 1], rotation[1, 0], rotation[1, 1] = cosine, -sine, sine, cosine
    return float(np.sqrt((middle - swing) / (middle + swing)))


@kernel
def pose_from_vector(
    geometry: Record, directions: Array, measured: Array, in_base: Array, in_platform: Array, position: Array,
    rotation: Array, scratch: Record,
) -> float:  # fmt: skip
    """Pose from one vector known in both frames, and three or more legs that end in two platform joints or more."""
    rotation_between(in_platform, in_base, rotation)
    matrix, right, unknowns = scratch.matrix, scratch.right, scratch.unknowns
    legs = set_number(measured)
    center, scale = geometry.centers[legs], 1.0 / geometry.spreads[legs]
    u0, u1, u2 = in_base[0], in_base[1], in_base[2]
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        a0 = geometry.platform_joints[k, 0] - center[0]
        a1 = geometry.platform_joints[k, 1] - center[1]
        a2 = geometry.platform_joints[k, 2] - center[2]
        q0 = rotation[0, 0] * a0 + rotation[0, 1] * a1 + rotation[0, 2] * a2
        q1 = rotation[1, 0] * a0 + rotation[1, 1] * a1 + rotation[1, 2] * a2
        q2 = rotation[2, 0] * a0 + rotation[2, 1] * a1 + rotation[2, 2] * a2
        along = u0 * q0 + u1 * q1 + u2 * q2
        x0, x1, x2 = q0 - along * u0, q1 - along * u1, q2 - along * u2
        y0, y1, y2 = u1 * q2 - u2 * q1, u2 * q0 - u0 * q2, u0 * q1 - u1 * q0
        c0 = geometry.base_joints[k, 0] - along * u0
        c1 = geometry.base_joints[k, 1] - along * u1
        c2 = geometry.base_joints[k, 2] - along * u2
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for row, w0, w1, w2 in ((rows, t0, t1, t2), (rows + 1, s0, s1, s2)):
            matrix[row, 0], matrix[row, 1], matrix[row, 2] = w0, w1, w2
            matrix[row, 3] = scale * (w0 * x0 + w1 * x1 + w2 * x2)
            matrix[row, 4] = scale * (w0 * y0 + w1 * y1 + w2 * y2)
            right[row] = w0 * c0 + w1 * c1 + w2 * c2
        rows += 2
    if rows < 6:
        return 0.0
    if _from_one_base_joint(geometry.base_joints, measured):
        return _pose_to_scale(geometry, directions, measured, rows, in_base, in_platform, position, rotation, scratch)
    conditioning = solve_least_squares(matrix, right, rows, unknowns[:5], scratch.norms, scratch.order)
    if conditioning < RANK_TOLERANCE or not _turn(rotation, in_base, scale * unknowns[3], scale * unknowns[4]):
        return 0.0
    if pose_from_rotation(geometry, directions, measured, rotation, position, scratch) < RANK_TOLERANCE:
        return 0.0
    return conditioning


@kernel
def _from_one_base_joint(base_joints: Array, measured: Array) -> bool:
    first = -1
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        if first < 0:
            first = k
        for i in range(3):
            if abs(base_joints[k, i] - base_joints[first, i]) > SAME_JOINT_M:
                return False
    return True


@kernel
def _pose_to_scale(
    geometry: Record, directions: Array, measured: Array, rows: int, in_base: Array, in_platform: Array, position: Array,
    rotation: Array, scratch: Record,
) -> float:  # fmt: skip
    """Pose from the system of `pose_from_vector` less its last pivot: `cos^2 + sin^2 = 1`, with two roots, stands in for it.

    Seen from the one base joint, a level platform may be near and small or far and large, and to scale its mirror image
    in that joint fits too: lengths are positive at one root only, or else the equations left out tell the roots apart.
    """
    matrix, right, span = scratch.matrix, scratch.right, scratch.span
    conditioning = solve_truncated(matrix, right, rows, 4, span[0, :5], span[1:, :5], scratch.norms, scratch.order)
    if conditioning < RANK_TOLERANCE:
        return 0.0
    scale = 1.0 / geometry.spreads[set_number(measured)]
    c0, s0, c1, s1 = scale * span[0, 3], scale * span[0, 4], scale * span[1, 3], scale * span[1, 4]
    a, b, c = c1 * c1 + s1 * s1, c0 * c1 + s0 * s1, c0 * c0 + s0 * s0 - 1.0
    if not a * geometry.spreads[set_number(measured)] ** 2 > RANK_TOLERANCE:
        return 0.0
    root = np.sqrt(max(b * b - a * c, 0.0))
    far = near = 0.0
    for row in range(4, rows):
        far += (right[row] - (root - b) / a * matrix[row, 4]) ** 2
        near += (right[row] + (root + b) / a * matrix[row, 4]) ** 2
    for step in (root, -root) if far < near else (-root, root):
        t = (step - b) / a
        rotation_between(in_platform, in_base, rotation)
        if not _turn(rotation, in_base, c0 + t * c1, s0 + t * s1):
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


@kernel
def _turn(rotation: Array, axis: Array, cosine: float, sine: float) -> bool:
    """Turn `rotation` about a unit axis seen in {1}, in place; cosine and sine need a common scale. False if they have none."""
    size = np.sqrt(cosine * cosine + sine * sine)
    if not size > RANK_TOLERANCE:
        return False
    cosine, sine = cosine / size, sine / size
    u0, u1, u2 = axis[0], axis[1], axis[2]
    for j in range(3):
        r0, r1, r2 = rotation[0, j], rotation[1, j], rotation[2, j]
        along = (1.0 - cosine) * (u0 * r0 + u1 * r1 + u2 * r2)
        rotation[0, j] = cosine * r0 + sine * (u1 * r2 - u2 * r1) + along * u0
        rotation[1, j] = cosine * r1 + sine * (u2 * r0 - u0 * r2) + along * u1
        rotation[2, j] = cosine * r2 + sine * (u0 * r1 - u1 * r0) + along * u2
    return True


@kernel
def rotation_from_vectors(in_base: Array, in_platform: Array, rotation: Array) -> bool:
    """Write the rotation (3, 3) that carries the first of two vectors (2, 3), a unit vector, from {2} to {1} and brings the
    second as near as it can; False if they do not tell one.
    """
    up, second = in_base[0], in_base[1]
    rotation_between(in_platform[0], up, rotation)
    m0, m1, m2 = in_platform[1, 0], in_platform[1, 1], in_platform[1, 2]
    t0 = rotation[0, 0] * m0 + rotation[0, 1] * m1 + rotation[0, 2] * m2
    t1 = rotation[1, 0] * m0 + rotation[1, 1] * m1 + rotation[1, 2] * m2
    t2 = rotation[2, 0] * m0 + rotation[2, 1] * m1 + rotation[2, 2] * m2
    c0, c1, c2 = t1 * second[2] - t2 * second[1], t2 * second[0] - t0 * second[2], t0 * second[1] - t1 * second[0]
    along = (up[0] * t0 + up[1] * t1 + up[2] * t2) * (up[0] * second[0] + up[1] * second[1] + up[2] * second[2])
    cosine = t0 * second[0] + t1 * second[1] + t2 * second[2] - along
    return bool(_turn(rotation, up, cosine, up[0] * c0 + up[1] * c1 + up[2] * c2))


@kernel
def pose_from_legs(
    geometry: Record, directions: Array, measured: Array, position: Array, rotation: Array, scratch: Record
) -> float:
    """Pose from leg directions alone, four legs or more; the one that fits better if there are two roots."""
    legs = set_number(measured)
    if geometry.ranks[legs] < 12 - _MOST_FREE:
        return 0.0
    bulge = geometry.bulges[legs]
    if bulge <= FLATNESS:
        conditioning = _pose_from_legs(geometry, directions, measured, legs, True, position, rotation, scratch)
        if conditioning >= _LEAST_FLAT_CONDITIONING * bulge:
            scratch.approximate = 1 if bulge > _FLAT else 0
            return conditioning
    scratch.approximate = 0
    return _pose_from_legs(geometry, directions, measured, legs, False, position, rotation, scratch)


@kernel
def second_pose_from_legs(
    geometry: Record, directions: Array, measured: Array, position: Array, rotation: Array, scratch: Record
) -> float:
    """The pose at the second of two roots, after `pose_from_legs` found both."""
    legs = set_number(measured)
    return _pose_from_columns(
        geometry, directions, measured, legs, True, scratch.second_root[3:], position, rotation, scratch
    )  # fmt: skip


@kernel
def _pose_from_legs(
    geometry: Record, directions: Array, measured: Array, legs: int, flat: bool, position: Array, rotation: Array,
    scratch: Record,
) -> float:  # fmt: skip
    """Pose from the legs in a set, with coplanar joints or not.

    Unknown are the joints' centre and the columns of R, times the spread, that turn the axes of the joints' plane, or all.
    """
    matrix, right, span = scratch.matrix, scratch.right, scratch.span
    center, axes, scale = geometry.centers[legs], geometry.axes[legs], 1.0 / geometry.spreads[legs]
    unknowns, rank = 9 if flat else 12, geometry.ranks[legs]
    free = unknowns - rank
    rows = 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        a0 = geometry.platform_joints[k, 0] - center[0]
        a1 = geometry.platform_joints[k, 1] - center[1]
        a2 = geometry.platform_joints[k, 2] - center[2]
        t0, t1, t2, s0, s1, s2 = _across(directions[k])
        for i in range(unknowns // 3):
            x = scale * (axes[0, i - 1] * a0 + axes[1, i - 1] * a1 + axes[2, i - 1] * a2) if i > 0 else 1.0
            j = 3 * i
            matrix[rows, j], matrix[rows, j + 1], matrix[rows, j + 2] = x * t0, x * t1, x * t2
            matrix[rows + 1, j], matrix[rows + 1, j + 1], matrix[rows + 1, j + 2] = x * s0, x * s1, x * s2
        b0, b1, b2 = geometry.base_joints[k, 0], geometry.base_joints[k, 1], geometry.base_joints[k, 2]
        right[rows] = t0 * b0 + t1 * b1 + t2 * b2
        right[rows + 1] = s0 * b0 + s1 * b1 + s2 * b2
        rows += 2
    span[:] = 0.0
    conditioning = solve_truncated(
        matrix, right, rows, rank, span[0, :unknowns], span[1:, :unknowns], scratch.norms, scratch.order
    )  # fmt: skip
    if conditioning < RANK_TOLERANCE:
        return conditioning
    columns = span[0, 3:]
    for i in range(9):
        columns[i] *= scale
    scratch.roots = 1
    if free > 0:
        if flat and free > 1:
            for i in range(3):
                span[1 + free + i, 9 + i] = 1.0
            free += 3
        if not _orthonormalise_span(free, span):
            return 0.0
        settled = _settle_columns(scratch) if free == 1 else _settle_rotation(free, scratch)
        conditioning = min(conditioning, settled)
        if conditioning < RANK_TOLERANCE:
            return conditioning
    met = _pose_from_columns(geometry, directions, measured, legs, flat, columns, position, rotation, scratch)
    return min(conditioning, met)


@kernel
def _pose_from_columns(
    geometry: Record, directions: Array, measured: Array, legs: int, flat: bool, columns: Array, position: Array,
    rotation: Array, scratch: Record,
) -> float:  # fmt: skip
    """Pose from the columns (9,) of a matrix near the rotation that turns the axes of the joints' plane."""
    scratch.misfit = orthonormalise(columns, flat)
    if scratch.misfit < 0.0:
        return 0.0
    axes = geometry.axes[legs]
    for i in range(3):
        for j in range(3):
            rotation[i, j] = columns[i] * axes[j, 0] + columns[3 + i] * axes[j, 1] + columns[6 + i] * axes[j, 2]
    return pose_from_rotation(geometry, directions, measured, rotation, position, scratch)


@kernel
def _orthonormalise_span(free: int, span: Array) -> bool:
    """Make the matrices `span[1:free + 1, 3:]` orthonormal and `span[0, 3:]` the least of those that differ by them; False if
    they are linearly dependent.
    """
    for i in range(1, free + 1):
        before = after = 0.0
        for e in range(3, 12):
            before += span[i, e] * span[i, e]
        for j in range(1, i):
            dot = 0.0
            for e in range(3, 12):
                dot += span[i, e] * span[j, e]
            for e in range(3, 12):
                span[i, e] -= dot * span[j, e]
        for e in range(3, 12):
            after += span[i, e] * span[i, e]
        if not after > RANK_TOLERANCE**2 * before:
            return False
        size = 1.0 / np.sqrt(after)
        dot = 0.0
        for e in range(3, 12):
            span[i, e] *= size
            dot += span[0, e] * span[i, e]
        for e in range(3, 12):
            span[0, e] -= dot * span[i, e]
    return True


@kernel
def _settle_columns(scratch: Record) -> float:
    """Find two orthonormal columns among `span[0, 3:] + t span[1, 3:]`, and write them to the former.

    Their three equations `a t^2 + b t + c = 0` have one root in common. Started from both roots of the equation in which they
    are added up by their leading coefficients, Gauss-Newton steps meet it at least once; the worse fit is the second root.
    Returns the sine of the angle between a and b: if those are parallel, the other root fits as well.
    """
    span, c, b, a = scratch.span, scratch.right, scratch.norms, scratch.order
    _write_equations(span[0, 3:], span[0, 3:], 1.0, -1.0, -1.0, _COLUMN_EQUATIONS, c)
    _write_equations(span[0, 3:], span[1, 3:], 2.0, -1.0, 0.0, _COLUMN_EQUATIONS, b)
    _write_equations(span[1, 3:], span[1, 3:], 1.0, 0.0, 0.0, _COLUMN_EQUATIONS, a)
    aa, bb = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    ab, ac = a[0] * b[0] + a[1] * b[1] + a[2] * b[2], a[0] * c[0] + a[1] * c[1] + a[2] * c[2]
    step = np.sqrt(max(0.25 * ab * ab - aa * ac, 0.0)) / aa
    least, best, other = np.inf, 0.0, 0.0
    for start in (step - 0.5 * ab / aa, -step - 0.5 * ab / aa):
        t, misfit = start, 0.0
        for _ in range(_COLUMN_STEPS):
            down = slope = misfit = 0.0
            for i in range(_COLUMN_EQUATIONS):
                value, rise = (a[i] * t + b[i]) * t + c[i], 2.0 * a[i] * t + b[i]
                down += value * rise
                slope += rise * rise
                misfit += value * value
            if slope > 0.0:
                t -= down / slope
        if misfit < least:
            least, best, other = misfit, t, best
        else:
            other = t
    scratch.roots = 2
    for e in range(3, 12):
        scratch.second_root[e] = span[0, e] + other * span[1, e]
        span[0, e] += best * span[1, e]
    return float(np.sqrt(max(aa * bb - ab * ab, 0.0) / (aa * max(aa, bb))))


@kernel
def _settle_rotation(free: int, scratch: Record) -> float:
    """Find the rotation among `span[0, 3:] + sum of t_i span[i, 3:]`, i = 1..free, and write it to the former.

    Linear in the parameters t and their products, of which there are `free (free + 3) / 2` together.
    """
    matrix, right, unknowns, span = scratch.matrix, scratch.right, scratch.unknowns, scratch.span
    equations = _ROTATION_EQUATIONS
    _write_equations(span[0, 3:], span[0, 3:], -1.0, 1.0, 1.0, equations, right)
    column = free
    for i in range(1, free + 1):
        _write_equations(span[0, 3:], span[i, 3:], 2.0, -1.0, 0.0, equations, matrix[:, i - 1])
        for j in range(i, free + 1):
            _write_equations(span[i, 3:], span[j, 3:], 1.0 if i == j else 2.0, 0.0, 0.0, equations, matrix[:, column])
            column += 1
    conditioning = solve_least_squares(matrix, right, equations, unknowns[:column], scratch.norms, scratch.order)
    if conditioning >= RANK_TOLERANCE:
        for i in range(1, free + 1):
            for e in range(3, 12):
                span[0, e] += unknowns[i - 1] * span[i, e]
    return conditioning


@kernel
def _write_equations(
    a: Array, b: Array, quadratic: float, linear: float, constant: float, equations: int, out: Array
) -> None:  # fmt: skip
    """Write `quadratic` Q(a, b) + `linear` L(b) + `constant` c, where a rotation r of columns r1, r2, r3 (9,) obeys
    Q(r, r) = L(r) + c: its columns are orthonormal, each is the cross product of the others, and R R^T = I.

    The first three equations hold for the first two columns alone; the one left out follows from the others.
    """
    out[0] = quadratic * (a[0] * b[0] + a[1] * b[1] + a[2] * b[2]) + constant
    out[1] = quadratic * 0.5 * (a[0] * b[3] + a[1] * b[4] + a[2] * b[5] + a[3] * b[0] + a[4] * b[1] + a[5] * b[2])
    out[2] = quadratic * (a[3] * b[3] + a[4] * b[4] + a[5] * b[5]) + constant
    if equations == _COLUMN_EQUATIONS:
        return
    out[3] = quadratic * 0.5 * (a[0] * b[6] + a[1] * b[7] + a[2] * b[8] + a[6] * b[0] + a[7] * b[1] + a[8] * b[2])
    out[4] = quadratic * 0.5 * (a[3] * b[6] + a[4] * b[7] + a[5] * b[8] + a[6] * b[3] + a[7] * b[4] + a[8] * b[5])
    out[5] = quadratic * (a[6] * b[6] + a[7] * b[7] + a[8] * b[8]) + constant
    for column in range(3):
        i, j, k = 3 * column, 3 * ((column + 1) % 3), 3 * ((column + 2) % 3)
        for n in range(3):
            m, o = (n + 1) % 3, (n + 2) % 3
            cross = a[i + m] * b[j + o] - a[i + o] * b[j + m] + b[i + m] * a[j + o] - b[i + o] * a[j + m]
            out[6 + i + n] = quadratic * 0.5 * cross + linear * b[k + n]
    out[15] = quadratic * (a[0] * b[0] + a[3] * b[3] + a[6] * b[6]) + constant
    out[16] = quadratic * 0.5 * (a[0] * b[1] + a[3] * b[4] + a[6] * b[7] + a[1] * b[0] + a[4] * b[3] + a[7] * b[6])
    out[17] = quadratic * 0.5 * (a[0] * b[2] + a[3] * b[5] + a[6] * b[8] + a[2] * b[0] + a[5] * b[3] + a[8] * b[6])
    out[18] = quadratic * (a[1] * b[1] + a[4] * b[4] + a[7] * b[7]) + constant
    out[19] = quadratic * 0.5 * (a[1] * b[2] + a[4] * b[5] + a[7] * b[8] + a[2] * b[1] + a[5] * b[4] + a[8] * b[7])


@kernel
def orthonormalise(columns: Array, flat: bool) -> float:
    """Replace three columns (9,) by the nearest rotation, by Newton's iteration for the polar decomposition; `flat` means
    that the third is still to be made from the others. Returns how far they were from it, -1 if there is none.
    """
    x0, x1, x2, y0, y1, y2, z0, z1, z2 = (
        columns[0], columns[1], columns[2], columns[3], columns[4], columns[5], columns[6], columns[7], columns[8],
    )  # fmt: skip
    if flat:
        z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        size = np.sqrt(z0 * z0 + z1 * z1 + z2 * z2)
        if not size > RANK_TOLERANCE:
            return -1.0
        z0, z1, z2 = z0 / size, z1 / size, z2 / size
        columns[6], columns[7], columns[8] = z0, z1, z2
    for _ in range(_MOST_POLAR_STEPS):
        # The matrix of cofactors, which over the determinant is the inverse transposed.
        a0, a1, a2 = y1 * z2 - y2 * z1, y2 * z0 - y0 * z2, y0 * z1 - y1 * z0
        b0, b1, b2 = z1 * x2 - z2 * x1, z2 * x0 - z0 * x2, z0 * x1 - z1 * x0
        c0, c1, c2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
        determinant = x0 * a0 + x1 * a1 + x2 * a2
        if not determinant > RANK_TOLERANCE:
            return -1.0
        f = 0.5 / determinant
        dx0, dx1, dx2 = f * a0 - 0.5 * x0, f * a1 - 0.5 * x1, f * a2 - 0.5 * x2
        dy0, dy1, dy2 = f * b0 - 0.5 * y0, f * b1 - 0.5 * y1, f * b2 - 0.5 * y2
        dz0, dz1, dz2 = f * c0 - 0.5 * z0, f * c1 - 0.5 * z1, f * c2 - 0.5 * z2
        x0, x1, x2, y0, y1, y2 = x0 + dx0, x1 + dx1, x2 + dx2, y0 + dy0, y1 + dy1, y2 + dy2
        z0, z1, z2 = z0 + dz0, z1 + dz1, z2 + dz2
        change = dx0 * dx0 + dx1 * dx1 + dx2 * dx2 + dy0 * dy0 + dy1 * dy1 + dy2 * dy2 + dz0 * dz0 + dz1 * dz1 + dz2 * dz2
        if change < _POLAR_TOLERANCE:
            break
    distance = (
        (columns[0] - x0) ** 2 + (columns[1] - x1) ** 2 + (columns[2] - x2) ** 2 + (columns[3] - y0) ** 2
        + (columns[4] - y1) ** 2 + (columns[5] - y2) ** 2 + (columns[6] - z0) ** 2 + (columns[7] - z1) ** 2
        + (columns[8] - z2) ** 2
    )  # fmt: skip
    columns[0], columns[1], columns[2] = x0, x1, x2
    columns[3], columns[4], columns[5] = y0, y1, y2
    columns[6], columns[7], columns[8] = z0, z1, z2
    return float(np.sqrt(distance))
