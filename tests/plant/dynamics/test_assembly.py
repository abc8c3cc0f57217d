"""The short equations of the ideal case against the whole ones."""

import numpy as np
import pytest
from numpy.random import Generator

from plant.dynamics.variables import SPATIAL, Variable
from plant.fmu.build import PLANAR_MODEL, SPATIAL_MODEL, Model
from plant.mechanism import load_in_space
from plant.pose import Array


def random_values(variables: tuple[Variable, ...], random: Generator) -> Array:
    """Small values, and zero for disturbances."""
    values = [
        np.zeros(each.size) if each.disturbance else random.integers(0, 3, each.size) if each.discrete else
        random.normal(0.0, 0.05, each.size) for each in variables
    ]  # fmt: skip
    return np.concatenate(values).astype(float)


@pytest.mark.parametrize("model", [SPATIAL_MODEL, PLANAR_MODEL], ids=lambda model: model.preset)
def test_without_disturbances_the_short_equations_are_the_whole_ones_to_the_bit(model: Model) -> None:
    dynamics, table, random = model.dynamics(), model.table, np.random.default_rng(0)
    parameters = load_in_space(model.preset).plant_parameters()
    flat = np.concatenate([np.ravel(parameters[each.name]) for each in table.parameters])
    constants, start = dynamics.constants(flat), np.array(dynamics.start(flat)).ravel()
    for _ in range(50):
        x, u = start + random_values(table.states, random), random_values(table.inputs, random)
        np.testing.assert_array_equal(dynamics.ideal_rates(x, u, constants), dynamics.rates(x, u, constants))
        np.testing.assert_array_equal(dynamics.ideal_outputs(x, u, constants), dynamics.outputs(x, u, constants))
        for ideal, whole in zip(dynamics.ideal_limits(x, constants), dynamics.limits(x, constants), strict=True):
            np.testing.assert_array_equal(ideal, whole)


def test_the_short_equations_are_short() -> None:
    """The base's motion, bending, play and offsets, which are zero there, take no time."""
    dynamics = SPATIAL_MODEL.dynamics()
    assert dynamics.ideal_rates.n_instructions() < 0.4 * dynamics.rates.n_instructions()
    idle = sum(each.size for each in SPATIAL.states if each.disturbance)
    sizes = (dynamics.ideal_rates.size1_in(i) for i in range(3))
    zeros = np.array(dynamics.ideal_rates(*map(np.ones, sizes))).ravel()[-idle:]
    assert not zeros.any()
