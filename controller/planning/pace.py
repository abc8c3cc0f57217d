"""The pace of a target: how fast it moves legs and platform, and by what its time must be scaled to keep the legs' limits.

What a target that is sampled does between its samples is a matter of interpolation. Its speeds, accelerations and jerks are
therefore those of cubics that are fitted to seven samples of it about each moment, by which the planner follows it, too; it is
at rest before it begins. A motion file comes with its reference, whose extrema are exact.
"""

from math import ceil, inf

import numpy as np

from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.built_in import SAMPLE_PERIOD_S
from controller.planning.motions.planned import LEG_QUANTITIES, TOOL_QUANTITIES, Peak, tool_sizes
from controller.planning.motions.splines import extrema_of
from controller.planning.segments import START
from controller.planning.target import Target
from plant.checks import LEAST_TIME_SCALE
from plant.mechanism import Mechanism
from plant.pose import Array, quaternions_along

HALF_WINDOW = 3
"""How many samples a fit takes on either side of its own."""

_PHASES = 4
"""How often a moment is looked at in each period of the samples, so that a corner counts wherever it lies."""

_DIGITS = 1e4
_MOST_STEPS, _PATIENT_STEPS = 60, 40
"""A time scale is rounded up to one part in so many, and found in so many steps, the last of which are larger."""


def window_fits(values: Array, step: float, phases: int = 1) -> Array:
    """Value and first to third derivative (4, N, m), at the middle of each seven, of the cubics that are fitted to seven values
    `step` [s] apart. The values (N + 6 phases, m) are `phases` times as dense.
    """
    window = np.arange(-HALF_WINDOW, HALF_WINDOW + 1)
    fit = np.linalg.pinv(np.vander(window * step, 4, increasing=True)) * np.array([1.0, 1.0, 2.0, 6.0])[:, None]
    samples = np.lib.stride_tricks.sliding_window_view(values, 2 * HALF_WINDOW * phases + 1, axis=0)[..., ::phases]
    fits: Array = np.moveaxis(samples @ fit.T, -1, 0)
    return fits


def target_peaks(mechanism: Mechanism, target: Target) -> list[Peak]:
    """The greatest speed, acceleration and jerk of any leg, with its limit, and those of the platform, which have none.

    A target whose poses are held jumps from one to the next, at no pace of its own: it has no peaks.
    """
    if target.held:
        return []
    span = float(target.times[-1])
    step = min(SAMPLE_PERIOD_S, span / (2 * HALF_WINDOW + 1))
    # A run begins at rest at the first pose.
    times = np.arange(-HALF_WINDOW * _PHASES, span / step * _PHASES + 0.5) * (step / _PHASES)
    positions, rotations = target.at(times)
    times = times[HALF_WINDOW * _PHASES : -HALF_WINDOW * _PHASES]

    def fitted(values: Array) -> Array:
        return window_fits(values, step, _PHASES)

    if target.segments is None:
        legs = _leg_peaks(mechanism, fitted(leg_lengths(mechanism, positions, rotations)), times)
    else:
        legs = exact_peaks(mechanism, target.segments, span)
    tool = tool_sizes(fitted(np.hstack([positions, quaternions_along(rotations)])))
    return legs + [
        Peak(f"{name.replace('_', ' ')} of the platform", unit, order, float(sizes.max()), inf, float(times[sizes.argmax()]))
        for (name, unit, order), sizes in zip(TOOL_QUANTITIES, tool, strict=True)
    ]


def exact_peaks(mechanism: Mechanism, segments: Array, duration: float) -> list[Peak]:
    """The greatest speed, acceleration and jerk of any leg by a reference (n, m, 5) of the legs until `duration` [s]."""
    extrema, places = np.zeros((mechanism.legs, 5)), np.zeros((mechanism.legs, 5))
    for leg in range(mechanism.legs):
        used = segments[leg, segments[leg, :, START] < duration]
        ended = np.append(used, used[-1:], axis=0)[None]
        ended[0, -1, START] = duration
        extrema_of(ended, extrema[leg : leg + 1], places[leg : leg + 1])
    return _of_legs(mechanism, extrema[:, 2:].T, places[:, 2:].T)


def least_time_scale(mechanism: Mechanism, target: Target, at_least: float = LEAST_TIME_SCALE) -> float:
    """The least factor on the times of a target with which no leg exceeds its velocity, acceleration or jerk, rounded up to
    1e-4: above 1 the target is too fast as it is. It is 1 for a target whose poses are held or that does not move.
    """
    scale, passing = 1.0, inf
    for step in range(_MOST_STEPS):
        needed = max((peak.stretch for peak in target_peaks(mechanism, target.slower(scale)) if peak.most < inf), default=0.0)
        if needed < LEAST_TIME_SCALE:
            return 1.0
        if needed <= 1.0:
            passing = scale
        # What the fits make of corners does not scale with the pace: each factor is tried, with more room the longer it takes.
        more = 1.0 if needed <= 1.0 else 1.0 + (step + max(step - _PATIENT_STEPS, 0) ** 2) / _DIGITS
        tried = max(ceil(_DIGITS * scale * needed * more) / _DIGITS, at_least)
        if tried >= passing:
            break
        scale = tried
    return passing if passing < inf else scale


def _leg_peaks(mechanism: Mechanism, fits: Array, times: Array) -> list[Peak]:
    sizes = np.abs(fits[1:])
    at = sizes.argmax(axis=1)
    return _of_legs(mechanism, np.take_along_axis(sizes, at[:, None], axis=1)[:, 0], times[at])


def _of_legs(mechanism: Mechanism, values: Array, times: Array) -> list[Peak]:
    """The peaks of the worst legs, from the greatest values (3, n) of each and their times (3, n)."""
    limits = mechanism.require_limits()
    most, worst = (limits.velocity, limits.acceleration, limits.jerk), values.argmax(axis=1)
    return [
        Peak(f"{name} of leg {leg}", unit, order, float(values[order - 1, leg]), limit, float(times[order - 1, leg]))
        for order, ((name, unit), leg, limit) in enumerate(zip(LEG_QUANTITIES, worst.tolist(), most, strict=True), start=1)
    ]
