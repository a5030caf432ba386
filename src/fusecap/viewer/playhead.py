"""Where a playback stands: plays, pauses, goes round; its clock is the caller's."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

MIN_SPEED, MAX_SPEED = 0.1, 4.0


class Playhead:
    """Of a motion whose frames lie at `time_s`, rising from 0; there is at least one."""

    def __init__(self, time_s: Float[np.ndarray, " t"]) -> None:
        self._time_s = time_s
        self.position_s = 0.0
        self.playing = True
        self.loop = True
        self._speed = 1.0

    @property
    def speed(self) -> float:
        """Times as fast as it was."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if math.isfinite(speed):
            self._speed = min(max(speed, MIN_SPEED), MAX_SPEED)

    @property
    def end_s(self) -> float:
        """Of the last frame."""
        return float(self._time_s[-1])

    @property
    def frame(self) -> int:
        """The last one whose time has come."""
        return max(int(np.searchsorted(self._time_s, self.position_s + 1e-9, side="right")) - 1, 0)

    def advance(self, elapsed_s: float) -> None:
        """Time has gone by; without a loop the end pauses."""
        if not self.playing:
            return
        self.position_s += elapsed_s * self.speed
        if self.position_s > self.end_s:
            if self.loop and self.end_s > 0:
                self.position_s %= self.end_s
            else:
                self.position_s = self.end_s
                self.playing = False

    def toggle(self) -> None:
        """Play or pause; from the end it starts anew."""
        self.playing = not self.playing
        if self.playing and self.position_s >= self.end_s:
            self.position_s = 0.0

    def seek(self, time_s: float) -> None:
        """Go there and pause; where that is no time, only pause."""
        if math.isfinite(time_s):
            self.position_s = min(max(time_s, 0.0), self.end_s)
        self.playing = False

    def step(self, frames: int) -> None:
        """So many frames on or back, and pause."""
        frame = min(max(self.frame + frames, 0), len(self._time_s) - 1)
        self.seek(float(self._time_s[frame]))
