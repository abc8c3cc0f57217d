"""Whether a target can be followed: held against every limit before anything moves, or while it is streamed.

Two things end a target. A pose that exceeds a limit is out of reach at any pace: there is a reachable one nearest to it. A pace
at which a leg exceeds its velocity, acceleration or jerk passes with a longer time.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, NamedTuple

import numpy as np

from controller.direct_kinematics.lengths import kernels_of_lengths, poses_from_lengths
from controller.frames import ActiveFrames, Frames
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.planned import Peak
from controller.planning.offline_planner import Reference, kernels_of_plan, plan
from controller.planning.pace import exact_peaks, least_time_scale, target_peaks
from controller.planning.segments import lengths_along
from controller.planning.target import Target
from controller.pose_limits.limits import (
    BEYOND,
    JACOBIAN,
    LEAST_JACOBIAN,
    LIMITS,
    USUAL,
    Demands,
    Limit,
    least_conditioning,
    space_of,
)
from controller.pose_limits.margins import Margins, kernels_of_margins, margins
from controller.workspace.nearest import Nearest, nearest_reachable
from plant.checks import LEAST_TIME_SCALE
from plant.compiled import load_kernels
from plant.errors import MissingPackageError, UnreachableError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, vector_from_rotation

_PERIOD_S = 0.005
"""Time between the poses that are tried."""

_CHUNK = 20_000
"""Poses that are tried at once, so that an hour's motion needs no more memory."""

_SLACK = 1e-9
"""Rounding by which a limit may be exceeded, in its unit."""


class Excess(NamedTuple):
    """A limit, and how a pose of a target stands to it."""

    limit: Limit
    time: float  # [s]
    value: float  # in the unit of the limit
    bound: float  # what the value may be, at most or at least
    pose: Pose

    @property
    def text(self) -> str:
        """In words: limit, value, bound and time."""
        value, bound, unit = self.shown
        unit, side = f" {unit}" if unit else "", "most" if value > bound else "least"
        # So many digits that the two differ.
        digits = next((n for n in range(5, 12) if f"{value:.{n}g}" != f"{bound:.{n}g}"), 12)
        texts = [f"{each:.{digits}g}{unit}" for each in (value, bound)]
        return f"{self.limit.text} would be {texts[0]} at {self.time:.3f} s, and must be at {side} {texts[1]}"

    @property
    def shown(self) -> tuple[float, float, str]:
        """Value and bound in the unit in which they are shown, and that unit."""
        unit, scale = _SHOWN.get(self.limit.unit, (self.limit.unit, 1.0))
        return scale * self.value, scale * self.bound, unit

    def plain(self) -> dict[str, Any]:
        """The figures, in SI units."""
        return {
            "limit": self.limit.text, "kind": self.limit.kind, "legs": list(self.limit.legs), "unit": self.limit.unit,
            "time": self.time, "value": self.value, "bound": self.bound, "position": self.pose.position.tolist(),
            "rotation": self.pose.rotation.tolist(),
        }  # fmt: skip


_SHOWN = {"m": ("mm", 1e3), "rad": ("deg", float(np.degrees(1.0))), "1": ("", 1.0)}


@dataclass(frozen=True, eq=False)
class TargetCheck:
    """What a target needs of a mechanism.

    Attributes:
        target: that was checked.
        duration: of it that was checked [s].
        first: the first limit that a pose exceeds; None if it can be reached all the way.
        worst: the limit that is exceeded most, at the pose that does so.
        nearest: the reachable pose nearest to that.
        closest: of each kind of limit, where the target comes closest to it.
        peaks: the greatest speed, acceleration and jerk of legs and platform, of the target; if its poses are held, those of
            the reference.
        reference: the plan; None if a pose is out of reach.
    """

    target: Target
    duration: float
    first: Excess | None
    worst: Excess | None
    nearest: Nearest | None
    closest: tuple[Excess, ...]
    peaks: tuple[Peak, ...]
    reference: Reference | None
    _mechanism: Mechanism = field(repr=False)

    @property
    def fast(self) -> Peak | None:
        """The limit of the legs' pace that is exceeded most; None if the target is not too fast."""
        peaks = [peak for peak in self.peaks if peak.most < inf]
        worst = max(peaks, key=lambda peak: peak.stretch, default=None)
        return worst if worst is not None and worst.share > 1.0 + _SLACK else None

    @property
    def passes(self) -> bool:
        """Whether nothing is exceeded."""
        return self.first is None and self.fast is None

    def time_scale(self, at_least: float = LEAST_TIME_SCALE) -> float:
        """The least factor on the target's times that passes; above 1 it is too fast."""
        return least_time_scale(self._mechanism, self.target, at_least)

    def refusal(self, frames: ActiveFrames | None = None) -> str:
        """Why it cannot be reached, in words, and what can be; "" if it can."""
        if self.first is None or self.worst is None:
            return ""
        text = f"the target {self.target.name} is out of reach: {self.first.text}"
        if self.worst.time != self.first.time:
            text += f"; farthest out, {self.worst.text}"
        if self.nearest is not None:
            where = pose_text(self.nearest.pose, self._mechanism.require_home(), frames)
            text += f"; there, the nearest pose within all limits is {where}"
        return f"{text}: {self.target.likely_reading(self._mechanism) or 'choose a smaller motion'}"

    @property
    def remark(self) -> str:
        """What a user should know of the pace of a target that can be reached, in a line; "" if it passes."""
        if self.fast is None or self.first is not None:
            return ""
        peak = self.fast
        return (
            f"the target {self.target.name} is too fast, and the reference stays behind it: the {peak.name} would be "
            f"{peak.value:.4g} {peak.unit} at {peak.time:.3f} s, with a limit of {peak.most:.4g}; it passes with --time-scale "
            f"{self.time_scale(1.0):.4f}"
        )

    def require_reachable(self, frames: ActiveFrames | None = None) -> Reference:
        """The plan of a target that can be reached, or an `UnreachableError`."""
        if self.reference is None or self.first is not None:
            raise UnreachableError(self.refusal(frames))
        return self.reference

    def summary(self) -> dict[str, Any]:
        """The figures, in SI units."""
        nearest = self.nearest
        return {
            "name": self.target.name,
            "duration": self.duration,
            "passes": self.passes,
            "first": None if self.first is None else self.first.plain(),
            "worst": None if self.worst is None else self.worst.plain(),
            "nearest": None if nearest is None else {
                "position": nearest.pose.position.tolist(), "rotation": nearest.pose.rotation.tolist(),
                "distance": nearest.distance, "angle": nearest.angle,
            },
            "closest": [excess.plain() for excess in self.closest],
            "peaks": [peak.plain() for peak in self.peaks],
            "time_scale": None if self.reference is None else self.time_scale(),
        }  # fmt: skip


def load_check(mechanism: Mechanism) -> None:
    """Load the machine code of `check_against_limits` beforehand; what is not in the cache is compiled on all cores."""
    lengths = lengths_along, np.zeros((mechanism.legs, 1, 5)), np.zeros(1), np.zeros((1, mechanism.legs))
    load_kernels(*kernels_of_margins(mechanism), *kernels_of_plan(), *kernels_of_lengths(mechanism), lengths)


def check_against_limits(mechanism: Mechanism, target: Target, duration: float, demands: Demands | None = None) -> TargetCheck:
    """Hold a target against all limits of `controller.workspace`, and plan it if its poses can be reached.

    Poses are tried each 5 ms and at the target's own samples: those of the target, and those of the reference, which goes its
    own way between poses that are held, and where it cannot keep up.

    Args:
        mechanism: with home and limits.
        target: what to follow.
        duration: of the motion [s].
        demands: what is asked of a pose besides that the legs reach it, as for `controller.workspace.margins`.

    Raises:
        InputError: the mechanism has no home or no limits.
        PlanningError: ruckig found no motion, not even a stop.
    """
    demands = demands or USUAL
    end = min(duration, float(target.times[-1])) if target.segments is None else duration
    grid = np.arange(0.0, end + _PERIOD_S, _PERIOD_S)
    times = np.union1d(grid, target.times[target.times <= end])
    tally = _Tally(mechanism, demands)
    for part in _parts(times):
        tally.add(part, *target.at(part))
    if tally.first is not None:
        return _result(mechanism, target, duration, tally, target_peaks(mechanism, target), None)
    reference = plan(mechanism, target, duration)
    guess = target.start
    for part in _parts(np.arange(0.0, duration + 0.5 * _PERIOD_S, _PERIOD_S)):
        lengths = np.empty((len(part), mechanism.legs))
        lengths_along(reference.segments, part, lengths)
        positions, rotations = poses_from_lengths(mechanism, lengths, guess, partial=True)
        found = int(np.isfinite(positions[:, 0]).sum())
        tally.add(part[:found], positions[:found], rotations[:found])
        if found < len(part):
            tally.lose(float(part[found]), guess if found == 0 else Pose(positions[found - 1], rotations[found - 1]))
            break
        guess = Pose(positions[-1], rotations[-1])
    peaks = target_peaks(mechanism, target) or exact_peaks(mechanism, reference.segments, duration)
    return _result(mechanism, target, duration, tally, peaks, reference)


def first_excess(
    mechanism: Mechanism, times: Array, positions: Array, rotations: Array, demands: Demands | None = None
) -> Excess | None:
    """The first limit that poses (N, ...) at times (N,) [s] exceed; None if they are within all."""
    tally = _Tally(mechanism, demands or USUAL)
    tally.add(times, positions, rotations)
    return tally.first


def closest_limits(mechanism: Mechanism, pose: Pose, demands: Demands | None = None) -> list[tuple[float, Excess]]:
    """Of each kind of limit the one that a pose is closest to or exceeds most, and its margin as a share of that with which it
    is farthest away; the closest kind comes first.
    """
    tally = _Tally(mechanism, demands or USUAL)
    tally.add(np.zeros(1), pose.position[None], pose.rotation[None])
    return sorted(tally.closest.values(), key=lambda found: found[0])


def _parts(times: Array) -> Iterable[Array]:
    return (times[k : k + _CHUNK] for k in range(0, len(times), _CHUNK))


def _result(
    mechanism: Mechanism, target: Target, duration: float, tally: "_Tally", peaks: Sequence[Peak], reference: Reference | None
) -> TargetCheck:
    first, worst, nearest = tally.first, None, None
    if first is not None:
        worst = tally.closest[tally.worst][1]
        try:
            nearest = nearest_reachable(mechanism, worst.pose, tally.demands)
        except (UnreachableError, MissingPackageError):
            nearest = None
    closest = tuple(excess for _, excess in tally.closest.values())
    return TargetCheck(target, duration, first, worst, nearest, closest, tuple(peaks), reference, mechanism)


class _Tally:
    """What poses come closest to, and the first limit that one exceeds."""

    def __init__(self, mechanism: Mechanism, demands: Demands) -> None:
        self._mechanism, self.demands = mechanism, demands
        self.first: Excess | None = None
        self.closest: dict[str, tuple[float, Excess]] = {}  # by kind: the margin over its scale, and how close

    @property
    def worst(self) -> str:
        """The kind of limit that is exceeded most."""
        return min(self.closest, key=lambda kind: self.closest[kind][0])

    def add(self, times: Array, positions: Array, rotations: Array) -> None:
        """Add poses at times (N,)."""
        found = margins(self._mechanism, positions, rotations, self.demands, workers=1)
        values = np.nan_to_num(found.values, nan=-inf, posinf=inf)
        exceeded = values < -_SLACK
        rows = np.flatnonzero(exceeded.any(axis=1))
        if len(rows):
            number = int(np.where(exceeded[rows[0]], values[rows[0]] / found.scales, inf).argmin())
            first = self._excess(found, int(rows[0]), number, times, positions, rotations)
            if self.first is None or first.time < self.first.time:
                self.first = first
        shares = values / found.scales
        for number, row in enumerate(shares.argmin(axis=0).tolist() if len(shares) else ()):
            share, kind = float(shares[row, number]), LIMITS[number].kind
            if share < inf and (kind not in self.closest or share < self.closest[kind][0]):
                self.closest[kind] = share, self._excess(found, row, number, times, positions, rotations)

    def lose(self, time: float, pose: Pose) -> None:
        """Add that the lengths of a time belong to no pose near one: there is a singularity between them."""
        lost = Excess(LIMITS[JACOBIAN], time, 0.0, LEAST_JACOBIAN, pose)
        self.closest[lost.limit.kind] = -inf, lost
        if self.first is None or time < self.first.time:
            self.first = lost

    def _excess(self, found: Margins, row: int, number: int, times: Array, positions: Array, rotations: Array) -> Excess:
        pose = Pose(positions[row], rotations[row])
        value, bound = measured(self._mechanism, self.demands, number, float(found.values[row, number]), pose)
        return Excess(LIMITS[number], float(times[row]), value, bound, pose)


def measured(mechanism: Mechanism, demands: Demands, number: int, margin: float, pose: Pose) -> tuple[float, float]:
    """What a pose makes of the limit of this number in `LIMITS`, with this margin, and what it may be: a length, an angle, a
    distance of surfaces, a force or a conditioning, in the unit of the limit.
    """
    limit, space = LIMITS[number], space_of(mechanism, demands)
    if limit.kind == "stroke":
        leg = limit.legs[0]
        length = float(leg_lengths(mechanism, pose.position, pose.rotation)[leg])
        shortest, longest = space["stroke"][leg].tolist()
        return length, longest if length > 0.5 * (shortest + longest) else shortest
    if limit.kind in ("base swing", "platform swing", "speed", "force"):
        name = "velocity" if limit.kind == "speed" else limit.kind.replace(" ", "_")
        most = float(np.broadcast_to(space[name], LEGS)[limit.legs[0]])
        return most - margin, most
    conditionings = {"Jacobian": LEAST_JACOBIAN, "direct kinematics": least_conditioning(mechanism)}
    least = conditionings.get(limit.kind, float(space["clearance"]))
    return least + margin, least


def pose_text(pose: Pose, home: Pose, frames: ActiveFrames | None = None) -> str:
    """A pose as a target means it, in words: position [mm] and rotation vector [deg]."""
    what = "from home"
    if frames is not None:
        what = f"of {frames.text}" if frames.absolute else f"{what} along {frames.frames.work}"
    position, rotation = (frames or ActiveFrames(Frames())).to_target(home, pose)
    # Rounded first, and without the sign of a zero.
    places = ", ".join(f"{each:.2f}" for each in np.round(1e3 * position, 2) + 0.0)
    turns = ", ".join(f"{each:.2f}" for each in np.round(np.degrees(vector_from_rotation(rotation)), 2) + 0.0)
    return f"({places}) mm, ({turns}) deg {what}"


class PoseGuard:
    """Holds poses that are streamed against all limits, quickly.

    Args:
        mechanism, demands: as for `margins`.
    """

    def __init__(self, mechanism: Mechanism, demands: Demands | None = None) -> None:
        self._mechanism, self._demands = mechanism, demands or USUAL

    def __call__(self, positions: Array, rotations: Array) -> tuple[int, int, float, float] | None:
        """Cause (of `controller.safety.causes`), leg, value and limit of the first pose that exceeds a limit, or None."""
        found = margins(self._mechanism, positions, rotations, self._demands, workers=1)
        values = np.nan_to_num(found.values, nan=-inf, posinf=inf)
        rows = np.flatnonzero((values < -_SLACK).any(axis=1))
        if not len(rows):
            return None
        number = int((values[rows[0]] / found.scales).argmin())
        limit, pose = LIMITS[number], Pose(positions[rows[0]], rotations[rows[0]])
        value, bound = measured(self._mechanism, self._demands, number, float(found.values[rows[0], number]), pose)
        return BEYOND[limit.kind], limit.legs[0] if limit.legs else -1, value, bound
