"""A stand-in for the module `time`, so that tests of a rig's timing do not depend on how busy the machine is."""

import pytest

from hil.rigs import contract, template

LOOK_NS = 1_000


class VirtualTime:
    """Time passes when someone sleeps, and by a microsecond with each look at the clock."""

    def __init__(self) -> None:
        self.now_ns = 1_000_000_000

    def monotonic_ns(self) -> int:
        self.now_ns += LOOK_NS
        return self.now_ns

    def monotonic(self) -> float:
        return 1e-9 * self.monotonic_ns()

    def perf_counter_ns(self) -> int:
        return self.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(1e9 * seconds)


@pytest.fixture
def virtual_time(monkeypatch: pytest.MonkeyPatch) -> VirtualTime:
    """The clock of the examiner and of the template rig."""
    clock = VirtualTime()
    for module in (contract, template):
        monkeypatch.setattr(module, "time", clock)
    return clock
