"""The power state machine of CiA 402, both sides: what a drive makes of a controlword, and which one leads where it is wanted.

    Not ready --> Switch on disabled <--> Ready to switch on <--> Switched on <--> Operation enabled
    Operation enabled --> Quick stop active --> Switch on disabled          (quick stop option code 2)
    any --> Fault reaction active --> Fault --rising edge of bit 7--> Switch on disabled

Pure functions on integers.
"""

from controller.safety.causes import DriveState, Request

(
    NOT_READY, SWITCH_ON_DISABLED, READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED, QUICK_STOP_ACTIVE, FAULT_REACTION_ACTIVE,
    FAULT,
) = range(8)  # fmt: skip

STATES = (
    "Not ready to switch on", "Switch on disabled", "Ready to switch on", "Switched on", "Operation enabled",
    "Quick stop active", "Fault reaction active", "Fault",
)  # fmt: skip

NO_STATE = -1
"""A statusword that stands for no state."""

DISABLE_VOLTAGE, QUICK_STOP_COMMAND, SHUTDOWN, SWITCH_ON, ENABLE_OPERATION, FAULT_RESET = 0x00, 0x02, 0x06, 0x07, 0x0F, 0x80
"""Controlwords. `SWITCH_ON` in Operation enabled is "disable operation"."""

VOLTAGE_ENABLED, REMOTE, FOLLOWS_TARGET = 1 << 4, 1 << 9, 1 << 12
"""Bits of the statusword: the power stage is supplied; the controlword is heeded; in cyclic synchronous velocity mode, the
drive follows the target velocity."""

(
    ERROR_CODE, CONTROLWORD, STATUSWORD, QUICK_STOP_OPTION, DISABLE_OPERATION_OPTION, MODE, MODE_DISPLAY, VELOCITY_ACTUAL,
    MAX_MOTOR_SPEED, QUICK_STOP_DECELERATION, TARGET_VELOCITY, ABORT_CONNECTION_OPTION, FAULT_REACTION_OPTION,
    INTERPOLATION_PERIOD,
) = (
    0x603F, 0x6040, 0x6041, 0x605A, 0x605C, 0x6060, 0x6061, 0x606C, 0x6080, 0x6085, 0x60FF, 0x6007, 0x605E, 0x60C2,
)  # fmt: skip
"""Objects of a drive."""

CYCLIC_SYNCHRONOUS_VELOCITY = 9
"""Mode of operation."""

QUICK_STOP_RAMP, DISABLE_AT_ONCE, FAULT_RAMP, ABORT_QUICK_STOP = 2, 0, 2, 3
"""Option codes: a quick stop slows down by the quick-stop deceleration and ends in Switch on disabled; "disable operation"
takes the power off and so closes the brake at once; a fault slows down in the same way, and a lost connection is a quick
stop."""

HEARTBEAT_LOST, PDO_LOST = 0x8130, 0x8250
"""Error codes of a drive that misses its controller: no heartbeat, no RPDO in time."""

_STATE_BITS = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)
_MASK, _MASK_WITHOUT_QUICK_STOP = 0x6F, 0x4F
_QUICK_STOP_BIT_MATTERS = frozenset({READY_TO_SWITCH_ON, SWITCHED_ON, OPERATION_ENABLED, QUICK_STOP_ACTIVE})


def _tabulated() -> tuple[int, ...]:
    table = [NO_STATE] * (_MASK + 1)
    for state, bits in enumerate(_STATE_BITS):
        mask = _MASK if state in _QUICK_STOP_BIT_MATTERS else _MASK_WITHOUT_QUICK_STOP
        for word in range(_MASK + 1):
            if word & mask == bits:
                table[word] = state
    return tuple(table)


_STATE_OF = _tabulated()


def state_of(statusword: int) -> int:
    """The state that a statusword stands for, or `NO_STATE`."""
    return _STATE_OF[statusword & _MASK]


def statusword(state: int, powered: bool, follows: bool) -> int:
    """The statusword of a drive in this state whose power stage is supplied or not, and which follows the target or not."""
    word = _STATE_BITS[state] | REMOTE
    if powered:
        word |= VOLTAGE_ENABLED
    if follows and state == OPERATION_ENABLED:
        word |= FOLLOWS_TARGET
    return word


def commanded(state: int, controlword: int, previous: int) -> int:
    """The state into which a controlword takes a drive, one transition at most.

    Args:
        state: of the drive.
        controlword: now.
        previous: the controlword before, for the rising edge that resets a fault.
    """
    if state == FAULT:
        return SWITCH_ON_DISABLED if controlword & ~previous & FAULT_RESET else FAULT
    if state in (NOT_READY, FAULT_REACTION_ACTIVE):
        return state
    if not controlword & 0x02:
        return SWITCH_ON_DISABLED
    if state == QUICK_STOP_ACTIVE:
        return state
    if not controlword & 0x04:
        return QUICK_STOP_ACTIVE if state == OPERATION_ENABLED else SWITCH_ON_DISABLED
    if not controlword & 0x01:
        return READY_TO_SWITCH_ON
    if state == SWITCH_ON_DISABLED:
        return state
    if state == READY_TO_SWITCH_ON or not controlword & 0x08:
        return SWITCHED_ON
    return OPERATION_ENABLED


def settled(state: int) -> int:
    """The state into which a drive goes by itself once it has come to rest."""
    if state == QUICK_STOP_ACTIVE:
        return SWITCH_ON_DISABLED
    return FAULT if state == FAULT_REACTION_ACTIVE else state


def controlword_towards(request: int, state: int) -> int:
    """The controlword that leads a drive one step towards what is asked of it.

    `BRAKED` leads to Switched on, `ENABLED` to Operation enabled, `QUICK_STOP` to rest in Switch on disabled. A quick stop is
    let finish before the drive is enabled again; `BRAKED` cuts it short. A fault is never reset here.
    """
    if request not in (Request.BRAKED, Request.ENABLED):
        return QUICK_STOP_COMMAND
    if state == SWITCH_ON_DISABLED:
        return SHUTDOWN
    if state == QUICK_STOP_ACTIVE:
        return QUICK_STOP_COMMAND if request == Request.ENABLED else DISABLE_VOLTAGE
    if state in (SWITCHED_ON, OPERATION_ENABLED):
        return ENABLE_OPERATION if request == Request.ENABLED else SWITCH_ON
    return SWITCH_ON if state == READY_TO_SWITCH_ON else DISABLE_VOLTAGE


def drive_state(word: int) -> int:
    """What a drive says of itself (`OFF`, `READY`, `FOLLOWING`, `QUICK_STOPPING`, `FAULTY`) by a statusword.

    A drive with its power stage supplied is ready from Switch on disabled on, since `controlword_towards` leads it on; in
    Operation enabled it is ready until it follows the target velocity.
    """
    state = state_of(word)
    if state in (FAULT, FAULT_REACTION_ACTIVE):
        return DriveState.FAULTY
    if state == QUICK_STOP_ACTIVE:
        return DriveState.QUICK_STOPPING
    if state == OPERATION_ENABLED and word & FOLLOWS_TARGET:
        return DriveState.FOLLOWING
    return DriveState.READY if state > NOT_READY and word & VOLTAGE_ENABLED else DriveState.NOT_READY
