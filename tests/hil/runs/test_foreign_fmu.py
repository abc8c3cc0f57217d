"""A foreign FMU in the closed loop: it follows the target, with the truth and without, and fails in a controlled way."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.errors import InputError
from plant.fmu.settings import Setting
from plant.truth import TRUTH_CURRENTS
from tests.hil.commands import gough
from tests.plant.fmu.foreign import BINDING, BINDING_3, TRUTH, edited

MM, DEG = 1e-3, np.radians(1.0)


@pytest.fixture
def binding(tmp_path):
    path = tmp_path / "foreign.toml"
    path.write_text(BINDING + TRUTH)
    return path


@pytest.fixture
def binding_3(tmp_path):
    path = tmp_path / "foreign3.toml"
    path.write_text(BINDING_3)
    return path


@pytest.fixture
def bare(tmp_path):
    """Without the truth."""
    path = tmp_path / "bare.toml"
    path.write_text(BINDING)
    return path


def test_a_foreign_fmu_follows_the_target(foreign_fmu, binding, tmp_path):
    figures = tmp_path / "figures.json"
    plant = ("--plant", foreign_fmu, "--binding", binding, "--set", "servo.lag=0.01", "--set", "servo.lag=0.03@1.5")
    run = gough("simulate", *plant, "--target", "sines", "--duration", 3, "--imu", "ideal", "--json", figures)
    assert run.returncode == 0, run.stderr
    found = json.loads(figures.read_text())
    assert found["truth_known"] and found["limits"]["violations"] == 0
    for group in ("estimation", "tracking"):
        assert found[group]["position_rms"] < 0.05 * MM
        assert found[group]["rotation_rms"] < 0.05 * DEG
    assert [each["at"] for each in found["config"]["settings"]] == [None, 1.5]


def test_fmi_3_in_other_units_is_the_same_motion(foreign_fmu, foreign_fmu_3, binding, binding_3):
    two, three = (
        simulate(SimulationConfig(plant=str(fmu), binding=str(text), target="sines", duration=1.0, imu="ideal"))
        for fmu, text in ((foreign_fmu, binding), (foreign_fmu_3, binding_3))
    )
    assert three.summary()["tracking"]["position_rms"] < 0.05 * MM
    # Other units round otherwise, as processors do; the loop feeds it back, and each start of a leg from rest makes it larger:
    # a hundredfold after 0.6 s.
    for field, tolerance in (("position", 1e-9), ("rotation", 1e-7), ("command", 1e-6), ("truth", 1e-8)):
        for end, larger in ((600, 1.0), (None, 100.0)):
            other, one = three.records[field][:end], two.records[field][:end]
            np.testing.assert_allclose(other, one, rtol=0.0, atol=larger * tolerance)
    assert np.ptp(three.true_positions, axis=0).max() > 5.0 * MM


def test_low_cost_imus_follow_on_a_foreign_fmu(foreign_fmu, binding):
    result = simulate(SimulationConfig(plant=str(foreign_fmu), binding=str(binding), target="circle", duration=3.0))
    assert result.summary()["tracking"]["position_rms"] < 1.5 * MM
    moved = np.ptp(result.true_positions, axis=0)
    assert moved.max() > 10.0 * MM


@pytest.mark.slow
def test_without_the_truth_the_loop_follows_all_the_same_and_says_so(foreign_fmu, binding, bare, tmp_path):
    figures, report = tmp_path / "figures.json", tmp_path / "report.html"
    plant = ("--plant", foreign_fmu, "--target", "sines", "--duration", 1, "--json", figures)
    run = gough("simulate", *plant, "--binding", bare, "--report", report)
    assert run.returncode == 0, run.stderr
    assert "the truth is not known" in run.stdout and "nan" not in run.stdout and "estimate - truth" not in run.stdout
    blind = json.loads(figures.read_text())
    assert blind["estimation"] is blind["tracking"] is None and not blind["truth_known"]
    page = report.read_text()
    assert "Estimated poses" in page and ">nan<" not in page
    assert gough("simulate", *plant, "--binding", binding).returncode == 0
    seeing = json.loads(figures.read_text())
    assert blind["estimated_tracking"] == seeing["estimated_tracking"]
    assert seeing["estimated_tracking"]["position_rms"] < 0.2 * MM


def test_imus_that_the_fmu_lacks_are_left_out_or_refused(foreign_fmu, tmp_path):
    legs = re.sub(r", 'top\.[^']*'", "", BINDING).replace(", 1, 1, 1]", "]")
    path = tmp_path / "legs.toml"
    path.write_text(re.sub(r"(\[imu_\w+\])", r"\1\nimus = [0, 1, 2, 3, 4, 5]", legs))
    config = {"plant": str(foreign_fmu), "binding": str(path), "imu": "ideal", "target": "sines", "duration": 1.0}
    with pytest.raises(InputError, match=r"foreign.fmu has no IMU 6: leave it out with --imus 0,1,2,3,4,5"):
        simulate(SimulationConfig(**config))
    summary = simulate(SimulationConfig(**config, imus=(0, 1, 2, 3, 4, 5))).summary()
    assert summary["estimated_tracking"]["position_rms"] < 0.2 * MM
    with pytest.raises(InputError, match=r"foreign.fmu has no magnetometer on the platform: bind imu_magnetic_field"):
        path.write_text(BINDING)
        simulate(SimulationConfig(**config, magnetometer=True))


@pytest.mark.parametrize("status", [1, 3])
def test_a_status_other_than_ok_ends_a_simulation_with_the_message_of_the_fmu(foreign_fmu, binding, status):
    settings = tuple(map(Setting.parse, (f"fault.status={status}", "fault.at=0.5")))
    config = SimulationConfig(plant=str(foreign_fmu), binding=str(binding), settings=settings, duration=1.0, imu="ideal")
    with pytest.raises(
        SimulationStoppedError, match=r"cycle 501 of 1200: .*servo 3 is at 91.5 degrees after a while"
    ) as stopped:
        simulate(config)
    assert len(stopped.value.result.records) > 500
    assert np.isfinite(stopped.value.result.summary()["tracking"]["position_rms"])


EVENT = "met an event, which needs event mode: export the FMU so that it handles its events itself"


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (1, "gave a warning: servo 3 is at 91.5 degrees after a while"),
        (10, "asked for the end of the simulation: the FMU gives no reason"),
        (11, f"{EVENT}: the FMU gives no reason"),
        (12, f"{EVENT}: the FMU gives no reason"),
    ],
)
def test_a_warning_and_every_flag_of_fmi_3_end_a_simulation(foreign_fmu_3, binding_3, kind, words):
    settings = tuple(map(Setting.parse, (f"trouble.kind={kind}", "trouble.time=0.3")))
    config = SimulationConfig(plant=str(foreign_fmu_3), binding=str(binding_3), settings=settings, duration=0.5, imu="ideal")
    with pytest.raises(SimulationStoppedError, match=rf"cycle 301 of 700: foreign3.fmu: a step {re.escape(words)}$"):
        simulate(config)


@pytest.mark.slow
def test_a_run_on_the_clock_ends_with_the_message_of_the_fmu(foreign_fmu, bare):
    # Changed while it runs: the fault is due 0.2 s after the hold of 1 s.
    faults = ("--set", "fault.status=3", "--set", "fault.at=0.001@0.2")
    run = gough("run", "--plant", foreign_fmu, "--binding", bare, *faults, "--duration", 1, "--rate", 200, "--imu", "ideal")
    assert run.returncode == 1
    assert re.search(r"stopped on the brakes at cycle 24\d: foreign.fmu: a step failed: servo 3 is at 91.5 degrees", run.stderr)
    assert "the truth is not known" in run.stdout


def test_what_does_not_fit_is_refused_before_anything_moves(foreign_fmu, binding):
    plant = ("--plant", foreign_fmu, "--binding", binding)
    for arguments, message in (
        (("--binding", binding), "foreign.toml binds an FMU, and none is given: name it with --plant FILE.fmu"),
        ((*plant, "--set", "servo.lag"), "'servo.lag' is no setting such as payload.mass=12"),
        ((*plant, "--set", "servo.lag=1@99"), "servo.lag is set at 99 s, when the motion of 10 s is over"),
        ((*plant, "--joint-error", "1"), "foreign.toml binds an FMU with joints of its own"),
        (("--set", "platform.mass=4@1"), "platform.mass of gough_plant.fmu cannot change during the run"),
    ):
        run = gough("simulate", *arguments)
        assert run.returncode == 2 and run.stdout == ""
        assert message in run.stderr and len(run.stderr.splitlines()) == 1


def test_the_payload_of_our_own_plant_changes_during_a_run():
    heavier = simulate(
        SimulationConfig(duration=1.0, imu="ideal", target="hold", settings=(Setting.parse("payload.mass=15@0.5"),))
    )
    currents = np.abs(heavier.records["truth"][:, TRUTH_CURRENTS]).mean(axis=1)
    before, after = (currents[np.abs(heavier.times - at) < 0.05].mean() for at in (0.4, 0.9))
    # The legs carry 13 kg and their own weight, and then 5 kg more.
    assert 1.25 < after / before < 5.0 / 13.0 + 1.05


# -------------------------------------------------------------------------------- values that do not fit


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            'unit = "mm"\n\n[quat',
            'unit = "m"\n\n[quat',
            "begins with position .* m, .*: they would fit as mm, in [position] of",
        ),
        ("offset = 0.3", "offset = 0.8", "begins with leg_length .* m, .*: check their unit, sign and offset, in [leg_length]"),
        ('unit = "g"', 'unit = "m/s2"', "begins with the accelerometer of IMU 0 at rest 1 m/s2, .*: they would fit as g, in"),
        ('"g"\nsign = -1', '"g"\nsign = 1', "the accelerometer of IMU 0 reads -.* m/s2 along its z axis at rest, where 'hex"),
    ],
)
def test_a_start_that_does_not_fit_the_mechanism_is_refused(foreign_fmu, tmp_path, old, new, said):
    assert old in BINDING + TRUTH
    (tmp_path / "wrong.toml").write_text((BINDING + TRUTH).replace(old, new))
    with pytest.raises(InputError, match=said.replace("[", r"\[").replace("]", r"\]")) as caught:
        simulate(SimulationConfig(plant=str(foreign_fmu), binding=str(tmp_path / "wrong.toml"), imu="ideal"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("fault", "said"), [(95, "inf for pose.y"), (96, "nan for top.acc.z")])
def test_a_value_that_is_not_finite_ends_the_run_and_names_its_variable(foreign_fmu, binding, tmp_path, fault, said):
    figures = tmp_path / "figures.json"
    faults = ("--set", f"fault.status={fault}", "--set", "fault.at=0.5")
    plant = ("--plant", foreign_fmu, "--binding", binding)
    run = gough("simulate", *plant, *faults, "--duration", 1, "--imu", "ideal", "--json", figures)
    assert run.returncode == 1
    assert f"foreign.fmu gives {said}, which is not finite: mend its model" in run.stderr
    assert not {"inf", "nan"} & set(re.findall(r"\w+", run.stdout))
    assert not {"Infinity", "NaN"} & set(re.findall(r"\w+", figures.read_text()))


def test_the_loop_looks_for_ctrl_c_often_on_a_slow_fmu_too(foreign_fmu, binding):
    slow = (Setting.parse("fault.status=94"), Setting.parse("fault.at=0.001"))
    binding.write_text(binding.read_text().replace("step = 0.0005", ""))
    config = SimulationConfig(
        plant=str(foreign_fmu), binding=str(binding), settings=slow, duration=0.1, rate=200.0, target="hold"
    )
    shares = []
    simulate(config, shares.append)
    # 60 cycles of 10 ms at least: 10 of them in 0.1 s, and as many as 250 before.
    assert len(shares) >= 6 and shares[-1] == 1.0 and shares == sorted(shares)


def started(*arguments, cwd):
    """The command in a process of its own."""
    environment = os.environ | {"PYTHONPATH": str(Path.cwd())}
    command = [sys.executable, "-m", "hil.command_line", *map(str, arguments)]
    return subprocess.Popen(command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "said"), [(97, "ended the process with status 7"), (99, "crashed with signal 11")]
)  # fmt: skip
def test_an_fmu_that_ends_the_process_is_told_of(foreign_fmu, binding, tmp_path, fault, said):
    plant = ("--plant", foreign_fmu, "--binding", binding, "--set", f"fault.status={fault}", "--set", "fault.at=0.01")
    run = started("simulate", *plant, "--duration", 0.2, cwd=tmp_path)
    _, errors = run.communicate()
    assert run.returncode == 1
    assert f"gough: the FMU {foreign_fmu} has {said}, and nothing is left of the run: try it with 'gough fmu valid" in errors


@pytest.mark.slow
def test_a_step_that_never_returns_ends_after_a_signal(foreign_fmu, binding, tmp_path):
    plant = ("--plant", foreign_fmu, "--binding", binding, "--set", "fault.status=98", "--set", "fault.at=0.01")
    run = started("simulate", *plant, "--duration", 0.2, cwd=tmp_path)
    while "hanging" not in run.stderr.readline():
        assert run.poll() is None
    run.send_signal(signal.SIGINT)
    _, errors = run.communicate()
    assert run.returncode == 130
    assert f"gough: the FMU {foreign_fmu} did not return from a call within 5 s, and its process was ended" in errors


# -------------------------------------------------------------------------------- gough's names, other parameters


def renamed(path, fmu, *names):
    """A copy of gough's own FMU in which some parameters have other names."""
    return edited(fmu, path, *((f'name="{name}"', f'name="my.{name}"') for name in names))


@pytest.mark.slow
def test_an_fmu_with_the_signals_alone_keeps_its_parameters_and_one_with_some_of_them_is_refused(fmu_path, hexapod, tmp_path):
    some, none = tmp_path / "some.fmu", tmp_path / "none.fmu"
    renamed(some, fmu_path, "brake.force", "gravity")
    renamed(none, fmu_path, *hexapod.plant_parameters())
    (tmp_path / "empty.toml").write_text("[fmu]\nstep = 0.001\n")
    assert "runs in the loop with a binding" in gough("fmu", "info", some).stdout
    shown = gough("fmu", "info", none).stdout
    assert "runs in the loop as it is (gough simulate --plant), with its own parameters, from the home of --mech" in shown
    said = "some.fmu has 38 of the 40 parameters of gough's own plants and lacks brake.force, gravity: add them, or bind its"
    for bound in ((), ("--binding", tmp_path / "empty.toml")):
        for command in (("simulate", "--plant", some), ("fmu", "linearize", some)):
            run = gough(*command, *bound)
            assert run.returncode == 2 and re.sub(r"\d+ of the \d+", "38 of the 40", run.stderr).startswith(f"gough: {said}")
        run = gough("simulate", "--plant", none, *bound, "--duration", 0.3, "--target", "hold")
        assert run.returncode == 0, run.stderr
        assert gough("fmu", "linearize", none, *bound).returncode == 0
    run = gough("simulate", "--plant", none, "--joint-error", 1)
    assert run.returncode == 2 and "none.fmu is an FMU with joints of its own, which have no joint error" in run.stderr
