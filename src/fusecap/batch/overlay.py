"""Videos with what was detected drawn in, from the files of a detection."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fusecap.batch.detect import CameraVideo
from fusecap.body.landmarks import LandmarkSet
from fusecap.exports.openpose import frame_path
from fusecap.exports.overlay import PeopleNumbers, draw_people, overlay_writer
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import read_people


def draw_overlays(
    cameras: Sequence[CameraVideo], landmarks: LandmarkSet, progress: Progress | None = None
) -> list[Path]:
    """Per camera a video beside its folder of keypoints, `<camera>_overlay.mp4`."""
    paths = []
    for camera in cameras:
        path = camera.folder.with_name(f"{camera.folder.name}_overlay.mp4")
        info = camera.video.info
        numbers = PeopleNumbers()
        with overlay_writer(path, info.size_px, info.rate_hz) as writer:
            for frame in camera.video.frames():
                found = read_people(frame_path(camera.folder, camera.name, frame.number), landmarks)
                if found is not None:
                    draw_people(frame.image, found, numbers.update(found), landmarks)
                writer.add(frame.image, frame.time_ns)
                if progress is not None:
                    progress(f"drawing {camera.name}", frame.number + 1, info.frames)
        paths.append(path)
    return paths
