"""The causes: what each leads to, how it reads, and the events of a cycle."""

import numpy as np
import pytest

from controller.cycle import react
from controller.safety.causes import EVENT_SLOTS, REACTION, Cause, Reaction
from tests.controller.safety.moving import moving

QUICK = {
    "EMERGENCY_STOP", "POSE_LOST", "NOT_FINITE", "IMPLAUSIBLE", "BUS_LOST", "DRIVE_FAULT", "DRIVE_OFF", "GYROSCOPES_SHARE",
    "ACCELEROMETERS_SHARE", "BASE_TURNS", "BASE_MOVES", "IMUS_CONTRADICT",
    "GYROSCOPES_CONTRADICT", "FORCES_SHARE", "NO_POSE_FITS", "STAGE_FAILED", "TWO_FORCES", "MOVES_AT_REST", "DRIFTS",
}  # fmt: skip
BRAKES = {"CLOCK_FAILED", "RIG_FAILED", "DRIVE_DEVIATES", "MOVED_OTHERWISE"}
ONLY_TOLD = {
    "NONE", "IMU_STALE", "IMU_FROZEN", "IMU_NOT_FINITE", "IMU_OUT_OF_RANGE", "IMU_NOISY", "IMU_DISAGREES", "IMU_BACK",
    "ANSWER_LATE", "ARMED", "SHAKEN", "BRIDGED", "CALM", "IMU_CONTRADICTED", "RIVAL_IMU", "RIVAL_GYROSCOPES",
    "RIVAL_ACCELEROMETERS", "RIVAL_BASE_TURNS", "RIVAL_BASE_MOVES", "GYROSCOPE_OFF", "FILTER_DISAGREES",
    "ENCODER_SILENT", "ENCODER_CONTRADICTED", "ENCODER_BACK", "UNJUDGED", "LEVEL_BEYOND", "GAINS_HALVED",
}  # fmt: skip


def test_each_cause_leads_to_what_is_specified():
    for cause in Cause:
        expected = Reaction.QUICK_STOP if cause.name in QUICK else Reaction.BRAKE if cause.name in BRAKES else Reaction.STOP
        expected = Reaction.GO_ON if cause.name in ONLY_TOLD else expected
        assert cause.reaction == expected, cause.name
        assert REACTION[cause] == expected
    assert len(Cause.__members__) == len(Cause), "two causes have the same number"
    assert Reaction.GO_ON < Reaction.STOP < Reaction.QUICK_STOP < Reaction.BRAKE
    assert [reaction.text for reaction in Reaction] == ["goes on", "controlled stop", "quick stop", "brakes at once"]


@pytest.mark.parametrize(
    ("cause", "given", "words"),
    [
        (Cause.TOO_FAST, (4, 0.6, 0.5), "leg 4 is too fast (0.6 m/s, the limit is 0.5 m/s)"),
        (Cause.TOO_FAST, (0, 0.123456, np.nan), "leg 0 is too fast (0.1235 m/s)"),
        (Cause.SATURATED, (5, 0.25, 0.25), "the command of leg 5 stays at its limit (0.25 s, the limit is 0.25 s)"),
        (Cause.RIG_FAILED, (-1, 3.0, np.nan), "the rig reports failure (3)"),
        (
            Cause.IMUS_DISAGREE,
            (6, 0.03, 0.02),
            "the IMUs contradict each other, the worst is IMU 6 (0.03 rad, the limit is 0.02 rad)",
        ),
        (Cause.IMUS_DISAGREE, (0, np.nan, 0.02), "the IMUs contradict each other, the worst is IMU 0"),
        (Cause.IMUS_DISAGREE, (-1, 0.03, 0.02), "the IMUs contradict each other (0.03 rad, the limit is 0.02 rad)"),
    ],
)
def test_an_event_reads_with_its_number_value_and_limit(cause, given, words):
    assert cause.describe(*given) == words


def test_a_short_text_names_no_leg():
    assert Cause.TOO_FAST.short == "leg is too fast"
    assert Cause.IMUS_DISAGREE.short == "the IMUs contradict each other"


def test_the_first_eight_events_of_a_cycle_are_kept_and_all_are_counted():
    _, parameters, state = moving()
    for n in range(11):
        react(parameters, state, Cause.ANSWER_LATE, n, 0.5 * n, 10.0 * n)
    events = state["safety"]["events"]
    assert events["count"] == 11 and EVENT_SLOTS == 8
    assert events["cause"].tolist() == 8 * [Cause.ANSWER_LATE]
    np.testing.assert_array_equal(events["index"], np.arange(8))
    np.testing.assert_array_equal(events["value"], 0.5 * np.arange(8))
    np.testing.assert_array_equal(events["limit"], 10.0 * np.arange(8))
