"""The engine on Dask: who can connect, what programs it works in, and what it does about workers that die."""

import os
import shutil
import socket
import ssl
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from operator import attrgetter
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.engine.cluster import _AHEAD, _TRIES, WorkerRefusedError, _Queue
from hil.engine.engine import Engine, open_engine
from hil.engine.settings import EngineSettings, host_and_port
from hil.runs.config import SimulationConfig
from hil.sweep.case import cases_of, measure
from hil.sweep.study import Factor, Study
from tests.hil.engine.certificates import Certificates, make_certificates
from tests.hil.processes import dask_scheduler, dask_worker, started, wait_until

LOOPBACK = ("127.0.0.1", "::1", "::ffff:127.0.0.1")


@given(st.integers(0, 80), st.integers(1, 5), st.sets(st.integers(0, 79), max_size=30), st.integers(0, 2**32 - 1))
def test_only_what_kills_workers_is_given_up(items: int, workers: int, deadly: set[int], seed: int) -> None:
    """A cluster in which batches end in any order, and a worker that dies takes any other batches with it."""
    rng, queue, running = np.random.default_rng(seed), _Queue(items), list[list[int]]()
    done, given_up, deaths = Counter[int](), Counter[int](), Counter[int]()
    while True:
        while len(running) < _AHEAD * workers and (numbers := queue.next(running, workers)):
            running.append(numbers)
        if not running:
            break
        batch = running.pop(rng.integers(len(running)))
        if not deadly & {*batch}:
            done.update(batch)
            queue.took(rng.choice([np.nan, 1e-3, 0.1, 10.0]))
        elif rng.random() < 0.2:
            queue.put_back(batch)
        else:
            beside = [each for each in running if rng.random() < 0.5]
            running = [each for each in running if each not in beside]
            for killed in (batch, *beside):
                deaths.update(killed)
                given_up.update(queue.died(killed))
    there = {number for number in deadly if number < items}
    assert given_up == Counter(there)
    assert done == Counter({*range(items)} - there)
    assert all(deaths[number] <= _TRIES for number in range(items))


def listening(pids: set[int]) -> list[tuple[str, int]]:
    """The addresses at which these processes listen."""
    found = psutil.net_connections(kind="tcp")
    return [(each.laddr.ip, each.laddr.port) for each in found if each.pid in pids and each.status == psutil.CONN_LISTEN]


def family() -> set[int]:
    return {os.getpid(), *(each.pid for each in psutil.Process().children(recursive=True))}


PROCESS = "__import__('os').getpid()"
"""What Python evaluates on a worker to its number."""


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Certificates:
    return make_certificates(tmp_path_factory.mktemp("tls") / "ours")


@pytest.fixture(scope="module")
def engine(certificates: Certificates) -> Iterator[Engine]:
    """Two processes, which others can join with a certificate."""
    files = {"tls_ca": str(certificates.ca), "tls_cert": str(certificates.cert), "tls_key": str(certificates.key)}
    with open_engine(EngineSettings(workers=2, listen="localhost:0", **files)) as engine:
        yield engine


@pytest.mark.slow
def test_all_workers_work_and_nothing_listens_beyond_this_machine(engine: Engine) -> None:
    pids = {*engine.map(eval, [PROCESS] * 50)}
    assert engine.workers == 2
    assert os.getpid() not in pids
    addresses = listening(family())
    # Scheduler, dashboard, and nanny, worker and its page twice.
    assert len(addresses) >= 6
    assert {host for host, _ in addresses} <= {*LOOPBACK}


# Dask speaks first.
@pytest.mark.slow
@pytest.mark.parametrize(("name", "spoken"), [("joined_at", b""), ("dashboard", b"GET /status HTTP/1.0\r\n\r\n")])
def test_nobody_connects_without_a_certificate(
    engine: Engine, certificates: Certificates, name: str, spoken: bytes, tmp_path: Path
) -> None:
    address = (getattr(engine, name) or "").partition("://")[2].removesuffix("/status")
    others = make_certificates(tmp_path / "others")

    def answers(shown: Certificates | None) -> bool:
        context = ssl.create_default_context(cafile=certificates.ca)
        context.check_hostname = False
        if shown:
            context.load_cert_chain(shown.cert, shown.key)
        with context.wrap_socket(socket.create_connection(host_and_port(address))) as tls:
            return heard(tls, 60.0 if shown is certificates else 2.0)

    def heard(connection: socket.socket, patience: float) -> bool:
        connection.settimeout(patience)
        try:
            connection.sendall(spoken)
            return bool(connection.recv(10))
        except OSError:
            return False

    assert answers(certificates)
    assert not answers(None)
    assert not answers(others)
    with socket.create_connection(host_and_port(address)) as plain:
        assert not heard(plain, 2.0)


@pytest.mark.slow
def test_a_worker_with_other_sources_is_left_out(
    engine: Engine, certificates: Certificates, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with started(dask_worker(engine.joined_at or "", *certificates.dask_options), other_sources(tmp_path)) as worker:
        wait_until(lambda: engine.workers == 3, "the worker has joined")
        while "left out" not in caplog.text:
            assert len({*engine.map(eval, [PROCESS] * 30)}) == 2
        assert worker.wait() == 0
    (line,) = [record.getMessage() for record in caplog.records if record.name == "gough"]
    assert line.startswith("the worker at tls://127.0.0.1:")
    assert "has other sources" in line
    assert engine.workers == 2


@pytest.mark.slow
def test_a_scheduler_needs_no_gough_and_a_worker_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = tmp_path / "empty"
    for package in ("hil", "plant"):
        (empty / package).mkdir(parents=True)
        (empty / package / "__init__.py").write_text(f"raise ModuleNotFoundError('No module named {package}')")
    with ExitStack() as stack:
        monkeypatch.setenv("PYTHONPATH", str(empty))
        _, address = stack.enter_context(dask_scheduler(tmp_path))
        with (
            started(dask_worker(address), tmp_path),
            open_engine(EngineSettings(scheduler=address)) as engine,
            pytest.raises(WorkerRefusedError, match="cannot take part: No module named hil; install the same gough"),
        ):
            engine.map(eval, ["1"])
        monkeypatch.setenv("PYTHONPATH", str(Path(__file__).resolve().parents[3]))
        stack.enter_context(started(dask_worker(address), tmp_path))
        with open_engine(EngineSettings(scheduler=address)) as engine:
            assert engine.map(eval, ["1", "2"]) == [1, 2]


@pytest.mark.endurance
def test_a_worker_stays_as_large_as_it_is() -> None:
    runs, grown = 150, 10e6
    study = Study((Factor("run.seed", tuple(range(runs))),), run=SimulationConfig(duration=0.5, rate=250.0))
    with open_engine(EngineSettings(workers=1, listen="localhost:0")) as engine:
        # A profile of the work, which Dask keeps unless told otherwise, would make it grow for an hour.
        assert engine.map(eval, ["__import__('dask').config.get('distributed.worker.profile.enabled')"]) == [False]
        (worker,) = {*engine.map(eval, [PROCESS] * 4)}
        sizes, files = [], []
        for _, outcome in engine.run(measure, list(cases_of(study)), attrgetter("kind")):
            assert isinstance(outcome, dict), outcome
            sizes.append(psutil.Process(worker).memory_info().rss)
            files.append(psutil.Process(worker).num_fds())
    first, middle, last = (sizes[n] / 1e6 for n in (0, runs // 2, -1))
    print(f"{first:.1f} MB after the first run, {middle:.1f} in the middle, {last:.1f} at the end")
    assert sizes[-1] - sizes[runs // 3] < grown
    # A run that is under way has some files open. A file that is never closed raises the least number as well.
    assert min(files[100:]) <= min(files[:50]) + 2


PROGRAM = """
import os
from pathlib import Path
from hil.engine.engine import open_engine
from hil.engine.settings import EngineSettings
from plant.compiled import keyed_folder

print("the program runs")
FACTOR = 3

def work(item):
    return FACTOR * item, os.getpid(), str(keyed_folder("kernels", "some"))

with open_engine(EngineSettings(workers=2)) as engine:
    results = engine.map(work, range(40))
    print(sorted(number for number, _, _ in results) == [3 * item for item in range(40)])
    print(len({process for _, process, _ in results}), len({folder for _, _, folder in results}))
"""


@pytest.mark.slow
@pytest.mark.parametrize("where", ["file", "standard input", "module"])
def test_a_program_needs_no_guard_and_no_cache(where: str, tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    (tmp_path / "a file").touch()
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    command = [sys.executable, *{"file": ["program.py"], "standard input": ["-"], "module": ["-m", "program"]}[where]]
    environment = os.environ | {"GOUGH_CACHE": str(tmp_path / "a file" / "cache"), "TMPDIR": str(temporary)}
    finished = subprocess.run(
        command, cwd=tmp_path, env=environment, input=PROGRAM, capture_output=True, text=True, timeout=120.0, check=False
    )
    # Both workers work, and share the program's cache, as nothing can be written where the user's should be.
    assert finished.stdout.splitlines() == ["the program runs", "True", "2 1"], finished.stderr
    assert finished.stderr == ""
    assert not list(temporary.glob("gough-*"))


@pytest.mark.slow
def test_two_programs_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(PROGRAM)
    both = [subprocess.Popen([sys.executable, "program.py"], cwd=tmp_path, stderr=subprocess.PIPE) for _ in range(2)]
    assert [each.communicate(timeout=120.0)[1] for each in both] == [b"", b""]
    assert [each.returncode for each in both] == [0, 0]


def other_sources(folder: Path) -> Path:
    """A folder that has gough with another constant, from which Python takes it."""
    here = Path(__file__).resolve().parents[3]
    for package in ("plant", "controller", "hil", "fmus"):
        shutil.copytree(here / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    changed = folder / "controller" / "settings.py"
    changed.write_text(f"{changed.read_text()}\nCHANGED = 1.0\n")
    return folder
