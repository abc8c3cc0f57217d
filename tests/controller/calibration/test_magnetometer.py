"""Calibration of a magnetometer by hand: hard and soft iron are recovered, and data that do not tell them are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.calibration.file import load_calibration
from controller.calibration.magnetometer import calibrate_magnetometer
from hil.command_line import main
from hil.recording.imu_data import COLUMNS, FIELD_COLUMNS
from plant.errors import CalibrationError
from plant.imu import SensorErrors, imu_state, load_imu, measure

RATE_HZ, GRAVITY = 200.0, 9.80665
FIELD = np.array([18.0, 0.0, -46.0])
STRENGTH = float(np.linalg.norm(FIELD))
DIP = np.arctan2(46.0, 18.0)
ALIGNED = np.eye(3)
MOUNTING = Rotation.from_rotvec([0.02, -0.03, 0.04]).as_matrix()
MODEL = replace(load_imu("mpu9150"), misalignment=0.0, accelerometer=SensorErrors(noise=4e-3))


def turned(seed=0, seconds=60.0, reach=np.pi, mounting=ALIGNED):
    """Raw fields and forces (N, 3) of an IMU that is turned by up to `reach` about its axes; its true gain and offset."""
    random = np.random.default_rng(seed)
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    rates, phases = random.uniform(0.3, 1.2, 3), random.uniform(0.0, 6.0, 3)
    back = Rotation.from_euler("zyx", reach * np.sin(rates * t[:, None] + phases)).inv()
    signals = np.zeros((len(t), 3, 7, 3))
    signals[:, 1, 6] = back.apply([0.0, 0.0, GRAVITY])
    signals[:, 2, 6] = back.apply(FIELD) @ mounting.T
    imu, raw = imu_state(MODEL, seed, 1.0 / RATE_HZ), np.zeros_like(signals)
    for signal, reading in zip(signals, raw, strict=True):
        measure(imu, signal, reading)
    gain = mounting.T @ np.linalg.inv(imu["gain"][2, 6])
    return raw[:, 2, 6], raw[:, 1, 6], gain, -gain @ imu["offset"][2, 6]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("mounting", [None, MOUNTING])
def test_hard_and_soft_iron_are_recovered(seed, mounting):
    """Without an accelerometer up to a rotation, which is none where the axes are mounted as they are; with one, that too."""
    fields, forces, gain, offset = turned(seed, mounting=ALIGNED if mounting is None else mounting)
    found = calibrate_magnetometer(fields, None if mounting is None else forces, STRENGTH, GRAVITY)
    assert np.abs(found.offset - offset).max() < 0.3
    assert np.abs(found.gain - gain).max() < 5e-3
    # The errors are of the size that is told: 12 or 9 of them, none beyond four deviations.
    errors = np.concatenate([found.offset - offset, (found.gain - gain).ravel()])
    told = found.sigmas > 0.0
    assert (np.abs(errors[told]) < 4.0 * found.sigmas[told]).all()
    assert found.samples == 1 + np.any(np.diff(fields, axis=0), axis=1).sum() <= 60.0 * 100.0
    noise = np.hypot(0.05 * np.sqrt(50.0), 0.3 / np.sqrt(12.0))
    assert found.field_residual == pytest.approx(noise, rel=0.1)
    if mounting is None:
        assert np.tril(found.gain, -1).any() == 0 and found.dip is None
    else:
        assert np.degrees(abs(found.dip - DIP)) < 0.1
        assert np.degrees(found.dip_residual) < 1.0
    # The raw reading was no use: 20 uT of hard iron.
    assert np.linalg.norm(np.linalg.solve(gain, offset)) == pytest.approx(20.0, rel=1e-9)


def test_samples_that_stand_count_once():
    fields, forces, *_ = turned(seconds=20.0)
    found = calibrate_magnetometer(fields, forces, STRENGTH, GRAVITY)
    repeated = calibrate_magnetometer(np.repeat(fields, 3, axis=0), np.repeat(forces, 3, axis=0), STRENGTH, GRAVITY)
    assert repeated.samples == found.samples
    np.testing.assert_array_equal(repeated.gain, found.gain)


@pytest.mark.slow
def test_data_that_do_not_tell_the_constants_are_refused_with_what_is_missing():
    def refused(match, fields, forces=None):
        with pytest.raises(CalibrationError, match=match):
            calibrate_magnetometer(fields, forces, STRENGTH, GRAVITY)

    fields, forces, *_ = turned()
    refused("there are 50 samples of the field; at least 100 are needed", fields[:100])
    refused(r"the field was never along \+x, -x.*: turn it", turned(reach=0.3)[0])
    refused("turn it slowly, and calibrate the accelerometer first", fields, 1.05 * forces)
    disturbed = fields.copy()
    disturbed[::3] += [15.0, 0.0, 0.0]
    refused("off by .* away from iron", disturbed)


def test_the_command_writes_what_the_cycle_applies(tmp_path, capsys):
    fields, forces, gain, offset = turned(mounting=MOUNTING)
    times = np.arange(len(fields)) / RATE_HZ
    data, output = tmp_path / "log.csv", tmp_path / "rig.toml"
    table = np.column_stack([times, np.zeros_like(forces), forces, fields])
    np.savetxt(data, table, delimiter=",", header=",".join((*COLUMNS, *FIELD_COLUMNS)), comments="")
    assert main(["calibrate", "magnetometer", str(data), str(output), "--json", str(tmp_path / "figures.json")]) == 0
    assert "dip" in capsys.readouterr().out
    calibration = load_calibration(output)
    np.testing.assert_allclose(calibration.gain[2, 6], gain, atol=5e-3)
    np.testing.assert_allclose(calibration.offset[2, 6], offset, atol=0.3)
    np.testing.assert_array_equal(calibration.gain[:2], np.tile(np.eye(3), (2, 7, 1, 1)))
    np.savetxt(data, table[:, [0, 7, 8, 9]], delimiter=",", header="time_s,mx,my,mz", comments="")
    assert main(["calibrate", "magnetometer", str(data), str(output), "--number", "2"]) == 0
    assert np.tril(load_calibration(output).gain[2, 2], -1) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--field", "4"], "--field is 4 uT; on the earth it is between 20 and 70"),
        (["--gravity", "98"], "--gravity is 98 m/s2"),
        ([], "cannot read none.csv"),
    ],
)
def test_bad_input_is_refused_in_a_line(arguments, complaint, capsys, tmp_path):
    assert main(["calibrate", "magnetometer", "none.csv", str(tmp_path / "rig.toml"), *arguments]) == 2
    assert complaint in capsys.readouterr().err
