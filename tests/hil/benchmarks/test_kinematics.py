"""The benchmark of direct kinematics times what it says, and its cold starts are scored against the truth."""

import shutil

import numpy as np
import pytest

from hil.benchmarks import kinematics as kinematics_bench
from hil.benchmarks.kinematics import Yardstick, measure_kinematics
from plant.errors import ToolchainError
from plant.mechanism import load_spatial
from plant.mechanism.classification import spatial_classes
from tests.controller.leg_geometry import rotation_of


@pytest.mark.slow
def test_every_class_and_method_is_timed_and_cold_starts_are_ours(monkeypatch):
    few = {"_ROWS": 100, "_REPEATS": 1, "_ROUNDS": 3, "_BATCH_ROWS": 5000, "_MOTION_S": 0.2, "_COLD_STARTS": 60}
    for name, value in few.items():
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
    for label, methods in figures["newton_in_c"]["ratios"].items():
        assert set(methods) == set(figures["hexapod_us"] if label == "hexapod" else figures["solve_us"][label])
        assert all(0.0 < ratio < 1e3 for kinds in methods.values() for ratio in kinds.values())
    for preset, ranges in figures["cold_starts"].items():
        for where, scores in ranges.items():
            assert scores["directions"] == {"success": 1.0, "wrong": 0.0}, (preset, where)
            assert scores["newton"]["success"] + scores["newton"]["wrong"] <= 1.0
    assert figures["cold_starts"]["hexapod"]["wide"]["newton"]["wrong"] > 0.2


@pytest.mark.parametrize("preset", ["hexapod", "6-3-I", "genhexkins"])
def test_the_yardstick_in_c_finds_the_poses_of_its_motion_to_a_nanometre(preset):
    yardstick = Yardstick(load_spatial(preset))
    yardstick()
    np.testing.assert_allclose(yardstick.poses[:, :3], yardstick.positions, rtol=0.0, atol=1e-9)
    for angles, rotation in zip(yardstick.poses[:, 3:], yardstick.rotations, strict=True):
        about_x, about_y, about_z = map(rotation_of, np.diag(angles))
        np.testing.assert_allclose(about_z @ about_y @ about_x, rotation, rtol=0.0, atol=1e-8)
    # It moves: the pose before is a guess, not the solution.
    assert 2.0 <= yardstick.steps < 10.0


def test_without_a_c_compiler_there_is_no_yardstick(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(ToolchainError, match="no C compiler"):
        Yardstick(load_spatial("hexapod"))
