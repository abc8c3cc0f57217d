"""What is told of a run while it goes on, or from its recording: the machine, and its state in a cycle, in SI units.

Both are mappings that `hil.runs.operator_messages` can send. docs/operating.md lists them.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.frames import BASE, ActiveFrames
from controller.safety.causes import Cause, Mode
from hil.loop.records import COMPUTED
from hil.runs.operator_messages import pose_message
from plant.compiled import Record
from plant.imu_wiring import IMU_COUNT
from plant.mechanism import Mechanism
from plant.pose import Pose, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION


def machine_message(mechanism: Mechanism) -> dict[str, Any]:
    """What a picture of a mechanism with limits needs: joints (n, 3) [m], strokes (n, 2) [m], speed of a leg [m/s]."""
    limits, legs = mechanism.require_limits(), mechanism.legs
    gravity = np.asarray(mechanism.plant_parameters()["gravity"], float)
    return {
        "name": mechanism.name,
        "planar": mechanism.planar,
        "base_joints": mechanism.base_joints[:legs],
        "platform_joints": mechanism.platform_joints[:legs],
        "stroke": limits.stroke,
        "velocity": limits.velocity,
        "up": -gravity / np.linalg.norm(gravity),
        "home": pose_message(mechanism.require_home()),
    }


def state_message(record: Record, frames: ActiveFrames) -> dict[str, Any]:
    """The state after a cycle (dtype `RECORD`); `pose` and `tool` are missing where there is no
    estimate, and `truth` where it is not known.
    """
    pose, stop = Pose(record["position"], record["rotation"]), Cause(int(record["stop"]))
    told: dict[str, Any] = {
        "mode": Mode(int(record["mode"])).name.lower(),
        "stop": None if stop == Cause.NONE else stop.short,
        "cycle": int(record["cycle"]),
        "lengths": record["lengths"],
        "rates": record["reference"][:, 1],
        "imus": [imu for imu in range(IMU_COUNT) if int(record["imus"]) >> imu & 1],
        "conditioning": float(record["conditioning"]),
        "protection": record["protection"].astype(float),
        "silent": int(record["silent"]),
    }
    if record["status"] == 0 and np.isfinite(pose.position).all() and np.isfinite(pose.rotation).all():
        told |= {"pose": pose_message(pose), **_tool_message(frames, pose)}
    truth = record["truth"]
    if np.isfinite(truth[:7]).all():
        true = Pose(truth[TRUTH_POSITION], rotations_from_quaternions(truth[None, TRUTH_QUATERNION])[0])
        told["truth"] = pose_message(true)
    return told


def timing_message(records: Record, at: NDArray[np.intp], period: float) -> Mapping[str, float]:
    """How long the cycles at these places of `records` took, and how late they began, over their period [s]; {} for none."""
    if not len(at):
        return {}
    computed, late = 1e-9 * records["stage_ns"][at][:, COMPUTED].sum(axis=1), 1e-9 * records["late_ns"][at]
    return {
        "period": period,
        "compute": float(np.median(computed)),
        "compute_p99": float(np.quantile(computed, 0.99)),
        "late": float(np.median(late)),
        "late_p99": float(np.quantile(late, 0.99)),
        "missed": int(records["missed"][at].sum()),
    }


def _tool_message(frames: ActiveFrames, pose: Pose) -> dict[str, Any]:
    """The tool's pose in the work frame, if that stands on {1}."""
    return {"tool": pose_message(frames.read(pose))} if frames.root == BASE else {}
