"""The messages between an operator and a run, version 1: lines of JSON over TCP, UTF-8, at most 64 KiB each.

The client speaks first, and once: `{"gough": 1, "role": "operator" or "observer", "name": TEXT, "token": TEXT}`. The answer has
`ok`, and either what the run is, or `kind` and `error`; then the server closes. A request has an `id` and what to `do`; its
answer has the same `id`, `ok`, and figures, or `kind`, `error` and perhaps `nearest`, a pose that could be reached. Lines
without an `id` are `telemetry` and `event`s, which come after `{"do": "watch"}`. All numbers are in SI units; docs/operating.md
lists them. A client and a server of other versions refuse each other.
"""

import ipaddress
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hil.rigs.udp.link import parse_address
from hil.runs.config import OPERATOR_CHANNEL
from plant.errors import GoughError, InputError
from plant.pose import Pose, rotation_from_vector, vector_from_rotation

VERSION = 1
MOST_LINE = 65536
RUN_ENDED = "the run has ended"
"""The last event."""

TOKEN_VARIABLE = "GOUGH_TOKEN"
"""The variable of the environment that may have the token."""

_LEAST_TOKEN, _MOST_TOKEN = 16, 1024


class ChannelError(GoughError, OSError):
    """The channel is not there, was closed, or speaks otherwise. `kind` is that of the server's answer, if it gave one."""

    def __init__(self, message: str, kind: str = "") -> None:
        super().__init__(message)
        self.kind = kind


def encode(message: Mapping[str, Any]) -> bytes:
    """The line of a message; what is not finite becomes null."""
    return json.dumps(_plain(message), allow_nan=False).encode() + b"\n"


def is_finite(value: Any) -> bool:
    """Whether all numbers in a part of a message are finite."""
    if isinstance(value, Mapping):
        return all(map(is_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float | np.number | np.ndarray) or bool(np.isfinite(value).all())


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def decode(line: bytes) -> dict[str, Any]:
    """The message of a line.

    Raises:
        InputError: it is none.
    """
    try:
        message = json.loads(line.decode())
    except (ValueError, RecursionError):
        raise InputError("the line is no JSON: send one object a line") from None
    if not isinstance(message, dict):
        raise InputError("the line is no JSON object: send one object a line")
    return message


def pose_message(pose: Pose) -> dict[str, Any]:
    """A pose as messages have it: `position` [m] and `rotation`, a rotation vector [rad]."""
    return {"position": pose.position, "rotation": vector_from_rotation(pose.rotation)}


def pose_in(message: Mapping[str, Any]) -> Pose:
    """The pose of a message; the inverse of `pose_message`."""
    return Pose(np.array(message["position"], float), rotation_from_vector(message["rotation"]))


def load_token(path: str | None) -> str | None:
    """The token in the first line of a file, else in the environment; None if there is neither.

    Raises:
        InputError: the file cannot be read, or the token is too short to be one.
    """
    source = path or TOKEN_VARIABLE
    if path is None:
        token = os.environ.get(TOKEN_VARIABLE)
        if token is None:
            return None
    else:
        try:
            token = Path(path).read_text().partition("\n")[0].strip()
        except (OSError, ValueError) as error:
            raise InputError(f"the token's file {path} cannot be read: {error}") from None
    if not (_LEAST_TOKEN <= len(token) <= _MOST_TOKEN and token.isascii() and token.isprintable()):
        raise InputError(
            f"the token in {source} has {len(token)} characters; it needs {_LEAST_TOKEN} to {_MOST_TOKEN} printable ones: make "
            "one with 'openssl rand -hex 32'"
        )
    return token


def channel_address(text: str, token: str | None) -> tuple[str, int]:
    """Host and port of a channel.

    Raises:
        InputError: the text is no address, or one beyond this machine without a token.
    """
    host, port = parse_address(text, anywhere=token is not None)
    if token is None and not ipaddress.IPv4Address(host).is_loopback:
        raise InputError(
            f"the channel at {text} would take orders from other machines: give a token with --token-file FILE, or listen at "
            f"{OPERATOR_CHANNEL}"
        )
    return host, port
