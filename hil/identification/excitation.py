"""The motion that tells a machine's actuators: a multisine on all axes at once, inside the limits of all legs.

Its lines are spread evenly over the logarithm of the frequency, from one that is slow enough for friction to show, up to where
the actuators lag. Each line is as large as the tightest limit lets it be at its frequency: stroke, velocity, acceleration or
jerk. All are then scaled together. Phases are random, so that no two legs do the same, and peaks stay low.
"""

from dataclasses import dataclass

import numpy as np

from controller.planning.motions import Motion, PlannedMotion, Sine, Wave, plan_motion
from controller.planning.motions.splines import extrema_of
from controller.planning.motions.waves import AXES, MOST_HZ
from controller.pose_limits.limits import GEOMETRY_ALONE, LIMITS
from controller.pose_limits.margins import margins
from hil.calibration.drives import within_drives
from plant.checks import check_rate
from plant.errors import InputError, UnreachableError
from plant.mechanism import Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array

LINES = 20
_SLOWEST_PERIODS = 4
"""Periods of the slowest line in the whole motion, at least."""

_SLOWEST_HZ = 0.25
_CYCLES_PER_PERIOD = 10.0
"""Cycles of the loop in a period of the quickest line, at least."""

_FITS = 6
_SMALL = 0.05
"""Share of the limits at which the first multisine is tried."""

SHORTEST_S, LONGEST_S = 5.0, 60.0


@dataclass(frozen=True, eq=False)
class Excitation:
    """A multisine.

    Attributes:
        motion: for the target of a run.
        planned: its reference.
        lines: (F,) [Hz].
        uses: greatest use of each limit, as a share of it: stroke, velocity, acceleration, jerk.
    """

    motion: Motion
    planned: PlannedMotion
    lines: Array
    uses: dict[str, float]


def multisine(mechanism: Mechanism, rate: float, duration: float, share: float = 0.8) -> Excitation:
    """The multisine of a mechanism.

    Args:
        mechanism: with limits.
        rate: of the loop [Hz].
        duration: of the motion [s].
        share: of the limits of stroke, velocity, acceleration and jerk that it may use, as far as the drives reach them.

    Raises:
        InputError: a duration or a share that cannot be, or a mechanism whose drives reach nothing.
        UnreachableError: a leg, a joint or the clearance between bodies does not allow it.
    """
    check_rate(rate)
    if not SHORTEST_S <= duration <= LONGEST_S:
        raise InputError(f"the duration is {duration:g} s; it must be {SHORTEST_S:g} to {LONGEST_S:g} s")
    if not 0.01 <= share <= 0.95:
        raise InputError(f"the share of the limits is {share:g}; it must be 0.01 to 0.95")
    gentle = within_drives(mechanism)
    limits = gentle.require_limits()
    slowest, quickest = max(_SLOWEST_HZ, _SLOWEST_PERIODS / duration), min(MOST_HZ, rate / _CYCLES_PER_PERIOD)
    lines = np.unique(np.round(np.geomspace(slowest, quickest, LINES) * duration)) / duration
    middle, half = limits.stroke.mean(axis=1), 0.5 * (limits.stroke[:, 1] - limits.stroke[:, 0])
    omega = 2.0 * np.pi * lines
    largest = np.min(
        [np.full(len(lines), half.min()), limits.velocity / omega, limits.acceleration / omega**2, limits.jerk / omega**3],
        axis=0,
    )
    spread = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    random = np.random.default_rng(0)
    phases = {axis: random.uniform(0.0, 2.0 * np.pi, len(lines)) for axis in range(6)}

    def at(size: float) -> tuple[Motion, PlannedMotion, dict[str, float]]:
        sines = tuple(
            Sine(AXES[axis], size * float(amplitude) / (1.0 if axis < 3 else spread), float(line), float(phase))
            for axis in moving_axes(mechanism)
            for line, amplitude, phase in zip(lines, largest, phases[axis], strict=True)
        )
        motion = Motion((Wave(duration, sines, blend=1.0),), name="multisine")
        planned = plan_motion(motion, gentle)
        extrema, places = np.empty((2, len(planned.segments), 5))
        extrema_of(planned.segments, extrema, places)
        away = np.abs(extrema[:, :2] - middle[:, None]).max(axis=1)
        uses = {"stroke": float((away / half).max())}
        for name, sizes in zip(("velocity", "acceleration", "jerk"), extrema[:, 2:].T, strict=True):
            uses[name] = float(sizes.max()) / getattr(limits, name)
        return motion, planned, uses

    size = _SMALL / len(lines)
    for _ in range(_FITS):
        motion, planned, uses = at(size)
        most = max(uses.values())
        if 0.98 * share <= most <= share:
            break
        # The legs' lengths hardly bend within the strokes; a step goes most of the way, and not beyond.
        size *= min(0.99 * share / most, 5.0)
    if max(uses.values()) > 1.0:
        raise UnreachableError(f"no multisine fits into the strokes of {mechanism.name!r}: they are not about its home")
    _check_poses(mechanism, planned)
    return Excitation(motion, planned, lines, uses)


def _check_poses(mechanism: Mechanism, planned: PlannedMotion) -> None:
    """Check joints and clearances, which no plan knows."""
    if mechanism.planar or (mechanism.joints is None and mechanism.bodies is None):
        return
    found = margins(mechanism, planned.positions, planned.rotations, GEOMETRY_ALONE)
    if len(outside := np.flatnonzero(~found.reachable)):
        first = int(outside[0])
        limit = LIMITS[found.binding[first]]
        raise UnreachableError(
            f"at {planned.times[first]:.3f} s the multisine exceeds {limit.text} by "
            f"{-found.values[first, found.binding[first]]:.3g} {limit.unit}: take a smaller --share of the limits"
        )
