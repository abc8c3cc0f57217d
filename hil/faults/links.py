"""A prepared loop on one of several links to its plant, in one process and on virtual time, so that runs are repeatable."""

from collections.abc import Iterable

import numpy as np

from hil.faults.rows import MOST_LATE, Drawn
from hil.loop.records import RECORD, Link
from hil.realtime.clock import SCRIPTED, new_clock
from hil.rigs.emulation import fault, new_emulated
from hil.rigs.udp.datagrams import version_for
from hil.rigs.udp.emulator import new_udp_emulator
from hil.rigs.udp.link import new_link
from hil.rigs.udp.rig import TIMEOUT_SHARE
from hil.runs.prepare import PreparedLoop, prepared_loop
from plant.compiled import Record
from plant.extras import missing_extras_named
from plant.imu_wiring import IMU_COUNT

_SESSION = 1
_REST_S = 9.0
"""Room in the records for a late arming and for the stop at the end [s]."""


def run(drawn: Drawn) -> tuple[Record, int, int]:
    """Run a row as a seed has it; returns records (N,), the cycle in which the disturbance begins, and the `Cause` of the end.

    Raises:
        GoughError: the row cannot be run.
    """
    config = drawn.config
    records = np.zeros(round((config.duration + _REST_S) * config.rate), RECORD)
    with prepared_loop(config, records) as loop:
        hold = int(loop.parameters["rig"]["hold_cycles"])
        end = hold + round(config.duration * config.rate)
        faults = [fault(text) for text in drawn.faults] if drawn.link != "fmu" else []
        if drawn.late_percent > 0.0:
            # Late cycles that follow each other are not to end the run.
            loop.most_missed = len(records)
            _follow_script(loop, drawn.late_percent, config.seed)
        if drawn.link == "canopen":
            cause = _follow_canopen(loop, faults, config.seed, end)
        else:
            if drawn.link == "udp":
                join_udp(loop, faults, config.seed)
            cause = loop.follow(end)
        records = records[: int(loop.link[Link.HEAD])]
    begin = hold if drawn.link == "fmu" else _first_enabled(records)
    return records, begin + round(drawn.begin * config.rate) if drawn.begin > 0.0 else 0, cause


def join_udp(loop: PreparedLoop, faults: Iterable[Record], seed: int) -> None:
    """Put datagrams and the emulated rig between a loop and its plant, on a scripted clock.

    Args:
        loop: that has not run.
        faults: each of dtype `hil.rigs.emulation.FAULT`.
        seed: of the faults' random numbers.
    """
    period = _on_a_bus(loop)
    rig = new_emulated(loop.mechanism, round(1e9 * period), seed, faults)
    version = version_for(bool(loop.encoders["legs"] > 0), bool(loop.imu["count"] > IMU_COUNT))
    loop.emulator = new_udp_emulator(loop.fmu, loop.imu, loop.encoders, rig, _SESSION, version=version)
    loop.udp = new_link()
    loop.udp.socket["version"] = version
    loop.udp.socket["session"] = _SESSION
    loop.udp.socket["timeout_ns"] = round(1e9 * TIMEOUT_SHARE * period)


def _follow_canopen(loop: PreparedLoop, faults: Iterable[Record], seed: int, end: int) -> int:
    """Follow the motion over CAN frames, each of which is real, with the drives' and IMUs' nodes in the same thread."""
    with missing_extras_named():
        from hil.rigs.canopen.in_memory import CanopenInMemory
        from hil.rigs.canopen.settings import canopen_settings
    period = _on_a_bus(loop)
    rig = new_emulated(loop.mechanism, round(1e9 * period), seed, faults)
    lengths = bool(loop.encoders["legs"] > 0)
    canopen = CanopenInMemory(
        canopen_settings(base_imu=loop.imu["count"] > IMU_COUNT),
        period,
        lambda: (loop.simulated, loop.imu, loop.encoders, rig),
        lengths,
    )
    loop.load(python=True)
    try:
        canopen.open()
        canopen.identify()
        canopen.arm()
        return loop.follow(end, canopen)
    finally:
        canopen.close()


def _on_a_bus(loop: PreparedLoop) -> float:
    """Let commands take effect a period later, as on a bus; returns the period [s]."""
    loop.parameters["load"]["command_delay"] = loop.parameters["rig"]["period"]
    if loop.clock["mode"] != SCRIPTED:
        _follow_script(loop)
    return float(loop.parameters["rig"]["period"])


def _follow_script(loop: PreparedLoop, late_percent: float = 0.0, seed: int = 0) -> None:
    """Let the loop's clock follow a script, in which a share of the cycles begins late."""
    period_ns, random = round(1e9 * float(loop.parameters["rig"]["period"])), np.random.default_rng([seed, 2])
    loop.clock = new_clock(SCRIPTED, period_ns)
    loop.script = np.zeros((1 << 14, 3), np.int64)
    late = random.random(len(loop.script)) < 0.01 * late_percent
    loop.script[late, 0] = period_ns * random.integers(1, MOST_LATE + 1, np.count_nonzero(late))


def _first_enabled(records: Record) -> int:
    """The cycle in which the drives are first enabled, or the one after the last; 0 if there is none."""
    enabled = records["cycle"][records["request"] != 0]
    if len(enabled) > 0:
        return int(enabled[0])
    return int(records["cycle"][-1]) + 1 if len(records) > 0 else 0
