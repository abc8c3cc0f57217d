"""The fault matrix: every reaction is the one that is specified, and the table in the docs is of these cases."""

from itertools import dropwhile, takewhile
from pathlib import Path

import pytest

from controller.safety.causes import Cause, Reaction
from hil.command_line import main
from hil.faults.reactions import CASES, MOST_OFF_M, MOST_TURNED_RAD, Case, Outcome, pose_table, table, with_encoders
from hil.faults.trials import outcomes_of, run_trials, trials_of

DOCS = Path(__file__).parents[3] / "docs" / "faults.md"


def run_matrix(seeds, cases):
    return outcomes_of(cases, run_trials(trials_of(cases, range(seeds))))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.endurance)])
@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_the_reaction_is_the_specified_one(case, seed):
    (trial,) = trials_of((case,), [seed])
    (outcome,) = outcomes_of((case,), run_trials([trial]))
    assert outcome.findings == []
    assert sum(outcome.reactions.values()) == 1
    assert len(outcome.cycles) == (1 if case.expected else 0)


ENCODERS = with_encoders(CASES, "incremental")
OF_EACH_KIND = (
    "the platform's IMU is dead", "two IMUs are biased by 2 deg", "10 % of the packets are damaged", "a drive runs away",
    "the payload gains 5 kg", "20 periods are missed",
)  # fmt: skip
"""The others are endurance tests: together they take minutes."""


@pytest.mark.parametrize(
    "case",
    [
        each
        if each.name == "a leg's IMU is biased by 2 deg"
        else pytest.param(each, marks=pytest.mark.slow if each.name in OF_EACH_KIND else pytest.mark.endurance)
        for each in ENCODERS
    ],
    ids=[each.name for each in ENCODERS],
)
def test_with_encoders_the_pose_is_within_1_mm_and_0_3_deg_until_a_fault_is_told(case):
    outcomes = run_matrix(1, (case,))
    assert [outcome.fusion for outcome in outcomes] == ["compiled", "whole"]
    for outcome in outcomes:
        assert outcome.findings == []
        position, rotation = outcome.position_m[0], outcome.rotation_rad[0]
        assert position <= MOST_OFF_M and rotation <= MOST_TURNED_RAD
        # Nothing is exact while the loop steers, which it does not where it stops in the cycle of the fault.
        stopped = case.act is not None and case.reaction == Reaction.QUICK_STOP and case.followed
        assert stopped or (position > 1e-5 and rotation > 1e-5)


def test_with_encoders_an_error_before_a_fault_is_told_is_found():
    """Two encoders that lose counts at once move the pose by millimetres before that can be told."""
    lost = Case("lost", Cause.ENCODERS_CONTRADICT, Reaction.QUICK_STOP, 100, 9e-3, "encoder-jumps:{k}+{j},size_mm=2")
    findings = [finding for outcome in run_matrix(1, with_encoders([lost], "incremental")) for finding in outcome.findings]
    assert any("off before it was told, and 1 and 0.3 are allowed" in each for each in findings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "finding"),
    [
        (
            Case("frozen", Cause.IMU_FROZEN, Reaction.STOP, 15, 2e-3, "imu-frozen:2"),
            "ended for another cause: end of the motion",
        ),
        (
            Case("frozen", Cause.IMU_FROZEN, Reaction.GO_ON, 3, 2e-3, "imu-frozen:2"),
            "took 10 cycles, and 3 are allowed",
        ),
        (Case("frozen", Cause.IMU_FROZEN, Reaction.GO_ON, 15, 1e-5, "imu-frozen:2"), "mm off, and 0.01 are allowed"),
        (Case("nothing", Cause.IMU_FROZEN, Reaction.GO_ON, 15, 2e-3), "was not told"),
    ],
)
def test_what_is_not_as_specified_is_found(case, finding):
    (outcome,) = run_matrix(1, (case,))
    assert any(finding in each for each in outcome.findings)


def test_a_case_may_disturb_imus_over_the_bus():
    """A clock that is 1 % off, some vibration and 1 K are borne by any rig; a leg's IMU that turns by 5 deg is told."""
    borne = "imu-clock:{k},size_percent=1 imu-vibration:all,axis=x,size_g=0.05,sine_hz=97 imu-temperature:{j},size_k=1,ramp_s=1"
    cases = (
        Case("borne", Cause.NONE, Reaction.GO_ON, 0, 3e-3, borne),
        Case("turned", Cause.IMU_CONTRADICTED, Reaction.GO_ON, 600, 15e-3, "imu-turn:{k},axis=x,size_deg=5"),
    )
    for outcome in run_matrix(1, cases):
        assert outcome.findings == []


@pytest.mark.slow
def test_a_case_comes_out_the_same_every_time():
    first, again = (run_matrix(2, CASES[3:4])[0].summary() for _ in range(2))
    assert first == again


def test_the_table_in_the_docs_is_of_these_cases():
    lines = DOCS.read_text().splitlines()
    rows = list(takewhile(lambda line: line.startswith("|"), dropwhile(lambda line: not line.startswith("| case"), lines)))
    assert rows[:2] == table([]).markdown().splitlines()
    told = {case.name: Cause(case.expected).text.format("k") if case.expected else "-" for case in CASES}
    assert {row.split(" | ")[0][2:]: row.split(" | ")[1] for row in rows[2:]} == told
    for case, row in zip(CASES, rows[2:], strict=True):
        allowed = {Reaction(case.reaction).text, *(Reaction(Cause(each).reaction).text for each in case.also)}
        assert set(row.split(" | ")[2].split(", ")) <= allowed


def test_the_table_has_the_median_and_the_greatest_of_each_figure():
    case = Case("frozen", Cause.IMU_FROZEN, Reaction.GO_ON, 15, 2e-3)
    told = Outcome(case, {"goes on": 3}, [10, 12, 30], [1e-3, 2e-3, 6e-3], [0.0, 4e-3, 10e-3])
    rows = [[cell.text for cell in row] for row in table([told]).rows]
    assert rows == [["frozen", "IMU k is left out: it is frozen", "goes on", "12, 30", "2.00, 6.00", "4.0, 10.0"]]
    quiet = Outcome(Case("q", Cause.NONE, Reaction.GO_ON, 0, 2e-3), {"goes on": 1}, [], [5e-4], [0.0])
    assert [cell.text for cell in table([quiet]).rows[0]] == ["q", "-", "goes on", "-", "0.50, 0.50", "-"]


def test_the_table_with_encoders_has_the_fusions_side_by_side():
    case = Case("frozen", Cause.IMU_FROZEN, Reaction.GO_ON, 15, 2e-3)
    outcomes = [
        Outcome(case, {"goes on": 2}, [10, 12], [], [], [3e-4, 5e-4], [0.001, 0.002], fusion="compiled"),
        Outcome(case, {"goes on": 2}, [10, 10], [], [], [1e-4, 1e-4], [0.0005, 0.0005], fusion="whole"),
    ]
    rows = [[cell.text for cell in row] for row in pose_table(outcomes).rows]
    assert rows == [["frozen", "compiled / whole", "11, 12 / 10, 10", "0.40, 0.50 / 0.10, 0.10", "0.09, 0.11 / 0.03, 0.03"]]


@pytest.mark.slow
def test_the_command_prints_the_table_and_its_status_says_whether_all_is_well(capsys, tmp_path):
    emergency = ("--seeds", "1", "--only", "emergency", "--workers", "1")
    assert main(["faults", *emergency, "--markdown", "--json", str(tmp_path / "x.json")]) == 0
    assert "| an emergency stop is asked for | emergency stop | quick stop | 0, 0 |" in capsys.readouterr().out
    assert (tmp_path / "x.json").exists()
    assert main(["faults", "--only", "nothing like this"]) == 2
    assert main(["faults", "--seeds", "0"]) == 2
    assert main(["faults", *emergency, "--lengths", "incremental", "--markdown"]) == 0
    assert "| an emergency stop is asked for | compiled / whole | 0, 0 / 0, 0 |" in capsys.readouterr().out
    assert main(["faults", "--lengths", "none-such"]) == 2
    assert table([]).rows == []
