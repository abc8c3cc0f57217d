"""The commands that move the platform of a run, move, jog and panel; and frames, in which they do."""

import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable
from contextlib import suppress
from math import isfinite, nan, radians
from typing import Any

from hil.command_line import cli
from hil.command_line.frames import gough_frames
from hil.command_line.panel import gough_panel
from hil.runs.config import OPERATOR_CHANNEL
from plant.errors import InputError

__all__ = ["gough_frames", "gough_jog", "gough_move", "gough_panel"]

_AXES = ("x", "y", "z", "rx", "ry", "rz")
_UNITS = {
    "": (1e-3, radians(1.0)), "um": (1e-6, None), "mm": (1e-3, None), "cm": (1e-2, None), "m": (1.0, None),
    "mrad": (None, 1e-3), "rad": (None, 1.0), "deg": (None, radians(1.0)),
}  # fmt: skip
"""Units of a step along an axis, and about one, in m and rad."""

_CHANNEL = (
    cli.setting("--at", OPERATOR_CHANNEL, "the channel of the run", metavar="HOST:PORT"),
    cli.argument("--token-file", metavar="FILE", help="the token of the run, if it needs one; also the variable GOUGH_TOKEN"),
    cli.argument("--frame", metavar="NAME", help="frame of the run's --frames (default: that of the run)"),
)
_WAIT = cli.argument("--no-wait", dest="wait", action="store_false", help="do not wait until the platform has arrived")


def _quantity(text: str, turn: bool, per_second: bool) -> float:
    """A step such as 5mm or 0.5deg, or with `per_second` a speed such as 5mm/s, in SI units."""
    found = re.fullmatch(r"([+-]?[\d.]+(?:e[+-]?\d+)?)\s*([a-z]*)(/s)?", text)
    scale = _UNITS.get(found[2], (None, None))[turn] if found else None
    try:
        number = float(found[1]) if found else nan
    except ValueError:
        number = nan
    if found is None or scale is None or not isfinite(number) or (found[3] is not None) > per_second:
        example = ("2deg" if turn else "5mm") + ("/s" if per_second else "")
        raise InputError(f"{text!r} is no {'speed' if per_second else 'step'} of this axis: give one such as {example}")
    return float(scale * number)


def _signed(axis: str, sign: str) -> Callable[[str], tuple[str, str, str]]:
    """What reads a step of this axis and sign."""
    return lambda text: (axis, sign, text)


def _steps() -> cli.Argument:
    """Options for steps along and about the axes, such as +x 5mm and -rz 2deg."""

    def add(parser: ArgumentParser) -> None:
        parser.prefix_chars = "-+"
        parser.set_defaults(steps=[])
        for axis in _AXES:
            kind = "about" if axis[0] == "r" else "along"
            for sign in "+-":
                parser.add_argument(
                    f"{sign}{axis}", dest="steps", action="append", metavar="STEP",
                    type=_signed(axis, sign),
                    help=f"{kind} {sign}{axis[-1]} [{'deg' if axis[0] == 'r' else 'mm'}]",
                )  # fmt: skip

    return add


def _place(text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(each) for each in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) not in (3, 6) or not all(map(isfinite, numbers)):
        raise ArgumentTypeError(f"{text!r} is no place: give X,Y,Z or X,Y,Z,RX,RY,RZ, all of them finite numbers")
    return numbers


def _operated(options: Namespace, do: Callable[[Any], dict[str, Any]]) -> None:
    """Let an operator do something, and print where the platform is then."""
    from hil.runs.operator import Operator, RequestRefusedError
    from hil.runs.operator_messages import load_token

    with Operator(
        options.at, load_token(options.token_file), name=f"gough {options.parser.prog.rpartition(' ')[2]}"
    ) as operator:
        try:
            telemetry = do(operator)
        except RequestRefusedError as refusal:
            cli.write_json(options.json, {"refused": str(refusal), "nearest": refusal.nearest})
            raise
        cli.write_json(options.json, telemetry)
        if "commanded" not in telemetry:
            print(f"begun, and takes {telemetry['duration']:.2f} s")
            return
        where = _text(telemetry["commanded"], operator.run["home"])
    print(f"the platform is commanded to {where}")


def _text(there: dict[str, Any], home: dict[str, Any]) -> str:
    """A pose as a displacement from another, both as messages have them."""
    from controller.workspace import pose_text
    from hil.runs.operator_messages import pose_in

    return pose_text(pose_in(there), pose_in(home))


def _speed(option: str, given: float | None, unit: str, factor: float) -> float | None:
    """A speed in SI units, from an option in others."""
    if given is None:
        return None
    if not 0.0 < given < float("inf"):
        raise InputError(f"{option} is {given:g} {unit}; it must be a positive number")
    return factor * given


@cli.command(
    cli.argument("point", nargs="?", metavar="POINT", help="home, or a named point of the run, such as park (--points)"),
    cli.argument(
        "--to",
        type=_place,
        metavar="X,Y,Z[,RX,RY,RZ]",
        help="in place of a point: position, and rotation vector, as a target in the frame has them [mm, deg]",
    ),
    cli.flag("--relative", "--to is a move from where the platform is, along the frame's axes"),
    cli.argument("--tool", metavar="NAME", help="tool of the run's --frames (default: that of the run)"),
    cli.argument("--speed", type=float, metavar="MM/S", help="speed of the tool at most [mm/s] (default: 50)"),
    cli.argument("--turn-speed", type=float, metavar="DEG/S", help="speed of its turn at most [deg/s] (default: 11.5)"),
    _WAIT,
    *_CHANNEL,
    cli.JSON,
)
def gough_move(options: Namespace) -> None:
    """Move the platform of a run to a point or a place.

    For a run that was started with --target operator. The tool goes straight. The whole way is held against all limits before
    anything moves; a move that exceeds one is refused with the nearest pose that does not.
    """
    if (options.point is None) == (options.to is None):
        raise InputError("give the name of a point, or a place with --to, and not both")
    if options.relative and options.to is None:
        raise InputError("--relative is for --to: a named point has its own place")
    speeds = {
        "speed": _speed("--speed", options.speed, "mm/s", 1e-3),
        "turn_speed": _speed("--turn-speed", options.turn_speed, "deg/s", radians(1.0)),
    }

    def do(operator: Any) -> dict[str, Any]:
        if options.point is not None:
            moved: dict[str, Any] = operator.move(options.point, options.frame, options.tool, **speeds, wait=options.wait)
            return moved
        position = [1e-3 * each for each in options.to[:3]]
        rotation = [radians(each) for each in options.to[3:]]
        if options.relative:
            stepped: dict[str, Any] = operator.step(
                position, rotation or (0.0, 0.0, 0.0), options.frame, **speeds, wait=options.wait
            )
            return stepped
        place = {"position": position, **({"rotation": rotation} if rotation else {})}
        gone: dict[str, Any] = operator.move(place, options.frame, options.tool, **speeds, wait=options.wait)
        return gone

    _operated(options, do)


@cli.command(
    _steps(),
    cli.flag("--hold", "move at a speed, such as +x 5mm/s, until Ctrl-C or a limit"),
    cli.argument("--for", dest="seconds", type=float, metavar="SECONDS", help="with --hold: no longer than this [s]"),
    _WAIT,
    *_CHANNEL,
    cli.JSON,
)
def gough_jog(options: Namespace) -> None:
    """Jog the platform of a run, by a step or as long as you hold it.

    For a run that was started with --target operator. Steps such as +x 5mm, -rz 2deg, or several at once, are along and about
    the axes of the frame, from where the platform is; numbers without a unit are mm and deg. With --hold they are speeds. A
    jog that is held ends at the first limit; if the jogging program goes away, the run ends by a controlled stop.
    """
    if not options.steps:
        raise InputError("give a step, such as +x 5mm or -rz 2deg")
    if options.seconds is not None and not options.hold:
        raise InputError("--for is for --hold: a step ends by itself")
    if options.seconds is not None and not options.seconds > 0.0:
        raise InputError(f"--for is {options.seconds:g} s; it must be positive")
    moves = [0.0] * len(_AXES)
    for axis, sign, text in options.steps:
        moves[_AXES.index(axis)] += float(f"{sign}1") * _quantity(text, axis[0] == "r", options.hold)
    straight, turn = moves[:3], moves[3:]

    def do(operator: Any) -> dict[str, Any]:
        if not options.hold:
            stepped: dict[str, Any] = operator.step(straight, turn, options.frame, wait=options.wait)
            return stepped
        seconds = float("inf") if options.seconds is None else options.seconds
        jogging = operator.jog(straight, turn, options.frame, seconds)
        with suppress(KeyboardInterrupt):
            for _ in jogging:
                pass
        jogging.close()
        ended: dict[str, Any] = operator.wait(0.0)
        return ended

    _operated(options, do)
