"""Kernels that are compiled by several processes at once, and what happens when these fail."""

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import pytest
from numba.core import event

from plant.compiled import filled, load_kernels, processes, shared_kernel
from tests.hil.processes import wait_until

KERNELS = """
from plant.compiled import kernel, record_dtype, shared_kernel

DTYPE = record_dtype(count=int, values=(float, 3))

@kernel
def scaled(record, by):
    return by * (record.values[0] + record.values[1])

@shared_kernel
def inner(record, by) -> float:
    record.count += 1
    return scaled(record, by) / record.count

@shared_kernel
def middle(record) -> float:
    return inner(record, 2.0) + inner(record, by=2.0)

@shared_kernel
def misdeclared(record) -> int:
    return inner(record, 1.0)

@kernel
def first(records):
    return middle(records[()]) - 1.0

@kernel
def second(records):
    return middle(records[()]) + inner(records[()], 1.0)

@kernel
def third(records):
    return misdeclared(records[()])

@kernel
def wrong(records):
    return inner(records[()], 1.0) + records[()].values.nothing
"""

RESULTS = {"first": 8.0, "second": 10.0, "third": 3.0}


@pytest.fixture
def kernels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module of kernels that are nowhere compiled, on a machine with two processors."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    name = f"kernels_of_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(KERNELS)
    monkeypatch.syspath_prepend(tmp_path)
    module = import_module(name)
    yield module
    del sys.modules[name]
    shutil.rmtree(module.first._cache.cache_path, ignore_errors=True)


def records(kernels: ModuleType) -> Any:
    return filled(kernels.DTYPE, values=(1.0, 2.0, 3.0))


def children() -> set[str]:
    """The processes that this one has started and not waited for; other tests may have left some."""
    return {pid for task in Path("/proc/self/task").iterdir() for pid in (task / "children").read_text().split()}


def compiled(kernels: ModuleType, *names: str) -> tuple[list[str], list[str]]:
    """Load and call kernels; returns what was compiled by workers, and what here, in alphabetical order."""
    told: list[Any] = []
    before = children()

    class Listener(event.Listener):
        def on_start(self, event: Any) -> None:
            told.append(event.data["dispatcher"])

        def on_end(self, event: Any) -> None:
            pass

    with event.install_listener("numba:compile", Listener()):
        load_kernels(*((getattr(kernels, name), records(kernels)) for name in names))
        assert {name: getattr(kernels, name)(records(kernels)) for name in names} == {name: RESULTS[name] for name in names}
    assert children() <= before
    elsewhere = sorted(each.rpartition(".")[2] for each in told if isinstance(each, str))
    return elsewhere, sorted(each.py_func.__name__ for each in told if not isinstance(each, str))


def cached(kernels: ModuleType) -> set[str]:
    """The kernels that are in the cache."""
    return {file.name.split(".")[1].split("-")[0] for file in Path(kernels.first._cache.cache_path).glob("*.nbc")}


def test_workers_compile_each_kernel_once_and_this_process_none(kernels: ModuleType) -> None:
    assert compiled(kernels, "first", "second") == (["first", "inner", "middle", "scaled", "second"], [])
    assert cached(kernels) == {"first", "inner", "middle", "second"}
    assert compiled(kernels, "first", "second") == ([], [])


def test_workers_compile_only_what_is_not_in_the_cache(kernels: ModuleType) -> None:
    kernels.inner(records(kernels)[()], 1.0)
    assert compiled(kernels, "first") == (["first", "middle"], [])


def test_a_single_processor_compiles_here(kernels: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    assert compiled(kernels, "first") == ([], ["first", "inner", "middle", "scaled"])


def test_a_thread_of_an_engine_compiles_here(kernels: ModuleType) -> None:
    """As many of them work at the same time as there are processors."""
    found: list[tuple[list[str], list[str]]] = []
    thread = threading.Thread(target=lambda: found.append(compiled(kernels, "first")))
    thread.start()
    thread.join()
    assert found == [([], ["first", "inner", "middle", "scaled"])]


def dies(*_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hangs(*_: Any) -> None:
    time.sleep(60.0)


def fails(*_: Any) -> None:
    raise OSError("no space left")


def disturb(monkeypatch: pytest.MonkeyPatch, kernel: str, what: Callable[..., None]) -> None:
    """Let something happen to the worker that compiles a kernel."""
    compile_one = processes._compile_one

    def compile_or_not(origin: Any, *arguments: Any) -> None:
        (what if origin[1] == kernel else compile_one)(origin, *arguments)

    monkeypatch.setattr(processes, "_compile_one", compile_or_not)


@pytest.mark.slow
@pytest.mark.parametrize("what", [dies, hangs, fails])
def test_what_workers_leave_undone_is_compiled_here(
    kernels: ModuleType, monkeypatch: pytest.MonkeyPatch, what: Callable[..., None]
) -> None:
    """Callers that are compiled without their shared kernels are not kept, as they could not be loaded."""
    monkeypatch.setattr(processes, "_PATIENCE_S", 3.0)
    disturb(monkeypatch, "inner", what)
    elsewhere, here = compiled(kernels, "first", "second")
    assert "first" in elsewhere
    assert here == ["first", "inner", "middle", "scaled", "second"]


def test_a_kernel_that_is_not_as_it_is_declared_is_compiled_here(kernels: ModuleType) -> None:
    """It returns a number, and says that this is whole."""
    elsewhere, here = compiled(kernels, "third")
    assert "misdeclared" in elsewhere
    assert {"misdeclared", "third"} <= {*here}


def test_a_shared_kernel_says_what_it_returns() -> None:
    with pytest.raises(TypeError, match=r"annotate what .*nothing_said returns"):

        @shared_kernel
        def nothing_said(record):  # type: ignore[no-untyped-def]
            return record.count


def test_an_error_in_a_kernel_is_raised_here(kernels: ModuleType) -> None:
    with pytest.raises(numba.TypingError, match="nothing"):
        load_kernels((kernels.wrong, records(kernels)))


def test_ctrl_c_ends_the_workers_and_what_they_have_done_serves_the_next_start(
    kernels: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    def press_ctrl_c() -> None:
        wait_until(lambda: "inner" in cached(kernels), "inner is saved")
        os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patch:
        disturb(patch, "middle", hangs)
        presses = threading.Thread(target=press_ctrl_c)
        presses.start()
        with pytest.raises(KeyboardInterrupt):
            load_kernels((kernels.second, records(kernels)))
        presses.join()
    assert cached(kernels) == {"inner"}
    assert compiled(kernels, "second") == (["middle", "second"], [])


def test_workers_end_with_their_parent(kernels: ModuleType, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def goes_on(origin: Any, pipe: Any, *_: Any) -> None:
        (tmp_path / "worker").write_text(str(os.getpid()))
        while True:
            processes._send(pipe, "and on")
            time.sleep(0.01)

    disturb(monkeypatch, "first", goes_on)
    parent = os.fork()
    if parent == 0:
        load_kernels((kernels.first, records(kernels)))
        os._exit(0)
    wait_until(lambda: (tmp_path / "worker").exists() and (tmp_path / "worker").read_text() != "", "the worker is there")
    worker = int((tmp_path / "worker").read_text())
    os.kill(parent, signal.SIGKILL)
    os.waitpid(parent, 0)
    wait_until(lambda: not _lives(worker), "the worker has ended")


def _lives(process: int) -> bool:
    """Whether a process is there, and is none that only waits to be counted."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
