"""The calibration of IMUs: its model, its file, and the cycle that applies it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from controller.calibration.file import (
    Calibration,
    calibrated_rig,
    calibration_for,
    join_gain,
    load_calibration,
    save_calibration,
    split_gain,
)
from controller.cycle import STATE, cycle_parameters
from controller.estimation.whole_mechanism.imu_errors import ERRORS
from controller.safety.causes import Cause
from controller.settings import control_settings, fusion_settings
from plant.errors import InputError
from plant.imu import imu_state, load_imu, measure
from plant.mechanism import load_spatial
from tests.controller.cycles import cycle
from tests.controller.leg_geometry import angle_between, rotation_of, static_signals


def numbers(low, high):
    return arrays(np.float64, 3, elements=st.floats(low, high))


def of_true_errors(imu, random):
    """The calibration that undoes an IMU layer's constant errors, with a covariance."""
    gain = np.linalg.inv(imu["gain"][:, :7])
    offset = -(gain @ imu["offset"][:, :7, :, None])[..., 0]
    root = random.normal(size=(7 * ERRORS, 7 * ERRORS)) * 10.0 ** random.uniform(-6.0, 0.0, 7 * ERRORS)[:, None]
    return Calibration(
        gain,
        offset,
        tilt=np.array([0.01, -0.02]),
        joints=random.normal(0.0, 1e-4, (2, 6, 3)),
        floor=np.array([1e-4, 3e-4]),
        covariance=root @ root.T,
        about={"date": "2026-11-21", "residuals": [0.1, 0.2], "poses_known": False},
    )


@given(scale=numbers(0.5, 2.0), axes=numbers(-0.3, 0.3), mounting=numbers(-1.5, 1.5))
def test_a_gain_splits_into_what_it_is_made_of(scale, axes, mounting):
    gain = join_gain(scale, axes, mounting)
    triangle = np.array([[1.0, axes[0], axes[1]], [0.0, 1.0, axes[2]], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(gain, Rotation.from_rotvec(mounting).as_matrix() @ triangle @ np.diag(scale), atol=1e-12)
    for found, given_ in zip(split_gain(gain), (scale, axes, mounting), strict=True):
        np.testing.assert_allclose(found, given_, atol=1e-9)


@pytest.mark.parametrize("value", [-2e-3, 2e-3])
@pytest.mark.parametrize(
    ("name", "index"), [("tilt", 0), ("tilt", 1), ("joints", (0, 5, 2)), ("joints", (1, 0, 0)), ("offset", (2, 6, 1))]
)
def test_a_single_correction_of_either_sign_survives_the_file(tmp_path, name, index, value):
    calibration = Calibration()
    getattr(calibration, name)[index] = value
    save_calibration(tmp_path / "c.toml", calibration)
    again = load_calibration(tmp_path / "c.toml")
    for each in ("gain", "offset", "tilt", "joints", "floor"):
        np.testing.assert_allclose(getattr(again, each), getattr(calibration, each), rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("gain", [np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), -np.inf)])
def test_a_gain_that_no_sensor_has_is_refused(gain):
    with pytest.raises(InputError, match="singular or mirrors"):
        split_gain(gain)


def test_it_is_the_inverse_of_the_imperfections(tmp_path):
    model = load_imu("mpu9150")
    still = {
        name: replace(getattr(model, name), noise=0.0, resolution=0.0)
        for name in ("gyroscope", "accelerometer", "magnetometer")
    }
    imu = imu_state(replace(model, **still), 3, 1e-3)
    random = np.random.default_rng(3)
    ideal, raw = random.normal(0.0, 1.0, (3, 7, 3)), np.zeros((3, 7, 3))
    measure(imu, ideal, raw)
    calibration = of_true_errors(imu, random)
    np.testing.assert_allclose(calibration.apply(raw), ideal, atol=1e-12)
    save_calibration(tmp_path / "c.toml", calibration)
    again = load_calibration(tmp_path / "c.toml")
    np.testing.assert_allclose(again.apply(raw), ideal, atol=1e-12)
    scale = np.sqrt(np.diag(calibration.covariance))
    np.testing.assert_allclose((again.covariance - calibration.covariance) / np.outer(scale, scale), 0.0, atol=1e-4)
    assert again.about == calibration.about
    for name in ("tilt", "joints", "floor"):
        np.testing.assert_array_equal(getattr(again, name), getattr(calibration, name))
    # What was measured by two, one after the other.
    gain, offset = np.tile(rotation_of([0.1, 0.0, 0.2]), (3, 7, 1, 1)), random.normal(size=(3, 7, 3))
    np.testing.assert_allclose(
        again.then(gain, offset).apply(raw), Calibration(gain, offset).apply(calibration.apply(raw)), atol=1e-12
    )


def test_the_cycle_applies_it(hexapod):
    """With raw IMUs and their calibration the pose at rest is as with ideal ones."""
    imu = imu_state(replace(load_imu("mpu9150"), magnetometer_rate=1000.0), 5, 1e-3)
    imu["noise"], imu["resolution"], imu["smoothing"] = 0.0, 0.0, (0.0, 1.0)
    calibration = replace(of_true_errors(imu, np.random.default_rng(5)), tilt=np.zeros(2))
    position, rotation = hexapod.home.position + [0.01, -0.02, 0.01], rotation_of([0.1, 0.05, -0.1])
    raw, segments = np.zeros((3, 7, 3)), np.zeros((6, 1, 5))
    segments[:, 0, 1] = 0.4
    settings = control_settings(hexapod), fusion_settings(hexapod)
    errors = []
    for each in (None, calibration):
        imu["cycle"] = 0
        parameters = cycle_parameters(hexapod, 1000.0, *settings, calibration=each)
        state = np.zeros((), STATE)
        for _ in range(100):
            measure(imu, static_signals(hexapod, position, rotation), raw)
            assert cycle(parameters, state, raw, segments) == Cause.NONE
        errors.append(
            (np.linalg.norm(state["pose"]["position"] - position), angle_between(state["pose"]["rotation"], rotation))
        )
    assert errors[1][0] < 1e-9
    assert errors[1][1] < 1e-9
    assert errors[0][0] > 5e-3


def test_what_it_leaves_is_what_the_filter_knows_of_the_sensors(hexapod):
    calibration = Calibration(covariance=np.diag(np.linspace(1.0, 2.0, 7 * ERRORS)))
    parameters = cycle_parameters(
        hexapod, 1000.0, control_settings(hexapod), fusion_settings(hexapod), whole="axes", calibration=calibration
    )
    prior = parameters["mechanism"]["filter"]["prior"]
    np.testing.assert_array_equal(prior[: 7 * ERRORS, : 7 * ERRORS], calibration.covariance)
    assert not prior[7 * ERRORS :].any()
    assert parameters["mechanism"]["filter"]["rig"] == 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("imu_0 = [", "is not valid TOML"),
        ("[imu_8.gyroscope]\nbias = [0, 0, 0]", "no table 'imu_8'"),
        ("[imu_7.magnetometer]\nbias = [0, 0, 0]", "imu_7 has no sensor 'magnetometer'"),
        ("[imu_0.compass]\nbias = [0, 0, 0]", "has no sensor 'compass'; it has gyroscope, accelerometer, magnetometer"),
        ("[imu_0.gyroscope]\noffset = [0, 0, 0]", "imu_0.gyroscope must be a table of bias, scale, axes, mounting"),
        ("[imu_0.gyroscope]\nbias = [0, 0]", r"imu_0.gyroscope.bias must have shape \(3,\)"),
        ("[imu_0.gyroscope]\nbias = [0, nan, 0]", r"imu_0.gyroscope.bias\[1\] is nan; it must be finite"),
        ("[imu_0.gyroscope]\nscale = [1, 0, 1]", r"imu_0.gyroscope.scale is \[1.0, 0.0, 1.0\]; it must be positive"),
        ("[covariance]\nsigmas = [1.0]", r"covariance.sigmas must have shape \(147,\)"),
        ("imu_0 = 3", "imu_0 must be a table, got 3"),
        ("joints = [1]", r"joints must be a table, got \[1\]"),
        ("[base]\ntitl = [0, 0]", "base has no entry 'titl'; it has tilt, floor"),
        ("[base]\ntilt = [0.1, -0.81]", "base.tilt must be within 0.8 rad of level"),
        ("[base]\nfloor = [1e-4, -1e-4]", "base.floor not negative"),
        ("[imu_6.magnetometer]\naxes = [0, 0, -1.1]", r"imu_6.magnetometer.axes is \[.*\]; an axis is at most 1 off"),
        ("[joints]\nbases = [0]", "joints has no entry 'bases'; it has base, platform"),
        ("[joints]\nplatform = [[0, 0, 0]]", r"joints.platform must have shape \(6, 3\)"),
        ('["imu_²"]', "no table 'imu_²'"),
        (f"[covariance]\nsigmas = {[1.0] * 147}\nfactor = [[1.0]]", "covariance.factor must have 147 rows"),
    ],
)
def test_a_malformed_file_is_refused_by_its_entry(tmp_path, text, complaint):
    path = tmp_path / "c.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=complaint):
        load_calibration(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*none\.toml: No such file"):
        load_calibration(tmp_path / "none.toml")


def test_what_a_file_does_not_say_stays_as_it_is(tmp_path):
    path = tmp_path / "c.toml"
    path.write_text("[imu_2.accelerometer]\nbias = [0.1, 0.0, 0.0]\n")
    calibration = load_calibration(path)
    expected = np.zeros((3, 7, 3))
    expected[1, 2, 0] = 0.1
    np.testing.assert_array_equal(calibration.offset, expected)
    np.testing.assert_array_equal(calibration.gain, np.tile(np.eye(3), (3, 7, 1, 1)))
    assert calibration.covariance is None


def test_a_file_is_read_as_the_papers_equation_37(tmp_path):
    """T S (raw + bias), and then the mounting: a quarter turn about z carries x to y."""
    path = tmp_path / "c.toml"
    path.write_text(
        f"[imu_3.gyroscope]\nbias = [0.1, -0.2, 0.3]\nscale = [2.0, 1.0, 0.5]\naxes = [0.1, 0.2, 0.3]\n"
        f"mounting = [0.0, 0.0, {np.pi / 2.0!r}]\n[imu_6.magnetometer]\nscale = [1.0, 4.0, 1.0]\nbias = [0.0, 5.0, 0.0]\n"
        "[base]\ntilt = [0.01, -0.02]\nfloor = [3e-4, 4e-3]\n"
        "[joints]\nplatform = [[0, 0, 0], [0, 1e-3, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]\n"
    )
    found, raw = load_calibration(path), np.zeros((3, 7, 3))
    raw[0, 3], raw[2, 6] = [0.4, 0.7, 1.7], [1.0, 2.0, 3.0]
    # (raw + bias) is (0.5, 0.5, 2), scaled (1, 0.5, 1), and with the axes (1 + 0.05 + 0.2, 0.5 + 0.3, 1).
    calibrated = found.apply(raw)
    np.testing.assert_allclose(calibrated[0, 3], [-0.8, 1.25, 1.0], rtol=1e-14)
    np.testing.assert_allclose(calibrated[2, 6], [1.0, 28.0, 3.0], rtol=1e-14)
    calibrated[0, 3] = calibrated[2, 6] = 0.0
    assert not calibrated.any()
    assert (found.tilt.tolist(), found.floor.tolist()) == ([0.01, -0.02], [3e-4, 4e-3])
    assert not found.joints[0].any() and found.joints[1, 1].tolist() == [0.0, 1e-3, 0.0]
    assert np.abs(found.joints).sum() == 1e-3


def test_the_file_tells_its_units(tmp_path):
    save_calibration(tmp_path / "c.toml", Calibration(joints=np.full((2, 6, 3), 1e-4)))
    text = (tmp_path / "c.toml").read_text()
    for imu in range(7):
        for sensor, unit in (("gyroscope", "rad/s"), ("accelerometer", "m/s2"), ("magnetometer", "uT")):
            assert f"[imu_{imu}.{sensor}]  # bias in {unit}, mounting in rad\n" in text


def test_one_calibration_after_another_is_both():
    random = np.random.default_rng(3)
    gains, offsets = np.eye(3) + 0.1 * random.normal(size=(2, 3, 7, 3, 3)), random.normal(size=(2, 3, 7, 3))
    first = Calibration(gains[0], offsets[0], tilt=np.array([0.01, 0.02]), floor=np.array([1e-4, 2e-4]))
    both, raw = first.then(gains[1], offsets[1], tilt=np.array([0.03, 0.0])), random.normal(size=(5, 3, 7, 3))
    once = np.einsum("skij,nskj->nski", gains[0], raw) + offsets[0]
    np.testing.assert_allclose(first.apply(raw), once, rtol=0.0, atol=1e-13)
    twice = np.einsum("skij,nskj->nski", gains[1], once) + offsets[1]
    np.testing.assert_allclose(both.apply(raw), twice, rtol=0.0, atol=1e-13)
    assert (both.tilt.tolist(), both.floor.tolist()) == ([0.03, 0.0], [1e-4, 2e-4])


# ---- of which rig, and whether it is whole ----


def written(tmp_path, hexapod, imu="mpu9150"):
    """A file with everything in it, as gough writes it; its calibration."""
    calibration = of_true_errors(imu_state(load_imu("mpu9150"), 4, 1e-3), np.random.default_rng(4))
    calibration = replace(calibration, about={"version": "0", **calibrated_rig(hexapod, imu)})
    save_calibration(tmp_path / "c.toml", calibration)
    return tmp_path / "c.toml", calibration


def test_a_whole_file_of_this_rig_is_taken_without_a_remark(tmp_path, hexapod):
    path, calibration = written(tmp_path, hexapod)
    found = calibration_for(path, hexapod, "mpu9150")
    assert found.remark == ""
    assert found.about == calibration.about
    np.testing.assert_allclose(found.gain, calibration.gain, atol=1e-12)


def test_a_file_of_another_rig_is_refused_with_what_differs(tmp_path, hexapod):
    path, _ = written(tmp_path, hexapod)
    moved = hexapod.moved_joints(np.pad([[[1e-4, 0.0, 0.0]]], ((1, 0), (0, 5), (0, 0))))
    own = replace(hexapod, plant=hexapod.plant | {"platform_imu_position": np.array([0.0, 0.01, 0.0])})
    for mechanism, imu, said in (
        (load_spatial("6-3-I"), "mpu9150", "of the mechanism 'hexapod', and this run has '6-3-I': give that with --mechanism"),
        (hexapod, "icm42688", "of the kind of IMU 'mpu9150', and this run has 'icm42688': give that with --imu"),
        (moved, "mpu9150", "of the geometry '.*', .*: joints, axes or places of the IMUs of 'hexapod' have changed since"),
        (own, "mpu9150", "of the geometry"),
    ):
        with pytest.raises(InputError, match=rf"c\.toml is a calibration {said}.*, or calibrate this rig"):
            calibration_for(path, mechanism, imu)
    # What does not belong to the IMUs may change.
    heavier = replace(hexapod, plant=hexapod.plant | {"payload.mass": np.array(12.0)}, limits=None)
    calibration_for(path, heavier, "mpu9150")


def test_a_file_of_imus_of_ones_own_is_taken_wherever_their_file_lies_until_its_figures_change(tmp_path, hexapod):
    mine, elsewhere = tmp_path / "mine.toml", tmp_path / "elsewhere" / "mine.toml"
    elsewhere.parent.mkdir()
    text = 'based_on = "mpu9150"\ndelay_ms = 2\n'
    mine.write_text(text)
    path, _ = written(tmp_path, hexapod, str(mine))
    elsewhere.write_text(f"# the same\n{text}")
    assert calibration_for(path, hexapod, str(elsewhere)).remark == ""
    elsewhere.write_text(text.replace("2", "3"))
    said = r"is a calibration of the kind of IMU 'mine \w{8}', and this run has 'mine \w{8}': give that with --imu"
    with pytest.raises(InputError, match=said):
        calibration_for(path, hexapod, str(elsewhere))


def test_no_cut_of_a_file_is_taken(tmp_path, hexapod):
    path, _ = written(tmp_path, hexapod)
    text = path.read_text()
    lines = text.splitlines(keepends=True)
    ends = [*np.cumsum([len(line) for line in lines])[:-1:3], *np.random.default_rng(0).integers(0, len(text) - 1, 20)]
    said = set()
    for end in ends:
        path.write_text(text[:end])
        with pytest.raises(InputError, match=r"c\.toml") as caught:
            load_calibration(path)
        said |= {
            word for word in ("was cut off or changed", "holds no constants", "is not valid TOML") if word in str(caught.value)
        }
    assert len(said) == 3
    path.write_text(text[: text.index("[imu_4.accelerometer]")])
    with pytest.raises(
        InputError, match=r"it lacks imu_4\.accelerometer, imu_4\.magnetometer, imu_5\.\w+, imu_5\.\w+ and 4 more"
    ):
        load_calibration(path)


def test_a_changed_number_is_told_and_a_comment_is_not(tmp_path, hexapod):
    path, calibration = written(tmp_path, hexapod)
    text = path.read_text()
    path.write_text("# the second rig\n\n" + text.replace("\n[base]", "\n\n[base]  # of the hall").replace(" = [", "=[ "))
    np.testing.assert_allclose(load_calibration(path).gain, calibration.gain, atol=1e-12)
    for old, new in (("tilt = [0.01,", "tilt = [0.02,"), ('mechanism = "hexapod"', 'mechanism = "6-5"'), ("version", "of")):
        assert text.count(old) == 1
        path.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=r"as its digest shows \(nothing is missing\): .* on purpose, remove its digest"):
            load_calibration(path)
    # On purpose, and so without the digest.
    path.write_text("".join(line for line in text.splitlines(keepends=True) if not line.startswith("digest")))
    assert load_calibration(path).remark == f"{path} has no digest, which would show a cut or a change"


def test_what_a_file_by_hand_lacks_is_said(tmp_path, hexapod):
    path = tmp_path / "mine.toml"
    path.write_text("[imu_2.accelerometer]\nbias = [0.1, 0.0, 0.0]\n")
    remark = calibration_for(path, hexapod, "ideal").remark
    assert remark == (
        f"{path} has no digest, which would show a cut or a change; no mechanism; no imu; nothing of imu_0.gyroscope, "
        "imu_0.accelerometer, imu_0.magnetometer, imu_1.gyroscope and 18 more, taken as free of errors"
    )
    path.write_text('[about]\nmechanism = "6-5"\n[imu_2.accelerometer]\nbias = [0.1, 0.0, 0.0]\n')
    with pytest.raises(InputError, match="of the mechanism '6-5'"):
        calibration_for(path, hexapod, "ideal")
    for text in ("", "# empty\n", '[about]\nmechanism = "hexapod"\n'):
        path.write_text(text)
        with pytest.raises(InputError, match="holds no constants: it is empty or was cut off"):
            load_calibration(path)


def test_a_file_of_an_older_version_is_taken_whole_and_refused_cut(tmp_path, hexapod):
    """They have a version and no digest."""
    path, calibration = written(tmp_path, hexapod)
    old = [line for line in path.read_text().splitlines(keepends=True) if not line.startswith(("digest", "geometry", "imu ="))]
    path.write_text("".join(old))
    found = calibration_for(path, hexapod, "icm42688")
    assert found.remark == f"{path} has no digest, which would show a cut or a change; no imu"
    np.testing.assert_allclose(found.gain, calibration.gain, atol=1e-12)
    last = next(i for i, line in enumerate(old) if line.startswith("[imu_6.magnetometer]"))
    for end in (last, last + 1, last + 4):
        path.write_text("".join(old[:end]))
        with pytest.raises(InputError, match=r"was cut off, as gough 0 writes all constants and it lacks imu_6\.magnetometer"):
            load_calibration(path)
