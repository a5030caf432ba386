"""Who may connect to the servers of this machine: not the pages of other web sites."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
import viser
import websockets
from websockets.asyncio.client import connect
from websockets.typing import Origin, Subprotocol

from fusecap.streams.door import Door, new_token
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts, WebSocketServer
from fusecap.viewer.page import Page, note_if_open

SITES = ["https://example.com", "null", "http://localhost.example.com", "file://", "http://[::"]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.mark.parametrize("origin", SITES)
def test_on_loopback_pages_of_other_sites_are_refused(origin):
    door = Door(token=new_token("127.0.0.1"))
    assert door.refusal(token="", host="127.0.0.1:8765", origin=origin) == "opened by another site"
    assert door.refusal(token="", host="localhost:8765", origin=None) == ""
    assert door.refusal(token="", host="[::1]:8765", origin="http://localhost:5173") == ""


@pytest.mark.parametrize(
    "host",
    ["evil.example:8765", "", "0.0.0.0", "127.0.0.1, evil", "10.0.0.1", "localhost:8765, evil"],
)
def test_a_name_that_another_site_gave_this_machine_is_refused(host):
    assert "another name" in Door(token="").refusal(token="", host=host, origin=None)


def test_beyond_loopback_the_token_decides_and_is_new_each_time():
    token = new_token("0.0.0.0")
    assert len(token) >= 20 and token != new_token("0.0.0.0")
    door = Door(token=token)
    for wrong in ("", "x", token[:-1], token + "x", "é"):
        assert door.refusal(token=wrong, host="studio:1", origin=None)
    assert door.refusal(token=token, host="studio:1", origin="https://example.com") == ""


@pytest.fixture(params=["", "secret"])
def stream(request) -> Iterator[tuple[WebSocketServer, int, str]]:
    port = free_port()
    server = WebSocketServer("127.0.0.1", port, Counts(), Door(token=request.param))
    server.publish_cast("cast")
    yield server, port, request.param
    server.close()


async def heard(url: str, origin: str | None = None, **options: object) -> str:
    named = None if origin is None else Origin(origin)
    async with connect(url, origin=named, **options) as connection:
        return str(await asyncio.wait_for(connection.recv(), 20))


def test_a_stream_admits_programs_and_own_pages_or_who_has_the_token(stream):
    _, port, token = stream
    where = f"ws://127.0.0.1:{port}"
    admitted = [(f"{where}/?token={token}", None), (f"{where}/?token={token}", "http://localhost")]
    refused = [(f"{where}/?token=guessed", site) for site in SITES[:3]]
    if token:
        admitted += [(f"{where}/?token={token}", SITES[0])]
        refused += [(where, None), (f"{where}/{token}", None)]
    for url, origin in admitted:
        assert asyncio.run(heard(url, origin)) == "cast"
    for url, origin in refused:
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run(heard(url, origin))


def test_a_stream_asked_for_by_a_name_of_another_site_is_refused():
    port = free_port()
    server = WebSocketServer("127.0.0.1", port, Counts(), Door(token=""))
    try:
        rebound = f"ws://evil.example:{port}"
        with pytest.raises(websockets.InvalidStatus, match="403"):
            asyncio.run(heard(rebound, "http://evil.example", sock=to(port)))
    finally:
        server.close()


def to(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port))


def test_a_target_beyond_loopback_shows_its_token_in_its_address_alone():
    target = Target(protocol="ws", host="0.0.0.0", port=8765, token="secret")
    assert target.address == f"ws://{socket.gethostname()}:8765/?token=secret"
    assert "secret" not in str(target)
    assert Target(protocol="ws", host="127.0.0.1", port=1).address == "ws://127.0.0.1:1"


async def close_code(url: str, origin: str | None) -> int | None:
    """With which the server closes the connection; None where it sends something instead."""
    async with connect(
        url,
        origin=None if origin is None else Origin(origin),
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
        max_size=None,
    ) as connection:
        try:
            await asyncio.wait_for(connection.recv(), 20)
        except websockets.ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else 0
        return None


def test_an_open_page_is_served_and_connected_to_by_its_own_address_alone():
    page = Page("test", host="0.0.0.0", port=free_port())
    try:
        port = page.get_port()
        assert page.is_open and page.address.startswith(f"http://localhost:{port}/")
        assert page.address in (note_if_open(page) or "")
        with urllib.request.urlopen(page.address, timeout=20) as reply:
            assert b"<html" in reply.read(2000).lower()
        for other in ("", "index.html", "guessed.html"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(f"http://localhost:{port}/{other}", timeout=20)
        socket_address = page.address.replace("http", "ws", 1)
        own = f"http://localhost:{port}"
        assert asyncio.run(close_code(socket_address, own)) is None
        assert asyncio.run(close_code(socket_address, None)) is None
        assert asyncio.run(close_code(socket_address, "https://example.com")) == 1008
        for other in ("", "/guessed.html", "/index.html"):
            assert asyncio.run(close_code(f"ws://localhost:{port}{other}", None)) == 1008
    finally:
        page.stop()


def test_strays_that_connect_to_a_page_or_a_stream_leave_no_word(capfd):
    page, port = Page("test"), free_port()
    server = WebSocketServer("127.0.0.1", port, Counts(), Door(token=""))
    try:
        for number in (page.get_port(), port):
            for said in (b"", b"\x16\x03\x01 no TLS here", b"GET / HTTP/1.1\r\n", bytes(100_000)):
                with to(number) as stray:
                    stray.sendall(said)
                    stray.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        time.sleep(1.0)
    finally:
        page.stop()
        server.close()
    told = capfd.readouterr()
    assert told.err == "" and told.out == ""


def test_a_client_that_sends_much_is_let_go():
    port = free_port()
    server = WebSocketServer("127.0.0.1", port, Counts(), Door(token=""))

    async def flood() -> int:
        async with connect(f"ws://127.0.0.1:{port}") as connection:
            try:
                await connection.send(bytes(100_000))
                await asyncio.wait_for(connection.wait_closed(), 20)
            except websockets.ConnectionClosed:
                pass
            return connection.close_code or 0

    try:
        assert asyncio.run(flood()) == 1009
    finally:
        server.close()
