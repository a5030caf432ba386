"""Keypoints from recorded videos: a folder of OpenPose JSON per camera.

Instants hold every frame of every camera once (`fusecap.sources.frame_sets.every_frame`), so a
camera that is faster than the others has keypoints at all its own frames. The detector sees all
views of an instant together and is told where people are expected: with calibrated cameras the
whole pipeline runs along (`Pipeline.expected`), without a calibration everyone is expected where
they were. The next pictures are decoded while networks look at the present ones.

What a folder holds is reused as long as video, detector and landmark set are the same. Frames take
their names whole, so folders are valid at any time. A folder that fusecap did not write is left
alone.

A run that was killed and started again gives the same keypoints as one that was not: every
`BLOCK_INSTANTS` detector and expectations start anew, so a block depends on its own pictures alone,
and a block with missing frames is looked at again from its start. Frames that have their file are
not written again.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int

from fusecap.believable import surest_of_views
from fusecap.body.landmarks import LandmarkSet
from fusecap.detect.clothes import ClothesReader
from fusecap.detect.detector import Detector, DetectorOptions
from fusecap.errors import InputError, SessionError
from fusecap.exports import openpose
from fusecap.files import distinct_names, plain
from fusecap.interrupts import Interruption, ctrl_c_held
from fusecap.pipeline import Pipeline
from fusecap.progress import Progress
from fusecap.setup import Setup, setup_of
from fusecap.sources.detection_files import DetectionRecord, mark, read_record
from fusecap.sources.frame_sets import FramePlan, clock_times_ns, every_frame, frame_sets
from fusecap.sources.keypoint_files import read_keypoints, read_people
from fusecap.sources.session import Session
from fusecap.sources.session_cameras import open_rig
from fusecap.sources.video import Video
from fusecap.types import Detections

SIZE_TOLERANCE = 0.02
"""Relative difference up to which a video may have another size than its calibration: encoders drop
rows and columns to reach multiples of 8."""
BLOCK_INSTANTS = 600
"""Instants after which nothing is known of earlier ones; a resumed run repeats fewer than these."""

_AHEAD = 2
"""Instants decoded ahead; each holds one picture per camera."""
_HELD_PERIODS = 1.01
"""Frame periods for which a view's last detections stand for it between its frames."""

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class CameraVideo:
    """A video to be detected, and where its keypoints go."""

    name: str
    video: Video
    folder: Path
    offset_s: float = 0.0
    """Added to the video's times."""


@dataclass(frozen=True, kw_only=True)
class CameraSummary:
    """What was found in one camera."""

    frames: int
    """With keypoint files, also those of earlier runs."""
    frames_in_video: int
    people_per_frame: float
    frames_with_people: float
    """Share."""
    mean_confidence: float
    """Of keypoints that were found; NaN for none."""
    folder: str


@dataclass(frozen=True, kw_only=True)
class Detected:
    """What a detection did."""

    detector: str
    landmark_set: str
    cameras: dict[str, CameraSummary]
    frames_detected: int
    """In this run; the others were there already."""
    frames_per_s: float
    """Decoding, detection, prediction and writing together, of all frames looked at, those looked
    at again after an interruption included; NaN where nothing was detected."""
    elapsed_s: float
    interrupted: bool
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        return plain(asdict(self))


def detector_options(
    session: Session | None, base: DetectorOptions | None = None, **given: Any
) -> DetectorOptions:
    """Defaults, changed by what `[detector]` says, changed by `given` that are not None."""
    options = base or DetectorOptions()
    if session is not None:
        options = replace(options, **_stated(session.detector.model_dump()))
    return replace(options, **_stated(given))


def _stated(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def session_videos(
    session: Session, out: Path | None = None, *, undetected: bool = False
) -> list[CameraVideo]:
    """The session's cameras that have a video; with `undetected` only those without keypoints.

    Keypoints go to a folder per camera under `out`, else where the session looks for them. Raises
    `InputError` for a video that cannot be read.
    """
    names = distinct_names(camera.name for camera in session.cameras)
    return [
        CameraVideo(
            name=camera.name,
            video=Video(camera.video),
            folder=out / name if out else session.detection_folder(camera),
            offset_s=camera.offset_s,
        )
        for camera, name in zip(session.cameras, names, strict=True)
        if camera.video is not None and not (undetected and camera.keypoints is not None)
    ]


def loose_videos(paths: Sequence[Path], out: Path) -> list[CameraVideo]:
    """Videos without a session: cameras are called like the files, whose clocks start together."""
    names = [path.stem for path in paths]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise InputError(
            f"two videos are called {', '.join(doubled)}; rename one: a camera is called like its "
            "file"
        )
    return [
        CameraVideo(name=path.stem, video=Video(path), folder=out / folder)
        for path, folder in zip(paths, distinct_names(names), strict=True)
    ]


def video_setup(
    session: Session, cameras: Sequence[CameraVideo], landmarks: LandmarkSet
) -> Setup | None:
    """What is known about the room: with it, people are predicted in three dimensions.

    None without a calibration. Raises `SessionError` for videos of another size than calibrated.
    """
    if session.settings.calibration is None:
        return None
    rig = open_rig(session)[0].subset([camera.name for camera in cameras])
    for camera, calibrated in zip(cameras, rig.cameras, strict=True):
        size = np.array(camera.video.info.size_px)
        if np.any(np.abs(size - calibrated.size_px) > SIZE_TOLERANCE * size):
            turned = camera.video.info.rotation_deg
            raise SessionError(
                f"{session.path}: camera '{camera.name}' shows {size[0]} x {size[1]} px"
                + (f" (turned by {turned} deg, as the file says)" if turned else "")
                + f", but is calibrated for {calibrated.size_px[0]} x {calibrated.size_px[1]}; "
                "use the video that was recorded, or calibrate at its size"
            )
    return setup_of(session, rig, landmarks)


def detect_videos(
    cameras: Sequence[CameraVideo],
    detector: Detector,
    *,
    setup: Setup | None = None,
    progress: Progress | None = None,
) -> Detected:
    """Finds everyone in every frame; Ctrl-C ends early with what was found until then.

    `setup` has the cameras in this order. Raises `InputError` for a folder of other keypoints.
    """
    started = time.perf_counter()
    works = [_Work(camera, detector, progress) for camera in cameras]
    plan = every_frame([clock_times_ns(c.video, c.offset_s) for c in cameras])
    loop_started = time.perf_counter()
    with ctrl_c_held() as stop:
        _detect(works, detector, plan, setup, progress, stop)
    loop_s = time.perf_counter() - loop_started
    if all(work.done.all() for work in works):
        for work in works:
            work.finish()
    looked_at = sum(work.looked_at for work in works)
    return Detected(
        detector=detector.identity,
        landmark_set=detector.landmarks.name,
        cameras={work.camera.name: work.summary() for work in works},
        frames_detected=sum(work.written for work in works),
        frames_per_s=looked_at / loop_s if looked_at else float("nan"),
        elapsed_s=time.perf_counter() - started,
        interrupted=stop.asked,
        notes=tuple(note for work in works for note in work.notes()),
    )


def _detect(
    works: Sequence[_Work],
    detector: Detector,
    plan: FramePlan,
    setup: Setup | None,
    progress: Progress | None,
    stop: Interruption,
) -> None:
    """Everything that has no file yet, and what comes before it in its block."""
    missing = np.stack([work.misses(plan.frame[:, i]) for i, work in enumerate(works)], axis=1)
    rows = _rows_to_detect(np.any(missing, axis=1, keepdims=False))
    shown = plan.frame[rows].copy()
    for index, work in enumerate(works):
        if work.was_complete:
            shown[~missing[rows, index], index] = -1
    total = int((shown >= 0).sum())
    videos = [work.camera.video for work in works]
    todo = FramePlan(timestamps_ns=plan.timestamps_ns[rows], frame=shown)
    expected, block = _expected_people(works, detector, setup), -1
    ahead = read_ahead(frame_sets(videos, todo), _AHEAD)
    for row, wanted, frames in zip(rows, shown, ahead, strict=True):
        if row // BLOCK_INSTANTS != block:
            block = row // BLOCK_INSTANTS
            detector.reset()
            expected = _expected_people(works, detector, setup)
        images = [None if frame is None else frame.image for frame in frames.frames]
        people: list[np.ndarray | None] = [None] * len(works)
        if any(image is not None for image in images):
            people = list(detector.detect(images, expected.at(frames.timestamp_ns)))
        for index, work in enumerate(works):
            number = int(plan.frame[row, index])
            if number < 0:
                people[index] = None
            elif wanted[index] < 0:
                people[index] = read_people(work.frame_path(number), detector.landmarks)
            else:
                people[index] = work.keep(number, people[index], images[index])
        expected.learn(frames.timestamp_ns, people)
        if progress is not None:
            progress("detecting frames", sum(work.looked_at for work in works), total)
        if stop.asked:
            break


def read_ahead(items: Iterable[T], count: int) -> Generator[T, None, None]:
    """The items (none of them None), up to `count` of them made ahead by a thread.

    What making an item raises is raised where that item is asked for.
    """
    source = iter(items)
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="read-ahead") as pool:
        waiting = deque(pool.submit(next, source, None) for _ in range(count))
        while (item := waiting.popleft().result()) is not None:
            waiting.append(pool.submit(next, source, None))
            yield item


def _rows_to_detect(missing: Bool[np.ndarray, " n"]) -> Int[np.ndarray, " m"]:
    """Per block the instants from its first to the last that misses frames."""
    blocks = [
        np.arange(start, start + np.flatnonzero(some)[-1] + 1)
        for start in range(0, len(missing), BLOCK_INSTANTS)
        if (some := missing[start : start + BLOCK_INSTANTS]).any()
    ]
    return np.concatenate([np.empty(0, dtype=np.int64), *blocks])


def _expected_people(
    works: Sequence[_Work], detector: Detector, setup: Setup | None
) -> ExpectedPeople:
    return ExpectedPeople(
        setup,
        periods_s=[1.0 / work.camera.video.info.rate_hz for work in works],
        landmark_count=len(detector.landmarks.landmark_names),
    )


class ExpectedPeople:
    """Learns from each instant's detections where people will be at the next."""

    def __init__(
        self, setup: Setup | None, *, periods_s: Sequence[float], landmark_count: int
    ) -> None:
        """`periods_s` are the cameras' frame periods, in the order of the setup's rig."""
        self._pipeline = None if setup is None else Pipeline(setup)
        self._hold_ns = [round(_HELD_PERIODS * period_s * 1e9) for period_s in periods_s]
        self._nobody = np.empty((0, landmark_count, 3))
        self._people = [self._nobody] * len(periods_s)
        self._seen_ns = [0] * len(periods_s)

    def at(self, now_ns: int) -> list[Float[np.ndarray, "m k 3"]]:
        """As `Pipeline.expected`."""
        return self._people if self._pipeline is None else self._pipeline.expected(now_ns)

    def learn(self, now_ns: int, people: Sequence[Float[np.ndarray, "n k 3"] | None]) -> None:
        """Per camera who was seen at `now_ns`; None where it had no picture."""
        for index, some in enumerate(people):
            if some is not None:
                self._people[index], self._seen_ns[index] = some, now_ns
            elif now_ns - self._seen_ns[index] > self._hold_ns[index]:
                self._people[index] = self._nobody
        if self._pipeline is not None:
            people = surest_of_views(self._people)
            self._pipeline.step(Detections(timestamp_ns=now_ns, people=people), {})


class _Work:
    """One camera's folder: what is there, and what is added."""

    def __init__(self, camera: CameraVideo, detector: Detector, progress: Progress | None) -> None:
        self.camera = camera
        self.written = 0
        self.looked_at = 0
        """Frames, those written included."""
        self._landmarks = detector.landmarks
        self._clothes = ClothesReader(detector.landmarks)
        self._undecodable = 0
        self._record = DetectionRecord(
            landmark_set=detector.landmarks.name,
            detector=detector.identity,
            video=mark(camera.video, progress),
            times_ns=camera.video.times_ns,
            complete=False,
        )
        self.done, self.was_complete = self._reusable()
        """(F,) which frames have a file, and whether an earlier run came to its end with them."""

    def _reusable(self) -> tuple[np.ndarray, bool]:
        folder, count = self.camera.folder, len(self._record.times_ns)
        before = read_record(folder)
        if before is None and openpose.is_foreign(folder):
            raise InputError(
                f"{folder}: holds files that fusecap did not write; move them away, write "
                f"elsewhere with --out, or name the folder as keypoints of '{self.camera.name}'"
            )
        if before is not None and not before.same_work(self._record):
            openpose.clear(folder)
            before = None
        if before is None:
            openpose.write_record(folder, self._record.json())
            return np.zeros(count, dtype=np.bool_), False
        there = {path.name for path in folder.iterdir()}
        done = np.array([self.frame_path(number).name in there for number in range(count)])
        return done, before.complete

    def misses(self, numbers: Int[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Which of these frames have no file; -1 is no frame."""
        return (numbers >= 0) & ~self.done[numbers]

    def frame_path(self, number: int) -> Path:
        return openpose.frame_path(self.camera.folder, self.camera.name, number)

    def keep(self, number: int, people: np.ndarray | None, image: np.ndarray | None) -> np.ndarray:
        """Writes a frame that has no file, that of a picture which cannot be decoded as empty."""
        if people is None or image is None:
            people = np.empty((0, len(self._landmarks.landmark_names), 3))
        self.looked_at += 1
        if not self.done[number]:
            self._undecodable += image is None
            looks = None if image is None else self._clothes.read(image, people)
            everything = self._landmarks.with_all(people)
            openpose.write_frame(self.camera.folder, self.camera.name, number, everything, looks)
            self.done[number] = True
            self.written += 1
        return people

    def finish(self) -> None:
        """Marks the folder as complete."""
        openpose.write_record(self.camera.folder, replace(self._record, complete=True).json())

    def notes(self) -> list[str]:
        notes = list(self.camera.video.notes)
        if self._undecodable:
            notes.append(
                f"{self.camera.video.path}: {self._undecodable} frames cannot be decoded and count "
                "as frames without people"
            )
        return notes

    def summary(self) -> CameraSummary:
        frames = int(self.done.sum())
        people: Sequence[np.ndarray] = ()
        if frames:
            people = read_keypoints(
                self.camera.folder,
                name=self.camera.name,
                landmarks=self._landmarks,
                rate_hz=self.camera.video.info.rate_hz,
            ).people
        counts = np.array([len(some) for some in people])
        nobody = np.empty((0, len(self._landmarks.landmark_names), 3))
        everyone = np.concatenate([nobody, *people])
        found = everyone[:, :, 2][everyone[:, :, 2] > 0]
        return CameraSummary(
            frames=frames,
            frames_in_video=len(self.done),
            people_per_frame=float(counts.mean()) if frames else float("nan"),
            frames_with_people=float((counts > 0).mean()) if frames else float("nan"),
            mean_confidence=float(found.mean()) if found.size else float("nan"),
            folder=str(self.camera.folder),
        )
