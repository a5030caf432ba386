"""What one solved instant of a live run holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from fusecap.pipeline import Step
from fusecap.types import Detections, Estimate, ImuReading


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveStep:
    """One instant: what was measured, what the stages made of it, and what is sent."""

    timestamp_ns: int
    """On the session's clock."""
    detections: Detections
    """Interpolated to the instant."""
    readings: Mapping[str, ImuReading]
    """By subject, interpolated to the instant."""
    step: Step
    """As sorted and solved."""
    people: Mapping[str, Estimate | None]
    """Every subject in a lasting order, without jumps and with a quality that fades where nothing
    measures; None while there is no pose to send."""
