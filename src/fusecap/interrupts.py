"""Ctrl-C during work that must not be cut in two.

Python raises `KeyboardInterrupt` between any two lines, so between one that poses somebody and one
that says when, too. Work that goes by instants or frames holds it, and asks between two of them.
"""

from __future__ import annotations

import atexit
import os
import signal
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_ENDS = ("SIGINT", "SIGTERM", "SIGHUP")


def ends_are_ctrl_c() -> None:
    """SIGTERM and SIGHUP do what Ctrl-C does, unless somebody ignores or handles them.

    Once this program is done, and only Python has to go, none of them takes its exit code away.
    """
    for number in _ends()[1:]:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)
    atexit.register(_ignore_ends)


def _end(number: int, frame: FrameType | None) -> None:
    leave_terminal(number)
    raise KeyboardInterrupt


_OURS = (signal.default_int_handler, _end)


def leave_terminal(number: int) -> bool:
    """Whether a signal is SIGHUP; then no other one comes, and a closed terminal is let go of.

    Else whatever is said to it would fail, also between the end of work and its file. A shell may
    pass SIGHUP on a second time.
    """
    if number != getattr(signal, "SIGHUP", None):
        return False
    signal.signal(number, signal.SIG_IGN)
    for output in (1, 2):
        with suppress(OSError):
            # A terminal that was closed is none any more, but still a device.
            if stat.S_ISCHR(os.fstat(output).st_mode) and not os.isatty(output):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, output)
                os.close(nowhere)
    return True


def _ignore_ends() -> None:
    for number in _ends():
        signal.signal(number, signal.SIG_IGN)


def _ends() -> list[int]:
    """Windows knows no SIGHUP."""
    return [getattr(signal, name) for name in _ENDS if hasattr(signal, name)]


class Interruption:
    """Ctrl-C as a question: `asked` once it came; a second one is raised at once."""

    def __init__(self) -> None:
        self.asked = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """As a handler of SIGINT."""
        if not leave_terminal(number) and self.asked:
            raise KeyboardInterrupt
        self.asked = True


@contextmanager
def ctrl_c_held() -> Iterator[Interruption]:
    """Ctrl-C, and what ends a command as it does, is noted while this lasts, for whoever asks.

    Nothing changes where Ctrl-C is not Python's own `KeyboardInterrupt`: in other threads than the
    main one, in workers that ignore it, in programs with handlers of their own. Within another of
    these the interruption is that one's.
    """
    handlers = {number: signal.getsignal(number) for number in _ends()}
    outer = [handler for handler in handlers.values() if isinstance(handler, Interruption)]
    if outer:
        yield outer[0]
        return
    interruption = Interruption()
    held = [n for n, handler in handlers.items() if handler in _OURS]
    with suppress(ValueError):  # in another thread
        for number in held:
            signal.signal(number, interruption)
    try:
        yield interruption
    finally:
        with suppress(ValueError):
            for number in held:
                if signal.getsignal(number) is interruption:
                    signal.signal(number, handlers[number])
