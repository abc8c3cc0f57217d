"""What is not known while a set of sensors measures a pose, as a linear model along the true motion: y = H x + n.

The unknowns x are the pose's error with its rate and second derivative; those of a base that may move, its angular velocity,
angular acceleration and specific force; the errors of each IMU and of the magnetometer; of each encoder its zero, the error of
its lead, and what play and steps do to its reading; and, where they are not exact, joints and vertical. The data y are the
means of all readings over each step. `docs/pose_bound.md` says how large each unknown is.

A sensor that is added here has rows of its own in `LinearModel.seen`, and its errors are one more block of unknowns.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from controller.calibration.file import Calibration
from hil.studies.detectability.kinematics import BASE_JET, JET, POSE, Motion, Signals, sensitivity, signals
from plant.encoders import EncoderModel
from plant.imu import ImuModel, SensorErrors, sampled_noise
from plant.imu_wiring import BASE_IMU, IMU_COUNT, PLATFORM_IMU
from plant.mechanism import Mechanism
from plant.pose import Array, rotation_from_vector

STEP_S = 0.02
"""Duration of a step."""

JERK, ANGULAR_JERK = 0.2, 1.0
"""White noise of the jerk of platform and base, RMS in a bandwidth of 1 Hz [m/s^3, rad/s^3]. The motion is free within 8 Hz,
which is what steps of 20 ms can show; what is faster, gyroscopes tell by themselves. With 6 m/s^3 and 35 rad/s^3 and steps of
1 ms, the bounds are 1 to 3 % greater.
"""

PLAY_S = 0.5
"""Time after which play and steps have changed the error of an encoder whose leg moves [s]."""

ERRORS = 21
"""Unknowns of an IMU: biases of gyroscope and accelerometer, scales of accelerometer and gyroscope, alignment, axes of both."""

_START = np.repeat([0.1, 0.5, 0.1, 0.5, 1.0, 5.0], 3)
"""Standard deviations of the pose's error and its derivatives before any data: nothing says where the platform is."""

_BASE_START = np.repeat([0.5, 5.0, 10.0], 3)
"""The same of the base's angular velocity [rad/s], angular acceleration [rad/s^2] and specific force [m/s^2]."""

_FREE_ZERO_M = 0.05
"""Standard deviation of where an incremental encoder begins to count [m]."""

_BASE_RATE, _BASE_HURRY, _BASE_FORCE = (slice(JET + i, JET + i + 3) for i in (0, 3, 6))
_OUT_OF_PLANE = np.array([2, 3, 4])
_ALIGNMENT = 12
_MOVE = 1e-6
_LEAST_NOISE = {"gyroscope": 1e-7, "accelerometer": 1e-6, "magnetometer": 1e-4}
_LEAST_LENGTH_NOISE, _LEAST_TRAVEL = 1e-7, 1e-9
"""Ideal sensors have so much noise, so that every covariance can be inverted."""


@dataclass(frozen=True, eq=False)
class Setup:
    """A mechanism and what measures its pose.

    Attributes:
        mechanism: as the loop knows it.
        imus: which there are, 0-5 on the legs, 6 on the platform, and 7 on the base, which may move then.
        imu: their kind.
        rate: of the loop's samples [Hz].
        magnetometer: whether the platform's is read.
        encoder: the kind of the encoders; None without.
        encoders: the legs that have one; None for all of them.
        calibration: of the IMUs; its covariance, if it has one, takes the place of the errors that the kind of IMU has.
        joint_error: standard deviation of each coordinate of the joints [m].
    """

    mechanism: Mechanism
    imus: tuple[int, ...]
    imu: ImuModel
    rate: float = 1000.0
    magnetometer: bool = False
    encoder: EncoderModel | None = None
    encoders: tuple[int, ...] | None = None
    calibration: Calibration = field(default_factory=Calibration)
    joint_error: float = 0.0

    @property
    def rows_of_imus(self) -> list[int]:
        """The rows of the present IMUs in `Signals`."""
        behind = self.mechanism.legs - PLATFORM_IMU
        return [imu + behind if imu >= PLATFORM_IMU else imu for imu in self.imus]

    @property
    def base_moves(self) -> bool:
        """Whether the base may move, as there is an IMU on it."""
        return BASE_IMU in self.imus

    @property
    def legs_with_encoder(self) -> list[int]:
        """Their numbers."""
        if self.encoder is None:
            return []
        return [leg for leg in range(self.mechanism.legs) if self.encoders is None or leg in self.encoders]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The linear model of a setup; `seen` gives H along a motion, which has the base's if there is an IMU on it."""

    setup: Setup

    @property
    def _motion(self) -> int:
        """The unknowns of the motions; those of sensors and rig are behind them."""
        return JET + BASE_JET if self.setup.base_moves else JET

    @cached_property
    def prior(self) -> Array:
        """(S, S): the covariance of the unknowns before any data."""
        jet: Array = np.reshape(_START**2, (-1, POSE))
        if self.setup.mechanism.planar:
            jet[:, _OUT_OF_PLANE] = 0.0
        motion = np.concatenate([jet.ravel(), _BASE_START**2])[: self._motion]
        blocks = [np.diag(motion), self._fixed, np.diag(self._field_prior), np.diag(self._length_prior)]
        return np.asarray(block_diag(*(block for block in blocks if block.size)))

    @cached_property
    def noise(self) -> Array:
        """(rows,): the variances of the data's white noise."""
        s, legs = self.setup, len(self.setup.legs_with_encoder)
        rate = min(s.imu.sample_rate or inf, s.rate)
        sensors = ("gyroscope", s.imu.gyroscope), ("accelerometer", s.imu.accelerometer)
        imu = np.repeat([_noise(sensor, sampled_noise(s.imu, sensor, rate), rate, name) for name, sensor in sensors], 3)
        magnetometer = s.imu.magnetometer
        field = [_noise(magnetometer, magnetometer.noise, min(rate, s.imu.magnetometer_rate), "magnetometer")] * 3
        length = [max(s.encoder.noise, _LEAST_LENGTH_NOISE) ** 2 / (s.rate * STEP_S)] * legs if s.encoder else []
        return np.array([*imu] * len(s.imus) + field * s.magnetometer + length)

    @cached_property
    def transition(self) -> Array:
        """(S, S): from the unknowns of a step to those of the next one."""
        made = np.eye(len(self.prior))
        powers = STEP_S ** np.arange(3) / np.array([1.0, 1.0, 2.0])
        for i in range(3):
            for j in range(i, 3):
                made[POSE * i : POSE * (i + 1), POSE * j : POSE * (j + 1)] = powers[j - i] * np.eye(POSE)
        if self.setup.base_moves:
            made[_BASE_RATE, _BASE_HURRY] = STEP_S * np.eye(3)
        return made

    @cached_property
    def driving(self) -> Array:
        """(S, S): the covariance of what changes the unknowns in a step."""
        made, free = np.zeros_like(self.prior), np.repeat([JERK, ANGULAR_JERK], 3) ** 2
        if self.setup.mechanism.planar:
            free[_OUT_OF_PLANE] = 0.0
        for i, j, power, divisor in ((0, 0, 5, 20), (0, 1, 4, 8), (0, 2, 3, 6), (1, 1, 3, 3), (1, 2, 2, 2), (2, 2, 1, 1)):
            block = STEP_S**power / divisor * np.diag(free)
            made[POSE * i : POSE * (i + 1), POSE * j : POSE * (j + 1)] = block
            made[POSE * j : POSE * (j + 1), POSE * i : POSE * (i + 1)] = block
        if self.setup.base_moves:
            for one, other, power, divisor in (
                (_BASE_RATE, _BASE_RATE, 3, 3), (_BASE_RATE, _BASE_HURRY, 2, 2), (_BASE_HURRY, _BASE_HURRY, 1, 1)
            ):  # fmt: skip
                made[one, other] = made[other, one] = ANGULAR_JERK**2 * STEP_S**power / divisor * np.eye(3)
            made[_BASE_FORCE, _BASE_FORCE] = JERK**2 * STEP_S * np.eye(3)
        drift = np.zeros(ERRORS)
        drift[:6] = np.repeat([self.setup.imu.gyroscope.drift, self.setup.imu.accelerometer.drift], 3)
        imus = slice(self._motion, self._motion + len(self._kept))
        made[imus, imus] = STEP_S * np.diag(np.tile(drift**2, len(self.setup.imus))[self._kept])
        return made

    def kept(self, motion: Motion) -> Array:
        """(N, legs with an encoder): how much of what play and steps do to a reading is left after each of N steps; all of it
        as long as the leg stands.
        """
        encoder, legs = self.setup.encoder, self.setup.legs_with_encoder
        if encoder is None:
            return np.zeros((len(motion.position), 0))
        travel = STEP_S * np.abs(signals(self.setup.mechanism, motion).leg_rates[:, legs])
        moving = np.minimum(1.0, travel / max(encoder.backlash + encoder.resolution, _LEAST_TRAVEL))
        kept: Array = np.exp(-STEP_S / PLAY_S * moving)
        return kept

    def carried(self, covariance: Array, kept: Array) -> Array:
        """A covariance (S, S) carried on by a step, of which `kept` is (legs with an encoder,)."""
        whole = np.ones(len(covariance))
        whole[len(whole) - len(kept) :] = kept
        made = self.transition @ covariance @ self.transition.T * np.outer(whole, whole) + self.driving
        renewed = np.arange(len(whole) - len(kept), len(whole))
        made[renewed, renewed] += (1.0 - kept**2) * self.prior[renewed, renewed]
        return 0.5 * (made + made.T)

    def seen(self, motion: Motion) -> Array:
        """(N, rows, S): the derivative of the data by the unknowns at N times."""
        mechanism, data, first = self.setup.mechanism, self._data, self._motion
        ideal = signals(mechanism, motion)
        made = np.zeros((len(motion.position), len(self.noise), len(self.prior)))
        made[:, :, :first] = sensitivity(mechanism, motion, data)
        imus = 6 * len(self.setup.imus)
        made[:, :imus, first : first + len(self._kept)] = self._errors_of_imus(ideal)
        start, row = first + len(self._kept), imus
        for i, moved in enumerate(self._moved_rigs):
            ahead, behind = (data(signals(moved(size), motion)) for size in (_MOVE, -_MOVE))
            made[:, :, start + i] = (ahead - behind) / (2.0 * _MOVE)
        start = first + len(self._fixed)
        if self.setup.magnetometer:
            bias, scale, axes, alignment = _errors_of_sensor(self._field(ideal))
            made[:, row : row + 3, start : start + 9] = np.concatenate([bias, scale, axes], axis=2)
            every = np.zeros((len(bias), 3, ERRORS * len(self.setup.imus)))
            at = ERRORS * self.setup.imus.index(PLATFORM_IMU) + _ALIGNMENT
            every[:, :, at : at + 3] = alignment
            made[:, row : row + 3, first : first + len(self._kept)] = every[:, :, self._kept]
            start, row = start + 9, row + 3
        if self.setup.encoder is not None:
            legs = len(self.setup.legs_with_encoder)
            # An incremental encoder's lead counts from where it was switched on.
            led = ideal.lengths - (0.0 if self.setup.encoder.absolute else self._first_lengths)
            led = led[:, self.setup.legs_with_encoder]
            for k in range(legs):
                made[:, row + k, [start + k, start + 2 * legs + k]] = 1.0
                made[:, row + k, start + legs + k] = led[:, k]
        return made

    @cached_property
    def _first_lengths(self) -> Array:
        home = self.setup.mechanism.require_home()
        arms = self.setup.mechanism.platform_joints @ home.rotation.T
        lengths: Array = np.linalg.norm(home.position + arms - self.setup.mechanism.base_joints, axis=1)
        return lengths

    @property
    def _data(self) -> Callable[[Signals], Array]:
        """What is measured, of signals: (N, rows)."""
        setup = self.setup

        def data(ideal: Signals) -> Array:
            readings = np.concatenate([ideal.angular_velocity, ideal.specific_force], axis=2)[:, setup.rows_of_imus]
            parts = [readings.reshape(len(ideal.axes), -1)]
            if setup.magnetometer:
                parts.append(self._field(ideal))
            if setup.encoder is not None:
                parts.append(ideal.lengths[:, setup.legs_with_encoder])
            return np.concatenate(parts, axis=1)

        return data

    def _field(self, ideal: Signals) -> Array:
        """The magnetic field (N, 3) in the platform's axes [uT]."""
        field: Array = self.setup.mechanism.plant["magnetic_field"] @ ideal.axes[:, -1]
        return field

    def _errors_of_imus(self, ideal: Signals) -> Array:
        """(N, 6 K, S'): the derivative of the readings of K IMUs by their errors."""
        imus = self.setup.rows_of_imus
        made = np.zeros((len(ideal.axes), 6 * len(imus), ERRORS * len(imus)))
        for i, row in enumerate(imus):
            rate, force = made[:, 6 * i : 6 * i + 3], made[:, 6 * i + 3 : 6 * i + 6]
            for part, reading, places in (
                (rate, ideal.angular_velocity[:, row], (0, 9, 18, _ALIGNMENT)),
                (force, ideal.specific_force[:, row], (3, 6, 15, _ALIGNMENT)),
            ):
                for place, derivative in zip(places, _errors_of_sensor(reading), strict=True):
                    part[:, :, ERRORS * i + place : ERRORS * i + place + 3] = derivative
        return made[:, :, self._kept]

    @cached_property
    def _all_errors(self) -> Array:
        """The covariance of all errors of the present IMUs, and of joints and vertical where they are not exact."""
        s = self.setup
        known = s.calibration.covariance
        if known is not None:
            rows = (ERRORS * imu + np.arange(ERRORS) for imu in s.imus)
            chosen = np.concatenate([*rows, np.arange(ERRORS * IMU_COUNT, len(known))])
            return np.asarray(known[np.ix_(chosen, chosen)])
        (rate_bias, rate_scale, rate_axes), (bias, scale, axes) = map(_variances, (s.imu.gyroscope, s.imu.accelerometer))
        own = np.repeat([rate_bias, bias, scale, rate_scale, s.imu.misalignment**2 / 3.0, axes, rate_axes], 3)
        of_imus = np.diag(np.tile(own, len(s.imus)))
        if s.joint_error == 0.0:
            return of_imus
        # Legs that share a joint share its error.
        axes_moved = np.diag([1.0, 1.0, 0.0 if s.mechanism.planar else 1.0])
        sides = (np.kron(side[:, None] == side, axes_moved) for side in s.mechanism.distinct_joints())
        return np.asarray(block_diag(of_imus, *(s.joint_error**2 * side for side in sides)))

    @cached_property
    def _kept(self) -> NDArray[np.intp]:
        """Which errors of the IMUs there are at all."""
        kept: NDArray[np.intp] = np.flatnonzero(np.diag(self._all_errors)[: ERRORS * len(self.setup.imus)] > 0.0)
        return kept

    @cached_property
    def _fixed(self) -> Array:
        """The covariance of the errors that there are."""
        chosen = np.r_[self._kept, np.arange(ERRORS * len(self.setup.imus), len(self._all_errors))]
        return np.asarray(self._all_errors[np.ix_(chosen, chosen)])

    @property
    def _field_prior(self) -> Array:
        return np.repeat(_variances(self.setup.imu.magnetometer), 3) if self.setup.magnetometer else np.zeros(0)

    @property
    def _length_prior(self) -> Array:
        encoder, legs = self.setup.encoder, len(self.setup.legs_with_encoder)
        if encoder is None:
            return np.zeros(0)
        zero = encoder.zero if encoder.absolute else _FREE_ZERO_M
        play = (0.5 * encoder.backlash) ** 2 + encoder.resolution**2 / 12.0
        return np.repeat([zero**2, encoder.scale**2 / 3.0, play], legs)

    @property
    def _moved_rigs(self) -> list[Callable[[float], Mechanism]]:
        """For each error of the joints [m] and of the vertical [rad], the mechanism with an error of that size."""
        mechanism, count = self.setup.mechanism, len(self._fixed) - len(self._kept)
        joints = 2 * 3 * mechanism.legs
        return [partial(_moved, mechanism, i) if i < joints else partial(_tilted, mechanism, i - joints) for i in range(count)]


def _moved(mechanism: Mechanism, coordinate: int, size: float) -> Mechanism:
    """The mechanism with one coordinate of its joints (2, n, 3) moved; legs that share a joint may part."""
    moves = np.zeros((2, mechanism.legs, 3))
    moves.flat[coordinate] = size
    base, platform = mechanism.base_joints + moves[0], mechanism.platform_joints + moves[1]
    return replace(mechanism, base_joints=base, platform_joints=platform)


def _tilted(mechanism: Mechanism, axis: int, size: float) -> Mechanism:
    """The mechanism with gravity and magnetic field turned about an axis of {1}."""
    turn = rotation_from_vector(size * np.eye(3)[axis])
    turned = {name: turn @ mechanism.plant[name] for name in ("gravity", "magnetic_field") if name in mechanism.plant}
    return replace(mechanism, plant={**mechanism.plant, **turned})


def _errors_of_sensor(ideal: Array) -> tuple[Array, Array, Array, Array]:
    """The derivatives (N, 3, 3) of the readings of a sensor by bias, scale, axes (xy, xz, yz) and alignment, at ideal readings
    (N, 3): reading = (I + diag(scale) + U(axes)) R(-alignment) ideal + bias.
    """
    x, y, z = ideal.T
    axes, zero = np.zeros((len(ideal), 3, 3)), np.zeros(len(ideal))
    axes[:, 0, 0], axes[:, 0, 1], axes[:, 1, 2] = y, z, z
    alignment = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    return np.broadcast_to(np.eye(3), axes.shape), ideal[:, :, None] * np.eye(3), axes, alignment


def _variances(sensor: SensorErrors) -> tuple[float, float, float]:
    """Of an axis: bias, of a uniform size in a random direction, scale and axes."""
    least, most = sensor.bias
    return (least**2 + least * most + most**2) / 9.0, sensor.scale**2 / 3.0, sensor.cross_axis**2 / 3.0


def _noise(sensor: SensorErrors, density: float, rate: float, name: str) -> float:
    """The variance of the mean of a sensor's samples over a step; white noise of density n, one-sided, leaves n^2 / (2 T)."""
    steps = sensor.resolution**2 / 12.0 / (rate * STEP_S)
    return max(density, _LEAST_NOISE[name]) ** 2 / (2.0 * STEP_S) + steps
