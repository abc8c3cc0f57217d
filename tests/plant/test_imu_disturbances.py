"""The words of what can happen to IMUs: the same in Python, in TOML and as text, and refused in one clear line."""

import tomllib
from math import inf, pi, radians, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from plant.errors import InputError, UnknownNameError
from plant.imu import disturbance_record
from plant.imu.disturbed import level
from plant.imu_disturbances import (
    WORDS,
    Course,
    DisturbanceKind,
    disturbance,
    disturbance_of_table,
    disturbance_of_text,
)

ALL = (0, 1, 2, 3, 4, 5, 6, 7)


@pytest.mark.parametrize(
    ("text", "kind", "imus", "sensor", "axis", "size", "course"),
    [
        ("imu-offset:all,axis=y,size_m_per_s2=0.5,ramp_s=10", "OFFSET", ALL, 1, (0, 1, 0), 0.5, (Course.RAMP, 10.0, inf)),
        ("imu-offset:6,axis=-x,size_deg_per_s=2", "OFFSET", (6,), 0, (-1, 0, 0), 2 * pi / 180, (Course.STEP, 0.0, inf)),
        ("imu-offset:3,axis=all,size_ut=4", "OFFSET", (3,), 2, (1, 1, 1), 4.0, (Course.STEP, 0.0, inf)),
        (
            "imu-scale:0+2+5,sensor=gyroscope,axis=z,size_percent=-3,settle_s=4",
            "SCALE", (0, 2, 5), 0, (0, 0, 1), -0.03, (Course.SETTLE, 4.0, inf),
        ),
        (
            "imu-vibration:legs,axis=0/3/-4,size_g=1,sine_hz=999.9",
            "VIBRATION", ALL[:6], 1, (0, 0.6, -0.8), 9.80665, (Course.SINE, 1 / 999.9, inf),
        ),
        (
            "imu-vibration:all,axis=z,size_g=3.5,pulse_ms=4,repeat_hz=20",
            "VIBRATION", ALL, 1, (0, 0, 1), 3.5 * 9.80665, (Course.PULSES, 0.004, 0.05),
        ),
        (
            "imu-vibration:1,axis=z,size_m_per_s2=3,pulse_ms=4,sensor=accelerometer",
            "VIBRATION", (1,), 1, (0, 0, 1), 3.0, (Course.PULSES, 0.004, inf),
        ),
        ("imu-noise:all,axis=x,size_g=0.3", "NOISE", ALL, 1, (1, 0, 0), 0.3 * 9.80665, (Course.STEP, 0.0, inf)),
        ("imu-range:all,size_deg_per_s=90", "RANGE", ALL, 0, (0, 0, 0), pi / 2, (Course.STEP, 0.0, inf)),
        ("imu-turn:6,axis=z,size_deg=3,ramp_s=60", "TURN", (6,), -1, (0, 0, 1), radians(3.0), (Course.RAMP, 60.0, inf)),
        ("imu-stuck:4,sensor=gyroscope,axis=x", "STUCK", (4,), 0, (1, 0, 0), 0.0, (Course.STEP, 0.0, inf)),
        ("imu-temperature:all,size_k=20,settle_s=90", "TEMPERATURE", ALL, -1, (0, 0, 0), 20.0, (Course.SETTLE, 90.0, inf)),
        ("imu-supply:all,size_v=-0.1", "SUPPLY", ALL, -1, (0, 0, 0), -0.1, (Course.STEP, 0.0, inf)),
        ("imu-clock:2,size_percent=-50", "CLOCK", (2,), -1, (0, 0, 0), -0.5, (Course.STEP, 0.0, inf)),
        ("imu-jitter:2,size_ms=0.2", "JITTER", (2,), -1, (0, 0, 0), 2e-4, (Course.STEP, 0.0, inf)),
    ],
)  # fmt: skip
def test_a_disturbance_is_the_same_as_text_in_python_and_in_toml(text, kind, imus, sensor, axis, size, course):
    made = disturbance_of_text(text)
    assert (made.kind, made.imus, made.sensor) == (DisturbanceKind[kind], imus, sensor)
    assert made.axis == pytest.approx(axis) and made.size == pytest.approx(size)
    assert (made.course, made.span, made.every) == pytest.approx(course)
    assert (made.begin, made.duration) == (-1.0, inf)
    # The same words in Python, and in a table.
    head, *options = text.split(",")
    name, _, which = head.partition(":")
    words = dict(option.split("=") for option in options)
    numbers = {word: float(value) if word not in ("axis", "sensor") else value for word, value in words.items()}
    assert disturbance(kind.lower(), imus=which, **numbers) == made
    lines = [f"{word} = {value!r}" for word, value in ({"kind": name.removeprefix("imu-"), "imus": which} | numbers).items()]
    assert disturbance_of_table(tomllib.loads("\n".join(lines))) == made
    # Lists of numbers do for texts.
    assert disturbance(kind.lower(), **numbers | {"imus": list(imus)} | ({"axis": axis} if any(axis[1:]) else {})) == (
        made if axis != (1, 1, 1) else disturbance(kind.lower(), imus=which, **numbers | {"axis": [1, 1, 1]})
    )


@given(st.floats(0.0, 1e6), st.floats(1e-3, 1e6))
def test_times_are_read_by_both_of_their_names(at, lasting):
    long, short = (f"imu-supply:all,size_v=1,{a}={at},{f}={lasting}" for a, f in (("at_s", "for_s"), ("at", "for")))
    made = disturbance_of_text(long)
    assert made == disturbance_of_text(short)
    assert (made.begin, made.duration) == (at, lasting)
    assert made.later(2.0).begin == at + 2.0
    assert disturbance("supply", imus="all", size_v=1.0).later(2.0).begin == -1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("imu-offset:all,axis=y", "needs one of size_deg_per_s, size_m_per_s2, size_g, size_ut, and it has none"),
        ("imu-offset:all,axis=y,size_g=1,size_m_per_s2=1", "and it has size_m_per_s2, size_g"),
        ("imu-offset:all,axis=y,size_percent=1", "has no entry 'size_percent'; it has imus, .*, size_ut"),
        (
            "imu-offset:all,size_g=1",
            "needs its axis: add x, -y, z, all, or a direction such as 0/0.89/-0.46, as in axis=z",
        ),
        ("imu-turn:all,size_deg=1", "needs its axis: add x, -y, z, or a direction"),
        ("imu-offset:all,size_g=1,axis=w", "has axis = 'w'"),
        ("imu-offset:all,size_g=1,axis=0/0/0", "has axis = '0/0/0'"),
        ("imu-offset:all,size_g=1,axis=1/nan/0", "has axis = '1/nan/0'"),
        ("imu-turn:all,size_deg=1,axis=all", "has axis = 'all'; it must be x, -y, z, or a direction"),
        (
            "imu-offset:all,size_g=1,axis=x,sensor=gyroscope",
            "sensor = 'gyroscope'; it must be accelerometer, which has that unit",
        ),
        ("imu-scale:all,size_percent=1,axis=x", "sensor = ''; it must be gyroscope or accelerometer or magnetometer"),
        ("imu-turn:8,size_deg=1,axis=x", "is for imus = '8'; there are 0 to 7"),
        ("imu-turn,size_deg=1,axis=x", "is for imus = None; there are 0 to 7"),
        ("imu-turn:x,size_deg=1,axis=x", "is for imus = 'x'"),
        ("imu-turn:1,size_deg=nan,axis=x", "has size_deg = 'nan'; it must be a finite number"),
        ("imu-turn:1,size_deg=big,axis=x", "has size_deg = 'big'; it must be a finite number"),
        ("imu-supply:1,size_v=1,ramp_s=1,sine_hz=3", "has ramp_s and sine_hz; it has one course, or none for a step"),
        ("imu-supply:1,size_v=1,repeat_hz=1", "has repeat_hz, which goes with pulse_ms"),
        ("imu-supply:1,size_v=1,sine_hz=0", "has sine_hz = 0; it must be positive, and at most 1e.06"),
        ("imu-supply:1,size_v=1,sine_hz=1e300", "has sine_hz = 1e.300; it must be positive, and at most 1e.06"),
        ("imu-supply:1,size_v=1,for=0", "has for_s = 0; it must be positive"),
        ("imu-supply:1,size_v=1,at=-5", "has at_s = -5; it must not be negative: leave it out for one from the start"),
        ("imu-supply:1,size_v=1,pulse_ms=30,repeat_hz=50", "has pulses of 30 ms every 20 ms: they must not overlap"),
        ("imu-clock:1,size_percent=-100", "a clock needs more than -100"),
        ("imu-jitter:1,size_ms=-1", "has size_ms = -1; it must not be negative"),
        ("imu-range:1,size_g=-2", "has size_g = -2; it must not be negative"),
        ("imu-range:1,size_g=2,axis=x", "has no entry 'axis'"),
        ("imu-supply:1,size_v", "'size_v' in 'imu-supply:1,size_v' is no word with a value"),
        ("imu-supply:1,size_v=1,at=1,at_s=2", "or comes twice"),
        ("imu-supply:1,size_v=1,imus=2", "the IMUs come twice in 'imu-supply:1,size_v=1,imus=2': 1 and 2"),
        ("imu-supply:1,size_v=1,kind=turn", "has no entry 'kind'"),
        ("imu-supply:1,size_v=1,=3", "has no entry ''"),
    ],
)
def test_what_is_wrong_is_told_with_the_remedy(text, message):
    with pytest.raises(InputError, match=message):
        disturbance_of_text(text)


def test_an_unknown_kind_is_told_with_those_that_there_are():
    with pytest.raises(
        UnknownNameError, match="there is no disturbance 'melted' of an IMU; there are offset, scale, vibration"
    ):
        disturbance_of_text("imu-melted:3")
    with pytest.raises(UnknownNameError, match="did you mean 'offset'"):
        disturbance_of_text("imu-ofset:3")
    with pytest.raises(InputError, match="needs its kind"):
        disturbance_of_table({"imus": "all"})


def test_a_direction_has_unit_length_whatever_is_given():
    assert disturbance("turn", imus=0, axis=[1, 1, 1], size_deg=1).axis == pytest.approx([1 / sqrt(3)] * 3)


def test_each_word_is_of_some_kind_and_every_kind_has_a_text():
    places = {word for kind in DisturbanceKind for word in kind.places}
    assert places <= set(WORDS)
    for kind in DisturbanceKind:
        assert kind.text and kind.label == "imu-" + kind.name.lower()


@pytest.mark.parametrize("course", ["", "ramp_s=2", "settle_s=0.1", "sine_hz=50", "pulse_ms=4,repeat_hz=50", "pulse_ms=20"])
def test_the_mean_square_is_that_of_the_sizes_over_time(course):
    made = disturbance_of_text(f"imu-vibration:all,axis=x,size_m_per_s2=-3,{course}".rstrip(","))
    record = disturbance_record(made)[()]
    sizes = [level(record, time) for time in 1000.0 + np.linspace(0.0, 0.2, 2000, endpoint=False)]
    assert made.mean_square == pytest.approx(np.mean(np.square(sizes)), rel=1e-6)
