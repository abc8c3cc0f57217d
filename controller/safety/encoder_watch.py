"""A second opinion on the encoders: lengths that they read against those that the IMUs have, and the other way round.

A zero is taken from the IMUs, and slow errors of theirs show in the difference. So what counts most is how the difference
changes within a second. One encoder whose difference changes alone is wrong, and is left out. An IMU that is wrong moves the
pose, and with it the differences of several legs.
"""

import numpy as np

from controller.rig import elapsed
from controller.safety.causes import Cause, Mode, report_event
from controller.safety.stop import handle_cause
from controller.settings import SafetySettings
from plant.compiled import Record, filled, kernel, record_dtype
from plant.mechanism import LEGS

_CHANGE_S = 1.0
"""Time constant of the mean from which the difference changes [s]."""

_LEAST_CHANGE_S = 0.05
"""The same while the filters settle [s]."""

_SLOW = 0.75
"""Share of the whole difference that counts like a change: an encoder may creep away slowly."""

_SETTLING_S, _UNSETTLED_S, _UNSETTLED = 1.5, 3.0, 1.5
"""After the first time from the start the filters have settled [s]; until the second one the limit is so much wider."""

_LASTING_S = 0.005
"""For how long a change must last, at least two cycles [s]."""

_ALONE = 2.0
"""How much more than those of all others together the difference of a wrong encoder changes."""

_BEYOND = 2.0
"""How far beyond the limit a change ends the run if it is not that of one encoder."""

_AGREED, _AGREED_S, _MOVED_M = 0.3, 5.0, 0.005
"""An encoder is used again when its difference has changed by less than this share of the limit for so long [s], while its leg
has moved so far [m].
"""

_SILENT_S = 0.01
"""After what time without a reading that is told [s]."""

PARAMETERS = record_dtype(
    deviation=np.float64,  # limit of a change [m]
    lasting=np.float64,  # [s]
)
"""The limits."""

STATE = record_dtype(
    begun=(np.int64, LEGS),  # whether there has been a difference
    mean=(np.float64, LEGS),  # of each difference, low-passed [m]
    changed_for=np.float64,  # how long the worst change has been beyond its limit [s]
    watched_for=np.float64,  # how long there have been differences [s]
    squares=(np.float64, 2),  # sum of the squares of the changes, and of the share of the differences [m^2]
    most=(np.float64, 2),  # the greatest of them [m]
    worst=(np.int64, 2),  # and whose it is
    silent_for=(np.float64, LEGS),  # how long each encoder has read nothing [s]
    agreed_for=(np.float64, LEGS),  # how long one that is left out has agreed [s]
    range=(np.float64, (LEGS, 2)),  # shortest and longest that its leg has been meanwhile [m]
)
"""What lasts."""


def encoder_watch_parameters(settings: SafetySettings, rate: float) -> Record:
    """The limits (dtype `PARAMETERS`) in cycles of this rate [Hz]."""
    return filled(PARAMETERS, deviation=settings.length_deviation, lasting=max(_LASTING_S, 2.0 / rate))


@kernel
def judge_encoders(
    p: Record, s: Record, rig: Record, time: Record, encoder_parameters: Record, encoders: Record, lengths: Record,
    reference: Record, pid: Record,
) -> bool:  # fmt: skip
    """After the comparison: leave out the encoder that is wrong, take back one that is right again, else stop. Returns whether
    the set of encoders has changed.

    Args:
        lengths: (6,), that the IMUs have [m].
    """
    w, limit, passed = s.encoders, p.encoders.deviation, elapsed(rig, time)
    w.watched_for += passed
    limit *= 1.0 if w.watched_for > _UNSETTLED_S else _UNSETTLED
    time_constant = max(min(_CHANGE_S, w.watched_for - _SETTLING_S), _LEAST_CHANGE_S, passed)
    settled = w.watched_for > _SETTLING_S
    w.squares[:], w.most[:] = 0.0, 0.0
    left_out, changed = 0, False
    for k in range(rig.legs):
        if encoder_parameters.present[k] == 0:
            continue
        _tell_silence(w, s.events, k, encoders, passed)
        if not np.isfinite(encoders.off[k]):
            continue
        if w.begun[k] == 0:
            w.begun[k], w.mean[k] = 1, encoders.off[k]
        change = encoders.off[k] - w.mean[k]
        w.mean[k] += passed / time_constant * change
        left_out += encoders.excluded[k]
        if encoders.excluded[k] != 0:
            if _agrees_again(p, w, encoder_parameters, encoders, k, change, lengths[k], passed):
                report_event(s.events, Cause.ENCODER_BACK, k, np.nan, np.nan)
                changed = True
        elif encoders.used[k] != 0.0:
            _compare(w, 0, k, change)
            _compare(w, 1, k, _SLOW * encoders.off[k] if settled else 0.0)
    kind = 0 if w.most[0] > w.most[1] else 1
    worst, most = w.worst[kind], w.most[kind]
    w.changed_for = w.changed_for + passed if most > limit else 0.0
    alone = most * most > _ALONE**2 * (w.squares[kind] - most * most)
    if most > limit and alone:
        # Until it is named, it does not move the pose.
        encoders.used[worst] = 0.0
    if w.changed_for < p.encoders.lasting or s.mode != Mode.RUNNING:
        return changed
    if alone and left_out == 0:
        encoders.excluded[worst] = 1
        w.changed_for = w.agreed_for[worst] = 0.0
        report_event(s.events, Cause.ENCODER_CONTRADICTED, worst, most, limit)
        return True
    if most > _BEYOND * limit or alone:
        handle_cause(p, s, rig, time, reference, pid, Cause.ENCODERS_CONTRADICT, worst, most, limit)
    return changed


@kernel
def _compare(w: Record, kind: int, k: int, difference: float) -> None:
    """Take a difference of leg `k` into the sum of the squares and the greatest of its kind."""
    w.squares[kind] += difference * difference
    if abs(difference) > w.most[kind]:
        w.worst[kind], w.most[kind] = k, abs(difference)


@kernel
def _tell_silence(w: Record, events: Record, k: int, encoders: Record, passed: float) -> None:
    """Say when an encoder reads nothing any more, and when it reads again."""
    before = w.silent_for[k]
    w.silent_for[k] = 0.0 if np.isfinite(encoders.reading[k]) else before + passed
    if before < _SILENT_S <= w.silent_for[k]:
        report_event(events, Cause.ENCODER_SILENT, k, np.nan, np.nan)
    elif before >= _SILENT_S and w.silent_for[k] == 0.0:
        report_event(events, Cause.ENCODER_BACK, k, np.nan, np.nan)


@kernel
def _agrees_again(
    p: Record, w: Record, encoder_parameters: Record, encoders: Record, k: int, change: float, length: float, passed: float
) -> bool:  # fmt: skip
    """Take an encoder back that has agreed with the IMUs for a while in which its leg has moved; returns whether it is."""
    known = encoder_parameters.absolute != 0 and abs(encoders.off[k]) > p.encoders.deviation
    if abs(change) > _AGREED * p.encoders.deviation or known or w.agreed_for[k] == 0.0:
        w.agreed_for[k] = 0.0
        w.range[k] = length
    w.agreed_for[k] += passed
    w.range[k, 0], w.range[k, 1] = min(w.range[k, 0], length), max(w.range[k, 1], length)
    if w.agreed_for[k] < _AGREED_S or w.range[k, 1] - w.range[k, 0] < _MOVED_M:
        return False
    encoders.excluded[k] = 0
    if encoder_parameters.absolute == 0:
        # Even one that a home switch has told is now known from the IMUs alone.
        encoders.zero[k] += w.mean[k]
        encoders.followed_for[k] = min(encoders.followed_for[k], _AGREED_S)
        w.mean[k] = 0.0
    return True
