"""Whether IMUs live, sit and are wired as they should be: readings of a small imposed motion, spoilt in every way."""

import re

import numpy as np
import pytest

from controller.calibration.mounting_checks import check_alive, check_all_along, check_motion, check_places, check_spread
from controller.estimation.whole_mechanism.readings import readings_along
from controller.rig import sensor_geometry
from plant.dynamics.imposed_motion import impose
from plant.errors import CalibrationError
from plant.imu import Wiring, imu_state, load_imu, measure
from tests.controller.leg_geometry import rotation_of

RATE = 250.0
PLACES = tuple(range(7))
RIGHT = ("+x+y+z",) * 7
KEPT = slice(5, -5)


@pytest.fixture(scope="module")
def motion(hexapod):
    return impose(hexapod, "0.8", 3.0, RATE, 1, size=(0.006, np.radians(2.0)))


def read(motion, wiring, seed=2):
    imu, samples = imu_state(load_imu("mpu9150"), seed, 1.0 / RATE, wiring), np.zeros_like(motion.signals)
    for signals, sample in zip(motion.signals, samples, strict=True):
        measure(imu, signals, sample)
    samples[:, 0] -= imu["offset"][0, :7]
    return np.concatenate([samples[:, 0], samples[:, 1]], axis=2)


def expected(hexapod, motion):
    return readings_along(sensor_geometry(hexapod), motion.positions, motion.rotations, RATE)


def axes(imu, text):
    return tuple(text if k == imu else right for k, right in enumerate(RIGHT))


def test_what_is_expected_along_a_motion_is_what_the_plant_gives(hexapod, motion):
    ideal = np.concatenate([motion.signals[:, 0], motion.signals[:, 1]], axis=2)[KEPT]
    np.testing.assert_allclose(expected(hexapod, motion)[KEPT], ideal, atol=2e-3 * 9.8)


@pytest.mark.parametrize("seed", range(5))
def test_raw_imus_pass(hexapod, motion, seed):
    check_places(read(motion, Wiring(), seed)[KEPT], expected(hexapod, motion)[KEPT])


@pytest.mark.parametrize(
    ("wrong", "wiring", "words"),
    [
        ("13", Wiring(places=(0, 3, 2, 1, 4, 5, 6)), "IMUs 1 and 3 are swapped"),
        ("06", Wiring(places=(6, 1, 2, 3, 4, 5, 0)), "IMUs 0 and 6 are swapped"),
        ("012", Wiring(places=(1, 2, 0, 3, 4, 5, 6)), "IMU 0 sits where IMU 1 should"),
        ("3", Wiring(PLACES, axes(3, "-y+x+z"), axes(3, "-y+x+z")), "turned by 90 deg about -z"),
        ("6", Wiring(PLACES, axes(6, "-x-y+z"), axes(6, "-x-y+z")), "IMU 6 reads -x-y+z"),
        ("2", Wiring(PLACES, axes(2, "+x-y-z"), axes(2, "+x-y-z")), "turned by 180 deg about +x"),
        (
            "5",
            Wiring(PLACES, axes(5, "-x+y+z"), axes(5, "-x+y+z")),
            "IMU 5 reads -x+y+z for its x, y and z, the sign of x wrong",
        ),
        ("4", Wiring(PLACES, axes(4, "-x-y-z"), RIGHT), "the gyroscope of IMU 4 reads -x-y-z"),
        ("4", Wiring(PLACES, RIGHT, axes(4, "-x-y-z")), "the accelerometer of IMU 4 reads -x-y-z"),
        ("1", Wiring(PLACES, axes(1, "000"), RIGHT), "the gyroscope of IMU 1 reads 0"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_else(hexapod, motion, wrong, wiring, words):
    with pytest.raises(CalibrationError, match="IMU") as raised:
        check_places(read(motion, wiring)[KEPT], expected(hexapod, motion)[KEPT])
    assert words in str(raised.value)
    assert set(re.findall(r"IMUs? (\d)", str(raised.value))) <= set(wrong)


def test_an_imu_that_does_not_take_part_is_named(hexapod, motion):
    readings = read(motion, Wiring())[KEPT]
    readings[:, 4] = readings[0, 4]
    with pytest.raises(CalibrationError, match="leg 4 does not move"):
        check_places(readings, expected(hexapod, motion)[KEPT])
    with pytest.raises(CalibrationError, match="hardly moves"):
        check_motion(np.zeros((100, 7, 3)))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda own: np.full_like(own, np.nan), "not finite"),
        (lambda own: np.broadcast_to(own[0], own.shape), "is frozen"),
        (lambda own: 0.1 * own, "reads 0.981 m/s2 at rest"),
    ],
)
def test_an_imu_that_is_dead_at_rest_is_named(spoil, words):
    samples = np.random.default_rng(0).normal(0.0, 0.01, (500, 3, 7, 3))
    samples[:, 1, :, 2] += 9.81
    check_alive(samples)
    samples[:, :, 5] = spoil(samples[:, :, 5])
    with pytest.raises(CalibrationError, match=f"IMU 5.*{words}"):
        check_alive(samples)


def test_rests_that_are_alike_and_legs_that_stand_are_named():
    forces = np.random.default_rng(0).normal(0.0, 1.0, (10, 7, 3)) + [0.0, 0.0, 9.81]
    check_spread(forces)
    still = forces.copy()
    still[:, 2] = still[0, 2]
    with pytest.raises(CalibrationError, match=r"IMU 2 turns by .* the others by 19; .* leg 2 does not move"):
        check_spread(still)
    with pytest.raises(CalibrationError, match="too alike"):
        check_spread(np.array([0.0, 0.0, 9.81]) + 0.01 * (forces - forces.mean(axis=0)))


def test_an_imu_that_is_lost_in_a_run_is_named_with_the_time():
    samples = np.random.default_rng(0).normal(size=(1000, 3, 7, 3))
    samples[:, 2] = np.nan
    # A period that was missed: all stand.
    samples[300:350] = samples[299]
    check_all_along(samples, RATE)
    frozen = samples.copy()
    frozen[600:850, :, 4] = frozen[599, :, 4]
    with pytest.raises(CalibrationError, match=r"IMU 4 is frozen while others are not 2\.4 s into a run"):
        check_all_along(frozen, RATE)
    samples[500:, 1, 2, 0] = np.nan
    with pytest.raises(CalibrationError, match="IMU 2 gives readings that are not finite 2 s into a run, for 2 s in all"):
        check_all_along(samples, RATE)


@pytest.mark.parametrize(("share", "fits"), [(0.69, False), (0.71, True), (1.29, True), (1.31, False)])
def test_gravity_at_rest_may_be_off_by_three_tenths(share, fits):
    samples = np.random.default_rng(0).normal(0.0, 0.001, (500, 3, 7, 3))
    samples[:, 1, :, 2] += 9.80665
    samples[:, 1, 3] *= share
    if fits:
        check_alive(samples)
    else:
        with pytest.raises(CalibrationError, match=rf"the accelerometer of IMU 3 reads {9.80665 * share:.3g} m/s2 at rest"):
            check_alive(samples)


@pytest.mark.parametrize("sensor", [0, 1])
@pytest.mark.parametrize(("repeats", "fits"), [(24, True), (25, False)])
def test_an_imu_may_stand_for_less_than_a_tenth_of_a_second(sensor, repeats, fits):
    """One sensor alone that stands is at rest; the IMU is frozen if both stand."""
    samples = np.random.default_rng(0).normal(size=(1000, 3, 7, 3))
    alone, both = samples.copy(), samples
    alone[401 : 401 + 200, sensor, 6] = alone[400, sensor, 6]
    check_all_along(alone, RATE)
    both[401 : 401 + repeats, :, 6] = both[400, :, 6]
    if fits:
        check_all_along(both, RATE)
    else:
        with pytest.raises(CalibrationError, match=r"IMU 6 is frozen while others are not 1\.6 s into a run, for 0\.004 s"):
            check_all_along(both, RATE)


@pytest.mark.parametrize(("rate", "fits"), [(0.95, False), (1.05, True), (-1.05, True)])
def test_a_motion_turns_some_imu_at_a_degree_per_second(rate, fits):
    rates = np.zeros((100, 7, 3))
    rates[:, 5] = np.radians(rate) * np.array([0.6, 0.0, 0.8])
    if fits:
        check_motion(rates)
    else:
        with pytest.raises(CalibrationError, match=r"no IMU turns at more than 0\.95 deg/s RMS; at least 1 are needed"):
            check_motion(rates)


def test_an_accelerometer_that_reads_no_changes_is_named(hexapod, motion):
    readings = read(motion, Wiring())[KEPT]
    readings[:, 2, 3:] = readings[:, 2, 3:].mean(axis=0) + 0.1 * (readings[:, 2, 3:] - readings[:, 2, 3:].mean(axis=0))
    with pytest.raises(
        CalibrationError, match=r"the accelerometer of IMU 2 reads 0\.\d+ of the expected changes, and at least 0\.2"
    ):
        check_places(readings, expected(hexapod, motion)[KEPT])


@pytest.mark.parametrize(("angle", "fits"), [(10.0, True), (-10.0, True), (25.0, False), (-25.0, False)])
def test_an_imu_that_leans_is_named_with_its_angle(hexapod, motion, angle, fits):
    ideal = np.concatenate([motion.signals[:, 0], motion.signals[:, 1]], axis=2)[KEPT]
    lean = rotation_of([np.radians(angle), 0.0, 0.0])
    ideal[:, 6, :3], ideal[:, 6, 3:] = ideal[:, 6, :3] @ lean, ideal[:, 6, 3:] @ lean
    if fits:
        check_places(ideal, expected(hexapod, motion)[KEPT])
    else:
        with pytest.raises(
            CalibrationError, match=r"^gravity at IMU 6 is 2[45]\.?\d* deg off the expected direction; at most 15 deg"
        ):
            check_places(ideal, expected(hexapod, motion)[KEPT])
