"""Safety: the states of a run, what is checked in every cycle, and how each cause ends or degrades a run."""

import numpy as np

from controller.estimation import imu_monitor
from controller.safety import arming, attribution, drives, encoder_watch, stop, watch
from controller.safety.causes import EVENTS
from controller.settings import DriveSettings, SafetySettings
from plant.compiled import Record, filled, record_dtype
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import Mechanism

PARAMETERS = record_dtype(
    arming=arming.PARAMETERS,
    monitor=imu_monitor.PARAMETERS,
    watch=watch.PARAMETERS,
    drives=drives.PARAMETERS,
    encoders=encoder_watch.PARAMETERS,
    stop=stop.PARAMETERS,
)
"""The constants of each part."""

STATE = record_dtype(
    mode=np.int64,
    request=np.int64,
    events=EVENTS,
    arming=arming.STATE,
    monitor=imu_monitor.STATE,
    watch=watch.STATE,
    attribution=attribution.STATE,
    drives=drives.STATE,
    encoders=encoder_watch.STATE,
    stop=stop.STATE,
)
"""The `Mode` of the run, the `Request` to the drives, the events of the cycle, and the state of each part."""


def safety_parameters(
    settings: SafetySettings, drive_settings: DriveSettings, mechanism: Mechanism, rate: float, arm: bool,
    position: bool = False, judged: bool = False,
) -> Record:  # fmt: skip
    """The constants (dtype `PARAMETERS`) in cycles of this rate [Hz].

    The drives are enabled only if `arm`, and close position loops if `position`. If evidence judges the IMUs, `judged`, they
    are enabled after it has done so once.
    """
    limits = mechanism.require_limits()
    return filled(
        PARAMETERS,
        arming=arming.arming_parameters(settings, rate, arm, judged),
        monitor=imu_monitor.monitor_parameters(settings, rate),
        watch=watch.watch_parameters(settings, rate, limits),
        drives=drives.drive_parameters(drive_settings, mechanism, position),
        encoders=encoder_watch.encoder_watch_parameters(settings, rate),
        stop=stop.stop_parameters(limits, rate),
    )


def watch_nothing(parameters: Record) -> None:
    """Let the cycle with these parameters arm and go on whatever it finds, for motions that do not rely on the estimate."""
    parameters["imus"]["noise"] = parameters["imus"]["shaking"]["limit"] = np.inf
    safety = parameters["safety"]
    safety["monitor"]["active"] = safety["arming"]["approach"] = safety["arming"]["judged"] = 0
    safety["arming"]["distance"] = safety["arming"]["drift"] = np.inf
    limits = safety["watch"]
    limits["most_lost_imus"], limits["conditioning"] = IMU_COUNT, 0.0
    limits["evidence"] = limits["level"] = np.inf
    limits["lengths"] = limits["plausible_lengths"] = -np.inf, np.inf
    for name in (
        "speed",
        "following",
        "saturation",
        "drive_deviation",
        "carried",
        "oscillation",
        "misfit",
        "without_platform_imu",
    ):
        limits[name] = np.inf
    safety["drives"]["slack"] = safety["encoders"]["deviation"] = np.inf


_LEAST_DEVIATION = 0.03
"""Slower than this, raw IMUs do not show that a drive does otherwise than commanded [m/s]."""


def watch_drives_alone(parameters: Record) -> None:
    """As `watch_nothing`, but a leg still ends the run that is too fast, or off its command by three
    quarters of its limit of speed: gyroscopes that are zeroed show so much.
    """
    limits, most = parameters["safety"]["watch"], float(parameters["safety"]["stop"]["velocity_limit"])
    kept = {
        "speed": float(limits["speed"]),
        "drive_deviation": min(float(limits["drive_deviation"]), max(0.75 * most, _LEAST_DEVIATION)),
    }
    watch_nothing(parameters)
    for name, limit in kept.items():
        limits[name] = limit
