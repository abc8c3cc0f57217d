"""The units in which figures and factors are shown; the table and JSON have SI units throughout."""

from dataclasses import fields
from math import degrees
from typing import Any

from hil.runs.config import SimulationConfig
from hil.sweep.study import Study
from plant.dynamics.variables import SPATIAL

_FIGURES = {"position": ("mm", 1e3), "rotation": ("deg", degrees(1.0))}
"""Unit, and the factor to it from SI, of figures that have this word in their name."""
_GEOMETRY = {
    "reach": ("dm3", 1e3), "reach_rotation": ("rad3", 1.0), "reach_share": ("%", 100.0), "force_max": ("N", 1.0),
    "force_per_torque": ("1/m", 1.0),
}  # fmt: skip
"""The same for the figures of the geometry alone."""
_FACTORS = {"mm": ("mm", 1e3), "ms": ("ms", 1e3)}


def unit_of_figure(name: str) -> tuple[str, float]:
    """The unit of a figure, "" if that is not known, and the factor to it from SI."""
    part, _, rest = name.partition(".")
    if part == "geometry":
        return _GEOMETRY.get(rest, ("", 1.0))
    words = name.replace(".", "_").split("_")
    return next((unit for word, unit in _FIGURES.items() if word in words), ("", 1.0))


def unit_of_factor(study: Study, name: str) -> tuple[str, float]:
    """The unit of a factor of a study, "" if that is not known, and the factor to it from SI."""
    part, _, rest = name.partition(".")
    if study.model is not None:
        return "", 1.0
    if part == "run":
        option = next((each.metadata.get("option") for each in fields(SimulationConfig) if each.name == rest), None)
        unit = "s" if rest == "hold" else option.unit if option else ""
        return _FACTORS.get(unit, (unit, 1.0))
    if part == "geometry":
        return ("deg", degrees(1.0)) if rest.endswith("angle") else ("mm", 1e3)
    variable = rest.removeprefix("plant.") if part == "mechanism" else rest.partition("@")[0]
    known = (*SPATIAL.parameters, *SPATIAL.inputs)
    return next((each.unit for each in known if each.name == variable and each.unit != "1"), ""), 1.0


def headed(name: str, unit: str) -> str:
    """A name with its unit."""
    return f"{name} [{unit}]" if unit else name


def label_of(value: Any, scale: float = 1.0) -> str:
    """A value of a factor, or the two ends of a part of its range, in words."""
    if isinstance(value, tuple):
        return " to ".join(f"{scale * each:.4g}" for each in value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return f"{scale * value:.6g}"
    return str(value)
