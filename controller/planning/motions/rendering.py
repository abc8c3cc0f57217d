"""A recorded motion of a vehicle, rendered within all limits; what was clipped, and how good the cue is.

The filter is the causal one of `controller.planning.motions.cueing`. As the whole motion is known beforehand, it is scaled down
for a while, smoothly, around each moment at which a limit would be left, and filtered again, until none is.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.planning.motions.cueing import ROW, Site, at_rest, quaternions_of, read_vehicle, render
from controller.planning.motions.elements import (
    MOST_DURATION_S,
    PERIOD_S,
    SAMPLES_PER_WAVE,
    Course,
    Cueing,
    blended,
    turned_quaternions,
)
from controller.planning.motions.splines import curve_at, spline_at_rest
from plant.errors import InputError, PlanningError
from plant.pose import Array, quaternion_from_rotation, rotations_from_quaternions

_FADE_S = 0.5
"""Time in which the vehicle's last acceleration fades out."""

_ALLOWED, _AIM = 0.999, 0.99
"""Share of a limit that may be used, and to which a use beyond is brought back."""

_REACH_S, _WIDER = 0.4, 1.1
"""How far around a moment the motion is scaled, and the factor by which that grows with every trial."""

_MOST_TRIALS = 200

_ONSET_S = 0.1
"""Changes within this time are an onset."""

_NOTHING, _SLIGHT = 1e-9, 1e-4
_AXES = ("x", "y", "z")


@dataclass(frozen=True)
class Clip:
    """A time in which something was clipped."""

    what: str  # such as "acceleration along x", "tilt"
    begin: float  # [s]
    end: float  # [s]
    asked: float  # the greatest value that was asked for
    most: float  # the limit
    unit: str


@dataclass(frozen=True)
class Scaled:
    """A time in which the vehicle's motion was scaled down, beyond the washout's own scale."""

    limit: str  # that was left most, such as "velocity of leg 2"
    begin: float  # [s]
    end: float  # [s]
    factor: float  # the least
    share: float  # of the limit, as it would have been used


@dataclass(frozen=True, eq=False)
class Rendered:
    """What was clipped, and how good the cue is, along the platform's axes.

    The specific force that the operator feels is compared with the scaled one of the vehicle, while the vehicle moves.

    Attributes:
        clips, scaled: in their order.
        asked: (3,), root mean square of the specific force that is to be rendered, less that at rest [m/s^2].
        error: (3,), root mean square of what is missing [m/s^2].
        worst_error: (3,), its greatest size [m/s^2].
        onset_gain: (3,), the share of changes within 0.1 s that is rendered (least squares); NaN where there is none.
        tilt: the steepest [rad].
        tilt_speed: the greatest [rad/s].
    """

    clips: tuple[Clip, ...]
    scaled: tuple[Scaled, ...]
    asked: Array
    error: Array
    worst_error: Array
    onset_gain: Array
    tilt: float
    tilt_speed: float

    def plain(self) -> dict[str, Any]:
        """The figures, in SI units."""
        return {
            "clips": [asdict(each) for each in self.clips],
            "scaled": [asdict(each) for each in self.scaled],
            "asked_rms": self.asked.tolist(),
            "error_rms": self.error.tolist(),
            "worst_error": self.worst_error.tolist(),
            "onset_gain": [None if np.isnan(each) else each for each in self.onset_gain.tolist()],
            "tilt": self.tilt,
            "tilt_speed": self.tilt_speed,
        }

    def remarks(self, begin: float) -> Iterator[str]:
        """What was clipped and scaled, a line each, for an element that begins at a time [s]."""
        for what in dict.fromkeys(clip.what for clip in self.clips):
            clips = [clip for clip in self.clips if clip.what == what]
            worst = max(clips, key=lambda clip: clip.asked)
            asked, most, unit = (
                (np.degrees(worst.asked), np.degrees(worst.most), worst.unit.replace("rad", "deg"))
                if worst.unit.startswith("rad")
                else (worst.asked, worst.most, worst.unit)
            )
            yield (
                f"{what} is clipped for {sum(clip.end - clip.begin for clip in clips):.2f} s, most from "
                f"{begin + worst.begin:.2f} s on: {asked:.3g} {unit} to {most:.3g}"
            )
        for each in self.scaled:
            yield (
                f"the vehicle's motion is scaled to {100.0 * each.factor:.0f} % from {begin + each.begin:.2f} to "
                f"{begin + each.end:.2f} s: the {each.limit} would be {each.share:.3g} of its limit"
            )


class Rendering:
    """A cue that is brought within limits.

    Args:
        element: with the vehicle's motion and the settings.
        site: where it begins.

    Attributes:
        times: (N,) [s], of the knots.

    Raises:
        InputError: the vehicle's motion cannot be read or is too long, or there is no room.
    """

    def __init__(self, element: Cueing, site: Site) -> None:
        vehicle = read_vehicle(element.file)
        self._site, self._settle, self._parameters = site, element.settle, site.filter(element.settings)
        self._ends = float(vehicle.times[-1])
        duration = self._ends + element.settle
        if duration > MOST_DURATION_S:
            raise InputError(f"{element.file} takes {self._ends:g} s; a motion takes {MOST_DURATION_S:g} s at most")
        p = self._parameters
        self._period = min(PERIOD_S, 2.0 * np.pi / (SAMPLES_PER_WAVE * float(p["smoothing"])))
        count = max(8, ceil(duration / self._period))
        self.times = np.linspace(0.0, duration, count + 1)
        fade = np.clip((self._ends + _FADE_S - self.times) / _FADE_S, 0.0, 1.0)[:, None]
        self._forces, self._rates = (
            fade * np.column_stack([np.interp(self.times, vehicle.times, column) for column in values.T])
            for values in (vehicle.deviations(site.up), vehicle.rates)
        )
        self._gain = np.ones(len(self.times))
        self._reach = _REACH_S
        self._left: list[tuple[float, float, str]] = []
        self._trials = 0
        self._render()

    @property
    def course(self) -> Course:
        """Where the cue leads."""
        begin = self._site.begin
        quaternion = quaternion_from_rotation(begin.rotation)

        def at(times: Array) -> tuple[Array, Array]:
            moves = np.column_stack([np.interp(times, self.times, column) for column in self._moves.T])
            return self._site.positions(moves), turned_quaternions(moves[:, 3:], quaternion)

        return Course(at, begin, np.empty(0), float(self.times[-1]), self._period)

    def _render(self) -> None:
        self._rows = np.zeros(len(self.times), ROW)
        render(self._parameters, at_rest(), self.times, self._forces, self._rates, self._gain, self._rows)
        home = blended((self.times[-1] - self.times) / (0.5 * self._settle))
        self._moves = self._rows["moves"] * home[:, None]

    def reduce(self, use: Array, starts: Array, names: Sequence[str]) -> bool:
        """Scale the vehicle's motion down where a limit is left.

        Args:
            use: (q, m), shares of limits that the cue uses in each interval.
            starts: (m,) [s], of the intervals.
            names: of the limits.

        Returns:
            Whether anything had to be scaled.

        Raises:
            PlanningError: it is scaled as far as it makes sense.
        """
        worst = use.max(axis=0)
        over = np.flatnonzero(~(worst <= _ALLOWED))
        if not len(over):
            return False
        self._trials += 1
        if self._trials > _MOST_TRIALS:
            raise PlanningError(f"the {names[int(use[:, over[0]].argmax())]} cannot be kept: choose a smaller scale")
        for group in np.split(over, np.flatnonzero(np.diff(starts[over]) > self._reach) + 1):
            at = group[int(worst[group].argmax())]
            share = float(worst[at])
            self._left.append((float(starts[at]), share, names[int(use[:, at].argmax())]))
            away = np.maximum(starts[group[0]] - self.times, self.times - starts[group[-1]]) / self._reach - 1.0
            x = np.clip(1.0 - away, 0.0, 1.0)
            self._gain *= 1.0 - (1.0 - (_AIM / share) ** 0.5) * x * x * (3.0 - 2.0 * x)
        self._reach *= _WIDER
        self._render()
        return True

    def rendered(self) -> Rendered:
        """What was clipped, and how good the cue is."""
        during = self.times <= self._ends
        moved = curve_at(spline_at_rest(self.times, self._moves[:, :3]), self.times)[2]
        rest = self._parameters["gravity"] * self._site.up
        turns = rotations_from_quaternions(quaternions_of(self._moves[:, 3:]))
        felt, asked = (
            (np.einsum("nji,nj->ni", turns, moved + rest) - rest)[during],
            self._parameters["scale"] * self._forces[during],
        )
        missing, step = asked - felt, max(1, round(_ONSET_S / self._period))
        changes, shown = (values[step:] - values[:-step] for values in (asked, felt))
        squares = (changes**2).sum(axis=0)
        there = squares > _NOTHING
        gains = np.where(there, (changes * shown).sum(axis=0) / np.where(there, squares, 1.0), np.nan)
        return Rendered(
            tuple(self._clips()),
            tuple(self._scaled()),
            np.sqrt((asked**2).mean(axis=0)),
            np.sqrt((missing**2).mean(axis=0)),
            np.abs(missing).max(axis=0),
            gains,
            float(np.arcsin(min(1.0, np.abs(np.linalg.norm(np.cross(turns @ self._site.up, self._site.up), axis=1)).max()))),
            float(self._rows["tilt_speed"].max()),
        )

    def _clips(self) -> Iterator[Clip]:
        p, rows = self._parameters, self._rows
        # All that is rendered is smaller by the gain, and so is what clips it.
        for values, most, what, unit in (
            (rows["wanted"] / self._gain[:, None], p["most_acceleration"], "acceleration along", "m/s^2"),
            (p["turn_scale"] * self._rates, p["most_turn_speed"], "angular velocity about", "rad/s"),
        ):
            for axis, sizes, limit in zip(_AXES, np.abs(values).T, most.tolist(), strict=True):
                yield from self._spans(f"{what} {axis}", sizes > limit * (1.0 + _SLIGHT), sizes, limit, unit)
        sines, steepest = rows["wanted_sine"] / self._gain, float(p["steepest"])
        tilts, most_tilt = np.arcsin(np.minimum(sines, 1.0)), float(np.arcsin(steepest))
        yield from self._spans("tilt", sines > steepest * (1.0 + _SLIGHT), tilts, most_tilt, "rad")
        yield from self._spans("tilt speed", rows["lagging"] > 0.0, rows["goal_speed"], float(p["tilt_speed"]), "rad/s")

    def _spans(self, what: str, clipped: NDArray[np.bool_], asked: Array, most: float, unit: str) -> Iterator[Clip]:
        for begin, end in _runs(clipped):
            greatest = float(asked[begin:end].max())
            yield Clip(what, float(self.times[begin]), float(self.times[min(end, len(self.times) - 1)]), greatest, most, unit)

    def _scaled(self) -> Iterator[Scaled]:
        for begin, end in _runs(self._gain < 1.0 - _SLIGHT):
            first, last = float(self.times[begin]), float(self.times[min(end, len(self.times) - 1)])
            inside = [each for each in self._left if first <= each[0] <= last] or self._left
            _, share, limit = max(inside, key=lambda each: each[1])
            yield Scaled(limit, first, last, float(self._gain[begin:end].min()), share)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begins and ends (exclusive) of the runs of true flags (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
