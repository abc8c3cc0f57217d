"""The engine of all studies: the same results, in order, from this process and from others; and when others are started."""

import os
import socket
import subprocess
import sys
import time
from functools import partial

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.engine.batches import Failure
from hil.engine.engine import IN_ONE_PROCESS, InOneProcess, engine_when_needed, open_engine
from hil.engine.settings import EngineSettings
from hil.runs.simulation import SimulationStoppedError
from plant.errors import GoughError, InputError, MissingPackageError, UnreachableError
from plant.mechanism import load_mechanism

TWO = EngineSettings(workers=2, dashboard="127.0.0.1:0")
NOBODY = EngineSettings(scheduler="tcp://127.0.0.1:9")


@pytest.fixture(scope="module")
def two():
    with open_engine(TWO) as engine:
        yield engine


@pytest.fixture(params=["in one process", "on two workers"], scope="module")
def engine(request):
    return IN_ONE_PROCESS if request.param == "in one process" else request.getfixturevalue("two")


def late(seconds):
    """The earlier the item, the later its result."""
    time.sleep(seconds)
    return seconds, os.getpid()


def below_three(number):
    if number == 3:
        raise UnreachableError("leg 3 is too long: take a shorter one")
    return number / (number - 5)


def ended_early(at):
    raise SimulationStoppedError(f"the run ended early, at {at} s", lambda: "which cannot be pickled")


def difference(much, less, least=0.0):
    return much - less - least


@pytest.mark.slow
def test_results_come_in_the_order_of_the_items_whatever_their_times(engine):
    delays, shares = [0.3, 0.2, 0.1, 0.05, 0.0, 0.0], []
    results = engine.map(late, delays, shares.append)
    assert [seconds for seconds, _ in results] == delays
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    processes = {process for _, process in results}
    assert processes == {os.getpid()} if engine is IN_ONE_PROCESS else len(processes) == 2 and os.getpid() not in processes
    assert engine.map(late, []) == []


@pytest.mark.slow
@hypothesis.settings(max_examples=20)
@given(items=st.lists(st.floats() | st.text() | st.tuples(st.integers(), st.booleans()), max_size=10))
def test_every_item_has_one_result_in_its_place(engine, items):
    assert engine.map(repr, items) == list(map(repr, items))
    assert sorted(engine.run(repr, items)) == list(enumerate(map(repr, items)))


def test_an_item_may_have_several_arguments_and_others_may_be_given_beforehand(engine):
    assert engine.starmap(difference, [(5.0, 3.0), (5.0, 1.0, 0.5)]) == [2.0, 3.5]
    assert engine.starmap(partial(difference, 9.0), [(3.0,), (1.0, 0.5)]) == [6.0, 7.5]
    assert engine.map(partial(difference, 9.0, least=2.0), [3.0, 4.0]) == [4.0, 3.0]


def test_random_numbers_and_mechanisms_arrive_bit_for_bit(engine):
    draws, mechanism = np.random.default_rng(7).normal(size=(3, 4)), load_mechanism("6-4-I")
    for sent, came in zip(draws, engine.map(np.positive, list(draws)), strict=True):
        assert sent.tobytes() == came.tobytes()
    (came,) = engine.map(partial(getattr, mechanism.built(1e-4, 3)), ["base_joints"])
    assert came.tobytes() == mechanism.built(1e-4, 3).base_joints.tobytes()


def test_what_an_item_raises_ends_the_work_with_its_message(engine):
    assert engine.map(below_three, [0, 1, 2]) == [0.0, -0.25, -2.0 / 3.0]
    with pytest.raises(GoughError, match="leg 3 is too long: take a shorter one") as raised:
        engine.map(below_three, [1, 3])
    assert isinstance(raised.value, UnreachableError) == (engine is IN_ONE_PROCESS)
    assert not hasattr(raised.value, "exit_status")
    with pytest.raises(GoughError, match="the run ended early") as raised:
        engine.map(ended_early, [2.0])
    assert raised.value.exit_status == 1
    with pytest.raises((ZeroDivisionError, RuntimeError), match="division by zero") as raised:
        engine.map(below_three, [1, 5])
    assert not isinstance(raised.value, GoughError)
    where = "".join(str(each.path) for each in raised.traceback) + str(raised.value)
    assert "test_engine.py" in where and "below_three" in str(raised.getrepr())


def test_an_item_that_fails_is_no_reason_to_leave_out_others(engine):
    outcomes = dict(engine.run(below_three, [1, 3, 5, 2]))
    assert (outcomes[0], outcomes[3]) == (-0.25, -2.0 / 3.0)
    assert outcomes[1] == Failure("leg 3 is too long: take a shorter one")
    assert outcomes[2].reason == "ZeroDivisionError: division by zero"
    assert "below_three" in outcomes[2].trace and not outcomes[2].died


def test_in_one_process_nothing_is_done_before_it_is_asked_for():
    done = []
    outcomes = IN_ONE_PROCESS.run(done.append, ["first", "second"])
    assert done == []
    assert next(outcomes) == (0, None) and done == ["first"]


def test_work_with_one_function_is_of_one_kind():
    kinds = []

    class Noting(InOneProcess):
        def run(self, function, items, kind):
            kinds.extend(map(kind, items))
            return super().run(function, items, kind)

    Noting().map(late, [0.0, 0.0])
    Noting().map(partial(partial(late)), [0.0])
    Noting().starmap(partial(difference, 1.0), [(2.0,)])
    assert kinds == [f"{__name__}.late"] * 3 + [f"{__name__}.difference"]


def test_workers_are_other_processes_and_their_page_is_named(two):
    assert two.workers == 2
    assert two.dashboard.startswith("http://127.0.0.1:")


def test_without_dask_all_is_done_here_unless_more_is_asked_for(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    for chosen in (None, EngineSettings(), EngineSettings(workers=1)):
        with open_engine(chosen) as engine:
            assert engine.map(late, [0.0]) == [(0.0, os.getpid())]
    for chosen in (TWO, NOBODY):
        with pytest.raises(MissingPackageError, match=r"this needs distributed.*gough\[sweep\]"), open_engine(chosen):
            pass


def test_one_process_needs_no_dask():
    code = (
        "import sys\nfrom hil.engine.engine import open_engine\nfrom hil.engine.settings import EngineSettings\n"
        "with open_engine(EngineSettings(workers=1)) as engine:\n    print(engine.map(abs, [-1, 2]))\n"
        "print([name for name in ('dask', 'distributed', 'tornado') if name in sys.modules])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split("\n")[:2] == ["[1, 2]", "[]"]


@pytest.mark.slow
def test_an_engine_is_opened_with_its_first_work_and_its_workers_end_with_it():
    told = []
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with engine_when_needed(EngineSettings(workers=2, listen=address), told.append) as engine:
            assert told == []
            with pytest.raises(InputError, match=f"a scheduler at {address}"):
                engine.map(late, [0.0])
    assert told == []
    with engine_when_needed(TWO, told.append) as engine:
        assert told == []
        processes = {process for _ in range(2) for _, process in engine.map(late, [0.05] * 4)}
        for process in processes:
            os.kill(process, 0)
    assert len(processes) == 2 and os.getpid() not in processes
    assert [each.dashboard.startswith("http://127.0.0.1:") for each in told] == [True]
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
