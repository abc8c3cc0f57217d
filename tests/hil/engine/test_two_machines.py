"""A sweep on several machines, each a network namespace with its own files; they share nothing but the network."""

import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from controller.calibration.file import Calibration, save_calibration
from hil.sweep.store import DONE, STATUS, TABLE
from plant.compiled.cache import user_cache
from plant.mechanism import load_mechanism
from plant.mechanism.documents import mechanism_text
from tests.hil.commands import gough
from tests.hil.engine.certificates import Certificates, make_certificates
from tests.hil.processes import Process, dask_worker, gough_sweep, started, wait_until

pytestmark = pytest.mark.slow

STUDY = """
name = "files"
[run]
mechanism = "rig.toml"
target = "motion.csv"
calibration = "imus.toml"
imu = "mpu9150-calibrated"
duration = 1.0
rate = 250.0
[vary]
run.seed = { seeds = 12 }
mechanism.control.proportional = [50.0, 60.0]
[measure]
function = "figures.py:machine"
"""
FIGURES = """
import os, time
from pathlib import Path

def machine(result):
    time.sleep(0.5)
    strange = [name for name in os.environ if name.startswith("OTHER") and any(Path(os.environ[name]).iterdir())]
    return {"machine": float(os.environ["MACHINE"]), "strange": len(strange), "last": result.records["position"][-1, 2]}
"""


class Machines:
    """Network namespaces 0, 1, ...: from each of them 0 is reached at 10.81.0.1."""

    def __init__(self, folder: Path, count: int, stack: ExitStack) -> None:
        self.folder, self.names = folder, [f"gough-{os.getpid()}-{number}" for number in range(count)]
        for number, name in enumerate(self.names):
            ip("netns", "add", name)
            stack.callback(ip, "netns", "del", name)
            ip("-n", name, "link", "set", "lo", "up")
            (folder / f"{number}").mkdir()
        ip("-n", self.names[0], "address", "add", "10.81.0.1/32", "dev", "lo")
        for number, name in enumerate(self.names[1:], start=1):
            ends = f"gough{number}a", f"gough{number}b"
            ip("link", "add", ends[0], "netns", self.names[0], "type", "veth", "peer", "name", ends[1], "netns", name)
            for end, there, last in ((ends[0], self.names[0], 1), (ends[1], name, 2)):
                ip("-n", there, "address", "add", f"10.81.{number}.{last}/24", "dev", end)
                ip("-n", there, "link", "set", end, "up")
            ip("-n", name, "route", "add", "default", "via", f"10.81.{number}.1")

    def prefix(self, number: int) -> list[str]:
        """What a command on this machine begins with; it sees an empty folder in place of every other machine's."""
        hidden = [self.folder / f"{other}" for other in range(len(self.names)) if other != number]
        mounts = " && ".join(f"mount -t tmpfs none {each}" for each in hidden)
        return ["ip", "netns", "exec", self.names[number], "unshare", "--mount", "sh", "-c", f'{mounts} && exec "$@"', "sh"]

    def environment(self, number: int) -> dict[str, str]:
        """Folders of its own for all that a process keeps: empty ones, but for a copy of the code that is compiled here."""
        own = self.folder / f"{number}"
        named = {}
        for name in ("GOUGH_CACHE", "HOME", "TMPDIR", "XDG_CACHE_HOME"):
            (own / name).mkdir(exist_ok=True)
            named[name] = str(own / name)
        for kind in ("kernels", "fmus"):
            # Another process may remove a file that it has just written.
            with suppress(shutil.Error, FileNotFoundError):
                shutil.copytree(user_cache() / kind, own / "GOUGH_CACHE" / kind, dirs_exist_ok=True)
        others = {f"OTHER{other}": str(self.folder / f"{other}") for other in range(len(self.names)) if other != number}
        return named | others | {"MACHINE": str(number), "PYTHONPATH": str(Path(__file__).resolve().parents[3])}

    def run(self, number: int, *arguments: object) -> AbstractContextManager[Process]:
        """A Python module with arguments on this machine."""
        return started(arguments, self.folder / f"{number}", self.environment(number), self.prefix(number))


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)


@pytest.fixture
def machines(tmp_path: Path) -> Iterator[Machines]:
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("network namespaces need root, and ip and unshare")
    with ExitStack() as stack:
        try:
            made = Machines(tmp_path, 3, stack)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"network namespaces are not allowed here: {error.stderr}")
        yield made


def write_study(folder: Path) -> None:
    (folder / "files.toml").write_text(STUDY)
    (folder / "figures.py").write_text(FIGURES)
    (folder / "rig.toml").write_text(mechanism_text("hexapod").replace('name = "hexapod"', 'name = "my rig"'))
    times = np.linspace(0.0, 2.0, 201)
    x, z = 5e-3 * np.sin(2.0 * np.pi * times) ** 2, 8e-3 * np.sin(np.pi * times) ** 2
    rows = [f"{t:.9g},{a:.9g},0,{c:.9g},1,0,0,0" for t, a, c in zip(times, x, z, strict=True)]
    (folder / "motion.csv").write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]))
    joints = np.random.default_rng(3).normal(0.0, 1e-5, (2, load_mechanism("hexapod").legs, 3))
    save_calibration(folder / "imus.toml", Calibration(joints=joints))


@pytest.fixture
def certificates(tmp_path: Path) -> Certificates:
    return make_certificates(tmp_path / "certificates")


def test_two_machines_that_share_nothing(machines: Machines, certificates: Certificates, tmp_path: Path) -> None:
    study = tmp_path / "0"
    write_study(study)
    address, page = "10.81.0.1:8786", "10.81.0.1:8787"
    with ExitStack() as stack:
        sweep = stack.enter_context(
            machines.run(
                0, *gough_sweep("files.toml", "--workers", 0, "--listen", address, "--dashboard", page, *certificates.options)
            )
        )
        wait_until(lambda: "dask worker" in sweep.text, "the scheduler listens")
        assert f"tls://{address}" in sweep.text
        # Without a certificate nobody gets in.
        with machines.run(1, *dask_worker(f"tcp://{address}", "--death-timeout", 3)) as stranger:
            assert stranger.wait() != 0
        for number in (1, 2):
            stack.enter_context(machines.run(number, *dask_worker(f"tls://{address}", *certificates.dask_options)))
        assert sweep.popen.wait(600.0) == 0, sweep.text
    table = pq.read_table(study / "files.results" / TABLE).to_pylist()
    assert len(table) == 24
    assert {row[STATUS] for row in table} == {DONE}
    assert {row["machine"] for row in table} == {1.0, 2.0}
    assert {row["strange"] for row in table} == {0.0}
    # The same as here, one by one.
    rig = mechanism_text("hexapod").partition("proportional = 60.0")
    for row in table[::7]:
        (tmp_path / "rig.toml").write_text(f"{rig[0]}proportional = {row['mechanism.control.proportional']}{rig[2]}")
        files = ["--mechanism", tmp_path / "rig.toml", "--target", study / "motion.csv", "--calibration", study / "imus.toml"]
        values = ["--imu", "mpu9150-calibrated", "--duration", 1, "--rate", 250, "--seed", row["run.seed"]]
        finished = gough("simulate", *files, *values, "--json", tmp_path / "run.json")
        assert finished.returncode == 0, finished.stderr
        figures = json.loads((tmp_path / "run.json").read_text())
        for part in ("estimation", "tracking", "estimated_tracking"):
            assert {name: row[f"{part}.{name}"] for name in figures[part]} == figures[part]
