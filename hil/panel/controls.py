"""The controls by which a browser moves the platform: each browser has its own, with numbers of its own."""

from collections.abc import Mapping
from math import degrees, radians
from typing import Any

import numpy as np
import viser

from controller.frames import parse_frames
from hil.panel.orders import HOLD_HZ, Orders
from hil.panel.scene import Machine
from hil.runs.operator import Operator
from hil.runs.operator_messages import pose_in, pose_message
from plant.pose import Array, Pose, rotation_from_vector, vector_from_rotation

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_SLIDER_MM, _SLIDER_DEG = 50.0, 15.0
_WORK_FRAME = "work frame"


class Controls:
    """The part of a page that one browser sees alone.

    Args:
        client: the browser.
        order: of its place among the parts of the page.
        orders: takes what it orders.
        machine: of the run.
        run: what the run says of itself.
    """

    def __init__(
        self, client: viser.ClientHandle, order: float, orders: Orders, machine: Machine, run: Mapping[str, Any]
    ) -> None:
        self._gui, self._orders, self._run = client.gui, orders, run
        frames = run["frames"]
        self._frames = parse_frames(frames["definitions"], "the frames of the run").active(frames["work"], frames["tool"])
        self._home = pose_in(run["home"])
        # The axes along and about which the platform moves.
        self._free = (0, 1, 5) if machine.planar else tuple(range(len(_AXES)))
        self._sliders: dict[int, Any] = {}
        self._tabs = self._gui.add_tab_group(order=order)
        for label, build in (("Jog", self._build_jog), ("Go to", self._build_moves), ("Sliders", self._build_sliders)):
            with self._tabs.add_tab(label):
                build()

    def show_rest(self, pose: Mapping[str, Any]) -> None:
        """Set the sliders to where the platform rests, a `pose_message`: from there they go on."""
        for number, value in enumerate(self._displacements(pose_in(pose))):
            if (slider := self._sliders.get(number)) is not None:
                if not slider.min <= value <= slider.max:
                    slider.min, slider.max = min(slider.min, value), max(slider.max, value)
                slider.value = value

    def remove(self) -> None:
        """Take it from the page."""
        self._tabs.remove()

    def _build_jog(self) -> None:
        axis = self._gui.add_dropdown("Axis", tuple(_AXES[number] for number in self._free))
        frame = self._gui.add_dropdown("Along", (_WORK_FRAME, *self._run["frames"]["names"]))
        step = self._gui.add_number("Step [mm, deg]", 1.0, min=0.001, max=100.0, step=0.001)
        speed = self._gui.add_number("Speed, held [mm/s, deg/s]", 5.0, min=0.01, max=100.0, step=0.01)

        def along(size: float) -> tuple[list[float], list[float], str | None]:
            place, turn = [0.0] * 3, [0.0] * 3
            at = _AXES.index(axis.value)
            if at < 3:
                place[at] = 1e-3 * size
            else:
                turn[at - 3] = radians(size)
            return place, turn, None if frame.value == _WORK_FRAME else frame.value

        for sign, label in ((1.0, "Step +"), (-1.0, "Step -")):

            async def step_once(event: Any, sign: float = sign) -> None:
                move = along(sign * step.value)
                self._orders.give(event.client, lambda operator: operator.step(*move, wait=False))

            self._gui.add_button(label).on_click(step_once)
        for sign, label in ((1.0, "Hold to jog +"), (-1.0, "Hold to jog -")):

            async def hold(event: Any, sign: float = sign) -> None:
                place, turn, axes = along(sign * speed.value)
                self._orders.hold(event.client, {"velocity": place, "turn_velocity": turn, "axes": axes})

            async def release(event: Any) -> None:
                self._orders.release(event.client)

            held = self._gui.add_button(label, color="teal")
            held.on_hold(hold, callback_hz=HOLD_HZ)
            held.on_click(release)

    def _build_moves(self) -> None:
        point = self._gui.add_dropdown("Point", tuple(self._run["points"]))

        async def go_to_point(event: Any) -> None:
            name = point.value
            self._orders.give(event.client, lambda operator: operator.move(name, wait=False))

        self._gui.add_button("Go to the point").on_click(go_to_point)
        frames = self._frames
        label = f"Place of {frames.text} [mm]" if frames.absolute else "Place from home [mm]"
        home = self._target(self._home)
        place = self._gui.add_vector3(label, _three(1e3 * home["position"]), step=0.1)
        turn = self._gui.add_vector3("Turn [deg]", _three(np.degrees(home["rotation"])), step=0.1)

        async def go_to_place(event: Any) -> None:
            position, rotation = [1e-3 * each for each in place.value], [radians(each) for each in turn.value]
            to = {"position": position, "rotation": rotation}

            def go(operator: Operator) -> None:
                operator.move(to, wait=False)

            self._orders.give(event.client, go)

        self._gui.add_button("Go to the place").on_click(go_to_place)

    def _build_sliders(self) -> None:
        """The platform follows the sliders."""
        self._gui.add_markdown(
            f"The platform follows the sliders, displacements from home along {self._frames.frames.work}, while this browser "
            "has control."
        )
        for number in self._free:
            most, unit = (_SLIDER_MM, "mm") if number < 3 else (_SLIDER_DEG, "deg")
            self._sliders[number] = self._gui.add_slider(f"{_AXES[number]} [{unit}]", -most, most, 0.1, 0.0)

        async def moved(event: Any) -> None:
            # What this program sets is no order.
            if event.client is not None:
                values = np.array([self._sliders[number].value if number in self._sliders else 0.0 for number in range(6)])
                turn = rotation_from_vector(np.radians(values[3:]))
                to = self._target(self._frames.displaced(self._home, 1e-3 * values[:3], turn))
                self._orders.follow(event.client, to)

        for slider in self._sliders.values():
            slider.on_update(moved)

    def _displacements(self, platform: Pose) -> list[float]:
        """Of a pose of the platform from home, along the work frame: (6,) [mm, deg]."""
        position, rotation = self._frames.displacement(self._home, platform)
        values = [*(1e3 * position), *map(degrees, vector_from_rotation(rotation))]
        # Without a minus before a zero.
        return [round(float(value), 6) + 0.0 for value in values]

    def _target(self, platform: Pose) -> dict[str, Any]:
        """The place that means a pose of the platform."""
        return pose_message(Pose(*self._frames.to_target(self._home, platform)))


def _three(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) + 0.0 for value in values)
    return x, y, z
