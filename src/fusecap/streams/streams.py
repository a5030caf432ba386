"""A stream: an encoder joined to what carries its packets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import InputError
from fusecap.streams.livelink import livelink_datagrams
from fusecap.streams.lsl import lsl_sample
from fusecap.streams.osc import osc_datagrams
from fusecap.streams.person_pose import StreamFrame
from fusecap.streams.rokoko import rokoko_datagrams
from fusecap.streams.target import Target
from fusecap.streams.transports import Counts, LslOutlet, UdpSender, WebSocketServer, check_lsl
from fusecap.streams.vmc import PORT_STEP, vmc_datagrams
from fusecap.streams.websocket import cast_message, frame_bytes, frame_text

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


def open_stream(target: Target, cast: Cast, rate_hz: float) -> Stream:
    """A stream to `target`; raises `InputError` where an address cannot be had."""
    if target.protocol == "vmc":
        return VmcStream(target, cast)
    if target.protocol == "ws":
        return WebSocketStream(target, cast, rate_hz)
    if target.protocol == "lsl":
        return LslStream(target, cast, rate_hz)
    encode: Callable[[StreamFrame], list[bytes]] = {
        "livelink": livelink_datagrams,
        "osc": osc_datagrams,
        "rokoko": lambda frame: rokoko_datagrams(frame, rate_hz),
    }[target.protocol]
    return UdpStream(target, encode)


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
        return _udp_remark(self.counts)

    def where(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        self._sender.close()


class VmcStream:
    """Each person to a port of their own; who comes later gets the first that is free."""

    def __init__(self, target: Target, cast: Cast) -> None:
        self.target = target
        self.counts = Counts()
        self._ports: dict[str, int] = {}
        self._senders: dict[str, UdpSender] = {}
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        for name, pose in frame.people.items():
            if name in self._senders:
                for datagram in vmc_datagrams(pose, frame.time_s):
                    self._senders[name].send(datagram)

    def set_cast(self, cast: Cast) -> None:
        """Opens ports for who is new and closes those of who is gone."""
        last = self.target.port + PORT_STEP * (len(cast) - 1)
        if last > 65535:
            raise InputError(
                f"{self.target}: {len(cast)} people need ports up to {last}; choose a lower one"
            )
        for name in [name for name in self._ports if name not in cast]:
            del self._ports[name]
            self._senders.pop(name).close()
        usable = range(self.target.port, last + 1, PORT_STEP)
        for name in cast:
            if name not in self._ports:
                port = next(port for port in usable if port not in self._ports.values())
                self._senders[name] = UdpSender(self.target.host, port, self.counts)
                self._ports[name] = port

    def remark(self) -> str:
        return _udp_remark(self.counts)

    def where(self) -> dict[str, str]:
        return {
            name: str(Target(protocol="vmc", host=self.target.host, port=port))
            for name, port in self._ports.items()
        }

    def close(self) -> None:
        for sender in self._senders.values():
            sender.close()


class WebSocketStream:
    """Everyone to every client."""

    def __init__(self, target: Target, cast: Cast, rate_hz: float) -> None:
        self.target = target
        self.counts = Counts()
        self._server = WebSocketServer(target.host, target.port, self.counts)
        self._rate_hz = rate_hz
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        wants = self._server.wants
        if wants:
            self._server.publish(
                frame_text(frame) if False in wants else None,
                frame_bytes(frame) if True in wants else None,
            )

    def set_cast(self, cast: Cast) -> None:
        """Tells every client."""
        self._server.publish_cast(cast_message(cast.items(), self._rate_hz))

    def remark(self) -> str:
        if not self._server.clients_ever:
            return f"no client has connected; open {self.target} or {self.target}/binary"
        if self.counts.dropped:
            return "a client is too slow and misses frames"
        return ""

    def where(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        self._server.close()


class LslStream:
    """One outlet per person."""

    def __init__(self, target: Target, cast: Cast, rate_hz: float) -> None:
        self.target = target
        self.counts = Counts()
        self._rate_hz = rate_hz
        self._skeletons: dict[str, Skeleton] = {}
        self._outlets: dict[str, LslOutlet] = {}
        check_lsl()
        self.set_cast(cast)

    def send(self, frame: StreamFrame) -> None:
        for name, pose in frame.people.items():
            if name in self._outlets:
                self._outlets[name].send(lsl_sample(pose, self._skeletons[name]))

    def set_cast(self, cast: Cast) -> None:
        """Opens outlets for who is new and closes those of who is gone."""
        for name in [name for name in self._outlets if name not in cast]:
            self._outlets.pop(name).close()
        for name, shape in cast.items():
            if name not in self._outlets:
                self._skeletons[name] = shape.skeleton
                self._outlets[name] = LslOutlet(name, shape.skeleton, self._rate_hz, self.counts)

    def remark(self) -> str:
        if any(outlet.heard for outlet in self._outlets.values()):
            return ""
        return "nobody has subscribed; look for streams of type MoCap"

    def where(self) -> dict[str, str]:
        return {name: f"lsl stream 'fusecap {name}'" for name in self._outlets}

    def close(self) -> None:
        for outlet in self._outlets.values():
            outlet.close()


def _udp_remark(counts: Counts) -> str:
    if counts.failed:
        return f"{counts.failed} packets could not be sent: {counts.last_failure}"
    if 2 * counts.refused > counts.sent:
        return "nobody listens there; start the receiver, check its port and the firewall"
    if counts.dropped:
        return "packets were dropped before they left this machine; its network is too slow"
    return ""
