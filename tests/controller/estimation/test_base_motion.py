"""The base's attitude and heave by the IMU on it, against Kalman filters with matrices, the truth, and their own covariance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from controller.estimation import base_motion
from controller.estimation.base_motion import base_motion_parameters, follow_base, heave
from controller.settings import fusion_settings
from plant.mechanism import load_spatial
from plant.pose import rotation_from_vector, vector_from_rotation
from tests.controller.leg_geometry import angle_between

GRAVITY = 9.80665
PERIOD = 0.01
UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def mechanism():
    return load_spatial("hexapod")


def parameters_of(mechanism, heave_period=0.0):
    return base_motion_parameters(mechanism, fusion_settings(mechanism), heave_period)[()]


def fresh():
    return np.zeros((), base_motion.STATE)[()]


class Sea:
    """Waves of three tilts [rad] and three displacements [m], with periods [s], and an IMU at `arm` [m]."""

    def __init__(self, seed, tilts=(0.05, 0.03, 0.0), moves=(0.1, 0.1, 0.0), periods=(5.0, 12.0), arm=(0.0, 0.0, 0.0)):
        random = np.random.default_rng(seed)
        self.sizes = np.array([*tilts, *moves])
        self.rates = 2.0 * np.pi / random.uniform(*periods, 6)
        self.phases = random.uniform(0.0, 2.0 * np.pi, 6)
        self.arm = np.array(arm)

    def moved(self, times):
        return self.sizes * np.sin(self.rates * times[:, None] + self.phases)

    def attitudes(self, times):
        return Rotation.from_rotvec(self.moved(times)[:, :3]).as_matrix()

    def places(self, times):
        return self.moved(times)[:, 3:]

    def readings(self, times):
        """Rate, angular acceleration and specific force (N, 3, 3), seen in {1}, by differences of attitude and place."""
        h = 1e-3
        before, now, after = (self.attitudes(times + k * h) for k in (-1, 0, 1))
        to_base = np.swapaxes(now, 1, 2)
        ahead, behind = (
            Rotation.from_matrix(turn).as_rotvec() / h for turn in (to_base @ after, np.swapaxes(before, 1, 2) @ now)
        )
        at = [self.places(times + k * h) + attitude @ self.arm for k, attitude in ((-1, before), (0, now), (1, after))]
        force = (at[2] - 2.0 * at[1] + at[0]) / h**2 + GRAVITY * UP
        return np.stack([0.5 * (ahead + behind), (ahead - behind) / h, (to_base @ force[:, :, None])[:, :, 0]], axis=1)


def follow(p, s, reading):
    follow_base(p, s, reading[0], reading[1], tuple(reading[2]), tuple(UP), GRAVITY, PERIOD)


def sail(p, sea, duration, bias=(0.0, 0.0, 0.0), noise=None):
    """Attitudes of the base against the truth (N, 3) [rad], and heaves (N, 3) beside the true ones (N,) [m]."""
    s, times = fresh(), PERIOD * np.arange(round(duration / PERIOD))
    readings = sea.readings(times)
    readings[:, 0] += bias
    if noise is not None:
        random = np.random.default_rng(7).normal(size=(len(times), 2, 3))
        readings[:, ::2] += np.array(noise)[:, None] / np.sqrt(PERIOD) * random
    attitudes, heaves = np.empty((len(times), 3, 3)), np.empty((len(times), 3))
    for n, reading in enumerate(readings):
        follow(p, s, reading)
        attitudes[n], heaves[n] = s["attitude"], heave(p, s)
    off = Rotation.from_matrix(attitudes @ np.swapaxes(sea.attitudes(times), 1, 2)).as_rotvec()
    return off, heaves, sea.places(times)[:, 2], s


def twin(p, readings):
    """The same filters with matrices, one for each axis across the vertical and one along it."""
    bias, place, speed = np.zeros(3), np.zeros(3), np.zeros(3)
    tilt, raised, x = np.diag(p["tilt_start"]), np.diag(p["heave_start"]), np.zeros(5)
    turned = np.array([[p["tilt_start"][2], 0.0], [0.0, p["tilt_start"][3]]])
    force = readings[0, 2] / np.linalg.norm(readings[0, 2])
    axis = np.cross(force, UP)
    attitude = rotation_from_vector(axis / np.linalg.norm(axis) * np.arcsin(np.linalg.norm(axis)))
    step, rise = np.eye(4) + PERIOD * p["tilt_change"], np.eye(5) + PERIOD * p["heave_change"]
    turn = np.array([[1.0, PERIOD], [0.0, 1.0]])
    for rate, _, force in readings[1:]:
        attitude = rotation_from_vector(PERIOD * attitude @ (rate - bias)) @ attitude
        felt = attitude @ force
        across = felt * [1.0, 1.0, 0.0]
        place, speed = place + PERIOD * speed + 0.5 * PERIOD**2 * across, speed + PERIOD * across
        tilt = step @ tilt @ step.T + PERIOD * np.diag(p["tilt_noise"])
        row = p["tilt_row"]
        gain = tilt @ row / (row @ tilt @ row + p["sway_variance"] / PERIOD)
        tilt = (np.eye(4) - np.outer(gain, row)) @ tilt
        off = -(across + row[0] * place + row[1] * speed)
        place, speed = place + gain[0] * off, speed + gain[1] * off
        turned = turn @ turned @ turn.T + PERIOD * np.diag([p["rate_density"], base_motion._BIAS_WALK**2])
        of_heading = turned[:, 0] / (turned[0, 0] + p["yaw_variance"] / PERIOD)
        turned = turned - np.outer(of_heading, turned[0])
        heading = -0.5 * (attitude[1, 0] - attitude[0, 1]) * UP
        bias = bias - attitude.T @ (gain[3] * np.cross(UP, off) + of_heading[1] * heading)
        attitude = rotation_from_vector(gain[2] * np.cross(UP, off) + of_heading[0] * heading) @ attitude
        x, raised = rise @ x, rise @ raised @ rise.T + PERIOD * np.diag(p["heave_noise"])
        row = p["heave_row"]
        gain = raised @ row / (row @ raised @ row + p["force_variance"] / PERIOD)
        x, raised = x + gain * (felt[2] - GRAVITY - row @ x), (np.eye(5) - np.outer(gain, row)) @ raised
    return attitude, bias, x


@pytest.mark.parametrize("seed", range(3))
def test_the_filters_agree_with_filters_of_matrices(mechanism, seed):
    p, sea = parameters_of(mechanism, 7.0), Sea(seed, moves=(0.1, 0.1, 0.05))
    readings = sea.readings(PERIOD * np.arange(1500)) + [[0.002], [0.0], [0.0]]
    s = fresh()
    for reading in readings:
        follow(p, s, reading)
    attitude, bias, x = twin(p, readings)
    np.testing.assert_allclose(s["attitude"], attitude, atol=1e-9)
    np.testing.assert_allclose(s["bias"], bias, atol=1e-9)
    np.testing.assert_allclose(s["heave"], x, atol=1e-9)


@settings(max_examples=4)
@given(st.integers(0, 2**32 - 1), st.floats(-0.004, 0.004), st.floats(-0.004, 0.004))
def test_the_level_is_exact_on_a_base_in_waves(seed, bias_x, bias_y):
    """Whatever the biases of the gyroscope: they are learned within half a minute."""
    off, _, _, s = sail(parameters_of(load_spatial("hexapod")), Sea(seed), 60.0, (bias_x, bias_y, 0.0))
    late = np.degrees(off[4000:, :2])
    assert np.sqrt((late**2).sum(axis=1).mean()) < 0.02
    np.testing.assert_allclose(s["bias"][:2], [bias_x, bias_y], atol=1e-4)


@pytest.mark.parametrize("lean", [0.0, 0.09, 0.5])
def test_a_base_that_stands_is_level_from_the_first_sample(mechanism, lean):
    p, s = parameters_of(mechanism), fresh()
    leaning = rotation_from_vector(np.array([lean, -0.4 * lean, 0.0]))
    reading = np.array([np.zeros(3), np.zeros(3), leaning.T @ (GRAVITY * UP)])
    for n in range(1000):
        follow(p, s, reading)
        assert angle_between(s["attitude"] @ leaning.T, np.eye(3)) < 1e-6 + 0.5 * lean**3, n


def test_the_heading_stays_through_a_yaw_and_turns_with_the_base(mechanism):
    sea = Sea(1, tilts=(0.0, 0.0, 0.02), moves=(0.0, 0.0, 0.0))
    off, _, _, _ = sail(parameters_of(mechanism), sea, 60.0)
    assert np.abs(off[3000:, 2]).max() < 0.25 * 0.02
    p, s = parameters_of(mechanism), fresh()
    for n in range(30000):
        turned = rotation_from_vector(np.array([0.0, 0.0, 0.01 * n * PERIOD]))
        follow(p, s, np.array([[0.0, 0.0, 0.01], np.zeros(3), turned.T @ (GRAVITY * UP)]))
    # It turned by 3 rad, and the level frame with it: the rate is taken for a bias.
    assert abs(vector_from_rotation(s["attitude"])[2]) < 0.1


@pytest.mark.parametrize(("period", "share"), [(7.0, 0.15), (6.0, 0.25), (8.5, 0.25)])
def test_the_heave_is_that_of_the_waves(mechanism, period, share):
    """Told a mean period of 7 s; with the rate and the acceleration of the heave."""
    sea = Sea(2, moves=(0.05, 0.05, 0.02), periods=(period, period))
    _, heaves, true, _ = sail(parameters_of(mechanism, 7.0), sea, 120.0)
    late, rate = slice(6000, None), 2.0 * np.pi / period
    off = heaves[late, 0] - true[late]
    assert off.std() < share * true[late].std()
    assert (heaves[late, 1] - np.gradient(true, PERIOD)[late]).std() < share * rate * true[late].std()
    assert (heaves[late, 2] + rate**2 * true[late]).std() < share * rate**2 * true[late].std()


def test_noise_moves_the_heave_no_further_than_its_covariance_says(mechanism):
    fusion = fusion_settings(mechanism)
    sea = Sea(0, moves=(0.0, 0.0, 0.0), tilts=(0.0, 0.0, 0.0))
    noise = fusion.gyroscope_noise, fusion.mechanism_accelerometer_noise
    off, heaves, _, s = sail(parameters_of(mechanism, 7.0), sea, 200.0, noise=noise)
    sigma = np.sqrt(s["heave_covariance"][0, 0])
    assert 1e-3 < heaves[5000:, 0].std() < sigma
    assert (off[5000:, :2].std(axis=0) < 2.0 * np.sqrt(s["tilt_covariance"][2, 2])).all()


def test_an_imu_off_the_axes_of_roll_tells_the_heave_of_the_origin(mechanism):
    """Rolling lifts an IMU that sits a metre aside by 5 cm, and the origin not at all."""
    p = parameters_of(mechanism, 7.0)
    p["place"] = 0.3, 1.0, 0.2
    sea = Sea(4, tilts=(0.05, 0.0, 0.0), moves=(0.0, 0.0, 0.0), arm=p["place"])
    off, heaves, _, _ = sail(p, sea, 90.0)
    assert np.abs(heaves[4000:, 0]).max() < 1e-3
    assert np.degrees(np.abs(off[4000:, :2]).max()) < 0.01


@pytest.mark.parametrize("gravity", [1.62, 9.81])
@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -0.6, 0.8), (1.0, 0.0, 0.0)])
def test_the_vertical_may_lie_anywhere(mechanism, up, gravity):
    """A mechanism may hang on a wall, or stand on the moon."""
    up, s = np.array(up), fresh()
    mechanism = replace(mechanism, plant={**mechanism.plant, "gravity": -gravity * up})
    p = parameters_of(mechanism)
    tilt = np.cross(up, [0.3, 0.2, 0.5])
    tilt *= 0.05 / np.linalg.norm(tilt)
    for n in range(3000):
        turned = rotation_from_vector(tilt * np.sin(0.8 * n * PERIOD))
        rate = 0.8 * tilt * np.cos(0.8 * n * PERIOD)
        follow_base(p, s, rate, np.zeros(3), tuple(turned.T @ (gravity * up)), tuple(up), gravity, PERIOD)
    assert angle_between(s["attitude"], turned) < 1e-3
