"""A page of this machine: where it is served, and what every page of fusecap looks like.

Served to this machine alone unless told otherwise. A browser lets any web site open a connection to
this machine, and a viewer shows people; so connections that another site's page opens are refused,
and viser's public links are off.
"""

from __future__ import annotations

import errno
import socket
from contextlib import suppress
from urllib.parse import urlsplit

import rich
import viser
from viser.infra import WebsockClientConnection
from websockets.asyncio.server import ServerConnection

from fusecap.errors import InputError
from fusecap.streams.target import LOOPBACK, is_loopback

DEFAULT_PORT = 8080
_PORTS_TRIED = 20
_PANEL_WIDTH_PX = 360


class Page(viser.ViserServer):
    """Serves until `stop`."""

    def __init__(self, title: str, *, host: str = LOOPBACK, port: int | None = None) -> None:
        """Port None: the first free one from 8080 on.

        Raises `InputError` where the address is not this machine's or the port is taken.
        """
        chosen = _free_port(host) if port is None else _checked_port(host, port)
        rich.get_console().quiet = True  # viser's own messages; fusecap's consoles are others
        super().__init__(host=host, port=chosen, label=title, verbose=False)
        self.address = f"http://{_in_url(host)}:{self.get_port()}"
        self.is_open = not is_loopback(host)
        """Whether other machines can reach it."""
        self._websock_server.on_client_connect(self._refuse_other_sites)
        self.scene.set_up_direction("+y")
        self.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self.gui.main_panel.dock_right()
        self.gui.main_panel.set_width(_PANEL_WIDTH_PX)

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: a page is never shared through a public server, even if a client asks for it."""
        return None

    async def _refuse_other_sites(self, client: WebsockClientConnection) -> None:
        connection = self._websock_server._live_connections[client.client_id]
        if not _same_site(connection, only_loopback=not self.is_open):
            await connection.close(1008, "opened by another site")


def note_if_open(page: Page) -> str | None:
    """What a user must know about a page that other machines can reach."""
    if not page.is_open:
        return None
    return (
        f"{page.address} is open: whoever reaches this machine on port {page.get_port()} can watch "
        "and press every button; there is no password and no encryption"
    )


def _same_site(connection: ServerConnection, *, only_loopback: bool) -> bool:
    """Whether the page that connects was served here; programs that name no origin may connect."""
    if connection.request is None:
        return False
    host = connection.request.headers.get("Host", "")
    origin = connection.request.headers.get("Origin")
    if only_loopback and not is_loopback(urlsplit(f"//{host}").hostname or ""):
        return False
    return origin is None or urlsplit(origin).netloc == host


def _free_port(host: str) -> int:
    for port in range(DEFAULT_PORT, DEFAULT_PORT + _PORTS_TRIED):
        with suppress(_PortTaken):
            return _checked_port(host, port)
    return 0


class _PortTaken(InputError):
    """Another program listens there."""


def _checked_port(host: str, port: int) -> int:
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, OverflowError) as error:
        number = error.errno if isinstance(error, OSError) else None
        if number == errno.EADDRINUSE:
            raise _PortTaken(
                f"port {port} of {host} is taken; leave --port out, or name another one, such as "
                f"--port {port + 1}"
            ) from None
        if number == errno.EACCES:
            raise InputError(f"port {port} is reserved; name one above 1023 with --port") from None
        raise InputError(
            f"--host {host}: not an address of this machine ({error}); leave it out for this "
            "machine alone, or write 0.0.0.0 to let others in"
        ) from None
    return port


def _in_url(host: str) -> str:
    if host in ("0.0.0.0", "::"):
        return "localhost"
    return f"[{host}]" if ":" in host else host
