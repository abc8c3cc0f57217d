"""What must be measured on a mechanism for each method to give its pose, found by trying every set of legs."""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from controller.direct_kinematics.solver import METHODS
from controller.direct_kinematics.spatial import NEEDS, check_spatial, solve_batch
from controller.direct_kinematics.synthetic import draw_poses, leg_directions
from plant.mechanism import LEGS, Mechanism

_TRIAL_POSES = 8


@dataclass(frozen=True)
class Requirement:
    """What a method needs on a mechanism.

    Attributes:
        method: one of `METHODS`.
        platform: the measurement of the platform: "nothing", "up_in_platform", "normal" or "rotation".
        fewest: the least number of legs with which the method gives the pose.
        choices: the sets of that many legs that suffice.
        any_choice: the least number of legs of which every choice suffices.
    """

    method: str
    platform: str
    fewest: int
    choices: tuple[tuple[int, ...], ...]
    any_choice: int

    @property
    def text(self) -> str:
        """The legs and what else is needed, in words."""
        if len(self.choices) == 1:
            legs = f"{self.fewest} legs"
        elif self.any_choice == self.fewest:
            legs = f"any {self.fewest} legs"
        else:
            legs = f"{self.fewest} legs, {len(self.choices)} choices"
        return legs if self.platform == "nothing" else f"{legs} + {self.platform}"

    @property
    def choice_text(self) -> str:
        """The choices as numbers of legs, "012, 024"; empty if there is only one, or if every choice suffices."""
        if len(self.choices) == 1 or self.any_choice == self.fewest:
            return ""
        return ", ".join("".join(str(leg) for leg in legs) for legs in self.choices)


def required_measurements(mechanism: Mechanism) -> tuple[Requirement, ...]:
    """What each method needs on this mechanism; methods that cannot give its pose are left out.

    Every set of legs is tried at poses about home. A set suffices if it gives the pose at most of them: single poses may be
    singular.

    Raises:
        InputError: the mechanism does not have six legs.
    """
    check_spatial(mechanism)
    positions, rotations = draw_poses(mechanism, _TRIAL_POSES, np.random.default_rng(0))
    seen = leg_directions(mechanism, positions, rotations)
    sets = [legs for count in range(2, LEGS + 1) for legs in combinations(range(LEGS), count)]
    directions = np.full((len(sets), *seen.shape), np.nan)
    for legs, of_set in zip(sets, directions, strict=True):
        of_set[:, legs] = seen[:, legs]
    rotations = np.tile(rotations, (len(sets), 1, 1))
    given: dict[str, dict[str, Any]] = {
        "nothing": {},
        "rotation": {"rotation": rotations},
        "normal": {"normal": rotations[:, :, 2]},
        "up_in_platform": {"up_in_platform": mechanism.up_in_base @ rotations},
    }
    requirements = []
    for method in METHODS:
        platform = NEEDS.get(method, "nothing")
        found = solve_batch(mechanism, directions.reshape(-1, LEGS, 3), method=method, **given[platform])
        enough = found.solved.reshape(len(sets), _TRIAL_POSES).mean(axis=1) > 0.5
        if not enough.any():
            continue
        sufficient = [legs for legs, suffices in zip(sets, enough, strict=True) if suffices]
        lacking = [len(legs) for legs, suffices in zip(sets, enough, strict=True) if not suffices]
        fewest = min(len(legs) for legs in sufficient)
        choices = tuple(legs for legs in sufficient if len(legs) == fewest)
        requirements.append(Requirement(method, platform, fewest, choices, max(lacking, default=1) + 1))
    return tuple(requirements)
