"""Fixtures of the plant's tests."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from pathlib import Path

import pytest
from numpy.typing import ArrayLike

from plant.dynamics.variables import checked_parameters
from plant.fmu.plant import FmuPlant
from plant.mechanism import Mechanism

MakePlant = Callable[..., FmuPlant]


@pytest.fixture
def make_plant(hexapod: Mechanism, fmu_path: Path) -> Iterator[MakePlant]:
    """A function that starts the real FMU as the hexapod with some parameters changed; all are closed at the end."""
    with ExitStack() as stack:

        def make(changes: Mapping[str, ArrayLike] | None = None, period: float = 1e-3) -> FmuPlant:
            parameters = hexapod.plant_parameters() | checked_parameters(changes or {})
            return stack.enter_context(FmuPlant(fmu_path, parameters, period))

        yield make
