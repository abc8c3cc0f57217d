"""From the ideal signals of a plant to the raw data of its IMUs, cycle by cycle.

The raw reading inverts the paper's (37), `a_cal = T S (a_u + b)`: with the mounting misalignment M,
`a_u = S^-1 T^-1 M a - b + noise`. A low-pass, a delay, range, resolution and dropouts follow. Each section of the low-pass is
exact for signals that are linear between conversions. An IMU converts once a cycle, or several times (its oversampling), or on
a clock of its own, of which the loop reads the latest sample. It may spare the conversions between samples while nothing shakes
it. Between cycles the ideal signals are linear, and disturbances as they are. All noise is keyed by (seed, IMU, conversion), so
every cycle can be reproduced on its own.
"""

import re
from collections.abc import Iterable
from math import inf, sqrt

import numpy as np

from plant.checks import checked_seed
from plant.compiled import MOST, Limits, Record, kernel, record_dtype, shared_kernel
from plant.errors import InputError
from plant.imu.aliasing import sampled_noise
from plant.imu.disturbed import DISTURBANCE, EFFECT, MOST_DISTURBANCES, clock_of, disturb, disturbance_record, shakes
from plant.imu.model import MOST_CONVERSIONS, MOST_SECTIONS, ImuModel, SensorErrors
from plant.imu.random_numbers import draw_normals
from plant.imu_disturbances import Disturbance
from plant.imu_wiring import BASE_IMU, IMU_COUNT, RIGHT_AXES, RIGHT_WIRING, SLOTS, Wiring
from plant.pose import Array, rotation_from_vector

GYROSCOPE, ACCELEROMETER, MAGNETOMETER = 0, 1, 2
"""First index of a measurement (3, 7, 3) [rad/s, m/s^2, uT]: sensor, IMU, axis."""

_LONGEST_DELAY = 32
_AT_ONCE = 1e-6
"""The share of its step by which a conversion may come after a cycle and count as its own, as rounding shifts both."""
_SLOWEST = 1e-3
"""The slowest clock over its nominal rate; several disturbances may add up to less."""


def axes_matrix(axes: str) -> Array:
    """The matrix (3, 3) of axes such as "+y-x+z", with 0 for an axis that reads nothing."""
    units = dict(zip(("+x", "+y", "+z", "-x", "-y", "-z", "0"), (*np.eye(3), *-np.eye(3), np.zeros(3)), strict=True))
    return np.array([units[axis] for axis in re.findall("[+-].|0", axes)])


IMU_STATE = record_dtype(
    gain=(np.float64, (3, SLOTS, 3, 3)),
    offset=(np.float64, (3, SLOTS, 3)),
    bias_per_kelvin=(np.float64, (3, SLOTS, 3)),
    scale_per_kelvin=(np.float64, (3, SLOTS, 3)),
    bias_per_volt=(np.float64, (3, SLOTS, 3)),
    rectification=(np.float64, 3),
    count=np.int64,  # how many IMUs there are
    place=(np.int64, SLOTS),
    noise=(np.float64, (2, 3)),  # this and `smoothing` of conversions, and of samples where those between them are spared
    drift=(np.float64, 2),
    smoothing=(np.float64, (2, 3, 2)),
    order=(np.int64, 3),
    reach=(np.float64, 3),
    resolution=(np.float64, 3),
    dropout=np.float64,
    delay=np.int64,
    magnetometer_every=np.int64,
    period=np.float64,  # of the cycles [s]
    rate=(np.float64, SLOTS),  # of the samples on a clock of its own [Hz]; 0: once a cycle
    conversions=np.int64,  # of a sample
    sparing=np.int64,  # whether those between samples are spared while nothing shakes the IMU
    spared=np.int64,  # whether they are at present
    jitter=np.float64,  # [s]
    timed=np.int64,  # whether any IMU converts at other times than the cycles'
    disturbance=(DISTURBANCE, MOST_DISTURBANCES),
    lasting=np.int64,  # the number of disturbances that belong to the IMUs or the run
    disturbances=np.int64,  # with those that a rig adds
    seed=np.uint64,
    cycle=np.int64,
    time=np.float64,  # of the cycle [s]; a caller may set it before each
    before=np.float64,  # time of the cycle before [s]
    kept=np.int64,  # whether `previous` has its signals
    base=(np.float64, (3, 3)),  # ideal signals of the IMU on the base, which a caller sets before each cycle
    previous=(np.float64, (3, SLOTS, 3)),
    converted_at=(np.float64, SLOTS),  # time of the last conversion on the IMU's clock, without jitter [s]
    part=(np.int64, SLOTS),  # conversions of the present sample
    conversion=(np.int64, SLOTS),  # number of the next conversion on a clock of its own
    sample=(np.int64, SLOTS),  # number of the next sample on it
    fresh=(np.int64, SLOTS),  # samples since the cycle before
    sampled_at=(np.float64, SLOTS),  # time of the latest sample [s]
    bias_walk=(np.float64, (2, SLOTS, 3)),
    sections=(np.float64, (MOST_SECTIONS + 1, 3, SLOTS, 3)),  # of the low-pass: its input, and the output of each
    queue=(np.float64, (_LONGEST_DELAY + 1, 3, SLOTS, 3)),
    reading=(np.float64, (3, SLOTS, 3)),
    normals=(np.float64, 6),
    sensed=(np.float64, 3),  # scratch, as the rest
    effect=EFFECT,
)
"""Constants and state of the imperfections of seven IMUs, and of one on the base; a copy is a snapshot."""

IMU_LIMITS: Limits = {
    "count": (IMU_COUNT, SLOTS),
    "place": (0, BASE_IMU),
    "order": (1, MOST_SECTIONS),
    "delay": (0, _LONGEST_DELAY),
    "magnetometer_every": (1, MOST),
    "conversions": (1, MOST_CONVERSIONS),
    "sparing": (0, 1),
    "spared": (0, 1),
    "disturbance.sensor": (-1, 2),
    "lasting": (0, MOST_DISTURBANCES),
    "disturbances": (0, MOST_DISTURBANCES),
    "cycle": (0, MOST),
    "sample": (0, MOST),
}
"""Least and greatest of what counts, indexes or divides in them."""


def imu_state(
    model: ImuModel, seed: int, period: float, wiring: Wiring = RIGHT_WIRING, on_base: bool = False
) -> Record:  # fmt: skip
    """Draw the constant errors of seven IMUs, and of one `on_base`, for cycles of `period` [s].

    Raises:
        InputError: a negative seed, or a delay longer than 32 samples.
    """
    checked_seed(seed)
    state: Record = np.zeros((), IMU_STATE)
    random, life = np.random.default_rng([seed, IMU_COUNT]), np.random.default_rng([seed, IMU_COUNT, 1])
    # The errors of an IMU on the base leave those of the others as they are.
    eighth = np.random.default_rng([seed, IMU_COUNT, 2])

    def drawn(k: int) -> np.random.Generator:
        return eighth if k == BASE_IMU else random

    alignments = [
        rotation_from_vector(drawn(k).uniform(-model.misalignment, model.misalignment, 3)) for k in range(SLOTS)
    ]  # fmt: skip
    sampling = 1.0 / model.sample_rate if model.sample_rate else period
    conversions = min(max(1, round(model.conversion_rate * sampling)), MOST_CONVERSIONS)
    every = max(1, round(1.0 / (model.magnetometer_rate * sampling)))
    for kind, sensor in enumerate((model.gyroscope, model.accelerometer, model.magnetometer)):
        samples = every * sampling if kind == MAGNETOMETER else sampling
        periods = samples if kind == MAGNETOMETER else sampling / conversions, samples
        axes = (*(wiring.gyroscopes, wiring.accelerometers, RIGHT_WIRING.gyroscopes)[kind], RIGHT_AXES)
        changes = _changes(sensor, life, eighth)
        for imu in range(SLOTS):
            gain, offset = _constant_errors(sensor, drawn(imu))
            read = axes_matrix(axes[imu])
            state["gain"][kind, imu] = read @ (gain @ alignments[imu])
            state["offset"][kind, imu] = read @ offset
            for name, change in changes.items():
                # A change of scale has no direction: what counts is the axis of the sensor that is read.
                state[name][kind, imu] = (np.abs(read) if name.startswith("scale") else read) @ change[imu]
        state["rectification"][kind] = sensor.rectification
        for spared, converting in enumerate(periods):
            density = sampled_noise(model, sensor, 1.0 / sampling) if spared and kind != MAGNETOMETER else sensor.noise
            # Without a low-pass, faster conversions than samples are not taken in.
            state["noise"][spared, kind] = density * sqrt(0.5 / (samples if sensor.bandwidth == inf else converting))
            state["smoothing"][spared, kind] = sensor.smoothing(converting)
        state["order"][kind] = sensor.order
        state["reach"][kind] = sensor.reach
        state["resolution"][kind] = sensor.resolution
        if kind != MAGNETOMETER:
            state["drift"][kind] = sensor.drift * sqrt(period)
    delay = round(model.delay / sampling)
    if delay > _LONGEST_DELAY:
        raise InputError(f"the delay of the IMUs is {delay} cycles; at most {_LONGEST_DELAY} are kept")
    for imus, clocks in ((slice(IMU_COUNT), life), (slice(IMU_COUNT, SLOTS), eighth)):
        count = len(range(SLOTS)[imus])
        state["rate"][imus] = model.sample_rate * (1.0 + clocks.uniform(-model.clock_error, model.clock_error, count))
        state["converted_at"][imus] = clocks.random(count) * sampling - sampling / conversions
    state["jitter"], state["conversions"], state["period"] = model.jitter, conversions, period
    state["sparing"] = model.sparing and conversions > 1
    state["timed"] = bool(model.sample_rate or model.jitter or (conversions > 1 and not model.sparing))
    state["count"], state["place"] = SLOTS if on_base else IMU_COUNT, (*wiring.places, BASE_IMU)
    state["delay"] = delay
    state["magnetometer_every"] = every
    state["dropout"] = model.dropout
    state["seed"] = seed
    add_disturbances(state, model.disturbances)
    return state


def add_disturbances(state: Record, disturbances: Iterable[Disturbance]) -> None:
    """Disturb the IMUs as long as they are (dtype `IMU_STATE`); times count from their first cycle.

    Raises:
        InputError: there are too many.
    """
    for each in disturbances:
        count = int(state["lasting"])
        if count == MOST_DISTURBANCES:
            raise InputError(f"there are more than {count} disturbances of IMUs, the most that are possible: leave some out")
        state["disturbance"][count] = disturbance_record(each)
        state["lasting"] = state["disturbances"] = count + 1


def _constant_errors(sensor: SensorErrors, random: np.random.Generator) -> tuple[Array, Array]:
    """The gain (3, 3), S^-1 T^-1, and the offset (3,), -b, of (37)."""
    scale = np.diag(1.0 + random.uniform(-sensor.scale, sensor.scale, 3))
    axes = np.eye(3) + np.triu(random.uniform(-sensor.cross_axis, sensor.cross_axis, (3, 3)), 1)
    direction = random.normal(size=3)
    return np.linalg.inv(axes @ scale), -random.uniform(*sensor.bias) * direction / np.linalg.norm(direction)


def _changes(sensor: SensorErrors, random: np.random.Generator, eighth: np.random.Generator) -> dict[str, Array]:
    """What a sensor's bias and scale do per kelvin and per volt, common parts included: (8, 3) each, by the state's field.

    `eighth` draws what is the own of the IMU on the base.
    """
    made: dict[str, Array] = {}
    for name in ("bias_per_kelvin", "bias_per_volt"):
        common, own = getattr(sensor, name)
        directions = np.concatenate([random.normal(size=(1 + IMU_COUNT, 3)), eighth.normal(size=(1, 3))])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sizes = np.concatenate([random.uniform(0.0, own, (IMU_COUNT, 1)), eighth.uniform(0.0, own, (1, 1))])
        made[name] = common * directions[0] + sizes * directions[1:]
    common, own = sensor.scale_per_kelvin
    shared = random.uniform(-common, common, 3)
    made["scale_per_kelvin"] = shared + np.concatenate(
        [random.uniform(-own, own, (IMU_COUNT, 3)), eighth.uniform(-own, own, (1, 3))]
    )  # fmt: skip
    return made


_MEASURE, _MAGNETIC, _WALK, _TIMES, _DISTURBED = range(5)
"""Purposes of random numbers; a sensor's number is added to the last."""


@shared_kernel
def measure(state: Record, ideal: Array, measurement: Array) -> None:
    """Write the IMUs' raw readings (3, 7, 3) of ideal signals (3, 7, 3), and advance `state` by one cycle.

    The ideal signals of an IMU on the base are those in `state`, and so is its reading.
    """
    s = state[()]
    # Otherwise the signals of this cycle are all that counts.
    timed = s.timed != 0 or s.disturbances > 0
    walking = s.drift[GYROSCOPE] > 0.0 or s.drift[ACCELEROMETER] > 0.0
    for imu in range(s.count):
        s.fresh[imu] = 0
        if walking:
            draw_normals(s.normals, s.cycle, imu, _WALK, s.seed)
            for axis in range(3):
                s.bias_walk[GYROSCOPE, imu, axis] += s.drift[GYROSCOPE] * s.normals[axis]
                s.bias_walk[ACCELEROMETER, imu, axis] += s.drift[ACCELEROMETER] * s.normals[3 + axis]
        if timed and s.cycle > 0:
            _convert_when_due(s, imu, ideal)
        else:
            s.spared = s.sparing
            _convert_at(s, imu, ideal, s.time, s.cycle, True, s.cycle)
            s.conversion[imu] = s.sample[imu] = s.cycle + 1
            if s.rate[imu] == 0.0:
                s.converted_at[imu] = s.time
    if timed:
        for kind in range(3):
            for axis in range(3):
                for imu in range(IMU_COUNT):
                    s.previous[kind, imu, axis] = ideal[kind, imu, axis]
                s.previous[kind, BASE_IMU, axis] = s.base[kind, axis]
    s.kept = 1 if timed else 0
    s.before = s.time
    s.time += s.period
    s.cycle += 1
    for kind in range(3):
        for imu in range(IMU_COUNT):
            for axis in range(3):
                measurement[kind, imu, axis] = s.reading[kind, imu, axis]


@kernel
def _convert_when_due(s: Record, imu: int, ideal: Array) -> None:
    """Make an IMU's conversions and samples since the cycle before."""
    own, faster, jitter = clock_of(s.disturbance, s.disturbances, imu, s.time)
    own, jitter, rate = own or s.rate[imu] > 0.0, jitter + s.jitter, s.rate[imu]
    s.spared = 1 if s.sparing != 0 and not shakes(s.disturbance, s.disturbances, imu, s.before, s.time) else 0
    conversions = 1 if s.spared != 0 else s.conversions
    if own:
        step = 1.0 / ((rate if rate > 0.0 else 1.0 / s.period) * max(1.0 + faster, _SLOWEST) * conversions)
    else:
        # The loop begins each sample, which is complete at the time of the cycle.
        step = (s.time - s.before) / conversions
        s.converted_at[imu], s.part[imu] = s.before, 0
    for _ in range(MOST_CONVERSIONS):
        complete = s.part[imu] + 1 >= conversions
        due = s.converted_at[imu] + step
        if own and due > s.time + _AT_ONCE * step:
            return
        if not own and complete:
            due = s.time
        conversion = s.conversion[imu] if own else s.cycle * conversions + s.part[imu]
        early = 0.0
        if jitter > 0.0:
            draw_normals(s.normals, conversion, imu, _TIMES, s.seed)
            early = min(jitter * abs(s.normals[0]), 0.9 * step)
        sample = s.sample[imu] if own else s.cycle
        _convert_at(s, imu, ideal, min(due, s.time) - early, conversion, complete, sample)
        s.converted_at[imu] = due
        s.conversion[imu] = conversion + 1
        s.part[imu] += 1
        if complete:
            s.part[imu], s.sample[imu] = 0, sample + 1
            if not own:
                return
    s.converted_at[imu] = s.time


@kernel
def _convert_at(s: Record, imu: int, ideal: Array, time: float, conversion: int, complete: bool, sample: int) -> None:
    """Convert the signals at a time, which may lie between the cycle before and this one; the last of a sample completes it."""
    e, place, span = s.effect, s.place[imu], s.time - s.before
    if time < s.before < s.time:
        time = s.before
    weight = (time - s.before) / span if s.kept != 0 and time < s.time and span > 0.0 else 1.0
    for kind in range(3):
        for axis in range(3):
            now = s.base[kind, axis] if place == BASE_IMU else ideal[kind, place, axis]
            if weight < 1.0:
                now = s.previous[kind, place, axis] + weight * (now - s.previous[kind, place, axis])
            e.signal[kind, axis] = now
    if s.disturbances > 0:
        disturb(s.disturbance, s.disturbances, imu, time, e)
    dropped = _filter(s, imu, conversion, complete and sample % s.magnetometer_every == 0)
    if complete:
        _take_sample(s, imu, sample, dropped)
        s.fresh[imu] += 1
        s.sampled_at[imu] = time


@kernel
def _filter(s: Record, imu: int, conversion: int, with_field: bool) -> bool:
    """Pass a conversion, and the magnetometer's with `with_field`, through the low-passes; returns whether it drops out."""
    e, normals, first, dropped = s.effect, s.normals, s.cycle == 0, False
    noise = s.noise[s.spared]
    if noise[GYROSCOPE] > 0.0 or noise[ACCELEROMETER] > 0.0 or s.dropout > 0.0:
        dropped = draw_normals(normals, conversion, imu, _MEASURE, s.seed) < s.dropout and not first
    else:
        normals[:] = 0.0
    for kind in range(3):
        magnetic = kind == MAGNETOMETER
        if magnetic and not with_field:
            break
        if magnetic and noise[kind] > 0.0:
            draw_normals(normals, conversion, imu, _MAGNETIC, s.seed)
        gain, signal, sensed = s.gain[kind, imu], e.signal[kind], s.sensed
        x, y, z = signal[0], signal[1], signal[2]
        for axis in range(3):
            sensed[axis] = gain[axis, 0] * x + gain[axis, 1] * y + gain[axis, 2] * z
        if s.rectification[kind] != 0.0:
            for axis in range(3):
                sensed[axis] += s.rectification[kind] * sensed[axis] * sensed[axis]
        if s.disturbances > 0:
            for axis in range(3):
                sensed[axis] += (e.scale[kind, axis] + e.warmer * s.scale_per_kelvin[kind, imu, axis]) * sensed[axis]
                sensed[axis] += e.added[kind, axis]
                sensed[axis] += e.warmer * s.bias_per_kelvin[kind, imu, axis] + e.supply * s.bias_per_volt[kind, imu, axis]
            if e.noisy != 0:
                draw_normals(e.normals, conversion, imu, _DISTURBED + kind, s.seed)
                for axis in range(3):
                    sensed[axis] += e.noise[kind, axis] * e.normals[axis]
        first_normal = 0 if magnetic else 3 * kind
        for axis in range(3):
            walk = 0.0 if magnetic else s.bias_walk[kind, imu, axis]
            sensed[axis] = s.offset[kind, imu, axis] + sensed[axis] + (walk + noise[kind] * normals[first_normal + axis])
        if s.conversions > 1:
            reach = _reach(s, kind)
            for axis in range(3):
                sensed[axis] = min(max(sensed[axis], -reach), reach)
        _smooth(s, kind, imu, first)
    return dropped


@kernel
def _reach(s: Record, kind: int) -> float:
    """The largest reading of a sensor."""
    return float(min(s.reach[kind], s.effect.reach[kind]) if s.disturbances > 0 else s.reach[kind])


@kernel
def _smooth(s: Record, kind: int, imu: int, first: bool) -> None:
    """Pass what is sensed through the sections of a low-pass, which begins settled."""
    smoothing = s.smoothing[s.spared, kind]
    before, share = smoothing[0], smoothing[1]
    passes = first or share == 1.0
    entered = s.sections[0, kind, imu]
    for k in range(1, s.order[kind] + 1):
        left = s.sections[k, kind, imu]
        for axis in range(3):
            was, value, now = entered[axis], s.sensed[axis], left[axis]
            smoothed = value if passes else now + (before * (was - now) + share * (value - now))
            entered[axis] = value
            s.sensed[axis] = smoothed
        entered = left
    for axis in range(3):
        entered[axis] = s.sensed[axis]


@kernel
def _take_sample(s: Record, imu: int, sample: int, dropped: bool) -> None:
    """Pass what has left the low-passes on to the readings: late, within the range, in steps; an axis may be stuck."""
    first, disturbed = s.cycle == 0, s.disturbances > 0
    slot = sample % (s.delay + 1)
    for kind in range(3):
        filtered, reach, resolution = s.sections[s.order[kind], kind, imu], _reach(s, kind), s.resolution[kind]
        for axis in range(3):
            delayed = filtered[axis]
            if s.delay > 0:
                if first:
                    s.queue[:, kind, imu, axis] = delayed
                s.queue[slot, kind, imu, axis] = delayed
                delayed = s.queue[(slot + 1) % (s.delay + 1), kind, imu, axis]
            delayed = min(max(delayed, -reach), reach)
            if resolution > 0.0:
                delayed = np.rint(delayed / resolution) * resolution
            if not dropped and (first or not disturbed or s.effect.stuck[kind, axis] == 0):
                s.reading[kind, imu, axis] = delayed
