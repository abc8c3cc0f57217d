"""What the loop notes of an exchange with the rig."""

import numpy as np
import pytest

from controller.cycle import STATE, cycle_parameters, skip_periods
from controller.safety.causes import Cause
from controller.settings import control_settings, fusion_settings
from hil.loop.compiled_loop import process_feedback
from hil.loop.records import WORK
from hil.rigs import ANSWERED, SILENT, new_feedback


@pytest.mark.parametrize("seed", range(3))
def test_samples_and_silence_age_by_the_periods_that_pass_missed_ones_too(hexapod, seed):
    """Against the times of the last new sample and of the last answer."""
    random = np.random.default_rng(seed)
    parameters = cycle_parameters(hexapod, 500.0, control_settings(hexapod), fusion_settings(hexapod))
    state, work = np.zeros((), STATE), np.zeros((), WORK)
    work["feedback"], work["sequence"] = new_feedback(), -1
    renewed, answered = np.zeros(7, np.int64), 0
    for cycle in range(200):
        missed = int(random.choice([0, 0, 1, 7])) if cycle else 0
        skip_periods(state, missed)
        now = int(state["time"]["cycle"])
        new = (random.random(7) < 0.3) | (cycle == 0)
        status = ANSWERED if random.random() < 0.7 or cycle == 0 else SILENT
        work["feedback"]["sequence"] += new
        renewed[new], answered = now, now if status == ANSWERED else answered
        assert process_feedback(parameters, state, work, status) == Cause.NONE
        np.testing.assert_array_equal(work["sample_age"], now - renewed)
        np.testing.assert_array_equal(state["imus"]["sample_age"], now - renewed)
        assert work["silent"] == state["safety"]["watch"]["silent"] == now - answered
        state["time"]["cycle"] += 1
