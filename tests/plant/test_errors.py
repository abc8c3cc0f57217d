"""The errors: one root for all, and each a builtin error that a caller may already expect."""

import inspect

import pytest

from plant import errors

BUILTIN = {
    "InputError": ValueError,
    "UnknownNameError": LookupError,
    "SingularConfigurationError": ArithmeticError,
    "UnreachableError": ValueError,
    "CalibrationError": ValueError,
    "FmuError": RuntimeError,
    "ToolchainError": OSError,
    "MissingPackageError": ImportError,
    "PlanningError": RuntimeError,
}


@pytest.mark.parametrize("name", BUILTIN)
def test_each_error_is_ours_and_a_builtin_one(name):
    kind = getattr(errors, name)
    assert issubclass(kind, errors.GoughError) and issubclass(kind, BUILTIN[name])
    assert str(kind("the value, the limit and the remedy")) == "the value, the limit and the remedy"
    # None is a kind of another, so that no handler takes one for the other.
    assert kind.__bases__ == (errors.GoughError, BUILTIN[name])


def test_there_are_no_others():
    found = {name for name, _ in inspect.getmembers(errors, inspect.isclass)}
    assert found == {"GoughError", *BUILTIN}
