"""Where a stream goes, as one writes it: `vmc://192.168.1.20:39539`, `ws`, `lsl`."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from urllib.parse import urlsplit

from fusecap.errors import InputError, nearest
from fusecap.streams import livelink, osc, rokoko, vmc, websocket

DEFAULT_PORTS = {
    "vmc": vmc.DEFAULT_PORT,
    "livelink": livelink.DEFAULT_PORT,
    "rokoko": rokoko.DEFAULT_PORT,
    "osc": osc.DEFAULT_PORT,
    "ws": websocket.DEFAULT_PORT,
}
PROTOCOLS = (*DEFAULT_PORTS, "lsl")
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A protocol and where it is sent to; for `ws` where clients are served."""

    protocol: str
    host: str = ""
    port: int = 0

    def __str__(self) -> str:
        if self.protocol == "lsl":
            return "lsl"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}://{host}:{self.port}"


def parse_target(text: str) -> Target:
    """Host and port may be left out; raises `InputError` that says what is wrong with `text`."""
    protocol, separator, rest = text.partition("://")
    if protocol not in PROTOCOLS:
        raise InputError(
            f"--to {text}: no protocol '{protocol}', expected something like "
            f"vmc://{LOOPBACK}:{vmc.DEFAULT_PORT}{nearest(protocol, PROTOCOLS)}"
        )
    if protocol == "lsl":
        if rest:
            raise InputError(f"--to {text}: lsl finds its receivers by itself; write --to lsl")
        return Target(protocol="lsl")
    if separator and not rest:
        raise InputError(f"--to {text}: a host is missing after ://")
    try:
        parts = urlsplit(f"//{rest}")
        port = parts.port
    except ValueError:
        raise InputError(
            f"--to {text}: the port must be a number from 1 to 65535, as in "
            f"{protocol}://{LOOPBACK}:{DEFAULT_PORTS[protocol]}"
        ) from None
    if parts.path or parts.query or parts.fragment or parts.username is not None:
        raise InputError(
            f"--to {text}: expected only a host and a port, as in "
            f"{protocol}://{LOOPBACK}:{DEFAULT_PORTS[protocol]}"
        )
    if port == 0:
        raise InputError(f"--to {text}: the port must be a number from 1 to 65535")
    return Target(
        protocol=protocol,
        host=parts.hostname or LOOPBACK,
        port=port or DEFAULT_PORTS[protocol],
    )


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine can reach `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
