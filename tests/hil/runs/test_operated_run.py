"""Runs that are operated, with all their processes, on the FMU's clock and against an emulated rig."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from controller.safety.causes import Cause
from hil.recording.mcap import read
from hil.recording.replay import replay
from hil.runs.operator import Operator
from hil.runs.operator_messages import ChannelError
from plant.mechanism import load_in_space, load_mechanism
from tests.hil.ports import free_port
from tests.hil.runs.test_hardware_in_the_loop import PATIENT, emulated

pytestmark = pytest.mark.slow(seconds=60)

JOG = "from hil.runs.operator import Operator\nfor _ in Operator({!r}).jog((0.02, 0.0, 0.0)): pass"


def command(*arguments, **options):
    line = [sys.executable, "-m", "hil.command_line", *map(str, arguments)]
    return subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


def ready(run, address):
    """Wait until a run follows its target."""
    until = time.monotonic() + 600.0
    while True:
        assert run.poll() is None and time.monotonic() < until, run.communicate()
        try:
            with Operator(address, role="observer", patience=60.0) as observer:
                if observer.ask("state")["telemetry"]["mode"] == "running":
                    return
        except ChannelError:
            pass
        time.sleep(0.2)


@contextmanager
def operated(folder, *options):
    """A run that is ready for its operator: its process, and the address of its channel."""
    address = f"127.0.0.1:{free_port()}"
    run = command(
        "run", "--target", f"operator:{address}", "--duration", 120, "--rate", 500, "--most-missed", 2000, "--imu", "ideal",
        "--record", folder / "run.mcap", "--json", folder / "run.json", *options,
    )  # fmt: skip
    try:
        ready(run, address)
        yield run, address
    finally:
        run.kill()
        run.communicate()


def told(*arguments):
    done = command(*arguments)
    out, error = done.communicate(timeout=60.0)
    return done.returncode, out, error


def poses(folder):
    records = read(folder / "run.mcap").records
    return records[records["mode"] == 2]


def test_commands_move_the_plant_and_the_recording_replays(tmp_path):
    home = load_mechanism("hexapod").home.position
    points = tmp_path / "points.toml"
    points.write_text("[points.park]\nposition = [0.0, 0.0, -0.02]\n")
    with operated(tmp_path, "--points", points) as (run, address):
        moved = told("move", "park", "--at", address)
        assert moved[1].startswith("the platform is commanded to (0.00, 0.00, -20.00) mm"), moved
        figures = tmp_path / "jog.json"
        assert told("jog", "+x", "5mm", "-rz", "2deg", "--at", address, "--json", figures)[0] == 0
        commanded = json.loads(figures.read_text())["commanded"]
        np.testing.assert_allclose(commanded["position"], home + [0.005, 0.0, -0.02], atol=1e-9)
        np.testing.assert_allclose(commanded["rotation"], [0.0, 0.0, -np.radians(2.0)], atol=1e-9)
        status, _, error = told("move", "--to", "0,0,200", "--at", address)
        assert status == 2 and "the nearest pose within all limits is" in error
        assert told("jog", "-y", "10mm/s", "--hold", "--for", "0.5", "--at", address)[0] == 0
        status, out, _ = told("move", "home", "--at", address, "--speed", "100")
        assert status == 0 and "(0.00, 0.00, 0.00) mm, (0.00, 0.00, 0.00) deg from home" in out
        with Operator(address) as operator:
            estimate = operator.ask("state")["telemetry"]
            np.testing.assert_allclose(estimate["pose"]["position"], home, atol=1e-3)
            operator.end()
        assert run.wait(60.0) == 0, run.communicate()
    records = poses(tmp_path)
    true = records["truth"][:, :3] - home
    assert np.linalg.norm(true - [0.0, 0.0, -0.02], axis=1).min() < 5e-4 and np.linalg.norm(true[-1]) < 5e-4
    assert json.loads((tmp_path / "run.json").read_text())["cause"] == "asked for"
    assert replay([tmp_path / "run.mcap"]).same


def test_three_legs_are_moved_in_their_plane_and_the_recording_replays(tmp_path):
    home = load_in_space("planar-3rpr").home.position
    with operated(tmp_path, "--mechanism", "planar-3rpr") as (run, address):
        assert told("jog", "+x", "5mm", "-y", "3mm", "+rz", "2deg", "--at", address)[0] == 0
        with Operator(address, role="observer") as observer:
            truth = observer.ask("state")["telemetry"]["truth"]["position"]
        np.testing.assert_allclose(truth, home + [0.005, -0.003, 0.0], atol=5e-4)
        status, _, error = told("jog", "+z", "1mm", "--at", address)
        assert status == 2 and "planar-3rpr moves in its plane alone, along x and y and about z" in error
        assert told("jog", "+y", "10mm/s", "--hold", "--for", "0.5", "--at", address)[0] == 0
        status, out, _ = told("move", "home", "--at", address)
        assert status == 0 and "(0.00, 0.00, 0.00) mm, (0.00, 0.00, 0.00) deg from home" in out
        with Operator(address) as operator:
            operator.end()
        assert run.wait(60.0) == 0, run.communicate()
    records = poses(tmp_path)
    assert np.linalg.norm(records["truth"][-1, :3] - home) < 5e-4 and not records["reference"][:, 3:].any()
    assert replay([tmp_path / "run.mcap"]).same


@pytest.mark.parametrize("rig", ["fmu", "udp"])
def test_an_operator_killed_while_jogging_ends_the_run_by_a_controlled_stop_with_its_reason(tmp_path, rig):
    with ExitStack() as stack:
        options: tuple[object, ...] = ()
        if rig == "udp":
            _, at, _ = stack.enter_context(emulated("--target", "hold", "--imu", "ideal"))
            options = ("--rig", "udp", "--rig-at", at, *PATIENT)
        run, address = stack.enter_context(operated(tmp_path, *options))
        client = subprocess.Popen([sys.executable, "-c", JOG.format(address)])
        with Operator(address, role="observer") as observer:
            until = time.monotonic() + 30.0
            while not observer.ask("state")["telemetry"]["commanded"]["position"][0] > 0.003:
                assert time.monotonic() < until and run.poll() is None
                time.sleep(0.01)
        os.kill(client.pid, signal.SIGKILL)
        client.wait()
        assert run.wait(60.0) == 1
        _, error = run.communicate()
    assert "the operator has gone while the platform was jogged" in error
    assert json.loads((tmp_path / "run.json").read_text())["cause"].startswith("the operator has gone")
    records = read(tmp_path / "run.mcap").records
    assert Cause.OPERATOR_LOST in records["stop"]
    limits = load_mechanism("hexapod").limits
    moving = records[records["mode"] >= 2]
    assert np.abs(moving["reference"][:, :, 1]).max() <= limits.velocity * (1.0 + 1e-9)
    assert np.abs(moving["reference"][:, :, 2]).max() <= limits.acceleration * (1.0 + 1e-9)
    assert np.abs(moving["reference"][-1, :, 1]).max() < 1e-9
