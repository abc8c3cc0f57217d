"""Courses of a base's motion over time: words, and kernels against differences and against rotations that are put together."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from plant.compiled import Record
from plant.dynamics.base_course import (
    BASE_MOTION,
    BASE_SIZE,
    STEP_S,
    base_motion,
    base_motion_at,
    base_motion_of_text,
    displacements_of,
    level,
    placed,
)
from plant.errors import GoughError
from plant.pose import Array
from tests.plant.dynamics.explicit_bodies import derivatives, vector_of


def motions(*each: Record) -> Record:
    return np.array([placed(one, 0.0) for one in each], BASE_MOTION)


def at(made: Record, time: float) -> Array:
    motion = np.zeros(BASE_SIZE)
    base_motion_at(made, len(made), time, motion)
    return motion


TILTS = motions(
    base_motion("tilt", axis=[0.6, 0.0, 0.8], size_deg=23.0, at_s=0.0, sine_hz=1.4),
    base_motion("tilt", axis="-y", size_deg=46.0, at_s=0.2, for_s=0.9, ramp_s=0.5),
    base_motion("tilt", axis="x", size_deg=86.0, at_s=0.3, settle_s=0.3),
    base_motion("acceleration", axis="z", size_m_per_s2=2.0, sine_hz=5.0),
)


@pytest.mark.parametrize("time", [0.02, 0.05, 0.15, 0.31, 0.5, 0.9, 1.2, 1.65, 3.0])
def test_rates_are_derivatives_of_the_attitude(time: float) -> None:
    step = 1e-4
    samples = np.array([at(TILTS, time + i * step) for i in range(-3, 4)])
    turns = Rotation.from_rotvec(samples[:, :3]).as_matrix()
    rate = vector_of(turns[3].T @ derivatives(turns, step)[0])
    np.testing.assert_allclose(samples[3, 3:6], rate, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(samples[3, 6:9], derivatives(samples[:, 3:6], step)[0], rtol=0.0, atol=1e-5)


def test_small_and_large_angles_meet() -> None:
    """Through the angle where the formulas change, without a jump in rate or acceleration."""
    sines = (base_motion("tilt", axis=axis, size_deg=4.4, at_s=0.0, sine_hz=hz) for axis, hz in (("x", 0.5), ("y", 0.3)))
    made, times = motions(*sines), np.linspace(0.105, 0.16, 400)
    values = np.array([at(made, time) for time in times])
    squares = np.sum(values[:, :3] ** 2, axis=1)
    assert squares[0] < 1e-3 < squares[-1]
    assert np.abs(np.diff(values[:, 3:9], 3, axis=0)).max() < 1e-9


def test_a_ramp_comes_and_goes_smoothly() -> None:
    (ramp,) = motions(base_motion("acceleration", axis="x", size_m_per_s2=2.0, at_s=1.0, for_s=6.0, ramp_s=4.0))
    times = np.linspace(0.0, 12.0, 12001)
    values, rates, changes = np.array([level(ramp, t) for t in times]).T
    np.testing.assert_allclose(np.gradient(values, times)[1:-1], rates[1:-1], atol=1e-5)
    np.testing.assert_allclose(np.gradient(rates, times)[1:-1], changes[1:-1], atol=1e-3)
    assert values[0] == 0.0 and values[6000] == 2.0 and values[-1] == 0.0
    assert values[3000] == pytest.approx(1.0) and (np.diff(values[:5000]) >= 0.0).all()


def test_pulses_repeat_and_end() -> None:
    words = {"axis": "x", "size_m_per_s2": 9.0, "pulse_ms": 10.0, "repeat_hz": 20.0, "at_s": 0.0, "for_s": 0.12}
    (pulses,) = motions(base_motion("acceleration", **words))
    assert level(pulses, 0.005)[0] == pytest.approx(9.0) == level(pulses, 0.105)[0]
    assert level(pulses, 0.03)[0] == 0.0 == level(pulses, 0.155)[0]
    assert at(np.array([pulses]), 0.005)[9:].tolist() == pytest.approx([9.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("base-tilt,axis=x,size_deg=2,at=3,ramp_s=4", {"axis": "x", "size_deg": 2.0, "at_s": 3.0, "ramp_s": 4.0}),
        ("base-acceleration,axis=0/3/-4,size_g=0.5", {"axis": [0.0, 3.0, -4.0], "size_m_per_s2": 4.903325}),
        ("base-acceleration,axis=-z,size_g=1,pulse_ms=8,for=2", {"axis": "-z", "size_g": 1, "pulse_ms": 8.0, "for_s": 2.0}),
    ],
)
def test_words_and_text_make_the_same_motion(text: str, words: dict[str, Any]) -> None:
    assert base_motion_of_text(text) == base_motion(text.split(",")[0].removeprefix("base-"), **words)


def test_times_count_from_an_origin_or_from_the_start() -> None:
    texts = (
        "base-tilt,axis=x,size_deg=2,at=3,for=2",
        "base-tilt,axis=x,size_deg=2",
        "base-tilt,axis=x,size_deg=2,sine_hz=0.25",
    )
    later, always, swinging = np.array([placed(base_motion_of_text(text), 1.0) for text in texts], BASE_MOTION)
    assert level(later, 3.9)[0] == 0.0
    assert level(later, 4.0 + STEP_S)[0] == pytest.approx(np.radians(2.0)) == level(later, 5.9)[0]
    assert level(later, 6.0 + STEP_S)[0] == 0.0
    assert level(always, 0.0) == pytest.approx((np.radians(2.0), 0.0, 0.0))
    assert level(swinging, 1.0)[0] == pytest.approx(np.radians(2.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base-shift,axis=x,size_deg=2", "no motion 'shift' of a base; there are tilt, acceleration"),
        ("base-tild,axis=x,size_deg=2", "did you mean 'tilt'?"),
        ("base-tilt:3,axis=x,size_deg=2", "there is one base"),
        ("base-tilt,axis=x", "needs one of size_deg, and it has none"),
        ("base-tilt,axis=x,size_g=2", "size_g"),
        ("base-tilt,axis=all,size_deg=2", "axis = 'all'; it must be x, -y, z, or a direction"),
        ("base-tilt,size_deg=2", "needs its axis: add x, -y, z, or a direction such as .*, as in axis=z"),
        ("base-tilt,axis=x,size_deg=much", "size_deg = 'much'; it must be a finite number"),
        ("base-tilt,axis=x,size_deg=2,for=0", "for_s = 0; it must be positive"),
        ("base-tilt,axis=x,size_deg=2,at=-1", "at_s = -1; it must not be negative"),
        ("base-tilt,axis=x,size_deg=2,imus=3", "imus"),
        ("base-tilt,axis=x,size_deg=2,ramp_s=1,sine_hz=2", "it has one course"),
    ],
)
def test_what_is_no_motion_of_a_base_is_told(text: str, message: str) -> None:
    with pytest.raises(GoughError, match=message):
        base_motion_of_text(text)


def test_a_base_is_displaced_as_its_accelerations_say() -> None:
    """Along the axes of a base that leans; what it moves steadily, and where it began, is taken off."""
    times, lean = np.arange(0.0, 400.0, 0.02), np.radians(30.0)
    moves = [
        base_motion("acceleration", axis="z", size_m_per_s2=0.1, sine_hz=0.25),
        base_motion("tilt", axis="x", size_deg=30.0),
    ]
    found = displacements_of(list(motions(*moves)), times)
    waves = -0.1 / (0.5 * np.pi) ** 2 * np.sin(0.5 * np.pi * times)
    np.testing.assert_allclose(found, np.outer(waves, [0.0, -np.sin(lean), np.cos(lean)]), atol=2.5e-3)
    assert displacements_of(list(motions(*moves)), times[:1]).shape == (1, 3)
