"""The table of live sensors' protocols, one module each: its addresses, and its datagrams' layout.

A module's `PROTOCOL` says both. What comes in datagrams needs no more than that; what does not has
a reader under `live/devices/`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusecap.sources.live_sensor import SensorProtocol

NAMES = ("lsl", "osc", "mvn")
"""Of protocols, of their addresses' schemes and of their modules."""


def protocol_named(name: str) -> SensorProtocol:
    """One of `NAMES`."""
    return import_module(f"{__name__}.{name}").PROTOCOL
