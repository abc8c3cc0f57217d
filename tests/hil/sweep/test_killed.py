"""Sweeps whose processes are killed: all of them go on, and no run is lost or counted twice."""

import re
import signal
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import psutil
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hil.engine.engine import InOneProcess
from hil.sweep.store import DIED, DONE, KEY, REASON, STATUS, TABLE
from hil.sweep.study import read_study
from hil.sweep.sweep import run_study
from tests.hil.processes import Process, dask_scheduler, dask_worker, gough_sweep, started, wait_until

RUNS = """
name = "killed"
[run]
target = "sines"
duration = 0.5
rate = 500.0
[vary]
run.seed = { seeds = 24 }
run.imu = ["ideal", "mpu9150-calibrated", "icm42688"]
[measure]
function = "figures.py:slowly"
"""
FIGURES = """
import os, time

def slowly(result):
    with open(os.environ["RAN"], "a") as file:
        file.write(f"{result.config.imu} {result.config.seed}\\n")
    time.sleep(0.1)
    return {"last": result.records["position"][-1, 0]}
"""

MODEL = """
name = "deadly"
model = "model.py:deadly"
[vary]
x = { from = 0.0, to = 39.0, steps = 40 }
"""
DEADLY = """
import os, time

def deadly(x):
    with open(os.environ["RAN"], "a") as file:
        file.write(f"{x:g}\\n")
    if x == 12.0:
        os._exit(1)
    time.sleep(0.05)
    return {"square": x * x}
"""


def with_studies(folder: Path) -> Path:
    for name, text in {"runs.toml": RUNS, "figures.py": FIGURES, "deadly.toml": MODEL, "model.py": DEADLY}.items():
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("RAN", str(tmp_path / "ran"))
    return with_studies(tmp_path)


def ran(folder: Path) -> Counter[str]:
    """How often each run was begun."""
    file = folder / "ran"
    return Counter(file.read_text().splitlines() if file.exists() else ())


def rows(folder: Path) -> dict[str, dict[str, object]]:
    """The rows of a table by key, each of which is there once, and nothing else in its folder."""
    table: pa.Table = pq.read_table(folder / TABLE)
    found = {row[KEY]: row for row in table.to_pylist()}
    assert len(found) == len(table)
    assert sorted(each.name for each in folder.rglob("*")) == ["lock", "new", TABLE]
    return found


@pytest.mark.slow
def test_a_sweep_goes_on_after_a_worker_and_the_program_died(folder: Path) -> None:
    results = folder / "deadly.results"
    command = gough_sweep("deadly.toml", "--workers", 2)
    with started(command, folder) as killed:
        wait_until(lambda: list(results.glob("new/*.parquet")), "the first rows are there")
        killed.kill()
    before = ran(folder)
    with started(command, folder) as again:
        assert again.wait() == 1, again.text
        assert re.search(r"^1 of \d+ runs failed; ", again.text, re.MULTILINE), again.text
        assert "Traceback" not in again.text
    found = {row["x"]: row for row in rows(results).values()}
    assert len(found) == 40
    assert found[12.0][STATUS] == DIED
    assert "died" in str(found[12.0][REASON])
    assert all(row[STATUS] == DONE and row["square"] == x * x for x, row in found.items() if x != 12.0)
    # The run that kills its worker took others with it, but not endlessly.
    later = ran(folder) - before
    assert 1 <= later["12"] <= 3
    assert max(later.values()) <= 3


@pytest.mark.endurance
def test_a_run_over_which_workers_died_is_tried_at_the_next_start_too(folder: Path) -> None:
    command = gough_sweep("deadly.toml", "--workers", 2)
    for starts in (1, 2):
        with started(command, folder) as process:
            assert process.wait() == 1, process.text
        assert 1 <= ran(folder)["12"] <= 3 * starts
        assert len(rows(folder / "deadly.results")) == 40
        if starts == 1:
            (folder / "ran").rename(folder / "ran first")
    assert set(ran(folder)) == {"12"}


@pytest.mark.endurance
def test_a_worker_that_dies_costs_its_batch(folder: Path) -> None:
    with started(gough_sweep("runs.toml", "--workers", 2), folder) as process:
        wait_until(lambda: ran(folder).total() > 36, "half of the runs are done")
        process.workers()[0].kill()
        assert process.wait() == 0, process.text
    assert len(rows(folder / "runs.results")) == 72
    # A batch is two seconds of runs that take a tenth each, and its worker did them once more at most.
    again = [run for run, times in ran(folder).items() if times > 1]
    assert len(again) <= 22
    assert max(ran(folder).values()) <= 2


class Sweeps:
    """Sweeps of the same study, each in a folder of its own, whose processes are killed at random moments."""

    def __init__(self, folder: Path, reference: dict[str, dict[str, object]], seed: int) -> None:
        self.folder, self.reference, self.rng = folder, reference, np.random.default_rng(seed)
        self.killed, self.sweeps = Counter[str](), 0

    def wait_randomly(self, process: Process) -> bool:
        """Wait for a random time; whether the process is still running."""
        moment = self.rng.uniform(0.0, 9.0)
        try:
            process.popen.wait(moment)
        except Exception:
            return True
        return False

    def check(self, process: Process, results: Path) -> None:
        """Wait for the end of a sweep, and check its table."""
        assert process.wait() == 0, process.text
        assert rows(results) == self.reference
        self.sweeps += 1


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, object]]:
    """What a sweep gives that nothing disturbs, in one process."""
    folder = with_studies(tmp_path_factory.mktemp("reference"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAN", str(folder / "ran"))
        run_study(read_study(folder / "runs.toml"), folder / "undisturbed", InOneProcess())
    return rows(folder / "undisturbed")


@pytest.mark.endurance
@pytest.mark.parametrize("deaths", [12])
def test_deaths_of_programs_and_their_workers(folder: Path, reference: dict[str, dict[str, object]], deaths: int) -> None:
    sweeps = Sweeps(folder, reference, 1)
    plan = (["worker", "worker", "worker", "program", "worker", "program"] * 2)[-deaths:]
    while plan:
        results, ended = folder / f"{sweeps.sweeps}.results", False
        while not ended:
            with started(gough_sweep("runs.toml", "--results", results, "--workers", 2), folder) as process:
                ended = True
                while plan and sweeps.wait_randomly(process):
                    kind = plan.pop()
                    if kind == "program":
                        process.kill()
                        ended = False
                    else:
                        wait_until(process.workers, "there is a worker")
                        workers: list[psutil.Process] = process.workers()
                        workers[sweeps.rng.integers(len(workers))].kill()
                    sweeps.killed[kind] += 1
                    if not ended:
                        break
                if ended:
                    sweeps.check(process, results)
    print(f"killed {dict(sweeps.killed)} in {sweeps.sweeps} sweeps")
    assert sweeps.killed.total() == deaths


@pytest.mark.endurance
@pytest.mark.parametrize("deaths", [2, 8])
def test_deaths_of_an_external_scheduler_and_its_workers(
    folder: Path, reference: dict[str, dict[str, object]], deaths: int
) -> None:
    sweeps = Sweeps(folder, reference, 2)
    plan = ["scheduler", "worker", "nanny", "program", "scheduler", "nanny", "worker", "scheduler"][-deaths:]
    while plan:
        results, ended = folder / f"external-{sweeps.sweeps}.results", False
        while not ended:
            with ExitStack() as stack:
                scheduler, address = stack.enter_context(dask_scheduler(folder))
                workers = [stack.enter_context(started(dask_worker(address), folder)) for _ in range(2)]
                while not ended:
                    with started(gough_sweep("runs.toml", "--results", results, "--scheduler", address), folder) as process:
                        ended = True
                        while plan and sweeps.wait_randomly(process):
                            kind = plan.pop()
                            if kind == "scheduler":
                                scheduler.kill()
                                # 2 if it was just about to connect.
                                assert process.wait() in (1, 2), process.text
                                assert process.text.splitlines()[-1].startswith("gough: ")
                                assert "Traceback" not in process.text
                            elif kind == "program":
                                process.kill()
                            elif kind == "worker":
                                wait_until(workers[0].workers, "there is a worker")
                                workers[0].workers()[0].kill()
                            else:
                                workers.pop().kill()
                                workers.insert(0, stack.enter_context(started(dask_worker(address), folder)))
                            sweeps.killed[kind] += 1
                            if kind in ("scheduler", "program"):
                                ended = False
                                break
                        if ended:
                            sweeps.check(process, results)
                    if not scheduler.running:
                        break
    print(f"killed {dict(sweeps.killed)} in {sweeps.sweeps} sweeps")
    assert sweeps.killed.total() == deaths


@pytest.mark.slow
@pytest.mark.parametrize("after", [0.5, 1.5, 3.0, "rows"])
def test_ctrl_c_ends_all_processes_and_keeps_the_rows(folder: Path, after: float | str) -> None:
    with started(gough_sweep("runs.toml", "--workers", 2), folder) as process:
        new = folder / "runs.results" / "new"
        if after == "rows":
            wait_until(lambda: list(new.glob("*.parquet")), "the first rows are there")
        else:
            with pytest.raises(Exception, match="timed out"):
                process.popen.wait(after)
        family = process.family()
        process.interrupt()
        # A shell says 130 of both: before the command is under way, the signal itself ends the process.
        assert process.wait() in (130, -signal.SIGINT), process.text
        wait_until(lambda: not any(each.is_running() for each in family), "all have ended", 10.0)
        lines = process.text.splitlines()
        assert lines[-1] == "gough: interrupted"
        assert "Traceback" not in process.text
    if after == "rows":
        assert list(new.glob("*.parquet"))
