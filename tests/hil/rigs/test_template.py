"""The template and its kinematic hexapod: what it does with commands, and a motion by hand-computed numbers."""

import numpy as np
import pytest

from hil.rigs import ANSWERED, BRAKED, ENABLED, FOLLOWING, QUICK_STOP, READY, SILENT, RigError, new_feedback
from hil.rigs.by_name import check_legs
from hil.rigs.kinematic import KinematicHexapod
from hil.rigs.template import TemplateRig
from plant.errors import InputError
from plant.mechanism import load_in_space, load_spatial
from plant.pose import rotation_from_quaternion

HEXAPOD = load_spatial("hexapod")
SPEEDS = np.array([0.01, -0.02, 0.03, -0.04, 0.05, -0.06])
LAG = 0.02
MS = 1_000_000


@pytest.fixture
def hexapod_at_rest():
    return KinematicHexapod(HEXAPOD)


def test_legs_follow_with_the_drives_lag(hexapod_at_rest):
    rig, before = hexapod_at_rest, hexapod_at_rest.lengths
    rig.commands = SPEEDS
    rig.advance(30 * MS + 1)
    left = np.exp(-1.5)
    np.testing.assert_allclose(rig.velocities, SPEEDS * (1.0 - left), rtol=1e-9)
    np.testing.assert_allclose(rig.lengths - before, SPEEDS * (0.03 - LAG * (1.0 - left)), rtol=1e-6)
    # In two steps it is the same, and the pose goes with the legs.
    lengths = rig.lengths
    rig.advance(40 * MS + 1)
    rig.advance(60 * MS + 1)
    np.testing.assert_allclose(rig.velocities, SPEEDS * (1.0 - np.exp(-3.0)), rtol=1e-9)
    np.testing.assert_allclose(rig.lengths - lengths, SPEEDS * (0.03 - LAG * (left - np.exp(-3.0))), rtol=1e-6)
    np.testing.assert_array_equal(rig.truth()[7:13], rig.lengths)
    np.testing.assert_array_equal(rig.truth()[:3], rig.pose.position)
    np.testing.assert_allclose(rotation_from_quaternion(rig.truth()[3:7]), rig.pose.rotation, atol=1e-12)


def test_without_a_command_for_long_the_legs_stop(hexapod_at_rest):
    rig, before = hexapod_at_rest, hexapod_at_rest.lengths
    rig.commands = 0.1 * SPEEDS
    rig.advance(90 * MS + 1)
    np.testing.assert_array_equal(rig.commands, 0.1 * SPEEDS)
    rig.advance(340 * MS + 1)
    # 0.1 s more of the command, and 0.15 s without it.
    reached = 1.0 - np.exp(-9.5)
    np.testing.assert_array_equal(rig.commands, 0.0)
    np.testing.assert_allclose(rig.velocities, 0.1 * SPEEDS * reached * np.exp(-7.5), rtol=1e-6)
    run_on = 0.19 - LAG * reached + LAG * reached * (1.0 - np.exp(-7.5))
    np.testing.assert_allclose(rig.lengths - before, 0.1 * SPEEDS * run_on, rtol=1e-6)


def test_at_rest_the_imus_read_gravity_and_the_magnetic_field(hexapod_at_rest):
    rates, forces, fields = hexapod_at_rest.signals
    np.testing.assert_allclose(rates, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.81, rtol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(fields, axis=1), np.hypot(18.0, 46.0), rtol=1e-9)
    rotation = HEXAPOD.require_home().rotation
    np.testing.assert_allclose(forces[6], rotation.T @ [0.0, 0.0, 9.81], atol=1e-9)
    np.testing.assert_allclose(fields[6], rotation.T @ [18.0, 0.0, -46.0], atol=1e-9)


def test_in_motion_the_platforms_imu_reads_its_turning(hexapod_at_rest):
    rig = hexapod_at_rest
    rig.commands = SPEEDS
    for ms in range(5, 85, 5):
        rig.advance(ms * MS)
    before, rates = rig.pose.rotation, rig.signals[0, 6].copy()
    rig.commands = SPEEDS
    rig.advance(81 * MS)
    turned = (before.T @ rig.pose.rotation - (before.T @ rig.pose.rotation).T) / 2.0 / 1e-3
    expected = np.array([turned[2, 1], turned[0, 2], turned[1, 0]])
    assert np.linalg.norm(expected) > 0.05
    np.testing.assert_allclose((rates + rig.signals[0, 6]) / 2.0, expected, atol=2e-3 * np.linalg.norm(expected))


def test_the_template_limits_commands_and_heeds_them_only_if_enabled():
    rig, feedback = TemplateRig(HEXAPOD, 0.005, None), new_feedback()
    assert rig.exchange(SPEEDS, ENABLED, feedback) == SILENT and feedback["sequence"].tolist() == 7 * [-1]
    for call in (rig.identify, rig.arm):
        with pytest.raises(RigError, match="not open"):
            call()
    rig.quick_stop()
    rig.open()
    rig.arm()
    assert rig.command_delay == 0.005
    command = np.array([0.1, -0.1, 0.4, -0.4, np.nan, -np.inf])
    assert rig.exchange(command, ENABLED, feedback) == ANSWERED
    limited = [0.1, -0.1, 0.35, -0.35, 0.0, -0.35]
    assert feedback["sent"].tolist() == limited and rig._hardware.commands.tolist() == limited
    assert (feedback["drive"] == FOLLOWING).all() and feedback["sequence"].tolist() == 7 * [0]
    assert np.isfinite(feedback["truth"][:13]).all() and np.isnan(feedback["truth"][13:]).all()
    assert feedback["round_trip_ns"] > 0
    for request in (BRAKED, QUICK_STOP):
        assert rig.exchange(command, request, feedback) == ANSWERED
        assert (feedback["sent"] == 0.0).all() and (feedback["drive"] == READY).all()
        assert (rig._hardware.commands == 0.0).all()
    rig.exchange(SPEEDS, ENABLED, feedback)
    rig.quick_stop()
    assert (rig._hardware.commands == 0.0).all() and feedback["sequence"].tolist() == 7 * [3]
    rig.close()
    rig.close()
    assert rig.exchange(SPEEDS, ENABLED, feedback) == SILENT


def test_the_templates_hardware_that_fails_is_silent(monkeypatch):
    rig, feedback = TemplateRig(HEXAPOD, 0.005, None), new_feedback()
    rig.open()

    def broken(time_ns):
        raise OSError("unplugged")

    monkeypatch.setattr(rig._hardware, "advance", broken)
    assert rig.exchange(SPEEDS, ENABLED, feedback) == SILENT


@pytest.mark.parametrize("rig", ["udp", "canopen"])
def test_buses_for_six_legs_refuse_three(rig):
    check_legs(rig, HEXAPOD)
    with pytest.raises(InputError, match=f"the rig '{rig}' has six legs, and .* has three"):
        check_legs(rig, load_in_space("planar-3rpr"))


@pytest.mark.parametrize("rig", ["fmu", "replay", "python:my_rig:MyRig"])
def test_other_rigs_have_the_mechanisms_legs(rig):
    check_legs(rig, load_in_space("planar-3rpr"))
