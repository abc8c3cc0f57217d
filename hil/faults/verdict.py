"""What the records of a run say: how far the pose was off before and after anything was told, and who was left out."""

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.safety.causes import Cause, Mode
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.pose import Array, pose_errors, rotation_from_vector, rotations_from_quaternions, vector_from_rotation
from plant.truth import TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION

FORBIDDEN_POSITION_M, FORBIDDEN_ROTATION_RAD = 5e-3, float(np.radians(1.0))
"""No pose may be off by more after a sound IMU was left out."""

_SAY_NOTHING = (
    Cause.NONE, Cause.END_OF_MOTION, Cause.STOP_REQUESTED, Cause.IMU_BACK, Cause.ENCODER_BACK, Cause.ANSWER_LATE, Cause.ARMED,
)  # fmt: skip
_MOST_EVENTS = 12

_MOST_LOST = 10
"""More frames in a row are not lost: with a fifth of them lost, so many are in one of ten million cases."""


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
    position, rotation = _errors(records)
    cycles = np.arange(len(records))
    events = _events(records, begin)
    first = events[0] if events else None
    told_at = first[0] if first else len(records)
    encoder_off = _encoder_off(records, begin, told_at)
    before, after = steering & (cycles >= begin) & (cycles <= told_at), steering & (cycles > told_at)
    used = (records["imus"][:, None] >> np.arange(IMU_COUNT)) & 1 != 0
    lost = ~used & (steering & (cycles >= begin))[:, None]
    left_out = np.flatnonzero(lost.any(axis=0))
    sound = [imu for imu in left_out.tolist() if imu not in guilty]
    then = steering & (cycles >= (lost[:, sound].any(axis=1).argmax() if sound else len(records)))
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
        "ended_s": (len(records) - begin) / rate,
        "left_out": _listed(left_out.tolist()),
        "sound_left_out": _listed(sound),
        "forbidden": bool(
            sound and ((position_then or 0.0) > FORBIDDEN_POSITION_M or (rotation_then or 0.0) > FORBIDDEN_ROTATION_RAD)
        ),
        "position_then": position_then,
        "rotation_then": rotation_then,
        "deviation": _most(np.abs(records["truth"][:, TRUTH_LENGTHS] - references).max(axis=1), steering & (cycles >= begin)),
        "encoder_off": encoder_off,
        "cycles": int(steering.sum()),
        "rms_position": _rms(position[steering]),
        "rms_rotation": _rms(rotation[steering]),
        **_protection(records, steering, position, rotation),
    }


def _errors(records: Record) -> tuple[Array, Array]:
    """The distance [m] and the angle [rad] of the estimate from the truth, (N,) each; NaN counts as infinitely far."""
    errors = pose_errors(records["position"], records["rotation"], *_true_poses(records))
    position, rotation = np.linalg.norm(errors.reshape(-1, 2, 3), axis=2).T
    return np.nan_to_num(position, nan=np.inf, posinf=np.inf), np.nan_to_num(rotation, nan=np.inf, posinf=np.inf)


def _true_poses(records: Record) -> tuple[Array, Array]:
    """Positions (N, 3) [m] and rotations (N, 3, 3).

    While the rig does not answer, the truth in the records is that of its last answer. Its drives go on at their last speed,
    and so does the pose here. On CAN the truth has a frame of its own. Where that was lost, the truth is that of an earlier
    cycle, and the pose here is between those of the frames before and after.
    """
    positions = records["truth"][:, TRUTH_POSITION].copy()
    rotations = rotations_from_quaternions(np.ascontiguousarray(records["truth"][:, TRUTH_QUATERNION]))
    periods = 1 + records["missed"]
    shift, turn = np.zeros(3), np.zeros(3)
    for cycle in np.flatnonzero(records["silent"] > 0).tolist():
        if cycle > 1 and records["silent"][cycle - 1] == 0:
            shift = (positions[cycle - 1] - positions[cycle - 2]) / periods[cycle - 1]
            turn = vector_from_rotation(rotations[cycle - 1] @ rotations[cycle - 2].T) / periods[cycle - 1]
        positions[cycle] = positions[cycle - 1] + periods[cycle] * shift
        rotations[cycle] = rotation_from_vector(periods[cycle] * turn) @ rotations[cycle - 1]
    periods_until = np.cumsum(periods)
    for before, after in _lost_frames(records):
        whole_turn = vector_from_rotation(rotations[after] @ rotations[before].T)
        for cycle in range(before + 1, after):
            share = (periods_until[cycle] - periods_until[before]) / (periods_until[after] - periods_until[before])
            positions[cycle] = positions[before] + share * (positions[after] - positions[before])
            rotations[cycle] = rotation_from_vector(share * whole_turn) @ rotations[before]
    return positions, rotations


def _lost_frames(records: Record) -> list[tuple[int, int]]:
    """The last cycle before and the first one after each gap in which the rig has answered and the truth did not change.

    Where it did not change for longer, the platform stands.
    """
    changes = np.flatnonzero((np.diff(records["truth"], axis=0) != 0.0).any(axis=1) | (records["silent"][1:] > 0)) + 1
    return [
        (before, after)
        for before, after in zip(changes[:-1].tolist(), changes[1:].tolist(), strict=True)
        if 1 < after - before <= _MOST_LOST + 1 and records["silent"][before] == records["silent"][after] == 0
    ]


def _encoder_off(records: Record, begin: int, told_at: int) -> float | None:
    """How far any encoder's reading changed otherwise than its length, from a cycle before `begin` until one [m]."""
    off = records["length"] - records["truth"][:, TRUTH_LENGTHS]
    answered = records["silent"] == 0
    first = max(begin - 1, 0)
    until = off[first : told_at + 1][answered[first : told_at + 1]]
    changes = np.abs(until - until[:1])
    return float(np.nanmax(changes)) if np.isfinite(changes).any() else None


def _events(records: Record, begin: int) -> list[tuple[int, int, int]]:
    """What was told since the begin: cycle, cause and index."""
    causes = records["event_cause"]
    rows, slots = np.nonzero(~np.isin(causes, _SAY_NOTHING))
    return [
        (int(row), int(causes[row, slot]), int(records["event_index"][row, slot]))
        for row, slot in zip(rows.tolist(), slots.tolist(), strict=True)
        if row >= begin
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
