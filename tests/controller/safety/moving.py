"""A cycle in motion whose state a test chooses."""

import numpy as np

from controller.cycle import STATE, cycle_parameters
from controller.inverse_kinematics import leg_lengths
from controller.safety.causes import Cause, Mode, Request
from controller.settings import control_settings, fusion_settings
from plant.mechanism import load_in_space
from tests.controller.leg_geometry import leg_vectors

RATE_HZ = 400.0
PERIOD_S = 1.0 / RATE_HZ
CYCLE = 700


def moving(preset="hexapod", mode=Mode.RUNNING, request=Request.ENABLED):
    """Mechanism, parameters, and the state of a cycle at home that follows its commands, all IMUs in use."""
    mechanism = load_in_space(preset)
    parameters = cycle_parameters(mechanism, RATE_HZ, control_settings(mechanism), fusion_settings(mechanism))
    state = np.zeros((), STATE)
    state["time"]["cycle"] = CYCLE
    state["safety"]["mode"], state["safety"]["request"] = mode, request
    state["imus"]["used"] = parameters["imus"]["present"]
    place(mechanism, state, mechanism.home.position, mechanism.home.rotation)
    return mechanism, parameters, state


def place(mechanism, state, position, rotation):
    """Let the estimate be a pose."""
    legs, pose = mechanism.legs, state["pose"]
    lengths = leg_lengths(mechanism, position, rotation)
    pose["position"], pose["rotation"], pose["conditioning"] = position, rotation, 1.0
    pose["lengths"][:legs] = lengths
    pose["directions"][:legs] = leg_vectors(mechanism, position, rotation) / lengths[:, None]
    pose["arms"][:legs] = mechanism.platform_joints @ rotation.T


def stop_of(state):
    """Cause, index, value and limit of the stop or fault under way."""
    stop = state["safety"]["stop"]
    return Cause(int(stop["cause"])), int(stop["index"]), float(stop["value"]), float(stop["limit"])


def told(state):
    """The causes of the events so far, which are forgotten."""
    events = state["safety"]["events"]
    causes = [Cause(int(cause)) for cause in events["cause"][: min(int(events["count"]), 8)]]
    events["count"] = 0
    return causes
