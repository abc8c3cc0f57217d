"""Runs whose target and errors are in frames of a file: the tool is where it must be, and everything says which frame."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.frames import Frames, Pivot, load_frames, parse_frames
from controller.planning.plan_handover import STREAM
from controller.planning.stream_planner import StreamPlanner
from controller.planning.target import load_target, text_of_target
from hil.command_line import main
from hil.realtime.scheduling import RealTimeSettings
from hil.recording import mcap
from hil.runs import emulator_process
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.runs.executive import run
from hil.runs.run_state import RunState
from hil.runs.simulation import simulate
from hil.runs.target_stream import Reception, encode
from plant.errors import InputError, UnknownNameError, UnreachableError
from plant.mechanism import load_spatial

MM, DEG = 1e-3, np.radians(1.0)

CELL = """
work = "table"
tool = "needle"

[frames.table]
parent = "corner"
position = [0.04, 0.06, 0.0]
angles_deg = [0.0, 0.0, 20.0]

[frames.corner]
parent = "base"
position = [-0.02, -0.05, 0.45]
angles_deg = [2.0, -3.0, -20.0]

[frames.holder]
parent = "platform"
position = [0.0, 0.0, 0.05]

[frames.needle]
parent = "holder"
position = [0.03, 0.0, 0.06]
rotation_vector_deg = [0.0, 4.0, 0.0]
"""

SEA = ("base-tilt,axis=x,size_deg=3,sine_hz=0.125,at=0.2", "base-tilt,axis=y,size_deg=1.5,sine_hz=0.0917,at=0.7")


def whole(rotation, position):
    matrix = np.zeros((*np.shape(position)[:-1], 4, 4))
    matrix[..., :3, :3], matrix[..., :3, 3], matrix[..., 3, 3] = rotation, position, 1.0
    return matrix


CORNER = whole(Rotation.from_euler("xyz", [2.0, -3.0, -20.0], degrees=True).as_matrix(), [-0.02, -0.05, 0.45])
TABLE = CORNER @ whole(Rotation.from_euler("z", 20.0, degrees=True).as_matrix(), [0.04, 0.06, 0.0])
NEEDLE = whole(Rotation.from_euler("y", 4.0, degrees=True).as_matrix(), [0.03, 0.0, 0.11])


def circle(times):
    """A circle of 10 mm about a point of the work frame, in its plane, and the tool's axes along those of the frame."""
    fade = np.clip(times, 0.0, 1.0) ** 3 * (10.0 - 15.0 * np.clip(times, 0.0, 1.0) + 6.0 * np.clip(times, 0.0, 1.0) ** 2)
    angle = 2.0 * np.pi * 0.25 * times
    return np.stack([0.002 + 0.01 * fade * np.cos(angle), 0.01 * fade * np.sin(angle), np.full(len(times), 0.012)], axis=1)


@pytest.fixture
def cell(tmp_path):
    """The files of frames and of a circle in them."""
    frames, target = tmp_path / "cell.toml", tmp_path / "circle.csv"
    frames.write_text(CELL)
    times = np.arange(0.0, 8.0, 0.01)
    rows = np.column_stack([times, circle(times), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))])
    np.savetxt(target, rows, delimiter=",", header="time_s,x_m,y_m,z_m,qw,qx,qy,qz", comments="")
    return SimulationConfig(frames=str(frames), target=str(target), duration=6.0, imu="ideal")


def needle_in_table(result, attitudes=None):
    """The matrices of the true poses of the needle in the table's frame."""
    truth = whole(result.true_rotations, result.true_positions)
    seen = truth if attitudes is None else whole(attitudes, np.zeros((len(attitudes), 3))) @ truth
    return np.linalg.inv(TABLE) @ seen @ NEEDLE


def off(needle, result):
    """RMS errors [mm, deg] of the needle from the circle."""
    moving = result.times >= 1.0
    position = needle[moving, :3, 3] - circle(result.times[moving])
    turns = Rotation.from_matrix(needle[moving, :3, :3]).magnitude()
    return np.sqrt(np.mean(np.sum(position**2, axis=1))) / MM, np.sqrt(np.mean(turns**2)) / DEG


def test_with_ideal_sensors_a_tool_goes_round_its_circle_in_a_work_frame(cell):
    result = simulate(cell)
    position, rotation = off(needle_in_table(result), result)
    assert position < 0.05 and rotation < 0.01
    summary = result.summary()
    figures = summary["frames"]
    assert (figures["work"], figures["tool"], figures["root"]) == ("table", "needle", "base")
    assert figures["target"]["reference_position_rms"] < 0.02 * MM
    moving = result.times >= 0.0
    needle, read = needle_in_table(result), result.read(result.true_positions, result.true_rotations)
    np.testing.assert_allclose(whole(read[1], read[0]), needle, atol=1e-12)
    estimate = np.linalg.inv(TABLE) @ whole(result.records["rotation"], result.records["position"]) @ NEEDLE
    errors = np.linalg.norm(estimate[moving, :3, 3] - needle[moving, :3, 3], axis=1)
    assert figures["estimation"]["position_rms"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    # The turn of the platform moves the needle, so that its errors are others than those of {2}.
    assert figures["estimation"]["rotation_rms"] == pytest.approx(summary["estimation"]["rotation_rms"])
    assert figures["estimation"]["position_rms"] > 1.2 * summary["estimation"]["position_rms"]
    levels, sizes = figures["protection"], summary["protection"]
    assert sizes["position_p99"] < levels["position_p99"] and levels["rotation_p99"] == sizes["rotation_p99"]
    assert levels["covered"] == 1.0


@pytest.mark.slow
def test_on_a_base_that_rolls_a_tool_stays_on_its_circle_in_a_level_work_frame(cell, tmp_path):
    """With the attitude of the plant's base, which the loop finds by itself."""
    path = tmp_path / "deck.toml"
    path.write_text(CELL.replace('parent = "base"', 'parent = "level"'))
    config = replace(cell, frames=str(path), base_imu=True, faults=SEA, duration=7.0)
    result = simulate(config)
    assert config.levelled and result.summary()["frames"]["root"] == "level"
    position, rotation = off(needle_in_table(result, result.attitudes), result)
    still = off(needle_in_table(result), result)
    assert position < 0.06 and rotation < 0.03
    assert still[0] > 10.0 and still[1] > 1.0


def test_a_motion_displaces_the_tool_along_the_axes_of_the_work_frame(cell, hexapod):
    frames = cell.active_frames
    target = load_target("steps", hexapod, 12.0, frames)
    home = np.linalg.inv(TABLE) @ whole(hexapod.home.rotation, hexapod.home.position) @ NEEDLE
    seen = np.linalg.inv(TABLE) @ whole(target.rotations, target.positions) @ NEEDLE
    for k in range(6):
        expected = home.copy()
        if k < 3:
            expected[k, 3] += 0.02
        else:
            angle = np.radians([4.0, 4.0, 8.0])[k - 3]
            expected[:3, :3] = Rotation.from_rotvec(angle * np.eye(3)[k - 3]).as_matrix() @ home[:3, :3]
        np.testing.assert_allclose(seen[k + 1], expected, atol=1e-12)
    with pytest.raises(InputError, match="shaking is fitted to the strokes, and not a motion in a frame"):
        load_target("shaking", hexapod, 2.0, frames)


def test_without_frames_or_with_none_in_use_a_target_means_what_it_did(hexapod):
    given = load_target("circle", hexapod, 2.0)
    framed = load_target("circle", hexapod, 2.0, Frames().active())
    np.testing.assert_allclose(framed.positions, given.positions, atol=1e-15)
    np.testing.assert_allclose(framed.rotations, given.rotations, atol=1e-15)
    plain = SimulationConfig(duration=0.3)
    assert plain.active_frames is None and not plain.levelled
    assert "frames" not in simulate(plain).summary()


def test_a_pivot_is_where_displacements_turn_about(hexapod):
    about = np.array([0.0, 0.0, 0.5])
    target = load_target("circle", hexapod, 2.0, Frames(pivot=Pivot("base", about)).active())
    plain = load_target("circle", hexapod, 2.0)
    home = hexapod.require_home()
    turns = plain.rotations @ home.rotation.T
    expected = about + (plain.positions - home.position) + (home.position - about) @ np.swapaxes(turns, 1, 2)
    np.testing.assert_allclose(target.positions, expected, atol=1e-15)
    np.testing.assert_allclose(target.rotations, plain.rotations, atol=1e-15)


def test_objects_stand_for_frames_and_for_a_target_in_them(cell, hexapod):
    target = load_target("sines", hexapod, 2.0)
    config = SimulationConfig(frames=load_frames(cell.frames), target=target)
    again = load_target(config.target, hexapod, 2.0, config.active_frames)
    np.testing.assert_allclose(again.positions, target.positions, atol=1e-12)
    np.testing.assert_allclose(again.rotations, target.rotations, atol=1e-12)
    assert text_of_target(again, hexapod, config.active_frames).splitlines()[0].startswith("time_s,x_m")
    with pytest.raises(InputError, match="the frames is a int; it must be a name, a path, or one of Frames"):
        SimulationConfig(frames=3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame": "desk"}, "no frame 'desk'; there are base, level, platform, table, corner, holder, needle"),
        ({"frame": "needle"}, "'needle' stands on the platform, so it is a tool, not a work frame"),
        ({"tool": "table"}, "'table' stands on base, so it is a work frame, not a tool"),
        ({"frame": "level"}, "a target in the level frame needs an IMU on the base: add --base-imu"),
        ({"frames": None, "tool": "needle"}, "the tool 'needle' stands in a file of frames: name that with --frames FILE.toml"),
        ({"frames": None, "frame": "table"}, "no frame 'table'; there are base, level; others stand in a file: name that with"),
        ({"frames": "nowhere.toml"}, "cannot read nowhere.toml: No such file"),
    ],
)
def test_frames_that_do_not_fit_are_refused(cell, changes, message):
    with pytest.raises((InputError, UnknownNameError), match=re.escape(message)):
        replace(cell, **changes)


def test_planar_mechanisms_have_no_frames(cell):
    with pytest.raises(InputError, match="frames are for six legs; planar-3rpr is planar: leave --frames out"):
        simulate(replace(cell, mechanism="planar-3rpr", target="hold"))


def test_the_enabled_pair_gives_way_to_the_one_that_is_named(cell):
    active = replace(cell, frame="base", tool="holder").active_frames
    assert active.text == "holder in base" and not active.absolute
    assert cell.active_frames.text == "needle in table" and cell.active_frames.absolute


def test_a_target_out_of_reach_is_not_said_to_fit_as_absolute(cell, tmp_path):
    path = tmp_path / "far.csv"
    path.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,1,1,0,0,0\n1,0,0,1,1,0,0,0\n")
    with pytest.raises(UnreachableError, match=r"the target far\.csv") as refused:
        simulate(replace(cell, target=str(path)))
    assert "fit" not in str(refused.value)


# ------------------------------------------------------------------------------------- streams, emulators, clocks and files


def test_a_stream_has_poses_of_the_tool_in_the_work_frame(cell):
    mechanism, frames = load_spatial("hexapod"), cell.active_frames
    home = mechanism.require_home()
    lengths = np.linalg.norm(home.position + mechanism.platform_joints - mechanism.base_joints, axis=1)
    stream = np.zeros((), STREAM)
    reception = Reception(stream, StreamPlanner(mechanism, lengths, frames), 1e-3)
    pose = np.linalg.inv(TABLE) @ whole(home.rotation, home.position + [0.0, 0.0, 0.004]) @ NEEDLE
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    reception.take(encode(1, 1_000_000_000, pose[:3, 3], (w, x, y, z)), "here")
    reception.plan()
    assert stream["accepted"] == 1 and stream["planned"] == 1
    planner = StreamPlanner(mechanism, lengths, frames)
    planner.add(0.0, pose[:3, 3], (w, x, y, z))
    planned = planner.plan(0.0, 0.0, True)
    raised = np.linalg.norm(home.position + [0.0, 0.0, 0.004] + mechanism.platform_joints - mechanism.base_joints, axis=1)
    np.testing.assert_allclose(planned.goal, raised, atol=1e-9)


@pytest.mark.slow
def test_a_run_on_the_clock_records_its_frames_and_says_how_far_the_tool_is_off(cell, tmp_path):
    path = tmp_path / "run.mcap"
    summary = run(replace(cell, duration=0.5, rate=200.0), RealTimeSettings(), path)
    recording = mcap.read(path)
    kept = parse_frames(recording.config["frame_definitions"], "recording")
    assert (kept.work, kept.tool, set(kept.frames)) == ("table", "needle", {"table", "corner", "holder", "needle"})
    np.testing.assert_allclose(kept.place("table").position, TABLE[:3, 3], atol=1e-15)
    assert summary["frames"] == {"work": "table", "tool": "needle", "root": "base"}
    records = recording.records[recording.records["status"] == 0]
    x, y, z, w = np.roll(records["truth"][:, 3:7], -1, axis=1).T
    true = records["truth"][:, :3] + Rotation.from_quat(np.stack([x, y, z, w], axis=1)).apply(NEEDLE[:3, 3])
    error = records["position"] + records["rotation"] @ NEEDLE[:3, 3] - true
    assert summary["errors_m"]["tool"] == pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    assert "tool" not in RunState(1e-3).errors()
    status = main(["frames", "zero", cell.frames, "here", "--parent", "base", "--recording", str(path), "--at", "0.4"])
    assert status == 0
    last = records[1e-9 * records["time_ns"] <= 0.4][-1]
    expected = whole(last["rotation"], last["position"]) @ NEEDLE
    found = load_frames(cell.frames).place("here")
    np.testing.assert_allclose(whole(found.rotation, found.position), expected, atol=1e-12)


def test_an_emulator_starts_where_the_tool_begins(cell, monkeypatch):
    started = []

    def plant_at(config, mechanism, start):
        started.append(start)
        return emulator_process_plant(config, mechanism, start)

    emulator_process_plant = emulator_process.simulated_plant
    monkeypatch.setattr(emulator_process, "simulated_plant", plant_at)
    emulator_process._rig_of(EmulatorConfig(cell), 1e-3, [])[0].close()
    expected = TABLE @ whole(np.eye(3), circle(np.zeros(1))[0]) @ np.linalg.inv(NEEDLE)
    np.testing.assert_allclose(whole(started[0].rotation, started[0].position), expected, atol=1e-12)


@pytest.mark.slow
def test_simulate_prints_and_writes_the_errors_of_the_tool(cell, tmp_path, capsys):
    pytest.importorskip("plotly")
    figures, report = tmp_path / "run.json", tmp_path / "run.html"
    line = ["simulate", "--frames", cell.frames, "--tool", "holder", "--frame", "base", "--duration", "0.5"]
    assert main([*line, "--json", str(figures), "--report", str(report)]) == 0
    assert "holder in base" in capsys.readouterr().out
    written = json.loads(figures.read_text())
    assert (written["frames"]["work"], written["frames"]["tool"]) == ("base", "holder")
    assert written["config"]["frame"] == "base"
    page = report.read_text()
    assert "holder in base" in page and "<h2>Frames</h2>" in page
    assert all(f"<th>{name}" in page for name in ("table", "corner", "holder", "needle"))
