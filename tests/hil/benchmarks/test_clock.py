"""The benchmark of the loop on the clock measures what it says, and its check tells gross excess from noise."""

import copy
import json

import numpy as np
import pytest

from hil.benchmarks.clock import BUSY, CONDITIONS, IDLE, LOAD, durations_of, gross_excess, measure_real_time
from hil.benchmarks.loop import read_earlier
from hil.command_line import main
from hil.realtime.durations import Histogram
from hil.reports.benchmark import write_report
from plant.errors import InputError


@pytest.fixture(scope="module")
def figures():
    """One slice of each condition at one rate."""
    return {"machine": "m", "date": "2026-11-21", "version": "0", "real_time": measure_real_time({500.0: 2.0})}


@pytest.mark.endurance
def test_every_condition_of_a_rate_is_measured(figures):
    measured = figures["real_time"]
    assert json.loads(json.dumps(measured)) == measured
    for condition in CONDITIONS:
        if condition == LOAD and "stress-ng" in measured["missing"]:
            continue
        found = measured["rates"]["500"][condition]
        for name in ("compute_us", "latency_us", "wake_us", "bare_us"):
            assert 0.0 < found[name]["p50"] <= found[name]["p99"] <= found[name]["p999"] <= found[name]["max"] + 1.0
            assert found[name]["n"] >= 200
        assert found["compute_us"]["p50"] < found["latency_us"]["p50"]
        assert found["compute_us"]["n"] + found["missed_own"] + found["missed_host"] >= 1000
        assert (found["cyclictest_us"] is None) == ("cyclictest" in measured["missing"]) or measured["refused"]
        assert sum(found["histograms"]["wake"][1]) == found["wake_us"]["n"]
        # The bare loop is to compute for as long as ours.
        assert 0.3 < found["bare_us"]["p50"] / found["compute_us"]["p50"] < 3.0
    assert set(measured["rates"]["500"]) >= {IDLE, BUSY}


@pytest.mark.endurance
def test_the_check_passes_what_is_measured_and_fails_gross_excess(figures):
    measured = figures["real_time"]
    assert gross_excess(measured) == []

    def changed(**values):
        altered = copy.deepcopy(measured)
        altered["rates"]["500"][IDLE] |= values
        return gross_excess(altered)

    # The host of a virtual machine holds up a few cycles of either loop.
    assert changed(overran={"ours": 3, "bare": 0}) == changed(overran={"ours": 300, "bare": 290}) == []
    assert changed(overran={"ours": 30, "bare": 2}) == ["500 Hz, idle: ours overran 30 times, the bare loop 2"]
    slow = dict.fromkeys(("p50", "p99", "p999", "max"), 900.0) | {"n": 1000}
    assert any("computing takes 900 us" in text for text in changed(compute_us=slow))
    if not measured["refused"]:
        usage = measured["rates"]["500"][IDLE]["usage"]
        assert changed(usage={**usage, "major_faults": 2}) == ["500 Hz, idle: 2 major page faults in the loop"]


def test_quantiles_of_whole_microseconds_are_those_of_the_durations():
    durations = np.random.default_rng(2).lognormal(2.0, 1.0, 50_000)
    counts = np.bincount(durations.astype(np.int64), minlength=2000)
    histogram = Histogram()
    histogram.add(durations_of(counts))
    histogram.longest = 123_000_000
    found = histogram.figures()
    for name, percent in (("p50", 50.0), ("p99", 99.0), ("p999", 99.9)):
        assert found[name] == pytest.approx(np.percentile(durations, percent), rel=0.02)
    assert found["max"] == 123_000.0


@pytest.mark.endurance
def test_a_report_shows_histograms_and_earlier_figures(figures, tmp_path):
    earlier = tmp_path / "earlier.json"
    earlier.write_text(json.dumps({**figures, "date": "2026-11-01"}))
    path = tmp_path / "bench.html"
    write_report(figures, [read_earlier(earlier), {"date": "2026-11-02"}], path)
    text = path.read_text()
    assert "500 Hz, idle" in text and "3 runs, idle" in text
    for content in ("[]", "5", "{}", "none"):
        (tmp_path / "other.json").write_text(content)
        with pytest.raises(InputError, match="holds no"):
            read_earlier(tmp_path / "other.json")
    with pytest.raises(InputError, match="was not measured"):
        write_report({"machine": "m"}, [], path)


def test_a_bench_of_no_time_is_refused(capsys):
    for option, value in (("--clock", "0"), ("--panel", "0"), ("--measures", "-1"), ("--measures", "nan")):
        assert main(["bench", "--only", "clock", option, value]) == 2
        assert f"{option} is {value} s; it must be positive and finite" in capsys.readouterr().err
