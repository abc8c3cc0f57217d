"""Documents of mechanisms: what a file may say, what it may be based on, and what is refused."""

import pickle
from pathlib import Path

import numpy as np
import pytest

from plant.errors import InputError, UnknownNameError
from plant.mechanism import Mechanism, PlanarMechanism, load_in_space, load_mechanism, load_spatial
from plant.pose import Array, Pose

BASE = [[0.3, -0.05, 0.0], [0.3, 0.05, 0.0], [-0.1, 0.28, 0.0], [-0.2, 0.23, 0.0], [-0.2, -0.23, 0.0], [-0.1, -0.28, 0.0]]
PLATFORM = [
    [0.13, -0.15, 0.0],
    [0.13, 0.15, 0.0],
    [0.06, 0.19, 0.0],
    [-0.19, 0.04, 0.0],
    [-0.19, -0.04, 0.0],
    [0.06, -0.19, 0.0],
]
HOME = Pose(np.array([0.0, 0.0, 0.35]), np.eye(3))


def lengths_at(mechanism: Mechanism, position: Array, rotation: Array) -> Array:
    return np.linalg.norm(position + mechanism.platform_joints @ rotation.T - mechanism.base_joints, axis=1)


GOOD = f"""
name = "mine"
[geometry]
base_joints = {BASE}
platform_joints = {PLATFORM}
up_in_base = [0.0, 0.6, 0.8]
[home]
position = [0.0, 0.0, 0.35]
[limits]
stroke = [-0.05, 0.05]
[plant.platform]
mass = 2.5
[control]
proportional = 30.0
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def test_a_mechanism_is_loaded_from_a_file(tmp_path: Path) -> None:
    mechanism = load_mechanism(write(tmp_path, GOOD))
    assert mechanism.name == "mine"
    np.testing.assert_array_equal(mechanism.base_joints, BASE)
    np.testing.assert_allclose(mechanism.up_in_base, [0.0, 0.6, 0.8])
    assert mechanism.plant["platform.mass"] == 2.5
    assert mechanism.settings["control"] == {"proportional": 30.0}
    np.testing.assert_allclose(np.ptp(mechanism.require_limits().stroke, axis=1), 0.1)


def replaced(old: str, new: str) -> str:
    assert old in GOOD
    return GOOD.replace(old, new)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (replaced("[home]", "[home"), "mine.toml is not valid TOML: .*line"),
        (replaced("[control]", "[kontrol]"), "unknown entry 'kontrol'; a mechanism has name, geometry, home, limits, plant"),
        (replaced("[home]\n", "[home]\nattitude = 1\n"), r"\[home\] has no entry 'attitude'; it has position, quaternion"),
        (replaced("stroke = ", "strokes = "), r"\[limits\] has no entry 'strokes'"),
        (replaced("base_joints = ", "joints = "), r"\[geometry\] has no entry 'joints'"),
        ("name = 'empty'", r"\[geometry\] lacks base_joints, an array of six rows"),
        (f"[geometry]\nbase_joints = {BASE}", r"\[geometry\] lacks platform_joints"),
        (replaced("[control]", "[home2]"), "unknown entry 'home2'"),
        ("geometry = 3", "'geometry' must be a table"),
        (replaced("[0.0, 0.0, 0.35]", "'here'"), "home.position must be an array of numbers .* got 'here'"),
        (replaced("position = [0.0, 0.0, 0.35]", ""), r"home.position must be an array .* got None"),
        (replaced("0.35]", "0.35]\nquaternion = [1.0, 0.1, 0.0, 0.0]"), "home.quaternion has length 1.00499; .* normalise it"),
        (replaced("[0.0, 0.6, 0.8]", "[0.0, 0.6, 0.9]"), "up_in_base has length 1.08"),
        (replaced("mass = 2.5", "mass = -2.5"), "platform.mass is -2.5 kg; it must be 1e-09 to"),
        (replaced("mass = 2.5", "weight = 2.5"), "no parameter 'platform.weight'"),
        (replaced("mass = 2.5", "mass = 'heavy'"), "platform.mass must be an array of numbers .* got 'heavy'"),
    ],
)
def test_a_file_that_is_no_mechanism_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises((InputError, UnknownNameError), match=message) as caught:
        load_mechanism(write(tmp_path, text))
    assert str(caught.value).count("mine.toml") == 1


def test_a_file_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match=r"cannot read .*binary.toml"):
        load_mechanism(path)


def test_an_unknown_preset_names_the_presets(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"no mechanism 'hexapot': neither a preset .*hexapod.* nor a file"):
        load_mechanism("hexapot")
    with pytest.raises(UnknownNameError, match="nor a file"):
        load_mechanism(tmp_path)


# ---- based on a preset ----


@pytest.fixture
def presets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of presets with a good one, another based on it, and two based on each other."""
    folder = tmp_path / "presets"
    folder.mkdir()
    stiffer = 'name = "stiffer"\nbased_on = "good"\n[control]\nintegral = 90.0\n[plant.payload]\nmass = 4.0\n'
    for name, text in {"good": GOOD, "stiffer": stiffer, "egg": 'based_on = "hen"', "hen": 'based_on = "egg"'}.items():
        (folder / f"{name}.toml").write_text(text)
    monkeypatch.setattr("plant.mechanism.documents._PRESETS", folder)
    return folder


def test_tables_are_laid_over_those_of_the_preset(tmp_path: Path, hexapod: Mechanism) -> None:
    text = f'based_on = "hexapod"\n[geometry]\nbase_joints = {BASE}\n[plant.payload]\nmass = 4\n[control]\nhold = 0.5\n'
    mechanism = load_mechanism(write(tmp_path, text))
    np.testing.assert_array_equal(mechanism.base_joints, BASE)
    np.testing.assert_array_equal(mechanism.platform_joints, hexapod.platform_joints)
    lengths = lengths_at(mechanism, HOME.position, HOME.rotation)
    np.testing.assert_allclose(mechanism.require_limits().stroke - lengths[:, None], np.tile([-0.06, 0.06], (6, 1)), atol=1e-15)
    assert {name for name, value in hexapod.plant.items() if (mechanism.plant[name] != value).any()} == {"payload.mass"}
    assert mechanism.settings["control"] == {**hexapod.settings["control"], "hold": 0.5}
    assert mechanism.name == "custom"


def test_a_preset_may_be_based_on_another(tmp_path: Path, presets: Path) -> None:
    mechanism = load_mechanism(write(tmp_path, 'based_on = "stiffer"\n[plant.platform]\nmass = 3.0'))
    np.testing.assert_array_equal(mechanism.base_joints, BASE)
    assert mechanism.settings["control"] == {"proportional": 30.0, "integral": 90.0}
    assert [mechanism.plant[f"{body}.mass"] for body in ("payload", "platform")] == [4.0, 3.0]
    assert load_mechanism("stiffer").name == "stiffer"
    assert load_mechanism("stiffer").plant["platform.mass"] == 2.5


def test_only_presets_can_be_based_on(tmp_path: Path, presets: Path) -> None:
    (tmp_path / "other.toml").write_text(GOOD)
    message = r"mine.toml: based_on names no preset: .*; there are egg, good, hen, stiffer"
    for base in ("'hexapod'", f"'{tmp_path / 'other.toml'}'", "3", "['good']"):
        with pytest.raises(UnknownNameError, match=message):
            load_mechanism(write(tmp_path, f"based_on = {base}"))


def test_presets_based_on_each_other_are_refused(tmp_path: Path, presets: Path) -> None:
    with pytest.raises(InputError, match="egg: based_on goes round in a circle, egg -> hen -> egg: leave one out"):
        load_mechanism("egg")
    with pytest.raises(InputError, match=r"circle, .*mine.toml -> hen -> egg -> hen"):
        load_mechanism(write(tmp_path, "based_on = 'hen'"))


def test_what_a_preset_has_as_a_table_must_stay_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'limits' must be a table"):
        load_mechanism(write(tmp_path, "based_on = 'hexapod'\nlimits = 3"))


def test_every_table_reaches_the_mechanism(tmp_path: Path) -> None:
    """Numbers that no default has, in every table."""
    half = np.radians(20.0) / 2.0
    axes = np.tile([0.6, 0.8, 0.0], (6, 1))
    text = replaced("0.35]", f"0.35]\nquaternion = [{np.cos(half)}, 0.0, 0.0, {np.sin(half)}]")
    text = text.replace("up_in_base = ", f"base_joint_axes = {axes.tolist()}\nup_in_base = ")
    text = text.replace(
        "[-0.05, 0.05]", "[-0.04, 0.05]\nvelocity = 0.2\nacceleration = 2.0\njerk = 50.0\nstop_clearance = 0.003"
    )
    text += "[plant.leg.lower]\nmass = 1.5\n[plant.motor]\nresistance = [1, 2, 3, 4, 5, 6]\n"
    text += "[fusion]\na = 1.0\n[safety]\nb = 2.0\n[drives]\nc = 3.0\n"
    mechanism = load_mechanism(write(tmp_path, text))
    assert isinstance(mechanism, Mechanism)
    home, kept = mechanism.require_home(), mechanism.require_limits()
    turned = [[np.cos(2 * half), -np.sin(2 * half), 0.0], [np.sin(2 * half), np.cos(2 * half), 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(home.rotation, turned, atol=1e-15)
    np.testing.assert_allclose(kept.stroke, lengths_at(mechanism, home.position, home.rotation)[:, None] + [-0.04, 0.05])
    assert (kept.velocity, kept.acceleration, kept.jerk, kept.stop_clearance) == (0.2, 2.0, 50.0, 0.003)
    np.testing.assert_allclose(mechanism.base_joint_axes, axes, atol=1e-15)
    np.testing.assert_array_equal(mechanism.platform_joints, PLATFORM)
    assert set(mechanism.plant) == {"platform.mass", "leg.lower.mass", "motor.resistance"}
    assert mechanism.plant["leg.lower.mass"] == 1.5
    np.testing.assert_array_equal(mechanism.plant["motor.resistance"], [1, 2, 3, 4, 5, 6])
    rest = {"fusion": {"a": 1.0}, "safety": {"b": 2.0}, "drives": {"c": 3.0}}
    assert mechanism.settings == {"control": {"proportional": 30.0}, **rest}


def test_without_a_name_and_an_attitude_it_is_custom_and_level(tmp_path: Path) -> None:
    mechanism = load_mechanism(write(tmp_path, replaced('name = "mine"', "")))
    assert isinstance(mechanism, Mechanism) and mechanism.name == "custom"
    np.testing.assert_array_equal(mechanism.require_home().rotation, np.eye(3))
    assert mechanism.settings["safety"] == {} == mechanism.settings["fusion"]


def test_three_legs_in_the_plane_are_loaded_for_the_loop_only() -> None:
    assert isinstance(load_mechanism("planar-3rpr"), PlanarMechanism)
    with pytest.raises(InputError, match="planar-3rpr has three legs in the plane; this needs six in space"):
        load_spatial("planar-3rpr")
    seen = load_in_space("planar-3rpr")
    assert (seen.legs, seen.planar) == (3, True)
    for load in (load_mechanism, load_spatial, load_in_space):
        assert (load("hexapod").legs, load("hexapod").planar) == (6, False)


def test_a_planar_mechanism_without_a_home_is_none_for_the_loop(tmp_path: Path) -> None:
    joints = (
        "[geometry]\nbase_joints = [[0.0, 0.0], [0.2, 0.0], [0.3, 0.1]]\nplatform_joints = [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]"
    )
    path = write(tmp_path, joints)
    assert isinstance(load_mechanism(path), PlanarMechanism)
    with pytest.raises(InputError, match="the mechanism 'custom' has no home pose: give one"):
        load_in_space(path)


@pytest.mark.parametrize("name", ["hexapod", "planar-3rpr"])
def test_a_mechanism_arrives_in_another_process_bit_for_bit(name: str) -> None:
    mechanism = load_mechanism(name)
    came = pickle.loads(pickle.dumps(mechanism))
    assert came.base_joints.tobytes() == mechanism.base_joints.tobytes()
    assert came.limits.stroke.tobytes() == mechanism.limits.stroke.tobytes()
    assert {key: value.tobytes() for key, value in came.plant.items()} == {
        key: value.tobytes() for key, value in mechanism.plant.items()
    }
    assert came.settings == mechanism.settings and came.name == name
    for table in (came.plant, came.settings):
        with pytest.raises(TypeError):
            table["mass"] = 1.0


# ---- what is hardly meant ----


@pytest.mark.parametrize(
    ("text", "message"),
    [
        # The order x, y, z, w: no turn, read as a half turn about z, with which the legs cross.
        ('based_on = "hexapod"\n[home]\nquaternion = [0.0, 0.0, 0.0, 1.0]', r"w first, so write \[1.0, 0.0, 0.0, 0.0\]"),
        ('based_on = "hexapod"\n[home]\nquaternion = [0, 0, 0.0348995, 0.9993908]', r"0\.\d+ m: quaternions are w first"),
        ('based_on = "6-3-I"\n[home]\nquaternion = [0.0, 0.0, 0.0, -1.0]', r"write \[-1.0, 0.0, 0.0, 0.0\]"),
        # Other units.
        (
            'based_on = "hexapod"\n[geometry]\nbase_joints = ' + str((1e3 * np.array(BASE)).tolist()),
            "base_joints reach 304.795 m from their middle; the largest mechanisms have 10 m: lengths are in metres, so write",
        ),
        (
            replaced("platform_joints = ", "platform_joints = " + str((1e3 * np.array(PLATFORM)).tolist()) + "#"),
            "platform_joints reach 19",
        ),
        (
            replaced("position = [0.0, 0.0, 0.35]", "position = [0, 0, 350]"),
            "home.position is 350 m from the middle of the base",
        ),
        (replaced("[-0.05, 0.05]", "[-50, 50]"), "it needs 0 < least < greatest length, in metres"),
        ('based_on = "hexapod"\n[limits]\nvelocity = 400.0', "velocity is 400 m/s; no leg has more than 10: give it in m/s"),
        # Home at an end of the stroke.
        (
            'based_on = "hexapod"\n[limits]\nstroke = [0.0, 0.1]',
            "leg 0 is .* mm from an end of its stroke at home, and a run .*: at least 2 mm",
        ),
        ('based_on = "hexapod"\n[limits]\nstroke = [-0.1, 0.001]', "leg 0 is 1 mm from an end of its stroke at home"),
        # Another mass with the old inertia.
        (
            'based_on = "hexapod"\n[plant.platform]\nmass = 60.0',
            r"platform.mass is 60 kg, and platform.inertia is left as hexapod's, for 3 kg: give the inertia in \[plant.plat",
        ),
        ('based_on = "genhexkins"\n[plant.payload]\nmass = 1', "payload.inertia is left as genhexkins's, for 15 kg"),
        # What the drives cannot do.
        (
            'based_on = "hexapod"\n[limits]\nvelocity = 2.0',
            r"leg \d reaches 0\.3\d+ m/s at home with its drive.voltage_limit of 24 V",
        ),
    ],
)
def test_what_is_hardly_meant_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_mechanism(write(tmp_path, text))
    assert str(caught.value).count("\n") == 0 and "mine.toml" in str(caught.value)


@pytest.mark.parametrize(
    "text",
    [
        # A frame {2} that is turned by half a turn, with joints to match.
        f"[geometry]\nbase_joints = {BASE}\nplatform_joints = {[[-x, -y, z] for x, y, z in PLATFORM]}\n"
        "[home]\nposition = [0, 0, 0.35]\nquaternion = [0.0, 0.0, 0.0, 1.0]\n[limits]\nstroke = [-0.05, 0.05]",
        'based_on = "hexapod"\n[home]\nquaternion = [0.9961947, 0.0, 0.0, 0.0871557]',
        'based_on = "hexapod"\n[limits]\nstroke = [-0.01, 0.05]',
        'based_on = "hexapod"\n[plant.payload]\nmass = 5.0',
        'based_on = "hexapod"\n[plant.platform]\nmass = 12.0\ninertia = [[0.12, 0, 0], [0, 0.12, 0], [0, 0, 0.24]]',
        'based_on = "planar-3rpr"\n[home]\nangle = -0.41',
    ],
)
def test_what_is_unusual_and_right_is_taken(tmp_path: Path, text: str) -> None:
    load_in_space(write(tmp_path, text))


def test_entries_may_be_changed_as_it_is_loaded(hexapod: Mechanism) -> None:
    changes = {
        "control.proportional": 30.0,
        "plant.payload.mass": 12.0,
        "geometry.base_joints.0.2": 0.01,
        "joints.base_swing": 0.6,
    }
    changed = load_mechanism("hexapod", changes)
    assert isinstance(changed, Mechanism) and changed.settings["control"]["proportional"] == 30.0
    assert changed.plant["payload.mass"] == 12.0 and changed.base_joints[0, 2] == 0.01 and changed.joints is not None
    # What is not named stays.
    np.testing.assert_array_equal(changed.base_joints[1:], hexapod.base_joints[1:])
    assert set(hexapod.settings["control"].items()) <= {
        *changed.settings["control"].items(),
        *hexapod.settings["control"].items(),
    }
    assert load_mechanism("hexapod").settings == hexapod.settings
    with pytest.raises(UnknownNameError, match=r"hexapod: the mechanism has no entry geometry.base_joints.9.0"):
        load_mechanism("hexapod", {"geometry.base_joints.9.0": 0.0})
    with pytest.raises(InputError, match=r"unknown entry 'contrl'.*control"):
        load_mechanism("hexapod", {"contrl.proportional": 30.0})
