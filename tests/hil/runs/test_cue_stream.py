"""Streamed cues over real pipes and sockets, to the receiver of a run."""

import json
import os
import socket
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from controller.planning.motions import drive, text_of_vehicle
from controller.planning.motions.cueing import COLUMNS, FORCE_COLUMNS
from controller.planning.plan_handover import CAUSE, STREAM
from controller.planning.stream_planner import StreamPlanner
from controller.safety.causes import Cause
from hil.command_line import main
from hil.runs import cue_stream
from hil.runs.cue_stream import Datagrams, Recorded, StandardInput, send_cues, source_of
from hil.runs.target_stream import FAREWELLS, Reception, StreamError, decode, is_last, open_socket
from plant.errors import InputError

HEADER = ",".join(COLUMNS)


@pytest.fixture
def washout(tmp_path):
    path = tmp_path / "washout.toml"
    path.write_text("scale = 0.4\ntilt_deg = 6\n")
    return path


@pytest.fixture
def short_end(monkeypatch):
    monkeypatch.setattr(cue_stream, "SETTLE_S", 0.3)


def poses_of(listener):
    found = []
    while not found or not is_last(found[-1]):
        found.append(decode(listener.recv(200)))
    return found


@pytest.mark.slow
def test_a_run_follows_a_recorded_vehicle_in_real_time(hexapod, washout, tmp_path, short_end):
    """Every pose is taken, none is a jump, and all that is planned is within the limits, as the planner checks."""
    path = tmp_path / "drive.csv"
    path.write_text(text_of_vehicle(drive(["brake"], speed=5.0, rest=0.2)))
    home = hexapod.require_home()
    stream = np.zeros((), STREAM)
    planner = StreamPlanner(hexapod, leg_lengths(hexapod, home.position, home.rotation))
    reception = Reception(stream, planner, 1e-3)
    with open_socket(port=0) as listener:
        host, port = listener.getsockname()
        found = {}
        sender = threading.Thread(
            target=lambda: found.update(send_cues(hexapod, washout, Recorded(str(path)), 100.0, host, port))
        )
        began = time.monotonic()
        sender.start()
        poses, listened = [], True
        listener.settimeout(5.0)
        while listened:
            datagram, address = listener.recvfrom(200)
            reception.take(datagram, address)
            reception.plan()
            poses.append(decode(datagram))
            listened = not is_last(poses[-1])
        sender.join()
        lasted = time.monotonic() - began
    assert stream["shared"][CAUSE] == Cause.NONE and stream["planned"] >= 1
    vehicle = drive(["brake"], speed=5.0, rest=0.2)
    assert lasted >= vehicle.times[-1] + 0.3
    assert found["sent"] == len(poses) - 1 and found["vehicle"]["lines"] == len(vehicle.times)
    assert found["kept"]["samples"] >= found["sent"] and found["kept"]["stroke"] == 0
    moved = np.array([pose["displacement"] for pose in poses])
    # It is pushed back under the brake, and leans forward.
    assert moved[:, 0].min() < -1e-3
    assert max(pose["quaternion"][2] for pose in poses) > 0.01


def test_lines_are_taken_until_the_pipe_ends(hexapod, washout, short_end, monkeypatch):
    ours, theirs = os.pipe()
    source = StandardInput(ours)
    assert source.sample(1, 0.01)[0].tolist() == [0.0, 0.0, 0.0]
    os.write(theirs, f"{HEADER}\n0,1,2,3,0.1,0.2,0.3\n0.01,4,5".encode())
    force, rate, gravity = source.sample(2, 0.01)
    assert force.tolist() == [1.0, 2.0, 3.0] and rate.tolist() == [0.1, 0.2, 0.3] and not gravity
    os.write(theirs, b",6,0,0,0\nnot,a,line\n0.02,nan,0,0,0,0,0\n0.005,9,9,9,0,0,0\n")
    assert source.sample(3, 0.01)[0].tolist() == [4.0, 5.0, 6.0]
    assert source.figures() == {"lines": 2, "malformed": 2, "stale": 1}
    os.write(theirs, f"{','.join(FORCE_COLUMNS)}\n0.03,0,0,9.80665,0,0,0\n".encode())
    assert source.sample(4, 0.01)[2]
    # One that falls silent is taken to be at rest.
    monkeypatch.setattr(cue_stream, "_PATIENCE_S", 0.0)
    time.sleep(1e-3)
    assert source.sample(5, 0.01)[0].tolist() == [0.0, 0.0, 0.0]
    os.close(theirs)
    assert source.sample(6, 0.01) is None
    os.close(ours)


def test_datagrams_of_the_first_sender_are_taken_until_it_says_so():
    source = Datagrams("127.0.0.1", 0)
    address = source.socket.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        first.sendto(b"0,1,0,0,0,0,0\n0.01,2,0,0,0,0,0\n", address)
        other.sendto(b"9,7,7,7,7,7,7", address)
        assert source.sample(1, 0.01)[0].tolist() == [2.0, 0.0, 0.0]
        assert source.figures() == {"lines": 2, "malformed": 0, "stale": 0, "strange": 1}
        first.sendto(b"end", address)
        assert source.sample(2, 0.01) is None


def test_a_recorded_vehicle_is_interpolated_to_its_end(tmp_path):
    path = tmp_path / "v.csv"
    path.write_text(f"{HEADER}\n5,0,0,0,0,0,0\n6,1,2,3,4,5,6\n")
    source = Recorded(str(path))
    force, rate, gravity = source.sample(1, 0.25)
    assert force == pytest.approx([0.25, 0.5, 0.75]) and rate == pytest.approx([1.0, 1.25, 1.5]) and not gravity
    assert source.sample(4, 0.25) is not None and source.sample(5, 0.25) is None


def test_the_vehicle_s_motion_ends_after_the_duration(hexapod, washout, short_end):
    with open_socket(port=0) as listener:
        listener.settimeout(5.0)
        host, port = listener.getsockname()
        ours, theirs = os.pipe()
        figures = send_cues(hexapod, washout, StandardInput(ours), 50.0, host, port, duration=0.2)
        os.close(ours)
        os.close(theirs)
        poses = poses_of(listener)
    assert figures["sent"] == len(poses) - 1 == 1 + 10 + 15 and FAREWELLS == 5
    np.testing.assert_allclose(poses[-1]["displacement"], 0.0, atol=1e-12)


@pytest.mark.slow
def test_the_command_renders_lines_from_a_pipe(washout, tmp_path):
    """A process of its own takes lines as they come on standard input, and sends poses that lean with the vehicle."""
    figures = tmp_path / "figures.json"
    with open_socket(port=0) as listener:
        listener.settimeout(60.0)
        options = ["--cueing", washout, "--to", f"127.0.0.1:{listener.getsockname()[1]}", "--json", figures]
        line = [sys.executable, "-m", "hil.command_line", "stream-target", *map(str, options)]
        with subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as run:
            poses = [decode(listener.recv(200))]

            def drive_on():
                for k in range(100):
                    run.stdin.write(f"{0.01 * k},2,0,0,0,0,0\n")
                    run.stdin.flush()
                    time.sleep(0.01)
                run.stdin.close()

            vehicle = threading.Thread(target=drive_on)
            vehicle.start()
            poses += poses_of(listener)
            vehicle.join()
            assert "100 lines, 0 malformed, 0 stale of the vehicle's motion" in run.stdout.read()
        assert run.returncode == 0
    assert min(pose["quaternion"][2] for pose in poses) < -0.01 and max(pose["displacement"][0] for pose in poses) > 1e-3
    assert json.loads(figures.read_text())["kept"]["samples"] >= len(poses) - 1


def test_what_cannot_be_streamed_is_refused(hexapod, washout, tmp_path, capsys):
    with pytest.raises(InputError, match=r"udp:127"):
        source_of("udp:nowhere")
    with pytest.raises(StreamError, match="choose another"):
        source_of("udp:no.such.host.invalid:4000")
    with pytest.raises(InputError, match=r"none\.csv"):
        source_of(str(tmp_path / "none.csv"))
    ours, theirs = os.pipe()
    for rate in (0.0, np.nan):
        with pytest.raises(InputError, match="the rate is"):
            send_cues(hexapod, washout, StandardInput(ours), rate, "127.0.0.1", 1)
    os.close(ours)
    os.close(theirs)
    assert main(["stream-target", "--cueing", str(washout), "--nan-at", "1"]) == 2
    assert "leave --stop-at" in capsys.readouterr().err
    washout.write_text("scale = 100\n")
    assert main(["stream-target", "--cueing", str(washout)]) == 2
    assert "washout.toml: scale is 100" in capsys.readouterr().err


def test_the_vehicle_command_names_what_there_is(capsys):
    assert main(["vehicle", "jump"]) == 2
    assert "there are brake, lane-change, bumps" in capsys.readouterr().err
