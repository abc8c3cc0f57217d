"""What the records of a run say: how far the pose was off before and after anything was told, and who was left out."""

import json
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.safety.causes import Cause, Mode
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.pose import (
    Array,
    pose_errors,
    quaternion_from_rotation,
    rotation_from_vector,
    rotations_from_quaternions,
    vector_from_rotation,
)
from plant.truth import TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION

FORBIDDEN_POSITION_M, FORBIDDEN_ROTATION_RAD = 5e-3, float(np.radians(1.0))
"""No pose may be off by more after a sound IMU was left out."""

_SAY_NOTHING = (
    Cause.NONE, Cause.END_OF_MOTION, Cause.STOP_REQUESTED, Cause.IMU_BACK, Cause.ENCODER_BACK, Cause.ANSWER_LATE, Cause.ARMED,
)  # fmt: skip
_MOST_EVENTS = 12

_MOST_LOST = 10
"""A longer gap is no loss of frames: if a fifth is lost, ten in a row are lost once in ten million."""


def judge(records: Record, begin: int, guilty: frozenset[int], cause: int, rate: float) -> dict[str, Any]:
    """The figures of a run, in SI units; None where there is nothing to measure.

    Args:
        records: (N,), dtype `hil.loop.records.RECORD`, from the first cycle on.
        begin: the cycle in which the disturbance begins.
        guilty: the IMUs that may rightly be left out.
        cause: of the end.
        rate: [Hz].

    Returns:
        `position_before`, `rotation_before`, `position_after`, `rotation_after`: the greatest errors from the begin until
        something was told, and from then on while the loop steers.
        `told`, `told_imu`, `told_s`: what was told first, of which leg or IMU (-1: none), and how long after the begin.
        `alarms`: how many things were told in motion before the begin. `events`: the first ones since the begin, as JSON.
        `ended`, `ended_s`: why and how long after the begin. `left_out`, `sound_left_out`: IMUs.
        `forbidden`: whether a sound one was left out and the error then exceeded 5 mm or 1 deg; `position_then`,
        `rotation_then`: the greatest errors since then.
        `deviation`: the greatest of a leg from its reference.
        `encoder_off`: how far the reading of any encoder had changed otherwise than its length when something was told; None
        without encoders.
        `cycles` in motion, in which the error was `rms_position` and `rms_rotation`, and, if the loop has a protection level,
        how many of them it has `covered`, and its 99th percentiles `level_position` and `level_rotation`.
    """
    steering = np.isin(records["mode"], (Mode.RUNNING, Mode.STOPPING))
    truth = _truth(records)
    position, rotation = _errors(records, truth)
    cycles = records["cycle"]
    events = _events(records, begin)
    first = events[0] if events else None
    end = int(cycles[-1]) + 1 if len(records) else 0
    told_at = first[0] if first else end
    encoder_off = _encoder_off(records, truth, begin, told_at)
    before, after = steering & (cycles >= begin) & (cycles <= told_at), steering & (cycles > told_at)
    used = (records["imus"][:, None] >> np.arange(IMU_COUNT)) & 1 != 0
    lost = ~used & (steering & (cycles >= begin))[:, None]
    left_out = np.flatnonzero(lost.any(axis=0))
    sound = [imu for imu in left_out.tolist() if imu not in guilty]
    then = steering & (cycles >= (cycles[lost[:, sound].any(axis=1).argmax()] if sound else end))
    position_then, rotation_then = _most(position, then), _most(rotation, then)
    references = records["reference"][:, :, 0]
    return {
        "position_before": _most(position, before),
        "rotation_before": _most(rotation, before),
        "position_after": _most(position, after),
        "rotation_after": _most(rotation, after),
        "told": Cause(first[1]).short if first else "",
        "told_imu": first[2] if first else -1,
        "told_s": (first[0] - begin) / rate if first else None,
        "alarms": _count_alarms(records, steering & (cycles < begin)),
        "events": json.dumps([[(at - begin) / rate, Cause(which).short, index] for at, which, index in events[:_MOST_EVENTS]]),
        "ended": Cause(cause).short,
        "ended_s": (end - begin) / rate,
        "left_out": _listed(left_out.tolist()),
        "sound_left_out": _listed(sound),
        "forbidden": bool(
            sound and ((position_then or 0.0) > FORBIDDEN_POSITION_M or (rotation_then or 0.0) > FORBIDDEN_ROTATION_RAD)
        ),
        "position_then": position_then,
        "rotation_then": rotation_then,
        "deviation": _most(np.abs(truth[:, TRUTH_LENGTHS] - references).max(axis=1), steering & (cycles >= begin)),
        "encoder_off": encoder_off,
        "cycles": int(steering.sum()),
        "rms_position": _rms(position[steering]),
        "rms_rotation": _rms(rotation[steering]),
        **_protection(records, steering, position, rotation),
    }


def _errors(records: Record, truth: Array) -> tuple[Array, Array]:
    """The distance [m] and the angle [rad] of the estimate from the truth, (N,) each; NaN counts as infinitely far."""
    errors = pose_errors(records["position"], records["rotation"], truth[:, TRUTH_POSITION].copy(), _rotations(truth))
    position, rotation = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).T
    return np.nan_to_num(position, nan=np.inf, posinf=np.inf), np.nan_to_num(rotation, nan=np.inf, posinf=np.inf)


def _rotations(truth: Array) -> Array:
    return rotations_from_quaternions(np.ascontiguousarray(truth[:, TRUTH_QUATERNION]))


def _truth(records: Record) -> Array:
    """Pose and lengths (N, 13) of the platform, also where the records have those of an earlier cycle.

    On CAN the truth has a frame of its own. Where that was lost, the platform was between where the frames before and after
    say. While the rig does not answer, its drives go on at their last speed, and so does the platform here.
    """
    truth: Array = records["truth"][:, : TRUTH_LENGTHS.stop].copy()
    times = np.cumsum(1 + records["missed"])
    fresh = np.flatnonzero(_fresh(records)).tolist()
    for before, after in pairwise([*fresh, len(records)]):
        gap = slice(before + 1, after)
        silent = (records["silent"][gap] > 0).any()
        first, last = (max(before - 1, 0), before) if silent else (before, after)
        if gap.start == after or first == last:
            continue
        shares = (times[gap] - times[before]) / (times[last] - times[first])
        ends = _rotations(truth[[first, last, before]])
        turn = vector_from_rotation(ends[1] @ ends[0].T)
        truth[gap] = truth[before] + shares[:, None] * (truth[last] - truth[first])
        truth[gap, TRUTH_QUATERNION] = quaternion_from_rotation(
            np.array([rotation_from_vector(share * turn) @ ends[2] for share in shares])
        )
    return truth


def _fresh(records: Record) -> NDArray[np.bool_]:
    """In which cycles (N,) the truth is their own. Where it does not change for long, or until the end, the platform stands."""
    answered = records["silent"] == 0
    # Not all rigs tell the currents.
    changed = np.r_[True, (np.diff(records["truth"][:, : TRUTH_LENGTHS.stop], axis=0) != 0.0).any(axis=1)]
    same = answered & ~changed
    bounds = np.flatnonzero(np.diff(np.r_[False, same, False]))
    for begin, end in bounds.reshape(-1, 2).tolist():
        if end - begin > _MOST_LOST or end == len(records):
            same[begin:end] = False
    fresh: NDArray[np.bool_] = answered & ~same
    fresh[0] = True
    return fresh


def _encoder_off(records: Record, truth: Array, begin: int, told_at: int) -> float | None:
    """How far any encoder's reading changed otherwise than its length, from a cycle before `begin` until one [m]."""
    off = records["length"] - truth[:, TRUTH_LENGTHS]
    cycles = records["cycle"]
    until = off[(records["silent"] == 0) & (cycles >= begin - 1) & (cycles <= told_at)]
    changes = np.abs(until - until[:1])
    return float(np.nanmax(changes)) if np.isfinite(changes).any() else None


def _events(records: Record, begin: int) -> list[tuple[int, int, int]]:
    """What was told since the begin: cycle, cause and index."""
    causes = records["event_cause"]
    rows, slots = np.nonzero(~np.isin(causes, _SAY_NOTHING))
    return [
        (int(records["cycle"][row]), int(causes[row, slot]), int(records["event_index"][row, slot]))
        for row, slot in zip(rows.tolist(), slots.tolist(), strict=True)
        if records["cycle"][row] >= begin
    ]


def _count_alarms(records: Record, where: NDArray[np.bool_]) -> int:
    return int((~np.isin(records["event_cause"][where], _SAY_NOTHING)).sum())


def _protection(records: Record, steering: NDArray[np.bool_], position: Array, rotation: Array) -> dict[str, Any]:
    levels = records["protection"][steering].astype(float)
    if np.isnan(levels).all():
        return {}
    covered = (position[steering] <= levels[:, 0]) & (rotation[steering] <= levels[:, 1])
    high = np.quantile(np.nan_to_num(levels, nan=np.inf), 0.99, axis=0, method="higher")
    return {"covered": int(covered.sum()), "level_position": float(high[0]), "level_rotation": float(high[1])}


def _most(values: Array, where: NDArray[np.bool_]) -> float | None:
    return float(values[where].max()) if where.any() else None


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _listed(imus: list[int]) -> str:
    return " ".join(map(str, imus))
