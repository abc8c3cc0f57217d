"""The data of a calibration: the rests in records."""

import numpy as np

from hil.calibration.data import CalibrationData, Knowledge, find_rests, is_long
from hil.calibration.drive import run_open
from hil.runs.config import SimulationConfig
from plant.mechanism import load_spatial


def test_the_rest_at_home_is_the_one_on_the_brakes():
    config = SimulationConfig(imu="mpu9150", seed=7, target="hold", duration=0.1, hold=1.0)
    mechanism = load_spatial(config.mechanism)
    data = CalibrationData(mechanism, config.imu, config.rate, Knowledge(home=True), config.seed)
    data.begin(run_open(config, blind=True), 1000)
    assert data.rests.home and len(data.rests.readings) == 1
    np.testing.assert_allclose(data.truth[0, :3], mechanism.home.position, atol=2e-5)


def test_rests_are_where_nothing_turns():
    random = np.random.default_rng(0)
    samples, zero = np.zeros((5000, 3, 7, 3)), random.normal(0.0, 0.3, (7, 3))
    samples[:, 0] = zero + random.normal(0.0, 0.002, (5000, 7, 3))
    samples[1000:2500, 0, 4, 1] += 0.2
    rests = find_rests(samples, zero, 1000.0)
    assert rests == [slice(0, 1000), slice(2500, 5000)]
    assert [is_long(rest, 1000.0) for rest in (*rests, slice(0, 800))] == [True, True, False]
