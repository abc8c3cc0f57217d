"""Guided calibration: each step is announced and recorded, a failed one says how to go on, and kept ones are not run again."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from controller.cycle import cycle_parameters
from controller.inverse_kinematics import inverse_kinematics
from controller.settings import control_settings, sensor_settings
from hil.calibration.data import Knowledge
from hil.calibration.excitation import MotionLimits
from hil.calibration.guided import Guide, Machine, calibrate_guided, plan_calibration
from hil.calibration.procedure import FailedCalibrationError
from hil.command_line import main
from hil.loop.records import RECORD
from hil.recording.mcap import Recorder
from hil.rigs.kinematic import ideal_signals
from hil.runs.config import SimulationConfig
from plant.errors import CalibrationError, InputError
from plant.imu import ACCELEROMETER, GYROSCOPE, load_imu
from plant.pose import rotation_from_vector

CONFIG = SimulationConfig(imu="mpu9150", rate=200.0)


@pytest.fixture(scope="module")
def plan():
    return plan_calibration(CONFIG, MotionLimits())


class Bench:
    """A machine at rest at home, whatever it is asked to do, and what was told of it."""

    def __init__(self, mechanism, turned=(), found=()):
        self.runs, self.announced, self.told, self.found, self.tilt = [], [], [], list(found), 0.0
        self.silent = 400
        still = np.zeros(6)
        self.lengths = inverse_kinematics(mechanism, mechanism.require_home()).lengths
        self.signals = ideal_signals(mechanism)(mechanism.require_home(), still, still)
        for imu in turned:
            self.signals[ACCELEROMETER, imu] *= -1.0
        settings = control_settings(mechanism), sensor_settings(mechanism, load_imu("mpu9150"), 200.0)
        self.parameters = cycle_parameters(mechanism, 200.0, *settings)
        self.machine = Machine(self.run, lambda config: self.found)
        self.guide = Guide(lambda number, count, step: self.announced.append((number, count, step.name)), self.told.append)

    def run(self, config, path):
        self.runs.append((config.target, config.arm, config.open_loop))
        records = np.zeros(round(config.rate * (config.duration + config.hold)), RECORD)
        records["reference"][:, :, 0] = self.lengths
        records["cycle"] = np.arange(len(records))
        noise = np.random.default_rng(0).normal(0.0, 0.01, (len(records), 2, 7, 3))
        for sensor, name in ((GYROSCOPE, "angular_velocity"), (ACCELEROMETER, "specific_force")):
            records[name] = self.signals[sensor] @ rotation_from_vector([0.0, self.tilt, 0.0]) + noise[:, sensor]
        records["silent"][self.silent :] = 1
        header = {"config": {**asdict(config), "version": "0"}, "parameters": self.parameters, "reference": np.zeros((6, 1, 5))}
        recorder = Recorder(path, header, 0)
        recorder.write_cycles(records)
        recorder.close()
        if len(self.runs) > 1 and config.arm:
            raise CalibrationError("the cable came off")

    def calibrate(self, plan, output, resume=False):
        return calibrate_guided(plan, Knowledge(), output, self.machine, self.guide, resume)


@pytest.mark.slow
def test_the_first_step_moves_nothing_and_a_failed_one_is_kept_and_gone_on_from(plan, tmp_path: Path) -> None:
    output, bench = tmp_path / "rig.toml", Bench(plan.mechanism)
    with pytest.raises(FailedCalibrationError, match=r"step 3 of 6, probing, failed: the cable came off.*--resume") as failed:
        bench.calibrate(plan, output)
    assert bench.announced == [(1, 6, "reading"), (2, 6, "legs"), (3, 6, "probing")]
    assert [run[1:] for run in bench.runs] == [(False, True), (True, True)], "nothing is armed in the first"
    assert str(tmp_path / "rig.probing.failed.mcap") in str(failed.value)
    kept = {path.name for path in tmp_path.iterdir()}
    assert kept == {"rig.reading.mcap", "rig.legs.txt", "rig.probing.failed.mcap"}
    assert "gravity at most 0." in bench.told[0] and "gyroscopes up to 0." in bench.told[0]
    with pytest.raises(InputError, match=r"rig\.reading\.mcap is there.*--resume, or remove it"):
        bench.calibrate(plan, output)
    again = Bench(plan.mechanism)
    with pytest.raises(FailedCalibrationError, match="step 3 of 6, probing, failed: the cable came off"):
        again.calibrate(plan, output, resume=True)
    assert again.announced == [(3, 6, "probing")] and [run[1] for run in again.runs] == [False, True]
    assert any("step 1 of 6 was done" in line for line in again.told)


@pytest.mark.slow
def test_it_does_not_go_on_blindly_from_another_place(plan, tmp_path: Path) -> None:
    output, moved = tmp_path / "rig.toml", Bench(plan.mechanism)
    with pytest.raises(FailedCalibrationError):
        moved.calibrate(plan, output)
    moved.runs, moved.announced, moved.tilt = [], [], np.radians(3.0)
    with pytest.raises(FailedCalibrationError, match=r"does not stand where it stood in the first step: .* by 3\.? ?\d* ?deg"):
        moved.calibrate(plan, output, resume=True)
    assert not moved.announced and [run[1] for run in moved.runs] == [False], "nothing moves"


@pytest.mark.slow
def test_a_kept_recording_of_another_rig_is_refused(plan, tmp_path: Path) -> None:
    output = tmp_path / "rig.toml"
    with pytest.raises(FailedCalibrationError):
        Bench(plan.mechanism).calibrate(plan, output)
    other = plan_calibration(SimulationConfig(imu="bmi088", rate=200.0), MotionLimits())
    with pytest.raises(FailedCalibrationError, match=r"its imu is mpu9150, and this calibration's is bmi088.*remove it"):
        Bench(plan.mechanism).calibrate(other, output, resume=True)
    slower = plan_calibration(CONFIG, MotionLimits(speed=0.1))
    with pytest.raises(FailedCalibrationError, match="its mechanism, or --box, --speed or --force, is another one"):
        Bench(plan.mechanism).calibrate(slower, output, resume=True)


def test_ctrl_c_between_runs_says_how_to_go_on(plan, tmp_path: Path) -> None:
    def interrupted(config):
        raise KeyboardInterrupt

    bench = Bench(plan.mechanism)
    bench.machine = Machine(bench.run, interrupted)
    with pytest.raises(KeyboardInterrupt):
        bench.calibrate(plan, tmp_path / "rig.toml")
    assert "step 2 of 6, legs, was interrupted" in bench.told[-1] and "--resume" in bench.told[-1]


def test_a_wrong_sign_at_rest_or_in_a_leg_ends_it_before_the_next_step(plan, tmp_path: Path) -> None:
    bench = Bench(plan.mechanism, turned=(2, 6))
    with pytest.raises(
        FailedCalibrationError, match=r"step 1 .* gravity comes from elsewhere .* IMU 2 by 180 deg, IMU 6 by 180"
    ):
        bench.calibrate(plan, tmp_path / "a.toml")
    assert len(bench.announced) == 1
    bench = Bench(plan.mechanism)
    bench.silent = 30
    with pytest.raises(FailedCalibrationError, match="has not answered in time in 92 % of 400 cycles; at most 10 %"):
        bench.calibrate(plan, tmp_path / "c.toml")
    bench = Bench(plan.mechanism, found=["Leg 3 moves the wrong way."])
    with pytest.raises(FailedCalibrationError, match="step 2 of 6, legs, failed: Leg 3 moves the wrong way"):
        bench.calibrate(plan, tmp_path / "b.toml")
    assert (tmp_path / "b.legs.failed.txt").read_text() == "Leg 3 moves the wrong way."
    assert bench.announced[-1][2] == "legs" and len(bench.runs) == 1


def test_every_step_says_what_will_happen_how_far_and_how_fast(plan) -> None:
    texts = {step.name: step.text for step in plan.steps}
    assert "Nothing moves" in texts["reading"] and not plan.steps[0].moves and all(step.moves for step in plan.steps[1:])
    for name in ("probing", "near-rests", "rests", "shaking"):
        assert "mm and" in texts[name] and "250 mm/s at most" in texts[name]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--rig", "udp"), "there is no terminal to ask at before the rig moves"),
        (("--rig", "replay", "--yes"), "a replay cannot be driven: give its recording with --recording"),
        (("--box", "5", "1"), "--box is too small"),
        (("--speed", "-1"), "--speed is -1 mm/s; it must be positive"),
        (("--rig", "udp", "--yes", "--known-poses"), "leave it out"),
        (("--recording", "a.mcap", "--resume"), "limits and --resume"),
    ],
)
def test_what_cannot_be_led_through_is_refused_before_anything_moves(arguments, message, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr("hil.calibration.machines.run", None)
    assert main(["calibrate", "rig", str(tmp_path / "rig.toml"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.endurance
def test_the_plant_rehearses_it_within_a_box(tmp_path: Path, capsys) -> None:
    output, figures = tmp_path / "rig.toml", tmp_path / "rig.json"
    arguments = ["calibrate", "rig", str(output), "--seed", "1", "--box", "40", "8", "--speed", "100", "--json", str(figures)]
    assert main(arguments) == 0
    told = capsys.readouterr().err
    assert all(f"step {number} of 6" in told for number in range(1, 7))
    assert "instead of 0.73 mm and 0.11 deg" in told
    true, predicted = (json.loads(figures.read_text())[kind]["motion"] for kind in ("true", "predicted"))
    assert true["position_rms"] < 2.0 * predicted["position_rms"] < 2e-3
    kept = {path.name for path in tmp_path.glob("rig.*.mcap")}
    assert kept == {f"rig.{name}.mcap" for name in ("reading", "probing", "near-rests", "rests", "shaking")}
    # All is kept, so that nothing has to run again.
    assert main([*arguments, "--resume"]) == 0
    assert json.loads(figures.read_text())["true"]["motion"] == true


@pytest.mark.endurance
def test_a_mechanism_whose_joints_swing_little_is_calibrated_within_its_limits(tmp_path: Path, capsys) -> None:
    own = tmp_path / "own.toml"
    swings = "[joints]\nbase_swing = 0.3\nplatform_swing = 0.3\n"
    own.write_text(f'based_on = "hexapod"\nname = "own"\n\n{swings}\n[bodies]\nleg_diameter = 0.03\n')
    command = ["calibrate", "rig", "--mechanism", str(own), "--imu", "mpu9150", "--seed", "3"]
    for name, options in (("whole", []), ("boxed", ["--box", "90", "20"])):
        figures = tmp_path / f"{name}.json"
        assert main([*command[:2], str(tmp_path / f"{name}.toml"), *command[2:], "--json", str(figures), *options]) == 0
        assert json.loads(figures.read_text())["true"]["motion"]["position_rms"] < 2e-3
    assert "the limits of the mechanism cut --box to" in capsys.readouterr().err
