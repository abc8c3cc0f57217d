"""The FMU as a file: built once, the same to the byte, and an error in one line."""

import os
import struct
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from plant.errors import ToolchainError
from plant.fmu import build as export
from plant.fmu.build import PLANAR_MODEL, PLATFORMS, SPATIAL_MODEL, build_in_subprocess, default_fmu, model_of
from plant.mechanism import load_in_space


def test_the_default_fmu_is_built_once(fmu_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def build_again(path: Path, *_: Any) -> None:
        raise AssertionError(f"{path} exists already")

    monkeypatch.setattr(export, "_start_build", build_again)
    before = fmu_path.stat()
    assert default_fmu() == fmu_path
    assert (fmu_path.stat().st_ino, fmu_path.stat().st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.mark.slow
def test_a_build_is_the_same_to_the_byte_and_loads_no_casadi(fmu_path: Path, tmp_path: Path) -> None:
    """A fresh process with an empty cache builds the FMU again, in a process of its own."""
    code = "import sys, plant.fmu.build; path = plant.fmu.build.default_fmu(); print(path); print('casadi' in sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"GOUGH_CACHE": str(tmp_path / "cache")},
        check=True,
        capture_output=True,
        text=True,
    )
    path, casadi = run.stdout.splitlines()
    assert casadi == "False"
    assert Path(path).is_relative_to(tmp_path / "cache" / "fmus") and Path(path).parent.name == fmu_path.parent.name
    assert Path(path).read_bytes() == fmu_path.read_bytes()


def test_the_cache_key_follows_the_sources(monkeypatch: pytest.MonkeyPatch, fmu_path: Path, tmp_path: Path) -> None:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    monkeypatch.setattr(export, "version", lambda package: "0.0.0")

    def write(path: Path, *_: Any) -> None:
        path.write_text("built")

    monkeypatch.setattr(export, "_start_build", write)
    path = default_fmu()
    assert path.read_text() == "built"
    assert path.parent.name != fmu_path.parent.name


def refused_build(path: Path) -> str:
    with pytest.raises(ToolchainError) as caught:
        build_in_subprocess(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_missing_compiler_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    message = refused_build(tmp_path / "plant.fmu")
    assert "no C compiler (cc, gcc or clang) was found: install one" in message
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_failing_compiler_is_quoted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\necho 'In file included' >&2\necho 'plant.c:1: error: disk full' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert f"{compiler} could not compile the plant: plant.c:1: error: disk full" in refused_build(tmp_path / "plant.fmu")
    assert list(tmp_path.iterdir()) == [compiler]


def test_a_path_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    target = tmp_path / "no" / "such" / "folder" / "plant.fmu"
    assert f"cannot write {target}: {target.parent} is no folder" in refused_build(target)


def test_a_failed_write_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "plant.fmu").mkdir()
    assert "cannot write" in refused_build(tmp_path / "plant.fmu")
    assert [entry.name for entry in tmp_path.iterdir()] == ["plant.fmu"]


def test_the_plant_of_a_mechanism_follows_from_its_legs() -> None:
    assert (model_of(load_in_space("hexapod")), model_of(load_in_space("planar-3rpr"))) == (SPATIAL_MODEL, PLANAR_MODEL)
    for model, legs in ((SPATIAL_MODEL, 6), (PLANAR_MODEL, 3)):
        (command,) = (each for each in model.table.inputs if each.name == "velocity_command")
        assert command.shape == (legs,) and load_in_space(model.preset).legs == legs


def test_the_names_of_platforms_are_those_of_fmi() -> None:
    names = {each.folder: (each.folder_2, each.suffix) for platforms in PLATFORMS.values() for each in platforms}
    assert names == {
        "x86_64-linux": ("linux64", ".so"),
        "x86_64-windows": ("win64", ".dll"),
        "x86_64-darwin": ("darwin64", ".dylib"),
        "aarch64-darwin": ("darwin64", ".dylib"),
    }
    for platforms in PLATFORMS.values():
        for each in platforms:
            assert each.zig.partition("-")[0] == each.folder.partition("-")[0]


def test_libraries_of_two_processors_are_one_file_as_mach_o_has_it() -> None:
    """Little-endian libraries behind a big-endian table of processor, variant, place, size and alignment."""
    first = struct.pack("<3I", 0xFEEDFACF, 0x01000007, 3) + b"intel" * 4000
    second = struct.pack("<3I", 0xFEEDFACF, 0x0100000C, 0) + b"arm" * 11
    whole = export._universal([first, second])
    assert struct.unpack_from(">2I", whole) == (0xCAFEBABE, 2)
    for i, (library, processor, variant) in enumerate(((first, 0x01000007, 3), (second, 0x0100000C, 0))):
        found, kind, at, size, alignment = struct.unpack_from(">5I", whole, 8 + 20 * i)
        assert (found, kind, size) == (processor, variant, len(library))
        assert at % (1 << alignment) == 0 and 1 << alignment == 16384
        assert whole[at : at + size] == library


def test_a_library_of_windows_loses_its_time_and_nothing_else() -> None:
    library = bytearray(range(1, 251))
    struct.pack_into("<I", library, 0x3C, 0x80)
    kept = export._without_time(bytes(library))
    assert len(kept) == len(library)
    # Signature and two words of the header come before the stamp.
    changed = [i for i in range(len(library)) if kept[i] != library[i]]
    assert changed == [0x88, 0x89, 0x8A, 0x8B] and kept[0x88:0x8C] == bytes(4)


def test_an_archive_has_no_time_and_its_members_in_order(tmp_path: Path) -> None:
    contents = {"modelDescription.xml": b"first", "binaries/a": b"second" * 1000}
    path = tmp_path / "archive.fmu"
    path.write_bytes(export._archive(contents))
    with zipfile.ZipFile(path) as archive:
        assert {name: archive.read(name) for name in archive.namelist()} == contents
        assert archive.namelist()[0] == "modelDescription.xml"
        for entry in archive.infolist():
            assert entry.date_time == (1980, 1, 1, 0, 0, 0) and entry.external_attr >> 16 == 0o644
            assert entry.compress_type == zipfile.ZIP_DEFLATED
