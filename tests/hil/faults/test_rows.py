"""The rows of disturbances: there are enough of every kind, each is read, and a seed makes a run of it."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hil.faults.rows import MOST_GUILTY, Row, all_rows, guilty_of, rows_of
from hil.rigs.emulation import fault
from hil.runs.config import SimulationConfig
from plant.errors import InputError
from plant.fmu.settings import Setting
from plant.mechanism import load_in_space

ROWS = {row.name: row for row in all_rows()}
ISSUE = (
    "all accelerometers +0.5 m/s2 along y within 10 s",
    "all accelerometers +0.5 m/s2 along z within 10 s",
    "all gyroscopes drift by 0.05 deg/s per second about x",
    "all gyroscopes drift by 0.5 deg/s per second about x",
    "the base tilts by 2 deg about x within 4 s",
    "the base tilts by 2 deg about x at once",
    "the base swings by 2 deg about x, period 4 s",
    "1 g at 999.9 Hz along z on all",
    "shocks of 2.9 g, 4 ms, 20 Hz along z on all",
    "a shock of 3.5 g, 4 ms along z on all",
    "the platform's IMU turns by 3 deg about z at once",
    "a leg's IMU turns by 3 deg about x at once",
    "the platform's IMU against one leg's, 1 deg each about x",
)
"""The lines of the table of issue 18 that are runs of the loop; the platform's filter by itself is `gough broad`."""


def test_there_are_the_issues_rows_and_sixty_more_of_every_kind():
    assert set(ISSUE) <= set(ROWS)
    assert len(ROWS) >= len(ISSUE) + 60
    kinds = {row.kind for row in ROWS.values()}
    assert kinds >= {
        "common-accelerometers", "common-gyroscopes", "single-sensors", "temperature-and-supply", "clocks", "vibration",
        "loosening", "base", "mechanism", "loads", "drives", "other-rates", "missed-periods", "buses",
    }  # fmt: skip
    assert {row.rate for row in ROWS.values()} >= {250.0, 500.0, 1000.0, 4000.0}
    assert {row.link for row in ROWS.values()} == {"fmu", "udp", "canopen"}
    words = {re.split(r"[:,]", text)[0] for row in ROWS.values() for text in row.faults}
    assert words >= {
        "imu-offset", "imu-scale", "imu-vibration", "imu-noise", "imu-range", "imu-turn", "imu-stuck", "imu-temperature",
        "imu-supply", "imu-clock", "imu-jitter", "base-tilt", "base-acceleration", "drive-stuck", "drive-unpowered",
    }  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_a_seed_makes_a_run_of_every_row(name):
    row = ROWS[name]
    drawn, again, other = (row.drawn(seed, "whole") for seed in (3, 3, 4))
    assert drawn == again
    assert drawn.config.seed == 3 and drawn.config.fusion == "whole"
    assert drawn.config.rate in row.draw.get("rate", [row.rate])
    assert drawn.begin == 0.0 or row.earliest <= drawn.begin <= row.latest < row.duration
    assert drawn.begin != other.begin or drawn.begin == 0.0
    for text in drawn.faults:
        assert "{" not in text
        # Behind a bus the emulated rig reads them, else the configuration has.
        fault(text)
    assert bool(drawn.config.faults) == bool(row.link == "fmu" and row.faults)
    assert all(each.at is None or drawn.begin <= each.at < row.duration for each in drawn.config.settings)


def test_what_begins_late_begins_at_the_time_that_is_judged():
    drawn = Row("x", "y", ("imu-turn:{k},axis=x,size_deg=1",), ("payload.mass=2@{at}", "gravity=0,0,-9@{at2}")).drawn(
        7, "whole"
    )
    assert f",at={drawn.begin:g}" in drawn.faults[0]
    assert [each.at for each in drawn.config.settings] == [drawn.begin, pytest.approx(drawn.begin + 2.0)]
    assert Row("x", "y", settings=("screw.backlash=1e-4",)).drawn(7, "whole").begin == 0.0


def test_the_begin_is_drawn_between_its_bounds_and_by_default_as_ever():
    bounded = Row("x", "y", ("imu-turn:{k},axis=x,size_deg=1",), earliest=7.0, latest=7.5)
    begins = [bounded.drawn(seed, "whole").begin for seed in range(100)]
    assert 7.0 <= min(begins) < 7.05 and 7.45 < max(begins) <= 7.5
    # Of one seed, both draw the same share of their time.
    usual = [replace(bounded, earliest=2.0, latest=5.0).drawn(seed, "whole").begin for seed in range(100)]
    np.testing.assert_allclose((np.array(usual) - 2.0) / 3.0, (np.array(begins) - 7.0) / 0.5, atol=2e-3)
    assert Row("x", "y", bounded.faults).drawn(3, "whole").begin == usual[3]
    assert replace(bounded, earliest=7.5).drawn(3, "whole").begin == 7.5


def test_legs_are_different_and_every_one_comes_up():
    row = Row("x", "y", ("imu-turn:{k},axis=x,size_deg=1", "imu-turn:{j},axis=x,size_deg=1", "imu-turn:{i},axis=x,size_deg=1"))
    guilty = [row.drawn(seed, "whole").guilty for seed in range(30)]
    assert all(len(each) == 3 for each in guilty)
    assert frozenset().union(*guilty) == {0, 1, 2, 3, 4, 5}


def test_a_plate_is_bent_and_a_joint_is_off_by_what_the_row_says():
    nominal = load_in_space("hexapod").base_joints
    for row in (Row("bent", "y", base_bend_mm=2.0), Row("off", "y", joint_off_mm=3.0)):
        (setting,) = row.drawn(1, "compiled").config.settings
        assert setting.name == "base_joints"
        moved = np.reshape(setting.value, (6, 3)) - nominal
        if row.base_bend_mm:
            angles = np.arctan2(nominal[:, 1], nominal[:, 0])
            np.testing.assert_allclose(moved, np.outer(2e-3 * np.cos(2.0 * angles), [0.0, 0.0, 1.0]), atol=1e-15)
        else:
            lengths = np.sort(np.linalg.norm(moved, axis=1))
            np.testing.assert_allclose(lengths, [0.0] * 5 + [3e-3], atol=1e-15)


def test_who_is_at_fault_is_who_has_a_disturbance_that_few_share():
    assert guilty_of(("imu-offset:all,axis=x,size_g=1",)) == frozenset()
    assert guilty_of(("imu-offset:legs,axis=x,size_g=1", "imu-turn:6,axis=x,size_deg=1")) == {6}
    assert guilty_of(("imu-turn:0+2+5,axis=x,size_deg=1",)) == {0, 2, 5} and MOST_GUILTY == 3
    assert guilty_of(("imu-dead:4,at=2", "base-tilt,axis=x,size_deg=1", "drive-stuck:1", "bus-down")) == {4}
    clocks = ROWS["every IMU on a clock of its own, up to 1 % off, with 0.02 ms of jitter"]
    assert clocks.drawn(0, "whole").guilty == frozenset()


def test_values_are_crossed_and_listed():
    entry = {
        "name": "{a} {b} {rate} {what}",
        "faults": ["imu-{what}:{k},axis={a},size_deg={b}"],
        "cross": {"rate": [250, 500]},
        "vary": {"a": ["x", "y"], "b": [1, 2]},
    }
    rows = rows_of({"kind": [{**entry, "vary": [{"a": "x", "b": 1, "what": "turn"}]}]})
    assert [row.name for row in rows] == ["x 1 250 turn", "x 1 500 turn"]
    assert rows[1] == Row("x 1 500 turn", "kind", ("imu-turn:{k},axis=x,size_deg=1",), rate=500.0)
    assert len(rows_of({"kind": [entry | {"name": "{a} {b} {rate}", "faults": []}]})) == 8


def test_every_seed_draws_a_size_and_a_choice_of_each_list():
    row = Row(
        "x", "y", ("imu-turn:{whom},axis={axis},size_deg={sign}{size}",), sizes=(0.5, 8.0),
        draw={"whom": ["{k}", "{k}+{j}", "6"], "axis": ["x", "y"], "rate": [250, 500], "mechanism": ["6-5", "hexapod"]},
    )  # fmt: skip
    drawn = [row.drawn(seed, "whole") for seed in range(200)]
    sizes = [abs(float(re.search("size_deg=([-0-9.]+)", each.faults[0]).group(1))) for each in drawn]
    assert 0.5 <= min(sizes) < 0.55 and 7.0 < max(sizes) <= 8.0
    # On a logarithmic scale, half of them are below the geometric mean.
    assert 70 < sum(size < 2.0 for size in sizes) < 130
    assert {(each.config.rate, each.config.mechanism) for each in drawn} == {
        (r, m) for r in (250, 500) for m in ("6-5", "hexapod")
    }
    assert {len(each.guilty) for each in drawn} == {1, 2} and any(each.guilty == {6} for each in drawn)
    assert drawn[7].what.startswith(drawn[7].faults[0]) and drawn[7].what.endswith(f" {drawn[7].config.rate:g} Hz")
    # What is drawn besides changes neither the begin nor the legs.
    fixed = Row("x", "y", ("imu-turn:{k},axis=x,size_deg=1",))
    assert [each.begin for each in drawn] == [fixed.drawn(seed, "whole").begin for seed in range(200)]


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"name": "a", "sizes": [0, 1]}, r"sizes = \[0, 1\] must be above 0, the smaller one first"),
        ({"name": "a", "sizes": [2, 1]}, r"sizes = \[2, 1\] must be above 0, the smaller one first"),
        ({"name": "a", "sizes": 3}, "sizes = 3 must be two numbers, such as"),
        ({"name": "a", "sizes": ["x", 1]}, "must be two numbers, such as"),
        ({"name": "a", "draw": ["x"]}, "must be a table of lists, such as"),
        ({"name": "a", "draw": {"axis": []}}, r"draw.axis = \[\] must be a list of values"),
        ({"name": "a", "draw": {"rate": ["fast"]}}, "rate = 'fast' must be a float"),
        (
            {"name": "a", "draw": {"duration": [9]}},
            "draw.duration: a seed cannot draw this entry; it can draw mechanism, target",
        ),
        ({"name": "a", "fault": []}, "has no entry 'fault'|knows no|unknown"),
        ({"name": "a", "link": "usb"}, "'a' has link = 'usb'; there are fmu, udp, canopen"),
        ({"name": "a", "rate": "{x}"}, "rate = '{x}' must be a float"),
        ({"name": "a", "vary": {"b": [1, 2]}}, "2 rows are called 'a'"),
        (
            {"name": "a", "earliest": -1},
            "'a' has earliest = -1 and latest = 5; its .* choose 0 <= earliest <= latest < duration = 20",
        ),
        ({"name": "a", "late_percent": -1}, "'a' has late_percent = -1; it must be 0 to 100"),
        ({"name": "a", "late_percent": "nan"}, "late_percent = nan"),
        ({"name": "a", "earliest": 6}, "earliest = 6 and latest = 5"),
        ({"name": "a", "latest": 9, "duration": 9}, "latest = 9; .* latest < duration = 9"),
        ({"name": "a {b}", "vary": {"b": [1], "latest": ["nan"]}}, "'a 1' has earliest = 2 and latest = nan"),
    ],
)
def test_a_wrong_entry_is_refused(entry, message):
    with pytest.raises(InputError, match=message):
        rows_of({"kind": [entry]})


def test_settings_and_configuration_are_those_of_the_command_line():
    row = ROWS["wind of 30 N"]
    assert [each.name for each in map(Setting.parse, (text.replace("{", "").split("@")[0] for text in row.settings))] == [
        "external_wrench.force"
    ] * 4
    assert isinstance(row.drawn(0, "whole").config, SimulationConfig)
