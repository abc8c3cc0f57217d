"""The benchmark must time the very loop that runs."""

import numpy as np

from hil.bench import STAGES, _run_stages
from hil.simulation import SimulationConfig, prepared_loop
from plant.variables import IMU_COUNT


def test_the_loop_that_is_timed_stage_by_stage_is_the_loop():
    config = SimulationConfig(target="sines", duration=0.3)
    with prepared_loop(config) as loop, prepared_loop(config) as timed:
        loop.run(500)
        nanoseconds = np.zeros((500, len(STAGES)), np.int64)
        arguments = (timed.calls, timed.imu, timed.parameters, timed.state, timed.segments)
        _run_stages(*arguments, np.zeros((3, IMU_COUNT, 3)), np.zeros(2, np.int64), nanoseconds)
        assert loop.state.tobytes() == timed.state.tobytes()
        assert (nanoseconds > 0).all()
