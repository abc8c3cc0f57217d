"""What the IMUs read when the platform moves, and its derivatives: against differences of where they are."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.estimation.whole_mechanism.readings import READINGS_SCRATCH, predict_readings
from controller.rig import sensor_geometry
from plant.dynamics.imposed_motion import impose
from plant.mechanism import Mechanism, load_spatial
from plant.pose import rotation_angle
from tests.controller.leg_geometry import rotation_of
from tests.controller.leg_motion import observe_mechanism


def inclined(mechanism):
    """The same mechanism, its base tilted, an IMU off the platform's origin."""
    up = rotation_of([0.2, -0.1, 0.0])[:, 2]
    return Mechanism.from_legs(
        mechanism.base_joints,
        mechanism.platform_joints,
        up_in_base=up,
        home=mechanism.home,
        limits={"stroke": mechanism.limits.stroke},
        plant={**mechanism.plant, "gravity": -9.81 * up, "platform_imu_position": np.array([0.02, -0.01, 0.03])},
    )


@pytest.fixture(scope="module", params=["hexapod", "inclined", "genhexkins"])
def mechanism(request):
    return inclined(load_spatial("hexapod")) if request.param == "inclined" else load_spatial(request.param)


def predict(mechanism, position, rotation, motion):
    readings, jacobian = np.zeros((7, 6)), np.full((7, 6, 18), np.nan)
    jacobian[:6] = 0.0
    scratch = np.zeros((), READINGS_SCRATCH)
    predict_readings(sensor_geometry(mechanism)[()], position, rotation, motion, True, readings, jacobian, scratch[()])
    return readings, jacobian


def swaying(mechanism, seed, size=0.25):
    """A platform in motion, and that motion (position, rotation, twist and its derivative) at a time."""
    random = np.random.default_rng(seed)
    rates, phases = random.uniform(1.0, 9.0, 6), random.uniform(0.0, 6.3, 6)
    sizes = np.array([0.03, 0.03, 0.03, size, size, size])
    home = mechanism.require_home()

    def coordinates(times):
        return (sizes[:, None] * np.sin(np.outer(rates, times) + phases[:, None])).T

    def pose_at(times):
        q = coordinates(times)
        return home.position + q[:, :3], Rotation.from_euler("zyx", q[:, 3:]).as_matrix() @ home.rotation

    def motion_at(time, h=1e-3):
        weights1 = np.array([1.0, -9.0, 45.0, 0.0, -45.0, 9.0, -1.0]) / (-60.0 * h)
        positions, rotations = pose_at(time + h * np.arange(-3, 4))
        weights2 = np.array([2.0, -27.0, 270.0, -490.0, 270.0, -27.0, 2.0]) / (180.0 * h * h)
        turned = Rotation.from_matrix(rotations @ rotations[3].T).as_rotvec()
        omega = weights1 @ turned
        # At the middle, rotation vectors relative to it have the angular acceleration as second derivative.
        return positions[3], rotations[3], np.array([weights1 @ positions, omega, weights2 @ positions, weights2 @ turned])

    return pose_at, motion_at


@pytest.mark.parametrize("seed", range(5))
def test_readings_are_those_of_moving_bodies(mechanism, seed):
    pose_at, motion_at = swaying(mechanism, seed)
    times = np.array([0.1, 0.7, 1.9])
    observed = observe_mechanism(mechanism, pose_at, times)
    for time, expected in zip(times, observed, strict=True):
        readings, _ = predict(mechanism, *motion_at(time))
        np.testing.assert_allclose(readings[:, :3], expected[0], rtol=0.0, atol=1e-7)
        np.testing.assert_allclose(readings[:, 3:], expected[1], rtol=0.0, atol=3e-6)


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_are_those_of_the_readings(mechanism, seed):
    _, motion_at = swaying(mechanism, seed)
    position, rotation, motion = motion_at(0.4)
    _, jacobian = predict(mechanism, position, rotation, motion)
    assert np.isfinite(jacobian).all()
    step = 1e-6
    for i in range(18):
        ends = []
        for sign in (1.0, -1.0):
            change = np.zeros(18)
            change[i] = sign * step
            moved = motion + change[6:].reshape(4, 3)
            ends.append(predict(mechanism, position + change[:3], rotation_of(change[3:6]) @ rotation, moved)[0])
        np.testing.assert_allclose(jacobian[:, :, i], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["static", "0.5", "2", "mixed"])
def test_imposed_motion_reads_as_moving_bodies_do(mechanism, kind):
    imposed = impose(mechanism, kind, 0.3, 1000.0, seed=3)
    home = mechanism.require_home()

    def pose_at(times):
        index = np.clip(np.rint(times * 1000.0).astype(int), 0, 299)
        return imposed.positions[index], imposed.rotations[index]

    times = imposed.times[10:-10:23]
    expected = observe_mechanism(mechanism, pose_at, times)
    signals = imposed.signals[10:-10:23]
    np.testing.assert_allclose(signals[:, 0], expected[:, 0], rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(signals[:, 1], expected[:, 1], rtol=0.0, atol=1e-6)
    field = np.einsum("nji,j->ni", imposed.rotations, mechanism.plant["magnetic_field"])
    np.testing.assert_allclose(imposed.signals[:, 2, 6], field, rtol=0.0, atol=1e-9)
    assert np.abs(imposed.positions - home.position).max() <= 0.03 + 1e-12
    assert rotation_angle(imposed.rotations, home.rotation).max() < np.radians(18.0)


def test_imposed_motion_is_repeatable_and_refuses_what_it_does_not_know(mechanism):
    first, again, other = (impose(mechanism, "mixed", 0.1, 100.0, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.signals, again.signals)
    assert np.abs(first.positions - other.positions).max() > 1e-3
    for kind in ("wobble", "-1", "nan", "inf", "0"):
        with pytest.raises(ValueError, match=r"no imposed motion .* give static, mixed, or a frequency"):
            impose(mechanism, kind, 0.1, 100.0, 0)
