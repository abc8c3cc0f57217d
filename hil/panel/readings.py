"""What the panel says in numbers: tables in Markdown, of states as `hil.runs.telemetry` has them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from controller.frames import BASE, PLATFORM, ActiveFrames, parse_frames
from hil.look import COLORINGS, ESTIMATE, LENGTH, REFERENCE, ROOM, SPEED, TRUTH
from hil.panel.scene import Machine, Scene
from hil.runs.operator_messages import pose_in
from plant.imu_wiring import PLATFORM_IMU
from plant.pose import Pose, vector_from_rotation


class Readings:
    """The part of a page with readings, and the choice of what the colours of the legs show."""

    def __init__(self, server: viser.ViserServer, machine: Machine, scene: Scene, frames: Mapping[str, Any]) -> None:
        self._machine, self._choices = machine, frames_to_choose(frames)
        gui = server.gui
        coloring = gui.add_dropdown("Colours of the legs", COLORINGS)
        coloring.on_update(lambda _: setattr(scene, "coloring", coloring.value))
        self._chosen = gui.add_dropdown("Poses of", tuple(self._choices))
        self._texts = {name: gui.add_markdown("") for name in ("poses", "sure", "legs", "timing")}
        with gui.add_folder("Events"):
            self._texts["events"] = gui.add_markdown("none")

    def show(self, state: Mapping[str, Any], events: Sequence[str]) -> None:
        """Show a state, and the last events."""
        texts = {
            "poses": pose_table(state, self._choices.get(self._chosen.value)),
            "sure": error_line(state),
            "legs": leg_table(state, self._machine),
            "timing": timing_line(state.get("timing", {})),
            "events": event_list(events),
        }
        for name, text in texts.items():
            set_text(self._texts[name], text)


def set_text(handle: Any, text: str) -> None:
    """Change a text, if it is another one."""
    if handle.content != text:
        handle.content = text


def status(state: Mapping[str, Any]) -> str:
    """What the run does, in a line."""
    mode = f"**{state.get('mode', 'preparing')}**"
    doing = "jogging" if state.get("jogging") else "moving" if state.get("moving") else ""
    stop = f"stopped by: {state['stop']}" if state.get("stop") else ""
    return " · ".join(filter(None, [mode, f"{state.get('time', 0.0):.1f} s", doing, stop]))


def frames_to_choose(frames: Mapping[str, Any]) -> dict[str, ActiveFrames | None]:
    """By its text, each work frame on the base in which the tool's pose can be told, from `frames_message`; the run's own is
    first, and None stands for {2} in {1}, as the messages have it.
    """
    defined = parse_frames(frames["definitions"], "the frames of the run")
    names = [name for name in (defined.work, BASE, *defined.frames) if defined.root(name) == BASE]
    pairs = [(name, tool) for name in names for tool in (defined.tool, PLATFORM)]
    return {
        f"{tool} in {name}": None if (name, tool) == (BASE, PLATFORM) else defined.active(name, tool) for name, tool in pairs
    }


def pose_table(state: Mapping[str, Any], seen: ActiveFrames | None = None) -> str:
    """Estimate, reference and truth of a tool in a work frame; None for {2} in {1}."""
    named = [(ESTIMATE, state.get("pose")), (REFERENCE, state.get("commanded")), (TRUTH, state.get("truth"))]
    rows = [(name, pose_in(pose)) for name, pose in named if pose]
    if not rows:
        return "no pose"
    text = "| | x | y | z [mm] | rx | ry | rz [deg] |\n|---|--:|--:|--:|--:|--:|--:|\n"
    cells = [(name, _pose_cells(pose if seen is None else seen.read(pose))) for name, pose in rows]
    return text + "".join(f"| {name} | {' | '.join(numbers)} |\n" for name, numbers in cells)


def error_line(state: Mapping[str, Any]) -> str:
    """How sure the pose is: the protection level, and the error where the truth is known."""
    parts = []
    if state.get("protection") is not None:
        parts.append(f"protection level {_level(state['protection'])}")
    if state.get("truth") and state.get("pose"):
        estimate, truth = pose_in(state["pose"]), pose_in(state["truth"])
        off = np.linalg.norm(estimate.position - truth.position)
        turned = np.linalg.norm(vector_from_rotation(estimate.rotation @ truth.rotation.T))
        parts.append(f"error {1e3 * off:.2f} mm, {np.degrees(turned):.3f} deg")
    return " · ".join(parts)


def leg_table(state: Mapping[str, Any], machine: Machine) -> str:
    """Length, room to the nearer end of the stroke, speed and IMU of each leg."""
    if "lengths" not in state:
        return ""
    lengths, room, rates = machine.lengths(state), machine.room(state), state["rates"]
    text = f"| leg | {LENGTH} | {ROOM} | {SPEED} | of limit | IMU |\n|--:|--:|--:|--:|--:|:-:|\n"
    for leg in range(machine.legs):
        rate = float(rates[leg])
        used = "used" if leg in state["imus"] else "**out**"
        text += (
            f"| {leg} | {1e3 * lengths[leg]:.2f} | {1e3 * room[leg]:.1f} | {1e3 * rate:.1f} "
            f"| {abs(rate) / machine.velocity:.0%} | {used} |\n"
        )
    platform = "used" if PLATFORM_IMU in state["imus"] else "**out**"
    return f"{text}\nIMU of the platform: {platform} · conditioning {state['conditioning']:.2f}"


def timing_line(timing: Mapping[str, Any]) -> str:
    """Period, computing and lateness of the last second."""
    if not timing:
        return ""
    micro = {name: 1e6 * float(value) for name, value in timing.items() if name != "missed"}
    return (
        f"period {micro['period']:.0f} us · computing {micro['compute']:.0f} us, p99 {micro['compute_p99']:.0f} us "
        f"({micro['compute'] / micro['period']:.1%} of the period) · late {micro['late']:.0f} us, p99 "
        f"{micro['late_p99']:.0f} us · {timing['missed']} periods missed"
    )


def event_list(events: Sequence[str]) -> str:
    """The last events, the newest first."""
    return "\n".join(f"- {text}" for text in reversed(events)) or "none"


def _pose_cells(pose: Pose) -> list[str]:
    turn = np.degrees(vector_from_rotation(pose.rotation))
    return [f"{value + 0.0:.2f}" for value in np.round(1e3 * pose.position, 2)] + [
        f"{value + 0.0:.3f}" for value in np.round(turn, 3)
    ]


def _level(protection: Sequence[float | None]) -> str:
    position, rotation = (np.inf if value is None else float(value) for value in protection)
    return f"{1e3 * position:.2f} mm, {np.degrees(rotation):.3f} deg"
