"""A recording as the run that it is of: its mechanism, its cycles and events, and its poses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.direct_kinematics import poses_from_lengths
from controller.frames import LEVEL, ActiveFrames, parse_frames
from controller.imu_set import imus_of
from controller.safety.causes import Mode
from controller.workspace import Demands
from hil.recording.mcap import Recording, read_run
from hil.runs.operator_messages import pose_message
from hil.runs.run_state import event_line
from hil.runs.telemetry import estimated_pose, margins_message, reference_pose, state_message, timing_message
from plant.compiled import Record
from plant.errors import GoughError, InputError
from plant.mechanism import Mechanism, load_in_space
from plant.pose import Array, Pose, rotations_from_quaternions
from plant.truth import TRUTH_POSITION, TRUTH_QUATERNION, pose_known

_EVENTS = 8
_AT_START_M = 1e-10


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """A run as its files have it.

    Attributes:
        mechanism: with the joints that the controller assumed.
        config: what was run.
        records: (N,), dtype `RECORD`.
        period: of a cycle [s].
        events: cycle and text of each, by cycle.
        frames: of the run.
        demands: what it asked of its poses.
    """

    mechanism: Mechanism
    config: Mapping[str, Any]
    records: Record
    period: float
    events: Sequence[tuple[int, str]]
    frames: ActiveFrames
    demands: Demands

    @property
    def duration(self) -> float:
        """From the first cycle to the last [s]."""
        return float(self.records["cycle"][-1] - self.records["cycle"][0]) * self.period

    @cached_property
    def times(self) -> Array:
        """The times (N,) [s]; 0 is where the motion begins, after the hold and the approach to its start. NaN without one."""
        motion = self.motion
        begin = float(self.records["cycle"][motion[0]]) if len(motion) else np.nan
        times: Array = (self.records["cycle"] - begin) * self.period
        return times

    @cached_property
    def motion(self) -> NDArray[np.intp]:
        """The places of the motion's records: from its beginning until it ends or is stopped. In the level frame, in which no
        reference rests, it begins with the approach.
        """
        running = np.flatnonzero(self.records["mode"] == Mode.RUNNING)
        if not len(running):
            return running
        # The reference waits at the start, goes to the estimated lengths when the run begins, and comes back.
        references = self.records["reference"][:, : self.mechanism.legs, 0]
        start = references[max(running[0] - 1, 0)]
        arrived = np.abs(references[running] - start).max(axis=1) < _AT_START_M
        if LEVEL in (self.config.get("frame"), self.frames.root):
            return running
        return running[np.argmax(arrived) :] if arrived.any() else running[:0]

    @property
    def truth_known(self) -> bool:
        """Whether the rig gives its true pose, if only from some cycle on."""
        return bool(pose_known(self.records["truth"]).any())

    def estimates(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """The estimated positions (n, 3) [m] and rotations (n, 3, 3) of records."""
        return self.records["position"][rows], self.records["rotation"][rows]

    def truths(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """The same of the true poses."""
        truth = self.records["truth"][rows]
        return truth[:, TRUTH_POSITION], rotations_from_quaternions(np.ascontiguousarray(truth[:, TRUTH_QUATERNION]))

    def references(self, rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """The poses (n, 3) [m] and (n, 3, 3) that the reference's lengths have, the first of them near the estimate, else
        near home; NaN from where on they have none.
        """
        lengths = self.records["reference"][rows, : self.mechanism.legs, 0]
        if not np.isfinite(lengths).all():
            return np.full((len(rows), 3), np.nan), np.full((len(rows), 3, 3), np.nan)
        near = Pose(*(values[0] for values in self.estimates(rows[:1])))
        if not (np.isfinite(near.position).all() and np.isfinite(near.rotation).all()):
            near = self.mechanism.require_home()
        return poses_from_lengths(self.mechanism, lengths, near, partial=True)

    def at(self, seconds: float) -> int:
        """The record at a time since the first cycle [s]."""
        cycle = self.records["cycle"][0] + seconds / self.period
        return int(np.clip(np.searchsorted(self.records["cycle"], cycle, side="right") - 1, 0, len(self.records) - 1))

    def state(self, index: int) -> dict[str, Any]:
        """The state at a record, as a run tells it; its reference is `commanded`."""
        record = self.records[index]
        seconds = float(record["cycle"] - self.records["cycle"][0]) * self.period
        told = {"time": seconds, **state_message(record, self.frames)}
        recent = np.arange(max(index - round(1.0 / self.period), 0), index + 1)
        told["timing"] = timing_message(self.records, recent, self.period)
        reference = reference_pose(record, self.mechanism)
        return told if reference is None else told | {"commanded": pose_message(reference)}

    def margins(self, index: int) -> list[dict[str, Any]]:
        """How the pose stands to everything that limits it at a record; [] without a pose."""
        pose = estimated_pose(self.records[index])
        return [] if pose is None else margins_message(self.mechanism, pose, self.demands)

    def told(self, index: int) -> list[str]:
        """The last events until a record."""
        cycle = int(self.records["cycle"][index])
        return [event_line(at, at * self.period, text) for at, text in self.events if at <= cycle][-_EVENTS:]


def recorded_run(paths: Sequence[Path], mechanism: str | None = None) -> RecordedRun:
    """Read the files of one run; `mechanism` takes the place of the recorded one, whose file may have moved.

    Raises:
        RecordingError: as `read_run`.
        InputError: the mechanism cannot be loaded, or has another number of legs.
    """
    recordings, records = read_run(paths)
    first = recordings[0]
    named = first.config["mechanism"] if mechanism is None else mechanism
    try:
        loaded = load_in_space(named)
    except GoughError as error:
        raise InputError(f"the mechanism of the recording {first.path}: {error}; name it with --mechanism") from None
    config, assumed = first.config, _as_assumed(loaded, first)
    events = sorted({event for recording in recordings for event in recording.events})
    frames = ActiveFrames(parse_frames(config.get("frame_definitions", ""), f"the frames in {first.path}"))
    demands = Demands(
        imus=imus_of(assumed, config["imus"]), magnetometer=config["magnetometer"], section_5=config["fusion"] == "section-5"
    )
    return RecordedRun(assumed, config, records, 1.0 / float(config["rate"]), events, frames, demands)


def _as_assumed(loaded: Mechanism, recording: Recording) -> Mechanism:
    """The mechanism with the joints of the recorded constants: a calibration, or its file's later content, may have others."""
    try:
        rig = recording.arrays["parameters"]["rig"]
        legs, joints = int(rig["legs"]), [rig["geometry"][name] for name in ("base_joints", "platform_joints")]
    except (KeyError, ValueError, IndexError):
        # The beginning is damaged, or of a version that had another layout.
        return loaded
    if legs != loaded.legs:
        raise InputError(f"{recording.path} is of a mechanism with {legs} legs, and {loaded.name} has {loaded.legs}")
    own = (loaded.base_joints, loaded.platform_joints)
    return loaded.moved_joints(np.stack([each[:legs] - at for each, at in zip(joints, own, strict=True)]))
