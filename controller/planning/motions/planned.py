"""From a motion to its reference: every element within the limits of the tool and of all actuators.

A way (line, arc, spline without times) is run through by ruckig: its parameter goes from 0 to 1 with limits of its rate,
acceleration and jerk, which are fitted to what the way needs of tool and actuators. An element with times of its own is
sampled. In all cases the reference of each actuator is the cubic spline through its lengths, so what the limits are held
against is what the actuators will follow. The time of each element is then scaled: k times longer, velocities are k,
accelerations k^2 and jerks k^3 times smaller, exactly. A cue has the times of its vehicle: that is scaled instead.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, inf
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruckig import InputParameter, Ruckig, Trajectory

from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.cueing import Site
from controller.planning.motions.elements import (
    KINDS,
    MOST_DURATION_S,
    Course,
    Cueing,
    Dwell,
    Element,
    Loop,
    Motion,
    Moving,
    ToolLimits,
)
from controller.planning.motions.rendering import Rendered, Rendering
from controller.planning.motions.splines import curve_at, extrema_of, natural_spline, spline_at_rest, stretched
from controller.planning.segments import LENGTH, START, state_after, write_segment
from controller.planning.trajectory_generator import calculate, phases_of
from plant.errors import InputError, PlanningError, UnreachableError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose, quaternion_from_rotation, rotations_from_quaternions

TARGET_PERIOD_S = 0.002
"""Period of the poses of a motion's target, so dense that what lies between them does not matter."""

_HOME = Pose(np.zeros(3), np.eye(3))

_ROOM = 1e-6
"""Share of each limit that is left for rounding."""

_STROKE_SLACK = 1e-9
"""As in `controller.planning.offline_planner` [m]."""

_PACES = (1.0, 0.92, 0.84, 0.74, 0.6, 0.45)
"""Shares of the fastest cruise that are tried for a way: a slower one leaves more acceleration for where the way bends."""

_FITS = 4
_TOOL_SAMPLES = 8
"""How often a way is fitted to the limits at each pace, and how many samples of the tool's motion an interval has."""

_MOST_KNOTS = 6000
_LONGEST_PERIOD_S = 0.1

LEG_QUANTITIES = (("velocity", "m/s"), ("acceleration", "m/s^2"), ("jerk", "m/s^3"))
TOOL_QUANTITIES = tuple(
    (name, unit, 1 + i % 3)
    for i, (name, unit) in enumerate(
        zip(ToolLimits.__dataclass_fields__, ("m/s", "m/s^2", "m/s^3", "rad/s", "rad/s^2", "rad/s^3"), strict=True)
    )
)


@dataclass(frozen=True)
class Peak:
    """The greatest value of a quantity, and its limit."""

    name: str  # such as "velocity of leg 2", or "speed of the tool"
    unit: str
    order: int  # of the derivative: 1 to 3
    value: float
    most: float  # the limit; inf without one
    time: float  # [s]

    @property
    def share(self) -> float:
        """The value as a share of its limit."""
        return self.value / self.most

    @property
    def stretch(self) -> float:
        """By what the time must be scaled for the value to reach its limit."""
        return float(self.share ** (1.0 / self.order))

    def plain(self) -> dict[str, Any]:
        """The figures, in SI units; no limit is None."""
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "limit": None if self.most == inf else self.most,
            "time": self.time,
        }

    def later(self, begin: float, factor: float = 1.0) -> "Peak":
        """The peak, if all is `factor` times slower, and begins at a time [s]."""
        value = self.value / factor**self.order
        return Peak(self.name, self.unit, self.order, value, self.most, begin + factor * self.time)


@dataclass(frozen=True, eq=False)
class Part:
    """A planned element, or its dwell."""

    label: str  # such as "2 (line)"
    kind: str
    begin: float  # [s]
    duration: float  # [s]
    legs: Array  # (n, m, 5), the lengths over the time since it began
    poses: Array  # (7, m, 5), position and quaternion, as displacements from home
    peaks: tuple[Peak, ...]
    asked: Peak | None = None  # what has slowed it, as it would have been by its own times
    scale: float = 1.0  # by what it is slower than by its own times
    cue: Rendered | None = None  # what was clipped of a vehicle's motion, and how good the cue is

    @property
    def binding(self) -> Peak | None:
        """The limit that is used most."""
        return max(self.peaks, key=lambda peak: peak.share, default=None)


@dataclass(frozen=True, eq=False)
class PlannedMotion:
    """A motion that every actuator can follow."""

    name: str
    parts: tuple[Part, ...]
    segments: Array  # (n, m, 5), the reference of each actuator
    times: Array  # (N,) [s], of the poses
    positions: Array  # (N, 3) [m], of {2} in {1}
    rotations: Array  # (N, 3, 3)

    @property
    def duration(self) -> float:
        """How long it takes [s]."""
        return self.parts[-1].begin + self.parts[-1].duration

    @property
    def peaks(self) -> list[Peak]:
        """The greatest values of all quantities over the whole motion."""
        greatest: dict[str, Peak] = {}
        for peak in (peak for part in self.parts for peak in part.peaks):
            if peak.name not in greatest or peak.value > greatest[peak.name].value:
                greatest[peak.name] = peak
        return list(greatest.values())

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units."""
        parts = [
            {
                "element": part.label,
                "kind": part.kind,
                "begin": part.begin,
                "duration": part.duration,
                "slowed_by": part.scale,
                "binding": None if part.binding is None else part.binding.name,
                "peaks": [peak.plain() for peak in part.peaks],
                **({} if part.cue is None else {"cue": part.cue.plain()}),
            }
            for part in self.parts
        ]
        peaks = [peak.plain() for peak in self.peaks]
        return {"name": self.name, "duration": self.duration, "elements": parts, "peaks": peaks, "remarks": self.remarks}

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was slowed, clipped or scaled, a line each."""
        slowed = (
            f"{self.name}, element {part.label}, is {part.scale:.4g} times slower than by its own times: {_excess(part.asked)}"
            for part in self.parts
            if part.asked is not None
        )
        cued = (
            f"{self.name}, element {part.label}: {remark}"
            for part in self.parts
            if part.cue is not None
            for remark in part.cue.remarks(part.begin)
        )
        return (*slowed, *cued)


def _excess(peak: Peak) -> str:
    return f"the {peak.name} would be {peak.value:.4g} {peak.unit} at {peak.time:.3f} s, with a limit of {peak.most:.4g}"


def plan_motion(
    motion: Motion,
    mechanism: Mechanism,
    platform: Callable[[Array, Array], tuple[Array, Array]] | None = None,
    at_home: Pose = _HOME,
) -> PlannedMotion:
    """Plan a motion within the limits of the tool and of all actuators.

    Args:
        motion: what to do, in displacements.
        mechanism: its legs, home and limits.
        platform: gives positions (N, 3) and rotations (N, 3, 3) of {2} in {1} from those of the motion, which by default are
            displacements from home.
        at_home: what home is in the motion's own poses.

    Raises:
        UnreachableError: an actuator would leave its stroke.
        InputError: an element cannot be meant, or is too fast by its own times; the error names the time scale that would do.
        PlanningError: ruckig found no way.
    """
    home = mechanism.require_home()

    def from_home(positions: Array, rotations: Array) -> tuple[Array, Array]:
        return home.position + positions, rotations @ home.rotation

    planner = _MotionPlanner(motion, mechanism, platform or from_home, at_home)
    return planner.plan()


class _MotionPlanner:
    def __init__(
        self,
        motion: Motion,
        mechanism: Mechanism,
        platform: Callable[[Array, Array], tuple[Array, Array]],
        at_home: Pose,
    ) -> None:
        limits = mechanism.require_limits()
        self._motion, self._mechanism, self._platform, self._stroke = motion, mechanism, platform, limits.stroke
        self._most = motion.actuator_share * np.array([limits.velocity, limits.acceleration, limits.jerk])
        self._known: dict[tuple[int, bytes], tuple[list[Part], Pose]] = {}
        self._pose = motion.start.after(at_home)
        self._time = 0.0
        # The first error, and the time scale at which none is left.
        self._refused: str | None = None
        self._needed = 1.0

    def plan(self) -> PlannedMotion:
        parts: list[Part] = []
        for part in self._planned(self._motion.elements, ""):
            parts.append(part)
            if self._time > MOST_DURATION_S:
                raise InputError(
                    f"{self._motion.name} takes more than {MOST_DURATION_S:g} s, at element {part.label}: choose a shorter one"
                )
        if self._refused is not None:
            # Rounded up, so that what is written back passes.
            scale = ceil(1e4 * self._needed) / 1e4
            raise InputError(
                f"{self._refused}: it passes with time_scale = {scale:.4f} (all of the motion slower), or with slow_down = true"
            )
        segments = np.concatenate(
            [part.legs[:, :-1] + [part.begin, 0, 0, 0, 0] for part in parts]
            + [parts[-1].legs[:, -1:] + [parts[-1].begin, 0, 0, 0, 0]],
            axis=1,
        )
        times = np.arange(ceil(self._time / TARGET_PERIOD_S - 1e-9) + 1) * TARGET_PERIOD_S
        begins = np.array([part.begin for part in parts])
        of = np.searchsorted(begins, times, side="right") - 1
        values = [curve_at(part.poses, times[of == i] - part.begin)[0] for i, part in enumerate(parts) if (of == i).any()]
        positions, rotations = self._poses_of(np.concatenate(values))
        return PlannedMotion(
            self._motion.name, tuple(parts), segments, np.append(times, times[-1] + 1.0),
            np.vstack([positions, positions[-1:]]), np.concatenate([rotations, rotations[-1:]]),
        )  # fmt: skip

    def _planned(self, elements: tuple[Element, ...], prefix: str) -> Iterator[Part]:
        for number, element in enumerate(elements, start=1):
            where = f"{prefix}{number}"
            if isinstance(element, Loop):
                for turn in range(element.count):
                    yield from self._planned(
                        element.elements, f"{where}, round {turn + 1}, " if element.count > 1 else f"{where}."
                    )
                continue
            kind = next(name for name, each in KINDS.items() if isinstance(element, each))
            label = f"{where} ({kind})"
            try:
                yield from self._parts_of(element, kind, label)
            except InputError as error:
                raise InputError(f"{self._motion.name}, element {label}: {error}") from None

    def _parts_of(self, element: Moving | Cueing | Dwell, kind: str, label: str) -> Iterator[Part]:
        key = id(element), np.concatenate([self._pose.position, self._pose.rotation.ravel()]).tobytes()
        if key not in self._known:
            parts = []
            dwell = element.duration if isinstance(element, Dwell) else element.dwell
            if isinstance(element, Cueing):
                parts.append(self._cued(element, kind, label))
            elif not isinstance(element, Dwell):
                parts.append(self._moved(element, kind, label))
            if dwell > 0.0 or not parts:
                parts.append(self._rested(max(dwell, 1e-3) * self._motion.time_scale, label))
            self._known[key] = parts, self._pose
        parts, self._pose = self._known[key]
        for part in parts:
            began = self._time
            self._time += part.duration
            yield Part(
                label, part.kind, began, part.duration, part.legs, part.poses, tuple(peak.later(began) for peak in part.peaks),
                None if part.asked is None else part.asked.later(began), part.scale, part.cue,
            )  # fmt: skip

    def _rested(self, duration: float, label: str) -> Part:
        values = np.concatenate([self._pose.position, quaternion_from_rotation(self._pose.rotation)])
        poses = np.zeros((7, 2, 5))
        poses[:, :, 1], poses[:, 1, START] = values[:, None], duration
        lengths = self._lengths(values[None])[0]
        legs = np.zeros((len(lengths), 2, 5))
        legs[:, :, 1], legs[:, 1, START] = lengths[:, None], duration
        self._check_stroke(label, legs, None)
        return Part(label, "dwell", 0.0, duration, legs, poses, ())

    def _moved(self, element: Moving, kind: str, label: str) -> Part:
        course, limits = element.course(self._pose), element.limits.over(self._motion.limits)
        scale = self._motion.time_scale
        asked: Peak | None = None
        if course.duration is None:
            legs, poses = self._fastest(course, limits)
            factor = self._needed_stretch(legs, poses, limits)[0] * max(1.0, scale)
            slower = 1.0
        else:
            count = max(8, ceil(course.duration / course.period))
            times = _merged(np.linspace(0.0, course.duration, count + 1), course.breaks, course.duration / count)
            legs, poses = self._curves(course, times, times)
            needed, worst = self._needed_stretch(legs, poses, limits)
            factor = slower = scale
            if needed > scale:
                factor = slower = needed
                asked = worst.later(0.0, scale)
                if not self._motion.slow_down and self._refused is None:
                    peak = asked.later(self._time)
                    self._refused = f"{self._motion.name}, element {label}, is too fast: {_excess(peak)}"
                if not self._motion.slow_down:
                    self._needed = max(self._needed, needed)
        legs, poses = stretched(legs, factor), stretched(poses, factor)
        self._check_stroke(label, legs, course)
        peaks = self._peaks(legs, poses, limits)
        self._pose = course.end
        return Part(label, kind, 0.0, float(legs[0, -1, START]), legs, poses, tuple(peaks), asked, slower)

    def _cued(self, element: Cueing, kind: str, label: str) -> Part:
        limits = element.limits.over(self._motion.limits)
        rendering = Rendering(element, Site(self._mechanism, self._pose, self._platform, element.point))
        while True:
            course, times = rendering.course, rendering.times
            legs, poses = self._curves(course, times, times)
            use, names = self._use(legs, poses, limits)
            if not rendering.reduce(use, legs[0, :-1, START], names):
                break
        self._check_stroke(label, legs, course)
        peaks = tuple(self._peaks(legs, poses, limits))
        return Part(label, kind, 0.0, float(times[-1]), legs, poses, peaks, cue=rendering.rendered())

    def _use(self, legs: Array, poses: Array, limits: ToolLimits) -> tuple[Array, list[str]]:
        """The shares (q, m - 1) of all limits that are used in each interval, and the names of the limits (q).

        That of a stroke is the share of the way from the first length to its end.
        """
        times = legs[0, :, START]
        middles = 0.5 * (times[:-1] + times[1:])
        values, between = (np.abs(each[1:]).transpose(0, 2, 1) for each in (curve_at(legs, times), curve_at(legs, middles)))
        sizes = np.maximum(np.maximum(values[..., :-1], values[..., 1:]), between)
        use, names = [*(sizes / self._most[:, None, None])], [f"{name} of leg" for name, _ in LEG_QUANTITIES]
        first = legs[:, :1, LENGTH]
        room = self._stroke - first
        lengths = np.stack([legs[:, :-1, LENGTH], curve_at(legs, middles)[0].T, legs[:, 1:, LENGTH]]) - first
        use.append(np.maximum(lengths.max(axis=0) / room[:, 1:], lengths.min(axis=0) / room[:, :1]))
        names.append("stroke of leg")
        most = np.array([getattr(limits, name) for name, _, _ in TOOL_QUANTITIES])
        tool = np.array(tool_sizes(curve_at(poses, times))) / most[:, None]
        use.append(np.maximum(tool[:, :-1], tool[:, 1:]))
        return np.concatenate(use), [
            *(f"{name} {leg}" for name in names for leg in range(len(legs))),
            *(f"{name.replace('_', ' ')} of the tool" for name, _, _ in TOOL_QUANTITIES),
        ]

    def _check_stroke(self, label: str, legs: Array, course: Course | None) -> None:
        """Check the lengths (n, m, 5) against the strokes, or raise an `UnreachableError` with the first time outside."""
        stroke = self._stroke
        extrema = _extrema(legs)[0]
        if np.maximum(stroke[:, 0] - extrema[:, 0], extrema[:, 1] - stroke[:, 1]).max() <= _STROKE_SLACK:
            return
        knots = legs[0, :, START]
        times = np.sort(np.concatenate([knots, 0.5 * (knots[1:] + knots[:-1])]))
        lengths = curve_at(legs, times)[0]
        excess = np.maximum(stroke[:, 0] - lengths, lengths - stroke[:, 1])
        first = int((excess.max(axis=1) >= min(_STROKE_SLACK, float(excess.max()))).argmax())
        leg = int(excess[first].argmax())
        farthest = 1e3 * lengths[excess[:, leg].argmax(), leg]
        reached = ""
        if course is not None and (inside := self._reach(course)) is not None:
            x, y, z = 1e3 * inside[1]
            reached = f"; up to {100.0 * inside[0]:.1f} % of it, at ({x:.2f}, {y:.2f}, {z:.2f}) mm, all are within theirs"
        least, most = 1e3 * stroke[leg]
        raise UnreachableError(
            f"{self._motion.name}, element {label}, leaves the strokes at {self._time + times[first]:.3f} s: leg {leg} would "
            f"go to {farthest:.2f} mm, with a stroke of {least:.2f} to {most:.2f} mm{reached}: choose a smaller motion"
        )

    def _reach(self, course: Course) -> tuple[float, Array] | None:
        """The share of a way, or of a time, up to which all legs are within their strokes, and the position (3,) there."""
        last = course.duration or 1.0

        def inside(parameters: Array) -> NDArray[np.bool_]:
            lengths = self._lengths(np.hstack(course.at(parameters)))
            excess: Array = np.maximum(self._stroke[:, 0] - lengths, lengths - self._stroke[:, 1]).max(axis=1)
            return excess <= 0.0

        grid = np.linspace(0.0, last, 2001)
        out = np.flatnonzero(~inside(grid))
        if not len(out) or out[0] == 0:
            return None
        low, high = grid[out[0] - 1], grid[out[0]]
        for _ in range(40):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if inside(np.array([middle]))[0] else (low, middle)
        return float(low / last), course.at(np.array([low]))[0][0]

    # ------------------------------------------------------------------------------------------------------------- curves

    def _poses_of(self, values: Array) -> tuple[Array, Array]:
        """Positions (N, 3) and rotations (N, 3, 3) of {2} in {1} from displacements (N, 7)."""
        quaternions = values[:, 3:] / np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        return self._platform(values[:, :3], rotations_from_quaternions(quaternions))

    def _lengths(self, values: Array) -> Array:
        return leg_lengths(self._mechanism, *self._poses_of(values))

    def _curves(self, course: Course, times: Array, parameters: Array) -> tuple[Array, Array]:
        """Lengths (n, m, 5) and poses (7, m, 5) over times, from rest to rest."""
        values = np.hstack(course.at(parameters))
        return spline_at_rest(times, self._lengths(values)), spline_at_rest(times, values)

    def _peaks(self, legs: Array, poses: Array, limits: ToolLimits, samples: int = _TOOL_SAMPLES) -> list[Peak]:
        """The greatest values of all quantities: those of the actuators exactly, those of the tool by samples."""
        extrema, places = _extrema(legs)
        peaks = []
        for q, (name, unit) in enumerate(LEG_QUANTITIES):
            leg = int(extrema[:, 2 + q].argmax())
            value, time = float(extrema[leg, 2 + q]), float(places[leg, 2 + q])
            peaks.append(Peak(f"{name} of leg {leg}", unit, 1 + q, value, float(self._most[q]), time))
        knots = poses[0, :, START]
        shares = np.arange(samples) / samples
        times = np.append((knots[:-1, None] + shares * np.diff(knots)[:, None]).ravel(), knots[-1])
        for (name, unit, order), sizes in zip(TOOL_QUANTITIES, tool_sizes(curve_at(poses, times)), strict=True):
            at = int(sizes.argmax())
            peaks.append(
                Peak(
                    f"{name.replace('_', ' ')} of the tool",
                    unit,
                    order,
                    float(sizes[at]),
                    getattr(limits, name),
                    float(times[at]),
                )
            )
        return peaks

    def _needed_stretch(self, legs: Array, poses: Array, limits: ToolLimits) -> tuple[float, Peak]:
        """By what the time must be scaled so that the tightest limit is just reached, and what is there now."""
        worst = max(self._peaks(legs, poses, limits), key=lambda peak: peak.stretch)
        return worst.stretch * (1.0 + _ROOM), worst

    # --------------------------------------------------------------------------------------------------------------- ways

    def _fastest(self, course: Course, limits: ToolLimits) -> tuple[Array, Array]:
        """Lengths and poses of the fastest run that was found through a way, up to a scale of its time."""
        found: tuple[float, tuple[Array, Array]] | None = None
        for start in self._first_guesses(course, limits):
            most = start
            for _ in range(_FITS):
                profile = _profile(*most)
                curves = self._along(course, profile)
                peaks = self._peaks(*curves, limits, 2)
                shares = np.array([max(peak.share for peak in peaks if peak.order == order) for order in (1, 2, 3)])
                duration = profile[0, -1, START] * max(peak.stretch for peak in peaks)
                if found is None or duration < found[0]:
                    found = duration, curves
                most = most / np.clip(shares, 0.5, 2.0)
        assert found is not None
        return found[1]

    def _first_guesses(self, course: Course, limits: ToolLimits) -> Iterator[Array]:
        """Limits (3,) of the parameter's rate, acceleration and jerk, from the derivatives of tool and actuators by it."""
        spans = np.concatenate([[0.0], course.breaks, [1.0]])
        inner = max(8, 256 // (len(spans) - 1))
        grid = np.concatenate([np.linspace(a, b, inner, endpoint=False) for a, b in pairwise(spans)])
        grid = np.append(grid, 1.0)
        values = np.hstack(course.at(grid))
        legs = np.abs(curve_at(natural_spline(grid, self._lengths(values)), grid)[1:]).max(axis=(1, 2))
        tool = np.array(tool_sizes(curve_at(natural_spline(grid, values), grid))).max(axis=1).reshape(2, 3)
        most = np.array([getattr(limits, name) for name, _, _ in TOOL_QUANTITIES]).reshape(2, 3)
        # Rows: first to third derivative by the parameter; columns: over the limit of velocity, acceleration, jerk.
        use = np.maximum(legs[:, None] / self._most, (tool[:, :, None] / most[:, None, :]).max(axis=0))
        for pace in _PACES:
            yield parameter_limits(use, pace)

    def _along(self, course: Course, profile: Array) -> tuple[Array, Array]:
        """Lengths and poses over time, if the parameter goes as the profile (1, m, 5)."""
        bounds = profile[0, :, START]
        duration = bounds[-1]
        period = float(np.clip(duration / _MOST_KNOTS, course.period, max(course.period, _LONGEST_PERIOD_S)))
        phases = [np.linspace(a, b, max(2, ceil((b - a) / period)), endpoint=False) for a, b in pairwise(bounds)]
        times = np.append(np.concatenate(phases), duration)
        if len(course.breaks):
            dense = np.linspace(0.0, duration, 20 * len(times))
            breaks = np.interp(course.breaks, curve_at(profile, dense)[0][:, 0], dense)
            times = _merged(times, breaks, period)
        parameters = np.clip(curve_at(profile, times)[0][:, 0], 0.0, 1.0)
        parameters[-1] = 1.0
        return self._curves(course, times, parameters)


def parameter_limits(use: Array, pace: float) -> Array:
    """Limits (3,) of the rate, acceleration and jerk of a way's parameter that keep those of what moves along it, as far as one
    number for the whole way can tell.

    Args:
        use: (3, 3), the greatest first to third derivative by the parameter over the limits of velocity, acceleration and jerk.
        pace: share of the fastest cruise.
    """
    use = np.maximum(use, 1e-9)
    v = pace * min(1.0 / use[0, 0], use[1, 1] ** -0.5, use[2, 2] ** (-1.0 / 3.0))
    a = max(1.0 - use[1, 1] * v * v, 0.05) / use[0, 1]
    j = max(1.0 - 3.0 * v * a * use[1, 2] - v**3 * use[2, 2], 0.1) / use[0, 2]
    return np.array([v, a, j])


def _extrema(curve: Array) -> tuple[Array, Array]:
    """Extrema (m, 5) of a curve, and their places (m, 5)."""
    extrema, places = np.zeros((len(curve), 5)), np.zeros((len(curve), 5))
    extrema_of(curve, extrema, places)
    return extrema, places


def _merged(times: Array, breaks: Array, period: float) -> Array:
    """Knots with the breaks among them; a knot too close to a break gives way."""
    if not len(breaks):
        return times
    near = np.abs(times[:, None] - breaks).min(axis=1) < 0.2 * period
    near[[0, -1]] = False
    inner = breaks[(breaks > times[0] + 1e-6) & (breaks < times[-1] - 1e-6)]
    return np.unique(np.concatenate([times[~near], inner]))


def _profile(rate: float, acceleration: float, jerk: float) -> Array:
    """The fastest way of a parameter (1, m, 5) from rest at 0 to rest at 1, by ruckig."""
    parameters, trajectory = InputParameter(1), Trajectory(1)
    parameters.target_position = [1.0]
    parameters.max_velocity, parameters.max_acceleration, parameters.max_jerk = [rate], [acceleration], [jerk]
    if not calculate(Ruckig(1), parameters, ([0.0], [0.0], [0.0]), trajectory):
        raise PlanningError(
            f"ruckig finds no way within a rate of {rate:g}, an acceleration of {acceleration:g}, a jerk of {jerk:g}"
        )
    durations, jerks = phases_of(trajectory)[0]
    kept = durations > 1e-7 * trajectory.duration
    curve, state, at = np.zeros((1, int(kept.sum()) + 1, 5)), (0.0, 0.0, 0.0), 0.0
    for row, (t, j) in enumerate(zip(durations[kept], jerks[kept], strict=True)):
        write_segment(curve[0, row], at, state, j)
        state, at = state_after(state, j, t), at + t
    write_segment(curve[0, -1], at, (1.0, 0.0, 0.0), 0.0)
    return curve


def tool_sizes(derivatives: Array) -> list[Array]:
    """Sizes (N,) of speed, acceleration and jerk, and of those of the turn, from the derivatives (4, N, 7) of poses."""
    positions, (q, q1, q2, q3) = derivatives[1:, :, :3], derivatives[:, :, 3:]

    def turning(first: Array, second: Array) -> Array:
        """Twice the vector part of `first` times the conjugate of `second`."""
        a, b, u, v = first[:, :1], second[:, :1], first[:, 1:], second[:, 1:]
        part: Array = 2.0 * (b * u - a * v - np.cross(u, v))
        return part

    turns = turning(q1, q), turning(q2, q), turning(q3, q) + turning(q2, q1)
    return [np.linalg.norm(each, axis=1) for each in (*positions, *turns)]
