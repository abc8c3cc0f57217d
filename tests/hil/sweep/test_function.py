"""Functions of the user's own: from files and programs, to other processes and back."""

import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import cloudpickle
import pytest

from hil.sweep.function import UserFunction
from plant.errors import InputError

GAIN = 2.0


def doubled(x: float) -> float:
    return 2.0 * x


def test_it_travels_with_the_text_of_its_module(tmp_path: Path) -> None:
    file = tmp_path / "figures.py"
    file.write_text("FACTOR = 3.0\n\ndef helper(x):\n    return FACTOR * x\n\ndef tripled(x):\n    return helper(x)\n")
    sent = cloudpickle.dumps(UserFunction.from_file("figures.py:tripled", tmp_path))
    file.unlink()
    assert cloudpickle.loads(sent).figures(2.0) == {"tripled": 6.0}


def test_one_of_a_program_is_the_same_as_from_its_file() -> None:
    made = UserFunction.of(doubled)
    assert made == UserFunction.from_file(f"{Path(__file__).name}:doubled", Path(__file__).parent)
    assert made.figures(4.0) == {"doubled": 8.0}


def test_one_within_another_goes_with_what_it_needs() -> None:
    offset = 5.0

    def shifted(x: float) -> float:
        return x + offset

    assert cloudpickle.loads(cloudpickle.dumps(UserFunction.of(shifted))).figures(1.0) == {"shifted": 6.0}


def amplified(gain: float) -> Callable[[float], float]:
    return lambda x: gain * GAIN * x


def test_one_within_another_is_as_it_was_with_what_it_used(monkeypatch: pytest.MonkeyPatch) -> None:
    made = UserFunction.of(amplified(1.0))
    assert made == UserFunction.of(amplified(1.0))
    assert made != UserFunction.of(amplified(10.0))
    monkeypatch.setattr(sys.modules[__name__], "GAIN", 3.0)
    assert made != UserFunction.of(amplified(1.0))
    assert made.function()(1.0) == 2.0
    assert UserFunction.of(amplified(1.0)).function()(1.0) == 3.0


def test_one_of_a_program_stays_the_same_but_for_what_it_uses(tmp_path: Path) -> None:
    """In each process, wherever it stands in the program; a set has an order of its own in each."""
    text = """
from hil import UserFunction

{lines}

def helper(x):
    return {gain} * x

def figure(x):
    return helper(x) if {{"a", "b", "c", "d"}} else 0.0

print(UserFunction.of(figure).source)
"""
    program = tmp_path / "program.py"

    def source(seed: int, lines: str = "", gain: float = 2.0) -> str:
        program.write_text(text.format(lines=lines, gain=gain))
        done = subprocess.run(
            [sys.executable, str(program)],
            env={**os.environ, "PYTHONHASHSEED": str(seed)},
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout

    assert source(1) == source(2) == source(3, lines="x = 1\n\n")
    assert source(1) != source(1, gain=3.0)


def test_one_that_uses_what_cannot_travel_is_refused() -> None:
    lock = threading.Lock()

    def locked() -> bool:
        return lock.locked()

    with pytest.raises(InputError, match=r"locked cannot go to another process.*write it in a file"):
        UserFunction.of(locked)


def test_it_may_give_several_figures(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text("import numpy as np\n\ndef f(x):\n    return {'a': x, 'b': np.float32(1)}\n")
    assert UserFunction.from_file("f.py:f", tmp_path).figures(1) == {"a": 1.0, "b": 1.0}


@pytest.mark.parametrize("value", ["'much'", "None", "[1, 2]", "{'a': 'b'}"])
def test_what_is_no_number_is_refused(tmp_path: Path, value: str) -> None:
    (tmp_path / "f.py").write_text(f"def f():\n    return {value}\n")
    with pytest.raises(InputError, match="must return a number"):
        UserFunction.from_file("f.py:f", tmp_path).figures()


@pytest.mark.parametrize(
    ("text", "source", "said"),
    [
        ("f.py", "", "FILE.py:FUNCTION"),
        ("f.py:2f", "", "FILE.py:FUNCTION"),
        ("f.py:g", "f = 1\n", "no function 'g'"),
        ("f.py:f", "f = 1\n", "no function 'f'"),
        ("f.py:f", "def f(:\n", "SyntaxError"),
        ("f.py:f", "import nothing_of_this_name\n", "ModuleNotFoundError"),
        ("g.py:f", "", "cannot read"),
    ],
)
def test_a_file_without_it_is_told(tmp_path: Path, text: str, source: str, said: str) -> None:
    (tmp_path / "f.py").write_text(source)
    with pytest.raises(InputError, match=said):
        UserFunction.from_file(text, tmp_path)
