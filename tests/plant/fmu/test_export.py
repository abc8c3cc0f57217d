"""The FMU as a file: built once, always the same, valid, described by the table, and able to save its state."""

import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from plant.dynamics.variables import BRAKE, DRIVE_MODES, SPATIAL, VELOCITY
from plant.errors import FmuError, ToolchainError
from plant.fmu import build as export
from plant.fmu.build import build_in_subprocess, default_fmu
from plant.fmu.description import QUANTITIES, Layout
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism
from plant.pose import Array

MakePlant = Callable[..., FmuPlant]
EXPOSED = Layout(SPATIAL).exposed


@pytest.fixture(scope="module")
def description(fmu_path: Path) -> Any:
    return fmpy.read_model_description(str(fmu_path), validate=True)


# ---- building ----


def test_the_default_fmu_is_built_once(fmu_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build_again(path: Path, *_: Any) -> None:
        raise AssertionError(f"{path} exists already")

    monkeypatch.setattr(export, "_start_build", build_again)
    before = fmu_path.stat()
    assert default_fmu() == fmu_path
    assert (fmu_path.stat().st_ino, fmu_path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.mark.slow
def test_a_build_is_the_same_to_the_byte_and_loads_no_casadi(fmu_path: Path, tmp_path: Path) -> None:
    """A fresh process with an empty cache builds the FMU again, in a process of its own."""
    code = "import sys, plant.fmu.build; path = plant.fmu.build.default_fmu(); print(path); print('casadi' in sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"GOUGH_CACHE": str(tmp_path / "cache")},
        check=True,
        capture_output=True,
        text=True,
    )
    path, casadi = run.stdout.splitlines()
    assert casadi == "False"
    assert Path(path).is_relative_to(tmp_path / "cache" / "fmus") and Path(path).parent.name == fmu_path.parent.name
    assert Path(path).read_bytes() == fmu_path.read_bytes()


def test_the_cache_key_follows_the_sources(monkeypatch: pytest.MonkeyPatch, fmu_path: Path, tmp_path: Path) -> None:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    monkeypatch.setattr(export, "version", lambda package: "0.0.0")

    def write(path: Path, *_: Any) -> None:
        path.write_text("built")

    monkeypatch.setattr(export, "_start_build", write)
    path = default_fmu()
    assert path.read_text() == "built"
    assert path.parent.name != fmu_path.parent.name


def refused_build(path: Path) -> str:
    with pytest.raises(ToolchainError) as caught:
        build_in_subprocess(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_missing_compiler_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    message = refused_build(tmp_path / "plant.fmu")
    assert "no C compiler (cc, gcc or clang) was found: install one" in message
    assert list(tmp_path.iterdir()) == []


def test_a_failing_compiler_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\necho 'In file included' >&2\necho 'plant.c:1: error: disk full' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert f"{compiler} could not compile the plant: plant.c:1: error: disk full" in refused_build(tmp_path / "plant.fmu")
    assert list(tmp_path.iterdir()) == [compiler]


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    target = tmp_path / "no" / "such" / "folder" / "plant.fmu"
    assert f"cannot write {target}: {target.parent} is no folder" in refused_build(target)


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "plant.fmu").mkdir()
    assert "cannot write" in refused_build(tmp_path / "plant.fmu")
    assert [entry.name for entry in tmp_path.iterdir()] == ["plant.fmu"]


# ---- the description ----


def test_fmpy_finds_no_problem(fmu_path: Path) -> None:
    assert validate_fmu(str(fmu_path)) == []


def test_the_archive_holds_description_sources_and_one_binary(fmu_path: Path) -> None:
    with zipfile.ZipFile(fmu_path) as archive:
        names = archive.namelist()
    assert names[0] == "modelDescription.xml"
    assert {name for name in names if name.startswith("binaries/")} == {
        f"binaries/{fmpy.platform_tuple}/gough_plant{fmpy.sharedLibraryExtension}"
    }
    assert {"sources/buildDescription.xml", "sources/model.c", "sources/fmi3.c", "sources/plant.c"} <= set(names)


def test_the_description_has_every_variable_of_the_table(description: Any) -> None:
    described = {variable.name: variable for variable in description.modelVariables}
    assert list(described) == ["time", *(variable.name for variable in EXPOSED)]
    for variable in EXPOSED:
        actual = described[variable.name]
        assert actual.description == variable.description
        assert actual.causality == ("local" if variable.causality == "state" else variable.causality)
        assert tuple(int(dimension.start) for dimension in actual.dimensions) == variable.shape
        assert actual.type == ("Enumeration" if variable.discrete else "Float64")
        assert actual.unit == (None if variable.discrete else variable.unit)
        assert (float(actual.min), float(actual.max)) == (variable.minimum, variable.maximum)
        assert actual.nominal is None if variable.discrete else float(actual.nominal) == variable.nominal
        assert (actual.quantity or actual.declaredType.name) == (
            "DriveMode" if variable.discrete else QUANTITIES[variable.unit][0]
        )
        if variable.causality == "parameter":
            assert actual.variability == ("tunable" if variable.tunable else "fixed")


def test_start_values_are_the_reference_mechanism_on_its_brakes(description: Any, hexapod: Mechanism) -> None:
    described = {variable.name: variable for variable in description.modelVariables}
    for name, value in hexapod.plant_parameters().items():
        np.testing.assert_array_equal([float(text) for text in described[name].start.split()], np.ravel(value), err_msg=name)
    assert described["drive_mode"].start.split() == [str(BRAKE)] * 6
    items = described["drive_mode"].declaredType.items
    assert {int(item.value): item.name for item in items} == DRIVE_MODES


DERIVED: dict[str, dict[str, int]] = {
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "Ohm": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "H": {"kg": 1, "m": 2, "s": -2, "A": -2},
    "uT": {"kg": 1, "s": -2, "A": -1},
    "1": {},
}


def exponents(unit: str) -> dict[str, int]:
    """Exponents of the SI base units in a name such as N.m/A."""
    total: dict[str, int] = {}
    above, _, below = unit.partition("/")
    for part, sign in ((above, 1), (below, -1)):
        for factor in filter(None, part.split(".")):
            name, power = re.fullmatch(r"([A-Za-z]+|1)(\d?)", factor).groups()  # type: ignore[union-attr]
            for base, exponent in DERIVED.get(name, {name: 1}).items():
                total[base] = total.get(base, 0) + sign * exponent * int(power or 1)
    return {base: exponent for base, exponent in total.items() if exponent}


def test_units_are_defined_by_si_base_units(description: Any) -> None:
    assert {unit.name for unit in description.unitDefinitions} == {v.unit for v in EXPOSED} | {"s"}
    for unit in description.unitDefinitions:
        base = unit.baseUnit
        defined = {name: getattr(base, name) for name in ("kg", "m", "s", "A", "K", "mol", "cd", "rad")}
        assert {name: value for name, value in defined.items() if value} == exponents(unit.name), unit.name
        assert base.factor == (1e-6 if unit.name == "uT" else 1.0)


def test_outputs_depend_on_the_listed_inputs_and_on_no_others(description: Any, make_plant: MakePlant) -> None:
    """Every input is changed at a lively moment; the outputs that change at once are those the description lists."""
    plant = make_plant()
    plant.set("drive_mode", np.full(6, VELOCITY))
    for cycle in range(50):
        plant.set("velocity_command", 0.1 * np.sin(0.2 * cycle + np.arange(6)))
        plant.step(1e-3)
    plant.set("drive_mode", [VELOCITY, BRAKE, BRAKE, VELOCITY, VELOCITY, VELOCITY])
    plant.step(1e-3)

    def outputs() -> dict[str, Array]:
        return {variable.name: plant.get(variable.name) for variable in SPATIAL.outputs}

    before = outputs()
    seen: dict[str, set[str]] = {variable.name: set() for variable in SPATIAL.outputs}
    others: dict[str, Any] = {
        "velocity_command": [[0.05 * i for i in range(6)]],
        "drive_mode": [[mode] * 6 for mode in DRIVE_MODES],
        "external_wrench.force": [[1.0, 2.0, 3.0]],
        "external_wrench.torque": [[4.0, 5.0, 6.0]],
    }
    held: dict[str, Any] = {
        "velocity_command": plant.get("velocity_command"),
        "drive_mode": [VELOCITY, BRAKE, BRAKE, VELOCITY, VELOCITY, VELOCITY],
        "external_wrench.force": np.zeros(3),
        "external_wrench.torque": np.zeros(3),
    }
    for changed, values in others.items():
        for value in values:
            plant.set(changed, value)
            for name, now in outputs().items():
                if (now != before[name]).any():
                    seen[name].add(changed)
        plant.set(changed, held[changed])
    listed = {
        unknown.variable.name: {known.name for known in unknown.dependencies if known.causality == "input"}
        for unknown in description.outputs
    }
    assert listed == seen


def test_a_foreign_importer_simulates_the_fmu(fmu_path: Path, make_plant: MakePlant) -> None:
    result = fmpy.simulate_fmu(
        str(fmu_path), stop_time=0.05, step_size=1e-3, output_interval=1e-3, output=["kinetic_energy", "potential_energy"]
    )
    plant = make_plant()
    for row in result:
        for name in ("kinetic_energy", "potential_energy"):
            assert row[name] == pytest.approx(float(plant.get(name)), rel=1e-9)
        plant.step(1e-3)
    assert len(result) == 51 and np.ptp(result["kinetic_energy"]) > 0.0


# ---- saving and restoring ----


def move(plant: FmuPlant, cycles: range) -> Array:
    """Drive on; the truth and IMU signals after every cycle, as the bits they are."""
    seen = []
    for cycle in cycles:
        plant.set("drive_mode", np.full(6, BRAKE if cycle % 50 > 40 else VELOCITY))
        plant.set("velocity_command", 0.1 * np.sin(0.1 * cycle + np.arange(6)))
        plant.step(1e-3)
        seen.append(
            np.hstack([plant.get(name).ravel() for name in ("position", "quaternion", "current", "imu_specific_force")])
        )
    return np.array(seen).view(np.uint64)


def test_a_restored_state_goes_on_bit_for_bit(make_plant: MakePlant) -> None:
    plant = make_plant({"payload.mass": 4.0})
    move(plant, range(45))
    saved, time = plant.state(), float(plant.handle["time"])
    first = move(plant, range(45, 145))
    plant.set("payload.mass", 8.0)
    move(plant, range(145, 150))
    plant.restore(saved)
    assert plant.get("time") == plant.handle["time"] == time
    assert plant.get("payload.mass") == 4.0
    np.testing.assert_array_equal(move(plant, range(45, 145)), first)


def test_a_state_goes_on_in_another_instance(make_plant: MakePlant) -> None:
    plant = make_plant({"payload.mass": 4.0, "brake.force": 1200.0})
    move(plant, range(45))
    saved = plant.state()
    first = move(plant, range(45, 145))
    other = make_plant()
    other.restore(saved)
    assert other.get("brake.force") == 1200.0
    np.testing.assert_array_equal(move(other, range(45, 145)), first)


def test_a_state_of_another_build_is_refused(make_plant: MakePlant) -> None:
    plant = make_plant()
    saved = plant._instance.state()
    clock = plant.state().removesuffix(saved)
    for broken, message in (
        (bytes([saved[0] ^ 1]) + saved[1:], "from another build of this FMU"),
        (saved[:-1], "wrong size"),
    ):
        with pytest.raises(FmuError, match=f"gough_plant.fmu: restoring a state failed: .*{message}"):
            plant.restore(clock + broken)
