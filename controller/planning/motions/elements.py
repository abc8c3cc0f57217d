"""The elements of a motion: lines, arcs, splines, waves, cues, dwells and loops, as a file has them and Python makes them.

Poses here are displacements: a position (3,) [m] from home, and the rotation (3, 3) from home's orientation, along and about
the axes of {1}; with frames of the user's own they are what these say (`controller.frames`). Each element begins at rest where
the one before has ended, and ends at rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from math import inf

import numpy as np

from controller.planning.motions.cueing import Washout, quaternions_of, read_vehicle
from controller.planning.motions.splines import curve_at, natural_spline, quintic_spline, quintic_values, spline_at_rest
from controller.planning.motions.waves import AnyWave, checked_number
from plant.errors import InputError
from plant.pose import Array, Pose, checked_array, quaternion_from_rotation, rotation_from_vector, vector_from_rotation

Numbers = tuple[float, ...]

MOST_DURATION_S = 3600.0
"""The longest motion."""

PERIOD_S = 0.01
SAMPLES_PER_WAVE = 25
"""Knots of the reference: so far apart at most, and so many for each period of the fastest wave."""

_SAME_M, _SAME_RAD = 1e-9, 1e-9
_LARGEST_TURN = np.radians(179.0)
"""The shortest turn to an orientation half a turn away can go either way round."""

_LARGEST_STEP = np.radians(120.0)
"""Between two points of a spline."""


@dataclass(frozen=True)
class ToolLimits:
    """What the tool, the origin of {2}, may do: the rest of it is up to the actuators."""

    speed: float = inf  # greatest [m/s]
    acceleration: float = inf  # greatest, along the way and across [m/s^2]
    jerk: float = inf  # greatest [m/s^3]
    turn_speed: float = inf  # greatest, of the orientation [rad/s]
    turn_acceleration: float = inf  # likewise [rad/s^2]
    turn_jerk: float = inf  # likewise [rad/s^3]

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if value != inf:
                checked_number(value, each.name, 1e-9)

    def over(self, general: "ToolLimits") -> "ToolLimits":
        """These limits, and those of the whole motion where there are none of one's own."""
        chosen = {each.name: getattr(self, each.name) for each in fields(self)}
        return ToolLimits(**{k: getattr(general, k) if value == inf else value for k, value in chosen.items()})


@dataclass(frozen=True)
class Place:
    """A pose to go to; what is not given remains as it is."""

    position: Numbers | None = None  # (3,) [m]
    rotation: Numbers | None = None  # (3,), rotation vector [rad]
    relative: bool = False  # to where the element begins

    def __post_init__(self) -> None:
        for name in ("position", "rotation"):
            if getattr(self, name) is not None:
                checked_array(getattr(self, name), (3,), name)

    def after(self, start: Pose) -> Pose:
        """The pose, if the element begins at `start`."""
        position, rotation = start.position, start.rotation
        if self.position is not None:
            position = np.array(self.position, float) + (start.position if self.relative else 0.0)
        if self.rotation is not None:
            rotation = rotation_from_vector(self.rotation) @ (start.rotation if self.relative else np.eye(3))
        return Pose(position, rotation)


@dataclass(frozen=True, eq=False)
class Course:
    """Where an element leads.

    Attributes:
        at: positions (N, 3) [m] and quaternions (N, 4) of one sign at parameters (N,), which go from 0 to 1 along a way, and
            are times [s] for an element that has times of its own.
        end: the last pose.
        breaks: parameters at which third derivatives may jump.
        duration: of an element that has times of its own [s]; None for a way.
        period: most distance of the knots of the reference [s].
    """

    at: Callable[[Array], tuple[Array, Array]]
    end: Pose
    breaks: Array
    duration: float | None = None
    period: float = PERIOD_S


def turned_quaternions(vector: Array, quaternion: Array) -> Array:
    """The quaternions (N, 4) of turns by rotation vectors (N, 3), after one of `quaternion` (4,)."""
    w, x, y, z = quaternions_of(vector).T
    a, b, c, d = quaternion
    return np.column_stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ]
    )


def blended(x: Array) -> Array:
    """Shares (N,) that go from 0 to 1 with x, so smoothly that three derivatives vanish at either end."""
    x = np.clip(x, 0.0, 1.0)
    shares: Array = x**4 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
    return shares


def _turn_between(start: Array, end: Array) -> Array:
    """The rotation vector (3,) of the shortest turn between rotations (3, 3), or an `InputError` if it is half a turn."""
    turn: Array = vector_from_rotation(end @ start.T)
    angle = float(np.linalg.norm(turn))
    if angle > _LARGEST_TURN:
        raise InputError(
            f"the orientation turns by {np.degrees(angle):.1f} deg, and may go either way round: "
            f"turn by {np.degrees(_LARGEST_TURN):.0f} deg at most, and give a point in between"
        )
    return turn


def _check_moves(start: Pose, end: Pose, turn: Array) -> None:
    if np.linalg.norm(end.position - start.position) < _SAME_M and np.linalg.norm(turn) < _SAME_RAD:
        raise InputError("it ends where it begins, so there is no way: leave it out, or write a dwell")


@dataclass(frozen=True)
class Line:
    """A straight way: the position on a straight line, the orientation on the shortest turn, both in proportion."""

    to: Place
    dwell: float = 0.0  # rest at its end [s]
    limits: ToolLimits = field(default_factory=ToolLimits)

    def __post_init__(self) -> None:
        checked_number(self.dwell, "dwell", 0.0, MOST_DURATION_S)

    def course(self, start: Pose) -> Course:
        """Where it leads from a pose."""
        end = self.to.after(start)
        turn, move = _turn_between(start.rotation, end.rotation), end.position - start.position
        _check_moves(start, end, turn)
        quaternion = quaternion_from_rotation(start.rotation)

        def at(s: Array) -> tuple[Array, Array]:
            return start.position + s[:, None] * move, turned_quaternions(s[:, None] * turn, quaternion)

        return Course(at, end, np.empty(0))


@dataclass(frozen=True)
class Arc:
    """A part of a circle: through a point to an end, or by an angle about an axis through a centre.

    The orientation goes the shortest turn to that of the end, in proportion to the way.
    """

    to: Place | None = None  # the end; with a centre, its orientation alone
    through: Place | None = None  # a point of the circle between start and end
    centre: Place | None = None  # instead of `through`: a point of the axis
    angle: float | None = None  # with a centre: how far to go about it [rad]
    axis: Numbers = (0.0, 0.0, 1.0)  # with a centre
    dwell: float = 0.0  # rest at its end [s]
    limits: ToolLimits = field(default_factory=ToolLimits)

    def __post_init__(self) -> None:
        checked_number(self.dwell, "dwell", 0.0, MOST_DURATION_S)
        if (self.through is None) == (self.centre is None):
            raise InputError("an arc goes through a point or about a centre: give one of them")
        if self.through is not None and (self.to is None or self.to.position is None or self.through.position is None):
            raise InputError("an arc through a point needs the positions of that point and of its end, to")
        if self.through is not None and self.angle is not None:
            raise InputError("an arc through a point ends at to: leave angle out, or give a centre")
        if self.centre is not None:
            if self.centre.position is None:
                raise InputError("a centre needs a position")
            if self.to is not None and self.to.position is not None:
                raise InputError("an arc about a centre ends after its angle: give to its orientation alone")
            if self.angle is None or checked_number(self.angle, "angle", -200.0 * np.pi, 200.0 * np.pi) == 0.0:
                raise InputError("an arc about a centre needs an angle other than 0: give angle or angle_deg")
            if np.linalg.norm(checked_array(self.axis, (3,), "axis")) < 1e-9:
                raise InputError("axis is of length 0; it must be a direction")

    def course(self, start: Pose) -> Course:
        """Where it leads from a pose."""
        p = start.position
        if self.centre is not None:
            axis = np.array(self.axis) / np.linalg.norm(self.axis)
            centre, angle = self.centre.after(start).position, float(self.angle or 0.0)
            centre = centre + axis * ((p - centre) @ axis)
        else:
            assert self.through is not None and self.to is not None
            centre, axis, angle = _circle_through(p, self.through.after(start).position, self.to.after(start).position)
        radius = p - centre
        if np.linalg.norm(radius) < 1e-6:
            raise InputError("it begins in its centre: give another centre")
        across = np.cross(axis, radius)
        rotation = start.rotation if self.to is None else self.to.after(start).rotation
        end = Pose(centre + np.cos(angle) * radius + np.sin(angle) * across, rotation)
        turn, quaternion = _turn_between(start.rotation, rotation), quaternion_from_rotation(start.rotation)

        def at(s: Array) -> tuple[Array, Array]:
            phi = angle * s[:, None]
            return centre + np.cos(phi) * radius + np.sin(phi) * across, turned_quaternions(s[:, None] * turn, quaternion)

        return Course(at, end, np.empty(0))


def _circle_through(first: Array, second: Array, third: Array) -> tuple[Array, Array, float]:
    """Centre, axis and angle [rad] of the arc from the first point through the second to the third."""
    a, b = second - first, third - first
    normal = np.cross(a, b)
    square = float(normal @ normal)
    if square < (1e-6 * np.linalg.norm(a) * np.linalg.norm(b)) ** 2 or square == 0.0:
        raise InputError("the three points of the arc lie on a line or coincide: take a line, or move the point in between")
    middle = ((a @ a) * np.cross(b, normal) - (b @ b) * np.cross(a, normal)) / (2.0 * square)
    axis, radius = normal / np.sqrt(square), -middle
    last = b - middle
    angle = float(np.arctan2(np.cross(radius, last) @ axis, radius @ last)) % (2.0 * np.pi)
    return first + middle, axis, angle


@dataclass(frozen=True)
class SplinePoint:
    """A point of a spline."""

    place: Place
    time: float | None = None  # since the element begins [s]
    velocity: Numbers | None = None  # (3,), there [m/s]
    turn_velocity: Numbers | None = None  # (3,), angular velocity [rad/s]; 0 if only the velocity is given


@dataclass(frozen=True)
class Spline:
    """A smooth way through points, from where it begins; with times, at these times; with velocities too, with these (PVT).

    Without times, or with times alone, position and quaternion are cubic splines; with velocities, quintics with a continuous
    third derivative.
    """

    points: tuple[SplinePoint, ...]
    dwell: float = 0.0  # rest at its end [s]
    limits: ToolLimits = field(default_factory=ToolLimits)

    def __post_init__(self) -> None:
        checked_number(self.dwell, "dwell", 0.0, MOST_DURATION_S)
        if not self.points:
            raise InputError("a spline needs at least one point")
        timed = [point.time is not None for point in self.points]
        if any(timed) and not all(timed):
            raise InputError(f"point {timed.index(False) + 1} has no time, and others have: give all of them times, or none")
        before = 0.0
        for number, point in enumerate(self.points, start=1):
            if point.time is not None:
                if checked_number(point.time, f"the time of point {number}", 0.0, MOST_DURATION_S) <= before + 1e-3:
                    raise InputError(f"point {number} has the time {point.time:g} s, which must be later than {before:g} s")
                before = point.time
            last = number == len(self.points)
            moves = [each for each in (point.velocity, point.turn_velocity) if each is not None]
            if moves and not all(timed):
                raise InputError(f"point {number} has a velocity and no time: give all points times, or no velocities")
            for each in moves:
                if checked_array(each, (3,), f"the velocity of point {number}").any() and last:
                    raise InputError("the last point has a velocity; a spline ends at rest: give 0, or leave it out")
        given = [point.velocity is not None or point.turn_velocity is not None for point in self.points[:-1]]
        if any(given) and not all(given):
            raise InputError(f"point {given.index(False) + 1} has no velocity, and others have: give all of them, or none")

    def course(self, start: Pose) -> Course:
        """Where it leads from a pose."""
        poses = [start, *(point.place.after(start) for point in self.points)]
        positions = np.array([pose.position for pose in poses])
        quaternions = quaternion_from_rotation(np.array([pose.rotation for pose in poses]))
        signs = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0.0, -1.0, 1.0)
        quaternions[1:] *= np.cumprod(signs)[:, None]
        steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
        turns = 2.0 * np.arccos(np.clip(np.sum(quaternions[1:] * quaternions[:-1], axis=1), -1.0, 1.0))
        if turns.max() > _LARGEST_STEP:
            point = int(turns.argmax()) + 1
            raise InputError(
                f"point {point} is turned by {np.degrees(turns.max()):.0f} deg from the one before, more than "
                f"{np.degrees(_LARGEST_STEP):.0f}: give a point in between"
            )
        values, moving = (
            np.hstack([positions, quaternions]),
            any(point.velocity or point.turn_velocity for point in self.points),
        )
        if self.points[0].time is None:
            # The parameter is about the length of the way; 0.2 m stands for a radian.
            lengths = np.hypot(steps, 0.2 * turns)
            if lengths.min() < _SAME_M:
                raise InputError(f"point {int(lengths.argmin()) + 1} is where the one before is: leave it out")
            knots = np.concatenate([[0.0], np.cumsum(lengths) / lengths.sum()])
            knots[-1] = 1.0
            if len(knots) == 2:
                knots, values = np.array([0.0, 0.5, 1.0]), np.array([values[0], values.mean(axis=0), values[1]])
            curve = natural_spline(knots, values)
            return Course(_normalised(lambda s: curve_at(curve, s)[0]), poses[-1], knots[1:-1])
        knots = np.array([0.0, *(point.time for point in self.points)], float)
        if moving:
            rates = np.zeros_like(values)
            for k, given in enumerate(self.points, start=1):
                rates[k, :3] = given.velocity or (0.0, 0.0, 0.0)
                w, *v = values[k, 3:]
                omega = np.array(given.turn_velocity or (0.0, 0.0, 0.0))
                rates[k, 3], rates[k, 4:] = -0.5 * omega @ v, 0.5 * (w * omega + np.cross(omega, v))
            second = quintic_spline(knots, values, rates)
            through = _normalised(lambda t: quintic_values(knots, values, rates, second, t))
        else:
            if len(knots) == 2:
                # The spline at rest needs a knot in between.
                knots, values = np.array([0.0, 0.5 * knots[1], knots[1]]), np.array([values[0], values.mean(axis=0), values[1]])
            curve = spline_at_rest(knots, values)
            knots = curve[0, :, 0]
            through = _normalised(lambda t: curve_at(curve, t)[0])
        return Course(through, poses[-1], knots[1:-1], duration=float(knots[-1]))


def _normalised(curve: Callable[[Array], Array]) -> Callable[[Array], tuple[Array, Array]]:
    """Positions and unit quaternions of a curve of seven values."""

    def at(s: Array) -> tuple[Array, Array]:
        values = curve(s)
        return values[:, :3], values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)

    return at


@dataclass(frozen=True)
class Wave:
    """Waves added up, as displacements from where the element begins, where it ends, too. They are blended in and out."""

    duration: float  # [s], with both blends
    waves: tuple[AnyWave, ...]
    blend: float = 1.0  # how long the waves take to come, and to go [s]
    dwell: float = 0.0  # rest at its end [s]
    limits: ToolLimits = field(default_factory=ToolLimits)

    def __post_init__(self) -> None:
        checked_number(self.duration, "duration", 0.1, MOST_DURATION_S)
        checked_number(self.blend, "blend", 0.02, 0.5 * self.duration)
        checked_number(self.dwell, "dwell", 0.0, MOST_DURATION_S)
        if not self.waves:
            raise InputError("waves is empty: give at least one")

    def course(self, start: Pose) -> Course:
        """Where it leads from a pose."""
        fastest = max(wave.fastest for wave in self.waves)
        period = min(PERIOD_S, self.blend / SAMPLES_PER_WAVE, 1.0 / (SAMPLES_PER_WAVE * max(fastest, 1e-9)))
        quaternion = quaternion_from_rotation(start.rotation)

        def at(times: Array) -> tuple[Array, Array]:
            share = blended(np.minimum(times, self.duration - times) / self.blend)
            moved = share[:, None] * np.sum([wave.at(times) for wave in self.waves], axis=0)
            return start.position + moved[:, :3], turned_quaternions(moved[:, 3:], quaternion)

        return Course(at, start, np.array([self.blend, self.duration - self.blend]), self.duration, period)


@dataclass(frozen=True, kw_only=True)
class Cueing(Washout):
    """What the platform renders of a vehicle's motion. It ends where it begins."""

    file: str  # of the vehicle's motion
    settle: float = 10.0  # time after the vehicle's motion to go back to where it begins [s]
    dwell: float = 0.0  # rest at its end [s]
    limits: ToolLimits = field(default_factory=ToolLimits)

    def __post_init__(self) -> None:
        super().__post_init__()
        checked_number(self.settle, "settle", 1.0, MOST_DURATION_S)
        checked_number(self.dwell, "dwell", 0.0, MOST_DURATION_S)
        read_vehicle(self.file)


@dataclass(frozen=True)
class Dwell:
    """Rest."""

    duration: float  # [s]

    def __post_init__(self) -> None:
        checked_number(self.duration, "duration", 0.0, MOST_DURATION_S)


@dataclass(frozen=True)
class Loop:
    """Elements, again and again."""

    count: int
    elements: "tuple[Element, ...]"

    def __post_init__(self) -> None:
        if not isinstance(self.count, int) or not 1 <= self.count <= 10_000:
            raise InputError(f"count is {self.count!r}; it must be a whole number from 1 to 10000")
        if not self.elements:
            raise InputError("a loop needs at least one element")


Moving = Line | Arc | Spline | Wave
Element = Moving | Cueing | Dwell | Loop

KINDS: dict[str, type[Element]] = {
    "line": Line,
    "arc": Arc,
    "spline": Spline,
    "wave": Wave,
    "cueing": Cueing,
    "dwell": Dwell,
    "loop": Loop,
}
"""The elements by their names in a motion file."""


@dataclass(frozen=True)
class Motion:
    """A whole motion, from rest to rest.

    Attributes:
        elements: one after the other.
        name: for messages and reports.
        limits: of the tool, for all elements that have none of their own.
        start: where it begins.
        time_scale: by what everything takes longer than it must.
        slow_down: whether elements with times of their own are slowed where these are too fast; else they are refused.
        actuator_share: share of the actuators' velocity, acceleration and jerk that may be used.
    """

    elements: tuple[Element, ...]
    name: str = "motion"
    limits: ToolLimits = field(default_factory=ToolLimits)
    start: Place = field(default_factory=Place)
    time_scale: float = 1.0
    slow_down: bool = False
    actuator_share: float = 1.0

    def __post_init__(self) -> None:
        if not self.elements:
            raise InputError("a motion needs at least one element")
        checked_number(self.time_scale, "time_scale", 0.01, 1000.0)
        checked_number(self.actuator_share, "actuator_share", 0.01, 1.0)
        if not isinstance(self.slow_down, bool):
            raise InputError(f"slow_down is {self.slow_down!r}; it must be true or false")
        if self.start.relative:
            raise InputError("the start cannot be relative: there is nothing before it")
