"""The power state machine: the drive's side takes only legal ways, the controller's side gets where it wants from anywhere."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.rigs import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, QUICK_STOPPING, READY
from hil.rigs.canopen.cia402 import Controlword as Word
from hil.rigs.canopen.cia402 import PowerState as State
from hil.rigs.canopen.cia402 import (
    commanded,
    controlword_towards,
    drive_state,
    settled,
    state_of,
    statusword,
)

ALL = tuple(State)
WORDS = st.integers(0, 0xFFFF)


@pytest.mark.parametrize("state", ALL)
@pytest.mark.parametrize("powered", [False, True])
@pytest.mark.parametrize("follows", [False, True])
def test_statuswords_stand_for_their_state(state, powered, follows):
    assert state_of(statusword(state, powered, follows)) == state


def test_no_statusword_stands_for_two_states_and_some_for_none():
    found = [state_of(word) for word in range(1 << 16)]
    assert set(found) == {None, *ALL}


@given(
    st.lists(WORDS, max_size=60),
    st.sampled_from([State.SWITCH_ON_DISABLED, State.FAULT, State.NOT_READY_TO_SWITCH_ON]),
)
def test_operation_is_enabled_only_along_the_legal_way(controlwords, state):
    previous, path = 0, [state]
    for controlword in controlwords:
        state, previous = commanded(state, controlword, previous), controlword
        path.append(state)
    legal = {
        State.READY_TO_SWITCH_ON: {
            State.SWITCH_ON_DISABLED,
            State.READY_TO_SWITCH_ON,
            State.SWITCHED_ON,
            State.OPERATION_ENABLED,
        },
        State.SWITCHED_ON: {State.READY_TO_SWITCH_ON, State.SWITCHED_ON, State.OPERATION_ENABLED},
        State.OPERATION_ENABLED: {State.SWITCHED_ON, State.OPERATION_ENABLED},
        State.QUICK_STOP_ACTIVE: {State.OPERATION_ENABLED, State.QUICK_STOP_ACTIVE},
    }
    for before, after in pairwise(path):
        assert before in legal.get(after, {before, *ALL})


@given(WORDS, WORDS)
def test_only_a_rising_edge_resets_a_fault(controlword, previous):
    rising = bool(controlword & Word.FAULT_RESET) and not previous & Word.FAULT_RESET
    assert commanded(State.FAULT, controlword, previous) == (State.SWITCH_ON_DISABLED if rising else State.FAULT)


@given(WORDS, WORDS, st.sampled_from([State.NOT_READY_TO_SWITCH_ON, State.FAULT_REACTION_ACTIVE]))
def test_nothing_is_heeded_before_a_drive_is_ready_or_while_it_reacts_to_a_fault(controlword, previous, state):
    assert commanded(state, controlword, previous) == state


@pytest.mark.parametrize(
    "request_, goal",
    [(BRAKED, State.SWITCHED_ON), (ENABLED, State.OPERATION_ENABLED), (QUICK_STOP, State.SWITCH_ON_DISABLED)],
)
@pytest.mark.parametrize(
    "start",
    [state for state in ALL if state not in (State.NOT_READY_TO_SWITCH_ON, State.FAULT, State.FAULT_REACTION_ACTIVE)],
)
def test_the_controller_gets_where_it_wants(request_, goal, start):
    state, previous = start, 0
    for _ in range(6):
        controlword = controlword_towards(request_, state)
        state, previous = commanded(state, controlword, previous), controlword
        # A quick stop comes to its end at some time.
        state = settled(state)
    assert state == goal


@given(st.lists(st.sampled_from([BRAKED, ENABLED, QUICK_STOP]), max_size=20))
def test_the_controller_resets_no_fault_on_its_own(requests):
    state, previous = State.FAULT, 0
    for each in requests:
        controlword = controlword_towards(each, state)
        state, previous = commanded(state, controlword, previous), controlword
    assert state == State.FAULT


def test_nothing_but_being_enabled_keeps_a_drive_enabled():
    assert commanded(State.OPERATION_ENABLED, Word.ENABLE_OPERATION, Word.ENABLE_OPERATION) == State.OPERATION_ENABLED
    assert commanded(State.OPERATION_ENABLED, Word.SWITCH_ON, Word.ENABLE_OPERATION) == State.SWITCHED_ON
    assert commanded(State.OPERATION_ENABLED, Word.SHUTDOWN, Word.ENABLE_OPERATION) == State.READY_TO_SWITCH_ON
    assert commanded(State.OPERATION_ENABLED, Word.DISABLE_VOLTAGE, Word.ENABLE_OPERATION) == State.SWITCH_ON_DISABLED
    assert (
        commanded(State.OPERATION_ENABLED, controlword_towards(QUICK_STOP, State.OPERATION_ENABLED), 0)
        == State.QUICK_STOP_ACTIVE
    )


def test_what_a_drive_says():
    assert drive_state(statusword(State.SWITCHED_ON, True, False)) == READY
    assert drive_state(statusword(State.SWITCH_ON_DISABLED, False, False)) == OFF
    assert drive_state(statusword(State.NOT_READY_TO_SWITCH_ON, True, False)) == OFF
    assert drive_state(statusword(State.OPERATION_ENABLED, True, False)) == READY
    assert drive_state(statusword(State.OPERATION_ENABLED, True, True)) == FOLLOWING
    assert drive_state(statusword(State.QUICK_STOP_ACTIVE, True, False)) == QUICK_STOPPING
    assert (
        drive_state(statusword(State.FAULT, True, False))
        == drive_state(statusword(State.FAULT_REACTION_ACTIVE, True, False))
        == FAULTY
    )


@pytest.mark.parametrize(
    "word, state",
    [
        (0x0000, State.NOT_READY_TO_SWITCH_ON),
        (0x0230, State.NOT_READY_TO_SWITCH_ON),
        (0x0040, State.SWITCH_ON_DISABLED),
        (0x0270, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY_TO_SWITCH_ON),
        (0x0233, State.SWITCHED_ON),
        (0x1637, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP_ACTIVE),
        (0x020F, State.FAULT_REACTION_ACTIVE),
        (0x023F, State.FAULT_REACTION_ACTIVE),
        (0x0208, State.FAULT),
        (0x0238, State.FAULT),
        (0x0211, None),
        (0x0277, None),
        (0x0248, None),
    ],
)
def test_statuswords_have_the_bits_of_cia_402(word, state):
    assert state_of(word) == state


def test_an_emulated_drives_statuswords_have_the_bits_of_cia_402():
    assert statusword(State.OPERATION_ENABLED, True, True) == 0x1237
    assert statusword(State.OPERATION_ENABLED, False, False) == 0x0227
    assert statusword(State.SWITCHED_ON, True, True) == 0x0233
    assert statusword(State.SWITCH_ON_DISABLED, True, False) == 0x0250
    assert statusword(State.QUICK_STOP_ACTIVE, True, True) == 0x0217
    assert statusword(State.FAULT, False, True) == 0x0208


@pytest.mark.parametrize("more", [0x00, 0x70, 0xFF70])
@pytest.mark.parametrize(
    "state, after",
    [
        (State.SWITCH_ON_DISABLED, "DDRDD"),
        (State.READY_TO_SWITCH_ON, "DDRSS"),
        (State.SWITCHED_ON, "DDRSE"),
        (State.OPERATION_ENABLED, "DQRSE"),
        (State.QUICK_STOP_ACTIVE, "DQQQQ"),
    ],
)
def test_a_controlword_takes_a_drive_one_transition_further(state, after, more):
    reached = {
        "D": State.SWITCH_ON_DISABLED, "R": State.READY_TO_SWITCH_ON, "S": State.SWITCHED_ON, "E": State.OPERATION_ENABLED,
        "Q": State.QUICK_STOP_ACTIVE,
    }  # fmt: skip
    assert [commanded(state, word | more, 0) for word in (0x00, 0x02, 0x06, 0x07, 0x0F)] == [reached[each] for each in after]


@pytest.mark.parametrize(
    "request_, words",
    [
        (BRAKED, (0, 0x06, 0x07, 0x07, 0x07, 0, 0, 0)),
        (ENABLED, (0, 0x06, 0x07, 0x0F, 0x0F, 0x02, 0, 0)),
        (QUICK_STOP, 8 * (0x02,)),
    ],
)
def test_the_controlword_towards_a_request_by_state(request_, words):
    assert tuple(controlword_towards(request_, state) for state in ALL) == words
    assert controlword_towards(request_, None) == (0x02 if request_ == QUICK_STOP else 0)


def test_a_request_that_is_unknown_stops_quickly():
    assert {controlword_towards(3, state) for state in (*ALL, None)} == {0x02}


def test_a_drive_without_a_supplied_power_stage_is_off_unless_its_state_says_more():
    found = [drive_state(statusword(state, False, True)) for state in ALL]
    assert found == [OFF, OFF, OFF, OFF, FOLLOWING, QUICK_STOPPING, FAULTY, FAULTY]
    assert drive_state(statusword(State.OPERATION_ENABLED, False, False)) == drive_state(0x0211) == OFF
    found = [drive_state(statusword(state, True, False)) for state in ALL]
    assert found == [OFF, READY, READY, READY, READY, QUICK_STOPPING, FAULTY, FAULTY]
