"""A live sensor as every protocol has it: address, samples, and why a packet is refused.

Packets come from the network: whatever their bytes, a parser returns a `Packet` of samples that
can be used and of reasons why the rest cannot, and takes no more memory than a few times its size.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from fusecap.errors import FusecapError

MAX_DATAGRAM_BYTES = 9000
"""Of a jumbo frame; no layout here needs more."""
UNIT_TOLERANCE = 0.05
"""How far a quaternion's norm may be off: 16-bit numbers and rounded text stay well within."""
MAX_ACCEL_M_S2 = 5000.0
"""500 g; no worn sensor measures more."""
MAX_STAMP_S = 1e10
"""Seconds since 1970 or 1900 until after the year 2200."""


class Refused(FusecapError):
    """A packet, or a sample in it, that does not follow its layout; parsers catch it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSample:
    """One sensor at one moment, as it came in."""

    sensor: str
    """As the sender calls it."""
    stamp_ns: int | None
    """On the sender's clock."""
    orientation_wxyz: Float[np.ndarray, "4"]
    """imu_world_from_imu, unit."""
    accel_m_s2: Float[np.ndarray, "3"]
    """Specific force in the imu frame; NaN where not sent."""
    counter: int | None = None
    """Counts the sender's samples, where it does."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Packet:
    """What one datagram holds."""

    samples: tuple[SensorSample, ...] = ()
    refused: tuple[str, ...] = ()
    """Why the others in it, or all, cannot be used."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorAddress:
    """Where a sensor's samples come from, and what it is called there."""

    protocol: str
    sensor: str = ""
    """As the sender calls it; empty: the only one."""
    stream: str = ""
    """By its name in the network; empty: datagrams that arrive at host and port."""
    host: str = ""
    port: int = 0

    @property
    def sender(self) -> str:
        """Without the sensor."""
        if self.stream:
            return f"{self.protocol}:{self.stream}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.protocol}://{host}:{self.port}"


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorProtocol:
    """What a protocol's module says of it."""

    parse: Callable[[str], SensorAddress]
    """Of a session's `live` key; raises `InputError` that says what is wrong."""
    packet: Callable[[bytes], Packet] | None = None
    """What a datagram holds; None: does not come in datagrams."""


def checked_stamp_ns(seconds: float) -> int:
    """Raises `Refused` for what is no time."""
    if not abs(seconds) <= MAX_STAMP_S:
        raise Refused(f"the time is {seconds:g} s")
    return round(seconds * 1e9)


def checked_orientation(wxyz: Sequence[float]) -> np.ndarray:
    """(4,) unit; raises `Refused` for numbers that are no rotation."""
    norm = math.hypot(*wxyz)
    if not abs(norm - 1.0) <= UNIT_TOLERANCE:
        raise Refused(f"the quaternion's norm is {norm:.3g}, expected 1")
    return np.array(wxyz, dtype=np.float64) / norm


def checked_accel(xyz: Sequence[float]) -> np.ndarray:
    """(3,); NaN throughout means not measured; raises `Refused` for impossible numbers."""
    if all(math.isnan(value) for value in xyz):
        return np.full(3, np.nan)
    if not all(abs(value) <= MAX_ACCEL_M_S2 for value in xyz):
        raise Refused(f"the acceleration is {xyz[0]:g}, {xyz[1]:g}, {xyz[2]:g} m/s2")
    return np.array(xyz, dtype=np.float64)
