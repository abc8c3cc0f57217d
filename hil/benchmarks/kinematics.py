"""Benchmarks of direct kinematics: time per pose, and success from a cold start."""

import ctypes
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from controller.direct_kinematics import METHODS, pose_difference, pose_from_lengths, poses_from_lengths, solve, solve_batch
from controller.direct_kinematics.synthetic import draw_measurements, draw_poses, measurements_of
from controller.inverse_kinematics import leg_lengths, sample_workspace
from hil.progress import Progress, no_progress
from plant.errors import SingularConfigurationError, ToolchainError
from plant.fmu.build import c_compiler
from plant.mechanism import Mechanism, load_spatial
from plant.mechanism.classification import draw_mechanism, spatial_classes
from plant.pose import Array, Pose, rotation_from_vector

PRESETS = ("hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins")

_ROWS = 1000
_REPEATS = 5
_ROUNDS = 51
_YARDSTICK_ROWS = 1000
_YARDSTICK_M = 1e-9
_BATCH_ROWS = 100_000
_MOTION_S = 10.0
_COLD_STARTS = 1000
_WIDE_TILT = np.radians(60.0)
Figures = dict[str, dict[str, float]]  # by method and kind
_SAME_POSE = 1e-6, 1e-6
"""Within this distance [m] and angle [rad], two poses are the same."""


def measure_kinematics(progress: Progress = no_progress) -> dict[str, Any]:
    """Time direct kinematics and try it from cold.

    Returns:
        `solve_us`: by class and method, per pose on one core, compiled: `closed_form`, and `refined` with its covariance.
        `call_us`: one call of `solve` from Python. `batch_per_s`: poses per second on all cores. `newton`: `warm_us` per
        pose by Newton's method from lengths along a motion at 1 kHz, and the `ratios` of each method to it. `newton_in_c`:
        `warm_us` and `steps` per pose of the `Yardstick`, and by class and on `hexapod` the `ratios` to it. `cold_starts`: by
        preset, over the `workspace` and over `wide` poses (60 deg of tilt, any yaw), the shares of poses found (`success`)
        and mistaken (`wrong`), by Newton's method from home and from the leg directions.

    Raises:
        ToolchainError: no C compiler, or it failed.
    """
    hexapod = load_spatial("hexapod")
    yardstick = Yardstick(hexapod)
    classes = spatial_classes()
    steps = len(classes) + len(PRESETS) + 2
    solve_us: dict[str, Any] = {}
    ratios: dict[str, Figures] = {}
    for number, mechanism_class in enumerate(classes):
        mechanism, label = draw_mechanism(mechanism_class, np.random.default_rng(number)), mechanism_class.label
        solve_us[label], ratios[label], _ = _time_methods(mechanism, yardstick, _REPEATS)
        progress((number + 1) / steps)
    newton = _time_newton(hexapod)
    progress((len(classes) + 1) / steps)
    on_hexapod, ratios["hexapod"], newton_in_c = _time_methods(hexapod, yardstick, _ROUNDS)
    batch, call = _time_batch(hexapod)
    progress((len(classes) + 2) / steps)
    cold = {}
    for number, name in enumerate(PRESETS):
        cold[name] = _start_cold(load_spatial(name), np.random.default_rng(number))
        progress((len(classes) + 3 + number) / steps)
    return {
        "solve_us": solve_us,
        "hexapod_us": on_hexapod,
        "call_us": call,
        "batch_per_s": batch,
        "newton": {
            "warm_us": newton,
            "ratios": {method: {kind: us / newton for kind, us in times.items()} for method, times in on_hexapod.items()},
        },
        "newton_in_c": {"warm_us": newton_in_c, "steps": yardstick.steps, "ratios": ratios},
        "cold_starts": cold,
    }


class Yardstick:
    """Newton's iteration on lengths in C (`length_newton.c`), compiled by this machine's compiler with -O2: warm from the pose
    a millisecond ago, to 1e-9 m, along a motion of a mechanism with the identity as the rotation of its home.

    Attributes:
        poses: (N, 6), x, y, z [m], roll, pitch and yaw [rad] that the last run found.
        steps: per pose.

    Raises:
        ToolchainError: no C compiler, or it failed.
    """

    def __init__(self, mechanism: Mechanism) -> None:
        self.positions, self.rotations = _motion(mechanism, _YARDSTICK_ROWS)
        lengths = leg_lengths(mechanism, self.positions, self.rotations)
        self._arguments = mechanism.base_joints, mechanism.platform_joints, lengths
        self._start = np.array([*self.positions[0], 0.0, 0.0, 0.0])
        self.poses, self.steps = np.empty((_YARDSTICK_ROWS, 6)), 0.0
        with tempfile.TemporaryDirectory(prefix="gough-bench-") as folder:
            self._follow = ctypes.CDLL(str(_compiled(Path(folder)))).follow_lengths
        array = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS")
        self._follow.argtypes = [array, array, array, ctypes.c_long, ctypes.c_double, array, array]
        self._follow.restype = ctypes.c_long

    def __call__(self) -> None:
        """Find the poses of the motion."""
        steps = self._follow(*self._arguments, _YARDSTICK_ROWS, _YARDSTICK_M, self._start.copy(), self.poses)
        self.steps = steps / _YARDSTICK_ROWS


def _compiled(folder: Path) -> Path:
    """The library of the yardstick."""
    library = folder / "length_newton.so"
    with resources.as_file(resources.files("hil.benchmarks") / "length_newton.c") as source:
        command = [*c_compiler(), "-std=c11", "-O2", "-fPIC", "-shared", "-o", str(library), str(source), "-lm"]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode:
        raise ToolchainError(f"{command[0]} could not compile the yardstick: {run.stderr.strip()}")
    return library


def _median_s(work: Callable[[], object]) -> float:
    """Median duration of some work [s]."""
    runs = []
    for _ in range(_REPEATS):
        began = perf_counter()
        work()
        runs.append(perf_counter() - began)
    return float(np.median(runs))


def _time_methods(mechanism: Mechanism, yardstick: Yardstick, rounds: int) -> tuple[Figures, Figures, float]:
    """Time every method that works on a mechanism and the yardstick in turns, by this thread's time on the processor.

    Returns:
        Microseconds per pose by method and kind, their ratios to the yardstick, each the median of those to its slice of the
        same round, and the yardstick's microseconds per pose.
    """
    runs = _runs(mechanism)
    turns: list[Callable[[], Any]] = [yardstick, *runs.values()]
    slices = np.array([[_thread_s(turn) for turn in turns] for _ in range(rounds)])
    slices *= 1e6 / np.array([_YARDSTICK_ROWS, *[_ROWS] * len(runs)])
    times: Figures = {}
    ratios: Figures = {}
    medians = np.median(slices, axis=0), np.median(slices / slices[:, :1], axis=0)
    for figures, found in zip((times, ratios), medians, strict=True):
        for (method, kind), figure in zip(runs, found[1:], strict=True):
            figures.setdefault(method, {})[kind] = float(figure)
    return times, ratios, float(medians[0][0])


def _thread_s(work: Callable[[], object]) -> float:
    """Duration of some work [s] without the time that other programs had the processor."""
    began = thread_time()
    work()
    return thread_time() - began


def _runs(mechanism: Mechanism) -> dict[tuple[str, str], Callable[[], Any]]:
    """A batch of poses on one core, by method that works on the mechanism and by kind."""
    measurements = _measure(mechanism, _ROWS)
    runs: dict[tuple[str, str], Callable[[], Any]] = {}
    for method in METHODS:
        for kind, refine in (("closed_form", False), ("refined", True)):
            given = measurements_of(method, measurements)
            run = partial(solve_batch, mechanism, **given, method=method, refine=refine, workers=1)
            # The first run may compile.
            if run().solved.mean() > 0.5:
                runs[method, kind] = run
    return runs


def _measure(mechanism: Mechanism, count: int) -> dict[str, Array]:
    random = np.random.default_rng(0)
    return draw_measurements(mechanism, *draw_poses(mechanism, count, random), random, 1.0)


def _time_batch(mechanism: Mechanism) -> tuple[dict[str, float], float]:
    """Poses per second of a refined batch by method, and microseconds of a call of `solve`."""
    measurements = _measure(mechanism, _BATCH_ROWS)
    rates = {}
    for method in ("section-5", "up", "normal", "legs"):
        given = measurements_of(method, measurements)
        rates[method] = _BATCH_ROWS / _median_s(partial(solve_batch, mechanism, **given, method=method))
    calls = []
    for directions, up in zip(measurements["leg_directions"][:_ROWS], measurements["up_in_platform"], strict=False):
        start = perf_counter()
        solve(mechanism, directions, up_in_platform=up)
        calls.append(perf_counter() - start)
    return rates, 1e6 * float(np.median(calls))


def _time_newton(mechanism: Mechanism) -> float:
    """Microseconds per pose of Newton's method, each started from the pose before."""
    positions, rotations = _motion(mechanism, round(1e3 * _MOTION_S))
    lengths = leg_lengths(mechanism, positions, rotations)
    run = partial(poses_from_lengths, mechanism, lengths, Pose(positions[0], rotations[0]))
    return 1e6 * float(np.median([_thread_s(run) for _ in range(_REPEATS)])) / len(positions)


def _motion(mechanism: Mechanism, count: int) -> tuple[Array, Array]:
    """Positions (count, 3) [m] and rotations (count, 3, 3) of a motion from home on, a millisecond apart."""
    home = mechanism.require_home()
    swings = np.sin(2e-3 * np.pi * np.arange(count)[:, None] * [0.9, 0.7, 0.5, 0.8, 0.6, 1.0])
    positions = home.position + 0.02 * swings[:, :3]
    return positions, np.array([rotation_from_vector(0.05 * swing) for swing in swings[:, 3:]]) @ home.rotation


def _start_cold(mechanism: Mechanism, random: np.random.Generator) -> dict[str, Any]:
    home = mechanism.require_home()
    turns = np.array(
        [
            rotation_from_vector([0.0, 0.0, yaw]) @ rotation_from_vector([tilt * np.cos(way), tilt * np.sin(way), 0.0])
            for tilt, way, yaw in random.uniform([0.0, -np.pi, -np.pi], [_WIDE_TILT, np.pi, np.pi], (_COLD_STARTS, 3))
        ]
    )
    legs = home.position + mechanism.platform_joints - mechanism.base_joints
    reach = 0.3 * float(np.median(np.linalg.norm(legs, axis=1)))
    wide = home.position + random.uniform(-reach, reach, (_COLD_STARTS, 3)), turns @ home.rotation
    figures = {}
    ranges = {"workspace": sample_workspace(mechanism, _COLD_STARTS, seed=0), "wide": wide}
    for name, (positions, rotations) in ranges.items():
        exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
        found = solve_batch(mechanism, exact["leg_directions"])
        ours = [found[i] if found.solved[i] else None for i in range(_COLD_STARTS)]
        newton: list[Pose | None] = []
        for lengths in leg_lengths(mechanism, positions, rotations):
            try:
                newton.append(pose_from_lengths(mechanism, lengths))
            except SingularConfigurationError:
                newton.append(None)
        truth = [Pose(position, rotation) for position, rotation in zip(positions, rotations, strict=True)]
        figures[name] = {"newton": _score(newton, truth), "directions": _score(ours, truth)}
    return figures


def _score(found: Sequence[Any], truth: Sequence[Pose]) -> dict[str, float]:
    pairs = [(pose, true_pose) for pose, true_pose in zip(found, truth, strict=True) if pose is not None]
    differences = np.array([pose_difference(*pair) for pair in pairs]).reshape(-1, 2)
    right = int((differences < _SAME_POSE).all(axis=1).sum())
    return {"success": right / len(truth), "wrong": (len(pairs) - right) / len(truth)}
