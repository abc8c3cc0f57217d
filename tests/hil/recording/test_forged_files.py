"""Recordings that lie: what they claim is checked before memory is taken for it, and before compiled code sees it."""

import io
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zstandard

from controller.cycle import PARAMETER_LIMITS, PARAMETERS
from hil.loop.records import RECORD
from hil.recording import mcap
from hil.recording.mcap import Recorder, RecordingError, read
from hil.recording.replay import replay
from hil.recording.replay_rig import ReplayRig
from hil.rigs import BRAKED, SILENT, RigError, new_feedback
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop

CONFIG = {"version": "0.0.1", "run": "1", "rate": 1000.0, "mechanism_name": "hexapod", "target": "circle", "rig": "fmu"}
CYCLES = 20
REFERENCE = np.zeros((6, 2, 5))


@pytest.fixture(scope="module")
def parameters():
    """Parameters of a real cycle with every filter."""
    with prepared_loop(SimulationConfig(target="hold", duration=0.1, fusion="whole-alignments", magnetometer=True)) as loop:
        return loop.parameters.copy()


def records_of(count=CYCLES):
    records = np.zeros(count, RECORD)
    records["cycle"] = np.arange(count)
    records["time_ns"] = records["cycle"] * 1_000_000
    for name in ("angular_velocity", "specific_force", "magnetic_field"):
        records[name] = np.random.default_rng(0).normal(size=(count, 7, 3))
    return records


def written(path, parameters, reference=REFERENCE, records=None, **config):
    recorder = Recorder(path, {"config": CONFIG | config, "parameters": parameters, "reference": reference}, 0)
    recorder.write_cycles(records_of() if records is None else records)
    recorder.close()
    return path


def chunk(size, content):
    """A chunk of zstd that claims to unpack to `size` bytes."""
    body = struct.pack("<QQQI", 0, 0, size, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(content)) + content
    return b"\x06" + struct.pack("<Q", len(body)) + body


def test_a_recording_that_unpacks_without_end_is_refused(tmp_path, parameters):
    path, zeros = (
        written(tmp_path / "run.mcap", parameters),
        zstandard.compress(b"\xff" + struct.pack("<Q", (8 << 20) - 9) + bytes((8 << 20) - 9)),
    )
    content = path.read_bytes()
    for bomb in (chunk(8 << 20, zeros) * 40, chunk(1 << 40, zeros)):
        forged = tmp_path / "bomb.mcap"
        forged.write_bytes(content[:8] + bomb + content[8:])
        with pytest.raises(
            RecordingError, match=r"would unpack to more than \d+ MB, or to 17 MB at once, as no recording does"
        ):
            read(forged)


def test_a_chunk_gives_no_more_than_it_claims(tmp_path, parameters):
    content = written(tmp_path / "run.mcap", parameters).read_bytes()
    for name, bomb in (("zstd", zstandard.compress(bytes(64 << 20))), ("lz4", mcap.lz4.frame.compress(bytes(64 << 20)))):
        assert mcap._UNPACK[name](bomb, 100) == bytes(100)
    (tmp_path / "lies.mcap").write_bytes(content[:8] + chunk(100, zstandard.compress(bytes(64 << 20))) + content[8:])
    with pytest.raises(RecordingError, match="is no recording of gough"):
        read(tmp_path / "lies.mcap")


def test_arrays_and_cycles_of_another_size_than_they_claim_are_left_out(tmp_path, parameters, monkeypatch):
    huge = io.BytesIO()
    np.lib.format.write_array_header_1_0(huge, {"descr": "<f8", "fortran_order": False, "shape": (6, 10**12, 5)})
    with monkeypatch.context() as patch:
        patch.setattr(mcap, "_saved", lambda array: huge.getvalue() + bytes(80))
        path = written(tmp_path / "array.mcap", parameters)
    assert not read(path).arrays
    with pytest.raises(RecordingError, match="lacks what a replay needs"):
        replay([path])
    with monkeypatch.context() as patch:
        patch.setattr(mcap, "_LITTLE_ENDIAN_CDR", b"\0\1\0\0more")
        path = written(tmp_path / "cycles.mcap", parameters)
    assert len(read(path).records) == 0


@pytest.mark.parametrize("path", PARAMETER_LIMITS)
def test_parameters_beyond_their_limits_are_refused(path, parameters, tmp_path):
    for value in (PARAMETER_LIMITS[path][0] - 1, min(PARAMETER_LIMITS[path][1] + 1, 10**6)):
        if PARAMETER_LIMITS[path][0] <= value <= PARAMETER_LIMITS[path][1]:
            continue
        forged = parameters.copy()
        *stages, name = path.split(".")
        field = forged
        for stage in stages:
            field = field[stage]
        field[name] = value
        with pytest.raises(RecordingError, match=rf"run.mcap cannot be replayed, as {path} is {value}, and must be at least"):
            replay([written(tmp_path / "run.mcap", forged)])


@pytest.mark.parametrize(
    "reference",
    [
        np.zeros((6, 5)),
        np.zeros((5, 2, 5)),
        np.zeros((6, 0, 5)),
        np.zeros((6, 2, 4)),
        np.zeros((6, 2, 5), np.float32),
        np.zeros(()),
    ],
)
def test_a_reference_of_another_shape_is_refused(reference, parameters, tmp_path):
    with pytest.raises(RecordingError, match=r"its reference is float\d+ \(.*\), and must be float64 \(6, n, 5\)"):
        replay([written(tmp_path / "run.mcap", parameters, reference)])


def test_parameters_of_another_shape_and_causes_that_there_are_not_are_refused(parameters, tmp_path):
    with pytest.raises(RecordingError, match=r"its parameters have the shape \(2,\), and must have none"):
        replay([written(tmp_path / "run.mcap", np.array([parameters, parameters]))])
    for name, value in (("asked", 10**6), ("status", -3), ("missed", -1)):
        records = records_of()
        records[name][7] = value
        with pytest.raises(RecordingError, match=f"as {name} is {value}, and must be at least 0"):
            replay([written(tmp_path / "run.mcap", parameters, records=records)])


def test_a_rig_plays_a_recording_with_a_gap_as_long_as_it_likes_and_asks_for_its_rate(parameters, tmp_path):
    records = records_of()
    records["cycle"][3:] += 2**31
    rig, feedback = ReplayRig(written(tmp_path / "gap.mcap", parameters, records=records), 1e-3), new_feedback()
    rig.open()
    statuses = [rig.exchange(np.zeros(6), BRAKED, feedback) for _ in range(10)]
    assert statuses == [0, 0, 0, *[SILENT] * 7]
    for rate in (None, "fast", [1]):
        rig = ReplayRig(written(tmp_path / "rate.mcap", parameters, rate=rate), 1e-3)
        with pytest.raises(RigError, match="does not say at what rate it was recorded"):
            rig.open()
    with pytest.raises(RigError, match="was recorded at nan Hz"):
        ReplayRig(written(tmp_path / "rate.mcap", parameters, rate=float("nan")), 1e-3).open()


_TRY_ALL = """
import sys
import numpy as np
from pathlib import Path
from controller.cycle import PARAMETERS
from hil.recording.mcap import RecordingError
from hil.recording.replay import replay
from tests.hil.recording.test_forged_files import written

def fields(dtype, path=()):
    for name, (kind, *_) in dtype.fields.items():
        if kind.fields:
            yield from fields(kind, (*path, name))
        else:
            yield (*path, name)

parameters = np.load(sys.argv[1])
tried = 0
for path in fields(PARAMETERS):
    for value in (10**6, -1, -(2**62), float("nan")):
        forged = np.zeros((), PARAMETERS)
        forged[()] = parameters
        field = forged
        for name in path[:-1]:
            field = field[name]
        if field.dtype[path[-1]].base.kind == "f" or value == value:
            field[path[-1]] = value
        print(*path, value, file=sys.stderr)
        try:
            replay([written(Path(sys.argv[2]), forged)])
        except RecordingError:
            pass
        tried += 1
print(tried)
"""


@pytest.mark.endurance
def test_no_value_of_any_parameter_ends_the_process(parameters, tmp_path):
    np.save(tmp_path / "parameters.npy", parameters)
    command = [sys.executable, "-c", _TRY_ALL, str(tmp_path / "parameters.npy"), str(tmp_path / "run.mcap")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path.cwd())
    assert done.returncode == 0, done.stderr[-500:]
    assert int(done.stdout) > 4 * len(PARAMETERS.names)
