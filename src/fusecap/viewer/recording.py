"""What else a recording of a live run holds: the detections, from above and as cameras saw them."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import viser

from fusecap.errors import InputError
from fusecap.recording.index import Places, RecordingIndex
from fusecap.recording.layout import KEYPOINTS
from fusecap.recording.reader import RecordedEvent, Recording
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


def look_for_damage(path: Path, tell: Callable[[str], None]) -> threading.Thread:
    """Reads all of a recording beside the page, and tells what is broken in it; until the end."""

    def look() -> None:
        try:
            recording = Recording(path)
            deque(recording.messages(), maxlen=0)
        except InputError as error:
            tell(str(error))
            return
        except OSError as error:
            tell(f"{path.name} cannot be read to its end: {error}")
            return
        found = []
        if recording.loss.broken_chunks:
            found.append(
                f"in {recording.loss.broken_chunks} places of about half a second each, where "
                "people are missing"
            )
        if recording.loss.malformed:
            found.append(f"in {recording.loss.malformed} entries that do not follow the format")
        if found:
            tell(f"{path.name} is damaged {' and '.join(found)}; what else is: fusecap doctor")

    thread = threading.Thread(target=look, name="damage", daemon=True)
    thread.start()
    return thread


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
