"""A second opinion on the encoders: lengths that they read against those that the IMUs have, and the other way round.

A zero is taken from the IMUs, and slow errors of theirs show in the differences d of readings and lengths. So what counts most
is how d changes within a second. An error of the IMUs' pose moves all of d, and with its covariance S the other encoders tell
most of it. So if encoder k alone is off, this is by

    f = (S^-1 d)_k / (S^-1)_kk,    with the variance 1 / (S^-1)_kk,

which is the greatest likelihood's, and without it d^T S^-1 d is smaller by the square of f over its standard deviation. An
encoder is wrong that is off by too many of these, if little is left without it, and is left out. An IMU that is wrong moves
the pose otherwise, and with it the differences of several legs.
"""

import numpy as np

from controller.least_squares import factor_cholesky, invert_cholesky
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

_SHARES = 1.0, 0.9, 0.4
"""Shares of an encoder's error that count: of how its difference changes within a second, of how far it is from its mean since
the start, as it may creep away slowly, and of all of it, if its zero is known: errors of IMUs and joints last in that.
"""

_SLOW = 0.75
"""Share of the last two that counts if several encoders are off."""

_MEMORY_S = 30.0
"""The longest memory of the mean since the start [s], as that of a zero."""

_SIGMAS, _LEAST = 2.1, 0.5
"""An encoder is wrong that is off by so many standard deviations, and by this share of the limit of a change."""

_SETTLING_S, _UNSETTLED_S, _UNSETTLED = 1.5, 3.0, 1.5
"""After the first time from the start the filters have settled [s]; until the second one the limits are so much wider."""

_LASTING_S = 0.005
"""For how long a change must last, at least two cycles [s]."""

_ALONE = 2.5
"""How many times as large as what is left without it the square of a wrong encoder's error is, in sigmas."""

_BEYOND = 2.0
"""How far beyond the limit a change ends the run if it is not that of one encoder."""

_UNSEEN = 2.0
"""How many standard deviations an encoder could be off beyond what it seems to be."""

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
    begun=(np.int64, LEGS),  # whether there has been a difference: 1 about a zero that is found, 2 about one that is known
    mean=(np.float64, LEGS),  # of each difference, low-passed [m]
    # mean since the start of a difference about a known zero [m]; 0 about one that is found, as that is such a mean itself
    start=(np.float64, LEGS),
    started_for=(np.float64, LEGS),  # how long that mean has been taken [s]
    changed_for=np.float64,  # how long an encoder or the worst change has been beyond its limit [s]
    watched_for=np.float64,  # how long there have been differences [s]
    differences=(np.float64, (len(_SHARES), LEGS)),  # as `_SHARES` has them, of the encoders that count [m]
    silent_for=(np.float64, LEGS),  # how long each encoder has read nothing [s]
    agreed_for=(np.float64, LEGS),  # how long one that is left out has agreed [s]
    range=(np.float64, (LEGS, 2)),  # shortest and longest that its leg has been meanwhile [m]
    factor=(np.float64, (LEGS, LEGS)),  # from here on scratch
    inverse=(np.float64, (LEGS, LEGS)),
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
    w, passed = s.encoders, elapsed(rig, time)
    w.watched_for += passed
    wider = 1.0 if w.watched_for > _UNSETTLED_S else _UNSETTLED
    time_constant = max(min(_CHANGE_S, w.watched_for - _SETTLING_S), _LEAST_CHANGE_S, passed)
    settled = w.watched_for > _SETTLING_S
    w.differences[:] = 0.0
    w.factor[:] = 0.0
    left_out, changed = 0, False
    for k in range(LEGS):
        w.factor[k, k] = 1.0
        if encoders.silent_for[k] == 0.0 or encoders.excluded[k] != 0:
            encoders.unseen[k] = 0.0
        if k >= rig.legs or encoder_parameters.present[k] == 0:
            continue
        _tell_silence(w, s.events, k, encoders, passed)
        if not np.isfinite(encoders.off[k]):
            continue
        zero = 2 if encoders.followed_for[k] == np.inf else 1
        if w.begun[k] != zero or s.mode < Mode.RUNNING:
            # On the brakes the zero still follows the IMUs' first lengths.
            w.begun[k], w.mean[k], w.started_for[k] = zero, encoders.off[k], 0.0
        change = encoders.off[k] - w.mean[k]
        w.mean[k] += passed / time_constant * change
        w.started_for[k] = w.started_for[k] + passed if settled else 0.0
        if zero == 1:
            w.start[k] = 0.0
        elif w.started_for[k] <= passed:
            w.start[k] = w.mean[k]
        else:
            w.start[k] += passed / min(_SETTLING_S + w.started_for[k], _MEMORY_S) * (encoders.off[k] - w.start[k])
        left_out += encoders.excluded[k]
        if encoders.excluded[k] != 0:
            if _agrees_again(p, w, encoder_parameters, encoders, k, change, lengths[k], passed):
                report_event(s.events, Cause.ENCODER_BACK, k, np.nan, np.nan)
                changed = True
        elif encoders.used[k] != 0.0:
            w.differences[0, k] = change
            w.differences[1, k] = encoders.off[k] - w.start[k]
            w.differences[2, k] = encoders.off[k] if zero == 2 else 0.0
            for other in range(k):
                if encoders.used[other] != 0.0:
                    w.factor[k, other] = encoders.covariance[k, other]
            w.factor[k, k] = encoders.covariance[k, k] + encoder_parameters.variance
    worst, error, sigma, alone = _find_wrong(w, encoders, settled)
    if s.mode < Mode.RUNNING:
        return changed
    limit = wider * max(_SIGMAS * sigma, _LEAST * p.encoders.deviation)
    wrong = alone and abs(error) > limit
    leg, most = _find_greatest(w, settled)
    several = most > _BEYOND * wider * p.encoders.deviation
    w.changed_for = w.changed_for + passed if wrong or several else 0.0
    if wrong:
        # Until it is named, it does not move the pose.
        encoders.used[worst] = 0.0
    if w.changed_for < p.encoders.lasting or s.mode != Mode.RUNNING:
        return changed
    if wrong and left_out == 0:
        encoders.excluded[worst] = 1
        w.changed_for = w.agreed_for[worst] = 0.0
        report_event(s.events, Cause.ENCODER_CONTRADICTED, worst, abs(error), limit)
        return True
    if wrong:
        handle_cause(p, s, rig, time, reference, pid, Cause.ENCODERS_CONTRADICT, worst, abs(error), limit)
    else:
        handle_cause(
            p, s, rig, time, reference, pid, Cause.ENCODERS_CONTRADICT, leg, most, _BEYOND * wider * p.encoders.deviation
        )  # fmt: skip
    return changed


@kernel
def _find_wrong(w: Record, encoders: Record, settled: bool) -> tuple[int, float, float, bool]:
    """The encoder that is off by most sigmas, by how much and its sigma [m], and whether it explains the differences alone;
    writes by how much each could be off unseen. Before the filters have settled, only changes count.

    The matrix of the covariances is in `factor`.
    """
    worst, error, sigma, square, alone = 0, 0.0, np.inf, 0.0, False
    if not factor_cholesky(w.factor):
        return worst, error, sigma, alone
    invert_cholesky(w.factor, w.inverse)
    for kind, share in enumerate(_SHARES):
        d = w.differences[kind]
        total, greatest, of, at = 0.0, 0.0, 0.0, 0
        for k in range(LEGS):
            weighted = 0.0
            for i in range(LEGS):
                weighted += w.inverse[k, i] * d[i]
            total += d[k] * weighted
            if kind == 2 and d[k] != 0.0:
                encoders.unseen[k] = abs(weighted) / w.inverse[k, k] + _UNSEEN / np.sqrt(w.inverse[k, k])
            if weighted * weighted > greatest * w.inverse[k, k]:
                at, greatest, of = k, weighted * weighted / w.inverse[k, k], weighted / w.inverse[k, k]
        if share * share * greatest > square and (settled or kind == 0):
            square = share * share * greatest
            worst, error, sigma = at, share * of, 1.0 / np.sqrt(w.inverse[at, at])
            alone = greatest > _ALONE * (total - greatest)
    return worst, error, sigma, alone


@kernel
def _find_greatest(w: Record, settled: bool) -> tuple[int, float]:
    """The greatest change, or share of a slow one, and its leg."""
    leg, most = 0, 0.0
    for k in range(LEGS):
        slow = max(abs(w.differences[1, k]), abs(w.differences[2, k])) if settled else 0.0
        size = max(abs(w.differences[0, k]), _SLOW * slow)
        if size > most:
            leg, most = k, size
    return leg, most


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
    w.started_for[k] = 0.0
    return True
