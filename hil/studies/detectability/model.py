"""What the data would be without a fault: a linear model with Gaussian errors, and its best estimate of the pose.

The unknowns are the pose's error with its rate and second derivative, which white noise of its jerk drives; a bias of each of
the 42 axes of gyroscopes and accelerometers, which walks at random; and first-order Gauss-Markov processes: one of each such
axis, for what changes with pose, supply and vibration, and one of each drive's speed. The data of a window are what the sensors
read on average over each of its steps, and the leg rates that the drives' model predicts from the commands.

`whitened` is a Kalman filter, which does the batch's algebra step by step: what it has not predicted, over its standard
deviation, is the data multiplied by a triangular root of the inverse covariance of the whole batch, unknowns included.
"""

from dataclasses import dataclass
from functools import cached_property
from math import exp
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from hil.studies.detectability.kinematics import JET, POSE, Motion, sensitivity
from hil.studies.detectability.uncertainty import Uncertainty
from plant.imu import ImuModel, sampled_noise
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array

SENSORS = 2 * 3 * IMU_COUNT
DATA = SENSORS + LEGS
STATES = JET + DATA + SENSORS
_BIASES, _WANDER, _DRIVES = slice(JET, JET + SENSORS), slice(JET + SENSORS, STATES - LEGS), slice(STATES - LEGS, STATES)


_START = np.repeat([0.1, 0.5, 0.1, 0.5, 1.0, 5.0], 3)
"""Standard deviations of the pose's error and its derivatives before any data: the IMUs alone say where the platform is."""


class Filter(NamedTuple):
    """What the Kalman filter of a model does in each step, whatever the data are."""

    whitening: Array  # (M, 48, 48), of innovations: the inverse of their covariance's root
    gains: Array  # (M, 48, 108), of the states from the whitened innovations
    covariances: Array  # (M, 6, 6), of the pose's estimate


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The data of M steps: `data = sensitivity @ states + noise`, `next states = transition @ states + driving noise`."""

    sensitivity: Array  # (M, 48, 108)
    noise: Array  # (48,), variances
    transition: Array  # (108, 108)
    driving: Array  # (108, 108), covariance
    prior: Array  # (108,), variances

    @cached_property
    def filter(self) -> Filter:
        """Its Kalman filter."""
        steps, covariance = len(self.sensitivity), np.diag(self.prior)
        found = Filter(np.empty((steps, DATA, DATA)), np.empty((steps, DATA, STATES)), np.empty((steps, POSE, POSE)))
        for n, seen in enumerate(self.sensitivity):
            across = seen @ covariance
            root = np.linalg.cholesky(across @ seen.T + np.diag(self.noise))
            found.whitening[n] = solve_triangular(root, np.eye(DATA), lower=True)
            found.gains[n] = gain = found.whitening[n] @ across
            covariance -= gain.T @ gain
            found.covariances[n] = covariance[:POSE, :POSE]
            covariance = self.transition @ covariance @ self.transition.T + self.driving
            covariance = 0.5 * (covariance + covariance.T)
        return found


class Whitened(NamedTuple):
    """Data in units of their own standard deviations, and what the best estimate without a fault makes of them."""

    innovations: Array  # (M, 48, C): independent, each of variance 1 without a fault
    estimates: Array  # (M, 6, C): of the pose's error at each step, from the data until then [m, rad]
    covariances: Array  # (M, 6, 6), of this estimate's error


def linear_model(
    mechanism: Mechanism, motion: Motion, imu: ImuModel, rate: float, uncertainty: Uncertainty, step: float
) -> LinearModel:  # fmt: skip
    """The model along a motion at times that are `step` [s] apart, of samples at a rate [Hz]."""
    u = uncertainty
    seen = np.zeros((len(motion.position), DATA, STATES))
    seen[:, :, :JET] = sensitivity(mechanism, motion)
    seen[:, :SENSORS, _BIASES] = np.eye(SENSORS)
    seen[:, :SENSORS, _WANDER] = np.eye(SENSORS)
    seen[:, SENSORS:, _DRIVES] = np.eye(LEGS)
    # White noise of density n, one-sided, has the variance n^2 / (2 T) in the mean over T.
    of_imus = _per_axis(*(sampled_noise(imu, sensor, rate) for sensor in (imu.gyroscope, imu.accelerometer)))
    densities = np.r_[of_imus, [u.drive_noise] * LEGS]
    transition, driving = np.eye(STATES), np.zeros((STATES, STATES))
    powers = step ** np.arange(3) / np.array([1.0, 1.0, 2.0])
    for i in range(3):
        for j in range(i, 3):
            transition[POSE * i : POSE * (i + 1), POSE * j : POSE * (j + 1)] = powers[j - i] * np.eye(POSE)
    density = np.diag(np.repeat([u.jerk, u.angular_jerk], 3) ** 2)
    for i, j, power, divisor in ((0, 0, 5, 20), (0, 1, 4, 8), (0, 2, 3, 6), (1, 1, 3, 3), (1, 2, 2, 2), (2, 2, 1, 1)):
        block = step**power / divisor * density
        driving[POSE * i : POSE * (i + 1), POSE * j : POSE * (j + 1)] = block
        driving[POSE * j : POSE * (j + 1), POSE * i : POSE * (i + 1)] = block
    driving[_BIASES, _BIASES] = step * np.diag(_per_axis(u.gyroscope_walk, u.accelerometer_walk) ** 2)
    wander, drives = _per_axis(u.gyroscope_wander, u.accelerometer_wander), np.full(LEGS, u.drive_rate)
    for states, sizes, time in ((_WANDER, wander, u.wander_time), (_DRIVES, drives, u.drive_time)):
        keep = exp(-step / time)
        transition[states, states] *= keep
        driving[states, states] = (1.0 - keep**2) * np.diag(sizes**2)
    prior = np.r_[_START, _per_axis(u.gyroscope_bias, u.accelerometer_bias), wander, drives] ** 2
    return LinearModel(seen, densities**2 / (2.0 * step), transition, driving, prior)


def _per_axis(gyroscope: float, accelerometer: float) -> Array:
    """(42,): a value for the axes of gyroscopes and one for those of accelerometers, IMU by IMU."""
    return np.tile(np.repeat([gyroscope, accelerometer], 3), IMU_COUNT)


def whitened(model: LinearModel, data: Array) -> Whitened:
    """Whiten columns of data (M, 48, C), each a record of all steps, and estimate the pose's error from each."""
    steps, columns = len(data), data.shape[2]
    state = np.zeros((STATES, columns))
    innovations, estimates = np.empty((steps, DATA, columns)), np.empty((steps, POSE, columns))
    for n, (seen, whitening, gain) in enumerate(zip(model.sensitivity, *model.filter[:2], strict=True)):
        innovations[n] = whitening @ (data[n] - seen @ state)
        state += gain.T @ innovations[n]
        estimates[n] = state[:POSE]
        state = model.transition @ state
    return Whitened(innovations, estimates, model.filter.covariances)
