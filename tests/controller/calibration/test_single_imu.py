"""Calibration of a single IMU by hand: simulated constants are recovered, and data that do not tell them are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from controller.calibration.single_imu import calibrate_imu, deviations_of, missing_half_axes
from hil.command_line import main
from hil.recording.imu_data import COLUMNS
from plant.errors import CalibrationError
from plant.imu import MILLI_G, imu_state, load_imu, measure

RATE_HZ, GRAVITY = 500.0, 9.80665
UPS = np.array(
    [
        *([0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]),
        *([1, 1, 0], [0, 1, 1], [1, 0, 1], [0, -1, 1], [-1, 0, 1], [-1, 1, 0], [0, 1, -1]),
        *([-1, 1, 1], [1, -1, 1], [1, 1, -1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, -1]),
    ],
    float,
)
RAW = replace(load_imu("mpu9150"), misalignment=0.0)


def by_hand(ups=UPS, rest_s=2.0, turn_s=2.0, seed=0, model=RAW):
    """Raw readings of an IMU that rests with each of `ups` (n, 3) up and is turned in between; and its true gain and offset."""
    random = np.random.default_rng(seed)
    poses = []
    for up in ups:
        tilt = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up / np.linalg.norm(up)])[0]
        poses.append(Rotation.from_rotvec([0.0, 0.0, random.uniform(-2.0, 2.0)]) * tilt)
    keys, times = [poses[0]], [0.0]
    for pose in poses:
        keys += [pose, pose]
        times += [times[-1] + turn_s, times[-1] + turn_s + rest_s]
    # Smooth starts and stops: time runs along the turn like a raised cosine.
    sampled = np.arange(0.0, times[-1], 1.0 / RATE_HZ)

    def eased(at):
        i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
        start, stop = np.array(times)[i], np.array(times)[i + 1]
        return start + (stop - start) * 0.5 * (1.0 - np.cos(np.pi * np.clip((at - start) / (stop - start), 0.0, 1.0)))

    slerp, h = Slerp(times, Rotation.concatenate(keys)), 1e-4
    here = slerp(eased(sampled))
    after, before = slerp(eased(np.minimum(sampled + h, times[-1]))), slerp(eased(np.maximum(sampled - h, 0.0)))
    signals = np.zeros((len(sampled), 3, 7, 3))
    signals[:, 0] = ((before.inv() * after).as_rotvec() / (2.0 * h))[:, None]
    signals[:, 1] = here.inv().apply([0.0, 0.0, GRAVITY])[:, None]
    imu, raw = imu_state(model, seed, 1.0 / RATE_HZ), np.zeros((len(sampled), 3, 7, 3))
    for signal, reading in zip(signals, raw, strict=True):
        measure(imu, signal, reading)
    gain = np.linalg.inv(imu["gain"][:2, 0])
    return sampled, raw[:, 0, 0], raw[:, 1, 0], gain, -(gain @ imu["offset"][:2, 0, :, None])[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_simulated_constants_are_recovered(seed):
    *data, gain, offset = by_hand(seed=seed)
    found = calibrate_imu(*data, GRAVITY)
    assert found.rests == len(UPS) + 1 or found.rests == len(UPS)
    assert np.abs(found.offset[1] - offset[1]).max() < MILLI_G
    assert np.degrees(np.abs(found.offset[0] - offset[0]).max()) < 0.05
    scales = np.abs(np.diagonal(found.gain, axis1=1, axis2=2) / np.diagonal(gain, axis1=1, axis2=2) - 1.0)
    assert scales.max() < 5e-4
    off_axis = (found.gain - gain)[:, ~np.eye(3, dtype=bool)]
    assert np.degrees(np.abs(off_axis).max()) < 0.05
    assert found.force_residual < 0.5 * MILLI_G
    # The deviations that it claims are those that it has.
    error = np.concatenate([found.offset[1] - offset[1], (found.gain - gain)[1][np.triu_indices(3)]])
    sigmas = np.concatenate([found.sigmas[1, :3], found.sigmas[1, 3:].reshape(3, 3)[np.triu_indices(3)]])
    assert np.sqrt(np.mean((error / sigmas) ** 2)) < 3.0


def test_too_few_rests_are_refused():
    *data, _, _ = by_hand(UPS[:5])
    with pytest.raises(CalibrationError, match=r"there are [56] rests of at least 0\.5 s; at least 9 in other orientations"):
        calibrate_imu(*data, GRAVITY)


def test_the_orientation_that_is_missing_is_named():
    askew = np.array([[1, 1, 4], [-1, 1, 4], [1, -1, 4], [-1, -1, 4], [2, 0, 4], [-2, 0, 4], [0, 2, 4]], float)
    *data, _, _ = by_hand(np.concatenate([UPS[[0, 2, 3, 4, 5]], askew]))
    with pytest.raises(CalibrationError, match="no rest has -z up: rest in these orientations too"):
        calibrate_imu(*data, GRAVITY)


def test_data_without_a_rest_are_refused():
    random = np.random.default_rng(0)
    times = np.arange(0.0, 20.0, 1.0 / RATE_HZ)
    with pytest.raises(CalibrationError, match="there are 0 rests"):
        calibrate_imu(
            times,
            random.normal(0.0, 1.0, (len(times), 3)) + np.sin(times)[:, None] * 3.0,
            random.normal(size=(len(times), 3)),
            GRAVITY,
        )


def write_csv(path, times, rates, forces):
    np.savetxt(path, np.column_stack([times, rates, forces]), delimiter=",", header=",".join(COLUMNS), comments="")
    return path


def test_the_command_writes_a_calibration_that_undoes_the_errors(tmp_path, capsys):
    from controller.calibration.file import load_calibration

    times, rates, forces, gain, offset = by_hand()
    file, output = write_csv(tmp_path / "imu.csv", times, rates, forces), tmp_path / "rig.toml"
    output.write_text("[imu_2.gyroscope]\nbias = [0.1, 0.0, 0.0]\n")
    assert main(["calibrate", "imu", str(file), str(output), "--number", "4"]) == 0
    assert "residuals: gravity 0." in capsys.readouterr().out
    calibration = load_calibration(output)
    np.testing.assert_allclose(calibration.gain[:2, 4], gain, atol=1e-3)
    np.testing.assert_allclose(calibration.offset[:2, 4], offset, atol=0.01)
    assert calibration.offset[0, 2, 0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t,x\n1,2\n", "the header must be time_s,wx,wy,wz,ax,ay,az"),
        (",".join(COLUMNS) + "\n0,0,0,0,0,0,a\n", "line 2: '0,0,0,0,0,0,a' is not a row of 7 finite numbers"),
        (
            ",".join(COLUMNS) + "\n0,0,0,0,0,0,nan\n0.1,0,0,0,0,0,1\n",
            "line 2: '0,0,0,0,0,0,nan' is not a row of 7 finite numbers: az is nan",
        ),
        (
            ",".join(COLUMNS) + "\n0,0,0,0,0,0,1\n0.1,0,0,0,0,0,1\n0.2,0,0,0,0,0,1\n0.9,0,0,0,0,0,1\n",
            "line 5: the samples must be evenly spaced",
        ),
    ],
)
def test_a_malformed_file_is_refused_by_its_line(tmp_path, text, complaint, capsys):
    path = tmp_path / "imu.csv"
    path.write_text(text)
    assert main(["calibrate", "imu", str(path), str(tmp_path / "c.toml")]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("sign", "name"), [(1.0, "+"), (-1.0, "-")])
def test_the_half_axis_without_a_vector_is_named(axis, sign, name):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    assert missing_half_axes(axes) == []
    tilted = sign * np.eye(3)[axis] * 0.74 + np.eye(3)[(axis + 1) % 3] * np.sqrt(1.0 - 0.74**2)
    others = axes[axes[:, axis] * sign < 0.5]
    assert missing_half_axes(np.vstack([others, tilted])) == [f"{name}{'xyz'[axis]}"]
    assert missing_half_axes(np.vstack([others, tilted + 0.02 * sign * np.eye(3)[axis]])) == []


def test_the_deviations_of_a_fit_are_those_of_linear_regression():
    """By the noise: over many straight lines with slope and offset, which are off by as much as is told."""
    random, x = np.random.default_rng(4), np.linspace(-1.0, 2.0, 12)
    jacobian, off, told = np.column_stack([np.ones(12), x]), [], []
    for _ in range(4000):
        noise = random.normal(0.0, 0.3, 12)
        fit = np.linalg.lstsq(jacobian, noise, rcond=None)[0]
        off.append(fit)
        told.append(deviations_of(jacobian, jacobian @ fit - noise, 10))
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(told), axis=0)), np.std(off, axis=0), rtol=0.05)
