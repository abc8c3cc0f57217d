"""What the terminal shows of an engine."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hil.command_line.terminal import engine_at_work
from hil.engine.settings import EngineSettings
from tests.hil.processes import wait_until


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
