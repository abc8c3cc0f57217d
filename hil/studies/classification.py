"""The class of a mechanism, and what each method of direct kinematics needs on it."""

from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import combinations
from typing import Any

import numpy as np

from controller.direct_kinematics import (
    LengthRequirement,
    Requirement,
    required_lengths,
    required_measurements,
    solve_batch,
    solve_planar,
)
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
    """Sensors that a method needs on a mechanism, how many poses it leaves, and its conditioning with all legs.

    The conditioning is given at home and at N poses; 1 is best, 0 singular.
    """

    requirement: Requirement
    modes: int
    home: float
    conditionings: Array

    @property
    def worst(self) -> float:
        """The least conditioning over these poses."""
        return float(self.conditionings.min())


@dataclass(frozen=True, eq=False)
class Description:
    """A mechanism, its class and the needs of each method; the conditioning is the worst of the poses `where`.

    `lengths` has what absolute encoders add; nothing for a planar mechanism without a home.
    """

    mechanism: Mechanism | PlanarMechanism
    mechanism_class: MechanismClass
    needs: tuple[Need, ...]
    where: str
    lengths: tuple[LengthRequirement, ...]

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
            "lengths": [asdict(need) for need in self.lengths],
            "version": version("gough"),
        }


def describe(mechanism: Mechanism | PlanarMechanism) -> Description:
    """The class of a mechanism and the needs of each method on it.

    Raises:
        InputError: the mechanism is in no class.
    """
    if isinstance(mechanism, PlanarMechanism):
        return _describe_planar(mechanism)
    mechanism_class, random = classify(mechanism), np.random.default_rng(0)
    if mechanism.limits is not None and mechanism.home is not None:
        where, poses = "the workspace", sample_workspace(mechanism, _POSES, seed=0)
    else:
        where = "poses within a sixth of the base's radius and 15 deg about home"
        poses = draw_poses(mechanism, _POSES, random)
    home = mechanism.nominal_home
    positions = np.vstack([home.position[None], poses[0]])
    rotations = np.vstack([home.rotation[None], poses[1]])
    exact = draw_measurements(mechanism, positions, rotations, random, 0.0)
    needs = []
    for requirement in required_measurements(mechanism):
        given = measurements_of(requirement.method, exact)
        found = solve_batch(mechanism, **given, method=requirement.method, refine=False)
        conditionings = np.where(found.solved, found.conditionings, 0.0)
        needs.append(Need(requirement, 1, float(conditionings[0]), conditionings[1:]))
    return Description(mechanism, mechanism_class, tuple(needs), where, required_lengths(mechanism))


def _describe_planar(mechanism: PlanarMechanism) -> Description:
    random, every = np.random.default_rng(0), tuple(range(PLANAR_LEGS))
    by_legs = Requirement("planar, legs", "nothing", PLANAR_LEGS, (every,), PLANAR_LEGS)
    by_roll = Requirement("planar, roll", "roll", 2, tuple(combinations(every, 2)), 2)
    center, across, spread = planar_home(mechanism)
    conditionings = np.zeros((_POSES + 1, 2))
    for number in range(_POSES + 1):
        reach = 0.0 if number == 0 else 1.0
        angle = reach * random.uniform(-_PLANAR_TILT, _PLANAR_TILT)
        middle = center + spread * (across + reach * random.uniform(-_PLANAR_REACH, _PLANAR_REACH, 2))
        x, y = (joints_about(mechanism, middle, angle) - mechanism.base_joints).T
        for method, roll in enumerate((None, angle)):
            with suppress(SingularConfigurationError):
                conditionings[number, method] = solve_planar(mechanism, np.arctan2(y, x), roll=roll)[0].conditioning
    (home_legs, home_roll), (of_legs, of_roll) = conditionings[0].tolist(), conditionings[1:].T
    needs = Need(by_legs, 2, home_legs, of_legs), Need(by_roll, 1, home_roll, of_roll)
    where = "poses within 15 % of the base's spread and 15 deg about a platform that stands off the base by its spread"
    lengths = () if mechanism.home is None else required_lengths(Mechanism.from_planar(mechanism))
    return Description(mechanism, classify(mechanism), needs, where, lengths)


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
