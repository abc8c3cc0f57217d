"""The contract of a rig: what the loop relies on, clause by clause, checked on any rig from outside.

By default the drives are only asked to hold on their brakes. With `moving` they are enabled, all legs extend and retract at
1 mm/s for 0.2 s each, and the drives are stopped; the rig must have room for that.
"""

from hil.rigs.examiner import FOLLOWED_WITHIN, Examination, Examiner, MakeRig

CLAUSES = {
    "interface": "it has all methods, and its command_delay",
    "stops at any time": "quick_stop and close raise nothing: before open, twice, and after close",
    "opens": "it can be opened, or says in a RigError why not",
    "identifies": "identify returns its identity",
    "arms": "arm makes the drives ready and requests nothing else of them",
    "threads": "no thread runs beside the exchanges, and none is left",
    "exchanges": "exchange raises nothing and gives answers",
    "feedback": "the feedback keeps its layout, and every required value is there",
    "order in time": "sample numbers, sample times and the count of refused packets never go back",
    "sample age": "new samples arrive in time",
    "drives": f"the drives do what is requested within {FOLLOWED_WITHIN} exchanges",
    "sent": "what was sent is what was commanded, within limits",
    "motion": "the legs move as commanded, where the truth is known",
    "period": "an exchange returns within the period (p99)",
    "opens again": "after close it can be opened again",
    "absent": "a rig that is not there raises a RigError with a message",
}


def check_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None
) -> list[str]:
    """Check a rig against the contract; returns the findings, one sentence each (see `examine_rig`)."""
    return examine_rig(make_rig, period, moving, beyond, absent).all_findings()


def examine_rig(
    make_rig: MakeRig, period: float, moving: bool = True, beyond: float | None = None, absent: MakeRig | None = None
) -> Examination:
    """Check a rig against the contract.

    Args:
        make_rig: makes a new rig at each call.
        period: of the exchanges [s].
        moving: whether the drives may be enabled and move by 0.2 mm.
        beyond: a command beyond the limits [m/s] that is tried for one exchange, with `moving` only: for emulated rigs, never
            for hardware.
        absent: makes a rig of the same kind that is not there.
    """
    return Examiner(make_rig, period, moving, beyond, absent).examine()
