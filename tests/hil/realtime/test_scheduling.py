"""Settings for real time, usage, and processes beside this one."""

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from hil.realtime import processes
from hil.realtime.scheduling import (
    MEASURES,
    RealTimeSettings,
    Usage,
    before_others,
    keep_to_one_thread,
    processor_left,
    processor_time,
    real_time,
    since_process_start,
    stolen_time,
)
from plant.errors import InputError


def test_priorities_are_those_below_the_kernels_own():
    for priority in (1, 98):
        assert RealTimeSettings(priority=priority).priority == priority
    for priority in (0, 99, -1):
        with pytest.raises(InputError, match=f"the priority is {priority}; it must be 1 to 98"):
            RealTimeSettings(priority=priority)


def test_a_period_missed_is_the_least_that_can_end_a_run():
    assert RealTimeSettings(most_missed=1).most_missed == 1
    with pytest.raises(InputError, match="most_missed is 0; it must be 1 at least"):
        RealTimeSettings(most_missed=0)


def test_the_processor_is_the_last_that_there_is_or_the_one_that_is_asked_for(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {7, 2, 5})
    assert RealTimeSettings().processor == 7
    assert RealTimeSettings(cpu=2).processor == 2
    with pytest.raises(InputError, match="there is no processor 3 for this process; there are 2, 5, 7"):
        RealTimeSettings(cpu=3)


def test_a_processor_is_left_to_the_loop_by_all_threads_and_what_they_start_and_only_for_a_while():
    before = os.sched_getaffinity(0)
    kept, begin, over = max(before), threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: begin.set() or over.wait())
    thread.start()
    begin.wait()
    try:
        for cpu, expected in ((kept, before - {kept} or before), (None, before), (max(before) + 1, before)):
            with processor_left(cpu):
                started = subprocess.run(["nproc"], stdout=subprocess.PIPE, check=True, env={"PATH": os.environ["PATH"]})
                assert int(started.stdout) == len(expected)
                assert os.sched_getaffinity(0) == os.sched_getaffinity(thread.native_id) == expected
            assert os.sched_getaffinity(0) == os.sched_getaffinity(thread.native_id) == before
    finally:
        over.set()
        thread.join()


def test_a_planner_comes_before_others_only_for_a_while():
    """Its children do not."""
    program = "import os; print(os.sched_getscheduler(0))"
    with before_others():
        first = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        child = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, check=True)
    # A machine may refuse it.
    assert first == (os.SCHED_FIFO if os.geteuid() == 0 else first)
    assert int(child.stdout) == os.sched_getscheduler(0) == os.SCHED_OTHER


def test_nothing_is_collected_on_the_clock_and_again_afterwards():
    settings = RealTimeSettings(without=MEASURES)
    assert gc.isenabled()
    with real_time(settings):
        assert not gc.isenabled()
    assert gc.isenabled()
    with pytest.raises(KeyError), real_time(settings):
        raise KeyError
    assert gc.isenabled()


def test_usage_is_the_difference_by_name():
    before, after = Usage(1, 2, 3, 4, 5_000, 0.5), Usage(2, 4, 6, 8, 6_000, 0.75)
    assert after.since(before) == {
        "major_faults": 1, "minor_faults": 2, "voluntary_switches": 3, "involuntary_switches": 4, "resident": 1000, "cpu": 0.25,
    }  # fmt: skip


def test_the_time_since_the_start_of_the_process_goes_on():
    first = since_process_start()
    time.sleep(0.05)
    assert 0.0 < first < since_process_start() < first + 60.0


def test_stolen_time_is_what_the_kernel_says_of_all_processors(monkeypatch):
    before = stolen_time()
    assert 0.0 <= before <= stolen_time()
    table = "cpu  11 12 13 14 15 16 17 1800 19 20\ncpu0 11 12 13 14 15 16 17 900 19 20\n"
    monkeypatch.setattr(Path, "read_text", lambda path: table if str(path) == "/proc/stat" else "")
    assert stolen_time() == 1800 / os.sysconf("SC_CLK_TCK")


def test_the_processor_time_of_a_process_is_what_it_has_computed():
    begun, own = processor_time(os.getpid()), time.process_time()
    while time.process_time() < own + 0.1:
        pass
    assert 0.08 < processor_time(os.getpid()) - begun < 0.2


def test_openblas_keeps_to_one_thread_unless_told_otherwise(monkeypatch):
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    keep_to_one_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    keep_to_one_thread()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"


def tell_blocked(number, pipe):
    os.write(pipe, ",".join(str(int(each)) for each in sorted(signal.pthread_sigmask(signal.SIG_BLOCK, []))).encode())
    os._exit(number)


def test_a_process_leaves_the_signals_that_end_it_to_its_supervisor():
    reader, writer = os.pipe()
    process = processes.started(tell_blocked, 3, writer)
    processes.join_or_kill(process)
    blocked = {int(each) for each in os.read(reader, 1000).decode().split(",")}
    os.close(reader)
    os.close(writer)
    assert process.exitcode == 3
    names = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")
    assert blocked >= {getattr(signal, name) for name in names}
    assert not blocked & {signal.SIGSEGV, signal.SIGALRM}


def test_a_process_that_does_not_end_is_killed(monkeypatch):
    monkeypatch.setattr(processes, "PATIENCE_S", 0.05)
    process = processes.started(time.sleep, 600.0)
    processes.join_or_kill(process)
    assert process.exitcode == -signal.SIGKILL
