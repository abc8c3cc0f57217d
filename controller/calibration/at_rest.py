"""Calibration at rest: the errors of the IMUs from the redundancy of the mechanism alone.

At rest, seven accelerometers measure twenty-one components of gravity, and six coordinates of the pose explain them. The poses
are not known. What is left over, at many wide poses, determines bias, scale, axes and mounting of the accelerometers, and the
tilt of the base: a maximum a posteriori estimate by nonlinear least squares. A motion determines the rest, above all the errors
of the gyroscopes (`in_motion`).
"""

from dataclasses import dataclass
from math import radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.imu_errors import ALIGNMENT, ERRORS, error_gradient, error_matrix
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS
from controller.estimation.whole_mechanism.readings import (
    JOINTS,
    MOTION_STATES,
    READINGS,
    READINGS_SCRATCH,
    TILT,
    predict_readings,
)
from controller.inverse_kinematics import Legs, inverse_kinematics
from controller.rig import sensor_geometry
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import CalibrationError
from plant.imu import STANDARD_GRAVITY
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, rotation_from_vector, skew

LEAST_POSES = 5

_MOST_STEPS = 50
_TILT_STEP = 1e-7
_JOINT_STEP = 1e-6
_EXACT_M = 1e-8
_HOME_SIGMAS = np.array([5e-5, 5e-5, 5e-5, 2e-4, 2e-4, 2e-4])


@dataclass(frozen=True)
class Prior:
    """What is known before the calibration: standard deviations."""

    gyroscope_bias: float = radians(20.0)  # [rad/s]
    accelerometer_bias: float = 0.05 * STANDARD_GRAVITY  # [m/s^2]
    accelerometer_scale: float = 0.03  # [1]
    gyroscope_scale: float = 0.03  # [1]
    alignment: float = radians(1.0)  # of the mounting about each axis [rad]
    axes: float = 0.02  # deviation from a right angle [rad]
    tilt: float = radians(0.05)  # of the base about x and y [rad]; the data determine it hardly better than a spirit level does
    joints: float = 0.0  # of each joint's coordinates [m]; 0 takes the joints as exact
    reading_rate: float = radians(0.02)  # of a mean over a rest, beyond the sensors' noise [rad/s]
    reading_force: float = 2e-4 * STANDARD_GRAVITY  # likewise [m/s^2]

    def of_an_imu(self) -> Array:
        """(21,), in the order of the errors."""
        each = (
            self.gyroscope_bias, self.accelerometer_bias, self.accelerometer_scale, self.gyroscope_scale, self.alignment,
            self.axes, self.axes,
        )  # fmt: skip
        return np.repeat(each, 3)

    def error_sigmas(self) -> Array:
        """(147,), of the seven IMUs."""
        return np.tile(self.of_an_imu(), IMU_COUNT)

    def sigmas(self) -> Array:
        """(185,), of the errors, the joints and the tilt."""
        return np.concatenate([self.error_sigmas(), np.full(JOINTS, max(self.joints, _EXACT_M)), np.full(TILT, self.tilt)])


class MeasuredLengths(NamedTuple):
    """What encoders read at N rests."""

    values: Array  # (N, 6) [m]
    covariance: Array  # (N, N) [m^2], of their errors on each leg: an unknown zero is common to all rests of a run


@dataclass(frozen=True, eq=False)
class Rests:
    """Readings of the IMUs at rest, by pose."""

    readings: Array  # (N, 7, 6), raw means of rate [rad/s] and force [m/s^2]
    home: bool = False  # whether the first pose is exactly home
    lengths: MeasuredLengths | None = None  # if a rig measures them

    def part(self, kept: NDArray[np.int64]) -> "Rests":
        """Some of the rests, by their numbers in ascending order."""
        lengths = self.lengths
        if lengths is not None:
            lengths = MeasuredLengths(lengths.values[kept], lengths.covariance[np.ix_(kept, kept)])
        return Rests(self.readings[kept], self.home and kept[0] == 0, lengths)


@dataclass(frozen=True, eq=False)
class RestCalibration:
    """The result of a calibration at rest."""

    errors: Array  # (7, 21), of the raw IMUs
    tilt: Array  # (2,) [rad], of the base about the axes x and y of {1}
    joints: Array  # (2, 6, 3) [m], corrections of base and platform joints
    covariance: Array  # (185, 185), of the errors, the joints and the tilt
    positions: Array  # (N, 3) [m], of the rests
    rotations: Array  # (N, 3, 3), of the rests
    residuals: Array  # (N, 7, 6), of the readings

    def calibration(self) -> Calibration:
        """The calibration that undoes the errors."""
        of_errors = self.covariance[:ALL_ERRORS, :ALL_ERRORS]
        return Calibration().then(*undo(self.errors), tilt=self.tilt, joints=self.joints, covariance=of_errors)


def undo(errors: Array) -> tuple[Array, Array]:
    """Gain (3, 7, 3, 3) and offset (3, 7, 3) that undo errors (7, 21), the mounting of the magnetometers too."""
    gain, offset = np.empty((3, IMU_COUNT, 3, 3)), np.zeros((3, IMU_COUNT, 3))
    for k in range(IMU_COUNT):
        gain[:2, k], offset[:2, k] = undo_one(errors[k])
        gain[2, k] = rotation_from_vector(errors[k, ALIGNMENT : ALIGNMENT + 3])
    return gain, offset


def undo_one(errors: Array) -> tuple[Array, Array]:
    """Gain (2, 3, 3) and offset (2, 3) that undo the errors (21,) of the gyroscope and the accelerometer of an IMU."""
    gain = np.stack([np.linalg.inv(error_matrix(errors, sensor)) for sensor in range(2)])
    return gain, -(gain @ errors[:6].reshape(2, 3, 1))[..., 0]


def errors_of_base_imu(mechanism: Mechanism, tilt: Array, reading: Array, prior: Prior = Prior()) -> Array:
    """The errors (21,) of an IMU on the base that explain its mean reading (6,) at rest best, given the base's tilt (2,).

    One orientation does not tell bias, scale and mounting of the accelerometer apart: each takes the share that the prior
    expects. The heading of the mounting does not show at all.
    """
    geometry = sensor_geometry(mechanism, tilt)
    ideal = np.concatenate([np.zeros(3), float(geometry["gravity"]) * geometry["up_in_base"].ravel()])
    sigmas = prior.of_an_imu()

    def residuals(x: Array) -> Array:
        """The weighted residuals (27,) at errors in standard deviations."""
        errors = sigmas * x
        expected = [error_matrix(errors, sensor) @ ideal[3 * sensor : 3 * sensor + 3] for sensor in range(2)]
        off = (np.concatenate(expected) + errors[:6] - reading) / np.repeat([prior.reading_rate, prior.reading_force], 3)
        return np.concatenate([off, x])

    found: Array = sigmas * least_squares(residuals, np.zeros(ERRORS)).x
    return found


def _ideal_readings(geometry: Record, position: Array, rotation: Array) -> tuple[Array, Array]:
    """Ideal readings (7, 6) at rest, and their derivatives (7, 6, 6) by position and rotation."""
    readings, jacobian = np.zeros((IMU_COUNT, READINGS)), np.zeros((IMU_COUNT, READINGS, MOTION_STATES))
    scratch: Record = np.zeros((), READINGS_SCRATCH)
    predict_readings(geometry[()], position, rotation, np.zeros((4, 3)), True, readings, jacobian, scratch[()])
    return readings, jacobian[:, :, :6].copy()


def _readings_by_rig(mechanism: Mechanism, tilt: Array, position: Array, rotation: Array) -> Array:
    """The derivative (7, 6, 38) of the ideal readings at rest by joints and tilt."""
    ideal, _ = _ideal_readings(sensor_geometry(mechanism, tilt), position, rotation)
    by_tilt = np.zeros((IMU_COUNT, READINGS, TILT))
    for i, step in enumerate(_TILT_STEP * np.eye(TILT)):
        tilted, _ = _ideal_readings(sensor_geometry(mechanism, tilt + step), position, rotation)
        by_tilt[:, :, i] = (tilted - ideal) / _TILT_STEP
    # A leg's readings depend on its own joints only.
    legs, by_joints = np.arange(LEGS), np.zeros((IMU_COUNT, READINGS, 2, LEGS, 3))
    for side, axis in np.ndindex(2, 3):
        moves = np.zeros((2, LEGS, 3))
        moves[side, :, axis] = _JOINT_STEP
        moved, _ = _ideal_readings(sensor_geometry(mechanism.moved_joints(moves), tilt), position, rotation)
        by_joints[legs, :, side, legs, axis] = (moved - ideal)[:LEGS] / _JOINT_STEP
    return np.concatenate([by_joints.reshape(IMU_COUNT, READINGS, JOINTS), by_tilt], axis=2)


def _lengths_by_rig(legs: Legs, rotation: Array) -> Array:
    """The derivative (6, 38) of the lengths by joints and tilt."""
    every, by_joints = np.arange(LEGS), np.zeros((LEGS, 2, LEGS, 3))
    by_joints[every, 0, every], by_joints[every, 1, every] = -legs.directions, legs.directions @ rotation
    return np.hstack([by_joints.reshape(LEGS, JOINTS), np.zeros((LEGS, TILT))])


def calibrate_at_rest(mechanism: Mechanism, rests: Rests, prior: Prior = Prior()) -> RestCalibration:
    """The errors that explain the readings at rest best, whatever the poses were.

    Args:
        mechanism: with home and plant data.
        rests: at least five, as different as possible.

    Raises:
        CalibrationError: too few rests, or readings that no pose explains.
    """
    count = len(rests.readings)
    if count < LEAST_POSES:
        raise CalibrationError(
            f"{count} poses at rest do not determine the IMUs' errors; at least {LEAST_POSES} do, 20 are good"
        )
    problem = _Problem(mechanism, rests, prior)
    fit = least_squares(problem.residuals, problem.start, problem.jacobian, method="trf", max_nfev=_MOST_STEPS)
    if not fit.success:
        raise CalibrationError("the readings at rest have no explanation: check which IMU sits where, and its signs")
    return problem.result(fit.x, np.linalg.inv(fit.jac.T @ fit.jac))


class _State(NamedTuple):
    """What some unknowns stand for, with the fields of `RestCalibration`, and the mechanism with its joints moved."""

    positions: Array
    rotations: Array
    errors: Array
    joints: Array
    tilt: Array
    mechanism: Mechanism

    def legs(self, n: int) -> Legs:
        """The legs at rest `n`."""
        return inverse_kinematics(self.mechanism, Pose(self.positions[n], self.rotations[n]))


class _Problem:
    """Least squares for the unknowns x: of each rest the translation and the rotation vector from its first pose, then the
    errors (147), each distinct joint (3) and the tilt (2).

    The weighted residuals are those of the readings, of home, of the lengths, and of the prior.
    """

    def __init__(self, mechanism: Mechanism, rests: Rests, prior: Prior) -> None:
        self._mechanism, self._rests, self._home = mechanism, rests, mechanism.require_home()
        self._count = len(rests.readings)
        self._weights = 1.0 / np.repeat([prior.reading_rate, prior.reading_force], 3)
        geometry = sensor_geometry(mechanism)
        poses = [fit_pose(geometry, reading[:, 3:], self._home) for reading in rests.readings]
        self._positions, self._rotations = (np.array(each) for each in zip(*poses, strict=True))
        # Legs may share a joint: its coordinates are those of both.
        places, joint_of = np.unique(LEGS * np.arange(2)[:, None] + mechanism.distinct_joints(), return_inverse=True)
        self._rig_of = block_diag(np.kron(np.eye(len(places))[joint_of.ravel()], np.eye(3)), np.eye(TILT))
        rig_sigmas = prior.sigmas()[ALL_ERRORS:] @ self._rig_of / self._rig_of.sum(axis=0)
        self._sigmas = np.concatenate([prior.error_sigmas(), rig_sigmas])
        own = 6 * self._count
        self._errors, self._rig = slice(own, own + ALL_ERRORS), slice(own + ALL_ERRORS, own + len(self._sigmas))
        if rests.lengths is not None:
            self._whiten = np.linalg.inv(np.linalg.cholesky(rests.lengths.covariance))
        # The first poses explain the forces best if the accelerometers have no errors.
        self.start = np.zeros(self._rig.stop)
        self.start[self._errors].reshape(IMU_COUNT, ERRORS)[:, :3] = rests.readings[:, :, :3].mean(axis=0)

    def _state(self, x: Array) -> _State:
        poses, rig = x[: 6 * self._count].reshape(-1, 6), self._rig_of @ x[self._rig]
        turned = [rotation_from_vector(turn) @ start for turn, start in zip(poses[:, 3:], self._rotations, strict=True)]
        errors, joints = x[self._errors].reshape(IMU_COUNT, ERRORS), rig[:JOINTS].reshape(2, LEGS, 3)
        moved = self._mechanism.moved_joints(joints)
        return _State(self._positions + poses[:, :3], np.array(turned), errors, joints, rig[JOINTS:], moved)

    def _expected(self, state: _State) -> Array:
        """The readings (N, 7, 6) that are expected."""
        geometry = sensor_geometry(state.mechanism, state.tilt)
        expected = np.empty((self._count, IMU_COUNT, READINGS))
        for n in range(self._count):
            ideal, _ = _ideal_readings(geometry, state.positions[n], state.rotations[n])
            for k, sensor in np.ndindex(IMU_COUNT, 2):
                part = slice(3 * sensor, 3 * sensor + 3)
                expected[n, k, part] = error_matrix(state.errors[k], sensor) @ ideal[k, part] + state.errors[k, part]
        return expected

    def residuals(self, x: Array) -> Array:
        """The weighted residuals (M,)."""
        state = self._state(x)
        parts: list[Array] = [((self._expected(state) - self._rests.readings) * self._weights).ravel()]
        if self._rests.home:
            turn = 0.5 * (state.rotations[0] @ self._home.rotation.T - self._home.rotation @ state.rotations[0].T)
            away = np.array([*(state.positions[0] - self._home.position), turn[2, 1], turn[0, 2], turn[1, 0]])
            parts.append(away / _HOME_SIGMAS)
        if self._rests.lengths is not None:
            lengths = np.array([state.legs(n).lengths for n in range(self._count)])
            parts.append((self._whiten @ (lengths - self._rests.lengths.values)).ravel())
        return np.concatenate([*parts, x[self._errors.start :] / self._sigmas])

    def jacobian(self, x: Array) -> Array:
        """The derivatives (M, size) of the residuals."""
        state = self._state(x)
        geometry, gradient = sensor_geometry(state.mechanism, state.tilt), np.zeros(ERRORS)
        rows = np.zeros((self._count, IMU_COUNT, READINGS, len(x)))
        for n in range(self._count):
            pose = state.positions[n], state.rotations[n]
            ideal, by_pose = _ideal_readings(geometry, *pose)
            by_rig = _readings_by_rig(state.mechanism, state.tilt, *pose) @ self._rig_of
            for k in range(IMU_COUNT):
                for sensor in range(2):
                    part, distortion = slice(3 * sensor, 3 * sensor + 3), error_matrix(state.errors[k], sensor)
                    rows[n, k, part, 6 * n : 6 * n + 6] = distortion @ by_pose[k, part]
                    rows[n, k, part, self._rig] = distortion @ by_rig[k, part]
                first = self._errors.start + ERRORS * k
                for m in range(READINGS):
                    error_gradient(state.errors[k], ideal[k], m, gradient)
                    rows[n, k, m, first : first + ERRORS] = gradient
        parts = [(rows * self._weights[:, None]).reshape(-1, len(x))]
        if self._rests.home:
            parts.append(np.eye(6, len(x)) / _HOME_SIGMAS[:, None])
        if self._rests.lengths is not None:
            lengths = np.zeros((self._count, LEGS, len(x)))
            for n in range(self._count):
                legs = state.legs(n)
                lengths[n, :, 6 * n : 6 * n + 6] = legs.jacobian
                lengths[n, :, self._rig] = _lengths_by_rig(legs, state.rotations[n]) @ self._rig_of
            parts.append(np.tensordot(self._whiten, lengths, 1).reshape(-1, len(x)))
        jacobian = np.concatenate([*parts, np.eye(len(self._sigmas), len(x), self._errors.start) / self._sigmas[:, None]])
        for n in range(self._count):
            turn = slice(6 * n + 3, 6 * n + 6)
            jacobian[:, turn] = jacobian[:, turn] @ _turn_by_vector(x[turn])
        return jacobian

    def result(self, x: Array, covariance: Array) -> RestCalibration:
        """The result at the unknowns, with their covariance."""
        state, spread = self._state(x), block_diag(np.eye(ALL_ERRORS), self._rig_of)
        own = covariance[self._errors.start :, self._errors.start :]
        residuals = self._rests.readings - self._expected(state)
        return RestCalibration(
            state.errors, state.tilt, state.joints, spread @ own @ spread.T, state.positions, state.rotations, residuals
        )


def _turn_by_vector(vector: Array) -> Array:
    """The derivative (3, 3) of a rotation, as a turn seen in {1}, by its rotation vector (3,)."""
    angle, cross = max(float(np.linalg.norm(vector)), 1e-4), skew(vector)
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    derivative: Array = np.eye(3) + a * cross + b * cross @ cross
    return derivative


def fit_pose(geometry: Record, forces: Array, home: Pose) -> tuple[Array, Array]:
    """The pose (3,), (3, 3) that explains forces (7, 3) at rest best, all components alike; from home.

    Raises:
        CalibrationError: none does.
    """

    def pose(x: Array) -> tuple[Array, Array]:
        return home.position + x[:3], rotation_from_vector(x[3:]) @ home.rotation

    def residuals(x: Array) -> Array:
        return (expected_forces(geometry, *pose(x)) - forces).ravel()

    def jacobian(x: Array) -> Array:
        by_pose = _ideal_readings(geometry, *pose(x))[1][:, 3:].reshape(-1, 6)
        return np.hstack([by_pose[:, :3], by_pose[:, 3:] @ _turn_by_vector(x[3:])])

    fit = least_squares(residuals, np.zeros(6), jacobian, method="lm", ftol=1e-12, xtol=1e-12, gtol=1e-12)
    if not fit.success:
        raise CalibrationError("the forces at rest have no pose: check which IMU sits where, and its signs")
    return pose(fit.x)


def expected_forces(geometry: Record, position: Array, rotation: Array) -> Array:
    """Forces (7, 3) that ideal accelerometers read at rest."""
    return _ideal_readings(geometry, position, rotation)[0][:, 3:]


def pose_covariance(mechanism: Mechanism, tilt: Array, pose: tuple[Array, Array], covariance: Array) -> Array:
    """The covariance (6, 6) of a pose at rest by accelerometers, for one (185, 185) of the IMUs' errors, joints and tilt."""
    ideal, by_pose = _ideal_readings(sensor_geometry(mechanism, tilt), *pose)
    by_others, gradient = np.zeros((IMU_COUNT, 3, len(covariance))), np.zeros(ERRORS)
    for k in range(IMU_COUNT):
        for i in range(3):
            error_gradient(np.zeros(ERRORS), ideal[k], 3 + i, gradient)
            by_others[k, i, ERRORS * k : ERRORS * (k + 1)] = gradient
    by_others[:, :, ALL_ERRORS:] = _readings_by_rig(mechanism, tilt, *pose)[:, 3:]
    gain = np.linalg.pinv(by_pose[:, 3:].reshape(-1, 6)) @ by_others.reshape(-1, len(covariance))
    found: Array = gain @ covariance @ gain.T
    return found
