"""The commands of `gough fmu`, as a user gives them."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hil.command_line import main


@pytest.mark.slow
def test_a_planar_fmu_is_built_told_tried_and_linearised(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["fmu", "build", "--fmi", "2", "--mechanism", "planar-3rpr"]) == 0
    path = Path(capsys.readouterr().out.strip())
    assert path == Path("gough_planar_plant_fmi2.fmu") and path.is_file()

    assert main(["fmu", "info", str(path), "--json", "info.json"]) == 0
    said, figures = capsys.readouterr().out, json.loads(Path("info.json").read_text())
    assert "runs in the loop as it is" in said and "leg_length[3]" in said
    assert figures["FMI"] == "2.0" and figures["states"] == 30
    assert {"name": "leg_length[3]", "shape": [], "type": "Real", "unit": "m"}.items() <= figures["variables"][
        [v["name"] for v in figures["variables"]].index("leg_length[3]")
    ].items()

    assert main(["fmu", "validate", str(path), "--json", "checks.json"]) == 0
    assert capsys.readouterr().out.count("  ok\n") == 4
    checks = json.loads(Path("checks.json").read_text())["checks"]
    assert len(checks) == 4 and not any(checks.values())

    assert main(["fmu", "linearize", str(path), "--mechanism", "planar-3rpr", "--json", "linear.json"]) == 0
    assert "12 states, 3 inputs, 3 outputs" in capsys.readouterr().out
    linear = json.loads(Path("linear.json").read_text())
    poles = np.sort_complex(np.linalg.eigvals(linear["A"]))
    np.testing.assert_allclose(np.sort_complex([real + 1j * imag for real, imag in linear["poles"]]), poles, rtol=1e-9)
    assert np.shape(linear["B"]) == (12, 3) and linear["outputs"] == [f"leg_length[{k}]" for k in (1, 2, 3)]


def test_an_fmu_that_needs_a_binding_is_told_so(foreign_fmu: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmu", "info", str(foreign_fmu)]) == 0
    assert "runs in the loop with a binding" in capsys.readouterr().out


@pytest.mark.slow
def test_a_broken_promise_is_told_by_the_exit_status(
    foreign_fmu: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "poor.fmu"
    with zipfile.ZipFile(foreign_fmu) as archive, zipfile.ZipFile(path, "w") as poor:
        for name in archive.namelist():
            if not name.startswith("binaries/"):
                poor.writestr(name, archive.read(name))
    assert main(["fmu", "validate", str(path)]) == 1
    assert "poor.fmu holds no binary for" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["build", "--platforms", "linux,amiga"], "no platform 'amiga'; there are linux, windows, darwin"),
        (["build", "--mechanism", "no-such"], "no mechanism 'no-such'"),
        (["build", "--output", "no/such/folder.fmu"], "cannot write"),
        (["info", "missing.fmu"], "there is no FMU at missing.fmu"),
        (["validate", "missing.fmu"], "there is no FMU at missing.fmu"),
        (["validate", "missing.fmu", "--json", "no/such/checks.json"], "cannot write no/such/checks.json"),
        (["linearize", "--outputs", "leg_lengths"], "has no variable 'leg_lengths'; did you mean leg_length?"),
    ],
)
def test_what_cannot_be_done_is_one_clear_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fmu", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error and error.count("\n") == 1 and error.startswith("gough: ")
