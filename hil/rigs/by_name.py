"""Rigs by the name that a configuration gives them: which mechanisms they fit, and the user's own classes in Python."""

import importlib
import sys
from pathlib import Path
from typing import Any

from hil.rigs import Rig, missing_members
from plant.errors import GoughError, InputError, UnknownNameError
from plant.mechanism import LEGS, Mechanism


def check_legs(rig: str, mechanism: Mechanism) -> None:
    """Check that the rig of this name has as many legs as a mechanism; the buses `udp` and `canopen` are laid out for six.

    Raises:
        InputError: the numbers differ.
    """
    if rig in ("udp", "canopen") and mechanism.legs != LEGS:
        raise InputError(f"the rig {rig!r} has six legs, and {mechanism.name} has three: choose another rig")


def python_rig(name: str, mechanism: Mechanism, period: float, rig_at: str | None) -> Rig:
    """A rig of the user's own: its class, called with mechanism, period [s] and `rig_at`.

    Args:
        name: MODULE:CLASS, such as my_rig:MyRig; modules in the current folder are found, too.
        mechanism: what the rig drives.
        period: of the exchanges [s].
        rig_at: the rig's address, from the command line's --rig-at.

    Raises:
        UnknownNameError: there is no such module or class.
        InputError: the module cannot be imported, or its class is not a rig.
    """
    module_name, _, class_name = name.partition(":")
    if not module_name or not class_name.isidentifier():
        raise InputError(f"{name!r} is not the name of a rig in Python: give module and class, such as python:my_rig:MyRig")
    where = f"{class_name} of module {module_name}"
    made = _find_class(module_name, class_name)
    if not isinstance(made, type):
        raise InputError(f"{where} is not a class")
    _check_members(made, where)
    try:
        rig: Rig = made(mechanism, period, rig_at)
    except GoughError:
        raise
    except Exception as error:
        raise InputError(
            f"{where} cannot be called with mechanism, period and rig_at: {type(error).__name__}: {error}"
        ) from None
    _check_members(rig, where)
    return rig


def _find_class(module_name: str, class_name: str) -> Any:
    folder = str(Path.cwd())
    sys.path.insert(0, folder)
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise InputError(f"module {module_name} cannot be imported: {error}") from None
        raise UnknownNameError(
            f"there is no module {error.name}: start gough in its folder, put that on PYTHONPATH, or install it"
        ) from None
    except Exception as error:
        raise InputError(f"module {module_name} cannot be imported: {type(error).__name__}: {error}") from None
    finally:
        sys.path.remove(folder)
    made: Any = getattr(module, class_name, None)
    if made is None:
        rigs = [key for key, value in vars(module).items() if isinstance(value, type) and not missing_members(value)]
        there = f"; there is {', '.join(rigs)}" if rigs else ""
        raise UnknownNameError(f"module {module_name} has no class {class_name}{there}")
    return made


def _check_members(rig: object, where: str) -> None:
    if missing := missing_members(rig):
        raise InputError(f"{where} is not a rig: it lacks {', '.join(missing)} (see hil.rigs.Rig)")
