"""The description of the FMU: valid, and what the table of variables says."""

import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu

from plant.dynamics.variables import BRAKE, DRIVE_MODES, PLANAR, SPATIAL, VELOCITY, VariableTable
from plant.fmu.binding import BASE
from plant.fmu.description_writer import QUANTITIES, Layout
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism
from plant.pose import Array

MakePlant = Callable[..., FmuPlant]
EXPOSED = Layout(SPATIAL).exposed


@pytest.fixture(scope="module")
def description(fmu_path: Path) -> Any:
    return fmpy.read_model_description(str(fmu_path), validate=True)


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
    plant = make_plant({"base_imu_position": np.array([0.3, 0.1, -0.2])})
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
        **{name: [[0.1, -0.2, 0.3]] for name in BASE},
    }
    held: dict[str, Any] = {
        "velocity_command": plant.get("velocity_command"),
        "drive_mode": [VELOCITY, BRAKE, BRAKE, VELOCITY, VELOCITY, VELOCITY],
        "external_wrench.force": np.zeros(3),
        "external_wrench.torque": np.zeros(3),
        **{name: np.zeros(3) for name in BASE},
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


@pytest.mark.parametrize("table", [SPATIAL, PLANAR], ids=["spatial", "planar"])
def test_a_derivative_is_its_state_per_second(table: VariableTable) -> None:
    layout = Layout(table)
    for state, rate in zip(table.states, layout.rates, strict=True):
        assert rate.name == f"der({state.name})" and rate.shape == state.shape
        assert layout.state_of(rate) is state and layout.state_of(state) is None
        per_second = {"s": 0} | exponents(state.unit)
        per_second["s"] -= 1
        assert exponents(rate.unit) == {base: exponent for base, exponent in per_second.items() if exponent}


def test_the_derivatives_of_the_description_are_those_of_its_states(description: Any) -> None:
    rates = {each.name: each.derivative.name for each in description.modelVariables if each.derivative}
    assert rates == {f"der({state.name})": state.name for state in SPATIAL.states}


@pytest.mark.parametrize("table", [SPATIAL, PLANAR], ids=["spatial", "planar"])
def test_every_value_has_a_place_of_its_own(table: VariableTable) -> None:
    layout = Layout(table)
    places = [place for variable in layout.stored for place in layout.places(variable)]
    assert places == list(range(layout.size)) and set(layout.stored) == set(layout.exposed)
    assert layout.places(table.states[0]).start == 0


def test_what_may_change_and_when_is_described(description: Any) -> None:
    described = {variable.name: variable for variable in description.modelVariables}
    for variable in (*SPATIAL.inputs, *SPATIAL.outputs, *SPATIAL.states, *Layout(SPATIAL).rates):
        actual = described[variable.name]
        assert actual.variability == ("discrete" if variable.name == "drive_mode" else "continuous"), variable.name
        # What is calculated has no start value, and an input is zero but for the drives' mode.
        calculated = variable.causality in ("output", "state")
        assert (actual.initial == "calculated") == calculated and (actual.start is None) == calculated, variable.name
        if variable.causality == "input" and variable.name != "drive_mode":
            assert {float(text) for text in actual.start.split()} == {0.0}
