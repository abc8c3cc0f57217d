"""Running an FMU: what is refused and why, what is left behind, and that compiled calls do what FMPy's methods do."""

import ctypes
import os
import re
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest

from plant.dynamics.variables import BRAKE, OPEN, SPATIAL, VELOCITY
from plant.errors import FmuError, InputError, UnknownNameError
from plant.fmu.binding import OWN_BINDING
from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL, Model, default_fmu
from plant.fmu.calls import (
    advance,
    read_imus,
    read_truth,
    write_command,
    write_drive_mode,
    write_drive_modes,
    write_payload_mass,
)
from plant.fmu.instance import FmuInstance
from plant.fmu.plant import FmuPlant
from plant.fmu.settings import Setting
from plant.mechanism import Mechanism
from plant.pose import Array

MakePlant = Callable[..., FmuPlant]
BINARY = f"binaries/{fmpy.platform_tuple}/gough_plant{fmpy.sharedLibraryExtension}"


def copy_of(fmu: Path, target: Path, description: dict[str, str] | None = None, members: dict[str, Any] | None = None) -> Path:
    """A copy of an FMU with some text of its description and some members replaced (None: left out)."""
    with zipfile.ZipFile(fmu) as archive:
        contents: dict[str, Any] = {name: archive.read(name) for name in archive.namelist()}
    text = contents["modelDescription.xml"].decode()
    for pattern, replacement in (description or {}).items():
        text, count = re.subn(pattern, replacement, text, flags=re.DOTALL)
        assert count, f"{pattern} is not in the description"
    contents |= {"modelDescription.xml": text} | (members or {})
    with zipfile.ZipFile(target, "w") as archive:
        for name, data in contents.items():
            if data is not None:
                archive.writestr(name, data)
    return target


def refused(path: Path, hexapod: Mechanism, period: float = 1e-3, parameters: dict[str, Any] | None = None) -> str:
    """The message with which an FMU is refused; it names the file."""
    with pytest.raises(FmuError) as caught:
        FmuPlant(path, parameters or hexapod.plant_parameters(), period)
    assert path.name in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


# ---- files that are refused ----


def test_a_missing_file_is_named(hexapod: Mechanism, tmp_path: Path) -> None:
    assert "there is no FMU at" in refused(tmp_path / "missing.fmu", hexapod)


@pytest.mark.parametrize("content", [b"", b"no archive at all", b"PK\x03\x04 torn off"])
def test_a_file_that_is_no_archive_is_refused(hexapod: Mechanism, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.fmu"
    path.write_bytes(content)
    assert "is not a usable FMU" in refused(path, hexapod)


def test_a_folder_is_refused(hexapod: Mechanism, tmp_path: Path) -> None:
    (tmp_path / "folder.fmu").mkdir()
    assert "folder.fmu is a folder: name the FMU's file" in refused(tmp_path / "folder.fmu", hexapod)


def test_an_archive_cut_short_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    path = tmp_path / "short.fmu"
    path.write_bytes(fmu_path.read_bytes()[:-100])
    assert "is not a usable FMU" in refused(path, hexapod)


def test_a_damaged_member_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    """The directory of the archive is whole, but the binary in it has a wrong checksum."""
    data = bytearray(fmu_path.read_bytes())
    with zipfile.ZipFile(fmu_path) as archive:
        data[archive.getinfo(BINARY).header_offset + 1000] ^= 0xFF
    path = tmp_path / "damaged.fmu"
    path.write_bytes(data)
    refused(path, hexapod)


def test_an_archive_without_a_description_is_refused(hexapod: Mechanism, tmp_path: Path) -> None:
    path = tmp_path / "empty.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "nothing here")
    assert "is not a usable FMU" in refused(path, hexapod)


def test_a_description_off_the_schema_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    path = copy_of(fmu_path, tmp_path / "odd.fmu", {'causality="output"': 'causality="outcome"'})
    assert "is not a usable FMU" in refused(path, hexapod)


FMI1 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="one" modelIdentifier="one" guid="{1}" numberOfContinuousStates="0"
 numberOfEventIndicators="0"><ModelVariables/></fmiModelDescription>
"""


def test_an_fmu_of_fmi_1_is_refused(hexapod: Mechanism, tmp_path: Path) -> None:
    path = tmp_path / "one.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", FMI1)
    assert "one.fmu is of FMI 1.0, not 2.0 or 3.0: export it for one of these" in refused(path, hexapod)


def test_an_fmu_for_model_exchange_alone_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    changes = {"<CoSimulation[^>]*/>": ""}
    message = refused(copy_of(fmu_path, tmp_path / "exchange.fmu", changes), hexapod)
    assert "exchange.fmu is not for Co-Simulation: export it for that" in message


@pytest.mark.parametrize("name", ["velocity_command", "imu_specific_force", "imu_angular_velocity"])
def test_an_fmu_without_a_needed_variable_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path, name: str) -> None:
    path = copy_of(fmu_path, tmp_path / "lacking.fmu", {f'name="{name}"': f'name="{name}s"'})
    assert f"{name}: has no variable '{name}'; did you mean {name}s?" in refused(path, hexapod)


def test_all_that_is_wrong_with_the_variables_is_said_at_once(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    changes = {
        r'(name="position"[^>]*>)\s*<Dimension start="3" />': r'\1<Dimension start="4"/>',
        r'(name="imu_magnetic_field"[^>]*>)\s*<Dimension start="7" />\s*<Dimension start="3" />': r'\1<Dimension start="20"/>',
        r'(name="velocity_command"[^>]*) causality="input" variability="continuous"': (
            r'\1 causality="parameter" variability="fixed"'
        ),
        'name="imu_specific_force"': 'name="force"',
        r'<Float64 name="current"(.*?)</Float64>': r'<Float32 name="current"\1</Float32>',
    }
    message = refused(copy_of(fmu_path, tmp_path / "wrong.fmu", changes), hexapod)
    assert "position: position has 4 elements and must have 3" in message
    assert "imu_magnetic_field: imu_magnetic_field has 20 elements and must have 21" in message
    assert "velocity_command: velocity_command is of causality fixed parameter and must be input" in message
    assert "imu_specific_force: has no variable 'imu_specific_force'" in message
    assert "current: current is of type Float32 and must be double-precision real" in message


def test_an_fmu_for_another_machine_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    members = {BINARY: None, "binaries/riscv64-linux/gough_plant.so": b"elf"}
    message = refused(copy_of(fmu_path, tmp_path / "foreign.fmu", members=members), hexapod)
    assert f"holds no binary for {fmpy.platform_tuple}: build it for this machine" in message


def test_a_binary_that_does_not_load_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    path = copy_of(fmu_path, tmp_path / "noise.fmu", members={BINARY: b"not a library"})
    before = Path.cwd()
    try:
        assert "cannot be loaded" in refused(path, hexapod)
        assert Path.cwd() == before
    finally:
        os.chdir(before)


def test_a_binary_of_another_build_is_refused(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    path = copy_of(fmu_path, tmp_path / "stale.fmu", {'instantiationToken="[^"]*"': 'instantiationToken="{0}"'})
    assert "cannot be loaded: the instantiationToken is not that of modelDescription.xml" in refused(path, hexapod)


# ---- parameters and inputs that are refused ----


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"platform.mass": np.array(-1.0)}, "parameter platform.mass is -1; it must be 1e-09 to 1e.06"),
        ({"substep": np.array(0.0)}, "parameter substep is 0; it must be 1e-06 to 0.1"),
        ({"gravity": np.array([0.0, 0.0, np.nan])}, "parameter gravity is .*nan; it must be"),
        ({"motor.resistance": np.array([0.6, 0.6, 0.6, np.inf, 0.6, 0.6])}, "parameter motor.resistance is inf"),
        ({"initial_quaternion": np.array([1.0, 0.1, 0.0, 0.0])}, "initial_quaternion is not of unit length"),
        ({"initial_quaternion": np.zeros(4)}, "initial_quaternion is not of unit length"),
    ],
)
def test_a_parameter_is_refused_in_the_words_of_the_fmu(
    hexapod: Mechanism, fmu_path: Path, change: dict[str, Array], message: str
) -> None:
    said = refused(fmu_path, hexapod, parameters=hexapod.plant_parameters() | change)
    assert re.search(f"gough_plant.fmu: initialisation failed: .*{message}", said)


def test_a_parameter_of_another_name_or_size_is_refused(fmu_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"gough_plant.fmu has no variable 'platform.weight'"):
        FmuPlant(fmu_path, {"platform.weight": 1.0}, 1e-3)
    with pytest.raises(InputError, match=r"gravity of gough_plant.fmu has 3 elements, got 2"):
        FmuPlant(fmu_path, {"gravity": [0.0, 1.0]}, 1e-3)


@pytest.mark.parametrize("value", ["fast", [[1.0], [1.0, 2.0]], None])
def test_a_value_that_is_no_number_is_refused(make_plant: MakePlant, value: Any) -> None:
    with pytest.raises(InputError, match="velocity_command"):
        make_plant().set("velocity_command", value)


def test_a_fractional_drive_mode_is_refused(make_plant: MakePlant) -> None:
    with pytest.raises(InputError, match="drive_mode"):
        make_plant().set("drive_mode", np.full(6, 1.5))


@pytest.mark.parametrize("mode", [-1, 3])
def test_a_drive_mode_that_does_not_exist_is_refused(make_plant: MakePlant, mode: int) -> None:
    with pytest.raises(FmuError, match=re.escape(f"drive_mode is {mode}; it must be 0 (open), 1 (brake) or 2 (velocity)")):
        make_plant().set("drive_mode", np.full(6, mode))


@pytest.mark.parametrize("name", ["velocity_command", "external_wrench.force"])
def test_an_input_that_is_not_finite_stops_the_step(make_plant: MakePlant, name: str) -> None:
    plant = make_plant()
    value = np.zeros_like(plant.get(name))
    value[-1] = np.nan
    plant.set(name, value)
    with pytest.raises(FmuError, match="a step failed: an input is not finite"):
        plant.step(1e-3)


def test_a_motion_that_diverges_is_reported(make_plant: MakePlant) -> None:
    plant = make_plant()
    plant.set("external_wrench.force", [1e300, 0.0, 0.0])
    with pytest.raises(FmuError, match="the state is no longer finite: reduce substep, or check the parameters"):
        for _ in range(100):
            plant.step(1e-3)


@pytest.mark.parametrize("duration", [0.0, -1e-3, np.nan, np.inf])
def test_a_step_that_is_not_positive_is_refused(make_plant: MakePlant, duration: float) -> None:
    with pytest.raises(FmuError, match="the communication step must be positive"):
        make_plant().step(duration)


def test_only_tunable_parameters_change_during_a_run(make_plant: MakePlant) -> None:
    plant = make_plant()
    plant.step(1e-3)
    with pytest.raises(FmuError, match=r"platform.mass is fixed once initialisation has ended"):
        plant.set("platform.mass", 4.0)
    assert plant.get("platform.mass") == 3.0
    before = plant.get("potential_energy")
    plant.set("payload.mass", 11.0)
    height = plant.get("position")[2] + 0.10
    assert plant.get("potential_energy") - before == pytest.approx(9.81 * height, rel=1e-6)
    with pytest.raises(FmuError, match=r"payload.mass is -1; it must be 0 to"):
        plant.set("payload.mass", -1.0)


def test_only_parameters_and_inputs_have_start_values(fmu_path: Path) -> None:
    message = "time of gough_plant.fmu is a continuous independent variable, which takes no start value"
    with pytest.raises(InputError, match=message):
        FmuPlant(fmu_path, {}, 1e-3, settings=[Setting.parse("time=1")])
    with pytest.raises(InputError, match=r"drive_mode of gough_plant.fmu is set by the loop"):
        FmuPlant(fmu_path, {}, 1e-3, settings=[Setting.parse("drive_mode=2")])


def test_outputs_cannot_be_set(make_plant: MakePlant) -> None:
    with pytest.raises(FmuError, match=r"position is calculated and cannot be set"):
        make_plant().set("position", np.zeros(3))


def test_unknown_names_are_refused(make_plant: MakePlant) -> None:
    plant = make_plant()
    for use in (plant.get, lambda name: plant.set(name, 0.0)):
        with pytest.raises(UnknownNameError, match=r"gough_plant.fmu has no variable 'height'"):
            use("height")


# ---- fixed steps ----


@pytest.fixture
def fixed_step(fmu_path: Path, tmp_path: Path) -> Path:
    changes = {
        'canHandleVariableCommunicationStepSize="true"': (
            'canHandleVariableCommunicationStepSize="false" fixedInternalStepSize="0.002"'
        )
    }
    return copy_of(fmu_path, tmp_path / "fixed.fmu", changes)


@pytest.mark.parametrize("period", [0.002, 0.004, 0.020])
def test_a_fixed_step_fmu_takes_whole_multiples(hexapod: Mechanism, fixed_step: Path, period: float) -> None:
    with FmuPlant(fixed_step, hexapod.plant_parameters(), period) as plant:
        plant.step(period)
        assert plant.get("time") == period


@pytest.mark.parametrize("period", [0.001, 0.003, 0.0005])
def test_a_fixed_step_fmu_refuses_other_rates(hexapod: Mechanism, fixed_step: Path, period: float) -> None:
    message = f"fixed.fmu cannot take a rate of {1 / period:g} Hz: its step is fixed at 0.002 s, so .* 500 Hz divided by"
    with pytest.raises(InputError, match=message):
        FmuPlant(fixed_step, hexapod.plant_parameters(), period)


@pytest.mark.parametrize("period", [0.0, -0.002, np.nan, np.inf])
def test_a_period_that_is_no_time_is_refused(hexapod: Mechanism, fixed_step: Path, period: float) -> None:
    with pytest.raises(InputError, match=r"fixed\.fmu cannot take"):
        FmuPlant(fixed_step, hexapod.plant_parameters(), period)


def test_without_a_fixed_step_the_default_step_counts(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    changes = {'canHandleVariableCommunicationStepSize="true"': ""}
    path = copy_of(fmu_path, tmp_path / "default.fmu", changes)
    with pytest.raises(InputError, match=r"its step is fixed at 0.001 s"):
        FmuPlant(path, hexapod.plant_parameters(), 0.0015)
    FmuPlant(path, hexapod.plant_parameters(), 0.002).close()


# ---- nothing is left behind ----


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_closing_removes_what_was_extracted(hexapod: Mechanism, fmu_path: Path, temporary: Path) -> None:
    with FmuPlant(fmu_path, hexapod.plant_parameters(), 1e-3) as plant:
        assert len(list(temporary.iterdir())) == 1
        plant.close()
        assert list(temporary.iterdir()) == []
    plant.close()


@pytest.mark.parametrize("change", [{"platform.mass": -1.0}, {"no.such": 1.0}, {"gravity": 1.0}])
def test_a_refused_start_leaves_nothing_behind(fmu_path: Path, temporary: Path, change: dict[str, float]) -> None:
    with pytest.raises((FmuError, UnknownNameError, InputError)):
        FmuPlant(fmu_path, change, 1e-3)
    assert list(temporary.iterdir()) == []


def test_loading_keeps_the_working_directory(hexapod: Mechanism, fmu_path: Path) -> None:
    before = Path.cwd()
    FmuPlant(fmu_path, hexapod.plant_parameters(), 1e-3).close()
    assert Path.cwd() == before


def test_a_closed_plant_refuses_and_does_not_crash(fmu_path: Path) -> None:
    """In a process of its own, for a call into a freed library would end it."""
    code = (
        "import sys; from plant.errors import GoughError; from plant.fmu.plant import FmuPlant\n"
        "plant = FmuPlant(sys.argv[1], {}, 1e-3); plant.close()\n"
        "for use in (lambda: plant.step(1e-3), lambda: plant.get('position'), lambda: plant.set('gravity', [0, 0, 0])):\n"
        "    try: use()\n"
        "    except GoughError as error: print(error)\n"
    )
    run = subprocess.run([sys.executable, "-c", code, str(fmu_path)], capture_output=True, text=True, check=False)
    assert run.returncode == 0
    assert len(run.stdout.splitlines()) == 3


# ---- compiled calls ----


def commands(cycle: int) -> tuple[Array, int]:
    return 0.1 * np.sin(0.05 * cycle + np.arange(6.0)), (BRAKE, VELOCITY, OPEN, VELOCITY)[cycle // 50]


def test_compiled_calls_do_what_fmpys_methods_do(hexapod: Mechanism, fmu_path: Path, tmp_path: Path) -> None:
    """The same motion through the kernels and through FMPy alone, bit for bit."""
    folder = fmpy.extract(str(fmu_path), unzipdir=str(tmp_path))
    description = fmpy.read_model_description(folder)
    references = {variable.name: variable.valueReference for variable in description.modelVariables}
    slow = fmpy.fmi3.FMU3Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="slow",
    )
    slow.instantiate()
    for name, value in hexapod.plant_parameters().items():
        slow.setFloat64([references[name]], np.ravel(value).tolist())
    slow.enterInitializationMode()
    slow.exitInitializationMode()

    imu = ("imu_angular_velocity", "imu_specific_force", "imu_magnetic_field")
    truth = ("position", "quaternion", "leg_length", "current")
    period = 1e-3
    with FmuPlant(fmu_path, hexapod.plant_parameters(), period) as plant:
        for cycle in range(200):
            command, mode = commands(cycle)
            assert write_command(plant.handle, command) == 0
            assert write_drive_mode(plant.handle, mode) == 0
            slow.setFloat64([references["velocity_command"]], command.tolist())
            slow.setInt64([references["drive_mode"]], [mode] * 6)
            assert advance(plant.handle, period) == 0
            slow.doStep(cycle * period, period)
            assert read_imus(plant.handle) == 0
            assert read_truth(plant.handle) == 0
            expected = slow.getFloat64([references[name] for name in imu], nValues=63)
            np.testing.assert_array_equal(plant.handle["imu"].ravel(), expected)
            np.testing.assert_array_equal(plant.handle["truth"], slow.getFloat64([references[n] for n in truth], nValues=19))
            assert plant.handle["time"] == (cycle + 1) * period
            assert plant.get("time") == slow.getFloat64([references["time"]])[0]
        assert np.ptp(plant.get("leg_length")) > 1e-4
        for variable in SPATIAL.outputs:
            one_by_one = slow.getFloat64([references[variable.name]], nValues=variable.size)
            np.testing.assert_array_equal(plant.get(variable.name).ravel(), one_by_one)
    slow.terminate()
    slow.freeInstance()


def test_our_fmi_2_export_does_the_same_without_a_binding(make_plant: MakePlant, hexapod: Mechanism) -> None:
    with FmuPlant(default_fmu(fmi=2), hexapod.plant_parameters(), 1e-3) as scalars:
        arrays = make_plant()
        for cycle in range(200):
            command, mode = commands(cycle)
            for plant in (arrays, scalars):
                write_drive_mode(plant.handle, mode)
                write_command(plant.handle, command)
                assert advance(plant.handle, 1e-3) == 0
                assert read_imus(plant.handle) == read_truth(plant.handle) == 0
            for buffer in ("imu", "truth"):
                assert scalars.handle[buffer].tobytes() == arrays.handle[buffer].tobytes()
        np.testing.assert_array_equal(scalars.get("platform.inertia"), arrays.get("platform.inertia"))
        scalars.set("payload.center_of_mass", [0.0, 0.01, 0.1])
        assert scalars.get("payload.center_of_mass[2]") == 0.01


def test_our_planar_plant_needs_no_binding_either() -> None:
    with FmuPlant(default_fmu(PLANAR_MODEL), {}, 1e-3) as plant:
        assert (plant.bound.legs, plant.bound.imus) == (3, (0, 1, 2, 6))
        for _ in range(100):
            write_drive_mode(plant.handle, VELOCITY)
            write_command(plant.handle, np.array([0.02, -0.01, 0.0]))
            assert advance(plant.handle, 1e-3) == read_imus(plant.handle) == read_truth(plant.handle) == 0
        imus = plant.get("imu_angular_velocity"), plant.get("imu_specific_force"), plant.get("imu_magnetic_field")
        np.testing.assert_array_equal(plant.handle["imu"][:, [0, 1, 2, 6]], imus)
        assert np.isnan(plant.handle["imu"][:, 3:6]).all()
        half = float(plant.get("angle")) / 2.0
        pose = [*plant.get("position"), 0.0, np.cos(half), 0.0, 0.0, np.sin(half)]
        np.testing.assert_allclose(plant.handle["truth"][:7], pose, rtol=1e-15)
        np.testing.assert_array_equal(plant.handle["truth"][7:10], plant.get("leg_length"))
        np.testing.assert_array_equal(plant.handle["truth"][13:16], plant.get("current"))
        assert np.isnan(plant.handle["truth"][[10, 11, 12, 16, 17, 18]]).all()


@pytest.mark.parametrize("kind", ["Boolean", "UInt8", "Int16", "Int32", "UInt64", "Float64", "Float32"])
def test_drive_modes_of_any_type_are_packed_as_fmi_3_has_them(fmu_path: Path, tmp_path: Path, kind: str) -> None:
    replacement = (
        rf'<{kind} name="drive_mode" valueReference="\1" causality="input" start="0 0 0 0 0 0"><Dimension start="6"/></{kind}>'
    )
    pattern = r'<Enumeration name="drive_mode" valueReference="(\d+)".*?</Enumeration>'
    path = copy_of(fmu_path, tmp_path / "modes.fmu", {pattern: replacement})
    seen = []

    def take(instance: int, references: int, count: int, values: int, size: int) -> int:
        dtype = np.dtype({"Boolean": "bool"}.get(kind, kind.lower()))
        seen.extend(np.frombuffer(ctypes.string_at(values, size * dtype.itemsize), dtype).astype(float))
        return 0

    function = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 5)(take)
    with FmuPlant(path, {}, 1e-3) as plant:
        plant.handle["set_mode"] = ctypes.cast(function, ctypes.c_void_p).value
        plant.handle["mode"] = [OPEN, BRAKE, VELOCITY, VELOCITY, BRAKE, OPEN]
        assert write_drive_modes(plant.handle) == 0
    assert seen == ([0, 0, 1, 1, 0, 0] if kind == "Boolean" else [0, 1, 2, 2, 1, 0])


def test_setting_by_name_is_the_compiled_command(make_plant: MakePlant) -> None:
    fast, slow = make_plant(), make_plant()
    command = np.linspace(-0.1, 0.1, 6)
    write_command(fast.handle, command)
    write_drive_mode(fast.handle, VELOCITY)
    slow.set("velocity_command", command)
    slow.set("drive_mode", [VELOCITY] * 6)
    for plant in (fast, slow):
        plant.step(0.02)
    np.testing.assert_array_equal(fast.get("current"), slow.get("current"))
    assert np.abs(fast.get("current")).max() > 0.1


def test_compiled_calls_report_a_failure_by_status(make_plant: MakePlant) -> None:
    plant = make_plant()
    assert write_command(plant.handle, np.full(6, np.inf)) == 0
    assert advance(plant.handle, 1e-3) == 3
    assert str(plant.failure()) == "gough_plant.fmu: a step failed: an input is not finite"
    plant.handle["sensed"]["references"] = 10_000
    assert read_imus(plant.handle) == 3


def test_plants_do_not_share_their_state(make_plant: MakePlant) -> None:
    moving, resting = make_plant(), make_plant({"gravity": [0.0, 0.0, 0.0]})
    moving.set("drive_mode", [VELOCITY] * 6)
    moving.set("velocity_command", [0.1] * 6)
    before = resting.get("position")
    for _ in range(100):
        moving.step(1e-3)
        resting.step(1e-3)
    np.testing.assert_allclose(resting.get("position"), before, atol=1e-15)
    assert moving.get("position")[2] - before[2] > 5e-3


def test_a_reset_fmu_starts_over(make_plant: MakePlant, hexapod: Mechanism) -> None:
    plant = make_plant({"payload.mass": 5.0})
    first = plant.get("position")
    plant.set("drive_mode", [OPEN] * 6)
    for _ in range(10):
        plant.step(1e-3)
    plant.fmu.reset()
    plant.fmu.enterInitializationMode()
    plant.fmu.exitInitializationMode()
    plant.handle["time"] = 0.0
    np.testing.assert_array_equal(plant.get("position"), first)
    assert plant.get("payload.mass") == hexapod.plant["payload.mass"]
    plant.step(1e-3)


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
    saved = FmuInstance.state(plant)
    clock = plant.state().removesuffix(saved)
    for broken, message in (
        (bytes([saved[0] ^ 1]) + saved[1:], "from another build of this FMU"),
        (saved[:-1], "wrong size"),
    ):
        with pytest.raises(FmuError, match=f"gough_plant.fmu: restoring a state failed: .*{message}"):
            plant.restore(clock + broken)


# ---- what the loop asks besides ----


def test_a_plant_of_another_number_of_legs_is_refused(hexapod: Mechanism, fmu_path: Path) -> None:
    with pytest.raises(InputError, match=r"gough_plant\.fmu has 6 legs, and the mechanism has 3: choose another one"):
        FmuPlant(fmu_path, {}, 1e-3, legs=3)
    FmuPlant(fmu_path, {}, 1e-3, legs=6).close()


def test_settings_at_one_time_come_in_the_order_of_the_user_and_at_zero_before_the_first_step(fmu_path: Path) -> None:
    texts = ("payload.mass=9@0.002", "payload.mass=7@0.002", "payload.mass=5@0", "payload.mass=4", "friction.coulomb=2@0.001")
    with FmuPlant(fmu_path, {}, 1e-3, settings=[Setting.parse(text) for text in texts]) as plant:
        assert plant.get("payload.mass") == 4.0
        seen = []
        for _ in range(4):
            plant.step(1e-3)
            seen.append((float(plant.get("payload.mass")), *set(plant.get("friction.coulomb").tolist())))
        assert seen == [(5.0, 15.0), (5.0, 2.0), (7.0, 2.0), (7.0, 2.0)]


def test_a_setting_during_the_run_may_be_an_end_of_its_range(fmu_path: Path) -> None:
    FmuPlant(fmu_path, {}, 1e-3, settings=[Setting.parse("payload.mass=0@1"), Setting.parse("payload.mass=1e6@2")]).close()
    for text, message in (
        ("payload.mass=-0.1@1", "payload.mass of gough_plant.fmu would be -0.1; it must be from 0 to 1e+06"),
        ("gravity=0,0,2000@1", "gravity[3] of gough_plant.fmu would be 2000; it must be from -1000 to 1000"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            FmuPlant(fmu_path, {}, 1e-3, settings=[Setting.parse(text)])


@pytest.mark.parametrize(
    ("step", "said"),
    [
        (0.003, "fixed.fmu cannot take a step of 0.003 s: its own is fixed at 0.002 s; set [fmu] step to that"),
        (0.001, "fixed.fmu cannot take a step of 0.001 s"),
        (0.005, "fixed.fmu cannot take a rate of 83.3333 Hz: its binding sets a step of 0.005 s, so the rate must be 200 Hz"),
        (0.024, "fixed.fmu cannot take a rate of 83.3333 Hz: its binding sets a step of 0.024 s"),
        (0.004, ""),
        (0.012, ""),
    ],
)
def test_a_step_of_the_binding_divides_the_period_and_is_a_multiple_of_the_fmus(
    hexapod: Mechanism, fixed_step: Path, step: float, said: str
) -> None:
    binding = replace(OWN_BINDING, step=step)
    if said:
        with pytest.raises(InputError, match=re.escape(said)):
            FmuPlant(fixed_step, hexapod.plant_parameters(), 0.012, binding)
    else:
        with FmuPlant(fixed_step, hexapod.plant_parameters(), 0.012, binding) as plant:
            plant.step(0.012)
            assert plant.handle["length"] == pytest.approx(step) and plant.get("time") == pytest.approx(0.012)


@pytest.mark.parametrize("model", [SPATIAL_MODEL, PLANAR_MODEL], ids=lambda model: model.identifier)
def test_a_linear_plant_goes_as_the_plant_does_nearby(model: Model) -> None:
    """Its four matrices against differences of the plant's own outputs and rates, at a lively moment."""
    with FmuPlant(default_fmu(model), {}, 1e-3) as plant:
        legs = plant.bound.legs
        plant.set("drive_mode", np.full(legs, VELOCITY))
        plant.set("velocity_command", 0.02 * np.arange(1, legs + 1) / legs)
        plant.step(0.02)
        inputs, outputs = ["external_wrench.force", "velocity_command"], ["leg_velocity", "position", "voltage"]
        linear = plant.linearize(inputs, outputs)
        sizes = {"n": len(linear.states), "m": len(linear.inputs), "p": len(linear.outputs)}
        assert (linear.a.shape, linear.b.shape) == ((sizes["n"], sizes["n"]), (sizes["n"], sizes["m"]))
        assert (linear.c.shape, linear.d.shape) == ((sizes["p"], sizes["n"]), (sizes["p"], sizes["m"]))
        assert linear.inputs[0] == "external_wrench.force[1]" and linear.inputs[-1] == f"velocity_command[{legs}]"
        assert linear.outputs[:2] == ("leg_velocity[1]", "leg_velocity[2]") and linear.states[0] == "state.position[1]"

        kept = {name.partition("[")[0] for name in linear.states}
        rates = [rate.name for state, rate in plant.description.states if state.name in kept]
        assert (len(rates), sizes["n"]) == (6, 25 if legs == 6 else 12)

        def values(names: list[str]) -> Array:
            return np.concatenate([plant.get(name).ravel() for name in names])

        column = 0
        for name in inputs:
            middle = plant.get(name)
            for i in range(middle.size):
                ends = []
                for sign in (1.0, -1.0):
                    plant.set(name, middle + sign * 1e-4 * np.eye(middle.size)[i])
                    ends.append((values(rates), values(outputs)))
                plant.set(name, middle)
                for matrix, one, other in zip((linear.b, linear.d), *ends, strict=True):
                    difference = (one - other) / 2e-4
                    np.testing.assert_allclose(matrix[:, column], difference, rtol=1e-5, atol=1e-6 * np.abs(matrix).max())
                column += 1
        assert column == sizes["m"]
        # A position is a state itself, and its rate is a velocity.
        place = linear.states.index("state.velocity[1]")
        np.testing.assert_array_equal(linear.a[0], np.eye(sizes["n"])[place])
        np.testing.assert_array_equal(linear.c[linear.outputs.index("position[1]")], np.eye(sizes["n"])[0])


def test_a_plant_without_derivatives_or_states_is_not_linearised(fmu_path: Path, tmp_path: Path, make_plant: MakePlant) -> None:
    changes = {'providesDirectionalDerivatives="true"': ""}
    with (
        FmuPlant(copy_of(fmu_path, tmp_path / "stiff.fmu", changes), {}, 1e-3) as plant,
        pytest.raises(FmuError, match=r"stiff\.fmu has no directional derivatives: export it with them"),
    ):
        plant.linearize(["velocity_command"], ["leg_length"])
    with pytest.raises(InputError, match=r"drive_mode of gough_plant\.fmu is of type Enumeration and has no derivatives"):
        make_plant().linearize(["drive_mode"], ["leg_length"])
    with pytest.raises(UnknownNameError, match="no variable 'lengths'"):
        make_plant().linearize(["velocity_command"], ["lengths"])


def test_the_payload_is_set_and_a_refusal_is_told(make_plant: MakePlant) -> None:
    plant = make_plant()
    assert write_payload_mass(plant.handle, 7.5) == 0
    assert plant.get("payload.mass") == 7.5
    assert write_payload_mass(plant.handle, -1.0) == 3
    assert "setting the payload failed" in str(plant.failure())
