"""Pose control of parallel mechanisms from orientations, in simulation and with hardware in the loop.

    from hil import SimulationConfig, simulate

    result = simulate(SimulationConfig(target="sines", duration=5.0))
    print(result.summary()["estimation"]["position_rms"])

Targets as functions, stages of your own, loops that you step, and signals for xarray: docs/python.md. A run on the machine's
clock, as `gough run`:

    from pathlib import Path

    from hil import RealTimeSettings, SimulationConfig, run

    summary = run(SimulationConfig(rig="udp"), RealTimeSettings(), recording=Path("run.mcap"))

Many runs, as `gough sweep` (docs/sweeps.md):

    from hil import Factor, Study, open_engine, run_study

    study = Study((Factor("run.imu", ("mpu9150-calibrated", "icm42688")), Factor("run.seed", tuple(range(20)))))
    if __name__ == "__main__":
        with open_engine() as engine:
            print(run_study(study, Path("imus.results"), engine).frame())

The best design within bounds, as `gough optimise` (docs/optimisation.md):

    from hil import optimise, read_design

    with open_engine() as engine:
        print(optimise(read_design("design.toml"), Path("design.results"), engine).knee)

Runs beside each other, as `gough compare` (docs/compare.md):

    from hil import compare

    print(compare(["before.json", "after.mcap"]).differing())

Whatever refuses its input raises a `GoughError`. This package loads nothing until a name is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hil.calibration.data import Knowledge
    from hil.calibration.procedure import calibrate_recordings, calibrate_rig
    from hil.engine.engine import open_engine
    from hil.engine.settings import EngineSettings
    from hil.loop.own_stages import Cycle, Stages
    from hil.realtime.scheduling import RealTimeSettings
    from hil.recording.replay import replay
    from hil.reports.run import figures, write_report
    from hil.runs.comparison import Comparison, compare
    from hil.runs.config import SimulationConfig
    from hil.runs.dataset import dataset, frame
    from hil.runs.executive import RunStoppedError, run
    from hil.runs.operator import Operator
    from hil.runs.run_state import RunState
    from hil.runs.simulation import Simulation, SimulationResult, SimulationStoppedError, open_simulation, simulate
    from hil.runs.snapshot import Snapshot, read_snapshot, write_snapshot
    from hil.sweep.design import Design, read_design
    from hil.sweep.function import UserFunction
    from hil.sweep.optimisation import OptimisationResult, optimise
    from hil.sweep.study import Factor, Sampling, Study, read_study
    from hil.sweep.sweep import SweepResult, run_study
    from plant.errors import GoughError
    from plant.fmu.settings import Setting
    from plant.imu_wiring import Wiring
    from plant.mechanism import Mechanism, PlanarMechanism, load_mechanism

__all__ = [
    "Comparison", "Cycle", "Design", "EngineSettings", "Factor", "GoughError", "Knowledge", "Mechanism", "Operator",
    "OptimisationResult", "PlanarMechanism", "RealTimeSettings", "RunState", "RunStoppedError", "Sampling", "Setting",
    "Simulation", "SimulationConfig", "SimulationResult", "SimulationStoppedError", "Snapshot", "Stages", "Study",
    "SweepResult", "UserFunction", "Wiring", "calibrate_recordings", "calibrate_rig", "compare", "dataset", "figures", "frame",
    "load_mechanism", "open_engine", "open_simulation", "optimise", "read_design", "read_snapshot", "read_study", "replay",
    "run", "run_study", "simulate", "write_report", "write_snapshot",
]  # fmt: skip

_HOMES = {
    "hil.calibration.data": ("Knowledge",),
    "hil.calibration.procedure": ("calibrate_recordings", "calibrate_rig"),
    "hil.engine.engine": ("open_engine",),
    "hil.engine.settings": ("EngineSettings",),
    "hil.loop.own_stages": ("Cycle", "Stages"),
    "hil.realtime.scheduling": ("RealTimeSettings",),
    "hil.recording.replay": ("replay",),
    "hil.reports.run": ("figures", "write_report"),
    "hil.runs.comparison": ("Comparison", "compare"),
    "hil.runs.config": ("SimulationConfig",),
    "hil.runs.dataset": ("dataset", "frame"),
    "hil.runs.executive": ("RunStoppedError", "run"),
    "hil.runs.operator": ("Operator",),
    "hil.runs.run_state": ("RunState",),
    "hil.runs.simulation": ("Simulation", "SimulationResult", "SimulationStoppedError", "open_simulation", "simulate"),
    "hil.runs.snapshot": ("Snapshot", "read_snapshot", "write_snapshot"),
    "hil.sweep.design": ("Design", "read_design"),
    "hil.sweep.function": ("UserFunction",),
    "hil.sweep.optimisation": ("OptimisationResult", "optimise"),
    "hil.sweep.study": ("Factor", "Sampling", "Study", "read_study"),
    "hil.sweep.sweep": ("SweepResult", "run_study"),
    "plant.errors": ("GoughError",),
    "plant.fmu.settings": ("Setting",),
    "plant.mechanism": ("Mechanism", "PlanarMechanism", "load_mechanism"),
    "plant.imu_wiring": ("Wiring",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from plant.extras import missing_extras_named

    with missing_extras_named():
        return getattr(import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return __all__
