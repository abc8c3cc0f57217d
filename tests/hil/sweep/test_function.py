"""Functions of the user's own: from files and programs, to other processes and back."""

from pathlib import Path

import cloudpickle
import pytest

from hil.sweep.function import UserFunction
from plant.errors import InputError


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
