"""The table of protocols, one module each: its encoder, and the `PROTOCOL` that opens a stream.

A module is imported when its protocol is asked for, so that the table itself costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.streams.stream import StreamProtocol

NAMES = ("vmc", "livelink", "rokoko", "osc", "ws", "lsl")
"""Of protocols and of their modules."""


def protocol_named(name: str) -> StreamProtocol:
    """One of `NAMES`."""
    return import_module(f"{__name__}.{name}").PROTOCOL
