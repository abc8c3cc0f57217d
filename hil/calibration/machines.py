"""The machines that a guided calibration may drive: a rig on the clock, or the simulated plant."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

from controller.safety.causes import Cause
from hil.calibration.guided import Machine
from hil.calibration.procedure import SimulatedRig
from hil.progress import Progress
from hil.realtime.scheduling import RealTimeSettings
from hil.rigs import Rig
from hil.rigs.contract import examine_rig
from hil.runs.config import SimulationConfig
from hil.runs.executive import run
from hil.runs.prepare import rig_of
from hil.runs.run_state import RunState
from plant.errors import CalibrationError, InputError
from plant.mechanism import load_spatial

_TRYING_HZ = 200.0
_TOLD_BY_RUNS = "period"
"""The clause that a run at its own rate checks better."""

Watched = Callable[[SimulationConfig], AbstractContextManager[Callable[[RunState], None]]]
"""Shows a run while it lasts."""


def machine_on_clock(settings: RealTimeSettings, watched: Watched) -> Machine:
    """A rig on a bus, or in a Python class."""

    def follow(config: SimulationConfig, path: Path) -> None:
        with watched(config) as show:
            summary = run(config, settings, path, show)
        if summary["cause"] != Cause.END_OF_MOTION.text:
            raise CalibrationError(f"the run has not come to its end: {summary['cause']}")

    def try_legs(config: SimulationConfig) -> Sequence[str]:
        slow = replace(config, rate=min(config.rate, _TRYING_HZ))

        def made() -> Rig:
            rig = rig_of(slow)
            if rig is None:
                raise InputError("the FMU plant is no rig of its own: choose udp, canopen or python:MODULE:CLASS")
            return rig

        findings = examine_rig(made, 1.0 / slow.rate, mechanism=load_spatial(config.mechanism)).findings
        return [text for clause, texts in findings.items() if clause != _TOLD_BY_RUNS for text in texts]

    return Machine(follow, try_legs)


def simulated_machine(progress: Progress) -> Machine:
    """The FMU plant, as fast as it can run, to rehearse."""

    def follow(config: SimulationConfig, path: Path) -> None:
        rig = SimulatedRig()
        try:
            rig.run_closed(config, progress)
        finally:
            rig.keep(path)

    return Machine(follow, lambda config: [])
