"""Calibration on the rig: a hexapod on its FMU plant finds the errors of its raw IMUs, and then follows a motion with them."""

import json

import numpy as np
import pytest

from hil.command_line import main
from hil.rig_calibration import find_rests, is_long, weakest_direction
from hil.simulation import SimulationConfig, simulate
from plant.mechanism import load_spatial


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibration")
    file, figures = folder / "rig.toml", folder / "rig.json"
    assert main(["calibrate", "rig", str(file), "--seed", "1", "--json", str(figures)]) == 0
    return file, json.loads(figures.read_text())


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


def test_raw_imus_follow_with_it_what_they_cannot_follow_without(calibrated):
    file, _ = calibrated
    result = simulate(
        SimulationConfig(target="sines", duration=15.0, imu="mpu9150", seed=1, calibration=str(file), fusion="whole-alignments")
    )
    late = result.times > 8.0
    error = np.linalg.norm(result.records["position"] - result.true_positions, axis=1)[late]
    assert np.sqrt(np.mean(error**2)) < 0.25e-3
    assert result.records["trusted"][late].all()


def test_rests_are_where_nothing_turns():
    random = np.random.default_rng(0)
    samples, zero = np.zeros((5000, 3, 7, 3)), random.normal(0.0, 0.3, (7, 3))
    samples[:, 0] = zero + random.normal(0.0, 0.002, (5000, 7, 3))
    samples[1000:2500, 0, 4, 1] += 0.2
    rests = find_rests(samples, zero, 1000.0)
    assert rests == [slice(0, 1000), slice(2500, 5000)]
    assert [is_long(rest, 1000.0) for rest in (*rests, slice(0, 800))] == [True, True, False]


def test_the_weakest_direction_is_named():
    mechanism = load_spatial("hexapod")
    assert weakest_direction(np.diag([1e-8, 1e-8, 4e-6, 0.0, 0.0, 0.0]), mechanism).startswith("mostly along z: 2 mm")
    assert weakest_direction(np.diag([1e-8, 1e-8, 1e-8, 0.0, 4e-4, 0.0]), mechanism).startswith("mostly about y: 4 mm")


@pytest.mark.parametrize("tilt", ["0", "-1", "nan", "90"])
def test_a_tilt_that_is_none_is_refused(tmp_path, tilt, capsys):
    assert main(["calibrate", "rig", str(tmp_path / "c.toml"), "--tilt", tilt]) == 2
    assert "must be between 0 and 45" in capsys.readouterr().err
    assert not (tmp_path / "c.toml").exists()
