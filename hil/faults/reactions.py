"""The matrix of reactions: a table of faults, each of which has a specified reaction.

Loop, messages and emulated rig are the real ones, connected in memory and on virtual time: results are reproducible.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from controller.inverse_kinematics import leg_lengths
from controller.planning.plan_handover import STREAM, note_sample, rest
from controller.planning.stream_planner import StreamPlanner
from controller.safety.causes import Cause, DriveState, Mode, Reaction, Request
from hil.faults.links import join_udp
from hil.faults.verdict import judge
from hil.loop.records import RECORD, Link, StopRequest
from hil.rigs.emulation import fault, sample
from hil.rigs.udp.emulator import check_watchdog
from hil.runs.config import SimulationConfig
from hil.runs.prepare import PreparedLoop, prepared_loop
from hil.runs.target_stream import Reception, encode
from hil.table import Table
from plant.encoders import NO_LENGTHS
from plant.mechanism import LEGS
from plant.pose import Array, quaternion_from_rotation
from plant.truth import TRUTH_LENGTHS

RATE_HZ = 1000.0
MOTION_S = 4.5
_FIRST_S, _SPREAD_S = 1.5, 1.0
_ZEROS_S = 3.5
"""With encoders everything is so much later: their zeros are known then."""
MOST_OFF_M, MOST_TURNED_RAD = 1e-3, float(np.radians(0.3))
"""With encoders, the greatest allowed error of the pose until a fault is told."""
_SAMPLE_CYCLES = 10
_SMOOTH = 20
"""Cycles over which a true acceleration is averaged: the IMUs' noise in the commands is no motion."""
MOST_TRAVEL_M = 0.03
"""The greatest allowed travel of a leg until it rests, after any fault."""
_SLACK, _HARDEST = 1.001, 1.5
"""Allowed factors over the limits, and of a controlled stop over the limit of acceleration."""

GO_ON, STOP, QUICK_STOP, BRAKE = Reaction


@dataclass(frozen=True)
class Case:
    """A fault and the reaction that it must cause.

    Attributes:
        name: in the table.
        expected: the cause that must be reported, or `Cause.NONE`.
        within: most cycles from the fault to this cause.
        peak: greatest allowed deviation of a leg from its reference [m].
        faults: of the rig, as `hil.rigs.emulation.fault` reads them; {k} is an IMU or drive, {j} another IMU.
        from_start: whether they are there before the motion.
        act: makes a fault that is not the rig's.
        streamed: the fault of a streamed target.
        also: other causes that may end the run.
        followed: whether it is known where the platform is until the fault is told. It is not if the rig has been killed, and
            the pose then counts until an answer is told to be late.
        lengths: the encoders, as in `SimulationConfig`.
    """

    kind: ClassVar[str] = "reactions"

    name: str
    expected: Cause
    reaction: Reaction
    within: int
    peak: float
    faults: str = ""
    from_start: bool = False
    act: Callable[[PreparedLoop], None] | None = None
    streamed: str = ""
    also: tuple[Cause, ...] = ()
    followed: bool = True
    lengths: str = NO_LENGTHS


def _ask(how: int, loop: PreparedLoop) -> None:
    loop.link[Link.STOP] = how


def _miss(periods: int, loop: PreparedLoop) -> None:
    cycle, period = int(loop.clock["cycles"]), int(loop.clock["period"])
    loop.script[cycle % len(loop.script), 0] = periods * period


def _kill_rig(loop: PreparedLoop) -> None:
    """A rig that was killed and started again has no session, and its drives hold."""
    assert loop.emulator is not None
    loop.emulator.session["id"] = 0
    loop.emulator.rig["request"], loop.emulator.rig["velocity"] = 0, 0.0


CASES = (
    Case("a leg's IMU is frozen", Cause.IMU_FROZEN, GO_ON, 15, 2e-3, "imu-frozen:{k}"),
    Case("a leg's IMU is dead", Cause.IMU_STALE, GO_ON, 15, 2e-3, "imu-dead:{k}"),
    Case("a leg's IMU is noisy", Cause.IMU_NOISY, GO_ON, 25, 2e-3, "imu-noisy:{k}"),
    Case("a leg's IMU is biased by 2 deg", Cause.IMU_CONTRADICTED, GO_ON, 600, 6e-3, "imu-biased:{k}"),
    Case(
        "a leg's IMU is biased by 2 deg from the start", Cause.NO_SENSORS, STOP, 5300, 1e-3,
        "imu-biased:{k}", from_start=True,
    ),
    Case(
        "two legs' IMUs are swapped from the start", Cause.GYROSCOPES_CONTRADICT, QUICK_STOP, 600, 4e-3,
        "imu-swapped:{k},size={j}", from_start=True, also=(Cause.IMUS_CONTRADICT, Cause.BASE_MOVES),
    ),
    Case("the platform's IMU is frozen", Cause.PLATFORM_IMU_LOST, STOP, 65, 2e-3, "imu-frozen:6"),
    Case("the platform's IMU is dead", Cause.PLATFORM_IMU_LOST, STOP, 65, 2e-3, "imu-dead:6"),
    Case(
        "the platform's IMU is biased by 2 deg", Cause.IMUS_CONTRADICT, QUICK_STOP, 800, 3e-3, "imu-biased:6",
        also=(Cause.PLATFORM_IMU_LOST,),
    ),
    Case("two IMUs are dead", Cause.IMUS_LOST, STOP, 15, 4e-3, "imu-dead:{k} imu-dead:{j}"),
    Case(
        "two IMUs are biased by 2 deg", Cause.TWO_FORCES, QUICK_STOP, 600, 10e-3,
        "imu-biased:{k} imu-biased:{j}", also=(Cause.IMUS_CONTRADICT,),
    ),
    Case("1 % of the packets are lost", Cause.NONE, GO_ON, 0, 2e-3, "bus-drops,size=0.01"),
    Case("10 % of the packets are lost", Cause.NONE, GO_ON, 0, 2e-3, "bus-drops,size=0.1"),
    Case("50 packets in a row are lost", Cause.BUS_LOST, QUICK_STOP, 21, 5e-3, "bus-down,for=0.05"),
    Case("packets come 0.2 ms late", Cause.NONE, GO_ON, 0, 2e-3, "bus-delays,size=0.2"),
    Case("packets come 5 ms late", Cause.BUS_LOST, QUICK_STOP, 21, 5e-3, "bus-delays,size=5"),
    Case("10 % of the packets are out of order", Cause.NONE, GO_ON, 0, 2e-3, "bus-reorders"),
    Case("10 % of the packets come twice", Cause.NONE, GO_ON, 0, 2e-3, "bus-repeats"),
    Case("10 % of the packets are damaged", Cause.NONE, GO_ON, 0, 2e-3, "bus-corrupts"),
    Case("the bus is down", Cause.BUS_LOST, QUICK_STOP, 21, 5e-3, "bus-down"),
    Case("the rig is killed and started again", Cause.BUS_LOST, QUICK_STOP, 21, 20e-3, act=_kill_rig, followed=False),
    Case("a drive has a fault", Cause.DRIVE_FAULT, QUICK_STOP, 3, 5e-3, "drive-faults:{k}"),
    Case("a drive loses its power", Cause.DRIVE_OFF, QUICK_STOP, 3, 5e-3, "drive-unpowered:{k}"),
    Case("a drive ignores its commands", Cause.MOVED_OTHERWISE, BRAKE, 1000, 10e-3, "drive-ignores:{k}"),
    Case("a drive stands still", Cause.MOVED_OTHERWISE, BRAKE, 1000, 10e-3, "drive-stuck:{k}"),
    Case("a drive runs away", Cause.MOVED_OTHERWISE, BRAKE, 60, 10e-3, "drive-runs-away:{k}"),
    Case("the payload gains 5 kg", Cause.NONE, GO_ON, 0, 3e-3, "payload-jumps"),
    Case("the payload loses 8 kg", Cause.NONE, GO_ON, 0, 3e-3, "payload-jumps,size=-8"),
    Case("5 periods are missed", Cause.NONE, GO_ON, 0, 3e-3, act=partial(_miss, 5)),
    Case("20 periods are missed", Cause.MISSED_PERIODS, STOP, 22, 15e-3, act=partial(_miss, 20)),
    Case(
        "50 periods are missed", Cause.DRIVE_FAULT, QUICK_STOP, 52, 15e-3, act=partial(_miss, 50),
        also=(Cause.MISSED_PERIODS,),
    ),
    Case("a stop is asked for", Cause.STOP_REQUESTED, STOP, 2, 2e-3, act=partial(_ask, StopRequest.CONTROLLED)),
    Case(
        "an emergency stop is asked for", Cause.EMERGENCY_STOP, QUICK_STOP, 2, 5e-3,
        act=partial(_ask, StopRequest.QUICK),
    ),
    Case("the target's stream stops", Cause.TARGET_LOST, STOP, 112, 2e-3, streamed="stops"),
    Case("the target's stream jumps", Cause.TARGET_JUMPS, STOP, 12, 2e-3, streamed="jumps"),
    Case("the target's stream turns NaN", Cause.TARGET_NOT_FINITE, STOP, 12, 2e-3, streamed="is not finite"),
)  # fmt: skip


def with_encoders(cases: Iterable[Case], lengths: str) -> list[Case]:
    """The cases whose faults begin after the encoders' zeros are known."""
    return [replace(case, lengths=lengths) for case in cases if not case.from_start]


@dataclass
class Outcome:
    """The outcome of a case over all seeds.

    Attributes:
        reactions: number of times of each.
        cycles: from the fault to its event; empty if none was expected.
        peak_m: greatest deviation of a leg from its reference since the fault, by seed.
        travel_m: greatest travel of a leg from the event to rest, by seed.
        position_m, rotation_rad: greatest errors of the pose from the fault to the event, or to the end, by seed.
        findings: differences from the specification, in words.
        fusion: how the IMUs are fused.
    """

    case: Case
    reactions: Counter[str] = field(default_factory=Counter)
    cycles: list[int] = field(default_factory=list)
    peak_m: list[float] = field(default_factory=list)
    travel_m: list[float] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    rotation_rad: list[float] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    fusion: str = "compiled"

    def __add__(self, other: "Outcome") -> "Outcome":
        """The outcome over the seeds of both."""
        names = [each.name for each in fields(self)[1:-1]]
        return replace(self, **{name: getattr(self, name) + getattr(other, name) for name in names})

    def row(self) -> dict[str, Any]:
        """The outcome with one seed, as a row of a table."""
        (reaction,) = self.reactions
        return {
            "reaction": reaction,
            "told_cycles": self.cycles[0] if self.cycles else None,
            "peak": self.peak_m[0],
            "travel": self.travel_m[0],
            "position_before": self.position_m[0],
            "rotation_before": self.rotation_rad[0],
            "findings": json.dumps(self.findings),
        }

    def with_row(self, row: Mapping[str, Any]) -> "Outcome":
        """The outcome with that of one more seed, from its `row`."""
        cycles = [] if row.get("told_cycles") is None else [int(row["told_cycles"])]
        before = [row["position_before"]], [row["rotation_before"]]
        findings = json.loads(row["findings"])
        reactions = Counter([row["reaction"]])
        return self + Outcome(
            self.case, reactions, cycles, [row["peak"]], [row["travel"]], *before, findings, self.fusion
        )  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """The figures, for JSON."""
        figures = {name: value for name, value in vars(self).items() if name != "case"}
        return {"case": self.case.name, "lengths": self.case.lengths, "expected": self.case.expected.text, **figures}


def table(outcomes: list[Outcome]) -> Table:
    """The outcomes in words; figures are the median and the greatest over the seeds."""
    result = Table("case", "told", "reaction", "cycles until told", "peak deviation [mm]", "travel to rest [mm]")
    for each in outcomes:
        told = each.case.expected.text.format("k") if each.case.expected else "-"
        cycles = f"{np.median(each.cycles):.0f}, {max(each.cycles)}" if each.cycles else "-"
        peaks, travels = 1e3 * np.array(each.peak_m), 1e3 * np.array(each.travel_m)
        peak = f"{np.median(peaks):.2f}, {peaks.max():.2f}"
        travel = f"{np.median(travels):.1f}, {travels.max():.1f}" if travels.any() else "-"
        result.add(each.case.name, told, ", ".join(each.reactions), cycles, peak, travel)
    return result


def pose_table(outcomes: Iterable[Outcome]) -> Table:
    """The errors of the pose with encoders until the fault is told, median and greatest over the seeds.

    Where there are several fusions, their cells have a stroke between them.
    """
    result = Table("case, with encoders", "fusion", "cycles until told", "pose until told [mm]", "[deg]")
    groups: dict[str, list[Outcome]] = {}
    for each in outcomes:
        groups.setdefault(each.case.name, []).append(each)
    for name, group in groups.items():
        cells = zip(*(_pose_cells(each) for each in group), strict=True)
        result.add(name, *(" / ".join(parts) for parts in cells))
    return result


def _pose_cells(each: Outcome) -> tuple[str, ...]:
    cycles = f"{np.median(each.cycles):.0f}, {max(each.cycles)}" if each.cycles else "-"
    positions, angles = 1e3 * np.array(each.position_m), np.degrees(each.rotation_rad)
    errors = f"{np.median(positions):.2f}, {positions.max():.2f}", f"{np.median(angles):.2f}, {angles.max():.2f}"
    return each.fusion, cycles, *errors


def try_case(case: Case, seed: int, fusion: str) -> Outcome:
    """The outcome of a case with one seed of IMUs and fault, its time and place.

    With encoders it begins after their zeros are known.

    Raises:
        GoughError: it cannot be run.
    """
    random = np.random.default_rng([seed, len(case.name), 6])
    later = 0.0 if case.lengths == NO_LENGTHS else _ZEROS_S
    at, duration = later + _FIRST_S + _SPREAD_S * random.random(), later + MOTION_S
    k, j = random.permutation(LEGS)[:2].tolist()
    begin = "" if case.from_start else f",at={round(at, 4)}"
    faults = [fault(text.format(k=k, j=j) + begin) for text in case.faults.split()]
    config = SimulationConfig(
        target="sines", duration=duration, rate=RATE_HZ, seed=seed, fusion=fusion, lengths=case.lengths
    )  # fmt: skip
    with prepared_loop(config) as loop:
        join_udp(loop, faults, seed)
        loop.records = np.zeros(1 << 14, RECORD)
        hold = int(loop.parameters["rig"]["hold_cycles"])
        onset = hold if case.from_start else hold + round(at * RATE_HZ)
        if case.streamed:
            onset -= onset % _SAMPLE_CYCLES
            _follow_stream(loop, case.streamed, onset)
        elif case.act is not None:
            loop.run(onset)
            case.act(loop)
        cause = loop.follow(hold + round(duration * RATE_HZ))
        _stand(loop)
        return _judge(Outcome(case, fusion=fusion), seed, loop, cause, onset)


def _stand(loop: PreparedLoop) -> None:
    """Let the rig go on by itself after the run, when no more commands come."""
    assert loop.emulator is not None
    begin = int(loop.emulator.rig["time_ns"])
    for passed in range(0, 500_000_000, 10_000_000):
        check_watchdog(loop.emulator, begin + passed)
    sample(loop.fmu, loop.imu, loop.encoders, loop.emulator.rig, int(loop.emulator.rig["time_ns"]))


def _follow_stream(loop: PreparedLoop, what: str, onset: int) -> None:
    """Stream the target until its fault."""
    target, mechanism, home = loop.target, loop.mechanism, loop.mechanism.require_home()
    hold = int(loop.parameters["rig"]["hold_cycles"])
    start = leg_lengths(mechanism, target.start.position, target.start.rotation)
    loop.stream, loop.segments = np.zeros((), STREAM), rest(start)
    reception = Reception(loop.stream, StreamPlanner(mechanism, start), 1.0 / RATE_HZ)
    for n, cycle in enumerate(range(hold + _SAMPLE_CYCLES - hold % _SAMPLE_CYCLES, onset + 1, _SAMPLE_CYCLES)):
        loop.run(cycle)
        time = (cycle - hold) / RATE_HZ
        position, rotation = (each[0] for each in target.at(np.array([time])))
        displacement = position - home.position
        if cycle == onset:
            if what == "stops":
                return
            displacement = displacement + (0.012 if what == "jumps" else np.nan) * np.array([0.0, 0.0, 1.0])
        quaternion = quaternion_from_rotation(rotation @ home.rotation.T)
        reception.take(encode(n, round(1e9 * time), displacement, quaternion), "here")
        note_sample(loop.stream, int(loop.clock["woke"]))
        reception.plan()


def _judge(outcome: Outcome, seed: int, loop: PreparedLoop, cause: int, onset: int) -> Outcome:
    """Compare the run with its specification."""
    assert loop.emulator is not None
    case = outcome.case
    limits, period = loop.mechanism.require_limits(), 1.0 / RATE_HZ
    records, rig = loop.records[: int(loop.link[Link.HEAD])], loop.emulator.rig

    def find(wrong: bool, what: str) -> None:
        if wrong:
            outcome.findings.append(f"{case.name}, seed {seed}: {what}")

    def most(values: Array) -> float:
        return float(np.abs(values).max(initial=0.0))

    # The cause that ended the run counts, not events before it.
    reaction = GO_ON if cause == Cause.END_OF_MOTION else Cause(cause).reaction
    outcome.reactions[reaction.text] += 1
    accepted = (case.expected, *case.also)
    if case.reaction == GO_ON:
        find(cause != Cause.END_OF_MOTION, f"ended: {loop.reason()}")
    else:
        find(cause not in accepted, f"ended for another cause: {loop.reason()}")
    begin = onset
    if case.expected != Cause.NONE:
        told = np.isin(records["event_cause"], accepted).any(axis=1)
        cycles = records["cycle"][told] - onset
        find(not len(cycles), "was not told")
        if len(cycles):
            begin += int(cycles[0])
            outcome.cycles.append(int(cycles[0]))
            find(cycles[0] > case.within, f"took {cycles[0]} cycles, and {case.within} are allowed")
    moved = records[records["request"] != Request.BRAKED]
    followed = moved[(moved["cycle"] >= onset) & (moved["mode"] != Mode.FAULT)]
    off = most(followed["truth"][:, TRUTH_LENGTHS] - followed["reference"][:, :, 0])
    outcome.peak_m.append(off)
    find(off > case.peak, f"a leg was {1e3 * off:.2f} mm off, and {1e3 * case.peak:g} are allowed")
    first = int(np.searchsorted(records["cycle"], onset))
    answered = len(records) if case.followed else first + int((records["silent"][first:] > 0).argmax()) + 1
    figures = judge(records[:answered], onset, frozenset(), cause, RATE_HZ)
    position, rotation = (float(figures[f"{part}_before"] or 0.0) for part in ("position", "rotation"))
    outcome.position_m.append(position)
    outcome.rotation_rad.append(rotation)
    find(
        case.lengths != NO_LENGTHS and (position > MOST_OFF_M or rotation > MOST_TURNED_RAD),
        f"the pose was {1e3 * position:.2f} mm and {np.degrees(rotation):.2f} deg off before it was told, and "
        f"{1e3 * MOST_OFF_M:g} and {np.degrees(MOST_TURNED_RAD):.1f} are allowed",
    )
    travel = 0.0
    after = records[(records["mode"] >= Mode.RUNNING) & (records["cycle"] >= begin)]["truth"][:, TRUTH_LENGTHS]
    if len(after) and case.reaction != GO_ON:
        travel = most(np.vstack([after, rig["truth"][TRUTH_LENGTHS]]) - after[0])
    outcome.travel_m.append(travel)
    find(travel > MOST_TRAVEL_M, f"a leg went on for {1e3 * travel:.1f} mm, and {1e3 * MOST_TRAVEL_M:g} are allowed")
    allowed = {case.reaction, *(each.reaction for each in case.also)}
    find(reaction not in allowed, f"the reaction was: {reaction.text}")
    # Commands and references stay within the limits; a quick stop is no harder than the limit of acceleration.
    find(most(records["command"]) > _SLACK * float(loop.parameters["pid"]["limit"]), "a command was above its limit")
    find(most(moved["reference"][:, :, 1]) > _SLACK * limits.velocity, "a reference was too fast")
    hardest = most(moved["reference"][:, :, 2])
    find(hardest > _SLACK * limits.acceleration, "a reference was beyond the limit of acceleration")
    steps = most(np.diff(records[records["request"] == Request.QUICK_STOP]["command"], axis=0))
    find(steps > _SLACK * limits.acceleration * period * (1 + int(records["missed"].max())), "a quick stop was too hard")
    if case.reaction == STOP:
        stopping = records[records["mode"] == Mode.STOPPING]["truth"][:, TRUTH_LENGTHS]
        hard = most(np.diff(stopping[::_SMOOTH], n=2, axis=0) / (_SMOOTH * period) ** 2)
        find(hard > _HARDEST * limits.acceleration, f"the legs stopped at {hard:.3g} m/s2")
    find(most(rig["velocity"]) > 0.0 or (rig["drive"] == DriveState.FOLLOWING).any(), "a drive still moves")
    expected_cycles = np.arange(len(records)) + np.cumsum(records["missed"])
    find(not np.array_equal(records["cycle"], expected_cycles), "a cycle is not recorded")
    return outcome
