"""The data of a calibration: the rests in records."""

from types import SimpleNamespace

import numpy as np
import pytest

from controller.calibration.file import Calibration
from controller.inverse_kinematics import leg_lengths
from hil.calibration import data as calibration_data
from hil.calibration.data import TO_50_UM, CalibrationData, Knowledge, find_rests, is_long, measured_lengths, was_read
from hil.calibration.procedure import SimulatedRig, every_cycle
from hil.loop.records import RECORD
from hil.runs.config import SimulationConfig
from plant.encoders import PRESETS
from plant.errors import CalibrationError
from plant.mechanism import load_spatial


def test_the_rest_at_home_is_the_one_on_the_brakes():
    config = SimulationConfig(imu="mpu9150", seed=7, target="hold", duration=0.1, hold=1.0)
    mechanism = load_spatial(config.mechanism)
    data = CalibrationData(mechanism, config.imu, config.rate, Knowledge(home=True), config.seed)
    data.begin(SimulatedRig().run_open(config, blind=True), 1000)
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


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("degrees", "still"), [(0.49, True), (0.51, False)])
def test_half_a_degree_per_second_of_any_axis_is_a_motion(sign, degrees, still):
    samples, zero = np.zeros((1050, 3, 7, 3)), np.full((7, 3), 0.2)
    samples[:, 0] = zero
    samples[300:600, 0, 6, 2] += sign * np.radians(degrees)
    # Forces and fields do not count, and what is left of a tenth of a second at the end is no mean.
    samples[:, 1:] = np.random.default_rng(0).normal(size=(1050, 2, 7, 3))
    assert find_rests(samples, zero, 1000.0) == ([slice(0, 1000)] if still else [slice(0, 300), slice(600, 1000)])


@pytest.mark.parametrize(("samples", "long"), [(450, True), (449, False)])
def test_a_rest_is_long_from_nine_tenths_of_a_second_on(samples, long):
    assert is_long(slice(1000, 1000 + samples), 500.0) == long


RATE = 500.0


def phases(*seconds, turning=0.3):
    """Records at 500 Hz that rest and turn by turns, beginning at rest; the forces tell the number of the sample."""
    counts = [round(each * RATE) for each in seconds]
    records = np.zeros(sum(counts), RECORD)
    records["length"], records["base_imu"] = np.nan, np.nan
    moving = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    records["cycle"] = np.arange(len(records))
    records["angular_velocity"] = 0.05
    records["angular_velocity"][moving] += turning
    records["specific_force"] = records["cycle"][:, None, None]
    records["truth"] = np.arange(len(records))[:, None] + 0.01 * np.arange(19)
    return records


def new_data(**knowledge):
    data = CalibrationData(load_spatial("hexapod"), "mpu9150", RATE, Knowledge(**knowledge), 3)
    data.zero[:] = 0.05
    return data


def test_the_first_half_second_of_a_rest_does_not_count():
    records = phases(2.0, 1.0, 0.8, 1.0, 0.9)
    assert new_data().rests_in(records) == [slice(250, 1000), slice(2650, 2850)]


def test_a_rest_is_the_means_of_its_readings_and_what_was_true_then(monkeypatch):
    monkeypatch.setattr(calibration_data, "check_all_along", lambda samples, rate: None)
    monkeypatch.setattr(calibration_data, "check_spread", lambda forces: None)
    records, random = phases(2.0, 1.0, 1.5), np.random.default_rng(4)
    for name in ("angular_velocity", "specific_force"):
        records[name] += 1e-4 * random.normal(size=(1, 7, 3))
    data = new_data(encoder=TO_50_UM)
    data.add_rests(records)
    assert data.readings.shape == (2, 7, 6)
    for rest, found, true in zip((slice(250, 1000), slice(1750, 2250)), data.readings, data.truth, strict=True):
        np.testing.assert_allclose(found[:, :3], records["angular_velocity"][rest].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(found[:, 3:], records["specific_force"][rest].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(true, records["truth"][rest].mean(axis=0)[:7], rtol=1e-12)
    # The lengths that a rig without encoders measures have a noise of 50 um.
    first, second = data.rests.lengths.values
    assert 1e-6 < np.abs(second - first - (1999.5 - 624.5)).max() < 5.0 * np.sqrt(2.0) * 5e-5
    assert new_data().rests.lengths is None
    records["truth"] = np.nan
    data.add_rests(records)
    with pytest.raises(CalibrationError, match="leave out --length-changes"):
        _ = data.rests


def on_a_base(records, degrees=0.0, rate=0.0):
    """The records with an IMU on the base, whose biases are 0.1 rad/s and 0.3 m/s^2; it tilts in the end, or turns."""
    records["base_imu"] = [[0.1, 0.0, 0.0], [0.0, 0.3, 9.80665]]
    last = records["base_imu"][-500:]
    last[:, 1, 0], last[:, 0, 2] = 9.80665 * np.radians(degrees), np.radians(rate)
    return records


def test_an_imu_on_the_base_is_calibrated_beside_the_others(monkeypatch):
    monkeypatch.setattr(calibration_data, "check_all_along", lambda samples, rate: None)
    data = new_data()
    data.add_rests(on_a_base(phases(2.0, 1.0, 1.5)))
    calibration = data.with_base(Calibration(tilt=np.array([0.002, 0.0])))
    rate, force = (calibration.base_gain @ data.base_readings[0].reshape(2, 3, 1))[..., 0] + calibration.base_offset
    np.testing.assert_allclose(rate, 0.0, atol=1e-4)
    # A turn by 0.002 rad about x takes the vertical towards -y.
    np.testing.assert_allclose(force, [0.0, -0.002 * 9.81, 9.81], atol=1e-4)
    without = new_data()
    without.add_rests(phases(2.0, 1.0, 1.5))
    untouched = Calibration()
    assert without.with_base(untouched) is untouched


@pytest.mark.parametrize(
    ("moved", "said"), [({"degrees": 0.3}, "0.00 deg/s and 0.30 deg of tilt"), ({"rate": 0.3}, "0.30 deg/s and 0.00 deg")]
)
def test_a_base_that_moves_is_told_while_its_imu_is_calibrated(monkeypatch, moved, said):
    monkeypatch.setattr(calibration_data, "check_all_along", lambda samples, rate: None)
    new_data().add_rests(on_a_base(phases(2.0, 1.0, 1.5), **{name: 0.5 * value for name, value in moved.items()}))
    with pytest.raises(CalibrationError, match=f"the base moves: .*{said}.*calibrate while it stands"):
        new_data().add_rests(on_a_base(phases(2.0, 1.0, 1.5), **moved))


@pytest.mark.parametrize("kind", ["incremental", "absolute"])
def test_encoders_count_from_home_in_every_run_unless_their_zeros_are_known(monkeypatch, hexapod, kind):
    monkeypatch.setattr(calibration_data, "check_all_along", lambda samples, rate: None)
    monkeypatch.setattr(calibration_data, "check_spread", lambda forces: None)
    data, encoder, known = new_data(encoder=PRESETS[kind]), PRESETS[kind], kind == "absolute"
    home = leg_lengths(hexapod, hexapod.home.position, hexapod.home.rotation)
    for zero in (0.3, 0.5):
        records = phases(2.0, 1.0, 1.5)
        records["length"] = zero + 1e-5 * np.arange(len(records))[:, None] + 0.01 * np.arange(6)
        # Lost readings are none.
        records["length"][[0, 624, 625], [1, 2, 2]] = np.nan
        as_read = records["length"].copy()
        data.add_rests(records)
        np.testing.assert_array_equal(records["length"], as_read)
    lengths = data.rests.lengths
    first = [0.3, 0.3, 0.5, 0.5] if known else [0.0] * 4
    moved = 1e-5 * (np.array([624.5, 1999.5] * 2) - (0 if known else 1))
    legs = 0.01 * np.arange(6) if known else home
    np.testing.assert_allclose(lengths.values, np.add.outer(first + moved, legs), atol=2e-8)
    spread = (0.5 * encoder.backlash) ** 2 + 2.0 * encoder.resolution**2 / 12.0
    runs = np.zeros(4) if known else np.array([0, 0, 1, 1])
    zeros = (5e-6 if known else 0.05) ** 2 * (runs[:, None] == runs)
    np.testing.assert_allclose(lengths.covariance, zeros + spread * np.eye(4), rtol=1e-9)


@pytest.mark.parametrize(("kept", "home"), [([0, 2, 3], True), ([1, 3], False), (None, True)])
def test_parts_of_the_rests_keep_what_is_known_of_them(monkeypatch, kept, home):
    monkeypatch.setattr(calibration_data, "check_spread", lambda forces: None)
    monkeypatch.setattr(calibration_data, "calibrate_at_rest", lambda mechanism, rests, prior: rests)
    data = new_data(encoder=PRESETS["incremental"], home=True)
    data.readings = np.random.default_rng(0).normal(size=(4, 7, 6))
    data._lengths, data._runs = np.random.default_rng(1).normal(size=(4, 6)), np.array([1.0, 1.0, 2.0, 2.0])
    rests = data.at_rest(None if kept is None else np.array(kept))
    chosen = kept or [0, 1, 2, 3]
    assert rests.home == home
    np.testing.assert_array_equal(rests.readings, data.readings[chosen])
    np.testing.assert_array_equal(rests.lengths.values, data._lengths[chosen])
    known = measured_lengths(data._lengths[chosen], data._runs[chosen], data.fusion)
    np.testing.assert_array_equal(rests.lengths.covariance, known.covariance)


def longest(monkeypatch, data, runs, calibration):
    """What `longest_motion` returns, and the forces at which it fits the pose."""
    fitted = []
    monkeypatch.setattr(calibration_data, "check_all_along", lambda samples, rate: None)
    monkeypatch.setattr(
        calibration_data, "fit_pose", lambda geometry, forces, home: fitted.append(forces) or (np.ones(3), np.eye(3))
    )
    motion = data.longest_motion(runs, SimpleNamespace(calibration=lambda: calibration))
    pose, twist = motion.start
    assert (pose.position == 1.0).all() and (twist == 0.0).all() and twist.shape == (6,)
    return motion, fitted[0]


def test_the_longest_motion_begins_with_the_last_tenth_of_its_rest(monkeypatch):
    runs = [phases(1.0, 12.0, 5.0), phases(2.0, 3.0, 1.6, 14.0, 1.0, 2.0), phases(1.0, 13.0)]
    calibration = Calibration()
    calibration.offset[1] = 0.25
    for records in runs:
        records["length"] = 1e-4 * records["cycle"][:, None]
    motion, forces = longest(monkeypatch, new_data(encoder=PRESETS["absolute"]), runs, calibration)
    samples = motion.samples
    # It begins at 6.6 s, and the pose is that of the half second before its last tenth at rest.
    first = round(6.5 * RATE)
    assert samples[0, 1, 0, 0] == first and samples[-1, 1, 0, 0] == round(20.6 * RATE) - 1
    np.testing.assert_allclose(motion.lengths, 1e-4 * samples[:, 1, :6, 0], rtol=1e-6)
    assert (np.diff(samples[:, 1, 3, 1]) == 1.0).all()
    np.testing.assert_allclose(forces, np.arange(first - 250, first).mean() + 0.25)


@pytest.mark.parametrize(("seconds", "said"), [(9.8, "at rest lasts 9.8 s; at least 10 s are needed"), (10.0, "")])
def test_a_motion_of_ten_seconds_is_long_enough(monkeypatch, seconds, said):
    runs = [phases(1.0, seconds, 1.0, 4.0)]
    if said:
        with pytest.raises(CalibrationError, match=said):
            longest(monkeypatch, new_data(), runs, Calibration())
    else:
        motion = longest(monkeypatch, new_data(), runs, Calibration())[0]
        assert len(motion.samples) == 5050 and motion.lengths is None


def test_the_planned_poses_are_those_of_the_planned_lengths(hexapod):
    random = np.random.default_rng(2)
    positions = hexapod.home.position + random.uniform(-0.02, 0.02, (5, 3))
    found = new_data().planned_poses(leg_lengths(hexapod, positions, np.tile(hexapod.home.rotation, (5, 1, 1))))
    np.testing.assert_allclose(found[0], positions, atol=1e-9)
    np.testing.assert_allclose(found[1], np.tile(hexapod.home.rotation, (5, 1, 1)), atol=1e-8)


def test_the_gyroscopes_are_zeroed_while_the_brakes_hold():
    records = phases(1.0, 2.0)
    records["angular_velocity"] += np.random.default_rng(0).normal(size=(7, 3))
    records["specific_force"] = 9.81 * np.array([0.0, 0.0, 1.0])
    data = new_data()
    data.begin(records, 400)
    np.testing.assert_allclose(data.zero, records["angular_velocity"][0], rtol=1e-12)
    assert len(data.readings) == 0


def test_the_record_before_stands_for_a_missed_one():
    records = np.zeros(4, RECORD)
    records["cycle"], records["missed"] = [0, 1, 4, 5], [0, 0, 2, 0]
    filled = every_cycle(records)
    assert filled["cycle"].tolist() == [0, 1, 1, 1, 4, 5]
    filled["silent"][5] = 1
    assert was_read(filled).tolist() == [True, True, False, False, True, False]


def test_what_was_not_read_is_none_of_a_motions_readings(monkeypatch):
    records = phases(1.0, 12.0)
    records["length"] = 0.5
    missed = np.r_[2000:2010, 3000]
    gappy = every_cycle(np.delete(records, missed))
    motion = longest(monkeypatch, new_data(encoder=PRESETS["absolute"]), [gappy], Calibration())[0]
    at = missed - (len(records) - len(motion.samples))
    assert np.flatnonzero(~motion.read).tolist() == at.tolist()
    assert np.flatnonzero(np.isnan(motion.lengths).any(axis=1)).tolist() == at.tolist()
    assert motion.used().shape == (len(motion.samples), 7) and (motion.used().sum(axis=1) == 7 * motion.read).all()
    half = motion.part(slice(int(at[5]), None), motion.start)
    assert half.read.sum() == motion.read[at[5] :].sum() and len(half.lengths) == len(half.samples)
