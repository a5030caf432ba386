"""A live run on a page: a `Listener` with a thread of its own.

The run's threads only leave the newest step, picture and status here; the viewer's thread draws
them at its own pace, and nothing at all while no browser is connected.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
import viser
from jaxtyping import Float

from fusecap.engine.engine import LiveStep
from fusecap.live.status import LiveStatus
from fusecap.setup import SessionSetup
from fusecap.streams.target import LOOPBACK
from fusecap.types import CameraImage, CameraSample, Command, Event
from fusecap.viewer import tables
from fusecap.viewer.commands import CommandPanel
from fusecap.viewer.figure import pose_of
from fusecap.viewer.floor_plan import FloorDrawing, floor_plan
from fusecap.viewer.page import Page, note_if_open
from fusecap.viewer.palette import Rgb, person_rgb
from fusecap.viewer.people import People
from fusecap.viewer.pictures import Pictures, mosaic
from fusecap.viewer.room import Room, add_view_controls

UPDATES_HZ = 30.0
_SLOW_HZ = 4.0
"""Floor plan and words."""
_IDLE_S = 0.2
_JPEG_QUALITY = 70
_FRUSTUM_M = 0.5
_MIDDLE_M = np.array([[-0.7, 0.0, -0.7], [0.7, 0.0, 0.7]])
"""Of the room: always in the picture."""
_WORDS = {
    "Run": tables.numbers,
    "Latency": tables.latency,
    "Streams": tables.streams,
    "Incidents": tables.incidents,
}
_PICTURES = (
    '<div style="font-size:0.85em;opacity:0.75;margin:4px 14px">White: detected. In colour: '
    "solved, as this camera sees it.</div>"
)


class Submitting(Protocol):
    """A live run, as far as its viewer goes."""

    def submit(self, command: Command) -> None:
        """Takes a user's wish from any thread."""
        ...


class LiveViewer:
    """Serves from the start until `close`; raises `InputError` where the page cannot be served."""

    def __init__(
        self,
        setup: SessionSetup,
        run: Submitting,
        host: str = LOOPBACK,
        port: int | None = None,
        *,
        on_record: Callable[[bool], None] | None = None,
    ) -> None:
        """`on_record` starts (True) or ends a recording and may raise; None: no button for it."""
        self._setup = setup
        self._page = page = Page(
            f"fusecap live: {setup.session.settings.name}", host=host, port=port
        )
        self.address = page.address
        self.note = note_if_open(page)
        """What a user must know about a page that other machines can reach."""
        self._step: LiveStep | None = None
        self._status: LiveStatus | None = None
        self._drawn_step: LiveStep | None = None
        self._drawn_status: LiveStatus | None = None
        self._colours: dict[str, Rgb] = {}
        self._people: People | None = None
        self._pictures = Pictures(setup.rig, setup.landmarks)
        self._drawing = FloorDrawing(setup.rig)
        self._room = Room(page, setup.rig, frustum_m=_FRUSTUM_M)
        gui = page.gui
        tabs = gui.add_tab_group()
        with tabs.add_tab("Now"):
            self._commands = CommandPanel(page, run.submit, on_record)
            self._who = gui.add_html("")
            with gui.add_folder("From above"):
                self._plan = gui.add_html("")
            with gui.add_folder("Cameras and sensors"):
                self._lights = gui.add_html("")
        with tabs.add_tab("Cameras"):
            add_view_controls(page, self._room, self._places)
            self._show_pictures = gui.add_checkbox(
                "Pictures", initial_value=True, visible=len(setup.rig) > 0
            )
            names = setup.rig.names
            self._mosaic = gui.add_image(
                mosaic(self._pictures.drawn, names) if names else np.zeros((1, 1, 3), np.uint8),
                format="jpeg",
                jpeg_quality=_JPEG_QUALITY,
                visible=len(names) > 0,
            )
            gui.add_html(_PICTURES)
        with tabs.add_tab("Numbers"):
            self._words = [(write, self._folder(title)) for title, write in _WORDS.items()]
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="fusecap-viewer", daemon=True)
        self._thread.start()

    # Listener

    def on_event(self, event: Event, arrival_ns: int) -> None:
        if isinstance(event, CameraSample):
            self._pictures.sample(event)

    def on_step(self, step: LiveStep, now_ns: int) -> None:
        self._step = step
        self._wake.set()

    def on_image(self, image: CameraImage) -> None:
        self._pictures.offer(image)

    def on_status(self, status: LiveStatus) -> None:
        self._status = status
        self._wake.set()

    def close(self) -> None:
        """Ends the page."""
        self._closing.set()
        self._wake.set()
        self._thread.join()
        self._page.stop()

    def _places(self) -> Float[np.ndarray, "n 3"]:
        """Where people are, or the middle of the room."""
        people = self._step.people.values() if self._step is not None else ()
        hips = [one.bone_position_in_world_m[:1] for one in people if one is not None]
        return np.concatenate([*hips, _MIDDLE_M])

    # The viewer's thread

    def _run(self) -> None:
        slow_s = 0.0
        while not self._closing.is_set():
            begun_s = time.monotonic()
            if self._page.get_clients():
                slow = begun_s - slow_s > 1 / _SLOW_HZ
                slow_s = begun_s if slow else slow_s
                self._draw(begun_s, slow=slow)
            self._closing.wait(max(0.0, 1 / UPDATES_HZ - (time.monotonic() - begun_s)))
            self._wake.wait(_IDLE_S)
            self._wake.clear()

    def _draw(self, now_s: float, *, slow: bool) -> None:
        step, status = self._step, self._status
        with self._page.atomic():
            self._commands.count_down(now_s)
            if step is not None and step is not self._drawn_step:
                self._drawn_step = step
                self._draw_step(step, slow=slow)
            if status is not None and status is not self._drawn_status:
                self._drawn_status = status
                self._draw_status(status)

    def _draw_step(self, step: LiveStep, *, slow: bool) -> None:
        if list(step.people) != list(self._colours):
            self._recast(list(step.people))
        if self._people is not None:
            self._people.show(
                {name: pose_of(one) if one else None for name, one in step.people.items()}
            )
        if slow:
            plan = floor_plan(step, self._setup.rig, self._setup.landmarks)
            self._plan.content = self._drawing.svg(plan, self._colours)
            self._who.content = tables.people(step, self._colours)
        if self._show_pictures.value:
            self._draw_pictures(step)

    def _draw_pictures(self, step: LiveStep) -> None:
        new = self._pictures.ready(step, self._colours)
        names = self._setup.rig.names
        for row in new:
            self._room.frusta[names[row]].image = self._pictures.drawn[row]
        if new:
            self._mosaic.image = mosaic(self._pictures.drawn, names)

    def _draw_status(self, status: LiveStatus) -> None:
        self._lights.content = tables.lights(status.sources)
        for write, html in self._words:
            html.content = write(status)
        recording = status.recording
        self._commands.show_recording(recording is not None and not recording.problem)

    def _recast(self, names: list[str]) -> None:
        """Someone is new or gone for good; who stays keeps the colour."""
        self._colours = {name: person_rgb(row) for row, name in enumerate(names)}
        if self._people is not None:
            self._people.remove()
        self._people = People(self._page.scene, self._setup.session.skeleton, self._colours)
        self._commands.show_people(names)

    def _folder(self, title: str) -> viser.GuiHtmlHandle:
        with self._page.gui.add_folder(title):
            return self._page.gui.add_html("")
