"""What must be measured on a mechanism for each method to give its pose, found by trying every set of legs."""

from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from controller.direct_kinematics.solver import METHODS
from controller.direct_kinematics.spatial import NEEDS, check_spatial, solve_batch
from controller.direct_kinematics.synthetic import draw_poses, leg_directions
from controller.inverse_kinematics import inverse_kinematics, sample_workspace
from plant.mechanism import LEGS, Mechanism
from plant.pose import Array, Pose

_TRIAL_POSES = 8

_IN_PLANE = [0, 1, 5]
_PLATFORMS = ("nothing", "up_in_platform", "rotation")
_LEAST_SINGULAR = 1e-2
"""Least singular value with which sensors tell every direction in which the platform can move; 1 is a length that changes as
far as the platform moves, or a direction that turns as far as it does.
"""


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


@dataclass(frozen=True)
class LengthRequirement:
    """How many absolute encoders are needed beside IMUs, for a pose that is found from a first guess.

    Attributes:
        platform: the measurement of the platform: "nothing", "up_in_platform" or "rotation".
        legs: the number of legs with an IMU.
        fewest: the least number of legs with an encoder, if IMUs and encoders sit on the best ones.
        any_choice: the least number that suffices wherever they sit; None if not even all do.
    """

    platform: str
    legs: int
    fewest: int
    any_choice: int | None


def required_lengths(mechanism: Mechanism) -> tuple[LengthRequirement, ...]:
    """How many absolute encoders a mechanism of six legs, or a planar one seen in space, needs beside each number of leg IMUs.

    Sensors suffice if they tell every direction in which the platform can move, at each of some poses about home. Then least
    squares find the pose from a first guess; other poses may have the same readings. Rows without an encoder end the list of a
    platform's measurement.
    """
    poses = (
        draw_poses(mechanism, _TRIAL_POSES, np.random.default_rng(0))
        if mechanism.limits is None or mechanism.home is None
        else sample_workspace(mechanism, _TRIAL_POSES, seed=0)
    )
    least = np.min([_least_singular_values(mechanism, Pose(*pose)) for pose in zip(*poses, strict=True)], axis=0)
    enough, counts = least > _LEAST_SINGULAR, np.array([bin(chosen).count("1") for chosen in range(2**mechanism.legs)])
    numbers, found = range(mechanism.legs + 1), []
    for platform, of_platform in zip(_PLATFORMS, enough, strict=True):
        for legs in numbers:
            rows = of_platform[counts == legs]
            sufficient = [lengths for lengths in numbers if rows[:, counts == lengths].any()]
            always = [lengths for lengths in numbers if rows[:, counts == lengths].all()]
            if sufficient:
                found.append(LengthRequirement(platform, legs, sufficient[0], always[0] if always else None))
                if sufficient[0] == 0:
                    break
    return tuple(found)


def _least_singular_values(mechanism: Mechanism, pose: Pose) -> Array:
    """(3, 2^n, 2^n): at a pose, for each measurement of the platform, each set of leg IMUs and each set of encoders."""
    legs = inverse_kinematics(mechanism, pose)
    arms = mechanism.platform_joints @ pose.rotation.T
    scale = np.diag([_spread(mechanism)] * 3 + [1.0] * 3)
    # With J = [I, -skew(arm)], a direction d turns by (I - d d^T) J / length, and the length changes by d^T J.
    moves = np.stack([np.hstack([np.eye(3), -_skew(arm)]) for arm in arms]) @ scale
    along = legs.directions[:, :, None] @ (legs.directions[:, None] @ moves)
    of_imus = [sideways.T @ sideways / length**2 for sideways, length in zip(moves - along, legs.lengths, strict=True)]
    of_lengths = [move.T @ move / scale[0, 0] ** 2 for move in along]
    tilt = np.zeros((6, 6))
    tilt[3:, 3:] = np.eye(3) - np.outer(mechanism.up_in_base, mechanism.up_in_base)
    rotation = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])
    chosen = np.arange(2**mechanism.legs)[:, None] >> np.arange(mechanism.legs) & 1
    imus, lengths = (np.einsum("sk,kij->sij", chosen, each) for each in (of_imus, of_lengths))
    platform = np.stack([np.zeros((6, 6)), tilt, rotation])
    information = platform[:, None, None] + imus[:, None] + lengths
    if mechanism.planar:
        information = information[..., _IN_PLANE, :][..., _IN_PLANE]
    least: Array = np.sqrt(np.maximum(np.linalg.eigvalsh(information)[..., 0], 0.0))
    return least


def length_conditionings(mechanism: Mechanism, positions: Array, rotations: Array) -> Array:
    """How much the lengths of all legs change at least (N,), if the platform moves by 1, at positions (N, 3) [m] and rotations
    (N, 3, 3). Turns count at the joints' spread.
    """
    scale = np.array([_spread(mechanism)] * 3 + [1.0] * 3) / _spread(mechanism)
    poses = zip(positions, rotations, strict=True)
    jacobians = np.array([inverse_kinematics(mechanism, Pose(*pose)).jacobian for pose in poses])
    moving = (jacobians * scale)[:, :, _IN_PLANE if mechanism.planar else slice(None)]
    least: Array = np.linalg.svd(moving, compute_uv=False)[:, -1]
    return least


def _spread(mechanism: Mechanism) -> float:
    """The greatest distance of a platform joint from their centre [m]."""
    joints = mechanism.platform_joints
    return float(np.linalg.norm(joints - joints.mean(axis=0), axis=1).max())


def _skew(vector: Array) -> Array:
    """The matrix of the cross product with a vector (3,)."""
    matrix: Array = np.cross(np.eye(3), vector)
    return matrix
