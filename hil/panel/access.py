"""Who may open the panel: programs of this machine, or who has the token; and no other page in the same browser.

A page from elsewhere can make a browser connect to this one. Its requests then carry another origin or another host's name,
and are refused. The token comes once in the address, and stays as a cookie.
"""

import hmac
import http
import io
import ipaddress
import socket
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from http.cookies import SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from hil.rigs.udp.link import parse_address
from plant.errors import InputError

DEFAULT_ADDRESS = "127.0.0.1:8080"

_COOKIE = "gough_panel"
_LOCAL_NAMES = ("127.0.0.1", "localhost")


class Gate:
    """Lets requests in or refuses them.

    Args:
        host: at which the panel listens.
        token: that a browser must give; None if none is needed.
    """

    def __init__(self, host: str, token: str | None) -> None:
        self._token = token
        address = ipaddress.IPv4Address(host)
        # Who listens at every address is known by names that cannot be listed here; the token keeps strangers out.
        self._names = None if address.is_unspecified else {host, *(_LOCAL_NAMES if address.is_loopback else ())}

    def refusal(self, headers: Headers, path: str) -> str:
        """Why a request is refused, or ""."""
        host = headers.get("Host", "")
        if self._names is not None and host.rpartition(":")[0] not in self._names:
            return f"this panel is not at {host[:80]!r}"
        origin = headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return f"a page from {origin[:80]!r} may not use this panel"
        if self._token is not None and not (self._knows(_asked(path)) or self._knows(_kept(headers))):
            return "the token is missing or wrong: open the address that 'gough panel' has printed"
        return ""

    def admits(self, path: str) -> bool:
        """Whether this path brings the token."""
        return self._token is not None and self._knows(_asked(path))

    def cookie(self) -> str:
        """The header that makes a browser keep the token."""
        return f"{_COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/"

    def _knows(self, given: str) -> bool:
        return self._token is not None and hmac.compare_digest(given.encode(), self._token.encode())


def _asked(path: str) -> str:
    return parse_qs(urlsplit(path).query).get("token", [""])[0]


def _kept(headers: Headers) -> str:
    kept: SimpleCookie = SimpleCookie()
    kept.load("; ".join(headers.get_all("Cookie")))
    return kept[_COOKIE].value if _COOKIE in kept else ""


def panel_address(text: str, token: str | None) -> tuple[str, int]:
    """Host and port at which a panel listens.

    Raises:
        InputError: the text is no address, or one beyond this machine without a token.
    """
    host, port = parse_address(text, anywhere=True)
    if token is None and not ipaddress.IPv4Address(host).is_loopback:
        raise InputError(
            f"a panel at {text} would let other machines move the platform: give a token of its own with "
            f"--page-token-file FILE, or listen at {DEFAULT_ADDRESS}"
        )
    return host, port


def open_server(host: str, port: int, token: str | None) -> viser.ViserServer:
    """Serve an empty page behind a gate.

    Raises:
        InputError: the address cannot be used.
    """
    # The library would take the next port that is free.
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise InputError(f"the panel cannot listen at {host}:{port}: {error.strerror}: choose another --listen") from None
    with _gated(Gate(host, token)), redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host, port, label="gough", verbose=False)
    # It would lead through a server elsewhere.
    server.request_share_url = lambda verbose=True: None  # type: ignore[method-assign]
    return server


def close_server(server: viser.ViserServer) -> None:
    """End a server, which would say so."""
    with redirect_stdout(io.StringIO()):
        server.stop()


@contextmanager
def _gated(gate: Gate) -> Iterator[None]:
    """Put a gate before the server that is started meanwhile: the library has no place for one."""
    serve = websockets.asyncio.server.serve

    def gated(handler: Any, host: str, port: int, *, process_request: Any, **settings: Any) -> Any:
        def process(connection: Any, request: Request) -> Response | None:
            if refusal := gate.refusal(request.headers, request.path):
                body = f"{refusal}\n".encode()
                kind = Headers({"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))})
                return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", kind, body)
            response: Response | None = process_request(connection, request)
            if response is not None:
                # Nobody may show this page within another.
                response.headers["X-Frame-Options"] = "DENY"
                response.headers["Referrer-Policy"] = "no-referrer"
                if gate.admits(request.path):
                    response.headers["Set-Cookie"] = gate.cookie()
            return response

        return serve(handler, host, port, process_request=process, **settings)

    setattr(websockets.asyncio.server, "serve", gated)  # noqa: B010
    try:
        yield
    finally:
        setattr(websockets.asyncio.server, "serve", serve)  # noqa: B010
