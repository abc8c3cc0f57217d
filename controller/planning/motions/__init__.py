"""Motions: the built-in ones, and those of a motion file: ways and waves, within the limits of tool and actuators."""

from controller.planning.motions.built_in import (
    EVERYWHERE,
    HELD,
    MARGIN_S,
    MOTIONS,
    NAMES,
    REST_S,
    SAMPLE_PERIOD_S,
    Box,
    Poses,
    named_motion,
    rests,
    shaking,
)
from controller.planning.motions.document import load_motion, motion_from_text, text_of_motion
from controller.planning.motions.elements import Arc, Dwell, Line, Loop, Motion, Place, Spline, SplinePoint, ToolLimits, Wave
from controller.planning.motions.planned import PlannedMotion, plan_motion
from controller.planning.motions.waves import Chirp, Circle, FigureEight, Noise, Samples, Sine

__all__ = [
    "EVERYWHERE",
    "HELD",
    "MARGIN_S",
    "MOTIONS",
    "NAMES",
    "REST_S",
    "SAMPLE_PERIOD_S",
    "Arc",
    "Box",
    "Chirp",
    "Circle",
    "Dwell",
    "FigureEight",
    "Line",
    "Loop",
    "Motion",
    "Noise",
    "Place",
    "PlannedMotion",
    "Poses",
    "Samples",
    "Sine",
    "Spline",
    "SplinePoint",
    "ToolLimits",
    "Wave",
    "load_motion",
    "motion_from_text",
    "named_motion",
    "plan_motion",
    "rests",
    "shaking",
    "text_of_motion",
]
