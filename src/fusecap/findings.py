"""What a check says: something is wrong somewhere, and this is what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One remark about a session; an `error` means that it cannot be solved as it is."""

    severity: Severity
    where: str
    """File, camera, subject or sensor."""
    found: str
    remedy: str

    def __str__(self) -> str:
        return (
            f"{self.where}: {self.found}; {self.remedy}"
            if self.remedy
            else (f"{self.where}: {self.found}")
        )


class Findings(list[Finding]):
    """Findings as a check collects them."""

    def add(self, severity: Severity, where: str, found: str, remedy: str = "") -> None:
        """One more."""
        self.append(Finding(severity=severity, where=where, found=found, remedy=remedy))

    def sorted(self) -> list[Finding]:
        """Errors first, then warnings."""
        order: dict[Severity, int] = {"error": 0, "warning": 1, "info": 2}
        return sorted(self, key=lambda finding: order[finding.severity])
