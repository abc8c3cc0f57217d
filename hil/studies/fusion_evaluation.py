"""Evaluation of the whole-mechanism filter after a self-calibration from raw IMUs, beside the refined pose.

Every seed is a rig of its own, calibrated by `hil.calibration.procedure` and then moved by `plant.dynamics.imposed_motion`.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import Prior
from controller.cycle import STATE
from hil.calibration.data import Knowledge
from hil.calibration.procedure import calibrate_rig
from hil.progress import Progress, in_parts
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from hil.studies.config import LEARNING_S, WHOLE_FUSIONS, EvaluationConfig
from hil.studies.fused_track import (
    LEGS_ALONE,
    REFINED,
    WHOLE,
    PoseErrors,
    PoseTrack,
    constants,
    fuse,
    pooled_rms,
    poses_of,
    read,
    track,
)
from plant.compiled import Record
from plant.dynamics.imposed_motion import impose
from plant.dynamics.variables import PLATFORM_IMU
from plant.imu import imu_state, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array

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
    """A calibrated rig: its mechanism as built, the cycle's constants, and the calibration's figures."""

    config: EvaluationConfig
    seed: int
    built: Mechanism
    parameters: Record
    summary: dict[str, Any]

    def move(self, kind: str, duration: float, seed: int, learning: float = LEARNING_S) -> tuple[Array, PoseTrack, slice]:
        """The raw samples of a motion, the true poses after the time to learn [s], and the slice of these."""
        motion = impose(self.built, kind, duration, self.config.rate, seed)
        raw = read(motion, imu_state(load_imu(self.config.imu), self.seed, 1.0 / self.config.rate))
        late = slice(round(learning * self.config.rate), None)
        return raw, poses_of(motion, late), late


def evaluate(config: EvaluationConfig, progress: Callable[[str, float], None] = lambda what, share: None) -> dict[str, Any]:
    """Evaluate the fusion; `progress` is called with the name of a part and its share that is done.

    Returns:
        The figures in SI units by section (`SECTIONS` and `calibration`), and `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    figures: dict[str, Any] = {}
    load_spatial(config.mechanism).built(config.joint_error, 0)
    if set(config.only) - {"follow", "cost"}:
        rigs = _calibrated_rigs(config, 0.0, partial(progress, "calibration"))
        figures["calibration"] = {"0": _of_calibrations(rigs)}
        if "motions" in config.only:
            figures["motions"] = {"0": _of_motions(rigs, partial(progress, "motions, exact joints"))}
            if config.joint_error > 0.0:
                others = _calibrated_rigs(config, config.joint_error, partial(progress, "calibration, joint errors"))
                name = f"{config.joint_error:g}"
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


def _calibrated_rigs(config: EvaluationConfig, joint_error: float, progress: Progress) -> list[_Rig]:
    nominal = load_spatial(config.mechanism)
    rigs = []
    for seed, of_seed in in_parts(config.seeds, progress):
        rig = SimulationConfig(
            mechanism=config.mechanism,
            imu=config.imu,
            seed=seed,
            rate=config.rate,
            joint_error=joint_error,
        )
        found = calibrate_rig(rig, Knowledge(Prior(joints=joint_error)), of_seed, validate=False)
        known = nominal.moved_joints(found.calibration.joints)
        parameters = constants(known, config.imu, config.rate, config.fusion, found.calibration)
        rigs.append(_Rig(config, seed, nominal.built(joint_error, seed), parameters, found.summary))
    return rigs


def _of_calibrations(rigs: Sequence[_Rig]) -> dict[str, Any]:
    """RMS of the pose at rest before and after, predicted and true."""
    true, predicted = ([rig.summary[kind] for rig in rigs] for kind in ("true", "predicted"))
    return {
        "before": pooled_rms([each["before"] for each in true]),
        "after": pooled_rms([each["motion"] for each in true]),
        "predicted": pooled_rms([each["motion"] for each in predicted]),
        "least_improvement": min(each["before"]["position_rms"] / each["motion"]["position_rms"] for each in true),
    }


def _figures(errors: PoseErrors) -> dict[str, Any]:
    return errors.figures() | errors.worst()


def _of_motions(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors of the refined pose and of the whole-mechanism filter, by motion."""
    figures: dict[str, Any] = {}
    for kind, of_kind in in_parts(MOTIONS, progress):
        refined, whole = PoseErrors(), PoseErrors()
        for rig, _ in in_parts(rigs, of_kind):
            raw, truth, late = rig.move(kind, _MOTION_S, rig.seed)
            fused = fuse(rig.parameters, raw)[late]
            refined.add(track(fused, REFINED), truth)
            whole.add(track(fused, WHOLE), truth)
        figures[kind] = {"refined": _figures(refined), "whole": _figures(whole)}
    return figures


def _of_faults(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors at 1 Hz with all IMUs, without one leg's and without the platform's, and their ratios to the first."""
    pooled = defaultdict[str, PoseErrors](PoseErrors)
    for rig, _ in in_parts(rigs, progress):
        raw, truth, late = rig.move("1", _MOTION_S, rig.seed)
        for name, dead in {"none": [], "leg": [rig.seed % LEGS], "platform": [PLATFORM_IMU]}.items():
            broken = raw.copy()
            broken[round(_FAULT_S * rig.config.rate) :, :, dead] = np.nan
            pooled[name].add(track(fuse(rig.parameters, broken)[late], WHOLE), truth)
    figures: dict[str, Any] = {name: _figures(errors) for name, errors in pooled.items()}
    for name in ("leg", "platform"):
        for key in ("position_rms", "rotation_rms"):
            figures[name][f"{key}_ratio"] = figures[name][key] / figures["none"][key]
    return figures


def _of_starts(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """How many starts in the middle of a motion, at a random frequency, give the pose in time."""
    config, random = rigs[0].config, np.random.default_rng(0)
    succeeded, largest = 0, np.zeros(2)
    for n, _ in in_parts(range(config.starts), progress):
        rig, frequency = rigs[n % len(rigs)], random.uniform(*_START_HZ)
        raw, truth, late = rig.move(f"{frequency:.3f}", _WATCHED_S, n, learning=_START_S)
        state = np.zeros((), STATE)
        fuse(rig.parameters, raw[: late.start], state)
        in_time = bool(state["mechanism"]["trusted"])
        errors = track(fuse(rig.parameters, raw[late], state), WHOLE).errors(truth)
        worst = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
        largest = np.maximum(largest, worst)
        small = bool((worst < (_STARTED_M, _STARTED_RAD)).all())
        succeeded += in_time and small and bool(state["mechanism"]["trusted"])
    position, rotation = largest.tolist()
    return {"starts": config.starts, "succeeded": succeeded, "position_max": position, "rotation_max": rotation}


def _of_drift(rigs: Sequence[_Rig], progress: Progress) -> dict[str, Any]:
    """Errors by minute while the platform stands still for long."""
    config = rigs[0].config
    pooled = [PoseErrors() for _ in range(int(np.ceil(config.still / _CHUNK_S)))]
    for rig, of_rig in in_parts(rigs, progress):
        motion = impose(rig.built, "static", min(_CHUNK_S, config.still), config.rate, rig.seed)
        imu, state = imu_state(load_imu(config.imu), rig.seed, 1.0 / config.rate), np.zeros((), STATE)
        counted = slice(round(LEARNING_S * config.rate), None)
        for errors, _ in in_parts(pooled, of_rig):
            fused = fuse(rig.parameters, read(motion, imu), state)
            errors.add(track(fused[counted], WHOLE), poses_of(motion, counted))
            counted = slice(None)
    return {"minutes": [_figures(errors) for errors in pooled]}


def _of_following(config: EvaluationConfig, progress: Progress) -> dict[str, Any]:
    """Errors of the estimate with calibrated IMUs while the closed loop follows a target."""
    pooled = PoseErrors()
    for seed, _ in in_parts(config.seeds, progress):
        run = simulate(
            SimulationConfig(
                config.mechanism, config.target, _FOLLOW_S, config.rate, _CALIBRATED_IMU, seed=seed, fusion=_FOLLOWING
            )
        )
        late = run.times >= LEARNING_S
        records, truth = run.records[late], PoseTrack(run.true_positions[late], run.true_rotations[late])
        covariances = records["covariance"].astype(float)
        pooled.add(PoseTrack(records["position"], records["rotation"], covariances=covariances), truth)
    return {"target": config.target, "fusion": _FOLLOWING, "imu": _CALIBRATED_IMU} | _figures(pooled)


def _of_cost(config: EvaluationConfig, progress: Progress) -> dict[str, Any]:
    """Microseconds of a cycle, of leg filters and whole-mechanism filters: the least of several repetitions counts."""
    mechanism = load_spatial(config.mechanism)
    motion = impose(mechanism, "1", _COST_S, config.rate, 0)
    raw = read(motion, imu_state(load_imu(_CALIBRATED_IMU), 0, 1.0 / config.rate))
    figures: dict[str, Any] = {}
    for name, of_name in in_parts(WHOLE_FUSIONS, progress):
        parameters = constants(mechanism, _CALIBRATED_IMU, config.rate, name)
        runs = [fuse(parameters, raw)["ns"] for _ in in_parts(range(_COST_REPEATS), of_name)]
        ns = np.min(runs, axis=0)[round(config.rate) :]
        figures[name] = _microseconds(ns[:, WHOLE] - ns[:, REFINED])
        figures["leg filters"] = _microseconds(ns[:, LEGS_ALONE])
    return figures


def _microseconds(ns: NDArray[np.int64]) -> dict[str, float]:
    return {"mean_us": float(ns.mean()) / 1e3, "max_us": float(ns.max()) / 1e3}
