"""Configurations of the studies, checked when they are made; quick to load."""

from dataclasses import dataclass
from math import inf

from hil.option import integers, option
from hil.runs.config import CALIBRATION, FUSIONS, IMU, MECHANISM
from hil.runs.names import name_objects
from plant.checks import check_rate, checked_seed, nearest
from plant.encoders import NO_LENGTHS
from plant.errors import InputError, UnknownNameError

LEARNING_S = 20.0
"""The filters learn for this time [s]; errors count after it."""
WHOLE_FUSIONS = tuple(name for name, errors in FUSIONS.items() if errors is not None)
"""Names of the whole-mechanism filters."""
SECTIONS = ("motions", "faults", "start", "drift", "follow", "cost", "encoders")
"""Sections of an evaluation, of which the last is run only if it is asked for."""
_SEEDS = (0, 1, 2, 3, 4, 5)
_RATE = "samples per second, 50 to 4000"


def _check(rate: float, seeds: tuple[int, ...]) -> None:
    check_rate(rate)
    if not seeds:
        raise InputError("there must be a seed at least")
    for seed in seeds:
        checked_seed(seed)


@dataclass(frozen=True)
class ComparisonConfig:
    """Configuration of a comparison of the ways to fuse the IMUs."""

    mechanism: str = option("hexapod", MECHANISM)
    motion: str = option("1", "static, mixed (0.1 to 1 Hz), or a frequency [Hz]")
    duration: float = option(40.0, "duration of the motion, of which the first 20 s do not count", unit="s")
    rate: float = option(1000.0, _RATE, unit="Hz")
    imu: str = option("mpu9150-calibrated", IMU)
    calibration: str | None = option(None, CALIBRATION, metavar="FILE.toml")
    seeds: tuple[int, ...] = option(_SEEDS, "seeds of the IMUs' imperfections; errors are pooled over them", parse=integers)

    def __post_init__(self) -> None:
        name_objects(self)
        _check(self.rate, self.seeds)
        if not LEARNING_S < self.duration < 3600.0:
            raise InputError(f"the duration is {self.duration:g} s; it must be more than {LEARNING_S:g} s, which do not count")


@dataclass(frozen=True)
class EvaluationConfig:
    """Configuration of an evaluation of the fusion after a self-calibration; `only` has the sections to run."""

    mechanism: str = option("hexapod", MECHANISM)
    imu: str = option("mpu9150", IMU)
    fusion: str = option("whole-alignments", "whole, whole-gyroscopes or whole-alignments")
    rate: float = option(1000.0, _RATE, unit="Hz")
    joint_error: float = option(
        1e-4, "standard deviation of each coordinate of the joints, in the half of the motions with wrong joints", unit="mm"
    )
    seeds: tuple[int, ...] = option(_SEEDS, "one for each rig", parse=integers)
    starts: int = option(100, "number of starts in motion")
    still: float = option(600.0, "how long the platform stands still", unit="s")
    target: str = option("sines", "motion or CSV file for a minute in the closed loop")
    lengths: str = option(
        "incremental", "encoders of the section 'encoders': incremental, absolute, or a TOML file", metavar="KIND"
    )
    only: tuple[str, ...] = SECTIONS[:-1]

    def __post_init__(self) -> None:
        name_objects(self)
        _check(self.rate, self.seeds)
        if self.fusion not in WHOLE_FUSIONS:
            names = ", ".join(WHOLE_FUSIONS)
            raise UnknownNameError(
                f"no fusion of the whole mechanism {self.fusion!r}; there are {names}{nearest(self.fusion, WHOLE_FUSIONS)}"
            )
        if not 0.0 <= self.joint_error < inf:
            raise InputError(f"the joint error is {1e3 * self.joint_error:g} mm; it must be at least 0 and finite")
        if not 1 <= self.starts <= 10000:
            raise InputError(f"{self.starts} starts are asked for; there can be 1 to 10000")
        if not LEARNING_S < self.still <= 3600.0:
            raise InputError(f"the platform is to stand still for {self.still:g} s; it can for {LEARNING_S:g} to 3600 s")
        if "encoders" in self.only and self.lengths == NO_LENGTHS:
            raise InputError(
                f"lengths {NO_LENGTHS!r} leave the section 'encoders' nothing to evaluate; choose incremental, absolute or a "
                "TOML file"
            )


@dataclass(frozen=True)
class TuningConfig:
    """Configuration of a tuning of the noise that the fusion assumes."""

    mechanism: str = option("hexapod", MECHANISM)
    imu: str = option("mpu9150-calibrated", IMU)
    seeds: tuple[int, ...] = option(_SEEDS, "seeds of the IMUs' imperfections and the motions", parse=integers)
    rate: float = option(1000.0, _RATE, unit="Hz")

    def __post_init__(self) -> None:
        name_objects(self)
        _check(self.rate, self.seeds)
