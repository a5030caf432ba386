"""Where a stream goes, as one writes it: `vmc://192.168.1.20:39539`, `ws`, `lsl`."""

from __future__ import annotations

import socket
from dataclasses import dataclass, replace
from urllib.parse import urlsplit

from fusecap.errors import InputError, nearest
from fusecap.streams.protocols import NAMES, protocol_named

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A protocol and where it is sent to, or where clients are served; no host: found by itself."""

    protocol: str
    host: str = ""
    port: int = 0
    token: str = ""
    """That clients of a server beyond loopback need."""

    @property
    def address(self) -> str:
        """Where clients find it: with its token, and by this machine's name where it has many."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        address = str(replace(self, host=host))
        return f"{address}/?token={self.token}" if self.token else address

    def __str__(self) -> str:
        if not self.host:
            return self.protocol
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}://{host}:{self.port}"


def parse_target(text: str) -> Target:
    """Host and port may be left out; raises `InputError` that says what is wrong with `text`."""
    name, separator, rest = text.partition("://")
    if name not in NAMES:
        raise InputError(
            f"--to {text}: no protocol '{name}', expected one of {', '.join(NAMES)}, as in "
            f"{NAMES[0]}://{LOOPBACK}:{protocol_named(NAMES[0]).port}{nearest(name, NAMES)}"
        )
    usual_port = protocol_named(name).port
    if usual_port is None:
        if rest:
            raise InputError(
                f"--to {text}: {name} finds its receivers by itself; write --to {name}"
            )
        return Target(protocol=name)
    if separator and not rest:
        raise InputError(f"--to {text}: a host is missing after ://")
    example = f"{name}://{LOOPBACK}:{usual_port}"
    try:
        parts = urlsplit(f"//{rest}")
        port = parts.port
    except ValueError:
        raise InputError(
            f"--to {text}: the port must be a number from 1 to 65535, as in {example}"
        ) from None
    if parts.path or parts.query or parts.fragment or parts.username is not None:
        raise InputError(f"--to {text}: expected only a host and a port, as in {example}")
    if port == 0:
        raise InputError(f"--to {text}: the port must be a number from 1 to 65535")
    return Target(protocol=name, host=parts.hostname or LOOPBACK, port=port or usual_port)


def serves(target: Target) -> bool:
    """Whether receivers connect to it, rather than being sent to."""
    return protocol_named(target.protocol).serves
