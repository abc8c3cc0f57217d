"""The power state machine: the drive's side takes only legal ways, the controller's side gets where it wants from anywhere."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.rigs import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, QUICK_STOPPING, READY
from hil.rigs.canopen.cia402 import (
    DISABLE_VOLTAGE,
    ENABLE_OPERATION,
    FAULT,
    FAULT_REACTION_ACTIVE,
    FAULT_RESET,
    NO_STATE,
    NOT_READY,
    OPERATION_ENABLED,
    QUICK_STOP_ACTIVE,
    READY_TO_SWITCH_ON,
    SHUTDOWN,
    STATES,
    SWITCH_ON,
    SWITCH_ON_DISABLED,
    SWITCHED_ON,
    commanded,
    controlword_towards,
    drive_state,
    settled,
    state_of,
    statusword,
)

ALL = range(len(STATES))
WORDS = st.integers(0, 0xFFFF)


@pytest.mark.parametrize("state", ALL)
@pytest.mark.parametrize("powered", [False, True])
@pytest.mark.parametrize("follows", [False, True])
def test_statuswords_stand_for_their_state(state, powered, follows):
    assert state_of(statusword(state, powered, follows)) == state


def test_no_statusword_stands_for_two_states_and_some_for_none():
    found = [state_of(word) for word in range(1 << 16)]
    assert set(found) == {NO_STATE, *ALL}


@given(st.lists(WORDS, max_size=60), st.sampled_from([SWITCH_ON_DISABLED, FAULT, NOT_READY]))
def test_operation_is_enabled_only_along_the_legal_way(controlwords, state):
    previous, path = 0, [state]
    for controlword in controlwords:
        state, previous = commanded(state, controlword, previous), controlword
        path.append(state)
    legal = {
        READY_TO_SWITCH_ON: {SWITCH_ON_DISABLED, READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED},
        SWITCHED_ON: {READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED},
        OPERATION_ENABLED: {SWITCHED_ON, OPERATION_ENABLED},
        QUICK_STOP_ACTIVE: {OPERATION_ENABLED, QUICK_STOP_ACTIVE},
    }
    for before, after in pairwise(path):
        assert before in legal.get(after, {before, *ALL})


@given(WORDS, WORDS)
def test_only_a_rising_edge_resets_a_fault(controlword, previous):
    rising = bool(controlword & FAULT_RESET) and not previous & FAULT_RESET
    assert commanded(FAULT, controlword, previous) == (SWITCH_ON_DISABLED if rising else FAULT)


@given(WORDS, WORDS, st.sampled_from([NOT_READY, FAULT_REACTION_ACTIVE]))
def test_nothing_is_heeded_before_a_drive_is_ready_or_while_it_reacts_to_a_fault(controlword, previous, state):
    assert commanded(state, controlword, previous) == state


@pytest.mark.parametrize(
    "request_, goal", [(BRAKED, SWITCHED_ON), (ENABLED, OPERATION_ENABLED), (QUICK_STOP, SWITCH_ON_DISABLED)]
)
@pytest.mark.parametrize("start", [s for s in ALL if s not in (NOT_READY, FAULT, FAULT_REACTION_ACTIVE)])
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
    state, previous = FAULT, 0
    for each in requests:
        controlword = controlword_towards(each, state)
        state, previous = commanded(state, controlword, previous), controlword
    assert state == FAULT


def test_nothing_but_being_enabled_keeps_a_drive_enabled():
    assert commanded(OPERATION_ENABLED, ENABLE_OPERATION, ENABLE_OPERATION) == OPERATION_ENABLED
    assert commanded(OPERATION_ENABLED, SWITCH_ON, ENABLE_OPERATION) == SWITCHED_ON
    assert commanded(OPERATION_ENABLED, SHUTDOWN, ENABLE_OPERATION) == READY_TO_SWITCH_ON
    assert commanded(OPERATION_ENABLED, DISABLE_VOLTAGE, ENABLE_OPERATION) == SWITCH_ON_DISABLED
    assert commanded(OPERATION_ENABLED, controlword_towards(QUICK_STOP, OPERATION_ENABLED), 0) == QUICK_STOP_ACTIVE


def test_what_a_drive_says():
    assert drive_state(statusword(SWITCHED_ON, True, False)) == READY
    assert drive_state(statusword(SWITCH_ON_DISABLED, False, False)) == OFF
    assert drive_state(statusword(NOT_READY, True, False)) == OFF
    assert drive_state(statusword(OPERATION_ENABLED, True, False)) == READY
    assert drive_state(statusword(OPERATION_ENABLED, True, True)) == FOLLOWING
    assert drive_state(statusword(QUICK_STOP_ACTIVE, True, False)) == QUICK_STOPPING
    assert drive_state(statusword(FAULT, True, False)) == drive_state(statusword(FAULT_REACTION_ACTIVE, True, False)) == FAULTY
