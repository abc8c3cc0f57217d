"""Calibration on the rig: a hexapod on its FMU plant finds the errors of its raw IMUs, and then follows a motion with them."""

import json
from dataclasses import asdict
from xml.etree import ElementTree

import numpy as np
import pytest

from hil.calibration.data import TO_50_UM, Knowledge
from hil.calibration.procedure import calibrate_recordings, calibrate_rig
from hil.command_line import main
from hil.loop.records import Link
from hil.recording.mcap import Recorder
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import simulate
from plant.errors import CalibrationError
from plant.imu import Wiring, imu_state, load_imu
from tests.once import made_once

pytestmark = pytest.mark.slow(seconds=60)
"""The calibration takes 20 s; `test_drives` and the calibrations of `controller` stay in `make test`."""


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    def calibrate(folder):
        outputs = [folder / "rig.toml"]
        for option, name in (("--json", "json"), ("--report", "html"), ("--picture", "svg")):
            outputs += [option, folder / f"rig.{name}"]
        assert main(["calibrate", "rig", "--seed", "1", *map(str, outputs)]) == 0

    file = made_once(tmp_path_factory, "calibration", calibrate) / "rig.toml"
    return file, json.loads(file.with_suffix(".json").read_text())


@pytest.fixture(scope="module")
def recorded(calibrated, tmp_path_factory):
    """Runs of a rig that has been calibrated, with what it really did, and without."""
    common = {"imu": "mpu9150", "seed": 1, "calibration": str(calibrated[0])}

    def record_all(folder):
        for target, duration in (("rests", 30.0), ("shaking", 20.0)):
            record(folder / f"{target}.mcap", SimulationConfig(target=target, duration=duration, **common))
        record(folder / "blind.mcap", SimulationConfig(target="rests", duration=30.0, **common), np.nan)

    return made_once(tmp_path_factory, "recordings", record_all)


def record(path, config, truth=None):
    with prepared_loop(config) as loop:
        loop.run(loop.end)
        records = loop.records[: int(loop.link[Link.HEAD])]
        if truth is not None:
            records["truth"] = truth
        header = {"config": {**asdict(config), "version": "0"}, "parameters": loop.parameters, "reference": loop.segments}
        recorder = Recorder(path, header, 0)
        recorder.write(records)
        recorder.close()


def test_it_brings_the_pose_at_rest_down_tenfold_and_says_so(calibrated):
    _, figures = calibrated
    before, rests, motion = (figures["true"][name]["position_rms"] for name in ("before", "rests", "motion"))
    assert rests < before / 5.0
    assert motion < before / 10.0
    assert motion < 0.4e-3
    assert figures["true"]["motion"]["rotation_rms"] < np.radians(0.1)
    assert 1.0 / 1.5 < motion / figures["predicted"]["motion"]["position_rms"] < 1.5
    assert figures["residual_mg"]["motion"] < 0.4
    assert figures["weakest"].startswith("mostly ")


def test_what_it_says_of_itself_without_the_truth_is_honest(calibrated):
    file, figures = calibrated
    for stage in ("rests", "motion"):
        ratio = figures["validated"][stage]["position_rms"] / figures["true"][stage]["position_rms"]
        assert 0.5 < ratio < 4.0
    assert figures["residual_mg"]["rests"] < figures["validated"]["rests"]["left_out_mg"] < 0.5
    imu = imu_state(load_imu("mpu9150"), 1, 1e-3)
    for sensor, name in enumerate(("gyroscope bias", "accelerometer bias")):
        found = figures["constants"][name]
        normalised = (np.array(found["values"]) + imu["offset"][sensor, :7]) / found["sigmas"]
        assert 0.3 < np.sqrt(np.mean(normalised**2)) < 2.0
    page = file.with_suffix(".html").read_text()
    assert all(f'id="{name}"' in page for name in ("rests", "accuracy", "residuals", "constants"))
    picture = ElementTree.parse(file.with_suffix(".svg"))
    assert f"{1e3 * figures['true']['motion']['position_rms']:.3g}" in {text.text for text in picture.iter() if text.text}


@pytest.mark.endurance
def test_recordings_tell_the_same_and_known_poses_less(recorded):
    files = [recorded / "shaking.mcap", recorded / "rests.mcap"]
    summary = calibrate_recordings(files).summary
    assert summary["true"]["motion"]["position_rms"] < 0.4e-3
    result = calibrate_recordings(files, Knowledge(known_poses=True, encoder=TO_50_UM))
    true = result.summary["true"]
    assert true["rests"]["position_rms"] < summary["true"]["rests"]["position_rms"]
    assert true["motion"]["rotation_rms"] < 0.1 * true["known"]["rotation_rms"]
    assert true["known"]["rotation_rms"] < 0.6 * true["before"]["rotation_rms"]
    imu = imu_state(load_imu("mpu9150"), 1, 1e-3)
    turned = result.calibration.gain[1] @ imu["gain"][1, :7]
    before = imu["gain"][1, :7]
    skew = [np.linalg.norm(each - np.swapaxes(each, 1, 2)) for each in (before, turned)]
    assert skew[1] < 0.7 * skew[0]


def test_recordings_that_do_not_suffice_are_refused(recorded, tmp_path, capsys):
    output = tmp_path / "c.toml"

    def refusal(*arguments):
        assert main(["calibrate", "rig", str(output), "--recording", *arguments]) == 2
        assert not output.exists()
        return capsys.readouterr().err

    rests, shaking, blind = (str(recorded / f"{name}.mcap") for name in ("rests", "shaking", "blind"))
    assert "at least 10 s are needed" in refusal(rests)
    assert "0 poses at rest" in refusal(shaking)
    assert "leave out --length-changes" in refusal(blind, shaking, "--lengths")
    assert "no recording" in refusal(str(tmp_path / "none.mcap"))
    record(other := tmp_path / "other.mcap", SimulationConfig(target="hold", duration=0.2, rate=500.0))
    assert "give recordings of one rig" in refusal(rests, str(other))


@pytest.mark.endurance
def test_recordings_without_the_truth_suffice(recorded, tmp_path, capsys):
    blind, shaking = (str(recorded / f"{name}.mcap") for name in ("blind", "shaking"))
    assert main(["calibrate", "rig", str(tmp_path / "c.toml"), "--recording", blind, shaking]) == 0
    assert "and in motion" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("wiring", "words"),
    [
        (Wiring(places=(0, 2, 1, 3, 4, 5, 6)), "IMUs 1 and 2 are swapped"),
        (Wiring(accelerometers=("+x+y+z",) * 5 + ("+x+y-z", "+x+y+z")), "the accelerometer of IMU 5 reads \\+x\\+y-z"),
    ],
)
def test_a_rig_that_is_wired_wrongly_is_not_driven_by_its_imus(wiring, words, monkeypatch):
    monkeypatch.setattr("hil.calibration.procedure.simulate", None)
    with pytest.raises(CalibrationError, match=words):
        calibrate_rig(SimulationConfig(imu="mpu9150", wiring=wiring))


def test_raw_imus_follow_with_it_what_they_cannot_follow_without(calibrated):
    file, _ = calibrated
    result = simulate(
        SimulationConfig(target="sines", duration=15.0, imu="mpu9150", seed=1, calibration=str(file), fusion="whole-alignments")
    )
    late = result.times > 8.0
    error = np.linalg.norm(result.records["position"] - result.true_positions, axis=1)[late]
    assert np.sqrt(np.mean(error**2)) < 0.25e-3
    assert result.records["trusted"][late].all()


@pytest.mark.parametrize("tilt", ["0", "-1", "nan", "90"])
def test_a_tilt_that_is_none_is_refused(tmp_path, tilt, capsys):
    assert main(["calibrate", "rig", str(tmp_path / "c.toml"), "--tilt", tilt]) == 2
    assert "must be between 0 and 45" in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()
