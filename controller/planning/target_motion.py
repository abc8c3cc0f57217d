"""How a streamed target moves: fitted to its last samples, in the way that has told best where it goes.

A curve through the last samples tells where the target will be, without lag, if the samples are exact. From samples with noise,
or rounded ones, it swings far away; a straight line or a mean over a longer time is better then. So there are several fits, and
each is judged by how far off it was: by the samples against where the fits of a moment before them put the target.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from plant.pose import Array

_FITS = ((2, 0.08), (1, 0.08), (1, 0.25), (0, 0.25))
"""The order of each fit, and the time whose samples it takes [s]; the later ones bear more noise."""

_AS_GOOD, _AS_GOOD_M = 1.2, 1e-5
"""Errors by this factor, and by this length [m], above the least are as good: then the earlier fit is taken."""

_LEAST_SAMPLES = 5
"""A fit takes at least so many samples, however old they are."""

_SLOT_S = 0.004
"""Samples closer than this count as one, their mean [s]."""

_JUDGED_S, _MEMORY_S = 0.04, 0.3
"""A fit is judged by the sample that comes so long after it, and the judgements of so long a time count [s]."""

_CURVED_S = 0.05
"""Time after the last sample for which the target is taken to accelerate as before; then its motion is taken as uniform."""

STILL_M = 1e-9
"""A target that moves no leg by more than this stands still."""


@dataclass(eq=False)
class _Slot:
    """The mean of the samples of a moment."""

    begin: float
    time: float
    lengths: Array
    count: int = 1

    def add(self, time: float, lengths: Array) -> None:
        self.count += 1
        self.time += (time - self.time) / self.count
        self.lengths = self.lengths + (lengths - self.lengths) / self.count


@dataclass(frozen=True, eq=False)
class _Fit:
    """Lengths (m, n) by powers of the time since `time`."""

    time: float
    powers: Array
    velocity: float  # the greatest [m/s]

    def at(self, time: float) -> tuple[Array, Array]:
        """Lengths and rates (n,)."""
        after = time - self.time
        curved = min(after, _CURVED_S)
        place, rate, bend = np.pad(self.powers, ((0, 3 - len(self.powers)), (0, 0)))
        rates = np.clip(rate + 2.0 * curved * bend, -self.velocity, self.velocity)
        return place + curved * (rate + curved * bend) + (after - curved) * rates, rates


class TargetMotion:
    """The motion of a streamed target, by the lengths of n legs.

    Args:
        time: of the first sample [s].
        lengths: (n,) [m], of the first sample.
        velocity: that a leg can have [m/s].
    """

    def __init__(self, time: float, lengths: Array, velocity: float) -> None:
        self.time, self.lengths, self._velocity = time, lengths, velocity
        most = max(_LEAST_SAMPLES, round(max(window for _, window in _FITS) / _SLOT_S) + 1)
        self._slots = deque([_Slot(time, time, lengths)], maxlen=most)
        self._fits: deque[list[_Fit]] = deque()
        self._errors = np.zeros(len(_FITS))  # mean squares [m^2]
        self._judged, self._judged_at = 0, time

    def add(self, time: float, lengths: Array) -> None:
        """Add a sample: its time [s], later than that of the last one, and its lengths (n,) [m]."""
        self.time, self.lengths = time, lengths
        last = self._slots[-1]
        if time - last.begin < _SLOT_S:
            last.add(time, lengths)
            return
        self._judge(last)
        self._slots.append(_Slot(time, time, lengths))

    def at(self, ahead: float) -> tuple[Array, Array]:
        """Lengths and rates (n,) `ahead` [s] of the newest sample; a target that stands still has rates of exactly 0."""
        recent = self._recent(_FITS[0][1])
        if np.ptp([slot.lengths for slot in recent], axis=0).max() < STILL_M:
            return self.lengths, np.zeros_like(self.lengths)
        errors = np.sqrt(self._errors)
        # Before any fit is judged, the calmest is best.
        best = int(np.argmax(errors <= _AS_GOOD * errors.min() + _AS_GOOD_M)) if self._judged else len(_FITS) - 1
        return self._fit(*_FITS[best]).at(self.time + ahead)

    def _recent(self, window: float) -> list[_Slot]:
        newest = self._slots[-1].time
        chosen = [slot for slot in self._slots if slot.time > newest - window]
        return chosen if len(chosen) >= _LEAST_SAMPLES else list(self._slots)[-_LEAST_SAMPLES:]

    def _fit(self, order: int, window: float) -> _Fit:
        chosen = self._recent(window)
        newest, rows = chosen[-1].time, order + 1 if len(chosen) >= 3 else 1
        times, lengths = np.array([slot.time for slot in chosen]), np.array([slot.lengths for slot in chosen])
        return _Fit(newest, np.linalg.pinv(np.vander(times - newest, rows, increasing=True)) @ lengths, self._velocity)

    def _judge(self, slot: _Slot) -> None:
        """Judge the fits of a moment before the newest slot by it, and make those that the next ones judge."""
        while self._fits and slot.time - self._fits[0][0].time >= _JUDGED_S:
            fits = self._fits.popleft()
            off = np.array([np.mean((fit.at(slot.time)[0] - slot.lengths) ** 2) for fit in fits])
            self._judged += 1
            share = -np.expm1(-(slot.time - self._judged_at) / _MEMORY_S)
            self._errors += max(share, 1.0 / self._judged) * (off - self._errors)
            self._judged_at = slot.time
        self._fits.append([self._fit(*each) for each in _FITS])
