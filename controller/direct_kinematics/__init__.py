"""Direct kinematics: from the directions of the legs to the pose, in closed form and without a first guess."""

from controller.direct_kinematics.lengths import pose_from_lengths, poses_from_lengths
from controller.direct_kinematics.spatial import Solution, pose_difference, solve

__all__ = ["Solution", "pose_difference", "pose_from_lengths", "poses_from_lengths", "solve"]
