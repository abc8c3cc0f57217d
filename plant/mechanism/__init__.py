"""Mechanisms: geometry, limits, class and presets of a rig."""

from plant.mechanism.bodies import Bodies, Joints, Plate
from plant.mechanism.checks import Limits
from plant.mechanism.documents import load_in_space, load_mechanism, load_spatial, mechanism_text, preset_names
from plant.mechanism.planar import PlanarMechanism
from plant.mechanism.spatial import LEGS, Mechanism, six_rows

__all__ = [
    "LEGS",
    "Bodies",
    "Joints",
    "Limits",
    "Mechanism",
    "PlanarMechanism",
    "Plate",
    "load_in_space",
    "load_mechanism",
    "load_spatial",
    "mechanism_text",
    "preset_names",
    "six_rows",
]
