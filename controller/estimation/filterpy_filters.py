"""The filters of legs and platform on filterpy's ExtendedKalmanFilter: the slow clear twins of `leg_filter` and
`platform_filter`, selectable for the whole loop.

They are written with vectors, and the Jacobian of a leg's measurement follows the product rule, term by term, so that they
share no line with the compiled filters.
"""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from controller.estimation import shaking
from controller.estimation.excess import INNOVATION_LIMIT, MEMORY_S
from controller.estimation.leg_filter import start_leg, update_leg_directions
from controller.estimation.platform_filter import (
    BIAS,
    CORRELATION_S,
    ERRORS,
    FASTEST_MOTION,
    LEVEL,
    RATE_NOISE,
    REST_RATE,
    REST_S,
    REST_VELOCITY,
    SLOW_TURN,
    SLOWEST_CORRECTION,
    START_CORRECTION,
    UNSEEN_ACCELERATION,
    VELOCITY,
    YOUNGEST_S,
    begin_platform_step,
    end_platform_step,
)
from controller.estimation.platform_filter import STATE as PLATFORM
from controller.estimation.pose_estimator import follow_plan
from controller.rig import elapsed
from plant.compiled import Record
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.pose import Array, rotation_from_vector, skew

STATES = 9


def _faded(excess: float, squared: float, explained: float, share: float) -> float:
    """The excess after another innovation, of which a share has faded."""
    return max(0.0, excess - min(1.0, share) * (excess + explained), squared - INNOVATION_LIMIT**2 * explained)


class _Filterpy(ExtendedKalmanFilter):  # type: ignore[misc]
    """A filter of filterpy with its state as a vector."""

    @property
    def state(self) -> Array:
        """The state (n,)."""
        state: Array = self.x[:, 0]
        return state

    def start(self, x: Array, covariance: Array) -> None:
        """Take over state (n,) and covariance (n, n)."""
        self.x, self.P = x.reshape(-1, 1).copy(), covariance.copy()


class FilterpyLeg(_Filterpy):
    """One leg's filter on filterpy; the state is that of `leg_filter`.

    Args:
        up_in_joint: (3,), the vertical in the joint frame.
        imu_position: (3,) [m], in the leg frame.
        gravity: [m/s^2].
        period: [s].
        jerk, bias_walk, rate_variance, force_variance: as in `leg_filter.PARAMETERS`.
    """

    def __init__(
        self,
        up_in_joint: Array,
        imu_position: Array,
        gravity: float,
        period: float,
        jerk: float,
        bias_walk: float,
        rate_variance: float,
        force_variance: float,
    ) -> None:
        super().__init__(dim_x=STATES, dim_z=6)
        self.up_in_joint, self.imu_position, self.gravity = up_in_joint, imu_position, gravity
        t = period
        noise = np.array([[t**5 / 20, t**4 / 8, t**3 / 6], [t**4 / 8, t**3 / 3, t**2 / 2], [t**3 / 6, t**2 / 2, t]])
        self.F, self.Q = np.eye(STATES), np.diag([0.0] * 6 + [bias_walk * t] * 3)
        self.F[:6, :6] = np.kron([[1.0, t, t**2 / 2], [0.0, 1.0, t], [0.0, 0.0, 1.0]], np.eye(2))
        self.Q[:6, :6] += np.kron(jerk * noise, np.eye(2))
        self.variances, self.period = np.array([rate_variance, force_variance]), period
        self.excess, self.passed, self.shaken, self.no_motion = np.zeros(2), 0.0, 0.0, 0.0

    def step(self, gyroscope: Array, accelerometer: Array) -> None:
        """Predict over one period and take a sample [rad/s, m/s^2]."""
        self.predict()
        self.take(gyroscope, accelerometer)

    def take(self, gyroscope: Array, accelerometer: Array, clipped: tuple[int, int] = (0, 0)) -> None:
        """Take a sample [rad/s, m/s^2] without predicting; `clipped` says which sensor is at the end of its range."""
        sample = np.concatenate([gyroscope, accelerometer]).reshape(6, 1)
        off, doubt = (sample - self.measurement(self.x)).reshape(2, 3), np.diag(self.P)
        squared, lever = (off**2).sum(axis=1), self.imu_position @ self.imu_position
        of_force = self.variances[1] + self.gravity**2 * doubt[:2].sum() + lever * doubt[4:6].sum()
        for sensor, explained in enumerate((3.0 * self.variances[0] + doubt[2:4].sum(), of_force)):
            self.excess[sensor] = _faded(self.excess[sensor], squared[sensor], explained, self.period / shaking.MEMORY_S)
        if self.shaken > shaking.SHAKEN:
            self.excess[0] = 0.0
        if self.excess[1] == 0.0:
            self.passed += min(1.0, self.period / shaking.AVERAGE_S) * (squared[1] - self.passed)
        hidden = max(0.0, self.passed - of_force)
        variances = self.variances + self.excess + [0.0, hidden + self.no_motion] + shaking.SAYS_NOTHING * np.array(clipped)
        self.update(sample, self.measurement_jacobian, self.measurement, R=np.diag(np.repeat(variances, 3)))

    def measurement(self, x: Array) -> Array:
        """Expected rate and force (6, 1) at a state (9, 1)."""
        omega, alpha, up, *_ = self._motion(x[:, 0])
        d = self.imu_position
        force = self.gravity * up + np.cross(alpha, d) + np.cross(omega, np.cross(omega, d))
        return np.concatenate([omega + x[6:, 0], force]).reshape(6, 1)

    def measurement_jacobian(self, x: Array) -> Array:
        """Derivative (6, 9) of `measurement`."""
        omega, _, _, omega_x, alpha_x, up_x = self._motion(x[:, 0])
        d = self.imu_position
        centripetal = -skew(np.cross(omega, d)) - skew(omega) @ skew(d)
        jacobian = np.zeros((6, STATES))
        jacobian[:3] = omega_x
        jacobian[:3, 6:] += np.eye(3)
        jacobian[3:] = self.gravity * up_x - skew(d) @ alpha_x + centripetal @ omega_x
        return jacobian

    def _motion(self, x: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Rate, angular acceleration and vertical in the leg frame, and their derivatives (3, 9)."""
        a, b, da, db, dda, ddb = x[:6]
        turn_a = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(a), -np.sin(a)], [0.0, np.sin(a), np.cos(a)]])
        turn_b = np.array([[np.cos(b), 0.0, np.sin(b)], [0.0, 1.0, 0.0], [-np.sin(b), 0.0, np.cos(b)]])
        turn_a_a = turn_a @ skew(np.array([1.0, 0.0, 0.0]))
        turn_b_b = turn_b @ skew(np.array([0.0, 1.0, 0.0]))
        # The first axis seen in the leg frame, and its derivatives with respect to b.
        axis = np.array([np.cos(b), 0.0, np.sin(b)])
        axis_b = np.array([-np.sin(b), 0.0, np.cos(b)])
        second = np.array([0.0, 1.0, 0.0])
        omega = da * axis + db * second
        alpha = dda * axis + da * db * axis_b + ddb * second
        up = turn_b.T @ turn_a.T @ self.up_in_joint
        omega_x, alpha_x, up_x = np.zeros((3, STATES)), np.zeros((3, STATES)), np.zeros((3, STATES))
        omega_x[:, 1], omega_x[:, 2], omega_x[:, 3] = da * axis_b, axis, second
        alpha_x[:, 1] = dda * axis_b - da * db * axis
        alpha_x[:, 2], alpha_x[:, 3], alpha_x[:, 4], alpha_x[:, 5] = db * axis_b, da * axis_b, axis, second
        up_x[:, 0] = turn_b.T @ turn_a_a.T @ self.up_in_joint
        up_x[:, 1] = turn_b_b.T @ turn_a.T @ self.up_in_joint
        return omega, alpha, up, omega_x, alpha_x, up_x


class FilterpyPlatform(_Filterpy):
    """The platform's filter on filterpy, which has the errors; the state is beside it, and takes the errors after each step.

    Args:
        gravity: [m/s^2].
        rate_density, bias_walk, force_variance: as in `platform_filter.PARAMETERS`.
    """

    def __init__(self, gravity: float, rate_density: float, bias_walk: float, force_variance: float) -> None:
        super().__init__(dim_x=ERRORS, dim_z=1)
        self.gravity, self.rate_density, self.bias_walk = gravity, rate_density, bias_walk
        nothing = np.zeros((), PLATFORM)
        nothing["force_variance"] = self.nominal_variance = force_variance
        self.take_over(nothing)

    def take_over(self, state: Record) -> None:
        """Take over a state (dtype `platform_filter.STATE`)."""
        up, self.bias, first, self.velocity = np.split(state["x"].copy(), (BIAS, LEVEL, VELOCITY))
        self.axes = np.stack([first, np.cross(up, first), up])
        self.running, self.noise, self.unknown = float(state["running"]), float(state["noise"]), float(state["unknown"])
        self.force_variance = float(state["force_variance"])
        self.resting_for, self.clipped_for = float(state["resting_for"]), float(state["clipped_for"])
        self.start(np.zeros(ERRORS), state["covariance"])

    def hand_over(self, state: Record) -> None:
        """Write the state (dtype `platform_filter.STATE`)."""
        state["x"] = np.concatenate([self.axes[2], self.bias, self.axes[0], self.velocity])
        state["covariance"], state["running"], state["noise"], state["unknown"] = self.P, self.running, self.noise, self.unknown
        state["resting_for"] = self.resting_for

    def step(self, gyroscope: Array, accelerometer: Array, acceleration: Array, period: float) -> None:
        """Predict over a period [s] and take a sample [rad/s, m/s^2], without the IMU's own acceleration (3,) in {2}."""
        rate = gyroscope - self.bias
        self.axes = self.axes @ rotation_from_vector(period * rate)
        shown = period * self.axes[:2] @ (accelerometer - acceleration)
        seen = float(np.mean((self.velocity + shown) ** 2))
        variance = self.force_variance + self.gravity**2 * np.trace(self.P[:2, :2]) / 2.0 + FASTEST_MOTION**2 * self.unknown
        bound = INNOVATION_LIMIT * period * np.sqrt(variance)
        self.velocity = self.velocity + np.clip(shown, -bound, bound)
        self._predict_errors(rate, period)
        self.noise += (self.force_variance - self.nominal_variance) * period**2
        self.unknown = _faded(self.unknown, seen, self.noise, period / MEMORY_S)
        self.noise += self.nominal_variance * period**2
        # The velocity is measured to be zero, along one axis after the other.
        self.R = np.array([[2.0 * CORRELATION_S * self.unknown / period]])
        both = np.trace(self.P[2:4, 2:4])
        self.noise *= (1.0 - both / (both + 2.0 * self.R.item())) ** 2
        for velocity, axis in zip(self.velocity, np.eye(ERRORS)[2:4], strict=True):
            self.update(-velocity, lambda x, h: h, lambda x, h: h @ x, args=axis[None], hx_args=axis[None])
        about_vertical = np.array([*np.zeros(4), *self.axes[2]])
        seems_at_rest = np.linalg.norm(rate) < REST_RATE and self.unknown < REST_VELOCITY**2
        self.resting_for = self.resting_for + period if seems_at_rest else 0.0
        if self.resting_for > REST_S and about_vertical @ self.P @ about_vertical > SLOW_TURN**2:
            self.R = np.array([[SLOW_TURN**2 / period]])
            row = about_vertical[None]
            self.update(rate @ self.axes[2], lambda x, h: h, lambda x, h: h @ x, args=row, hx_args=row)
        self._correct()

    def _predict_errors(self, rate: Array, period: float) -> None:
        self.running += period
        slowest = max(SLOWEST_CORRECTION, START_CORRECTION / (self.running + YOUNGEST_S))
        unknown = (slowest**2 / self.gravity) ** 2 * 2.0 * CORRELATION_S * self.unknown
        turn = self.rate_density + RATE_NOISE * float(rate @ rate) + unknown + UNSEEN_ACCELERATION**2 * self.clipped_for**3
        self.Q = period * np.diag([turn] * 2 + [self.force_variance * period] * 2 + [self.bias_walk] * 3)
        self.F = np.eye(ERRORS)
        self.F[2:4, :2] = period * self.gravity * np.array([[0.0, 1.0], [-1.0, 0.0]])
        self.F[:2, 4:] = -period * self.axes[:2]
        self.predict()

    def _correct(self) -> None:
        turn, velocity, bias = np.split(self.state, (2, 4))
        self.velocity, self.bias = self.velocity + velocity, self.bias + bias
        first, _, up = self.axes + skew(np.array([*turn, 0.0])) @ self.axes
        up = up / np.linalg.norm(up)
        first = first - first @ up * up
        first = first / np.linalg.norm(first)
        self.axes, self.x = np.stack([first, np.cross(up, first), up]), np.zeros((ERRORS, 1))


class FilterpyFilters:
    """The stages of leg and platform filters on filterpy, in place of the compiled ones.

    Args:
        parameters: of the cycle (dtype `controller.cycle.PARAMETERS`).
    """

    def __init__(self, parameters: Record) -> None:
        self._parameters = p = parameters[()]
        sensors, constants = p["rig"]["sensors"], (float(p["rig"]["sensors"]["gravity"]), float(p["rig"]["period"]))
        noise = [float(p["legs"][name]) for name in ("jerk", "bias_walk", "rate_variance", "force_variance")]
        places = zip(sensors["up_in_joint"], sensors["leg_imu_position"], strict=True)
        self._legs = [FilterpyLeg(up, position, *constants, *noise) for up, position in places]
        noise = [float(p["platform"][name]) for name in ("rate_density", "bias_walk", "force_variance")]
        self._platform = FilterpyPlatform(float(sensors["gravity"]), *noise)

    def step_legs(self, state: Record) -> None:
        """Step the leg filters, as `leg_filter.step_leg_filters` does; `state` has dtype `controller.cycle.STATE`."""
        p, s = self._parameters, state[()]
        imus, legs = s["imus"], s["legs"]
        for k, leg in enumerate(self._legs):
            if not imus["used"][k]:
                continue
            rate, force = imus["sample"][GYROSCOPE, k], imus["sample"][ACCELEROMETER, k]
            if legs["age"][k] == 0:
                x, covariance = legs["x"][k], legs["covariance"][k]
                start_leg(x, covariance, rate, force, leg.up_in_joint, float(p["legs"]["bias_sigma"]))
                leg.start(x, covariance)
            else:
                leg.predict()
            shaken = imus["shaking"]
            leg.excess[:], leg.passed, leg.shaken = shaken["excess"][:, k], float(shaken["passed"][k]), float(shaken["mean"][k])
            leg.no_motion = float(shaken["no_motion"][k])
            leg.take(rate, force, tuple(shaken["clipped"][:, k]))
            shaken["excess"][:, k], shaken["passed"][k] = leg.excess, leg.passed
            legs["x"][k], legs["covariance"][k] = leg.state, leg.P
        update_leg_directions(p["legs"], legs, p["rig"], s["time"], imus)

    def step_platform(self, state: Record) -> None:
        """Step the platform's filter, as `platform_filter.step_platform_filter` does."""
        p, s = self._parameters, state[()]
        imus, platform = s["imus"], s["platform"]
        follow_plan(s["pose"], p["rig"], s["reference"]["motion"])
        if begin_platform_step(p["platform"], platform, p["rig"], s["time"], imus, s["pose"]):
            self._platform.take_over(platform)
            force = imus["sample"][ACCELEROMETER, PLATFORM_IMU]
            self._platform.step(platform["gyroscope"], force, platform["imu_acceleration"], elapsed(p["rig"], s["time"]))
            self._platform.hand_over(platform)
            end_platform_step(p["platform"], platform)
