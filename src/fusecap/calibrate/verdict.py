"""How far the result of a calibration can be trusted: one word, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum


class Verdict(StrEnum):
    """Best first."""

    GOOD = "good"
    """Nothing speaks against it."""
    USABLE = "usable"
    """It serves; what would make it better is named."""
    POOR = "poor"
    """It contradicts itself or the data, or was hardly measured: better than nothing at most."""


def worst(verdicts: Iterable[Verdict]) -> Verdict:
    """Good where there is none."""
    return max(verdicts, key=tuple(Verdict).index, default=Verdict.GOOD)


@dataclass(kw_only=True)
class Marks:
    """A verdict as it comes together from what was measured; the worst mark decides."""

    verdict: Verdict = Verdict.GOOD
    advice: list[str] = field(default_factory=list)

    def mark(self, value: float | int, good: float | int, poor: float | int, remedy: str) -> None:
        """One mark: good up to `good`, usable up to `poor`; `remedy` where it is not good."""
        if value <= good:
            return
        self.verdict = worst((self.verdict, Verdict.USABLE if value <= poor else Verdict.POOR))
        self.advice.append(remedy)
