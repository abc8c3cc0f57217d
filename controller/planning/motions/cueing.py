"""Motion cueing: what a platform renders of a vehicle's motion, by a classical washout.

A platform has little room, so it renders fast changes by moving and what lasts by leaning:

    d       deviation of the vehicle's specific force from that at rest, scaled
    tilt    low-pass of d -> the tilt whose gravity is d, if not too steep -> speed limit -> smoothing
    turn    tilt + washed-out integral of the scaled, clipped and smoothed angular velocity
    a       what is left to render at that turn R, R (g up + smoothed d) - g up, clipped
    move    washed-out double integral of a

A washout is a high-pass: of second order for angular velocities, s^2 / (s + w)^2, of third order for accelerations,
s^3 / ((s + w)^2 (s + v)), so that the platform returns to the middle; with v = 0 it is of second order. Written with the
integrals in it, there is none that could drift: the angle is s / (s + w)^2 times the angular velocity, the displacement
s / ((s + w)^2 (s + v)) times the acceleration. All are cascades of first-order low-passes, each exact for an input that goes
straight. Above, `a` is seen in axes that do not turn, so what the tilt renders is not rendered again by moving. If the platform
can lean about one axis alone, the tilt is about that one.

Sources: L. D. Reid and M. A. Nahon, "Flight simulation motion-base drive algorithms, part 1", UTIAS report 296 (1985);
M. A. Nahon and L. D. Reid, "Simulator motion-drive algorithms: a designer's perspective", J. Guidance 13(2), 356-362 (1990).
The structure is theirs, and so are a scale of about 0.5, a damping of 1 and a tilt at 3 deg/s at most as first choices; what
depends on the size of the platform is taken from the mechanism here.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import product
from math import e
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.waves import MOST_HZ, checked_number, read_samples
from plant.compiled import Record, filled, kernel, record_dtype
from plant.errors import InputError
from plant.imu.model import STANDARD_GRAVITY
from plant.mechanism import Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose, checked_array, rotate_by_vector, rotations_from_quaternions
from plant.vectors import add, cross, dot, rotate, scale, subtract, vector

Numbers = tuple[float, ...]
Platform = Callable[[Array, Array], tuple[Array, Array]]
"""Positions (N, 3) and rotations (N, 3, 3) of {2} in {1}, from those of a motion."""

_RATES = ("wx_rad_s", "wy_rad_s", "wz_rad_s")
COLUMNS = ("time_s", "ax_m_s2", "ay_m_s2", "az_m_s2", *_RATES)
"""Of a file of a vehicle's accelerations, without gravity, and angular velocities."""

FORCE_COLUMNS = ("time_s", "fx_m_s2", "fy_m_s2", "fz_m_s2", *_RATES)
"""Of a file of what a vehicle's accelerometers and gyroscopes read: specific forces, with gravity."""

_LEAST_HZ, _LEAST_TILT_SPEED = 0.001, 1e-4
_STEEPEST = np.radians(45.0)
_SHARE_OF_ACCELERATION, _SHARE_OF_VELOCITY = 0.5, 0.25
"""Shares of the legs' limits that a clipped acceleration, and a clipped angular velocity, take by default."""

_TILT_SHARE = 0.6
"""Share of the room to lean that is the tilt's by default; turns have the rest."""

_RETURN = 0.1
"""The default frequency of the return to the middle, as a share of that of the washout."""

_GENTLE = 2.0
"""The tilt is smoothed at this multiple of its frequency, so that it is not felt when its speed changes."""

_COARSE = 0.1
"""A step times the highest frequency [rad/s]."""

_MOST_TURN = 1.0
_BISECTIONS = 40


@dataclass(frozen=True, kw_only=True)
class Washout:
    """Settings of the washout; those that are None suit the mechanism, at the place where it begins.

    A frequency is the one at which a first-order filter has lost 3 dB; a washout has two of them.
    """

    scale: float = 0.5  # on the specific force, less that at rest
    turn_scale: float = 0.5  # on the angular velocity
    point: Numbers = (0.0, 0.0, 0.0)  # (3,) in the tool's axes [m]: where the operator is
    most_acceleration: Numbers | None = None  # (3,), at which is clipped what is left to render by moving [m/s^2]
    most_turn_speed: Numbers | None = None  # (3,), at which scaled angular velocities are clipped [rad/s]
    smoothing_frequency: float | None = None  # of the smoothing [Hz]
    washout_frequency: float | None = None  # of accelerations [Hz]
    return_frequency: float | None = None  # of the return to the middle [Hz]; 0 for a washout of second order
    turn_washout_frequency: float | None = None  # of angular velocities [Hz]
    tilt_frequency: float | None = None  # below it, the tilt renders [Hz]
    tilt: float | None = None  # the steepest [rad]
    tilt_speed: float = np.radians(3.0)  # below what is felt as a turn [rad/s]

    def __post_init__(self) -> None:
        checked_number(self.scale, "scale", 0.0, 10.0)
        checked_number(self.turn_scale, "turn_scale", 0.0, 10.0)
        checked_array(self.point, (3,), "point")
        for name, least, most in (
            ("smoothing_frequency", _LEAST_HZ, MOST_HZ), ("washout_frequency", _LEAST_HZ, MOST_HZ),
            ("return_frequency", 0.0, MOST_HZ), ("turn_washout_frequency", _LEAST_HZ, MOST_HZ),
            ("tilt_frequency", _LEAST_HZ, MOST_HZ), ("tilt", 0.0, _STEEPEST), ("tilt_speed", _LEAST_TILT_SPEED, np.inf),
        ):  # fmt: skip
            if getattr(self, name) is not None:
                checked_number(getattr(self, name), name, least, most)
        for name in ("most_acceleration", "most_turn_speed"):
            if getattr(self, name) is not None:
                for value in checked_array(getattr(self, name), (3,), name).tolist():
                    checked_number(value, name, 0.0)

    @property
    def settings(self) -> "Washout":
        """The settings alone, of a class that adds to them."""
        return Washout(**{each.name: getattr(self, each.name) for each in fields(Washout)})


class Vehicle(NamedTuple):
    """How a vehicle moves, along and about its own axes: those of the poses of the motion."""

    times: Array  # (N,) [s], from 0
    forces: Array  # (N, 3), accelerations or specific forces [m/s^2]
    rates: Array  # (N, 3), angular velocities [rad/s]
    gravity: bool = False  # whether the forces are specific ones, with gravity

    def deviations(self, up: Array) -> Array:
        """The specific forces (N, 3) less that at rest, with a vertical (3,)."""
        return self.forces - STANDARD_GRAVITY * up if self.gravity else self.forces


def read_vehicle(path: str | Path) -> Vehicle:
    """The motion of a vehicle from a CSV file with the header `COLUMNS` or `FORCE_COLUMNS`.

    Raises:
        InputError: the file cannot be read, is malformed, not finite or out of order, or has less than two samples.
    """
    columns, table = read_samples(Path(path), "a vehicle's motion", 2, COLUMNS, FORCE_COLUMNS)
    return Vehicle(table[:, 0] - table[0, 0], table[:, 1:4], table[:, 4:], columns == FORCE_COLUMNS)


class Site:
    """Where a cue is rendered: a mechanism, and the pose from which it moves.

    Args:
        mechanism: with home and limits.
        begin: the pose, as the motion has it.
        platform: the poses of {2} from those of the motion.
        point: (3,) [m], where the operator is in the tool's axes; it moves, and the platform turns about it.
    """

    def __init__(self, mechanism: Mechanism, begin: Pose, platform: Platform, point: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        self.mechanism, self.begin, self.limits = mechanism, begin, mechanism.require_limits()
        self._platform, self.arm = platform, begin.rotation @ np.asarray(point, float)

    def poses(self, moves: Array) -> tuple[Array, Array]:
        """Positions (N, 3) and rotations (N, 3, 3) of the motion after moves (N, 6), displacements and rotation vectors."""
        turns = rotations_from_quaternions(quaternions_of(moves[:, 3:]))
        return self.positions(moves), turns @ self.begin.rotation

    def positions(self, moves: Array) -> Array:
        """Positions (N, 3) of the motion after moves (N, 6)."""
        turns = rotations_from_quaternions(quaternions_of(moves[:, 3:]))
        found: Array = self.begin.position + moves[:, :3] + self.arm - turns @ self.arm
        return found

    def lengths(self, moves: Array) -> Array:
        """The lengths (N, n) after moves (N, 6)."""
        return leg_lengths(self.mechanism, *self._platform(*self.poses(moves)))

    def inside(self, moves: Array) -> NDArray[np.bool_]:
        """Whether (N,) all legs are within their strokes."""
        lengths, stroke = self.lengths(moves), self.limits.stroke
        found: NDArray[np.bool_] = np.all((lengths >= stroke[:, 0]) & (lengths <= stroke[:, 1]), axis=1)
        return found

    @cached_property
    def up(self) -> Array:
        """The vertical (3,) in the axes of the motion."""
        corners = np.vstack([np.zeros(3), np.eye(3)])
        positions, _ = self._platform(corners, np.tile(np.eye(3), (4, 1, 1)))
        up: Array = (positions[1:] - positions[0]) @ self.mechanism.up_in_base
        return up

    def room(self, axes: Collection[int]) -> Array:
        """Half the edges (6,) [m, rad] of a box of moves along some axes that is within all strokes, in the ratios of the
        travel along each axis alone; 0 along the others.

        Raises:
            InputError: there is no room.
        """
        chosen = [axis for axis in moving_axes(self.mechanism) if axis in axes]
        directions = np.eye(6)[chosen]
        most = np.where(np.array(chosen) < 3, 2.0 * np.diff(self.limits.stroke).max(), _MOST_TURN)
        alone = np.minimum(self._travel(directions, most), self._travel(-directions, most))
        corners = np.array([*product((-1.0, 1.0), repeat=len(chosen))]) @ (alone[:, None] * directions)
        share = self._travel(corners, np.ones(len(corners))).min()
        if not share * alone.min() > 0.0:
            raise InputError("there is no room for a cue: a leg is at the end of its stroke; begin at another pose")
        room: Array = share * alone @ directions
        return room

    def _travel(self, directions: Array, most: Array) -> Array:
        """How far (N,) it is along directions (N, 6) to the end of a stroke."""
        low, high = np.zeros(len(directions)), most.copy()
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            inside = self.inside(middle[:, None] * directions)
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        return low

    def filter(self, washout: Washout) -> Record:
        """The parameters (dtype `PARAMETERS`) of a washout, with what suits the mechanism where there is no setting."""
        moving, limits = moving_axes(self.mechanism), self.limits
        free = np.zeros(6)
        free[moving] = 1.0
        small = 1e-6
        # By which each axis moves the legs that it moves most.
        slopes = np.abs(self.lengths(small * np.eye(6)) - self.lengths(-small * np.eye(6))).max(axis=1) / (2.0 * small)
        slopes[free == 0.0] = np.inf
        usual = _SHARE_OF_ACCELERATION * limits.acceleration / slopes[:3]
        accelerations = _chosen(washout.most_acceleration, usual)
        turn_speeds = _chosen(washout.most_turn_speed, _SHARE_OF_VELOCITY * limits.velocity / slopes[3:])
        # A step of an acceleration has the jerk v / e of it after two low-passes at v, and moves by 1 / w^2 of it; a step of an
        # angular velocity turns by 1 / (e w) of it.
        smoothing = _hertz(washout.smoothing_frequency, e * limits.jerk / limits.acceleration)
        room = np.array([self.room([axis])[axis] if free[axis] else np.inf for axis in range(6)])
        # The tilt has this frequency, too: where the platform may not move along any axis, it is the usual one.
        away = _hertz(washout.washout_frequency, np.sqrt(((accelerations if accelerations.any() else usual) / room[:3]).max()))
        turn_away = _hertz(washout.turn_washout_frequency, (turn_speeds / (e * (1.0 - _TILT_SHARE) * room[3:])).max())
        tilt_frequency = _hertz(washout.tilt_frequency, away)
        leans = [3 + axis for axis in range(3) if axis != np.abs(self.up).argmax()]
        tilt = washout.tilt
        if tilt is None:
            tilt = _TILT_SHARE * min(self.room(leans)[axis] for axis in leans if free[axis]) if free[leans].any() else 0.0
        return filled(
            PARAMETERS, step=_COARSE / max(smoothing, away, turn_away, tilt_frequency), scale=washout.scale,
            turn_scale=washout.turn_scale, most_acceleration=accelerations, most_turn_speed=turn_speeds, smoothing=smoothing,
            washout=away, back=_hertz(washout.return_frequency, _RETURN * away), turn_washout=turn_away,
            tilt_frequency=tilt_frequency, tilt_smoothing=min(_GENTLE * tilt_frequency, smoothing), steepest=np.sin(tilt),
            tilt_speed=washout.tilt_speed, up=self.up, gravity=STANDARD_GRAVITY, free=free,
        )  # fmt: skip


def _chosen(given: Numbers | None, default: Array) -> Array:
    return default if given is None else np.array(given)


def _hertz(given: float | None, default: float) -> float:
    """A frequency [rad/s], given in Hz or not; it is never so low that the filter could not divide by it."""
    return float(max(default, 2.0 * np.pi * _LEAST_HZ) if given is None else 2.0 * np.pi * given)


def quaternions_of(vectors: Array) -> Array:
    """The unit quaternions (N, 4), w first, of rotation vectors (N, 3)."""
    half = 0.5 * np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.hstack([np.cos(half), 0.5 * np.sinc(half / np.pi) * vectors])


PARAMETERS = record_dtype(
    step=np.float64,  # longest step of the filters [s]
    scale=np.float64,
    turn_scale=np.float64,
    most_acceleration=(np.float64, 3),
    most_turn_speed=(np.float64, 3),
    smoothing=np.float64,  # frequencies [rad/s]
    washout=np.float64,
    back=np.float64,
    turn_washout=np.float64,
    tilt_frequency=np.float64,
    tilt_smoothing=np.float64,
    steepest=np.float64,  # sine of the steepest tilt
    tilt_speed=np.float64,
    up=(np.float64, 3),
    gravity=np.float64,
    free=(np.float64, 6),  # 1 for an axis that the platform has, else 0
)

STATE = record_dtype(
    gain=np.float64,  # on the vehicle's motion, and on what clips it
    force=(np.float64, 3),  # scaled
    rate=(np.float64, 3),  # scaled and clipped
    gain_step=np.float64,  # by which they change in a step
    force_step=(np.float64, 3),
    rate_step=(np.float64, 3),
    low=(np.float64, (2, 3)),  # force after low-passes
    tilt=(np.float64, 3),  # rotation vector within the speed limit
    tilted=(np.float64, (2, 3)),  # and smoothed
    turned=(np.float64, (4, 3)),  # rate, smoothed and washed out
    turn=(np.float64, 3),  # rotation vector of the platform
    rotation=(np.float64, (3, 3)),
    smooth=(np.float64, (2, 3)),  # force
    wanted=(np.float64, 3),  # acceleration that is left to render by moving
    left=(np.float64, 3),  # and clipped
    washed=(np.float64, (2, 3)),
    returned=(np.float64, 3),
    move=(np.float64, 3),  # displacement of the platform
    wanted_sine=np.float64,  # of the tilt, before it is clipped
    goal=(np.float64, 3),  # tilt before the speed limit
    goal_speed=np.float64,
    lagging=np.float64,  # 1 while the tilt is behind its goal, else 0
    tilt_speed=np.float64,  # of the smoothed tilt
)

ROW = record_dtype(
    moves=(np.float64, 6),  # displacement and rotation vector
    wanted=(np.float64, 3),
    wanted_sine=np.float64,
    goal_speed=np.float64,
    lagging=np.float64,
    tilt_speed=np.float64,
)
"""What `render` writes for a sample, as in `STATE`."""


def at_rest() -> Record:
    """A filter's state (dtype `STATE`) of a vehicle at rest."""
    return filled(STATE, gain=1.0, rotation=np.eye(3))


@kernel
def advance(parameters: Record, state: Record, force: Array, rate: Array, gain: float, time: float) -> None:
    """Go on for a time [s] in which the vehicle's motion changes steadily to `force` and `rate`.

    Args:
        parameters: dtype `PARAMETERS`.
        state: dtype `STATE`, written.
        force: (3,), specific force less that at rest, in the vehicle's axes [m/s^2].
        rate: (3,), angular velocity [rad/s].
        gain: factor on both, and on what clips them, so that all that is rendered is smaller.
        time: positive [s].
    """
    p, s = parameters[()], state[()]
    count = max(1, int(np.ceil(time / p.step - 1e-9)))
    for k in range(3):
        s.force_step[k] = (gain * p.scale * force[k] - s.force[k]) / count
        s.rate_step[k] = (gain * clipped(p.turn_scale * rate[k], p.most_turn_speed[k]) - s.rate[k]) / count
    s.gain_step = (gain - s.gain) / count
    for _ in range(count):
        _tilt(p, s, time / count)
        _turn(p, s, time / count)
        _move(p, s, time / count)


@kernel
def render(parameters: Record, state: Record, times: Array, forces: Array, rates: Array, gains: Array, rows: Record) -> None:
    """Write a row (dtype `ROW`) for each sample of a vehicle's motion but the first: times and gains (N,), forces and rates
    (N, 3), as for `advance`.
    """
    s = state[()]
    s.gain = gains[0]
    for i in range(1, times.shape[0]):
        advance(parameters, state, forces[i], rates[i], gains[i], times[i] - times[i - 1])
        row = rows[i]
        for k in range(3):
            row.moves[k], row.moves[3 + k], row.wanted[k] = s.move[k], s.turn[k], s.wanted[k]
        row.wanted_sine, row.goal_speed, row.lagging, row.tilt_speed = s.wanted_sine, s.goal_speed, s.lagging, s.tilt_speed


@kernel
def clipped(value: float, most: float) -> float:
    """The value, or the nearest one of this size at most."""
    return min(max(value, -most), most)


@kernel
def low_pass(value: float, before: float, after: float, angle: float) -> float:
    """A first-order low-pass after a step in which its input goes straight from `before` to `after`; exact.

    `angle` is its frequency [rad/s] times the step [s]; 0 keeps the value.
    """
    if angle == 0.0:
        return value
    kept, mean = np.exp(-angle), -np.expm1(-angle) / angle
    return float(kept * value + (mean - kept) * before + (1.0 - mean) * after)


@kernel
def _tilt(p: Record, s: Record, h: float) -> None:
    """Lean so that gravity renders what lasts, no faster than allowed."""
    for k in range(3):
        first = s.low[0, k]
        s.low[0, k] = low_pass(first, s.force[k], s.force[k] + s.force_step[k], h * p.tilt_frequency)
        s.low[1, k] = low_pass(s.low[1, k], first, s.low[0, k], h * p.tilt_frequency)
    # The vertical, seen by the platform, leans along the force: the platform turns about force x vertical.
    x, y, z = cross(vector(s.low[1]), vector(p.up))
    axis = (p.free[3] * x, p.free[4] * y, p.free[5] * z)
    size = np.sqrt(dot(axis, axis))
    s.wanted_sine = size / p.gravity
    s.gain += s.gain_step
    angle = np.arcsin(min(s.wanted_sine, s.gain * p.steepest))
    away = fast = 0.0
    for k in range(3):
        goal = angle * axis[k] / size if size > 0.0 else 0.0
        fast += (goal - s.goal[k]) ** 2
        s.goal[k] = goal
        away += (goal - s.tilt[k]) ** 2
    s.goal_speed = np.sqrt(fast) / h
    away = np.sqrt(away)
    share = min(1.0, p.tilt_speed * h / away) if away > 0.0 else 1.0
    s.lagging = 1.0 if share < 1.0 else 0.0
    fast = 0.0
    for k in range(3):
        before, first, second = s.tilt[k], s.tilted[0, k], s.tilted[1, k]
        s.tilt[k] = before + share * (s.goal[k] - before)
        s.tilted[0, k] = low_pass(first, before, s.tilt[k], h * p.tilt_smoothing)
        s.tilted[1, k] = low_pass(second, first, s.tilted[0, k], h * p.tilt_smoothing)
        fast += (s.tilted[1, k] - second) ** 2
    s.tilt_speed = np.sqrt(fast) / h


@kernel
def _turn(p: Record, s: Record, h: float) -> None:
    """Turn with the vehicle for a moment, besides the tilt."""
    for k in range(3):
        before, first, second, third = s.rate[k], s.turned[0, k], s.turned[1, k], s.turned[2, k]
        s.rate[k] = before + s.rate_step[k]
        s.turned[0, k] = low_pass(first, before, s.rate[k], h * p.smoothing)
        s.turned[1, k] = low_pass(second, first, s.turned[0, k], h * p.smoothing)
        s.turned[2, k] = low_pass(third, second, s.turned[1, k], h * p.turn_washout)
        s.turned[3, k] = low_pass(s.turned[3, k], third, s.turned[2, k], h * p.turn_washout)
        s.turn[k] = p.free[3 + k] * (s.tilted[1, k] + (s.turned[2, k] - s.turned[3, k]) / p.turn_washout)
        for i in range(3):
            s.rotation[k, i] = 1.0 if i == k else 0.0
    rotate_by_vector(s.rotation, s.turn)


@kernel
def _move(p: Record, s: Record, h: float) -> None:
    """Move by what the turn does not render."""
    for k in range(3):
        before, first = s.force[k], s.smooth[0, k]
        s.force[k] = before + s.force_step[k]
        s.smooth[0, k] = low_pass(first, before, s.force[k], h * p.smoothing)
        s.smooth[1, k] = low_pass(s.smooth[1, k], first, s.smooth[0, k], h * p.smoothing)
    rest = scale(p.gravity, vector(p.up))
    seen = subtract(rotate(s.rotation, add(rest, vector(s.smooth[1]))), rest)
    w = p.washout
    for k in range(3):
        before, first, last = s.left[k], s.washed[0, k], s.washed[1, k]
        s.wanted[k] = p.free[k] * seen[k]
        s.left[k] = clipped(s.wanted[k], s.gain * p.most_acceleration[k])
        s.washed[0, k] = low_pass(first, before, s.left[k], h * w)
        s.washed[1, k] = low_pass(last, first, s.washed[0, k], h * w)
        s.returned[k] = low_pass(s.returned[k], last, s.washed[1, k], h * p.back)
        s.move[k] = (s.washed[1, k] - s.returned[k]) / (w * w)
