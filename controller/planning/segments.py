"""The reference that the cycle follows: per actuator, cubic segments in time, evaluated every cycle; and the way to stop.

`segments` (6, n, 5) holds for each actuator rows of start time [s], length [m], rate, acceleration and jerk at the start;
unused rows start at infinity. The last segment goes on for ever: a motion is planned for at least as long as it runs.
"""

import numpy as np

from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array

START, LENGTH, RATE, ACCELERATION, JERK = range(5)

STOP_SEGMENTS = 4
"""A stop has three phases of constant jerk, and rest."""


@kernel
def evaluate_reference(segments: Array, time: float, index: Array, reference: Array) -> None:
    """Write length, rate and acceleration (6, 3) of each actuator at `time` [s].

    `index` (6,) remembers the segment of each actuator; time must not run backwards between calls.
    """
    for k in range(LEGS):
        i = index[k]
        while i + 1 < segments.shape[1] and segments[k, i + 1, START] <= time:
            i += 1
        index[k] = i
        segment = segments[k, i]
        t = time - segment[START]
        reference[k, 0] = segment[LENGTH] + t * (segment[RATE] + t * (segment[ACCELERATION] / 2.0 + t * segment[JERK] / 6.0))
        reference[k, 1] = segment[RATE] + t * (segment[ACCELERATION] + t * segment[JERK] / 2.0)
        reference[k, 2] = segment[ACCELERATION] + t * segment[JERK]


@kernel
def stop_phases(
    rate: float, acceleration: float, most_acceleration: float, most_jerk: float
) -> tuple[float, float, float, float]:
    """The fastest way to rest at the limits of acceleration and jerk: a jerk, and for how long it, none, and its opposite."""
    sign = 1.0 if rate + acceleration * abs(acceleration) / (2.0 * most_jerk) >= 0.0 else -1.0
    # Seen in the direction in which the actuator would go on: jerk down to -peak, stay there, jerk back up.
    v, a = sign * rate, sign * acceleration
    peak = np.sqrt(max(most_jerk * v + a * a / 2.0, 0.0))
    stay = 0.0
    if peak > most_acceleration:
        peak = most_acceleration
        stay = max((v + a * a / (2.0 * most_jerk) - peak * peak / most_jerk) / peak, 0.0)
    return -sign * most_jerk, max((a + peak) / most_jerk, 0.0), stay, peak / most_jerk


@kernel
def plan_stop(reference: Array, most_acceleration: float, most_jerk: float, segments: Array) -> float:
    """Write the fastest stop of every actuator (6, 4, 5) from a reference (6, 3) at time 0; returns its duration [s]."""
    longest = 0.0
    for k in range(LEGS):
        p, v, a = reference[k, 0], reference[k, 1], reference[k, 2]
        jerk, down, stay, up = stop_phases(v, a, most_acceleration, most_jerk)
        at = 0.0
        for i, (j, t) in enumerate(((jerk, down), (0.0, stay), (-jerk, up))):
            segment = segments[k, i]
            segment[START], segment[LENGTH], segment[RATE], segment[ACCELERATION], segment[JERK] = at, p, v, a, j
            p += t * (v + t * (a / 2.0 + t * j / 6.0))
            v += t * (a + t * j / 2.0)
            a += t * j
            at += t
        rest = segments[k, 3]
        rest[START], rest[LENGTH], rest[RATE], rest[ACCELERATION], rest[JERK] = at, p, 0.0, 0.0, 0.0
        longest = max(longest, at)
    return longest
