"""The planner of a recorded target: from its poses to a reference that every actuator can follow within its limits.

ruckig plans anew at every sample of the target: from the state of the reference to where the target will be 30 ms later, with
the target's velocity and acceleration there. The reference consists of the cubic segments of these plans, so the limits on
velocity, acceleration and jerk also hold between samples. ruckig does not know the stroke. A plan is accepted only if it
arrives in time and every leg can still stop inside its stroke after it. Otherwise the planner tries a gentler plan, and at last
the stop itself.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Synchronization, Trajectory

from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.built_in import SAMPLE_PERIOD_S
from controller.planning.pace import HALF_WINDOW, window_fits
from controller.planning.segments import segment_extrema, state_after, stop_phases, write_segment
from controller.planning.target import Target
from controller.planning.trajectory_generator import calculate, phases_of
from plant.compiled import kernel
from plant.errors import PlanningError, UnreachableError
from plant.mechanism import LEGS, Limits, Mechanism, six_rows
from plant.pose import Array

PREVIEW_S = 0.03
_LATEST_S = 2.0 * PREVIEW_S
_STILL_M = 1e-9
"""A target that moves no leg by more than this within the window stands still."""
_SLACK = 1e-9
"""Rounding by which a limit may be exceeded without a violation, relative to the limit, or in m for the stroke."""

_STROKE_SLACK = 1e-10
"""Rounding by which the planner's own plans may leave the stroke [m]."""

_PHASES = 9
"""A plan of ruckig has two braking phases and seven more."""


@dataclass(frozen=True, eq=False)
class Reference:
    """A planned motion. Rows of legs that a mechanism lacks rest at 0."""

    segments: Array  # (6, n, 5), as `controller.planning.segments` evaluates them
    violations: int  # how many segments leave a limit; the planner should make none


def plan(mechanism: Mechanism, target: Target, duration: float) -> Reference:
    """Plan a whole recorded motion before it starts, from rest at its first pose; one that has its reference already keeps it.

    Raises:
        UnreachableError: a target pose needs a leg outside its stroke.
        PlanningError: ruckig found no motion, not even a stop.
    """
    limits = mechanism.require_limits()
    if target.segments is not None:
        return Reference(six_rows(target.segments), count_violations(target.segments, duration, limits))
    _check_reach(mechanism, target)
    knots = max(1, int(np.ceil(duration / SAMPLE_PERIOD_S - 1e-9)))
    positions, rates, accelerations = _aims(mechanism, target, knots)
    start = leg_lengths(mechanism, target.start.position, target.start.rotation)
    planner = _Planner(limits, start, None if target.held else PREVIEW_S)
    for k in range(knots):
        planner.advance(positions[k], rates[k], accelerations[k])
    segments = planner.segments()
    horizon = knots * SAMPLE_PERIOD_S
    return Reference(six_rows(segments), count_violations(segments, horizon, limits))


def kernels_of_plan() -> tuple[tuple[Any, ...], ...]:
    """The kernels of `plan`, with arguments each, as `load_kernels` takes them."""
    segments, stroke = np.zeros((LEGS, 1, 5)), np.zeros((LEGS, 2))
    return (
        (_stops_inside, np.zeros((3, LEGS)), stroke, np.zeros(2)),
        (_collect_segments, np.zeros((1, LEGS, 2, _PHASES)), np.zeros((1, 3, LEGS)), np.zeros(2), segments),
        (_count_violations, segments, 0.0, stroke, np.zeros(3)),
    )


def _check_reach(mechanism: Mechanism, target: Target) -> None:
    """Check a target against the strokes; if it would be inside when read in another way, the error says so."""
    try:
        mechanism.check_lengths(leg_lengths(mechanism, target.positions, target.rotations), f"the target {target.name}")
    except UnreachableError as error:
        reading = target.likely_reading(mechanism)
        raise UnreachableError(f"{str(error).rpartition(':')[0]}: {reading}") if reading else error from None


def count_violations(segments: Array, horizon: float, limits: Limits) -> int:
    """How many segments before `horizon` [s] leave the stroke, or the limits of velocity, acceleration or jerk."""
    most = np.array([limits.velocity, limits.acceleration, limits.jerk])
    return int(_count_violations(segments, horizon, limits.stroke.copy(), most))


class _Planner:
    """Extends a reference by one sample period at a time, and keeps the state from which the next plan starts."""

    def __init__(self, limits: Limits, lengths: Array, preview: float | None) -> None:
        self._limits, self._stroke = limits, limits.stroke.copy()
        self._legs = len(lengths)
        self._state: tuple[list[float], ...] = (lengths.tolist(), [0.0] * self._legs, [0.0] * self._legs)
        self._otg = Ruckig(self._legs, SAMPLE_PERIOD_S)
        self._trajectory = Trajectory(self._legs)
        self._follow = ruckig_input(limits, ControlInterface.Position, preview)
        self._stop = ruckig_input(limits, ControlInterface.Velocity, None)
        self._stop.synchronization = Synchronization.No
        self._goal: Array | None = None
        self._knot = 0
        self._plans: list[Array] = []
        self._starts: list[int] = []
        self._states: list[tuple[list[float], ...]] = []
        self._stop_limits = np.array([limits.acceleration, limits.jerk])
        # Within a sample period no leg goes further than this: inside this reach the plan need not be checked.
        near = limits.velocity * SAMPLE_PERIOD_S
        self._reach = [(least + near, greatest - near) for least, greatest in limits.stroke.tolist()]

    def advance(self, positions: Array, rates: Array, accelerations: Array) -> None:
        """Go on for one sample period towards a state, (legs,) each. A plan that leads to rest there is kept."""
        resting = not rates.any() and not accelerations.any()
        if not (resting and self._goal is not None and np.abs(positions - self._goal).max() < _STILL_M):
            kept = self._begin(positions.tolist(), rates.tolist(), accelerations.tolist())
            self._goal = positions if resting and kept else None
        self._knot += 1
        self._state = self._trajectory.at_time((self._knot - self._starts[-1]) * SAMPLE_PERIOD_S)[:3]

    def _begin(self, target: list[float], rates: list[float], accelerations: list[float]) -> bool:
        """Begin a plan at the present state; returns whether it leads to the target itself and is safe to its end."""
        rest = [0.0] * self._legs
        self._follow.target_position = target
        for rate, acceleration in ((rates, accelerations), (rates, rest), (rest, rest)):
            self._follow.target_velocity, self._follow.target_acceleration = rate, acceleration
            if not calculate(self._otg, self._follow, self._state, self._trajectory):
                continue
            # A plan that must arrive with a speed, and cannot in time, first swings away from the target to gain that speed.
            if (self._trajectory.duration <= _LATEST_S or not any(rate)) and self._is_safe():
                kept = self._stays_inside()
                break
        else:
            kept = False
            if not calculate(self._otg, self._stop, self._state, self._trajectory):
                raise PlanningError(f"ruckig finds no way to stop from lengths {self._state[0]}")
        self._starts.append(self._knot)
        self._states.append(self._state)
        self._plans.append(phases_of(self._trajectory))
        return kept

    def _is_safe(self) -> bool:
        """Whether the first sample period of the plan, and a stop after it, stay inside the stroke."""
        near = any(not least < at < greatest for at, (least, greatest) in zip(self._state[0], self._reach, strict=True))
        if near and not self._stays_inside():
            return False
        after = np.array(self._trajectory.at_time(SAMPLE_PERIOD_S)[:3])
        return bool(_stops_inside(after, self._stroke, self._stop_limits))

    def _stays_inside(self) -> bool:
        return all(
            least - _STROKE_SLACK <= extrema.min and extrema.max <= greatest + _STROKE_SLACK
            for extrema, (least, greatest) in zip(self._trajectory.position_extrema, self._limits.stroke, strict=True)
        )

    def segments(self) -> Array:
        """All segments so far, (legs, n, 5)."""
        plans = np.array(self._plans)
        segments = np.zeros((self._legs, len(plans) * (_PHASES + 1), 5))
        segments[:, :, 0] = np.inf
        starts = np.array([*self._starts, self._knot]) * SAMPLE_PERIOD_S
        longest = _collect_segments(plans, np.array(self._states), starts, segments)
        return segments[:, :longest].copy()


def ruckig_input(limits: Limits, interface: ControlInterface, minimum_duration: float | None) -> InputParameter:
    """Parameters of ruckig with the limits of velocity, acceleration and jerk."""
    legs = len(limits.stroke)
    parameters = InputParameter(legs)
    parameters.control_interface = interface
    parameters.minimum_duration = minimum_duration
    parameters.max_velocity = [limits.velocity] * legs
    parameters.max_acceleration = [limits.acceleration] * legs
    parameters.max_jerk = [limits.jerk] * legs
    return parameters


def _aims(mechanism: Mechanism, target: Target, knots: int) -> tuple[Array, Array, Array]:
    """Lengths, rates and accelerations (knots, legs) to aim at, within the limits."""
    limits = mechanism.require_limits()
    if target.held:
        positions = leg_lengths(mechanism, *target.at(np.arange(knots) * SAMPLE_PERIOD_S + 1e-9))
        return positions, np.zeros_like(positions), np.zeros_like(positions)
    # A cubic is fitted to seven samples about each aim: derivatives of the interpolation would make ruckig's plans chatter.
    ahead = round(PREVIEW_S / SAMPLE_PERIOD_S)
    grid = np.arange(ahead - HALF_WINDOW, knots + ahead + HALF_WINDOW) * SAMPLE_PERIOD_S
    lengths = np.clip(leg_lengths(mechanism, *target.at(grid)), limits.stroke[:, 0], limits.stroke[:, 1])
    positions, rates, accelerations, _ = window_fits(lengths, SAMPLE_PERIOD_S)
    samples = np.lib.stride_tricks.sliding_window_view(lengths, 2 * HALF_WINDOW + 1, axis=0)
    still = (np.ptp(samples, axis=2) < _STILL_M).all(axis=1)
    positions[still], rates[still], accelerations[still] = samples[still, :, -1], 0.0, 0.0
    # A fit through a jump swings out; the samples themselves are inside the stroke.
    positions = np.clip(positions, limits.stroke[:, 0], limits.stroke[:, 1])
    rates = np.clip(rates, -0.999 * limits.velocity, 0.999 * limits.velocity)
    accelerations = np.clip(accelerations, -0.9 * limits.acceleration, 0.9 * limits.acceleration)
    too_fast = np.abs(rates) + accelerations**2 / (2.0 * limits.jerk) > 0.999 * limits.velocity
    accelerations[too_fast] = 0.0
    return positions, rates, accelerations


@kernel
def _collect_segments(plans: Array, states: Array, starts: Array, segments: Array) -> int:
    """Write the segments of each plan up to the start of the next; returns the number of segments in the longest row.

    Args:
        plans: (n, legs, 2, 9), durations and jerks.
        states: (n, 3, legs), the states from which the plans start.
        starts: (n + 1,) [s], the starts of the plans and the end of the last one.
        segments: (legs, m, 5), written.
    """
    longest = 0
    for leg in range(plans.shape[1]):
        row = 0
        for i in range(plans.shape[0]):
            durations, jerks = plans[i, leg, 0], plans[i, leg, 1]
            state = states[i, 0, leg], states[i, 1, leg], states[i, 2, leg]
            at, end = starts[i], starts[i + 1]
            for k in range(durations.shape[0] + 1):
                # A plan that ends before the next one begins rests in its last state.
                last = k == durations.shape[0]
                t = end - at if last else durations[k]
                if t > 0.0 and at < end - 1e-12:
                    j = 0.0 if last else jerks[k]
                    write_segment(segments[leg, row], at, state, j)
                    row += 1
                    state = state_after(state, j, t)
                    at += t
        longest = max(longest, row)
    return longest


@kernel
def _stops_inside(state: Array, stroke: Array, limits: Array) -> bool:
    """Whether every leg, from its state (3, legs), can stop within the stroke (legs, 2) and the limits of acceleration and
    jerk.
    """
    for k in range(state.shape[1]):
        p, now = state[0, k], (0.0, state[1, k], state[2, k])
        least = greatest = 0.0
        for jerk, duration in stop_phases(now[1], now[2], limits[0], limits[1]):
            low, high, _ = segment_extrema(now, jerk, duration)
            least, greatest = min(least, low), max(greatest, high)
            now = state_after(now, jerk, duration)
        if p + least < stroke[k, 0] - _STROKE_SLACK or p + greatest > stroke[k, 1] + _STROKE_SLACK:
            return False
    return True


@kernel
def _count_violations(segments: Array, horizon: float, stroke: Array, limits: Array) -> int:
    violations = 0
    for k in range(segments.shape[0]):
        for i in range(segments.shape[1]):
            start = segments[k, i, 0]
            if not start < horizon:
                break
            end = horizon
            if i + 1 < segments.shape[1]:
                end = min(end, segments[k, i + 1, 0])
            t = end - start
            p, v, a, j = segments[k, i, 1], segments[k, i, 2], segments[k, i, 3], segments[k, i, 4]
            least, greatest, speed = segment_extrema((p, v, a), j, t)
            acceleration = max(abs(a), abs(a + t * j))
            # Written so that NaN is a violation.
            inside = (
                least >= stroke[k, 0] - _SLACK
                and greatest <= stroke[k, 1] + _SLACK
                and speed <= limits[0] * (1.0 + _SLACK)
                and acceleration <= limits[1] * (1.0 + _SLACK)
                and abs(j) <= limits[2] * (1.0 + _SLACK)
                and np.isfinite(p + v + a + j)
            )
            if not inside:
                violations += 1
    return violations
