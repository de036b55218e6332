# SPDX-License-Identifier: Apache-2.0
"""The server of the page: its port, and the web pages that may talk to it."""

import contextlib
import errno
import http
import io
import ipaddress
import socket
import urllib.parse
from collections.abc import Callable, Iterator

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

Answer = Callable[[ServerConnection, Request], Response | None]

FIRST_PORT = 8080


class Server(viser.ViserServer):
    """
    Serves this page, and refuses requests that come from the pages of other sites.

    A request is refused if its `Origin` is another site, or if its `Host` is not a name of this
    machine: another site can let its own name stand for this address (DNS rebinding).  Raises
    OSError if the port cannot be used.
    """

    def __init__(self, host: str, port: int | None) -> None:
        with contextlib.redirect_stdout(io.StringIO()), _guarded(_names(host)):
            super().__init__(host=host, port=_free_port(host, port), verbose=False)

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: viser would share the page by a public server."""

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def _free_port(host: str, port: int | None) -> int:
    """Return the port.  Raises OSError if it cannot be used; viser would try for ever."""
    number = FIRST_PORT if port is None else port
    try:
        family = socket.AF_INET6 if ':' in host else socket.AF_INET
        with socket.create_server((host, number), family=family) as server:
            return int(server.getsockname()[1])
    except OSError as error:
        if port is None and error.errno == errno.EADDRINUSE:
            return number               # viser takes the next free one
        raise OSError(error.errno, f'{host} port {number}: {error.strerror}') from error


def _names(host: str) -> set[str]:
    """Return the names of this machine that a request may contain."""
    own = socket.gethostname()
    return {name.lower() for name in (host, 'localhost', own, f'{own}.local', socket.getfqdn())}


def refusal(asked: str | None, origin: str | None, names: set[str]) -> str:
    """
    Return why a request is refused; '' if it is not.

    asked : the header `Host`;  origin : the header `Origin`, None if no browser asks
    names : the names that are allowed; addresses always are
    """
    host = ''
    with contextlib.suppress(ValueError):       # malformed, or no address
        host = urllib.parse.urlsplit(f'//{asked or ""}').hostname or ''
        ipaddress.ip_address(host)
        names = {*names, host}
    if asked and host not in names:
        return f'Host: {asked}: must be an address or one of {", ".join(sorted(names))}'
    if origin is not None and origin.partition('://')[2].lower() != (asked or '').lower():
        return f'Origin: {origin}: must be the address of this page, {asked}'
    return ''


@contextlib.contextmanager
def _guarded(names: set[str]) -> Iterator[None]:
    """Make servers that start in this context refuse other sites; viser has no option for it."""
    serve = websockets.asyncio.server.serve

    def guarded(*arguments: object, process_request: Answer, **options: object) -> object:
        def answer(connection: ServerConnection, request: Request) -> Response | None:
            reason = refusal(request.headers.get('Host'), request.headers.get('Origin'), names)
            if reason:
                return connection.respond(http.HTTPStatus.FORBIDDEN, f'{reason}\n')
            return process_request(connection, request)
        return serve(*arguments, process_request=answer, **options)     # type: ignore[arg-type]

    websockets.asyncio.server.serve = guarded       # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve     # type: ignore[misc]
