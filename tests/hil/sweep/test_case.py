"""Cases: what determines a run, and what a worker needs of it."""

import os
import tomllib
from dataclasses import replace
from pathlib import Path

import cloudpickle
import numpy as np
import pytest

from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from hil.sweep.case import Case, cases_of, measure
from hil.sweep.function import UserFunction
from hil.sweep.study import Factor, Study
from plant.errors import GoughError
from plant.fmu.settings import Setting
from plant.mechanism import load_spatial

SHORT = SimulationConfig(target="sines", duration=0.2, rate=500.0)


def only(study: Study) -> Case:
    (case,) = cases_of(study)
    return case


def seeds(*values: int, **others: object) -> Study:
    return Study((Factor("run.seed", values),), **others)  # type: ignore[arg-type]


def test_the_figures_are_those_of_a_simulation_to_the_bit() -> None:
    summary = simulate(SimulationConfig(target="sines", duration=0.2, rate=500.0, seed=3)).summary()
    figures = measure(only(seeds(3, run=SHORT)))
    for group in ("estimation", "tracking", "estimated_tracking", "target"):
        for name, value in summary[group].items():
            assert figures[f"{group}.{name}"] == value
    assert figures["limits.violations"] == 0.0
    assert not [name for name in figures if name.startswith(("cycle_us", "real_time", "config"))]


def test_an_entry_of_the_mechanism_is_changed_and_the_others_stay() -> None:
    name = "mechanism.geometry.platform_joints.0.2"
    case = only(Study((Factor(name, (0.01,)), Factor("mechanism.plant.payload.mass", (2.5,))), run=SHORT))
    changed, preset = load_spatial(case.local_config().mechanism), load_spatial("hexapod")
    assert changed.platform_joints[0, 2] == 0.01
    assert changed.name == "hexapod"
    assert (changed.platform_joints[1:] == preset.platform_joints[1:]).all()
    assert (changed.base_joints == preset.base_joints).all()
    document = tomllib.loads(case.files[0].content.decode())
    assert document["plant"]["payload"]["mass"] == 2.5
    assert document["plant"]["payload"]["center_of_mass"] == [0.0, 0.0, 0.10]


def test_an_entry_of_the_mechanism_may_be_a_list() -> None:
    cases = cases_of(Study((Factor("mechanism.home.position", ([0.0, 0.0, 0.35], (0.0, 0.01, 0.36))),), run=SHORT))
    found = [load_spatial(case.local_config().mechanism).home.position for case in cases]
    assert np.array_equal(found, [[0.0, 0.0, 0.35], [0.0, 0.01, 0.36]])


def test_files_go_with_the_case_and_need_not_be_there(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('based_on = "hexapod"\nname = "own"\n[limits]\nvelocity = 0.2\n')
    study = seeds(1, run=SimulationConfig(mechanism=str(own), target="hold", duration=0.2, rate=500.0))
    sent = cloudpickle.dumps(only(study))
    own.unlink()
    case = cloudpickle.loads(sent)
    assert load_spatial(case.local_config().mechanism).require_limits().velocity == 0.2
    assert measure(case)["truth_known"] == 1.0


def test_a_function_of_the_result_gives_more_figures() -> None:
    study = seeds(1, run=SHORT, function=UserFunction.of(cycles))
    figures = measure(only(study))
    assert figures["cycles"] == 100
    assert figures["estimation.position_rms"] > 0.0


def cycles(result: object) -> int:
    return int((result.times >= 0.0).sum())  # type: ignore[attr-defined]


def test_a_model_needs_no_run() -> None:
    study = Study((Factor("x", (2.0,)), Factor("y", (3.0,))), model=UserFunction.of(product))
    assert measure(only(study)) == {"product": 6.0}


def product(x: float, y: float) -> float:
    return x * y


def test_the_key_is_that_of_all_that_determines_the_figures(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text('based_on = "hexapod"\n')
    there = SimulationConfig(mechanism=str(own))
    key = only(seeds(1)).key
    assert key == only(seeds(1)).key
    assert key == only(Study((Factor("run.seed", (1,)), Factor("run.rate", (1000,))))).key
    others = [seeds(2), seeds(1, run=SHORT), seeds(1, mechanism={"control.integral": 150.0}), seeds(1, run=there)]
    others += [
        seeds(1, function=UserFunction.of(cycles)),
        Study((Factor("plant.payload.mass", (9.0,)), Factor("run.seed", (1,)))),
    ]
    keys = {only(study).key for study in others}
    assert len(keys | {key}) == len(others) + 1
    before = only(seeds(1, run=there)).key
    moved = tmp_path / "moved.toml"
    own.rename(moved)
    assert only(seeds(1, run=SimulationConfig(mechanism=str(moved)))).key == before


def test_a_file_that_was_edited_is_another_one(tmp_path: Path) -> None:
    """In the same process, as in a notebook; the text is as long as before, and its time of change is set back."""
    own = tmp_path / "own.toml"

    def case(velocity: float, **others: object) -> Case:
        own.write_text(f'based_on = "hexapod"\n[limits]\nvelocity = {velocity}\n')
        os.utime(own, (1e9, 1e9))
        return only(seeds(1, run=SimulationConfig(mechanism=str(own)), **others))

    for others in ({}, {"mechanism": {"control.integral": 150.0}}):
        first, second = case(0.2, **others), case(0.3, **others)
        assert first.key != second.key
        assert load_spatial(first.local_config().mechanism).require_limits().velocity == 0.2
        assert load_spatial(second.local_config().mechanism).require_limits().velocity == 0.3
        assert case(0.2, **others).key == first.key


def test_a_value_of_the_plant_may_come_at_a_time_of_the_motion() -> None:
    study = Study((Factor("plant.payload.mass@0.1", (5.0, 30.0)),), run=SHORT)
    figures = [measure(case) for case in cases_of(study)]
    command_line = replace(SHORT, settings=(Setting.parse("payload.mass=30@0.1"),))
    assert figures[1]["tracking.position_rms"] == simulate(command_line).summary()["tracking"]["position_rms"]
    assert figures[0]["tracking.position_rms"] != figures[1]["tracking.position_rms"]


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (Factor("run.rate", (1e9,)), "run.rate = 1000000000.0: the rate"),
        (Factor("run.mechanism", ("octopod",)), "no mechanism 'octopod'"),
        (Factor("mechanism.geometry.base_joints.9.0", (0.1,)), "no number from 0 to 5"),
        (Factor("mechanism.limits.velocity.fast", (0.1,)), "limits.velocity is no table"),
        (Factor("plant.payload.mass@soon", (5.0,)), "payload.mass=5.0@soon' is no setting"),
    ],
)
def test_a_point_that_cannot_be_run_is_told_before_anything_runs(factor: Factor, said: str) -> None:
    with pytest.raises(GoughError, match=said):
        list(cases_of(Study((factor,))))
