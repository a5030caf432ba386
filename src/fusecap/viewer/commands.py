"""What a user may ask of a live run: buttons that become commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import viser
from viser import GuiEvent, Icon

from fusecap.errors import FusecapError
from fusecap.types import Command, CommandKind

EVERYONE: str = "everyone"
_COUNTDOWN_S = 3.0
"""To get into the T-pose and stand still; the last second of it counts."""


class CommandPanel:
    """Who is meant, and what to do; T-poses are counted down."""

    def __init__(
        self,
        page: viser.ViserServer,
        submit: Callable[[Command], None],
        on_record: Callable[[bool], None] | None,
    ) -> None:
        """`on_record` starts (True) or ends a recording; None: no button for it."""
        self._page = page
        self._submit = submit
        self._tpose: tuple[str, float] | None = None
        """Who, and when the countdown ends."""
        self._recording = False
        gui = page.gui
        self._record = gui.add_button(
            "Record", icon=Icon.PLAYER_RECORD, visible=on_record is not None, color="red"
        )
        self._who = gui.add_dropdown("Person", (EVERYONE,))
        find = gui.add_button("Find anew", icon=Icon.REFRESH, hint="Forget where they are")
        self._stand = gui.add_button(_TPOSE, icon=Icon.MAN, hint="Of who wears sensors")
        remove = gui.add_button("Remove", icon=Icon.USER_MINUS, hint="Follow them no longer")
        add = gui.add_button("Add a person", icon=Icon.USER_PLUS, hint="Make room for one more")
        find.on_click(lambda _: self._send(CommandKind.REINITIALISE, self._name()))
        add.on_click(lambda _: self._send(CommandKind.ADD_SUBJECT))
        remove.on_click(self._ask_remove)
        self._stand.on_click(lambda _: self._begin_tpose())
        if on_record is not None:
            self._record.on_click(lambda event: self._toggle_record(event, on_record))

    def show_people(self, names: Sequence[str]) -> None:
        """Who can be chosen."""
        options = (EVERYONE, *names)
        if tuple(self._who.options) != options:
            self._who.options = options

    def show_recording(self, recording: bool) -> None:
        """Whether a recording runs."""
        self._recording = recording
        self._record.label = "Stop recording" if recording else "Record"
        self._record.icon = Icon.PLAYER_STOP if recording else Icon.PLAYER_RECORD

    def count_down(self, now_s: float) -> None:
        """Of a T-pose; `now_s` is that of `time.monotonic`."""
        if self._tpose is None:
            return
        name, end_s = self._tpose
        if now_s < end_s:
            self._stand.label = f"Stand in the T-pose: {int(end_s - now_s) + 1}"
        else:
            self._tpose = None
            self._stand.label = _TPOSE
            self._send(CommandKind.TPOSE, name)

    def _name(self) -> str:
        """Of the chosen person; empty for everyone."""
        return "" if self._who.value == EVERYONE else self._who.value

    def _send(self, kind: CommandKind, name: str = "") -> None:
        self._submit(Command(kind=kind, subject=name))

    def _begin_tpose(self) -> None:
        self._tpose = self._name(), time.monotonic() + _COUNTDOWN_S

    def _ask_remove(self, event: GuiEvent[viser.GuiButtonHandle]) -> None:
        if name := self._name():
            self._send(CommandKind.REMOVE_SUBJECT, name)
        elif event.client is not None:
            event.client.add_notification("Choose a person first", "Nobody was removed.")

    def _toggle_record(
        self, event: GuiEvent[viser.GuiButtonHandle], on_record: Callable[[bool], None]
    ) -> None:
        try:
            on_record(not self._recording)
        except FusecapError as error:
            if event.client is not None:
                event.client.add_notification("Cannot record", str(error), color="red")


_TPOSE = "Calibrate in the T-pose"
