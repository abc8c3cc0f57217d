"""What an operator's requests do to the platform of a run: moves, jogs and stops, checked before they begin.

A move is a straight way of the tool (`controller.planning.straight_way`), or one to a goal that may change
(`controller.planning.followed_goal`). Plans that follow it go to the loop as those of a streamed target do, and all of them end
at rest: whatever becomes of the operator or of this process, the platform stops within its limits.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil, inf, radians
from typing import Any

import numpy as np

from controller.direct_kinematics import poses_from_lengths
from controller.frames import ActiveFrames, Move
from controller.inverse_kinematics import leg_lengths
from controller.planning.followed_goal import FollowedGoal
from controller.planning.motions.elements import Place, ToolLimits
from controller.planning.plan_handover import CAUSE, CYCLE, fail_stream, note_sample
from controller.planning.points import HOME, Point, require_point
from controller.planning.segments import START, lengths_along
from controller.planning.straight_way import StraightWay, is_nothing
from controller.planning.stream_planner import StreamPlanner
from controller.safety.causes import Cause
from controller.workspace import Demands, PoseGuard, first_excess, nearest_reachable, pose_text
from hil.runs.target_stream import LEAD_S, PlanOffers, load_handover
from plant.compiled import Record
from plant.errors import GoughError, InputError, MissingPackageError, UnreachableError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose

SPEED, TURN_SPEED = 0.05, 0.2
"""Speeds of moves that name none [m/s, rad/s]."""

DEADMAN_S, MOST_DEADMAN_S = 0.25, 1.0
"""How long a jog goes on without a sign of its operator, unless that asks for another time, and at most [s]."""

_STALL_NS = round(1e9 * DEADMAN_S)
"""How much longer than a stream's process the channel's may stand still while the platform moves: every plan ends at rest."""

_STALLED_S = 0.05

_FARTHEST_M, _FARTHEST_RAD = 1.0, np.pi
"""A jog ends here, if no limit ends it before."""

_LEAST_JOG = 1e-5
"""A jog that could go no farther is refused [m or rad]."""

_OUT_OF_PLANE = 1e-9
"""A planar mechanism may be asked to leave its plane by so much, which is rounding [m or rad]."""

_STEP_M, _STEP_RAD, _MOST_POSES = 1e-3, radians(0.2), 10_000
"""Poses of a way are checked so far apart. One that is too long for so many of them leads far beyond all limits."""

_OFFER_S = 0.01
_PATIENCE_S = 1.0
"""Time between plans, and how long the platform may come behind its way."""


class RefusedError(GoughError, ValueError):
    """A request that is not carried out. `nearest` is the nearest pose that could be, if there is one."""

    def __init__(self, message: str, nearest: Pose | None = None) -> None:
        super().__init__(message)
        self.nearest = nearest


@dataclass(frozen=True, eq=False)
class Workplace:
    """What moves are made of: the machine, its frames and points, and what is asked of its poses.

    Raises:
        UnknownNameError: a point is in a frame that does not exist.
        InputError: a point's frame or tool is of the wrong kind, or stands on another root than the run's work frame.
    """

    mechanism: Mechanism
    frames: ActiveFrames
    demands: Demands = field(default_factory=Demands)
    points: Mapping[str, Point] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for point in self.points.values():
            self.frames_of(point.frame, point.tool)

    def frames_of(self, frame: str | None, tool: str | None) -> ActiveFrames:
        """The frames of a move; None for those of the run."""
        if frame is None and tool is None:
            return self.frames
        chosen = self.frames.frames.active(frame, tool)
        if chosen.root != self.frames.root:
            raise InputError(
                f"{frame!r} stands on {chosen.root}, and the run's work frame on {self.frames.root}: choose another frame"
            )
        return chosen

    @property
    def home(self) -> Pose:
        """Where a run that is operated begins."""
        return self.mechanism.require_home()

    def planner(self) -> StreamPlanner:
        """A planner that rests at home."""
        lengths = leg_lengths(self.mechanism, self.home.position, self.home.rotation)
        return StreamPlanner(self.mechanism, lengths, None, PoseGuard(self.mechanism, self.demands))


class OperatedPlatform:
    """The platform of a run that is operated.

    Args:
        stream: dtype `STREAM`, shared with the loop.
        workplace: what there is.
        period: of a cycle [s].

    Attributes:
        pose: of {2}, where the platform rests or its move has begun.
        jogging: whether it moves only as long as its operator says so.
        paused: whether it rests, or comes to rest, on a way that can be resumed.
    """

    def __init__(self, stream: Record, workplace: Workplace, period: float) -> None:
        self._stream, self._shared, self._place, self._period = stream, stream["shared"], workplace, period
        _load(workplace)
        self._planner = workplace.planner()
        self._offers = PlanOffers(stream, self._planner, period)
        self.pose, self.jogging, self.paused = workplace.home, False, False
        self._way: StraightWay | FollowedGoal | None = None
        self._towards: tuple[ActiveFrames, Pose, ToolLimits | None] | None = None  # frames, end and limits of the last way
        self._began = self._offered = 0.0
        self._beaten = self._stepped = 0.0
        self._deadman = DEADMAN_S
        self._ended_by = self._over = ""

    @property
    def moving(self) -> bool:
        """Whether a move is under way."""
        return self._way is not None

    @property
    def now(self) -> float:
        """Time of the motion [s]; 0 before it begins."""
        return int(self._shared[CYCLE]) * self._period

    @property
    def commanded(self) -> Pose:
        """The pose of {2} on the way, or where it rests."""
        return self.pose if self._way is None else self._way.pose(self.now - self._began)

    def go_to(
        self, where: Place | str, frame: str | None = None, tool: str | None = None, limits: ToolLimits | None = None
    ) -> float:
        """Begin a straight move to a place in the frames, or to a named point; returns how long it will take [s],
        0 if the platform is there.

        Raises:
            RefusedError: a pose on the way exceeds a limit, or the platform cannot move now.
            GoughError: the request itself cannot be used.
        """
        self._require_rest()
        frames, goal = self._goal(where, frame, tool)
        move = frames.move_between(self.pose, goal)
        return 0.0 if is_nothing(move) else self._begin(frames, move, limits)

    def follow(self, where: Place | str, frame: str | None = None, tool: str | None = None) -> float:
        """Go to a place or a point, which a later call may change while the platform moves; returns how long it will take [s].

        The goal is held against all limits, and so is every plan on the way, which is not straight: the platform comes to rest
        before a limit that lies between.

        Raises:
            RefusedError: the goal exceeds a limit, or the platform cannot move now.
            GoughError: the request itself cannot be used.
        """
        way = self._way if isinstance(self._way, FollowedGoal) and not self._way.stopped else None
        if way is None:
            self._require_rest()
        frames, goal = self._goal(where, frame, tool)
        move = frames.move_between(self.commanded, goal)
        self._require_plane(frames, move)
        mechanism = self._place.mechanism
        if excess := first_excess(mechanism, np.zeros(1), goal.position[None], goal.rotation[None], self._place.demands):
            value, bound, unit = excess.shown
            raise RefusedError(
                f"{excess.limit.text} would be {value:.5g} {unit}, with a limit of {bound:.5g}: choose another place"
            )
        if way is not None:
            way.aim(goal, self._ahead() - self._began)
            self._towards = frames, goal, None
        elif is_nothing(move):
            return 0.0
        else:
            way = FollowedGoal(mechanism, self.pose, goal, SPEED, TURN_SPEED)
            self._set_out(way, (frames, goal, None))
        return way.duration + self._began - self.now

    def move_by(
        self, translation: Any, rotation_vector: Any, axes: str | None = None, limits: ToolLimits | None = None
    ) -> float:
        """Begin a move from where the platform is, along the axes of a frame, by default the work frame's; as `go_to`."""
        self._require_rest()
        return self._begin(self._place.frames, Move(translation, rotation_vector, axes), limits)

    def jog(self, velocity: Any, turn_velocity: Any, axes: str | None = None, deadman: float = DEADMAN_S) -> float:
        """Begin to move at a velocity (3,) [m/s] and a rate of turn (3,) [rad/s], as far as the limits allow; a `beat` within
        each `deadman` [s] keeps it going. Returns how long it can go on [s].

        Raises:
            RefusedError: a limit is so near that it cannot move, or it cannot move now.
            GoughError: the request itself cannot be used.
        """
        self._require_rest()
        if not 0.0 < deadman <= MOST_DEADMAN_S:
            raise InputError(f"deadman is {deadman:g} s; it must be positive, and {MOST_DEADMAN_S:g} s at most")
        rate = Move(velocity, turn_velocity, axes)
        self._place.frames.rate(self.pose, rate)
        self._require_plane(self._place.frames, rate)
        speeds = [float(np.linalg.norm(np.asarray(each, float))) for each in (velocity, turn_velocity)]
        if not max(speeds) > 0.0:
            raise InputError("the jog has no speed: give one along or about an axis")
        far, turned = (
            most / speed if speed > 0.0 else inf for most, speed in zip((_FARTHEST_M, _FARTHEST_RAD), speeds, strict=True)
        )
        lasts = min(far, turned)
        share, limit = self._reach(_scaled(rate, lasts))
        if share * lasts * max(speeds) < _LEAST_JOG:
            raise RefusedError(f"the platform is at a limit that way: {limit}")
        self._ended_by = limit
        limits = ToolLimits(speed=speeds[0] or inf, turn_speed=speeds[1] or inf)
        duration = self._begin(self._place.frames, _scaled(rate, share * lasts), limits)
        self.jogging, self._deadman = True, deadman
        self.beat()
        return duration

    def beat(self) -> None:
        """Note a sign of the operator."""
        self._beaten = time.monotonic()

    def stop(self) -> None:
        """Come to rest on the way, for good."""
        if self._way is not None:
            self._way.stop(self._ahead() - self._began)
            self._ended_by = ""
        self.jogging = self.paused = False

    def pause(self) -> None:
        """Come to rest on the way, which `resume` takes up again; a jog has no end to go on to, and stops."""
        paused = self._way is not None and not self.jogging
        self.stop()
        self.paused = paused

    def resume(self) -> float:
        """Go on to where the platform went when it was paused; as `go_to`."""
        self._require_rest()
        if not self.paused or self._towards is None:
            raise RefusedError("no move has been paused: there is nothing to go on with")
        frames, end, limits = self._towards
        move = frames.move_between(self.pose, end)
        self.paused = False
        return 0.0 if is_nothing(move) else self._begin(frames, move, limits)

    def lose_operator(self) -> None:
        """End the run by a controlled stop if the operator has gone while it jogged; forget what was paused."""
        self.paused = False
        if self.jogging:
            silent = time.monotonic() - self._beaten
            # One whose connection has closed was not silent for too long.
            told = (silent, self._deadman) if silent > self._deadman else (np.nan, np.nan)
            fail_stream(self._stream, Cause.OPERATOR_LOST, -1, *told)
            self.end(Cause.OPERATOR_LOST.short)

    def end(self, reason: str) -> None:
        """Note that the run has stopped, and why: nothing moves any more."""
        self._over, self._way, self.jogging, self.paused = reason, None, False, False

    def step(self) -> str:
        """Go on with the move; to be called each few milliseconds. Returns what has ended, in words, or ""."""
        now = time.monotonic()
        # After a stall of this process the signs of the operator may still wait to be read.
        stalled, self._stepped = now - self._stepped > _STALLED_S, now
        if self.jogging and not stalled and now - self._beaten > self._deadman:
            self.lose_operator()
        if self._way is None:
            return ""
        if self._shared[CAUSE] != Cause.NONE:
            self.end(Cause(int(self._shared[CAUSE])).short)
            return f"the run stops: {self._over}"
        note_sample(self._stream, time.monotonic_ns() + _STALL_NS)
        if not self._offers.settle():
            return ""
        now, plan = self.now, self._planner.current
        behind = now - self._began - self._way.duration
        here = plan.goal is not None and np.abs(plan.goal - self._way.lengths).max() < 1e-8 and now >= _end_of(plan.segments)
        if here or behind > _PATIENCE_S:
            return self._rest(now, behind > _PATIENCE_S)
        if now - self._offered >= _OFFER_S or self._offers.late:
            self._offered = now
            self._offers.offer(self._began)
        return ""

    def _rest(self, now: float, behind: bool) -> str:
        way = self._way
        assert way is not None
        lengths = np.empty((1, self._place.mechanism.legs))
        lengths_along(self._planner.current.segments, np.array([max(now, _end_of(self._planner.current.segments))]), lengths)
        end = way.pose(way.duration)
        positions, rotations = poses_from_lengths(self._place.mechanism, lengths, end, partial=True)
        self.pose = Pose(positions[0], rotations[0]) if np.isfinite(positions).all() else end
        if not behind and not way.stopped:
            # Without the rounding of going by the legs' lengths.
            self.pose = end
        self._way, self.jogging = None, False
        note_sample(self._stream, 0)
        if behind and isinstance(way, FollowedGoal):
            return "stopped before a limit on the way"
        if behind:
            return "the plans did not keep up with the move, which ended early"
        if way.stopped:
            return "paused" if self.paused else "stopped"
        return f"stopped at a limit: {self._ended_by}" if self._ended_by else "arrived"

    def _require_rest(self) -> None:
        if not self._shared[CYCLE]:
            raise RefusedError("the run has not begun to move yet: wait until its mode is running")
        if self._over:
            raise RefusedError(f"the run stops: {self._over}")
        if self._way is not None or not self._offers.settle():
            raise RefusedError("the platform is moving: stop it first, or wait until it rests")
        self._ended_by = ""

    def _goal(self, where: Place | str, frame: str | None, tool: str | None) -> tuple[ActiveFrames, Pose]:
        """The frames and the pose of the platform that a place in them, or a named point, means."""
        if where == HOME:
            return self._place.frames_of(frame, tool), self._place.home
        if isinstance(where, str):
            point = require_point(self._place.points, where)
            where, frame, tool = point.place, frame or point.frame, tool or point.tool
        frames = self._place.frames_of(frame, tool)
        there = where.after(Pose(*frames.to_target(self._place.home, self.commanded)))
        goal = frames.from_target(self._place.home, there.position, there.rotation)
        if not (np.isfinite(goal.position).all() and np.isfinite(goal.rotation).all()):
            raise InputError("the place is too far away to be computed: give its position in m and its rotation in rad")
        return frames, goal

    def _require_plane(self, frames: ActiveFrames, move: Move) -> None:
        """Refuse a move out of the plane of a planar mechanism."""
        if not self._place.mechanism.planar:
            return
        axes = frames.axes(self.pose, move.axes)
        straight, turn = axes @ np.asarray(move.translation, float), axes @ np.asarray(move.rotation_vector, float)
        if not max(abs(straight[2]), abs(turn[0]), abs(turn[1])) <= _OUT_OF_PLANE:
            raise RefusedError(
                f"{self._place.mechanism.name} moves in its plane alone, along x and y and about z: leave z, rx and ry out"
            )

    def _begin(self, frames: ActiveFrames, move: Move, limits: ToolLimits | None) -> float:
        self._require_plane(frames, move)
        way = StraightWay(
            self._place.mechanism, frames, self.pose, move, limits or ToolLimits(speed=SPEED, turn_speed=TURN_SPEED)
        )
        self._check(way)
        self._set_out(way, (frames, way.poses(np.array(1.0)), limits))
        return way.duration

    def _set_out(self, way: StraightWay | FollowedGoal, towards: tuple[ActiveFrames, Pose, ToolLimits | None]) -> None:
        self._began = self._ahead()
        self._offered = -inf
        self._planner.lead(way)
        self._way, self._towards, self.paused = way, towards, False
        note_sample(self._stream, time.monotonic_ns() + _STALL_NS)

    def _ahead(self) -> float:
        """The first time from which a plan can still begin [s]."""
        return self.now + LEAD_S

    def _check(self, way: StraightWay) -> None:
        mechanism, demands = self._place.mechanism, self._place.demands
        # At its fastest it goes no more than twice its mean speed, but for a long ramp.
        times = np.linspace(0.0, way.duration, 2 * _count(way.far, way.turned))
        poses = way.poses(np.array([way.parameter(each)[0] for each in times]))
        excess = first_excess(mechanism, times, poses.position, poses.rotation, demands)
        if excess is None:
            return
        goal = way.poses(np.array(1.0))
        try:
            nearest = nearest_reachable(mechanism, goal, demands, self.pose)
        except (UnreachableError, MissingPackageError):
            raise RefusedError(f"{excess.text}: choose another place") from None
        if nearest.distance == nearest.angle == 0.0:
            raise RefusedError(f"on the straight way there, {excess.text}: go there by another pose", nearest.pose)
        where = pose_text(nearest.pose, self._place.home, self._place.frames)
        raise RefusedError(f"{excess.text}; the nearest pose within all limits is {where}", nearest.pose)

    def _reach(self, move: Move) -> tuple[float, str]:
        """The share of a move that is within all limits, and what ends it, in words."""
        frames, mechanism, demands = self._place.frames, self._place.mechanism, self._place.demands
        far, turned = (float(np.linalg.norm(np.asarray(each, float))) for each in (move.translation, move.rotation_vector))
        low, high, limit = 0.0, 1.0, ""
        shares = np.linspace(0.0, 1.0, _count(far, turned))
        for _ in range(3):
            poses = frames.moved(self.pose, move, shares)
            excess = first_excess(mechanism, shares, poses.position, poses.rotation, demands)
            if excess is None:
                break
            out = int(np.searchsorted(shares, excess.time))
            if out == 0:
                raise RefusedError(f"the platform rests beyond a limit: {excess.limit.text}")
            low, high, limit = float(shares[out - 1]), float(shares[out]), excess.limit.text
            shares = np.linspace(low, high, 11)
        return (low if limit else 1.0), limit


def _load(workplace: Workplace) -> None:
    """Load the machine code of a move: while one goes on there is not enough time."""
    load_handover()
    aside = Move((1e-3, 0.0, 0.0))
    way, planner = StraightWay(workplace.mechanism, workplace.frames, workplace.home, aside), workplace.planner()
    poses = way.poses(np.array([0.0]))
    first_excess(workplace.mechanism, np.zeros(1), poses.position, poses.rotation, workplace.demands)
    planner.lead(way)
    planner.plan(0.0, 0.01)
    way.stop(0.5 * way.duration)
    lengths = np.empty((1, workplace.mechanism.legs))
    lengths_along(planner.current.segments, np.zeros(1), lengths)
    poses_from_lengths(workplace.mechanism, lengths, workplace.home)
    FollowedGoal(workplace.mechanism, workplace.home, workplace.home, SPEED, TURN_SPEED).at(0.0)


def _scaled(move: Move, factor: float) -> Move:
    return Move(factor * np.asarray(move.translation, float), factor * np.asarray(move.rotation_vector, float), move.axes)


def _count(far: float, turned: float) -> int:
    """How many poses of a way are checked."""
    count: int = ceil(min(far / _STEP_M + turned / _STEP_RAD, _MOST_POSES)) + 2
    return count


def _end_of(segments: Array) -> float:
    """When a plan (6, n, 5) comes to rest [s]."""
    starts = segments[:, :, START]
    return float(starts[np.isfinite(starts)].max())
