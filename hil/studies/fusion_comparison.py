"""Comparison of every way to fuse the IMUs on one imposed motion: errors, consistency and cost, side by side.

The platform is moved as prescribed (`plant.dynamics.imposed`), whatever actuators could follow; all methods get the same raw
readings. The first twenty seconds do not count: the filters may learn.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vqf import VQF

from controller.calibration.file import Calibration, load_calibration
from controller.cycle import ALL_IMUS, STATE, check_rate, cycle_parameters
from controller.direct_kinematics import solve_batch
from controller.estimation.fusion import (
    calibrate,
    find_pose,
    fuse_heading,
    fuse_legs,
    fuse_mechanism,
    fuse_platform,
    improve_pose,
)
from controller.estimation.leg_filter import leg_direction, start_leg
from controller.estimation.mechanism_filter import extrapolate_covariance
from controller.settings import control_settings, sensor_settings
from hil.realtime.clock import now
from hil.runs.simulation import FUSIONS, filterpy_filters
from plant.compiled import Record, kernel
from plant.dynamics.imposed import ImposedMotion, impose
from plant.dynamics.variables import IMU_COUNT, PLATFORM_IMU
from plant.errors import InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, ImuModel, imu_state, load_imu, measure
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.pose import Array, vector_from_rotation

LEARNING_S = 20.0
CLOSED, REFINED, WHOLE, LEGS_ALONE = range(4)
"""Steps of `Found`."""


@dataclass(frozen=True)
class ComparisonConfig:
    """What to compare on.

    Attributes:
        mechanism: preset or TOML file.
        motion: "static", "mixed", or a frequency in Hz.
        duration: [s], of which the first twenty seconds do not count.
        rate: samples per second [Hz].
        imu: preset of the imperfections.
        calibration: file with the IMUs' constants.
        seeds: of imperfections, motions and noise; errors are pooled over them.
    """

    mechanism: str = "hexapod"
    motion: str = "1"
    duration: float = 40.0
    rate: float = 1000.0
    imu: str = "mpu9150-calibrated"
    calibration: str | None = None
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4, 5)

    def __post_init__(self) -> None:
        check_rate(self.rate)
        if not LEARNING_S < self.duration < 3600.0:
            raise InputError(f"the duration is {self.duration:g} s; it must be more than {LEARNING_S:g} s, which do not count")
        if not self.seeds:
            raise InputError("there must be a seed at least")


@dataclass(eq=False)
class _Errors:
    """What a method has gathered, by seed: mean squares of position [m^2] and rotation [rad^2], NEES, cycle times [us]."""

    squares: list[tuple[float, float]]
    nees: list[float]
    us: list[float]

    def figures(self) -> dict[str, Any]:
        position, rotation = np.sqrt(np.mean(self.squares, axis=0))
        return {
            "position_rms": float(position),
            "rotation_rms": float(rotation),
            "nees": float(np.mean(self.nees)) if self.nees else None,
            "us": float(np.median(self.us)) if self.us else None,
            "seeds": len(self.squares),
        }


def compare(config: ComparisonConfig, progress: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
    """Run every method.

    Args:
        config: what to compare on.
        progress: called with the share that is done.

    Returns:
        `methods`: by name, `position_rms` [m], `rotation_rms` [rad], `nees` (6 is consistent; None without a covariance), `us`,
        the median time of a cycle from raw sample to pose, and the number of `seeds`; `config` and `version`.

    Raises:
        GoughError: something in the configuration cannot be used.
    """
    mechanism, model = load_spatial(config.mechanism), load_imu(config.imu)
    calibration = Calibration() if config.calibration is None else load_calibration(config.calibration)
    errors: dict[str, _Errors] = {}
    late = slice(round(LEARNING_S * config.rate), None)
    for i, seed in enumerate(config.seeds):
        motion = impose(mechanism, config.motion, config.duration, config.rate, seed)
        readings = _Readings(mechanism.moved_joints(calibration.joints), model, calibration, config.rate, seed, motion)
        methods = {**METHODS, **(SLOW_METHODS if i == 0 else {})}
        for k, (name, method) in enumerate(methods.items()):
            run = method(readings)
            each = errors.setdefault(name, _Errors([], [], []))
            error = pose_errors(run.positions, run.rotations, motion)[late]
            each.squares.append(
                (float(np.mean(np.sum(error[:, :3] ** 2, axis=1))), float(np.mean(np.sum(error[:, 3:] ** 2, axis=1))))
            )
            if (nees := run.nees(error, late)) is not None:
                each.nees.append(nees)
            if run.us is not None:
                each.us.append(run.us)
            progress((i + (k + 1) / len(methods)) / len(config.seeds))
    return {
        "methods": {name: each.figures() for name, each in errors.items()},
        "config": asdict(config),
        "version": version("gough"),
    }


@dataclass(frozen=True, eq=False)
class _Run:
    """Poses (N, 3), (N, 3, 3), with their covariance (N, 6, 6) or its inverse, and the median time of a cycle [us], if any."""

    positions: Array
    rotations: Array
    information: Array | None = None
    covariance: Array | None = None
    us: float | None = None

    def nees(self, errors: Array, late: slice) -> float | None:
        """Mean square of the late errors (n, 6) over their covariance; 6 is consistent."""
        if self.information is not None:
            information = self.information[late]
        elif self.covariance is not None:
            information = np.linalg.inv(self.covariance[late])
        else:
            return None
        return float(np.einsum("ni,nij,nj->n", errors, information, errors).mean())


def pose_errors(positions: Array, rotations: Array, motion: ImposedMotion) -> Array:
    """Errors (N, 6) of poses (N, 3), (N, 3, 3): of position, and rotation vectors in {1}."""
    turned = vector_from_rotation(rotations @ np.swapaxes(motion.rotations, 1, 2))
    return np.concatenate([positions - motion.positions, turned], axis=1)


class _Readings:
    """What all methods get: raw readings of one motion; and what the cycle makes of them, by the way to fuse."""

    def __init__(
        self, mechanism: Mechanism, model: ImuModel, calibration: Calibration, rate: float, seed: int, motion: ImposedMotion
    ) -> None:
        self.mechanism, self.rate, self.count = mechanism, rate, len(motion.times)
        self._fusion, self._calibration = sensor_settings(mechanism, model), calibration
        self.raw = read(motion, model, rate, seed)
        self.calibrated = calibration.apply(self.raw)
        self._found: dict[str | None, Found] = {}

    def parameters(self, errors: str | None, section_5: bool = False) -> Record:
        """The cycle's constants."""
        control, imus = control_settings(self.mechanism), ALL_IMUS
        return cycle_parameters(
            self.mechanism, self.rate, control, self._fusion, imus, errors, self._calibration, section_5, section_5
        )

    def run(self, errors: str) -> _Run:
        """The poses of the whole-mechanism filter for these errors."""
        return self.found(errors).run(WHOLE)

    def found(self, errors: str | None) -> "Found":
        """What the cycle finds with the whole-mechanism filter for these errors, or without it."""
        if errors not in self._found:
            self._found[errors] = fuse(self.parameters(errors), self.raw)
        return self._found[errors]


class Found:
    """What the fusing steps find.

    By step (closed form, refined, whole mechanism) positions and rotations; the refined pose's inverse covariance and the
    filter's covariance; the leg filters' directions with the covariances (N, 6, 2, 2) of their angles, the platform's vertical
    with its covariance; nanoseconds until each step was done, and of the leg filters alone.
    """

    def __init__(self, count: int) -> None:
        self.positions, self.rotations = np.zeros((3, count, 3)), np.zeros((3, count, 3, 3))
        self.information, self.covariances = np.zeros((count, 6, 6)), np.zeros((count, 6, 6))
        self.directions, self.verticals = np.zeros((count, LEGS, 3)), np.zeros((count, 3))
        self.leg_covariances, self.vertical_covariances = np.zeros((count, LEGS, 2, 2)), np.zeros((count, 3, 3))
        self.ns = np.zeros((4, count), np.int64)

    def run(self, step: int) -> _Run:
        """One step's poses."""
        information = self.information if step == REFINED else None
        covariance = self.covariances if step == WHOLE else None
        us = float(np.median(self.ns[step])) / 1e3
        return _Run(self.positions[step], self.rotations[step], information, covariance, us)


def read(motion: ImposedMotion, model: ImuModel, rate: float, seed: int) -> Array:
    """What imperfect IMUs read on a motion (N, 3, 7, 3), at this rate [Hz]."""
    raw = np.empty_like(motion.signals)
    measure_all(imu_state(model, seed, 1.0 / rate), motion.signals, raw)
    return raw


def fuse(parameters: Record, raw: Array, state: Record | None = None) -> Found:
    """The fusing steps of the cycle over raw readings (N, 3, 7, 3), going on from a state, if there is one."""
    found, state = Found(len(raw)), np.zeros((), STATE) if state is None else state
    _follow(
        parameters, state, raw, found.positions, found.rotations, found.information, found.covariances, found.directions,
        found.leg_covariances, found.verticals, found.vertical_covariances, found.ns, np.zeros(2, np.int64),
    )  # fmt: skip
    return found


@kernel
def measure_all(imu: Record, signals: Array, raw: Array) -> None:
    """Write what imperfect IMUs read (N, 3, 7, 3) for ideal signals."""
    for i in range(signals.shape[0]):
        measure(imu, signals[i], raw[i])


@kernel
def _follow(
    parameters: Record, state: Record, raw: Array, positions: Array, rotations: Array, information: Array, covariances: Array,
    directions: Array, leg_covariances: Array, verticals: Array, vertical_covariances: Array, ns: NDArray[np.int64],
    timespec: NDArray[np.int64],
) -> None:  # fmt: skip
    s = state[()]
    for i in range(raw.shape[0]):
        began = now(timespec)
        calibrate(parameters, state, raw[i])
        before_legs = now(timespec)
        fuse_legs(parameters, state)
        ns[LEGS_ALONE, i] = now(timespec) - before_legs
        fuse_platform(parameters, state)
        fuse_heading(parameters, state)
        find_pose(parameters, state)
        ns[0, i] = now(timespec) - began
        positions[0, i], rotations[0, i] = s.position, s.rotation
        directions[i], verticals[i] = s.directions, s.vectors[0]
        leg_covariances[i], vertical_covariances[i] = s.leg_covariance[:, :2, :2], s.platform_covariance[:3, :3]
        began = now(timespec)
        improve_pose(parameters, state)
        ns[1, i] = ns[0, i] + now(timespec) - began
        positions[1, i], rotations[1, i] = s.position, s.rotation
        for j in range(6):
            for k in range(6):
                information[i, j, k] = s.information[max(j, k), min(j, k)]
        began = now(timespec)
        fuse_mechanism(parameters, state, True)
        ns[2, i] = ns[1, i] + now(timespec) - began
        positions[2, i], rotations[2, i] = s.position, s.rotation
        extrapolate_covariance(parameters[()].filter, s.filter, s.cycle * parameters[()].period, covariances[i])
        s.cycle += 1


def _section_5(readings: _Readings) -> _Run:
    """The paper's algorithm: leg directions, and all of the platform's orientation, with the heading of its magnetometer."""
    run = fuse(readings.parameters(None, section_5=True), readings.raw).run(CLOSED)
    return _Run(run.positions, run.rotations, us=run.us)


def _vqf(readings: _Readings) -> _Run:
    """The `vqf` package for each IMU by itself, which knows neither joints nor what the platform does; and the refinement."""
    period, began = 1.0 / readings.rate, time.perf_counter()
    ups = np.empty((IMU_COUNT, readings.count, 3))
    for imu in range(IMU_COUNT):
        rates, forces = (np.ascontiguousarray(readings.calibrated[:, sensor, imu]) for sensor in (GYROSCOPE, ACCELEROMETER))
        ups[imu] = vqf_verticals(period, rates, forces)
    us = 1e6 * (time.perf_counter() - began) / readings.count
    directions = np.empty((readings.count, LEGS, 3))
    _point(readings.parameters(None), ups, directions)
    solutions = solve_batch(readings.mechanism, directions, up_in_platform=ups[PLATFORM_IMU])
    return _Run(solutions.positions, solutions.rotations, us=us)


def vqf_verticals(period: float, rates: Array, forces: Array) -> Array:
    """The unit vertical (N, 3) in the IMU's frame, as `vqf` finds it from rates and forces (N, 3), `period` [s] apart."""
    w, x, y, z = VQF(period).updateBatch(rates, forces)["quat6D"].T
    return np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)], axis=1)


@kernel
def _point(parameters: Record, ups: Array, directions: Array) -> None:
    """Directions (N, 6, 3) of legs on their joints that see the vertical as `ups` (7, N, 3)."""
    sensors = parameters[()].sensors
    x, covariance, still, rate = np.zeros(9), np.zeros((9, 9)), np.zeros(3), np.zeros(3)
    for k in range(LEGS):
        for i in range(directions.shape[0]):
            start_leg(x, covariance, still, ups[k, i], sensors.up_in_joint[k], 1.0)
            leg_direction(x, sensors.joint_rotations[k], 0.0, directions[i, k], rate)


def _filterpy(readings: _Readings) -> _Run:
    """The refined pose with the filters of legs and platform on filterpy."""
    parameters, state = readings.parameters(None), np.zeros((), STATE)
    filters, found, ns = filterpy_filters(parameters), Found(readings.count), np.zeros(readings.count, np.int64)
    for i, raw in enumerate(readings.raw):
        began = time.perf_counter_ns()
        calibrate(parameters, state, raw)
        filters.fuse_legs(state)
        filters.fuse_platform(state)
        find_pose(parameters, state)
        improve_pose(parameters, state)
        ns[i] = time.perf_counter_ns() - began
        found.positions[REFINED, i], found.rotations[REFINED, i] = state["position"], state["rotation"]
        lower = np.tril(state["information"])
        found.information[i] = lower + np.tril(lower, -1).T
        state["cycle"] += 1
    found.ns[REFINED] = ns
    return found.run(REFINED)


METHODS: dict[str, Callable[[_Readings], _Run]] = {
    "section 5, magnetometer": _section_5,
    "vqf per IMU, refined": _vqf,
    "legs + vertical": lambda readings: readings.found(None).run(CLOSED),
    "refined (compiled)": lambda readings: readings.found(None).run(REFINED),
    **{name: partial(_Readings.run, errors=errors) for name, errors in FUSIONS.items() if errors is not None},
}
SLOW_METHODS: dict[str, Callable[[_Readings], _Run]] = {"refined (filterpy)": _filterpy}
"""Ways to fuse; the slow ones are tried with the first seed only."""
