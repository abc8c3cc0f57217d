"""Direct kinematics: from the directions of the legs to the pose, in closed form and without a first guess.

`solve` and `solve_batch` take six legs, `solve_planar` three in the plane. `required_measurements` says what to measure, and
`required_lengths` how many encoders beside; `integrity` which measurement is wrong. `pose_from_lengths` is for rigs with
encoders.
"""

from controller.direct_kinematics.consistency import Integrity, LengthCheck, cross_check, integrity
from controller.direct_kinematics.lengths import pose_from_lengths, poses_from_lengths
from controller.direct_kinematics.planar import AssemblyMode, solve_planar
from controller.direct_kinematics.requirements import (
    LengthRequirement,
    Requirement,
    required_lengths,
    required_measurements,
)
from controller.direct_kinematics.solver import METHODS
from controller.direct_kinematics.spatial import NEEDS, Solution, Solutions, pose_difference, solve, solve_batch

__all__ = [
    "METHODS",
    "NEEDS",
    "AssemblyMode",
    "Integrity",
    "LengthCheck",
    "LengthRequirement",
    "Requirement",
    "Solution",
    "Solutions",
    "cross_check",
    "integrity",
    "pose_difference",
    "pose_from_lengths",
    "poses_from_lengths",
    "required_lengths",
    "required_measurements",
    "solve",
    "solve_batch",
    "solve_planar",
]
