"""The rig that a configuration names."""

from hil.recording.replay_rig import ReplayRig
from hil.rigs import Rig
from hil.rigs.by_name import check_legs, python_rig
from hil.rigs.udp.link import DEFAULT_ADDRESS
from hil.rigs.udp.rig import UdpRig
from hil.runs.config import PYTHON_RIG, SimulationConfig
from plant.errors import InputError
from plant.extras import missing_extras_named
from plant.mechanism import load_in_space


def rig_of(config: SimulationConfig) -> Rig | None:
    """The rig that a configuration names; None for the plant's FMU.

    Raises:
        GoughError: the rig cannot be made, or its number of legs is not the mechanism's.
    """
    mechanism, period = load_in_space(config.mechanism), 1.0 / config.rate
    check_legs(config.rig, mechanism)
    if config.rig == "udp":
        return UdpRig(config.rig_at or DEFAULT_ADDRESS, period)
    if config.rig == "canopen":
        with missing_extras_named():
            from hil.rigs.canopen.rig import CanopenRig
            from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings

        return CanopenRig(canopen_settings(config.rig_at or DEFAULT_FILE), period)
    if config.rig == "replay":
        if not config.rig_at:
            raise InputError("a replay needs its recording: name it with --rig-at FILE.mcap")
        return ReplayRig(config.rig_at.split(","), period, mechanism)
    if config.rig.startswith(PYTHON_RIG):
        return python_rig(config.rig.removeprefix(PYTHON_RIG), mechanism, period, config.rig_at)
    return None
