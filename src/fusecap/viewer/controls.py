"""Play, pause, scrub, speed, loop: the time line of a page."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import viser
from jaxtyping import Float
from viser import GuiEvent, Icon

from fusecap.viewer.playhead import MAX_SPEED, MIN_SPEED, Playhead


class PlaybackControls:
    """Buttons and keys that move a playhead.

    Callbacks of a page run on viser's threads: they only move the playhead, under its lock, and
    wake whoever draws.
    """

    def __init__(self, gui: viser.GuiApi, time_s: Float[np.ndarray, " t"]) -> None:
        self._head = head = Playhead(time_s)
        self._lock = threading.Lock()
        self._wake = threading.Event()
        with gui.add_folder("Playback"):
            self._slider = gui.add_slider(
                "Time (s)",
                min=0.0,
                max=max(round(head.end_s, 3), 0.001),
                step=0.001,
                initial_value=0.0,
                hint="Drag to scrub; this pauses",
            )
            self._button = gui.add_button("Pause", icon=Icon.PLAYER_PAUSE, hint="Space")
            steps = gui.add_button_group(
                "Step", ("-1 s", "-1 frame", "+1 frame", "+1 s"), hint="Arrow keys step by a frame"
            )
            speed = gui.add_slider(
                "Speed", min=MIN_SPEED, max=MAX_SPEED, step=0.1, initial_value=1.0
            )
            loop = gui.add_checkbox("Loop", initial_value=True)
        per_step = {
            "-1 s": lambda: head.seek(head.position_s - 1),
            "-1 frame": lambda: head.step(-1),
            "+1 frame": lambda: head.step(1),
            "+1 s": lambda: head.seek(head.position_s + 1),
        }

        @self._slider.on_update
        def _(event: GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            if event.client is not None:
                self._move(lambda: head.seek(event.target.value))

        self._button.on_click(lambda _: self._move(head.toggle))
        steps.on_click(lambda event: self._move(per_step[event.target.value]))

        @speed.on_update
        def _(event: GuiEvent[viser.GuiSliderHandle[float]]) -> None:
            head.speed = event.target.value

        @loop.on_update
        def _(event: GuiEvent[viser.GuiCheckboxHandle]) -> None:
            head.loop = event.target.value

        toggle = gui.add_command("Play or pause", hotkey="space")
        back = gui.add_command("One frame back", hotkey="arrowleft")
        on = gui.add_command("One frame on", hotkey="arrowright")
        toggle.on_trigger(lambda _: self._move(head.toggle))
        back.on_trigger(lambda _: self._move(per_step["-1 frame"]))
        on.on_trigger(lambda _: self._move(per_step["+1 frame"]))

    @property
    def playing(self) -> bool:
        """Whether time goes on by itself."""
        return self._head.playing

    def wait(self, seconds: float) -> None:
        """Until something was pressed, at most so long."""
        self._wake.wait(seconds)
        self._wake.clear()

    def nudge(self) -> None:
        """Wakes whoever waits."""
        self._wake.set()

    def advance(self, elapsed_s: float) -> tuple[int, float]:
        """Time has gone by; the frame and the time [s] that are now to be seen."""
        with self._lock:
            self._head.advance(elapsed_s)
            return self._head.frame, self._head.position_s

    def show(self, position_s: float) -> None:
        """Slider and button as they are now."""
        playing = self._head.playing
        self._slider.value = round(position_s, 3)
        self._button.label = "Pause" if playing else "Play"
        self._button.icon = Icon.PLAYER_PAUSE if playing else Icon.PLAYER_PLAY

    def _move(self, act: Callable[[], None]) -> None:
        with self._lock:
            act()
        self._wake.set()
