"""Fixtures that all rooms share."""

import gc
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from zlib import crc32

import pytest
from hypothesis import settings

from plant.fmu.build import default_fmu
from plant.mechanism import Mechanism, load_mechanism
from tests.plant.fmu.foreign import build_foreign, build_foreign_3

# The first example of a property may compile kernels, so there is no deadline; and the same examples come every time.
# `make test` takes fewer of them than the slow and the weekly tests, which say `--hypothesis-profile=all`.
settings.register_profile("few", deadline=None, derandomize=True, max_examples=20)
settings.register_profile("all", deadline=None, derandomize=True)
settings.load_profile("few")

# For `--hypothesis-profile=thorough`: tests that follow the profile's number of examples take their time.
settings.register_profile("thorough", max_examples=10_000, deadline=None)

# A session in the background ignores these, and so would the processes of its tests.
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGQUIT, signal.SIG_DFL)
signal.signal(signal.SIGHUP, signal.SIG_DFL)


def _part(text: str) -> tuple[int, int]:
    part, parts = map(int, text.split("/"))
    if not 1 <= part <= parts:
        raise ValueError
    return part, parts


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--part", type=_part, metavar="K/N", default=(1, 1), help="run part K of N of the tests, by their names")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests of other parts. Modules with tests that are marked `slow(seconds=...)` come first, the longest first,
    so that no long one begins last.
    """
    part, parts = config.getoption("part")
    chosen = [crc32(item.nodeid.encode()) % parts == part - 1 for item in items]
    config.hook.pytest_deselected(items=[item for item, mine in zip(items, chosen, strict=True) if not mine])
    items[:] = [item for item, mine in zip(items, chosen, strict=True) if mine]
    longest: dict[Path, float] = {}
    for item in items:
        seconds = max((mark.kwargs.get("seconds", 0.0) for mark in item.iter_markers("slow")), default=0.0)
        longest[item.path] = max(longest.get(item.path, 0.0), seconds)
    items.sort(key=lambda item: -longest[item.path])


def pytest_collection_finish() -> None:
    """What stays to the end, thousands of tests among it, need not be looked through at each collection of garbage."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _leaves_the_machine_to_others() -> Iterator[None]:
    """A test that kept a real-time priority or a processor would hold up all tests after it, on the other workers too."""
    allowed = os.sched_getaffinity(0)
    yield
    assert os.sched_getscheduler(0) == os.SCHED_OTHER and os.sched_getaffinity(0) == allowed


SHARED_DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def hexapod() -> Mechanism:
    return load_mechanism("hexapod")


@pytest.fixture(scope="session")
def fmu_path() -> Path:
    return default_fmu()


@pytest.fixture(scope="session")
def foreign_fmu(hexapod: Mechanism, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An FMU of FMI 2.0 that shares nothing with gough's own (`tests/plant/foreign.c`)."""
    return build_foreign(tmp_path_factory.mktemp("foreign"), hexapod)


@pytest.fixture(scope="session")
def foreign_fmu_3(hexapod: Mechanism, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same hexapod in FMI 3.0, with other names and units (`tests/plant/foreign3.c`)."""
    return build_foreign_3(tmp_path_factory.mktemp("foreign3"), hexapod)


@pytest.fixture(scope="session")
def motion_capture() -> Path:
    """A real motion, which lies beside the project and is not part of it."""
    path = SHARED_DATA / "targets" / "motion_capture.csv"
    if not path.exists():
        pytest.skip("the motion capture data is not here")
    return path
