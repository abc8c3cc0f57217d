"""The planner of a streamed target: from each sample a plan of cubic segments, within all limits, that ends at rest.

The target's motion is fitted to its last samples (see `controller.planning.target_motion`). ruckig plans from the state of the
previous plan to where the target will be a moment later, with the target's velocity there; a moment at that velocity follows,
and a stop. A plan is accepted only if all of it stays inside the limits and the stroke. Otherwise the planner tries a gentler
plan. If none is accepted, the previous plan goes on, which also ends at rest. So no limit is left, whatever the samples are and
whenever they end.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from ruckig import ControlInterface, Ruckig, Trajectory

from controller.direct_kinematics import poses_from_lengths
from controller.frames import ActiveFrames
from controller.inverse_kinematics import leg_lengths
from controller.planning.offline_planner import PREVIEW_S, count_violations, ruckig_input
from controller.planning.plan_handover import PLAN_SEGMENTS, STREAM_PATIENCE_S, rest
from controller.planning.segments import (
    LENGTH,
    START,
    evaluate_reference,
    lengths_along,
    state_after,
    stop_phases,
    write_segment,
)
from controller.planning.target import poses_of
from controller.planning.target_motion import STILL_M, TargetMotion
from controller.planning.trajectory_generator import calculate, phases_of
from controller.safety.causes import Cause
from plant.compiled import kernel
from plant.errors import GoughError, InputError
from plant.mechanism import LEGS, Mechanism
from plant.pose import UNIT_TOLERANCE, Array, Pose, rotation_from_quaternion

_PREVIEWS_S = (PREVIEW_S, 0.045, 0.06, 0.08, 0.1, 0.15, 0.25)
"""Times in which a plan may meet the target; the first that the limits allow is chosen."""

_TIMELY = 1.2
"""A plan that takes this many times its intended time would swing away from the target to gain speed."""

_COAST_S = 0.02
"""Time for which a plan keeps the target's velocity after it has met the target, if the stroke allows."""

_JUMP_FACTOR, _JUMP_M = 1.5, 1e-3
"""Between any two samples, a leg may go this many times as far as its velocity limit allows, and this much further."""

_GUARDED_S = 0.01
"""Time between the poses of a plan that the guard sees."""

_STROKE_SLACK_M = 1e-9
"""Rounding by which a sample may be outside the stroke."""


class TargetRefusedError(GoughError, ValueError):
    """A sample cannot be followed. Attributes: cause (a `Cause`), leg, value and limit."""

    def __init__(self, cause: int, index: int = 0, value: float = np.nan, limit: float = np.nan) -> None:
        super().__init__(f"{Cause(cause).describe(index, value, limit)}: correct what sends the target")
        self.cause, self.index, self.value, self.limit = cause, index, value, limit


class KnownMotion(Protocol):
    """A motion that is known beforehand, by the lengths of the legs."""

    lengths: Array  # (n,) [m], at its end

    def at(self, ahead: float) -> tuple[Array, Array]:
        """Lengths [m] and rates [m/s] (n,) after a time [s]; at rest the rates are exactly 0."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A plan, in motion time."""

    begin: float  # when it takes over from the previous plan [s]
    segments: Array  # (6, 24, 5), as `controller.planning.segments` has them; legs that are not there stay at 0
    goal: Array | None  # (n,) [m], the lengths at which it ends if the target stands still there
    near: Pose | None = None  # the pose at which it begins, if that has been found


Guard = Callable[[Array, Array], tuple[int, int, float, float] | None]
"""What holds poses, positions (N, 3) and rotations (N, 3, 3), against limits besides the strokes: cause (of
`controller.safety.causes`), leg, value and limit of the first pose that exceeds one; None if none does.
"""


class StreamPlanner:
    """Plans how to follow a stream of target poses, sample by sample.

    Args:
        mechanism: with n legs, home and limits.
        lengths: (n,) [m], at which the legs rest when the motion begins.
        frames: in which the samples are; None for displacements from home in {1}.
        guard: holds samples, and the poses of every plan to its end, against other limits than strokes and actuators.

    Attributes:
        current: the plan that is followed.

    Raises:
        UnreachableError: the motion begins outside the stroke.
        InputError: the mechanism has no home or no limits.
    """

    def __init__(
        self, mechanism: Mechanism, lengths: Array, frames: ActiveFrames | None = None, guard: Guard | None = None
    ) -> None:
        self._mechanism, self._home, self._limits = mechanism, mechanism.require_home(), mechanism.require_limits()
        self._frames, self._guard = frames, guard
        self._near = mechanism.require_home()  # a pose near which those of the next plan are
        mechanism.check_lengths(lengths, "the start of the stream")
        self.current = Plan(0.0, rest(lengths, PLAN_SEGMENTS), None)
        self._motion: TargetMotion | None = None
        self._known: KnownMotion | None = None
        self._sent_s = 0.0  # time stamp of the newest sample
        self._within = lengths, lengths  # least and greatest lengths (n,) at that time that no sample so far makes a jump
        self._otg = Ruckig(mechanism.legs)
        self._trajectory = Trajectory(mechanism.legs)
        self._follow = ruckig_input(self._limits, ControlInterface.Position, None)
        # Loads the machine code now: between samples there is not enough time.
        self._plan_towards(0.0, self._state(0.0), lengths, None, PREVIEW_S)
        rotation_from_quaternion(np.array([1.0, 0.0, 0.0, 0.0]))

    def add(self, time_s: float, displacement: ArrayLike, quaternion: ArrayLike) -> None:
        """Add a sample.

        Args:
            time_s: of the sample, on the sender's clock [s].
            displacement: (3,) [m] from home, or the tool's position in the work frame.
            quaternion: (4,), unit, w first; the turn from home, or the tool's orientation in the work frame.

        Raises:
            TargetRefusedError: the sample is not finite, off unit length, out of reach, or a jump.
            InputError: its time does not come after that of the last sample.
        """
        position, turn = np.asarray(displacement, float), np.asarray(quaternion, float)
        if not (np.isfinite(position).all() and np.isfinite(turn).all()):
            raise TargetRefusedError(Cause.TARGET_NOT_FINITE)
        norm = float(np.linalg.norm(turn))
        if abs(norm - 1.0) > UNIT_TOLERANCE:
            raise TargetRefusedError(Cause.TARGET_NOT_FINITE, 0, abs(norm - 1.0), UNIT_TOLERANCE)
        pose = poses_of(position, rotation_from_quaternion(turn / norm), self._home, self._frames)
        lengths = leg_lengths(self._mechanism, *pose)
        stroke = self._limits.stroke
        excess = np.maximum(stroke[:, 0] - lengths, lengths - stroke[:, 1])
        leg = int(excess.argmax())
        if excess[leg] > _STROKE_SLACK_M:
            raise TargetRefusedError(Cause.BEYOND_STROKE, leg, lengths[leg], stroke[leg, int(lengths[leg] > stroke[leg, 1])])
        if self._guard is not None and (excess_found := self._guard(*(part[None] for part in pose))) is not None:
            raise TargetRefusedError(*excess_found)
        lengths = np.clip(lengths, stroke[:, 0], stroke[:, 1])
        motion = self._motion
        if motion is None:
            self._motion = TargetMotion(0.0, lengths, self._limits.velocity)
            self._within = lengths - _JUMP_M, lengths + _JUMP_M
        else:
            if not time_s > self._sent_s:
                raise InputError(
                    f"a sample of {time_s:g} s does not come after {self._sent_s:g} s: send samples in their order"
                )
            elapsed = min(time_s - self._sent_s, STREAM_PATIENCE_S)
            way = _JUMP_FACTOR * self._limits.velocity * elapsed
            least, most = self._within[0] - way, self._within[1] + way
            step = lengths - motion.lengths
            room = np.where(step > 0.0, most - motion.lengths, motion.lengths - least)
            leg = int((np.abs(step) - room).argmax())
            if abs(step[leg]) > room[leg]:
                raise TargetRefusedError(Cause.TARGET_JUMPS, leg, abs(step[leg]), room[leg])
            self._within = np.maximum(least, lengths - _JUMP_M), np.minimum(most, lengths + _JUMP_M)
            motion.add(motion.time + elapsed, lengths)
        self._sent_s = time_s

    def lead(self, motion: KnownMotion) -> None:
        """Follow a motion that is known, in place of samples: plans are then `ahead_s` after its begin."""
        self._known = motion

    def plan(self, at_s: float, ahead_s: float, ended: bool = False) -> Plan | None:
        """Plan how to follow the target. The plan takes effect only after `follow(plan)`.

        Args:
            at_s: motion time at which the plan begins [s], no earlier than the current plan.
            ahead_s: time from the newest sample to that begin [s].
            ended: whether the target stays at its newest sample.

        Returns:
            The plan; None if the current plan goes on.

        Raises:
            InputError: the plan would begin before the current one, or there is no sample.
        """
        if not at_s >= self.current.begin:
            raise InputError(
                f"a plan from {at_s:g} s on would begin before the current plan, at {self.current.begin:g} s: plan for later"
            )
        motion = self._known or self._motion
        if motion is None:
            raise InputError("there is no sample to plan for: add one first")
        state, ahead = self._state(at_s), max(ahead_s, 0.0)
        goal, rates = self._aim(motion, ahead + PREVIEW_S)
        if ended or not rates.any():
            goal = motion.lengths if ended else goal
            if self.current.goal is not None and np.abs(goal - self.current.goal).max() < STILL_M:
                return None
            return self._plan_towards(at_s, state, goal, None, PREVIEW_S)
        for preview in _PREVIEWS_S:
            plan = self._plan_towards(at_s, state, *self._aim(motion, ahead + preview), preview)
            if plan is not None:
                return plan
        return self._plan_towards(at_s, state, goal, None, PREVIEW_S)

    def follow(self, plan: Plan) -> None:
        """Follow a plan from its begin on; the next plan comes after it."""
        self.current = plan
        self._near = plan.near or self._near

    def _state(self, at_s: float) -> Array:
        """The state (n, 3) of the current plan at a time [s]."""
        state = np.empty((LEGS, 3))
        evaluate_reference(self.current.segments, at_s, np.zeros(LEGS, np.int64), state)
        return state[: self._mechanism.legs]

    def _aim(self, motion: TargetMotion | KnownMotion, ahead: float) -> tuple[Array, Array]:
        """Lengths and rates (n,) of the target `ahead` [s] of its newest sample, within the limits."""
        limits = self._limits
        lengths, rates = motion.at(ahead)
        aim = np.clip(lengths, limits.stroke[:, 0], limits.stroke[:, 1])
        # The way that a leg has left to stop in.
        room = np.where(rates > 0.0, limits.stroke[:, 1] - aim, aim - limits.stroke[:, 0])
        most = np.minimum(_stoppable(room, limits.acceleration, limits.jerk), limits.velocity)
        return aim, np.clip(rates, -most, most)

    def _plan_towards(self, begin: float, state: Array, aim: Array, rates: Array | None, preview: float) -> Plan | None:
        """A plan from a state (n, 3) to the aim, to arrive after `preview` [s] with these rates, or at rest; None if limits,
        stroke or ruckig do not allow it.
        """
        follow, limits = self._follow, self._limits
        follow.minimum_duration = preview
        follow.target_position = aim.tolist()
        follow.target_velocity = [0.0] * len(aim) if rates is None else rates.tolist()
        if not calculate(self._otg, follow, state.T.tolist(), self._trajectory):
            return None
        if rates is not None and self._trajectory.duration > _TIMELY * preview:
            return None
        phases, segments = phases_of(self._trajectory), np.empty((LEGS, PLAN_SEGMENTS, 5))
        most = np.array([limits.acceleration, limits.jerk])
        for coast in (0.0,) if rates is None else (_COAST_S, 0.0):
            end = _write_plan(phases, begin, self._trajectory.duration, coast, state, most, segments)
            if count_violations(segments[: len(aim)], end, limits):
                continue
            if (found := self._guarded(segments, begin, end)) is not None:
                return Plan(begin, segments, aim if rates is None else None, found)
        return None

    def _guarded(self, segments: Array, begin: float, end: float) -> Pose | None:
        """The pose at which a plan begins, or one near it; None if the guard refuses a pose between its begin and its end."""
        if self._guard is None:
            return self._near
        times = np.linspace(begin, end, max(2, ceil((end - begin) / _GUARDED_S) + 1))
        lengths = np.empty((len(times), self._mechanism.legs))
        lengths_along(segments, times, lengths)
        positions, rotations = poses_from_lengths(self._mechanism, lengths, self._near, partial=True)
        if not np.isfinite(positions[-1]).all() or self._guard(positions, rotations) is not None:
            return None
        return Pose(positions[0], rotations[0])


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
    """Write the segments (6, m, 5) of phases (n, 2, 9), durations and jerks, from a state (n, 3), then a coast and a stop.
    Returns the time at which all legs are at rest [s].

    Durations count between the rounded starts, so that each row ends exactly where the next one begins.
    """
    count = phases.shape[2]
    segments[:, :, :] = 0.0
    segments[:, :, START] = np.inf
    segments[phases.shape[0] :, 0, START] = begin
    end, arrived = begin, begin + duration
    for leg in range(phases.shape[0]):
        row, now, at = 0, (state[leg, 0], state[leg, 1], state[leg, 2]), begin
        for k in range(count + 2):
            # The rest of ruckig's duration after its phases, and the coast, have no jerk.
            j = phases[leg, 1, k] if k < count else 0.0
            after = min(at + phases[leg, 0, k], arrived) if k < count else arrived if k == count else arrived + coast
            if after > at:
                write_segment(segments[leg, row], at, now, j)
                row, now, at = row + 1, state_after(now, j, after - at), after
        before = 0.0
        for j, t in stop_phases(now[1], now[2], limits[0], limits[1]):
            after = at + ((before + t) - before)
            before += t
            if after > at:
                write_segment(segments[leg, row], at, now, j)
                row, now, at = row + 1, state_after(now, j, after - at), after
        segments[leg, row, START], segments[leg, row, LENGTH] = at, now[0]
        end = max(end, at)
    return end
