"""The benchmark of the panel: its figures on made-up slices, and what it measures of real processes."""

import copy
import json
import os
import socket
import subprocess
import sys

import numpy as np
import pytest

from hil.benchmarks.panel import LIMITS, Slice, _process_at, figures_of, panel_excess
from hil.command_line import main
from hil.loop.records import COMPUTED, RECORD
from hil.reports.benchmark import write_report
from plant.errors import GoughError


def made_up(attached, compute_us, late_us, cycles=2000, own=0, host=0, panel=0.0, frames=0):
    """A slice in which one cycle in a hundred takes ten times as long, of 2 s."""
    records = np.zeros(cycles, RECORD)
    stages = len(range(*COMPUTED.indices(records["stage_ns"].shape[1])))
    records["stage_ns"][:, COMPUTED] = round(1e3 * compute_us / stages)
    records["late_ns"] = round(1e3 * late_us)
    records["stage_ns"][::100, COMPUTED] *= 10
    records["late_ns"][::100] *= 10
    records["cycle"] = np.arange(cycles)
    records["cpu_ns"] = records["stage_ns"].sum(axis=1)
    # The first cycle of each pair takes two periods; the second one has missed one. The host's were not busy all the time.
    for k in range(own + host):
        records["stage_ns"][10 + 2 * k] = 200_000
        records["cpu_ns"][10 + 2 * k] = 2_000_000 if k < own else 10_000
        records["missed"][11 + 2 * k] = 1
    return Slice(attached, records, 2.0, channel=0.2, panel=panel, stolen=0.01, frames=frames, received=1000 * frames)


def round_of(before=10.0, after=10.0, attached=10.0, **of_panel):
    of_panel = {"panel": 0.1, "frames": 60, **of_panel}
    return [made_up(False, before, 30.0), made_up(True, attached, 33.0, **of_panel), made_up(False, after, 30.0)]


def test_ratios_are_of_the_time_with_a_panel_over_the_time_without():
    figures = figures_of(round_of(attached=12.0) + round_of(attached=12.0))
    assert figures["ratios"]["compute"] == pytest.approx({"p50": 1.2, "p999": 1.2}, rel=1e-3)
    assert figures["ratios"]["wake"] == pytest.approx({"p50": 1.1, "p999": 1.1}, rel=1e-3)
    assert figures["noise"]["compute"] == figures["noise"]["wake"] == {"p50": 1.0, "p999": 1.0}
    attached, without = figures["with"], figures["without"]
    assert attached["compute_us"]["p50"] == pytest.approx(12.0, rel=1e-3) and attached["compute_us"]["n"] == 4000
    assert without["compute_us"]["n"] == 8000 and without["frames_hz"] == without["panel_cores"] == 0.0
    assert (attached["panel_cores"], attached["channel_cores"], attached["frames_hz"]) == pytest.approx((0.05, 0.1, 30.0))
    assert attached["bytes_per_s"] == pytest.approx(30_000.0) and attached["stolen_cores"] == pytest.approx(0.005)
    assert sum(attached["histograms"]["compute"][1]) == 4000


def test_noise_is_what_the_time_without_a_panel_differs_by():
    """With slices that take turns in being slow, some choices of signs are the same in most rounds."""
    figures = figures_of([each for _ in range(3) for each in round_of(before=10.0, after=15.0)])
    assert figures["noise"]["compute"]["p50"] == pytest.approx(1.5, rel=1e-3) and figures["noise"]["wake"]["p50"] == 1.0
    assert figures["ratios"]["compute"]["p999"] == pytest.approx(1.0 / 1.5, rel=1e-3)
    # Of many rounds, as many go up as down.
    assert figures_of(round_of() * 30)["noise"]["compute"]["p50"] == 1.0


def test_what_disturbs_a_few_rounds_is_not_the_panels_cost():
    good, slow = round_of(attached=11.0), round_of(attached=50.0)
    assert figures_of(good * 3 + slow * 2)["ratios"]["compute"]["p50"] == pytest.approx(1.1, rel=1e-3)
    assert figures_of(good * 2 + slow * 3)["ratios"]["compute"]["p50"] == pytest.approx(5.0, rel=1e-3)


def test_periods_count_as_missed_by_own_work_if_the_thread_was_busy():
    figures = figures_of(round_of(own=3, host=2))["with"]
    assert (figures["missed_own"], figures["missed_host"]) == (3, 2)
    assert [each["cycle"] for each in figures["overran"]] == [10, 12, 14]
    assert figures["overran"][0]["cpu_us"] == 2000.0 and set(figures["overran"][0]["stages_us"].values()) == {200.0}
    # Twice the thread was stopped for sure, and it works for 10 us of 1 ms.
    assert figures["stalled"] == pytest.approx(2 * 0.01 / 0.99, rel=0.01)


@pytest.mark.parametrize(
    ("own", "host", "told"),
    [
        (0, 5, []),
        (1, 0, ["1, limit 0: in 1 cycles, of which the host's stalls explain 0.0 at most"]),
        (9, 891, ["9, limit 0: in 9 cycles, of which the host's stalls explain 9.0 at most"]),
    ],
)
def test_one_period_that_own_work_missed_is_told_with_what_stalls_explain(own, host, told):
    """Of 900 stalls, 9 are expected to hit a thread that works for 10 us of 1 ms."""
    excess = panel_excess(figures_of(round_of(own=own, host=host)))
    assert [text for text in excess if "missed_own" in text] == [f"with a panel: missed_own {text}" for text in told]


def test_each_limit_that_is_exceeded_is_told():
    good = figures_of(round_of(attached=10.0) + round_of())
    good["ratios"] = {what: {"p50": 1.04, "p999": 1.19} for what in ("compute", "wake")}
    assert panel_excess(good) == []

    def told(where, **values):
        changed = copy.deepcopy(good)
        changed[where] |= values
        return panel_excess(changed)

    assert told("ratios", wake={"p50": 1.06, "p999": 1.0}) == ["with a panel: wake p50 1.06 times as long, limit 1.05"]
    assert told("ratios", compute={"p50": 1.0, "p999": 1.3}) == ["with a panel: compute p999 1.30 times as long, limit 1.2"]
    assert told("with", panel_cores=0.26) == ["with a panel: panel_cores 0.26, limit 0.25"]
    assert told("with", frames_hz=20.0) == [f"with a panel: frames_hz 20, at least {LIMITS['frames_hz']:g}"]


def test_the_process_that_serves_an_address_is_found():
    serve = (
        "import socket; s = socket.create_server(('127.0.0.1', 0)); print(s.getsockname()[1], flush=True); "
        "c = s.accept()[0]; c.send(b'.'); c.recv(1)"
    )
    with subprocess.Popen([sys.executable, "-c", serve], stdout=subprocess.PIPE, text=True) as server:
        address = f"127.0.0.1:{int(server.stdout.readline())}"
        with pytest.raises(GoughError, match=f"no process of this user serves {address}"):
            _process_at(address)
        with socket.create_connection(("127.0.0.1", int(address.rpartition(":")[2]))) as client:
            client.recv(1)
            assert _process_at(address) == server.pid != os.getpid()


def test_a_report_shows_histograms_without_and_with_a_panel(tmp_path):
    pytest.importorskip("plotly")
    panel = {"rate": 1000.0, "rounds": 1, "seconds": 2.0, **figures_of(round_of()), "refused": []}
    path = tmp_path / "bench.html"
    write_report({"machine": "m", "date": "2026-11-26", "version": "0", "panel": panel}, [], path)
    text = path.read_text()
    assert "without and with a panel: woken late" in text and "for 30.0 pictures a second" in text


@pytest.mark.slow(seconds=40)
def test_a_panel_at_a_run_is_measured(tmp_path, capsys):
    """The page gets what moves; the same figures are printed and written."""
    pytest.importorskip("viser")
    path = tmp_path / "bench.json"
    # A busy machine may end a run that misses too many periods.
    assert 0 in (main(["bench", "--only", "panel", "--panel", "2", "--json", str(path)]) for _ in range(3))
    figures = json.loads(path.read_text())["panel"]
    for which in ("without", "with"):
        found = figures[which]
        assert found["channel_cores"] > 0.0 and 0 < found["compute_us"]["p50"] < found["compute_us"]["max"]
        assert 1500 < found["compute_us"]["n"] + found["missed_own"] + found["missed_host"] < 2500
    assert figures["with"]["panel_cores"] > 0.0 and 3.0 < figures["with"]["frames_hz"] < 31.0
    assert figures["with"]["bytes_per_s"] > 100.0 * figures["with"]["frames_hz"]
    assert figures["without"]["panel_cores"] == figures["without"]["frames_hz"] == 0.0
    assert f"{figures['with']['panel_cores']:.3f}" in capsys.readouterr().out
