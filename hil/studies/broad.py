"""The platform filter by itself, where nothing tells the platform's acceleration: on real and on simulated IMUs.

The real ones are trials of the BROAD benchmark, moved by hand, with an optical reference.

D. Laidig, M. Caruso, A. Cereatti, T. Seel, *BROAD - A Benchmark for Robust Inertial Orientation Estimation*, Data 6(7), 2021,
doi 10.3390/data6070072. A trial is a NumPy archive with

- `imu_gyr`, `imu_acc`: (N, 3), rates [rad/s] and forces [m/s^2],
- `opt_quat`: (N, 4), maps the sensor's frame to one with z up; NaN where the optics lost the sensor,
- `movement`: (N,), true for samples that count,
- `sampling_rate`: [Hz].

The simulated ones move freely (`plant.dynamics.free_motion`).
"""

import timeit
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.estimation.imu_health import END_OF_RANGE
from controller.estimation.platform_filter import STATE, note_clipping, platform_parameters, start_platform, step_platform
from controller.settings import FusionSettings
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.studies.fusion_comparison import vqf_verticals
from plant.compiled import Record, kernel
from plant.dynamics.free_motion import SPECTRA, STILL_S, move_freely
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, STANDARD_GRAVITY, imu_state, load_imu, measure
from plant.pose import Array, rotations_from_quaternions

SHAPES = {"imu_gyr": (3,), "imu_acc": (3,), "opt_quat": (4,), "movement": ()}
"""Arrays of a trial, and the shape of a sample of each."""
_REPEATS = 5
_IMU = "mpu9150-calibrated"
_UNIT_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class Trial:
    """A trial: its rate [Hz], and the IMU's rates and forces (N, 3) [rad/s, m/s^2].

    `verticals` (N, 3) are the true ones in the sensor's frame. Only samples with `counts` (N,) count. The gyroscope's readings
    are clipped at its `reach` [rad/s]; infinity if that is not known.
    """

    name: str
    rate: float
    rates: Array
    forces: Array
    verticals: Array
    counts: NDArray[np.bool_]
    reach: float = np.inf

    def inclination_rms(self, verticals: Array) -> float:
        """RMS of the angle between verticals (N, 3) and the true ones [rad], over the samples that count."""
        found, true = verticals[self.counts], self.verticals[self.counts]
        angles = np.arctan2(np.linalg.norm(np.cross(found, true), axis=1), np.sum(found * true, axis=1))
        return float(np.sqrt(np.mean(angles**2)))


def evaluate(
    folder: str | Path | None, fusion: FusionSettings, seeds: int = 0, engine: Engine = IN_ONE_PROCESS
) -> dict[str, Any]:
    """Run the platform filter and the `vqf` package on every trial `*.npz` of a folder, and on simulated motions.

    Args:
        folder: of the trials; None for none.
        fusion: what the filter assumes.
        seeds: how many simulated motions there are of each kind, those of the seeds 1, 2 ...

    Returns:
        `trials` and `simulated`: by name and method (`filter`, `vqf`) the `inclination_rms` [rad] and the `us` of a sample; the
        noise that the filter assumed [m/s^2/sqrt(Hz), rad/s/sqrt(s)], and the `version`.

    Raises:
        InputError: the folder is missing or has no trial, a file is not a trial, or there is nothing to run on.
    """
    paths = [] if folder is None else sorted(Path(folder).glob("*.npz"))
    if folder is not None and not paths:
        raise InputError(f"{folder} is no folder with trials *.npz: give one with trials of BROAD")
    if not paths and seeds < 1:
        raise InputError(f"no folder with trials and {seeds} simulated motions of each kind: give a folder, or at least 1")
    trials = [load_trial(path) for path in paths]
    motions = [(kind, seed) for kind in SPECTRA for seed in range(1, seeds + 1)]
    of_motions = engine.starmap(partial(_evaluate_motion, fusion), motions) if motions else []
    return {
        "trials": dict(engine.map(partial(_evaluate, fusion), trials)) if trials else {},
        "simulated": dict(of_motions),
        "accelerometer_noise": fusion.platform_accelerometer_noise,
        "bias_walk": fusion.bias_walk,
        "version": version("gough"),
    }


def _evaluate(fusion: FusionSettings, trial: Trial) -> tuple[str, dict[str, Any]]:
    return trial.name, {
        "filter": _score(trial, partial(filter_verticals, trial, fusion)),
        "vqf": _score(trial, partial(vqf_verticals, 1.0 / trial.rate, trial.rates, trial.forces)),
        "samples": len(trial.rates),
        "rate": trial.rate,
    }


def _evaluate_motion(fusion: FusionSettings, kind: str, seed: int) -> tuple[str, dict[str, Any]]:
    return _evaluate(fusion, simulated_trial(kind, seed))


def simulated_trial(kind: str, seed: int, duration: float = 120.0, rate: float = 250.0) -> Trial:
    """A trial of a free motion (`move_freely`) with an IMU `mpu9150-calibrated`, whose errors have the same seed."""
    model = load_imu(_IMU)
    motion, imu = move_freely(kind, duration, rate, seed), imu_state(model, seed, 1.0 / rate)
    ideal, raw = np.zeros((3, IMU_COUNT, 3)), np.empty((len(motion.times), 3, IMU_COUNT, 3))
    for rates, forces, sample in zip(motion.rates, motion.forces, raw, strict=True):
        ideal[GYROSCOPE, PLATFORM_IMU], ideal[ACCELEROMETER, PLATFORM_IMU] = rates, forces
        measure(imu, ideal, sample)
    gyroscope, accelerometer = (np.ascontiguousarray(raw[:, kind, PLATFORM_IMU]) for kind in (GYROSCOPE, ACCELEROMETER))
    verticals, counts = motion.rotations[:, 2], motion.times >= STILL_S
    return Trial(f"{kind}, seed {seed}", rate, gyroscope, accelerometer, verticals, counts, model.gyroscope.reach)


def load_trial(path: Path) -> Trial:
    """Read a trial.

    Raises:
        InputError: the file cannot be read, or an array is missing, of a wrong shape, or not finite.
    """
    try:
        with np.load(path) as file:
            arrays = {
                name: np.asarray(file[name], dtype=float, order="C")
                for name in file.files
                if name in {*SHAPES, "sampling_rate"}
            }
    except (OSError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no NumPy archive that can be read: {error}") from None
    if missing := [name for name in (*SHAPES, "sampling_rate") if name not in arrays]:
        raise InputError(f"{path} lacks {', '.join(missing)}: a trial of BROAD has {', '.join(SHAPES)} and sampling_rate")
    count = len(np.atleast_1d(arrays["imu_gyr"]))
    for name, shape in SHAPES.items():
        if arrays[name].shape != (count, *shape):
            raise InputError(
                f"{path}: {name} has shape {arrays[name].shape}; with imu_gyr of {count} it must be {(count, *shape)}"
            )
    for name in ("imu_gyr", "imu_acc", "movement"):
        bad = np.flatnonzero(~np.isfinite(arrays[name].reshape(count, -1)).all(axis=1))
        if len(bad):
            raise InputError(f"{path}: {name} is not finite in sample {bad[0]}: cut the trial there")
    rate = arrays["sampling_rate"]
    if rate.shape != () or not 0.0 < rate < np.inf:
        raise InputError(f"{path}: sampling_rate is {rate}; it must be one positive number")
    lengths = np.linalg.norm(arrays["opt_quat"], axis=1)
    seen = np.isfinite(lengths)
    counts = seen & (arrays["movement"] != 0.0)
    if not counts.any():
        raise InputError(f"{path}: no sample counts: movement must mark some that opt_quat is known of")
    crooked = np.flatnonzero(seen & (abs(lengths - 1.0) > _UNIT_TOLERANCE))
    if len(crooked):
        raise InputError(f"{path}: opt_quat has length {lengths[crooked[0]]:g} in sample {crooked[0]}; it must be 1")
    verticals = rotations_from_quaternions(arrays["opt_quat"] / lengths[:, None])[:, 2]
    return Trial(path.stem, float(rate), arrays["imu_gyr"], arrays["imu_acc"], verticals, counts)


def _score(trial: Trial, method: Callable[[], Array]) -> dict[str, float]:
    """The error of a method, and its median time."""
    verticals, took = method(), timeit.repeat(method, repeat=_REPEATS, number=1)
    return {"inclination_rms": trial.inclination_rms(verticals), "us": 1e6 * float(np.median(took)) / len(verticals)}


def filter_verticals(trial: Trial, fusion: FusionSettings) -> Array:
    """The verticals (N, 3) by the platform filter, which does not know the acceleration."""
    parameters = platform_parameters(fusion, trial.rate)
    return _follow(parameters, np.zeros((), STATE), trial.rates, trial.forces, 1.0 / trial.rate, END_OF_RANGE * trial.reach)


@kernel
def _follow(parameters: Record, state: Record, rates: Array, forces: Array, period: float, end: float) -> Array:
    p, s = parameters[()], state[()]
    acceleration, verticals = np.zeros(3), np.empty_like(forces)
    start_platform(p, s, forces[0])
    for i in range(rates.shape[0]):
        most = max(abs(rates[i, 0]), abs(rates[i, 1]), abs(rates[i, 2]))
        note_clipping(s, most >= end, period)
        step_platform(p, s, rates[i], forces[i], acceleration, period, STANDARD_GRAVITY)
        verticals[i] = s.x[:3]
    return verticals
