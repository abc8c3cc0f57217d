"""The errors of an IMU, as matrices."""

import numpy as np
import pytest

from controller.estimation.whole_mechanism.imu_errors import (
    ACCELEROMETER_AXES,
    ACCELEROMETER_BIAS,
    ACCELEROMETER_SCALE,
    ALIGNMENT,
    ERROR_NAMES,
    ERRORS,
    GYROSCOPE_AXES,
    GYROSCOPE_BIAS,
    GYROSCOPE_SCALE,
    distort,
    error_matrix,
)
from tests.controller.leg_geometry import rotation_of


def test_every_error_has_three_places_in_the_order_of_its_name():
    places = (
        GYROSCOPE_BIAS, ACCELEROMETER_BIAS, ACCELEROMETER_SCALE, GYROSCOPE_SCALE, ALIGNMENT, ACCELEROMETER_AXES, GYROSCOPE_AXES,
    )  # fmt: skip
    assert places == tuple(range(0, 21, 3))
    assert ERRORS == 3 * len(ERROR_NAMES) == 21
    assert [name.split()[0] for name in ERROR_NAMES] == [
        "gyroscope", "accelerometer", "accelerometer", "gyroscope", "alignment", "accelerometer", "gyroscope",
    ]  # fmt: skip
    assert [name.split()[-1] for name in ERROR_NAMES] == ["bias", "bias", "scale", "scale", "alignment", "axes", "axes"]


@pytest.mark.parametrize(
    ("sensor", "scale", "axes"), [(0, GYROSCOPE_SCALE, GYROSCOPE_AXES), (1, ACCELEROMETER_SCALE, ACCELEROMETER_AXES)]
)
def test_a_reading_is_turned_back_by_the_alignment_then_scaled_and_mixed_by_its_own_sensors_errors(sensor, scale, axes):
    errors = np.random.default_rng(sensor).uniform(-0.01, 0.01, ERRORS)
    upper = np.zeros((3, 3))
    upper[[0, 0, 1], [1, 2, 2]] = errors[axes : axes + 3]
    expected = (np.eye(3) + np.diag(errors[scale : scale + 3]) + upper) @ rotation_of(-errors[ALIGNMENT : ALIGNMENT + 3])
    # The rotation is that to second order.
    np.testing.assert_allclose(error_matrix(errors, sensor), expected, rtol=0.0, atol=2e-6)
    ideal = (3.0, -7.0, 5.0)
    np.testing.assert_allclose(distort(errors, sensor, ideal), error_matrix(errors, sensor) @ ideal, rtol=0.0, atol=1e-14)
    np.testing.assert_array_equal(error_matrix(np.zeros(ERRORS), sensor), np.eye(3))
