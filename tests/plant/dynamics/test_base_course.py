"""Courses of a base's motion over time: kernels against differences, and against rotations that are put together."""

from math import inf

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from plant.compiled import Record
from plant.dynamics.base_course import (
    BASE_MOTION,
    BASE_SIZE,
    PULSES,
    SETTLE,
    SHAKE,
    SINE,
    STEADY,
    TILT,
    base_motion_at,
    level,
)
from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import derivatives, vector_of


def motions(*each: dict[str, object]) -> Record:
    made: Record = np.zeros(len(each), BASE_MOTION)
    for one, fields in zip(made, each, strict=True):
        one["begin"], one["end"], one["every"] = 0.0, inf, inf
        for name, value in fields.items():
            one[name] = value
    return made


def at(made: Record, time: float) -> Array:
    motion = np.zeros(BASE_SIZE)
    base_motion_at(made, len(made), time, motion)
    return motion


TILTS = motions(
    {"kind": TILT, "course": SINE, "axis": [0.6, 0.0, 0.8], "size": 0.4, "rise": 0.1, "span": 0.7},
    {"kind": TILT, "course": STEADY, "axis": [0.0, 1.0, 0.0], "size": -0.8, "rise": 0.5, "begin": 0.2, "end": 1.1},
    {"kind": TILT, "course": SETTLE, "axis": [1.0, 0.0, 0.0], "size": 1.5, "rise": 0.1, "span": 0.3, "begin": 0.3},
    {"kind": SHAKE, "course": SINE, "axis": [0.0, 0.0, 1.0], "size": 2.0, "rise": 0.1, "span": 0.2},
)


@pytest.mark.parametrize("time", [0.02, 0.05, 0.15, 0.31, 0.5, 0.9, 1.2, 1.65, 3.0])
def test_rates_are_derivatives_of_the_attitude(time: float) -> None:
    step = 1e-4
    samples = np.array([at(TILTS, time + i * step) for i in range(-3, 4)])
    turns = Rotation.from_rotvec(samples[:, :3]).as_matrix()
    rate = vector_of(turns[3].T @ derivatives(turns, step)[0])
    np.testing.assert_allclose(samples[3, 3:6], rate, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(samples[3, 6:9], derivatives(samples[:, 3:6], step)[0], rtol=0.0, atol=1e-6)


def test_small_and_large_angles_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    """On both sides of the angle where the formulas change, and at zero."""
    two = [
        {"kind": TILT, "course": SINE, "axis": axis, "size": 0.1, "span": span}
        for axis, span in (([1, 0, 0], 1), ([0, 1, 0], 1.7))
    ]
    made = motions(*two)
    times = np.linspace(1e-3, 0.12, 400)
    angles = np.array([at(made, t) for t in times])
    lengths = np.linalg.norm(angles[:, :3], axis=1)
    assert lengths.min() ** 2 < 1e-3 < lengths.max() ** 2
    smooth = np.diff(angles[:, 3:9], 3, axis=0)
    assert np.abs(smooth).max() < 1e-5


def test_a_step_and_a_ramp_come_and_go_smoothly() -> None:
    (ramp,) = motions({"kind": TILT, "course": STEADY, "axis": [1, 0, 0], "size": 2.0, "rise": 4.0, "begin": 1.0, "end": 7.0})
    times = np.linspace(0.0, 12.0, 12001)
    values, rates, changes = np.array([level(ramp, t) for t in times]).T
    np.testing.assert_allclose(np.gradient(values, times)[1:-1], rates[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(rates, times)[1:-1], changes[1:-1], atol=1e-3)
    assert values[0] == 0.0 and values[6000] == 2.0 and values[-1] == 0.0
    assert values[3000] == pytest.approx(1.0) and (np.diff(values[:5000]) >= 0.0).all()


def test_pulses_repeat_and_end() -> None:
    (pulses,) = motions(
        {"kind": SHAKE, "course": PULSES, "axis": [1, 0, 0], "size": 9.0, "span": 0.01, "every": 0.05, "end": 0.12}
    )
    assert level(pulses, 0.005)[0] == pytest.approx(9.0) == level(pulses, 0.105)[0]
    assert level(pulses, 0.03)[0] == 0.0 == level(pulses, 0.155)[0]
    assert at(np.array([pulses]), 0.005)[9:].tolist() == pytest.approx([9.0, 0.0, 0.0])
