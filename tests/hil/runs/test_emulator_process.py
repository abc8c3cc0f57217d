"""The control channel of an emulated rig: what it answers, and when a fault that is injected begins and ends."""

import json
import os
import socket

import numpy as np
import pytest

from hil.rigs.emulation import new_emulated
from hil.runs.config import EmulatorConfig
from hil.runs.emulator_process import BusyError, _Control, _findable, _hello, _padded, _UdpSessions, own_control
from plant.errors import GoughError, InputError


@pytest.fixture
def control():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as opened:
        yield _Control(opened, "of mine", base_imu=False)


@pytest.fixture
def rig(hexapod):
    rig = new_emulated(hexapod, 1_000_000, 0)
    rig["time_ns"] = 7_500_000_000
    return rig


def injected(control, rig, text):
    assert control._do("fault", text, rig, {}) == {"fault": text}
    made = rig["fault"][int(rig["faults"]) - 1]
    return int(made["begin_ns"]), int(made["end_ns"])


def test_a_fault_begins_now_and_ends_after_its_time(control, rig):
    rig["enabled_ns"] = 5_000_000_000
    begin, end = injected(control, rig, "imu-dead:3,for=2")
    # 2.5 s after the drives were first enabled, to the nanosecond before which it counts as from the start.
    assert begin == 2_500_000_000 and abs(end - 4_500_000_000) <= 1
    begin, end = injected(control, rig, "drive-faults:1")
    assert begin == 2_500_000_000 and end > 2**61
    assert injected(control, rig, "imu-dead:2,at=4,for=1") == (4_000_000_000, 5_000_000_000)
    assert int(rig["faults"]) == 3
    assert control._do("clear", "", rig, {}) == {"faults": 0} and rig["faults"] == 0


def test_a_fault_before_the_drives_are_enabled_is_there_from_the_start(control, rig):
    assert injected(control, rig, "imu-dead:3")[0] == -1
    rig["enabled_ns"] = 7_500_000_000
    assert injected(control, rig, "imu-dead:4")[0] == 0


@pytest.mark.parametrize("text", ["imu-dead:7", "imu-offset:2+7,axis=y,size_m_per_s2=0.5"])
def test_a_fault_of_the_bases_imu_is_refused_where_there_is_none(control, rig, text):
    with pytest.raises(InputError, match="on the base, and there is none: name one of 0 to 6, or add --base-imu"):
        control._do("fault", text, rig, {})
    assert rig["faults"] == 0
    control._base_imu = True
    assert control._do("fault", text, rig, {}) == {"fault": text}


def test_the_course_of_a_disturbance_begins_when_it_is_injected(control, rig):
    injected(control, rig, "imu-offset:all,axis=y,size_m_per_s2=0.5,ramp_s=10")
    assert float(rig["fault"][0]["disturbance"]["begin"]) == pytest.approx(7.5)
    assert (int(rig["fault"][0]["begin_ns"]), int(rig["fault"][0]["kind"])) == (-1, 0)
    with pytest.raises(InputError, match="'offset' needs one of size_deg_per_s"):
        control._do("fault", "imu-offset:all,axis=y", rig, {})


def test_the_state_is_that_of_the_rig_and_its_bus(control, rig):
    rig["drive"], rig["code"], rig["velocity"] = np.arange(6) % 5, 10 * np.arange(6), 0.1 * np.arange(6)
    rig["truth"] = np.arange(19.0)
    assert control._do("state", "", rig, {"lost": 4}) == {
        "time_s": pytest.approx(7.5),
        "drive": [0, 1, 2, 3, 4, 0],
        "code": [0, 10, 20, 30, 40, 50],
        "velocity": pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5]),
        "lengths": [7.0, 8.0, 9.0, 10.0, 11.0, 12.0],
        "lost": 4,
    }


def test_without_a_session_it_can_only_stop(control, rig):
    for command in ("state", "fault", "clear"):
        with pytest.raises(InputError, match="no controller has begun a session"):
            control._do(command, "imu-dead:3", None, {})
    with pytest.raises(InputError, match="the control channel has the commands fault, clear, state and stop, not 'dance'"):
        control._do("dance", "", rig, {})
    with pytest.raises(GoughError, match="there is no fault"):
        control._do("fault", "imu-happy:3", rig, {})
    assert not control.stopped and control._do("stop", "", None, {}) == {"stopping": True} and control.stopped


@pytest.mark.parametrize(("watchdog", "period_us", "seconds"), [(0.03, 1000, 0.03), (0.03, 20_000, 0.06), (0.03, 10_000, 0.03)])
def test_the_watchdog_waits_for_three_periods_at_least(watchdog, period_us, seconds):
    assert EmulatorConfig(watchdog=watchdog).watchdog_for(period_us) == pytest.approx(seconds)


def test_what_is_no_greeting_begins_no_session():
    assert _hello(b"") is None and _hello(bytes(64)) is None


def test_each_answer_says_whose_it_is_and_a_flood_is_answered_in_parts(control, rig):
    control.socket.bind(("127.0.0.1", 0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        asker.settimeout(2.0)
        for _ in range(20):
            asker.sendto(b"state", control.socket.getsockname())
        control.answer(rig)
        answers = [json.loads(asker.recv(65536)) for _ in range(16)]
        assert all(answer["emulator"] == "of mine" for answer in answers)
        asker.settimeout(0.05)
        with pytest.raises(TimeoutError):
            asker.recv(65536)
        control.answer(rig)
        assert json.loads(asker.recv(65536))["emulator"] == "of mine"


def test_the_one_emulator_of_this_user_is_found_and_of_several_one_must_be_named(monkeypatch):
    # A user of the tests' own, whom no other emulator on this machine has.
    monkeypatch.setattr(os, "getuid", lambda: 3_000_000_000 + os.getpid())
    with pytest.raises(BusyError, match="no emulator of this user runs on this machine: start one with 'gough emulate'"):
        own_control()
    with _findable("127.0.0.1:5001"):
        assert own_control() == "127.0.0.1:5001"
        with (
            _findable("127.0.0.1:5002"),
            pytest.raises(InputError, match=r"at 127\.0\.0\.1:5001 and 127\.0\.0\.1:5002: name one"),
        ):
            own_control()
    with pytest.raises(BusyError):
        own_control()


def test_a_rig_is_named_after_its_mechanism():
    assert bytes(_padded("gough emulated 6-3-II", 32)) == b"gough emulated 6-3-II" + 11 * b"\0"
    assert bytes(_padded("\u00e9" + 40 * "x", 32)) == b"?" + 31 * b"x"


def test_who_else_sends_datagrams_to_a_rig_is_said_once_of_each_and_of_ten_at_most(control):
    said, told = [], set()
    sessions = _UdpSessions(control.socket, EmulatorConfig(), [], control, said.append)
    # Without a port, nobody has sent any yet.
    for stranger in [("0.0.0.0", 0), *(("10.0.0.7", 4000 + port) for port in (1, 1, *range(1, 31)))]:
        sessions._tell_stranger(stranger, told)
    assert said == [f"refused: 10.0.0.7:{4000 + k} sends datagrams that are none of this session's" for k in range(1, 11)]
