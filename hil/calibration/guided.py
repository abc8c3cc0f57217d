"""Calibration of a machine that has never moved, from raw IMUs, step by step: each is announced, agreed to, and recorded.

The drives follow the plan alone until there is a first calibration. Every motion begins and ends at home, and keeps to the
limits that the user sets. A step's recording is kept, and a step whose recording was kept is not run again.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from controller.calibration.at_rest import RestCalibration, pose_covariance
from controller.calibration.file import Calibration, save_calibration
from controller.calibration.mounting_checks import check_gravity, spreads_of
from controller.planning.motions import EVERYWHERE
from controller.planning.target import Target
from hil.calibration.data import CalibrationData, Knowledge
from hil.calibration.excitation import (
    MotionLimits,
    calibration_targets,
    check_useful,
    check_within,
    cut_of_box,
    expected_accuracy,
    extent,
    gentle_mechanism,
)
from hil.calibration.procedure import FailedCalibrationError, RigCalibration, complete, every_cycle, finish
from hil.recording.mcap import read
from hil.rigs.kinematic import ideal_signals
from hil.runs.config import SimulationConfig
from hil.runs.names import name_of
from hil.runs.prepare import demands_of
from plant.compiled import Record
from plant.errors import CalibrationError, GoughError, InputError
from plant.files import write_whole
from plant.imu import ACCELEROMETER, STANDARD_GRAVITY
from plant.mechanism import Mechanism, load_spatial

ZEROING_S = 1.0
"""How long each run begins with the brakes on [s]."""
_ON_THE_BRAKES: dict[str, Any] = {"target": "hold", "arm": False}
_MOST_UNANSWERED = 0.1
"""Share of the cycles of the first step that may be without an answer of the rig."""
_SAME_PLACE = np.radians(2.0)
"""By how much gravity may have turned in an IMU since the first step, where the drives follow the plan alone [rad]."""
_READING_S, _TRYING_S = 2.0, 12.0


class Step(NamedTuple):
    """A step of the calibration: its recording's name, what will happen, and how long it takes without getting ready [s]."""

    name: str
    text: str
    seconds: float
    moves: bool = True
    recorded: bool = True  # in a file of every cycle; else in words


class Machine(NamedTuple):
    """What is calibrated: how it makes a run, which records to a file, and how it tries the legs one by one."""

    run: Callable[[SimulationConfig, Path], None]
    try_legs: Callable[[SimulationConfig], Sequence[str]]  # returns what was found wrong


class Guide(NamedTuple):
    """Whom the steps are told to."""

    announce: Callable[[int, int, Step], None]  # number, their count, step; raises to end the calibration before it
    tell: Callable[[str], None]  # what came out


@dataclass(frozen=True)
class Plan:
    """What the calibration will do: the configuration, whose mechanism keeps to the limits, the motions and the steps; and to
    what limits of the mechanism cut the box that a user gave, "" if they do not.
    """

    mechanism: Mechanism
    config: SimulationConfig
    targets: dict[str, Target]
    steps: tuple[Step, ...]
    cut: str = ""


def plan_calibration(config: SimulationConfig, limits: MotionLimits) -> Plan:
    """Plan the steps, before anything is read or moved.

    Raises:
        GoughError: the mechanism cannot be used, the limits are too narrow for a calibration, or a motion exceeds one.
    """
    mechanism = load_spatial(config.mechanism)
    gentle = gentle_mechanism(mechanism, limits)
    targets = calibration_targets(gentle, limits.box)
    check_useful(gentle, targets, limits.box)
    check_within(gentle, targets, demands_of(config, gentle))
    cut = "" if limits.box == EVERYWHERE else cut_of_box(gentle, targets, limits.box)
    if gentle is not mechanism:
        config = replace(config, mechanism=name_of("mechanism", gentle))
    most = gentle.require_limits().velocity

    def step(name: str, text: str) -> Step:
        moved, turned = extent(targets[name])
        where = f"up to {1e3 * moved:.3g} mm and {np.degrees(turned):.2g} deg from home, a leg at {1e3 * most:.3g} mm/s at most"
        return Step(name, f"{text}: {where}", float(targets[name].times[-1]) + ZEROING_S)

    steps = (
        Step(
            "reading",
            "Nothing moves, and the drives stay off: every IMU is read. The platform stands near home, to a few millimetres, "
            "and nobody touches it",
            _READING_S, moves=False,
        ),
        Step(
            "legs",
            "The drives are enabled for the first time. All legs move by 0.2 mm, then each by 2 mm, at 5 mm/s at most. A leg "
            "that goes the wrong way is stopped as soon as the IMUs show it",
            _TRYING_S, recorded=False,
        ),
        step("probing", "All legs move at once, and the drives follow the plan alone, whatever the IMUs read"),
        step("near-rests", "The platform rests at poses near home, and the drives still follow the plan alone"),
        step("rests", "The loop closes over the IMUs, with the first calibration, and the platform rests at wider poses"),
        step("shaking", "The platform shakes on all axes at once"),
    )  # fmt: skip
    return Plan(mechanism, replace(config, raw_imus=True), targets, steps, cut)


def lost_accuracy(plan: Plan, knowledge: Knowledge) -> str:
    """What the limits cost, in words: the accuracy at rest, within them and in the whole workspace."""
    whole = calibration_targets(plan.mechanism, MotionLimits().box)["rests"]
    within, best = (expected_accuracy(plan.mechanism, each, knowledge) for each in (plan.targets["rests"], whole))
    return (
        "calibrated at rest within these limits, poses in the whole workspace are expected to be "
        f"{1e3 * within.position:.2g} mm and {np.degrees(within.rotation):.2g} deg off (RMS), instead of "
        f"{1e3 * best.position:.2g} mm and {np.degrees(best.rotation):.2g} deg with all strokes; the shaking improves both"
    )


def calibrate_guided(
    plan: Plan, knowledge: Knowledge, output: Path, machine: Machine, guide: Guide, resume: bool = False, validate: bool = True
) -> RigCalibration:
    """Lead through the steps of a plan, and calibrate the IMUs.

    Args:
        plan: of `plan_calibration`.
        knowledge: besides the samples.
        output: the calibration's file; recordings are kept beside it, as FILE.reading.mcap and so on.
        machine, guide: what is calibrated, and whom the steps are told to.
        resume: whether to take kept recordings instead of running their steps again.
        validate: whether to compare calibrations by parts of the data as well.

    Raises:
        InputError: there are kept recordings, and they are not to be taken; or they are of another rig.
        FailedCalibrationError: a step failed; the message says which, and how to go on.
    """
    steps = _Steps(plan, output, machine, guide, resume)
    data = CalibrationData(plan.mechanism, plan.config.imu, plan.config.rate, knowledge, plan.config.seed)
    with TemporaryDirectory(prefix="gough-calibration-") as folder:
        steps.config = replace(plan.config, calibration=str(file := Path(folder) / "calibration.toml"))
        save_calibration(file, Calibration())
        with steps.next() as (step, due):
            reading = steps.records(step, due, **_ON_THE_BRAKES)
            guide.tell(_begin(data, reading))
        if not due and steps.next_follows_plan:
            again = Path(folder) / "again.mcap"
            machine.run(replace(steps.config, duration=ZEROING_S, hold=ZEROING_S, open_loop=True, **_ON_THE_BRAKES), again)
            _check_same_place(reading, read(again).records)
        save_calibration(file, data.zeroed())
        with steps.next() as (step, due):
            steps.try_legs(step, due)
            guide.tell("commands, gyroscopes and accelerometers agree with the mechanism")
        with steps.next() as (step, due):
            data.check_places(steps.records(step, due))
            guide.tell("every IMU reads the motion of its place")
        for open_loop in (True, False):
            with steps.next() as (step, due):
                data.add_rests(steps.records(step, due, open_loop=open_loop))
                at_rest = data.at_rest()
                save_calibration(file, data.with_base(at_rest.calibration()))
                guide.tell(f"{len(data.readings)} poses at rest: {_expected(plan.mechanism, at_rest)}")
        with steps.next() as (step, due):
            shaken = steps.records(step, due, open_loop=False)
            guide.tell("the platform rests; the constants are computed from all that was recorded, which takes up to a minute")
            return finish(data, at_rest, [shaken], None, validate)


def _begin(data: CalibrationData, records: Record) -> str:
    """Check what was read while nothing moved; returns what was found, in words."""
    unanswered = float((records["silent"] > 0).mean())
    if unanswered > _MOST_UNANSWERED:
        raise CalibrationError(
            f"the rig has not answered in time in {100.0 * unanswered:.2g} % of {len(records)} cycles; at most "
            f"{100.0 * _MOST_UNANSWERED:g} % may be lost: take a lower --rate, or see what 'gough check-rig' says of the bus"
        )
    data.begin(records, len(records))
    forces, still = records["specific_force"].mean(axis=0), np.zeros(6)
    expected = ideal_signals(data.mechanism)(data.mechanism.require_home(), still, still)
    tilt = check_gravity(forces, expected[ACCELEROMETER])
    off = np.degrees(np.abs(data.zero).max())
    strengths = np.linalg.norm(forces, axis=1) / STANDARD_GRAVITY
    return (
        f"all IMUs work: gyroscopes up to {off:.3g} deg/s off, accelerometers between {strengths.min():.3f} and "
        f"{strengths.max():.3f} g, and gravity at most {np.degrees(tilt):.2g} deg from where it comes from at home"
    )


def _check_same_place(before: Record, now: Record) -> None:
    """Check that the platform stands where it stood when the calibration began, by the same raw accelerometers."""
    forces = np.array([np.nanmean(each["specific_force"], axis=0) for each in (before, now)])
    turned = np.degrees(spreads_of(forces))
    if (most := float(turned.max())) > np.degrees(_SAME_PLACE):
        raise FailedCalibrationError(
            f"the platform does not stand where it stood in the first step: gravity has turned by {most:.2g} deg in IMU "
            f"{int(turned.argmax())}, and at most {np.degrees(_SAME_PLACE):g} deg are allowed, as the drives follow the plan "
            "alone next: bring it back near home, and give the same command"
        )


def _expected(mechanism: Mechanism, found: RestCalibration) -> str:
    home = mechanism.require_home()
    covariance = pose_covariance(mechanism, found.tilt, (home.position, home.rotation), found.covariance)
    position, rotation = (float(np.sqrt(np.trace(part))) for part in (covariance[:3, :3], covariance[3:, 3:]))
    return f"the pose at home is expected to be {1e3 * position:.2g} mm and {np.degrees(rotation):.2g} deg off (RMS)"


class _Steps:
    """Goes through the steps of a plan: announces each, does it or takes what was kept, and says how to go on if it fails."""

    def __init__(self, plan: Plan, output: Path, machine: Machine, guide: Guide, resume: bool) -> None:
        self.config = plan.config
        self._plan, self._output, self._machine, self._guide = plan, output, machine, guide
        self._number = 0
        there = [file for each in plan.steps if (file := self._file(each)).exists()]
        if there and not resume:
            raise InputError(f"{there[0]} is there, of an earlier calibration: go on from it with --resume, or remove it")

    @property
    def next_follows_plan(self) -> bool:
        """Whether the next step to be done relies on where the platform stands."""
        due = (each.name for each in self._plan.steps if not self._file(each).exists())
        return next(due, "") in ("legs", "probing", "near-rests")

    def _file(self, step: Step, kind: str = "") -> Path:
        return self._output.with_suffix(f".{step.name}{kind}{'.mcap' if step.recorded else '.txt'}")

    @contextmanager
    def next(self) -> Iterator[tuple[Step, bool]]:
        """Announce the next step; yields it, and whether it is to be done, as nothing of it was kept."""
        step, count = self._plan.steps[self._number], len(self._plan.steps)
        self._number += 1
        file, failed = self._file(step), self._file(step, ".failed")
        due = not file.exists()
        if due:
            self._guide.announce(self._number, count, step)
        else:
            self._guide.tell(f"step {self._number} of {count} was done: {file} is taken")
        try:
            yield step, due
        except KeyboardInterrupt:
            self._guide.tell(
                f"step {self._number} of {count}, {step.name}, was interrupted; drives to which nothing comes stop by "
                "themselves. Bring the platform near home, and go on from this step with --resume"
            )
            raise
        except GoughError as error:
            if not due:
                raise FailedCalibrationError(f"{file}: {error}; remove it to do step {self._number} again") from None
            where = f"; what it did is in {failed}" if failed.exists() else ""
            raise FailedCalibrationError(
                f"step {self._number} of {count}, {step.name}, failed: {error}{where}; "
                "when the cause is mended, bring the platform near home, and go on from this step with --resume"
            ) from None
        if due:
            # Only what has succeeded is taken by the next calibration.
            failed.replace(file)

    def records(self, step: Step, due: bool, **changes: Any) -> Record:
        """The records of a step, which is run if it is due; `changes` are of its configuration."""
        path = self._file(step, ".failed" if due else "")
        if due:
            usual = {"target": self._plan.targets.get(step.name), "duration": step.seconds - ZEROING_S, "open_loop": True}
            self._machine.run(replace(self.config, **({"hold": ZEROING_S} | usual | changes)), path)
        recording = complete(path, read(path))
        for name in ("mechanism", "imu", "rate"):
            if (was := recording.config[name]) != (now := getattr(self.config, name)):
                if name == "mechanism":
                    name, was, now = "mechanism, or --box, --speed or --force,", "another one", "not that"
                raise InputError(f"its {name} is {was}, and this calibration's is {now}: give the same options as before")
        records = every_cycle(recording.records)
        # A bus may need some cycles for the first samples.
        return records[np.isfinite(records["angular_velocity"]).all(axis=(1, 2)).argmax() :]

    def try_legs(self, step: Step, due: bool) -> None:
        """Try the legs one by one, and note what was found."""
        if not due:
            return
        found = self._machine.try_legs(self.config)
        write_whole(self._file(step, ".failed"), "\n".join(found or ["nothing was found"]).encode())
        if found:
            raise CalibrationError(" ".join(found))
