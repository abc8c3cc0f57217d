"""The compiled solver: reads what was measured of a pose, tries closed forms, refines, and decides between two roots.

It never raises: `spatial` makes an error from the status with which a row ends.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics.geometry import SCRATCH
from controller.direct_kinematics.legs_alone import nearest_rotation, pose_from_legs, second_pose_from_legs
from controller.direct_kinematics.legs_and_attitude import pose_from_rotation, pose_from_vector
from controller.direct_kinematics.refinement import information_at, move_pose, right_side_at
from controller.direct_kinematics.shared_joints import section_3_1_1, section_4
from controller.inverse_kinematics import legs_at
from controller.least_squares import invert_symmetric
from plant.compiled import Record, kernel, record_dtype
from plant.mechanism import LEGS
from plant.pose import UNIT_TOLERANCE, Array
from plant.vectors import Vector, dot, rotate, rotate_back, scale, vector

METHODS = ("section-5", "up", "normal", "legs", "section-3.1.1", "section-4")
"""The closed forms: those of the paper's sections, and those from all legs with the vertical, the normal, or nothing else."""

_SECTION_5, _UP, _NORMAL, _LEGS, _SECTION_3_1_1, _SECTION_4 = range(len(METHODS))

LEAST_CONDITIONING = 1e-6  # below which the measurements count as singular
_GOOD_CONDITIONING = 1e-2
_MOST_MISFIT = 0.2  # distance from a rotation, in its nine elements, beyond which what `legs` gives fits noise

_DISTINCT, _DISTINCT_SHARE = 25.0, 400.0
"""One of two roots is the pose if their chi-square sums differ by the first number, which noise does once in three million
times, or by the second number times the better sum over its degrees of freedom, if the noise is far below the sigmas."""

_SAME_ROTATION = 1e-6
_MOST_REFINEMENTS = 21
_REFINED = 1e-14  # square of a step over its variance at which the pose has settled
_FAST = 1e-4  # share of the square before, up to which the steps get shorter as fast as if each had its own covariance
_SHORT = 3e-3  # step, over the joints' spread or in radians, after which the same is true
_TINY = 1e-9  # step, over the joints' spread or in radians, that may be no more than rounding

SOLVED, REFUSED, OPEN, SINGULAR, UNSETTLED, NEGATIVE, AMBIGUOUS = range(7)  # statuses of a row


class Measurements(NamedTuple):
    """What was measured of N poses; an array without rows was not measured. The weights are inverse variances."""

    directions: Array  # (N, 6, 3)
    rotations: Array  # (N, 3, 3) or (0, 3, 3)
    ups: Array  # (N, 3) or (0, 3)
    normals: Array  # (N, 3) or (0, 3)
    axes: Array  # (3, 3), orthonormal rows in {1}, the first of which is the vertical
    leg_weight: float
    tilt_weight: float
    yaw_weight: float


class Results(NamedTuple):
    """The arrays of `Solutions`. They are few, because each costs 0.2 us in a call from Python."""

    positions: Array
    rotations: Array
    covariances: Array
    residuals: Array
    numbers: Array  # (2, N), chi-square sums and conditionings
    integers: NDArray[np.int64]  # (3, N), statuses, degrees of freedom and methods


WORK = record_dtype(
    scratch=SCRATCH,
    directions=(np.float64, (LEGS, 3)),
    measured=(np.float64, LEGS),
    weights=(np.float64, LEGS),
    measured_rotation=(np.float64, (3, 3)),
    in_base=(np.float64, (5, 3)),
    in_platform=(np.float64, (5, 3)),
    vector_weights=(np.float64, 5),
    refused=np.int64,  # whether a measurement is no unit vector or no rotation
    vectors=np.int64,  # how many are known in both frames
    up=np.int64,  # row of the vectors
    normal=np.int64,  # row of the vectors
    equations=np.int64,
    position=(np.float64, 3),
    rotation=(np.float64, (3, 3)),
    best_position=(np.float64, 3),
    best_rotation=(np.float64, (3, 3)),
    second_position=(np.float64, 3),
    second_rotation=(np.float64, (3, 3)),
    arms=(np.float64, (LEGS, 3)),
    predicted=(np.float64, (LEGS, 3)),
    lengths=(np.float64, LEGS),
    information=(np.float64, (6, 6)),
    covariance=(np.float64, (6, 6)),
    correction=(np.float64, 6),
)
"""Memory for one pose: what was measured, the pose, and its fit."""


@kernel
def solve_rows(
    geometry_array: Record, work_array: Record, measurements: Measurements, candidates: NDArray[np.int64], refine: bool,
    results: Results, start: int, stop: int,
) -> None:  # fmt: skip
    """Solve the rows from `start` to `stop`; of a row without a pose, the status says why."""
    geometry, work = geometry_array[()], work_array[()]
    statuses, degrees_of_freedom, methods = results.integers[0], results.integers[1], results.integers[2]
    chi_squares, conditionings = results.numbers[0], results.numbers[1]
    for row in range(start, stop):
        _read(measurements, row, work)
        methods[row], conditionings[row], degrees_of_freedom[row], chi_squares[row] = 0, 0.0, 0, np.nan
        if work.refused != 0:
            statuses[row] = REFUSED
            _write_nothing(row, results)
            continue
        method, conditioning = _find(geometry, candidates, work)
        methods[row], conditionings[row] = method, conditioning
        if not conditioning > LEAST_CONDITIONING:
            statuses[row] = OPEN
            _write_nothing(row, results)
            continue
        # If the joints are only nearly coplanar, the closed form that takes them for coplanar is a start, not the pose.
        settle = refine or (method == _LEGS and work.scratch.approximate != 0)
        two_roots = settle and method == _LEGS and work.scratch.roots == 2
        status, chi_square = _fit_better(geometry, work) if two_roots else _fit(geometry, settle, work)
        statuses[row] = status
        if status == SOLVED:
            chi_squares[row], degrees_of_freedom[row] = chi_square, work.equations - 6
            _write(work, row, results)
        else:
            _write_nothing(row, results)


@kernel
def _read(measurements: Measurements, row: int, work: Record) -> None:
    """Read what was measured of a pose: directions at unit length, and the vectors that are known in both frames."""
    work.refused = 0
    work.vectors = 0
    work.equations = 0
    for k in range(LEGS):
        given = vector(measurements.directions[row, k])
        measured = not (np.isnan(given[0]) and np.isnan(given[1]) and np.isnan(given[2]))
        direction = _unit(given, work) if measured else (0.0, 0.0, 1.0)
        work.directions[k, 0], work.directions[k, 1], work.directions[k, 2] = direction
        work.measured[k] = 1.0 if measured else 0.0
        work.weights[k] = work.measured[k] * measurements.leg_weight
        work.equations += 2 * int(measured)
    if measurements.rotations.shape[0] > 0:
        _read_rotation(measurements.rotations, row, work)
        # These weights add up to the yaw's about the vertical, and to the tilt's about every level axis.
        yaw = 0.5 * measurements.yaw_weight
        for i in range(3):
            axis = vector(measurements.axes[i])
            weight = measurements.tilt_weight - yaw if i == 0 else yaw
            _add_vector(work, axis, rotate_back(work.measured_rotation, axis), weight)
        work.equations += 3
    work.up = work.vectors
    if measurements.ups.shape[0] > 0:
        _add_vector(work, vector(measurements.axes[0]), _unit(vector(measurements.ups[row]), work), measurements.tilt_weight)
        work.equations += 2
    work.normal = work.vectors
    if measurements.normals.shape[0] > 0:
        _add_vector(work, _unit(vector(measurements.normals[row]), work), (0.0, 0.0, 1.0), measurements.tilt_weight)
        work.equations += 2


@kernel
def _read_rotation(rotations: Array, row: int, work: Record) -> None:
    """Read the rotation nearest to a measured one. Its rows are the columns of the one that is nearest to the transposed."""
    x, y, z = vector(rotations[row, 0]), vector(rotations[row, 1]), vector(rotations[row, 2])
    orthogonal = _is_orthogonal(rotations[row])
    found, x, y, z = nearest_rotation(x, y, z)
    if not orthogonal or not found:
        work.refused = 1
    for i in range(3):
        work.measured_rotation[0, i], work.measured_rotation[1, i], work.measured_rotation[2, i] = x[i], y[i], z[i]


@kernel
def _unit(given: Vector, work: Record) -> Vector:
    size = np.sqrt(dot(given, given))
    if not abs(size - 1.0) <= UNIT_TOLERANCE:
        work.refused = 1
    return scale(1.0 / size, given)


@kernel
def _is_orthogonal(matrix: Array) -> bool:
    for i in range(3):
        for j in range(3):
            product = matrix[0, i] * matrix[0, j] + matrix[1, i] * matrix[1, j] + matrix[2, i] * matrix[2, j]
            if not abs(product - (1.0 if i == j else 0.0)) <= UNIT_TOLERANCE:
                return False
    return True


@kernel
def _add_vector(work: Record, in_base: Vector, in_platform: Vector, weight: float) -> None:
    for i in range(3):
        work.in_base[work.vectors, i] = in_base[i]
        work.in_platform[work.vectors, i] = in_platform[i]
    work.vector_weights[work.vectors] = weight
    work.vectors += 1


@kernel
def _find(geometry: Record, candidates: NDArray[np.int64], work: Record) -> tuple[int, float]:
    """Find the pose by the first method that is well conditioned, else by the best; returns the method and its conditioning."""
    best, chosen = 0.0, candidates[0]
    for method in candidates:
        conditioning = _apply(geometry, method, work)
        if conditioning > best:
            best, chosen = conditioning, method
            _copy_pose(work.position, work.rotation, work.best_position, work.best_rotation)
        if best > _GOOD_CONDITIONING:
            break
    _copy_pose(work.best_position, work.best_rotation, work.position, work.rotation)
    return chosen, best


@kernel
def _copy_pose(position: Array, rotation: Array, to_position: Array, to_rotation: Array) -> None:
    for i in range(3):
        to_position[i] = position[i]
        for j in range(3):
            to_rotation[i, j] = rotation[i, j]


@kernel
def _apply(geometry: Record, method: int, work: Record) -> float:
    """Find the pose by a closed form; returns the conditioning."""
    directions, measured, position, rotation = work.directions, work.measured, work.position, work.rotation
    if method == _SECTION_5:
        _copy_pose(position, work.measured_rotation, position, rotation)
        return pose_from_rotation(geometry, directions, measured, rotation, position, work.scratch)
    if method == _LEGS:
        conditioning = pose_from_legs(geometry, directions, measured, position, rotation, work.scratch)
        return conditioning if work.scratch.misfit < _MOST_MISFIT else 0.0
    if method == _SECTION_3_1_1:
        return section_3_1_1(geometry, directions, measured, position, rotation, work.scratch)
    k = work.up if method == _UP else work.normal
    in_base, in_platform = work.in_base[k], work.in_platform[k]
    if method == _SECTION_4:
        return section_4(geometry, directions, measured, in_base, in_platform, position, rotation, work.scratch)
    return pose_from_vector(geometry, directions, measured, in_base, in_platform, position, rotation, work.scratch)


@kernel
def _fit(geometry: Record, refine: bool, work: Record) -> tuple[int, float]:
    """Refine the pose, if wanted, and weigh its residuals; returns a status and their chi-square sum."""
    base_joints, platform_joints = geometry.base_joints, geometry.platform_joints
    position, rotation, vector_weights = work.position, work.rotation, work.vector_weights[: work.vectors]
    status, before, fresh, spread = UNSETTLED if refine else SOLVED, np.inf, True, geometry.spreads[-1]
    for _ in range(_MOST_REFINEMENTS if refine else 1):
        legs_at(base_joints, platform_joints, position, rotation, work.arms, work.predicted, work.lengths)
        if fresh:
            information_at(
                work.weights, work.in_platform, vector_weights, rotation, work.arms, work.predicted, work.lengths,
                work.information,
            )  # fmt: skip
            if not invert_symmetric(work.information, work.covariance):
                return SINGULAR, np.inf
        if not refine:
            break
        right_side_at(
            work.directions, work.weights, work.in_base, work.in_platform, vector_weights, rotation, work.arms, work.predicted,
            work.lengths, work.correction,
        )  # fmt: skip
        square = _step(work.covariance, work.correction)
        move_pose(work.correction, position, rotation)
        longest = _longest(work.correction, spread)
        if fresh and (square < _REFINED or (square >= before and longest < _TINY)):
            status = SOLVED
            break
        # The covariance serves for one more step where it changes much less than the pose, unless that step is the last.
        first, last = before == np.inf, square * square < _REFINED * before
        fresh = longest > _SHORT or not (first or (square < _FAST * before and not last))
        before = square
    if refine:
        legs_at(base_joints, platform_joints, position, rotation, work.arms, work.predicted, work.lengths)
    chi_square = 0.0
    for k in range(LEGS):
        if work.measured[k] == 0.0:
            continue
        for i in range(3):
            chi_square += work.weights[k] * (work.directions[k, i] - work.predicted[k, i]) ** 2
        if status == SOLVED and not dot(vector(work.directions[k]), vector(work.predicted[k])) > 0.0:
            status = NEGATIVE
    for k in range(work.vectors):
        seen = rotate(rotation, vector(work.in_platform[k]))
        for i in range(3):
            chi_square += vector_weights[k] * (seen[i] - work.in_base[k, i]) ** 2
    return status, chi_square


@kernel
def _fit_better(geometry: Record, work: Record) -> tuple[int, float]:
    """Refine the pose at both roots of the legs alone and keep the better one, if it is far better; returns its status and
    chi-square sum.
    """
    position, rotation = work.position, work.rotation
    _copy_pose(position, rotation, work.best_position, work.best_rotation)
    second_pose_from_legs(geometry, work.directions, work.measured, position, rotation, work.scratch)
    second_status, second_chi_square = _fit(geometry, True, work)
    _copy_pose(position, rotation, work.second_position, work.second_rotation)
    _copy_pose(work.best_position, work.best_rotation, position, rotation)
    status, chi_square = _fit(geometry, True, work)
    if second_status != SOLVED:
        return status, chi_square
    if status == SOLVED:
        apart = 0.0
        for i in range(3):
            for j in range(3):
                apart = max(apart, abs(rotation[i, j] - work.second_rotation[i, j]))
        if apart <= _SAME_ROTATION:
            return status, chi_square
        least = min(chi_square, second_chi_square)
        if abs(chi_square - second_chi_square) < min(_DISTINCT, _DISTINCT_SHARE * least / max(work.equations - 6, 1)):
            return AMBIGUOUS, chi_square
        if chi_square < second_chi_square:
            return status, chi_square
    _copy_pose(work.second_position, work.second_rotation, position, rotation)
    return _fit(geometry, True, work)


@kernel
def _write(work: Record, row: int, results: Results) -> None:
    _copy_pose(work.position, work.rotation, results.positions[row], results.rotations[row])
    for k in range(LEGS):
        for i in range(3):
            residual = work.directions[k, i] - work.predicted[k, i]
            results.residuals[row, k, i] = residual if work.measured[k] != 0.0 else np.nan
    for i in range(6):
        for j in range(6):
            results.covariances[row, i, j] = work.covariance[i, j]


@kernel
def _write_nothing(row: int, results: Results) -> None:
    """Write NaN for a row without a pose."""
    for i in range(3):
        results.positions[row, i] = np.nan
        for j in range(3):
            results.rotations[row, i, j] = np.nan
    for k in range(LEGS):
        for i in range(3):
            results.residuals[row, k, i] = np.nan
        for j in range(6):
            results.covariances[row, k, j] = np.nan


@kernel
def _longest(step: Array, spread: float) -> float:
    """The greatest component of a step, over the joints' spread or in radians."""
    moved = max(abs(step[0]), abs(step[1]), abs(step[2])) / spread
    return float(max(moved, abs(step[3]), abs(step[4]), abs(step[5])))


@kernel
def _step(covariance: Array, right: Array) -> float:
    """Replace the right side (6,) of normal equations by their solution x; returns the square of x over its variance."""
    r0, r1, r2, r3, r4, r5 = right[0], right[1], right[2], right[3], right[4], right[5]
    square = 0.0
    for i in range(6):
        c = covariance[i]
        x = c[0] * r0 + c[1] * r1 + c[2] * r2 + c[3] * r3 + c[4] * r4 + c[5] * r5
        square += x * right[i]
        right[i] = x
    return square
