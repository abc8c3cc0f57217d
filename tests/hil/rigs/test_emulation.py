"""The emulated rig without a bus: its faults' texts, times and effects, and its drives, by hand-computed numbers."""

from math import pi, radians
from types import SimpleNamespace

import numpy as np
import pytest

from hil.rigs import BRAKED, ENABLED, FAULTY, FOLLOWING, OFF, QUICK_STOP, QUICK_STOPPING, READY
from hil.rigs.emulation import (
    MOST_FAULTS,
    POWER_LOST,
    FaultKind,
    add_fault,
    disturb,
    draw,
    fault,
    is_active,
    move,
    new_emulated,
    sample,
)
from hil.runs.config import EmulatorConfig, SimulationConfig
from hil.runs.emulator_process import _rig_of
from plant.encoder_readings import encoder_state
from plant.encoders import load_encoder
from plant.errors import InputError, UnknownNameError
from plant.imu import imu_state, load_imu
from plant.mechanism import load_spatial
from plant.pose import rotation_from_quaternion
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS

MS = 1_000_000
FOREVER = 2**63 - 1
LIMIT, SLOWER = 1.5 * 0.25, 3.0 * 1e-3
"""Largest velocity of a drive of the hexapod [m/s]; what a quick stop takes off in a millisecond [m/s]."""

SPEEDS = np.array([0.01, -0.02, 0.03, -0.04, 0.05, -0.06])


@pytest.fixture(scope="module")
def made():
    """A plant with ideal IMUs and encoders, and their imperfections."""
    plant, imu, encoders, _ = _rig_of(EmulatorConfig(SimulationConfig(imu="ideal", lengths="ideal")), 1e-3, [])
    with plant:
        yield plant, imu, encoders


class Emulated:
    """An emulated rig that a test drives by the millisecond."""

    def __init__(self, made, *texts, step_ns=MS, seed=0):
        self.plant, self.imu, self.encoders = made
        self.rig = new_emulated(load_spatial("hexapod"), step_ns, seed, [fault(text) for text in texts])

    def __getitem__(self, name):
        return self.rig[name].copy()

    def step(self, request=None, target=None, count=1, leg=slice(None)):
        """So many milliseconds, with a new request and target for all legs or one."""
        if request is not None:
            self.rig["request"][leg] = request
        if target is not None:
            self.rig["target"][leg] = target
        assert move(self.plant.handle, self.rig, int(self.rig["time_ns"]) + count * MS) == 0
        return self

    def read(self):
        """The present readings, of a plant that stands still meanwhile."""
        assert sample(self.plant.handle, self.imu, self.encoders, self.rig, int(self.rig["time_ns"])) == 0
        return self["measurement"]


# ---------------------------------------------------------------------------------------------------------------- texts


@pytest.mark.parametrize(
    "text, kind, index, begin, end, size",
    [
        ("imu-turn:0,axis=z,size_deg=2,at=0.5,for=1", 0, 0, 500_000_000, 1_500_000_000, 0.0),
        ("imu-supply:all,size_v=2", 0, 0, -1, FOREVER, 0.0),
        ("imu-frozen:0", FaultKind.IMU_FROZEN, 0, -1, FOREVER, 0.0),
        ("imu-dead:6,at=2", FaultKind.IMU_DEAD, 6, 2_000_000_000, FOREVER, 0.0),
        ("imu-noisy:2,at=0.25,for=0.5", FaultKind.IMU_NOISY, 2, 250_000_000, 750_000_000, 20.0),
        ("imu-biased:6,size=-3,for=2.25,at=1.5", FaultKind.IMU_BIASED, 6, 1_500_000_000, 3_750_000_000, -3.0 * pi / 180.0),
        ("imu-biased:1", FaultKind.IMU_BIASED, 1, -1, FOREVER, 2.0 * pi / 180.0),
        ("imu-swapped:1,size=4", FaultKind.IMU_SWAPPED, 1, -1, FOREVER, 4.0),
        ("drive-faults:5", FaultKind.DRIVE_FAULTS, 5, -1, FOREVER, 0x7500),
        ("drive-faults:1,size=8976", FaultKind.DRIVE_FAULTS, 1, -1, FOREVER, 0x2310),
        ("drive-unpowered:3,at=0", FaultKind.DRIVE_UNPOWERED, 3, 0, FOREVER, 0.0),
        ("drive-ignores:3", FaultKind.DRIVE_IGNORES, 3, -1, FOREVER, 0.0),
        ("drive-stuck:4", FaultKind.DRIVE_STUCK, 4, -1, FOREVER, 0.0),
        ("drive-runs-away:0", FaultKind.DRIVE_RUNS_AWAY, 0, -1, FOREVER, 0.2),
        ("drive-runs-away:2,size=-0.05", FaultKind.DRIVE_RUNS_AWAY, 2, -1, FOREVER, -0.05),
        ("bus-drops", FaultKind.BUS_DROPS, 0, -1, FOREVER, 0.01),
        ("bus-delays", FaultKind.BUS_DELAYS, 0, -1, FOREVER, 5e6),
        ("bus-delays,at=0,size=0.25", FaultKind.BUS_DELAYS, 0, 0, FOREVER, 250_000.0),
        ("bus-reorders", FaultKind.BUS_REORDERS, 0, -1, FOREVER, 0.1),
        ("bus-repeats", FaultKind.BUS_REPEATS, 0, -1, FOREVER, 0.1),
        ("bus-corrupts", FaultKind.BUS_CORRUPTS, 0, -1, FOREVER, 0.1),
        ("bus-down,at=3,for=1", FaultKind.BUS_DOWN, 0, 3_000_000_000, 4_000_000_000, 0.0),
        ("payload-jumps", FaultKind.PAYLOAD_JUMPS, 0, -1, FOREVER, 5.0),
        ("payload-jumps,size=-8", FaultKind.PAYLOAD_JUMPS, 0, -1, FOREVER, -8.0),
    ],
)
def test_a_fault_is_made_of_its_text(text, kind, index, begin, end, size):
    made = fault(text)
    assert (int(made["kind"]), int(made["index"])) == (kind, index)
    assert (int(made["begin_ns"]), int(made["end_ns"])) == (begin, end)
    assert float(made["size"]) == pytest.approx(size, rel=1e-15)


def test_the_kinds_of_faults_keep_their_names_and_take_the_numbers_of_what_they_concern():
    for kind in FaultKind:
        most = 7 if kind == FaultKind.IMU_SWAPPED else {"IMU": 8, "DRI": 6}.get(kind.name[:3], 0)
        assert kind.count == most, kind
        assert kind.label == kind.name.lower().replace("_", "-")
        if most:
            assert int(fault(f"{kind.label}:{most - 1}")["index"]) == most - 1
            for wrong in (f":{most}", ":-1", ":x", ""):
                with pytest.raises(InputError, match=f"0 to {most - 1}"):
                    fault(kind.label + wrong)
        else:
            with pytest.raises(InputError, match="takes none"):
                fault(f"{kind.label}:0")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bus-down,for=0", "the fault 'bus-down' has for_s = 0; it must be positive"),
        ("bus-down,for=-1", "has for_s = -1; it must be positive"),
        ("bus-down,for=nan", "has for_s = 'nan'; it must be a finite number"),
        ("bus-down,at=inf", "has at_s = 'inf'; it must be a finite number"),
        ("bus-down,at=x", "has at_s = 'x'; it must be a finite number"),
        ("imu-dead:3,at=-1", "has at_s = -1; it must not be negative: leave it out for one from the start"),
        ("bus-drops,size=inf", "has size = 'inf'; it must be a finite number"),
        ("bus-drops,size=nan", "has size = 'nan'; it must be a finite number"),
        ("bus-drops,size=5", "the fault 'bus-drops' has size = 5; it is a probability: give 0 to 1"),
        ("bus-repeats,size=-0.1", "has size = -0.1; it is a probability: give 0 to 1"),
        ("bus-reorders,size=1.1", "it is a probability"),
        ("bus-corrupts,size=1.1", "it is a probability"),
    ],
)
def test_a_fault_with_a_number_out_of_range_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        fault(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bus-down,at", "'at' in 'bus-down,at' is no word with a value"),
        ("bus-down,", "'' in 'bus-down,' is no word with a value"),
        ("bus-down,until=3", "has no entry 'until'; it has at_s, for_s, size"),
    ],
)
def test_an_option_that_is_none_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        fault(text)


@pytest.mark.parametrize(("text", "meant"), [("imu-dad:3", "imu-dead"), ("imu-ofset:all", "imu-offset")])
def test_a_mistyped_fault_is_told_with_the_one_that_may_be_meant(text, meant):
    with pytest.raises(UnknownNameError, match=f"did you mean '{meant}'"):
        fault(text)


def test_an_unknown_fault_is_told_with_those_that_there_are():
    with pytest.raises(
        UnknownNameError,
        match=r"there is no fault 'imu'; there are imu-frozen, .*, payload-jumps, imu-offset, .*, imu-jitter, base-tilt",
    ):
        fault("imu:3")


@pytest.mark.parametrize(
    "text, enabled, now, there",
    [
        # Without `at` from the start, before the drives are enabled, too; `for` counts from when they are.
        ("bus-down", -1, 0, True),
        ("bus-down,for=2", -1, 10**12, True),
        ("bus-down,for=2", 10**9, 2_999_999_999, True),
        ("bus-down,for=2", 10**9, 3_000_000_000, False),
        # With `at` from then on after the drives were enabled; the first instant counts, the last does not.
        ("bus-down,at=2,for=1", -1, 2_500_000_000, False),
        ("bus-down,at=2,for=1", 10**9, 2_999_999_999, False),
        ("bus-down,at=2,for=1", 10**9, 3_000_000_000, True),
        ("bus-down,at=2,for=1", 10**9, 3_999_999_999, True),
        ("bus-down,at=2,for=1", 10**9, 4_000_000_000, False),
        ("bus-down,at=0", 0, 0, True),
        ("bus-down,at=0", -1, 0, False),
    ],
)
def test_a_fault_is_there_from_its_beginning_to_its_end(text, enabled, now, there):
    made = SimpleNamespace(**{name: int(fault(text)[name]) for name in ("begin_ns", "end_ns")})
    assert is_active.py_func(made, enabled, now) is there


def test_a_new_rig_has_the_mechanisms_limits_and_ready_drives():
    rig = new_emulated(load_spatial("hexapod"), 250_000, 41, [fault("imu-dead:3"), fault("bus-down")])
    expected = {"step_ns": 250_000, "deceleration": 3.0, "speed_limit": 0.375, "payload": 10.0, "added": 0.0, "enabled_ns": -1}
    assert {name: float(rig[name]) for name in expected} == expected
    assert (rig["drive"] == READY).all() and (rig["request"] == BRAKED).all() and rig["random"].tolist() == [42]
    assert rig["faults"] == 2 and rig["fault"]["kind"][:3].tolist() == [FaultKind.IMU_DEAD, FaultKind.BUS_DOWN, 0]
    for _ in range(MOST_FAULTS - 2):
        add_fault(rig, fault("imu-noisy:6"))
    assert rig["faults"] == 32 and rig["fault"]["index"][31] == 6
    with pytest.raises(InputError, match="already 32 faults"):
        add_fault(rig, fault("bus-down"))
    assert rig["faults"] == 32


# --------------------------------------------------------------------------------------------------------------- drives


def test_drives_follow_their_targets_within_the_limit_and_the_legs_with_them(made):
    rig = Emulated(made).step(BRAKED, SPEEDS)
    assert (rig["drive"] == READY).all() and (rig["velocity"] == 0.0).all()
    # The legs sag a little when their brakes open.
    rig.step(ENABLED, SPEEDS, count=100).read()
    before = rig["truth"][TRUTH_LENGTHS]
    rig.step(count=50).read()
    np.testing.assert_array_equal(rig["drive"], FOLLOWING)
    np.testing.assert_array_equal(rig["velocity"], SPEEDS)
    np.testing.assert_allclose(rig["truth"][TRUTH_LENGTHS] - before, 0.05 * SPEEDS, atol=2e-4)
    rig.step(target=[10.0, -10.0, LIMIT, -LIMIT, 0.374, -0.374])
    np.testing.assert_allclose(rig["velocity"], [LIMIT, -LIMIT, LIMIT, -LIMIT, 0.374, -0.374], rtol=1e-15)
    rig.step(target=-SPEEDS).step(BRAKED)
    assert (rig["drive"] == READY).all() and (rig["velocity"] == 0.0).all()
    rig.step(count=100).read()
    held = rig["truth"][TRUTH_LENGTHS]
    rig.step(count=50).read()
    np.testing.assert_allclose(rig["truth"][TRUTH_LENGTHS], held, atol=1e-6)


def test_a_leg_obeys_its_own_request_alone(made):
    rig = Emulated(made).step(ENABLED, 0.05, leg=2).step(QUICK_STOP, 0.05, leg=4)
    assert rig["drive"].tolist() == [READY, READY, FOLLOWING, READY, READY, READY]
    assert rig["velocity"].tolist() == [0.0, 0.0, 0.05, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_quick_stop_slows_down_by_the_deceleration_and_then_holds(made, sign):
    speed = sign * 3.5 * SLOWER
    rig = Emulated(made).step(ENABLED, speed)
    found = [(int(rig["drive"][3]), float(rig["velocity"][3])) for _ in range(6) if rig.step(QUICK_STOP)]
    expected = [(QUICK_STOPPING, sign * left * SLOWER) for left in (2.5, 1.5, 0.5)] + 3 * [(READY, 0.0)]
    assert [drive for drive, _ in found] == [drive for drive, _ in expected]
    np.testing.assert_allclose([velocity for _, velocity in found], [velocity for _, velocity in expected], atol=1e-15)
    # Enabled again it follows at once.
    rig.step(ENABLED)
    assert (rig["drive"] == FOLLOWING).all() and (rig["velocity"] == speed).all()


def test_a_quick_stop_takes_as_long_in_other_steps(made):
    rig = Emulated(made, step_ns=200_000).step(ENABLED, 0.03).step(QUICK_STOP, count=5)
    np.testing.assert_allclose(rig["velocity"], 0.03 - 5.0 * SLOWER, rtol=1e-12)


def test_a_drive_in_a_quick_stop_is_not_enabled_but_may_be_braked(made):
    rig = Emulated(made).step(ENABLED, 0.3).step(QUICK_STOP).step(ENABLED)
    assert (rig["drive"] == QUICK_STOPPING).all()
    np.testing.assert_allclose(rig["velocity"], 0.3 - 2.0 * SLOWER)
    rig.step(BRAKED)
    assert (rig["drive"] == READY).all() and (rig["velocity"] == 0.0).all()


def test_the_time_since_drives_were_enabled_begins_with_the_first_one(made):
    rig = Emulated(made).step(QUICK_STOP, count=3)
    assert rig["enabled_ns"] == -1
    rig.step(ENABLED, 0.0, leg=5)
    assert rig["enabled_ns"] == 3 * MS
    rig.step(ENABLED, 0.0).step(BRAKED).step(ENABLED)
    assert rig["enabled_ns"] == 3 * MS and rig["time_ns"] == 7 * MS


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_faulty_drive_slows_down_and_needs_a_reset_at_rest_without_its_cause(made, sign):
    rig = Emulated(made, "drive-faults:2,at=0.002,for=0.01,size=8976").step(ENABLED, sign * 2.5 * SLOWER, count=2)
    assert (rig["drive"] == FOLLOWING).all()
    rig.rig["reset"] = 1
    rig.step()
    assert rig["drive"].tolist() == [FOLLOWING, FOLLOWING, FAULTY, FOLLOWING, FOLLOWING, FOLLOWING]
    assert rig["code"].tolist() == [0, 0, 0x2310, 0, 0, 0]
    np.testing.assert_allclose(rig["velocity"] / SLOWER, sign * np.array([2.5, 2.5, 1.5, 2.5, 2.5, 2.5]))
    rig.rig["reset"] = 1
    rig.step(BRAKED)
    np.testing.assert_allclose(rig["velocity"] / SLOWER, sign * np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0]))
    rig.step(count=4)
    # At rest, but the cause is still there.
    rig.rig["reset"] = 1
    rig.step()
    assert rig["drive"][2] == FAULTY and rig["velocity"][2] == 0.0 and (rig["reset"] == 0).all()
    # The cause is gone, and no reset is remembered.
    rig.step(count=10)
    assert rig["drive"][2] == FAULTY and rig["code"][2] == 0x2310
    rig.rig["reset"][2] = 1
    rig.step()
    assert (rig["drive"] == READY).all() and (rig["code"] == 0).all()


def test_a_moving_drive_is_not_reset(made):
    rig = Emulated(made, "drive-faults:2,at=0.001,for=0.001").step(ENABLED, 2.5 * SLOWER, count=2)
    rig.rig["reset"] = 1
    rig.step()
    assert rig["drive"][2] == FAULTY
    np.testing.assert_allclose(rig["velocity"][2], 0.5 * SLOWER)


def test_a_drive_without_power_stands_and_comes_back_with_a_fault(made):
    rig = Emulated(made, "drive-unpowered:5,at=0.002,for=0.003").step(ENABLED, SPEEDS, count=2).step()
    assert rig["drive"].tolist() == 5 * [FOLLOWING] + [OFF]
    np.testing.assert_array_equal(rig["velocity"], np.append(SPEEDS[:5], 0.0))
    rig.step(count=2)
    assert rig["drive"][5] == OFF and rig["code"][5] == 0
    rig.step()
    assert rig["drive"][5] == FAULTY and rig["code"].tolist() == [0, 0, 0, 0, 0, POWER_LOST] and rig["velocity"][5] == 0.0
    rig.rig["reset"][5] = 1
    rig.step()
    assert rig["drive"][5] == READY and rig["code"][5] == 0
    rig.step()
    assert rig["drive"][5] == FOLLOWING and rig["velocity"][5] == SPEEDS[5]


def test_a_drive_that_ignores_its_commands_keeps_its_velocity_until_it_is_braked(made):
    rig = Emulated(made, "drive-ignores:1,at=0.001").step(ENABLED, SPEEDS).step(target=-SPEEDS)
    expected = -SPEEDS
    expected[1] = SPEEDS[1]
    np.testing.assert_array_equal(rig["velocity"], expected)
    rig.step(QUICK_STOP, count=50)
    np.testing.assert_array_equal(rig["velocity"], np.where(np.arange(6) == 1, SPEEDS[1], 0.0))
    rig.step(BRAKED)
    np.testing.assert_array_equal(rig["velocity"], 0.0)


def test_a_drive_that_is_stuck_says_that_it_follows(made):
    rig = Emulated(made, "drive-stuck:0").step(ENABLED, SPEEDS)
    assert (rig["drive"] == FOLLOWING).all()
    np.testing.assert_array_equal(rig["velocity"], np.append(0.0, SPEEDS[1:]))


@pytest.mark.parametrize("speed", [0.2, -0.03])
def test_a_drive_that_runs_away_does_so_unless_it_is_braked(made, speed):
    rig = Emulated(made, f"drive-runs-away:3,size={speed}").step(BRAKED)
    np.testing.assert_array_equal(rig["velocity"], 0.0)
    for request in (QUICK_STOP, ENABLED, QUICK_STOP):
        rig.step(request, 0.0)
        np.testing.assert_array_equal(rig["velocity"], np.where(np.arange(6) == 3, speed, 0.0))
    rig.step(BRAKED)
    np.testing.assert_array_equal(rig["velocity"], 0.0)


def test_the_latest_of_two_faults_of_a_drive_counts(made):
    rig = Emulated(made, "drive-runs-away:3,size=0.1,at=0", "drive-runs-away:3,size=-0.07,at=0.001,for=0.001")
    found = [float(rig["velocity"][3]) for _ in range(4) if rig.step(ENABLED, 0.0)]
    assert found == [0.1, -0.07, 0.1, 0.1]


def test_payloads_that_jump_add_up_while_they_are_there_and_load_the_legs(made):
    rig = Emulated(made, "payload-jumps,at=0.001,for=0.2,size=5", "payload-jumps,at=0.101,for=0.1,size=-8").step(ENABLED, 0.0)
    plant = rig.plant.handle
    masses, currents = [], []
    for count in (100, 100, 100):
        rig.step(count=count)
        masses.append((float(rig["added"]), float(plant["payload"][0])))
        rig.read()
        currents.append(abs(rig["truth"][TRUTH_CURRENTS]).sum())
    assert masses == [(5.0, 15.0), (-3.0, 7.0), (0.0, 10.0)]
    assert currents[1] < currents[2] < currents[0]


# ----------------------------------------------------------------------------------------------------------------- IMUs


def about_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


@pytest.mark.parametrize("degrees", [10.0, -25.0])
def test_an_imu_that_is_turned_reads_the_vectors_in_its_turned_axes(made, degrees):
    right = Emulated(made).read()
    found = Emulated(made, f"imu-biased:4,size={degrees}").read()
    # Axes that are turned by R see a vector as R^T v.
    expected = right.copy()
    expected[:, 4] = right[:, 4] @ about_x(radians(degrees))
    assert abs(expected - right)[1].max() > 0.5
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_an_imu_that_has_come_loose_is_one_that_is_turned_about_some_axis(made):
    one, other = (Emulated(made, text).read() for text in ("imu-biased:4,size=-25", "imu-turn:4,axis=x,size_deg=-25"))
    np.testing.assert_array_equal(one, other)


def test_a_disturbance_begins_with_the_drives_and_ends_with_its_time(made):
    texts = ("imu-offset:2+6,axis=y,size_m_per_s2=0.5,ramp_s=0.01,at=0.02,for=0.03", "imu-supply:all,size_v=1,at=1")
    healthy, rig = Emulated(made), Emulated((made[0], imu_state(load_imu("ideal"), 0, 1e-3), made[2]), *texts)
    base = healthy.read()[1, :, 1]
    for milliseconds, share in ((0, 0.0), (19, 0.0), (24, 0.4), (35, 1.0), (49, 1.0), (50, 0.0), (60, 0.0)):
        # The drives are enabled at 5 ms; the plant itself stands still.
        rig.rig["enabled_ns"], rig.rig["time_ns"] = 5 * MS, (5 + milliseconds) * MS
        expected = base + 0.5 * share * np.isin(np.arange(7), (2, 6))
        np.testing.assert_allclose(rig.read()[1, :, 1], expected, atol=1e-12, err_msg=str(milliseconds))
    rig.rig["faults"] = 0
    np.testing.assert_array_equal(rig.read(), healthy.read())
    assert int(rig.imu["disturbances"]) == 0


def test_a_fault_of_an_encoder_begins_with_the_drives_and_ends_with_its_time(made):
    encoders = encoder_state(load_encoder("ideal"), 0, 1e-3)
    rig = Emulated((made[0], made[1], encoders), "encoder-dead:2+4,at=0.02,for=0.03", "encoder-jumps:5,size_mm=3,at=0.03")
    true = Emulated(made)
    true.read()
    for milliseconds, dead in ((0, False), (19, False), (20, True), (49, True), (50, False), (60, False)):
        rig.rig["enabled_ns"], rig.rig["time_ns"] = 5 * MS, (5 + milliseconds) * MS
        rig.read()
        expected = true["truth"][TRUTH_LENGTHS] + 3e-3 * (np.arange(6) == 5) * (milliseconds >= 30)
        np.testing.assert_allclose(rig["length"], np.where(dead & np.isin(np.arange(6), (2, 4)), np.nan, expected), atol=1e-9)
    rig.rig["faults"] = 0
    rig.read()
    assert np.isfinite(rig["length"]).all() and int(encoders["faults"]) == 0


def test_the_samples_of_an_imu_with_a_slow_clock_are_counted_and_dated(made):
    rig = Emulated((made[0], imu_state(load_imu("ideal"), 0, 1e-3), made[2]), "imu-clock:3,size_percent=-50")
    numbers, times = [], []
    for _ in range(20):
        rig.step().read()
        numbers.append(rig["sequence"])
        times.append(rig["sample_ns"])
    news, dated = np.diff(numbers, axis=0), np.array(times)
    assert (np.delete(news, 3, axis=1) == 1).all() and news[:, 3].sum() in (9, 10)
    assert set(np.diff(dated[:, 3]).tolist()) == {0, 2 * MS}
    np.testing.assert_array_equal(dated[:, 0], np.arange(1, 21) * MS)


@pytest.mark.parametrize(
    "text, pair", [("imu-swapped:1,size=6", (1, 6)), ("imu-swapped:5", (5, 0)), ("imu-swapped:2,size=99", (2, 6))]
)
def test_imus_that_have_changed_places_read_each_others_vectors(made, text, pair):
    right = Emulated(made).read()
    order = np.arange(7)
    order[list(pair)] = order[list(pair)][::-1]
    np.testing.assert_allclose(Emulated(made, text).read(), right[:, order], atol=1e-12)


def test_dead_and_frozen_imus_keep_their_readings_but_only_a_frozen_one_counts_on(made):
    rig = Emulated(made, "imu-dead:3,at=0", "imu-frozen:4,at=0", "imu-noisy:4,at=0")
    first = rig.read()
    assert rig["sequence"].tolist() == 7 * [1] and rig["sample_ns"].tolist() == 7 * [0]
    rig.step(ENABLED, 0.2, count=20)
    second = rig.read()
    changed = (first != second).any(axis=(0, 2))
    assert changed.tolist() == [True, True, True, False, False, True, True]
    assert rig["sequence"].tolist() == [2, 2, 2, 1, 2, 2, 2]
    assert rig["sample_ns"].tolist() == [20 * MS, 20 * MS, 20 * MS, 0, 20 * MS, 20 * MS, 20 * MS]


def test_a_noisy_imu_has_noise_of_its_size_on_rates_and_a_tenth_on_forces(made):
    rig = Emulated(made, "imu-noisy:2,size=30")
    ideal = Emulated(made).read()
    found = np.array([rig.read() for _ in range(400)]) - ideal
    quiet = np.delete(found, 2, axis=2)
    np.testing.assert_allclose(quiet, 0.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 0, 2].std(axis=0), radians(30.0), rtol=0.12)
    np.testing.assert_allclose(found[:, 1, 2].std(axis=0), 3.0, rtol=0.12)
    np.testing.assert_allclose(found[:, 2, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(found[:, 0, 2].mean(axis=0), 0.0, atol=0.2 * radians(30.0))


# ----------------------------------------------------------------------------------------------------------------- base


def test_a_base_that_leans_turns_gravity_for_all_imus_until_the_fault_is_cleared(made):
    rig = Emulated(made, "base-tilt,axis=x,size_deg=5")
    p = load_spatial("hexapod").plant_parameters()
    upright = Emulated(made).step(BRAKED, count=1500).read()
    for tilt in (5.0, 0.0):
        readings = rig.step(BRAKED, count=1500).read()
        to_platform = (about_x(radians(tilt)) @ rotation_from_quaternion(rig.plant.get("quaternion"))).T
        np.testing.assert_allclose(readings[1, 6], -to_platform @ p["gravity"], atol=0.02)
        np.testing.assert_allclose(readings[2, 6], to_platform @ p["magnetic_field"], atol=1e-9)
        assert ((np.linalg.norm(readings[1] - upright[1], axis=1) > 0.3) == (tilt > 0.0)).all()
        rig.rig["faults"] = 0
    assert not rig.plant.get("base_motion.rotation").any()


def test_the_time_of_a_moving_base_counts_from_when_the_drives_were_enabled(made):
    rig = Emulated(made, "base-tilt,axis=-y,size_deg=4,at=0.02,ramp_s=0.1,for=0.2").step(BRAKED, count=50)
    assert not rig.plant.get("base_motion.rotation").any()
    rig.step(ENABLED, 0.0, count=20)
    assert not rig.plant.get("base_motion.rotation").any()
    rig.step(count=50)
    # In the middle of its ramp.
    np.testing.assert_allclose(rig.plant.get("base_motion.rotation"), [0.0, -radians(2.0), 0.0], atol=1e-9)
    np.testing.assert_allclose(rig.plant.get("base_motion.angular_velocity"), [0.0, -1.875 * radians(40.0), 0.0], rtol=1e-7)
    rig.step(count=60)
    np.testing.assert_allclose(rig.plant.get("base_motion.rotation"), [0.0, -radians(4.0), 0.0], atol=1e-12)
    rig.step(BRAKED, count=300)
    assert not rig.plant.get("base_motion.rotation").any()


# ------------------------------------------------------------------------------------------------------------------ bus


def disturbed(*texts, count=1, now=0, enabled=-1, seed=3):
    """What becomes of so many messages: copies, delays, whether damaged and whether held back, each an array."""
    rig = new_emulated(load_spatial("hexapod"), MS, seed, [fault(text) for text in texts])
    rig["enabled_ns"] = enabled
    return [np.array(each) for each in zip(*(disturb(rig[()], now) for _ in range(count)), strict=True)]


@pytest.mark.parametrize(
    "texts, expected",
    [
        ((), (1, 0, False, False)),
        (("imu-dead:3", "drive-stuck:2"), (1, 0, False, False)),
        (("bus-down",), (0, 0, False, False)),
        (("bus-delays,size=0.25",), (1, 250_000, False, False)),
        (("bus-delays,size=0.25", "bus-delays,size=2"), (1, 2_250_000, False, False)),
        (("bus-drops,size=1",), (0, 0, False, False)),
        (("bus-drops,size=0",), (1, 0, False, False)),
        (("bus-repeats,size=1",), (2, 0, False, False)),
        (("bus-repeats,size=1", "bus-repeats,size=1"), (4, 0, False, False)),
        (("bus-repeats,size=1", "bus-down"), (0, 0, False, False)),
        (("bus-corrupts,size=1",), (1, 0, True, False)),
        (("bus-reorders,size=1",), (1, 0, False, True)),
        (("bus-delays,size=1,at=0",), (1, 0, False, False)),
    ],
)
def test_what_becomes_of_a_message(texts, expected):
    assert tuple(each[0].item() for each in disturbed(*texts)) == expected


def test_a_fault_of_the_bus_is_timed_by_the_present():
    for now, delay in ((999_999_999, 0), (1_000_000_000, 5_000_000), (2_999_999_999, 5_000_000), (3_000_000_000, 0)):
        assert disturbed("bus-delays,at=1,for=2", now=now, enabled=0)[1].item() == delay


@pytest.mark.parametrize(
    "kind, column, struck", [("drops", 0, 0), ("repeats", 0, 2), ("corrupts", 2, True), ("reorders", 3, True)]
)
def test_messages_are_disturbed_with_the_faults_probability(kind, column, struck):
    found = disturbed(f"bus-{kind},size=0.3", count=2000)
    # Four standard deviations.
    assert abs(np.mean(found[column] == struck) - 0.3) < 4.0 * np.sqrt(0.3 * 0.7 / 2000)
    again, other = (disturbed(f"bus-{kind},size=0.3", count=50, seed=seed)[column] for seed in (3, 4))
    np.testing.assert_array_equal(again, found[column][:50])
    assert (other != again).any()


def test_the_random_numbers_are_those_of_splitmix64():
    # The reference implementation's first numbers from the seed 1234567.
    state = np.array([1234567], np.uint64)
    known = (6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821)
    assert [draw(state) for _ in known] == [(each >> 11) / 2**53 for each in known]
