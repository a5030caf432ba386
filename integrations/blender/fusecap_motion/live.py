"""A client of fusecap's WebSocket stream (RFC 6455, text), without a library.

A thread keeps the cast and the newest frame; Blender's timer takes them. What is behind is dropped.
"""

import base64
import contextlib
import json
import os
import socket
import struct
import threading
from urllib.parse import urlsplit

_MOST_BYTES = 1 << 24


class Client:
    """Connected from the start; raises OSError where nobody listens."""

    def __init__(self, address):
        url = urlsplit(address)
        if url.scheme != "ws" or not url.hostname:
            raise OSError(f"'{address}': expected ws://HOST:PORT")
        self._socket = socket.create_connection((url.hostname, url.port or 8765), timeout=5)
        key = base64.b64encode(os.urandom(16)).decode()
        path = (url.path or "/") + (f"?{url.query}" if url.query else "")
        self._socket.sendall(
            f"GET {path} HTTP/1.1\r\nHost: {url.hostname}:{url.port or 8765}\r\n"
            "Upgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        self._data = b""
        head = self._until(b"\r\n\r\n")
        if b" 101 " not in head.split(b"\r\n")[0]:
            raise OSError(f"{address} answered {head.splitlines()[0].decode(errors='replace')}")
        self._lock = threading.Lock()
        self._cast, self._frames = None, []
        self.ended = ""
        """Why, once it has."""
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def news(self, *, all_frames):
        """A new cast or None, and the frames since the last call: all, or the newest."""
        with self._lock:
            cast, self._cast = self._cast, None
            frames, self._frames = self._frames, []
        return cast, frames if all_frames else frames[-1:]

    def close(self):
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(timeout=2)

    def _run(self):
        try:
            while True:
                message = json.loads(self._message())
                with self._lock:
                    if message["type"] == "cast":
                        self._cast, self._frames = message, []
                    elif message["type"] == "frame":
                        self._frames.append(message)
                        del self._frames[:-600]
        except (OSError, ValueError, KeyError) as error:
            self.ended = str(error) or "the stream has ended"

    def _message(self):
        parts = []
        while True:
            first, second = self._exactly(2)
            length = second & 127
            if length == 126:
                (length,) = struct.unpack(">H", self._exactly(2))
            elif length == 127:
                (length,) = struct.unpack(">Q", self._exactly(8))
            if length > _MOST_BYTES:
                raise OSError("a message is too long")
            data, kind = self._exactly(length), first & 15
            if kind == 8:
                raise OSError("the stream has ended")
            if kind == 9:
                mask = os.urandom(4)
                masked = bytes(b ^ mask[i % 4] for i, b in enumerate(data[:125]))
                self._socket.sendall(bytes([0x8A, 0x80 | len(masked)]) + mask + masked)
            elif kind in (0, 1):
                parts.append(data)
                if first & 128:
                    return b"".join(parts)

    def _until(self, mark):
        while mark not in self._data:
            self._receive()
        head, _, self._data = self._data.partition(mark)
        return head

    def _exactly(self, count):
        while len(self._data) < count:
            self._receive()
        taken, self._data = self._data[:count], self._data[count:]
        return taken

    def _receive(self):
        while True:
            try:
                more = self._socket.recv(1 << 16)
                break
            except TimeoutError:
                continue
        if not more:
            raise OSError("the stream has ended")
        self._data += more
