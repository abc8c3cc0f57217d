"""What a configuration names: whether it is there, and objects in place of names.

A program may give what a file describes as an object: mechanism, target, IMU, encoder, frames, calibration or binding. It is
written to a file in gough's cache, in a folder named after its content, and the file's path is its name. So configurations stay
plain: they are compared, hashed, recorded, and sent to other machines as those with names are.
"""

import hashlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plant.errors import InputError
from plant.files import temporary_folder, write_whole

if TYPE_CHECKING:
    from hil.runs.config import SimulationConfig


def digest_of(content: bytes) -> str:
    """A hash of a file's content."""
    return hashlib.sha256(content).hexdigest()[:24]


def kept_file(name: str, content: bytes) -> Path:
    """A file of this name and content in this machine's cache."""
    from plant.compiled import keyed_folder

    path = keyed_folder("files", digest_of(content)) / name
    if not path.is_file():
        write_whole(path, content)
    return path


def check_names(config: "SimulationConfig") -> None:
    """Check that what a configuration names is there, before anything is built or compiled for it.

    Raises:
        UnknownNameError: no such mechanism, IMU, encoder or motion.
        InputError: a file is not there.
    """
    from controller.planning.target import check_target
    from plant.encoders import load_encoder
    from plant.imu import load_imu
    from plant.mechanism import mechanism_text

    mechanism_text(config.mechanism)
    load_imu(config.imu)
    load_encoder(config.lengths)
    if not config.streamed:
        check_target(config.target)
    for field in ("frames", "points", "token_file", "calibration", "plant", "binding"):
        name = getattr(config, field)
        if name is not None and not Path(name).exists():
            raise InputError(f"{field} = {name!r}: there is no such file")


def name_objects(config: Any) -> None:
    """Put names in place of objects into a configuration that is being made, a frozen dataclass.

    Raises:
        InputError: an object that its file cannot hold.
    """
    # What a target's file has depends on the mechanism and on the frames.
    for each in sorted(fields(config), key=lambda each: each.name == "target"):
        object.__setattr__(config, each.name, name_of(each.name, getattr(config, each.name), config))


def name_of(field: str, given: Any, config: Any = None) -> Any:
    """The name of what is given for a field of a configuration; what is no object with a file remains as it is.

    Raises:
        InputError: an object that the field cannot name, or that its file cannot hold.
    """
    if isinstance(given, Path):
        return str(given)
    if field not in _NAMED or given is None or isinstance(given, str):
        return given
    named = _NAMED[field](given, config)
    return named if isinstance(named, str) else str(kept_file(*named))


def _mechanism_file(given: Any, config: Any) -> tuple[str, bytes]:
    del config
    from plant.mechanism import Mechanism, PlanarMechanism
    from plant.mechanism.documents import text_of_mechanism

    _check_kind("mechanism", given, Mechanism, PlanarMechanism)
    return f"{_stem(given.name)}.toml", text_of_mechanism(given).encode()


def _target_file(given: Any, config: Any) -> tuple[str, bytes]:
    """A motion, or the displacements of a target from the home of the configuration's mechanism, or its poses in the frames."""
    from controller.planning.motions import Motion, text_of_motion
    from controller.planning.target import MOTION_SUFFIX, Target, target_of_function, text_of_target
    from plant.checks import check_time_scale
    from plant.mechanism import load_in_space

    function = callable(given)
    if not function:
        _check_kind("target", given, Target, Motion)
    if isinstance(given, Motion):
        return f"{_stem(given.name)}{MOTION_SUFFIX}", text_of_motion(given).encode()
    if config is None:
        name = getattr(given, "name", given)
        raise InputError(f"the target {name!r} has no mechanism from whose home it counts: give a motion or a file by name")
    mechanism, frames = load_in_space(config.mechanism), config.active_frames
    if function:
        check_time_scale(config.time_scale)
        given = target_of_function(given, mechanism, config.duration / config.time_scale, frames)
    return f"{_stem(given.name)}.csv", text_of_target(given, mechanism, frames).encode()


def _frames_file(given: Any, config: Any) -> tuple[str, bytes]:
    del config
    from controller.frames import Frames

    _check_kind("frames", given, Frames)
    return "frames.toml", given.text().encode()


def _calibration_file(given: Any, config: Any) -> tuple[str, bytes]:
    del config
    from controller.calibration.file import Calibration, save_calibration

    _check_kind("calibration", given, Calibration)
    with temporary_folder("gough-calibration-") as folder:
        save_calibration(folder / "calibration.toml", given)
        return "calibration.toml", (folder / "calibration.toml").read_bytes()


def _imu_file(given: Any, config: Any) -> str | tuple[str, bytes]:
    """A preset has its name, by which calibrations know it."""
    del config
    from plant.imu import PRESETS, ImuModel, text_of_imu

    _check_kind("imu", given, ImuModel)
    if given == PRESETS.get(given.name):
        return str(given.name)
    return f"{_stem(given.name)}.toml", text_of_imu(given).encode()


def _encoder_file(given: Any, config: Any) -> tuple[str, bytes]:
    del config
    from plant.encoders import EncoderModel, text_of_encoder

    _check_kind("lengths", given, EncoderModel)
    return f"{_stem(given.name)}.toml", text_of_encoder(given).encode()


def _binding_file(given: Any, config: Any) -> tuple[str, bytes]:
    del config
    from plant.fmu.binding import Binding, text_of_binding

    _check_kind("binding", given, Binding)
    return f"{_stem(given.source)}.toml", text_of_binding(given).encode()


def _no_object(given: Any, config: Any) -> str:
    """A plant is an instance with a state; what a run begins with is its file."""
    del config
    raise InputError(f"the plant is a {type(given).__name__}; it must be the path of an FMU")


def _rig_name(given: Any, config: Any) -> str:
    """A rig is made when the run is prepared, so that its class stands for it."""
    del config
    from hil.runs.config import PYTHON_RIG

    _check_kind("rig", given, type)
    return f"{PYTHON_RIG}{given.__module__}:{given.__qualname__}"


def _check_kind(field: str, given: object, *kinds: type) -> None:
    if not isinstance(given, kinds):
        names = ", ".join(kind.__name__ for kind in kinds)
        raise InputError(f"the {field} is a {type(given).__name__}; it must be a name, a path, or one of {names}")


def _stem(name: str) -> str:
    """A file's name without its ending, from the name of what is in it."""
    kept = "".join(letter if letter.isalnum() or letter in "-_+" else "_" for letter in Path(name).stem)
    return kept[:60] or "unnamed"


_NAMED: dict[str, Callable[[Any, Any], str | tuple[str, bytes]]] = {
    "mechanism": _mechanism_file,
    "frames": _frames_file,
    "target": _target_file,
    "imu": _imu_file,
    "lengths": _encoder_file,
    "calibration": _calibration_file,
    "plant": _no_object,
    "binding": _binding_file,
    "rig": _rig_name,
}
"""The fields of configurations that objects may stand for, with the name and content of their file, or their name."""
