"""What each set of sensors is worth: its bound at rest, with encoders and without, and what is left when one of it fails."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from hil.engine.engine import IN_ONE_PROCESS, Engine
from hil.progress import Progress, no_progress
from hil.studies.pose_bound.bound import bound_of, text
from hil.studies.pose_bound.model import Setup
from hil.studies.sensor_sets import SensorSet, choose_imus
from hil.table import Table
from plant.encoders import load_encoder
from plant.imu import load_imu
from plant.mechanism import load_in_space

SETS = (
    SensorSet("tilt", 0),
    SensorSet("2 legs", 2, platform=False),
    SensorSet("3 legs", 3, platform=False),
    SensorSet("4 legs", 4, platform=False),
    SensorSet("6 legs", 6, platform=False),
    SensorSet("1 leg + tilt", 1),
    SensorSet("2 legs + tilt", 2),
    SensorSet("3 legs + tilt", 3),
    SensorSet("4 legs + tilt", 4),
    SensorSet("6 legs + tilt", 6),
    SensorSet("2 legs + yaw", 2, magnetometer=True),
    SensorSet("6 legs + yaw", 6, magnetometer=True),
)
"""From one IMU to all. Each is tried without lengths, with incremental and with absolute encoders."""

Bound = tuple[float, float]
"""Position [m] and rotation [rad], standard deviations."""

_IMU = "mpu9150-calibrated"


@dataclass(frozen=True)
class Worth:
    """The bounds of a set after 1 s at rest.

    Attributes:
        imus: on the legs that suit the set best.
        none, incremental, absolute: with these encoders.
        imu_less, incremental_imu_less: without the IMU whose loss is worst from the start, without lengths and with incremental
            encoders.
        encoder_less: with absolute encoders on all legs but one, whose loss is worst.
    """

    mechanism: str
    sensors: str
    imus: tuple[int, ...]
    none: Bound
    imu_less: Bound
    incremental: Bound
    incremental_imu_less: Bound
    absolute: Bound
    encoder_less: Bound


def evaluate_worth(
    mechanisms: Sequence[str],
    sets: Sequence[SensorSet] = SETS,
    engine: Engine = IN_ONE_PROCESS,
    progress: Progress = no_progress,
) -> list[Worth]:
    """The worth of every set on presets or TOML files, as far as they have so many legs.

    Raises:
        GoughError: a mechanism cannot be used.
    """
    legs = {name: load_in_space(name).legs for name in mechanisms}
    pairs = [
        (name, sensors)
        for name, sensors in product(mechanisms, sets)
        if sensors.legs <= legs[name] and not (sensors.magnetometer and load_in_space(name).planar)
    ]
    return engine.starmap(_evaluate, pairs, progress)


def _evaluate(name: str, sensors: SensorSet) -> Worth:
    mechanism = load_in_space(name)
    imus, _, refused = choose_imus(mechanism, sensors, paper=False)
    if refused:
        imus, _, _ = choose_imus(mechanism, replace(sensors, lengths="absolute"), paper=False)
    alone = Setup(mechanism, imus, load_imu(_IMU), magnetometer=sensors.magnetometer)
    counting, knowing = (replace(alone, encoder=load_encoder(kind)) for kind in ("incremental", "absolute"))
    return Worth(
        name,
        sensors.label,
        imus,
        none=_worst([alone]),
        imu_less=_worst(_without_an_imu(alone)),
        incremental=_worst([counting]),
        incremental_imu_less=_worst(_without_an_imu(counting)),
        absolute=_worst([knowing]),
        encoder_less=_worst(
            [replace(knowing, encoders=tuple(set(range(mechanism.legs)) - {leg})) for leg in range(mechanism.legs)]
        ),
    )


def _without_an_imu(setup: Setup) -> list[Setup]:
    left = [tuple(imu for imu in setup.imus if imu != lost) for lost in setup.imus]
    return [replace(setup, imus=imus, magnetometer=setup.magnetometer and 6 in imus) for imus in left if imus]


def _worst(setups: Sequence[Setup]) -> Bound:
    """The greatest bounds of some setups after 1 s at rest; infinite without any."""
    bounds = [bound_of(setup).at(1.0) for setup in setups]
    positions, rotations = zip(*bounds, strict=True) if bounds else ((float("inf"),), (float("inf"),))
    return max(positions), max(rotations)


def table(worths: Sequence[Worth]) -> Table:
    """The bounds in mm and deg; a dash where the pose is not known."""
    headings = ("none", "an IMU less", "incremental", "an IMU less", "absolute", "an encoder less")
    made = Table("mechanism", "sensors", "IMUs", *headings, left=(0, 1))
    for each in worths:
        bounds = (
            each.none, each.imu_less, each.incremental, each.incremental_imu_less, each.absolute, each.encoder_less,
        )  # fmt: skip
        made.add(each.mechanism, each.sensors, "".join(map(str, each.imus)), *map(text, bounds))
    return made
