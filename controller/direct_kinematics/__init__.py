"""Direct kinematics: from the directions of the legs to the pose, in closed form and without a first guess."""

from controller.direct_kinematics.consistency import Integrity, LengthCheck, cross_check, integrity
from controller.direct_kinematics.lengths import pose_from_lengths, poses_from_lengths
from controller.direct_kinematics.planar import AssemblyMode, solve_planar
from controller.direct_kinematics.spatial import (
    METHODS,
    Requirement,
    Solution,
    Solutions,
    pose_difference,
    required_measurements,
    solve,
    solve_batch,
)

__all__ = [
    "METHODS",
    "AssemblyMode",
    "Integrity",
    "LengthCheck",
    "Requirement",
    "Solution",
    "Solutions",
    "cross_check",
    "integrity",
    "pose_difference",
    "pose_from_lengths",
    "poses_from_lengths",
    "required_measurements",
    "solve",
    "solve_batch",
    "solve_planar",
]
