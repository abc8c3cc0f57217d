"""The closed loop with fewer sensors, on each of the paper's types: which sets close it, and how accurately.

The IMUs of a set sit on those legs that give the best conditioning at the worst pose of the workspace.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np

from controller.imu_set import check_imus
from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from hil.table import Table
from plant.dynamics.variables import PLATFORM_IMU
from plant.encoders import NO_LENGTHS, load_encoder
from plant.errors import InputError
from plant.mechanism import LEGS, Mechanism, load_spatial
from plant.mechanism.classification import MechanismClass, classify, joint_numbers

MECHANISMS = ("6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "hexapod", "genhexkins")
"""A preset of each type of the paper's section 2, and a second one of type n-6."""

_SECTION_5 = ("section-5",)


@dataclass(frozen=True)
class SensorSet:
    """IMUs on so many legs and on the platform, its magnetometer, encoders of all legs, and the fusions that use them."""

    label: str
    legs: int
    platform: bool = True
    magnetometer: bool = False
    lengths: str = NO_LENGTHS
    fusions: tuple[str, ...] = ("compiled", "whole")


SETS = (
    SensorSet("6 legs", 6, platform=False),
    SensorSet("4 legs", 4, platform=False),
    SensorSet("2 legs + yaw, section 5", 2, magnetometer=True, fusions=_SECTION_5),
    SensorSet("2 legs + yaw", 2, magnetometer=True),
    SensorSet("3 legs + tilt", 3),
    SensorSet("4 legs + tilt", 4),
    SensorSet("6 legs + tilt", 6),
    SensorSet("6 legs + yaw, section 5", 6, magnetometer=True, fusions=_SECTION_5),
    SensorSet("6 legs + yaw", 6, magnetometer=True),
    SensorSet("3 legs + tilt + incremental", 3, lengths="incremental"),
    SensorSet("6 legs + tilt + incremental", 6, lengths="incremental"),
    SensorSet("tilt + absolute", 0, lengths="absolute"),
    SensorSet("2 legs + absolute", 2, platform=False, lengths="absolute"),
    SensorSet("6 legs + tilt + absolute", 6, lengths="absolute"),
)
"""From the fewest IMUs to all, then with encoders. The tilt is the platform's roll and pitch."""


def paper_set(mechanism_class: MechanismClass) -> str:
    """The label of the sensors that the paper needs for this class (sections 3 to 5)."""
    if mechanism_class.group == "n-3-I":
        return "6 legs"
    return "4 legs + tilt" if mechanism_class.platform_count < LEGS else "2 legs + yaw, section 5"


@dataclass(frozen=True)
class Outcome:
    """The closed loop with a set of sensors.

    Attributes:
        mechanism, sensors: labels.
        paper: whether the paper needs exactly these.
        imus: their numbers; none if every choice was refused.
        conditioning: of direct kinematics at the worst pose of the workspace.
        refused: the reason why no choice can be used; empty if one can.
        runs: by fusion, `estimation` and `tracking` of `SimulationResult.summary`, or the reason why it `stopped`.
    """

    mechanism: str
    sensors: str
    paper: bool
    imus: tuple[int, ...]
    conditioning: float
    refused: str
    runs: dict[str, dict[str, Any]]


def evaluate_sensor_sets(
    mechanisms: Sequence[str] = MECHANISMS,
    sets: Sequence[SensorSet] = SETS,
    duration: float = 10.0,
    seed: int = 0,
    engine: Engine = IN_ONE_PROCESS,
    progress: Progress = no_progress,
) -> list[Outcome]:
    """Follow `sines` for `duration` [s] with every set of sensors, on presets or TOML files; `seed` is that of the IMUs.

    Raises:
        GoughError: a mechanism, the duration or the seed cannot be used.
    """
    configs = [SimulationConfig(name, "sines", duration, seed=seed) for name in mechanisms]
    least = {name: paper_set(classify(load_spatial(name))) for name in mechanisms}
    items = [(config, sensors, sensors.label == least[config.mechanism]) for config, sensors in product(configs, sets)]
    return engine.starmap(_evaluate, items, progress)


def _evaluate(config: SimulationConfig, sensors: SensorSet, paper: bool) -> Outcome:
    imus, conditioning, refused = choose_imus(load_spatial(config.mechanism), sensors, paper)
    config = replace(config, imus=imus, magnetometer=sensors.magnetometer, lengths=sensors.lengths)
    runs = {fusion: _follow(replace(config, fusion=fusion)) for fusion in sensors.fusions if imus}
    return Outcome(config.mechanism, sensors.label, paper, imus, conditioning, refused, runs)


def choose_imus(mechanism: Mechanism, sensors: SensorSet, paper: bool) -> tuple[tuple[int, ...], float, str]:
    """The best IMUs of a set, the worst conditioning with them, and why there are none."""
    best, refused = 0.0, ""
    imus: tuple[int, ...] = ()
    encoder = load_encoder(sensors.lengths)
    for legs in combinations(range(mechanism.legs), sensors.legs):
        if paper and sensors.legs == 4 and len(set(joint_numbers(mechanism.platform_joints)[list(legs)].tolist())) != 3:
            # The paper's section 4 uses two legs that meet, and two that end elsewhere.
            continue
        choice = (*legs, PLATFORM_IMU) if sensors.platform else legs
        try:
            conditioning = check_imus(mechanism, choice, sensors.magnetometer, sensors.fusions == _SECTION_5, encoder)
        except InputError as error:
            refused = str(error)
            continue
        if conditioning > best:
            best, imus = conditioning, choice
    return imus, best, "" if imus else refused


def _follow(config: SimulationConfig) -> dict[str, Any]:
    try:
        summary = simulate(config).summary()
    except SimulationStoppedError as error:
        return {"stopped": str(error)}
    return {group: summary[group] for group in ("estimation", "tracking")}


def table(outcomes: Sequence[Outcome], mechanism: str = "") -> Table:
    """Errors of the estimate with every set, of one mechanism alone if it is named; the paper's set has a star."""
    first = (mechanism,) if mechanism else ("mechanism", "sensors")
    errors = ("filters [mm / deg]", "at most", "whole [mm / deg]", "at most")
    result = Table(*first, "IMUs", "conditioning", *errors)
    for outcome in outcomes:
        if mechanism not in ("", outcome.mechanism):
            continue
        label = f"{outcome.sensors} *" if outcome.paper else outcome.sensors
        names = [label] if mechanism else [outcome.mechanism, label]
        imus, conditioning = "".join(map(str, outcome.imus)), f"{outcome.conditioning:.2f}"
        found = [imus, conditioning, *(cell for run in outcome.runs.values() for cell in _errors(run))]
        cells = [*names, *(["refused"] if outcome.refused else found)]
        result.add(*cells, *[""] * (len(result.headings) - len(cells)))
    return result


def _errors(run: dict[str, Any]) -> tuple[str, str]:
    """RMS and greatest error of a run in words, or "stopped"."""
    if "stopped" in run:
        return "stopped", ""
    found = run["estimation"]
    rms, most = (
        f"{1e3 * found[f'position_{kind}']:.2f} / {np.degrees(found[f'rotation_{kind}']):.2f}" for kind in ("rms", "max")
    )
    return rms, most


def reasons(outcomes: Sequence[Outcome]) -> list[str]:
    """Why sets were refused or runs stopped, a line each."""
    lines = [f"{each.mechanism}, {each.sensors}: {each.refused}" for each in outcomes if each.refused]
    lines += [
        f"{each.mechanism}, {each.sensors}, {fusion}: {run['stopped']}"
        for each in outcomes
        for fusion, run in each.runs.items()
        if "stopped" in run
    ]
    return lines
