"""Recordings of other versions of gough: they are read, and only what needs the same cycle refuses them."""

import re
from importlib.metadata import version

import numpy as np
import pytest

from controller.cycle import PARAMETERS
from hil.loop.records import RECORD
from hil.recording import mcap
from hil.recording.imu_data import read_field, read_imu
from hil.recording.mcap import Recorder, RecordingError, read, read_run
from hil.recording.replay import replay
from hil.recording.replay_rig import ReplayRig
from hil.rigs import ANSWERED, BRAKED, new_feedback

CONFIG = {"version": "0.0.1", "run": "1", "rate": 1000.0, "mechanism_name": "hexapod", "target": "circle", "rig": "fmu"}
CYCLES = 50
FLAT = np.dtype([("period", "f8"), ("hold_cycles", "i8"), ("command_delay", "f8")])
BY_STAGE = np.dtype([("rig", [("period", "f8"), ("hold_cycles", "i8")]), ("load", [("command_delay", "f8")])])


def made(path, parameters, **changes):
    """A recording of 50 cycles with these parameters; its records."""
    records = np.zeros(CYCLES, RECORD)
    records["cycle"] = np.arange(CYCLES)
    records["time_ns"] = records["cycle"] * 1_000_000
    for name in ("angular_velocity", "specific_force", "magnetic_field"):
        records[name] = np.random.default_rng(0).normal(size=(CYCLES, 7, 3))
    header = {"config": CONFIG | changes, "parameters": parameters, "reference": np.zeros((6, 2, 5))}
    recorder = Recorder(path, header, 0)
    recorder.write(records)
    recorder.close()
    return records


@pytest.mark.parametrize("parameters", [np.array((1e-3, 200, 2e-3), FLAT), np.array(((1e-3, 200), (2e-3,)), BY_STAGE)])
def test_a_recording_of_another_cycle_is_read_and_only_its_replay_is_refused(tmp_path, parameters):
    path = tmp_path / "other.mcap"
    records = made(path, parameters)
    recording = read(path)
    assert recording.records.tobytes() == records.tobytes()
    assert (recording.version, recording.constant("rig", "hold_cycles")) == ("0.0.1", 200)
    np.testing.assert_array_equal(read_imu(path, 3)[2], records["specific_force"][:, 3])
    np.testing.assert_array_equal(read_field(path, 6)[0], records["magnetic_field"][:, 6])
    rig, feedback = ReplayRig(path, 1e-3), new_feedback()
    rig.open()
    assert rig.command_delay == 2e-3
    assert rig.exchange(np.zeros(6), BRAKED, feedback) == ANSWERED
    np.testing.assert_array_equal(feedback["measurement"][0], records["angular_velocity"][0])
    said = (
        f"was recorded by gough 0.0.1, whose cycle has other parameters than that of this gough {version('gough')}: replay it"
    )
    with pytest.raises(RecordingError, match=re.escape(said)) as error:
        replay([path])
    assert "\n" not in str(error.value)


def test_the_notes_of_a_schema_may_change_and_the_layout_may_not(tmp_path, monkeypatch):
    path, text = tmp_path / "run.mcap", mcap.schema()
    monkeypatch.setattr(mcap, "schema", lambda: re.sub(r"#.*", "# another note", text))
    records = made(path, np.zeros((), PARAMETERS))
    monkeypatch.undo()
    assert read(path).records.tobytes() == records.tobytes()
    monkeypatch.setattr(mcap, "schema", lambda: text.replace("float64[6] command", "float32[12] command"))
    with pytest.raises(RecordingError, match=r"recorded by gough 0.0.1, whose records have another layout .* read it with"):
        read(path)


def test_files_of_one_run_come_in_order_and_others_are_refused(tmp_path):
    first, second, other = (tmp_path / f"{name}.mcap" for name in ("first", "second", "other"))
    parameters = np.zeros((), PARAMETERS)
    records = made(first, parameters)
    made(other, parameters, run="2")
    recorder = Recorder(second, {"config": CONFIG, "parameters": parameters}, 0)
    later = records.copy()
    later["cycle"] += 40
    recorder.write_cycles(later)
    recorder.close()
    run, joined = read_run([second, first])
    assert [each.path for each in run] == [first, second]
    assert joined["cycle"].tolist() == list(range(90))
    with pytest.raises(RecordingError, match="are of different runs"):
        read_run([first, other])
    with pytest.raises(RecordingError, match="does not begin with the first cycle"):
        read_run([second])
