"""Ctrl-C during work that must not be cut in two.

Python raises `KeyboardInterrupt` between any two lines, so between one that poses somebody and one
that says when, too. Work that goes by instants or frames holds it, and asks between two of them.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType


class Interruption:
    """Ctrl-C as a question: `asked` once it came; a second one is raised at once."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """As a handler of SIGINT."""
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def ctrl_c_held() -> Iterator[Interruption]:
    """Ctrl-C is noted while this lasts, for whoever asks.

    Nothing changes where Ctrl-C is not Python's own `KeyboardInterrupt`: in other threads than the
    main one, in workers that ignore it, in programs with handlers of their own. Within another of
    these the interruption is that one's.
    """
    handler = signal.getsignal(signal.SIGINT)
    if isinstance(handler, Interruption):
        yield handler
        return
    interruption = Interruption()
    if handler is not signal.default_int_handler:
        yield interruption
        return
    with suppress(ValueError):  # in another thread
        signal.signal(signal.SIGINT, interruption)
    try:
        yield interruption
    finally:
        with suppress(ValueError):
            signal.signal(signal.SIGINT, handler)
