"""The truth of a run: an array (19,) with the pose of {2}, and the lengths and currents of six legs."""

TRUTH_SIZE = 19
TRUTH_POSITION = slice(0, 3)
"""[m]."""
TRUTH_QUATERNION = slice(3, 7)
"""Unit, w first."""
TRUTH_LENGTHS = slice(7, 13)
"""[m]."""
TRUTH_CURRENTS = slice(13, 19)
"""[A]."""
