"""Evaluation of the whole-mechanism filter after a self-calibration from raw IMUs, beside the refined pose.

Every seed is a rig of its own, calibrated by `hil.calibration.procedure` and then moved by `plant.dynamics.imposed_motion`.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import Prior
from controller.cycle import STATE
from hil.calibration.data import Knowledge
from hil.calibration.procedure import calibrate_rig
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress
from hil.runs.config import SimulationConfig
from hil.runs.names import name_of
from hil.runs.simulation import simulate
from hil.studies.config import LEARNING_S, WHOLE_FUSIONS, EvaluationConfig
from hil.studies.fused_track import LEGS_ALONE, REFINED, RMS, WHOLE, PoseTrack, constants, fuse, imposed, pooled, read, track
from hil.studies.pose_bound.bound import find_bound
from plant.compiled import Record
from plant.dynamics.imposed_motion import impose
from plant.dynamics.variables import PLATFORM_IMU
from plant.encoders import load_encoder
from plant.imu import imu_state, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array, rms_figures

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
_FOUND_S = 5.0
"""After this time the zeros of incremental encoders are found, and errors count [s]."""
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
        late = slice(round(learning * self.config.rate), None)
        return *imposed(self.built, kind, duration, self.config.rate, seed, self.config.imu, late, self.seed), late


def evaluate(
    config: EvaluationConfig,
    engine: Engine = IN_ONE_PROCESS,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> dict[str, Any]:
    """Evaluate the fusion; `progress` is called with the name of a part and its share that is done.

    The engine does all but `cost`, which is measured first, in this process.

    Returns:
        The figures in SI units by section (`SECTIONS` and `calibration`), and `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    figures: dict[str, Any] = {}
    load_imu(config.imu)
    load_encoder(config.lengths)
    load_spatial(config.mechanism).built(config.joint_error, 0)
    # Before the engine has work, and so before it has other processes.
    cost = {"cost": _of_cost(config, partial(progress, "cost"))} if "cost" in config.only else {}
    if set(config.only) - {"follow", "cost", "encoders"}:
        rigs, moved = {}, {}
        for error in dict.fromkeys((0.0, config.joint_error) if "motions" in config.only else (0.0,)):
            name, joints = f"{error:g}", _joints(error)
            calibrated = partial(_calibrated, config, error)
            rigs[name] = engine.map(calibrated, config.seeds, partial(progress, f"calibration, {joints}"))
            if "motions" in config.only:
                moved[name] = _of_motions(rigs[name], engine, partial(progress, f"motions, {joints}"))
        figures["calibration"] = {name: _of_calibrations(each) for name, each in rigs.items()}
        figures |= {"motions": moved} if moved else {}
        for section, of in {"faults": _of_faults, "start": _of_starts, "drift": _of_drift}.items():
            if section in config.only:
                figures[section] = of(rigs["0"], engine, partial(progress, section))
    if "follow" in config.only:
        followed = engine.map(partial(_followed, config), config.seeds, partial(progress, "closed loop"))
        about = {"target": config.target, "fusion": _FOLLOWING, "imu": _CALIBRATED_IMU}
        figures["follow"] = about | pooled(followed, worst=True)
    if "encoders" in config.only:
        figures["encoders"] = {"kind": config.lengths, "target": config.target, "fusion": config.fusion, "joints": {}}
        for error in dict.fromkeys((0.0, config.joint_error)):
            runs = engine.map(
                partial(_with_encoders, config, error), config.seeds, partial(progress, f"encoders, {_joints(error)}")
            )
            figures["encoders"]["joints"][f"{error:g}"] = _of_encoders(runs)
    return figures | cost | {"config": asdict(config), "version": version("gough")}


def _joints(error: float) -> str:
    return f"joints {1e3 * error:g} mm off"


def _calibrated(config: EvaluationConfig, joint_error: float, seed: int) -> _Rig:
    nominal = load_spatial(config.mechanism)
    rig = SimulationConfig(config.mechanism, imu=config.imu, seed=seed, rate=config.rate, joint_error=joint_error)
    found = calibrate_rig(rig, Knowledge(Prior(joints=joint_error)), validate=False)
    known = nominal.moved_joints(found.calibration.joints)
    parameters = constants(known, config.imu, config.rate, config.fusion, found.calibration)
    return _Rig(config, seed, nominal.built(joint_error, seed), parameters, found.summary)


def _of_calibrations(rigs: Sequence[_Rig]) -> dict[str, Any]:
    """RMS of the pose at rest before and after, predicted and true."""
    true, predicted = ([rig.summary[kind] for rig in rigs] for kind in ("true", "predicted"))
    return {
        "before": pooled([each["before"] for each in true]),
        "after": pooled([each["motion"] for each in true]),
        "predicted": pooled([each["motion"] for each in predicted]),
        "least_improvement": min(each["before"]["position_rms"] / each["motion"]["position_rms"] for each in true),
    }


def _by_name(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of several rigs, pooled by their names."""
    return {name: pooled([each[name] for each in found], worst=True) for name in found[0]}


def _of_motions(rigs: Sequence[_Rig], engine: Engine, progress: Progress) -> dict[str, Any]:
    """Errors of the refined pose and of the whole-mechanism filter, by motion."""
    moved = engine.starmap(_moved, list(product(MOTIONS, rigs)), progress)
    return {kind: _by_name(moved[i * len(rigs) :][: len(rigs)]) for i, kind in enumerate(MOTIONS)}


def _moved(kind: str, rig: _Rig) -> dict[str, Any]:
    raw, truth, late = rig.move(kind, _MOTION_S, rig.seed)
    fused = fuse(rig.parameters, raw)[late]
    return {name: track(fused, step).figures(truth) for name, step in {"refined": REFINED, "whole": WHOLE}.items()}


def _of_faults(rigs: Sequence[_Rig], engine: Engine, progress: Progress) -> dict[str, Any]:
    """Errors at 1 Hz with all IMUs, without one leg's and without the platform's, and their ratios to the first."""
    figures = _by_name(engine.map(_faulty, rigs, progress))
    for name in ("leg", "platform"):
        for key in ("position_rms", "rotation_rms"):
            figures[name][f"{key}_ratio"] = figures[name][key] / figures["none"][key]
    return figures


def _faulty(rig: _Rig) -> dict[str, Any]:
    raw, truth, late = rig.move("1", _MOTION_S, rig.seed)
    figures = {}
    for name, dead in {"none": [], "leg": [rig.seed % LEGS], "platform": [PLATFORM_IMU]}.items():
        broken = raw.copy()
        broken[round(_FAULT_S * rig.config.rate) :, :, dead] = np.nan
        figures[name] = track(fuse(rig.parameters, broken)[late], WHOLE).figures(truth)
    return figures


def _of_starts(rigs: Sequence[_Rig], engine: Engine, progress: Progress) -> dict[str, Any]:
    """How many starts in the middle of a motion, at a random frequency, give the pose in time."""
    starts = rigs[0].config.starts
    frequencies = np.random.default_rng(0).uniform(*_START_HZ, starts)
    items = [(rigs[n % len(rigs)], n, f"{frequency:.3f}") for n, frequency in enumerate(frequencies)]
    succeeded, worst = zip(*engine.starmap(_started, items, progress), strict=True)
    position, rotation = np.max(worst, axis=0).tolist()
    return {"starts": starts, "succeeded": sum(succeeded), "position_max": position, "rotation_max": rotation}


def _started(rig: _Rig, seed: int, frequency: str) -> tuple[bool, Array]:
    """Whether a start has given the pose in time, and the largest errors from then on [m, rad]."""
    raw, truth, late = rig.move(frequency, _WATCHED_S, seed, learning=_START_S)
    state = np.zeros((), STATE)
    fuse(rig.parameters, raw[: late.start], state)
    in_time = bool(state["mechanism"]["trusted"])
    errors = track(fuse(rig.parameters, raw[late], state), WHOLE).errors(truth)
    worst = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
    small = bool((worst < (_STARTED_M, _STARTED_RAD)).all())
    return in_time and small and bool(state["mechanism"]["trusted"]), worst


def _of_drift(rigs: Sequence[_Rig], engine: Engine, progress: Progress) -> dict[str, Any]:
    """Errors by minute while the platform stands still for long."""
    return {"minutes": [pooled(minute, worst=True) for minute in zip(*engine.map(_still, rigs, progress), strict=True)]}


def _still(rig: _Rig) -> list[dict[str, Any]]:
    config = rig.config
    motion = impose(rig.built, "static", min(_CHUNK_S, config.still), config.rate, rig.seed)
    imu, state = imu_state(load_imu(config.imu), rig.seed, 1.0 / config.rate), np.zeros((), STATE)
    figures = []
    for minute in range(int(np.ceil(config.still / _CHUNK_S))):
        late = slice(0 if minute else round(LEARNING_S * config.rate), None)
        raw, truth = read(motion, imu, late)
        figures.append(track(fuse(rig.parameters, raw, state)[late], WHOLE).figures(truth))
    return figures


def _followed(config: EvaluationConfig, seed: int) -> dict[str, Any]:
    """Errors of the estimate with calibrated IMUs while the closed loop follows a target."""
    run = simulate(SimulationConfig(config.mechanism, config.target, _FOLLOW_S, config.rate, _CALIBRATED_IMU, seed, _FOLLOWING))
    late = run.times >= LEARNING_S
    records, truth = run.records[late], PoseTrack(run.true_positions[late], run.true_rotations[late])
    estimates = PoseTrack(records["position"], records["rotation"], covariances=records["covariance"].astype(float))
    return estimates.figures(truth)


def _with_encoders(config: EvaluationConfig, joint_error: float, seed: int) -> dict[str, Any]:
    """Errors in the closed loop of a rig that was calibrated with its encoders: `absolute`, and `relative` without
    their mean; the `bound` of the absolute ones.
    """
    rig = SimulationConfig(
        config.mechanism, rate=config.rate, imu=config.imu, seed=seed, joint_error=joint_error, lengths=config.lengths
    )
    knowledge = Knowledge(Prior(joints=joint_error), encoder=load_encoder(config.lengths))
    calibration = name_of("calibration", calibrate_rig(rig, knowledge, validate=False).calibration)
    rig = replace(rig, target=config.target, duration=_FOLLOW_S, fusion=config.fusion, calibration=calibration)
    run, bound = simulate(rig), find_bound(rig)
    late = run.times >= _FOUND_S
    records, truth = run.records[late], PoseTrack(run.true_positions[late], run.true_rotations[late])
    estimates = PoseTrack(records["position"], records["rotation"], covariances=records["covariance"].astype(float))
    errors = estimates.errors(truth)
    return {
        "absolute": estimates.figures(truth),
        "relative": rms_figures(errors - errors.mean(axis=0)),
        "bound": dict(zip(RMS, bound.over_the_motion(_FOUND_S), strict=True)),
    }


def _of_encoders(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all rigs, and how many times the bound the absolute errors are."""
    found: dict[str, Any] = _by_name(runs)
    return found | {"over_bound": {key: found["absolute"][key] / found["bound"][key] for key in RMS}}


def _of_cost(config: EvaluationConfig, progress: Progress) -> dict[str, Any]:
    """Microseconds of a cycle, of leg filters and whole-mechanism filters: the least of several repetitions counts."""
    mechanism = load_spatial(config.mechanism)
    raw, _ = imposed(mechanism, "1", _COST_S, config.rate, 0, _CALIBRATED_IMU, slice(None))
    figures: dict[str, Any] = {}
    for done, name in enumerate(WHOLE_FUSIONS, start=1):
        parameters = constants(mechanism, _CALIBRATED_IMU, config.rate, name)
        ns = np.min([fuse(parameters, raw)["ns"] for _ in range(_COST_REPEATS)], axis=0)[round(config.rate) :]
        figures[name] = _microseconds(ns[:, WHOLE] - ns[:, REFINED])
        figures["leg filters"] = _microseconds(ns[:, LEGS_ALONE])
        progress(done / len(WHOLE_FUSIONS))
    return figures


def _microseconds(ns: NDArray[np.int64]) -> dict[str, float]:
    return {"mean_us": float(ns.mean()) / 1e3, "max_us": float(ns.max()) / 1e3}
