"""Files: errors in TOML name file and entries, what is written appears whole, and temporary folders go."""

import os
import stat
import tempfile
from pathlib import Path

import pytest

from plant.errors import InputError
from plant.files import check_entries, check_writable, read_toml, temporary_folder, unknown_entries, write_whole


def test_a_file_is_read(tmp_path):
    path = tmp_path / "good.toml"
    path.write_text("[rig]\nname = 'µ'\n", encoding="utf-8")
    assert read_toml(path) == {"rig": {"name": "µ"}}


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, r"cannot read .*file\.toml: No such file"),
        (b"\xff", r"cannot read .*file\.toml: it is not UTF-8 text"),
        (b"[rig", r"file\.toml is not valid TOML: "),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, content, said):
    path = tmp_path / "file.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_toml(path)


def test_unknown_entries_are_named_with_the_known_ones_and_the_nearest():
    table = {"speed": 1, "mass": 2, "inertai": 3}
    assert unknown_entries(table, ("mass", "inertia"), "[body]") == [
        "[body] has no entry 'speed'; it has mass, inertia",
        "[body] has no entry 'inertai'; it has mass, inertia; did you mean 'inertia'?",
    ]
    check_entries({"mass": 2}, ("mass", "inertia"), "[body]")
    with pytest.raises(InputError, match=r"\[body\] has no entry 'speed'"):
        check_entries(table, ("mass", "inertia"), "[body]")


# ---- written whole or not at all ----


def test_a_file_is_replaced_whole_and_can_be_read_by_all(tmp_path):
    path = tmp_path / "result.bin"
    path.write_bytes(b"a longer content from before")
    path.chmod(0o600)
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o644
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_half_way_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "result.bin"
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(InputError, match=r"cannot write .*result\.bin: No space left on device"):
        write_whole(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_link_stays_one_and_its_target_is_written(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "target.bin", tmp_path / "link.bin"
    target.write_bytes(b"old")
    link.symlink_to(target)
    write_whole(link, b"new")
    assert link.is_symlink() and target.read_bytes() == b"new"
    assert list((tmp_path / "elsewhere").iterdir()) == [target]


def test_a_pipe_is_written_to_and_not_replaced(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(path, b"through")
        assert os.read(reader, 100) == b"through"
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(path.stat().st_mode)


def test_what_cannot_be_written_is_said_before(tmp_path):
    check_writable(tmp_path / "new.bin")
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(InputError, match=f"cannot write {tmp_path}: it is a folder"):
        check_writable(tmp_path)
    with pytest.raises(InputError, match=r"cannot write .*new\.bin: .*missing is no folder that can be written"):
        check_writable(tmp_path / "missing" / "new.bin")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file is no folder that can be written"):
        check_writable(tmp_path / "file" / "new.bin")


# ---- temporary folders ----


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_a_temporary_folder_ends_with_its_use_even_after_an_error(temporary):
    with pytest.raises(ZeroDivisionError), temporary_folder("gough-try-") as folder:
        assert folder.parent == temporary and folder.name.startswith("gough-try-")
        (folder / "content").write_text("some")
        raise ZeroDivisionError
    assert list(temporary.iterdir()) == []


def test_only_what_nobody_holds_and_has_the_prefix_is_swept_away(temporary):
    for name in ("gough-try-left", "other-left", "gough-try-unlocked"):
        (temporary / name).mkdir()
    for name in ("gough-try-left", "other-left"):
        (temporary / name / "gough.lock").write_text("")
    with temporary_folder("gough-try-") as held:
        assert not (temporary / "gough-try-left").exists()
        with temporary_folder("gough-try-") as second:
            assert held.is_dir() and second.is_dir() and held != second
        assert held.is_dir()
    # Without a lock the folder may be one that is just being made.
    assert sorted(each.name for each in temporary.iterdir()) == ["gough-try-unlocked", "other-left"]
