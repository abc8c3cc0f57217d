"""Runs as labelled arrays: they are the records, all of them, with the right names, units and errors."""

import json
from dataclasses import replace

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from hil import RealTimeSettings, SimulationConfig, dataset, figures, frame, load_mechanism, run, simulate
from hil.loop.records import RECORD, STAGES
from hil.runs.dataset import VARIABLES
from plant.pose import rotation_angle, rotations_from_quaternions

CONFIG = SimulationConfig(target="circle", duration=0.5, rate=250.0)
NOT_KEPT = {"cycle", "event_count", "event_cause", "event_index", "event_value", "event_limit"}
"""The cycle is a coordinate, and the events are attributes in words."""


@pytest.fixture(scope="module")
def result():
    return simulate(CONFIG)


@pytest.fixture(scope="module")
def signals(result):
    return dataset(result)


def test_every_field_of_a_record_is_kept():
    """A field that changes changes a variable."""
    records = np.zeros(1, RECORD)
    records["rotation"] = np.eye(3)

    def values():
        return [np.asarray(each.values(records)).tobytes() for each in VARIABLES.values()]

    before = values()
    for name in {*RECORD.names} - NOT_KEPT:
        kept = records[name].copy()
        records[name] = kept[:, [1, 2, 0]] if name == "rotation" else kept + 1
        assert values() != before, name
        records[name] = kept


def test_the_signals_are_those_of_the_result(result, signals):
    sizes = {"time": len(result.times), "leg": 6, "imu": 7, "axis": 3, "component": 4, "coordinate": 6, "coordinate_": 6}
    assert signals.sizes == {**sizes, "stage": len(STAGES)}
    np.testing.assert_array_equal(signals.time, result.times)
    np.testing.assert_array_equal(signals.position, result.records["position"])
    np.testing.assert_array_equal(signals.command.sel(leg=3), result.records["command"][:, 3])
    np.testing.assert_array_equal(signals.angular_velocity.sel(imu=6, axis="z"), result.records["angular_velocity"][:, 6, 2])
    assert (signals.mode[0], signals.mode[-1]) == ("idle", "running") and signals.imu_used[-1].all()
    assert signals.length.attrs == {"units": "m", "long_name": "estimate"}
    rms = float(np.sqrt((signals.position_error.sel(time=slice(0.0, None)) ** 2).sum("axis").mean()))
    assert rms == pytest.approx(result.summary()["estimation"]["position_rms"], rel=1e-9)
    assert json.loads(signals.attrs["config"])["rate"] == 250.0 and signals.attrs["events"] == result.events


def test_quaternions_and_lengths_agree(result, signals):
    """Independent: the lengths of the true poses, by inverse kinematics."""
    rotations = rotations_from_quaternions(signals.true_quaternion.values)
    lengths = leg_lengths(load_mechanism("hexapod"), signals.true_position.values, rotations)
    np.testing.assert_allclose(signals.true_length, lengths, rtol=0.0, atol=1e-9)
    moving = signals.sel(time=slice(0.0, None))
    estimated = rotations_from_quaternions(moving.quaternion.values)
    off = rotation_angle(estimated, rotations_from_quaternions(moving.true_quaternion.values))
    np.testing.assert_allclose(np.linalg.norm(moving.rotation_error, axis=1), off, rtol=0.0, atol=1e-9)
    planned = rotations_from_quaternions(moving.reference_quaternion.values)
    lengths = leg_lengths(load_mechanism("hexapod"), moving.reference_position.values, planned)
    np.testing.assert_allclose(lengths, moving.reference_length, rtol=0.0, atol=1e-9)


def test_a_result_says_in_a_line_what_it_is(result):
    rms = 1e3 * result.summary()["estimation"]["position_rms"]
    assert repr(result) == f"<hexapod follows circle: {len(result.times)} cycles at 250 Hz, estimate - truth {rms:.3f} mm RMS>"


def test_a_frame_has_a_column_for_each_number(signals, result):
    table = frame(result)
    assert len(table) == len(result.times) and table.index.name == "time"
    np.testing.assert_array_equal(table["position_x"], signals.position.sel(axis="x"))
    np.testing.assert_array_equal(table["command_5"], signals.command.sel(leg=5))
    np.testing.assert_array_equal(table["specific_force_2_y"], signals.specific_force.sel(imu=2, axis="y"))
    np.testing.assert_array_equal(table["protection_position"], signals.protection_position)
    assert len(table.columns) == sum(int(np.prod(each.shape[1:])) for each in signals.data_vars.values())


def test_of_three_legs_three_are_there():
    signals = dataset(simulate(replace(CONFIG, mechanism="planar-3rpr", duration=0.1)))
    assert signals.sizes["leg"] == 3 and np.isfinite(signals.length).all() and np.isfinite(signals.target_position).all()


def test_the_figures_of_a_report_are_there_for_a_notebook(result):
    drawn = figures(result)
    assert list(drawn)[:4] == ["mechanism", "pose", "errors", "lengths"]
    assert len(drawn["mechanism"].frames) > 5 and drawn["errors"].data


@pytest.mark.slow
def test_a_recording_has_the_same_signals(tmp_path):
    path = tmp_path / "run.mcap"
    summary = run(replace(CONFIG, rate=100.0), RealTimeSettings(most_missed=1000), path)
    signals = dataset(path)
    assert len(signals.time) == summary["cycles"] and signals.attrs["mechanism"] == "hexapod"
    assert float(signals.time[1] - signals.time[0]) == pytest.approx(0.01) and float(signals.time[0]) < -0.19
    assert set(dataset([path]).data_vars) == set(signals.data_vars)
    assert set(signals.mode.sel(time=slice(0.0, 0.49)).values) == {"running"}
    on_the_way = signals.sel(time=slice(0.0, 0.49))
    assert float(abs(on_the_way.reference_position - on_the_way.true_position).max()) < 5e-3
    assert "reference_quaternion" in signals and "target_position" not in signals
