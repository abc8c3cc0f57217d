"""How far poses are from everything that limits them."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.imu_set import conditionings
from controller.inverse_kinematics import jacobian_at, legs_at
from controller.least_squares import determinant, extreme_singular_values
from controller.load_feed_forward import STATE, find_static_forces, own_weight
from controller.pose_limits.clearance import disc_distance, segment_distance
from controller.pose_limits.limits import (
    BASE_PLATE,
    BASE_SWING,
    BETWEEN,
    COUNT,
    DIRECT_KINEMATICS,
    FORCE,
    JACOBIAN,
    KINDS,
    LEAST_JACOBIAN,
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
from plant.compiled import Record, kernel, record_dtype
from plant.errors import InputError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, Pose, numbers
from plant.threads import in_threads
from plant.vectors import Vector, add, cross, dot, rotate, rotate_back, scale, subtract, vector

_CHUNK = 1024

WORK = record_dtype(
    arms=(np.float64, (LEGS, 3)),
    directions=(np.float64, (LEGS, 3)),
    lengths=(np.float64, LEGS),
    rotation=(np.float64, (3, 3)),
    starts=(np.float64, (LEGS, 3)),  # where the body of each leg begins
    tips=(np.float64, (LEGS, 3)),  # and ends
    jacobian=(np.float64, (6, 6)),
    matrix=(np.float64, (6, 6)),
    squares=(np.float64, (6, 6)),
    diagonal=(np.float64, 6),
    beside=(np.float64, 6),
    smallest=np.float64,  # singular value of the Jacobian, with turns at the spread of the joints
    static=STATE,
)
"""Memory for one pose."""


@dataclass(frozen=True, eq=False)
class Margins:
    """How far N poses are from each limit; below zero it is exceeded, inf where there is no such limit.

    Attributes:
        values: (N, 59), in the order of `LIMITS` and in their units.
        scales: (59,), the margin with which a limit is farthest away.
    """

    values: Array
    scales: Array

    @property
    def reachable(self) -> NDArray[np.bool_]:
        """(N,): whether no limit is exceeded."""
        found: NDArray[np.bool_] = np.all(self.values >= 0.0, axis=1)
        return found

    @property
    def binding(self) -> NDArray[np.int64]:
        """(N,): the number in `LIMITS` of the limit with the least margin over its scale: what is exceeded most, or nearest."""
        found: NDArray[np.int64] = np.nan_to_num(self.values / self.scales, nan=-np.inf).argmin(axis=1)
        return found

    def of(self, kind: str) -> Array:
        """The margins (N, m) of a kind of limit, one of `KINDS`: of each leg, pair of legs, or one."""
        if kind not in KINDS:
            raise InputError(f"there is no kind of limit {kind!r}; there are {', '.join(KINDS)}")
        return self.values[:, [limit.kind == kind for limit in LIMITS]]


def margins(
    mechanism: Mechanism,
    positions: ArrayLike,
    rotations: ArrayLike,
    demands: Demands | None = None,
    *,
    workers: int | None = None,
) -> Margins:
    """How far poses are from everything that limits them; compiled, and on all cores.

    - stroke [m]: from the nearer end, of each leg.
    - base swing, platform swing [rad]: from the edge of the joint's cone.
    - legs, base plate, platform plate [m]: distance of a leg's surface from that of another leg or a plate, less the least
      clearance. Where two axes or an axis and a plate cross, it is less the sum of both radii.
    - speed [m/s]: what is left of the velocity limit at the twist of the demands.
    - force [N]: what is left of the motor's force, at rest, with all weights and the load.
    - Jacobian: the ratio of its least to its greatest singular value, with turns at the greatest distance of a platform joint
      from their centre, less `LEAST_JACOBIAN`; negative on the other side of a singularity than home.
    - direct kinematics: its conditioning with the IMUs, less the least with which a run goes on (`[safety] conditioning`).

    Args:
        mechanism: with home and stroke; a planar one seen in space, whose poses must stay in its plane.
        positions: (N, 3) [m].
        rotations: (N, 3, 3).
        demands: what is asked besides; by default that motors hold the weights, and good conditioning with all IMUs.
        workers: threads; by default one for each core.

    Raises:
        InputError: arrays of another shape or not finite, no rotations, a pose outside the plane, no home or stroke.
    """
    demands = demands or USUAL
    positions, rotations = checked_poses(mechanism, positions, rotations)
    space = space_of(mechanism, demands)
    values = np.full((len(positions), COUNT), np.inf)

    def find(start: int, stop: int) -> None:
        margin_rows(space, np.zeros((), WORK), positions, rotations, values, start, stop)

    in_threads(find, len(positions), _CHUNK, workers)
    if demands.conditioning and demands.imus is not None:
        found = conditionings(
            mechanism, positions, rotations, demands.imus, demands.magnetometer, demands.section_5, workers=workers
        )
        values[:, DIRECT_KINEMATICS] = found - least_conditioning(mechanism)
    return Margins(values, scales_of(space))


def kernels_of_margins(mechanism: Mechanism) -> tuple[tuple[Any, ...], ...]:
    """The kernels of `margins`, with arguments each, as `load_kernels` takes them; without that of the conditioning."""
    poses = np.zeros((1, 3)), np.zeros((1, 3, 3))
    return (
        (margin_rows, space_of(mechanism, USUAL), np.zeros((), WORK), *poses, np.zeros((1, COUNT)), 0, 1),
        (first_that_is_none, *poses),
    )


def margins_at(mechanism: Mechanism, pose: Pose, demands: Demands | None = None) -> dict[Limit, float]:
    """The margins of one pose by limit, those with no such limit left out; as `margins`."""
    row = margins(mechanism, pose.position[None], pose.rotation[None], demands, workers=1).values[0]
    return {limit: float(value) for limit, value in zip(LIMITS, row, strict=True) if value < np.inf}


def checked_poses(mechanism: Mechanism, positions: ArrayLike, rotations: ArrayLike) -> tuple[Array, Array]:
    """Positions (N, 3) and rotations (N, 3, 3), or an `InputError`."""
    at, turned = numbers(positions, "positions", "(N, 3)"), numbers(rotations, "rotations", "(N, 3, 3)")
    if at.ndim != 2 or at.shape[1] != 3 or turned.shape != (len(at), 3, 3):
        raise InputError(f"positions have shape {at.shape} and rotations {turned.shape}; they must be (N, 3) and (N, 3, 3)")
    row = first_that_is_none(at, turned)
    if row >= 0:
        raise InputError(
            f"pose {row} has the position {at[row].tolist()} and the rotation {turned[row].tolist()}: give finite positions "
            "and rotation matrices"
        )
    if mechanism.planar:
        out = np.abs(at[:, 2]) + np.abs(turned[:, 2, :2]).max(axis=1, initial=0.0)
        if len(at) and out.max() > UNIT_TOLERANCE:
            raise InputError(
                f"pose {int(out.argmax())} leaves the plane of {mechanism.name!r}: it turns about z alone, at z = 0"
            )
    return at, turned


@kernel
def first_that_is_none(positions: Array, rotations: Array) -> int:
    """The first row whose position is not finite, or whose rotation is none; -1 if there is no such row."""
    for row in range(positions.shape[0]):
        rotation, off = rotations[row], 0.0
        for i in range(3):
            off = max(off, 0.0 if np.isfinite(positions[row, i]) else np.inf)
            for j in range(3):
                product = dot(vector(rotation[i]), vector(rotation[j])) - (1.0 if i == j else 0.0)
                off = max(off, abs(product)) if np.isfinite(product) else np.inf
        volume = dot(cross(vector(rotation[0]), vector(rotation[1])), vector(rotation[2]))
        if not (off <= UNIT_TOLERANCE and volume > 0.0):
            return row
    return -1


@kernel
def margin_rows(
    space_array: Record, work_array: Record, positions: Array, rotations: Array, values: Array, start: int, stop: int
) -> None:
    """Write the margins of the rows from `start` to `stop`, but for those of direct kinematics."""
    space, work = space_array[()], work_array[()]
    for row in range(start, stop):
        find_margins(space, work, positions[row], rotations[row], values[row])


@kernel
def force_rows(space_array: Record, work_array: Record, positions: Array, rotations: Array, forces: Array) -> None:
    """Write the static forces (N, n) of the legs on the platform, with the weights of the space alone."""
    space, work = space_array[()], work_array[()]
    for row in range(positions.shape[0]):
        legs_at(
            space.base_joints, space.platform_joints, positions[row], rotations[row], work.arms, work.directions, work.lengths
        )
        work.rotation[:] = rotations[row]
        find_static_forces(space.weights, work.static, work, space.legs, vector(space.up), space.gravity, space.load)
        for k in range(space.legs):
            forces[row, k] = work.static.force[k]


@kernel
def find_margins(space: Record, work: Record, position: Array, rotation: Array, values: Array) -> None:
    """Write the margins (COUNT,) of one pose, where there is a limit."""
    n = space.legs
    arms, directions, lengths = work.arms, work.directions, work.lengths
    legs_at(space.base_joints, space.platform_joints, position, rotation, arms, directions, lengths)
    for k in range(n):
        values[STROKE + k] = min(lengths[k] - space.stroke[k, 0], space.stroke[k, 1] - lengths[k])
    if space.swinging != 0:
        for k in range(n):
            direction = vector(directions[k])
            if space.base_swing[k] < np.inf:
                values[BASE_SWING + k] = space.base_swing[k] - _angle(direction, vector(space.base_axes[k]))
            if space.platform_swing[k] < np.inf:
                seen = rotate_back(rotation, direction)
                values[PLATFORM_SWING + k] = space.platform_swing[k] - _angle(seen, vector(space.platform_axes[k]))
    if space.thick != 0:
        _find_clearances(space, work, position, rotation, values)
    if space.moving != 0 or space.conditioned != 0 or space.loaded != 0:
        jacobian_at(arms, directions, n, work.jacobian)
    if space.moving != 0:
        for k in range(n):
            rate = 0.0
            for i in range(6):
                rate += work.jacobian[k, i] * space.twist[i]
            values[SPEED + k] = space.velocity - abs(rate)
    if space.loaded != 0:
        _find_forces(space, work, rotation, values)
    if space.conditioned != 0:
        values[JACOBIAN] = _find_conditioning(space, work) - LEAST_JACOBIAN


@kernel
def _angle(a: Vector, b: Vector) -> float:
    """The angle between two unit vectors."""
    return float(np.arccos(min(max(dot(a, b), -1.0), 1.0)))


@kernel
def _find_clearances(space: Record, work: Record, position: Array, rotation: Array, values: Array) -> None:
    n, clearance = space.legs, space.clearance
    for k in range(n):
        direction = vector(work.directions[k])
        start = add(vector(space.base_joints[k]), scale(space.ends[0], direction))
        tip = subtract(add(vector(position), vector(work.arms[k])), scale(space.ends[1], direction))
        work.starts[k, 0], work.starts[k, 1], work.starts[k, 2] = start
        work.tips[k, 0], work.tips[k, 1], work.tips[k, 2] = tip
    number = 0
    for i in range(n):
        for j in range(i + 1, LEGS):
            if space.compared[number] != 0:
                apart = segment_distance(
                    vector(work.starts[i]), vector(work.tips[i]), vector(work.starts[j]), vector(work.tips[j])
                )
                values[BETWEEN + number] = apart - space.radii[i] - space.radii[j] - clearance
            number += 1
    plate = space.base_plate
    if plate.there != 0:
        for k in range(n):
            apart = disc_distance(
                vector(work.starts[k]), vector(work.tips[k]), vector(plate.center), vector(plate.normal), plate.radius
            )
            values[BASE_PLATE + k] = apart - space.radii[k] - plate.gap
    plate = space.platform_plate
    if plate.there != 0:
        center = add(vector(position), rotate(rotation, vector(plate.center)))
        normal = rotate(rotation, vector(plate.normal))
        for k in range(n):
            apart = disc_distance(vector(work.tips[k]), vector(work.starts[k]), center, normal, plate.radius)
            values[PLATFORM_PLATE + k] = apart - space.radii[k] - plate.gap


@kernel
def _find_forces(space: Record, work: Record, rotation: Array, values: Array) -> None:
    work.rotation[:] = rotation
    up, weights, static = vector(space.up), space.weights, work.static
    solved = find_static_forces(weights, static, work, space.legs, up, space.gravity, space.load) > 0.0
    for k in range(space.legs):
        pushed = abs(static.force[k] + own_weight(weights, work, k, up, space.gravity)) if solved else np.inf
        values[FORCE + k] = space.force - pushed


@kernel
def _find_conditioning(space: Record, work: Record) -> float:
    """The conditioning of the Jacobian, negative on the other side of a singularity than home."""
    n = space.legs
    scale_jacobian(space, work)
    positive = determinant(work.matrix, n) * space.side > 0.0
    scale_jacobian(space, work)
    least, greatest = extreme_singular_values(work.matrix, n, work.squares, work.diagonal, work.beside)
    work.smallest = least
    ratio = least / greatest
    return float(ratio if positive else -ratio)


@kernel
def scale_jacobian(space: Record, work: Record) -> None:
    """Copy the Jacobian, for the twist's components that the platform has, with turns at the joints' spread."""
    for k in range(space.legs):
        for i in range(space.legs):
            axis = space.axes[i]
            work.matrix[k, i] = work.jacobian[k, axis] / (1.0 if axis < 3 else space.spread)
