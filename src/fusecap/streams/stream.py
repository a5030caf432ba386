"""A stream: an encoder joined to what carries its packets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from fusecap.body.shape import BodyShape
from fusecap.streams.person_pose import StreamFrame
from fusecap.streams.protocols import protocol_named
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts, UdpSender

Cast = dict[str, BodyShape]
"""Everyone a stream is about, in its order."""


class Stream(Protocol):
    """Takes one instant after the other."""

    target: Target
    counts: Counts

    def send(self, frame: StreamFrame) -> None:
        """Send one instant; never waits."""
        ...

    def set_cast(self, cast: Cast) -> None:
        """From now on it is about these people; raises `InputError` where some have no room."""
        ...

    def remark(self) -> str:
        """What a user should know about the receiving side; empty when all is well."""
        ...

    def where(self) -> dict[str, str]:
        """Address per person, where persons have addresses of their own."""
        ...

    def close(self) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamProtocol:
    """What a protocol's module says of it."""

    open: Callable[[Target, Cast, float], Stream]
    """With the rate [Hz] of frames; raises `InputError` where an address cannot be had."""
    port: int | None
    """The usual one; None: receivers are found by themselves."""
    serves: bool = False
    """Receivers connect to the target, which is an address of this machine."""


def open_stream(target: Target, cast: Cast, rate_hz: float) -> Stream:
    """A stream to `target`; raises `InputError` where an address cannot be had."""
    return protocol_named(target.protocol).open(target, cast, rate_hz)


def udp_protocol(
    encode: Callable[[StreamFrame, float], list[bytes]], *, port: int
) -> StreamProtocol:
    """One that sends everyone to one address; `encode` takes a frame and the rate [Hz]."""
    return StreamProtocol(
        open=lambda target, cast, rate_hz: UdpStream(target, lambda frame: encode(frame, rate_hz)),
        port=port,
    )


class UdpStream:
    """Everyone to one address."""

    def __init__(self, target: Target, encode: Callable[[StreamFrame], list[bytes]]) -> None:
        self.target = target
        self.counts = Counts()
        self._encode = encode
        self._sender = UdpSender(target.host, target.port, self.counts)

    def send(self, frame: StreamFrame) -> None:
        for datagram in self._encode(frame):
            self._sender.send(datagram)

    def set_cast(self, cast: Cast) -> None:
        """Every packet names its people by itself."""

    def remark(self) -> str:
        return udp_remark(self.counts)

    def where(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        self._sender.close()


def udp_remark(counts: Counts) -> str:
    """What the counts of datagrams tell a user."""
    if counts.failed:
        return f"{counts.failed} packets could not be sent: {counts.last_failure}"
    if 2 * counts.refused > counts.sent:
        return "nobody listens there; start the receiver, check its port and the firewall"
    if counts.dropped:
        return "packets were dropped before they left this machine; its network is too slow"
    return ""
