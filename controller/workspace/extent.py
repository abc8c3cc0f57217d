"""How large the region about a pose is that a mechanism reaches: volume, slices, and the largest box and ellipsoid in it."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.pose_limits.limits import LIMITS, Demands, Limit
from controller.pose_limits.margins import margins
from controller.workspace.travel import pose_along, travels
from plant.errors import InputError
from plant.mechanism import Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose, checked_array

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""The coordinates of a pose about another one: a translation [m] and a rotation vector [rad], both in {1}."""

_DIRECTIONS = 4000
_TRIALS, _KEPT, _ROUNDS, _AROUND = 1000, 8, 16, 24
_FIRST_REACH, _SHRINK = 0.3, 0.6
_PROBES, _MOST_PROBES = 8192, 8
_BEYOND, _ROUND = 1.15, 48
_GRID = 81


@dataclass(frozen=True, eq=False)
class Reach:
    """What straight moves, or turns about one axis, from a pose reach.

    Attributes:
        volume: of the positions [m^3] or of the rotation vectors [rad^3]; of a planar mechanism an area [m^2], or the range of
            its angle [rad].
        shares: the share of the directions that each limit ends, the largest first.
    """

    volume: float
    shares: dict[Limit, float]


@dataclass(frozen=True, eq=False)
class Region:
    """The largest region of a shape in which a mechanism reaches every pose.

    Attributes:
        half_sizes: (6,), along `AXES` [m, rad].
        limit: what it touches; None if it is bounded by a full turn alone.
        pose: where it touches.
    """

    half_sizes: Array
    limit: Limit | None
    pose: Pose


@dataclass(frozen=True, eq=False)
class Slice:
    """Which poses of a grid are reached, and what limits them most.

    Attributes:
        axes: the two of `AXES` that vary: the first one along the columns, the second one along the rows.
        columns, rows: the moves from the pose along them [m or rad].
        reachable: (rows, columns).
        binding: (rows, columns), the number in `LIMITS` of the limit with the least margin.
    """

    axes: tuple[str, str]
    columns: Array
    rows: Array
    reachable: NDArray[np.bool_]
    binding: NDArray[np.int64]


def reach_from(
    mechanism: Mechanism, pose: Pose, demands: Demands | None = None, *, turning: bool = False, most: float = np.inf
) -> Reach:
    """What straight moves from a pose reach without a turn, or, with `turning`, turns about one axis in place.

    It is the mean over 4,000 directions that are spread evenly, exact to about 0.1 %. `most` ends every move [m or rad].

    Raises:
        InputError, UnreachableError: as `travel`.
    """
    moving = [axis for axis in moving_axes(mechanism) if (axis >= 3) == turning]
    spread = spread_directions(_DIRECTIONS, len(moving))
    directions = np.zeros((len(spread), 6))
    directions[:, moving] = spread
    ways, ends = travels(mechanism, pose, directions, demands, most=most)
    volume = float(_UNIT_BALL[len(moving)] * np.mean(ways ** len(moving)))
    counts = {LIMITS[end]: float(np.mean(ends == end)) for end in np.unique(ends) if end >= 0}
    return Reach(volume, dict(sorted(counts.items(), key=lambda each: -each[1])))


def largest_box(mechanism: Mechanism, pose: Pose, shape: ArrayLike, demands: Demands | None = None) -> Region:
    """The largest box about a pose with all poses in it reachable, its edges along `AXES` and in the ratios of `shape` (6,).

    The pose is its middle, and an edge of 0 varies nothing: (1, 1, 1, 0, 0, 0) is a cube of positions with the pose's rotation.
    It is found by a search over the directions in which it may touch a limit, and tried at 8,192 poses; it is not proven.

    Raises:
        InputError: a shape that is negative, zero or out of the plane, or as `travel`.
        UnreachableError: as `travel`.
    """
    return _largest(mechanism, pose, shape, demands, _onto_cube)


def largest_ellipsoid(mechanism: Mechanism, pose: Pose, shape: ArrayLike, demands: Demands | None = None) -> Region:
    """The largest ellipsoid about a pose with all poses in it reachable, its half axes in the ratios of `shape`; as
    `largest_box`.
    """
    return _largest(mechanism, pose, shape, demands, _onto_sphere)


def _onto_cube(points: Array) -> Array:
    """Points (N, k) brought onto the surface of the cube from -1 to 1."""
    within = np.clip(points, -1.0, 1.0)
    found: Array = within / np.abs(within).max(axis=1, keepdims=True)
    return found


def _onto_sphere(points: Array) -> Array:
    """Points (N, k) brought onto the unit sphere."""
    found: Array = points / np.linalg.norm(points, axis=1, keepdims=True)
    return found


def _largest(
    mechanism: Mechanism, pose: Pose, shape: ArrayLike, demands: Demands | None, onto: Callable[[Array], Array]
) -> Region:
    """The largest region whose surface, in shares of the shape, is what `onto` makes of points (N, k)."""
    sizes = checked_array(shape, (6,), "shape")
    varied = np.flatnonzero(sizes)
    if sizes.min() < 0.0 or not len(varied) or not {*varied.tolist()} <= {*moving_axes(mechanism)}:
        raise InputError(
            f"the shape {sizes.tolist()} is none: give sizes of at least 0 along {', '.join(AXES)}, not all 0"
            + (", and of a planar mechanism along x, y and rz alone" if mechanism.planar else "")
        )
    random = np.random.default_rng(0)

    def ways_of(points: Array, most: float) -> tuple[Array, NDArray[np.int64]]:
        directions = np.zeros((len(points), 6))
        directions[:, varied] = points * sizes[varied]
        return travels(mechanism, pose, directions, demands, most=most)

    corners = np.array([each for each in product((-1.0, 0.0, 1.0), repeat=len(varied)) if any(each)])
    points = onto(np.vstack([corners, 2.0 * spread_points(_TRIALS, len(varied)) - 1.0]))
    best, way, end = points[0], np.inf, -1
    for _ in range(_MOST_PROBES):
        ways, ends = ways_of(points, way)
        reach = _FIRST_REACH
        for _ in range(_ROUNDS):
            kept = np.argsort(ways)[:_KEPT]
            if ways[kept[0]] < way or end < 0:
                best, way, end = points[kept[0]], float(ways[kept[0]]), int(ends[kept[0]])
            around = np.repeat(points[kept], _AROUND, axis=0)
            tried = onto(around + reach * random.standard_normal(around.shape))
            found = ways_of(tried, float(ways[kept[-1]]))
            points = np.vstack([points[kept], tried])
            ways, ends = np.append(ways[kept], found[0]), np.append(ends[kept], found[1])
            reach *= _SHRINK
        inside = onto(2.0 * random.random((_PROBES, len(varied))) - 1.0)
        moves = np.zeros((_PROBES, 6))
        moves[:, varied] = way * random.random((_PROBES, 1)) ** (1.0 / len(varied)) * inside * sizes[varied]
        missed = ~margins(mechanism, *poses_about(pose, moves), demands).reachable
        if not missed.any():
            break
        points = inside[missed]
    half_sizes = np.zeros(6)
    half_sizes[varied] = way * sizes[varied]
    move = np.zeros(6)
    move[varied] = way * best * sizes[varied]
    return Region(half_sizes, None if end < 0 else LIMITS[end], pose_along(pose, move))


def slice_about(
    mechanism: Mechanism, pose: Pose, axes: tuple[str, str], demands: Demands | None = None, points: int = _GRID
) -> Slice:
    """Which poses of a grid about a pose are reached, as far as straight moves go and somewhat beyond.

    Raises:
        InputError: axes that are none, or out of the plane, or as `travel`.
        UnreachableError: as `travel`.
    """
    numbers = [AXES.index(axis) for axis in axes if axis in AXES]
    if len(set(numbers)) != 2 or not {*numbers} <= {*moving_axes(mechanism)}:
        known = ", ".join(AXES[axis] for axis in moving_axes(mechanism))
        raise InputError(f"there is no slice along {' and '.join(axes)}: take two of {known}")
    round_about = np.zeros((_ROUND, 6))
    round_about[:, numbers] = spread_directions(_ROUND, 2)
    extent = travels(mechanism, pose, round_about, demands)[0][:, None] * round_about[:, numbers]
    columns, rows = (
        np.linspace(low - margin, high + margin, points)
        for low, high in zip(extent.min(axis=0), extent.max(axis=0), strict=True)
        for margin in [0.5 * (_BEYOND - 1.0) * (high - low)]
    )
    moves = np.zeros((points * points, 6))
    moves[:, numbers[0]], moves[:, numbers[1]] = np.tile(columns, points), np.repeat(rows, points)
    found = margins(mechanism, *poses_about(pose, moves), demands)
    shape = points, points
    return Slice(axes, columns, rows, found.reachable.reshape(shape), found.binding.reshape(shape))


def poses_about(pose: Pose, moves: Array) -> tuple[Array, Array]:
    """The poses at moves (N, 6) from a pose, along `AXES`: positions (N, 3) [m] and rotations (N, 3, 3)."""
    return pose.position + moves[:, :3], rotations_of(moves[:, 3:]) @ pose.rotation


_UNIT_BALL = {1: 2.0, 2: np.pi, 3: 4.0 / 3.0 * np.pi}


def spread_directions(count: int, dimensions: int) -> Array:
    """Unit vectors (count, dimensions), spread evenly; on a line both of them."""
    number = np.arange(count) + 0.5
    if dimensions == 1:
        return np.array([[-1.0], [1.0]])
    if dimensions == 2:
        angles = 2.0 * np.pi * number / count
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    z, turn = 1.0 - 2.0 * number / count, np.pi * (1.0 + np.sqrt(5.0)) * number
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=1)


def spread_points(count: int, dimensions: int) -> Array:
    """Points (count, dimensions), spread evenly over the unit cube (an additive recurrence)."""
    root = 2.0
    for _ in range(50):
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    steps = root ** -np.arange(1.0, dimensions + 1)
    return (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1.0


def rotations_of(vectors: Array) -> Array:
    """The rotations (N, 3, 3) of vectors (N, 3) [rad] (Rodrigues)."""
    angles = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = (vectors / np.maximum(angles[:, 0], np.finfo(float).tiny)).T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    turned: Array = np.eye(3) + np.sin(angles) * skew + (1.0 - np.cos(angles)) * skew @ skew
    return turned
