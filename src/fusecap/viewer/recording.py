"""What else a recording of a live run holds: the detections, from above and as cameras saw them."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping

import numpy as np
import viser

from fusecap.recording.index import Places, RecordingIndex
from fusecap.recording.layout import KEYPOINTS
from fusecap.recording.reader import RecordedEvent
from fusecap.setup import SessionSetup
from fusecap.types import CameraSample
from fusecap.viewer.figure import Pose
from fusecap.viewer.floor_plan import FloorDrawing, FloorPlan, standing_places
from fusecap.viewer.palette import Rgb
from fusecap.viewer.pictures import Pictures, mosaic

SHOWN_HZ = 10.0
"""Of each camera's detections."""
_OLD_NS = 500_000_000
"""After which a detection is no longer of the present."""


class RecordedDetections:
    """The detections of a recording, read as they are looked at."""

    def __init__(self, index: RecordingIndex, setup: SessionSetup) -> None:
        self.setup = setup
        self._index = index
        none = Places(KEYPOINTS)
        self._places = [
            index.keypoints.get(f"/camera/{name}/keypoints", none) for name in setup.rig.names
        ]

    def at(self, camera: int, timestamp_ns: int) -> np.ndarray | None:
        """(n, k, 3) the latest of a camera; None where there is none of the present."""
        places = self._places[camera]
        row = bisect_right(places.times_ns, timestamp_ns) - 1
        if row < 0 or timestamp_ns - places.times_ns[row] > _OLD_NS:
            return None
        found = self._index.read(places, row)
        if not (isinstance(found, RecordedEvent) and isinstance(found.event, CameraSample)):
            return None
        return found.event.people

    def views(self, gui: viser.GuiApi, colours: Mapping[str, Rgb]) -> RecordedViews:
        """Adds them to a page."""
        return RecordedViews(gui, self, colours)


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
