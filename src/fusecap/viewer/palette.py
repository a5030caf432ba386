"""Colours of people that also those tell apart who see fewer of them.

Okabe and Ito's palette ("Color Universal Design", 2008), in an order that keeps neighbours apart.
"""

from __future__ import annotations

import html

Rgb = tuple[int, int, int]

PEOPLE_RGB: tuple[Rgb, ...] = (
    *((0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167)),
    *((86, 180, 233), (213, 94, 0), (240, 228, 66)),
)
PALE_RGB: Rgb = (222, 222, 222)
"""What no measurement supports."""
CAMERA_RGB: Rgb = (70, 70, 80)


def person_rgb(row: int) -> Rgb:
    """Of the person in this row; colours come round again."""
    return PEOPLE_RGB[row % len(PEOPLE_RGB)]


def css(rgb: Rgb) -> str:
    """As a page writes it."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def escaped(text: str) -> str:
    """Text from outside as a page's HTML shows it letter by letter."""
    return html.escape(text, quote=True)
