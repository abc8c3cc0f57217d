"""Every preset of six legs closes the loop."""

import numpy as np
import pytest

from controller.planning.motions import MOTIONS
from controller.planning.offline_planner import plan
from controller.planning.target import load_target
from hil.runs.config import SimulationConfig
from hil.runs.simulation import simulate
from plant.errors import InputError
from plant.mechanism import load_mechanism

PRESETS = ["hexapod", "6-3-I", "6-3-II", "6-4-I", "6-4-II", "6-5", "genhexkins"]
LEG_IMUS = (0, 1, 2, 3, 4, 5)


def relative_errors(result, group):
    """The position's in mm for each metre of leg, and the rotation's in degrees."""
    figures = result.summary()[group]
    size = result.mechanism.require_limits().stroke.mean()
    return 1e3 * figures["position_rms"] / size, np.degrees(figures["rotation_rms"])


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize(("imu", "bounds"), [("mpu9150-calibrated", (2.5, 0.3)), ("ideal", (0.2, 0.09))])
def test_every_preset_follows_a_circle(name, imu, bounds):
    result = simulate(SimulationConfig(mechanism=name, duration=1.0, imu=imu))
    for group in ("estimation", "tracking"):
        assert (np.array(relative_errors(result, group)) < bounds).all(), group
    assert result.reference.violations == 0


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("motion", MOTIONS)
def test_every_motion_is_within_every_preset(name, motion):
    mechanism = load_mechanism(name)
    assert plan(mechanism, load_target(motion, mechanism, 14.0), 14.0).violations == 0


@pytest.mark.parametrize("name", PRESETS)
def test_leg_imus_alone_close_the_loop_unless_one_joint_carries_three_legs_and_another_one(name):
    config = SimulationConfig(mechanism=name, duration=1.0, imus=LEG_IMUS)
    if name == "6-3-II":
        with pytest.raises(InputError, match="add legs, or the platform's IMU"):
            simulate(config)
    else:
        assert (np.array(relative_errors(simulate(config), "tracking")) < (2.5, 0.5)).all()
