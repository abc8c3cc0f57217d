"""The step-by-step algebra against the whole batch at once, against draws, and the figures of one pose at home."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from controller.planning.target import load_target
from hil.studies.detectability.kinematics import motion_along, sensitivity, signals
from hil.studies.detectability.model import DATA, STATES, linear_model, whitened
from hil.studies.detectability.uncertainty import Uncertainty
from plant.errors import InputError
from plant.imu import MILLI_G, load_imu

from .conftest import STEP_S, draw


def batch(model):
    """The covariance of all data at once, and of the last pose with them, by unrolling the recursion."""
    steps = len(model.sensitivity)
    covariances, reach = [np.diag(model.prior)], [np.eye(STATES)]
    for _ in range(steps - 1):
        covariances.append(model.transition @ covariances[-1] @ model.transition.T + model.driving)
        reach.append(model.transition @ reach[-1])
    blocks = np.empty((steps, DATA, steps, DATA))
    across = np.empty((6, steps, DATA))
    for i in range(steps):
        for j in range(i + 1):
            later = reach[i - j] @ covariances[j]
            blocks[i, :, j] = model.sensitivity[i] @ later @ model.sensitivity[j].T
            blocks[j, :, i] = blocks[i, :, j].T
        blocks[i, :, i] += np.diag(model.noise)
        across[:, i] = (reach[steps - 1 - i] @ covariances[i] @ model.sensitivity[i].T)[:6]
    return blocks.reshape(steps * DATA, -1), across.reshape(6, -1), covariances[-1][:6, :6]


def test_whitening_step_by_step_is_the_algebra_of_the_whole_batch(short_model):
    part = replace(short_model, sensitivity=short_model.sensitivity[:8])
    random = np.random.default_rng(0)
    data = random.standard_normal((8, DATA, 5)) * np.sqrt(part.noise)[:, None]
    found = whitened(part, data)
    covariance, across, prior = batch(part)
    flat = data.reshape(-1, 5)
    solved = np.linalg.solve(covariance, flat)
    whole = found.innovations.reshape(-1, 5)
    np.testing.assert_allclose(whole.T @ whole, flat.T @ solved, rtol=1e-6, atol=1e-6 * np.abs(flat.T @ solved).max())
    np.testing.assert_allclose(found.estimates[-1], across @ solved, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(
        found.covariances[-1], prior - across @ np.linalg.solve(covariance, across.T), rtol=1e-4, atol=1e-10
    )


def test_data_of_the_model_become_white_and_estimates_err_as_they_say(short_model):
    data, poses = draw(short_model, 300, 1)
    found = whitened(short_model, data)
    assert kstest(found.innovations[5:].ravel()[::97], "norm").pvalue > 1e-3
    squares = np.sum(found.innovations**2, axis=(0, 1))
    low, high = chi2.ppf([1e-3, 1 - 1e-3], found.innovations[:, :, 0].size)
    assert np.mean((squares > low) & (squares < high)) > 0.97
    errors = poses - found.estimates
    for n in (0, 30, -1):
        normalised = np.sum(errors[n] * np.linalg.solve(found.covariances[n], errors[n]), axis=0)
        assert kstest(normalised, chi2(6).cdf).pvalue > 1e-3


def test_uncertainty_about_drives_and_sensors_makes_estimates_worse(hexapod, short_model):
    target = load_target("sines", hexapod, 2.0)
    motion = motion_along(target, hexapod, STEP_S * (np.arange(60) + 0.5) - 0.2)
    nothing = np.zeros((60, DATA, 1))
    sizes = [np.trace(whitened(short_model, nothing).covariances[-1])]
    for worse in ({"drive_rate": 1.0, "drive_noise": 1.0}, {"gyroscope_bias": 0.01}, {"accelerometer_wander": 0.05}):
        model = linear_model(hexapod, motion, load_imu("mpu9150-calibrated"), 1000.0, Uncertainty(**worse), STEP_S)
        sizes.append(np.trace(whitened(model, nothing).covariances[-1]))
    assert min(sizes[1:]) > sizes[0]


def test_noise_that_aliases_counts(hexapod):
    """In slow loops, as in `tests/controller/test_settings.py`."""
    imu = replace(load_imu("mpu9150-calibrated"), conversion_rate=400e3)
    motion = motion_along(load_target("sines", hexapod, 2.0), hexapod, STEP_S * np.arange(3))
    noise = linear_model(hexapod, motion, imu, 250.0, Uncertainty(), STEP_S).noise[:42].reshape(7, 2, 3)
    x = np.pi * np.array([256.0, 260.0]) / 250.0
    densities = np.array([imu.gyroscope.noise, imu.accelerometer.noise]) * np.sqrt(x / np.tanh(x))
    np.testing.assert_allclose(noise, np.broadcast_to((densities**2 / (2.0 * STEP_S))[:, None], noise.shape), rtol=5e-3)


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.inf, np.nan])
def test_an_uncertainty_must_be_positive_and_finite(wrong):
    with pytest.raises(InputError, match="the wander_time of the uncertainty"):
        Uncertainty(wander_time=wrong)


@pytest.fixture(scope="module")
def at_home(hexapod):
    """What accelerometers read at home, and how that depends on the pose: (21,) and (21, 6)."""
    motion = motion_along(load_target("hold", hexapod, 1.0), hexapod, np.array([0.5]))
    rows = np.concatenate([np.arange(6 * k + 3, 6 * k + 6) for k in range(7)])
    exact = signals(hexapod, motion)
    return exact, sensitivity(hexapod, motion)[0][rows, :6]


def estimated(jacobian, readings):
    """The least-squares pose of wrong readings [mm, deg], and what does not fit."""
    pose = np.linalg.lstsq(jacobian, readings, rcond=None)[0]
    return 1e3 * np.linalg.norm(pose[:3]), np.degrees(np.linalg.norm(pose[3:])), readings - jacobian @ pose


def test_legs_that_share_a_bias_move_the_platform_without_a_residual(at_home):
    """Linearised at home: 44 mm for 0.5 m/s2 along (0, 0.89, -0.46)."""
    _, jacobian = at_home
    position, _, residual = estimated(jacobian[:18], np.tile([0.0, 0.89, -0.46], 6) * 0.5 / np.hypot(0.89, 0.46))
    assert position == pytest.approx(44.0, abs=0.5)
    assert np.linalg.norm(residual) < 3e-3 * 0.5 * np.sqrt(6)


def test_the_same_on_all_seven_is_told_by_the_platform_s_length_of_gravity(at_home):
    """0.9 mm for each standard deviation, where each axis has a bias of 1 mg / sqrt(3)."""
    _, jacobian = at_home
    sigma, common = MILLI_G / np.sqrt(3.0), np.tile(np.eye(3), (7, 1))
    hidden = (np.eye(21) - jacobian @ np.linalg.pinv(jacobian)) @ common / sigma
    values, vectors = np.linalg.eigh(hidden.T @ hidden)
    weakest = np.abs(vectors[:, 0])
    np.testing.assert_allclose(weakest, [0.0, 0.91, 0.41], atol=0.01)
    position, _, _ = estimated(jacobian, common @ vectors[:, 0] / np.sqrt(values[0]))
    assert position == pytest.approx(0.9, abs=0.02)


def test_a_tilt_of_the_base_costs_what_was_found_at_home_and_one_pose_tells_it(hexapod, at_home):
    """7.9 mm and 0.86 deg for each degree; 0.126 deg for both axes together, with a bias of 1 mg / sqrt(3) of each axis."""
    exact, jacobian = at_home
    sigma, found = MILLI_G / np.sqrt(3.0), []
    for axis in np.eye(3)[:2]:
        force = np.cross(axis, hexapod.plant["gravity"])
        readings = np.concatenate([axes.T @ force for axes in exact.axes[0]])
        position, rotation, residual = estimated(jacobian, np.radians(1.0) * readings)
        assert position == pytest.approx(7.93, abs=0.05) and rotation == pytest.approx(0.863, abs=0.005)
        found.append(sigma / np.linalg.norm(residual))
    assert np.hypot(*found) == pytest.approx(0.126, abs=0.001)
