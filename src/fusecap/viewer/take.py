"""A take on a page: people that move, a time line, curves."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import viser
from jaxtyping import Bool, Float, Int
from viser import GuiEvent

from fusecap.body.shape import BodyShape
from fusecap.body.skeleton import Skeleton
from fusecap.errors import TakeError
from fusecap.exports.stick_figures import passing
from fusecap.geometry.camera import Rig
from fusecap.take import Take
from fusecap.viewer.backdrop import RATE_HZ, Backdrop, OpenVideo
from fusecap.viewer.controls import PlaybackControls
from fusecap.viewer.curves import ALL_BONES, BoneCurve, Plot, drawn, sigma_curve
from fusecap.viewer.figure import Pose
from fusecap.viewer.page import Page
from fusecap.viewer.palette import css, escaped, person_rgb
from fusecap.viewer.people import People
from fusecap.viewer.room import Room, add_view_controls, places_of

if TYPE_CHECKING:
    from fusecap.viewer.recording import RecordedDetections

_UPDATES_HZ = 60.0
_PLOTS_HZ = 8.0
_IDLE_S = 0.25
"""How often a page at rest looks whether it is to stop."""
_SMALL = "margin:2px 14px;font-size:0.85em"


class ViewedTake(Protocol):
    """What a page asks of a take: a `Take`, or one that stays in its file."""

    @property
    def timestamps_ns(self) -> Int[np.ndarray, " t"]: ...
    @property
    def time_s(self) -> Float[np.ndarray, " t"]: ...
    @property
    def tracked(self) -> Bool[np.ndarray, "s t"]: ...
    @property
    def subject_names(self) -> tuple[str, ...]: ...
    @property
    def heights_m(self) -> Float[np.ndarray, " s"]: ...
    @property
    def provenance(self) -> Mapping[str, Any]: ...
    @property
    def skeleton(self) -> Skeleton: ...
    def shape(self, subject: int) -> BodyShape: ...
    def at_frames(self, frames: Sequence[int] | Int[np.ndarray, " n"]) -> Take: ...


class TakePage:
    """Shows a take until it is stopped; raises `TakeError` for one without a frame."""

    def __init__(
        self,
        page: Page,
        take: ViewedTake,
        *,
        rig: Rig | None = None,
        videos: Mapping[str, OpenVideo] = MappingProxyType({}),
        curves: Sequence[BoneCurve] = (),
        detections: RecordedDetections | None = None,
    ) -> None:
        """`rig`: its cameras are shown, and their `videos`, by camera, behind the figures."""
        if len(take.timestamps_ns) == 0:
            raise TakeError("the take has no frame: nothing to view; solve it again")
        self._page = page
        self._take = take
        rows = range(len(take.subject_names))
        self._shapes = [take.shape(row) for row in rows]
        frames = drawn(np.arange(len(take.timestamps_ns)))
        seen = take.at_frames(frames)
        colours = {name: person_rgb(row) for row, name in enumerate(take.subject_names)}
        self._told = page.gui.add_html("")
        room = Room(page, rig)
        self._people = People(page.scene, take.skeleton, colours)
        self._controls = PlaybackControls(page.gui, take.time_s)
        with page.gui.add_folder("People"):
            page.gui.add_html(_legend(take, seen, list(colours.values())))
            self._boxes = [
                page.gui.add_checkbox(f"Show {name}", initial_value=True) for name in colours
            ]
            for box in self._boxes:
                box.on_update(lambda _: self._controls.nudge())
        stay = ~passing(take.tracked)
        everywhere = places_of(list(seen.bone_position_in_world_m[stay, :, 0]))
        add_view_controls(page, room, lambda: everywhere)
        self._backdrop = None
        if rig is not None and videos:
            nearby = places_of(list(seen.bone_position_in_world_m[:, :, 0]))
            self._backdrop = Backdrop(page, room, videos, rig, nearby, self._controls.nudge)
        self._views = detections and detections.views(page.gui, colours)
        self._plots = self._add_plots([sigma_curve(seen, take.time_s[frames]), *curves], colours)
        self._drawn: tuple[int, tuple[bool, ...]] | None = None
        self._draw(0, 0.0, plots=True)

    def tell(self, text: str) -> None:
        """Something that whoever looks should know, above all else."""
        self._told.content = f'<div style="{_SMALL}">{escaped(text)}</div>'

    def run(self, stopping: threading.Event | None = None) -> None:
        """Plays until `stopping` is set, or interrupted; sends nothing while nobody looks."""
        stopping = stopping or threading.Event()
        controls = self._controls
        last_s = time.monotonic()
        plotted_s = 0.0
        while not stopping.is_set():
            with_video = self._backdrop is not None and self._backdrop.shown
            updates_hz = RATE_HZ if with_video else _UPDATES_HZ
            controls.wait(1 / updates_hz if controls.playing else _IDLE_S)
            now_s = time.monotonic()
            frame, position_s = controls.advance(now_s - last_s)
            last_s = now_s
            if self._page.get_clients():
                plots = not controls.playing or now_s - plotted_s > 1 / _PLOTS_HZ
                plotted_s = now_s if plots else plotted_s
                self._draw(frame, position_s, plots=plots)

    def _draw(self, frame: int, position_s: float, *, plots: bool) -> None:
        if self._backdrop is not None:
            exposed_ns = self._backdrop.at(int(self._take.timestamps_ns[frame]))
            frame = int(np.abs(self._take.timestamps_ns - exposed_ns).argmin())
        shown = tuple(box.value for box in self._boxes)
        moved = (frame, shown) != self._drawn
        poses = self._poses(frame) if moved or plots else {}
        with self._page.atomic():
            if moved:
                self._drawn = (frame, shown)
                names = self._take.subject_names
                self._people.show(
                    {
                        n: poses.get(n) if seen else None
                        for n, seen in zip(names, shown, strict=True)
                    }
                )
            self._controls.show(position_s)
            if plots:
                for plot in self._plots:
                    plot.mark(position_s)
                if self._views is not None:
                    self._views.show(int(self._take.timestamps_ns[frame]), poses)

    def _poses(self, frame: int) -> dict[str, Pose]:
        """Of who is tracked; nothing measures the bones of who is predicted."""
        take = self._take.at_frames([frame])
        return {
            name: Pose(
                shape=self._shapes[row],
                position_m=take.bone_position_in_world_m[row, 0],
                rotation=take.bone_rotation_in_world(row)[0],
                quality=take.bone_quality[row, 0] * take.measured[row, 0],
            )
            for row, name in enumerate(take.subject_names)
            if take.tracked[row, 0]
        }

    def _add_plots(
        self, curves: Sequence[BoneCurve], colours: dict[str, tuple[int, int, int]]
    ) -> list[Plot]:
        gui, bone_names = self._page.gui, self._take.skeleton.bone_names
        with gui.add_folder("Over time"):
            bone = gui.add_dropdown("Bone", (ALL_BONES, *bone_names))
            plots = [Plot(gui, curve, bone_names, colours) for curve in curves]

        @bone.on_update
        def _(event: GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
            for plot in plots:
                plot.choose(event.target.value)

        return plots


def _legend(take: ViewedTake, some: Take, colours: Sequence[tuple[int, int, int]]) -> str:
    lines = []
    for row, (name, colour) in enumerate(zip(take.subject_names, colours, strict=True)):
        dot = f'<span style="color:{css(colour)};font-size:1.3em">&#9679;</span>'
        about = (
            f"{take.heights_m[row]:.2f} m tall, tracked in "
            f"{100 * take.tracked[row].mean():.0f} % of frames"
        )
        predicted = (some.tracked & ~some.measured)[row].mean()
        if predicted > 0:
            about += f", predicted in {100 * predicted:.0f} %: seen by nobody, by the motion around"
        lines.append(f'<div style="{_SMALL}">{dot} <b>{escaped(name)}</b>, {about}</div>')
    what = "Simulated. " if take.provenance.get("simulated") else ""
    note = f"{what}A person's right side is darker; bones that nothing measures are grey."
    return "".join([*lines, f'<div style="{_SMALL};opacity:0.75">{note}</div>'])
