"""Direct kinematics of six legs: every method behind one function, for one pose or many at once.

A closed form gives the pose without a first guess. Gauss-Newton steps follow, weighted by the variances of legs and platform;
their normal matrix gives the covariance.
"""

import operator
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.direct_kinematics import solver
from controller.direct_kinematics.geometry import geometry_of
from controller.direct_kinematics.solver import METHODS, REFUSED, SOLVED, WORK, Measurements, Results, solve_rows
from plant.compiled import Record
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, Pose, numbers, rotation_angle
from plant.threads import in_threads

# Standard deviations that `solve` assumes [rad].
LEG_SIGMA = np.radians(0.05)  # of each component of a leg's direction
TILT_SIGMA = np.radians(0.05)  # of roll and pitch
YAW_SIGMA = np.radians(1.5)  # of a yaw that is measured magnetically
LEAST_SIGMA = 1e-9  # of a direction, that double precision can resolve

NEEDS = {"section-5": "rotation", "up": "up_in_platform", "normal": "normal", "section-4": "normal"}
"""The measurement of the platform that a method needs; the others need none."""

_AUTOMATIC = ("section-5", "up", "normal", "legs")

_CHUNK = 4096


@dataclass(frozen=True, eq=False)
class Solution:
    """A pose found from leg directions. If the refinement finds that another pose would fit as well, `solve` raises instead.

    Attributes:
        position: (3,) [m], origin of {2} in {1}.
        rotation: (3, 3), maps {2} to {1}.
        covariance: (6, 6) of position [m] and of a small rotation seen in {1} [rad], of the refined pose. A pose that was not
            refined is no better.
        residuals: (6, 3), measured minus predicted direction of each leg; NaN where a leg was not measured.
        chi_square: sum of the squared residuals of legs and platform over their variances.
        degrees_of_freedom: the mean of `chi_square` if the variances are right; 0 without redundancy.
        method: the closed form that gave the pose, one of `METHODS`.
        conditioning: reciprocal condition of that closed form: the ratio of the least to the greatest pivot of its QR.
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
    """Many poses; `solutions[i]` is a `Solution`, or raises the reason why there is none.

    The arrays have N rows with the shapes and units of a `Solution`, NaN where there is no pose.

    Attributes:
        methods: (N,), indices into `METHODS`.
        solved: (N,), whether there is a pose.
        errors: by row, the reason why there is none.
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
    errors: dict[int, SingularConfigurationError]

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
            self.positions[row], self.rotations[row], self.covariances[row], self.residuals[row],
            float(self.chi_squares[row]), int(self.degrees_of_freedom[row]), METHODS[self.methods[row]],
            float(self.conditionings[row]),
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
    """The pose of the platform from the directions of its legs, and its attitude as far as it was measured.

    Args:
        mechanism: its joints suffice; no home, limits or plant are needed.
        leg_directions: (6, 3), unit, from base to platform joint, seen in {1}; a leg that was not measured is a row of NaN.
        rotation: (3, 3), measured roll-pitch-yaw; maps {2} to {1} (the paper's section 5).
        normal: (3,), the z axis of {2} seen in {1} (the paper's section 4).
        up_in_platform: (3,), the vertical seen in {2}: what an accelerometer at rest measures.
        method: one of `METHODS`. "auto" takes the first of rotation, vertical, normal and legs alone that is given and
            determines the pose well.
        refine: whether to weigh all measurements by their variances; if not, the pose is that of the closed form.
        leg_sigma: standard deviation of each component of a direction [rad].
        tilt_sigma: standard deviation of roll and pitch, given by the vertical, the normal or the rotation [rad].
        yaw_sigma: standard deviation of the yaw in `rotation` [rad].

    Measurements that contradict each other show in the residuals. `integrity` finds the wrong one.

    Raises:
        InputError: wrong shape, not finite, off unit length by more than 1e-3, a reflection, a sigma not positive, an unknown
            method, or a method whose measurement is not given.
        SingularConfigurationError: the measurements do not determine the pose.
    """
    given = _shapes_checked(leg_directions, rotation, normal, up_in_platform)
    arrays = {name: array[None] for name, array in given.items()}
    results = _solve(mechanism, arrays, method, refine, (leg_sigma, tilt_sigma, yaw_sigma), 1)
    (status,), (degrees_of_freedom,), (number,) = results.integers.tolist()
    if status == REFUSED:
        raise _refusal(arrays, 0, "")
    if status != SOLVED:
        raise _error(mechanism, arrays, method, status, 0, "")
    (chi_square,), (conditioning,) = results.numbers.tolist()
    return Solution(
        results.positions[0], results.rotations[0], results.covariances[0], results.residuals[0], chi_square,
        degrees_of_freedom, METHODS[number], conditioning,
    )  # fmt: skip


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
    arrays = _shapes_checked(directions, rotation, normal, up_in_platform, len(directions) if directions.ndim else 0)
    where = " of row {row}"
    results = _solve(mechanism, arrays, method, refine, (leg_sigma, tilt_sigma, yaw_sigma), workers)
    statuses, degrees_of_freedom, methods = results.integers
    for row in np.flatnonzero(statuses == REFUSED)[:1].tolist():
        raise _refusal(arrays, row, where.format(row=row))
    solved = statuses == SOLVED
    unsolved = np.flatnonzero(~solved).tolist()
    errors = {row: _error(mechanism, arrays, method, statuses[row], row, where) for row in unsolved}
    chi_squares, conditionings = results.numbers
    return Solutions(
        results.positions, results.rotations, results.covariances, results.residuals, chi_squares, degrees_of_freedom, methods,
        conditionings, solved, errors,
    )  # fmt: skip


def pose_difference(first: Solution | Pose, second: Solution | Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    distance = float(np.linalg.norm(first.position - second.position))
    return distance, float(rotation_angle(first.rotation, second.rotation))


def _shapes_checked(
    directions: ArrayLike, rotation: ArrayLike | None, normal: ArrayLike | None, up_in_platform: ArrayLike | None, *rows: int
) -> dict[str, Array]:  # fmt: skip
    """The measurements that are given, by name, with so many rows."""
    arrays = {"leg_directions": _shaped(directions, (*rows, LEGS, 3), "leg_directions")}
    given = {"rotation": (rotation, (3, 3)), "normal": (normal, (3,)), "up_in_platform": (up_in_platform, (3,))}
    for name, (value, shape) in given.items():
        if value is not None:
            arrays[name] = _shaped(value, (*rows, *shape), name)
    return arrays


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
    workers: int | None,
) -> Results:
    """Solve all rows; an `InputError` if what holds for all of them cannot be used."""
    check_spatial(mechanism)
    if not isinstance(refine, bool | np.bool_):
        raise InputError(f"refine must be True or False, got {refine!r}")
    candidates = _candidates(method, tuple(arrays))
    weights = [_weight(name, sigma) for name, sigma in zip(_SIGMAS, sigmas, strict=True)]
    count = len(arrays["leg_directions"])
    measurements = Measurements(
        arrays["leg_directions"], arrays.get("rotation", _NO_ROTATIONS), arrays.get("up_in_platform", _NO_VECTORS),
        arrays.get("normal", _NO_VECTORS), _axes_of(mechanism), *weights,
    )  # fmt: skip
    results = _results(count)

    geometry = _geometry_array_of(mechanism)

    def solve_chunk(start: int, stop: int) -> None:
        solve_rows(geometry, _memory.work, measurements, candidates, refine, results, start, stop)

    if count == workers == 1:
        solve_chunk(0, 1)
    else:
        in_threads(solve_chunk, count, _CHUNK, workers)
    return results


_SIGMAS = ("leg_sigma", "tilt_sigma", "yaw_sigma")
_NO_ROTATIONS, _NO_VECTORS = np.empty((0, 3, 3)), np.empty((0, 3))


def _weight(name: str, sigma: float) -> float:
    """The inverse variance."""
    value = sigma if isinstance(sigma, float) else float(_shaped(sigma, (), name))
    if not LEAST_SIGMA <= value < np.inf:
        raise InputError(f"{name} is {sigma}; it must be at least {LEAST_SIGMA:g} and finite [rad]")
    return float(value) ** -2


def _results(count: int) -> Results:
    """Arrays for so many rows, of which the kernel writes every element."""
    empty = np.empty
    return Results(
        empty((count, 3)), empty((count, 3, 3)), empty((count, 6, 6)), empty((count, LEGS, 3)), empty((2, count)),
        empty((3, count), np.int64),
    )  # fmt: skip


def check_spatial(mechanism: Mechanism) -> None:
    """Raise an `InputError` unless the mechanism has six legs."""
    if not isinstance(mechanism, Mechanism):
        raise InputError(f"the mechanism must be a Mechanism of six legs, not a {type(mechanism).__name__}")


class _Memory(threading.local):
    """The solver's memory, which it keeps for no longer than a row: one for each thread."""

    def __init__(self) -> None:
        self.work: Record = np.zeros((), WORK)


_memory = _Memory()


def _candidates(method: str, measured: tuple[str, ...]) -> NDArray[np.int64]:
    if not isinstance(method, str) or method not in ("auto", *METHODS):
        raise InputError(f"there is no method {method!r}; there are auto, {', '.join(METHODS)}")
    return _possible(method, measured)


@lru_cache
def _possible(method: str, measured: tuple[str, ...]) -> NDArray[np.int64]:
    names = _AUTOMATIC if method == "auto" else (method,)
    given = [name for name in names if NEEDS.get(name, "leg_directions") in measured]
    if not given:
        raise InputError(f"the method {method!r} needs {NEEDS[method]}: give it, or choose another method")
    return np.array([METHODS.index(name) for name in given])


@lru_cache(maxsize=256)
def _geometry_array_of(mechanism: Mechanism) -> Record:
    """Its geometry as an array of shape (), which a kernel takes from Python five times as fast as a record."""
    return np.array(geometry_of(mechanism))


@lru_cache(maxsize=256)
def _axes_of(mechanism: Mechanism) -> Array:
    """Orthonormal rows (3, 3), the first of which is the vertical."""
    up = mechanism.up_in_base
    across = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.8 else [0.0, 1.0, 0.0])
    level = across / np.linalg.norm(across)
    return np.array([up, level, np.cross(up, level)])


def _refusal(arrays: dict[str, Array], row: int, where: str) -> InputError:
    """Why the measurements of a row are refused: a vector that is no unit vector, or else a matrix that is no rotation."""
    vectors = {f"leg_directions[{leg}]": vector for leg, vector in enumerate(arrays["leg_directions"][row])}
    vectors |= {name: arrays[name][row] for name in ("up_in_platform", "normal") if name in arrays}
    for name, vector in vectors.items():
        leg, missing = name not in arrays, np.isnan(vector)
        if leg and missing.all():
            continue
        if leg and missing.any():
            return InputError(f"{name}{where} is partly NaN; a leg that is not measured has a row of NaN")
        if not np.isfinite(vector).all():
            return InputError(
                f"{name}{where} is {vector.tolist()}; it must be finite{', or NaN if not measured' if leg else ''}"
            )
        size = float(np.sqrt(np.sum(vector * vector)))
        if abs(size - 1.0) > UNIT_TOLERANCE:
            return InputError(f"{name}{where} has length {size:.6g}; it must be 1 within {UNIT_TOLERANCE:g}: normalise it")
    given = arrays["rotation"][row]
    if not np.isfinite(given).all():
        return InputError(f"rotation{where} is {given.tolist()}; it must be finite")
    off = float(np.abs(given.T @ given - np.eye(3)).max())
    if not off <= UNIT_TOLERANCE:
        return InputError(
            f"rotation{where} is off orthogonal by {off:.3g}, more than {UNIT_TOLERANCE:g}: give a rotation matrix"
        )
    return InputError(f"rotation{where} is a reflection (determinant -1); the frames of a pose are both right-handed")


def _error(
    mechanism: Mechanism, arrays: dict[str, Array], method: str, status: int, row: int, where: str
) -> SingularConfigurationError:
    """Why a row has no pose."""
    legs = arrays["leg_directions"][row]
    measured = [f"leg {k}" for k in range(LEGS) if np.isfinite(legs[k, 0])] + [n for n in arrays if n != "leg_directions"]
    known = f"{', '.join(measured) or 'nothing'}{where.format(row=row)}"
    by, remedy = f" by {method}", "choose the method auto, or measure more"
    if method == "auto":
        missing = [name for name in ("up_in_platform", "rotation") if name not in arrays]
        by, remedy = "", f"measure more legs{''.join(f', or {name}' for name in missing)}"
    return SingularConfigurationError(
        {
            solver.OPEN: f"{known} do not give the pose of {mechanism.name!r} here{by} (legs parallel or too few, joints in "
            f"line or alike): {remedy}",
            solver.SINGULAR: f"{known} leave the pose of {mechanism.name!r} open to a small motion: measure more",
            solver.AMBIGUOUS: f"two poses fit {known}, and noise cannot tell them apart: measure up_in_platform too",
            solver.UNSETTLED: f"no pose fits {known}: the measurements contradict each other",
            solver.NEGATIVE: "the pose that fits best has legs of negative length: the directions contradict each other, or "
            f"point down the legs ({known})",
        }[status]
    )  # fmt: skip
