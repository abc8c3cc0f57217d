"""Runs as labelled arrays, for xarray and pandas."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from importlib.metadata import version
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from controller.safety.causes import Mode
from hil.loop.records import STAGES
from hil.runs.recorded_run import recorded_run
from hil.runs.run_state import event_line, told_in
from hil.runs.simulation import SimulationResult
from plant.compiled import Record
from plant.dynamics.variables import IMU_COUNT
from plant.mechanism import Mechanism
from plant.pose import UNIT_TOLERANCE, Array, pose_errors, quaternion_from_rotation, rotations_from_quaternions
from plant.truth import TRUTH_CURRENTS, TRUTH_LENGTHS, TRUTH_POSITION, TRUTH_QUATERNION, pose_known

AXES, QUATERNION, TWIST = ("x", "y", "z"), ("w", "x", "y", "z"), ("x", "y", "z", "rx", "ry", "rz")


class _Variable(NamedTuple):
    """A variable of a dataset, from the records of a run."""

    dimensions: tuple[str, ...]  # after the time
    unit: str
    text: str
    values: Callable[[Record], Any]


VARIABLES = {
    "position": _Variable(("axis",), "m", "estimate: origin of {2} in {1}", lambda r: r["position"]),
    "quaternion": _Variable(("component",), "1", "estimate: maps {2} to {1}, w first", lambda r: _quaternions(r["rotation"])),
    "true_position": _Variable(("axis",), "m", "truth: origin of {2} in {1}", lambda r: r["truth"][:, TRUTH_POSITION]),
    "true_quaternion": _Variable(
        ("component",), "1", "truth: maps {2} to {1}, w first", lambda r: r["truth"][:, TRUTH_QUATERNION]
    ),
    "covariance": _Variable(
        ("coordinate", "coordinate_"), "m, rad", "of the estimate's translation and rotation in {1}", lambda r: r["covariance"]
    ),
    "protection_position": _Variable((), "m", "protection level of the position", lambda r: r["protection"][:, 0]),
    "protection_rotation": _Variable((), "rad", "protection level of the rotation", lambda r: r["protection"][:, 1]),
    "conditioning": _Variable((), "1", "of the closed form: 1 is best, 0 singular", lambda r: r["conditioning"]),
    "residual": _Variable(("leg", "axis"), "1", "measured less predicted direction of each leg", lambda r: r["residuals"]),
    "length": _Variable(("leg",), "m", "estimate", lambda r: r["lengths"]),
    "true_length": _Variable(("leg",), "m", "truth", lambda r: r["truth"][:, TRUTH_LENGTHS]),
    "measured_length": _Variable(("leg",), "m", "by encoders, raw", lambda r: r["length"]),
    "measured_rate": _Variable(("leg",), "m/s", "by encoders, raw", lambda r: r["length_rate"]),
    "home_switch": _Variable(("leg",), "1", "1 beyond the home switch, 0 before it, -1 without one", lambda r: r["home"]),
    "reference_length": _Variable(("leg",), "m", "reference", lambda r: r["reference"][:, :, 0]),
    "reference_rate": _Variable(("leg",), "m/s", "reference", lambda r: r["reference"][:, :, 1]),
    "reference_acceleration": _Variable(("leg",), "m/s^2", "reference", lambda r: r["reference"][:, :, 2]),
    "command": _Variable(("leg",), "m/s", "of each drive", lambda r: r["command"]),
    "sent": _Variable(("leg",), "m/s", "what was really sent", lambda r: r["sent"]),
    "current": _Variable(("leg",), "A", "truth, of each motor", lambda r: r["truth"][:, TRUTH_CURRENTS]),
    "angular_velocity": _Variable(("imu", "axis"), "rad/s", "raw readings", lambda r: r["angular_velocity"]),
    "specific_force": _Variable(("imu", "axis"), "m/s^2", "raw readings", lambda r: r["specific_force"]),
    "magnetic_field": _Variable(("imu", "axis"), "uT", "raw readings", lambda r: r["magnetic_field"]),
    "imu_used": _Variable(("imu",), "1", "whether the filters use it", lambda r: _bits(r["imus"])),
    "sample_age": _Variable(("imu",), "cycles", "since the sample was new", lambda r: r["sample_age"]),
    "sample_time": _Variable(("imu",), "s", "of the sample, on the rig's clock", lambda r: 1e-9 * r["sample_ns"]),
    "magnetometer_used": _Variable((), "1", "whether the platform's is used", lambda r: r["imus"] >> IMU_COUNT & 1),
    "base_angular_velocity": _Variable(("axis",), "rad/s", "raw reading of the base's IMU", lambda r: r["base_imu"][:, 0]),
    "base_specific_force": _Variable(("axis",), "m/s^2", "raw reading of the base's IMU", lambda r: r["base_imu"][:, 1]),
    "base_sample_age": _Variable((), "cycles", "since the sample of the base's IMU was new", lambda r: r["base_imu_age"]),
    "base_sample_time": _Variable((), "s", "of the base's sample, on the rig's clock", lambda r: 1e-9 * r["base_imu_ns"]),
    "mode": _Variable((), "", "state of the run", lambda r: np.array([mode.name.lower() for mode in Mode])[r["mode"]]),
    "whole_mechanism": _Variable((), "1", "whether the pose is the whole-mechanism filter's", lambda r: r["trusted"]),
    "request": _Variable((), "1", "to the drives: 0 braked, 1 enabled, 2 quick stop", lambda r: r["request"]),
    "drive": _Variable(("leg",), "1", "0 following, 1 ready, 2 not ready, 3 stopping quickly, 4 faulty", lambda r: r["drive"]),
    "drive_code": _Variable(("leg",), "1", "the drives' own fault codes", lambda r: r["drive_code"]),
    "fault": _Variable((), "1", "number of the cause of a fault that began; 0: none", lambda r: r["status"]),
    "stop": _Variable((), "1", "number of the cause of the stop that is under way; 0: none", lambda r: r["stop"]),
    "asked": _Variable((), "1", "number of the cause that was asked for; 0: none", lambda r: r["asked"]),
    "lateness": _Variable((), "s", "of the wake-up", lambda r: 1e-9 * r["late_ns"]),
    "woken": _Variable((), "s", "time of the wake-up since the first deadline", lambda r: 1e-9 * r["time_ns"]),
    "duration": _Variable(("stage",), "s", "of each stage", lambda r: 1e-9 * r["stage_ns"]),
    "processor_time": _Variable((), "s", "of the loop's thread", lambda r: 1e-9 * r["cpu_ns"]),
    "round_trip": _Variable((), "s", "of the exchange with a rig on a bus", lambda r: 1e-9 * r["round_trip_ns"]),
    "silent": _Variable((), "cycles", "since the rig has answered", lambda r: r["silent"]),
    "refused": _Variable((), "1", "frames or packets that were refused until then", lambda r: r["refused"]),
    "missed": _Variable((), "cycles", "periods that were missed before this one", lambda r: r["missed"]),
}
"""The variables that every run has, by name. A row of each is a cycle."""

Source = SimulationResult | str | PathLike[str] | Sequence[str | PathLike[str]]


def dataset(source: Source, mechanism: str | None = None) -> xr.Dataset:
    """All signals of a run, with names, units and labelled dimensions, in SI units.

    Beside `VARIABLES` there are `reference_position` and `reference_quaternion`; of a simulation `target_position` and
    `target_quaternion`; and where the truth is known `position_error` and `rotation_error`, estimate less truth, a rotation
    vector. The attributes have the configuration as JSON, the version, and the events.

    Args:
        source: a simulation's result, or the recording of a run, its files in a sequence if there are several. Time 0 is where
            the motion begins, or the first cycle if a recording has no motion.
        mechanism: of a recording, if the file of its mechanism has moved.

    Raises:
        GoughError: the recording or its mechanism cannot be read.
    """
    if isinstance(source, SimulationResult):
        return _of_result(source)
    files = [source] if isinstance(source, str | PathLike) else source
    run = recorded_run([Path(each) for each in files], mechanism)
    times = run.times if len(run.motion) else run.records["cycle"] * run.period
    made = _of_records(run.records, times, run.mechanism.legs)
    positions, rotations = run.references(np.arange(len(times)))
    made["reference_position"] = _of_axes(positions, "reference: origin of {2} in {1}")
    made["reference_quaternion"] = _of_components(rotations, "reference: maps {2} to {1}, w first")
    return made.assign_attrs(_attributes(dict(run.config), run.mechanism, run.records))


def frame(source: Source, mechanism: str | None = None) -> Any:
    """The same as a `pandas.DataFrame` with a row a cycle and a column each number, such as `position_x` or `command_3`."""
    import pandas as pd

    made, columns = dataset(source, mechanism), {}
    for name, variable in made.data_vars.items():
        values = variable.values.reshape(len(made.time), -1)
        labels = [""]
        for dimension in variable.dims[1:]:
            labels = [f"{label}_{each}" for label in labels for each in made[dimension].values]
        columns.update({f"{name}{label}": values[:, i] for i, label in enumerate(labels)})
    return pd.DataFrame(columns, index=pd.Index(made.time.values, name="time"))


def _of_result(result: SimulationResult) -> xr.Dataset:
    made = _of_records(result.records, result.times, result.mechanism.legs)
    poses = {
        "reference": (result.reference_positions, result.reference_rotations),
        "target": (result.target_positions, result.target_rotations),
    }
    for name, (positions, rotations) in poses.items():
        made[f"{name}_position"] = _of_axes(positions, f"{name}: origin of {{2}} in {{1}}")
        made[f"{name}_quaternion"] = _of_components(rotations, f"{name}: maps {{2}} to {{1}}, w first")
    attributes = _attributes(asdict(result.config) | {"stages": result.stages}, result.mechanism, result.records)
    return made.assign_attrs(attributes)


def _of_records(records: Record, times: Array, legs: int) -> xr.Dataset:
    labels: dict[str, Any] = {
        "time": ("time", times, {"units": "s"}),
        "cycle": ("time", records["cycle"], {"long_name": "periods since the first"}),
        "leg": range(legs),
        "imu": range(IMU_COUNT),
        "axis": [*AXES],
        "component": [*QUATERNION],
        "coordinate": [*TWIST],
        "coordinate_": [*TWIST],
        "stage": [*STAGES],
    }
    made = xr.Dataset(coords=labels)
    for name, each in VARIABLES.items():
        values = each.values(records)
        values = values[:, :legs] if each.dimensions[:1] == ("leg",) else values
        made[name] = (("time", *each.dimensions), values, {"units": each.unit, "long_name": each.text})
    truth = records["truth"]
    if pose_known(truth).any():
        rotations = rotations_from_quaternions(np.ascontiguousarray(truth[:, TRUTH_QUATERNION]))
        errors = pose_errors(records["position"], records["rotation"], truth[:, TRUTH_POSITION], rotations)
        made["position_error"] = _of_axes(errors[:, :3], "estimate less truth")
        made["rotation_error"] = _of_axes(errors[:, 3:], "estimate less truth, a rotation vector in {1}", "rad")
    return made


def _of_axes(values: Array, text: str, unit: str = "m") -> Any:
    return ("time", "axis"), values, {"units": unit, "long_name": text}


def _of_components(rotations: Array, text: str) -> Any:
    return ("time", "component"), _quaternions(rotations), {"units": "1", "long_name": text}


def _attributes(config: dict[str, Any], mechanism: Mechanism, records: Record) -> dict[str, Any]:
    return {
        "mechanism": mechanism.name,
        "config": json.dumps(config),
        "version": config.get("version", version("gough")),
        "events": [event_line(*event) for event in told_in(records, 1.0 / float(config["rate"]))],
    }


def _quaternions(rotations: Array) -> Array:
    # Before the first pose the estimate is no rotation.
    known = np.abs(np.linalg.det(rotations) - 1.0) < UNIT_TOLERANCE
    quaternions = np.full((len(rotations), 4), np.nan)
    quaternions[known] = quaternion_from_rotation(rotations[known])
    return quaternions


def _bits(imus: Any) -> Any:
    return (imus[:, None] >> np.arange(IMU_COUNT) & 1).astype(bool)
