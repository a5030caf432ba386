"""Sensors whose samples come in UDP datagrams: one socket serves all sensors of an address."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Mapping, Sequence

from fusecap.live.devices.sensor_feed import SensorFeed
from fusecap.live.devices.source import Deliver, SessionClock, SourceCounts, SourceLost
from fusecap.sources.live_sensor import MAX_DATAGRAM_BYTES, Packet
from fusecap.streams.door import is_loopback

LISTEN_S = 0.2
"""How long one look at the socket takes, and so how soon the source stops."""
_RECEIVE_BUFFER = 1 << 20


class UdpImus:
    """Listens on one address; unknown senders and malformed datagrams are counted and dropped."""

    def __init__(
        self,
        *,
        name: str,
        host: str,
        port: int,
        parse: Callable[[bytes], Packet],
        sensors: Mapping[str, Sequence[SensorFeed]],
        clock: SessionClock,
    ) -> None:
        """`sensors` by the name that the sender calls them."""
        self._name = name
        self._host, self._port = host, port
        self._parse = parse
        self._sensors = sensors
        self._clock = clock
        self._counts = SourceCounts()
        self.address: tuple[str, int] | None = None
        """Where it listens, once it does."""

    @property
    def name(self) -> str:
        """Protocol and address."""
        return self._name

    @property
    def counts(self) -> SourceCounts:
        """What came in so far; `received` counts samples, `malformed` and `oversize` packets."""
        return self._counts

    def run(self, deliver: Deliver, stopping: threading.Event) -> None:
        """Raises `SourceLost` where the address cannot be had."""
        with self._listening() as listener:
            self._say("")
            while not stopping.is_set():
                try:
                    datagram = listener.recv(MAX_DATAGRAM_BYTES + 1)
                except TimeoutError:
                    continue
                except OSError as error:
                    raise self._lost(error) from None
                self._take(datagram, self._clock.now_ns(), deliver)

    def _listening(self) -> socket.socket:
        try:
            family, kind, protocol, _, address = socket.getaddrinfo(
                self._host, self._port, type=socket.SOCK_DGRAM, flags=socket.AI_PASSIVE
            )[0]
            listener = socket.socket(family, kind, protocol)
        except (OSError, UnicodeError) as error:
            raise self._lost(error) from None
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
            listener.bind(address)
            listener.settimeout(LISTEN_S)
        except OSError as error:
            listener.close()
            raise self._lost(error) from None
        self.address = listener.getsockname()[:2]
        return listener

    def _take(self, datagram: bytes, arrival_ns: int, deliver: Deliver) -> None:
        counts = self._counts
        if len(datagram) > MAX_DATAGRAM_BYTES:
            counts.oversize += 1
            self._say(f"refused a datagram over {MAX_DATAGRAM_BYTES} bytes")
            return
        packet = self._parse(datagram)
        if packet.refused:
            counts.malformed += 1
            self._say(f"refused: {packet.refused[-1]}")
        for sample in packet.samples:
            feeds = self._sensors.get(sample.sensor)
            if feeds is None:
                counts.dropped += 1
                if not counts.received:
                    self._say(f"no sensor of the session is called '{sample.sensor[:60]}'")
                continue
            for feed in feeds:
                restarts = feed.clock.restarts
                taken = feed.take(sample, arrival_ns)
                if feed.clock.restarts > restarts:
                    self._say(f"{feed.subject}/{feed.bone}: {feed.clock.note}")
                if taken is None:
                    counts.dropped += 1
                    continue
                counts.received += 1
                deliver(taken)

    def _say(self, what: str) -> None:
        """Puts it after what must always be known."""
        exposed = "" if is_loopback(self._host) else f"open to the network on {self._name}"
        self._counts.note = "; ".join(part for part in (exposed, what) if part)

    def _lost(self, error: OSError | UnicodeError) -> SourceLost:
        reason = getattr(error, "strerror", None) or str(error)
        return SourceLost(
            f"{self._name}: cannot listen there ({reason}); another program may have the port, or "
            "the host is not an address of this machine"
        )
