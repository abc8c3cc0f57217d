"""Attribution: which IMU is left out or taken back, and what ends a run, by evidence that a test makes up."""

import numpy as np
import pytest

from controller.safety.arming import run_arming_checks
from controller.safety.attribution import exclude_imu, judge_evidence, judge_parity
from controller.safety.causes import Cause, Mode
from tests.controller.safety.moving import PERIOD_S, moving, stop_of, told

# ------------------------------------------------------------------------------------------- an IMU that contradicts the others

OFF = 0.03
LIMIT = np.radians(1.0)
LASTING = 21
"""Three looks at each of seven IMUs."""


def contradicted(worst, explained=10.0, others=1.0, **given):
    """A cycle in motion in which an IMU contradicts the others."""
    mechanism, parameters, state = moving(**given)
    monitor = state["safety"]["monitor"]
    monitor["explained"] = others
    monitor["explained"][worst] = explained
    monitor["squares"] = monitor["explained"]
    monitor["contradiction"][worst] = (0.0, 0.6 * OFF, -0.8 * OFF)
    return mechanism, parameters, state


def exclude(parameters, state, cycles=LASTING + 1, rest=6.5):
    """Run the check for some cycles; `rest` is the sum of squares that the other IMUs may leave."""
    p, s = parameters, state
    for _ in range(cycles):
        exclude_imu(
            p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], s["imus"][()], float(rest / LIMIT**2),
            s["reference"][()], s["pid"][()],
        )  # fmt: skip


@pytest.mark.parametrize("worst", [0, 3, 6])
def test_an_imu_that_contradicts_the_others_for_long_is_left_out_and_all_begin_anew(worst):
    _, parameters, state = contradicted(worst)
    exclude(parameters, state, LASTING - 1)
    assert told(state) == [] and not state["imus"]["excluded"].any()
    exclude(parameters, state, 2)
    assert state["imus"]["excluded"].tolist() == [k == worst for k in range(7)]
    assert told(state) == [Cause.IMU_DISAGREES]
    events, safety = state["safety"]["events"], state["safety"]
    assert (events["index"][0], events["value"][0]) == (worst, pytest.approx(OFF))
    assert events["limit"][0] == pytest.approx(LIMIT)
    assert safety["mode"] == Mode.RUNNING and safety["attribution"]["contradicted_for"] <= PERIOD_S
    for name in ("contradiction", "explained", "squares"):
        assert not safety["monitor"][name].any()


def test_a_contradiction_must_last_without_a_break():
    _, parameters, state = contradicted(2)
    contradiction = state["safety"]["monitor"]["contradiction"]
    for _ in range(4):
        exclude(parameters, state, LASTING - 2)
        contradiction[2] *= 0.5
        exclude(parameters, state, 1)
        assert state["safety"]["attribution"]["contradicted_for"] == 0.0
        contradiction[2] *= 2.0
    assert told(state) == []


@pytest.mark.parametrize(
    ("change", "excluded"),
    [
        ({"rest": 6.01}, True),
        ({"rest": 5.99}, False),
        ({"explained": 1.31, "rest": 100.0}, True),
        ({"explained": 1.29, "rest": 100.0}, False),
        ({"most_lost": 0}, False),
        ({"already": 0}, False),
        ({"already": 6}, False),
    ],
)
@pytest.mark.parametrize("preset", ["hexapod", "planar-3rpr"])
def test_an_imu_that_cannot_be_named_for_sure_is_a_stop(change, excluded, preset):
    worst = 1
    _, parameters, state = contradicted(worst, change.get("explained", 10.0), preset=preset)
    parameters["safety"]["watch"]["most_lost_imus"] = change.get("most_lost", 1)
    if "already" in change:
        state["imus"]["excluded"][change["already"]] = 1
    exclude(parameters, state, rest=change.get("rest", 6.5))
    assert bool(state["imus"]["excluded"][worst]) == excluded
    if not excluded:
        named = worst if preset == "hexapod" else -1
        assert stop_of(state) == (Cause.IMUS_DISAGREE, named, pytest.approx(OFF), pytest.approx(LIMIT))
        assert state["safety"]["mode"] == Mode.STOPPING


@pytest.mark.parametrize("mode", [Mode.IDLE, Mode.ARMED, Mode.STOPPING])
def test_only_in_motion_an_imu_is_left_out(mode):
    _, parameters, state = contradicted(4, mode=mode)
    exclude(parameters, state)
    assert told(state) == [] and not state["imus"]["excluded"].any()


# ------------------------------------------------------------------------------------------------------------- evidence


def judge(parameters, state):
    p, s = parameters, state
    return judge_evidence(
        p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], s["imus"][()], s["integrity"][()], s["reference"][()],
        s["pid"][()],
    )  # fmt: skip


@pytest.mark.parametrize("changes", [{}, {"limit": np.inf}, {"healthy": 0}, {"of_learned": 1}, {"evidence": 30.0}])
def test_an_imu_is_taken_back_by_evidence_of_what_it_reads_alone(changes):
    """Not without a limit, not while it gives nothing, and not by what was learned before."""
    _, parameters, state = moving()
    parameters["safety"]["watch"]["evidence"] = changes.get("limit", 64.0)
    state["imus"]["excluded"][3], state["imus"]["healthy"] = 1, changes.get("healthy", 1)
    evidence = state["integrity"]["evidence"]
    evidence["apart"], evidence["order"][0], evidence["apart_evidence"][0] = 1, 3, changes.get("evidence", 1.0)
    evidence["of_learned"] = changes.get("of_learned", 0)
    back = [judge(parameters, state) for _ in range(12)]
    assert back == ([False] * 5 + [True] + [False] * 6 if not changes else [False] * 12)
    assert int(state["imus"]["excluded"][3]) == (1 if changes else 0)


@pytest.mark.parametrize("mode", [Mode.RUNNING, Mode.STOPPING])
def test_contradicting_evidence_ends_a_motion_and_a_controlled_stop_and_says_the_cause_first(mode):
    _, parameters, state = moving(mode=mode)
    integrity = state["integrity"]
    integrity["best_evidence"] = integrity["imu_evidence"] = integrity["all_evidence"] = 200.0
    integrity["blamed"], integrity["rival_blamed"], integrity["rival_evidence"] = 2, 4, 190.0
    assert not judge(parameters, state)
    assert stop_of(state) == (Cause.IMUS_CONTRADICT, 2, pytest.approx(np.sqrt(200.0)), pytest.approx(8.0))
    assert told(state) == [Cause.IMUS_CONTRADICT, Cause.RIVAL_IMU]


def weigh(state, imu, evidence, in_all, rival=0.0, platform=0.0, misfit=0.51):
    """Let an evaluation have found evidence in sigma: against an IMU, for faults of any kind, for something else, and against
    the platform's IMU if that is another one, where the closed form fits badly.
    """
    integrity = state["integrity"]
    integrity["platform_evidence"] = evidence**2 if imu == 6 else platform**2
    integrity["best_evidence"] = integrity["imu_evidence"] = evidence**2
    integrity["blamed"], integrity["all_evidence"] = imu, in_all**2
    integrity["rival_blamed"], integrity["rival_evidence"] = -1, rival**2
    integrity["protection"]["misfit"] = misfit


def rival_of(state):
    """IMU and evidence of the last event."""
    events = state["safety"]["events"]
    last = int(events["count"]) - 1
    return int(events["index"][last]), float(events["value"][last])


def evaluations_until_a_stop(parameters, state, most=30):
    for n in range(1, most):
        assert not judge(parameters, state)
        if state["safety"]["stop"]["cause"] != Cause.NONE:
            return n
    return None


@pytest.mark.parametrize(("in_all", "evaluations", "expected"), [(9.7, 20, None), (9.9, 20, 3), (9.9, 18, None)])
def test_three_evaluations_that_no_single_imu_explains_end_a_motion_below_the_limit(in_all, evaluations, expected):
    """With 6 of 8 sigma against IMU 2, the limit is the root of 0.75 x 64 and 0.35 x 36. The first two seconds do not count."""
    _, parameters, state = moving()
    state["integrity"]["evaluations"] = evaluations
    weigh(state, 2, 6.0, in_all)
    assert evaluations_until_a_stop(parameters, state) == expected
    if expected:
        left = np.sqrt(in_all**2 - 36.0)
        assert stop_of(state) == (Cause.IMUS_CONTRADICT, 2, pytest.approx(left), pytest.approx(np.sqrt(48.0 + 12.6)))


def test_unexplained_evidence_must_come_in_evaluations_in_a_row_of_recent_readings():
    _, parameters, state = moving()
    state["integrity"]["evaluations"] = 20
    for n in range(20):
        weigh(state, 2, 6.0, 12.0 if n % 2 else 7.0)
        assert evaluations_until_a_stop(parameters, state, 2) is None
    state["integrity"]["evidence"]["of_learned"] = 1
    weigh(state, 2, 6.0, 12.0)
    assert evaluations_until_a_stop(parameters, state) is None
    parameters["safety"]["watch"]["evidence"] = np.inf
    state["integrity"]["evidence"]["of_learned"] = 0
    assert evaluations_until_a_stop(parameters, state) is None


@pytest.mark.parametrize(
    ("imu", "needed", "evidence", "platform", "expected"),
    [(6, 1, 4.3, 0.0, 4), (6, 1, 5.5, 0.0, 2), (6, 1, 2.6, 0.0, None), (6, 0, 4.3, 0.0, None), (3, 1, 5.5, 4.1, 4),
     (3, 1, 6.0, 4.1, None), (-1, 1, 4.5, 4.1, 4)],
)  # fmt: skip
def test_evidence_that_adds_up_against_the_platforms_imu_ends_a_motion(imu, needed, evidence, platform, expected):
    """What is beyond 2.7 of 8 sigma, up to 5. The run may go on without that IMU only if the settings allow it. Evidence that
    is less than half of the most (as a square) does not count.
    """
    _, parameters, state = moving()
    if not needed:
        parameters["safety"]["watch"]["without_platform_imu"] = np.inf
    weigh(state, imu, evidence, 7.0, platform=platform)
    # The first two seconds do not count.
    state["integrity"]["evaluations"] = 19
    assert evaluations_until_a_stop(parameters, state) is None
    state["integrity"]["evaluations"] = 20
    assert evaluations_until_a_stop(parameters, state) == expected
    if expected:
        added = expected * ((platform or evidence) - 2.7)
        assert stop_of(state) == (Cause.IMUS_CONTRADICT, 6, pytest.approx(added), pytest.approx(5.0))
        rival = [] if imu == 6 else [Cause.RIVAL_IMU if imu == 3 else Cause.RIVAL_GYROSCOPES]
        assert told(state) == [Cause.IMUS_CONTRADICT, *rival]


@pytest.mark.parametrize("shared", range(4))
@pytest.mark.parametrize(
    ("imu", "evidence", "rival", "expected"),
    [(-1, 4.0, 0.0, 7), (-1, 5.5, 0.0, 3), (-1, 2.9, 0.0, None), (2, 5.0, 4.0, 7), (2, 7.0, 4.0, None)],
)
def test_evidence_that_adds_up_for_an_error_that_all_share_ends_a_motion(imu, evidence, rival, expected, shared):
    """What is beyond 3 of 8 sigma, up to 7; also if an IMU has more evidence, but not more than twice as much (as a square)."""
    _, parameters, state = moving()
    integrity = state["integrity"]
    integrity["shared"], integrity["rival_shared"] = (shared, -2) if imu < 0 else (-2, shared)
    weigh(state, imu, evidence, 7.0, rival=rival)
    integrity["evaluations"] = 19
    assert evaluations_until_a_stop(parameters, state) is None
    integrity["evaluations"] = 20
    assert evaluations_until_a_stop(parameters, state) == expected
    if expected:
        added = expected * ((rival or evidence) - 3.0)
        assert stop_of(state) == (Cause.GYROSCOPES_SHARE + shared, -1, pytest.approx(added), pytest.approx(7.0))
        assert told(state)[1:] == ([] if imu < 0 else [Cause.RIVAL_IMU])


@pytest.mark.parametrize(("misfit", "evidence", "expected"), [(0.51, 3.4, 8), (0.49, 3.4, None), (0.49, 4.0, 10)])
def test_where_the_closed_form_fits_more_evidence_against_the_platforms_imu_is_usual(misfit, evidence, expected):
    """There, what is beyond 3.5 of 8 sigma adds up, to 5: play and joints that are off by 0.1 mm hardly raise the misfit."""
    _, parameters, state = moving()
    state["integrity"]["evaluations"] = 20
    weigh(state, 6, evidence, 7.0, misfit=misfit)
    assert evaluations_until_a_stop(parameters, state) == expected


@pytest.mark.parametrize(("between", "expected"), [(0.6, None), (1.5, 10), (None, 4)])
def test_less_evidence_against_the_platforms_imu_takes_off_from_the_sum(between, expected):
    """Evaluations with 4.6 and less sigma take turns; what was learned does not count."""
    _, parameters, state = moving()
    state["integrity"]["evaluations"] = 20
    ended = None
    for n in range(40):
        high = n % 2 == 0
        state["integrity"]["evidence"]["of_learned"] = int(not high and between is None)
        found = 4.6 if high else between or 0.0
        weigh(state, 6, found, 7.0)
        judge(parameters, state)
        if state["safety"]["stop"]["cause"] != Cause.NONE:
            ended = n
            break
    assert ended == expected


def test_a_sum_that_ends_a_motion_does_so_beside_more_evidence_that_names_no_imu_clearly():
    """Without the sum, more evidence would be awaited: something else explains the readings as well."""
    _, parameters, state = moving()
    state["integrity"]["evaluations"] = 20
    weigh(state, 2, 8.5, 9.0, rival=8.4, platform=6.2)
    assert evaluations_until_a_stop(parameters, state) == 2
    assert stop_of(state) == (Cause.IMUS_CONTRADICT, 6, pytest.approx(7.0), pytest.approx(5.0))
    assert rival_of(state) == (2, pytest.approx(8.5))
    assert told(state) == [Cause.IMUS_CONTRADICT, Cause.RIVAL_IMU]


def test_a_sum_that_grew_on_the_brakes_delays_arming_by_a_limited_time():
    """It is kept below twice its limit, and 2 sigma take off 0.7 each time."""
    _, parameters, state = moving(mode=Mode.IDLE)
    found = state["safety"]["attribution"]
    state["integrity"]["evaluations"] = 20
    weigh(state, 3, 9.0, 9.0, platform=8.0)
    for _ in range(100):
        assert not judge(parameters, state)
    assert found["lasting"][1] == pytest.approx(25.0) and found["lasting_imu"] == 6 and told(state) == []
    weigh(state, 6, 2.0, 2.0)
    lasted = 0
    while found["lasting"][1] > 0.0:
        judge(parameters, state)
        lasted += 1
    assert lasted == 8


LEAST_EVIDENCE = pytest.mark.parametrize(
    ("imu", "evidence", "changes", "limit"),
    [
        (-1, 5.7, {}, np.sqrt(32.0)),
        (-1, 5.6, {}, None),
        (6, 5.7, {}, np.sqrt(32.0)),
        (2, 7.9, {}, None),
        (-1, 6.6, {"evaluations": 19}, None),
        (-1, 7.9, {"of_learned": 1}, None),
        (-1, 8.1, {"of_learned": 1, "evaluations": 19}, 8.0),
        (-1, 20.0, {"limit": np.inf}, None),
    ],
)
"""All share the error, or it is the platform's: the root of half of 64, in recent readings, after the first two seconds."""


def with_evidence(mode, imu, evidence, changes):
    """A cycle in which an evaluation has just found it, of the 20th or so on."""
    _, parameters, state = moving(mode=mode)
    parameters["safety"]["watch"]["evidence"] = changes.get("limit", 64.0)
    integrity = state["integrity"]
    integrity["evaluations"] = changes.get("evaluations", 20)
    integrity["evidence"]["of_learned"] = changes.get("of_learned", 0)
    integrity["fresh"], integrity["shared"] = 1, 0
    weigh(state, imu, evidence, evidence)
    return parameters, state


@LEAST_EVIDENCE
def test_less_evidence_ends_a_motion_where_no_imu_could_be_left_out(imu, evidence, changes, limit):
    parameters, state = with_evidence(Mode.RUNNING, imu, evidence, changes)
    # More evaluations would add up.
    assert evaluations_until_a_stop(parameters, state, 3) == (1 if limit else None)
    if limit:
        cause = Cause.GYROSCOPES_SHARE if imu < 0 else Cause.IMUS_CONTRADICT
        assert stop_of(state) == (cause, imu, pytest.approx(evidence), pytest.approx(limit))


@LEAST_EVIDENCE
def test_evidence_that_would_end_a_motion_prevents_arming(imu, evidence, changes, limit):
    parameters, state = with_evidence(Mode.IDLE, imu, evidence, changes)
    assert obstacle_after_evidence(parameters, state)[0] == (Cause.NOT_STILL if limit is None else blamed(imu))
    if limit:
        assert obstacle_after_evidence(parameters, state)[1:] == (imu, pytest.approx(evidence), pytest.approx(limit))


def test_evidence_that_would_leave_out_an_imu_prevents_arming():
    assert obstacle_after_evidence(*with_evidence(Mode.IDLE, 2, 8.1, {}))[:2] == (Cause.NO_SENSORS, 2)


def test_between_armed_and_running_such_evidence_ends_the_run():
    parameters, state = with_evidence(Mode.ARMED, -1, 5.7, {})
    obstacle_after_evidence(parameters, state)
    assert stop_of(state) == (Cause.NO_TRUST, -1, pytest.approx(5.7), pytest.approx(np.sqrt(32.0)))


def blamed(imu):
    return Cause.NO_TRUST if imu < 0 else Cause.NO_SENSORS


def obstacle_after_evidence(parameters, state):
    """What then is in the way of arming: cause, IMU, value and limit."""
    p, s = parameters, state
    judge(p, s)
    s["time"]["cycle"] = p["rig"]["hold_cycles"]
    run_arming_checks(
        p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], p["imus"][()], s["imus"][()], s["integrity"][()],
        s["pose"][()], s["reference"][()], s["pid"][()],
    )  # fmt: skip
    arming = s["safety"]["arming"]
    return Cause(int(arming["obstacle"])), int(arming["index"]), float(arming["value"]), float(arming["limit"])


@pytest.mark.parametrize("change", ["back", "parity"])
def test_evidence_about_another_set_of_imus_does_not_last(change):
    _, parameters, state = moving()
    p, s, integrity = parameters, state, state["integrity"]
    state["imus"]["healthy"], integrity["evaluations"] = 1, 30
    weigh(state, 6, 4.1, 7.0)
    assert evaluations_until_a_stop(parameters, state, 4) is None
    if change == "back":
        state["imus"]["excluded"][3] = 1
        state["safety"]["attribution"]["cleared_for"][3] = 5
        evidence = integrity["evidence"]
        evidence["apart"], evidence["order"][0], evidence["apart_evidence"][0] = 1, 3, 0.0
        assert judge(parameters, state)
        evidence["apart"] = 0
    else:
        integrity["parity"]["named"], integrity["parity"]["worst"] = 1, 3
        assert judge_parity(
            p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], s["imus"][()], integrity["parity"][()],
            s["reference"][()], s["pid"][()],
        )  # fmt: skip
    assert evaluations_until_a_stop(parameters, state) == 4


@pytest.mark.parametrize(
    ("suspected", "evidence", "needed", "calm", "left_out"),
    [(3, 3.8, 1, 0, False), (2, 3.8, 1, 0, True), (3, 3.6, 1, 0, True), (3, 3.8, 0, 0, True), (4, 3.8, 1, 18, False),
     (4, 3.8, 1, 19, True)],
)  # fmt: skip
def test_no_imu_is_left_out_while_the_platforms_imu_is_suspected(suspected, evidence, needed, calm, left_out):
    """A sum of 3 sigma beyond 2.7 makes it suspected, and for 19 evaluations more, if the run needs it."""
    _, parameters, state = moving()
    state["imus"]["healthy"], state["integrity"]["evaluations"] = 1, 30
    if not needed:
        parameters["safety"]["watch"]["without_platform_imu"] = np.inf
    for imu, found, evaluations in ((6, evidence, suspected), (2, 3.0, calm)):
        weigh(state, imu, found, found)
        assert evaluations == 0 or evaluations_until_a_stop(parameters, state, evaluations + 1) is None
    weigh(state, 2, 9.0, 9.5, platform=5.0)
    assert judge(parameters, state) == left_out
    assert int(state["imus"]["excluded"][2]) == left_out
    if not left_out:
        assert stop_of(state) == (Cause.IMUS_CONTRADICT, 2, pytest.approx(9.0), pytest.approx(8.0))
        # The evidence of before is over.
        assert rival_of(state) == (6, pytest.approx(np.nan, nan_ok=True))
        assert told(state) == [Cause.IMUS_CONTRADICT, Cause.RIVAL_IMU]


@pytest.mark.parametrize(("of_leg", "left_out"), [(6.0, False), (7.0, True)])
def test_the_platforms_imu_is_suspected_if_a_legs_is_not_twice_as_likely(of_leg, left_out):
    """At 4.3 sigma; the evidence is the square."""
    _, parameters, state = moving()
    state["imus"]["healthy"], state["integrity"]["evaluations"] = 1, 30
    weigh(state, 2, of_leg, 7.5, platform=4.3)
    assert evaluations_until_a_stop(parameters, state, 4) is None
    weigh(state, 2, 9.0, 9.5)
    assert judge(parameters, state) == left_out


def test_the_platforms_imu_stays_suspected_when_another_one_is_taken_back():
    _, parameters, state = moving()
    integrity, evidence = state["integrity"], state["integrity"]["evidence"]
    state["imus"]["healthy"], integrity["evaluations"], state["imus"]["excluded"][3] = 1, 30, 1
    weigh(state, 6, 4.1, 5.0)
    assert evaluations_until_a_stop(parameters, state, 4) is None
    state["safety"]["attribution"]["cleared_for"][3] = 5
    evidence["apart"], evidence["order"][0], evidence["apart_evidence"][0] = 1, 3, 0.0
    assert judge(parameters, state)
    evidence["apart"] = 0
    weigh(state, 2, 9.0, 9.5)
    assert not judge(parameters, state)


@pytest.mark.parametrize(("imu", "expected"), [(6, 1), (3, None)])
def test_only_for_an_imu_that_may_be_left_out_more_evidence_is_awaited(imu, expected):
    """Something else explains the readings as well."""
    _, parameters, state = moving()
    weigh(state, imu, 8.5, 9.0, rival=8.0)
    assert evaluations_until_a_stop(parameters, state) == expected


@pytest.mark.parametrize("two", [0, 1])
def test_two_imus_that_read_a_force_that_is_no_motion_end_a_run(two):
    _, parameters, state = moving()
    p, s = parameters, state
    parity = state["integrity"]["parity"]
    parity["two"], parity["shared"], parity["second"], parity["common"] = two, 1 - two, 0.3, 0.2
    assert not judge_parity(
        p["safety"][()], s["safety"][()], p["rig"][()], s["time"][()], s["imus"][()], parity[()], s["reference"][()],
        s["pid"][()],
    )  # fmt: skip
    expected = (Cause.TWO_FORCES, -1, 0.3, 0.2) if two else (Cause.FORCES_SHARE, -1, 0.2, 0.1)
    assert stop_of(state) == tuple(pytest.approx(each) if isinstance(each, float) else each for each in expected)
