"""What docs/fmu.md shows must run, and its tables must be those of the source."""

import re
import shlex
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from hil.command_line import main, parse
from plant.dynamics.variables import VELOCITY
from plant.fmu.build import SPATIAL_MODEL, default_fmu
from plant.mechanism import load_mechanism
from plant.pose import Array

PAGE = (Path(__file__).parent.parent / "docs" / "fmu.md").read_text()
EXAMPLES = {
    heading: re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    for heading, text in re.findall(r"^##+ (.+)\n((?:(?!##).*\n)*)", PAGE, re.MULTILINE)
}
COMMANDS = re.findall(r"^gough .*?(?= {2,}#|$)", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def folder(fmu_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the FMUs that `gough fmu build` writes."""
    made = tmp_path_factory.mktemp("examples")
    shutil.copy(fmu_path, made / "gough_plant.fmu")
    shutil.copy(default_fmu(SPATIAL_MODEL, fmi=2), made / "gough_plant_fmi2.fmu")
    return made


def run(heading: str, number: int = 0) -> dict[str, Any]:
    """The names that an example defines."""
    names: dict[str, Any] = {}
    exec(compile(EXAMPLES[heading][number], f"docs/fmu.md, {heading}", "exec"), names)
    return names


def grown_legs(interface: str = "CoSimulation") -> Array:
    """Lengths after 0.5 s at 20 mm/s with a payload of 12 kg, by FMPy."""
    result = fmpy.simulate_fmu(
        "gough_plant.fmu", fmi_type=interface, stop_time=0.5, output_interval=1e-3, relative_tolerance=1e-8,
        output=["leg_length"],
        start_values={"drive_mode": [VELOCITY] * 6, "velocity_command": [0.02] * 6, "payload.mass": 12.0},
    )  # fmt: skip
    lengths: Array = result["leg_length"][-1]
    return lengths


def test_every_example_is_tried() -> None:
    assert {heading: len(codes) for heading, codes in EXAMPLES.items() if codes} == {
        "FMPy": 2, "libcosim": 1, "Ecos": 1, "Linearise": 1,
    }  # fmt: skip
    assert len(re.findall("```python", PAGE)) == 5


@pytest.mark.slow
def test_fmpy_simulates_both_interfaces(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    names = run("FMPy")
    stepped, integrated = names["stepped"]["leg_length"], names["integrated"]["leg_length"]
    assert np.ptp(stepped, axis=0).min() > 0.015
    assert 0.0 < np.abs(stepped - integrated).max() < 6e-6
    np.testing.assert_allclose(grown_legs("ModelExchange"), grown_legs(), rtol=0.0, atol=2e-9)


def test_fmpy_gets_a_derivative(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive's voltage rises by force constant times command: `di/dt = n k / L du`, n = 2 pi / lead."""
    monkeypatch.chdir(folder)
    p = load_mechanism("hexapod").plant_parameters()
    slope = 2.0 * np.pi / p["motor.screw_lead"] * p["motor.torque_constant"] / p["motor.inductance"]
    np.testing.assert_allclose(run("FMPy", 1)["columns"], slope * np.eye(6), rtol=1e-12)


def test_libcosim_moves_the_legs_as_fmpy_does(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("libcosimpy")
    monkeypatch.chdir(folder)
    np.testing.assert_allclose(run("libcosim")["lengths"], grown_legs(), rtol=0.0, atol=1e-12)


@pytest.mark.skipif(find_spec("ecospy") is None, reason="Ecos is not installed")
def test_ecos_moves_the_legs_as_fmpy_does(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    np.testing.assert_allclose(run("Ecos")["lengths"], grown_legs(), rtol=0.0, atol=1e-12)


def test_the_linear_plant_is_one_of_python_control(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    gain = abs(run("Linearise")["leg"](20j * np.pi)) * 20.0 * np.pi
    assert f"# {gain:.2f} m/s per m/s" in EXAMPLES["Linearise"][0]


@pytest.mark.slow
def test_the_commands_exist(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Those that take no time are run, too."""
    monkeypatch.chdir(folder)
    assert len(COMMANDS) > 12
    for command in COMMANDS:
        arguments = shlex.split(command)[1:]
        parse(arguments)
        if arguments[1] in ("info", "validate", "table"):
            assert main(arguments) == 0, capsys.readouterr().err


def test_the_tables_are_those_of_the_source(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmu", "table"]) == 0
    (tables,) = re.findall(r"<!-- gough fmu table -->\n\n(.*)\n<!-- end -->", PAGE, re.DOTALL)
    assert tables == capsys.readouterr().out
