"""What rest does not tell: on a platform that stands still, what the whole-mechanism filter knows of the IMUs' errors stays."""

import numpy as np
import pytest

from controller.estimation.whole_mechanism.filter import accumulate_sample, start_filter, step_filter
from controller.estimation.whole_mechanism.parameters import FILTER_STATE, filter_parameters
from controller.estimation.whole_mechanism.readings import readings_along
from controller.rig import sensor_geometry
from controller.settings import fusion_settings
from plant.imu import STANDARD_GRAVITY
from tests.controller.leg_geometry import unit

RATE_HZ = 200.0
"""That of the windows, so that each sample is an update."""

NOISE = np.array([np.radians(0.005), 400e-6 * STANDARD_GRAVITY])[:, None, None] * np.sqrt(RATE_HZ / 2.0)


def positions_at_rest(hexapod, errors, minutes, seed):
    """The estimated positions, second by second, with the errors and noise of calibrated IMUs of the kind MPU-9150."""
    random, home = np.random.default_rng(seed), hexapod.home
    parameters, f = filter_parameters(fusion_settings(hexapod), RATE_HZ, errors, None), np.zeros((), FILTER_STATE)
    geometry = sensor_geometry(hexapod)
    still = np.tile(home.position, (5, 1)), np.tile(home.rotation, (5, 1, 1))
    ideal = np.moveaxis(readings_along(geometry, *still, RATE_HZ)[2].reshape(7, 2, 3), 1, 0)
    biases = np.array([np.radians(0.2), 1e-3 * STANDARD_GRAVITY])[:, None, None] * unit(random.normal(size=(2, 7, 3)))
    mean = ideal * (1.0 + 1e-3 * random.uniform(-1.0, 1.0, (2, 7, 3))) + biases
    start_filter(parameters[()], f[()], 0.0, home.position, home.rotation, np.zeros(6))
    sample, weights, found, number = np.zeros((3, 7, 3)), np.ones((2, 7)), [], 0
    for _ in range(round(60 * minutes)):
        for noise in NOISE * random.normal(size=(round(RATE_HZ), 2, 7, 3)):
            number += 1
            sample[:2] = mean + noise
            accumulate_sample(f[()], sample, weights, number / RATE_HZ)
            step_filter(parameters[()], geometry[()], f[()])
        found.append(f["published_position"].copy())
    return np.array(found), np.sqrt(np.trace(f["published_covariance"][:3, :3]))


@pytest.mark.parametrize(
    ("errors", "minutes", "seed"),
    [
        ("alignments", 0.5, 3),
        pytest.param("accelerometers", 4.0, 5, marks=pytest.mark.slow),
        pytest.param("alignments", 20.0, 4, marks=pytest.mark.endurance),
        pytest.param("accelerometers", 20.0, 5, marks=pytest.mark.endurance),
    ],
)
def test_the_pose_stays_where_it_is_within_its_own_uncertainty(hexapod, errors, minutes, seed):
    found, sigma = positions_at_rest(hexapod, errors, minutes, seed)
    # In the first seconds the biases settle.
    drift = np.linalg.norm(found[-10:].mean(axis=0) - found[5:15].mean(axis=0))
    assert drift < 0.2e-3
    assert np.linalg.norm(found - hexapod.home.position, axis=1).max() < 1.5 * sigma
