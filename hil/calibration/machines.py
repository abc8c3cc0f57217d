"""The machines that a guided calibration may drive: a rig on the clock, or the simulated plant."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

from controller.safety.causes import Cause
from hil.calibration.guided import Machine
from hil.calibration.procedure import SimulatedRig
from hil.progress import Progress
from hil.realtime.scheduling import RealTimeSettings, real_time
from hil.rigs import Rig
from hil.rigs.contract import examine_rig
from hil.runs.config import SimulationConfig
from hil.runs.executive import RunStoppedError, run
from hil.runs.prepare import rig_of
from hil.runs.run_state import RunState
from plant.errors import CalibrationError, InputError
from plant.mechanism import load_spatial

_TRYING_HZ = 200.0
_LONG_PAUSE_S = 0.02
"""Drives may have stopped by themselves if periods were missed for this time or longer [s]."""
_TOLD_BY_RUNS = "period"
"""The clause that a run at its own rate checks better."""

Watched = Callable[[SimulationConfig], AbstractContextManager[Callable[[RunState], None]]]
"""Shows a run while it lasts."""


def machine_on_clock(settings: RealTimeSettings, watched: Watched) -> Machine:
    """A rig on a bus, or in a Python class."""

    def follow(config: SimulationConfig, path: Path) -> None:
        try:
            with watched(config) as show:
                summary = run(config, settings, path, show)
        except RunStoppedError as error:
            raise CalibrationError(f"{error}{_advice(error.summary, config.rate)}") from None
        if summary["cause"] != Cause.END_OF_MOTION.text:
            by = "you have stopped it" if summary["cause"] == Cause.STOP_REQUESTED.short else summary["cause"]
            raise CalibrationError(f"the run has not come to its end: {by}")

    def try_legs(config: SimulationConfig) -> Sequence[str]:
        slow = replace(config, rate=min(config.rate, _TRYING_HZ))

        def made() -> Rig:
            rig = rig_of(slow)
            if rig is None:
                raise InputError("the FMU plant is no rig of its own: choose udp, canopen or python:MODULE:CLASS")
            return rig

        with real_time(settings):
            findings = examine_rig(made, 1.0 / slow.rate, mechanism=load_spatial(config.mechanism)).findings
        return [text for clause, texts in findings.items() if clause != _TOLD_BY_RUNS for text in texts]

    return Machine(follow, try_legs)


def _advice(summary: dict[str, Any] | None, rate: float) -> str:
    """What to do if a run ended because this machine held the loop up, in words; "" if it did not."""
    if summary is None:
        return ""
    paused = summary["missed_in_a_row"] / rate
    if Cause.MISSED_PERIODS.text not in summary["cause"] and paused < _LONG_PAUSE_S:
        return ""
    lacking = f"; it ran without {'; '.join(summary['refused'])}" if summary["refused"] else ""
    return (
        f": this machine held the loop up for {1e3 * paused:.0f} ms ({summary['missed_late']} periods woken late, "
        f"{summary['missed_host']} held up by the host, {summary['missed_own']} by own work), and drives stop when they hear "
        "nothing for longer than their watchdog: end what else runs on it, give the loop a processor of its own (--cpu), or "
        f"take a lower --rate{lacking}"
    )


def simulated_machine(progress: Progress) -> Machine:
    """The FMU plant, as fast as it can run, to rehearse."""

    def follow(config: SimulationConfig, path: Path) -> None:
        rig = SimulatedRig()
        try:
            rig.run_closed(config, progress)
        finally:
            rig.keep(path)

    return Machine(follow, lambda config: [])
