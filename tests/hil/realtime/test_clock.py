"""The clock against a slow twin on scripted times: deadlines, missed periods, and who is to blame."""

import numpy as np
import pytest

from hil.realtime.clock import FREE, SCRIPTED, finish, new_clock, start, wait

PERIOD = 1000


class Twin:
    """Time as a list of deadlines: all that began before the work was done, or lie wholly before the wake-up, are missed."""

    def __init__(self):
        self.next, self.done, self.first = 1, 0, None
        self.missed = {"late": 0, "own": 0, "host": 0}
        self.in_a_row = self.most = self.overrun = 0

    def cycle(self, late, work, cpu):
        """Wake-up, lateness, and periods missed since the last cycle."""
        deadline = self.next * PERIOD
        woke = max(self.done, deadline) + late
        skipped = 0
        while (self.next + 1) * PERIOD <= woke:
            self.next += 1
            skipped += 1
        missed = self.overrun + skipped
        if self.first is None:
            self.first, missed = self.next * PERIOD, 0
        else:
            self.missed["late"] += skipped
            self.in_a_row = self.in_a_row + missed if missed else 0
            self.most = max(self.most, self.in_a_row)
        self.done, self.next, self.overrun = woke + work, self.next + 1, 0
        while self.next * PERIOD < self.done:
            self.next += 1
            self.overrun += 1
        self.missed["own" if min(cpu, work) > PERIOD else "host"] += self.overrun
        return woke, woke - deadline, missed


@pytest.mark.parametrize("seed", range(8))
def test_the_clock_skips_and_blames_as_a_slow_twin(seed):
    random = np.random.default_rng(seed)
    script = np.stack(
        [
            random.choice([0, 1, 999, 1000, 1001, 2500, 7000], 300, p=[0.6, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05]),
            random.choice([100, 999, 1000, 1001, 2000, 3700], 300, p=[0.5, 0.1, 0.1, 0.1, 0.1, 0.1]),
            random.choice([50, 1000, 1001, 3000], 300),
        ],
        axis=1,
    ).astype(np.int64)
    clock, twin = new_clock(SCRIPTED, PERIOD), Twin()
    start(clock)
    assert clock["start"] == clock["deadline"] == PERIOD
    for late, work, cpu in script.tolist():
        missed = wait(clock, script)
        woke, lateness, expected = twin.cycle(late, work, cpu)
        assert (missed, clock["woke"], clock["late"]) == (expected, woke, lateness)
        assert finish(clock, script, 7) == cpu
        assert clock["deadline"] == twin.next * PERIOD and clock["overrun"] == twin.overrun
        assert (clock["start"], clock["in_a_row"], clock["most_in_a_row"]) == (twin.first, twin.in_a_row, twin.most)
        counted = {cause: int(clock[f"missed_{cause}"]) for cause in twin.missed}
        assert counted == twin.missed
    assert clock["cycles"] == 300 and min(twin.missed.values()) > 0


def test_a_free_clock_misses_nothing():
    clock, script = new_clock(FREE, PERIOD), np.zeros((1, 3), np.int64)
    start(clock)
    for n in range(3):
        assert wait(clock, script) == 0
        assert finish(clock, script, 10**9) == 0
        assert clock["cycles"] == n + 1
    assert clock["missed_own"] == clock["missed_host"] == clock["late"] == clock["in_a_row"] == 0
