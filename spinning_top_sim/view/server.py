# SPDX-License-Identifier: Apache-2.0
"""The server of the page: its port, and the web pages that may talk to it."""

import contextlib
import io
import ipaddress
import socket
import urllib.parse
from collections.abc import Mapping

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
        _check_port(host, port)
        with contextlib.redirect_stdout(io.StringIO()):     # without one, the first free port
            super().__init__(host=host, port=FIRST_PORT if port is None else port, verbose=False)
        names = {name.lower() for name in (host, 'localhost', socket.gethostname(),
                                           f'{socket.gethostname()}.local', socket.getfqdn())}
        # viser has no option for it, and tells only these objects of a connection.
        sockets = self._websock_server

        async def check(connection: WebsockClientConnection) -> None:
            opened = sockets._live_connections[connection.client_id]
            if opened.request and (reason := refusal(opened.request.headers, names)):
                await opened.close(REFUSED, reason[:100])

        sockets.on_client_connect(check)

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()


def _check_port(host: str, port: int | None) -> None:
    """Raise OSError if the port cannot be used; viser would try others for ever."""
    try:
        socket.create_server((host, port or 0), family=(
            socket.AF_INET6 if ':' in host else socket.AF_INET)).close()
    except OSError as error:
        raise OSError(error.errno, f'{host} port {port or 0}: {error.strerror}') from error


def refusal(headers: Mapping[str, str], names: set[str]) -> str:
    """Return why a connection with these headers is refused; '' if it is not."""
    asked, origin = headers.get('Host', ''), headers.get('Origin')
    host = ''
    with contextlib.suppress(ValueError):       # malformed, or no address
        host = urllib.parse.urlsplit(f'//{asked}').hostname or ''
        ipaddress.ip_address(host)
        names = {*names, host}
    if host not in names:
        return f'Host: {asked}: must be an address or one of {", ".join(sorted(names))}'
    if origin is not None and origin.partition('://')[2].lower() != asked.lower():
        return f'Origin: {origin}: must be the address of this page, {asked}'
    return ''
