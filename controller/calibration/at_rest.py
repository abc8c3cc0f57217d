"""Self-calibration: the errors of the IMUs from the redundancy of the mechanism alone.

At rest, seven accelerometers measure twenty-one components of gravity, which six coordinates of the pose explain. Over many
wide poses, *not* known, what is left over tells the accelerometers' bias, scale, axes and mounting, and the tilt of the base:
MAP estimation by Gauss-Newton steps (`calibrate_at_rest`). Motion tells the rest, above all of the gyroscopes: the
whole-mechanism filter, with every error as a state and the first step's covariance as prior, runs over it
(`calibrate_in_motion`).
"""

from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.filter import (
    accumulate_sample,
    extrapolate,
    extrapolate_covariance,
    start_filter,
    step_filter,
)
from controller.estimation.whole_mechanism.imu_errors import ALIGNMENT, ERRORS, error_gradient, error_matrix
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS, FILTER_STATE, filter_parameters
from controller.estimation.whole_mechanism.readings import MOTION_STATES, READINGS, READINGS_SCRATCH, predict_readings
from controller.estimation.whole_mechanism.rig_jacobian import JOINTS, RIG_ERRORS, TILT
from controller.inverse_kinematics import inverse_kinematics
from controller.rig import sensor_geometry
from controller.settings import FusionSettings
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.imu import STANDARD_GRAVITY
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose, rotation_from_vector

LEAST_POSES = 5

_MOST_STEPS = 50
_TILT_STEP = 1e-7
_LENGTH_STEP = 1e-6
_EXACT_M = 1e-8


class CalibrationError(GoughError, ValueError):
    """The data cannot be explained, or do not determine the constants; the message says what to do."""


@dataclass(frozen=True)
class Prior:
    """What is known before: standard deviations.

    Attributes:
        gyroscope_bias, accelerometer_bias: [rad/s, m/s^2].
        accelerometer_scale, gyroscope_scale: [1].
        alignment: of the mounting about each axis [rad].
        axes: off a right angle [rad].
        tilt: of the base about each horizontal axis [rad]; the data tell it hardly better than a spirit level does.
        joints: of each joint's coordinates; 0 takes them for exact [m].
        reading_rate, reading_force: of a mean over a rest, beyond the sensors' noise [rad/s, m/s^2].
    """

    gyroscope_bias: float = radians(20.0)
    accelerometer_bias: float = 0.05 * STANDARD_GRAVITY
    accelerometer_scale: float = 0.03
    gyroscope_scale: float = 0.03
    alignment: float = radians(1.0)
    axes: float = 0.02
    tilt: float = radians(0.05)
    joints: float = 0.0
    reading_rate: float = radians(0.02)
    reading_force: float = 2e-4 * STANDARD_GRAVITY

    def error_sigmas(self) -> Array:
        """(147,), in the order of the errors."""
        each = (
            self.gyroscope_bias, self.accelerometer_bias, self.accelerometer_scale, self.gyroscope_scale, self.alignment,
            self.axes, self.axes,
        )  # fmt: skip
        return np.tile(np.repeat(each, 3), IMU_COUNT)

    def sigmas(self) -> Array:
        """(185,), of the errors, the joints and the tilt."""
        return np.concatenate([self.error_sigmas(), np.full(JOINTS, max(self.joints, _EXACT_M)), np.full(TILT, self.tilt)])


@dataclass(frozen=True, eq=False)
class Rests:
    """Readings of the IMUs at rest, by pose.

    Attributes:
        readings: (N, 7, 6), raw means of rate [rad/s] and force [m/s^2].
        home: whether the first pose is home exactly.
        length_changes: (N, 6) [m], how much longer each leg is than at the first rest, where a rig measures that; else None.
    """

    readings: Array
    home: bool = False
    length_changes: Array | None = None


@dataclass(frozen=True, eq=False)
class Found:
    """What a calibration has found.

    Attributes:
        errors: (7, 21), of the raw IMUs.
        tilt: (2,) [rad], of the base about the axes x and y of {1}.
        joints: (2, 6, 3) [m], what must be added to base and platform joints.
        covariance: (185, 185), of the errors, the joints and the tilt.
        positions, rotations: (N, 3), (N, 3, 3), of the rests.
        residuals: (N, 7, 6), of the readings.
    """

    errors: Array
    tilt: Array
    joints: Array
    covariance: Array
    positions: Array
    rotations: Array
    residuals: Array

    def calibration(self) -> Calibration:
        """The calibration that undoes the errors."""
        of_errors = self.covariance[:ALL_ERRORS, :ALL_ERRORS]
        return Calibration().then(*undo(self.errors), tilt=self.tilt, joints=self.joints, covariance=of_errors)


def undo(errors: Array) -> tuple[Array, Array]:
    """Gain (3, 7, 3, 3) and offset (3, 7, 3) that undo errors (7, 21); the magnetometers' mounting is undone, too."""
    gain, offset = np.empty((3, IMU_COUNT, 3, 3)), np.zeros((3, IMU_COUNT, 3))
    for k in range(IMU_COUNT):
        for sensor in range(2):
            gain[sensor, k] = np.linalg.inv(error_matrix(errors[k], sensor))
            offset[sensor, k] = -gain[sensor, k] @ errors[k, 3 * sensor : 3 * sensor + 3]
        gain[2, k] = rotation_from_vector(errors[k, ALIGNMENT : ALIGNMENT + 3])
    return gain, offset


class _Rest:
    """Ideal readings at rest, and their derivatives."""

    def __init__(self) -> None:
        self._motion, self._readings = np.zeros((4, 3)), np.zeros((IMU_COUNT, READINGS))
        self._jacobian = np.zeros((IMU_COUNT, READINGS, MOTION_STATES))
        self._scratch: Record = np.zeros((), READINGS_SCRATCH)

    def __call__(self, geometry: Record, position: Array, rotation: Array) -> tuple[Array, Array]:
        """(7, 6), and by position and rotation (7, 6, 6)."""
        predict_readings(
            geometry[()], position, rotation, self._motion, True, self._readings, self._jacobian, self._scratch[()]
        )
        return self._readings.copy(), self._jacobian[:, :, :6].copy()

    def by_rig(self, mechanism: Mechanism, tilt: Array, position: Array, rotation: Array) -> Array:
        """The derivative (7, 6, 38) of the readings by joints and tilt."""
        ideal, _ = self(sensor_geometry(mechanism, tilt), position, rotation)
        by_tilt = np.zeros((IMU_COUNT, READINGS, TILT))
        for i, step in enumerate(_TILT_STEP * np.eye(TILT)):
            by_tilt[:, :, i] = (self(sensor_geometry(mechanism, tilt + step), position, rotation)[0] - ideal) / _TILT_STEP
        # A leg's readings depend on its own joints only.
        legs, by_joints = np.arange(LEGS), np.zeros((IMU_COUNT, READINGS, 2, LEGS, 3))
        for side, axis in np.ndindex(2, 3):
            moves = np.zeros((2, LEGS, 3))
            moves[side, :, axis] = _LENGTH_STEP
            moved, _ = self(sensor_geometry(mechanism.moved_joints(moves), tilt), position, rotation)
            by_joints[legs, :, side, legs, axis] = (moved - ideal)[:LEGS] / _LENGTH_STEP
        return np.concatenate([by_joints.reshape(IMU_COUNT, READINGS, JOINTS), by_tilt], axis=2)


def calibrate_at_rest(mechanism: Mechanism, rests: Rests, prior: Prior = Prior()) -> Found:
    """The errors that explain the readings at rest best, whatever the poses were.

    Args:
        mechanism: with home and plant data.
        rests: at least five, as different as possible.
        prior: what is known before.

    Raises:
        CalibrationError: too few rests, or readings that no pose explains.
    """
    count = len(rests.readings)
    if count < LEAST_POSES:
        raise CalibrationError(
            f"{count} poses at rest do not determine the IMUs' errors; at least {LEAST_POSES} do, 20 are good"
        )
    problem = _Problem(mechanism, rests, prior)
    unknowns = problem.start()
    cost, matrix, right = problem.linearise(unknowns)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        scale = np.diag(matrix)
        step = np.linalg.solve(matrix + damping * np.diag(scale), right)
        moved = problem.moved(unknowns, step)
        moved_cost, moved_matrix, moved_right = problem.linearise(moved)
        if moved_cost > cost:
            damping *= 8.0
            continue
        gained = cost - moved_cost
        unknowns, cost, matrix, right = moved, moved_cost, moved_matrix, moved_right
        damping = max(damping / 8.0, 1e-12)
        if gained < 1e-6 * (1.0 + cost) and np.abs(step / np.sqrt(1.0 / scale)).max() < 1e-3:
            break
    else:
        raise CalibrationError("the readings at rest have no explanation: check which IMU sits where, and its signs")
    return problem.found(unknowns, np.linalg.inv(matrix))


@dataclass(eq=False)
class _Unknowns:
    positions: Array
    rotations: Array
    errors: Array
    tilt: Array
    joints: Array


class _Problem:
    """MAP estimation: columns are the poses (6 each), the errors (147), and of the rig the joints (3 each) and the tilt (2)."""

    def __init__(self, mechanism: Mechanism, rests: Rests, prior: Prior) -> None:
        self._mechanism, self._rests = mechanism, rests
        self._count = len(rests.readings)
        self._rest = _Rest()
        self._weights = 1.0 / np.repeat([prior.reading_rate, prior.reading_force], 3)
        at = 6 * self._count
        self._errors = slice(at, at + ALL_ERRORS)
        self._places, joint_of = np.unique(LEGS * np.arange(2)[:, None] + mechanism.distinct_joints(), return_inverse=True)
        places = len(self._places)
        # Legs may share a joint: its coordinates are those of both.
        self._rig_of = np.zeros((RIG_ERRORS, 3 * places + TILT))
        self._rig_of[:JOINTS, : 3 * places] = np.kron(np.eye(places)[joint_of.ravel()], np.eye(3))
        self._rig_of[JOINTS:, 3 * places :] = np.eye(TILT)
        self._rig = slice(self._errors.stop, self._errors.stop + 3 * places + TILT)
        rig_sigmas = prior.sigmas()[ALL_ERRORS:] @ self._rig_of / self._rig_of.sum(axis=0)
        self._prior_weights = 1.0 / np.concatenate([prior.error_sigmas(), rig_sigmas]) ** 2

    def start(self) -> _Unknowns:
        """No errors, and for each rest the pose that explains its forces best."""
        home = self._mechanism.require_home()
        positions, rotations = np.tile(home.position, (self._count, 1)), np.tile(home.rotation, (self._count, 1, 1))
        geometry = sensor_geometry(self._mechanism)
        errors = np.zeros((IMU_COUNT, ERRORS))
        errors[:, :3] = self._rests.readings[:, :, :3].mean(axis=0)
        for n in range(self._count):
            positions[n], rotations[n] = fit_pose(geometry, self._rests.readings[n, :, 3:], home)
        return _Unknowns(positions, rotations, errors, np.zeros(2), np.zeros((2, LEGS, 3)))

    def linearise(self, x: _Unknowns) -> tuple[float, Array, Array]:
        """The cost, the normal matrix and the right side at some unknowns."""
        size = self._rig.stop
        matrix, right = np.zeros((size, size)), np.zeros(size)
        deviations = np.concatenate([x.errors.ravel(), x.joints.reshape(-1, 3)[self._places].ravel(), x.tilt])
        own = slice(self._errors.start, size)
        matrix[own, own] = np.diag(self._prior_weights)
        right[own] = -self._prior_weights * deviations
        cost = float(self._prior_weights @ deviations**2)
        for n in range(self._count):
            rows, residuals = self._rows(x, n)
            matrix += rows.T @ rows
            right += rows.T @ residuals
            cost += float(residuals @ residuals)
        return cost, matrix, right

    def _rows(self, x: _Unknowns, n: int) -> tuple[Array, Array]:
        """Weighted derivatives (42 or more, size) and residuals of one rest."""
        residuals, jacobian = self._readings_rows(x, n)
        rows = [(jacobian * self._weights[:, None]).reshape(-1, jacobian.shape[2])]
        values = [(residuals * self._weights).ravel()]
        here = slice(6 * n, 6 * n + 6)
        if self._rests.home and n == 0:
            home = self._mechanism.require_home()
            row = np.zeros((6, jacobian.shape[2]))
            row[:, here] = np.diag(1.0 / _HOME_SIGMAS)
            turn = 0.5 * (home.rotation @ x.rotations[0].T - x.rotations[0] @ home.rotation.T)
            away = np.array([*(home.position - x.positions[0]), turn[2, 1], turn[0, 2], turn[1, 0]])
            rows.append(row)
            values.append(away / _HOME_SIGMAS)
        changes = self._rests.length_changes
        if changes is not None and n > 0:
            row = np.zeros((6, jacobian.shape[2]))
            legs = [inverse_kinematics(self._mechanism, Pose(x.positions[i], x.rotations[i])) for i in (0, n)]
            row[:, :6], row[:, here] = -legs[0].jacobian / _LENGTH_SIGMA, legs[1].jacobian / _LENGTH_SIGMA
            rows.append(row)
            values.append((changes[n] - (legs[1].lengths - legs[0].lengths)) / _LENGTH_SIGMA)
        return np.concatenate(rows), np.concatenate(values)

    def _readings_rows(self, x: _Unknowns, n: int) -> tuple[Array, Array]:
        """Residuals (7, 6) of the readings of one rest, and the derivatives (7, 6, size) of what is expected."""
        mechanism, pose = self._mechanism.moved_joints(x.joints), (x.positions[n], x.rotations[n])
        ideal, by_pose = self._rest(sensor_geometry(mechanism, x.tilt), *pose)
        jacobian = np.zeros((IMU_COUNT, READINGS, self._rig.stop))
        by_rig = self._rest.by_rig(mechanism, x.tilt, *pose) @ self._rig_of
        gradient, expected = np.zeros(ERRORS), np.empty((IMU_COUNT, READINGS))
        for k in range(IMU_COUNT):
            for sensor in range(2):
                part = slice(3 * sensor, 3 * sensor + 3)
                distortion = error_matrix(x.errors[k], sensor)
                expected[k, part] = distortion @ ideal[k, part] + x.errors[k, part]
                jacobian[k, part, 6 * n : 6 * n + 6] = distortion @ by_pose[k, part]
                jacobian[k, part, self._rig] = distortion @ by_rig[k, part]
            for m in range(READINGS):
                error_gradient(x.errors[k], ideal[k], m, gradient)
                jacobian[k, m, self._errors.start + ERRORS * k : self._errors.start + ERRORS * (k + 1)] = gradient
        return self._rests.readings[n] - expected, jacobian

    def moved(self, x: _Unknowns, step: Array) -> _Unknowns:
        """The unknowns after a step."""
        poses = step[: 6 * self._count].reshape(-1, 6)
        rig = self._rig_of @ step[self._rig]
        turned = np.array([rotation_from_vector(turn) @ r for turn, r in zip(poses[:, 3:], x.rotations, strict=True)])
        return _Unknowns(
            x.positions + poses[:, :3],
            turned,
            x.errors + step[self._errors].reshape(IMU_COUNT, ERRORS),
            x.tilt + rig[JOINTS:],
            x.joints + rig[:JOINTS].reshape(2, LEGS, 3),
        )

    def found(self, x: _Unknowns, covariance: Array) -> Found:
        """The result."""
        residuals = np.array([self._readings_rows(x, n)[0] for n in range(self._count)])
        spread = np.zeros((ALL_ERRORS + RIG_ERRORS, self._rig.stop - self._errors.start))
        spread[:ALL_ERRORS, :ALL_ERRORS], spread[ALL_ERRORS:, ALL_ERRORS:] = np.eye(ALL_ERRORS), self._rig_of
        own = covariance[self._errors.start :, self._errors.start :]
        return Found(x.errors, x.tilt, x.joints, spread @ own @ spread.T, x.positions, x.rotations, residuals)


_HOME_SIGMAS = np.array([5e-5, 5e-5, 5e-5, 2e-4, 2e-4, 2e-4])
_LENGTH_SIGMA = 5e-5


def fit_pose(geometry: Record, forces: Array, home: Pose) -> tuple[Array, Array]:
    """The pose (3,), (3, 3) that explains forces (7, 3) at rest best, all components alike; from home.

    Raises:
        CalibrationError: none does.
    """
    rest = _Rest()
    position, rotation = home.position.copy(), home.rotation.copy()
    damping, (ideal, by_pose) = 1e-3, rest(geometry, position, rotation)
    residual = (forces - ideal[:, 3:]).ravel()
    for _ in range(_MOST_STEPS):
        jacobian = by_pose[:, 3:].reshape(-1, 6)
        matrix = jacobian.T @ jacobian
        step = np.linalg.solve(matrix + damping * np.diag(np.diag(matrix)), jacobian.T @ residual)
        moved = position + step[:3], rotation_from_vector(step[3:]) @ rotation
        ideal, by_moved = rest(geometry, *moved)
        moved_residual = (forces - ideal[:, 3:]).ravel()
        if moved_residual @ moved_residual > residual @ residual:
            damping *= 8.0
            if damping > 1e12:
                return position, rotation
            continue
        (position, rotation), residual, by_pose = moved, moved_residual, by_moved
        damping = max(damping / 8.0, 1e-12)
        if np.abs(step).max() < 1e-9:
            return position, rotation
    raise CalibrationError("the forces at rest have no pose: check which IMU sits where, and its signs")


def expected_forces(geometry: Record, position: Array, rotation: Array) -> Array:
    """Forces (7, 3) that ideal accelerometers read at rest."""
    return _Rest()(geometry, position, rotation)[0][:, 3:]


def pose_covariance(mechanism: Mechanism, tilt: Array, pose: tuple[Array, Array], covariance: Array) -> Array:
    """The covariance (6, 6) of a pose at rest from seven accelerometers, if that of the IMUs' errors, the joints and the tilt
    is `covariance` (185, 185).
    """
    rest = _Rest()
    ideal, by_pose = rest(sensor_geometry(mechanism, tilt), *pose)
    by_others, gradient = np.zeros((IMU_COUNT, 3, ALL_ERRORS + RIG_ERRORS)), np.zeros(ERRORS)
    for k in range(IMU_COUNT):
        for i in range(3):
            error_gradient(np.zeros(ERRORS), ideal[k], 3 + i, gradient)
            by_others[k, i, ERRORS * k : ERRORS * (k + 1)] = gradient
    by_others[:, :, ALL_ERRORS:] = rest.by_rig(mechanism, tilt, *pose)[:, 3:]
    gain = np.linalg.pinv(by_pose[:, 3:].reshape(-1, 6)) @ by_others.reshape(-1, ALL_ERRORS + RIG_ERRORS)
    found: Array = gain @ covariance @ gain.T
    return found


@dataclass(frozen=True, eq=False)
class Track:
    """What the whole-mechanism filter makes of samples: positions (N, 3), rotations (N, 3, 3), motions (N, 4, 3), covariances
    (N, 6, 6) of the pose, and the state at the end.
    """

    positions: Array
    rotations: Array
    motions: Array
    covariances: Array
    state: Record


def track(
    parameters: Record, geometry: Record, samples: Array, used: NDArray[np.int64], rate: float, delay: float,
    start: tuple[Pose, Array], guide: Array | None = None,
) -> Track:  # fmt: skip
    """Run the whole-mechanism filter by itself.

    Args:
        parameters, geometry: dtypes `FILTER_PARAMETERS` and `SENSOR_GEOMETRY`.
        samples: (N, 3, 7, 3), calibrated.
        used: (N, 7), which IMUs to use.
        rate: samples per second [Hz].
        delay: of the sensors [s].
        start: pose and twist (6,) at the first sample.
        guide: (N, 4, 3), motions at which the Jacobian is taken, instead of the filter's own, low-passed one.
    """
    count = len(samples)
    state: Record = np.zeros((), FILTER_STATE)
    found = Track(
        np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros((count, 4, 3)), np.zeros((count, 6, 6)), state
    )  # fmt: skip
    guided = np.zeros((0, 4, 3)) if guide is None else guide
    if guide is not None:
        parameters = parameters.copy()
        parameters["smoothing"] = np.inf
    pose, twist = start
    start_filter(parameters[()], state[()], 0.0, pose.position, pose.rotation, twist)
    _track(
        parameters[()], geometry[()], state[()], samples, used, 1.0 / rate, delay, guided, found.positions, found.rotations,
        found.motions, found.covariances,
    )  # fmt: skip
    return found


@kernel
def _track(
    parameters: Record, geometry: Record, state: Record, samples: Array, used: NDArray[np.int64], period: float, delay: float,
    guide: Array, positions: Array, rotations: Array, motions: Array, covariances: Array,
) -> None:  # fmt: skip
    twist, acceleration = np.zeros(6), np.zeros(6)
    for i in range(samples.shape[0]):
        if guide.shape[0] > 0:
            state.low_passed[:] = guide[i]
        if i > 0:
            accumulate_sample(state, samples[i], used[i], i * period - delay)
            step_filter(parameters, geometry, state)
        extrapolate(state, i * period, positions[i], rotations[i], twist, acceleration)
        extrapolate_covariance(parameters, state, i * period, covariances[i])
        for j in range(3):
            motions[i, 0, j], motions[i, 1, j] = twist[j], twist[3 + j]
            motions[i, 2, j], motions[i, 3, j] = acceleration[j], acceleration[3 + j]


_INFLATION = 1.5
"""What the model leaves out is the same in every swing and does not average out as noise does: the covariance that is told is
that for so many times the noise."""

_GUIDE_SIGMA_S = 0.02


def calibrate_in_motion(
    mechanism: Mechanism, found: Found, samples: Array, rate: float, start: tuple[Pose, Array], fusion: FusionSettings
) -> tuple[Calibration, Array]:
    """Improve what was found at rest by a motion.

    The filter runs twice, the second time linearised at the motion that the first one has found, smoothed to both sides: at its
    own, the noise in it would be taken for excitation. A third run, with more noise, tells the covariance.

    Args:
        mechanism: as before.
        found: by `calibrate_at_rest`.
        samples: (N, 3, 7, 3), raw.
        rate: samples per second [Hz].
        start: pose and twist (6,) at the first sample.
        fusion: settings.

    Returns:
        The calibration, and the covariance (185, 185) of what is left of errors, joints and tilt.

    Raises:
        CalibrationError: the filter does not follow the motion.
    """
    plain, inflated = (filter_parameters(fusion, rate, "axes", found.covariance, inflation=by) for by in (1.0, _INFLATION))
    used = np.ones((len(samples), IMU_COUNT), np.int64)
    geometry = sensor_geometry(mechanism.moved_joints(found.joints), found.tilt)
    calibrated, guide = found.calibration().apply(samples), None
    runs: list[Track] = []
    for parameters in (plain, plain, inflated):
        run = track(parameters, geometry, calibrated, used, rate, fusion.sensor_delay, start, guide)
        if not (np.isfinite(run.state["errors"]).all() and np.isfinite(run.positions).all()):
            raise CalibrationError("the whole-mechanism filter does not follow the motion: check the calibration at rest")
        guide = _smoothed(run.motions, _GUIDE_SIGMA_S * rate)
        runs.append(run)
    last = runs[-2].state
    moved = last["rig"]
    calibration = found.calibration().then(
        *undo(last["errors"]),
        joints=found.joints + moved[:JOINTS].reshape(2, LEGS, 3),
        tilt=found.tilt + moved[JOINTS:],
    )
    kept = slice(MOTION_STATES, MOTION_STATES + ALL_ERRORS + RIG_ERRORS)
    covariance: Array = runs[-1].state["covariance"][kept, kept].copy()
    of_errors, across, of_rig = (
        covariance[:ALL_ERRORS, :ALL_ERRORS],
        covariance[ALL_ERRORS:, :ALL_ERRORS],
        covariance[ALL_ERRORS:],
    )
    # Of the errors if the rig's were known, and what these add.
    known = of_errors - across.T @ np.linalg.pinv(of_rig[:, ALL_ERRORS:], rcond=1e-12, hermitian=True) @ across
    added = covariance.copy()
    added[:ALL_ERRORS, :ALL_ERRORS] -= known
    built, poses = mechanism.moved_joints(calibration.joints), zip(found.positions, found.rotations, strict=True)
    variances = np.diag(np.mean([pose_covariance(built, calibration.tilt, pose, added) for pose in poses], axis=0))
    return replace(calibration, covariance=known, floor=np.sqrt(variances.reshape(2, 3).sum(axis=1))), covariance


def _smoothed(motions: Array, sigma: float) -> Array:
    """Motions (N, 4, 3) after a Gaussian low-pass without delay, of a standard deviation in samples."""
    reach = int(np.ceil(4.0 * sigma))
    kernel_ = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-9)) ** 2)
    padded = np.pad(motions, ((reach, reach), (0, 0), (0, 0)), mode="edge").reshape(len(motions) + 2 * reach, 12)
    columns = [np.convolve(column, kernel_ / kernel_.sum(), mode="valid") for column in padded.T]
    return np.stack(columns, axis=1).reshape(-1, 4, 3)
