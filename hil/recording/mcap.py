"""Recordings: every cycle of a run in an MCAP file, and the process that takes it there from memory shared with the loop.

The loop writes its records round and round and never waits; the recorder takes them out and counts those that it came too late
for. A record's layout is that of a ROS 2 message in CDR, so a message is the record's bytes, and the schema inside the file is
made from its dtype: Foxglove and PlotJuggler open it. What a replay needs lies in the file's attachments.
"""

import hashlib
import io
import json
import os
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from numpy.typing import NDArray

from controller.safety.causes import EVENT_SLOTS, Cause, Reaction
from hil.loop.records import RECORD, STAGES, Link
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError

_LITTLE_ENDIAN_CDR = b"\x00\x01\x00\x00"
_CYCLE_TOPIC, _EVENT_TOPIC = "/cycle", "/event"
_CYCLE_SCHEMA = "gough/Cycle"
_CHUNK_S = 0.25
_POLL_S = 0.05
_MOST_BYTES = 1 << 20
_CDR_TYPES = {"i4": "int32", "i8": "int64", "f4": "float32", "f8": "float64"}
_EVENT_SCHEMA = "int64 cycle  # the period that it happened in\nstring text\n"
_NOTES = {
    "cycle": "periods since the first",
    "time_ns": "when it woke, since the first deadline",
    "late_ns": "how late it woke",
    "stage_ns": ", ".join(STAGES),
    "cpu_ns": "processor time of the thread",
    "missed": "periods missed before this one",
    "status": "cause of a fault that began in this cycle; 0: none",
    "stop": "cause of the stop or fault that is under way; 0: none",
    "asked": "cause that was asked for before the cycle; 0: none",
    "mode": "0 idle, 1 armed, 2 running, 3 stopping, 4 stopped, 5 fault",
    "request": "to the drives: 0 braked, 1 enabled, 2 quick stop",
    "silent": "cycles since the rig has answered",
    "drive": "0 following, 1 ready, 2 off, 3 stopping quickly, 4 faulty",
    "drive_code": "the drives' own fault codes",
    "sample_age": "cycles since each IMU's sample was new",
    "sample_ns": "time of each IMU's sample on the rig's clock",
    "round_trip_ns": "of the exchange",
    "refused": "frames or packets that were refused since the start",
    "sent": "m/s, what was really sent",
    "event_count": "what happened in this cycle: how much, and of the first eight",
    "event_cause": "by number, controller/safety/watch.py",
    "event_index": "which leg or IMU; -1: none",
    "event_value": "in the unit of its cause; NaN: none",
    "event_limit": "which it broke; NaN: none",
    "imus": "which IMUs were used, a bit each, and the eighth for the platform's magnetometer",
    "trusted": "1: the pose is the whole-mechanism filter's",
    "angular_velocity": "rad/s, seven IMUs by three axes: 0-5 on the legs, 6 on the platform",
    "specific_force": "m/s^2",
    "magnetic_field": "uT",
    "position": "m, of {2} in {1}",
    "rotation": "row by row, maps {2} to {1}",
    "covariance": "row by row, of translation [m] and rotation [rad] in {1}",
    "residuals": "measured less predicted direction, six legs by three",
    "conditioning": "1 is best, 0 singular",
    "lengths": "m; 0 for legs that there are not",
    "reference": "six legs by length [m], rate [m/s], acceleration [m/s^2]",
    "command": "m/s",
    "truth": "position [m], quaternion (w first), lengths [m], currents [A]",
}


class RecordingError(GoughError, ValueError):
    """A file is no recording of gough, or one that this version cannot read."""


def schema() -> str:
    """The ROS 2 message definition of a cycle."""
    lines = []
    for name in RECORD.names or ():
        base, shape = RECORD.fields[name][0].base, RECORD.fields[name][0].shape  # type: ignore[index]
        count = f"[{int(np.prod(shape))}]" if shape else ""
        lines.append(f"{_CDR_TYPES[base.str[1:]]}{count} {name}  # {_NOTES[name]}\n")
    return "".join(lines)


class Recorder:
    """Writes cycles and events to an MCAP file.

    Args:
        path: the file, replaced if it exists.
        header: what a replay needs: `config` (JSON) and arrays by name.
        epoch_ns: Unix time of the first deadline [ns].
    """

    def __init__(self, path: Path, header: Mapping[str, Any], epoch_ns: int) -> None:
        self._file = path.open("wb")
        self._epoch = epoch_ns
        self._writer = Writer(self._file, chunk_size=_MOST_BYTES)
        self._writer.start(library=f"gough {header['config']['version']}")
        self._cycles = self._channel(_CYCLE_TOPIC, _CYCLE_SCHEMA, schema())
        self._events = self._channel(_EVENT_TOPIC, "gough/Event", _EVENT_SCHEMA)
        contents = {name: _saved(array) for name, array in header.items() if name != "config"}
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
        self._writer.add_metadata("gough", {"config": json.dumps(header["config"]), **digests})
        for name, content in contents.items():
            self._writer.add_attachment(0, 0, f"{name}.npy", "application/x-npy", content)
        self._known = {"imus": -1, "trusted": 0}
        self.flush()

    def _channel(self, topic: str, name: str, text: str) -> int:
        number = self._writer.register_schema(name, "ros2msg", text.encode())
        return int(self._writer.register_channel(topic, "cdr", number))

    def flush(self) -> None:
        """Complete the chunk: what has been written until now is in the file, whatever happens."""
        flush: Any = self._writer.flush
        flush()
        self._file.flush()

    def write(self, records: Record) -> None:
        """Append records (n,), dtype `RECORD`, and what is to be told of them."""
        self.write_cycles(records)
        times = self._epoch + records["time_ns"]
        told = (records["missed"] > 0) | (records["event_count"] > 0)
        for name, before in self._known.items():
            told |= np.diff(records[name], prepend=before) != 0
        for i in np.flatnonzero(told).tolist():
            for text in self._tell(records[i]):
                self.tell(int(records["cycle"][i]), text, int(times[i]))

    def write_cycles(self, records: Record) -> None:
        """Append records (n,) alone."""
        times = (self._epoch + records["time_ns"]).tolist()
        for i, at in enumerate(times):
            self._writer.add_message(self._cycles, at, _LITTLE_ENDIAN_CDR + records[i].tobytes(), at, int(records["cycle"][i]))

    def _tell(self, record: Record) -> Iterator[str]:
        if record["missed"] > 0:
            yield f"{record['missed']} periods missed"
        yield from events_of(record)
        magnetometer, trusted = int(record["imus"]) >> IMU_COUNT & 1, int(record["trusted"])
        if self._known["imus"] >= 0 and magnetometer != self._known["imus"] >> IMU_COUNT & 1:
            yield f"the magnetometer is {'used again' if magnetometer else 'left out: it is lost, frozen or disturbed'}"
        if trusted != self._known["trusted"]:
            yield (
                "the whole-mechanism filter is relied upon"
                if trusted
                else "the whole-mechanism filter is not relied upon: the leg filters disagree with it"
            )
        self._known = {"imus": int(record["imus"]), "trusted": trusted}

    def tell(self, cycle: int, text: str, time_ns: int | None = None) -> None:
        """Append an event."""
        at = time.time_ns() if time_ns is None else time_ns
        encoded = text.encode() + b"\0"
        data = _LITTLE_ENDIAN_CDR + cycle.to_bytes(8, "little", signed=True) + len(encoded).to_bytes(4, "little") + encoded
        self._writer.add_message(self._events, at, data, at)

    def close(self) -> None:
        """Complete the file with its index."""
        finish: Any = self._writer.finish
        finish()
        self._file.close()


def events_of(record: Record) -> Iterator[str]:
    """What happened in a cycle, in words."""
    count = int(record["event_count"])
    for i in range(min(count, EVENT_SLOTS)):
        cause, index, value, limit = (record[f"event_{name}"][i] for name in ("cause", "index", "value", "limit"))
        reaction = Cause(int(cause)).reaction
        how = f"{Reaction(reaction).text}: " if reaction != Reaction.GO_ON else ""
        yield how + Cause(int(cause)).describe(int(index), float(value), float(limit))
    if count > EVENT_SLOTS:
        yield f"and {count - EVENT_SLOTS} events more"


def _saved(array: Record) -> bytes:
    content = io.BytesIO()
    np.save(content, array)
    return content.getvalue()


def take(records: Record, link: NDArray[np.int64], tail: int) -> tuple[Record, int, int]:
    """Copy what the loop has written since record `tail`; returns it, the new tail, and how many were overwritten before."""
    capacity = len(records)
    head = int(link[Link.HEAD])
    first = max(tail, head - capacity)
    taken = records[np.arange(first, head) % capacity]
    # What the loop has begun to write over meanwhile is not to be trusted.
    sound = max(first, int(link[Link.HEAD]) - capacity + 1)
    return taken[max(sound - first, 0) :], head, min(sound, head) - tail


def record(path: Path, header: Mapping[str, Any], records: Record, link: NDArray[np.int64]) -> None:
    """Take the loop's records to a file until it is done; the body of the recorder's process."""
    supervisor = int(link[Link.SUPERVISOR])
    while not link[Link.HEAD] and not link[Link.DONE]:
        time.sleep(_POLL_S)
        if os.getppid() != supervisor:
            return
    recorder = Recorder(path, header, time.time_ns() - time.monotonic_ns() + int(link[Link.START]))
    tail, before = int(link[Link.TAIL]), int(link[Link.KEPT])
    count, flushed = 0, time.monotonic()
    while True:
        done = bool(link[Link.DONE]) or (os.getppid() != supervisor and _has_ended(link))
        taken, tail, lost = take(records, link, tail)
        if lost:
            recorder.tell(tail, f"{lost} cycles lost: the recorder came too late")
        recorder.write(taken)
        count += len(taken)
        ended = done and tail == link[Link.HEAD]
        if ended or time.monotonic() - flushed > _CHUNK_S:
            recorder.flush()
            link[Link.KEPT], link[Link.TAIL] = before + count, tail
            flushed = time.monotonic()
        if ended:
            break
        time.sleep(_POLL_S)
    recorder.close()


def _has_ended(link: NDArray[np.int64]) -> bool:
    """Whether the loop has stopped writing, when there is no supervisor any more to say so."""
    head = int(link[Link.HEAD])
    time.sleep(1.0)
    return head == int(link[Link.HEAD])


@dataclass(frozen=True, eq=False)
class Recording:
    """What a file holds.

    Attributes:
        config: what was run.
        arrays: what a replay needs, by name.
        records: (N,), dtype `RECORD`.
        events: cycle and text of each.
        epoch_ns: Unix time of the first deadline [ns].
        complete: whether the file was closed; if not, its end is what was last written out.
    """

    config: dict[str, Any]
    arrays: dict[str, Record]
    records: Record
    events: list[tuple[int, str]]
    epoch_ns: int
    complete: bool

    def constant(self, stage: str, name: str) -> Any:
        """A constant of the cycle that was recorded; the layout of version 0.1 had no stages."""
        parameters = self.arrays["parameters"]
        return parameters[stage][name] if stage in (parameters.dtype.names or ()) else parameters[name]


def read(path: Path | str) -> Recording:
    """Read a recording, also one that was cut short.

    Raises:
        RecordingError: no such file, no recording of gough, or one of another layout.
    """
    config: dict[str, Any] | None = None
    arrays: dict[str, Record] = {}
    cycles = bytearray()
    events: list[tuple[int, str]] = []
    topics: dict[int, str] = {}
    digests: dict[str, str] = {}
    layout, epoch, complete = "", 0, True
    try:
        for item in _items(path):
            if isinstance(item, Footer):
                break
            if isinstance(item, Schema) and item.name == _CYCLE_SCHEMA:
                layout = item.data.decode()
            elif isinstance(item, Channel):
                topics[item.id] = item.topic
            elif isinstance(item, Metadata) and item.name == "gough":
                config, digests = json.loads(item.metadata["config"]), item.metadata
            elif isinstance(item, Attachment):
                name = item.name.removesuffix(".npy")
                if hashlib.sha256(item.data).hexdigest() == digests.get(name):
                    arrays[name] = np.load(io.BytesIO(item.data))
            elif isinstance(item, Message) and topics[item.channel_id] == _CYCLE_TOPIC:
                if not cycles:
                    epoch = item.log_time - int(np.frombuffer(item.data[len(_LITTLE_ENDIAN_CDR) :], RECORD)[0]["time_ns"])
                cycles += item.data[len(_LITTLE_ENDIAN_CDR) :]
            elif isinstance(item, Message):
                text = item.data[len(_LITTLE_ENDIAN_CDR) :]
                events.append((int.from_bytes(text[:8], "little", signed=True), text[12:-1].decode()))
        else:
            complete = False
    except FileNotFoundError:
        raise RecordingError(f"there is no recording at {path}") from None
    except IsADirectoryError:
        raise RecordingError(f"{path} is a folder, no recording") from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
    except MemoryError:
        raise
    except Exception:
        # Whatever the decoder says of what follows the last chunk that is whole.
        complete = False
    if config is None:
        raise RecordingError(f"{path} is no recording of gough")
    if layout != schema() and (layout or cycles):
        raise RecordingError(
            f"{path} was recorded by gough {config.get('version')}, whose records are of another layout: use that"
        )
    return Recording(config, arrays, np.frombuffer(cycles, RECORD), events, epoch, complete)


def _items(path: Path | str) -> Iterator[Any]:
    with Path(path).open("rb") as file:
        yield from StreamReader(file, validate_crcs=True).records


def repair(path: Path) -> bool:
    """Complete a file that was cut short, in its place; returns whether it needed that.

    Raises:
        RecordingError: as `read`.
    """
    recording = read(path)
    if recording.complete:
        return False
    mended = path.with_name(f".{path.name}.mended")
    try:
        recorder = Recorder(mended, {"config": recording.config, **recording.arrays}, recording.epoch_ns)
        recorder.write_cycles(recording.records)
        for cycle, text in recording.events:
            recorder.tell(cycle, text)
        recorder.close()
        mended.replace(path)
    finally:
        mended.unlink(missing_ok=True)
    return True


def total(recordings: Iterable[Recording]) -> Record:
    """The records of consecutive files; those that a recorder wrote just before it died may be in the next file again."""
    parts: list[Record] = []
    last = -1
    for each in recordings:
        parts.append(each.records[each.records["cycle"] > last])
        last = max([last, *each.records["cycle"][-1:].tolist()])
    return np.concatenate(parts)
