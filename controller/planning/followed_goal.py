"""A way of the platform to a goal that its operator may change at any time, as by sliders.

ruckig plans each free coordinate of the platform, anew from where it is with each goal, within limits of its own rate,
acceleration and jerk. They are such that no actuator needs more than a share of its limits, whatever the direction.
"""

import numpy as np
from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from controller.inverse_kinematics import leg_lengths
from controller.planning.trajectory_generator import calculate
from plant.errors import InputError, PlanningError
from plant.mechanism import Mechanism
from plant.mechanism.loads import moving_axes
from plant.pose import Array, Pose, rotation_from_vector, vector_from_rotation

_ACTUATOR_SHARE = 0.8
_MOST_TURN = 2.0
"""A goal may be turned by so much from home [rad]: rotation vectors serve as coordinates."""

_DIFFERENCE_S = 1e-4
"""Half the time between the lengths of which a rate is made."""


class FollowedGoal:
    """A way to a goal, of which a later goal may take the place.

    Args:
        mechanism: with home and limits.
        start: the pose of the platform, at rest.
        goal: where it goes.
        speed, turn_speed: of the platform at most [m/s, rad/s].

    Attributes:
        lengths: (n,) [m], of the n legs at its end.
        stopped: whether it was asked to stop on the way.

    Raises:
        InputError: the goal is turned too far from home.
        PlanningError: ruckig found no way.
    """

    def __init__(self, mechanism: Mechanism, start: Pose, goal: Pose, speed: float, turn_speed: float) -> None:
        self._mechanism, self._home, self._free = mechanism, mechanism.require_home(), moving_axes(mechanism)
        count = len(self._free)
        self._otg = Ruckig(count)
        self._parameters = InputParameter(count)
        actuators, joints = mechanism.require_limits(), mechanism.platform_joints
        # Of a turn, the joint that is farthest out moves fastest.
        reach = float(np.linalg.norm(joints, axis=1).max())
        units = np.where(np.array(self._free) < 3, 1.0, 1.0 / reach)
        asked = np.where(np.array(self._free) < 3, speed, turn_speed) / np.sqrt(3.0)
        share = _ACTUATOR_SHARE / count * units
        self._parameters.max_velocity = np.minimum(asked, share * actuators.velocity).tolist()
        self._parameters.max_acceleration = (share * actuators.acceleration).tolist()
        self._parameters.max_jerk = (share * actuators.jerk).tolist()
        at_rest = [0.0] * count
        self._plan((self._coordinates(start).tolist(), at_rest, at_rest), 0.0, self._coordinates(goal).tolist())

    @property
    def duration(self) -> float:
        """When it ends, after its begin [s]."""
        return float(self._began + self._trajectory.duration)

    def aim(self, goal: Pose, time: float) -> None:
        """Go to another goal, from a time after the begin [s]; a way that was stopped stays so.

        Raises:
            InputError, PlanningError: as for a new way; this one goes on.
        """
        if not self.stopped:
            self._plan(self._state(time), max(time, self._began), self._coordinates(goal).tolist())

    def stop(self, time: float) -> None:
        """Come to rest on the way, from a time after the begin [s].

        Raises:
            PlanningError: ruckig found no way to rest; this one goes on.
        """
        if not self.stopped and time < self.duration:
            self._plan(self._state(time), max(time, self._began), None)

    def pose(self, time: float) -> Pose:
        """The pose of the platform at a time after the begin [s]."""
        return self._pose(np.array(self._state(time)[0]))

    def at(self, ahead: float) -> tuple[Array, Array]:
        """Lengths [m] and rates [m/s] (n,) of the legs at a time after the begin [s]; at rest the rates are exactly 0."""
        if ahead >= self.duration:
            return self.lengths, np.zeros(self._mechanism.legs)
        ahead = max(ahead, self._began)
        before, after = max(ahead - _DIFFERENCE_S, self._began), min(ahead + _DIFFERENCE_S, self.duration)
        return self._lengths(ahead), (self._lengths(after) - self._lengths(before)) / (after - before)

    def _state(self, time: float) -> tuple[list[float], list[float], list[float]]:
        within = min(max(time - self._began, 0.0), self._trajectory.duration)
        position, rate, acceleration = self._trajectory.at_time(within)[:3]
        return position, rate, acceleration

    def _lengths(self, time: float) -> Array:
        pose = self.pose(time)
        return leg_lengths(self._mechanism, pose.position, pose.rotation)

    def _plan(self, state: tuple[list[float], list[float], list[float]], began: float, target: list[float] | None) -> None:
        """Plan from a state at a time [s] to a target, None for rest on the way; where that fails, nothing changes."""
        stops, trajectory = target is None, Trajectory(len(self._free))
        self._parameters.control_interface = ControlInterface.Velocity if stops else ControlInterface.Position
        if target is not None:
            self._parameters.target_position = target
        if not calculate(self._otg, self._parameters, state, trajectory):
            raise PlanningError(f"ruckig finds no way to {'rest' if stops else target}: choose another goal")
        self._trajectory, self._began, self.stopped = trajectory, began, stops
        self.lengths = self._lengths(self.duration)

    def _coordinates(self, pose: Pose) -> Array:
        """The free ones of displacement [m] and rotation vector [rad] from home."""
        turn = vector_from_rotation(pose.rotation @ self._home.rotation.T)
        if float(np.linalg.norm(turn)) > _MOST_TURN:
            raise InputError(f"the goal is turned by {np.linalg.norm(turn):.3g} rad from home; at most {_MOST_TURN:g} will do")
        coordinates: Array = np.concatenate([pose.position - self._home.position, turn])[self._free]
        return coordinates

    def _pose(self, coordinates: Array) -> Pose:
        displacement = np.zeros(6)
        displacement[self._free] = coordinates
        return Pose(self._home.position + displacement[:3], rotation_from_vector(displacement[3:]) @ self._home.rotation)
