"""What the examiner asks of a rig and finds, at the bounds of each clause, on a virtual clock."""

from itertools import groupby, pairwise

import numpy as np
import pytest

from hil.rigs import ANSWERED, BRAKED, ENABLED, FAULTY, FOLLOWING, QUICK_STOP, SILENT, RigError, contract
from hil.rigs.contract import check_rig
from hil.rigs.template import TemplateRig
from plant.mechanism import load_spatial

PERIOD = 0.005
HEXAPOD = load_spatial("hexapod")
pytestmark = pytest.mark.usefixtures("virtual_time")


class Changed(TemplateRig):
    """The template, whose answers are changed by a function of feedback and number."""

    def __init__(self, change=None):
        super().__init__(HEXAPOD, PERIOD, None)
        self._change, self.count, self.asked = change, 0, []

    def exchange(self, command, request, feedback):
        self.count += 1
        self.asked.append((contract.time.now_ns, request, *command))
        status = super().exchange(command, request, feedback)
        changed = self._change and self._change(self, feedback)
        return status if changed is None else changed


def put(name, *index, value):
    """A change of one value of the feedback."""

    def change(rig, feedback):
        if index:
            feedback[name][index] = value
        else:
            feedback[name] = value

    return change


def times(name, *index, factor):
    def change(rig, feedback):
        feedback[name][index] *= factor

    return change


def refused_from(most):
    def change(rig, feedback):
        feedback["refused"] = most - rig.count

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    "change, message",
    [
        (put("sample_ns", 2, value=7), "IMU 2 has a new sample with the time of the last, in exchange 2."),
        (refused_from(500), "The count of refused packets went back in exchange 2."),
        (put("measurement", 0, 4, value=[0.0, -0.6, 0.0]), "IMU 4 reads 0.6 rad/s at rest: check its unit."),
        (times("measurement", 1, 3, factor=1.6), "IMU 3 reads 15.7 m/s^2 at rest instead of gravity: check its unit."),
        (times("measurement", 1, 6, factor=0.5), "IMU 6 reads 4.91 m/s^2 at rest instead of gravity: check its unit."),
        (put("measurement", 2, 1, 0, value=np.nan), "The magnetic field of IMU 1 must be finite, or NaN on all axes."),
        (put("drive", 2, value=7), "The drives' states are [1, 1, 7, 1, 1, 1]; they must be 0 to 4."),
        (put("drive", 5, value=-1), "The drives' states are [1, 1, 1, 1, 1, -1]; they must be 0 to 4."),
        (put("round_trip_ns", value=-5), "The round trip is -5 ns."),
        (
            put("truth", 12, value=np.nan),
            "The truth must have position, quaternion and lengths, or be NaN where it is not known.",
        ),
        (put("sent", 1, value=np.inf), "What was sent is not finite: [0.0, inf, 0.0, 0.0, 0.0, 0.0]."),
        (put("measurement", slice(None), value=np.nan), "No IMU has given readings: the measurement is NaN."),
        (put("sent", 4, value=-2e-5), "Drive 4 was commanded 0 m/s, and -2e-05 m/s is reported as sent, after 3 exchanges."),
        (lambda rig, feedback: -1, "exchange returned -1; it must return ANSWERED, SILENT, or a failure above."),
        (lambda rig, feedback: True, "exchange returned True; it must return ANSWERED, SILENT, or a failure above."),
        (lambda rig, feedback: 2 if rig.count == 7 else ANSWERED, "Exchange 7 failed with status 2."),
        (
            lambda rig, feedback: SILENT if rig.count % 9 == 1 else ANSWERED,
            "12 of 100 exchanges on the brakes brought no answer.",
        ),
    ],
)
def test_what_an_exchange_at_rest_does_wrong_is_told(change, message):
    assert check_rig(lambda: Changed(change), PERIOD, moving=False) == [message]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        put("measurement", 2, value=np.nan),
        put("measurement", slice(None), 3, value=np.nan),
        put("truth", value=np.nan),
        put("measurement", 0, 4, value=[0.0, -0.4, 0.0]),
        times("measurement", 1, factor=1.5),
        times("measurement", 1, factor=0.55),
        put("sent", 4, value=9e-6),
        lambda rig, feedback: SILENT if rig.count % 10 == 1 else ANSWERED,
    ],
)
def test_what_is_within_the_bounds_at_rest_is_no_finding(change):
    assert check_rig(lambda: Changed(change), PERIOD, moving=False) == []


def scaled(leg, factor):
    """A drive that moves by another scale, but does not say so."""

    def change(rig, feedback):
        rig._hardware.commands = rig._hardware.commands.copy()
        rig._hardware.commands[leg] *= factor

    return change


@pytest.mark.slow
@pytest.mark.parametrize(
    "leg, factor, found", [(3, 1.4, False), (3, 0.7, False), (3, 1.9, True), (0, 0.3, True), (5, -1.0, True)]
)
def test_a_leg_that_moves_by_another_scale_is_told(leg, factor, found):
    texts = check_rig(lambda: Changed(scaled(leg, factor)), PERIOD)
    assert len(texts) == found
    if found:
        # Less what the drive's lag takes off.
        assert texts[0].endswith("mm, commanded were 0.200 mm: check its sign and scale.")
        moved = float(texts[0].removeprefix(f"Leg {leg} moved by ").split(" ")[0])
        assert moved == pytest.approx(0.2 * factor, rel=0.25)


def test_drives_without_states_of_their_own_always_follow():
    assert check_rig(lambda: Changed(put("drive", slice(None), value=FOLLOWING)), PERIOD) == []


def test_a_faulty_drive_is_told_with_its_code_and_ends_the_examination():
    rigs = []

    def change(rig, feedback):
        feedback["drive"][4], feedback["drive_code"][4] = FAULTY, 0x2310

    def make():
        rigs.append(Changed(change))
        return rigs[-1]

    (text,) = check_rig(make, PERIOD)
    assert text == (
        "Asked to hold on their brakes, the drives are ready, ready, ready, ready, faulty, ready after 21 exchanges "
        "(fault codes 0x0, 0x0, 0x0, 0x0, 0x2310, 0x0)."
    )
    assert {request for _, request, *_ in rigs[0].asked} == {BRAKED}


def test_what_is_asked_of_a_rig_that_may_move():
    rigs = []

    def make():
        rigs.append(Changed())
        return rigs[-1]

    assert check_rig(make, PERIOD, beyond=-10.0) == []
    asked = rigs[0].asked
    assert all(len(set(command)) == 1 for _, _, *command in asked if not np.isnan(command[0]))
    grouped = groupby((request, repr(float(command[0]))) for _, request, *command in asked)
    assert [(*key, len(list(group))) for key, group in grouped] == [
        (BRAKED, "0.0", 100),
        (ENABLED, "0.0", 20),
        (ENABLED, "0.001", 40),
        (ENABLED, "-0.001", 40),
        (ENABLED, "-10.0", 1),
        (ENABLED, "0.0", 2),
        (ENABLED, "nan", 1),
        (QUICK_STOP, "0.0", 20),
        (BRAKED, "0.0", 20),
        (ENABLED, "0.0", 20),
        (ENABLED, "0.001", 1),
        (QUICK_STOP, "0.0", 20),
        (BRAKED, "0.0", 20),
    ]
    np.testing.assert_allclose([after[0] - before[0] for before, after in pairwise(asked)], 1e9 * PERIOD, atol=1e5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "delay, sound", [(0, True), (0.05, True), (0.0501, False), (-0.001, False), ("5 ms", False), (float("nan"), False)]
)
def test_the_delay_of_commands_must_be_plausible(delay, sound):
    def make():
        rig = Changed()
        rig.command_delay = delay
        return rig

    texts = check_rig(make, PERIOD, moving=False)
    assert texts == ([] if sound else [f"Its command_delay is {delay!r}; it must be 0 to 10 periods [s], one on a bus."])


def test_a_rig_that_refuses_to_be_armed_says_why_and_is_not_asked_for_more():
    class Refuses(Changed):
        def arm(self):
            raise RigError("drive 3 is hot")

    assert check_rig(Refuses, PERIOD) == ["arm refused: drive 3 is hot"]
    assert check_rig(Refuses, PERIOD, moving=False) == []


def test_the_parts_of_an_identity_must_be_texts():
    class Numbered(Changed):
        def identify(self):
            identity = super().identify()
            identity.parts["drives"] = 6
            return identity

    assert check_rig(Numbered, PERIOD, moving=False) == ["The identity's parts must be texts by name, for they are recorded."]
