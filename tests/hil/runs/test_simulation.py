"""The main job: a hexapod follows a motion on its FMU plant."""

import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from controller.calibration.file import Calibration, calibrated_rig, save_calibration
from controller.estimation.filterpy_filters import FilterpyLeg, FilterpyPlatform
from controller.safety.causes import Cause, Mode
from controller.settings import control_settings
from controller.workspace import check_against_limits
from hil.runs import prepare
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import SimulationStoppedError, simulate
from plant.errors import InputError, UnknownNameError, UnreachableError
from plant.fmu.settings import Setting
from plant.imu_wiring import ALL_IMUS
from plant.mechanism import load_mechanism
from plant.pose import rotation_from_quaternion, rotation_from_vector
from plant.truth import TRUTH_POSITION

MM, DEG = 1e-3, np.radians(1.0)


def errors(result, group):
    figures = result.summary()[group]
    return figures["position_rms"] / MM, figures["rotation_rms"] / DEG


@pytest.mark.parametrize("seeds", [pytest.param(2, marks=pytest.mark.slow), pytest.param(20, marks=pytest.mark.endurance)])
def test_low_cost_imus_follow_a_real_motion_within_the_promise(motion_capture, seeds):
    estimation, tracking = [], []
    for seed in range(seeds):
        result = simulate(SimulationConfig(target=str(motion_capture), duration=60.0, seed=seed))
        assert result.summary()["limits"]["violations"] == 0
        estimation.append(errors(result, "estimation"))
        tracking.append(errors(result, "tracking"))
    assert (np.max(estimation, axis=0) <= (0.7, 0.12)).all()
    assert np.sqrt(np.mean(np.square(estimation), axis=0))[0] <= 0.4
    assert (np.max(tracking, axis=0) <= (0.75, 0.12)).all()


@pytest.mark.parametrize("duration", [15.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_ideal_imus_follow_a_real_motion_within_the_promise(motion_capture, duration):
    result = simulate(SimulationConfig(target=str(motion_capture), duration=duration, imu="ideal"))
    assert errors(result, "estimation") < (0.02, 0.01)
    assert errors(result, "estimation")[1] < 0.01
    assert errors(result, "tracking") < (0.05, 0.01)
    assert errors(result, "tracking")[1] < 0.01
    assert result.summary()["target"]["reference_position_rms"] <= 0.02 * MM


@pytest.mark.parametrize("target", ["hold", "circle", "sines", "steps"])
def test_every_named_motion_is_followed(target):
    result = simulate(SimulationConfig(target=target, duration=4.0, imu="ideal"))
    assert errors(result, "tracking")[0] < 0.15
    assert result.reference.violations == 0


@pytest.mark.parametrize("mechanism", ["hexapod", "6-4-II", "planar-3rpr"])
def test_a_run_begins_at_rest_on_its_brakes_with_a_true_estimate(mechanism):
    """From the very first sample: the plant stands, and accelerometers that read gravity alone tell the pose."""
    result = simulate(SimulationConfig(mechanism=mechanism, target="hold", duration=0.01, imu="ideal"))
    held = result.records[result.times < 0.0]
    gravity = np.linalg.norm(result.mechanism.plant["gravity"])
    used = [*range(result.mechanism.legs), 6]
    np.testing.assert_allclose(np.linalg.norm(held["specific_force"][:, used], axis=2), gravity, rtol=1e-6)
    assert np.abs(held["position"] - result.true_positions[result.times < 0.0]).max() < 1e-6
    assert np.ptp(held["truth"][:, TRUTH_POSITION], axis=0).max() < 1e-9


def test_what_a_calibration_does_not_tell_is_said_before_the_run_and_recorded(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("[imu_2.accelerometer]\nbias = [1e-4, 0.0, 0.0]\n")
    said = []
    result = simulate(SimulationConfig(duration=0.05, calibration=str(path)), say=said.append)
    assert said == result.summary()["remarks"]
    assert said[0].startswith(f"{path} has no digest, which would show a cut or a change; no mechanism; no imu; nothing of")
    assert simulate(SimulationConfig(duration=0.05)).summary()["remarks"] == []


def test_gains_that_do_not_suit_and_imus_that_hardly_check_each_other_are_said_before_the_run_and_recorded(tmp_path):
    path, said = tmp_path / "quick.toml", []
    path.write_text('based_on = "hexapod"\n[control]\nproportional = 120.0\nintegral = 400.0\n')
    result = simulate(SimulationConfig(str(path), duration=0.05, imus=(0, 1, 3, 4, 6)), say=said.append)
    assert said == result.summary()["remarks"]
    assert [remark[:9] for remark in said] == ["the gains", "the other"]
    assert "do not suit" in said[0] and "the others hardly check IMU 6" in said[1]


@pytest.mark.parametrize(("own", "slack"), [("", 0.03), ("[drives]\nslack = 0.004\n", 0.004)])
def test_a_slack_of_ones_own_holds_with_few_imus(tmp_path, own, slack):
    path = tmp_path / "own.toml"
    path.write_text(f'based_on = "hexapod"\n{own}')
    with prepared_loop(SimulationConfig(str(path), duration=0.05, imus=(0, 1, 3, 4))) as loop:
        assert loop.parameters["safety"]["drives"]["slack"] == slack


@pytest.mark.parametrize(("imus", "limited"), [(ALL_IMUS, True), ((0, 1, 3, 4), False)])
def test_the_noise_of_few_imus_is_no_oscillation(imus, limited):
    with prepared_loop(SimulationConfig(duration=0.05, imus=imus)) as loop:
        assert np.isfinite(loop.parameters["safety"]["watch"]["oscillation"]) == limited


@pytest.mark.parametrize("seed", [2, 11])
def test_four_legs_alone_hold_the_platform_with_the_whole_mechanism_filter(seed):
    """The filter began at the pose of the first sample, up to 12 deg off, as sure as with all IMUs: these runs ended."""
    result = simulate(SimulationConfig(target="hold", duration=1.0, imus=(1, 2, 3, 4), fusion="whole", seed=seed))
    assert result.summary()["estimation"]["position_rms"] < 4e-3


PLAY = Setting("joint.clearance", (5e-4,))


@pytest.mark.parametrize("seed", [2, 8])
def test_a_mechanism_that_chatters_in_its_play_goes_on_with_half_the_gains(seed):
    """0.5 mm of clearance: from one second on the legs would go to and fro by 1 mm at 18 Hz, and on and on."""
    result = simulate(SimulationConfig(target="sines", duration=8.0, seed=seed, settings=(PLAY,)))
    causes = result.records["event_cause"]
    halved = np.flatnonzero((causes == Cause.GAINS_HALVED).any(axis=1))
    assert 1 <= len(halved) <= 2 and result.times[halved[-1]] < 4.0
    corrections = result.records["command"] - result.records["reference"][..., 1]
    assert np.diff(corrections[-4000:], axis=0).std() < 0.2 * np.diff(corrections[halved[0] - 250 : halved[0]], axis=0).std()


@pytest.mark.parametrize("seed", [3135, 3136])
def test_slight_chatter_in_play_is_no_fault_of_an_imu(seed):
    """0.05 mm of backlash: the platform goes to and fro by 0.1 mm at 20 Hz. The evidence against an IMU came to 9 sigma."""
    settings = Setting("payload.mass", (15.0,)), Setting("screw.backlash", (5e-5,))
    result = simulate(SimulationConfig("6-3-II", target="sines", duration=6.0, seed=seed, fusion="compiled", settings=settings))
    told = set(result.records["event_cause"].ravel().tolist())
    assert Cause.ARMED in told and told <= {Cause.NONE, Cause.ARMED, Cause.GAINS_HALVED}


def test_a_platform_that_heaves_in_its_play_goes_on_with_half_the_gains():
    """20 um of clearance at 333 Hz: it heaved by 3 g within 0.2 s and did not turn, and its IMU was left out as noisy."""
    settings = Setting("payload.mass", (10.0,)), Setting("joint.clearance", (2e-5,))
    config = SimulationConfig(
        target="steps", duration=2.0, rate=333.0, imu="icm42688", seed=6604, fusion="compiled", settings=settings,
        joint_error=5e-5,
    )  # fmt: skip
    causes = simulate(config).records["event_cause"]
    told = set(causes.ravel().tolist())
    assert Cause.GAINS_HALVED in told and not told & {Cause.IMU_NOISY, Cause.PLATFORM_IMU_LOST, Cause.OSCILLATES}


@pytest.mark.parametrize("seed", [2, 8])
def test_a_mechanism_that_chatters_with_gains_that_were_halved_twice_is_stopped(tmp_path, seed):
    path = tmp_path / "stiff.toml"
    path.write_text('based_on = "hexapod"\n[control]\nproportional = 240\nintegral = 3200\n')
    with prepared_loop(SimulationConfig(str(path), target="sines", duration=8.0, seed=seed, settings=(PLAY,))) as loop:
        loop.state["pid"]["halvings"] = 2
        assert loop.run(4000) == Cause.OSCILLATES


def test_a_calibration_of_another_rig_is_refused_before_anything_runs(tmp_path):
    path = tmp_path / "rig.toml"
    about = calibrated_rig(load_mechanism("hexapod"), "mpu9150-calibrated")
    save_calibration(path, Calibration(about=about))
    assert simulate(SimulationConfig(duration=0.05, calibration=str(path))).summary()["remarks"] == []
    for changes, said in (({"mechanism": "6-5"}, "of the mechanism 'hexapod'"), ({"imu": "icm42688"}, "of the kind of IMU")):
        with pytest.raises(InputError, match=said):
            simulate(SimulationConfig(duration=0.05, calibration=str(path), **changes))


def suited(tmp_path, rate):
    """The hexapod with gains that suit the rate: with its own it rings for a second, which is told, or a run says that they do
    not suit.
    """
    if not 50.0 <= rate < 200.0:
        return "hexapod"
    path = tmp_path / "slow.toml"
    path.write_text('based_on = "hexapod"\n[control]\nproportional = 30.0\nintegral = 50.0\n')
    return str(path)


@pytest.mark.parametrize("rate", [50.0, 250.0, 4000.0])
def test_the_loop_follows_at_other_rates(tmp_path, rate):
    result = simulate(SimulationConfig(suited(tmp_path, rate), "sines", 4.0, rate=rate))
    assert not any("gains" in remark for remark in result.remarks)
    assert any("there is no protection level" in remark for remark in result.remarks) == (rate < 125.0)
    assert errors(result, "tracking") < (3.0, 0.6)


@pytest.mark.parametrize("rate", [50.0, 70.0, 100.0, 150.0, 200.0, 300.0, 500.0, 2000.0])
@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 4), marks=pytest.mark.slow)], ids=["one", "more"])
def test_no_watch_stops_a_sound_run_at_any_rate(tmp_path, rate, seeds):
    mechanism = suited(tmp_path, rate)
    for seed in seeds:
        for target in ("circle", "sines"):
            records = simulate(SimulationConfig(mechanism, target, 3.0, rate=rate, seed=seed)).records
            # Armed, and nothing else: no IMU is left out.
            assert records["event_count"].sum() == 1, (seed, target)


def test_a_target_faster_than_the_limits_is_followed_as_closely_as_they_allow(tmp_path):
    times = np.arange(0.0, 4.0, 0.01)
    x = 0.04 * np.sin(2.0 * np.pi * 3.0 * times) * np.minimum(times, 1.0)
    rows = [f"{t:.2f},{value:.6f},0,0,1,0,0,0" for t, value in zip(times, x, strict=True)]
    path = tmp_path / "fast.csv"
    path.write_text("\n".join(["time_s,x_m,y_m,z_m,qw,qx,qy,qz", *rows]))
    result = simulate(SimulationConfig(target=str(path), duration=4.0, imu="ideal"))
    assert result.reference.violations == 0
    assert result.summary()["target"]["reference_position_rms"] > 2.0 * MM
    speeds = np.abs(result.records["reference"][:, :, 1])
    assert speeds.max() > 0.5 * result.mechanism.limits.velocity
    assert errors(result, "tracking")[0] < 1.0


def test_one_seed_gives_one_result_bit_for_bit_and_another_seed_another():
    first, second, other = (simulate(SimulationConfig(duration=1.0, seed=seed)).records for seed in (3, 3, 4))
    for field in set(first.dtype.names) - {"stage_ns"}:
        assert first[field].tobytes() == second[field].tobytes(), field
    assert first["command"].tobytes() != other["command"].tobytes()


def test_a_fault_of_imus_begins_at_its_time_of_the_motion():
    fault = "imu-offset:all,axis=y,size_m_per_s2=0.5,ramp_s=0.01,at=0.6"
    healthy, disturbed = (
        simulate(SimulationConfig(target="hold", duration=0.605, faults=each)).records for each in ((), (fault,))
    )
    begun = round((0.2 + 0.6) * 1000)
    for field in set(healthy.dtype.names) - {"stage_ns"}:
        assert healthy[field][:begun].tobytes() == disturbed[field][:begun].tobytes(), field
    # The low-pass is late by 0.6 cycles, and the loop has not reacted much yet.
    added = (disturbed["specific_force"] - healthy["specific_force"])[begun : begun + 5, :, 1].mean(axis=1)
    np.testing.assert_allclose(added, 0.5 * np.clip((np.arange(5) - 0.6) / 10.0, 0.0, 1.0), atol=0.03)


def test_the_samples_of_imus_with_clocks_of_their_own_have_their_ages_and_times():
    records = simulate(SimulationConfig(target="hold", duration=1.0, faults=("imu-clock:3,size_percent=-50,at=0",))).records
    age, begun = records["sample_age"], 210
    assert (np.delete(age, 3, axis=1) == 0).all() and (age[:190] == 0).all()
    assert set(age[begun:, 3].tolist()) == {0, 1} and age[begun:, 3].mean() == pytest.approx(0.5, abs=0.01)
    late = records["time_ns"][begun:] - records["sample_ns"][begun:, 3]
    assert late.min() >= 0 and late.max() < 2_000_000


def test_what_was_left_out_is_in_the_summary():
    result = simulate(SimulationConfig(target="sines", duration=1.2, faults=("imu-noise:3,axis=all,size_deg_per_s=20,at=0.8",)))
    events = result.summary()["events"]
    assert events[0].endswith(": armed")
    assert any(re.fullmatch(r"cycle \d+ \(\d\.\d{3} s\): IMU 3 is left out: it is noisy \(.*\)", event) for event in events)


@pytest.mark.parametrize("imu", [3, 6])
def test_a_slow_imu_among_others_does_not_bend_the_pose(imu):
    """The samples that it repeats are up to 3 ms old; taken as new, they cost 17 mm, or a leg off its reference."""
    fault = f"imu-clock:{imu},size_percent=-66.66"
    records = simulate(SimulationConfig(duration=3.0, seed=3, fusion="whole", faults=(fault,))).records[800:]
    assert np.linalg.norm(records["position"] - records["truth"][:, :3], axis=1).max() < 2.0 * MM


def test_a_run_taken_up_from_its_arrays_goes_on_bit_for_bit():
    config = SimulationConfig(duration=0.5)
    with prepared_loop(config) as whole, prepared_loop(config) as parts:
        assert whole.run(700) == 0
        assert parts.run(333) == 0
        parts.state, parts.imu = parts.state.copy(), parts.imu.copy()
        assert parts.run(700) == 0
        assert whole.state.tobytes() == parts.state.tobytes()
        assert whole.imu.tobytes() == parts.imu.tobytes()


def test_runs_of_the_same_motion_share_its_plan(monkeypatch):
    asked = []
    monkeypatch.setattr(prepare, "check_against_limits", lambda *question: asked.append(1) or check_against_limits(*question))
    # No other test has this duration.
    config, times = SimulationConfig(duration=0.513), []
    others = {"seed": 3, "fusion": "whole"}, {"imus": (0, 1, 2, 3, 6)}, {"duration": 0.514}
    for changes, count in zip(({}, *others), (1, 1, 2, 3), strict=True):
        with prepared_loop(replace(config, **changes)) as loop:
            assert len(asked) == count
            assert loop.segments is loop.reference.segments
            # A user may change the plan of a run: others have their own.
            assert (loop.segments[:, 0, 1] > 0.1).all()
            loop.segments[:] = 0.0
            times.append(loop.planning_time)
    assert times[0] == times[1] > 0.0


@pytest.mark.slow
def test_filterpy_closes_the_same_loop(monkeypatch):
    taken = Counter()
    for kind, name in ((FilterpyLeg, "take"), (FilterpyPlatform, "step")):
        whole = getattr(kind, name)

        def step(self, *sample, kind=kind, whole=whole):
            taken[kind] += 1
            whole(self, *sample)

        monkeypatch.setattr(kind, name, step)
    config = SimulationConfig(target="sines", duration=0.8, rate=500.0)
    compiled, filterpy = (simulate(replace(config, fusion=fusion)).records for fusion in ("compiled", "filterpy"))
    assert taken == {FilterpyLeg: 6 * len(filterpy), FilterpyPlatform: len(filterpy)}
    np.testing.assert_allclose(filterpy["position"], compiled["position"], atol=1e-11)
    np.testing.assert_allclose(filterpy["command"], compiled["command"], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("imus", [(0, 1, 2, 3, 4, 5), (0, 1, 2, 6), (0, 1, 2, 3, 4), (1, 2, 3, 4, 5, 6)])
def test_any_imus_that_determine_the_pose_close_the_loop(imus):
    result = simulate(SimulationConfig(target="circle", duration=3.0, imus=imus))
    assert errors(result, "tracking") < (3.0, 1.0)


def test_imus_that_do_not_determine_the_pose_are_refused():
    for imus in ((0, 1, 6), (0, 1, 2), (0, 2, 4, 6), (), (7,)):
        with pytest.raises(InputError):
            simulate(SimulationConfig(imus=imus))


def test_nothing_moves_while_the_brakes_hold():
    result = simulate(SimulationConfig(target="sines", duration=0.2))
    hold = result.records["mode"] < Mode.RUNNING
    assert hold.sum() == 200
    # Then the legs are brought to the start of the target, and its time begins.
    approach = (result.times < 0.0) & ~hold
    assert 0 < approach.sum() < 150 and len(result.times) == 400 + approach.sum()
    assert result.times[-1] == pytest.approx(0.199)
    assert (result.records["command"][hold] == 0.0).all()
    moved = np.linalg.norm(result.true_positions[hold] - result.true_positions[0], axis=1)
    assert moved.max() < 20e-6


@pytest.mark.parametrize(("rate", "seconds"), [(50.0, 1.0), (249.0, 1.0), (250.0, 0.2)])
def test_at_low_rates_the_brakes_hold_for_longer(rate, seconds):
    result = simulate(SimulationConfig(target="hold", duration=0.1, rate=rate))
    assert (result.records["mode"] < Mode.RUNNING).sum() == np.ceil(seconds * rate)


@pytest.mark.parametrize("rate", [200.0, 1000.0])
@pytest.mark.parametrize("hold", [0.19, 10.1])
def test_a_hold_in_which_no_estimate_settles_is_refused(hold, rate):
    with pytest.raises(InputError, match=f"hold is {hold:g} s; it must be 0.2 to 10 s"):
        simulate(SimulationConfig(hold=hold, rate=rate))
    mechanism = load_mechanism("hexapod")
    settings = {**mechanism.settings, "control": {"hold": hold}}
    with pytest.raises(InputError, match=f"hold is {hold:g} s"):
        simulate(SimulationConfig(mechanism=replace(mechanism, settings=settings), rate=rate))


@pytest.mark.parametrize("fusion", ["compiled", "whole"])
@pytest.mark.parametrize("rate", [62.0, 100.0, 150.0, 200.0])
def test_the_loop_does_not_oscillate_at_low_rates(rate, fusion):
    """The estimate does not leap to and fro from cycle to cycle. When the brakes held for 0.2 s, it did, by up to 0.7 mm."""
    result = simulate(SimulationConfig(duration=1.0, rate=rate, imu="ideal", seed=810, fusion=fusion))
    error = (result.records["position"] - result.true_positions)[result.times >= 0.0]
    assert len(error) >= rate
    leaps = np.linalg.norm(error[2:] - 2.0 * error[1:-1] + error[:-2], axis=1) / 4.0
    assert leaps.max() < 25e-6


def test_settings_of_the_preset_are_those_of_the_design():
    gains = control_settings(load_mechanism("hexapod"))
    assert gains == replace(gains, proportional=60.0, integral=200.0, derivative=0.0, hold=0.2)


def test_a_plant_that_fails_in_motion_ends_the_run_with_its_reason_and_its_record():
    # Friction that steep is too stiff for the substep, which the FMU tells when it is set.
    steep = Setting("friction.velocity", (1e-9,), 0.5)
    with pytest.raises(
        SimulationStoppedError, match=r"cycle \d+ of \d+.*changing a parameter failed: substep is 0.0005"
    ) as stopped:
        simulate(SimulationConfig(duration=1.0, settings=(steep,)))
    assert 600 < len(stopped.value.result.records) < 1200


def test_what_cannot_be_used_is_refused():
    for changes, error in (
        ({"rate": 10.0}, InputError),
        ({"rate": float("nan")}, InputError),
        ({"fusion": "magic"}, UnknownNameError),
        ({"imu": "magic"}, UnknownNameError),
        ({"mechanism": "magic"}, UnknownNameError),
        ({"target": "magic"}, UnknownNameError),
        ({"duration": 0.0}, InputError),
        ({"seed": -1}, InputError),
    ):
        with pytest.raises(error):
            simulate(SimulationConfig(**changes))


def test_an_unreachable_pose_names_the_leg_and_by_how_much(tmp_path):
    path = tmp_path / "far.csv"
    path.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,0.09,1,0,0,0\n")
    with pytest.raises(UnreachableError, match=r"stroke of leg \d would be .* mm at 0\.\d+ s, and must be at most .* mm; far"):
        simulate(SimulationConfig(target=str(path)))
    # A plant cannot be started out there; the target is refused before.
    path.write_text("time_s,x_m,y_m,z_m,qw,qx,qy,qz\n0,0,0,0.35,1,0,0,0\n1,0,0,0.36,1,0,0,0\n")
    with pytest.raises(UnreachableError, match=r"far\.csv is out of reach: .* displacements from home$"):
        simulate(SimulationConfig(target=str(path)))


def test_the_process_of_a_loop_loads_no_design_or_plotting_library():
    # numba loads a part of scipy by itself; nothing may be added to it.
    code = (
        "import sys; from hil.runs.config import SimulationConfig; from hil.runs.simulation import simulate;"
        "import numba.np.arraymath;"
        "before = set(sys.modules);"
        "simulate(SimulationConfig(duration=0.05));"
        "roots = {name.split('.')[0] for name in sys.modules};"
        "print(sorted(roots & {'control', 'casadi', 'filterpy', 'plotly', 'matplotlib'}),"
        "sorted(name for name in set(sys.modules) - before if name.startswith('scipy')))"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[] []"


@pytest.mark.parametrize(("target", "first"), [("sines", 210), ("hold", 2800)])
def test_the_loop_allocates_nothing_per_cycle(target, first):
    """At rest, too, after the 2.5 s from which on commands are added up."""
    code = (
        "from hil.runs.config import SimulationConfig\nfrom hil.runs.prepare import prepared_loop\n"
        "from numba.core.runtime import rtsys\n"
        f"with prepared_loop(SimulationConfig(target='{target}', duration=4.0)) as loop:\n"
        "    counts = []\n"
        f"    for last in ({first}, {first + 10}, {first + 1000}):\n"
        "        loop.run(last)\n"
        "        counts.append(rtsys.get_allocation_stats().alloc)\n"
        "print(counts[1] - counts[0], counts[2] - counts[1])\n"
    )
    environment = os.environ | {"NUMBA_NRT_STATS": "1"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    ten_cycles, many_cycles = map(int, run.stdout.split())
    assert ten_cycles == many_cycles


def test_a_simulated_base_tilts_and_the_imus_turn_with_it():
    """The platform's magnetometer sees the field through the base's attitude, from the time of the motion on."""
    config = SimulationConfig(
        target="hold", duration=0.3, imu="ideal", faults=("base-tilt,axis=x,size_deg=3,at=0.1,ramp_s=0.1",)
    )
    with prepared_loop(config) as loop:
        plant, hold = loop.simulated, int(loop.parameters["rig"]["hold_cycles"])
        for cycle, tilt in ((101, 0.0), (151, 1.5), (290, 3.0)):
            loop.run(hold + cycle)
            turn = plant.get("base_motion.rotation")
            np.testing.assert_allclose(np.degrees(turn), [tilt, 0.0, 0.0], atol=1e-6)
            attitude = rotation_from_vector(turn) @ rotation_from_quaternion(plant.get("quaternion"))
            seen = attitude.T @ loop.mechanism.plant["magnetic_field"]
            np.testing.assert_allclose(plant.get("imu_magnetic_field")[6], seen, atol=1e-9)
