"""Optimisations: known fronts, bounds, interruptions, and mechanisms that a run takes."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.engine.engine import InOneProcess, open_engine
from hil.engine.settings import EngineSettings
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from hil.sweep.design import Check, Constraint, Design, Objective, Search, read_design
from hil.sweep.function import UserFunction
from hil.sweep.optimisation import GIVEN_UP, REFUSED, RUN, TRIALS, OptimisationResult, check, mechanism_of, optimise
from hil.sweep.store import Store
from hil.sweep.study import Factor, Study
from plant.errors import InputError
from plant.mechanism import load_spatial
from plant.mechanism.joint_circles import shape_of
from tests.hil.commands import gough

ZDT1 = """
import math

def zdt1(**x):
    first, *others = (x[f"x{n:02d}"] for n in range(30))
    g = 1.0 + 9.0 * sum(others) / 29.0
    return {"f1": first, "f2": g * (1.0 - math.sqrt(first / g))}
"""
ZDT1_VOLUME = 1.1 * 1.1 - 1.0 / 3.0
"""Of the true front f2 = 1 - sqrt(f1), to (1.1, 1.1): the square without the area below the front."""
CALLS: list[dict[str, Any]] = []


def volume(points: Sequence[tuple[float, float]]) -> float:
    """The area that points beat, to (1.1, 1.1)."""
    found, lowest = 0.0, 1.1
    for first, second in sorted(points):
        if first < 1.1 and second < lowest:
            found += (1.1 - first) * (lowest - second)
            lowest = second
    return found


def schaffer(x: float, y: float) -> dict[str, float]:
    """Its front is y = 0, x from 0 to 2; x below -3 cannot be run."""
    CALLS.append({"x": x, "y": y})
    if x < -3.0:
        raise ValueError("x is too small")
    return {"f1": x**2 + y**2, "f2": (x - 2.0) ** 2 + y**2, "sum": x + y}


def of_model(function: Callable[..., Any], objectives: Sequence[Objective], **others: Any) -> Design:
    factors = (Factor("x", low=-4.0, high=4.0), Factor("y", low=-1.0, high=1.0))
    study = Study(factors, model=UserFunction(function.__name__, "the text", "here", function))
    return Design(study, tuple(objectives), **others)


def two(**others: Any) -> Design:
    CALLS.clear()
    return of_model(schaffer, [Objective("f1"), Objective("f2")], **others)


def run(design: Design, folder: Path) -> OptimisationResult:
    return optimise(design, folder, InOneProcess())


def points_of(result: OptimisationResult) -> list[Any]:
    return [(trial.number, dict(trial.point), dict(trial.figures), trial.state) for trial in result.trials]


def test_the_front_is_the_known_one(tmp_path):
    result = run(two(search=Search(trials=240, batch=16)), tmp_path)
    # Two parents may have the same child twice, which is run once.
    assert len(result.trials) == 240
    assert len({(call["x"], call["y"]) for call in CALLS}) == len(CALLS) == result.ran <= 240
    front = result.objectives_of(result.front)
    # On the true front, sqrt(f1) + sqrt(f2) = 2.
    assert len(front) > 10
    assert np.median(np.sqrt(front).sum(axis=1)) == pytest.approx(2.0, abs=0.02)
    assert (np.diff(front[:, 0]) >= 0.0).all() and (np.diff(front[:, 1]) <= 0.0).all()
    assert result.knee.point["x"] == pytest.approx(1.0, abs=0.2)
    for trial in result.trials:
        assert (trial.state == REFUSED) == (trial.point["x"] < -3.0)
        assert trial.reason == ("ValueError: x is too small" if trial.state == REFUSED else "")


def test_the_front_keeps_the_bounds(tmp_path):
    bounds = (Constraint("sum", least=1.0, most=1.5),)
    result = run(two(constraints=bounds, search=Search(trials=200, batch=20)), tmp_path)
    assert all(1.0 <= trial.figures["sum"] <= 1.5 for trial in result.front)
    broken = [trial for trial in result.trials if trial.state == REFUSED and "sum" in trial.figures]
    assert broken and all(not 1.0 <= trial.figures["sum"] <= 1.5 for trial in broken)
    assert {trial.reason for trial in broken} == {"out of its bounds: sum"}
    assert result.front[0].figures["f1"] == pytest.approx(0.5, abs=0.2)


def test_one_objective_is_found_by_tpe(tmp_path):
    CALLS.clear()
    design = of_model(schaffer, [Objective("f2")], search=Search(trials=120))
    result = run(design, tmp_path)
    assert design.method == "tpe"
    assert result.knee.point["x"] == pytest.approx(2.0, abs=0.3)
    assert result.knee.figures["f2"] == min(trial.figures["f2"] for trial in result.trials if trial.state == RUN)
    largest = of_model(schaffer, [Objective("sum", "maximise")], search=Search(trials=60, seed=3))
    assert run(largest, tmp_path).knee.figures["sum"] > 4.0


@pytest.mark.slow
@pytest.mark.parametrize("method", ["nsga2", "tpe"])
def test_the_seed_alone_decides_and_an_interruption_changes_nothing(method, tmp_path):
    design = two(search=Search(trials=60, method=method, batch=6, seed=4))
    whole = run(design, tmp_path / "whole")
    assert points_of(run(design, tmp_path / "again")) == points_of(whole)
    other = replace(design, search=replace(design.search, seed=5))
    assert points_of(run(other, tmp_path / "other")) != points_of(whole)
    CALLS.clear()
    for stop in (0.1, 0.3, 0.3, 0.7, 0.9):

        def interrupt(share: float, label: str, stop: float = stop) -> None:
            if share >= stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            optimise(design, tmp_path / "parts", InOneProcess(), interrupt)
    result = run(design, tmp_path / "parts")
    assert points_of(result) == points_of(whole)
    assert len({(call["x"], call["y"]) for call in CALLS}) == len(CALLS) == whole.ran
    assert run(design, tmp_path / "parts").ran == 0


def test_it_goes_on_behind_a_line_that_was_cut_and_a_batch_that_was_saved_in_part(tmp_path):
    design = two(search=Search(trials=24, batch=8))
    whole = run(design, tmp_path)
    journal = tmp_path / TRIALS
    lines = journal.read_bytes().splitlines(keepends=True)
    # The last line says that the last batch is whole; the ones before are its trials.
    journal.write_bytes(b"".join(lines[:-4]) + lines[-4][:20])
    (tmp_path / f"{TRIALS}.lock").symlink_to(journal)
    again = run(design, tmp_path)
    assert (points_of(again), again.ran) == (points_of(whole), 0)
    assert points_of(run(design, tmp_path)) == points_of(whole)


def test_more_trials_go_on_from_those_that_are_there(tmp_path):
    first = run(two(search=Search(trials=16, batch=8)), tmp_path)
    more = run(two(search=Search(trials=32, batch=8)), tmp_path)
    assert points_of(more)[:16] == points_of(first)
    assert more.ran == 16


def test_what_cannot_be_run_or_is_not_there_is_told_at_once(tmp_path):
    def broken(x: float, y: float) -> float:
        raise ValueError("no licence")

    with pytest.raises(InputError, match="none of the first 8 trials can be run; the first one: ValueError: no licence"):
        run(of_model(broken, [Objective("broken")], search=Search(trials=20)), tmp_path)
    with pytest.raises(InputError, match="no run has the figure 'f3'; there are f1, f2, sum"):
        run(of_model(schaffer, [Objective("f3")]), tmp_path)
    never = two(constraints=(Constraint("sum", least=100.0),), search=Search(trials=20, batch=10))
    result = run(never, tmp_path)
    assert result.front == ()
    with pytest.raises(InputError, match="none of 20 trials keeps the constraints"):
        _ = result.knee
    with pytest.raises(InputError, match="not on the front; on it are knee, no trials"):
        result.chosen("3")


def hexapod(objectives: Sequence[Objective], *factors: Factor, **others: Any) -> Design:
    study = Study(factors, SimulationConfig(target="sines", duration=0.5))
    return Design(study, tuple(objectives), **others)


@pytest.mark.slow
def test_geometry_alone_needs_no_run_and_begins_at_the_start(tmp_path):
    design = hexapod(
        [Objective("geometry.force_per_torque"), Objective("geometry.reach_rotation", "maximise")],
        Factor("geometry.platform_radius", low=0.16, high=0.24),
        Factor("geometry.base_radius", low=0.24, high=0.36),
        constraints=(Constraint("geometry.reach", least="start"),),
        search=Search(trials=32, batch=8),
    )
    result = run(design, tmp_path)
    assert result.ran == len(Store(tmp_path).table()) <= 33
    first = result.trials[0]
    assert first.point == pytest.approx({"geometry.platform_radius": 0.2, "geometry.base_radius": 0.3})
    assert first.figures == pytest.approx(result.start) and first.state == RUN
    assert all(trial.figures["geometry.reach"] >= result.start["geometry.reach"] * (1 - 1e-9) for trial in result.front)
    # A larger platform bears torques better and turns less: both ends are on the front.
    ends = result.front[0].point, result.front[-1].point
    assert ends[0]["geometry.platform_radius"] > 0.21 > 0.19 > ends[1]["geometry.platform_radius"]


@pytest.mark.slow
def test_the_chosen_mechanism_is_a_file_that_runs_as_the_trial_did(tmp_path):
    design = hexapod(
        [Objective("estimation.rotation_rms", pool="rms"), Objective("geometry.reach", "maximise")],
        Factor("geometry.platform_radius", low=0.18, high=0.22),
        Factor("geometry.home_height", low=0.32, high=0.38),
        Factor("mechanism.control.proportional", low=50.0, high=70.0),
        Factor("run.imu", ("icm42688", "ideal")),
        search=Search(trials=6, seeds=2, batch=3),
        check=Check(2, (Factor("run.target", ("hold", "circle")),)),
    )
    result = run(design, tmp_path / "results")
    # 6 trials and the start, each the geometry once and two seeds.
    assert result.ran == 7 * 3
    trial = result.front[0]
    path = tmp_path / "chosen.toml"
    path.write_text(mechanism_of(result, trial))
    written = load_spatial(path)
    shape = shape_of(written)
    assert shape["platform_radius"] == pytest.approx(trial.point["geometry.platform_radius"])
    assert shape["home_height"] == pytest.approx(trial.point["geometry.home_height"])
    assert written.settings["control"]["proportional"] == trial.point["mechanism.control.proportional"]
    np.testing.assert_allclose(np.ptp(written.limits.stroke, axis=1), 0.12)
    assert f"# run.imu = {trial.point['run.imu']}" in path.read_text()
    errors = [
        simulate(
            SimulationConfig(mechanism=str(path), target="sines", duration=0.5, seed=seed, imu=trial.point["run.imu"])
        ).summary()["estimation"]["rotation_rms"]
        for seed in range(2)
    ]
    assert np.sqrt(np.mean(np.square(errors))) == trial.figures["estimation.rotation_rms"]

    found = check(result, trial, InOneProcess())
    assert [(each.figure, each.values["run.target"], each.seeds) for each in found] == [
        ("estimation.rotation_rms", "hold", 2),
        ("estimation.rotation_rms", "circle", 2),
    ]
    config = SimulationConfig(target="circle", duration=0.5)
    start = [simulate(replace(config, seed=seed)).summary()["estimation"]["rotation_rms"] for seed in (2, 3)]
    assert found[1].start == np.sqrt(np.mean(np.square(start)))
    assert found[1].better is not None and 0 <= found[1].better <= 2


@pytest.mark.slow
def test_a_trial_that_is_worse_at_each_seed_is_given_up(tmp_path):
    design = hexapod(
        [Objective("estimation.rotation_rms", pool="rms")],
        Factor("run.imu", ("ideal", "mpu9150-calibrated")),
        search=Search(trials=8, seeds=8, group=4, batch=2),
    )
    result = run(design, tmp_path)
    assert result.knee.point == {"run.imu": "ideal"}
    given_up = [trial for trial in result.trials if trial.state == GIVEN_UP]
    assert given_up and {trial.point["run.imu"] for trial in given_up} == {"mpu9150-calibrated"}
    assert run(design, tmp_path).ran == 0


ONE = 'model = "model.py:f"\n[vary]\nx = { from = -1.0, to = 1.0 }\n[objectives]\nf = "minimise"\n[search]\ntrials = 20\n'


def test_the_command_prints_the_front_and_writes_the_figures(tmp_path):
    (tmp_path / "model.py").write_text("def f(x):\n    return (x - 0.25) ** 2\n")
    (tmp_path / "one.toml").write_text(ONE)
    done = gough("optimise", "one.toml", "--workers", 1, "--json", "one.json", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert "20 trials, 20 new runs; 20 within all bounds, 0 not, 0 given up early; * is chosen; in one.results" in done.stdout
    figures = json.loads((tmp_path / "one.json").read_text())
    assert figures["trials"] == {"run": 20, "given up": 0, "refused": 0}
    assert figures["chosen"] == figures["knee"] == figures["front"][0]["number"]
    assert figures["front"][0]["point"]["x"] == pytest.approx(0.25, abs=0.1)
    for arguments, message in (
        (["--write", "m.toml"], "a model has no mechanism that could be written: leave --write out"),
        (["--choose", "99"], "'99' is not on the front"),
        (["--choose", "nee", "--results", "other"], "--choose nee is no trial: give its number, knee, or first"),
    ):
        refused = gough("optimise", "one.toml", "--workers", 1, *arguments, cwd=tmp_path)
        assert refused.returncode == 2
        assert message in refused.stderr and refused.stderr.count("\n") == 1
    assert not (tmp_path / "other").exists()


def test_a_search_that_finds_nothing_writes_its_figures(tmp_path):
    (tmp_path / "model.py").write_text("def f(x):\n    return (x - 0.25) ** 2\n")
    (tmp_path / "one.toml").write_text(f"{ONE}[constraints]\nf = {{ most = -1.0 }}\n")
    refused = gough("optimise", "one.toml", "--workers", 1, "--json", "one.json", cwd=tmp_path)
    assert refused.returncode == 2 and refused.stderr.count("\n") == 1
    assert json.loads((tmp_path / "one.json").read_text())["trials"] == {"run": 0, "given up": 0, "refused": 20}


@pytest.mark.slow
def test_the_command_writes_a_mechanism(tmp_path):
    (tmp_path / "shape.toml").write_text(
        "[vary]\ngeometry.platform_radius = { from = 0.16, to = 0.24 }\n"
        '[objectives]\ngeometry.force_max = "minimise"\n[search]\ntrials = 12\n'
    )
    done = gough("optimise", "shape.toml", "--workers", 1, "--write", "best.toml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    run = gough("simulate", "--mechanism", "best.toml", "--target", "hold", "--duration", 0.2, cwd=tmp_path)
    assert run.returncode == 0
    assert "as it was" in done.stdout and "is written to best.toml" in done.stdout


def zdt1(folder: Path, trials: int, seed: int) -> Design:
    (folder / "zdt1.py").write_text(ZDT1)
    names = "\n".join(f"x{n:02d} = {{ from = 0.0, to = 1.0 }}" for n in range(30))
    objectives = '[objectives]\nf1 = "minimise"\nf2 = "minimise"\n'
    search = f"[search]\ntrials = {trials}\nseed = {seed}\n"
    (folder / "zdt1.toml").write_text(f'model = "zdt1.py:zdt1"\n[vary]\n{names}\n{objectives}{search}')
    return read_design(folder / "zdt1.toml")


@pytest.mark.endurance
@pytest.mark.parametrize("seed", range(11, 16))
def test_zdt1_is_solved_to_95_percent_of_the_hypervolume(tmp_path, seed):
    """On the engine's processes, with seeds that the settings of the search were not chosen on."""
    with open_engine(EngineSettings(workers=2, dashboard="127.0.0.1:0")) as engine:
        result = optimise(zdt1(tmp_path, 4000, seed), tmp_path / "results", engine)
    front = [(float(first), float(second)) for first, second in result.objectives_of(result.front)]
    assert result.ran <= len(result.trials) == 4000
    assert volume(front) >= 0.95 * ZDT1_VOLUME


def test_the_volume_of_the_true_front_is_the_known_one():
    first = np.linspace(0.0, 1.0, 20001)
    assert volume(list(zip(first, 1.0 - np.sqrt(first), strict=True))) == pytest.approx(ZDT1_VOLUME, rel=1e-3)


@pytest.mark.endurance
def test_a_process_that_is_killed_loses_nothing(tmp_path):
    design = zdt1(tmp_path, 200, 1)
    slow = ZDT1.replace("    first, *others", '    time.sleep(0.01)\n    open("calls", "a").write("x\\n")\n    first, *others')
    (tmp_path / "zdt1.py").write_text(f"import time\n{slow}")
    command = [sys.executable, "-m", "hil.command_line", "optimise", "zdt1.toml", "--workers", "1"]
    root = Path(__file__).parents[3]
    for _ in range(4):
        process = subprocess.Popen(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)})
        time.sleep(3.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(root)}, check=True)
    found = run(read_design(tmp_path / "zdt1.toml"), tmp_path / "zdt1.results")
    assert (found.ran, len(found.trials)) == (0, 200)
    whole = run(design, tmp_path / "uninterrupted")
    assert [trial.figures for trial in found.trials] == [trial.figures for trial in whole.trials]
    # What had not been written when a process was killed is done again: a tenth of a second of runs.
    calls = len((tmp_path / "calls").read_text().splitlines())
    assert whole.ran <= calls <= whole.ran + 4 * 30
