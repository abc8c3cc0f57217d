"""The rig as the controller knows it: the vertical, the magnetic field, the hold and the time, with a base that leans."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.rig import RIG, TIME, elapsed, field_of, rig_parameters, sensor_geometry, tilt_rotation
from controller.settings import FusionSettings
from plant.mechanism import Mechanism, load_in_space
from tests.controller.leg_geometry import unit

TILT = np.array([0.02, -0.05])
WORLD = Rotation.from_rotvec([0.02, -0.05, 0.0]).as_matrix()
FIELD = np.array([18.0, 5.0, -46.0])


@pytest.fixture(scope="module")
def leaning(hexapod):
    """A hexapod whose vertical leans, with IMUs at places of their own."""
    up, random = unit([0.1, -0.2, 0.9]), np.random.default_rng(0)
    places = {"leg_imu_position": random.normal(0.0, 0.05, (6, 3)), "platform_imu_position": random.normal(0.0, 0.05, 3)}
    return Mechanism.from_legs(
        hexapod.base_joints, hexapod.platform_joints, up_in_base=up, home=hexapod.home, limits={"stroke": (-0.06, 0.06)},
        plant={**hexapod.plant, "gravity": -9.7 * up, "magnetic_field": FIELD, **places},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("tilt", "start", "end"),
    [
        ([1, 0], [0, 1, 0], [0, 0, 1]), ([-1, 0], [0, 1, 0], [0, 0, -1]),
        ([0, 1], [0, 0, 1], [1, 0, 0]), ([0, -1], [1, 0, 0], [0, 0, 1]),
    ],
)  # fmt: skip
def test_a_quarter_turn_about_x_and_about_y(tilt, start, end):
    np.testing.assert_allclose(tilt_rotation(0.5 * np.pi * np.array(tilt)) @ start, end, atol=1e-15)


def test_a_tilt_turns_the_vertical_and_the_field_and_nothing_else(leaning):
    geometry, up = sensor_geometry(leaning, TILT), leaning.up_in_base
    np.testing.assert_allclose(geometry["up_in_base"], [WORLD @ up], atol=1e-15)
    for leg in range(6):
        np.testing.assert_allclose(geometry["up_in_joint"][leg], leaning.joint_rotations[leg].T @ WORLD @ up, atol=1e-15)
    assert geometry["gravity"] == pytest.approx(9.7, rel=1e-14)
    for name, expected in (
        ("base_joints", leaning.base_joints),
        ("platform_joints", leaning.platform_joints),
        ("joint_rotations", leaning.joint_rotations),
        ("leg_imu_position", leaning.plant["leg_imu_position"]),
        ("platform_imu_position", leaning.plant["platform_imu_position"]),
    ):
        np.testing.assert_array_equal(geometry[name], expected, err_msg=name)
    north = unit(FIELD - (FIELD @ up) * up)
    field = field_of(leaning, TILT)
    np.testing.assert_allclose(field.vectors, [WORLD @ up, WORLD @ north], atol=1e-14)
    np.testing.assert_allclose(rig_parameters(leaning, 100.0, 0.2, TILT)["vectors_in_base"], field.vectors)
    np.testing.assert_allclose(rig_parameters(leaning, 100.0, 0.2, TILT)["sensors"]["up_in_base"], [WORLD @ up], atol=1e-15)


def test_the_fields_parts_are_those_along_and_across_the_vertical(leaning, hexapod):
    field, up = field_of(leaning), leaning.up_in_base
    assert field.vertical == pytest.approx(FIELD @ up, rel=1e-14) and field.vertical < 0.0
    assert field.horizontal == pytest.approx(np.linalg.norm(np.cross(up, FIELD)), rel=1e-13)
    assert field.strength == pytest.approx(np.linalg.norm(FIELD), rel=1e-14)
    np.testing.assert_allclose(field.horizontal * field.vectors[1] + field.vertical * up, FIELD, atol=1e-13)
    bare = Mechanism.from_legs(hexapod.base_joints, hexapod.platform_joints)
    none = field_of(bare)
    assert none.vertical == 0.0 and none.horizontal < 1e-6 and not none.vectors[1].any()


@pytest.mark.parametrize(("cycles", "samples"), [(1000.0, 80.0), (50.0, 50.0), (80.0, 80.0)])
def test_the_headings_variance_is_that_of_the_samples_that_come(leaning, cycles, samples):
    """A white density d over samples at a rate f has the variance d^2 f / 2; across a field B that is an angle of d / B."""
    field, fusion = field_of(leaning), FusionSettings(magnetometer_noise=0.3, magnetometer_rate=80.0)
    expected = 0.3**2 * samples / 2.0 / np.linalg.norm(np.cross(leaning.up_in_base, FIELD)) ** 2
    assert field.heading_variance(fusion, cycles) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("rate", "hold", "cycles"),
    [(500.0, 0.2, 100), (1000.0, 0.2, 200), (300.0, 0.011, 4), (100.0, 0.0101, 2), (700.0, 0.3, 210)],
)
def test_the_hold_is_whole_cycles_and_never_shorter_than_asked_for(hexapod, rate, hold, cycles):
    rig = rig_parameters(hexapod, rate, hold, np.zeros(2))
    assert rig["hold_cycles"] == cycles
    assert rig["period"] == 1.0 / rate
    assert (rig["legs"], rig["planar"]) == (6, 0)


def test_a_planar_rig_has_three_legs_in_the_first_rows():
    rig = rig_parameters(load_in_space("planar-3rpr"), 200.0, 0.2, np.zeros(2))
    assert (rig["legs"], rig["planar"]) == (3, 1)
    np.testing.assert_allclose(rig["vectors_in_base"], [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_array_equal(rig["sensors"]["platform_joints"][:3], [[0.0, 0.0, 0.0], [0.07, 0.0, 0.0], [0.1, 0.0, 0.0]])


@pytest.mark.parametrize(("missed", "periods"), [(0, 1), (1, 2), (7, 8)])
def test_the_time_since_the_last_cycle_counts_the_missed_periods(missed, periods):
    rig, time = np.zeros((), RIG), np.zeros((), TIME)
    rig["period"], time["missed"], time["cycle"] = 4e-3, missed, 100
    assert elapsed(rig[()], time[()]) == pytest.approx(4e-3 * periods, rel=1e-15)
