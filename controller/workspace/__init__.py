"""Where a mechanism can go: margins of poses, travel along a direction, and the largest region about a pose."""

from controller.pose_limits import GEOMETRY_ALONE, KINDS, LIMITS, Demands, Limit, Margins, margins, margins_at
from controller.workspace.check import (
    Excess,
    PoseGuard,
    TargetCheck,
    check_against_limits,
    closest_limits,
    first_excess,
    load_check,
    pose_text,
)
from controller.workspace.extent import (
    AXES,
    Reach,
    Region,
    Slice,
    largest_box,
    largest_ellipsoid,
    poses_about,
    reach_from,
    slice_about,
)
from controller.workspace.figures import geometry_figures
from controller.workspace.nearest import Nearest, nearest_reachable
from controller.workspace.travel import Travel, pose_along, travel, travels

__all__ = [
    "AXES",
    "GEOMETRY_ALONE",
    "KINDS",
    "LIMITS",
    "Demands",
    "Excess",
    "Limit",
    "Margins",
    "Nearest",
    "PoseGuard",
    "Reach",
    "Region",
    "Slice",
    "TargetCheck",
    "Travel",
    "check_against_limits",
    "closest_limits",
    "first_excess",
    "geometry_figures",
    "largest_box",
    "largest_ellipsoid",
    "load_check",
    "margins",
    "margins_at",
    "nearest_reachable",
    "pose_along",
    "pose_text",
    "poses_about",
    "reach_from",
    "slice_about",
    "travel",
    "travels",
]
