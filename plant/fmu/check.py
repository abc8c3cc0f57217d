"""Checks of any FMU for Co-Simulation: its description, and trials of what it promises."""

import contextlib
import functools
import io
import multiprocessing
import os
import zipfile
from collections.abc import Callable, Iterable
from math import inf
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from fmpy.validation import validate_fmu

from plant.errors import InputError
from plant.fmu.description_reader import FmuDescription, FmuVariable
from plant.fmu.instance import FmuInstance
from plant.pose import Array

_STEPS = 10
_SMALL = 1e-4
_ROUGHLY = 1e-4
"""The step of an input for central differences, and their relative tolerance."""

Found = tuple[str, ...] | None
"""Problems, if any; None if there was nothing to check."""


class Check(NamedTuple):
    """One check and its result."""

    name: str
    problems: Found


def platforms_of(path: Path) -> list[str]:
    """The platforms that an FMU has binaries for."""
    with zipfile.ZipFile(path) as archive:
        names = [name.split("/") for name in archive.namelist()]
    return sorted({parts[1] for parts in names if parts[0] == "binaries" and len(parts) > 2 and parts[2]})


def check_fmu(path: Path, limit: float = 60.0) -> list[Check]:
    """Validate an FMU and try it on this machine, in a separate process, which may crash, or take longer than `limit` [s].

    Raises:
        FmuError: the file is no FMU for Co-Simulation.
        InputError: the limit is not positive.
    """
    if not 0.0 < limit < inf:
        raise InputError(f"the limit is {limit:g} s; it must be positive and finite")
    FmuDescription(path)
    valid = Check("description and units (FMPy)", _found(lambda: validate_fmu(str(path))))
    return [valid, *map(Check, _TRIALS, _try_apart(path, limit))]


def _try_apart(path: Path, limit: float) -> list[Found]:
    """The result of each trial; after a crash or the time limit, another process continues with the next."""
    found: list[Found] = []
    context = multiprocessing.get_context("spawn")
    while len(found) < len(_TRIALS):
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=_try, args=(path, len(found), sender), daemon=True)
        process.start()
        sender.close()
        ending = f"took longer than {limit:g} s"
        with receiver:
            try:
                while receiver.poll(limit):
                    found.append(receiver.recv())
                process.kill()
            except EOFError:
                process.join()
                status = process.exitcode or 0
                ending = f"crashed with signal {-status}" if status < 0 else f"ended its process with status {status}"
        process.join()
        if len(found) < len(_TRIALS):
            found.append((ending,))
    return found


def _try(path: Path, first: int, sender: Connection) -> None:
    """Run the trials from number `first` on, in their own process."""
    # Some FMUs print.
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    description = FmuDescription(path)
    for trial in list(_TRIALS.values())[first:]:
        sender.send(_found(functools.partial(trial, description)))


def _found(trial: Callable[[], Iterable[str] | None]) -> Found:
    """The problems of a trial; an exception is a problem, too."""
    try:
        # FMPy prints.
        with contextlib.redirect_stdout(io.StringIO()), contextlib.chdir("."):
            problems = trial()
    except Exception as error:
        return (" ".join(str(error).split()) or type(error).__name__,)
    return None if problems is None else tuple(str(problem) for problem in problems)


def _reals(description: FmuDescription, causality: str) -> list[FmuVariable]:
    return [each for each in description if each.causality == causality and each.real and each.variability == "continuous"]


def _advance(fmu: FmuInstance) -> None:
    experiment = fmu.description.experiment
    step = float(experiment.stepSize if experiment and experiment.stepSize else 1e-3)
    for i in range(_STEPS):
        fmu.do_step(i * step, step)


def _outputs(fmu: FmuInstance) -> list[Array]:
    return [fmu.get(each.name).ravel() for each in _reals(fmu.description, "output")]


def _step(description: FmuDescription) -> list[str]:
    with FmuInstance(description) as fmu:
        fmu.start()
        _advance(fmu)
        outputs = _reals(description, "output")
        return [f"{each.name} is not finite" for each in outputs if not np.isfinite(fmu.get(each.name)).all()]


def _restore(description: FmuDescription) -> list[str] | None:
    if not description.saves_state:
        return None
    with FmuInstance(description) as fmu:
        fmu.start()
        saved = fmu.state()
        _advance(fmu)
        once = _outputs(fmu)
        fmu.restore(saved)
        _advance(fmu)
        again = _outputs(fmu)
    same = all(np.array_equal(a, b, equal_nan=True) for a, b in zip(once, again, strict=True))
    return [] if same else ["a restored state takes another course"]


def _differentiate(description: FmuDescription) -> list[str] | None:
    inputs, outputs = _reals(description, "input"), _reals(description, "output")
    if not (description.differentiable and inputs and outputs):
        return None
    problems = []
    with FmuInstance(description) as fmu:
        fmu.start()
        for known in inputs:
            derivatives = fmu.jacobian(outputs, [known])
            middle = fmu.get(known.name).ravel()
            for i, column in enumerate(derivatives.T):
                ends: list[Array] = []
                for sign in (1.0, -1.0):
                    moved: Any = middle.copy()
                    moved[i] += sign * _SMALL
                    fmu.set(known.name, moved)
                    ends.append(np.concatenate(_outputs(fmu)))
                fmu.set(known.name, middle)
                differences = (ends[0] - ends[1]) / (2.0 * _SMALL)
                size = max(float(np.abs(column).max()), float(np.abs(differences).max()))
                if np.abs(column - differences).max() > _ROUGHLY * size:
                    problems.append(f"those by {known.element_names[i]} are off their differences")
    return problems


_TRIALS: dict[str, Callable[[FmuDescription], Iterable[str] | None]] = {
    f"{_STEPS} steps with finite outputs": _step,
    "a saved state goes on the same": _restore,
    "derivatives agree with differences": _differentiate,
}
