"""The machines that a guided calibration drives: what a user is told when this computer holds the loop up."""

from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.calibration import machines
from hil.calibration.machines import machine_on_clock
from hil.realtime.scheduling import RealTimeSettings
from hil.rigs.clauses import Examination
from hil.runs.config import SimulationConfig
from hil.runs.executive import RunStoppedError
from plant.errors import CalibrationError

CONFIG = SimulationConfig(imu="mpu9150", rate=1000.0, rig="udp")
MISSED = "stopped before its time at cycle 18977: too many periods missed in a row (27 periods, the limit is 25 periods)"
FAULT = "stopped on the brakes at cycle 400: drive 0 reports a fault (0x8130)"


def stopped(cause, in_a_row, refused=()):
    summary = {"cause": cause, "missed_in_a_row": in_a_row, "missed_late": 20, "missed_host": 7, "missed_own": 0}
    return RunStoppedError(cause, {**summary, "refused": list(refused)})


@pytest.fixture
def machine(monkeypatch):
    """A machine on the clock whose runs end by `machine.error`, if there is one."""
    held = SimpleNamespace(error=None)

    def run(*arguments):
        if held.error is not None:
            raise held.error
        return {"cause": "end of the motion"}

    monkeypatch.setattr(machines, "run", run)
    held.follow = machine_on_clock(RealTimeSettings(), lambda config: nullcontext(lambda state: None)).run
    return held


@pytest.mark.parametrize("error", [stopped(MISSED, 27), stopped(FAULT, 33, ["SCHED_FIFO at priority 80: run as root"])])
def test_a_run_that_this_machine_held_up_says_what_to_do(machine, error):
    machine.error = error
    with pytest.raises(CalibrationError) as told:
        machine.follow(CONFIG, Path("a.mcap"))
    text = str(told.value)
    held_up = (
        f"held the loop up for {error.summary['missed_in_a_row']} ms (20 periods woken late, 7 held up by the host, 0 by own"
    )
    assert text.startswith(str(error)) and held_up in text
    assert "end what else runs on it" in text and "--cpu" in text and "--rate" in text
    assert ("it ran without SCHED_FIFO" in text) == bool(error.summary["refused"])


@pytest.mark.parametrize("error", [stopped(FAULT, 3), RunStoppedError("the loop's process has died")])
def test_a_run_that_ended_otherwise_says_so_alone(machine, error):
    machine.error = error
    with pytest.raises(CalibrationError) as told:
        machine.follow(CONFIG, Path("a.mcap"))
    assert str(told.value) == str(error)


def test_legs_are_tried_by_a_real_time_thread(monkeypatch):
    """Else whatever else runs holds it up beyond the drives' watchdog."""
    order = []

    @contextmanager
    def real_time(settings):
        order.append(settings.priority)
        yield []
        order.append("over")

    def examine(*arguments, **more):
        order.append("examined")
        return Examination(findings={"drives": ["Leg 3 is faulty."], "period": ["It takes long."]})

    monkeypatch.setattr(machines, "real_time", real_time)
    monkeypatch.setattr(machines, "examine_rig", examine)
    found = machine_on_clock(RealTimeSettings(priority=42), lambda config: nullcontext(lambda state: None)).try_legs(CONFIG)
    assert found == ["Leg 3 is faulty."] and order == [42, "examined", "over"]
