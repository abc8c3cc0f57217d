"""What the terminal shows of an engine, and while numba compiles: it never stands still, with a terminal or without."""

import os
import pty
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hil.command_line import terminal
from hil.command_line.terminal import engine_at_work
from hil.engine.settings import EngineSettings
from hil.runs.run_state import RunState
from tests.hil.processes import wait_until

COMPILES = """
import time
from numba.core import event
from hil.command_line import terminal
terminal._COMPILED_FUNCTIONS, terminal._QUIET_S = 3, {quiet}
with terminal.progress_bar("hexapod follows circle"):
    for _ in range(8):
        event.start_event("numba:compile")
        time.sleep(0.4)
"""


def on_a_terminal(code):
    """What a program draws on a terminal."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": "160", "TERM": "xterm"}
    process = subprocess.Popen([sys.executable, "-c", code], stderr=theirs, stdout=theirs, env=environment)
    os.close(theirs)
    drawn = b""
    try:
        while chunk := os.read(ours, 1 << 16):
            drawn += chunk
    except OSError:
        # The other side has closed.
        pass
    os.close(ours)
    assert process.wait() == 0
    return drawn.decode()


@pytest.mark.slow
def test_the_clock_of_the_bar_goes_on_when_more_functions_are_compiled_than_expected():
    drawn = on_a_terminal(COMPILES.format(quiet=10.0))
    frames = re.findall(r"compiling function (\d+) of about \d+.*?(\d+:\d\d:\d\d)", drawn)
    beyond = {clock for number, clock in frames if int(number) > 3}
    assert {"0:00:01", "0:00:02"} <= beyond


@pytest.mark.slow
def test_without_a_terminal_a_line_tells_now_and_then_that_it_goes_on():
    run = subprocess.run([sys.executable, "-c", COMPILES.format(quiet=1.0)], capture_output=True, text=True, check=True)
    told = re.findall(r"^compiling function (\d+) of about (\d+) ", run.stderr, re.MULTILINE)
    numbers = [int(number) for number, _ in told]
    assert numbers[0] == 1 and 2 <= len(numbers) <= 5 and numbers[-1] > 3
    # The total that was expected grows with the number.
    assert [int(most) for _, most in told] == [max(number, 3) for number in numbers]


@pytest.mark.parametrize(("waited", "lines"), [(5.0, 0), (35.0, 1)])
def test_without_a_terminal_a_run_that_takes_long_to_begin_says_so(monkeypatch, capsys, waited, lines):
    now = [100.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    with terminal.live_view("hexapod", "circle", 1000.0) as show:
        now[0] += waited
        for _ in range(3):
            show(RunState(1e-3))
    told = capsys.readouterr().err.splitlines()
    assert len(told) == lines
    assert all("preparing" in line and "35 s" in line for line in told)


@pytest.mark.slow
def test_the_printed_line_lets_a_worker_for_each_processor_join(capsys: pytest.CaptureFixture[str]) -> None:
    """Workers that keep no profile of their work, and whose pages other machines do not reach."""
    settings = EngineSettings(workers=1, listen="localhost:0", dashboard="127.0.0.1:0")
    with engine_at_work(settings, "work") as (engine, _):
        engine.map(abs, [-1])
        line = next(each for each in capsys.readouterr().err.splitlines() if "dask worker" in each)
        command = line.partition("join with: ")[2]
        assert "PROFILE__ENABLED=False" in command and "--dashboard-address 127.0.0.1:0" in command
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        joined = subprocess.Popen(command, shell=True, env=os.environ | {"PATH": path}, start_new_session=True)
        try:
            ask = ["__import__('os').getpid()"] * 50
            wait_until(lambda: len({*engine.map(eval, ask)}) == 1 + len(os.sched_getaffinity(0)), "all have joined", 60.0)
        finally:
            os.killpg(joined.pid, signal.SIGKILL)
            joined.wait()
