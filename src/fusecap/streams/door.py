"""Who may connect to a server of this machine.

A browser lets the pages of any web site open WebSockets to this machine, and a site can give this
machine a name of its own. So a server on loopback admits programs, which name no origin, and pages
of this machine, and only where they ask for it by a name of loopback. A server that other machines
can reach admits whoever knows its address, of which a random token is part.
"""

from __future__ import annotations

import ipaddress
import secrets
from dataclasses import dataclass
from urllib.parse import urlsplit


def is_loopback(host: str) -> bool:
    """Whether only programs of this machine can reach `host`."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def new_token(host: str) -> str:
    """What the address of a server on `host` needs; empty on loopback."""
    return "" if is_loopback(host) else secrets.token_urlsafe(16)


@dataclass(frozen=True, slots=True, kw_only=True)
class Door:
    """Admits visitors of one server."""

    token: str
    """Empty: the server is on loopback."""

    def refusal(self, *, token: str, host: str, origin: str | None) -> str:
        """Why a visitor with this token, Host and Origin is not admitted; empty where they are."""
        if self.token:
            known = secrets.compare_digest(token.encode(), self.token.encode())
            return "" if known else "the address lacks its token"
        if "," in host or not is_loopback(_hostname(f"//{host}")):
            return "asked for by another name than this machine's own"
        if origin is not None and not is_loopback(_hostname(origin)):
            return "opened by another site"
        return ""


def _hostname(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""
