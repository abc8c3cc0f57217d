"""Assessment of a calibration on the rig: how well it explains the rests, and how accurate poses are."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import LEAST_POSES, expected_forces, fit_pose, pose_covariance
from controller.calibration.file import Calibration, split_gain
from controller.calibration.in_motion import Motion, calibrate_in_motion, track
from controller.estimation.whole_mechanism.imu_errors import ERROR_NAMES
from controller.estimation.whole_mechanism.parameters import filter_parameters
from controller.estimation.whole_mechanism.readings import RATE, VELOCITY
from hil.calibration.data import CalibrationData
from plant.dynamics.variables import IMU_COUNT
from plant.imu import ACCELEROMETER, MILLI_G
from plant.mechanism import Mechanism
from plant.pose import Array, Pose, pose_errors, rms_figures, rotations_from_quaternions

STAGES = {
    "before": "as they are",
    "known": "by known poses",
    "rests": "calibrated at rest",
    "motion": "and in motion",
}
"""Stages of a calibration, and their names in plain words."""

UNTOLD = 0.5
"""Data hardly tell a constant that keeps more than this share of its prior standard deviation."""
_FOLDS = 5


def assess(data: CalibrationData, cases: Mapping[str, tuple[Calibration, Array]]) -> dict[str, Any]:
    """Residuals and the accuracy of poses at rest, predicted and, where the truth is known, true.

    `cases` has by stage its calibration and the covariance (185, 185) of the remaining errors.
    """
    figures: dict[str, Any] = {"rests": len(data.readings)}
    figures |= {kind: {} for kind in ("residual_mg", "residual_by_imu_mg", "predicted", "true")}
    for name, (calibration, covariance) in cases.items():
        positions, rotations, residuals = _fit(data, calibration, np.arange(len(data.readings)))
        figures["residual_mg"][name] = float(np.sqrt(np.mean(residuals**2))) / MILLI_G
        figures["residual_by_imu_mg"][name] = (np.sqrt(np.mean(residuals**2, axis=(0, 2))) / MILLI_G).tolist()
        mechanism, tilt = data.mechanism.moved_joints(calibration.joints), calibration.tilt
        poses = zip(positions, rotations, strict=True)
        of_poses = np.mean([pose_covariance(mechanism, tilt, pose, covariance) for pose in poses], axis=0)
        figures["predicted"][name] = {
            "position_rms": float(np.sqrt(np.trace(of_poses[:3, :3]))),
            "rotation_rms": float(np.sqrt(np.trace(of_poses[3:, 3:]))),
        }
        figures["weakest"] = weakest_direction(of_poses, data.mechanism)
        figures["tilt"] = tilt.tolist()
        if np.isfinite(data.truth).all():
            true_rotations = rotations_from_quaternions(np.ascontiguousarray(data.truth[:, 3:]))
            figures["true"][name] = rms_figures(pose_errors(positions, rotations, data.truth[:, :3], true_rotations))
    return figures


def _fit(data: CalibrationData, calibration: Calibration, kept: NDArray[np.int64]) -> tuple[Array, Array, Array]:
    """Positions and rotations of some rests, and the residuals of their forces (n, 7, 3).

    The residuals are scaled for the six of twenty-one components that the pose takes up.
    """
    raw = np.zeros((len(kept), 3, IMU_COUNT, 3))
    raw[:, ACCELEROMETER] = data.readings[kept, :, 3:]
    forces = calibration.apply(raw)[:, ACCELEROMETER]
    geometry = data.geometry(calibration)
    poses = [fit_pose(geometry, each, data.mechanism.require_home()) for each in forces]
    residuals = [each - expected_forces(geometry, *pose) for each, pose in zip(forces, poses, strict=True)]
    positions, rotations = (np.array(each) for each in zip(*poses, strict=True))
    return positions, rotations, np.array(residuals) * np.sqrt(21.0 / 15.0)


def cross_validate(data: CalibrationData, calibration: Calibration, motion: Motion) -> dict[str, dict[str, float]]:
    """The accuracy as far as it shows without the truth; empty for too few rests.

    `left_out_mg` is the residual at rests that the calibration had not seen, in five parts. `position_rms` and `rotation_rms`
    are the differences of the poses by calibrations from disjoint halves of the data.

    Args:
        data: with the rests.
        calibration: from all data.
        motion: in which it was found.
    """
    everything = np.arange(len(data.readings))
    if len(everything) < 2 * LEAST_POSES:
        return {}
    left_out = []
    for fold in range(_FOLDS):
        part = data.at_rest(everything[everything % _FOLDS != fold])
        left_out.append(_fit(data, part.calibration(), everything[everything % _FOLDS == fold])[2])
    # The second half of the motion begins where the filter with the whole calibration was.
    middle = len(motion.samples) // 2
    parameters = filter_parameters(data.fusion, data.rate, "axes", calibration.covariance)
    first = calibration.apply(motion.samples[: middle + 1])
    used = motion.used()[: middle + 1]
    way = track(parameters, data.geometry(calibration), first, used, data.rate, data.fusion.sensor_delay, motion.start)
    there = Pose(way.positions[-1], way.rotations[-1]), way.motions[-1, [VELOCITY, RATE]].ravel()
    poses: dict[str, list[Array]] = {"rests": [], "motion": []}
    for first_rest, samples, begin in ((0, slice(middle), motion.start), (1, slice(middle, None), there)):
        half = data.at_rest(everything[first_rest::2])
        moved, _ = calibrate_in_motion(data.mechanism, half, motion.part(samples, begin), data.rate, data.fusion)
        poses["rests"] += _fit(data, half.calibration(), everything)[:2]
        poses["motion"] += _fit(data, moved, everything)[:2]
    figures = {name: rms_figures(pose_errors(*each)) for name, each in poses.items()}
    figures["rests"]["left_out_mg"] = float(np.sqrt(np.mean(np.concatenate(left_out) ** 2))) / MILLI_G
    return figures


def constants(calibration: Calibration, prior_sigmas: Array) -> dict[str, Any]:
    """Each IMU's constants with their standard deviations, and those that the data hardly told."""
    covariance, before = calibration.covariance, prior_sigmas.reshape(IMU_COUNT, -1, 3)
    sigmas = np.sqrt(np.diag(covariance)).reshape(IMU_COUNT, -1, 3) if covariance is not None else before
    values = np.empty((IMU_COUNT, len(ERROR_NAMES), 3))
    for imu in range(IMU_COUNT):
        gains, offsets = calibration.gain[:2, imu], calibration.offset[:2, imu]
        biases = [np.linalg.solve(gain, offset) for gain, offset in zip(gains, offsets, strict=True)]
        (gyroscope_scale, gyroscope_axes, _), (scale, axes, mounting) = (split_gain(gain) for gain in gains)
        values[imu] = [*biases, scale - 1.0, gyroscope_scale - 1.0, mounting, axes, gyroscope_axes]
    shares = sigmas / before
    untold = dict[str, list[int]]()
    for imu, kind, axis in np.argwhere(shares > UNTOLD).tolist():
        untold.setdefault(_constant(kind, axis), []).append(imu)
    imu, kind, axis = map(int, np.unravel_index(shares.argmax(), shares.shape))
    return {
        "constants": {
            name: {"values": values[:, i].tolist(), "sigmas": sigmas[:, i].tolist()} for i, name in enumerate(ERROR_NAMES)
        },
        "untold": untold,
        "least_told": {"name": _constant(kind, axis), "imu": imu, "share": float(shares.max())},
    }


def _constant(kind: int, axis: int) -> str:
    name = ERROR_NAMES[kind]
    return f"{name} {(('xy', 'xz', 'yz') if name.endswith('axes') else 'xyz')[axis]}"


def weak_words(summary: Mapping[str, Any]) -> Sequence[str]:
    """Sentences on what a calibration knows least, from its summary."""
    least = summary["least_told"]
    return [
        f"the pose is known least {summary['weakest']}",
        *(
            f"the data hardly told {name} of IMU {', '.join(map(str, imus))}: more than {UNTOLD:g} of its sigma before is left"
            for name, imus in summary["untold"].items()
        ),
        f"the constant known least is {least['name']} of IMU {least['imu']}: {least['share']:.2g} of its sigma before is left",
    ]


def weakest_direction(covariance: Array, mechanism: Mechanism) -> str:
    """The direction in which the pose is known least, in words; rotations count at the platform's joints."""
    arm = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    scale = np.repeat([1.0, arm], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    main = int(np.abs(vectors[:, -1]).argmax())
    words = ("along x", "along y", "along z", "about x", "about y", "about z")[main]
    return f"mostly {words}: {1e3 * float(np.sqrt(values[-1])):.2g} mm at the platform's joints"
