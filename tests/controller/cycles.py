"""The cycle as tests call it, without the times of its stages."""

import numpy as np

from controller import cycle as compiled
from controller.estimation.pose_estimator import find_pose, refine_pose

_MARKS = np.zeros((), compiled.MARKS)[()]


def cycle(parameters, state, measurement, segments):
    """One cycle; returns its cause."""
    return compiled.cycle(parameters, state, measurement, segments, _MARKS)


def follow_at_once(parameters):
    """Parameters with which the reference is the motion's after the hold, wherever the legs are, even if they never move."""
    arming = parameters["safety"]["arming"]
    arming["drift"], arming["approach"], arming["judged"] = np.inf, 0, 0
    parameters["safety"]["drives"]["slack"] = np.inf
    return parameters


def run_stages(parameters, state, measurement, first, last=None):
    """The stages from `first` up to `last`, by default the first alone; the time stands still."""
    # Plain numbers, as compiled callers pass them: for members of an enumeration numba compiles the whole cycle a second time.
    first, last = int(first), first + 1 if last is None else int(last)
    return compiled.run_stages(parameters, state, measurement, np.zeros((6, 1, 5)), _MARKS, first, last)


def find(parameters, state):
    """The pose in closed form; returns its conditioning."""
    p, s = parameters[()], state[()]
    used = int(s["platform"]["used"]), int(s["heading"]["used"])
    return find_pose(p["pose"], s["pose"], p["rig"], s["legs"]["directions"], s["legs"]["used"], *used)


def refine(parameters, state):
    """The refined pose with its twist; returns whether there is one."""
    p, s = parameters[()], state[()]
    return refine_pose(p["pose"], s["pose"], p["rig"], s["time"], s["legs"], s["platform"]["rate"])
