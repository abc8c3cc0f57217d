"""Objects do wherever names do, and what a configuration names is looked for before anything else."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from controller.calibration.file import Calibration, load_calibration
from controller.frames import Frame, Frames
from controller.planning.target import Target, load_target
from hil.rigs.template import TemplateRig
from hil.runs import prepare
from hil.runs.config import SimulationConfig
from hil.runs.names import check_names
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import simulate
from hil.studies.config import EvaluationConfig
from hil.sweep.case import cases_of
from hil.sweep.study import Factor, Study
from plant.encoders import EncoderModel, load_encoder
from plant.errors import InputError, UnknownNameError
from plant.fmu.binding import load_binding
from plant.imu import PRESETS as IMUS
from plant.imu import ImuModel, load_imu
from plant.imu_disturbances import disturbance_of_text
from plant.mechanism import Mechanism, load_in_space, load_mechanism, load_spatial
from plant.pose import rotation_from_vector
from tests.plant.fmu.foreign import BINDING, BINDING_3, TRUTH

PRESETS = ("hexapod", "6-3-I", "6-5", "genhexkins", "planar-3rpr")


def flat(values):
    """The numbers and names in tuples and dictionaries, by their place."""
    if isinstance(values, dict):
        values = values.items()
    elif not isinstance(values, tuple | list):
        return {"": values}
    each = dict(values) if not isinstance(values, tuple | list) else dict(enumerate(values))
    return {f"{name} {place}": value for name, part in each.items() for place, value in flat(part).items() if name != "name"}


def spiral(mechanism):
    times = np.arange(0.0, 1.0, 0.01)
    home = mechanism.home
    positions = home.position + 0.01 * np.column_stack([np.sin(3.0 * times), 1.0 - np.cos(3.0 * times), 0.3 * times])
    rotations = np.array([rotation_from_vector([0.0, 0.05 * t, 0.02 * t]) @ home.rotation for t in times])
    return Target("spiral.v2", times, positions, rotations)


def same_figures(one, other):
    return [one.summary()[group] for group in ("estimation", "tracking")] == [
        other.summary()[group] for group in ("estimation", "tracking")
    ]


@pytest.mark.parametrize("name", PRESETS)
def test_a_mechanism_is_kept_with_all_that_it_has(name):
    given = load_mechanism(name)
    kept = load_mechanism(SimulationConfig(mechanism=given).mechanism)
    assert type(kept) is type(given) and kept.name == given.name and kept.settings == given.settings
    for attribute in ("base_joints", "platform_joints", "base_joint_axes", "home_directions", "up_in_base"):
        if hasattr(given, attribute):
            np.testing.assert_allclose(getattr(kept, attribute), getattr(given, attribute), rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(kept.home.position, given.home.position, rtol=0.0, atol=0.0)
    assert {k: v.tolist() for k, v in kept.plant.items()} == {k: v.tolist() for k, v in given.plant.items()}
    for limit, value in vars(given.limits).items():
        np.testing.assert_array_equal(getattr(kept.limits, limit), value)


def test_a_planar_mechanism_seen_in_space_is_kept():
    given = load_in_space("planar-3rpr")
    kept = load_in_space(SimulationConfig(mechanism=given, target="hold").mechanism)
    np.testing.assert_array_equal(kept.base_joints, given.base_joints)
    np.testing.assert_allclose(kept.joint_rotations, given.joint_rotations, atol=1e-12)


def test_a_mechanism_whose_joints_were_moved_is_refused_as_its_leg_frames_would_be_others(hexapod):
    moved = hexapod.built(1e-3, seed=1)
    with pytest.raises(InputError, match="joints of 'hexapod' were moved after it was made"):
        SimulationConfig(mechanism=moved)


@pytest.mark.parametrize("held", [False, True])
def test_a_target_is_kept_with_its_poses(hexapod, held):
    given = replace(spiral(hexapod), held=held)
    config = SimulationConfig(target=given, duration=0.8)
    kept = load_target(config.target, hexapod, 10.0)
    assert Path(config.target).name == "spiral.csv" and kept.held is held
    np.testing.assert_array_equal(kept.times, given.times)
    np.testing.assert_allclose(kept.positions, given.positions, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(kept.rotations, given.rotations, rtol=0.0, atol=1e-15)


def test_a_calibration_is_kept():
    given = Calibration(tilt=np.array([0.01, -0.02]), about={"who": "ümläut"})
    given.offset[1, 3] = [0.1, 0.2, -0.3]
    kept = load_calibration(SimulationConfig(calibration=given).calibration)
    np.testing.assert_array_equal(kept.tilt, given.tilt)
    np.testing.assert_allclose(kept.offset, given.offset, atol=1e-15)
    assert kept.about == given.about


@pytest.mark.parametrize("name", sorted(IMUS))
def test_an_imu_is_kept_and_a_preset_has_its_name(name):
    preset = load_imu(name)
    assert SimulationConfig(imu=preset).imu == name
    given = replace(preset, name="mine", delay=0.002, gyroscope=replace(preset.gyroscope, noise=1e-4, order=2))
    path = SimulationConfig(imu=given).imu
    assert Path(path).name == "mine.toml"
    kept, expected = asdict(load_imu(path)), asdict(given)
    assert flat(kept) == pytest.approx(flat(expected), rel=1e-14)


@pytest.mark.parametrize(
    "text",
    [
        "imu-offset:0+3,axis=0/0.6/0.8,size_m_per_s2=0.5,at=5,ramp_s=2",
        "imu-scale:6,sensor=gyroscope,axis=all,size_percent=-3",
        "imu-vibration:all,axis=-x,size_g=3,pulse_ms=4,repeat_hz=20,for=7",
        "imu-noise:0,axis=z,size_ut=3",
        "imu-range:2,size_deg_per_s=100",
        "imu-turn:5,axis=y,size_deg=3,sine_hz=0.5",
        "imu-stuck:1,sensor=magnetometer,axis=z,at=0",
        "imu-temperature:4,size_k=10,at=1,for=2",
        "imu-supply:all,size_v=0.1,settle_s=3",
        "imu-clock:2,size_percent=-50",
        "imu-jitter:2,size_ms=0.1",
    ],
)
def test_whatever_happens_to_an_imu_of_its_kind_is_kept(text):
    given = ImuModel("shaken", disturbances=(disturbance_of_text(text),))
    (kept,) = load_imu(SimulationConfig(imu=given).imu).disturbances
    assert flat(asdict(kept)) == pytest.approx(flat(asdict(given.disturbances[0])), rel=1e-14)


def test_an_encoder_is_kept():
    given = EncoderModel("mine", True, 1e-6, 30e-6, 2e-6, 1e-4, 7e-6, 0.01, (0.39, 0.4), 3e-6)
    path = SimulationConfig(lengths=given).lengths
    assert Path(path).name == "mine.toml"
    assert flat(asdict(load_encoder(path))) == pytest.approx(flat(asdict(given)), rel=1e-14)


@pytest.mark.parametrize("text", [BINDING + TRUTH, BINDING_3, '[start]\n"payload.mass" = 12.0\n'])
def test_a_binding_is_kept(tmp_path, text):
    path = tmp_path / "foreign.toml"
    path.write_text(text)
    given = load_binding(path)
    assert not given.problems
    assert load_binding(SimulationConfig(plant="some.fmu", binding=given).binding) == given


def test_a_rig_is_named_by_its_class():
    assert SimulationConfig(rig=TemplateRig).rig == "python:hil.rigs.template:TemplateRig"


def test_a_run_with_objects_is_that_with_their_files_and_recordings_can_name_it(tmp_path, hexapod):
    with_names = simulate(SimulationConfig(target="sines", duration=0.3))
    with_objects = simulate(SimulationConfig(hexapod, "sines", 0.3, imu=load_imu("mpu9150-calibrated")))
    assert same_figures(with_objects, with_names)
    whole = load_target("sines", hexapod, 0.3)
    result = simulate(SimulationConfig(hexapod, whole, 0.3))
    assert result.summary()["tracking"]["position_rms"] == pytest.approx(
        with_names.summary()["tracking"]["position_rms"], rel=0.02
    )
    again = SimulationConfig.from_plain(json.loads(json.dumps(asdict(result.config))))
    assert again == result.config and hash(again) == hash(result.config)


def test_equal_objects_are_one_configuration_and_others_are_another(hexapod):
    one, same = SimulationConfig(load_spatial("hexapod")), SimulationConfig(hexapod)
    heavier = replace(hexapod, plant={**hexapod.plant, "payload.mass": np.array(12.0)})
    assert one == same and one != SimulationConfig(heavier)
    assert EvaluationConfig(mechanism=hexapod).mechanism == one.mechanism


def test_a_sweep_takes_objects_and_hashes_what_is_in_them(tmp_path, hexapod):
    heavier = replace(hexapod, plant={**hexapod.plant, "payload.mass": np.array(12.0)})
    run = SimulationConfig(target=spiral(hexapod), duration=0.2, rate=500.0)
    study = Study((Factor("run.mechanism", (hexapod, heavier)), Factor("run.seed", (1,))), run=run)
    cases = list(cases_of(study))
    assert len({case.key for case in cases}) == 2
    assert [{file.field for file in case.files} for case in cases] == [{"mechanism", "target"}] * 2
    assert [load_spatial(case.local_config().mechanism).plant["payload.mass"] for case in cases] == [10.0, 12.0]
    # Where a file lies does not matter, only what is in it.
    moved = tmp_path / "hexapod.toml"
    moved.write_bytes(Path(study.factors[0].values[0]).read_bytes())
    (elsewhere,) = cases_of(Study((Factor("run.mechanism", (str(moved),)), Factor("run.seed", (1,))), run=run))
    assert elsewhere.key == cases[0].key


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mechanism": 3}, "the mechanism is a int; it must be a name, a path, or one of Mechanism, PlanarMechanism"),
        ({"target": Calibration()}, "the target is a Calibration; it must be a name, a path, or one of Target"),
        ({"calibration": [1]}, "the calibration is a list"),
        ({"imu": EncoderModel("mine")}, "the imu is a EncoderModel; it must be a name, a path, or one of ImuModel"),
        ({"lengths": True}, "the lengths is a bool; it must be a name, a path, or one of EncoderModel"),
        ({"binding": {"step": 1}}, "the binding is a dict; it must be a name, a path, or one of Binding"),
        ({"plant": Calibration()}, "the plant is a Calibration; it must be the path of an FMU"),
        ({"rig": 3}, "the rig is a int"),
        ({"target": Target("one", np.zeros(1), np.zeros((1, 3)), np.eye(3)[None])}, "N at least 2"),
    ],
)
def test_what_is_neither_name_nor_object_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        SimulationConfig(**given)


def test_a_target_in_a_factor_has_no_home_to_count_from(hexapod):
    with pytest.raises(InputError, match="no mechanism from whose home it counts"):
        Factor("run.target", (spiral(hexapod),))


def test_paths_are_names(tmp_path, hexapod):
    config = SimulationConfig(mechanism=tmp_path / "a.toml", plant=tmp_path / "b.fmu", binding=tmp_path / "c.toml")
    assert (config.mechanism, config.plant, config.binding) == tuple(str(tmp_path / n) for n in ("a.toml", "b.fmu", "c.toml"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mechanism": "hexapot"}, "no mechanism 'hexapot'.*did you mean 'hexapod'"),
        ({"imu": "mpu9150-calibratet"}, "no IMU preset .*did you mean 'mpu9150-calibrated'"),
        ({"lengths": "incremntal"}, "no encoder 'incremntal'.*did you mean 'incremental'"),
        ({"target": "sine"}, "no target 'sine'.*did you mean 'sines'"),
        ({"target": "/nowhere/x.csv"}, "no target '/nowhere/x.csv'"),
        ({"plant": "no.fmu"}, "plant = 'no.fmu': there is no such file"),
    ],
)
def test_wrong_names_are_told_before_anything_is_built(monkeypatch, wrong, message):
    def built(*_):
        raise AssertionError("the plant was built first")

    monkeypatch.setattr(prepare, "building_default_fmu", built)
    config = SimulationConfig(**wrong)
    for look in (check_names, lambda c: prepared_loop(c).__enter__()):
        with pytest.raises((UnknownNameError, InputError), match=message):
            look(config)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"fusion": "hole"}, "no fusion 'hole'; there are .*; did you mean 'whole'"),
        ({"rig": "upd"}, "no rig 'upd'; there are .*; did you mean 'udp'"),
        ({"rig": "canopem"}, "did you mean 'canopen'"),
    ],
)
def test_mistyped_names_of_a_configuration_name_the_nearest(wrong, message):
    with pytest.raises(UnknownNameError, match=message):
        SimulationConfig(**wrong)


def test_a_mechanism_made_by_a_program_runs(hexapod):
    made = Mechanism.from_legs(
        hexapod.base_joints,
        hexapod.platform_joints,
        home=hexapod.home,
        limits={"stroke": [-0.05, 0.05]},
        plant=hexapod.plant,
        name="made here / by hand",
    )
    config = SimulationConfig(made, spiral(made), 0.3, imu="ideal")
    assert Path(config.mechanism).name == "_by_hand.toml"
    assert simulate(config).summary()["tracking"]["position_rms"] < 1e-3


def nod(t):
    """A bow about y, and a rise, from rest."""
    s = 10.0 * t**3 - 15.0 * t**4 + 6.0 * t**5 if t < 1.0 else 1.0
    return [0.0, 0.0, 0.01 * s, 0.0, 0.05 * s, 0.0]


def test_a_function_of_time_is_a_target():
    config = SimulationConfig(target=nod, duration=1.0, imu="ideal", rate=250.0)
    assert Path(config.target).name == "nod.csv"
    result = simulate(config)
    expected = np.array([nod(max(0.0, t)) for t in result.times])
    home = result.mechanism.home
    np.testing.assert_allclose(result.target_positions - home.position, expected[:, :3], rtol=0.0, atol=1e-6)
    assert result.summary()["target"]["position_rms"] < 2e-4
    end = rotation_from_vector(expected[-1, 3:]) @ home.rotation
    np.testing.assert_allclose(result.target_rotations[-1], end, rtol=0.0, atol=1e-6)


def test_a_function_of_time_is_slowed_down_as_a_file_is():
    fast, slow = (
        SimulationConfig(target=nod, duration=duration, time_scale=scale) for duration, scale in ((1.0, 1.0), (2.0, 2.0))
    )
    assert fast.target == slow.target


def test_a_function_of_time_has_the_poses_of_the_tool_with_frames():
    frames = Frames({"cell": Frame("base", np.array([0.02, 0.0, 0.3]))}, work="cell")
    config = SimulationConfig(target=lambda t: [-0.02, 0.0, 0.065, 0.0, 0.0, 0.0], frames=frames, duration=0.1)
    target = load_target(config.target, load_in_space("hexapod"), 0.1, config.active_frames)
    np.testing.assert_allclose(target.positions, np.tile([0.0, 0.0, 0.365], (len(target.times), 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("function", "said"),
    [
        (lambda t: [0.0] * 5, r"<lambda>\(0\) must have shape \(6,\), got \(5,\)"),
        (lambda t: [0.0] * 5 + [np.nan if t > 0.5 else 0.0], r"<lambda>\(0.51\)\[5\] is nan"),
        (lambda t: None, "array of numbers"),
    ],
)
def test_a_function_that_gives_no_pose_is_refused(function, said):
    with pytest.raises(InputError, match=said):
        SimulationConfig(target=function)
    with pytest.raises(InputError, match="duration"):
        SimulationConfig(target=nod, duration=np.inf)
