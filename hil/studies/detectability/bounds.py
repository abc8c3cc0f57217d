"""How far the pose can be off before the best test on the data tells a fault.

The signature of a fault is whitened by the model without a fault. The sum of the squares of what comes out until a time is the
noncentrality of the likelihood-ratio test at this time, and the best estimate that knows of no fault makes of the signature the
error that the fault causes. `docs/detectability.md` derives this.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2

from controller.planning.target import load_target
from hil.runs.config import SimulationConfig
from hil.studies.detectability.kinematics import Motion, motion_along
from hil.studies.detectability.likelihood_ratio import POWER, needed_noncentrality, probability_of_silence
from hil.studies.detectability.model import LinearModel, Whitened, linear_model, whitened
from hil.studies.detectability.signatures import Stage, directions_of, signature
from hil.studies.detectability.uncertainty import Uncertainty
from plant.imu import load_imu
from plant.mechanism import Mechanism, load_spatial
from plant.pose import Array

STEP_S = 0.02
"""Duration of a step of the model."""

REST_S = 1.0
"""So long the platform stands at the start of the motion, and the test listens."""


class Disturbed(NamedTuple):
    """A run in which something goes wrong."""

    config: SimulationConfig
    faults: Sequence[str]  # as texts
    begin: float  # of the first, in the motion [s]; 0 if it is there from the start


@dataclass(frozen=True)
class Bound:
    """What the best test on the data does with a disturbed run.

    Attributes:
        told_after: from the begin of the fault, or of the motion, until the test has its power [s]; None if never.
        share: the greatest of the fault until then, relative to the greatest of the whole run.
        position, rotation: error of the pose until then, the greatest of all times: at each, 99.9 % of all errors of the best
            estimate that knows of no fault are smaller [m], [rad].
        fault_position, fault_rotation: what the fault itself does to this estimate.
        least: factor on the fault with which it would be told just at the end of the run.
        least_position, least_rotation: what the fault with this factor does to the estimate until then.
        level_position, level_rotation: what a protection level must be at least, as `least_level` has it [m], [rad].
        sound_position, sound_rotation: RMS error of the estimate in motion without a fault [m], [rad].
    """

    told_after: float | None
    share: float
    position: float
    rotation: float
    fault_position: float
    fault_rotation: float
    least: float
    least_position: float
    least_rotation: float
    level_position: float
    level_rotation: float
    sound_position: float
    sound_rotation: float


def find_bounds(runs: Sequence[Disturbed], uncertainty: Uncertainty) -> list[Bound]:
    """The bounds of runs with the same mechanism, target, duration, rate and kind of IMUs.

    Raises:
        NoSignatureError: a fault changes nothing that the sensors read on average.
        GoughError: the mechanism, the target or the IMUs cannot be used.
    """
    config = runs[0].config
    model = _model(config.mechanism, config.target, config.duration, config.imu, config.rate, uncertainty)
    data = np.stack([_signature(run) for run in runs], axis=2)[: len(model.sensitivity)]
    found = whitened(model, data)
    return [_bound(found, data, i, run) for i, run in enumerate(runs)]


def _signature(run: Disturbed) -> Array:
    config = run.config
    mechanism, motion, times = _motion(config.mechanism, config.target, config.duration, 1.0 / config.rate, -REST_S)
    stage = Stage(mechanism, _built(mechanism, config), load_imu(config.imu), config.seed, motion, times)
    return signature(stage, run.faults, _cycles(config.rate))


def _built(mechanism: Mechanism, config: SimulationConfig) -> Mechanism:
    """The mechanism as it is, where its joints are not as drawn."""
    built = mechanism.built(config.joint_error, config.seed) if config.joint_error else mechanism
    for setting in config.settings:
        if setting.name == "base_joints":
            moves = np.zeros((2, *built.base_joints.shape))
            moves[0] = np.reshape(setting.value, built.base_joints.shape) - built.base_joints
            built = built.moved_joints(moves)
    return built


@lru_cache(maxsize=8)
def _motion(name: str, target: str, duration: float, period: float, first: float) -> tuple[Mechanism, Motion, Array]:
    """A mechanism, its motion along a target in every `period` [s], and these times, of which the first is `first` [s]."""
    mechanism = load_spatial(name)
    # What is left of a step at the end does not count; rounding must not take the last one.
    times = first + period * np.arange(int((REST_S + duration) / period + 1e-6))
    return mechanism, motion_along(load_target(target, mechanism, duration), mechanism, times), times


# Each takes 100 MB for 20 s.
@lru_cache(maxsize=4)
def _model(name: str, target: str, duration: float, imu: str, rate: float, uncertainty: Uncertainty) -> LinearModel:
    step = _cycles(rate) / rate
    mechanism, motion, _ = _motion(name, target, duration, step, 0.5 * step - REST_S)
    return linear_model(mechanism, motion, load_imu(imu), rate, uncertainty, step)


def _cycles(rate: float) -> int:
    """The number of cycles in a step of the model, which takes about `STEP_S`."""
    return round(STEP_S * rate)


def _bound(found: Whitened, data: Array, column: int, run: Disturbed) -> Bound:
    begin, needed = run.begin, needed_noncentrality(directions_of(run.faults))
    rate = run.config.rate
    ended = _cycles(rate) / rate * np.arange(1, len(found.estimates) + 1) - REST_S
    noncentrality = np.cumsum(np.sum(found.innovations[:, :, column] ** 2, axis=1))
    reached = bool(noncentrality[-1] >= needed)
    last = (
        max(int(np.searchsorted(noncentrality, needed)), int(np.searchsorted(ended, begin, "right")))
        if reached
        else len(ended) - 1
    )
    during = (ended > begin) & (np.arange(len(ended)) <= last)
    sizes = np.linalg.norm(data[: len(ended), :, column], axis=1)
    least = sqrt(needed / max(noncentrality[-1], 1e-300))
    estimates, covariances = found.estimates[:, :, column], found.covariances
    moving = ended > 0.0
    silence = probability_of_silence(noncentrality[moving])
    figures: dict[str, float] = {}
    for name, part in (("position", slice(0, 3)), ("rotation", slice(3, 6))):
        errors = np.linalg.norm(estimates[:, part], axis=1)
        figures[name] = float(quantile_of_size(estimates[during, part], covariances[during, part, part]).max())
        figures[f"fault_{name}"] = float(errors[during].max())
        figures[f"least_{name}"] = least * float(errors.max())
        means, spreads = estimates[moving, part], covariances[moving, part, part]
        figures[f"level_{name}"] = least_level(means, spreads, silence)
        figures[f"sound_{name}"] = float(np.sqrt(np.trace(spreads, axis1=1, axis2=2).mean()))
    return Bound(
        told_after=float(ended[last] - begin) if reached else None,
        share=float(sizes[: last + 1].max() / sizes.max()),
        least=least,
        **figures,
    )


def least_level(means: Array, covariances: Array, silence: Array) -> float:
    """The size that a protection level must have at least to be above the error in a share `POWER` of the steps.

    Without a fault, the level is beyond this size with the probability `RAISED` at each step. So "it is beyond" is a test,
    and silent with the probability `silence` (N,) at least, whatever the level makes of the data. The error of the best
    estimate, of mean (N, 3) and covariance (N, 3, 3), does not depend on the data. 0 if the test is hardly ever silent.
    """

    def uncovered(size: float) -> float:
        return float(np.mean(silence * beyond(means, covariances, size))) - (1.0 - POWER)

    # What is told at once needs no level.
    if uncovered(0.0) <= 0.0:
        return 0.0
    return float(brentq(uncovered, 0.0, quantile_of_size(means, covariances, 1.0 - 1e-6).max(), rtol=1e-4))


def beyond(mean: Array, covariance: Array, size: float) -> Array:
    """With what probability (N,) normal vectors of mean (N, m) and covariance (N, m, m) are longer than `size`."""
    factor, freedom = _like_chi_squared(mean, covariance)
    probability: Array = chi2.sf(size**2 / factor, freedom)
    return probability


def quantile_of_size(mean: Array, covariance: Array, level: float = POWER) -> Array:
    """The length (N,) below which normal vectors of mean (N, m) and covariance (N, m, m) are with the probability `level`."""
    factor, freedom = _like_chi_squared(mean, covariance)
    quantile: Array = np.sqrt(factor * chi2.ppf(level, freedom))
    return quantile


def _like_chi_squared(mean: Array, covariance: Array) -> tuple[Array, Array]:
    """The factor and the degrees of freedom of a multiple of a chi-squared variable with the mean and the variance of the
    square of the length of such vectors (Satterthwaite).
    """
    middle = np.trace(covariance, axis1=1, axis2=2) + np.sum(mean**2, axis=1)
    spread = 2.0 * np.sum(covariance**2, axis=(1, 2)) + 4.0 * np.einsum("ni,nij,nj->n", mean, covariance, mean)
    return spread / (2.0 * middle), 2.0 * middle**2 / spread
