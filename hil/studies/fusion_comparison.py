"""Comparison of all ways to fuse the IMUs on one imposed motion: errors, consistency and cost.

The platform moves as prescribed (`plant.dynamics.imposed`), also where no actuator could follow. All methods get the same raw
samples. The filters learn for the first twenty seconds, whose errors do not count.
"""

import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from vqf import VQF

from controller.calibration.file import Calibration, load_calibration
from controller.cycle import MARKS, STATE, CycleStage, cycle_parameters, run_stages
from controller.direct_kinematics import solve_batch
from controller.estimation.filterpy_filters import FilterpyFilters
from controller.estimation.leg_filter import leg_direction, start_leg
from controller.settings import control_settings, sensor_settings
from hil.progress import Progress, no_progress
from hil.runs.config import FUSIONS
from hil.studies.config import LEARNING_S, ComparisonConfig
from hil.studies.fused_track import CLOSED, FUSED, REFINED, WHOLE, PoseErrors, PoseTrack, fuse, poses_of, read, track
from plant.compiled import Record, kernel
from plant.dynamics.imposed import ImposedMotion, impose
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.imu import ACCELEROMETER, GYROSCOPE, ImuModel, load_imu
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array
from plant.wiring import ALL_IMUS


def compare(config: ComparisonConfig, progress: Progress = no_progress) -> dict[str, Any]:
    """Run every method.

    Returns:
        `methods`: by name, `position_rms` [m], `rotation_rms` [rad], `nees` (6 is consistent; None without a covariance), `us`,
        the median time of a cycle from raw sample to pose, and the number of `seeds`; `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    mechanism, model = load_spatial(config.mechanism), load_imu(config.imu)
    calibration = Calibration() if config.calibration is None else load_calibration(config.calibration)
    errors: dict[str, PoseErrors] = {}
    times: dict[str, list[float]] = {}
    late = slice(round(LEARNING_S * config.rate), None)
    for i, seed in enumerate(config.seeds):
        motion = impose(mechanism, config.motion, config.duration, config.rate, seed)
        truth = poses_of(motion, late)
        readings = _Readings(mechanism.moved_joints(calibration.joints), model, calibration, config.rate, seed, motion)
        methods = {**METHODS, **(SLOW_METHODS if i == 0 else {})}
        for k, (name, method) in enumerate(methods.items()):
            found = method(readings)
            errors.setdefault(name, PoseErrors()).add(found.at(late), truth)
            if found.us is not None:
                times.setdefault(name, []).append(found.us)
            progress((i + (k + 1) / len(methods)) / len(config.seeds))
    return {
        "methods": {
            name: pooled.figures() | {"us": float(np.median(times[name])), "seeds": len(times[name])}
            for name, pooled in errors.items()
        },
        "config": asdict(config),
        "version": version("gough"),
    }


class _Readings:
    """The raw samples of one motion, which all methods get, and the cycle's estimates from them."""

    def __init__(
        self, mechanism: Mechanism, model: ImuModel, calibration: Calibration, rate: float, seed: int, motion: ImposedMotion
    ) -> None:
        self.mechanism, self.rate, self.count = mechanism, rate, len(motion.times)
        self._fusion, self._calibration = sensor_settings(mechanism, model), calibration
        self.raw = read(motion, model, rate, seed)
        self.calibrated = calibration.apply(self.raw)
        self._fused: dict[str | None, Record] = {}

    def parameters(self, errors: str | None, section_5: bool = False) -> Record:
        """The cycle's constants."""
        control, imus = control_settings(self.mechanism), ALL_IMUS
        return cycle_parameters(
            self.mechanism, self.rate, control, self._fusion, imus, errors, self._calibration, section_5, section_5
        )

    def track(self, step: int, errors: str | None = None) -> PoseTrack:
        """The poses of a step of the cycle; the whole-mechanism filter estimates these `errors` of the IMUs."""
        if errors not in self._fused:
            self._fused[errors] = fuse(self.parameters(errors), self.raw)
        return track(self._fused[errors], step)


def _section_5(readings: _Readings) -> PoseTrack:
    """The paper's algorithm: leg directions, and the platform's whole orientation, with the heading of its magnetometer."""
    return track(fuse(readings.parameters(None, section_5=True), readings.raw), CLOSED)


def _vqf(readings: _Readings) -> PoseTrack:
    """The `vqf` package on each IMU by itself, which knows neither joints nor the platform's motion; and the refinement."""
    period, began = 1.0 / readings.rate, time.perf_counter()
    ups = np.empty((IMU_COUNT, readings.count, 3))
    for imu in range(IMU_COUNT):
        rates, forces = (np.ascontiguousarray(readings.calibrated[:, sensor, imu]) for sensor in (GYROSCOPE, ACCELEROMETER))
        ups[imu] = vqf_verticals(period, rates, forces)
    us = 1e6 * (time.perf_counter() - began) / readings.count
    directions = np.empty((readings.count, LEGS, 3))
    _point(readings.parameters(None), ups, directions)
    solutions = solve_batch(readings.mechanism, directions, up_in_platform=ups[PLATFORM_IMU])
    return PoseTrack(solutions.positions, solutions.rotations, us=us)


def vqf_verticals(period: float, rates: Array, forces: Array) -> Array:
    """The unit vertical (N, 3) in the IMU's frame by `vqf`, from rates and forces (N, 3) that are `period` [s] apart."""
    w, x, y, z = VQF(period).updateBatch(rates, forces)["quat6D"].T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


@kernel
def _point(parameters: Record, ups: Array, directions: Array) -> None:
    """Write the directions (N, 6, 3) of legs whose IMUs see the vertical as `ups` (7, N, 3)."""
    sensors = parameters[()].rig.sensors
    x, covariance, still, rate = np.zeros(9), np.zeros((9, 9)), np.zeros(3), np.zeros(3)
    for k in range(LEGS):
        for i in range(directions.shape[0]):
            start_leg(x, covariance, still, ups[k, i], sensors.up_in_joint[k], 1.0)
            leg_direction(x, sensors.joint_rotations[k], 0.0, directions[i, k], rate)


def _filterpy(readings: _Readings) -> PoseTrack:
    """The refined pose with the filters of legs and platform on filterpy."""
    parameters, state = readings.parameters(None), np.zeros((), STATE)
    filters, fused = FilterpyFilters(parameters), np.zeros(readings.count, FUSED)
    segments, marks, pose = np.zeros((LEGS, 1, 5)), np.zeros((), MARKS)[()], state["pose"]
    for i, raw in enumerate(readings.raw):
        began = time.perf_counter_ns()
        run_stages(parameters, state, raw, segments, marks, CycleStage.SCREENING, CycleStage.LEGS)
        filters.step_legs(state)
        filters.step_platform(state)
        run_stages(parameters, state, raw, segments, marks, CycleStage.HEADING, CycleStage.MECHANISM)
        fused["ns"][i, REFINED] = time.perf_counter_ns() - began
        fused["positions"][i, REFINED], fused["rotations"][i, REFINED] = pose["position"], pose["rotation"]
        lower = np.tril(pose["information"])
        fused["information"][i] = lower + np.tril(lower, -1).T
        state["time"]["cycle"] += 1
    return track(fused, REFINED)


METHODS: dict[str, Callable[[_Readings], PoseTrack]] = {
    "section 5, magnetometer": _section_5,
    "vqf per IMU, refined": _vqf,
    "legs + vertical": partial(_Readings.track, step=CLOSED),
    "refined (compiled)": partial(_Readings.track, step=REFINED),
    **{name: partial(_Readings.track, step=WHOLE, errors=errors) for name, errors in FUSIONS.items() if errors is not None},
}
SLOW_METHODS: dict[str, Callable[[_Readings], PoseTrack]] = {"refined (filterpy)": _filterpy}
"""Ways to fuse; the slow ones run on the first seed only."""
