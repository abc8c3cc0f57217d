"""The times of the stages: which of them a sum contains, and what is over the budget."""

import numpy as np
import pytest

from hil.loop.records import RECORD, STAGES
from hil.loop.stage_times import Timing, budget, exceeded, over_budget


def test_sums_are_of_the_stages_that_they_name():
    records = np.zeros(1, RECORD)
    records["stage_ns"] = 1000 * 2 ** np.arange(10)
    records["late_ns"], records["round_trip_ns"] = 3_000_000, 5_000_000
    timing = Timing()
    timing.add(records)
    figures = timing.figures()
    assert {name: figures[name]["max"] for name in STAGES} == {
        "sense": 1.0, "leg filters": 2.0, "platform filter": 4.0, "direct kinematics": 8.0, "refinement": 16.0,
        "whole mechanism": 32.0, "integrity": 64.0, "control": 128.0, "record": 256.0, "plant": 512.0,
    }  # fmt: skip
    assert figures["compute"]["max"] == 2.0 + 4.0 + 8.0 + 16.0 + 32.0 + 64.0 + 128.0
    # From the wake-up to the command: neither the record nor a simulated plant delays that.
    assert figures["latency"]["max"] == 1.0 + 2.0 + 4.0 + 8.0 + 16.0 + 32.0 + 64.0 + 128.0
    assert (figures["wake"]["max"], figures["round trip"]["max"]) == (3000.0, 5000.0)
    assert {each["n"] for each in figures.values()} == {1}


def test_only_answered_exchanges_have_a_round_trip():
    records, timing = np.zeros(4, RECORD), Timing()
    timing.add(records)
    assert "round trip" not in timing.figures()
    records["round_trip_ns"] = [0, 800_000, 0, 600_000]
    timing.add(records)
    found = timing.figures()["round trip"]
    assert (found["n"], found["max"]) == (2, 800.0)
    assert timing.figures()["wake"]["n"] == 8


def of(value, n=10):
    return dict.fromkeys(("p50", "p99", "p999", "max"), value) | {"n": n}


def test_the_longer_filter_has_a_budget_of_its_own():
    figures = {name: of(0.1) for name in budget()}
    figures["whole mechanism"] = of(0.1) | {"p50": 15.9}
    assert over_budget(figures) == over_budget(figures, "whole") == ["whole mechanism p50 15.9 us, budget 8 us"]
    assert over_budget(figures, "whole-alignments") == []
    assert exceeded(figures | {"record": of(600.0)}) == {"whole mechanism": ["p50"], "record": ["p50", "p99", "p999", "max"]}


@pytest.mark.parametrize("stage", list(budget()))
def test_the_budget_holds_for_every_figure_of_a_stage(stage):
    figures = {name: of(0.1) for name in budget()}
    limits = budget()[stage]
    figures[stage] = {**limits, "n": 10}
    assert over_budget(figures) == []
    for name, limit in limits.items():
        figures[stage] = {**limits, name: limit + 0.1, "n": 10}
        assert over_budget(figures) == [f"{stage} {name} {limit + 0.1:.1f} us, budget {limit:g} us"]
        # On a bus, its round trip is part of `sense` and `latency`.
        on_bus = over_budget(figures | {"round trip": of(900.0)})
        assert bool(on_bus) == (stage not in ("sense", "latency"))
    figures[stage] = of(1e6, n=0)
    assert over_budget(figures) == []
