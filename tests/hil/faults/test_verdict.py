"""What the records of a run say, on records that are made up and whose figures are known."""

import json

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from hil.faults.rows import SOUND
from hil.faults.tables import (
    disturbance_table,
    disturbances_of,
    encoder_table,
    sound_of,
    sound_table,
    summary,
    worst_first,
)
from hil.faults.verdict import judge
from hil.loop.records import RECORD
from plant.pose import rotations_from_quaternions

RATE, CYCLES, BEGIN = 100.0, 400, 100


def records(protection=np.nan):
    """Four seconds, of which the last half second is on the brakes; the error grows by 1 mm and 0.1 deg a second."""
    made = np.zeros(CYCLES, RECORD)
    made["cycle"] = np.arange(CYCLES)
    times = np.arange(CYCLES) / RATE
    made["mode"] = Mode.RUNNING
    made["mode"][:20], made["mode"][350:] = Mode.IDLE, Mode.FAULT
    made["imus"] = 0x7F
    made["truth"][:, 3] = 1.0
    made["position"][:, 2] = 1e-3 * times
    turns = np.radians(0.1) * times
    made["rotation"] = np.eye(3)
    made["rotation"][:, 0, 0] = made["rotation"][:, 1, 1] = np.cos(turns)
    made["rotation"][:, 0, 1], made["rotation"][:, 1, 0] = -np.sin(turns), np.sin(turns)
    made["protection"] = protection
    return made


def tell(made, cycle, cause, index=-1):
    made["event_cause"][cycle, 0], made["event_index"][cycle, 0], made["event_count"][cycle] = cause, index, 1


def test_errors_are_told_apart_by_the_moment_at_which_something_is_told():
    made = records()
    tell(made, 20, Cause.ARMED)
    tell(made, 250, Cause.IMU_DISAGREES, 3)
    tell(made, 300, Cause.IMU_BACK, 3)
    found = judge(made, BEGIN, frozenset({3}), Cause.DRIVE_DEVIATES, RATE)
    assert (found["position_before"], found["position_after"]) == pytest.approx((2.5e-3, 3.49e-3))
    assert (found["rotation_before"], found["rotation_after"]) == pytest.approx((np.radians(0.25), np.radians(0.349)))
    assert (found["told"], found["told_imu"], found["told_s"]) == ("IMU is left out: it disagrees with the others", 3, 1.5)
    assert json.loads(found["events"]) == [[1.5, "IMU is left out: it disagrees with the others", 3]]
    assert (found["ended"], found["ended_s"], found["alarms"]) == ("drive does not do what it is told", 3.0, 0)
    assert found["cycles"] == 330 and not found["forbidden"] and "covered" not in found


def test_missed_periods_count_as_time():
    """Every second period is missed from the hundredth on: the begin and all times are those of the clock."""
    made = records()
    tell(made, 250, Cause.IMU_DISAGREES, 3)
    kept = np.r_[:100, 100:CYCLES:2]
    missing = made[kept].copy()
    missing["missed"] = np.diff(kept, prepend=-1) - 1
    found = judge(missing, 150, frozenset({3}), Cause.DRIVE_DEVIATES, RATE)
    assert (found["position_before"], found["position_after"]) == pytest.approx((2.5e-3, 3.48e-3))
    assert (found["told_s"], found["ended_s"], found["cycles"]) == (1.0, 2.49, 80 + 125)


def moving_exactly():
    """The platform goes at 20 mm/s and turns by 10 deg/s, and the estimate is right."""
    made = records()
    times = np.arange(CYCLES) / RATE
    made["truth"][:, 0] = made["position"][:, 0] = 0.02 * times
    half = np.radians(5.0) * times
    made["truth"][:, 3], made["truth"][:, 6] = np.cos(half), np.sin(half)
    made["rotation"] = rotations_from_quaternions(np.ascontiguousarray(made["truth"][:, 3:7]))
    made["position"][:, 2] = 0.0
    # On CAN nobody tells the currents.
    made["truth"][:, 13:] = np.nan
    return made


def test_while_the_rig_is_silent_the_platform_goes_on_at_its_last_speed():
    """The records then have the truth of the last answer."""
    made = moving_exactly()
    made["truth"][200:230] = made["truth"][199]
    made["silent"][200:230] = np.arange(1, 31)
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] < 1e-12 and found["rotation_before"] < 1e-6
    made["position"][215, 0] += 1e-3
    assert judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)["position_before"] == pytest.approx(1e-3)


@pytest.mark.parametrize("lost", [198, 199, 230, 231])
def test_frames_that_are_lost_just_before_or_after_the_silence_change_nothing(lost):
    made = moving_exactly()
    made["truth"][200:230] = made["truth"][199]
    made["silent"][200:230] = np.arange(1, 31)
    made["truth"][lost] = made["truth"][lost - 1]
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] < 1e-12 and found["rotation_before"] < 1e-6


@pytest.mark.parametrize("lost", [1, 2, 10])
def test_where_a_frame_with_the_truth_was_lost_the_platform_was_between_those_before_and_after(lost):
    made = moving_exactly()
    made["truth"][200 : 200 + lost] = made["truth"][199]
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] < 1e-12 and found["rotation_before"] < 1e-6


def test_where_the_truth_does_not_change_for_longer_the_platform_stands():
    made = moving_exactly()
    made["truth"][200:211] = made["truth"][199]
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] == pytest.approx(11 * 0.02 / RATE)
    assert found["rotation_before"] == pytest.approx(np.radians(11 * 10.0 / RATE))


def test_an_encoder_is_as_far_off_as_its_reading_changes_otherwise_than_its_length():
    made = records()
    made["truth"][:, 7:13] = 0.4 + 1e-3 * np.arange(CYCLES)[:, None] / RATE
    made["length"] = made["truth"][:, 7:13] - 0.3
    made["length"][BEGIN:, 2] -= 1e-5 * np.arange(CYCLES - BEGIN)
    tell(made, 180, Cause.ENCODER_CONTRADICTED, 2)
    of_run = {"kind": "encoders", "row": "a", "fusion": "whole", "seed": 0, "what": "b"}
    found = {**of_run, **judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)}
    assert found["encoder_off"] == pytest.approx(0.8e-3)
    (each,) = disturbances_of([found])
    assert each["late"] == 0
    assert [cell.text for cell in encoder_table([each]).rows[0]] == ["a", "whole", "0.80", "0.800", "0 of 1"]
    slow = {**found, "encoder_off": 1.2e-3}
    assert disturbances_of([slow])[0]["late"] == 1
    assert disturbances_of([{**slow, "told_s": 0.04}])[0]["late"] == 0
    made["length"] = np.nan
    assert judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)["encoder_off"] is None


def test_without_a_word_all_errors_are_silent():
    made = records()
    tell(made, 50, Cause.IMU_NOISY, 2)
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] == pytest.approx(3.49e-3)
    assert (found["position_after"], found["told"], found["told_s"]) == (None, "", None)
    assert found["alarms"] == 1


@pytest.mark.parametrize(
    ("imu", "guilty", "scale", "turn", "forbidden"),
    [
        (6, frozenset(), 2.0, 1.0, True),  # a sound one, and 6.98 mm
        (6, frozenset({6}), 2.0, 1.0, False),  # rightly
        (6, frozenset({2}), 1.4, 1.0, False),  # a sound one, but 4.9 mm
        (6, frozenset({2}), 1.0, 3.0, True),  # 1.05 deg
    ],
)
def test_a_sound_imu_that_is_left_out_is_forbidden_to_cost_more_than_5_mm_or_1_deg(imu, guilty, scale, turn, forbidden):
    made = records()
    made["position"] *= scale
    angle = turn * np.radians(0.1) * np.arange(CYCLES) / RATE
    made["rotation"][:, 0, 0] = made["rotation"][:, 1, 1] = np.cos(angle)
    made["rotation"][:, 0, 1], made["rotation"][:, 1, 0] = -np.sin(angle), np.sin(angle)
    # Out for a moment is out; before the disturbance begins is not what is asked.
    made["imus"][200:210] = 0x7F & ~(1 << imu)
    found = judge(made, BEGIN, guilty, Cause.END_OF_MOTION, RATE)
    assert found["forbidden"] is forbidden
    assert found["left_out"] == f"{imu}"
    assert found["sound_left_out"] == ("" if imu in guilty else f"{imu}")
    early = records()
    early["position"] *= 10.0
    early["imus"][:BEGIN] = 0x3F
    assert not judge(early, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)["forbidden"]


def test_an_error_before_the_sound_one_was_left_out_is_not_its_fault():
    made = records()
    made["position"] *= 2.0
    made["position"][300:] = 0.0
    made["imus"][320:] = 0x3F
    assert not judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)["forbidden"]
    made["position"][349] = 0.006, 0.0, 0.0
    assert judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)["forbidden"]


def test_an_estimate_that_is_no_number_is_infinitely_far_off_and_null_in_json():
    made = records()
    made["position"][200] = np.nan
    found = judge(made, BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["position_before"] == np.inf
    (each,) = disturbances_of([{"kind": "x", "row": "a", "fusion": "whole", "seed": 0, "what": "a", **found}])
    written = summary([], [each], [], [0])
    json.dumps(written, allow_nan=False)
    assert written["disturbances"][0]["seeds"][0]["position_before"] is None
    assert disturbance_table([each]).rows[0][1].text == "none"


def test_a_run_that_never_moves_has_no_errors():
    made = records()
    made["mode"] = Mode.IDLE
    tell(made, 150, Cause.NO_SENSORS, 1)
    found = judge(made, BEGIN, frozenset(), Cause.NO_SENSORS, RATE)
    assert found["position_before"] is found["position_after"] is found["deviation"] is None
    assert found["told_s"] == 0.5 and found["cycles"] == 0


def test_the_protection_level_is_judged_in_every_cycle_in_motion():
    levels = np.full((CYCLES, 2), (2e-3, 1.0))
    levels[300:310] = np.inf
    levels[310:315] = np.nan
    found = judge(records(levels), BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    # Cycles 20 to 200 are within 2 mm, and those without a bound are covered.
    assert found["covered"] == 181 + 10 and found["cycles"] == 330
    assert found["level_position"] == np.inf
    levels = np.full((CYCLES, 2), (1.0, np.radians(0.2)))
    found = judge(records(levels), BEGIN, frozenset(), Cause.END_OF_MOTION, RATE)
    assert found["covered"] == pytest.approx(181, abs=1) and found["level_position"] == 1.0


def test_runs_in_which_nothing_is_wrong_are_counted_and_their_errors_taken_together():
    quiet, loud, never = records(np.full((CYCLES, 2), (4e-3, 1.0))), records(np.full((CYCLES, 2), (8e-3, 1.0))), records()
    loud["position"] *= 2.0
    loud["imus"][300:320] = 0x3F
    tell(loud, 50, Cause.IMU_NOISY, 2)
    never["mode"] = Mode.IDLE
    ends = Cause.END_OF_MOTION, Cause.DRIVE_DEVIATES, Cause.NO_SENSORS
    found = [
        {"kind": kind, "row": "a", "fusion": "whole", "seed": 0, **judge(made, 0, frozenset(), end, RATE)}
        for made, end in zip((quiet, loud, never), ends, strict=True)
        for kind in (SOUND, "other")
    ]
    (each,) = sound_of(found)
    # A run that never moves is a false alarm as well.
    assert (each["runs"], each["told"], each["left_out"], each["ended"], each["seconds"]) == (3, 1, 1, 2, 12.0)
    # Errors of 0.2 to 3.49 mm, and twice as large ones.
    rms = np.sqrt(2.5 * np.mean((1e-5 * np.arange(20, 350)) ** 2))
    assert each["rms_position"] == pytest.approx(rms) and each["covered"] == 1.0
    assert each["level_position"] == pytest.approx(6e-3 / rms)
    (cells,) = sound_table([each]).rows
    assert [cell.text for cell in cells[:6]] == ["whole", "3", "0.00", "1", "1", "2"]
    (alone,) = sound_of([figures for figures in found if not figures["cycles"]])
    assert (alone["runs"], alone["ended"], alone["rms_position"], alone["covered"], alone["level_position"]) == (
        1,
        1,
        *3 * [None],
    )
    assert sound_table([alone]).rows[0][6].text == "-"
    lost = {**found[0], "rms_position": np.inf, "level_position": np.inf}
    json.dumps(summary([], [], sound_of([lost]), [0]), allow_nan=False)


def test_a_row_of_the_table_has_the_greatest_of_all_seeds_and_the_worst_come_first():
    figures = {
        "kind": "x", "row": "a", "fusion": "whole", "seed": 0, "what": "c",
        "position_before": 1e-3, "rotation_before": 0.01, "position_after": None,
        "rotation_after": None, "position_then": None, "rotation_then": None, "deviation": 1e-3, "told": "", "told_s": None,
        "alarms": 0, "ended": "end of the motion", "sound_left_out": "", "forbidden": False,
    }  # fmt: skip
    told = {"told": "the base turns", "told_s": 2.5, "position_before": 4e-3, "position_after": 9e-3, "ended": "the base turns"}
    found = [
        figures,
        {**figures, **told, "seed": 1},
        {**figures, **told, "seed": 2, "covered": 90, "cycles": 100},
        {**figures, "row": "b", "fusion": "compiled", "forbidden": True, "sound_left_out": "6"},
        {**figures, "row": "b", "position_before": 8e-3},
    ]
    made = disturbances_of([*found, {"kind": "reactions"}])
    assert made[0]["seeds"][1] == {"seed": 1, "what": "c", "position_before": 4e-3, "rotation_before": 0.01}
    assert [(each["row"], each["fusion"], each["forbidden"]) for each in worst_first(made)] == [
        ("b", "compiled", 1),
        ("b", "whole", 0),
        ("a", "whole", 0),
    ]
    rows = [[cell.text for cell in row] for row in disturbance_table(made).rows]
    assert rows[0] == ["a", "4.0", "0.57", "9.0", "-", "the base turns (2 of 3)", "2.5", "2", "0", "90.00"]
    assert rows[1] == ["b", "1.0 / 8.0", "0.57 / 0.57", "- / -", "- / -", "nothing", "- / -", "0 / 0", "1 / 0", "- / -"]
