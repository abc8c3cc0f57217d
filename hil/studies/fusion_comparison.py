"""Comparison of all ways to fuse the IMUs on one imposed motion: errors, consistency and cost.

All methods get the same raw samples. The filters learn for the first twenty seconds, whose errors do not count.
"""

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from vqf import VQF

from controller.calibration.file import Calibration, calibration_for
from controller.cycle import MARKS, STATE, CycleStage, run_stages
from controller.direct_kinematics import solve_batch
from controller.estimation.filterpy_filters import FilterpyFilters
from controller.estimation.leg_filter import leg_direction, start_leg
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.studies.config import LEARNING_S, WHOLE_FUSIONS, ComparisonConfig
from hil.studies.fused_track import CLOSED, FUSED, REFINED, WHOLE, Figures, PoseTrack, constants, fuse, imposed, pooled, track
from plant.compiled import Record, kernel
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE
from plant.mechanism import LEGS, load_spatial
from plant.pose import Array


def compare(config: ComparisonConfig, engine: Engine = IN_ONE_PROCESS, progress: Progress = no_progress) -> dict[str, Any]:
    """Run every method.

    Returns:
        `methods`: by name, `position_rms` [m], `rotation_rms` [rad], `nees` (6 is consistent; None without a covariance), `us`
        (median time of a cycle) and the number of `seeds`; `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    mechanism = load_spatial(config.mechanism)
    calibration = Calibration() if config.calibration is None else calibration_for(config.calibration, mechanism, config.imu)
    of_seeds = engine.starmap(partial(_compare, config, calibration), list(enumerate(config.seeds)), progress)
    by_name = {name: [each[name] for each in of_seeds if name in each] for name in of_seeds[0]}
    return {
        "methods": {
            name: pooled(runs) | {"us": float(np.median([each["us"] for each in runs])), "seeds": len(runs)}
            for name, runs in by_name.items()
        },
        "config": asdict(config),
        "version": version("gough"),
    }


def _compare(config: ComparisonConfig, calibration: Calibration, number: int, seed: int) -> dict[str, Figures]:
    readings, methods = _Readings(config, calibration, seed), METHODS if number else METHODS | SLOW_METHODS
    return {name: method(readings).figures(readings.truth) for name, method in methods.items()}


class _Readings:
    """The raw samples of one motion, which all methods get, and the cycle's estimates from them."""

    def __init__(self, config: ComparisonConfig, calibration: Calibration, seed: int) -> None:
        nominal = load_spatial(config.mechanism)
        self.rate = config.rate
        self.late = slice(round(LEARNING_S * config.rate), None)
        of_imus = config.motion, config.duration, config.rate, seed, config.imu
        self.raw, self.truth = imposed(nominal, *of_imus, self.late)
        self.calibration = calibration
        self.mechanism = nominal.moved_joints(calibration.joints)
        self.imu = config.imu
        self._fused: dict[str, Record] = {}

    def parameters(self, fusion: str = "compiled") -> Record:
        """The cycle's constants with this fusion, a key of `hil.runs.config.FUSIONS`."""
        return constants(self.mechanism, self.imu, self.rate, fusion, self.calibration)

    def track(self, step: int, fusion: str = "compiled") -> PoseTrack:
        """The poses of a step of the cycle that count."""
        if fusion not in self._fused:
            self._fused[fusion] = fuse(self.parameters(fusion), self.raw)
        return track(self._fused[fusion][self.late], step)


def _vqf(readings: _Readings) -> PoseTrack:
    """The refined pose with the `vqf` package, which knows neither joints nor motion."""
    count = len(readings.raw)
    calibrated = readings.calibration.apply(readings.raw)
    ups, directions = np.empty((IMU_COUNT, count, 3)), np.empty((count, LEGS, 3))
    began = time.perf_counter()
    for imu in range(IMU_COUNT):
        rates = np.ascontiguousarray(calibrated[:, GYROSCOPE, imu])
        forces = np.ascontiguousarray(calibrated[:, ACCELEROMETER, imu])
        ups[imu] = vqf_verticals(1.0 / readings.rate, rates, forces)
    us = 1e6 * (time.perf_counter() - began) / count
    _point(readings.parameters(), ups, directions)
    solutions = solve_batch(readings.mechanism, directions, up_in_platform=ups[PLATFORM_IMU])
    return PoseTrack(solutions.positions[readings.late], solutions.rotations[readings.late], us=us)


def vqf_verticals(period: float, rates: Array, forces: Array) -> Array:
    """The unit verticals (N, 3) in the IMU's frame by `vqf`, from rates and forces (N, 3); `period` in s."""
    w, x, y, z = VQF(period).updateBatch(rates, forces)["quat6D"].T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


@kernel
def _point(parameters: Record, ups: Array, directions: Array) -> None:
    """Write the directions (N, 6, 3) of legs whose IMUs see the vertical at `ups` (7, N, 3)."""
    sensors = parameters[()].rig.sensors
    x, covariance, still, rate = np.zeros(9), np.zeros((9, 9)), np.zeros(3), np.zeros(3)
    for k in range(LEGS):
        for i in range(directions.shape[0]):
            start_leg(x, covariance, still, ups[k, i], sensors.up_in_joint[k], 1.0)
            leg_direction(x, sensors.joint_rotations[k], 0.0, directions[i, k], rate)


def _filterpy(readings: _Readings) -> PoseTrack:
    """The refined pose with the filters of legs and platform on filterpy."""
    parameters, state = readings.parameters(), np.zeros((), STATE)
    filters, fused = FilterpyFilters(parameters), np.zeros(len(readings.raw), FUSED)
    segments, marks, pose = np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()], state["pose"]
    for i, raw in enumerate(readings.raw):
        began = time.perf_counter_ns()
        run_stages(parameters, state, raw, segments, marks, CycleStage.SCREENING.value, CycleStage.LEGS.value)
        filters.step_legs(state)
        filters.step_platform(state)
        run_stages(parameters, state, raw, segments, marks, CycleStage.HEADING.value, CycleStage.MECHANISM.value)
        fused["ns"][i, REFINED] = time.perf_counter_ns() - began
        fused["positions"][i, REFINED], fused["rotations"][i, REFINED] = pose["position"], pose["rotation"]
        lower = np.tril(pose["information"])
        fused["information"][i] = lower + np.tril(lower, -1).T
        state["time"]["cycle"] += 1
    return track(fused[readings.late], REFINED)


METHODS: dict[str, Callable[[_Readings], PoseTrack]] = {
    "section 5, magnetometer": partial(_Readings.track, step=CLOSED, fusion="section-5"),
    "vqf per IMU, refined": _vqf,
    "legs + vertical": partial(_Readings.track, step=CLOSED),
    "refined (compiled)": partial(_Readings.track, step=REFINED),
    **{name: partial(_Readings.track, step=WHOLE, fusion=name) for name in WHOLE_FUSIONS},
}
SLOW_METHODS: dict[str, Callable[[_Readings], PoseTrack]] = {"refined (filterpy)": _filterpy}
"""Ways to fuse; the slow ones run on the first seed only."""
