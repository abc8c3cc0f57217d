"""The power state machine of CiA 402: a drive's reaction to a controlword, and the controlword that leads to a wanted state.

    Not ready --> Switch on disabled <--> Ready to switch on <--> Switched on <--> Operation enabled
    Operation enabled --> Quick stop active --> Switch on disabled          (quick stop option code 2)
    any --> Fault reaction active --> Fault --rising edge of bit 7--> Switch on disabled

Pure functions on integers.
"""

from enum import IntEnum
from functools import cache

from hil.rigs import DriveState, Request


class PowerState(IntEnum):
    """A drive's power state."""

    NOT_READY_TO_SWITCH_ON = 0
    SWITCH_ON_DISABLED = 1
    READY_TO_SWITCH_ON = 2
    SWITCHED_ON = 3
    OPERATION_ENABLED = 4
    QUICK_STOP_ACTIVE = 5
    FAULT_REACTION_ACTIVE = 6
    FAULT = 7

    @property
    def label(self) -> str:
        """The state's name in CiA 402, such as Switched on."""
        return self.name.replace("_", " ").capitalize()


class Controlword(IntEnum):
    """Commands to the power state machine. `SWITCH_ON` in Operation enabled is CiA 402's "disable operation"."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


VOLTAGE_ENABLED, REMOTE, FOLLOWS_TARGET, OFF_TARGET = 1 << 4, 1 << 9, 1 << 12, 1 << 13
"""Bits of the statusword: the power stage is supplied; the drive obeys the controlword; in a cyclic synchronous mode, the
drive follows its target; in that of position, its following error is beyond the window."""

POSITION_MODE, VELOCITY_MODE = 8, 9
"""Modes of operation: cyclic synchronous position and velocity."""

HEARTBEAT_LOST, PDO_LOST = 0x8130, 0x8250
"""Error codes of a drive that misses its controller: no heartbeat, no RPDO in time."""

_STATE_BITS = (0x00, 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08)
_STATE_MASKS = (0x4F, 0x4F, 0x6F, 0x6F, 0x6F, 0x6F, 0x4F, 0x4F)
"""By state: the bits of the statusword, and which bits must be these."""


@cache
def state_of(statusword: int) -> PowerState | None:
    """The state in a statusword; None if there is no such state."""
    return next((state for state in PowerState if statusword & _STATE_MASKS[state] == _STATE_BITS[state]), None)


def statusword(state: PowerState, powered: bool, follows: bool, off_target: bool = False) -> int:
    """The statusword of a drive in this state whose power stage is `powered` or not, which `follows` the target or not, and
    whose following error is beyond its window if it is `off_target`.
    """
    word = _STATE_BITS[state] | REMOTE | (VOLTAGE_ENABLED if powered else 0) | (OFF_TARGET if off_target else 0)
    if follows and state == PowerState.OPERATION_ENABLED:
        word |= FOLLOWS_TARGET
    return word


def commanded(state: PowerState, controlword: int, previous: int) -> PowerState:
    """The state after a controlword, at most one transition further; the `previous` one shows the edge that resets a fault."""
    if state == PowerState.FAULT:
        return PowerState.SWITCH_ON_DISABLED if controlword & ~previous & Controlword.FAULT_RESET else state
    if state in (PowerState.NOT_READY_TO_SWITCH_ON, PowerState.FAULT_REACTION_ACTIVE):
        return state
    if not controlword & 0x02:
        return PowerState.SWITCH_ON_DISABLED
    if state == PowerState.QUICK_STOP_ACTIVE:
        return state
    if not controlword & 0x04:
        enabled = state == PowerState.OPERATION_ENABLED
        return PowerState.QUICK_STOP_ACTIVE if enabled else PowerState.SWITCH_ON_DISABLED
    if not controlword & 0x01:
        return PowerState.READY_TO_SWITCH_ON
    if state == PowerState.SWITCH_ON_DISABLED:
        return state
    if state == PowerState.READY_TO_SWITCH_ON or not controlword & 0x08:
        return PowerState.SWITCHED_ON
    return PowerState.OPERATION_ENABLED


def settled(state: PowerState) -> PowerState:
    """The state that a drive enters by itself once it is at rest."""
    if state == PowerState.QUICK_STOP_ACTIVE:
        return PowerState.SWITCH_ON_DISABLED
    return PowerState.FAULT if state == PowerState.FAULT_REACTION_ACTIVE else state


def controlword_towards(request: int, state: PowerState | None) -> Controlword:
    """The controlword that leads a drive one step towards the request.

    `BRAKED` leads to Switched on, `ENABLED` to Operation enabled, `QUICK_STOP` to rest in Switch on disabled. `ENABLED` lets a
    quick stop finish; `BRAKED` cuts it short. This function never resets a fault.
    """
    if request not in (Request.BRAKED, Request.ENABLED):
        return Controlword.QUICK_STOP
    if state == PowerState.SWITCH_ON_DISABLED:
        return Controlword.SHUTDOWN
    if state == PowerState.QUICK_STOP_ACTIVE:
        return Controlword.QUICK_STOP if request == Request.ENABLED else Controlword.DISABLE_VOLTAGE
    if state in (PowerState.SWITCHED_ON, PowerState.OPERATION_ENABLED):
        return Controlword.ENABLE_OPERATION if request == Request.ENABLED else Controlword.SWITCH_ON
    return Controlword.SWITCH_ON if state == PowerState.READY_TO_SWITCH_ON else Controlword.DISABLE_VOLTAGE


def drive_state(word: int, position: bool = False) -> DriveState:
    """A drive's state for the loop, by its statusword; in `position` mode, a following error is a fault.

    A drive whose power stage is supplied is ready from Switch on disabled on, because `controlword_towards` leads it further;
    in Operation enabled it is ready until it follows the target velocity.
    """
    state = state_of(word)
    if state in (PowerState.FAULT, PowerState.FAULT_REACTION_ACTIVE):
        return DriveState.FAULTY
    if state == PowerState.QUICK_STOP_ACTIVE:
        return DriveState.QUICK_STOPPING
    if position and state == PowerState.OPERATION_ENABLED and word & OFF_TARGET:
        return DriveState.FAULTY
    if state == PowerState.OPERATION_ENABLED and word & FOLLOWS_TARGET:
        return DriveState.FOLLOWING
    not_ready = state in (None, PowerState.NOT_READY_TO_SWITCH_ON) or not word & VOLTAGE_ENABLED
    return DriveState.NOT_READY if not_ready else DriveState.READY
