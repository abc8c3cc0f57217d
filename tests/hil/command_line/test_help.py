"""The help of every command: quick, and true."""

import argparse
import re
import subprocess
import sys
from dataclasses import is_dataclass
from importlib.metadata import version

import pytest

from hil.command_line import COMMANDS, main, parse
from hil.command_line.cli import config_of, options_of
from hil.realtime.scheduling import RealTimeSettings
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.studies.config import ComparisonConfig, EvaluationConfig, TuningConfig

ACTIONS = {"calibrate": ("rig", "imu", "magnetometer"), "fmu": ("build", "table", "info", "validate", "linearize")}
NAMES = [name for helps in COMMANDS.values() for name in helps]
LINES = [[name, *action] for name in NAMES for action in ([], *([each] for each in ACTIONS.get(name, ())))]
HEAVY = ("numpy", "numba", "scipy", "casadi", "control", "fmpy", "rich")


def helped(capsys, *arguments):
    with pytest.raises(SystemExit) as ended:
        parse([*arguments, "--help"])
    assert ended.value.code == 0
    return capsys.readouterr().out


def test_the_help_fits_a_screen_and_has_every_command_under_a_heading(capsys):
    lines = helped(capsys).splitlines()
    assert len(lines) <= 56 and max(map(len, lines)) <= 100
    headings = [line[:-1] for line in lines if re.fullmatch(r"[a-z]+:", line)]
    assert headings == ["options", *COMMANDS]
    for name in NAMES:
        assert sum(line.startswith(f"  {name} ") for line in lines) == 1
    assert len(NAMES) > 20


def test_no_help_loads_a_heavy_library():
    code = (
        "import sys\nfrom hil.command_line import parse\n"
        f"for line in {[[], *LINES]}:\n"
        "    try:\n        parse([*line, '--help'])\n    except SystemExit:\n        pass\n"
        f"print([name for name in {HEAVY} if name in sys.modules], file=sys.stderr)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stderr.strip() == "[]"
    assert run.stdout.count("usage: gough") == 1 + len(LINES)


@pytest.mark.parametrize("line", ["--version", "--version simulate"])
def test_the_version_is_that_of_the_package(line, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(line.split())
    assert ended.value.code == 0
    assert capsys.readouterr().out == f"gough {version('gough')}\n"


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_every_help_gives_one_default_and_every_option_a_help(line, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    text = re.sub(r"\n {20,}", "  ", helped(capsys, *line))
    for option in re.findall(r"^  (-\S.*)$", text, re.MULTILINE):
        assert re.search(r"\S  +\S", option), f"{option} has no help"
        assert option.count("(default: ") <= 1
        assert not re.search(r"default: (None|False|True|\[|\()", option)


@pytest.mark.parametrize(
    "config", [SimulationConfig, EmulatorConfig, RealTimeSettings, ComparisonConfig, EvaluationConfig, TuningConfig]
)
def test_options_without_arguments_are_the_configuration_s_defaults(config):
    assert is_dataclass(config)
    command = argparse.ArgumentParser()
    options_of(config)(command)
    assert config_of(command.parse_args([]), config) == config()


def test_options_are_read_in_their_units_and_forms():
    line = "run --rig udp --no-arm --duration 2 --imus 6,0,2 --joint-error 0.1 --magnetometer --cpu 0 --strict --plant p.fmu"
    options = parse(line.split())
    config = config_of(options, SimulationConfig)
    assert config == SimulationConfig(
        rig="udp", arm=False, duration=2.0, imus=(0, 2, 6), joint_error=1e-4, magnetometer=True, plant="p.fmu"
    )
    assert config_of(options, RealTimeSettings) == RealTimeSettings(cpu=0, strict=True)
    settings = parse(["simulate", "--set", "payload.mass=12@3.5", "--set", "gravity=0,0,-9.8"]).settings
    assert [each.text for each in settings] == ["payload.mass=12@3.5", "gravity=0,0,-9.8"]
    options = parse(["emulate", "--fault", "dead:1", "--fault", "noise,at=2", "--watchdog", "40"])
    config = config_of(options, EmulatorConfig)
    assert config.faults == ("dead:1", "noise,at=2") and config.watchdog == 0.04
    assert config_of(options, RealTimeSettings) == RealTimeSettings(priority=79, cpu=0)


def test_faults_of_drives_and_bus_go_to_the_emulator_alone(monkeypatch):
    told = []
    monkeypatch.setattr("hil.runs.emulator_process.emulate", lambda config, *_: told.append(config))
    assert main(["emulate", "--fault", "drive-faults:2,at=5", "--fault", "bus-drops", "--rate", "200"]) == 0
    (config,) = told
    assert config.faults == ("drive-faults:2,at=5", "bus-drops") and config.simulated == SimulationConfig(rate=200.0)


@pytest.mark.parametrize("place", ["-10,0,5", "-.5,0,5", "-1e-3,0,5,0,0,-3"])
def test_numbers_that_begin_with_a_minus_belong_to_the_option_before_them(place):
    numbers = tuple(map(float, place.split(",")))
    assert parse(["move", "--to", place, "--speed", "20"]).to == parse(["move", f"--to={place}"]).to == numbers
    assert parse(["move", "--speed", "-20", "--to", place]).speed == -20.0


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("move --to 0,0,nan", "'0,0,nan' is no place: give X,Y,Z or X,Y,Z,RX,RY,RZ, all of them finite numbers"),
        ("move --to 0,0", "'0,0' is no place: give X,Y,Z"),
        ("move --to -- -1,0,5", "argument --to: expected one argument"),
        ("simulate --set mass", "argument --set: 'mass' is no setting such as payload.mass=12"),
        ("simulate --imus some", "argument --imus: 'some' is neither all, legs, nor a list of numbers such as 0,2,4,6"),
        ("simulate --joint-error much", "argument --joint-error: invalid float value: 'much'"),
        ("compare-fusion --seeds 0,a", "argument --seeds: '0,a' is no list of numbers such as 0,1,2"),
        ("run --cpu one", "argument --cpu: invalid int value: 'one'"),
        ("emulate --bus can", "argument --bus: invalid choice: 'can'"),
        ("simulat", "gough: argument COMMAND: invalid choice: 'simulat'; did you mean 'simulate'? (see gough --help)"),
        ("check_rig", "'check_rig'; did you mean 'check-rig'?"),
        ("octopus", "gough: argument COMMAND: invalid choice: 'octopus' (see gough --help)"),
        (
            "simulate --sed 1",
            "gough simulate: unrecognized arguments: --sed 1; did you mean '--seed'? (see gough simulate --help)",
        ),
        ("fmu info a.fmu --jsn b", "gough fmu info: unrecognized arguments: --jsn b; did you mean '--json'?"),
        ("simulate --colour red", "gough simulate: unrecognized arguments: --colour red (see"),
        ("", "the following arguments are required: COMMAND"),
    ],
)
def test_what_cannot_be_read_is_one_line(line, said, capsys):
    with pytest.raises(SystemExit) as ended:
        parse(line.split())
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and "--help)" in error
