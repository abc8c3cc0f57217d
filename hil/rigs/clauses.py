"""The clauses of the contract of a rig, and the result of an examination."""

from dataclasses import dataclass, field

from hil.rigs import Identity

FOLLOWED_WITHIN = 20
"""Exchanges within which the drives must do what is requested."""

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
    "gravity": "the accelerometers point as gravity does at home, by the mechanism's file",
    "commands": "the legs move as commanded, by how the accelerometers tilt",
    "gyroscopes": "the gyroscopes turn as the legs' motion makes them",
    "accelerometers": "each accelerometer tilts as the legs' motion makes it",
    "encoders": "the encoders, where there are any, read the legs' motion",
    "period": "an exchange returns within the period (p99)",
    "opens again": "after close it can be opened again",
    "absent": "a rig that is not there raises a RigError with a message",
}


@dataclass
class Examination:
    """The result of an examination."""

    findings: dict[str, list[str]] = field(default_factory=dict)  # by clause, of the clauses that were checked
    exchange_us: dict[str, float] = field(default_factory=dict)  # durations p50, p99 and max [us], and their number n
    identity: Identity | None = None

    def all_findings(self) -> list[str]:
        """The findings of all clauses."""
        return [text for each in self.findings.values() for text in each]
