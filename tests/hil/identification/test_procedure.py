"""From a command to the fitted file: the simulated plant with other actuators, a rig on a bus, and what is refused."""

import json
import tomllib
from dataclasses import asdict

import numpy as np
import pytest

from controller.calibration.file import Calibration
from controller.design.identification import DELAY, USUAL
from hil.calibration.machines import simulated_machine
from hil.command_line import main
from hil.identification.procedure import identify, identify_recording, measured_in, plan_identification
from hil.loop.records import RECORD
from hil.progress import no_progress
from hil.recording.mcap import Recorder, RecordingError, read
from hil.runs.config import SimulationConfig
from plant.errors import InputError
from plant.fmu.settings import Setting
from plant.mechanism import load_in_space, load_mechanism

OTHERS = {
    "drive.gain": (0.97, 1.02, 1.0, 0.98, 1.03, 0.99),
    "motor.resistance": (0.66, 0.55, 0.7, 0.6, 0.64, 0.52),
    "friction.coulomb": (19.0, 11.0, 15.0, 13.0, 18.0, 16.0),
    "motor.inductance": 0.0007,
    "motor.rotor_inertia": 0.000024,
}
"""Actuators that are not the preset's."""


def settings(values):
    return [f"{name}={','.join(map(str, np.ravel(value)))}" for name, value in values.items()]


@pytest.mark.slow
def test_the_command_recovers_other_actuators_and_hands_them_on(tmp_path):
    """Every value within 5 %, and within its interval or nearly so; nothing else of the mechanism has changed."""
    output, figures = tmp_path / "found.toml", tmp_path / "found.json"
    changes = [word for each in settings(OTHERS) for word in ("--set", each)]
    assert main(["identify", str(output), "--seed", "11", *changes, "--json", str(figures)]) == 0
    found = json.loads(figures.read_text())
    assert found["remarks"] == [] and found["unexplained"] == pytest.approx(1.0, abs=0.1)
    for each in found["parameters"]:
        if each["name"] == DELAY:
            assert each["interval"][0] <= 0.0 <= each["interval"][1] and each["value"] < 5e-5
            continue
        true = np.ravel(OTHERS[each["name"]])[each["leg"] or 0]
        assert each["value"] == pytest.approx(true, rel=0.05) and abs(each["value"] - true) < 4.0 * each["sigma"]
        assert each["interval"][1] - each["interval"][0] < 0.2 * true
    made, preset = load_mechanism(output), load_mechanism("hexapod")
    for name in OTHERS:
        np.testing.assert_allclose(made.plant[name], OTHERS[name], rtol=0.05)
    same = {name for name in preset.plant if np.array_equal(made.plant[name], preset.plant[name])}
    assert same == {*preset.plant} - {*OTHERS}
    assert tomllib.loads(output.read_text())["control"] == {**preset.settings["control"]}
    assert "# delay of the commands" in output.read_text()
    # The recording is kept, and gives the same again.
    again = identify_recording(tmp_path / "found.mcap").found
    assert [each.value for each in again.values] == [each["value"] for each in found["parameters"]]


@pytest.mark.endurance
@pytest.mark.parametrize("imu", ["mpu9150-calibrated"])
def test_intervals_hold_the_truth(tmp_path, imu):
    """In at least 35 of 40 seeds for every parameter, none wider than 10 % to either side, every error below 5 %."""
    plant = load_in_space("hexapod").plant_parameters()
    held: dict[tuple[str, int | None], int] = {}
    for seed in range(600, 640):
        random = np.random.default_rng(seed)
        true = {name: plant[name] * random.uniform(0.8, 1.25, plant[name].shape) for name in USUAL if name != DELAY}
        true["drive.gain"] = random.uniform(0.95, 1.05, 6)
        true["motor.resistance"] = plant["motor.resistance"] * random.uniform(0.8, 1.25, 6)
        config = SimulationConfig(imu=imu, seed=seed, settings=tuple(map(Setting.parse, settings(true))))
        plan = plan_identification(config, 10.0, 0.8)
        (tmp_path / "run.mcap").unlink(missing_ok=True)
        for each in identify(plan, simulated_machine(no_progress), tmp_path / "run.mcap").found.values:
            value = 0.0 if each.name == DELAY else float(np.ravel(true[each.name])[each.leg or 0])
            scale = 1.0 / config.rate if each.name == DELAY else value
            assert abs(each.value - value) < 0.05 * scale and each.half < 0.1 * scale, (seed, each)
            held[each.name, each.leg] = held.get((each.name, each.leg), 0) + each.holds(value)
    assert min(held.values()) >= 35, held


@pytest.fixture
def recorded(tmp_path):
    """A recording of made-up records: two legs of a run on a rig whose samples come with the exchanges."""

    def make(name="rig.mcap", count=4000, rig="udp", moving=slice(1000, 3800), **changes):
        config = SimulationConfig(rig="fmu" if rig == "fmu" else "udp", rate=1000.0)
        records = np.zeros(count, RECORD)
        records["cycle"] = np.arange(count)
        records["time_ns"] = 1_000_000 * np.arange(count)
        records["sample_ns"] = (5_000_000_000 + 1_000_000 * np.arange(count) + 40_000)[:, None]
        records["request"][900:3900] = 1
        records["reference"][moving, 0, 1] = 0.01
        records["specific_force"] = np.random.default_rng(0).normal(0.0, 0.05, records["specific_force"].shape)
        records["command"] = np.arange(count)[:, None]
        for field, (rows, value) in changes.items():
            records[field][rows] = value
        path = tmp_path / name
        header = {"config": {**asdict(config), "version": "0"}, "parameters": np.zeros(1), "reference": np.zeros((6, 1, 5))}
        recorder = Recorder(path, header, 0)
        recorder.write_cycles(records)
        recorder.close()
        return path

    return make


def read_back(path):
    return measured_in(read(path), Calibration())


def test_a_rig_exchanges_at_the_times_of_its_samples(recorded):
    """On the rig's own clock; unanswered exchanges lie between, and the noise at rest is that before the drives are enabled."""
    late = 7_000_040_000 + 300_000
    found = read_back(recorded(sample_ns=(2000, late), silent=(slice(2100, 2103), 1)))
    times, commands = found.commands.times, found.commands.velocities
    assert commands[0, 0] == 1000.0 and commands[-1, 0] == 3899.0
    assert times[1000] == pytest.approx(1.0 + 300e-6, abs=1e-9)
    np.testing.assert_allclose(np.delete(times, 1000), np.delete(1e-3 * np.arange(len(times)), 1000), atol=1e-9)
    assert not found.fresh[1100:1103].any() and found.fresh[:1100].all()
    assert not found.ages.any() and found.rest[1] == pytest.approx(0.05, rel=0.1)


def test_samples_of_the_simulated_plant_have_ages(recorded):
    ages = np.array([0, 100, 200, 300, 400, 500, 900]) * 1000
    rows = np.arange(4000)[:, None] * 1_000_000 - ages
    found = read_back(recorded(rig="fmu", sample_ns=(slice(None), rows)))
    np.testing.assert_allclose(found.ages[5], 1e-9 * ages, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"moving": slice(0, 0)}, "nothing moves"),
        ({"request": (slice(1500, None), 0)}, "follow a motion for 0.5 s .* at least 2 s"),
        ({"silent": (slice(None), 1)}, "hardly answered"),
    ],
)
def test_recordings_without_a_motion_are_refused(recorded, changes, said):
    with pytest.raises(RecordingError, match=said):
        read_back(recorded(**changes))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("--rig replay --rig-at run.mcap", "give its recording with --recording"),
        ("--rig udp", "no terminal to ask at"),
        ("--fit drive.gian", "did you mean 'drive.gain'"),
        ("--duration 2", "it must be 5 to 60 s"),
        ("--share 2", "it must be 0.01 to 0.95"),
        ("--recording absent.mcap --rate 500", "the recordings say what --rate would"),
        ("--recording absent.mcap", "there is no recording"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(line, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["identify", "out.toml", *line.split()]) == 2
    assert said in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_drives_that_close_a_position_loop_are_refused():
    with pytest.raises(InputError, match="drives that close a position loop hide"):
        plan_identification(SimulationConfig(drives="position"), 10.0, 0.8)
