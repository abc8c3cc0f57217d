"""The constants of the whole-mechanism filter, by hand, for settings that are not the defaults."""

import numpy as np
import pytest

from controller.calibration.file import Calibration
from controller.cycle import cycle_parameters
from controller.estimation.whole_mechanism.imu_errors import ERRORS, distort
from controller.estimation.whole_mechanism.parameters import BLOCKS, filter_parameters, rig_start
from controller.rig import field_of
from controller.settings import ControlSettings, FusionSettings
from plant.mechanism import Mechanism
from tests.controller.leg_geometry import rotation_of, static_signals, unit

FUSION = FusionSettings(
    platform_jerk=2.0, platform_angular_jerk=3.0, mechanism_gyroscope_noise=0.01, mechanism_accelerometer_noise=0.02,
    bias_walk=1e-3, accelerometer_bias_walk=2e-3, bias_sigma=0.1, accelerometer_bias_sigma=0.2, scale_sigma=0.3,
    alignment_sigma=0.4, axes_sigma=0.5, noise_inflation=4.0, magnetometer_noise=0.3, magnetometer_rate=50.0,
    heading_sigma=0.06,
)  # fmt: skip


@pytest.mark.parametrize(
    ("errors", "estimated"), [(None, 0), ("gyroscopes", 3), ("accelerometers", 6), ("alignments", 15), ("axes", 21)]
)
@pytest.mark.parametrize("covered", [147, 185])
def test_the_states_are_the_motion_the_errors_the_rig_and_the_heading(hexapod, errors, estimated, covered):
    covariance = np.diag(np.arange(1.0, covered + 1.0))
    for field, heading in ((None, 0), (field_of(hexapod), 1)):
        found = filter_parameters(FUSION, 800.0, errors, covariance, field=field)
        assert (int(found["errors"]), int(found["rig"]), int(found["heading"])) == (estimated, covered - 147, heading)
        assert int(found["states"]) == 18 + 7 * estimated + covered - 147 + heading
        assert rig_start(found[()]) == 18 + 7 * estimated
        np.testing.assert_array_equal(np.diag(found["prior"]), [*range(1, covered + 1), *[0.0] * (185 - covered)])


@pytest.mark.parametrize(
    ("covariance", "inflation", "factor"),
    [(None, None, 4.0), (None, 1.5, 1.5), (np.eye(147), None, 1.0), (np.eye(147), 2.0, 2.0)],
)
def test_noise_and_jerk_are_inflated_where_the_imus_are_not_calibrated(covariance, inflation, factor):
    found = filter_parameters(FUSION, 800.0, "axes", covariance, inflation=inflation)
    np.testing.assert_allclose(found["jerk"], np.square([2.0 * factor, 3.0 * factor]), rtol=1e-12)
    # White noise of density d over samples at a rate f has the variance d^2 f / 2.
    np.testing.assert_allclose(found["variance"], np.square([0.01 * factor, 0.02 * factor]) * 400.0, rtol=1e-12)
    np.testing.assert_allclose(found["bias_walk"], [1e-6, 4e-6], rtol=1e-12)
    np.testing.assert_array_equal(found["floor"], 0.0)
    assert found["smoothing"] == 0.03


def test_an_imu_on_the_base_has_biases_and_half_of_the_noise_of_a_difference():
    found, without = (filter_parameters(FUSION, 800.0, "accelerometers", None, base=base) for base in (True, False))
    assert (int(found["base"]), int(without["base"])) == (6, 0)
    assert int(found["states"]) - int(without["states"]) == 6 + 6
    np.testing.assert_allclose(found["base_variance"], found["variance"] / 2.0, rtol=1e-12)
    np.testing.assert_allclose(found["base_prior"], [0.01, 0.04], rtol=1e-12)


def test_without_a_calibration_the_prior_is_that_of_the_settings():
    prior = filter_parameters(FUSION, 800.0, "axes", None)["prior"]
    # Biases of gyroscope and accelerometer, scales of accelerometer and gyroscope, alignment, axes of both.
    sigmas = np.repeat([0.1, 0.2, 0.3, 0.3, 0.4, 0.5, 0.5], 3)
    np.testing.assert_allclose(prior[:147, :147], np.diag(np.tile(sigmas**2, 7)), rtol=1e-12)
    assert not prior[147:].any()
    floor = filter_parameters(FUSION, 800.0, "axes", None, np.array([3e-3, 6e-2]))["floor"]
    # A standard deviation of the whole, shared by three components.
    np.testing.assert_allclose(floor, [3e-6, 1.2e-3], rtol=1e-12)


@pytest.mark.parametrize("errors", ["gyroscopes", "accelerometers", "alignments", "axes"])
def test_biases_stand_for_the_errors_that_are_not_estimated_at_the_readings_at_home(hexapod, errors):
    random, estimated, home = np.random.default_rng(8), BLOCKS[errors], hexapod.home
    ideal = np.concatenate(static_signals(hexapod, home.position, home.rotation)[:2], axis=1)
    off = 1e-4 * random.normal(size=(7, ERRORS))
    calibration = Calibration(covariance=np.outer(off, off))
    found = cycle_parameters(hexapod, 1000.0, ControlSettings(), FusionSettings(), whole=errors, calibration=calibration)[
        "mechanism"
    ]["filter"]["prior"][:147, :147]
    some = (found[:, 20] / off[0, 20]).reshape(7, ERRORS)
    some[:, estimated:] = 0.0
    for sensor in range(min(estimated, 6) // 3):
        part = slice(3 * sensor, 3 * sensor + 3)
        for k in range(7):
            whole = np.array(distort(off[k], sensor, tuple(ideal[k, part]))) + off[k, part]
            seen = np.array(distort(some[k], sensor, tuple(ideal[k, part]))) + some[k, part]
            np.testing.assert_allclose(seen - ideal[k, part], whole - ideal[k, part], rtol=0.0, atol=3e-6)
    # The others are as they were, for those who estimate them.
    np.testing.assert_allclose(found[20::21, 20::21], np.outer(off[:, 20], off[:, 20]), rtol=1e-9)


@pytest.mark.parametrize(("rate", "window"), [(4000.0, 20), (1000.0, 5), (250.0, 1), (50.0, 1)])
def test_the_window_lasts_five_milliseconds_or_a_cycle(rate, window):
    assert filter_parameters(FUSION, rate, "axes", None)["window"] == window


def test_a_small_turn_changes_the_heading_as_the_axis_says(hexapod):
    """On an inclined base, where the field dips: about the vertical by the turn itself, about the north by the dip."""
    up, magnetic = unit([0.2, -0.1, 0.9]), np.array([12.0, 15.0, -40.0])
    mechanism = Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, up_in_base=up, home=hexapod.home,
        plant={**hexapod.plant, "gravity": -9.81 * up, "magnetic_field": magnetic},
    )  # fmt: skip
    found = filter_parameters(FUSION, 800.0, "axes", None, field=field_of(mechanism))
    north, east, axis = found["field_axes"]
    np.testing.assert_allclose(np.cross(up, north), east, atol=1e-12)
    np.testing.assert_allclose(north, unit(magnetic - up * (up @ magnetic)), atol=1e-12)
    assert axis @ up == pytest.approx(1.0)
    for step in 1e-6 * np.eye(3):
        angles = [np.arctan2(east @ turned, north @ turned) for turned in (rotation_of(s * step) @ magnetic for s in (1, -1))]
        assert (angles[0] - angles[1]) / 2.0 == pytest.approx(axis @ step, abs=1e-12)
    horizontal = np.linalg.norm(magnetic - up * (up @ magnetic))
    assert float(found["heading_variance"]) == pytest.approx(0.3**2 * 25.0 / horizontal**2)
    assert float(found["offset_variance"]) == pytest.approx(0.06**2)
