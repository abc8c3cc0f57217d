"""Runs that a page starts, without a browser: what it offers and takes, and the process."""

import shutil
import threading
import time
from pathlib import Path

import pytest

from hil.command_line import main
from hil.panel.access import close_server, open_server
from hil.panel.page import NotBegunError, Page
from hil.panel.starting import RunForm, StartedRun
from hil.runs.config import SimulationConfig
from hil.runs.operator import Operator
from plant.errors import InputError
from tests.hil.ports import free_port

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def server():
    server = open_server("127.0.0.1", free_port(), None)
    yield server
    close_server(server)


def test_the_form_offers_presets_and_the_files_of_the_folder_and_takes_nothing_else(server, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "docs" / "limited_hexapod.toml", "mine.toml")
    Path("dwell.toml").write_text('[[elements]]\nkind = "dwell"\nduration = 1.0\n')
    Path("points.toml").write_text("[points.park]\nposition = [0.0, 0.0, -0.02]\n")
    Path("path.csv").write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n")
    assert main(["frames", "set", "cell.toml", "table", "--parent", "base", "--position", "0,0,0.1"]) == 0
    Path("measured.toml").write_text("[imu_0.accelerometer]\nbias = [0.1, 0.0, 0.0]\n")
    form = RunForm(server, lambda options: None)
    options = form.options()
    assert options[:6] == ["--mechanism", "hexapod", "--target", "operator", "--imu", "mpu9150-calibrated"]
    assert not {"--frames", "--calibration", "none"} & {*options}
    assert form.choices["--frames"][1] == ("none", "cell.toml")
    assert form.choices["--calibration"][1] == ("none", "measured.toml")
    assert "whole" in form.choices["--fusion"][1] and not {"filterpy", "section-5"} & {*form.choices["--fusion"][1]}
    mechanism, names = form.choices["--mechanism"]
    assert "planar-3rpr" in names and "mine.toml" in names and "dwell.toml" not in names and "points.toml" not in names
    target, names = form.choices["--target"]
    assert {"circle", "path.csv", "dwell.toml"} <= {*names} and not {"mine.toml", "points.toml", "stream"} & {*names}
    mechanism.value, target.value = "mine.toml", "circle"
    chosen = dict(zip(form.options()[::2], form.options()[1::2], strict=True))
    config = SimulationConfig(
        mechanism=chosen["--mechanism"], target=chosen["--target"], imu=chosen["--imu"],
        duration=float(chosen["--duration"]), rate=float(chosen["--rate"]),
    )  # fmt: skip
    assert config.mechanism == "mine.toml" and config.rig == "fmu"
    form.choices["--calibration"][0].value, form._seed.value, form._rate.value = "measured.toml", 7.0, 250.0
    again = RunForm(server, lambda options: None, form.options())
    assert again.options() == form.options() and {"measured.toml", "7", "250"} <= {*again.options()}
    form._duration.value = 50_000.0
    assert RunForm(server, lambda options: None, form.options())._duration.value == 36_000.0
    Path("measured.toml").unlink()
    assert "--calibration" not in RunForm(server, lambda options: None, form.options()).options()
    # As a browser might send it.
    target.value = "operator:0.0.0.0:1"
    with pytest.raises(InputError, match=r"there is no target 'operator:0\.0\.0\.0:1' to choose"):
        form.options()


@pytest.mark.parametrize(
    ("control", "value", "said"),
    [
        ("_duration", float("nan"), "the duration is nan s; it must be positive, and at most 1,000,000 s"),
        ("_duration", -1.0, "the duration is -1 s"),
        ("_rate", 1e9, "the rate is 1e\\+09 Hz; it must be 50 to 4000 Hz"),
        ("_rate", float("inf"), "the rate is inf Hz"),
        ("_seed", -1.0, "the seed is -1; it must be a whole number"),
        ("_seed", 0.5, "the seed is 0.5; it must be a whole number"),
        ("_seed", float("nan"), "the seed is nan; it must be a whole number"),
    ],
)
def test_numbers_that_no_run_can_have_are_refused_before_one_is_started(server, control, value, said):
    """A browser need not keep to what its controls offer."""
    form = RunForm(server, lambda options: None)
    getattr(form, control).value = value
    with pytest.raises(InputError, match=said):
        form.options()


@pytest.mark.slow
def test_a_run_that_cannot_begin_says_why(server, capfd):
    run = StartedRun(["--mechanism", "nothing"])
    while run.status is None:
        time.sleep(0.1)
    run.end()
    assert run.status not in (0, None) and "no mechanism 'nothing'" in "".join(run.words)
    assert "no mechanism 'nothing'" in capfd.readouterr().out
    page = Page(server, f"127.0.0.1:{free_port()}", None)
    with pytest.raises(NotBegunError, match="before it began"):
        page.run(threading.Event(), ["--mechanism", "nothing"])


@pytest.mark.slow(seconds=40)
def test_a_page_shows_its_run_and_ends_it_with_itself(server):
    address, over = f"127.0.0.1:{free_port()}", threading.Event()
    page = Page(server, address, None)
    shown = threading.Thread(target=page.run, args=(over, ["--mechanism", "planar-3rpr", "--most-missed", "100000"]))
    shown.start()
    try:
        for _ in range(300):
            try:
                with Operator(address, role="observer") as observer:
                    while observer.ask("state")["telemetry"]["mode"] != "running":
                        over.wait(0.2)
                    assert observer.run["target"] == "circle" and observer.margins()[0]["share"] > 0.0
                    break
            except OSError:
                over.wait(0.2)
        else:
            raise AssertionError("no run answers")
        with pytest.raises(InputError, match="a run is being started"):
            page.start([])
    finally:
        over.set()
        shown.join(60.0)
    assert not shown.is_alive()
    with pytest.raises(OSError, match="no run answers"):
        Operator(address, role="observer")
