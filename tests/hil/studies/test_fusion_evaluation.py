"""The evaluation of the whole-mechanism filter, by its command, on one rig."""

import json

import numpy as np
import pytest

from controller.calibration.file import Calibration
from hil.calibration.procedure import RigCalibration
from hil.command_line import main
from plant.mechanism import load_spatial


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    file = tmp_path_factory.mktemp("evaluation") / "figures.json"
    options = ("--rate", "500", "--seeds", "1", "--starts", "4", "--still", "80", "--workers", "1", "--json", str(file))
    assert main(["evaluate-fusion", *options]) == 0
    return json.loads(file.read_text())


@pytest.fixture
def without_calibration(monkeypatch):
    """Calibrated IMUs on every rig, so that the evaluation need not drive it: `tests/hil/calibration` tests that."""
    error = {"position_rms": 1e-3, "rotation_rms": 1e-3}
    summary = {kind: dict.fromkeys(("before", "motion"), error) for kind in ("true", "predicted")}
    found = RigCalibration(load_spatial("hexapod"), Calibration(), summary)
    monkeypatch.setattr("hil.studies.fusion_evaluation.calibrate_rig", lambda *arguments, **options: found)


@pytest.mark.slow
def test_calibrated_imus_start_in_motion_bear_a_dead_one_and_do_not_drift(without_calibration, tmp_path):
    file = tmp_path / "figures.json"
    options = (
        "--imu",
        "mpu9150-calibrated",
        "--rate",
        "250",
        "--seeds",
        "1",
        "--starts",
        "2",
        "--still",
        "25",
        "--workers",
        "1",
    )
    sections = ("faults", "start", "drift")
    assert main(["evaluate-fusion", *options, "--joint-error", "0", "--only", *sections, "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert {"calibration", *sections} < set(figures) and "motions" not in figures
    assert figures["start"]["succeeded"] == figures["start"]["starts"] == 2
    assert figures["start"]["position_max"] < 1e-3
    for name, ratio in (("none", 1.0), ("leg", 1.5), ("platform", 3.0)):
        assert figures["faults"][name]["position_rms"] < 0.3e-3
        assert figures["faults"][name]["position_rms"] <= ratio * figures["faults"]["none"]["position_rms"]
    (minute,) = figures["drift"]["minutes"]
    assert minute["position_rms"] < 0.3e-3


@pytest.mark.endurance
def test_raw_imus_come_to_tenths_of_a_millimetre(figures):
    for error, (position, rotation) in {"0": (0.2, 0.03), "0.0001": (0.4, 0.1)}.items():
        assert figures["calibration"][error]["least_improvement"] > 10.0
        for motion, each in figures["motions"][error].items():
            still = 2.0 if motion == "static" else 1.0
            assert 1e3 * each["whole"]["position_rms"] < still * position
            assert np.degrees(each["whole"]["rotation_rms"]) < still * rotation
            assert 0.05 < each["whole"]["nees"] < 40.0
            assert each["refined"]["position_rms"] < 1e-3


@pytest.mark.endurance
def test_a_dead_imu_costs_little(figures):
    faults = figures["faults"]
    assert faults["leg"]["position_rms_ratio"] < 1.5
    assert faults["platform"]["position_rms_ratio"] < 2.0
    assert faults["leg"]["position_rms"] != faults["none"]["position_rms"] != faults["platform"]["position_rms"]


@pytest.mark.endurance
def test_it_starts_in_motion_and_does_not_drift(figures):
    assert figures["start"]["succeeded"] == figures["start"]["starts"] == 4
    first, last = figures["drift"]["minutes"]
    assert last["position_rms"] < 1.5 * first["position_rms"] + 1e-4
    assert figures["follow"]["position_rms"] < 0.2e-3


@pytest.mark.endurance
def test_a_rig_calibrated_with_its_encoders_is_as_repeatable_as_they_are(tmp_path, capsys):
    file = tmp_path / "figures.json"
    options = ("--rate", "250", "--seeds", "1", "--joint-error", "0", "--workers", "1", "--json", str(file))
    assert main(["evaluate-fusion", "--only", "encoders", *options]) == 0
    figures = json.loads(file.read_text())["encoders"]
    assert figures["kind"] == "incremental" and list(figures["joints"]) == ["0"]
    found = figures["joints"]["0"]
    assert found["relative"]["position_rms"] < 0.03e-3 and found["absolute"]["position_rms"] < 0.1e-3
    assert np.degrees(found["relative"]["rotation_rms"]) < 0.01 and np.degrees(found["absolute"]["rotation_rms"]) < 0.02
    assert 0.1 < found["over_bound"]["position_rms"] < 1.5
    assert "closed loop with encoders, incremental, whole-alignments, sines" in capsys.readouterr().out


@pytest.mark.endurance
def test_what_a_cycle_costs_is_told(figures):
    cost = figures["cost"]
    assert 0.0 < cost["whole-gyroscopes"]["mean_us"] < cost["whole-alignments"]["mean_us"]
    for each in cost.values():
        assert each["mean_us"] <= each["max_us"]


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (
            ("--fusion", "compiled"),
            "no fusion of the whole mechanism 'compiled'; there are whole-gyroscopes, whole, whole-alignments",
        ),
        (("--still", "5"), "the platform is to stand still for 5 s; it can for 20 to 3600 s"),
        (("--starts", "0"), "0 starts are asked for; there can be 1 to 10000"),
        (("--only", "encoders", "--lengths", "none"), "lengths 'none' leave the section 'encoders' nothing to evaluate"),
        (("--joint-error", "-1"), "the joint error is -1 mm; it must be at least 0"),
        (("--seeds", "0,-1"), "the seed is -1"),
        (("--imu", "best"), "no IMU preset 'best'"),
        (("--only", "encoders", "--lengths", "best"), "no encoder 'best'"),
    ],
)
def test_what_cannot_be_evaluated_is_refused(options, complaint, capsys):
    assert main(["evaluate-fusion", *options]) == 2
    assert complaint in capsys.readouterr().err
