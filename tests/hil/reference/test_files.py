"""The page of files must have every entry that a reader accepts, and each limit must be the one that it keeps."""

import copy
import re
from collections.abc import Callable
from functools import cache
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from controller.calibration.file import load_calibration
from controller.frames import load_frames
from controller.planning.motions import load_motion, load_washout
from controller.planning.points import load_points
from controller.settings import control_settings, drive_settings, fusion_settings, safety_settings
from hil.reference.fields import REQUIRED, Entry
from hil.reference.files import FILES
from hil.rigs.canopen.settings import DEFAULT_FILE, canopen_settings
from hil.sweep.design import read_design
from hil.sweep.study import read_study
from plant.encoders import load_encoder
from plant.errors import GoughError, InputError
from plant.files import read_toml, toml_entries
from plant.fmu.binding import load_binding
from plant.imu.presets import load_imu
from plant.mechanism import load_in_space

HERE = (1.0, 0.0, 0.0)
VEHICLE = "time_s,ax_m_s2,ay_m_s2,az_m_s2,wx_rad_s,wy_rad_s,wz_rad_s\n"
WAVES: dict[str, dict[str, Any]] = {
    "sine": {"axis": "x", "amplitude": 0.01, "frequency": 1.0},
    "chirp": {"axis": "x", "amplitude": 0.01, "from_frequency": 0.1, "to_frequency": 1.0, "duration": 5.0},
    "circle": {"axes": ["x", "y"], "radius": 0.01, "frequency": 1.0},
    "figure-eight": {"axes": ["x", "y"], "amplitudes": [0.01, 0.01], "frequency": 1.0},
    "noise": {"axis": "x", "rms": 0.001, "from_frequency": 0.1, "to_frequency": 50.0},
    "samples": {"file": "samples.csv"},
}
ELEMENTS: dict[str, dict[str, Any]] = {
    "line": {"to": {"position": [0.01, 0.0, 0.0]}},
    "arc": {"centre": {"position": [0.0, 0.01, 0.0]}, "angle": 1.0},
    "spline": {"points": [{"position": [0.01, 0.0, 0.0]}]},
    "wave": {"duration": 10.0, "waves": [{"shape": name, **entries} for name, entries in WAVES.items()]},
    "cueing": {"file": "vehicle.csv"},
    "dwell": {"duration": 1.0},
    "loop": {"count": 2, "elements": [{"kind": "dwell", "duration": 1.0}]},
}
STUDY: dict[str, Any] = {
    "vary": {"run": {"seed": {"seeds": 2}, "joint_error": {"from": 0.001, "to": 0.002}}},
    "sampling": {"count": 4}, "measure": {}, "run": {},
}  # fmt: skip
DESIGN = {
    "vary": {"run": {"joint_error": {"from": 0.001, "to": 0.002}}},
    "objectives": {"tracking": {"position_rms": {"goal": "minimise"}}},
    "constraints": {"tracking": {"rotation_rms": {"most": 0.1}}},
    "search": {}, "check": {"seeds": 1},
}  # fmt: skip
SAMPLES: dict[str, dict[str, Any]] = {
    "mechanism": {
        "based_on": "hexapod",
        "joints": {"base_swing": 1.0},
        "bodies": {"leg_diameter": 0.01, "base_plate": {"center": [0.0, 0.0, -0.1], "radius": 0.1},
                   "platform_plate": {"center": [0.0, 0.0, 0.1], "radius": 0.1}},
        **{name: {} for name in ("geometry", "home", "limits", "control", "fusion", "safety", "drives")},
    },
    "frames": {"frames": {"table": {"parent": "base"}}, "pivot": {}},
    "motion": {
        "elements": [{"kind": name, **entries} for name, entries in ELEMENTS.items()],
        "start": {}, "limits": {},
    },
    "points": {"points": {"left": {"position": [0.01, 0.0, 0.0]}}},
    "cueing": {},
    "imu": {"gyroscope": {}, "accelerometer": {}, "magnetometer": {}},
    "encoder": {},
    "calibration": {
        "base": {}, "joints": {}, "imu_0": {"gyroscope": {}},
        "covariance": {"sigmas": [1.0] * 147, "factor": [[0.0] * k + [1.0] for k in range(147)]},
    },
    "binding": {
        "fmu": {"step": 0.001}, "imu_angular_velocity": {"variables": ["w"]}, "drive_mode": {"variables": ["mode"]},
    },
    "study": STUDY,
    "design": DESIGN,
    "canopen": {
        name: {entry: str(DEFAULT_FILE.parent / value) if entry == "eds" else value for entry, value in table.items()}
        for name, table in read_toml(DEFAULT_FILE).items()
    },
}  # fmt: skip
PLACES: dict[tuple[str, str], tuple[Any, ...]] = {
    ("mechanism", "[bodies.base_plate], [bodies.platform_plate]"): ("bodies", "base_plate"),
    ("frames", "[frames.NAME]"): ("frames", "table"),
    ("motion", "[limits], or in an element"): ("limits",),
    ("motion", "A place: [start], [points.NAME], to, through or centre"): ("start",),
    ("motion", "A point of a spline: a place, and"): ("elements", 2, "points", 0),
    **{("motion", f'[[elements]] kind = "{name}"'): ("elements", k) for k, name in enumerate(ELEMENTS)},
    **{("motion", f'[[elements.waves]] shape = "{name}"'): ("elements", 3, "waves", k) for k, name in enumerate(WAVES)},
    ("points", "[points.NAME]"): ("points", "left"),
    **{
        ("imu", f"[{sensor}], {kind}"): (sensor,)
        for sensor in ("gyroscope", "accelerometer", "magnetometer") for kind in ("single figures", "words of a data sheet")
    },
    ("calibration", "[imu_0.gyroscope] to [imu_7.accelerometer]"): ("imu_0", "gyroscope"),
    ("binding", "[SIGNAL], each signal but `drive_mode`"): ("imu_angular_velocity",),
    ("study", "A factor in [vary]: a list of values, or a table"): ("vary", "run", "joint_error"),
    ("design", "[objectives] FIGURE, a text for the goal alone"): ("objectives", "tracking", "position_rms"),
    ("design", "[constraints] FIGURE"): ("constraints", "tracking", "rotation_rms"),
}  # fmt: skip
"""Where a table is, if its title does not say it."""

LIKEWISE = {
    ("mechanism", ""): {"geometry", "home", "limits", "plant", "control", "fusion", "safety", "drives", "joints", "bodies"},
    ("motion", "A point of a spline: a place, and"): {"position", "rotation", "relative", "quaternion"},
    **{
        ("motion", f'[[elements]] kind = "{name}"'):
            {"kind", *(f"{turn}{of}" for turn in ("", "turn_") for of in ("speed", "acceleration", "jerk"))}
        for name in ("line", "arc", "spline", "wave", "cueing")
    },
    ("motion", '[[elements]] kind = "dwell"'): {"kind"},
    ("motion", '[[elements]] kind = "loop"'): {"kind"},
    **{("motion", f'[[elements.waves]] shape = "{name}"'): {"shape"} for name in WAVES},
}  # fmt: skip
"""What a table has, too, and the page has in another one."""


def mechanism(path: Path) -> None:
    made = load_in_space(path)
    for read in (control_settings, fusion_settings, safety_settings, drive_settings):
        read(made)


def binding(path: Path) -> None:
    for problem in load_binding(path).problems:
        raise InputError(problem)


READERS: dict[str, Callable[[Path], object]] = {
    "mechanism": mechanism, "frames": load_frames, "motion": load_motion, "points": load_points, "cueing": load_washout,
    "imu": lambda path: load_imu(str(path)), "encoder": lambda path: load_encoder(str(path)), "calibration": load_calibration,
    "binding": binding, "study": read_study, "design": read_design, "canopen": canopen_settings,
}  # fmt: skip


class Case(NamedTuple):
    kind: str
    title: str
    entry: Entry


@cache
def tables() -> list[tuple[str, str, list[Entry]]]:
    return [
        (kind, title, entries) for kind, made in FILES.items() for title, entries in made().items()
        if [each.name for each in entries] != ["..."]
    ]  # fmt: skip


def place(kind: str, title: str) -> tuple[Any, ...]:
    return PLACES.get((kind, title), (title.strip("[]"),) if title else ())


def refusal(folder: Path, kind: str, title: str, changes: dict[str, Any]) -> str:
    """What the reader says of its sample with changes in a table; "" if it takes it."""
    document = copy.deepcopy(SAMPLES[kind])
    table = document
    for part in place(kind, title):
        table = table[part]
    table |= changes
    for name in [name for name, value in changes.items() if value is None]:
        del table[name]
    (folder / "vehicle.csv").write_text(VEHICLE + "".join(f"{0.01 * k:g},0,0,0,0,0,0\n" for k in range(100)))
    (folder / "samples.csv").write_text(
        "time_s,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad\n" + "".join(f"{0.01 * k:g},0,0,0,0,0,0\n" for k in range(9))
    )
    path = folder / "sample.toml"
    path.write_text("\n".join(toml_entries(document)) + "\n")
    try:
        READERS[kind](path)
    except GoughError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", FILES)
def test_the_samples_are_taken(tmp_path: Path, kind: str) -> None:
    assert refusal(tmp_path, kind, "", {}) == ""


@pytest.mark.parametrize(("kind", "title"), [(kind, title) for kind, title, _ in tables() if title != "[check]"])
def test_a_table_has_the_entries_that_its_reader_knows(tmp_path: Path, kind: str, title: str) -> None:
    of_page = {
        entry.name for other_kind, other, entries in tables() for entry in entries
        if kind == other_kind and place(kind, title) == place(kind, other)
    }  # fmt: skip
    # [check] of a design has fields of a run beside its entry.
    message = refusal(tmp_path, kind, title, {"zzzz": 1})
    listed = re.search(r"(?:it has|a mechanism has|a run has|must be a table of|a table with) ([\w, -]+)", message)
    assert listed, message
    assert {*listed[1].split(", ")} == of_page | LIKEWISE.get((kind, title), set())


def beyond(limit: str, whole: bool) -> tuple[list[float], list[float]]:
    """Values just outside of a limit, and just inside, as far as it is one of numbers."""
    number = r"-?[\d.]+(?:e[+-]\d+)?"
    limit = limit.removeprefix("each ").removeprefix("a whole number from ").replace("2^63 - 1", str(2**63 - 1))
    if found := re.match(rf"({number}) to ({number})(, not 0)?", limit):
        if whole:
            least, most = round(float(found[1])), int(found[2]) if found[2].isdecimal() else round(float(found[2]))
            return [least - 1, most + (1 if most > 1e15 else max(1, most // 1000))], [least]
        low, high = float(found[1]), float(found[2])
        span = 1e-3 * (high - low)
        return [low - span, high + span] + ([0.0] if found[3] else []), [low + span, high - span]
    if found := re.match(rf"at least ({number})", limit):
        return [0.99 * float(found[1])], [float(found[1])]
    if found := re.match(rf"positive, at most ({number})", limit):
        return [0.0, 1.001 * float(found[1])], [0.99 * float(found[1])]
    if found := re.match(rf"0 to below ({number})", limit):
        return [-1e-6, float(found[1])], [0.0]
    if limit.startswith(("positive", "0 or positive")):
        least, inside = ([0.0], [1e-3]) if limit.startswith("positive") else ([-1e-6], [0.0])
        return least + ([inf] if "finite" in limit else []), inside + ([inf] if "inf is no limit" in limit else [])
    return [], []


LIMITED = [
    (kind, title, entry) for kind, title, entries in tables() for entry in entries
    if beyond(entry.limit, False)[0] and entry.type in ("number", "whole number", "2 numbers", "3 numbers", "1 or 6 numbers")
    and entry.name not in ("seeds", "bits")
]  # fmt: skip


@pytest.mark.parametrize(("kind", "title", "entry"), LIMITED, ids=lambda value: getattr(value, "name", None))
def test_a_limit_is_kept(tmp_path: Path, kind: str, title: str, entry: Entry) -> None:
    """Beyond it, a value is refused; within it, it is not, or for another reason."""
    outside, inside = beyond(entry.limit, entry.type == "whole number")
    count = {"3 numbers": 3, "2 numbers": 2}.get(entry.type, 0)

    def said(number: float) -> str:
        message = refusal(tmp_path, kind, title, {entry.name: [number] * count if count else number})
        return re.sub(r"-?[\d.]+(e[+-]?\d+)?|inf", "#", message)

    refused = [said(number) for number in outside]
    assert all(refused), (outside, refused)
    for number in inside:
        assert said(number) not in refused, number


def test_many_limits_are_held_against_their_readers() -> None:
    assert len(LIMITED) > 200 and {kind for kind, *_ in LIMITED} == FILES.keys() - {"frames", "points"}


def test_what_must_be_given_is_asked_for(tmp_path: Path) -> None:
    """An entry that the page says must be given, and only such a one, is missed by its reader."""
    for kind, title, entries in tables():
        table: Any = SAMPLES[kind]
        for part in place(kind, title):
            table = table[part]
        for entry in entries:
            if entry.name in table and kind != "binding":
                missed = refusal(tmp_path, kind, title, {entry.name: None}) != ""
                assert missed or entry.default != REQUIRED, (kind, title, entry.name)
