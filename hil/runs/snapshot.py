"""Snapshots: files from which a simulation goes on bit for bit.

A snapshot has the plant's own state, and every array that the loop changes. What follows from the configuration, such as the
motion and the gains, is made again and must be the same as before.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from controller.cycle import PARAMETERS, RUNNING_LIMITS, STATE
from controller.planning.segments import START
from hil.loop.records import WORK
from hil.realtime.clock import CLOCK, FREE
from hil.runs.prepare import PreparedLoop
from plant.compiled import Record, out_of_limits
from plant.encoder_readings import ENCODER_LIMITS, ENCODER_STATE
from plant.errors import InputError
from plant.files import write_whole
from plant.imu import IMU_LIMITS, IMU_STATE

_KIND = "gough snapshot"


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A simulation between two cycles.

    Attributes:
        config: the configuration as plain values.
        cycle: the next one to run.
        settings: hash of what does not change: the cycle's parameters, the FMU and its binding.
        motion: hash of what was planned until then.
        memory: the loop's arrays.
        plant: state of the FMU and its clock.
    """

    config: Mapping[str, Any]
    cycle: int
    settings: bytes
    motion: bytes
    memory: Mapping[str, bytes]
    plant: bytes


def take_snapshot(config: Mapping[str, Any], loop: PreparedLoop) -> Snapshot:
    """Take a snapshot between two cycles.

    Raises:
        FmuError: the FMU cannot save its state.
    """
    cycle = int(loop.state["time"]["cycle"])
    memory = {name: array.tobytes() for name, array in loop.memory().items()}
    return Snapshot(config, cycle, _settings(loop), _motion(loop, cycle), memory, loop.simulated.state())


def resume_snapshot(snapshot: Snapshot, loop: PreparedLoop) -> None:
    """Go on from a snapshot, in a loop that has just been prepared from its configuration.

    Raises:
        InputError: the loop differs from the one in the snapshot, or has no cycle left.
        FmuError: the FMU is another one, or cannot restore its state.
    """
    refused, memory = "this simulation cannot go on from the snapshot, as", loop.memory()
    if snapshot.settings != _settings(loop):
        raise InputError(f"{refused} its mechanism, calibration, FMU or binding have changed since")
    if snapshot.motion != _motion(loop, snapshot.cycle):
        remedy = "take the snapshot in a run of the same duration, with --save-at"
        raise InputError(f"{refused} another motion was planned until then: {remedy}")
    if {name: len(kept) for name, kept in snapshot.memory.items()} != {name: array.nbytes for name, array in memory.items()}:
        raise InputError(f"{refused} its memory has another layout")
    kept: dict[str, Record] = {name: np.frombuffer(snapshot.memory[name], array.dtype) for name, array in memory.items()}
    broken = _broken(snapshot, kept)
    if broken is not None:
        raise InputError(f"{refused} {broken}: its file was forged or is damaged")
    if snapshot.cycle >= loop.end + int(kept["state"]["safety"]["arming"]["delay"][0]):
        raise InputError(
            f"the snapshot is of the end of its motion of {snapshot.config['duration']:g} s: go on with a longer --duration"
        )
    loop.simulated.restore(snapshot.plant)
    for name, array in memory.items():
        array[...] = kept[name].reshape(array.shape)
    # The place in the segments is found again.
    loop.state["reference"]["index"] = 0


def _broken(snapshot: Snapshot, kept: Mapping[str, Record]) -> str | None:
    """What compiled code could not take of the loop's arrays, in words; None if there is nothing."""
    for name, limits in (
        ("state", RUNNING_LIMITS),
        ("imu", IMU_LIMITS),
        ("encoders", ENCODER_LIMITS),
        ("clock", {"mode": (FREE, FREE)}),
    ):
        if broken := out_of_limits(kept[name], limits):
            return f"in its {name} {broken}"
    cycle = int(kept["state"]["time"]["cycle"][0])
    return None if cycle == snapshot.cycle else f"its state is that of cycle {cycle}, and it is to be of {snapshot.cycle}"


def write_snapshot(snapshot: Snapshot, path: Path) -> None:
    """Write a snapshot's file, which appears only when it is complete; an `InputError` if it cannot be written."""
    content = msgpack.packb(vars(snapshot))
    whole = {"kind": _KIND, "version": version("gough"), "layout": _layout(), "digest": _hash(content), "content": content}
    write_whole(path, msgpack.packb(whole))


def read_snapshot(path: Path) -> Snapshot:
    """Read a snapshot's file.

    Raises:
        InputError: it cannot be read, or is no snapshot of this version.
    """
    try:
        whole = msgpack.unpackb(path.read_bytes())
    except OSError as error:
        raise InputError(f"cannot read the snapshot {path}: {error.strerror}") from None
    except Exception:
        whole = None
    if not isinstance(whole, dict) or whole.get("kind") != _KIND:
        raise InputError(f"{path} is no snapshot of 'gough simulate --save-state'")
    of, layout = whole.get("version"), whole.get("layout")
    if of != version("gough") or layout != _layout():
        raise InputError(
            f"{path} is of gough {of}, and this is gough {version('gough')} with another layout of the state: go on with the "
            "version that saved it, or simulate from the start"
        )
    content = whole.get("content")
    if not isinstance(content, bytes) or whole.get("digest") != _hash(content):
        raise InputError(f"{path} is damaged, as its digest is not that of its content: save the snapshot again")
    try:
        snapshot = Snapshot(**msgpack.unpackb(content))
    except Exception:
        raise InputError(f"{path} is a snapshot with missing or unknown parts") from None
    kinds = {"config": dict, "cycle": int, "settings": bytes, "motion": bytes, "memory": dict, "plant": bytes}
    wrong = [name for name, kind in kinds.items() if type(getattr(snapshot, name)) is not kind]
    wrong += [f"memory.{name}" for name, part in snapshot.memory.items() if type(part) is not bytes] if not wrong else []
    if wrong:
        raise InputError(f"{path} is a snapshot whose {wrong[0]} is of another kind: it was forged")
    return snapshot


def _hash(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()


def _layout() -> bytes:
    return _hash(repr((PARAMETERS, STATE, WORK, CLOCK, IMU_STATE, ENCODER_STATE)).encode())


def _settings(loop: PreparedLoop) -> bytes:
    bound, content = loop.simulated.bound, loop.parameters.tobytes() + loop.simulated.path.read_bytes()
    for array in (*bound.sensed, *bound.known, *bound.commanded, *bound.loaded, bound.modes.references, bound.modes.values):
        content += array.tobytes()
    return _hash(content)


def _motion(loop: PreparedLoop, cycle: int) -> bytes:
    begun = loop.segments[:, :, START] <= cycle * float(loop.parameters["rig"]["period"])
    return _hash(loop.segments[begun].tobytes())
