"""Compiled kernels and the cache that keeps them."""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba.core.compiler import run_frontend
from numba.extending import lower_builtin, type_callable

from controller.cycle import run_stages
from controller.estimation.integrity.stage import step_integrity
from plant.compiled import hash_of_files, kernel, keyed_folder, shortcuts, user_cache
from plant.compiled.cache import STALE_AFTER_S
from plant.compiled.kernels import PACKAGES, WITHOUT_KERNELS
from plant.compiled.linking import flat_linking, linked_flat


@kernel
def _ratio(a: float, b: float) -> float:
    return a / b


@kernel
def _twice(a: float) -> float:
    return _ratio(a, 0.5)


@kernel
def _faculty(n: int) -> int:
    return n * _faculty(n - 1) if n > 1 else 1


@kernel
def _is_nan(a: float) -> bool:
    return a != a


def test_a_kernel_divides_by_zero_as_numpy_does() -> None:
    assert _ratio(1.0, 0.0) == np.inf
    assert np.isnan(_ratio(0.0, 0.0))


def test_a_kernel_can_tell_nan() -> None:
    assert _is_nan(np.nan) and not _is_nan(np.inf)


def test_a_kernel_serves_python_and_other_kernels() -> None:
    assert _twice(3.0) == 6.0
    assert _ratio(3.0, 0.5) == 6.0
    assert _faculty(5) == 120


def test_a_function_of_numba_alone_calls_kernels_and_is_called_as_ever() -> None:
    @numba.njit  # type: ignore[untyped-decorator]
    def alone(values: Any) -> Any:
        return _twice(values.sum()) + np.linalg.norm(values)

    assert alone(np.array([3.0, 4.0])) == 19.0


@kernel
def _assign(target: Any, source: Any) -> None:
    target[:] = source


def test_arrays_whose_shapes_differ_are_refused_in_few_words() -> None:
    target = np.zeros(3)
    _assign(target, np.arange(3.0))
    assert list(target) == [0.0, 1.0, 2.0]
    with pytest.raises(ValueError, match="the shapes of an array and of what is assigned to it differ"):
        _assign(target, np.arange(4.0))


def test_numba_is_as_ever_when_nothing_compiles() -> None:
    before = [getattr(owner, name) for owner, name, _ in shortcuts._SHORTCUTS]
    with pytest.raises(InterruptedError), flat_linking():
        assert all(getattr(owner, name) is shortcut for owner, name, shortcut in shortcuts._SHORTCUTS)
        raise InterruptedError
    assert [getattr(owner, name) for owner, name, _ in shortcuts._SHORTCUTS] == before


@kernel
def _with_a_function_of_its_own(a: float) -> float:
    def more(b: float) -> float:
        return a + b

    return more(2.0)


def test_a_kernel_may_define_a_function_of_its_own() -> None:
    assert _with_a_function_of_its_own(3.0) == 5.0


def test_what_numba_learns_while_kernels_compile_serves_the_next() -> None:
    def learned(a: float) -> float:
        return a + a

    with flat_linking():
        assert numba.njit(lambda a: 2.0 * a)(3.0) == 6.0
        type_callable(learned)(lambda context: lambda a: numba.float64)
        lower_builtin(learned, numba.float64)(lambda context, builder, signature, values: builder.fadd(*2 * values))
        assert numba.njit(lambda a: learned(a))(3.0) == 6.0


@pytest.mark.parametrize("function", [run_stages, step_integrity, _ratio])
def test_the_variables_of_instructions_are_those_that_numba_finds(function: Any) -> None:
    blocks = run_frontend(function.py_func).blocks.values()
    instructions = [instruction for block in blocks for instruction in block.body]
    assert all(shortcuts._variables(each, vars(each)) == each._rec_list_vars(vars(each)) for each in instructions)
    assert sum(len(shortcuts._variables(each, vars(each))) for each in instructions) > len(instructions)


def test_no_ctrl_c_is_lost_while_a_kernel_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """What Python raises in a function that compiled code calls back ends there, and is reported unless it is a Ctrl-C."""
    reported: list[Any] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda unraisable: reported.append(unraisable.exc_type))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    called: list[str] = []

    def compile_with_callback(signature: Any) -> str:
        ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
        called.append(signature)
        return "compiled"

    def compile_with_error(signature: Any) -> str:
        ctypes.CFUNCTYPE(None)(lambda: 1 // 0)()
        return "compiled"

    try:
        with pytest.raises(KeyboardInterrupt):
            linked_flat(compile_with_callback)("while it compiles")
        assert reported == []
        assert linked_flat(compile_with_error)("with an error") == "compiled"
        assert reported == [ZeroDivisionError]
        assert called and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert linked_flat(lambda signature: "compiled")("again") == "compiled"
        # A handler of another kind, as a run has it, stays where it is.
        signal.signal(signal.SIGINT, lambda number, frame: called.append("heard"))
        assert linked_flat(compile_with_callback)("in a run") == "compiled"
        assert called[1:] == ["heard", "in a run"]
    finally:
        signal.signal(signal.SIGINT, before)


def test_the_cache_is_where_the_user_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path / "own"))
    assert user_cache() == tmp_path / "own"
    monkeypatch.delenv("GOUGH_CACHE")
    assert user_cache() == tmp_path / "xdg" / "gough"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_cache() == tmp_path / ".cache" / "gough"


def test_the_hash_changes_with_content_name_order_and_extra(tmp_path: Path) -> None:
    a, b, c = tmp_path / "a", tmp_path / "b", tmp_path / "c"
    for file, text in ((a, "one"), (b, "two"), (c, "one")):
        file.write_text(text)
    key = hash_of_files([a, b], "1.0")
    assert len(key) == 20 and int(key, 16) >= 0
    assert key == hash_of_files([a, b], "1.0")
    others = [[a, b], "1.1"], [[b, a], "1.0"], [[c, b], "1.0"], [[a], "1.0"]
    assert len({key, *(hash_of_files(files, extra) for files, extra in others)}) == 5  # type: ignore[arg-type]
    b.write_text("twp")
    assert hash_of_files([a, b], "1.0") != key


def test_folders_long_unused_are_swept_away(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    old, recent, elsewhere = tmp_path / "things/old", tmp_path / "things/recent", tmp_path / "others/old"
    for folder in (old, recent, elsewhere):
        folder.mkdir(parents=True)
    (old / "file").write_text("x")
    now = old.stat().st_mtime
    os.utime(old, (now - STALE_AFTER_S - 60.0,) * 2)
    os.utime(recent, (now - STALE_AFTER_S + 60.0,) * 2)
    os.utime(elsewhere, (now - STALE_AFTER_S - 60.0,) * 2)
    current = keyed_folder("things", "current")
    assert not old.exists()
    assert recent.exists() and current.exists() and elsewhere.exists()


def test_use_keeps_a_folder_fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    folder = tmp_path / "things/key"
    folder.mkdir(parents=True)
    (folder / "file").write_text("x")
    os.utime(folder, (1.0, 1.0))
    assert keyed_folder("things", "key") == folder
    assert folder.stat().st_mtime > 1.0
    assert (folder / "file").exists()


def test_a_folder_takes_as_long_to_find_among_thousands(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    looked = []
    listed = Path.iterdir
    monkeypatch.setattr(Path, "iterdir", lambda folder: looked.append(folder) or listed(folder))
    for number in range(20):
        keyed_folder("things", str(number % 3))
    keyed_folder("others", "0")
    assert looked == [tmp_path / "things", tmp_path / "others"]


def test_a_cache_that_cannot_be_written_gives_way_to_temporary_files(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    folder = keyed_folder("things", "key")
    assert folder.is_relative_to(tmp_path / "temporary") and folder.is_dir()
    assert keyed_folder("things", "key") == folder


@pytest.mark.slow
def test_machine_code_is_kept_in_the_cache_alone(tmp_path: Path) -> None:
    """A fresh process compiles into the cache folder; the next one compiles nothing, nor does one on a copy of the sources."""
    code = (
        "import numpy as np; from plant.pose import rotation_from_quaternion as r; r(np.array([1.0, 0.0, 0.0, 0.0]));"
        "print(sum(r.stats.cache_hits.values()), sum(r.stats.cache_misses.values()))"
    )
    package = Path(__file__).resolve().parents[2] / "plant"
    before = sorted(package.rglob("*.nb?"))
    for each in PACKAGES:
        shutil.copytree(package.parent / each, tmp_path / "copy" / each, ignore=shutil.ignore_patterns("__pycache__"))
    said = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"GOUGH_CACHE": str(tmp_path)},
            cwd=folder,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()
        for folder in (package.parent, package.parent, tmp_path / "copy")
    ]
    assert said == [["0", "1"], ["1", "0"], ["1", "0"]]
    assert len(list((tmp_path / "kernels").iterdir())) == 1
    assert list((tmp_path / "kernels").rglob("*.nbc"))
    assert sorted(package.rglob("*.nb?")) == before


@pytest.mark.slow
def test_machine_code_that_calls_other_kernels_is_loaded_whole(tmp_path: Path) -> None:
    """The callees have no machine code of their own in the cache; the next process finds them in their caller's."""
    code = (
        "import os; {}"
        "from plant.mechanism import load_mechanism; from controller.imu_set import check_imus, find_conditionings;"
        "from controller.estimation.pose_estimator import find_pose;"
        "print(check_imus(load_mechanism('hexapod'), range(7)), sum(find_pose.stats.cache_misses.values()));"
        "assert len(find_conditionings.overloads) == 1, 'not loaded for the types of the call'"
    )
    on_one_core = "os.sched_setaffinity(0, [min(os.sched_getaffinity(0))]);"
    said = [
        subprocess.run(
            [sys.executable, "-c", code.format(cores)],
            env=os.environ | {"GOUGH_CACHE": str(tmp_path / cache)},
            cwd=Path(__file__).resolve().parents[2],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()
        for cores, cache in ((on_one_core, "a"), (on_one_core, "a"), ("", "b"))
    ]
    assert said[0][0] == said[1][0] == said[2][0] and float(said[0][0]) > 0.0
    # Other processes compile where there are several cores.
    assert [each[1] for each in said] == ["1", "0", "0" if len(os.sched_getaffinity(0)) > 1 else "1"]


SHARED = """
from plant.compiled import filled, kernel, record_dtype, shared_kernel

DTYPE = record_dtype(count=int, values=(float, 3))

@kernel
def scaled(values, by):
    return by * values.sum()

@shared_kernel
def inner(record, by) -> float:
    record.count += 1
    return scaled(record.values, by) / record.count

@shared_kernel
def middle(record) -> float:
    return inner(record, 2.0) + inner(record, by=2.0)

@kernel
def first(records):
    return middle(records[()]) - 1.0

@kernel
def second(records):
    return middle(records[()]) + inner(records[()], 1.0)
"""


@pytest.mark.slow
def test_a_shared_kernel_is_compiled_once_for_all_callers_and_processes(tmp_path: Path) -> None:
    """Whichever is compiled first, and if the machine code of the shared ones is lost, those of their callers remain."""
    (tmp_path / "shared_example.py").write_text(SHARED)
    cache = tmp_path / "cache"

    def called(*names: str, before: str = "", after: str = "") -> list[str]:
        """What comes out, and what was compiled for it."""
        code = (
            "import numba; from numba.core import event; from shared_example import *; compiled = []\n"
            "class Listener(event.Listener):\n"
            "    def on_start(self, event): compiled.append(event.data['dispatcher'].py_func.__name__)\n"
            "    def on_end(self, event): pass\n"
            f"{before}\n"
            "with event.install_listener('numba:compile', Listener()):\n"
            f"    for each in ({', '.join(names)},): print(each(filled(DTYPE, values=(1.0, 2.0, 3.0))))\n"
            f"    {after}\n"
            "print(*(each for each in compiled if each in ('inner', 'middle', 'first', 'second')))"
        )
        paths = os.pathsep.join((str(tmp_path), str(Path(__file__).resolve().parents[2])))
        environment = os.environ | {"GOUGH_CACHE": str(cache), "PYTHONPATH": paths}
        run = subprocess.run([sys.executable, "-c", code], env=environment, check=True, capture_output=True, text=True)
        return run.stdout.splitlines()

    alone = "numba.njit(lambda records: middle(records[()]))"
    assert called("first", alone) == ["17.0", "18.0", "first middle inner"]
    assert called("first", "second") == ["17.0", "20.0", "second"]
    assert called("second", "first") == ["20.0", "17.0", ""]
    for lost in cache.rglob("shared_example.inner-*"):
        lost.unlink()
    assert called("second", before="numba.njit(lambda: 1)()") == ["20.0", "inner"]
    assert called("inner.py_func", "first", before="inner.py_func = lambda record: 0.0") == ["0.0", "17.0", ""]


@pytest.mark.slow
def test_an_edit_where_kernels_are_gives_a_new_folder(tmp_path: Path) -> None:
    """The sources are copied, one file is edited, and the kernels of another file move to another folder."""
    root = Path(__file__).resolve().parents[2]
    copy = tmp_path / "copy"
    for package in ("plant", "controller", "hil"):
        shutil.copytree(root / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    code = "from plant.compiled.kernels import _kernel_folder; print(_kernel_folder().name)"

    def key() -> str:
        run = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"GOUGH_CACHE": str(tmp_path / "cache"), "PYTHONPATH": str(copy)},
            cwd=copy,
            check=True,
            capture_output=True,
            text=True,
        )
        return run.stdout.strip()

    first = key()
    assert key() == first
    shown = copy / "hil" / "reports" / "page.py"
    shown.write_text(shown.read_text() + "# edited\n")
    assert key() == first
    edited = copy / "controller" / "pid.py"
    edited.write_text(edited.read_text() + "# edited\n")
    assert key() != first


def test_rooms_that_leave_machine_code_as_it_is_serve_no_kernel() -> None:
    root = Path(__file__).resolve().parents[2]
    sources = {file: file.read_text() for package in PACKAGES for file in (root / package).rglob("*.py")}
    rooms = "|".join(WITHOUT_KERNELS)
    with_kernels = {
        file: text for file, text in sources.items() if re.search(r"^\s*@(shared_)?kernel|record_dtype\(", text, re.MULTILINE)
    }
    assert len(with_kernels) > 50
    for file, text in with_kernels.items():
        assert file.parent.name not in WITHOUT_KERNELS or file.name == "kernels.py", file
        assert not re.search(rf"^(from|import) hil\.({rooms})\b", text, re.MULTILINE), file
