"""The names that `hil` gives to Python."""

import subprocess
import sys

import pytest

import hil


def test_every_name_is_there_and_comes_from_its_home():
    assert sorted(hil.__all__) == hil.__all__ == dir(hil)
    assert sorted(hil._HOME_OF) == hil.__all__
    for name, home in hil._HOME_OF.items():
        assert getattr(hil, name).__module__.startswith(home)


def test_a_wrong_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'hil' has no attribute 'simulat'"):
        _ = hil.simulat
    with pytest.raises(ImportError, match="cannot import name 'simulat'"):
        from hil import simulat  # noqa: F401


def test_the_import_costs_nothing():
    code = (
        "import sys, hil; from hil import SimulationConfig; print([n for n in ('numpy', 'numba', 'scipy') if n in sys.modules])"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("package", ["plant", "controller", "hil"])
def test_the_packages_say_that_they_are_typed(package):
    from importlib.resources import files

    assert files(package).joinpath("py.typed").is_file()
