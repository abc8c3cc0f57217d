"""The figures of benchmarks: shares, scores, and what is in gross excess, on made-up measurements."""

import numpy as np
import pytest

from hil.benchmarks import clock
from hil.benchmarks.clock import BUSY, IDLE, _Pool, _take_turns, count_bursts, durations_of, gross_excess
from hil.benchmarks.kinematics import _score
from hil.loop.records import RECORD
from hil.reports.benchmark import _sentence
from plant.pose import Pose, rotation_from_vector


def measured(compute=10.0, bare=9.0, overran=(0, 0), faults=0):
    figures = {"compute_us": {"p50": compute, "n": 900}, "bare_us": {"p50": bare, "n": 1100}}
    return figures | {"overran": dict(zip(("ours", "bare"), overran, strict=True)), "usage": {"major_faults": faults}}


@pytest.mark.parametrize(
    ("condition", "changes", "refused", "found"),
    [
        (IDLE, {}, [], []),
        (IDLE, {"compute": 100.0, "bare": 90.0}, [], []),
        (IDLE, {"compute": 101.0, "bare": 90.0}, [], ["computing takes 101 us"]),
        (BUSY, {"compute": 101.0, "bare": 90.0}, [], []),
        (BUSY, {"compute": 10.0, "bare": 0.5}, [], []),
        (BUSY, {"compute": 11.0, "bare": 0.5}, [], ["computing takes 11 times as long as a bare loop of the same work"]),
        (BUSY, {"compute": 91.0}, [], ["computing takes 10 times as long as a bare loop of the same work"]),
        # 0.45^8 is 1.7e-3, and 0.45^9 less than 1e-3.
        (IDLE, {"overran": (8, 0)}, [], []),
        (IDLE, {"overran": (9, 0)}, ["x"], ["ours overran 9 times, the bare loop 0"]),
        (BUSY, {"overran": (90, 100)}, [], []),
        (BUSY, {"overran": (0, 100)}, [], []),
        (BUSY, {"overran": (120, 80)}, [], ["ours overran 120 times, the bare loop 80"]),
        (IDLE, {"faults": 1}, [], ["1 major page faults in the loop"]),
        (IDLE, {"faults": 1}, ["locked memory"], []),
    ],
)
def test_only_what_no_noise_explains_is_in_excess(condition, changes, refused, found):
    figures = {"rates": {"500": {condition: measured(**changes)}}, "refused": refused}
    assert gross_excess(figures) == [f"500 Hz, {condition}: {text}" for text in found]


def test_durations_are_spread_evenly_over_their_microsecond():
    assert durations_of(np.array([0, 2, 0, 4])).tolist() == [1000, 1500, 3000, 3250, 3500, 3750]
    assert durations_of(np.zeros(5, np.int64)).tolist() == []


def test_all_loops_take_turns_for_their_shares_of_the_time(monkeypatch):
    monkeypatch.setattr(clock, "_SLICE_S", 2.0)
    turns, shares = [], []

    class Bench:
        def __init__(self, name):
            self.name = name

        def add_slice(self, condition):
            turns.append((condition, self.name))

    _take_turns([Bench("a"), Bench("b")], {IDLE: 1.0, BUSY: 0.1}, 6.0, shares.append)
    assert turns == [(IDLE, name) for name in "ababab"] + [(BUSY, name) for name in "ab"]
    assert shares == [(k + 1) / 8 for k in range(8)]


def test_a_pool_has_its_figures_under_their_names():
    pool, records = _Pool(), np.zeros(4, RECORD)
    records["late_ns"] = 3000
    records["stage_ns"] = 1000
    pool.timing.add(records)
    pool.counts.update({"missed_own": 1, "missed_host": 2, "major_faults": 3})
    pool.counts.update({"missed_own": 10, "missed_host": 20, "major_faults": 30})
    pool.bare.add(np.full(3, 50_000))
    pool.bare_wake.add(np.full(2, 70_000))
    pool.overran[:] = 7, 5
    figures = pool.figures()
    assert (figures["missed_own"], figures["missed_host"], figures["usage"]) == (11, 22, {"major_faults": 33})
    assert figures["overran"] == {"ours": 7, "bare": 5}
    greatest = {name: figures[f"{name}_us"]["max"] for name in ("compute", "latency", "wake", "bare", "bare_wake")}
    assert greatest == {"compute": 7.0, "latency": 8.0, "wake": 3.0, "bare": 50.0, "bare_wake": 70.0}
    assert (figures["bare_us"]["n"], figures["bare_wake_us"]["n"]) == (3, 2)
    assert figures["cyclictest_us"] is None and not {"compute", "wake", "latency"} & set(figures["stages_us"])
    pool.cyclictest.add(np.array([8000]))
    assert pool.figures()["cyclictest_us"]["max"] == 8.0
    said = _sentence(figures | {"latency_us": {"p50": 1.0, "p999": 2.0}, "compute_us": {"p50": 3.0, "p999": 4.0}})
    assert said == (
        "Computing p50 3.0 us, p99.9 4.0; wake-up to command p50 1.0, p99.9 2.0; missed by own work 11, by the host 22."
    )


def test_a_pose_is_found_within_a_micrometre_and_a_microradian():
    truth = [Pose(np.array([0.0, 0.0, k]), np.eye(3)) for k in range(8)]

    def off(k, metres=0.0, angle=0.0):
        return Pose(truth[k].position + [0.0, -metres, 0.0], rotation_from_vector([0.0, angle, 0.0]))

    found = [off(0), off(1, 0.9e-6), off(2, 0.0, 0.9e-6), off(3, 1.1e-6), off(4, 0.0, -1.1e-6), off(5, 0.1, 0.1), None, None]
    assert _score(found, truth) == {"success": 3 / 8, "wrong": 3 / 8}
    assert _score([None] * 8, truth) == {"success": 0.0, "wrong": 0.0}


def test_a_pause_that_spoils_many_cycles_counts_once():
    overran = np.zeros(4000, bool)
    assert count_bursts(overran, 4000.0) == 0
    overran[[100, 101, 102, 290, 1000, 1201, 3999]] = True
    assert count_bursts(overran, 4000.0) == 4
