"""Benchmark of the plant: the cost of a step, and its exactness."""

from time import perf_counter_ns
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.progress import Progress, no_progress
from hil.realtime.durations import percentiles
from plant.compiled import Record, kernel
from plant.dynamics.variables import BRAKE, VELOCITY
from plant.fmu.build import SPATIAL_MODEL, default_fmu
from plant.fmu.calls import advance, read_imus, read_truth, write_command, write_drive_mode
from plant.fmu.description_reader import FmuDescription
from plant.fmu.instance import FmuInstance
from plant.fmu.plant import FmuPlant
from plant.mechanism import load_spatial
from plant.pose import Array
from plant.stopwatch import now

PERIOD_S = 1e-3
FINER = 16
"""Substeps of the reference for the error are this many times shorter."""

_SHOWN = ("p50", "p99")
_PARTS = ("set modes and commands", "step", "read IMUs", "read truth")
_FMPY_CYCLES = 2000
_BRAKED_CYCLES = 300
_BLOCK = 50


def measure_plant(duration: float, progress: Progress = no_progress) -> dict[str, Any]:
    """Drive the plant of the hexapod with sines of all legs, for this duration [s].

    Returns:
        `step_us`: of a 1 ms step from compiled code, by FMI's version. `calls_us`: of each call of a cycle (FMI 3.0).
        `cycle_us` and `fmpy_us`: medians of all calls, from compiled code and through FMPy's methods; `fmpy_slowdown`: their
        ratio. `error_m`: greatest distance from the positions with shorter substeps. `substep` [s].
    """
    commands = _commands(duration)
    parameters = load_spatial("hexapod").plant_parameters()
    driven = {}
    for fmi in (3, 2):
        with FmuPlant(default_fmu(SPATIAL_MODEL, fmi), parameters, PERIOD_S) as plant:
            driven[fmi] = _drive(plant, commands)
        progress(0.2 * (4 - fmi))
    finer = parameters | {"substep": parameters["substep"] / FINER}
    with FmuPlant(default_fmu(), finer, PERIOD_S) as plant:
        _, exact = _drive(plant, commands)
    progress(0.9)
    fmpy_us = _drive_with_fmpy(commands[:_FMPY_CYCLES])
    progress(1.0)
    times, positions = driven[3]
    cycle_us = float(np.median(times.sum(axis=1))) / 1e3
    step = _PARTS.index("step")
    return {
        "step_us": {f"FMI {fmi}": percentiles(parts[:, step], _SHOWN) for fmi, (parts, _) in driven.items()},
        "calls_us": {name: percentiles(times[:, i], _SHOWN) for i, name in enumerate(_PARTS)},
        "cycle_us": cycle_us,
        "fmpy_us": fmpy_us,
        "fmpy_slowdown": fmpy_us / cycle_us,
        "error_m": float(np.linalg.norm(positions - exact, axis=1).max()),
        "substep": float(parameters["substep"]),
        "duration": duration,
    }


def _commands(duration: float) -> Array:
    """Velocity commands (n, 6) [m/s]."""
    times = PERIOD_S * np.arange(round(duration / PERIOD_S))[:, None]
    legs = np.arange(6)
    commands: Array = 0.06 * np.sin(2.0 * np.pi * (0.4 + 0.07 * legs) * times + legs)
    return commands


def _drive(plant: FmuPlant, commands: Array) -> tuple[Array, Array]:
    """Durations of the parts [ns], means over blocks of cycles (m, 4), and positions (n, 3) [m]."""
    durations, positions = np.zeros((len(commands), len(_PARTS)), np.int64), np.zeros((len(commands), 3))
    fmu = plant.handle
    failed = write_drive_mode(fmu, BRAKE) or any(advance(fmu, PERIOD_S) for _ in range(_BRAKED_CYCLES))
    if failed or _run(fmu, commands, durations, positions, np.zeros(2, np.int64)):
        raise plant.failure()
    whole = len(commands) // _BLOCK * _BLOCK
    return durations[:whole].reshape(-1, _BLOCK, len(_PARTS)).mean(axis=1), positions


@kernel
def _run(fmu: Record, commands: Array, durations: NDArray[np.int64], positions: Array, timespec: NDArray[np.int64]) -> int:
    for i in range(commands.shape[0]):
        t0 = now(timespec)
        status = write_drive_mode(fmu, VELOCITY) | write_command(fmu, commands[i])
        t1 = now(timespec)
        status |= advance(fmu, PERIOD_S)
        t2 = now(timespec)
        status |= read_imus(fmu)
        t3 = now(timespec)
        status |= read_truth(fmu)
        t4 = now(timespec)
        durations[i, 0], durations[i, 1], durations[i, 2], durations[i, 3] = t1 - t0, t2 - t1, t3 - t2, t4 - t3
        positions[i] = fmu[()].truth[:3]
        if status != 0:
            return status
    return 0


def _drive_with_fmpy(commands: Array) -> float:
    """Median duration of a cycle [us] through FMPy's own methods."""
    description = FmuDescription(default_fmu())
    groups = []
    for names in (
        ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field"),
        ("position", "quaternion", "leg_length", "current"),
    ):
        variables = [description[name] for name in names]
        groups.append(([each.references[0] for each in variables], sum(each.size for each in variables)))
    drive_mode, velocity_command = (description[name].references[:1] for name in ("drive_mode", "velocity_command"))
    took = []
    with FmuInstance(description) as instance:
        instance.start()
        fmu = instance.fmu
        for i, command in enumerate(commands.tolist()):
            began = perf_counter_ns()
            fmu.setInt64(drive_mode, [VELOCITY] * 6)
            fmu.setFloat64(velocity_command, command)
            fmu.doStep(currentCommunicationPoint=PERIOD_S * i, communicationStepSize=PERIOD_S)
            for references, size in groups:
                fmu.getFloat64(references, nValues=size)
            took.append(perf_counter_ns() - began)
    return float(np.median(took)) / 1e3
