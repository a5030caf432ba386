"""What the module of a motion format says of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from fusecap.motion.motion import Motion


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionFormat:
    """How it is told from others, and read."""

    what: str
    """As a message calls it."""
    suffix: str
    parse: Callable[[str, str, Mapping[str, str]], Motion]
    """The take of a text and its path, with the texts by path of the files beside it that end with
    `beside`; raises `InputError`."""
    beside: str = ""
    """Suffix of files that a take needs and that are none themselves."""
    holds: Callable[[str], bool] = lambda text: True
    """Whether a text among others is a take at all."""
