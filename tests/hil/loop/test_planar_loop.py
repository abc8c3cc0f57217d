"""The closed loop on the planar plant's FMU: targets are followed, and what fails ends as it should."""

import re

import numpy as np
import pytest

from controller.safety.causes import Cause, Mode
from controller.safety.stop import describe_end
from hil.command_line import main
from hil.loop.driver import FmuRig
from hil.reports.run import write_report
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.simulation import simulate
from plant.dynamics.variables import PLATFORM_IMU
from plant.errors import InputError
from plant.fmu.build import PLANAR_MODEL, default_fmu
from tests.hil.loop.test_driver import replayed
from tests.hil.runs.test_simulation import errors

RIG = "planar-3rpr"
OF_SIX_LEGS = "the rig 'udp' has six legs, and planar-3rpr has three: choose another rig"


def config(**changes):
    return SimulationConfig(**{"mechanism": RIG, "duration": 3.0, **changes})


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_circle_is_followed_with_low_cost_imus(seed):
    result = simulate(config(duration=8.0, seed=seed))
    assert (np.array(errors(result, "estimation")) <= (0.6, 0.12)).all()
    assert (np.array(errors(result, "tracking")) <= (0.6, 0.14)).all()
    assert result.reference.violations == 0
    assert np.ptp(result.true_positions[:, :2], axis=0).min() > 0.02


@pytest.mark.parametrize("target", ["circle", "sines", "shaking"])
def test_ideal_imus_follow_closely(target):
    result = simulate(config(target=target, imu="ideal"))
    assert (np.array(errors(result, "estimation")) <= (0.08, 0.05)).all()
    assert (np.array(errors(result, "tracking")) <= (0.2, 0.15)).all()


def test_the_plant_may_be_of_fmi_2_and_the_records_are_the_same():
    ours = simulate(config(duration=0.5)).records
    other = simulate(config(duration=0.5, plant=str(default_fmu(PLANAR_MODEL, 2)))).records
    for name in ("position", "rotation", "lengths", "command", "truth"):
        np.testing.assert_array_equal(ours[name], other[name])
    assert np.isfinite(ours["truth"][:, :10]).all()
    assert not ours["lengths"][:, 3:].any() and not ours["command"][:, 3:].any()


def test_a_cycle_that_is_replayed_finds_the_same():
    with prepared_loop(config()) as loop:
        assert loop.run(1000) == Cause.NONE
        found = replayed(loop, loop.records[:1000])
        for name in ("position", "rotation", "lengths", "command", "conditioning"):
            np.testing.assert_array_equal(found[name], loop.records[name][:1000])


class Disturbed(FmuRig):
    """The FMU, of whose IMUs some are disturbed from a cycle on: frozen, or turned by an angle about the plane's normal."""

    def __init__(self, loop, cycle, frozen=(), turned=()):
        super().__init__(loop)
        self._loop_of, self._cycle, self._frozen, self._turned = loop, cycle, list(frozen), dict(turned)
        self._last = None

    def exchange(self, command, request, feedback):
        status = super().exchange(command, request, feedback)
        measurement = feedback["measurement"]
        if self._loop_of.state["time"]["cycle"] < self._cycle:
            self._last = measurement[:, self._frozen].copy()
            return status
        measurement[:, self._frozen] = self._last
        for imu, angle in self._turned.items():
            # The normal is the x axis of a leg's IMU.
            c, s = np.cos(angle), np.sin(angle)
            measurement[:, imu, 1:] = measurement[:, imu, 1:] @ [[c, s], [-s, c]]
        return status


def run_disturbed(**disturbance):
    """Run to the end with a disturbance; the cause, the loop's state, records, and how the plant stands half a second later."""
    with prepared_loop(config(duration=1.5)) as loop:
        cause = loop.follow(loop.end, Disturbed(loop, 900, **disturbance))
        loop.plant.step(0.5)
        speed = float(np.abs(loop.plant.get("leg_velocity")).max())
        records = loop.records[: int(loop.state["time"]["cycle"])].copy()
        return cause, loop.state.copy(), records, speed


def told(records):
    return {int(cause) for cause in records["event_cause"].ravel()}


def test_a_leg_imu_that_freezes_is_left_out_and_the_motion_goes_on():
    cause, state, records, speed = run_disturbed(frozen=[1])
    assert cause == Cause.END_OF_MOTION and state["safety"]["mode"] == Mode.STOPPED
    assert Cause.IMU_FROZEN in told(records)
    off = np.linalg.norm(records["position"] - records["truth"][:, :3], axis=1)
    assert off[1000:].max() < 1.5e-3
    assert speed < 1e-6


@pytest.mark.parametrize("frozen", [[PLATFORM_IMU], [0, 2]])
def test_a_pose_that_is_lost_ends_on_the_brakes_with_its_cause(frozen):
    cause, state, records, speed = run_disturbed(frozen=frozen)
    assert cause == Cause.POSE_LOST and state["safety"]["mode"] == Mode.FAULT
    assert describe_end(state) == Cause(Cause.POSE_LOST).text
    assert {Cause.IMU_FROZEN, Cause.POSE_LOST} <= told(records)
    assert 900 <= state["safety"]["stop"]["cycle"] < 930
    assert speed < 1e-6


@pytest.mark.parametrize("leg", range(3))
def test_a_leg_imu_that_lies_contradicts_the_others_and_the_motion_stops(leg):
    """Three legs and the roll tell that one of them is wrong, not which: none is named."""
    cause, state, records, speed = run_disturbed(turned={leg: np.radians(2.0)})
    assert cause == Cause.IMUS_DISAGREE and state["safety"]["mode"] == Mode.STOPPED
    assert describe_end(state).startswith("the IMUs contradict each other (0.0")
    assert Cause.IMUS_DISAGREE in told(records)
    assert speed < 1e-6


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fusion": "whole"}, "fusion 'whole' is for six legs; for planar-3rpr, which is planar, take 'compiled'"),
        ({"magnetometer": True}, "'planar-3rpr' is planar and has no heading"),
        ({"imus": (0, 1, 2)}, "the IMUs 0, 1, 2 determine the pose of 'planar-3rpr' up to its two assembly modes at best"),
        ({"plant": str(default_fmu())}, "gough_plant.fmu has 6 legs, and the mechanism has 3"),
    ],
)
def test_what_a_planar_mechanism_cannot_do_is_refused(changes, said):
    with pytest.raises(InputError, match=re.escape(said)):
        simulate(config(**changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"target": "stream"}, "a target can be streamed to six legs alone; planar-3rpr is planar"),
        ({"rig": "udp"}, OF_SIX_LEGS),
    ],
)
def test_runs_that_are_for_six_legs_are_refused(changes, said):
    with pytest.raises(InputError, match=re.escape(said)), prepared_loop(config(**changes)):
        pass


@pytest.mark.parametrize("rig", ["udp", "canopen"])
def test_a_rig_of_six_legs_is_refused_before_it_is_asked(rig, capsys):
    assert main(["check-rig", "--mechanism", RIG, "--rig", rig]) == 2
    assert OF_SIX_LEGS.replace("udp", rig) in capsys.readouterr().err


def test_the_report_draws_three_legs(tmp_path):
    write_report(simulate(config(duration=0.5)), tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "gough: planar-3rpr follows circle" in page
    assert "leg 2" in page and "leg 3" not in page
