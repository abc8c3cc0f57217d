"""Designs: what a file says, how figures are pooled and bound, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.sweep.case import case_of, measure
from hil.sweep.design import Check, Constraint, Design, Objective, Search, pooled, read_design
from hil.sweep.study import Factor, Study
from plant.errors import GoughError, InputError

TEXT = """
name = "legs"
[run]
target = "sines"
duration = 1.0
[vary]
geometry.base_radius = { from = 0.24, to = 0.36 }
run.imu = ["mpu9150-calibrated", "icm42688"]
[objectives]
estimation.rotation_rms = { goal = "minimise", pool = "rms" }
geometry.reach = "maximise"
[constraints]
geometry.reach = { least = "start" }
tracking.position_max = { most = 0.005, pool = 0.9 }
[search]
trials = 30
seeds = 3
[check]
seeds = 2
run.target = ["sines", "circle"]
"""


def test_a_file_says_it_all(tmp_path):
    path = tmp_path / "legs.toml"
    path.write_text(TEXT)
    design = read_design(path)
    assert design.objectives == (
        Objective("estimation.rotation_rms", "minimise", "rms"),
        Objective("geometry.reach", "maximise", "mean"),
    )
    assert design.constraints == (
        Constraint("geometry.reach", least="start"),
        Constraint("tracking.position_max", most=0.005, pool=0.9),
    )
    assert [factor.name for factor in design.study.factors] == ["geometry.base_radius", "run.imu"]
    assert (design.method, design.batch, design.search.trials, design.search.seeds) == ("nsga2", 40, 30, 3)
    assert design.of_geometry and design.of_run
    assert list(design.pools.items()) == [
        ("estimation.rotation_rms", "rms"),
        ("geometry.reach", "mean"),
        ("tracking.position_max", 0.9),
    ]
    point = {"geometry.base_radius": 0.3, "run.imu": "icm42688"}
    assert [each["run.seed"] for each in design.points_of(point)] == [0, 1, 2]
    checked = design.check_points(point, {"run.target": "circle"})
    assert [(each["run.seed"], each["run.target"]) for each in checked] == [(3, "circle"), (4, "circle")]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[vary]", "[vary]\nrun.seed = { seeds = 3 }", r"run.seed is no part of a design"),
        ('"maximise"', '"larger"', "the goal is 'larger'; it is minimise or maximise"),
        ('pool = "rms"', 'pool = "median"', "pool is 'median'; it is rms, mean, max, min, or a quantile"),
        (
            "tracking.position_max =",
            "estimation.rotation_rms = { most = 0.1 }\ntracking.position_max =",
            "estimation.rotation_rms is pooled by rms as an objective and by mean as a constraint: give both the same pool",
        ),
        ("pool = 0.9", "pool = 1.5", "pool is 1.5"),
        ('least = "start"', 'least = "begin"', "a bound is 'begin'"),
        ("most = 0.005, ", "", "tracking.position_max has no bound"),
        ("trials = 30", "trials = 0", "trials is 0; it is a whole number from 1"),
        ("trials = 30", "trails = 30", r"\[search\] has no entry 'trails'"),
        ("trials = 30", 'method = "nsga3"', "there is no method 'nsga3'"),
        ("trials = 30", 'method = "nsga2"\nbatch = 1', "give 2 at least"),
        ("[check]\nseeds = 2", "[check]", r"\[check\] has no seeds"),
        ('run.target = ["sines", "circle"]', "run.seed = [1, 2]", "but not of its seed"),
        ("geometry.base_radius", "geometry.base_radios", "the geometry has no entry 'base_radios'"),
        ("[check]", "[sampling]\ncount = 8\n[check]", r"leave \[sampling\] out"),
        ("[objectives]", "[goals]", "has no entry 'goals'"),
        ("estimation.rotation_rms = {", "estimation.rotation_rms = { gaol = 1, ", "is not understood"),
    ],
)
def test_what_makes_no_sense_is_one_clear_line(tmp_path, old, new, message):
    assert old in TEXT
    path = tmp_path / "wrong.toml"
    path.write_text(TEXT.replace(old, new))
    with pytest.raises(GoughError, match=message) as refused:
        read_design(path)
    assert "\n" not in str(refused.value)


def test_a_model_has_neither_start_nor_seeds():
    study = Study((Factor("x", low=0.0, high=1.0),), model=read_only_model())
    with pytest.raises(InputError, match="a model has no start"):
        Design(study, (Objective("y"),), (Constraint("y", most="start"),))
    with pytest.raises(InputError, match="a model has no seeds"):
        Design(study, (Objective("y"),), check=Check(3))
    assert Design(study, (Objective("y"),), search=Search(seeds=5)).points_of({"x": 0.5}) == [{"x": 0.5}]


def read_only_model():
    from hil.sweep.function import UserFunction

    return UserFunction("model", "text", "here", lambda x: {"y": x})


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=9), st.floats(0.0, 1.0))
def test_figures_are_pooled(values, share):
    assert pooled(values, "rms") == pytest.approx(np.linalg.norm(values) / np.sqrt(len(values)))
    assert pooled(values, "mean") == pytest.approx(sum(values) / len(values))
    assert (pooled(values, "min"), pooled(values, "max")) == (min(values), max(values))
    assert min(values) <= pooled(values, share) <= max(values)


@given(st.floats(-10.0, 10.0), st.floats(0.1, 10.0), st.floats(0.1, 10.0))
def test_a_value_breaks_its_bounds_by_a_share_of_them(value, least, span):
    constraint = Constraint("figure", least, least + span)
    assert (constraint.violation(value, np.nan) <= 0.0) == (least <= value <= least + span)
    start = Constraint("figure", least="start")
    assert start.violation(0.5 * span, span) == pytest.approx(0.5)
    assert start.violation(span, span) <= 0.0


def test_figures_of_the_geometry_need_no_run():
    study = Study((Factor("geometry.platform_radius", low=0.16, high=0.24),))
    figures = [
        measure(case_of(study, {"geometry.platform_radius": radius}, run=False, geometry=True)) for radius in (0.2, 0.24)
    ]
    assert all(name.startswith("geometry.") for name in figures[0])
    assert figures[1]["geometry.reach_rotation"] < figures[0]["geometry.reach_rotation"]
    assert figures[0] == pytest.approx(measure(case_of(study, {}, run=False, geometry=True)), rel=1e-9)
