"""The table of results: what was added is there, each key once, whenever a process died."""

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.sweep.store import DONE, FAILED, KEY, REASON, STATUS, TABLE, Store, rows_of
from plant.errors import InputError


def row(key: str, **values: Any) -> dict[str, Any]:
    return {KEY: key, STATUS: DONE, REASON: None, **values}


def rows(folder: Path) -> dict[str, dict[str, Any]]:
    table = Store(folder).table()
    found = {each[KEY]: each for each in table.to_pylist()}
    assert len(found) == len(table)
    return found


class Killed(BaseException):
    """A process dies here."""


STEPS = st.lists(
    st.one_of(
        st.lists(st.tuples(st.sampled_from("abcdef"), st.floats(allow_nan=False)), max_size=4),
        st.sampled_from(["compact", "again"]),
        st.integers(0, 5),
    ),
    max_size=12,
)


@given(steps=STEPS)
def test_the_last_row_of_each_key_is_there_wherever_the_process_died(
    steps: list[Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A step is rows to add, or to take all new rows into the table, or to open the folder again, or so many files after which
    the process dies while it does either."""
    folder, model = tmp_path_factory.mktemp("store"), dict[str, float]()
    stack = Store.opened(folder)
    store = stack.__enter__()
    for step in steps:
        if isinstance(step, list):
            store.add([row(key, x=value) for key, value in step])
            model.update(step)
        elif step == "compact":
            store.compact()
        else:
            if isinstance(step, int):
                die_after(step, store)
            stack.gen.close()
            stack = Store.opened(folder)
            store = stack.__enter__()
        assert {key: each["x"] for key, each in rows(folder).items()} == model
    stack.__exit__(None, None, None)
    assert sorted(each.name for each in folder.rglob("*")) == sorted(["lock", "new", *[TABLE] * bool(model)])
    if model:
        assert {each[KEY]: each["x"] for each in pq.read_table(folder / TABLE).to_pylist()} == model


def die_after(files: int, store: Store) -> None:
    """Die in the middle of taking new rows into the table: it is half written, or so many new files are gone."""
    if files == 0:
        (store.folder / f".{TABLE}.abc").write_bytes(b"half")
        return
    unlink, left = Path.unlink, iter(range(files - 1))

    def mortal(path: Path, missing_ok: bool = False) -> None:
        if path.parent.name == "new" and next(left, None) is None:
            raise Killed
        unlink(path, missing_ok)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "unlink", mortal)
        with suppress(Killed):
            store.compact()


def test_every_table_has_the_columns_of_a_row_s_fate(tmp_path: Path) -> None:
    assert Store(tmp_path).table().schema.names == [KEY, STATUS, REASON]
    with Store.opened(tmp_path) as store:
        store.add([row("a", x=1.0, n=2, word="w", yes=True, many=[1, 2])])
        store.add([{KEY: "b", STATUS: FAILED, REASON: "why", "x": 2}])
    assert Store(tmp_path).table().to_pylist() == [
        {KEY: "a", STATUS: DONE, REASON: None, "x": 1.0, "n": 2, "word": "w", "yes": True, "many": "[1, 2]"},
        {KEY: "b", STATUS: FAILED, REASON: "why", "x": 2.0, "n": None, "word": None, "yes": None, "many": None},
    ]


def test_rows_come_in_the_order_that_is_asked_for(tmp_path: Path) -> None:
    with Store.opened(tmp_path) as store:
        store.add([row(key) for key in "abc"])
        assert rows_of(store.table(), ["c", "z", "a"])[KEY].to_pylist() == ["c", "a"]


def test_many_files_become_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.sweep.store._MOST_FILES", 10)
    with Store.opened(tmp_path) as store:
        for number in range(25):
            store.add([row(str(number))])
            assert len(list(tmp_path.glob("new/*"))) < 10
        assert len(store.table()) == 25


def test_a_second_process_is_refused_until_the_first_has_died(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from hil.sweep.store import Store\n"
        "with Store.opened(Path(sys.argv[1])): print('open', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "open\n"
        with pytest.raises(InputError, match="another process writes results to"), Store.opened(tmp_path):
            pass
        other.kill()
        other.wait()
        with Store.opened(tmp_path) as store:
            store.add([row("a")])


def test_what_cannot_be_written_or_read_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write results to"), Store.opened(tmp_path / "file"):
        pass
    folder = tmp_path / "results"
    with Store.opened(folder) as store:
        store.add([row("a", x=1.0)])
        with pytest.raises(InputError, match="of several kinds"):
            store.add([row("b", x=1.0), row("c", x="text")])
        for _ in range(2):
            with pytest.raises(InputError, match=r"of several kinds in .*results .*give another folder"):
                store.add([row("b", x="text")])
        store.add([row("b", x=2)])
    with Store.opened(folder) as store:
        with pytest.raises(InputError, match="give another folder"):
            store.add([row("c", x="text")])
        assert store.table()["x"].to_pylist() == [1.0, 2.0]
    (folder / TABLE).write_bytes(b"no table")
    with pytest.raises(InputError, match=r"cannot read .*runs.parquet.*; move it away"):
        Store(folder).table()


@pytest.mark.skipif(os.geteuid() != 0, reason="a small file system needs root")
def test_a_full_disk_keeps_what_was_written(tmp_path: Path) -> None:
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=200k", "none", str(tmp_path)], capture_output=True, check=False)
    if done.returncode:
        pytest.skip("a file system cannot be mounted here")
    try:
        number = 0
        with pytest.raises(InputError, match="No space left on device"), Store.opened(tmp_path) as store:
            while True:
                store.add([row(f"{number:0500d}", x=float(number))])
                number += 1
        assert number > 10
        assert sorted(int(key) for key in rows(tmp_path)) == list(range(number))
    finally:
        # What the reader has mapped stays open until its memory is freed.
        subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)
