"""What else a recording of a live run holds: the detections, from above and as cameras saw them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping

import numpy as np
import viser

from fusecap.recording.reader import RecordedEvent, Recording
from fusecap.setup import SessionSetup
from fusecap.types import CameraSample
from fusecap.viewer.figure import Pose
from fusecap.viewer.floor_plan import FloorDrawing, FloorPlan, standing_places
from fusecap.viewer.palette import Rgb
from fusecap.viewer.pictures import Pictures, mosaic

_KEPT_HZ = 10.0
"""Per camera: what a page shows; an hour of four cameras takes about 130 MB."""
_OLD_NS = 500_000_000
"""After which a detection is no longer of the present."""


class RecordedDetections:
    """The detections of a recording, thinned out."""

    def __init__(self, recording: Recording, setup: SessionSetup) -> None:
        self.setup = setup
        self._times_ns: list[list[int]] = [[] for _ in setup.rig.cameras]
        self._people: list[list[np.ndarray]] = [[] for _ in setup.rig.cameras]
        for item in recording.items():
            if isinstance(item, RecordedEvent) and isinstance(item.event, CameraSample):
                self._keep(item.event)

    def at(self, camera: int, timestamp_ns: int) -> np.ndarray | None:
        """(n, k, 3) the latest of a camera; None where there is none of the present."""
        times_ns = self._times_ns[camera]
        row = bisect_right(times_ns, timestamp_ns) - 1
        if row < 0 or timestamp_ns - times_ns[row] > _OLD_NS:
            return None
        return self._people[camera][row].astype(np.float64)

    def views(self, gui: viser.GuiApi, colours: Mapping[str, Rgb]) -> RecordedViews:
        """Adds them to a page."""
        return RecordedViews(gui, self, colours)

    def _keep(self, sample: CameraSample) -> None:
        times_ns = self._times_ns[sample.camera]
        if not times_ns or sample.timestamp_ns - times_ns[-1] >= 1e9 / _KEPT_HZ:
            times_ns.append(sample.timestamp_ns)
            self._people[sample.camera].append(sample.people.astype(np.float32))


class RecordedViews:
    """The floor plan and the cameras' views of a recording on a page."""

    def __init__(
        self, gui: viser.GuiApi, detections: RecordedDetections, colours: Mapping[str, Rgb]
    ) -> None:
        self._detections = detections
        self._colours = colours
        setup = detections.setup
        self._pictures = Pictures(setup.rig, setup.landmarks)
        self._drawing = FloorDrawing(setup.rig)
        with gui.add_folder("From above"):
            self._plan = gui.add_html("")
        with gui.add_folder("Detected (white) and solved"):
            self._mosaic = gui.add_image(
                mosaic(self._pictures.drawn, setup.rig.names), format="jpeg", jpeg_quality=70
            )

    def show(self, timestamp_ns: int, poses: dict[str, Pose]) -> None:
        """What there is at one time."""
        rig, landmarks = self._detections.setup.rig, self._detections.setup.landmarks
        crosses = []
        for row, camera in enumerate(rig.cameras):
            found = self._detections.at(row, timestamp_ns)
            if found is not None:
                crosses += standing_places(camera, landmarks, found)
            self._pictures.draw(row, None, found, poses, self._colours)
        plan = FloorPlan(
            subjects={name: pose.position_m[0, [0, 2]] for name, pose in poses.items()},
            candidates=(),
            bystanders=tuple(crosses),
        )
        self._plan.content = self._drawing.svg(plan, self._colours, cross="detection of one camera")
        self._mosaic.image = mosaic(self._pictures.drawn, rig.names)
