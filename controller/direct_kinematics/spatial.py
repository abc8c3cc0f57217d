"""Direct kinematics of six legs: the one face of every method, for one pose or many at once.

A closed form gives the pose without a first guess. Gauss-Newton steps follow that weigh legs and platform by their
variances, and whose normal matrix gives the covariance.
"""

import operator
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.direct_kinematics.closed_forms import (
    SCRATCH,
    geometry_of,
    orthonormalise,
    pose_from_legs,
    pose_from_rotation,
    pose_from_vector,
    second_pose_from_legs,
)
from controller.direct_kinematics.paper import section_3_1_1, section_4
from controller.direct_kinematics.refinement import move_pose, normal_equations, solve_normal_equations
from controller.inverse_kinematics import legs_at
from controller.least_squares import invert_cholesky
from plant.compiled import Record, kernel
from plant.errors import GoughError, InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, Pose, numbers, rotation_angle, rotation_from_vector

LEG_SIGMA = np.radians(0.05)
"""Standard deviation that `solve` assumes of each component of a leg's direction [rad]."""

TILT_SIGMA = np.radians(0.05)
"""Standard deviation that `solve` assumes of roll and pitch [rad]."""

YAW_SIGMA = np.radians(1.5)
"""Standard deviation that `solve` assumes of a yaw that was measured magnetically [rad]."""

LEAST_SIGMA = 1e-9
"""Least standard deviation that makes sense of directions in double precision [rad]."""

LEAST_CONDITIONING = 1e-6
"""Conditioning below which the measurements count as singular."""

METHODS = ("section-5", "up", "normal", "legs", "section-3.1.1", "section-4")
"""The closed forms: of the paper's sections, and from all legs with the vertical, the normal, or nothing else."""

_SECTION_5, _UP, _NORMAL, _LEGS, _SECTION_3_1_1, _SECTION_4 = range(len(METHODS))
NEEDS = {"section-5": "rotation", "up": "up_in_platform", "normal": "normal", "section-4": "normal"}
"""What a method needs of the platform; the others need nothing."""

_AUTOMATIC = ("section-5", "up", "normal", "legs")
_GOOD_CONDITIONING = 1e-2

_MOST_MISFIT = 0.2
"""How far from a rotation, in its nine elements, `legs` may come out: further off it is noise that was solved for."""

_DISTINCT, _DISTINCT_SHARE = 25.0, 400.0
"""By how much the chi-square sums of two roots must differ for one to be the pose, which noise does to one in three million;
or by how many times the better sum over its degrees of freedom, where noise is far below the sigmas."""

_SAME_ROTATION = 1e-6
_MOST_REFINEMENTS = 20
_REFINED = 1e-14
"""Square of a step over its variance at which the pose has settled."""

_TINY = 1e-9
"""Step, over the joints' spread or in radians, that may be no more than rounding."""

_CHUNK = 4096

(
    _SOLVED, _OPEN, _SINGULAR, _UNSETTLED, _NEGATIVE, _PARTLY_NAN, _INFINITE, _LEG_NOT_UNIT, _ROTATION_INFINITE,
    _NOT_ORTHOGONAL, _REFLECTION, _UP_NOT_UNIT, _NORMAL_NOT_UNIT, _AMBIGUOUS,
) = range(14)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose found from leg directions. Where another would fit as well, none is given, as far as the refinement can tell.

    Attributes:
        position: (3,) [m], origin of {2} in {1}.
        rotation: (3, 3), maps {2} to {1}.
        covariance: (6, 6) of position [m] and of a small rotation seen in {1} [rad], of the refined pose; one that was not
            refined can be no better.
        residuals: (6, 3), measured minus predicted direction of each leg; NaN where a leg was not measured.
        chi_square: sum of the squared residuals of legs and platform over their variances.
        degrees_of_freedom: what `chi_square` is on average if the variances are right; 0 without redundancy.
        method: the closed form that gave the pose, one of `METHODS`.
        conditioning: reciprocal condition of that closed form, from the pivots of its QR.
    """

    position: Array
    rotation: Array
    covariance: Array
    residuals: Array
    chi_square: float
    degrees_of_freedom: int
    method: str
    conditioning: float


@dataclass(frozen=True, eq=False)
class Solutions:
    """Many poses; `solutions[i]` is a `Solution`, or raises why there is none.

    Attributes:
        positions: (N, 3) [m]; NaN where there is no pose, as in the arrays below.
        rotations: (N, 3, 3).
        covariances: (N, 6, 6).
        residuals: (N, 6, 3).
        chi_squares: (N,).
        degrees_of_freedom: (N,).
        methods: (N,), indices into `METHODS`.
        conditionings: (N,).
        solved: (N,), whether there is a pose.
    """

    positions: Array
    rotations: Array
    covariances: Array
    residuals: Array
    chi_squares: Array
    degrees_of_freedom: NDArray[np.int64]
    methods: NDArray[np.int64]
    conditionings: Array
    solved: NDArray[np.bool_]
    errors: dict[int, GoughError]

    def __len__(self) -> int:
        return len(self.solved)

    def __iter__(self) -> Iterator[Solution]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, index: int) -> Solution:
        """The solution of a row.

        Raises:
            SingularConfigurationError: there is none.
        """
        row = range(len(self))[operator.index(index)]
        if not self.solved[row]:
            raise self.errors[row]
        return Solution(
            self.positions[index], self.rotations[index], self.covariances[index], self.residuals[index],
            float(self.chi_squares[index]), int(self.degrees_of_freedom[index]), METHODS[self.methods[index]],
            float(self.conditionings[index]),
        )  # fmt: skip


def solve(
    mechanism: Mechanism,
    leg_directions: ArrayLike,
    *,
    rotation: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    up_in_platform: ArrayLike | None = None,
    method: str = "auto",
    refine: bool = True,
    leg_sigma: float = LEG_SIGMA,
    tilt_sigma: float = TILT_SIGMA,
    yaw_sigma: float = YAW_SIGMA,
) -> Solution:
    """The pose of the platform from the directions of its legs and what else is known of its attitude.

    Args:
        mechanism: two arrays of joints are enough.
        leg_directions: (6, 3), unit, from base to platform joint, seen in {1}; a row of NaN is a leg not measured.
        rotation: (3, 3), measured roll-pitch-yaw; maps {2} to {1} (the paper's section 5).
        normal: (3,), the z axis of {2} seen in {1} (the paper's section 4).
        up_in_platform: (3,), the vertical seen in {2}: what an accelerometer at rest measures.
        method: one of `METHODS`, or "auto": rotation, vertical, normal or legs alone, whichever comes first in this order,
            is given, and determines the pose well.
        refine: weigh all that is given by its variance; otherwise the pose is that of the closed form.
        leg_sigma: standard deviation of each component of a direction [rad].
        tilt_sigma: of roll and pitch, as the vertical, the normal or the rotation give them [rad].
        yaw_sigma: of the yaw in `rotation` [rad].

    Measurements that contradict each other show in the residuals: `integrity` finds the one that is wrong.

    Raises:
        InputError: wrong shape, not finite, off unit length by more than 1e-3, a reflection, a sigma not positive, an unknown
            method, or one whose measurement is not given.
        SingularConfigurationError: the measurements do not determine the pose.
    """
    given = {"rotation": rotation, "normal": normal, "up_in_platform": up_in_platform}
    shapes = {"rotation": (3, 3), "normal": (3,), "up_in_platform": (3,)}
    arrays = {"leg_directions": _shaped(leg_directions, (LEGS, 3), "leg_directions")[None]}
    arrays |= {name: _shaped(value, shapes[name], name)[None] for name, value in given.items() if value is not None}
    return _solve(mechanism, arrays, method, refine, (leg_sigma, tilt_sigma, yaw_sigma), 1, "")[0]


def solve_batch(
    mechanism: Mechanism,
    leg_directions: ArrayLike,
    *,
    rotation: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    up_in_platform: ArrayLike | None = None,
    method: str = "auto",
    refine: bool = True,
    leg_sigma: float = LEG_SIGMA,
    tilt_sigma: float = TILT_SIGMA,
    yaw_sigma: float = YAW_SIGMA,
    workers: int | None = None,
) -> Solutions:
    """`solve` for N poses, compiled and on all cores; measurements have the shapes (N, 6, 3), (N, 3, 3) and (N, 3).

    Args:
        workers: threads; by default one for each core that this process may use.

    Raises:
        InputError: as `solve`, naming the row. A row whose pose is not determined raises only when it is asked for.
    """
    directions = numbers(leg_directions, "leg_directions", "(N, 6, 3)")
    count = len(directions) if directions.ndim else 0
    given = {"rotation": (rotation, (3, 3)), "normal": (normal, (3,)), "up_in_platform": (up_in_platform, (3,))}
    arrays = {"leg_directions": _shaped(directions, (count, LEGS, 3), "leg_directions")}
    for name, (value, shape) in given.items():
        if value is not None:
            arrays[name] = _shaped(value, (count, *shape), name)
    sigmas = (leg_sigma, tilt_sigma, yaw_sigma)
    return _solve(mechanism, arrays, method, refine, sigmas, _cores() if workers is None else workers, " of row {row}")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def pose_difference(first: Solution | Pose, second: Solution | Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    distance = float(np.linalg.norm(first.position - second.position))
    return distance, float(rotation_angle(first.rotation, second.rotation))


class _Measurements(NamedTuple):
    """What was measured of N poses; arrays without rows were not."""

    directions: Array
    rotations: Array
    ups: Array
    normals: Array
    axes: Array
    leg_weight: float
    tilt_weight: float
    yaw_weight: float


class _Results(NamedTuple):
    positions: Array
    rotations: Array
    covariances: Array
    residuals: Array
    chi_squares: Array
    degrees_of_freedom: NDArray[np.int64]
    methods: NDArray[np.int64]
    conditionings: Array
    statuses: NDArray[np.int64]
    legs: NDArray[np.int64]


def _shaped(value: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    array = numbers(value, name, shape)
    if array.shape != shape:
        raise InputError(f"{name} must have shape {shape}, got {array.shape}")
    return array


def _solve(
    mechanism: Mechanism,
    arrays: dict[str, Array],
    method: str,
    refine: bool,
    sigmas: tuple[float, float, float],
    workers: int,
    where: str,
) -> Solutions:
    _check_spatial(mechanism)
    if not isinstance(refine, bool | np.bool_):
        raise InputError(f"refine must be True or False, got {refine!r}")
    if not isinstance(workers, int) or workers < 1:
        raise InputError(f"workers is {workers!r}; it must be a whole number of threads, 1 at least")
    candidates = _candidates(method, arrays)
    weights = []
    for name, sigma in zip(("leg_sigma", "tilt_sigma", "yaw_sigma"), sigmas, strict=True):
        value = _shaped(sigma, (), name)
        if not LEAST_SIGMA <= value < np.inf:
            raise InputError(f"{name} is {sigma}; it must be at least {LEAST_SIGMA:g} and finite [rad]")
        weights.append(float(value) ** -2)
    count = len(arrays["leg_directions"])
    measurements = _Measurements(
        arrays["leg_directions"], arrays.get("rotation", np.empty((0, 3, 3))), arrays.get("up_in_platform", np.empty((0, 3))),
        arrays.get("normal", np.empty((0, 3))), _axes_about(mechanism.up_in_base), *weights,
    )  # fmt: skip
    results = _Results(
        np.empty((count, 3)), np.empty((count, 3, 3)), np.empty((count, 6, 6)), np.empty((count, LEGS, 3)), np.empty(count),
        np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count), np.empty(count, np.int64),
        np.empty(count, np.int64),
    )  # fmt: skip

    def solve_chunk(start: int) -> None:
        stop = min(start + _CHUNK, count)
        _solve_rows(geometry_of(mechanism), np.zeros((), _WORK), measurements, candidates, refine, results, start, stop)

    starts = range(0, count, _CHUNK)
    if workers == 1 or len(starts) <= 1:
        for start in starts:
            solve_chunk(start)
    else:
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(solve_chunk, starts))
    errors = {
        int(row): _error(mechanism, arrays, method, int(results.statuses[row]), int(row), int(results.legs[row]), where)
        for row in np.flatnonzero(results.statuses != _SOLVED)
    }
    for error in errors.values():
        if isinstance(error, InputError):
            raise error
    return Solutions(*results[:-2], solved=results.statuses == _SOLVED, errors=errors)


def _check_spatial(mechanism: Mechanism) -> None:
    if not isinstance(mechanism, Mechanism):
        raise InputError(f"the mechanism must be a Mechanism of six legs, not a {type(mechanism).__name__}")


def _candidates(method: str, arrays: dict[str, Array]) -> NDArray[np.int64]:
    if isinstance(method, str) and method == "auto":
        names = [name for name in _AUTOMATIC if name not in NEEDS or NEEDS[name] in arrays]
    elif not isinstance(method, str) or method not in METHODS:
        raise InputError(f"there is no method {method!r}; there are auto, {', '.join(METHODS)}")
    elif NEEDS.get(method, "leg_directions") not in arrays:
        raise InputError(f"the method {method!r} needs {NEEDS[method]}: give it, or choose another method")
    else:
        names = [method]
    return np.array([METHODS.index(name) for name in names])


def _axes_about(up: Array) -> Array:
    """Orthonormal rows (3, 3), the first of which is the vertical."""
    across = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.8 else [0.0, 1.0, 0.0])
    level = across / np.linalg.norm(across)
    return np.array([up, level, np.cross(up, level)])


def _error(
    mechanism: Mechanism, arrays: dict[str, Array], method: str, status: int, row: int, leg: int, where: str
) -> GoughError:  # fmt: skip
    where = where.format(row=row)
    legs = arrays["leg_directions"][row]
    if status == _PARTLY_NAN:
        return InputError(f"leg_directions[{leg}]{where} is partly NaN; a leg that is not measured has a row of NaN")
    if status == _INFINITE:
        return InputError(f"leg_directions[{leg}]{where} is {legs[leg].tolist()}; it must be finite, or NaN if not measured")
    if status == _ROTATION_INFINITE:
        return InputError(f"rotation{where} is {arrays['rotation'][row].tolist()}; it must be finite")
    if status == _REFLECTION:
        return InputError(f"rotation{where} is a reflection (determinant -1); the frames of a pose are both right-handed")
    if status == _NOT_ORTHOGONAL:
        given = arrays["rotation"][row]
        off = float(np.abs(given.T @ given - np.eye(3)).max())
        return InputError(
            f"rotation{where} is off orthogonal by {off:.3g}, more than {UNIT_TOLERANCE:g}: give a rotation matrix"
        )
    if status in (_LEG_NOT_UNIT, _UP_NOT_UNIT, _NORMAL_NOT_UNIT):
        name, vector = {
            _LEG_NOT_UNIT: (f"leg_directions[{leg}]", legs[leg]),
            _UP_NOT_UNIT: ("up_in_platform", arrays.get("up_in_platform", legs)[row]),
            _NORMAL_NOT_UNIT: ("normal", arrays.get("normal", legs)[row]),
        }[status]
        if not np.isfinite(vector).all():
            return InputError(f"{name}{where} is {vector.tolist()}; it must be finite")
        size = float(np.linalg.norm(vector))
        return InputError(f"{name}{where} has length {size:.6g}; it must be 1 within {UNIT_TOLERANCE:g}: normalise it")
    measured = [f"leg {k}" for k in range(LEGS) if np.isfinite(legs[k, 0])] + [n for n in arrays if n != "leg_directions"]
    known = f"{', '.join(measured) or 'nothing'}{where}"
    return SingularConfigurationError(
        {
            _OPEN: f"{known} do not give the pose of {mechanism.name!r} here" + ("" if method == "auto" else f" by {method}")
            + f" (legs parallel or too few, joints in line or alike): {_remedy(arrays, method)}",
            _SINGULAR: f"{known} leave the pose of {mechanism.name!r} open to a small motion: measure more",
            _AMBIGUOUS: f"two poses fit {known}, and noise cannot tell them apart: measure up_in_platform too",
            _UNSETTLED: f"no pose fits {known}: the measurements contradict each other",
            _NEGATIVE: "the pose that fits best has legs of negative length: the directions contradict each other, or point "
            f"down the legs ({known})",
        }[status]
    )  # fmt: skip


def _remedy(arrays: dict[str, Array], method: str) -> str:
    if method != "auto":
        return "choose the method auto, or measure more"
    missing = [name for name in ("up_in_platform", "rotation") if name not in arrays]
    return f"measure more legs{''.join(f', or {name}' for name in missing)}"


_WORK = np.dtype(
    [
        ("scratch", SCRATCH),
        ("directions", np.float64, (LEGS, 3)),
        ("measured", np.float64, LEGS),
        ("weights", np.float64, LEGS),
        ("measured_rotation", np.float64, (3, 3)),
        ("in_base", np.float64, (5, 3)),
        ("in_platform", np.float64, (5, 3)),
        ("vector_weights", np.float64, 5),
        ("vectors", np.int64),
        ("up", np.int64),
        ("normal", np.int64),
        ("equations", np.int64),
        ("position", np.float64, 3),
        ("rotation", np.float64, (3, 3)),
        ("best_position", np.float64, 3),
        ("best_rotation", np.float64, (3, 3)),
        ("second_position", np.float64, 3),
        ("second_rotation", np.float64, (3, 3)),
        ("arms", np.float64, (LEGS, 3)),
        ("predicted", np.float64, (LEGS, 3)),
        ("lengths", np.float64, LEGS),
        ("information", np.float64, (6, 6)),
        ("factor", np.float64, (6, 6)),
        ("correction", np.float64, 6),
    ],
    align=True,
)
"""Memory for one pose: what was measured, with `up` and `normal` as rows of the vectors known in both frames; the pose; and
its fit."""


@kernel
def _solve_rows(
    geometry: Record, work_array: Record, measurements: _Measurements, candidates: NDArray[np.int64], refine: bool,
    results: _Results, start: int, stop: int,
) -> None:  # fmt: skip
    """Solve the rows from `start` to `stop`; a row without a pose is filled with NaN and says why in its status."""
    work = work_array[()]
    for row in range(start, stop):
        status, results.legs[row] = _read(measurements, row, work)
        results.conditionings[row] = 0.0
        results.methods[row] = 0
        if status == _SOLVED:
            results.methods[row], results.conditionings[row] = _find(geometry, candidates, work)
            status = _SOLVED if results.conditionings[row] > LEAST_CONDITIONING else _OPEN
        if status == _SOLVED:
            # A closed form that took joints for coplanar that hardly are is a start, not the pose.
            by_legs = results.methods[row] == _LEGS
            settle = refine or (by_legs and work.scratch.approximate != 0)
            two_roots = settle and by_legs and work.scratch.roots == 2
            status, chi_square = _fit_better(geometry, work) if two_roots else _fit(geometry, settle, work)
        results.statuses[row] = status
        if status == _SOLVED:
            _write(work, chi_square, row, results)
        else:
            results.positions[row] = np.nan
            results.rotations[row] = np.nan
            results.covariances[row] = np.nan
            results.residuals[row] = np.nan
            results.chi_squares[row] = np.nan
            results.degrees_of_freedom[row] = 0


@kernel
def _read(measurements: _Measurements, row: int, work: Record) -> tuple[int, int]:
    """Take in what was measured of a pose; returns a status and the leg that it is about."""
    status, leg = _read_directions(measurements.directions[row], work.directions, work.measured)
    if status != _SOLVED:
        return status, leg
    work.vectors = 0
    work.equations = 0
    for k in range(LEGS):
        work.weights[k] = work.measured[k] * measurements.leg_weight
        work.equations += 2 * int(work.measured[k])
    if measurements.rotations.shape[0] > 0:
        status = _read_rotation(measurements.rotations[row], work.measured_rotation)
        if status != _SOLVED:
            return status, leg
        # These weights add up to that of the yaw about the vertical, and to that of the tilt about every level axis.
        for axis in range(3):
            work.vector_weights[axis] = 0.5 * measurements.yaw_weight
            for i in range(3):
                work.in_base[axis, i] = measurements.axes[axis, i]
                work.in_platform[axis, i] = 0.0
                for j in range(3):
                    work.in_platform[axis, i] += work.measured_rotation[j, i] * measurements.axes[axis, j]
        work.vector_weights[0] = measurements.tilt_weight - 0.5 * measurements.yaw_weight
        work.vectors, work.equations = 3, work.equations + 3
    work.up = work.vectors
    if measurements.ups.shape[0] > 0:
        if not _read_unit(measurements.ups[row], work.in_platform[work.up]):
            return _UP_NOT_UNIT, leg
        for i in range(3):
            work.in_base[work.up, i] = measurements.axes[0, i]
        work.vector_weights[work.up] = measurements.tilt_weight
        work.vectors, work.equations = work.vectors + 1, work.equations + 2
    work.normal = work.vectors
    if measurements.normals.shape[0] > 0:
        if not _read_unit(measurements.normals[row], work.in_base[work.normal]):
            return _NORMAL_NOT_UNIT, leg
        for i in range(3):
            work.in_platform[work.normal, i] = 1.0 if i == 2 else 0.0
        work.vector_weights[work.normal] = measurements.tilt_weight
        work.vectors, work.equations = work.vectors + 1, work.equations + 2
    return _SOLVED, leg


@kernel
def _find(geometry: Record, candidates: NDArray[np.int64], work: Record) -> tuple[int, float]:
    """Leave the pose of the first method that is well conditioned, else of the best; returns that and its conditioning."""
    best, chosen = 0.0, candidates[0]
    for method in candidates:
        conditioning = _apply(geometry, method, work)
        if conditioning > best:
            best, chosen = conditioning, method
            work.best_position[:] = work.position
            work.best_rotation[:] = work.rotation
        if best > _GOOD_CONDITIONING:
            break
    work.position[:] = work.best_position
    work.rotation[:] = work.best_rotation
    return chosen, best


@kernel
def _apply(geometry: Record, method: int, work: Record) -> float:
    """Find the pose by a closed form; returns the conditioning."""
    directions, measured, position, rotation = work.directions, work.measured, work.position, work.rotation
    if method == _SECTION_5:
        rotation[:] = work.measured_rotation
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
    base_joints, platform_joints, position, rotation = (
        geometry.base_joints,
        geometry.platform_joints,
        work.position,
        work.rotation,
    )
    vectors = work.vectors
    in_base, in_platform, vector_weights = work.in_base, work.in_platform, work.vector_weights[:vectors]
    status, before, spread = _UNSETTLED, np.inf, geometry.spreads[-1]
    for _ in range(_MOST_REFINEMENTS if refine else 1):
        normal_equations(
            base_joints, platform_joints, work.directions, work.weights, in_base, in_platform, vector_weights, position,
            rotation, work.arms, work.predicted, work.lengths, work.information, work.correction,
        )  # fmt: skip
        if not solve_normal_equations(work.information, work.correction, work.factor):
            return _SINGULAR, np.inf
        if not refine:
            status = _SOLVED
            break
        move_pose(work.correction, position, rotation)
        square = _square_over_variance(work.factor, work.correction)
        if square < _REFINED or (square >= before and _is_tiny(work.correction, spread)):
            status = _SOLVED
            break
        before = square
    legs_at(base_joints, platform_joints, position, rotation, work.arms, work.predicted, work.lengths)
    chi_square = 0.0
    for k in range(LEGS):
        if work.measured[k] == 0.0:
            continue
        along = 0.0
        for i in range(3):
            chi_square += work.weights[k] * (work.directions[k, i] - work.predicted[k, i]) ** 2
            along += work.directions[k, i] * work.predicted[k, i]
        if status == _SOLVED and not along > 0.0:
            status = _NEGATIVE
    for k in range(vectors):
        for i in range(3):
            seen = rotation[i, 0] * in_platform[k, 0] + rotation[i, 1] * in_platform[k, 1] + rotation[i, 2] * in_platform[k, 2]
            chi_square += vector_weights[k] * (seen - in_base[k, i]) ** 2
    return status, chi_square


@kernel
def _fit_better(geometry: Record, work: Record) -> tuple[int, float]:
    """Refine the pose at both roots of the legs alone and leave the better one, if it is better by far; returns its status
    and chi-square sum.
    """
    position, rotation, second_position, second_rotation = (
        work.position,
        work.rotation,
        work.second_position,
        work.second_rotation,
    )
    work.best_position[:] = position
    work.best_rotation[:] = rotation
    second_pose_from_legs(geometry, work.directions, work.measured, position, rotation, work.scratch)
    second_status, second_chi_square = _fit(geometry, True, work)
    second_position[:] = position
    second_rotation[:] = rotation
    position[:] = work.best_position
    rotation[:] = work.best_rotation
    status, chi_square = _fit(geometry, True, work)
    if second_status != _SOLVED:
        return status, chi_square
    if status == _SOLVED:
        apart = 0.0
        for i in range(3):
            for j in range(3):
                apart = max(apart, abs(rotation[i, j] - second_rotation[i, j]))
        if apart <= _SAME_ROTATION:
            return status, chi_square
        least = min(chi_square, second_chi_square)
        if abs(chi_square - second_chi_square) < min(_DISTINCT, _DISTINCT_SHARE * least / max(work.equations - 6, 1)):
            return _AMBIGUOUS, chi_square
        if chi_square < second_chi_square:
            return status, chi_square
    position[:] = second_position
    rotation[:] = second_rotation
    return _fit(geometry, True, work)


@kernel
def _write(work: Record, chi_square: float, row: int, results: _Results) -> None:
    results.positions[row] = work.position
    results.rotations[row] = work.rotation
    results.chi_squares[row] = chi_square
    results.degrees_of_freedom[row] = work.equations - 6
    for k in range(LEGS):
        for i in range(3):
            residual = work.directions[k, i] - work.predicted[k, i]
            results.residuals[row, k, i] = residual if work.measured[k] != 0.0 else np.nan
    invert_cholesky(work.factor, results.covariances[row])


@kernel
def _read_directions(given: Array, directions: Array, measured: Array) -> tuple[int, int]:
    """Copy directions (6, 3) at unit length, and say which there are; returns a status and the leg that it is about."""
    for k in range(LEGS):
        missing = np.isnan(given[k, 0]) + np.isnan(given[k, 1]) + np.isnan(given[k, 2])
        if missing == 3:
            measured[k] = 0.0
            directions[k, 0], directions[k, 1], directions[k, 2] = 0.0, 0.0, 1.0
            continue
        if missing > 0:
            return _PARTLY_NAN, k
        measured[k] = 1.0
        if not _read_unit(given[k], directions[k]):
            return (_LEG_NOT_UNIT if np.isfinite(given[k]).all() else _INFINITE), k
    return _SOLVED, 0


@kernel
def _read_unit(given: Array, vector: Array) -> bool:
    """Copy a vector (3,) at unit length; False if it was not nearly a unit vector."""
    size = np.sqrt(given[0] * given[0] + given[1] * given[1] + given[2] * given[2])
    for i in range(3):
        vector[i] = given[i] / size
    return bool(abs(size - 1.0) <= UNIT_TOLERANCE)


@kernel
def _read_rotation(given: Array, rotation: Array) -> int:
    """Copy the rotation (3, 3) nearest to a matrix; returns a status."""
    columns = rotation.reshape(9)
    for i in range(3):
        for j in range(3):
            if not np.isfinite(given[i, j]):
                return _ROTATION_INFINITE
            dot = 0.0
            for k in range(3):
                dot += given[k, i] * given[k, j]
            if abs(dot - (1.0 if i == j else 0.0)) > UNIT_TOLERANCE:
                return _NOT_ORTHOGONAL
            columns[3 * i + j] = given[i, j]
    # The nearest rotation to the transposed is the transposed nearest rotation.
    return _SOLVED if orthonormalise(columns, False) >= 0.0 else _REFLECTION


@kernel
def _is_tiny(step: Array, spread: float) -> bool:
    """Whether a step that has stopped getting shorter does so for rounding alone."""
    longest = 0.0
    for i in range(3):
        longest = max(longest, abs(step[i]) / spread, abs(step[3 + i]))
    return longest < _TINY


@kernel
def _square_over_variance(factor: Array, step: Array) -> float:
    """step^T A step for a matrix A whose Cholesky factor is the lower triangle of `factor`."""
    square = 0.0
    for j in range(6):
        value = 0.0
        for i in range(j, 6):
            value += factor[i, j] * step[i]
        square += value * value
    return square


@dataclass(frozen=True)
class Requirement:
    """What a method needs on a mechanism.

    Attributes:
        method: one of `METHODS`.
        platform: what it needs of the platform: "nothing", "up_in_platform", "normal" or "rotation".
        fewest: the least number of legs with which the method gives the pose.
        choices: the sets of so many legs that will do; no leg can be left out of one.
        any_choice: the least number of legs with which every choice will do.
    """

    method: str
    platform: str
    fewest: int
    choices: tuple[tuple[int, ...], ...]
    any_choice: int

    @property
    def text(self) -> str:
        """The legs and what else is needed, in words."""
        if len(self.choices) == 1:
            legs = f"{self.fewest} legs"
        elif self.any_choice == self.fewest:
            legs = f"any {self.fewest} legs"
        else:
            legs = f"{self.fewest} legs, {len(self.choices)} choices"
        return legs if self.platform == "nothing" else f"{legs} + {self.platform}"

    @property
    def choice_text(self) -> str:
        """The choices as numbers of legs, "012, 024"; empty where any choice or only one will do."""
        if len(self.choices) == 1 or self.any_choice == self.fewest:
            return ""
        return ", ".join("".join(str(leg) for leg in legs) for legs in self.choices)


_TRIAL_POSES = 8
_TRIAL_TILT = 0.3


def required_measurements(mechanism: Mechanism) -> tuple[Requirement, ...]:
    """What each method needs on this mechanism, by trying every set of legs at poses about home; methods that cannot do are
    left out.

    A set of legs will do if it gives the pose at most of the poses: single poses may be singular.
    """
    _check_spatial(mechanism)
    poses = _trial_poses(mechanism)
    sets = [legs for count in range(2, LEGS + 1) for legs in combinations(range(LEGS), count)]
    directions = np.empty((len(sets), len(poses), LEGS, 3))
    for i, pose in enumerate(poses):
        vectors = pose.position + mechanism.platform_joints @ pose.rotation.T - mechanism.base_joints
        directions[:, i] = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    for j, legs in enumerate(sets):
        directions[j][:, [leg for leg in range(LEGS) if leg not in legs]] = np.nan
    rotations = np.tile([pose.rotation for pose in poses], (len(sets), 1, 1))
    given = {
        "nothing": {},
        "rotation": {"rotation": rotations},
        "normal": {"normal": rotations[:, :, 2]},
        "up_in_platform": {"up_in_platform": mechanism.up_in_base @ rotations},
    }
    requirements = []
    for method in METHODS:
        platform = NEEDS.get(method, "nothing")
        found = solve_batch(mechanism, directions.reshape(-1, LEGS, 3), method=method, **given[platform])
        enough = found.solved.reshape(len(sets), len(poses)).mean(axis=1) > 0.5
        if not enough.any():
            continue
        sufficient = [legs for legs, will_do in zip(sets, enough, strict=True) if will_do]
        lacking = [len(legs) for legs, will_do in zip(sets, enough, strict=True) if not will_do]
        fewest = min(len(legs) for legs in sufficient)
        choices = tuple(legs for legs in sufficient if len(legs) == fewest)
        requirements.append(Requirement(method, platform, fewest, choices, max(lacking, default=1) + 1))
    return tuple(requirements)


def _trial_poses(mechanism: Mechanism) -> list[Pose]:
    random = np.random.default_rng(0)
    size = float(np.linalg.norm(mechanism.base_joints - mechanism.base_joints.mean(axis=0), axis=1).max())
    home = mechanism.nominal_home
    return [
        Pose(
            home.position + 0.2 * size * random.uniform(-1.0, 1.0, 3),
            rotation_from_vector(_TRIAL_TILT * random.uniform(-1.0, 1.0, 3)) @ home.rotation,
        )
        for _ in range(_TRIAL_POSES)
    ]
