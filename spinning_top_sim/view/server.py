# SPDX-License-Identifier: Apache-2.0
"""The server of the page: its port, and the web pages that may talk to it."""

import contextlib
import errno
import io
import ipaddress
import socket
import urllib.parse

import viser
from viser.infra import WebsockClientConnection

FIRST_PORT = 8080
REFUSED = 1008              # code of a closed websocket: against the policy of the server


class Server(viser.ViserServer):
    """
    Serves this page, and refuses connections that come from the pages of other sites.

    A connection is refused if its `Origin` is another site, or if its `Host` is not a name of
    this machine: another site can let its own name stand for this address (DNS rebinding).
    Raises OSError if the port cannot be used.
    """

    def __init__(self, host: str, port: int | None) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host=host, port=_free_port(host, port), verbose=False)
        own = socket.gethostname()
        names = {name.lower() for name in (
            host, 'localhost', own, f'{own}.local', socket.getfqdn())}
        # viser has no option for it, and tells only these objects of a connection.
        sockets = self._websock_server

        async def check(connection: WebsockClientConnection) -> None:
            opened = sockets._live_connections[connection.client_id]
            headers = opened.request.headers if opened.request else {}
            if reason := refusal(headers.get('Host'), headers.get('Origin'), names):
                await opened.close(REFUSED, reason[:100])

        sockets.on_client_connect(check)

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


def refusal(asked: str | None, origin: str | None, names: set[str]) -> str:
    """
    Return why a connection is refused; '' if it is not.

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
