"""Hardware in the loop with its real processes: the emulated rig in one, the run in others, a bus between them."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from controller.calibration.file import load_calibration
from controller.safety.causes import Cause, DriveState, Mode
from hil.recording.mcap import read
from hil.recording.replay import replay
from hil.rigs.canopen.settings import DEFAULT_FILE
from hil.rigs.udp.emulator import WATCHDOG_CODE
from hil.runs.emulator_process import BusyError, ask
from plant.errors import GoughError
from plant.truth import TRUTH_LENGTHS
from tests.hil.ports import free_port

MOTION = ("--target", "sines", "--rate", "500")
PATIENT = ("--most-missed", "2000", "--mechanism", str(Path(__file__).with_name("patient.toml")))
"""Other tests want the processors too, which holds up loops and rigs: the watch is patient with the bus."""


def gough(*arguments, **options):
    command = [sys.executable, "-m", "hil.command_line", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def wait_for(condition, seconds=120.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(0.02)


@contextmanager
def emulated(*options, at=None, control=None):
    """An emulator that listens: its process, where its rig is, and where its control."""
    at, control = at or f"127.0.0.1:{free_port()}", control or f"127.0.0.1:{free_port()}"
    process = gough("emulate", "--at", at, "--control", control, "--watchdog", 300, *MOTION, *options)
    try:
        for line in process.stdout:
            if "listens" in line:
                break
        assert process.poll() is None, process.communicate()
        yield process, at, control
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=30.0)


def state_of(control):
    with suppress(GoughError):
        return ask(control, "state", patience=0.5)
    return {"drive": [-1] * 6, "velocity": [0.0] * 6, "code": [0] * 6, "lengths": [0.0] * 6}


def tried(at, control, *options, rig="udp"):
    """A run whose drives follow, and move, or that has ended; without a channel its loop is its first process."""
    process = gough("run", "--rig", rig, "--rig-at", at, "--channel", "none", *MOTION, *PATIENT, "--duration", 60, *options)
    wait_for(lambda: process.poll() is not None or moves(state_of(control)))
    return process


def started(at, control, *options):
    """A run whose drives follow, and move."""
    process = tried(at, control, *options)
    assert process.poll() is None, process.communicate()
    return process


def moves(state):
    return state["drive"] == [DriveState.FOLLOWING] * 6 and np.abs(state["velocity"]).max() > 2e-3


def loop_of(run):
    """The process of a run's loop: the first one that it has started."""
    children = Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()
    assert children, finished(run)
    return int(children[0])


def finished(process):
    output, errors = process.communicate(timeout=400.0)
    return process.returncode, output, errors


@pytest.fixture(scope="module")
def canopen_file(tmp_path_factory):
    """Settings of a CAN bus of its own."""
    file = tmp_path_factory.mktemp("canopen") / "bus.toml"
    text = DEFAULT_FILE.read_text()
    for name in ("drive.eds", "imu.eds"):
        text = text.replace(f'"{name}"', f'"{DEFAULT_FILE.with_name(name)}"')
    for name, value in (("heartbeat_timeout", 0.5), ("command_timeout", 0.5), ("silence", 1.0)):
        text = re.sub(rf"^{name} = [0-9.]+", f"{name} = {value}", text, flags=re.MULTILINE)
    file.write_text(text.replace("port = 43113", f"port = {free_port()}"))
    return file


# --------------------------------------------------------------------------------------------------------------- it follows


@pytest.mark.slow
def test_over_udp_it_follows_as_with_the_plant_itself_and_says_how_the_bus_was(tmp_path):
    figures = {}
    direct = gough("run", *MOTION, *PATIENT, "--duration", 5, "--json", tmp_path / "fmu.json")
    assert finished(direct)[0] == 0
    with emulated() as (_, at, _):
        run = gough(
            "run", "--rig", "udp", "--rig-at", at, *MOTION, *PATIENT, "--duration", 5, "--record", tmp_path / "udp.mcap",
            "--json", tmp_path / "udp.json",
        )  # fmt: skip
        status, output, errors = finished(run)
        assert status == 0, errors
    for name in ("fmu", "udp"):
        figures[name] = json.loads((tmp_path / f"{name}.json").read_text())
    for error in ("estimation", "tracking"):
        assert figures["udp"]["errors_m"][error] < 1.5 * figures["fmu"]["errors_m"][error] + 5e-5
    assert "round trip to the rig p50" in output and " us #" in output and "exchanges late" in output
    assert figures["udp"]["identity"]["name"] == "gough emulated hexapod"
    assert figures["udp"]["timing_us"]["round trip"]["p50"] > 0.0
    records = read(tmp_path / "udp.mcap").records
    assert len(records) == figures["udp"]["cycles"]
    # What is sent takes effect one exchange later, in single precision.
    answered = records["silent"][1:] == 0
    sent, told = records["command"][:-1][answered], records["sent"][1:][answered]
    following = (records["drive"][1:][answered] == DriveState.FOLLOWING).all(axis=1) & (
        records["mode"][1:][answered] == Mode.RUNNING
    )
    np.testing.assert_allclose(told[following], sent[following].astype(np.float32), rtol=1e-6)
    assert replay([tmp_path / "udp.mcap"]).same


@pytest.mark.slow
def test_over_canopen_it_follows_and_replays(tmp_path, canopen_file):
    """IMUs whose node waits for a processor are left out for a while; what is checked holds nevertheless. At 125 Hz they may
    wait for twice as long as at 250. Their samples come at this rate too, and the
    gains are lower than those of the preset, which oscillate when samples are late.

    On a busy machine all of them may wait at once, which ends a run as it should. If samples were late, there is another.
    """
    patient = tmp_path / "patient.toml"
    changes = "most_lost_imus = 4\nneed_platform_imu = 0\n\n[control]\nproportional = 35.0\nintegral = 80.0\n"
    patient.write_text(Path(PATIENT[-1]).read_text() + changes)
    for _ in range(6):
        with emulated("--bus", "canopen", "--rate", 125, at=str(canopen_file)) as (_, at, _):
            run = gough(
                "run", "--rig", "canopen", "--rig-at", at, "--target", "sines", "--rate", 125, *PATIENT[:-1], patient,
                "--duration", 4, "--record", tmp_path / "can.mcap", "--json", tmp_path / "can.json",
            )  # fmt: skip
            status, _, errors = finished(run)
        if "ip route add" in errors:
            pytest.skip("this machine has no multicast")
        assert (tmp_path / "can.mcap").exists(), errors
        records = read(tmp_path / "can.mcap").records
        if status == 0 or not records["sample_age"].any():
            break
    assert status == 0, errors
    figures = json.loads((tmp_path / "can.json").read_text())
    assert len(figures["identity"]["parts"]) == 13
    assert figures["errors_m"]["known"] > 450
    assert figures["errors_m"]["estimation"] < 2e-3
    assert figures["errors_m"]["tracking"] < 1e-3
    assert np.mean(records["imus"][records["mode"] == Mode.RUNNING] & 0x7F == 0x7F) > 0.8
    assert replay([tmp_path / "can.mcap"]).same


@pytest.mark.slow
def test_a_dry_run_reads_everything_and_moves_nothing(tmp_path):
    """On a busy machine more answers are late than a tenth. Then there is another run."""
    for attempt in range(4):
        recording = tmp_path / f"{attempt}.mcap"
        with emulated() as (_, at, control):
            words = ("--rig", "udp", "--rig-at", at, *MOTION, *PATIENT, "--duration", 2, "--no-arm", "--record", recording)
            status, output, errors = finished(gough("run", *words))
            assert status == 0, output + errors
            assert "nothing was moved; all is well for arming" in output
            lengths = state_of(control)["lengths"]
        records = read(recording).records
        # Before the first answer nothing is known of the drives.
        answered = records[records["silent"] == 0]
        if len(answered) > 0.9 * len(records):
            break
    assert (records["command"] == 0.0).all() and (records["mode"] == 0).all() and len(answered) > 0.9 * len(records)
    assert (answered["drive"] != DriveState.FOLLOWING).all()
    assert np.isfinite(records["position"]).all()
    assert np.abs(records["truth"][0, TRUTH_LENGTHS] - lengths).max() < 1e-4


# ------------------------------------------------------------------------------------------------------------ it ends safely


@pytest.mark.slow
def test_when_the_loop_is_killed_the_drives_stop_by_themselves(tmp_path):
    with emulated() as (_, at, control):
        run = started(at, control)
        os.kill(loop_of(run), signal.SIGKILL)
        wait_for(lambda: state_of(control)["drive"] == [DriveState.FAULTY] * 6, 10.0)
        time.sleep(0.2)
        state = state_of(control)
        assert state["velocity"] == [0.0] * 6
        assert state["code"] == [WATCHDOG_CODE] * 6
        assert finished(run)[0] == 1
        # And the next controller resets the fault and goes on.
        assert finished(gough("run", "--rig", "udp", "--rig-at", at, *MOTION, *PATIENT, "--duration", 0.5))[0] == 0


@pytest.mark.slow
def test_when_the_loop_is_killed_canopen_drives_stop_by_their_heartbeat(canopen_file):
    """On a busy machine all IMUs may wait for a processor at once, which ends a run as it should. Then there is another."""
    for _ in range(6):
        with emulated("--bus", "canopen", "--rate", 250, at=str(canopen_file)) as (_, at, control):
            run = tried(at, control, "--rate", 250, rig="canopen")
            if run.poll() is not None:
                assert "stopped" in finished(run)[2]
                continue
            os.kill(loop_of(run), signal.SIGKILL)
            wait_for(lambda: DriveState.FOLLOWING not in state_of(control)["drive"], 10.0)
            time.sleep(0.5)
            assert state_of(control)["velocity"] == [0.0] * 6
            assert finished(run)[0] == 1
            return
    pytest.fail("each of six runs lost its IMUs")


@pytest.mark.slow
def test_when_the_rig_is_killed_the_run_ends_and_a_new_one_serves_the_next(tmp_path):
    with emulated() as (process, at, control):
        run = started(at, control, "--record", tmp_path / "x.mcap", "--mechanism", "hexapod")
        process.kill()
        status, _, errors = finished(run)
        assert status == 1
        assert "the bus is lost" in errors
        with pytest.raises(BusyError):
            ask(control, "state", patience=0.2)
    found = read(tmp_path / "x.mcap")
    assert found.complete and found.records["stop"][-1] == Cause.BUS_LOST
    with emulated(at=at, control=control):
        assert finished(gough("run", "--rig", "udp", "--rig-at", at, *MOTION, *PATIENT, "--duration", 0.5))[0] == 0


@pytest.mark.slow
def test_a_fault_that_is_injected_is_told_and_the_run_goes_on_without_the_imu(tmp_path):
    with emulated() as (_, at, control):
        run = started(at, control)
        assert finished(gough("inject", "imu-dead:3", "--to", control))[0] == 0
        time.sleep(1.0)
        run.send_signal(signal.SIGINT)
        status, output, errors = finished(run)
        assert status == 0, errors
        assert "IMU 3 is left out: its samples are stale" in output
        status, _, errors = finished(gough("inject", "imu-dead:7", "--to", control))
        assert status == 2 and "0 to 6" in errors


@pytest.mark.slow
def test_the_emergency_key_stops_the_drives_quickly():
    with emulated() as (_, at, control):
        run = started(at, control)
        run.send_signal(signal.SIGQUIT)
        status, _, errors = finished(run)
        assert status == 1
        assert "emergency stop" in errors
        wait_for(lambda: DriveState.FOLLOWING not in state_of(control)["drive"], 10.0)


@pytest.mark.slow
def test_a_rig_that_is_not_there_or_stands_elsewhere_is_not_driven():
    status, _, errors = finished(gough("run", "--rig", "udp", "--rig-at", f"127.0.0.1:{free_port()}", "--duration", 1))
    assert status == 2 and "no rig answers" in errors
    with emulated("--target", "hold") as (_, at, _):
        # A target that begins 15 mm beside where the platform stands.
        aside = Path(__file__).with_name("aside.csv")
        try:
            aside.write_text(
                "time_s,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(f"{t},0.02,0,0.02,1,0,0,0\n" for t in (0.0, 1.0, 2.0))
            )
            options = ("--target", aside, "--rate", 500, "--duration", 1)
            status, _, errors = finished(gough("run", "--rig", "udp", "--rig-at", at, *options, *PATIENT))
        finally:
            aside.unlink()
        assert status == 1
        assert "not armed" in errors and "is not where the target begins" in errors


# ---------------------------------------------------------------------------------------------------------- a streamed target


@pytest.mark.parametrize(
    ("options", "words"),
    [
        pytest.param((), "the target's stream has stopped", marks=pytest.mark.slow),
        pytest.param(("--jump-at", 2), "the target jumps", marks=pytest.mark.slow),
        pytest.param(("--nan-at", 2), "the target is not finite", marks=pytest.mark.endurance),
    ],
)
def test_a_streamed_target_is_followed_until_it_goes_wrong(tmp_path, options, words):
    """On a busy machine, the sender may wait for a processor longer than the run waits for it. Then there is another run."""
    for attempt in range(4):
        recording = tmp_path / f"{attempt}.mcap"
        errors = follow_stream(recording, *options)
        if words in errors or "the target's stream has stopped" not in errors:
            break
    assert words in errors
    records = read(recording).records
    assert np.ptp(records["truth"][:, :3], axis=0).max() > 2e-3
    moved = records[records["mode"] == Mode.RUNNING]
    assert np.abs(moved["truth"][:, TRUTH_LENGTHS] - moved["reference"][:, :, 0]).max() < 3e-3
    assert replay([recording]).same


def follow_stream(recording, *options):
    """What a run says that follows a stream with these options until it fails; without any, the sender is killed in motion."""
    port = free_port()
    run = gough(
        "run", "--target", f"stream:127.0.0.1:{port}", "--rate", 500, "--duration", 60, *PATIENT, "--record", recording
    )  # fmt: skip
    wait_for(lambda: run.poll() is not None or (recording.exists() and moving(recording)))
    assert run.poll() is None, run.communicate()
    sender = gough("stream-target", "--target", "sines", "--duration", 60, "--to", f"127.0.0.1:{port}", *options)
    if not options:
        wait_for(lambda: np.ptp(read(recording).records["truth"][:, :3], axis=0).max() > 5e-3)
        sender.kill()
    status, _, errors = finished(run)
    # It would go on to its end.
    sender.kill()
    finished(sender)
    assert status == 1
    return errors


def moving(path):
    with suppress(GoughError):
        return bool((read(path).records["mode"] == Mode.RUNNING).any())
    return False


# ------------------------------------------------------------------------------------------------------- it is calibrated


@pytest.mark.endurance
def test_a_machine_that_has_never_moved_is_led_through_its_calibration_and_goes_on_after_a_fault(tmp_path):
    with emulated("--imu", "mpu9150", "--seed", 1, "--base-imu") as (_, at, control):

        def calibrating(*options):
            return gough(
                "calibrate", "rig", tmp_path / "rig.toml", "--rig", "udp", "--rig-at", at, "--rate", 500, *PATIENT,
                "--box", 40, 8, "--speed", 100, "--base-imu", "--yes", *options, stdin=subprocess.DEVNULL,
            )  # fmt: skip

        first = calibrating()
        for line in first.stderr:
            if "step 4 of 6" in line:
                break
        assert first.poll() is None, finished(first)
        wait_for(lambda: first.poll() is not None or moves(state_of(control)))
        ask(control, "fault drive-runs-away:3,size=0.2")
        status, _, errors = finished(first)
        assert status == 2 and "step 4 of 6, near-rests, failed" in errors and "drive 3 does not do what it is told" in errors
        assert (tmp_path / "rig.near-rests.failed.mcap").exists() and "--resume" in errors
        ask(control, "clear")
        status, _, errors = finished(calibrating("--resume", "--json", tmp_path / "rig.json"))
        assert status == 0, errors
        assert "step 3 of 6 was done" in errors and "step 6 of 6, shaking" in errors
    figures = json.loads((tmp_path / "rig.json").read_text())
    true, predicted = (figures[kind]["motion"]["position_rms"] for kind in ("true", "predicted"))
    assert true < 2.5 * predicted < 2e-3
    calibration = load_calibration(tmp_path / "rig.toml")
    raw = np.nanmean(read(tmp_path / "rig.reading.mcap").records["base_imu"], axis=0)
    rate, force = (calibration.base_gain @ raw[..., None])[..., 0] + calibration.base_offset
    up = [calibration.tilt[1], -calibration.tilt[0], 1.0]
    assert np.abs(raw[0]).max() > 0.01 > 10 * np.abs(rate).max()
    np.testing.assert_allclose(force / 9.80665, up, atol=5e-4)
