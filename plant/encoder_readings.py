"""Encoders in compiled code: from the true lengths of the legs to what `plant.encoders` read, cycle by cycle.

All noise is keyed by (seed, leg, cycle), so every cycle can be reproduced on its own.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from plant.checks import checked_seed
from plant.compiled import MOST, Limits, Record, kernel, record_dtype, shared_kernel
from plant.encoders import EncoderFault, EncoderFaultKind, EncoderModel
from plant.errors import InputError
from plant.imu.random_numbers import draw_normals
from plant.mechanism import LEGS
from plant.pose import Array

MOST_FAULTS = 16
_RATE_S = 0.005
"""Time constant of the low-pass of a rate [s]."""

_INSTANT_S = 1e-9
"""A fault that is due within this time is there [s]."""

_PURPOSE = 9
"""Of random numbers, beside those of the IMUs."""

ENCODER_FAULT = record_dtype(
    kind=np.int64,  # EncoderFaultKind; 0: none
    legs=np.int64,  # a bit for each
    size=np.float64,
    begin=np.float64,  # [s]
    end=np.float64,  # [s]
)
"""An `EncoderFault`."""

ENCODER_STATE = record_dtype(
    legs=np.int64,  # how many have an encoder; 0: none
    scale=(np.float64, LEGS),
    zero=(np.float64, LEGS),  # true length at which the encoder reads 0 [m]
    absolute=np.int64,
    resolution=np.float64,
    half_play=np.float64,
    noise=np.float64,
    dropout=np.float64,
    switch=(np.float64, LEGS),  # length at which the home switch closes; NaN without one [m]
    period=np.float64,  # of the cycles [s]
    seed=np.uint64,
    fault=(ENCODER_FAULT, MOST_FAULTS),
    lasting=np.int64,  # the number of faults that belong to the encoders or the run
    faults=np.int64,  # with those that a rig adds
    cycle=np.int64,
    time=np.float64,  # of the cycle [s]; a caller may set it before each
    before=np.float64,  # time of the cycle before [s]
    place=(np.float64, LEGS),  # of the encoder's end of the play, in true lengths [m]
    moved=(np.float64, LEGS),  # what faults have added to the count [m]
    kept=(np.float64, LEGS),  # last reading [m]
    reading=(np.float64, LEGS),  # [m]; NaN for none
    rate=(np.float64, LEGS),  # [m/s]; NaN for none
    home=(np.int64, LEGS),  # 1 beyond the home switch, 0 before it, -1 without one
    normals=(np.float64, 6),  # scratch
)
"""Constants and state of the encoders; a copy is a snapshot."""

ENCODER_LIMITS: Limits = {"legs": (0, LEGS), "lasting": (0, MOST_FAULTS), "faults": (0, MOST_FAULTS), "cycle": (0, MOST)}
"""Least and greatest of what counts, indexes or divides in them."""


def encoder_state(
    model: EncoderModel | None, seed: int, period: float, faults: Iterable[EncoderFault] = (), legs: int = LEGS
) -> Record:
    """Draw the constant errors of the encoders (dtype `ENCODER_STATE`), for cycles of `period` [s].

    Raises:
        InputError: a negative seed, or too many faults.
    """
    checked_seed(seed)
    state: Record = np.zeros((), ENCODER_STATE)
    state["reading"] = state["rate"] = state["switch"] = np.nan
    state["home"] = -1
    if model is None:
        return state
    random = np.random.default_rng([seed, LEGS, 2])
    state["legs"], state["absolute"] = legs, model.absolute
    state["scale"] = random.uniform(-model.scale, model.scale, LEGS)
    state["zero"] = random.normal(0.0, model.zero, LEGS) if model.absolute else np.nan
    state["switch"][: len(model.switches)] = model.switches
    state["switch"] += random.normal(0.0, model.repeatability, LEGS)
    state["resolution"], state["half_play"] = model.resolution, 0.5 * model.backlash
    state["noise"], state["dropout"] = model.noise, model.dropout
    state["period"] = period
    state["seed"], state["place"] = seed, np.nan
    made = [fault_record(each) for each in faults]
    if len(made) > MOST_FAULTS:
        raise InputError(f"there are {len(made)} faults of encoders, and at most {MOST_FAULTS} are possible: leave some out")
    for place, each in enumerate(made):
        state["fault"][place] = each
    state["faults"] = state["lasting"] = len(made)
    return state


def fault_record(fault: EncoderFault) -> Record:
    """The record (dtype `ENCODER_FAULT`) of a fault; one from the start begins at 0 s."""
    made: Record = np.zeros((), ENCODER_FAULT)
    begin = max(fault.begin, 0.0)
    made["kind"], made["legs"], made["size"] = fault.kind, sum(1 << leg for leg in fault.legs), fault.size
    made["begin"], made["end"] = begin, begin + fault.duration
    return made


@shared_kernel
def read_encoders(state: Record, lengths: Array, readings: Array, rates: Array, home: NDArray[np.int64]) -> None:
    """Write readings [m], rates [m/s] and home switches (6,) at true lengths (6,) [m]; `state` advances by a cycle."""
    s = state[()]
    for k in range(s.legs):
        _read(s, k, lengths[k])
    for k in range(LEGS):
        readings[k], rates[k], home[k] = s.reading[k], s.rate[k], s.home[k]
    s.before = s.time
    s.time += s.period
    s.cycle += 1


@kernel
def _read(s: Record, k: int, length: float) -> None:
    """Read the encoder of leg `k`."""
    uniform = draw_normals(s.normals, s.cycle, k, _PURPOSE, s.seed)
    first = s.cycle == 0 or np.isnan(s.place[k])
    before = length if first else s.place[k]
    s.place[k] = min(max(before, length - s.half_play), length + s.half_play)
    if first and s.absolute == 0:
        s.zero[k] = length
    dead = frozen = False
    passed = 0.0 if first else s.time - s.before
    for i in range(s.faults):
        f = s.fault[i]
        if (f.legs >> k) & 1 == 0 or not f.begin <= s.time + _INSTANT_S < f.end:
            continue
        motion = s.place[k] - before
        if f.kind == EncoderFaultKind.DEAD:
            dead = True
        elif f.kind == EncoderFaultKind.FROZEN:
            frozen = True
        elif f.kind == EncoderFaultKind.REVERSED:
            s.moved[k] -= 2.0 * motion
        elif f.kind == EncoderFaultKind.SLIPS:
            s.moved[k] -= f.size * motion
        elif f.kind == EncoderFaultKind.CREEPS:
            s.moved[k] += f.size * passed
        elif f.kind == EncoderFaultKind.JUMPS and (first or s.before + _INSTANT_S < f.begin):
            s.moved[k] += f.size
    exact = (1.0 + s.scale[k]) * (s.place[k] - s.zero[k]) + s.moved[k] + s.noise * s.normals[0]
    if s.resolution > 0.0:
        exact = s.resolution * np.rint(exact / s.resolution)
    if frozen and not first:
        exact = s.kept[k]
    if first:
        s.rate[k] = 0.0
    elif passed > 0.0:
        s.rate[k] -= np.expm1(-passed / _RATE_S) * ((exact - s.kept[k]) / passed - s.rate[k])
    s.kept[k] = exact
    s.reading[k] = np.nan if dead or uniform < s.dropout else exact
    s.home[k] = -1 if np.isnan(s.switch[k]) else 1 if length >= s.switch[k] else 0
