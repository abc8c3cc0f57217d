"""The reference that the cycle follows: per actuator, cubic segments in time, evaluated every cycle; and the ways to the start
of a motion and to a stop.

`segments` (6, n, 5) holds rows for each actuator: start time [s], then length [m], rate, acceleration and jerk at the start.
Unused rows start at infinity. The last segment never ends: a motion is planned for at least as long as it runs.
"""

import numpy as np

from plant.compiled import kernel
from plant.mechanism import LEGS
from plant.pose import Array
from plant.vectors import Vector

SEGMENT_SIZE = 5
START, LENGTH, RATE, ACCELERATION, JERK = range(SEGMENT_SIZE)

STOP_SEGMENTS = 4
"""A stop has three phases of constant jerk, and rest."""

APPROACH_SEGMENTS = 4
"""An approach has four phases of constant jerk, equally long."""


@kernel
def state_after(state: Vector, jerk: float, time: float) -> Vector:
    """Length, rate and acceleration after a time [s] of constant jerk."""
    p, v, a = state
    return p + time * (v + time * (a / 2.0 + time * jerk / 6.0)), v + time * (a + time * jerk / 2.0), a + time * jerk


@kernel
def segment_extrema(state: Vector, j: float, t: float) -> Vector:
    """Least and greatest position, and greatest speed, over a cubic segment of jerk j and duration t."""
    p, v, a = state
    end, rate, _ = state_after(state, j, t)
    least, greatest = min(p, end), max(p, end)
    speed = max(abs(v), abs(rate))
    # Positions peak where v + a s + j s^2 / 2 = 0, speeds where a + j s = 0.
    if j == 0.0:
        first = -v / a if a != 0.0 else -1.0
        second = -1.0
    else:
        root = a * a - 2.0 * j * v
        root = np.sqrt(root) if root > 0.0 else np.nan
        first, second = (-a + root) / j, (-a - root) / j
        s = -a / j
        if 0.0 < s < t:
            speed = max(speed, abs(state_after(state, j, s)[1]))
    for s in (first, second):
        if 0.0 < s < t:
            at = state_after(state, j, s)[0]
            least, greatest = min(least, at), max(greatest, at)
    return least, greatest, speed


@kernel
def write_segment(segment: Array, start: float, state: Vector, jerk: float) -> None:
    """Write a row of the segments."""
    segment[START], segment[JERK] = start, jerk
    segment[LENGTH], segment[RATE], segment[ACCELERATION] = state


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
        state = segment[LENGTH], segment[RATE], segment[ACCELERATION]
        reference[k, 0], reference[k, 1], reference[k, 2] = state_after(state, segment[JERK], time - segment[START])


@kernel
def lengths_along(segments: Array, times: Array, lengths: Array) -> None:
    """Write the lengths (N, n) of n actuators at increasing times (N,) [s]."""
    for k in range(lengths.shape[1]):
        i = 0
        for row in range(times.shape[0]):
            while i + 1 < segments.shape[1] and segments[k, i + 1, START] <= times[row]:
                i += 1
            segment = segments[k, i]
            state = segment[LENGTH], segment[RATE], segment[ACCELERATION]
            lengths[row, k] = state_after(state, segment[JERK], times[row] - segment[START])[0]


Phase = tuple[float, float]
"""A jerk [m/s^3] and its duration [s]."""


@kernel
def stop_phases(rate: float, acceleration: float, most_acceleration: float, most_jerk: float) -> tuple[Phase, Phase, Phase]:
    """The fastest way to rest within the limits of acceleration and jerk: a jerk, none, and the opposite one."""
    sign = 1.0 if rate + acceleration * abs(acceleration) / (2.0 * most_jerk) >= 0.0 else -1.0
    # In the direction in which the actuator would go on: jerk down to -peak, stay there, jerk back up.
    v, a = sign * rate, sign * acceleration
    peak = np.sqrt(max(most_jerk * v + a * a / 2.0, 0.0))
    stay = 0.0
    if peak > most_acceleration:
        peak = most_acceleration
        stay = max((v + a * a / (2.0 * most_jerk) - peak * peak / most_jerk) / peak, 0.0)
    jerk = -sign * most_jerk
    return (jerk, max((a + peak) / most_jerk, 0.0)), (0.0, stay), (-jerk, peak / most_jerk)


@kernel
def plan_stop(reference: Array, most_acceleration: float, most_jerk: float, segments: Array) -> float:
    """Write the fastest stop of every actuator (6, 4, 5) from a reference (6, 3) at time 0; returns its duration [s]."""
    longest = 0.0
    for k in range(LEGS):
        state = reference[k, 0], reference[k, 1], reference[k, 2]
        at = 0.0
        for i, (j, t) in enumerate(stop_phases(state[1], state[2], most_acceleration, most_jerk)):
            write_segment(segments[k, i], at, state, j)
            state = state_after(state, j, t)
            at += t
        write_segment(segments[k, 3], at, (state[0], 0.0, 0.0), 0.0)
        longest = max(longest, at)
    return longest


@kernel
def approach_duration(distance: float, most_rate: float, most_acceleration: float, most_jerk: float) -> float:
    """How long an approach over a distance [m] takes within the limits [s].

    In a time T with four phases of the jerks j, -j, -j, j, an actuator moves by j T^3 / 32 from rest to rest, at most at a rate
    of j T^2 / 16 and an acceleration of j T / 4.
    """
    by_rate, by_acceleration = 2.0 * distance / most_rate, np.sqrt(8.0 * distance / most_acceleration)
    return float(max(by_rate, by_acceleration, (32.0 * distance / most_jerk) ** (1.0 / 3.0)))


@kernel
def plan_approach(lengths: Array, reference: Array, duration: float, segments: Array) -> None:
    """Write the way (6, 4, 5) of every actuator from rest at its length (6,) to rest at the reference (6, 3), where all arrive
    together after a duration [s].
    """
    phase = duration / APPROACH_SEGMENTS
    for k in range(LEGS):
        jerk = 32.0 * (reference[k, 0] - lengths[k]) / duration**3
        state = lengths[k], 0.0, 0.0
        for i in range(APPROACH_SEGMENTS):
            j = jerk if i in (0, 3) else -jerk
            write_segment(segments[k, i], i * phase, state, j)
            state = state_after(state, j, phase)
