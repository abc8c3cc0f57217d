"""Runs on shaken, struck and clipped IMUs: they go on, and what happens is told; the pose stays right or the run ends."""

import numpy as np
import pytest

from controller.safety.causes import Cause
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.pose import pose_errors

SHOCKS_35 = "imu-vibration:all,axis=z,size_g=3.5,pulse_ms=4,repeat_hz=20,at_s=0.5"
SHOCKS_29 = "imu-vibration:all,axis=z,size_g=2.9,pulse_ms=4,repeat_hz=20,at_s=0.5"
CLIPPED = "imu-vibration:all,axis=z,size_g=5,at_s=0.5,for_s=0.03"


class Shaken:
    """A run with disturbances: its largest errors while it moves [mm, deg], and what it told."""

    def __init__(self, *faults, **choices):
        config = SimulationConfig(**({"target": "sines", "duration": 1.5, "faults": faults} | choices))
        self.stopped = None
        try:
            result = simulate(config)
        except SimulationStoppedError as error:
            self.stopped, result = error, error.result
        records, moving = result.records, result.times >= 0.0
        pose = records["position"], records["rotation"]
        errors = pose_errors(*pose, result.true_positions, result.true_rotations)[moving].reshape(-1, 2, 3)
        largest = np.linalg.norm(errors, axis=2).max(axis=0)
        self.position, self.rotation = 1e3 * largest[0], np.degrees(largest[1])
        causes = records["event_cause"][np.arange(8) < records["event_count"][:, None]]
        self.told = [Cause(cause) for cause in causes if cause != Cause.ARMED]
        self.used = np.bitwise_and.reduce(records["imus"][moving]) & 0x7F


@pytest.mark.parametrize(
    ("fusion", "faults", "told", "most"),
    [
        ("compiled", (SHOCKS_35,), [Cause.SHAKEN], 3.0),
        ("whole", (SHOCKS_29,), [Cause.SHAKEN], 1.5),
        ("whole", (CLIPPED,), [Cause.SHAKEN, Cause.BRIDGED], 1.5),
    ],
)
def test_shocks_and_clipped_readings_do_not_end_a_run_nor_bend_its_pose(fusion, faults, told, most):
    """The gyroscopes carry it half a second after the start, when their biases are hardly known.

    The estimate still trembles, and so the platform may: then the gains are halved.
    """
    run = Shaken(*faults, fusion=fusion)
    assert run.stopped is None and [cause for cause in run.told if cause != Cause.GAINS_HALVED] == told
    assert run.used == 0x7F
    assert run.position < most and run.rotation < 0.6


def test_readings_that_stay_clipped_end_a_run():
    run = Shaken("imu-vibration:all,axis=z,size_g=5,at_s=0.5")
    assert run.stopped is not None and Cause.BRIDGED in run.told and Cause.IMU_OUT_OF_RANGE in run.told
    assert run.position < 3.0


@pytest.mark.slow
@pytest.mark.parametrize("fusion", ["compiled", "whole"])
@pytest.mark.parametrize("rate", [250.0, 1000.0])
@pytest.mark.parametrize(
    "fault",
    [
        "imu-vibration:all,axis=x,size_g=3.2,pulse_ms=7,repeat_hz=13,at_s=0.5",
        "imu-vibration:legs,axis=z,size_g=2.4,pulse_ms=10,repeat_hz=9,at_s=0.5",
        "imu-vibration:6,axis=y,size_g=3.7,pulse_ms=5,repeat_hz=17,at_s=0.5",
        "imu-vibration:2,axis=-z,size_g=6,pulse_ms=3,repeat_hz=11,at_s=0.5",
    ],
)
def test_shocks_of_other_kinds_do_not_end_a_run_nor_bend_its_pose(fusion, rate, fault):
    """Shocks that last for a sample at least: of shorter ones, low rates see tails too small to be told from motion."""
    run = Shaken(fault, fusion=fusion, rate=rate, seed=11)
    assert run.stopped is None and Cause.SHAKEN in run.told
    assert run.position < 5.0 and run.rotation < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("rate", [250.0, 1000.0, 4000.0])
def test_vibration_that_lasts_goes_on_or_ends_the_run_before_the_pose_is_wrong(rate):
    """Half a second after the start, the gyroscopes cannot carry it for long."""
    run = Shaken("imu-vibration:all,axis=1/1/1,size_g=1.3,sine_hz=71,at_s=0.5", rate=rate, seed=11, duration=3.0)
    assert Cause.SHAKEN in run.told
    assert run.position < 5.0 and run.rotation < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("imu", "rates"),
    [
        ("mpu9150-calibrated", (250.0, 500.0, 4000.0)),
        ("icm42688", (250.0, 500.0, 4000.0)),
        ("ideal", (250.0, 500.0, 4000.0)),
        ("mpu9150-nominal", (250.0, 500.0, 1000.0)),
        ("icm42688-nominal", (250.0, 500.0, 1000.0)),
    ],
)
@pytest.mark.parametrize(("target", "fusion"), [("shaking", "whole"), ("steps", "compiled")])
def test_sound_runs_tell_nothing(imu, rates, target, fusion):
    for rate in rates:
        run = Shaken(target=target, fusion=fusion, rate=rate, imu=imu, seed=4)
        assert run.stopped is None and run.told == [], rate


def test_aliasing_is_said_before_a_run():
    said = simulate(SimulationConfig(duration=0.05, rate=250.0)).summary()["remarks"]
    (remark,) = (each for each in said if "alias" in each)
    assert "vibration can alias" in remark and "at most 125 Hz" in remark
