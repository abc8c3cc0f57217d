"""A straight way of the platform, which an operator asks for while the loop runs, and may stop at any time.

The pivot goes straight and the platform turns about it at a constant rate (`controller.frames`). ruckig plans the way's
parameter, which goes from 0 to 1, within limits of its rate, acceleration and jerk that keep those of tool and actuators. A
stop slows the parameter down, so that the platform stays on its way.
"""

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from controller.frames import ActiveFrames, Move
from controller.inverse_kinematics import leg_lengths
from controller.planning.motions.elements import ToolLimits
from controller.planning.motions.planned import parameter_limits
from controller.planning.motions.splines import curve_at, natural_spline
from controller.planning.trajectory_generator import calculate
from plant.errors import InputError, PlanningError
from plant.mechanism import Mechanism
from plant.pose import Array, Pose

_KNOTS = 65
_PACE, _ACTUATOR_SHARE = 0.9, 0.8
"""Share of the fastest cruise, and of the actuators' limits: the plans that follow it need some room."""

_SPEEDS, _TURN_SPEEDS = ("speed", "acceleration", "jerk"), ("turn_speed", "turn_acceleration", "turn_jerk")
"""Of the limits of a tool."""

_SHORTEST_M, _SHORTEST_RAD = 1e-7, 1e-6


def is_nothing(move: Move) -> bool:
    """Whether a move leads to where it begins."""
    far, turned = (float(np.linalg.norm(np.asarray(each, float))) for each in (move.translation, move.rotation_vector))
    return far <= _SHORTEST_M and turned <= _SHORTEST_RAD


class StraightWay:
    """A way of the platform, and how it is run through.

    Args:
        mechanism: its legs and limits.
        frames: the work frame, the tool and the pivot.
        start: the pose of the platform.
        move: from there.
        limits: of speed, acceleration and jerk of the move, at the pivot.

    Attributes:
        lengths: (n,) [m], of the n legs at its end.
        stopped: whether it was asked to stop on the way.

    Raises:
        InputError: the move is none, or not finite.
        PlanningError: ruckig found no way.
    """

    def __init__(
        self, mechanism: Mechanism, frames: ActiveFrames, start: Pose, move: Move, limits: ToolLimits | None = None
    ) -> None:
        self._frames, self._start, self._move = frames, start, move
        self.far = float(np.linalg.norm(np.asarray(move.translation, float)))
        self.turned = float(np.linalg.norm(np.asarray(move.rotation_vector, float)))
        if is_nothing(move):
            raise InputError("the platform is there already: there is nothing to move")
        knots = np.linspace(0.0, 1.0, _KNOTS)
        poses = self.poses(knots)
        self._legs = natural_spline(knots, leg_lengths(mechanism, poses.position, poses.rotation))
        self.lengths = self._legs[:, -1, 1].copy()
        self._otg = Ruckig(1)
        self._parameters = InputParameter(1)
        most = self._limits_of_parameter(mechanism, limits or ToolLimits())
        self._parameters.max_velocity, self._parameters.max_acceleration, self._parameters.max_jerk = ([each] for each in most)
        self._parameters.target_position = [1.0]
        self._plan((0.0, 0.0, 0.0), 0.0)

    @property
    def duration(self) -> float:
        """When it ends, after its begin [s]."""
        return float(self._began + self._trajectory.duration)

    def parameter(self, time: float) -> tuple[float, float, float]:
        """The parameter, its rate and its acceleration at a time after the begin [s]."""
        if time >= self.duration:
            return self._end(), 0.0, 0.0
        position, rate, acceleration = (each[0] for each in self._trajectory.at_time(max(time - self._began, 0.0))[:3])
        return position, rate, acceleration

    def poses(self, shares: Array) -> Pose:
        """The poses of the platform at parameters (N,): positions (N, 3) and rotations (N, 3, 3)."""
        return self._frames.moved(self._start, self._move, shares)

    def pose(self, time: float) -> Pose:
        """The pose of the platform at a time after the begin [s]."""
        return self.poses(np.array(self.parameter(time)[0]))

    def at(self, ahead: float) -> tuple[Array, Array]:
        """Lengths [m] and rates [m/s] (n,) of the legs at a time after the begin [s]; at rest the rates are exactly 0."""
        share, rate, _ = self.parameter(ahead)
        values = curve_at(self._legs, np.array([min(max(share, 0.0), 1.0)]))[:2, 0]
        return values[0], values[1] * rate

    def stop(self, time: float) -> None:
        """Come to rest on the way, from a time after the begin [s].

        Raises:
            PlanningError: ruckig found no way to rest; this one goes on.
        """
        if self.stopped or time >= self.duration:
            return
        self._plan(self.parameter(time), time, stops=True)
        self.lengths = self.at(self.duration)[0]

    def _plan(self, state: tuple[float, float, float], began: float, stops: bool = False) -> None:
        """Plan from a state at a time [s], to the end or to rest on the way; where that fails, nothing changes."""
        self._parameters.control_interface = ControlInterface.Velocity if stops else ControlInterface.Position
        trajectory = Trajectory(1)
        if not calculate(self._otg, self._parameters, [[each] for each in state], trajectory):
            raise PlanningError(f"ruckig finds no way along {self.far:g} m and {self.turned:g} rad: choose another speed")
        self._trajectory, self._began, self.stopped = trajectory, began, stops

    def _end(self) -> float:
        return float(self._trajectory.at_time(self._trajectory.duration)[0][0])

    def _limits_of_parameter(self, mechanism: Mechanism, limits: ToolLimits) -> Array:
        actuators = mechanism.require_limits()
        most = _ACTUATOR_SHARE * np.array([actuators.velocity, actuators.acceleration, actuators.jerk])
        knots = self._legs[0, :, 0]
        use = np.abs(curve_at(self._legs, knots)[1:]).max(axis=(1, 2))[:, None] / most
        # The pivot goes straight and the turn is about one axis: only their first derivatives are not 0.
        for size, names in ((self.far, _SPEEDS), (self.turned, _TURN_SPEEDS)):
            use[0] = np.maximum(use[0], [size / getattr(limits, name) for name in names])
        # Where a speed binds, it is reached; where bends do, a slower cruise leaves acceleration for them.
        return parameter_limits(use, 1.0 if use[0, 0] > use[1, 1] ** 0.5 else _PACE)
