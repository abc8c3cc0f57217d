"""Accuracy of direct kinematics, by Monte Carlo runs against the Cramér-Rao bound.

The noise is 0.05 deg on legs, roll and pitch, and 1.5 deg on a magnetic yaw.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import chi2

from controller.direct_kinematics import Solutions, required_measurements, solve_batch, solve_planar
from controller.direct_kinematics.spatial import LEG_SIGMA, TILT_SIGMA, YAW_SIGMA
from controller.direct_kinematics.synthetic import TILT, draw_measurements, draw_poses, measurements_of
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.table import Cell, Table
from plant.checks import checked_seed
from plant.errors import InputError, SingularConfigurationError
from plant.mechanism import LEGS, Mechanism
from plant.mechanism.classification import (
    MechanismClass,
    classify,
    draw_mechanism,
    draw_planar_mechanism,
    planar_classes,
    spatial_classes,
)
from plant.pose import Array, pose_errors, rms_figures, rotation_angle

Measurements = dict[str, Array]
ALL_LEGS = tuple(range(LEGS))
_TWO_LEGS = (0, 3)
_NEES_BOUNDS = 0.005, 0.995
_CLASS_POSES = 50


@dataclass(frozen=True)
class Estimator:
    """A method of direct kinematics, the legs that it uses, and whether its pose is refined."""

    label: str
    method: str
    legs: tuple[int, ...] = ALL_LEGS
    refine: bool = False


@dataclass(frozen=True)
class Errors:
    """RMS errors of an estimator [m, rad], also over the bound, and the share of poses that it solved.

    The mean NEES is 6 if the stated covariance is right and the pose refined.
    """

    position_rms: float
    rotation_rms: float
    position_over_bound: float
    rotation_over_bound: float
    nees: float
    solved: float


@dataclass(frozen=True, eq=False)
class Accuracy:
    """The errors on a mechanism; `nees_bounds` hold 99 % of the mean NEES if covariances are right."""

    mechanism: str
    mechanism_class: MechanismClass
    errors: dict[Estimator, Errors]
    poses: int
    seed: int
    nees_bounds: tuple[float, float]

    def summary(self) -> dict[str, Any]:
        """Configuration and figures, in SI units."""
        return {
            "mechanism": self.mechanism,
            "class": self.mechanism_class.label,
            "poses": self.poses,
            "seed": self.seed,
            "sigmas": {"leg": LEG_SIGMA, "tilt": TILT_SIGMA, "yaw": YAW_SIGMA},
            "nees_bounds": self.nees_bounds,
            "errors": [{**asdict(estimator), **asdict(errors)} for estimator, errors in self.errors.items()],
            "version": version("gough"),
        }


def evaluate_accuracy(mechanism: Mechanism, poses: int = 2000, seed: int = 0, engine: Engine = IN_ONE_PROCESS) -> Accuracy:
    """Errors of the paper's algorithms, and with all legs, at random poses about home.

    Raises:
        InputError: no poses, or the mechanism is in no class.
    """
    if poses < 1:
        raise InputError(f"{poses} poses were asked for; give 1 at least")
    random = np.random.default_rng(checked_seed(seed))
    positions, rotations = draw_poses(mechanism, poses, random)
    noisy = draw_measurements(mechanism, positions, rotations, random, 1.0)
    exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
    errors = dict(engine.map(partial(_errors, mechanism, positions, rotations, noisy, exact), _estimators(mechanism)))
    low, high = chi2.ppf(_NEES_BOUNDS, 6 * poses) / poses
    return Accuracy(mechanism.name, classify(mechanism), errors, poses, seed, (float(low), float(high)))


def _estimators(mechanism: Mechanism) -> list[Estimator]:
    of_class = []
    if classify(mechanism).platform_count < LEGS:
        four = _best_legs(mechanism, "section-4", 4)
        of_class.append(Estimator("paper, section 4: four legs + normal", "section-4", four))
    if classify(mechanism).group == "n-3-I":
        of_class.append(Estimator("paper, section 3.1.1: six legs alone", "section-3.1.1"))
    return [
        Estimator("paper, section 5: two legs + magnetic yaw", "section-5", _TWO_LEGS),
        Estimator("section 5, six legs + magnetic yaw", "section-5"),
        *of_class,
        Estimator("six legs alone", "legs"),
        Estimator("six legs alone, refined", "legs", refine=True),
        Estimator("six legs + vertical", "up"),
        Estimator("six legs + vertical, refined", "up", refine=True),
    ]


def _best_legs(mechanism: Mechanism, method: str, count: int) -> tuple[int, ...]:
    """The `count` legs with which the method is conditioned best near home."""
    choices, random = list(combinations(ALL_LEGS, count)), np.random.default_rng(0)
    measurements = draw_measurements(mechanism, *draw_poses(mechanism, 10, random), random, 0.0)
    found = (_run(mechanism, Estimator("", method, legs), measurements) for legs in choices)
    return choices[int(np.argmax([np.median(solutions.conditionings) for solutions in found]))]


def _run(mechanism: Mechanism, estimator: Estimator, measurements: Measurements) -> Solutions:
    given = measurements_of(estimator.method, measurements)
    given["leg_directions"] = given["leg_directions"].copy()
    given["leg_directions"][:, [leg for leg in ALL_LEGS if leg not in estimator.legs]] = np.nan
    return solve_batch(mechanism, **given, method=estimator.method, refine=estimator.refine)


def _errors(
    mechanism: Mechanism, positions: Array, rotations: Array, noisy: Measurements, exact: Measurements, estimator: Estimator
) -> tuple[Estimator, Errors]:
    found, bounds = _run(mechanism, estimator, noisy), _run(mechanism, estimator, exact).covariances
    kept = found.solved & np.isfinite(bounds[:, 0, 0])
    error = pose_errors(found.positions[kept], found.rotations[kept], positions[kept], rotations[kept])
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(found.covariances[kept], error[..., None])[..., 0])
    variances = np.diagonal(bounds[kept], axis1=1, axis2=2).reshape(-1, 2, 3).sum(axis=2).mean(axis=0)
    rms = tuple(rms_figures(error).values())
    over = rms / np.sqrt(variances)
    return estimator, Errors(*(float(value) for value in (*rms, *over, nees.mean(), kept.mean())))


@dataclass(frozen=True)
class ClassAccuracy:
    """What the paper and gough need on a class of mechanisms, and their median errors [m, rad].

    The paper's algorithm uses the legs that suit it best; gough uses all legs and refines the pose.
    """

    label: str
    drawing: str
    paper_needs: str
    paper_errors: tuple[float, float]
    alone_needs: str
    alone_errors: tuple[float, float]
    vertical_needs: str
    vertical_errors: tuple[float, float]


def evaluate_classes(
    seed: int = 0, engine: Engine = IN_ONE_PROCESS, progress: Progress = no_progress, mechanisms: int = 20
) -> list[ClassAccuracy]:
    """The needs and errors of every class, spatial and planar, over so many random mechanisms of each.

    Raises:
        InputError: the seed is out of range, or there are no mechanisms.
    """
    if mechanisms < 1:
        raise InputError(f"there are {mechanisms} mechanisms of each class; at least 1 is needed")
    numbered = [*enumerate(spatial_classes()), *enumerate(planar_classes(), start=LEGS**3)]
    return engine.starmap(partial(_evaluate_class, checked_seed(seed), mechanisms), numbered, progress)


def _evaluate_class(seed: int, mechanisms: int, number: int, mechanism_class: MechanismClass) -> ClassAccuracy:
    random = np.random.default_rng((seed, number))
    if mechanism_class.planar:
        return _evaluate_planar_class(mechanism_class, mechanisms, random)
    if mechanism_class.group == "n-3-I":
        paper_method, paper_legs, paper_needs = "section-3.1.1", 6, "6 legs"
    elif mechanism_class.platform_count < LEGS:
        paper_method, paper_legs, paper_needs = "section-4", 4, "4 legs + normal"
    else:
        paper_method, paper_legs, paper_needs = "section-5", 2, "2 legs + rotation"
    errors: dict[str, list[Array]] = {"paper": [], "legs": [], "up": []}
    for _ in range(mechanisms):
        mechanism = draw_mechanism(mechanism_class, random)
        positions, rotations = draw_poses(mechanism, _CLASS_POSES, random)
        measurements = draw_measurements(mechanism, positions, rotations, random, 1.0)
        paper = Estimator("paper", paper_method, _best_legs(mechanism, paper_method, paper_legs))
        for estimator in (paper, Estimator("legs", "legs", refine=True), Estimator("up", "up", refine=True)):
            found = _run(mechanism, estimator, measurements)
            away = np.linalg.norm(found.positions - positions, axis=1)
            angles = rotation_angle(np.where(found.solved[:, None, None], found.rotations, np.eye(3)), rotations)
            errors[estimator.label].append(np.stack([away, angles], axis=1)[found.solved])
    needs = {need.method: need.text.partition(" + ")[0] for need in required_measurements(mechanism)}
    return _class_accuracy(mechanism_class, (paper_needs, needs["legs"], needs["up"]), *errors.values())


def _evaluate_planar_class(mechanism_class: MechanismClass, mechanisms: int, random: np.random.Generator) -> ClassAccuracy:
    errors: dict[str, list[tuple[float, float]]] = {"paper": [], "alone": [], "roll": []}
    for _ in range(mechanisms):
        mechanism = draw_planar_mechanism(mechanism_class, random)
        for _ in range(_CLASS_POSES):
            position, angle = random.uniform(-0.05, 0.05, 2), random.uniform(-TILT, TILT)
            x, y = (mechanism.joints_at(position, angle) - mechanism.base_joints).T
            angles = np.arctan2(y, x) + random.normal(scale=LEG_SIGMA, size=3)
            roll = angle + random.normal(scale=TILT_SIGMA)
            apart = np.abs(np.sin(angles - np.roll(angles, 1)))
            two = angles.copy()
            two[(int(np.argmax(apart)) + 1) % 3] = np.nan
            for label, given, known in (("paper", two, roll), ("alone", angles, None), ("roll", angles, roll)):
                with suppress(SingularConfigurationError):
                    modes = solve_planar(mechanism, given, roll=known)
                    away = ((float(np.linalg.norm(mode.position - position)), abs(mode.angle - angle)) for mode in modes)
                    errors[label].append(min(away))
    return _class_accuracy(mechanism_class, ("2 legs + roll", "3 legs, two modes", "any 2 legs"), *errors.values())


def _class_accuracy(mechanism_class: MechanismClass, needs: Sequence[str], *errors: Sequence[ArrayLike]) -> ClassAccuracy:
    """From needs and errors by the paper, by legs alone, and by legs with the vertical or the roll."""
    paper, alone, vertical = (tuple(np.median(np.vstack(each), axis=0).tolist()) for each in errors)
    return ClassAccuracy(mechanism_class.label, mechanism_class.drawing, needs[0], paper, needs[1], alone, needs[2], vertical)


def class_table(rows: Sequence[ClassAccuracy]) -> Table:
    """The needs and errors of classes, in words."""

    def text(errors: tuple[float, float]) -> str:
        return f"{1e3 * errors[0]:.2f} mm, {np.degrees(errors[1]):.3f} deg"

    table = Table(
        "class", "graph", "the paper needs", "its error", "gough needs", "six legs alone", "or + vertical",
        "six legs + vertical",
    )  # fmt: skip
    for row in rows:
        table.add(
            row.label, Cell(row.drawing, code=True), row.paper_needs, text(row.paper_errors), row.alone_needs,
            text(row.alone_errors), row.vertical_needs, text(row.vertical_errors),
        )  # fmt: skip
    return table
