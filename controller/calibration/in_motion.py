"""Calibration in motion: improves what was found at rest by a motion, above all the errors of the gyroscopes.

The whole-mechanism filter, with every error of the IMUs as a state and the covariance at rest as prior, runs over the motion.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from controller.calibration.at_rest import RestCalibration, pose_covariance, undo
from controller.calibration.file import Calibration
from controller.estimation.whole_mechanism.filter import (
    accumulate_lengths,
    accumulate_sample,
    extrapolate,
    extrapolate_covariance,
    start_filter,
    step_filter,
)
from controller.estimation.whole_mechanism.parameters import ALL_ERRORS, FILTER_STATE, filter_parameters
from controller.estimation.whole_mechanism.readings import JOINTS, MOTION_STATES, RIG_ERRORS
from controller.rig import sensor_geometry
from controller.settings import FusionSettings
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT
from plant.errors import CalibrationError
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose

# Factor on the noise for the covariance: what the model leaves out is the same in every swing, and does not average out.
_INFLATION = 1.5
_GUIDE_SIGMA_S = 0.02  # of the Gaussian low-pass of a motion at which the filter is linearised


class Motion(NamedTuple):
    """What was read in a motion that begins at a pose that is about known."""

    samples: Array  # (N, 3, 7, 3), raw
    start: tuple[Pose, Array]  # pose and twist (6,) at the first sample
    lengths: Array | None = None  # (N, 6) [m], by encoders, NaN for none
    read: NDArray[np.bool_] | None = None  # (N,), False where a sample only stands for a missed one; None where all were read

    def part(self, samples: slice, start: tuple[Pose, Array]) -> "Motion":
        """Some of its samples, with pose and twist at the first of them."""
        lengths = None if self.lengths is None else self.lengths[samples]
        read = None if self.read is None else self.read[samples]
        return Motion(self.samples[samples], start, lengths, read)

    def used(self) -> NDArray[np.int64]:
        """(N, 7), which IMUs' samples were read."""
        read = np.ones(len(self.samples), np.int64) if self.read is None else self.read.astype(np.int64)
        return np.repeat(read[:, None], IMU_COUNT, axis=1)


class Track(NamedTuple):
    """Estimates of the whole-mechanism filter."""

    positions: Array  # (N, 3) [m]
    rotations: Array  # (N, 3, 3)
    motions: Array  # (N, 4, 3): velocity and angular velocity in {1}, and their derivatives
    covariances: Array  # (N, 6, 6), of the pose
    state: Record  # of the filter at the end


def track(
    parameters: Record, geometry: Record, samples: Array, used: NDArray[np.int64], rate: float, delay: float,
    start: tuple[Pose, Array], guide: Array | None = None, lengths: Array | None = None,
) -> Track:  # fmt: skip
    """Run the whole-mechanism filter (dtypes `FILTER_PARAMETERS` and `SENSOR_GEOMETRY`) alone.

    Args:
        samples: (N, 3, 7, 3), calibrated.
        used: (N, 7), which IMUs to use.
        rate: samples per second [Hz].
        delay: of the sensors [s].
        start: pose and twist (6,) at the first sample.
        guide: (N, 4, 3), motions at which the Jacobian is taken instead of the filter's own, low-passed one.
        lengths: (N, 6) [m], by encoders, NaN for none.
    """
    shapes, state = ((3,), (3, 3), (4, 3), (6, 6)), np.zeros((), FILTER_STATE)
    positions, rotations, motions, covariances = (np.zeros((len(samples), *shape)) for shape in shapes)
    if lengths is None:
        lengths = np.zeros((0, LEGS))
    if guide is None:
        guide = np.zeros((0, 4, 3))
    else:
        parameters = parameters.copy()
        parameters["smoothing"] = np.inf
    weights = np.repeat(used[:, None, :], 2, axis=1).astype(float)
    pose, twist = start
    start_filter(parameters[()], state[()], 0.0, pose.position, pose.rotation, twist)
    run = Track(positions, rotations, motions, covariances, state)
    _track(parameters[()], geometry[()], state[()], samples, weights, 1.0 / rate, delay, guide, lengths, *run[:-1])
    return run


@kernel
def _track(
    parameters: Record, geometry: Record, state: Record, samples: Array, weights: Array, period: float, delay: float,
    guide: Array, lengths: Array, positions: Array, rotations: Array, motions: Array, covariances: Array,
) -> None:  # fmt: skip
    measured = np.zeros(LEGS)
    for i in range(samples.shape[0]):
        if guide.shape[0] > 0:
            state.low_passed[:] = guide[i]
        if i > 0:
            accumulate_sample(state, samples[i], weights[i], i * period - delay)
            if lengths.shape[0] > 0:
                measured[:] = np.isfinite(lengths[i])
                accumulate_lengths(state, lengths[i], measured, i * period)
            step_filter(parameters, geometry, state)
        motion = motions[i].reshape(12)
        extrapolate(state, i * period, positions[i], rotations[i], motion[:6], motion[6:])
        extrapolate_covariance(parameters, state, i * period, covariances[i])


def calibrate_in_motion(
    mechanism: Mechanism, found: RestCalibration, motion: Motion, rate: float, fusion: FusionSettings
) -> tuple[Calibration, Array]:
    """Improve what was found at rest by a motion.

    The filter runs twice. The second run is linearised at the smoothed motion of the first: at its own motion, the filter would
    take noise for excitation. A third run, with more noise, gives the covariance.

    Args:
        found: by `calibrate_at_rest`, for the same mechanism.
        motion: with lengths if a rig measures them.
        rate: samples per second [Hz].
        fusion: with the noise, play and zeros of the encoders.

    Returns:
        The calibration, and the covariance (185, 185) of the remaining errors of IMUs, joints and tilt.

    Raises:
        CalibrationError: the filter does not follow the motion.
    """
    measured = motion.lengths is not None
    plain, inflated = (
        filter_parameters(fusion, rate, "axes", found.covariance, inflation=by, lengths=measured) for by in (1.0, _INFLATION)
    )
    geometry = sensor_geometry(mechanism.moved_joints(found.joints), found.tilt)
    calibrated, guide = found.calibration().apply(motion.samples), None
    states = []
    for parameters in (plain, plain, inflated):
        run = track(
            parameters, geometry, calibrated, motion.used(), rate, fusion.sensor_delay, motion.start, guide, motion.lengths
        )  # fmt: skip
        if not (np.isfinite(run.state["errors"]).all() and np.isfinite(run.positions).all()):
            raise CalibrationError("the whole-mechanism filter does not follow the motion: check the calibration at rest")
        guide = gaussian_filter1d(run.motions, _GUIDE_SIGMA_S * rate, axis=0, mode="nearest")
        states.append(run.state)
    _, last, with_noise = states
    joints, tilt = found.joints + last["rig"][:JOINTS].reshape(2, LEGS, 3), found.tilt + last["rig"][JOINTS:]
    calibration = found.calibration().then(*undo(last["errors"]), joints=joints, tilt=tilt)
    kept = slice(MOTION_STATES, MOTION_STATES + ALL_ERRORS + RIG_ERRORS)
    covariance: Array = with_noise["covariance"][kept, kept].copy()
    across, of_rig = covariance[ALL_ERRORS:, :ALL_ERRORS], covariance[ALL_ERRORS:, ALL_ERRORS:]
    # The covariance of the IMUs' errors if joints and tilt were known, and what these two add.
    known = covariance[:ALL_ERRORS, :ALL_ERRORS] - across.T @ np.linalg.pinv(of_rig, rcond=1e-12, hermitian=True) @ across
    added = covariance.copy()
    added[:ALL_ERRORS, :ALL_ERRORS] -= known
    built, poses = mechanism.moved_joints(calibration.joints), zip(found.positions, found.rotations, strict=True)
    variances = np.diag(np.mean([pose_covariance(built, calibration.tilt, pose, added) for pose in poses], axis=0))
    return replace(calibration, covariance=known, floor=np.sqrt(variances.reshape(2, 3).sum(axis=1))), covariance
