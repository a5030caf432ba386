"""Garbage into the sockets that listen: the page's, the stream's; they go on, and leave no word."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import suppress
from random import Random

import msgspec
import numpy as np
import pytest
import viser
from websockets.asyncio.client import connect
from websockets.exceptions import WebSocketException
from websockets.typing import Subprotocol

from fusecap.streams.door import Door
from fusecap.streams.transports import Counts, WebSocketServer
from fusecap.viewer.page import Page
from fusecap.viewer.take import TakePage
from hostile_files import spoilt
from motions import person, take_of, walk

TIMES = 120
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: viser-v" + viser.__version__.encode() + b"\r\n\r\n"
)
FRAME = b"\x82\x85\x01\x02\x03\x04hello"
"""Binary, masked, of five bytes."""


@pytest.fixture
def page() -> Iterator[TakePage]:
    page = Page("test")
    try:
        yield TakePage(page, take_of(walk(person(), 30)[None], [person()], names=("anna",)))
    finally:
        page.stop()


@pytest.fixture
def stream() -> Iterator[int]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    server = WebSocketServer("127.0.0.1", port, Counts(), Door(token=""))
    server.publish_cast("cast")
    try:
        yield port
    finally:
        server.close()


def garble(port: int, random: Random) -> None:
    """Connections that break off in a handshake, or after one, in frames that are none."""
    for _ in range(TIMES):
        with socket.create_connection(("127.0.0.1", port), timeout=10) as stray, suppress(OSError):
            hello = HANDSHAKE % port
            if random.random() < 0.5:
                stray.sendall(spoilt(hello, random))
            else:
                stray.sendall(hello)
                stray.recv(64)
                stray.sendall(b"".join(spoilt(FRAME, random) for _ in range(4)))


async def heard(port: int, said: list[bytes | str] = [], **options: object) -> object:  # noqa: B006
    """What comes first from the server, after which `said` is said to it."""
    async with connect(f"ws://127.0.0.1:{port}", max_size=None, **options) as connection:
        first = await asyncio.wait_for(connection.recv(), 30)
        with suppress(WebSocketException):
            for message in said:
                await connection.send(message)
            await asyncio.sleep(0.05)
        return first


def test_a_stream_goes_on_after_garbage(stream, capfd):
    random = Random(0)
    garble(stream, random)
    for _ in range(20):
        said = [spoilt(b'{"type":"hello"}', random) for _ in range(5)]
        assert asyncio.run(heard(stream, [*said, "\x00", ""])) == "cast"
    assert asyncio.run(heard(stream)) == "cast"
    told = capfd.readouterr()
    assert told.err == "" and told.out == ""


def test_a_page_goes_on_after_garbage(page, capfd):
    random = Random(1)
    port = page._page.get_port()
    garble(port, random)
    viser_client = {"subprotocols": [Subprotocol(f"viser-v{viser.__version__}")]}
    for _ in range(15):
        assert asyncio.run(heard(port, list(messages(page, random)), **viser_client))
    assert asyncio.run(heard(port, **viser_client))
    page._draw(3, 0.05, plots=True)
    told = capfd.readouterr()
    assert told.err == "" and told.out == ""


def messages(page: TakePage, random: Random) -> Iterator[bytes]:
    """As a browser sends them, with values that no browser sends; then spoilt ones."""
    odd = (None, "x", -1, 1e308, float("nan"), [], {}, True, "9" * 5000, [[1e308] * 3], 2**63)
    handles = list(page._page.gui._gui_input_handle_from_uuid)
    for _ in range(10):
        named = {
            "type": "GuiUpdateMessage",
            "uuid": random.choice([*handles, "none", ""]),
            "updates": {random.choice(("value", "visible", "x")): random.choice(odd)},
        }
        yield msgspec.msgpack.encode(named)
    camera = {"type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": random.choice(odd)}
    yield msgspec.msgpack.encode(camera)
    yield spoilt(msgspec.msgpack.encode(camera), random)


def test_what_a_page_is_told_of_the_playhead_stays_within_the_take(page):
    head = page._controls._head
    for odd in (np.nan, np.inf, -np.inf, 1e308, -5.0):
        head.speed = odd
        head.seek(odd)
        head.toggle()
        head.advance(0.1)
        assert 0 <= head.position_s <= head.end_s and 0 <= head.frame < 30
