"""A batch on a worker: who builds what all need."""

import math
from importlib.metadata import version
from pathlib import Path

import pytest

from hil.engine.batches import Batch, Failure, _prepared, fingerprint, run_batch
from plant.errors import InputError


def refuses_odd(number: int) -> int:
    if number % 2:
        raise InputError(f"{number} is odd")
    return number


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("GOUGH_CACHE", str(tmp_path))
    return tmp_path


def test_what_all_need_counts_as_built_when_a_run_has_succeeded(cache: Path) -> None:
    """The first run of a process may fail before anything is built; the next process must then not build beside others."""

    def done() -> bool:
        return bool([*cache.glob("prepared/*/done")])

    failed = run_batch(refuses_odd, [1], ["odd or even"], fingerprint())
    assert isinstance(failed, Batch) and isinstance(failed.results[0], Failure) and math.isnan(failed.seconds)
    assert not done()
    _prepared.discard("odd or even")  # as in the next process
    batch = run_batch(refuses_odd, [2, 3, 4], ["odd or even"] * 3, fingerprint())
    assert isinstance(batch, Batch) and batch.results[::2] == [2, 4] and 0.0 < batch.seconds < 1.0
    assert done()


def test_the_fingerprint_has_the_libraries_of_all_filters(monkeypatch: pytest.MonkeyPatch) -> None:
    known = fingerprint()
    for library in ("filterpy", "scipy", "vqf", "llvmlite", "fmpy"):
        monkeypatch.setattr("hil.engine.batches.version", lambda name, other=library: "0" if name == other else version(name))
        assert fingerprint.__wrapped__() != known
    monkeypatch.setattr("hil.engine.batches.version", version)
    assert fingerprint.__wrapped__() == known
    monkeypatch.setattr("hil.engine.batches.python_version", lambda: "3.0")
    assert fingerprint.__wrapped__() != known
