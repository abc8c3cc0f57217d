"""How well any estimate can know the pose with a set of sensors: the Bayesian Cramér-Rao bound, beside the loop's errors.

The bound is the covariance of the pose given all data until a time. A Kalman recursion of the covariance computes it; no data
are needed, as the model is linear along the true motion. No estimate that is linear in the data has a smaller mean square
error, whatever the distribution of the errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from operator import methodcaller
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from controller.calibration.file import Calibration, calibration_for
from controller.imu_set import imus_of
from controller.planning.target import load_target
from controller.settings import control_settings
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from hil.studies.detectability.kinematics import POSE, Motion, base_motion_along, motion_along
from hil.studies.pose_bound.model import STEP_S, LinearModel, Setup
from hil.table import Table
from plant.compiled import Record
from plant.dynamics.base_course import placed
from plant.encoders import load_encoder
from plant.errors import InputError
from plant.imu import load_imu
from plant.imu_disturbances import BASE_PREFIX
from plant.imu_wiring import BASE_IMU, PLATFORM_IMU
from plant.mechanism import load_in_space
from plant.pose import Array, pose_errors

_PART = 200
"""So many steps are linearised at a time."""

UNKNOWN = 0.03, np.radians(5.0)
"""Beyond these standard deviations a pose counts as not known [m, rad]."""


@dataclass(frozen=True, eq=False)
class PoseBound:
    """The least standard deviations of a pose over N times of a motion.

    Attributes:
        times: (N,) [s], from the begin of the motion; before 0 the brakes hold.
        position, rotation: (N,) [m] and [rad], roots of the traces of the covariances.
    """

    times: Array
    position: Array
    rotation: Array

    def at(self, time: float) -> tuple[float, float]:
        """Position [m] and rotation [rad] at a time [s]."""
        n = int(np.argmin(np.abs(self.times - time)))
        return float(self.position[n]), float(self.rotation[n])

    def over_the_motion(self, begin: float = 0.0) -> tuple[float, float]:
        """The roots of the mean squares from a time of the motion on [m, rad]."""
        return _rms(self.position[self.times > begin]), _rms(self.rotation[self.times > begin])


def find_bound(config: SimulationConfig) -> PoseBound:
    """The bound of a configuration's mechanism, IMUs, magnetometer, encoders, target, duration, calibration and base's motion.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    mechanism = load_in_space(config.mechanism)
    calibration = Calibration() if config.calibration is None else calibration_for(config.calibration, mechanism, config.imu)
    mechanism = mechanism.moved_joints(calibration.joints[:, : mechanism.legs])
    if config.magnetometer and (PLATFORM_IMU not in config.imus or mechanism.planar):
        raise InputError("the magnetometer is part of the platform's IMU of a mechanism in space: add IMU 6, or leave it out")
    _check_base(config, calibration)
    imus = imus_of(mechanism, config.imus)
    setup = Setup(
        mechanism,
        (*imus, BASE_IMU) if config.base_imu else imus,
        load_imu(config.imu),
        rate=config.rate,
        magnetometer=config.magnetometer,
        encoder=load_encoder(config.lengths),
        calibration=calibration,
        joint_error=config.joint_error,
    )
    if not imus and setup.encoder is None:
        raise InputError("there is no sensor: name IMUs with --imus, or encoders with --lengths")
    hold = config.hold_of(control_settings(mechanism))
    return bound_of(setup, config.target, config.duration, hold, config.base_motions)


def _check_base(config: SimulationConfig, calibration: Calibration) -> None:
    """Refuse what the bound has no model of."""
    others = [text for text in config.faults if not text.startswith(BASE_PREFIX)]
    if others:
        raise InputError(f"the bound is that of sensors in order, and {others[0]!r} is a fault of some: leave it out")
    if config.base_motions and not config.base_imu:
        raise InputError("the base moves, and a loop without an IMU on it takes it to rest: add --base-imu")
    if config.base_imu and config.magnetometer:
        raise InputError(
            "the field of the earth turns in the frame of a base that moves: leave out --magnetometer or --base-imu"
        )
    if config.base_imu and calibration.covariance is not None:
        raise InputError(
            f"{config.calibration} does not say how well the IMU on the base is known: leave out --calibration or --base-imu"
        )


def bound_of(
    setup: Setup, target: str = "hold", duration: float = 1.0, hold: float = 0.0, base_motions: Sequence[Record] = ()
) -> PoseBound:
    """The bound of a setup along a target of so many seconds, before which the platform stands for `hold` [s].

    `base_motions` have the dtype `plant.dynamics.base_course.BASE_MOTION`, with times that count from the begin of the target.

    Raises:
        GoughError: the target cannot be used.
    """
    times = STEP_S * (np.arange(max(1, round((hold + duration) / STEP_S))) + 0.5) - hold
    motion = motion_along(load_target(target, setup.mechanism, duration), setup.mechanism, times)
    if setup.base_moves:
        moved = [placed(each, hold) for each in base_motions]
        motion = replace(motion, base=base_motion_along(moved, setup.mechanism, times + hold))
    covariances = pose_covariances(LinearModel(setup), motion)
    variances = np.diagonal(covariances, axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2) + setup.calibration.floor**2
    return PoseBound(times + 0.5 * STEP_S, *np.sqrt(variances).T)


def pose_covariances(model: LinearModel, motion: Motion) -> Array:
    """The covariances (N, 6, 6) of the pose, given all data until each of the N steps of a motion."""
    found, covariance = np.empty((len(motion.position), POSE, POSE)), model.prior
    for first in range(0, len(found), _PART):
        part = motion.part(slice(first, first + _PART))
        for n, (seen, kept) in enumerate(zip(model.seen(part), model.kept(part), strict=True), start=first):
            across = seen @ covariance
            root = np.linalg.cholesky(across @ seen.T + np.diag(model.noise))
            gain = solve_triangular(root, across, lower=True)
            covariance = covariance - gain.T @ gain
            found[n] = covariance[:POSE, :POSE]
            covariance = model.carried(covariance, kept)
    return found


@dataclass(frozen=True, eq=False)
class Measured:
    """The closed loop's errors over seeds, beside the bound.

    Attributes:
        position, rotation: (seeds, N), errors at the bound's times from the begin of the motion on [m], [rad]; NaN where a run
            has ended early.
        stopped: the reasons why runs ended early, a line each.
    """

    times: Array
    position: Array
    rotation: Array
    stopped: tuple[str, ...]

    def at(self, time: float) -> tuple[float, float]:
        """RMS over the seeds at a time [s]: position [m] and rotation [rad]."""
        n = int(np.argmin(np.abs(self.times - time)))
        return _rms(self.position[:, n]), _rms(self.rotation[:, n])

    def over_the_motion(self, begin: float = 0.0) -> tuple[float, float]:
        """RMS over seeds and motion, from a time of it on [m, rad]."""
        return _rms(self.position[:, self.times > begin]), _rms(self.rotation[:, self.times > begin])


def measure(
    config: SimulationConfig, seeds: int, engine: Engine = IN_ONE_PROCESS, progress: Progress = no_progress
) -> Measured:
    """Run the closed loop with so many seeds, from 0 on.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    if seeds < 1:
        raise InputError(f"there are {seeds} seeds; at least 1 is needed")
    if config.calibration is not None:
        raise InputError("a calibration is of one machine, and every seed is another: leave --calibration or --measured out")
    runs = engine.map(_errors, [replace(config, seed=seed) for seed in range(seeds)], progress)
    times = STEP_S * np.arange(1, round(config.duration / STEP_S) + 1)
    errors = np.stack([each for each, _ in runs])
    return Measured(times, errors[:, 0], errors[:, 1], tuple(reason for _, reason in runs if reason))


def _errors(config: SimulationConfig) -> tuple[Array, str]:
    """The errors (2, N) of position [m] and rotation [rad] after every step of the motion, and why it ended early."""
    reason, count = "", round(config.duration / STEP_S)
    try:
        result = simulate(config)
    except SimulationStoppedError as stopped:
        result, reason = stopped.result, str(stopped)
    found = np.full((2, count), np.nan)
    wanted = np.searchsorted(result.times, STEP_S * np.arange(1, count + 1) - 1.5 / config.rate)
    there = wanted < len(result.times) - bool(reason)
    rows = wanted[there]
    errors = pose_errors(
        result.records["position"][rows], result.records["rotation"][rows], result.true_positions[rows],
        result.true_rotations[rows],
    )  # fmt: skip
    found[:, there] = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).T
    return found, reason


def _rms(errors: Array) -> float:
    known = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def check_since(config: SimulationConfig, since: float | None) -> None:
    """Check a time of the motion from which errors are to count [s].

    Raises:
        InputError: it is not within the motion.
    """
    if since is not None and not 0.0 <= since <= config.duration - STEP_S:
        raise InputError(
            f"--since {since:g} is not within the motion of {config.duration:g} s: choose less, or a longer --duration"
        )


def ratios(bound: PoseBound, measured: Measured, since: float | None = None) -> dict[str, float]:
    """The measured errors over the bound: position and rotation, at the end, over the motion, and from a time of it on [s]."""
    end = float(bound.times[-1])
    pairs = {"end": (measured.at(end), bound.at(end)), "motion": (measured.over_the_motion(), bound.over_the_motion())}
    if since is not None:
        pairs["since"] = measured.over_the_motion(since), bound.over_the_motion(since)
    return {
        f"{name}_{when}": found / least
        for when, each in pairs.items()
        for name, found, least in zip(("position", "rotation"), *each, strict=True)
    }


def summary(
    config: SimulationConfig, bound: PoseBound, measured: Measured | None, since: float | None = None
) -> dict[str, Any]:  # fmt: skip
    """Everything, for JSON, in SI units."""
    found: dict[str, Any] = {"config": asdict(config), "version": version("gough"), "bound": vars(bound), "since": since}
    if measured is not None:
        position, rotation = measured.over_the_motion()
        found["measured"] = {
            "seeds": len(measured.position),
            "position_end": measured.position[:, -1],
            "rotation_end": measured.rotation[:, -1],
            "position_rms": position,
            "rotation_rms": rotation,
            "stopped": measured.stopped,
            "over_bound": ratios(bound, measured, since),
        }
    return found


def text(errors: tuple[float, float]) -> str:
    """Errors of position and rotation in mm and deg; a dash if they say that the pose is not known."""
    position, rotation = errors
    if position > UNKNOWN[0] or rotation > UNKNOWN[1]:
        return "-"
    return f"{1e3 * position:.3f} / {np.degrees(rotation):.3f}"


def table(
    bound: PoseBound,
    measured: Measured | None = None,
    since: float | None = None,
    moments: Sequence[float] = (0.1, 1.0, 10.0),
) -> Table:
    """The bound at some moments, at the end, over the motion, and from a time of it on [s], in mm and deg; beside it what was
    measured, and the ratio.
    """
    made = Table("standard deviation [mm / deg]", "bound", *(["measured", "over the bound"] if measured else []))
    end = float(bound.times[-1])
    rows: dict[str, Callable[[PoseBound | Measured], tuple[float, float]]] = {
        f"after {moment:g} s": methodcaller("at", moment) for moment in moments if moment < end - STEP_S
    }
    rows |= {f"at the end, {end:g} s": methodcaller("at", end), "over the motion": methodcaller("over_the_motion")}
    if since is not None:
        rows[f"from {since:g} s on"] = methodcaller("over_the_motion", since)
    for name, errors in rows.items():
        cells = [name, text(least := errors(bound))]
        if measured is not None:
            found = errors(measured)
            cells += [text(found), " / ".join(f"{each / bounded:.2f}" for each, bounded in zip(found, least, strict=True))]
        made.add(*cells)
    return made
