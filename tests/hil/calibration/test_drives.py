"""The motions of a calibration keep to what the drives can do with all legs at once, and a failure keeps its last run."""

from dataclasses import replace

import numpy as np
import pytest

from hil.calibration import procedure
from hil.calibration.drives import within_drives
from hil.calibration.procedure import FailedCalibrationError, SimulatedRig, calibrate_rig
from hil.command_line import main
from hil.recording.mcap import read
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.imu_wiring import Wiring
from plant.mechanism import load_mechanism, load_spatial
from plant.truth import TRUTH_CURRENTS

# Weak motors, whose limits each leg reaches by itself, and not all of them together.
WEAK = """based_on = "hexapod"
name = "weak"
[limits]
acceleration = 5.0
jerk = 100.0
[plant.drive]
current_limit = 4.4
"""


@pytest.fixture(scope="module")
def weak(tmp_path_factory):
    path = tmp_path_factory.mktemp("weak") / "weak.toml"
    path.write_text(WEAK)
    return path


@pytest.mark.parametrize("name", ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins"])
def test_the_presets_keep_their_limits(name):
    mechanism = load_mechanism(name)
    assert within_drives(mechanism) is mechanism


@pytest.mark.slow
def test_drives_that_are_too_weak_for_all_legs_at_once_get_gentler_motions(weak):
    """The plant's own currents in the open loop are the witness."""
    mechanism = load_spatial(weak)
    gentle = within_drives(mechanism)
    assert 0.5 < gentle.limits.acceleration < mechanism.limits.acceleration
    assert gentle.limits.velocity == mechanism.limits.velocity and gentle.limits.jerk == mechanism.limits.jerk
    limit = float(mechanism.plant["drive.current_limit"])
    largest = {}
    for each in (mechanism, gentle):
        records = SimulatedRig().run_open(SimulationConfig(each, "rests", 12.5, rate=500.0, imu="ideal"))
        largest[each is gentle] = float(np.abs(records["truth"][:, TRUTH_CURRENTS]).max())
    assert largest[True] < 0.97 * limit < largest[False]


def test_drives_with_nothing_left_are_refused(weak):
    mechanism = load_spatial(weak)
    spent = replace(mechanism, plant={**mechanism.plant, "drive.current_limit": np.array(1.0)})
    with pytest.raises(InputError, match=r"leg \d needs .* A for its load at 0.25 m/s, and its drive has 1 A"):
        within_drives(spent)


def test_a_failure_keeps_its_last_run(tmp_path):
    kept = tmp_path / "rig.failed.mcap"
    swapped = SimulationConfig(imu="mpu9150", rate=500.0, wiring=Wiring(places=(0, 2, 1, 3, 4, 5, 6)))
    with pytest.raises(FailedCalibrationError, match=r"1 and 2 are swapped.*; its last run is recorded in .*mcap") as failure:
        calibrate_rig(swapped, failed=kept)
    assert failure.value.result is None
    found = read(kept)
    assert found.complete and len(found.records) == 2500 and found.config["target"] == "probing"
    assert found.arrays["reference"].shape[0] == 6


@pytest.mark.slow
def test_the_report_of_a_failure_is_that_of_its_last_run(tmp_path, monkeypatch, capsys):
    result = simulate(SimulationConfig(target="rests", duration=0.1))

    def fails(*arguments, **options):
        raise FailedCalibrationError("the data do not give a calibration", result)

    monkeypatch.setattr(procedure, "calibrate_rig", fails)
    report = tmp_path / "rig.html"
    assert main(["calibrate", "rig", str(tmp_path / "rig.toml"), "--report", str(report)]) == 2
    assert "the data do not give a calibration" in capsys.readouterr().err
    assert "gough: hexapod follows rests" in report.read_text()
