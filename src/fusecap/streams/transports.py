"""What carries packets: UDP and a WebSocket server. Neither ever waits.

A receiver that is missing, slow or stalled costs the sender nothing: UDP datagrams that the system
does not take at once are dropped, a WebSocket client has a short queue of its own whose oldest
message makes room for the newest.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import socket
import threading
from collections import deque
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from fusecap.errors import InputError
from fusecap.streams.door import Door

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

CLIENT_QUEUE = 4
"""Messages a WebSocket client may lie behind."""
_MOST_HEARD = 1000
"""Messages of a client, which nobody asked for: then it is let go."""
_MOST_HEARD_BYTES = 1024
"""Of a message from a client; none is used."""
_GOODBYE_S = 0.5
"""How long the server lets clients take what is queued when it closes."""
_LOG = logging.getLogger("fusecap.websocket")
_LOG.addHandler(logging.NullHandler())
_LOG.propagate = False
"""Keeps what the library says about ill-mannered clients off the terminal."""


@dataclass(kw_only=True)
class Counts:
    """What became of the packets so far."""

    sent: int = 0
    """Taken by the operating system, or by a library; not: received."""
    bytes: int = 0
    dropped: int = 0
    """Because a buffer or a client's queue was full."""
    refused: int = 0
    """Answers of the other machine that nobody listens on the port."""
    failed: int = 0
    last_failure: str = ""


class UdpSender:
    """Datagrams to one address, without waiting."""

    def __init__(self, host: str, port: int, counts: Counts) -> None:
        self._counts = counts
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                host, port, type=socket.SOCK_DGRAM
            )[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.setblocking(False)
            self._socket.connect(address)
        except (OSError, UnicodeError) as error:
            raise InputError(
                f"cannot send to {host}:{port}: {_reason(error)}; check the name of the host"
            ) from error

    def send(self, datagram: bytes) -> None:
        """Hand one datagram to the system, or drop it."""
        for _ in range(2):
            try:
                self._socket.send(datagram)
            except ConnectionRefusedError:
                # The answer to an earlier datagram; this one has not been sent yet.
                self._counts.refused += 1
            except BlockingIOError:
                self._counts.dropped += 1
                return
            except OSError as error:
                if error.errno == errno.ENOBUFS:
                    self._counts.dropped += 1
                else:
                    self._counts.failed += 1
                    self._counts.last_failure = _reason(error)
                return
            else:
                self._counts.sent += 1
                self._counts.bytes += len(datagram)
                return

    def close(self) -> None:
        self._socket.close()


class _Client:
    """One WebSocket connection: what it still has to get, newest last."""

    def __init__(self, connection: ServerConnection, *, binary: bool) -> None:
        self.connection = connection
        self.binary = binary
        self.busy = False
        """Has been given a message that it does not take."""
        self.cast: str | None = None
        self.frames: deque[str | bytes] = deque(maxlen=CLIENT_QUEUE)
        self.something = asyncio.Event()


class WebSocketServer:
    """Serves messages to any number of clients from a thread of its own.

    Clients of `/binary` get binary frames, all others text; the `door` says who is one. Raises
    `InputError` where the port cannot be had.
    """

    def __init__(self, host: str, port: int, counts: Counts, door: Door) -> None:
        self.clients_ever = 0
        self._door = door
        self._counts = counts
        self._clients: set[_Client] = set()
        self._cast: str | None = None
        self._failure: OSError | UnicodeError | None = None
        self._ready = threading.Event()
        self._loop = asyncio.new_event_loop()
        self._closing: asyncio.Event | None = None
        self._thread = threading.Thread(
            target=self._run, args=(host, port), name="fusecap-websocket", daemon=True
        )
        self._thread.start()
        self._ready.wait()
        if self._failure is not None:
            self._thread.join()
            in_use = getattr(self._failure, "errno", None) == errno.EADDRINUSE
            what = "is in use by another program" if in_use else "cannot be opened"
            raise InputError(
                f"ws://{host}:{port}: the port {what} ({_reason(self._failure)}); "
                "choose another address"
            )

    @property
    def clients(self) -> int:
        """Connected now."""
        return len(self._clients)

    @property
    def wants(self) -> set[bool]:
        """Which forms are listened to: True is binary."""
        return {client.binary for client in tuple(self._clients)}

    def publish_cast(self, cast: str) -> None:
        """Tell everyone, and whoever connects from now on, who is in the stream."""
        self._loop.call_soon_threadsafe(self._set_cast, cast)

    def publish(self, text: str | None, binary: bytes | None) -> None:
        """One instant; a form is None where `wants` did not have it."""
        self._loop.call_soon_threadsafe(self._queue, text, binary)

    def close(self) -> None:
        """Let clients take what is queued, say goodbye and end the thread."""
        closing = self._closing
        if closing is not None and self._thread.is_alive():
            self._loop.call_soon_threadsafe(closing.set)
        self._thread.join()

    def _run(self, host: str, port: int) -> None:
        try:
            self._loop.run_until_complete(self._serve(host, port))
        except (OSError, UnicodeError) as error:
            self._failure = error
        finally:
            self._loop.close()
            self._ready.set()

    async def _serve(self, host: str, port: int) -> None:
        from websockets.asyncio.server import serve

        self._closing = asyncio.Event()
        server = serve(
            self._attend,
            host,
            port,
            compression=None,
            close_timeout=_GOODBYE_S,
            logger=_LOG,
            max_size=_MOST_HEARD_BYTES,
            max_queue=1,
            process_request=self._admit,
        )
        async with server:
            self._ready.set()
            await self._closing.wait()
            deadline = self._loop.time() + _GOODBYE_S
            while self._loop.time() < deadline and any(c.busy for c in self._clients):
                await asyncio.sleep(0.01)
            for client in tuple(self._clients):
                if client.busy:
                    client.connection.transport.abort()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        headers = request.headers
        refusal = self._door.refusal(
            token=parse_qs(urlsplit(request.path).query).get("token", [""])[0],
            host=", ".join(headers.get_all("Host")),
            origin=", ".join(headers.get_all("Origin")) or None,
        )
        return connection.respond(HTTPStatus.FORBIDDEN, f"{refusal}\n") if refusal else None

    async def _attend(self, connection: ServerConnection) -> None:
        from websockets.exceptions import ConnectionClosed

        path = connection.request.path if connection.request else "/"
        client = _Client(connection, binary=path.split("?")[0].rstrip("/") == "/binary")
        client.cast = self._cast
        client.something.set()
        self._clients.add(client)
        self.clients_ever += 1
        gone = asyncio.ensure_future(self._hear(connection))
        try:
            while not gone.done():
                woken = asyncio.ensure_future(client.something.wait())
                await asyncio.wait({woken, gone}, return_when=asyncio.FIRST_COMPLETED)
                woken.cancel()
                client.something.clear()
                with contextlib.suppress(ConnectionClosed):
                    await self._send_queued(client)
        finally:
            gone.cancel()
            self._clients.discard(client)

    async def _hear(self, connection: ServerConnection) -> None:
        """Until a client is gone: what is left unread would hide its farewell."""
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            for _ in range(_MOST_HEARD):
                await connection.recv()
            await connection.close(1008, "this stream only sends")

    async def _send_queued(self, client: _Client) -> None:
        if client.cast is not None:
            cast, client.cast = client.cast, None
            await client.connection.send(cast)
        while client.frames:
            frame = client.frames.popleft()
            await client.connection.send(frame)
            self._counts.sent += 1
            self._counts.bytes += len(frame)
        client.busy = False

    def _set_cast(self, cast: str) -> None:
        self._cast = cast
        for client in self._clients:
            client.cast = cast
            client.busy = True
            client.something.set()

    def _queue(self, text: str | None, binary: bytes | None) -> None:
        for client in self._clients:
            frame = binary if client.binary else text
            if frame is None:
                continue
            self._counts.dropped += len(client.frames) == client.frames.maxlen
            client.frames.append(frame)
            client.busy = True
            client.something.set()


def _reason(error: OSError | UnicodeError) -> str:
    return getattr(error, "strerror", None) or str(error)
