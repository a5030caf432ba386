"""Lengths as people write them: 40mm, 4cm, 0.04m, 1.5in."""

from __future__ import annotations

import re

import typer

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


def length_m(option: str, text: str) -> float:
    """Metres; a number without a unit is misuse (exit code 2)."""
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(mm|cm|m|in)\s*", text)
    if match is None:
        raise typer.BadParameter(
            f"'{text}': expected a length with its unit, such as 40mm, 4cm, 0.04m or 1.5in",
            param_hint=option,
        )
    return float(match[1]) * _METRES[match[2]]


def named(option: str, text: str, expected: str) -> tuple[str, str]:
    """The two sides of NAME=VALUE; misuse without either."""
    name, equals, value = text.rpartition("=")
    if not (name and equals and value):
        raise typer.BadParameter(f"'{text}': expected {expected}", param_hint=option)
    return name, value
