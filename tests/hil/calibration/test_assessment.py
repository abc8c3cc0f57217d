"""The assessment of a calibration in words."""

import numpy as np

from hil.calibration.assessment import weakest_direction
from plant.mechanism import load_spatial


def test_the_weakest_direction_is_named():
    mechanism = load_spatial("hexapod")
    assert weakest_direction(np.diag([1e-8, 1e-8, 4e-6, 0.0, 0.0, 0.0]), mechanism).startswith("mostly along z: 2 mm")
    assert weakest_direction(np.diag([1e-8, 1e-8, 1e-8, 0.0, 4e-4, 0.0]), mechanism).startswith("mostly about y: 4 mm")
