"""Imposed motion: how large and how fast it is on each axis, where it is at home, and what is refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from plant.dynamics.imposed_motion import impose
from plant.errors import InputError
from plant.pose import Array

SIZES = (0.02, 0.15)


def coordinates(mechanism, imposed) -> Array:
    """(6, N): the way from home along each axis [m], and the angles about z, then y, then x [rad]."""
    home = mechanism.require_home()
    turned = Rotation.from_matrix(imposed.rotations @ home.rotation.T).as_euler("xyz")
    return np.vstack([(imposed.positions - home.position).T, turned.T])


def test_a_static_motion_is_one_pose_within_the_size_on_every_axis(hexapod) -> None:
    found = []
    for seed in range(100):
        imposed = impose(hexapod, "static", 0.004, 500.0, seed, SIZES)
        assert imposed.times.tolist() == [0.0, 0.002]
        assert (imposed.positions[0] == imposed.positions[1]).all() and (imposed.signals[0] == imposed.signals[1]).all()
        found.append(coordinates(hexapod, imposed)[:, 0])
        np.testing.assert_allclose(imposed.signals[:, 0], 0.0, atol=1e-15)
        # At rest every accelerometer reads gravity alone, and the platform's sees it as it is turned.
        np.testing.assert_allclose(np.linalg.norm(imposed.signals[0, 1], axis=1), 9.81, rtol=1e-12)
        np.testing.assert_allclose(imposed.signals[0, 1, 6], imposed.rotations[0].T @ [0.0, 0.0, 9.81], atol=1e-12)
    reach = np.abs(found) / np.repeat(SIZES, 3)
    assert (reach.max(axis=0) <= 1.0 + 1e-9).all() and (reach.max(axis=0) > 0.9).all()
    assert (np.min(found, axis=0) < 0.0).all() and (np.max(found, axis=0) > 0.0).all()


@pytest.mark.parametrize("frequency", [0.5, 5.0])
def test_all_axes_share_a_frequency_within_a_tenth(hexapod, frequency) -> None:
    imposed = impose(hexapod, str(frequency), 4.0 / frequency, 200.0 * frequency, 3, SIZES)
    assert len(imposed.times) == 800 and imposed.times[-1] == pytest.approx(799 / (200.0 * frequency))
    for axis, values in enumerate(coordinates(hexapod, imposed)):
        expected = frequency * (1.0 + 0.04 * (axis - 2.5))
        assert 0.9 * frequency <= expected <= 1.1 * frequency
        waves = np.stack([np.sin(2.0 * np.pi * expected * imposed.times), np.cos(2.0 * np.pi * expected * imposed.times)])
        amplitudes, left, *_ = np.linalg.lstsq(waves.T, values)
        assert left < 1e-20
        assert np.hypot(*amplitudes) == pytest.approx(SIZES[axis // 3], rel=1e-9)


def test_a_mixed_motion_is_five_sines_from_a_tenth_of_a_hertz_to_one(hexapod) -> None:
    imposed = impose(hexapod, "mixed", 40.0, 20.0, 5, SIZES)
    for axis, values in enumerate(coordinates(hexapod, imposed)):
        frequencies = (1.0 + 0.03 * axis) * np.array([0.1, 0.225, 0.4, 0.65, 1.0])
        phases = 2.0 * np.pi * np.outer(imposed.times, frequencies)
        amplitudes, left, *_ = np.linalg.lstsq(np.hstack([np.sin(phases), np.cos(phases)]), values)
        assert left < 1e-20
        sizes = np.hypot(amplitudes[:5], amplitudes[5:])
        # All five reach the same speed, and together the size.
        np.testing.assert_allclose(sizes * frequencies, sizes[0] * frequencies[0], rtol=1e-9)
        assert sizes.sum() == pytest.approx(SIZES[axis // 3], rel=1e-9)


def test_five_hertz_are_the_most(hexapod) -> None:
    for kind in ("5.01", "-0.5"):
        with pytest.raises(InputError, match=rf"no imposed motion '{kind}'.* at most 5 Hz"):
            impose(hexapod, kind, 0.1, 100.0, 0)
    with pytest.raises(InputError, match="the seed is -1"):
        impose(hexapod, "static", 0.1, 100.0, -1)


def test_a_motion_is_as_large_as_ten_degrees_and_three_centimetres_by_default(hexapod) -> None:
    found = np.abs([coordinates(hexapod, impose(hexapod, "static", 0.01, 100.0, seed))[:, 0] for seed in range(50)]).max(axis=0)
    np.testing.assert_allclose(found, [0.03] * 3 + [np.radians(10.0)] * 3, rtol=0.15)
