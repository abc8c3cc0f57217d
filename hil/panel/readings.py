"""What the panel says in numbers: tables in Markdown, of states as `hil.runs.telemetry` has them."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import viser

from controller.frames import BASE, PLATFORM, ActiveFrames, parse_frames
from hil.look import COLORINGS, ESTIMATE, LENGTH, REFERENCE, ROOM, SPEED, TRUTH
from hil.panel.gui import set_text
from hil.panel.scene import Machine, Scene
from hil.runs.operator_messages import pose_in, pose_message
from plant.imu_wiring import PLATFORM_IMU
from plant.pose import rotation_angle

_TEXT_S = 0.2
"""Time between changes of the texts: nobody reads faster, and each costs as much as a picture."""


class Readings:
    """The part of a page with readings, and the choice of what the colours of the legs show; `status` is where the page says
    what the run does.
    """

    def __init__(
        self, server: viser.ViserServer, machine: Machine, scene: Scene, frames: Mapping[str, Any], status: Any
    ) -> None:
        self._machine, self._choices, self._due = machine, frames_to_choose(frames), 0.0
        gui = server.gui
        coloring = gui.add_dropdown("Colours of the legs", COLORINGS)
        coloring.on_update(lambda _: setattr(scene, "coloring", coloring.value))
        self._chosen = gui.add_dropdown("Poses of", tuple(self._choices))
        self._texts = {"status": status, **{name: gui.add_markdown("") for name in ("poses", "sure", "legs", "timing")}}
        with gui.add_folder("Events"):
            self._texts["events"] = gui.add_markdown("none")

    def show(self, state: Mapping[str, Any], events: Sequence[str], at_once: bool = False) -> None:
        """Show a state, and the last events: a few times a second, or `at_once`."""
        now = time.monotonic()
        if now < self._due and not at_once:
            return
        self._due = now + _TEXT_S
        texts = {
            "status": status_line(state),
            "poses": pose_table(state, self._choices.get(self._chosen.value)),
            "sure": error_line(state),
            "legs": leg_table(state, self._machine),
            "timing": timing_line(state.get("timing", {})),
            "events": event_list(events),
        }
        for name, text in texts.items():
            set_text(self._texts[name], text)


def status_line(state: Mapping[str, Any]) -> str:
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
    rows = [(name, pose if seen is None else pose_message(seen.read(pose_in(pose)))) for name, pose in named if pose]
    if not rows:
        return "no pose"
    text = "| | x | y | z [mm] | rx | ry | rz [deg] |\n|---|--:|--:|--:|--:|--:|--:|\n"
    return text + "".join(f"| {name} | {' | '.join(_pose_cells(pose))} |\n" for name, pose in rows)


def error_line(state: Mapping[str, Any]) -> str:
    """How sure the pose is: the protection level, and the error where the truth is known."""
    parts = []
    if state.get("protection") is not None:
        parts.append(f"protection level {_level(state['protection'])}")
    if state.get("truth") and state.get("pose"):
        estimate, truth = pose_in(state["pose"]), pose_in(state["truth"])
        off, turned = np.linalg.norm(estimate.position - truth.position), rotation_angle(estimate.rotation, truth.rotation)
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


def _pose_cells(pose: Mapping[str, Any]) -> list[str]:
    place, turn = np.round(1e3 * np.array(pose["position"]), 2), np.round(np.degrees(pose["rotation"]), 3)
    # Without a minus before a zero; the wide space keeps columns apart on a narrow page.
    return [f"\u2003{value + 0.0:.2f}" for value in place] + [f"\u2003{value + 0.0:.3f}" for value in turn]


def _level(protection: Sequence[float | None]) -> str:
    position, rotation = (np.inf if value is None else float(value) for value in protection)
    return f"{1e3 * position:.2f} mm, {np.degrees(rotation):.3f} deg"
