"""Signatures against the plant's layer of IMUs, and against frames of a base that moves, differentiated numerically."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.planning.target import load_target
from hil.studies.detectability.bounds import REST_S
from hil.studies.detectability.kinematics import motion_along, signals
from hil.studies.detectability.signatures import NoSignatureError, Stage, directions_of, signature
from plant.errors import UnknownNameError
from plant.imu import add_disturbances, imu_state, load_imu, measure
from plant.imu_disturbances import disturbance_of_text

RATE_HZ, CYCLES, SEED = 1000.0, 20, 3


def stage_of(hexapod, imu="mpu9150-calibrated", built=None, seconds=1.0):
    """A stage along `sines`, of a second of motion after the rest."""
    times = np.arange(round((REST_S + seconds) * RATE_HZ)) / RATE_HZ - REST_S
    motion = motion_along(load_target("sines", hexapod, seconds), hexapod, times)
    model = load_imu(imu)
    quiet = replace(model, gyroscope=replace(model.gyroscope, noise=0.0), accelerometer=replace(model.accelerometer, noise=0.0))
    return Stage(hexapod, built or hexapod, quiet, SEED, motion, times)


def measured(stage, *texts):
    """What the plant's layer reads in the stage, averaged over steps (M, 7, 6)."""
    state = imu_state(replace(stage.imu, disturbances=()), SEED, stage.period)
    add_disturbances(state, [disturbance_of_text(text).later(REST_S) for text in texts])
    exact = signals(stage.mechanism, stage.motion)
    ideal, readings = np.zeros((len(stage.times), 3, 7, 3)), np.empty((len(stage.times), 3, 7, 3))
    ideal[:, 0], ideal[:, 1] = exact.angular_velocity, exact.specific_force
    for n, signal in enumerate(ideal):
        measure(state, signal, readings[n])
    return np.moveaxis(readings[:, :2], 1, 2).reshape(-1, CYCLES, 7, 6).mean(axis=1)


@pytest.mark.parametrize(
    "texts",
    [
        ("imu-offset:all,axis=y,size_m_per_s2=0.5,at=0.2,ramp_s=0.5",),
        ("imu-offset:1+6,axis=0/0.89/-0.46,size_deg_per_s=3,at=0.2,sine_hz=2",),
        ("imu-scale:legs,sensor=accelerometer,axis=all,size_percent=5,at=0.3,settle_s=0.2",),
        ("imu-scale:2,sensor=gyroscope,axis=z,size_percent=50,at=0.3,for=0.4",),
        ("imu-turn:6,axis=x,size_deg=5,at=0.1", "imu-turn:0,axis=1/1/1,size_deg=-15,at=0.5,ramp_s=0.4"),
        ("imu-turn:4,axis=z,size_deg=3",),
        ("imu-stuck:3,sensor=accelerometer,axis=y,at=0.4",),
        ("imu-range:5,size_g=0.8,at=0.3",),
        ("imu-vibration:all,axis=z,size_g=1,sine_hz=999.9,at=0.1",),
        ("imu-vibration:2,axis=x,size_deg_per_s=20,sine_hz=170,at=0.1",),
        ("imu-vibration:all,axis=z,size_g=3.5,pulse_ms=4,repeat_hz=20,at=0.2",),
        ("imu-temperature:all,size_k=20,settle_s=0.3,at=0.1",),
        ("imu-supply:0+3,size_v=-0.5,at=0.2,for=0.3",),
    ],
    ids=lambda texts: texts[0].partition(",")[0],
)
def test_a_signature_is_what_the_plant_s_imus_read_more(hexapod, texts):
    stage = stage_of(hexapod)
    found = signature(stage, texts, CYCLES)[:, :42].reshape(-1, 7, 6)
    more = measured(stage, *texts) - measured(stage)
    size = np.abs(more).max(axis=(0, 1)).reshape(2, 3).max(axis=1).repeat(3)
    # Scale errors of 0.1 %, the delay of the low-passes, and steps of quantisation.
    assert np.all(np.abs(found - more) < 0.05 * size + np.repeat([1.5e-3, 0.03], 3))
    np.testing.assert_allclose(found.mean(axis=0), more.mean(axis=0), atol=2e-3 + 0.01 * size.max())


@pytest.mark.parametrize("axis", ["x", "1/0.5/0.2"])
@pytest.mark.parametrize("course", ["ramp_s=0.8", "sine_hz=1.5"])
def test_a_base_that_tilts_is_that_of_frames_in_the_world(hexapod, axis, course):
    stage = stage_of(hexapod)
    degrees = 0.2
    found = signature(stage, (f"base-tilt,axis={axis},size_deg={degrees},at=0.1,{course}",), 1)
    exact, t = signals(hexapod, stage.motion), stage.times
    vector = {"x": [1.0, 0.0, 0.0], "1/0.5/0.2": [1.0, 0.5, 0.2]}[axis]
    since = np.clip(t - 0.1, 0.0, None)
    span = 0.8 if course.startswith("ramp") else 0.1
    x = np.clip(since / span, 0.0, 1.0)
    gentle = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    angle = np.radians(degrees) * (gentle if course.startswith("ramp") else gentle * np.sin(2.0 * np.pi * 1.5 * since))
    base = Rotation.from_rotvec(angle[:, None] * np.array(vector) / np.linalg.norm(vector)).as_matrix()
    for k in (0, 3, 6):
        places = np.einsum("nij,nj->ni", base, exact.places[:, k])
        axes = base @ exact.axes[:, k]
        spin = np.swapaxes(axes, 1, 2) @ np.gradient(axes, t, axis=0)
        rate = spin[:, [2, 0, 1], [1, 2, 0]]
        # Differences of places have an error that those of a base at rest have, too.
        force = np.gradient(np.gradient(places, t, axis=0), t, axis=0) - hexapod.plant["gravity"]
        still = np.gradient(np.gradient(exact.places[:, k], t, axis=0), t, axis=0) - hexapod.plant["gravity"]
        more = np.einsum("nji,nj->ni", axes, force) - np.einsum("nji,nj->ni", exact.axes[:, k], still)
        inner = slice(1010, -10)
        np.testing.assert_allclose(found[inner, 6 * k : 6 * k + 3], (rate - exact.angular_velocity[:, k])[inner], atol=3e-4)
        off = np.abs(found[inner, 6 * k + 3 : 6 * k + 6] - more[inner])
        # Where its jerk jumps, the course has no second derivative that differences would meet.
        assert np.quantile(off, 0.98) < 4e-3 and off.max() < 0.03
        assert np.abs(more[inner]).max() > 0.02


def test_an_accelerated_base_adds_one_vector_that_every_imu_sees(hexapod):
    stage = stage_of(hexapod)
    found = signature(stage, ("base-acceleration,axis=0/0/1,size_m_per_s2=0.7,at=0.2",), 1)[-1, :42].reshape(7, 6)
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:], axis=1), 0.7, rtol=1e-9)
    axes = signals(hexapod, stage.motion).axes[-1]
    np.testing.assert_allclose(np.einsum("kij,kj->ki", axes, found[:, 3:]), np.tile([0.0, 0.0, 0.7], (7, 1)), atol=1e-9)


def test_joints_that_are_off_change_what_the_legs_read_and_nothing_of_the_platform(hexapod):
    built = hexapod.built(1e-3, 1)
    found = signature(stage_of(hexapod, built=built), (), CYCLES)
    assert np.abs(found[:, :36]).max() > 1e-2 and np.abs(found[:, 42:]).max() > 1e-5
    np.testing.assert_allclose(found[:, 36:42], 0.0, atol=1e-12)


def test_faults_without_a_signature_are_refused(hexapod):
    stage = stage_of(hexapod)
    for text in (
        "imu-noise:all,axis=all,size_g=0.1,at=1",
        "imu-clock:2,size_percent=1,at=1",
        "bus-drops",
        "drive-stuck:1,at=2",
    ):
        with pytest.raises(NoSignatureError):
            signature(stage, (text,), CYCLES)
    with pytest.raises(NoSignatureError, match="magnetometers"):
        signature(stage, ("imu-offset:6,axis=x,size_ut=3,at=0.1",), CYCLES)
    with pytest.raises(UnknownNameError):
        signature(stage, ("base-jump,axis=x,size_deg=3",), CYCLES)


def test_each_fault_has_directions_of_its_own():
    assert directions_of(("imu-turn:6,axis=x,size_deg=1", "imu-turn:1,axis=x,size_deg=1")) == 6
    assert directions_of(("imu-temperature:all,size_k=3",)) == 6
    assert directions_of(()) == directions_of(("base-tilt,axis=x,size_deg=1",)) == 3
