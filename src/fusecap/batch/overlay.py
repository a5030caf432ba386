"""Videos with people drawn in: what was detected, from the files of a detection, or who was solved.

Interrupted (Ctrl-C), a video ends at the frame it had reached, as a whole file called
`..._interrupted.mp4`; what an earlier run wrote stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from fusecap.batch.detect import SIZE_TOLERANCE, CameraVideo
from fusecap.batch.seen import frames_at, paired, posed_keypoints
from fusecap.body.landmarks import LandmarkSet
from fusecap.errors import InputError
from fusecap.exports.openpose import frame_path
from fusecap.exports.overlay import (
    COLOURS_BGR,
    PeopleNumbers,
    draw_bystander,
    draw_people,
    draw_solved,
    overlay_writer,
)
from fusecap.exports.stick_figures import TakeSticks
from fusecap.files import distinct_names
from fusecap.geometry.camera import Camera
from fusecap.interrupts import ctrl_c_held
from fusecap.progress import Progress
from fusecap.sources.keypoint_files import KeypointTrack, read_people
from fusecap.sources.session import Session
from fusecap.sources.session_cameras import camera_track, common_landmarks, open_rig
from fusecap.sources.session_data import session_clocks, video_times_s
from fusecap.sources.synchronizer import people_at
from fusecap.sources.video import Video, VideoFrame
from fusecap.take import Take


@dataclass(frozen=True, kw_only=True)
class DrawnVideos:
    """What was written."""

    files: list[Path]
    interrupted: bool


@dataclass(frozen=True, kw_only=True)
class _Job:
    name: str
    video: Video
    path: Path
    paint: Callable[[VideoFrame], None]
    """Draws into the frame's picture."""


def draw_overlays(
    cameras: Sequence[CameraVideo], landmarks: LandmarkSet, progress: Progress | None = None
) -> DrawnVideos:
    """Per camera a video beside its folder of keypoints, `<camera>_overlay.mp4`."""
    return _draw(
        [
            _Job(
                name=camera.name,
                video=camera.video,
                path=camera.folder.with_name(f"{camera.folder.name}_overlay.mp4"),
                paint=_Found(camera, landmarks).paint,
            )
            for camera in cameras
        ],
        progress,
    )


def draw_take(
    take: Take, session: Session, folder: Path, stem: str, progress: Progress | None = None
) -> DrawnVideos:
    """`<stem>_<camera>_overlay.mp4` per camera with a video: who was solved, who else was found.

    `session` as `fusecap.sources.session_cameras.with_detections` gives it. Raises `InputError` for
    one without videos.
    """
    rig, landmarks = open_rig(session)[0], common_landmarks(session)
    shown = [(each, each.video) for each in session.cameras if each.video is not None]
    if not shown:
        raise InputError(
            f'{session.path}: no camera has a video to draw on; name one: video = "left.mp4"'
        )
    names = distinct_names(camera.name for camera, _ in shown)
    jobs: list[_Job] = []
    for (camera, path), name in zip(shown, names, strict=True):
        video, track = Video(path), None
        if camera.keypoints is not None:
            track = camera_track(session, camera, landmarks, progress)
            clock = session_clocks(session).camera(camera.name)
            track = replace(track, times_s=clock.session_s(track.times_s))
        times_s = video_times_s(session, camera, video)
        solved = _Solved(take, rig[camera.name], video, times_s, track)
        target = folder / f"{stem}_{name}_overlay.mp4"
        if any(target.resolve() == each.resolve() for _, each in shown):
            raise InputError(f"{target} is a video of the session; name another folder with --out")
        jobs.append(_Job(name=camera.name, video=video, path=target, paint=solved.paint))
    return _draw(jobs, progress)


class _Found:
    """Who was detected in one camera."""

    def __init__(self, camera: CameraVideo, landmarks: LandmarkSet) -> None:
        self._camera = camera
        self._landmarks = landmarks
        self._numbers = PeopleNumbers()

    def paint(self, frame: VideoFrame) -> None:
        path = frame_path(self._camera.folder, self._camera.name, frame.number)
        found = read_people(path, self._landmarks)
        if found is not None:
            draw_people(frame.image, found, self._numbers.update(found), self._landmarks)


class _Solved:
    """Who was solved, as one camera sees them."""

    def __init__(
        self,
        take: Take,
        camera: Camera,
        video: Video,
        times_s: Float[np.ndarray, " f"],
        track: KeypointTrack | None,
    ) -> None:
        self._take = take
        self._sticks = TakeSticks(take)
        self._camera = camera
        self._times_s = times_s
        self._track = track
        scale = video.info.size_px[0] / camera.size_px[0]
        self._scale = 1.0 if abs(scale - 1) <= SIZE_TOLERANCE else scale

    def paint(self, frame: VideoFrame) -> None:
        time_s = float(self._times_s[frame.number])
        if self._track is not None:
            for person in self._others(self._track, time_s):
                scaled = person * [self._scale, self._scale, 1.0]
                draw_bystander(frame.image, scaled, self._track.landmarks)
        for row, name in enumerate(self._take.subject_names):
            sticks = self._sticks.at_time(row, round(time_s * 1e9))
            if sticks is not None:
                colour = COLOURS_BGR[row % len(COLOURS_BGR)]
                draw_solved(frame.image, self._camera, sticks, colour, name=name, scale=self._scale)

    def _others(self, track: KeypointTrack, time_s: float) -> Float[np.ndarray, "n k 3"]:
        """Detections that are nobody of the take."""
        detected = people_at(track, time_s)
        frames = frames_at(self._take, np.array([round(time_s * 1e9)]))
        if frames[0] < 0 or not len(detected):
            return detected
        posed = posed_keypoints(self._take, track.landmarks, [self._camera], frames)[0, :, 0]
        _, known = paired(posed, detected)
        return np.delete(detected, known, axis=0)


def _draw(jobs: Iterable[_Job], progress: Progress | None) -> DrawnVideos:
    files: list[Path] = []
    with ctrl_c_held() as stop:
        for job in jobs:
            if stop.asked:
                return DrawnVideos(files=files, interrupted=True)
            info, whole = job.video.info, True
            partial = job.path.with_name(f"{job.path.stem}_interrupted{job.path.suffix}")
            with overlay_writer(partial, info.size_px, info.rate_hz) as writer:
                for frame in job.video.frames():
                    if stop.asked:
                        whole = False
                        break
                    job.paint(frame)
                    writer.add(frame.image, frame.time_ns)
                    if progress is not None:
                        progress(f"drawing {job.name}", frame.number + 1, info.frames)
            if not whole:
                return DrawnVideos(files=[*files, partial], interrupted=True)
            files.append(partial.replace(job.path))
    return DrawnVideos(files=files, interrupted=False)
