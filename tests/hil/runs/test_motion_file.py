"""A motion file in the closed loop: with ideal sensors, the platform goes straight where the motion does."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.planning.motions import Cueing, Motion, drive, plan_motion, text_of_vehicle
from hil.command_line import main
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate

FIRST, LAST = np.array([0.04, -0.02, 0.01]), np.array([-0.03, 0.03, -0.01])
FIRST_TURN, LAST_TURN = np.array([4.0, -3.0, 6.0]), np.array([-4.0, 3.0, -6.0])
MOTION = f"""
[limits]
speed = 0.05
acceleration = 0.2
jerk = 2

[[elements]]
kind = "line"
to = {{position = {FIRST.tolist()}, rotation_deg = {FIRST_TURN.tolist()}}}
dwell = 1

[[elements]]
kind = "line"
to = {{position = {LAST.tolist()}, rotation_deg = {LAST_TURN.tolist()}}}
dwell = 0.2
"""


AT_FULL_SPEED = MOTION.replace("[limits]\nspeed = 0.05\nacceleration = 0.2\njerk = 2\n", "").replace("dwell = 1", "dwell = 9")


@pytest.fixture
def path(tmp_path):
    made = tmp_path / "line.toml"
    made.write_text(MOTION)
    return made


def test_a_command_tells_what_binds(path, tmp_path, capsys):
    figures, poses = tmp_path / "figures.json", tmp_path / "poses.csv"
    assert main(["motion", str(path), "--json", str(figures), "--csv", str(poses)]) == 0
    out = capsys.readouterr().out
    assert "speed of the tool" in out and "within all limits" in out
    found = json.loads(figures.read_text())
    assert [each["binding"] for each in found["elements"]] == ["speed of the tool", None] * 2
    speed = next(each for each in found["peaks"] if each["name"] == "speed of the tool")
    assert speed["limit"] == 0.05 and speed["value"] == pytest.approx(0.05, rel=1e-4)
    table = np.loadtxt(poses, delimiter=",", skiprows=1)
    reached = table[np.searchsorted(table[:, 0], found["elements"][1]["begin"] + 0.1)]
    np.testing.assert_allclose(reached[1:4], FIRST, atol=1e-8)
    assert found["duration"] == pytest.approx(table[-2, 0], abs=0.003)


def test_a_motion_out_of_reach_is_refused_in_a_line(path, capsys):
    path.write_text('[[elements]]\nkind = "line"\nto = {position = [0, 0, 0.3]}\n')
    assert main(["motion", str(path)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("gough: line.toml, element 1 (line), leaves the strokes at") and error.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "fusion", "duration"),
    [
        (MOTION, "compiled", 6.0),
        pytest.param(AT_FULL_SPEED, "compiled", 13.0, marks=pytest.mark.slow),
        pytest.param(AT_FULL_SPEED, "whole", 13.0, marks=pytest.mark.slow),
    ],
)
def test_a_line_is_straight_in_the_loop(path, hexapod, text, fusion, duration):
    """Within 0.05 mm and 0.02 deg, once the estimate has settled, also at the actuators' full speed and acceleration."""
    path.write_text(text)
    result = simulate(SimulationConfig(target=str(path), imu="ideal", duration=duration, fusion=fusion))
    assert result.reference.violations == 0
    rest = np.linalg.norm(result.target_positions - hexapod.home.position - FIRST, axis=1) < 1e-9
    begin = result.times[rest].max()
    there = np.linalg.norm(result.target_positions - hexapod.home.position - LAST, axis=1) < 1e-9
    moving = (result.times > begin) & (result.times < result.times[there & (result.times > begin)].min() + 0.1)
    first, last = Rotation.from_rotvec(FIRST_TURN, degrees=True), Rotation.from_rotvec(LAST_TURN, degrees=True)
    along, whole = (LAST - FIRST) / np.linalg.norm(LAST - FIRST), (last * first.inv()).as_rotvec(degrees=True)
    for positions, rotations, most, most_turn in (
        (result.reference_positions, result.reference_rotations, 0.02e-3, 0.005),
        (result.true_positions, result.true_rotations, 0.05e-3, 0.02),
    ):
        away = positions[moving] - hexapod.home.position - FIRST
        assert np.linalg.norm(away[-1] - (LAST - FIRST)) < 1e-4
        assert np.linalg.norm(away - np.outer(away @ along, along), axis=1).max() < most
        turns = (Rotation.from_matrix(rotations[moving] @ hexapod.home.rotation.T) * first.inv()).as_rotvec(degrees=True)
        axis = whole / np.linalg.norm(whole)
        assert np.linalg.norm(turns - np.outer(turns @ axis, axis), axis=1).max() < most_turn


def test_a_cue_is_felt_in_the_loop(tmp_path, hexapod):
    """What an accelerometer on the true platform reads is what was planned, and pushes as the vehicle does."""
    path = tmp_path / "brake.csv"
    path.write_text(text_of_vehicle(drive(["brake"], speed=6.0, rest=1.5)))
    motion = Motion((Cueing(file=str(path), settle=3.0),))
    planned = plan_motion(motion, hexapod)
    result = simulate(SimulationConfig(target=motion, imu="ideal", duration=planned.duration))
    assert result.reference.violations == 0
    begin = result.times[0]

    def felt(times, positions, rotations):
        """Specific force (N, 3) less that at rest, over 50 ms."""
        accelerations = np.gradient(np.gradient(positions, times, axis=0), times, axis=0)
        up = 9.81 * np.array([0.0, 0.0, 1.0])
        forces = np.einsum("nji,nj->ni", rotations, accelerations + up) - up
        width = round(0.05 / np.diff(times).mean())
        return np.array([np.convolve(each, np.ones(width) / width, "same") for each in forces.T]).T

    true = felt(result.times, result.true_positions, result.true_rotations)
    reference = felt(result.times, result.reference_positions, result.reference_rotations)
    later = result.times > begin + 1.2
    off = true[later][:-100] - reference[later][:-100]
    assert np.sqrt((off**2).mean(axis=0)).max() < 0.05
    assert reference[later][:, 0].min() < -0.5 and true[later][:, 0].min() < -0.5
