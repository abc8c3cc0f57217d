"""The figures of a simulation: which pose is compared with which, and over which time."""

from types import SimpleNamespace

import numpy as np
import pytest

from controller.planning.target import load_target
from hil.loop.records import RECORD, STAGES
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationResult
from plant.mechanism import load_spatial
from plant.pose import quaternion_from_rotation, rotation_from_vector

CYCLES, HOLD = 60, 20
PLACES = {"truth": 0.0, "estimate": 1.0, "reference": -2.0, "target": 4.0}
"""Where each pose is from the true one [mm along x, 0.1 deg about z]; twice as far in one cycle, and far off in the hold."""


def poses(name):
    size = PLACES[name] * np.ones(CYCLES)
    size[HOLD + 5] *= 2.0
    size[:HOLD] *= 50.0
    rotations = np.array([rotation_from_vector([0.0, 0.0, np.radians(0.1 * each)]) for each in size])
    return np.outer(1e-3 * size, [1.0, 0.0, 0.0]), rotations


def made_up(known=True):
    records = np.zeros(CYCLES, RECORD)
    records["position"], records["rotation"] = poses("estimate")
    positions, rotations = poses("truth")
    records["truth"][:, :3] = positions
    records["truth"][:, 3:7] = [quaternion_from_rotation(each) for each in rotations]
    if not known:
        records["truth"] = np.nan
    # Each stage takes a microsecond times a power of two.
    records["stage_ns"] = 1000 * 2 ** np.arange(len(STAGES))
    times = (np.arange(CYCLES) - HOLD) / 1000.0
    mechanism = load_spatial("hexapod")
    target = load_target("hold", mechanism, 1.0)
    parts = SimulationConfig(), mechanism, target, SimpleNamespace(violations=3), times, records
    return SimulationResult(*parts, *poses("reference"), *poses("target"), 12.0, None, ())


def distances(first, second):
    """RMS and largest distance of two of the poses [mm]; the angles are a tenth of it [deg]."""
    apart = abs(PLACES[first] - PLACES[second])
    counted = CYCLES - HOLD
    return apart * np.sqrt((counted + 3.0) / counted), 2.0 * apart


@pytest.mark.parametrize("known", [True, False])
def test_every_figure_compares_its_own_two_poses_after_the_hold(known):
    result = made_up(known)
    summary = result.summary()
    groups = {"estimated_tracking": ("estimate", "reference", ""), "target": ("reference", "target", "reference_")}
    if known:
        groups |= {"estimation": ("estimate", "truth", ""), "tracking": ("truth", "reference", "")}
        rms, most = distances("truth", "target")
        assert summary["target"]["position_rms"] == pytest.approx(1e-3 * rms)
        assert summary["target"]["rotation_max"] == pytest.approx(np.radians(0.1 * most), rel=1e-6)
    else:
        assert summary["estimation"] is None and summary["tracking"] is None and "position_rms" not in summary["target"]
    for group, (first, second, prefix) in groups.items():
        rms, most = distances(first, second)
        found = [summary[group][f"{prefix}{name}"] for name in ("position_rms", "position_max", "rotation_rms", "rotation_max")]
        expected = [1e-3 * rms, 1e-3 * most, np.radians(0.1 * rms), np.radians(0.1 * most)]
        assert found == pytest.approx(expected, rel=1e-6), group
    assert (summary["truth_known"], summary["limits"], summary["real_time_factor"]) == (known, {"violations": 3}, 12.0)
    assert summary["target_stretch"] == 1.0
    # From the leg filters to the control: the second to the eighth stage.
    assert summary["cycle_us"] == pytest.approx(dict.fromkeys(("p50", "p99", "p999"), 254.0))


def test_figures_are_of_the_reference_as_far_as_it_is_a_pose():
    whole, result = made_up(), made_up()
    last = len(result.times) - 5
    result.reference_positions[last:], result.reference_rotations[last:] = np.nan, np.nan
    cut = {name: value[:last] for name, value in vars(whole).items() if isinstance(value, np.ndarray) and value.ndim}
    expected = SimulationResult(**vars(whole) | cut).summary()
    for group in ("tracking", "estimated_tracking"):
        assert result.summary()[group] == expected[group]
    assert result.summary()["estimation"] == whole.summary()["estimation"]


def test_a_run_has_moved_from_the_end_of_the_hold_on():
    result = made_up()
    assert result.moved
    for count, moved in ((HOLD + 1, True), (HOLD, False), (0, False)):
        assert SimulationResult(**vars(result) | {"times": result.times[:count]}).moved == moved
