"""What limits the poses of a mechanism: strokes, swings of joints, clearances, forces and conditioning; and how far a pose is
from each.
"""

from controller.pose_limits.limits import GEOMETRY_ALONE, KINDS, LIMITS, USUAL, Demands, Limit
from controller.pose_limits.margins import Margins, margins, margins_at

__all__ = ["GEOMETRY_ALONE", "KINDS", "LIMITS", "USUAL", "Demands", "Limit", "Margins", "margins", "margins_at"]
