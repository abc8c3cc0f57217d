"""The FMU as a file: built once, the same to the byte, and an error in one line."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from plant.errors import ToolchainError
from plant.fmu import build as export
from plant.fmu.build import build_in_subprocess, default_fmu


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
