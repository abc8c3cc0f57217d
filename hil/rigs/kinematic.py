"""A hexapod without dynamics, in the place of the template's hardware: drives of the first order, and ideal IMUs."""

from collections.abc import Callable

import casadi as ca
import numpy as np

from controller.direct_kinematics import pose_from_lengths
from controller.inverse_kinematics import inverse_kinematics
from plant.dynamics.spatial import imu_signals
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, quaternion_from_rotation

_DRIVE_S = 0.02
"""Time constant of a drive's velocity [s]."""

_WATCHDOG_S = 0.1
"""Time without a command after which the legs stop, as with real drives [s]."""


def ideal_signals(mechanism: Mechanism) -> Callable[[Pose, Array, Array], Array]:
    """A function from pose, twist (6,) and acceleration (6,) to the signals (3, 7, 3) of ideal IMUs [rad/s, m/s^2, uT]."""
    position, velocity, omega = (ca.SX.sym(name, 3) for name in ("position", "velocity", "omega"))
    rotation, acceleration = ca.SX.sym("rotation", 3, 3), ca.SX.sym("acceleration", 6)
    constants = {name: ca.SX(ca.DM(value)) for name, value in mechanism.plant_parameters().items()}
    ideal = imu_signals(position, rotation, velocity, omega, acceleration, constants)
    outputs = [ca.vec(ca.densify(value).T) for value in ideal.values()]
    function = ca.Function("signals", [position, rotation, velocity, omega, acceleration], outputs, {"cse": True})

    def signals(pose: Pose, twist: Array, acceleration: Array) -> Array:
        found = function(pose.position, pose.rotation, twist[:3], twist[3:], acceleration)
        return np.array([np.array(kind).reshape(IMU_COUNT, 3) for kind in found])

    return signals


class KinematicHexapod:
    """A mechanism at rest at home, on a clock of its own."""

    def __init__(self, mechanism: Mechanism) -> None:
        self.time_ns = 0  # since the start
        self.velocities: Array = np.zeros(LEGS)  # of the legs [m/s]
        self.commands: Array = np.zeros(LEGS)  # to the drives [m/s]
        self.pose = mechanism.require_home()  # of the platform
        self.lengths: Array = inverse_kinematics(mechanism, self.pose).lengths  # of the legs [m]
        self.signals: Array = np.zeros((3, IMU_COUNT, 3))  # of the IMUs [rad/s, m/s^2, uT]
        self._mechanism = mechanism
        self._twist: Array = np.zeros(6)
        self._signals = ideal_signals(mechanism)
        self.advance(1)

    def advance(self, time_ns: int) -> None:
        """Move on to this time with the present commands."""
        duration = 1e-9 * (time_ns - self.time_ns)
        self.time_ns = time_ns
        if duration > _WATCHDOG_S:
            self._follow(_WATCHDOG_S)
            self.commands = np.zeros(LEGS)
            self._follow(duration - _WATCHDOG_S)
        else:
            self._follow(duration)
        self.pose = pose_from_lengths(self._mechanism, self.lengths, self.pose)
        twist = np.linalg.solve(inverse_kinematics(self._mechanism, self.pose).jacobian, self.velocities)
        acceleration, self._twist = (twist - self._twist) / duration, twist
        self.signals = self._signals(self.pose, twist, acceleration)

    def _follow(self, duration: float) -> None:
        lag = self.velocities - self.commands
        left = np.exp(-duration / _DRIVE_S)
        self.lengths = self.lengths + duration * self.commands + _DRIVE_S * (1.0 - left) * lag
        self.velocities = self.commands + left * lag

    def truth(self) -> Array:
        """Position, quaternion and lengths (13,), as the plant's `truth` buffer begins."""
        return np.concatenate([self.pose.position, quaternion_from_rotation(self.pose.rotation), self.lengths])
