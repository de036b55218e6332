# SPDX-License-Identifier: Apache-2.0
"""The server of the page: on which port, and which pages of a browser may talk to it."""

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

PORTS = 100                     # tried in turn


class Server(viser.ViserServer):
    """
    Serves to who has the address, and to nobody else.

    A browser sends the pages of any site to any address.  So a request is refused whose `Origin`
    is another site, or whose `Host` is a name that is not this machine's: another site can let
    its own name stand for this address.  Raises OSError if the port cannot be used.
    """

    def __init__(self, host: str, port: int | None) -> None:
        with contextlib.redirect_stdout(io.StringIO()), _guarded(_names(host)):
            super().__init__(host=host, port=_free_port(host, port), verbose=False)

    def request_share_url(self, verbose: bool = True) -> None:
        """Refuse: viser would ask a server in the internet to pass the page on."""

    def stop(self) -> None:
        """Stop, without a word on the terminal."""
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def _free_port(host: str, port: int | None, first: int = 8080) -> int:
    """Return the port, by default the first free one.  Raises OSError if it cannot be used."""
    for number in (range(first, first + PORTS) if port is None else (port,)):
        try:
            family = socket.AF_INET6 if ':' in host else socket.AF_INET
            with socket.create_server((host, number), family=family) as server:
                return int(server.getsockname()[1])
        except OSError as error:
            if error.errno != errno.EADDRINUSE or number == port:
                raise OSError(error.errno, f'{host} port {number}: {error.strerror}') from error
    raise OSError(errno.EADDRINUSE, f'{host} ports {first} to {first + PORTS - 1}: in use')


def _names(host: str) -> set[str]:
    """Return the names by which a browser may ask for the page, besides addresses."""
    own = socket.gethostname()
    return {name.lower() for name in (host, 'localhost', own, f'{own}.local', socket.getfqdn())}


def refusal(asked: str | None, origin: str | None, names: set[str]) -> str:
    """
    Return why a request is refused; '' if it is not.

    asked : the header `Host`;  origin : the header `Origin`, None where no browser asks
    names : allowed, besides addresses
    """
    if asked and not _is_address(asked) and _hostname(asked) not in names:
        return f'Host: {asked}: must be an address or one of {", ".join(sorted(names))}'
    if origin is not None and origin.partition('://')[2].lower() != (asked or '').lower():
        return f'Origin: {origin}: must be the address of this page, {asked}'
    return ''


def _hostname(asked: str) -> str:
    """Return the host without the port; '' where there is none."""
    try:
        return urllib.parse.urlsplit(f'//{asked}').hostname or ''
    except ValueError:          # as a bracket that does not close
        return ''


def _is_address(asked: str) -> bool:
    try:
        ipaddress.ip_address(_hostname(asked))
    except ValueError:
        return False
    return True


@contextlib.contextmanager
def _guarded(names: set[str]) -> Iterator[None]:
    """
    Let what is served within refuse the requests of other sites.

    viser passes `websockets` no `origins`, which could not look at `Host` either; so this puts a
    question before the one that viser answers requests with.
    """
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
