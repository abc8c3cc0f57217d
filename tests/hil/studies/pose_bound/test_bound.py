"""The command `gough bounds`: the bound of a configuration, the closed loop beside it, and what is refused."""

import json

import numpy as np
import pytest

from hil.command_line import main
from hil.runs.config import SimulationConfig
from hil.studies.pose_bound.bound import Measured, PoseBound, find_bound, measure, ratios, table, text

SHORT = {"target": "hold", "duration": 0.4}


def test_the_bound_falls_with_time_at_rest_and_faster_in_motion():
    still = find_bound(SimulationConfig(target="hold", duration=2.0))
    moving = find_bound(SimulationConfig(target="sines", duration=2.0, lengths="incremental"))
    assert (np.diff(still.position) <= 1e-9).all() and still.times[-1] == pytest.approx(2.0)
    assert moving.at(2.0)[0] < 0.7 * still.at(2.0)[0]
    assert still.over_the_motion()[0] > still.over_the_motion(1.0)[0] > still.at(2.0)[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "most"),
    [
        ({}, 2.0),
        ({"lengths": "absolute"}, 2.0),
        pytest.param({"mechanism": "planar-3rpr", "lengths": "absolute"}, 2.0, marks=pytest.mark.slow),
        ({"base_imu": True, "faults": ("base-tilt,axis=x,size_deg=3,sine_hz=0.125",)}, 2.0),
    ],
)
def test_the_closed_loop_errs_as_much_as_the_bound_says(changes, most):
    """Of four seeds the RMS of about twenty numbers is within a factor of two; a wrong unit or frame is not."""
    config = SimulationConfig(**SHORT, **changes)
    measured = measure(config, 4)
    assert not measured.stopped and np.isfinite(measured.position).all() and measured.position.shape == (4, 20)
    for name, ratio in ratios(find_bound(config), measured).items():
        assert 0.4 < ratio < most, name


def test_a_pose_that_is_not_determined_is_a_dash():
    open_pose = find_bound(SimulationConfig(imus=(0, 6), **SHORT))
    assert text(open_pose.at(0.4)) == "-"
    assert text((1e-3, np.radians(2.0))) == "1.000 / 2.000"


def test_the_table_has_moments_within_the_motion():
    times = 0.02 * np.arange(1, 76)
    made = table(PoseBound(times, np.full(75, 1e-3), np.full(75, 1e-2)))
    assert [row[0].text for row in made.rows] == ["after 0.1 s", "after 1 s", "at the end, 1.5 s", "over the motion"]


def test_what_came_before_a_time_does_not_count_from_then_on():
    times = 0.02 * np.arange(1, 76)
    sizes = np.where(times > 1.0, 1e-3, 5e-3)
    bound, measured = PoseBound(times, sizes, sizes), Measured(times, 2.0 * sizes[None], 3.0 * sizes[None], ())
    made = table(bound, measured, since=1.0)
    assert [cell.text for cell in made.rows[-1]] == ["from 1 s on", "1.000 / 0.057", "2.000 / 0.172", "2.00 / 3.00"]
    assert made.rows[-2][1].text != made.rows[-1][1].text
    assert ratios(bound, measured, 1.0)["position_since"] == pytest.approx(2.0)


def test_the_command_prints_and_writes(tmp_path, capsys):
    path = tmp_path / "bound.json"
    arguments = ["bounds", "--imus", "0,4,5,6", "--lengths", "incremental", "--duration", "0.4", "--json", str(path)]
    assert main([*arguments, "--measured", "--seeds", "2", "--workers", "1", "--since", "0.2"]) == 0
    printed = capsys.readouterr().out
    assert "over the bound" in printed and "from 0.2 s on" in printed
    written = json.loads(path.read_text())
    assert written["measured"]["seeds"] == 2 and len(written["measured"]["position_end"]) == 2
    assert written["since"] == 0.2 and written["measured"]["over_bound"]["rotation_since"] > 0.0
    assert len(written["bound"]["times"]) == len(written["bound"]["position"]) == 30
    assert written["config"]["imus"] == [0, 4, 5, 6]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--imus", "0,1,2,3", "--magnetometer"], "add IMU 6"),
        (["--mechanism", "planar-3rpr", "--magnetometer"], "of a mechanism in space"),
        (["--measured", "--seeds", "0"], "at least 1 is needed"),
        (["--measured", "--calibration", "none.toml"], "none.toml"),
        (["--lengths", "none.toml"], "none.toml"),
        (["--since", "5"], "not within the motion of 5 s"),
        (["--fault", "base-tilt,axis=x,size_deg=3,sine_hz=0.125"], "add --base-imu"),
        (["--base-imu", "--fault", "imu-turn:2,axis=x,size_deg=3"], "is a fault of some"),
        (["--base-imu", "--magnetometer"], "leave out --magnetometer or --base-imu"),
    ],
)
def test_bad_input_is_refused_in_a_line(arguments, complaint, capsys):
    assert main(["bounds", *arguments]) == 2
    error = capsys.readouterr().err
    assert complaint in error and error.strip().count("\n") == 0
