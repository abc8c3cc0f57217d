"""The class of a mechanism, and what each method of direct kinematics needs on it: sensors, uniqueness, conditioning."""

from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from controller.direct_kinematics import Requirement, required_measurements, solve_batch, solve_planar
from controller.direct_kinematics.synthetic import draw_measurements, draw_poses, measurements_of
from controller.inverse_kinematics import sample_workspace
from plant.errors import SingularConfigurationError
from plant.mechanism import Mechanism
from plant.mechanism.classification import MechanismClass, classify, joint_numbers
from plant.mechanism.planar import PLANAR_LEGS, PlanarMechanism
from plant.pose import Array

_POSES = 1000
_PLANAR_REACH, _PLANAR_TILT = 0.15, np.radians(15.0)

PAPER = {"section-3.1.1": "3.1.1", "section-4": "4", "section-5": "5", "planar, roll": "6"}
"""The section of the paper that each of its methods comes from."""


@dataclass(frozen=True, eq=False)
class Need:
    """Needs and conditioning of a method on a mechanism.

    Attributes:
        requirement: sensors that it needs.
        modes: number of poses that it leaves possible.
        home: conditioning at home with all legs; 1 is best, 0 singular.
        worst: least conditioning over many poses.
        conditionings: (N,), at these poses.
    """

    requirement: Requirement
    modes: int
    home: float
    worst: float
    conditionings: Array


@dataclass(frozen=True, eq=False)
class Description:
    """A mechanism, its class and the needs of each method; `where` names the poses that the conditioning is the worst of."""

    mechanism: Mechanism | PlanarMechanism
    mechanism_class: MechanismClass
    needs: tuple[Need, ...]
    where: str

    def summary(self) -> dict[str, Any]:
        """Everything, for JSON."""
        mechanism = self.mechanism
        return {
            "mechanism": mechanism.name,
            "class": self.mechanism_class.label,
            "name": self.mechanism_class.name,
            "drawing": self.mechanism_class.drawing,
            "base_joints": joint_numbers(mechanism.base_joints).tolist(),
            "platform_joints": joint_numbers(mechanism.platform_joints).tolist(),
            "poses": self.where,
            "methods": [
                {
                    **asdict(need.requirement),
                    "section": PAPER.get(need.requirement.method),
                    "modes": need.modes,
                    "conditioning_home": need.home,
                    "conditioning_worst": need.worst,
                }
                for need in self.needs
            ],
            "version": version("gough"),
        }


def describe(mechanism: Mechanism | PlanarMechanism) -> Description:
    """The class of a mechanism and the needs of each method on it.

    Raises:
        InputError: the mechanism is in no class.
    """
    if isinstance(mechanism, PlanarMechanism):
        return _describe_planar(mechanism)
    mechanism_class = classify(mechanism)
    random = np.random.default_rng(0)
    if mechanism.limits is not None and mechanism.home is not None:
        where = "the workspace"
        poses = sample_workspace(mechanism, _POSES, seed=0)
    else:
        where = "poses within a sixth of the base's radius and 15 deg about home"
        poses = draw_poses(mechanism, _POSES, random)
    home = mechanism.nominal_home
    positions = np.concatenate([home.position[None], poses[0]])
    rotations = np.concatenate([home.rotation[None], poses[1]])
    exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
    needs = []
    for requirement in required_measurements(mechanism):
        given = measurements_of(requirement.method, exact)
        found = solve_batch(mechanism, **given, method=requirement.method, refine=False)
        conditionings = np.where(found.solved, found.conditionings, 0.0)
        needs.append(Need(requirement, 1, float(conditionings[0]), float(conditionings[1:].min()), conditionings[1:]))
    return Description(mechanism, mechanism_class, tuple(needs), where)


def _describe_planar(mechanism: PlanarMechanism) -> Description:
    random = np.random.default_rng(0)
    center, across, spread = planar_home(mechanism)
    values: dict[str, list[float]] = {"planar, legs": [], "planar, roll": []}
    for number in range(_POSES + 1):
        reach = 0.0 if number == 0 else 1.0
        angle = reach * random.uniform(-_PLANAR_TILT, _PLANAR_TILT)
        middle = center + spread * (across + reach * random.uniform(-_PLANAR_REACH, _PLANAR_REACH, 2))
        x, y = (joints_about(mechanism, middle, angle) - mechanism.base_joints).T
        for method, roll in (("planar, legs", None), ("planar, roll", angle)):
            try:
                values[method].append(solve_planar(mechanism, np.arctan2(y, x), roll=roll)[0].conditioning)
            except SingularConfigurationError:
                values[method].append(0.0)
    every = tuple(range(PLANAR_LEGS))
    pairs = tuple((i, j) for i in every for j in every[i + 1 :])
    requirements = {
        "planar, legs": Requirement("planar, legs", "nothing", PLANAR_LEGS, (every,), PLANAR_LEGS),
        "planar, roll": Requirement("planar, roll", "roll", 2, pairs, 2),
    }
    needs = tuple(
        Need(requirements[method], 2 if method == "planar, legs" else 1, found[0], min(found[1:]), np.array(found[1:]))
        for method, found in values.items()
    )
    where = "poses within 15 % of the base's spread and 15 deg about a platform that stands off the base by its spread"
    return Description(mechanism, classify(mechanism), needs, where)


def planar_home(mechanism: PlanarMechanism) -> tuple[Array, Array, float]:
    """Centre of the base joints (2,) [m], the unit vector (2,) across them, and their spread [m]."""
    center = mechanism.base_joints.mean(axis=0)
    _, spread, axes = np.linalg.svd(mechanism.base_joints - center)
    across = axes[1] * np.sign(axes[1, 1] or 1.0)
    return center, across, float(np.linalg.norm(spread))


def joints_about(mechanism: PlanarMechanism, middle: Array, angle: float) -> Array:
    """The platform joints (3, 2) [m] with their centre at `middle` (2,) [m]."""
    joints = mechanism.joints_at(np.zeros(2), angle)
    moved: Array = joints - joints.mean(axis=0) + middle
    return moved
