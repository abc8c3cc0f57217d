"""Evaluation of the whole-mechanism filter after a self-calibration from raw IMUs, beside leg filters and refined pose.

Every seed is a rig of its own. Its IMUs are calibrated on it (`hil.calibration.drive`). Then its platform moves as prescribed
(`plant.dynamics.imposed`), beyond what the actuators could follow. The estimator uses the joints that the calibration found.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import Prior
from controller.cycle import STATE, cycle_parameters
from controller.settings import control_settings, sensor_settings
from hil.calibration.data import Knowledge
from hil.calibration.drive import calibrate_rig
from hil.progress import Progress, part_of
from hil.runs.config import FUSIONS, SimulationConfig
from hil.runs.simulation import simulate
from hil.studies.config import LEARNING_S, EvaluationConfig
from hil.studies.fused_track import (
    LEGS_ALONE,
    REFINED,
    WHOLE,
    PoseErrors,
    PoseTrack,
    fuse,
    measure_all,
    pooled_rms,
    poses_of,
    read,
    track,
)
from plant.compiled import Record
from plant.dynamics.imposed import ImposedMotion, impose
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import imu_state, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array
from plant.wiring import ALL_IMUS

MOTIONS = ("static", "0.5", "1", "2", "mixed")

_MOTION_S = LEARNING_S + 10.0
_FAULT_S = 15.0
_START_S, _WATCHED_S = 1.5, 3.0
_START_HZ = (0.2, 2.0)
_STARTED_M, _STARTED_RAD = 1e-3, np.radians(0.2)
"""A start succeeds if the errors stay below these after `_START_S`."""

_CHUNK_S = 60.0
_FOLLOW_S, _FOLLOWING = 60.0, "whole"
_COST_S, _COST_REPEATS = 10.0, 7
_CALIBRATED_IMU = "mpu9150-calibrated"


@dataclass(frozen=True, eq=False)
class _Rig:
    """A calibrated rig: its mechanism as built, the cycle's constants by the calibration, and the calibration's figures."""

    config: EvaluationConfig
    seed: int
    built: Mechanism
    parameters: Record
    summary: dict[str, Any]

    def move(self, kind: str, duration: float, seed: int) -> tuple[ImposedMotion, Array]:
        """A motion of this rig, and the samples of its raw IMUs."""
        motion = impose(self.built, kind, duration, self.config.rate, seed)
        return motion, read(motion, load_imu(self.config.imu), self.config.rate, self.seed)


def evaluate(config: EvaluationConfig, progress: Callable[[str, float], None] = lambda what, share: None) -> dict[str, Any]:
    """Evaluate the fusion; `progress` is called with the name of a part and the share of it that is done.

    Returns:
        The figures in SI units by section (`SECTIONS` and `calibration`), and `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    figures: dict[str, Any] = {}
    load_spatial(config.mechanism).built(config.joint_error, 0)
    if set(config.only) - {"follow", "cost"}:
        rigs = _calibrated_rigs(config, 0.0, progress)
        figures["calibration"] = {"0": _of_calibrations(rigs)}
        if "motions" in config.only:
            figures["motions"] = {"0": _of_motions(rigs, partial(progress, "motions, exact joints"))}
            if config.joint_error > 0.0:
                others, name = _calibrated_rigs(config, config.joint_error, progress), f"{config.joint_error:g}"
                figures["calibration"][name] = _of_calibrations(others)
                figures["motions"][name] = _of_motions(others, partial(progress, "motions, joint errors"))
        for section, of in {"faults": _of_faults, "start": _of_starts, "drift": _of_drift}.items():
            if section in config.only:
                figures[section] = of(rigs, partial(progress, section))
    if "follow" in config.only:
        figures["follow"] = _of_following(config, partial(progress, "closed loop"))
    if "cost" in config.only:
        figures["cost"] = _of_cost(config, partial(progress, "cost"))
    return figures | {"config": asdict(config), "version": version("gough")}


def _calibrated_rigs(config: EvaluationConfig, joint_error: float, progress: Callable[[str, float], None]) -> list[_Rig]:
    report = partial(progress, "calibration" if joint_error == 0.0 else "calibration, joint errors")
    nominal, model, share = load_spatial(config.mechanism), load_imu(config.imu), 1.0 / len(config.seeds)
    rigs = []
    for i, seed in enumerate(config.seeds):
        rig = SimulationConfig(mechanism=config.mechanism, imu=config.imu, seed=seed, rate=config.rate, joint_error=joint_error)
        found = calibrate_rig(rig, Knowledge(Prior(joints=joint_error)), part_of(report, i * share, share), validate=False)
        known = nominal.moved_joints(found.calibration.joints)
        control, fusion, errors = control_settings(known), sensor_settings(known, model), FUSIONS[config.fusion]
        parameters = cycle_parameters(known, config.rate, control, fusion, ALL_IMUS, errors, found.calibration)
        rigs.append(_Rig(config, seed, nominal.built(joint_error, seed), parameters, found.summary))
    return rigs


def _of_calibrations(rigs: Sequence[_Rig]) -> dict[str, Any]:
    """RMS of the pose at rest before and after, predicted and true."""
    cases = {"before": ("true", "before"), "after": ("true", "motion"), "predicted": ("predicted", "motion")}
    figures = {name: pooled_rms([rig.summary[kind][stage] for rig in rigs]) for name, (kind, stage) in cases.items()}
    least = min(rig.summary["true"]["before"]["position_rms"] / rig.summary["true"]["motion"]["position_rms"] for rig in rigs)
    return figures | {"least_improvement": least}


def _figures(errors: PoseErrors) -> dict[str, Any]:
    return errors.figures() | errors.worst()


def _late(rate: float) -> slice:
    """The samples after the time to learn."""
    return slice(round(LEARNING_S * rate), None)


def _of_motions(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors of the refined pose and of the whole-mechanism filter, by motion."""
    figures: dict[str, Any] = {}
    for m, kind in enumerate(MOTIONS):
        pooled = {"refined": PoseErrors(), "whole": PoseErrors()}
        for i, rig in enumerate(rigs):
            motion, raw = rig.move(kind, _MOTION_S, rig.seed)
            fused, late = fuse(rig.parameters, raw), _late(rig.config.rate)
            for name, step in (("refined", REFINED), ("whole", WHOLE)):
                pooled[name].add(track(fused, step).at(late), poses_of(motion, late))
            progress((m + (i + 1) / len(rigs)) / len(MOTIONS))
        figures[kind] = {name: _figures(errors) for name, errors in pooled.items()}
    return figures


def _of_faults(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors of the whole-mechanism filter at 1 Hz: with all IMUs, without one leg's (another for each seed), and without the
    platform's; with their ratios to the first.
    """
    cases: dict[str, Callable[[_Rig], list[int]]] = {
        "none": lambda rig: [],
        "leg": lambda rig: [rig.seed % LEGS],
        "platform": lambda rig: [PLATFORM_IMU],
    }
    pooled = {name: PoseErrors() for name in cases}
    for i, rig in enumerate(rigs):
        motion, raw = rig.move("1", _MOTION_S, rig.seed)
        late = _late(rig.config.rate)
        for name, dead in cases.items():
            broken = raw.copy()
            broken[round(_FAULT_S * rig.config.rate) :, :, dead(rig)] = np.nan
            pooled[name].add(track(fuse(rig.parameters, broken), WHOLE).at(late), poses_of(motion, late))
        progress((i + 1) / len(rigs))
    figures: dict[str, Any] = {name: _figures(errors) for name, errors in pooled.items()}
    for name in ("leg", "platform"):
        for key in ("position_rms", "rotation_rms"):
            figures[name][f"{key}_ratio"] = figures[name][key] / figures["none"][key]
    return figures


def _of_starts(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """How many starts in the middle of a motion, at a random frequency, give the whole-mechanism filter's pose in time."""
    config, random = rigs[0].config, np.random.default_rng(0)
    due, succeeded, largest = round(_START_S * config.rate), 0, np.zeros(2)
    for n in range(config.starts):
        rig, frequency = rigs[n % len(rigs)], random.uniform(*_START_HZ)
        motion, raw = rig.move(f"{frequency:.3f}", _WATCHED_S, n)
        state = np.zeros((), STATE)
        fuse(rig.parameters, raw[:due], state)
        in_time = bool(state["mechanism"]["trusted"])
        after = track(fuse(rig.parameters, raw[due:], state), WHOLE)
        errors = after.errors(poses_of(motion, slice(due, None)))
        worst = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
        largest = np.maximum(largest, worst)
        succeeded += in_time and bool(state["mechanism"]["trusted"]) and bool((worst < (_STARTED_M, _STARTED_RAD)).all())
        progress((n + 1) / config.starts)
    position, rotation = largest.tolist()
    return {"starts": config.starts, "succeeded": succeeded, "position_max": position, "rotation_max": rotation}


def _of_drift(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors by minute while the platform stands still for long."""
    config = rigs[0].config
    chunks = int(np.ceil(config.still / _CHUNK_S))
    pooled = [PoseErrors() for _ in range(chunks)]
    for i, rig in enumerate(rigs):
        motion = impose(rig.built, "static", min(_CHUNK_S, config.still), config.rate, rig.seed)
        imu, raw = imu_state(load_imu(config.imu), rig.seed, 1.0 / config.rate), np.empty_like(motion.signals)
        state = np.zeros((), STATE)
        for chunk in range(chunks):
            measure_all(imu, motion.signals, raw)
            counted = slice(None) if chunk else _late(config.rate)
            pooled[chunk].add(track(fuse(rig.parameters, raw, state), WHOLE).at(counted), poses_of(motion, counted))
            progress((i + (chunk + 1) / chunks) / len(rigs))
    return {"minutes": [_figures(errors) for errors in pooled]}


def _of_following(config: EvaluationConfig, progress: Progress) -> dict[str, Any]:
    """Errors of the estimate with calibrated IMUs while the closed loop follows a target."""
    pooled = PoseErrors()
    for i, seed in enumerate(config.seeds):
        run = simulate(
            SimulationConfig(
                config.mechanism, config.target, _FOLLOW_S, config.rate, _CALIBRATED_IMU, seed=seed, fusion=_FOLLOWING
            )
        )
        late, records = run.times >= LEARNING_S, run.records
        covariances = records["covariance"].astype(float)
        estimated = PoseTrack(records["position"], records["rotation"], covariances=covariances)
        pooled.add(estimated.at(late), PoseTrack(run.true_positions, run.true_rotations).at(late))
        progress((i + 1) / len(config.seeds))
    return {"target": config.target, "fusion": _FOLLOWING, "imu": _CALIBRATED_IMU} | _figures(pooled)


def _of_cost(config: EvaluationConfig, progress: Progress) -> dict[str, Any]:
    """Microseconds that the leg filters and each whole-mechanism filter take in a cycle, mean and greatest.

    The least of several repetitions counts for each cycle: all beyond it comes from the machine.
    """
    mechanism, model = load_spatial(config.mechanism), load_imu(_CALIBRATED_IMU)
    motion = impose(mechanism, "1", _COST_S, config.rate, 0)
    raw, fusion = read(motion, model, config.rate, 0), sensor_settings(mechanism, model)
    names = [name for name, errors in FUSIONS.items() if errors is not None]
    figures: dict[str, Any] = {}
    for i, name in enumerate(names):
        parameters = cycle_parameters(mechanism, config.rate, control_settings(mechanism), fusion, ALL_IMUS, FUSIONS[name])
        runs = []
        for repeat in range(_COST_REPEATS):
            runs.append(fuse(parameters, raw)["ns"])
            progress((i + (repeat + 1) / _COST_REPEATS) / len(names))
        ns = np.min(runs, axis=0)[round(config.rate) :]
        figures[name] = _microseconds(ns[:, WHOLE] - ns[:, REFINED])
        figures["leg filters"] = _microseconds(ns[:, LEGS_ALONE])
    return figures


def _microseconds(ns: NDArray[np.int64]) -> dict[str, float]:
    return {"mean_us": float(ns.mean()) / 1e3, "max_us": float(ns.max()) / 1e3}
