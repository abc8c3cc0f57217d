"""No silent wrong pose at the start on mechanisms whose legs lean: over random geometries the estimate is right, or the IMUs
are refused with what would help, which does.
"""

import re

import numpy as np
import pytest

from controller.cycle import STATE, CycleStage, cycle_parameters
from controller.imu_set import check_imus
from controller.inverse_kinematics import sample_workspace
from controller.settings import control_settings, fusion_settings
from plant.errors import InputError
from plant.imu_wiring import ALL_IMUS
from tests.controller.cycles import run_stages
from tests.controller.leaning_legs import AXES, leaning, with_axis
from tests.controller.leg_geometry import static_signals

RATE_HZ, CYCLES = 1000.0, 100
SEEDS = [
    range(60),
    pytest.param(range(60, 240), marks=pytest.mark.slow),
    pytest.param(range(240, 1200), marks=pytest.mark.endurance),
]
JOINTS_REFUSED = r"(gravity hardly tells|within its workspace leg)"
REMEDY = re.compile(r"turn base_joint_axes\[(\d)\], such as to \[(.+)\], or leave its IMU out")


def estimate(parameters, signals):
    """The estimated position after 0.1 s of these readings."""
    state = np.zeros((), STATE)
    for _ in range(CYCLES):
        run_stages(parameters, state, signals, CycleStage.SCREENING, CycleStage.CONTROL)
        state["time"]["cycle"] += 1
    assert state["pose"]["found"]
    return state["pose"]["position"]


@pytest.mark.parametrize("seeds", SEEDS)
def test_at_rest_the_pose_is_right_at_once_or_the_imus_are_refused(hexapod, seeds):
    """Exact readings at home and at two other poses of the workspace; without and with the whole-mechanism filter."""
    kinds = set()
    for seed in seeds:
        mechanism, kind = leaning(hexapod, seed)
        if mechanism is None:
            continue
        whole = ("accelerometers", None)[seed % 2]
        try:
            settings = control_settings(mechanism), fusion_settings(mechanism)
            parameters = cycle_parameters(mechanism, RATE_HZ, *settings, whole=whole)
        except InputError as refused:
            assert re.match(JOINTS_REFUSED + "|the IMUs .* do not determine the pose", str(refused))
            continue
        kinds.add(kind)
        others = zip(*sample_workspace(mechanism, 2, seed), strict=True)
        for pose in [(mechanism.home.position, mechanism.home.rotation), *others]:
            found = estimate(parameters, static_signals(mechanism, *pose))
            np.testing.assert_allclose(found, pose[0], rtol=0.0, atol=1e-6, err_msg=f"seed {seed}, axes {kind}")
    assert kinds == set(AXES)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", SEEDS)
def test_the_axes_that_a_refusal_names_help(hexapod, seeds):
    helped = helpless = 0
    for seed in seeds:
        mechanism, _ = leaning(hexapod, seed)
        for _ in range(7 if mechanism is not None else 0):
            try:
                check_imus(mechanism, ALL_IMUS)
                break
            except InputError as refused:
                found = REMEDY.search(str(refused))
                if found is None:
                    helpless += re.match(JOINTS_REFUSED, str(refused)) is not None
                    break
                leg, axis = found.groups()
                mechanism = with_axis(mechanism, int(leg), [float(part) for part in axis.split(",")])
                helped += 1
        else:
            assert mechanism is None, f"seed {seed}: the axis of each leg was turned, and the IMUs are still refused"
    # Short legs that swing far have no such axis.
    assert helped > 0.25 * len(seeds) and helpless < 0.02 * len(seeds)
