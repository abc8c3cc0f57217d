"""Configurations of runs: what is given, checked and restored."""

from dataclasses import asdict

import pytest

from hil.rigs.udp.emulator import WATCHDOG_S
from hil.runs.config import EmulatorConfig, SimulationConfig, imus_from_text
from hil.runs.prepare import simulated_plant
from plant.errors import InputError, UnknownNameError
from plant.fmu.settings import Setting
from plant.imu_wiring import Wiring
from plant.mechanism import load_in_space


def test_a_configuration_comes_back_from_its_plain_values():
    config = SimulationConfig(
        settings=(Setting("payload.mass", (12.0,), 3.5),), wiring=Wiring(places=(1, 0, 2, 3, 4, 5, 6)), imus=(0, 2, 6)
    )
    plain = asdict(config)
    assert SimulationConfig.from_plain(plain) == config
    assert SimulationConfig.from_plain(plain | {"imus": [0, 2, 6]}) == config
    with pytest.raises(InputError, match="these values are no configuration of a simulation"):
        SimulationConfig.from_plain(plain | {"colour": "red"})


@pytest.mark.parametrize(("text", "imus"), [("all", (0, 1, 2, 3, 4, 5, 6)), ("legs", (0, 1, 2, 3, 4, 5)), ("6,0", (0, 6))])
def test_imus_have_names_and_numbers(text, imus):
    assert imus_from_text(text) == imus


def test_an_imu_that_is_named_twice_is_refused():
    with pytest.raises(InputError, match="'0,3,0,1' names IMU 0 twice: name each IMU once"):
        imus_from_text("0,3,0,1")


def test_an_address_without_a_rig_is_refused():
    with pytest.raises(InputError, match=r"--rig-at 127\.0\.0\.1:1 says where a rig is, but not which: name it with --rig"):
        SimulationConfig(rig_at="127.0.0.1:1")
    assert SimulationConfig(rig="udp", rig_at="127.0.0.1:1").rig_at == "127.0.0.1:1"


def test_faults_of_imus_are_checked_and_are_for_simulated_ones():
    texts = ("imu-offset:all,axis=y,size_m_per_s2=0.5,at=5,ramp_s=10", "imu-turn:6,axis=z,size_deg=3")
    config = SimulationConfig(faults=texts)
    assert SimulationConfig.from_plain(asdict(config) | {"faults": list(texts)}) == config
    with pytest.raises(UnknownNameError, match="there is no disturbance 'drive-stuck' of an IMU"):
        SimulationConfig(faults=("drive-stuck:1",))
    with pytest.raises(InputError, match="needs one of size_deg"):
        SimulationConfig(faults=("imu-turn:6,axis=z",))
    moved = SimulationConfig(faults=(texts[0], "base-tilt,axis=x,size_deg=2,at=3,ramp_s=4"))
    assert [len(moved.disturbances), len(moved.base_motions)] == [1, 1]
    with pytest.raises(InputError, match="the base's tilt needs one of size_deg"):
        SimulationConfig(faults=("base-tilt,axis=z",))
    of_the_base = ("imu-offset:7,axis=y,size_m_per_s2=0.5",)
    with pytest.raises(InputError, match="--fault imu-offset is for IMU 7, on the base, and there is none"):
        SimulationConfig(faults=of_the_base)
    assert SimulationConfig(faults=of_the_base, base_imu=True).disturbances[0].imus == (7,)
    with pytest.raises(InputError, match="--fault is for a simulated plant, not for the rig udp: tell it to 'gough emulate'"):
        SimulationConfig(rig="udp", faults=texts)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("need_platform_imu=0", 'in the table [safety] .* lines based_on = "hexapod", [safety] and need_platform_imu = 0, and'),
        ("safety.disagreement=0.1@3", "safety.disagreement is no variable .* [safety] and disagreement = 0.1, and"),
        ("disagreement=0.1", "in the table [fusion] or [safety] of the mechanism's file"),
        ("hold=0.5", "in the table [control]"),
    ],
)
def test_a_setting_of_the_controller_is_told_from_one_of_the_plant(text, message):
    config = SimulationConfig(settings=(Setting.parse("payload.mass=12"), Setting.parse(text)))
    mechanism = load_in_space(config.mechanism)
    with pytest.raises(InputError, match=message.replace("[", r"\[").replace("]", r"\]")):
        simulated_plant(config, mechanism, mechanism.home)


def test_a_setting_of_the_controller_belongs_into_a_mechanism_s_own_file(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text('based_on = "hexapod"')
    mechanism = load_in_space(str(path))
    config = SimulationConfig(mechanism=str(path), settings=(Setting.parse("leg_sigma=1e-3"),))
    with pytest.raises(InputError, match=r"Write leg_sigma = 0\.001 into that table of .*own\.toml"):
        simulated_plant(config, mechanism, mechanism.home)


def test_what_is_no_setting_of_anything_keeps_its_message():
    mechanism = load_in_space("hexapod")
    for text in ("payload.hold=1", "colour=1"):
        with pytest.raises(UnknownNameError, match="has no variable"):
            simulated_plant(SimulationConfig(settings=(Setting.parse(text),)), mechanism, mechanism.home)


def test_the_emulated_drives_have_one_watchdog():
    assert EmulatorConfig().watchdog == WATCHDOG_S
    with pytest.raises(InputError, match="the watchdog is 0 ms"):
        EmulatorConfig(watchdog=0.0)


def test_a_fault_of_an_encoder_that_an_emulated_rig_lacks_is_refused():
    with pytest.raises(InputError, match="--fault breaks an encoder, and there is none: add --lengths"):
        EmulatorConfig(faults=("encoder-dead:2",))
    assert EmulatorConfig(SimulationConfig(lengths="incremental"), faults=("encoder-dead:2",)).faults == ("encoder-dead:2",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"faults": ("encoder-dead:2",)}, "--fault breaks an encoder, and there is none: add --lengths"),
        ({"faults": ("imu-stuck:2,sensor=gyroscope,axis=x,at=10",)}, "at=10 begins at 10 s, when the motion of 10 s is over"),
        ({"faults": ("base-tilt,axis=x,size_deg=1,at=3",), "duration": 2.0}, "begins at 3 s, when the motion of 2 s is over"),
        ({"lengths": "incremental", "fusion": "section-5", "magnetometer": True}, "section 5 takes no lengths"),
    ],
)
def test_what_would_do_nothing_is_refused(changes, message):
    with pytest.raises(InputError, match=message):
        SimulationConfig(**changes)
