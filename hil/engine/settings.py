"""Where the work of a study is done: in this process, in several on this machine, or on a cluster; quick to load."""

import os
from dataclasses import dataclass

from hil.option import option
from plant.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine can reach."""


@dataclass(frozen=True)
class EngineSettings:
    """Where work is done, and who may connect."""

    workers: int | None = option(
        None,
        "processes of this machine that work; 1 does everything in one, without Dask",
        parse=int,
        shown="one for each processor",
    )
    scheduler: str | None = option(
        None,
        "a Dask scheduler whose workers do the work instead, tcp://HOST:PORT or tls://HOST:PORT",
        metavar="ADDRESS",
    )
    listen: str = option(
        "127.0.0.1:0",
        "where the scheduler of this machine's processes listens, so that workers of other machines can join; beyond this "
        "machine it needs the three files for TLS",
        metavar="HOST:PORT",
    )
    dashboard: str = option("127.0.0.1:8787", "where Dask's dashboard listens; as above", metavar="HOST:PORT")
    tls_ca: str | None = option(None, "certificate of the authority that signed everyone's certificate", metavar="FILE.pem")
    tls_cert: str | None = option(None, "certificate of this machine", metavar="FILE.pem")
    tls_key: str | None = option(None, "private key of this machine", metavar="FILE.pem")

    def __post_init__(self) -> None:
        if self.workers is not None and not 1 <= self.workers <= 1024:
            raise InputError(f"{self.workers} workers are asked for; there can be 1 to 1024")
        if self.scheduler is not None and not self.scheduler.startswith(("tcp://", "tls://")):
            raise InputError(f"{self.scheduler!r} is no address of a scheduler such as tcp://127.0.0.1:8786")
        if self.scheduler is not None and self.workers is not None:
            raise InputError("--workers is for this machine, and the scheduler has workers of its own: leave one of them out")
        files = (self.tls_ca, self.tls_cert, self.tls_key)
        if any(files) and not all(files):
            raise InputError("TLS needs three files: --tls-ca, --tls-cert and --tls-key")
        if self.scheduler is not None and self.scheduler.startswith("tls://") and not all(files):
            raise InputError(f"{self.scheduler} speaks TLS: add --tls-ca, --tls-cert and --tls-key")
        for flag, address in (("--listen", self.listen), ("--dashboard", self.dashboard)):
            host, _ = host_and_port(address)
            if host not in LOOPBACK and not all(files):
                raise InputError(
                    f"{flag} {address} can be reached from other machines, so it needs TLS: add --tls-ca, --tls-cert and "
                    "--tls-key, or take 127.0.0.1"
                )

    @property
    def processes(self) -> int:
        """How many processes of this machine work."""
        return len(os.sched_getaffinity(0)) if self.workers is None else self.workers

    @property
    def tls(self) -> bool:
        """Whether everyone shows a certificate."""
        return self.tls_ca is not None


def host_and_port(address: str) -> tuple[str, int]:
    """The parts of an address such as 127.0.0.1:8786; port 0 is any that is free.

    Raises:
        InputError: the text is no such address.
    """
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise InputError(f"{address!r} is no address such as 127.0.0.1:8786")
    return host.strip("[]"), int(port)
