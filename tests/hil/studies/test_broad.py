"""The platform's filter on the BROAD benchmark: its real trials beside VQF, and made-up ones against what went in."""

import json
from dataclasses import replace

import numpy as np
import pytest

from controller.settings import FusionSettings
from hil.command_line import main
from hil.studies.broad import evaluate, filter_verticals, load_trial, simulated_trial
from hil.studies.fusion_comparison import vqf_verticals
from plant.dynamics.free_motion import SPECTRA
from plant.pose import quaternion_from_rotation, rotation_from_vector
from tests.conftest import SHARED_DATA

DEG = np.radians(1.0)
RATE_HZ = 250.0
TILT = 3.0 * DEG
WITHOUT_SIMULATED = ("--seeds", "0")
"""Motions, which would come before the trials of a folder."""


@pytest.fixture
def trial():
    """At rest and askew, with an optical reference that is off by 3 deg of inclination and any heading where it counts."""
    count, sensor = 1000, rotation_from_vector([0.4, -0.3, 0.2])
    seen = rotation_from_vector([0.0, 0.0, 0.7]) @ rotation_from_vector([TILT, 0.0, 0.0]) @ sensor
    quaternions = np.tile(quaternion_from_rotation(seen), (count, 1))
    quaternions[:100] = [0.0, 1.0, 0.0, 0.0]
    quaternions[500:600] = np.nan
    return {
        "imu_gyr": np.zeros((count, 3)),
        "imu_acc": np.tile(9.81 * sensor[2], (count, 1)),
        "opt_quat": quaternions.astype(np.float32),
        "movement": np.arange(count) >= 100,
        "sampling_rate": RATE_HZ,
    }


def test_the_score_is_the_inclination_where_it_counts(trial, tmp_path):
    np.savez(tmp_path / "rest.npz", **trial)
    figures = evaluate(tmp_path, FusionSettings())["trials"]["rest"]
    for method in ("filter", "vqf"):
        assert figures[method]["inclination_rms"] == pytest.approx(TILT, rel=1e-3), method
        assert 0.0 < figures[method]["us"] < 100.0
    assert (figures["samples"], figures["rate"]) == (1000, RATE_HZ)
    loaded = load_trial(tmp_path / "rest.npz")
    assert loaded.counts.sum() == 800
    assert loaded.inclination_rms(loaded.verticals) < 1e-9


def test_a_trial_whose_arrays_run_down_the_columns_is_read_all_the_same(trial, tmp_path):
    """As those that come from Matlab."""
    np.savez(tmp_path / "rest.npz", **{name: np.array(values, order="F") for name, values in trial.items()})
    figures = evaluate(tmp_path, FusionSettings())["trials"]["rest"]
    assert figures["vqf"]["inclination_rms"] == pytest.approx(TILT, rel=1e-3)


def test_on_real_data_as_good_as_vqf_and_vqf_as_published(tmp_path):
    """With one setting, that of the closed loop."""
    folder = SHARED_DATA / "broad"
    if not folder.exists():
        pytest.skip("the trials of BROAD are not here")
    path = tmp_path / "broad.json"
    assert main(["broad", str(folder), *WITHOUT_SIMULATED, "--json", str(path)]) == 0
    trials = json.loads(path.read_text())["trials"]
    assert len(trials) == 2
    for figures, published in zip(trials.values(), (0.43, 0.42), strict=True):
        assert figures["filter"]["inclination_rms"] <= 1.0 * figures["vqf"]["inclination_rms"]
        assert figures["vqf"]["inclination_rms"] == pytest.approx(published * DEG, abs=0.0051 * DEG)


@pytest.mark.parametrize("kind", SPECTRA)
def test_in_fast_motions_nearly_as_good_as_vqf(kind):
    """On seeds on which nothing was chosen."""
    trial = simulated_trial(kind, 31, duration=60.0)
    by_vqf = vqf_verticals(1.0 / trial.rate, trial.rates, trial.forces)
    assert trial.inclination_rms(filter_verticals(trial, FusionSettings())) < 1.5 * trial.inclination_rms(by_vqf)


def test_a_gyroscope_that_clips_for_a_fifth_of_a_second_costs_less_than_half_of_vqf_s_error():
    """Of 5-40 Hz the worst motion of seeds on which nothing was chosen: 6 deg are lost, which vqf does not know."""
    trial = simulated_trial("5-40 Hz", 15)
    by_vqf = vqf_verticals(1.0 / trial.rate, trial.rates, trial.forces)
    unaware = replace(trial, reach=np.inf)
    assert trial.inclination_rms(filter_verticals(trial, FusionSettings())) < 0.5 * trial.inclination_rms(by_vqf)
    assert trial.inclination_rms(filter_verticals(unaware, FusionSettings())) > 1.5 * trial.inclination_rms(by_vqf)


@pytest.mark.slow
def test_simulated_motions_are_beside_the_trials_or_alone(trial, tmp_path, capsys):
    np.savez(tmp_path / "rest.npz", **trial)
    path = tmp_path / "broad.json"
    assert main(["broad", "--json", str(path)]) == 0
    figures = json.loads(path.read_text())
    assert figures["trials"] == {}
    assert list(figures["simulated"]) == [f"{kind}, seed 1" for kind in SPECTRA]
    assert "bursts, seed 1" in capsys.readouterr().out
    assert main(["broad", *WITHOUT_SIMULATED]) == 2
    assert "no folder with trials and 0 simulated motions of each kind" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"imu_acc": None, "sampling_rate": None}, "lacks imu_acc, sampling_rate: a trial of BROAD has imu_gyr"),
        ({"imu_acc": np.ones((999, 3))}, "imu_acc has shape (999, 3); with imu_gyr of 1000 it must be (1000, 3)"),
        ({"imu_gyr": np.array(1.0)}, "imu_gyr has shape (); with imu_gyr of 1 it must be (1, 3)"),
        ({"imu_gyr": np.where(np.arange(3000).reshape(1000, 3) == 7, np.nan, 0.0)}, "imu_gyr is not finite in sample 2"),
        ({"movement": np.zeros(1000)}, "no sample counts"),
        ({"sampling_rate": -5.0}, "sampling_rate is -5.0; it must be one positive number"),
        ({"opt_quat": np.ones((1000, 4))}, "opt_quat has length 2 in sample 0; it must be 1"),
        ({"opt_quat": np.full((1000, 4), "north")}, "is no NumPy archive that can be read: could not convert"),
    ],
)
def test_what_is_no_trial_is_refused_in_a_line(trial, tmp_path, capsys, changes, said):
    np.savez(tmp_path / "bad.npz", **{name: value for name, value in (trial | changes).items() if value is not None})
    assert main(["broad", str(tmp_path), *WITHOUT_SIMULATED]) == 2
    complaint = capsys.readouterr().err
    assert f"bad.npz: {said}" in complaint or f"bad.npz {said}" in complaint
    assert complaint.count("\n") == 1


def test_a_folder_without_trials_a_broken_file_and_no_noise_are_refused(trial, tmp_path, capsys):
    for folder in (tmp_path, tmp_path / "missing"):
        assert main(["broad", str(folder)]) == 2
        assert f"{folder} is no folder with trials *.npz" in capsys.readouterr().err
    np.savez(tmp_path / "rest.npz", **trial)
    assert main(["broad", str(tmp_path), *WITHOUT_SIMULATED, "--accelerometer-noise", "0"]) == 2
    assert "platform_accelerometer_noise is 0.0; it must be positive" in capsys.readouterr().err
    (tmp_path / "torn.npz").write_bytes((tmp_path / "rest.npz").read_bytes()[:2000])
    assert main(["broad", str(tmp_path), *WITHOUT_SIMULATED]) == 2
    assert "torn.npz is no NumPy archive that can be read" in capsys.readouterr().err
