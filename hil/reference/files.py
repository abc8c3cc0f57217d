"""All entries of the files that gough reads, one table for each table of a file.

Most rows are fields of the dataclass that a reader makes. What only a reader's code knows stands here, and
`tests/hil/reference` holds names and limits against what the readers accept.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from math import pi
from typing import Any

from controller.frames.tree import FARTHEST_M, MOST_FRAMES
from controller.planning.motions import Motion, Place, SplinePoint, ToolLimits, Washout
from controller.planning.motions.elements import KINDS, MOST_DURATION_S
from controller.planning.motions.waves import AXES, MOST_HZ, SHAPES
from controller.settings import ControlSettings, DriveSettings, FusionSettings, SafetySettings
from hil.reference.fields import REQUIRED, Entry, entries_of, plain, shown, table_of
from hil.rigs.canopen.settings import TABLES as CANOPEN_TABLES
from hil.rigs.canopen.settings import Check
from hil.rigs.emulation import FaultKind
from hil.runs.config import SimulationConfig
from hil.sweep.design import MAXIMISE, MINIMISE, POOLS, Search
from hil.sweep.names import run_fields
from hil.sweep.study import METHODS, Sampling
from hil.table import Cell, Table
from plant.dynamics.base_course import BaseMotionKind
from plant.encoders import WORDS as ENCODER_WORDS
from plant.encoders import EncoderFaultKind, EncoderModel
from plant.fmu.binding import IMU_SIGNALS, LEAST_STEP_S, MODE_NAMES, MODES, SIGNAL_UNITS, unit_names
from plant.imu.data_sheet import IMU_WORDS, words_for
from plant.imu.model import MOST_SECTIONS, ImuModel, SensorErrors
from plant.imu.presets import GRADES, UNITS, WORDS, sensor_words
from plant.imu_disturbances import WORDS as DISTURBANCE_WORDS
from plant.imu_disturbances import DisturbanceKind
from plant.mechanism.bodies import LARGEST_PLATE_M, MOST_M
from plant.mechanism.checks import MOST_LIMITS, Limits

ANY_SIZE = "0 or positive"
DWELL = f"0 to {MOST_DURATION_S:g}"


def mechanism() -> dict[str, list[Entry]]:
    """The tables of a mechanism's file, but for those of the plant's parameters."""
    rows, size = "6 rows of 3 numbers", f"positive, at most {MOST_M:g}"
    bounded = {name: f"positive, at most {most:g}" for name, (most, _) in MOST_LIMITS.items()}
    swing = f"positive, at most {pi:.4g}"
    plate = [
        Entry("center", "3 numbers", "m", REQUIRED, "", "its middle, in {1} or in {2}"),
        Entry("normal", "unit vector", "", "[0, 0, 1]", "", "its normal, in {1} or in {2}"),
        Entry("radius", "number", "m", REQUIRED, f"positive, at most {LARGEST_PLATE_M:g}"),
        Entry("thickness", "number", "m", "0", f"0 to {MOST_M:g}"),
    ]
    return {
        "": [
            Entry("name", "text", "", "custom", "", "for messages and reports"),
            Entry("based_on", "text", "", "", "a preset", "what the file changes"),
        ],
        "[geometry]": [
            Entry("base_joints", rows, "m", REQUIRED, "within 10 m of their middle", "base joint of each leg, in {1}"),
            Entry(
                "platform_joints", rows, "m", REQUIRED, "within 10 m of their middle",
                "platform joint of each leg, in {2}; a repeated row is a shared joint",
            ),
            Entry(
                "base_joint_axes", "6 unit rows", "", "e_z x home direction", "not along a leg",
                "first axis of each universal joint, fixed in {1}",
            ),
            Entry("up_in_base", "unit vector", "", "[0, 0, 1]", "", "the vertical, in {1}"),
        ],
        "[home]": [
            Entry("position", "3 numbers", "m", REQUIRED, "", "origin of {2} in {1}, from which strokes and targets count"),
            Entry("quaternion", "4 numbers", "", "[1, 0, 0, 0]", "of length 1", "orientation of {2} in {1}, w first"),
        ],
        "[limits]": [
            Entry(
                "stroke", "2 numbers, or 6 rows of 2", "m", REQUIRED, "",
                "about the lengths at home; or the least and greatest length of each leg",
            ),
            *entries_of(Limits, bounded, ("stroke",)),
        ],
        "[joints]": [
            entry
            for side, frame in (("base", "{1}"), ("platform", "{2}"))
            for entry in (
                Entry(
                    f"{side}_swing", "1 or 6 numbers", "rad", "no limit", swing,
                    f"half angle of the cone within which a leg stays at its {side} joint",
                ),
                Entry(f"{side}_axes", "6 unit rows", "", "the legs at home", "", f"axes of these cones, in {frame}"),
            )
        ],
        "[bodies]": [
            Entry("leg_diameter", "1 or 6 numbers", "m", REQUIRED, size, "of each leg, from joint to joint"),
            Entry(
                "leg_ends", "2 numbers", "m", "[0, 0]", f"0 to {MOST_M:g}",
                "how far from the base joint, and from the platform joint, a leg has no body",
            ),
            Entry("clearance", "number", "m", "0", f"0 to {MOST_M:g}", "least distance of two bodies"),
            Entry("base_plate", "table", text="a round plate"),
            Entry("platform_plate", "table", text="a round plate"),
        ],
        "[bodies.base_plate], [bodies.platform_plate]": plate,
        **{
            f"[{name}]": entries_of(kind, {each.name: kind.allowed(each.name) for each in fields(kind)})
            for name, kind in (
                ("control", ControlSettings), ("fusion", FusionSettings), ("safety", SafetySettings), ("drives", DriveSettings),
            )
        },
    }  # fmt: skip


def frames() -> dict[str, list[Entry]]:
    """The tables of a file of frames."""
    position = Entry(
        "position", "3 numbers", "m", "[0, 0, 0]", f"at most {FARTHEST_M:g} along each axis", "origin, in the parent"
    )
    parent = Entry("parent", "text", "", REQUIRED, "base, level, platform, or a frame of the file", "what it stands on")
    return {
        "": [
            Entry("work", "text", "", "base", "a frame on the base or the level frame", "in which targets and read-outs are"),
            Entry("tool", "text", "", "platform", "a frame on the platform", "whose poses these are"),
            Entry("pivot", "table", text="the centre of rotation; without it, the tool's origin"),
            Entry("frames", "table", limit=f"{MOST_FRAMES} frames", text="a table for each frame"),
        ],
        "[frames.NAME]": [
            parent,
            position,
            Entry("quaternion", "4 numbers", "", "[1, 0, 0, 0]", "of length 1", "orientation in the parent, w first"),
            Entry("angles_deg", "3 numbers", "deg", "", "", "instead: turns about fixed x, then y, then z"),
            Entry("rotation_vector_deg", "3 numbers", "deg", "", "", "instead: axis times angle"),
            Entry("note", "text", text="for a reader"),
        ],
        "[pivot]": [replace(parent, default="platform"), replace(position, text="of the pivot, in its parent")],
    }


_PLACE = [
    *entries_of(Place, position="from home, or from where the element begins [m]"),
    Entry("quaternion", "4 numbers", "", "", "of length 1", "instead of `rotation`, w first"),
]
_WASHOUT = {
    "scale": "0 to 10", "turn_scale": "0 to 10", "smoothing_frequency": f"0.001 to {MOST_HZ:g}",
    "washout_frequency": f"0.001 to {MOST_HZ:g}", "return_frequency": f"0 to {MOST_HZ:g}",
    "turn_washout_frequency": f"0.001 to {MOST_HZ:g}", "tilt_frequency": f"0.001 to {MOST_HZ:g}", "tilt": "0 to 0.7853",
    "tilt_speed": "at least 0.0001", "most_acceleration": "each 0 or positive", "most_turn_speed": "each 0 or positive",
}  # fmt: skip
_ELEMENTS: dict[str, dict[str, str]] = {
    "line": {"dwell": DWELL},
    "arc": {"dwell": DWELL, "angle": "-628.3 to 628.3, not 0"},
    "spline": {"dwell": DWELL},
    "wave": {"duration": f"0.1 to {MOST_DURATION_S:g}", "blend": "0.02 to half the duration", "dwell": DWELL},
    "cueing": {**_WASHOUT, "settle": f"1 to {MOST_DURATION_S:g}", "dwell": DWELL},
    "dwell": {"duration": f"0 to {MOST_DURATION_S:g}"},
    "loop": {"count": "1 to 10000"},
}
_BAND = {"from_frequency": f"0.001 to {MOST_HZ:g}", "to_frequency": f"0.001 to {MOST_HZ:g}"}
_WAVES: dict[str, dict[str, str]] = {
    "sine": {"frequency": f"0 to {MOST_HZ:g}"},
    "chirp": {**_BAND, "duration": "at least 0.001"},
    "circle": {"radius": ANY_SIZE, "frequency": f"0 to {MOST_HZ:g}"},
    "figure-eight": {"frequency": f"0 to {MOST_HZ / 2:g}"},
    "noise": {**_BAND, "to_frequency": f"`from_frequency` to {MOST_HZ:g}", "rms": ANY_SIZE, "seed": "0 to 2^63 - 1"},
    "samples": {},
}
_AXES = {"axis": ", ".join(AXES), "axes": f"two of {', '.join(AXES)}"}
_MEANINGS = {
    "to": "where it ends", "through": "a point of the circle between", "centre": "a point of the axis",
    "count": "how often", "elements": "one after the other", "points": "in their order", "waves": "added up",
    "seed": "of its phases", "factor": "on its displacements", "duration": "how long it takes", "frequency": "of the wave",
    "from_frequency": "at first, or the lower end", "to_frequency": "at last, or the upper end",
}  # fmt: skip


def motion() -> dict[str, list[Entry]]:
    """The tables of a motion file."""

    def of(kind: Any, limits: Mapping[str, str], without: Sequence[str] = ()) -> list[Entry]:
        return entries_of(kind, limits, without, **_MEANINGS)

    limits = dict.fromkeys((each.name for each in fields(ToolLimits)), "at least 1e-09")
    return {
        "": [
            *entries_of(Motion, {"time_scale": "0.01 to 1000", "actuator_share": "0.01 to 1"}, name="for messages and reports"),
            Entry("points", "table", text="named places"),
        ],
        "[limits], or in an element": entries_of(ToolLimits, limits),
        "A place: [start], [points.NAME], to, through or centre": _PLACE,
        **{
            f'[[elements]] kind = "{name}"': of(kind, _ELEMENTS[name], ("limits",)) for name, kind in KINDS.items()
        },
        "A point of a spline: a place, and": [
            Entry("point", "text", "", "", "a name in [points]", "instead of a place"),
            *entries_of(SplinePoint, without=("place",)),
        ],
        **{f'[[elements.waves]] shape = "{name}"': of(kind, _WAVES[name] | _AXES) for name, kind in SHAPES.items()},
    }  # fmt: skip


def points() -> dict[str, list[Entry]]:
    """The table of a file of points."""
    return {
        "[points.NAME]": [
            *_PLACE,
            Entry("frame", "text", "", "that of the run", "", "the work frame in which it is"),
            Entry("tool", "text", "", "that of the run", "", "whose pose it is"),
        ]
    }


def cueing() -> dict[str, list[Entry]]:
    """The entries of a file for `--cueing`."""
    return {"": entries_of(Washout, _WASHOUT)}


_OF_IMU = {"dropout": "0 to 1", "clock_error_percent": "0 to below 100", "magnetometer_rate_hz": "positive"}


def imu() -> dict[str, list[Entry]]:
    """The tables of a file of an IMU: single figures, and the words of a data sheet."""
    of_model = {each.name: each for each in entries_of(ImuModel)}
    of_sensor = {each.name: each for each in entries_of(SensorErrors)}
    figures = [
        replace(of_model[field], name=word, unit=_unit_of(word), limit=_OF_IMU.get(word, ANY_SIZE), default="")
        for word, (field, _) in WORDS.items()
    ]
    sheet = [
        Entry(word, "text", " or ".join(units), text=f"data sheet: {of_model[field].text}")
        for word, (field, units) in IMU_WORDS.items()
    ]
    tables = {
        "": [
            Entry("based_on", "text", "", "ideal", "a preset, or a file", "what the file changes"),
            Entry("grade", "text", "", "raw", ", ".join(GRADES), "what becomes of the part"),
            Entry("low_pass", "whole number", "", "", "one of `low_passes_hz`", "the setting of the part's own low-pass"),
            Entry(
                "low_passes_hz", "rows of 3 numbers", "Hz", "", f"positive; order 1 to {MOST_SECTIONS}",
                "settings of the low-pass: bandwidth of gyroscope and of accelerometer, and order",
            ),
            *figures,
            *sheet,
            Entry("disturbances", "tables", text="what happens to it in its normal life, as below"),
            *(Entry(sensor, "table") for sensor in UNITS),
        ]
    }  # fmt: skip
    for sensor, of in UNITS.items():
        words = sensor_words(*of)
        tables[f"[{sensor}], single figures"] = [
            replace(
                of_sensor[field], name=word, unit=_unit_of(word), default="",
                limit=f"1 to {MOST_SECTIONS}" if field == "order" else ANY_SIZE,
            )
            for word, (field, _) in words.items()
        ]  # fmt: skip
        tables[f"[{sensor}], words of a data sheet"] = [
            Entry(word, "text", ", ".join(units), text=of_sensor[field].text)
            if units else Entry(word, "whole number", limit="8 to 32", text="width of a reading, which gives its step")
            for word, (field, units) in words_for(sensor).items()
        ]  # fmt: skip
    return tables


def _unit_of(word: str) -> str:
    """The unit in a word's name."""
    for end, unit in _UNIT_ENDS.items():
        if end in word:
            return unit
    return ""


_UNIT_ENDS = {
    "deg_per_s_per_root_hz": "deg/s/sqrt(Hz)", "m_per_s2_per_root_hz": "m/s^2/sqrt(Hz)", "ut_per_root_hz": "uT/sqrt(Hz)",
    "deg_per_s_per_root_s": "deg/s/sqrt(s)", "m_per_s2_per_root_s": "m/s^2/sqrt(s)", "ut_per_root_s": "uT/sqrt(s)",
    "deg_per_s_per_k": "deg/s/K", "m_per_s2_per_k": "m/s^2/K", "ut_per_k": "uT/K", "percent_per_k": "%/K",
    "deg_per_s_per_v": "deg/s/V", "m_per_s2_per_v": "m/s^2/V", "ut_per_v": "uT/V", "per_deg_per_s": "1/(deg/s)",
    "per_m_per_s2": "1/(m/s^2)", "per_ut": "1/uT", "deg_per_s": "deg/s", "m_per_s2": "m/s^2", "_ut": "uT", "_hz": "Hz",
    "_deg": "deg", "_ms": "ms", "_um": "um", "_percent": "%", "_m": "m",
}  # fmt: skip
"""The units that names of entries end with, the longer ones first."""


def encoder() -> dict[str, list[Entry]]:
    """The entries of a file of encoders."""
    of_model = {each.name: each for each in entries_of(EncoderModel)}
    limits = {"dropout": "0 to 1", "scale": "0 to below 100"}

    def scaled(field: str, factor: float) -> str:
        return shown(float(getattr(EncoderModel("any"), field)) / factor)

    return {
        "": [
            Entry("based_on", "text", "", "incremental", "incremental, absolute, ideal, or a file", "what the file changes"),
            of_model["absolute"],
            *(
                replace(
                    of_model[field], name=word, unit=_unit_of(word), default=scaled(field, factor),
                    limit=limits.get(field, ANY_SIZE),
                )
                for word, (field, factor) in ENCODER_WORDS.items()
            ),
            replace(of_model["switches"], name="switches_m", default="", limit="one for each leg, positive"),
        ]
    }  # fmt: skip


def calibration() -> dict[str, list[Entry]]:
    """The tables of a calibration file."""
    rows = "6 rows of 3 numbers"
    return {
        "[about]": [Entry("...", "texts and numbers", text="the rig, date, version and residuals; `digest` shows any change")],
        "[base]": [
            Entry("tilt", "2 numbers", "rad", "[0, 0]", "-0.8 to 0.8", "turns of the vertical about the axes x and y of {1}"),
            Entry(
                "floor", "2 numbers", "m, rad", "[0, 0]", ANY_SIZE,
                "standard deviations of position and rotation that tilt and joints leave",
            ),
        ],
        "[joints]": [
            Entry("base", rows, "m", "zeros", "", "corrections of the base joints"),
            Entry("platform", rows, "m", "zeros", "", "corrections of the platform joints"),
        ],
        "[imu_0.gyroscope] to [imu_7.accelerometer]": [
            Entry("bias", "3 numbers", "rad/s, m/s^2 or uT", "[0, 0, 0]", "", "added to the raw reading"),
            Entry("scale", "3 numbers", "", "[1, 1, 1]", "positive", "factor of each axis"),
            Entry("axes", "3 numbers", "", "[0, 0, 0]", "-1 to 1", "upper triangle xy, xz, yz of T"),
            Entry("mounting", "3 numbers", "rad", "[0, 0, 0]", "", "rotation vector of the sensor on its place"),
        ],
        "[covariance]": [
            Entry("sigmas", "147 numbers", "", "", "", "standard deviations of the errors that are left"),
            Entry("factor", "147 rows", "", "", "", "Cholesky factor of their correlation, a triangle"),
        ],
    }  # fmt: skip


def binding() -> dict[str, list[Entry]]:
    """The tables of a binding of an FMU."""
    return {
        "[fmu]": [
            Entry("step", "number", "s", "the control period", f"at least {LEAST_STEP_S:g}", "communication step of the FMU")
        ],
        "[start]": [Entry("...", "any value", text="start values of parameters and inputs, by their names in the FMU")],
        "[SIGNAL], each signal but `drive_mode`": [
            Entry("variables", "text, or list of texts", "", REQUIRED, "", "the FMU's variables that hold it, in order"),
            Entry("unit", "text", "", "the FMU's, or else gough's", "below", "in which the FMU has it"),
            Entry("sign", "1 or -1, or a list", "", "1", "1 or -1", "of all, of each axis, or of each element"),
            Entry("offset", "number, or a list", "gough's", "0", "", "added afterwards"),
            Entry("imus", "whole numbers", "", "all", "0 to 6", f"of {', '.join(IMU_SIGNALS)} alone: which IMUs there are"),
        ],
        f"[{MODES}]": [
            Entry("variables", "text, or list of texts", "", REQUIRED, "", "one for all drives, or one for each"),
            *(Entry(name, "number, true or false", "", "gough's", "", "its value for this mode") for name in MODE_NAMES),
        ],
    }  # fmt: skip


def units_of_signals() -> str:
    """The signals of a binding, with gough's units and those that an FMU may use."""
    table = Table("signal", "gough's unit", "an FMU may use")
    for signal, unit in SIGNAL_UNITS.items():
        table.add(Cell(signal, code=True), unit, unit_names(signal))
    return table.markdown()


def study() -> dict[str, list[Entry]]:
    """The tables of a study's file."""
    return {
        "": [
            Entry("name", "text", "", "the file's", "", "what reports call it"),
            Entry("run", "table", text="what is the same in all runs"),
            Entry("mechanism", "table", text="entries that replace those of the mechanism's file, as there"),
            Entry("plant", "table", text="parameters and inputs of the FMU, as docs/fmu.md names them"),
            Entry("vary", "table", "", REQUIRED, "one factor or more", "what varies, by name with dots"),
            Entry("sampling", "table", text="how ranges are sampled"),
            Entry("measure", "table", text="what is measured"),
            Entry("model", "text", "", "", "FILE.py:FUNCTION", "figures of your own from the factors, in place of a run"),
        ],
        "A factor in [vary]: a list of values, or a table": [
            Entry("from", "number", "", REQUIRED, "below `to`", "least value, in SI units"),
            Entry("to", "number", "", REQUIRED, "", "greatest value"),
            Entry("steps", "whole number", "", "sampled", "2 to 10000000", "so many values, crossed with all others"),
            Entry("logarithmic", "true or false", "", "false", "`from` positive", "whether values go up by the same factor"),
            Entry("seeds", "whole number", "", "", "1 to 10000000", "of run.seed, alone: the seeds 0 to this, without it"),
        ],
        "[sampling]": entries_of(
            Sampling, {"method": ", ".join(METHODS), "count": "2 to 10000000, a power of two but for latin-hypercube",
                       "seed": "0 to 2^63 - 1"},
            method="how", count="of samples; for saltelli, the base of their number", seed="of the samples",
        ),
        "[measure]": [
            Entry("figures", "texts", "", "four of a run", "", "which figures reports and tables show; all are kept"),
            Entry("function", "text", "", "", "FILE.py:FUNCTION", "figures of your own, from the result of a run"),
        ],
        "[run]": _run(),
    }  # fmt: skip


def _run() -> list[Entry]:
    """The fields of a run's configuration that a study may give, in SI units."""
    of_config = {each.name: each for each in fields(SimulationConfig)}
    found = []
    for name in run_fields():
        option = of_config[name].metadata.get("option")
        unit = {"mm": "m", "ms": "s"}.get(option.unit, option.unit) if option else "s"
        kind = {bool: "true or false", int: "whole number", float: "number"}.get(type(of_config[name].default), "text")
        default = (option.shown if option else None) or shown(of_config[name].default)
        text = (
            option.text if option else "how long the brakes hold first; without it the mechanism's, below 250 Hz at least 1 s"
        )
        found.append(Entry(name, kind if option else "number", unit, "" if default == "[]" else default, "", text))
    return found


def design() -> dict[str, list[Entry]]:
    """The tables that a design's file has beside those of a study."""
    pool = Entry(
        "pool", "text or number", "", "mean", f"{', '.join(POOLS)}, or 0 to 1", "how seeds are pooled; a number is a quantile"
    )
    whole = {
        "trials": "1 to 1000000",
        "seeds": "1 to 10000",
        "batch": "0 to 10000",
        "group": "1 to 10000",
        "seed": "0 to 2^63 - 1",
    }
    bound = 'a number, or "start"'
    return {
        "[objectives] FIGURE, a text for the goal alone": [
            Entry("goal", "text", "", MINIMISE, f"{MINIMISE} or {MAXIMISE}", "what is better"), pool,
        ],
        "[constraints] FIGURE": [
            Entry("least", "number or text", "", "", bound, "what the figure must have at least"),
            Entry("most", "number or text", "", "", bound, "what it may have at most"),
            pool,
        ],
        "[search]": entries_of(Search, {**whole, "method": "nsga2 or tpe"}),
        "[check]": [
            Entry("seeds", "whole number", "", "0", "0 to 10000", "so many that the search did not use"),
            Entry("run.FIELD", "list", text="values of a field of the run, crossed with the seeds"),
        ],
    }  # fmt: skip


def canopen() -> dict[str, list[Entry]]:
    """The tables of a CANopen rig's file; the defaults are those of the emulated bus, and a file gives all of them."""
    return {f"[{name}]": _of_bus(kind) for name, kind in CANOPEN_TABLES.items()}


def _of_bus(kind: Any) -> list[Entry]:
    return entries_of(kind, {each.name: _allowed(each.metadata["check"]) for each in fields(kind)})


def _allowed(check: Check) -> str:
    return f"{check.text}, each {_allowed(check.each)}" if check.each else check.text.removeprefix("from ")


def disturbances() -> str:
    """What can happen to IMUs, encoders and the base, and in an emulated rig to drives and the bus."""
    kinds = Table("fault", "size", "what happens")
    for each in DisturbanceKind:
        kinds.add(Cell(each.label, code=True), _words(*each.sizes, *each.places), each.text)
    for moved in BaseMotionKind:
        kinds.add(Cell(moved.label, code=True), _words(*moved.sizes, "axis"), plain(moved.text))
    for broken in EncoderFaultKind:
        kinds.add(Cell(broken.label, code=True), _words(*filter(None, [broken.size])), broken.text)
    for fault in FaultKind:
        size = f"`size`, {fault.default:g} by default" if fault.default else ""
        kinds.add(Cell(fault.label, code=True), size, f"emulated rig: {plain(fault.text)}")
    words = Table("word", "meaning")
    for word, meaning in DISTURBANCE_WORDS.items():
        words.add(Cell(word, code=True), meaning)
    return f"{kinds.markdown()}\n\n{words.markdown()}"


def _words(*words: str) -> str:
    return ", ".join(f"`{word}`" for word in words)


def tables_of(tables: Mapping[str, Sequence[Entry]]) -> str:
    """The tables of a file in Markdown."""
    parts = [(f"### {plain(title)}" if title else "", table_of(entries)) for title, entries in tables.items()]
    return "\n\n".join(part for both in parts for part in both if part)


FILES = {
    each.__name__: each
    for each in (mechanism, frames, motion, points, cueing, imu, encoder, calibration, binding, study, design, canopen)
}
"""Of each kind of file, what gives its tables: rows by the title of a table, "" for entries outside of all."""
