"""How far the platform gets from a pose along a direction, and what ends it.

The platform moves by `s` times a twist: a pivot goes straight, and the platform turns about it at a constant rate. The margin
of each limit cannot change faster than the joints move, so that a step by the margin over this rate meets no limit. Such steps
lead to the first limit that is met; bisection finds where.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.imu_set import conditionings
from controller.least_squares import extreme_singular_values
from controller.pose_limits.limits import (
    BASE_PLATE,
    BASE_SWING,
    BETWEEN,
    COUNT,
    DIRECT_KINEMATICS,
    FORCE,
    JACOBIAN,
    LIMITS,
    PLATFORM_PLATE,
    PLATFORM_SWING,
    SPEED,
    STROKE,
    USUAL,
    Demands,
    Limit,
    least_conditioning,
    scales_of,
    space_of,
)
from controller.pose_limits.margins import WORK, find_margins, scale_jacobian
from plant.compiled import Record, kernel, record_dtype
from plant.dynamics.variables import TINY
from plant.errors import InputError, UnreachableError
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose, checked_array, checked_rotation, numbers, rotate_by_vector, rotation_from_vector
from plant.threads import in_threads
from plant.vectors import Vector, cross, dot, rotate, scale, subtract, vector

_CHUNK = 16
_LEAST_STEP_M = 1e-7
"""A limit that is exceeded only while no joint moves so far is not noticed."""
_SETTLED = 1e-12
_MOST_STEPS = 2_000_000
_SINE = np.pi / 3.0
"""Half a leg's length away, an angle is at most this times the way over the length."""
_FULL_TURN = 2.0 * np.pi
_LOOK_M, _LOOK_RAD = 1e-3, np.radians(0.2)
"""Steps in which the conditioning of direct kinematics is looked at."""


@dataclass(frozen=True, eq=False)
class Travel:
    """How far the platform gets.

    Attributes:
        way: how far, in multiples of the direction.
        distance: that the pivot has gone [m].
        angle: by which the platform has turned [rad].
        limit: what ends it; None after a full turn.
        pose: where it ends, within all limits.
    """

    way: float
    distance: float
    angle: float
    limit: Limit | None
    pose: Pose


PATH = record_dtype(
    position=(np.float64, 3),
    rotation=(np.float64, (3, 3)),
    pivot=(np.float64, 3),
    velocity=(np.float64, 3),
    turn=(np.float64, 3),
    rate=np.float64,  # size of the turn
    speeds=(np.float64, LEGS),  # that the platform joints have at most
    plate_speed=np.float64,  # and the platform's plate
    at=(np.float64, 3),
    turned=(np.float64, (3, 3)),
    vector=(np.float64, 3),
    work=WORK,
)
"""A path of the platform, a pose of it, and memory."""


def travel(
    mechanism: Mechanism, pose: Pose, direction: ArrayLike, demands: Demands | None = None, *, pivot: ArrayLike | None = None
) -> Travel:
    """How far the platform gets from a pose along a direction, to 1e-9 m, and what ends it.

    Args:
        mechanism: as for `margins`.
        pose: where it begins.
        direction: (6,), a velocity of the pivot and an angular velocity, both in {1} and in any unit: (0, 0, 1, 0, 0, 0) goes
            up, (0, 0, 0, 0, 0, 1) turns about z. Both at once go straight and turn; along the angular velocity, it is a screw.
        demands: as for `margins`.
        pivot: (3,) [m], the point in {1} about which it turns; by default the origin of {2}.

    The conditioning of direct kinematics is looked at each 1 mm and each 0.2 deg; no other limit is passed over, except one
    that is exceeded on less than 0.1 um of the joints' way.

    Raises:
        InputError: a direction without length or out of the plane, or as `margins`.
        UnreachableError: the pose itself exceeds a limit.
    """
    chosen = checked_array(direction, (6,), "direction")
    size = float(np.linalg.norm(chosen))
    if size == 0.0:
        raise InputError("the direction has no length: give a velocity or an angular velocity")
    demands = demands or USUAL
    ways, ends = travels(mechanism, pose, chosen[None], demands, pivot=pivot)
    way, end = float(ways[0]), int(ends[0])
    if demands.conditioning and demands.imus is not None:
        way, end = _until_blind(mechanism, pose, chosen, way, end, demands, demands.imus, pivot)
    distance, angle = (way * float(np.linalg.norm(part)) for part in (chosen[:3], chosen[3:]))
    return Travel(way, distance, angle, None if end < 0 else LIMITS[end], pose_along(pose, way * chosen, pivot))


def travels(
    mechanism: Mechanism,
    pose: Pose,
    directions: ArrayLike,
    demands: Demands | None = None,
    *,
    most: float = np.inf,
    pivot: ArrayLike | None = None,
    workers: int | None = None,
) -> tuple[Array, NDArray[np.int64]]:
    """How far the platform gets along N directions (N, 6), in multiples of each, and the numbers in `LIMITS` of what ends them.

    As `travel`, compiled and on all cores, but without direct kinematics. A way ends at `most` (number -1), and after a full
    turn.

    Raises:
        InputError, UnreachableError: as `travel`.
    """
    given = np.ascontiguousarray(numbers(directions, "directions", "(N, 6)"))
    if given.ndim != 2 or given.shape[1] != 6 or not np.isfinite(given).all():
        raise InputError(f"directions have shape {given.shape}; they must be (N, 6) and finite")
    outside = np.delete(given, moving_axes(mechanism), axis=1)
    if np.any(outside):
        raise InputError(f"a direction leaves the plane of {mechanism.name!r}: it moves along x and y, and turns about z")
    space = space_of(mechanism, demands or USUAL)
    position = checked_array(pose.position, (3,), "position")
    path_of_all = np.zeros((), PATH)
    path_of_all["position"], path_of_all["rotation"] = position, checked_rotation(pose.rotation, "rotation")
    path_of_all["pivot"] = position if pivot is None else checked_array(pivot, (3,), "pivot")
    _check_start(mechanism, space, path_of_all)
    scales, ways, ends = scales_of(space), np.empty(len(given)), np.empty(len(given), np.int64)

    def find(start: int, stop: int) -> None:
        path = path_of_all.copy()
        travel_rows(space, path, given, scales, most, ways, ends, np.full((2, COUNT), np.inf), start, stop)

    in_threads(find, len(given), _CHUNK, workers)
    return ways, ends


def pose_along(pose: Pose, move: Array, pivot: ArrayLike | None = None) -> Pose:
    """The pose after a move (6,): a translation [m] of the pivot (by default the origin of {2}) and a turn about it [rad]."""
    center = pose.position if pivot is None else np.asarray(pivot)
    turn = rotation_from_vector(move[3:])
    return Pose(center + move[:3] + turn @ (pose.position - center), turn @ pose.rotation)


def _check_start(mechanism: Mechanism, space: Record, path: Record) -> None:
    values = np.full((1, COUNT), np.inf)
    find_start(space, path, values)
    worst = int(np.nan_to_num(values[0] / scales_of(space), nan=-np.inf).argmin())
    if not values[0, worst] >= 0.0:
        limit = LIMITS[worst]
        raise UnreachableError(
            f"{mechanism.name!r} cannot be at the pose from which it should travel: {limit.text} is exceeded by "
            f"{-values[0, worst]:.4g}{'' if limit.unit == '1' else ' ' + limit.unit}; begin at another pose"
        )


def _until_blind(
    mechanism: Mechanism,
    pose: Pose,
    direction: Array,
    way: float,
    end: int,
    demands: Demands,
    imus: Collection[int],
    pivot: ArrayLike | None,
) -> tuple[float, int]:
    """The way until direct kinematics is too badly conditioned, if it is shorter."""
    least = least_conditioning(mechanism)

    def left(ways: Array) -> Array:
        poses = [pose_along(pose, each * direction, pivot) for each in ways]
        positions, rotations = (np.array([getattr(each, name) for each in poses]) for name in ("position", "rotation"))
        found = conditionings(mechanism, positions, rotations, imus, demands.magnetometer, demands.section_5)
        return found - least

    far, turned = (max(float(np.linalg.norm(part)), TINY) for part in (direction[:3], direction[3:]))
    step = min(_LOOK_M / far, _LOOK_RAD / turned)
    ways = np.append(np.arange(0.0, way, step), way)
    blind = np.flatnonzero(~(left(ways) >= 0.0))
    if not len(blind):
        return way, end
    if blind[0] == 0:
        raise UnreachableError(
            f"{mechanism.name!r} cannot be at the pose from which it should travel: its IMUs do not determine it; begin at "
            "another pose, or add IMUs"
        )
    low, high = ways[blind[0] - 1], ways[blind[0]]
    while high - low > _SETTLED * max(way, 1e-3):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if left(np.array([middle]))[0] >= 0.0 else (low, middle)
    return float(low), DIRECT_KINEMATICS


@kernel
def find_start(space_array: Record, path_array: Record, values: Array) -> None:
    """Write the margins at the start of a path."""
    space, path = space_array[()], path_array[()]
    find_margins(space, path.work, path.position, path.rotation, values[0])


@kernel
def travel_rows(
    space_array: Record, path_array: Record, directions: Array, scales: Array, most: float, ways: Array,
    ends: NDArray[np.int64], values: Array, start: int, stop: int,
) -> None:  # fmt: skip
    """Find how far the rows from `start` to `stop` get; `values` (2, COUNT) is scratch, filled with inf."""
    space, path = space_array[()], path_array[()]
    for row in range(start, stop):
        for i in range(3):
            path.velocity[i], path.turn[i] = directions[row, i], directions[row, 3 + i]
        ways[row], ends[row] = _travel(space, path, scales, most, values)


@kernel
def _travel(space: Record, path: Record, scales: Array, most: float, values: Array) -> tuple[float, int]:
    fastest = _prepare(space, path)
    if path.rate > 0.0:
        most = min(most, _FULL_TURN / path.rate)
    least_step = _LEAST_STEP_M / fastest if fastest > 0.0 else most
    here, there = values[0], values[1]
    _margins_along(space, path, 0.0, here)
    s = 0.0
    for _ in range(_MOST_STEPS):
        if s >= most:
            return most, -1
        ahead = min(s + max(_safe_step(space, path, here), least_step), most)
        _margins_along(space, path, ahead, there)
        if _all_kept(there):
            s = ahead
            here[:] = there
            continue
        low, high = s, ahead
        while high - low > _SETTLED * max(high, 1e-3 * least_step):
            middle = 0.5 * (low + high)
            if middle <= low or middle >= high:
                break
            _margins_along(space, path, middle, there)
            if _all_kept(there):
                low = middle
            else:
                high = middle
        _margins_along(space, path, high, there)
        worst, at = np.inf, 0
        for number in range(COUNT):
            share = there[number] / scales[number]
            if not share >= worst:
                worst, at = share, number
        return low, at
    return s, -1


@kernel
def _all_kept(values: Array) -> bool:
    kept = True
    for number in range(COUNT):
        kept = kept and values[number] >= 0.0
    return kept


@kernel
def _margins_along(space: Record, path: Record, s: float, values: Array) -> None:
    """Write the margins after the share s of the path."""
    for i in range(3):
        path.vector[i] = s * path.turn[i]
        path.at[i] = path.position[i] - path.pivot[i]
    path.turned[:] = path.rotation
    rotate_by_vector(path.turned, path.vector)
    arm = _turned(path, vector(path.at))
    for i in range(3):
        path.at[i] = path.pivot[i] + s * path.velocity[i] + arm[i]
    find_margins(space, path.work, path.at, path.turned, values)


@kernel
def _turned(path: Record, arm: Vector) -> Vector:
    """A vector turned by `path.vector` (Rodrigues)."""
    angle = np.sqrt(dot(vector(path.vector), vector(path.vector)))
    if angle == 0.0:
        return arm
    axis = scale(1.0 / angle, vector(path.vector))
    sideways, along = cross(axis, arm), (1.0 - np.cos(angle)) * dot(axis, arm)
    cosine, sine = np.cos(angle), np.sin(angle)
    return (
        cosine * arm[0] + sine * sideways[0] + along * axis[0],
        cosine * arm[1] + sine * sideways[1] + along * axis[1],
        cosine * arm[2] + sine * sideways[2] + along * axis[2],
    )


@kernel
def _speed(path: Record, arm: Vector) -> float:
    """The greatest speed of a point of the platform, at `arm` from the pivot at the start; it stays as far from the axis."""
    velocity, turn = vector(path.velocity), vector(path.turn)
    if path.rate == 0.0:
        return float(np.sqrt(dot(velocity, velocity)))
    axis = scale(1.0 / path.rate, turn)
    along = dot(axis, velocity)
    across = subtract(velocity, scale(along, axis))
    out = subtract(arm, scale(dot(axis, arm), axis))
    return float(np.sqrt(along**2 + (np.sqrt(dot(across, across)) + path.rate * np.sqrt(dot(out, out))) ** 2))


@kernel
def _prepare(space: Record, path: Record) -> float:
    """Find the greatest speeds of the platform's joints and plate; returns the greatest of all."""
    path.rate = np.sqrt(dot(vector(path.turn), vector(path.turn)))
    origin = subtract(vector(path.position), vector(path.pivot))
    fastest = 0.0
    for k in range(space.legs):
        joint = rotate(path.rotation, vector(space.platform_joints[k]))
        speed = _speed(path, (origin[0] + joint[0], origin[1] + joint[1], origin[2] + joint[2]))
        path.speeds[k] = speed
        fastest = max(fastest, speed)
    center = rotate(path.rotation, vector(space.platform_plate.center))
    middle = _speed(path, (origin[0] + center[0], origin[1] + center[1], origin[2] + center[2]))
    path.plate_speed = middle + path.rate * space.platform_plate.radius
    return fastest


@kernel
def _safe_step(space: Record, path: Record, values: Array) -> float:
    """How far the path may go on before a limit can be met, from a pose with these margins, whose legs are in `path.work`.

    No leg loses more than half its length, so that its direction turns by at most `_SINE` times its joint's way over the
    length, and at no more than twice the speed over the length.
    """
    work, n, rate = path.work, space.legs, path.rate
    step = np.inf
    for k in range(n):
        speed = path.speeds[k]
        if speed == 0.0:
            continue
        step = min(step, values[STROKE + k] / speed, 0.5 * work.lengths[k] / speed)
        turning = _SINE * speed / work.lengths[k]
        step = min(step, values[BASE_SWING + k] / turning, values[PLATFORM_SWING + k] / (turning + rate))
        step = min(step, values[BASE_PLATE + k] / speed, values[PLATFORM_PLATE + k] / (speed + path.plate_speed))
    if space.thick != 0:
        number = 0
        for i in range(n):
            for j in range(i + 1, LEGS):
                if space.compared[number] != 0:
                    both = path.speeds[i] + path.speeds[j]
                    if both > 0.0:
                        step = min(step, values[BETWEEN + number] / both)
                number += 1
    if space.moving != 0 or space.loaded != 0 or space.conditioned != 0:
        step = min(step, _step_of_jacobian(space, path, values))
    return step


@kernel
def _step_of_jacobian(space: Record, path: Record, values: Array) -> float:
    """The part of `_safe_step` for speeds, forces and the conditioning of the Jacobian."""
    work, n, rate = path.work, space.legs, path.rate
    step, square, pulled, weighed = np.inf, 0.0, 0.0, 0.0
    moved = np.sqrt(space.twist[0] ** 2 + space.twist[1] ** 2 + space.twist[2] ** 2)
    spun = np.sqrt(space.twist[3] ** 2 + space.twist[4] ** 2 + space.twist[5] ** 2)
    weights, gravity = space.weights, space.gravity
    for k in range(n):
        arm = np.sqrt(dot(vector(work.arms[k]), vector(work.arms[k])))
        turning = 2.0 * path.speeds[k] / work.lengths[k]
        lever = rate * arm + arm * turning
        square += turning**2 + (lever / space.spread) ** 2
        change = moved * turning + spun * lever
        if space.moving != 0 and change > 0.0:
            step = min(step, values[SPEED + k] / change)
        if space.loaded != 0:
            # Half its length away, a leg's push changes at most so much.
            near = 0.5 * work.lengths[k]
            most = weights.lower_moment + weights.rod_mass * (work.lengths[k] + near + weights.rod_center)
            push = gravity * most / near
            pushed = 2.0 * turning * push + gravity * path.speeds[k] * (weights.rod_mass / near + most / near**2)
            pulled += pushed
            weighed += rate * arm * push + arm * pushed
    changing = np.sqrt(square)
    if space.conditioned != 0 and changing > 0.0:
        step = min(step, values[JACOBIAN] / (2.0 * changing))
    if space.loaded != 0:
        if space.conditioned == 0:
            scale_jacobian(space, work)
            work.smallest = extreme_singular_values(work.matrix, n, work.squares, work.diagonal, work.beside)[0]
        moment = vector(weights.first_moment)
        weighed += rate * gravity * np.sqrt(dot(moment, moment))
        size, largest, tightest = 0.0, 0.0, np.inf
        for k in range(n):
            size += work.static.force[k] ** 2
            largest = max(largest, 2.0 * gravity * weights.rod_mass * path.speeds[k] / work.lengths[k])
            tightest = min(tightest, values[FORCE + k])
        size = np.sqrt(size) + 1e-9
        # While no singular value falls below half the least, and the forces do not double, they change by at most so much.
        change = 2.0 / work.smallest * (pulled + weighed / space.spread + 2.0 * size * changing)
        if changing > 0.0:
            step = min(step, 0.5 * work.smallest / changing)
        if change > 0.0:
            step = min(step, size / change)
        if change + largest > 0.0:
            step = min(step, tightest / (change + largest))
    return step
