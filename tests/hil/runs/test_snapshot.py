"""A simulation that goes on from a snapshot is the one that was never interrupted, to the bit."""

import hashlib
import os
import re
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from controller.cycle import STATE
from hil.command_line import main
from hil.loop.records import WORK
from hil.realtime.clock import CLOCK
from hil.runs.config import SimulationConfig
from hil.runs.simulation import SimulationStoppedError, simulate
from hil.runs.snapshot import read_snapshot, write_snapshot
from plant.encoder_readings import ENCODER_STATE
from plant.errors import GoughError, InputError
from plant.fmu.settings import Setting
from plant.imu import IMU_STATE
from tests.plant.fmu.foreign import BINDING, TRUTH

TIMED = ("time_ns", "late_ns", "stage_ns", "cpu_ns")
"""What of a record the machine's own time is in."""

MEMORY = {"imu": IMU_STATE, "encoders": ENCODER_STATE, "state": STATE, "clock": CLOCK, "work": WORK}
"""The arrays of a snapshot that have fields."""


def bits(records: np.ndarray) -> dict[str, bytes]:
    return {name: records[name].tobytes() for name in records.dtype.names if name not in TIMED}


LIVELY = SimulationConfig(
    target="sines", duration=2.0, seed=3, fusion="whole", magnetometer=True, settings=(Setting("payload.mass", (12.0,), 1.2),)
)


@pytest.mark.parametrize(
    ("config", "save_at"),
    [
        (LIVELY, 0.7),
        (replace(LIVELY, fusion="compiled", rate=250.0, imu="icm42688"), 1.5),
        (replace(LIVELY, joint_error=1e-4), -0.1),
        (replace(LIVELY, imu="icm42688-nominal", faults=("imu-offset:2,axis=x,size_deg_per_s=0.05,ramp_s=1,at=0.3",)), 0.7),
        (replace(LIVELY, lengths="incremental", faults=("encoder-jumps:2,size_mm=2,at=1",)), 0.7),
        (SimulationConfig(mechanism="planar-3rpr", duration=1.0, lengths="incremental"), 0.4),
    ],
)
def test_a_simulation_goes_on_to_the_bit(config: SimulationConfig, save_at: float, tmp_path: Path) -> None:
    """Before and after a payload changes, within the hold, and on the planar plant; through a file."""
    whole = simulate(config)
    first = simulate(config, save_at=save_at)
    assert first.snapshot is not None
    write_snapshot(first.snapshot, tmp_path / "state")
    kept = read_snapshot(tmp_path / "state")
    rest = simulate(SimulationConfig.from_plain(kept.config), resumed=kept)
    assert SimulationConfig.from_plain(kept.config) == config
    assert len(rest.records) == len(whole.records) - kept.cycle and 0 < kept.cycle < len(whole.records)
    assert bits(first.records) == bits(whole.records)
    assert bits(rest.records) == bits(whole.records[kept.cycle :])
    np.testing.assert_array_equal(rest.times, whole.times[kept.cycle :])
    assert rest.summary()["limits"]["violations"] == 0


def test_a_finished_run_goes_on_for_longer(tmp_path: Path) -> None:
    """The command line: what 'gough simulate --duration 1.5' would have done from 1 s on."""
    path = tmp_path / "state"
    assert main(["simulate", "--target", "hold", "--duration", "1", "--save-state", str(path)]) == 0
    assert main(["simulate", "--load-state", str(path), "--duration", "1.5", "--json", str(tmp_path / "rest.json")]) == 0
    snapshot = read_snapshot(path)
    rest = simulate(replace(SimulationConfig.from_plain(snapshot.config), duration=1.5), resumed=snapshot)
    whole = simulate(SimulationConfig(target="hold", duration=1.5))
    assert bits(rest.records) == bits(whole.records[snapshot.cycle :])


def refused(config: SimulationConfig, path: Path) -> str:
    with pytest.raises(GoughError) as caught:
        simulate(config, resumed=read_snapshot(path))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulationConfig, Path]:
    config, path = SimulationConfig(target="hold", duration=0.5), tmp_path_factory.mktemp("snapshot") / "state"
    snapshot = simulate(config, save_at=0.5).snapshot
    assert snapshot is not None
    write_snapshot(snapshot, path)
    return config, path


def test_what_does_not_go_together_is_refused(saved: tuple[SimulationConfig, Path], capsys: pytest.CaptureFixture[str]) -> None:
    config, path = saved
    assert "the end of its motion of 0.5 s: go on with a longer --duration" in refused(config, path)
    assert "mechanism, calibration, FMU or binding have changed" in refused(
        replace(config, mechanism="6-3-I", duration=1.0), path
    )
    assert "another motion was planned" in refused(replace(config, target="sines", duration=1.0), path)
    assert main(["simulate", "--load-state", str(path), "--rate", "500"]) == 2
    assert "the snapshot was taken with rate 1000.0, and cannot go on with 500.0: leave it out" in capsys.readouterr().err
    # What is given counts, even if it is the default.
    slower = simulate(replace(config, rate=500.0, duration=0.1), save_at=0.1).snapshot
    assert slower is not None
    write_snapshot(slower, path.with_name("slower"))
    assert main(["simulate", "--load-state", str(path.with_name("slower")), "--rate", "1000"]) == 2
    assert "the snapshot was taken with rate 500.0, and cannot go on with 1000.0: leave it out" in capsys.readouterr().err


@pytest.mark.parametrize("save_at", [-1.0, 0.6, np.nan])
def test_a_snapshot_beyond_the_motion_is_refused(save_at: float) -> None:
    with pytest.raises(InputError, match=f"a snapshot at {save_at:g} s is not within the motion: choose more than"):
        simulate(SimulationConfig(duration=0.5), save_at=save_at)


def test_other_files_are_refused(saved: tuple[SimulationConfig, Path], tmp_path: Path) -> None:
    content = saved[1].read_bytes()
    for broken in (b"", b"no snapshot", content[:-1], msgpack.packb([1, 2])):
        (tmp_path / "broken").write_bytes(broken)
        with pytest.raises(InputError, match="is no snapshot of 'gough simulate --save-state'"):
            read_snapshot(tmp_path / "broken")
    whole = msgpack.unpackb(content)
    for changes, said in (
        ({"version": "0.0.1"}, "is of gough 0.0.1, and this is gough"),
        ({"layout": b""}, "with another layout of the state: go on with the version that saved it, or simulate from the start"),
        ({"layout": None}, "with another layout of the state"),
        ({"digest": bytes(32)}, "is damaged, as its digest is not that of its content"),
        ({"content": whole["content"][:-1]}, "is damaged, as its digest is not that of its content"),
        ({"content": None}, "is damaged, as its digest is not that of its content"),
    ):
        (tmp_path / "broken").write_bytes(msgpack.packb(whole | changes))
        with pytest.raises(InputError, match=said):
            read_snapshot(tmp_path / "broken")
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 1
    (tmp_path / "broken").write_bytes(flipped)
    with pytest.raises(InputError, match="its digest is not that of its content"):
        read_snapshot(tmp_path / "broken")


def forged(saved: Path, path: Path, **changes: Any) -> Path:
    """A snapshot with other content, and its digest."""
    whole = msgpack.unpackb(saved.read_bytes())
    content = msgpack.packb(msgpack.unpackb(whole["content"]) | changes)
    path.write_bytes(msgpack.packb(whole | {"content": content, "digest": hashlib.sha256(content).digest()}))
    return path


def resumed(path: Path) -> None:
    snapshot = read_snapshot(path)
    simulate(replace(SimulationConfig.from_plain(snapshot.config), duration=0.6), resumed=snapshot)


def test_forged_parts_are_refused(saved: tuple[SimulationConfig, Path], tmp_path: Path) -> None:
    whole = msgpack.unpackb(msgpack.unpackb(saved[1].read_bytes())["content"])
    for changes, said in (
        ({"more": 1}, "missing or unknown parts"),
        ({"cycle": "1"}, "a snapshot whose cycle is of another kind"),
        ({"memory": []}, "a snapshot whose memory is of another kind"),
        ({"memory": whole["memory"] | {"imu": 1}}, "a snapshot whose memory.imu is of another kind"),
        ({"plant": None}, "a snapshot whose plant is of another kind"),
        ({"cycle": whole["cycle"] - 1}, "its state is that of cycle"),
        ({"plant": whole["plant"][:32] + struct.pack("<q", -5) + whole["plant"][40:]}, "after -5 changes: it has not so many"),
        ({"memory": whole["memory"] | {"imu": b""}}, "memory has another layout"),
        ({"config": whole["config"] | {"speed": 1}}, "no configuration of a simulation"),
        ({"plant": whole["plant"][:-1]}, "wrong size"),
    ):
        with pytest.raises(GoughError, match=said) as caught:
            resumed(forged(saved[1], tmp_path / "forged", **changes))
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="cannot read the snapshot"):
        read_snapshot(tmp_path / "missing")


@pytest.mark.parametrize(
    ("array", "path", "value"),
    [
        ("imu", "delay", 10**6), ("imu", "delay", -1), ("imu", "place", 10**9), ("imu", "magnetometer_every", 0),
        ("state", "safety.stop.cause", 21), ("state", "safety.mode", 3), ("state", "safety.events.count", -10**6),
        ("state", "safety.arming.obstacle", 10**6), ("state", "time.cycle", -1), ("clock", "mode", 1),
    ],
)  # fmt: skip
def test_memory_beyond_its_limits_is_refused(
    array: str, path: str, value: int, saved: tuple[SimulationConfig, Path], tmp_path: Path
) -> None:
    with pytest.raises(
        InputError, match=rf"in its {array} {re.escape(path)} is {value}, and must be at least .*: its file was"
    ):
        resumed(forged(saved[1], tmp_path / "forged", memory=changed(saved[1], array, path, value)))


def changed(saved: Path, array: str, path: str, value: float) -> dict[str, bytes]:
    """The memory of a snapshot with another value in one field."""
    memory: dict[str, bytes] = msgpack.unpackb(msgpack.unpackb(saved.read_bytes())["content"])["memory"]
    record = np.frombuffer(memory[array], MEMORY[array]).copy()
    *stages, name = path.split(".")
    field = record
    for stage in stages:
        field = field[stage]
    field[name] = value
    return memory | {array: record.tobytes()}


def test_a_wrong_place_in_the_reference_is_found_again(saved: tuple[SimulationConfig, Path], tmp_path: Path) -> None:
    config, path = saved
    wrong = forged(path, tmp_path / "forged", memory=changed(path, "state", "reference.index", 10**9))
    rest = [simulate(replace(config, duration=0.6), resumed=read_snapshot(each)).records for each in (path, wrong)]
    assert bits(rest[0]) == bits(rest[1])


@pytest.mark.endurance
def test_no_value_in_a_snapshot_ends_the_process(saved: tuple[SimulationConfig, Path]) -> None:
    done = subprocess.run([sys.executable, "-c", _TRY_ALL, str(saved[1])], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    assert int(done.stdout) > 500


_TRY_ALL = """
import sys
from dataclasses import replace
from pathlib import Path
import numpy as np
from hil.runs.config import SimulationConfig
from hil.runs.prepare import prepared_loop
from hil.runs.snapshot import read_snapshot, resume_snapshot
from plant.errors import GoughError
from tests.hil.runs.test_snapshot import MEMORY, changed

def fields(dtype, path=()):
    for name, (kind, *_) in dtype.fields.items():
        if kind.base.fields:
            yield from fields(kind.base, (*path, name))
        else:
            yield (*path, name), kind.base

path = Path(sys.argv[1])
good, tried = read_snapshot(path), 0
with prepared_loop(replace(SimulationConfig.from_plain(good.config), duration=0.6)) as loop:
    for array, dtype in MEMORY.items():
        for field, kind in fields(dtype):
            whole = kind.kind != "f"
            for value in (10**6, -1, -(2**62), 2**62) if whole else (float("nan"), float("inf")):
                if not whole or np.iinfo(kind).min <= value <= np.iinfo(kind).max:
                    print(array, *field, value, file=sys.stderr)
                    try:
                        resume_snapshot(replace(good, memory=changed(path, array, ".".join(field), value)), loop)
                        loop.run(good.cycle + 20)
                    except GoughError:
                        pass
                    tried += 1
print(tried)
"""


def test_a_time_without_a_file_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "--save-at", "1"]) == 2
    assert "add --save-state FILE" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"filters on filterpy .* cannot be saved"):
        simulate(SimulationConfig(fusion="filterpy", duration=0.5), save_at=0.2)


@pytest.mark.slow
def test_a_snapshot_goes_on_in_another_process_and_with_a_foreign_fmu(foreign_fmu: Path, tmp_path: Path) -> None:
    (tmp_path / "foreign.toml").write_text(BINDING + TRUTH)
    config = SimulationConfig(duration=0.6, plant=str(foreign_fmu), binding=str(tmp_path / "foreign.toml"))
    whole = simulate(config)
    snapshot = simulate(config, save_at=0.3).snapshot
    assert snapshot is not None
    write_snapshot(snapshot, tmp_path / "state")
    subprocess.run(
        [sys.executable, "-m", "hil.command_line", "simulate", "--load-state", "state", "--save-state", "end"],
        cwd=tmp_path, check=True, env=os.environ | {"PYTHONPATH": str(Path.cwd())},
    )  # fmt: skip
    end = read_snapshot(tmp_path / "end")
    assert end.cycle == len(whole.records)
    uninterrupted = simulate(config, save_at=0.6).snapshot
    assert uninterrupted is not None
    state = np.frombuffer(end.memory["state"], STATE)
    assert state.tobytes() == uninterrupted.memory["state"] and end.plant == uninterrupted.plant
    (tmp_path / "foreign.toml").write_text((BINDING + TRUTH).replace("sign = -1\n\n[drive_mode]", "sign = 1\n\n[drive_mode]"))
    with pytest.raises(InputError, match="FMU or binding have changed"):
        simulate(config, resumed=snapshot)


def test_a_run_that_fails_near_its_end_fails_and_gives_no_snapshot(tmp_path: Path) -> None:
    """A body that cannot be, so late that the loop has not stopped yet when the time is over."""
    impossible = Setting("payload.inertia", (1.0,), 0.05)
    with pytest.raises(SimulationStoppedError, match=r"changing a parameter failed: payload\.inertia is of no") as stopped:
        simulate(SimulationConfig(duration=0.1, settings=(impossible,)), save_at=0.1)
    assert stopped.value.result.snapshot is None
