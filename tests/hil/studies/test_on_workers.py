"""Every study gives the same figures, bit for bit, in one process and on workers, and needs no Dask."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from controller.settings import FusionSettings
from hil.command_line import main
from hil.engine.engine import IN_ONE_PROCESS, open_engine
from hil.engine.settings import EngineSettings
from hil.faults.reactions import CASES
from hil.faults.rows import all_rows
from hil.faults.trials import run_trials, trials_of
from hil.studies import broad, fusion_comparison, fusion_evaluation, fusion_tuning
from hil.studies.accuracy import evaluate_accuracy, evaluate_classes
from hil.studies.config import ComparisonConfig, EvaluationConfig, TuningConfig
from hil.studies.sensor_sets import SETS, evaluate_sensor_sets
from plant.extras import EXTRAS
from plant.mechanism import load_spatial

CALIBRATED = EvaluationConfig(imu="mpu9150-calibrated", rate=250.0, joint_error=0.0, seeds=(1, 2), starts=3, still=70.0)


@pytest.fixture(scope="module")
def workers():
    with open_engine(EngineSettings(workers=2, dashboard="127.0.0.1:0")) as engine:
        yield engine


@pytest.fixture(scope="module")
def trials(tmp_path_factory):
    """Two trials of made-up data."""
    folder, random = tmp_path_factory.mktemp("trials"), np.random.default_rng(0)
    for name in ("first", "second"):
        arrays = {"imu_gyr": random.normal(size=(500, 3)), "imu_acc": random.normal(size=(500, 3)) + [0.0, 0.0, 9.81]}
        turns = np.tile([1.0, 0.0, 0.0, 0.0], (500, 1))
        np.savez(folder / f"{name}.npz", **arrays, opt_quat=turns, movement=np.ones(500), sampling_rate=250.0)
    return folder


def faults(engine):
    short = [replace(row, duration=4.0) for row in all_rows() if row.name == "a leg's IMU turns by 3 deg about x at once"]
    return run_trials(trials_of([*CASES[30:32], CASES[33], *short], [0]), engine)


STUDIES = {
    "accuracy": lambda engine, trials: evaluate_accuracy(load_spatial("6-4-I"), 40, 1, engine).summary(),
    "broad": lambda engine, trials: broad.evaluate(trials, FusionSettings(), engine=engine),
    "faults": lambda engine, trials: faults(engine),
    "sensor-sets": lambda engine, trials: list(map(vars, evaluate_sensor_sets(["6-3-II"], SETS[:4], 0.3, 1, engine))),
}
LONG_STUDIES = {
    "classes": lambda engine, trials: list(map(vars, evaluate_classes(1, engine, mechanisms=3))),
    "compare-fusion": lambda engine, trials: fusion_comparison.compare(
        ComparisonConfig(duration=20.5, rate=50.0, seeds=(0, 1)), engine
    ),
    "evaluate-fusion": lambda engine, trials: fusion_evaluation.evaluate(CALIBRATED, engine),
    "tune-fusion": lambda engine, trials: fusion_tuning.tune_fusion(TuningConfig(seeds=(0,), rate=50.0), engine),
}


def without_times(figures):
    if isinstance(figures, dict):
        return {name: without_times(each) for name, each in figures.items() if name not in ("us", "cost")}
    return [without_times(each) for each in figures] if isinstance(figures, list | tuple) else figures


@pytest.mark.slow
@pytest.mark.parametrize(
    "study",
    [
        *(pytest.param(name, marks=pytest.mark.slow) if name in ("faults", "sensor-sets") else name for name in STUDIES),
        *(pytest.param(n, marks=pytest.mark.slow if n == "tune-fusion" else pytest.mark.endurance) for n in LONG_STUDIES),
    ],
)
def test_figures_do_not_depend_on_the_engine(study, workers, trials):
    evaluate = (STUDIES | LONG_STUDIES)[study]
    here, there = (json.dumps(without_times(evaluate(engine, trials)), default=str) for engine in (IN_ONE_PROCESS, workers))
    assert here == there
    assert len(here) > 200


COMMANDS = ["accuracy --poses 20", "broad TRIALS --seeds 0"]
LONG_COMMANDS = [
    "faults --seeds 1 --only emergency",
    "classes --mechanisms 3",
    "compare-fusion --duration 20.5 --rate 50 --seeds 0",
    "evaluate-fusion --imu mpu9150-calibrated --rate 250 --seeds 1 --starts 1 --joint-error 0 --only start",
    "sensor-sets --mechanism 6-3-II --duration 0.3",
    "tune-fusion TUNED --seeds 0 --rate 50",
]


@pytest.mark.parametrize("line", [*COMMANDS, *(pytest.param(line, marks=pytest.mark.endurance) for line in LONG_COMMANDS)])
def test_without_the_packages_for_sweeps_studies_run_in_this_process(line, trials, tmp_path, monkeypatch, capsys):
    for package in (name for name, extra in EXTRAS.items() if extra == "sweep"):
        monkeypatch.setitem(sys.modules, package, None)
    arguments = line.replace("TRIALS", str(trials)).replace("TUNED", str(tmp_path / "tuned.toml")).split()
    assert main(arguments) == 0
    assert "the workers at their work" not in capsys.readouterr().err
    assert main([*arguments, "--workers", "2"]) == 2
    assert "this needs distributed, which is not installed: pip install 'gough[sweep]'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_share_that_is_done_grows_to_all_of_it():
    shares = []
    run_trials(trials_of(CASES[30:32], range(2)), progress=shares.append)
    assert shares == [0.25, 0.5, 0.75, 1.0]
    parts = []
    config = EvaluationConfig(rate=50.0, only=("cost",))
    fusion_evaluation.evaluate(config, progress=lambda part, share: parts.append((part, share)))
    assert parts == [("cost", pytest.approx(k / 3)) for k in (1, 2, 3)]
