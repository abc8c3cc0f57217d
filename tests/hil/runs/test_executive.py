"""The loop on the machine's clock, with its real processes: they record every cycle, stop when asked, outlive each other."""

import json
import mmap
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from hil.loop.driver import FmuRig, prevent_compilation
from hil.loop.stage_times import over_budget
from hil.realtime.durations import Histogram
from hil.realtime.scheduling import MEASURES, RealTimeSettings, RefusedError, real_time, usage
from hil.recording import mcap as recording
from hil.recording.mcap import RecordingError, read, repair
from hil.recording.replay import COMPARED, replay
from hil.runs.config import SimulationConfig
from hil.runs.executive import RunStoppedError, run
from hil.runs.prepare import prepared_loop
from plant.errors import GoughError, InputError
from plant.mechanism import load_mechanism
from tests.hil.ports import free_port

ROOT = os.geteuid() == 0
CONFIG = SimulationConfig(target="sines", duration=1.0, rate=500.0)
SETTINGS = RealTimeSettings(most_missed=2000)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A short run: its summary and its recording."""
    path = tmp_path_factory.mktemp("run") / "run.mcap"
    return run(CONFIG, SETTINGS, path), path


def gough(*arguments, terminal=subprocess.PIPE, **options):
    command = [sys.executable, "-m", "hil.command_line", *map(str, arguments)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL if terminal > 0 else terminal, stderr=terminal, text=True, **options
    )


def children(pid):
    """Processes whose parent is `pid`, in the order in which they were started."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            found.append(int(status.parent.name))
    return sorted(found)


def is_ours(pid):
    """Whether it is a process of a run, and not of something that Python asks for when it starts: such a one has the run's
    command line until it has its own.
    """
    with suppress(OSError):
        looks = []
        for _ in range(2):
            looks.append(b"hil.command_line" in Path(f"/proc/{pid}/cmdline").read_bytes())
            time.sleep(0.01)
        return all(looks)
    return False


def wait_for(condition, seconds=60.0, pause=0.02):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(pause)


def started(path, *options, **environment):
    """A run in a process of its own that is well under way: that, and the loop's and the recorder's process."""
    process = gough("run", "--duration", 60, "--rate", 500, "--most-missed", 2000, "--record", path, *options, **environment)
    wait_for(lambda: recorded_cycles(path) > 300 or process.poll() is not None, pause=0.1)
    assert process.poll() is None, process.communicate()
    # The channel comes before them, if its address is free.
    loop, recorder = children(process.pid)[-2:]
    return process, loop, recorder


def recorded_cycles(path):
    try:
        return len(read(path).records)
    except RecordingError:
        return 0


def accounted(cycles, missed):
    """Whether every period is there once, or was missed."""
    return (np.diff(cycles) == 1 + missed[1:]).all() and cycles[0] == 0


# ---------------------------------------------------------------------------------------------------------------- a whole run


def test_a_run_ends_at_rest_and_says_what_it_did(recorded):
    summary, path = recorded
    assert summary["cause"] == "end of the motion"
    missed = sum(summary[name] for name in ("missed_late", "missed_own", "missed_host"))
    assert missed >= read(path).records["missed"].sum()
    assert summary["cycles"] >= 600
    for name in ("wake", "compute", "latency", "leg filters", "control", "record"):
        assert (
            0.0 < summary["timing_us"][name]["p50"] <= summary["timing_us"][name]["p999"] <= summary["timing_us"][name]["max"]
        )
        assert summary["timing_us"][name]["n"] == summary["cycles"]
    assert summary["errors_m"]["estimation"] < 2e-3
    assert summary["usage"]["major_faults"] == 0
    assert summary["recording"]["lost"] == 0
    assert json.dumps(summary)
    if ROOT and not summary["refused"]:
        assert summary["usage"]["minor_faults"] == 0
        assert summary["usage"]["resident"] == 0


def test_every_cycle_is_in_the_file_once_and_another_library_reads_the_same(recorded):
    summary, path = recorded
    found = read(path)
    assert found.complete
    assert len(found.records) == summary["cycles"]
    assert accounted(found.records["cycle"], found.records["missed"])
    assert found.config["target"] == "sines"
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_summary().statistics.channel_message_counts[1] == summary["cycles"]
        for own, (_, _, message, decoded) in zip(found.records, reader.iter_decoded_messages(topics=["/cycle"]), strict=True):
            assert decoded.cycle == own["cycle"] == message.sequence
            for name in ("position", "specific_force", "command", "stage_ns", "covariance", "truth"):
                np.testing.assert_array_equal(getattr(decoded, name), np.ravel(own[name]))
        events = [decoded.text for _, _, _, decoded in reader.iter_decoded_messages(topics=["/event"])]
    assert "controlled stop: end of the motion" in events
    assert [text for _, text in found.events] == events
    assert abs(message.log_time / 1e9 - time.time()) < 600.0


def test_a_replay_is_the_run_bit_for_bit(recorded):
    summary, path = recorded
    result = replay([path])
    assert result.same
    assert result.cycles == result.recorded == summary["cycles"]
    process = gough("replay", path)
    assert f"{summary['cycles']} of {summary['cycles']} cycles replayed, bit for bit" in process.communicate()[0]
    assert process.returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("fusion", [pytest.param("compiled", marks=pytest.mark.slow), "whole"])
def test_a_replay_has_the_added_sensors(fusion, tmp_path):
    """Lengths and the base's IMU are as much part of a recording as the other IMUs."""
    added = ["--lengths", "incremental", "--base-imu", "--fault", "base-tilt,axis=x,size_deg=3,sine_hz=0.2,at=0.1"]
    path = tmp_path / "run.mcap"
    process = gough("run", "--duration", 1, "--rate", 200, "--most-missed", 2000, "--fusion", fusion, "--record", path, *added)
    assert process.wait() == 0, process.communicate()
    records = read(path).records
    assert np.isfinite(records["base_imu"]).all() and np.isfinite(records["length"]).all()
    assert replay([path]).same


def rewritten(path, to, change):
    """A recording with its records changed."""
    found = read(path)
    records = change(found.records.copy())
    recorder = recording.Recorder(to, {"config": found.config, **found.arrays}, 0)
    recorder.write(records)
    recorder.close()
    return to


def test_a_replay_names_the_first_cycle_that_differs(recorded, tmp_path):
    _, path = recorded

    def change(records):
        records["command"][321, 4] = np.nextafter(records["command"][321, 4], 1.0)
        records["position"][400] = 0.0
        return records

    result = replay([rewritten(path, tmp_path / "changed.mcap", change)])
    assert not result.same
    assert result.different == read(path).records["cycle"][321]
    assert list(result.fields) == ["command"]
    assert any(f"cycle {result.different} is the first that differs" in line for line in result.lines())

    def disturb(records):
        records["specific_force"][200, 3, 1] += 1e-9
        return records

    result = replay([rewritten(path, tmp_path / "disturbed.mcap", disturb)])
    assert result.different == read(path).records["cycle"][200]
    assert set(result.fields) < set(COMPARED)


def test_a_replay_ends_where_cycles_are_missing(recorded, tmp_path):
    _, path = recorded
    result = replay([rewritten(path, tmp_path / "gap.mcap", lambda records: np.delete(records, slice(300, 310)))])
    assert result.missing_after == read(path).records["cycle"][299]
    assert result.different is None and not result.same
    later = rewritten(path, tmp_path / "later.mcap", lambda records: records[100:])
    with pytest.raises(RecordingError, match="does not begin with the first cycle"):
        replay([later])


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="there is no recording"):
        read(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("hello")
    with pytest.raises(RecordingError, match="is no recording of gough"):
        read(tmp_path / "text.mcap")


def test_a_file_that_was_cut_short_anywhere_is_read_up_to_there_and_can_be_mended(recorded, tmp_path):
    _, path = recorded
    whole, content = read(path), path.read_bytes()
    cut = tmp_path / "cut.mcap"
    most = 0
    for share in np.linspace(0.05, 0.999, 25):
        cut.write_bytes(content[: int(share * len(content))])
        try:
            found = read(cut)
        except RecordingError:
            assert share < 0.5
            continue
        count = len(found.records)
        assert not found.complete or count == len(whole.records)
        assert found.records.tobytes() == whole.records[:count].tobytes()
        most = max(most, count)
        assert repair(cut) != found.complete
        with cut.open("rb") as file:
            counts = make_reader(file).get_summary().statistics.channel_message_counts
        assert counts.get(1, 0) == count
    assert most > 0.5 * len(whole.records)


@pytest.mark.slow
def test_a_rig_in_python_runs_in_the_same_executive(tmp_path):
    path = tmp_path / "python.mcap"
    config = SimulationConfig(target="circle", duration=0.5, rate=100.0)
    summary = run(config, SETTINGS, path, rig=FmuRig)
    assert summary["cause"] == "end of the motion"
    assert replay([path]).same


def test_a_rig_that_leaves_a_thread_running_is_refused():
    import threading

    class Chatty(FmuRig):
        def __init__(self, loop):
            super().__init__(loop)
            threading.Thread(target=threading.Event().wait, name="bus", daemon=True).start()

    with pytest.raises(GoughError, match=r"left threads running \(bus\)"):
        run(CONFIG, SETTINGS, rig=Chatty)


def test_what_cannot_be_run_is_refused_before_anything_runs(tmp_path):
    before = children(os.getpid())
    with pytest.raises(GoughError, match=r"no mechanism|there is no"):
        run(SimulationConfig(mechanism="nothing"), SETTINGS, tmp_path / "x.mcap")
    assert not (tmp_path / "x.mcap").exists()
    assert children(os.getpid()) == before
    for wrong, said in (
        ({"priority": 99}, "priority is 99"),
        ({"cpu": 4096}, "no processor 4096"),
        ({"most_missed": 0}, "1 at"),
    ):
        with pytest.raises(InputError, match=said):
            RealTimeSettings(**wrong)


# ----------------------------------------------------------------------------------------------------------- being asked to end


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
@pytest.mark.parametrize("whom", ["supervisor", pytest.param("group", marks=pytest.mark.slow)])
def test_a_signal_ends_the_motion_by_a_controlled_stop(tmp_path, number, whom):
    path = tmp_path / "run.mcap"
    process, *others = started(path)
    if whom == "supervisor":
        process.send_signal(number)
    else:
        # As from a terminal: to every process at once.
        for pid in (process.pid, *others):
            os.kill(pid, number)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "stopped on the brakes: asked for" in output
    records = read(path).records
    assert accounted(records["cycle"], records["missed"])
    assert np.abs(records["reference"][-1, :, 1:]).max() == 0.0
    assert np.abs(records["reference"][:, :, 2]).max() <= load_mechanism("hexapod").limits.acceleration * (1.0 + 1e-9)
    assert not any(Path(f"/proc/{pid}").exists() for pid in others)
    assert replay([path]).same


def ignore_as_a_script_asks_of_its_background():
    for number in (signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)


@pytest.mark.slow
def test_an_emergency_stop_is_heard_by_a_run_that_was_told_to_ignore_it(tmp_path):
    path = tmp_path / "run.mcap"
    process, *others = started(path, preexec_fn=ignore_as_a_script_asks_of_its_background)
    for pid in (process.pid, *others):
        os.kill(pid, signal.SIGINT)
    cycles = recorded_cycles(path)
    wait_for(lambda: recorded_cycles(path) > cycles + 300 or process.poll() is not None, pause=0.1)
    process.send_signal(signal.SIGQUIT)
    _, errors = process.communicate(timeout=30.0)
    said = errors.splitlines()[0]
    assert said.startswith("ignored, as what started this run asks: ") and "SIGINT; SIGTERM ends it" in said
    assert process.returncode == 1 and "emergency stop" in errors
    found = read(path)
    assert next(cycle for cycle, text in found.events if "emergency stop" in text) > cycles + 300
    assert (found.records["request"][-5:] != 1).all()


@pytest.mark.slow
def test_when_the_supervisor_is_killed_the_loop_stops_by_itself_and_the_file_is_complete(tmp_path):
    path = tmp_path / "run.mcap"
    process, *others = started(path)
    process.kill()
    process.communicate()
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in others))
    found = read(path)
    assert found.complete
    assert "controlled stop: the supervising process has gone" in [text for _, text in found.events]
    assert np.abs(found.records["reference"][-1, :, 1:]).max() == 0.0
    assert replay([path]).same


@pytest.mark.slow
def test_when_the_loop_is_killed_its_file_is_complete_and_the_run_fails(tmp_path):
    path = tmp_path / "run.mcap"
    process, loop, recorder = started(path, env={**os.environ, "TMPDIR": str(tmp_path)})
    assert list(tmp_path.glob("gough-fmu-*"))
    os.kill(loop, signal.SIGKILL)
    _, errors = process.communicate(timeout=30.0)
    assert process.returncode == 1
    assert "the loop's process has died (exit code -9)" in errors
    assert not Path(f"/proc/{recorder}").exists()
    assert not list(tmp_path.glob("gough-fmu-*"))
    found = read(path)
    assert found.complete
    assert accounted(found.records["cycle"], found.records["missed"])
    assert replay([path]).same


def test_when_the_recorder_is_killed_another_goes_on_and_no_cycle_is_lost_or_doubled(tmp_path):
    path = tmp_path / "run.mcap"
    process, loop, recorder = started(path)
    os.kill(recorder, signal.SIGKILL)
    second = tmp_path / "run-2.mcap"
    wait_for(lambda: recorded_cycles(second) > 300, pause=0.1)
    assert Path(f"/proc/{loop}").exists()
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert "the recorder died (exit code -9)" in output
    assert read(path).complete and read(second).complete
    records = np.concatenate([read(each).records for each in (path, second)])
    assert accounted(records["cycle"], records["missed"])
    assert replay([path, second]).same


def deleted(path):
    path.unlink()


def cut(path):
    os.truncate(path, 1000)


def replaced(path):
    path.with_suffix(".other").write_bytes(b"of someone else")
    path.with_suffix(".other").replace(path)


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(deleted, marks=pytest.mark.slow),
        *(pytest.param(each, marks=pytest.mark.endurance) for each in (cut, replaced)),
    ],
)
def test_a_recording_that_is_spoiled_while_it_goes_on_is_noticed_and_the_rest_is_kept(tmp_path, spoil):
    path, second, figures = tmp_path / "run.mcap", tmp_path / "run-2.mcap", tmp_path / "run.json"
    process, *_ = started(path, "--json", figures)
    spoil(path)
    left = path.read_bytes() if path.exists() else None
    wait_for(lambda: recorded_cycles(second) > 300 or process.poll() is not None, pause=0.1)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0, errors
    assert f"{path} was deleted, cut or replaced while it was recorded" in output
    assert f"another recorder goes on in {second}" in output
    summary = json.loads(figures.read_text())
    # All that the first file had was still in memory.
    assert summary["recording"] == {"files": [str(second)], "lost": 0}
    assert len(read(second).records) == summary["cycles"] and replay([second]).same
    assert (path.read_bytes() if path.exists() else None) == left


@pytest.mark.slow
def test_a_recording_that_is_deleted_in_the_end_is_written_again(tmp_path):
    path, second = tmp_path / "run.mcap", tmp_path / "run-2.mcap"
    process, _, recorder = started(path)
    os.kill(recorder, signal.SIGSTOP)
    path.unlink()
    process.send_signal(signal.SIGTERM)
    wait_for(lambda: not any(is_ours(child) for child in children(process.pid) if child != recorder))
    os.kill(recorder, signal.SIGCONT)
    output, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0 and f"{path} was deleted" in output, errors
    assert read(second).complete and replay([second]).same


# --------------------------------------------------------------------------------------------------------------- what is taken


@pytest.mark.skipif(not ROOT, reason="needs privileges")
def test_the_loop_is_alone_in_its_process_with_what_it_was_granted(tmp_path):
    process, loop, _ = started(tmp_path / "run.mcap", "--priority", 71)
    try:
        status = Path(f"/proc/{loop}/status").read_text()
        assert "Threads:\t1\n" in status
        assert os.sched_getscheduler(loop) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
        assert os.sched_getparam(loop).sched_priority == 71
        everywhere, kept = os.sched_getaffinity(0), os.sched_getaffinity(loop)
        assert len(kept) == 1
        for beside in (process.pid, *(each for each in children(process.pid) if each != loop)):
            assert os.sched_getaffinity(beside) == (everywhere - kept or everywhere)
        assert "VmLck:\t       0 kB" not in status
        maps = Path(f"/proc/{loop}/maps").read_text()
        for absent in ("casadi", "matplotlib", "ruckig_plot"):
            assert absent not in maps
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30.0)


@pytest.mark.slow
def test_the_process_of_the_loop_imports_nothing_heavy():
    code = (
        "import sys, hil.runs.executive; print([name for name in "
        "('control', 'scipy.linalg', 'casadi', 'filterpy', 'plotly', 'matplotlib', 'rich', 'pandas') if name in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


@pytest.mark.slow
@pytest.mark.skipif(not ROOT, reason="needs privileges")
def test_what_was_taken_is_given_back():
    before = (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, os.sched_getaffinity(0), locked())
    open_files = len(list(Path("/proc/self/fd").iterdir()))
    with real_time(RealTimeSettings()) as refused:
        if not refused:
            assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
            assert locked() > 0
    assert before == (os.sched_getscheduler(0), os.sched_getparam(0).sched_priority, os.sched_getaffinity(0), locked())
    assert len(list(Path("/proc/self/fd").iterdir())) <= open_files


def test_a_measure_that_is_not_wanted_is_not_taken():
    before = (os.sched_getscheduler(0), os.sched_getaffinity(0), locked())
    with real_time(RealTimeSettings(without=MEASURES, strict=True)) as refused:
        assert refused == []
        assert before == (os.sched_getscheduler(0), os.sched_getaffinity(0), locked())
    with pytest.raises(GoughError, match="there is no measure 'magic'; there are memory, processor, doze, priority"):
        RealTimeSettings(without=("magic",))


def locked():
    return next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck"))


UNPRIVILEGED = """
import os, resource, sys
resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
from hil.realtime.scheduling import RealTimeSettings, real_time
with real_time(RealTimeSettings(strict=sys.argv[1] == "strict")) as refused:
    print("\\n".join(refused))
"""


@pytest.mark.skipif(ROOT and shutil.which("setpriv") is None, reason="needs setpriv to do without privileges")
def test_what_the_machine_refuses_is_told_by_name_and_an_error_only_if_strict():
    def without_privileges(strict):
        dropped = ["setpriv", "--bounding-set", "-sys_nice,-ipc_lock,-sys_resource"] if ROOT else []
        command = [*dropped, sys.executable, "-c", UNPRIVILEGED, strict]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    lenient = without_privileges("lenient")
    assert lenient.returncode == 0, lenient.stderr
    for what in ("locked memory: Operation not permitted", "SCHED_FIFO at priority 80: Operation not permitted", "rtprio"):
        assert what in lenient.stdout
    strict = without_privileges("strict")
    assert strict.returncode == 1
    assert RefusedError.__name__ in strict.stderr and "SCHED_FIFO at priority 80" in strict.stderr


def test_nothing_is_compiled_on_the_clock():
    with prepared_loop(CONFIG) as loop:
        loop.load(python=True)
        with prevent_compilation():
            assert loop.run(50) == 0
            loop.segments = loop.segments.astype(np.float32)
            with pytest.raises(RuntimeError, match="was to be compiled while the loop is on the clock"):
                loop.run(60)


# ------------------------------------------------------------------------------------------------------------------ the figures


def test_usage_counts_what_a_thread_has_done():
    before = usage()
    memory = mmap.mmap(-1, 50_000_000)
    memory[:] = bytes(len(memory))
    time.sleep(0.01)
    used = usage().since(before)
    assert used["minor_faults"] > 10
    assert used["resident"] > 40_000_000
    assert used["voluntary_switches"] >= 1
    del memory


@pytest.mark.parametrize("scale", [1.0, 50.0, 3000.0, 1e6])
def test_quantiles_of_a_histogram_are_those_of_the_durations(scale):
    durations = (scale * np.random.default_rng(1).lognormal(3.0, 1.0, 100_000)).astype(np.int64)
    histogram = Histogram()
    for part in np.array_split(durations, 7):
        histogram.add(part)
    figures = histogram.figures()
    for name, percent in (("p50", 50.0), ("p99", 99.0), ("p999", 99.9)):
        exact = np.percentile(durations, percent) / 1e3
        assert figures[name] == pytest.approx(exact, rel=0.012, abs=1e-3)
    assert figures["max"] == durations.max() / 1e3
    assert figures["n"] == len(durations) == sum(histogram.bars()[1])
    assert Histogram().figures() == {"p50": 0.0, "p99": 0.0, "p999": 0.0, "max": 0.0, "n": 0}


def test_what_is_over_the_budget_is_named(recorded):
    timing = json.loads(json.dumps(recorded[0]["timing_us"]))
    for figures in timing.values():
        figures |= {"p50": 0.5, "p99": 0.6, "p999": 0.7, "max": 0.8}
    assert over_budget(timing) == []
    timing["compute"]["p50"] = 13.0
    assert over_budget(timing) == ["compute p50 13.0 us, budget 12 us"]


@pytest.mark.slow
def test_a_run_that_cannot_go_on_says_why_and_keeps_its_recording(tmp_path):
    path = tmp_path / "raw.mcap"
    with pytest.raises(
        RunStoppedError,
        match=r"stopped before its time at cycle \d+: not armed: (IMU \d is not plausible|"
        r"the estimate of leg \d [^:]* within 50 ms|"
        r"the IMUs share an error, or the base is not at rest: raw)",
    ) as stopped:
        run(SimulationConfig(imu="mpu9150", duration=5.0, rate=500.0), SETTINGS, path)
    assert stopped.value.summary["cycles"] == len(read(path).records)
    assert any("controlled stop: not armed" in text for _, text in read(path).events)
    assert replay([path]).same


# -------------------------------------------------------------------------------------------------------------- what goes wrong


def gone(*pids):
    def ended(pid):
        try:
            return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except OSError:
            return True

    return all(ended(pid) for pid in pids)


@pytest.mark.slow
def test_when_the_supervisor_is_killed_before_the_start_nothing_stays(tmp_path):
    channel = f"127.0.0.1:{free_port()}"
    process = gough("run", "--duration", 60, "--rate", 500, "--record", tmp_path / "run.mcap", "--channel", channel)
    wait_for(lambda: len(children(process.pid)) > 1 or process.poll() is not None)
    others = children(process.pid)
    process.kill()
    process.communicate()
    wait_for(lambda: gone(*others))


@pytest.mark.slow
def test_a_signal_before_the_start_ends_it_at_once():
    process = gough("run", "--duration", 60, "--rate", 500)
    wait_for(lambda: any(is_ours(child) for child in children(process.pid)) or process.poll() is not None)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=30.0)
    assert process.returncode == 0 or "asked to stop before anything has moved" in errors


@pytest.mark.slow
def test_a_recorder_killed_at_once_costs_nothing(tmp_path):
    path, figures = tmp_path / "run.mcap", tmp_path / "run.json"
    process = gough("run", "--duration", 1.5, "--rate", 500, "--most-missed", 2000, "--record", path, "--json", figures)
    wait_for(lambda: path.exists() and path.stat().st_size)
    os.kill(children(process.pid)[-1], signal.SIGKILL)
    _, errors = process.communicate(timeout=60.0)
    assert process.returncode == 0, errors
    summary = json.loads(figures.read_text())
    assert len(summary["recording"]["files"]) == 2
    assert sum(recorded_cycles(each) for each in summary["recording"]["files"]) == summary["cycles"]
    assert summary["recording"]["lost"] == 0


@pytest.mark.slow
def test_cycles_that_a_stopped_recorder_missed_are_counted(tmp_path):
    path, figures = tmp_path / "run.mcap", tmp_path / "run.json"
    process, _, recorder = started(path, "--json", figures)
    os.kill(recorder, signal.SIGSTOP)
    time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    output, errors = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert "cycles are not recorded" in errors
    summary = json.loads(figures.read_text())
    assert 0 < summary["recording"]["lost"] == summary["cycles"] - len(read(path).records)
    assert f"{summary['recording']['lost']} cycles lost" in output
    assert gone(recorder)


@pytest.mark.slow
def test_a_loop_that_does_not_answer_is_ended(tmp_path):
    process, loop, recorder = started(tmp_path / "run.mcap")
    os.kill(loop, signal.SIGSTOP)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert "the loop's process has died (exit code -9)" in errors
    assert "the loop has not answered for 10 s and was killed" in errors
    assert f"recorded in {tmp_path / 'run.mcap'}" in errors
    assert gone(loop, recorder)


@pytest.mark.slow
def test_a_file_that_another_run_records_to_is_refused(tmp_path):
    path = tmp_path / "run.mcap"
    process, loop, recorder = started(path)
    second = gough("run", "--duration", 1, "--record", path)
    assert "is being recorded to by another run: name another file" in second.communicate(timeout=60.0)[1]
    assert second.returncode == 2
    process.send_signal(signal.SIGTERM)
    assert process.communicate(timeout=60.0) and process.returncode == 0
    assert len(read(path).records)
    assert gone(loop, recorder)


def test_a_file_that_cannot_be_written_is_refused_before_anything_moves():
    process = gough("run", "--duration", 1, "--record", "/proc/run.mcap")
    errors = process.communicate(timeout=60.0)[1]
    assert "/proc" in errors
    assert errors.count("\n") == 1
    assert process.returncode == 2


def test_filters_in_python_are_refused_on_the_clock():
    with pytest.raises(InputError, match="too slow for the clock: use them with 'gough simulate'"):
        run(SimulationConfig(duration=0.5, fusion="filterpy"), RealTimeSettings())


@pytest.mark.slow
def test_the_whole_mechanism_filter_runs_on_the_clock_and_replays_bit_for_bit(tmp_path):
    path = tmp_path / "run.mcap"
    config = SimulationConfig(target="sines", duration=2.0, rate=500.0, fusion="whole")
    summary = run(config, RealTimeSettings(most_missed=2000), path)
    assert summary["cause"] == "end of the motion"
    recorded = read(path)
    assert recorded.records["trusted"][-1] == 1
    assert "the whole-mechanism filter is relied upon" in [text for _, text in recorded.events]
    again = replay([path])
    assert again.same
    assert again.cycles == summary["cycles"]


def test_a_disk_without_room_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hil.runs.recorders._LEAST_FREE", 2**60)
    with pytest.raises(InputError, match=r"MiB are free there, and .* MiB are needed to begin: make room"):
        run(SimulationConfig(duration=0.5), RealTimeSettings(), tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_a_terminal_that_has_gone_and_a_full_output_are_told_in_a_line():
    command = [sys.executable, "-m", "hil.command_line", "fmu", "table"]
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False, timeout=120.0)
    assert process.returncode == 1
    assert process.stderr == "gough: the output cannot be written: No space left on device\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_what_is_no_file_is_refused_for_a_recording():
    process = gough("run", "--duration", 1, "--record", "/dev/full")
    assert "/dev/full is no file" in process.communicate(timeout=60.0)[1]
    assert process.returncode == 2


LIMITED = """
import resource, signal, sys
from hil.command_line import main
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4_500_000, 4_500_000))
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
def test_a_recording_that_cannot_go_on_is_told_in_a_line_and_the_run_goes_on(tmp_path):
    """A limit on the size of files stands in for a full disk; the plant's library is smaller."""
    path = tmp_path / "run.mcap"
    arguments = ["run", "--duration", "5", "--rate", "1000", "--most-missed", "2000", "--record", str(path)]
    command = [sys.executable, "-c", LIMITED, *arguments]
    process = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60.0)
    assert process.returncode == 1
    assert "cycles are not recorded" in process.stderr
    assert "cannot be written: File too large: the rest is not recorded" in process.stdout
    assert "Traceback" not in process.stderr
    assert [each.name for each in tmp_path.iterdir()] == ["run.mcap"]
    assert int(process.stdout.partition("recorded in ")[2].partition("; ")[2].split()[0]) > 100
    assert int(process.stdout.partition(" cycles recorded in ")[0].splitlines()[-1]) > 0


class Raising(FmuRig):
    """A rig that fails in motion, and leaves a mark when it is stopped."""

    mark = Path()

    def exchange(self, command, request, feedback):
        if self._loop.state["time"]["cycle"] > 60:
            raise ValueError("the bus is gone")
        return super().exchange(command, request, feedback)

    def quick_stop(self):
        Raising.mark.touch()
        super().quick_stop()


@pytest.mark.slow
def test_a_rig_that_raises_is_braked(tmp_path):
    Raising.mark = tmp_path / "braked"
    with pytest.raises(RunStoppedError, match="ValueError: the bus is gone"):
        run(SimulationConfig(duration=1.0, rate=100.0), SETTINGS, rig=Raising)
    assert Raising.mark.exists()


class Refusing(FmuRig):
    """A rig whose exchanges fail in motion."""

    def exchange(self, command, request, feedback):
        return 104 if self._loop.state["time"]["cycle"] > 60 else super().exchange(command, request, feedback)


@pytest.mark.slow
def test_an_exchange_that_fails_is_told_and_replayed(tmp_path):
    path = tmp_path / "run.mcap"
    with pytest.raises(RunStoppedError, match=r"the rig reports failure \(104\)"):
        run(SimulationConfig(duration=1.0, rate=100.0), SETTINGS, path, rig=Refusing)
    assert replay([path]).same


@pytest.mark.slow
def test_too_many_missed_periods_are_a_failure(tmp_path):
    path = tmp_path / "run.mcap"
    process, loop, _ = started(path, "--most-missed", 50)
    os.kill(loop, signal.SIGSTOP)
    time.sleep(0.4)
    os.kill(loop, signal.SIGCONT)
    _, errors = process.communicate(timeout=60.0)
    assert process.returncode == 1
    assert "too many periods missed in a row" in errors
    assert replay([path]).same


def test_damage_never_passes_for_a_difference(recorded, tmp_path):
    _, path = recorded
    random, content = np.random.default_rng(7), path.read_bytes()
    for _ in range(40):
        damaged = bytearray(content)
        damaged[random.integers(200, len(content))] ^= 1 << int(random.integers(8))
        (tmp_path / "damaged.mcap").write_bytes(damaged)
        try:
            result = replay([tmp_path / "damaged.mcap"])
        except RecordingError:
            continue
        assert result.different is None


@pytest.mark.slow
def test_no_file_is_named_twice(recorded, tmp_path):
    _, path = recorded
    for arguments in (["replay", path, "--json", path], ["run", "--json", tmp_path / "x", "--record", tmp_path / "x"]):
        process = gough(*arguments)
        assert "is named twice: give two files" in process.communicate(timeout=60.0)[1]
        assert process.returncode == 2
    assert read(path).complete


@pytest.mark.slow
def test_a_terminal_shows_the_run_as_it_goes():
    main, terminal = pty.openpty()
    try:
        process = gough("run", "--duration", 1, "--rate", 200, "--most-missed", 2000, stdin=terminal, terminal=terminal)
        os.close(terminal)
        shown = b""
        with suppress(OSError):
            while part := os.read(main, 4096):
                shown += part
    finally:
        os.close(main)
    assert process.wait(30.0) == 0
    for text in (b"hexapod follows circle at 200 Hz", b"roll, pitch, yaw [deg]", b"woken late p50", b"running"):
        assert text in shown


@pytest.mark.slow
def test_what_a_calibration_does_not_tell_is_said_before_the_run_and_recorded(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[imu_2.accelerometer]\nbias = [1e-4, 0.0, 0.0]\n")
    said = []
    summary = run(
        SimulationConfig(target="hold", duration=0.2, calibration=str(path), channel="none"), SETTINGS, tmp_path / "run.mcap",
        say=said.append,
    )  # fmt: skip
    assert len(said) == 1 and said[0].startswith(f"{path} has no digest")
    assert summary["remarks"] == said == read(tmp_path / "run.mcap").config["remarks"]
