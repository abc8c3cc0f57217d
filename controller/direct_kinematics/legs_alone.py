"""Closed form from leg directions alone, four legs or more, of every class (`docs/direct_kinematics.md`).

The legs' equations are linear in p and R. Their rank follows from the graph of the legs. Rotations obey twenty quadratic
equations, which are linear in the parameters that the legs leave open and in the products of these parameters. So up to five
open parameters can be found, with coplanar platform joints or not.

Every function returns the conditioning, as in `legs_and_attitude`.
"""

import numpy as np

from controller.direct_kinematics.geometry import MOST_FREE, ROTATION_EQUATIONS, across, across_leg, set_number
from controller.direct_kinematics.legs_and_attitude import pose_from_rotation
from controller.least_squares import (
    RANK_TOLERANCE,
    WELL_CONDITIONED,
    Symmetric,
    solve_least_squares,
    solve_nine,
    solve_truncated,
)
from plant.compiled import Record, kernel, shared_kernel
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import Vector, add, cross, dot, scale, subtract, vector

_FLATNESS = 1e-3
"""Platform joints count as coplanar if they leave their plane by less than this share of their spread. The refinement makes
up for the difference if it starts near enough."""

_FLAT = 1e-13  # such a share that is no more than rounding
# Least conditioning over that share: more than a tenth of a radian away, the refinement may find another pose.
_LEAST_FLAT_CONDITIONING = 10.0

_COLUMN_EQUATIONS = 3
_COLUMN_STEPS = 5
_MOST_POLAR_STEPS = 30
_POLAR_TOLERANCE = 1e-18  # square of the last step; the error left after it is the square of that step


@shared_kernel
def pose_from_legs(
    geometry: Record, directions: Array, measured: Array, position: Array, rotation: Array, scratch: Record
) -> float:
    """Pose from leg directions alone, four legs or more; of two roots, the one that fits better."""
    legs = set_number(measured)
    if geometry.ranks[legs] < 12 - MOST_FREE:
        return 0.0
    bulge = geometry.bulges[legs]
    if bulge <= _FLATNESS:
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
    columns = scratch.second_root[3:]
    return _pose_from_columns(geometry, directions, measured, set_number(measured), True, columns, position, rotation, scratch)


@kernel
def _pose_from_legs(
    geometry: Record, directions: Array, measured: Array, legs: int, flat: bool, position: Array, rotation: Array,
    scratch: Record,
) -> float:  # fmt: skip
    """Pose from a set of legs, with coplanar joints or not.

    The unknowns are the joints' centre and columns of R times the spread: those that turn the axes of the joints' plane if the
    joints are coplanar, all three if not.
    """
    span, per_spread = scratch.span, 1.0 / geometry.spreads[legs]
    unknowns, rank = 9 if flat else 12, geometry.ranks[legs]
    free = unknowns - rank
    span[:] = 0.0
    solution, null_space = span[0, :unknowns], span[1:, :unknowns]
    conditioning = 0.0
    if flat:
        _write_normal_equations(geometry, directions, measured, legs, scratch.matrix)
        conditioning = solve_nine(scratch.matrix, rank, solution, null_space, scratch.norms, scratch.order)
    if conditioning < WELL_CONDITIONED:
        rows = _write_rows(geometry, directions, measured, legs, unknowns, scratch)
        conditioning = solve_truncated(
            scratch.matrix, scratch.right, rows, rank, solution, null_space, scratch.norms, scratch.order
        )  # fmt: skip
    if conditioning < RANK_TOLERANCE:
        return conditioning
    columns = span[0, 3:]
    for i in range(9):
        columns[i] *= per_spread
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
def _write_rows(geometry: Record, directions: Array, measured: Array, legs: int, unknowns: int, scratch: Record) -> int:
    """Write the equations of a set of legs for QR; returns how many there are."""
    matrix, right, rows = scratch.matrix, scratch.right, 0
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        place, base = _place(geometry, k, legs), vector(geometry.base_joints[k])
        for w in across(directions[k]):
            for i in range(unknowns // 3):
                x = place[i - 1] if i > 0 else 1.0
                for j in range(3):
                    matrix[rows, 3 * i + j] = x * w[j]
            right[rows] = dot(w, base)
            rows += 1
    return rows


@kernel
def _place(geometry: Record, k: int, legs: int) -> Vector:
    """Where a platform joint is from the centre of those of a set of legs, along their axes, over their spread."""
    axes, per_spread = geometry.axes[legs], 1.0 / geometry.spreads[legs]
    x, y, z = subtract(vector(geometry.platform_joints[k]), vector(geometry.centers[legs]))
    return (
        per_spread * (axes[0, 0] * x + axes[1, 0] * y + axes[2, 0] * z),
        per_spread * (axes[0, 1] * x + axes[1, 1] * y + axes[2, 1] * z),
        per_spread * (axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z),
    )


@kernel
def _write_normal_equations(geometry: Record, directions: Array, measured: Array, legs: int, matrix: Array) -> None:
    """Write the normal equations of a set of legs with coplanar joints. A leg to the place x, y from the base joint b counts
    [1, x, y]^T [1, x, y] in blocks P = I - d d^T, and [1, x, y]^T P b on the right side.
    """
    zero = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    one_one = x_one = y_one = x_x = x_y = y_y = zero
    one_b = x_b = y_b = (0.0, 0.0, 0.0)
    for k in range(LEGS):
        if measured[k] == 0.0:
            continue
        d0, d1, d2 = direction = vector(directions[k])
        x, y, _ = _place(geometry, k, legs)
        b = across_leg(direction, vector(geometry.base_joints[k]))
        p = 1.0 - d0 * d0, -d1 * d0, 1.0 - d1 * d1, -d2 * d0, -d2 * d1, 1.0 - d2 * d2
        one_one, x_one, y_one = _plus(one_one, 1.0, p), _plus(x_one, x, p), _plus(y_one, y, p)
        x_x, x_y, y_y = _plus(x_x, x * x, p), _plus(x_y, x * y, p), _plus(y_y, y * y, p)
        one_b, x_b, y_b = add(one_b, b), add(x_b, scale(x, b)), add(y_b, scale(y, b))
    _put(matrix, 0, 0, one_one)
    _put(matrix, 0, 3, x_one)
    _put(matrix, 3, 0, x_one)
    _put(matrix, 0, 6, y_one)
    _put(matrix, 6, 0, y_one)
    _put(matrix, 3, 3, x_x)
    _put(matrix, 3, 6, x_y)
    _put(matrix, 6, 3, x_y)
    _put(matrix, 6, 6, y_y)
    for i in range(3):
        matrix[i, 9], matrix[3 + i, 9], matrix[6 + i, 9] = one_b[i], x_b[i], y_b[i]


@kernel
def _plus(a: Symmetric, factor: float, b: Symmetric) -> Symmetric:
    """A + `factor` b."""
    return (
        a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2],
        a[3] + factor * b[3], a[4] + factor * b[4], a[5] + factor * b[5],
    )  # fmt: skip


@kernel
def _put(matrix: Array, row: int, column: int, block: Symmetric) -> None:
    """Write a symmetric block (3, 3) into a matrix."""
    xx, yx, yy, zx, zy, zz = block
    matrix[row, column], matrix[row, column + 1], matrix[row, column + 2] = xx, yx, zx
    matrix[row + 1, column], matrix[row + 1, column + 1], matrix[row + 1, column + 2] = yx, yy, zy
    matrix[row + 2, column], matrix[row + 2, column + 1], matrix[row + 2, column + 2] = zx, zy, zz


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
    """Make the matrices `span[1:free + 1, 3:]` orthonormal, `span[0, 3:]` orthogonal to them; False if they are dependent."""
    for i in range(1, free + 1):
        before = after = 0.0
        for e in range(3, 12):
            before += span[i, e] * span[i, e]
        for j in range(1, i):
            share = 0.0
            for e in range(3, 12):
                share += span[i, e] * span[j, e]
            for e in range(3, 12):
                span[i, e] -= share * span[j, e]
        for e in range(3, 12):
            after += span[i, e] * span[i, e]
        if not after > RANK_TOLERANCE**2 * before:
            return False
        size = 1.0 / np.sqrt(after)
        share = 0.0
        for e in range(3, 12):
            span[i, e] *= size
            share += span[0, e] * span[i, e]
        for e in range(3, 12):
            span[0, e] -= share * span[i, e]
    return True


@kernel
def _settle_columns(scratch: Record) -> float:
    """Find two orthonormal columns among `span[0, 3:] + t span[1, 3:]`, and write them to `span[0, 3:]`.

    Their three equations `a t^2 + b t + c = 0` have one root in common. Gauss-Newton steps start from both roots of the
    equations' sum weighted by a, and meet the common root at least once. The worse fit is the second root.
    Returns the sine of the angle between a and b: if those are parallel, the other root fits as well.
    """
    span, c, b, a = scratch.span, scratch.right, scratch.norms, scratch.order
    _write_equations(span[0, 3:], span[0, 3:], 1.0, -1.0, -1.0, _COLUMN_EQUATIONS, c)
    _write_equations(span[0, 3:], span[1, 3:], 2.0, -1.0, 0.0, _COLUMN_EQUATIONS, b)
    _write_equations(span[1, 3:], span[1, 3:], 1.0, 0.0, 0.0, _COLUMN_EQUATIONS, a)
    aa, bb, ab, ac = dot(vector(a), vector(a)), dot(vector(b), vector(b)), dot(vector(a), vector(b)), dot(vector(a), vector(c))
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
    """Find the rotation among `span[0, 3:] + sum of t_i span[i, 3:]`, i = 1..free, and write it to `span[0, 3:]`.

    The equations are linear in the parameters t and their products, `free (free + 3) / 2` unknowns in all.
    """
    matrix, right, unknowns, span = scratch.matrix, scratch.right, scratch.unknowns, scratch.span
    equations = ROTATION_EQUATIONS
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
def _write_equations(a: Array, b: Array, quadratic: float, linear: float, constant: float, equations: int, out: Array) -> None:
    """Write `quadratic` Q(a, b) + `linear` L(b) + `constant` c, where a rotation r of columns r1, r2, r3 (9,) obeys
    Q(r, r) = L(r) + c: its columns are orthonormal, each is the cross product of the others, and R R^T = I.

    The first three equations hold for the first two columns alone. The twenty-first equation follows from the others.
    """
    row = 0
    for j in range(3):
        for i in range(j + 1):
            out[row] = quadratic * _product(a, b, 3 * i, 3 * j, 1)
            if i == j:
                out[row] += constant
            row += 1
        if row == equations:
            return
    for column in range(3):
        i, j, k = 3 * column, 3 * ((column + 1) % 3), 3 * ((column + 2) % 3)
        for n in range(3):
            m, o = (n + 1) % 3, (n + 2) % 3
            turned = a[i + m] * b[j + o] - a[i + o] * b[j + m] + b[i + m] * a[j + o] - b[i + o] * a[j + m]
            out[row] = quadratic * 0.5 * turned + linear * b[k + n]
            row += 1
    for i in range(2):
        for j in range(i, 3):
            out[row] = quadratic * _product(a, b, i, j, 3)
            if i == j:
                out[row] += constant
            row += 1


@kernel
def _product(a: Array, b: Array, i: int, j: int, step: int) -> float:
    """Inner product of two columns (`step` 1) or rows (`step` 3) from i and j on, the mean of that of a with b and b with a."""
    first = a[i] * b[j] + a[i + step] * b[j + step] + a[i + 2 * step] * b[j + 2 * step]
    if i == j:
        return float(first)
    return float(0.5 * (first + a[j] * b[i] + a[j + step] * b[i + step] + a[j + 2 * step] * b[i + 2 * step]))


@kernel
def orthonormalise(columns: Array, flat: bool) -> float:
    """Replace three columns (9,) by the nearest rotation, by Newton's iteration for the polar decomposition. `flat` means that
    the first two give the third. Returns the distance from that rotation, in the nine elements; -1 if there is none.
    """
    x, y, z = vector(columns[:3]), vector(columns[3:]), vector(columns[6:])
    if flat:
        z = cross(x, y)
        size = np.sqrt(dot(z, z))
        if not size > RANK_TOLERANCE:
            return -1.0
        z = scale(1.0 / size, z)
        columns[6], columns[7], columns[8] = z
    found, x, y, z = nearest_rotation(x, y, z)
    if not found:
        return -1.0
    distance = 0.0
    for i in range(3):
        distance += (columns[i] - x[i]) ** 2 + (columns[3 + i] - y[i]) ** 2 + (columns[6 + i] - z[i]) ** 2
        columns[i], columns[3 + i], columns[6 + i] = x[i], y[i], z[i]
    return float(np.sqrt(distance))


@kernel
def nearest_rotation(x: Vector, y: Vector, z: Vector) -> tuple[bool, Vector, Vector, Vector]:
    """The columns of the rotation nearest to a matrix of these columns, by Newton's iteration; and whether there is one."""
    for _ in range(_MOST_POLAR_STEPS):
        # The matrix of cofactors over the determinant is the inverse transposed.
        a, b, c = cross(y, z), cross(z, x), cross(x, y)
        determinant = dot(x, a)
        if not determinant > RANK_TOLERANCE:
            return False, x, y, z
        f = 0.5 / determinant
        dx, dy = subtract(scale(f, a), scale(0.5, x)), subtract(scale(f, b), scale(0.5, y))
        dz = subtract(scale(f, c), scale(0.5, z))
        x, y, z = add(x, dx), add(y, dy), add(z, dz)
        if dot(dx, dx) + dot(dy, dy) + dot(dz, dz) < _POLAR_TOLERANCE:
            break
    return True, x, y, z
