"""The process of a run's channel: it listens where the configuration says, beside the loop, whose memory it reads.

Every run has one, unless it is told not to, or another run listens at the usual address.
"""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controller.frames import ActiveFrames, Frames
from controller.planning.points import load_points
from hil.loop.records import Link
from hil.progress import Say
from hil.realtime.processes import join_or_kill, started
from hil.runs.config import SimulationConfig
from hil.runs.operated_platform import Workplace
from hil.runs.operator_messages import ChannelError, channel_address, load_token
from hil.runs.prepare import demands_of
from plant.compiled import Record
from plant.mechanism import load_in_space

MOST_CLIENTS = 16
"""So many observers may watch, besides the operator; and so many clients may be about to say who they are."""


def open_channel(host: str, port: int) -> socket.socket:
    """A socket that listens for clients; port 0 takes a free one.

    Raises:
        ChannelError: the address cannot be used.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(MOST_CLIENTS)
    except (OSError, OverflowError) as error:
        listener.close()
        raise ChannelError(f"cannot listen for clients at {host}:{port}: {error}: choose another address") from None
    return listener


@contextmanager
def channel_process(
    config: SimulationConfig, records: Record, link: NDArray[np.int64], stream: Record | None, say: Say,
    processor: int | None = None,
) -> Iterator[BaseProcess | None]:  # fmt: skip
    """The process of a run's channel while the context lasts; None if it has no channel.

    Args:
        config: of the run.
        records, link: shared with the loop.
        stream: dtype `STREAM`, shared with the loop; needed where an operator moves the platform.
        say: is told if the usual address is not free.
        processor: that the loop keeps, and clients on this machine are asked to leave to it; None if it keeps none.

    Raises:
        GoughError: an address that was asked for, the token or the points cannot be used.
    """
    listener, token = _listener(config, say)
    if listener is None:
        yield None
        return
    # The loop, which is forked later, has no part in it.
    with listener:
        mechanism = load_in_space(config.mechanism)
        points = {} if config.points is None else load_points(config.points)
        frames = config.active_frames or ActiveFrames(Frames())
        workplace = Workplace(mechanism, frames, demands_of(config, mechanism), points)
        operated = stream if config.operated else None
        what = listener, token, workplace, config.target, 1.0 / config.rate, records, link, operated, processor
        process = started(_serve, *what)
    try:
        yield process
    finally:
        link[Link.DONE] = 1
        join_or_kill(process)


def _listener(config: SimulationConfig, say: Say) -> tuple[socket.socket | None, str | None]:
    """The socket of the channel, and its token."""
    if config.channel_address is None:
        return None, None
    token = load_token(config.token_file)
    address = channel_address(config.channel_address, token)
    try:
        return open_channel(*address), token
    except ChannelError:
        if config.operated or config.channel is not None:
            raise
    say(f"no channel, as {config.channel_address} is taken, perhaps by another run: name another with --channel HOST:PORT")
    return None, None


def _serve(*what: Any) -> None:
    # The supervisor, which begins the loop, does without it.
    from hil.runs.operator_channel import serve_channel

    serve_channel(*what)
