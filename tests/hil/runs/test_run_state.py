"""What the supervisor sees of a run: its figures are those of all records, however they come."""

import numpy as np
import pytest

from controller.safety.causes import Cause
from hil.loop.records import LINK_SIZE, RECORD, Link
from hil.runs.run_state import RunState
from plant.pose import quaternion_from_rotation, rotation_from_vector

CYCLES, PERIOD_S = 60, 2e-3
DISTANCE_M, TRACKING_M, ANGLE_RAD = 3e-3, 2e-3, 0.02


@pytest.mark.parametrize("legs", [6, 3])
@pytest.mark.parametrize("portion", [1, 7, CYCLES])
def test_the_figures_are_those_of_the_cycles_and_legs_that_there_are(legs, portion):
    random = np.random.default_rng(legs)
    buffer, link, state = np.zeros(CYCLES + 1, RECORD), np.zeros(LINK_SIZE, np.int64), RunState(PERIOD_S)
    records = buffer[:CYCLES]
    records["cycle"] = np.arange(CYCLES)
    records["lengths"][:, :legs] = random.uniform(0.3, 0.5, (CYCLES, legs))
    records["reference"][:, :, 0] = records["lengths"]
    records["reference"][:, :legs, 0] += TRACKING_M * random.choice([-1.0, 1.0], (CYCLES, legs))
    away = random.normal(size=(CYCLES, 3))
    records["truth"][:, :3] = random.normal(size=(CYCLES, 3))
    records["position"] = records["truth"][:, :3] + DISTANCE_M * away / np.linalg.norm(away, axis=1, keepdims=True)
    true = [rotation_from_vector(vector) for vector in random.normal(size=(CYCLES, 3))]
    records["truth"][:, 3:7] = quaternion_from_rotation(np.array(true))
    records["rotation"] = [
        rotation_from_vector(ANGLE_RAD * axis / np.linalg.norm(axis)) @ each for axis, each in zip(away, true, strict=True)
    ]
    # A cycle without a pose has nothing to compare, one without a truth only its reference.
    records["status"][4], records["position"][4], records["lengths"][4] = 17, 5.0, 5.0
    records["truth"][10:15] = np.nan
    records["missed"][[2, 9]], records["silent"][[3, 30, 31]] = (1, 4), (1, 1, 2)
    records["refused"] = np.arange(CYCLES) // 20
    records["round_trip_ns"][::2], records["late_ns"] = 5000, 1000
    for head in (*range(portion, CYCLES, portion), CYCLES):
        link[Link.HEAD] = head
        assert state.update(buffer, link)
    assert not state.update(buffer, link)
    found = state.errors()
    assert found["tracking"] == pytest.approx(TRACKING_M, rel=1e-9)
    assert found["estimation"] == pytest.approx(DISTANCE_M, rel=1e-9)
    assert state.rotation_errors()["estimation"] == pytest.approx(ANGLE_RAD, rel=1e-9)
    assert found["known"] == CYCLES - 6
    assert (state.missed, state.late, state.refused_packets, state.latest["cycle"]) == (5, 3, 2, CYCLES - 1)
    figures = state.timing.figures()
    assert (figures["wake"]["n"], figures["round trip"]["n"]) == (CYCLES, CYCLES // 2)


def test_an_event_has_its_cycle_and_its_time():
    state, records = RunState(PERIOD_S), np.zeros(3, RECORD)
    records["cycle"] = 40, 41, 42
    records["status"], records["event_index"] = 17, -1
    records["event_value"] = records["event_limit"] = np.nan
    records["event_count"][1], records["event_cause"][1, 0] = 1, Cause.ARMED
    state.add(records)
    assert state.events == ["cycle 41 (0.082 s): armed"]
