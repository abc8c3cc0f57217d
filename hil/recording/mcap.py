"""Recordings: every cycle of a run in an MCAP file, and the process that writes it.

The loop writes its records into a ring buffer in shared memory and never waits. The recorder copies them to the file, and
counts those that were overwritten before. A record's layout is that of a ROS 2 message in CDR, so a message is the record's
bytes, and Foxglove and PlotJuggler open the file. Its attachments hold what a replay needs.
"""

import errno
import hashlib
import io
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.records import Attachment, Channel, Chunk, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer
from numpy.typing import NDArray

from controller.safety.causes import EVENT_SLOTS, Cause, Reaction
from hil.loop.records import RECORD, RECORD_FIELDS, Link
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.errors import GoughError
from plant.files import most_unpacked

_LITTLE_ENDIAN_CDR = b"\x00\x01\x00\x00"
_CYCLE_TOPIC, _EVENT_TOPIC = "/cycle", "/event"
_CYCLE_SCHEMA = "gough/Cycle"
_CHUNK_S = 0.25
_POLL_S = 0.05
_MOST_BYTES = 1 << 20
_MOST_CHUNK = 16 * _MOST_BYTES  # even if another tool has written the file anew
_NUMBERS = 1 << 32  # sequence numbers
_CDR_TYPES = {"i4": "int32", "i8": "int64", "f4": "float32", "f8": "float64"}
_EVENT_SCHEMA = "int64 cycle  # the period in which it happened\nstring text\n"


class RecordingError(GoughError, ValueError):
    """A file is not a recording of gough, or this version cannot read it."""


def schema() -> str:
    """The ROS 2 message definition of a cycle."""
    text = ""
    for name, kind, shape, note in RECORD_FIELDS:
        count = f"[{int(np.prod(shape))}]" if shape else ""
        text += f"{_CDR_TYPES[kind]}{count} {name}  # {note}\n"
    return text


def _layout(definition: str) -> list[str]:
    return [line.partition("#")[0].strip() for line in definition.splitlines()]


class Recorder:
    """Writes cycles and events to an MCAP file; an existing one is replaced.

    The header is what a replay needs: `config`, for JSON, and arrays by name. The epoch is the Unix time of the start [ns].
    """

    def __init__(self, path: Path, header: Mapping[str, Any], epoch_ns: int) -> None:
        self._path, self._size = path, 0
        self._file = path.open("wb")
        self._epoch = epoch_ns
        self._writer: Any = Writer(self._file, chunk_size=_MOST_BYTES)
        self._writer.start(library=f"gough {header['config']['version']}")
        self._cycles = self._channel(_CYCLE_TOPIC, _CYCLE_SCHEMA, schema())
        self._events = self._channel(_EVENT_TOPIC, "gough/Event", _EVENT_SCHEMA)
        contents = {name: _saved(array) for name, array in header.items() if name != "config"}
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
        self._writer.add_metadata("gough", {"config": json.dumps(header["config"]), **digests})
        for name, content in contents.items():
            self._writer.add_attachment(0, 0, f"{name}.npy", "application/x-npy", content)
        self._last = {"imus": -1, "trusted": 0}
        self.flush()

    def _channel(self, topic: str, name: str, text: str) -> int:
        number = self._writer.register_schema(name, "ros2msg", text.encode())
        return int(self._writer.register_channel(topic, "cdr", number))

    def flush(self) -> None:
        """Complete the chunk, so that all of it is in the file, whatever happens."""
        self._writer.flush()
        self._file.flush()
        self._size = self._file.tell()

    def check_file(self) -> None:
        """Check that the path still names the file that was begun, and that nothing of it has been cut off.

        Raises:
            OSError: with `errno.ESTALE`; it was deleted, cut or replaced.
        """
        with suppress(FileNotFoundError):
            ours = os.fstat(self._file.fileno())
            if os.path.samestat(ours, self._path.stat()) and ours.st_size >= self._size:
                return
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(self._path))

    def write(self, records: Record) -> None:
        """Append records (n,), dtype `RECORD`, and their events."""
        self.write_cycles(records)
        eventful = (records["missed"] > 0) | (records["event_count"] > 0)
        for name, before in self._last.items():
            eventful |= np.diff(records[name], prepend=before) != 0
        for record in records[eventful]:
            for text in self._news(record):
                self.write_event(int(record["cycle"]), text, self._epoch + int(record["time_ns"]))

    def write_cycles(self, records: Record) -> None:
        """Append records (n,) alone."""
        for record in records:
            at = self._epoch + int(record["time_ns"])
            number = int(record["cycle"]) % _NUMBERS
            self._writer.add_message(self._cycles, at, _LITTLE_ENDIAN_CDR + record.tobytes(), at, number)

    def _news(self, record: Record) -> Iterator[str]:
        """The events of a cycle, and what has changed since the last eventful one."""
        if record["missed"] > 0:
            yield f"{record['missed']} periods missed"
        yield from events_of(record)
        magnetometer, trusted = int(record["imus"]) >> IMU_COUNT & 1, int(record["trusted"])
        if self._last["imus"] >= 0 and magnetometer != self._last["imus"] >> IMU_COUNT & 1:
            yield f"the magnetometer is {'used again' if magnetometer else 'left out: it is lost, frozen or disturbed'}"
        if trusted != self._last["trusted"]:
            how = "relied upon" if trusted else "not relied upon: the leg filters disagree with it"
            yield f"the whole-mechanism filter is {how}"
        self._last = {"imus": int(record["imus"]), "trusted": trusted}

    def write_event(self, cycle: int, text: str, time_ns: int | None = None) -> None:
        """Append an event."""
        at = time.time_ns() if time_ns is None else time_ns
        encoded = text.encode() + b"\0"
        data = _LITTLE_ENDIAN_CDR + cycle.to_bytes(8, "little", signed=True) + len(encoded).to_bytes(4, "little") + encoded
        self._writer.add_message(self._events, at, data, at)

    def close(self) -> None:
        """Complete the file with its index."""
        self._writer.finish()
        self._file.close()


def events_of(record: Record) -> Iterator[str]:
    """The events of a cycle, in words."""
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


def _loaded(content: bytes) -> Record:
    """The array of `_saved`, or an error; memory is taken only for the size that it has."""
    file = io.BytesIO(content)
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    shape, _, dtype = read_header[np.lib.format.read_magic(file)](file)
    if prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError("an array of another size")
    file.seek(0)
    return np.load(file)


def take(records: Record, link: NDArray[np.int64], tail: int) -> tuple[Record, int, int]:
    """Copy what the loop has written since record `tail`: the records, the new tail, and how many were overwritten before."""
    capacity = len(records)
    head = int(link[Link.HEAD])
    first = max(tail, head - capacity)
    taken = records[np.arange(first, head) % capacity]
    # The loop may have begun to overwrite some of them meanwhile.
    intact = max(first, int(link[Link.HEAD]) - capacity + 1)
    return taken[max(intact - first, 0) :], head, min(intact, head) - tail


def record(path: Path, header: Mapping[str, Any], records: Record, link: NDArray[np.int64]) -> None:
    """Copy the loop's records to a file until it has ended; this is what the recorder's process runs.

    Raises:
        OSError: the file cannot be written; with `errno.ESTALE`, it was deleted, cut or replaced.
    """
    supervisor = int(link[Link.SUPERVISOR])
    while not link[Link.HEAD] and not link[Link.DONE]:
        time.sleep(_POLL_S)
        if os.getppid() != supervisor:
            return
    recorder = Recorder(path, header, time.time_ns() - time.monotonic_ns() + int(link[Link.START]))
    begin, kept_before, flushed = int(link[Link.TAIL]), int(link[Link.KEPT]), time.monotonic()
    tail, kept, unsaved = begin, kept_before, 0
    # The writer must not complete a chunk by itself: the next recorder would not know of it, and write it again.
    most = _MOST_BYTES // (3 * records.dtype.itemsize)
    ended = False
    while not ended:
        time.sleep(_POLL_S)
        done = bool(link[Link.DONE]) or (os.getppid() != supervisor and _has_ended(link))
        taken, tail, lost = take(records, link, tail)
        try:
            recorder.check_file()
        except OSError:
            # The next recorder writes what this file had, as far as it is in memory.
            link[Link.KEPT], link[Link.TAIL] = kept_before, begin
            raise
        if lost:
            recorder.write_event(tail, f"{lost} cycles lost: the recorder came too late")
        left = len(taken)
        for part in np.split(taken, range(most, len(taken), most)):
            recorder.write(part)
            kept, unsaved, left = kept + len(part), unsaved + len(part), left - len(part)
            ended = done and left == 0 and tail == link[Link.HEAD]
            if ended or unsaved >= most or time.monotonic() - flushed > _CHUNK_S:
                recorder.flush()
                link[Link.KEPT], link[Link.TAIL] = kept, tail - left
                flushed, unsaved = time.monotonic(), 0
    recorder.close()


def _has_ended(link: NDArray[np.int64]) -> bool:
    head = int(link[Link.HEAD])
    time.sleep(1.0)
    return head == int(link[Link.HEAD])


@dataclass(frozen=True, eq=False)
class Recording:
    """The content of a file."""

    config: dict[str, Any]  # what was run
    arrays: dict[str, Record]  # what a replay needs, by name
    records: Record  # (N,), dtype `RECORD`
    events: list[tuple[int, str]]  # cycle and text of each
    event_times_ns: list[int]  # Unix time of each [ns]
    epoch_ns: int  # Unix time of the first deadline [ns]
    complete: bool  # else it was not closed, and ends with its last whole chunk
    path: Path

    @property
    def version(self) -> str:
        """The version of gough that recorded it."""
        return str(self.config.get("version"))

    def constant(self, stage: str, name: str) -> Any:
        """A recorded constant of the cycle. The layout of version 0.1 had no stages."""
        parameters = self.arrays["parameters"]
        return parameters[stage][name] if stage in (parameters.dtype.names or ()) else parameters[name]


def read(path: Path | str) -> Recording:
    """Read a recording, even one that was cut short.

    Raises:
        RecordingError: there is no such file, it is not a recording of gough, its records have another layout, or it unpacks
            to far more than any recording.
    """
    config: dict[str, Any] | None = None
    arrays: dict[str, Record] = {}
    cycles = bytearray()
    events: list[tuple[int, str]] = []
    event_times_ns: list[int] = []
    topics: dict[int, str] = {}
    digests: dict[str, str] = {}
    layout, began, complete = "", 0, False
    try:
        for item in _items(path):
            if isinstance(item, Footer):
                complete = True
                break
            if isinstance(item, Schema) and item.name == _CYCLE_SCHEMA:
                layout = item.data.decode()
            elif isinstance(item, Channel):
                topics[item.id] = item.topic
            elif isinstance(item, Metadata) and item.name == "gough":
                content, digests = json.loads(item.metadata["config"]), item.metadata
                config = content if isinstance(content, dict) else None
            elif isinstance(item, Attachment):
                name = item.name.removesuffix(".npy")
                if hashlib.sha256(item.data).hexdigest() == digests.get(name):
                    with suppress(Exception):
                        arrays[name] = _loaded(item.data)
            elif isinstance(item, Message) and topics[item.channel_id] == _CYCLE_TOPIC:
                if not cycles:
                    began = item.log_time
                content = item.data[len(_LITTLE_ENDIAN_CDR) :]
                if len(content) != RECORD.itemsize:
                    break
                cycles += content
            elif isinstance(item, Message):
                text = item.data[len(_LITTLE_ENDIAN_CDR) :]
                events.append((int.from_bytes(text[:8], "little", signed=True), text[12:-1].decode()))
                event_times_ns.append(item.log_time)
    except FileNotFoundError:
        raise RecordingError(f"there is no recording at {path}") from None
    except IsADirectoryError:
        raise RecordingError(f"{path} is a folder, not a recording") from None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror}") from None
    except (MemoryError, RecordingError):
        raise
    except Exception:
        # Whatever the decoder raises for the part after the last whole chunk.
        pass
    if config is None:
        raise RecordingError(f"{path} is no recording of gough")
    if (layout or cycles) and _layout(layout) != _layout(schema()):
        raise RecordingError(
            f"{path} was recorded by gough {config.get('version')}, whose records have another layout than those of this gough "
            f"{version('gough')}: read it with the version that recorded it"
        )
    records: Record = np.frombuffer(cycles, RECORD)
    epoch = began - int(records["time_ns"][0]) if len(records) else 0
    return Recording(config, arrays, records, events, event_times_ns, epoch, complete, Path(path))


def _items(path: Path | str) -> Iterator[Any]:
    """The records of a file in their order, those of a chunk one by one."""
    size = Path(path).stat().st_size
    left = most_unpacked(size)
    with Path(path).open("rb") as file:
        for item in StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size).records:
            if not isinstance(item, Chunk):
                yield item
                continue
            left -= item.uncompressed_size
            if left < 0 or item.uncompressed_size > _MOST_CHUNK:
                raise RecordingError(
                    f"{path} has {size / 1e3:.0f} kB and would unpack to more than {most_unpacked(size) / 1e6:.0f} MB, or to "
                    f"{_MOST_CHUNK / 1e6:.0f} MB at once, as no recording does: it was forged or is damaged"
                )
            content = _UNPACK[item.compression](item.data, item.uncompressed_size)
            yield from breakup_chunk(replace(item, compression="", data=content), validate_crc=True)


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda content, _: content,
    "zstd": lambda content, size: zstandard.ZstdDecompressor().stream_reader(content).read(size),
    "lz4": lambda content, size: lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size),
}
"""How the content of a chunk is unpacked, to `size` bytes and never more; its checksum tells whether they are all."""


def repair(path: Path) -> bool:
    """Complete a file that was cut short, in place; returns whether it was. Raises as `read`."""
    recording = read(path)
    if recording.complete:
        return False
    mended = path.with_name(f".{path.name}.mended")
    try:
        recorder = Recorder(mended, {"config": recording.config, **recording.arrays}, recording.epoch_ns)
        recorder.write_cycles(recording.records)
        for (cycle, text), time_ns in zip(recording.events, recording.event_times_ns, strict=True):
            recorder.write_event(cycle, text, time_ns)
        recorder.close()
        mended.replace(path)
    finally:
        mended.unlink(missing_ok=True)
    return True


def read_run(paths: Sequence[Path | str]) -> tuple[list[Recording], Record]:
    """Read the consecutive files of one run: the recordings in their order, and all records.

    Each record comes once, although the last ones before a recorder dies may be in the next file again.

    Raises:
        RecordingError: as `read`; or the files are of different runs, hold no cycle, or lack the first one.
    """
    recordings = sorted((read(path) for path in paths), key=lambda each: each.records["cycle"][:1].tolist())
    where = ", ".join(map(str, paths))
    if any(each.config != recordings[0].config for each in recordings):
        raise RecordingError(f"{where} are of different runs: give the files of one")
    records = np.concatenate([each.records for each in recordings])
    records = records[np.diff(np.maximum.accumulate(records["cycle"]), prepend=-1) > 0]
    if not len(records):
        raise RecordingError(f"{where} holds no cycle: the run ended before its first one, or it is damaged")
    if records["cycle"][0] != 0:
        raise RecordingError(f"{where} does not begin with the first cycle of its run: give all of its files")
    return recordings, records
