"""Calibration on the rig: it rests at wide poses and shakes, and its IMUs' errors come out of the redundancy.

The gyroscopes are zeroed while the brakes hold. Then the rig rests at a few poses near home, driven by raw data, for a first
calibration; with that at twenty wide ones; with that it shakes, for the rest. Every run is one of `hil.simulation`.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from controller.calibration import Calibration, save_calibration
from controller.mechanism_filter import JOINTS, TILT
from controller.readings import sensor_geometry
from controller.self_calibration import (
    CalibrationError,
    Found,
    Prior,
    Rests,
    calibrate_at_rest,
    calibrate_in_motion,
    expected_forces,
    fit_pose,
    pose_covariance,
)
from controller.settings import sensor_settings
from controller.target import REST_S
from hil.simulation import SimulationConfig, SimulationStoppedError, prepared_loop, simulate
from plant.compiled import Record
from plant.imu import MILLI_G, load_imu
from plant.mechanism import Mechanism, load_spatial
from plant.pose import Array, Pose, rotation_angle, rotations_from_quaternions
from plant.variables import IMU_COUNT

FIRST_POSES, WIDE_POSES, SHAKING_S = 8, 20, 40.0
_ZEROING_S = 1.0
_SETTLED_S = 0.5
"""What is left out at the beginning of a rest [s]."""

_SHORTEST_REST_S = 0.4
_MEAN_S = 0.1
_MOST_RATE = np.radians(0.5)
"""A mean over `_MEAN_S` that turns faster than this is no rest [rad/s]."""


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """What a calibration on the rig has found.

    Attributes:
        calibration: of the IMUs.
        at_rest: what was found from the rests alone.
        summary: the figures.
    """

    calibration: Calibration
    at_rest: Found
    summary: dict[str, Any]


def raw_samples(records: Record) -> Array:
    """Raw measurements (N, 3, 7, 3) of records."""
    return np.stack([records["angular_velocity"], records["specific_force"], records["magnetic_field"]], axis=1)


def find_rests(samples: Array, zero: Array, rate: float) -> list[slice]:
    """The stretches of raw samples (N, 3, 7, 3) in which no gyroscope, less its `zero` (7, 3) [rad/s], turns."""
    length = max(1, round(_MEAN_S * rate))
    count = len(samples) // length
    means = (samples[: count * length, 0] - zero).reshape(count, length, IMU_COUNT, 3).mean(axis=1)
    still = np.abs(means).max(axis=(1, 2)) < _MOST_RATE
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [slice(first * length, last * length) for first, last in edges.reshape(-1, 2)]


def is_long(rest: slice, rate: float) -> bool:
    """Whether enough of a rest is left without its beginning."""
    return int(rest.stop) - int(rest.start) >= (_SETTLED_S + _SHORTEST_REST_S) * rate


def rest_readings(samples: Array, rests: Sequence[slice], rate: float) -> Array:
    """Mean readings (n, 7, 6) of rests, without their beginnings."""
    means = [samples[rest.start + round(_SETTLED_S * rate) : rest.stop].mean(axis=0) for rest in rests]
    return np.array([np.concatenate([mean[0], mean[1]], axis=1) for mean in means]).reshape(-1, IMU_COUNT, 6)


def calibrate_rig(
    config: SimulationConfig,
    prior: Prior | None = None,
    home: bool = False,
    progress: Callable[[float], None] = lambda share: None,
) -> RigCalibration:
    """Drive the rig and calibrate its IMUs.

    Args:
        config: mechanism, IMUs, seed, rate and plant; its target and durations are the calibration's own.
        prior: what is known before.
        home: whether the rig's first pose is home exactly.
        progress: called with the share that is done.

    Raises:
        CalibrationError: the data have no explanation, or do not suffice.
        GoughError: something in the configuration cannot be used.
    """
    prior = prior or Prior()
    mechanism = load_spatial(config.mechanism)
    fusion = sensor_settings(mechanism, load_imu(config.imu))
    zero = _zero(replace(config, target="hold", duration=0.1, hold=_ZEROING_S))
    offset = np.zeros((3, IMU_COUNT, 3))
    offset[0] = -zero
    calibration = Calibration(offset=offset)
    data, done = _Data(mechanism, zero, config.rate), 0.0
    whole = (FIRST_POSES + WIDE_POSES) * REST_S + SHAKING_S
    for target, duration in (("near-rests", FIRST_POSES * REST_S), ("rests", WIDE_POSES * REST_S)):
        data.add_rests(_run(config, target, duration, calibration, _part(progress, done / whole, duration / whole)))
        done += duration
        found = calibrate_at_rest(mechanism, Rests(data.readings, home), prior)
        calibration = found.calibration()
    records = _run(config, "shaking", SHAKING_S, calibration, _part(progress, done / whole, SHAKING_S / whole))
    samples, start = data.motion(records, found)
    calibration, covariance = calibrate_in_motion(mechanism, found, samples, config.rate, start, fusion)
    summary = data.summary(found, calibration, covariance, prior)
    about = {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "version": version("gough"),
        "mechanism": mechanism.name,
        **{f"residual_{name}_mg": round(value, 4) for name, value in summary["residual_mg"].items()},
    }
    return RigCalibration(replace(calibration, about=about), found, summary)


def _part(progress: Callable[[float], None], start: float, size: float) -> Callable[[float], None]:
    return lambda share: progress(start + share * size)


def _zero(config: SimulationConfig) -> Array:
    """Mean rates (7, 3) while the brakes hold."""
    with prepared_loop(config) as loop:
        hold = int(loop.parameters["hold_cycles"])
        loop.run(hold)
        rates: Array = loop.records["angular_velocity"][:hold].mean(axis=0)
    return rates


def _run(
    config: SimulationConfig, target: str, duration: float, calibration: Calibration, progress: Callable[[float], None]
) -> Record:
    """The records of a run with a calibration."""
    with tempfile.TemporaryDirectory(prefix="gough-calibration-") as folder:
        file = Path(folder) / "calibration.toml"
        save_calibration(file, calibration)
        try:
            run = simulate(replace(config, target=target, duration=duration, calibration=str(file)), progress)
        except SimulationStoppedError as error:
            raise CalibrationError(f"the rig stopped at {target}: {error}: check which IMU sits where, and its signs") from None
    return run.records


class _Data:
    """What the rests have given so far."""

    def __init__(self, mechanism: Mechanism, zero: Array, rate: float) -> None:
        self._mechanism, self._zero, self._rate = mechanism, zero, rate
        self.readings = np.zeros((0, IMU_COUNT, 6))
        self._truth = np.zeros((0, 7))

    def add_rests(self, records: Record) -> None:
        """Take the rests out of records."""
        samples = raw_samples(records)
        rests = [each for each in find_rests(samples, self._zero, self._rate) if is_long(each, self._rate)]
        self.readings = np.concatenate([self.readings, rest_readings(samples, rests, self._rate)])
        truth = [records["truth"][rest.start + round(_SETTLED_S * self._rate) : rest.stop, :7].mean(axis=0) for rest in rests]
        self._truth = np.concatenate([self._truth, np.reshape(truth, (-1, 7))])

    def motion(self, records: Record, found: Found) -> tuple[Array, tuple[Pose, Array]]:
        """The samples of a motion from the end of the rest before it, with the pose and twist there."""
        samples = raw_samples(records)
        rests = find_rests(samples, self._zero, self._rate)
        if not rests or rests[0].start > 0:
            raise CalibrationError("the recording of the motion does not begin at rest: begin with half a second of it")
        last = max(rests[0].stop - round(_MEAN_S * self._rate), 1)
        first = max(last - round(_SETTLED_S * self._rate), 0)
        mean = found.calibration().apply(samples[first:last].mean(axis=0))
        geometry = sensor_geometry(self._mechanism.moved_joints(found.joints), found.tilt)
        pose = Pose(*fit_pose(geometry, mean[1], self._mechanism.require_home()))
        return samples[last:], (pose, np.zeros(6))

    def summary(self, found: Found, calibration: Calibration, covariance: Array, prior: Prior) -> dict[str, Any]:
        """The figures: residuals of the forces at rest, and how well poses at rest are known, as predicted and, where the truth
        is known, in fact; before, with the calibration from the rests, and with that from the motion, too.
        """
        unknown = np.concatenate([prior.error_sigmas(), np.full(JOINTS, prior.joints), np.full(TILT, prior.tilt)])
        cases = {
            "before": (Calibration(), np.diag(unknown**2)),
            "rests": (found.calibration(), found.covariance),
            "motion": (calibration, covariance),
        }
        figures: dict[str, Any] = {"rests": len(self.readings), "residual_mg": {}, "predicted": {}, "true": {}}
        for name, (each, left_over) in cases.items():
            mechanism = self._mechanism.moved_joints(each.joints)
            geometry = sensor_geometry(mechanism, each.tilt)
            poses = [fit_pose(geometry, forces, self._mechanism.require_home()) for forces in self._forces(each)]
            left = [forces - expected_forces(geometry, *pose) for forces, pose in zip(self._forces(each), poses, strict=True)]
            # Of twenty-one components six have gone into the pose.
            figures["residual_mg"][name] = float(np.sqrt(np.mean(np.square(left)) * 21.0 / 15.0)) / MILLI_G
            of_poses = np.array([pose_covariance(mechanism, each.tilt, pose, left_over) for pose in poses])
            figures["predicted"][name] = _rms_of(of_poses.mean(axis=0))
            if np.isfinite(self._truth).all():
                figures["true"][name] = self._true_errors(poses)
            figures["weakest"] = weakest_direction(of_poses.mean(axis=0), self._mechanism)
        figures["tilt"] = calibration.tilt.tolist()
        return figures

    def _forces(self, calibration: Calibration) -> Array:
        """Calibrated forces at rest (n, 7, 3)."""
        raw = np.zeros((len(self.readings), 3, IMU_COUNT, 3))
        raw[:, 0], raw[:, 1] = self.readings[:, :, :3], self.readings[:, :, 3:]
        forces: Array = calibration.apply(raw)[:, 1]
        return forces

    def _true_errors(self, poses: Sequence[tuple[Array, Array]]) -> dict[str, float]:
        true = rotations_from_quaternions(np.ascontiguousarray(self._truth[:, 3:]))
        distances = np.linalg.norm([pose[0] for pose in poses] - self._truth[:, :3], axis=1)
        angles = rotation_angle(np.array([pose[1] for pose in poses]), true)
        return {"position_rms": float(np.sqrt(np.mean(distances**2))), "rotation_rms": float(np.sqrt(np.mean(angles**2)))}


def _rms_of(covariance: Array) -> dict[str, float]:
    return {
        "position_rms": float(np.sqrt(np.trace(covariance[:3, :3]))),
        "rotation_rms": float(np.sqrt(np.trace(covariance[3:, 3:]))),
    }


def weakest_direction(covariance: Array, mechanism: Mechanism) -> str:
    """Along or about what the pose is known least, in plain words; rotations count at the platform's joints."""
    arm = float(np.linalg.norm(mechanism.platform_joints, axis=1).mean())
    scale = np.repeat([1.0, arm], 3)
    values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
    main = int(np.abs(vectors[:, -1]).argmax())
    words = ("along x", "along y", "along z", "about x", "about y", "about z")[main]
    return f"mostly {words}: {1e3 * float(np.sqrt(values[-1])):.2g} mm at the platform's joints"
