"""The start of a run: the estimate is right where legs lean, and the platform does not jump when feedback closes."""

import numpy as np
import pytest

from controller.inverse_kinematics import leg_lengths
from controller.planning.plan_handover import rest
from controller.safety.causes import Cause, Mode
from hil.loop.records import Link
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.errors import InputError
from plant.truth import TRUTH_LENGTHS
from tests.controller.leaning_legs import document, leaning

ABOVE_M = 7.5e-3
FUSIONS = ["compiled", "whole"]


def errors_after_a_tenth_of_a_second(path, fusion):
    """Distances of the estimate from the truth [m]."""
    config = SimulationConfig(mechanism=str(path), target="hold", duration=0.3, imu="ideal", fusion=fusion)
    try:
        result = simulate(config)
    except SimulationStoppedError as stopped:
        result = stopped.result
    return np.linalg.norm(result.records["position"] - result.true_positions, axis=1)[100:]


@pytest.mark.parametrize("fusion", FUSIONS)
@pytest.mark.parametrize(
    ("home", "accepted"),
    [
        ([0.0, -0.6, 0.45], True), ([0.0, 0.5, 0.35], True), ([0.8, 0.0, 0.35], True), ([0.0, 1.0, 0.35], False),
        ([-0.5, 0.5, 0.3], False),
    ],
)  # fmt: skip
def test_with_a_home_that_is_shifted_the_estimate_is_right_or_the_axes_are_named(tmp_path, home, accepted, fusion):
    path = tmp_path / "shifted.toml"
    drives = (
        "[limits]\nacceleration = 0.3\n[plant.drive]\ncurrent_limit = 30.0\nvoltage_limit = 48.0\n[plant.brake]\nforce = 5e3\n"
    )
    path.write_text(f'based_on = "hexapod"\n[home]\nposition = {home}\n{drives}')
    if accepted:
        assert errors_after_a_tenth_of_a_second(path, fusion).max() < 0.01
    else:
        with pytest.raises(
            InputError, match=r"gravity hardly tells the angles of leg \d.*: turn base_joint_axes\[\d\], such as to"
        ):
            errors_after_a_tenth_of_a_second(path, fusion)


@pytest.mark.slow
@pytest.mark.parametrize("fusion", FUSIONS)
def test_on_random_mechanisms_whose_legs_lean_the_estimate_is_right(hexapod, tmp_path, fusion):
    ran = 0
    for seed in range(2000, 2040):
        mechanism, kind = leaning(hexapod, seed)
        if mechanism is None:
            continue
        path = tmp_path / f"{seed}.toml"
        path.write_text(document(mechanism))
        try:
            errors = errors_after_a_tenth_of_a_second(path, fusion)
        except InputError:
            continue
        ran += 1
        assert errors.max() < 0.01, (seed, kind)
    assert ran >= 10


@pytest.mark.parametrize("fusion", FUSIONS)
def test_a_platform_that_is_found_off_the_start_is_brought_there_within_the_limits(tmp_path, fusion):
    """Its plant starts above home, and the target stays at home."""
    path = tmp_path / "above.csv"
    path.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n" + "".join(f"{t},0,0,{ABOVE_M},1,0,0,0\n" for t in (0, 1)))
    with prepared_loop(SimulationConfig(target=str(path), duration=0.8, fusion=fusion)) as loop:
        home, limits = loop.mechanism.require_home(), loop.mechanism.require_limits()
        lengths = leg_lengths(loop.mechanism, home.position, home.rotation)
        loop.segments = rest(lengths)
        assert loop.run(loop.end) == Cause.NONE
        records = loop.records[: int(loop.link[Link.HEAD])]
    period, running = 1e-3, records["mode"] == Mode.RUNNING
    true, references = records["truth"][:, TRUTH_LENGTHS], records["reference"][running]
    begins = int(np.argmax(running))
    np.testing.assert_allclose(references[0, :, 0], records["lengths"][begins], rtol=0.0, atol=1e-12)
    assert np.abs(references[0, :, 0] - lengths).min() > 0.8 * ABOVE_M
    assert np.abs(references[:, :, 1]).max() <= limits.velocity and np.abs(references[:, :, 2]).max() <= limits.acceleration
    assert np.abs(np.diff(references[:, :, 2], axis=0)).max() <= 1.0001 * limits.jerk * period
    # At the limits of jerk the true legs reach 0.11 m/s; with a reference that begins at home it is 0.31 m/s and 18 m/s^2.
    assert np.abs(np.diff(true[begins:], axis=0)).max() < 0.15 * period
    assert np.abs(np.diff(records["command"], axis=0)).max() < 0.03
    np.testing.assert_allclose(true[-1], lengths, rtol=0.0, atol=1e-3)
