"""A page of this machine: where it is served, and what every page of fusecap looks like.

Served to this machine alone unless told otherwise. A browser lets any web site open a connection to
this machine, and a viewer shows people; so connections that another site's page opens are refused,
and viser's public links are off. A page that other machines can reach has a random name, and only
who knows it gets the page or its socket: viser's page connects to the address that it came from.
"""

from __future__ import annotations

import atexit
import errno
import logging
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import rich
import viser
from viser import infra
from viser.infra import WebsockClientConnection
from websockets.asyncio.server import ServerConnection

from fusecap.errors import InputError
from fusecap.streams.door import Door, new_token
from fusecap.streams.target import LOOPBACK

DEFAULT_PORT = 8080
_PORTS_TRIED = 20
_PANEL_WIDTH_PX = 360
_LIBRARIES = ("websockets.server", "asyncio")


class Page(viser.ViserServer):
    """Serves until `stop`."""

    def __init__(self, title: str, *, host: str = LOOPBACK, port: int | None = None) -> None:
        """Port None: the first free one from 8080 on.

        Raises `InputError` where the address is not this machine's or the port is taken.
        """
        chosen = _free_port(host) if port is None else _checked_port(host, port)
        rich.get_console().quiet = True  # viser's own messages; fusecap's consoles are others
        for library in _LIBRARIES:  # what they say about ill-mannered clients
            logging.getLogger(library).addHandler(logging.NullHandler())
        self._door = Door(token=new_token(host))
        name = f"{self._door.token}.html" if self._door.token else ""
        with _served_as(name):
            super().__init__(host=host, port=chosen, label=title, verbose=False)
        self.address = f"http://{_in_url(host)}:{self.get_port()}/{name}".rstrip("/")
        self.is_open = bool(self._door.token)
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
        refusal = _refusal(connection, self._door)
        if refusal:
            await connection.close(1008, refusal)


def note_if_open(page: Page) -> str | None:
    """What a user must know about a page that other machines can reach."""
    if not page.is_open:
        return None
    return (
        f"{page.address} is open to other machines, with {socket.gethostname()} in place of "
        "localhost: whoever has the address can watch and press every button; it is new each time, "
        "and nothing is encrypted"
    )


def _refusal(connection: ServerConnection, door: Door) -> str:
    """Empty for the page that was served here, and for programs, which name no origin."""
    if connection.request is None:
        return "nothing was asked for"
    headers = connection.request.headers
    host, origin = ", ".join(headers.get_all("Host")), ", ".join(headers.get_all("Origin")) or None
    if origin is not None and origin.partition("://")[2] != host:
        return "opened by another site"
    name = connection.request.path.partition("?")[0].strip("/")
    return door.refusal(token=name.removesuffix(".html"), host=host, origin=origin)


@contextmanager
def _served_as(name: str) -> Iterator[None]:
    """A viser server that is made meanwhile serves its page by this name alone."""
    if not name:
        yield
        return
    usual = infra.WebsockServer
    folder = tempfile.mkdtemp(prefix="fusecap-page-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)

    class Named(usual):
        def __init__(self, *args: Any, http_server_root: Path, **options: Any) -> None:
            shutil.copy(http_server_root / "index.html", Path(folder) / name)
            super().__init__(*args, http_server_root=Path(folder), **options)

    try:
        infra.WebsockServer = Named
        yield
    finally:
        infra.WebsockServer = usual


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
