"""The comparison of every way to fuse: what it prints, and that the ways are in the order that they should be."""

import json

import pytest

from hil.command_line import main
from hil.studies.fusion_comparison import METHODS, SLOW_METHODS


@pytest.fixture(scope="module")
def figures(tmp_path_factory):
    path = tmp_path_factory.mktemp("fusion") / "fusion.json"
    assert (
        main(["compare-fusion", "--motion", "1", "--duration", "22", "--seeds", "0", "--rate", "250", "--json", str(path)]) == 0
    )
    return json.loads(path.read_text())["methods"]


@pytest.mark.endurance
def test_every_method_is_there(figures):
    assert list(figures) == [*METHODS, *SLOW_METHODS]
    for name, method in figures.items():
        assert 0.0 < method["position_rms"] < 5e-3, name
        assert method["seeds"] == 1


@pytest.mark.endurance
def test_the_whole_mechanism_beats_its_parts_and_the_parts_what_knows_no_joints(figures):
    error = {name: method["position_rms"] for name, method in figures.items()}
    assert error["whole"] < 0.5 * error["refined (compiled)"]
    assert error["refined (compiled)"] < 0.5 * error["vqf per IMU, refined"]
    assert error["whole"] < 0.15e-3
    assert error["refined (filterpy)"] == pytest.approx(error["refined (compiled)"], rel=1e-6)


@pytest.mark.endurance
def test_covariances_are_of_the_size_of_the_errors(figures):
    assert 0.5 < figures["whole"]["nees"] < 15.0
    assert figures["section 5, magnetometer"]["nees"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--duration", "20"], "it must be more than 20 s, which do not count"),
        (["--rate", "nan"], "the rate is nan Hz"),
        (["--motion", "wobble"], "there is no imposed motion 'wobble'"),
        (["--imu", "best"], "no IMU preset 'best'"),
        (["--calibration", "none.toml"], "cannot read none.toml"),
    ],
)
def test_bad_input_is_refused_in_a_line(arguments, complaint, capsys):
    assert main(["compare-fusion", *arguments]) == 2
    assert complaint in capsys.readouterr().err
