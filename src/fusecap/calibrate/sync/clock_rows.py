"""What is said of each clock: whether it was found, how well, why, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fusecap.calibrate.sync.curves import Peak
from fusecap.calibrate.verdict import Verdict
from fusecap.sources.sync_files import Clock

GOOD_S, USABLE_S = 0.005, 0.015
"""Standard errors of an offset."""
SIGNIFICANT = 4.0
"""Standard errors that a drift must differ from zero by to be written."""

State = Literal["found", "ambiguous", "not found", "reference"]


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Whether a clock was found, and how well."""

    state: State
    verdict: Verdict | None = None
    """Of a clock that was found."""
    said: str = ""
    """Why, and what to do; empty where all is well."""

    @property
    def word(self) -> str:
        """The verdict, or the state of a clock that has none."""
        return self.verdict or self.state


@dataclass(frozen=True, kw_only=True)
class ClockEstimate:
    """What the data say of a clock; times in s, NaN where they say nothing."""

    offset_s: float = float("nan")
    """At the middle of its recording."""
    error_s: float = float("nan")
    drift_ppm: float = float("nan")
    drift_error_ppm: float = float("nan")
    rivals_s: tuple[float, ...] = ()
    """Other offsets that the data cannot tell from this one."""
    correlation: float | None = None


@dataclass(frozen=True, kw_only=True)
class ClockRow(Judgement):
    """What is known about one clock; times in s, `offset_s` at the middle of its recording."""

    kind: Literal["camera", "imu"]
    name: str
    """Of the camera or subject."""
    sensors: tuple[str, ...]
    """Bones of the sensors on this clock; empty for a camera."""
    offset_s: float | None
    """None: not determined."""
    error_s: float | None
    drift_ppm: float | None
    """None: too short to tell."""
    drift_error_ppm: float | None
    drift_used: bool
    correlation: float | None
    rivals_s: tuple[float, ...]

    def clock(self, middle_s: float) -> Clock | None:
        """What to write; an offset at the middle becomes one at the clock's zero."""
        if self.offset_s is None or self.state == "ambiguous":
            return None
        drift_ppm = self.drift_ppm if self.drift_used and self.drift_ppm is not None else 0.0
        return Clock(
            offset_s=self.offset_s - 1e-6 * drift_ppm * middle_s,
            drift_ppm=drift_ppm,
            error_s=self.error_s,
        )


def clock_row(
    kind: Literal["camera", "imu"],
    name: str,
    judged: Judgement,
    found: ClockEstimate,
    sensors: tuple[str, ...] = (),
) -> ClockRow:
    """Numbers of a clock that was not found are left out, and those that the data do not tell."""
    known = judged.state != "not found"
    drifts = known and bool(np.isfinite(found.drift_ppm) and np.isfinite(found.drift_error_ppm))
    return ClockRow(
        kind=kind,
        name=name,
        sensors=sensors,
        state=judged.state,
        verdict=judged.verdict,
        said=judged.said,
        offset_s=found.offset_s if known else None,
        error_s=found.error_s if known and np.isfinite(found.error_s) else None,
        drift_ppm=found.drift_ppm if drifts else None,
        drift_error_ppm=found.drift_error_ppm if drifts else None,
        drift_used=drifts and abs(found.drift_ppm) > SIGNIFICANT * found.drift_error_ppm,
        correlation=found.correlation,
        rivals_s=found.rivals_s,
    )


def judge(
    peak: Peak | None,
    *,
    moving: bool,
    seen: bool,
    error_s: float,
    max_offset_s: float,
    who: str,
) -> Judgement:
    """From the best offset; `who` is what the clock was compared with."""
    if not seen:
        said = "nobody is seen here; check the detector's output of this camera"
    elif not moving:
        said = "nobody moves; record people who walk about and wave their arms"
    elif peak is None:
        said = (
            f"too little in common with {who}; record longer, or give a rough offset_s and a "
            "larger --max-offset"
        )
    elif peak.rivals_s:
        every = ", ".join(f"{1e3 * (r - peak.shift_s):+.0f}" for r in peak.rivals_s[:4])
        return Judgement(
            state="ambiguous",
            said=f"offsets {every} ms away fit as well: the motion repeats itself; record "
            "something that does not, such as one stamp or jump, or narrow --max-offset",
        )
    elif peak.at_edge:
        said = f"the best offset is the end of the range of {max_offset_s:g} s; raise --max-offset"
    elif not peak.distinct:
        said = (
            f"no offset within {max_offset_s:g} s fits better than the rest; record longer and "
            "livelier motion, or raise --max-offset"
        )
    elif not np.isfinite(error_s):
        said = "too few keypoints in common to refine; record longer"
    elif error_s <= GOOD_S:
        return Judgement(state="found", verdict=Verdict.GOOD)
    elif error_s <= USABLE_S:
        return Judgement(state="found", verdict=Verdict.USABLE)
    else:
        return Judgement(
            state="found",
            verdict=Verdict.POOR,
            said="the standard error is large; record longer or livelier motion",
        )
    return Judgement(state="not found", said=said)
