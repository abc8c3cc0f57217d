"""Where the work of a study is done: in this process, in several on this machine, or on a cluster; quick to load."""

import os
from dataclasses import dataclass

from hil.option import option
from plant.errors import InputError

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Hosts that only this machine can reach."""

_LISTEN, _DASHBOARD = "127.0.0.1:0", "127.0.0.1:8787"


@dataclass(frozen=True)
class EngineSettings:
    """Where work is done, and who may connect."""

    workers: int | None = option(
        None,
        "processes of this machine that do the work; 1 alone needs no Dask; 0 leaves the work to workers that join at --listen",
        parse=int,
        shown="one for each processor",
    )
    scheduler: str | None = option(
        None,
        "a Dask scheduler that is there already, whose workers do the work: tcp://HOST:PORT, or tls://HOST:PORT",
        metavar="ADDRESS",
    )
    listen: str = option(
        _LISTEN,
        "where workers of other machines can join ('dask worker', docs/sweeps.md); an address that other machines reach needs "
        "TLS; port 0 is any that is free",
        metavar="HOST:PORT",
    )
    dashboard: str = option(
        _DASHBOARD,
        "where Dask's page on the work is, or a free port if another sweep has this one; an address that other machines reach "
        "needs TLS",
        metavar="HOST:PORT",
    )
    tls_ca: str | None = option(None, "TLS: certificate of the authority that has signed everyone's", metavar="FILE.pem")
    tls_cert: str | None = option(None, "TLS: certificate of this machine", metavar="FILE.pem")
    tls_key: str | None = option(None, "TLS: private key of this machine", metavar="FILE.pem")

    def __post_init__(self) -> None:
        if self.workers is not None and not 0 <= self.workers <= 1024:
            raise InputError(f"{self.workers} workers are asked for; there can be 0 to 1024")
        if self.workers == 0 and self.listen == _LISTEN:
            raise InputError("without processes of this machine others must join: say where, with --listen HOST:PORT")
        files = (self.tls_ca, self.tls_cert, self.tls_key)
        if any(files) and not all(files):
            raise InputError("TLS needs three files: --tls-ca, --tls-cert and --tls-key")
        if self.scheduler is not None:
            self._check_scheduler(self.scheduler)
        for flag, address in (("--listen", self.listen), ("--dashboard", self.dashboard)):
            host, _ = host_and_port(address)
            if host not in LOOPBACK and not self.tls:
                raise InputError(
                    f"{flag} {address} can be reached from other machines, so it needs TLS: add --tls-ca, --tls-cert and "
                    "--tls-key, or take 127.0.0.1"
                )

    def _check_scheduler(self, address: str) -> None:
        protocol, _, rest = address.partition("://")
        if protocol not in ("tcp", "tls"):
            raise InputError(f"{address!r} is no address of a scheduler such as tcp://127.0.0.1:8786")
        host_and_port(rest)
        if self.tls != (protocol == "tls"):
            raise InputError(f"--tls-ca, --tls-cert and --tls-key go with tls://HOST:PORT, and only with it; here is {address}")
        if self.workers is not None:
            raise InputError("--workers is for this machine, and the scheduler has workers of its own: leave one of them out")
        if (self.listen, self.dashboard) != (_LISTEN, _DASHBOARD):
            raise InputError("--listen and --dashboard are for a scheduler of its own: leave out these, or --scheduler")

    @property
    def processes(self) -> int:
        """How many processes of this machine work."""
        return len(os.sched_getaffinity(0)) if self.workers is None else self.workers

    @property
    def alone(self) -> bool:
        """Whether one process does everything."""
        own = self.listen, self.dashboard, self.tls
        return self.scheduler is None and own == (_LISTEN, _DASHBOARD, False) and self.processes == 1

    @property
    def others_join(self) -> bool:
        """Whether workers that are started by hand are expected to join."""
        return self.listen != _LISTEN

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
