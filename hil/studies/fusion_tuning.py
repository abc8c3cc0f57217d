"""Tuning of the noise that the fusion assumes, by the consistency of its estimators on simulated motions.

An estimator is consistent if the mean NEES, the square of its errors over its covariance, equals the number of components.
The noise of each estimator is scaled until it is consistent, unless its errors grow before. Settings that consistency leaves
open minimise the errors. The simulated joints are exact, so the result does not allow for wrong joints.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache, partial
from importlib.metadata import version
from itertools import chain, product
from typing import Any
from uuid import uuid4

import numpy as np
import tomlkit
from filterpy.stats import NEES
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import chi2

from controller.cycle import cycle_parameters
from controller.settings import FusionSettings, control_settings, sensor_settings
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.runs.config import FUSIONS
from hil.studies.config import TuningConfig
from hil.studies.fused_track import REFINED, WHOLE, PoseTrack, fuse, imposed, track
from plant.compiled import Record
from plant.errors import InputError
from plant.imu import load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial, mechanism_text
from plant.pose import Array

MOTIONS = ("static", "mixed", "1")
"""As `plant.dynamics.imposed_motion.impose` has them."""
DURATION_S, SETTLING_S = 16.0, 8.0
"""Durations of a run, and of its first part, which does not count."""
_SAMPLE_S = 0.05
"""Time between the samples that count; errors hardly change from one cycle to the next."""
_MOST_WORSE = 1.02
"""Factor up to which errors may grow for the sake of consistency."""
_REACH, _COARSE, _FINE = np.log(4.0), 0.3, 0.02
"""Range and tolerances of a search, as logarithms of factors; coarse at least errors, which are flat."""
_DIGITS = 4
_KEPT = 32
"""Motions of which a process keeps the samples, 8 MB of each at 1 kHz."""
_MOST_LEG_ERROR = np.radians(5.0)
"""RMS up to which noise can explain the errors."""


@dataclass(frozen=True, eq=False)
class Consistency:
    """The mean NEES (M,) of each run, and the RMS of the error's parts over all runs, [rad] or [m, rad]."""

    nees: Array
    rms: Array

    def summary(self) -> dict[str, Any]:
        """The mean NEES and the RMS."""
        return {"nees": float(self.nees.mean()), "rms": self.rms.tolist()}


@dataclass(frozen=True)
class Estimator:
    """An estimator that is tuned.

    Attributes:
        errors: finds the errors (N, s, n) in a fused track (N,), and their covariances (N, s, n, n).
        components: n; a consistent NEES equals this number.
        parts: number of groups of components that have an RMS each.
        series: s, the number of independent estimates.
        whole: errors of the IMUs that the whole-mechanism filter estimates; None for other estimators.
    """

    errors: Callable[[Mechanism, Record, PoseTrack], tuple[Array, Array]]
    components: int
    parts: int
    series: int = 1
    whole: str | None = None

    def judge(self, mechanism: Mechanism, fused: Record, truth: PoseTrack) -> tuple[float, Array]:
        """Mean NEES and mean squares of the parts in a run."""
        errors, covariances = self.errors(mechanism, fused, truth)
        n = self.components
        nees = NEES(errors.reshape(-1, n), np.zeros(n), covariances.reshape(-1, n, n))
        squares = np.sum(errors.reshape(*errors.shape[:2], self.parts, -1) ** 2, axis=3)
        return float(np.mean(nees)), squares.mean(axis=(0, 1))

    def bounds(self, runs: int) -> tuple[float, float]:
        """Bounds that hold 95 % of the mean NEES of so many runs if the estimator is consistent.

        A run counts once, however long it is: the IMUs' errors are constant in it.
        """
        count = self.series * runs
        low, high = chi2.ppf((0.025, 0.975), self.components * count) / count
        return float(low), float(high)


def _leg_errors(mechanism: Mechanism, fused: Record, truth: PoseTrack) -> tuple[Array, Array]:
    """Of the two angles of each leg [rad]."""
    vectors = truth.positions[:, None] + mechanism.platform_joints @ np.swapaxes(truth.rotations, 1, 2) - mechanism.base_joints
    return _joint_angles(mechanism, fused["directions"]) - _joint_angles(mechanism, vectors), fused["leg_covariances"]


def _joint_angles(mechanism: Mechanism, vectors: Array) -> Array:
    """The angles (N, 6, 2) [rad] of legs along vectors (N, 6, 3), on their universal joints."""
    x, y, z = np.einsum("kji,nkj->ikn", mechanism.joint_rotations, vectors)
    return np.stack([np.arctan2(-y, z), np.arctan2(x, np.hypot(y, z))]).T


def _tilt_errors(mechanism: Mechanism, fused: Record, truth: PoseTrack) -> tuple[Array, Array]:
    """Of the vertical, along two axes across it [rad]."""
    verticals = fused["vertical"] / np.linalg.norm(fused["vertical"], axis=1, keepdims=True)
    across = np.linalg.svd(verticals[:, None])[2][:, 1:]
    errors = across @ (mechanism.up_in_base @ truth.rotations - verticals)[:, :, None]
    covariances = across @ fused["vertical_covariance"] @ np.swapaxes(across, 1, 2)
    return errors[:, None, :, 0], covariances[:, None]


def _pose_errors(mechanism: Mechanism, fused: Record, truth: PoseTrack, step: int) -> tuple[Array, Array]:
    """Of the pose of a step [m, rad]."""
    covariances = np.linalg.inv(fused["information"]) if step == REFINED else fused["covariance"]
    return track(fused, step).errors(truth)[:, None], covariances[:, None]


ESTIMATORS = {
    "leg filters": Estimator(_leg_errors, components=2, parts=1, series=LEGS),
    "platform filter": Estimator(_tilt_errors, components=2, parts=1),
    "refined pose": Estimator(partial(_pose_errors, step=REFINED), components=6, parts=2),
    "whole mechanism": Estimator(partial(_pose_errors, step=WHOLE), components=6, parts=2, whole=FUSIONS["whole"]),
}

Evaluate = Callable[[float], Consistency]
"""Consistency of an estimator whose noise is multiplied by exp of the argument."""


def _seek_consistency(evaluate: Evaluate, components: int) -> float:
    """The change that makes the mean NEES right, or a smaller one where errors grow or the reach ends."""
    start = evaluate(0.0)
    side = 1.0 if start.nees.mean() > components else -1.0

    def excess(change: float) -> float:
        """Negative while the search should go further."""
        there = evaluate(change)
        beyond = side * np.log(components / there.nees.mean())
        worse = np.log((there.rms / start.rms).max() / _MOST_WORSE)
        left = max(beyond, worse)
        # Close enough: zero ends the search.
        return 0.0 if abs(left) < _FINE / 2.0 else float(left)

    end = side * _REACH
    return end if excess(end) <= 0.0 else float(brentq(excess, 0.0, end, xtol=_FINE))


def _seek_least_errors(evaluate: Evaluate, components: int) -> float:
    """The change with the least product of the errors' RMS."""
    found = minimize_scalar(
        lambda change: np.log(evaluate(change).rms).sum(),
        bounds=(-_REACH, _REACH),
        method="bounded",
        options={"xatol": _COARSE},
    )
    return float(found.x)


def _consistency(
    config: TuningConfig, engine: Engine, tuning: str, fusion: FusionSettings, names: Sequence[str] = tuple(ESTIMATORS)
) -> dict[str, Consistency]:
    """Consistency of estimators by name with these settings, over every motion with every seed."""
    judge = partial(_judge, config, tuning, fusion, names)
    figures = {}
    for name, runs in zip(names, zip(*engine.starmap(judge, list(product(MOTIONS, config.seeds))), strict=True), strict=True):
        nees, squares = zip(*runs, strict=True)
        figures[name] = Consistency(np.array(nees), np.sqrt(np.mean(squares, axis=0)))
    return figures


def _judge(
    config: TuningConfig, tuning: str, fusion: FusionSettings, names: Sequence[str], kind: str, seed: int
) -> list[tuple[float, Array]]:
    """What `Estimator.judge` says of each estimator in a motion."""
    mechanism, raw, truth, late = _motion(config, tuning, kind, seed)
    filters, of_loop = {ESTIMATORS[name].whole for name in names}, (config.rate, control_settings(mechanism))
    fused = {}
    for whole in filters:
        parameters = cycle_parameters(mechanism, *of_loop, fusion, whole=whole)
        # Noise is what least squares leave: doubts would hide that it is assumed too small.
        parameters["pose"]["doubting"] = 0
        fused[whole] = fuse(parameters, raw)[late]
    return [ESTIMATORS[name].judge(mechanism, fused[ESTIMATORS[name].whole], truth) for name in names]


@lru_cache(_KEPT)
def _motion(config: TuningConfig, tuning: str, kind: str, seed: int) -> tuple[Mechanism, Array, PoseTrack, slice]:
    """The mechanism, the samples of a motion, and the true poses that count; kept for one `tuning`, as files may change."""
    mechanism = load_spatial(config.mechanism)
    late = slice(round(SETTLING_S * config.rate), None, max(1, round(_SAMPLE_S * config.rate)))
    return mechanism, *imposed(mechanism, kind, DURATION_S, config.rate, seed, config.imu, late), late


@dataclass(frozen=True)
class _Step:
    """A search: which estimator it improves, how, and the settings that it scales by a common factor."""

    estimator: str
    seek: Callable[[Evaluate, int], float]
    settings: tuple[str, ...]

    def tuned(self, fusion: FusionSettings, consistency: Callable[..., dict[str, Consistency]]) -> FusionSettings:
        """The settings with the result of the search."""

        def scaled(change: float) -> FusionSettings:
            changed = {name: getattr(fusion, name) * np.exp(change) for name in self.settings}
            return replace(fusion, **{name: float(f"{value:.{_DIGITS}g}") for name, value in changed.items()})

        @cache
        def evaluate(change: float) -> Consistency:
            return consistency(scaled(change), (self.estimator,))[self.estimator]

        return scaled(self.seek(evaluate, ESTIMATORS[self.estimator].components))


STEPS = (
    _Step("leg filters", _seek_consistency, ("leg_accelerometer_noise",)),
    _Step("platform filter", _seek_consistency, ("platform_accelerometer_noise",)),
    _Step("refined pose", _seek_least_errors, ("tilt_sigma",)),
    _Step("refined pose", _seek_consistency, ("leg_sigma", "tilt_sigma")),
    _Step("whole mechanism", _seek_consistency, ("noise_inflation",)),
)
"""In the order of the estimators: each builds upon the one before."""


def tune_fusion(config: TuningConfig, engine: Engine = IN_ONE_PROCESS, progress: Progress = no_progress) -> dict[str, Any]:
    """Find the noise that makes the estimators consistent.

    Returns:
        `settings`: by name, the value `before` and `after`; `estimators`: by name, the `settings` that it has, its `consistent`
        NEES with 95 % `bounds`, and `before` and `after` the mean `nees` and the `rms` [rad], or [m, rad]; `config`, `version`.

    Raises:
        GoughError: something in the configuration cannot be used, or noise cannot explain the IMUs' errors.
    """
    before = fusion = sensor_settings(load_spatial(config.mechanism), load_imu(config.imu), config.rate)
    consistency = partial(_consistency, config, engine, uuid4().hex)
    stages = len(STEPS) + 2  # First figures before, last figures after.
    figures_before = consistency(before)
    worst = float(figures_before["leg filters"].rms[0])
    if not worst < _MOST_LEG_ERROR:
        raise InputError(
            f"the IMUs {config.imu} put the leg filters off by {np.degrees(worst):.3g} deg RMS, and beyond "
            f"{np.degrees(_MOST_LEG_ERROR):g} deg no noise accounts for it: tune for calibrated ones"
        )
    names: dict[str, list[str]] = {name: [] for name in ESTIMATORS}
    for i, step in enumerate(STEPS, start=1):
        progress(i / stages)
        fusion = step.tuned(fusion, consistency)
        names[step.estimator] += [name for name in step.settings if name not in names[step.estimator]]
    progress((stages - 1) / stages)
    figures_after = consistency(fusion)
    return {
        "settings": {
            name: {"before": getattr(before, name), "after": getattr(fusion, name)} for name in chain(*names.values())
        },
        "estimators": {
            name: {
                "settings": names[name],
                "consistent": estimator.components,
                "bounds": estimator.bounds(len(MOTIONS) * len(config.seeds)),
                "before": figures_before[name].summary(),
                "after": figures_after[name].summary(),
            }
            for name, estimator in ESTIMATORS.items()
        },
        "config": asdict(config),
        "version": version("gough"),
    }


def tuned_text(mechanism: str, settings: Mapping[str, float]) -> str:
    """The TOML text of a mechanism with these entries in its table `fusion`, and no other change.

    Raises:
        GoughError: no such mechanism, or its file cannot be read.
    """
    document = tomlkit.parse(mechanism_text(mechanism))
    document.setdefault("fusion", tomlkit.table()).update(settings)
    return tomlkit.dumps(document)
