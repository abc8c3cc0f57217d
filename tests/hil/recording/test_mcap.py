"""Recordings: what the loop wrote is in the file with its events and times, even in files of other versions or cut short."""

import os
import re
import time
from importlib.metadata import version

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from controller.cycle import PARAMETERS
from controller.safety.causes import Cause
from hil.loop.records import LINK_SIZE, RECORD, Link
from hil.recording import mcap
from hil.recording.imu_data import read_field, read_imu
from hil.recording.mcap import Recorder, RecordingError, read, read_run, record, repair, take
from hil.recording.replay import replay
from hil.recording.replay_rig import ReplayRig
from hil.rigs import ANSWERED, BRAKED, new_feedback

CONFIG = {"version": "0.0.1", "run": "1", "rate": 1000.0, "mechanism_name": "hexapod", "target": "circle", "rig": "fmu"}
CYCLES = 50
EPOCH_NS = 1_700_000_000_123_456_789
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


def test_what_was_overwritten_before_it_was_taken_is_counted():
    records, link = np.zeros(8, RECORD), np.zeros(LINK_SIZE, np.int64)

    def write(count):
        for _ in range(count):
            records["cycle"][link[Link.HEAD] % 8] = link[Link.HEAD]
            link[Link.HEAD] += 1

    write(5)
    taken, tail, lost = take(records, link, 0)
    assert (taken["cycle"].tolist(), tail, lost) == ([0, 1, 2, 3, 4], 5, 0)
    write(3)
    taken, tail, lost = take(records, link, tail)
    assert (taken["cycle"].tolist(), tail, lost) == ([5, 6, 7], 8, 0)
    # The loop may be writing the next record, over the oldest of the eight.
    write(20)
    taken, tail, lost = take(records, link, tail)
    assert (taken["cycle"].tolist(), tail, lost) == (list(range(21, 28)), 28, 13)
    taken, tail, lost = take(records, link, tail)
    assert (len(taken), tail, lost) == (0, 28, 0)


# ------------------------------------------------------------------------------------------------------------ events and times


def eventful_records():
    """Records with every kind of event, and the events that a reader is to find: cycle and text."""
    records = np.zeros(12, RECORD)
    records["cycle"] = 100 + np.arange(12)
    records["time_ns"] = 2_000_000 * records["cycle"] + 77
    records["imus"] = 0b1111_1111
    records["missed"][2] = 3
    for name, values in {
        "count": 2, "cause": (Cause.FOLLOWING_ERROR, Cause.ARMED), "index": (4, -1), "value": (0.012, np.nan),
        "limit": (0.01, np.nan),
    }.items():  # fmt: skip
        records[f"event_{name}"][3, ...] = np.resize(values, 8) if name != "count" else values
    records["event_count"][4], records["event_cause"][4], records["event_index"][4] = 10, Cause.IMU_BACK, np.arange(8)
    records["event_value"][4] = np.nan
    # The magnetometer goes and comes; that an IMU goes between is told by its own event.
    records["imus"][5:7] = 0b0111_1111
    records["imus"][6] ^= 1
    records["trusted"][8:10] = 1
    events = [
        (102, "3 periods missed"),
        (103, "controlled stop: leg 4 does not follow its reference (0.012 m, the limit is 0.01 m)"),
        (103, "armed"),
        *((104, f"IMU {imu} is used again") for imu in range(8)),
        (104, "and 2 events more"),
        (105, "the magnetometer is left out: it is lost, frozen or disturbed"),
        (107, "the magnetometer is used again"),
        (108, "the whole-mechanism filter is relied upon"),
        (110, "the whole-mechanism filter is not relied upon: the leg filters disagree with it"),
    ]
    return records, events


def written(path, *portions):
    recorder = Recorder(path, {"config": CONFIG, "parameters": np.zeros((), PARAMETERS)}, EPOCH_NS)
    for records in portions:
        recorder.write(records)
        recorder.flush()
    recorder.close()
    return path


def messages(path, topic):
    """Times and content of the messages of a topic, by another library."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = reader.iter_decoded_messages(topics=[topic])
        return [(message.log_time, message.publish_time, decoded) for _, _, message, decoded in found]


@pytest.mark.parametrize("first", [0, 2, 5, 6, 8, 9, 11])
def test_events_come_once_in_words_with_their_cycle_and_time(tmp_path, first):
    records, events = eventful_records()
    path = written(tmp_path / "run.mcap", records[:first], records[first:])
    recording = read(path)
    assert recording.events == events
    assert recording.epoch_ns == EPOCH_NS
    times = dict(zip(records["cycle"].tolist(), (EPOCH_NS + records["time_ns"]).tolist(), strict=True))
    found = messages(path, "/event")
    assert [(each.cycle, each.text) for _, _, each in found] == events
    assert [(logged, published) for logged, published, _ in found] == [(times[cycle],) * 2 for cycle, _ in events]
    assert [(logged, each.cycle) for logged, _, each in messages(path, "/cycle")] == [(at, k) for k, at in times.items()]


def test_numbers_of_messages_begin_anew_after_32_bits_and_those_of_cycles_do_not(tmp_path):
    records = np.zeros(3, RECORD)
    records["cycle"] = 2**32 + np.arange(-1, 2)
    path = written(tmp_path / "run.mcap", records)
    with path.open("rb") as file:
        assert [message.sequence for _, _, message in make_reader(file).iter_messages(topics=["/cycle"])] == [2**32 - 1, 0, 1]
    assert read(path).records["cycle"].tolist() == records["cycle"].tolist()


def test_a_filter_that_is_relied_upon_from_the_first_cycle_is_told(tmp_path):
    records, _ = eventful_records()
    records["trusted"] = 1
    assert read(written(tmp_path / "run.mcap", records[:2])).events == [(100, "the whole-mechanism filter is relied upon")]


def test_a_mended_file_has_everything_up_to_the_cut_at_its_time(tmp_path):
    records, events = eventful_records()
    path = written(tmp_path / "run.mcap", records[:5], records[5:])
    whole, content, event_times = read(path), path.read_bytes(), [at for at, _, _ in messages(path, "/event")]
    assert not repair(path) and path.read_bytes() == content
    # Within the index at the end of the file.
    path.write_bytes(content[: content.rindex(b"gough/Event")])
    cut = read(path)
    assert not cut.complete
    assert repair(path)
    mended = read(path)
    assert mended.complete and list(tmp_path.iterdir()) == [path]
    assert mended.records.tobytes() == records.tobytes() and mended.events == events
    assert mended.epoch_ns == whole.epoch_ns == EPOCH_NS and mended.config == whole.config
    assert mended.arrays["parameters"].tobytes() == whole.arrays["parameters"].tobytes()
    assert [at for at, _, _ in messages(path, "/cycle")] == (EPOCH_NS + records["time_ns"]).tolist()
    assert [at for at, _, _ in messages(path, "/event")] == event_times == mended.event_times_ns


# ---------------------------------------------------------------------------------------------------------------- the recorder


def ring_of(count, capacity=8):
    ring, link, number = np.zeros(capacity, RECORD), np.zeros(LINK_SIZE, np.int64), np.arange(count)
    ring["cycle"][number % capacity] = number
    ring["time_ns"][number % capacity] = 1000 * number
    link[Link.HEAD], link[Link.SUPERVISOR] = count, os.getppid()
    return ring, link


HEADER = {"config": CONFIG, "parameters": np.zeros((), PARAMETERS)}
HOUR_NS = 3600 * 10**9


def test_a_successor_goes_on_where_the_last_whole_chunk_ended_and_counts_what_was_overwritten(tmp_path):
    path = tmp_path / "run-2.mcap"
    ring, link = ring_of(20)
    link[[Link.DONE, Link.TAIL, Link.KEPT]] = 1, 4, 3
    link[Link.START] = time.monotonic_ns() - HOUR_NS
    record(path, HEADER, ring, link)
    found = read(path)
    assert found.complete and found.records["cycle"].tolist() == list(range(13, 20))
    assert found.events == [(20, "9 cycles lost: the recorder came too late")]
    assert (link[Link.TAIL], link[Link.KEPT]) == (20, 10)
    # The start on the machine's clock, as Unix time.
    assert abs(found.epoch_ns - (time.time_ns() - HOUR_NS)) < 60 * 10**9


def test_what_is_in_the_file_is_known_to_a_successor_however_much_is_taken_at_once(tmp_path, monkeypatch):
    """A recorder that was held up takes seconds at once, and may be killed at any time."""
    path = tmp_path / "run.mcap"
    ring, link = ring_of(2000, capacity=3000)
    link[Link.DONE] = 1
    flush, checked = Recorder.flush, []

    def flush_after_a_look(recorder):
        recorder._file.flush()
        checked.append(len(read(path).records) if checked else 0)
        assert checked[-1] == link[Link.TAIL]
        flush(recorder)

    monkeypatch.setattr(Recorder, "flush", flush_after_a_look)
    record(path, HEADER, ring, link)
    assert len(checked) > 5 and read(path).records["cycle"].tolist() == list(range(2000))


def test_without_a_supervisor_a_recorder_waits_for_no_run_but_completes_the_one_there_is(tmp_path, monkeypatch):
    path = tmp_path / "run.mcap"
    monkeypatch.setattr(mcap.time, "sleep", lambda seconds: None)
    ring, link = ring_of(0)
    link[Link.SUPERVISOR] = -1
    record(path, HEADER, ring, link)
    assert not path.exists()
    ring, link = ring_of(6)
    link[Link.SUPERVISOR] = -1
    record(path, HEADER, ring, link)
    assert read(path).complete and read(path).records["cycle"].tolist() == list(range(6))
    assert read(path).events == [] and (link[Link.TAIL], link[Link.KEPT]) == (6, 6)
