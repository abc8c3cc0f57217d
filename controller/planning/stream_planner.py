"""The planner of a streamed target: from each sample a plan of cubic segments, within all limits, that ends at rest.

The target's motion is fitted to its last samples and followed with ruckig: from the state of the plan before to where the
target will be a moment later, with its velocity there; then a moment at that velocity, and a stop. A plan counts only if all
of it stays inside the limits and the stroke; else a gentler one is tried, and at last the plan before goes on, which ends at
rest itself. So whatever the samples are, and whenever they end, no limit is left.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Trajectory

from controller.inverse_kinematics import leg_lengths
from controller.planning.planner import PREVIEW_S, count_violations
from controller.planning.segments import ACCELERATION, JERK, LENGTH, RATE, START, STOP_SEGMENTS, evaluate_reference, plan_stop
from controller.planning.stream import PLAN_SEGMENTS, rest
from controller.safety.causes import Cause
from plant.compiled import kernel
from plant.errors import GoughError, InputError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, rotation_from_quaternion

_WINDOW_S, _LEAST_SAMPLES, _MOST_SAMPLES = 0.08, 5, 64
"""The target's motion is fitted to the samples of so long, but to so many at least and at most."""

_CURVED_S = 0.05
"""For how long after its last sample the target's motion is thought to be accelerated as before; then it is uniform."""

_PREVIEWS_S = (PREVIEW_S, 0.045, 0.06, 0.08, 0.1, 0.15, 0.25)
"""How long a plan may take to meet the target; the first that the limits allow is chosen."""

_TIMELY = 1.2
"""A plan that takes this many times as long as it should would swing away from the target to gain speed."""

_COAST_S = 0.02
"""How long a plan goes on with the target's velocity after it has met it, if the stroke allows."""

_JUMP_FACTOR, _JUMP_M = 1.5, 1e-3
"""A leg may go this many times as far as its velocity limit allows between samples, and this much further."""

_STILL_M = 1e-9
"""A target that moves no leg by more than this stands still."""

_STROKE_SLACK_M = 1e-9
"""Rounding by which a sample may be outside the stroke."""


class TargetRefusedError(GoughError, ValueError):
    """A sample is not one that can be followed; cause (of `controller.safety.watch`), leg, value and limit are its
    attributes.
    """

    def __init__(self, cause: int, index: int = 0, value: float = np.nan, limit: float = np.nan) -> None:
        super().__init__(f"{Cause(cause).describe(index, value, limit)}: correct what sends the target")
        self.cause, self.index, self.value, self.limit = cause, index, value, limit


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan that has been made.

    Attributes:
        begin: motion time at which it follows on the plan before [s].
        segments: (6, 24, 5), as `controller.planning.segments` has them, in motion time.
        goal: (6,) [m], the lengths at which it ends, if the target stands still there.
    """

    begin: float
    segments: Array
    goal: Array | None


class StreamPlanner:
    """Plans how to follow a stream of target poses, sample by sample.

    Args:
        mechanism: with home and limits.
        lengths: (6,) [m], where the legs rest when the motion begins.

    Raises:
        UnreachableError: it begins outside the stroke.
        InputError: the mechanism has no home or no limits.
    """

    def __init__(self, mechanism: Mechanism, lengths: Array) -> None:
        self._mechanism, self._home, self._limits = mechanism, mechanism.require_home(), mechanism.require_limits()
        mechanism.check_lengths(lengths, "the start of the stream")
        self._now = Plan(0.0, rest(lengths, PLAN_SEGMENTS), None)
        self._samples: deque[tuple[float, Array]] = deque(maxlen=_MOST_SAMPLES)
        self._otg = Ruckig(LEGS)
        self._trajectory = Trajectory(LEGS)
        self._follow = InputParameter(LEGS)
        self._follow.control_interface = ControlInterface.Position
        self._follow.max_velocity = [self._limits.velocity] * LEGS
        self._follow.max_acceleration = [self._limits.acceleration] * LEGS
        self._follow.max_jerk = [self._limits.jerk] * LEGS
        # Loads the machine code, which would take longer than there is between samples.
        state = np.empty((LEGS, 3))
        evaluate_reference(self._now.segments, 0.0, np.zeros(LEGS, np.int64), state)
        self._plan_towards(0.0, state, lengths, None, PREVIEW_S)
        rotation_from_quaternion(np.array([1.0, 0.0, 0.0, 0.0]))

    @property
    def current(self) -> Plan:
        """The plan that is followed."""
        return self._now

    def add(self, time_s: float, displacement: ArrayLike, quaternion: ArrayLike) -> None:
        """Take note of a sample.

        Args:
            time_s: of the sample on the sender's clock [s].
            displacement: (3,) [m] from home.
            quaternion: (4,), unit, w first; the turn from home.

        Raises:
            TargetRefusedError: it is not finite, off unit, out of reach or jumps.
            InputError: its time does not come after the last one's.
        """
        position, turn = np.asarray(displacement, float), np.asarray(quaternion, float)
        if not (np.isfinite(position).all() and np.isfinite(turn).all()):
            raise TargetRefusedError(Cause.TARGET_NOT_FINITE)
        norm = float(np.linalg.norm(turn))
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise TargetRefusedError(Cause.TARGET_NOT_FINITE, 0, abs(norm - 1.0), UNIT_TOLERANCE)
        rotation = rotation_from_quaternion(turn / norm) @ self._home.rotation
        lengths = leg_lengths(self._mechanism, self._home.position + position, rotation)
        stroke = self._limits.stroke
        excess = np.maximum(stroke[:, 0] - lengths, lengths - stroke[:, 1])
        leg = int(excess.argmax())
        if excess[leg] > _STROKE_SLACK_M:
            raise TargetRefusedError(Cause.BEYOND_STROKE, leg, lengths[leg], stroke[leg, int(lengths[leg] > stroke[leg, 1])])
        if self._samples:
            before, was = self._samples[-1]
            if not time_s > before:
                raise InputError(f"a sample of {time_s:g} s does not come after {before:g} s: send them in their order")
            step = np.abs(lengths - was)
            most = _JUMP_FACTOR * self._limits.velocity * (time_s - before) + _JUMP_M
            if step.max() > most:
                raise TargetRefusedError(Cause.TARGET_JUMPS, int(step.argmax()), float(step.max()), most)
        self._samples.append((time_s, np.clip(lengths, stroke[:, 0], stroke[:, 1])))

    def plan(self, at_s: float, ahead_s: float) -> Plan | None:
        """Plan how to follow the target; the plan is of no consequence until `follow` says that it is followed.

        Args:
            at_s: motion time at which the plan begins [s], no earlier than the current one.
            ahead_s: by how much that is later than the newest sample [s].

        Returns:
            The plan; None if the current one shall go on.

        Raises:
            InputError: it is to begin before the current one, or there is no sample.
        """
        if not at_s >= self._now.begin:
            raise InputError(
                f"a plan from {at_s:g} s on would precede the current one of {self._now.begin:g} s: plan for later"
            )
        if not self._samples:
            raise InputError("there is no sample to plan for: add one first")
        state = np.empty((LEGS, 3))
        evaluate_reference(self._now.segments, at_s, np.zeros(LEGS, np.int64), state)
        motion = self._fit()
        if not motion[1:].any():
            goal = motion[0]
            if self._now.goal is not None and np.abs(goal - self._now.goal).max() < _STILL_M:
                return None
            return self._plan_towards(at_s, state, goal, None, PREVIEW_S)
        for preview in _PREVIEWS_S:
            aim, rates = self._aim(motion, max(ahead_s, 0.0), preview)
            plan = self._plan_towards(at_s, state, aim, rates, preview)
            if plan is not None:
                return plan
        aim, _ = self._aim(motion, max(ahead_s, 0.0), PREVIEW_S)
        return self._plan_towards(at_s, state, aim, None, PREVIEW_S)

    def follow(self, plan: Plan) -> None:
        """Say that a plan is followed from its begin on, so that the next one comes after it."""
        self._now = plan

    def _fit(self) -> Array:
        """The target's motion (m, 6) by powers of the time since its newest sample; one row if it stands still."""
        newest = self._samples[-1][0]
        chosen = [each for each in self._samples if each[0] > newest - _WINDOW_S]
        if len(chosen) < _LEAST_SAMPLES:
            chosen = list(self._samples)[-_LEAST_SAMPLES:]
        times, lengths = np.array([each[0] for each in chosen]), np.array([each[1] for each in chosen])
        if len(times) < 3 or np.ptp(lengths, axis=0).max() < _STILL_M:
            return lengths[-1:]
        fit: Array = np.linalg.pinv(np.vander(times - newest, 3, increasing=True)) @ lengths
        return fit

    def _aim(self, motion: Array, ahead: float, preview: float) -> tuple[Array, Array]:
        """Lengths and rates (6,) of the target `ahead` and `preview` [s] after its newest sample, within the limits."""
        limits = self._limits
        curved = min(ahead + preview, _CURVED_S)
        rates = np.clip(motion[1] + 2.0 * curved * motion[2], -limits.velocity, limits.velocity)
        aim = motion[0] + curved * (motion[1] + curved * motion[2]) + (ahead + preview - curved) * rates
        aim = np.clip(aim, limits.stroke[:, 0], limits.stroke[:, 1])
        # What a leg must still be able to stop in.
        room = np.where(rates > 0.0, limits.stroke[:, 1] - aim, aim - limits.stroke[:, 0])
        most = _stoppable(room, limits.acceleration, limits.jerk)
        return aim, np.clip(rates, -most, most)

    def _plan_towards(self, begin: float, state: Array, aim: Array, rates: Array | None, preview: float) -> Plan | None:
        """A plan from a state (6, 3) to the aim, to be there after `preview` [s] with these rates, or to rest; None if the
        limits, the stroke or ruckig do not allow it.
        """
        follow, limits = self._follow, self._limits
        follow.minimum_duration = preview
        follow.current_position, follow.current_velocity, follow.current_acceleration = state.T.tolist()
        follow.target_position = aim.tolist()
        follow.target_velocity = [0.0] * LEGS if rates is None else rates.tolist()
        try:
            if self._otg.calculate(follow, self._trajectory) not in (Result.Working, Result.Finished):
                return None
        except (RuckigError, ValueError):
            # ValueError: a result code of ruckig that its own binding does not know.
            return None
        if rates is not None and self._trajectory.duration > _TIMELY * preview:
            return None
        phases = np.array([(*each.brake.t, *each.t, *each.brake.j, *each.j) for each in self._trajectory.profiles[0]])
        segments = np.empty((LEGS, PLAN_SEGMENTS, 5))
        most = np.array([limits.acceleration, limits.jerk])
        for coast in (0.0,) if rates is None else (_COAST_S, 0.0):
            end = _write_plan(phases, begin, self._trajectory.duration, coast, state, most, segments)
            if not count_violations(segments, end, limits):
                return Plan(begin, segments, aim if rates is None else None)
        return None


def _stoppable(room: Array, acceleration: float, jerk: float) -> Array:
    """The speeds from which a leg without acceleration can stop within `room` [m]."""
    ramp = acceleration / jerk
    brief = np.cbrt(np.maximum(room, 0.0) ** 2 * jerk)
    long = 0.5 * acceleration * (np.sqrt(ramp * ramp + 8.0 * np.maximum(room, 0.0) / acceleration) - ramp)
    speeds: Array = np.where(brief < acceleration * ramp, brief, long)
    return speeds


@kernel
def _write_plan(
    phases: Array, begin: float, duration: float, coast: float, state: Array, limits: Array, segments: Array
) -> float:
    """Write the segments (6, n, 5) of phases (6, 18), durations and jerks, from a state (6, 3), a coast, and a stop; returns
    from when on all legs rest [s].

    Durations are those between the starts as they are rounded, so that each row ends exactly where the next one begins.
    """
    count = phases.shape[1] // 2
    rows = np.zeros(LEGS, np.int64)
    ends = state.copy()
    stops = np.empty((LEGS, STOP_SEGMENTS, 5))
    segments[:, :, :] = 0.0
    segments[:, :, START] = np.inf
    arrived = begin + duration
    for leg in range(LEGS):
        p, v, a = state[leg, 0], state[leg, 1], state[leg, 2]
        at = begin
        for k in range(count + 2):
            # What ruckig's phases leave of its duration, and the coast, have no jerk.
            j = phases[leg, count + k] if k < count else 0.0
            after = min(at + phases[leg, k], arrived) if k < count else arrived if k == count else arrived + coast
            t = after - at
            if t > 0.0:
                segment = segments[leg, rows[leg]]
                segment[START], segment[LENGTH], segment[RATE], segment[ACCELERATION], segment[JERK] = at, p, v, a, j
                rows[leg] += 1
                p += t * (v + t * (a / 2.0 + t * j / 6.0))
                v += t * (a + t * j / 2.0)
                a += t * j
                at = after
        ends[leg, 0], ends[leg, 1], ends[leg, 2] = p, v, a
    plan_stop(ends, limits[0], limits[1], stops)
    end = begin
    for leg in range(LEGS):
        at = arrived + coast
        p, v, a = ends[leg, 0], ends[leg, 1], ends[leg, 2]
        for k in range(STOP_SEGMENTS - 1):
            after = at + (stops[leg, k + 1, START] - stops[leg, k, START])
            t = after - at
            if t > 0.0:
                segment, j = segments[leg, rows[leg]], stops[leg, k, JERK]
                segment[START], segment[LENGTH], segment[RATE], segment[ACCELERATION], segment[JERK] = at, p, v, a, j
                rows[leg] += 1
                p += t * (v + t * (a / 2.0 + t * j / 6.0))
                v += t * (a + t * j / 2.0)
                a += t * j
                at = after
        segments[leg, rows[leg], START], segments[leg, rows[leg], LENGTH] = at, p
        end = max(end, at)
    return end
