"""The benchmark of direct kinematics times what it says, and its cold starts are scored against the truth."""

import numpy as np

from hil.benchmarks import kinematics as kinematics_bench
from hil.benchmarks.kinematics import measure_kinematics
from plant.mechanism.classification import spatial_classes


def test_every_class_and_method_is_timed_and_cold_starts_are_ours(monkeypatch):
    for name, value in {"_ROWS": 100, "_REPEATS": 1, "_BATCH_ROWS": 5000, "_MOTION_S": 0.2, "_COLD_STARTS": 60}.items():
        monkeypatch.setattr(kinematics_bench, name, value)
    shares = []
    figures = measure_kinematics(shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert list(figures["solve_us"]) == [each.label for each in spatial_classes()]
    for each in spatial_classes():
        methods = figures["solve_us"][each.label]
        assert {"section-5", "up", "normal", "legs"} <= set(methods)
        assert ("section-3.1.1" in methods) == (each.group == "n-3-I")
        assert ("section-4" in methods) == (each.platform_count < 6)
        assert all(0.0 < us < 1e3 for times in methods.values() for us in times.values())
    ratios = figures["newton"]["ratios"]["legs"]
    assert np.isclose(ratios["refined"], figures["hexapod_us"]["legs"]["refined"] / figures["newton"]["warm_us"])
    for preset, ranges in figures["cold_starts"].items():
        for where, scores in ranges.items():
            assert scores["directions"] == {"success": 1.0, "wrong": 0.0}, (preset, where)
            assert scores["newton"]["success"] + scores["newton"]["wrong"] <= 1.0
    assert figures["cold_starts"]["hexapod"]["wide"]["newton"]["wrong"] > 0.2
