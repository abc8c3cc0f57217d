"""Ports for the programs that tests start."""

import random
import socket

_BELOW_EPHEMERAL = range(10_000, 30_000)
"""Where no system gives a port to a socket that asks for any: a port that is free stays so until it is used."""


def free_port() -> int:
    """A port of 127.0.0.1 on which nothing listens, by UDP or TCP."""
    # Its own generator: tests have seeds, and would all ask for the same port.
    chosen = random.SystemRandom()
    while True:
        port = chosen.choice(_BELOW_EPHEMERAL)
        try:
            for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return port
