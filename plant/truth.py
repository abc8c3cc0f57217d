"""The truth of a run: an array (19,) with the pose of {2}, and the lengths and currents of six legs."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

TRUTH_SIZE = 19
TRUTH_POSITION = slice(0, 3)
"""[m]."""
TRUTH_QUATERNION = slice(3, 7)
"""Unit, w first."""
TRUTH_LENGTHS = slice(7, 13)
"""[m]."""
TRUTH_CURRENTS = slice(13, 19)
"""[A]."""


def pose_known(truth: Any) -> NDArray[np.bool_]:
    """In which of truths (..., 19) the pose is known."""
    known: NDArray[np.bool_] = np.isfinite(truth[..., : TRUTH_QUATERNION.stop]).all(axis=-1)
    return known
