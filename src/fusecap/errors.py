"""Every error that fusecap raises on purpose.

    FusecapError
    ├── InputError          a file or value the user gave is missing, broken or contradictory
    │   ├── SessionError    session.toml
    │   ├── CalibrationError    cameras
    │   └── TakeError       a solved take
    └── MotionError         motion or prior that does not fit the skeleton

A message says what was found, where, what was expected and what to do; the command line prints
it as it stands, without a traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from importlib import metadata


class FusecapError(Exception):
    """Root of every deliberate failure."""


class InputError(FusecapError):
    """A file or value the user gave is missing, broken or contradictory."""


class SessionError(InputError):
    """The session file, or what it names, is wrong."""


class CalibrationError(InputError):
    """A camera calibration is missing, broken or physically impossible."""


class TakeError(InputError):
    """A take cannot be read or written."""


class MotionError(FusecapError):
    """Motion or prior that does not fit the skeleton."""


def nearest(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' with the closest known name, or the list of them when none is close."""
    names = [str(k) for k in known]
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    if close:
        return f"; did you mean '{close[0]}'?"
    return f"; known: {', '.join(names)}" if names else ""


def from_extra(extra: str) -> str:
    """How to install what an extra brings, by its own names: no index has a fusecap to extend."""
    brings = [
        f"'{_from_least(requirement.partition(';')[0].strip())}'"
        for requirement in metadata.requires("fusecap") or ()
        if requirement.replace("'", '"').endswith(f'extra == "{extra}"')
    ]
    return f"install fusecap's extra '{extra}', or what it brings: pip install {' '.join(brings)}"


def _from_least(requirement: str) -> str:
    """`numpy<3,>=2` as `numpy>=2,<3`."""
    least = requirement.find(">=")
    start = min((at for at in map(requirement.find, "<>=!~") if at >= 0), default=least)
    if least < 0 or requirement[start:].startswith(">="):
        return requirement
    bounds = requirement[start:].split(",")
    return requirement[:start] + ",".join(sorted(bounds, key=lambda bound: bound[:2] != ">="))
