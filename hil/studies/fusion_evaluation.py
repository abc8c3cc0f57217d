"""What the whole-mechanism filter is worth after a self-calibration from raw IMUs, beside leg filters and refined pose.

Every seed is a rig of its own: its IMUs are calibrated on it (`hil.calibration.rig_calibration`), and then its platform is
moved as prescribed (`plant.dynamics.imposed`), beyond what the actuators could follow. The estimator knows the joints as the
calibration has found them.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.calibration.at_rest import Prior
from controller.calibration.file import Calibration
from controller.cycle import ALL_IMUS, STATE, check_rate, cycle_parameters
from controller.settings import control_settings, sensor_settings
from hil.calibration.rig_calibration import Knowledge, calibrate_rig
from hil.runs.simulation import FUSIONS, SimulationConfig, simulate
from hil.studies.fusion_comparison import LEARNING_S, LEGS_ALONE, REFINED, WHOLE, Found, fuse, measure_all, pose_errors, read
from plant.compiled import Record
from plant.dynamics.imposed import ImposedMotion, impose
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import InputError, UnknownNameError
from plant.imu import imu_state, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array, vector_from_rotation

MOTIONS = ("static", "0.5", "1", "2", "mixed")
SECTIONS = ("motions", "faults", "start", "drift", "follow", "cost")

_MOTION_S = LEARNING_S + 10.0
_FAULT_S = 15.0
_START_S, _WATCHED_S = 1.5, 3.0
_START_HZ = (0.2, 2.0)
_STARTED_M, _STARTED_RAD = 1e-3, np.radians(0.2)
"""A start has succeeded if the errors stay below these from then on."""

_CHUNK_S = 60.0
_FOLLOW_S, _FOLLOWING = 60.0, "whole"
_COST_S, _COST_REPEATS = 10.0, 7
_CALIBRATED_IMU = "mpu9150-calibrated"


@dataclass(frozen=True)
class EvaluationConfig:
    """What to evaluate.

    Attributes:
        mechanism: preset or TOML file.
        imu: preset of the raw IMUs' imperfections.
        fusion: a key of `FUSIONS` with a whole-mechanism filter.
        rate: samples per second [Hz].
        joint_error: standard deviation of each coordinate of the joints [m], in half of the motions; in the others it is 0.
        seeds: one for each rig.
        starts: number of starts in motion.
        still: of the platform that stands still [s].
        target: motion or CSV file that calibrated IMUs follow in the closed loop.
        only: sections, of `SECTIONS`.
    """

    mechanism: str = "hexapod"
    imu: str = "mpu9150"
    fusion: str = "whole-alignments"
    rate: float = 1000.0
    joint_error: float = 1e-4
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)
    starts: int = 100
    still: float = 600.0
    target: str = "sines"
    only: tuple[str, ...] = SECTIONS

    def __post_init__(self) -> None:
        check_rate(self.rate)
        if FUSIONS.get(self.fusion) is None:
            names = ", ".join(name for name, errors in FUSIONS.items() if errors is not None)
            raise UnknownNameError(f"no fusion of the whole mechanism {self.fusion!r}; there are {names}")
        if not self.seeds:
            raise InputError("there must be a seed at least")
        if not 0.0 <= self.joint_error < np.inf:
            raise InputError(f"the joint error is {1e3 * self.joint_error:g} mm; it must be at least 0 and finite")
        if not 1 <= self.starts <= 10000:
            raise InputError(f"{self.starts} starts are asked for; there can be 1 to 10000")
        if not LEARNING_S < self.still <= 3600.0:
            raise InputError(f"the platform is to stand still for {self.still:g} s; it can for {LEARNING_S:g} to 3600 s")


@dataclass(frozen=True, eq=False)
class _Rig:
    """A rig that has been calibrated: the mechanism as it is built and as the controller knows it."""

    config: EvaluationConfig
    seed: int
    built: Mechanism
    known: Mechanism
    calibration: Calibration
    summary: dict[str, Any]

    def parameters(self) -> Record:
        """The cycle's constants."""
        control, fusion = control_settings(self.known), sensor_settings(self.known, load_imu(self.config.imu))
        errors = FUSIONS[self.config.fusion]
        return cycle_parameters(self.known, self.config.rate, control, fusion, ALL_IMUS, errors, self.calibration)

    def move(self, kind: str, duration: float, seed: int) -> tuple[ImposedMotion, Array]:
        """A motion of this rig, and what its raw IMUs read."""
        motion = impose(self.built, kind, duration, self.config.rate, seed)
        return motion, read(motion, load_imu(self.config.imu), self.config.rate, self.seed)


def _calibrated_rig(config: EvaluationConfig, seed: int, joint_error: float, progress: Callable[[float], None]) -> _Rig:
    rig = SimulationConfig(mechanism=config.mechanism, imu=config.imu, seed=seed, rate=config.rate, joint_error=joint_error)
    found = calibrate_rig(rig, Knowledge(Prior(joints=joint_error)), progress, validate=False)
    nominal = load_spatial(config.mechanism)
    calibration = found.calibration
    built = nominal.built(joint_error, seed)
    return _Rig(config, seed, built, nominal.moved_joints(calibration.joints), calibration, found.summary)


def evaluate(config: EvaluationConfig, progress: Callable[[str, float], None] = lambda what, share: None) -> dict[str, Any]:
    """Evaluate the fusion.

    Args:
        config: what to evaluate.
        progress: called with what is under way and the share of it that is done.

    Returns:
        The figures in SI units by section, those of `SECTIONS` and `calibration`; `config` and `version`.

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
    count, label = len(config.seeds), "calibration" if joint_error == 0.0 else "calibration, joint errors"

    def calibrated(i: int, seed: int) -> _Rig:
        return _calibrated_rig(config, seed, joint_error, lambda share: progress(label, (i + share) / count))

    return [calibrated(i, seed) for i, seed in enumerate(config.seeds)]


def _of_calibrations(rigs: Sequence[_Rig]) -> dict[str, Any]:
    """RMS of the pose at rest before and after, predicted and true."""

    def rms(kind: str, stage: str, key: str) -> float:
        return float(np.sqrt(np.mean([rig.summary[kind][stage][key] ** 2 for rig in rigs])))

    keys = ("position_rms", "rotation_rms")
    figures = {
        name: {key: rms(kind, stage, key) for key in keys}
        for name, kind, stage in (
            ("before", "true", "before"), ("after", "true", "motion"), ("predicted", "predicted", "motion"),
        )
    }  # fmt: skip
    least = min(rig.summary["true"]["before"]["position_rms"] / rig.summary["true"]["motion"]["position_rms"] for rig in rigs)
    return figures | {"least_improvement": least}


class _Errors:
    """Mean squares and NEES of runs, pooled."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []

    def add(self, errors: Array, information: Array) -> None:
        """Errors (N, 6) of poses, and the inverse (N, 6, 6) of their covariances."""
        squares = errors.reshape(-1, 2, 3) ** 2
        nees = float(np.einsum("ni,nij,nj->n", errors, information, errors).mean())
        self._rows.append((*squares.sum(axis=2).mean(axis=0), nees))

    def figures(self) -> dict[str, float]:
        """RMS over all, that of the worst run, and mean NEES."""
        squares, nees = np.array(self._rows)[:, :2], np.array(self._rows)[:, 2]
        position, rotation = np.sqrt(squares.mean(axis=0))
        worst_position, worst_rotation = np.sqrt(squares.max(axis=0))
        return {
            "position_rms": float(position),
            "rotation_rms": float(rotation),
            "worst_position_rms": float(worst_position),
            "worst_rotation_rms": float(worst_rotation),
            "nees": float(nees.mean()),
        }


def _add_late(found: Found, motion: ImposedMotion, rate: float, refined: _Errors, whole: _Errors) -> None:
    """Add the errors after the time to learn."""
    late = slice(round(LEARNING_S * rate), None)
    information = found.information[late], np.linalg.inv(found.covariances[late])
    for step, errors, inverse in zip((REFINED, WHOLE), (refined, whole), information, strict=True):
        errors.add(pose_errors(found.positions[step], found.rotations[step], motion)[late], inverse)


def _of_motions(rigs: Sequence[_Rig], progress: Callable[[float], None]) -> dict[str, Any]:
    """By motion, errors of the refined pose and of the whole-mechanism filter."""
    figures: dict[str, Any] = {}
    for m, kind in enumerate(MOTIONS):
        refined, whole = _Errors(), _Errors()
        for i, rig in enumerate(rigs):
            motion, raw = rig.move(kind, _MOTION_S, rig.seed)
            _add_late(fuse(rig.parameters(), raw), motion, rig.config.rate, refined, whole)
            progress((m + (i + 1) / len(rigs)) / len(MOTIONS))
        figures[kind] = {"refined": refined.figures(), "whole": whole.figures()}
    return figures


def _of_faults(rigs: Sequence[_Rig], progress: Callable[[float], None]) -> dict[str, Any]:
    """At 1 Hz, errors of the whole-mechanism filter with all IMUs, without one of a leg, another one for each seed, and without
    the platform's; and their ratios to that with all.
    """
    cases: dict[str, Callable[[_Rig], list[int]]] = {
        "none": lambda rig: [],
        "leg": lambda rig: [rig.seed % LEGS],
        "platform": lambda rig: [PLATFORM_IMU],
    }
    pooled = {name: _Errors() for name in cases}
    for i, rig in enumerate(rigs):
        motion, raw = rig.move("1", _MOTION_S, rig.seed)
        for name, dead in cases.items():
            broken = raw.copy()
            broken[round(_FAULT_S * rig.config.rate) :, :, dead(rig)] = np.nan
            _add_late(fuse(rig.parameters(), broken), motion, rig.config.rate, _Errors(), pooled[name])
        progress((i + 1) / len(rigs))
    figures: dict[str, Any] = {name: errors.figures() for name, errors in pooled.items()}
    for name in ("leg", "platform"):
        for key in ("position_rms", "rotation_rms"):
            figures[name][f"{key}_ratio"] = figures[name][key] / figures["none"][key]
    return figures


def _of_starts(rigs: Sequence[_Rig], progress: Callable[[float], None]) -> dict[str, Any]:
    """Starts in the middle of a motion at a random frequency: how many have the whole-mechanism filter's pose in time."""
    config, random = rigs[0].config, np.random.default_rng(0)
    starts, succeeded, largest = config.starts, 0, np.zeros(2)
    for n in range(starts):
        rig, frequency = rigs[n % len(rigs)], random.uniform(*_START_HZ)
        motion, raw = rig.move(f"{frequency:.3f}", _WATCHED_S, n)
        due = round(_START_S * config.rate)
        state: Record = np.zeros((), STATE)
        parameters = rig.parameters()
        fuse(parameters, raw[:due], state)
        in_time = bool(state["filter_trusted"])
        after = fuse(parameters, raw[due:], state)
        errors = pose_errors(after.positions[WHOLE], after.rotations[WHOLE], _part(motion, due))
        worst = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).max(axis=0)
        largest = np.maximum(largest, worst)
        succeeded += in_time and bool(state["filter_trusted"]) and bool((worst < (_STARTED_M, _STARTED_RAD)).all())
        progress((n + 1) / starts)
    return {"starts": starts, "succeeded": succeeded, "position_max": float(largest[0]), "rotation_max": float(largest[1])}


def _part(motion: ImposedMotion, first: int) -> ImposedMotion:
    return ImposedMotion(motion.times[first:], motion.positions[first:], motion.rotations[first:], motion.signals[first:])


def _of_drift(rigs: Sequence[_Rig], progress: Callable[[float], None]) -> dict[str, Any]:
    """A platform that stands still for long: errors by minute."""
    config = rigs[0].config
    chunks = int(np.ceil(config.still / _CHUNK_S))
    pooled = [_Errors() for _ in range(chunks)]
    for i, rig in enumerate(rigs):
        motion = impose(rig.built, "static", min(_CHUNK_S, config.still), config.rate, rig.seed)
        imu, raw = imu_state(load_imu(config.imu), rig.seed, 1.0 / config.rate), np.empty_like(motion.signals)
        parameters, state = rig.parameters(), np.zeros((), STATE)
        for chunk in range(chunks):
            measure_all(imu, motion.signals, raw)
            found = fuse(parameters, raw, state)
            late = slice(round(LEARNING_S * config.rate) if chunk == 0 else 0, None)
            errors = pose_errors(found.positions[WHOLE], found.rotations[WHOLE], motion)[late]
            pooled[chunk].add(errors, np.linalg.inv(found.covariances[late]))
            progress((i + (chunk + 1) / chunks) / len(rigs))
    return {"minutes": [errors.figures() for errors in pooled]}


def _of_following(config: EvaluationConfig, progress: Callable[[float], None]) -> dict[str, Any]:
    """Errors of the estimate with calibrated IMUs while the closed loop follows a target."""
    pooled = _Errors()
    for i, seed in enumerate(config.seeds):
        run = simulate(
            SimulationConfig(
                config.mechanism, config.target, _FOLLOW_S, config.rate, _CALIBRATED_IMU, seed=seed, fusion=_FOLLOWING
            )
        )
        late = run.times >= LEARNING_S
        turned = vector_from_rotation(run.records["rotation"] @ np.swapaxes(run.true_rotations, 1, 2))
        errors = np.concatenate([run.records["position"] - run.true_positions, turned], axis=1)[late]
        pooled.add(errors, np.linalg.inv(run.records["covariance"][late].astype(float)))
        progress((i + 1) / len(config.seeds))
    return {"target": config.target, "fusion": _FOLLOWING, "imu": _CALIBRATED_IMU} | pooled.figures()


def _of_cost(config: EvaluationConfig, progress: Callable[[float], None]) -> dict[str, Any]:
    """Microseconds of the leg filters and of each whole-mechanism filter in a cycle: mean, and the most that a cycle takes
    because of it, which is the greatest over the cycles of the least over repetitions; what is more is the machine's.
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
            runs.append(fuse(parameters, raw).ns)
            progress((i + (repeat + 1) / _COST_REPEATS) / len(names))
        ns = np.min(runs, axis=0)[:, round(config.rate) :]
        figures[name] = _microseconds(ns[WHOLE] - ns[REFINED])
        figures["leg filters"] = _microseconds(ns[LEGS_ALONE])
    return figures


def _microseconds(ns: NDArray[np.int64]) -> dict[str, float]:
    return {"mean_us": float(ns.mean()) / 1e3, "max_us": float(ns.max()) / 1e3}
